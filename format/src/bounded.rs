//! Tiles whose values may be off by a bound: values to stored bytes, and what those say of the tile (SPEC.md, "Bounded").
//!
//! A value becomes a multiple of a step. A *track*, one component of one Gaussian over the frames of the tile, stands still
//! if one multiple is near enough to all its values; of the others the multiples are predicted from the frames before,
//! as integers, so that no error adds up. Every value is decoded again while it is encoded: one that would be off by more
//! than the bound, or is not finite, is kept as it is.
//!
//! Raw bytes over stored ones of three trained models, zstd level 15, bounds of .001 for positions, .005 for rotations,
//! .01 for log scales and harmonics (`cargo bench --bench filters` of the program prints the table):
//!
//! | column | all tracks, by frame | by track | tracks that move, by frame | by track | half a step for the others, where smaller |
//! |---|---|---|---|---|---|
//! | position | 14–20 | 18–22 | 14–20 | 18–22 | 18–23 |
//! | rotation | 43–63 | 44–67 | 44–76 | 45–77 | 50–103 |
//! | log_scale | 48–66 | 48–71 | 53–77 | 55–78 | 59–95 |
//! | sh (one model) | 135 | 153 | 168 | 172 | 234 |

use std::io;

use crate::codec::{Stats, order_at, predict, shuffle_into, stats, zigzag};

/// Least and greatest bound of a column, so that a step is a finite number above zero.
pub(crate) const BOUNDS: std::ops::RangeInclusive<f64> = f32::MIN_POSITIVE as f64..=f32::MAX as f64;
/// Bytes before the exceptions: step, number of exceptions, halvings of the step for tracks that stand still.
const HEAD: usize = 16;
/// There is at most one exception for so many values.
const VALUES_PER_EXCEPTION: usize = 16;
/// Multiples stay below it, so that two differences of them fit 32 bits.
const MOST: f64 = (1 << 28) as f64;
/// zstd level that decides whether tracks that stand still shall have half the step: more of them do then, and each takes
/// a bit more.
const TRIAL_LEVEL: i32 = 1;

/// A tile that is stored within a bound.
pub(crate) struct Bounded {
    pub(crate) order: u8,
    pub(crate) constant: bool,
    pub(crate) stats: Stats,
    pub(crate) bytes: Vec<u8>,
}

/// Encodes `values`, frames of `plane` values, at most `max_error` off; none where that does not pay: too many values
/// are kept as they are, or the bytes are no fewer than 4 a value.
pub(crate) fn encode(values: &[f32], plane: usize, max_error: f64, level: i32) -> io::Result<Option<Bounded>> {
    let step = step(values, max_error);
    let whole = Multiples::new(values, plane, max_error, step, 0);
    let halved = Multiples::new(values, plane, max_error, step, 1);
    let multiples = if halved.still() > whole.still() {
        let size = |multiples: &Multiples| zstd::bulk::compress(&multiples.body(multiples.order()), TRIAL_LEVEL);
        if size(&halved)?.len() < size(&whole)?.len() { halved } else { whole }
    } else {
        whole
    };
    if multiples.exceptions.len() * VALUES_PER_EXCEPTION > values.len() {
        return Ok(None);
    }
    let decoded = multiples.decoded();
    let (first, rest) = decoded.split_at(plane);
    let constant = rest.chunks_exact(plane).all(|frame| frame == first);
    let stats = stats(if constant { first } else { &decoded });
    let multiples = if constant { multiples.first_frame() } else { multiples };
    drop(decoded);

    let mut bytes = Vec::new();
    bytes.extend(step.to_le_bytes());
    bytes.extend((multiples.exceptions.len() as u32).to_le_bytes());
    bytes.extend(multiples.halvings.to_le_bytes());
    bytes.extend(multiples.exceptions.iter().flat_map(|&(place, bits)| [place, bits]).flat_map(u32::to_le_bytes));
    let order = multiples.order();
    let body = multiples.body(order);
    let values = multiples.values.len();
    drop(multiples);
    bytes.extend(zstd::bulk::compress(&body, level)?);
    Ok((bytes.len() < 4 * values).then_some(Bounded { order, constant, stats, bytes }))
}

