//! Selection of views (frame and camera) to render, of their background, and an estimate of the memory for rendering.

use rayon::prelude::*;

use super::Scene;
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::memory_plan::{RENDER_COST, ResourceEstimate, SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload};
use crate::metrics::PSNR_CAP_DB;
use crate::model::{Attributes, FrameView, Rig, Split};
use crate::passes::{BatchLimits, RenderableView, RenderedSource, for_each_view_batch};
use crate::render;

/// Selection among the views of a camera rig.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ViewSet {
    /// Views that were not used for training: the test views if there are any, else the validation views, else all
    /// views.
    #[default]
    HeldOut,
    /// Views of one split (training, validation or test), of which there must be at least one.
    Split(Split),
    /// Every view of the rig.
    All,
}

/// Returns the views of `rig` that `part` selects, ordered by frame, then view number. `frame_times` holds the times of
/// the frames.
///
/// # Errors
/// Fails if a view has a time that is not the time of any frame, if the split has no views, or if two cameras have the
/// same frame and view number, which happens only if each split numbers its views on its own.
pub fn select_views(rig: &Rig, frame_times: &[f64], part: ViewSet) -> Result<Vec<FrameView>> {
    let found = distinct_views(rig, rig.schedule(frame_times, part.split(rig))?.frame_views())?;
    if found.is_empty() {
        return Err(no_view_error(rig));
    }
    Ok(found)
}

/// Returns `views`, which are views of `rig`, ordered by frame, then view number, and each of them once.
///
/// # Errors
/// Fails if two cameras have the same frame and view number.
pub(crate) fn distinct_views(rig: &Rig, views: impl Iterator<Item = FrameView>) -> Result<Vec<FrameView>> {
    let mut found: Vec<FrameView> = views.collect();
    found.sort_by_key(|view| (view.frame, view.view));
    // The files of training and test cameras may both list the same view.
    found.dedup();
    match found.windows(2).find(|pair| (pair[0].frame, pair[0].view) == (pair[1].frame, pair[1].view)) {
        None => Ok(found),
        Some(pair) => {
            let hint = match &splits_with_views(rig)[..] {
                [] | [_] => "correct the camera file: a view number may occur only once per frame".to_owned(),
                splits => format!("choose one part with --split {}", splits.join(" or --split ")),
            };
            let FrameView { frame, view, .. } = pair[0];
            Err(Error::usage(format!("{}: two cameras are view {view} at frame {frame}\n  {hint}", rig.origin)))
        }
    }
}

/// Returns the names of the splits (training, validation, test) that have views in `rig`.
fn splits_with_views(rig: &Rig) -> Vec<&'static str> {
    let has_views = |split: &Split| rig.views.iter().any(|rig_view| rig_view.split == *split);
    [Split::Train, Split::Val, Split::Test].into_iter().filter(has_views).map(Split::name).collect()
}

/// Number of views that [`blind_views_note`] renders before it decides whether to render more.
const CHECKED_VIEWS: usize = 16;

/// Returns a warning for the user if no Gaussian of `scene` is visible in any of the measured `views`, so that renders
/// of them show only the background color `background`. Renders nothing unless `psnr`, the mean PSNR of the views in
/// dB, is that of equal images.
///
/// # Errors
/// Fails if a frame cannot be read.
pub fn blind_views_note(
    scene: &Scene,
    views: &[FrameView],
    background: [f32; 3],
    psnr: f64,
) -> Result<Option<&'static str>> {
    let mut is_blind = psnr >= PSNR_CAP_DB;
    for views in views.chunks(CHECKED_VIEWS) {
        if !is_blind {
            return Ok(None);
        }
        let subject = [RenderedSource::all_gaussians(scene.source())];
        for_each_view_batch(subject, &scene.rig.cameras, views, BatchLimits::one_frame(&scene.limits), |batch| {
            is_blind &= batch.par_iter().all(|view: &RenderableView<'_, 1>| {
                view.render(0, background).data.chunks_exact(3).all(|pixel| pixel == background)
            });
            Ok(())
        })?;
    }
    Ok(is_blind.then_some(
        "the measured views show none of the Gaussians, only the background, so their PSNR means nothing; give the \
         cameras of this scene",
    ))
}

