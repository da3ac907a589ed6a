//! Data types shared by the whole workspace: Gaussians of one frame, sequences of frames, cameras, and per-Gaussian
//! statistics.
//!
//! ```
//! use splat_core::{Attributes, Gaussians, logit, opacity};
//!
//! let mut gaussians = Gaussians::zeros(2, 0);
//! gaussians.position.set_row(1, [0.5, 0.0, 2.0]);
//! gaussians.opacity_logit.set_row(1, [logit(0.8) as f32]);
//! assert_eq!(gaussians.position.plane(0), [0.0, 0.5]);
//! assert!((opacity(gaussians.opacity_logit.plane(0)[1]) - 0.8).abs() < 1e-6);
//! assert_eq!(Attributes::all().width(gaussians.sh_degree()), 3 + 4 + 3 + 1 + 3);
//! ```

#![cfg_attr(not(test), deny(clippy::print_stderr, clippy::print_stdout))]

mod camera;
mod covariance;
pub mod error;
pub mod exp_log;
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
mod vectorized;

use crate::error::{Error, Result};
pub use camera::Camera;
pub use covariance::scale_rotation;
pub use gaussians::{AttributeValues, Attributes, Gaussians};
pub use gradients::{GradientSpan, Gradients};
pub use hash::{hash_id, inverse_permutation};
pub use jacobian::Jacobian;
pub use ranges::format_ranges;
pub use raw::StoredParams;
pub use rig::{Rig, RigView, Split};
pub use robust_box::RobustBox;
pub use rows::{AnomalyFlags, Statistic, StatisticArray, StatisticRows};
pub use schedule::{FrameView, ViewSchedule};
#[cfg(target_arch = "x86_64")]
pub use vectorized::has_avx512;
pub use vectorized::vectorized;

/// Value of the spherical-harmonic (SH) basis function of degree 0. A color is 0.5 + SH_C0 · f_dc, where f_dc is its
/// stored SH coefficient of degree 0.
pub const SH_C0: f64 = 0.282_094_791_773_878_14;

/// Returns the opacity, in [0, 1], of a stored logit. Computed in f64.
pub fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

/// Returns the logit ln(o / (1 − o)) of an opacity o. Computed in f64.
pub fn logit(opacity: f64) -> f64 {
    (opacity / (1.0 - opacity)).ln()
}

/// Magnitude of the finite logit that replaces an infinite one. The logit 100 gives an opacity of 1 in f64, and the
/// logit −100 an opacity below 4e-44.
pub const INFINITE_LOGIT: f32 = 100.0;

/// Returns `logit` with an infinite value replaced by ±[`INFINITE_LOGIT`]; NaN and finite values are unchanged.
pub fn finite_logit(logit: f32) -> f32 {
    if logit.is_infinite() { INFINITE_LOGIT.copysign(logit) } else { logit }
}

/// Returns 0.5 + SH_C0 · `f_dc`: the value of one color channel without the SH coefficients above degree 0, which make
/// the color depend on the view direction. `f_dc` is the stored SH coefficient of degree 0.
pub fn color_from_sh(f_dc: f32) -> f64 {
    0.5 + SH_C0 * f64::from(f_dc)
}

/// Returns (`color` − 0.5) / SH_C0: the stored SH coefficient of degree 0 that gives one color channel the value
/// `color`.
pub fn sh_from_color(color: f64) -> f32 {
    ((color - 0.5) / SH_C0) as f32
}

/// Returns the number of SH coefficients per color channel up to `degree`, which is (`degree` + 1)².
pub const fn sh_coefficient_count(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Highest supported degree of spherical harmonics (SH), the limit of common renderers.
pub const MAX_SH_DEGREE: usize = 3;

/// Value for a maximum SH degree that means "no limit": all SH coefficients are kept.
pub const NO_SH_LIMIT: usize = usize::MAX;

/// Properties of a sequence of frames, each with the same Gaussians, that are known before any frame is read.
#[derive(Debug, Clone, PartialEq)]
pub struct SequenceInfo {
    /// Number of Gaussians N, the same in every frame.
    pub count: usize,
    /// Time stamp of each of the T frames, strictly increasing.
    pub times: Vec<f64>,
    /// SH degree, 0 to 3.
    pub sh_degree: usize,
    /// Attributes that may differ between frames. All others have the same values in every frame.
    pub varying: Attributes,
}

impl SequenceInfo {
    /// Replaces the time stamps of the T frames by `times`.
    ///
    /// # Errors
    /// Fails if `times` does not have T entries, or if times are not finite or not strictly increasing. The message
    /// names the frames.
    pub fn with_times(self, times: Vec<f64>) -> Result<SequenceInfo> {
        if times.len() != self.times.len() {
            return Err(Error::usage(format!("{} times were given for {} frames", times.len(), self.times.len())));
        }
        self.with_frames_at(times)
    }

    /// Replaces the T frames by one frame at each of `times`; the Gaussians stay the same.
    ///
    /// # Errors
    /// Fails if times are not finite or not strictly increasing. The message names the frames.
    pub fn with_frames_at(self, times: Vec<f64>) -> Result<SequenceInfo> {
        if let Some(i) = times.iter().position(|time| !time.is_finite()) {
            return Err(Error::usage(format!("the time of frame {i} is {}: expected a finite number", times[i])));
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

/// Compiles the example in the README of this crate as a documentation test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
mod readme {}
