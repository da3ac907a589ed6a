//! What ranking is made of: the pictures of the first look, the rounds, the percentiles of the scores.

use std::collections::BTreeMap;
use std::num::NonZeroU32;

use super::Bench;
use crate::error::Result;
use crate::evaluation::cost::Cost;
use crate::evaluation::precision::{
    ADDED, KEPT, PERCENTILES, PICTURES, PrecisionCurve, PrecisionKnob, PrecisionSetting, STAYING, Source, added, apart,
    relative_l2,
};
use crate::journal::Journal;
use crate::pipeline::stages::measure::Measure;
use crate::pipeline::stages::rounds::Rounds;
use crate::pruning::contribution::VisibleContribution;
use crate::pruning::score::{Scored, UserOverrides};
use crate::pruning::visible::Visible;
use crate::pruning::{Overrides, select};
use crate::recipe::{self, Recipe};
use crate::statistics::score::sketch::MOST_BITS;
use crate::statistics::score::{Graded, PercentilePasses, Scores, score_by};

/// Pictures of a look or a round: numbers that are tried, as far as there are so many.
const PICTURES_TRIED: [usize; 9] = [6, 12, 25, 50, 100, 200, 400, 800, 1600];
/// Pictures of a round: the most that are tried.
const MOST_IN_ROUNDS: usize = 400;
/// Strides that are tried.
const STRIDES: [u32; 4] = [16, 8, 4, 2];
/// Parts that a round leaves.
const FRACTIONS: [f64; 7] = [0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95];
/// Mantissa bits of a sketch.
const BITS: [u32; 8] = [1, 2, 3, 5, 7, 9, 11, MOST_BITS];

/// A ranking, and what it took.
struct TriedRanking {
    value: f64,
    step: f64,
    cost: Cost,
    /// Errors that are known without the finest ranking.
    errors: BTreeMap<String, f64>,
    kept: Vec<u32>,
}

/// A way to look: a recipe, and where on a curve it stands.
struct RankingVariant {
    value: f64,
    step: f64,
    recipe: Recipe,
}

