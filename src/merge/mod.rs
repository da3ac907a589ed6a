//! Motion-consistent merging by moment matching (METHOD section 5).
//!
//! ```text
//! states at the reference frame ─▶ neighbors ─▶ gates ─▶ pairs ─▶ motion ─▶ greedy ─▶ proxy
//!                                                          frames ──▲
//! ```
//!
//! In: the survivors' states at the reference frame, and whoever can measure the motion of pairs. Out:
//! groups of survivors and one state per group. Memory per survivor: 30 bytes for the neighbour index,
//! 24 for the clustering, 48 for groups and ranks, and its state twice; per candidate pair (at most
//! `max_neighbors` per survivor, 3.5 measured among evenly strewn Gaussians) 28 bytes, [`motion::PAIR_BYTES`] and a
//! [`PairMeasure`].

pub mod gates;
pub mod greedy;
mod groups;
pub mod moments;
pub mod motion;
pub mod neighbors;
pub mod proxy;

use rayon::prelude::*;
use serde::Serialize;

use crate::model::{Columns, Gaussians};
use crate::recipe;
use gates::{Gates, Look};
pub use groups::Groups;
use motion::{MotionGate, PairMeasure};
use neighbors::{PointIndex, Search};
use proxy::Importance;

/// Memory per survivor beside its states, see above.
pub const BYTES_PER_SURVIVOR: usize = 102;
/// Memory per pair.
pub const BYTES_PER_PAIR: usize = 152;

/// Nodes whose neighbours one task looks up.
const CHUNK: usize = 1024;

/// The Gaussians to merge, in the order of their ids.
#[derive(Debug, Clone, Copy)]
pub struct Survivors<'a> {
    /// M states at the reference frame.
    pub states: &'a Gaussians,
    /// C `[M]`: the size that ranks leaders, and part of the weights.
    pub coverage: &'a [f64],
    /// Vis `[M]`.
    pub visibility: &'a [f64],
    /// Hashed ids `[M]`, which break ties of size.
    pub hash: &'a [u64],
    /// Whether each of the M may merge. A row that is not finite never does.
    pub mergeable: &'a [bool],
    /// Scene extent, the unit of [`LengthUnit::Extent`].
    pub extent: f64,
}

/// What merging made of the survivors.
#[derive(Debug, Clone)]
pub struct Merged {
    /// Who stands for whom.
    pub groups: Groups,
    /// One state per group at the reference frame; groups of one are unchanged to the byte.
    pub states: Gaussians,
    /// What each pass did; passes after the limit was met are not made.
    pub passes: Vec<PassCounts>,
}

/// What one pass did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct PassCounts {
    /// Nodes with more neighbours within ε than were looked at.
    pub truncated: usize,
    /// Pairs that passed tests 1 and 2.
    pub candidates: usize,
    /// Of those, pairs that passed test 3.
    pub passing: usize,
    /// Nodes that joined a leader.
    pub joins: usize,
    /// Rounds of the parallel greedy rule.
    pub rounds: usize,
    /// Whether it was finished in sequence.
    pub sequential: bool,
}

/// Pairs that pass tests 1 and 2.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Candidates {
    /// Rank of every node, see [`greedy::ranks`].
    pub rank: Vec<u32>,
    /// (leader, member): the member is among the leader's nearest neighbours and ranks behind it. By
    /// leader, then by distance.
    pub pairs: Vec<(u32, u32)>,
    /// Nodes with more neighbours within ε than were looked at.
    pub truncated: usize,
}

