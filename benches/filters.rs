//! Compares filters that transform values before zstd compresses them, for each attribute, on states of trained models.
//!
//! The first table has all combinations of these choices:
//! - Values: the bits of each f32 unchanged (`order0`), or zigzag-coded differences. Before differences are taken, the
//!   bits are mapped to integers in the order of the numbers. A difference is taken to the frame before (`order1`), or
//!   to the line through the two frames before (`order2`).
//! - Bytes: in place (`plain`), or grouped by significance (`shuffled`): first the lowest byte of every value, then the
//!   next byte of every value, and so on.
//! - zstd level 1 or 3.
//!
//! `gseq` uses the better order of each tile, shuffled, at the requested level; this benchmark is the reason for that
//! choice. Sizes in percent of the raw bytes are printed as a Markdown table with one row per model and attribute.
//! Times are measured over all models together.
//!
//! A second table compares encodings within an error bound. Values are stored as multiples of twice the bound, and
//! frames as differences to the frame before. Differences are stored for all tracks (one value of one Gaussian over
//! time) or only for tracks that move, and frame by frame or track by track. The last columns are the encoding of
//! `gseq`, which also tries half the step for tracks that do not move. The figures are raw bytes divided by stored
//! bytes.
//!
//! Usage: `cargo bench --bench filters`; `cargo bench --bench filters -- decode/position` measures one attribute.

mod trajectories;

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gseq::{Compression, encode_tile};
use splatsieve::model::Attributes;
use splatsieve::source::FrameSource;

struct Filter {
    order: usize,
    shuffled: bool,
    level: i32,
}

/// Returns every filter that is compared: differences of order 0 (none), 1 and 2; bytes in place or grouped by
/// significance; zstd levels 1 and 3.
fn filters() -> impl Iterator<Item = Filter> {
    let with = |order| {
        [(false, 1), (false, 3), (true, 1), (true, 3)].map(|(shuffled, level)| Filter { order, shuffled, level })
    };
    (0..3).flat_map(with)
}

impl Filter {
    fn name(&self) -> String {
        let layout = if self.shuffled { "shuffled" } else { "plain" };
        format!("order{}_{layout}_zstd{}", self.order, self.level)
    }

    /// Filters and compresses f32 values, and returns the compressed bytes. `bits` holds the bits of the values, frame
    /// after frame, with `plane` values per frame.
    fn encode(&self, bits: &[u32], plane: usize) -> Vec<u8> {
        let mut residuals = bits.to_vec();
        if self.order > 0 {
            residuals.iter_mut().for_each(|bits| *bits = rank(*bits));
            // From the last frame to the first, so that the predictors are still unchanged.
            for frame in (1..bits.len() / plane).rev() {
                let (before, rest) = residuals.split_at_mut(frame * plane);
                let (one, two) = predictors(before, frame, plane, self.order);
                for (i, value) in rest[..plane].iter_mut().enumerate() {
                    let difference = value.wrapping_sub(predict(one[i], two[i]));
                    *value = difference << 1 ^ ((difference as i32) >> 31) as u32;
                }
            }
        }
        let mut bytes = bytemuck::cast_slice(&residuals).to_vec();
        if self.shuffled {
            for (weight, bytes) in bytes.chunks_exact_mut(residuals.len()).enumerate() {
                bytes.iter_mut().zip(&residuals).for_each(|(byte, residual)| *byte = (residual >> (8 * weight)) as u8);
            }
        }
        zstd::bulk::compress(&bytes, self.level).unwrap()
    }

    fn decode(&self, stored: &[u8], plane: usize, bytes: &mut [u8], out: &mut [u32]) {
        let len = zstd::bulk::decompress_to_buffer(stored, bytes).unwrap();
        if self.shuffled {
            let (low, high) = bytes[..len].split_at(len / 2);
            let ((b0, b1), (b2, b3)) = (low.split_at(len / 4), high.split_at(len / 4));
            for (i, value) in out.iter_mut().enumerate() {
                *value = u32::from_le_bytes([b0[i], b1[i], b2[i], b3[i]]);
            }
        } else {
            bytemuck::cast_slice_mut(out).copy_from_slice(&bytes[..len]);
        }
        if self.order > 0 {
            for frame in 1..out.len() / plane {
                let (before, rest) = out.split_at_mut(frame * plane);
                let (one, two) = predictors(before, frame, plane, self.order);
                for (i, value) in rest[..plane].iter_mut().enumerate() {
                    let difference = *value >> 1 ^ (*value & 1).wrapping_neg();
                    *value = difference.wrapping_add(predict(one[i], two[i]));
                }
            }
            out.iter_mut().for_each(|value| *value ^= !((*value as i32) >> 31) as u32 | 0x8000_0000);
        }
    }
}

