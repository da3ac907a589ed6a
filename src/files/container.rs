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
//! When a reader that decodes whole frame blocks enters a block, it tells the system which block comes next, so that the
//! system reads it ahead.

mod held;
mod store;
mod tiles;

pub use self::store::Container;
use self::tiles::TileReader;
use crate::error::Result;
use crate::model::SequenceInfo;
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts};

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
}

#[cfg(test)]
mod tests;
