//! Measurements of the settings of ranking: views of the first ranking by renders, pruning rounds, and percentiles of
//! the scores.

use std::collections::BTreeMap;
use std::num::NonZeroU32;

use super::Bench;
use crate::error::Result;
use crate::evaluation::cost::Cost;
use crate::evaluation::precision::{
    ADDED_ERROR, InaccuracySource, KEPT_COUNT_ERROR, KEPT_SET_JACCARD_DISTANCE, PERCENTILE_ERROR, PrecisionCurve,
    PrecisionKnob, PrecisionSetting, RENDER_ERROR, added_error, jaccard_distance, relative_l2,
};
use crate::journal::Journal;
use crate::pipeline::stages::measure::MeasureStages;
use crate::pipeline::stages::rounds::Rounds;
use crate::pruning::contribution::VisibleContribution;
use crate::pruning::score::{Scored, UserOverrides};
use crate::pruning::select;
use crate::pruning::visibility::VisibilityStage;
use crate::recipe::{self, Recipe};
use crate::statistics::score::percentile_sketch::MAX_MANTISSA_BITS;
use crate::statistics::score::{PercentilePasses, ScoredQuantity, Scores, score_with_passes};

/// Numbers of views that are tried for the first ranking and for a pruning round. Numbers that exceed the number of
/// views of the scene are skipped.
const VIEW_COUNTS: [usize; 9] = [6, 12, 25, 50, 100, 200, 400, 800, 1600];
/// Largest number of views per pruning round that is tried.
const MOST_IN_ROUNDS: usize = 400;
/// Strides of pixels, views and frames that are tried. With a stride of n, every n-th is used.
const STRIDES: [u32; 4] = [16, 8, 4, 2];
/// Values that are tried for the fraction of the Gaussians that a pruning round keeps.
const FRACTIONS: [f64; 7] = [0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95];
/// Numbers of mantissa bits that are tried for the histogram from which percentiles are found. More bits mean narrower
/// bins.
const BITS: [u32; 8] = [1, 2, 3, 5, 7, 9, 11, MAX_MANTISSA_BITS];

/// Result of ranking the Gaussians with one value of the varied parameter.
struct TriedRanking {
    /// Value of the varied parameter.
    value: f64,
    /// Step size h ≥ 0 of this value: how coarse it is, like the mesh width of a numerical method. For example, 1/n for
    /// n views, or n for a stride of n. An error of order p is proportional to h^p.
    step: f64,
    /// Time and memory of the ranking.
    cost: Cost,
    /// Errors of this ranking, by name. Errors that compare `kept` with the Gaussians that the finest setting keeps are
    /// added later, by [`Bench::curve`].
    errors: BTreeMap<String, f64>,
    /// Ids of the Gaussians that the ranking keeps.
    kept: Vec<u32>,
}

/// One setting to measure: a recipe in which one parameter has the value `value`.
struct RankingVariant {
    /// Value of the varied parameter in `recipe`.
    value: f64,
    /// Step size h > 0 of this value: how coarse it is, like the mesh width of a numerical method. For example, 1/n for
    /// n views, or n for a stride of n. An error of order p is proportional to h^p.
    step: f64,
    recipe: Recipe,
}

