//! Recovery of the complete frame blocks of a container that was cut short, or that is damaged after its header.

use std::collections::HashMap;
use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use crate::codec::EncodedTile;
use crate::error::{Fault, Result};
use crate::file::MappedFile;
use crate::index::check_memory;
use crate::layout::Layout;
use crate::reader::{TileBuffer, read_header, read_tile};
use crate::record::{RECORD_BYTES, Record, TileRecord, TimesRecord, align};
use crate::verify::check_stats;
use crate::writer::{Writer, check_times};

/// Result of [`recover`]: numbers of frames, tiles and bytes that were found and saved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecoverReport {
    /// Number of frames in the new container.
    pub frames: u64,
    /// Number of frames whose time stamps were found in the damaged file.
    pub frames_seen: u64,
    /// Number of intact tiles that were found in the damaged file.
    pub tiles_seen: u64,
    /// Number of tiles in the new container. The other intact tiles belong to an incomplete frame block or to a frame
    /// block after an incomplete one.
    pub tiles_saved: u64,
    /// Number of bytes of the damaged file that were skipped, because they belong to no intact tile, time stamps or
    /// footer.
    pub bytes_skipped: u64,
}

/// Recovers a damaged container and returns a report. Writes a valid container `dst` with the frame blocks of the
/// damaged container `src`, up to the first frame block that lacks its time stamps or a tile. Every value keeps its
/// bits. After a damaged record, every multiple of 64 bytes is tried as the start of the next record. Memory: about 150
/// bytes per tile, the time stamps, and one [`TileBuffer`].
///
/// Fails if the header of `src` is damaged or `dst` cannot be written. If no frame can be saved, `dst` has no frames
/// and the report says so; that is not an error.
pub fn recover(src: impl AsRef<Path>, dst: impl AsRef<Path>) -> Result<RecoverReport> {
    recover_within(src, dst, u64::MAX)
}

/// Recovers a container like [`recover`], with at most `memory` bytes of memory. Also fails if more is needed.
pub fn recover_within(src: impl AsRef<Path>, dst: impl AsRef<Path>, memory: u64) -> Result<RecoverReport> {
    let file = MappedFile::open(src.as_ref())?;
    let (layout, header) = read_header(&file)?;
    let found = scan(&file, &layout, align(header.len() as u64), memory)?;
    let mut report = RecoverReport {
        frames: 0,
        frames_seen: found.times.values().map(|times| times.len() as u64).sum(),
        tiles_seen: found.tiles.len() as u64,
        tiles_saved: 0,
        bytes_skipped: found.skipped,
    };
    let per_block = layout.tiles_per_frame_block();
    let full = layout.frame_block as usize;
    let mut last = None;
    let mut buffer = TileBuffer::default();
    let mut writer = Writer::create(dst, layout.clone())?;
    for block in 0..=u32::MAX {
        let first = u64::from(block) * per_block;
        let Some(times) = found.times.get(&block).filter(|times| check_times(last, times).is_ok()) else { break };
        let tiles: Option<Vec<&TileRecord>> = (first..first + per_block)
            .map(|index| found.tiles.get(&index).filter(|tile| tile.frames as usize == times.len()))
            .collect();
        let Some(tiles) = tiles else { break };
        writer.append_times(times)?;
        for tile in tiles {
            read_tile(&file, &layout, tile, &mut buffer)?;
            writer.write_tile(tile.id, &encoded(tile, &layout, buffer.stored()))?;
            report.tiles_saved += 1;
        }
        report.frames += times.len() as u64;
        last = times.last().copied();
        if times.len() < full {
            break;
        }
    }
    writer.finish()?;
    Ok(report)
}

/// Creates an encoded tile for [`crate::Writer::write_tile`] from the record `tile` (header of the tile in the damaged
/// file) and `stored`, the stored bytes of the tile, without encoding its values again.
fn encoded(tile: &TileRecord, layout: &Layout, stored: &[u8]) -> EncodedTile {
    let column = &layout.columns[tile.id.column as usize];
    EncodedTile {
        frames: tile.frames,
        width: column.width,
        max_error: column.max_error,
        len: layout.block_len(tile.id.gaussian_block),
        constant: tile.constant,
        encoding: tile.encoding,
        stats: tile.stats,
        checksum: tile.checksum,
        bytes: stored.to_vec(),
    }
}

/// Intact content that was found in a damaged file. `times` holds the time stamps of each frame block by the number of
/// the block, `tiles` the record (header) of each tile by its position in the index, and `skipped` is the number of
/// bytes that belong to no intact record.
struct FoundRecords {
    times: HashMap<u32, Vec<f64>>,
    tiles: HashMap<u64, TileRecord>,
    /// Records (headers) of constant tiles (all frames equal) that have stored bytes of their own, which later tiles
    /// may share. The key is the offset of these bytes.
    constants: HashMap<u64, TileRecord>,
    skipped: u64,
    /// Number of bytes of all time stamps found in the damaged file (8 per frame).
    time_bytes: u64,
}

