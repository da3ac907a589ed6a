//! Search for the smallest model that has a requested quality: repeats the stages that reduce the model to a number of
//! Gaussians.
//!
//! Sizes (numbers of Gaussians) are tried one after the other; each model is refined as if its size had been requested.
//! The next size lies between the largest size that failed and the smallest that passed, and is computed from the
//! surpluses of quality at the tried sizes. The models after prune steps (removals of the lowest-ranked Gaussians) are
//! kept, so that the refinement of a smaller model continues from one of them. A quarter of the views is never used by
//! the search and gives the reported quality (method.md, section 6.3).

use super::planning::Planning;
use super::quality_meter::{QualityMeter, QualityReference};
use super::request::{Goal, Quality};
use super::stage::{EstimateInput, Phase, RunState};
use super::stages::bands::ShDegreeStage;
use super::stages::choose;
use super::stages::field::FieldPrecisionStage;
use super::stages::reference_views::ARCHIVE_HEADROOM;
use super::summary::{GoalSummary, UNREACHED};
use crate::cache::CacheKey;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result, ShowPath};
use crate::journal::Journal;
use crate::journal::as_toml::AsToml;
use crate::memory_plan::{RENDER_COST, ResourceEstimate, SHARED_VIEW_BYTES_PER_GAUSSIAN};
use crate::metrics::PSNR_CAP_DB;
use crate::model::{Attributes, FrameView};
use crate::outputs::kind::{Fidelity, OutputKind};
use crate::pruning::Ranking;
use crate::pruning::score::{Scored, scored_memory};
use crate::refinement::prune_steps::PrunedModels;
use crate::refinement::targets::{TargetViewParams, Targets, ViewSplit, ViewStrides};
use crate::refinement::{RefineRun, RefineStage};
use crate::render::{self, ALL_PIXELS};
use crate::scene::Scene;
use crate::scene::add_file_stamps;
use crate::scene::photographs::Photographs;
use crate::scene::view_selection::{ViewSet, select_views};
use crate::source::FrameSource;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "search";
/// Fraction of the Gaussians in the first model that is tried.
const FIRST_FRACTION: f64 = 0.2;
/// Usual number of sizes (numbers of Gaussians) that are tried; used for estimates of time.
const SIZES_USUALLY_TRIED: f64 = 4.0;
/// Maximum number of sizes (numbers of Gaussians) that are tried. If all of them fail, the model of all Gaussians in
/// the ranking is tried as well; the ranking leaves out Gaussians that are always dropped.
const MAX_SIZES: usize = 8;
/// The search ends when the smallest size (number of Gaussians) with the requested quality, divided by the largest size
/// without it, is at most this ratio.
const SAME_SIZE_RATIO: f64 = 1.04;
/// Approximate loss of quality when the number of Gaussians is halved, from which the search computes its next size.
/// First number, used if a minimum PSNR is requested: decrease of the PSNR against the original, dB. Second number,
/// used if a maximum loss is requested: factor by which the loss of PSNR against photographs grows.
const COST_OF_HALVING: (f64, f64) = (4.5, 3.0);
/// The search ends if the surplus of quality (quality above the requested one) is at most this value. Unit: halvings of
/// the number of Gaussians; with a surplus of 1, about half as many Gaussians would suffice.
const MAX_SURPLUS: f64 = 0.03;
/// Smallest loss of PSNR that the search distinguishes from none, dB.
const MIN_LOSS: f64 = 1e-3;
/// Number n: one of every n views with photographs is held back from the search, to measure the quality that is
/// reported.
const HELD_EVERY: usize = 4;

/// Search of a run for the smallest model with a requested quality. Repeats the stages that reduce the model to a
/// number of Gaussians ([`Phase::Reduce`]).
#[derive(Debug, Clone)]
pub struct SearchStage {
    /// Quality that the user requested.
    quality: Quality,
    /// Quality that the search must reach. For an archive it is higher than requested, because quantization costs
    /// quality.
    searched: Quality,
    /// Whether the output stores the result only approximately, which the search does not take into account.
    before_conversion: bool,
    /// Number and kinds of target views (renders of the original model). Refinement fits models to some of them; the
    /// quality of the models is measured on others.
    target_views: TargetViewParams,
    /// Refinement stage, which is run at every size; `None` if nothing is refined.
    refine: Option<RefineStage>,
    /// Whether every tried model is also fitted to photographs, those in the folder of [`Quality::Loss`].
    fits_photographs: bool,
    /// Margins of PSNR, dB, of two optional reductions of the model. First: storing the deformation field in half
    /// precision ([`FieldPrecisionStage::margin`]); `None` if the field stays exact. Second: dropping SH degrees
    /// ([`ShDegreeStage::margin`]); `None` if all degrees stay.
    margins: [Option<f64>; 2],
}

