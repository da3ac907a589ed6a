//! Collection of pruned models, for a search for the smallest sufficient number of Gaussians. Models between two prune
//! steps are kept, so that the search can make smaller models from them instead of from the beginning.

use super::{MIN_KEPT_FRACTION, RefineRun};
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::journal::Journal;

/// Models that a search for the smallest sufficient number of Gaussians has kept so far, each between two prune steps.
/// To try another number of Gaussians, the search starts from the smallest of these models that has at least this
/// number.
pub struct PrunedModels<'a> {
    refinement: RefineRun<'a>,
    /// Models between two prune steps, from the largest to the smallest, all made from one model. A model that already
    /// has the requested number of Gaussians is not stored.
    models: Vec<CompressedModel>,
    /// Number of Gaussians of the model from which `models` were made.
    first: usize,
}

impl<'a> PrunedModels<'a> {
    /// Creates an empty collection of models. [`PrunedModels::refined`] adds models to it, which it makes by the
    /// optimization and prune steps of `refinement`.
    pub(crate) fn new(refinement: RefineRun<'a>) -> PrunedModels<'a> {
        PrunedModels { refinement, models: Vec::new(), first: 0 }
    }

    /// Returns a refined model. Prunes a larger model by optimization and prune steps, then runs the final optimization
    /// steps. `unrefined`: ids of the Gaussians that ranking alone keeps, increasing, as many as are to stay; if the
    /// model of these, unchanged, has better renders of the validation views, it is the result. The larger model is the
    /// smallest sufficient one that earlier calls have stored or, if there is none, `start`: the Gaussians that ranking
    /// keeps. If `start` has more Gaussians than the model with which earlier calls began, their models are dropped
    /// first. Notes for the user are added to `journal`, the record of the run.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub(crate) fn refined(
        &mut self,
        start: CompressedModel,
        unrefined: &[u32],
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let size = unrefined.len();
        let unrefined = match start.len() > size {
            true => {
                let model = start.with_kept(unrefined.to_vec());
                let quality = self.refinement.validation_quality(&model)?;
                if self.refinement.is_good_enough(&quality, journal) {
                    return Ok(model);
                }
                Some((model, quality))
            }
            false => None,
        };
        if start.len() > self.first {
            (self.first, self.models) = (start.len(), Vec::new());
        }
        let before = self.models.iter().rfind(|model| start.len() > size && model.len() >= size);
        let mut model = before.cloned().unwrap_or(start);
        while model.len() > size {
            let next = next_size(model.len(), size);
            model = self.refinement.prune_to(&model, next, size)?;
            if next > size {
                self.models.push(model.clone());
            }
        }
        self.refinement.refine_best(model, unrefined, journal)
    }
}

/// Returns how many of `count` Gaussians the next prune step keeps, if `target_count` are to remain in the end. This is
/// the fraction [`MIN_KEPT_FRACTION`] of `count`, but at least `target_count`, and less than `count`.
fn next_size(count: usize, target_count: usize) -> usize {
    ((MIN_KEPT_FRACTION * count as f64).ceil() as usize).min(count - 1).max(target_count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prune_steps_reach_every_size_from_every_count() {
        for count in 0..=50 {
            for wanted in 0..count {
                let (mut left, mut steps) = (count, 0);
                while left > wanted {
                    let next = next_size(left, wanted);
                    assert!((wanted..left).contains(&next), "{left} to {next} on the way to {wanted}");
                    (left, steps) = (next, steps + 1);
                }
                assert!(steps <= count, "{steps} steps from {count} to {wanted}");
            }
        }
        assert_eq!([next_size(1000, 3), next_size(1000, 900), next_size(5, 1)], [800, 900, 4]);
    }
}
