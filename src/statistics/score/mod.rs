//! Robust normalization and scores (method.md, sections 2 and 3).
//!
//! Input: rows of statistics. Output: the score S of every Gaussian, its static and its dynamic part, and both parts
//! normalized. Memory: at most six f64 per Gaussian, and one histogram at a time. Source: "Temporally-Aware Pruning for
//! Compact 4D Gaussian Splatting Models", section 3.2.

mod norm;
pub mod percentile_sketch;

pub use norm::{Norm, PercentilePasses};
pub use percentile_sketch::FloatSketch;

use serde::{Deserialize, Serialize};

use crate::model::{AnomalyFlags, Statistic, StatisticRows};
use crate::recipe::{self, StaticScoreTerm};

/// Scores of N Gaussians; every array has N entries, all finite.
#[derive(Debug, Clone, PartialEq)]
pub struct Scores {
    /// Static score S_static = norm(C) + λ·norm(E), from contribution C and anisotropy E. The recipe may replace C by
    /// the largest weight W or by √(C·W).
    pub static_score: Vec<f64>,
    /// Dynamic score S_dynamic = norm(D) + μ·norm(κ) + η·norm(V) + ξ·norm(Life), from trajectory magnitude D, curvature
    /// κ, opacity variance V, and the fraction of frames in which the Gaussian is alive.
    pub dynamic_score: Vec<f64>,
    /// Score S = w_s·S_static + w_d·S_dynamic, by which Gaussians are ranked.
    pub score: Vec<f64>,
    /// Normalized static score norm(S_static), which the second stage of the selection compares with a threshold.
    pub static_norm: Vec<f64>,
    /// Normalized dynamic score norm(S_dynamic), which the second stage of the selection compares with a threshold.
    pub dynamic_norm: Vec<f64>,
    /// Normalization of every term of the scores: first the terms of S_static, then the terms of S_dynamic, then
    /// S_static and S_dynamic themselves. Terms of weight 0 are not computed and are missing.
    pub terms: Vec<Term>,
}

impl Scores {
    /// Bytes of memory that the scores of one Gaussian take.
    pub const BYTES_PER_GAUSSIAN: usize = 5 * size_of::<f64>();
}

/// Term of a score: a quantity and its normalization.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Term {
    /// Quantity that this term normalizes, such as the contribution of a Gaussian.
    #[serde(rename = "of")]
    pub quantity: ScoredQuantity,
    /// Normalization of the quantity, from its percentiles over all Gaussians.
    pub norm: Norm,
}

/// Quantity by which Gaussians are scored: a statistic, or a combination of several.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ScoredQuantity {
    /// A single statistic.
    By(Statistic),
    /// √(C·W): geometric mean of the contribution C and the largest weight W in any pixel.
    Geometric,
    /// Static score S_static, computed from contribution and anisotropy.
    Static,
    /// Dynamic score S_dynamic, computed from motion, opacity variance and life span.
    Dynamic,
}

impl From<StaticScoreTerm> for ScoredQuantity {
    fn from(term: StaticScoreTerm) -> ScoredQuantity {
        match term {
            StaticScoreTerm::Mean => ScoredQuantity::By(Statistic::C),
            StaticScoreTerm::Peak => ScoredQuantity::By(Statistic::W),
            StaticScoreTerm::Geometric => ScoredQuantity::Geometric,
        }
    }
}

impl ScoredQuantity {
    /// Returns the name of the quantity in summaries and reports.
    pub fn name(self) -> &'static str {
        match self {
            ScoredQuantity::By(statistic) => statistic.name(),
            ScoredQuantity::Geometric => "sqrt(C*W)",
            ScoredQuantity::Static => "S_static",
            ScoredQuantity::Dynamic => "S_dynamic",
        }
    }

    /// Returns whether the quantity describes how a Gaussian moves or how its opacity changes.
    pub fn describes_motion(self) -> bool {
        use Statistic::{D, Kappa, V};
        matches!(self, ScoredQuantity::By(D | Kappa | V) | ScoredQuantity::Dynamic)
    }

    /// Returns in words which property of a Gaussian the quantity measures.
    pub fn measured_property(self) -> &'static str {
        match self {
            ScoredQuantity::By(statistic) => statistic.measured_property(),
            ScoredQuantity::Geometric => Statistic::C.measured_property(),
            ScoredQuantity::Static => "the static score",
            ScoredQuantity::Dynamic => "the dynamic score",
        }
    }
}

/// Computes the scores of the Gaussians with the statistics `rows`. The sequence has `frames` frames.
///
/// Rows with [`AnomalyFlags::NON_FINITE`] are excluded from the percentiles, and their scores are 0. The anisotropy
/// `rows.e` is used only if its weight λ is above 0. An empty list of rows gives empty scores.
pub fn score(rows: &StatisticRows, frames: usize, recipe: &recipe::ScoreParams) -> Scores {
    score_with_passes(PercentilePasses::Two, rows, frames, recipe)
}

