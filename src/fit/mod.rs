//! Fits of simple motions to the track of one Gaussian (its states at all frames), in the forms that compact formats
//! store.
//!
//! [`straight`] divides a track into pieces of linear motion. [`curved`] covers it with cubic or linear motions in soft
//! windows of time. Both report their error.

mod curved;
mod least_squares;
mod optical_depths;
mod straight;
mod track;
mod windows;

pub use curved::{CubicTrack, CurveForm, fit_curves};
pub(crate) use least_squares::polynomial;
pub use straight::{LinearPiece, fit_lines};
pub use track::{FittedTrack, MIN_VISIBLE_OPACITY};

/// Largest errors that a fit may have at any frame in which the Gaussian is visible.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// Largest allowed distance between the positions of the fit and of the Gaussian, in units of the Gaussian's middle
    /// scale (the middle one of its three scales).
    pub position: f64,
    /// Largest allowed angle between the rotations of the fit and of the Gaussian, radians. Ignored for a nearly round
    /// Gaussian, whose log scales all differ by less than 0.1.
    pub rotation: f64,
    /// Largest allowed difference between the log scales (natural logarithms) of the fit and of the Gaussian.
    pub log_scale: f64,
    /// Largest allowed difference between the opacities of the fit and of the Gaussian. Opacities are in [0, 1].
    pub opacity: f64,
    /// Largest allowed difference between the SH coefficients of the fit and of the Gaussian.
    pub sh: f64,
    /// Opacity from which on the tolerances apply as given. For a Gaussian of a lower opacity α, every tolerance except
    /// that of the opacity is multiplied by `full_opacity`/α, because errors of faint Gaussians are less visible. The
    /// value 0 means that the tolerances apply as given to every Gaussian. Used by [`curved`] only.
    pub full_opacity: f64,
}

impl Tolerance {
    /// Tolerances of the compact fit by [`curved`], which takes few curves: for example, a Gaussian may be off by half
    /// of its middle scale (the middle one of its three scales).
    pub const COMPACT: Tolerance =
        Tolerance { position: 0.5, rotation: 0.3, log_scale: 0.2, opacity: 0.06, sh: 0.2, full_opacity: 1.0 / 3.0 };

    /// Returns the factor by which errors of a Gaussian of opacity `opacity` are multiplied before they are compared
    /// with the tolerances. The factor is at most 1, because faint Gaussians may have larger errors. It does not apply
    /// to errors of the opacity itself.
    fn weight(&self, opacity: f64) -> f64 {
        if opacity < self.full_opacity { opacity / self.full_opacity } else { 1.0 }
    }
}

impl Default for Tolerance {
    /// Returns tolerances of about one step of an 8-bit quantization.
    fn default() -> Tolerance {
        Tolerance { position: 0.1, rotation: 0.05, log_scale: 0.05, opacity: 0.02, sh: 0.05, full_opacity: 0.0 }
    }
}

/// Errors beyond which the fit counts as far off. First: distance between the positions of the fit and of the Gaussian,
/// in units of the Gaussian's middle scale (the middle one of its three scales). Second: difference between their
/// opacities.
const FAR: [f64; 2] = [1.0, 0.1];

/// Errors of fitted motions (curves, or pieces of linear motion) compared with the original states of the Gaussians.
/// They are collected over all Gaussians, and over the frames in which the Gaussian or its fit is visible.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FitError {
    /// Number of compared states. A state is one Gaussian at one frame in which it or its fit is visible.
    pub states: u64,
    /// Sum, over all compared states, of the squared distance between the positions of the fit and of the Gaussian.
    /// Distances are in units of the Gaussian's middle scale (the middle one of its three scales).
    squares: f64,
    /// Sum, over all compared states, of the squared difference between the opacity of the fit and that of the
    /// Gaussian.
    opacity_squares: f64,
    /// Sum of the Gaussian's opacity over all compared states.
    opacity_sum: f64,
    /// Sum of the Gaussian's opacity over those compared states in which the fit is far off: one of its errors exceeds
    /// [`FAR`].
    far_opacity_sum: f64,
    /// Largest distance, over all compared states, between the positions of the fit and of the Gaussian, in units of
    /// the Gaussian's middle scale (the middle one of its three scales).
    pub max_position_error: f64,
    /// Largest difference, over all compared states, between the opacities of the fit and of the Gaussian.
    pub max_opacity_error: f64,
}

impl FitError {
    /// Adds one compared state: one Gaussian at one frame. `position`: distance between the positions of the fit and of
    /// the Gaussian, in units of the Gaussian's middle scale (the middle one of its three scales). `opacity`:
    /// difference between the opacities of the fit and of the Gaussian. `visible`: opacity of the Gaussian, its weight
    /// in [`FitError::far_off_fraction`].
    pub(crate) fn add_state(&mut self, position: f64, opacity: f64, visible: f64) {
        self.opacity_sum += visible;
        self.far_opacity_sum += if position > FAR[0] || opacity.abs() > FAR[1] { visible } else { 0.0 };
        self.states += 1;
        self.squares += position * position;
        self.opacity_squares += opacity * opacity;
        self.max_position_error = self.max_position_error.max(position);
        self.max_opacity_error = self.max_opacity_error.max(opacity.abs());
    }

    /// Combines the errors of two disjoint sets of compared states and returns the errors over both sets. Counts and
    /// sums are added; of each maximum error, the larger one is taken.
    pub fn merged_with(self, other: FitError) -> FitError {
        FitError {
            states: self.states + other.states,
            squares: self.squares + other.squares,
            opacity_squares: self.opacity_squares + other.opacity_squares,
            opacity_sum: self.opacity_sum + other.opacity_sum,
            far_opacity_sum: self.far_opacity_sum + other.far_opacity_sum,
            max_position_error: self.max_position_error.max(other.max_position_error),
            max_opacity_error: self.max_opacity_error.max(other.max_opacity_error),
        }
    }

    /// Returns the errors as text for a note to the user.
    pub fn error_note(&self) -> String {
        format!(
            "error of positions, as a fraction of the Gaussian's middle scale: {:.3} rms, {:.3} at most; error of \
             opacities: {:.3} at most",
            self.rms(),
            self.max_position_error,
            self.max_opacity_error
        )
    }

    /// Returns the root mean square distance between the positions of the fit and of the Gaussian, over all compared
    /// states. Distances are in units of the Gaussian's middle scale (the middle one of its three scales).
    pub fn rms(&self) -> f64 {
        (self.squares / self.states.max(1) as f64).sqrt()
    }

    /// Returns the fraction of the compared states, weighted by the opacity of the Gaussian, in which the fit is far
    /// off. A fit is far off if its position is wrong by more than the Gaussian's middle scale (the middle one of its
    /// three scales), or its opacity by more than 0.1. Because of the weight, faint Gaussians hardly count in this
    /// fraction, unlike in the other errors.
    pub fn far_off_fraction(&self) -> f64 {
        self.far_opacity_sum / self.opacity_sum.max(f64::MIN_POSITIVE)
    }

    /// Returns the root mean square difference between the opacities of the fit and of the Gaussian, over all compared
    /// states.
    pub fn opacity_rms(&self) -> f64 {
        (self.opacity_squares / self.states.max(1) as f64).sqrt()
    }
}
