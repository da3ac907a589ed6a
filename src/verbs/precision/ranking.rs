//! What ranking is made of: the pictures of the first look, the rounds, the percentiles of the scores.

use std::collections::BTreeMap;
use std::num::NonZeroU32;

use super::Bench;
use super::found::{ADDED, Curve, KEPT, Knob, Mark, PERCENTILES, PICTURES, STAYING, Source, added, apart, relative_l2};
use crate::compress::journal::Journal;
use crate::compress::measure::Measure;
use crate::compress::rounds::Rounds;
use crate::compress::score::{Scored, UserOverrides};
use crate::error::Result;
use crate::recipe::{self, Recipe};
use crate::score::sketch::MOST_BITS;
use crate::score::{Looks, Scores, score_by};
use crate::select::{Overrides, select};
use crate::stats::snap;
use crate::stream::Seen;
use crate::verbs::cost::Cost;

/// Pictures of a look or a round: numbers that are tried, as far as there are so many.
const PICTURES_TRIED: [usize; 9] = [6, 12, 25, 50, 100, 200, 400, 800, 1600];
/// Pictures of a round: the most that are tried.
const MOST_IN_ROUNDS: usize = 400;
/// Strides that are tried.
const STRIDES: [u32; 4] = [16, 8, 4, 2];
/// Parts that a round leaves.
const FRACTIONS: [f64; 7] = [0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95];
/// Mantissa bits of a sketch.
const BITS: [u32; 9] = [1, 2, 3, 5, 7, 9, 11, 13, MOST_BITS];

/// A ranking, and what it took.
struct Tried {
    value: f64,
    step: f64,
    cost: Cost,
    /// Errors that are known without the finest ranking.
    errors: BTreeMap<String, f64>,
    kept: Vec<u32>,
}

/// What a look at pictures came to.
struct Looked {
    value: f64,
    step: f64,
    seen: Seen,
    cost: Cost,
}

