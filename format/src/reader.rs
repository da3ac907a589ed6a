//! Reader of finished containers. Any number of threads may use one reader together.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use xxhash_rust::xxh3::{Xxh3, xxh3_64};
use zstd::bulk::Decompressor;

use crate::codec::{Encoding, StoredTile, TileDecoder, TileStats};
use crate::error::{Error, Fault, Result};
use crate::file::MappedFile;
use crate::index::{Index, check_memory};
use crate::layout::{FIXED_HEADER_BYTES, Layout, TileId};
use crate::record::{Digest, FooterRecord, RECORD_BYTES, Record, TRAILER_BYTES, TileRecord, align, trailer_from_bytes};
use crate::text::ShowPath;
use crate::writer::check_times;

mod tile_frames;

pub use tile_frames::{TileFrames, TouchedPages};

/// Maximum gap, in bytes of the file, between two tiles whose pages are prefetched or released in one call of the
/// system.
const MERGE_GAP_BYTES: u64 = 1 << 12;

/// Open container, from which tiles are read.
///
/// Memory: 8 bytes per frame and 1 byte per tile; while opening also about 80 bytes per column and Gaussian block. The
/// index (table of tiles) and the values stay on disk. If the tiles do not lie in the order of the index (a writer
/// places them in the order of writing), opening takes 80 bytes per tile.
///
/// See [`Reader::tile`] for the behavior when the file changes while it is open.
pub struct Reader {
    pub(crate) file: MappedFile,
    pub(crate) layout: Layout,
    pub(crate) times: Vec<f64>,
    pub(crate) index: Index,
    pub(crate) footer_offset: u64,
    /// For every column, whether its values differ between frames.
    varies: Vec<bool>,
    /// For every tile, whether its bytes in the memory map have been found to match their checksum.
    verified: Vec<AtomicBool>,
    digest: u64,
    read_bytes: AtomicU64,
    read_tiles: AtomicU64,
}

/// Buffer for reading and decoding tiles (each one column for a block of Gaussians and frames). The buffer can be used
/// again for the next tile. Grows to three times the size of the largest decoded tile.
#[derive(Default)]
pub struct TileBuffer {
    stored: Vec<u8>,
    decoder: TileDecoder,
    values: Vec<f32>,
    /// Decompressor of zstd frames, created when the first compressed tile is read.
    zstd: Option<Decompressor<'static>>,
}

/// Counts of the data of tiles that a reader has read so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TileReadCounts {
    /// Number of bytes of stored tile data that were read from the file.
    pub bytes: u64,
    /// Number of tiles that were decoded. A raw tile (plain f32) counts when it is loaded.
    pub tiles: u64,
}

/// Values of one tile: one column for a block of Gaussians and a block of frames.
#[derive(Debug, Clone, Copy)]
pub struct Tile<'a> {
    values: &'a [f32],
    frames: usize,
    width: usize,
    len: usize,
    constant: bool,
}

/// Entry in the index of a container for one tile: one column for a block of Gaussians and frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileInfo {
    /// Encoding (raw, lossless or lossy) of the values of the tile in its stored bytes.
    pub encoding: Encoding,
    /// Whether all frames of the tile are equal, so that only one is stored.
    pub constant: bool,
    /// Number of frames of the tile, also if only one is stored.
    pub frames: u32,
    /// Offset of the tile's stored bytes in the file. Constant tiles of other frame blocks may share these bytes.
    pub offset: u64,
    /// Number of the tile's stored bytes.
    pub stored_bytes: u64,
    /// Checksum (xxh3-64) of the tile's stored bytes.
    pub checksum: u64,
    /// Minimum, maximum and number of non-finite values among the values of the tile.
    pub stats: TileStats,
}

impl<'a> Tile<'a> {
    /// Returns the values of component `component` for all Gaussians of the tile at its frame `frame`, counted from 0.
    /// A constant tile (all frames equal) returns the same values for every frame.
    ///
    /// # Panics
    /// Panics if the tile has no such frame or component.
    pub fn plane(&self, frame: usize, component: usize) -> &'a [f32] {
        assert!(frame < self.frames && component < self.width, "no frame {frame}, component {component} in {self:?}");
        let frame = if self.constant { 0 } else { frame };
        &self.values[(frame * self.width + component) * self.len..][..self.len]
    }

    /// Returns all stored values of the tile, laid out as `[frame][component][gaussian]`; only one frame if all are
    /// equal.
    pub fn values(&self) -> &'a [f32] {
        self.values
    }

    /// Returns the number of frames of the tile, even if only one is stored.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Returns the number of values (components) that the tile has per Gaussian and frame.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Returns the number of Gaussians in the tile; never 0.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether all frames of the tile are equal, so that only one is stored.
    pub fn is_constant(&self) -> bool {
        self.constant
    }
}

