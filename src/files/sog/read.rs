//! Reader of `.sog` files, and of folders that hold the same files without an archive.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use flate2::Crc;
use serde_json::Value;
use zip::ZipArchive;

use super::codebook::Codebook;
use super::images::{
    Range3, decode_by_codebook, decode_label, decode_opacity, decode_position, decode_rotation, palette_entry,
};
use super::{META_FILE, Meta, PaletteEntry, VERSION};
use crate::error::{Error, Result, quoted};
use crate::files::json;
use crate::files::open::{open_file, read_small};
use crate::files::text::decode_text;
use crate::files::webp::RgbaImage;
use crate::files::zip_directory::{check_checksum, declared_directory};
use crate::limits::ReadLimit;
use crate::model::{Gaussians, MAX_SH_DEGREE, sh_coefficient_count};

/// Maximum length in bytes of `meta.json`; three codebooks take about 20 kB.
const MAX_META_BYTES: u64 = 1 << 20;
/// Maximum number of files in a `.sog` archive.
const MAX_ENTRIES: u64 = 1024;
/// Maximum length in bytes of the list of files at the end of a `.sog` archive.
const MAX_LIST_BYTES: u64 = 4 << 20;
/// Bytes of memory per pixel while an image is decoded: the image and the buffers of the decoder.
const BYTES_PER_PIXEL: u64 = 16;
/// Maximum number of large images (those with one pixel per Gaussian) that are in memory at the same time while a file
/// is read.
const MAX_LARGE_IMAGES: u64 = 6;
/// Maximum number of pixels of the image that holds the palette of SH coefficients: 65536 entries with 15 pixels each,
/// one per coefficient of degrees 1 to 3.
const MAX_PALETTE_PIXELS: usize = 15 << 16;
/// Largest accepted magnitude of a logarithmic coordinate sign(x)·ln(|x| + 1). The coordinate x is then finite as f32.
const MAX_LOG_COORDINATE: f64 = 88.0;
/// Largest accepted magnitude of a stored SH coefficient and of the logarithm of a scale.
const MAX_CODEBOOK_VALUE: f32 = 1e30;

/// Reads the Gaussians of the `.sog` file at `path`, in the order in which the file holds them. `path` may also be a
/// folder with the files of such an archive.
///
/// # Errors
/// Fails if the file is damaged, has another version than 2, or needs more memory than `memory`.
pub fn read_sog(path: &Path, memory: ReadLimit) -> Result<Gaussians> {
    let mut files = if path.is_dir() { SogFiles::Folder(path.to_owned()) } else { SogFiles::open_archive(path)? };
    let text = files.read(path, META_FILE, ReadLimit::new(MAX_META_BYTES))?;
    decode(&parse(&text, path)?, &mut files, path, memory)
}

