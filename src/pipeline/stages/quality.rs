//! Stage `quality`: measures PSNR and SSIM of the result against the original, on views that were used neither to fit
//! nor to choose anything. It also measures the time of rendering a view of the original and of the result.
//!
//! If the cameras have a test split, test views are measured: at most [`MOST_VIEWS`], spread over frames and views, and
//! fewer in a short run ([`MAX_TIME_FRACTION`]). Without a test split, the PSNR on the validation views of refinement
//! is reported. It is labeled as such, because these views were used to choose the best state of refinement. Without
//! test and validation views, training views are measured.
//!
//! The stage runs before the result is written. Only if the output stores rounded values or fitted motion
//! ([`Fidelity::Approximate`]), the stage that writes the output calls it with the written file. It then uses training
//! views instead of validation views, whose PSNR belongs to the result before it was written.
//!
//! Memory: one state (all Gaussians at one frame) of each model, two views per thread, and the scores.

use std::fs;
use std::path::Path;
use std::time::Instant;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::files::atomic::ScratchFolder;
use crate::journal::Journal;
use crate::journal::records::{QualitySummary, RenderTime, ViewKind};
use crate::limits::Limits;
use crate::memory_plan::{RENDER_COST, ResourceEstimate, Workload, bytes_of_survivors};
use crate::metrics::{METRIC_BYTES_PER_PIXEL, psnr, ssim};
use crate::model::{Attributes, FrameView};
use crate::models::InputModel;
use crate::outputs::kind::{Fidelity, OutputKind};
use crate::passes::{BatchLimits, RenderableView, RenderedSource, for_each_view_batch};
use crate::pipeline::planning::Planning;
use crate::pipeline::stage::{EstimateInput, MeasuredOnArrival, Phase, PreparedArchive, RunState, Stage, StageList};
use crate::pruning::score::scored_memory;
use crate::scene::view_selection::{self, ViewSet, blind_views_note, spread_views};
use crate::scene::{InputOptions, Scene, open_compressed};
use crate::source::FrameSource;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "quality";
/// Maximum number of views on which quality is measured.
const MOST_VIEWS: usize = 60;
/// Minimum number of views on which quality is measured, however short the run is.
const FEWEST_VIEWS: usize = 4;
/// Fraction of the run's estimated processor time that measuring quality may take. The goal is 3% of the measured time.
/// The fraction is lower because the estimates of other stages were up to 1.6 times too high.
const MAX_TIME_FRACTION: f64 = 0.014;
/// Assumed maximum number of times that the stage reads the frames of the measured views: for the original, for the
/// result (whose frames are computed from the same input), and for the timed views. Used to estimate its reads.
const READS: f64 = 2.5;
/// Assumed maximum number of times that the stage reads the frames of the measured views if the result has proxies
/// (Gaussians that replace merged clusters). It is higher than [`READS`], the number without proxies, because the
/// members of a cluster lie in several blocks of the input.
const MERGED_READS: f64 = 6.0;
/// This optional stage runs only if memory is plentiful: at least this number of bytes must remain free within the
/// memory limit, beyond the estimate.
const MARGIN: u64 = 8 << 20;
/// Assumed memory that a written output takes once it is open, divided by the memory of one state of the result. Fitted
/// motion has up to about twelve pieces for each Gaussian, and an open file holds each piece twice.
const WRITTEN_COPIES: u64 = 24;
/// Number of views whose rendering is timed, on one thread.
const TIMED_VIEWS: usize = 3;

/// Stage that measures the quality of the result.
#[derive(Debug, Clone)]
pub(crate) struct QualityStage {
    input: InputOptions,
    /// Kind of the output.
    kind: OutputKind,
    /// Whether the result may have proxies (Gaussians that replace merged clusters), each of which is computed from
    /// several Gaussians of the input.
    merges: bool,
}

/// Adds the stage that measures the quality of the result before it is written to `stages`, if the plan has memory for
/// it and the quality is not measured on the written file. If memory does not suffice, records this in `stages`.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    match planning.measures_quality {
        true if planning.output.fidelity() != Fidelity::Approximate => {
            stages.add(Phase::Write, QualityStage::from_planning(planning));
        }
        true => (),
        false => leave_out(stages),
    }
}

