//! Gaussians of a frame by cells: of every octave of sizes a grid of its own, in one hash table.
//!
//! Memory: 72 bytes per Gaussian and 4 for each of up to four times as many cells.

use std::ops::RangeInclusive;

use super::look::{ComparedAppearance, mix};

/// Of more Gaussians in a cell, only so many are looked at.
const CROWD: usize = 64;
/// Most cells along an axis that a search looks into: none within the reach of the fastest lies further.
const MOST_CELLS: i64 = 8;

/// Some Gaussians of a frame by their cells.
pub(super) struct CellGrid {
    reach: f64,
    mask: usize,
    /// Where the Gaussians of each bucket start; one more at the end.
    starts: Vec<u32>,
    /// Of each Gaussian its cell: apart from the rest, so that those of other cells are passed over in the cache.
    cells: Vec<u64>,
    points: Vec<CellEntry>,
}

/// A Gaussian in a cell.
struct CellEntry {
    look: ComparedAppearance,
    number: u32,
}

impl CellGrid {
    /// The Gaussians `numbers` of `looks`, in cells that suit searches within `reach` times the size.
    pub(super) fn new(looks: &[ComparedAppearance], numbers: &[u32], reach: f32) -> CellGrid {
        let reach = f64::from(reach);
        let buckets = (2 * numbers.len()).next_power_of_two();
        let mask = buckets - 1;
        let cells: Vec<u64> = numbers.iter().map(|&number| own_cell(&looks[number as usize], reach)).collect();
        let mut starts = vec![0u32; buckets + 1];
        cells.iter().for_each(|&cell| starts[(cell as usize & mask) + 1] += 1);
        (0..buckets).for_each(|bucket| starts[bucket + 1] += starts[bucket]);
        let mut next = starts.clone();
        let mut order = vec![0u32; numbers.len()];
        for (place, &cell) in cells.iter().enumerate() {
            let to = &mut next[cell as usize & mask];
            order[*to as usize] = place as u32;
            *to += 1;
        }
        let look = |place: u32| &looks[numbers[place as usize] as usize];
        for bucket in starts.windows(2) {
            let of_bucket = &mut order[bucket[0] as usize..bucket[1] as usize];
            if of_bucket.len() > CROWD {
                // Places are in the order of numbers.
                of_bucket.sort_unstable_by(|&a, &b| {
                    let brightness = look(a).brightness().total_cmp(&look(b).brightness());
                    cells[a as usize].cmp(&cells[b as usize]).then(brightness).then(a.cmp(&b))
                });
            }
        }
        let points = order.iter().map(|&place| CellEntry { look: *look(place), number: numbers[place as usize] });
        let points = points.collect();
        let cells = order.iter().map(|&place| cells[place as usize]).collect();
        CellGrid { reach, mask, starts, cells, points }
    }

    /// Hands `each` the Gaussians, with their numbers, that lie within `radius` of `at` along each axis, or further, of
    /// about the size of `look`.
    pub(super) fn near(
        &self,
        look: &ComparedAppearance,
        at: [f32; 3],
        radius: f32,
        mut each: impl FnMut(u32, &ComparedAppearance),
    ) {
        let brightness = look.brightness();
        for level in levels(look.ln_size) {
            let side = side(level, self.reach);
            let along = |c: usize| -> RangeInclusive<i64> {
                let cell = |x: f64| floor(x / side);
                let low = cell(f64::from(at[c]) - f64::from(radius));
                low..=cell(f64::from(at[c]) + f64::from(radius)).min(low.saturating_add(MOST_CELLS - 1))
            };
            let (along, level) = ([along(0), along(1), along(2)], CellKey::from_level(level));
            for x in along[0].clone() {
                let x = level.then(x);
                for y in along[1].clone() {
                    let y = x.then(y);
                    for z in along[2].clone() {
                        self.of_cell(y.then(z).cell(), brightness, &mut each);
                    }
                }
            }
        }
    }

    fn of_cell(&self, cell: u64, brightness: f32, each: &mut impl FnMut(u32, &ComparedAppearance)) {
        let bucket = cell as usize & self.mask;
        let mut places = self.starts[bucket] as usize..self.starts[bucket + 1] as usize;
        if places.len() > CROWD {
            let cells = &self.cells[places.clone()];
            let first = places.start + cells.partition_point(|&other| other < cell);
            places = first..places.start + cells.partition_point(|&other| other <= cell);
            if places.len() > CROWD {
                let points = &self.points[places.clone()];
                let middle = points.partition_point(|point| point.look.brightness().total_cmp(&brightness).is_lt());
                let first = places.start + middle.saturating_sub(CROWD / 2).min(points.len() - CROWD);
                places = first..first + CROWD;
            }
        }
        for place in places {
            // Cells of other places share the bucket.
            if self.cells[place] == cell {
                let point = &self.points[place];
                each(point.number, &point.look);
            }
        }
    }
}

/// Octaves of sizes that those within a factor of √2 are in.
fn levels(ln_size: f32) -> RangeInclusive<i64> {
    let octave = f64::from(ln_size) / std::f64::consts::LN_2;
    floor(octave - 0.5)..=floor(octave + 0.5)
}

/// A cell is as wide as a search among the largest of its octave.
fn side(level: i64, reach: f64) -> f64 {
    2.0 * reach * ((level + 1) as f64).exp2()
}

fn own_cell(look: &ComparedAppearance, reach: f64) -> u64 {
    let level = floor(f64::from(look.ln_size) / std::f64::consts::LN_2);
    let side = side(level, reach);
    look.position.iter().fold(CellKey::from_level(level), |name, &x| name.then(floor(f64::from(x) / side))).cell()
}

/// The largest integer that is not above `x`, inlined where the machine's own instruction may not be counted on.
fn floor(x: f64) -> i64 {
    let toward_zero = x as i64;
    toward_zero - i64::from(x < toward_zero as f64)
}

/// What a cell is called, from its level and its place along each axis: two that share it would cost time and change
/// nothing. The eight cells of a cube differ in the last bits alone, so that they are neighbors in the table.
#[derive(Clone, Copy)]
struct CellKey {
    cube: u64,
    within: u64,
}

impl CellKey {
    fn from_level(level: i64) -> CellKey {
        CellKey { cube: mix(level as u64), within: 0 }
    }

    fn then(self, place: i64) -> CellKey {
        CellKey { cube: mix(self.cube ^ (place >> 1) as u64), within: self.within << 1 | (place & 1) as u64 }
    }

    fn cell(self) -> u64 {
        self.cube << 3 | self.within
    }
}
