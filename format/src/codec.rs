//! Encodes tiles (values of one column for a block of Gaussians and frames) to stored bytes and decodes them, in
//! memory.
//!
//! The lossless filter maps the bits of every value to an integer in numeric order, predicts this integer from one or
//! two earlier frames, and replaces the value by the zigzag-coded difference. Then the lowest bytes of all values are
//! stored together, the next bytes together, and so on (shuffle), and are compressed by zstd. All arithmetic wraps, so
//! every bit pattern is restored exactly.
//!
//! The table shows stored bytes in percent of the raw bytes, for tiles of 32 frames of three trained models and zstd
//! level 1, by the filter before zstd. The order is the number of earlier frames that predict a value (`cargo bench
//! --bench filters` of the program prints the table by model, with the times of encoding and decoding):
//!
//! | column | no filter | shuffle | order 1 + shuffle | order 2 + shuffle | order 2 |
//! |---|---|---|---|---|---|
//! | position | 92–93 | 63–74 | 52–57 | 48–52 | 58–62 |
//! | rotation | 93 | 67–71 | 56–61 | 52–57 | 63–67 |
//! | log_scale | 84–86 | 53–56 | 41–45 | 37–41 | 48–52 |
//! | opacity_logit (one model) | 92 | 60 | 50 | 47 | 55 |
//! | sh (one model) | 93 | 73 | 61 | 59 | 69 |
//!
//! With zstd level 3, "order 2 + shuffle" differs by at most 0.2 percentage points. Compression factors of positions
//! over 60 frames: order 2 with zigzag and shuffle 1.93–2.14; XOR with the previous frame 1.65–1.87; order 3 1.86–2.02;
//! order 2 without zigzag 1.69–1.86. Transposing to [component][gaussian][frame] gained 1%.

use std::fmt;

use xxhash_rust::xxh3::xxh3_64;
use zstd::bulk::Decompressor;

use crate::bounded::{self, BoundedTracks};
use crate::error::{Error, Result};
use crate::layout::MAX_TILE_BYTES;

/// Storage method of the values of a tile (one column for a block of Gaussians and frames), chosen by the caller of
/// [`encode_tile`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Compression {
    /// Raw: plain f32 values, which readers use in place from the memory map.
    Raw,
    /// Lossless: the values are replaced by differences from a prediction (the filter), which zstd compresses at this
    /// level. A tile that does not become smaller is stored raw.
    Zstd(i32),
    /// Lossy: values differ from the original ones by at most `max_error`, and zstd compresses them at `level`. A tile
    /// that does not become smaller this way, or has too many values that cannot be stored within the bound, is stored
    /// like [`Compression::Zstd`].
    Bounded {
        /// Maximum absolute error of a value, above 0; see [`crate::ColumnSpec::max_error`].
        max_error: f64,
        /// Compression level of zstd for the lossy tile.
        level: i32,
    },
}

/// Encoding of the values of a tile in its stored bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// Raw: little-endian f32.
    Raw,
    /// Lossless: each value is stored as its difference from a prediction. The bytes of the differences are grouped by
    /// significance and compressed by zstd.
    Filtered {
        /// Number of earlier frames from which a value is predicted: 0, 1 or 2.
        order: u8,
    },
    /// Lossy: each value is rounded to an integer multiple of a quantization step, which is stored as its difference
    /// from a prediction. The bytes of the differences are grouped by significance and compressed by zstd.
    Bounded {
        /// Number of earlier frames from which the multiple of the quantization step is predicted: 1 or 2.
        order: u8,
    },
}

impl fmt::Display for Encoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Encoding::Raw => write!(f, "as it is"),
            Encoding::Filtered { order } => write!(f, "predicted, order {order}"),
            Encoding::Bounded { order } => write!(f, "within a bound, order {order}"),
        }
    }
}

/// Statistics of the stored values of a tile. A constant tile, whose frames are all equal, stores one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileStats {
    /// Smallest finite value, with −0 counted as +0; +∞ if no value is finite.
    pub min: f32,
    /// Largest finite value, with −0 counted as +0; −∞ if no value is finite.
    pub max: f32,
    /// Number of values that are NaN or infinite.
    pub non_finite: u32,
}

