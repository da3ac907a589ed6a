//! Motion model of four-dimensional Gaussians: the state at a time is a slice of the Gaussian at that time.
//!
//! A Gaussian has the center (x, μ) in space and time, and a covariance Σ₄ with the blocks Σ₁₁ (space), Σ_tt (time) and
//! Σ₁₂ (both).
//!
//! - Σ₄ = R₄ diag(s)² R₄ᵀ; velocity v = Σ₁₂/Σ_tt; x(t) = x + v·(t − μ); the spatial covariance Σ = Σ₁₁ − Σ₁₂Σ₂₁/Σ_tt is
//!   constant in time.
//! - Temporal marginal m = exp(−½(t − μ)²/Σ_tt); opacity = σ(o)·m, and 0 if m ≤ 0.05.
//! - Without a 4D rotation, v = 0, Σ follows from `scaling` and `rotation`, and Σ_tt = exp(scaling_t), not its square.
//! - SH coefficients: c_k + cos(2π(μ − t)/L)·c₁₆₊ₖ + cos(4π(μ − t)/L)·c₃₂₊ₖ, with the period L.
//!
//! All computations are in f64: in f32 a fast, small Gaussian with a long life span would lose Σ. Source:
//! `computeCov3D_conditional`, `get_marginal_t`, `eval_shfs_4d` of the repository (fudan-zvg). Its rasterizer evaluates
//! SH in the direction of x, this one in the direction of x(t).

use std::f64::consts::TAU;

use super::rotation::{covariance, rotation};
use crate::error::Result;
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, StoredParams, scale_rotation};
use crate::models::motion_model::window::{MAX_LOGIT, faded_logit, inverse_odds, slope};
use crate::models::motion_model::{MotionModel, copy_stored};

/// Index in [`StoredParams::format_specific`] of the center μ in time.
pub(super) const TIME: usize = 0;
/// Index in [`StoredParams::format_specific`] of the logarithm of the scale along time.
pub(super) const SCALING_T: usize = 1;
/// First of four indices in [`StoredParams::format_specific`] of the right quaternion of the 4D rotation.
pub(super) const ROTATION_R: usize = 2;
/// First index in [`StoredParams::format_specific`] of the time-dependent SH coefficients, term by term.
pub(super) const TERMS: usize = 6;
/// Number of SH coefficients (three channels, degree 3) of one time-dependent term.
pub(super) const TERM_WIDTH: usize = 48;

/// Temporal marginal m (factor of the opacity) up to which a Gaussian is not drawn.
const MIN_MARGINAL: f64 = 0.05;

/// Motion model of four-dimensional Gaussians and the settings of their training.
#[derive(Debug, Clone)]
pub(super) struct Native {
    /// Whether Gaussians have a 4D rotation; if not, space and time are independent.
    pub(super) has_4d_rotation: bool,
    /// Whether the rows and columns of the 4D rotation matrix are in reversed order, as in checkpoints since 15
    /// September 2024.
    pub(super) flipped: bool,
    /// Variance p that is added to the temporal variance Σ_tt of a Gaussian when its temporal marginal (factor of the
    /// opacity) is computed: exp(−½(t − μ)²/(Σ_tt + p)). A negative value counts as 0.
    pub(super) prefilter: f64,
    /// Number of time-dependent SH terms in use, from 0 to 2.
    pub(super) terms: usize,
    /// Period L after which time-dependent colors repeat, in the model's time unit, as given by the user or the
    /// training configuration; `None` if neither gives it.
    pub(super) given_period: Option<f64>,
    /// Period L with which time-dependent colors are computed, in the model's time unit: the given or a guessed one.
    pub(super) period: f64,
}

/// Time-independent values of a block of consecutive Gaussians, from which its states at a time follow. They are
/// computed once and used for every frame.
#[derive(Debug)]
pub(super) struct Slices {
    /// Velocity of each Gaussian, axis by axis, in scene units per unit of time.
    velocity: [Vec<f64>; 3],
    /// For each Gaussian −1/(2 Σ_tt), where the variance in time Σ_tt includes `prefilter`.
    rates: Vec<f64>,
    /// For each Gaussian exp(−o), where o is the stored opacity logit.
    inverse_odds: Vec<f64>,
    /// Rotation of the spatial covariance Σ of each Gaussian; empty without a 4D rotation.
    rotation: AttributeValues,
    /// Log scales of the spatial covariance Σ of each Gaussian; empty without a 4D rotation.
    log_scale: AttributeValues,
}