impl Bench<'_> {
    /// The first look: how many pictures, and every how many-th pixel, view and frame.
    pub(super) fn look(&self) -> Result<Knob> {
        let all = self.scene.schedule.pairs();
        let recipe = |change: &dyn Fn(&mut Recipe)| {
            let mut recipe = self.recipe.clone();
            let one = NonZeroU32::MIN;
            let scan = &mut recipe.scan;
            (scan.look_pictures, scan.pixel_stride, scan.view_stride, scan.frame_stride) = (0, one, one, one);
            change(&mut recipe);
            recipe
        };
        let finest = self.look_by(&recipe(&|_| ()), all as f64, 1.0 / all.max(1) as f64)?;
        let mut curves = Vec::new();
        let mut counts = Vec::new();
        for count in PICTURES_TRIED.into_iter().filter(|&count| count < all) {
            let recipe = recipe(&|recipe| recipe.scan.look_pictures = count);
            counts.push(self.look_by(&recipe, count as f64, 1.0 / count as f64)?);
        }
        let own = self.recipe.scan.look_pictures;
        curves.push(self.looks(
            "look_pictures",
            counts,
            &finest,
            Some(own).filter(|&own| own < all).unwrap_or(all) as f64,
        )?);
        let seen = self.scene.schedule.iter().filter(|views| !views.is_empty()).count();
        let views = self.scene.schedule.most_views();
        type Set = fn(&mut Recipe, NonZeroU32);
        let strides: [(&str, usize, Set); 3] = [
            ("pixel_stride", usize::MAX, |recipe, stride| recipe.scan.pixel_stride = stride),
            ("view_stride", views, |recipe, stride| recipe.scan.view_stride = stride),
            ("frame_stride", seen, |recipe, stride| recipe.scan.frame_stride = stride),
        ];
        for (name, most, set) in strides {
            let mut looks = Vec::new();
            for stride in STRIDES.into_iter().filter_map(NonZeroU32::new).filter(|stride| stride.get() as usize <= most)
            {
                let value = f64::from(stride.get());
                looks.push(self.look_by(&recipe(&|recipe| set(recipe, stride)), value, value)?);
            }
            let finest = Looked { value: 1.0, step: 1.0, seen: finest.seen.clone(), cost: finest.cost.clone() };
            curves.push(self.looks(name, looks, &finest, f64::NAN)?);
        }
        Ok(Knob {
            name: "look".to_owned(),
            about: "The first look: contributions C and W of every Gaussian from some of the pictures, and which Gaussians \
                    the scores of these keep, before any round."
                .to_owned(),
            source: Source::Discretisation,
            curves,
        })
    }

    /// The look of `recipe`.
    fn look_by(&self, recipe: &Recipe, value: f64, step: f64) -> Result<Looked> {
        let measure = Measure::new(recipe, self.scene.has_cameras, UserOverrides::default());
        let look = || match &measure.visible {
            Some(visible) => visible.run(self.scene, &self.scanned.rows.life, &mut Journal::default()),
            None => Ok(Seen { coverage: Vec::new(), peak: Vec::new() }),
        };
        let (seen, cost) = self.repeats.measure(look, || Ok(()))?;
        Ok(Looked { value, step, seen, cost })
    }

    /// A curve of looks beside the `finest` one.
    fn looks(&self, name: &str, looks: Vec<Looked>, finest: &Looked, own: f64) -> Result<Curve> {
        let against = "all pixels of all pictures";
        let best = self.scored(finest.seen.clone())?;
        let mut tried = Vec::new();
        for look in looks.iter().chain([finest]) {
            let scored = self.scored(look.seen.clone())?;
            let l2 = |of: fn(&Seen) -> &Vec<f64>| {
                relative_l2(of(&look.seen).iter().copied(), of(&finest.seen).iter().copied())
            };
            let errors = [
                ("C", l2(|seen| &seen.coverage)),
                ("W", l2(|seen| &seen.peak)),
                (STAYING, off(scored.selection.counts.kept, best.selection.counts.kept)),
            ];
            tried.push(Tried {
                value: look.value,
                step: look.step,
                cost: look.cost.clone(),
                errors: errors.map(|(of, error)| (of.to_owned(), error)).into(),
                kept: scored.ranked().take(self.kept),
            });
        }
        self.curve(name, against, tried, own, &[])
    }

    /// Scores by what was scanned and `seen`.
    fn scored(&self, seen: Seen) -> Result<Scored> {
        let measure = Measure::new(self.recipe, self.scene.has_cameras, UserOverrides::default());
        measure.score.run(self.scene, self.scanned.clone(), Some(seen), &mut Journal::default())
    }

    /// Rounds of more and of fewer pictures, and of larger and of smaller cuts.
    pub(super) fn rounds(&self) -> Result<Knob> {
        let scored = self.scored(self.look_by(self.recipe, 0.0, 0.0)?.seen)?;
        let own = &self.recipe.select;
        let most = self.scene.schedule.pairs().min(MOST_IN_ROUNDS);
        let mut counts: Vec<usize> = PICTURES_TRIED
            .into_iter()
            .filter(|&count| count < most)
            .chain([own.round_pictures.min(most), most])
            .collect();
        counts.sort_unstable();
        counts.dedup();
        let mut by_pictures = Vec::new();
        for count in counts {
            let select = recipe::Select { round_pictures: count, ..own.clone() };
            by_pictures.push(self.ranked(&scored, &select, count as f64, 1.0 / count as f64)?);
        }
        let mut by_fraction = Vec::new();
        for fraction in FRACTIONS {
            let select = recipe::Select { round_fraction: fraction, ..own.clone() };
            by_fraction.push(self.ranked(&scored, &select, fraction, -fraction.ln())?);
        }
        let curves = vec![
            self.curve("round_pictures", "the most pictures", by_pictures, own.round_pictures as f64, &[])?,
            self.curve("round_fraction", "the smallest cuts", by_fraction, own.round_fraction, &[])?,
        ];
        Ok(Knob {
            name: "rounds".to_owned(),
            about:
                "Rounds that rank anew by what pictures would lose: pictures of each, and the part that each leaves."
                    .to_owned(),
            source: Source::Discretisation,
            curves,
        })
    }

    /// What rounds of `select` keep.
    fn ranked(&self, scored: &Scored, select: &recipe::Select, value: f64, step: f64) -> Result<Tried> {
        let rounds = Rounds::of(select, None);
        let rank = || {
            let order = match &rounds {
                Some(rounds) => rounds.run(self.scene, scored, scored.ranked(), self.kept, &mut Journal::default())?,
                None => scored.ranked(),
            };
            Ok(order.take(self.kept))
        };
        let (kept, cost) = self.repeats.measure(rank, || Ok(()))?;
        Ok(Tried { value, step, cost, errors: BTreeMap::new(), kept })
    }

    /// Percentiles from one look at the values, by more and fewer bits, beside exact ones.
    pub(super) fn percentiles(&self) -> Result<Knob> {
        let seen = self.look_by(self.recipe, 0.0, 0.0)?.seen;
        let mut rows = self.scanned.rows.clone();
        (rows.c, rows.w) = (seen.coverage, seen.peak);
        if self.recipe.scan.snap_noise {
            snap(&mut rows, self.scanned.largest_coordinate);
        }
        let frames = self.scene.source().info().times.len();
        let by = |looks: Looks| -> Result<(Scores, Cost)> {
            self.repeats.measure(|| Ok(score_by(looks, &rows, frames, &self.recipe.score)), || Ok(()))
        };
        let (exact, cost) = by(Looks::Two)?;
        let mut tried = Vec::new();
        let mut looks = Vec::new();
        for bits in BITS {
            let (scores, cost) = by(Looks::One(bits))?;
            looks.push((f64::from(bits), 0.5f64.powi(bits as i32), scores, cost));
        }
        looks.push((f64::from(MOST_BITS + 1), 0.0, exact.clone(), cost));
        let select = |scores: &Scores| select(scores, &self.recipe.select, &Overrides::default());
        let expected = select(&exact)?.counts.kept;
        for (value, step, scores, cost) in looks {
            let selection = select(&scores)?;
            let errors = [(PERCENTILES, worst(&scores, &exact)), (STAYING, off(selection.counts.kept, expected))];
            let errors = errors.map(|(of, error)| (of.to_owned(), error)).into();
            tried.push(Tried { value, step, cost, errors, kept: selection.ranking.take(self.kept) });
        }
        // Half a bucket at most, and buckets halve with every bit.
        let expected = [(PERCENTILES, 1.0)];
        let own = f64::from(MOST_BITS + 1);
        let against = "exact percentiles, as every run has them (the last mark)";
        Ok(Knob {
            name: "percentiles".to_owned(),
            about: "Percentiles from one look at the values: mantissa bits of the histogram's keys.".to_owned(),
            source: Source::Discretisation,
            curves: vec![self.curve("mantissa bits", against, tried, own, &expected)?],
        })
    }

    /// A curve of rankings, of which the last is the finest.
    fn curve(&self, name: &str, against: &str, tried: Vec<Tried>, own: f64, expected: &[(&str, f64)]) -> Result<Curve> {
        let mut marks = Vec::with_capacity(tried.len());
        let Some(finest) = tried.last().map(|last| last.kept.clone()) else {
            return Ok(Curve::new(name, against, marks, None, expected));
        };
        let best = self.judge.closeness(self.scene, &finest)?;
        for Tried { value, step, cost, mut errors, kept } in tried {
            let found = if kept == finest { best } else { self.judge.closeness(self.scene, &kept)? };
            errors.extend(
                [(KEPT, apart(&kept, &finest)), (PICTURES, found.error), (ADDED, added(found.error, best.error))]
                    .map(|(of, error)| (of.to_owned(), error)),
            );
            marks.push(Mark { value, step, cost, errors, psnr: Some(found.psnr) });
            self.advance();
        }
        Ok(Curve::new(name, against, marks, Some(own), expected))
    }
}

/// Relative error of a count.
fn off(count: usize, expected: usize) -> f64 {
    (count as f64 / expected.max(1) as f64 - 1.0).abs()
}

/// The worst relative error of a percentile that scores are normalised by; those of scores of scores aside, whose values
/// differ themselves.
fn worst(scores: &Scores, exact: &Scores) -> f64 {
    let of_statistics = |scores: &Scores| scores.terms[..scores.terms.len() - 2].to_vec();
    let pairs = of_statistics(scores).into_iter().zip(of_statistics(exact));
    let errors = pairs.flat_map(|(rough, exact)| {
        [(rough.norm.p1, exact.norm.p1), (rough.norm.p99, exact.norm.p99)]
            .map(|(rough, exact)| if exact == 0.0 { 0.0 } else { (rough / exact - 1.0).abs() })
    });
    errors.fold(0.0, f64::max)
}
