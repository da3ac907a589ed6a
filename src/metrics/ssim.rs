//! Structural similarity, as the field's training and evaluation code computes it.
//!
//! Data in: two images. Data out: one number. Source: Wang et al., "Image Quality Assessment: From Error
//! Visibility to Structural Similarity", 2004, with the window and the zero padding of the code behind
//! Kerbl et al. 2023.

use super::{assert_same_size, clamped};
use crate::render::Image;

/// Half the window without its middle: 11 taps.
const RADIUS: usize = 5;
/// Standard deviation of the window, pixels.
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Mean over pixels and channels of
/// (2 μₐ μ_b + C₁)(2 σ_ab + C₂) / ((μₐ² + μ_b² + C₁)(σₐ² + σ_b² + C₂)),
/// moments under a normalised 11×11 Gaussian window of σ = 1.5 px; beyond the border lie zeros.
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
    let (width, height) = (a.width as usize, a.height as usize);
    let window = window();
    // The two variances are only ever added, so four windowed sums do.
    let mut sums: [Vec<f64>; 4] = std::array::from_fn(|_| vec![0.0; width * height]);
    let mut scratch = vec![0.0; width * height];
    let mut total = 0.0;
    for channel in 0..3 {
        for (i, (a, b)) in a.data.iter().zip(&b.data).skip(channel).step_by(3).enumerate() {
            let (a, b) = (clamped(*a), clamped(*b));
            for (sum, value) in sums.iter_mut().zip([a, b, a * a + b * b, a * b]) {
                sum[i] = value;
            }
        }
        for sum in &mut sums {
            blur(sum, &mut scratch, width, &window);
        }
        let [mean_a, mean_b, squares, products] = &sums;
        for i in 0..width * height {
            let (a, b) = (mean_a[i], mean_b[i]);
            let (both, across) = (a * a + b * b, a * b);
            total +=
                (2.0 * across + C1) * (2.0 * (products[i] - across) + C2) / ((both + C1) * (squares[i] - both + C2));
        }
    }
    total / (3 * width * height) as f64
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
