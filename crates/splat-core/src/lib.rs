//! The vocabulary: Gaussians at an instant, sequences of them, cameras, rows of statistics.

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout))]

mod camera;
mod covariance;
pub mod error;
pub mod functions;
mod gaussians;
mod gradients;
mod hash;
mod jacobian;
mod ranges;
mod raw;
mod rig;
mod robust_box;
mod rows;
mod schedule;

use crate::error::{Error, Result};
pub use camera::Camera;
pub use covariance::scale_rotation;
pub use gaussians::{Column, Columns, Gaussians};
pub use gradients::{GradientSpan, Gradients};
pub use hash::hash_id;
pub use jacobian::Jacobian;
pub use ranges::ranges;
pub use raw::Raw;
pub use rig::{Rig, Shot, Split};
pub use robust_box::RobustBox;
pub use rows::{Flags, Rows, Statistic, Values};
pub use schedule::{Picture, Schedule};

/// Zeroth spherical-harmonic basis constant: color = 0.5 + SH_C0 · f_dc.
pub const SH_C0: f64 = 0.282_094_791_773_878_14;

/// Opacity in [0, 1] of a stored logit, in f64.
pub fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

/// The logit of an opacity, in f64.
pub fn logit(opacity: f64) -> f64 {
    (opacity / (1.0 - opacity)).ln()
}

/// The color that a coefficient of degree 0 is from all sides, in f64.
pub fn color(harmonic: f32) -> f64 {
    0.5 + SH_C0 * f64::from(harmonic)
}

/// The coefficient of degree 0 of a color.
pub fn harmonic(color: f64) -> f32 {
    ((color - 0.5) / SH_C0) as f32
}

/// Number of spherical-harmonic coefficients per channel of degree `d`: (d + 1)².
pub const fn sh_coefficients(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Highest degree of harmonics that a renderer knows.
pub const HIGHEST_DEGREE: usize = 3;

/// A degree that no harmonics reach: all of them.
pub const ALL_HARMONICS: usize = usize::MAX;

/// What is known of a sequence before any frame is read.
#[derive(Debug, Clone, PartialEq)]
pub struct SequenceInfo {
    /// N, Gaussians in every frame.
    pub count: usize,
    /// Time stamp of each of the T frames, strictly increasing.
    pub times: Vec<f64>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: usize,
    /// Columns that may differ between frames; all others hold the same values in every frame.
    pub varying: Columns,
}

impl SequenceInfo {
    /// The same frames at other times, one per frame.
    ///
    /// # Errors
    /// A number of times other than T; times that are not finite or not strictly increasing, naming the frames.
    pub fn with_times(self, times: Vec<f64>) -> Result<SequenceInfo> {
        if times.len() != self.times.len() {
            return Err(Error::usage(format!("{} times were given for {} frames", times.len(), self.times.len())));
        }
        self.at(times)
    }

    /// The same Gaussians with frames at `times`, however many.
    ///
    /// # Errors
    /// Times that are not finite or not strictly increasing, naming the frames.
    pub fn at(self, times: Vec<f64>) -> Result<SequenceInfo> {
        if let Some(i) = times.iter().position(|time| !time.is_finite()) {
            return Err(Error::usage(format!("the time of frame {i} is {}, which is no time", times[i])));
        }
        if let Some(i) = (1..times.len()).find(|&i| times[i] <= times[i - 1]) {
            let (before, after) = (times[i - 1], times[i]);
            return Err(Error::usage(format!(
                "times must increase: frame {} has {before}, frame {i} has {after}",
                i - 1
            )));
        }
        Ok(SequenceInfo { times, ..self })
    }
}
