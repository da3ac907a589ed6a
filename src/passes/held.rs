//! Consecutive frames that are held in memory together, so that passes which read block by block can process input that
//! arrives frame by frame.

use std::ops::Range;

use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids};

/// Source of frames held in memory with all columns. Its frame 0 is the first frame held.
pub struct HeldFrames {
    info: SequenceInfo,
    constant: Gaussians,
    frames: Vec<Gaussians>,
}

impl HeldFrames {
    /// Creates a source of `count` Gaussians without frames. `constant` holds the columns outside `varying`.
    pub fn new(count: usize, sh_degree: usize, varying: Attributes, constant: Gaussians) -> Self {
        let info = SequenceInfo { count, times: Vec::new(), sh_degree, varying };
        HeldFrames { info, constant, frames: Vec::new() }
    }

    /// Adds a frame. Only the varying columns of `state` are used; they hold all Gaussians.
    pub fn push(&mut self, time: f64, state: Gaussians) {
        self.info.times.push(time);
        self.frames.push(state);
    }

    /// Removes and returns all frames.
    pub fn drain(&mut self) -> impl Iterator<Item = Gaussians> {
        self.info.times.clear();
        self.frames.drain(..)
    }

    /// Returns the positions of all Gaussians at a held frame.
    pub fn position(&self, frame: usize) -> &AttributeValues {
        let varies = self.info.varying.contains(Attributes::POSITION);
        if varies { &self.frames[frame].position } else { &self.constant.position }
    }

    /// Returns the number of frames held.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Returns whether no frame is held.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }
}

impl FrameSource for HeldFrames {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let mut runs: Vec<Range<usize>> = Vec::new();
        for id in ids.iter() {
            match runs.last_mut() {
                Some(run) if run.end == id => run.end += 1,
                _ => runs.push(id..id + 1),
            }
        }
        Ok(Box::new(HeldReader { held: self, len: ids.len(), runs }))
    }
}

struct HeldReader<'a> {
    held: &'a HeldFrames,
    len: usize,
    /// Ranges of consecutive ids, in the order of the requested ids.
    runs: Vec<Range<usize>>,
}

impl BlockReader for HeldReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        for column in want.iter() {
            let varies = self.held.info.varying.contains(column);
            let from = if varies { &self.held.frames[frame] } else { &self.held.constant }.column(column);
            let to = out.column_mut(column);
            to.resize(self.len);
            for c in 0..to.width() {
                let (plane, mut rest) = (from.plane(c), to.plane_mut(c));
                for run in &self.runs {
                    let (part, after) = rest.split_at_mut(run.len());
                    part.copy_from_slice(&plane[run.clone()]);
                    rest = after;
                }
            }
        }
        Ok(())
    }
}
