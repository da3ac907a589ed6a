//! Opens a finished container and hands out its tiles, from any number of threads.

use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use xxhash_rust::xxh3::{Xxh3, xxh3_64};
use zstd::bulk::Decompressor;

use crate::codec::{Encoding, Stats, Stored, Unfilter};
use crate::error::{Error, Fault, Result};
use crate::file::MappedFile;
use crate::index::{Index, check_memory};
use crate::layout::{FIXED_HEADER, Layout, TileId};
use crate::record::{Digest, FooterRecord, RECORD, Record, TRAILER, TileRecord, align, trailer_from_bytes};
use crate::text::ShowPath;
use crate::writer::check_times;

/// Tiles closer than this are expected and released together.
const NEAR: u64 = 1 << 12;

/// A finished container. Memory: 8 bytes per frame, 1 per tile, some 80 per column and Gaussian block while opening;
/// index and values stay on disk. A file whose tiles lie in another order than its index, as a writer makes that is
/// given them so, takes 80 bytes per tile while opening.
///
/// What happens when the file changes underneath: see [`Reader::tile`].
pub struct Reader {
    pub(crate) file: MappedFile,
    pub(crate) layout: Layout,
    pub(crate) times: Vec<f64>,
    pub(crate) index: Index,
    pub(crate) footer_offset: u64,
    /// Per column whether its values differ between frames.
    varies: Vec<bool>,
    /// Per tile whether its bytes in the map have matched their checksum.
    verified: Vec<AtomicBool>,
    digest: u64,
    read_bytes: AtomicU64,
    read_tiles: AtomicU64,
}

/// Room for tiles that have to be read and decoded; reuse it. Grows to three times the largest decoded tile.
#[derive(Default)]
pub struct TileBuffer {
    stored: Vec<u8>,
    unfilter: Unfilter,
    values: Vec<f32>,
    /// Made when the first compressed tile comes.
    zstd: Option<Decompressor<'static>>,
}

/// The frames of one tile, one at a time and best in order: see [`Reader::load`].
///
/// Memory: of a packed tile 4 bytes per value of all its frames and 8 per value of one; of a raw tile nothing, but for
/// what is used of it in place, until it is released.
#[derive(Debug, Default)]
pub struct TileFrames {
    tile: Option<TileRecord>,
    unfilter: Unfilter,
    /// Whether a raw tile is used in place.
    in_place: bool,
    /// What of a raw tile has been counted as read.
    counted: Counted,
}

/// What of a raw tile has been counted as read.
#[derive(Debug, Default, Clone, Copy, PartialEq)]
enum Counted {
    #[default]
    Nothing,
    /// The frame read last.
    Frame(usize),
    /// All of it, when it was verified.
    Tile,
}

/// Tiles that were used in place and whose pages are to be released together: see [`Reader::release`].
#[derive(Debug, Default)]
pub struct Touched {
    ranges: Vec<Range<u64>>,
    bytes: u64,
}

/// What of a container's tiles was read from the file.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TilesRead {
    /// Stored bytes of tiles.
    pub bytes: u64,
    /// Tiles that were decoded or, if raw, taken into use.
    pub tiles: u64,
}

/// The values of one tile.
#[derive(Debug, Clone, Copy)]
pub struct Tile<'a> {
    values: &'a [f32],
    frames: usize,
    width: usize,
    len: usize,
    constant: bool,
}

/// What the index says of a tile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileInfo {
    /// How its bytes are to be read.
    pub encoding: Encoding,
    /// Whether one frame stands for all.
    pub constant: bool,
    /// Frames it covers.
    pub frames: u32,
    /// Where its stored bytes start. Constant tiles of other frame blocks may share them.
    pub offset: u64,
    /// Length of its stored bytes.
    pub stored_bytes: u64,
    /// xxh3-64 of its stored bytes.
    pub checksum: u64,
    /// Minimum, maximum, count of non-finite values.
    pub stats: Stats,
}

