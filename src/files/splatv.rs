//! Reads and writes `.splatv` files of the players splaTV and WebGS. The position of each Gaussian is a cubic
//! polynomial in time, and its opacity rises and falls like a Gaussian function of time (its temporal window).
//!
//! Layout, little-endian: u32 [`MAGIC`], u32 length of a JSON text, the JSON text, and the texture that this text
//! describes. The text is a list; the entry of type `splat` in it has `size` (bytes of the texture), `texwidth` and
//! `texheight` (columns and rows of the texture, in texels) and `cameras`. The texture holds one row of [`ROW_BYTES`]
//! bytes per Gaussian ([`SplatvGaussian`]), then zeros. Source: antmatter15/splaTV.

pub mod rows;
pub mod write;

use std::ops::Range;
use std::path::{Path, PathBuf};

use half::f16;
use serde_json::Value;

use super::map::FileMap;
use crate::error::{Error, Result, quoted};

/// First 32-bit word of every `.splatv` file.
pub const MAGIC: u32 = 0x674b;
/// Number of texels in one line of the texture, which holds 1024 Gaussians.
pub const TEXELS_PER_ROW: usize = 4096;
/// Number of bytes that store one Gaussian: four texels.
pub const ROW_BYTES: usize = 64;
/// Number of bytes per texel: four 32-bit words.
const TEXEL_BYTES: usize = 16;
/// Maximum length of the JSON text in bytes: enough for about 3000 cameras. The parsed values take up to 30 times as
/// much memory.
const MAX_TEXT_BYTES: usize = 1 << 20;
/// Number of 32-bit words that store one Gaussian.
pub const WORDS_PER_GAUSSIAN: usize = 16;

/// Gaussian whose position is a cubic polynomial of dt = time − center and whose quaternion is linear in dt. Its
/// opacity is multiplied by exp(−(dt/width)²).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SplatvGaussian {
    /// Position at dt = 0 (the center of the temporal window), in scene units.
    pub position: [f32; 3],
    /// Coefficients of dt, dt² and dt³ in the position, x, y, z for each, in scene units.
    pub motion: [f32; 9],
    /// Quaternion wxyz at dt = 0, of any length.
    pub rotation: [f32; 4],
    /// Change of the quaternion `rotation` per unit of time.
    pub omega: [f32; 4],
    /// Standard deviations along the three axes, in scene units.
    pub scale: [f32; 3],
    /// View-independent color (red, green, blue) in [0, 1]. The type is f64 because the writer truncates the color to a
    /// byte instead of rounding it, so the smallest difference can change the byte.
    pub rgb: [f64; 3],
    /// Opacity at dt = 0, its maximum over time, in [0, 1].
    pub opacity: f64,
    /// Time at which the opacity is highest: the center of the temporal window.
    pub center: f32,
    /// Width of the temporal window: √2 × its standard deviation.
    pub width: f32,
}

impl SplatvGaussian {
    /// Decodes a Gaussian from the 32-bit words that store it.
    pub fn from_words(words: &[u32; WORDS_PER_GAUSSIAN]) -> SplatvGaussian {
        let half = |at: usize, high: usize| f16::from_bits((words[at] >> (16 * high)) as u16).to_f32();
        let halves = |first: usize, k: usize| half(first + k / 2, k % 2);
        let byte = |k: usize| f64::from((words[7] >> (8 * k)) & 0xff) / 255.0;
        SplatvGaussian {
            position: std::array::from_fn(|c| f32::from_bits(words[c])),
            rotation: std::array::from_fn(|k| halves(3, k)),
            scale: std::array::from_fn(|k| halves(5, k)),
            rgb: std::array::from_fn(byte),
            opacity: byte(3),
            motion: std::array::from_fn(|k| halves(8, k)),
            omega: std::array::from_fn(|k| halves(13, k)),
            center: half(15, 0),
            width: half(15, 1),
        }
    }
}

/// Returns the number of bytes of the texture up to its last nonzero byte. `texture` is the byte range of the texture
/// in the file `map`.
fn used_bytes(map: &FileMap, texture: Range<usize>) -> usize {
    let mut end = texture.end;
    while end > texture.start {
        let piece = texture.start.max(end.saturating_sub(1 << 20))..end;
        map.touched(piece.clone());
        if let Some(last) = map[piece.clone()].iter().rposition(|&byte| byte != 0) {
            return piece.start + last + 1 - texture.start;
        }
        end = piece.start;
    }
    0
}

/// Open `.splatv` file of moving Gaussians.
#[derive(Debug)]
pub struct Splatv {
    path: PathBuf,
    map: FileMap,
    /// Offset in bytes of the texture in the file.
    start: usize,
    count: usize,
    /// Number of rows (Gaussians and padding) that the texture has according to the header, if the file ends before its
    /// last row; `None` if the file is complete.
    declared: Option<usize>,
    cameras: Value,
}

