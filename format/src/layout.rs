//! Shape of a container (number of Gaussians, columns, division into tiles) and its encoding in the file header
//! (SPEC.md, "Header").

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::Range;

use xxhash_rust::xxh3::xxh3_64;

use crate::bounded::BOUNDS;
use crate::error::{Error, Fault, Result, quoted};

/// First bytes of every container. They contain a byte above 127, a line ending and a control byte. A transfer that
/// treats the file as text would change some of these bytes, so the damage is noticed.
pub const MAGIC: [u8; 8] = *b"\x89GSEQ\r\n\x1a";
/// Format versions that this crate writes: 1 if no column has an error bound, 2 if one has.
pub(crate) const VERSIONS: [u32; 2] = [1, 2];
/// Length in bytes of the part of the file header before the first column: magic, version, header length, number of
/// Gaussians, the two block lengths, and the numbers of columns and attributes.
pub(crate) const FIXED_HEADER_BYTES: usize = 40;

/// Maximum decoded size of one tile, in bytes (256 MiB). A reader never allocates more for a tile.
pub const MAX_TILE_BYTES: u64 = 1 << 28;
/// Maximum length of a file header, in bytes. A reader therefore never allocates more than this for a forged header
/// length.
pub(crate) const MAX_HEADER_BYTES: usize = 1 << 22;
const MAX_GAUSSIANS: u64 = 1 << 32;
const MAX_FRAME_BLOCK: u32 = 1 << 24;
const MAX_COLUMNS: usize = 256;
const MAX_NAME_BYTES: usize = 64;
const MAX_ATTRIBUTES: usize = 1024;
const MAX_KEY_BYTES: usize = 256;
const MAX_VALUE_BYTES: usize = 1 << 20;
/// Maximum number of tiles per frame block. It limits the memory in which readers and writers keep the last constant
/// tile of each column and Gaussian block.
const MAX_TILES_PER_FRAME_BLOCK: u64 = 1 << 24;

/// Name, width and error bound of one column (an attribute of all Gaussians at all frames).
#[derive(Debug, Clone, PartialEq)]
pub struct ColumnSpec {
    /// Name: `[a-z][a-z0-9_]*`, at most 64 bytes, unique in its container. SPEC.md lists well-known names.
    pub name: String,
    /// Number of f32 components per Gaussian and frame, at least 1.
    pub width: u32,
    /// Maximum absolute difference between a stored and an original value, in the unit of the column's values; 0:
    /// values are stored exactly.
    pub max_error: f64,
}

/// Shape and text attributes of a container. The shape is the number of Gaussians, the columns, and the block lengths.
/// The number of frames is not included, because it may be unknown when writing begins.
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    /// Number N of Gaussians in every frame; 0 to 2³².
    pub gaussians: u64,
    /// Number of Gaussians per tile, at least 1; the last block of Gaussians may be shorter.
    pub gaussian_block: u32,
    /// Number of frames per tile, 1 to 2²⁴; the last block of frames may be shorter.
    pub frame_block: u32,
    /// Columns of the container, 1 to 256. A full tile of the widest column must fit [`MAX_TILE_BYTES`].
    pub columns: Vec<ColumnSpec>,
    /// Text attributes that the writer of the container chooses, by key: at most 1024 keys of at most 256 bytes, values
    /// of at most 1 MiB each, 4 MiB in total.
    pub attributes: BTreeMap<String, String>,
}

/// Address of a tile, which contains the values of one column for a block of Gaussians and a block of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TileId {
    /// Column of the tile, as an index into [`Layout::columns`].
    pub column: u32,
    /// Number of the tile's Gaussian block. The first Gaussian of the block is `gaussian_block ·
    /// Layout::gaussian_block`.
    pub gaussian_block: u32,
    /// Number of the tile's frame block. The first frame of the block is `frame_block · Layout::frame_block`.
    pub frame_block: u32,
}