impl fmt::Display for TileStats {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let TileStats { min, max, non_finite } = self;
        write!(f, "values from {min} to {max}, {non_finite} of them not finite")
    }
}

/// Encoded tile, to be passed to [`crate::Writer::write_tile`].
#[derive(Debug, Clone, PartialEq)]
pub struct EncodedTile {
    pub(crate) frames: u32,
    pub(crate) width: u32,
    pub(crate) len: u32,
    pub(crate) constant: bool,
    pub(crate) encoding: Encoding,
    /// Maximum absolute error of the decoded values; 0 if they are exact.
    pub(crate) max_error: f64,
    pub(crate) stats: TileStats,
    pub(crate) checksum: u64,
    pub(crate) bytes: Vec<u8>,
}

impl EncodedTile {
    /// Returns the number of bytes that the tile takes in the file, without its 64-byte record header.
    pub fn stored_bytes(&self) -> usize {
        self.bytes.len()
    }

    /// Returns whether all frames have the same bits. Then only one frame is stored, and the tile may be written to
    /// frame blocks of any length.
    pub fn is_constant(&self) -> bool {
        self.constant
    }

    /// Returns minimum, maximum and number of non-finite values of the tile.
    pub fn stats(&self) -> TileStats {
        self.stats
    }
}

/// Encodes `values`, laid out as `[frames][width][len]`: `width` components of `len` Gaussians at `frames` frames.
///
/// The result depends on the arguments only; any number of threads may encode at a time. Memory: about twice the size
/// of `values` while it runs, three times with an error bound. If all frames have the same bits, one frame is stored.
/// To encode a column that never changes, pass its one frame with `frames` = 1 and write the result to every frame
/// block.
///
/// Fails if `values` is empty, has another shape or is larger than [`MAX_TILE_BYTES`], if zstd does not have this
/// level, or if the error bound is not legal.
pub fn encode_tile(values: &[f32], frames: u32, width: u32, len: u32, compression: Compression) -> Result<EncodedTile> {
    let count = [frames, width, len].into_iter().try_fold(1u64, |product, n| product.checked_mul(n.into()));
    if values.is_empty() || count != Some(values.len() as u64) || 4 * values.len() as u64 > MAX_TILE_BYTES {
        return Err(Error::usage(format!(
            "a tile of {frames} frames × {width} components × {len} Gaussians must have as many values, at least one \
             and at most {}, not {}",
            MAX_TILE_BYTES / 4,
            values.len()
        )));
    }
    let plane = width as usize * len as usize;
    let failed = |level: i32, error: std::io::Error| Error::usage(format!("zstd level {level} failed: {error}"));
    if let Compression::Bounded { level, .. } | Compression::Zstd(level) = compression {
        let range = zstd::compression_level_range();
        if !range.contains(&level) {
            let message = format!("zstd levels go from {} to {}, not {level}", range.start(), range.end());
            return Err(Error::usage(message));
        }
    }
    let compression = match compression {
        Compression::Bounded { max_error, level } => {
            if !bounded::BOUNDS.contains(&max_error) {
                return Err(Error::usage(format!("a bound is a normal f32 above 0, not {max_error}")));
            }
            let found = bounded::encode(values, plane, max_error, level).map_err(|error| failed(level, error))?;
            if let Some(bounded::BoundedTile { order, constant, stats, bytes }) = found {
                let (encoding, checksum) = (Encoding::Bounded { order }, xxh3_64(&bytes));
                return Ok(EncodedTile { frames, width, len, constant, encoding, max_error, stats, checksum, bytes });
            }
            Compression::Zstd(level)
        }
        exact => exact,
    };
    let bits: &[u32] = bytemuck::cast_slice(values);
    let (first, rest) = bits.split_at(plane);
    let constant = rest.chunks_exact(plane).all(|frame| frame == first);
    let bits = if constant { first } else { bits };
    let (encoding, bytes) = match compression {
        Compression::Zstd(level) => {
            let order = best_order(bits, plane);
            let shuffled = filter(bits, plane, order);
            match zstd::bulk::compress(&shuffled, level) {
                Ok(bytes) if bytes.len() < shuffled.len() => (Encoding::Filtered { order }, bytes),
                Ok(_) => (Encoding::Raw, raw_bytes(bits)),
                Err(error) => return Err(failed(level, error)),
            }
        }
        _ => (Encoding::Raw, raw_bytes(bits)),
    };
    let checksum = xxh3_64(&bytes);
    Ok(EncodedTile { frames, width, len, constant, encoding, max_error: 0.0, stats: stats(bits), checksum, bytes })
}

