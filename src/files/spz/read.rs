//! Reader of `.spz` files of versions 2, 3 and 4.

use std::io::Read;
use std::path::Path;

use flate2::read::GzDecoder;

use super::{AXIS_SIGNS, HEADER_BYTES_4, MAGIC};
use crate::error::{Error, Result};
use crate::files::open::open_file;
use crate::files::sog::images::decode_opacity;
use crate::limits::ReadLimit;
use crate::model::{Gaussians, MAX_SH_DEGREE, sh_coefficient_count};

/// First two bytes of a gzip file. `.spz` files of versions 2 and 3 are gzip files.
const GZIP: [u8; 2] = [0x1f, 0x8b];
/// Number of bytes of the header of an `.spz` file of version 2 or 3.
const HEADER_BYTES: usize = 16;
/// Maximum SH degree of an `.spz` file.
const MAX_DEGREE: u8 = 4;
/// Bit of the flags in the header of an `.spz` file that says that the file has extensions (optional data, which this
/// reader skips).
const HAS_EXTENSIONS: u8 = 2;
/// Maximum number of bytes of extensions (optional data) in an `.spz` file of version 4. They lie between the header
/// and the table of array sizes.
const MAX_EXTENSION_BYTES: u64 = 1 << 20;
/// Largest zstd window that is accepted when an array is decoded, as the base-2 logarithm of its size in bytes. The
/// window determines the memory that the decoder takes.
const MAX_WINDOW: u32 = 24;

/// Values that the header of an `.spz` file declares.
struct Header {
    version: u32,
    count: usize,
    sh_degree: usize,
    /// Number n of fractional bits of positions, which are stored in units of 2⁻ⁿ scene units.
    bits: i32,
    flags: u8,
}

/// Number of arrays of an `.spz` file. Each array holds one attribute of all Gaussians.
const ARRAYS: usize = 6;

