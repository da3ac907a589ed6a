//! Writes a copy of a NumPy `.npz` archive with fewer Gaussians.
//!
//! Input: an open archive, for each of its arrays the axis whose index is the Gaussian, and the indices of the
//! Gaussians to keep. Output: an archive with the same arrays in the same order and types, compressed as before.
//! Memory: the values of one frame. The output bytes depend only on the content, because all files in the archive are
//! dated 1980-01-01.

use std::io::Write;
use std::path::Path;

use zip::CompressionMethod;

use crate::error::{Error, Result};
use crate::files::npz::{Npz, NpzArray};
use crate::files::zip_output::{create_zip, finish_zip, stored_file_options};

/// Axis of an array that counts the Gaussians: index i along this axis belongs to Gaussian i.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum GaussianAxis {
    /// No axis: the array has no values per Gaussian and is copied unchanged.
    None,
    /// Axis 0 counts the Gaussians.
    Axis0,
    /// Axis 1 counts the Gaussians, and axis 0 counts the frames.
    Axis1,
}

/// Writes a copy of the archive `template` to `path` that has only the Gaussians with the indices `kept`. Two functions
/// decide about the arrays:
///
/// - `axis` receives an array and returns which of its axes counts the Gaussians.
/// - `change` receives the name of an array, a frame number and the values of the kept Gaussians at this frame. It may
///   change these values, and returns the indices (in `kept`) of the Gaussians that it changed. All other values keep
///   their bytes.
///
/// # Errors
/// Fails if an array cannot be decoded, if `change` fails, or if the file cannot be written.
pub(crate) fn write_like(
    template: &Npz,
    kept: &[u32],
    axis: impl Fn(&NpzArray) -> GaussianAxis,
    mut change: impl FnMut(&str, usize, &mut [f32]) -> Result<Vec<u32>>,
    path: &Path,
) -> Result<()> {
    let failed = |error| Error::io("write", path)(error);
    let mut archive = create_zip(path)?;
    for entry in template.entries() {
        let axis = axis(entry);
        let mut shape = entry.shape.clone();
        match axis {
            GaussianAxis::None => (),
            GaussianAxis::Axis0 => shape[0] = kept.len(),
            GaussianAxis::Axis1 => shape[1] = kept.len(),
        }
        let method = if entry.is_compressed { CompressionMethod::Deflated } else { CompressionMethod::Stored };
        // A value has at most 8 bytes.
        let options = stored_file_options(8 * entry.len() as u64).compression_method(method);
        archive.start_file(format!("{}.npy", entry.name), options).map_err(|error| failed(error.into()))?;
        template.read(entry, |values| {
            if axis == GaussianAxis::None {
                archive.write_all(&header(&entry.descr, entry.is_fortran, &shape)).map_err(failed)?;
                std::io::copy(values, &mut archive).map_err(|error| template.damaged(entry, &error))?;
                return Ok(());
            }
            let Some(float) = entry.float else {
                return Err(Error::input(template.path(), &entry.name, "floating-point numbers", &entry.descr));
            };
            archive.write_all(&header(&entry.descr, false, &shape)).map_err(failed)?;
            let (frames, rows) = match axis {
                GaussianAxis::Axis1 => (entry.shape[0], &entry.shape[1..]),
                _ => (1, &entry.shape[..]),
            };
            let width: usize = rows[1..].iter().product();
            let row_bytes = width * float.bytes;
            let (mut frame_bytes, mut kept_bytes) = (vec![0; rows[0] * row_bytes], Vec::new());
            let mut as_f32 = Vec::new();
            for frame in 0..frames {
                values.read_exact(&mut frame_bytes).map_err(|error| template.damaged(entry, &error))?;
                kept_bytes.clear();
                kept.iter().for_each(|&row| {
                    kept_bytes.extend_from_slice(&frame_bytes[row as usize * row_bytes..][..row_bytes])
                });
                as_f32.clear();
                as_f32.extend(kept_bytes.chunks_exact(float.bytes).map(|stored| float.decode(stored)));
                for row in change(&entry.name, frame, &mut as_f32)? {
                    let row = row as usize;
                    let (stored, values) =
                        (&mut kept_bytes[row * row_bytes..][..row_bytes], &as_f32[row * width..][..width]);
                    stored
                        .chunks_exact_mut(float.bytes)
                        .zip(values)
                        .for_each(|(stored, &value)| float.encode(value, stored));
                }
                archive.write_all(&kept_bytes).map_err(failed)?;
            }
            Ok(())
        })?;
    }
    finish_zip(archive, path)
}

/// Returns the header of a NumPy array file for values of the type `descr` (NumPy's notation) in an array of the shape
/// `shape`. If `is_fortran` is true, the first axis is the fastest. The header has version 1.0 of the format: a
/// dictionary padded to a multiple of 64 bytes.
fn header(descr: &str, is_fortran: bool, shape: &[usize]) -> Vec<u8> {
    let order = if is_fortran { "True" } else { "False" };
    let lengths: String = shape.iter().map(|length| format!("{length}, ")).collect();
    let lengths = if shape.len() == 1 { lengths.trim_end() } else { lengths.trim_end_matches(", ") };
    let mut text = format!("{{'descr': {descr}, 'fortran_order': {order}, 'shape': ({lengths}), }}");
    let before = 10;
    let padding = (before + text.len() + 1).next_multiple_of(64) - (before + text.len() + 1);
    text.extend(std::iter::repeat_n(' ', padding));
    text.push('\n');
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend((text.len() as u16).to_le_bytes());
    header.extend(text.as_bytes());
    header
}
