//! Many Gaussians of a source, frame after frame, read in blocks on all threads.

use rayon::prelude::*;

use super::BLOCK;
use crate::error::{Error, Result};
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::pass::{BlockReader, FrameSource, Ids};

/// Open readers over Gaussians of a source.
///
/// Memory per Gaussian: its reader and its state at one frame.
pub struct Frames<'a> {
    info: &'a SequenceInfo,
    columns: Columns,
    count: usize,
    blocks: Vec<(Box<dyn BlockReader + 'a>, Gaussians)>,
}

impl<'a> Frames<'a> {
    /// Opens readers for the columns `columns` of the Gaussians `ids`, which hold at most `held` frames each
    /// ([`BlockReader::hold`]).
    pub fn open(source: &'a dyn FrameSource, ids: Ids<'_>, columns: Columns, held: usize) -> Result<Frames<'a>> {
        let (info, count) = (source.info(), ids.len());
        let sh_degree = degree(info, columns);
        let blocks = (0..count.div_ceil(BLOCK))
            .into_par_iter()
            .map(|block| {
                let rows = block * BLOCK..count.min((block + 1) * BLOCK);
                let state = Gaussians::zeros(rows.len(), sh_degree);
                let ids = match &ids {
                    Ids::Range(range) => Ids::Range(range.start + rows.start..range.start + rows.end),
                    Ids::List(list) => Ids::List(&list[rows]),
                };
                let mut reader = source.open(ids)?;
                reader.hold(held);
                Ok((reader, state))
            })
            .collect::<Result<_>>()?;
        Ok(Frames { info, columns, count, blocks })
    }

    /// A state to read into.
    pub fn state(&self) -> Gaussians {
        Gaussians::zeros(self.count, degree(self.info, self.columns))
    }

    /// Reads the columns `want`, of those that were opened, at `frame` into `state`.
    pub fn read(&mut self, frame: usize, want: Columns, state: &mut Gaussians) -> Result<()> {
        let want = want & self.columns;
        if want.is_empty() {
            return Ok(());
        }
        self.blocks.par_iter_mut().try_for_each(|(reader, block)| reader.read(frame, want, block))?;
        for column in want.iter() {
            let target = state.column_mut(column);
            for c in 0..target.width() {
                for (to, (_, block)) in target.plane_mut(c).chunks_mut(BLOCK).zip(&self.blocks) {
                    to.copy_from_slice(block.column(column).plane(c));
                }
            }
        }
        Ok::<_, Error>(())
    }
}

/// No room for colours that nobody reads.
fn degree(info: &SequenceInfo, columns: Columns) -> usize {
    if columns.contains(Columns::SH) { info.sh_degree } else { 0 }
}