impl Splatv {
    /// Opens the `.splatv` file at `path`. Rows that contain only zeros at the end of the texture are padding and are
    /// not Gaussians. Some converters do not write these rows, so a file that ends before its texture is accepted.
    ///
    /// # Errors
    /// Fails if the first word is not [`MAGIC`], if the text is not a list with an entry of type `splat`, if the stated
    /// sizes contradict each other, or if the file ends within a Gaussian.
    pub fn open(path: &Path) -> Result<Splatv> {
        let map = FileMap::open(path)?;
        let cut = |expected: String| {
            Error::input(path, "", expected, format!("{} bytes", map.len()))
                .hint("the file is cut short; copy or export it again")
        };
        let word = |at: usize| -> Result<u32> {
            let bytes = map.get(at..at + 4).ok_or_else(|| cut("8 bytes of magic and length".to_owned()))?;
            Ok(u32::from_le_bytes(std::array::from_fn(|k| bytes[k])))
        };
        let magic = word(0)?;
        if magic != MAGIC {
            return Err(Error::input(path, "byte 0", format!("the magic {MAGIC:#06x}"), format!("{magic:#06x}")));
        }
        let start = 8 + word(4)? as usize;
        if start > MAX_TEXT_BYTES && map.len() >= start {
            let expected = format!("a text of at most {MAX_TEXT_BYTES} bytes");
            return Err(Error::input(path, "byte 4", expected, format!("{} bytes", start - 8)));
        }
        let text = map.get(8..start).ok_or_else(|| cut(format!("{start} bytes up to the end of its text")))?;
        let document: Value = serde_json::from_slice(text)
            .map_err(|error| Error::input(path, "its text", "JSON", quoted(&error.to_string())))?;
        let entries = document.as_array().map_or(&[][..], Vec::as_slice);
        let Some(entry) = entries.iter().find(|entry| entry["type"] == "splat") else {
            return Err(Error::input(path, "its text", "a list with an entry of type \"splat\"", "none"));
        };
        if entries.first() != Some(entry) {
            return Err(Error::input(path, "its text", "the entry of type \"splat\" first", "another one"));
        }
        let side = |key: &str| {
            let number = entry[key].as_u64().filter(|&side| side <= 1 << 32);
            number.ok_or_else(|| Error::input(path, format!("its text, {key}"), "a number", entry[key].to_string()))
        };
        let (size, width, height) = (side("size")?, side("texwidth")?, side("texheight")?);
        let expected = width.saturating_mul(height).saturating_mul(TEXEL_BYTES as u64);
        if size != expected || size % ROW_BYTES as u64 != 0 {
            let expected = format!("{expected}, of {width} × {height} texels, whole Gaussians of {ROW_BYTES} bytes");
            return Err(Error::input(path, "its text, size", expected, size.to_string()));
        }
        let there = (map.len() - start) as u64;
        let whole_rows = there / ROW_BYTES as u64;
        if there < size && (whole_rows == 0 || !there.is_multiple_of(ROW_BYTES as u64)) {
            let least = start as u64 + whole_rows.max(1) * ROW_BYTES as u64;
            return Err(cut(format!(
                "{} bytes, {size} of them of its texture, or fewer whole Gaussians of {ROW_BYTES} bytes, such as {least}",
                start as u64 + size
            )));
        }
        let declared = (there < size).then_some((size / ROW_BYTES as u64) as usize);
        let used = used_bytes(&map, start..start + there.min(size) as usize);
        let (count, cameras) = (used.div_ceil(ROW_BYTES), entry["cameras"].clone());
        u32::try_from(count)
            .map_err(|_| Error::input(path, "its texture", "at most 4294967295 Gaussians", count.to_string()))?;
        Ok(Splatv { path: path.to_owned(), start, count, declared, cameras, map })
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the offset in bytes of the first Gaussian in the file.
    pub(crate) fn start(&self) -> usize {
        self.start
    }

    /// Returns N, the number of Gaussians.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Returns a note for the user if the file ends before its texture does.
    pub fn note(&self) -> Option<String> {
        let (declared, rows) = (self.declared?, (self.map.len() - self.start) / ROW_BYTES);
        Some(format!("{rows} rows of {declared} declared: the file ends before its texture is complete"))
    }

    /// Returns the list of cameras as JSON, unchanged from the file.
    pub fn cameras(&self) -> &Value {
        &self.cameras
    }

    /// Returns the 32-bit words that store Gaussian `i`.
    pub fn words(&self, i: usize) -> [u32; WORDS_PER_GAUSSIAN] {
        self.map.touched(self.start + i * ROW_BYTES..self.start + (i + 1) * ROW_BYTES);
        let row = &self.map[self.start + i * ROW_BYTES..][..ROW_BYTES];
        std::array::from_fn(|k| u32::from_le_bytes(std::array::from_fn(|b| row[4 * k + b])))
    }

    /// Checks that the file has not been cut short since it was opened.
    ///
    /// # Errors
    /// Fails if the file is shorter than at opening.
    pub fn check(&self) -> Result<()> {
        self.map.check()
    }
}
