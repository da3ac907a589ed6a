//! Selection of the views of a schedule (list of the views at each frame) that a pass renders.

use std::num::NonZeroU32;

use crate::model::{FrameView, ViewSchedule};
use crate::recipe;
use crate::render::GridStrides;

/// Number of views that a selection of few views takes from each frame that it uses; more only if there are too few
/// frames. Reading a frame takes long, so it is better to render several of its views and to read fewer frames.
pub const VIEWS_PER_FRAME: usize = 3;

/// Maximum stride at which the pixels of a view are rendered (every stride-th pixel in each direction). Beyond this
/// stride, the work per Gaussian dominates the time of a render.
const MAX_PIXEL_STRIDE: NonZeroU32 = NonZeroU32::new(4).unwrap();

/// Returns the strides of a grid that holds at least `target_pixels` of the `pixels` pixels of a view, but at least 1/16
/// of them. The stride along rows is that along columns or one more.
pub fn grid_strides(pixels: u64, target_pixels: f64) -> GridStrides {
    let along_columns = pixel_stride(pixels, target_pixels);
    let ratio = pixels as f64 / target_pixels.max(1.0);
    let along_rows = NonZeroU32::new((ratio / f64::from(along_columns.get())) as u32).unwrap_or(NonZeroU32::MIN);
    [along_rows.min(along_columns.saturating_add(1)).min(MAX_PIXEL_STRIDE), along_columns]
}

/// Returns the stride n, from 1 to 4, such that every n-th pixel of a view in each direction gives about
/// `target_pixels` pixels. `pixels`: number of all pixels of the view. The stride is rounded down.
pub fn pixel_stride(pixels: u64, target_pixels: f64) -> NonZeroU32 {
    let stride = (pixels as f64 / target_pixels.max(1.0)).sqrt();
    NonZeroU32::new(stride as u32).map_or(NonZeroU32::MIN, |stride| stride.min(MAX_PIXEL_STRIDE))
}

/// Sampler of every n-th frame and of every m-th view in such a frame, for frames that arrive one by one.
#[derive(Debug, Clone)]
pub struct ViewSampler {
    frame_stride: usize,
    view_stride: usize,
    /// Number of frames so far that had at least one view.
    frames_with_views: usize,
}

impl ViewSampler {
    /// Creates a sampler with the strides `frame_stride` and `view_stride` of `scan`:
    /// - Frames without views are not counted. Of the others, the first is selected, and then every `frame_stride`-th.
    /// - In a selected frame, every `view_stride`-th view is selected. The first view is one further in each selected
    ///   frame (modulo `view_stride`), so that all views are selected in turn.
    pub fn new(scan: &recipe::ScanParams) -> Self {
        Self::with_strides(scan.frame_stride.get() as usize, scan.view_stride.get() as usize)
    }

    fn with_strides(frame_stride: usize, view_stride: usize) -> Self {
        ViewSampler { frame_stride, view_stride, frames_with_views: 0 }
    }

    /// Returns the selected views of the next frame. `frame` is its number; `views` lists its views as (view number,
    /// camera index).
    pub fn views_of_next_frame<'a>(
        &mut self,
        frame: usize,
        views: &'a [(u32, u32)],
    ) -> impl Iterator<Item = FrameView> + use<'a> {
        let first_view = self.frames_with_views / self.frame_stride;
        let is_taken = self.frames_with_views.is_multiple_of(self.frame_stride);
        self.frames_with_views += usize::from(!views.is_empty());
        let views = if is_taken { views } else { &[] };
        let taken = views.iter().skip(first_view % self.view_stride).step_by(self.view_stride);
        taken.map(move |&(view, camera)| FrameView { frame, view, camera })
    }

    /// Returns a schedule with only those views of `schedule` that this sampler selects.
    fn thin(mut self, schedule: &ViewSchedule) -> ViewSchedule {
        let mut left = ViewSchedule::default();
        for (frame, views) in schedule.iter().enumerate() {
            let taken: Vec<(u32, u32)> =
                self.views_of_next_frame(frame, views).map(|view| (view.view, view.camera)).collect();
            left.push_frames(1, &taken);
        }
        left
    }
}

