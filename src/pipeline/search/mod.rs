//! Stage `search`: the smallest model that is as good as asked for.
//!
//! Sizes are tried one after the other, each refined as if it had been asked for; the next one follows from how much
//! quality the last ones had to spare, and lies between the largest that did not do and the smallest that did. Cuts on the
//! way down are kept, so that a smaller size goes on from there. A quarter of the pictures is never searched on and gives
//! the figure that is reported (method.md, section 6.3).

pub(crate) mod quality_meter;
pub(crate) mod size;

use super::request::Quality;
use super::summary::GoalSummary;
use crate::cache::CacheKey;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result, ShowPath};
use crate::journal::Journal;
use crate::journal::as_toml::AsToml;
use crate::limits::Limits;
use crate::memory_plan::{MemoryPart, PICTURE_ON_ALL_THREADS, RENDER, ResourceEstimate, Workload};
use crate::model::{Columns, Picture};
use crate::pipeline::search::quality_meter::{QualityMeter, With};
use crate::pipeline::stages::bands::ShDegreeStage;
use crate::pipeline::stages::choose::CLUSTERED;
use crate::pipeline::stages::field::FieldPrecisionStage;
use crate::pruning::Ranking;
use crate::pruning::score::{Scored, scored_memory};
use crate::refinement::targets::Targets;
use crate::refinement::{CUT, RefineRun, RefineStage};
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
/// Part that rounds leave where nothing is refined.
const FEWEST: f64 = 0.02;
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

/// The search of a run.
#[derive(Debug, Clone)]
pub struct SearchStage {
    /// What is asked for.
    pub quality: Quality,
    /// Pictures of the original that sizes are compared and refined by.
    pub pictures: usize,
    /// How a size is refined.
    pub refine: Option<RefineStage>,
    /// How its field is rounded.
    pub field: Option<FieldPrecisionStage>,
    /// How bands of its harmonics are dropped.
    pub bands: Option<ShDegreeStage>,
}

/// A size that was tried.
struct TriedSize {
    reduction: CompressedModel,
    /// dB or dB lost, by the pictures that are searched on.
    value: f64,
    journal: Journal,
}

impl SearchStage {
    /// How many of `all` Gaussians rounds are to rank down to.
    pub fn fewest(&self, all: usize) -> usize {
        self.refine.as_ref().map_or((FEWEST * all as f64).ceil() as usize, |refine| refine.first(0, all))
    }

