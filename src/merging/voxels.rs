//! A grid of voxels: cubes of one side, in Morton order (G. M. Morton, "A computer oriented geodetic data base", 1966).
//!
//! In that order Gaussians that lie together follow one another. A piece of it together with what lies within a voxel's
//! side of it, its ghosts, is all that the pairs led from the piece consist of. Only the speed of reading depends on the
//! order, no result does.
//! Memory of ordering: 20 bytes per Gaussian beside the output.

use rayon::prelude::*;

/// Voxels along an axis, at most: three of their numbers make up 63 bits.
const MOST: u32 = 1 << 21;

/// The voxels around some points.
#[derive(Debug, Clone, Copy)]
pub struct Voxels {
    low: [f64; 3],
    side: f64,
    per_unit: f64,
}

impl Voxels {
    /// Voxels of that `side` from the lowest coordinates of `points` on, or wider ones where there would be more than
    /// 2²¹ along an axis. Edges: points all at one place and a side of zero, one voxel. Coordinates that are not finite
    /// are passed over.
    pub fn around(points: impl Iterator<Item = [f32; 3]>, side: f64) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for point in points {
            for c in (0..3).filter(|&c| point[c].is_finite()) {
                low[c] = low[c].min(point[c].into());
                high[c] = high[c].max(point[c].into());
            }
        }
        let widest = (0..3).map(|c| high[c] - low[c]).fold(0.0, f64::max);
        let side = side.max(widest / f64::from(MOST));
        Voxels { low, side, per_unit: side.recip() }
    }

    /// Their side, scene units.
    pub fn side(&self) -> f64 {
        self.side
    }

    /// Where `at` is, in voxels from the corner where they start.
    pub fn place(&self, at: [f32; 3]) -> [f64; 3] {
        std::array::from_fn(|c| (f64::from(at[c]) - self.low[c]) * self.per_unit)
    }

    /// The number in Morton order of the voxel that holds `at`.
    pub fn number(&self, at: [f32; 3]) -> u64 {
        let voxel = voxel_of(self.place(at));
        (0..3).filter_map(|c| along(c, voxel[c])).sum()
    }

    /// `rows` by the voxel they lie in, `at` telling their positions, scene units; ties by row.
    pub fn order(&self, rows: &[u32], at: impl Fn(u32) -> [f32; 3] + Sync) -> Vec<u32> {
        let mut keyed: Vec<(u64, u32)> = rows.par_iter().map(|&row| (self.number(at(row)), row)).collect();
        keyed.par_sort_unstable();
        keyed.into_iter().map(|(_, row)| row).collect()
    }
}

/// [`Voxels::order`] of `rows` among voxels of that `side` around themselves.
pub fn voxel_order(rows: &[u32], at: impl Fn(u32) -> [f32; 3] + Sync, side: f64) -> Vec<u32> {
    Voxels::around(rows.iter().map(|&row| at(row)), side).order(rows, at)
}

/// The voxel at a [place](Voxels::place), by its number along each axis; outside of all, the nearest one. What is not a
/// number is in the first.
pub fn voxel_of(place: [f64; 3]) -> [u32; 3] {
    // A cast takes what is beyond the range to its end, and NaN, which 0·∞ is, to 0.
    place.map(|x| (x as u32).min(MOST - 1))
}

/// What being the `number`-th along `axis` adds to a voxel's number in Morton order; none where there is no such voxel.
pub fn along(axis: usize, number: u32) -> Option<u64> {
    (number < MOST).then(|| spread(number.into()) << axis)
}

/// Bit k of the lowest 21 moved to bit 3k.
fn spread(x: u64) -> u64 {
    let x = (x | x << 32) & 0x001f_0000_0000_ffff;
    let x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    let x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    let x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use super::*;
    #[test]
    fn spreading_moves_every_bit_to_its_place() {
        for k in 0..21 {
            assert_eq!(spread(1 << k), 1 << (3 * k), "bit {k}");
        }
    }

    #[test]
    fn the_eight_voxels_of_a_cube_follow_one_another_and_ties_go_by_row() {
        // Two points in each voxel of a 4³ lattice, x fastest.
        let lattice = |i: usize| [i % 4, i / 4 % 4, i / 16 % 4].map(|k| k as f32 + 0.25);
        let points: Vec<[f32; 3]> = (0..128).map(lattice).collect();
        let rows: Vec<u32> = (0..128).rev().collect();
        let order = voxel_order(&rows, |row| points[row as usize], 1.0);
        for (cube, of_cube) in order.chunks(16).enumerate() {
            let corner = [cube & 1, cube >> 1 & 1, cube >> 2].map(|k| 2.0 * k as f32);
            for pair in of_cube.chunks(2) {
                let at = points[pair[0] as usize];
                assert!((0..3).all(|c| at[c] >= corner[c] && at[c] < corner[c] + 2.0), "{at:?} in cube {cube}");
                assert_eq!(pair[1], pair[0] + 64, "both of one voxel, the lower row first");
            }
        }
    }

    #[test]
    fn any_extent_and_side_give_an_order_of_all_rows() {
        let points = [[0.0; 3], [f32::MAX; 3], [f32::MIN, 0.0, 1.0], [0.0; 3]];
        let far = |row: u32| points[row as usize];
        for side in [0.0, 1e-30, 1.0, f64::INFINITY] {
            let mut order = voxel_order(&[0, 1, 2, 3], far, side);
            order.sort_unstable();
            assert_eq!(order, [0, 1, 2, 3], "side {side}");
            assert_eq!(voxel_order(&[3, 0], far, side), [0, 3], "one place, side {side}");
            assert!(voxel_order(&[], far, side).is_empty());
        }
    }
}
