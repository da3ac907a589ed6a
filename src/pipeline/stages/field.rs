//! Stage `field`: stores the deformation field of the result in half precision (16-bit floats) if the error that this
//! adds to renders is small against the error that the result has already ([`FieldPrecisionStage::margin`]).
//!
//! Memory: two states (all Gaussians at one frame), and two rendered views.

use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::journal::Journal;
use crate::journal::records::FieldPrecisionSummary;
use crate::limits::Limits;
use crate::memory_plan::{RENDER_COST, ResourceEstimate, SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload, bytes_of_survivors};
use crate::metrics::psnr;
use crate::model::{Attributes, FrameView};
use crate::outputs::kind::OutputKind;
use crate::passes::{BatchLimits, RenderedSource, VIEWS_PER_FRAME, for_each_view_batch, select_evenly};
use crate::pipeline::planning::Planning;
use crate::pipeline::request::Request;
use crate::pipeline::stage::{EstimateInput, Phase, RunState, Stage, StageList};
use crate::pruning::score::scored_memory;
use crate::recipe::FieldPrecision;
use crate::refinement::MAX_USEFUL_PSNR;
use crate::render::{self, render};
use crate::scene::Scene;
use crate::source::FrameSource;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "field";
/// Number of views on which renders before and after an optional reduction of the model (half-precision deformation
/// field, fewer SH degrees) are compared. They are chosen among the views used for scoring.
pub(crate) const COMPARED_VIEWS: usize = 12;

/// Stage that chooses the precision in which the deformation field of a result is written.
#[derive(Debug, Clone)]
pub(crate) struct FieldPrecisionStage {
    /// Half precision is used if one PSNR exceeds another by at least this margin, dB. The first is the PSNR of renders
    /// with the half-precision field against renders with the exact field; the second is that of the result against the
    /// original. The first suffices alone if it is at least 60 dB.
    pub margin: f64,
}

/// Adds the stage that chooses the precision of the deformation field to `stages` if the deformation field may be
/// written in half precision.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    if let Some(stage) = FieldPrecisionStage::from_request(planning.request, planning.output) {
        stages.add(Phase::Reduce, stage);
    }
}

impl Stage for FieldPrecisionStage {
    fn estimates(
        &self,
        EstimateInput { work, limits, output_fraction, .. }: EstimateInput<'_>,
    ) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits, output_fraction)]
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scene, result) = (run.scene, run.take_result());
        let (count, key) = (result.len(), scene.work.key(&(self.margin, &result)));
        run.result = run
            .journal
            .run_cached_stage(NAME, count, scene, key, |journal| Ok((self.round(scene, result, journal)?, count)))?;
        Ok(())
    }
}

/// Returns the views, at most [`COMPARED_VIEWS`], by which two models are compared: several views of each frame, or one
/// if opacities vary, because most Gaussians may then be invisible at few frames.
pub(crate) fn compared_views(scene: &Scene) -> Vec<FrameView> {
    let opacity_varies = scene.source().info().varying.contains(Attributes::OPACITY);
    select_evenly(&scene.schedule, COMPARED_VIEWS, if opacity_varies { 1 } else { VIEWS_PER_FRAME })
}

impl FieldPrecisionStage {
    /// Returns the stage that chooses the precision of the deformation field. Returns `None` unless the output `kind`
    /// is a model folder and the recipe of `request` allows half precision.
    pub(crate) fn from_request(request: &Request, kind: OutputKind) -> Option<FieldPrecisionStage> {
        let field = &request.recipe.field;
        (kind == OutputKind::Model && field.field == FieldPrecision::Half)
            .then_some(FieldPrecisionStage { margin: field.field_margin })
    }