impl<'a> Tile<'a> {
    /// Component `component` of every Gaussian of the block at `frame`, both counted from the tile's first. A
    /// constant tile gives the same plane for every frame.
    ///
    /// # Panics
    /// If the tile has no such frame or component.
    pub fn plane(&self, frame: usize, component: usize) -> &'a [f32] {
        assert!(frame < self.frames && component < self.width, "no frame {frame}, component {component} in {self:?}");
        let frame = if self.constant { 0 } else { frame };
        &self.values[(frame * self.width + component) * self.len..][..self.len]
    }

    /// Everything that is stored, `[frame][component][gaussian]`; of a constant tile one frame.
    pub fn values(&self) -> &'a [f32] {
        self.values
    }

    /// Frames it covers, also if it is constant.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Components per Gaussian.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Gaussians; never 0.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether one frame is stored for all.
    pub fn is_constant(&self) -> bool {
        self.constant
    }
}

impl Reader {
    /// Opens a container and checks its header, footer and index: every length and place lies within its limits, no
    /// two tiles overlap. The tiles themselves are checked when they are read, or by [`Reader::verify`].
    pub fn open(path: impl AsRef<Path>) -> Result<Reader> {
        Self::open_within(path, u64::MAX)
    }

    /// [`Reader::open`] with at most `memory` bytes for time stamps and what is known of tiles. Errors: the container
    /// needs more.
    pub fn open_within(path: impl AsRef<Path>, memory: u64) -> Result<Reader> {
        let file = MappedFile::open(path.as_ref())?;
        Self::read(file, memory)
    }

