//! Moment matching: computes the single Gaussian that has the weighted mean and covariance of several Gaussians.
//!
//! Input: weighted ellipsoids. Output: one ellipsoid. Memory: 96 bytes per input ellipsoid.
//!
//! The covariance is Σ = Σ_i w_i (R_i S_i S_iᵀ R_iᵀ + (μ_i − μ)(μ_i − μ)ᵀ), where w is a weight, R a rotation, S a
//! diagonal matrix of scales and μ a center. This matrix is never formed: squaring halves the number of correct digits,
//! and the smallest scale of a needle would lose its digits first. Instead, the factor F (3 × 4n) with Σ = F Fᵀ is
//! formed. Its columns are √w_i R_i S_i and √w_i (μ_i − μ). A one-sided Jacobi SVD rotates the three rows of F until
//! they are orthogonal (Demmel and Veselić, "Jacobi's method is more accurate than QR", 1992). Every rotation is exact
//! to rounding in each column, so a column a billion times shorter than another keeps its digits.

use glam::{DMat3, DQuat, DVec3};

/// Maximum number of sweeps of the Jacobi SVD. A sweep makes each of the three pairs of rows of the 3-row matrix
/// orthogonal once. Convergence is quadratic and needs about six sweeps; rounding noise in nearly equal singular values
/// needs a few more.
const MAX_SWEEPS: usize = 40;

/// One Gaussian of a mixture, with its weight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WeightedGaussian {
    /// Weight in the mixture, ≥ 0; the weights sum to 1.
    pub weight: f64,
    /// Center μ of the Gaussian, in any unit of length.
    pub position: DVec3,
    /// Rotation R, a unit quaternion.
    pub rotation: DQuat,
    /// Scales, the diagonal of S: standard deviations along the axes of `rotation`, in the unit of `position`.
    pub scales: DVec3,
}

/// A Gaussian without color and opacity: mean, and covariance R S Sᵀ Rᵀ given by the rotation R and the scales S.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipsoid {
    /// Center of the Gaussian, in the unit of length of the input Gaussians.
    pub mean: DVec3,
    /// Rotation, a unit quaternion with w ≥ 0.
    pub rotation: DQuat,
    /// Scales: standard deviations along the axes of `rotation`.
    pub scales: DVec3,
}

/// Returns the Gaussian that has the mean Σ w_i μ_i and the covariance of the mixture `parts`. If `about` is given, the
/// mean is that point instead, and the second moments are taken about it.
///
/// Canonical form: the scales are in descending order. In each of the first two axes, the component of largest
/// magnitude is positive. The sign of the third axis, that of the smallest scale, is the one that makes the axes
/// right-handed.
///
/// Accuracy: at any anisotropy, every scale has a relative error of about 1e-14, if the scaled axes of `parts` have
/// errors of this size. Edge cases: without parts all scales are zero, and the mean is `about` or the origin. Scales
/// must be finite, but may be so large that their squares overflow.
pub fn moments(parts: &[WeightedGaussian], about: Option<DVec3>) -> Ellipsoid {
    let mean = about.unwrap_or_else(|| parts.iter().map(|part| part.weight * part.position).sum());
    let mut rows: [Vec<f64>; 3] = std::array::from_fn(|_| Vec::with_capacity(4 * parts.len()));
    for part in parts {
        let root = part.weight.sqrt();
        let axes = DMat3::from_quat(part.rotation);
        let columns = [
            axes.x_axis * (root * part.scales.x),
            axes.y_axis * (root * part.scales.y),
            axes.z_axis * (root * part.scales.z),
            (part.position - mean) * root,
        ];
        for (r, row) in rows.iter_mut().enumerate() {
            row.extend(columns.iter().map(|column| column[r]));
        }
    }
    // Dot products square the entries, so the largest entry is first scaled to about 1. A power of two changes no
    // digit.
    let largest = rows.iter().flatten().fold(0.0f64, |most, x| most.max(x.abs()));
    let unit = if largest.is_normal() { 2f64.powi(largest.log2().floor() as i32) } else { 1.0 };
    rows.iter_mut().flatten().for_each(|x| *x /= unit);

    let axes = orthogonalize_rows(&mut rows);
    let lengths: [f64; 3] = std::array::from_fn(|r| dot(&rows[r], &rows[r]).sqrt() * unit);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| lengths[b].total_cmp(&lengths[a]));
    let [first, second] = [order[0], order[1]].map(|r| with_largest_positive(axes[r]));
    let frame = DMat3::from_cols(first, second, first.cross(second));
    Ellipsoid { mean, rotation: unit_from_axes(&frame), scales: DVec3::from(order.map(|r| lengths[r])) }
}

