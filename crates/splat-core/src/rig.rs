//! Cameras of a data set, and the views (a camera at a time) from which the scene was photographed.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::camera::Camera;
use super::schedule::{FrameView, ViewSchedule};
use crate::error::{Error, Result};

/// Part of a data set that a view belongs to: training, validation or test.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Views with which the model was trained. Compression scores Gaussians with these views.
    Train,
    /// Validation views. Evaluation uses them if there are no test views.
    Val,
    /// Test views, held out of training. Evaluation uses these views.
    Test,
}

impl Split {
    /// Returns the name of the split in options and results: `train`, `val` or `test`.
    pub fn name(self) -> &'static str {
        match self {
            Split::Train => "train",
            Split::Val => "val",
            Split::Test => "test",
        }
    }
}

/// View of the scene: a camera at a time stamp. There may be a photograph of it.
#[derive(Debug, Clone, PartialEq)]
pub struct RigView {
    /// Number of the view in the data set.
    pub view: u32,
    /// Index into [`Rig::cameras`].
    pub camera: u32,
    /// Time stamp of the view. `None` if the camera sees the scene at every frame.
    pub time: Option<f64>,
    /// Part of the data set that the view belongs to.
    pub split: Split,
    /// Path of the photograph, if the camera file names one.
    pub image: Option<PathBuf>,
}

/// Cameras of a data set and all of their views.
#[derive(Debug, Clone, PartialEq)]
pub struct Rig {
    /// Distinct cameras; several views may share one.
    pub cameras: Vec<Camera>,
    /// Views of all cameras, in the order of the camera file.
    pub views: Vec<RigView>,
    /// Background color, linear RGB in [0, 1], if the camera file gives one.
    pub background: Option<[f32; 3]>,
    /// Source of the cameras for messages: the path of the camera file, or a description of a virtual rig (cameras that
    /// the program made up).
    pub origin: String,
}

/// Maximum allowed difference between the time of a view and the time of its frame, as a fraction of the time span of
/// the sequence. Large enough for times that were rounded in a file, and small enough to distinguish a million frames.
const TIME_TOLERANCE: f64 = 1e-6;

impl Rig {
    /// Bytes of memory per distinct camera: the camera, its copy in a [`ViewSchedule`], and an entry in a table while
    /// the camera file is read.
    pub const BYTES_PER_CAMERA: u64 = 2 * size_of::<Camera>() as u64 + 16;

    /// Bytes of memory per view, except its camera and the path of its photograph. This is the sum of:
    /// - a [`RigView`];
    /// - 32 bytes for entries in two tables while the camera file is read;
    /// - 3 × 40 bytes for an entry in a [`ViewSchedule`], because a vector that grows needs its old memory and twice as
    ///   much new memory.
    pub const BYTES_PER_VIEW: u64 = size_of::<RigView>() as u64 + 32 + 3 * 40;

    /// Bytes of memory per path of a photograph, in addition to its text: the overhead of the allocator.
    pub const NAME_OVERHEAD_BYTES: u64 = 32;

    /// Returns the bytes of memory that all cameras and views take, including one [`ViewSchedule`] of them.
    pub fn bytes(&self) -> u64 {
        let names = self.views.iter().filter_map(|rig_view| rig_view.image.as_ref());
        let names: u64 = names.map(|image| image.as_os_str().len() as u64 + Rig::NAME_OVERHEAD_BYTES).sum();
        Rig::BYTES_PER_CAMERA * self.cameras.len() as u64 + Rig::BYTES_PER_VIEW * self.views.len() as u64 + names
    }

    /// Returns the distinct times of all views in increasing order. Returns no times if no view has a time.
    ///
    /// Times that differ by at most half the tolerance of [`Rig::schedule`] count as equal, because training and test
    /// views of one moment may have been rounded differently.
    pub fn times(&self) -> Vec<f64> {
        let mut times: Vec<f64> = self.views.iter().filter_map(|rig_view| rig_view.time).collect();
        times.sort_by(f64::total_cmp);
        let near = 0.5 * TIME_TOLERANCE * span(&times);
        times.dedup_by(|later, kept| *later - *kept <= near);
        times
    }

