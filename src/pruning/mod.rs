//! Sampling and pruning (method.md, section 4): which Gaussians stay.
//!
//! In: scores. Out: a mask, and a ranking of all Gaussians of which the mask is a prefix, so that any
//! other number can be kept by the same rule. Memory per Gaussian: [`BYTES_PER_GAUSSIAN`], and
//! [`WORKING_BYTES_PER_GAUSSIAN`] meanwhile. Source: "Temporally-Aware
//! Pruning for Compact 4D Gaussian Splatting Models", section 3.3.

pub mod contribution;
mod ranking;
pub mod removal;
pub mod score;
pub mod visible;

pub use ranking::Ranking;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::recipe::{LowPriority, Select};
use crate::statistics::score::Scores;

/// What the user knows better than the scores. Ids in any order.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Overrides {
    /// These stay whatever their scores.
    pub keep_ids: Vec<u32>,
    /// These go whatever their scores.
    pub drop_ids: Vec<u32>,
}

/// The outcome of stages 1 and 2.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Selection {
    /// For every Gaussian whether it stays.
    pub keep: Vec<bool>,
    /// All Gaussians but those dropped by the user, best first; the first `counts.kept` are those of `keep`.
    pub ranking: Ranking,
    /// How many each stage kept and pruned.
    pub counts: Counts,
}

/// Gaussians at each stage. Before overrides: total = candidates + outside, and
/// kept = candidates − pruned by stage 2 + rescued.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Counts {
    /// N.
    pub total: usize,
    /// Stage 1's top fraction by S.
    pub candidates: usize,
    /// Outside stage 1 and kept by the OR rule; 0 under [`LowPriority::Drop`].
    pub rescued: usize,
    /// Outside stage 1 and pruned.
    pub pruned_by_stage_1: usize,
    /// Candidates that fail the OR rule.
    pub pruned_by_stage_2: usize,
    /// Kept by the user against the rule.
    pub forced_keep: usize,
    /// Dropped by the user against the rule.
    pub forced_drop: usize,
    /// In the output.
    pub kept: usize,
}

/// Memory of a selection per Gaussian, and of a second ranking beside its own.
pub const BYTES_PER_GAUSSIAN: usize = size_of::<bool>() + 2 * size_of::<u32>();
/// What selecting takes per Gaussian besides, while it lasts: fates, places in two orders, one of them being sorted,
/// and what they are sorted by.
pub const WORKING_BYTES_PER_GAUSSIAN: usize =
    size_of::<bool>() + size_of::<Option<bool>>() + 4 * size_of::<u32>() + 2 * size_of::<f64>();

/// Applies both stages to N scored Gaussians, then the overrides.
///
/// Stage 1 takes the round(`keep_fraction`·N) best (halves up) by S, ties by hashed id. Stage 2 keeps
/// those with norm(S_static) ≥ τ_S or norm(S_dynamic) ≥ τ_D: of the candidates, or under
/// [`LowPriority::Rescue`] of all. Where both norms are 0 throughout, as for a single Gaussian or for copies
/// of one, nothing tells Gaussians apart and stage 2 prunes nobody.
///
/// # Errors
/// [`Error::Usage`] for an id beyond N, or one to be both kept and dropped.
pub fn select(scores: &Scores, recipe: &Select, overrides: &Overrides) -> Result<Selection> {
    let n = scores.score.len();
    let forced = forced_fates(n, overrides)?;
    let candidates = (recipe.keep_fraction * n as f64).round() as usize;
    let passes = passes(scores, recipe);
    let ordered = ranking::orders(scores, recipe, candidates, &passes);

    let rescue = recipe.low_priority == LowPriority::Rescue;
    let mut counts = Counts { total: n, candidates, ..Counts::default() };
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
    for (keep, fate) in keep.iter_mut().zip(&forced) {
        match fate {
            Some(true) if !*keep => counts.forced_keep += 1,
            Some(false) if *keep => counts.forced_drop += 1,
            _ => {}
        }
        *keep = fate.unwrap_or(*keep);
    }
    counts.kept = keep.iter().filter(|&&keep| keep).count();
    Ok(Selection { keep, ranking: ordered.ranking(&forced), counts })
}

/// Stage 2 for every Gaussian.
fn passes(scores: &Scores, recipe: &Select) -> Vec<bool> {
    let Scores { static_norm, dynamic_norm, .. } = scores;
    let norms = || static_norm.iter().zip(dynamic_norm);
    let ungraded = norms().all(|(&of_static, &of_dynamic)| of_static == 0.0 && of_dynamic == 0.0);
    norms()
        .map(|(&of_static, &of_dynamic)| ungraded || of_static >= recipe.tau_static || of_dynamic >= recipe.tau_dynamic)
        .collect()
}

/// For every Gaussian what the user wants, if anything.
fn forced_fates(n: usize, overrides: &Overrides) -> Result<Vec<Option<bool>>> {
    let mut fates = vec![None; n];
    for (ids, keep) in [(&overrides.keep_ids, true), (&overrides.drop_ids, false)] {
        for &id in ids {
            let Some(fate) = fates.get_mut(id as usize) else {
                return Err(Error::usage(format!("Gaussian {id} is to be kept or dropped, but there are only {n}")));
            };
            if *fate == Some(!keep) {
                return Err(Error::usage(format!(
                    "Gaussian {id} is to be kept and to be dropped: name it in one list only"
                )));
            }
            *fate = Some(keep);
        }
    }
    Ok(fates)
}

#[cfg(test)]
mod tests;
