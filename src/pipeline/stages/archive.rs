//! Stage `archive`: chooses the quantization steps of the values in an archive (compact file of the result).
//!
//! Errors of quantization add up. If one group of values (an attribute or a tensor) is quantized alone, two things
//! hold: the squared error of renders is proportional to the square of its quantization step, and each octave
//! (doubling) of the step saves about one bit per value. For a given total error, the archive has the fewest bits if
//! the error of every group is proportional to the bits that one octave saves in this group (reverse water-filling;
//! Cover & Thomas, "Elements of Information Theory", 10.3.3). So the stage measures the bits of every group and its
//! error on renders, and sets the steps by this rule. Then it makes all steps together as coarse as the quality of
//! renders of the archive allows.
//!
//! A refined result is refined again with these steps, so that it renders close to the original after quantization
//! (`archive_refinement`). An archive of the same quality then needs fewer bytes.

use super::archive_grids::Grids;
use super::archive_refinement::{ArchiveRefinement, loss_before_refinement};
use super::bounds;
use super::quantizer::{MeasuredArchive, Quantizer};
use crate::archive::{self, EncodedArchive};
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::journal::Journal;
use crate::journal::as_toml::AsToml;
use crate::limits::Limits;
use crate::memory_plan::{RENDER_COST, ResourceEstimate, SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload, bytes_of_survivors};
use crate::model::Attributes;
use crate::outputs::kind::OutputKind;
use crate::pipeline::planning::Planning;
use crate::pipeline::request::Goal;
use crate::pipeline::stage::{EstimateInput, Phase, PreparedArchive, RunState, Stage, StageList};
use crate::pipeline::stages::reference_views::{
    ARCHIVE_HEADROOM, ArchiveTarget, BALANCING_ROUNDS, BYTES_OCTAVE_HALVINGS, BYTES_PER_PIXEL, ENOUGH_PSNR,
    OCTAVE_HALVINGS, QualityTarget, ReferenceViews, check_measurable, check_met, view_count,
};
use crate::pipeline::summary::{ArchiveSummary, UNREACHED};
use crate::refinement::RefineStage;
use crate::render;
use crate::scene::Scene;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "archive";
/// The size of an archive is estimated without rendering, with the initial quantization steps made coarser by this
/// number of octaves (doublings). The estimate decides how many Gaussians a result of at most `--size` bytes keeps;
/// with this value, quantization then costs 0.5 and 1.2 dB PSNR on two trained models.
const ESTIMATE_OCTAVES: f64 = 3.3;

/// Maximum amount, dB, by which an archive may miss the requested PSNR without a warning: rounding of measured PSNRs.
const MAX_MISSED_PSNR: f64 = 0.01;

/// Name, in notes about omitted work, of the refinement for the quantization of an archive.
const REFINEMENT: &str = "refinement of quantized values";
/// Usual number of attempts (`archive_refinement`) to find how coarse the quantization steps may be.
const ATTEMPTS_USUALLY_MADE: f64 = 1.5;

/// Stage that quantizes and encodes the result as an archive.
#[derive(Debug, Clone)]
pub struct ArchiveStage {
    /// Required PSNR, dB, of renders of the archive against renders of the result before quantization. `None`: derived
    /// from the goal of the run or from a default.
    pub psnr: Option<f64>,
    /// Refinement of the attributes for the quantization of the archive; `None` if they are only quantized.
    pub refine: Option<RefineStage>,
}

/// Adds the stage that makes an archive to `stages` if the output is an archive. The stage refines the result for the
/// quantization if four conditions hold: the run refines toward renders, no PSNR against the result before quantization
/// is requested, the archive stores a model, and there is memory for the refinement.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    if planning.output != OutputKind::Archive {
        return;
    }
    let psnr = planning.request.archive_psnr;
    let mut refine = planning.refine.as_ref().and_then(|refine| refine.for_archive(planning.searches()));
    if psnr.is_some() || planning.request.photographs.is_some() || planning.input.archives_as_frames {
        refine = None;
    } else if refine.is_some() && !planning.refines_archive {
        stages.leave_out(REFINEMENT, "memory: it does not fit within the limit (--memory)");
        refine = None;
    }
    stages.add(Phase::Write, ArchiveStage { psnr, refine });
}

