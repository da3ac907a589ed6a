//! Reader of `.compressed.ply` files (SuperSplat): a PLY whose Gaussians are packed into four 32-bit words each.
//!
//! A row of the element `chunk` holds the range (smallest and largest value) of each component over a chunk of 256
//! successive Gaussians. A row of the element `vertex` holds one Gaussian. Bits are counted from the highest:
//!
//! | property | bits | value |
//! |---|---|---|
//! | `packed_position` | 11, 10, 11 | x, y, z as fractions of their ranges in the chunk |
//! | `packed_rotation` | 2, 10, 10, 10 | index of the omitted one of w, x, y, z; the others, from −1/√2 to 1/√2 |
//! | `packed_scale` | 11, 10, 11 | ln s along x, y, z as fractions of their ranges in the chunk |
//! | `packed_color` | 8, 8, 8, 8 | red, green, blue as fractions of their ranges; opacity |
//!
//! The properties with the ranges of red, green and blue (`min_r` …) are optional; without them the ranges are 0 to 1.
//! The optional element `sh` holds one byte per coefficient `f_rest_*`, from −4 to 4. Source: the reader of
//! splat-transform 3.7 of PlayCanvas.

use std::path::Path;

use super::map::FileMap;
use super::ply::header::{Element, PlyEncoding, PlyHeader, Property, Scalar};
use super::sog::images::decode_opacity;
use crate::error::{Error, Result, quoted};
use crate::limits::ReadLimit;
use crate::model::{Gaussians, MAX_SH_DEGREE, SH_C0, sh_coefficient_count};

/// Name of a PLY property that only `.compressed.ply` files have. A file with this property is read in this format.
pub const MARKER_PROPERTY: &str = "packed_position";
/// Number of Gaussians per row of the element `chunk`.
const CHUNK: usize = 256;
/// Width of the range of SH coefficients above degree 0 that a byte can store: −4 to 4.
const SH_RANGE: f32 = 8.0;

/// Element of the PLY file: its description in the header, and the bytes of its rows in the mapped file.
struct Table<'a> {
    element: &'a Element,
    bytes: &'a [u8],
    path: &'a Path,
}

impl<'a> Table<'a> {
    /// Returns the property called `name`, which must have the number type `scalar`. Fails if it is missing or has
    /// another type.
    fn property(&self, name: &str, scalar: Scalar) -> Result<&'a Property> {
        let place = format!("element {}", quoted(&self.element.name));
        let expected = format!("a property {} {name}", scalar.name());
        match self.element.properties.iter().find(|property| property.name == name) {
            Some(property) if property.scalar == scalar => Ok(property),
            Some(property) => Err(Error::input(self.path, place, expected, format!("type {}", property.scalar.name()))),
            None => Err(Error::input(self.path, place, expected, "none")),
        }
    }

    /// Returns the four bytes that begin at byte `offset` of row `row`: a property of the type `uint`.
    fn word(&self, row: usize, offset: usize) -> [u8; 4] {
        let bytes = &self.bytes[row * self.element.stride + offset..][..4];
        [bytes[0], bytes[1], bytes[2], bytes[3]]
    }
}

/// Ranges of three components over the Gaussians of one chunk: for each component, its smallest and its largest value.
type Ranges = [[f32; 2]; 3];

