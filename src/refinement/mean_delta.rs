//! Mean of the parameter deltas after some of the last optimization steps of a refinement.

use serde::{Deserialize, Serialize};

use crate::compressed_model::ParamDelta;

/// Fraction of the final steps, taken from their end, over which the parameters are averaged. The parameters after
/// single steps scatter around the optimum; their mean is closer to it.
const AVERAGED_FRACTION: f64 = 0.4;
/// Number n: of the last optimization steps, the parameter delta after every n-th step is included in the mean.
const AVERAGE_EVERY: usize = 4;

/// Returns whether the parameters after the optimization step `step` (from 1) of `steps` are included in the mean.
pub(super) fn is_averaged(step: usize, steps: usize) -> bool {
    let averaged_after = steps - (steps as f64 * AVERAGED_FRACTION) as usize;
    step > averaged_after && (step - averaged_after).is_multiple_of(AVERAGE_EVERY)
}

/// Mean of parameter deltas (values that refinement adds to the parameters). One delta is taken after every
/// [`AVERAGE_EVERY`]-th of the last optimization steps.
#[derive(Clone, Default, Serialize, Deserialize)]
pub(super) struct MeanDelta {
    pub(super) delta: ParamDelta,
    /// Number of parameter deltas of which `delta` is the mean so far.
    pub(super) count: u32,
}

impl MeanDelta {
    /// Includes the parameter delta `next` in the mean.
    pub(super) fn add(&mut self, mut next: ParamDelta) {
        self.count += 1;
        let part = 1.0 / self.count as f32;
        self.delta.scale(1.0 - part);
        next.scale(part);
        self.delta = std::mem::take(&mut self.delta).plus(next);
    }
}
