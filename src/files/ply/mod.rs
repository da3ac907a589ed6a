//! Reads Gaussians from a PLY file in the INRIA layout and its variants.
//!
//! Input: a path. Output: the attributes of any Gaussians as f32, and the stored rows (one per Gaussian) for writers
//! that copy them. Memory: 2 MiB of the mapped file; a text file is first converted to a scratch file, which is mapped
//! instead. Source: 3D Gaussian Splatting (Kerbl et al., 2023), `save_ply` of its public code.
//!
//! Accepted: text, and binary of either byte order; any number type per property; properties in any order, extra
//! properties, no normals; comments; LF or CRLF; extra elements before or after `vertex`, those with lists only after
//! it; no `scale_2` (2DGS, see [`THIN_LOG_SCALE`]); bytes after the last element. This reader does not refuse NaN
//! values. SH coefficients of degree 4 are left out.

mod ascii;
mod defects;
pub(crate) mod header;
mod layout;
#[cfg(test)]
pub(crate) mod tests;
pub mod write;

use std::io::{self, Read, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

pub(crate) use ascii::{TextRows, TextStore};
use header::Element;
pub(crate) use header::PlyHeader;
pub use header::{PlyEncoding, Property, Scalar};
pub use layout::THIN_LOG_SCALE;
pub(crate) use layout::{PlaneSource, PlyLayout, name_at_sh_degree};

use super::map::FileMap;
use super::open::open_file;
use crate::error::{Error, Result, ShowPath};
use crate::limits::ReadLimit;
use crate::model::{AttributeValues, Attributes, Gaussians, finite_logit};
use crate::progress::Events;
use crate::source::Ids;

/// Returns whether the first 16 KiB of the header of the PLY file at `path` contain `text`. Also returns false if the
/// file cannot be read.
pub(crate) fn header_contains(path: &Path, text: &str) -> bool {
    let mut head = Vec::new();
    let read = open_file(path).is_ok_and(|file| file.take(1 << 14).read_to_end(&mut head).is_ok());
    let header = head.windows(10).position(|bytes| bytes == b"end_header").map_or(&head[..], |end| &head[..end]);
    read && header.windows(text.len()).any(|bytes| bytes == text.as_bytes())
}

/// Maximum number of rows (Gaussians) read together. At SH degree 3 they take 32 KiB, so that all components are read
/// from the processor's cache.
const BLOCK_ROWS: usize = 128;
/// Maximum number of bytes of the rows that are read together.
const BLOCK_BYTES: usize = 1 << 20;

/// Options for reading PLY files.
#[derive(Debug, Clone)]
pub struct PlyOptions {
    /// Folder for the scratch file, which holds the converted rows of text files as long as these are open.
    pub scratch: PathBuf,
    /// Maximum memory in bytes for reading a whole file.
    pub memory: ReadLimit,
    /// Receiver of progress events while Gaussians are linked (matched) from frame to frame.
    pub events: Events,
}

impl Default for PlyOptions {
    fn default() -> Self {
        PlyOptions { scratch: std::env::temp_dir(), memory: ReadLimit::NONE, events: Events::IGNORED }
    }
}

/// Parses the header of a PLY file and returns the number of Gaussians that it declares. `bytes` are the first bytes of
/// the file, and `path` names it in errors. The rows after the header are not checked.
///
/// # Errors
/// Fails like [`Ply::open_with`], as far as the errors depend only on the header.
pub fn check_header(bytes: &[u8], path: &Path) -> Result<u64> {
    let header = PlyHeader::parse(path, bytes)?;
    let vertex = vertex_element(&header, path)?;
    PlyLayout::from_element(path, vertex)?;
    Ok(vertex.count)
}

/// An open PLY file of Gaussians.
#[derive(Debug)]
pub struct Ply {
    path: PathBuf,
    header: PlyHeader,
    layout: PlyLayout,
    stride: usize,
    properties: Vec<Property>,
    body: PlyBody,
    /// Byte range of the rows of the element `vertex` (the Gaussians) in the bytes after the header.
    rows: Range<usize>,
    /// End of the content that writers copy to output files, as an offset in the bytes after the header.
    end: usize,
    count: usize,
    memory: ReadLimit,
}

/// Rows of all elements of an open PLY file: the bytes after the header in memory-mapped binary form.
#[derive(Debug)]
struct PlyBody {
    /// Memory map of the whole file; for a text file, of its converted rows in the scratch file.
    map: FileMap,
    /// Offset in bytes, in `map`, of the rows of the first element.
    start: usize,
    /// For a text file: the length of the file in bytes, and the location of its rows, which were converted to binary.
    /// `None` for a binary file.
    text: Option<(u64, TextRows)>,
}

impl PlyBody {
    /// Returns all bytes after the header, with the rows of text files in binary form.
    fn bytes(&self) -> &[u8] {
        &self.map[self.start..]
    }

    /// Converts a byte range in [`PlyBody::bytes`] to the same range in the memory map.
    fn range(&self, range: Range<usize>) -> Range<usize> {
        self.start + range.start..self.start + range.end
    }
}

impl Ply {
    /// Opens the PLY file at `path` and checks that the file is as long as its header declares. Converted rows of a
    /// text file are kept in the system's folder for temporary files.
    ///
    /// # Errors
    /// Fails like [`Ply::open_with`].
    pub fn open(path: &Path) -> Result<Ply> {
        Self::open_with(path, &PlyOptions::default())
    }

    /// Opens the PLY file at `path` and checks that the file is as long as its header declares.
    ///
    /// # Errors
    /// Fails if the file is not a PLY, if its header is malformed, lacks a property or has a list property, if the
    /// number of `f_rest_*` belongs to no SH degree, if there are more than `u32::MAX` Gaussians or fewer bytes than
    /// the header declares, or if a row of a text file cannot be read.
    pub fn open_with(path: &Path, options: &PlyOptions) -> Result<Ply> {
        Self::open_into(path, options.memory, &TextStore::new(&options.scratch))
    }

    /// Opens the PLY file at `path`. The converted rows of a text file are added to the scratch file `texts`.
    pub(crate) fn open_into(path: &Path, memory: ReadLimit, texts: &TextStore) -> Result<Ply> {
        Self::with_text_rows(path, memory, |header| texts.convert(path, header, open_file(path)?))
    }

    /// Opens the PLY file at `path` again. If it is a text file, `text` holds the rows converted when it was first
    /// opened.
    pub(crate) fn open_again(path: &Path, memory: ReadLimit, text: Option<&TextRows>) -> Result<Ply> {
        Self::with_text_rows(path, memory, |_| text.cloned().ok_or_else(|| encoding_changed(path)))
    }

    /// Opens the PLY file at `path`. If it is a text file, calls `convert`, which receives the header and returns the
    /// location of the rows in binary form.
    fn with_text_rows(
        path: &Path,
        memory: ReadLimit,
        convert: impl FnOnce(&PlyHeader) -> Result<TextRows>,
    ) -> Result<Ply> {
        let map = FileMap::open(path)?;
        let header = PlyHeader::parse(path, &map)?;
        let vertex = vertex_element(&header, path)?;
        let (stride, properties) = (vertex.stride, vertex.properties.clone());
        let layout = PlyLayout::from_element(path, vertex)?;
        let count = u32::try_from(vertex.count)
            .map_err(|_| Error::input(path, "element vertex", "at most 4294967295 rows", vertex.count.to_string()))?;
        let body = match header.encoding {
            PlyEncoding::Ascii => {
                let (length, rows) = (map.len() as u64, convert(&header)?);
                let map = FileMap::from_scratch(&rows.file, rows.range.clone(), path)?;
                PlyBody { map, start: 0, text: Some((length, rows)) }
            }
            PlyEncoding::LittleEndian | PlyEncoding::BigEndian => PlyBody { map, start: header.text.len(), text: None },
        };
        let (rows, end) = vertex_rows(path, &header, body.bytes().len())?;
        let end = if header.skipped.is_empty() { body.bytes().len() } else { end };
        let count = count as usize;
        Ok(Ply { path: path.to_owned(), header, layout, stride, properties, body, rows, end, count, memory })
    }

    /// Returns the converted rows of a text file, to be passed to [`Ply::open_again`]; `None` for a binary file.
    pub(crate) fn text_rows(&self) -> Option<&TextRows> {
        self.body.text.as_ref().map(|(_, rows)| rows)
    }

    /// Reads all attributes of all Gaussians.
    ///
    /// # Errors
    /// Fails if the memory limit for reading would be exceeded, or if the file was truncated since it was opened.
    pub(crate) fn whole(&self) -> Result<Gaussians> {
        let bytes = 4 * Attributes::all().width(self.sh_degree()) as u64 * self.count as u64;
        self.memory.check(&self.path, "element vertex", "the Gaussians of the file", bytes)?;
        let mut out = Gaussians::zeros(self.count, self.sh_degree());
        self.gather_range(0..self.count, Attributes::all(), &mut out)?;
        Ok(out)
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns N, the number of Gaussians.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Returns the SH degree, 0 to 3.
    pub fn sh_degree(&self) -> usize {
        self.layout.sh_degree
    }

    /// Returns the texts of the `comment` lines of the header, in order.
    pub fn comments(&self) -> &[String] {
        &self.header.comments
    }

    /// Returns the properties of a row (Gaussian), in file order.
    pub fn properties(&self) -> &[Property] {
        &self.properties
    }

    /// Writes the attributes `want` of the Gaussians with indices `range` into `out`, as [`Ply::gather`] does.
    pub fn gather_range(&self, range: Range<usize>, want: Attributes, out: &mut Gaussians) -> Result<()> {
        self.gather(&Ids::Range(range), want, out)
    }

    /// Writes the attributes `want` of the Gaussians `ids`, in that order, into `out`, which is resized to their
    /// number. f32 values keep their bits; values of other types are rounded to the nearest f32. An infinite opacity
    /// logit becomes ±[`INFINITE_LOGIT`](crate::model::INFINITE_LOGIT).
    ///
    /// # Errors
    /// Fails if an id is beyond the last Gaussian, or if the file was truncated since it was opened.
    pub fn gather(&self, ids: &Ids<'_>, want: Attributes, out: &mut Gaussians) -> Result<()> {
        self.check_unshrunk()?;
        check_ids(&self.path, ids, self.count)?;
        out.resize(ids.len());
        for column in want.iter() {
            let width = self.layout.planes(column).len();
            if out.attribute_values(column).width() != width {
                *out.attribute_values_mut(column) = AttributeValues::zeros(width, ids.len());
            }
        }
        let rows = &self.body.bytes()[self.rows.clone()];
        let big_endian = self.header.encoding == PlyEncoding::BigEndian;
        let mut starts = Vec::with_capacity(BLOCK_ROWS);
        let mut ids_left = ids.iter();
        // Read fewer rows together if each has thousands of properties, so that few of their pages are in memory.
        let together = (BLOCK_BYTES / self.stride.max(1)).clamp(1, BLOCK_ROWS);
        for first in (0..ids.len()).step_by(together) {
            starts.clear();
            starts.extend(ids_left.by_ref().take(together).map(|id| id * self.stride));
            self.touch(&starts);
            for column in want.iter() {
                for (c, plane) in self.layout.planes(column).iter().enumerate() {
                    if let PlaneSource::Property(property) = plane {
                        let out = &mut out.attribute_values_mut(column).plane_mut(c)[first..first + starts.len()];
                        read_plane(rows, &starts, property, big_endian, out);
                    }
                }
            }
        }
        if want.contains(Attributes::OPACITY) {
            out.opacity_logit.planes_mut().iter_mut().for_each(|logit| *logit = finite_logit(*logit));
        }
        if want.contains(Attributes::LOG_SCALE)
            && self.layout.planes(Attributes::LOG_SCALE).contains(&PlaneSource::Thin)
        {
            for i in 0..ids.len() {
                let [a, b, _] = out.log_scale.row::<3>(i);
                out.log_scale.set_row(i, [a, b, a.min(b) + THIN_LOG_SCALE]);
            }
        }
        Ok(())
    }

    /// Returns the values of the property `name` for all Gaussians, rounded to the nearest f32; `None` if there is no
    /// such property.
    ///
    /// # Errors
    /// Fails if the file was truncated since it was opened.
    pub(crate) fn values(&self, name: &str) -> Result<Option<Vec<f32>>> {
        self.check_unshrunk()?;
        let Some(property) = self.properties.iter().find(|property| property.name == name) else { return Ok(None) };
        let mut values = vec![0.0; self.count];
        let rows = &self.body.bytes()[self.rows.clone()];
        let big_endian = self.header.encoding == PlyEncoding::BigEndian;
        for (block, values) in values.chunks_mut(BLOCK_ROWS).enumerate() {
            let starts: Vec<usize> = (0..values.len()).map(|i| (block * BLOCK_ROWS + i) * self.stride).collect();
            self.touch(&starts);
            read_plane(rows, &starts, property, big_endian, values);
        }
        Ok(Some(values))
    }

    /// Returns the number of bytes that statistics count as read when `rows` Gaussians of this file are read: the size
    /// of their rows. For a text file it is always the length of the whole file.
    pub(crate) fn bytes_read_for(&self, rows: usize) -> u64 {
        match &self.body.text {
            None => (rows * self.stride) as u64,
            Some((stored, _)) => *stored,
        }
    }

    /// Returns the parsed header, for writers that copy it.
    pub(crate) fn header(&self) -> &PlyHeader {
        &self.header
    }

    /// Returns the layout of a row, for writers that change attributes in it.
    pub(crate) fn layout(&self) -> &PlyLayout {
        &self.layout
    }

    /// Returns the bytes of the row of Gaussian `i` in binary form.
    pub(crate) fn row(&self, i: usize) -> &[u8] {
        self.touch(&[i * self.stride]);
        &self.body.bytes()[self.rows.clone()][i * self.stride..(i + 1) * self.stride]
    }

    /// Returns how many bytes writers copy from the file before the rows of `vertex` (the Gaussians), and how many
    /// after them. Both count the binary form of the rows, without the header.
    pub(crate) fn bytes_around(&self) -> [usize; 2] {
        [self.rows.start, self.end - self.rows.end]
    }

    /// Writes the rows of the elements before `vertex` (the Gaussians) to `out`, in binary form.
    pub(crate) fn write_lead(&self, out: &mut dyn Write) -> io::Result<()> {
        self.body.map.pieces(self.body.range(0..self.rows.start), |piece| out.write_all(piece))
    }

    /// Writes the bytes after the rows of `vertex` (the Gaussians) to `out`: in binary form, up to the end of the
    /// content that writers copy.
    pub(crate) fn write_tail(&self, out: &mut dyn Write) -> io::Result<()> {
        self.body.map.pieces(self.body.range(self.rows.end..self.end), |piece| out.write_all(piece))
    }

    /// Returns the maximum memory in bytes for reading the whole file.
    pub(crate) fn memory(&self) -> ReadLimit {
        self.memory
    }

    /// Checks that the mapped file has not been truncated since it was opened.
    pub(crate) fn check_unshrunk(&self) -> Result<()> {
        self.body.map.check()
    }

    /// Records that some rows (Gaussians) are about to be read, so that their memory-mapped pages can be released
    /// later. `starts` holds the byte offset of each row from the first row.
    fn touch(&self, starts: &[usize]) {
        let first = self.body.start + self.rows.start;
        for run in starts.chunk_by(|a, b| a + self.stride == *b) {
            let [start, end] = [run[0], run[run.len() - 1] + self.stride];
            self.body.map.touched(first + start..first + end);
        }
    }
}

/// Returns the element `vertex` of `header`, which holds the Gaussians. Fails if there is none.
fn vertex_element<'a>(header: &'a PlyHeader, path: &Path) -> Result<&'a Element> {
    header.vertex().ok_or_else(|| Error::input(path, "header", "an element \"vertex\"", "none"))
}