    fn read(file: MappedFile, memory: u64) -> Result<Reader> {
        let fault = |fault: Fault| fault.at(file.path());
        let (layout, header) = read_header(&file)?;
        let first_record = align(header.len() as u64);

        let least = first_record + RECORD + TRAILER;
        if file.len() < least {
            let short = Fault::new(file.len(), format!("a container of at least {least} bytes"), "the end of the file");
            return Err(fault(short.hint("the file is cut short; nothing but its header is left")));
        }
        let mut trailer = [0; TRAILER as usize];
        let trailer_offset = file.len() - TRAILER;
        file.read_at(trailer_offset, &mut trailer)?;
        let footer_offset = trailer_from_bytes(&trailer, trailer_offset).map_err(fault)?;
        let room = first_record..trailer_offset - RECORD + 1;
        if !room.contains(&footer_offset) || !footer_offset.is_multiple_of(RECORD) {
            let expected =
                format!("a footer within bytes {} to {}, at a multiple of {RECORD}", room.start, trailer_offset);
            return Err(fault(Fault::new(trailer_offset, expected, footer_offset)));
        }

        let mut record = [0; RECORD as usize];
        file.read_at(footer_offset, &mut record)?;
        let footer = match Record::from_bytes(&record, footer_offset).map_err(fault)? {
            Record::Footer(footer) => footer,
            other => return Err(fault(Fault::new(footer_offset, "the footer", other))),
        };
        let start = footer_offset + RECORD;
        check_footer(&footer, &layout, &header, footer_offset, trailer_offset - start).map_err(fault)?;
        // A time stamp per frame, a flag per tile, and the last constant tile of each column and Gaussian block.
        let slots = layout.tiles_per_frame_block().min(footer.tiles);
        let needed = footer.frames.saturating_mul(8) + footer.tiles + slots * size_of::<Option<TileRecord>>() as u64;
        check_memory(footer_offset, needed, memory).map_err(fault)?;
        let mut piece = Vec::new();
        let mut hash = Xxh3::new();
        file.read_pieces(start..trailer_offset, &mut piece, |_, bytes| {
            hash.update(bytes);
            Ok(())
        })?;
        let computed = hash.digest();
        if computed != footer.checksum {
            let expected = format!("footer checksum {computed:016x}");
            return Err(fault(Fault::new(footer_offset + 32, expected, format!("{:016x}", footer.checksum))));
        }

        // As many as the file says, and the file is that long: no more memory than the file has bytes.
        let mut times = Vec::with_capacity(footer.frames as usize);
        let index_offset = start + 8 * footer.frames;
        file.read_pieces(start..index_offset, &mut piece, |_, bytes| {
            times.extend(bytes.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)));
            Ok(())
        })?;
        check_times(None, &times)
            .map_err(|(frame, found)| {
                Fault::new(start + 8 * frame as u64, "finite, strictly increasing time stamps", found)
            })
            .map_err(fault)?;
        let payloads = first_record + RECORD..footer_offset;
        let index = Index { offset: index_offset, tiles: footer.tiles, frames: footer.frames, payloads };
        let mut digest = Digest::new(&header, &times);
        let varies = index.check(&file, &layout, &mut piece, &mut digest, memory - needed)?;
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

    /// The shape of the container.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Time stamp of every frame, strictly increasing.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// T, the number of frames.
    pub fn frames(&self) -> usize {
        self.times.len()
    }

    /// Number of frame blocks.
    pub fn frame_blocks(&self) -> u32 {
        self.times.len().div_ceil(self.layout.frame_block as usize) as u32
    }

    /// Whether a column's values differ between frames, by the index alone: if not, its tiles are constant each and
    /// share their stored bytes.
    ///
    /// # Panics
    /// If there is no such column.
    pub fn varies(&self, column: u32) -> bool {
        self.varies[column as usize]
    }

    /// Identifies the content: a hash of header, time stamps and the checksums and statistics of every tile. The same
    /// for the same content, layout and compression, in whatever order the tiles were written.
    pub fn digest(&self) -> u64 {
        self.digest
    }

    /// What the index says of a tile, which is read from the file. Errors: there is no such tile.
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

    /// The values of a tile: in place from the map if it is stored raw, else decoded into `buffer`.
    ///
    /// The checksum is verified, for tiles in place once. If the file shrinks before this call, the call ends in an
    /// error; if it shrinks while the slice of a raw tile is in use, the system may end the process, and a file
    /// rewritten in place shows through. Use [`Reader::read_tile`] where others may do that to the file.
    pub fn tile<'a>(&'a self, at: TileId, buffer: &'a mut TileBuffer) -> Result<Tile<'a>> {
        let (index, tile) = self.record(at)?;
        if tile.encoding == Encoding::Raw && cfg!(target_endian = "little") {
            let bytes = self.file.in_place(tile.offset, tile.stored_bytes.into())?;
            self.verify_in_place(index, &tile, bytes)?;
            self.count(1, bytes.len());
            // Offsets are multiples of 64 and maps start at a page: the bytes are aligned.
            if let Ok(values) = bytemuck::try_cast_slice(bytes) {
                return Ok(self.shaped(&tile, values));
            }
        }
        self.read_record(&tile, buffer)
    }

    /// The values of a tile, always copied into `buffer` by ordinary reads and verified: the map is not touched,
    /// so that a file cut short at any moment ends in an error.
    pub fn read_tile<'a>(&self, at: TileId, buffer: &'a mut TileBuffer) -> Result<Tile<'a>> {
        self.read_record(&self.record(at)?.1, buffer)
    }

    /// Makes `frames` give the frames of a tile: decompresses it, or, if it is raw, verifies it unless it has been.
    /// No values of it stay in `buffer`.
    ///
    /// With `touched` stored bytes are used where they lie in the map, with the promise of [`Reader::tile`], and noted
    /// there, to be released ([`Reader::release`]): a packed tile's as soon as this returns, a raw one's once its
    /// frames have been read. Without, by ordinary reads, like [`Reader::read_tile`]: cheaper where just a frame of a
    /// raw tile is read before it is released.
    pub fn load(
        &self,
        at: TileId,
        buffer: &mut TileBuffer,
        frames: &mut TileFrames,
        touched: Option<&mut Touched>,
    ) -> Result<()> {
        let (index, tile) = self.record(at)?;
        // Set last: after an error no frames are given.
        frames.tile = None;
        frames.in_place = touched.is_some();
        frames.counted = Counted::Nothing;
        let mapped = match touched {
            Some(touched) => {
                touched.add(&tile);
                Some(self.file.in_place(tile.offset, tile.stored_bytes.into())?)
            }
            None => None,
        };
        match (tile.encoding, mapped) {
            (Encoding::Raw, mapped) => {
                let verified = match mapped {
                    Some(bytes) => self.verify_in_place(index, &tile, bytes)?,
                    None => self.verify_raw(index, &tile, &mut buffer.stored)?,
                };
                self.count(1, if verified { tile.stored_bytes as usize } else { 0 });
                if verified {
                    frames.counted = Counted::Tile;
                }
            }
            (Encoding::Filtered { .. } | Encoding::Bounded { .. }, mapped) => {
                let TileBuffer { stored, zstd, .. } = buffer;
                let stored = match mapped {
                    Some(bytes) => {
                        check_payload(&tile, xxh3_64(bytes)).map_err(|fault| fault.at(self.file.path()))?;
                        bytes
                    }
                    None => {
                        read_stored(&self.file, &tile, stored)?;
                        stored
                    }
                };
                self.count(1, stored.len());
                unfilter(&self.file, &self.layout, &tile, stored, zstd, &mut frames.unfilter)?;
            }
        }
        frames.tile = Some(tile);
        Ok(())
    }

    /// Writes the values of a frame, counted from the tile's first, into `out`: `[width, len]` of the tile that was
    /// loaded. Of a raw tile just these bytes are read from the file or, if it was loaded so, copied from the map.
    ///
    /// # Panics
    /// If `out` is of another size, or the tile that this reader loaded last into `frames` has no such frame, or no
    /// tile was.
    pub fn read_frame(&self, frames: &mut TileFrames, frame: usize, out: &mut [f32]) -> Result<()> {
        let (tile, frame) = self.frame_of(frames, frame);
        let plane = plane_of(&self.layout, &tile);
        assert!(out.len() == plane, "{} values for a frame of {tile:?}", out.len());
        match tile.encoding {
            Encoding::Raw => {
                self.count_frame(frames, frame, 4 * plane);
                let (offset, bytes) = (frame_offset(&tile, frame, plane), bytemuck::cast_slice_mut(&mut *out));
                match frames.in_place {
                    true => bytes.copy_from_slice(self.file.in_place(offset, bytes.len() as u64)?),
                    false => self.file.read_at(offset, bytes)?,
                }
                out.iter_mut().for_each(|value| *value = f32::from_bits(u32::from_le(value.to_bits())));
            }
            Encoding::Filtered { .. } | Encoding::Bounded { .. } => {
                frames.unfilter.frame(frame, bytemuck::cast_slice_mut(out));
            }
        }
        Ok(())
    }

    /// The values of a frame, as [`Reader::read_frame`] gives them: where they lie in the map if the tile is raw and
    /// was loaded so, else in `room`.
    ///
    /// # Panics
    /// If the tile that this reader loaded last into `frames` has no such frame, or no tile was.
    pub fn frame<'a>(&'a self, frames: &mut TileFrames, frame: usize, room: &'a mut Vec<f32>) -> Result<&'a [f32]> {
        let (tile, stored) = self.frame_of(frames, frame);
        let plane = plane_of(&self.layout, &tile);
        if tile.encoding == Encoding::Raw && frames.in_place && cfg!(target_endian = "little") {
            let bytes = self.file.in_place(frame_offset(&tile, stored, plane), 4 * plane as u64)?;
            if let Ok(values) = bytemuck::try_cast_slice(bytes) {
                self.count_frame(frames, stored, bytes.len());
                return Ok(values);
            }
        }
        room.resize(plane, 0.0);
        self.read_frame(frames, frame, room)?;
        Ok(room)
    }

    /// Writes all that is stored of the tile that was loaded to `out`, `[frames, width, len]`; of a constant one a
    /// frame.
    ///
    /// # Panics
    /// If `out` is of another size, or no tile was loaded.
    pub fn read_frames(&self, frames: &mut TileFrames, out: &mut [f32]) -> Result<()> {
        let (tile, _) = self.frame_of(frames, 0);
        assert!(out.len() == tile.values(&self.layout), "{} values for {tile:?}", out.len());
        let planes = out.chunks_exact_mut(plane_of(&self.layout, &tile)).enumerate();
        planes.into_iter().try_for_each(|(frame, out)| self.read_frame(frames, frame, out))
    }

    /// Gives the pages of tiles that were used in place back to the system, so that they no longer count as this
    /// process's memory.
    pub fn release(&self, touched: &mut Touched) {
        touched.bytes = 0;
        touched.ranges.sort_unstable_by_key(|range| range.start);
        let mut together: Range<u64> = 0..0;
        for range in touched.ranges.drain(..) {
            if range.start > together.end + NEAR {
                self.file.release(std::mem::replace(&mut together, range));
            } else {
                together.end = together.end.max(range.end);
            }
        }
        self.file.release(together);
    }

    /// What of the tiles has been read so far, by whomever. Bytes count as often as they are read; of a raw tile that
    /// has been verified those of the frames read.
    pub fn tiles_read(&self) -> TilesRead {
        TilesRead { bytes: self.read_bytes.load(Ordering::Relaxed), tiles: self.read_tiles.load(Ordering::Relaxed) }
    }

    /// Tells the system that tiles will be read soon, so that the disk brings them while others are worked on.
    /// Costs no memory of this process; that the file cannot be read shows when it is.
    pub fn expect(&self, tiles: impl IntoIterator<Item = TileId>) {
        let mut ahead = 0..0;
        for (_, tile) in tiles.into_iter().filter_map(|at| self.record(at).ok()) {
            let end = tile.offset + u64::from(tile.stored_bytes);
            // Columns of a block lie side by side, with a record between.
            if tile.offset < ahead.end || tile.offset - ahead.end > NEAR {
                self.file.expect(ahead);
                ahead = tile.offset..end;
            }
            ahead.end = end;
        }
        self.file.expect(ahead);
    }

    /// Brings the stored bytes of tiles from the disk, and waits for them, so that whoever decodes them does not. Takes
    /// a small buffer. That the file cannot be read shows when the tiles are.
    pub fn fetch(&self, tiles: impl IntoIterator<Item = TileId>) {
        let mut piece = Vec::new();
        for (_, tile) in tiles.into_iter().filter_map(|at| self.record(at).ok()) {
            _ = self.file.fetch(tile.offset..tile.offset + u64::from(tile.stored_bytes), &mut piece);
        }
    }

    /// Whether the system holds the file in its memory, judged by `samples` places in it, evenly spread; none if it
    /// does not tell.
    pub fn is_cached(&self, samples: u64) -> Option<bool> {
        let step = (self.file.len() / samples.max(1)).max(1);
        let mut places = (0..self.file.len()).step_by(step as usize).map(|offset| self.file.is_cached(offset));
        // Nine of ten: the odd page that was dropped costs less than another way of reading.
        let (mut cached, mut all) = (0, 0);
        places.try_for_each(|found| {
            cached += u64::from(found?);
            all += 1;
            Some(())
        })?;
        Some(10 * cached >= 9 * all)
    }

    /// The tile that was loaded, and where the frame is that stands for `frame` in it.
    fn frame_of(&self, frames: &TileFrames, frame: usize) -> (TileRecord, usize) {
        let Some(tile) = frames.tile else { panic!("frame {frame} of no tile") };
        assert!(frame < tile.frames as usize, "frame {frame} of {tile:?}");
        (tile, if tile.constant { 0 } else { frame })
    }

    fn count(&self, tiles: u64, bytes: usize) {
        // Relaxed: sums that are looked at when the reading is done.
        self.read_tiles.fetch_add(tiles, Ordering::Relaxed);
        self.read_bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// Counts the bytes of a raw tile's frame, unless they have been.
    fn count_frame(&self, frames: &mut TileFrames, frame: usize, bytes: usize) {
        if frames.counted != Counted::Tile && frames.counted != Counted::Frame(frame) {
            frames.counted = Counted::Frame(frame);
            self.count(0, bytes);
        }
    }

    /// Verifies the bytes of a raw tile unless they have been; gives whether they were now.
    fn verify_in_place(&self, index: usize, tile: &TileRecord, bytes: &[u8]) -> Result<bool> {
        // Relaxed: the flag guards nothing but repeated work.
        if self.verified[index].load(Ordering::Relaxed) {
            return Ok(false);
        }
        check_payload(tile, xxh3_64(bytes)).map_err(|fault| fault.at(self.file.path()))?;
        self.verified[index].store(true, Ordering::Relaxed);
        Ok(true)
    }

    /// Verifies a raw tile, through `piece`, unless it has been: its frames are read one by one afterwards. Gives
    /// whether it was now.
    fn verify_raw(&self, index: usize, tile: &TileRecord, piece: &mut Vec<u8>) -> Result<bool> {
        if self.verified[index].load(Ordering::Relaxed) {
            return Ok(false);
        }
        let mut hash = Xxh3::new();
        self.file.read_pieces(tile.offset..tile.offset + u64::from(tile.stored_bytes), piece, |_, bytes| {
            hash.update(bytes);
            Ok(())
        })?;
        check_payload(tile, hash.digest()).map_err(|fault| fault.at(self.file.path()))?;
        self.verified[index].store(true, Ordering::Relaxed);
        Ok(true)
    }

    /// Place of a tile in the index and what stands there.
    fn record(&self, at: TileId) -> Result<(usize, TileRecord)> {
        let index = self.layout.index_of(at).filter(|&index| index < self.index.tiles).ok_or_else(|| {
            let frames = self.frames();
            Error::usage(format!("{}: there is nothing such as {at} in {frames} frames", self.file.path().shown()))
        })?;
        Ok((index as usize, self.index.record(&self.file, &self.layout, index)?))
    }

    fn read_record<'a>(&self, tile: &TileRecord, buffer: &'a mut TileBuffer) -> Result<Tile<'a>> {
        read_tile(&self.file, &self.layout, tile, buffer)?;
        self.count(1, tile.stored_bytes as usize);
        Ok(self.shaped(tile, &buffer.values))
    }

    fn shaped<'a>(&self, tile: &TileRecord, values: &'a [f32]) -> Tile<'a> {
        Tile {
            values,
            frames: tile.frames as usize,
            width: self.layout.columns[tile.id.column as usize].width as usize,
            len: self.layout.block_len(tile.id.gaussian_block) as usize,
            constant: tile.constant,
        }
    }
}