    /// Returns this rig for a scene that does not move: no view has a time, so every camera sees every frame. Of
    /// several views of one camera in one split, the first is kept. If different cameras then have views of the same
    /// number, the views of each camera get the index of the camera as their number.
    pub fn without_times(mut self) -> Rig {
        let mut kept = HashSet::new();
        self.views.retain(|rig_view| kept.insert((rig_view.camera, rig_view.split)));
        let mut camera_of = HashMap::new();
        let is_ambiguous =
            self.views.iter().any(|found| *camera_of.entry(found.view).or_insert(found.camera) != found.camera);
        for rig_view in &mut self.views {
            rig_view.time = None;
            if is_ambiguous {
                rig_view.view = rig_view.camera;
            }
        }
        self
    }

    /// Returns the split of the views that were held out of training: test, or validation if there are no test views.
    /// Returns `None` if all views are training views.
    pub fn held_out_split(&self) -> Option<Split> {
        [Split::Test, Split::Val].into_iter().find(|split| self.views.iter().any(|rig_view| rig_view.split == *split))
    }

    /// Returns the maximum allowed difference between the time of a view and the time of its frame, in the unit of the
    /// times.
    ///
    /// - Views of two or more distinct times: 1e-6 times the time span of the views. The sequence is assumed to cover
    ///   the same time span.
    /// - Otherwise: 1e-6.
    pub fn time_tolerance(&self) -> f64 {
        let times = self.times();
        TIME_TOLERANCE * if times.len() > 1 { span(&times) } else { 1.0 }
    }

    /// Builds the schedule (the list of views of each frame) from the views of one split; `None` takes all splits.
    ///
    /// `frame_times` must increase. A view with a time belongs to the frame with the nearest time. The two times may
    /// differ by at most 1e-6 times the time span of the frames (by 1e-6 if there is only one frame). A view without a
    /// time belongs to every frame.
    ///
    /// # Errors
    /// Fails with [`Error::Usage`] if no frame has the time of a view of the split.
    pub fn schedule(&self, frame_times: &[f64], split: Option<Split>) -> Result<ViewSchedule> {
        let (mut timed, mut timeless) = (Vec::new(), Vec::new());
        for (place, rig_view) in self.views.iter().enumerate() {
            if split.is_none_or(|split| split == rig_view.split) {
                match self.frame_of(rig_view, frame_times)? {
                    None => timeless.push(place),
                    Some(frame) => timed.push((frame, place)),
                }
            }
        }
        timed.sort_unstable();
        let views_of = |mut places: Vec<usize>| -> Vec<(u32, u32)> {
            places.sort_unstable();
            places.iter().map(|&place| (self.views[place].view, self.views[place].camera)).collect()
        };
        let mut schedule = ViewSchedule::new(self.cameras.clone());
        for of_one_frame in timed.chunk_by(|a, b| a.0 == b.0) {
            schedule.push_frames(of_one_frame[0].0 - schedule.frames(), &views_of(timeless.clone()));
            schedule.push_frames(
                1,
                &views_of(of_one_frame.iter().map(|&(_, place)| place).chain(timeless.iter().copied()).collect()),
            );
        }
        schedule.push_frames(frame_times.len() - schedule.frames(), &views_of(timeless));
        Ok(schedule)
    }

    /// Returns the index of the frame whose time is nearest to the time of the view `rig_view`. Returns `None` if the
    /// view has no time, and so belongs to every frame. `frame_times` are the increasing times of the frames.
    ///
    /// # Errors
    /// Fails with [`Error::Usage`] if the two times differ by more than the tolerance of [`Rig::schedule`].
    pub fn frame_of(&self, rig_view: &RigView, frame_times: &[f64]) -> Result<Option<usize>> {
        let Some(time) = rig_view.time else { return Ok(None) };
        let tolerance = TIME_TOLERANCE * if frame_times.len() > 1 { span(frame_times) } else { 1.0 };
        nearest(frame_times, time)
            .filter(|&frame| (frame_times[frame] - time).abs() <= tolerance)
            .map(Some)
            .ok_or_else(|| self.no_such_frame(rig_view.view, time, frame_times))
    }

