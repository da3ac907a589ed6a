//! Scan (pass over all frames that computes statistics) of single blocks of Gaussians, and the data that the scans of
//! all blocks share.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use crate::error::Result;
use crate::model::{Camera, Gaussians, StatisticRows, ViewSchedule};
use crate::passes::GAUSSIANS_PER_BLOCK;
use crate::progress::Progress;
use crate::source::{FrameSource, Ids};
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

impl BlockScans<'_> {
    /// Scans all frames of the block of Gaussians with the number `block`. Returns the statistics of its Gaussians, one
    /// row each, and the largest |coordinate| of their positions.
    ///
    /// # Errors
    /// Fails if a frame cannot be read.
    pub(crate) fn block(&self, block: usize) -> Result<(StatisticRows, f32)> {
        let info = self.source.info();
        let range = block * GAUSSIANS_PER_BLOCK..info.count.min((block + 1) * GAUSSIANS_PER_BLOCK);
        let mut scan = BlockScan::new(range.len(), range.start, self.plan);
        let mut state = Gaussians::zeros(range.len(), info.sh_degree);
        let mut reader = self.source.open(Ids::Range(range))?;
        let mut cameras: Vec<&Camera> = Vec::new();
        for frame in 0..info.times.len() {
            let changed = attributes_to_read(frame, info.varying);
            reader.read(frame, changed, &mut state)?;
            cameras.clear();
            cameras
                .extend(self.schedule.views(frame).iter().map(|&(_, camera)| &self.schedule.cameras[camera as usize]));
            scan.add_frame(frame, &state, &cameras, changed);
            self.progress.advance(state.len() as u64);
        }
        let found = scan.finish();
        let mut alive = self.alive.lock().unwrap_or_else(PoisonError::into_inner);
        for (sum, count) in alive.iter_mut().zip(found.alive_per_frame) {
            *sum += count;
        }
        Ok((found.rows, found.largest_coordinate))
    }
}
