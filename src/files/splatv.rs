//! `.splatv`: Gaussians on cubic paths with windows in time, as splaTV and WebGS read them.
//!
//! u32 [`MAGIC`], u32 length of a JSON text, that text, the texture it describes; all little-endian. The text is a list whose
//! entry of type `splat` has `size` (bytes of the texture), `texwidth`, `texheight` and `cameras`. The texture holds
//! [`ROW_BYTES`] per Gaussian ([`SplatvGaussian`]), then zeros. Source: antmatter15/splaTV.

pub mod rows;
pub mod write;

use std::ops::Range;
use std::path::{Path, PathBuf};

use half::f16;
use serde_json::Value;

use super::map::FileMap;
use crate::error::{Error, Result, quoted};

/// First word of a file.
pub const MAGIC: u32 = 0x674b;
/// Texels of a row of the texture.
pub const TEXELS: usize = 4096;
/// Bytes of a Gaussian, of four texels.
pub const ROW_BYTES: usize = 64;
/// Bytes of a texel: four words.
const TEXEL_BYTES: usize = 16;
/// Longest JSON text: some 3000 cameras. Its values take up to 30 times as much memory.
const MOST_TEXT: usize = 1 << 20;
/// Words of a Gaussian.
pub const WORDS: usize = 16;

/// A Gaussian whose position is a cubic of the time since its center, whose quaternion is linear in it, and whose opacity is
/// multiplied by exp(−((t − center)/width)²).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SplatvGaussian {
    /// Where it is at its center, scene units.
    pub position: [f32; 3],
    /// Coefficients of dt, dt², dt³, each of x, y, z.
    pub motion: [f32; 9],
    /// wxyz of any length.
    pub rotation: [f32; 4],
    /// What is added to `rotation` per unit of time.
    pub omega: [f32; 4],
    /// Standard deviations, scene units.
    pub scale: [f32; 3],
    /// Color from all sides, in [0, 1]; in f64, for bytes are cut, not rounded, so that the last digit can tell.
    pub rgb: [f64; 3],
    /// In [0, 1].
    pub opacity: f64,
    /// Unit of time.
    pub center: f32,
    /// √2 × the standard deviation in time.
    pub width: f32,
}

impl SplatvGaussian {
    /// The Gaussian that `words` hold.
    pub fn of_words(words: &[u32; WORDS]) -> SplatvGaussian {
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

/// Number of bytes of `texture` up to the last one that is not zero.
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

/// An open file.
#[derive(Debug)]
pub struct Splatv {
    path: PathBuf,
    map: FileMap,
    /// Where the texture begins.
    start: usize,
    count: usize,
    /// Rows that the texture would hold, where the data ends before it does.
    declared: Option<usize>,
    cameras: Value,
}

impl Splatv {
    /// Opens the file at `path`. Rows of zeros at the end are padding, which some converters leave out.
    ///
    /// # Errors
    /// Another magic; a text that is no list with an entry of type `splat`; sizes that contradict each other; data that end
    /// within a Gaussian.
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
        if start > MOST_TEXT && map.len() >= start {
            let expected = format!("a text of at most {MOST_TEXT} bytes");
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

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// N, the number of Gaussians.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Returns a note about data that end before the texture does.
    pub fn note(&self) -> Option<String> {
        let (declared, rows) = (self.declared?, (self.map.len() - self.start) / ROW_BYTES);
        Some(format!("{rows} rows of {declared} declared: the file is not padded to whole rows of its texture"))
    }

    /// Its cameras, as they stand in it.
    pub fn cameras(&self) -> &Value {
        &self.cameras
    }

    /// The words of Gaussian `i`.
    pub fn words(&self, i: usize) -> [u32; WORDS] {
        self.map.touched(self.start + i * ROW_BYTES..self.start + (i + 1) * ROW_BYTES);
        let row = &self.map[self.start + i * ROW_BYTES..][..ROW_BYTES];
        std::array::from_fn(|k| u32::from_le_bytes(std::array::from_fn(|b| row[4 * k + b])))
    }

    /// Confirms that the file still has its bytes.
    ///
    /// # Errors
    /// A file cut short since it was opened.
    pub fn check(&self) -> Result<()> {
        self.map.check()
    }
}
