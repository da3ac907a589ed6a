//! Assignment of Gaussians to leaders (Gaussians that take others into their cluster): the sequential greedy rule,
//! computed in parallel.
//!
//! The rule: visit the nodes (single Gaussians, or groups merged in earlier passes) in order of rank. A node that no
//! leader has taken becomes a leader, and takes every node that passes all tests with it and that no leader has taken.
//! Members are tested against their leader only. The leaders are therefore the lexicographically first independent set,
//! and every other node joins the earliest leader that it passes with. This set can be computed locally (Blelloch,
//! Fineman and Shun, "Greedy sequential maximal independent set and matching are parallel on average", 2012): in
//! synchronous rounds a node reads only the decisions of earlier rounds, so the thread count cannot change the result.
//!
//! Input: the rank of every node, and the pairs (leader, member) that passed the tests. Output: a leader for every
//! node. Memory: 24 bytes per node in addition to the input. The pairs are sorted in place.

use rayon::prelude::*;

use crate::model::inverse_permutation;

/// Maximum number of parallel rounds. Nodes (Gaussians or merged groups) that have no leader (node that they join)
/// after the last round are assigned sequentially. Scenes need 5 to 8 rounds. A chain of Gaussians that are ranked in
/// their order along a line would need one round for every two Gaussians.
const MAX_ROUNDS: usize = 32;
/// Maximum number of undecided nodes that are assigned to their leaders sequentially at the end. For so few nodes
/// another parallel round would take longer.
const MAX_SEQUENTIAL_NODES: usize = 64;

/// Result of clustering: for every node its leader, which is the node that it joins or itself, and statistics of how
/// the leaders were found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Clustering {
    /// Index of the leader of every node: the node that it joined, or the node itself if it joined no other.
    pub leader_of: Vec<u32>,
    /// Number of nodes that joined another node.
    pub joins: usize,
    /// Number of parallel rounds in which nodes were assigned to leaders (the nodes that they join).
    pub rounds: usize,
    /// Whether more than 64 nodes had no leader after the last of 32 parallel rounds, so that many nodes were assigned
    /// sequentially.
    pub sequential: bool,
}

/// Returns the rank of every node, from 0: its position in the order in which the greedy rule visits the nodes. `size`
/// holds the importance of every node. Nodes are ordered by descending `size`; ties by ascending `hash`, then by index.
///
/// A size that is NaN counts as the smallest; −0 equals 0.
pub fn ranks(size: &[f64], hash: &[u64]) -> Vec<u32> {
    // Adding 0.0 turns −0 into 0.
    let key = |i: u32| if size[i as usize].is_nan() { f64::NEG_INFINITY } else { size[i as usize] + 0.0 };
    let mut order: Vec<u32> = (0..size.len() as u32).collect();
    order.par_sort_unstable_by(|&a, &b| {
        key(b).total_cmp(&key(a)).then(hash[a as usize].cmp(&hash[b as usize])).then(a.cmp(&b))
    });
    inverse_permutation(&order)
}

/// Value in `leader_of` of a node that has no leader yet. For all other nodes the value is the index of the leader: the
/// node into which the node is merged, or the node itself.
const UNDECIDED: u32 = u32::MAX;

/// Assigns every node to a leader by the sequential greedy rule of this module: the node that it joins, or itself.
/// Returns the assignment.
///
/// - `rank`: rank of every node, a permutation of 0..N;
/// - `pairs`: pairs (leader, member) that passed all tests, in any order; the leader has the lower rank;
/// - `limit`: maximum number of joins. Only the first joins are made, in the order of the leader's rank, then of the
///   member's. The members of all later joins stay single.
pub fn cluster(rank: &[u32], pairs: Vec<(u32, u32)>, limit: Option<usize>) -> Clustering {
    let predecessors = Predecessors::new(rank, pairs);
    let mut leader_of = vec![UNDECIDED; rank.len()];
    let mut undecided: Vec<u32> = (0..rank.len() as u32).collect();
    let mut rounds = 0;
    while undecided.len() > MAX_SEQUENTIAL_NODES && rounds < MAX_ROUNDS {
        let decisions: Vec<Option<u32>> =
            undecided.par_iter().map(|&node| predecessors.decide(node, &leader_of)).collect();
        for (&node, decision) in undecided.iter().zip(&decisions) {
            if let Some(leader) = *decision {
                leader_of[node as usize] = leader;
            }
        }
        undecided.retain(|&node| leader_of[node as usize] == UNDECIDED);
        rounds += 1;
    }
    let sequential = undecided.len() > MAX_SEQUENTIAL_NODES;
    undecided.sort_unstable_by_key(|&node| rank[node as usize]);
    for node in undecided {
        // Every predecessor (node that could take this one) is decided by now, so `decide` always returns a leader.
        leader_of[node as usize] = predecessors.decide(node, &leader_of).unwrap_or(node);
    }
    let joins = truncate(rank, &mut leader_of, limit);
    Clustering { leader_of, joins, rounds, sequential }
}

