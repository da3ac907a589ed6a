//! Lossy tiles: encodes the values of a tile (one column for a block of Gaussians and frames) so that no decoded value
//! differs from the original by more than the error bound of the column, and decodes them (SPEC.md, "Bounded").
//!
//! Values are stored as integer multiples of a step. A *track* is one component of one Gaussian over the frames of the
//! tile. A track is *static* if one multiple is within the bound of all its values; this multiple is stored once. All
//! other tracks are *moving*: each multiple is predicted from the multiples of earlier frames, and the integer
//! difference is stored, so that errors do not accumulate. The encoder decodes every value again. A value that is not
//! finite, or would differ by more than the bound, is stored as an *exception* with its original bits.
//!
//! The table shows compression factors (raw bytes / stored bytes) of three trained models, with zstd level 15 and
//! bounds of .001 for positions, .005 for rotations and .01 for log scales and SH coefficients (`cargo bench --bench
//! filters` of the program prints the table). Its columns are variants of the encoding. "All" stores the prediction
//! errors (residuals) of all tracks, "moving" only those of moving tracks. "By frame" stores the prediction errors of
//! one frame after the other, "by track" those of one track after the other. The last column is "moving, by track" with
//! half the step for static tracks in tiles that become smaller that way:
//!
//! | column | all, by frame | all, by track | moving, by frame | moving, by track | half step where smaller |
//! |---|---|---|---|---|---|
//! | position | 14–20 | 18–22 | 14–20 | 18–22 | 18–23 |
//! | rotation | 43–63 | 44–67 | 44–76 | 45–77 | 50–103 |
//! | log_scale | 48–66 | 48–71 | 53–77 | 55–78 | 59–95 |
//! | sh (one model) | 135 | 153 | 168 | 172 | 234 |

use std::io;

use crate::codec::{TileStats, order_at, predict, shuffle_into, stats, zigzag};

/// Range of the error bounds that a column may have. Every bound in this range gives a finite quantization step above
/// zero.
pub(crate) const BOUNDS: std::ops::RangeInclusive<f64> = f32::MIN_POSITIVE as f64..=f32::MAX as f64;
/// Length in bytes of the fields at the start of a stored tile: the quantization step, the number of exceptions (values
/// stored with their original bits), and how often the step is halved for static tracks (components of a Gaussian that
/// are stored as one number). The exceptions follow these fields.
const HEAD_BYTES: usize = 16;
/// Minimum number of values per exception (value stored with its original bits). A tile with more exceptions is stored
/// in another encoding.
const VALUES_PER_EXCEPTION: usize = 16;
/// Limit of the absolute value of a multiple of the quantization step. All multiples are below this limit, so that the
/// differences of their differences fit 32 bits.
const MAX_MULTIPLE: f64 = (1 << 28) as f64;
/// zstd level of a trial compression. The trial decides whether static tracks (components of a Gaussian whose values in
/// all frames are stored as one number) use half the quantization step. Half the step makes more tracks static, but
/// doubles the numbers that are stored for them, and larger numbers take more space.
const TRIAL_LEVEL: i32 = 1;

/// Encoded tile whose decoded values differ from the original ones by at most the error bound.
pub(crate) struct BoundedTile {
    pub(crate) order: u8,
    pub(crate) constant: bool,
    pub(crate) stats: TileStats,
    pub(crate) bytes: Vec<u8>,
}

