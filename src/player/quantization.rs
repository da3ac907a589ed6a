//! Quantization of frame states for the page that plays a scene. Every value becomes the nearest point of a grid, so
//! that differences between frames are small integers that repeat.
//!
//! Input: the Gaussians of one frame. Output: their values as multiples of quantization steps (i32). The output
//! consists of planes, one after another; a plane has one scalar component (such as the x of the position) of all
//! Gaussians. Memory: one plane per component.

use std::ops::Range;

use serde::Serialize;

use crate::error::Result;
use crate::files::accuracy::{CodingErrors, RenderedAttributes};
use crate::model::{AttributeValues, Attributes, Gaussians, opacity, sh_coefficient_count};

/// Quantization steps of the values on the player page. Each stored value differs from the original by at most half a
/// step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PlayerSteps {
    /// Quantization step of positions, scene units.
    pub position: f64,
    /// Quantization step of the components of unit quaternions.
    pub rotation: f64,
    /// Quantization step of the natural logarithms of scales.
    pub log_scale: f64,
    /// Quantization step of opacities, which are in [0, 1].
    pub opacity: f64,
    /// Quantization step of SH coefficients.
    pub sh: f64,
}

/// Number of binary digits of a position. The quantization step of positions is 2^−14 · E, where E is the scene extent
/// rounded down to a power of two. In a render of the whole scene on 800 pixels, positions are off by at most a
/// fortieth of a pixel.
const POSITION_BITS: i32 = 14;
/// Largest absolute value of a log scale on the player page, as in the rasterizer; other values are clamped.
const LOGARITHM_LIMIT: f32 = 80.0;
/// Largest absolute SH coefficient, in quantization steps: the player page stores coefficients in 16 bits.
const SH_LIMIT: f64 = 32767.0;
/// Largest absolute value of a position coordinate, in quantization steps.
const POSITION_LIMIT: f64 = (1 << 30) as f64;

impl PlayerSteps {
    /// Returns the quantization steps for a scene of the extent `extent` (scene units). The steps are powers of two, so
    /// that grid points are exact in any precision.
    ///
    /// Only the position step depends on the extent. The others were chosen by renders: with them, two trained models
    /// (`deform2`, `room2_big`) reach over 50 dB PSNR against unquantized renders.
    pub fn from_extent(extent: f64) -> PlayerSteps {
        let position = extent.log2().floor() as i32 - POSITION_BITS;
        PlayerSteps {
            position: f64::from(position.clamp(-100, 100)).exp2(),
            rotation: 1.0 / 2048.0,
            log_scale: 1.0 / 128.0,
            opacity: 1.0 / 1024.0,
            sh: 1.0 / 128.0,
        }
    }
}

/// Returns the range of indices of the attribute `column` among all scalar components of a Gaussian with SH degree
/// `sh_degree`. The attributes are in the order position, rotation, log scale, opacity, SH.
pub fn component_range(column: Attributes, sh_degree: usize) -> Range<usize> {
    let width = |column: Attributes| column.width(sh_degree);
    let before = Attributes::all().iter().take_while(|&other| other != column).map(width).sum();
    before..before + width(column)
}

/// Returns the number of scalar components of all attributes of a Gaussian with SH degree `sh_degree`.
pub fn component_count(sh_degree: usize) -> usize {
    11 + 3 * sh_coefficient_count(sh_degree)
}

