//! Motion-consistent merging by moment matching (method.md, section 5).
//!
//! ```text
//! states at the reference frame ─▶ neighbors ─▶ gates ─▶ pairs ─▶ motion ─▶ greedy ─▶ proxy
//!                                                          frames ──▲
//! ```
//!
//! In: the survivors' states at the reference frame, and whoever can measure the motion of pairs. Out:
//! groups of survivors and one state per group of several.
//!
//! Memory, all of it resident at once at the worst: per survivor its state, which the caller holds, the states of
//! proxies, of which there are half as many at most, before a pass and after it, and [`BYTES_PER_SURVIVOR`]; per
//! candidate pair of those that are measured together [`BYTES_PER_PAIR`], and per pair that passed all tests
//! [`BYTES_PER_PASSING`]. Pairs are at most `max_neighbors` per survivor, 3.5 measured among evenly strewn Gaussians.
//! Whoever measures motion needs more.

pub mod gates;
pub mod greedy;
mod groups;
pub mod known;
pub mod merged;
pub mod moments;
pub mod motion;
pub mod motion_pass;
pub mod neighbors;
pub mod proxy;
pub(crate) mod trajectories;
pub mod tree;
pub mod voxels;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::model::hash_id;
use crate::model::{Columns, Gaussians};
use crate::recipe;
use gates::{Appearance, Gates};
pub use groups::MergeGroups;
use known::KNOWN_BYTES;
use neighbors::{NeighborSearch, PointIndex};
use proxy::Importance;
use tree::TreePoint;

/// Memory per survivor beside its state while a pass is made: groups 12 before and 12 after, place of the state 4,
/// rank 4, and the largest of the neighbor index, 46, who coincides with whom, 24, and the clustering, 24.
pub const BYTES_PER_SURVIVOR: usize = 12 + 12 + 4 + 4 + 46;

/// Memory per candidate pair of those handed on together, beside what measuring takes: the pair, the same pair as one
/// to be measured, what is known of it and of another of earlier passes ([`known::KnownPairs`]), and its likeness.
pub const BYTES_PER_PAIR: usize = 2 * size_of::<(u32, u32)>() + 2 * KNOWN_BYTES + size_of::<f64>();

/// Memory per pair that passed all tests of a pass: the pair, with some room for the list to grow.
pub const BYTES_PER_PASSING: usize = size_of::<(u32, u32)>() + size_of::<u32>();

/// Nodes whose neighbors one task looks up.
const CHUNK: usize = 1024;

/// The Gaussians to merge: some rows of a table of states.
#[derive(Debug, Clone, Copy)]
pub struct Survivors<'a> {
    /// States at the reference frame. Of the harmonics only the first band is read; proxies get as many as there are.
    pub states: &'a Gaussians,
    /// The M rows that survive, increasing.
    pub rows: &'a [u32],
    /// Ids of all rows, whose hashes break ties of size; C by id, the size that ranks leaders; and Vis by id.
    pub importance: Importance<'a>,
    /// With which others each of the rows may merge: those of its class; none: with nobody. One whose state is not finite
    /// never does.
    pub classes: &'a [Option<u8>],
    /// Scene extent, the unit of [`LengthUnit::Extent`](recipe::LengthUnit::Extent).
    pub extent: f64,
}

/// Pairs of a pass whose motion is asked for.
#[derive(Debug, Clone, Copy)]
pub struct RequestedPairs<'a> {
    pairs: &'a [(u32, u32)],
    row: &'a [u32],
    /// ε of the pass, scene units: the nodes of a pair lie within it.
    pub reach: f64,
    /// Whether there are more in this pass, asked for before or after.
    pub is_part: bool,
}

impl<'a> RequestedPairs<'a> {
    /// The pairs, as rows of the states.
    pub fn pairs(self) -> impl ExactSizeIterator<Item = (u32, u32)> + 'a {
        self.pairs.iter().map(move |&(i, j)| (self.row[i as usize], self.row[j as usize]))
    }
}

/// What merging made of the survivors.
#[derive(Debug, Clone)]
pub struct Merged {
    /// Who stands for whom.
    pub groups: MergeGroups,
    /// State at the reference frame of every group of more than one member, in their order.
    pub proxies: Gaussians,
    /// What each pass did; passes after the limit was met are not made.
    pub passes: Vec<PassCounts>,
}

/// What one pass did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PassCounts {
    /// Nodes with more neighbors within ε than were looked at.
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