/// The value of a multiple.
fn value(multiple: u32, step: f64) -> u32 {
    ((f64::from(multiple as i32) * step) as f32).to_bits()
}

/// Step of values that are at most `max_error` off: twice that, less what rounding the largest of them to f32 may add. Larger
/// ones, whose neighbors in f32 are further apart than half of it, may become exceptions.
fn step(values: &[f32], max_error: f64) -> f64 {
    let spacing = |value: f32| f64::from(value.next_up()) - f64::from(value);
    let sizes = values.iter().map(|value| value.abs()).filter(|size| size.is_finite());
    let most = sizes.filter(|&size| spacing(size) <= 0.5 * max_error).fold(0.0, f32::max);
    2.0 * max_error - spacing((f64::from(most) + max_error) as f32)
}

/// A tile as multiples of its step.
struct Multiples {
    plane: usize,
    step: f64,
    halvings: u32,
    /// As the tile's values lie; of tracks that stand still those of the halved step.
    values: Vec<u32>,
    /// By track.
    moves: Vec<bool>,
    /// Place among the values, and bits, of those that are kept as they are; increasing.
    exceptions: Vec<(u32, u32)>,
}

impl Multiples {
    fn new(values: &[f32], plane: usize, max_error: f64, step: f64, halvings: u32) -> Multiples {
        let still = still_step(step, halvings);
        // The multiple nearest to `x` if it is near enough to all of `values`.
        let near = |x: f64, step: f64, values: [f32; 2]| {
            let nearest = (x / step).round();
            let multiple = (nearest.abs() < MOST).then_some(nearest as i32 as u32)?;
            let stored = f64::from(f32::from_bits(value(multiple, step)));
            values.iter().all(|&v| (stored - f64::from(v)).abs() <= max_error).then_some(multiple)
        };
        let (mut least, mut most) = (values[..plane].to_vec(), values[..plane].to_vec());
        for frame in values.chunks_exact(plane).skip(1) {
            for ((least, most), &value) in least.iter_mut().zip(&mut most).zip(frame) {
                // What is no number stays: no multiple is near it.
                *least = if value < *least || value.is_nan() { value } else { *least };
                *most = if value > *most || value.is_nan() { value } else { *most };
            }
        }
        let of_track =
            |(&least, &most): (&f32, &f32)| near(0.5 * (f64::from(least) + f64::from(most)), still, [least, most]);
        let stands: Vec<Option<u32>> = least.iter().zip(&most).map(of_track).collect();
        let (mut multiples, mut exceptions) = (vec![0; values.len()], Vec::new());
        for (place, &value) in values.iter().enumerate() {
            let before = place.checked_sub(plane).map_or(0, |before| multiples[before]);
            multiples[place] = match stands[place % plane] {
                Some(multiple) => multiple,
                None => near(value.into(), step, [value; 2]).unwrap_or_else(|| {
                    exceptions.push((place as u32, value.to_bits()));
                    before
                }),
            };
        }
        let moves = stands.iter().map(Option::is_none).collect();
        Multiples { plane, step, halvings, values: multiples, moves, exceptions }
    }

    /// Tracks that stand still.
    fn still(&self) -> usize {
        self.moves.iter().filter(|&&moves| !moves).count()
    }

    /// The first frame alone.
    fn first_frame(mut self) -> Multiples {
        self.values.truncate(self.plane);
        self.exceptions.retain(|&(place, _)| (place as usize) < self.plane);
        self
    }

