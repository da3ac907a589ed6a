//! Rounding of the stored parameters to the quantization grids of an archive, for refinement.

use crate::archive::{self, ATTRIBUTES, CloudSteps};
use crate::compressed_model::ParamDelta;
use crate::model::{AttributeValues, Attributes, Gaussians};

/// Rounding of the stored parameters of all Gaussians to quantization grids.
#[derive(Debug)]
pub(super) struct Rounding {
    /// Stored parameters before the first optimization step.
    start: Gaussians,
    steps: CloudSteps,
    /// Attributes that are rounded, as indices in [`ATTRIBUTES`].
    attributes: Vec<usize>,
}

impl Rounding {
    /// Creates a rounding of the stored parameters `start` with the quantization steps `steps`. `base`: parameters to
    /// which the optimizer adds its delta. `constant`: attributes that do not vary with time. An attribute is rounded
    /// only if it is in `constant` and has the same values in `start` and `base`. Otherwise the format stores it in
    /// another unit or for each frame, and its grid does not apply to `base`.
    pub(super) fn new(start: Gaussians, steps: CloudSteps, base: &Gaussians, constant: Attributes) -> Rounding {
        let is_rounded = |k: &usize| {
            let attribute = archive::attribute(*k);
            constant.contains(attribute) && start.attribute_values(attribute) == base.attribute_values(attribute)
        };
        let attributes = (0..ATTRIBUTES.len()).filter(is_rounded).collect();
        Rounding { start, steps, attributes }
    }

    /// Returns `delta`, changed so that `start` + `baked` + delta is on the quantization grids. Attributes that are not
    /// rounded keep their delta. `baked`: part of the total delta that the frame states already include.
    pub(super) fn rounded_delta(&self, baked: &ParamDelta, delta: &ParamDelta) -> ParamDelta {
        let mut base = self.start.clone();
        baked.add_to(&mut base, Attributes::all());
        let mut rounded = base.clone();
        delta.add_to(&mut rounded, Attributes::all());
        archive::round_cloud(&mut rounded, &self.steps, &self.attributes);
        let mut difference = ParamDelta::default();
        for column in delta.attributes().iter() {
            let width = delta.0.attribute_values(column).width();
            let (to, from) = (rounded.attribute_values(column), base.attribute_values(column));
            let values = (0..width).flat_map(|c| to.plane(c).iter().zip(from.plane(c)).map(|(to, from)| to - from));
            *difference.0.attribute_values_mut(column) = AttributeValues::from_planes(width, values.collect());
        }
        difference
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns Gaussians whose k-th value of every attribute is k · `step` + 0.2531 (k from 0).
    fn ramp(count: usize, step: f32) -> Gaussians {
        let mut ramp = Gaussians::zeros(count, 1);
        for column in ramp.selected_attribute_values_mut(Attributes::all()) {
            column.planes_mut().iter_mut().enumerate().for_each(|(k, value)| *value = k as f32 * step + 0.2531);
        }
        ramp
    }

    #[test]
    fn rounded_parameters_are_on_the_grid_and_others_stay() {
        let (start, mut state) = (ramp(5, 0.375), ramp(5, 0.375));
        state.opacity_logit.planes_mut()[0] += 1.0;
        // The exponent 0 stands for the quantization step 2^(0/8) = 1.
        let rounding = Rounding::new(start.clone(), [0; ATTRIBUTES.len()], &state, Attributes::all());
        let (baked, delta) = (ParamDelta(ramp(5, 0.11)), ParamDelta(ramp(5, 0.07)));
        let rounded = rounding.rounded_delta(&baked, &delta);
        for column in Attributes::all().iter() {
            let values = |gaussians: &Gaussians| gaussians.attribute_values(column).planes().to_vec();
            let [start, baked, delta, rounded] = [&start, &baked.0, &delta.0, &rounded.0].map(values);
            for k in 0..start.len() {
                let [exact, sum] =
                    [delta[k], rounded[k]].map(|delta| f64::from(start[k] + baked[k]) + f64::from(delta));
                let expected = if column == Attributes::OPACITY { exact } else { exact.round() };
                assert!((sum - expected).abs() < 1e-5, "{column:?} {k}: {exact} to {sum}");
            }
        }
    }
}