/// Quantizes the attributes `which` of `state`: writes them as multiples of their quantization steps into `points`,
/// `[components, N]`. Leaves the other attributes in `points` as they are. Returns the number of Gaussians that become
/// invisible.
///
/// - Quaternions are normalized. A quaternion and its negative are the same rotation; the one that is closer to the
///   quaternion of the previous frame, which `points` still holds, is written.
/// - A Gaussian gets opacity 0, and is invisible, if one of its values is NaN or if a coordinate of its position is at
///   least [`POSITION_LIMIT`] quantization steps away from 0.
///
/// # Panics
/// Panics if `points` has fewer than components × N values.
pub fn quantize_into(state: &Gaussians, which: Attributes, steps: &PlayerSteps, points: &mut [i32]) -> usize {
    let (count, degree) = (state.len(), state.sh_degree());
    let of = |column: Attributes| {
        let range = component_range(column, degree);
        range.start * count..range.end * count
    };
    let plain = |column: &AttributeValues, points: &mut [i32], point: &dyn Fn(f32) -> i32| {
        points.iter_mut().zip(column.planes()).for_each(|(to, &value)| *to = point(value));
    };
    if which.contains(Attributes::POSITION) {
        plain(&state.position, &mut points[of(Attributes::POSITION)], &|x| nearest(x.into(), steps.position));
    }
    if which.contains(Attributes::ROTATION) {
        quantize_rotations(&state.rotation, steps.rotation, &mut points[of(Attributes::ROTATION)]);
    }
    if which.contains(Attributes::LOG_SCALE) {
        let point = |x: f32| nearest(x.clamp(-LOGARITHM_LIMIT, LOGARITHM_LIMIT).into(), steps.log_scale);
        plain(&state.log_scale, &mut points[of(Attributes::LOG_SCALE)], &point);
    }
    if which.contains(Attributes::SH) {
        let limit = SH_LIMIT * steps.sh;
        let point = |x: f32| nearest(f64::from(x).clamp(-limit, limit), steps.sh);
        plain(&state.sh, &mut points[of(Attributes::SH)], &point);
    }
    let mut unseen = 0;
    if which.intersects(Attributes::POSITION | Attributes::OPACITY) {
        let far = POSITION_LIMIT * steps.position;
        for (i, to) in points[of(Attributes::OPACITY)].iter_mut().enumerate() {
            let [logit] = state.opacity_logit.row(i);
            let position: [f32; 3] = state.position.row(i);
            let shape = [&state.rotation, &state.log_scale, &state.sh];
            let is_finite = shape.iter().all(|column| (0..column.width()).all(|c| !column.plane(c)[i].is_nan()));
            let is_seen = is_finite && !logit.is_nan() && position.iter().all(|x| f64::from(x.abs()) < far);
            *to = if is_seen { nearest(opacity(logit), steps.opacity) } else { 0 };
            unseen += usize::from(!is_seen);
        }
    }
    unseen
}

/// Checks that the quantized positions in `points` are close to the positions of `state`. `points` holds all attributes
/// of `state` as multiples of the quantization steps `steps`, with SH up to `sh_degree`.
///
/// # Errors
/// Fails if a visible Gaussian moved further than [`accuracy`](crate::files::accuracy) allows.
pub fn check_positions(state: &Gaussians, sh_degree: usize, steps: &PlayerSteps, points: &[i32]) -> Result<()> {
    let count = state.len();
    let mut accuracy = CodingErrors::new(&state.position);
    let opacities = component_range(Attributes::OPACITY, sh_degree).start * count;
    for row in (0..count).filter(|row| points[opacities + row] > 0) {
        let wanted = RenderedAttributes { color: [0.0; 3], ..RenderedAttributes::from_state(state, row) };
        let position = [0, 1, 2].map(|axis| f64::from(points[axis * count + row]) * steps.position);
        accuracy.add(row, &wanted, &RenderedAttributes { position, ..wanted });
    }
    accuracy.check("a page")
}

/// Returns the integer k for which k · `step` is nearest to `value`; 0 for NaN.
fn nearest(value: f64, step: f64) -> i32 {
    (value / step).round_ties_even() as i32
}