    /// Bits of the values as they are decoded.
    fn decoded(&self) -> Vec<u32> {
        let steps = [still_step(self.step, self.halvings), self.step];
        let tracks = self.moves.iter().cycle();
        let values =
            self.values.iter().zip(tracks).map(|(&multiple, &moves)| value(multiple, steps[usize::from(moves)]));
        let mut values: Vec<u32> = values.collect();
        self.exceptions.iter().for_each(|&(place, bits)| values[place as usize] = bits);
        values
    }

    /// By how much [`predict`] is wrong of a track at a frame after the first.
    fn residual(&self, order: u8, track: usize, frame: usize) -> u32 {
        let order = order_at(order, frame);
        let at = |back: usize| self.values[(frame - back) * self.plane + track];
        zigzag(at(0).wrapping_sub(predict(order, at(1), at(order.into()))))
    }

    /// The residuals after the first frame of tracks that move, track by track.
    fn residuals(&self, order: u8) -> impl Iterator<Item = u32> + '_ {
        let moving = (0..self.plane).filter(|&track| self.moves[track]);
        let frames = self.values.len() / self.plane;
        moving.flat_map(move |track| (1..frames).map(move |frame| self.residual(order, track, frame)))
    }

    /// The order with the shorter residuals.
    fn order(&self) -> u8 {
        let cost = |order| self.residuals(order).map(|residual| u64::from(32 - residual.leading_zeros())).sum::<u64>();
        if cost(2) < cost(1) { 2 } else { 1 }
    }

    /// What zstd takes.
    fn body(&self, order: u8) -> Vec<u8> {
        let mut out = vec![0; self.plane.div_ceil(8)];
        for (track, _) in self.moves.iter().enumerate().filter(|(_, moves)| **moves) {
            out[track / 8] |= 1 << (track % 8);
        }
        shuffle_into(&self.values[..self.plane].iter().copied().map(zigzag).collect::<Vec<_>>(), &mut out);
        shuffle_into(&self.residuals(order).collect::<Vec<_>>(), &mut out);
        out
    }
}

fn still_step(step: f64, halvings: u32) -> f64 {
    if halvings == 0 { step } else { 0.5 * step }
}

/// What the stored bytes of a bounded tile say before its zstd frame, and which of its tracks move.
#[derive(Debug, Default)]
pub(crate) struct Tracks {
    /// Of tracks that stand still, and of those that move.
    steps: [f64; 2],
    exceptions: Vec<(u32, u32)>,
    plane: usize,
    frames: usize,
    /// Tracks that move.
    moving: usize,
}

