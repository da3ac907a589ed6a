//! A sequence with its base colours changed, frame by frame as it is read.

use crate::error::Result;
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::pass::{BlockReader, FrameSource, Ids};

/// A source whose base colours (`f_dc`) are changed, the same at every frame.
pub struct Recolored<'a> {
    source: Box<dyn FrameSource + 'a>,
    change: &'a [[f32; 3]],
}

impl<'a> Recolored<'a> {
    /// `source` with `change` `[N]` added to the first spherical-harmonic coefficients of its Gaussians; none:
    /// the source as it is.
    pub fn new(source: Box<dyn FrameSource + 'a>, change: &'a [[f32; 3]]) -> Self {
        Recolored { source, change }
    }
}

impl FrameSource for Recolored<'_> {
    fn info(&self) -> &SequenceInfo {
        self.source.info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        if self.change.is_empty() {
            return self.source.open(ids);
        }
        let change = ids.iter().map(|id| self.change[id]).collect();
        Ok(Box::new(RecoloredReader { reader: self.source.open(ids)?, change }))
    }
}

struct RecoloredReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    change: Vec<[f32; 3]>,
}

impl BlockReader for RecoloredReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        if want.contains(Columns::SH) {
            recolor(out, &self.change);
        }
        Ok(())
    }
}

/// Adds `change` to the first coefficients of every Gaussian.
pub fn recolor(state: &mut Gaussians, change: &[[f32; 3]]) {
    for c in 0..3 {
        state.sh.plane_mut(c).iter_mut().zip(change).for_each(|(value, change)| *value += change[c]);
    }
}
