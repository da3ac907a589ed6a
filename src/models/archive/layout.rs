//! Layout of the files of a model in an archive: which bytes of each file are values that the archive stores quantized,
//! and which are stored as they are.
//!
//! The layout is stored as JSON in the archive part [`LAYOUT`]. The archive part `file.k` holds the bytes of file k
//! that are no values. Everything read from an archive is checked before it is used: paths stay inside the output
//! folder, and the restored files have at most [`MAX_GROWTH`] times the bytes of the decoded archive, plus 1 MiB.

use std::collections::BTreeSet;
use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use flate2::Crc;
use half::f16;
use serde::{Deserialize, Serialize};
use zip::ZipArchive;

use crate::archive::ArchiveContent;
use crate::error::{Error, Result, quoted};
use crate::model::{Attributes, sh_coefficient_count};

/// Name of the archive part with the layout.
pub(super) const LAYOUT: &str = "layout";
/// Maximum size of all restored files, as a multiple of the bytes of the decoded archive. The files may be larger than
/// the archive, because training checkpoints hold two optimizer values per parameter, which an archive does not store.
const MAX_GROWTH: u64 = 4;
/// Number of bytes that the restored files may have in addition to [`MAX_GROWTH`] times the decoded archive.
const BASE_BYTES: u64 = 1 << 20;
/// Maximum length in bytes of the layout. The layout of a model with one row of values per frame takes about 100 bytes
/// per frame.
const MAX_LAYOUT_BYTES: usize = 4 << 20;
/// Maximum length in bytes of a path in an archive.
const MAX_PATH: usize = 256;
/// File names that Windows reserves for devices, also if a period and any text follow.
const DEVICES: [&str; 4] = ["con", "prn", "aux", "nul"];
/// Beginnings of file names that Windows reserves for devices if a digit follows, such as `com1`.
const NUMBERED_DEVICES: [&str; 2] = ["com", "lpt"];
/// Number by which the bits of a half-precision number, read as an integer, increase when the number is doubled. One
/// doubling is one octave.
const BITS_PER_OCTAVE: f32 = 1024.0;

/// Layout of a model in an archive: the files of the model, and which bytes of each file are values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Layout {
    /// Whether the model is a folder; `false` if the model is a single file.
    pub(super) folder: bool,
    pub(super) files: Vec<FileLayout>,
}

/// Path of one file of a model, and the parts of the file that the archive stores as values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FileLayout {
    /// Path of the file relative to the model folder, with `/` between names. For a model of a single file: its name.
    pub(super) path: String,
    /// Parts of the file that hold values, in order and without overlap.
    pub(super) spans: Vec<Span>,
}

impl FileLayout {
    /// Returns whether `path` equals the path of this file, ignoring the case of ASCII letters. Both paths would then
    /// name the same file on some operating systems.
    pub(super) fn has_path(&self, path: &str) -> bool {
        self.path.eq_ignore_ascii_case(path)
    }
}

/// Contiguous part of a file that consists of values, or of bytes that are restored as zeros.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Span {
    /// Offset of this part from the start of the file, in bytes.
    pub(super) at: u64,
    pub(super) of: Values,
}

/// Content of a [`Span`], which is a contiguous part of a file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Values {
    /// Rows of the given fields, one row per Gaussian in the order of the archive.
    Rows(Vec<Field>),
    /// All values of the tensor with this name, as f32.
    Tensor(String),
    /// Given number of bytes that the archive does not store and that are restored as zeros.
    Zeros(u64),
}

/// Field of a row of a file; each row holds the values of one Gaussian. The number in a variant is a number of bytes,
/// or the index of a plane (scalar component of all Gaussians). Planes are counted in this order:
/// - planes of position, rotation, log scale, opacity logit and SH coefficients
/// - planes of the columns ([`ArchiveContent::columns`]), which hold all other values of Gaussians
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Field {
    /// Value of the plane (scalar component of all Gaussians) with this index, as f32.
    F32(usize),
    /// Value of the plane (scalar component of all Gaussians) with this index, converted to half precision.
    Half(usize),
    /// Nonnegative half-precision number on a logarithmic scale. The value of the plane (scalar component of all
    /// Gaussians) with this index is the bits of the number, read as an integer, divided by 1024. It is about 15 plus
    /// the binary logarithm of the number.
    Octaves(usize),
    /// Byte that is 255 times the value of the plane (scalar component of all Gaussians) with this index.
    Byte(usize),
    /// Given number of bytes that the archive stores unchanged for each Gaussian ([`ArchiveContent::extra_bytes`]).
    Bytes(usize),
    /// Given number of bytes that the archive does not store and that are restored as zeros.
    Zeros(usize),
}