impl Tracks {
    /// Reads the bytes before the zstd frame, which is given back. The error says what was found.
    pub(crate) fn read_head<'a>(
        &mut self,
        stored: &'a [u8],
        frames: usize,
        plane: usize,
        max_error: f64,
    ) -> Result<&'a [u8], String> {
        let short = || format!("{} stored bytes", stored.len());
        let (head, rest) = stored.split_first_chunk::<HEAD>().ok_or_else(short)?;
        let step = f64::from_le_bytes(std::array::from_fn(|i| head[i]));
        let [exceptions, halvings] = [8, 12].map(|at| u32::from_le_bytes(std::array::from_fn(|i| head[at + i])));
        if !(step > 0.0 && step <= 2.0 * max_error) {
            return Err(format!("a step of {step} where {max_error} is the bound"));
        }
        if halvings > 1 {
            return Err(format!("{halvings} halvings of the step"));
        }
        if exceptions as usize > frames * plane / VALUES_PER_EXCEPTION {
            return Err(format!("{exceptions} exceptions"));
        }
        let (places, packed) = rest.split_at_checked(8 * exceptions as usize).ok_or_else(short)?;
        let word = |bytes: &[u8; 8], at: usize| u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        self.exceptions.clear();
        self.exceptions.extend(places.as_chunks().0.iter().map(|bytes| (word(bytes, 0), word(bytes, 4))));
        let increase = self.exceptions.windows(2).all(|pair| pair[0].0 < pair[1].0);
        if !increase || self.exceptions.last().is_some_and(|&(place, _)| place as usize >= frames * plane) {
            return Err("exceptions that do not increase within the tile".to_owned());
        }
        (self.steps, self.plane, self.frames) = ([still_step(step, halvings), step], plane, frames);
        Ok(packed)
    }

    /// Bytes that the zstd frame holds at most.
    pub(crate) fn most_bytes(&self) -> usize {
        self.mask_bytes() + 4 * self.frames * self.plane
    }

    /// Reads which tracks move off the bytes in the zstd frame. The error says what was found.
    pub(crate) fn read_mask(&mut self, bytes: &[u8]) -> Result<(), String> {
        let wrong = || format!("{} bytes after decompression", bytes.len());
        let mask = bytes.get(..self.mask_bytes()).ok_or_else(wrong)?;
        self.moving = mask.iter().map(|byte| byte.count_ones() as usize).sum();
        let expected = mask.len() + 4 * (self.plane + self.moving * (self.frames - 1));
        let spare = mask.last().is_some_and(|&last| !self.plane.is_multiple_of(8) && last >> (self.plane % 8) != 0);
        if spare || bytes.len() != expected {
            return Err(wrong());
        }
        Ok(())
    }

    /// Zigzagged multiples of the first frame.
    pub(crate) fn first<'a>(&self, bytes: &'a [u8]) -> impl Iterator<Item = u32> + 'a {
        let (from, plane) = (self.mask_bytes(), self.plane);
        (0..plane).map(move |track| gathered(&bytes[from..], plane, track))
    }

    /// Tracks that move and their residuals at a frame after the first.
    pub(crate) fn residuals<'a>(&self, bytes: &'a [u8], frame: usize) -> impl Iterator<Item = (usize, u32)> + 'a {
        let from = self.mask_bytes() + 4 * self.plane;
        let (after_first, values) = (self.frames - 1, self.moving * (self.frames - 1));
        let moving = (0..self.plane).filter(|&track| moves(bytes, track)).enumerate();
        moving.map(move |(nth, track)| (track, gathered(&bytes[from..], values, nth * after_first + frame - 1)))
    }

    /// Bits of the values of a frame, whose multiples these are.
    pub(crate) fn values(&self, bytes: &[u8], frame: usize, multiples: &[u32], out: &mut [u32]) {
        for (track, (out, &multiple)) in out.iter_mut().zip(multiples).enumerate() {
            *out = value(multiple, self.steps[usize::from(moves(bytes, track))]);
        }
        // Exceptions before a frame.
        let before =
            |frame: usize| self.exceptions.partition_point(|&(place, _)| (place as usize) < frame * self.plane);
        for &(place, bits) in &self.exceptions[before(frame)..before(frame + 1)] {
            out[place as usize - frame * self.plane] = bits;
        }
    }

    /// Bytes it holds beside itself.
    pub(crate) fn memory(&self) -> usize {
        size_of::<(u32, u32)>() * self.exceptions.capacity()
    }

    fn mask_bytes(&self) -> usize {
        self.plane.div_ceil(8)
    }
}

fn moves(bytes: &[u8], track: usize) -> bool {
    bytes[track / 8] >> (track % 8) & 1 != 0
}