/// Finds the intact records of `file` from offset `start` on, one after the other. After a damaged record, it tries
/// every multiple of 64 bytes. Fails if a read fails, or if the records found need more than `memory` bytes of memory.
///
/// The record of a tile contains the offset of the stored bytes of the tile. Bytes inside a payload that look like such
/// a record are therefore not mistaken for a tile, unless their offset is correct, too.
fn scan(file: &MappedFile, layout: &Layout, start: u64, memory: u64) -> Result<FoundRecords> {
    let mut found = FoundRecords {
        times: HashMap::new(),
        tiles: HashMap::new(),
        constants: HashMap::new(),
        skipped: 0,
        time_bytes: 0,
    };
    let mut buffer = TileBuffer::default();
    let mut position = start;
    while position + RECORD_BYTES <= file.len() {
        let mut bytes = [0; RECORD_BYTES as usize];
        file.read_at(position, &mut bytes)?;
        let payload = position + RECORD_BYTES;
        check_memory(position, found.bytes(layout), memory).map_err(|fault| fault.at(file.path()))?;
        let len = match Record::from_bytes(&bytes, position) {
            Ok(Record::Tile(tile)) => found.add_tile(file, layout, &tile, position, start, &mut buffer),
            Ok(Record::Times(times)) => read_times(file, layout, &times, position).ok().map(|stamps| {
                let len = 8 * stamps.len() as u64;
                found.time_bytes += len;
                found.times.entry(times.frame_block).or_insert(stamps);
                len
            }),
            // Only the trailer follows the footer.
            Ok(Record::Footer(footer)) if footer.payload_bytes().is_some_and(|len| len <= file.len() - payload) => {
                break;
            }
            Ok(Record::Footer(_)) | Err(_) => None,
        };
        match len {
            Some(len) => position = align(payload + len),
            None => {
                found.skipped += RECORD_BYTES;
                position += RECORD_BYTES;
            }
        }
    }
    if position < file.len() && position + RECORD_BYTES > file.len() {
        found.skipped += file.len() - position;
    }
    Ok(found)
}

impl FoundRecords {
    /// Returns the bytes of memory that recovery needs for the records found so far: the lists of records with room for
    /// their growth, and buffers to decode the largest tile.
    fn bytes(&self, layout: &Layout) -> u64 {
        let tiles = (self.tiles.capacity() + self.constants.capacity()) * 3 / 2 * (size_of::<TileRecord>() + 16);
        let times = 2 * self.time_bytes + 64 * self.times.len() as u64;
        tiles as u64 + times + 3 * layout.largest_tile(u64::MAX)
    }

    /// Adds the tile of the record `tile`, which is at byte `position` of the file, if the tile is intact. Returns the
    /// number of stored bytes that follow the record; it is 0 if the tile shares the stored bytes of an earlier tile.
    /// Returns `None` if the tile is damaged. `start` is the offset of the first record, and `buffer` is used for
    /// reading.
    fn add_tile(
        &mut self,
        file: &MappedFile,
        layout: &Layout,
        tile: &TileRecord,
        position: u64,
        start: u64,
        buffer: &mut TileBuffer,
    ) -> Option<u64> {
        tile.check(layout, start + RECORD_BYTES..file.len(), position).ok()?;
        let own = tile.offset == position + RECORD_BYTES;
        if own {
            read_tile(file, layout, tile, buffer).ok()?;
            check_stats(tile, position, buffer.values()).ok()?;
            if tile.constant {
                self.constants.insert(tile.offset, *tile);
            }
        } else {
            // The shared bytes were decoded with the record before them. A forged file of many records that share the
            // same bytes thus takes no longer than its length requires.
            self.constants.get(&tile.offset).filter(|owner| tile.may_share(owner))?;
        }
        self.tiles.entry(layout.index_of(tile.id)?).or_insert(*tile);
        Some(if own { tile.stored_bytes.into() } else { 0 })
    }
}

/// Reads the time stamps that follow the record `times` (a 64-byte header), which is at byte `position` of the file.
/// Checks them against the checksum in this record and against the layout.
pub(crate) fn read_times(file: &MappedFile, layout: &Layout, times: &TimesRecord, position: u64) -> Result<Vec<f64>> {
    let fault = |fault: Fault| fault.at(file.path());
    if !(1..=layout.frame_block).contains(&times.frames) {
        return Err(fault(Fault::new(position + 20, format!("1 to {} frames", layout.frame_block), times.frames)));
    }
    let len = 8 * u64::from(times.frames);
    if len > file.len().saturating_sub(position + RECORD_BYTES) {
        return Err(fault(Fault::new(position + RECORD_BYTES, format!("{len} bytes"), "the end of the file")));
    }
    let mut bytes = vec![0; len as usize];
    file.read_at(position + RECORD_BYTES, &mut bytes)?;
    let computed = xxh3_64(&bytes);
    if computed != times.checksum {
        let expected = format!("time stamps with checksum {:016x}", times.checksum);
        return Err(fault(Fault::new(position + RECORD_BYTES, expected, format!("{computed:016x}"))));
    }
    Ok(bytes.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect())
}
