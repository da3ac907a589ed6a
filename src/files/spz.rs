//! Writes `.spz` files of versions 3 and 4 and reads those of versions 2, 3 and 4. A file holds one frame of Gaussians
//! (nianticlabs/spz, `load-spz.cc`).
//!
//! | array | bytes per Gaussian | value |
//! |---|---|---|
//! | positions | 9 | 24-bit signed, in units of 2^−(fractional bits); axes right, up, back |
//! | opacities | 1 | 255·α |
//! | colors | 3 | 255·(.15·f_dc + ½) |
//! | scales | 3 | 16·(ln s + 10) |
//! | rotations | 4 | 2 bits: index of the largest of x, y, z, w; then sign and 9 bits of 511·√2·value each |
//! | SH coefficients | 3·((d + 1)² − 1) | 128·c + 128, rounded to 5 bits in degree 1 and to 4 bits above |
//!
//! Versions 2 and 3 are a header of 16 bytes and the arrays one after the other, all compressed by gzip. Version 4 is a
//! header of 32 bytes, a table of the compressed and the original size of each array (u64 each), and each array as a
//! zstd frame. Arrays of 0 bytes are left out.
//!
//! The maintained crate for this format is not used, because it depends on an asynchronous runtime.

pub mod read;

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use flate2::{Compression, GzBuilder};

use super::accuracy::{CodingErrors, RenderedAttributes, check_positions};
use crate::error::{Error, Result, ShowPath};
use crate::model::{Gaussians, color_from_sh, opacity};

/// First 32-bit word of an `.spz` file, "NGSP". In versions 2 and 3, which are gzip files, it is the first word after
/// decompression.
pub const MAGIC: u32 = 0x5053_474e;
/// Number of bytes of the header of an `.spz` file of version 4.
const HEADER_BYTES_4: usize = 32;
/// gzip compression level of `.spz` files of version 3. On trained models higher levels save less than 0.1% of the
/// bytes, and on repetitive ones they take up to ten times as long.
const GZIP_LEVEL: u32 = 4;
/// zstd compression level of `.spz` files of version 4. Level 12 would make files of trained models between 0.3% smaller
/// and 1% larger.
const ZSTD_LEVEL: i32 = 3;
/// Largest magnitude of a coordinate as it is stored: a 24-bit signed integer, in units of 2^−(fractional bits) scene
/// units.
const MAX_FIXED: f64 = 8_388_607.0;
/// Maximum number n of fractional bits of positions, which are stored in units of 2⁻ⁿ scene units. More bits would only
/// store rounding noise of f32.
const MAX_FRACTION_BITS: i32 = 20;
/// Sign by which each SH coefficient above degree 0 is multiplied when the y and z axes are reversed.
const AXIS_SIGNS: [f32; 15] = [-1., -1., 1., -1., 1., 1., -1., 1., -1., 1., -1., -1., 1., -1., 1.];

/// Version of the `.spz` format in which a file is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpzVersion {
    /// Version 3, gzip: read by most players.
    V3,
    /// Version 4, zstd: the only one that the PlayCanvas engine reads.
    V4,
}

/// Errors of the values that an `.spz` file stores.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpzErrors {
    /// Largest difference between a stored and an original coordinate of a position, in scene units.
    pub position: f64,
    /// Number of Gaussians with a scale that is stored much too small. A scale counts as such if both conditions hold:
    /// - The scale is above the maximum that the format can store. The file then stores this maximum.
    /// - The maximum is smaller than the scale by more than 1/10 of the scale.
    ///
    /// Such a scale is allowed if the maximum is still at least ten times the distance from the Gaussian to the far
    /// side of the scene. Otherwise [`write_spz`] fails.
    pub reduced_scales: usize,
}

impl SpzErrors {
    /// Returns notes for the user: the largest position error, and the number of Gaussians with a reduced scale, if
    /// any.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = vec![format!("maximum position error: {:.2e} scene units", self.position)];
        if self.reduced_scales > 0 {
            notes.push(format!(
                "Gaussians much larger than the scene: {}; stored with the largest scale of a .spz, {:.0} scene units",
                self.reduced_scales,
                scale_of_byte(u8::MAX)
            ));
        }
        notes
    }
}