/// Model of one size (number of Gaussians) that was tried, with its quality.
struct TriedSize {
    result: CompressedModel,
    /// Quality of the model on the views that the search uses, dB: PSNR against the original, or loss of PSNR against
    /// photographs if a maximum loss is requested.
    value: f64,
    journal: Journal,
}

impl SearchStage {
    /// Returns the search for the smallest model with the requested quality; `None` if no quality is requested.
    pub fn from_planning(planning: &Planning<'_>) -> Option<SearchStage> {
        let Planning { request, output, .. } = *planning;
        let Some(Goal::Quality(quality)) = &request.goal else { return None };
        let searched = match quality {
            Quality::Psnr(least) if output == OutputKind::Archive => {
                Quality::Psnr((least + ARCHIVE_HEADROOM).min(PSNR_CAP_DB))
            }
            other => other.clone(),
        };
        let field = FieldPrecisionStage::from_request(request, output).map(|stage| stage.margin);
        let bands = ShDegreeStage::from_request(request, output).map(|stage| stage.margin);
        Some(SearchStage {
            quality: quality.clone(),
            searched,
            before_conversion: output.fidelity() != Fidelity::Exact,
            target_views: TargetViewParams::from_recipe(&request.recipe.refine),
            refine: planning.refine.clone(),
            fits_photographs: request.photographs.is_some(),
            margins: [field, bands],
        })
    }

    /// Returns the parameters of the search as text for display.
    pub(super) fn parameters(&self) -> String {
        format!("search: {} sizes at most, for {} {}", MAX_SIZES, self.name(), self.searched.limit())
    }

    /// Returns the resource estimate (memory, time, reads) of the search. `repeated` holds the estimates of the stages
    /// that run for every size. The memory is that of the repeated stage with the largest memory, plus that of the
    /// models which the search keeps. Time and reads are the sums over all repeated stages, times the usual number of
    /// sizes.
    pub fn estimate(&self, input: EstimateInput<'_>, repeated: &[ResourceEstimate]) -> ResourceEstimate {
        let EstimateInput { work, limits, .. } = input;
        let whole = work.state_bytes(Attributes::all());
        let (reader, held) = (work.input.reader, work.kept_frames_bytes(limits, Attributes::all()));
        let frames = work.frames.min(128);
        let target_views: usize = self.target_views.view_counts(work).iter().sum();
        let measured = ResourceEstimate {
            stage: NAME,
            reads: work.scattered_whole_input_reads(frames, limits),
            seconds: work.reading_seconds(work.gaussian_count(), frames as f64)
                + work.render_seconds(target_views as f64, work.gaussian_count(), RENDER_COST),
            per_gaussian: [
                scored_memory(limits),
                vec![
                    ("states", whole),
                    ("readers", reader),
                    ("kept frames", held),
                    ("views", SHARED_VIEW_BYTES_PER_GAUSSIAN),
                ],
            ]
            .concat(),
            fixed: vec![work.block_buffer_memory()],
        };
        let (seconds, reads) = repeated.iter().fold((0.0, 0.0), |(s, r), stage| (s + stage.seconds, r + stage.reads));
        let largest = repeated.iter().chain([&measured]).max_by_key(|stage| stage.bytes(work));
        let mut need = largest.unwrap_or(&measured).clone();
        need.stage = NAME;
        need.seconds = SIZES_USUALLY_TRIED * seconds.max(measured.seconds);
        need.reads = SIZES_USUALLY_TRIED * reads.max(measured.reads);
        // A rendered view, and the image that it is compared with: once as read, once as used.
        need.fixed.push(("compared images", work.threads * (render::STRIP_BYTES as u64 + 28 * work.pixels)));
        need.fixed.push(("field", work.input.fixed));
        // Each prune step removes a fifth of the Gaussians. So the models that are kept after prune steps have together
        // less than four times as many Gaussians as the model from which they are made.
        need.per_gaussian.extend([
            ("search models", 4 * (whole + 8)),
            ("result", work.input.compressed),
            ("survivors", choose::BYTES_PER_GAUSSIAN),
        ]);
        need
    }

