//! Stage `bands`: drops SH degrees of the result, from the highest down, as long as the error that this adds to renders
//! is small against the error that the result has already ([`ShDegreeStage::margin`]).
//!
//! Memory: one state of the original, two of the result (a state holds all Gaussians at one frame), and three rendered
//! views.

use super::field::{COMPARED_VIEWS, compared_views, min_psnr};
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::journal::Journal;
use crate::journal::records::ShDegreeSummary;
use crate::limits::Limits;
use crate::memory_plan::{RENDER_COST, ResourceEstimate, SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload, bytes_of_survivors};
use crate::metrics::psnr;
use crate::model::{Attributes, FrameView, Gaussians, NO_SH_LIMIT};
use crate::outputs::kind::OutputKind;
use crate::passes::{BatchLimits, RenderedSource, for_each_view_batch};
use crate::pipeline::planning::Planning;
use crate::pipeline::request::Request;
use crate::pipeline::stage::{EstimateInput, Phase, RunState, Stage, StageList};
use crate::pruning::score::scored_memory;
use crate::recipe::ShDegreeRule;
use crate::render::{self, render};
use crate::scene::Scene;
use crate::source::FrameSource;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "bands";

/// Name of the work "lowering the SH degree" in the journal (record of the run for the user). If the result keeps its
/// full SH degree, the list of omitted work contains this name.
const DROPPED_DEGREES: &str = "lower SH degree";

/// Returns the highest SH degree that a result of `scene` may have: the lowest of the degree of the input, the degree that
/// `rule` allows, and the degree that an output of kind `output` stores. If the format of the input needs all degrees, it
/// is the degree of the input. Adds a note to `journal`, the record of the run, if degrees are dropped, or the reason why
/// they are not.
pub(crate) fn highest(scene: &Scene, rule: ShDegreeRule, output: Option<OutputKind>, journal: &mut Journal) -> usize {
    let all = scene.source().info().sh_degree;
    let requested = match rule {
        ShDegreeRule::UpTo(degree) => degree,
        ShDegreeRule::All | ShDegreeRule::Needed => NO_SH_LIMIT,
    };
    let stored = output.map_or(NO_SH_LIMIT, OutputKind::max_sh_degree);
    let degree = requested.min(stored);
    if degree >= all {
        return all;
    }
    if let Some(why) = scene.input.description().reason_to_keep_sh_degree {
        if requested < all {
            journal.leave_out(DROPPED_DEGREES, why);
        }
        if stored < requested {
            let what = "the format of the output has no SH coefficients above degree";
            journal.notes.push(format!("{what} {stored}; colors were not refined for this: {why}"));
        }
        return all;
    }
    let reason = if stored < requested { "because the format of the output stores none" } else { "as requested" };
    journal.notes.push(format!("SH coefficients above degree {degree} of {all} are dropped, {reason}"));
    degree
}

/// Stage that lowers the SH degree of a result if renders hardly change.
#[derive(Debug, Clone)]
pub(crate) struct ShDegreeStage {
    /// A degree is dropped if one PSNR exceeds another by at least this margin, dB. The first is the PSNR of renders
    /// with the lower degree against renders with all degrees; the second is that of the result against the original.
    /// The first suffices alone if it is at least 60 dB.
    pub margin: f64,
}

/// Adds the stage that drops SH degrees to `stages` if the recipe asks for the lowest SH degree with which renders
/// hardly change, and if the output is not an archive.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    if let Some(stage) = ShDegreeStage::from_request(planning.request, planning.output) {
        stages.add(Phase::Reduce, stage);
    }
}

impl Stage for ShDegreeStage {
    fn estimates(
        &self,
        EstimateInput { work, limits, output_fraction, .. }: EstimateInput<'_>,
    ) -> Vec<ResourceEstimate> {
        // At SH degree 0 there is nothing to drop.
        (work.sh_degree > 0).then(|| self.resource_estimate(work, limits, output_fraction)).into_iter().collect()
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let scene = run.scene;
        // An SH degree that the user, the kind of output or a byte limit determined stays.
        if run.template.sh_degree < scene.source().info().sh_degree {
            return Ok(());
        }
        let result = run.take_result();
        let (count, key) = (result.len(), scene.work.key(&(self.margin, &result)));
        run.result = run.journal.run_cached_stage(NAME, count, scene, key, |journal| {
            Ok((self.lower_degree(scene, result, journal)?, count))
        })?;
        Ok(())
    }
}

impl ShDegreeStage {
    /// Returns the stage that drops SH degrees. Returns `None` unless the recipe asks for the lowest SH degree with
    /// which renders hardly change. Also returns `None` for an archive, because quantization already removes
    /// coefficients that do not change renders.
    pub(crate) fn from_request(request: &Request, kind: OutputKind) -> Option<ShDegreeStage> {
        let bands = &request.recipe.bands;
        let drops = kind != OutputKind::Archive && bands.bands == ShDegreeRule::Needed;
        drops.then_some(ShDegreeStage { margin: bands.bands_margin })
    }