    /// Returns the path of the photograph that belongs to `view` (a camera at a frame). Returns `None` if the camera
    /// file names no photograph for it. `frame_times` are the increasing times of the frames.
    pub fn image_path(&self, view: FrameView, frame_times: &[f64]) -> Option<&Path> {
        let shows = |rig_view: &&RigView| {
            let frame = || self.frame_of(rig_view, frame_times).ok();
            (rig_view.view, rig_view.camera) == (view.view, view.camera)
                && frame().is_some_and(|frame| frame.is_none_or(|frame| frame == view.frame))
        };
        self.views.iter().find(shows)?.image.as_deref()
    }

    /// Creates the error of a view whose `time` is not the time of any frame.
    fn no_such_frame(&self, view: u32, time: f64, frame_times: &[f64]) -> Error {
        let frames = match frame_times {
            [] => "has no frames".to_owned(),
            [only] => format!("has one frame, at time {only}"),
            [first, .., last] => format!("has {} frames, from time {first} to {last}", frame_times.len()),
        };
        Error::usage(format!(
            "{}: view {view} was taken at time {time}, but the sequence has no frame at this time: it {frames}\n  \
             use the cameras of this scene",
            self.origin,
        ))
    }
}

/// Returns the time span of increasing `times`: the last time minus the first, or 0 for fewer than two times.
fn span(times: &[f64]) -> f64 {
    match times {
        [first, .., last] => last - first,
        _ => 0.0,
    }
}

