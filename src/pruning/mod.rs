//! Selection of the Gaussians that stay, by their scores ("sampling and pruning" in method.md, section 4).
//!
//! Input: scores. Output: the number of Gaussians that stay, and a ranking of all Gaussians in which those that stay
//! come first, so that any other number can be kept by the same rule. Memory per Gaussian: [`BYTES_PER_GAUSSIAN`], and
//! [`WORKING_BYTES_PER_GAUSSIAN`] while selecting. Source: "Temporally-Aware Pruning for Compact 4D Gaussian Splatting
//! Models", section 3.3.

pub mod contribution;
mod ranking;
pub mod removal;
pub mod score;
pub mod visibility;

pub use ranking::Ranking;
use ranking::Ranks;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::recipe::{LowScorePolicy, SelectParams};
use crate::statistics::score::Scores;

/// Result of the selection, which has two stages: stage 1 takes the best fraction of the Gaussians by score, stage 2
/// applies thresholds to the static and the dynamic score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Selection {
    /// Ranking of the Gaussians that the user does not drop, best first. Its first `counts.kept` Gaussians are those
    /// that stay.
    pub ranking: Ranking,
    /// Numbers of Gaussians that each stage of the selection keeps and prunes.
    pub counts: SelectionCounts,
}

impl Selection {
    /// Returns for each Gaussian whether it is kept.
    pub fn keep(&self) -> Vec<bool> {
        let mut keep = vec![false; self.counts.total];
        self.ranking.order()[..self.counts.kept].iter().for_each(|&id| keep[id as usize] = true);
        keep
    }
}

/// Numbers of Gaussians at each stage of the selection. `total` = `candidates` + `rescued` + `pruned_by_stage_1`, and
/// `kept` = `candidates` − `pruned_by_stage_2` + `rescued` + `forced_keep` − `forced_drop`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SelectionCounts {
    /// Number N of all Gaussians.
    pub total: usize,
    /// Number of candidates: the best fraction of the Gaussians by score S, which stage 1 takes.
    pub candidates: usize,
    /// Number of Gaussians that stage 1 does not make candidates but stage 2 keeps; 0 under [`LowScorePolicy::Drop`].
    pub rescued: usize,
    /// Number of Gaussians that stage 1 does not make candidates and that are pruned.
    pub pruned_by_stage_1: usize,
    /// Number of candidates that are pruned because they reach neither threshold of stage 2.
    pub pruned_by_stage_2: usize,
    /// Number of Gaussians that the selection by scores prunes but the user keeps.
    pub forced_keep: usize,
    /// Number of Gaussians that the selection by scores keeps but the user drops.
    pub forced_drop: usize,
    /// Number of Gaussians that stay in the end, with the user's overrides applied.
    pub kept: usize,
}

/// Bytes of memory per Gaussian for the result of a selection and a copy of its ranking.
pub const BYTES_PER_GAUSSIAN: usize = 2 * size_of::<u32>();
/// Bytes of memory per Gaussian that are needed only while selecting: whether it passes stage 2, the user's decision,
/// its ranks in two orders, the list of ids being sorted, and the sort keys.
pub const WORKING_BYTES_PER_GAUSSIAN: usize =
    size_of::<bool>() + size_of::<Option<bool>>() + 4 * size_of::<u32>() + 2 * size_of::<f64>();

/// Applies stages 1 and 2 to N scored Gaussians, then the user's decisions, and returns which Gaussians stay.
/// `keep`, `drop`: ids, in any order, of Gaussians that the user keeps or drops, whatever their scores.
///
/// By default a Gaussian stays if it passes both stages. Under [`LowScorePolicy::Rescue`] it stays if it passes stage
/// 2, whether or not it passes stage 1.
///
/// - Stage 1 takes the best round(`keep_fraction`·N) Gaussians by score S as candidates (halves round up; of equal
///   scores, the Gaussian with the smaller hash of its id comes first).
/// - Stage 2 keeps Gaussians with norm(S_static) ≥ τ_S or norm(S_dynamic) ≥ τ_D. S_static and S_dynamic are the static
///   and the dynamic score, norm is the normalized score, and τ a threshold of the recipe.
///
/// If both norms are 0 for all Gaussians, as for a single Gaussian or for copies of one, the scores cannot distinguish
/// them, and stage 2 prunes none.
///
/// # Errors
/// Returns [`Error::Usage`] for an id that is N or larger, and for an id that is to be both kept and dropped.
pub fn select(scores: &Scores, recipe: &SelectParams, keep: &[u32], drop: &[u32]) -> Result<Selection> {
    let n = scores.score.len();
    let forced = user_decisions(n, keep, drop)?;
    let candidates = (recipe.keep_fraction * n as f64).round() as usize;
    let passes = passes_stage_2(scores, recipe);
    let ranks = Ranks::new(scores, recipe, candidates, &passes);

    let rescue = recipe.low_priority == LowScorePolicy::Rescue;
    let mut counts = SelectionCounts { total: n, candidates, ..SelectionCounts::default() };
    for i in 0..n {
        let candidate = (ranks.by_score[i] as usize) < candidates;
        let kept_by_score = passes[i] && (candidate || rescue);
        match (candidate, kept_by_score) {
            (true, true) => {}
            (true, false) => counts.pruned_by_stage_2 += 1,
            (false, true) => counts.rescued += 1,
            (false, false) => counts.pruned_by_stage_1 += 1,
        }
        match forced[i] {
            Some(true) if !kept_by_score => counts.forced_keep += 1,
            Some(false) if kept_by_score => counts.forced_drop += 1,
            _ => {}
        }
        counts.kept += usize::from(forced[i].unwrap_or(kept_by_score));
    }
    Ok(Selection { ranking: ranks.ranking(&forced), counts })
}

/// Returns for each Gaussian whether it passes stage 2: its normalized static or dynamic score reaches the threshold.
/// All pass if all these scores are 0.
fn passes_stage_2(scores: &Scores, recipe: &SelectParams) -> Vec<bool> {
    let Scores { static_norm, dynamic_norm, .. } = scores;
    let norms = || static_norm.iter().zip(dynamic_norm);
    let indistinguishable = norms().all(|(&static_score, &dynamic_score)| static_score == 0.0 && dynamic_score == 0.0);
    norms()
        .map(|(&static_score, &dynamic_score)| {
            indistinguishable || static_score >= recipe.tau_static || dynamic_score >= recipe.tau_dynamic
        })
        .collect()
}

/// Returns the user's decision for each of the `n` Gaussians: keep (`true`), drop (`false`) or none (`None`). Fails for
/// an id that is `n` or larger, and for an id that is to be both kept and dropped.
fn user_decisions(n: usize, keep: &[u32], drop: &[u32]) -> Result<Vec<Option<bool>>> {
    let mut decisions = vec![None; n];
    for (ids, keep) in [(keep, true), (drop, false)] {
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