impl Reader {
    /// Opens a container and checks its header, footer and index: every length and offset is within its limits, and no
    /// two tiles overlap. The tiles themselves are checked when they are read, or by [`Reader::verify`]. Fails if a
    /// check fails or the file cannot be read.
    pub fn open(path: impl AsRef<Path>) -> Result<Reader> {
        Self::open_within(path, u64::MAX)
    }

    /// Opens a container like [`Reader::open`], with at most `memory` bytes of memory for the time stamps and the data
    /// kept per tile. Fails if the container needs more.
    pub fn open_within(path: impl AsRef<Path>, memory: u64) -> Result<Reader> {
        let file = MappedFile::open(path.as_ref())?;
        Self::read(file, memory)
    }

    /// Reads and checks the header, trailer, footer and index of the container `file`.
    fn read(file: MappedFile, memory: u64) -> Result<Reader> {
        let fault = |fault: Fault| fault.at(file.path());
        let (layout, header) = read_header(&file)?;
        let first_record = align(header.len() as u64);

        let least = first_record + RECORD_BYTES + TRAILER_BYTES;
        if file.len() < least {
            let short = Fault::new(file.len(), format!("a container of at least {least} bytes"), "the end of the file");
            return Err(fault(short.hint("the file is cut short; nothing but its header is left")));
        }
        let mut trailer = [0; TRAILER_BYTES as usize];
        let trailer_offset = file.len() - TRAILER_BYTES;
        file.read_at(trailer_offset, &mut trailer)?;
        let footer_offset = trailer_from_bytes(&trailer, trailer_offset).map_err(fault)?;
        let allowed = first_record..trailer_offset - RECORD_BYTES + 1;
        if !allowed.contains(&footer_offset) || !footer_offset.is_multiple_of(RECORD_BYTES) {
            let expected = format!(
                "a footer within bytes {} to {}, at a multiple of {RECORD_BYTES}",
                allowed.start, trailer_offset
            );
            return Err(fault(Fault::new(trailer_offset, expected, footer_offset)));
        }

        let mut record = [0; RECORD_BYTES as usize];
        file.read_at(footer_offset, &mut record)?;
        let footer = match Record::from_bytes(&record, footer_offset).map_err(fault)? {
            Record::Footer(footer) => footer,
            other => return Err(fault(Fault::new(footer_offset, "the footer", other))),
        };
        let start = footer_offset + RECORD_BYTES;
        check_footer(&footer, &layout, &header, footer_offset, trailer_offset - start).map_err(fault)?;
        // Memory for a time stamp per frame, a flag per tile, and the last constant tile of each column and Gaussian
        // block.
        let slots = layout.tiles_per_frame_block().min(footer.tiles);
        let needed = footer.frames.saturating_mul(8) + footer.tiles + slots * size_of::<Option<TileRecord>>() as u64;
        check_memory(footer_offset, needed, memory).map_err(fault)?;
        let mut chunk = Vec::new();
        let mut hash = Xxh3::new();
        file.read_chunks(start..trailer_offset, &mut chunk, |_, bytes| {
            hash.update(bytes);
            Ok(())
        })?;
        let computed = hash.digest();
        if computed != footer.checksum {
            let expected = format!("footer checksum {computed:016x}");
            return Err(fault(Fault::new(footer_offset + 32, expected, format!("{:016x}", footer.checksum))));
        }

        // The number of frames is bounded by the length of the file, which was checked above.
        let mut times = Vec::with_capacity(footer.frames as usize);
        let index_offset = start + 8 * footer.frames;
        file.read_chunks(start..index_offset, &mut chunk, |_, bytes| {
            times.extend(bytes.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)));
            Ok(())
        })?;
        check_times(None, &times)
            .map_err(|(frame, found)| {
                Fault::new(start + 8 * frame as u64, "finite, strictly increasing time stamps", found)
            })
            .map_err(fault)?;
        let payloads = first_record + RECORD_BYTES..footer_offset;
        let index = Index { offset: index_offset, tiles: footer.tiles, frames: footer.frames, payloads };
        let mut digest = Digest::new(&header, &times);
        let varies = index.check(&file, &layout, &mut chunk, &mut digest, memory - needed)?;
        let verified = (0..footer.tiles).map(|_| AtomicBool::new(false)).collect();
        Ok(Reader {
            file,
            layout,
            times,
            index,
            footer_offset,
            varies,
            verified,
            digest: digest.value(),
            read_bytes: AtomicU64::new(0),
            read_tiles: AtomicU64::new(0),
        })
    }

    /// Returns the shape of the container: number of Gaussians, columns and block lengths.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Returns the time stamps of all frames, which strictly increase.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Returns T, the number of frames.
    pub fn frames(&self) -> usize {
        self.times.len()
    }

    /// Returns the number of blocks into which the frames are divided.
    pub fn frame_blocks(&self) -> u32 {
        self.times.len().div_ceil(self.layout.frame_block as usize) as u32
    }

    /// Returns whether the values of column `column` (an attribute) may differ between frames. They are known to be the
    /// same at all frames if all tiles of the column are constant and, for each block of Gaussians, share their stored
    /// bytes. Uses only the index of the file.
    ///
    /// # Panics
    /// Panics if there is no such column.
    pub fn is_varying(&self, column: u32) -> bool {
        self.varies[column as usize]
    }

    /// Returns a hash of the content: header, time stamps, and checksums and statistics of all tiles. Containers with
    /// the same content, layout and compression have the same hash, in whatever order their tiles were written.
    pub fn digest(&self) -> u64 {
        self.digest
    }

    /// Reads the index entry of the tile `at`, which states how the tile is stored and summarizes its values. Fails if
    /// there is no such tile.
    pub fn tile_info(&self, at: TileId) -> Result<TileInfo> {
        let (_, tile) = self.record(at)?;
        Ok(TileInfo {
            encoding: tile.encoding,
            constant: tile.constant,
            frames: tile.frames,
            offset: tile.offset,
            stored_bytes: tile.stored_bytes.into(),
            checksum: tile.checksum,
            stats: tile.stats,
        })
    }

    /// Returns the values of a tile: as a slice of the memory map if the tile is raw (plain f32), otherwise decoded
    /// into `buffer`.
    ///
    /// Checks the checksum of the stored bytes; for a raw tile only the first time. If the file shrank before this
    /// call, the call fails. If it shrinks while the slice of a raw tile is in use, the operating system may end the
    /// process; if it is rewritten in place, the slice shows the new bytes. Use [`Reader::read_tile`] for files that
    /// other processes may change this way.
    pub fn tile<'a>(&'a self, at: TileId, buffer: &'a mut TileBuffer) -> Result<Tile<'a>> {
        let (index, tile) = self.record(at)?;
        if tile.encoding == Encoding::Raw && cfg!(target_endian = "little") {
            let bytes = self.file.in_place(tile.offset, tile.stored_bytes.into())?;
            self.verify_in_place(index, &tile, bytes)?;
            self.count(1, bytes.len());
            // Stored bytes start at multiples of 64 and the memory map starts at a page, so the bytes are aligned for
            // f32.
            if let Ok(values) = bytemuck::try_cast_slice(bytes) {
                return Ok(self.tile_view(&tile, values));
            }
        }
        self.read_record(&tile, buffer)
    }

    /// Returns the values of the tile `at`. They are read by system calls into `buffer`, never through the memory map,
    /// and checked against the checksum. A file that is cut short at any moment thus causes an error and nothing worse.
    pub fn read_tile<'a>(&self, at: TileId, buffer: &'a mut TileBuffer) -> Result<Tile<'a>> {
        self.read_record(&self.record(at)?.1, buffer)
    }

    /// Returns how much tile data has been read so far, by all threads. Bytes count each time they are read. Of a raw
    /// tile (plain f32) whose checksum was checked before, only the frames that are read count.
    pub fn tiles_read(&self) -> TileReadCounts {
        TileReadCounts {
            bytes: self.read_bytes.load(Ordering::Relaxed),
            tiles: self.read_tiles.load(Ordering::Relaxed),
        }
    }

    /// Tells the operating system that the stored bytes of `tiles` will be read soon, so that it reads them from disk
    /// meanwhile. Takes no memory of this process. Read errors are ignored here; they appear when the tiles are read.
    pub fn prefetch_in_background(&self, tiles: impl IntoIterator<Item = TileId>) {
        let mut pending = 0..0;
        for (_, tile) in tiles.into_iter().filter_map(|at| self.record(at).ok()) {
            let end = tile.offset + u64::from(tile.stored_bytes);
            // The columns of a block lie side by side in the file, with a record between them.
            if tile.offset < pending.end || tile.offset - pending.end > MERGE_GAP_BYTES {
                self.file.will_need(pending);
                pending = tile.offset..end;
            }
            pending.end = end;
        }
        self.file.will_need(pending);
    }

    /// Adds `tiles` tiles and `bytes` bytes to the counts of [`Reader::tiles_read`].
    fn count(&self, tiles: u64, bytes: usize) {
        // Relaxed ordering suffices: the sums are read only after the reading is done.
        self.read_tiles.fetch_add(tiles, Ordering::Relaxed);
        self.read_bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// Checks the checksum of a raw tile (plain f32) in the memory map, unless an earlier call has checked it. Returns
    /// whether this call checked it.
    fn verify_in_place(&self, index: usize, tile: &TileRecord, bytes: &[u8]) -> Result<bool> {
        // Relaxed ordering suffices: the flag only saves repeated work.
        if self.verified[index].load(Ordering::Relaxed) {
            return Ok(false);
        }
        check_payload(tile, xxh3_64(bytes)).map_err(|fault| fault.at(self.file.path()))?;
        self.verified[index].store(true, Ordering::Relaxed);
        Ok(true)
    }

    /// Returns a tile's position in the index and its entry there. Fails if there is no such tile.
    fn record(&self, at: TileId) -> Result<(usize, TileRecord)> {
        let index = self.layout.index_of(at).filter(|&index| index < self.index.tiles).ok_or_else(|| {
            let frames = self.frames();
            Error::usage(format!(
                "{}: {at} does not exist; the container has {frames} frames",
                self.file.path().shown()
            ))
        })?;
        Ok((index as usize, self.index.record(&self.file, &self.layout, index)?))
    }

    /// Reads and decodes the tile of the index entry `tile` into `buffer`, and counts it as read.
    fn read_record<'a>(&self, tile: &TileRecord, buffer: &'a mut TileBuffer) -> Result<Tile<'a>> {
        read_tile(&self.file, &self.layout, tile, buffer)?;
        self.count(1, tile.stored_bytes as usize);
        Ok(self.tile_view(tile, &buffer.values))
    }

    /// Returns a view of the tile that has the index entry `tile` and the stored values `values`.
    fn tile_view<'a>(&self, tile: &TileRecord, values: &'a [f32]) -> Tile<'a> {
        Tile {
            values,
            frames: tile.frames as usize,
            width: self.layout.columns[tile.id.column as usize].width as usize,
            len: self.layout.block_len(tile.id.gaussian_block) as usize,
            constant: tile.constant,
        }
    }
}