/// Decoder of one tile that is stored in the lossless or the lossy encoding. Decodes the tile frame by frame.
///
/// Memory of a lossless tile: 4 bytes per value of the tile, and two decoded frames. A lossy tile takes in addition 1/8
/// byte per value of one frame for the mask of moving tracks, and up to 1/2 byte per value of the tile for exceptions
/// (if every 16th value is one). A decoder that has loaded no tile takes no memory.
#[derive(Debug, Default)]
pub(crate) struct TileDecoder {
    order: u8,
    /// Decompressed bytes of the tile: in the lossless encoding the lowest bytes of all values, then the next bytes,
    /// and so on; in the lossy encoding as SPEC.md describes under "Bounded".
    shuffled: Vec<u8>,
    /// Values of the last decoded frame (the frame before `next`), and of the frame before that: as [`ordered`]
    /// integers in the lossless encoding, as multiples of the quantization step in the lossy one.
    recent: [Vec<u32>; 2],
    next: usize,
    bounded: bool,
    tracks: BoundedTracks,
}

/// Stored bytes of a tile, and the parameters needed to decode them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct StoredTile<'a> {
    pub(crate) bytes: &'a [u8],
    pub(crate) encoding: Encoding,
    pub(crate) frames: usize,
    /// Number of values per frame.
    pub(crate) plane: usize,
    /// Maximum absolute error of the values of the tile; 0 if they are exact.
    pub(crate) max_error: f64,
}

impl TileDecoder {
    /// Decompresses a tile that is not stored raw, so that [`TileDecoder::frame`] can decode its frames. Fails if the
    /// tile is stored raw or is malformed; the error describes the data that was found where valid values were
    /// expected.
    pub(crate) fn load(
        &mut self,
        stored: StoredTile<'_>,
        zstd: &mut Decompressor<'_>,
    ) -> std::result::Result<(), String> {
        let StoredTile { bytes, encoding, frames, plane, max_error } = stored;
        self.next = 0;
        self.recent.iter_mut().for_each(|frame| frame.resize(plane, 0));
        self.bounded = matches!(encoding, Encoding::Bounded { .. });
        let (packed, max_bytes) = match encoding {
            Encoding::Bounded { order } => {
                self.order = order;
                let packed = self.tracks.read_head(bytes, frames, plane, max_error)?;
                (packed, self.tracks.max_decompressed_bytes())
            }
            Encoding::Filtered { order } => {
                self.order = order;
                (bytes, 4 * frames * plane)
            }
            Encoding::Raw => return Err("raw values".to_owned()),
        };
        self.shuffled.resize(max_bytes, 0);
        // The buffer has a fixed size, so a zstd frame that decompresses to more bytes is refused, whatever size it
        // declares.
        match zstd.decompress_to_buffer(packed, self.shuffled.as_mut_slice()) {
            Ok(len) if self.bounded => self.tracks.read_mask(&self.shuffled[..len]),
            Ok(len) if len == max_bytes => Ok(()),
            Ok(len) => Err(format!("{len} bytes after decompression")),
            Err(error) => Err(format!("a zstd frame that does not decompress to them ({error})")),
        }
    }

    /// Decodes frame `frame` into `out`, which has one element for each value of a frame. A frame that is predicted
    /// from earlier frames needs all earlier frames. Decoding therefore continues after the last decoded frame if
    /// `frame` is later, and otherwise starts again at the first frame. With prediction order 0 only `frame` itself is
    /// decoded.
    pub(crate) fn frame(&mut self, frame: usize, out: &mut [u32]) {
        if self.order == 0 || frame < self.next {
            self.next = if self.order == 0 { frame } else { 0 };
        }
        while self.next <= frame {
            if self.bounded {
                self.step_multiples();
            } else {
                self.step(out);
            }
            self.next += 1;
        }
        if self.bounded {
            self.tracks.values(&self.shuffled, frame, &self.recent[0], out);
        }
    }