impl Bench<'_> {
    /// Measures settings of the first ranking by renders: several numbers of views, and several strides of pixels,
    /// views and frames. Returns `None` if the recipe does not rank by renders.
    pub(super) fn first_ranking(&self) -> Result<Option<PrecisionKnob>> {
        let all = self.scene.schedule.pair_count();
        let variant = |value: f64, step: f64, change: &dyn Fn(&mut recipe::ScanParams)| {
            let mut recipe = self.recipe.clone();
            let one = NonZeroU32::MIN;
            let scan = &mut recipe.scan;
            (scan.scoring_views, scan.pixel_stride, scan.view_stride, scan.frame_stride) = (0, one, one, one);
            change(scan);
            RankingVariant { value, step, recipe }
        };
        let (finest, cost) = self.contributions_with_cost(&variant(1.0, 1.0, &|_| ()).recipe)?;
        let Some(finest) = finest else { return Ok(None) };
        let own = Some(self.recipe.scan.scoring_views).filter(|&own| own > 0 && own < all).unwrap_or(all);
        let counts = sorted_distinct(VIEW_COUNTS.into_iter().chain([own]).filter(|&count| count < all));
        let counts =
            counts.into_iter().map(|n| variant(n as f64, 1.0 / n as f64, &|scan| scan.scoring_views = n)).collect();
        let last = (all as f64, 1.0 / all.max(1) as f64);
        let mut curves = vec![self.pass_curve("scoring_views", counts, (last, &finest, &cost), Some(own as f64))?];
        let frames_with_views = self.scene.schedule.iter().filter(|views| !views.is_empty()).count();
        let views = self.scene.schedule.max_views_per_frame();
        type SetStride = fn(&mut recipe::ScanParams, NonZeroU32);
        let strides: [(&str, usize, SetStride); 3] = [
            ("pixel_stride", usize::MAX, |scan, stride| scan.pixel_stride = stride),
            ("view_stride", views, |scan, stride| scan.view_stride = stride),
            ("frame_stride", frames_with_views, |scan, stride| scan.frame_stride = stride),
        ];
        for (name, most, set) in strides {
            let strides =
                STRIDES.into_iter().filter_map(NonZeroU32::new).filter(|stride| stride.get() as usize <= most);
            let value = |stride: NonZeroU32| f64::from(stride.get());
            let variants = strides.map(|n| variant(value(n), value(n), &|scan| set(scan, n))).collect();
            curves.push(self.pass_curve(name, variants, ((1.0, 1.0), &finest, &cost), None)?);
        }
        Ok(Some(PrecisionKnob {
            name: "scoring".to_owned(),
            about:
                "The first pass over the views: contributions C and W of every Gaussian from some of the views, and \
                    which Gaussians the scores based on these keep, before any pruning round."
                    .to_owned(),
            source: InaccuracySource::Discretization,
            curves,
        }))
    }

    /// Renders the views that `recipe` selects and returns the contributions of all Gaussians to them. Returns `None`
    /// if the recipe does not rank by renders.
    fn contributions(&self, recipe: &Recipe) -> Result<Option<VisibleContribution>> {
        let measure = MeasureStages::new(recipe, self.scene.has_cameras, UserOverrides::default());
        let inspect =
            |visible: &VisibilityStage| visible.run(self.scene, &self.scanned.rows.life, &mut Journal::default());
        measure.visible.as_ref().map(inspect).transpose()
    }

    /// Returns the contributions of all Gaussians, as [`Bench::contributions`] does, and the time and memory of
    /// computing them.
    fn contributions_with_cost(&self, recipe: &Recipe) -> Result<(Option<VisibleContribution>, Cost)> {
        self.repeats.measure_cost(|| self.contributions(recipe), || Ok(()))
    }

    /// Ranks the Gaussians with each of `variants` and with the finest setting. Returns the measurements as a curve,
    /// the finest setting last.
    /// - `name`: name of the varied parameter
    /// - third argument: value and step size of the parameter in the finest setting; contributions of the Gaussians,
    ///   measured with this setting; cost (time and memory) of measuring them
    /// - `recipe_value`: value of the parameter in the recipe
    fn pass_curve(
        &self,
        name: &str,
        variants: Vec<RankingVariant>,
        ((value, step), finest, cost): ((f64, f64), &VisibleContribution, &Cost),
        recipe_value: Option<f64>,
    ) -> Result<PrecisionCurve> {
        let best = self.scored(Some(finest.clone()))?;
        let measured =
            |value: f64, step: f64, contributions: VisibleContribution, cost: Cost| -> Result<TriedRanking> {
                let l2 = |field: fn(&VisibleContribution) -> &Vec<f64>| {
                    relative_l2(field(&contributions).iter().copied(), field(finest).iter().copied())
                };
                let [c, w] = [l2(|contributions| &contributions.coverage), l2(|contributions| &contributions.peak)];
                let scored = self.scored(Some(contributions))?;
                let staying = relative_error(scored.selection.counts.kept, best.selection.counts.kept);
                let errors = [("C", c), ("W", w), (KEPT_COUNT_ERROR, staying)]
                    .map(|(name, error)| (name.to_owned(), error))
                    .into();
                Ok(TriedRanking { value, step, cost, errors, kept: scored.ranking().best_ids(self.kept) })
            };
        let mut tried = Vec::with_capacity(variants.len() + 1);
        for RankingVariant { value, step, recipe } in variants {
            if let (Some(contributions), cost) = self.contributions_with_cost(&recipe)? {
                tried.push(measured(value, step, contributions, cost)?);
            }
        }
        tried.push(measured(value, step, finest.clone(), cost.clone())?);
        self.curve(name, "all pixels of all these views", tried, recipe_value, &[])
    }

    /// Computes the scores of all Gaussians and selects the Gaussians to keep. The scores follow from the statistics of
    /// the scan (pass over all frames) and from `contributions`, the contributions of the Gaussians to renders. If the
    /// recipe does not rank by renders, `contributions` is `None` and the scores follow from the statistics alone.
    fn scored(&self, contributions: Option<VisibleContribution>) -> Result<Scored> {
        let measure = MeasureStages::new(self.recipe, self.scene.has_cameras, UserOverrides::default());
        measure.score.run(self.scene, self.scanned.clone(), contributions, &mut Journal::default())
    }

    /// Measures settings of the pruning rounds: several numbers of views per round, and several fractions of the
    /// Gaussians that a round keeps. Returns `None` if the recipe does not rank by renders.
    pub(super) fn rounds(&self) -> Result<Option<PrecisionKnob>> {
        let Some(contributions) = self.contributions(self.recipe)? else { return Ok(None) };
        let scored = self.scored(Some(contributions))?;
        let own = &self.recipe.select;
        let most = self.scene.schedule.pair_count().min(MOST_IN_ROUNDS);
        let own_views = own.round_views.min(most);
        let mut by_views = Vec::new();
        for count in sorted_distinct(VIEW_COUNTS.into_iter().filter(|&count| count < most).chain([own_views, most])) {
            let select = recipe::SelectParams { round_views: count, ..own.clone() };
            by_views.push(self.rank_by(&scored, &select, count as f64, 1.0 / count as f64)?);
        }
        let mut fractions: Vec<f64> = FRACTIONS.into_iter().chain([own.round_fraction]).filter(|&f| f < 1.0).collect();
        fractions.sort_unstable_by(f64::total_cmp);
        fractions.dedup();
        let mut by_fraction = Vec::new();
        for fraction in fractions {
            let select = recipe::SelectParams { round_fraction: fraction, ..own.clone() };
            by_fraction.push(self.rank_by(&scored, &select, fraction, -fraction.ln())?);
        }
        let own = (Some(own_views as f64), Some(own.round_fraction));
        let curves = vec![
            self.curve("round_views", "the largest number of views", by_views, own.0, &[])?,
            self.curve("round_fraction", "the rounds that remove least", by_fraction, own.1, &[])?,
        ];
        Ok(Some(PrecisionKnob {
            name: "rounds".to_owned(),
            about:
                "Pruning rounds, each ranked by removal error: views of each round, and the fraction that each leaves."
                    .to_owned(),
            source: InaccuracySource::Discretization,
            curves,
        }))
    }

    /// Ranks the Gaussians in pruning rounds with the parameters `select`, starting from the scores `scored`. Returns
    /// the ids of the kept Gaussians and the cost (time and memory); the list of errors is empty.
    /// - `value`: value of the varied parameter in `select`
    /// - `step`: step size h of this value (how coarse it is); an error of order p is proportional to h^p
    fn rank_by(&self, scored: &Scored, select: &recipe::SelectParams, value: f64, step: f64) -> Result<TriedRanking> {
        let rounds = Rounds::from_recipe(select, None);
        let rank = || {
            let order = match &rounds {
                Some(rounds) => {
                    rounds.rank(self.scene, scored, scored.ranking(), self.kept, &mut Journal::default())?
                }
                None => scored.ranking(),
            };
            Ok(order.best_ids(self.kept))
        };
        let (kept, cost) = self.repeats.measure_cost(rank, || Ok(()))?;
        Ok(TriedRanking { value, step, cost, errors: BTreeMap::new(), kept })
    }

    /// Measures the errors of percentiles that a histogram finds in one pass over the values, for histograms with
    /// several numbers of mantissa bits. Compares them with exact percentiles. Returns the measurements.
    pub(super) fn percentiles(&self) -> Result<PrecisionKnob> {
        let scored = self.scored(self.contributions(self.recipe)?)?;
        let rows = scored.rows()?;
        let frames = self.scene.source().info().times.len();
        let by = |passes: PercentilePasses| -> Result<(Scores, Cost)> {
            self.repeats.measure_cost(|| Ok(score_with_passes(passes, &rows, frames, &self.recipe.score)), || Ok(()))
        };
        let (exact, cost) = by(PercentilePasses::Two)?;
        let staying = scored.selection.counts.kept;
        let measured = |value: f64, step: f64, scores: &Scores, cost: Cost| -> Result<TriedRanking> {
            let selection = select(scores, &self.recipe.select, &[], &[])?;
            let errors = [
                (PERCENTILE_ERROR, worst_percentile_error(scores, &exact)),
                (KEPT_COUNT_ERROR, relative_error(selection.counts.kept, staying)),
            ];
            let errors = errors.map(|(name, error)| (name.to_owned(), error)).into();
            Ok(TriedRanking { value, step, cost, errors, kept: selection.ranking.best_ids(self.kept) })
        };
        let mut tried = Vec::with_capacity(BITS.len() + 1);
        for bits in BITS {
            let (scores, cost) = by(PercentilePasses::One(bits))?;
            tried.push(measured(f64::from(bits), 0.5f64.powi(bits as i32), &scores, cost)?);
        }
        let own = f64::from(MAX_MANTISSA_BITS + 1);
        tried.push(measured(own, 0.0, &exact, cost)?);
        let against = "exact percentiles from two passes, as in every run (the last mark)";
        // The error is at most half the width of a bucket of the histogram, and each mantissa bit halves this width.
        let curve = self.curve("mantissa bits", against, tried, Some(own), &[(PERCENTILE_ERROR, 1.0)])?;
        Ok(PrecisionKnob {
            name: "percentiles".to_owned(),
            about: "Percentiles from one pass over the values: mantissa bits of the histogram's keys.".to_owned(),
            source: InaccuracySource::Discretization,
            curves: vec![curve],
        })
    }

    /// Returns the errors of the rankings `tried` as a curve. The last ranking has the finest setting and is the
    /// reference. Adds two kinds of errors to each ranking: how its kept Gaussians differ from those of the reference,
    /// and how renders of its kept Gaussians differ from renders of the whole model.
    /// - `name`: name of the varied parameter
    /// - `against`: description of the finest setting, for the user
    /// - `recipe_value`: value of the parameter in the recipe
    /// - `expected`: pairs of the name of an error and the order of convergence that theory predicts for it
    fn curve(
        &self,
        name: &str,
        against: &str,
        tried: Vec<TriedRanking>,
        recipe_value: Option<f64>,
        expected: &[(&str, f64)],
    ) -> Result<PrecisionCurve> {
        let mut marks = Vec::with_capacity(tried.len());
        let Some(finest) = tried.last().map(|last| last.kept.clone()) else {
            return Ok(PrecisionCurve::new(name, against, marks, None, expected));
        };
        let best = self.judge.quality(self.scene, &finest)?;
        for TriedRanking { value, step, cost, mut errors, kept } in tried {
            let found = if kept == finest { best } else { self.judge.quality(self.scene, &kept)? };
            errors.extend(
                [
                    (KEPT_SET_JACCARD_DISTANCE, jaccard_distance(&kept, &finest)),
                    (RENDER_ERROR, found.error),
                    (ADDED_ERROR, added_error(found.error, best.error)),
                ]
                .map(|(name, error)| (name.to_owned(), error)),
            );
            marks.push(PrecisionSetting { value, step, cost, errors, psnr: Some(found.psnr) });
            self.advance();
        }
        Ok(PrecisionCurve::new(name, against, marks, recipe_value, expected))
    }
}

