//! Search for the nearest neighbors of every Gaussian, by a k-d tree.
//!
//! Input: positions. Output: for each Gaussian its nearest neighbors, at most K within the distance ε, nearest first,
//! ties by index. The result is defined by distance and index alone, so it does not depend on the tree or on threads.
//! Memory: 16 bytes per point, and that of the [`Tree`].

use super::tree::{NearestPoints, Tree, TreePoint};

/// Index of points that finds the neighbors of each point within the distance ε. Holds only points with finite
/// coordinates.
#[derive(Debug)]
pub struct PointIndex {
    epsilon: f64,
    /// Indexed points, in the order of the leaves of `tree`.
    points: Vec<TreePoint>,
    tree: Tree,
}

impl PointIndex {
    /// Builds an index of those of `points` that have finite coordinates, for queries within the distance `epsilon`.
    /// There may be at most 2³² − 2 points, all with different indices.
    ///
    /// Edge cases: ε = 0 finds exact duplicates; an infinite ε reaches all points.
    pub fn new(mut points: Vec<TreePoint>, epsilon: f64) -> Self {
        points.retain(|point| point.position.iter().all(|x| x.is_finite()));
        let tree = Tree::new(&mut points);
        PointIndex { epsilon, points, tree }
    }

    /// Returns all indexed points. Points that are close in space are mostly close in this list, so neighbor queries
    /// are fastest in its order.
    pub fn points(&self) -> &[TreePoint] {
        &self.points
    }

    /// Creates a search for the points nearest to a position. It can be used for many positions; each thread needs its
    /// own.
    pub fn search(&self) -> NeighborSearch<'_> {
        NeighborSearch { index: self, nearest: NearestPoints::default() }
    }
}

/// Search for the points of a [`PointIndex`] that are nearest to a position.
#[derive(Debug)]
pub struct NeighborSearch<'a> {
    index: &'a PointIndex,
    nearest: NearestPoints,
}