/// Rotates pairs of the three `rows` until all are orthogonal to one another (one-sided Jacobi SVD). Returns a unit
/// vector axis_r for each resulting row r, such that the original matrix of rows is Σ_r axis_r ⊗ row_r.
fn orthogonalize_rows(rows: &mut [Vec<f64>; 3]) -> [DVec3; 3] {
    let mut axes = [DVec3::X, DVec3::Y, DVec3::Z];
    // Relative to the product of the lengths, a dot product of n terms has about this rounding error.
    let tolerance = f64::EPSILON * (rows[0].len() as f64).sqrt().max(1.0);
    for _ in 0..MAX_SWEEPS {
        let mut rotated = false;
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let (pp, qq, pq) = (dot(&rows[p], &rows[p]), dot(&rows[q], &rows[q]), dot(&rows[p], &rows[q]));
            if pq == 0.0 || pq.abs() <= tolerance * (pp.sqrt() * qq.sqrt()) {
                continue;
            }
            rotated = true;
            let zeta = (qq - pp) / (2.0 * pq);
            let tangent = 1f64.copysign(zeta) / (zeta.abs() + zeta.hypot(1.0));
            let cosine = 1.0 / tangent.hypot(1.0);
            let sine = cosine * tangent;
            let (head, tail) = rows.split_at_mut(q);
            for (a, b) in head[p].iter_mut().zip(&mut tail[0]) {
                (*a, *b) = (cosine * *a - sine * *b, sine * *a + cosine * *b);
            }
            (axes[p], axes[q]) = (cosine * axes[p] - sine * axes[q], sine * axes[p] + cosine * axes[q]);
        }
        if !rotated {
            break;
        }
    }
    axes
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn with_largest_positive(axis: DVec3) -> DVec3 {
    let largest = axis.abs().max_position();
    if axis[largest] < 0.0 { -axis } else { axis }
}

/// Returns the unit quaternion with w ≥ 0 of the rotation matrix `frame`.
fn unit_from_axes(frame: &DMat3) -> DQuat {
    let rotation = DQuat::from_mat3(frame).normalize();
    if rotation.w < 0.0 { -rotation } else { rotation }
}

