//! Stage `search`: the smallest model that is as good as asked for.
//!
//! Sizes are tried one after the other, each refined as if it had been asked for; the next one follows from how much
//! quality the last ones had to spare, and lies between the largest that did not do and the smallest that did. Cuts on the
//! way down are kept, so that a smaller size goes on from there. A quarter of the pictures is never searched on and gives
//! the figure that is reported (method.md, section 6.3).

mod gauge;

use super::choose::CLUSTERED;
use super::journal::Journal;
use super::refine::targets::Targets;
use super::refine::{CUT, Refine, Walk};
use super::request::Quality;
use super::score::{Ranked, Scored, scored};
use super::summary::GoalSummary;
use crate::budget::{Need, PICTURE_ON_ALL_THREADS, Part, Workload};
use crate::error::Result;
use crate::limits::Limits;
use crate::model::Columns;
use crate::recipe;
use crate::reduction::Reduction;
use crate::render;
use crate::scene::Scene;
use crate::scene::photographs::Photographs;
use crate::scene::pictures::{PictureSet, pictures};
use gauge::{Found, Gauge, With};

/// What the stage is called.
const NAME: &str = "search";
/// Part of the Gaussians that is tried first.
const FIRST: f64 = 0.2;
/// Part that rounds leave where nothing is refined.
const FEWEST: f64 = 0.02;
/// Sizes that are tried at most.
const MOST_TRIED: usize = 8;
/// Neighbouring sizes whose ratio is this or less are not told apart.
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
pub struct Search {
    /// What is asked for.
    pub quality: Quality,
    /// How a size is refined.
    pub refine: Option<Refine>,
    /// Merging does not take part.
    pub rule: recipe::Merge,
}

/// A size that was tried.
struct Tried {
    reduction: Reduction,
    found: Found,
    journal: Journal,
}

impl Search {
    /// How many of `all` Gaussians rounds are to rank down to.
    pub fn fewest(&self, all: usize) -> usize {
        self.refine.as_ref().map_or((FEWEST * all as f64).ceil() as usize, |refine| refine.first(0, all))
    }

    /// What refining needs, what is kept of the way down, and of the best.
    pub fn need(&self, work: &Workload, limits: &Limits) -> Need {
        let whole = work.state(Columns::all());
        let (reader, held) = (work.input.reader, work.held(limits, Columns::all()));
        // Cuts of a fifth from two fifths: twice the Gaussians.
        let ways: Vec<Part> = vec![("ways", 3 * (whole + 8)), ("result", work.input.reduced)];
        let refined = self.refine.as_ref().map(|refine| refine.need(work, limits));
        let looked = Need {
            stage: NAME,
            reads: work.scattered_reads(work.frames.min(128), limits),
            seconds: 0.0,
            per_gaussian: [
                scored(limits),
                vec![("states", whole), ("readers", reader), ("held", held), ("pictures", PICTURE_ON_ALL_THREADS)],
            ]
            .concat(),
            fixed: vec![work.arriving(), ("pictures", render::STRIP_BYTES as u64 + 8 * 24 * work.pixels)],
        };
        let mut need = refined.unwrap_or(looked);
        need.stage = NAME;
        (need.seconds, need.reads) = (4.0 * need.seconds, 4.0 * need.reads);
        need.per_gaussian.extend(ways);
        need.per_gaussian.push(("kept", CLUSTERED));
        need
    }

    /// The smallest reduction found that is as good as asked for.
    ///
    /// # Errors
    /// Frames or photographs that cannot be read; too few pictures.
    pub fn run(
        &self,
        scene: &Scene,
        scored: &Scored,
        ranked: &Ranked,
        journal: &mut Journal,
    ) -> Result<(Reduction, GoalSummary)> {
        let all = ranked.ranking.order().len();
        journal.stage(NAME, all, scene.source(), |journal| {
            let targets = Targets::new(scene)?;
            let by_photographs = matches!(self.quality, Quality::Loss { .. });
            let parts = targets.parted(!by_photographs);
            let gauge = match &self.quality {
                Quality::Loss { photographs, .. } => {
                    let times = &scene.source().info().times;
                    let of = pictures(&scene.rig, times, PictureSet::HeldOut)?;
                    let all = of.len();
                    let (of, with) = Photographs::of_some(photographs, &scene.rig, times, of)?;
                    if of.len() < all {
                        let found = of.len();
                        journal.notes.push(format!("{found} of {all} held-out pictures have photographs"));
                    }
                    let of = of.into_iter().enumerate().map(|(k, of)| (of, k % HELD_EVERY == HELD_EVERY - 1));
                    Gauge::new(scene, &scene.rig.cameras, of.collect(), With::Photographs(with))?
                }
                Quality::Psnr(_) => {
                    let mut numbers = [&parts.apart[..], &parts.held[..]].concat();
                    numbers.sort_unstable();
                    let of = |&k: &usize| (targets.pictures[k], parts.held.contains(&k));
                    let of = numbers.iter().map(of).collect();
                    Gauge::new(scene, &targets.cameras, of, With::Original(&targets, numbers))?
                }
            };
            let original = if by_photographs { gauge.measure(scene.source())? } else { [0.0; 2] };
            let walk = self.refine.as_ref().map(|refine| Walk::new(refine, scene, scored, &targets, parts));
            let mut way = Way { search: self, scene, ranked, gauge: &gauge, walk, cuts: Vec::new() };
            let (best, tried) = self.bracket(&mut way, original, scored.protected.len().max(1), all)?;
            let summary = self.summary(&best, original, &gauge, tried);
            journal.left_out.extend(best.journal.left_out);
            journal.notes.extend(best.journal.notes);
            journal.notes.push(note(&summary, gauge.searched(), best.reduction.len()));
            let count = best.reduction.len();
            Ok(((best.reduction, summary), count))
        })
    }