impl Field {
    /// Returns the number of bytes that the field takes in each row.
    pub(super) fn bytes(self) -> usize {
        match self {
            Field::F32(_) => 4,
            Field::Half(_) | Field::Octaves(_) => 2,
            Field::Byte(_) => 1,
            Field::Bytes(count) | Field::Zeros(count) => count,
        }
    }

    /// Decodes the value of the field from its bytes `stored`. Returns `None` if the field holds no value of an
    /// attribute or column, but bytes that are kept unchanged or are zero.
    pub(super) fn decode(self, stored: &[u8]) -> Option<f32> {
        let half = || Some(f16::from_le_bytes(stored.try_into().ok()?));
        match self {
            Field::F32(_) => Some(f32::from_le_bytes(stored.try_into().ok()?)),
            Field::Half(_) => Some(half()?.to_f32()),
            // The sign of scales and widths has no effect on renders.
            Field::Octaves(_) => Some(f32::from(half()?.to_bits() & 0x7fff) / BITS_PER_OCTAVE),
            Field::Byte(_) => Some(f32::from(*stored.first()?) / 255.0),
            Field::Bytes(_) | Field::Zeros(_) => None,
        }
    }

    /// Encodes `value` as this field, and writes the result to `stored`, the bytes of the field in a row.
    fn encode(self, value: f32, stored: &mut [u8]) {
        let limit = f16::MAX.to_f32();
        match self {
            Field::F32(_) => stored.copy_from_slice(&value.to_le_bytes()),
            Field::Half(_) => stored.copy_from_slice(&f16::from_f32(value.clamp(-limit, limit)).to_le_bytes()),
            Field::Octaves(_) => {
                let most = f32::from(f16::MAX.to_bits());
                let bits = (value * BITS_PER_OCTAVE).round_ties_even().clamp(0.0, most) as u16;
                stored.copy_from_slice(&bits.to_le_bytes());
            }
            Field::Byte(_) => stored.fill((value * 255.0).round_ties_even().clamp(0.0, 255.0) as u8),
            Field::Bytes(_) | Field::Zeros(_) => stored.fill(0),
        }
    }
}

/// Returns the index, in an archive, of the first plane (scalar component of all Gaussians) after those of the standard
/// attributes: position, rotation, log scale, opacity and SH coefficients. The planes from this index on hold values
/// that only the model's format has. `sh_degree` determines the number of SH planes.
pub(super) fn first_column_plane(sh_degree: usize) -> usize {
    first_plane(Attributes::SH) + 3 * sh_coefficient_count(sh_degree)
}

/// Returns the index of the first plane (scalar component) of `attribute` in an archive.
pub(super) fn first_plane(attribute: Attributes) -> usize {
    match attribute {
        Attributes::POSITION => 0,
        Attributes::ROTATION => 3,
        Attributes::LOG_SCALE => 7,
        Attributes::OPACITY => 10,
        _ => 11,
    }
}

/// Returns the values of the plane (scalar component of all Gaussians) with index `plane` in the archive content
/// `content`; `None` if there is no such plane.
fn values_of(content: &ArchiveContent, plane: usize) -> Option<&[f32]> {
    let cloud = &content.cloud;
    let all = Attributes::all();
    if let Some(attribute) = all.iter().filter(|&attribute| first_plane(attribute) <= plane).last() {
        let (values, c) = (cloud.attribute_values(attribute), plane - first_plane(attribute));
        if c < values.width() {
            return Some(values.plane(c));
        }
    }
    let mut c = plane.checked_sub(first_column_plane(cloud.sh_degree()))?;
    for column in &content.columns {
        if c < column.values.width() {
            return Some(column.values.plane(c));
        }
        c -= column.values.width();
    }
    None
}

