//! Index of a finished container: the table of its tiles, one entry per tile. The index stays in the file; entries are
//! read when they are needed.

use std::ops::Range;

use crate::error::{Fault, Result};
use crate::file::MappedFile;
use crate::layout::Layout;
use crate::record::{Digest, RECORD_BYTES, Record, TileRecord};

/// Place of the index (table of tiles) in the file, and limits that its entries must respect.
pub(crate) struct Index {
    pub(crate) offset: u64,
    pub(crate) tiles: u64,
    /// Number T of frames of the sequence.
    pub(crate) frames: u64,
    /// Byte range of the file in which the stored bytes of tiles may lie.
    pub(crate) payloads: Range<u64>,
}

impl Index {
    /// Returns the offset in the file of entry `index` (counted from 0) of the index, the table of tiles.
    pub(crate) fn entry_offset(&self, index: u64) -> u64 {
        self.offset + RECORD_BYTES * index
    }

    /// Reads and checks entry `index` (counted from 0) of the index, the table of tiles. Fails if the entry is damaged
    /// or describes another tile than the one that belongs there.
    pub(crate) fn record(&self, file: &MappedFile, layout: &Layout, index: u64) -> Result<TileRecord> {
        let mut bytes = [0; RECORD_BYTES as usize];
        file.read_at(self.entry_offset(index), &mut bytes)?;
        self.parse(layout, index, &bytes).map_err(|fault| fault.at(file.path()))
    }

    /// Decodes entry `index` (counted from 0) of the index, the table of tiles, from its bytes, and checks it against
    /// the layout.
    fn parse(
        &self,
        layout: &Layout,
        index: u64,
        bytes: &[u8; RECORD_BYTES as usize],
    ) -> std::result::Result<TileRecord, Fault> {
        let place = self.entry_offset(index);
        let id = layout.tile_at(index);
        let range = layout.frame_range(id.frame_block, self.frames);
        match Record::from_bytes(bytes, place)? {
            Record::Tile(tile) if tile.id == id && u64::from(tile.frames) == range.end - range.start => {
                tile.check(layout, self.payloads.clone(), place)?;
                Ok(tile)
            }
            other => {
                let expected = format!("the index entry of {id}, frames {} to {}", range.start, range.end);
                Err(Fault::new(place, expected, other))
            }
        }
    }

    /// Checks all entries of the index and adds them to `digest`, the hash of the content. Returns for every column
    /// whether its values differ between frames. `chunk` is a buffer for reading.
    /// Also checks that no two tiles overlap in the file; constant tiles (all frames equal) may share all of their
    /// bytes. If the tiles do not lie in the order of the index, the check takes more memory, at most `memory` bytes.
    pub(crate) fn check(
        &self,
        file: &MappedFile,
        layout: &Layout,
        chunk: &mut Vec<u8>,
        digest: &mut Digest,
        memory: u64,
    ) -> Result<Vec<bool>> {
        let (varies, in_order) = self.check_entries(file, layout, chunk, digest)?;
        if !in_order {
            let needed = self.tiles * (size_of::<TileRecord>() + size_of::<usize>()) as u64;
            check_memory(self.offset, needed, memory).map_err(|fault| fault.at(file.path()))?;
            let tiles = (0..self.tiles).map(|index| self.record(file, layout, index)).collect::<Result<Vec<_>>>()?;
            self.check_overlap(&tiles).map_err(|fault| fault.at(file.path()))?;
        }
        Ok(varies)
    }

    /// Checks all entries in one pass over the index, and adds them to `digest`, the hash of the content. Returns
    /// - for every column, whether its values differ between frames,
    /// - whether the pass has shown that no two tiles overlap in the file. It shows this only if the tiles lie in the
    ///   file in the order of the index.
    ///
    /// The pass remembers only the last constant tile of each column and Gaussian block. `chunk` is a buffer for
    /// reading.
    fn check_entries(
        &self,
        file: &MappedFile,
        layout: &Layout,
        chunk: &mut Vec<u8>,
        digest: &mut Digest,
    ) -> Result<(Vec<bool>, bool)> {
        let mut varies = vec![false; layout.columns.len()];
        // One element per column and Gaussian block. A file without frames has no tile, whatever its header says.
        let mut constants: Vec<Option<TileRecord>> =
            vec![None; layout.tiles_per_frame_block().min(self.tiles) as usize];
        let mut end = 0;
        let mut in_order = true;
        let entries = self.offset..self.entry_offset(self.tiles);
        file.read_chunks(entries, chunk, |offset, bytes| {
            for (i, bytes) in bytes.as_chunks().0.iter().enumerate() {
                let index = (offset - self.offset) / RECORD_BYTES + i as u64;
                let tile = self.parse(layout, index, bytes).map_err(|fault| fault.at(file.path()))?;
                digest.tile(&tile);
                let before = &mut constants[(index % layout.tiles_per_frame_block()) as usize];
                varies[tile.id.column as usize] |=
                    !tile.constant || before.is_some_and(|before| before.offset != tile.offset);
                if tile.offset - RECORD_BYTES >= end {
                    end = tile.offset + u64::from(tile.stored_bytes);
                } else {
                    in_order &= before.is_some_and(|before| tile.may_share(&before));
                }
                if tile.constant {
                    *before = Some(tile);
                }
            }
            Ok(())
        })?;
        Ok((varies, in_order))
    }

