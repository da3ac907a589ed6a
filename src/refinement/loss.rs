//! What refining makes small: how far pictures are from the original's.

use serde::{Deserialize, Serialize};

use super::targets::{mean_square, wide};
use crate::metrics::{BYTES_PER_PIXEL, BYTES_PER_PIXEL_OF_SLOPE, decibels, ssim, ssim_slope};
use crate::render::Image;

/// What the squared error counts beside 1 − SSIM: at equal parts both weigh about as much where 35 dB are left.
const SQUARED: f64 = 20.0;

/// A part `ssim` of 1 − SSIM, the rest [`SQUARED`] times the mean square error.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Loss {
    /// From 0 to 1.
    pub(super) ssim: f64,
}

/// How close pictures are to the original's.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct RenderQuality {
    /// Mean, dB.
    pub(super) psnr: f64,
    /// Root of the mean square error of all.
    pub(super) error: f64,
    /// Mean of 1 − SSIM; 0 where it is not asked for.
    unlike: f64,
}

impl Loss {
    /// How the loss of a picture changes with each of its values, times how many there are, but for a factor that is the
    /// same for all pictures. What a screen cannot show does not count.
    pub(super) fn slope(&self, picture: &Image, target: &[u16]) -> Image {
        let mut slope = picture.clone();
        for (value, &wanted) in slope.data.iter_mut().zip(target) {
            let shown = value.clamp(0.0, 1.0);
            *value = if shown == *value { 2.0 * (shown - wide(wanted)) } else { 0.0 };
        }
        if self.ssim > 0.0 {
            let count = target.len() as f64;
            let factors = [(1.0 - self.ssim) * SQUARED, self.ssim * count].map(|factor| factor as f32);
            let like = ssim_slope(picture, &image(picture, target));
            slope.data.iter_mut().zip(&like.data).for_each(|(to, like)| *to = factors[0] * *to - factors[1] * like);
        }
        slope
    }

    /// Mean square error of a picture, and 1 − SSIM where that is asked for.
    pub(super) fn errors(&self, picture: &Image, target: &[u16]) -> [f64; 2] {
        let unlike = if self.ssim > 0.0 { 1.0 - ssim(picture, &image(picture, target)) } else { 0.0 };
        [mean_square(picture, target), unlike]
    }

    /// Memory beside a picture and what it is compared with, where `threads` pictures are compared at once.
    pub(super) fn bytes_per_pixel(&self, threads: u64) -> u64 {
        let compared = threads * (12 + BYTES_PER_PIXEL) as u64;
        if self.ssim > 0.0 { compared.max((12 + BYTES_PER_PIXEL_OF_SLOPE) as u64) } else { 0 }
    }

    /// Whether pictures as close as `now` are closer than `best`: by mean dB, or by the loss where that has more to it.
    pub(super) fn is_closer(&self, now: &RenderQuality, best: &RenderQuality) -> bool {
        let loss = |of: &RenderQuality| (1.0 - self.ssim) * SQUARED * of.error.powi(2) + self.ssim * of.unlike;
        if self.ssim > 0.0 { loss(now) < loss(best) } else { now.psnr > best.psnr }
    }
}

impl RenderQuality {
    /// Of pictures with a [`Loss::of`] each.
    pub(super) fn from_errors(pictures: &[[f64; 2]]) -> RenderQuality {
        let mean = |of: &dyn Fn(&[f64; 2]) -> f64| pictures.iter().map(of).sum::<f64>() / pictures.len().max(1) as f64;
        RenderQuality {
            psnr: mean(&|&[square, _]| decibels(square)),
            error: mean(&|&[square, _]| square).sqrt(),
            unlike: mean(&|&[_, unlike]| unlike),
        }
    }
}

/// The target of `picture` as an image.
fn image(picture: &Image, target: &[u16]) -> Image {
    Image { data: target.iter().copied().map(wide).collect(), ..*picture }
}

#[cfg(test)]
mod tests {
    use super::super::targets::narrow;
    use super::*;

    #[test]
    fn a_slope_is_the_difference_of_losses_and_what_no_screen_shows_has_none() {
        let (width, height) = (16, 13);
        let values = |step: f32, from: f32, span: f32| -> Vec<f32> {
            (0..3 * width * height).map(|k| from + span * (k as f32 * step).fract()).collect()
        };
        let image = |data: Vec<f32>| Image { width: width as u32, height: height as u32, data };
        let target = narrow(&image(values(0.618, 0.1, 0.8)));
        let picture = image(values(0.414, -0.1, 1.2));
        let count = picture.data.len() as f64;
        for ssim in [0.0, 0.5, 1.0] {
            let loss = Loss { ssim };
            let slopes = loss.slope(&picture, &target).data;
            // Alone the squared error is not scaled.
            let squared = if ssim > 0.0 { (1.0 - ssim) * SQUARED } else { 1.0 };
            let at = |k: usize, by: f32| {
                let mut moved = picture.clone();
                moved.data[k] += by;
                let [square, unlike] = loss.errors(&moved, &target);
                count * (squared * square + ssim * unlike)
            };
            // A difference across the end of what a screen shows is none of either side.
            let clear = |k: &usize| [0.0, 1.0].iter().all(|end| (picture.data[*k] - end).abs() > 2e-3);
            for k in (0..picture.data.len()).step_by(7).filter(clear) {
                let expected =
                    if (0.0..=1.0).contains(&picture.data[k]) { (at(k, 2e-3) - at(k, -2e-3)) / 4e-3 } else { 0.0 };
                let got = f64::from(slopes[k]);
                assert!(
                    (got - expected).abs() < 0.02 * expected.abs() + 0.02,
                    "{ssim}, {k}: got {got}, expected {expected}"
                );
            }
        }
    }

    #[test]
    fn closer_is_by_decibels_alone_or_by_the_loss() {
        let close = |square: f64, unlike: f64| RenderQuality::from_errors(&[[square, unlike], [square, unlike]]);
        let (sharp, soft) = (close(1e-3, 0.02), close(0.9e-3, 0.08));
        assert!((sharp.psnr - 30.0).abs() < 1e-9 && (sharp.error - 1e-3f64.sqrt()).abs() < 1e-12);
        assert!(Loss { ssim: 0.0 }.is_closer(&soft, &sharp) && !Loss { ssim: 0.0 }.is_closer(&sharp, &sharp));
        assert!(Loss { ssim: 0.5 }.is_closer(&sharp, &soft) && !Loss { ssim: 0.5 }.is_closer(&soft, &sharp));
        let unknown = close(f64::NAN, f64::NAN);
        assert!(!Loss { ssim: 0.0 }.is_closer(&unknown, &soft) && !Loss { ssim: 0.5 }.is_closer(&unknown, &soft));
    }
}
