//! Computes the error in a render that the removal of each single Gaussian would cause.
//!
//! In a pixel, a Gaussian of color c has the weight w = alpha · transmittance and hides the color b behind it. Without
//! this Gaussian, the pixel changes by exactly w·(c − b). A Gaussian with the same color as the background that it
//! hides can thus be removed without error, even if its weight is large.
//!
//! These errors hold for the removal of a single Gaussian. If several Gaussians are removed at once, their changes add
//! up, and b changes too: among several Gaussians of one color in front of each other, each alone may be removed almost
//! without error, but not all of them. Two measures limit this effect. The square of a constant, the floor, is added to
//! ‖c − b‖², so that a Gaussian with a large weight never has an error of 0. Gaussians are removed in several rounds,
//! and the errors are computed again for each round.

use serde::{Deserialize, Serialize};

use super::blend::{BlendSink, Fragment, TilePlane};
use super::lanes::{Lanes, Sums};
use super::project::Splat;

/// Removal error of N Gaussians, summed over any number of views: Σ over pixels of w²·(‖c − b‖² + floor²), where w is
/// the weight of the Gaussian in the pixel, c its color, and b the color behind it. The floor
/// ([`RemovalError::contrast_floor`]) is a minimum color difference, so that removing a Gaussian in front of its own
/// color counts as an error too.
///
/// With a floor of 0 this is the squared error of renders without that Gaussian, except for alphas clamped at 0.99 and
/// pixels that end early. Errors do not depend on the order of views or the number of threads. Memory: 8 bytes per
/// Gaussian.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RemovalError {
    /// Removal error of each Gaussian in units of 2⁻³⁶ ([`RemovalError::SUM_UNIT`]). Within a view, errors are summed
    /// per 16×16 tile in f32, in a fixed order. A sum stops growing at 2⁶⁴ units.
    pub sum: Vec<u64>,
    /// Floor: constant whose square is added to ‖c − b‖², the squared difference (summed over red, green and blue)
    /// between the color of a Gaussian and the color behind it. Between equal colors, the difference thus counts as the
    /// floor.
    pub contrast_floor: f32,
}

impl RemovalError {
    /// Unit of [`RemovalError::sum`]: a squared error of 2⁻³⁶. A sum can hold 3000 completely changed renders of
    /// 320×256 pixels.
    pub const SUM_UNIT: f64 = 1.0 / (1u64 << 36) as f64;

    /// Creates removal errors of 0 for `len` Gaussians, to which the errors in views are then added. The square of
    /// `contrast_floor` is added to each squared color difference ([`RemovalError::contrast_floor`]).
    pub fn new(len: usize, contrast_floor: f32) -> Self {
        RemovalError { sum: vec![0; len], contrast_floor }
    }

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.sum.len()
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.sum.is_empty()
    }

    /// Selects `count` Gaussians to keep, and returns their indices in increasing order. Gaussians for which `fixed`
    /// returns true are selected first, then the Gaussians with the largest removal error. Of equal errors, the lower
    /// index is selected first.
    pub fn top_by_error(&self, count: usize, fixed: impl Fn(usize) -> bool) -> Vec<u32> {
        let mut ids: Vec<u32> = (0..self.len() as u32).collect();
        // A stable sort keeps ties in index order.
        ids.sort_by_key(|&id| std::cmp::Reverse((fixed(id as usize), self.sum[id as usize])));
        ids.truncate(count);
        ids.sort_unstable();
        ids
    }

    /// Adds the removal errors in `other`, which come from other views of the same Gaussians, to those in `self`.
    ///
    /// # Panics
    /// Panics if the numbers of Gaussians differ.
    pub fn merge(&mut self, other: &RemovalError) {
        assert_eq!(self.len(), other.len(), "expected removal errors of equally many Gaussians");
        self.sum.iter_mut().zip(&other.sum).for_each(|(sum, other)| *sum = sum.saturating_add(*other));
    }

    /// Adds the removal errors in `other`, which come from a subset of the Gaussians. The error of Gaussian k of
    /// `other` is added to that of Gaussian `rows[k]` of `self`.
    pub fn merge_rows(&mut self, rows: &[u32], other: &RemovalError) {
        for (&row, other) in rows.iter().zip(&other.sum) {
            let sum = &mut self.sum[row as usize];
            *sum = sum.saturating_add(*other);
        }
    }

    /// Adds `error` to the sum of Gaussian `i`. `error` is the squared error that the removal of the Gaussian would
    /// cause in one tile of a view. It is rounded to a multiple of [`RemovalError::SUM_UNIT`].
    pub(super) fn add(&mut self, i: usize, error: f32) {
        let units = (f64::from(error) * (1.0 / Self::SUM_UNIT) + 0.5) as u64;
        self.sum[i] = self.sum[i].saturating_add(units);
    }
}

/// Receiver of weights (alpha · transmittance of each splat) that computes the removal error of every splat of a tile
/// while the tile is blended.
pub(super) struct RemovalSink<'a> {
    /// Part of the color of each pixel that comes from behind the splats blended so far, one plane per channel. It is
    /// the color behind these splats times the transmittance, computed as the color of the pixel minus weight · color
    /// of each of these splats.
    pub(super) behind: [TilePlane; 3],
    /// Floor: constant whose square is added to the squared difference between the color of a splat and the color
    /// behind it ([`RemovalError::contrast_floor`]).
    pub(super) contrast_floor: f32,
    /// For each splat of the tile, the squared error that its removal would cause in the pixels of the tile: Σ w²·(‖c −
    /// b‖² + floor²), as in [`RemovalError`].
    pub(super) pairs: &'a mut [f32],
}