impl fmt::Display for TileId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let TileId { column, gaussian_block, frame_block } = self;
        write!(f, "the tile of column {column}, Gaussian block {gaussian_block}, frame block {frame_block}")
    }
}

impl Layout {
    /// Returns the index in [`Layout::columns`] of the column called `name`, or `None` if there is none.
    pub fn column(&self, name: &str) -> Option<u32> {
        self.columns.iter().position(|column| column.name == name).map(|at| at as u32)
    }

    /// Returns the number of blocks into which the Gaussians are divided; 0 without Gaussians.
    ///
    /// # Panics
    /// Panics if `gaussian_block` is 0, which no container has.
    pub fn gaussian_blocks(&self) -> u32 {
        // Legal layouts have at most 2²⁴ tiles per frame block, so the cast keeps the value.
        self.gaussians.div_ceil(u64::from(self.gaussian_block)) as u32
    }

    /// Returns the range of Gaussians in Gaussian block `block`; empty for blocks beyond the last.
    pub fn gaussian_range(&self, block: u32) -> Range<u64> {
        let start = u64::from(block) * u64::from(self.gaussian_block);
        start.min(self.gaussians)..(start + u64::from(self.gaussian_block)).min(self.gaussians)
    }

    /// Returns the range of frames in frame block `block` of a sequence of `frames` frames; empty for blocks beyond the
    /// last.
    pub fn frame_range(&self, block: u32, frames: u64) -> Range<u64> {
        let start = u64::from(block) * u64::from(self.frame_block);
        start.min(frames)..(start + u64::from(self.frame_block)).min(frames)
    }

    /// Returns the number of Gaussians in Gaussian block `block`.
    pub(crate) fn block_len(&self, block: u32) -> u32 {
        let range = self.gaussian_range(block);
        (range.end - range.start) as u32
    }

    /// Returns the decoded size in bytes of the largest tile (one column for a block of Gaussians and frames) in a
    /// sequence of `frames` frames.
    pub(crate) fn largest_tile(&self, frames: u64) -> u64 {
        let widest = self.columns.iter().map(|column| column.width).max().unwrap_or(0);
        let gaussians = self.gaussians.min(self.gaussian_block.into());
        4 * u64::from(widest) * gaussians * frames.min(self.frame_block.into())
    }

    /// Returns the number of tiles per frame block: columns times Gaussian blocks.
    pub(crate) fn tiles_per_frame_block(&self) -> u64 {
        self.columns.len() as u64 * u64::from(self.gaussian_blocks())
    }

    /// Returns the position of the tile `id` in the index (table of tiles), or `None` if there is no such column or
    /// Gaussian block. The index is in the order of frame block, then Gaussian block, then column.
    pub(crate) fn index_of(&self, id: TileId) -> Option<u64> {
        if id.column as usize >= self.columns.len() || id.gaussian_block >= self.gaussian_blocks() {
            return None;
        }
        let within = u64::from(id.gaussian_block) * self.columns.len() as u64 + u64::from(id.column);
        Some(u64::from(id.frame_block) * self.tiles_per_frame_block() + within)
    }

    /// Returns the tile at position `index` of the index. Inverse of [`Layout::index_of`].
    pub(crate) fn tile_at(&self, index: u64) -> TileId {
        let columns = self.columns.len() as u64;
        TileId {
            column: (index % columns) as u32,
            gaussian_block: (index / columns % u64::from(self.gaussian_blocks())) as u32,
            frame_block: (index / self.tiles_per_frame_block()) as u32,
        }
    }

