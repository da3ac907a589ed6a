//! The index of a finished container: an entry for every tile, left in the file and read when it is asked for.

use std::ops::Range;

use crate::error::{Fault, Result};
use crate::file::MappedFile;
use crate::layout::Layout;
use crate::record::{Digest, RECORD, Record, TileRecord};

/// Where the entries lie and what they may say.
pub(crate) struct Index {
    pub(crate) offset: u64,
    pub(crate) tiles: u64,
    /// T, frames of the sequence.
    pub(crate) frames: u64,
    /// Where payloads may lie.
    pub(crate) payloads: Range<u64>,
}

impl Index {
    /// Place of an entry in the file.
    pub(crate) fn place(&self, index: u64) -> u64 {
        self.offset + RECORD * index
    }

    /// Reads and checks an entry.
    pub(crate) fn record(&self, file: &MappedFile, layout: &Layout, index: u64) -> Result<TileRecord> {
        let mut bytes = [0; RECORD as usize];
        file.read_at(self.place(index), &mut bytes)?;
        self.parse(layout, index, &bytes).map_err(|fault| fault.at(file.path()))
    }

    fn parse(
        &self,
        layout: &Layout,
        index: u64,
        bytes: &[u8; RECORD as usize],
    ) -> std::result::Result<TileRecord, Fault> {
        let place = self.place(index);
        let id = layout.tile_at(index);
        let range = layout.frame_range(id.frame_block, self.frames);
        match Record::from_bytes(bytes, place)? {
            Record::Tile(tile) if tile.id == id && u64::from(tile.frames) == range.end - range.start => {
                tile.check(layout, self.payloads.clone(), place)?;
                Ok(tile)
            }
            other => {
                let expected = format!("the index entry of {id:?}, frames {} to {}", range.start, range.end);
                Err(Fault::new(place, expected, format!("{other:?}")))
            }
        }
    }

    /// Checks every entry, that no two tiles overlap but for constant ones that share all of their bytes, and adds
    /// them to `digest`. Gives per column whether its values differ between frames.
    pub(crate) fn check(
        &self,
        file: &MappedFile,
        layout: &Layout,
        piece: &mut Vec<u8>,
        digest: &mut Digest,
    ) -> Result<Vec<bool>> {
        let mut varies = vec![false; layout.columns.len()];
        // By column and Gaussian block the tile of the frame block before, if it is constant.
        let mut constants: Vec<Option<TileRecord>> = vec![None; layout.tiles_per_frame_block() as usize];
        let mut end = 0;
        let mut in_order = true;
        let entries = self.offset..self.place(self.tiles);
        file.read_pieces(entries, piece, |offset, bytes| {
            for (i, bytes) in bytes.as_chunks().0.iter().enumerate() {
                let index = (offset - self.offset) / RECORD + i as u64;
                let tile = self.parse(layout, index, bytes).map_err(|fault| fault.at(file.path()))?;
                digest.tile(&tile);
                let before = &mut constants[(index % layout.tiles_per_frame_block()) as usize];
                varies[tile.id.column as usize] |=
                    !tile.constant || before.is_some_and(|before| before.offset != tile.offset);
                if tile.offset - RECORD >= end {
                    end = tile.offset + u64::from(tile.stored_bytes);
                } else {
                    in_order &= before.is_some_and(|before| tile.may_share(&before));
                }
                *before = tile.constant.then_some(tile);
            }
            Ok(())
        })?;
        if !in_order {
            let tiles = (0..self.tiles).map(|index| self.record(file, layout, index)).collect::<Result<Vec<_>>>()?;
            self.check_overlap(&tiles).map_err(|fault| fault.at(file.path()))?;
        }
        Ok(varies)
    }

    /// No two tiles may use the same bytes of the file, but for constant ones that share all of them.
    fn check_overlap(&self, tiles: &[TileRecord]) -> std::result::Result<(), Fault> {
        let mut order: Vec<usize> = (0..tiles.len()).collect();
        order.sort_unstable_by_key(|&i| (tiles[i].offset, i));
        for pair in order.windows(2) {
            let (tile, next) = (&tiles[pair[0]], &tiles[pair[1]]);
            let apart = next.offset - RECORD >= tile.offset + u64::from(tile.stored_bytes);
            if !apart && !next.may_share(tile) {
                let expected = format!("{:?} stored apart from {:?}", next.id, tile.id);
                return Err(Fault::new(
                    self.place(pair[1] as u64) + 24,
                    expected,
                    format!("both at bytes {} to {}", next.offset, tile.offset + u64::from(tile.stored_bytes)),
                ));
            }
        }
        Ok(())
    }
}
