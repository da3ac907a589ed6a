//! Derivative of the projection: computes the gradients of the stored attributes of Gaussians from gradient sums, the
//! sums over the pixels of their splats ([`SplatSums`]).
//!
//! Gaussians are processed in blocks like in the projection, in f64 where the projection uses f64. The covariance of a
//! footprint is not inverted; instead, offsets in the footprint are expressed in its standard deviations. Very thin and
//! very large Gaussians then lose no digits that the projection kept (docs/method.md, section 8.1). Input: gradient
//! sums of splats. Output: gradients of Gaussians. Memory: stack arrays of [`BLOCK`] entries. Source of the projection:
//! Zwicker et al., "EWA Splatting", 2002. A variable `by_x` holds the derivative of the loss with respect to `x`.

use std::ops::Range;

use super::super::color;
use super::super::convention::BLOCK;
use super::super::project::{CameraTerms, LOGARITHM_LIMIT, ProjectedShape, Splat, cross, dot, opacity};
use super::sums::SplatSums;
use splat_core::{Attributes, Gaussians, GradientSpan, sh_coefficient_count, vectorized};

/// Computes the gradients of the Gaussians whose projections are `splats`, and adds them to `out`, which must contain
/// these Gaussians. `sums` holds the gradient sums of each splat.
pub(super) fn add_gradients(
    gaussians: &Gaussians,
    splats: &[Splat],
    sums: &[SplatSums<f64>],
    view: &CameraTerms,
    out: &mut GradientSpan,
) {
    vectorized(
        #[inline(always)]
        || add_blocks(gaussians, splats, sums, view, out),
    );
}

/// Does the same as [`add_gradients`], for [`BLOCK`] Gaussians at a time. Inlined, so that each instruction set has its
/// own compiled version.
#[inline(always)]
fn add_blocks(
    gaussians: &Gaussians,
    splats: &[Splat],
    sums: &[SplatSums<f64>],
    view: &CameraTerms,
    out: &mut GradientSpan<'_>,
) {
    let mut block = GradientBlock::default();
    let (mut splats, mut sums) = (splats, sums);
    for start in out.ids().step_by(BLOCK) {
        let ids = start..(start + BLOCK).min(out.ids().end);
        let count = splats[..splats.len().min(BLOCK)].partition_point(|splat| (splat.id as usize) < ids.end);
        if count == 0 {
            continue;
        }
        block.fill(&splats[..count], &sums[..count], start);
        (splats, sums) = (&splats[count..], &sums[count..]);
        let columns = out.attributes();
        let needs_direction = columns.contains(Attributes::POSITION) && color::coefficients(gaussians) > 1;
        if needs_direction || columns.contains(Attributes::SH) {
            let directions = Directions::new(gaussians, ids.clone(), view);
            if columns.contains(Attributes::SH) {
                block.add_sh_gradients(gaussians, ids.clone(), &directions, out);
            }
            if needs_direction {
                block.add_direction(gaussians, ids.clone(), &directions, out);
            }
        }
        if !Attributes::SH.contains(columns) {
            block.add_shape(gaussians, ids, view, out);
        }
    }
}

/// Directions from the camera to the Gaussians of a block, on which their colors depend.
struct Directions {
    /// Unit vectors from the camera center to the Gaussians.
    unit: [[f32; BLOCK]; 3],
    /// Reciprocals of the distances from the camera center to the Gaussians, 1 / scene unit.
    per_distance: [f32; BLOCK],
}

impl Directions {
    /// Computes the directions from the camera of `view` to the Gaussians `ids`.
    #[inline(always)]
    fn new(gaussians: &Gaussians, ids: Range<usize>, view: &CameraTerms) -> Self {
        let n = ids.len().min(BLOCK);
        let position: [&[f32]; 3] = std::array::from_fn(|c| &gaussians.position.plane(c)[ids.clone()][..n]);
        let mut directions = Directions { unit: [[0.0; BLOCK]; 3], per_distance: [0.0; BLOCK] };
        let Directions { unit: [x, y, z], per_distance } = &mut directions;
        for i in 0..n {
            let (unit, inverse) = color::direction([position[0][i], position[1][i], position[2][i]], view.center);
            (x[i], y[i], z[i]) = (unit[0], unit[1], unit[2]);
            per_distance[i] = inverse as f32;
        }
        directions
    }

