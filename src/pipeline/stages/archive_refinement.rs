//! Refinement of a result for the quantization of its archive (quantization-aware fine-tuning).
//!
//! The deformation field and the further columns are quantized and then stay fixed. Optimization steps move the
//! attributes of the Gaussians so that renders of their rounded values are close to the original
//! ([`RefineStage::refine_quantized`]). This removes most of the error that quantization adds.
//!
//! [`ArchiveRefinement::refined_archive`] tries several sets of quantization steps. Each attempt starts from the
//! unquantized result, refines it, encodes it and measures it. For a maximum loss of PSNR, the archive becomes smaller,
//! because coarser steps suffice. For a byte limit, its PSNR becomes higher.

use std::borrow::Cow;

use super::quantizer::{MeasuredArchive, Quantizer};
use super::reference_views::{QualityTarget, error_from_loss, loss_from_error};
use crate::archive::{self, ATTRIBUTES, ArchiveContent, FIRST_SH_ATTRIBUTE, QuantizationSteps};
use crate::compressed_model::{CompressedModel, ParamDelta};
use crate::error::{ErrorKind, Result};
use crate::model::{Attributes, FrameView, Gaussians};
use crate::progress::Progress;
use crate::refinement::RefineStage;
use crate::refinement::targets::{Targets, ViewSplit};
use crate::scene::Scene;

/// Estimate of a ratio: the squared error of renders that quantization adds after refinement, divided by the error that
/// it adds before. The first attempt chooses its quantization steps by it.
const EXPECTED_ERROR_RATIO: f64 = 0.4;
/// Maximum number of attempts to find the coarsest quantization steps that meet a maximum loss of PSNR.
const MAX_ATTEMPTS: usize = 3;
/// Limits of the factor on the error before refinement, from an attempt that misses the target to the next one. Used
/// until an attempt meets the target. The factor is the allowed error divided by the error after refinement.
const MISS_FACTOR_RANGE: [f64; 2] = [0.25, 0.8];
/// An attempt that meets the target is followed by one with coarser quantization steps if the allowed error, divided by
/// the error after refinement, is at least this value.
const MIN_GROWTH: f64 = 1.6;
/// Upper limit of this quotient g when the next quantization steps are computed from it.
const MAX_GROWTH: f64 = 4.0;
/// Exponent p: the next attempt allows g^p times the error before refinement. p is below 1 because the error after
/// refinement grows faster than the error before.
const GROWTH_EXPONENT: f64 = 0.6;
/// Fractions of a byte limit that an archive may take before refinement, one for each attempt. Refined values may take
/// a few more bytes.
const BYTES_FRACTIONS: [f64; 2] = [0.995, 0.98];
/// Fraction of the optimization steps that also move positions. In the remaining steps, positions are fixed and the
/// deformation field has its final values: the quantization grids of its feature planes depend on the positions.
const FREE_POSITION_FRACTION: f64 = 0.62;
/// Maximum number of target views, except in a search. This refinement has fewer steps than the main one (method.md,
/// section 6.2), so fewer views are enough.
const MAX_TARGET_VIEWS: usize = 260;

/// Returns the loss of PSNR, dB, that quantization may cause before refinement if it is to cause at most `most` after
/// it.
pub(super) fn loss_before_refinement(most: f64) -> f64 {
    loss_from_error(error_from_loss(most) / EXPECTED_ERROR_RATIO)
}

impl RefineStage {
    /// Returns a copy of this stage that refines a result for the quantization of its archive, in `archive_steps` steps
    /// without prune steps; `None` if there are no such steps. `searches`: whether the run searches for the smallest
    /// model with a requested quality. The number of target views then stays that of the search. Otherwise other target
    /// views would be chosen, and test views of the search could become training views.
    pub(super) fn for_archive(&self, searches: bool) -> Option<RefineStage> {
        let mut refine = self.clone().without_prune_steps().with_time_independent_deltas();
        refine.steps = self.archive_steps;
        if !searches {
            refine.target_views.max_count = refine.target_views.max_count.min(MAX_TARGET_VIEWS);
        }
        (refine.steps > 0).then_some(refine)
    }