/// Decodes the Gaussians that `meta` describes from the images in `files`, in the order of the pixels. Messages call
/// the archive `path`.
///
/// # Errors
/// Fails if an image is missing or damaged, or if more memory than `memory` is needed.
pub(crate) fn decode(meta: &Meta, files: &mut SogFiles, path: &Path, memory: ReadLimit) -> Result<Gaussians> {
    let count = meta.count as usize;
    if meta.count > u64::from(u32::MAX) {
        return Err(Error::input(path, "meta.json, count", "at most 4294967295", meta.count.to_string()));
    }
    let widest = 4 * 3 * sh_coefficient_count(MAX_SH_DEGREE) as u64 + 4 * 11;
    let per_gaussian = widest + MAX_LARGE_IMAGES * BYTES_PER_PIXEL;
    memory.check(path, "meta.json, count", "the Gaussians of the file", meta.count.saturating_mul(per_gaussian))?;
    let mut of_gaussians = |name: &str| files.image_of_gaussians(path, name, count, memory);
    let [low, high] = [of_gaussians(&meta.means.files[0])?, of_gaussians(&meta.means.files[1])?];
    let [scales, quats, sh0] =
        [&meta.scales.files[0], &meta.quats.files[0], &meta.sh0.files[0]].map(|name| of_gaussians(name));
    let (scales, quats, sh0) = (scales?, quats?, sh0?);
    let labels = meta.sh_n.as_ref().map(|entry| of_gaussians(&entry.files[1])).transpose()?;
    let palette = match &meta.sh_n {
        Some(entry) => {
            Some(read_palette(entry, &files.image(path, &entry.files[0], MAX_PALETTE_PIXELS, memory)?, path)?)
        }
        None => None,
    };
    let range = read_range(meta, path)?;
    let scale_book = codebook(&meta.scales.codebook, path, "scales")?;
    let dc_book = codebook(&meta.sh0.codebook, path, "sh0")?;
    let degree = palette.as_ref().map_or(0, |palette| palette.degree);
    let mut gaussians = Gaussians::zeros(count, degree);
    let at = |i: usize, image: &str| format!("{image}, Gaussian {i}");
    for i in 0..count {
        let rotation = decode_rotation(quats.pixels[i]).ok_or_else(|| {
            let found = quats.pixels[i][3].to_string();
            Error::input(path, at(i, &meta.quats.files[0]), "an alpha of 252, 253, 254 or 255", found)
        })?;
        let value = |book: &Codebook, pixel: [u8; 4], image: &str| {
            decode_by_codebook(book, pixel).ok_or_else(|| {
                let expected = format!("indices below {}, the length of the codebook", book.entries().len());
                Error::input(path, at(i, image), expected, format!("{}, {}, {}", pixel[0], pixel[1], pixel[2]))
            })
        };
        gaussians.position.set_row(i, decode_position(&range, low.pixels[i], high.pixels[i]));
        gaussians.rotation.set_row(i, rotation);
        gaussians.log_scale.set_row(i, value(&scale_book, scales.pixels[i], &meta.scales.files[0])?);
        gaussians.opacity_logit.set_row(i, [decode_opacity(sh0.pixels[i][3])]);
        let dc = value(&dc_book, sh0.pixels[i], &meta.sh0.files[0])?;
        (0..3).for_each(|c| gaussians.sh.plane_mut(c)[i] = dc[c]);
    }
    if let (Some(palette), Some(labels), Some(entry)) = (&palette, &labels, &meta.sh_n) {
        let label = |i: usize| decode_label(labels.pixels[i]);
        if let Some(i) = (0..count).find(|&i| label(i) >= palette.count) {
            let expected = format!("a label below {}, the number of palette entries", palette.count);
            return Err(Error::input(path, at(i, &entry.files[1]), expected, label(i).to_string()));
        }
        for plane in 0..palette.width {
            let values = gaussians.sh.plane_mut(3 + plane);
            values.iter_mut().enumerate().for_each(|(i, to)| *to = palette.values[label(i) * palette.width + plane]);
        }
    }
    Ok(gaussians)
}

/// Source of the files of a `.sog` archive: the archive itself, or a folder with the same files.
pub(crate) enum SogFiles {
    Archive(ZipArchive<BufReader<File>>),
    Folder(PathBuf),
}

impl SogFiles {
    /// Opens the ZIP archive at `path`. Fails if the file is no ZIP archive or has too many files.
    pub(crate) fn open_archive(path: &Path) -> Result<SogFiles> {
        let damaged = |found: String| {
            Error::input(path, "", "a ZIP archive of images", found)
                .hint("if the file was copied, copy it again: one that is cut short has lost its list of files")
        };
        let mut file = BufReader::new(open_file(path)?);
        let declared = declared_directory(&mut file).map_err(|error| damaged(error.to_string()))?;
        if declared.entries > MAX_ENTRIES || declared.bytes > MAX_LIST_BYTES {
            return Err(damaged(format!("a list of {} files in {} bytes", declared.entries, declared.bytes)));
        }
        Ok(SogFiles::Archive(ZipArchive::new(file).map_err(|error| damaged(error.to_string()))?))
    }

