//! Image metrics: PSNR, SSIM, FLIP, and the temporal error (flicker: the error of the differences between successive
//! frames).
//!
//! Input: pairs of [`Image`]s of equal size. Output: one f64 per pair. Values are clamped to [0, 1] first, as on a
//! screen, and all sums are in f64. Memory: [`METRIC_BYTES_PER_PIXEL`] per pixel; FLIP takes what the code of its
//! authors needs.

mod flip;
mod ssim;

pub use flip::flip;
pub use ssim::{ssim, ssim_gradient};

use crate::Image;

/// Maximum bytes of memory per pixel for comparing two images by a metric other than FLIP. SSIM takes this much.
pub const METRIC_BYTES_PER_PIXEL: usize = 5 * size_of::<f64>();

/// Bytes of memory per pixel for [`ssim_gradient`]: the sums of SSIM for three channels, and two copies of the
/// derivatives, in f64 and f32.
pub const SSIM_GRADIENT_BYTES_PER_PIXEL: usize = 3 * (METRIC_BYTES_PER_PIXEL + size_of::<f64>() + size_of::<f32>());

/// Maximum PSNR in dB, which equal images get instead of infinity. It keeps the mean over views finite.
pub const PSNR_CAP_DB: f64 = 100.0;

/// Computes the peak signal-to-noise ratio with peak 1 in dB: −10·log₁₀ of the mean squared difference over pixels and
/// channels, at most [`PSNR_CAP_DB`]. For several views, average the values in dB.
///
/// Two empty images are equal. NaN in either image gives NaN.
///
/// # Panics
/// Panics if the sizes of the images differ.
pub fn psnr(a: &Image, b: &Image) -> f64 {
    decibels(mean_square(channels(a, b).map(|(a, b)| a - b)))
}

/// Returns the PSNR in dB that corresponds to a mean squared difference, at most [`PSNR_CAP_DB`]. NaN gives NaN.
pub fn decibels(mean_square: f64) -> f64 {
    let db = -10.0 * mean_square.log10();
    if db > PSNR_CAP_DB { PSNR_CAP_DB } else { db }
}

/// Returns `psnr` as text with its unit and `digits` decimal places. NaN is explained in words.
pub fn decibels_text(psnr: f64, digits: usize) -> String {
    match psnr.is_nan() {
        true => "an unmeasurable PSNR (some pixels are NaN)".to_owned(),
        false => format!("{psnr:.digits$} dB"),
    }
}

/// Computes the temporal error (flicker) between two sequences `a` and `b`: the root mean square of (a₁ − a₀) − (b₁ −
/// b₀) over pixels and channels.
///
/// Each argument holds two renders of one view, at the successive frames 0 and 1. The result is in [0, 2], and 0 if
/// both sequences change equally: an error that is constant over time does not count, flicker does.
///
/// # Panics
/// Panics if the sizes of the images differ.
pub fn temporal_error(a: [&Image; 2], b: [&Image; 2]) -> f64 {
    let (before, after) = (channels(a[0], b[0]), channels(a[1], b[1]));
    mean_square(before.zip(after).map(|((a0, b0), (a1, b1))| (a1 - a0) - (b1 - b0))).sqrt()
}

/// Returns an iterator over the pairs of corresponding values of `a` and `b`, clamped to [0, 1]. Panics if the sizes of
/// the images differ.
fn channels<'a>(a: &'a Image, b: &'a Image) -> impl ExactSizeIterator<Item = (f64, f64)> + 'a {
    assert_same_size(a, b);
    a.data.iter().zip(&b.data).map(|(&a, &b)| (clamped(a), clamped(b)))
}

/// Panics if the sizes of the images differ.
fn assert_same_size(a: &Image, b: &Image) {
    assert_eq!((a.width, a.height), (b.width, b.height), "images of different sizes");
    assert_eq!(a.data.len(), b.data.len(), "images of different sizes");
}

/// Returns `value` clamped to [0, 1], as a screen shows it.
pub fn clamped(value: f32) -> f64 {
    f64::from(value.clamp(0.0, 1.0))
}

/// Returns the mean of the squares of `values`, or 0 if there are none.
fn mean_square(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1) as f64;
    values.map(|value| value * value).sum::<f64>() / count
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, value: impl Fn(usize) -> f32) -> Image {
        Image { width, height, data: (0..width as usize * height as usize * 3).map(value).collect() }
    }

    #[test]
    fn psnr_of_a_constant_difference_has_a_closed_form() {
        let (a, b) = (image(5, 4, |_| 0.25), image(5, 4, |_| 0.375));
        let expected = -20.0 * 0.125f64.log10();
        assert!((psnr(&a, &b) - expected).abs() < 1e-12, "got {}, expected {expected}", psnr(&a, &b));
    }

    #[test]
    fn psnr_of_equal_images_is_capped() {
        let a = image(5, 4, |i| i as f32 * 0.01);
        assert_eq!(psnr(&a, &a), PSNR_CAP_DB);
        assert_eq!(psnr(&image(0, 0, |_| 0.0), &image(0, 0, |_| 0.0)), PSNR_CAP_DB);
    }

    #[test]
    fn values_above_1_count_as_1() {
        let (a, b) = (image(3, 3, |_| 1.0), image(3, 3, |i| 1.0 + i as f32));
        assert_eq!(psnr(&a, &b), PSNR_CAP_DB);
        assert_eq!(ssim(&a, &b), 1.0);
    }

    #[test]
    fn nan_psnr_is_explained_in_words() {
        assert_eq!(decibels_text(31.416, 1), "31.4 dB");
        assert_eq!(decibels_text(PSNR_CAP_DB, 2), "100.00 dB");
        let text = decibels_text(f64::NAN, 2);
        assert!(text.starts_with("an unmeasurable PSNR") && !text.contains("NaN dB"), "{text}");
    }

    #[test]
    fn nan_pixels_give_nan() {
        let (a, b) = (image(12, 12, |_| 0.5), image(12, 12, |i| if i == 7 { f32::NAN } else { 0.5 }));
        assert!(psnr(&a, &b).is_nan() && ssim(&a, &b).is_nan());
    }

    #[test]
    fn temporal_error_counts_flicker_but_no_constant_error() {
        let (a0, a1) = (image(6, 6, |_| 0.2), image(6, 6, |i| 0.2 + i as f32 * 0.001));
        let shifted = |image: &Image| Image { data: image.data.iter().map(|v| v + 0.25).collect(), ..image.clone() };
        let steady = temporal_error([&a0, &a1], [&shifted(&a0), &shifted(&a1)]);
        assert!(steady < 1e-7, "got {steady}");
        let flicker = temporal_error([&a0, &a1], [&a0, &shifted(&a1)]);
        assert!((flicker - 0.25).abs() < 1e-7, "got {flicker}");
    }
}