impl TileBuffer {
    /// Returns the values of the tile that was read last into this buffer.
    pub(crate) fn values(&self) -> &[f32] {
        &self.values
    }

    /// Returns the stored bytes of the tile that was read last into this buffer.
    pub(crate) fn stored(&self) -> &[u8] {
        &self.stored
    }
}

/// Reads the stored bytes of a tile into `buffer`, checks their checksum and decodes them. `tile` is the index entry of
/// the tile, which states where and how it is stored. The caller must have checked this entry against `layout`.
pub(crate) fn read_tile(file: &MappedFile, layout: &Layout, tile: &TileRecord, buffer: &mut TileBuffer) -> Result<()> {
    let TileBuffer { stored, decoder, values, zstd } = buffer;
    read_stored(file, tile, stored)?;
    values.resize(tile.value_count(layout), 0.0);
    match tile.encoding {
        Encoding::Raw => {
            for (value, bytes) in values.iter_mut().zip(stored.as_chunks().0) {
                *value = f32::from_le_bytes(*bytes);
            }
        }
        Encoding::Filtered { .. } | Encoding::Bounded { .. } => {
            decompress(file, layout, tile, stored, zstd, decoder)?;
            for (frame, out) in values.chunks_exact_mut(plane_len(layout, tile)).enumerate() {
                decoder.frame(frame, bytemuck::cast_slice_mut(out));
            }
        }
    }
    Ok(())
}

