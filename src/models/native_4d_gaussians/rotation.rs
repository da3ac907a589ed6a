//! Four-dimensional rotations, given as pairs of quaternions.
//!
//! The rotation matrix is R = L(l)·R̄(r). It acts on vectors that stand for quaternions (w, x, y, z). L multiplies from
//! the left by the unit quaternion l, and R̄ from the right by the conjugate of the unit quaternion r.
//!
//! Models apply a matrix to the axes x, y, z and t of space and time, in this order. In checkpoints since 15 September
//! 2024, this matrix is R with its rows and its columns in reversed order; in older ones it is R itself. Source:
//! `build_rotation_4d` of the repository fudan-zvg/4d-gaussian-splatting on GitHub.

use glam::DMat4;

/// 4×4 matrix, row by row.
pub(super) type Matrix = [[f64; 4]; 4];

/// Returns the matrix that multiplies a quaternion from the left by the quaternion (a, b, c, d).
fn left([a, b, c, d]: [f64; 4]) -> Matrix {
    [[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]]
}

/// Returns the matrix that multiplies a quaternion from the right by the conjugate of the quaternion (p, q, r, s).
fn right([p, q, r, s]: [f64; 4]) -> Matrix {
    [[p, q, r, s], [-q, p, -s, r], [-r, s, p, -q], [-s, -r, q, p]]
}

