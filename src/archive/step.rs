//! Steps of uniform quantization grids. Each step is given by a whole number, so that every machine computes the same
//! values.
//!
//! Step `k` is 2^(k/8). A value `v` on the grid with step `s` is stored as the whole number `round(v / s)` and restored
//! as `v'`, the f32 nearest to this number times `s`. So |v' − v| ≤ s/2, plus at most half a unit in the last place of
//! an f32.

/// The powers 2^(i/8) for `i` from 0 to 7.
const EIGHTHS: [f64; 8] = [
    1.0,
    1.090_507_732_665_257_7,
    1.189_207_115_002_721,
    1.296_839_554_651_009_6,
    std::f64::consts::SQRT_2,
    1.542_210_825_407_940_7,
    1.681_792_830_507_429,
    1.834_008_086_409_342_4,
];

/// Allowed step numbers `k`; the steps range from 2^−40 to 2^40.
pub const STEP_NUMBERS: std::ops::RangeInclusive<i32> = -320..=320;

/// Maximum absolute value of a stored multiple of the step, so that multiples and sums of them are exact in an f64.
const MAX_MULTIPLE: f64 = (1u64 << 50) as f64;

/// Constant 1.5 · 2^52: adding and subtracting it rounds to the nearest whole number, halves to even, for |x| < 2^51.
const ROUNDING: f64 = 6_755_399_441_055_744.0;

/// Returns the whole number nearest to `x`, halves to even; 0 for NaN. The magnitude of `x` must be below 2^51.
#[inline(always)]
fn rounded(x: f64) -> i64 {
    (x + ROUNDING - ROUNDING) as i64
}

/// Returns the quantization step 2^(k/8).
pub fn step_size(k: i32) -> f64 {
    let whole = k.div_euclid(8).clamp(-1000, 1000);
    EIGHTHS[k.rem_euclid(8) as usize] * f64::from_bits(((1023 + whole) as u64) << 52)
}

/// Returns the number `k` in [`STEP_NUMBERS`] whose step 2^(k/8) is closest to 2^`octave` on a logarithmic scale.
pub fn nearest_step_number(octave: f64) -> i32 {
    ((8.0 * octave).round() as i32).clamp(*STEP_NUMBERS.start(), *STEP_NUMBERS.end())
}

/// Number of possible values of [`PredictedMultiple::offset`], which says where between two quantized values a
/// predicted value lies.
pub(super) const OFFSETS: usize = 8;

/// Multiple of a quantization step that is nearest to a predicted value, and the offset of the value from it.
#[derive(Debug, Clone, Copy)]
pub(super) struct PredictedMultiple {
    pub(super) multiple: i64,
    /// Offset of the predicted value from `multiple`, as the index (0 to 7) of the interval in which the value lies.
    /// The intervals divide the step around the multiple into eighths: interval 0 begins half a step below the
    /// multiple, and interval 7 ends half a step above it.
    pub(super) offset: usize,
}

/// Uniform grid of the values to which quantization rounds: all multiples of a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct QuantizationGrid {
    step: f64,
    inverse: f64,
}

impl QuantizationGrid {
    /// Returns the grid with the step 2^(k/8).
    pub(super) fn new(k: i32) -> QuantizationGrid {
        let step = step_size(k);
        QuantizationGrid { step, inverse: 1.0 / step }
    }

    /// Returns the whole number of steps nearest to `value`; 0 for NaN.
    #[inline(always)]
    pub(super) fn multiple(self, value: f32) -> i64 {
        self.nearest(f64::from(value))
    }

    /// Returns the whole number of steps nearest to `value`, at most [`MAX_MULTIPLE`] in magnitude; 0 for NaN.
    #[inline(always)]
    pub(super) fn nearest(self, value: f64) -> i64 {
        rounded(self.clamped(value))
    }

    /// Returns `value` in units of the quantization step, limited to [`MAX_MULTIPLE`] in magnitude.
    #[inline(always)]
    fn clamped(self, value: f64) -> f64 {
        (value * self.inverse).clamp(-MAX_MULTIPLE, MAX_MULTIPLE)
    }

    /// Returns the multiple of the quantization step that is nearest to the predicted value `value`, and the offset of
    /// the value from this multiple.
    #[inline(always)]
    pub(super) fn predicted(self, value: f32) -> PredictedMultiple {
        let x = self.clamped(f64::from(value));
        let multiple = rounded(x);
        // `as` rounds down, and turns NaN into 0.
        let offset = ((x - multiple as f64 + 0.5) * OFFSETS as f64) as usize;
        PredictedMultiple { multiple, offset: offset.min(OFFSETS - 1) }
    }

    /// Returns the value that the whole number `multiple` stands for: `multiple` times the step.
    #[inline(always)]
    pub(super) fn value(self, multiple: i64) -> f32 {
        (multiple as f64 * self.step) as f32
    }

    /// Returns the length `size` in units of the step.
    #[inline(always)]
    pub(super) fn in_steps(self, size: f32) -> f32 {
        size * self.inverse as f32
    }

    /// Returns the step, which is the distance between neighboring grid values.
    #[inline(always)]
    pub(super) fn size(self) -> f32 {
        self.step as f32
    }

    /// Returns the grid value nearest to `value`.
    pub(super) fn round(self, value: f32) -> f32 {
        self.value(self.multiple(value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn eight_steps_are_an_octave() {
        for k in STEP_NUMBERS {
            let expected = (f64::from(k) / 8.0).exp2();
            assert!((step_size(k) / expected - 1.0).abs() < 1e-14, "{k}: {} of {expected}", step_size(k));
            assert_eq!(nearest_step_number(step_size(k).log2()), k);
        }
    }

    proptest! {
        #[test]
        fn a_value_is_restored_within_half_a_step(value in -1e6f32..1e6, k in -100i32..60) {
            let back = QuantizationGrid::new(k).round(value);
            let bound = step_size(k) / 2.0 + f64::from(value.abs()) * f64::from(f32::EPSILON);
            prop_assert!((f64::from(back) - f64::from(value)).abs() <= bound, "{value} {back} {bound}");
        }

        #[test]
        fn values_on_the_grid_are_unchanged(multiple in -(1i64 << 20)..1 << 20, k in -100i32..60) {
            let grid = QuantizationGrid::new(k);
            prop_assert_eq!(grid.multiple(grid.value(multiple)), multiple);
        }
    }
}
