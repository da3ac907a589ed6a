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
    pub fn new(scan: &recipe::ScanParams) -> Self {
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

    /// What is left of `schedule`.
    fn thin(mut self, schedule: &Schedule) -> Schedule {
        let mut left = Schedule::default();
        for (frame, views) in schedule.iter().enumerate() {
            let taken: Vec<(u32, u32)> =
                self.next(frame, views).map(|picture| (picture.view, picture.camera)).collect();
            left.push(1, &taken);
        }
        left
    }
}

/// The pictures of `schedule` that `scan` looks at: those that its strides leave (see [`Sampler`]), or as many of these as it
/// looks at most, spread over `frames` frames or more, see [`spread_over`].
pub fn looked_at(schedule: &Schedule, scan: &recipe::ScanParams, frames: usize) -> Vec<Picture> {
    let left = Sampler::new(scan).thin(schedule);
    if scan.look_pictures == 0 || left.pairs() <= scan.look_pictures {
        let of_frame = |(frame, views): (usize, &[(u32, u32)])| -> Vec<Picture> {
            views.iter().map(|&(view, camera)| Picture { frame, view, camera }).collect()
        };
        return left.iter().enumerate().flat_map(of_frame).collect();
    }
    spread_over(&left, scan.look_pictures, frames)
}

/// How many frames, evenly spaced, it takes for all but a hundredth of those that ever live to live in one of them, if they
/// live without a gap. `life`: in how many of the `frames` frames each lives.
pub fn frames_to_see(life: &[u32], frames: usize) -> usize {
    let mut lives: Vec<u32> = life.iter().copied().filter(|&life| life > 0).collect();
    if lives.is_empty() {
        return 0;
    }
    let hundredth = lives.len() / 100;
    let (_, &mut shortest, _) = lives.select_nth_unstable(hundredth);
    frames.div_ceil(shortest as usize)
}

/// [`spread`] of at most `pictures` pictures over `frames` frames or more, if there are as many pictures, and else over as few
/// frames as [`VIEWS_AT_ONCE`] allows.
pub fn spread_over(schedule: &Schedule, pictures: usize, frames: usize) -> Vec<Picture> {
    spread(schedule, pictures, (pictures / frames.max(1)).clamp(1, VIEWS_AT_ONCE))
}

/// At most `pictures` pictures, spread evenly over all frames and views, of no more frames than it takes to have
/// `views` of each (see [`VIEWS_AT_ONCE`]); all there are, if they are no more.
pub fn spread(schedule: &Schedule, pictures: usize, views: usize) -> Vec<Picture> {
    let seen = schedule.iter().filter(|views| !views.is_empty()).count();
    let pictures = pictures.min(schedule.pairs());
    let of_frame = schedule.pairs().div_ceil(seen.max(1)).clamp(1, views.max(1));
    let count = seen.min(pictures.div_ceil(of_frame));
    let mut found = Vec::with_capacity(pictures);
    let mut frames = schedule.iter().enumerate().filter(|(_, views)| !views.is_empty()).enumerate();
    for k in 0..count {
        let wanted = (2 * k + 1) * seen / (2 * count);
        let Some((_, (frame, views))) = frames.find(|&(place, _)| place == wanted) else { break };
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
        let mut schedule = Schedule::new(vec![camera; views as usize]);
        schedule.push(frames, &of_frame);
        schedule
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
    fn frames_are_those_in_the_middle_of_even_parts_of_the_seen_ones() {
        // Every frame but each third, in which nobody looks.
        let mut gaps = Schedule::default();
        (0..50).for_each(|frame| gaps.push(1, if frame % 3 == 0 { &[] } else { &[(0, 0), (1, 1)] }));
        let seen: Vec<usize> = (0..50).filter(|frame| frame % 3 > 0).collect();
        for count in [1, 2, 7, 16, 32, 33, 40] {
            let found: Vec<usize> = spread(&gaps, count, 1).iter().map(|picture| picture.frame).collect();
            let parts = count.min(seen.len());
            let expected = (0..parts).map(|k| seen[(2 * k + 1) * seen.len() / (2 * parts)]);
            let mut frames = found.clone();
            frames.dedup();
            assert_eq!(frames, expected.collect::<Vec<_>>(), "{count} pictures");
            assert_eq!(found.len(), count);
        }
    }

    #[test]
    fn short_lives_spread_pictures_over_more_frames() {
        // Of 300 Gaussians three live in 5 frames or less, the others in 12 or more; one never does.
        let life: Vec<u32> = [0, 1, 5, 5].into_iter().chain((0..297).map(|k| 12 + k)).collect();
        assert_eq!((frames_to_see(&life, 300), frames_to_see(&[0, 0], 300), frames_to_see(&[300], 300)), (25, 0, 1));
        let of = |frames_at_least: usize| frames(&spread_over(&schedule(300, 18), 48, frames_at_least));
        assert_eq!([0, 1, 16, 17, 24, 25, 48, 300].map(of), [16, 16, 16, 24, 24, 48, 48, 48]);
        // Whoever lives as long as all but a hundredth lives in one of them.
        let seen: Vec<usize> = spread_over(&schedule(300, 18), 48, 25).iter().map(|picture| picture.frame).collect();
        assert!((0..=288).all(|birth| seen.iter().any(|frame| (birth..birth + 12).contains(frame))));
    }

    #[test]
    fn a_look_takes_what_strides_leave_up_to_so_many() {
        let taken = |look_pictures: usize, view_stride: u32| {
            let view_stride = std::num::NonZeroU32::new(view_stride).unwrap();
            let scan =
                recipe::ScanParams { look_pictures, view_stride, ..recipe::Recipe::preset("paper").unwrap().scan };
            looked_at(&schedule(60, 12), &scan, 1)
        };
        assert_eq!(
            [(0, 1), (0, 4), (180, 4), (100, 1), (100, 4)].map(|(most, stride)| taken(most, stride).len()),
            [720, 180, 180, 100, 100]
        );
        let strided = taken(0, 4);
        assert!(taken(100, 4).iter().all(|picture| strided.contains(picture)));
    }

    #[test]
    fn no_pictures_leave_none_to_look_at() {
        assert!(spread(&schedule(3, 0), 96, 3).is_empty() && spread(&schedule(3, 2), 0, 3).is_empty());
    }
}