/// For every node, its possible leaders: the nodes of lower rank that it could join.
struct Predecessors {
    start: Vec<usize>,
    /// Pairs (possible leader, node). A node is a Gaussian or a merged group. It may join the possible leader, a node
    /// of lower rank. The rank of a node is its position in the order in which the greedy rule visits the nodes. The
    /// pairs are sorted by the index of the node; pairs of the same node are sorted by the rank of the possible leader.
    pairs: Vec<(u32, u32)>,
}

impl Predecessors {
    fn new(rank: &[u32], mut pairs: Vec<(u32, u32)>) -> Self {
        pairs.par_sort_unstable_by_key(|&(leader, member)| (member, rank[leader as usize]));
        let mut start = vec![0; rank.len() + 1];
        for &(_, member) in &pairs {
            start[member as usize + 1] += 1;
        }
        for node in 0..rank.len() {
            start[node + 1] += start[node];
        }
        Predecessors { start, pairs }
    }

    /// Returns the leader of `node`: the node that it joins, or itself. Returns `None` if this cannot be decided yet,
    /// because a predecessor (node of lower rank that could take `node`) has no leader in `leader_of`.
    fn decide(&self, node: u32, leader_of: &[u32]) -> Option<u32> {
        let candidates = &self.pairs[self.start[node as usize]..self.start[node as usize + 1]];
        for &(predecessor, _) in candidates {
            match leader_of[predecessor as usize] {
                UNDECIDED => return None,
                leader if leader == predecessor => return Some(leader),
                _member => {}
            }
        }
        Some(node)
    }
}

