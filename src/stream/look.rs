//! Looking at Gaussians through many cameras: a frame is read once, its pictures run on all threads.
//!
//! Frame-major, for occlusion needs all Gaussians of a frame at once: frames are read by blocks on all
//! threads, then the pictures of a batch of frames are shared out among them.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::{Frames, Progress};
use crate::error::Result;
use crate::model::{Camera, Columns, Gaussians, Schedule};
use crate::pass::{BlockReader, FrameSource, Ids, Wanted};
use crate::plan::Limits;
use crate::recipe;

/// Pictures of a batch for each thread: enough that the last ones to finish cost little.
pub const PICTURES_PER_THREAD: usize = 4;

/// Views of a frame that are worth reading it for.
pub const VIEWS_AT_ONCE: usize = 3;

/// Pictures to look at: frames in order, each with the cameras of its pictures, at least one.
#[derive(Debug, Clone)]
pub struct Sample<'a>(pub(super) Vec<(usize, Vec<&'a Camera>)>);

/// Decides frame by frame which pictures are looked at.
#[derive(Debug, Clone)]
pub struct Sampler {
    frame_stride: usize,
    view_stride: usize,
    /// Frames so far that have pictures.
    with_pictures: usize,
}

impl Sampler {
    /// The strides of `scan`: of the frames that have pictures the first and every `frame_stride`-th, of the
    /// pictures of each every `view_stride`-th, from one that moves on from frame to frame, so that all views
    /// take their turns.
    pub fn new(scan: &recipe::Scan) -> Self {
        Self::with_strides(scan.frame_stride.get() as usize, scan.view_stride.get() as usize)
    }

    fn with_strides(frame_stride: usize, view_stride: usize) -> Self {
        Sampler { frame_stride, view_stride, with_pictures: 0 }
    }

    /// Cameras of the pictures of the next frame to look at, of those at `views` (view number, place in
    /// `cameras`).
    pub fn next<'a>(&mut self, views: &[(u32, u32)], cameras: &'a [Camera]) -> Vec<&'a Camera> {
        if views.is_empty() {
            return Vec::new();
        }
        let frame = self.with_pictures;
        self.with_pictures += 1;
        if !frame.is_multiple_of(self.frame_stride) {
            return Vec::new();
        }
        let turn = frame / self.frame_stride;
        let views = views.iter().skip(turn % self.view_stride).step_by(self.view_stride);
        views.map(|&(_, camera)| &cameras[camera as usize]).collect()
    }
}

impl<'a> Sample<'a> {
    /// What the strides of `scan` leave of `schedule`, see [`Sampler`].
    pub fn new(schedule: &'a Schedule, scan: &recipe::Scan) -> Self {
        Self::of(schedule, Sampler::new(scan))
    }

    /// About `pictures` pictures at most, spread over all frames and views, of no more frames than it takes
    /// to have [`VIEWS_AT_ONCE`] views of each, or all there are: reading a frame can cost more than looking
    /// at it once.
    pub fn at_most(schedule: &'a Schedule, pictures: usize) -> Self {
        let frames = schedule.frames.iter().filter(|views| !views.is_empty()).count().max(1);
        let views = schedule.pairs().div_ceil(frames).clamp(1, VIEWS_AT_ONCE);
        let frame_stride = frames.div_ceil(pictures.div_ceil(views).max(1));
        let left = schedule.pairs().div_ceil(frame_stride);
        Self::of(schedule, Sampler::with_strides(frame_stride, left.div_ceil(pictures.max(1)).max(1)))
    }