/// All passes of `recipe` over `survivors`, in each of which nodes that coincide merge first.
///
/// `measure` answers test 3: for every pair, in order, how alike it moves; a pair passes where that exceeds the pass's
/// τ_m. It is asked once per pass, and once before if nodes coincide, unless no pair is left; more often if there are
/// more than `most_pairs`: then for so many at a time, in the voxel order of those that lead. The answer depends on the
/// pair alone, so the caller may remember it. In later passes nodes are groups: state = proxy over all original members,
/// size = ΣC, trajectory, life and hash = the leader's.
///
/// With `limit`, merging stops after exactly that many joins over all passes, or fewer if there are
/// not so many; the joins kept are the first ones in sequential order. Fails only if `measure` does.
pub fn run<E>(
    survivors: &Survivors<'_>,
    recipe: &recipe::MergeParams,
    limit: Option<usize>,
    most_pairs: usize,
    mut measure: impl FnMut(RequestedPairs<'_>) -> Result<Vec<f64>, E>,
) -> Result<Merged, E> {
    let importance = &survivors.importance;
    let unit = recipe.length_unit.in_scene_units(survivors.extent);
    let mut groups = MergeGroups::alone(survivors.rows);
    let mut proxies = survivors.states.pick(&[]);
    let (mut passes, mut left) = (Vec::new(), limit);
    for pass in &recipe.passes {
        if left == Some(0) {
            break;
        }
        let mut counts = PassCounts::default();
        for coincident in [true, false] {
            let rank = ranks(&groups, importance);
            let nodes = MergeNodes::new(survivors, &groups, &proxies);
            let mut pairs = Vec::new();
            let take = |some: &[(u32, u32)], is_part| {
                let asked = RequestedPairs { pairs: some, row: groups.leaders(), reach: pass.epsilon * unit, is_part };
                let likeness = measure(asked)?;
                debug_assert_eq!(likeness.len(), some.len(), "one likeness per pair");
                let alike = some.iter().zip(likeness).filter(|&(_, likeness)| likeness > pass.tau_m);
                pairs.extend(alike.map(|(&pair, _)| pair));
                counts.candidates += some.len();
                Ok::<_, E>(())
            };
            if coincident {
                each_coincident(&nodes, &rank, &Gates::new(recipe, pass), most_pairs, take)?;
                if pairs.is_empty() {
                    continue;
                }
            } else {
                counts.truncated = each_candidate(&nodes, &rank, recipe, (pass, unit), most_pairs, take)?;
            }
            counts.passing += pairs.len();
            let clustering = greedy::cluster(&rank, pairs, left);
            left = left.map(|left| left - clustering.joins);
            counts.joins += clustering.joins;
            counts.rounds += clustering.rounds;
            counts.sequential |= clustering.sequential;
            groups = groups.joined(&clustering.leader_of);
            proxies = proxy::merge_groups(&groups, importance, survivors.states, recipe);
            if left == Some(0) {
                break;
            }
        }
        passes.push(counts);
    }
    Ok(Merged { groups, proxies, passes })
}

/// The rank of every group: by ΣC, ties by the hash of the leader's id.
fn ranks(groups: &MergeGroups, importance: &Importance<'_>) -> Vec<u32> {
    let size = |group: usize| groups.members(group).iter().map(|&row| importance.coverage(row)).sum();
    let sizes: Vec<f64> = (0..groups.len()).map(size).collect();
    let hash = |&row: &u32| hash_id(importance.ids[row as usize].into());
    let hashes: Vec<u64> = groups.leaders().iter().map(hash).collect();
    greedy::ranks(&sizes, &hashes)
}

/// The groups of a pass: Gaussians that are alone, and proxies.
struct MergeNodes<'a> {
    survivors: &'a Survivors<'a>,
    groups: &'a MergeGroups,
    proxies: &'a Gaussians,
    /// Row of the survivors' states, or of the proxies.
    place: Vec<u32>,
}

impl<'a> MergeNodes<'a> {
    fn new(survivors: &'a Survivors<'a>, groups: &'a MergeGroups, proxies: &'a Gaussians) -> Self {
        let mut place = groups.leaders().to_vec();
        for (proxy, group) in groups.clusters().enumerate() {
            place[group as usize] = proxy as u32;
        }
        MergeNodes { survivors, groups, proxies, place }
    }

    fn len(&self) -> usize {
        self.place.len()
    }

    /// The states among which that of `node` is, and its row.
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

    fn look(&self, node: usize) -> Appearance {
        let (states, row) = self.state(node);
        Appearance::new(states, row)
    }

    /// The bits of all that an [`Appearance`] is made of, −0 as 0.
    fn look_bits(&self, node: usize) -> [u32; 13] {
        let (states, row) = self.state(node);
        let [x, y, z] = states.position.row(row);
        let [qw, qx, qy, qz] = states.rotation.row(row);
        let [a, b, c] = states.log_scale.row(row);
        let [red, green, blue] = states.sh.row(row);
        [x, y, z, qw, qx, qy, qz, a, b, c, red, green, blue].map(|value: f32| (value + 0.0).to_bits())
    }
}

