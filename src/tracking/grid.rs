//! Grid of the Gaussians of a frame, to find neighbors of similar size. There is one grid of cells per octave (factor
//! of two) of sizes; all of them share one hash table.
//!
//! Memory: 88 bytes per Gaussian, and 4 bytes per hash bucket, of which there are up to four per Gaussian.

use std::ops::RangeInclusive;

use super::appearance::{ComparedAppearance, mix};

/// Maximum number of Gaussians that a search visits in one cell, so that crowded cells do not make searches slow.
const MAX_PER_CELL: usize = 64;
/// Maximum number of cells along an axis that a search visits. Even the search for the continuation of the fastest
/// track, which reaches farthest, never needs more cells.
const MAX_CELLS_PER_AXIS: i64 = 8;

/// Some of the Gaussians of a frame, sorted by the cells of the grid in which they lie.
pub(super) struct CellGrid {
    reach: f64,
    mask: usize,
    /// For each hash bucket the index in `entries` of its first Gaussian, followed by the total number of entries.
    starts: Vec<u32>,
    /// Hash of the cell of each entry of `entries`, in the same order. The hashes are kept apart from the entries, so
    /// that a search skips Gaussians of other cells in a bucket without loading their entries into the processor's
    /// cache.
    cells: Vec<u64>,
    entries: Vec<CellEntry>,
}

/// Gaussian in the grid: its appearance, and its number in the frame.
struct CellEntry {
    appearance: ComparedAppearance,
    number: u32,
}

impl CellGrid {
    /// Builds the grid of the Gaussians with the indices `numbers` in `appearances`. Cells are sized for searches
    /// within `reach` times the size of a Gaussian.
    pub(super) fn new(appearances: &[ComparedAppearance], numbers: &[u32], reach: f32) -> CellGrid {
        let reach = f64::from(reach);
        let buckets = (2 * numbers.len()).next_power_of_two();
        let mask = buckets - 1;
        let cells: Vec<u64> = numbers.iter().map(|&number| own_cell(&appearances[number as usize], reach)).collect();
        let mut starts = vec![0u32; buckets + 1];
        cells.iter().for_each(|&cell| starts[(cell as usize & mask) + 1] += 1);
        (0..buckets).for_each(|bucket| starts[bucket + 1] += starts[bucket]);
        let mut next = starts.clone();
        let mut order = vec![0u32; numbers.len()];
        for (index, &cell) in cells.iter().enumerate() {
            let to = &mut next[cell as usize & mask];
            order[*to as usize] = index as u32;
            *to += 1;
        }
        let appearance = |index: u32| &appearances[numbers[index as usize] as usize];
        for bucket in starts.windows(2) {
            let bucket_order = &mut order[bucket[0] as usize..bucket[1] as usize];
            if bucket_order.len() > MAX_PER_CELL {
                // Sorting by index as well keeps Gaussians with equal keys in the order of their numbers.
                bucket_order.sort_unstable_by(|&a, &b| {
                    let brightness = appearance(a).brightness().total_cmp(&appearance(b).brightness());
                    cells[a as usize].cmp(&cells[b as usize]).then(brightness).then(a.cmp(&b))
                });
            }
        }
        let entries =
            order.iter().map(|&index| CellEntry { appearance: *appearance(index), number: numbers[index as usize] });
        let entries = entries.collect();
        let cells = order.iter().map(|&index| cells[index as usize]).collect();
        CellGrid { reach, mask, starts, cells, entries }
    }