/// Adds the stage that measures the quality of the written output to `stages`, if the plan has memory for it and the
/// output stores the result only approximately. The stage that writes the output calls it.
pub(super) fn plan_for_output(planning: &Planning<'_>, stages: &mut StageList) {
    if planning.measures_quality && planning.output.fidelity() == Fidelity::Approximate {
        stages.add(Phase::Write, QualityStage::from_planning(planning));
    }
}

/// Records in `stages` that the quality is not measured because memory does not suffice.
pub(in crate::pipeline) fn leave_out(stages: &mut StageList) {
    stages.leave_out("quality on test views", "memory: it does not fit within the limit (--memory)");
}

impl Stage for QualityStage {
    fn estimates(
        &self,
        EstimateInput { work, limits, output_fraction, .. }: EstimateInput<'_>,
    ) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits, output_fraction)]
    }

    fn is_optional(&self) -> bool {
        true
    }

    /// Measures the written file if it can be read back; otherwise, as for an output that this program does not read, the
    /// result before its conversion. Returns `None` for an output that stores the result exactly.
    fn measure_output(&self, run: &RunState<'_>, path: &Path, journal: &mut Journal) -> Result<Option<QualitySummary>> {
        let (scene, count) = (run.scene, run.result.len());
        if count == 0 || !self.is_measured_once_written() {
            return Ok(None);
        }
        journal.run_stage(NAME, count, scene.source(), |journal| {
            let output = self.open_output(scene, path).unwrap_or_else(|error| {
                journal.notes.push(format!("the written file could not be read back: {error}"));
                None
            });
            let written = output.as_ref().map(|(_, output)| output.source());
            Ok((self.measure(run, written, journal)?, count))
        })
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        run.scene.work.end_shard_run_before("measuring quality")?;
        if run.result.is_empty() || self.is_measured_once_written() {
            return Ok(());
        }
        let (scene, count) = (run.scene, run.result.len());
        let mut journal = std::mem::take(&mut run.journal);
        let quality =
            journal.run_stage(NAME, count, scene.source(), |journal| Ok((self.measure(run, None, journal)?, count)))?;
        run.journal = journal;
        run.quality = quality;
        Ok(())
    }
}

impl QualityStage {
    fn from_planning(planning: &Planning<'_>) -> QualityStage {
        let Planning { request, output, merges, .. } = *planning;
        QualityStage { input: request.input.clone(), kind: output, merges }
    }

    /// Returns whether the quality is measured when the output is written, and not before.
    fn is_measured_once_written(&self) -> bool {
        self.kind.fidelity() == Fidelity::Approximate
    }

    /// Returns whether an output is never read back: a folder, because all of its frames would have to be decoded; and
    /// any output if there is a memory limit, because a file may hold many more Gaussians than the result.
    fn reads_no_output(&self) -> bool {
        self.kind.is_folder() || self.input.memory.bytes.is_some()
    }

    /// Opens the output that was written to `path`, as a copy in a scratch folder with the ending of its kind. Returns
    /// `None` for the outputs of [`QualityStage::reads_no_output`].
    ///
    /// # Errors
    /// Fails if the output cannot be copied or read.
    fn open_output(&self, scene: &Scene, path: &Path) -> Result<Option<(ScratchFolder, Box<dyn InputModel>)>> {
        let Some(ending) = self.kind.ending().filter(|_| !self.reads_no_output()) else { return Ok(None) };
        let folder = ScratchFolder::new(&scene.scratch)?;
        let copy = folder.path().join(format!("result.{ending}"));
        fs::copy(path, &copy).map_err(Error::io("copy", path))?;
        // The note names the copy, which the user does not know.
        let (output, _) = open_compressed(&copy, scene, &self.input)?;
        Ok(Some((folder, output)))
    }