    /// Returns the bytes of memory that the decoder takes.
    pub(crate) fn memory(&self) -> usize {
        let [a, b] = &self.recent;
        self.shuffled.capacity() + 4 * (a.capacity() + b.capacity()) + self.tracks.memory()
    }

    /// Decodes the next frame of a tile in the lossless encoding. Writes the bits of its f32 values to `out`.
    fn step(&mut self, out: &mut [u32]) {
        let plane = out.len();
        let [b0, b1, b2, b3]: [&[u8]; 4] = std::array::from_fn(|weight| {
            &self.shuffled[weight * (self.shuffled.len() / 4) + self.next * plane..][..plane]
        });
        let stored = |i: usize| u32::from_le_bytes([b0[i], b1[i], b2[i], b3[i]]);
        let [before, second_before] = &mut self.recent;
        let (before, second_before) = (&mut before[..plane], &mut second_before[..plane]);
        match order_at(self.order, self.next) {
            0 => {
                for i in 0..plane {
                    out[i] = stored(i);
                    before[i] = ordered(out[i]);
                }
            }
            1 => {
                for i in 0..plane {
                    let rank = unzigzag(stored(i)).wrapping_add(before[i]);
                    second_before[i] = before[i];
                    before[i] = rank;
                    out[i] = unordered(rank);
                }
            }
            _ => {
                for i in 0..plane {
                    let rank = unzigzag(stored(i)).wrapping_add(predict(2, before[i], second_before[i]));
                    // This value becomes that of the previous frame by the swap below.
                    second_before[i] = rank;
                    out[i] = unordered(rank);
                }
                self.recent.swap(0, 1);
            }
        }
    }

    /// Decodes the next frame of a tile in the lossy encoding into `recent[0]`, as multiples of the quantization step.
    /// Values that are the same in all frames are stored once and are decoded at the first frame only.
    fn step_multiples(&mut self) {
        let [before, second_before] = &mut self.recent;
        if self.next == 0 {
            self.tracks
                .first_frame(&self.shuffled)
                .zip(&mut *before)
                .for_each(|(first, before)| *before = unzigzag(first));
            return;
        }
        let order = order_at(self.order, self.next);
        for (track, residual) in self.tracks.residuals(&self.shuffled, self.next) {
            let multiple = unzigzag(residual).wrapping_add(predict(order, before[track], second_before[track]));
            second_before[track] = std::mem::replace(&mut before[track], multiple);
        }
    }
}

/// Returns the values `bits` as little-endian bytes.
fn raw_bytes(bits: &[u32]) -> Vec<u8> {
    bits.iter().flat_map(|bits| bits.to_le_bytes()).collect()
}

/// Appends the bytes of `values` to `out` in shuffled order: the lowest bytes of all values first, their highest bytes
/// last.
pub(crate) fn shuffle_into(values: &[u32], out: &mut Vec<u8>) {
    for weight in 0..4 {
        out.extend(values.iter().map(|value| (value >> (8 * weight)) as u8));
    }
}

/// Maps the bits of an f32 to an integer. Larger f32 values give larger integers, and different bits give different
/// integers.
fn ordered(bits: u32) -> u32 {
    bits ^ (((bits as i32) >> 31) as u32 | 0x8000_0000)
}

/// Maps an integer back to the bits of an f32; the inverse of [`ordered`].
fn unordered(rank: u32) -> u32 {
    rank ^ (!((rank as i32) >> 31) as u32 | 0x8000_0000)
}

/// Returns the zigzag code of a signed difference: 0, −1, 1, −2, 2, … become 0, 1, 2, 3, 4, …. The high bytes of the
/// code are zero if the absolute difference is small.
pub(crate) fn zigzag(difference: u32) -> u32 {
    (difference << 1) ^ ((difference as i32) >> 31) as u32
}

/// Maps a zigzag code back to a signed difference; the inverse of [`zigzag`].
fn unzigzag(code: u32) -> u32 {
    (code >> 1) ^ (code & 1).wrapping_neg()
}