    /// Searches for Gaussians of about the size of `appearance` near `center`. Calls `visit` with the number and the
    /// appearance of each Gaussian found. Finds every Gaussian that satisfies two conditions, and others in the same
    /// grid cells:
    ///
    /// - Its size differs from that of `appearance` by a factor of at most √2.
    /// - Its position differs from `center` by at most `radius` (scene units) along each axis.
    ///
    /// In a cell with more than 64 Gaussians, only the 64 with the brightness nearest to that of `appearance` are
    /// visited.
    pub(super) fn for_each_near(
        &self,
        appearance: &ComparedAppearance,
        center: [f32; 3],
        radius: f32,
        mut visit: impl FnMut(u32, &ComparedAppearance),
    ) {
        let brightness = appearance.brightness();
        for level in levels(appearance.ln_size) {
            let side = side(level, self.reach);
            let along = |c: usize| -> RangeInclusive<i64> {
                let cell = |x: f64| floor(x / side);
                let low = cell(f64::from(center[c]) - f64::from(radius));
                low..=cell(f64::from(center[c]) + f64::from(radius)).min(low.saturating_add(MAX_CELLS_PER_AXIS - 1))
            };
            let (along, level) = ([along(0), along(1), along(2)], CellKey::from_level(level));
            for x in along[0].clone() {
                let x = level.with_axis(x);
                for y in along[1].clone() {
                    let y = x.with_axis(y);
                    for z in along[2].clone() {
                        self.for_each_in_cell(y.with_axis(z).cell(), brightness, &mut visit);
                    }
                }
            }
        }
    }

    fn for_each_in_cell(&self, cell: u64, brightness: f32, visit: &mut impl FnMut(u32, &ComparedAppearance)) {
        let bucket = cell as usize & self.mask;
        let mut indices = self.starts[bucket] as usize..self.starts[bucket + 1] as usize;
        if indices.len() > MAX_PER_CELL {
            let cells = &self.cells[indices.clone()];
            let first = indices.start + cells.partition_point(|&other| other < cell);
            indices = first..indices.start + cells.partition_point(|&other| other <= cell);
            if indices.len() > MAX_PER_CELL {
                let entries = &self.entries[indices.clone()];
                let middle =
                    entries.partition_point(|entry| entry.appearance.brightness().total_cmp(&brightness).is_lt());
                let first = indices.start + middle.saturating_sub(MAX_PER_CELL / 2).min(entries.len() - MAX_PER_CELL);
                indices = first..first + MAX_PER_CELL;
            }
        }
        for index in indices {
            // Several cells may share a hash bucket.
            if self.cells[index] == cell {
                let entry = &self.entries[index];
                visit(entry.number, &entry.appearance);
            }
        }
    }
}

/// Returns the octaves that contain all sizes within a factor of √2 of the size whose natural log is `ln_size`. Octave
/// k has the sizes from 2ᵏ to 2ᵏ⁺¹ scene units.
fn levels(ln_size: f32) -> RangeInclusive<i64> {
    let octave = f64::from(ln_size) / std::f64::consts::LN_2;
    floor(octave - 0.5)..=floor(octave + 0.5)
}

/// Returns the width of the grid cells for octave `level`, in scene units. This octave contains the Gaussians of the
/// sizes from 2^level to 2^(level + 1) scene units.
///
/// A search for neighbors of a Gaussian has the radius `reach` · size. The cells are as wide as twice the radius of the
/// search for the largest Gaussian of the octave.
fn side(level: i64, reach: f64) -> f64 {
    2.0 * reach * ((level + 1) as f64).exp2()
}

fn own_cell(appearance: &ComparedAppearance, reach: f64) -> u64 {
    let level = floor(f64::from(appearance.ln_size) / std::f64::consts::LN_2);
    let side = side(level, reach);
    appearance
        .position
        .iter()
        .fold(CellKey::from_level(level), |key, &x| key.with_axis(floor(f64::from(x) / side)))
        .cell()
}

/// Returns the largest integer that is not above `x`. Unlike `f64::floor`, it is inlined on processors without a
/// rounding instruction.
fn floor(x: f64) -> i64 {
    let toward_zero = x as i64;
    toward_zero - i64::from(x < toward_zero as f64)
}

/// Key of a grid cell, from which its hash is computed: its octave of sizes, and its index along each axis. Two cells
/// with equal hashes cost time but change no result. The eight cells of a cube of 2×2×2 cells have hashes that differ
/// in the last three bits only, so they are adjacent in the hash table.
#[derive(Clone, Copy)]
struct CellKey {
    cube: u64,
    within: u64,
}

impl CellKey {
    fn from_level(level: i64) -> CellKey {
        CellKey { cube: mix(level as u64), within: 0 }
    }

    fn with_axis(self, index: i64) -> CellKey {
        CellKey { cube: mix(self.cube ^ (index >> 1) as u64), within: self.within << 1 | (index & 1) as u64 }
    }

    fn cell(self) -> u64 {
        self.cube << 3 | self.within
    }
}
