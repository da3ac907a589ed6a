//! Refinement of the parameters in an archive for their quantization steps.
//!
//! Quantization changes the deformation field and the other values of a model together. The stored parameters of the
//! Gaussians can make up for most of this: they are optimized again with the quantized field, and rounded to their
//! quantization grids in every render ([`RefineStage::refine_quantized`]). So an archive of a given quality may have
//! coarser steps.

use std::num::NonZeroU32;

use super::archive::{MeasuredArchive, Quantizer};
use super::reference_views::QualityTarget;
use crate::archive::{self, ArchiveContent, QuantizationSteps};
use crate::compressed_model::{CompressedModel, ParamDelta};
use crate::error::{ErrorKind, Result};
use crate::model::Attributes;
use crate::progress::Progress;
use crate::refinement::RefineStage;
use crate::refinement::targets::Targets;
use crate::scene::Scene;

/// Squared error of renders that quantization adds after refinement, divided by the one before it: an estimate, with
/// which the first attempt chooses its quantization steps.
const EXPECTED_ERROR_RATIO: f64 = 0.4;
/// Maximum number of attempts to meet a maximum loss of PSNR with quantization steps as coarse as possible.
const MAX_ATTEMPTS: usize = 3;
/// Range of the factor on the error before refinement for the next attempt, if an attempt has missed the target.
const FINER: [f64; 2] = [0.25, 0.8];
/// Minimum factor by which the error after refinement could grow within the target for which coarser quantization steps
/// are tried.
const MIN_GROWTH: f64 = 1.6;
/// Exponent p: attempts with coarser steps multiply the error before refinement by (the growth that the target allows
/// for the error after refinement)^p. The error after refinement grows faster than the one before.
const GROWTH_EXPONENT: f64 = 0.6;
/// Maximum growth of the error after refinement that is used for the next attempt.
const MAX_GROWTH: f64 = 4.0;
/// Parts of a byte limit that the archives have before refinement, one for each attempt. Refined values may take a few
/// more bytes.
const BYTES_PARTS: [f64; 2] = [0.995, 0.98];
/// Fraction of the optimization steps that refine all parameters. The others follow with fixed positions: the
/// quantization grid of a texel depends on the positions, so the final values of the field are known only once the
/// positions are.
const FREE_POSITION_STEPS: f64 = 0.62;
/// Maximum number of target views. There are fewer steps than in a refinement from the beginning, so fewer views are
/// enough.
const MAX_TARGET_VIEWS: usize = 260;

/// Returns the loss of PSNR, dB, that quantization may cause before refinement if it is to cause at most `most` after
/// it.
pub(super) fn loss_before_refinement(most: f64) -> f64 {
    loss_from_error(error_from_loss(most) / EXPECTED_ERROR_RATIO)
}

/// Returns the squared error that quantization adds if it lowers the PSNR by `loss` dB, as a fraction of the squared
/// error before quantization.
fn error_from_loss(loss: f64) -> f64 {
    10f64.powf(0.1 * loss) - 1.0
}

/// Returns the loss of PSNR, dB, by a squared error `error`, as a fraction of the squared error before quantization.
fn loss_from_error(error: f64) -> f64 {
    10.0 * (1.0 + error).log10()
}

impl RefineStage {
    /// Returns the refinement of this stage's parameters for the quantization steps of an archive; `None` if it has no
    /// optimization steps.
    pub(super) fn for_archive(&self) -> Option<RefineStage> {
        let mut refine = self.clone().without_prune_steps().with_time_independent_deltas();
        refine.steps = self.archive_steps;
        refine.target_views = refine.target_views.min(MAX_TARGET_VIEWS);
        (refine.steps > 0).then_some(refine)
    }

    /// Returns the two parts of this refinement ([`RefineStage::for_archive`]): with and without positions.
    fn parts_with_and_without_positions(&self) -> [RefineStage; 2] {
        let [mut with, mut without] = [self.clone(), self.clone()];
        with.steps = (FREE_POSITION_STEPS * self.steps as f64).ceil() as usize;
        without.steps -= with.steps;
        without.columns.remove(Attributes::POSITION);
        [with, without]
    }
}

/// Refinement of a result for the quantization steps of its archive.
pub(super) struct ArchiveRefinement<'a> {
    scene: &'a Scene,
    /// Refinement of all parameters, and refinement without positions.
    parts: [RefineStage; 2],
    compressed: &'a CompressedModel,
    fixed: &'a [bool],
    targets: Targets,
}