/// Returns `ellipsoid` with its axes reordered and flipped so that its rotation is the nearest to `reference`. There
/// are 24 such rotations q of the same ellipsoid. The one with the largest |⟨q, reference⟩| is taken, the first one on
/// a tie. Of the two quaternions of this rotation, the one nearer to `reference` is returned.
///
/// A deformation field adds its deltas axis by axis. So the axes of a merged Gaussian must be in the same order as
/// those of the Gaussian whose deltas it gets.
pub fn reorder_axes_to_match(ellipsoid: &Ellipsoid, reference: DQuat) -> Ellipsoid {
    let axes = DMat3::from_quat(ellipsoid.rotation);
    let (mut closest, mut rotation, mut scales) = (f64::NEG_INFINITY, ellipsoid.rotation, ellipsoid.scales);
    for order in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
        for (sign_x, sign_y) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
            let (x, y) = (axes.col(order[0]) * sign_x, axes.col(order[1]) * sign_y);
            let candidate = unit_from_axes(&DMat3::from_cols(x, y, x.cross(y)));
            let closeness = candidate.dot(reference).abs();
            if closeness > closest {
                (closest, rotation, scales) =
                    (closeness, candidate, DVec3::from(order.map(|axis| ellipsoid.scales[axis])));
            }
        }
    }
    let rotation = if rotation.dot(reference) < 0.0 { -rotation } else { rotation };
    Ellipsoid { mean: ellipsoid.mean, rotation, scales }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn unit_quaternion() -> impl Strategy<Value = DQuat> {
        prop::array::uniform4(-1.0..1.0f64)
            .prop_filter("direction", |q| q.iter().map(|x| x * x).sum::<f64>() > 0.05)
            .prop_map(|[x, y, z, w]| DQuat::from_xyzw(x, y, z, w).normalize())
    }

    fn mixture() -> impl Strategy<Value = Vec<WeightedGaussian>> {
        let part =
            (0.01..1.0f64, prop::array::uniform3(-1.0..1.0f64), unit_quaternion(), prop::array::uniform3(-4.0..0.0f64));
        prop::collection::vec(part, 1..12).prop_map(|parts| {
            let total: f64 = parts.iter().map(|part| part.0).sum();
            let part = |(weight, position, rotation, logs): (f64, [f64; 3], DQuat, [f64; 3])| WeightedGaussian {
                weight: weight / total,
                position: position.into(),
                rotation,
                scales: DVec3::from(logs.map(f64::exp)),
            };
            parts.into_iter().map(part).collect()
        })
    }

    fn outer(v: DVec3) -> DMat3 {
        DMat3::from_cols(v * v.x, v * v.y, v * v.z)
    }

    fn covariance(rotation: DQuat, scales: DVec3) -> DMat3 {
        let axes = DMat3::from_quat(rotation);
        axes * DMat3::from_diagonal(scales * scales) * axes.transpose()
    }

    /// Slow reference for [`moments`]: returns mean and covariance of the mixture `parts` by the textbook formula,
    /// which forms Σ. If `about` is given, it is returned as the mean, and the second moments are taken about it.
    fn oracle(parts: &[WeightedGaussian], about: Option<DVec3>) -> (DVec3, DMat3) {
        let mean = about.unwrap_or_else(|| parts.iter().fold(DVec3::ZERO, |sum, p| sum + p.position * p.weight));
        let sigma = parts
            .iter()
            .fold(DMat3::ZERO, |sum, p| sum + (covariance(p.rotation, p.scales) + outer(p.position - mean)) * p.weight);
        (mean, sigma)
    }

    fn largest_entry(m: DMat3) -> f64 {
        m.to_cols_array().iter().fold(0.0, |most, x| x.abs().max(most))
    }

    fn assert_covariance(got: &Ellipsoid, expected: DMat3) {
        let error = largest_entry(covariance(got.rotation, got.scales) - expected) / largest_entry(expected);
        assert!(
            error < 1e-13,
            "got {got:?}, expected covariance {expected:?}, relative error {error:e}, tolerance 1e-13"
        );
    }

    fn part(weight: f64, position: DVec3, rotation: DQuat, scales: DVec3) -> WeightedGaussian {
        WeightedGaussian { weight, position, rotation, scales }
    }

    fn tilt() -> DQuat {
        DQuat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize()
    }

    proptest! {
        #[test]
        fn mean_and_covariance_of_the_mixture_are_preserved(parts in mixture(), at in prop::array::uniform3(-1.0..1.0f64)) {
            for about in [None, Some(DVec3::from(at))] {
                let got = moments(&parts, about);
                let (mean, sigma) = oracle(&parts, about);
                prop_assert!((got.mean - mean).length() < 1e-14);
                assert_covariance(&got, sigma);
                prop_assert!(got.scales.x >= got.scales.y && got.scales.y >= got.scales.z);
                prop_assert!(got.rotation.w >= 0.0 && got.rotation.is_normalized());
            }
        }

        #[test]
        fn moving_the_mixture_moves_the_merged_gaussian(parts in mixture(), turn in unit_quaternion(), shift in prop::array::uniform3(-9.0..9.0f64)) {
            let unmoved = moments(&parts, None);
            let shift = DVec3::from(shift);
            let moved: Vec<WeightedGaussian> = parts
                .iter()
                .map(|p| WeightedGaussian { position: turn * p.position + shift, rotation: (turn * p.rotation).normalize(), ..*p })
                .collect();
            let got = moments(&moved, None);
            prop_assert!((got.mean - (turn * unmoved.mean + shift)).length() < 1e-13);
            prop_assert!(((got.scales - unmoved.scales) / unmoved.scales).abs().max_element() < 1e-12);
            assert_covariance(&Ellipsoid { scales: unmoved.scales, ..got }, covariance((turn * unmoved.rotation).normalize(), unmoved.scales));
        }

        #[test]
        fn aligning_permutes_axes_to_within_63_degrees(parts in mixture(), reference in unit_quaternion()) {
            let got = moments(&parts, None);
            let aligned = reorder_axes_to_match(&got, reference);
            assert_covariance(&aligned, covariance(got.rotation, got.scales));
            // The rotation farthest from the 24 rotations of the cube is 62.8 degrees away.
            prop_assert!(aligned.rotation.dot(reference) > (62.9f64.to_radians() / 2.0).cos());
        }
    }

    #[test]
    fn merged_needles_keep_their_smallest_scale_to_1e_12() {
        for rotation in [DQuat::IDENTITY, tilt()] {
            for order in [DVec3::new(1e6, 1.0, 1e-6), DVec3::new(1e-6, 1e6, 1e-6), DVec3::new(1e-6, 3e-6, 1e6)] {
                let needle = part(0.5, DVec3::new(1.0, 2.0, 3.0), rotation, order);
                let got = reorder_axes_to_match(&moments(&[needle, needle], None), rotation);
                let error = ((got.scales - order) / order).abs().max_element();
                assert!(error < 1e-12, "got {:?}, expected {order:?}, relative error {error:e}", got.scales);
            }
        }
    }

    #[test]
    fn coplanar_flat_gaussians_stay_flat() {
        let (u, v) = (tilt() * DVec3::X, tilt() * DVec3::Y);
        let parts = [(0.1, 0.2), (-0.4, 0.3), (0.2, -0.5)]
            .map(|(a, b)| part(1.0 / 3.0, a * u + b * v, tilt(), DVec3::new(0.1, 0.2, 1e-9)));
        let got = moments(&parts, None);
        assert!((got.scales.z / 1e-9 - 1.0).abs() < 1e-6, "thickness {:e}, expected 1e-9", got.scales.z);
        let flat = parts.map(|p| WeightedGaussian { scales: p.scales.with_z(0.0), ..p });
        assert!(moments(&flat, None).scales.z < 1e-16);
    }

    #[test]
    fn equal_diagonal_covariance_gets_diagonal_axes() {
        // Σ = [[2, 1, 0], [1, 2, 0], [0, 0, 2]]: an eigenvector method that looks at the diagonal only finds a sphere.
        let long = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_4);
        let got = moments(&[part(1.0, DVec3::ZERO, long, DVec3::new(3f64.sqrt(), 1.0, 2f64.sqrt()))], None);
        assert!((got.scales - DVec3::new(3f64.sqrt(), 2f64.sqrt(), 1.0)).length() < 1e-14);
        let axis = DMat3::from_quat(got.rotation).x_axis;
        assert!((axis - DVec3::new(1.0, 1.0, 0.0).normalize()).length() < 1e-14, "longest axis {axis:?}");
    }

    #[test]
    fn extreme_scales_neither_overflow_nor_vanish() {
        for size in [1e-300, 1e-12, 1.0, 1e6, 1e200] {
            let parts = [-1.0, 1.0].map(|side| part(0.5, DVec3::X * size * side, tilt(), DVec3::splat(size)));
            let got = moments(&parts, None).scales / size;
            assert!((got - DVec3::new(2f64.sqrt(), 1.0, 1.0)).length() < 1e-14, "{size:e}: {got:?}");
        }
        let mixed = [
            part(0.5, DVec3::ZERO, tilt(), DVec3::splat(1e-12)),
            part(0.5, DVec3::ZERO, DQuat::IDENTITY, DVec3::splat(1e6)),
        ];
        assert!(moments(&mixed, None).scales.is_finite());
        assert_eq!(moments(&[], None).scales, DVec3::ZERO);
    }
}
