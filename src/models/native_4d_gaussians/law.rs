//! Gaussians of four dimensions, of which every instant is a slice.
//!
//! Σ₄ = R₄ diag(s)² R₄ᵀ; v = Σ₁₂/Σ_tt; x(t) = x + v·(t − μ); Σ = Σ₁₁ − Σ₁₂Σ₂₁/Σ_tt, the same at all times;
//! m = exp(−½(t − μ)²/Σ_tt); opacity = σ(o)·m, and 0 where m ≤ .05. Without a rotation of four dimensions v = 0, Σ is that of
//! `scaling` and `rotation`, and Σ_tt = exp(scaling_t), not its square. Harmonics: c_k + cos(2π(μ − t)/L)·c₁₆₊ₖ +
//! cos(4π(μ − t)/L)·c₃₂₊ₖ. Everything is in f64: in f32 a fast, small Gaussian that lasts long would lose Σ.
//! Source: `computeCov3D_conditional`, `get_marginal_t`, `eval_shfs_4d` of the repository (fudan-zvg). Its rasteriser sees
//! harmonics from the side of x, the one here from that of x(t).

use std::f64::consts::TAU;

use super::rotation::{covariance, rotation};
use crate::error::Result;
use crate::model::{Column, Columns, Gaussians, Jacobian, Raw, scale_rotation};
use crate::models::motion_model::window::{MOST, faded, odds, slope};
use crate::models::motion_model::{MotionModel, copy_stored};

/// Planes of [`Raw::own`]: μ, the logarithm of the scale along time, the right quaternion, harmonics in time term by term.
pub(super) const TIME: usize = 0;
pub(super) const SCALING_T: usize = 1;
pub(super) const ROTATION_R: usize = 2;
pub(super) const TERMS: usize = 6;
/// Planes of a term of harmonics of degree 3.
pub(super) const TERM: usize = 48;

/// The marginal up to which a Gaussian is not drawn.
const CUT: f64 = 0.05;

/// The law of the family.
#[derive(Debug, Clone)]
pub(super) struct Native {
    /// Whether it turns in four dimensions; else time stands alone.
    pub(super) turns: bool,
    /// Whether both axes of the rotation are reversed.
    pub(super) flipped: bool,
    /// What is added to Σ_tt in the marginal.
    pub(super) prefilter: f64,
    /// Terms of harmonics in time.
    pub(super) terms: usize,
    /// L as the user gives it.
    pub(super) given: Option<f64>,
    /// L.
    pub(super) period: f64,
}

/// What follows from raw parameters for all times.
#[derive(Debug)]
pub(super) struct Slices {
    /// A plane for each axis.
    velocity: [Vec<f64>; 3],
    /// −1/(2 Σ_tt), with the prefilter.
    rates: Vec<f64>,
    odds: Vec<f64>,
    /// Of Σ, where it turns in four dimensions.
    rotation: Column,
    log_scale: Column,
}

/// Of one Gaussian.
pub(super) struct Slice {
    pub(super) velocity: [f64; 3],
    /// Σ_tt.
    pub(super) variance: f64,
    /// Σ: xx xy xz yy yz zz; none: that of the raw scales and rotation.
    pub(super) covariance: Option<[f64; 6]>,
}

impl Native {
    /// What follows for row `i`.
    pub(super) fn slice(&self, raw: &Raw, i: usize) -> Slice {
        let along = f64::from(raw.own.plane(SCALING_T)[i]);
        if !self.turns {
            return Slice { velocity: [0.0; 3], variance: along.exp(), covariance: None };
        }
        let [l, r] = [raw.gaussians.rotation.row::<4>(i), [0, 1, 2, 3].map(|c| raw.own.plane(ROTATION_R + c)[i])];
        let [x, y, z] = raw.gaussians.log_scale.row::<3>(i).map(f64::from);
        let whole =
            covariance(&rotation([l.map(f64::from), r.map(f64::from)], self.flipped), [x, y, z, along].map(f64::exp));
        let variance = whole[3][3];
        // A Gaussian as short as nothing does not move.
        let velocity = [0, 1, 2].map(|c| if variance > 0.0 { whole[c][3] / variance } else { 0.0 });
        let entry = |i: usize, j: usize| whole[i][j] - velocity[i] * whole[3][j];
        let covariance = [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)];
        Slice { velocity, variance, covariance: Some(covariance) }
    }

    fn rate(&self, variance: f64) -> f64 {
        -0.5 / (variance + self.prefilter.max(0.0))
    }

    /// What is left at `time` of a Gaussian with that center and Σ_tt.
    pub(super) fn marginal(&self, time: f64, center: f64, variance: f64) -> f64 {
        let m = (self.rate(variance) * (time - center).powi(2)).exp();
        if m > CUT { m } else { 0.0 }
    }

    /// cos(2π(μ − t)/L) and its double.
    pub(super) fn waves(&self, time: f64, center: f64) -> [f64; 2] {
        let wave = (TAU * (center - time) / self.period).cos();
        [wave, 2.0 * wave * wave - 1.0]
    }
}