/// Predicts a value from its values `before` and `second_before` in the two frames before: order 1 repeats `before`,
/// order 2 continues the line through both. Values are [`ordered`] integers, or multiples of the quantization step.
pub(crate) fn predict(order: u8, before: u32, second_before: u32) -> u32 {
    match order {
        1 => before,
        _ => before.wrapping_mul(2).wrapping_sub(second_before),
    }
}

/// Returns the number of earlier frames that predict frame `frame`: `order`, or fewer for the first frames.
pub(crate) fn order_at(order: u8, frame: usize) -> u8 {
    order.min(frame.min(2) as u8)
}

/// Returns the order of prediction (number of earlier frames that predict a value) with which the differences from the
/// prediction take fewer bits: 1 or 2. Returns 1 for two frames, and 0 for a single frame.
///
/// Compares only every fourth value: comparing all would take as long as the filter itself. If the results are close,
/// either order is good.
fn best_order(bits: &[u32], plane: usize) -> u8 {
    let frames = bits.len() / plane;
    if frames < 3 {
        return (frames - 1) as u8;
    }
    let cost = |order: u8| -> u64 {
        let mut bits_needed = 0;
        for frame in 2..frames {
            let at = |back: usize| &bits[(frame - back) * plane..][..plane];
            for i in (0..plane).step_by(4) {
                let predicted = predict(order, ordered(at(1)[i]), ordered(at(2)[i]));
                let residual = ordered(at(0)[i]).wrapping_sub(predicted);
                bits_needed += u64::from(32 - zigzag(residual).leading_zeros());
            }
        }
        bits_needed
    };
    if cost(1) < cost(2) { 1 } else { 2 }
}

/// Applies the lossless filter to values given as bits, in frames of `plane` values. `order` is the number of earlier
/// frames that predict a value. Returns the differences from the prediction as bytes in shuffled order: the lowest
/// bytes of all differences first, their highest bytes last.
fn filter(bits: &[u32], plane: usize, order: u8) -> Vec<u8> {
    let mut out = vec![0; 4 * bits.len()];
    let (low, high) = out.split_at_mut(2 * bits.len());
    let (b0, b1) = low.split_at_mut(bits.len());
    let (b2, b3) = high.split_at_mut(bits.len());
    let mut residuals = vec![0; plane];
    for frame in 0..bits.len() / plane {
        let at = |back: usize| &bits[(frame - back) * plane..][..plane];
        match order_at(order, frame) {
            0 => residuals.copy_from_slice(at(0)),
            order => {
                let (now, before, second_before) = (at(0), at(1), at(order.into()));
                for (i, residual) in residuals.iter_mut().enumerate() {
                    let predicted = predict(order, ordered(before[i]), ordered(second_before[i]));
                    *residual = zigzag(ordered(now[i]).wrapping_sub(predicted));
                }
            }
        }
        for (weight, bytes) in [&mut *b0, &mut *b1, &mut *b2, &mut *b3].into_iter().enumerate() {
            for (byte, residual) in bytes[frame * plane..][..plane].iter_mut().zip(&residuals) {
                *byte = (residual >> (8 * weight)) as u8;
            }
        }
    }
    out
}

/// Computes the [`TileStats`] of values given as bits. Minimum and maximum are found by comparing [`ordered`] integers
/// instead of floats, so the compiler can vectorize the loop and the order of the values does not matter.
pub(crate) fn stats(bits: &[u32]) -> TileStats {
    const EXPONENT: u32 = 0x7f80_0000;
    let (mut min, mut max, mut non_finite) = (u32::MAX, 0, 0u32);
    for &bits in bits {
        let finite = bits & EXPONENT != EXPONENT;
        let rank = ordered(bits);
        min = min.min(if finite { rank } else { u32::MAX });
        max = max.max(if finite { rank } else { 0 });
        non_finite += u32::from(!finite);
    }
    if non_finite as usize == bits.len() {
        return TileStats { min: f32::INFINITY, max: f32::NEG_INFINITY, non_finite };
    }
    // Adding +0 turns −0 into +0 and leaves every other value as it is.
    TileStats { min: f32::from_bits(unordered(min)) + 0.0, max: f32::from_bits(unordered(max)) + 0.0, non_finite }
}

#[cfg(test)]
mod tests;
