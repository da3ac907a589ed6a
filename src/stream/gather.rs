//! The state of many Gaussians at one frame, read in blocks on all threads.

use rayon::prelude::*;

use super::BLOCK;
use crate::error::Result;
use crate::model::{Columns, Gaussians};
use crate::pass::{FrameSource, Ids};

/// Columns `want` of the Gaussians `ids` at `frame`; all other columns are empty.
pub fn gather(source: &dyn FrameSource, ids: &[u32], frame: usize, want: Columns) -> Result<Gaussians> {
    let blocks: Vec<Gaussians> = ids
        .par_chunks(BLOCK)
        .map(|ids| {
            let mut block = Gaussians::zeros(0, source.info().sh_degree);
            let mut reader = source.open(Ids::List(ids))?;
            reader.hold(1);
            reader.read(frame, want, &mut block)?;
            Ok(block)
        })
        .collect::<Result<_>>()?;
    let mut all = Gaussians::zeros(0, source.info().sh_degree);
    for column in want.iter() {
        let target = all.column_mut(column);
        target.resize(ids.len());
        for c in 0..target.width() {
            for (to, block) in target.plane_mut(c).chunks_mut(BLOCK).zip(&blocks) {
                to.copy_from_slice(block.column(column).plane(c));
            }
        }
    }
    Ok(all)
}

/// Columns `want` of all Gaussians at `frame`; all other columns are empty.
pub fn gather_all(source: &dyn FrameSource, frame: usize, want: Columns) -> Result<Gaussians> {
    let ids: Vec<u32> = (0..source.info().count as u32).collect();
    gather(source, &ids, frame, want)
}