    /// Returns the two parts of this refinement ([`RefineStage::for_archive`]): with and without positions.
    fn parts_with_and_without_positions(&self) -> [RefineStage; 2] {
        let [mut with, mut without] = [self.clone(), self.clone()];
        with.steps = (FREE_POSITION_FRACTION * self.steps as f64).ceil() as usize;
        without.steps -= with.steps;
        without.columns.remove(Attributes::POSITION);
        [with, without]
    }
}

/// Refinement of a result for the quantization of its archive.
pub(super) struct ArchiveRefinement<'a> {
    scene: &'a Scene,
    /// Refinement of all parameters, and refinement without positions.
    parts: [RefineStage; 2],
    compressed: &'a CompressedModel,
    /// For each Gaussian of `compressed`, whether it is protected, so that it is not changed.
    fixed: &'a [bool],
    targets: Targets,
    views: ViewSplit,
}

impl<'a> ArchiveRefinement<'a> {
    /// Creates the refinement `refine` ([`RefineStage::for_archive`]) of the result `compressed`, and renders its
    /// target views. Returns `None` if there are no training views.
    /// - `fixed`: whether each Gaussian is protected, so that it is not changed.
    /// - `compared`: views by which the quality of the archive is measured; they are removed from the training views.
    /// - `has_test_views`: whether one of every four target views is a test view, as in a search.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub(super) fn new(
        scene: &'a Scene,
        refine: &RefineStage,
        (compressed, fixed): (&'a CompressedModel, &'a [bool]),
        compared: &[FrameView],
        has_test_views: bool,
    ) -> Result<Option<ArchiveRefinement<'a>>> {
        if scene.schedule.pair_count() == 0 {
            return Ok(None);
        }
        let strides = refine.stored_strides(&scene.workload(), compressed.len());
        let targets = Targets::new(scene, refine.target_views, strides, has_test_views)?;
        let mut views = targets.split();
        let is_compared = |k: usize| {
            let is_same = |view: &FrameView| {
                view.frame == targets.views[k].frame
                    && scene.schedule.cameras[view.camera as usize] == *targets.camera(k)
            };
            compared.iter().any(is_same)
        };
        views.training.retain(|&k| !is_compared(k));
        let parts = refine.parts_with_and_without_positions();
        let has_views = !views.training.is_empty();
        Ok(has_views.then_some(ArchiveRefinement { scene, parts, compressed, fixed, targets, views }))
    }

    /// Returns the number of optimization steps of one attempt.
    pub(super) fn optimization_steps(&self) -> usize {
        self.parts.iter().map(|part| part.steps).sum()
    }

    /// Returns the refined archive that meets `target`. For a maximum loss, this is the archive of the last attempt that
    /// meets it, which has the coarsest quantization steps. Returns `None` if no attempt meets the target, if a refined
    /// archive within a byte limit is not better than the unrefined one, if the reader of the model format refuses
    /// quantized values, or if `target` compares with the result before quantization.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub(super) fn refined_archive(
        &self,
        quantizer: &Quantizer<'_>,
        target: QualityTarget,
    ) -> Result<Option<MeasuredArchive>> {
        match target {
            QualityTarget::Close(_) => Ok(None),
            QualityTarget::Loss(most) => {
                let allowed = error_from_loss(most);
                let (mut error, mut best): (f64, Option<MeasuredArchive>) = (allowed / EXPECTED_ERROR_RATIO, None);
                for _ in 0..MAX_ATTEMPTS {
                    let unrefined = quantizer.archive(QualityTarget::Loss(loss_from_error(error)))?;
                    if best.as_ref().is_some_and(|best| best.steps == unrefined.steps) {
                        break;
                    }
                    let Some(refined) = self.refined(quantizer, unrefined.steps)? else { break };
                    let growth = allowed / error_from_loss(refined.loss).max(f64::MIN_POSITIVE);
                    let (is_met, was_met) = (refined.loss <= most, best.is_some());
                    if is_met {
                        best = Some(refined);
                    }
                    error *= match is_met {
                        true if growth >= MIN_GROWTH => growth.min(MAX_GROWTH).powf(GROWTH_EXPONENT),
                        false if !was_met => growth.clamp(MISS_FACTOR_RANGE[0], MISS_FACTOR_RANGE[1]),
                        _ => break,
                    };
                    // With so little error, values that are only quantized meet the target.
                    if error <= allowed {
                        break;
                    }
                }
                Ok(best)
            }
            QualityTarget::Bytes(most) => {
                for fraction in BYTES_FRACTIONS {
                    let Some((steps, encoded)) = quantizer.finest_within((fraction * most as f64) as u64)? else {
                        break;
                    };
                    let unrefined = quantizer.measure((steps.clone(), encoded))?;
                    let Some(refined) = self.refined(quantizer, steps)? else { break };
                    if refined.encoded.bytes.len() as u64 <= most {
                        return Ok(Some(refined).filter(|refined| refined.loss < unrefined.loss));
                    }
                }
                Ok(None)
            }
        }
    }

    /// Refines the result for the quantization steps `quantization`, and returns its encoded and measured archive.
    /// Returns `None` if the reader of the model format refuses quantized values.
    fn refined(&self, quantizer: &Quantizer<'_>, quantization: QuantizationSteps) -> Result<Option<MeasuredArchive>> {
        let scene = self.scene;
        let refine = || {
            let (mut compressed, mut content) = (self.compressed.clone(), Cow::Borrowed(quantizer.content));
            for part in &self.parts {
                let delta = self.refined_delta(part, &content, &quantization, &quantizer.progress)?;
                compressed.delta = std::mem::take(&mut compressed.delta).plus(delta);
                content = Cow::Owned(scene.input.archive_content(&compressed)?);
            }
            quantizer.measure((quantization.clone(), archive::encode(&content, &quantization)?))
        };
        match refine() {
            Err(error) if error.kind() == ErrorKind::Input => Ok(None),
            refined => refined.map(Some),
        }
    }

    /// Refines the attributes of `content` with the optimization steps of `part`. Renders use values that are rounded
    /// with `quantization`. Returns the parameter delta: values to add to the attributes before they are rounded.
    fn refined_delta(
        &self,
        part: &RefineStage,
        content: &ArchiveContent,
        quantization: &QuantizationSteps,
        progress: &Progress,
    ) -> Result<ParamDelta> {
        let mut start_content = content.clone();
        // Indices in ATTRIBUTES of the attributes and SH degrees that `part` does not optimize. They are rounded once.
        let is_unchanged = |&k: &usize| {
            let degree = k.saturating_sub(FIRST_SH_ATTRIBUTE);
            !part.columns.contains(archive::attribute(k)) || degree > part.sh_degree
        };
        let unchanged: Vec<usize> = (0..ATTRIBUTES.len()).filter(is_unchanged).collect();
        archive::round_cloud(&mut start_content.cloud, &quantization.cloud, &unchanged);
        for (column, step) in start_content.columns.iter_mut().zip(&quantization.columns) {
            archive::round_column(column, *step);
        }
        // The grids of the field depend on the positions as they will be decoded (attribute 0).
        let mut rounded = Gaussians { position: content.cloud.position.clone(), ..Gaussians::default() };
        archive::round_cloud(&mut rounded, &quantization.cloud, &[0]);
        let space = archive::field_box(content);
        for (name, tensor_steps) in &quantization.field.0 {
            let (tensor, role) = (&content.tensors[name], content.field[name]);
            let tensor = archive::round_tensor(tensor, role, tensor_steps, &rounded.position, space);
            start_content.tensors.insert(name.clone(), tensor);
        }
        let source = self.scene.input.decode_frames(&start_content)?;
        let start = (start_content.cloud, quantization.cloud);
        part.refine_quantized(self.scene, (&self.targets, &self.views), &*source, start, self.fixed.to_vec(), progress)
    }
}