impl TileFrames {
    /// Bytes it holds.
    pub fn memory(&self) -> usize {
        self.unfilter.memory()
    }

    /// Whether the tile is raw and used where it lies in the map.
    pub fn is_in_place(&self) -> bool {
        self.in_place && self.tile.is_some_and(|tile| tile.encoding == Encoding::Raw)
    }
}

impl Touched {
    /// Bytes of the map that wait to be released.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Takes over what another waits to release.
    pub fn append(&mut self, other: &mut Touched) {
        self.ranges.append(&mut other.ranges);
        self.bytes += std::mem::take(&mut other.bytes);
    }

    fn add(&mut self, tile: &TileRecord) {
        self.bytes += u64::from(tile.stored_bytes);
        self.ranges.push(tile.offset..tile.offset + u64::from(tile.stored_bytes));
    }
}

impl TileBuffer {
    /// The values of the tile that was read last.
    pub(crate) fn values(&self) -> &[f32] {
        &self.values
    }

    /// The stored bytes of the tile that was read last.
    pub(crate) fn stored(&self) -> &[u8] {
        &self.stored
    }
}

/// Reads, verifies and decodes the tile of a checked record.
pub(crate) fn read_tile(file: &MappedFile, layout: &Layout, tile: &TileRecord, buffer: &mut TileBuffer) -> Result<()> {
    let TileBuffer { stored, unfilter: frames, values, zstd } = buffer;
    read_stored(file, tile, stored)?;
    values.resize(tile.values(layout), 0.0);
    match tile.encoding {
        Encoding::Raw => {
            for (value, bytes) in values.iter_mut().zip(stored.as_chunks().0) {
                *value = f32::from_le_bytes(*bytes);
            }
        }
        Encoding::Filtered { .. } | Encoding::Bounded { .. } => {
            unfilter(file, layout, tile, stored, zstd, frames)?;
            for (frame, out) in values.chunks_exact_mut(plane_of(layout, tile)).enumerate() {
                frames.frame(frame, bytemuck::cast_slice_mut(out));
            }
        }
    }
    Ok(())
}