    /// Reads and decodes the image file called `name`. Error messages call the archive `path`. Fails if the image is
    /// missing or damaged, has more than `max_pixels` pixels, or its file is larger than `memory`.
    fn image(&mut self, path: &Path, name: &str, max_pixels: usize, memory: ReadLimit) -> Result<RgbaImage> {
        // A lossless WebP takes little more than four bytes per pixel, so more cannot come from a valid file.
        let most = ReadLimit::new(memory.bytes().min(8 * max_pixels as u64 + (1 << 20)));
        let bytes = self.read(path, name, most)?;
        let found = RgbaImage::from_webp(&bytes, max_pixels);
        found
            .map_err(|found| Error::input(path, name, format!("a lossless WebP of at most {max_pixels} pixels"), found))
    }

    /// Reads and decodes the image file called `name`, in which the first `count` pixels belong to the Gaussians. Error
    /// messages call the archive `path`; `memory` limits the size of the file.
    ///
    /// # Errors
    /// Fails if the image is missing or damaged, or has less than `count` or more than 4 × `count` + 65536 pixels.
    pub(crate) fn image_of_gaussians(
        &mut self,
        path: &Path,
        name: &str,
        count: usize,
        memory: ReadLimit,
    ) -> Result<RgbaImage> {
        // An image may be larger than needed, but not much.
        let image = self.image(path, name, 4 * count + (1 << 16), memory)?;
        match image.pixels.len() {
            pixels if pixels >= count => Ok(image),
            pixels => Err(Error::input(path, name, format!("{count} pixels, one per Gaussian"), pixels.to_string())),
        }
    }

    /// Reads the file called `name`, which may have at most `memory` bytes. Messages call the archive `path`.
    pub(crate) fn read(&mut self, path: &Path, name: &str, memory: ReadLimit) -> Result<Vec<u8>> {
        match self {
            SogFiles::Archive(archive) => {
                let refused = |error: String| Error::input(path, name, "a file in the archive", quoted(&error));
                let mut entry = archive.by_name(name).map_err(|error| refused(error.to_string()))?;
                memory.check(path, name, "the file", entry.size())?;
                let mut bytes = Vec::new();
                let length = entry.size();
                entry.by_ref().take(length).read_to_end(&mut bytes).map_err(|error| refused(error.to_string()))?;
                let mut sum = Crc::new();
                sum.update(&bytes);
                check_checksum(path, name, [entry.crc32(), sum.sum()])?;
                Ok(bytes)
            }
            SogFiles::Folder(folder) => {
                if name.is_empty() || name.contains(['/', '\\', ':']) || name.starts_with('.') {
                    return Err(Error::input(path, META_FILE, "names of files in this folder", quoted(name)));
                }
                read_small(&folder.join(name), memory.bytes(), "an image")
            }
        }
    }
}

/// Parses `text`, the content of `meta.json`. Fails if it is malformed or has another version than 2.
fn parse(text: &[u8], path: &Path) -> Result<Meta> {
    let meta_path = path.join(META_FILE);
    let value: Value = json::parse(decode_text(&meta_path, text)?, &meta_path)?;
    if value["version"] != VERSION {
        let found = match &value["version"] {
            Value::Null => "none, as in version 1".to_owned(),
            version => quoted(&version.to_string()),
        };
        return Err(Error::input(path, "meta.json, version", VERSION.to_string(), found)
            .hint("splat-transform of PlayCanvas converts other versions: splat-transform OLD.sog NEW.ply"));
    }
    serde_json::from_value(value).map_err(|error| {
        Error::input(path, META_FILE, "the members of version 2 of the format", quoted(&error.to_string()))
    })
}

