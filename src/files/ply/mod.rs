//! Gaussians from a PLY file in the INRIA layout and its dialects.
//!
//! In: a path. Out: planes of f32 for any list of Gaussians, and the rows as they lie in the file for
//! writers that keep them. Memory: 2 MiB of a map of the file, or of a scratch file with the binary rows of a text file.
//! Source: 3D Gaussian Splatting (Kerbl et al., 2023), `save_ply` of its public code.
//!
//! Accepted: binary of either byte order and text; any number type per property; properties in any
//! order, further ones, no normals; comments; LF or CRLF; further elements before or after `vertex`;
//! no `scale_2` (2DGS, see [`THIN_LOG_SCALE`]); bytes after the last element. NaN is no error here.

mod ascii;
mod header;
mod layout;
#[cfg(test)]
pub(crate) mod tests;
pub mod write;

use std::io::{self, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

pub(crate) use ascii::{TextRows, TextStore};
use header::Element;
pub(crate) use header::PlyHeader;
pub use header::{PlyEncoding, Property, Scalar};
pub use layout::THIN_LOG_SCALE;
pub(crate) use layout::{PlaneSource, PlyLayout, name_without_bands};

use super::map::FileMap;
use super::open::open_file;
use crate::error::{Error, Result, ShowPath};
use crate::limits::ReadLimit;
use crate::model::{Column, Columns, Gaussians};
use crate::progress::Events;
use crate::source::Ids;

/// Rows handled together, so that all planes of them are taken from cache: 32 KiB at degree 3.
const BLOCK_ROWS: usize = 128;
/// Bytes of rows handled together.
const BLOCK_BYTES: usize = 1 << 20;

/// How PLY files may be read.
#[derive(Debug, Clone)]
pub struct PlyOptions {
    /// Folder for the scratch file that holds the rows of text files while they are open.
    pub scratch: PathBuf,
    /// Memory that reading a whole file may take.
    pub memory: ReadLimit,
    /// Where the progress of linking frames goes.
    pub events: Events,
}

impl Default for PlyOptions {
    fn default() -> Self {
        PlyOptions { scratch: std::env::temp_dir(), memory: ReadLimit::NONE, events: Events::IGNORED }
    }
}

/// Parses the header at the start of `bytes`, the content of `path`, and returns the number of Gaussians that it
/// announces. Says nothing about the rows behind it.
///
/// # Errors
/// Those of [`Ply::open_with`] that the header alone shows.
pub fn check_header(bytes: &[u8], path: &Path) -> Result<u64> {
    let header = PlyHeader::parse(path, bytes)?;
    let vertex = vertex_of(&header, path)?;
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
    /// Where the rows of `vertex` lie in the body.
    rows: Range<usize>,
    count: usize,
    memory: ReadLimit,
}

/// The tables of a file after its header.
#[derive(Debug)]
struct PlyBody {
    /// The whole file, or the converted rows of a text file.
    map: FileMap,
    /// Where the tables start in the map.
    start: usize,
    /// Of a text file: its length in bytes, and where its converted rows are.
    text: Option<(u64, TextRows)>,
}

impl PlyBody {
    fn bytes(&self) -> &[u8] {
        &self.map[self.start..]
    }

    /// Returns `range` of the body in the map.
    fn range(&self, range: Range<usize>) -> Range<usize> {
        self.start + range.start..self.start + range.end
    }
}

impl Ply {
    /// Opens the file at `path` and checks its header against its size. Rows of a text file lie in the system's folder
    /// for temporary files.
    ///
    /// # Errors
    /// Those of [`Ply::open_with`].
    pub fn open(path: &Path) -> Result<Ply> {
        Self::open_with(path, &PlyOptions::default())
    }

    /// Opens the file at `path` and checks its header against its size.
    ///
    /// # Errors
    /// Not a PLY; a malformed header; a missing property; a list property; a number of `f_rest_*` that
    /// belongs to no SH degree; more than `u32::MAX` Gaussians; fewer bytes than the header declares; in
    /// a text file, a row that cannot be read.
    pub fn open_with(path: &Path, options: &PlyOptions) -> Result<Ply> {
        Self::open_into(path, options.memory, &TextStore::new(&options.scratch))
    }

    /// Opens the file at `path`; rows of a text file go to `texts`.
    pub(crate) fn open_into(path: &Path, memory: ReadLimit, texts: &TextStore) -> Result<Ply> {
        Self::with_text_rows(path, memory, |header| texts.convert(path, header, open_file(path)?))
    }

    /// Opens the file at `path` again. `text` are its rows if it is a text file.
    pub(crate) fn open_again(path: &Path, memory: ReadLimit, text: Option<&TextRows>) -> Result<Ply> {
        Self::with_text_rows(path, memory, |_| text.cloned().ok_or_else(|| changed(path)))
    }

    fn with_text_rows(
        path: &Path,
        memory: ReadLimit,
        convert: impl FnOnce(&PlyHeader) -> Result<TextRows>,
    ) -> Result<Ply> {
        let map = FileMap::open(path)?;
        let header = PlyHeader::parse(path, &map)?;
        let vertex = vertex_of(&header, path)?;
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
        let rows = vertex_rows(path, &header, body.bytes().len())?;
        let count = count as usize;
        Ok(Ply { path: path.to_owned(), header, layout, stride, properties, body, rows, count, memory })
    }

    /// The converted rows of a text file, for [`Ply::open_again`].
    pub(crate) fn text_rows(&self) -> Option<&TextRows> {
        self.body.text.as_ref().map(|(_, rows)| rows)
    }

    /// Reads all columns of all Gaussians.
    ///
    /// # Errors
    /// More than the memory that reading may take; a file cut short since it was opened.
    pub(crate) fn whole(&self) -> Result<Gaussians> {
        let bytes = 4 * Columns::all().width(self.sh_degree()) as u64 * self.count as u64;
        self.memory.check(&self.path, "element vertex", "the Gaussians of the file", bytes)?;
        let mut out = Gaussians::zeros(self.count, self.sh_degree());
        self.gaussians(0..self.count, Columns::all(), &mut out)?;
        Ok(out)
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// N, the number of Gaussians.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Degree of the spherical harmonics, 0 to 3.
    pub fn sh_degree(&self) -> usize {
        self.layout.sh_degree
    }

    /// Texts of the `comment` lines, in order.
    pub fn comments(&self) -> &[String] {
        &self.header.comments
    }

    /// The properties of a Gaussian's row, in file order.
    pub fn properties(&self) -> &[Property] {
        &self.properties
    }

    /// Writes the columns `want` of the Gaussians `range` into `out`, as [`Ply::gather`] does.
    pub fn gaussians(&self, range: Range<usize>, want: Columns, out: &mut Gaussians) -> Result<()> {
        self.gather(&Ids::Range(range), want, out)
    }

    /// Writes the columns `want` of the Gaussians `ids`, in that order, into `out`, which is resized to
    /// them. An f32 keeps its bits; other number types become the nearest f32.
    ///
    /// # Errors
    /// An id beyond the last Gaussian; a file cut short since it was opened.
    pub fn gather(&self, ids: &Ids<'_>, want: Columns, out: &mut Gaussians) -> Result<()> {
        self.check_unshrunk()?;
        check_ids(&self.path, ids, self.count)?;
        out.resize(ids.len());
        for column in want.iter() {
            let width = self.layout.planes(column).len();
            if out.column(column).width() != width {
                *out.column_mut(column) = Column::zeros(width, ids.len());
            }
        }
        let rows = &self.body.bytes()[self.rows.clone()];
        let big_endian = self.header.encoding == PlyEncoding::BigEndian;
        let mut starts = Vec::with_capacity(BLOCK_ROWS);
        let mut ids_left = ids.iter();
        // Rows with thousands of properties: few of them, so that few of their pages are resident.
        let together = (BLOCK_BYTES / self.stride.max(1)).clamp(1, BLOCK_ROWS);
        for first in (0..ids.len()).step_by(together) {
            starts.clear();
            starts.extend(ids_left.by_ref().take(together).map(|id| id * self.stride));
            self.touch(&starts);
            for column in want.iter() {
                for (c, plane) in self.layout.planes(column).iter().enumerate() {
                    if let PlaneSource::Property(property) = plane {
                        let out = &mut out.column_mut(column).plane_mut(c)[first..first + starts.len()];
                        read_plane(rows, &starts, property, big_endian, out);
                    }
                }
            }
        }
        if want.contains(Columns::LOG_SCALE) && self.layout.planes(Columns::LOG_SCALE).contains(&PlaneSource::Thin) {
            for i in 0..ids.len() {
                let [a, b, _] = out.log_scale.row::<3>(i);
                out.log_scale.set_row(i, [a, b, a.min(b) + THIN_LOG_SCALE]);
            }
        }
        Ok(())
    }

    /// The property `name` of all Gaussians, as the nearest f32; none where there is no such property.
    ///
    /// # Errors
    /// A file cut short since it was opened.
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

    /// Bytes of the file that reading `rows` Gaussians takes, whatever their columns: of a text file all.
    pub(crate) fn bytes_of(&self, rows: usize) -> u64 {
        match &self.body.text {
            None => (rows * self.stride) as u64,
            Some((stored, _)) => *stored,
        }
    }

    /// The header, for writers.
    pub(crate) fn header(&self) -> &PlyHeader {
        &self.header
    }

    /// Where a row holds what, for writers.
    pub(crate) fn layout(&self) -> &PlyLayout {
        &self.layout
    }

    /// The bytes of Gaussian `i` in a binary body.
    pub(crate) fn row(&self, i: usize) -> &[u8] {
        self.touch(&[i * self.stride]);
        &self.body.bytes()[self.rows.clone()][i * self.stride..(i + 1) * self.stride]
    }

    /// Number of bytes that a binary body holds before the rows of `vertex`, and after them.
    pub(crate) fn bytes_around(&self) -> [usize; 2] {
        [self.rows.start, self.body.bytes().len() - self.rows.end]
    }

    /// Writes what a binary body holds before the rows of `vertex`.
    pub(crate) fn write_lead(&self, out: &mut dyn Write) -> io::Result<()> {
        self.body.map.pieces(self.body.range(0..self.rows.start), |piece| out.write_all(piece))
    }

    /// Writes what a binary body holds after the rows of `vertex`.
    pub(crate) fn write_tail(&self, out: &mut dyn Write) -> io::Result<()> {
        let end = self.body.bytes().len();
        self.body.map.pieces(self.body.range(self.rows.end..end), |piece| out.write_all(piece))
    }

    /// Memory that reading the whole file may take.
    pub(crate) fn memory(&self) -> ReadLimit {
        self.memory
    }

    /// Confirms that a mapped file still has its bytes.
    pub(crate) fn check_unshrunk(&self) -> Result<()> {
        self.body.map.check()
    }

    /// Records that the rows which begin at `starts` are about to be read.
    fn touch(&self, starts: &[usize]) {
        let first = self.body.start + self.rows.start;
        for run in starts.chunk_by(|a, b| a + self.stride == *b) {
            let [start, end] = [run[0], run[run.len() - 1] + self.stride];
            self.body.map.touched(first + start..first + end);
        }
    }
}

/// The element that holds the Gaussians.
fn vertex_of<'a>(header: &'a PlyHeader, path: &Path) -> Result<&'a Element> {
    header.vertex().ok_or_else(|| Error::input(path, "header", "an element \"vertex\"", "none"))
}

/// Error for a file that was binary when it was opened first.
fn changed(path: &Path) -> Error {
    Error::input(path, "header", "a binary body, as before", "a text body")
        .hint("the file has changed since it was opened")
}

/// Confirms that every id is below `count`.
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

/// Where the rows of `vertex` lie in a binary body of `available` bytes.
fn vertex_rows(path: &Path, header: &PlyHeader, available: usize) -> Result<Range<usize>> {
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
            // Both fit usize: they are at most `available`.
            rows = start as usize..next as usize;
        }
    }
    Ok(rows)
}

/// Reads one property of the rows that start at `starts`.
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