/// Reads and verifies the stored bytes of a tile.
fn read_stored(file: &MappedFile, tile: &TileRecord, stored: &mut Vec<u8>) -> Result<()> {
    stored.resize(tile.stored_bytes as usize, 0);
    file.read_at(tile.offset, stored)?;
    check_payload(tile, xxh3_64(stored)).map_err(|fault| fault.at(file.path()))
}

/// Decompresses the stored bytes of a tile that is not raw.
fn unfilter(
    file: &MappedFile,
    layout: &Layout,
    tile: &TileRecord,
    stored: &[u8],
    zstd: &mut Option<Decompressor<'static>>,
    frames: &mut Unfilter,
) -> Result<()> {
    let zstd = match zstd {
        Some(zstd) => zstd,
        None => zstd.insert(Decompressor::new().map_err(Error::io("decompress", file.path()))?),
    };
    let plane = plane_of(layout, tile);
    let values = tile.values(layout);
    let max_error = layout.columns[tile.id.column as usize].max_error;
    let stored = Stored { bytes: stored, encoding: tile.encoding, frames: values / plane, plane, max_error };
    frames
        .load(stored, zstd)
        .map_err(|found| Fault::new(tile.offset, format!("{} bytes of {}", 4 * values, tile.id), found).at(file.path()))
}