    /// Checks that the layout is within all limits of the format. The error message names the first one that is
    /// exceeded.
    pub(crate) fn check(&self) -> std::result::Result<(), String> {
        let within = |what: &str, value: u64, range: std::ops::RangeInclusive<u64>| {
            if range.contains(&value) {
                Ok(())
            } else {
                Err(format!("{what} {} to {}, not {value}", range.start(), range.end()))
            }
        };
        within("gaussians", self.gaussians, 0..=MAX_GAUSSIANS)?;
        within("gaussian_block", self.gaussian_block.into(), 1..=u32::MAX.into())?;
        within("frame_block", self.frame_block.into(), 1..=MAX_FRAME_BLOCK.into())?;
        within("number of columns", self.columns.len() as u64, 1..=MAX_COLUMNS as u64)?;
        let mut names = BTreeSet::new();
        for ColumnSpec { name, width, max_error } in &self.columns {
            if !is_column_name(name) {
                return Err(format!(
                    "column names of 1 to {MAX_NAME_BYTES} bytes [a-z][a-z0-9_]*, not {}",
                    quoted(name)
                ));
            }
            if !names.insert(name) {
                return Err(format!("distinct column names, not two called {}", quoted(name)));
            }
            let frame_values = u64::from(self.gaussian_block) * u64::from(self.frame_block);
            let most = MAX_TILE_BYTES / 4 / frame_values.max(1);
            within(
                &format!("width of column {name} (whole tiles hold {MAX_TILE_BYTES} bytes at most)"),
                (*width).into(),
                1..=most,
            )?;
            if *max_error != 0.0 && !BOUNDS.contains(max_error) {
                return Err(format!("a bound of column {name} that is 0 or a normal f32 above, not {max_error}"));
            }
        }
        let blocks = self.gaussians.div_ceil(self.gaussian_block.into());
        within("tiles per frame block", blocks * self.columns.len() as u64, 0..=MAX_TILES_PER_FRAME_BLOCK)?;
        within("number of attributes", self.attributes.len() as u64, 0..=MAX_ATTRIBUTES as u64)?;
        for (key, value) in &self.attributes {
            within("bytes in an attribute key", key.len() as u64, 1..=MAX_KEY_BYTES as u64)?;
            within("bytes in an attribute value", value.len() as u64, 0..=MAX_VALUE_BYTES as u64)?;
        }
        within("bytes in the header", self.header_len() as u64, 0..=MAX_HEADER_BYTES as u64)
    }

    /// Returns the format version of a file with this layout: 1, or 2 if a column has an error bound.
    fn version(&self) -> u32 {
        VERSIONS[usize::from(self.columns.iter().any(|column| column.max_error != 0.0))]
    }

    /// Returns the length of the encoded header in bytes, including its checksum, but without padding.
    fn header_len(&self) -> usize {
        let fields = if self.version() == VERSIONS[0] { 6 } else { 14 };
        let columns: usize = self.columns.iter().map(|column| fields + column.name.len()).sum();
        let attributes: usize = self.attributes.iter().map(|(key, value)| 6 + key.len() + value.len()).sum();
        FIXED_HEADER_BYTES + columns + attributes + 8
    }

    /// Encodes the header of a file with this layout, without the zeros that pad it to a multiple of 64 bytes. Fails if
    /// the layout exceeds a limit of the format.
    pub(crate) fn to_header(&self) -> Result<Vec<u8>> {
        self.check().map_err(|limit| Error::usage(format!("a container's layout must have {limit}")))?;
        let mut out = Vec::with_capacity(self.header_len());
        out.extend(MAGIC);
        let version = self.version();
        out.extend(version.to_le_bytes());
        out.extend((self.header_len() as u32).to_le_bytes());
        out.extend(self.gaussians.to_le_bytes());
        out.extend(self.gaussian_block.to_le_bytes());
        out.extend(self.frame_block.to_le_bytes());
        out.extend((self.columns.len() as u32).to_le_bytes());
        out.extend((self.attributes.len() as u32).to_le_bytes());
        for ColumnSpec { name, width, max_error } in &self.columns {
            out.extend(width.to_le_bytes());
            out.extend((name.len() as u16).to_le_bytes());
            out.extend(name.as_bytes());
            if version != VERSIONS[0] {
                out.extend(max_error.to_le_bytes());
            }
        }
        for (key, value) in &self.attributes {
            out.extend((key.len() as u16).to_le_bytes());
            out.extend((value.len() as u32).to_le_bytes());
            out.extend(key.as_bytes());
            out.extend(value.as_bytes());
        }
        let checksum = xxh3_64(&out);
        out.extend(checksum.to_le_bytes());
        Ok(out)
    }