    /// Returns the unit vector from the camera center to Gaussian `i` of the block.
    #[inline(always)]
    fn at(&self, i: usize) -> [f32; 3] {
        [self.unit[0][i], self.unit[1][i], self.unit[2][i]]
    }
}

/// Sums over pixels, for each Gaussian of a block, from which its gradients follow: the values of [`SplatSums`], or 0
/// for a Gaussian that is not visible.
struct GradientBlock {
    p: [f64; BLOCK],
    first: [[f64; BLOCK]; 2],
    second: [[f64; BLOCK]; 3],
    /// Derivatives of the loss with respect to the colors; 0 for channels that were clamped at 0.
    color: [[f32; BLOCK]; 3],
}

impl Default for GradientBlock {
    fn default() -> Self {
        let zero = [0.0; BLOCK];
        GradientBlock { p: zero, first: [zero; 2], second: [zero; 3], color: [[0.0; BLOCK]; 3] }
    }
}

impl GradientBlock {
    /// Sets the sums of the whole block: copies `sums`, the sums over pixels of each of the `splats` of the block, and
    /// sets the sums of all other Gaussians to 0. `start` is the index of the first Gaussian of the block.
    fn fill(&mut self, splats: &[Splat], sums: &[SplatSums<f64>], start: usize) {
        *self = GradientBlock::default();
        for (splat, sums) in splats.iter().zip(sums) {
            let i = splat.id as usize - start;
            self.p[i] = sums.p;
            (0..2).for_each(|k| self.first[k][i] = sums.first[k]);
            (0..3).for_each(|k| self.second[k][i] = sums.second[k]);
            (0..3).filter(|&c| splat.color[c] > 0.0).for_each(|c| self.color[c][i] = sums.color[c] as f32);
        }
    }

    /// Adds to `out` the gradients of the SH coefficients: ∂L/∂c_k = Y_k · ∂L/∂color for the coefficient c_k of the SH
    /// basis function Y_k.
    #[inline(always)]
    fn add_sh_gradients(
        &self,
        gaussians: &Gaussians,
        ids: Range<usize>,
        directions: &Directions,
        out: &mut GradientSpan<'_>,
    ) {
        let n = ids.len().min(BLOCK);
        let mut values = [[0.0f32; BLOCK]; sh_coefficient_count(3)];
        for i in 0..n {
            for (values, value) in values.iter_mut().zip(color::basis(directions.at(i))) {
                values[i] = value;
            }
        }
        for (k, values) in values.iter().enumerate().take(color::coefficients(gaussians)) {
            for (c, color) in self.color.iter().enumerate() {
                let parts = values[..n].iter().zip(&color[..n]).map(|(value, color)| value * color);
                out.add(Attributes::SH, 3 * k + c, ids.start, parts);
            }
        }
    }

    /// Adds to `out` the part of the gradients of positions that comes from colors: moving a Gaussian changes its view
    /// direction, and thereby its color. [`GradientBlock::add_shape`] adds the other part.
    #[inline(always)]
    fn add_direction(
        &self,
        gaussians: &Gaussians,
        ids: Range<usize>,
        directions: &Directions,
        out: &mut GradientSpan<'_>,
    ) {
        let n = ids.len().min(BLOCK);
        // ∂L/∂Y_k for each SH basis function Y_k: the sum over color channels of the SH coefficient times ∂L/∂color.
        let mut by_value = [[0.0f32; BLOCK]; sh_coefficient_count(3)];
        for (k, by_value) in by_value.iter_mut().enumerate().take(color::coefficients(gaussians)).skip(1) {
            let [red, green, blue] = std::array::from_fn(|c| &gaussians.sh.plane(3 * k + c)[ids.clone()][..n]);
            // The planes are iterated over with `zip`: if they were indexed, the compiler would check every index and not
            // vectorize the loop.
            for (i, (((by, red), green), blue)) in by_value.iter_mut().zip(red).zip(green).zip(blue).enumerate() {
                *by = red * self.color[0][i] + green * self.color[1][i] + blue * self.color[2][i];
            }
        }
        let mut parts = [[0.0f32; BLOCK]; 3];
        for i in 0..n {
            let d = directions.at(i);
            let mut sum = [0.0; 3];
            let slopes = color::basis_gradient(d);
            // Indexed instead of `zip` and `skip`, which the compiler does not vectorize.
            for k in 1..slopes.len() {
                let (by, slope) = (by_value[k][i], slopes[k]);
                sum = [sum[0] + by * slope[0], sum[1] + by * slope[1], sum[2] + by * slope[2]];
            }
            // Moving a Gaussian along its view direction does not change the direction.
            let radial = sum[0] * d[0] + sum[1] * d[1] + sum[2] * d[2];
            for axis in 0..3 {
                parts[axis][i] = directions.per_distance[i] * (sum[axis] - radial * d[axis]);
            }
        }
        for (axis, parts) in parts.iter().enumerate() {
            out.add(Attributes::POSITION, axis, ids.start, parts[..n].iter().copied());
        }
    }

