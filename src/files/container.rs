//! A `gseq` container as a source of frames.
//!
//! In: the file. Out: the state of any Gaussians at any frame. Memory: what a reader keeps is that of `TileReader`,
//! what is held for all readers that of `HeldTiles`, and each thread that decodes has one `Scratch`.
//!
//! Raw tiles are used where they lie in the map, packed ones are decoded straight from there. Pages that were touched
//! count as resident until they are released, so a reader releases what it used of a frame block when it enters another.
//! Where it may keep less than a frame block, positioned reads stay: releasing frame by frame costs more than their
//! copy. Raw frames into the caller's state (`cargo bench --bench scan`, `raw_frames`; two threads on two cores of an
//! EPYC that others kept busy, so compare them with one another): 1.5 GB/s released by frame block, 0.6 frame by frame, 1.4
//! by positioned reads, 2.3 left mapped.
//!
//! A file that lies in memory is read block by block, and the disk works ahead by advice: when a reader that decodes
//! whole frame blocks enters one, the system is told of the next. One that does not is scanned in stages
//! ([`FrameSource::ahead`]). On the same machine, blocks and stages: from a cold page cache 95 and 71 ms (raw), 222 and
//! 232 (packed); from a disk of 300 MB/s, simulated, 158 and 162, 216 and 206; from a warm one 46 and 45, 152 and 223,
//! as a packed scan waits for no disk, but its stages for one another.

mod held;
mod store;
mod tiles;

use std::ops::Range;

pub use self::store::Container;
use self::tiles::TileReader;
use crate::error::Result;
use crate::model::{Columns, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids, Prefetch, Reads};

/// Places of the file that are asked about to know whether the system holds it in memory.
const SAMPLES: u64 = 64;

impl FrameSource for Container {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(TileReader::new(self, &ids)))
    }

    fn reads(&self) -> Reads {
        let read = self.reader.tiles_read();
        Reads { bytes: read.bytes, tiles: read.tiles, states: self.states.get() }
    }

    /// Not for a file that lies in memory: see the figures at the top of this module.
    fn ahead(&self) -> Option<&dyn Prefetch> {
        match self.reader.is_cached(SAMPLES) {
            Some(true) => None,
            _ => Some(self),
        }
    }
}

impl Prefetch for Container {
    fn frame_block(&self) -> usize {
        self.reader.layout().frame_block as usize
    }

    fn fetch(&self, gaussians: Range<usize>, frames: Range<usize>, want: Columns) {
        if gaussians.is_empty() || frames.is_empty() {
            return;
        }
        let layout = self.reader.layout();
        let block = |id: usize, of: u32| (id / of as usize) as u32;
        let of = layout.gaussian_block;
        for frame_block in block(frames.start, layout.frame_block)..=block(frames.end - 1, layout.frame_block) {
            for gaussian_block in block(gaussians.start, of)..=block(gaussians.end - 1, of) {
                let tiles = || self.unheld(want, gaussian_block, frame_block);
                // All at once, then waiting for one after the other.
                self.reader.expect(tiles());
                self.reader.fetch(tiles());
            }
        }
    }
}

#[cfg(test)]
mod tests;