/// Writes the Gaussians `state` to an `.spz` file of the version `version` at `path`. Returns the errors of the stored
/// values.
///
/// # Errors
/// Fails if a position is not finite, if stored values would exceed the error bounds of [`accuracy`](super::accuracy),
/// if there are more Gaussians than the format can count, or if writing fails.
pub fn write_spz(state: &Gaussians, version: SpzVersion, path: &Path) -> Result<SpzErrors> {
    let furthest = state.position.planes().iter().fold(0.0f64, |most, x| most.max(f64::from(x.abs())));
    check_positions(state, path, "a .spz")?;
    let count = u32::try_from(state.len())
        .map_err(|_| Error::usage(format!("{}: {} Gaussians are too many for a .spz", path.shown(), state.len())))?;
    let bits = (MAX_FIXED / furthest.max(1e-9)).log2().floor().clamp(0.0, f64::from(MAX_FRACTION_BITS)) as i32;
    let unit = 0.5f64.powi(bits);
    let errors = check_accuracy(state, unit)?;
    let file = BufWriter::new(File::create(path).map_err(Error::io("create", path))?);
    let head = |version: u32, streams: usize| {
        let words: Vec<u8> = [MAGIC, version, count].into_iter().flat_map(u32::to_le_bytes).collect();
        [&words[..], &[state.sh_degree() as u8, bits as u8, 0, streams as u8]].concat()
    };
    let write = || match version {
        SpzVersion::V3 => write_gzip(&head(3, 0), state, unit, file),
        SpzVersion::V4 => write_streams(&head, state, unit, file),
    };
    write().map_err(Error::io("write", path))?;
    Ok(errors)
}

/// Writes an `.spz` file of version 3 to `file`: the header `head` and the arrays of the Gaussians `state`, all
/// compressed together by gzip. `unit` is the unit in which positions are stored, in scene units.
fn write_gzip(head: &[u8], state: &Gaussians, unit: f64, file: impl Write) -> std::io::Result<()> {
    // Write no time stamp and no name into the gzip header, so that the same scene gives the same bytes.
    let compressed = GzBuilder::new().write(file, Compression::new(GZIP_LEVEL));
    // The arrays are written in pieces of a few bytes, and each call of the compressor takes time.
    let mut out = BufWriter::with_capacity(1 << 16, compressed);
    out.write_all(head)?;
    ARRAYS.iter().try_for_each(|write| write(state, unit, &mut out))?;
    let mut compressed = out.into_inner().map_err(std::io::IntoInnerError::into_error)?;
    compressed.try_finish()?;
    compressed.get_mut().flush()
}

/// Writes an `.spz` file of version 4 to `file`: the header, the table of sizes, and each array of the Gaussians
/// `state` as a zstd frame. `head` receives the version and the number of arrays, and returns the first 16 bytes of the
/// header. `unit` is the unit in which positions are stored, in scene units.
fn write_streams(
    head: &dyn Fn(u32, usize) -> Vec<u8>,
    state: &Gaussians,
    unit: f64,
    mut file: impl Write,
) -> std::io::Result<()> {
    let (mut table, mut frames) = (Vec::new(), Vec::new());
    for write in ARRAYS {
        let mut array = Vec::new();
        write(state, unit, &mut array)?;
        if !array.is_empty() {
            let frame = zstd::bulk::compress(&array, ZSTD_LEVEL)?;
            table.extend([frame.len() as u64, array.len() as u64].into_iter().flat_map(u64::to_le_bytes));
            frames.push(frame);
        }
    }
    let mut header = head(4, frames.len());
    header.extend((HEADER_BYTES_4 as u32).to_le_bytes());
    header.resize(HEADER_BYTES_4, 0);
    file.write_all(&header)?;
    file.write_all(&table)?;
    frames.iter().try_for_each(|frame| file.write_all(frame))?;
    file.flush()
}

/// Function that writes one array of an `.spz` file, such as the positions of all Gaussians. The arguments are the
/// Gaussians, the unit in which positions are stored (in scene units), and the output.
type WriteArray = fn(&Gaussians, f64, &mut dyn Write) -> std::io::Result<()>;

