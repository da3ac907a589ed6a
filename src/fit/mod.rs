//! Few numbers for many states: what a Gaussian does along the frames, as the motions that compact formats know.
//!
//! [`straight`] cuts a life into pieces of straight motion; [`curved`] covers it with cubic motions under soft windows of
//! time. Both say how far they are off.

mod curved;
mod least_squares;
mod straight;
mod track;

pub use curved::{CubicTrack, curved};
pub(crate) use least_squares::polynomial;
pub use straight::{LinearPiece, straight};
pub use track::{FittedTrack, SEEN};

/// How far a fit may be from the states, at every frame that is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// Of positions, as a part of the middle one of the three scales.
    pub position: f64,
    /// Of rotations, radians; counts only where axes differ by more than a tenth.
    pub rotation: f64,
    /// Of scales, natural logarithm.
    pub log_scale: f64,
    /// Of opacities.
    pub opacity: f64,
    /// Of harmonic coefficients.
    pub sh: f64,
}

impl Default for Tolerance {
    /// About what one step of 8 bits shows.
    fn default() -> Tolerance {
        Tolerance { position: 0.1, rotation: 0.05, log_scale: 0.05, opacity: 0.02, sh: 0.05 }
    }
}

/// How far fits are off, over all Gaussians and frames that are seen.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Misfit {
    /// States compared.
    pub states: u64,
    /// Sum of squares of the distances, in middle scales.
    squares: f64,
    /// Largest of them.
    pub position: f64,
    /// Largest difference of opacity.
    pub opacity: f64,
}

impl Misfit {
    /// One state: how far its position is off, in middle scales, and its opacity.
    fn add(&mut self, position: f64, opacity: f64) {
        self.states += 1;
        self.squares += position * position;
        self.position = self.position.max(position);
        self.opacity = self.opacity.max(opacity.abs());
    }

    /// Both together.
    pub fn and(self, other: Misfit) -> Misfit {
        Misfit {
            states: self.states + other.states,
            squares: self.squares + other.squares,
            position: self.position.max(other.position),
            opacity: self.opacity.max(other.opacity),
        }
    }

    /// Root mean square of the distances, in middle scales.
    pub fn rms(&self) -> f64 {
        (self.squares / self.states.max(1) as f64).sqrt()
    }
}
