//! The nearest neighbours of every Gaussian, by a k-d tree that stays fast when points coincide.
//!
//! In: positions. Out: for a Gaussian the at most K nearest others within ε, nearest first, ties by
//! index. The answer is defined by (distance, index) alone, so it does not depend on the tree, on
//! threads or on any partition of space. Memory: 16 bytes per point and 28 per node of the tree, two
//! nodes for every 4 to 8 points: 23 to 30 bytes per point.
//!
//! Every node of the tree knows the smallest index below it, and a subtree is skipped unless it can
//! hold a pair (distance, index) below the worst one kept. With ten million points at one place all
//! distances are equal, the K smallest indices are found at once and all else is skipped; a tree
//! that prunes by distance alone visits every point for every point.

use std::collections::BinaryHeap;

/// Points in a leaf, at most.
const LEAF: usize = 8;
/// Subtrees smaller than this are built by one thread.
const PARALLEL: usize = 1 << 14;

#[derive(Debug, Clone, Copy, Default)]
struct Point {
    at: [f32; 3],
    index: u32,
}

#[derive(Debug, Clone, Copy)]
struct Node {
    low: [f32; 3],
    high: [f32; 3],
    smallest: u32,
}

/// A perfect binary tree over points: nodes in preorder, all leaves at one depth.
#[derive(Debug)]
pub struct PointIndex {
    points: Vec<Point>,
    nodes: Vec<Node>,
    depth: u32,
}

/// A candidate: squared distance as bits, whose order is that of the values (≥ 0), then index.
type Found = (u64, u32);

/// Working memory of [`PointIndex::nearest`], to be used again by the same thread.
#[derive(Debug, Default)]
pub struct Search {
    heap: BinaryHeap<Found>,
    found: Vec<Found>,
}

impl PointIndex {
    /// Indexes those of `count` points that `position` has a place for and that are finite.
    pub fn new(count: usize, position: impl Fn(usize) -> Option<[f32; 3]>) -> Self {
        let mut points: Vec<Point> = Vec::with_capacity(count);
        let finite = |at: &[f32; 3]| at.iter().all(|x| x.is_finite());
        let point = |i| Some(Point { at: position(i).filter(finite)?, index: i as u32 });
        points.extend((0..count).filter_map(point));
        let depth = points.len().div_ceil(LEAF).next_power_of_two().trailing_zeros();
        let empty = Node { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3], smallest: u32::MAX };
        let mut nodes = vec![empty; (2usize << depth) - 1];
        build(&mut points, &mut nodes);
        PointIndex { points, nodes, depth }
    }

    /// The at most `k` nearest indexed points other than `query` whose distance to `at` is at most
    /// `epsilon`, nearest first, equal distances by index; and whether there were more than `k`.
    ///
    /// Squared distances are summed in f64 and compared with ε². Edges: a point that is not finite
    /// has no neighbours; ε = 0 finds exact duplicates.
    pub fn nearest<'s>(
        &self,
        query: u32,
        at: [f32; 3],
        k: usize,
        epsilon: f64,
        search: &'s mut Search,
    ) -> (impl ExactSizeIterator<Item = u32> + 's, bool) {
        search.heap.clear();
        if at.iter().all(|x| x.is_finite()) && !self.points.is_empty() {
            let at = at.map(f64::from);
            // One more than k tells whether the list was cut.
            let query = Query { own: query, at, wanted: k + 1, limit: ((epsilon * epsilon).to_bits(), u32::MAX) };
            let entry = self.nodes[0].nearest_possible(at);
            self.visit(&query, 0, self.depth, 0..self.points.len(), entry, &mut search.heap);
        }
        search.found.clear();
        search.found.extend(search.heap.drain());
        search.found.sort_unstable();
        let truncated = search.found.len() > k;
        search.found.truncate(k);
        (search.found.iter().map(|&(_, index)| index), truncated)
    }

    fn visit(
        &self,
        query: &Query,
        node: usize,
        depth: u32,
        range: std::ops::Range<usize>,
        bound: Found,
        heap: &mut BinaryHeap<Found>,
    ) {
        if bound > query.worst(heap) {
            return;
        }
        if depth == 0 {
            for point in &self.points[range] {
                let found = (squared(std::array::from_fn(|c| f64::from(point.at[c]) - query.at[c])), point.index);
                if point.index != query.own && found <= query.worst(heap) {
                    if heap.len() == query.wanted {
                        heap.pop();
                    }
                    heap.push(found);
                }
            }
            return;
        }
        let middle = range.start + range.len() / 2;
        let left = node + 1;
        let right = node + (1 << depth);
        let near = self.nodes[left].nearest_possible(query.at);
        let far = self.nodes[right].nearest_possible(query.at);
        if near <= far {
            self.visit(query, left, depth - 1, range.start..middle, near, heap);
            self.visit(query, right, depth - 1, middle..range.end, far, heap);
        } else {
            self.visit(query, right, depth - 1, middle..range.end, far, heap);
            self.visit(query, left, depth - 1, range.start..middle, near, heap);
        }
    }
}