impl Header {
    /// Returns the arrays of the file in their order. Each element is the name of the array and its number of bytes.
    fn arrays(&self) -> [(&'static str, usize); ARRAYS] {
        let rotation = if self.version == 2 { 3 } else { 4 };
        let harmonics = 3 * (sh_coefficient_count(self.sh_degree) - 1);
        [
            ("positions", 9),
            ("opacities", 1),
            ("colors", 3),
            ("scales", 3),
            ("rotations", rotation),
            ("SH coefficients", harmonics),
        ]
        .map(|(name, width)| (name, width * self.count))
    }
}

/// Reads the Gaussians of the `.spz` file at `path`. SH coefficients of degree 4 are left out. Files of versions 2 and
/// 3 are recognized by the magic bytes of gzip.
///
/// # Errors
/// Fails if the file is damaged, has another version than 2, 3 or 4, or needs more memory than `memory`.
pub fn read_spz(path: &Path, memory: ReadLimit) -> Result<Gaussians> {
    let mut file = open_file(path)?;
    let length = file.metadata().map_err(Error::io("read the size of", path))?.len();
    let mut head = Vec::new();
    file.by_ref().take(HEADER_BYTES_4 as u64).read_to_end(&mut head).map_err(Error::io("read", path))?;
    let rest = head.clone();
    let whole = rest.as_slice().chain(file);
    let (header, arrays) = match head.starts_with(&GZIP) {
        true => read_gzip(GzDecoder::new(whole), path, memory)?,
        false => read_streams(whole, &head, length, path, memory)?,
    };
    Ok(decode(&header, &arrays))
}

/// Parses the first 16 bytes of the header of the file at `path`. Fails if a value is invalid, or if the Gaussians need
/// more memory than `memory`.
fn parse_header(bytes: &[u8], path: &Path, memory: ReadLimit) -> Result<Header> {
    let word = |at: usize| bytes.get(at..at + 4).map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    if bytes.len() < HEADER_BYTES {
        return Err(cut(path, format!("a header of {HEADER_BYTES} bytes"), bytes.len()));
    }
    if word(0) != MAGIC {
        return Err(Error::input(path, "byte 0", format!("the magic {MAGIC:#010x}"), format!("{:#010x}", word(0))));
    }
    let (version, count) = (word(4), word(8));
    let (degree, bits, flags) = (bytes[12], bytes[13], bytes[14]);
    if !(2..=4).contains(&version) {
        return Err(Error::input(path, "byte 4, version", "2, 3 or 4", version.to_string()));
    }
    if degree > MAX_DEGREE {
        return Err(Error::input(path, "byte 12, SH degree", "0 to 4", degree.to_string()));
    }
    if bits > 24 {
        return Err(Error::input(path, "byte 13, fractional bits", "at most 24", bits.to_string()));
    }
    let coded = 20 + 3 * (sh_coefficient_count(usize::from(degree)) as u64 - 1);
    let decoded = 4 * (11 + 3 * sh_coefficient_count(MAX_SH_DEGREE) as u64);
    memory.check(path, "byte 8", "the Gaussians of the file", u64::from(count) * (coded + decoded))?;
    Ok(Header { version, count: count as usize, sh_degree: usize::from(degree), bits: i32::from(bits), flags })
}

/// Returns the error for a file that is cut short. `expected` describes the bytes that are missing, and `found` is the
/// number of bytes that are there.
fn cut(path: &Path, expected: String, found: usize) -> Error {
    Error::input(path, "", expected, format!("{found} bytes")).hint("the file is cut short; copy or export it again")
}

/// Reads the header and the arrays of a file of version 2 or 3. `source` returns the decompressed bytes of the file.
fn read_gzip(mut source: impl Read, path: &Path, memory: ReadLimit) -> Result<(Header, [Vec<u8>; ARRAYS])> {
    let damaged = |error: std::io::Error| {
        Error::input(path, "", "an .spz compressed by gzip", error.to_string())
            .hint("the file is damaged or cut short; copy or export it again")
    };
    let mut head = Vec::new();
    source.by_ref().take(HEADER_BYTES as u64).read_to_end(&mut head).map_err(damaged)?;
    let header = parse_header(&head, path, memory)?;
    if header.version == 4 {
        return Err(Error::input(path, "byte 4, version", "2 or 3 in a gzip file", "4"));
    }
    let mut arrays = <[Vec<u8>; ARRAYS]>::default();
    for (array, (name, bytes)) in arrays.iter_mut().zip(header.arrays()) {
        source.by_ref().take(bytes as u64).read_to_end(array).map_err(damaged)?;
        if array.len() < bytes {
            return Err(cut(path, format!("{bytes} bytes of {name}"), array.len()));
        }
    }
    // Extensions may follow the arrays. Reading on also checks the checksum of the file.
    let mut more = [0; 1];
    let follows = source.read(&mut more).map_err(damaged)? > 0;
    if follows && header.flags & HAS_EXTENSIONS == 0 {
        return Err(Error::input(path, "", "the end of the file after its arrays", "more bytes"));
    }
    Ok((header, arrays))
}

/// Reads the header and the arrays of a file of version 4. `source` returns all bytes of the file, and `length` is
/// their number. `head` holds the first bytes of the file once more, at most 32.
fn read_streams(
    mut source: impl Read,
    head: &[u8],
    length: u64,
    path: &Path,
    memory: ReadLimit,
) -> Result<(Header, [Vec<u8>; ARRAYS])> {
    let header = parse_header(head, path, memory)?;
    if header.version != 4 {
        let expected = format!("a file compressed by gzip, as version {} is", header.version);
        return Err(Error::input(path, "byte 0", expected, "the header itself"));
    }
    if head.len() < HEADER_BYTES_4 {
        return Err(cut(path, format!("a header of {HEADER_BYTES_4} bytes"), head.len()));
    }
    let table_at = u64::from(u32::from_le_bytes([head[16], head[17], head[18], head[19]]));
    if !(HEADER_BYTES_4 as u64..=HEADER_BYTES_4 as u64 + MAX_EXTENSION_BYTES).contains(&table_at) {
        return Err(Error::input(path, "byte 16, offset of the table", "32 to 1048608", table_at.to_string()));
    }
    let mut arrays = <[Vec<u8>; ARRAYS]>::default();
    let listed: Vec<_> = arrays.iter_mut().zip(header.arrays()).filter(|(_, (_, bytes))| *bytes > 0).collect();
    if usize::from(head[15]) != listed.len() {
        return Err(Error::input(path, "byte 15, number of streams", listed.len().to_string(), head[15].to_string()));
    }
    let failed = |error| Error::io("read", path)(error);
    let skipped = std::io::copy(&mut source.by_ref().take(table_at), &mut std::io::sink()).map_err(failed)?;
    let mut table = Vec::new();
    source.by_ref().take(16 * listed.len() as u64).read_to_end(&mut table).map_err(failed)?;
    if table.len() < 16 * listed.len() {
        return Err(cut(path, format!("a table of {} streams", listed.len()), skipped as usize + table.len()));
    }
    let sizes: Vec<[u64; 2]> =
        table.as_chunks::<8>().0.as_chunks::<2>().0.iter().map(|pair| pair.map(u64::from_le_bytes)).collect();
    let whole = sizes.iter().try_fold(table_at + table.len() as u64, |sum, [stored, _]| sum.checked_add(*stored));
    if whole != Some(length) {
        let expected = whole.map_or("a file that can exist".to_owned(), |whole| format!("{whole} bytes"));
        return Err(Error::input(path, "", expected + ", the sum of its parts", format!("{length} bytes"))
            .hint("the file is cut short or damaged; copy or export it again"));
    }
    for ((array, (name, expected)), [stored, size]) in listed.into_iter().zip(sizes) {
        if size != expected as u64 {
            return Err(Error::input(path, name, format!("{expected} bytes"), size.to_string()));
        }
        let damaged = |error: std::io::Error| Error::input(path, name, "a zstd stream", error.to_string());
        let mut stored = source.by_ref().take(stored);
        let mut decoder = zstd::stream::read::Decoder::new(&mut stored).map_err(damaged)?;
        decoder.window_log_max(MAX_WINDOW).map_err(damaged)?;
        decoder.take(expected as u64 + 1).read_to_end(array).map_err(damaged)?;
        if array.len() != expected {
            return Err(Error::input(path, name, format!("{expected} bytes"), array.len().to_string()));
        }
        std::io::copy(&mut stored, &mut std::io::sink()).map_err(failed)?;
    }
    Ok((header, arrays))
}

/// Decodes the Gaussians in the arrays of a file with the header `header`.
fn decode(header: &Header, arrays: &[Vec<u8>; ARRAYS]) -> Gaussians {
    let [positions, opacities, colors, scales, rotations, harmonics] = arrays;
    let degree = header.sh_degree.min(MAX_SH_DEGREE);
    let mut gaussians = Gaussians::zeros(header.count, degree);
    let unit = 0.5f64.powi(header.bits);
    let stored_coefficients = sh_coefficient_count(header.sh_degree) - 1;
    let reversed = [1.0, -1.0, -1.0];
    for i in 0..header.count {
        let position: [f32; 3] = std::array::from_fn(|axis| {
            let bytes = &positions[9 * i + 3 * axis..][..3];
            // The sign is in the highest of the three bytes.
            let fixed = i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]]) >> 8;
            (reversed[axis] * f64::from(fixed) * unit) as f32
        });
        gaussians.position.set_row(i, position);
        gaussians.opacity_logit.set_row(i, [decode_opacity(opacities[i])]);
        let byte = |array: &[u8], k: usize| f64::from(array[3 * i + k]);
        gaussians.log_scale.set_row(i, [0, 1, 2].map(|axis| (byte(scales, axis) / 16.0 - 10.0) as f32));
        let [x, y, z, w] = match header.version {
            2 => rotation_of_3_bytes(&rotations[3 * i..][..3]),
            _ => rotation_of_4_bytes(&rotations[4 * i..][..4]),
        };
        gaussians.rotation.set_row(i, [w, x, -y, -z].map(|x| x as f32));
        for c in 0..3 {
            gaussians.sh.plane_mut(c)[i] = ((byte(colors, c) / 255.0 - 0.5) / 0.15) as f32;
        }
        let harmonics = &harmonics[3 * stored_coefficients * i..][..3 * stored_coefficients];
        for (k, (rgb, sign)) in
            harmonics.as_chunks::<3>().0.iter().zip(AXIS_SIGNS).take(sh_coefficient_count(degree) - 1).enumerate()
        {
            for (c, &byte) in rgb.iter().enumerate() {
                gaussians.sh.plane_mut(3 * (k + 1) + c)[i] = sign * (f32::from(byte) - 128.0) / 128.0;
            }
        }
    }
    gaussians
}