/// Reads the Gaussians of the `.compressed.ply` file at `path`.
///
/// # Errors
/// Fails if the file is damaged, lacks a property, holds a range that is not finite, or needs more memory than
/// `memory`.
pub fn read_compressed_ply(path: &Path, memory: ReadLimit) -> Result<Gaussians> {
    let map = FileMap::open(path)?;
    let header = PlyHeader::parse(path, &map)?;
    if header.encoding != PlyEncoding::LittleEndian {
        return Err(Error::input(path, "format", "binary_little_endian", "another encoding"));
    }
    let mut at = header.text.len();
    let mut tables = Vec::new();
    for element in &header.elements {
        let end = usize::try_from(element.count)
            .ok()
            .and_then(|count| count.checked_mul(element.stride))
            .and_then(|bytes| bytes.checked_add(at))
            .filter(|&end| end <= map.len());
        let Some(end) = end else {
            let expected = format!("{} rows of {} bytes", element.count, element.stride);
            let place = format!("element {}", quoted(&element.name));
            return Err(Error::input(path, place, expected, format!("{} bytes", map.len() - at))
                .hint("the file is cut short; copy or export it again"));
        };
        tables.push(Table { element, bytes: &map[at..end], path });
        at = end;
    }
    let table = |name: &str| tables.iter().find(|table| table.element.name == name);
    let required = |name: &str| table(name).ok_or_else(|| Error::input(path, "", format!("an element {name}"), "none"));
    let (chunks, vertices) = (required("chunk")?, required("vertex")?);
    let count = vertices.element.count as usize;
    if count > u32::MAX as usize {
        return Err(Error::input(path, "element vertex", "at most 4294967295 Gaussians", count.to_string()));
    }
    if (chunks.element.count as usize) < count.div_ceil(CHUNK) {
        let expected = format!("{} chunks for {count} Gaussians", count.div_ceil(CHUNK));
        return Err(Error::input(path, "element chunk", expected, chunks.element.count.to_string()));
    }
    let per_gaussian = 4 * (11 + 3 * sh_coefficient_count(MAX_SH_DEGREE) as u64);
    memory.check(path, "element vertex", "the Gaussians of the file", count as u64 * per_gaussian)?;
    let degree = table("sh").map_or(Ok(0), |table| sh_degree(table, count))?;
    let mut gaussians = Gaussians::zeros(count, degree);
    decode_vertices(chunks, vertices, &mut gaussians)?;
    if let Some(table) = table("sh") {
        decode_sh(table, &mut gaussians)?;
    }
    Ok(gaussians)
}

/// Decodes the packed position, rotation, scale and color of every row of `vertices` into `gaussians`. Each row of
/// `chunks` holds the value ranges of 256 successive Gaussians. Fails if a property is missing or a range is not
/// finite.
fn decode_vertices(chunks: &Table, vertices: &Table, gaussians: &mut Gaussians) -> Result<()> {
    let names = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
    let mut offsets = [0; 4];
    for (offset, name) in offsets.iter_mut().zip(names) {
        *offset = vertices.property(name, Scalar::U32)?.offset;
    }
    let has_colors = chunks.element.properties.iter().any(|property| property.name == "min_r");
    let count = gaussians.len();
    for first in (0..count).step_by(CHUNK) {
        let chunk = first / CHUNK;
        let places = ranges(chunks, chunk, ["x", "y", "z"])?;
        let scales = ranges(chunks, chunk, ["scale_x", "scale_y", "scale_z"])?;
        let colors = if has_colors { ranges(chunks, chunk, ["r", "g", "b"])? } else { [[0.0, 1.0]; 3] };
        for row in first..count.min(first + CHUNK) {
            let [position, rotation, scale, color] = offsets.map(|at| u32::from_le_bytes(vertices.word(row, at)));
            gaussians.position.set_row(row, between(&places, unpack_11_10_11(position)));
            gaussians.rotation.set_row(row, unpack_rotation(rotation));
            gaussians.log_scale.set_row(row, between(&scales, unpack_11_10_11(scale)));
            let [red, green, blue, alpha] = color.to_be_bytes();
            let rgb = between(&colors, [red, green, blue].map(|byte| f32::from(byte) / 255.0));
            let dc = rgb.map(|value| ((f64::from(value) - 0.5) / SH_C0) as f32);
            (0..3).for_each(|c| gaussians.sh.plane_mut(c)[row] = dc[c]);
            gaussians.opacity_logit.set_row(row, [decode_opacity(alpha)]);
        }
    }
    Ok(())
}

