//! From what a splat takes to what the stored values of its Gaussian take: the projection's derivative, in f64.
//!
//! The footprint enters through its whitened axes alone, so needles and giants lose no digits that the projection kept.
//! Sources: Zwicker et al., "EWA Splatting", 2002 (the projection); derived anew in method.md, section 8.1.

use super::super::colour;
use super::super::project::{Covariance, LOGARITHM_LIMIT, Shape, Splat, View, cross, dot, opacity};
use super::tile::Sums;
use crate::model::{Columns, Gaussians, GradientSpan};

/// Adds what the Gaussian behind `splat` takes to its gradients, which are among `out`.
pub(super) fn add(gaussians: &Gaussians, splat: &Splat, sums: &Sums<f64>, view: &View, out: &mut GradientSpan<'_>) {
    let id = splat.id as usize;
    // A channel cut off at 0 moves nothing.
    let colour = std::array::from_fn(|c| if splat.colour[c] > 0.0 { sums.colour[c] } else { 0.0 });
    let (direction, per_distance) = colour::direction(gaussians.position.row(id), view.center);
    let basis = colour::basis(direction);
    let coefficients = colour::coefficients(gaussians);
    out.add(Columns::SH, id, basis[..coefficients].iter().flat_map(|&y| colour.map(|taken| f64::from(y) * taken)));
    if Columns::SH.contains(out.columns()) {
        return;
    }
    let by_direction = by_direction(gaussians, id, direction, colour).map(|x| per_distance * x);
    out.add(Columns::POSITION, id, by_direction);
    let logit = gaussians.opacity_logit.plane(0)[id];
    out.add(Columns::OPACITY, id, [(1.0 - opacity(logit)) * sums.p]);
    let taken = Taken::new(gaussians, id, sums, view);
    out.add(Columns::POSITION, id, taken.position);
    out.add(Columns::ROTATION, id, taken.rotation);
    out.add(Columns::LOG_SCALE, id, taken.log_scale);
}

/// ∂L/∂ direction of view, tangential: through the colour's harmonics.
fn by_direction(gaussians: &Gaussians, id: usize, direction: [f32; 3], colour: [f64; 3]) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for (k, slope) in colour::basis_gradient(direction).iter().enumerate().take(colour::coefficients(gaussians)).skip(1)
    {
        let by_value: f64 = (0..3).map(|c| f64::from(gaussians.sh.plane(3 * k + c)[id]) * colour[c]).sum();
        (0..3).for_each(|axis| sum[axis] += by_value * f64::from(slope[axis]));
    }
    let direction = direction.map(f64::from);
    let radial = dot(sum, direction);
    std::array::from_fn(|axis| sum[axis] - radial * direction[axis])
}

/// What a Gaussian's geometry takes.
struct Taken {
    position: [f64; 3],
    rotation: [f64; 4],
    log_scale: [f64; 3],
}

impl Taken {
    fn new(gaussians: &Gaussians, id: usize, sums: &Sums<f64>, view: &View) -> Self {
        let p = gaussians.position.row::<3>(id).map(f64::from);
        let q = gaussians.rotation.row::<4>(id).map(f64::from);
        let log_scale = gaussians.log_scale.row::<3>(id);
        let shape = Shape::new(p, q, log_scale, view);
        let Covariance { xy, yy, det, .. } = shape.covariance();
        let [a, b] = shape.spread;

        // Offsets in standard deviations: s = (x − slope·y)·per_s, t = y·per_t.
        let (slope, per_s, per_t) = (xy / yy, (yy / det).sqrt(), yy.sqrt().recip());
        let [s, t] = sums.first;
        let [ss, st, tt] = sums.second;
        // The three axes as s and t see them.
        let along_s: [f64; 3] = std::array::from_fn(|j| per_s * (a[j] - slope * b[j]));
        let along_t = b.map(|b| per_t * b);
        let log_scale = std::array::from_fn(|j| match log_scale[j] {
            cut if f64::from(cut).abs() > LOGARITHM_LIMIT => 0.0,
            _ => ss * along_s[j] * along_s[j] + 2.0 * st * along_s[j] * along_t[j] + tt * along_t[j] * along_t[j],
        });
        let by_a: [f64; 3] = std::array::from_fn(|j| per_s * (ss * along_s[j] + st * along_t[j]));
        let by_b: [f64; 3] = std::array::from_fn(|j| per_t * (st * along_s[j] + tt * along_t[j]) - slope * by_a[j]);

        // a and b are `to` · axes · scale.
        let by_to = [by_a, by_b].map(|by| {
            let turned: [f64; 3] = std::array::from_fn(|j| by[j] * shape.scale[j]);
            std::array::from_fn::<f64, 3, _>(|axis| (0..3).map(|j| turned[j] * shape.axes[j][axis]).sum())
        });
        // Turning the Gaussian one way is turning `to` the other way.
        let torques = [cross(by_to[0], shape.to[0]), cross(by_to[1], shape.to[1])];
        let rotation = by_quaternion(q, std::array::from_fn(|axis| torques[0][axis] + torques[1][axis]));

        let by_center = [per_s * s, per_t * t - slope * per_s * s];
        let mut by_depth = 0.0;
        let mut by_camera = [0.0; 3];
        for k in 0..2 {
            // `to` is focal/depth · (row k − slope · row of the depth), with the slope cut at the limit.
            by_depth -= dot(shape.to[k], by_to[k]);
            let mut by_slope = view.focal[k] * by_center[k];
            if shape.slopes[k].abs() <= view.slope_limit[k] {
                by_slope -= view.focal[k] / shape.depth * dot(view.rotation[2], by_to[k]);
            }
            by_camera[k] = by_slope / shape.depth;
            by_depth -= shape.slopes[k] * by_slope;
        }
        by_camera[2] = by_depth / shape.depth;
        let position = std::array::from_fn(|axis| (0..3).map(|row| view.rotation[row][axis] * by_camera[row]).sum());
        Taken { position, rotation, log_scale }
    }
}

/// ∂L/∂ wxyz quaternion of any length, given ∂L/∂ angle about each of the world's axes: 2·(0, torque) ⊗ q / ‖q‖². A
/// quaternion changes by half an angle times itself; along itself nothing changes. None for a zero one.
fn by_quaternion([w, x, y, z]: [f64; 4], torque: [f64; 3]) -> [f64; 4] {
    let square = w * w + x * x + y * y + z * z;
    if square == 0.0 {
        return [0.0; 4];
    }
    let across = cross(torque, [x, y, z]);
    let product =
        [-dot(torque, [x, y, z]), w * torque[0] + across[0], w * torque[1] + across[1], w * torque[2] + across[2]];
    product.map(|component| 2.0 * component / square)
}