/// Returns the range of the logarithmic coordinates sign(x)·ln(|x| + 1) of positions that `meta` states, for each of
/// the axes x, y and z. Fails if a range exceeds ±88 ([`MAX_LOG_COORDINATE`]). Messages call the archive `path`.
fn read_range(meta: &Meta, path: &Path) -> Result<Range3> {
    let (mins, maxs) = (meta.means.mins, meta.means.maxs);
    for axis in 0..3 {
        let (min, max) = (mins[axis], maxs[axis]);
        if !(-MAX_LOG_COORDINATE <= min && min <= max && max <= MAX_LOG_COORDINATE) {
            let expected = format!("a range within ±{MAX_LOG_COORDINATE}");
            return Err(Error::input(
                path,
                format!("meta.json, means, axis {axis}"),
                expected,
                format!("{min:.3e} to {max:.3e}"),
            ));
        }
    }
    Ok(Range3 { mins, maxs })
}

/// Builds a codebook (table of the numbers that bytes stand for) from `entries`, 1 to 256 finite numbers in
/// `meta.json`. Error messages name the member `what` of `meta.json`. The first entry may be `None`, because some
/// writers store null there. It then gets the value of the second entry.
fn codebook(entries: &[Option<f32>], path: &Path, what: &str) -> Result<Codebook> {
    let place = || format!("meta.json, {what}, codebook");
    if entries.is_empty() || entries.len() > super::codebook::ENTRIES {
        return Err(Error::input(path, place(), "1 to 256 numbers", entries.len().to_string()));
    }
    let value = |at: usize| match (entries[at], at) {
        (None, 0) => entries.get(1).copied().flatten(),
        (value, _) => value,
    };
    let values: Option<Vec<f32>> =
        (0..entries.len()).map(|at| value(at).filter(|value| value.abs() <= MAX_CODEBOOK_VALUE)).collect();
    values
        .map(Codebook::from_entries)
        .ok_or_else(|| Error::input(path, place(), "finite numbers", "null or a number beyond 1e30"))
}

/// Decoded palette of SH coefficients above degree 0.
struct DecodedPalette {
    degree: usize,
    /// Number of palette entries.
    count: usize,
    /// Number of values per palette entry: red, green and blue of each SH coefficient above degree 0.
    width: usize,
    values: Vec<f32>,
}

/// Decodes the palette of SH coefficients. `image` holds the palette entries, and `entry` is the member of `meta.json`
/// that describes them. Fails if the image does not fit the description. Messages call the archive `path`.
fn read_palette(entry: &PaletteEntry, image: &RgbaImage, path: &Path) -> Result<DecodedPalette> {
    let name = &entry.files[0];
    let degree = (1..=MAX_SH_DEGREE).find(|&degree| image.width == 64 * (sh_coefficient_count(degree) - 1));
    let Some(degree) = degree.filter(|&degree| entry.bands.is_none_or(|bands| bands == degree as u64)) else {
        let expected = match entry.bands {
            Some(bands @ 1..=3) => format!("a width of {} pixels", 64 * (sh_coefficient_count(bands as usize) - 1)),
            _ => "a width of 192, 512 or 960 pixels for 1, 2 or 3 bands".to_owned(),
        };
        return Err(Error::input(path, name, expected, image.width.to_string()));
    };
    let coefficients = sh_coefficient_count(degree) - 1;
    let there = image.pixels.len() / coefficients;
    let count = entry.count.map_or(there, |count| usize::try_from(count).unwrap_or(usize::MAX));
    if count > there {
        return Err(Error::input(path, name, format!("{count} palette entries"), there.to_string()));
    }
    let book = codebook(&entry.codebook, path, "shN")?;
    let mut values = Vec::with_capacity(3 * count * coefficients);
    for label in 0..count {
        for &pixel in palette_entry(image, label).unwrap_or_default() {
            values.extend(decode_by_codebook(&book, pixel).ok_or_else(|| {
                let expected = format!("indices below {}, the length of the codebook", book.entries().len());
                Error::input(
                    path,
                    format!("{name}, entry {label}"),
                    expected,
                    format!("{}, {}, {}", pixel[0], pixel[1], pixel[2]),
                )
            })?);
        }
    }
    Ok(DecodedPalette { degree, count, width: 3 * coefficients, values })
}
