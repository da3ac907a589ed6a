//! How close pictures are to one another: PSNR, SSIM, FLIP, and the error of what moves.
//!
//! Data in: pairs of [`Image`]s of one size. Data out: one f64 per pair. Values are clamped to [0, 1]
//! first, as a screen does, and everything is summed in f64. Memory: [`BYTES_PER_PIXEL`]; for
//! FLIP what its authors' code takes.

mod flip;
mod ssim;

pub use flip::flip;
pub use ssim::{ssim, ssim_slope};

use crate::Image;

/// Memory of comparing two pictures, per pixel: SSIM's sums are the most.
pub const BYTES_PER_PIXEL: usize = 5 * size_of::<f64>();

/// Memory of [`ssim_slope`], per pixel: SSIM's sums of three channels, and their slopes twice.
pub const BYTES_PER_PIXEL_OF_SLOPE: usize = 3 * (BYTES_PER_PIXEL + size_of::<f64>() + size_of::<f32>());

/// PSNR of pictures that agree to the last bit, and of any nearer than that: a mean over pictures then
/// stays finite.
pub const PSNR_CAP_DB: f64 = 100.0;

/// Peak signal-to-noise ratio with peak 1: −10·log₁₀ of the mean squared difference over pixels and
/// channels, dB, at most [`PSNR_CAP_DB`]. Over several pictures, average this value.
///
/// Two empty images agree. NaN in either image gives NaN.
///
/// # Panics
/// If the sizes differ.
pub fn psnr(a: &Image, b: &Image) -> f64 {
    decibels(mean_square(channels(a, b).map(|(a, b)| a - b)))
}

/// PSNR of a mean squared difference; NaN of NaN.
pub fn decibels(mean_square: f64) -> f64 {
    let db = -10.0 * mean_square.log10();
    if db > PSNR_CAP_DB { PSNR_CAP_DB } else { db }
}

/// Returns the text of a PSNR, with so many `digits` after the point; of NaN what NaN means.
pub fn decibels_text(psnr: f64, digits: usize) -> String {
    match psnr.is_nan() {
        true => "an unmeasurable PSNR (some pixels are NaN)".to_owned(),
        false => format!("{psnr:.digits$} dB"),
    }
}

/// Error of frame-to-frame differences: the root mean square of (a₁ − a₀) − (b₁ − b₀) over pixels and
/// channels, for one view at two successive frames; in [0, 2], 0 where `b` flickers exactly as `a` moves.
///
/// A loss that stands still costs nothing here, one that shimmers does.
///
/// # Panics
/// If the sizes differ.
pub fn temporal_error(a: [&Image; 2], b: [&Image; 2]) -> f64 {
    let (before, after) = (channels(a[0], b[0]), channels(a[1], b[1]));
    mean_square(before.zip(after).map(|((a0, b0), (a1, b1))| (a1 - a0) - (b1 - b0))).sqrt()
}

/// Clamped values of both images, side by side.
fn channels<'a>(a: &'a Image, b: &'a Image) -> impl ExactSizeIterator<Item = (f64, f64)> + 'a {
    assert_same_size(a, b);
    a.data.iter().zip(&b.data).map(|(&a, &b)| (clamped(a), clamped(b)))
}

fn assert_same_size(a: &Image, b: &Image) {
    assert_eq!((a.width, a.height), (b.width, b.height), "pictures of different sizes");
    assert_eq!(a.data.len(), b.data.len(), "pictures of different sizes");
}

/// What a screen shows of a value.
pub fn clamped(value: f32) -> f64 {
    f64::from(value.clamp(0.0, 1.0))
}

/// Mean of squares, 0 of nothing.
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
    fn a_constant_difference_has_its_closed_form() {
        let (a, b) = (image(5, 4, |_| 0.25), image(5, 4, |_| 0.375));
        let expected = -20.0 * 0.125f64.log10();
        assert!((psnr(&a, &b) - expected).abs() < 1e-12, "got {}, expected {expected}", psnr(&a, &b));
    }

    #[test]
    fn equal_pictures_are_capped() {
        let a = image(5, 4, |i| i as f32 * 0.01);
        assert_eq!(psnr(&a, &a), PSNR_CAP_DB);
        assert_eq!(psnr(&image(0, 0, |_| 0.0), &image(0, 0, |_| 0.0)), PSNR_CAP_DB);
    }

    #[test]
    fn what_a_screen_clamps_does_not_count() {
        let (a, b) = (image(3, 3, |_| 1.0), image(3, 3, |i| 1.0 + i as f32));
        assert_eq!(psnr(&a, &b), PSNR_CAP_DB);
        assert_eq!(ssim(&a, &b), 1.0);
    }

    #[test]
    fn nan_decibels_are_named_in_words() {
        assert_eq!(decibels_text(31.416, 1), "31.4 dB");
        assert_eq!(decibels_text(PSNR_CAP_DB, 2), "100.00 dB");
        let text = decibels_text(f64::NAN, 2);
        assert!(text.starts_with("an unmeasurable PSNR") && !text.contains("NaN dB"), "{text}");
    }

    #[test]
    fn nan_is_not_called_agreement() {
        let (a, b) = (image(12, 12, |_| 0.5), image(12, 12, |i| if i == 7 { f32::NAN } else { 0.5 }));
        assert!(psnr(&a, &b).is_nan() && ssim(&a, &b).is_nan());
    }

    #[test]
    fn a_steady_loss_has_no_temporal_error_and_a_flicker_has_its_own() {
        let (a0, a1) = (image(6, 6, |_| 0.2), image(6, 6, |i| 0.2 + i as f32 * 0.001));
        let shifted = |image: &Image| Image { data: image.data.iter().map(|v| v + 0.25).collect(), ..image.clone() };
        let steady = temporal_error([&a0, &a1], [&shifted(&a0), &shifted(&a1)]);
        assert!(steady < 1e-7, "got {steady}");
        let flicker = temporal_error([&a0, &a1], [&a0, &shifted(&a1)]);
        assert!((flicker - 0.25).abs() < 1e-7, "got {flicker}");
    }
}
