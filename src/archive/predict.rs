//! Linear prediction of a value from `N` known neighboring values:
//!
//! predicted = mean + Σₖ weightₖ · differenceₖ, where differenceₖ is a neighboring value minus its own mean.

/// Denominator of the predictor weights, which are multiples of 1/64.
const WEIGHT_DENOMINATOR: f32 = 64.0;

/// Weights with which a value is predicted from `N` differences (known neighboring values less their means), in 64ths:
/// from −128 (weight −2) to 127.
pub(super) type PredictorWeights<const N: usize> = [i8; N];

/// Returns `weights`, which are stored in 64ths, as f32 factors: a weight of 64 becomes 1.0.
pub(super) fn factors<const N: usize>(weights: &PredictorWeights<N>) -> [f32; N] {
    weights.map(|weight| f32::from(weight) / WEIGHT_DENOMINATOR)
}

/// Returns the predicted value: `mean` plus each of `differences` times its factor, added in order.
#[inline(always)]
pub(super) fn expected<const N: usize>(mean: f32, factors: &[f32; N], differences: &[f32; N]) -> f32 {
    let mut sum = mean;
    for (factor, difference) in factors.iter().zip(differences) {
        sum += factor * difference;
    }
    sum
}

/// Least-squares fit of predictor weights, with which a value is predicted from `N` differences (known neighboring
/// values less their means).
#[derive(Debug)]
pub(super) struct PredictorFit<const N: usize> {
    /// For each pair of differences (known neighboring values less their means), the sum of their products over all
    /// samples (lower triangle).
    products: [[f64; N]; N],
    /// For each difference (known neighboring value less its mean), the sum over all samples of its product with the
    /// value to predict.
    with_value: [f64; N],
}

impl<const N: usize> PredictorFit<N> {
    /// Returns a least-squares fit to which no samples have been added yet.
    pub(super) fn new() -> Self {
        PredictorFit { products: [[0.0; N]; N], with_value: [0.0; N] }
    }

    /// Adds a sample to the least-squares fit: `value`, the value to predict minus the mean of all such values, and the
    /// `differences` from which it is predicted.
    #[inline(always)]
    pub(super) fn add(&mut self, differences: &[f32; N], value: f32) {
        for i in 0..N {
            for j in 0..=i {
                self.products[i][j] += f64::from(differences[i]) * f64::from(differences[j]);
            }
            self.with_value[i] += f64::from(differences[i]) * f64::from(value);
        }
    }

    /// Returns the fitted predictor weights in 64ths. Solves the normal equations by Cholesky factorization. To keep
    /// them solvable, first adds 1e-4 times the mean of the diagonal to every diagonal element. Returns zeros if the
    /// differences of all samples are 0, or if a difference is not finite.
    pub(super) fn weights(mut self) -> PredictorWeights<N> {
        let trace: f64 = (0..N).map(|i| self.products[i][i]).sum();
        if !(trace.is_finite() && trace > 0.0) {
            return [0; N];
        }
        for i in 0..N {
            self.products[i][i] += 1e-4 * trace / N as f64;
        }
        let mut root = [[0.0; N]; N];
        for i in 0..N {
            for j in 0..=i {
                let known: f64 = (0..j).map(|k| root[i][k] * root[j][k]).sum();
                let left = self.products[i][j] - known;
                root[i][j] = if i == j { left.max(f64::MIN_POSITIVE).sqrt() } else { left / root[j][j] };
            }
        }
        let mut found = self.with_value;
        for i in 0..N {
            let known: f64 = (0..i).map(|k| root[i][k] * found[k]).sum();
            found[i] = (found[i] - known) / root[i][i];
        }
        for i in (0..N).rev() {
            let known: f64 = (i + 1..N).map(|k| root[k][i] * found[k]).sum();
            found[i] = (found[i] - known) / root[i][i];
        }
        // `as` saturates and turns NaN into 0.
        found.map(|weight| (weight * f64::from(WEIGHT_DENOMINATOR)).round() as i8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_weighted_sum_is_recovered_exactly() {
        let mut fit = PredictorFit::new();
        for i in 0..400 {
            let x = [(i as f32 * 0.7).sin(), (i as f32 * 1.3).cos(), (i as f32 * 0.11).sin()];
            fit.add(&x, 0.75 * x[0] - 1.25 * x[1] + 0.5 * x[2]);
        }
        let weights = fit.weights();
        assert_eq!(weights, [48, -80, 32]);
        assert_eq!(expected(2.0, &factors(&weights), &[1.0, 1.0, 2.0]), 2.5);
    }

    #[test]
    fn zero_or_nan_differences_give_zero_weights() {
        let mut fit = PredictorFit::<4>::new();
        fit.add(&[0.0; 4], 1.0);
        assert_eq!(fit.weights(), [0; 4]);
        let mut fit = PredictorFit::<2>::new();
        fit.add(&[f32::NAN; 2], 1.0);
        assert_eq!(fit.weights(), [0; 2]);
    }
}
