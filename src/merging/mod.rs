//! Merging: replaces clusters of Gaussians that look alike and move alike by one Gaussian, the proxy, with their mean
//! and covariance (method.md, section 5).
//!
//! ```text
//! states at the reference frame ─▶ neighbors ─▶ appearance ─▶ pairs ─▶ motion ─▶ greedy ─▶ proxy
//! frames ──▲
//! ```
//!
//! Input: the states of the survivors (Gaussians left by pruning) at the reference frame, and a callback that measures
//! the motion of pairs. Output: groups of survivors, and the state of one proxy for each group of more than one.
//!
//! Peak memory per survivor:
//! - its state, which the caller holds;
//! - the proxy states before and after a pass (in each of these two tables, at most one proxy for every two survivors);
//! - [`BYTES_PER_SURVIVOR`] for everything else.
//!
//! In addition, memory holds [`BYTES_PER_PAIR`] for each candidate pair that is measured in one call, and
//! [`BYTES_PER_PASSED_PAIR`] for each pair that passed all tests. There are at most `max_neighbors` pairs per survivor;
//! 3.5 were measured for evenly distributed Gaussians. The memory of the callback is not included.

pub mod appearance;
pub mod greedy;
mod groups;
pub mod merged_sequence;
pub mod moments;
pub mod motion;
pub mod motion_pass;
pub mod neighbors;
pub mod proxy;
pub mod similarity_cache;
pub(crate) mod trajectories;
pub mod tree;
pub mod voxels;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::model::hash_id;
use crate::model::{Attributes, Gaussians};
use crate::recipe;
use appearance::{Appearance, AppearanceThresholds};
pub use groups::MergeGroups;
use neighbors::{NeighborSearch, PointIndex};
use proxy::Importance;
use similarity_cache::BYTES_PER_CACHED_PAIR;
use tree::TreePoint;

/// Bytes of memory per survivor during a merging pass, beside its state. The terms are, in order: the groups before the
/// pass, the groups after it, the row of the survivor's state, its rank, and 46 bytes for the largest of three
/// structures that exist one after the other. These are the neighbor index (46 bytes while it is built, 30 later), the
/// list of coincident nodes (24), and the clustering (24).
pub const BYTES_PER_SURVIVOR: usize = 12 + 12 + 4 + 4 + 46;

/// Bytes of memory per candidate pair in one call of `measure`, the callback that measures the motion of pairs; memory
/// that the callback itself takes is not included. The terms are the pair, its copy in the list of pairs to measure,
/// two entries of the [`similarity_cache::SimilarityCache`] (one for this pair, one for a pair of an earlier pass), and
/// the motion similarity that is returned.
pub const BYTES_PER_PAIR: usize = 2 * size_of::<(u32, u32)>() + 2 * BYTES_PER_CACHED_PAIR + size_of::<f64>();

/// Bytes of memory per pair that passed all tests of a merging pass: the pair, and 4 bytes of spare capacity of the
/// list.
pub const BYTES_PER_PASSED_PAIR: usize = size_of::<(u32, u32)>() + size_of::<u32>();

/// Number of nodes (single Gaussians or merged groups) whose neighbors one parallel task looks up.
const CHUNK: usize = 1024;

/// Survivors, which are to be merged: selected rows of a table of states.
#[derive(Debug, Clone, Copy)]
pub struct Survivors<'a> {
    /// Attributes of all Gaussians at the reference frame. Of the SH coefficients, comparisons use only those of degree
    /// 0; proxies (Gaussians that replace merged groups) get those of all degrees.
    pub states: &'a Gaussians,
    /// Rows of the survivors in `states`, increasing.
    pub rows: &'a [u32],
    /// Ids of the Gaussians in `states`, and the contribution C and the visibility of each id. The leader of a group,
    /// into which the others are merged, is chosen by C; ties are broken by the hashes of the ids.
    pub importance: Importance<'a>,
    /// Merge class of every row of `states`. A Gaussian merges only with others of its class. A Gaussian of class
    /// `None`, or with a value that is not finite, never merges.
    pub classes: &'a [Option<u8>],
    /// Extent of the scene in scene units. If the recipe gives lengths in the unit
    /// [`LengthUnit::Extent`](recipe::LengthUnit::Extent), they are multiples of it.
    pub extent: f64,
}

