//! The pictures that cameras took.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::camera::Camera;
use super::schedule::{Picture, Schedule};
use crate::error::{Error, Result};

/// The part of a data set a picture belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Pictures the model was trained on; compression scores with these.
    Train,
    /// Pictures held out while it was trained; evaluation uses these where there are no others.
    Val,
    /// Held-out pictures; evaluation uses these.
    Test,
}

/// A picture that cameras took, or may have taken: a (time, view) pair.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// View number.
    pub view: u32,
    /// Index into [`Rig::cameras`].
    pub camera: u32,
    /// Time stamp, or none when the camera sees every frame.
    pub time: Option<f64>,
    /// Part of the data set.
    pub split: Split,
    /// The picture's file, if the cameras name one.
    pub image: Option<PathBuf>,
}

/// All cameras of a data set and the pictures they took.
#[derive(Debug, Clone, PartialEq)]
pub struct Rig {
    /// Distinct cameras.
    pub cameras: Vec<Camera>,
    /// Every picture, in file order.
    pub shots: Vec<Shot>,
    /// Linear RGB in [0, 1] behind the scene, if the cameras' file says.
    pub background: Option<[f32; 3]>,
    /// Where they come from, for people: a path, or the recipe of a virtual rig.
    pub origin: String,
}

/// How far from a frame's time stamp a picture may be taken and still show that frame, in parts of
/// the time span: files round their times, and a million frames are still told apart.
const TIME_TOLERANCE: f64 = 1e-6;

impl Rig {
    /// Bytes that a distinct camera takes: itself, its copy in a schedule, and its place in a table while it is read.
    pub const CAMERA_BYTES: u64 = 2 * size_of::<Camera>() as u64 + 16;

    /// Bytes that a picture takes beside its camera and the name of its file: itself, its places in two tables while it is
    /// read, and three times its place in a schedule.
    pub const SHOT_BYTES: u64 = size_of::<Shot>() as u64 + 32 + 3 * 40;

    /// Bytes that the name of a picture's file takes beside its text, for the allocator.
    pub const NAME_BYTES: u64 = 32;

    /// Bytes of all cameras and pictures, and of one schedule of them.
    pub fn bytes(&self) -> u64 {
        let names = self.shots.iter().filter_map(|shot| shot.image.as_ref());
        let names: u64 = names.map(|image| image.as_os_str().len() as u64 + Rig::NAME_BYTES).sum();
        Rig::CAMERA_BYTES * self.cameras.len() as u64 + Rig::SHOT_BYTES * self.shots.len() as u64 + names
    }

    /// The distinct times of all pictures, increasing; empty when no picture has a time.
    ///
    /// Times within half the tolerance of [`Rig::schedule`] above another are that one: training and
    /// held-out pictures of one moment may have been rounded differently.
    pub fn times(&self) -> Vec<f64> {
        let mut times: Vec<f64> = self.shots.iter().filter_map(|shot| shot.time).collect();
        times.sort_by(f64::total_cmp);
        let near = 0.5 * TIME_TOLERANCE * span(&times);
        times.dedup_by(|later, kept| *later - *kept <= near);
        times
    }

    /// The split that is held out: test, or val where there is none; none where every picture is for training.
    pub fn held_out(&self) -> Option<Split> {
        [Split::Test, Split::Val].into_iter().find(|split| self.shots.iter().any(|shot| shot.split == *split))
    }

    /// How far from a frame's time a picture of it may be taken, if the frames span the pictures' times.
    pub fn time_tolerance(&self) -> f64 {
        let times = self.times();
        TIME_TOLERANCE * if times.len() > 1 { span(&times) } else { 1.0 }
    }