/// Where a frame of a raw tile lies.
fn frame_offset(tile: &TileRecord, frame: usize, plane: usize) -> u64 {
    tile.offset + 4 * (frame * plane) as u64
}

/// Values of a tile in one frame.
fn plane_of(layout: &Layout, tile: &TileRecord) -> usize {
    layout.columns[tile.id.column as usize].width as usize * layout.block_len(tile.id.gaussian_block) as usize
}

/// Reads and checks the header: the layout, and the header's bytes.
pub(crate) fn read_header(file: &MappedFile) -> Result<(Layout, Vec<u8>)> {
    let fault = |fault: Fault| fault.at(file.path());
    let mut fixed = [0; FIXED_HEADER];
    file.read_at(0, &mut fixed)?;
    let len = Layout::header_len_from(&fixed).map_err(fault)?;
    let mut header = vec![0; len];
    file.read_at(0, &mut header)?;
    Ok((Layout::from_header(&header).map_err(fault)?, header))
}

fn check_payload(tile: &TileRecord, computed: u64) -> std::result::Result<(), Fault> {
    if computed == tile.checksum {
        return Ok(());
    }
    let expected = format!("{} with checksum {:016x}", tile.id, tile.checksum);
    Err(Fault::new(tile.offset, expected, format!("{computed:016x}")))
}

fn check_footer(
    footer: &FooterRecord,
    layout: &Layout,
    header: &[u8],
    offset: u64,
    room: u64,
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
    if footer.payload() != Some(room) {
        let expected = format!("{} time stamps and {} index entries", footer.frames, footer.tiles);
        return Err(Fault::new(offset + 8, expected, format!("{room} bytes before the trailer")));
    }
    Ok(())
}