    /// Adds the gradients of opacity, scale and rotation to `out`. Also adds the part of the gradients of positions
    /// that comes from footprints: moving a Gaussian moves its footprint and changes the footprint's shape.
    #[inline(always)]
    fn add_shape(&self, gaussians: &Gaussians, ids: Range<usize>, view: &CameraTerms, out: &mut GradientSpan<'_>) {
        let n = ids.len().min(BLOCK);
        let plane = |column: Attributes, c: usize| &gaussians.attribute_values(column).plane(c)[ids.clone()][..n];
        let position: [&[f32]; 3] = std::array::from_fn(|c| plane(Attributes::POSITION, c));
        let rotation: [&[f32]; 4] = std::array::from_fn(|c| plane(Attributes::ROTATION, c));
        let log_scale: [&[f32]; 3] = std::array::from_fn(|c| plane(Attributes::LOG_SCALE, c));
        let logit = plane(Attributes::OPACITY, 0);
        let mut parts = [[0.0f32; BLOCK]; 11];
        let GradientBlock { p, first, second, .. } = self;
        for i in 0..n {
            let gradient = GeometryGradient::new(
                [position[0][i].into(), position[1][i].into(), position[2][i].into()],
                [rotation[0][i].into(), rotation[1][i].into(), rotation[2][i].into(), rotation[3][i].into()],
                [log_scale[0][i], log_scale[1][i], log_scale[2][i]],
                [first[0][i], first[1][i]],
                [second[0][i], second[1][i], second[2][i]],
                view,
            );
            for axis in 0..3 {
                parts[axis][i] = gradient.position[axis] as f32;
                parts[7 + axis][i] = gradient.log_scale[axis] as f32;
            }
            for c in 0..4 {
                parts[3 + c][i] = gradient.rotation[c] as f32;
            }
            parts[10][i] = ((1.0 - opacity(logit[i])) * p[i]) as f32;
        }
        let places = [
            (Attributes::POSITION, 0, 3),
            (Attributes::ROTATION, 3, 4),
            (Attributes::LOG_SCALE, 7, 3),
            (Attributes::OPACITY, 10, 1),
        ];
        for (column, first, width) in places {
            for c in 0..width {
                out.add(column, c, ids.start, parts[first + c][..n].iter().copied());
            }
        }
    }
}

/// Derivatives of the loss with respect to position, quaternion and log scales of one Gaussian.
struct GeometryGradient {
    position: [f64; 3],
    rotation: [f64; 4],
    log_scale: [f64; 3],
}