impl MotionModel for Native {
    type Prepared = Slices;

    fn prepare(&self, raw: &Raw) -> Slices {
        let (count, turning) = (raw.len(), if self.turns { raw.len() } else { 0 });
        let mut slices = Slices {
            velocity: [0, 1, 2].map(|_| vec![0.0; count]),
            rates: vec![0.0; count],
            odds: raw.gaussians.opacity_logit.plane(0).iter().map(|&logit| odds(logit)).collect(),
            rotation: Column::zeros(4, turning),
            log_scale: Column::zeros(3, turning),
        };
        for i in 0..count {
            let Slice { velocity, variance, covariance } = self.slice(raw, i);
            (0..3).for_each(|c| slices.velocity[c][i] = velocity[c]);
            slices.rates[i] = self.rate(variance);
            if let Some(covariance) = covariance {
                let (scales, rotation) = scale_rotation(covariance, raw.gaussians.rotation.row(i).map(f64::from));
                slices.rotation.set_row(i, rotation.map(|q| q as f32));
                slices.log_scale.set_row(i, scales.map(|scale| scale.ln() as f32));
            }
        }
        slices
    }

    fn varying(&self) -> Columns {
        let colors = if self.terms > 0 { Columns::SH } else { Columns::empty() };
        Columns::POSITION | Columns::OPACITY | colors
    }

    /// Scales and rotations follow from those of four dimensions together.
    fn movable(&self) -> Columns {
        let mixed = if self.turns { Columns::ROTATION | Columns::LOG_SCALE } else { Columns::empty() };
        Columns::all().difference(mixed)
    }

    #[inline(always)]
    fn state(&self, time: f64, raw: &Raw, slices: &Slices, want: Columns, out: &mut Gaussians) -> Result<()> {
        let centers = raw.own.plane(TIME);
        let mixed = if self.turns { Columns::ROTATION | Columns::LOG_SCALE } else { Columns::empty() };
        copy_stored(raw, want.difference(Columns::POSITION | Columns::OPACITY | mixed), out);
        if (want & mixed).contains(Columns::ROTATION) {
            out.rotation.planes_mut().copy_from_slice(slices.rotation.planes());
        }
        if (want & mixed).contains(Columns::LOG_SCALE) {
            out.log_scale.planes_mut().copy_from_slice(slices.log_scale.planes());
        }
        if want.contains(Columns::POSITION) {
            for (c, velocity) in slices.velocity.iter().enumerate() {
                let from = raw.gaussians.position.plane(c).iter().zip(velocity).zip(centers);
                out.position.plane_mut(c).iter_mut().zip(from).for_each(|(to, ((&x, &velocity), &center))| {
                    *to = (f64::from(x) + velocity * (time - f64::from(center))) as f32;
                });
            }
        }
        if want.contains(Columns::OPACITY) {
            let cut = CUT.ln();
            let from = centers.iter().zip(&slices.rates).zip(&slices.odds);
            out.opacity_logit.plane_mut(0).iter_mut().zip(from).for_each(|(to, ((&center, &rate), &odds))| {
                let exponent = rate * (time - f64::from(center)).powi(2);
                let drawn = faded(odds, exponent);
                *to = if exponent > cut { drawn } else { -MOST } as f32;
            });
        }
        if want.contains(Columns::SH) && self.terms > 0 {
            let waves = centers.iter().map(|&center| self.waves(time, f64::from(center)));
            let waves: (Vec<f64>, Vec<f64>) = waves.map(|[first, second]| (first, second)).unzip();
            for (term, waves) in [waves.0, waves.1].iter().enumerate().take(self.terms) {
                for c in 0..out.sh.width() {
                    let by = raw.own.plane(TERMS + term * TERM + c).iter().zip(waves);
                    out.sh.plane_mut(c).iter_mut().zip(by).for_each(|(to, (&by, &wave))| {
                        *to += (wave * f64::from(by)) as f32;
                    });
                }
            }
        }
        Ok(())
    }

    fn jacobian(&self, time: f64, raw: &Raw, slices: &Slices, want: Columns) -> Result<Jacobian> {
        let mut jacobian = Jacobian::default();
        if want.contains(Columns::OPACITY) {
            let cut = CUT.ln();
            let of = raw.own.plane(TIME).iter().zip(&slices.rates).zip(&slices.odds);
            let slopes = of.map(|((&center, &rate), &odds)| {
                let exponent = rate * (time - f64::from(center)).powi(2);
                if exponent > cut { slope(odds, exponent) as f32 } else { 0.0 }
            });
            *jacobian.column_mut(Columns::OPACITY) = Column::from_planes(1, slopes.collect());
        }
        Ok(jacobian)
    }
}
