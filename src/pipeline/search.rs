//! The search for the smallest model that is as good as asked for: a loop around the stages that reduce the model.
//!
//! Sizes are tried one after the other, each refined as if it had been asked for; the next one follows from how much
//! quality the last ones had to spare, and lies between the largest that did not do and the smallest that did. Cuts on the
//! way down are kept, so that a smaller size goes on from there. A quarter of the pictures is never searched on and gives
//! the figure that is reported (method.md, section 6.3).

use super::planning::Planning;
use super::quality_meter::{QualityMeter, With};
use super::request::{Goal, Quality};
use super::stage::{EstimateInput, Phase, RunState};
use super::stages::bands::ShDegreeStage;
use super::stages::choose::CLUSTERED;
use super::stages::field::FieldPrecisionStage;
use super::stages::reference_views::LEFT_BY_SEARCH;
use super::summary::GoalSummary;
use crate::cache::CacheKey;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result, ShowPath};
use crate::journal::Journal;
use crate::journal::as_toml::AsToml;
use crate::memory_plan::{PICTURE_ON_ALL_THREADS, RENDER, ResourceEstimate};
use crate::model::{Columns, Picture};
use crate::outputs::kind::OutputKind;
use crate::pruning::Ranking;
use crate::pruning::score::{Scored, scored_memory};
use crate::refinement::prune_steps::PruneSteps;
use crate::refinement::targets::{Parted, Targets};
use crate::refinement::{RefineRun, RefineStage};
use crate::render;
use crate::scene::Scene;
use crate::scene::photographs::Photographs;
use crate::scene::pictures::{PictureSet, pictures};
use crate::scene::stamps;
use crate::source::FrameSource;

/// What the stage is called.
const NAME: &str = "search";
/// Part of the Gaussians that is tried first.
const FIRST: f64 = 0.2;
/// Sizes that are usually tried, for estimates.
const SIZES_USUALLY_TRIED: f64 = 4.0;
/// Sizes that are tried at most.
const MOST_TRIED: usize = 8;
/// Neighboring sizes whose ratio is this or less are not told apart.
const SAME_SIZE: f64 = 1.04;
/// What a halving of the number of Gaussians costs, about: dB, and the factor of a loss. Guesses follow from it.
const HALVING: (f64, f64) = (4.5, 3.0);
/// Halvings that a size may have to spare and still be the one.
const CLOSE: f64 = 0.03;
/// Losses are not told apart below this, dB.
const LEAST_LOSS: f64 = 1e-3;
/// Of the photographs every fourth is held back.
const HELD_EVERY: usize = 4;

/// The search of a run: repeats the stages that reduce the model, once for every size it tries.
#[derive(Debug, Clone)]
pub struct SearchStage {
    /// What is asked for.
    quality: Quality,
    /// What is searched for: an archive takes some of the quality that is found.
    searched: Quality,
    /// Pictures of the original that sizes are compared and refined by.
    pictures: usize,
    /// How a size is refined.
    refine: Option<RefineStage>,
    /// Margins, dB, by which the field of a size is rounded and bands of its harmonics are dropped; none: they stay.
    margins: [Option<f64>; 2],
}

/// A size that was tried.
struct TriedSize {
    result: CompressedModel,
    /// dB or dB lost, by the pictures that are searched on.
    value: f64,
    journal: Journal,
}

impl SearchStage {
    /// Returns the search of a run that asks for a quality.
    pub fn from_planning(planning: &Planning<'_>) -> Option<SearchStage> {
        let Planning { request, output, .. } = *planning;
        let Some(Goal::Quality(quality)) = &request.goal else { return None };
        let searched = match quality {
            Quality::Psnr(least) if output == OutputKind::Archive => Quality::Psnr(least + LEFT_BY_SEARCH),
            other => other.clone(),
        };
        let field = FieldPrecisionStage::from_request(request, output).map(|stage| stage.margin);
        let bands = ShDegreeStage::from_request(request, output).map(|stage| stage.margin);
        Some(SearchStage {
            quality: quality.clone(),
            searched,
            pictures: request.recipe.refine.refine_pictures,
            refine: planning.refine.clone(),
            margins: [field, bands],
        })
    }