/// Normalizes the quaternions `rotation` and writes them as multiples of `step` into `points`, which holds the
/// quaternions of the previous frame (zeros before the first frame). A quaternion and its negative are the same
/// rotation; the one closer to the previous quaternion is written. Without this choice, a jump of the sign would make
/// differences between frames large.
fn quantize_rotations(rotation: &AttributeValues, step: f64, points: &mut [i32]) {
    let count = rotation.len();
    for i in 0..count {
        let q: [f32; 4] = rotation.row(i);
        let q = q.map(f64::from);
        let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        // A zero quaternion is the identity, as in the rasterizer.
        let unit = if length > 0.0 { q.map(|x| x / length) } else { [1.0, 0.0, 0.0, 0.0] };
        let before: [f64; 4] = std::array::from_fn(|c| f64::from(points[c * count + i]));
        let along: f64 = unit.iter().zip(before).map(|(a, b)| a * b).sum();
        let side = if along < 0.0 || (along == 0.0 && unit[0] < 0.0) { -1.0 } else { 1.0 };
        for (c, x) in unit.iter().enumerate() {
            points[c * count + i] = nearest(side * x, step);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::model::AttributeValues;

    /// Returns the quantization step of the scalar component with the index `component`.
    fn step_of(component: usize, steps: &PlayerSteps) -> f64 {
        match component {
            0..3 => steps.position,
            3..7 => steps.rotation,
            7..10 => steps.log_scale,
            10 => steps.opacity,
            _ => steps.sh,
        }
    }

    fn gaussians(values: [Vec<f32>; 5]) -> Gaussians {
        let [position, rotation, log_scale, opacity_logit, sh] = values;
        Gaussians {
            position: AttributeValues::from_planes(3, position),
            rotation: AttributeValues::from_planes(4, rotation),
            log_scale: AttributeValues::from_planes(3, log_scale),
            opacity_logit: AttributeValues::from_planes(1, opacity_logit),
            sh: AttributeValues::from_planes(12, sh),
        }
    }

    proptest! {
        #[test]
        fn every_value_is_within_half_a_step_of_its_point(
            position in prop::collection::vec(-50f32..50.0, 6), rotation in prop::collection::vec(-2f32..2.0, 8),
            log_scale in prop::collection::vec(-9f32..3.0, 6), logit in prop::collection::vec(-9f32..9.0, 2),
            sh in prop::collection::vec(-3f32..3.0, 24), extent in 0.01f64..1e4,
        ) {
            let state = gaussians([position, rotation.clone(), log_scale, logit, sh]);
            let steps = PlayerSteps::from_extent(extent);
            prop_assert!(steps.position <= extent / 16384.0 && steps.position > extent / 32768.0);
            let mut points = vec![0; 2 * component_count(1)];
            prop_assert_eq!(quantize_into(&state, Attributes::all(), &steps, &mut points), 0);
            for i in 0..2 {
                let q: [f64; 4] = std::array::from_fn(|c| f64::from(rotation[2 * c + i]));
                let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
                let side = if q[0] < 0.0 { -1.0 } else { 1.0 };
                for component in 0..component_count(1) {
                    let value = match component {
                        0..3 => state.position.plane(component)[i].into(),
                        3..7 => side * q[component - 3] / length,
                        7..10 => state.log_scale.plane(component - 7)[i].into(),
                        10 => 1.0 / (1.0 + (-f64::from(state.opacity_logit.plane(0)[i])).exp()),
                        _ => state.sh.plane(component - 11)[i].into(),
                    };
                    let step = step_of(component, &steps);
                    let off = (f64::from(points[2 * component + i]) * step - value).abs();
                    prop_assert!(off <= 0.5 * step * (1.0 + 1e-9), "component {}: {} of {}", component, off, step);
                }
            }
        }
    }

    #[test]
    fn quaternions_keep_their_sign_and_odd_gaussians_are_invisible() {
        let steps = PlayerSteps::from_extent(1.0);
        let mut state = Gaussians::zeros(4, 0);
        let mut points = vec![0; 4 * component_count(0)];
        (0..4).for_each(|i| state.rotation.set_row(i, [-0.1, 0.995, 0.0, 0.0]));
        quantize_into(&state, Attributes::all(), &steps, &mut points);
        assert!(points[3 * 4] > 0 && points[4 * 4] < 0, "{points:?}");
        // With the other sign the next rotation would be a jump.
        state.rotation.set_row(0, [-0.1, -0.995, 0.0, 0.0]);
        state.rotation.set_row(1, [0.0; 4]);
        quantize_into(&state, Attributes::ROTATION, &steps, &mut points);
        assert!(points[3 * 4] < 0 && points[4 * 4] < 0);
        assert_eq!([points[13], points[17]], [2048, 0]);
        state.position.set_row(1, [f32::NAN, 0.0, 0.0]);
        state.position.set_row(2, [1e30, 0.0, 0.0]);
        state.log_scale.set_row(3, [0.0, f32::NAN, 0.0]);
        assert_eq!(quantize_into(&state, Attributes::all(), &steps, &mut points), 3);
        assert_eq!(points[40..44], [512, 0, 0, 0]);
    }
}