/// Returns the ranges of three components that row number `chunk` of the table `chunks` holds: the properties
/// `min_NAME` and `max_NAME` for each NAME in `names`. Fails if one of them is missing or not finite.
fn ranges(chunks: &Table, chunk: usize, names: [&str; 3]) -> Result<Ranges> {
    let mut found = [[0.0; 2]; 3];
    for (range, name) in found.iter_mut().zip(names) {
        for (bound, prefix) in range.iter_mut().zip(["min", "max"]) {
            let property = chunks.property(&format!("{prefix}_{name}"), Scalar::F32)?;
            *bound = f32::from_le_bytes(chunks.word(chunk, property.offset));
            if !bound.is_finite() {
                let place = format!("element chunk, row {chunk}, {prefix}_{name}");
                return Err(Error::input(chunks.path, place, "a finite number", bound.to_string()));
            }
        }
    }
    Ok(found)
}

/// Returns three components, each interpolated linearly in its range in `ranges`. `at` holds a fraction for each
/// component: 0 gives the smallest value of the range, 1 the largest.
fn between(ranges: &Ranges, at: [f32; 3]) -> [f32; 3] {
    [0, 1, 2].map(|c| ranges[c][0] * (1.0 - at[c]) + ranges[c][1] * at[c])
}

/// Returns the three fractions (0 to 1) that `word` holds with 11, 10 and 11 bits, from the highest bits.
fn unpack_11_10_11(word: u32) -> [f32; 3] {
    let fraction = |value: u32, most: u32| (value & most) as f32 / most as f32;
    [fraction(word >> 21, 2047), fraction(word >> 11, 1023), fraction(word, 2047)]
}

