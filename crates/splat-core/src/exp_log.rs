//! Exponential and logarithm functions, computed with polynomials.
//!
//! The compiler vectorizes loops over arrays that call these functions. Results have the same bits on every system,
//! because the functions neither call the math library of the system nor fuse operations. Source: Taylor series after
//! the range reduction of Cody and Waite, "Software Manual for the Elementary Functions", 1980.

use std::f64::consts::{FRAC_1_SQRT_2, LOG2_E};

/// Rounding constant 1.5 · 2⁵². Adding it to a number rounds the number to an integer, which the low bits of the sum
/// then hold.
const ROUND: f64 = 6_755_399_441_055_744.0;
/// Upper digits of ln 2. The constant ends in zero bits, so that its product with an integer n is exact.
const LN_2_HIGH: f64 = 0.693_147_180_369_123_8;
/// Lower digits of ln 2: ln 2 minus `LN_2_HIGH`.
const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;

/// Computes eˣ for |x| ≤ 700 with a relative error of at most 1e-15.
#[inline(always)]
pub fn exp(x: f64) -> f64 {
    let (r, rounded) = reduce_range(x);
    f64::from_bits((expm1_over_r(r) * r + 1.0).to_bits().wrapping_add(rounded.to_bits() << 52))
}

/// Computes eˣ − 1 for |x| ≤ 700 with a relative error of at most 1e-15, also near 0.
#[inline(always)]
pub fn exp_m1(x: f64) -> f64 {
    let (r, rounded) = reduce_range(x);
    let power = f64::from_bits(1f64.to_bits().wrapping_add(rounded.to_bits() << 52));
    power * (expm1_over_r(r) * r) + (power - 1.0)
}

/// Splits x into n·ln 2 + r with |r| ≤ ½·ln 2 and an integer n. Returns r, and a number whose low bits hold n.
#[inline(always)]
fn reduce_range(x: f64) -> (f64, f64) {
    let rounded = x * LOG2_E + ROUND;
    let n = rounded - ROUND;
    ((x - n * LN_2_HIGH) - n * LN_2_LOW, rounded)
}

/// Computes (eʳ − 1)/r by its Taylor series up to r¹² / 13!. The truncation error is 2e-17 of eʳ at |r| = ½·ln 2.
#[inline(always)]
fn expm1_over_r(r: f64) -> f64 {
    let mut sum = 1.0 / 6_227_020_800.0;
    for inverse_factorial in [
        1.0 / 479_001_600.0,
        1.0 / 39_916_800.0,
        1.0 / 3_628_800.0,
        1.0 / 362_880.0,
        1.0 / 40_320.0,
        1.0 / 5_040.0,
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
    ] {
        sum = sum * r + inverse_factorial;
    }
    sum
}

/// Computes the natural logarithm of a normal positive x with a relative error of at most 1e-15.
///
/// Returns about −709 for 0 and subnormal numbers, and x itself for ∞ and NaN.
#[inline(always)]
pub fn ln(x: f64) -> f64 {
    /// 2⁵². For an f64 x from 2⁵² to 2⁵³, the low bits of x hold the integer x − 2⁵².
    const INTEGERS: f64 = 4_503_599_627_370_496.0;
    const BIAS: u64 = 1023;
    // x = 2ⁿ·m with m between √½ and √2.
    let biased = x.to_bits().wrapping_add((BIAS << 52).wrapping_sub(FRAC_1_SQRT_2.to_bits())) >> 52;
    let n = f64::from_bits(biased | INTEGERS.to_bits()) - (INTEGERS + BIAS as f64);
    let m = f64::from_bits(x.to_bits().wrapping_sub(biased << 52).wrapping_add(BIAS << 52));
    // ln m = 2·(s + s³/3 + s⁵/5 + …) up to s¹⁹/19; the truncation error is 2e-17 of the sum.
    let s = (m - 1.0) / (m + 1.0);
    let square = s * s;
    let mut sum = 1.0 / 19.0;
    for inverse in [1.0 / 17.0, 1.0 / 15.0, 1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0] {
        sum = sum * square + inverse;
    }
    let ln_mantissa = 2.0 * (s + s * (square * sum));
    let found = n * LN_2_HIGH + (n * LN_2_LOW + ln_mantissa);
    if x < f64::INFINITY { found } else { x }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_has_relative_error_below_1e_15() {
        for step in -80_000..=80_000 {
            let x = f64::from(step) * 1e-3 + 1e-4;
            let error = (exp(x) / x.exp() - 1.0).abs();
            assert!(error < 1e-15, "exp({x}) is off by {error:e}, expected below 1e-15");
            for x in [x, x * 1e-4, x * 1e-12] {
                let error = (exp_m1(x) / x.exp_m1() - 1.0).abs();
                assert!(error < 1e-15, "exp({x}) − 1 is off by {error:e}, expected below 1e-15");
            }
        }
        assert_eq!([exp(0.0), exp_m1(0.0)], [1.0, 0.0]);
        assert!(exp(f64::NAN).is_nan() && exp_m1(f64::NAN).is_nan());
    }

    #[test]
    fn ln_has_relative_error_below_1e_15() {
        for step in -70_000..=70_000 {
            for x in [(f64::from(step) * 1e-2 + 1e-4).exp(), 1.0 + f64::from(step) * 1e-9, 1.0 + f64::from(step) * 1e-6]
            {
                if x != 1.0 {
                    let error = (ln(x) / x.ln() - 1.0).abs();
                    assert!(error < 1e-15, "ln {x} is off by {error:e}, expected below 1e-15");
                }
            }
        }
        assert_eq!([ln(1.0), ln(f64::INFINITY)], [0.0, f64::INFINITY]);
        assert!(ln(0.0) < -709.0 && ln(f64::NAN).is_nan());
    }
}