/// Encodes `values`, which are frames of `plane` values each, with an error of at most `max_error`. `level` is the zstd
/// level.
///
/// Returns `None` if the tile should be stored in another encoding: more than one value in 16 has to be stored with its
/// original bits, or the result takes 4 bytes per value or more.
pub(crate) fn encode(values: &[f32], plane: usize, max_error: f64, level: i32) -> io::Result<Option<BoundedTile>> {
    let step = step(values, max_error);
    let whole = Multiples::new(values, plane, max_error, step, 0);
    let halved = Multiples::new(values, plane, max_error, step, 1);
    let multiples = if halved.static_tracks() > whole.static_tracks() {
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
    Ok((bytes.len() < 4 * values).then_some(BoundedTile { order, constant, stats, bytes }))
}

/// Returns the bits of the f32 value `multiple` · `step`. The bits of `multiple` are those of an i32.
fn value(multiple: u32, step: f64) -> u32 {
    ((f64::from(multiple as i32) * step) as f32).to_bits()
}

/// Returns the quantization step 2·(`max_error` − r), with which decoded values differ from `values` by at most
/// `max_error`. r is the largest error that rounding a decoded value to f32 may add. It follows from the largest
/// absolute value in `values`.
///
/// This maximum leaves out values so large that neighboring f32 numbers are more than `max_error` / 2 apart. If the
/// error of such a value exceeds `max_error`, the value is stored with its original bits, as an exception.
fn step(values: &[f32], max_error: f64) -> f64 {
    let spacing = |value: f32| f64::from(value.next_up()) - f64::from(value);
    let sizes = values.iter().map(|value| value.abs()).filter(|size| size.is_finite());
    let most = sizes.filter(|&size| spacing(size) <= 0.5 * max_error).fold(0.0, f32::max);
    2.0 * max_error - spacing((f64::from(most) + max_error) as f32)
}

/// Values of a tile, quantized to integer multiples of a step.
struct Multiples {
    plane: usize,
    step: f64,
    halvings: u32,
    /// Multiples of the quantization step, in the order of the tile's values. The step depends on the track (one
    /// component of one Gaussian over all frames): [`static_step`] for a static track, whose values are all stored as
    /// one multiple, and `step` for all others.
    values: Vec<u32>,
    /// Whether each track (one component of one Gaussian over all frames) is moving. A track that is not moving is
    /// static: all of its values are stored as one multiple.
    moves: Vec<bool>,
    /// Values stored as they are: index of the value and its original bits, in the order of the indices.
    exceptions: Vec<(u32, u32)>,
}

impl Multiples {
    /// Quantizes `values`, which are frames of `plane` values each, with an error of at most `max_error`. A track is
    /// one component of one Gaussian over all frames.
    /// - The step of a static track is `step`, halved `halvings` times (0 or 1). A track is static if one multiple of
    ///   this step is within the error bound of all its values.
    /// - The step of all other tracks is `step`.
    fn new(values: &[f32], plane: usize, max_error: f64, step: f64, halvings: u32) -> Multiples {
        let resting_step = static_step(step, halvings);
        // Returns the multiple of `step` nearest to `x`, if it is within the error bound of all of `values`.
        let nearest = |x: f64, step: f64, values: [f32; 2]| {
            let rounded = (x / step).round();
            let multiple = (rounded.abs() < MAX_MULTIPLE).then_some(rounded as i32 as u32)?;
            let stored = f64::from(f32::from_bits(value(multiple, step)));
            values.iter().all(|&v| (stored - f64::from(v)).abs() <= max_error).then_some(multiple)
        };
        let (mut least, mut most) = (values[..plane].to_vec(), values[..plane].to_vec());
        for frame in values.chunks_exact(plane).skip(1) {
            for ((least, most), &value) in least.iter_mut().zip(&mut most).zip(frame) {
                // A NaN is kept: no multiple is within the bound of it, so the track becomes a moving one.
                *least = if value < *least || value.is_nan() { value } else { *least };
                *most = if value > *most || value.is_nan() { value } else { *most };
            }
        }
        let static_multiple = |(&least, &most): (&f32, &f32)| {
            nearest(0.5 * (f64::from(least) + f64::from(most)), resting_step, [least, most])
        };
        let static_multiples: Vec<Option<u32>> = least.iter().zip(&most).map(static_multiple).collect();
        let (mut multiples, mut exceptions) = (vec![0; values.len()], Vec::new());
        for (place, &value) in values.iter().enumerate() {
            let before = place.checked_sub(plane).map_or(0, |before| multiples[before]);
            multiples[place] = match static_multiples[place % plane] {
                Some(multiple) => multiple,
                None => nearest(value.into(), step, [value; 2]).unwrap_or_else(|| {
                    exceptions.push((place as u32, value.to_bits()));
                    before
                }),
            };
        }
        let moves = static_multiples.iter().map(Option::is_none).collect();
        Multiples { plane, step, halvings, values: multiples, moves, exceptions }
    }

    /// Returns the number of static tracks: components of a Gaussian whose values in all frames are stored as one
    /// number.
    fn static_tracks(&self) -> usize {
        self.moves.iter().filter(|&&moves| !moves).count()
    }

    /// Keeps the first frame only, for a tile whose frames are all equal: drops the multiples and exceptions of all
    /// later frames.
    fn first_frame(mut self) -> Multiples {
        self.values.truncate(self.plane);
        self.exceptions.retain(|&(place, _)| (place as usize) < self.plane);
        self
    }

    /// Returns the f32 bits of all values as a decoder reads them from the tile.
    fn decoded(&self) -> Vec<u32> {
        let steps = [static_step(self.step, self.halvings), self.step];
        let tracks = self.moves.iter().cycle();
        let values =
            self.values.iter().zip(tracks).map(|(&multiple, &moves)| value(multiple, steps[usize::from(moves)]));
        let mut values: Vec<u32> = values.collect();
        self.exceptions.iter().for_each(|&(place, bits)| values[place as usize] = bits);
        values
    }

    /// Returns the prediction error of track `track` (one component of one Gaussian) at frame `frame`, zigzag-coded.
    /// `order` is the number of earlier frames that predict a value. `frame` must not be the first.
    fn residual(&self, order: u8, track: usize, frame: usize) -> u32 {
        let order = order_at(order, frame);
        let at = |back: usize| self.values[(frame - back) * self.plane + track];
        zigzag(at(0).wrapping_sub(predict(order, at(1), at(order.into()))))
    }

    /// Returns the prediction errors of all moving tracks (components of Gaussians that change in the tile) at all
    /// frames but the first, track by track. `order` is the number of earlier frames that predict a value.
    fn residuals(&self, order: u8) -> impl Iterator<Item = u32> + '_ {
        let moving = (0..self.plane).filter(|&track| self.moves[track]);
        let frames = self.values.len() / self.plane;
        moving.flat_map(move |track| (1..frames).map(move |frame| self.residual(order, track, frame)))
    }

    /// Returns the order of prediction (number of earlier frames that predict a value), 1 or 2, with which the
    /// prediction errors take fewer bits.
    fn order(&self) -> u8 {
        let cost = |order| self.residuals(order).map(|residual| u64::from(32 - residual.leading_zeros())).sum::<u64>();
        if cost(2) < cost(1) { 2 } else { 1 }
    }

    /// Returns the bytes that zstd compresses: a mask with one bit per track (component of a Gaussian) that tells which
    /// tracks are moving; the values of the first frame, as integer multiples of the quantization step; and the
    /// prediction errors of moving tracks in the later frames. `order` is the number of earlier frames that predict a
    /// value.
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

/// Returns the quantization step of static tracks (components of a Gaussian whose values in all frames are stored as
/// one number): `step` halved `halvings` times (0 or 1).
fn static_step(step: f64, halvings: u32) -> f64 {
    if halvings == 0 { step } else { 0.5 * step }
}

/// Decoder of a lossy tile: turns the stored bytes of the tile into the quantized value of each track, and quantized
/// values into f32 values. First call [`BoundedTracks::read_head`], which stores the fields before the zstd frame, then
/// [`BoundedTracks::read_mask`], which stores the number of moving tracks.
#[derive(Debug, Default)]
pub(crate) struct BoundedTracks {
    /// Quantization steps: first of static tracks (components of a Gaussian whose values in all frames are stored as
    /// one number), then of all other tracks.
    steps: [f64; 2],
    exceptions: Vec<(u32, u32)>,
    plane: usize,
    frames: usize,
    /// Number of moving tracks: components of a Gaussian whose values in the frames of the tile are not all stored as
    /// one number.
    moving: usize,
}

impl BoundedTracks {
    /// Reads the fields at the start of `stored`, the stored bytes of a tile of `frames` frames with `plane` values
    /// each. Returns the bytes of the zstd frame that follows these fields. `max_error` is the error bound of the tile.
    ///
    /// # Errors
    /// Fails if the tile is malformed; the error says what was found instead of a valid tile.
    pub(crate) fn read_head<'a>(
        &mut self,
        stored: &'a [u8],
        frames: usize,
        plane: usize,
        max_error: f64,
    ) -> Result<&'a [u8], String> {
        let short = || format!("{} stored bytes", stored.len());
        let (head, rest) = stored.split_first_chunk::<HEAD_BYTES>().ok_or_else(short)?;
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
        (self.steps, self.plane, self.frames) = ([static_step(step, halvings), step], plane, frames);
        Ok(packed)
    }

    /// Returns the maximum number of bytes that the tile's zstd frame may decompress to.
    pub(crate) fn max_decompressed_bytes(&self) -> usize {
        self.mask_bytes() + 4 * self.frames * self.plane
    }

    /// Reads the mask at the start of `bytes`, the decompressed bytes of the tile. The mask has one bit per track,
    /// which is set if the track changes in the tile (is moving). Stores the number of moving tracks, and checks the
    /// length of `bytes`. An error says what was found instead of a valid tile.
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

    /// Returns for each track its value in the first frame, as a zigzag-coded multiple of the quantization step.
    /// `bytes` are the decompressed bytes of the tile.
    pub(crate) fn first_frame<'a>(&self, bytes: &'a [u8]) -> impl Iterator<Item = u32> + 'a {
        let (from, plane) = (self.mask_bytes(), self.plane);
        (0..plane).map(move |track| shuffled_value(&bytes[from..], plane, track))
    }

    /// Returns for each moving track (component of a Gaussian that changes in the tile) its index and its zigzag-coded
    /// prediction error at frame `frame`, which must not be the first. `bytes` are the decompressed bytes of the tile.
    pub(crate) fn residuals<'a>(&self, bytes: &'a [u8], frame: usize) -> impl Iterator<Item = (usize, u32)> + 'a {
        let from = self.mask_bytes() + 4 * self.plane;
        let (after_first, values) = (self.frames - 1, self.moving * (self.frames - 1));
        let moving = (0..self.plane).filter(|&track| moves(bytes, track)).enumerate();
        moving.map(move |(nth, track)| (track, shuffled_value(&bytes[from..], values, nth * after_first + frame - 1)))
    }

    /// Writes the f32 values of frame `frame`, as bits, to `out`, one per track. `multiples` holds the quantized value
    /// of each track in this frame, in quantization steps; `bytes` are the decompressed bytes of the tile.
    pub(crate) fn values(&self, bytes: &[u8], frame: usize, multiples: &[u32], out: &mut [u32]) {
        for (track, (out, &multiple)) in out.iter_mut().zip(multiples).enumerate() {
            *out = value(multiple, self.steps[usize::from(moves(bytes, track))]);
        }
        // Returns the number of exceptions in the frames before `frame`.
        let before =
            |frame: usize| self.exceptions.partition_point(|&(place, _)| (place as usize) < frame * self.plane);
        for &(place, bits) in &self.exceptions[before(frame)..before(frame + 1)] {
            out[place as usize - frame * self.plane] = bits;
        }
    }

    /// Returns the bytes of heap memory that the list of exceptions takes.
    pub(crate) fn memory(&self) -> usize {
        size_of::<(u32, u32)>() * self.exceptions.capacity()
    }

    /// Returns the length in bytes of the mask, which has one bit per track.
    fn mask_bytes(&self) -> usize {
        self.plane.div_ceil(8)
    }
}

