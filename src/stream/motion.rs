//! Measuring how alike pairs of Gaussians move, over all frames.
//!
//! As long as all pairs fit, they are measured in one read of the source. Else the trajectories of every Gaussian in a
//! pair are gathered once in voxel order ([`Trajectories`]), and the pairs are cut into partitions of that order: a
//! partition is so many consecutive pairs, and reads the Gaussians that lead them and their ghosts, the partners
//! within ε that other partitions share. As partitions are cut by counting pairs, a voxel that holds more than fit is
//! split. Every pair is summed whole in one partition, so no cut changes a bit.

use std::path::PathBuf;

use rayon::prelude::*;

use super::{BLOCK, Progress, Trajectories};
use crate::emit::container::FRAME_BLOCK;
use crate::error::{Error, Result};
use crate::merge::known::Likeness;
use crate::merge::motion::{MotionGate, NODE_BYTES, PAIR_BYTES, PairMotion};
use crate::merge::voxels::voxel_order;
use crate::model::{Column, Columns, Gaussians, opacity};
use crate::pass::{BlockReader, FrameSource, Ids};
use crate::plan::Limits;
use crate::recipe;

/// What test 3 reads of a Gaussian.
const NEEDED: Columns = Columns::POSITION.with(Columns::OPACITY);

/// Memory of one pair while it is measured: its sums, its two Gaussians while they are counted, its result.
pub const BYTES_PER_PAIR: usize = PAIR_BYTES + 8 + size_of::<f64>();

/// Memory of one Gaussian of the pairs that are measured together, at most two per pair, beside what the reader of the
/// source itself keeps: number and id, track, state at one frame, and the frames a reader holds.
pub fn bytes_per_gaussian(frames_held: usize) -> usize {
    8 + NODE_BYTES + 16 * (1 + frames_held.min(FRAME_BLOCK))
}

/// Measures pairs of Gaussians of a source.
pub struct PairMeter<'a> {
    /// Where they move.
    pub source: &'a dyn FrameSource,
    /// What is life, and what is a step.
    pub scan: &'a recipe::Scan,
    /// What makes a pair alike.
    pub gate: MotionGate,
    /// How many pairs are measured together, and how many frames are held.
    pub limits: Limits,
    /// Folder for trajectories that have to wait.
    pub scratch: PathBuf,
}

