//! Verification of every byte of a container, in the order of the bytes in the file.

use std::collections::HashSet;

use crate::codec::{TileStats, stats};
use crate::error::{Fault, Result};
use crate::index::check_memory;
use crate::reader::{Reader, TileBuffer};
use crate::record::{RECORD_BYTES, Record, TileRecord, TimesRecord, align};
use crate::recover::read_times;

/// Result of [`Reader::verify`]: numbers of frames, tiles and bytes that were checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VerifyReport {
    /// Number of frames of the container.
    pub frames: u64,
    /// Number of tiles of the container.
    pub tiles: u64,
    /// Number of bytes in which all tiles are stored, mostly compressed. Bytes that several tiles share count once.
    pub stored_bytes: u64,
    /// Number of bytes of the decoded values of all tiles. A constant tile (all frames equal) counts as one frame.
    /// Tiles that share their stored bytes count once.
    pub decoded_bytes: u64,
}

impl Reader {
    /// Reads the whole file and checks all bytes that opening it did not check. Fails at the first difference.
    /// Together, opening and this check find a change of any byte of the file. This check covers:
    ///
    /// - every record: it equals its entry in the index;
    /// - the stored bytes of every tile: they have the recorded checksum and decode to values with the recorded
    ///   statistics;
    /// - all bytes in between: they are zero.
    ///
    /// Memory: one [`TileBuffer`], 1 byte per tile, about 20 bytes per constant tile.
    pub fn verify(&self) -> Result<VerifyReport> {
        self.verify_within(u64::MAX)
    }

    /// Verifies the container like [`Reader::verify`], with at most `memory` bytes of memory. Also fails if more is
    /// needed.
    pub fn verify_within(&self, memory: u64) -> Result<VerifyReport> {
        let fault = |fault: Fault| fault.at(self.file.path());
        let tile = self.layout.largest_tile(self.times.len() as u64);
        check_memory(0, 3 * tile + 32 * self.index.tiles, memory).map_err(fault)?;
        let mut report = VerifyReport { frames: self.times.len() as u64, tiles: 0, stored_bytes: 0, decoded_bytes: 0 };
        let mut buffer = TileBuffer::default();
        let mut seen = vec![false; self.index.tiles as usize];
        let mut blocks_seen = 0;
        // Offsets of the stored bytes of constant tiles that were checked so far. Opening has checked that the records
        // of tiles with the same stored bytes agree, except in frame block and number of frames.
        let mut own_payloads = HashSet::new();
        let (_, header) = crate::reader::read_header(&self.file)?;
        let mut position = self.skip_padding(header.len() as u64)?;
        while position < self.footer_offset {
            let mut bytes = [0; RECORD_BYTES as usize];
            self.file.read_at(position, &mut bytes)?;
            let payload = position + RECORD_BYTES;
            match Record::from_bytes(&bytes, position).map_err(fault)? {
                Record::Tile(tile) => {
                    let index = self.layout.index_of(tile.id).filter(|&i| i < self.index.tiles && !seen[i as usize]);
                    let mut indexed = [0; RECORD_BYTES as usize];
                    if let Some(index) = index {
                        self.file.read_at(self.index.entry_offset(index), &mut indexed)?;
                    }
                    let Some(index) = index.filter(|_| indexed == bytes) else {
                        return Err(fault(Fault::new(position, "the tile the index describes, once", tile.id)));
                    };
                    seen[index as usize] = true;
                    report.tiles += 1;
                    let mut stored = 0;
                    if tile.offset == payload {
                        let values = self.read_tile(tile.id, &mut buffer)?.values();
                        check_stats(&tile, position, values).map_err(fault)?;
                        stored = u64::from(tile.stored_bytes);
                        report.stored_bytes += stored;
                        report.decoded_bytes += 4 * tile.value_count(&self.layout) as u64;
                        if tile.constant {
                            own_payloads.insert(tile.offset);
                        }
                    } else if !own_payloads.contains(&tile.offset) {
                        let fault =
                            Fault::new(position + 24, "a payload after this record or of an earlier tile", tile.offset);
                        return Err(fault.at(self.file.path()));
                    }
                    position = self.skip_padding(payload + stored)?;
                }
                Record::Times(times) => {
                    self.check_times(&times, blocks_seen, position)?;
                    blocks_seen += 1;
                    position = self.skip_padding(payload + 8 * u64::from(times.frames))?;
                }
                Record::Footer(_) => {
                    let expected = format!("the footer at byte {}", self.footer_offset);
                    return Err(fault(Fault::new(position, expected, "another one")));
                }
            }
        }
        if blocks_seen != self.frame_blocks() || report.tiles != self.index.tiles {
            let expected =
                format!("{} time records and {} tiles before the footer", self.frame_blocks(), self.index.tiles);
            return Err(fault(Fault::new(self.footer_offset, expected, format!("{blocks_seen} and {}", report.tiles))));
        }
        Ok(report)
    }

    /// Checks that the record at byte `position` of the file is followed by the time stamps of frame block `block`, and
    /// that these equal the time stamps in the footer.
    fn check_times(&self, record: &TimesRecord, block: u32, position: u64) -> Result<()> {
        let stamps = read_times(&self.file, &self.layout, record, position)?;
        let range = self.layout.frame_range(block, self.times.len() as u64);
        let indexed = self.times.get(range.start as usize..range.end as usize).unwrap_or_default();
        let same = indexed.iter().map(|t| t.to_bits()).eq(stamps.iter().map(|t| t.to_bits()));
        if record.frame_block != block || !same {
            let expected = format!("the time stamps of frame block {block}, as in the footer");
            let found = format!("{} others of frame block {}", stamps.len(), record.frame_block);
            return Err(Fault::new(position, expected, found).at(self.file.path()));
        }
        Ok(())
    }

    /// Checks that the file contains only zeros from `end` to the next multiple of 64 bytes, and returns this multiple.
    fn skip_padding(&self, end: u64) -> Result<u64> {
        let mut zeros = [0; RECORD_BYTES as usize];
        let zeros = &mut zeros[..(align(end) - end) as usize];
        self.file.read_at(end, zeros)?;
        if let Some(at) = zeros.iter().position(|&byte| byte != 0) {
            let fault = Fault::new(end + at as u64, "a zero byte of padding", format!("{:#04x}", zeros[at]));
            return Err(fault.at(self.file.path()));
        }
        Ok(align(end))
    }
}

/// Checks that the statistics in the record `tile` (the 64-byte description of a tile) match `values`, the values of
/// the tile. The record is at byte `position` of the file.
pub(crate) fn check_stats(tile: &TileRecord, position: u64, values: &[f32]) -> std::result::Result<(), Fault> {
    let found = stats(bytemuck::cast_slice(values));
    // Bits are compared: a forged NaN must not pass, and −0 must not pass for +0.
    let bits = |stats: TileStats| (stats.min.to_bits(), stats.max.to_bits(), stats.non_finite);
    if bits(found) != bits(tile.stats) {
        return Err(Fault::new(position + 44, format!("{found}, as the values are"), tile.stats));
    }
    Ok(())
}
