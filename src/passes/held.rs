//! Consecutive frames that are kept in memory together. Passes that read one block of Gaussians after the other can
//! thus process an input that arrives frame by frame.

use std::ops::Range;

use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids};

/// Frame source whose frames are in memory with all attributes. Its frame 0 is the first frame in memory.
pub struct FramesInMemory {
    info: SequenceInfo,
    constant: Gaussians,
    frames: Vec<Gaussians>,
}

impl FramesInMemory {
    /// Creates a source of `count` Gaussians with SH coefficients up to `sh_degree`, without any frame. `varying` names
    /// the attributes that vary in time; `constant` holds the values of all others.
    pub fn new(count: usize, sh_degree: usize, varying: Attributes, constant: Gaussians) -> Self {
        let info = SequenceInfo { count, times: Vec::new(), sh_degree, varying };
        FramesInMemory { info, constant, frames: Vec::new() }
    }

    /// Adds the frame at time `time`. `state` holds all Gaussians; only its time-varying attributes are used.
    pub fn push(&mut self, time: f64, state: Gaussians) {
        self.info.times.push(time);
        self.frames.push(state);
    }

    /// Removes all frames from memory and returns them.
    pub fn drain(&mut self) -> impl Iterator<Item = Gaussians> {
        self.info.times.clear();
        self.frames.drain(..)
    }

    /// Returns the positions of all Gaussians at frame `frame` of this source.
    pub fn position(&self, frame: usize) -> &AttributeValues {
        let varies = self.info.varying.contains(Attributes::POSITION);
        if varies { &self.frames[frame].position } else { &self.constant.position }
    }

    /// Returns the number of frames in memory.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Returns whether no frame is in memory.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }
}

impl FrameSource for FramesInMemory {
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
        Ok(Box::new(HeldReader { source: self, len: ids.len(), runs }))
    }
}

struct HeldReader<'a> {
    source: &'a FramesInMemory,
    len: usize,
    /// Ids of the Gaussians to read, in the order in which they are returned, as ranges of consecutive ids.
    runs: Vec<Range<usize>>,
}

impl BlockReader for HeldReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        for column in want.iter() {
            let varies = self.source.info.varying.contains(column);
            let from = if varies { &self.source.frames[frame] } else { &self.source.constant }.attribute_values(column);
            let to = out.attribute_values_mut(column);
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