    /// Returns what is searched for, for a person.
    pub(super) fn parameters(&self) -> String {
        format!("search: {} sizes at most, for {} {}", MOST_TRIED, self.name(), self.goal())
    }

    /// Returns the estimate of the search. `repeated` are those of the stages that every size goes through: memory is that of
    /// the largest of them and of the models that the search keeps, time and reads are those of all, for each size.
    pub fn estimate(&self, input: EstimateInput<'_>, repeated: &[ResourceEstimate]) -> ResourceEstimate {
        let EstimateInput { work, limits, .. } = input;
        let whole = work.state(Columns::all());
        let (reader, held) = (work.input.reader, work.held(limits, Columns::all()));
        let frames = work.frames.min(128);
        let measured = ResourceEstimate {
            stage: NAME,
            reads: work.scattered_reads(frames, limits),
            seconds: work.reading(work.count(), frames as f64)
                + work.picturing(self.pictures as f64, work.count(), RENDER),
            per_gaussian: [
                scored_memory(limits),
                vec![("states", whole), ("readers", reader), ("held", held), ("pictures", PICTURE_ON_ALL_THREADS)],
            ]
            .concat(),
            fixed: vec![work.arriving()],
        };
        let (seconds, reads) = repeated.iter().fold((0.0, 0.0), |(s, r), stage| (s + stage.seconds, r + stage.reads));
        let largest = repeated.iter().chain([&measured]).max_by_key(|stage| stage.bytes(work));
        let mut need = largest.unwrap_or(&measured).clone();
        need.stage = NAME;
        need.seconds = SIZES_USUALLY_TRIED * seconds.max(measured.seconds);
        need.reads = SIZES_USUALLY_TRIED * reads.max(measured.reads);
        // A picture, what it is compared with as it is read, and as it is used.
        need.fixed.push(("compared", work.threads * (render::STRIP_BYTES as u64 + 28 * work.pixels)));
        need.fixed.push(("field", work.input.fixed));
        // Prune steps of a fifth from two fifths: twice the Gaussians.
        need.per_gaussian.extend([("ways", 3 * (whole + 8)), ("result", work.input.reduced), ("kept", CLUSTERED)]);
        need
    }