    /// Checks that no two tiles use the same bytes of the file, except constant tiles that share all of them.
    fn check_overlap(&self, tiles: &[TileRecord]) -> std::result::Result<(), Fault> {
        let mut order: Vec<usize> = (0..tiles.len()).collect();
        order.sort_unstable_by_key(|&i| (tiles[i].offset, i));
        for pair in order.windows(2) {
            let (tile, next) = (&tiles[pair[0]], &tiles[pair[1]]);
            let apart = next.offset - RECORD_BYTES >= tile.offset + u64::from(tile.stored_bytes);
            if !apart && !next.may_share(tile) {
                let expected = format!("{} stored apart from {}", next.id, tile.id);
                return Err(Fault::new(
                    self.entry_offset(pair[1] as u64) + 24,
                    expected,
                    format!("both at bytes {} to {}", next.offset, tile.offset + u64::from(tile.stored_bytes)),
                ));
            }
        }
        Ok(())
    }
}

/// Fails if `needed` is larger than `memory`. `needed` is the number of bytes of memory that opening, checking or
/// recovering a container takes, `memory` the number of bytes allowed, and `offset` the place in the file that the
/// error names.
pub(crate) fn check_memory(offset: u64, needed: u64, memory: u64) -> std::result::Result<(), Fault> {
    if needed <= memory {
        return Ok(());
    }
    let expected = format!("an index that takes at most {memory} bytes of memory");
    Err(Fault::new(offset, expected, format!("{needed} bytes"))
        .hint("if the container is meant to be this large, allow more memory (splatsieve: --memory)"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ColumnSpec, Compression, Reader, TileId, Writer, encode_tile};

    /// Writes a container of 2 blocks of 2 Gaussians and 3 frame blocks, and opens it. `order` is the order in which
    /// the frame blocks are written. Column 0 varies in every frame block. Column 1 is constant in the first and the
    /// last frame block, with the same values, and varies in the middle one.
    fn open(path: &std::path::Path, order: [u32; 3]) -> Reader {
        let columns =
            ["moving", "pausing"].map(|name| ColumnSpec { name: name.into(), width: 1, max_error: 0.0 }).into();
        let layout =
            Layout { gaussians: 4, gaussian_block: 2, frame_block: 2, columns, attributes: Default::default() };
        let mut writer = Writer::create(path, layout).unwrap();
        for times in [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]] {
            writer.append_times(&times).unwrap();
        }
        for frame_block in order {
            for (gaussian_block, column) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                let moves = column == 0 || frame_block == 1;
                let values = [1.0, 2.0, if moves { 3.0 } else { 1.0 }, 2.0];
                let tile = encode_tile(&values, 2, 1, 2, Compression::Raw).unwrap();
                writer.write_tile(TileId { column, gaussian_block, frame_block }, &tile).unwrap();
            }
        }
        writer.finish().unwrap();
        Reader::open(path).unwrap()
    }

    #[test]
    fn tiles_in_index_order_are_checked_in_one_pass() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        for (order, expected) in [([0, 1, 2], true), ([2, 0, 1], false)] {
            let reader = open(&path, order);
            let mut digest = Digest::new(&[], &[]);
            let found = reader.index.check_entries(&reader.file, &reader.layout, &mut Vec::new(), &mut digest).unwrap();
            assert_eq!(found, (vec![true, true], expected), "{order:?}");
            let tile = |frame_block| reader.tile_info(TileId { column: 1, gaussian_block: 0, frame_block }).unwrap();
            assert_eq!(tile(0).offset, tile(2).offset, "{order:?}: stored twice");
            reader.verify().unwrap();
        }
    }
}