/// Returns the quaternion xyzw that version 2 stores in three bytes: x, y and z. The component w is positive and
/// follows from the length 1.
fn rotation_of_3_bytes(bytes: &[u8]) -> [f64; 4] {
    let [x, y, z] = [0, 1, 2].map(|k| f64::from(bytes[k]) / 127.5 - 1.0);
    [x, y, z, (1.0 - (x * x + y * y + z * z)).max(0.0).sqrt()]
}

/// Returns the unit quaternion xyzw that versions 3 and 4 store in four bytes: the index of its largest component,
/// which is positive, and the values of the other three.
fn rotation_of_4_bytes(bytes: &[u8]) -> [f64; 4] {
    let mut word = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    let largest = (word >> 30) as usize;
    let mut q = [0.0; 4];
    for k in (0..4).rev().filter(|&k| k != largest) {
        let magnitude = f64::from(word & 511) / 511.0 * std::f64::consts::FRAC_1_SQRT_2;
        q[k] = if word & 512 == 0 { magnitude } else { -magnitude };
        word >>= 10;
    }
    q[largest] = (1.0 - q.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
    q
}

#[cfg(test)]
mod tests {
    use flate2::Compression;
    use flate2::write::GzEncoder;

    use super::*;
    use crate::files::spz::{SpzVersion, write_spz};
    use crate::files::tests::gaussians_with_sh;
    use crate::model::{AttributeValues, opacity};

    /// Returns 200 Gaussians with SH degree `degree`, whose values differ along all axes.
    fn gaussians(degree: usize) -> Gaussians {
        gaussians_with_sh(200, degree)
    }

    #[test]
    fn both_versions_are_read_within_half_a_step() {
        let folder = tempfile::tempdir().unwrap();
        for (degree, version) in [(0, SpzVersion::V3), (3, SpzVersion::V3), (0, SpzVersion::V4), (2, SpzVersion::V4)] {
            let (state, path) = (gaussians(degree), folder.path().join("a.spz"));
            let step = 2.0 * write_spz(&state, version, &path).unwrap().position;
            let found = read_spz(&path, ReadLimit::NONE).unwrap();
            let near = |a: &AttributeValues, b: &AttributeValues, most: f64, what: &str| {
                assert_eq!(a.width(), b.width(), "{what}");
                for (i, (a, b)) in a.planes().iter().zip(b.planes()).enumerate() {
                    assert!(f64::from((a - b).abs()) <= most, "{what} {i}: {a}, expected {b}");
                }
            };
            near(&found.position, &state.position, 0.5 * step + 1e-6, "position");
            near(&found.log_scale, &state.log_scale, 0.51 / 16.0, "scale");
            near(&found.sh, &state.sh, 8.5 / 128.0, "SH coefficient");
            for i in 0..state.len() {
                let [a, b] = [&found, &state].map(|state| opacity(state.opacity_logit.row::<1>(i)[0]));
                assert!((a - b).abs() <= 0.5 / 255.0 + 1e-7, "opacity {i}: {a}, expected {b}");
                let dot: f32 =
                    found.rotation.row::<4>(i).iter().zip(state.rotation.row::<4>(i)).map(|(a, b)| a * b).sum();
                let length = state.rotation.row::<4>(i).iter().map(|x| x * x).sum::<f32>().sqrt();
                assert!(dot.abs() / length > 0.99999, "rotation {i}: {dot}");
            }
        }
    }

    #[test]
    fn version_2_has_rotations_of_three_bytes() {
        let words: Vec<u8> = [MAGIC, 2, 1].into_iter().flat_map(u32::to_le_bytes).collect();
        let mut bytes = [&words[..], &[0, 12, 0, 0]].concat();
        // Position 1, 2, −1 in units of 2⁻¹², opacity, color, ln s + 10 in sixteenths, rotation.
        bytes.extend([0, 16, 0, 0, 32, 0, 0, 240, 255, 128, 255, 0, 51, 160, 128, 144, 255, 0, 64]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.spz");
        let mut out = GzEncoder::new(Vec::new(), Compression::fast());
        std::io::Write::write_all(&mut out, &bytes).unwrap();
        std::fs::write(&path, out.finish().unwrap()).unwrap();
        let found = read_spz(&path, ReadLimit::NONE).unwrap();
        assert_eq!(found.position.row::<3>(0), [1.0, -2.0, 1.0]);
        assert_eq!(found.log_scale.row::<3>(0), [0.0, -2.0, -1.0]);
        assert_eq!(found.sh.row::<3>(0).map(|x| (1e3 * x).round()), [3333.0, -3333.0, -2000.0]);
        assert_eq!(found.rotation.row::<4>(0).map(|x| (1e3 * x).round()), [0.0, 1000.0, 1000.0, 498.0]);
    }

    #[test]
    fn damaged_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        for version in [SpzVersion::V3, SpzVersion::V4] {
            let path = folder.path().join("a.spz");
            write_spz(&gaussians(1), version, &path).unwrap();
            let whole = std::fs::read(&path).unwrap();
            for length in (0..whole.len()).step_by(if whole.len() > 400 { 37 } else { 1 }) {
                std::fs::write(&path, &whole[..length]).unwrap();
                let message = read_spz(&path, ReadLimit::NONE).unwrap_err().to_string();
                assert!(message.contains("a.spz"), "{length}: {message}");
            }
            std::fs::write(&path, [&whole[..], &[0; 9]].concat()).unwrap();
            let trailing = read_spz(&path, ReadLimit::NONE);
            assert!(version == SpzVersion::V3 || trailing.is_err());
            std::fs::write(&path, &whole).unwrap();
            let message = read_spz(&path, ReadLimit::new(1000)).unwrap_err().to_string();
            assert!(message.contains("--memory"), "{message}");
        }
    }
}
