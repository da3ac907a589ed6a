//! The nearest neighbors of every Gaussian, by a hash of voxels as wide as they may be apart.
//!
//! In: positions. Out: for a Gaussian the at most K nearest others within ε, nearest first, ties by
//! index. The answer is defined by (distance, index) alone, so it does not depend on voxels, hashes, threads or any
//! partition of space.
//!
//! Points stand in the order of their voxels, and a table tells where each voxel starts. What is within ε of a point is
//! in its own voxel or in one of the 26 around it: those are looked up once for all points of a voxel, and skipped where
//! they are farther than the worst neighbor kept. A voxel of very many points has a [`Tree`] over them, so that a crowd
//! in one voxel, or an ε that reaches everywhere, costs what a tree costs.
//! Memory: 16 bytes per point, and 13 bytes for each slot of the table, of which there are at most 16 for 7 voxels: at
//! most 46 bytes per point, 40 while points are sorted.
//!
//! Source: spatial hashing after M. Teschner et al., "Optimized spatial hashing for collision detection of deformable
//! objects", 2003.

use std::ops::Range;

use hashbrown::HashTable;
use rayon::prelude::*;

use super::tree::{Nearest, Tree, TreePoint};
use super::voxels::{Voxels, along, voxel_of};
use crate::model::hash_id;

/// Points in a voxel without a tree, at most. Trees in voxels of 8 to 64 points cost up to a third more among evenly
/// strewn points and gain 7% among clusters.
const SPARSE: usize = 64;
/// Part of a voxel's side by which places may be wrong: they are up to 2²¹ sides, rounded to 53 bits a few times.
const MARGIN: f64 = 1.0 / (1 << 20) as f64;

/// Finite points, to be asked for the neighbors of each within ε.
#[derive(Debug)]
pub struct PointIndex {
    epsilon: f64,
    voxels: Voxels,
    /// By voxel.
    points: Vec<TreePoint>,
    /// Of the voxels that have one.
    trees: Vec<Tree>,
    table: HashTable<Occupied>,
}

/// A voxel that holds points.
#[derive(Debug, Clone, Copy)]
struct Occupied {
    start: u32,
    len: u32,
    /// Its place among the trees; any beyond them if it has none.
    tree: u32,
}

impl Occupied {
    fn points(self) -> Range<usize> {
        self.start as usize..self.start as usize + self.len as usize
    }
}

impl PointIndex {
    /// Indexes those of `points` that are finite, at most 2³² − 2, each of an index of its own.
    ///
    /// Edges: ε = 0 finds exact duplicates, an infinite ε reaches all points.
    pub fn new(mut points: Vec<TreePoint>, epsilon: f64) -> Self {
        points.retain(|point| point.at.iter().all(|x| x.is_finite()));
        // Wider than ε, lest rounding put what is exactly ε away two voxels away.
        let voxels = Voxels::around(points.iter().map(|point| point.at), epsilon * (1.0 + 2.0 * MARGIN));
        let rows: Vec<u32> = (0..points.len() as u32).collect();
        let order = voxels.order(&rows, |row| points[row as usize].at);
        drop(rows);
        points = order.into_iter().map(|row| points[row as usize]).collect();
        let number = |point: &TreePoint| voxels.number(point.at);
        let same = |a: &TreePoint, b: &TreePoint| number(a) == number(b);
        let trees: Vec<Tree> = points.par_chunk_by_mut(same).filter(|all| all.len() > SPARSE).map(Tree::new).collect();
        let mut table = HashTable::with_capacity(points.chunk_by(same).count());
        let (mut start, mut tree) = (0, 0);
        for all in points.chunk_by(same) {
            let is_sparse = all.len() <= SPARSE;
            let voxel = Occupied { start, len: all.len() as u32, tree: if is_sparse { u32::MAX } else { tree } };
            table.insert_unique(hash(number(&all[0])), voxel, |voxel| hash(number(&points[voxel.start as usize])));
            start += voxel.len;
            tree += u32::from(!is_sparse);
        }
        PointIndex { epsilon, voxels, points, trees, table }
    }

    /// All points, those of a voxel together: the fastest order to ask for their neighbors in.
    pub fn points(&self) -> &[TreePoint] {
        &self.points
    }

    /// What asks for neighbors: one for each thread, to be used again.
    pub fn search(&self) -> NeighborSearch<'_> {
        NeighborSearch { index: self, entered: None, around: Vec::new(), nearest: Nearest::default() }
    }

    fn find(&self, number: u64) -> Option<Occupied> {
        let is_it = |voxel: &Occupied| self.voxels.number(self.points[voxel.start as usize].at) == number;
        self.table.find(hash(number), is_it).copied()
    }
}

