//! Looking at Gaussians through many cameras: a frame is read once, its pictures run on all threads.
//!
//! Frame-major, for occlusion needs all Gaussians of a frame at once: frames are read by blocks on all
//! threads, then the pictures of a batch of frames are shared out among them.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::{BLOCK, Progress};
use crate::error::{Error, Result};
use crate::model::{Camera, Columns, Gaussians, Schedule};
use crate::pass::{BlockReader, FrameSource, Ids};
use crate::recipe;

/// Pictures of a batch for each thread: enough that the last ones to finish cost little.
const PICTURES_PER_THREAD: usize = 4;

/// Views of a frame that are worth reading it for.
const VIEWS_AT_ONCE: usize = 3;

/// Pictures to look at: frames in order, each with the cameras of its pictures, at least one.
#[derive(Debug, Clone)]
pub struct Sample<'a>(pub(super) Vec<(usize, Vec<&'a Camera>)>);

impl<'a> Sample<'a> {
    /// What the strides of `scan` leave of `schedule`: of the frames that have pictures the first and
    /// every `frame_stride`-th, of the pictures of each every `view_stride`-th, from one that moves on
    /// from frame to frame, so that all views take their turns.
    pub fn new(schedule: &'a Schedule, scan: &recipe::Scan) -> Self {
        Self::with_strides(schedule, scan.frame_stride.get() as usize, scan.view_stride.get() as usize)
    }

    /// About `pictures` pictures at most, spread over all frames and views, of no more frames than it takes
    /// to have [`VIEWS_AT_ONCE`] views of each, or all there are: reading a frame can cost more than looking
    /// at it once.
    pub fn at_most(schedule: &'a Schedule, pictures: usize) -> Self {
        let frames = schedule.frames.iter().filter(|views| !views.is_empty()).count().max(1);
        let views = schedule.pairs().div_ceil(frames).clamp(1, VIEWS_AT_ONCE);
        let frame_stride = frames.div_ceil(pictures.div_ceil(views).max(1));
        let left = schedule.pairs().div_ceil(frame_stride);
        Self::with_strides(schedule, frame_stride, left.div_ceil(pictures.max(1)).max(1))
    }

    fn with_strides(schedule: &'a Schedule, frame_stride: usize, view_stride: usize) -> Self {
        let with_pictures = schedule.frames.iter().enumerate().filter(|(_, views)| !views.is_empty());
        let sampled = with_pictures.step_by(frame_stride).enumerate();
        let taken = sampled.map(|(turn, (frame, views))| {
            let views = views.iter().skip(turn % view_stride).step_by(view_stride);
            (frame, views.map(|&(_, camera)| &schedule.cameras[camera as usize]).collect::<Vec<_>>())
        });
        Sample(taken.filter(|(_, cameras)| !cameras.is_empty()).collect())
    }

    /// Number of pictures.
    pub fn pictures(&self) -> usize {
        self.0.iter().map(|(_, cameras)| cameras.len()).sum()
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.0.len()
    }
}

