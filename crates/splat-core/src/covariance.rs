//! Computes the scales and the rotation of a Gaussian from its covariance matrix.
//!
//! Most model formats store scales S and a rotation R, which define the covariance Σ = R S Sᵀ Rᵀ. Some formats define Σ
//! in another way: with a quaternion that is not of unit length, or as a slice through a four-dimensional Gaussian.
//! Renderers and statistics need scales and a rotation for these formats too.

use glam::{DMat3, DQuat, DVec3};

/// Lower limit of the eigenvalues of a covariance, in squared scene units; smaller eigenvalues are raised to it. It
/// corresponds to a scale of 1e-7 scene units.
const MIN_EIGENVALUE: f64 = 1e-14;
/// Maximum number of Jacobi sweeps. A sweep sets each of the three off-diagonal entries of a matrix to zero once.
/// Convergence is quadratic; 6 to 8 sweeps suffice from any start.
const MAX_SWEEPS: usize = 12;

/// Computes the scales s and the unit quaternion (wxyz) of a rotation R with Σ = R diag(s)² Rᵀ. `sigma` holds the
/// entries xx, xy, xz, yy, yz, zz of the covariance Σ in squared scene units; the scales are in scene units.
///
/// The order and the directions of the axes of R are not unique. They are chosen close to the axes of the quaternion
/// `like` (wxyz, of any length; 0 counts as the identity):
/// - Of the six orders of the axes, the one closest to the axes of `like` is taken.
/// - Each axis points in the direction of the corresponding axis of `like`. If the three axes would then form a
///   reflection, the one furthest from its corresponding axis is reversed.
/// - Of the two quaternions of R, the one nearer to `like` is returned.
/// - If eigenvalues coincide, eigenvectors are not unique. The axes of `like` are then taken if they are eigenvectors.
///
/// The result depends only on `sigma` and `like`, not on earlier calls. A Gaussian thus has the same scales and
/// rotation at a given time, in whatever order times are read.
///
/// Method: Jacobi iteration in f64, started at the axes of `like`. The result reproduces Σ to about 1e-15 of its
/// largest entry. Eigenvalues below 1e-14, such as those that rounding made negative, are raised to 1e-14. An entry of
/// `sigma` that is not finite gives NaN scales and the rotation `like`.
pub fn scale_rotation(sigma: [f64; 6], like: [f64; 4]) -> ([f64; 3], [f64; 4]) {
    let [xx, xy, xz, yy, yz, zz] = sigma;
    let like = DQuat::from_xyzw(like[1], like[2], like[3], like[0]);
    let like = if like.length_squared().is_normal() { like.normalize() } else { DQuat::IDENTITY };
    if sigma.iter().any(|x| !x.is_finite()) {
        return ([f64::NAN; 3], [like.w, like.x, like.y, like.z]);
    }
    let axes_of_like = DMat3::from_quat(like);
    let covariance = DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz));
    let in_axes_of_like = axes_of_like.transpose() * covariance * axes_of_like;
    let entry = |i: usize, j: usize| 0.5 * (in_axes_of_like.col(j)[i] + in_axes_of_like.col(i)[j]);
    let entries = [0, 1, 2].map(|i| [0, 1, 2].map(|j| entry(i, j)));
    let (values, axes) = eigen(entries);

    // Component i of an axis in `axes` is the scalar product of this axis and axis i of `like`.
    let mut best = ([0, 1, 2], f64::NEG_INFINITY);
    for order in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
        let closeness: f64 = (0..3).map(|i| axes[order[i]][i].abs()).sum();
        if closeness > best.1 {
            best = (order, closeness);
        }
    }
    let mut frame = [0, 1, 2].map(|i| axes[best.0[i]] * 1f64.copysign(axes[best.0[i]][i]));
    if frame[0].cross(frame[1]).dot(frame[2]) < 0.0 {
        let furthest = (1..3).fold(0, |least, i| if frame[i][i] < frame[least][least] { i } else { least });
        frame[furthest] = -frame[furthest];
    }
    let relative_rotation = DQuat::from_mat3(&DMat3::from_cols(frame[0], frame[1], frame[2]));
    let rotation = (like * relative_rotation).normalize();
    let rotation = if rotation.dot(like) < 0.0 { -rotation } else { rotation };
    (best.0.map(|axis| values[axis].max(MIN_EIGENVALUE).sqrt()), [rotation.w, rotation.x, rotation.y, rotation.z])
}