/// Returns whether track `track` changes in the tile, according to the mask at the start of `bytes`, which has one bit
/// per track.
fn moves(bytes: &[u8], track: usize) -> bool {
    bytes[track / 8] >> (track % 8) & 1 != 0
}

/// Returns the value at index `place` of an array of `values` u32 stored as shuffled bytes: first the lowest bytes of
/// all values, last their highest bytes.
fn shuffled_value(bytes: &[u8], values: usize, place: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|weight| bytes[weight * values + place]))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use zstd::bulk::Decompressor;

    use super::*;
    use crate::codec::{Encoding, StoredTile, TileDecoder};

    fn decoded(tile: &BoundedTile, frames: usize, plane: usize, max_error: f64) -> Result<Vec<f32>, String> {
        let stored_frames = if tile.constant { 1 } else { frames };
        let encoding = Encoding::Bounded { order: tile.order };
        let stored = StoredTile { bytes: &tile.bytes, encoding, frames: stored_frames, plane, max_error };
        let mut decoder = TileDecoder::default();
        decoder.load(stored, &mut Decompressor::new().unwrap())?;
        let mut out = vec![0u32; plane];
        let mut values = Vec::new();
        for frame in 0..frames {
            decoder.frame(if tile.constant { 0 } else { frame }, &mut out);
            values.extend(out.iter().map(|&bits| f32::from_bits(bits)));
        }
        Ok(values)
    }

    /// Generates tiles, as (number of frames, number of values per frame, values of one frame after the other). Their
    /// tracks (components of a Gaussian over the frames) are constant, drift, jitter or jump; some tracks have one
    /// value of arbitrary bits.
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
        fn values_are_within_the_bound((frames, plane, values) in tiles(), max_error in 1e-6f64..0.5) {
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
        fn frames_decode_in_any_order(
            (frames, plane, values) in tiles(), asked in prop::collection::vec(0usize..9, 1..12),
        ) {
            let Some(tile) = encode(&values, plane, 1e-3, 1).unwrap().filter(|tile| !tile.constant) else { return Ok(()) };
            let expected = decoded(&tile, frames, plane, 1e-3).unwrap();
            let encoding = Encoding::Bounded { order: tile.order };
            let mut decoder = TileDecoder::default();
            let stored = StoredTile { bytes: &tile.bytes, encoding, frames, plane, max_error: 1e-3 };
            decoder.load(stored, &mut Decompressor::new().unwrap()).unwrap();
            let mut out = vec![0u32; plane];
            for frame in asked.into_iter().map(|frame| frame % frames) {
                decoder.frame(frame, &mut out);
                let same = out.iter().copied().eq(expected[frame * plane..][..plane].iter().map(|value| value.to_bits()));
                prop_assert!(same, "frame {}", frame);
            }
        }
    }

    #[test]
    fn drift_within_the_bound_is_static() {
        let values: Vec<f32> = (0..32 * 256).map(|i| (i % 256) as f32 + 1e-5 * (i / 256) as f32).collect();
        let tile = encode(&values, 256, 1e-3, 1).unwrap().unwrap();
        assert!(tile.constant);
        let moved: Vec<f32> = values.iter().map(|&value| if value < 1.0 { 90.0 * value } else { value }).collect();
        let tile = encode(&moved, 256, 1e-3, 1).unwrap().unwrap();
        assert!(!tile.constant);
        assert!(tile.bytes.len() < 700, "{} bytes for 255 static tracks", tile.bytes.len());
    }

    #[test]
    fn encoding_without_gain_returns_none() {
        assert!(encode(&[1.0], 1, 1e-3, 1).unwrap().is_none(), "one value");
        let odd: Vec<f32> = (0..640).map(|i| if i % 15 == 0 { f32::NAN } else { 1.0 }).collect();
        assert!(encode(&odd, 64, 1e-3, 1).unwrap().is_none(), "too many exceptions");
        // The distance between neighboring f32 values of this size exceeds the error bound.
        let far: Vec<f32> = (0..640).map(|i| 3e7 + 8.0 * i as f32).collect();
        assert!(encode(&far, 64, 1e-3, 1).unwrap().is_none(), "no multiple is near");
    }

    /// Checks that lossy tiles with forged bytes are refused, and that no flipped bit causes a panic.
    #[test]
    fn forged_bytes_are_refused() {
        let values: Vec<f32> = (0..8 * 64).map(|i| (i as f32 * 0.37).sin()).collect();
        let values: Vec<f32> =
            values.into_iter().enumerate().map(|(i, v)| if i == 70 { f32::NAN } else { v }).collect();
        let good = encode(&values, 64, 1e-3, 1).unwrap().unwrap();
        decoded(&good, 8, 64, 1e-3).unwrap();
        let with = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = good.bytes.clone();
            change(&mut bytes);
            decoded(&BoundedTile { bytes, ..good }, 8, 64, 1e-3)
        };
        let body = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut body = zstd::bulk::decompress(&good.bytes[HEAD_BYTES + 8..], 1 << 16).unwrap();
            change(&mut body);
            with(&|bytes| bytes.splice(HEAD_BYTES + 8.., zstd::bulk::compress(&body, 1).unwrap()).for_each(drop))
        };
        body(&|_| ()).unwrap();
        let cases: [(&str, Result<Vec<f32>, String>); 12] = [
            ("a step above twice the bound", with(&|bytes| bytes[..8].copy_from_slice(&2.1e-3f64.to_le_bytes()))),
            ("no step", with(&|bytes| bytes[..8].copy_from_slice(&f64::NAN.to_le_bytes()))),
            ("a step of 0", with(&|bytes| bytes[..8].fill(0))),
            ("absurdly many exceptions", with(&|bytes| bytes[8..12].fill(255))),
            ("more exceptions than there are", with(&|bytes| bytes[8] = 2)),
            ("two halvings", with(&|bytes| bytes[12] = 2)),
            ("an exception beyond the tile", with(&|bytes| bytes[HEAD_BYTES + 1] = 255)),
            ("a cut head", with(&|bytes| bytes.truncate(HEAD_BYTES - 1))),
            ("a cut frame", with(&|bytes| bytes.truncate(HEAD_BYTES + 20))),
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