impl GeometryGradient {
    /// Computes the derivatives for one Gaussian from its stored attributes and from two sums over the pixels of its
    /// splat: `[x, y]` is [`SplatSums::first`], and `[xx, xy, yy]` is [`SplatSums::second`]. `q` is the quaternion in
    /// the order w, x, y, z.
    #[inline(always)]
    fn new(
        position: [f64; 3],
        q: [f64; 4],
        log_scale: [f32; 3],
        [x, y]: [f64; 2],
        [xx, xy, yy]: [f64; 3],
        view: &CameraTerms,
    ) -> Self {
        let shape = ProjectedShape::new(position, q, log_scale, view);
        let covariance = shape.covariance();
        let [a, b] = shape.spread;

        // Offsets of pixels in standard deviations of the footprint: s = (x − shear·y)·per_s, t = y·per_t.
        let inverse_yy = 1.0 / covariance.yy;
        let (shear, per_s, per_t) =
            (covariance.xy * inverse_yy, (covariance.yy / covariance.det).sqrt(), inverse_yy.sqrt());
        let (s, t) = (per_s * x, per_t * y);
        let (ss, st, tt) = (per_s * per_s * xx, per_s * per_t * xy, per_t * per_t * yy);
        // For each axis of the Gaussian, computes ∂L/∂log scale, ∂L/∂a and ∂L/∂b.
        let by_axis = |j: usize| {
            // Components of the axis along s and t.
            let (along_s, along_t) = (per_s * (a[j] - shear * b[j]), per_t * b[j]);
            let (by_s, by_t) = (ss * along_s + st * along_t, st * along_s + tt * along_t);
            let by_a = per_s * by_s;
            let kept = f64::from(log_scale[j]).abs() <= LOGARITHM_LIMIT;
            (if kept { by_s * along_s + by_t * along_t } else { 0.0 }, by_a, per_t * by_t - shear * by_a)
        };
        let [(scale_0, a_0, b_0), (scale_1, a_1, b_1), (scale_2, a_2, b_2)] = [by_axis(0), by_axis(1), by_axis(2)];

        // `a` and `b` are `to_pixels` · axes · scale (see [`ProjectedShape::spread`]).
        let by_to = |by: [f64; 3]| {
            let by = [by[0] * shape.scale[0], by[1] * shape.scale[1], by[2] * shape.scale[2]];
            let along = |axis: usize| dot(by, [shape.axes[0][axis], shape.axes[1][axis], shape.axes[2][axis]]);
            [along(0), along(1), along(2)]
        };
        let (by_to_u, by_to_v) = (by_to([a_0, a_1, a_2]), by_to([b_0, b_1, b_2]));
        // Rotating the Gaussian is equivalent to rotating `to_pixels` in the opposite direction.
        let (turn_u, turn_v) = (cross(by_to_u, shape.to_pixels[0]), cross(by_to_v, shape.to_pixels[1]));
        let torque = [turn_u[0] + turn_v[0], turn_u[1] + turn_v[1], turn_u[2] + turn_v[2]];

        // `to_pixels` is focal/depth · (row k − slope · depth row), with the slope clamped at the limit.
        let [row_x, row_y, row_z] = view.rotation;
        let by_slope = |k: usize, by_center: f64, by_to: [f64; 3]| {
            let through_to = view.focal[k] * shape.inverse_depth * dot(row_z, by_to);
            let kept = shape.slopes[k].abs() <= view.slope_limit[k];
            view.focal[k] * by_center - if kept { through_to } else { 0.0 }
        };
        let by_slope_x = by_slope(0, per_s * s, by_to_u);
        let by_slope_y = by_slope(1, per_t * t - shear * per_s * s, by_to_v);
        let by_size = dot(shape.to_pixels[0], by_to_u) + dot(shape.to_pixels[1], by_to_v);
        let by_depth = -by_size - shape.slopes[0] * by_slope_x - shape.slopes[1] * by_slope_y;
        let along = |axis: usize| {
            shape.inverse_depth * (row_x[axis] * by_slope_x + row_y[axis] * by_slope_y + row_z[axis] * by_depth)
        };
        GeometryGradient {
            position: [along(0), along(1), along(2)],
            rotation: by_quaternion(q, torque),
            log_scale: [scale_0, scale_1, scale_2],
        }
    }
}

/// Returns ∂L/∂quaternion for a quaternion (w, x, y, z) of any length. `torque` is ∂L/∂angle for rotations about the
/// world axes. The formula is 2·(0, torque) ⊗ q / ‖q‖².
///
/// A rotation by a small vector δ (axis times angle) changes a quaternion q by ½·(0, δ) ⊗ q. A change of the length of
/// q has no effect on the loss. The result is not finite for a zero quaternion.
#[inline(always)]
fn by_quaternion([w, x, y, z]: [f64; 4], torque: [f64; 3]) -> [f64; 4] {
    let twice = 2.0 / (w * w + x * x + y * y + z * z);
    let [cross_x, cross_y, cross_z] = cross(torque, [x, y, z]);
    [
        -twice * dot(torque, [x, y, z]),
        twice * (w * torque[0] + cross_x),
        twice * (w * torque[1] + cross_y),
        twice * (w * torque[2] + cross_z),
    ]
}
