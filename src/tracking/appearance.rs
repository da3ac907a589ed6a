//! Appearance of a Gaussian (size, shape, opacity, base color), as far as tracking compares it between frames, and the
//! cost of a difference in appearance.

use rayon::prelude::*;

use crate::model::{AttributeValues, Gaussians, SH_C0};

/// Largest magnitude of the natural log of a scale. Larger ones are clamped to this value, so that squares of scales
/// stay finite in f32.
const MAX_LOG_SCALE: f32 = 30.0;
/// Difference in size that adds 1 to the difference in appearance A of two Gaussians, as the natural log of the ratio
/// of their sizes. A is the sum of (difference / unit)² over size, shape, opacity and color; the other units follow.
const SIZE_UNIT: f32 = std::f32::consts::LN_2 / 2.0;
const SHAPE_UNIT: f32 = 0.25;
const OPACITY_UNIT: f32 = 0.5;
const COLOR_UNIT: f32 = 0.1;
/// Parameters of the cost by which two Gaussians are near-duplicates ([`ComparedAppearance::distance_cost`]):
/// `DUPLICATE_REACH` is the distance, in sizes of the smaller Gaussian, that adds 1 to the cost; `DUPLICATE_STRICTNESS`
/// is the factor by which the difference in appearance is multiplied.
const DUPLICATE_REACH: f32 = 0.25;
const DUPLICATE_STRICTNESS: f32 = 4.0;

/// Position and appearance of a Gaussian at one frame, as far as tracking compares them.
#[derive(Debug, Clone, Copy)]
pub(super) struct ComparedAppearance {
    /// Position, scene units.
    pub(super) position: [f32; 3],
    /// Size: root mean square of the three scales, scene units. `ln_size` is its natural log.
    pub(super) size: f32,
    pub(super) ln_size: f32,
    /// Shape: covariance divided by its trace, as xx, yy, zz, and √2 times xy, xz, yz. With the factor √2, the squared
    /// distance of two shapes equals the squared distance of the two 3×3 matrices.
    shape: [f32; 6],
    opacity: f32,
    /// Base color (without view dependence): red, green, blue; 0 to 1 is the range of a screen.
    color: [f32; 3],
    /// Hash of the bits of position, rotation, scales, opacity and base color.
    pub(super) bits: u64,
}

impl ComparedAppearance {
    /// Returns the appearance of every Gaussian of the frame `state`, in the order of the Gaussians.
    pub(super) fn all_from_state(state: &Gaussians) -> Vec<ComparedAppearance> {
        (0..state.len())
            .into_par_iter()
            .with_min_len(4096)
            .map(|i| ComparedAppearance::from_gaussian(state, i))
            .collect()
    }

    fn from_gaussian(state: &Gaussians, i: usize) -> ComparedAppearance {
        let row = |column: &AttributeValues| column.row::<3>(i);
        let (position, rotation, log_scale) = (row(&state.position), state.rotation.row::<4>(i), row(&state.log_scale));
        let (logit, dc) = (state.opacity_logit.row::<1>(i), row(&state.sh));
        let values = position.iter().chain(&rotation).chain(&log_scale).chain(&logit).chain(&dc);
        let bits = values.fold(0x9e37_79b9_7f4a_7c15, |hash, value| mix(hash ^ u64::from(value.to_bits())));
        // A NaN stays NaN and fails every comparison.
        let variance = log_scale.map(|log| (2.0 * log.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)).exp());
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

    /// Returns a copy with `position` (x, y, z in scene units) as position; all other values stay the same.
    pub(super) fn at(self, position: [f32; 3]) -> ComparedAppearance {
        ComparedAppearance { position, ..self }
    }

    /// Returns the sum of the three color channels. If a grid cell holds too many Gaussians to compare with all of
    /// them, those with the nearest brightness are compared.
    pub(super) fn brightness(&self) -> f32 {
        self.color.iter().sum()
    }

    /// Returns the difference in appearance A between this Gaussian and `other`: the sum of (difference / unit)² over
    /// size, shape, opacity and color, with the units [`SIZE_UNIT`], [`SHAPE_UNIT`], [`OPACITY_UNIT`] and
    /// [`COLOR_UNIT`]. The difference in size is the natural log of the ratio of the sizes. A is symmetric.
    pub(super) fn difference(&self, other: &ComparedAppearance) -> f32 {
        let opacity = (self.opacity - other.opacity) / OPACITY_UNIT;
        self.difference_without_opacity(other) + opacity * opacity
    }

    /// Returns whether this Gaussian and `other` are near-duplicates: their distance is at most a quarter of the
    /// smaller size, and they differ little in size, shape and color. Opacity is not compared.
    pub(super) fn is_near_duplicate(&self, other: &ComparedAppearance) -> bool {
        self.distance_cost(other, DUPLICATE_REACH, DUPLICATE_STRICTNESS) <= 1.0
    }

    /// Returns the cost |x_b − x_a|² / (r·min(s_a, s_b))² + q·A of joining Gaussian a (this one) and Gaussian b
    /// (`other`). x are positions, s sizes, and A is the difference in size, shape and color. `reach` is r,
    /// `strictness` is q. If the first term alone exceeds 1, returns only this term.
    pub(super) fn distance_cost(&self, other: &ComparedAppearance, reach: f32, strictness: f32) -> f32 {
        let unit = reach * self.size.min(other.size);
        let distance = squared_distance(&self.position, &other.position) / (unit * unit);
        // Most Gaussians in the cells of a grid are too far away; their difference in appearance is not computed.
        if distance > 1.0 { distance } else { distance + strictness * self.difference_without_opacity(other) }
    }

    /// Returns the difference in appearance without opacity between this Gaussian and `other`: the sum of (difference /
    /// unit)² over size, shape and color, with the units [`SIZE_UNIT`], [`SHAPE_UNIT`] and [`COLOR_UNIT`].
    fn difference_without_opacity(&self, other: &ComparedAppearance) -> f32 {
        let size = (self.ln_size - other.ln_size) / SIZE_UNIT;
        size * size
            + squared_distance(&self.shape, &other.shape) / (SHAPE_UNIT * SHAPE_UNIT)
            + squared_distance(&self.color, &other.color) / (COLOR_UNIT * COLOR_UNIT)
    }
}

fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Returns a hash of `x`. Two times, `x` is combined with its upper half by exclusive or (a shift by 32 bits) and
/// multiplied by an odd constant modulo 2⁶⁴. Both steps are bijections, so different numbers have different hashes.
pub(super) fn mix(x: u64) -> u64 {
    let x = (x ^ (x >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    (x ^ (x >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93)
}

/// Returns six entries of the symmetric matrix R·diag(v)·Rᵀ: xx, yy, zz, and √2 times xy, xz and yz. R is the rotation
/// of the wxyz quaternion, which may have any length; a zero quaternion is the identity.
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