    /// Returns the length in bytes of the whole header, read from `fixed`, the first bytes of the file. Fails if the
    /// file does not begin with [`MAGIC`], if its format version is unknown, or if the header length is not allowed.
    pub(crate) fn header_len_from(fixed: &[u8; FIXED_HEADER_BYTES]) -> std::result::Result<usize, Fault> {
        let mut fields = Fields { bytes: fixed, at: 0 };
        let magic = fields.take(8)?;
        if magic != MAGIC {
            return Err(Fault::new(0, "the gseq magic 89 'GSEQ' 0d 0a 1a", format!("{:02x?}", magic)));
        }
        let version = fields.u32()?;
        if !VERSIONS.contains(&version) {
            let [exact, bounded] = VERSIONS;
            let fault = Fault::new(8, format!("format version {exact} or {bounded}"), format!("version {version}"));
            return Err(fault.hint("a newer release of this program may read it"));
        }
        let len = fields.u32()? as usize;
        if !(FIXED_HEADER_BYTES + 8..=MAX_HEADER_BYTES).contains(&len) {
            return Err(Fault::new(
                12,
                format!("a header of {} to {MAX_HEADER_BYTES} bytes", FIXED_HEADER_BYTES + 8),
                format!("{len} bytes"),
            ));
        }
        Ok(len)
    }

    /// Decodes a whole header, and checks its checksum and all limits of the format.
    pub(crate) fn from_header(bytes: &[u8]) -> std::result::Result<Layout, Fault> {
        let body = bytes.len().saturating_sub(8);
        let mut fields = Fields { bytes, at: body };
        let stored = fields.u64()?;
        let computed = xxh3_64(&bytes[..body]);
        if stored != computed {
            return Err(Fault::new(body as u64, format!("header checksum {computed:016x}"), format!("{stored:016x}")));
        }
        let mut fields = Fields { bytes: &bytes[..body], at: 8 };
        let version = fields.u32()?;
        fields.at = 16;
        let gaussians = fields.u64()?;
        let gaussian_block = fields.u32()?;
        let frame_block = fields.u32()?;
        let column_count = fields.u32()? as usize;
        let attribute_count = fields.u32()? as usize;
        let mut columns = Vec::with_capacity(column_count.min(MAX_COLUMNS));
        for _ in 0..column_count {
            let width = fields.u32()?;
            let len = fields.u16()?;
            let name = fields.text(len.into())?;
            let max_error = if version == VERSIONS[0] { 0.0 } else { f64::from_le_bytes(fields.array()?) };
            columns.push(ColumnSpec { name, width, max_error });
        }
        let mut attributes = BTreeMap::new();
        for _ in 0..attribute_count {
            let start = fields.at;
            let key_len = fields.u16()?;
            let value_len = fields.u32()?;
            let key = fields.text(key_len.into())?;
            let value = fields.text(value_len as usize)?;
            if attributes.last_key_value().is_some_and(|(last, _)| *last >= key) {
                return Err(Fault::new(
                    start as u64,
                    "attributes in strictly increasing order of their keys",
                    quoted(&key),
                ));
            }
            attributes.insert(key, value);
        }
        if fields.at != body {
            return Err(Fault::new(
                fields.at as u64,
                "the header checksum",
                format!("{} more bytes before it", body - fields.at),
            ));
        }
        let layout = Layout { gaussians, gaussian_block, frame_block, columns, attributes };
        layout.check().map_err(|limit| Fault::new(16, limit, "a header outside this limit"))?;
        if layout.version() != version {
            return Err(Fault::new(8, format!("version {} of a header without a bound", VERSIONS[0]), version));
        }
        Ok(layout)
    }
}

