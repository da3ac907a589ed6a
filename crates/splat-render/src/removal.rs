//! What a picture would lose with each of its Gaussians.
//!
//! A Gaussian of color c and weight w = alpha · transmittance hides what lies behind it, of color b:
//! without it the pixel changes by exactly w·(c − b), so one that looks like what it hides is worth
//! nothing however much it covers. Of N removals at once the changes add up, with b changing too; hence
//! the floor under c − b, and ranking in rounds.

use serde::{Deserialize, Serialize};

use super::blend::{BlendSink, Fragment, TilePlane};
use super::lanes::{Lanes, Sums};
use super::project::Splat;

/// Removal error of N Gaussians over any number of pictures: Σ over pixels of w²·(‖c − b‖² + floor²).
///
/// With a floor of 0, and but for alphas cut at 0.99 and pixels that end early, it is the squared error
/// of the picture without that Gaussian. The same whatever the order of pictures and the number of threads.
/// Memory: 8 bytes per Gaussian.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RemovalError {
    /// `[N]`, in units of 2⁻³⁶ ([`RemovalError::UNIT`]); a picture's part is summed per 16×16 tile in f32,
    /// in a fixed order. A sum that would pass 2⁶⁴ stays there.
    pub sum: Vec<u64>,
    /// Least difference of color that a Gaussian counts as having from what it hides, as a norm over RGB.
    pub contrast_floor: f32,
}

impl RemovalError {
    /// Squared error per unit of [`RemovalError::sum`]: 2⁻³⁶. 3000 wholly changed pictures of 320×256 fit.
    pub const UNIT: f64 = 1.0 / (1u64 << 36) as f64;

    /// Nothing seen of `len` Gaussians.
    pub fn new(len: usize, contrast_floor: f32) -> Self {
        RemovalError { sum: vec![0; len], contrast_floor }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.sum.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.sum.is_empty()
    }

    /// The `count` Gaussians, increasing, that are `fixed` or else that pictures would lose most with; of equals the
    /// first ones.
    pub fn most_missed(&self, count: usize, fixed: impl Fn(usize) -> bool) -> Vec<u32> {
        let mut places: Vec<u32> = (0..self.len() as u32).collect();
        // Stable: ties by place.
        places.sort_by_key(|&place| std::cmp::Reverse((fixed(place as usize), self.sum[place as usize])));
        places.truncate(count);
        places.sort_unstable();
        places
    }

    /// Adds what `other` found of the same Gaussians in other pictures.
    ///
    /// # Panics
    /// If the lengths differ.
    pub fn merge(&mut self, other: &RemovalError) {
        assert_eq!(self.len(), other.len(), "errors of different models");
        self.sum.iter_mut().zip(&other.sum).for_each(|(sum, other)| *sum = sum.saturating_add(*other));
    }

    /// Adds what `other` found of the Gaussians `rows` alone, in that order.
    pub fn merge_rows(&mut self, rows: &[u32], other: &RemovalError) {
        for (&row, other) in rows.iter().zip(&other.sum) {
            let sum = &mut self.sum[row as usize];
            *sum = sum.saturating_add(*other);
        }
    }

    /// Adds one tile's error of Gaussian `i`.
    pub(super) fn add(&mut self, i: usize, error: f32) {
        let units = (f64::from(error) * (1.0 / Self::UNIT) + 0.5) as u64;
        self.sum[i] = self.sum[i].saturating_add(units);
    }
}

/// Sums squared changes over the pixels of a tile.
pub(super) struct Removal<'a> {
    /// Colors of the pixels; of what is drawn so far, each takes its part away.
    pub(super) rest: [TilePlane; 3],
    pub(super) contrast_floor: f32,
    /// One per pair of the tile.
    pub(super) pairs: &'a mut [f32],
}

impl BlendSink for Removal<'_> {
    /// Color and sum.
    type Drop<V: Lanes> = ([V; 3], V::Sums);
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> ([V; 3], V::Sums) {
        (splat.color.map(V::splat), V::Sums::zero())
    }
    #[inline(always)]
    fn add<V: Lanes>(
        &mut self,
        (color, sum): ([V; 3], V::Sums),
        group: usize,
        stroke: Fragment<V>,
    ) -> ([V; 3], V::Sums) {
        let Fragment { weight, left, .. } = stroke;
        // What lies behind shows with transmittance `left`, and `weight` more without this splat.
        let gain = weight.div(left);
        let floor = weight.mul(V::splat(self.contrast_floor));
        let mut squares = floor.mul(floor);
        for (plane, color) in self.rest.iter_mut().zip(color) {
            let own = color.mul(weight);
            let behind = V::load(plane, group).sub(own);
            behind.store(plane, group);
            let change = own.sub(gain.mul(behind));
            squares = squares.add(change.mul(change));
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

    /// Translucent Gaussians of many colors before each other.
    fn cloud(count: usize) -> Gaussians {
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

    fn camera() -> Camera {
        Camera::look_at(DVec3::new(1.0, -3.0, 0.4), DVec3::ZERO, 0.6, (45, 37))
    }

    fn errors(scene: &Gaussians, floor: f32) -> Vec<f64> {
        let mut found = RemovalError::new(scene.len(), floor);
        Renderer::new().removal_error(scene, &camera(), BACKGROUND, &mut found);
        found.sum.iter().map(|&units| units as f64 * RemovalError::UNIT).collect()
    }

    #[test]
    fn the_error_is_that_of_the_picture_without_the_gaussian() {
        let scene = cloud(40);
        let whole = render(&scene, &camera(), BACKGROUND);
        let found = errors(&scene, 0.0);
        let mut largest = 0.0f64;
        for (i, &got) in found.iter().enumerate() {
            let others: Vec<u32> = (0..40).filter(|&j| j as usize != i).collect();
            let without = render(&scene.pick(&others), &camera(), BACKGROUND);
            let change = whole.data.iter().zip(&without.data).map(|(a, b)| f64::from(a - b).powi(2));
            let expected: f64 = change.sum();
            largest = largest.max(expected);
            // Pixels that nearly end may blend one splat more without this one.
            assert!((got - expected).abs() <= 1e-3 * expected + 1e-5, "{i}: got {got}, expected {expected}");
        }
        assert!(largest > 1.0, "nothing in the scene matters: {largest}");
    }

    #[test]
    fn the_floor_adds_the_sum_of_squared_weights() {
        let scene = cloud(40);
        let (plain, raised) = (errors(&scene, 0.0), errors(&scene, 0.5));
        let white = (0.5 / splat_core::SH_C0) as f32;
        let mut lit = scene.clone();
        (0..40).for_each(|i| lit.sh.set_row(i, [-white; 3]));
        for i in 0..40 {
            // One that is white among black ones shows its weight in every pixel.
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
    fn sums_stay_at_the_top_instead_of_wrapping() {
        let mut near = RemovalError::new(1, 0.1);
        near.sum[0] = u64::MAX - 5;
        near.add(0, 1.0);
        let other = near.clone();
        near.merge(&other);
        assert_eq!(near.sum[0], u64::MAX);
    }
}