impl NeighborSearch<'_> {
    /// Finds the points nearest to `position`, other than the point with index `query_index`. Returns the indices of at
    /// most `k` points within the distance ε, sorted by distance, then by index. Also returns whether more than `k`
    /// points are within ε.
    ///
    /// Squared distances are summed in f64 and compared with ε². Edge case: a point that is not finite has no
    /// neighbors.
    pub fn nearest(
        &mut self,
        query_index: u32,
        position: [f32; 3],
        k: usize,
    ) -> (impl ExactSizeIterator<Item = u32>, bool) {
        // One neighbor more than `k` is sought, to know whether there are more.
        self.nearest.start_query(query_index, position, k + 1, self.index.epsilon);
        if position.iter().all(|x| x.is_finite()) {
            self.index.tree.search(&self.index.points, &mut self.nearest);
        }
        let neighbors = self.nearest.sort_by_distance();
        (neighbors[..neighbors.len().min(k)].iter().map(|&(_, index)| index), neighbors.len() > k)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use proptest::prelude::*;
    use rayon::prelude::*;

    use super::*;

    fn numbered(points: &[[f32; 3]]) -> Vec<TreePoint> {
        points.iter().zip(0..).map(|(&position, index)| TreePoint { position, index }).collect()
    }

    fn found_by_index(points: &[[f32; 3]], k: usize, epsilon: f64) -> Vec<(Vec<u32>, bool)> {
        let index = PointIndex::new(numbered(points), epsilon);
        let mut search = index.search();
        numbered(points)
            .iter()
            .map(|point| {
                let (found, truncated) = search.nearest(point.index, point.position, k);
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
        fn neighbors_equal_brute_force(
            points in prop::collection::vec(prop::array::uniform3(-1.0..1.0f32), 0..120),
            k in 1usize..9,
            epsilon in 0.0..1.5f64,
        ) {
            prop_assert_eq!(found_by_index(&points, k, epsilon), brute_force(&points, k, epsilon));
        }

        // On a coarse grid, many points coincide and most distances tie.
        #[test]
        fn duplicates_and_ties_equal_brute_force(
            cells in prop::collection::vec(prop::array::uniform3(0u8..3), 0..150),
            k in 1usize..9,
            epsilon in prop::sample::select(vec![0.0, 1.0, 2.0, 4.0]),
        ) {
            let points: Vec<[f32; 3]> = cells.iter().map(|cell| cell.map(f32::from)).collect();
            prop_assert_eq!(found_by_index(&points, k, epsilon), brute_force(&points, k, epsilon));
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        // Clusters are far narrower and far wider than ε.
        #[test]
        fn distant_clusters_equal_brute_force(
            centers in prop::collection::vec(prop::array::uniform3(-1.0..1.0f32), 1..5),
            offsets in prop::collection::vec((0usize..5, prop::array::uniform3(-1.0..1.0f32)), 0..500),
            width in prop::sample::select(vec![1e-3f32, 0.03, 1.0]),
            offset in prop::sample::select(vec![0.0f32, -3.0, 1e4, -1e7, 1e30]),
            k in 1usize..40,
            epsilon in prop::sample::select(vec![1e-30, 1e-3, 0.02, 0.25, 2.0, 1e6, f64::INFINITY]),
        ) {
            let center = |c: usize| centers[c % centers.len()];
            let position = |(c, d): &(usize, [f32; 3])| std::array::from_fn(|x| offset + center(*c)[x] + width * d[x]);
            let points: Vec<[f32; 3]> = offsets.iter().map(position).collect();
            prop_assert_eq!(found_by_index(&points, k, epsilon), brute_force(&points, k, epsilon));
        }

        // There is a point at each end of the range of f32.
        #[test]
        fn extreme_coordinates_equal_brute_force(
            points in prop::collection::vec(prop::array::uniform3(-1.0..1.0f32), 0..150),
            k in 1usize..9,
            epsilon in 0.0..1.5f64,
        ) {
            let points = [vec![[f32::MAX, f32::MIN, 0.0]], points, vec![[f32::MIN; 3]]].concat();
            prop_assert_eq!(found_by_index(&points, k, epsilon), brute_force(&points, k, epsilon));
        }
    }

    // Neighbors are exactly ε away.
    #[test]
    fn points_exactly_epsilon_away_are_found() {
        for unit in [1.0f32, 0.1, 3e-7, 7e9] {
            let points: Vec<[f32; 3]> = (0..1000u16).map(|i| [f32::from(i) * unit, unit, -unit]).collect();
            for steps in [1, 2, 3] {
                let epsilon = f64::from(points[steps][0]);
                assert_eq!(
                    found_by_index(&points, 8, epsilon),
                    brute_force(&points, 8, epsilon),
                    "{steps} steps of {unit}"
                );
            }
        }
    }

    #[test]
    fn input_order_changes_no_neighbors() {
        let points: Vec<[f32; 3]> = (0..2000).map(|i| [i % 7, i % 11, i % 13].map(|x| x as f32 * 0.1)).collect();
        let mut reversed = numbered(&points);
        reversed.reverse();
        let (index, reversed) = (PointIndex::new(numbered(&points), 0.15), PointIndex::new(reversed, 0.15));
        let (mut search, mut other) = (index.search(), reversed.search());
        for point in numbered(&points) {
            let (found, cut) = search.nearest(point.index, point.position, 5);
            let (expected, expected_cut) = other.nearest(point.index, point.position, 5);
            assert!(found.eq(expected) && cut == expected_cut, "{point:?}");
        }
    }

    #[test]
    fn non_finite_points_neither_have_nor_are_neighbors() {
        let points = [[0.0; 3], [f32::NAN, 0.0, 0.0], [0.0; 3], [f32::INFINITY; 3]];
        let found = found_by_index(&points, 4, f64::MAX.sqrt());
        assert_eq!(found.iter().map(|(list, _)| list.clone()).collect::<Vec<_>>(), [vec![2], vec![], vec![0], vec![]]);
    }

    #[test]
    fn excluded_points_do_not_count_among_the_k() {
        let mut points = numbered(&[[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        points.remove(1);
        let index = PointIndex::new(points, 5.0);
        let mut search = index.search();
        let (found, truncated) = search.nearest(0, [0.0; 3], 1);
        assert_eq!((found.collect::<Vec<_>>(), truncated), (vec![2], false));
    }

    /// Searches the `k` nearest neighbors within the distance `epsilon` of each of the `points`. Returns the time in
    /// seconds, and the number of points with more than `k` neighbors.
    fn time_queries(points: &[[f32; 3]], k: usize, epsilon: f64) -> (f64, usize) {
        let start = Instant::now();
        let index = PointIndex::new(numbered(points), epsilon);
        let query_one = |search: &mut NeighborSearch<'_>, point: &TreePoint| {
            usize::from(search.nearest(point.index, point.position, k).1)
        };
        let cut = index.points().par_iter().map_init(|| index.search(), query_one).sum();
        (start.elapsed().as_secs_f64(), cut)
    }

    #[test]
    fn coincident_points_take_bounded_time() {
        let (seconds, cut) = time_queries(&vec![[1.0, 2.0, 3.0]; 200_000], 32, 0.1);
        assert_eq!(cut, 200_000);
        // Comparing all pairs would take 4e10 distances; 60 s leaves time for a slow shared machine.
        assert!(seconds < 60.0, "{seconds} s for 200,000 coincident points");
    }

    #[test]
    #[ignore = "ten million points: minutes and gigabytes; run with --release"]
    fn ten_million_points_within_epsilon_cost_bounded_time() {
        let n = 10_000_000;
        let position = |i: u64, salt: u64| {
            let hash = xxhash_rust::xxh3::xxh3_64_with_seed(&i.to_le_bytes(), salt);
            (hash >> 40) as f32 / (1u64 << 24) as f32
        };
        let spread: Vec<[f32; 3]> = (0..n).map(|i| [position(i, 0), position(i, 1), position(i, 2)]).collect();
        for (name, points) in [("spread", spread), ("coincident", vec![[0.5; 3]; n as usize])] {
            let (seconds, cut) = time_queries(&points, 32, 1.0);
            eprintln!("{name}: {seconds:.1} s, {cut} lists cut");
            assert_eq!(cut, n as usize);
        }
    }
}