impl BlendSink for RemovalSink<'_> {
    /// Color of a splat (red, green, blue), then the removal error of this splat so far: the sum over pixels of its
    /// squared change.
    type Accumulator<V: Lanes> = ([V; 3], V::Sums);
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> ([V; 3], V::Sums) {
        (splat.color.map(V::splat), V::Sums::zero())
    }
    #[inline(always)]
    fn add<V: Lanes>(
        &mut self,
        (color, sum): ([V; 3], V::Sums),
        group: usize,
        fragment: Fragment<V>,
    ) -> ([V; 3], V::Sums) {
        let Fragment { weight, transmittance_after, .. } = fragment;
        // Colors behind this splat are multiplied by `transmittance_after`. Without the splat, they would be multiplied
        // by `transmittance_after + weight`.
        let gain = weight.div(transmittance_after);
        let floor = weight.mul(V::splat(self.contrast_floor));
        let mut squares = floor.mul(floor);
        for (plane, color) in self.behind.iter_mut().zip(color) {
            let own = color.mul(weight);
            let background = V::load(plane, group).sub(own);
            background.store(plane, group);
            let change = gain.neg_mul_add(background, own);
            squares = change.mul_add(change, squares);
        }
        (color, squares.add_to(sum))
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, (_, sum): ([V; 3], V::Sums), pair: usize) {
        self.pairs[pair] = sum.total();
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::{Renderer, render};
    use splat_core::{Camera, Gaussians};

    const BACKGROUND: [f32; 3] = [0.2, 0.5, 0.9];

    /// Returns `count` translucent overlapping Gaussians of many colors.
    fn scene(count: usize) -> Gaussians {
        let mut scene = Gaussians::zeros(count, 0);
        for i in 0..count {
            let step = |k: f64| (i as f64 * k).fract() as f32;
            scene.position.set_row(i, [step(0.618_034) - 0.5, step(0.754_878) - 0.5, step(0.569_84) - 0.5]);
            scene.rotation.set_row(i, [1.0, step(0.819_173), step(0.671_044), step(0.549_701)]);
            scene.log_scale.set_row(i, [-2.0 - step(0.380_2), -1.8, -2.4]);
            scene.opacity_logit.set_row(i, [2.0 * step(0.856_675) - 2.0]);
            scene.sh.set_row(i, [3.0 * step(0.733_892) - 1.5, 2.0 * step(0.628_71) - 1.0, step(0.538_6)]);
        }
        scene
    }

    /// Returns a camera that sees the test scene.
    fn camera() -> Camera {
        Camera::look_at(DVec3::new(1.0, -3.0, 0.4), DVec3::ZERO, 0.6, (45, 37))
    }

    /// Returns the removal errors of all Gaussians of `scene` (squared error in a render that the removal of the
    /// Gaussian causes). The square of `floor`, the contrast floor, is added to each squared color difference, so that
    /// removing a Gaussian in front of its own color counts, too.
    fn errors(scene: &Gaussians, floor: f32) -> Vec<f64> {
        let mut found = RemovalError::new(scene.len(), floor);
        Renderer::new().removal_error(scene, &camera(), BACKGROUND, &mut found);
        found.sum.iter().map(|&units| units as f64 * RemovalError::SUM_UNIT).collect()
    }

    #[test]
    fn error_equals_that_of_a_render_without_the_gaussian() {
        let scene = scene(40);
        let whole = render(&scene, &camera(), BACKGROUND);
        let found = errors(&scene, 0.0);
        let mut largest = 0.0f64;
        for (i, &got) in found.iter().enumerate() {
            let others: Vec<u32> = (0..40).filter(|&j| j as usize != i).collect();
            let without = render(&scene.pick(&others), &camera(), BACKGROUND);
            let change = whole.data.iter().zip(&without.data).map(|(a, b)| f64::from(a - b).powi(2));
            let expected: f64 = change.sum();
            largest = largest.max(expected);
            // Pixels that almost end early may blend one splat more without this Gaussian.
            assert!((got - expected).abs() <= 1e-3 * expected + 1e-5, "{i}: got {got}, expected {expected}");
        }
        assert!(largest > 1.0, "largest expected error: {largest}, expected above 1");
    }

    #[test]
    fn floor_adds_the_sum_of_squared_weights() {
        let scene = scene(40);
        let (plain, raised) = (errors(&scene, 0.0), errors(&scene, 0.5));
        let white = (0.5 / splat_core::SH_C0) as f32;
        let mut lit = scene.clone();
        (0..40).for_each(|i| lit.sh.set_row(i, [-white; 3]));
        for i in 0..40 {
            // A white Gaussian among black ones shows its weight in every pixel.
            lit.sh.set_row(i, [white; 3]);
            let weights = render(&lit, &camera(), [0.0; 3]).data;
            lit.sh.set_row(i, [-white; 3]);
            let squares: f64 = weights.iter().map(|&w| f64::from(w).powi(2)).sum::<f64>() / 3.0;
            let expected = plain[i] + 0.25 * squares;
            let got = raised[i];
            assert!((got - expected).abs() <= 1e-4 * expected + 1e-6, "{i}: got {got}, expected {expected}");
        }
    }

    #[test]
    fn sums_saturate() {
        let mut near = RemovalError::new(1, 0.1);
        near.sum[0] = u64::MAX - 5;
        near.add(0, 1.0);
        let other = near.clone();
        near.merge(&other);
        assert_eq!(near.sum[0], u64::MAX);
    }
}