/// Pairs of nodes of one merging pass whose motion is to be measured.
#[derive(Debug, Clone, Copy)]
pub struct RequestedPairs<'a> {
    pairs: &'a [(u32, u32)],
    row: &'a [u32],
    /// Maximum distance ε of the two nodes of a pair at the reference frame, in scene units.
    pub max_distance: f64,
    /// Whether all pairs to be measured were too many for one call of the callback that measures motion. The pairs of
    /// this call are then only a part of them; other calls request the others.
    pub is_part: bool,
}

impl<'a> RequestedPairs<'a> {
    /// Returns each pair as two rows of [`Survivors::states`]. For a node that is a merged group, the row is that of
    /// its leader (the Gaussian into which the others are merged).
    pub fn pairs(self) -> impl ExactSizeIterator<Item = (u32, u32)> + 'a {
        self.pairs.iter().map(move |&(i, j)| (self.row[i as usize], self.row[j as usize]))
    }
}

/// Result of merging: groups of Gaussians, and, for each group of more than one, the proxy (Gaussian) that replaces it.
#[derive(Debug, Clone)]
pub struct MergeResult {
    /// Groups of the survivors. Every survivor is in exactly one group.
    pub groups: MergeGroups,
    /// Proxies at the reference frame: one merged Gaussian for each group of more than one, in the order of the groups.
    pub proxies: Gaussians,
    /// Statistics of each merging pass that was run. After the limit of joins is reached, no further pass is run.
    pub passes: Vec<PassCounts>,
}

/// Statistics of one merging pass. Its nodes are single Gaussians and the groups that earlier passes merged.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PassCounts {
    /// Number of nodes that have more neighbors within the radius ε than the allowed maximum. Of these neighbors only
    /// the nearest were examined.
    pub truncated: usize,
    /// Number of candidate pairs: pairs that passed tests 1 (place and size) and 2 (color).
    pub candidates: usize,
    /// Number of candidate pairs that also passed test 3 (motion).
    pub passing: usize,
    /// Number of nodes that joined another node.
    pub joins: usize,
    /// Number of parallel rounds in which nodes were assigned to leaders (the nodes that they join). Nodes without a
    /// leader after the last round are assigned sequentially and not counted here.
    pub rounds: usize,
    /// Whether, after the last of 32 parallel rounds, more than 64 nodes had no leader yet (node that they join), so
    /// that many nodes were assigned sequentially.
    pub sequential: bool,
}

