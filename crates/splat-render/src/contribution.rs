//! How much of the pictures each Gaussian is.

use serde::{Deserialize, Serialize};

/// Visible contribution of N Gaussians over any number of pictures (method.md, section 1: C `visible`, and W).
///
/// Both figures are the same whatever the order of pictures and the number of threads. Memory: 12 bytes
/// per Gaussian.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Contribution {
    /// `[N]`, Σ over pixels of alpha · transmittance, in units of 2⁻²⁸ pixel ([`Contribution::UNIT`]).
    ///
    /// A picture's part is summed per 16×16 tile in f32, in a fixed order, and rounded to a unit: relative
    /// error below 3e-6 and absolute below 2e-9 per tile. A sum that would pass 2⁶⁴ (7e10 fully covered
    /// pixels) stays there.
    pub sum: Vec<u64>,
    /// `[N]`, largest alpha · transmittance of any pixel, in [0, 0.99].
    pub max: Vec<f32>,
}

impl Contribution {
    /// Pixels per unit of [`Contribution::sum`]: 2⁻²⁸. The least weight a pixel can have, 1e-4 / 255, is
    /// 105 units; 800,000 fully covered pictures of 320×256 fit.
    pub const UNIT: f64 = 1.0 / (1u64 << 28) as f64;

    /// Nothing seen of `len` Gaussians.
    pub fn new(len: usize) -> Self {
        Contribution { sum: vec![0; len], max: vec![0.0; len] }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.sum.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.sum.is_empty()
    }

    /// Σ alpha · transmittance of Gaussian `i`, pixels.
    pub fn pixels(&self, i: usize) -> f64 {
        self.sum[i] as f64 * Self::UNIT
    }

    /// Adds what `other` saw of the same Gaussians, in other pictures.
    ///
    /// # Panics
    /// If the lengths differ.
    pub fn merge(&mut self, other: &Contribution) {
        assert_eq!(self.len(), other.len(), "contributions of different models");
        for (sum, other) in self.sum.iter_mut().zip(&other.sum) {
            *sum = sum.saturating_add(*other);
        }
        for (max, other) in self.max.iter_mut().zip(&other.max) {
            *max = max.max(*other);
        }
    }

    /// Adds one tile's weight of Gaussian `i`.
    pub(super) fn add(&mut self, i: usize, sum: f32, max: f32) {
        let units = (f64::from(sum) * (1.0 / Self::UNIT) + 0.5) as u64;
        self.sum[i] = self.sum[i].saturating_add(units);
        self.max[i] = self.max[i].max(max);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_stay_at_the_top_instead_of_wrapping() {
        let mut near = Contribution::new(1);
        near.sum[0] = u64::MAX - 5;
        near.add(0, 1.0, 0.5);
        let other = near.clone();
        near.merge(&other);
        assert_eq!((near.sum[0], near.max[0]), (u64::MAX, 0.5));
    }
}