/// Value `place` of `values` whose bytes of equal weight are gathered.
fn gathered(bytes: &[u8], values: usize, place: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|weight| bytes[weight * values + place]))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use zstd::bulk::Decompressor;

    use super::*;
    use crate::codec::{Encoding, Stored, Unfilter};

    fn decoded(tile: &Bounded, frames: usize, plane: usize, max_error: f64) -> Result<Vec<f32>, String> {
        let stored_frames = if tile.constant { 1 } else { frames };
        let encoding = Encoding::Bounded { order: tile.order };
        let stored = Stored { bytes: &tile.bytes, encoding, frames: stored_frames, plane, max_error };
        let mut unfilter = Unfilter::default();
        unfilter.load(stored, &mut Decompressor::new().unwrap())?;
        let mut out = vec![0u32; plane];
        let mut values = Vec::new();
        for frame in 0..frames {
            unfilter.frame(if tile.constant { 0 } else { frame }, &mut out);
            values.extend(out.iter().map(|&bits| f32::from_bits(bits)));
        }
        Ok(values)
    }

    /// Values of every kind: tracks that rest, drift, jitter or jump, some of any bits.
    fn tiles() -> impl Strategy<Value = (usize, usize, Vec<f32>)> {
        let track = |frames: usize| {
            let from = prop_oneof![-3.0f32..3.0, -2e5f32..2e5, Just(0.0)];
            let walk = prop_oneof![
                from.clone().prop_map(move |at| vec![at; frames]),
                (from.clone(), -0.01f32..0.01)
                    .prop_map(move |(at, by)| (0..frames).map(|t| at + by * t as f32).collect()),
                (from, prop::collection::vec(-2e-3f32..2e-3, frames))
                    .prop_map(|(at, by)| by.into_iter().map(|by| at + by).collect::<Vec<_>>()),
                prop::collection::vec(-5.0f32..5.0, frames),
            ];
            (walk, 0..frames, any::<u32>(), prop::bool::weighted(0.1)).prop_map(|(mut walk, at, bits, odd)| {
                if odd {
                    walk[at] = f32::from_bits(bits);
                }
                walk
            })
        };
        (1usize..9, 1usize..70).prop_flat_map(move |(frames, plane)| {
            prop::collection::vec(track(frames), plane).prop_map(move |tracks| {
                let values = (0..frames).flat_map(|frame| tracks.iter().map(move |track| track[frame]));
                (frames, plane, values.collect())
            })
        })
    }

    proptest! {
        #[test]
        fn no_value_is_off_by_more_than_the_bound((frames, plane, values) in tiles(), max_error in 1e-6f64..0.5) {
            let Some(tile) = encode(&values, plane, max_error, 1).unwrap() else { return Ok(()) };
            let found = decoded(&tile, frames, plane, max_error).unwrap();
            for (place, (&before, &after)) in values.iter().zip(&found).enumerate() {
                let off = (f64::from(before) - f64::from(after)).abs();
                let kept = before.to_bits() == after.to_bits();
                prop_assert!(kept || off <= max_error, "value {}: {} is {}", place, before, after);
            }
            let stored: Vec<u32> = found.iter().map(|value| value.to_bits()).collect();
            let expected = stats(if tile.constant { &stored[..plane] } else { &stored });
            prop_assert_eq!(tile.stats, expected);
            prop_assert_eq!(tile.constant, stored.chunks_exact(plane).all(|frame| frame == &stored[..plane]));
        }

        #[test]
        fn frames_come_back_in_whatever_order_they_are_asked_for(
            (frames, plane, values) in tiles(), asked in prop::collection::vec(0usize..9, 1..12),
        ) {
            let Some(tile) = encode(&values, plane, 1e-3, 1).unwrap().filter(|tile| !tile.constant) else { return Ok(()) };
            let expected = decoded(&tile, frames, plane, 1e-3).unwrap();
            let encoding = Encoding::Bounded { order: tile.order };
            let mut unfilter = Unfilter::default();
            let stored = Stored { bytes: &tile.bytes, encoding, frames, plane, max_error: 1e-3 };
            unfilter.load(stored, &mut Decompressor::new().unwrap()).unwrap();
            let mut out = vec![0u32; plane];
            for frame in asked.into_iter().map(|frame| frame % frames) {
                unfilter.frame(frame, &mut out);
                let same = out.iter().copied().eq(expected[frame * plane..][..plane].iter().map(|value| value.to_bits()));
                prop_assert!(same, "frame {}", frame);
            }
        }
    }

    #[test]
    fn what_drifts_within_the_bound_stands_still() {
        let values: Vec<f32> = (0..32 * 256).map(|i| (i % 256) as f32 + 1e-5 * (i / 256) as f32).collect();
        let tile = encode(&values, 256, 1e-3, 1).unwrap().unwrap();
        assert!(tile.constant);
        let moved: Vec<f32> = values.iter().map(|&value| if value < 1.0 { 90.0 * value } else { value }).collect();
        let tile = encode(&moved, 256, 1e-3, 1).unwrap().unwrap();
        assert!(!tile.constant);
        assert!(tile.bytes.len() < 700, "{} bytes for 255 tracks that stand still", tile.bytes.len());
    }

    #[test]
    fn what_does_not_pay_is_left_to_other_encodings() {
        assert!(encode(&[1.0], 1, 1e-3, 1).unwrap().is_none(), "one value");
        let odd: Vec<f32> = (0..640).map(|i| if i % 15 == 0 { f32::NAN } else { 1.0 }).collect();
        assert!(encode(&odd, 64, 1e-3, 1).unwrap().is_none(), "too many exceptions");
        // Neighbors in f32 are further apart than the bound.
        let far: Vec<f32> = (0..640).map(|i| 3e7 + 8.0 * i as f32).collect();
        assert!(encode(&far, 64, 1e-3, 1).unwrap().is_none(), "no multiple is near");
    }

    /// Bytes that lie are refused, whatever they claim; none of them may make it panic.
    #[test]
    fn stored_bytes_that_lie_are_refused() {
        let values: Vec<f32> = (0..8 * 64).map(|i| (i as f32 * 0.37).sin()).collect();
        let values: Vec<f32> =
            values.into_iter().enumerate().map(|(i, v)| if i == 70 { f32::NAN } else { v }).collect();
        let good = encode(&values, 64, 1e-3, 1).unwrap().unwrap();
        decoded(&good, 8, 64, 1e-3).unwrap();
        let with = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = good.bytes.clone();
            change(&mut bytes);
            decoded(&Bounded { bytes, ..good }, 8, 64, 1e-3)
        };
        let body = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut body = zstd::bulk::decompress(&good.bytes[HEAD + 8..], 1 << 16).unwrap();
            change(&mut body);
            with(&|bytes| bytes.splice(HEAD + 8.., zstd::bulk::compress(&body, 1).unwrap()).for_each(drop))
        };
        body(&|_| ()).unwrap();
        let cases: [(&str, Result<Vec<f32>, String>); 12] = [
            ("a step above twice the bound", with(&|bytes| bytes[..8].copy_from_slice(&2.1e-3f64.to_le_bytes()))),
            ("no step", with(&|bytes| bytes[..8].copy_from_slice(&f64::NAN.to_le_bytes()))),
            ("a step of 0", with(&|bytes| bytes[..8].fill(0))),
            ("absurdly many exceptions", with(&|bytes| bytes[8..12].fill(255))),
            ("more exceptions than there are", with(&|bytes| bytes[8] = 2)),
            ("two halvings", with(&|bytes| bytes[12] = 2)),
            ("an exception beyond the tile", with(&|bytes| bytes[HEAD + 1] = 255)),
            ("a cut head", with(&|bytes| bytes.truncate(HEAD - 1))),
            ("a cut frame", with(&|bytes| bytes.truncate(HEAD + 20))),
            ("a track less", body(&|body| body[0] &= 0xfe)),
            ("a byte too many", body(&|body| body.push(0))),
            ("no bytes", body(&Vec::clear)),
        ];
        for (name, found) in cases {
            assert!(found.is_err(), "{name} passed");
        }
        for at in 0..good.bytes.len() {
            _ = with(&|bytes| bytes[at] ^= 1 << (at % 8));
        }
    }
}