    /// Returns the resource estimate of the stage. Its memory holds two states (all Gaussians at one frame), rendered
    /// views, and a second copy of the deformation field. `output_fraction`: number of Gaussians in the result divided
    /// by that in the input.
    pub(crate) fn resource_estimate(&self, work: &Workload, limits: &Limits, output_fraction: f64) -> ResourceEstimate {
        let whole = work.state_bytes(Attributes::all());
        let per_gaussian = vec![
            ("survivors", bytes_of_survivors(output_fraction, 24)),
            ("states", whole + bytes_of_survivors(output_fraction, whole)),
            ("result", bytes_of_survivors(output_fraction, 2 * work.input.compressed)),
            ("readers", work.input.reader + bytes_of_survivors(output_fraction, work.input.reader)),
            ("views", SHARED_VIEW_BYTES_PER_GAUSSIAN),
        ];
        let views = (COMPARED_VIEWS as u64).min(work.frame_views);
        ResourceEstimate {
            stage: NAME,
            seconds: work.reading_seconds(work.gaussian_count(), 4.0 * views as f64)
                + work.render_seconds(2.0 * views as f64, work.gaussian_count(), RENDER_COST)
                + work.render_seconds(2.0 * views as f64, output_fraction * work.gaussian_count(), RENDER_COST),
            reads: work.whole_input_reads(views, limits),
            per_gaussian: [scored_memory(limits), per_gaussian].concat(),
            fixed: vec![
                work.block_buffer_memory(),
                ("field", work.input.fixed),
                ("views", render::STRIP_BYTES as u64 + 24 * work.pixels),
            ],
        }
    }

    /// Returns `compressed` with its deformation field in half precision, if the input supports it and the margin
    /// ([`FieldPrecisionStage::margin`]) allows it; otherwise returns `compressed` unchanged. Adds the measured PSNRs,
    /// and the reason if the field stays exact, to `journal`, the log of the run.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    fn round(&self, scene: &Scene, compressed: CompressedModel, journal: &mut Journal) -> Result<CompressedModel> {
        if !scene.input.can_round_field()? {
            return Ok(compressed);
        }
        let what = "half precision of the field";
        let views = compared_views(scene);
        if compressed.is_empty() || views.is_empty() {
            journal.leave_out(what, "there are no Gaussians or no views to compare");
            return Ok(compressed);
        }
        let halved = CompressedModel { field: FieldPrecision::Half, ..compressed.clone() };
        let [exact, half] = [&compressed, &halved].map(|model| scene.input.compressed_frames(model));
        let (exact, half) = (exact?, half?);
        let rounding = closeness(scene, [&*exact, &*half], &views)?;
        let result = match rounding >= MAX_USEFUL_PSNR {
            true => None,
            false => Some(closeness(scene, [scene.source(), &*exact], &views)?),
        };
        drop((exact, half));
        let least = result.map_or(MAX_USEFUL_PSNR, |result| min_psnr(result, self.margin));
        let found = FieldPrecisionSummary { views: views.len(), rounding, result, least, half: rounding >= least };
        let fits = found.half;
        if !fits {
            journal.leave_out(what, found.why());
        }
        journal.field = Some(found);
        Ok(if fits { halved } else { compressed })
    }
}

/// Returns the minimum PSNR, dB, that renders after an optional reduction (half precision, fewer SH degrees) must have
/// against renders of the same model before it: `result` + `margin`, but at most [`MAX_USEFUL_PSNR`]. `result`: PSNR of
/// the model before the reduction against the original, dB.
pub(crate) fn min_psnr(result: f64, margin: f64) -> f64 {
    MAX_USEFUL_PSNR.min(result + margin)
}

/// Returns the mean PSNR, dB, between renders of the two models `a` and `b` over `views`.
fn closeness(scene: &Scene, [a, b]: [&dyn FrameSource; 2], views: &[FrameView]) -> Result<f64> {
    let progress = scene.events.task(NAME, "views", views.len() as u64);
    let mut sum = 0.0;
    let subjects = [RenderedSource::all_gaussians(a), RenderedSource::all_gaussians(b)];
    for_each_view_batch(subjects, &scene.schedule.cameras, views, BatchLimits::one_frame(&scene.limits), |batch| {
        for view in batch {
            let [a, b] = view.states.map(|state| render(state, view.camera, scene.background));
            sum += psnr(&a, &b);
        }
        progress.advance(batch.len() as u64);
        Ok(())
    })?;
    Ok(sum / views.len() as f64)
}
