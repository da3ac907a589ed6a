//! Search for the nearest neighbors of every Gaussian, by a hash table of voxels whose side is the maximum distance ε.
//!
//! Input: positions. Output: for each Gaussian its nearest neighbors, at most K within ε, nearest first, ties by index.
//! The result is defined by distance and index alone, so it does not depend on voxels, hashes, threads or any partition
//! of space.
//!
//! Points are sorted by voxel, and the hash table holds the start of each voxel. All points within ε of a point lie in
//! its own voxel or in one of the 26 around it. These voxels are looked up once for all points of a voxel, and skipped
//! if they are farther away than the worst neighbor found so far. A voxel with very many points has a [`Tree`], so that
//! many points in one voxel, or an ε that spans the scene, cost no more than a tree search.
//!
//! Memory: 16 bytes per point, and 13 bytes per entry of the hash table. For V voxels that contain points, the table
//! has at most 16/7 · V entries, and V is at most the number of points. Total: at most 16 + 13 · 16/7 ≈ 46 bytes per
//! point, and 40 while points are sorted.
//!
//! Source: spatial hashing after M. Teschner et al., "Optimized spatial hashing for collision detection of deformable
//! objects", 2003.

use std::ops::Range;

use hashbrown::HashTable;
use rayon::prelude::*;

use super::tree::{NearestPoints, Tree, TreePoint};
use super::voxels::{VoxelGrid, morton_bits, voxel_of};
use crate::model::hash_id;

/// Maximum number of points in a voxel without a tree. Trees in voxels of 8 to 64 points would cost up to a third more
/// time for evenly distributed points, and save 7% for clusters.
const MAX_WITHOUT_TREE: usize = 64;
/// Bound on the rounding error of a position in the grid, as a fraction of a voxel's side. Coordinates are up to 2²¹
/// sides and are rounded to 53 bits a few times.
const ROUNDING: f64 = 1.0 / (1 << 20) as f64;

/// Index of points that finds the neighbors of each point within the distance ε. Holds only points with finite
/// coordinates.
#[derive(Debug)]
pub struct PointIndex {
    epsilon: f64,
    voxels: VoxelGrid,
    /// Indexed points, sorted by the voxel that contains them.
    points: Vec<TreePoint>,
    /// Trees of the voxels with more than [`MAX_WITHOUT_TREE`] points, in the order of the voxels.
    trees: Vec<Tree>,
    table: HashTable<FilledVoxel>,
}

/// A voxel that contains at least one point.
#[derive(Debug, Clone, Copy)]
struct FilledVoxel {
    start: u32,
    len: u32,
    /// Index of the voxel's tree in `trees`; an index beyond the last one if the voxel has no tree.
    tree: u32,
}

impl FilledVoxel {
    fn points(self) -> Range<usize> {
        self.start as usize..self.start as usize + self.len as usize
    }
}

impl PointIndex {
    /// Builds an index of those of `points` that have finite coordinates, for queries within the distance `epsilon`.
    /// There may be at most 2³² − 2 points, all with different indices.
    ///
    /// Edge cases: ε = 0 finds exact duplicates; an infinite ε reaches all points.
    pub fn new(mut points: Vec<TreePoint>, epsilon: f64) -> Self {
        points.retain(|point| point.position.iter().all(|x| x.is_finite()));
        // Sides are slightly longer than ε. Otherwise rounding could put two points at the exact distance ε into voxels
        // that do not touch.
        let voxels = VoxelGrid::around(points.iter().map(|point| point.position), epsilon * (1.0 + 2.0 * ROUNDING));
        let rows: Vec<u32> = (0..points.len() as u32).collect();
        let order = voxels.sort_rows(&rows, |row| points[row as usize].position);
        drop(rows);
        points = order.into_iter().map(|row| points[row as usize]).collect();
        let number = |point: &TreePoint| voxels.morton_code(point.position);
        let in_same_voxel = |a: &TreePoint, b: &TreePoint| number(a) == number(b);
        let trees: Vec<Tree> = points
            .par_chunk_by_mut(in_same_voxel)
            .filter(|voxel_points| voxel_points.len() > MAX_WITHOUT_TREE)
            .map(Tree::new)
            .collect();
        let mut table = HashTable::with_capacity(points.chunk_by(in_same_voxel).count());
        let (mut start, mut tree) = (0, 0);
        for voxel_points in points.chunk_by(in_same_voxel) {
            let is_sparse = voxel_points.len() <= MAX_WITHOUT_TREE;
            let voxel =
                FilledVoxel { start, len: voxel_points.len() as u32, tree: if is_sparse { u32::MAX } else { tree } };
            table.insert_unique(hash(number(&voxel_points[0])), voxel, |voxel| {
                hash(number(&points[voxel.start as usize]))
            });
            start += voxel.len;
            tree += u32::from(!is_sparse);
        }
        PointIndex { epsilon, voxels, points, trees, table }
    }

    /// Returns all indexed points, sorted by voxel. Neighbor queries are fastest in this order.
    pub fn points(&self) -> &[TreePoint] {
        &self.points
    }

