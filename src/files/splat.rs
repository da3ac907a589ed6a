//! Reader of `.splat` files (antimatter15/splat): 32 bytes per Gaussian and no header.
//!
//! | bytes | value |
//! |---|---|
//! | 12 | position, three f32 |
//! | 12 | standard deviations, three f32 |
//! | 4 | 255 times the color red, green, blue, and 255 times the opacity |
//! | 4 | quaternion wxyz: 128·q + 128 |

use std::path::Path;

use super::map::FileMap;
use super::sog::images::decode_opacity;
use crate::error::{Error, Result};
use crate::limits::ReadLimit;
use crate::model::{Gaussians, sh_from_color};

/// Number of bytes per Gaussian in a `.splat` file.
pub const ROW_BYTES: usize = 32;
/// Minimum standard deviation, in scene units, of a Gaussian after reading. Smaller values of the file are raised to
/// the minimum, so that their logarithms are finite.
const MIN_SCALE: f32 = 1e-7;

/// Reads the Gaussians of the `.splat` file at `path`, with SH degree 0. Accepts positions and scales that are NaN or
/// infinite, and zero quaternions.
///
/// # Errors
/// Fails if the file is not a whole number of rows, or if the Gaussians need more memory than `memory`.
pub fn read_splat(path: &Path, memory: ReadLimit) -> Result<Gaussians> {
    let map = FileMap::open(path)?;
    let count = map.len() / ROW_BYTES;
    if !map.len().is_multiple_of(ROW_BYTES) || u32::try_from(count).is_err() {
        let expected = format!("a multiple of {ROW_BYTES} bytes, one row per Gaussian");
        return Err(Error::input(path, "", expected, format!("{} bytes", map.len()))
            .hint("the file is cut short, or is no .splat; copy or export it again"));
    }
    let mut gaussians = Gaussians::zeros(0, 0);
    let values = 4 * (3 + 4 + 3 + 1 + 3) * count as u64;
    memory.check(path, "", "the Gaussians of the file", values)?;
    gaussians.resize(count);
    for (i, row) in map.as_chunks::<ROW_BYTES>().0.iter().enumerate() {
        map.touched(i * ROW_BYTES..(i + 1) * ROW_BYTES);
        let number = |at: usize| f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]]);
        let [position, scale] = [0, 12].map(|first| [0, 1, 2].map(|c| number(first + 4 * c)));
        gaussians.position.set_row(i, position);
        gaussians.log_scale.set_row(i, scale.map(log_scale));
        gaussians.sh.set_row(i, [24, 25, 26].map(|at| sh_from_color(f64::from(row[at]) / 255.0)));
        gaussians.opacity_logit.set_row(i, [decode_opacity(row[27])]);
        gaussians.rotation.set_row(i, unit([28, 29, 30, 31].map(|at| (f32::from(row[at]) - 128.0) / 128.0)));
    }
    Ok(gaussians)
}

/// Returns the natural logarithm of the standard deviation `scale`, at least that of [`MIN_SCALE`]; NaN for NaN.
fn log_scale(scale: f32) -> f32 {
    if scale.is_nan() { scale } else { f64::from(scale.abs().max(MIN_SCALE)).ln() as f32 }
}

/// Returns the quaternion `q` scaled to length 1; a quaternion of length 0 is unchanged.
fn unit(q: [f32; 4]) -> [f32; 4] {
    let length = q.iter().map(|x| x * x).sum::<f32>().sqrt();
    if length > 0.0 { q.map(|x| x / length) } else { q }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{color_from_sh, opacity};

    /// Returns the row (32 bytes) of a test Gaussian whose values differ along all axes, so that a swapped axis is
    /// noticed.
    fn row() -> Vec<u8> {
        let numbers = [1.5f32, -2.0, 0.25, 0.5, 0.0, 2.0].into_iter().flat_map(f32::to_le_bytes);
        numbers.chain([255, 0, 51, 204, 128, 192, 64, 128]).collect()
    }

    fn read(bytes: &[u8]) -> Result<Gaussians> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.splat");
        std::fs::write(&path, bytes).unwrap();
        read_splat(&path, ReadLimit::NONE)
    }

    #[test]
    fn rows_are_read_in_the_order_of_the_format() {
        let found = read(&[row(), row()].concat()).unwrap();
        assert_eq!((found.len(), found.position.row::<3>(1)), (2, [1.5, -2.0, 0.25]));
        assert_eq!(found.log_scale.row::<3>(0), [0.5f64.ln() as f32, 1e-7f64.ln() as f32, 2f64.ln() as f32]);
        let rgb = found.sh.row::<3>(0).map(|dc| (255.0 * color_from_sh(dc)).round());
        assert_eq!((rgb, (255.0 * opacity(found.opacity_logit.plane(0)[0])).round()), ([255.0, 0.0, 51.0], 204.0));
        let half = std::f32::consts::FRAC_1_SQRT_2;
        assert_eq!(found.rotation.row::<4>(0), [0.0, half, -half, 0.0]);
    }

    #[test]
    fn damaged_files_are_refused() {
        assert!(read(&row()[..31]).unwrap_err().to_string().contains("31 bytes"));
    }

    #[test]
    fn unusual_values_are_read_as_they_are() {
        let mut odd = row();
        odd[0..4].copy_from_slice(&f32::NAN.to_le_bytes());
        odd[12..16].copy_from_slice(&f32::NAN.to_le_bytes());
        odd[28..].copy_from_slice(&[128; 4]);
        let found = read(&odd).unwrap();
        assert!(found.position.plane(0)[0].is_nan() && found.log_scale.plane(0)[0].is_nan());
        assert_eq!(found.rotation.row::<4>(0), [0.0; 4]);
    }
}
