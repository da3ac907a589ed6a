//! Cameras, the pictures they took, and which camera sees which frame.

use std::path::PathBuf;

use glam::{DMat3, DVec3};

use crate::error::{Error, Result};

/// A pinhole camera in OpenCV axes (x right, y down, z forward); pixel centres at half integers.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// Picture width in pixels.
    pub width: u32,
    /// Picture height in pixels.
    pub height: u32,
    /// Focal length along x in pixels.
    pub fx: f64,
    /// Focal length along y in pixels.
    pub fy: f64,
    /// Principal point in pixels; the picture's middle is `width / 2`.
    pub cx: f64,
    /// Principal point in pixels.
    pub cy: f64,
    /// World to camera.
    pub rotation: DMat3,
    /// World to camera: `x_camera = rotation · x_world + translation`.
    pub translation: DVec3,
}

impl Camera {
    /// Position of the camera in the world.
    pub fn center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }
}

/// The part of a data set a picture belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// Pictures the model was trained on; compression scores with these.
    Train,
    /// Held-out pictures; evaluation uses these.
    Test,
}

/// One picture: a (time, view) pair.
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
    /// Where they come from, for people: a path, or the recipe of a virtual rig.
    pub origin: String,
}

impl Rig {
    /// The distinct times of all pictures, increasing; empty when no picture has a time.
    pub fn times(&self) -> Vec<f64> {
        let mut times: Vec<f64> = self.shots.iter().filter_map(|shot| shot.time).collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        times
    }

    /// Which cameras see which frame, for the pictures of one split (`None`: all of them).
    ///
    /// A picture belongs to the frame whose time stamp lies within 1e-6 of the time span of its own.
    pub fn schedule(&self, frame_times: &[f64], split: Option<Split>) -> Result<Schedule> {
        let mut frames = vec![Vec::new(); frame_times.len()];
        let span = match frame_times {
            [first, .., last] => last - first,
            _ => 1.0,
        };
        for shot in self.shots.iter().filter(|shot| split.is_none_or(|split| split == shot.split)) {
            match shot.time {
                None => frames.iter_mut().for_each(|frame| frame.push((shot.view, shot.camera))),
                Some(time) => {
                    let after = frame_times.partition_point(|&t| t < time);
                    let nearest = [after.wrapping_sub(1), after]
                        .into_iter()
                        .filter(|&i| i < frame_times.len() && (frame_times[i] - time).abs() <= 1e-6 * span)
                        .min_by(|&a, &b| (frame_times[a] - time).abs().total_cmp(&(frame_times[b] - time).abs()));
                    let Some(frame) = nearest else {
                        return Err(Error::usage(format!(
                            "{}: view {} was taken at time {time}, which is no frame of the sequence ({} frames from {:?} to {:?})\n  \
                             give the cameras of this scene, or --frames to match their number",
                            self.origin,
                            shot.view,
                            frame_times.len(),
                            frame_times.first(),
                            frame_times.last(),
                        )));
                    };
                    frames[frame].push((shot.view, shot.camera));
                }
            }
        }
        Ok(Schedule { cameras: self.cameras.clone(), frames })
    }
}

/// Which cameras see which frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// Distinct cameras.
    pub cameras: Vec<Camera>,
    /// For every frame its (view number, camera index) pairs.
    pub frames: Vec<Vec<(u32, u32)>>,
}

impl Schedule {
    /// M, the number of (time, view) pairs.
    pub fn pairs(&self) -> usize {
        self.frames.iter().map(Vec::len).sum()
    }
}