    /// Finds the smallest model with the requested quality. Stores the model and the summary of the search in `run`. If
    /// no tried size reaches the quality, stores the model of all Gaussians in the ranking.
    ///
    /// # Errors
    /// Fails if frames or photographs cannot be read, or if there are too few views for a search.
    pub fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scene, scored, ranking) = (run.scene, run.scored()?, run.ranking()?);
        let key = self.key(scene, &scored, &ranking, &run.template)?;
        let (request, stages, template) = (run.request, run.stages, &run.template);
        let found = run.journal.run_cached_stage(NAME, ranking.order().len(), scene, key, |journal| {
            let photographs = self.photographs(scene)?;
            let (work, count) = (scene.workload(), scored.gaussian_count());
            let training = self.refine.as_ref().map_or(ALL_PIXELS, |refine| refine.strides(&work, count));
            let strides = ViewStrides::with_whole_validation(training);
            let target_views = self.target_views.with_frames(scored.frames_needed_to_see_all);
            let targets = Targets::new(scene, target_views, strides, photographs.is_none())?;
            let parts = targets.split();
            let meter = self.meter(scene, &targets, &parts, photographs, journal)?;
            let mut trial = RunState::new(scene, request, stages, template.clone());
            (trial.scored, trial.ranking) = (Some(scored.clone()), Some(ranking.clone()));
            let steps = |stage| PrunedModels::new(RefineRun::new(NAME, stage, scene, &scored, &targets));
            trial.prune_steps = self.refine.as_ref().map(steps);
            let (best, tried) = self.bracket(&mut trial, &meter)?;
            if best.value.is_nan() {
                return Err(Error::usage(format!(
                    "--{}: the PSNR of renders cannot be measured: expected numbers in every pixel, found NaN in \
                     some\n  \
                     --set non_finite=drop removes the Gaussians that are not finite",
                    self.name().replace('_', "-")
                )));
            }
            let result = scene.input.compressed_frames(&best.result)?;
            let held = self.value(&meter, &*result, scene, true)?;
            let summary = self.summary(&best, held, meter.held_back_names(), tried);
            drop(result);
            let count = best.result.len();
            journal.left_out.extend(best.journal.left_out);
            journal.notes.extend(best.journal.notes);
            (journal.field, journal.bands) = (best.journal.field, best.journal.bands);
            (journal.refined, journal.photographs) = (best.journal.refined, best.journal.photographs);
            let note = self.note(&summary, meter.search_view_count(), count);
            Ok(((best.result, AsToml(summary), note), count))
        });
        let (result, AsToml(mut goal), note) = found?;
        if let Quality::Psnr(least) = self.quality {
            goal.asked = least;
        }
        match goal.is_met {
            true => run.journal.notes.push(note),
            false => run.journal.warn(&scene.events, note),
        }
        (run.result, run.goal) = (result, Some(goal));
        Ok(())
    }

    /// Returns the meter that measures the quality of models during the search:
    /// - If `photographs` is given (test views with their photographs), the meter compares renders with the
    ///   photographs. It holds one of every [`HELD_EVERY`] views back from the search.
    /// - Otherwise it compares renders with `targets`, the stored renders of the original, which `parts` divides by
    ///   purpose. The search uses the validation views; the test views are held back.
    fn meter<'a>(
        &self,
        scene: &'a Scene,
        targets: &'a Targets,
        parts: &ViewSplit,
        photographs: Option<(Vec<FrameView>, Photographs)>,
        journal: &mut Journal,
    ) -> Result<QualityMeter<'a>> {
        match photographs {
            Some((views, photographs)) => {
                journal.notes.push(format!("{} test views have photographs", views.len()));
                let is_held = |k: usize| k % HELD_EVERY == HELD_EVERY - 1;
                let views = views.into_iter().enumerate().map(|(k, view)| (view, is_held(k)));
                QualityMeter::new(
                    scene,
                    &scene.rig.cameras,
                    views.collect(),
                    QualityReference::Photographs(photographs),
                )
            }
            None => {
                let mut numbers = [&parts.validation[..], &parts.test[..]].concat();
                numbers.sort_unstable();
                let view = |&k: &usize| (targets.views[k], parts.test.contains(&k));
                let views = numbers.iter().map(view).collect();
                QualityMeter::new(scene, &targets.cameras, views, QualityReference::Original(targets, numbers))
            }
        }
    }

    /// Returns the cache key of the result of the search: a digest of everything on which the result depends.
    fn key(&self, scene: &Scene, scored: &Scored, ranked: &Ranking, template: &CompressedModel) -> Result<CacheKey> {
        let folder = match &self.quality {
            Quality::Psnr(_) => None,
            Quality::Loss { photographs, .. } => Some(photographs),
        };
        let limits = [self.quality.limit(), self.searched.limit()];
        let mut files = Vec::new();
        if let Some(folder) = folder.filter(|_| scene.work.is_enabled()) {
            add_file_stamps(folder, &mut files)?;
        }
        let refine = self.refine.as_ref().map(RefineStage::key);
        Ok(scene.work.key(&(
            (limits, files, self.target_views, self.fits_photographs, self.before_conversion, self.margins, refine),
            &scored.protected,
            ranked,
            template,
        )))
    }

    /// Checks, before any work, that at least [`HELD_EVERY`] test views have photographs if a maximum loss against
    /// photographs is requested.
    ///
    /// # Errors
    /// Fails if photographs are missing or too few.
    pub fn check(&self, scene: &Scene) -> Result<()> {
        self.photographs(scene).map(|_| ())
    }

    /// Returns the test views for which photographs exist, with the photographs; `None` unless a maximum loss against
    /// photographs is requested.
    fn photographs(&self, scene: &Scene) -> Result<Option<(Vec<FrameView>, Photographs)>> {
        let Quality::Loss { photographs, .. } = &self.searched else { return Ok(None) };
        let times = &scene.source().info().times;
        let views = select_views(&scene.rig, times, ViewSet::HeldOut)?;
        let found = Photographs::find(photographs, &scene.rig, times, views)?;
        if found.0.len() < HELD_EVERY {
            let (folder, found) = (photographs.shown(), found.0.len());
            return Err(Error::usage(format!(
                "--ground-truth {folder}: expected photographs of {HELD_EVERY} or more test views, found {found}"
            )));
        }
        Ok(Some(found))
    }

    /// Tries sizes (numbers of Gaussians) from the number of protected Gaussians, which are always kept, to the number
    /// of Gaussians in the ranking. Returns two values:
    /// - the smallest tried model that has the requested quality; if none has it, the model of all Gaussians in the
    ///   ranking;
    /// - every tried size with the quality of its model, dB (see [`TriedSize::value`]).
    fn bracket(&self, trial: &mut RunState<'_>, meter: &QualityMeter<'_>) -> Result<(TriedSize, Vec<(usize, f64)>)> {
        let (least, ranked_count) = (trial.scored()?.protected.len().max(1), trial.ranking()?.order().len());
        let mut tried: Vec<(usize, f64)> = Vec::new();
        let mut best: Option<TriedSize> = None;
        // Bounds of the search: size `low` fails, size `high` passes. Each has its surplus of quality in halvings, or
        // `None` if the size was not tried.
        let (mut low, mut high) = ((least.saturating_sub(1), None), (ranked_count, None));
        let mut next = FIRST_FRACTION * ranked_count as f64;
        while tried.len() < MAX_SIZES && high.0 - low.0 > 1 && high.0 as f64 > SAME_SIZE_RATIO * low.0 as f64 {
            let size = (next.round() as usize).clamp(low.0 + 1, high.0 - 1);
            let tried_size = self.try_size(trial, meter, size)?;
            let surplus = self.surplus(tried_size.value);
            tried.push((size, tried_size.value));
            if surplus >= 0.0 {
                (high, best) = ((size, Some(surplus)), Some(tried_size));
                if surplus <= MAX_SURPLUS {
                    break;
                }
            } else {
                low = (size, Some(surplus));
            }
            next = match (low, high) {
                ((low, Some(below)), (high, Some(above))) => {
                    // Slightly above the size at which a line through both surpluses crosses zero.
                    let part = ((0.5 * MAX_SURPLUS - below) / (above - below)).clamp(0.1, 0.9);
                    low as f64 * (high as f64 / low as f64).powf(part)
                }
                _ => size as f64 * (0.5 * MAX_SURPLUS - surplus).clamp(-2.0, 2.0).exp2(),
            };
        }
        let best = match best {
            Some(best) => best,
            None => {
                let everything = self.try_size(trial, meter, ranked_count)?;
                tried.push((ranked_count, everything.value));
                everything
            }
        };
        Ok((best, tried))
    }

    /// Runs the stages that reduce the model to `size` Gaussians, and measures the quality of the result on the views
    /// that the search uses. Returns the model, with its quality and the journal (log) of these stages.
    fn try_size(&self, trial: &mut RunState<'_>, meter: &QualityMeter<'_>, size: usize) -> Result<TriedSize> {
        (trial.journal, trial.target) = (Journal::default(), Some(size));
        trial.stages.run(Phase::Reduce, trial)?;
        let (result, journal) = (trial.take_result(), std::mem::take(&mut trial.journal));
        let source = trial.scene.input.compressed_frames(&result)?;
        let value = self.value(meter, &*source, trial.scene, false)?;
        drop(source);
        Ok(TriedSize { result, value, journal })
    }

    /// Returns the quality of the model `result`, dB: its PSNR against the original, or its loss of PSNR against
    /// photographs if a maximum loss is requested. If `on_held_views`, measures on the views held back from the search,
    /// otherwise on the views that the search uses.
    fn value(
        &self,
        meter: &QualityMeter<'_>,
        result: &dyn FrameSource,
        scene: &Scene,
        on_held_views: bool,
    ) -> Result<f64> {
        let found = meter.measure(result, on_held_views)?;
        match self.searched {
            Quality::Loss { .. } => Ok(meter.measure(scene.source(), on_held_views)? - found),
            Quality::Psnr(_) => Ok(found),
        }
    }

    /// Returns the surplus of quality: the estimated number of times that the number of Gaussians may still be halved.
    /// `value` is the quality of the present model, dB: its PSNR or its loss of PSNR. The surplus follows from
    /// [`COST_OF_HALVING`]:
    /// - 0: the quality is exactly the required one.
    /// - 1: the quality is so high that half as many Gaussians would suffice.
    /// - Below 0: the quality is worse than required, so more Gaussians are needed.
    fn surplus(&self, value: f64) -> f64 {
        match self.searched {
            // Renders with NaN or infinity never pass.
            _ if value.is_nan() => f64::NEG_INFINITY,
            Quality::Loss { most, .. } => (most / value.max(MIN_LOSS)).ln() / COST_OF_HALVING.1.ln(),
            Quality::Psnr(least) => (value - least) / COST_OF_HALVING.0,
        }
    }

    /// Returns the name of the requested quality in a recipe file: `min_psnr` or `max_loss`.
    fn name(&self) -> &'static str {
        match self.quality {
            Quality::Psnr(_) => "min_psnr",
            Quality::Loss { .. } => "max_loss",
        }
    }

    fn summary(&self, best: &TriedSize, held: f64, held_views: Vec<String>, tried: Vec<(usize, f64)>) -> GoalSummary {
        let (name, asked, before_conversion) = (self.name().to_owned(), self.searched.limit(), self.before_conversion);
        // The aim of an archive is higher than requested. Whether quantization keeps enough, its stage decides.
        let is_met = match self.quality {
            Quality::Psnr(least) => best.value >= least,
            Quality::Loss { .. } => self.surplus(best.value) >= 0.0,
        };
        GoalSummary { name, is_met, asked, before_conversion, searched: best.value, held, held_views, tried }
    }

    /// Returns a note for display about the result of the search. `searched_views`: number of views that the search
    /// used. `gaussians`: number of Gaussians in the result.
    fn note(&self, summary: &GoalSummary, searched_views: usize, gaussians: usize) -> String {
        let GoalSummary { name, is_met, asked, searched, held, held_views, tried, before_conversion } = summary;
        let stage = if *before_conversion { ", before conversion to the format of the output" } else { "" };
        let (sizes, held_count) = (tried.len(), held_views.len());
        let asked = match &self.quality {
            Quality::Psnr(least) if least < asked => {
                format!("at least {least} dB PSNR, which is {asked} dB before quantization")
            }
            _ if name == "max_loss" => format!("at most {asked} dB loss against photographs"),
            _ => format!("at least {asked} dB PSNR"),
        };
        let measured = format!(
            "{searched:.2} dB on the {searched_views} views of the search, {held:.2} dB on {held_count} other views \
             (goal.held_views in the summary){stage}"
        );
        match (is_met, self.surplus(*searched) >= 0.0) {
            (true, true) => format!(
                "search for {asked}: {gaussians} Gaussians are the smallest of {sizes} tried sizes that reach this; \
                 {measured}"
            ),
            (true, false) => format!(
                "search for {asked}: none of {sizes} tried sizes leaves room for quantization; all {gaussians} \
                 Gaussians that may stay are written, with {measured}"
            ),
            (false, _) => format!(
                "{UNREACHED}: none of {sizes} tried sizes has {asked}; all {gaussians} Gaussians that may stay are \
                 written, with {measured}"
            ),
        }
    }
}