/// Velocity, variance in time and spatial covariance of one four-dimensional Gaussian.
pub(super) struct Slice {
    pub(super) velocity: [f64; 3],
    /// Variance in time, Σ_tt, before the constant `prefilter` is added.
    pub(super) variance: f64,
    /// Spatial covariance Σ: xx xy xz yy yz zz; `None` if it follows from the stored scales and rotation.
    pub(super) covariance: Option<[f64; 6]>,
}

impl Native {
    /// Computes velocity, variance in time and spatial covariance of Gaussian `i` from its stored parameters.
    pub(super) fn slice(&self, raw: &StoredParams, i: usize) -> Slice {
        let log_scale_t = f64::from(raw.format_specific.plane(SCALING_T)[i]);
        if !self.has_4d_rotation {
            return Slice { velocity: [0.0; 3], variance: log_scale_t.exp(), covariance: None };
        }
        let [l, r] =
            [raw.gaussians.rotation.row::<4>(i), [0, 1, 2, 3].map(|c| raw.format_specific.plane(ROTATION_R + c)[i])];
        let [x, y, z] = raw.gaussians.log_scale.row::<3>(i).map(f64::from);
        let covariance_4d = covariance(
            &rotation([l.map(f64::from), r.map(f64::from)], self.flipped),
            [x, y, z, log_scale_t].map(f64::exp),
        );
        let variance = covariance_4d[3][3];
        // A Gaussian without extent in time does not move.
        let velocity = [0, 1, 2].map(|c| if variance > 0.0 { covariance_4d[c][3] / variance } else { 0.0 });
        let entry = |i: usize, j: usize| covariance_4d[i][j] - velocity[i] * covariance_4d[3][j];
        let covariance = [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)];
        Slice { velocity, variance, covariance: Some(covariance) }
    }

    /// Returns −1/(2(Σ_tt + p)), where Σ_tt = `variance` is the variance in time, and p is [`Native::prefilter`], or 0
    /// if it is negative.
    fn rate(&self, variance: f64) -> f64 {
        -0.5 / (variance + self.prefilter.max(0.0))
    }

    /// Returns the temporal marginal m (factor of the opacity) at `time` of a Gaussian with the given center and
    /// variance in time. Values up to [`MIN_MARGINAL`] are replaced by 0.
    pub(super) fn marginal(&self, time: f64, center: f64, variance: f64) -> f64 {
        let m = (self.rate(variance) * (time - center).powi(2)).exp();
        if m > MIN_MARGINAL { m } else { 0.0 }
    }

    /// Returns the factors cos(2π(μ − t)/L) and cos(4π(μ − t)/L) of the two time-dependent SH terms, for `time` t,
    /// `center` μ and period L of the colors.
    pub(super) fn waves(&self, time: f64, center: f64) -> [f64; 2] {
        let wave = (TAU * (center - time) / self.period).cos();
        [wave, 2.0 * wave * wave - 1.0]
    }
}

impl MotionModel for Native {
    type Prepared = Slices;

    fn prepare(&self, raw: &StoredParams) -> Slices {
        let (count, turning) = (raw.len(), if self.has_4d_rotation { raw.len() } else { 0 });
        let mut slices = Slices {
            velocity: [0, 1, 2].map(|_| vec![0.0; count]),
            rates: vec![0.0; count],
            inverse_odds: raw.gaussians.opacity_logit.plane(0).iter().map(|&logit| inverse_odds(logit)).collect(),
            rotation: AttributeValues::zeros(4, turning),
            log_scale: AttributeValues::zeros(3, turning),
        };
        for i in 0..count {
            let Slice { velocity, variance, covariance } = self.slice(raw, i);
            (0..3).for_each(|c| slices.velocity[c][i] = velocity[c]);
            slices.rates[i] = self.rate(variance);
            if let Some(covariance) = covariance {
                let (scales, rotation) = scale_rotation(covariance, raw.gaussians.rotation_f64(i));
                slices.rotation.set_row(i, rotation.map(|q| q as f32));
                slices.log_scale.set_row(i, scales.map(|scale| scale.ln() as f32));
            }
        }
        slices
    }