/// Returns the name of the archive part with the remaining bytes of file `k`: all its bytes except the values that the
/// archive holds as planes and tensors.
pub(super) fn rest_name(k: usize) -> String {
    format!("file.{k}")
}

/// Returns whether a name of a file or folder in an archive may contain `c`.
fn is_plain_char(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.' | ' ' | '+')
}

/// Replaces each character of `path` that an archive does not allow by `_` ([`is_plain_char`]; `/` stays). Returns the
/// resulting path, or `None` if an archive does not allow it for another reason ([`is_plain`]).
pub(super) fn plain_path(path: &str) -> Option<String> {
    let plain: String = path.chars().map(|c| if c == '/' || is_plain_char(c) { c } else { '_' }).collect();
    is_plain(&plain).then_some(plain)
}

/// Returns whether an archive allows `path` as the path of a file. It must be relative, have at most [`MAX_PATH`]
/// bytes, stay inside its folder, and have names that every operating system allows.
fn is_plain(path: &str) -> bool {
    let is_plain_name = |name: &str| {
        let stem = name.split('.').next().unwrap_or_default().to_ascii_lowercase();
        let is_numbered = NUMBERED_DEVICES
            .iter()
            .any(|device| stem.strip_prefix(device).is_some_and(|rest| rest.len() == 1 && rest != "0"));
        !name.is_empty()
            && !name.starts_with(['.', ' '])
            && !name.ends_with(['.', ' '])
            && name.chars().all(is_plain_char)
            && !DEVICES.contains(&&*stem)
            && !is_numbered
    };
    path.len() <= MAX_PATH && path.split('/').all(is_plain_name)
}

/// Returns the error for a damaged layout in the archive at `path`.
fn damaged(path: &Path, expected: &str, found: impl Into<String>) -> Error {
    Error::input(path, LAYOUT, expected, found.into()).hint("the archive is damaged; copy it again")
}

impl Layout {
    /// Reads the layout of a model's files from `content`, the content of the archive at `path`. Returns `None` if the
    /// archive holds a model without a layout.
    ///
    /// # Errors
    /// Fails if the layout is malformed.
    pub(super) fn read(content: &ArchiveContent, path: &Path) -> Result<Option<Layout>> {
        let Some(text) = content.files.get(LAYOUT) else { return Ok(None) };
        if text.len() > MAX_LAYOUT_BYTES {
            let found = format!("{} bytes", text.len());
            return Err(damaged(path, &format!("at most {MAX_LAYOUT_BYTES} bytes"), found));
        }
        let layout: Layout = serde_json::from_slice(text)
            .map_err(|error| damaged(path, "the files of a model as JSON", error.to_string()))?;
        if let Some(file) = layout.files.iter().find(|file| !is_plain(&file.path)) {
            let found = quoted(&file.path);
            return Err(damaged(path, "relative paths of letters, digits, _, -, +, . and spaces", found));
        }
        // Some file systems ignore case.
        let mut names = BTreeSet::new();
        if let Some(file) = layout.files.iter().find(|file| !names.insert(file.path.to_ascii_lowercase())) {
            return Err(damaged(path, "one file for each path", format!("two files at {}", file.path)));
        }
        let is_single = layout.files.len() == 1 && layout.files.iter().all(|file| !file.path.contains('/'));
        if !layout.folder && !is_single {
            return Err(damaged(path, "one file", format!("{} files outside a folder", layout.files.len())));
        }
        Ok(Some(layout))
    }

    /// Writes the files of the model in `content` into the folder `folder`. Returns the path of the model: the folder
    /// itself, or the only file in it. `path` is the path of the archive, for messages.
    ///
    /// # Errors
    /// Fails if the content does not match the layout or a write fails.
    pub(super) fn restore(&self, content: &ArchiveContent, path: &Path, folder: &Path) -> Result<PathBuf> {
        let name =
            self.files.first().filter(|_| !self.folder).map_or(folder.to_owned(), |file| folder.join(&file.path));
        self.write(content, path, &name)?;
        Ok(name)
    }