/// All passes of `recipe` over `survivors`.
///
/// `measure` answers test 3: for pairs of survivors (rows of `survivors.states`) it returns their
/// [`PairMeasure`]s in the same order. It is asked once per pass, unless no pair is left. A measure
/// depends on the pair alone, so the caller may remember it by ids. In later passes nodes are groups:
/// state = proxy over all original members, size = ΣC, trajectory, life and hash = the leader's.
///
/// With `limit`, merging stops after exactly that many joins over all passes, or fewer if there are
/// not so many; the joins kept are the first ones in sequential order. Fails only if `measure` does.
pub fn run<E>(
    survivors: &Survivors<'_>,
    recipe: &recipe::Merge,
    limit: Option<usize>,
    mut measure: impl FnMut(&[(u32, u32)]) -> Result<Vec<PairMeasure>, E>,
) -> Result<Merged, E> {
    let importance = Importance { coverage: survivors.coverage, visibility: survivors.visibility };
    let unit = recipe.length_unit.in_scene_units(survivors.extent);
    let mut groups = Groups::alone(survivors.states.len());
    let mut states = survivors.states.clone();
    let (mut passes, mut left) = (Vec::new(), limit);
    for pass in &recipe.passes {
        if left == Some(0) {
            break;
        }
        let sizes: Vec<f64> = (0..groups.len())
            .map(|group| groups.members(group).iter().map(|&row| survivors.coverage[row as usize]).sum())
            .collect();
        let hashes: Vec<u64> = groups.leaders().iter().map(|&row| survivors.hash[row as usize]).collect();
        let mergeable: Vec<bool> = groups.leaders().iter().map(|&row| survivors.mergeable[row as usize]).collect();
        let rank = greedy::ranks(&sizes, &hashes);
        let candidates = candidates(&states, rank, &mergeable, recipe, pass, unit);
        let row = |node: u32| groups.leaders()[node as usize];
        let rows: Vec<(u32, u32)> = candidates.pairs.iter().map(|&(i, j)| (row(i), row(j))).collect();
        let measures = if rows.is_empty() { Vec::new() } else { measure(&rows)? };
        debug_assert_eq!(measures.len(), rows.len(), "one measure per pair");
        let gate = MotionGate::new(recipe, pass, unit);
        let passing: Vec<(u32, u32)> = candidates
            .pairs
            .iter()
            .zip(&measures)
            .filter(|(_, measure)| gate.passes(measure))
            .map(|(&pair, _)| pair)
            .collect();
        let clustering = greedy::cluster(&candidates.rank, &passing, left);
        left = left.map(|left| left - clustering.joins);
        passes.push(PassCounts {
            truncated: candidates.truncated,
            candidates: candidates.pairs.len(),
            passing: passing.len(),
            joins: clustering.joins,
            rounds: clustering.rounds,
            sequential: clustering.sequential,
        });
        groups = groups.joined(&clustering.leader_of);
        states = proxy::merge_groups(&groups, &importance, survivors.states, recipe);
    }
    Ok(Merged { groups, states, passes })
}

/// The pairs of nodes that pass tests 1 and 2 of `pass`, `unit` being the length of one unit of the
/// recipe. A node that is not `mergeable` or not finite leads nobody, joins nobody and takes no place
/// among the nearest neighbours of others.
pub fn candidates(
    states: &Gaussians,
    rank: Vec<u32>,
    mergeable: &[bool],
    recipe: &recipe::Merge,
    pass: &recipe::MergePass,
    unit: f64,
) -> Candidates {
    let usable: Vec<bool> =
        mergeable.iter().zip(finite_rows(states)).map(|(&wanted, finite)| wanted && finite).collect();
    let index = PointIndex::new(&states.position, |i| usable[i]);
    let gates = Gates::new(recipe, pass);
    let epsilon = pass.epsilon * unit;
    let of_chunk = |search: &mut Search, chunk: usize| {
        let (mut pairs, mut truncated) = (Vec::new(), 0);
        for i in (chunk * CHUNK..((chunk + 1) * CHUNK).min(states.len())).filter(|&i| usable[i]) {
            let look = Look::new(states, i);
            let (near, cut) = index.nearest(i as u32, states.position.row(i), recipe.max_neighbors, epsilon, search);
            truncated += usize::from(cut);
            let behind = near.filter(|&j| rank[i] < rank[j as usize]);
            pairs.extend(behind.filter(|&j| gates.pass(&look, &Look::new(states, j as usize))).map(|j| (i as u32, j)));
        }
        (pairs, truncated)
    };
    let chunks: Vec<(Vec<(u32, u32)>, usize)> =
        (0..states.len().div_ceil(CHUNK)).into_par_iter().map_init(Search::default, of_chunk).collect();
    let truncated = chunks.iter().map(|(_, truncated)| truncated).sum();
    Candidates { rank, pairs: chunks.into_iter().flat_map(|(pairs, _)| pairs).collect(), truncated }
}

/// Whether every value of each row is finite.
fn finite_rows(states: &Gaussians) -> Vec<bool> {
    let mut finite = vec![true; states.len()];
    for column in Columns::ALL.iter().map(|column| states.column(column)) {
        for plane in (0..column.width()).map(|c| column.plane(c)) {
            finite.iter_mut().zip(plane).for_each(|(finite, value)| *finite &= value.is_finite());
        }
    }
    finite
}

#[cfg(test)]
mod tests;