/// Functions that write the arrays of an `.spz` file, in the order of the file.
const ARRAYS: [WriteArray; 6] = [
    |state, unit, out| {
        (0..state.len()).try_for_each(|row| {
            let [x, y, z] = state.position_f64(row);
            [x, -y, -z].into_iter().try_for_each(|value| out.write_all(&fixed(value, unit).to_le_bytes()[..3]))
        })
    },
    |state, _, out| {
        let bytes = state.opacity_logit.plane(0).iter().map(|&logit| opacity_byte(logit));
        bytes.into_iter().try_for_each(|byte| out.write_all(&[byte]))
    },
    |state, _, out| (0..state.len()).try_for_each(|row| out.write_all(&state.sh.row::<3>(row).map(color_byte))),
    |state, _, out| (0..state.len()).try_for_each(|row| out.write_all(&state.log_scale.row::<3>(row).map(scale_byte))),
    |state, _, out| {
        (0..state.len()).try_for_each(|row| {
            let q = state.rotation_f64(row);
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            let [w, x, y, z] = if length > 0.0 { q.map(|x| x / length) } else { [1.0, 0.0, 0.0, 0.0] };
            out.write_all(&smallest_three([x, -y, -z, w]).to_le_bytes())
        })
    },
    write_sh,
];

/// Writes the SH coefficients above degree 0 of the Gaussians `state` to `out`, one Gaussian after another, each with all
/// its coefficients. `_unit` is not used; [`WriteArray`] requires it.
fn write_sh(state: &Gaussians, _unit: f64, out: &mut dyn Write) -> std::io::Result<()> {
    /// Number of Gaussians that are encoded at once, so that the bytes stay in the cache.
    const BLOCK: usize = 1024;
    let width = state.sh.width().saturating_sub(3);
    if width == 0 {
        return Ok(());
    }
    let mut bytes = vec![0; width * BLOCK];
    for first in (0..state.len()).step_by(BLOCK) {
        let rows = first..state.len().min(first + BLOCK);
        for (column, sign) in AXIS_SIGNS.iter().flat_map(|sign| [sign; 3]).take(width).enumerate() {
            let values = &state.sh.plane(3 + column)[rows.clone()];
            let to = bytes[column..].iter_mut().step_by(width);
            to.zip(values).for_each(|(to, value)| *to = sh_byte(1 + column / 3, sign * value));
        }
        out.write_all(&bytes[..width * rows.len()])?;
    }
    Ok(())
}

/// Returns the scale, in scene units, that `byte` stands for.
fn scale_of_byte(byte: u8) -> f64 {
    (f64::from(byte) / 16.0 - 10.0).exp()
}

/// Returns the errors of the values that an `.spz` file would store for the Gaussians `state`. `unit` is the unit in
/// which positions are stored, in scene units.
///
/// # Errors
/// Fails if an error exceeds its bound in [`accuracy`](super::accuracy).
fn check_accuracy(state: &Gaussians, unit: f64) -> Result<SpzErrors> {
    let mut accuracy = CodingErrors::new(&state.position);
    for row in 0..state.len() {
        let wanted = RenderedAttributes::from_state(state, row);
        let color = |dc: f32| color_from_sh(((f64::from(color_byte(dc)) / 255.0 - 0.5) / 0.15) as f32);
        let found = RenderedAttributes {
            position: wanted.position.map(|x| f64::from(fixed(x, unit)) * unit),
            scale: state.log_scale.row::<3>(row).map(|scale| scale_of_byte(scale_byte(scale))),
            opacity: f64::from(opacity_byte(state.opacity_logit.row::<1>(row)[0])) / 255.0,
            color: state.sh.row::<3>(row).map(color),
        };
        accuracy.add(row, &wanted, &found);
        if wanted.color.iter().any(|c| !c.is_finite()) {
            accuracy.add_sh(row, f64::INFINITY);
        }
    }
    for column in 3..state.sh.width() {
        let values = state.sh.plane(column);
        // The error of a value from −1 to 1 is below 0.07, and the bound is 1, so these values need no check. NaN does.
        // `&` makes a loop without early exit, which the compiler vectorizes; `all` does not.
        if values.iter().fold(true, |are_in_range, value| are_in_range & (value.abs() <= 1.0)) {
            continue;
        }
        for (row, &value) in values.iter().enumerate() {
            let held = (f64::from(sh_byte(column / 3, value)) - 128.0) / 128.0;
            accuracy.add_sh(row, (f64::from(value) - held).abs());
        }
    }
    accuracy.check("a .spz")?;
    Ok(SpzErrors { position: accuracy.position_error(), reduced_scales: accuracy.reduced_scales() })
}

