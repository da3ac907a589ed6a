//! Weighted least squares fit of polynomials of low degree, in f64.

/// Fits a polynomial Σ cₖ·uᵏ with `K` coefficients, at most 4, to each of the `C` components of `samples`. A sample is
/// (u, y, w): argument, values of the components, and weight. Arguments u should lie about between −1 and 1.
///
/// Returns the coefficients c₀ … that minimize Σ w·(y − Σ cₖ·uᵏ)² + `ridge`·Σ w·(c₁² + c₂² + …). The ridge term keeps
/// coefficients small that the samples do not determine. It is proportional to the total weight, so `ridge` does not
/// depend on the unit of the weights. Returns zeros if the system cannot be solved.
pub(crate) fn polynomial<const K: usize, const C: usize>(
    samples: impl Iterator<Item = (f64, [f64; C], f64)>,
    ridge: f64,
) -> [[f64; C]; K] {
    const { assert!(K <= 4) };
    // Sums of w·uⁱ, which are the elements of the normal matrix.
    let mut moments = [0.0; 7];
    let mut right = [[0.0; C]; K];
    for (u, y, w) in samples {
        let mut weighted_power = w;
        for (i, moment) in moments[..2 * K - 1].iter_mut().enumerate() {
            *moment += weighted_power;
            if i < K {
                right[i].iter_mut().zip(y).for_each(|(to, y)| *to += weighted_power * y);
            }
            weighted_power *= u;
        }
    }
    let mut normal: [[f64; K]; K] = std::array::from_fn(|i| std::array::from_fn(|j| moments[i + j]));
    for (k, row) in normal.iter_mut().enumerate().skip(1) {
        row[k] += ridge * moments[0] + f64::MIN_POSITIVE;
    }
    // Gauss-Jordan elimination with pivots. The matrix is positive definite except for rounding errors.
    for k in 0..K {
        let pivot = (k..K).max_by(|&a, &b| normal[a][k].abs().total_cmp(&normal[b][k].abs())).unwrap_or(k);
        normal.swap(k, pivot);
        right.swap(k, pivot);
        let by = normal[k][k];
        if by == 0.0 || !by.is_finite() {
            return [[0.0; C]; K];
        }
        for i in (0..K).filter(|&i| i != k) {
            let factor = normal[i][k] / by;
            let (pivot_normal, pivot_right) = (normal[k], right[k]);
            normal[i].iter_mut().zip(pivot_normal).for_each(|(to, from)| *to -= factor * from);
            right[i].iter_mut().zip(pivot_right).for_each(|(to, from)| *to -= factor * from);
        }
    }
    std::array::from_fn(|k| right[k].map(|value| value / normal[k][k]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_are_recovered_and_free_coefficients_stay_small() {
        let cubic = |u: f64| [1.0 - 2.0 * u + 0.5 * u * u - 3.0 * u.powi(3), 4.0];
        let found: [[f64; 2]; 4] = polynomial(
            (0..9).map(|i| (f64::from(i) / 4.0 - 1.0, cubic(f64::from(i) / 4.0 - 1.0), 1.0 + f64::from(i))),
            0.0,
        );
        for (found, expected) in found.iter().zip([[1.0, 4.0], [-2.0, 0.0], [0.5, 0.0], [-3.0, 0.0]]) {
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}, expected {expected:?}");
        }
        let alone: [[f64; 1]; 4] = polynomial([(0.3, [7.0], 2.0)].into_iter(), 1e-6);
        let at = (0..4).map(|k| alone[k][0] * 0.3f64.powi(k as i32)).sum::<f64>();
        assert!((at - 7.0).abs() < 1e-3 && alone[3][0].abs() < 8.0, "{alone:?}");
    }
}
