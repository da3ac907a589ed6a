//! Writer of still scenes as `.spz`, version 3 of the format (nianticlabs/spz, `load-spz.cc`): a header of 16 bytes and
//! the arrays below one after the other, all compressed by gzip.
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
//! The maintained crate for this format is not used, because it depends on an asynchronous runtime; writing the format
//! takes only the code below.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use flate2::{Compression, GzBuilder};

use super::accuracy::{Accuracy, RenderedAttributes, check_positions};
use crate::error::{Error, Result, ShowPath};
use crate::model::{Gaussians, color, opacity};

const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 3;
/// Largest magnitude of a stored position, in units of the last bit (24 bits, signed).
const MAX_FIXED: f64 = 8_388_607.0;
/// Maximum number of fractional bits of positions; more bits would only store rounding noise of f32.
const MAX_FRACTION_BITS: i32 = 20;
/// Sign by which each SH coefficient above degree 0 is multiplied when the y and z axes are reversed.
const AXIS_SIGNS: [f32; 15] = [-1., -1., 1., -1., 1., 1., -1., 1., -1., 1., -1., -1., 1., -1., 1.];

/// Writes the Gaussians `state` to an `.spz` file at `path`. Returns the largest error of a position in the file, in
/// scene units.
///
/// # Errors
/// Fails if a position is not finite, if stored values would exceed the error bounds of [`accuracy`](super::accuracy),
/// if there are more Gaussians than the format can count, or if writing fails.
pub fn write_spz(state: &Gaussians, path: &Path) -> Result<f64> {
    let furthest = state.position.planes().iter().fold(0.0f64, |most, x| most.max(f64::from(x.abs())));
    check_positions(state, path, "a .spz")?;
    let count = u32::try_from(state.len())
        .map_err(|_| Error::usage(format!("{}: {} Gaussians are too many for a .spz", path.shown(), state.len())))?;
    let bits = (MAX_FIXED / furthest.max(1e-9)).log2().floor().clamp(0.0, f64::from(MAX_FRACTION_BITS)) as i32;
    let unit = 0.5f64.powi(bits);
    let position_error = check_accuracy(state, unit)?;
    let file = File::create(path).map_err(Error::io("create", path))?;
    // Write no time stamp and no name into the gzip header, so that the same scene gives the same bytes.
    let mut out = GzBuilder::new().write(BufWriter::new(file), Compression::best());
    let mut write = || -> std::io::Result<()> {
        for word in [MAGIC, VERSION, count] {
            out.write_all(&word.to_le_bytes())?;
        }
        out.write_all(&[state.sh_degree() as u8, bits as u8, 0, 0])?;
        let rows = 0..state.len();
        for row in rows.clone() {
            let [x, y, z] = state.position.row::<3>(row).map(f64::from);
            for value in [x, -y, -z] {
                let fixed = fixed(value, unit);
                out.write_all(&fixed.to_le_bytes()[..3])?;
            }
        }
        for row in rows.clone() {
            out.write_all(&[opacity_byte(state.opacity_logit.row::<1>(row)[0])])?;
        }
        for row in rows.clone() {
            out.write_all(&state.sh.row::<3>(row).map(color_byte))?;
        }
        for row in rows.clone() {
            out.write_all(&state.log_scale.row::<3>(row).map(scale_byte))?;
        }
        for row in rows.clone() {
            let q = state.rotation.row::<4>(row).map(f64::from);
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            let [w, x, y, z] = if length > 0.0 { q.map(|x| x / length) } else { [1.0, 0.0, 0.0, 0.0] };
            out.write_all(&smallest_three([x, -y, -z, w]).to_le_bytes())?;
        }
        for row in rows {
            for (k, turned) in (1..state.sh.width() / 3).zip(AXIS_SIGNS) {
                for c in 0..3 {
                    out.write_all(&[sh_byte(k, turned * state.sh.plane(3 * k + c)[row])])?;
                }
            }
        }
        out.try_finish()?;
        out.get_mut().flush()
    };
    write().map_err(Error::io("write", path))?;
    Ok(position_error)
}