/// Reads the stored bytes of the tile with the index entry `tile` into `stored` and checks their checksum.
fn read_stored(file: &MappedFile, tile: &TileRecord, stored: &mut Vec<u8>) -> Result<()> {
    stored.resize(tile.stored_bytes as usize, 0);
    file.read_at(tile.offset, stored)?;
    check_payload(tile, xxh3_64(stored)).map_err(|fault| fault.at(file.path()))
}

/// Decompresses a tile that is not raw into the decoder `frames`, which can then decode the frames of the tile one by
/// one. `tile` is the index entry of the tile, and `stored` its stored bytes. Creates the decompressor `zstd` if it is
/// `None`.
fn decompress(
    file: &MappedFile,
    layout: &Layout,
    tile: &TileRecord,
    stored: &[u8],
    zstd: &mut Option<Decompressor<'static>>,
    frames: &mut TileDecoder,
) -> Result<()> {
    let zstd = match zstd {
        Some(zstd) => zstd,
        None => zstd.insert(Decompressor::new().map_err(Error::io("decompress", file.path()))?),
    };
    let plane = plane_len(layout, tile);
    let values = tile.value_count(layout);
    let max_error = layout.columns[tile.id.column as usize].max_error;
    let stored = StoredTile { bytes: stored, encoding: tile.encoding, frames: values / plane, plane, max_error };
    frames
        .load(stored, zstd)
        .map_err(|found| Fault::new(tile.offset, format!("{} bytes of {}", 4 * values, tile.id), found).at(file.path()))
}