/// Returns the coordinate `value` in units of `unit`, as an integer that fits into 24 bits with its sign. Rounds to the
/// nearest integer and clamps larger magnitudes.
fn fixed(value: f64, unit: f64) -> i32 {
    (value / unit).round().clamp(-MAX_FIXED, MAX_FIXED) as i32
}

/// Returns the byte that stores the opacity with logit `logit`.
fn opacity_byte(logit: f32) -> u8 {
    byte(255.0 * opacity(logit))
}

/// Returns the byte that stores the SH coefficient `dc` of degree 0.
fn color_byte(dc: f32) -> u8 {
    byte(255.0 * (0.15 * f64::from(dc) + 0.5))
}

/// Returns the byte that stores the log scale `log_scale`.
fn scale_byte(log_scale: f32) -> u8 {
    byte(16.0 * (f64::from(log_scale) + 10.0))
}

/// Returns the byte that stores the SH coefficient `value` above degree 0. `k` is its index among the coefficients of
/// one color channel, from 1. The number 128·`value` + 128 is rounded to 5 bits in degree 1 and to 4 bits above.
fn sh_byte(k: usize, value: f32) -> u8 {
    let dropped_bits = if k < 4 { 3 } else { 4 };
    let scaled = 128.0 * f64::from(value);
    // The nearest integer; halves are rounded away from 0. Larger magnitudes than ±512 do not fit a byte anyway.
    let rounded = (scaled + 0.5f64.copysign(scaled)).clamp(-512.0, 512.0) as i32;
    let half = 1 << (dropped_bits - 1);
    ((rounded + 128 + half) >> dropped_bits << dropped_bits).clamp(0, 255) as u8
}

/// Encodes a unit quaternion xyzw in 32 bits: the index of the component with the largest magnitude, and the sign and
/// magnitude of each of the other three components. A decoder takes the omitted component as positive. If it is
/// negative, the stored signs are therefore reversed; q and −q are the same rotation.
fn smallest_three(q: [f64; 4]) -> u32 {
    let largest = (1..4).fold(0, |largest: usize, i| if q[i].abs() > q[largest].abs() { i } else { largest });
    let others = (0..4).filter(|&i| i != largest);
    others.fold(largest as u32, |word, i| {
        let sign = u32::from((q[i] < 0.0) != (q[largest] < 0.0));
        word << 10 | sign << 9 | (511.0 * 2f64.sqrt() * q[i].abs()).round().min(511.0) as u32
    })
}

/// Returns `value` rounded to the nearest integer and clamped to 0–255; NaN becomes 0.
fn byte(value: f64) -> u8 {
    value.round() as u8
}

#[cfg(test)]
mod tests {
    use crate::files::tests::assert_signs_reverse_axes;
    use std::io::Read;

    use flate2::read::GzDecoder;

    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::Attributes;
    use crate::passes::gather_all;

    /// One Gaussian as read: position, opacity, color, scales, rotation wxyz and SH coefficients.
    type Row = (Vec<f64>, f64, Vec<f64>, Vec<f64>, [f64; 4], Vec<f64>);

    /// Reads an `.spz` file as the format specifies, without code shared with the writer.
    fn read(path: &Path) -> Vec<Row> {
        let mut bytes = Vec::new();
        GzDecoder::new(File::open(path).unwrap()).read_to_end(&mut bytes).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!([word(0), word(4)], [0x5053_474e, 3]);
        let (count, degree, bits) = (word(8) as usize, bytes[12] as usize, i32::from(bytes[13]));
        let more = 3 * ((degree + 1).pow(2) - 1);
        assert_eq!(bytes.len(), 16 + count * (9 + 1 + 3 + 3 + 4 + more));
        let starts: Vec<usize> = [9, 1, 3, 3, 4]
            .iter()
            .scan(16, |at, width| Some(std::mem::replace(at, *at + width * count)))
            .chain([16 + 20 * count])
            .collect();
        let row_bytes = |array: usize, width: usize, i: usize| &bytes[starts[array] + width * i..][..width];
        let values = |bytes: &[u8], decode: &dyn Fn(f64) -> f64| {
            bytes.iter().map(|&b| decode(f64::from(b))).collect::<Vec<f64>>()
        };
        (0..count)
            .map(|i| {
                let place = row_bytes(0, 9, i).as_chunks::<3>().0;
                // Extend the sign, which is in the highest of the three bytes.
                let place =
                    place.iter().map(|b| f64::from(i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) / 2f64.powi(bits));
                let mut bits_left = u32::from_le_bytes(row_bytes(4, 4, i).try_into().unwrap());
                let (largest, mut q) = ((bits_left >> 30) as usize, [0.0f64; 4]);
                for k in (0..4).rev().filter(|&k| k != largest) {
                    let size = f64::from(bits_left & 511) / 511.0 / 2f64.sqrt();
                    q[k] = if bits_left & 512 == 0 { size } else { -size };
                    bits_left >>= 10;
                }
                q[largest] = (1.0 - q.iter().map(|x| x * x).sum::<f64>()).sqrt();
                (
                    place.collect(),
                    f64::from(row_bytes(1, 1, i)[0]) / 255.0,
                    values(row_bytes(2, 3, i), &|b| (b / 255.0 - 0.5) / 0.15),
                    values(row_bytes(3, 3, i), &|b| b / 16.0 - 10.0),
                    [q[3], q[0], q[1], q[2]],
                    values(row_bytes(5, more, i), &|b| (b - 128.0) / 128.0),
                )
            })
            .collect()
    }