    fn of(schedule: &'a Schedule, mut sampler: Sampler) -> Self {
        let taken = schedule.frames.iter().map(|views| sampler.next(views, &schedule.cameras)).enumerate();
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

/// Shows the Gaussians `ids` to every camera of `sample` and gives what the workers gathered, in no order: fold
/// them by what does not depend on it. Memory: see [`Looks`].
pub(super) fn look<W: Send>(
    source: &dyn FrameSource,
    ids: Ids<'_>,
    want: Columns,
    sample: &Sample<'_>,
    (stage, limits): (&'static str, Limits),
    new_worker: impl Fn() -> W + Sync,
    picture: impl Fn(&mut W, &Gaussians, &Camera) + Sync,
) -> Result<Vec<W>> {
    let progress = Progress::new(stage, "pictures", sample.pictures() as u64);
    let mut looks = Looks::new(want, limits);
    looks.add(source, ids, &sample.0, new_worker, |worker, state, camera| {
        picture(worker, state, camera);
        progress.advance(1);
    })?;
    Ok(looks.into_workers())
}

/// Workers that have seen some pictures and may see more.
///
/// Memory per Gaussian: its reader; the columns looked at, those that vary once for a block and all for each
/// frame of a batch (frames with 4 × threads pictures between them, no more than [`Limits::frames_together`]);
/// what a worker holds, one per thread but no more than [`Limits::pictures_together`].
pub(super) struct Looks<W> {
    want: Columns,
    limits: Limits,
    /// Those without a picture.
    workers: Mutex<Vec<W>>,
    states: Vec<Gaussians>,
}

impl<W: Send> Looks<W> {
    /// Nothing seen yet, of the columns `want`.
    pub(super) fn new(want: Columns, limits: Limits) -> Self {
        Looks { want, limits, workers: Mutex::default(), states: Vec::new() }
    }

    /// Shows the Gaussians `ids` of `source` at `frames`, each to the cameras of its pictures. Every source that
    /// is added must have the same Gaussians, and the same values in columns that do not vary.
    pub(super) fn add(
        &mut self,
        source: &dyn FrameSource,
        ids: Ids<'_>,
        frames: &[(usize, Vec<&Camera>)],
        new_worker: impl Fn() -> W + Sync,
        picture: impl Fn(&mut W, &Gaussians, &Camera) + Sync,
    ) -> Result<()> {
        if frames.is_empty() {
            return Ok(());
        }
        let wanted = Wanted::of(frames.iter().map(|&(frame, _)| frame)).holding(self.limits.frames_held);
        let mut reader = Frames::open(source, ids, self.want, &wanted)?;
        let threads = rayon::current_num_threads();
        for batch in batches(frames, PICTURES_PER_THREAD * threads, self.limits.frames_together) {
            for (slot, &(frame, _)) in batch.iter().enumerate() {
                let want = if slot < self.states.len() { source.info().varying } else { self.want };
                if slot == self.states.len() {
                    self.states.push(reader.state());
                }
                reader.read(frame, want, &mut self.states[slot])?;
            }
            let jobs: Vec<(&Gaussians, &Camera)> = batch
                .iter()
                .zip(&self.states)
                .flat_map(|((_, cameras), state)| cameras.iter().map(move |&camera| (state, camera)))
                .collect();
            let next = AtomicUsize::new(0);
            let workers = threads.min(self.limits.pictures_together);
            (0..workers.min(jobs.len())).into_par_iter().with_max_len(1).for_each(|_| {
                let free = self.workers.lock().unwrap_or_else(PoisonError::into_inner).pop();
                let mut worker = free.unwrap_or_else(&new_worker);
                while let Some((state, camera)) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
                    picture(&mut worker, state, camera);
                }
                self.workers.lock().unwrap_or_else(PoisonError::into_inner).push(worker);
            });
        }
        Ok(())
    }

    /// The workers, in no order.
    pub(super) fn into_workers(self) -> Vec<W> {
        self.workers.into_inner().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Runs of frames with at least `pictures` pictures between them, or of `most` frames; the last one perhaps of
/// fewer.
fn batches<T>(
    mut frames: &[(usize, Vec<T>)],
    pictures: usize,
    most: usize,
) -> impl Iterator<Item = &[(usize, Vec<T>)]> {
    std::iter::from_fn(move || {
        let mut held = 0;
        let enough = frames.iter().position(|(_, cameras)| {
            held += cameras.len();
            held >= pictures
        });
        let (batch, rest) = frames.split_at(enough.map_or(frames.len(), |last| last + 1).min(most));
        frames = rest;
        (!batch.is_empty()).then_some(batch)
    })
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