    fn varying(&self) -> Attributes {
        let colors = if self.terms > 0 { Attributes::SH } else { Attributes::empty() };
        Attributes::POSITION | Attributes::OPACITY | colors
    }

    /// Returns the attributes that the optimizer can change. Excludes scales and rotations of Gaussians with a 4D
    /// rotation: they follow from the 4D scales and rotation together.
    fn movable(&self) -> Attributes {
        let mixed =
            if self.has_4d_rotation { Attributes::ROTATION | Attributes::LOG_SCALE } else { Attributes::empty() };
        Attributes::all().difference(mixed)
    }

    #[inline(always)]
    fn state(
        &self,
        time: f64,
        raw: &StoredParams,
        slices: &Slices,
        want: Attributes,
        out: &mut Gaussians,
    ) -> Result<()> {
        let centers = raw.format_specific.plane(TIME);
        let mixed =
            if self.has_4d_rotation { Attributes::ROTATION | Attributes::LOG_SCALE } else { Attributes::empty() };
        copy_stored(raw, want.difference(Attributes::POSITION | Attributes::OPACITY | mixed), out);
        if (want & mixed).contains(Attributes::ROTATION) {
            out.rotation.planes_mut().copy_from_slice(slices.rotation.planes());
        }
        if (want & mixed).contains(Attributes::LOG_SCALE) {
            out.log_scale.planes_mut().copy_from_slice(slices.log_scale.planes());
        }
        if want.contains(Attributes::POSITION) {
            for (c, velocity) in slices.velocity.iter().enumerate() {
                let from = raw.gaussians.position.plane(c).iter().zip(velocity).zip(centers);
                out.position.plane_mut(c).iter_mut().zip(from).for_each(|(to, ((&x, &velocity), &center))| {
                    *to = (f64::from(x) + velocity * (time - f64::from(center))) as f32;
                });
            }
        }
        if want.contains(Attributes::OPACITY) {
            let log_cutoff = MIN_MARGINAL.ln();
            let from = centers.iter().zip(&slices.rates).zip(&slices.inverse_odds);
            out.opacity_logit.plane_mut(0).iter_mut().zip(from).for_each(|(to, ((&center, &rate), &inverse_odds))| {
                let exponent = rate * (time - f64::from(center)).powi(2);
                let drawn = faded_logit(inverse_odds, exponent);
                *to = if exponent > log_cutoff { drawn } else { -MAX_LOGIT } as f32;
            });
        }
        if want.contains(Attributes::SH) && self.terms > 0 {
            let waves = centers.iter().map(|&center| self.waves(time, f64::from(center)));
            let waves: (Vec<f64>, Vec<f64>) = waves.map(|[first, second]| (first, second)).unzip();
            for (term, waves) in [waves.0, waves.1].iter().enumerate().take(self.terms) {
                for c in 0..out.sh.width() {
                    let by = raw.format_specific.plane(TERMS + term * TERM_WIDTH + c).iter().zip(waves);
                    out.sh.plane_mut(c).iter_mut().zip(by).for_each(|(to, (&by, &wave))| {
                        *to += (wave * f64::from(by)) as f32;
                    });
                }
            }
        }
        Ok(())
    }

    fn jacobian(&self, time: f64, raw: &StoredParams, slices: &Slices, want: Attributes) -> Result<Jacobian> {
        let mut jacobian = Jacobian::default();
        if want.contains(Attributes::OPACITY) {
            let log_cutoff = MIN_MARGINAL.ln();
            let windows = raw.format_specific.plane(TIME).iter().zip(&slices.rates).zip(&slices.inverse_odds);
            let slopes = windows.map(|((&center, &rate), &inverse_odds)| {
                let exponent = rate * (time - f64::from(center)).powi(2);
                if exponent > log_cutoff { slope(inverse_odds, exponent) as f32 } else { 0.0 }
            });
            *jacobian.derivative_mut(Attributes::OPACITY) = AttributeValues::from_planes(1, slopes.collect());
        }
        Ok(jacobian)
    }
}