struct Query {
    own: u32,
    at: [f64; 3],
    wanted: usize,
    limit: Found,
}

impl Query {
    /// What a find must not exceed.
    fn worst(&self, heap: &BinaryHeap<Found>) -> Found {
        match heap.peek() {
            Some(&worst) if heap.len() == self.wanted => worst,
            _ => self.limit,
        }
    }
}

impl Node {
    /// A lower bound of (distance, index) below this node. Each step of the sum is monotone in f64,
    /// so rounding cannot lift the bound above the distance of a point in the box.
    fn nearest_possible(&self, at: [f64; 3]) -> Found {
        let outside = |c: usize| (f64::from(self.low[c]) - at[c]).max(at[c] - f64::from(self.high[c])).max(0.0);
        (squared(std::array::from_fn(outside)), self.smallest)
    }
}

fn squared(d: [f64; 3]) -> u64 {
    (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).to_bits()
}

/// Fills `nodes`, the preorder of a perfect subtree over `points`, splitting at the median of the
/// widest side; equal coordinates split by index, so that low indices are met first.
fn build(points: &mut [Point], nodes: &mut [Node]) {
    let Some((node, below)) = nodes.split_first_mut() else { return };
    for point in points.iter() {
        for c in 0..3 {
            node.low[c] = node.low[c].min(point.at[c]);
            node.high[c] = node.high[c].max(point.at[c]);
        }
        node.smallest = node.smallest.min(point.index);
    }
    if below.is_empty() || points.is_empty() {
        return;
    }
    let side = |c: usize| f64::from(node.high[c]) - f64::from(node.low[c]);
    let widest = (1..3).fold(0, |best, c| if side(c) > side(best) { c } else { best });
    let middle = points.len() / 2;
    points.select_nth_unstable_by(middle, |a, b| a.at[widest].total_cmp(&b.at[widest]).then(a.index.cmp(&b.index)));
    let (left, right) = points.split_at_mut(middle);
    let (left_nodes, right_nodes) = below.split_at_mut(below.len() / 2);
    if left.len() >= PARALLEL {
        rayon::join(|| build(left, left_nodes), || build(right, right_nodes));
    } else {
        build(left, left_nodes);
        build(right, right_nodes);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use proptest::prelude::*;
    use rayon::prelude::*;

    use super::*;
    use crate::model::Column;

    fn column(points: &[[f32; 3]]) -> Column {
        let mut column = Column::zeros(3, points.len());
        for (i, &point) in points.iter().enumerate() {
            column.set_row(i, point);
        }
        column
    }

    fn indexed(position: &Column, k: usize, epsilon: f64) -> Vec<(Vec<u32>, bool)> {
        let index = PointIndex::new(position.len(), |i| Some(position.row(i)));
        let mut search = Search::default();
        (0..position.len())
            .map(|i| {
                let (found, truncated) = index.nearest(i as u32, position.row(i), k, epsilon, &mut search);
                (found.collect(), truncated)
            })
            .collect()
    }

    fn brute_force(points: &[[f32; 3]], k: usize, epsilon: f64) -> Vec<(Vec<u32>, bool)> {
        let distance2 = |a: &[f32; 3], b: &[f32; 3]| -> f64 {
            a.iter().zip(b).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum()
        };
        let neighbors = |i: usize| {
            let mut all: Vec<(f64, u32)> = (0..points.len())
                .filter(|&j| j != i)
                .map(|j| (distance2(&points[i], &points[j]), j as u32))
                .filter(|&(d2, _)| d2 <= epsilon * epsilon)
                .collect();
            all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            let truncated = all.len() > k;
            (all.into_iter().take(k).map(|(_, j)| j).collect(), truncated)
        };
        (0..points.len()).map(neighbors).collect()
    }

    proptest! {
        #[test]
        fn neighbours_equal_brute_force(
            points in prop::collection::vec(prop::array::uniform3(-1.0..1.0f32), 0..120),
            k in 1usize..9,
            epsilon in 0.0..1.5f64,
        ) {
            prop_assert_eq!(indexed(&column(&points), k, epsilon), brute_force(&points, k, epsilon));
        }

        // A coarse lattice: many points coincide, most distances tie.
        #[test]
        fn neighbours_equal_brute_force_among_duplicates_and_ties(
            cells in prop::collection::vec(prop::array::uniform3(0u8..3), 0..150),
            k in 1usize..9,
            epsilon in prop::sample::select(vec![0.0, 1.0, 2.0, 4.0]),
        ) {
            let points: Vec<[f32; 3]> = cells.iter().map(|cell| cell.map(f32::from)).collect();
            prop_assert_eq!(indexed(&column(&points), k, epsilon), brute_force(&points, k, epsilon));
        }
    }

    #[test]
    fn points_that_are_not_finite_have_no_neighbours_and_are_none() {
        let points = column(&[[0.0; 3], [f32::NAN, 0.0, 0.0], [0.0; 3], [f32::INFINITY; 3]]);
        let found = indexed(&points, 4, f64::MAX.sqrt());
        assert_eq!(found.iter().map(|(list, _)| list.clone()).collect::<Vec<_>>(), [vec![2], vec![], vec![0], vec![]]);
    }

    #[test]
    fn excluded_points_do_not_take_a_place_among_the_k() {
        let points = column(&[[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        let index = PointIndex::new(3, |i| (i != 1).then(|| points.row(i)));
        let mut search = Search::default();
        let (found, truncated) = index.nearest(0, [0.0; 3], 1, 5.0, &mut search);
        assert_eq!((found.collect::<Vec<_>>(), truncated), (vec![2], false));
    }

    /// Seconds for all neighbours of `points`, and how many lists were cut.
    fn timed(points: &[[f32; 3]], k: usize, epsilon: f64) -> (f64, usize) {
        let position = column(points);
        let start = Instant::now();
        let index = PointIndex::new(points.len(), |i| Some(points[i]));
        let cut = (0..points.len())
            .into_par_iter()
            .map_init(Search::default, |search, i| {
                let (_, truncated) = index.nearest(i as u32, position.row(i), k, epsilon, search);
                usize::from(truncated)
            })
            .sum();
        (start.elapsed().as_secs_f64(), cut)
    }

    #[test]
    fn a_crowd_at_one_point_costs_bounded_time_and_every_list_is_reported_cut() {
        let (seconds, cut) = timed(&vec![[1.0, 2.0, 3.0]; 200_000], 32, 0.1);
        assert_eq!(cut, 200_000);
        // All pairs would be 4e10 distances; 60 s leaves a slow shared machine its share.
        assert!(seconds < 60.0, "{seconds} s for 200,000 coincident points");
    }

    #[test]
    #[ignore = "ten million points: minutes and gigabytes; run with --release"]
    fn ten_million_points_in_one_voxel_cost_bounded_time() {
        let n = 10_000_000;
        let place = |i: u64, salt: u64| {
            let hash = xxhash_rust::xxh3::xxh3_64_with_seed(&i.to_le_bytes(), salt);
            (hash >> 40) as f32 / (1u64 << 24) as f32
        };
        let spread: Vec<[f32; 3]> = (0..n).map(|i| [place(i, 0), place(i, 1), place(i, 2)]).collect();
        for (name, points) in [("spread", spread), ("coincident", vec![[0.5; 3]; n as usize])] {
            let (seconds, cut) = timed(&points, 32, 1.0);
            eprintln!("{name}: {seconds:.1} s, {cut} lists cut");
            assert_eq!(cut, n as usize);
        }
    }
}
