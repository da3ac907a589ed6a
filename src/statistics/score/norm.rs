//! Robust min-max normalization between the 1st and the 99th percentile.

use serde::{Deserialize, Serialize};

use super::FloatSketch;
use crate::recipe;

/// norm(X) = (X − P1) / (P99 − P1 + ε), clipped to [0, 1] if asked.
///
/// Where P99 ≤ P1 (at most 1% of the values stand out) there is no scale to measure by: norm is 1
/// above P99 and 0 elsewhere, and the term is *inactive*. This holds with ε too: dividing by
/// ε = 1e-8 would let the few that stand out outweigh every other term a million times.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Norm {
    /// 1st percentile, nearest rank; 0 over no values.
    pub p1: f64,
    /// 99th percentile, nearest rank; 0 over no values.
    pub p99: f64,
    epsilon: f64,
    clip: bool,
}

/// How often the values are looked at for a percentile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PercentilePasses {
    /// Twice: exact.
    Two,
    /// Once, by so many mantissa bits: the middle of the bucket that holds it.
    One(u32),
}

impl Norm {
    /// The normalization of a set of values; NaN and infinities are passed over.
    pub fn from_values<I: Iterator<Item = f64>>(
        values: impl Fn() -> I,
        recipe: &recipe::ScoreParams,
        looks: PercentilePasses,
    ) -> Self {
        let [p1, p99] = match looks {
            PercentilePasses::Two => {
                let sketch = FloatSketch::from_values(values());
                [1.0, 99.0].map(|p| sketch.percentile(p, values()))
            }
            PercentilePasses::One(bits) => {
                let sketch = FloatSketch::keyed_by(bits, values());
                [1.0, 99.0].map(|p| sketch.rough_percentile(p))
            }
        }
        .map(|percentile| percentile.unwrap_or(0.0));
        Norm { p1, p99, epsilon: recipe.norm_epsilon, clip: recipe.clip_norm }
    }

    /// Whether the percentiles differ, so that the term grades rather than splits.
    pub fn is_active(&self) -> bool {
        self.p99 > self.p1
    }

    /// norm(x).
    pub fn apply(&self, x: f64) -> f64 {
        if !self.is_active() {
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

    fn norm_of(preset: &str, values: &[f64]) -> Norm {
        Norm::from_values(|| values.iter().copied(), &Recipe::preset(preset).unwrap().score, PercentilePasses::Two)
    }

    #[test]
    fn a_constant_term_is_inactive_and_zero() {
        for preset in ["paper", "default"] {
            let norm = norm_of(preset, &[0.3; 1000]);
            assert!(!norm.is_active() && norm.apply(0.3) == 0.0 && norm.apply(0.300_000_1) == 1.0, "{norm:?}");
        }
    }

    #[test]
    fn default_is_clipped_and_paper_is_not() {
        let ramp: Vec<f64> = (0..1000).map(f64::from).collect();
        let (paper, default) = (norm_of("paper", &ramp), norm_of("default", &ramp));
        assert!(paper.apply(2000.0) > 2.0 && paper.apply(-50.0) < 0.0);
        assert!(default.apply(2000.0) == 1.0 && default.apply(-50.0) == 0.0);
    }

    #[test]
    fn no_values_give_an_inactive_norm() {
        let norm = norm_of("default", &[]);
        assert!(!norm.is_active() && norm.apply(0.0) == 0.0);
    }
}