/// The hash of a voxel's number. Eight voxels that make up a cube follow one another in the table: what surrounds a
/// voxel is then in 8 places of memory, not in 27. The table compares the highest bits first, so they differ too.
fn hash(number: u64) -> u64 {
    let corner = number & 7;
    (hash_id(number >> 3) & !7 | corner) ^ corner << 60
}

/// Asks an index for neighbors, and remembers what surrounds the voxel asked about last.
#[derive(Debug)]
pub struct NeighborSearch<'a> {
    index: &'a PointIndex,
    entered: Option<[u32; 3]>,
    /// The occupied voxels around that one and itself, the step to each along the axes, as in [`STEPS`].
    around: Vec<([u8; 3], Occupied)>,
    nearest: Nearest,
}

impl NeighborSearch<'_> {
    /// The at most `k` nearest indexed points other than `query` whose distance to `at` is at most
    /// ε, nearest first, equal distances by index; and whether there were more than `k`.
    ///
    /// Squared distances are summed in f64 and compared with ε². Edges: a point that is not finite
    /// has no neighbors.
    pub fn nearest(&mut self, query: u32, at: [f32; 3], k: usize) -> (impl ExactSizeIterator<Item = u32>, bool) {
        let index = self.index;
        // One more than k tells whether the list was cut.
        self.nearest.start(query, at, k + 1, index.epsilon);
        if at.iter().all(|x| x.is_finite()) {
            let place = index.voxels.place(at);
            let voxel = voxel_of(place);
            if self.entered != Some(voxel) {
                self.enter(voxel);
            }
            // By step and axis, the least squared distance, which adds up over the axes.
            let gap = |part: f64| ((part - MARGIN).max(0.0) * index.voxels.side()).powi(2);
            let gaps: [[f64; 3]; 3] = std::array::from_fn(|c| {
                let inside = place[c] - f64::from(voxel[c]);
                [0.0, gap(inside), gap(1.0 - inside)]
            });
            for &(step, occupied) in &self.around {
                if self.nearest.reaches((0..3).map(|c| gaps[c][usize::from(step[c])]).sum()) {
                    let points = &index.points[occupied.points()];
                    match index.trees.get(occupied.tree as usize) {
                        Some(tree) => tree.search(points, &mut self.nearest),
                        None => self.nearest.scan(points),
                    }
                }
            }
        }
        let found = self.nearest.sorted();
        (found[..found.len().min(k)].iter().map(|&(_, index)| index), found.len() > k)
    }

    /// Looks up what surrounds `voxel`.
    fn enter(&mut self, voxel: [u32; 3]) {
        self.entered = Some(voxel);
        // The one below the first wraps to a number that is beyond the last.
        let numbers: [[Option<u64>; 3]; 3] =
            std::array::from_fn(|c| [voxel[c], voxel[c].wrapping_sub(1), voxel[c] + 1].map(|number| along(c, number)));
        let index = self.index;
        self.around.clear();
        self.around.extend(STEPS.iter().filter_map(|&step| {
            let [x, y, z] = std::array::from_fn(|c| numbers[c][usize::from(step[c])]);
            Some((step, index.find(x? | y? | z?)?))
        }));
    }
}