/// Returns the error that the chosen split has no views. It names the splits of `rig` that have some.
pub fn no_view_error(rig: &Rig) -> Error {
    let available = splits_with_views(rig);
    Error::usage(format!(
        "{}: the cameras have no views in this split\n  they have views of {}; use --split {} or --split all",
        rig.origin,
        available.join(" and "),
        available.first().unwrap_or(&"all")
    ))
}

/// Returns the view with the number `view` at frame `frame`, among the views of `rig` that `part` selects.
/// `frame_times` holds the times of the frames.
///
/// # Errors
/// Fails as [`select_views`] does, and if the sequence has no such frame or the frame has no such view number.
pub fn select_view(rig: &Rig, frame_times: &[f64], part: ViewSet, frame: usize, view: u32) -> Result<FrameView> {
    if frame >= frame_times.len() {
        let last = frame_times.len().saturating_sub(1);
        return Err(Error::usage(format!("--frame {frame}: expected 0 to {last}, the frames of this sequence")));
    }
    let here: Vec<FrameView> =
        select_views(rig, frame_times, part)?.into_iter().filter(|frame_view| frame_view.frame == frame).collect();
    here.iter().find(|frame_view| frame_view.view == view).copied().ok_or_else(|| {
        let views: Vec<String> = here.iter().map(|frame_view| frame_view.view.to_string()).collect();
        let views = if views.is_empty() { "none".to_owned() } else { views.join(", ") };
        Error::usage(format!("--view {view}: expected a view of frame {frame}, which are {views} ({})", rig.origin))
    })
}

/// Returns the views in `views` at `count` evenly spaced frames, which include the first and the last. Returns all
/// views if they have at most `count` frames; a `count` of 0 counts as 1. Of K frames, those with the indices
/// round(i·(K − 1)/(count − 1)), halves to even, are chosen, as by numpy's `round(linspace(0, K − 1, count))`.
pub fn select_frames(views: Vec<FrameView>, count: usize) -> Vec<FrameView> {
    let count = count.max(1);
    let mut frames: Vec<usize> = views.iter().map(|view| view.frame).collect();
    frames.dedup();
    if count >= frames.len() {
        return views;
    }
    let step = (frames.len() - 1) as f64 / (count - 1).max(1) as f64;
    // As `count` is less than the number of frames, steps exceed 1 and no frame is taken twice.
    let kept: Vec<usize> = (0..count).map(|i| frames[(i as f64 * step).round_ties_even() as usize]).collect();
    views.into_iter().filter(|view| kept.binary_search(&view.frame).is_ok()).collect()
}

/// Returns at most `most` of `views`, spread evenly over frames and view numbers. `views` must be sorted by frame, then
/// view.
///
/// The views are picked at equal distances from a list of all views, ordered by frame. In this list, the m views of the
/// n-th frame are rotated cyclically by m · frac(n · φ) places, where φ is the golden ratio and frac the fractional
/// part. Without this rotation, the same view numbers would be picked again and again.
pub fn spread_views(views: Vec<FrameView>, most: usize) -> Vec<FrameView> {
    let (count, most) = (views.len(), most.max(1));
    if count <= most {
        return views;
    }
    let mut rotated = Vec::with_capacity(count);
    for (number, frame) in views.chunk_by(|a, b| a.frame == b.frame).enumerate() {
        let turn = (number as f64 * GOLDEN_RATIO).fract() * frame.len() as f64;
        let (head, tail) = frame.split_at((turn as usize).min(frame.len() - 1));
        rotated.extend_from_slice(tail);
        rotated.extend_from_slice(head);
    }
    // Takes the middle view of each of `most` equal parts of the list.
    let mut spread: Vec<FrameView> = (0..most).map(|k| rotated[(2 * k + 1) * count / (2 * most)]).collect();
    spread.sort_by_key(|view| (view.frame, view.view));
    spread
}

