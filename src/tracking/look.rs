//! What is compared of a Gaussian, and what a difference costs.

use rayon::prelude::*;

use crate::model::{Column, Gaussians, SH_C0};

/// Natural logs of scales beyond this are taken as it: their squares stay finite in f32.
const MOST_LOG_SCALE: f32 = 30.0;
/// Differences that cost 1 each.
const SIZE_UNIT: f32 = std::f32::consts::LN_2 / 2.0;
const SHAPE_UNIT: f32 = 0.25;
const OPACITY_UNIT: f32 = 0.5;
const COLOUR_UNIT: f32 = 0.1;
/// r and q of the [module](super) for twins.
const TWIN_REACH: f32 = 0.25;
const TWIN_STRICTNESS: f32 = 4.0;

/// What is compared of a Gaussian at a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct ComparedAppearance {
    /// Scene units.
    pub(super) position: [f32; 3],
    /// Root mean square of the scales, scene units, and its natural log.
    pub(super) size: f32,
    pub(super) ln_size: f32,
    /// Covariance over its trace: xx, yy, zz, and √2 times xy, xz, yz, so that squares sum to those of the matrix.
    shape: [f32; 6],
    opacity: f32,
    /// Red, green, blue; 0 to 1 for what a screen shows.
    color: [f32; 3],
    /// Hash of the bits of everything that enters.
    pub(super) bits: u64,
}

impl ComparedAppearance {
    /// Those of all Gaussians of a frame.
    pub(super) fn of_all(state: &Gaussians) -> Vec<ComparedAppearance> {
        (0..state.len()).into_par_iter().with_min_len(4096).map(|i| ComparedAppearance::from_state(state, i)).collect()
    }

    fn from_state(state: &Gaussians, i: usize) -> ComparedAppearance {
        let row = |column: &Column| column.row::<3>(i);
        let (position, rotation, log_scale) = (row(&state.position), state.rotation.row::<4>(i), row(&state.log_scale));
        let (logit, dc) = (state.opacity_logit.row::<1>(i), row(&state.sh));
        let values = position.iter().chain(&rotation).chain(&log_scale).chain(&logit).chain(&dc);
        let bits = values.fold(0x9e37_79b9_7f4a_7c15, |hash, value| mix(hash ^ u64::from(value.to_bits())));
        // NaN stays NaN, which no comparison takes.
        let variance = log_scale.map(|log| (2.0 * log.clamp(-MOST_LOG_SCALE, MOST_LOG_SCALE)).exp());
        let trace: f32 = variance.iter().sum();
        let size = (trace / 3.0).sqrt();
        ComparedAppearance {
            position,
            size,
            ln_size: size.ln(),
            shape: shape(rotation, variance.map(|v| v / trace)),
            opacity: 1.0 / (1.0 + (-logit[0]).exp()),
            color: dc.map(|dc| 0.5 + SH_C0 as f32 * dc),
            bits,
        }
    }

    /// The same elsewhere.
    pub(super) fn at(self, position: [f32; 3]) -> ComparedAppearance {
        ComparedAppearance { position, ..self }
    }

    /// What tells those of a crowded cell apart.
    pub(super) fn brightness(&self) -> f32 {
        self.color.iter().sum()
    }

    /// A of the [module](super), symmetric.
    pub(super) fn unlike(&self, other: &ComparedAppearance) -> f32 {
        let opacity = (self.opacity - other.opacity) / OPACITY_UNIT;
        self.unlike_but_opacity(other) + opacity * opacity
    }

    /// Whether both are one to the eye, but for their opacity: in the same place by what the first round calls it.
    pub(super) fn is_near_duplicate(&self, other: &ComparedAppearance) -> bool {
        self.apart(other, TWIN_REACH, TWIN_STRICTNESS) <= 1.0
    }

    /// |x_b − x_a|² / (r·min(s_a, s_b))² + q·A of the [module](super), opacities aside, with r the `reach` and q the
    /// `strictness`; more than 1 where that is too much, whatever it is.
    pub(super) fn apart(&self, other: &ComparedAppearance, reach: f32, strictness: f32) -> f32 {
        let unit = reach * self.size.min(other.size);
        let apart = squared(&self.position, &other.position) / (unit * unit);
        // Most of those in the cells of a grid are too far away.
        if apart > 1.0 { apart } else { apart + strictness * self.unlike_but_opacity(other) }
    }

    /// A without opacities.
    fn unlike_but_opacity(&self, other: &ComparedAppearance) -> f32 {
        let size = (self.ln_size - other.ln_size) / SIZE_UNIT;
        size * size
            + squared(&self.shape, &other.shape) / (SHAPE_UNIT * SHAPE_UNIT)
            + squared(&self.color, &other.color) / (COLOUR_UNIT * COLOUR_UNIT)
    }
}

fn squared(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// A bijection whose every bit follows from all below it and, by the shift, from those above
/// (S. Vigna, splitmix64, 2015, one round).
pub(super) fn mix(x: u64) -> u64 {
    let x = (x ^ (x >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    (x ^ (x >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93)
}

/// R·diag(v)·Rᵀ of a wxyz quaternion of any length; a zero one turns nothing.
fn shape(quaternion: [f32; 4], v: [f32; 3]) -> [f32; 6] {
    let length = quaternion.iter().map(|x| x * x).sum::<f32>();
    let [w, x, y, z] = if length == 0.0 { [1.0, 0.0, 0.0, 0.0] } else { quaternion };
    let s = 2.0 / if length == 0.0 { 1.0 } else { length };
    let r = [
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    ];
    let entry = |a: usize, b: usize| (0..3).map(|k| r[a][k] * v[k] * r[b][k]).sum::<f32>();
    let root = std::f32::consts::SQRT_2;
    [entry(0, 0), entry(1, 1), entry(2, 2), root * entry(0, 1), root * entry(0, 2), root * entry(1, 2)]
}