/// Shows the Gaussians `ids` to every camera of `sample` and gives what the workers gathered, at most one per
/// thread, in no order: fold them by what does not depend on it.
///
/// Memory per Gaussian: its reader; the columns `want` for a block and for each frame of a batch (frames
/// with 4 × threads pictures between them); what a worker holds.
pub(super) fn look<W: Send>(
    source: &dyn FrameSource,
    ids: Ids<'_>,
    want: Columns,
    sample: &Sample<'_>,
    stage: &'static str,
    new_worker: impl Fn() -> W + Sync,
    picture: impl Fn(&mut W, &Gaussians, &Camera) + Sync,
) -> Result<Vec<W>> {
    let info = source.info();
    let count = ids.len();
    let degree = if want.contains(Columns::SH) { info.sh_degree } else { 0 };
    let progress = Progress::new(stage, "pictures", sample.pictures() as u64);
    let mut blocks: Vec<(Box<dyn BlockReader + '_>, Gaussians)> = (0..count.div_ceil(BLOCK))
        .into_par_iter()
        .map(|block| {
            let rows = block * BLOCK..count.min((block + 1) * BLOCK);
            let state = Gaussians::zeros(rows.len(), degree);
            let ids = match &ids {
                Ids::Range(range) => Ids::Range(range.start + rows.start..range.start + rows.end),
                Ids::List(list) => Ids::List(&list[rows]),
            };
            Ok((source.open(ids)?, state))
        })
        .collect::<Result<_>>()?;

    // One per thread at most: a picture runs on the thread that took its worker.
    let workers: Mutex<Vec<W>> = Mutex::default();
    let mut states: Vec<Gaussians> = Vec::new();
    for batch in batches(&sample.0, PICTURES_PER_THREAD * rayon::current_num_threads()) {
        for (slot, &(frame, _)) in batch.iter().enumerate() {
            let want = if slot < states.len() { info.varying & want } else { want };
            if slot == states.len() {
                states.push(Gaussians::zeros(count, degree));
            }
            read_frame(&mut blocks, frame, want, &mut states[slot])?;
        }
        let jobs: Vec<(&Gaussians, &Camera)> = batch
            .iter()
            .zip(&states)
            .flat_map(|((_, cameras), state)| cameras.iter().map(move |&camera| (state, camera)))
            .collect();
        jobs.par_iter().with_max_len(1).for_each(|(state, camera)| {
            let free = workers.lock().unwrap_or_else(PoisonError::into_inner).pop();
            let mut worker = free.unwrap_or_else(&new_worker);
            picture(&mut worker, state, camera);
            workers.lock().unwrap_or_else(PoisonError::into_inner).push(worker);
            progress.advance(1);
        });
    }
    Ok(workers.into_inner().unwrap_or_else(PoisonError::into_inner))
}

/// Runs of frames with at least `pictures` pictures between them, the last one perhaps fewer.
fn batches<T>(mut frames: &[(usize, Vec<T>)], pictures: usize) -> impl Iterator<Item = &[(usize, Vec<T>)]> {
    std::iter::from_fn(move || {
        let mut held = 0;
        let enough = frames.iter().position(|(_, cameras)| {
            held += cameras.len();
            held >= pictures
        });
        let (batch, rest) = frames.split_at(enough.map_or(frames.len(), |last| last + 1));
        frames = rest;
        (!batch.is_empty()).then_some(batch)
    })
}

/// Reads the columns `want` of all blocks at `frame` into `state`.
fn read_frame(
    blocks: &mut [(Box<dyn BlockReader + '_>, Gaussians)],
    frame: usize,
    want: Columns,
    state: &mut Gaussians,
) -> Result<()> {
    if want.is_empty() {
        return Ok(());
    }
    blocks.par_iter_mut().try_for_each(|(reader, block)| reader.read(frame, want, block))?;
    for column in want.iter() {
        let target = state.column_mut(column);
        for c in 0..target.width() {
            for (to, (_, block)) in target.plane_mut(c).chunks_mut(BLOCK).zip(&*blocks) {
                to.copy_from_slice(block.column(column).plane(c));
            }
        }
    }
    Ok::<_, Error>(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `frames` frames of `views` pictures.
    fn schedule(frames: usize, views: u32) -> Schedule {
        let camera = Camera::look_at(glam::DVec3::X, glam::DVec3::ZERO, 1.0, (8, 8));
        let of_frame: Vec<(u32, u32)> = (0..views).map(|view| (view, view)).collect();
        Schedule { cameras: vec![camera; views as usize], frames: vec![of_frame; frames] }
    }

    #[test]
    fn a_bounded_sample_spreads_over_frames_and_views_and_takes_all_of_a_few() {
        for (frames, views, pictures, expected) in [
            (60, 13, 96, (30, 70..=96)),
            (600, 1, 96, (86, 86..=96)),
            (1, 12, 96, (1, 12..=12)),
            (1, 400, 96, (1, 80..=96)),
        ] {
            let schedule = schedule(frames, views);
            let sample = Sample::at_most(&schedule, pictures);
            assert_eq!(sample.frames(), expected.0, "{frames} frames of {views} views");
            assert!(expected.1.contains(&sample.pictures()), "{frames}, {views}: {} pictures", sample.pictures());
        }
    }

    #[test]
    fn a_bounded_sample_of_nothing_is_nothing() {
        let none = schedule(3, 0);
        assert_eq!(Sample::at_most(&none, 96).pictures(), 0);
    }
}
