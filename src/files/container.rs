//! Reads frames of Gaussians from a `gseq` container (this project's file format for sequences).
//!
//! Input: the file. Output: the attributes of any Gaussians at any frame. A tile holds the values of one attribute for
//! a block of consecutive Gaussians and a block of consecutive frames. Memory: buffers for each reader (`TileReader`),
//! decoded tiles that all readers share (`HeldTiles`), and decoding buffers for each thread (`TileScratch`).
//!
//! Raw (uncompressed) tiles are read in place from the memory-mapped file; compressed tiles are decoded directly from
//! the mapping. Mapped pages that were read count as memory of the process until they are released, so a reader
//! releases the pages of a frame block when it enters another one. A reader that may keep less than a frame block in
//! memory copies the values with positioned reads instead, because releasing pages after every frame costs more than
//! the copy. Throughput of reading raw frames into the caller's buffers (`cargo bench --bench scan`, `raw_frames`; two
//! threads on two cores of a busy EPYC, so compare the figures only with one another):
//!
//! | method | GB/s |
//! |---|---|
//! | pages released after each frame block | 1.5 |
//! | pages released after each frame | 0.6 |
//! | positioned reads | 1.4 |
//! | pages never released | 2.3 |
//!
//! A file that is in the page cache is read one frame block after another. When a reader that decodes whole frame
//! blocks enters a block, it tells the system which block comes next, so that the system reads it ahead. A file that is
//! not in the page cache is read in stages by a scan (pass over all frames): one thread fetches bytes from the disk
//! before others need them ([`FrameSource::prefetcher`]). Times of a scan on the same machine, the first by frame
//! blocks, the second in stages:
//!
//! | file | raw tiles, ms | compressed tiles, ms |
//! |---|---|---|
//! | not in the page cache | 95 and 71 | 222 and 232 |
//! | on a simulated disk of 300 MB/s | 158 and 162 | 216 and 206 |
//! | in the page cache | 46 and 45 | 152 and 223 |
//!
//! In the page cache, a scan of compressed tiles never waits for the disk, but its stages wait for one another.

mod held;
mod store;
mod tiles;

use std::ops::Range;

pub use self::store::Container;
use self::tiles::TileReader;
use crate::error::Result;
use crate::model::{Attributes, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids, Prefetch, ReadCounts};

/// Number of positions in the file that are sampled to find out whether the file is in the page cache.
const CACHE_SAMPLES: u64 = 64;

impl FrameSource for Container {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(TileReader::new(self, &ids)))
    }

    fn reads(&self) -> ReadCounts {
        let read = self.reader.tiles_read();
        ReadCounts { bytes: read.bytes, tiles: read.tiles, states: self.states.get() }
    }

    /// Returns the prefetcher, with which a scan (pass over all frames) reads the file ahead in stages. Returns `None`
    /// if the file is in the page cache, where a scan in stages is not faster (times: see the module documentation).
    fn prefetcher(&self) -> Option<&dyn Prefetch> {
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