/// Returns whether `name` is allowed as the name of a column: 1 to 64 bytes of the form `[a-z][a-z0-9_]*`.
fn is_column_name(name: &str) -> bool {
    name.len() <= MAX_NAME_BYTES
        && name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_')
}

/// Reader of the little-endian fields of a header, one after the other. The first byte of the slice is byte 0 of the
/// file.
struct Fields<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Fields<'a> {
    /// Returns the next `len` bytes of the header. Fails if fewer are left.
    fn take(&mut self, len: usize) -> std::result::Result<&'a [u8], Fault> {
        let left = self.bytes.len() - self.at;
        if len > left {
            return Err(Fault::new(self.at as u64, format!("{len} bytes of header"), format!("{left} before its end")));
        }
        let taken = &self.bytes[self.at..self.at + len];
        self.at += len;
        Ok(taken)
    }

    fn array<const LEN: usize>(&mut self) -> std::result::Result<[u8; LEN], Fault> {
        let mut out = [0; LEN];
        out.copy_from_slice(self.take(LEN)?);
        Ok(out)
    }

    fn u16(&mut self) -> std::result::Result<u16, Fault> {
        self.array().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> std::result::Result<u32, Fault> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> std::result::Result<u64, Fault> {
        self.array().map(u64::from_le_bytes)
    }

    /// Returns the next `len` bytes of the header as text. Fails if they are not UTF-8.
    fn text(&mut self, len: usize) -> std::result::Result<String, Fault> {
        let start = self.at as u64;
        let bytes = self.take(len)?;
        let text = std::str::from_utf8(bytes).map_err(|error| Fault::new(start, "UTF-8 text", error))?;
        Ok(text.to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn layout() -> Layout {
        Layout {
            gaussians: 100,
            gaussian_block: 32,
            frame_block: 4,
            columns: vec![
                ColumnSpec { name: "position".into(), width: 3, max_error: 0.0 },
                ColumnSpec { name: "sh".into(), width: 48, max_error: 0.0 },
            ],
            attributes: BTreeMap::from([("a".into(), "1".into()), ("b".into(), String::new())]),
        }
    }

    #[test]
    fn header_round_trips() {
        let header = layout().to_header().unwrap();
        assert_eq!(header.len(), layout().header_len());
        assert_eq!(Layout::from_header(&header).unwrap(), layout());
    }

    #[test]
    fn index_position_and_tile_id_are_inverse() {
        let layout = layout();
        let ids: Vec<TileId> = (0..40).map(|index| layout.tile_at(index)).collect();
        assert!(ids.iter().enumerate().all(|(index, &id)| layout.index_of(id) == Some(index as u64)));
        assert_eq!(ids[9], TileId { column: 1, gaussian_block: 0, frame_block: 1 });
        assert_eq!(layout.gaussian_range(3), 96..100);
        assert_eq!(layout.gaussian_range(4), 100..100);
    }

    proptest! {
        #[test]
        fn forged_header_is_legal_or_refused(
            at in 16usize..120, bytes in prop::collection::vec(any::<u8>(), 1..12), cut in 0usize..60,
        ) {
            let mut header = layout().to_header().unwrap();
            header.truncate(header.len() - 8);
            for (i, byte) in bytes.into_iter().enumerate() {
                if let Some(place) = header.get_mut(at + i) { *place = byte; }
            }
            header.truncate(header.len() - cut);
            let checksum = xxh3_64(&header);
            header.extend(checksum.to_le_bytes());
            if let Ok(layout) = Layout::from_header(&header) {
                prop_assert!(layout.check().is_ok());
            }
        }
    }
}