/// Returns the unit quaternion wxyz that `word` stores as three components with 10 bits each.
fn unpack_rotation(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut q = [0f64; 4];
    for (k, shift) in (0..4).filter(|&k| k != largest).zip([20, 10, 0]) {
        q[k] = (f64::from(word >> shift & 1023) / 1023.0 - 0.5) * std::f64::consts::SQRT_2;
    }
    q[largest] = (1.0 - q.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    q.map(|x| (x / length) as f32)
}

/// Returns the SH degree of the element `sh` (`table`), which follows from its number of properties `f_rest_*`. Fails
/// if no degree has this number of coefficients, or if the element does not have one row for each of `count` Gaussians.
fn sh_degree(table: &Table, count: usize) -> Result<usize> {
    let coefficients = table.element.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
    let degree = (1..=MAX_SH_DEGREE).find(|&degree| 3 * (sh_coefficient_count(degree) - 1) == coefficients);
    if table.element.count != count as u64 {
        return Err(Error::input(table.path, "element sh", format!("{count} rows"), table.element.count.to_string()));
    }
    degree.ok_or_else(|| {
        let expected = "9, 24 or 45 properties f_rest_*, for SH degree 1, 2 or 3";
        Error::input(table.path, "element sh", expected, coefficients.to_string())
    })
}

/// Decodes the SH coefficients above degree 0 in the element `sh` (`table`) into `gaussians`. Fails if a property is
/// missing or is not a byte. A row holds all coefficients of red, then all of green, then all of blue.
fn decode_sh(table: &Table, gaussians: &mut Gaussians) -> Result<()> {
    let coefficients = gaussians.sh.width() / 3 - 1;
    for rest in 0..3 * coefficients {
        let offset = table.property(&format!("f_rest_{rest}"), Scalar::U8)?.offset;
        let (channel, k) = (rest / coefficients, rest % coefficients + 1);
        for (row, to) in gaussians.sh.plane_mut(3 * k + channel).iter_mut().enumerate() {
            let fraction = match table.bytes[row * table.element.stride + offset] {
                0 => 0.0,
                255 => 1.0,
                byte => (f32::from(byte) + 0.5) / 256.0,
            };
            *to = SH_RANGE * (fraction - 0.5);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the bytes of a `.compressed.ply` file of one Gaussian with SH degree 1. `edit` receives the text of the
    /// header and returns the text to be used.
    fn file(edit: impl Fn(&str) -> String) -> Vec<u8> {
        let bounds = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
        let mut header = "ply\nformat binary_little_endian 1.0\nelement chunk 1\n".to_owned();
        for names in bounds.chunks(3) {
            for prefix in ["min", "max"] {
                names.iter().for_each(|name| header += &format!("property float {prefix}_{name}\n"));
            }
        }
        header += "element vertex 1\n";
        ["position", "rotation", "scale", "color"]
            .iter()
            .for_each(|name| header += &format!("property uint packed_{name}\n"));
        header += "element sh 1\n";
        (0..9).for_each(|k| header += &format!("property uchar f_rest_{k}\n"));
        let mut bytes = edit(&(header + "end_header\n")).into_bytes();
        let ranges = [-1.0, -2.0, -3.0, 1.0, 3.0, 5.0, -8.0, -7.0, -6.0, 0.0, 0.0, 1.0, 0.0, 0.5, -0.5, 1.0, 1.0, 1.5];
        bytes.extend(ranges.into_iter().flat_map(f32::to_le_bytes));
        let words =
            [2047 << 21 | 512 << 11, 2 << 30 | 1023 << 20 | 512 << 10 | 511, 1023 << 11 | 2047, 0xff_00_33_80u32];
        bytes.extend(words.into_iter().flat_map(u32::to_le_bytes));
        bytes.extend([0, 255, 128, 127, 1, 2, 3, 4, 5]);
        bytes
    }

    fn read(bytes: &[u8]) -> Result<Gaussians> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.compressed.ply");
        std::fs::write(&path, bytes).unwrap();
        read_compressed_ply(&path, ReadLimit::NONE)
    }

    #[test]
    fn words_are_unpacked_in_the_order_of_the_format() {
        let found = read(&file(str::to_owned)).unwrap();
        let near = |found: &[f32], expected: &[f32]| {
            for (a, b) in found.iter().zip(expected) {
                assert!((a - b).abs() < 2e-3, "{found:?}, expected {expected:?}");
            }
        };
        near(&found.position.row::<3>(0), &[1.0, 0.502, -3.0]);
        near(&found.rotation.row::<4>(0), &[0.707, 0.001, 0.707, -0.001]);
        near(&found.log_scale.row::<3>(0), &[-8.0, 0.0, 1.0]);
        let color = |value: f32| (value - 0.5) / SH_C0 as f32;
        near(&found.sh.row::<3>(0), &[color(1.0), color(0.5), color(-0.1)]);
        near(&[found.opacity_logit.plane(0)[0]], &[0.0078]);
        // Red of the three coefficients, then green, then blue.
        near(&[3, 6, 9, 4].map(|plane| found.sh.plane(plane)[0]), &[-4.0, 4.0, 0.0156, -0.0156]);
    }

    #[test]
    fn damaged_files_are_refused() {
        let whole = file(str::to_owned);
        for length in 0..whole.len() {
            assert!(read(&whole[..length]).is_err(), "{length}");
        }
        for (from, to, expected) in [
            ("uint packed_scale", "int packed_scale", "packed_scale"),
            ("element chunk 1", "element chunk 0", "1 chunks for 1"),
            ("element vertex 1", "element vertex 99999999999", "rows of 16"),
            ("float min_g", "float min_h", "min_g"),
            ("f_rest_8", "rest_8", "9, 24 or 45"),
            ("element sh 1", "element sh 0", "1 rows"),
        ] {
            let message = read(&file(|header| header.replace(from, to))).unwrap_err().to_string();
            assert!(message.contains(expected), "{from}: {message}");
        }
    }
}
