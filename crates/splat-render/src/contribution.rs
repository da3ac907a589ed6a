//! Visible contribution of every Gaussian to renders: its weight in a pixel (alpha · transmittance), summed over
//! pixels.

use serde::{Deserialize, Serialize};

/// Visible contribution of N Gaussians, over any number of views: the sum and the maximum of the weights of each
/// Gaussian in all pixels. The weight of a Gaussian in a pixel is its alpha times the transmittance in front of it. In
/// docs/method.md, section 1, the sum is C with the option `visible`, and the maximum is W.
///
/// The values do not depend on the order of views or the number of threads. Memory: 12 bytes per Gaussian.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Contribution {
    /// Contribution of each Gaussian: its weight alpha · transmittance summed over all pixels, in units of 2⁻²⁸ pixel
    /// ([`Contribution::SUM_UNIT`]).
    ///
    /// Within a view, weights are summed per 16×16 tile in f32, in a fixed order, and each tile sum is rounded to a
    /// unit: relative error below 3e-6, absolute error below 2e-9 pixels per tile. A sum stops growing at 2⁶⁴ units
    /// (7e10 fully covered pixels).
    pub sum: Vec<u64>,
    /// Largest weight alpha · transmittance of each Gaussian in any pixel, from 0 to 0.99.
    pub max: Vec<f32>,
}

impl Contribution {
    /// Unit of [`Contribution::sum`]: 2⁻²⁸ pixels. The smallest weight in a pixel, 1e-4 / 255, is 105 units. A sum can
    /// hold 800,000 fully covered images of 320×256.
    pub const SUM_UNIT: f64 = 1.0 / (1u64 << 28) as f64;

    /// Creates zero contributions of `len` Gaussians.
    pub fn new(len: usize) -> Self {
        Contribution { sum: vec![0; len], max: vec![0.0; len] }
    }

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.sum.len()
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.sum.is_empty()
    }

    /// Returns the contribution of Gaussian `i`, alpha · transmittance summed over all pixels, in pixels.
    pub fn in_pixels(&self, i: usize) -> f64 {
        self.sum[i] as f64 * Self::SUM_UNIT
    }

    /// Adds to `self` the contributions in `other`, which come from other views of the same Gaussians. Sums are added;
    /// of the two maxima of a Gaussian, the larger is kept.
    ///
    /// # Panics
    /// Panics if the numbers of Gaussians differ.
    pub fn merge(&mut self, other: &Contribution) {
        assert_eq!(self.len(), other.len(), "expected contributions of equally many Gaussians");
        for (sum, other) in self.sum.iter_mut().zip(&other.sum) {
            *sum = sum.saturating_add(*other);
        }
        for (max, other) in self.max.iter_mut().zip(&other.max) {
            *max = max.max(*other);
        }
    }

    /// Adds to the contribution of Gaussian `i` its contribution in one tile of a view: `sum` is the sum of its weights
    /// over the pixels of the tile, and `max` its largest weight in one of them.
    pub(super) fn add(&mut self, i: usize, sum: f32, max: f32) {
        let units = (f64::from(sum) * (1.0 / Self::SUM_UNIT) + 0.5) as u64;
        self.sum[i] = self.sum[i].saturating_add(units);
        self.max[i] = self.max[i].max(max);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_saturate() {
        let mut near = Contribution::new(1);
        near.sum[0] = u64::MAX - 5;
        near.add(0, 1.0, 0.5);
        let other = near.clone();
        near.merge(&other);
        assert_eq!((near.sum[0], near.max[0]), (u64::MAX, 0.5));
    }
}