    /// Writes the model in `content` to `to`: a folder, or a file if the model is a single file. `path` is the path of
    /// the archive, for messages.
    ///
    /// # Errors
    /// Fails if the content does not match the layout or a write fails.
    pub(super) fn write(&self, content: &ArchiveContent, path: &Path, to: &Path) -> Result<()> {
        self.check_size(content, path)?;
        // Number of extra bytes per Gaussian that the files so far have used.
        let mut extra_offset = 0;
        for (k, file) in self.files.iter().enumerate() {
            let bytes = assemble(content, k, file, &mut extra_offset)
                .ok_or_else(|| damaged(path, "places of values that match the archive", file.path.clone()))?;
            let target = if self.folder { to.join(&file.path) } else { to.to_owned() };
            if let Some(parent) = target.parent().filter(|_| self.folder) {
                fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
            }
            fs::write(&target, bytes).map_err(Error::io("write", &target))?;
        }
        Ok(())
    }

    /// Checks that the restored files are not far larger than the decoded archive; only damage can make them so large.
    /// `path` is the path of the archive, for messages.
    fn check_size(&self, content: &ArchiveContent, path: &Path) -> Result<()> {
        let count = content.cloud.len() as u64;
        let values = Attributes::all().iter().map(|attribute| content.cloud.attribute_values(attribute).planes().len());
        let columns = content.columns.iter().map(|column| column.values.planes().len());
        let tensors = content.tensors.values().map(|tensor| tensor.data.len());
        let values: usize = values.chain(columns).chain(tensors).sum();
        let files: usize = content.files.values().map(Vec::len).sum();
        let stored = 4 * values as u64 + (files + content.extra_bytes.len()) as u64;
        let of_span = |span: &Span| match &span.of {
            Values::Rows(fields) => {
                fields.iter().fold(0u64, |sum, field| sum.saturating_add(field.bytes() as u64)).saturating_mul(count)
            }
            Values::Tensor(name) => content.tensors.get(name).map_or(0, |tensor| 4 * tensor.data.len() as u64),
            Values::Zeros(bytes) => *bytes,
        };
        let spans = self.files.iter().flat_map(|file| &file.spans).map(of_span);
        let restored = spans.fold(files as u64, u64::saturating_add);
        let most = stored.saturating_mul(MAX_GROWTH).saturating_add(BASE_BYTES);
        match restored <= most {
            true => Ok(()),
            false => Err(damaged(path, &format!("files of at most {most} bytes"), format!("{restored} bytes"))),
        }
    }
}

/// Returns the restored bytes of `file`, which is file number `k` of the model. Returns `None` if the layout of the
/// file does not match the content of the archive.
///
/// Archives store some bytes of each Gaussian unchanged ([`ArchiveContent::extra_bytes`]). `extra_offset` is the number
/// of these bytes, per Gaussian, that earlier files have used. The function adds the number that this file uses.
fn assemble(content: &ArchiveContent, k: usize, file: &FileLayout, extra_offset: &mut usize) -> Option<Vec<u8>> {
    let mut rest = content.files.get(&rest_name(k))?.as_slice();
    let mut out = Vec::new();
    for span in &file.spans {
        let (before, after) = rest.split_at_checked(usize::try_from(span.at).ok()?.checked_sub(out.len())?)?;
        out.extend_from_slice(before);
        rest = after;
        match &span.of {
            Values::Zeros(bytes) => out.resize(out.len() + usize::try_from(*bytes).ok()?, 0),
            Values::Tensor(name) => {
                out.extend(content.tensors.get(name)?.data.iter().flat_map(|value| value.to_le_bytes()));
            }
            Values::Rows(fields) => add_rows(content, fields, extra_offset, &mut out)?,
        }
    }
    out.extend_from_slice(rest);
    if !file.spans.is_empty() && out.starts_with(b"PK\x03\x04") {
        repair_checksums(&mut out)?;
    }
    Some(out)
}