/// Calls `take` with the pairs (leader, member) of coincident nodes: nodes that are equal in every attribute that `gates`
/// compare, and that pass them. The leader of such a crowd is its first node in rank, and all others are its members,
/// however many. Pairs come ordered by leader, `most` (at least 1) at a time.
///
/// Needed because the neighbor search returns a fixed number of nearest Gaussians: where more coincide, all their neighbors
/// are members of the same crowd, so that it would neither merge into one nor meet the Gaussians around it.
fn each_coincident<E>(
    nodes: &MergeNodes<'_>,
    rank: &[u32],
    gates: &Gates,
    most: usize,
    mut take: impl FnMut(&[(u32, u32)], bool) -> Result<(), E>,
) -> Result<(), E> {
    let key = |node: usize| nodes.look_bits(node).iter().fold(0, |key, &bits| hash_id(key ^ u64::from(bits)));
    let usable = (0..nodes.len()).into_par_iter().filter(|&node| nodes.is_usable(node));
    let mut order: Vec<(u64, u32, u32)> = usable.map(|node| (key(node), rank[node], node as u32)).collect();
    order.par_sort_unstable();
    let mut pairs = Vec::new();
    for crowd in order.chunk_by(|a, b| a.0 == b.0).filter(|crowd| crowd.len() > 1) {
        let leader = crowd[0].2;
        let (bits, look) = (nodes.look_bits(leader as usize), nodes.look(leader as usize));
        let class = nodes.class(leader as usize);
        let is_like = |node: usize| nodes.class(node) == class && nodes.look_bits(node) == bits;
        let alike = |node: u32| is_like(node as usize) && gates.pass(&look, &nodes.look(node as usize));
        pairs.extend(crowd[1..].iter().filter(|member| alike(member.2)).map(|member| (leader, member.2)));
    }
    drop(order);
    pairs.par_sort_unstable();
    let is_part = pairs.len() > most;
    pairs.chunks(most).try_for_each(|some| take(some, is_part))
}

/// Hands on the pairs of nodes (leader, member) that pass tests 1 and 2 of `pass`, `unit` being the length of one unit
/// of the recipe: the member is among the leader's nearest neighbors and ranks behind it. By leader in voxel order,
/// then by distance; `most` (at least 1) at a time, and whether that is a part of them. Gives the number of nodes with
/// more neighbors within ε than were looked at.
///
/// A node that is not mergeable or not finite leads nobody, joins nobody and takes no place among the nearest
/// neighbors of others.
fn each_candidate<E>(
    nodes: &MergeNodes<'_>,
    rank: &[u32],
    recipe: &recipe::MergeParams,
    (pass, unit): (&recipe::MergePass, f64),
    most: usize,
    mut take: impl FnMut(&[(u32, u32)], bool) -> Result<(), E>,
) -> Result<usize, E> {
    let usable = (0..nodes.len()).into_par_iter().filter(|&node| nodes.is_usable(node));
    let points = usable.map(|node| TreePoint { at: nodes.position(node), index: node as u32 }).collect();
    let index = PointIndex::new(points, pass.epsilon * unit);
    let gates = Gates::new(recipe, pass);
    let of_chunk = |search: &mut NeighborSearch<'_>, leaders: &[TreePoint]| {
        let (mut pairs, mut truncated) = (Vec::new(), 0);
        for &TreePoint { at, index: i } in leaders {
            let (look, class) = (nodes.look(i as usize), nodes.class(i as usize));
            let passes = |j: u32| nodes.class(j as usize) == class && gates.pass(&look, &nodes.look(j as usize));
            let (near, cut) = search.nearest(i, at, recipe.max_neighbors);
            truncated += usize::from(cut);
            let behind = near.filter(|&j| rank[i as usize] < rank[j as usize]);
            pairs.extend(behind.filter(|&j| passes(j)).map(|j| (i, j)));
        }
        (pairs, truncated)
    };
    let (mut pairs, mut truncated, mut is_part) = (Vec::new(), 0, false);
    // One batch of chunks at a time bounds the pairs that wait beside those that are handed on.
    for batch in index.points().chunks(2 * CHUNK * rayon::current_num_threads()) {
        let chunks: Vec<(Vec<(u32, u32)>, usize)> =
            batch.par_chunks(CHUNK).map_init(|| index.search(), of_chunk).collect();
        for (of_chunk, cut) in chunks {
            pairs.extend(of_chunk);
            truncated += cut;
        }
        while pairs.len() > most {
            is_part = true;
            take(&pairs[..most], is_part)?;
            pairs.drain(..most);
        }
    }
    if !pairs.is_empty() {
        take(&pairs, is_part)?;
    }
    Ok(truncated)
}

/// Whether every value of a row is finite.
pub fn is_finite(states: &Gaussians, row: usize) -> bool {
    let columns = Columns::all().iter().map(|column| states.column(column));
    columns.into_iter().all(|column| (0..column.width()).all(|c| column.plane(c)[row].is_finite()))
}

#[cfg(test)]
mod tests;
