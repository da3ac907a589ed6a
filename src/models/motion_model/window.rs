//! Opacities that fade with the distance in time.
//!
//! The opacity is α = σ(o)·m, with the stored logit o, the logistic function σ, and the window m = exp(e), e ≤ 0. Its
//! logit ln α − ln(1 − α) equals e − ln(exp(−o) + 1 − m), which is computed in f64 without loss of precision for α near
//! 0 or 1.

use crate::model::exp_log::{exp_m1, ln};

/// Maximum absolute value of an opacity logit. Larger ones do not change the opacity noticeably.
pub(in crate::models) const MAX_LOGIT: f64 = 40.0;

/// Returns exp(−o) for a stored opacity logit o.
pub(in crate::models) fn inverse_odds(logit: f32) -> f64 {
    (-f64::from(logit)).exp()
}

/// Returns the logit of the faded opacity σ(o)·exp(`exponent`), clamped to ±[`MAX_LOGIT`]. `inverse_odds` is exp(−o)
/// for the stored opacity logit o. Has no branches, so that loops are vectorized.
#[inline(always)]
pub(in crate::models) fn faded_logit(inverse_odds: f64, exponent: f64) -> f64 {
    // The resulting opacity is at most m = exp(exponent).
    let exponent = if exponent < -MAX_LOGIT { -MAX_LOGIT } else { exponent };
    let logit = exponent - ln(inverse_odds - exp_m1(exponent));
    let logit = if logit > MAX_LOGIT { MAX_LOGIT } else { logit };
    if logit < -MAX_LOGIT { -MAX_LOGIT } else { logit }
}

/// Returns the derivative of [`faded_logit`] with respect to the stored logit o; 0 if the result of `faded_logit` is
/// clamped.
pub(in crate::models) fn slope(inverse_odds: f64, exponent: f64) -> f64 {
    let logit = faded_logit(inverse_odds, exponent);
    if logit.abs() < MAX_LOGIT { inverse_odds / (inverse_odds - exponent.exp_m1()) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faded_logit_equals_the_logit_of_the_product() {
        for logit in [-9.0f32, -3.0, 0.0, 2.0, 12.0] {
            for exponent in [0.0, -1e-9, -0.1, -1.0, -3.0, -20.0] {
                let alpha = (1.0 / (1.0 + (-f64::from(logit)).exp())) * f64::exp(exponent);
                let got = faded_logit(inverse_odds(logit), exponent);
                let again = 1.0 / (1.0 + (-got).exp());
                assert!((again / alpha - 1.0).abs() < 1e-12, "{logit} {exponent}: {again} {alpha}");
                let [above, below] = [1e-3f32, -1e-3].map(|by| faded_logit(inverse_odds(logit + by), exponent));
                let by = f64::from(logit + 1e-3) - f64::from(logit - 1e-3);
                let expected = (above - below) / by;
                let slope = slope(inverse_odds(logit), exponent);
                assert!((slope - expected).abs() < 1e-6, "{logit} {exponent}: {slope} {expected}");
            }
        }
        // Values that are clamped.
        assert_eq!(
            [faded_logit(inverse_odds(800.0), 0.0), faded_logit(inverse_odds(-800.0), 0.0), faded_logit(1.0, -1e300)],
            [MAX_LOGIT, -MAX_LOGIT, -MAX_LOGIT]
        );
        assert_eq!([slope(inverse_odds(800.0), 0.0), slope(inverse_odds(-800.0), 0.0), slope(1.0, -1e300)], [0.0; 3]);
    }
}