impl<'a> ArchiveRefinement<'a> {
    /// Creates the refinement `refine` ([`RefineStage::for_archive`]) of the result `compressed`, and renders its
    /// target views. `fixed`: whether each Gaussian is protected, so that it is not changed.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub(super) fn new(
        scene: &'a Scene,
        refine: &RefineStage,
        compressed: &'a CompressedModel,
        fixed: &'a [bool],
    ) -> Result<ArchiveRefinement<'a>> {
        let stride: NonZeroU32 = refine.stored_stride(scene.workload().pixels, compressed.len());
        let targets = Targets::new(scene, refine.target_views, stride, false)?;
        let parts = refine.parts_with_and_without_positions();
        Ok(ArchiveRefinement { scene, parts, compressed, fixed, targets })
    }

    /// Returns an archive of refined parameters that meets `target`; `None` if no attempt has met it.
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
                let (mut error, mut best) = (allowed / EXPECTED_ERROR_RATIO, None);
                for _ in 0..MAX_ATTEMPTS {
                    let unrefined = quantizer.archive(QualityTarget::Loss(loss_from_error(error)))?;
                    let Some(refined) = self.refined(quantizer, unrefined.steps)? else { break };
                    let growth = allowed / error_from_loss(refined.loss).max(f64::MIN_POSITIVE);
                    let (is_met, was_met) = (refined.loss <= most, best.is_some());
                    if is_met {
                        best = Some(refined);
                    }
                    error *= match is_met {
                        true if growth >= MIN_GROWTH => growth.min(MAX_GROWTH).powf(GROWTH_EXPONENT),
                        false if !was_met => growth.clamp(FINER[0], FINER[1]),
                        _ => break,
                    };
                }
                Ok(best)
            }
            QualityTarget::Bytes(most) => {
                for part in BYTES_PARTS {
                    let Some((steps, encoded)) = quantizer.finest_within((part * most as f64) as u64)? else { break };
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

    /// Returns the archive with the quantization steps `steps` of parameters that are refined for them. Returns `None`
    /// if the reader of the model format refuses quantized values.
    fn refined(&self, quantizer: &Quantizer<'_>, steps: QuantizationSteps) -> Result<Option<MeasuredArchive>> {
        let scene = self.scene;
        let total: usize = self.parts.iter().map(|part| part.steps).sum();
        let progress = scene.events.task("archive", "steps", total as u64);
        let refine = || {
            let mut compressed = self.compressed.clone();
            let mut content = scene.input.archive_content(&compressed)?;
            for part in &self.parts {
                let delta = self.refined_delta(part, &content, &steps, &progress)?;
                compressed.delta = std::mem::take(&mut compressed.delta).plus(delta);
                content = scene.input.archive_content(&compressed)?;
            }
            quantizer.measure((steps.clone(), archive::encode(&content, &steps)?))
        };
        match refine() {
            Err(error) if error.kind() == ErrorKind::Input => Ok(None),
            refined => refined.map(Some),
        }
    }

    /// Refines the parameters in `content` by the optimization steps of `part`, for the quantization steps `steps`.
    /// Returns what refinement adds to them.
    fn refined_delta(
        &self,
        part: &RefineStage,
        content: &ArchiveContent,
        steps: &QuantizationSteps,
        progress: &Progress,
    ) -> Result<ParamDelta> {
        let mut quantized = content.clone();
        let mut rounded = content.cloud.clone();
        archive::round_cloud(&mut rounded, &steps.cloud, &[0]);
        let space = archive::field_box(content);
        for (name, tensor_steps) in &steps.field.0 {
            let (tensor, role) = (&content.tensors[name], content.field[name]);
            let tensor = archive::round_tensor(tensor, role, tensor_steps, &rounded.position, space);
            quantized.tensors.insert(name.clone(), tensor);
        }
        for (column, step) in quantized.columns.iter_mut().zip(&steps.columns) {
            archive::round_column(column, *step);
        }
        if !part.columns.contains(Attributes::POSITION) {
            quantized.cloud.position = rounded.position;
        }
        let source = self.scene.input.decode_frames(&quantized)?;
        let start = (quantized.cloud, steps.cloud);
        part.refine_quantized(self.scene, &self.targets, &*source, start, self.fixed.to_vec(), progress)
    }
}