/// Returns the distinct values of `counts` in increasing order.
fn sorted_distinct(counts: impl Iterator<Item = usize>) -> Vec<usize> {
    let mut counts: Vec<usize> = counts.collect();
    counts.sort_unstable();
    counts.dedup();
    counts
}

/// Returns the relative error |count / expected − 1| of `count`, whose correct value is `expected`.
fn relative_error(count: usize, expected: usize) -> f64 {
    (count as f64 / expected.max(1) as f64 - 1.0).abs()
}

/// Returns the largest relative error of the percentiles P1 and P99 in `scores`, by which the terms of the scores (such
/// as motion) are normalized. `exact` holds the correct percentiles. The percentiles of the static and dynamic scores
/// are left out: these scores combine several terms, so their values already differ between `scores` and `exact` before
/// a percentile is taken of them.
fn worst_percentile_error(scores: &Scores, exact: &Scores) -> f64 {
    let pairs = scores.terms.iter().zip(&exact.terms);
    let pairs = pairs.filter(|(term, _)| !matches!(term.quantity, ScoredQuantity::Static | ScoredQuantity::Dynamic));
    let errors = pairs.flat_map(|(rough, exact)| {
        [(rough.norm.p1, exact.norm.p1), (rough.norm.p99, exact.norm.p99)]
            .map(|(rough, exact)| if exact == 0.0 { 0.0 } else { (rough / exact - 1.0).abs() })
    });
    errors.fold(0.0, f64::max)
}
