//! The blocks of Gaussians of one scan: what they share, and how one of them is gone through.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use crate::error::Result;
use crate::model::{Camera, Columns, Gaussians, Rows, Schedule};
use crate::passes::BLOCK;
use crate::progress::Progress;
use crate::source::{BlockReader, FrameSource, Ids};
use crate::statistics::{BlockScan, ScanPlan, wanted};

/// What the scans of all blocks share.
pub(crate) struct BlockScans<'a> {
    pub(crate) source: &'a dyn FrameSource,
    /// Cameras, frame by frame.
    pub(crate) schedule: &'a Schedule,
    pub(crate) plan: &'a ScanPlan,
    /// Those that are gone through.
    pub(crate) blocks: Range<usize>,
    pub(crate) progress: Progress,
    /// Living Gaussians in each frame. Sums of integers: the order in which blocks finish does not show.
    pub(crate) alive: Mutex<Vec<u32>>,
}

impl<'a> BlockScans<'a> {
    pub(crate) fn blocks(&self) -> usize {
        self.blocks.len()
    }

    pub(crate) fn frames(&self) -> usize {
        self.source.info().times.len()
    }

    /// The Gaussians of a block, counted among those that are gone through.
    pub(crate) fn range(&self, block: usize) -> Range<usize> {
        let block = self.blocks.start + block;
        block * BLOCK..self.source.info().count.min((block + 1) * BLOCK)
    }

    /// What may have changed since the frame before.
    pub(crate) fn changed(&self, frame: usize) -> Columns {
        wanted(frame, self.source.info().varying)
    }

    pub(crate) fn begin(&self, block: usize) -> (BlockScan<'a>, Gaussians) {
        let range = self.range(block);
        let state = Gaussians::zeros(range.len(), self.source.info().sh_degree);
        (BlockScan::new(range.len(), range.start, self.plan), state)
    }

    /// Adds the next frames of a block.
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
            scan.frame(frame, state, &cameras, changed);
            self.progress.advance(state.len() as u64);
        }
        Ok(())
    }

    /// The rows of a block of which all frames have been added, and its largest coordinate.
    pub(crate) fn finish(&self, (scan, _): (BlockScan<'a>, Gaussians)) -> (Rows, f32) {
        let found = scan.finish();
        let mut alive = self.alive.lock().unwrap_or_else(PoisonError::into_inner);
        for (sum, count) in alive.iter_mut().zip(found.alive_per_frame) {
            *sum += count;
        }
        (found.rows, found.largest_coordinate)
    }

    /// A block from first to last.
    pub(crate) fn block(&self, block: usize) -> Result<(Rows, f32)> {
        let mut scan = self.begin(block);
        let mut reader = self.source.open(Ids::Range(self.range(block)))?;
        self.add(&mut scan, 0..self.frames(), &mut *reader)?;
        Ok(self.finish(scan))
    }
}
