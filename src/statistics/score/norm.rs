//! Robust normalization of statistics: [`Norm`] maps the range between the 1st and the 99th percentile of a quantity to
//! 0 to 1.

use serde::{Deserialize, Serialize};

use super::FloatSketch;
use crate::recipe;

/// Normalization norm(X) = (X − P1) / (P99 − P1 + ε) of a quantity X with the 1st percentile P1 and the 99th percentile
/// P99; clipped to [0, 1] if the recipe asks for it.
///
/// If P99 ≤ P1 (at most 1% of the values differ from the rest), there is no scale to normalize by. norm is then 1 above
/// P99 and 0 elsewhere, and the score term that uses it is called *inactive*. This rule also applies if ε > 0: dividing
/// by ε = 1e-8 would let the few different values outweigh every other term by a factor of a million.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Norm {
    /// 1st percentile P1 of the quantity; 0 if it has no values. Either one of its values (nearest rank) or, with
    /// [`PercentilePasses::One`], the middle of a histogram bucket.
    pub p1: f64,
    /// 99th percentile P99 of the quantity; 0 if it has no values. Either one of its values (nearest rank) or, with
    /// [`PercentilePasses::One`], the middle of a histogram bucket.
    pub p99: f64,
    epsilon: f64,
    clip: bool,
}

/// How percentiles are found: exactly, in two passes over the values, or approximately, in one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PercentilePasses {
    /// Two passes over the values, which find the exact percentile.
    Two,
    /// One pass, which counts the values in a histogram. The result is the middle of the bucket that contains the
    /// percentile. The number is how many mantissa bits of a value (as f32) select its bucket: with more bits, buckets
    /// are narrower.
    One(u32),
}

impl Norm {
    /// Computes the 1st and the 99th percentile of the values that `values` iterates over, and returns the
    /// normalization by these percentiles, with the ε and the clipping of `recipe`. `passes` selects how the
    /// percentiles are found: exactly in two passes over the values, or approximately in one. NaN and infinities are
    /// ignored.
    pub fn from_values<I: Iterator<Item = f64>>(
        values: impl Fn() -> I,
        recipe: &recipe::ScoreParams,
        passes: PercentilePasses,
    ) -> Self {
        let [p1, p99] = match passes {
            PercentilePasses::Two => {
                let sketch = FloatSketch::from_values(values());
                [1.0, 99.0].map(|p| sketch.percentile(p, values()))
            }
            PercentilePasses::One(bits) => {
                let sketch = FloatSketch::with_mantissa_bits(bits, values());
                [1.0, 99.0].map(|p| sketch.rough_percentile(p))
            }
        }
        .map(|percentile| percentile.unwrap_or(0.0));
        Norm { p1, p99, epsilon: recipe.norm_epsilon, clip: recipe.clip_norm }
    }

    /// Returns whether the 1st and the 99th percentile differ. If they do not, a normalized value can only be 0 or 1.
    pub fn has_spread(&self) -> bool {
        self.p99 > self.p1
    }

    /// Returns norm(x), the normalized value of `x`.
    pub fn apply(&self, x: f64) -> f64 {
        if !self.has_spread() {
            return f64::from(u8::from(x > self.p99));
        }
        let norm = (x - self.p1) / (self.p99 - self.p1 + self.epsilon);
        if self.clip { norm.clamp(0.0, 1.0) } else { norm }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;

    fn preset_norm(preset: &str, values: &[f64]) -> Norm {
        Norm::from_values(|| values.iter().copied(), &Recipe::preset(preset).unwrap().score, PercentilePasses::Two)
    }

    #[test]
    fn a_constant_term_is_inactive_and_zero() {
        for preset in ["paper", "default"] {
            let norm = preset_norm(preset, &[0.3; 1000]);
            assert!(!norm.has_spread() && norm.apply(0.3) == 0.0 && norm.apply(0.300_000_1) == 1.0, "{norm:?}");
        }
    }

    #[test]
    fn default_is_clipped_and_paper_is_not() {
        let ramp: Vec<f64> = (0..1000).map(f64::from).collect();
        let (paper, default) = (preset_norm("paper", &ramp), preset_norm("default", &ramp));
        assert!(paper.apply(2000.0) > 2.0 && paper.apply(-50.0) < 0.0);
        assert!(default.apply(2000.0) == 1.0 && default.apply(-50.0) == 0.0);
    }

    #[test]
    fn an_empty_set_gives_an_inactive_norm() {
        let norm = preset_norm("default", &[]);
        assert!(!norm.has_spread() && norm.apply(0.0) == 0.0);
    }
}