/// Keeps only the first `limit` joins in `leader_of`, and undoes all others. Joins are ordered by the `rank` of the
/// leader, then by the rank of the node that joins it. Without `limit`, keeps all joins. Returns the number of joins
/// that remain.
fn truncate(rank: &[u32], leader_of: &mut [u32], limit: Option<usize>) -> usize {
    let joined = |(node, &leader): (usize, &u32)| (node as u32 != leader).then_some(node as u32);
    let all = leader_of.iter().enumerate().filter_map(joined).count();
    let Some(limit) = limit.filter(|&limit| limit < all) else { return all };
    let mut members: Vec<u32> = leader_of.iter().enumerate().filter_map(joined).collect();
    members.par_sort_unstable_by_key(|&node| (rank[leader_of[node as usize] as usize], rank[node as usize]));
    for &node in &members[limit..] {
        leader_of[node as usize] = node;
    }
    limit
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Slow reference implementation of the sequential greedy rule of this module. Visits the nodes in order of `rank`.
    /// A node without a leader becomes a leader. Every node without a leader that forms a pair (leader, node) in
    /// `pairs` with it joins it, as long as the number of joins is below `limit`. Returns the leader of every node and
    /// the number of joins.
    fn sequential_oracle(rank: &[u32], pairs: &[(u32, u32)], limit: Option<usize>) -> (Vec<u32>, usize) {
        let n = rank.len();
        let mut order: Vec<u32> = (0..n as u32).collect();
        order.sort_by_key(|&node| rank[node as usize]);
        let mut leader_of: Vec<Option<u32>> = vec![None; n];
        let mut joins = 0;
        for &leader in &order {
            if leader_of[leader as usize].is_some() {
                continue;
            }
            leader_of[leader as usize] = Some(leader);
            for &member in &order {
                let free = leader_of[member as usize].is_none();
                if free && pairs.contains(&(leader, member)) {
                    // A join beyond the limit is not made; the member stays single, because no other leader may take it
                    // either.
                    leader_of[member as usize] =
                        Some(if limit.is_none_or(|limit| joins < limit) { leader } else { member });
                    joins += usize::from(leader_of[member as usize] == Some(leader));
                }
            }
        }
        (leader_of.into_iter().map(|leader| leader.expect("all visited")).collect(), joins)
    }

    fn any_graph() -> impl Strategy<Value = (Vec<u32>, Vec<(u32, u32)>)> {
        (1usize..200, 0usize..600).prop_flat_map(|(n, edges)| {
            let ranks = Just((0..n as u32).collect::<Vec<_>>()).prop_shuffle();
            (ranks, prop::collection::vec((0..n as u32, 0..n as u32), edges)).prop_map(|(rank, edges)| {
                let mut pairs: Vec<(u32, u32)> = edges
                    .into_iter()
                    .filter(|(a, b)| a != b)
                    .map(|(a, b)| if rank[a as usize] < rank[b as usize] { (a, b) } else { (b, a) })
                    .collect();
                pairs.dedup();
                (rank, pairs)
            })
        })
    }

    fn assert_equals_oracle(rank: &[u32], pairs: &[(u32, u32)], limit: Option<usize>) -> Clustering {
        let got = cluster(rank, pairs.to_vec(), limit);
        let (leader_of, joins) = sequential_oracle(rank, pairs, limit);
        assert_eq!((&got.leader_of, got.joins), (&leader_of, joins), "limit {limit:?}");
        got
    }

    proptest! {
        #[test]
        fn rounds_equal_the_sequential_rule((rank, pairs) in any_graph(), limit in prop::option::of(0usize..150)) {
            assert_equals_oracle(&rank, &pairs, limit);
        }

        #[test]
        fn order_of_pairs_does_not_matter((rank, pairs) in any_graph()) {
            let mut reversed = pairs.clone();
            reversed.reverse();
            prop_assert_eq!(cluster(&rank, pairs, None), cluster(&rank, reversed, None));
        }
    }

    #[test]
    fn a_long_chain_is_finished_sequentially_with_equal_result() {
        let n = 1000;
        let rank: Vec<u32> = (0..n).collect();
        let pairs: Vec<(u32, u32)> = (1..n).map(|i| (i - 1, i)).collect();
        let got = assert_equals_oracle(&rank, &pairs, None);
        assert!(got.sequential, "a chain of {n} was decided in {} rounds", got.rounds);
        assert_eq!((got.rounds, got.joins), (MAX_ROUNDS, 500));
        let backwards: Vec<u32> = (0..n).rev().collect();
        let pairs: Vec<(u32, u32)> = (1..n).map(|i| (i, i - 1)).collect();
        assert!(assert_equals_oracle(&backwards, &pairs, None).sequential);
    }

    #[test]
    fn stars_and_complete_graphs_get_one_leader() {
        let n = 300;
        let rank: Vec<u32> = (0..n).collect();
        let star: Vec<(u32, u32)> = (1..n).map(|i| (0, i)).collect();
        assert_eq!(assert_equals_oracle(&rank, &star, None).leader_of, vec![0; n as usize]);
        let complete: Vec<(u32, u32)> = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).collect();
        let got = cluster(&rank, complete, None);
        assert_eq!((got.leader_of, got.sequential), (vec![0; n as usize], false));
    }

    #[test]
    fn members_never_lead_and_the_earliest_leader_wins() {
        // Node 0 takes 1. Node 1 could take 2 but was taken itself. So 2 is free when it is visited, leads, and takes
        // 3.
        let got = cluster(&[0, 1, 2, 3], vec![(0, 1), (1, 2), (2, 3)], None);
        assert_eq!(got.leader_of, [0, 0, 2, 2]);
        let got = cluster(&[1, 0, 2], vec![(0, 2), (1, 2)], None);
        assert_eq!(got.leader_of, [0, 1, 1]);
    }

    #[test]
    fn the_limit_is_met_exactly() {
        let rank: Vec<u32> = (0..100).collect();
        let star: Vec<(u32, u32)> = (1..100).map(|i| (0, i)).collect();
        for limit in [0, 1, 57, 99, 100] {
            let got = assert_equals_oracle(&rank, &star, Some(limit));
            assert_eq!(got.joins, limit.min(99));
        }
    }

    #[test]
    fn ranks_descend_by_size_then_hash_with_nan_last() {
        let size = [1.0, f64::NAN, 2.0, 1.0, 0.0, -0.0];
        let hash = [9, 0, 0, 3, 5, 4];
        assert_eq!(ranks(&size, &hash), [2, 5, 0, 1, 4, 3]);
    }
}