/// Golden ratio. Its multiples are spread evenly modulo 1.
const GOLDEN_RATIO: f64 = 1.618_033_988_749_895;

/// Returns the background color for renders: `requested`, the color that the user gave, or else that of the scene.
///
/// # Errors
/// Fails if a component of the color is not from 0 to 1.
pub fn render_background(requested: Option<[f32; 3]>, scene: &Scene) -> Result<[f32; 3]> {
    match requested {
        Some(rgb) if rgb.iter().any(|c| !(0.0..=1.0).contains(c)) => {
            Err(Error::usage(format!("--background: expected red, green, blue from 0 to 1, found {rgb:?}")))
        }
        requested => Ok(requested.unwrap_or(scene.background)),
    }
}

/// Returns the resource estimate (memory, time, reads) of the stage `stage`, which renders all views of `models` models
/// and keeps `pixel` bytes per pixel in memory for each view being rendered.
pub fn render_estimate(
    work: &Workload,
    limits: &Limits,
    stage: &'static str,
    models: u64,
    pixel: u64,
) -> ResourceEstimate {
    let views_together = work.threads.min(limits.views_together as u64);
    ResourceEstimate {
        stage,
        reads: models as f64,
        seconds: models as f64
            * (work.reading_seconds(work.gaussian_count(), work.frames as f64)
                + work.render_seconds(work.frame_views as f64, work.gaussian_count(), RENDER_COST)),
        per_gaussian: vec![
            ("states", models * work.state_bytes(Attributes::all())),
            ("readers", models * work.input.reader),
            ("kept frames", models * work.kept_frames_bytes(limits, Attributes::all())),
            ("views", views_together * SHARED_VIEW_BYTES_PER_GAUSSIAN),
        ],
        fixed: vec![
            work.block_buffer_memory(),
            ("views", views_together * (render::STRIP_BYTES as u64 + pixel * work.pixels)),
            Workload::view_list_memory(work.frame_views as f64),
        ],
    }
}

