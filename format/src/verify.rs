//! Checks every byte of a container, in the order they lie in the file.

use std::collections::HashSet;

use crate::codec::{Stats, stats};
use crate::error::{Fault, Result};
use crate::index::check_memory;
use crate::reader::{Reader, TileBuffer};
use crate::record::{RECORD, Record, TileRecord, TimesRecord, align};
use crate::recover::read_times;

/// What [`Reader::verify`] went through.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VerifyReport {
    /// Frames of the sequence.
    pub frames: u64,
    /// Tiles of the container.
    pub tiles: u64,
    /// Bytes of payloads as stored; shared ones once.
    pub stored_bytes: u64,
    /// Bytes of values after decoding: of constant tiles one frame, of shared payloads once.
    pub decoded_bytes: u64,
}

impl Reader {
    /// Reads the whole file and checks what opening it left unchecked: every record is where the index says and says
    /// the same, every tile decodes to values with its checksum and statistics, all bytes between are zero. A file
    /// that passes has no byte that could be changed unnoticed. Memory: one [`TileBuffer`], 1 byte per
    /// tile, some 20 per constant tile.
    pub fn verify(&self) -> Result<VerifyReport> {
        self.verify_within(u64::MAX)
    }

    /// [`Reader::verify`] with at most `memory` bytes. Errors: the container needs more.
    pub fn verify_within(&self, memory: u64) -> Result<VerifyReport> {
        let fault = |fault: Fault| fault.at(self.file.path());
        let tile = self.layout.largest_tile(self.times.len() as u64);
        check_memory(0, 3 * tile + 32 * self.index.tiles, memory).map_err(fault)?;
        let mut report = VerifyReport { frames: self.times.len() as u64, tiles: 0, stored_bytes: 0, decoded_bytes: 0 };
        let mut buffer = TileBuffer::default();
        let mut met = vec![false; self.index.tiles as usize];
        let mut blocks_met = 0;
        // Opening made sure that tiles with the same payload agree on everything about it.
        let mut owned = HashSet::new();
        let (_, header) = crate::reader::read_header(&self.file)?;
        let mut position = self.padded(header.len() as u64)?;
        while position < self.footer_offset {
            let mut bytes = [0; RECORD as usize];
            self.file.read_at(position, &mut bytes)?;
            let payload = position + RECORD;
            match Record::from_bytes(&bytes, position).map_err(fault)? {
                Record::Tile(tile) => {
                    let index = self.layout.index_of(tile.id).filter(|&i| i < self.index.tiles && !met[i as usize]);
                    let mut indexed = [0; RECORD as usize];
                    if let Some(index) = index {
                        self.file.read_at(self.index.place(index), &mut indexed)?;
                    }
                    let Some(index) = index.filter(|_| indexed == bytes) else {
                        return Err(fault(Fault::new(position, "the tile the index describes, once", tile.id)));
                    };
                    met[index as usize] = true;
                    report.tiles += 1;
                    let mut stored = 0;
                    if tile.offset == payload {
                        let values = self.read_tile(tile.id, &mut buffer)?.values();
                        check_stats(&tile, position, values).map_err(fault)?;
                        stored = u64::from(tile.stored_bytes);
                        report.stored_bytes += stored;
                        report.decoded_bytes += 4 * tile.values(&self.layout) as u64;
                        if tile.constant {
                            owned.insert(tile.offset);
                        }
                    } else if !owned.contains(&tile.offset) {
                        let fault =
                            Fault::new(position + 24, "a payload after this record or of an earlier tile", tile.offset);
                        return Err(fault.at(self.file.path()));
                    }
                    position = self.padded(payload + stored)?;
                }
                Record::Times(times) => {
                    self.check_times(&times, blocks_met, position)?;
                    blocks_met += 1;
                    position = self.padded(payload + 8 * u64::from(times.frames))?;
                }
                Record::Footer(_) => {
                    let expected = format!("the footer at byte {}", self.footer_offset);
                    return Err(fault(Fault::new(position, expected, "another one")));
                }
            }
        }
        if blocks_met != self.frame_blocks() || report.tiles != self.index.tiles {
            let expected =
                format!("{} time records and {} tiles before the footer", self.frame_blocks(), self.index.tiles);
            return Err(fault(Fault::new(self.footer_offset, expected, format!("{blocks_met} and {}", report.tiles))));
        }
        Ok(report)
    }

    /// Checks that the record at `position` holds the time stamps of frame block `block`, as the footer has them.
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

    /// Checks that zeros fill the file from `end` to the next multiple of 64, which is returned.
    fn padded(&self, end: u64) -> Result<u64> {
        let mut zeros = [0; RECORD as usize];
        let zeros = &mut zeros[..(align(end) - end) as usize];
        self.file.read_at(end, zeros)?;
        if let Some(at) = zeros.iter().position(|&byte| byte != 0) {
            let fault = Fault::new(end + at as u64, "a zero byte of padding", format!("{:#04x}", zeros[at]));
            return Err(fault.at(self.file.path()));
        }
        Ok(align(end))
    }
}

/// Checks the statistics of the record at `position` against the values of its tile.
pub(crate) fn check_stats(tile: &TileRecord, position: u64, values: &[f32]) -> std::result::Result<(), Fault> {
    let found = stats(bytemuck::cast_slice(values));
    // As bits: a forged NaN must not compare as equal to nothing, nor −0 to the +0 it has to be.
    let bits = |stats: Stats| (stats.min.to_bits(), stats.max.to_bits(), stats.non_finite);
    if bits(found) != bits(tile.stats) {
        return Err(Fault::new(position + 44, format!("{found}, as the values are"), tile.stats));
    }
    Ok(())
}
