//! Structural similarity (SSIM) of images, computed as in the training and evaluation code of Gaussian splatting.
//!
//! Input: two images. Output: one number. Source: Wang et al., "Image Quality Assessment: From Error Visibility to
//! Structural Similarity", 2004, with the window and the zero padding of the code of Kerbl et al. 2023.

use rayon::prelude::*;

use super::{assert_same_size, clamped};
use crate::Image;

/// Radius of the Gaussian window in pixels, not counting its center. The window is 11 pixels wide.
const RADIUS: usize = 5;
/// Standard deviation of the Gaussian window, pixels.
const SIGMA: f64 = 1.5;
/// Constant C₁ of SSIM, which keeps the luminance term stable for dark images.
const C1: f64 = 0.01 * 0.01;
/// Constant C₂ of SSIM, which keeps the contrast term stable for uniform images.
const C2: f64 = 0.03 * 0.03;

/// Computes the SSIM of `a` and `b`: the mean over pixels and channels of (2 μₐ μ_b + C₁)(2 σ_ab + C₂) / ((μₐ² + μ_b² +
/// C₁)(σₐ² + σ_b² + C₂)).
///
/// Means μ, variances σ² and covariance σ_ab are taken under a normalized 11×11 Gaussian window of σ = 1.5 pixels;
/// pixels outside the image count as 0. Equal images, also empty ones, have the largest SSIM, 1. NaN in either image
/// gives NaN.
///
/// # Panics
/// Panics if the sizes of the images differ.
pub fn ssim(a: &Image, b: &Image) -> f64 {
    assert_same_size(a, b);
    if a.data.is_empty() {
        return 1.0;
    }
    let count = a.data.len() / 3;
    let mut moments = Moments::new(count);
    let mut total = 0.0;
    for channel in 0..3 {
        moments.set_windowed(a, b, channel);
        total += (0..count).map(|i| SsimFactors::new(moments.at(i)).similarity()).sum::<f64>();
    }
    total / (3 * count) as f64
}

/// Computes the derivative of [`ssim`] of `a` and `b` with respect to each value of `a`, as an image. The derivative is
/// 0 where clamping to [0, 1] changes the value.
///
/// The SSIM of a pixel is S = (A₁A₂)/(B₁B₂), with factors computed from windowed sums. The derivative follows by the
/// chain rule. Because the window is symmetric, derivatives with respect to the windowed sums are weighted with the
/// same window to get derivatives with respect to pixels.
///
/// # Panics
/// Panics if the sizes of the images differ.
pub fn ssim_gradient(a: &Image, b: &Image) -> Image {
    assert_same_size(a, b);
    let (width, count) = (a.width as usize, a.data.len() / 3);
    let channel_slopes = |channel: usize| {
        let mut moments = Moments::new(count);
        moments.set_windowed(a, b, channel);
        for i in 0..count {
            let slopes = SsimFactors::new(moments.at(i)).slopes();
            // The sums are no longer needed and make room for the derivatives.
            moments.sums.iter_mut().zip(slopes).for_each(|(sum, slope)| sum[i] = slope);
        }
        let Moments { sums: [by_mean, by_squares, by_products, _], scratch } = &mut moments;
        for slopes in [&mut *by_mean, &mut *by_squares, &mut *by_products] {
            blur(slopes, scratch, width, &window());
        }
        let values = a.data.iter().zip(&b.data).skip(channel).step_by(3).enumerate();
        let value_slope = |(i, (&a, &b)): (usize, (&f32, &f32))| {
            let slope = by_mean[i] + 2.0 * clamped(a) * by_squares[i] + clamped(b) * by_products[i];
            if clamped(a) == f64::from(a) { slope / (3 * count) as f64 } else { 0.0 }
        };
        values.map(value_slope).collect()
    };
    let channels: Vec<Vec<f64>> = (0..3).into_par_iter().map(channel_slopes).collect();
    let mut slope = Image { data: vec![0.0; a.data.len()], ..*a };
    for (channel, slopes) in channels.iter().enumerate() {
        slope.data.iter_mut().skip(channel).step_by(3).zip(slopes).for_each(|(to, &of)| *to = of as f32);
    }
    slope
}