/// Computes the scores of the Gaussians with the statistics `rows` in a sequence of `frames` frames, like [`score`].
/// `passes` selects how percentiles are found: exactly, in two passes over the values, or approximately, in one.
pub fn score_with_passes(
    passes: PercentilePasses,
    rows: &StatisticRows,
    frames: usize,
    recipe: &recipe::ScoreParams,
) -> Scores {
    use ScoredQuantity::By;
    use Statistic::{C, D, E, Kappa, Life, V, W};
    let is_finite: Vec<bool> = rows.flags.iter().map(|flags| !flags.contains(AnomalyFlags::NON_FINITE)).collect();
    let life = |i: usize| f64::from(rows.life[i]) / frames.max(1) as f64;
    let motion_weight = |i: usize| if recipe.weigh_motion_by_life { life(i) } else { 1.0 };

    let mut sum = Summation { is_finite: &is_finite, recipe, passes, terms: Vec::new() };
    let mut static_score = vec![0.0; rows.len()];
    match recipe.static_term {
        StaticScoreTerm::Peak if !rows.w.is_empty() => sum.add_term(&mut static_score, By(W), 1.0, |i| rows.w[i]),
        StaticScoreTerm::Geometric if !rows.w.is_empty() => {
            sum.add_term(&mut static_score, ScoredQuantity::Geometric, 1.0, |i| (rows.c[i] * rows.w[i]).sqrt());
        }
        _ => sum.add_term(&mut static_score, By(C), 1.0, |i| rows.c[i]),
    }
    sum.add_term(&mut static_score, By(E), recipe.lambda, |i| rows.e[i]);
    let mut dynamic_score = vec![0.0; rows.len()];
    sum.add_term(&mut dynamic_score, By(D), 1.0, |i| rows.d[i] * motion_weight(i));
    sum.add_term(&mut dynamic_score, By(Kappa), recipe.mu, |i| rows.kappa[i] * motion_weight(i));
    sum.add_term(&mut dynamic_score, By(V), recipe.eta, |i| rows.v[i]);
    sum.add_term(&mut dynamic_score, By(Life), recipe.xi, life);

    let score =
        static_score.iter().zip(&dynamic_score).map(|(s, d)| recipe.w_static * s + recipe.w_dynamic * d).collect();
    let mut static_norm = vec![0.0; rows.len()];
    sum.add_term(&mut static_norm, ScoredQuantity::Static, 1.0, |i| static_score[i]);
    let mut dynamic_norm = vec![0.0; rows.len()];
    sum.add_term(&mut dynamic_norm, ScoredQuantity::Dynamic, 1.0, |i| dynamic_score[i]);
    let terms = sum.terms;
    Scores { static_score, dynamic_score, score, static_norm, dynamic_norm, terms }
}

/// Data that all terms share while the scores, which are weighted sums of normalized quantities, are computed.
struct Summation<'a> {
    is_finite: &'a [bool],
    recipe: &'a recipe::ScoreParams,
    passes: PercentilePasses,
    terms: Vec<Term>,
}