/// Computes the eigenvalues of the symmetric matrix `a`, in no particular order, and the unit eigenvector of each, by
/// Jacobi iteration.
fn eigen(mut a: [[f64; 3]; 3]) -> ([f64; 3], [DVec3; 3]) {
    let mut axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let scale = a.iter().flatten().fold(0.0f64, |most, x| most.max(x.abs()));
    for _ in 0..MAX_SWEEPS {
        // Off-diagonal entries below this limit do not change the eigenvalues at f64 precision.
        if a[0][1].abs().max(a[0][2].abs()).max(a[1][2].abs()) <= 1e-18 * scale {
            break;
        }
        for (p, q, r) in [(0, 1, 2), (0, 2, 1), (1, 2, 0)] {
            if a[p][q] == 0.0 {
                continue;
            }
            // The smaller of the two rotation angles keeps the axes near their present directions.
            let zeta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let tangent = 1f64.copysign(zeta) / (zeta.abs() + zeta.hypot(1.0));
            let cosine = 1.0 / tangent.hypot(1.0);
            let sine = cosine * tangent;
            a[p][p] -= tangent * a[p][q];
            a[q][q] += tangent * a[p][q];
            (a[p][q], a[q][p]) = (0.0, 0.0);
            let (pr, qr) = (cosine * a[p][r] - sine * a[q][r], sine * a[p][r] + cosine * a[q][r]);
            (a[p][r], a[r][p], a[q][r], a[r][q]) = (pr, pr, qr, qr);
            (axes[p], axes[q]) = (cosine * axes[p] - sine * axes[q], sine * axes[p] + cosine * axes[q]);
        }
    }
    ([a[0][0], a[1][1], a[2][2]], axes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn quaternion() -> impl Strategy<Value = [f64; 4]> {
        prop::array::uniform4(-2.0..2.0f64).prop_filter("direction", |q| q.iter().map(|x| x * x).sum::<f64>() > 0.05)
    }

    /// Returns the covariance R diag(s)² Rᵀ (xx, xy, xz, yy, yz, zz) of scales s and a quaternion `q` of any length.
    /// Independent of the tested code: normalizes `q` and applies the formula of unit quaternions.
    fn sigma(scales: [f64; 3], q: [f64; 4]) -> [f64; 6] {
        let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        let [w, x, y, z] = q.map(|c| c / length);
        let rows = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let entry = |i: usize, j: usize| (0..3).map(|k| rows[i][k] * rows[j][k] * scales[k].powi(2)).sum();
        [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)]
    }

    /// Returns the largest difference between entries of `got` and `expected`, divided by the largest expected entry.
    fn relative_error(got: [f64; 6], expected: [f64; 6]) -> f64 {
        let most = expected.iter().fold(0.0f64, |most, x| most.max(x.abs()));
        got.iter().zip(expected).fold(0.0f64, |largest, (a, b)| largest.max((a - b).abs())) / most
    }

    proptest! {
        #[test]
        fn scales_and_rotation_reproduce_the_covariance(
            q in quaternion(), like in quaternion(), logs in prop::array::uniform3(-6.0..1.0f64)
        ) {
            let expected = sigma(logs.map(f64::exp), q);
            let (scales, rotation) = scale_rotation(expected, like);
            let relative_error = relative_error(sigma(scales, rotation), expected);
            prop_assert!(relative_error < 4e-15, "off by {relative_error:e}: {scales:?} {rotation:?}");
            prop_assert!((rotation.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-14);
            prop_assert!((0..4).map(|c| rotation[c] * like[c]).sum::<f64>() >= 0.0);
        }

        #[test]
        fn axes_keep_their_order_under_a_small_rotation(
            q in quaternion(), turn in prop::array::uniform3(-0.1..0.1f64), logs in prop::array::uniform3(-3.0..1.0f64)
        ) {
            prop_assume!((0..3).all(|i| (logs[i] - logs[(i + 1) % 3]).abs() > 1e-3));
            // The rotations `near` and `q` differ by less than a twelfth of a full turn.
            let [w, x, y, z] = q;
            let product = |[a, b, c, d]: [f64; 4]| [
                w * a - x * b - y * c - z * d,
                w * b + x * a + y * d - z * c,
                w * c - x * d + y * a + z * b,
                w * d + x * c - y * b + z * a,
            ];
            let near = product([1.0, turn[0], turn[1], turn[2]]);
            let (scales, rotation) = scale_rotation(sigma(logs.map(f64::exp), near), q);
            for i in 0..3 {
                prop_assert!((scales[i].ln() - logs[i]).abs() < 1e-9, "{scales:?} {logs:?}");
            }
            let length = near.iter().map(|x| x * x).sum::<f64>().sqrt();
            prop_assert!((0..4).all(|c| (rotation[c] - near[c] / length).abs() < 1e-9), "{rotation:?} {near:?}");
        }
    }

    #[test]
    fn equal_scales_keep_the_axes_of_like() {
        let like = [0.5, -0.5, 0.5, 0.5];
        let (scales, rotation) = scale_rotation([4.0, 0.0, 0.0, 4.0, 0.0, 4.0], like);
        assert_eq!((scales, rotation), ([2.0; 3], like));
    }

    #[test]
    fn flat_and_tiny_covariances_have_small_finite_scales() {
        let like = [1.0, 0.0, 0.0, 0.0];
        // This covariance has rank 1; rounding may make two of its eigenvalues slightly negative.
        let v = [0.1f64, 0.7, -0.3];
        let (scales, rotation) =
            scale_rotation([v[0] * v[0], v[0] * v[1], v[0] * v[2], v[1] * v[1], v[1] * v[2], v[2] * v[2]], like);
        assert!(rotation.iter().all(|x| x.is_finite()));
        let mut sorted = scales;
        sorted.sort_by(f64::total_cmp);
        assert!((sorted[2] - 0.59f64.sqrt()).abs() < 1e-15 && sorted[0] == 1e-7 && sorted[1] < 1.1e-7, "{scales:?}");
        assert_eq!(scale_rotation([0.0; 6], like), ([1e-7; 3], like));
        assert_eq!(scale_rotation([0.0; 6], [0.0; 4]).1, like);
        let (scales, rotation) = scale_rotation([f64::INFINITY, 0.0, 0.0, 1.0, 0.0, 1.0], like);
        assert!(scales.iter().all(|x| x.is_nan()) && rotation == like);
    }
}