/// Returns the index of the entry of the increasing `times` that is nearest to `time`, the earlier one if two are
/// equally near. Returns `None` if `times` is empty.
fn nearest(times: &[f64], time: f64) -> Option<usize> {
    let after = times.partition_point(|&t| t < time);
    [after.wrapping_sub(1), after]
        .into_iter()
        .filter(|&i| i < times.len())
        .min_by(|&a, &b| (times[a] - time).abs().total_cmp(&(times[b] - time).abs()))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn rig(rig_views: &[(u32, Option<f64>, Split)]) -> Rig {
        let camera = |view: u32| Camera::look_at(DVec3::new(f64::from(view), -5.0, 1.0), DVec3::ZERO, 1.0, (64, 48));
        let views = rig_views.iter().map(|rig_view| rig_view.0).max().map_or(0, |last| last + 1);
        let rig_view = |&(view, time, split)| RigView { view, camera: view, time, split, image: None };
        Rig {
            cameras: (0..views).map(camera).collect(),
            views: rig_views.iter().map(rig_view).collect(),
            background: None,
            origin: "test.json".into(),
        }
    }

    #[test]
    fn synchronized_views_belong_to_their_frames() {
        let times = [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0];
        let rig_views: Vec<_> = times.iter().flat_map(|&t| (0..3).map(move |v| (v, Some(t), Split::Train))).collect();
        let rig = rig(&rig_views);
        assert_eq!(rig.times(), times);
        let schedule = rig.schedule(&times, Some(Split::Train)).unwrap();
        assert_eq!(schedule.pair_count(), 12);
        assert!(schedule.iter().all(|views| views == [(0, 0), (1, 1), (2, 2)]));
    }

    #[test]
    fn monocular_frames_without_a_view_stay_empty() {
        let rig = rig(&[(0, Some(0.0), Split::Train), (1, Some(0.5), Split::Test), (2, Some(1.0), Split::Train)]);
        let times = rig.times();
        assert_eq!(times, [0.0, 0.5, 1.0]);
        let views = |split| -> Vec<_> { rig.schedule(&times, split).unwrap().iter().map(<[_]>::to_vec).collect() };
        assert_eq!(views(Some(Split::Train)), [vec![(0, 0)], vec![], vec![(2, 2)]]);
        assert_eq!(views(Some(Split::Test)), [vec![], vec![(1, 1)], vec![]]);
        assert_eq!(rig.schedule(&times, None).unwrap().pair_count(), 3);
    }

    #[test]
    fn view_without_time_belongs_to_every_frame() {
        let rig = rig(&[(0, None, Split::Train), (1, None, Split::Test)]);
        assert!(rig.times().is_empty());
        let schedule = rig.schedule(&[0.0, 7.0], None).unwrap();
        assert_eq!(schedule.iter().collect::<Vec<_>>(), [[(0, 0), (1, 1)]; 2]);
        assert_eq!(rig.schedule(&[], None).unwrap().frames(), 0);
    }

    #[test]
    fn rig_without_times_has_one_view_per_camera() {
        let mut still = rig(&[
            (0, Some(0.0), Split::Train),
            (1, Some(0.0), Split::Test),
            (0, Some(0.5), Split::Train),
            (1, Some(0.5), Split::Train),
        ])
        .without_times();
        let views = |rig: &Rig| -> Vec<_> { rig.views.iter().map(|v| (v.view, v.camera, v.time, v.split)).collect() };
        let expected = [(0, 0, None, Split::Train), (1, 1, None, Split::Test), (1, 1, None, Split::Train)];
        assert_eq!(views(&still), expected);
        // Cameras of which each has a view of the number 7, as in the file of a moving camera.
        still.views.iter_mut().for_each(|rig_view| rig_view.view = 7);
        assert_eq!(views(&still.without_times()), expected);
    }

    #[test]
    fn timed_and_timeless_views_keep_the_file_order() {
        let rig = rig(&[
            (0, None, Split::Train),
            (1, Some(1.0), Split::Train),
            (2, None, Split::Train),
            (3, Some(3.0), Split::Train),
            (4, Some(1.0), Split::Train),
        ]);
        let schedule = rig.schedule(&[0.0, 1.0, 2.0, 3.0, 4.0], None).unwrap();
        let views: Vec<Vec<u32>> = schedule.iter().map(|views| views.iter().map(|view| view.0).collect()).collect();
        assert_eq!(views, [vec![0, 2], vec![0, 1, 2, 4], vec![0, 2], vec![0, 2, 3], vec![0, 2]]);
    }

    #[test]
    fn rounded_times_belong_to_one_frame() {
        let exact: Vec<f64> = (0..60).map(|t| f64::from(t) / 59.0).collect();
        let rig_views: Vec<_> = exact
            .iter()
            .flat_map(|&t| [(0, Some(t), Split::Train), (1, Some((t * 1e8).round() / 1e8), Split::Test)])
            .collect();
        let rig = rig(&rig_views);
        let times = rig.times();
        assert_eq!(times.len(), 60);
        assert!(rig.schedule(&times, None).unwrap().iter().all(|views| views.len() == 2));
    }

    #[test]
    fn a_million_frames_are_distinguished() {
        const T: usize = 1_000_000;
        let rig_views: Vec<_> = (0..T).map(|t| (0, Some(t as f64 / (T - 1) as f64), Split::Train)).collect();
        let rig = rig(&rig_views);
        let times = rig.times();
        assert_eq!(times.len(), T);
        assert!(rig.schedule(&times, None).unwrap().iter().all(|views| views.len() == 1));
    }

    #[test]
    fn view_without_a_frame_is_an_error_with_its_details() {
        let rig = rig(&[(0, Some(0.0), Split::Train), (3, Some(0.25), Split::Test)]);
        let message = rig.schedule(&[0.0, 0.5, 1.0], None).unwrap_err().to_string();
        for part in ["test.json", "view 3", "0.25", "has 3 frames, from time 0 to 1"] {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
        assert!(rig.schedule(&[0.0, 0.5, 1.0], Some(Split::Train)).is_ok(), "views of other splits must be ignored");
        assert!(rig.schedule(&[], None).unwrap_err().to_string().contains("has no frames"));
        assert!(rig.schedule(&[5.0], None).unwrap_err().to_string().contains("has one frame, at time 5"));
    }
}
