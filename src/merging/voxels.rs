//! Order of Gaussians by voxels: cubes of equal size, sorted in Morton order, which keeps neighbors together (G. M.
//! Morton, "A computer oriented geodetic data base", 1966).
//!
//! Gaussians that are close in space are mostly close in this order, too. The order affects only the speed of reading,
//! never a result. Memory while sorting: 20 bytes per Gaussian beside the output.

use rayon::prelude::*;

/// Maximum number of voxels along an axis. Three voxel numbers of 21 bits form a 63-bit Morton code.
const MAX_PER_AXIS: u32 = 1 << 21;

/// Returns the row indices `rows` sorted by the Morton code of the voxel of each row, ties by row index. `at` returns
/// the position of a row, in scene units. Voxels have the side `side`, or are wider if there would be more than 2²¹ of
/// them along an axis. The positions may be infinite or NaN.
pub fn voxel_order(rows: &[u32], at: impl Fn(u32) -> [f32; 3] + Sync, side: f64) -> Vec<u32> {
    let grid = VoxelGrid::around(rows.iter().map(|&row| at(row)), side);
    let mut keyed: Vec<(u64, u32)> = rows.par_iter().map(|&row| (grid.morton_code(at(row)), row)).collect();
    keyed.par_sort_unstable();
    keyed.into_iter().map(|(_, row)| row).collect()
}

/// Grid of voxels that covers a set of points.
struct VoxelGrid {
    low: [f64; 3],
    /// Number of voxels per scene unit along an axis.
    per_unit: f64,
}

impl VoxelGrid {
    /// Creates a grid that starts at the lowest finite coordinates of `points`, with voxels of side `side` or wider.
    fn around(points: impl Iterator<Item = [f32; 3]>, side: f64) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for point in points {
            for c in (0..3).filter(|&c| point[c].is_finite()) {
                low[c] = low[c].min(point[c].into());
                high[c] = high[c].max(point[c].into());
            }
        }
        let widest = (0..3).map(|c| high[c] - low[c]).fold(0.0, f64::max);
        VoxelGrid { low, per_unit: side.max(widest / f64::from(MAX_PER_AXIS)).recip() }
    }

    /// Returns the Morton code of the voxel that contains the position `at`.
    fn morton_code(&self, at: [f32; 3]) -> u64 {
        // A saturating cast maps numbers beyond the range of u32 to its ends, and NaN (from 0·∞) to 0.
        let number = |c: usize| ((f64::from(at[c]) - self.low[c]) * self.per_unit) as u32;
        (0..3).map(|c| spread_bits(number(c).min(MAX_PER_AXIS - 1).into()) << c).sum()
    }
}

/// Spreads the lowest 21 bits of `x`: bit k moves to bit 3k.
fn spread_bits(x: u64) -> u64 {
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
    fn spread_bits_moves_bit_k_to_3k() {
        for k in 0..21 {
            assert_eq!(spread_bits(1 << k), 1 << (3 * k), "bit {k}");
        }
    }

    #[test]
    fn voxels_of_a_cube_are_consecutive_and_ties_go_by_row() {
        // Two points in each voxel of a 4³ grid, x fastest.
        let grid = |i: usize| [i % 4, i / 4 % 4, i / 16 % 4].map(|k| k as f32 + 0.25);
        let points: Vec<[f32; 3]> = (0..128).map(grid).collect();
        let rows: Vec<u32> = (0..128).rev().collect();
        let order = voxel_order(&rows, |row| points[row as usize], 1.0);
        for (cube, cube_rows) in order.chunks(16).enumerate() {
            let corner = [cube & 1, cube >> 1 & 1, cube >> 2].map(|k| 2.0 * k as f32);
            for pair in cube_rows.chunks(2) {
                let at = points[pair[0] as usize];
                assert!((0..3).all(|c| at[c] >= corner[c] && at[c] < corner[c] + 2.0), "{at:?} in cube {cube}");
                assert_eq!(pair[1], pair[0] + 64, "both of one voxel, the lower row first");
            }
        }
    }

    #[test]
    fn every_extent_and_side_orders_all_rows() {
        let points = [[0.0; 3], [f32::MAX; 3], [f32::MIN, 0.0, 1.0], [0.0; 3]];
        let position_of = |row: u32| points[row as usize];
        for side in [0.0, 1e-30, 1.0, f64::INFINITY] {
            let mut order = voxel_order(&[0, 1, 2, 3], position_of, side);
            order.sort_unstable();
            assert_eq!(order, [0, 1, 2, 3], "side {side}");
            assert_eq!(voxel_order(&[3, 0], position_of, side), [0, 3], "one place, side {side}");
            assert!(voxel_order(&[], position_of, side).is_empty());
        }
    }
}