impl Stage for ArchiveStage {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits)]
    }

    fn parameters(&self) -> String {
        self.refine.as_ref().map_or_else(String::new, |refine| format!("{NAME}: {} refinement steps", refine.steps))
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let asked = match (&run.goal, &run.request.goal) {
            (Some(goal), _) => ArchiveTarget::Loss(goal.searched - goal.asked),
            (None, Some(Goal::Bytes(most))) => ArchiveTarget::Bytes(*most),
            _ => ArchiveTarget::Nothing,
        };
        let fixed = match &run.scored {
            Some(scored) => run.result.kept.iter().map(|&id| scored.is_protected(id)).collect(),
            None => vec![false; run.result.len()],
        };
        let (archived, archive) = self.archive(run.scene, &run.result, asked, &fixed, &mut run.journal)?;
        if let Some(goal) = &mut run.goal {
            (goal.searched, goal.held) = (goal.searched - archive.loss, goal.held - archive.loss);
            let what =
                if archive.is_refined { "quantization and refinement for it cost" } else { "quantization costs" };
            let text = format!(
                "{what} {:.2} dB of the {ARCHIVE_HEADROOM} dB that the search reserved for it; at least {} dB PSNR \
                 requested, {:.2} dB on the views of the search, {:.2} dB on the other views",
                archive.loss, goal.asked, goal.searched, goal.held
            );
            if goal.is_met && goal.searched < goal.asked - MAX_MISSED_PSNR {
                goal.is_met = false;
                run.journal.warn(&run.scene.events, format!("{UNREACHED}: {text}"));
            } else {
                run.journal.notes.push(format!("archive: {text}"));
            }
        }
        (run.archived, run.archive) = (Some(archived), Some(archive));
        Ok(())
    }
}

