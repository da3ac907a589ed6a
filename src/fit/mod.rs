//! Curves fitted to the states of one Gaussian over all frames, in the forms that compact formats store.
//!
//! [`straight`] divides a track into pieces of linear motion. [`curved`] covers it with cubic motions under soft
//! windows in time. Both report their error.

mod curved;
mod least_squares;
mod straight;
mod track;

pub use curved::{CubicTrack, curved};
pub(crate) use least_squares::polynomial;
pub use straight::{LinearPiece, straight};
pub use track::{FittedTrack, MIN_VISIBLE_OPACITY};

/// Maximum error of a fit at every frame where the Gaussian is visible.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// Maximum error of positions, in units of the middle one of the three scales.
    pub position: f64,
    /// Maximum error of rotations, radians. Ignored if no two log scales differ by 0.1 or more.
    pub rotation: f64,
    /// Maximum error of log scales (natural logarithm).
    pub log_scale: f64,
    /// Maximum error of opacities.
    pub opacity: f64,
    /// Maximum error of SH coefficients.
    pub sh: f64,
}

impl Default for Tolerance {
    /// Returns tolerances of about one quantization step of 8 bits.
    fn default() -> Tolerance {
        Tolerance { position: 0.1, rotation: 0.05, log_scale: 0.05, opacity: 0.02, sh: 0.05 }
    }
}

/// Error of fits, over all Gaussians and the frames where they are visible.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Misfit {
    /// Number of compared states.
    pub states: u64,
    /// Sum of squared distances, in units of the middle scale squared.
    squares: f64,
    /// Largest distance, in units of the middle scale.
    pub position: f64,
    /// Largest difference of opacities.
    pub opacity: f64,
}

impl Misfit {
    /// Adds one state with the error of its position, in units of the middle scale, and of its opacity.
    fn add(&mut self, position: f64, opacity: f64) {
        self.states += 1;
        self.squares += position * position;
        self.position = self.position.max(position);
        self.opacity = self.opacity.max(opacity.abs());
    }

    /// Returns the combined error of both sets of fits.
    pub fn and(self, other: Misfit) -> Misfit {
        Misfit {
            states: self.states + other.states,
            squares: self.squares + other.squares,
            position: self.position.max(other.position),
            opacity: self.opacity.max(other.opacity),
        }
    }

    /// Returns the root mean square of the distances, in units of the middle scale.
    pub fn rms(&self) -> f64 {
        (self.squares / self.states.max(1) as f64).sqrt()
    }
}