    /// Finds the smallest result that is as good as asked for, and leaves it and what it was found by in `run`.
    ///
    /// # Errors
    /// Frames or photographs that cannot be read; too few pictures.
    pub fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scene, scored, ranking) = (run.scene, run.scored()?, run.ranking()?);
        let key = self.key(scene, &scored, &ranking, &run.template)?;
        let (request, stages, template) = (run.request, run.stages, &run.template);
        let found = run.journal.kept_stage(NAME, ranking.order().len(), scene, key, |journal| {
            let photographs = self.photographs(scene)?;
            let targets = Targets::new(scene, self.pictures)?;
            let parts = targets.parted(photographs.is_none());
            let meter = self.meter(scene, &targets, &parts, photographs, journal)?;
            let mut trial = RunState::new(scene, request, stages, template.clone());
            (trial.scored, trial.ranking) = (Some(scored.clone()), Some(ranking.clone()));
            let steps =
                |stage| PruneSteps::new(RefineRun::new(NAME, stage, scene, &scored, &targets, parts.clone()));
            trial.prune_steps = self.refine.as_ref().map(steps);
            let (best, tried) = self.bracket(&mut trial, &meter)?;
            if best.value.is_nan() {
                return Err(Error::usage(format!(
                    "--{}: the PSNR of pictures cannot be measured: expected numbers in every pixel, found NaN in some\n  \
                     --non-finite drop removes the Gaussians that are not finite",
                    self.name().replace('_', "-")
                )));
            }
            let result = scene.input.reduced(&best.result)?;
            let summary = self.summary(&best, self.value(&meter, &*result, scene, true)?, meter.held(), tried);
            drop(result);
            let (count, does) = (best.result.len(), self.spare(summary.searched) >= 0.0);
            journal.left_out.extend(best.journal.left_out);
            journal.notes.extend(best.journal.notes);
            (journal.field, journal.bands) = (best.journal.field, best.journal.bands);
            journal.refined = best.journal.refined;
            journal.notes.push(note(&summary, meter.searched(), count, does));
            Ok(((best.result, AsToml(summary)), count))
        });
        let (result, AsToml(mut goal)) = found?;
        if let Quality::Psnr(least) = self.quality {
            goal.asked = least;
        }
        (run.result, run.goal) = (result, Some(goal));
        Ok(())
    }

    /// Returns what sizes are compared by: photographs, or pictures of the original.
    fn meter<'a>(
        &self,
        scene: &'a Scene,
        targets: &'a Targets,
        parts: &Parted,
        photographs: Option<(Vec<Picture>, Photographs)>,
        journal: &mut Journal,
    ) -> Result<QualityMeter<'a>> {
        match photographs {
            Some((of, photographs)) => {
                journal.notes.push(format!("{} held-out pictures have photographs", of.len()));
                let of = of.into_iter().enumerate().map(|(k, of)| (of, k % HELD_EVERY == HELD_EVERY - 1));
                QualityMeter::new(scene, &scene.rig.cameras, of.collect(), With::Photographs(photographs))
            }
            None => {
                let mut numbers = [&parts.apart[..], &parts.held[..]].concat();
                numbers.sort_unstable();
                let of = |&k: &usize| (targets.pictures[k], parts.held.contains(&k));
                let of = numbers.iter().map(of).collect();
                QualityMeter::new(scene, &targets.cameras, of, With::Original(targets, numbers))
            }
        }
    }

    /// What the search follows from.
    fn key(&self, scene: &Scene, scored: &Scored, ranked: &Ranking, like: &CompressedModel) -> Result<CacheKey> {
        let (asked, folder) = match &self.searched {
            Quality::Psnr(least) => (*least, None),
            Quality::Loss { most, photographs } => (*most, Some(photographs)),
        };
        let mut files = Vec::new();
        if let Some(folder) = folder.filter(|_| scene.work.keeps()) {
            stamps(folder, &mut files)?;
        }
        let refine = self.refine.as_ref().map(RefineStage::key);
        Ok(scene.work.key(&(
            (asked, files, self.pictures, self.margins[0], self.margins[1], refine),
            &scored.protected,
            ranked,
            like,
        )))
    }

    /// Confirms, before any work, that there are photographs, where a loss is asked for.
    ///
    /// # Errors
    /// Photographs that are not there, or too few.
    pub fn check(&self, scene: &Scene) -> Result<()> {
        self.photographs(scene).map(|_| ())
    }

    /// The held-out pictures that have a photograph, and these, where a loss is asked for.
    fn photographs(&self, scene: &Scene) -> Result<Option<(Vec<Picture>, Photographs)>> {
        let Quality::Loss { photographs, .. } = &self.searched else { return Ok(None) };
        let times = &scene.source().info().times;
        let of = pictures(&scene.rig, times, PictureSet::HeldOut)?;
        let found = Photographs::of_some(photographs, &scene.rig, times, of)?;
        if found.0.len() < HELD_EVERY {
            let (folder, found) = (photographs.shown(), found.0.len());
            return Err(Error::usage(format!(
                "--ground-truth {folder}: expected photographs of {HELD_EVERY} or more held-out pictures, found {found}"
            )));
        }
        Ok(Some(found))
    }

    /// Tries sizes from all protected Gaussians to all that may stay. Returns the smallest that does, or everything, and every
    /// size tried with what it has.
    fn bracket(&self, trial: &mut RunState<'_>, meter: &QualityMeter<'_>) -> Result<(TriedSize, Vec<(usize, f64)>)> {
        let (least, all) = (trial.scored()?.protected.len().max(1), trial.ranking()?.order().len());
        let mut tried: Vec<(usize, f64)> = Vec::new();
        let mut best: Option<TriedSize> = None;
        // Sizes, and halvings that each has to spare: below what does not do, above what does.
        let (mut low, mut high) = ((least.saturating_sub(1), None), (all, None));
        let mut next = FIRST * all as f64;
        while tried.len() < MOST_TRIED && high.0 - low.0 > 1 && high.0 as f64 > SAME_SIZE * low.0 as f64 {
            let size = (next.round() as usize).clamp(low.0 + 1, high.0 - 1);
            let now = self.try_size(trial, meter, size)?;
            let spare = self.spare(now.value);
            tried.push((size, now.value));
            if spare >= 0.0 {
                (high, best) = ((size, Some(spare)), Some(now));
                if spare <= CLOSE {
                    break;
                }
            } else {
                low = (size, Some(spare));
            }
            next = match (low, high) {
                ((low, Some(below)), (high, Some(above))) => {
                    // A little above where the line between both crosses zero.
                    let part = ((0.5 * CLOSE - below) / (above - below)).clamp(0.1, 0.9);
                    low as f64 * (high as f64 / low as f64).powf(part)
                }
                _ => size as f64 * (0.5 * CLOSE - spare).clamp(-2.0, 2.0).exp2(),
            };
        }
        let best = match best {
            Some(best) => best,
            None => {
                let everything = self.try_size(trial, meter, all)?;
                tried.push((all, everything.value));
                everything
            }
        };
        Ok((best, tried))
    }

    /// Runs the stages that reduce the model to `size` Gaussians and measures what comes out.
    fn try_size(&self, trial: &mut RunState<'_>, meter: &QualityMeter<'_>, size: usize) -> Result<TriedSize> {
        (trial.journal, trial.target) = (Journal::default(), Some(size));
        trial.stages.run(Phase::Reduce, trial)?;
        let (result, journal) = (trial.take_result(), std::mem::take(&mut trial.journal));
        let source = trial.scene.input.reduced(&result)?;
        let value = self.value(meter, &*source, trial.scene, false)?;
        drop(source);
        Ok(TriedSize { result, value, journal })
    }

    /// What the goal is about, dB or dB lost, of `result`, by the pictures that are searched on or by those held back.
    fn value(&self, meter: &QualityMeter<'_>, result: &dyn FrameSource, scene: &Scene, held: bool) -> Result<f64> {
        let found = meter.measure(result, held)?;
        match self.searched {
            Quality::Loss { .. } => Ok(meter.measure(scene.source(), held)? - found),
            Quality::Psnr(_) => Ok(found),
        }
    }

    /// Halvings of the number of Gaussians that `value` has to spare, about.
    fn spare(&self, value: f64) -> f64 {
        match self.searched {
            // Of pictures that are not finite.
            _ if value.is_nan() => f64::NEG_INFINITY,
            Quality::Loss { most, .. } => (most / value.max(LEAST_LOSS)).ln() / HALVING.1.ln(),
            Quality::Psnr(least) => (value - least) / HALVING.0,
        }
    }

    /// Returns what is searched for, dB.
    fn goal(&self) -> f64 {
        match self.searched {
            Quality::Psnr(least) => least,
            Quality::Loss { most, .. } => most,
        }
    }

    /// Name of what is asked for, as a recipe has it.
    fn name(&self) -> &'static str {
        match self.quality {
            Quality::Psnr(_) => "min_psnr",
            Quality::Loss { .. } => "max_loss",
        }
    }

    fn summary(
        &self,
        best: &TriedSize,
        held: f64,
        held_pictures: Vec<String>,
        tried: Vec<(usize, f64)>,
    ) -> GoalSummary {
        let asked = self.goal();
        GoalSummary { name: self.name().to_owned(), asked, searched: best.value, held, held_pictures, tried }
    }
}

/// What was found, for a person: of `gaussians`, by so many pictures searched on, and whether it `does`.
fn note(summary: &GoalSummary, searched: usize, gaussians: usize, does: bool) -> String {
    let GoalSummary { name, asked, searched: by_searched, held, held_pictures, tried } = summary;
    let (sizes, others) = (tried.len(), held_pictures.len());
    let (at, unit) = if name == "max_loss" { ("most", "dB lost against photographs") } else { ("least", "dB") };
    let found = match does {
        true => format!("of {sizes} sizes tried {gaussians} Gaussians are the fewest that do"),
        false => format!("none of {sizes} sizes tried does, and everything that may stay is written"),
    };
    format!(
        "at {at} {asked} {unit} asked for: {found}; {by_searched:.2} dB by the {searched} pictures searched on, \
         {held:.2} dB by {others} held back (goal.held_pictures in the summary)"
    )
}
