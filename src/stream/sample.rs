//! Which pictures of a schedule are looked at.

use crate::model::{Picture, Schedule};
use crate::recipe;

/// Views of a frame that are worth reading it for.
pub const VIEWS_AT_ONCE: usize = 3;

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

    /// Pictures to look at of the next frame, which is `frame` and has those at `views` (view number, camera).
    pub fn next<'a>(&mut self, frame: usize, views: &'a [(u32, u32)]) -> impl Iterator<Item = Picture> + use<'a> {
        let turn = self.with_pictures / self.frame_stride;
        let is_taken = self.with_pictures.is_multiple_of(self.frame_stride);
        self.with_pictures += usize::from(!views.is_empty());
        let views = if is_taken { views } else { &[] };
        let taken = views.iter().skip(turn % self.view_stride).step_by(self.view_stride);
        taken.map(move |&(view, camera)| Picture { frame, view, camera })
    }

    fn all(mut self, schedule: &Schedule) -> Vec<Picture> {
        schedule.frames.iter().enumerate().flat_map(|(frame, views)| self.next(frame, views)).collect()
    }
}

/// The pictures that the strides of `scan` leave of `schedule`, see [`Sampler`].
pub fn strided(schedule: &Schedule, scan: &recipe::Scan) -> Vec<Picture> {
    Sampler::new(scan).all(schedule)
}

/// At most `pictures` pictures, spread evenly over all frames and views, of no more frames than it takes to have
/// `views` of each (see [`VIEWS_AT_ONCE`]); all there are, if they are no more.
pub fn spread(schedule: &Schedule, pictures: usize, views: usize) -> Vec<Picture> {
    let seen: Vec<usize> = (0..schedule.frames.len()).filter(|&frame| !schedule.frames[frame].is_empty()).collect();
    let pictures = pictures.min(schedule.pairs());
    let of_frame = schedule.pairs().div_ceil(seen.len().max(1)).clamp(1, views.max(1));
    let count = seen.len().min(pictures.div_ceil(of_frame));
    let mut found = Vec::with_capacity(pictures);
    for k in 0..count {
        let frame = seen[(2 * k + 1) * seen.len() / (2 * count)];
        let views = &schedule.frames[frame];
        let wanted = (pictures * (k + 1) / count - pictures * k / count).min(views.len());
        // From the view after the last one of the frame before, so that all take their turns.
        let first = found.len();
        let mut places: Vec<usize> = (0..wanted).map(|j| (first + j * views.len() / wanted) % views.len()).collect();
        places.sort_unstable();
        found.extend(places.into_iter().map(|place| Picture { frame, view: views[place].0, camera: views[place].1 }));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Camera;

    /// `frames` frames of `views` pictures.
    fn schedule(frames: usize, views: u32) -> Schedule {
        let camera = Camera::look_at(glam::DVec3::X, glam::DVec3::ZERO, 1.0, (8, 8));
        let of_frame: Vec<(u32, u32)> = (0..views).map(|view| (view, view)).collect();
        Schedule { cameras: vec![camera; views as usize], frames: vec![of_frame; frames] }
    }

    fn frames(pictures: &[Picture]) -> usize {
        pictures.chunk_by(|a, b| a.frame == b.frame).count()
    }

    #[test]
    fn pictures_spread_over_frames_and_views_and_all_of_a_few_are_taken() {
        for (of, views, pictures, at_once, expected) in [
            (60, 13, 96, 3, (32, 96)),
            (60, 12, 24, 1, (24, 24)),
            (25, 1, 24, 1, (24, 24)),
            (600, 1, 96, 3, (96, 96)),
            (1, 12, 96, 3, (1, 12)),
            (1, 400, 96, 3, (1, 96)),
            (7, 5, usize::MAX, 3, (7, 35)),
        ] {
            let found = spread(&schedule(of, views), pictures, at_once);
            assert_eq!(frames(&found), expected.0, "{of} frames of {views} views");
            assert_eq!(found.len(), expected.1, "{of} frames of {views} views");
            let order = |picture: &Picture| (picture.frame, picture.view);
            assert!(found.windows(2).all(|pair| order(&pair[0]) < order(&pair[1])), "{of} frames of {views} views");
            let mut seen: Vec<u32> = found.iter().map(|picture| picture.view).collect();
            seen.sort_unstable();
            seen.dedup();
            assert_eq!(seen.len(), found.len().min(views as usize), "{of} frames: views that are seen of {views}");
        }
    }

    #[test]
    fn no_pictures_leave_none_to_look_at() {
        assert!(spread(&schedule(3, 0), 96, 3).is_empty() && spread(&schedule(3, 2), 0, 3).is_empty());
    }
}