/// Converts the bits of an f32 to an integer, so that the integers are in the same order as the numbers.
fn rank(bits: u32) -> u32 {
    bits ^ (((bits as i32) >> 31) as u32 | 0x8000_0000)
}

/// Returns the predicted value of a frame, 2·`one` − `two`, where `one` is the value one frame before. For prediction
/// order 2, `two` is the value two frames before. For order 1, `two` equals `one`, so the prediction is `one`.
fn predict(one: u32, two: u32) -> u32 {
    one.wrapping_mul(2).wrapping_sub(two)
}

/// Returns the values of the two frames from which `frame` is predicted: the frame before it, and the frame `order`
/// frames before it. `before` has all frames before `frame`, with `plane` values each.
fn predictors(before: &[u32], frame: usize, plane: usize, order: usize) -> (&[u32], &[u32]) {
    let back = |k: usize| &before[(frame - k) * plane..][..plane];
    (back(1), back(order.min(frame)))
}

/// Returns the error bound of the attribute `column` in the table of encodings within an error bound, in the unit of
/// the attribute.
fn bound(column: Attributes) -> f64 {
    match column {
        Attributes::POSITION => 1e-3,
        Attributes::ROTATION => 5e-3,
        Attributes::OPACITY => 2e-2,
        _ => 1e-2,
    }
}

/// Encodes f32 values as multiples of twice `bound`, and returns the bytes before compression. `bits` holds the bits of
/// the values, frame after frame, with `plane` values per frame. A track is one value of one Gaussian over time. The
/// result has one bit per track, the multiples of the first frame, then differences between frames. Bytes are grouped
/// by significance.
///
/// - `apart`: store differences only for tracks that move, instead of for all tracks.
/// - `by_track`: store differences track by track, instead of frame by frame.
fn multiples(bits: &[u32], plane: usize, bound: f64, apart: bool, by_track: bool) -> Vec<u8> {
    let multiple = |&bits: &u32| (f64::from(f32::from_bits(bits)) / (2.0 * bound)).round() as i32;
    let values: Vec<i32> = bits.iter().map(multiple).collect();
    let frames = bits.len() / plane;
    let moves = |track: usize| (1..frames).any(|frame| values[frame * plane + track] != values[track]);
    let moving: Vec<usize> = (0..plane).filter(|&track| !apart || moves(track)).collect();
    let zigzag = |difference: i32| (difference << 1 ^ difference >> 31) as u32;
    let difference = |(frame, track)| zigzag(values[frame * plane + track] - values[(frame - 1) * plane + track]);
    let differences: Vec<u32> = if by_track {
        moving.iter().flat_map(|&track| (1..frames).map(move |frame| (frame, track))).map(difference).collect()
    } else {
        (1..frames).flat_map(|frame| moving.iter().map(move |&track| (frame, track))).map(difference).collect()
    };
    let first: Vec<u32> = values[..plane].iter().map(|&value| zigzag(value)).collect();
    let mut out = vec![0u8; plane.div_ceil(8)];
    moving.iter().for_each(|track| out[track / 8] |= 1 << (track % 8));
    for part in [first, differences] {
        (0..4).for_each(|weight| out.extend(part.iter().map(|value| (value >> (8 * weight)) as u8)));
    }
    out
}

/// Values of a tile (values of one attribute that are encoded together) as bits of f32, and the number of values per
/// frame.
type TileBits = (Vec<u32>, usize);

