//! Sampling and pruning (method.md, section 4): selects the Gaussians that stay, by their scores.
//!
//! Input: scores. Output: for every Gaussian whether it stays, and a ranking of all Gaussians in which those that stay
//! come first, so that any other number can be kept by the same rule. Memory per Gaussian: [`BYTES_PER_GAUSSIAN`], and
//! [`WORKING_BYTES_PER_GAUSSIAN`] while selecting. Source: "Temporally-Aware Pruning for Compact 4D Gaussian Splatting
//! Models", section 3.3.

pub mod contribution;
mod ranking;
pub mod removal;
pub mod score;
pub mod visible;

pub use ranking::Ranking;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::recipe::{LowScorePolicy, SelectParams};
use crate::statistics::score::Scores;

/// Ids of Gaussians that the user keeps or drops whatever their scores, in any order.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Overrides {
    /// Ids of Gaussians that are always kept.
    pub keep_ids: Vec<u32>,
    /// Ids of Gaussians that are always dropped.
    pub drop_ids: Vec<u32>,
}

/// Result of stage 1 (best fraction by score) and stage 2 (thresholds of the static and dynamic score).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Selection {
    /// For each Gaussian, whether it stays.
    pub keep: Vec<bool>,
    /// Ranking of the Gaussians that the user does not drop, best first. Its first `counts.kept` Gaussians are those
    /// that stay.
    pub ranking: Ranking,
    /// Numbers of Gaussians kept and pruned by each stage.
    pub counts: SelectionCounts,
}

/// Numbers of Gaussians at each stage of selection. Without the user's overrides, total = candidates + outside, and
/// kept = candidates − pruned by stage 2 + rescued. "Outside" are the Gaussians that stage 1 does not make candidates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SelectionCounts {
    /// Number N of all Gaussians.
    pub total: usize,
    /// Number of candidates: the top fraction by score S, which stage 1 takes.
    pub candidates: usize,
    /// Number of Gaussians outside the candidates that stage 2 keeps nevertheless; 0 under [`LowScorePolicy::Drop`].
    pub rescued: usize,
    /// Number of Gaussians outside the candidates that are pruned.
    pub pruned_by_stage_1: usize,
    /// Number of candidates that are pruned because they reach neither threshold of stage 2.
    pub pruned_by_stage_2: usize,
    /// Number of Gaussians that are kept only because the user keeps them.
    pub forced_keep: usize,
    /// Number of Gaussians that are dropped only because the user drops them.
    pub forced_drop: usize,
    /// Number of Gaussians that stay in the end.
    pub kept: usize,
}

/// Bytes of memory per Gaussian for a selection and one further ranking.
pub const BYTES_PER_GAUSSIAN: usize = size_of::<bool>() + 2 * size_of::<u32>();
/// Bytes of memory per Gaussian that are needed only while selecting: the results of stage 2, overrides, positions in two orders, the order
/// being sorted, and the sort keys.
pub const WORKING_BYTES_PER_GAUSSIAN: usize =
    size_of::<bool>() + size_of::<Option<bool>>() + 4 * size_of::<u32>() + 2 * size_of::<f64>();

/// Applies stages 1 and 2 to N scored Gaussians, then the user's overrides.
///
/// Stage 1 takes the best round(`keep_fraction`·N) Gaussians by score S as candidates (halves round up; ties by hashed
/// id). Stage 2 keeps Gaussians with norm(S_static) ≥ τ_S or norm(S_dynamic) ≥ τ_D, where norm is the normalized score
/// and τ a threshold of the recipe. It applies to the candidates, or under [`LowScorePolicy::Rescue`] to all Gaussians. If
/// both norms are 0 for all Gaussians, as for a single Gaussian or for copies of one, the scores cannot distinguish
/// them, and stage 2 prunes none.
///
/// # Errors
/// Returns [`Error::Usage`] for an id beyond N, and for an id that is to be both kept and dropped.
pub fn select(scores: &Scores, recipe: &SelectParams, overrides: &Overrides) -> Result<Selection> {
    let n = scores.score.len();
    let forced = user_decisions(n, overrides)?;
    let candidates = (recipe.keep_fraction * n as f64).round() as usize;
    let passes = passes(scores, recipe);
    let ordered = ranking::orders(scores, recipe, candidates, &passes);

    let rescue = recipe.low_priority == LowScorePolicy::Rescue;
    let mut counts = SelectionCounts { total: n, candidates, ..SelectionCounts::default() };
    let mut keep: Vec<bool> = (0..n)
        .map(|i| {
            let candidate = (ordered.by_score[i] as usize) < candidates;
            match (candidate, passes[i]) {
                (true, true) => true,
                (true, false) => {
                    counts.pruned_by_stage_2 += 1;
                    false
                }
                (false, true) if rescue => {
                    counts.rescued += 1;
                    true
                }
                (false, _) => {
                    counts.pruned_by_stage_1 += 1;
                    false
                }
            }
        })
        .collect();
    for (keep, decision) in keep.iter_mut().zip(&forced) {
        match decision {
            Some(true) if !*keep => counts.forced_keep += 1,
            Some(false) if *keep => counts.forced_drop += 1,
            _ => {}
        }
        *keep = decision.unwrap_or(*keep);
    }
    counts.kept = keep.iter().filter(|&&keep| keep).count();
    Ok(Selection { keep, ranking: ordered.ranking(&forced), counts })
}

/// Returns for each Gaussian whether its static or its dynamic score reaches the threshold of stage 2.
fn passes(scores: &Scores, recipe: &SelectParams) -> Vec<bool> {
    let Scores { static_norm, dynamic_norm, .. } = scores;
    let norms = || static_norm.iter().zip(dynamic_norm);
    let indistinguishable = norms().all(|(&static_score, &dynamic_score)| static_score == 0.0 && dynamic_score == 0.0);
    norms()
        .map(|(&static_score, &dynamic_score)| {
            indistinguishable || static_score >= recipe.tau_static || dynamic_score >= recipe.tau_dynamic
        })
        .collect()
}

/// Returns the user's decision for each of the `n` Gaussians: keep (`true`), drop (`false`) or none (`None`).
fn user_decisions(n: usize, overrides: &Overrides) -> Result<Vec<Option<bool>>> {
    let mut decisions = vec![None; n];
    for (ids, keep) in [(&overrides.keep_ids, true), (&overrides.drop_ids, false)] {
        for &id in ids {
            let Some(decision) = decisions.get_mut(id as usize) else {
                return Err(Error::usage(format!(
                    "Gaussian {id} is to be kept or dropped, but the model has only {n} Gaussians (ids start at 0)"
                )));
            };
            if *decision == Some(!keep) {
                return Err(Error::usage(format!(
                    "Gaussian {id} is to be kept and to be dropped: list it in one of the two options only"
                )));
            }
            *decision = Some(keep);
        }
    }
    Ok(decisions)
}

#[cfg(test)]
mod tests;