impl PairMeter<'_> {
    /// How alike each of `pairs` (rows of `ids`, which increase) moves, in some order. `reference` `[3, M]` holds the
    /// positions of `ids` at the reference frame; partners lie within about `reach` of each other there.
    ///
    /// Memory: [`BYTES_PER_PAIR`] and [`bytes_per_gaussian`] for the pairs measured together; 16 bytes for every pair; and
    /// where not all fit, 12 bytes for each of `ids` and what [`Trajectories`] needs for those in a pair. Nothing grows
    /// with the number of frames. A sequence in which neither positions nor opacities vary is measured by its first.
    pub fn measure(
        &self,
        ids: &[u32],
        reference: &Column,
        mut pairs: Vec<(u32, u32)>,
        reach: f64,
    ) -> Result<Vec<Likeness>> {
        let mut found = Vec::with_capacity(pairs.len());
        if pairs.len() <= self.limits.pairs_together {
            let rows = members(&pairs);
            let of_rows: Vec<u32> = rows.iter().map(|&row| ids[row as usize]).collect();
            let progress = Progress::new("motion", "Gaussian frames", self.work(self.source, rows.len()));
            let places = rows.iter().map(|&row| reference.row(row as usize));
            let measured = self.follow(self.source, &of_rows, places, local(&pairs, &rows), |n| progress.advance(n))?;
            found.extend(pairs.iter().zip(measured).map(|(&(a, b), likeness)| (a, b, likeness)));
            return Ok(found);
        }
        let order = voxel_order(&members(&pairs), reference, reach);
        let of_order: Vec<u32> = order.iter().map(|&row| ids[row as usize]).collect();
        let trajectories =
            Trajectories::gather(self.source, &of_order, NEEDED, self.limits.frames_held, &self.scratch)?;
        drop(of_order);
        let mut place = vec![0; ids.len()];
        for (&row, k) in order.iter().zip(0u32..) {
            place[row as usize] = k;
        }
        for (a, b) in &mut pairs {
            let (i, j) = (place[*a as usize], place[*b as usize]);
            (*a, *b) = (i.min(j), i.max(j));
        }
        drop(place);
        pairs.par_sort_unstable();
        let progress = Progress::new("motion", "pairs", pairs.len() as u64);
        // Partitions of equal size: as few as the limit allows.
        let partitions = pairs.len().div_ceil(self.limits.pairs_together);
        for of_partition in pairs.chunks(pairs.len().div_ceil(partitions)) {
            let places = members(of_partition);
            let at = places.iter().map(|&k| reference.row(order[k as usize] as usize));
            let measured = self.follow(trajectories.source(), &places, at, local(of_partition, &places), |_| ())?;
            found.extend(of_partition.iter().zip(measured).map(|(&(i, j), likeness)| {
                let (a, b) = (order[i as usize], order[j as usize]);
                (a.min(b), a.max(b), likeness)
            }));
            progress.advance(of_partition.len() as u64);
        }
        Ok(found)
    }

    /// Likeness of `pairs` of places in `ids`, whose positions at the reference frame are `reference`.
    fn follow(
        &self,
        source: &dyn FrameSource,
        ids: &[u32],
        reference: impl ExactSizeIterator<Item = [f32; 3]>,
        pairs: impl ExactSizeIterator<Item = (u32, u32)>,
        advance: impl Fn(u64) + Sync,
    ) -> Result<impl Iterator<Item = f64>> {
        let info = source.info();
        let varying = info.varying & NEEDED;
        let mut readers: Vec<Box<dyn BlockReader + '_>> = ids
            .par_chunks(BLOCK)
            .map(|ids| {
                let mut reader = source.open(Ids::List(ids))?;
                reader.hold(self.limits.frames_held);
                Ok(reader)
            })
            .collect::<Result<_>>()?;
        let mut states: Vec<Gaussians> = readers.iter().map(|_| Gaussians::zeros(0, info.sh_degree)).collect();
        let mut motion = PairMotion::new(pairs, reference, self.scan.motion);
        for frame in 0..frames(source) {
            let want = if frame == 0 { NEEDED } else { varying };
            readers.par_iter_mut().zip(&mut states).try_for_each(|(reader, state)| {
                reader.read(frame, want, state)?;
                advance(state.position.len() as u64);
                Ok::<_, Error>(())
            })?;
            motion.frame(|node| {
                let (state, row) = (&states[node / BLOCK], node % BLOCK);
                (state.position.row(row), opacity(state.opacity_logit.plane(0)[row]) >= self.scan.alpha_min)
            });
        }
        Ok(motion.finish().map(|pair| self.gate.likeness(&pair)))
    }

    /// Gaussian frames to read for `gaussians` of a source.
    fn work(&self, source: &dyn FrameSource, gaussians: usize) -> u64 {
        (gaussians * frames(source)) as u64
    }
}

/// Frames that say everything about the motion in a source.
fn frames(source: &dyn FrameSource) -> usize {
    let info = source.info();
    let all = info.times.len();
    if (info.varying & NEEDED).is_empty() { all.min(1) } else { all }
}

/// Everybody in a pair, increasing.
fn members(pairs: &[(u32, u32)]) -> Vec<u32> {
    let mut members = Vec::with_capacity(2 * pairs.len());
    members.extend(pairs.iter().flat_map(|&(a, b)| [a, b]));
    members.par_sort_unstable();
    members.dedup();
    members.shrink_to_fit();
    members
}

/// The pairs as places in `members`.
fn local<'a>(pairs: &'a [(u32, u32)], members: &'a [u32]) -> impl ExactSizeIterator<Item = (u32, u32)> + 'a {
    let place = |member: u32| members.binary_search(&member).unwrap_or_default() as u32;
    pairs.iter().map(move |&(a, b)| (place(a), place(b)))
}