/// Returns the number of values per frame of the tile with the index entry `tile`: components times Gaussians.
fn plane_len(layout: &Layout, tile: &TileRecord) -> usize {
    layout.columns[tile.id.column as usize].width as usize * layout.block_len(tile.id.gaussian_block) as usize
}

/// Reads and checks the header of a file. Returns the layout that the header describes, and the bytes of the header.
pub(crate) fn read_header(file: &MappedFile) -> Result<(Layout, Vec<u8>)> {
    let fault = |fault: Fault| fault.at(file.path());
    let mut fixed = [0; FIXED_HEADER_BYTES];
    file.read_at(0, &mut fixed)?;
    let len = Layout::header_len_from(&fixed).map_err(fault)?;
    let mut header = vec![0; len];
    file.read_at(0, &mut header)?;
    Ok((Layout::from_header(&header).map_err(fault)?, header))
}

/// Checks that `computed`, the checksum of the bytes read for a tile, equals the checksum in its index entry `tile`.
fn check_payload(tile: &TileRecord, computed: u64) -> std::result::Result<(), Fault> {
    if computed == tile.checksum {
        return Ok(());
    }
    let expected = format!("{} with checksum {:016x}", tile.id, tile.checksum);
    Err(Fault::new(tile.offset, expected, format!("{computed:016x}")))
}

/// Checks that the footer belongs to the file's header, of which `header` holds the bytes. Also checks that the
/// footer's numbers of frames and tiles agree with `layout` and with the length of its payload. `offset` is the offset
/// of the footer record in the file, `payload_bytes` the number of bytes between this record and the trailer.
fn check_footer(
    footer: &FooterRecord,
    layout: &Layout,
    header: &[u8],
    offset: u64,
    payload_bytes: u64,
) -> std::result::Result<(), Fault> {
    let header_checksum = xxh3_64(header);
    if footer.header_checksum != header_checksum {
        let expected = format!("the footer of header {header_checksum:016x}");
        return Err(Fault::new(offset + 24, expected, format!("{:016x}", footer.header_checksum)));
    }
    let blocks = footer.frames.div_ceil(layout.frame_block.into());
    let tiles = blocks.checked_mul(layout.tiles_per_frame_block());
    if blocks > u32::MAX.into() || tiles != Some(footer.tiles) {
        let expected = format!("the tiles of {} frames", footer.frames);
        return Err(Fault::new(offset + 16, expected, format!("{} tiles", footer.tiles)));
    }
    if footer.payload_bytes() != Some(payload_bytes) {
        let expected = format!("{} time stamps and {} index entries", footer.frames, footer.tiles);
        return Err(Fault::new(offset + 8, expected, format!("{payload_bytes} bytes before the trailer")));
    }
    Ok(())
}