    /// Which cameras see which frame, for the pictures of one split (`None`: all of them).
    ///
    /// `frame_times` must increase. A picture belongs to the nearest frame, which must lie within
    /// 1e-6 of the time span (of 1, if there is one frame); a picture without a time to every frame.
    ///
    /// # Errors
    /// [`Error::Usage`] when a picture was taken at no frame's time.
    pub fn schedule(&self, frame_times: &[f64], split: Option<Split>) -> Result<Schedule> {
        let (mut timed, mut timeless) = (Vec::new(), Vec::new());
        for (place, shot) in self.shots.iter().enumerate() {
            if split.is_none_or(|split| split == shot.split) {
                match self.frame_of(shot, frame_times)? {
                    None => timeless.push(place),
                    Some(frame) => timed.push((frame, place)),
                }
            }
        }
        timed.sort_unstable();
        let seen = |mut places: Vec<usize>| -> Vec<(u32, u32)> {
            places.sort_unstable();
            places.iter().map(|&place| (self.shots[place].view, self.shots[place].camera)).collect()
        };
        let mut schedule = Schedule::new(self.cameras.clone());
        for together in timed.chunk_by(|a, b| a.0 == b.0) {
            schedule.push(together[0].0 - schedule.frames(), &seen(timeless.clone()));
            schedule.push(1, &seen(together.iter().map(|&(_, place)| place).chain(timeless.iter().copied()).collect()));
        }
        schedule.push(frame_times.len() - schedule.frames(), &seen(timeless));
        Ok(schedule)
    }

    /// The frame a picture of this rig shows, by the rule of [`Rig::schedule`]; none: every frame.
    ///
    /// # Errors
    /// [`Error::Usage`] when the picture was taken at no frame's time.
    pub fn frame_of(&self, shot: &Shot, frame_times: &[f64]) -> Result<Option<usize>> {
        let Some(time) = shot.time else { return Ok(None) };
        let tolerance = TIME_TOLERANCE * if frame_times.len() > 1 { span(frame_times) } else { 1.0 };
        nearest(frame_times, time)
            .filter(|&frame| (frame_times[frame] - time).abs() <= tolerance)
            .map(Some)
            .ok_or_else(|| self.no_such_frame(shot.view, time, frame_times))
    }

    /// The file of `picture`, if the cameras name one; `frame_times` as for [`Rig::schedule`].
    pub fn image(&self, picture: Picture, frame_times: &[f64]) -> Option<&Path> {
        let shows = |shot: &&Shot| {
            let frame = || self.frame_of(shot, frame_times).ok();
            (shot.view, shot.camera) == (picture.view, picture.camera)
                && frame().is_some_and(|frame| frame.is_none_or(|frame| frame == picture.frame))
        };
        self.shots.iter().find(shows)?.image.as_deref()
    }

    fn no_such_frame(&self, view: u32, time: f64, frame_times: &[f64]) -> Error {
        let frames = match frame_times {
            [] => "has none".to_owned(),
            [only] => format!("has one, at time {only}"),
            [first, .., last] => format!("has {}, from time {first} to {last}", frame_times.len()),
        };
        Error::usage(format!(
            "{}: view {view} was taken at time {time}, which is no frame of the sequence: it {frames}\n  \
             give the cameras of this scene, or --frames to match their number",
            self.origin,
        ))
    }
}

/// Last minus first; 0 of fewer than two.
fn span(times: &[f64]) -> f64 {
    match times {
        [first, .., last] => last - first,
        _ => 0.0,
    }
}