    /// Tries sizes from `least` to `all`; the smallest that does, or everything, and every size tried with what it has.
    fn bracket(
        &self,
        way: &mut Way<'_>,
        original: Found,
        least: usize,
        all: usize,
    ) -> Result<(Tried, Vec<(usize, f64)>)> {
        let mut tried: Vec<(usize, f64)> = Vec::new();
        let mut best: Option<Tried> = None;
        // Sizes, and halvings that each has to spare: below what does not do, above what does.
        let (mut low, mut high) = ((least.saturating_sub(1), None), (all, None));
        let mut next = FIRST * all as f64;
        while tried.len() < MOST_TRIED && high.0 - low.0 > 1 && high.0 as f64 > SAME_SIZE * low.0 as f64 {
            let size = (next.round() as usize).clamp(low.0 + 1, high.0 - 1);
            let now = way.at(size)?;
            let spare = self.spare(self.value(now.found[0], original[0]));
            tried.push((size, self.value(now.found[0], original[0])));
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
            None => way.at(all)?,
        };
        Ok((best, tried))
    }

    /// What the goal is about: dB, or dB lost.
    fn value(&self, found: f64, original: f64) -> f64 {
        if let Quality::Loss { .. } = self.quality { original - found } else { found }
    }

    /// Halvings of the number of Gaussians that `value` has to spare, about.
    fn spare(&self, value: f64) -> f64 {
        match self.quality {
            Quality::Loss { most, .. } => (most / value.max(LEAST_LOSS)).ln() / HALVING.1.ln(),
            Quality::Psnr(least) => (value - least) / HALVING.0,
        }
    }

    fn summary(&self, best: &Tried, original: Found, gauge: &Gauge<'_>, tried: Vec<(usize, f64)>) -> GoalSummary {
        let (name, asked) = match self.quality {
            Quality::Psnr(least) => ("min_psnr", least),
            Quality::Loss { most, .. } => ("max_loss", most),
        };
        GoalSummary {
            name: name.to_owned(),
            asked,
            searched: self.value(best.found[0], original[0]),
            held: self.value(best.found[1], original[1]),
            held_pictures: gauge.held(),
            tried,
        }
    }
}

/// What was found, for a person.
fn note(summary: &GoalSummary, searched: usize, gaussians: usize) -> String {
    let GoalSummary { name, asked, searched: by_searched, held, held_pictures, tried } = summary;
    let (sizes, others) = (tried.len(), held_pictures.len());
    let what = if name == "max_loss" { "of what photographs show lost" } else { "kept of the original's pictures" };
    format!(
        "{asked} dB asked for: of {sizes} sizes tried {gaussians} Gaussians are the fewest that do; {by_searched:.2} dB \
         {what} by the {searched} pictures searched on, {held:.2} dB by {others} others (goal.held_pictures in the summary)"
    )
}

/// The way down, as far as it was gone.
struct Way<'a> {
    search: &'a Search,
    scene: &'a Scene,
    ranked: &'a Ranked,
    gauge: &'a Gauge<'a>,
    walk: Option<Walk<'a>>,
    /// What cuts left, larger ones first.
    cuts: Vec<Reduction>,
}

impl Way<'_> {
    /// The best of `size` Gaussians.
    fn at(&mut self, size: usize) -> Result<Tried> {
        let mut journal = Journal::default();
        let all = self.ranked.ranking.order().len();
        let prefix = |size: usize| Reduction::pruned(self.ranked.ranking.take(size), &self.search.rule);
        let reduction = match (&self.search.refine, &mut self.walk) {
            (Some(refine), Some(walk)) if size < all => {
                let first = refine.first(size, all);
                let mut start = self.cuts.iter().rfind(|cut| cut.len() >= size).cloned();
                let mut start = start.take().filter(|_| first > size).unwrap_or_else(|| prefix(first));
                while start.len() > size {
                    let next = ((CUT * start.len() as f64).ceil() as usize).max(size);
                    start = walk.cut_down(&start, next, size)?;
                    if next > size {
                        self.cuts.push(start.clone());
                    }
                }
                walk.best_of(start, &mut journal)?
            }
            _ => prefix(size),
        };
        let found = self.gauge.measure(&*self.scene.input.reduced(&reduction)?)?;
        Ok(Tried { reduction, found, journal })
    }
}