/// Returns the error for a file that was binary when it was first opened and is a text file now.
fn encoding_changed(path: &Path) -> Error {
    Error::input(path, "header", "a binary body, as before", "a text body")
        .hint("the file has changed since it was opened")
}

/// Checks that every index in `ids` is below the number of Gaussians `count`.
pub(crate) fn check_ids(path: &Path, ids: &Ids<'_>, count: usize) -> Result<()> {
    let beyond = match ids {
        Ids::Range(range) => (range.end > count && !range.is_empty()).then(|| range.end - 1),
        Ids::List(list) => list.iter().map(|&id| id as usize).find(|&id| id >= count),
    };
    match beyond {
        None => Ok(()),
        Some(id) => {
            Err(Error::internal(format!("{}: Gaussian {id} was asked for, of {count} counted from 0", path.shown())))
        }
    }
}

/// Finds the rows of the Gaussians in the binary form of a PLY file. `available` is the number of bytes after the
/// header. Returns the byte range of the rows of the element `vertex`, and the offset at which the last element that
/// can be read ends; both count from the end of the header. Fails if the file has fewer bytes than its header declares.
fn vertex_rows(path: &Path, header: &PlyHeader, available: usize) -> Result<(Range<usize>, usize)> {
    let mut end = 0u64;
    let mut rows = 0..0;
    for element in &header.elements {
        let start = end;
        let size = element.count.checked_mul(element.stride as u64);
        let Some(next) = size.and_then(|size| start.checked_add(size)).filter(|&next| next <= available as u64) else {
            let place = format!("element {}", element.name);
            let size = size.map_or("far too many".to_owned(), |size| size.to_string());
            let expected = format!("{} rows × {} bytes = {size} bytes", element.count, element.stride);
            return Err(Error::input(path, place, expected, format!("{} bytes", available as u64 - start))
                .hint("the file is cut short; copy or export it again"));
        };
        end = next;
        if element.name == "vertex" {
            // Both values fit into usize, because they are at most `available`.
            rows = start as usize..next as usize;
        }
    }
    Ok((rows, end as usize))
}

