//! Ranking of all Gaussians, best first. To keep n Gaussians, the first n of the ranking are taken.
//!
//! The ranking extends the selection of a recipe, which has two stages, to any number n. Stage 1 keeps the k₁ Gaussians
//! with the highest scores. Stage 2 keeps the k₂ Gaussians whose static or dynamic score reaches a threshold. A
//! Gaussian is selected if it passes both stages. For another number n, both stages are made stricter or looser by a
//! common factor λ: stage 1 keeps λ·k₁ Gaussians, and the thresholds are moved so that stage 2 keeps λ·k₂. The first n
//! Gaussians of the ranking are those that pass both stages with the λ for which n Gaussians pass.

use rayon::slice::ParallelSliceMut;
use serde::{Deserialize, Serialize};

use crate::model::{hash_id, inverse_permutation};
use crate::recipe::{LowScorePolicy, SelectParams};
use crate::statistics::score::Scores;

/// Ids of Gaussians in the order in which they are kept, best first.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ranking {
    order: Vec<u32>,
}

impl Ranking {
    /// Creates a ranking from the ids in `order`, best first; each id occurs once.
    pub fn new(order: Vec<u32>) -> Self {
        Ranking { order }
    }

    /// Returns the ids of the Gaussians, best first.
    pub fn order(&self) -> &[u32] {
        &self.order
    }

    /// Returns the first `m` ids of the ranking, or all ids if there are fewer, in increasing order.
    pub fn best_ids(&self, m: usize) -> Vec<u32> {
        let mut ids = self.order[..m.min(self.order.len())].to_vec();
        ids.sort_unstable();
        ids
    }
}

/// Two ranks of every Gaussian, by id, from which [`Ranks::ranking`] makes a ranking. Rank 0 is the best.
pub(super) struct Ranks {
    /// Rank of every Gaussian by descending score S. Of equal scores, the Gaussian with the smaller hash of its id comes
    /// first.
    pub(super) by_score: Vec<u32>,
    /// Rank of every Gaussian by the criterion of stage 2, descending. The criterion is max(norm(S_static)/τ_S,
    /// norm(S_dynamic)/τ_D): the normalized static and dynamic scores, each divided by its threshold. Ties are broken
    /// by score S.
    by_criterion: Vec<u32>,
    /// Number of Gaussians that stage 1 keeps: those with the best ranks in `by_score`. `None` under
    /// [`LowScorePolicy::Rescue`], where stage 1 excludes none.
    kept_by_stage_1: Option<usize>,
    /// Number of Gaussians that pass stage 2, whose thresholds are applied to the static and the dynamic score.
    kept_by_stage_2: usize,
}

impl Ranks {
    /// Sorts all Gaussians twice: by the score of stage 1, and by the criterion of stage 2. Returns both ranks of each.
    /// `candidates`: number of Gaussians that stage 1 keeps. `passes`: for each Gaussian, whether it passes stage 2.
    pub(super) fn new(scores: &Scores, recipe: &SelectParams, candidates: usize, passes: &[bool]) -> Self {
        let n = scores.score.len();
        let mut by_score: Vec<u32> = (0..n as u32).collect();
        // Adding 0 turns −0 into 0, which a total order would distinguish.
        let score = |id: u32| scores.score[id as usize] + 0.0;
        by_score.par_sort_unstable_by(|&a, &b| {
            score(b).total_cmp(&score(a)).then_with(|| hash_id(a.into()).cmp(&hash_id(b.into())))
        });
        let by_score = inverse_permutation(&by_score);

        let criterion: Vec<f64> = (0..n)
            .map(|i| {
                let static_ratio = ratio(scores.static_norm[i], recipe.tau_static);
                static_ratio.max(ratio(scores.dynamic_norm[i], recipe.tau_dynamic)) + 0.0
            })
            .collect();
        let mut by_criterion: Vec<u32> = (0..n as u32).collect();
        by_criterion.par_sort_unstable_by(|&a, &b| {
            let (a, b) = (a as usize, b as usize);
            criterion[b].total_cmp(&criterion[a]).then_with(|| by_score[a].cmp(&by_score[b]))
        });
        Ranks {
            by_criterion: inverse_permutation(&by_criterion),
            by_score,
            kept_by_stage_1: (recipe.low_priority == LowScorePolicy::Drop).then_some(candidates),
            kept_by_stage_2: passes.iter().filter(|&&passes| passes).count(),
        }
    }

    /// Returns the ranking of all Gaussians except those that the user drops. `forced`: the user's decision for each
    /// Gaussian. Gaussians that the user keeps come first, then the others; both groups are sorted by increasing key.
    ///
    /// The key of a Gaussian is the larger of two quotients:
    /// - its rank by score S, from 1, divided by the number of Gaussians that stage 1 keeps (left out under
    ///   [`LowScorePolicy::Rescue`]);
    /// - its rank by the criterion of stage 2, from 1, divided by the number of Gaussians that pass stage 2.
    ///
    /// The Gaussians that the recipe keeps have keys of at most 1, and all others have larger keys. The ranks come
    /// from two orders, so keys may be equal; Gaussians with equal keys are sorted by score S.
    pub(super) fn ranking(&self, forced: &[Option<bool>]) -> Ranking {
        let key = |i: usize| {
            let stage_2_ratio = rank_over(self.by_criterion[i], self.kept_by_stage_2);
            self.kept_by_stage_1.map_or(stage_2_ratio, |kept| stage_2_ratio.max(rank_over(self.by_score[i], kept)))
        };
        let keys: Vec<f64> = (0..forced.len()).map(key).collect();
        let mut order: Vec<u32> = (0..forced.len() as u32).filter(|&i| forced[i as usize] != Some(false)).collect();
        order.par_sort_unstable_by(|&a, &b| {
            let (a, b) = (a as usize, b as usize);
            forced[b]
                .cmp(&forced[a])
                .then_with(|| keys[a].total_cmp(&keys[b]))
                .then_with(|| self.by_score[a].cmp(&self.by_score[b]))
        });
        Ranking { order }
    }
}

/// Returns (`place` + 1) / `kept`: the rank of a Gaussian, counted from 1, divided by the number of Gaussians that a
/// stage keeps. `place` is the rank counted from 0. If the stage keeps none, divides by one half instead of 0: every
/// quotient then exceeds 1, and the order is that of the ranks.
fn rank_over(place: u32, kept: usize) -> f64 {
    (f64::from(place) + 1.0) / (kept as f64).max(0.5)
}

/// Returns the quotient `x`/`tau` of a normalized score and its threshold, by which Gaussians are ranked. It is at
/// least 1 exactly if `x` reaches `tau`. For `tau` ≤ 0 a quotient would not tell this, so the result is then:
/// - infinity if `x` ≥ `tau`, so that all values that reach the threshold tie;
/// - −infinity otherwise.
fn ratio(x: f64, tau: f64) -> f64 {
    if tau > 0.0 {
        x / tau
    } else if x >= tau {
        f64::INFINITY
    } else {
        f64::NEG_INFINITY
    }
}