impl Bench<'_> {
    /// The first look: how many pictures, and every how many-th pixel, view and frame. None where nothing is looked at.
    pub(super) fn look(&self) -> Result<Option<PrecisionKnob>> {
        let all = self.scene.schedule.pairs();
        let way = |value: f64, step: f64, change: &dyn Fn(&mut recipe::ScanParams)| {
            let mut recipe = self.recipe.clone();
            let one = NonZeroU32::MIN;
            let scan = &mut recipe.scan;
            (scan.look_pictures, scan.pixel_stride, scan.view_stride, scan.frame_stride) = (0, one, one, one);
            change(scan);
            RankingVariant { value, step, recipe }
        };
        let (finest, cost) = self.seen_at_cost(&way(1.0, 1.0, &|_| ()).recipe)?;
        let Some(finest) = finest else { return Ok(None) };
        let own = Some(self.recipe.scan.look_pictures).filter(|&own| own > 0 && own < all).unwrap_or(all);
        let counts = tried(PICTURES_TRIED.into_iter().chain([own]).filter(|&count| count < all));
        let counts =
            counts.into_iter().map(|n| way(n as f64, 1.0 / n as f64, &|scan| scan.look_pictures = n)).collect();
        let last = (all as f64, 1.0 / all.max(1) as f64);
        let mut curves = vec![self.looks("look_pictures", counts, (last, &finest, &cost), Some(own as f64))?];
        let seen = self.scene.schedule.iter().filter(|views| !views.is_empty()).count();
        let views = self.scene.schedule.most_views();
        type Set = fn(&mut recipe::ScanParams, NonZeroU32);
        let strides: [(&str, usize, Set); 3] = [
            ("pixel_stride", usize::MAX, |scan, stride| scan.pixel_stride = stride),
            ("view_stride", views, |scan, stride| scan.view_stride = stride),
            ("frame_stride", seen, |scan, stride| scan.frame_stride = stride),
        ];
        for (name, most, set) in strides {
            let strides =
                STRIDES.into_iter().filter_map(NonZeroU32::new).filter(|stride| stride.get() as usize <= most);
            let value = |stride: NonZeroU32| f64::from(stride.get());
            let ways = strides.map(|n| way(value(n), value(n), &|scan| set(scan, n))).collect();
            curves.push(self.looks(name, ways, ((1.0, 1.0), &finest, &cost), None)?);
        }
        Ok(Some(PrecisionKnob {
            name: "look".to_owned(),
            about: "The first look: contributions C and W of every Gaussian from some of the pictures, and which Gaussians \
                    the scores of these keep, before any round."
                .to_owned(),
            source: Source::Discretisation,
            curves,
        }))
    }

    /// What the look of `recipe` sees, if it looks.
    fn seen(&self, recipe: &Recipe) -> Result<Option<VisibleContribution>> {
        let measure = Measure::new(recipe, self.scene.has_cameras, UserOverrides::default());
        let look = |visible: &Visible| visible.run(self.scene, &self.scanned.rows.life, &mut Journal::default());
        measure.visible.as_ref().map(look).transpose()
    }

    /// The same, and what that takes.
    fn seen_at_cost(&self, recipe: &Recipe) -> Result<(Option<VisibleContribution>, Cost)> {
        self.repeats.measure(|| self.seen(recipe), || Ok(()))
    }

    /// A curve of looks, at the end of which stands the `finest` one.
    fn looks(
        &self,
        name: &str,
        ways: Vec<RankingVariant>,
        ((value, step), finest, cost): ((f64, f64), &VisibleContribution, &Cost),
        own: Option<f64>,
    ) -> Result<PrecisionCurve> {
        let best = self.scored(Some(finest.clone()))?;
        let of = |value: f64, step: f64, seen: VisibleContribution, cost: Cost| -> Result<TriedRanking> {
            let l2 = |of: fn(&VisibleContribution) -> &Vec<f64>| {
                relative_l2(of(&seen).iter().copied(), of(finest).iter().copied())
            };
            let [c, w] = [l2(|seen| &seen.coverage), l2(|seen| &seen.peak)];
            let scored = self.scored(Some(seen))?;
            let staying = off(scored.selection.counts.kept, best.selection.counts.kept);
            let errors = [("C", c), ("W", w), (STAYING, staying)].map(|(of, error)| (of.to_owned(), error)).into();
            Ok(TriedRanking { value, step, cost, errors, kept: scored.ranked().take(self.kept) })
        };
        let mut tried = Vec::with_capacity(ways.len() + 1);
        for RankingVariant { value, step, recipe } in ways {
            if let (Some(seen), cost) = self.seen_at_cost(&recipe)? {
                tried.push(of(value, step, seen, cost)?);
            }
        }
        tried.push(of(value, step, finest.clone(), cost.clone())?);
        self.curve(name, "all pixels of all these pictures", tried, own, &[])
    }

    /// Scores by what was scanned and `seen`.
    fn scored(&self, seen: Option<VisibleContribution>) -> Result<Scored> {
        let measure = Measure::new(self.recipe, self.scene.has_cameras, UserOverrides::default());
        measure.score.run(self.scene, self.scanned.clone(), seen, &mut Journal::default())
    }

    /// Rounds of more and of fewer pictures, and of larger and of smaller cuts. None where nothing is looked at.
    pub(super) fn rounds(&self) -> Result<Option<PrecisionKnob>> {
        let Some(seen) = self.seen(self.recipe)? else { return Ok(None) };
        let scored = self.scored(Some(seen))?;
        let own = &self.recipe.select;
        let most = self.scene.schedule.pairs().min(MOST_IN_ROUNDS);
        let own_pictures = own.round_pictures.min(most);
        let mut by_pictures = Vec::new();
        for count in tried(PICTURES_TRIED.into_iter().filter(|&count| count < most).chain([own_pictures, most])) {
            let select = recipe::Select { round_pictures: count, ..own.clone() };
            by_pictures.push(self.ranked(&scored, &select, count as f64, 1.0 / count as f64)?);
        }
        let mut fractions: Vec<f64> = FRACTIONS.into_iter().chain([own.round_fraction]).filter(|&f| f < 1.0).collect();
        fractions.sort_unstable_by(f64::total_cmp);
        fractions.dedup();
        let mut by_fraction = Vec::new();
        for fraction in fractions {
            let select = recipe::Select { round_fraction: fraction, ..own.clone() };
            by_fraction.push(self.ranked(&scored, &select, fraction, -fraction.ln())?);
        }
        let own = (Some(own_pictures as f64), Some(own.round_fraction));
        let curves = vec![
            self.curve("round_pictures", "the most pictures", by_pictures, own.0, &[])?,
            self.curve("round_fraction", "the smallest cuts", by_fraction, own.1, &[])?,
        ];
        Ok(Some(PrecisionKnob {
            name: "rounds".to_owned(),
            about:
                "Rounds that rank anew by what pictures would lose: pictures of each, and the part that each leaves."
                    .to_owned(),
            source: Source::Discretisation,
            curves,
        }))
    }

    /// What rounds of `select` keep.
    fn ranked(&self, scored: &Scored, select: &recipe::Select, value: f64, step: f64) -> Result<TriedRanking> {
        let rounds = Rounds::from_recipe(select, None);
        let rank = || {
            let order = match &rounds {
                Some(rounds) => rounds.rank(self.scene, scored, scored.ranked(), self.kept, &mut Journal::default())?,
                None => scored.ranked(),
            };
            Ok(order.take(self.kept))
        };
        let (kept, cost) = self.repeats.measure(rank, || Ok(()))?;
        Ok(TriedRanking { value, step, cost, errors: BTreeMap::new(), kept })
    }

    /// Percentiles from one look at the values, by more and fewer bits, beside exact ones.
    pub(super) fn percentiles(&self) -> Result<PrecisionKnob> {
        let scored = self.scored(self.seen(self.recipe)?)?;
        let rows = scored.rows()?;
        let frames = self.scene.source().info().times.len();
        let by = |looks: PercentilePasses| -> Result<(Scores, Cost)> {
            self.repeats.measure(|| Ok(score_by(looks, &rows, frames, &self.recipe.score)), || Ok(()))
        };
        let (exact, cost) = by(PercentilePasses::Two)?;
        let staying = scored.selection.counts.kept;
        let of = |value: f64, step: f64, scores: &Scores, cost: Cost| -> Result<TriedRanking> {
            let selection = select(scores, &self.recipe.select, &Overrides::default())?;
            let errors = [(PERCENTILES, worst(scores, &exact)), (STAYING, off(selection.counts.kept, staying))];
            let errors = errors.map(|(of, error)| (of.to_owned(), error)).into();
            Ok(TriedRanking { value, step, cost, errors, kept: selection.ranking.take(self.kept) })
        };
        let mut tried = Vec::with_capacity(BITS.len() + 1);
        for bits in BITS {
            let (scores, cost) = by(PercentilePasses::One(bits))?;
            tried.push(of(f64::from(bits), 0.5f64.powi(bits as i32), &scores, cost)?);
        }
        let own = f64::from(MOST_BITS + 1);
        tried.push(of(own, 0.0, &exact, cost)?);
        let against = "exact percentiles from two looks, as every run has them (the last mark)";
        // Half a bucket at most, and buckets halve with every bit.
        let curve = self.curve("mantissa bits", against, tried, Some(own), &[(PERCENTILES, 1.0)])?;
        Ok(PrecisionKnob {
            name: "percentiles".to_owned(),
            about: "Percentiles from one look at the values: mantissa bits of the histogram's keys.".to_owned(),
            source: Source::Discretisation,
            curves: vec![curve],
        })
    }

    /// A curve of rankings, of which the last is the finest.
    fn curve(
        &self,
        name: &str,
        against: &str,
        tried: Vec<TriedRanking>,
        own: Option<f64>,
        expected: &[(&str, f64)],
    ) -> Result<PrecisionCurve> {
        let mut marks = Vec::with_capacity(tried.len());
        let Some(finest) = tried.last().map(|last| last.kept.clone()) else {
            return Ok(PrecisionCurve::new(name, against, marks, None, expected));
        };
        let best = self.judge.closeness(self.scene, &finest)?;
        for TriedRanking { value, step, cost, mut errors, kept } in tried {
            let found = if kept == finest { best } else { self.judge.closeness(self.scene, &kept)? };
            errors.extend(
                [(KEPT, apart(&kept, &finest)), (PICTURES, found.error), (ADDED, added(found.error, best.error))]
                    .map(|(of, error)| (of.to_owned(), error)),
            );
            marks.push(PrecisionSetting { value, step, cost, errors, psnr: Some(found.psnr) });
            self.advance();
        }
        Ok(PrecisionCurve::new(name, against, marks, own, expected))
    }
}

/// Rising, each once.
fn tried(counts: impl Iterator<Item = usize>) -> Vec<usize> {
    let mut counts: Vec<usize> = counts.collect();
    counts.sort_unstable();
    counts.dedup();
    counts
}

/// Relative error of a count.
fn off(count: usize, expected: usize) -> f64 {
    (count as f64 / expected.max(1) as f64 - 1.0).abs()
}

/// The worst relative error of a percentile that scores are normalized by; those of scores of scores aside, whose values
/// differ themselves.
fn worst(scores: &Scores, exact: &Scores) -> f64 {
    let pairs = scores.terms.iter().zip(&exact.terms);
    let pairs = pairs.filter(|(term, _)| !matches!(term.of, Graded::Static | Graded::Dynamic));
    let errors = pairs.flat_map(|(rough, exact)| {
        [(rough.norm.p1, exact.norm.p1), (rough.norm.p99, exact.norm.p99)]
            .map(|(rough, exact)| if exact == 0.0 { 0.0 } else { (rough / exact - 1.0).abs() })
    });
    errors.fold(0.0, f64::max)
}