impl ArchiveStage {
    /// Returns the resource estimate of the stage. Its memory holds the result, its renders, the archive and the
    /// decoded archive.
    pub fn resource_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let whole = work.state_bytes(Attributes::all());
        let count = view_count(work.pixels);
        // About forty groups of values are quantized alone in every balancing round, and all together in each halving.
        let renders = count as f64 * (2.0 * OCTAVE_HALVINGS as f64 + BALANCING_ROUNDS as f64 * 40.0);
        let quantization = ResourceEstimate {
            stage: NAME,
            reads: 1.0,
            seconds: work.render_seconds(renders, 0.3 * work.gaussian_count(), RENDER_COST),
            per_gaussian: vec![
                ("states", whole),
                ("readers", work.input.reader),
                ("kept frames", work.kept_frames_bytes(limits, Attributes::all())),
                ("views", SHARED_VIEW_BYTES_PER_GAUSSIAN),
                ("contents", 4 * whole),
            ],
            fixed: vec![
                ("views", BYTES_PER_PIXEL * (2 * count + work.threads) * work.pixels),
                ("strips", work.threads * render::STRIP_BYTES as u64),
                ("fields", 4 * work.input.fixed),
                // An archive of frames also encodes a few blocks of Gaussians.
                ("blocks", bounds::storing_memory(work).iter().map(|part| part.1).sum()),
            ],
        };
        match &self.refine {
            None => quantization,
            Some(refine) => {
                let refinement = refine.resource_estimate(work, limits);
                // Contents with rounded and with refined values, and values that are rounded for a step.
                let refined = bytes_of_survivors(refine.target.unwrap_or(1.0), 5 * whole);
                ResourceEstimate {
                    reads: quantization.reads + refinement.reads,
                    seconds: quantization.seconds + ATTEMPTS_USUALLY_MADE * refinement.seconds,
                    per_gaussian: [quantization.per_gaussian, refinement.per_gaussian, vec![("contents", refined)]]
                        .concat(),
                    fixed: [quantization.fixed, refinement.fixed].concat(),
                    ..quantization
                }
            }
        }
    }

    /// Makes an archive of `compressed` that meets the quality or size `archive_target`. Returns its content and its
    /// summary. `fixed`: for each Gaussian of `compressed`, whether it is protected, that is, not changed by refinement;
    /// not used without refinement.
    ///
    /// # Errors
    /// Fails if the input cannot be archived, if values or renders are not finite, if frames cannot be read, if the
    /// required PSNR is missed by far (`check_met`), or if even the coarsest archive of these Gaussians exceeds the
    /// byte limit.
    pub fn archive(
        &self,
        scene: &Scene,
        compressed: &CompressedModel,
        archive_target: ArchiveTarget,
        fixed: &[bool],
        journal: &mut Journal,
    ) -> Result<(PreparedArchive, ArchiveSummary)> {
        let refine = self.refine.as_ref().map(RefineStage::key);
        let key = scene.work.key(&(self.psnr, archive_target, compressed, refine, fixed));
        let (archived, AsToml(summary)) = journal.run_cached_stage(NAME, compressed.len(), scene, key, |_| {
            let (archived, summary) = match scene.input.description().archives_as_frames {
                true => {
                    let left = scene.input.compressed_frames(compressed)?;
                    let (bounds, summary) = bounds::find(scene, &*left, self.psnr, archive_target)?;
                    (PreparedArchive::Frames(bounds), summary)
                }
                false => {
                    let (encoded, summary) = self.make(scene, compressed, archive_target, fixed)?;
                    (PreparedArchive::Content(encoded), summary)
                }
            };
            Ok(((archived, AsToml(summary)), compressed.len()))
        })?;
        let quality_target = QualityTarget::new(self.psnr, archive_target, summary.level);
        journal.notes.extend(check_met(scene, compressed, (quality_target, self.psnr), &summary)?);
        if self.refine.is_some() && !summary.is_refined {
            let is_close = summary.level >= ENOUGH_PSNR && archive_target == ArchiveTarget::Nothing;
            let why = match is_close {
                true => format!("the result has {:.1} dB PSNR vs. the original", summary.level),
                false => "it would not have met the requested quality or size with fewer bytes or more PSNR".to_owned(),
            };
            journal.leave_out(REFINEMENT, why);
        }
        Ok((archived, summary))
    }

    fn make(
        &self,
        scene: &Scene,
        compressed: &CompressedModel,
        archive_target: ArchiveTarget,
        fixed: &[bool],
    ) -> Result<(EncodedArchive, ArchiveSummary)> {
        let mut content = scene.input.archive_content(compressed)?;
        let reference_views = ReferenceViews::new(scene, &*scene.input.decode_frames(&content)?)?;
        let original = ReferenceViews::new(scene, scene.source())?;
        let level = check_measurable(reference_views.psnr(scene.source())?)?;
        let target = QualityTarget::new(self.psnr, archive_target, level);
        let refinement = match (&self.refine, target) {
            // Refinement moves the result toward the original, away from the result before quantization.
            (None, _) | (_, QualityTarget::Close(_)) => None,
            (Some(refine), _) => {
                let has_test_views = matches!(archive_target, ArchiveTarget::Loss(_));
                ArchiveRefinement::new(scene, refine, (compressed, fixed), original.views(), has_test_views)?
            }
        };
        let required_psnr = match (target, &refinement) {
            (QualityTarget::Loss(most), Some(_)) => QualityTarget::Loss(loss_before_refinement(most)),
            _ => target,
        }
        .required_psnr(level);
        let mut grids = Grids::from_content(&content);
        let mut measured = Vec::new();
        let halvings = if matches!(target, QualityTarget::Bytes(_)) { BYTES_OCTAVE_HALVINGS } else { OCTAVE_HALVINGS };
        let steps = refinement.as_ref().map_or(0, ArchiveRefinement::optimization_steps);
        let total = BALANCING_ROUNDS * grids.groups.len() + halvings + steps;
        let progress = scene.events.task(NAME, "steps", total as u64);
        for _ in 0..BALANCING_ROUNDS {
            measured =
                grids.balance(scene, &reference_views, &mut content, 10f64.powf(-0.1 * required_psnr), &progress)?;
        }
        let quantizer = Quantizer { scene, content: &content, grids, reference_views, original, level, progress };
        let refined = refinement.map_or(Ok(None), |refinement| refinement.refined_archive(&quantizer, target))?;
        let is_refined = refined.is_some();
        let found = match refined {
            Some(refined) => refined,
            None => quantizer.archive(target)?,
        };
        let MeasuredArchive { encoded, psnr, loss, .. } = found;
        let (parts, bits) = (Some(encoded.parts), encoded.bits.clone());
        let asked = target.required_psnr(level);
        let summary = ArchiveSummary { asked, psnr, level, loss, is_refined, parts, bounds: None, bits, measured };
        Ok((encoded, summary))
    }
}

/// Returns the estimated size, in bytes, of an archive of `compressed`: the size with fixed quantization steps or error
/// bounds, for which nothing has to be rendered.
///
/// # Errors
/// Fails if the input cannot be archived or values are not finite.
pub fn estimated_bytes(scene: &Scene, compressed: &CompressedModel) -> Result<u64> {
    if scene.input.description().archives_as_frames {
        return bounds::bytes(scene, &*scene.input.compressed_frames(compressed)?);
    }
    let content = scene.input.archive_content(compressed)?;
    Ok(archive::encode(&content, &Grids::from_content(&content).steps(ESTIMATE_OCTAVES))?.bytes.len() as u64)
}