impl ViewSet {
    /// Returns the split of `rig` whose views this selection uses; `None`: the views of all splits.
    pub fn split(self, rig: &Rig) -> Option<Split> {
        match self {
            ViewSet::HeldOut => rig.held_out_split(),
            ViewSet::Split(split) => Some(split),
            ViewSet::All => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::model::{Camera, RigView};

    /// Returns a rig with the views `rig_views`. Each is a tuple of view number, camera index, time and split.
    fn rig(rig_views: &[(u32, u32, Option<f64>, Split)]) -> Rig {
        let camera = |k: u32| Camera::look_at(DVec3::new(f64::from(k), -5.0, 1.0), DVec3::ZERO, 1.0, (8, 8));
        let rig_view = |&(view, camera, time, split)| RigView { view, camera, time, split, image: None };
        Rig {
            cameras: (0..4).map(camera).collect(),
            views: rig_views.iter().map(rig_view).collect(),
            background: None,
            origin: "test.json".into(),
        }
    }

    fn pairs(views: &[FrameView]) -> Vec<(usize, u32)> {
        views.iter().map(|view| (view.frame, view.view)).collect()
    }

    #[test]
    fn spread_views_cover_frames_and_views() {
        let view_at = |k: usize| FrameView { frame: k / 9, view: (k % 9) as u32, camera: 0 };
        let all: Vec<FrameView> = (0..180).map(view_at).collect();
        assert_eq!(spread_views(all.clone(), 180), all);
        let some = spread_views(all, 60);
        assert_eq!(some.len(), 60);
        assert!(some.windows(2).all(|pair| (pair[0].frame, pair[0].view) < (pair[1].frame, pair[1].view)));
        for value in 0..20 {
            assert_eq!(some.iter().filter(|view| view.frame == value).count(), 3, "frame {value}");
        }
        for view in 0..9 {
            let count = some.iter().filter(|frame_view| frame_view.view == view).count();
            assert!((3..=11).contains(&count), "view {view}: {count} of 60");
        }
    }

    #[test]
    fn views_are_in_the_order_of_frame_then_view_number() {
        let rig = rig(&[
            (2, 0, Some(1.0), Split::Test),
            (7, 1, None, Split::Test),
            (1, 2, Some(0.0), Split::Test),
            (5, 3, Some(0.5), Split::Train),
        ]);
        let times = [0.0, 0.5, 1.0];
        assert_eq!(
            pairs(&select_views(&rig, &times, ViewSet::HeldOut).unwrap()),
            [(0, 1), (0, 7), (1, 7), (2, 2), (2, 7)]
        );
        assert_eq!(pairs(&select_views(&rig, &times, ViewSet::Split(Split::Train)).unwrap()), [(1, 5)]);
        assert_eq!(select_views(&rig, &times, ViewSet::All).unwrap().len(), 6);
        assert_eq!(pairs(&[select_view(&rig, &times, ViewSet::All, 1, 5).unwrap()]), [(1, 5)]);
    }

    #[test]
    fn all_views_are_used_if_none_are_held_out() {
        let rig = rig(&[(0, 0, None, Split::Train)]);
        assert_eq!(pairs(&select_views(&rig, &[0.0, 1.0], ViewSet::HeldOut).unwrap()), [(0, 0), (1, 0)]);
        let message = select_views(&rig, &[0.0], ViewSet::Split(Split::Test)).unwrap_err().to_string();
        assert!(message.contains("--split"), "{message}");
    }

    #[test]
    fn equal_views_are_merged_and_conflicting_ones_refused() {
        let same = rig(&[(3, 1, Some(0.0), Split::Train), (3, 1, Some(0.0), Split::Test)]);
        assert_eq!(pairs(&select_views(&same, &[0.0], ViewSet::All).unwrap()), [(0, 3)]);
        let two = rig(&[(3, 1, Some(0.0), Split::Train), (3, 2, Some(0.0), Split::Test)]);
        let message = select_views(&two, &[0.0], ViewSet::All).unwrap_err().to_string();
        assert!(
            message.contains("view 3 at frame 0") && message.contains("--split train or --split test"),
            "{message}"
        );
        let in_one_split = rig(&[(3, 1, Some(0.0), Split::Train), (3, 2, Some(0.0), Split::Train)]);
        let message = select_views(&in_one_split, &[0.0], ViewSet::All).unwrap_err().to_string();
        assert!(message.contains("correct the camera file") && !message.contains("--split"), "{message}");
    }

    #[test]
    fn thinned_frames_equal_numpy_linspace() {
        let every = |frames: usize| -> Vec<FrameView> {
            (0..frames).map(|frame| FrameView { frame: 3 * frame, view: 0, camera: 0 }).collect()
        };
        let kept =
            |frames, count| pairs(&select_frames(every(frames), count)).iter().map(|p| p.0 / 3).collect::<Vec<_>>();
        // Values of np.round(np.linspace(0, 59, 15)) and np.round(np.linspace(0, 9, 3)), where 4.5 rounds to 4.
        assert_eq!(kept(60, 15), [0, 4, 8, 13, 17, 21, 25, 30, 34, 38, 42, 46, 51, 55, 59]);
        assert_eq!(kept(10, 3), [0, 4, 9]);
        assert_eq!(kept(10, 1), [0]);
        assert_eq!(kept(10, 0), [0]);
        assert_eq!(kept(3, 3), [0, 1, 2]);
        assert_eq!(kept(3, 99), [0, 1, 2]);
    }
}