    /// Returns the resource estimate of the stage, which renders views of the original and of the result.
    /// `output_fraction`: number of Gaussians in the result divided by that in the input.
    fn resource_estimate(&self, work: &Workload, limits: &Limits, output_fraction: f64) -> ResourceEstimate {
        let views = (MOST_VIEWS as u64).min(work.frame_views.max(1));
        let of_views = view_selection::render_estimate(work, limits, NAME, 2, 24 + METRIC_BYTES_PER_PIXEL as u64);
        let is_read_back = self.is_measured_once_written() && !self.reads_no_output();
        let written = if is_read_back { WRITTEN_COPIES * work.state_bytes(Attributes::all()) } else { 0 };
        let result = vec![
            ("written output", bytes_of_survivors(output_fraction, written)),
            ("survivors", bytes_of_survivors(output_fraction, 24)),
            ("result", bytes_of_survivors(output_fraction, 2 * work.input.compressed)),
        ];
        ResourceEstimate {
            // The number of views is derived from the estimated time of all other stages; see `view_count`.
            seconds: 0.0,
            reads: if self.merges { MERGED_READS } else { READS } * work.whole_input_reads(views, limits),
            per_gaussian: [scored_memory(limits), of_views.per_gaussian, result].concat(),
            fixed: [of_views.fixed, vec![("field", work.input.fixed), ("margin", MARGIN)]].concat(),
            ..of_views
        }
    }

    /// Measures the quality of the result of `run`, or of the output `written` that was made from it, on the first of
    /// these sets of views that exists:
    /// - test views;
    /// - unless there is an output, validation views of refinement, whose PSNR is taken from `journal`, the log of the
    ///   run;
    /// - training views, or views of cameras placed by the program.
    ///
    /// Returns `None` if the result is an archive of frames, whose frames exist only once it is written. Also returns
    /// `None`, with a warning, if the views show nothing of the scene.
    fn measure(
        &self,
        run: &RunState<'_>,
        written: Option<&dyn FrameSource>,
        journal: &mut Journal,
    ) -> Result<Option<QualitySummary>> {
        let scene = run.scene;
        let times = &scene.source().info().times;
        let kind = match scene.rig.held_out_split() {
            Some(_) => ViewKind::Test,
            // After a fit to photographs, the PSNR of validation views in the journal is that of the model before it.
            None if written.is_none() && journal.refined.is_some() && journal.photographs.is_none() => {
                ViewKind::Validation
            }
            None if scene.has_virtual_rig => ViewKind::Virtual,
            None => ViewKind::Training,
        };
        let all = view_selection::select_views(&scene.rig, times, ViewSet::HeldOut)?;
        let views = spread_views(all, self.view_count(run));
        let folder;
        let (opened, reduced);
        let result: &dyn FrameSource = match (written, &run.archived) {
            (Some(written), _) => written,
            (None, None) => {
                reduced = scene.input.compressed_frames(&run.result)?;
                &*reduced
            }
            (None, Some(PreparedArchive::Content(encoded))) => {
                folder = ScratchFolder::new(&scene.scratch)?;
                let path = folder.path().join("result.gsz");
                fs::write(&path, &encoded.bytes).map_err(Error::io("write", &path))?;
                (opened, _) = open_compressed(&path, scene, &self.input)?;
                opened.source()
            }
            // Frames with error bounds exist only once they are written.
            (None, Some(PreparedArchive::Frames(_))) => return Ok(None),
        };
        let render_ms = render_times(scene, result, &views)?;
        let is_converted = self.kind.fidelity() != Fidelity::Exact || scene.input.motion_note(self.kind).is_some();
        let before_conversion = written.is_none() && is_converted;
        if let (ViewKind::Validation, Some(refined)) = (kind, journal.refined) {
            let psnr = journal.result_psnr().unwrap_or(refined.result);
            let views = refined.views;
            return Ok(Some(QualitySummary { kind, views, psnr, ssim: None, before_conversion, render_ms }));
        }
        let (psnr, ssim) = mean_scores(scene, result, &views)?;
        if let Some(warning) = blind_views_note(scene, &views, scene.background, psnr)? {
            journal.warn(&scene.events, warning.to_owned());
            return Ok(None);
        }
        let views = views.len();
        Ok(Some(QualitySummary { kind, views, psnr, ssim: Some(ssim), before_conversion, render_ms }))
    }