/// Returns a row of the table of encodings within an error bound: the row of the scene `name` and the attribute
/// `column`, whose values are `tiles`.
fn within_bounds(name: &str, column: Attributes, tiles: &[TileBits]) -> String {
    let raw: usize = tiles.iter().map(|(bits, _)| 4 * bits.len()).sum();
    let times =
        |size: &dyn Fn(&TileBits) -> usize| format!("{:.0}", raw as f64 / tiles.iter().map(size).sum::<usize>() as f64);
    let mut row = format!("| {name} | {} | {} | ", column.name(), bound(column));
    for (apart, by_track) in [(false, false), (false, true), (true, false), (true, true)] {
        row += &times(&|(bits, plane)| {
            zstd::bulk::compress(&multiples(bits, *plane, bound(column), apart, by_track), 15).unwrap().len()
        });
        row += " | ";
    }
    for level in [1, 15, 19] {
        let compression = Compression::Bounded { max_error: bound(column), level };
        row += &times(&|(bits, plane)| {
            let frames = (bits.len() / plane) as u32;
            encode_tile(bytemuck::cast_slice(bits), frames, 1, *plane as u32, compression).unwrap().stored_bytes()
        });
        row += " | ";
    }
    row
}

fn benches(criterion: &mut Criterion) {
    let mut columns: Vec<(Attributes, Vec<TileBits>)> =
        Attributes::all().iter().map(|column| (column, Vec::new())).collect();
    let names: Vec<String> = filters().map(|filter| filter.name()).collect();
    eprintln!("| scene | column | {} |\n|---|---|{}", names.join(" | "), "---|".repeat(names.len()));
    let mut within = Vec::new();
    for (name, scene) in trajectories::scenes() {
        for (column, all_tiles) in columns.iter_mut().filter(|(column, _)| scene.info().varying.contains(*column)) {
            let tiles = trajectories::tiles(&scene, *column).into_iter();
            let tiles: Vec<TileBits> =
                tiles.map(|tile| (bytemuck::cast_slice(&tile).to_vec(), tile.len() / scene.len())).collect();
            let raw: usize = tiles.iter().map(|(bits, _)| 4 * bits.len()).sum();
            let percent = |filter: Filter| {
                let stored: usize = tiles.iter().map(|(bits, plane)| filter.encode(bits, *plane).len()).sum();
                format!("{:.1}", 100.0 * stored as f64 / raw as f64)
            };
            let sizes: Vec<String> = filters().map(percent).collect();
            eprintln!("| {name} | {} | {} |", column.name(), sizes.join(" | "));
            within.push(within_bounds(name, *column, &tiles));
            // Generated curves with noise do not represent models.
            if name != "curves" {
                all_tiles.extend(tiles);
            }
        }
    }
    eprintln!(
        "| scene | column | bound | all, by frame | all, by track | moving, by frame | moving, by track | gseq 1 | 15 | 19 |"
    );
    eprintln!("|---|---|---|---|---|---|---|---|---|---|\n{}", within.join("\n"));
    for (column, tiles) in columns.iter().filter(|(_, tiles)| !tiles.is_empty()) {
        let values = tiles.iter().map(|(bits, _)| bits.len()).sum::<usize>();
        let most = tiles.iter().map(|(bits, _)| bits.len()).max().unwrap_or(0);
        let (mut bytes, mut out) = (vec![0; 4 * most], vec![0; most]);
        for filter in filters() {
            let stored: Vec<Vec<u8>> = tiles.iter().map(|(bits, plane)| filter.encode(bits, *plane)).collect();
            let mut decode_all = |check: bool| {
                for ((bits, plane), stored) in tiles.iter().zip(&stored) {
                    let out = &mut out[..bits.len()];
                    filter.decode(stored, *plane, &mut bytes, out);
                    assert!(!check || out == bits, "{} loses bits", filter.name());
                }
            };
            decode_all(true);
            let mut group = |verb: &str, work: &mut dyn FnMut()| {
                let mut group = criterion.benchmark_group(format!("{verb}/{}", column.name()));
                group.sample_size(10).throughput(Throughput::Bytes(4 * values as u64));
                group.bench_function(BenchmarkId::from_parameter(filter.name()), |bencher| bencher.iter(&mut *work));
            };
            group("encode", &mut || {
                tiles.iter().for_each(|(bits, plane)| _ = black_box(filter.encode(bits, *plane)));
            });
            group("decode", &mut || decode_all(false));
        }
    }
}

criterion_group! {
    name = all;
    // There are more than a hundred benchmarks.
    config = Criterion::default().warm_up_time(std::time::Duration::from_millis(200)).measurement_time(std::time::Duration::from_millis(800));
    targets = benches
}
criterion_main!(all);