    /// Returns the resource estimate of the stage. Its memory holds three states (all Gaussians at one frame) and
    /// renders of them. `output_fraction`: number of Gaussians in the result divided by that in the input.
    pub(crate) fn resource_estimate(&self, work: &Workload, limits: &Limits, output_fraction: f64) -> ResourceEstimate {
        let (whole, reader, held) =
            (work.state_bytes(Attributes::all()), work.input.reader, work.kept_frames_bytes(limits, Attributes::all()));
        let per_gaussian = vec![
            ("survivors", bytes_of_survivors(output_fraction, 24)),
            ("states", whole + bytes_of_survivors(output_fraction, 2 * whole)),
            ("result", bytes_of_survivors(output_fraction, work.input.compressed)),
            ("readers", reader + bytes_of_survivors(output_fraction, reader)),
            ("kept frames", held + bytes_of_survivors(output_fraction, held)),
            ("views", SHARED_VIEW_BYTES_PER_GAUSSIAN),
        ];
        let views = if work.sh_degree > 0 { (COMPARED_VIEWS as u64).min(work.frame_views) } else { 0 };
        ResourceEstimate {
            stage: NAME,
            seconds: work.reading_seconds(work.gaussian_count(), 2.0 * views as f64)
                + work.render_seconds(views as f64, work.gaussian_count(), RENDER_COST)
                + work.render_seconds(2.0 * views as f64, output_fraction * work.gaussian_count(), RENDER_COST),
            reads: 2.0 * work.scattered_whole_input_reads(views, limits),
            per_gaussian: [scored_memory(limits), per_gaussian].concat(),
            fixed: vec![work.block_buffer_memory(), ("views", render::STRIP_BYTES as u64 + 36 * work.pixels)],
        }
    }

    /// Returns `compressed` with the lowest SH degree that the margin allows ([`ShDegreeStage::margin`]). Adds the
    /// measured PSNRs, and the reason if no degree is dropped, to `journal`, the log of the run.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    fn lower_degree(
        &self,
        scene: &Scene,
        compressed: CompressedModel,
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let all = scene.source().info().sh_degree;
        let views = compared_views(scene);
        let stay = match scene.input.description().reason_to_keep_sh_degree {
            _ if all == 0 => Some("colors have SH degree 0"),
            None if compressed.is_empty() || views.is_empty() => Some("there are no Gaussians or no views to compare"),
            why => why,
        };
        if let Some(why) = stay {
            journal.leave_out(DROPPED_DEGREES, why);
            return Ok(compressed);
        }
        let source = scene.input.compressed_frames(&compressed)?;
        let (mut found, mut tried, mut sh_degree) = ([0.0; 2], Vec::new(), all);
        // A lower degree is tried only if the last one was accepted.
        while sh_degree > 0 && tried.len() == all - sh_degree {
            let [result, apart] = quality_without_degrees(scene, &*source, sh_degree - 1, &views)?;
            found = [result, min_psnr(result, self.margin)];
            tried.push((sh_degree - 1, apart));
            sh_degree -= usize::from(apart >= found[1]);
        }
        drop(source);
        let [result, least] = found;
        let found = ShDegreeSummary { sh_degree, views: views.len(), tried, result, least };
        if sh_degree == all {
            journal.leave_out(DROPPED_DEGREES, found.why());
        }
        journal.bands = Some(found);
        Ok(CompressedModel { sh_degree, ..compressed })
    }
}

/// Returns two mean PSNRs over `views`, dB. First: renders of `result` against renders of the original. Second: renders
/// of `result` with SH coefficients up to `degree` only, against renders of `result` with all of them.
fn quality_without_degrees(
    scene: &Scene,
    result: &dyn FrameSource,
    degree: usize,
    views: &[FrameView],
) -> Result<[f64; 2]> {
    let progress = scene.events.task(NAME, "views", views.len() as u64);
    let mut sums = [0.0; 2];
    let subjects = [RenderedSource::all_gaussians(scene.source()), RenderedSource::all_gaussians(result)];
    for_each_view_batch(subjects, &scene.schedule.cameras, views, BatchLimits::one_frame(&scene.limits), |batch| {
        for view in batch {
            let image = |state: &Gaussians| render(state, view.camera, scene.background);
            let [original, whole] = view.states.map(image);
            let mut state = view.states[1].clone();
            state.truncate_sh(degree);
            sums[0] += psnr(&original, &whole);
            sums[1] += psnr(&image(&state), &whole);
        }
        progress.advance(batch.len() as u64);
        Ok(())
    })?;
    Ok(sums.map(|sum| sum / views.len() as f64))
}
