//! `gseq` container (this project's sequence file) as a source of frames.
//!
//! Input: the file. Output: the attributes of any Gaussians at any frame. A tile holds the values of one attribute for
//! a block of consecutive Gaussians and a block of consecutive frames. Memory: each reader has the buffers of a
//! `TileReader`, all readers share the decoded tiles in `HeldTiles`, and each decoding thread has one `Scratch`.
//!
//! Raw (uncompressed) tiles are read in place from the memory-mapped file; compressed tiles are decoded directly from
//! the mapping. Touched pages count as resident until they are released, so a reader releases the pages of a frame
//! block when it enters another one. If it may keep less than a frame block, it uses positioned reads, because
//! releasing page by page per frame costs more than the copy. Throughput of reading raw frames into the caller's
//! buffers (`cargo bench --bench scan`, `raw_frames`; two threads on two cores of a busy EPYC, so compare the figures
//! only with one another): 1.5 GB/s with release per frame block, 0.6 with release per frame, 1.4 with positioned
//! reads, 2.3 if pages stay mapped.
//!
//! A file that is in the page cache is read block by block, and the system reads ahead on advice: when a reader that
//! decodes whole frame blocks enters one, it announces the next one. A file that is not in the page cache is scanned in
//! stages ([`FrameSource::ahead`]). Times on the same machine for blocks and stages: cold page cache 95 and 71 ms
//! (raw), 222 and 232 ms (compressed); simulated disk of 300 MB/s 158 and 162, 216 and 206; warm page cache 46 and 45,
//! 152 and 223. In the last case a compressed scan never waits for the disk, but its stages wait for one another.

mod held;
mod store;
mod tiles;

use std::ops::Range;

pub use self::store::Container;
use self::tiles::TileReader;
use crate::error::Result;
use crate::model::{Attributes, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids, Prefetch, Reads};

/// Number of places in the file that are tested to find out whether the file is in the page cache.
const CACHE_SAMPLES: u64 = 64;

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

    /// Returns the prefetcher of the file, or `None` if the file is in the page cache; the module documentation gives
    /// the measurements behind this.
    fn ahead(&self) -> Option<&dyn Prefetch> {
        match self.reader.is_cached(CACHE_SAMPLES) {
            Some(true) => None,
            _ => Some(self),
        }
    }
}

impl Prefetch for Container {
    fn frame_block(&self) -> usize {
        self.reader.layout().frame_block as usize
    }

    fn fetch(&self, gaussians: Range<usize>, frames: Range<usize>, want: Attributes) {
        if gaussians.is_empty() || frames.is_empty() {
            return;
        }
        let layout = self.reader.layout();
        let block = |id: usize, block_len: u32| (id / block_len as usize) as u32;
        let gaussians_per_block = layout.gaussian_block;
        for frame_block in block(frames.start, layout.frame_block)..=block(frames.end - 1, layout.frame_block) {
            for gaussian_block in
                block(gaussians.start, gaussians_per_block)..=block(gaussians.end - 1, gaussians_per_block)
            {
                let tiles = || self.unheld(want, gaussian_block, frame_block);
                // Request all tiles first, then wait for each of them.
                self.reader.prefetch_in_background(tiles());
                self.reader.prefetch_and_wait(tiles());
            }
        }
    }
}

#[cfg(test)]
mod tests;