    /// What refining needs, what is kept of the way down, and of the best.
    pub fn need(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let whole = work.state(Columns::all());
        let (reader, held) = (work.input.reader, work.held(limits, Columns::all()));
        // Cuts of a fifth from two fifths: twice the Gaussians.
        let ways: Vec<MemoryPart> = vec![("ways", 3 * (whole + 8)), ("result", work.input.reduced)];
        let refined = self.refine.as_ref().map(|refine| refine.need(work, limits));
        let frames = work.frames.min(128);
        // A picture, what it is compared with as it is read, and as it is used.
        let compared = work.threads * (render::STRIP_BYTES as u64 + 28 * work.pixels);
        let looked = ResourceEstimate {
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
        let mut need = refined.unwrap_or(looked);
        need.fixed.push(("compared", compared));
        need.fixed.extend(self.field.as_ref().map(|_| ("field", work.input.fixed)));
        need.stage = NAME;
        (need.seconds, need.reads) = (4.0 * need.seconds, 4.0 * need.reads);
        need.per_gaussian.extend(ways);
        need.per_gaussian.push(("kept", CLUSTERED));
        need
    }

    /// The smallest reduction in the manner of `like` found that is as good as asked for.
    ///
    /// # Errors
    /// Frames or photographs that cannot be read; too few pictures.
    pub fn run(
        &self,
        scene: &Scene,
        scored: &Scored,
        ranked: &Ranking,
        like: &CompressedModel,
        journal: &mut Journal,
    ) -> Result<(CompressedModel, GoalSummary)> {
        let all = ranked.order().len();
        let key = self.key(scene, scored, ranked, like)?;
        let found = journal.kept_stage(NAME, all, scene, key, |journal| {
            let photographs = self.photographs(scene)?;
            let targets = Targets::new(scene, self.pictures)?;
            let parts = targets.parted(photographs.is_none());
            let gauge = match photographs {
                Some((of, photographs)) => {
                    journal.notes.push(format!("{} held-out pictures have photographs", of.len()));
                    let of = of.into_iter().enumerate().map(|(k, of)| (of, k % HELD_EVERY == HELD_EVERY - 1));
                    QualityMeter::new(scene, &scene.rig.cameras, of.collect(), With::Photographs(photographs))?
                }
                None => {
                    let mut numbers = [&parts.apart[..], &parts.held[..]].concat();
                    numbers.sort_unstable();
                    let of = |&k: &usize| (targets.pictures[k], parts.held.contains(&k));
                    let of = numbers.iter().map(of).collect();
                    QualityMeter::new(scene, &targets.cameras, of, With::Original(&targets, numbers))?
                }
            };
            let walk = self.refine.as_ref().map(|refine| RefineRun::new(NAME, refine, scene, scored, &targets, parts));
            let mut way = SearchState { search: self, scene, scored, ranked, like, gauge: &gauge, walk, cuts: Vec::new() };
            let (best, tried) = self.bracket(&mut way, scored.protected.len().max(1), all)?;
            if best.value.is_nan() {
                return Err(Error::usage(format!(
                    "--{}: the PSNR of pictures cannot be measured: expected numbers in every pixel, found NaN in some\n  \
                     --non-finite drop removes the Gaussians that are not finite",
                    self.name().replace('_', "-")
                )));
            }
            let result = scene.input.reduced(&best.reduction)?;
            let summary = self.summary(&best, self.value(&gauge, &*result, scene, true)?, gauge.held(), tried);
            drop(result);
            let (count, does) = (best.reduction.len(), self.spare(summary.searched) >= 0.0);
            journal.left_out.extend(best.journal.left_out);
            journal.notes.extend(best.journal.notes);
            (journal.field, journal.bands) = (best.journal.field, best.journal.bands);
            journal.refined = best.journal.refined;
            journal.notes.push(note(&summary, gauge.searched(), count, does));
            Ok(((best.reduction, AsToml(summary)), count))
        });
        let (reduction, AsToml(summary)) = found?;
        Ok((reduction, summary))
    }

    /// What the search follows from.
    fn key(&self, scene: &Scene, scored: &Scored, ranked: &Ranking, like: &CompressedModel) -> Result<CacheKey> {
        let (asked, folder) = match &self.quality {
            Quality::Psnr(least) => (*least, None),
            Quality::Loss { most, photographs } => (*most, Some(photographs)),
        };
        let mut files = Vec::new();
        if let Some(folder) = folder.filter(|_| scene.work.keeps()) {
            stamps(folder, &mut files)?;
        }
        let (field, bands) = (self.field.as_ref().map(|of| of.margin), self.bands.as_ref().map(|of| of.margin));
        let refine = self.refine.as_ref().map(RefineStage::key);
        Ok(scene.work.key(&((asked, files, self.pictures, field, bands, refine), &scored.protected, ranked, like)))
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
        let Quality::Loss { photographs, .. } = &self.quality else { return Ok(None) };
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

    /// Tries sizes from `least` to `all`; the smallest that does, or everything, and every size tried with what it has.
    fn bracket(&self, way: &mut SearchState<'_>, least: usize, all: usize) -> Result<(TriedSize, Vec<(usize, f64)>)> {
        let mut tried: Vec<(usize, f64)> = Vec::new();
        let mut best: Option<TriedSize> = None;
        // Sizes, and halvings that each has to spare: below what does not do, above what does.
        let (mut low, mut high) = ((least.saturating_sub(1), None), (all, None));
        let mut next = FIRST * all as f64;
        while tried.len() < MOST_TRIED && high.0 - low.0 > 1 && high.0 as f64 > SAME_SIZE * low.0 as f64 {
            let size = (next.round() as usize).clamp(low.0 + 1, high.0 - 1);
            let now = way.at(size)?;
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
                let everything = way.at(all)?;
                tried.push((all, everything.value));
                everything
            }
        };
        Ok((best, tried))
    }

    /// What the goal is about, dB or dB lost, of `result`, by the pictures that are searched on or by those held back.
    fn value(&self, gauge: &QualityMeter<'_>, result: &dyn FrameSource, scene: &Scene, held: bool) -> Result<f64> {
        let found = gauge.measure(result, held)?;
        match self.quality {
            Quality::Loss { .. } => Ok(gauge.measure(scene.source(), held)? - found),
            Quality::Psnr(_) => Ok(found),
        }
    }

    /// Halvings of the number of Gaussians that `value` has to spare, about.
    fn spare(&self, value: f64) -> f64 {
        match self.quality {
            // Of pictures that are not finite.
            _ if value.is_nan() => f64::NEG_INFINITY,
            Quality::Loss { most, .. } => (most / value.max(LEAST_LOSS)).ln() / HALVING.1.ln(),
            Quality::Psnr(least) => (value - least) / HALVING.0,
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
        let asked = match self.quality {
            Quality::Psnr(least) => least,
            Quality::Loss { most, .. } => most,
        };
        GoalSummary { name: self.name().to_owned(), asked, searched: best.value, held, held_pictures, tried }
    }
}

/// Returns how many of `count` Gaussians the next prune step leaves on the way to `wanted`, of which there are fewer: a part
/// [`CUT`], and always at least one Gaussian less than before.
fn next_size(count: usize, wanted: usize) -> usize {
    ((CUT * count as f64).ceil() as usize).min(count - 1).max(wanted)
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

/// The way down, as far as it was gone.
struct SearchState<'a> {
    search: &'a SearchStage,
    scene: &'a Scene,
    scored: &'a Scored,
    ranked: &'a Ranking,
    like: &'a CompressedModel,
    gauge: &'a QualityMeter<'a>,
    walk: Option<RefineRun<'a>>,
    /// What cuts left, larger ones first.
    cuts: Vec<CompressedModel>,
}

impl SearchState<'_> {
    /// The best of `size` Gaussians.
    fn at(&mut self, size: usize) -> Result<TriedSize> {
        let mut journal = Journal::default();
        let all = self.ranked.order().len();
        let prefix = |size: usize| self.like.with(self.ranked.take(size));
        let mut reduction = match (&self.search.refine, &mut self.walk) {
            (Some(refine), Some(walk)) if size < all => {
                let first = refine.first(size, self.scored.count()).min(all);
                let cut = self.cuts.iter().rfind(|cut| first > size && cut.len() >= size);
                let mut start = cut.cloned().unwrap_or_else(|| prefix(first));
                while start.len() > size {
                    let next = next_size(start.len(), size);
                    start = walk.cut_down(&start, next, size)?;
                    if next > size {
                        self.cuts.push(start.clone());
                    }
                }
                walk.best_of(start, &mut journal)?
            }
            _ => prefix(size),
        };
        if let Some(field) = &self.search.field {
            reduction = field.round(self.scene, reduction, &mut journal)?;
        }
        if let Some(bands) = &self.search.bands {
            reduction = bands.drop_some(self.scene, reduction, &mut journal)?;
        }
        let result = self.scene.input.reduced(&reduction)?;
        let value = self.search.value(self.gauge, &*result, self.scene, false)?;
        drop(result);
        Ok(TriedSize { reduction, value, journal })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prune_steps_reach_every_size_from_every_count() {
        for count in 0..=50 {
            for wanted in 0..count {
                let (mut left, mut steps) = (count, 0);
                while left > wanted {
                    let next = next_size(left, wanted);
                    assert!((wanted..left).contains(&next), "{left} to {next} on the way to {wanted}");
                    (left, steps) = (next, steps + 1);
                }
                assert!(steps <= count, "{steps} steps from {count} to {wanted}");
            }
        }
        assert_eq!([next_size(1000, 3), next_size(1000, 900), next_size(5, 1)], [800, 900, 4]);
    }
}
