//! Which Gaussians join which leader: the sequential greedy rule, computed in parallel.
//!
//! The rule: in order of rank, a node that no leader took leads and takes every node that it passes
//! with and that no leader took. A pair is tested against the leader only, so the leaders are the
//! lexicographically first independent set, and whoever does not lead joins its earliest leader.
//! That much is decided locally (Blelloch, Fineman and Shun, "Greedy sequential maximal independent
//! set and matching are parallel on average", 2012): in synchronous rounds a node reads only what
//! earlier rounds decided, so threads cannot change the outcome.
//!
//! In: ranks and directed pairs. Out: a leader for every node. Memory: 24 bytes per node beside the
//! input; the pairs are sorted where they lie.

use rayon::prelude::*;

/// Rounds before the rest is done sequentially: 5 to 8 suffice for scenes, a chain sorted along a
/// line would need one for every second node.
const MAX_ROUNDS: usize = 32;
/// Below this many undecided nodes another round costs more than finishing in order.
const FEW: usize = 64;

/// Who leads whom.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Clustering {
    /// Leader of every node; a node that joined nobody is its own.
    pub leader_of: Vec<u32>,
    /// Nodes that joined another.
    pub joins: usize,
    /// Parallel rounds it took.
    pub rounds: usize,
    /// Whether nodes were left over after the last round and decided in sequence.
    pub sequential: bool,
}

/// The rank of every node: descending size, then ascending hash, then index; a permutation of 0..N.
///
/// A size that is NaN counts as the smallest; −0 equals 0.
pub fn ranks(size: &[f64], hash: &[u64]) -> Vec<u32> {
    // + 0.0 turns -0 into 0.
    let key = |i: u32| if size[i as usize].is_nan() { f64::NEG_INFINITY } else { size[i as usize] + 0.0 };
    let mut order: Vec<u32> = (0..size.len() as u32).collect();
    order.par_sort_unstable_by(|&a, &b| {
        key(b).total_cmp(&key(a)).then(hash[a as usize].cmp(&hash[b as usize])).then(a.cmp(&b))
    });
    let mut rank = vec![0; order.len()];
    for (r, node) in order.into_iter().enumerate() {
        rank[node as usize] = r as u32;
    }
    rank
}

/// What is known of a node. A member is stored as the index of its leader.
const UNDECIDED: u32 = u32::MAX;

/// Clusters the nodes with these `rank`s (a permutation of 0..N) along `pairs` (leader, member),
/// rank(leader) < rank(member), in any order; the outcome is that of the sequential rule.
///
/// With `limit`, merging stops after exactly that many joins in sequential order: by the leader's
/// rank, then by the member's. Members cut off stay alone.
pub fn cluster(rank: &[u32], pairs: Vec<(u32, u32)>, limit: Option<usize>) -> Clustering {
    let predecessors = Predecessors::new(rank, pairs);
    let mut leader_of = vec![UNDECIDED; rank.len()];
    let mut undecided: Vec<u32> = (0..rank.len() as u32).collect();
    let mut rounds = 0;
    while undecided.len() > FEW && rounds < MAX_ROUNDS {
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
    let sequential = undecided.len() > FEW;
    undecided.sort_unstable_by_key(|&node| rank[node as usize]);
    for node in undecided {
        // Every predecessor is decided by now, so there always is a decision.
        leader_of[node as usize] = predecessors.decide(node, &leader_of).unwrap_or(node);
    }
    let joins = truncate(rank, &mut leader_of, limit);
    Clustering { leader_of, joins, rounds, sequential }
}

/// The leaders that could take a node, for every node, by rank.
struct Predecessors {
    start: Vec<usize>,
    /// (leader, member), by member.
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

    /// The leader of `node` (itself if it leads) as far as `leader_of` tells; none while an earlier
    /// predecessor that might take it is undecided.
    fn decide(&self, node: u32, leader_of: &[u32]) -> Option<u32> {
        let of_node = &self.pairs[self.start[node as usize]..self.start[node as usize + 1]];
        for &(predecessor, _) in of_node {
            match leader_of[predecessor as usize] {
                UNDECIDED => return None,
                leader if leader == predecessor => return Some(leader),
                _member => {}
            }
        }
        Some(node)
    }
}

/// Undoes all joins but the first `limit` in sequential order; returns how many remain.
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

    /// The rule as it reads: nodes in order, each unmerged one takes what it can.
    fn one_by_one(rank: &[u32], pairs: &[(u32, u32)], limit: Option<usize>) -> (Vec<u32>, usize) {
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
                    // A join beyond the limit is not made, yet nobody else may have the member.
                    leader_of[member as usize] =
                        Some(if limit.is_none_or(|limit| joins < limit) { leader } else { member });
                    joins += usize::from(leader_of[member as usize] == Some(leader));
                }
            }
        }
        (leader_of.into_iter().map(|leader| leader.expect("all visited")).collect(), joins)
    }

    fn graph() -> impl Strategy<Value = (Vec<u32>, Vec<(u32, u32)>)> {
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

    fn assert_sequential(rank: &[u32], pairs: &[(u32, u32)], limit: Option<usize>) -> Clustering {
        let got = cluster(rank, pairs.to_vec(), limit);
        let (leader_of, joins) = one_by_one(rank, pairs, limit);
        assert_eq!((&got.leader_of, got.joins), (&leader_of, joins), "limit {limit:?}");
        got
    }

    proptest! {
        #[test]
        fn rounds_equal_the_sequential_rule_on_any_graph((rank, pairs) in graph(), limit in prop::option::of(0usize..150)) {
            assert_sequential(&rank, &pairs, limit);
        }

        #[test]
        fn the_order_of_pairs_does_not_matter((rank, pairs) in graph()) {
            let mut reversed = pairs.clone();
            reversed.reverse();
            prop_assert_eq!(cluster(&rank, pairs, None), cluster(&rank, reversed, None));
        }
    }

    #[test]
    fn a_chain_sorted_along_a_line_falls_back_and_equals_the_sequential_result() {
        let n = 1000;
        let rank: Vec<u32> = (0..n).collect();
        let pairs: Vec<(u32, u32)> = (1..n).map(|i| (i - 1, i)).collect();
        let got = assert_sequential(&rank, &pairs, None);
        assert!(got.sequential, "a chain of {n} was decided in {} rounds", got.rounds);
        assert_eq!((got.rounds, got.joins), (MAX_ROUNDS, 500));
        let backwards: Vec<u32> = (0..n).rev().collect();
        let pairs: Vec<(u32, u32)> = (1..n).map(|i| (i, i - 1)).collect();
        assert!(assert_sequential(&backwards, &pairs, None).sequential);
    }

    #[test]
    fn a_star_is_taken_whole_and_a_crowd_of_duplicates_has_one_leader() {
        let n = 300;
        let rank: Vec<u32> = (0..n).collect();
        let star: Vec<(u32, u32)> = (1..n).map(|i| (0, i)).collect();
        assert_eq!(assert_sequential(&rank, &star, None).leader_of, vec![0; n as usize]);
        let crowd: Vec<(u32, u32)> = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).collect();
        let got = cluster(&rank, crowd, None);
        assert_eq!((got.leader_of, got.sequential), (vec![0; n as usize], false));
    }

    #[test]
    fn a_member_does_not_lead_and_the_earliest_leader_wins() {
        // 0 takes 1; 1 could take 2 but was taken; 3 passes with 2 only, so 2 leads it.
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
            let got = assert_sequential(&rank, &star, Some(limit));
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