impl Summation<'_> {
    /// Adds `weight` · norm(`value(i)`) to `total[i]` for every Gaussian i whose statistics are finite. Appends
    /// `quantity` and its normalization to the list of terms. Does nothing if the weight is 0.
    fn add_term(&mut self, total: &mut [f64], quantity: ScoredQuantity, weight: f64, value: impl Fn(usize) -> f64) {
        if weight == 0.0 {
            return;
        }
        let counted = || (0..total.len()).filter(|&i| self.is_finite[i]);
        let norm = Norm::from_values(|| counted().map(&value), self.recipe, self.passes);
        for (i, total) in total.iter_mut().enumerate() {
            if self.is_finite[i] {
                *total += weight * norm.apply(value(i));
            }
        }
        self.terms.push(Term { quantity, norm });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;

    fn rows(n: usize) -> StatisticRows {
        let ramp = |scale: f64| (0..n).map(|i| scale * i as f64).collect::<Vec<f64>>();
        StatisticRows {
            d: ramp(0.1),
            kappa: ramp(0.01),
            v: ramp(1e-3),
            life: (0..n as u32).collect(),
            c: ramp(3.0),
            w: Vec::new(),
            e: ramp(2.0),
            vis: ramp(0.0),
            flags: vec![AnomalyFlags::empty(); n],
        }
    }

    fn preset(name: &str) -> recipe::ScoreParams {
        Recipe::preset(name).unwrap().score
    }

    #[test]
    fn paper_scores_equal_the_formulas_written_out() {
        let rows = rows(1000);
        let recipe = recipe::ScoreParams {
            lambda: 0.3,
            mu: 0.7,
            eta: 0.9,
            xi: 0.2,
            w_static: 1.5,
            w_dynamic: 2.5,
            ..preset("paper")
        };
        let scores = score(&rows, 2000, &recipe);
        // Every statistic is a ramp of 0 to 999 steps: by nearest rank, P1 is step 9 and P99 is step 989.
        let norm = |i: usize, scale: f64| (i as f64 - 9.0) * scale / (980.0 * scale + 1e-8);
        for i in [0, 9, 500, 989, 999] {
            let static_score = norm(i, 3.0) + 0.3 * norm(i, 2.0);
            let dynamic_score = norm(i, 0.1) + 0.7 * norm(i, 0.01) + 0.9 * norm(i, 1e-3) + 0.2 * norm(i, 1.0 / 2000.0);
            let expected = 1.5 * static_score + 2.5 * dynamic_score;
            assert!((scores.score[i] - expected).abs() < 1e-12, "{i}: got {}, expected {expected}", scores.score[i]);
            assert!((scores.static_norm[i] - norm(i, 1.0)).abs() < 1e-7);
        }
        let names: Vec<&str> = scores.terms.iter().map(|term| term.quantity.name()).collect();
        assert_eq!(names, ["C", "E", "D", "kappa", "V", "Life", "S_static", "S_dynamic"]);
    }

    #[test]
    fn terms_of_weight_zero_are_left_out() {
        let mut rows = rows(100);
        rows.e = vec![f64::NAN; 100];
        let scores = score(&rows, 100, &preset("default"));
        assert!(
            scores
                .terms
                .iter()
                .all(|term| ![Statistic::E, Statistic::Life].map(ScoredQuantity::By).contains(&term.quantity))
        );
        assert!(scores.score.iter().all(|s| s.is_finite()));
    }

    #[test]
    fn flagged_rows_do_not_change_percentiles() {
        let clean = rows(500);
        let mut odd = rows(500);
        let zeros = StatisticRows {
            d: vec![0.0; 200],
            kappa: vec![0.0; 200],
            v: vec![0.0; 200],
            life: vec![0; 200],
            c: vec![0.0; 200],
            w: Vec::new(),
            e: vec![0.0; 200],
            vis: vec![0.0; 200],
            flags: vec![AnomalyFlags::NON_FINITE; 200],
        };
        odd.append(&mut zeros.clone());
        for name in ["paper", "default"] {
            let (expected, got) = (score(&clean, 9, &preset(name)), score(&odd, 9, &preset(name)));
            assert_eq!(got.terms, expected.terms);
            assert_eq!(got.score[..500], expected.score);
            assert!(got.score[500..].iter().all(|&s| s == 0.0));
        }
    }

    #[test]
    fn static_scene_has_inactive_dynamic_terms() {
        let mut rows = rows(300);
        for values in [&mut rows.d, &mut rows.kappa, &mut rows.v] {
            values.fill(0.0);
        }
        for name in ["paper", "default"] {
            let scores = score(&rows, 300, &preset(name));
            assert!(scores.dynamic_score.iter().chain(&scores.dynamic_norm).all(|&s| s == 0.0));
            let inactive: Vec<_> =
                scores.terms.iter().filter(|t| !t.norm.has_spread()).map(|t| t.quantity.name()).collect();
            assert_eq!(inactive, ["D", "kappa", "V", "S_dynamic"]);
        }
    }

    #[test]
    fn about_one_percent_of_movers_all_get_the_top_score() {
        for movers in [9, 10, 11] {
            let mut rows = rows(1000);
            rows.d = (0..1000).map(|i| if i < movers { 5.0 } else { 0.0 }).collect();
            (rows.kappa, rows.v) = (vec![0.0; 1000], vec![0.0; 1000]);
            let scores = score(&rows, 10, &preset("default"));
            for (i, &norm) in scores.dynamic_norm.iter().enumerate() {
                assert_eq!(norm, f64::from(u8::from(i < movers)), "{movers} movers, Gaussian {i}");
            }
        }
    }

    #[test]
    fn zero_rows_and_one_row_are_scored() {
        let none = score(&StatisticRows::default(), 0, &preset("default"));
        assert!(none.score.is_empty());
        let one = score(&rows(1), 1, &preset("paper"));
        assert_eq!(one.score, [0.0]);
    }

    #[test]
    fn motion_can_be_weighted_by_the_life_span() {
        let mut rows = rows(200);
        rows.life = vec![50; 200];
        let plain = score(&rows, 100, &preset("paper"));
        let weighed = score(&rows, 100, &recipe::ScoreParams { weigh_motion_by_life: true, ..preset("paper") });
        let d = |scores: &Scores| {
            scores.terms.iter().find(|t| t.quantity == ScoredQuantity::By(Statistic::D)).unwrap().norm.p99
        };
        assert_eq!(d(&weighed), 0.5 * d(&plain));
    }
}
