//! Measuring how pairs of Gaussians move beside each other, over all frames.

use rayon::prelude::*;

use super::{BLOCK, Progress};
use crate::error::{Error, Result};
use crate::merge::motion::{PairMeasure, PairMotion};
use crate::model::{Column, Columns, Gaussians, opacity};
use crate::pass::{BlockReader, FrameSource, Ids};
use crate::recipe;

/// Motion of every pair in `pairs` (places in `ids`); `reference` holds the positions of `ids` at the
/// reference frame.
///
/// Memory: per Gaussian of `ids` its reader, its track and its position at one frame, and per pair its
/// sums ([`crate::merge::motion::PAIR_BYTES`]); nothing grows with the number of frames. A sequence in which
/// neither positions nor opacities vary is measured by its first frame.
pub fn measure_motion(
    source: &dyn FrameSource,
    ids: &[u32],
    pairs: &[(u32, u32)],
    reference: &Column,
    scan: &recipe::Scan,
) -> Result<Vec<PairMeasure>> {
    let info = source.info();
    let needed = Columns::POSITION | Columns::OPACITY;
    let varying = info.varying & needed;
    let frames = if varying.is_empty() { info.times.len().min(1) } else { info.times.len() };
    let progress = Progress::new("motion", "Gaussian frames", ids.len() as u64 * frames as u64);

    let mut blocks: Vec<(Box<dyn BlockReader + '_>, Gaussians)> = ids
        .par_chunks(BLOCK)
        .map(|ids| Ok((source.open(Ids::List(ids))?, Gaussians::zeros(0, info.sh_degree))))
        .collect::<Result<_>>()?;
    let mut motion = PairMotion::new(pairs, reference, scan.motion);
    let mut position = Column::zeros(3, ids.len());
    let mut alive = vec![false; ids.len()];
    for frame in 0..frames {
        let want = if frame == 0 { needed } else { varying };
        blocks.par_iter_mut().zip(alive.par_chunks_mut(BLOCK)).try_for_each(|((reader, state), alive)| {
            reader.read(frame, want, state)?;
            for (alive, &logit) in alive.iter_mut().zip(state.opacity_logit.plane(0)) {
                *alive = opacity(logit) >= scan.alpha_min;
            }
            progress.advance(alive.len() as u64);
            Ok::<_, Error>(())
        })?;
        for c in 0..3 {
            for (to, (_, state)) in position.plane_mut(c).chunks_mut(BLOCK).zip(&blocks) {
                to.copy_from_slice(state.position.plane(c));
            }
        }
        motion.frame(&position, &alive);
    }
    Ok(motion.finish())
}
