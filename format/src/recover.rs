//! Saves the complete frame blocks of a container that was cut short or damaged after its header.

use std::collections::HashMap;
use std::path::Path;

use xxhash_rust::xxh3::xxh3_64;

use crate::codec::EncodedTile;
use crate::error::{Fault, Result};
use crate::file::MappedFile;
use crate::index::check_memory;
use crate::layout::Layout;
use crate::reader::{TileBuffer, read_header, read_tile};
use crate::record::{RECORD, Record, TileRecord, TimesRecord, align};
use crate::verify::check_stats;
use crate::writer::{Writer, check_times};

/// What [`recover`] found and saved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecoverReport {
    /// Frames in the new container.
    pub frames: u64,
    /// Frames whose time stamps were found.
    pub frames_seen: u64,
    /// Intact tiles that were found.
    pub tiles_seen: u64,
    /// Tiles in the new container; the others belong to frame blocks that are not complete or come after one
    /// that is not.
    pub tiles_saved: u64,
    /// Bytes that belong to no intact record.
    pub bytes_skipped: u64,
}

/// Writes a valid container `dst` with the frame blocks of `src` up to the first that lacks its time stamps or
/// a tile; every value has the bits it had. Tiles whose place in the file is damaged are searched for
/// record by record. Memory: some 150 bytes per tile, the time stamps, one tile buffer.
///
/// Errors: the header of `src` is damaged, or `dst` cannot be written. No frames left is not an error:
/// `dst` has none then, and the report says so.
pub fn recover(src: impl AsRef<Path>, dst: impl AsRef<Path>) -> Result<RecoverReport> {
    recover_within(src, dst, u64::MAX)
}

/// [`recover`] with at most `memory` bytes. Errors: those of [`recover`]; the container needs more.
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

/// A stored tile as the writer takes it, without encoding it again.
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

/// Every intact record of a file: time stamps by frame block, tiles by their place in the index.
struct Found {
    times: HashMap<u32, Vec<f64>>,
    tiles: HashMap<u64, TileRecord>,
    /// Constant tiles that have their own payload, by its place.
    constants: HashMap<u64, TileRecord>,
    skipped: u64,
    /// Bytes of all time stamps.
    time_bytes: u64,
}

/// Goes from record to record. Where one is damaged, tries every multiple of 64 after it: a record knows
/// its place, so bytes inside a payload are not taken for one.
fn scan(file: &MappedFile, layout: &Layout, start: u64, memory: u64) -> Result<Found> {
    let mut found =
        Found { times: HashMap::new(), tiles: HashMap::new(), constants: HashMap::new(), skipped: 0, time_bytes: 0 };
    let mut buffer = TileBuffer::default();
    let mut position = start;
    while position + RECORD <= file.len() {
        let mut bytes = [0; RECORD as usize];
        file.read_at(position, &mut bytes)?;
        let payload = position + RECORD;
        check_memory(position, found.bytes(layout), memory).map_err(|fault| fault.at(file.path()))?;
        let len = match Record::from_bytes(&bytes, position) {
            Ok(Record::Tile(tile)) => found.take_tile(file, layout, &tile, position, start, &mut buffer),
            Ok(Record::Times(times)) => read_times(file, layout, &times, position).ok().map(|stamps| {
                let len = 8 * stamps.len() as u64;
                found.time_bytes += len;
                found.times.entry(times.frame_block).or_insert(stamps);
                len
            }),
            // Behind the footer comes nothing but the trailer.
            Ok(Record::Footer(footer)) if footer.payload().is_some_and(|len| len <= file.len() - payload) => break,
            Ok(Record::Footer(_)) | Err(_) => None,
        };
        match len {
            Some(len) => position = align(payload + len),
            None => {
                found.skipped += RECORD;
                position += RECORD;
            }
        }
    }
    if position < file.len() && position + RECORD > file.len() {
        found.skipped += file.len() - position;
    }
    Ok(found)
}

impl Found {
    /// Bytes of what was found so far, of its tables while they grow, and of the largest tile, decoded.
    fn bytes(&self, layout: &Layout) -> u64 {
        let tiles = (self.tiles.capacity() + self.constants.capacity()) * 3 / 2 * (size_of::<TileRecord>() + 16);
        let times = 2 * self.time_bytes + 64 * self.times.len() as u64;
        tiles as u64 + times + 3 * layout.largest_tile(u64::MAX)
    }

    /// Takes the tile of the record at `position` if it is intact. Gives the length of what follows the record: its payload,
    /// or nothing if it shares one.
    fn take_tile(
        &mut self,
        file: &MappedFile,
        layout: &Layout,
        tile: &TileRecord,
        position: u64,
        start: u64,
        buffer: &mut TileBuffer,
    ) -> Option<u64> {
        tile.check(layout, start + RECORD..file.len(), position).ok()?;
        let own = tile.offset == position + RECORD;
        if own {
            read_tile(file, layout, tile, buffer).ok()?;
            check_stats(tile, position, buffer.values()).ok()?;
            if tile.constant {
                self.constants.insert(tile.offset, *tile);
            }
        } else {
            // Decoded when its owner was met: a file of nothing but records that share one large payload
            // costs no more than its length.
            self.constants.get(&tile.offset).filter(|owner| tile.may_share(owner))?;
        }
        self.tiles.entry(layout.index_of(tile.id)?).or_insert(*tile);
        Some(if own { tile.stored_bytes.into() } else { 0 })
    }
}

/// The time stamps of the record at `position`, checked against its checksum and the layout.
pub(crate) fn read_times(file: &MappedFile, layout: &Layout, times: &TimesRecord, position: u64) -> Result<Vec<f64>> {
    let fault = |fault: Fault| fault.at(file.path());
    if !(1..=layout.frame_block).contains(&times.frames) {
        return Err(fault(Fault::new(position + 20, format!("1 to {} frames", layout.frame_block), times.frames)));
    }
    let len = 8 * u64::from(times.frames);
    if len > file.len().saturating_sub(position + RECORD) {
        return Err(fault(Fault::new(position + RECORD, format!("{len} bytes"), "the end of the file")));
    }
    let mut bytes = vec![0; len as usize];
    file.read_at(position + RECORD, &mut bytes)?;
    let computed = xxh3_64(&bytes);
    if computed != times.checksum {
        let expected = format!("time stamps with checksum {:016x}", times.checksum);
        return Err(fault(Fault::new(position + RECORD, expected, format!("{computed:016x}"))));
    }
    Ok(bytes.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect())
}