/// Windowed sums (weighted by the Gaussian window around each pixel) of one channel of two images a and b.
struct Moments {
    /// Windowed sums of a, b, a² + b² and a·b at every pixel. SSIM needs only the sum of the two variances, hence a² +
    /// b².
    sums: [Vec<f64>; 4],
    /// Buffer for one image channel that was weighted with the window along its rows, but not yet along its columns.
    scratch: Vec<f64>,
}

impl Moments {
    /// Creates windowed sums that are 0 at each of `count` pixels.
    fn new(count: usize) -> Moments {
        Moments { sums: std::array::from_fn(|_| vec![0.0; count]), scratch: vec![0.0; count] }
    }

    /// Computes the windowed sums (weighted by the Gaussian window around each pixel) of channel `channel` of the
    /// images `a` and `b`.
    fn set_windowed(&mut self, a: &Image, b: &Image, channel: usize) {
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

    /// Returns the sums of a, b, a² + b² and a·b, weighted by the Gaussian window around pixel `i`.
    fn at(&self, i: usize) -> [f64; 4] {
        self.sums.each_ref().map(|sum| sum[i])
    }
}

/// Factors of the SSIM S = (A₁A₂)/(B₁B₂) at one pixel, and the means of both images around this pixel.
struct SsimFactors {
    /// Means of the images a and b, weighted by the Gaussian window around the pixel.
    means: [f64; 2],
    /// Factors A₁ and A₂ of the numerator of the SSIM S = (A₁A₂)/(B₁B₂).
    numerators: [f64; 2],
    /// Factors B₁ and B₂ of the denominator of the SSIM S = (A₁A₂)/(B₁B₂).
    denominators: [f64; 2],
}

impl SsimFactors {
    /// Computes the factors A₁, A₂, B₁ and B₂ at a pixel from the windowed sums of a, b, a² + b² and a·b there.
    fn new([a, b, squares, products]: [f64; 4]) -> SsimFactors {
        let (squared_means, means_product) = (a * a + b * b, a * b);
        SsimFactors {
            means: [a, b],
            numerators: [2.0 * means_product + C1, 2.0 * (products - means_product) + C2],
            denominators: [squared_means + C1, squares - squared_means + C2],
        }
    }

    /// Returns the SSIM of the pixel, S = (A₁A₂)/(B₁B₂).
    fn similarity(&self) -> f64 {
        let SsimFactors { numerators, denominators, .. } = self;
        numerators[0] * numerators[1] / (denominators[0] * denominators[1])
    }

    /// Returns the derivatives of the SSIM S of the pixel with respect to the windowed sums of a, a² + b² and a·b, in
    /// this order. The fourth value is 0.
    fn slopes(&self) -> [f64; 4] {
        let SsimFactors { means: [a, b], numerators, denominators } = self;
        let (whole, s) = (denominators[0] * denominators[1], self.similarity());
        let by_mean = 2.0 * b * (numerators[1] - numerators[0]) / whole
            - 2.0 * a * s * (1.0 / denominators[0] - 1.0 / denominators[1]);
        [by_mean, -s / denominators[1], 2.0 * numerators[0] / whole, 0.0]
    }
}

/// Returns the weights of the Gaussian window along one axis; their sum is 1.
fn window() -> [f64; 2 * RADIUS + 1] {
    let tap = |i: usize| (-(i as f64 - RADIUS as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp();
    let sum: f64 = (0..=2 * RADIUS).map(tap).sum();
    std::array::from_fn(|i| tap(i) / sum)
}

/// Applies the window to the image channel `plane` `[height, width]` in place, first along rows and then along columns.
/// `scratch` is a buffer of the same size.
fn blur(plane: &mut [f64], scratch: &mut [f64], width: usize, window: &[f64; 2 * RADIUS + 1]) {
    scratch.fill(0.0);
    for (from, to) in plane.chunks_exact(width).zip(scratch.chunks_exact_mut(width)) {
        for (tap, weight) in window.iter().enumerate() {
            // to[x] += weight · from[x + tap − RADIUS] where that pixel exists.
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