    #[test]
    fn sh_bytes_are_multiples_of_the_step_nearest_to_the_value() {
        for (k, step) in [(1, 8.0), (3, 8.0), (4, 16.0), (15, 16.0)] {
            for value in (-40_000..40_000).map(|i| i as f32 / 15_000.0).chain([f32::MAX, f32::MIN, 1e-20, -0.5 / 128.0])
            {
                let steps = ((128.0 * f64::from(value)).round() + 128.0 + step / 2.0) / step;
                let expected = (steps.floor() * step).clamp(0.0, 255.0) as u8;
                assert_eq!(super::sh_byte(k, value), expected, "coefficient {k}, value {value}");
            }
        }
    }

    #[test]
    fn independent_reader_finds_the_written_values() {
        let mut state = gather_all(&DemoScene::new(300, 1), 0, Attributes::all()).unwrap();
        state.sh = crate::model::AttributeValues::zeros(48, 300);
        state.sh.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k as f32 * 0.618_034).fract() - 0.5);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.spz");
        let position_error = write_spz(&state, SpzVersion::V3, &path).unwrap().position;
        for (row, (place, visible, color, scales, q, sh)) in read(&path).into_iter().enumerate() {
            let near = |found: &[f64], expected: &[f64], within: f64, what: &str| {
                for (a, b) in found.iter().zip(expected) {
                    assert!((a - b).abs() <= within, "{what} of {row}: {a}, expected {b}");
                }
            };
            let [x, y, z] = state.position_f64(row);
            near(&place, &[x, -y, -z], 1.01 * position_error, "position");
            near(&[visible], &[opacity(state.opacity_logit.row::<1>(row)[0])], 0.5 / 255.0, "opacity");
            let dc = state.sh.row::<3>(row).map(f64::from);
            near(&color, &dc, 0.51 / 255.0 / 0.15, "color");
            near(
                &scales,
                &state.log_scale.row::<3>(row).map(|s| f64::from(s).clamp(-10.0, 5.93)),
                0.51 / 16.0,
                "scale",
            );
            let r = state.rotation_f64(row);
            let length = r.iter().map(|x| x * x).sum::<f64>().sqrt();
            let turned = [r[0], r[1], -r[2], -r[3]].map(|x| x / length);
            let dot: f64 = q.iter().zip(turned).map(|(a, b)| a * b).sum();
            assert!(dot.abs() > 0.99999, "rotation of {row}: {q:?}, expected {turned:?}");
            for k in 1..16 {
                let half = if k < 4 { 4.5 / 128.0 } else { 8.5 / 128.0 };
                for c in 0..3 {
                    let expected = f64::from(AXIS_SIGNS[k - 1] * state.sh.plane(3 * k + c)[row]);
                    near(&[sh[3 * (k - 1) + c]], &[expected], half, "SH coefficient");
                }
            }
        }
        let again = folder.path().join("b.spz");
        write_spz(&state, SpzVersion::V3, &again).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&again).unwrap());
        state.position.plane_mut(1)[7] = f32::NAN;
        assert!(write_spz(&state, SpzVersion::V3, &again).unwrap_err().to_string().contains("Gaussian 7"));
    }

    #[test]
    fn sh_signs_match_the_reversed_axes() {
        assert_signs_reverse_axes(AXIS_SIGNS, [1.0, -1.0, -1.0]);
    }
}
