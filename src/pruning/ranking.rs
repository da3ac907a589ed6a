//! One order of all Gaussians of which the selection is a prefix, so that a target count is met
//! exactly by the same two stages with both thresholds moved together.

use rayon::slice::ParallelSliceMut;
use serde::{Deserialize, Serialize};

use crate::model::hash_id;
use crate::recipe::{LowPriority, Select};
use crate::statistics::score::Scores;

/// Gaussians from the one to keep first to the one to keep last.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ranking {
    order: Vec<u32>,
}

impl Ranking {
    /// Ids, each once, best first.
    pub fn new(order: Vec<u32>) -> Self {
        Ranking { order }
    }

    /// The ids, best first.
    pub fn order(&self) -> &[u32] {
        &self.order
    }

    /// The first `m` ids (all, if there are fewer) in increasing order.
    pub fn take(&self, m: usize) -> Vec<u32> {
        let mut ids = self.order[..m.min(self.order.len())].to_vec();
        ids.sort_unstable();
        ids
    }
}

/// The two orders behind a ranking, as the place of every Gaussian in each, from 0.
pub(super) struct Orders {
    /// By S, ties by hashed id.
    pub(super) by_score: Vec<u32>,
    /// By max(norm(S_static)/τ_S, norm(S_dynamic)/τ_D), ties by S.
    by_rule: Vec<u32>,
    /// How many of each order the recipe keeps; stage 1 does not bind under `rescue`.
    stage_1: Option<usize>,
    stage_2: usize,
}

/// Ranks all Gaussians in both orders; `passes` is stage 2's verdict on each.
pub(super) fn orders(scores: &Scores, recipe: &Select, candidates: usize, passes: &[bool]) -> Orders {
    let n = scores.score.len();
    let mut by_score: Vec<u32> = (0..n as u32).collect();
    // Adding 0 makes −0 equal to 0 under a total order.
    let score = |id: u32| scores.score[id as usize] + 0.0;
    by_score.par_sort_unstable_by(|&a, &b| {
        score(b).total_cmp(&score(a)).then_with(|| hash_id(a.into()).cmp(&hash_id(b.into())))
    });
    let by_score = places(&by_score);

    let rule: Vec<f64> = (0..n)
        .map(|i| {
            let of_static = share(scores.static_norm[i], recipe.tau_static);
            of_static.max(share(scores.dynamic_norm[i], recipe.tau_dynamic)) + 0.0
        })
        .collect();
    let mut by_rule: Vec<u32> = (0..n as u32).collect();
    by_rule.par_sort_unstable_by(|&a, &b| {
        let (a, b) = (a as usize, b as usize);
        rule[b].total_cmp(&rule[a]).then_with(|| by_score[a].cmp(&by_score[b]))
    });
    Orders {
        by_rule: places(&by_rule),
        by_score,
        stage_1: (recipe.low_priority == LowPriority::Drop).then_some(candidates),
        stage_2: passes.iter().filter(|&&passes| passes).count(),
    }
}

impl Orders {
    /// Orders by the fraction of its share that each stage must admit for a Gaussian to stay, the
    /// larger of both; those to be kept come first, those to be dropped not at all.
    ///
    /// A key is at most 1 exactly for what the recipe keeps. Ties, which come from ranks in two
    /// orders, go by S.
    pub(super) fn ranking(&self, forced: &[Option<bool>]) -> Ranking {
        let key = |i: usize| {
            let of_stage_2 = place_over(self.by_rule[i], self.stage_2);
            self.stage_1.map_or(of_stage_2, |kept| of_stage_2.max(place_over(self.by_score[i], kept)))
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

/// Rank over the number kept. None kept counts as half a Gaussian: every key then exceeds 1 and the
/// order stays.
fn place_over(place: u32, kept: usize) -> f64 {
    (f64::from(place) + 1.0) / (kept as f64).max(0.5)
}

/// x/τ, at least 1 exactly when x ≥ τ. A threshold of 0 is no measure: whatever reaches it ties.
fn share(x: f64, tau: f64) -> f64 {
    if tau > 0.0 {
        x / tau
    } else if x >= tau {
        f64::INFINITY
    } else {
        f64::NEG_INFINITY
    }
}

/// Place of every id in `order`.
fn places(order: &[u32]) -> Vec<u32> {
    let mut places = vec![0; order.len()];
    for (place, &id) in order.iter().enumerate() {
        places[id as usize] = place as u32;
    }
    places
}