    /// Returns the number of views on which quality is measured, from [`FEWEST_VIEWS`] to [`MOST_VIEWS`]. Within these
    /// limits it is the largest number for which measuring, timed renders included, takes at most the fraction
    /// [`MAX_TIME_FRACTION`] of the time of the run. Times are estimates for a reference machine, so that the number of
    /// views is the same on every machine.
    fn view_count(&self, run: &RunState<'_>) -> usize {
        let scene = run.scene;
        let work = scene.workload();
        let output_fraction = run.result.len() as f64 / work.gaussian_count().max(1.0);
        let input = EstimateInput {
            work: &work,
            limits: &Limits::NONE,
            output_fraction,
            measured: MeasuredOnArrival::default(),
        };
        let seconds: f64 = run.stages.all().flat_map(|stage| stage.estimates(input)).map(|need| need.seconds).sum();
        let renders = work.render_seconds(1.0, (1.0 + output_fraction) * work.gaussian_count(), RENDER_COST);
        let reads = work.reading_seconds(work.gaussian_count(), 2.0);
        let scored_view = renders + reads + 2.0 * SCORE_SECONDS_PER_PIXEL * work.pixels as f64;
        // A view whose rendering is timed is rendered twice.
        let timed_view = 2.0 * renders + reads;
        let left = MAX_TIME_FRACTION * seconds - TIMED_VIEWS as f64 * timed_view;
        ((left / scored_view.max(1e-9)) as usize).clamp(FEWEST_VIEWS, MOST_VIEWS)
    }
}

/// Approximate processor time of computing PSNR and SSIM, seconds per pixel of a view (`benches/filters.rs`).
const SCORE_SECONDS_PER_PIXEL: f64 = 6e-8;

/// Returns the mean PSNR, dB, and the mean SSIM of renders of `result` against renders of the original over `views`.
fn mean_scores(scene: &Scene, result: &dyn FrameSource, views: &[FrameView]) -> Result<(f64, f64)> {
    let progress = scene.events.task(NAME, "views", views.len() as u64);
    let mut scores: Vec<(f64, f64)> = Vec::with_capacity(views.len());
    let subjects = [scene.source(), result].map(RenderedSource::all_gaussians);
    for_each_view_batch(subjects, &scene.rig.cameras, views, BatchLimits::one_frame(&scene.limits), |batch| {
        let score = |view: &RenderableView<'_, 2>| {
            let [original, compressed] = [0, 1].map(|subject| view.render(subject, scene.background));
            progress.advance(1);
            (psnr(&compressed, &original), ssim(&compressed, &original))
        };
        scores.par_extend(batch.par_iter().map(score));
        Ok(())
    })?;
    let mean = |score: fn(&(f64, f64)) -> f64| scores.iter().map(score).sum::<f64>() / scores.len().max(1) as f64;
    Ok((mean(|score| score.0), mean(|score| score.1)))
}

/// Returns two median times, in milliseconds: of rendering a view of the original, and of rendering a view of the
/// result, on one thread. The evaluation of the deformation field is not included. Each view is rendered once before
/// its time is taken, to fill the processor's caches. Returns `None` if there are no views or a thread cannot be
/// started.
pub(crate) fn render_times(scene: &Scene, result: &dyn FrameSource, views: &[FrameView]) -> Result<Option<RenderTime>> {
    let Ok(pool) = rayon::ThreadPoolBuilder::new().num_threads(1).build() else { return Ok(None) };
    let views = spread_views(views.to_vec(), TIMED_VIEWS);
    let mut times = [Vec::new(), Vec::new()];
    let subjects = [scene.source(), result].map(RenderedSource::all_gaussians);
    for_each_view_batch(subjects, &scene.rig.cameras, &views, BatchLimits::one_frame(&scene.limits), |batch| {
        for view in batch {
            for (subject, times) in times.iter_mut().enumerate() {
                times.push(pool.install(|| {
                    std::hint::black_box(view.render(subject, scene.background));
                    let start = Instant::now();
                    std::hint::black_box(view.render(subject, scene.background));
                    1e3 * start.elapsed().as_secs_f64()
                }));
            }
        }
        Ok(())
    })?;
    let [before, after] = times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times.get(times.len() / 2).copied()
    });
    Ok(before.zip(after).map(|(before, after)| RenderTime { before, after }))
}
