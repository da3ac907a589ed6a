//! How frames reach a pass: a source hands out readers over blocks of Gaussians.

use std::ops::Range;

use crate::error::Result;
use crate::model::{Columns, Gaussians, SequenceInfo};

/// A sequence of Gaussians that can be read block by block, frame by frame, in any order, from
/// several threads. The same (Gaussian, frame) always gives the same bits, whatever the block.
pub trait FrameSource: Send + Sync {
    /// Size, time stamps and varying columns.
    fn info(&self) -> &SequenceInfo;

    /// A reader over the Gaussians of `range`. What does not change with time is prepared here once.
    fn open(&self, range: Range<usize>) -> Result<Box<dyn BlockReader + '_>>;

    /// The same sequence reduced to the Gaussians `ids` (strictly increasing).
    fn subset(&self, ids: &[u32]) -> Result<Box<dyn FrameSource + '_>>;
}

/// Reads one block of Gaussians at any frame.
pub trait BlockReader {
    /// Writes the columns `want` of the block at `frame` into `out`, which is resized to the block.
    /// Columns outside `want` are left alone.
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()>;
}
