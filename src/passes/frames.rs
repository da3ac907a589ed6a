//! Readers of many Gaussians of a frame source, for one frame after the other, in blocks of Gaussians on all threads.

use rayon::prelude::*;

use super::GAUSSIANS_PER_BLOCK;
use super::parts::BlockSlices;
use crate::error::Result;
use crate::model::{Attributes, Gaussians, SequenceInfo};
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan};

/// Readers of many Gaussians of a frame source: one reader for each block of [`GAUSSIANS_PER_BLOCK`] Gaussians. All
/// readers stay open while one frame after the other is read.
///
/// Memory: one reader for every block; on each thread the attributes of one block at one frame.
pub struct FrameReaders<'a> {
    info: &'a SequenceInfo,
    columns: Attributes,
    count: usize,
    readers: Vec<Box<dyn BlockReader + 'a>>,
}

impl<'a> FrameReaders<'a> {
    /// Opens readers for the attributes `columns` of the Gaussians `ids`. `plan` names the frames that will be read.
    ///
    /// # Errors
    /// Fails if the source cannot be opened.
    pub fn open(
        source: &'a dyn FrameSource,
        ids: Ids<'_>,
        columns: Attributes,
        plan: &ReadPlan,
    ) -> Result<FrameReaders<'a>> {
        let count = ids.len();
        let readers = (0..count.div_ceil(GAUSSIANS_PER_BLOCK))
            .into_par_iter()
            .map(|block| {
                let rows = block * GAUSSIANS_PER_BLOCK..count.min((block + 1) * GAUSSIANS_PER_BLOCK);
                let ids = match &ids {
                    Ids::Range(range) => Ids::Range(range.start + rows.start..range.start + rows.end),
                    Ids::List(list) => Ids::List(&list[rows]),
                };
                let mut reader = source.open(ids)?;
                reader.expect(plan);
                Ok(reader)
            })
            .collect::<Result<_>>()?;
        Ok(FrameReaders { info: source.info(), columns, count, readers })
    }

    /// Returns a buffer with space for the attributes of all Gaussians of these readers at one frame.
    pub fn state_buffer(&self) -> Gaussians {
        Gaussians::zeros(self.count, self.sh_degree())
    }

    /// Returns the SH degree of the frames that are read: 0 if `columns` excludes SH, which saves the memory for it.
    fn sh_degree(&self) -> usize {
        if self.columns.contains(Attributes::SH) { self.info.sh_degree } else { 0 }
    }
}

impl BlockReader for FrameReaders<'_> {
    /// Reads the attributes `want` at frame `frame` into `state`. Attributes for which the readers were not opened are
    /// ignored.
    fn read(&mut self, frame: usize, want: Attributes, state: &mut Gaussians) -> Result<()> {
        let want = want & self.columns;
        if want.is_empty() {
            return Ok(());
        }
        let sh_degree = self.sh_degree();
        self.readers.par_iter_mut().zip(BlockSlices::split(state, want, self.count)).try_for_each_init(
            || Gaussians::zeros(0, sh_degree),
            |block, (reader, parts)| {
                reader.read(frame, want, block)?;
                parts.write(block, want);
                Ok(())
            },
        )
    }

    fn expect(&mut self, plan: &ReadPlan) {
        self.readers.iter_mut().for_each(|reader| reader.expect(plan));
    }
}

/// Opens a reader of the attributes `columns` of all Gaussians of a source. It stays open for all frames that `plan`
/// names.
///
/// Memory: that of [`FrameReaders`], or that of the source's own reader if it has one ([`FrameSource::open_all`]).
pub(super) fn open_all<'a>(
    source: &'a dyn FrameSource,
    columns: Attributes,
    plan: &ReadPlan,
) -> Result<Box<dyn BlockReader + 'a>> {
    match source.open_all(plan) {
        Some(opened) => opened,
        None => Ok(Box::new(FrameReaders::open(source, Ids::Range(0..source.info().count), columns, plan)?)),
    }
}