    /// Creates a search for the points nearest to a position. It can be used for many positions; each thread needs its
    /// own.
    pub fn search(&self) -> NeighborSearch<'_> {
        NeighborSearch { index: self, last_voxel: None, around: Vec::new(), nearest: NearestPoints::default() }
    }

    fn find_voxel(&self, number: u64) -> Option<FilledVoxel> {
        let has_number =
            |voxel: &FilledVoxel| self.voxels.morton_code(self.points[voxel.start as usize].position) == number;
        self.table.find(hash(number), has_number).copied()
    }
}

/// Returns the hash of the voxel with Morton code `number`. The eight voxels of a 2×2×2 cube follow one another in the
/// table, so that the 27 voxels around a position lie in 8 places of memory instead of 27. The table compares the
/// highest bits of two hashes before it compares the entries; the hashes within a cube differ in these bits, too.
fn hash(number: u64) -> u64 {
    let corner = number & 7;
    (hash_id(number >> 3) & !7 | corner) ^ corner << 60
}

/// Search for the points of a [`PointIndex`] that are nearest to a position. Remembers the voxels around the voxel
/// queried last, so that a further query in the same voxel does not look them up again.
#[derive(Debug)]
pub struct NeighborSearch<'a> {
    index: &'a PointIndex,
    last_voxel: Option<[u32; 3]>,
    /// Of the 27 voxels at and around the voxel queried last, those that contain points. Each comes with the step along
    /// the three axes from the queried voxel to it, encoded as in [`STEPS`].
    around: Vec<([u8; 3], FilledVoxel)>,
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
        let index = self.index;
        // One neighbor more than `k` is sought, to know whether there are more.
        self.nearest.start_query(query_index, position, k + 1, index.epsilon);
        if position.iter().all(|x| x.is_finite()) {
            let grid_position = index.voxels.grid_coordinates(position);
            let voxel = voxel_of(grid_position);
            if self.last_voxel != Some(voxel) {
                self.look_up(voxel);
            }
            // Returns the smallest squared distance to a neighboring voxel along one axis. These distances add up over
            // the axes.
            let gap = |part: f64| ((part - ROUNDING).max(0.0) * index.voxels.side()).powi(2);
            let gaps: [[f64; 3]; 3] = std::array::from_fn(|c| {
                let inside = grid_position[c] - f64::from(voxel[c]);
                [0.0, gap(inside), gap(1.0 - inside)]
            });
            for &(step, occupied) in &self.around {
                if self.nearest.could_improve_at((0..3).map(|c| gaps[c][usize::from(step[c])]).sum()) {
                    let points = &index.points[occupied.points()];
                    match index.trees.get(occupied.tree as usize) {
                        Some(tree) => tree.search(points, &mut self.nearest),
                        None => self.nearest.add_points(points),
                    }
                }
            }
        }
        let neighbors = self.nearest.sort_by_distance();
        (neighbors[..neighbors.len().min(k)].iter().map(|&(_, index)| index), neighbors.len() > k)
    }

    /// Looks up `voxel` and the 26 voxels around it, and remembers those that contain points.
    fn look_up(&mut self, voxel: [u32; 3]) {
        self.last_voxel = Some(voxel);
        // One below 0 wraps to a number beyond the last voxel, for which there is no voxel.
        let numbers: [[Option<u64>; 3]; 3] = std::array::from_fn(|c| {
            [voxel[c], voxel[c].wrapping_sub(1), voxel[c] + 1].map(|number| morton_bits(c, number))
        });
        let index = self.index;
        self.around.clear();
        self.around.extend(STEPS.iter().filter_map(|&step| {
            let [x, y, z] = std::array::from_fn(|c| numbers[c][usize::from(step[c])]);
            Some((step, index.find_voxel(x? | y? | z?)?))
        }));
    }
}

/// Steps from a voxel to itself and to the 26 voxels around it. A step has one number per axis: 0 stays, 1 goes down, 2
/// goes up. The voxel itself comes first, then those that share a side, an edge and a corner. Near voxels come first so
/// that more of the far ones can be skipped.
const STEPS: [[u8; 3]; 27] = {
    let mut steps = [[0; 3]; 27];
    let (mut filled, mut moved) = (0, 0);
    while moved <= 3 {
        let mut k = 0;
        while k < 27 {
            let step = [k % 3, k / 3 % 3, k / 9];
            if (step[0] > 0) as u8 + (step[1] > 0) as u8 + (step[2] > 0) as u8 == moved {
                steps[filled] = step;
                filled += 1;
            }
            k += 1;
        }
        moved += 1;
    }
    steps
};

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use proptest::prelude::*;

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

        // Clusters far narrower and far wider than ε give voxels with and without trees, side by side.
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

        // A point at each end of the range of f32 makes voxels wider than all other distances.
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

    // Neighbors are exactly ε away, on the borders of voxels, for several grid origins and values of ε.
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
    fn ten_million_points_in_one_voxel_cost_bounded_time() {
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
