//! Refinement of a model whose parameters are rounded to quantization grids, as in an archive.
//!
//! Every optimization step renders the rounded parameters and applies the derivatives to the unrounded ones
//! (straight-through estimator: Bengio, Léonard and Courville, "Estimating or Propagating Gradients Through Stochastic
//! Neurons for Conditional Computation", arXiv 1308.3432). So parameters move until their rounded values, together with
//! other values that are quantized and stay as they are, render close to the target views.

use super::RefineStage;
use super::optimizer::RateSchedule;
use super::optimizer_state::OptimizerState;
use super::run::{AVERAGE_EVERY, AVERAGED_FRACTION, EpochSampler, MeanDelta};
use super::targets::{Targets, ViewSplit};
use crate::archive::{self, ATTRIBUTES, CloudSteps};
use crate::compressed_model::ParamDelta;
use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians};
use crate::progress::Progress;
use crate::scene::Scene;
use crate::source::FrameSource;

/// Learning rates at the first and at the last optimization step, as a fraction of those at the beginning of a
/// refinement without rounding.
const RATES: [f32; 2] = [0.25, 0.05];

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
    /// Creates a rounding of the stored parameters `start` to grids with the quantization steps `steps`. The optimizer
    /// adds its deltas to the parameters `base`. Only attributes that have the same values in `start` and `base` are
    /// rounded, and only those in `constant`: a format may store the others in other units, or for each frame.
    pub(super) fn new(start: Gaussians, steps: CloudSteps, base: &Gaussians, constant: Attributes) -> Rounding {
        let is_rounded = |k: &usize| {
            let attribute = archive::attribute(*k);
            constant.contains(attribute) && start.attribute_values(attribute) == base.attribute_values(attribute)
        };
        let attributes = (0..ATTRIBUTES.len()).filter(is_rounded).collect();
        Rounding { start, steps, attributes }
    }

    /// Returns the delta that replaces `delta` so that its sum with the start parameters and `baked` is on the
    /// quantization grids.
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

impl RefineStage {
    /// Refines the attributes [`RefineStage::columns`] of a model by [`RefineStage::steps`] optimization steps, so that
    /// the model is close to the target views after these attributes have been rounded. Returns the delta: values to
    /// add to the parameters `start`, before rounding. It is a mean over the last steps.
    /// - `result`: reader of the frames of the model. Values that the steps do not change, such as a deformation field,
    ///   must be rounded already.
    /// - `start`: stored parameters of the model, not rounded. `quantization`: quantization steps of its attributes.
    /// - `fixed`: whether each Gaussian is protected, that is, not changed.
    /// - `views`: training and validation views. The error of the validation views sets the learning rates.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub(crate) fn refine_quantized(
        &self,
        scene: &Scene,
        (targets, views): (&Targets, &ViewSplit),
        result: &dyn FrameSource,
        (start, quantization): (Gaussians, CloudSteps),
        fixed: Vec<bool>,
        progress: &Progress,
    ) -> Result<ParamDelta> {
        let mut optimizer = OptimizerState::new(scene, result, targets, self.step_params(), fixed)?;
        optimizer.set_rounding(start, quantization);
        let error = optimizer.quality(&views.validation)?.typical_error();
        let schedule = RateSchedule::new(self.steps, RATES[1] / RATES[0], error).scaled_by(RATES[0]);
        let (mut sampler, mut mean) = (EpochSampler::new(views.training.clone()), MeanDelta::default());
        let averaged_after = self.steps - (self.steps as f64 * AVERAGED_FRACTION) as usize;
        for step in 1..=self.steps {
            optimizer.step(sampler.next(), &schedule)?;
            if step > averaged_after && (step - averaged_after).is_multiple_of(AVERAGE_EVERY) || step == self.steps {
                mean.add(optimizer.change());
            }
            progress.advance(1);
        }
        Ok(mean.delta)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::tests::{scene, score_scene};
    use crate::pruning::score::UserOverrides;
    use crate::recipe::Recipe;

    /// Returns Gaussians with 0, 1, 2, … times `step` as values of all attributes.
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
        // Steps of 1: 2^(0/8).
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

    #[test]
    fn refined_parameters_render_better_after_rounding() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default());
        let mut stage = RefineStage::from_recipe(&recipe, None, false).unwrap();
        (stage.steps, stage.target_views, stage.keyframes) = (60, 60, 0);
        let kept = scored.ranking().best_ids(300);
        let fixed: Vec<bool> = kept.iter().map(|id| id % 7 == 0).collect();
        let compressed = crate::compressed_model::CompressedModel::pruned(kept, &recipe.merge);
        let result = scene.input.compressed_frames(&compressed).unwrap();
        let targets = Targets::new(&scene, 60, std::num::NonZeroU32::MIN, false).unwrap();
        let start = crate::passes::gather_all(&*result, 0, Attributes::all()).unwrap();
        // Log scales, opacities and colors in steps of 1/2, positions and rotations in steps of 2^-10.
        let steps = [-80, -80, -8, -8, -8, -8, -8, -8];
        let progress = scene.events.task("test", "steps", 0);
        let refined = stage
            .refine_quantized(
                &scene,
                (&targets, &targets.split()),
                &*result,
                (start.clone(), steps),
                fixed.clone(),
                &progress,
            )
            .unwrap();
        let quality = |delta: &ParamDelta| {
            let mut optimizer =
                OptimizerState::new(&scene, &*result, &targets, stage.step_params(), fixed.clone()).unwrap();
            optimizer.set_rounding(start.clone(), steps);
            optimizer.restart_from(delta).unwrap();
            optimizer.quality(&targets.split().validation).unwrap().psnr
        };
        let [before, after] = [ParamDelta::default(), refined.clone()].map(|delta| quality(&delta));
        assert!(after > before + 1.0, "{before:.2} dB before, {after:.2} dB after");
        for (place, _) in fixed.iter().enumerate().filter(|(_, fixed)| **fixed) {
            let moved = |column: Attributes| {
                let delta = refined.0.attribute_values(column);
                (0..delta.width()).any(|c| delta.plane(c)[place] != 0.0)
            };
            assert!(!Attributes::all().iter().any(moved), "Gaussian {place} is protected and moved");
        }
    }
}