/// To a voxel itself and the 26 around it, by axis: 0 stays, 1 goes down, 2 goes up. First itself, then those that
/// share a side, an edge and a corner: the nearer they are, the sooner the farther ones can be skipped.
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

    fn named(points: &[[f32; 3]]) -> Vec<TreePoint> {
        points.iter().zip(0..).map(|(&at, index)| TreePoint { at, index }).collect()
    }

    fn indexed(points: &[[f32; 3]], k: usize, epsilon: f64) -> Vec<(Vec<u32>, bool)> {
        let index = PointIndex::new(named(points), epsilon);
        let mut search = index.search();
        named(points)
            .iter()
            .map(|point| {
                let (found, truncated) = search.nearest(point.index, point.at, k);
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
            prop_assert_eq!(indexed(&points, k, epsilon), brute_force(&points, k, epsilon));
        }

        // A coarse lattice: many points coincide, most distances tie.
        #[test]
        fn neighbors_equal_brute_force_among_duplicates_and_ties(
            cells in prop::collection::vec(prop::array::uniform3(0u8..3), 0..150),
            k in 1usize..9,
            epsilon in prop::sample::select(vec![0.0, 1.0, 2.0, 4.0]),
        ) {
            let points: Vec<[f32; 3]> = cells.iter().map(|cell| cell.map(f32::from)).collect();
            prop_assert_eq!(indexed(&points, k, epsilon), brute_force(&points, k, epsilon));
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        // Clusters far narrower and far wider than ε: voxels with and without trees, and borders between them.
        #[test]
        fn neighbors_equal_brute_force_among_clusters_far_from_the_origin(
            centers in prop::collection::vec(prop::array::uniform3(-1.0..1.0f32), 1..5),
            within in prop::collection::vec((0usize..5, prop::array::uniform3(-1.0..1.0f32)), 0..500),
            width in prop::sample::select(vec![1e-3f32, 0.03, 1.0]),
            offset in prop::sample::select(vec![0.0f32, -3.0, 1e4, -1e7, 1e30]),
            k in 1usize..40,
            epsilon in prop::sample::select(vec![1e-30, 1e-3, 0.02, 0.25, 2.0, 1e6, f64::INFINITY]),
        ) {
            let center = |c: usize| centers[c % centers.len()];
            let place = |(c, d): &(usize, [f32; 3])| std::array::from_fn(|x| offset + center(*c)[x] + width * d[x]);
            let points: Vec<[f32; 3]> = within.iter().map(place).collect();
            prop_assert_eq!(indexed(&points, k, epsilon), brute_force(&points, k, epsilon));
        }

        // One point at the edge of what f32 holds makes voxels wider than everything else.
        #[test]
        fn neighbors_equal_brute_force_beside_a_point_at_the_end_of_the_world(
            points in prop::collection::vec(prop::array::uniform3(-1.0..1.0f32), 0..150),
            k in 1usize..9,
            epsilon in 0.0..1.5f64,
        ) {
            let points = [vec![[f32::MAX, f32::MIN, 0.0]], points, vec![[f32::MIN; 3]]].concat();
            prop_assert_eq!(indexed(&points, k, epsilon), brute_force(&points, k, epsilon));
        }
    }

    // Neighbors exactly ε away, on the borders of voxels, wherever the grid begins and however wide ε is.
    #[test]
    fn what_is_exactly_epsilon_away_is_found() {
        for unit in [1.0f32, 0.1, 3e-7, 7e9] {
            let points: Vec<[f32; 3]> = (0..1000u16).map(|i| [f32::from(i) * unit, unit, -unit]).collect();
            for steps in [1, 2, 3] {
                let epsilon = f64::from(points[steps][0]);
                assert_eq!(indexed(&points, 8, epsilon), brute_force(&points, 8, epsilon), "{steps} steps of {unit}");
            }
        }
    }

    #[test]
    fn the_order_in_which_points_are_given_changes_nothing() {
        let points: Vec<[f32; 3]> = (0..2000).map(|i| [i % 7, i % 11, i % 13].map(|x| x as f32 * 0.1)).collect();
        let mut turned = named(&points);
        turned.reverse();
        let (index, turned) = (PointIndex::new(named(&points), 0.15), PointIndex::new(turned, 0.15));
        let (mut search, mut other) = (index.search(), turned.search());
        for point in named(&points) {
            let (found, cut) = search.nearest(point.index, point.at, 5);
            let (expected, expected_cut) = other.nearest(point.index, point.at, 5);
            assert!(found.eq(expected) && cut == expected_cut, "{point:?}");
        }
    }

    #[test]
    fn points_that_are_not_finite_have_no_neighbors_and_are_none() {
        let points = [[0.0; 3], [f32::NAN, 0.0, 0.0], [0.0; 3], [f32::INFINITY; 3]];
        let found = indexed(&points, 4, f64::MAX.sqrt());
        assert_eq!(found.iter().map(|(list, _)| list.clone()).collect::<Vec<_>>(), [vec![2], vec![], vec![0], vec![]]);
    }

    #[test]
    fn excluded_points_do_not_take_a_place_among_the_k() {
        let mut points = named(&[[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        points.remove(1);
        let index = PointIndex::new(points, 5.0);
        let mut search = index.search();
        let (found, truncated) = search.nearest(0, [0.0; 3], 1);
        assert_eq!((found.collect::<Vec<_>>(), truncated), (vec![2], false));
    }

    /// Seconds for all neighbors of `points`, and how many lists were cut.
    fn timed(points: &[[f32; 3]], k: usize, epsilon: f64) -> (f64, usize) {
        let start = Instant::now();
        let index = PointIndex::new(named(points), epsilon);
        let ask = |search: &mut NeighborSearch<'_>, point: &TreePoint| {
            usize::from(search.nearest(point.index, point.at, k).1)
        };
        let cut = index.points().par_iter().map_init(|| index.search(), ask).sum();
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