/// Returns the views of `schedule` that a scoring pass with the parameters `scan` renders.
///
/// A [`ViewSampler`] selects views by the strides of `scan`. If they are more than the maximum
/// [`recipe::ScanParams::scoring_views`] (0: no maximum), [`select_evenly_over_frames`] selects this many of them, from
/// at least `frames` frames if possible.
pub fn scoring_views(schedule: &ViewSchedule, scan: &recipe::ScanParams, frames: usize) -> Vec<FrameView> {
    let left = ViewSampler::new(scan).thin(schedule);
    if scan.scoring_views == 0 || left.pair_count() <= scan.scoring_views {
        return left.frame_views().collect();
    }
    select_evenly_over_frames(&left, scan.scoring_views, frames, VIEWS_PER_FRAME)
}

/// Returns the minimum number of evenly spaced frames such that at least 99% of the Gaussians are alive (opacity ≥
/// alpha_min) in one of them or more. Gaussians that are never alive are ignored; the others are assumed to be alive
/// without a gap. `life` holds for each Gaussian the number of frames in which it is alive, out of `frames` frames.
pub fn frames_needed_to_see_all(life: &[u32], frames: usize) -> usize {
    let mut lives: Vec<u32> = life.iter().copied().filter(|&life| life > 0).collect();
    if lives.is_empty() {
        return 0;
    }
    let hundredth = lives.len() / 100;
    let (_, &mut shortest, _) = lives.select_nth_unstable(hundredth);
    frames.div_ceil(shortest as usize)
}

/// Selects at most `max_views` views with [`select_evenly`], from at least `frames` frames if possible. Takes
/// `views_per_frame` views of each frame that it uses, or fewer (at least one) if this is necessary to use `frames`
/// frames.
pub fn select_evenly_over_frames(
    schedule: &ViewSchedule,
    max_views: usize,
    frames: usize,
    views_per_frame: usize,
) -> Vec<FrameView> {
    select_evenly(schedule, max_views, (max_views / frames.max(1)).min(views_per_frame))
}

