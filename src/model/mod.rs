//! The vocabulary: Gaussians at an instant, sequences of them, cameras, rows of statistics.

mod camera;
mod gaussians;
mod gradients;
mod jacobian;
mod ranges;
mod rig;
mod rows;
mod schedule;

pub use camera::Camera;
pub use gaussians::{Column, Columns, Gaussians};
pub use gradients::{GradientSpan, Gradients};
pub use jacobian::Jacobian;
pub use ranges::ranges;
pub use rig::{Rig, Shot, Split};
pub use rows::{Flags, Rows, Statistic, Values};
pub use schedule::{Picture, Schedule};

/// Zeroth spherical-harmonic basis constant: colour = 0.5 + SH_C0 · f_dc.
pub const SH_C0: f64 = 0.282_094_791_773_878_14;

/// Opacity in [0, 1] of a stored logit, in f64.
pub fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
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
