//! Scan (pass over all frames that computes statistics) of single blocks of Gaussians, and the data that the scans of
//! all blocks share.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use crate::error::Result;
use crate::model::{Attributes, Camera, Gaussians, StatisticRows, ViewSchedule};
use crate::passes::GAUSSIANS_PER_BLOCK;
use crate::progress::Progress;
use crate::source::{BlockReader, FrameSource, Ids};
use crate::statistics::{BlockScan, ScanPlan, attributes_to_read};

/// Data that is shared by the scans (passes over all frames that compute statistics) of all blocks of Gaussians.
pub(crate) struct BlockScans<'a> {
    pub(crate) source: &'a dyn FrameSource,
    /// Views at each frame, with their cameras.
    pub(crate) schedule: &'a ViewSchedule,
    pub(crate) plan: &'a ScanPlan,
    /// Numbers of the blocks of Gaussians to scan.
    pub(crate) blocks: Range<usize>,
    pub(crate) progress: Progress,
    /// Number of Gaussians alive (opacity ≥ alpha_min) in each frame, summed over finished blocks. The sums are
    /// integers, so the order in which blocks finish does not matter.
    pub(crate) alive: Mutex<Vec<u32>>,
}

impl<'a> BlockScans<'a> {
    pub(crate) fn blocks(&self) -> usize {
        self.blocks.len()
    }

    pub(crate) fn frames(&self) -> usize {
        self.source.info().times.len()
    }

    /// Returns the ids of the Gaussians of block number `block`, where 0 is the first block to scan.
    pub(crate) fn range(&self, block: usize) -> Range<usize> {
        let block = self.blocks.start + block;
        block * GAUSSIANS_PER_BLOCK..self.source.info().count.min((block + 1) * GAUSSIANS_PER_BLOCK)
    }

    /// Returns the attributes that must be read at frame `frame`: all attributes at frame 0, and after it only the
    /// attributes that may have changed since the previous frame.
    pub(crate) fn changed(&self, frame: usize) -> Attributes {
        attributes_to_read(frame, self.source.info().varying)
    }

    /// Returns a scan of block `block` that has not read any frame yet, and a buffer for the attributes of the block at
    /// one frame.
    pub(crate) fn begin(&self, block: usize) -> (BlockScan<'a>, Gaussians) {
        let range = self.range(block);
        let state = Gaussians::zeros(range.len(), self.source.info().sh_degree);
        (BlockScan::new(range.len(), range.start, self.plan), state)
    }

    /// Reads the frames `frames` of a block with `reader` and adds them to the block's scan.
    ///
    /// # Errors
    /// Fails if a frame cannot be read.
    pub(crate) fn add(
        &self,
        (scan, state): &mut (BlockScan<'a>, Gaussians),
        frames: Range<usize>,
        reader: &mut dyn BlockReader,
    ) -> Result<()> {
        let mut cameras: Vec<&Camera> = Vec::new();
        for frame in frames {
            let changed = self.changed(frame);
            reader.read(frame, changed, state)?;
            cameras.clear();
            cameras
                .extend(self.schedule.views(frame).iter().map(|&(_, camera)| &self.schedule.cameras[camera as usize]));
            scan.add_frame(frame, state, &cameras, changed);
            self.progress.advance(state.len() as u64);
        }
        Ok(())
    }

    /// Returns the results of a block whose frames have all been added: its statistics, one row per Gaussian, and the
    /// largest |coordinate| of its positions.
    pub(crate) fn finish(&self, (scan, _): (BlockScan<'a>, Gaussians)) -> (StatisticRows, f32) {
        let found = scan.finish();
        let mut alive = self.alive.lock().unwrap_or_else(PoisonError::into_inner);
        for (sum, count) in alive.iter_mut().zip(found.alive_per_frame) {
            *sum += count;
        }
        (found.rows, found.largest_coordinate)
    }

    /// Scans all frames of block `block`. Returns the statistics of its Gaussians, one row each, and the largest
    /// |coordinate| of its positions.
    ///
    /// # Errors
    /// Fails if a frame cannot be read.
    pub(crate) fn block(&self, block: usize) -> Result<(StatisticRows, f32)> {
        let mut scan = self.begin(block);
        let mut reader = self.source.open(Ids::Range(self.range(block)))?;
        self.add(&mut scan, 0..self.frames(), &mut *reader)?;
        Ok(self.finish(scan))
    }
}
