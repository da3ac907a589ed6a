//! Exponentials and logarithms as polynomials.
//!
//! Loops over planes that call them run in vectors, and give the same bits whatever the system's mathematics library: no
//! operation is fused. Source: Taylor's series after Cody and Waite's reduction, "Software Manual for the Elementary
//! Functions", 1980.

use std::f64::consts::{FRAC_1_SQRT_2, LOG2_E};

/// 1.5 · 2⁵²: adding it rounds to an integer kept in the low bits.
const ROUND: f64 = 6_755_399_441_055_744.0;
/// ln 2 in two parts, the first with trailing zeros so that its products with n are exact.
const LN_2_HIGH: f64 = 0.693_147_180_369_123_8;
const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;

/// eˣ for |x| ≤ 700 to 1e-15 relative.
#[inline(always)]
pub fn exp(x: f64) -> f64 {
    let (r, rounded) = reduced(x);
    f64::from_bits((series(r) * r + 1.0).to_bits().wrapping_add(rounded.to_bits() << 52))
}

/// eˣ − 1 for |x| ≤ 700 to 1e-15 relative, also near 0.
#[inline(always)]
pub fn exp_m1(x: f64) -> f64 {
    let (r, rounded) = reduced(x);
    let power = f64::from_bits(1f64.to_bits().wrapping_add(rounded.to_bits() << 52));
    power * (series(r) * r) + (power - 1.0)
}

/// x = n·ln 2 + r with |r| ≤ ½·ln 2: r, and n in the low bits of a number.
#[inline(always)]
fn reduced(x: f64) -> (f64, f64) {
    let rounded = x * LOG2_E + ROUND;
    let n = rounded - ROUND;
    ((x - n * LN_2_HIGH) - n * LN_2_LOW, rounded)
}

/// (eʳ − 1)/r: Taylor to r¹³ / 13!, 2e-17 of eʳ at |r| = ½·ln 2.
#[inline(always)]
fn series(r: f64) -> f64 {
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

/// ln x of a normal positive x to 1e-15 relative; −709 of 0 and what is as small, itself of ∞ and of NaN.
#[inline(always)]
pub fn ln(x: f64) -> f64 {
    /// 2⁵²: in the low bits of it and what follows are integers.
    const INTEGERS: f64 = 4_503_599_627_370_496.0;
    const BIAS: u64 = 1023;
    // x = 2ⁿ·m with m from √½ to √2.
    let biased = x.to_bits().wrapping_add((BIAS << 52).wrapping_sub(FRAC_1_SQRT_2.to_bits())) >> 52;
    let n = f64::from_bits(biased | INTEGERS.to_bits()) - (INTEGERS + BIAS as f64);
    let m = f64::from_bits(x.to_bits().wrapping_sub(biased << 52).wrapping_add(BIAS << 52));
    // ln m = 2·(s + s³/3 + s⁵/5 + …), to s¹⁹/19: 2e-17 of it.
    let s = (m - 1.0) / (m + 1.0);
    let square = s * s;
    let mut sum = 1.0 / 19.0;
    for inverse in [1.0 / 17.0, 1.0 / 15.0, 1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0] {
        sum = sum * square + inverse;
    }
    let of_mantissa = 2.0 * (s + s * (square * sum));
    let found = n * LN_2_HIGH + (n * LN_2_LOW + of_mantissa);
    if x < f64::INFINITY { found } else { x }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponentials_are_within_1e_15_of_the_truth() {
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
    fn logarithms_are_within_1e_15_of_the_truth() {
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