/// Measures the coding errors of an `.spz` file of `state` whose positions are stored in units of `unit`. Returns the
/// largest error of a position in scene units.
///
/// # Errors
/// Fails if an error exceeds its bound in [`accuracy`](super::accuracy).
fn check_accuracy(state: &Gaussians, unit: f64) -> Result<f64> {
    let mut accuracy = Accuracy::new(&state.position);
    for row in 0..state.len() {
        let wanted = RenderedAttributes::from_state(state, row);
        let color = |dc: f32| color(((f64::from(color_byte(dc)) / 255.0 - 0.5) / 0.15) as f32);
        let found = RenderedAttributes {
            position: wanted.position.map(|x| f64::from(fixed(x, unit)) * unit),
            scale: state.log_scale.row::<3>(row).map(|scale| (f64::from(scale_byte(scale)) / 16.0 - 10.0).exp()),
            opacity: f64::from(opacity_byte(state.opacity_logit.row::<1>(row)[0])) / 255.0,
            color: state.sh.row::<3>(row).map(color),
        };
        accuracy.add(row, &wanted, &found);
        if wanted.color.iter().any(|c| !c.is_finite()) {
            accuracy.add_sh(row, f64::INFINITY);
        }
        for (k, c) in (1..state.sh.width() / 3).flat_map(|k| (0..3).map(move |c| (k, c))) {
            let value = state.sh.plane(3 * k + c)[row];
            let held = (f64::from(sh_byte(k, value)) - 128.0) / 128.0;
            accuracy.add_sh(row, (f64::from(value) - held).abs());
        }
    }
    accuracy.check("a .spz")?;
    Ok(accuracy.position_error())
}

/// Returns the coordinate `value` as a 24-bit integer in units of `unit`.
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

/// Returns the byte that stores the SH coefficient with index `k` (from 1) of one channel. Its value is rounded to 5
/// bits in degree 1 and to 4 bits above.
fn sh_byte(k: usize, value: f32) -> u8 {
    let step = if k < 4 { 8.0 } else { 16.0 };
    let nearest = ((128.0 * f64::from(value)).round() + 128.0 + step / 2.0) / step;
    byte(nearest.floor() * step)
}

/// Encodes a unit quaternion xyzw in 32 bits: the index of its largest component, and the other three components. q and
/// −q are the same rotation; the sign is chosen so that the omitted largest component is positive.
fn smallest_three(q: [f64; 4]) -> u32 {
    let largest = (1..4).fold(0, |largest: usize, i| if q[i].abs() > q[largest].abs() { i } else { largest });
    let others = (0..4).filter(|&i| i != largest);
    others.fold(largest as u32, |word, i| {
        let sign = u32::from((q[i] < 0.0) != (q[largest] < 0.0));
        word << 10 | sign << 9 | (511.0 * 2f64.sqrt() * q[i].abs()).round().min(511.0) as u32
    })
}

/// Rounds to the nearest integer and clamps to 0–255; NaN becomes 0.
fn byte(value: f64) -> u8 {
    value.round() as u8
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use flate2::read::GzDecoder;

    use super::*;
    use crate::diagnostics::demo_scene::Scene;
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
    fn independent_reader_finds_the_written_values() {
        let mut state = gather_all(&Scene::new(300, 1), 0, Attributes::all()).unwrap();
        state.sh = crate::model::AttributeValues::zeros(48, 300);
        state.sh.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k as f32 * 0.618_034).fract() - 0.5);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.spz");
        let position_error = write_spz(&state, &path).unwrap();
        for (row, (place, visible, color, scales, q, sh)) in read(&path).into_iter().enumerate() {
            let near = |found: &[f64], expected: &[f64], within: f64, what: &str| {
                for (a, b) in found.iter().zip(expected) {
                    assert!((a - b).abs() <= within, "{what} of {row}: {a}, expected {b}");
                }
            };
            let [x, y, z] = state.position.row::<3>(row).map(f64::from);
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
            let r = state.rotation.row::<4>(row).map(f64::from);
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
        write_spz(&state, &again).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&again).unwrap());
        state.position.plane_mut(1)[7] = f32::NAN;
        assert!(write_spz(&state, &again).unwrap_err().to_string().contains("Gaussian 7"));
    }

    /// Evaluates a color in the same direction in the original and in the reversed coordinate system; the signs in
    /// [`AXIS_SIGNS`] must make both equal.
    #[test]
    fn sh_signs_match_the_reversed_axes() {
        let basis = |[x, y, z]: [f64; 3]| -> [f64; 15] {
            [
                -y,
                z,
                -x,
                x * y,
                -y * z,
                2.0 * z * z - x * x - y * y,
                -x * z,
                x * x - y * y,
                -y * (3.0 * x * x - y * y),
                x * y * z,
                -y * (4.0 * z * z - x * x - y * y),
                z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
                -x * (4.0 * z * z - x * x - y * y),
                z * (x * x - y * y),
                -x * (x * x - 3.0 * y * y),
            ]
        };
        let direction = [0.48, -0.6, 0.64];
        let turned = basis([direction[0], -direction[1], -direction[2]]);
        for (k, (a, b)) in basis(direction).iter().zip(turned).enumerate() {
            assert!((a * f64::from(AXIS_SIGNS[k]) - b).abs() < 1e-12, "function {k}");
        }
    }
}