/// Merges `survivors` in all merging passes of `recipe`. Returns the groups of survivors, a proxy for each group of
/// more than one, and statistics of the passes.
///
/// A pass merges nodes: single Gaussians, or groups that were merged before. It first merges coincident nodes, which
/// are equal in every attribute that tests 1 and 2 compare, then neighbors. A merge joins one or more nodes, the
/// members, to another node, the leader. The leader is the node of the new group with the largest contribution C.
///
/// A member must pass three tests with its leader: 1 (place and size) and 2 (color), both in [`appearance`], and 3
/// (motion), in [`motion`]. `measure` provides the values for test 3: it returns the motion similarity of every
/// requested pair, in the order of the request. A pair passes test 3 if its similarity exceeds τ_m, the minimum that
/// `recipe` sets for the pass. The similarity depends on the pair alone, so the caller may cache it.
///
/// # Calls of `measure`
///
/// Each pass calls `measure` at most twice: first for the pairs of coincident nodes, then for the pairs of neighbors.
/// There is no call without pairs. More than `max_pairs` pairs are divided among several calls of at most `max_pairs`
/// pairs each. Pairs of neighbors are ordered so that their leaders are close in space.
///
/// # Groups as nodes
///
/// A group that was merged before is a node with the state of the proxy of all its original Gaussians. It is ranked by
/// the sum of their contributions C; ties are broken by the hash of the leader's id. Its trajectory and life span are
/// those of its leader.
///
/// # Limit of joins
///
/// With `limit`, merging stops after exactly that many joins over all passes, or earlier if no more are possible. The
/// joins made are the first ones that the sequential rule ([`greedy`]) makes.
///
/// # Errors
/// Returns the first error of `measure`; nothing else fails.
pub fn merge_survivors<E>(
    survivors: &Survivors<'_>,
    recipe: &recipe::MergeParams,
    limit: Option<usize>,
    max_pairs: usize,
    mut measure: impl FnMut(RequestedPairs<'_>) -> Result<Vec<f64>, E>,
) -> Result<MergeResult, E> {
    let importance = &survivors.importance;
    let unit = recipe.length_unit.in_scene_units(survivors.extent);
    let mut groups = MergeGroups::singletons(survivors.rows);
    let mut proxies = survivors.states.pick(&[]);
    let (mut passes, mut remaining_joins) = (Vec::new(), limit);
    for pass in &recipe.passes {
        if remaining_joins == Some(0) {
            break;
        }
        let tests = PassTests {
            appearance: AppearanceThresholds::new(recipe, pass),
            max_distance: pass.epsilon * unit,
            max_neighbors: recipe.max_neighbors,
            min_similarity: pass.tau_m,
            max_pairs,
        };
        let mut counts = PassCounts::default();
        for coincident in [true, false] {
            let nodes = MergeNodes::new(survivors, &groups, &proxies);
            let pairs = find_pairs(&nodes, &tests, coincident, &mut counts, &mut measure)?;
            if coincident && pairs.is_empty() {
                continue;
            }
            let clustering = greedy::cluster(&nodes.rank, pairs, remaining_joins);
            remaining_joins = remaining_joins.map(|joins| joins - clustering.joins);
            counts.joins += clustering.joins;
            counts.rounds += clustering.rounds;
            counts.sequential |= clustering.sequential;
            groups = groups.joined(&clustering.leader_of);
            proxies = proxy::merge_groups(&groups, importance, survivors.states, recipe);
            if remaining_joins == Some(0) {
                break;
            }
        }
        passes.push(counts);
    }
    Ok(MergeResult { groups, proxies, passes })
}

/// Tests of one merging pass, and its limits.
struct PassTests {
    /// Thresholds of tests 1 (place and size) and 2 (color).
    appearance: AppearanceThresholds,
    /// Maximum distance ε of two neighbors at the reference frame, in scene units.
    max_distance: f64,
    /// Maximum number of neighbors of a node that are examined.
    max_neighbors: usize,
    /// Motion similarity τ_m that a pair must exceed to pass test 3.
    min_similarity: f64,
    /// Maximum number of pairs whose motion is measured in one call, at least 1.
    max_pairs: usize,
}

/// Finds the pairs (leader, member) of `nodes` that pass all `tests` of a merging pass: pairs of coincident nodes if
/// `coincident`, otherwise pairs of neighbors. Adds the numbers of pairs to `counts`. `measure`: see
/// [`merge_survivors`].
fn find_pairs<E>(
    nodes: &MergeNodes<'_>,
    tests: &PassTests,
    coincident: bool,
    counts: &mut PassCounts,
    measure: &mut impl FnMut(RequestedPairs<'_>) -> Result<Vec<f64>, E>,
) -> Result<Vec<(u32, u32)>, E> {
    let (row, max_distance) = (nodes.groups.leaders(), tests.max_distance);
    let mut passing = Vec::new();
    let take = |pairs: &[(u32, u32)], is_part| {
        let similarities = measure(RequestedPairs { pairs, row, max_distance, is_part })?;
        debug_assert_eq!(similarities.len(), pairs.len(), "one similarity per pair");
        let similar = pairs.iter().zip(similarities).filter(|&(_, similarity)| similarity > tests.min_similarity);
        passing.extend(similar.map(|(&pair, _)| pair));
        counts.candidates += pairs.len();
        Ok(())
    };
    if coincident {
        each_coincident(nodes, tests, take)?;
    } else {
        counts.truncated = each_candidate(nodes, tests, take)?;
    }
    counts.passing += passing.len();
    Ok(passing)
}

/// Returns the rank of each of `groups`, from 0. Groups are ranked by the sum of the contributions C of their Gaussians
/// (from `importance`), largest first. Ties are broken by the hash of the id of the leader, the Gaussian into which the
/// others are merged.
fn ranks(groups: &MergeGroups, importance: &Importance<'_>) -> Vec<u32> {
    let size = |group: usize| groups.members(group).iter().map(|&row| importance.coverage(row)).sum();
    let sizes: Vec<f64> = (0..groups.group_count()).map(size).collect();
    let hash = |&row: &u32| hash_id(importance.ids[row as usize].into());
    let hashes: Vec<u64> = groups.leaders().iter().map(hash).collect();
    greedy::ranks(&sizes, &hashes)
}

/// Nodes of one merging pass: single Gaussians, and groups that earlier passes merged. A group has the state of its
/// proxy, the Gaussian that replaces it.
struct MergeNodes<'a> {
    survivors: &'a Survivors<'a>,
    groups: &'a MergeGroups,
    proxies: &'a Gaussians,
    /// For each node, the row with its state: a row of `survivors.states` for a single Gaussian, a row of `proxies` for
    /// a merged group.
    place: Vec<u32>,
    /// Rank of each node by contribution, from 0 (see [`ranks`]). The node of a group with the lowest rank is its
    /// leader.
    rank: Vec<u32>,
}

impl<'a> MergeNodes<'a> {
    fn new(survivors: &'a Survivors<'a>, groups: &'a MergeGroups, proxies: &'a Gaussians) -> Self {
        let mut place = groups.leaders().to_vec();
        for (proxy, group) in groups.clusters().enumerate() {
            place[group as usize] = proxy as u32;
        }
        MergeNodes { survivors, groups, proxies, place, rank: ranks(groups, &survivors.importance) }
    }

    fn len(&self) -> usize {
        self.place.len()
    }

    /// Returns the table of states that contains `node`, and the row of the node in this table.
    fn state(&self, node: usize) -> (&Gaussians, usize) {
        let alone = self.groups.members(node).len() == 1;
        (if alone { self.survivors.states } else { self.proxies }, self.place[node] as usize)
    }

    fn is_usable(&self, node: usize) -> bool {
        let (states, row) = self.state(node);
        self.class(node).is_some() && is_finite(states, row)
    }

    fn class(&self, node: usize) -> Option<u8> {
        self.survivors.classes[self.groups.leaders()[node] as usize]
    }

    fn position(&self, node: usize) -> [f32; 3] {
        let (states, row) = self.state(node);
        states.position.row(row)
    }

    fn appearance(&self, node: usize) -> Appearance {
        let (states, row) = self.state(node);
        Appearance::new(states, row)
    }

    /// Returns the bits of all values of `node` that tests 1 (place and size) and 2 (color) compare ([`Appearance`]),
    /// with −0 stored as 0.
    fn appearance_bits(&self, node: usize) -> [u32; 13] {
        let (states, row) = self.state(node);
        let [x, y, z] = states.position.row(row);
        let [qw, qx, qy, qz] = states.rotation.row(row);
        let [a, b, c] = states.log_scale.row(row);
        let [red, green, blue] = states.sh.row(row);
        [x, y, z, qw, qx, qy, qz, a, b, c, red, green, blue].map(|value: f32| (value + 0.0).to_bits())
    }
}

/// Finds sets of coincident nodes: nodes that are equal in every attribute that tests 1 and 2 ([`appearance`]) compare,
/// and that pass these tests. The leader of a set is the node with the lowest rank; all others are its members, however
/// many there are.
///
/// Calls `take` with the pairs (leader, member), ordered by leader. Each call gets at most [`PassTests::max_pairs`]
/// pairs, and whether the pairs are divided among several calls.
///
/// This step is needed because the neighbor search returns only a fixed number of nearest Gaussians. If more Gaussians
/// than that coincide, each of them finds only neighbors that coincide with it. Without this step, the coincident
/// Gaussians would not all merge into one, and would find none of the other Gaussians around them.
///
/// # Errors
/// Returns the first error of `take`.
fn each_coincident<E>(
    nodes: &MergeNodes<'_>,
    tests: &PassTests,
    mut take: impl FnMut(&[(u32, u32)], bool) -> Result<(), E>,
) -> Result<(), E> {
    let key = |node: usize| nodes.appearance_bits(node).iter().fold(0, |key, &bits| hash_id(key ^ u64::from(bits)));
    let usable = (0..nodes.len()).into_par_iter().filter(|&node| nodes.is_usable(node));
    let mut order: Vec<(u64, u32, u32)> = usable.map(|node| (key(node), nodes.rank[node], node as u32)).collect();
    order.par_sort_unstable();
    let mut pairs = Vec::new();
    for coincident in order.chunk_by(|a, b| a.0 == b.0).filter(|coincident| coincident.len() > 1) {
        let leader = coincident[0].2;
        let (bits, appearance) = (nodes.appearance_bits(leader as usize), nodes.appearance(leader as usize));
        let class = nodes.class(leader as usize);
        let is_equal = |node: usize| nodes.class(node) == class && nodes.appearance_bits(node) == bits;
        let is_member =
            |node: u32| is_equal(node as usize) && tests.appearance.pass(&appearance, &nodes.appearance(node as usize));
        pairs.extend(coincident[1..].iter().filter(|member| is_member(member.2)).map(|member| (leader, member.2)));
    }
    drop(order);
    pairs.par_sort_unstable();
    let is_part = pairs.len() > tests.max_pairs;
    pairs.chunks(tests.max_pairs).try_for_each(|some| take(some, is_part))
}

/// Finds the pairs of nodes that pass tests 1 (place and size) and 2 (color). A pair (leader, member) proposes to merge
/// the member into the leader. The member is among the leader's nearest neighbors and has a higher rank. Returns the
/// number of nodes with more neighbors within the radius ε than were examined.
///
/// Calls `take` with the pairs, ordered by leader so that successive leaders are close in space, then by distance. Each
/// call gets at most [`PassTests::max_pairs`] pairs, and whether the pairs are divided among several calls.
///
/// A node that may not merge, or has a value that is not finite, is in no pair and does not count as a neighbor.
///
/// # Errors
/// Returns the first error of `take`.
fn each_candidate<E>(
    nodes: &MergeNodes<'_>,
    tests: &PassTests,
    mut take: impl FnMut(&[(u32, u32)], bool) -> Result<(), E>,
) -> Result<usize, E> {
    let usable = (0..nodes.len()).into_par_iter().filter(|&node| nodes.is_usable(node));
    let points = usable.map(|node| TreePoint { position: nodes.position(node), index: node as u32 }).collect();
    let index = PointIndex::new(points, tests.max_distance);
    let find_pairs = |search: &mut NeighborSearch<'_>, leaders: &[TreePoint]| {
        let (mut pairs, mut truncated) = (Vec::new(), 0);
        for &TreePoint { position, index: i } in leaders {
            let (appearance, class) = (nodes.appearance(i as usize), nodes.class(i as usize));
            let looks_alike = |j: u32| tests.appearance.pass(&appearance, &nodes.appearance(j as usize));
            let passes = |j: u32| nodes.class(j as usize) == class && looks_alike(j);
            let (near, cut) = search.nearest(i, position, tests.max_neighbors);
            truncated += usize::from(cut);
            let behind = near.filter(|&j| nodes.rank[i as usize] < nodes.rank[j as usize]);
            pairs.extend(behind.filter(|&j| passes(j)).map(|j| (i, j)));
        }
        (pairs, truncated)
    };
    let (mut pairs, mut truncated, mut is_part) = (Vec::new(), 0, false);
    // Only one batch of chunks is processed at a time, which bounds the number of pairs that wait for the next call of
    // `take`.
    for batch in index.points().chunks(2 * CHUNK * rayon::current_num_threads()) {
        let chunks: Vec<(Vec<(u32, u32)>, usize)> =
            batch.par_chunks(CHUNK).map_init(|| index.search(), find_pairs).collect();
        for (chunk_pairs, cut) in chunks {
            pairs.extend(chunk_pairs);
            truncated += cut;
        }
        while pairs.len() > tests.max_pairs {
            is_part = true;
            take(&pairs[..tests.max_pairs], is_part)?;
            pairs.drain(..tests.max_pairs);
        }
    }
    if !pairs.is_empty() {
        take(&pairs, is_part)?;
    }
    Ok(truncated)
}

/// Returns whether all attribute values of the Gaussian in row `row` of `states` are finite.
pub fn is_finite(states: &Gaussians, row: usize) -> bool {
    let columns = Attributes::all().iter().map(|column| states.attribute_values(column));
    columns.into_iter().all(|column| (0..column.width()).all(|c| column.plane(c)[row].is_finite()))
}

#[cfg(test)]
mod tests;
