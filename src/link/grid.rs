//! Gaussians of a frame by cells: of every octave of sizes a grid of its own, in one hash table.
//!
//! Memory: 72 bytes per Gaussian and 4 for each of up to four times as many cells.

use std::ops::RangeInclusive;

use super::look::{Look, mix};

/// Of more Gaussians in a cell, only so many are looked at.
const CROWD: usize = 64;
/// Most cells along an axis that a search looks into: none within the reach of the fastest lies further.
const MOST_CELLS: i64 = 8;

/// Some Gaussians of a frame by their cells.
pub(super) struct Grid {
    reach: f64,
    mask: usize,
    /// Where the Gaussians of each bucket start; one more at the end.
    starts: Vec<u32>,
    points: Vec<Point>,
}

/// A Gaussian in its cell.
struct Point {
    cell: u64,
    look: Look,
    number: u32,
}

impl Grid {
    /// The Gaussians `numbers` of `looks`, in cells that suit searches within `reach` times the size.
    pub(super) fn new(looks: &[Look], numbers: &[u32], reach: f32) -> Grid {
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
        let point = |&place: &u32| {
            let number = numbers[place as usize];
            Point { cell: cells[place as usize], look: looks[number as usize], number }
        };
        let mut points: Vec<Point> = order.iter().map(point).collect();
        for bucket in starts.windows(2) {
            let of_bucket = &mut points[bucket[0] as usize..bucket[1] as usize];
            if of_bucket.len() > CROWD {
                of_bucket.sort_unstable_by(|a, b| {
                    let brightness = a.look.brightness().total_cmp(&b.look.brightness());
                    a.cell.cmp(&b.cell).then(brightness).then(a.number.cmp(&b.number))
                });
            }
        }
        Grid { reach, mask, starts, points }
    }

    /// Hands `each` the Gaussians, with their numbers, that lie within `radius` of `at` along each axis, or further, of
    /// about the size of `look`.
    pub(super) fn near(&self, look: &Look, at: [f32; 3], radius: f32, mut each: impl FnMut(u32, &Look)) {
        for level in levels(look.ln_size) {
            let side = side(level, self.reach);
            let along = |c: usize| -> RangeInclusive<i64> {
                let cell = |x: f64| (x / side).floor() as i64;
                let low = cell(f64::from(at[c]) - f64::from(radius));
                low..=cell(f64::from(at[c]) + f64::from(radius)).min(low.saturating_add(MOST_CELLS - 1))
            };
            for x in along(0) {
                for y in along(1) {
                    for z in along(2) {
                        self.of_cell(cell(level, [x, y, z]), look.brightness(), &mut each);
                    }
                }
            }
        }
    }

    fn of_cell(&self, cell: u64, brightness: f32, each: &mut impl FnMut(u32, &Look)) {
        let bucket = cell as usize & self.mask;
        let mut points = &self.points[self.starts[bucket] as usize..self.starts[bucket + 1] as usize];
        if points.len() > CROWD {
            let from = points.partition_point(|point| point.cell < cell);
            points = &points[from..];
            points = &points[..points.partition_point(|point| point.cell == cell)];
            if points.len() > CROWD {
                let middle = points.partition_point(|point| point.look.brightness().total_cmp(&brightness).is_lt());
                let first = middle.saturating_sub(CROWD / 2).min(points.len() - CROWD);
                points = &points[first..first + CROWD];
            }
        }
        // Cells of other places share the bucket.
        points.iter().filter(|point| point.cell == cell).for_each(|point| each(point.number, &point.look));
    }
}

/// Octaves of sizes that those within a factor of √2 are in.
fn levels(ln_size: f32) -> RangeInclusive<i64> {
    let octave = f64::from(ln_size) / std::f64::consts::LN_2;
    (octave - 0.5).floor() as i64..=(octave + 0.5).floor() as i64
}

/// A cell is as wide as a search among the largest of its octave.
fn side(level: i64, reach: f64) -> f64 {
    2.0 * reach * ((level + 1) as f64).exp2()
}

fn own_cell(look: &Look, reach: f64) -> u64 {
    let level = (f64::from(look.ln_size) / std::f64::consts::LN_2).floor() as i64;
    let side = side(level, reach);
    cell(level, look.position.map(|x| (f64::from(x) / side).floor() as i64))
}

/// The name of a cell: two that share it would cost time and change nothing.
fn cell(level: i64, at: [i64; 3]) -> u64 {
    at.iter().fold(mix(level as u64), |hash, &x| mix(hash ^ x as u64))
}