/// Returns the product of two matrices.
fn product(a: &Matrix, b: &Matrix) -> Matrix {
    [0, 1, 2, 3].map(|i| [0, 1, 2, 3].map(|j| (0..4).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Returns the matrix with rows and columns in reversed order. Applied twice, it returns the original matrix.
fn reversed(a: &Matrix) -> Matrix {
    [3, 2, 1, 0].map(|i| [3, 2, 1, 0].map(|j| a[i][j]))
}

/// Returns the quaternion `q` scaled to length 1; the identity (1, 0, 0, 0) if its length is 0.
fn unit(q: [f64; 4]) -> [f64; 4] {
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length > 0.0 { q.map(|x| x / length) } else { [1.0, 0.0, 0.0, 0.0] }
}

/// Returns the rotation matrix of the left and the right quaternion, which may have any length; length 0 counts as the
/// identity. If `flipped`, the order of rows and columns is reversed, as in checkpoints since 15 September 2024.
pub(super) fn rotation([l, r]: [[f64; 4]; 2], flipped: bool) -> Matrix {
    let whole = product(&left(unit(l)), &right(unit(r)));
    if flipped { reversed(&whole) } else { whole }
}

/// Returns the left and the right unit quaternion of the 4D rotation `matrix`, which must have determinant 1. `flipped`
/// states that the order of rows and columns of `matrix` is reversed, as in checkpoints since 15 September 2024.
pub(super) fn quaternions(matrix: &Matrix, flipped: bool) -> [[f64; 4]; 2] {
    let matrix = if flipped { reversed(matrix) } else { *matrix };
    let axis = |i: usize| {
        let mut axis = [0.0; 4];
        axis[i] = 1.0;
        axis
    };
    // Products of the basis matrices are orthogonal, each with squared norm 4. This gives the matrix of coefficients
    // l_i·r_j, which has rank 1.
    let coefficient = |i: usize, j: usize| -> f64 {
        let basis = product(&left(axis(i)), &right(axis(j)));
        basis.iter().flatten().zip(matrix.iter().flatten()).map(|(a, b)| a * b).sum::<f64>() / 4.0
    };
    let rows: [[f64; 4]; 4] = [0, 1, 2, 3].map(|i| [0, 1, 2, 3].map(|j| coefficient(i, j)));
    let square = |row: &[f64; 4]| row.iter().map(|x| x * x).sum::<f64>();
    let strongest = (1..4).fold(0, |largest, i| if square(&rows[i]) > square(&rows[largest]) { i } else { largest });
    let r = unit(rows[strongest]);
    let l = rows.map(|row| row.iter().zip(r).map(|(a, b)| a * b).sum::<f64>());
    [unit(l), r]
}

/// Returns the covariance R diag(s)² Rᵀ of a rotation R and scales s.
pub(super) fn covariance(rotation: &Matrix, scales: [f64; 4]) -> Matrix {
    [0, 1, 2, 3]
        .map(|i| [0, 1, 2, 3].map(|j| (0..4).map(|k| rotation[i][k] * scales[k].powi(2) * rotation[j][k]).sum()))
}

/// Returns scales and rotation (determinant 1) of a covariance, by Jacobi's method. The axis with the largest time
/// component comes last. Squares of scales are at least 1e-14.
pub(super) fn decomposed(covariance: &Matrix) -> ([f64; 4], Matrix) {
    const SWEEPS: usize = 16;
    const MIN_SQUARE: f64 = 1e-14;
    let mut a = [0, 1, 2, 3].map(|i| [0, 1, 2, 3].map(|j| 0.5 * (covariance[i][j] + covariance[j][i])));
    // Row i of this matrix is axis i.
    let mut axes = [0, 1, 2, 3].map(|i| [0, 1, 2, 3].map(|j| f64::from(u8::from(i == j))));
    let largest = a.iter().flatten().fold(0.0f64, |largest, x| largest.max(x.abs()));
    for _ in 0..SWEEPS {
        let mut relative_difference = 0.0f64;
        for p in 0..4 {
            for q in p + 1..4 {
                relative_difference = relative_difference.max(a[p][q].abs());
                if a[p][q].abs() <= 1e-19 * largest {
                    continue;
                }
                let zeta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                let tangent = 1f64.copysign(zeta) / (zeta.abs() + zeta.hypot(1.0));
                let cosine = 1.0 / tangent.hypot(1.0);
                let sine = cosine * tangent;
                for row in &mut a {
                    (row[p], row[q]) = (cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]);
                }
                for of in [&mut a, &mut axes] {
                    let (first, second) = (of[p], of[q]);
                    of[p] = std::array::from_fn(|k| cosine * first[k] - sine * second[k]);
                    of[q] = std::array::from_fn(|k| sine * first[k] + cosine * second[k]);
                }
            }
        }
        if relative_difference <= 1e-18 * largest {
            break;
        }
    }
    let time_axis = (0..3).fold(3, |last, i| if axes[i][3].abs() > axes[last][3].abs() { i } else { last });
    let mut order = [0, 1, 2, 3];
    order.swap(time_axis, 3);
    let scales = order.map(|i| a[i][i].max(MIN_SQUARE).sqrt());
    let mut rotation = [0, 1, 2, 3].map(|row| order.map(|i| axes[i][row]));
    if determinant(&rotation) < 0.0 {
        rotation.iter_mut().for_each(|row| row[0] = -row[0]);
    }
    (scales, rotation)
}

/// Returns the determinant of a matrix.
fn determinant(a: &Matrix) -> f64 {
    DMat4::from_cols_array_2d(a).determinant()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Returns the product of two quaternions (w, x, y, z).
    fn hamilton([a, b, c, d]: [f64; 4], [p, q, r, s]: [f64; 4]) -> [f64; 4] {
        [
            a * p - b * q - c * r - d * s,
            a * q + b * p + c * s - d * r,
            a * r - b * s + c * p + d * q,
            a * s + b * r - c * q + d * p,
        ]
    }

    fn quaternion() -> impl Strategy<Value = [f64; 4]> {
        prop::array::uniform4(-2.0..2.0f64).prop_filter("direction", |q| q.iter().map(|x| x * x).sum::<f64>() > 0.05)
    }

    fn relative_difference(a: &Matrix, b: &Matrix) -> f64 {
        let largest = b.iter().flatten().fold(0.0f64, |largest, x| largest.max(x.abs()));
        a.iter()
            .flatten()
            .zip(b.iter().flatten())
            .fold(0.0f64, |relative_difference, (a, b)| relative_difference.max((a - b).abs()))
            / largest
    }

    proptest! {
        #[test]
        fn rotation_multiplies_by_l_and_the_conjugate_of_r(
            l in quaternion(), r in quaternion(), at in quaternion()
        ) {
            let conjugate = |[a, b, c, d]: [f64; 4]| [a, -b, -c, -d];
            let expected = hamilton(hamilton(unit(l), at), conjugate(unit(r)));
            let apply = |matrix: &Matrix, at: [f64; 4]| matrix.map(|row| (0..4).map(|k| row[k] * at[k]).sum::<f64>());
            let got = apply(&rotation([l, r], false), at);
            prop_assert!((0..4).all(|i| (got[i] - expected[i]).abs() < 1e-13), "{got:?} {expected:?}");
            // With reversed axes, the quaternion components w, x, y, z come in the order z, y, x, w.
            let back = |[a, b, c, d]: [f64; 4]| [d, c, b, a];
            let got = back(apply(&rotation([l, r], true), back(at)));
            prop_assert!((0..4).all(|i| (got[i] - expected[i]).abs() < 1e-13), "{got:?} {expected:?}");
        }

        #[test]
        fn quaternions_reproduce_the_rotation(l in quaternion(), r in quaternion(), flipped: bool) {
            let matrix = rotation([l, r], flipped);
            prop_assert!((determinant(&matrix) - 1.0).abs() < 1e-13);
            prop_assert!(relative_difference(&rotation(quaternions(&matrix, flipped), flipped), &matrix) < 1e-14);
        }

        #[test]
        fn decomposition_reproduces_the_covariance(
            l in quaternion(), r in quaternion(), logs in prop::array::uniform4(-5.0..1.0f64), flipped: bool
        ) {
            let expected = covariance(&rotation([l, r], flipped), logs.map(f64::exp));
            let (scales, found) = decomposed(&expected);
            prop_assert!((determinant(&found) - 1.0).abs() < 1e-12);
            prop_assert!((0..3).all(|i| found[3][i].abs() <= found[3][3].abs()));
            let again = covariance(&rotation(quaternions(&found, flipped), flipped), scales);
            prop_assert!(relative_difference(&again, &expected) < 1e-14, "{}", relative_difference(&again, &expected));
        }
    }
}
