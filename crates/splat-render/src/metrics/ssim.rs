//! Structural similarity, as the field's training and evaluation code computes it.
//!
//! Data in: two images. Data out: one number. Source: Wang et al., "Image Quality Assessment: From Error
//! Visibility to Structural Similarity", 2004, with the window and the zero padding of the code behind
//! Kerbl et al. 2023.

use rayon::prelude::*;

use super::{assert_same_size, clamped};
use crate::Image;

/// Half the window without its middle: 11 taps.
const RADIUS: usize = 5;
/// Standard deviation of the window, pixels.
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Mean over pixels and channels of
/// (2 μₐ μ_b + C₁)(2 σ_ab + C₂) / ((μₐ² + μ_b² + C₁)(σₐ² + σ_b² + C₂)),
/// moments under a normalized 11×11 Gaussian window of σ = 1.5 px; beyond the border lie zeros.
///
/// At most 1, which is equality; 1 for two empty images. NaN in either image gives NaN.
///
/// # Panics
/// If the sizes differ.
pub fn ssim(a: &Image, b: &Image) -> f64 {
    assert_same_size(a, b);
    if a.data.is_empty() {
        return 1.0;
    }
    let count = a.data.len() / 3;
    let mut moments = Moments::new(count);
    let mut total = 0.0;
    for channel in 0..3 {
        moments.window_of(a, b, channel);
        total += (0..count).map(|i| Terms::new(moments.at(i)).similarity()).sum::<f64>();
    }
    total / (3 * count) as f64
}

/// How [`ssim`] of `a` and `b` changes with each value of `a`, `[H, W, 3]`; 0 where a screen shows no change.
///
/// With S = (A₁A₂)/(B₁B₂) of windowed moments, the chain rule back through them: a window is its own adjoint.
///
/// # Panics
/// If the sizes differ.
pub fn ssim_slope(a: &Image, b: &Image) -> Image {
    assert_same_size(a, b);
    let (width, count) = (a.width as usize, a.data.len() / 3);
    let of_channel = |channel: usize| {
        let mut moments = Moments::new(count);
        moments.window_of(a, b, channel);
        for i in 0..count {
            let slopes = Terms::new(moments.at(i)).slopes();
            // What they were is not needed any more.
            moments.sums.iter_mut().zip(slopes).for_each(|(sum, slope)| sum[i] = slope);
        }
        let Moments { sums: [by_mean, by_squares, by_products, _], scratch } = &mut moments;
        for slopes in [&mut *by_mean, &mut *by_squares, &mut *by_products] {
            blur(slopes, scratch, width, &window());
        }
        let values = a.data.iter().zip(&b.data).skip(channel).step_by(3).enumerate();
        let of_value = |(i, (&a, &b)): (usize, (&f32, &f32))| {
            let slope = by_mean[i] + 2.0 * clamped(a) * by_squares[i] + clamped(b) * by_products[i];
            if clamped(a) == f64::from(a) { slope / (3 * count) as f64 } else { 0.0 }
        };
        values.map(of_value).collect()
    };
    let channels: Vec<Vec<f64>> = (0..3).into_par_iter().map(of_channel).collect();
    let mut slope = Image { data: vec![0.0; a.data.len()], ..*a };
    for (channel, slopes) in channels.iter().enumerate() {
        slope.data.iter_mut().skip(channel).step_by(3).zip(slopes).for_each(|(to, &of)| *to = of as f32);
    }
    slope
}

/// Windowed sums of one channel of two pictures.
struct Moments {
    /// Of a, b, a² + b² (the two variances are only ever added), and a·b.
    sums: [Vec<f64>; 4],
    scratch: Vec<f64>,
}

impl Moments {
    fn new(count: usize) -> Moments {
        Moments { sums: std::array::from_fn(|_| vec![0.0; count]), scratch: vec![0.0; count] }
    }

    fn window_of(&mut self, a: &Image, b: &Image, channel: usize) {
        for (i, (a, b)) in a.data.iter().zip(&b.data).skip(channel).step_by(3).enumerate() {
            let (a, b) = (clamped(*a), clamped(*b));
            for (sum, value) in self.sums.iter_mut().zip([a, b, a * a + b * b, a * b]) {
                sum[i] = value;
            }
        }
        for sum in &mut self.sums {
            blur(sum, &mut self.scratch, a.width as usize, &window());
        }
    }

    fn at(&self, i: usize) -> [f64; 4] {
        self.sums.each_ref().map(|sum| sum[i])
    }
}

/// The factors of S = (A₁A₂)/(B₁B₂), and the means.
struct Terms {
    means: [f64; 2],
    above: [f64; 2],
    below: [f64; 2],
}

impl Terms {
    fn new([a, b, squares, products]: [f64; 4]) -> Terms {
        let (both, across) = (a * a + b * b, a * b);
        Terms {
            means: [a, b],
            above: [2.0 * across + C1, 2.0 * (products - across) + C2],
            below: [both + C1, squares - both + C2],
        }
    }

    fn similarity(&self) -> f64 {
        let Terms { above, below, .. } = self;
        above[0] * above[1] / (below[0] * below[1])
    }

    /// ∂S by the mean of a, by a² + b² and by a·b, and 0.
    fn slopes(&self) -> [f64; 4] {
        let Terms { means: [a, b], above, below } = self;
        let (whole, s) = (below[0] * below[1], self.similarity());
        let by_mean = 2.0 * b * (above[1] - above[0]) / whole - 2.0 * a * s * (1.0 / below[0] - 1.0 / below[1]);
        [by_mean, -s / below[1], 2.0 * above[0] / whole, 0.0]
    }
}

/// The taps of the window along one axis, sum 1.
fn window() -> [f64; 2 * RADIUS + 1] {
    let tap = |i: usize| (-(i as f64 - RADIUS as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp();
    let sum: f64 = (0..=2 * RADIUS).map(tap).sum();
    std::array::from_fn(|i| tap(i) / sum)
}

/// Windows `plane` `[height, width]` in place, rows first.
fn blur(plane: &mut [f64], scratch: &mut [f64], width: usize, window: &[f64; 2 * RADIUS + 1]) {
    scratch.fill(0.0);
    for (from, to) in plane.chunks_exact(width).zip(scratch.chunks_exact_mut(width)) {
        for (tap, weight) in window.iter().enumerate() {
            // to[x] += weight · from[x + tap − RADIUS] where that exists.
            let (back, ahead) = (RADIUS.saturating_sub(tap).min(width), tap.saturating_sub(RADIUS).min(width));
            for (to, from) in to[back..].iter_mut().zip(&from[ahead..]) {
                *to += weight * from;
            }
        }
    }
    plane.fill(0.0);
    let rows = plane.len() / width;
    for (y, to) in plane.chunks_exact_mut(width).enumerate() {
        for (tap, weight) in window.iter().enumerate() {
            let Some(row) = (y + tap).checked_sub(RADIUS).filter(|&row| row < rows) else { continue };
            for (to, from) in to.iter_mut().zip(&scratch[row * width..(row + 1) * width]) {
                *to += weight * from;
            }
        }
    }
}
