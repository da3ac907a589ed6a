//! Refinement of a model whose parameters are rounded to quantization grids, as in an archive.
//!
//! Every optimization step renders the rounded parameters and applies the derivatives to the unrounded ones
//! (straight-through estimator: Bengio, Léonard and Courville, "Estimating or Propagating Gradients Through Stochastic
//! Neurons for Conditional Computation", arXiv 1308.3432). So parameters move until their rounded values, together with
//! other values that are quantized and stay as they are, render close to the target views.

use super::RefineStage;
use super::epoch_sampler::EpochSampler;
use super::mean_delta::{MeanDelta, is_averaged};
use super::optimizer::RateSchedule;
use super::optimizer_state::OptimizerState;
use super::targets::{Targets, ViewSplit};
use crate::archive::CloudSteps;
use crate::compressed_model::ParamDelta;
use crate::error::Result;
use crate::model::Gaussians;
use crate::progress::Progress;
use crate::scene::Scene;
use crate::source::FrameSource;

/// Learning rates at the first and at the last optimization step, as a fraction of those at the beginning of a
/// refinement without rounding.
const RATES: [f32; 2] = [0.25, 0.05];

impl RefineStage {
    /// Refines the attributes [`RefineStage::columns`] of a model by [`RefineStage::steps`] optimization steps, so that
    /// the model is close to the target views after these attributes have been rounded. Returns the delta: values to
    /// add to the parameters `start`, before rounding. It is a mean over the last steps.
    /// - `result`: reader of the frames of the model. Values that the steps do not change, such as a deformation field,
    ///   must be rounded already.
    /// - `start`: stored parameters of the model that `result` reads. Attributes that the steps change are not rounded;
    ///   all others are. `quantization`: quantization steps of the attributes.
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
        for step in 1..=self.steps {
            let (view, next) = (sampler.next(), (step < self.steps).then(|| sampler.peek()));
            rayon::scope(|_| optimizer.step(view, next, &schedule))?;
            if is_averaged(step, self.steps) || step == self.steps {
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
    use crate::model::Attributes;
    use crate::pipeline::tests::{scene, score_scene};
    use crate::pruning::score::UserOverrides;
    use crate::recipe::Recipe;
    use crate::refinement::targets::ViewStrides;

    #[test]
    fn refined_parameters_render_better_after_rounding() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default());
        let mut stage = RefineStage::from_recipe(&recipe, None, false).unwrap();
        (stage.steps, stage.target_views.max_count, stage.keyframes) = (60, 60, 0);
        let kept = scored.ranking().best_ids(300);
        let fixed: Vec<bool> = kept.iter().map(|id| id % 7 == 0).collect();
        let compressed = crate::compressed_model::CompressedModel::pruned(kept, &recipe.merge);
        let result = scene.input.compressed_frames(&compressed).unwrap();
        let whole = ViewStrides::with_whole_validation(crate::render::ALL_PIXELS);
        let targets = Targets::new(&scene, stage.target_views, whole, false).unwrap();
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