/// Index of the increasing `times` nearest to `time`, the earlier of two equally near.
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

    fn rig(shots: &[(u32, Option<f64>, Split)]) -> Rig {
        let camera = |view: u32| Camera::look_at(DVec3::new(f64::from(view), -5.0, 1.0), DVec3::ZERO, 1.0, (64, 48));
        let views = shots.iter().map(|shot| shot.0).max().map_or(0, |last| last + 1);
        let shot = |&(view, time, split)| Shot { view, camera: view, time, split, image: None };
        Rig {
            cameras: (0..views).map(camera).collect(),
            shots: shots.iter().map(shot).collect(),
            background: None,
            origin: "test.json".into(),
        }
    }

    #[test]
    fn every_picture_of_a_synchronized_rig_lands_on_its_frame() {
        let times = [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0];
        let shots: Vec<_> = times.iter().flat_map(|&t| (0..3).map(move |v| (v, Some(t), Split::Train))).collect();
        let rig = rig(&shots);
        assert_eq!(rig.times(), times);
        let schedule = rig.schedule(&times, Some(Split::Train)).unwrap();
        assert_eq!(schedule.pairs(), 12);
        assert!(schedule.iter().all(|views| views == [(0, 0), (1, 1), (2, 2)]));
    }

    #[test]
    fn monocular_capture_has_one_view_per_frame_and_its_gaps_stay() {
        let rig = rig(&[(0, Some(0.0), Split::Train), (1, Some(0.5), Split::Test), (2, Some(1.0), Split::Train)]);
        let times = rig.times();
        assert_eq!(times, [0.0, 0.5, 1.0]);
        let views = |split| -> Vec<_> { rig.schedule(&times, split).unwrap().iter().map(<[_]>::to_vec).collect() };
        assert_eq!(views(Some(Split::Train)), [vec![(0, 0)], vec![], vec![(2, 2)]]);
        assert_eq!(views(Some(Split::Test)), [vec![], vec![(1, 1)], vec![]]);
        assert_eq!(rig.schedule(&times, None).unwrap().pairs(), 3);
    }

    #[test]
    fn picture_without_time_shows_every_frame() {
        let rig = rig(&[(0, None, Split::Train), (1, None, Split::Test)]);
        assert!(rig.times().is_empty());
        let schedule = rig.schedule(&[0.0, 7.0], None).unwrap();
        assert_eq!(schedule.iter().collect::<Vec<_>>(), [[(0, 0), (1, 1)]; 2]);
        assert_eq!(rig.schedule(&[], None).unwrap().frames(), 0);
    }

    #[test]
    fn pictures_with_and_without_time_keep_the_order_of_the_file() {
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
    fn rounding_of_times_neither_splits_a_frame_nor_loses_a_picture() {
        let exact: Vec<f64> = (0..60).map(|t| f64::from(t) / 59.0).collect();
        let shots: Vec<_> = exact
            .iter()
            .flat_map(|&t| [(0, Some(t), Split::Train), (1, Some((t * 1e8).round() / 1e8), Split::Test)])
            .collect();
        let rig = rig(&shots);
        let times = rig.times();
        assert_eq!(times.len(), 60);
        assert!(rig.schedule(&times, None).unwrap().iter().all(|views| views.len() == 2));
    }

    #[test]
    fn a_million_frames_are_told_apart() {
        const T: usize = 1_000_000;
        let shots: Vec<_> = (0..T).map(|t| (0, Some(t as f64 / (T - 1) as f64), Split::Train)).collect();
        let rig = rig(&shots);
        let times = rig.times();
        assert_eq!(times.len(), T);
        assert!(rig.schedule(&times, None).unwrap().iter().all(|views| views.len() == 1));
    }

    #[test]
    fn picture_of_no_frame_is_refused_by_name() {
        let rig = rig(&[(0, Some(0.0), Split::Train), (3, Some(0.25), Split::Test)]);
        let message = rig.schedule(&[0.0, 0.5, 1.0], None).unwrap_err().to_string();
        for part in ["test.json", "view 3", "0.25", "has 3, from time 0 to 1", "--frames"] {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
        assert!(rig.schedule(&[0.0, 0.5, 1.0], Some(Split::Train)).is_ok(), "the other split is not looked at");
        assert!(rig.schedule(&[], None).unwrap_err().to_string().contains("has none"));
        assert!(rig.schedule(&[5.0], None).unwrap_err().to_string().contains("has one, at time 5"));
    }
}