/// Appends one row for each Gaussian to `out`; a row consists of `fields`. Returns `None` if the content of the archive
/// has no values for a field.
///
/// `extra_offset` is the number of bytes of [`ArchiveContent::extra_bytes`], per Gaussian, that earlier parts of the
/// files have used. The function adds the number that these rows use.
fn add_rows(content: &ArchiveContent, fields: &[Field], extra_offset: &mut usize, out: &mut Vec<u8>) -> Option<()> {
    let (count, start) = (content.cloud.len(), out.len());
    if count == 0 {
        return Some(());
    }
    let stride: usize = fields.iter().map(|field| field.bytes()).sum();
    let extra_bytes_per_gaussian = content.extra_bytes.len() / count;
    out.resize(start + stride * count, 0);
    let rows = &mut out[start..];
    let mut at = 0;
    for &field in fields.iter().filter(|field| field.bytes() > 0) {
        let bytes = field.bytes();
        match field {
            Field::F32(plane) | Field::Half(plane) | Field::Octaves(plane) | Field::Byte(plane) => {
                let values = values_of(content, plane)?;
                for (row, &value) in rows.chunks_exact_mut(stride).zip(values) {
                    field.encode(value, &mut row[at..at + bytes]);
                }
            }
            Field::Bytes(_) => {
                let from = *extra_offset..extra_offset.checked_add(bytes)?;
                if from.end > extra_bytes_per_gaussian {
                    return None;
                }
                for (row, stored) in
                    rows.chunks_exact_mut(stride).zip(content.extra_bytes.chunks_exact(extra_bytes_per_gaussian))
                {
                    row[at..at + bytes].copy_from_slice(&stored[from.clone()]);
                }
                *extra_offset += bytes;
            }
            Field::Zeros(_) => (),
        }
        at += bytes;
    }
    Some(())
}

/// Replaces the checksums of the uncompressed files in the zip archive `bytes` by those of the files' present content.
/// A checksum of 0, which PyTorch writes if it did not compute one, stays 0. Returns `None` if the bytes are no zip
/// archive.
fn repair_checksums(bytes: &mut [u8]) -> Option<()> {
    /// Offsets in bytes of a file's checksum in a zip archive: from the start of the header before the file, and from
    /// the start of the file's entry in the central directory.
    const CHECKSUM_AT: [usize; 2] = [14, 16];
    /// Bit in the flags of a file of a zip archive: if it is set, a record with the checksum follows the file.
    const RECORD_FOLLOWS: u8 = 1 << 3;
    const RECORD_MAGIC: &[u8] = b"PK\x07\x08";
    let mut sums = Vec::new();
    // Files in an archive do not overlap. The sum of their lengths bounds the time that the checksums take.
    let mut unread = bytes.len();
    let mut archive = ZipArchive::new(Cursor::new(&bytes[..])).ok()?;
    for index in 0..archive.len() {
        let entry = archive.by_index_raw(index).ok()?;
        let start = usize::try_from(entry.data_start()).ok()?;
        let data = bytes.get(start..start.checked_add(usize::try_from(entry.compressed_size()).ok()?)?)?;
        unread = unread.checked_sub(data.len())?;
        if entry.crc32() == 0 || entry.compression() != zip::CompressionMethod::Stored {
            continue;
        }
        let mut sum = Crc::new();
        sum.update(data);
        let header = usize::try_from(entry.header_start()).ok()?;
        let listed = usize::try_from(entry.central_header_start()).ok()?;
        let mut places = vec![listed.checked_add(CHECKSUM_AT[1])?];
        match bytes.get(header.checked_add(6)?)? & RECORD_FOLLOWS {
            0 => places.push(header + CHECKSUM_AT[0]),
            _ => {
                let after = start + data.len();
                let has_magic = bytes.get(after..after + 4) == Some(RECORD_MAGIC);
                places.push(if has_magic { after + 4 } else { after });
            }
        }
        sums.push((places, sum.sum()));
    }
    drop(archive);
    for (places, sum) in sums {
        for place in places {
            bytes.get_mut(place..place + 4)?.copy_from_slice(&sum.to_le_bytes());
        }
    }
    Some(())
}
