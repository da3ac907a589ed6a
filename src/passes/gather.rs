//! The state of many Gaussians at one frame, read in blocks on all threads. Whoever reads more than a frame keeps
//! readers open instead ([`super::FrameReaders`], [`super::States`]), so that no tile is decoded for each.

use rayon::prelude::*;

use super::BLOCK;
use super::frames::open_all;
use super::parts::BlockSlices;
use crate::error::{Error, Result};
use crate::model::{Column, Columns, Gaussians};
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan};

/// Columns `want` of the Gaussians `ids` at `frame`; all other columns are empty.
///
/// Memory: what it gives, and per thread a reader over one block and that block's state.
pub fn gather(source: &dyn FrameSource, ids: &[u32], frame: usize, want: Columns) -> Result<Gaussians> {
    let sh_degree = source.info().sh_degree;
    let mut all = Gaussians::zeros(0, sh_degree);
    let parts = BlockSlices::split(&mut all, want, ids.len());
    let wanted = ReadPlan::new([frame]);
    ids.par_chunks(BLOCK).zip(parts).try_for_each_init(
        || Gaussians::zeros(0, sh_degree),
        |block, (ids, parts)| {
            let mut reader = source.open(Ids::List(ids))?;
            reader.expect(&wanted);
            reader.read(frame, want, block)?;
            parts.write(block, want);
            Ok::<_, Error>(())
        },
    )?;
    Ok(all)
}

/// Columns `want` of all Gaussians at `frame`; all other columns are empty.
pub fn gather_all(source: &dyn FrameSource, frame: usize, want: Columns) -> Result<Gaussians> {
    let mut all = Gaussians::zeros(0, source.info().sh_degree);
    open_all(source, want, &ReadPlan::new([frame]))?.read(frame, want, &mut all)?;
    Ok(all)
}

/// Reads all Gaussians of a source that decodes nothing together, each block by a reader that lasts for one frame: nothing is
/// gained by what readers of all Gaussians would keep.
pub struct InBlocks<'a> {
    source: &'a dyn FrameSource,
    ids: Vec<u32>,
}

impl<'a> InBlocks<'a> {
    /// Of all of `source`. Memory: 4 bytes a Gaussian.
    pub fn new(source: &'a dyn FrameSource) -> InBlocks<'a> {
        InBlocks { source, ids: (0..source.info().count as u32).collect() }
    }
}

impl BlockReader for InBlocks<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        // What is replaced goes first.
        out.columns_mut(want).for_each(|column| *column = Column::default());
        let mut found = gather(self.source, &self.ids, frame, want)?;
        out.columns_mut(want).zip(found.columns_mut(want)).for_each(|(to, from)| std::mem::swap(to, from));
        Ok(())
    }
}
