//! Screw motions, by which the variant of Deformable-3D-Gaussians with six degrees of freedom moves positions.
//!
//! The network outputs w and v. With θ = |w|, w becomes w/θ + 1e-5 and v becomes v/θ + 1e-5 in every component, so w is
//! not exactly a unit vector. With W the matrix of the cross product with w, the moved position is x′ = (I + sin θ·W +
//! (1 − cos θ)·W²)·x + (θ·I + (1 − cos θ)·W + (θ − sin θ)·W²)·v. Source: `exp_se3` of the authors' code.

use glam::DVec3;

/// Value that the original code adds to every component of the axis w/θ and the translation v/θ of a screw motion.
const EPSILON: f64 = 1e-5;
/// Minimum angle θ = |w|. Below it, the limit x + v is used, where the original code divides by zero.
const MIN_ANGLE: f64 = 1e-30;
/// Half of the step of central differences for quantities of size 1: the cube root of the precision of f64.
const HALF_STEP: f64 = 6e-6;

/// Returns the position `x` moved by the screw motion with the network's outputs `w` and `v`.
pub(super) fn apply_screw(x: DVec3, w: DVec3, v: DVec3) -> DVec3 {
    let angle = w.length();
    if angle < MIN_ANGLE {
        return x + v;
    }
    let (w, v) = (w / angle + EPSILON, v / angle + EPSILON);
    let (sine, rest) = (angle.sin(), 1.0 - angle.cos());
    let turned = x + sine * w.cross(x) + rest * w.cross(w.cross(x));
    turned + angle * v + rest * w.cross(v) + (angle - sine) * w.cross(w.cross(v))
}

/// Returns the derivative of the moved position when `x` moves in the direction `axis`. Then the network's outputs w
/// and v change as well; `of_w` and `of_v` are their derivatives in this direction. The derivative is a central
/// difference in which x, w and v change together.
pub(super) fn slope(x: DVec3, w: DVec3, v: DVec3, axis: DVec3, [of_w, of_v]: [DVec3; 2]) -> DVec3 {
    // Screw motions may change fast with x, so the step is shortened accordingly.
    let step = HALF_STEP / (1.0 + of_w.abs().max_element() + of_v.abs().max_element());
    let at = |by: f64| apply_screw(x + by * axis, w + by * of_w, v + by * of_v);
    (at(step) - at(-step)) / (2.0 * step)
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    /// Returns the position `x` moved by the screw motion `w`, `v`, computed with the matrices of the formula at the
    /// top of this file.
    fn by_matrices(x: DVec3, w: DVec3, v: DVec3) -> DVec3 {
        let angle = w.length();
        let (w, v) = (w / angle + DVec3::splat(1e-5), v / angle + DVec3::splat(1e-5));
        let skew = DMat3::from_cols_array(&[0.0, w.z, -w.y, -w.z, 0.0, w.x, w.y, -w.x, 0.0]);
        let turn = DMat3::IDENTITY + skew * angle.sin() + skew * skew * (1.0 - angle.cos());
        let along = DMat3::IDENTITY * angle + skew * (1.0 - angle.cos()) + skew * skew * (angle - angle.sin());
        turn * x + along * v
    }

    #[test]
    fn screw_agrees_with_the_matrix_formula() {
        let [x, w, v] = [DVec3::new(0.3, -1.2, 2.0), DVec3::new(0.02, -0.5, 0.1), DVec3::new(-0.4, 0.1, 0.7)];
        for size in [1e-9, 1e-3, 1.0, 20.0] {
            let off = (apply_screw(x, size * w, v) - by_matrices(x, size * w, v)).length();
            assert!(off < 1e-13, "size {size}: off by {off:e}");
        }
        assert_eq!(apply_screw(x, DVec3::ZERO, v), x + v);
        assert!((apply_screw(x, 1e-20 * w, v) - x - v).length() < 1e-15);
    }

    #[test]
    fn slope_follows_position_and_network() {
        let [x, w, v] = [DVec3::new(0.3, -1.2, 2.0), DVec3::new(0.02, -0.5, 0.1), DVec3::new(-0.4, 0.1, 0.7)];
        let slopes = [DVec3::new(3.0, 1.0, -2.0), DVec3::new(0.5, -4.0, 1.0)];
        let wide = |by: f64| apply_screw(x + by * DVec3::Y, w + by * slopes[0], v + by * slopes[1]);
        // Reference value: Richardson extrapolation of two wider differences.
        let [one, two] = [1e-3, 2e-3].map(|by| (wide(by) - wide(-by)) / (2.0 * by));
        let expected = (4.0 * one - two) / 3.0;
        let found = slope(x, w, v, DVec3::Y, slopes);
        assert!((found - expected).length() < 1e-8, "{found} {expected}");
    }
}