/// Selects at most `max_views` views, spread evenly over all frames and view numbers. Takes up to `views_per_frame`
/// views of each frame that it uses, so that it uses as few frames as possible (see [`VIEWS_PER_FRAME`]). Selects all
/// views if `schedule` has no more than `max_views`.
pub fn select_evenly(schedule: &ViewSchedule, max_views: usize, views_per_frame: usize) -> Vec<FrameView> {
    let seen = schedule.iter().filter(|views| !views.is_empty()).count();
    let view_count = max_views.min(schedule.pair_count());
    let of_frame = schedule.pair_count().div_ceil(seen.max(1)).clamp(1, views_per_frame.max(1));
    let count = seen.min(view_count.div_ceil(of_frame));
    let mut selected = Vec::with_capacity(view_count);
    let mut frames = schedule.iter().enumerate().filter(|(_, views)| !views.is_empty()).enumerate();
    for k in 0..count {
        let wanted = (2 * k + 1) * seen / (2 * count);
        let Some((_, (frame, views))) = frames.find(|&(place, _)| place == wanted) else { break };
        let wanted = (view_count * (k + 1) / count - view_count * k / count).min(views.len());
        // Starts at the view after the last one taken of the previous frame, so that all views are used in turn.
        let first = selected.len();
        let mut places: Vec<usize> = (0..wanted).map(|j| (first + j * views.len() / wanted) % views.len()).collect();
        places.sort_unstable();
        selected.extend(places.into_iter().map(|place| FrameView {
            frame,
            view: views[place].0,
            camera: views[place].1,
        }));
    }
    selected
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Camera;

    /// Returns a schedule of `frames` frames with `views` views each.
    fn schedule(frames: usize, views: u32) -> ViewSchedule {
        let camera = Camera::look_at(glam::DVec3::X, glam::DVec3::ZERO, 1.0, (8, 8));
        let of_frame: Vec<(u32, u32)> = (0..views).map(|view| (view, view)).collect();
        let mut schedule = ViewSchedule::new(vec![camera; views as usize]);
        schedule.push_frames(frames, &of_frame);
        schedule
    }

    fn frames(views: &[FrameView]) -> usize {
        views.chunk_by(|a, b| a.frame == b.frame).count()
    }

    #[test]
    fn views_spread_over_frames_and_view_numbers() {
        for (frame_count, views, max_views, at_once, expected) in [
            (60, 13, 96, 3, (32, 96)),
            (60, 12, 24, 1, (24, 24)),
            (25, 1, 24, 1, (24, 24)),
            (600, 1, 96, 3, (96, 96)),
            (1, 12, 96, 3, (1, 12)),
            (1, 400, 96, 3, (1, 96)),
            (7, 5, usize::MAX, 3, (7, 35)),
        ] {
            let selected = select_evenly(&schedule(frame_count, views), max_views, at_once);
            assert_eq!(frames(&selected), expected.0, "{frame_count} frames of {views} views");
            assert_eq!(selected.len(), expected.1, "{frame_count} frames of {views} views");
            let order = |view: &FrameView| (view.frame, view.view);
            assert!(
                selected.windows(2).all(|pair| order(&pair[0]) < order(&pair[1])),
                "{frame_count} frames of {views} views"
            );
            let mut seen: Vec<u32> = selected.iter().map(|view| view.view).collect();
            seen.sort_unstable();
            seen.dedup();
            assert_eq!(
                seen.len(),
                selected.len().min(views as usize),
                "{frame_count} frames: views that are seen of {views}"
            );
        }
    }

    #[test]
    fn frames_lie_in_the_middle_of_equal_parts() {
        // Every third frame has no views.
        let mut gaps = ViewSchedule::default();
        (0..50).for_each(|frame| gaps.push_frames(1, if frame % 3 == 0 { &[] } else { &[(0, 0), (1, 1)] }));
        let seen: Vec<usize> = (0..50).filter(|frame| frame % 3 > 0).collect();
        for count in [1, 2, 7, 16, 32, 33, 40] {
            let selected: Vec<usize> = select_evenly(&gaps, count, 1).iter().map(|view| view.frame).collect();
            let parts = count.min(seen.len());
            let expected = (0..parts).map(|k| seen[(2 * k + 1) * seen.len() / (2 * parts)]);
            let mut frames = selected.clone();
            frames.dedup();
            assert_eq!(frames, expected.collect::<Vec<_>>(), "{count} views");
            assert_eq!(selected.len(), count);
        }
    }

    #[test]
    fn short_life_spans_spread_views_over_more_frames() {
        // Of the 300 Gaussians that are ever alive, three are alive for at most 5 frames and the others for at least
        // 12. One more is never alive.
        let life: Vec<u32> = [0, 1, 5, 5].into_iter().chain((0..297).map(|k| 12 + k)).collect();
        assert_eq!(
            (
                frames_needed_to_see_all(&life, 300),
                frames_needed_to_see_all(&[0, 0], 300),
                frames_needed_to_see_all(&[300], 300)
            ),
            (25, 0, 1)
        );
        let frame_count = |frames_at_least: usize| {
            frames(&select_evenly_over_frames(&schedule(300, 18), 48, frames_at_least, VIEWS_PER_FRAME))
        };
        assert_eq!([0, 1, 16, 17, 24, 25, 48, 300].map(frame_count), [16, 16, 16, 24, 24, 48, 48, 48]);
        // A Gaussian that is alive as long as 99% of the Gaussians are is alive in one of these frames.
        let seen: Vec<usize> = select_evenly_over_frames(&schedule(300, 18), 48, 25, VIEWS_PER_FRAME)
            .iter()
            .map(|view| view.frame)
            .collect();
        assert!((0..=288).all(|birth| seen.iter().any(|frame| (birth..birth + 12).contains(frame))));
    }

    #[test]
    fn selection_is_strided_then_limited() {
        let taken = |most: usize, view_stride: u32| {
            let view_stride = std::num::NonZeroU32::new(view_stride).unwrap();
            let scan = recipe::ScanParams {
                scoring_views: most,
                view_stride,
                ..recipe::Recipe::preset("paper").unwrap().scan
            };
            scoring_views(&schedule(60, 12), &scan, 1)
        };
        assert_eq!(
            [(0, 1), (0, 4), (180, 4), (100, 1), (100, 4)].map(|(most, stride)| taken(most, stride).len()),
            [720, 180, 180, 100, 100]
        );
        let strided = taken(0, 4);
        assert!(taken(100, 4).iter().all(|view| strided.contains(view)));
    }

    #[test]
    fn empty_schedules_and_zero_views_select_nothing() {
        assert!(select_evenly(&schedule(3, 0), 96, 3).is_empty() && select_evenly(&schedule(3, 2), 0, 3).is_empty());
    }
}