/// Reads the values of `property` for some Gaussians into `out`, converted to f32. `rows` holds the bytes of the rows,
/// and `starts` the offset in `rows` of the row of each of these Gaussians. `big_endian` says whether the numbers are
/// big-endian.
pub(crate) fn read_plane(rows: &[u8], starts: &[usize], property: &Property, big_endian: bool, out: &mut [f32]) {
    let at = property.offset;
    match (property.scalar, big_endian) {
        (Scalar::F32, false) => fill(rows, starts, at, out, f32::from_le_bytes),
        (Scalar::F32, true) => fill(rows, starts, at, out, f32::from_be_bytes),
        (Scalar::F64, false) => fill(rows, starts, at, out, |b| f64::from_le_bytes(b) as f32),
        (Scalar::F64, true) => fill(rows, starts, at, out, |b| f64::from_be_bytes(b) as f32),
        (Scalar::I8, _) => fill(rows, starts, at, out, |b| i8::from_le_bytes(b).into()),
        (Scalar::U8, _) => fill(rows, starts, at, out, |b| u8::from_le_bytes(b).into()),
        (Scalar::I16, false) => fill(rows, starts, at, out, |b| i16::from_le_bytes(b).into()),
        (Scalar::I16, true) => fill(rows, starts, at, out, |b| i16::from_be_bytes(b).into()),
        (Scalar::U16, false) => fill(rows, starts, at, out, |b| u16::from_le_bytes(b).into()),
        (Scalar::U16, true) => fill(rows, starts, at, out, |b| u16::from_be_bytes(b).into()),
        (Scalar::I32, false) => fill(rows, starts, at, out, |b| i32::from_le_bytes(b) as f32),
        (Scalar::I32, true) => fill(rows, starts, at, out, |b| i32::from_be_bytes(b) as f32),
        (Scalar::U32, false) => fill(rows, starts, at, out, |b| u32::from_le_bytes(b) as f32),
        (Scalar::U32, true) => fill(rows, starts, at, out, |b| u32::from_be_bytes(b) as f32),
    }
}

/// Reads one number from each of some rows into `out`: `convert` converts the `W` bytes at `offset` in a row to f32.
/// `rows` holds the bytes of the rows, and `starts` the offset in `rows` of each row to be read.
fn fill<const W: usize>(
    rows: &[u8],
    starts: &[usize],
    offset: usize,
    out: &mut [f32],
    convert: impl Fn([u8; W]) -> f32,
) {
    for (out, start) in out.iter_mut().zip(starts) {
        let at = start + offset;
        *out = convert(std::array::from_fn(|b| rows[at + b]));
    }
}
