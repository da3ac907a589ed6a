//! Frame source that shows only chosen frames of another source, renumbered from 0.

use crate::error::Result;
use crate::model::{Attributes, Gaussians, SequenceInfo, ViewSchedule};
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts, ReadPlan};

/// Frame source that shows only chosen frames of another source. Frame k of this source is the k-th chosen frame,
/// counted from 0.
pub struct SomeFrames<'a> {
    source: &'a dyn FrameSource,
    /// Chosen frames of `source`, increasing.
    frames: Vec<usize>,
    info: SequenceInfo,
}

impl<'a> SomeFrames<'a> {
    /// Creates a source that shows only the frames of `source` with the indices `frames`, in increasing order.
    pub fn new(source: &'a dyn FrameSource, frames: Vec<usize>) -> SomeFrames<'a> {
        let times = frames.iter().map(|&frame| source.info().times[frame]).collect();
        SomeFrames { source, info: SequenceInfo { times, ..source.info().clone() }, frames }
    }

    /// Returns the schedule (list of the views at each frame) for the chosen frames. `schedule` lists the views at all
    /// frames of the original source.
    pub fn views(&self, schedule: &ViewSchedule) -> ViewSchedule {
        let mut chosen = ViewSchedule::new(schedule.cameras.clone());
        self.frames.iter().for_each(|&frame| chosen.push_frames(1, schedule.views(frame)));
        chosen
    }
}

impl FrameSource for SomeFrames<'_> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let mut reader = self.source.open(ids)?;
        reader.expect(&ReadPlan::new(self.frames.iter().copied()));
        Ok(Box::new(SomeFramesReader { reader, frames: &self.frames }))
    }

    fn reads(&self) -> ReadCounts {
        self.source.reads()
    }
}

/// Reader of a block of Gaussians at the chosen frames.
struct SomeFramesReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    frames: &'a [usize],
}

impl BlockReader for SomeFramesReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        self.reader.read(self.frames[frame], want, out)
    }
}
