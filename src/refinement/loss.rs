//! Loss that refinement minimizes: the difference between renders and target views (renders of the original model).

use serde::{Deserialize, Serialize};

use super::targets::{mean_square, wide};
use crate::memory_plan::Workload;
use crate::metrics::{METRIC_BYTES_PER_PIXEL, SSIM_GRADIENT_BYTES_PER_PIXEL, decibels, ssim, ssim_gradient};
use crate::passes::grid_strides;
use crate::render::{ALL_PIXELS, GridStrides, Image};

/// Weight of the newest step in the running mean square of derivatives (see [`limit_gradient`]). The earlier mean has
/// the rest of 1.
const NEWEST_WEIGHT: f64 = 0.1;

/// Factor of the mean square error in the loss. For a render with 35 dB PSNR, the mean square error times this factor
/// is 0.006.
const SQUARED_WEIGHT: f64 = 20.0;
/// Wanted number of rendered pixels of a training view per survivor (Gaussian left by pruning). It determines the
/// strides of the rendered pixels. With 2.5, the mean PSNR of three moving models at four counts is 0.1 dB higher, and
/// a run takes 2 to 15% longer.
const PIXELS_PER_SURVIVOR: f64 = 1.8;
/// Wanted number of rendered pixels per survivor in a static scene. There, all steps share one state, so each step takes
/// less time. At 10% kept, two captured models have 0 and 0.25 dB more than with 1.8 pixels.
const PIXELS_PER_SURVIVOR_IF_STATIC: f64 = 2.65;

/// Loss of a render: `ssim` · (1 − SSIM) + (1 − `ssim`) · [`SQUARED_WEIGHT`] · mean square error.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Loss {
    /// Weight of 1 − SSIM in the loss, from 0 to 1.
    pub(super) ssim: f64,
}

/// Quality of renders, compared with their target views and averaged over the views.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct RenderQuality {
    /// Mean PSNR over the views, in dB.
    pub(super) psnr: f64,
    /// Root mean square error over all color values of all views; color values are from 0 to 1.
    pub(super) error: f64,
    /// Mean of 1 − SSIM over the views; 0 if SSIM is not part of the loss.
    dissimilarity: f64,
}

impl Loss {
    /// Returns the derivative of the loss with respect to each color value of `render`, as an image. Derivatives are
    /// multiplied by the number of color values and by a constant; Adam does not depend on a constant factor. `target`:
    /// color values of the target view, 0 to 1 as 16-bit integers. For values of the render outside [0, 1] the
    /// derivative is 0, because a screen clamps these.
    pub(super) fn gradient(&self, render: &Image, target: &[u16]) -> Image {
        let mut gradient = render.clone();
        for (value, &wanted) in gradient.data.iter_mut().zip(target) {
            let shown = value.clamp(0.0, 1.0);
            *value = if shown == *value { 2.0 * (shown - wide(wanted)) } else { 0.0 };
        }
        if self.ssim > 0.0 {
            let count = target.len() as f64;
            let factors = [(1.0 - self.ssim) * SQUARED_WEIGHT, self.ssim * count].map(|factor| factor as f32);
            let like = ssim_gradient(render, &image(render, target));
            gradient.data.iter_mut().zip(&like.data).for_each(|(to, like)| *to = factors[0] * *to - factors[1] * like);
        }
        gradient
    }

    /// Returns the strides of the grid of pixels of training views of the input `work` that are rendered and compared.
    /// `survivors`: number of Gaussians left by pruning. All pixels are rendered if SSIM is part of the loss, because
    /// SSIM needs neighboring pixels.
    pub(super) fn strides(&self, work: &Workload, survivors: usize) -> GridStrides {
        if self.ssim > 0.0 {
            return ALL_PIXELS;
        }
        let per_survivor = if work.is_static() { PIXELS_PER_SURVIVOR_IF_STATIC } else { PIXELS_PER_SURVIVOR };
        grid_strides(work.pixels, per_survivor * survivors as f64)
    }

    /// Returns two errors of `render` against the 16-bit values `target` of its target view: the mean square error, and
    /// 1 − SSIM, which is 0 if SSIM is not part of the loss.
    pub(super) fn errors(&self, render: &Image, target: &[u16]) -> [f64; 2] {
        let dissimilarity = if self.ssim > 0.0 { 1.0 - ssim(render, &image(render, target)) } else { 0.0 };
        [mean_square(render, target), dissimilarity]
    }

    /// Returns the bytes of memory, per pixel of a view, that buffers for SSIM take if `threads` renders are compared
    /// with their target views in parallel. The renders and target views themselves are not included. Returns 0 if SSIM
    /// is not part of the loss.
    pub(super) fn bytes_per_pixel(&self, threads: u64) -> u64 {
        let compared = threads * (12 + METRIC_BYTES_PER_PIXEL) as u64;
        if self.ssim > 0.0 { compared.max((12 + SSIM_GRADIENT_BYTES_PER_PIXEL) as u64) } else { 0 }
    }

    /// Returns whether the quality `now` is better than the quality `best`. If SSIM is part of the loss, the lower loss
    /// is better; otherwise the higher mean PSNR is.
    pub(super) fn is_closer(&self, now: &RenderQuality, best: &RenderQuality) -> bool {
        let loss =
            |of: &RenderQuality| (1.0 - self.ssim) * SQUARED_WEIGHT * of.error.powi(2) + self.ssim * of.dissimilarity;
        if self.ssim > 0.0 { loss(now) < loss(best) } else { now.psnr > best.psnr }
    }
}

impl RenderQuality {
    /// Returns the geometric mean of the root mean square errors of all views, which is the error that corresponds to
    /// the mean PSNR. A few views with large errors raise it less than they raise [`RenderQuality::error`].
    pub(super) fn typical_error(&self) -> f64 {
        10f64.powf(-self.psnr / 20.0)
    }

    /// Returns the mean quality of several views. `errors` holds two errors of each view, as [`Loss::errors`] returns
    /// them: the mean square error, and 1 − SSIM.
    pub(super) fn from_errors(errors: &[[f64; 2]]) -> RenderQuality {
        let mean = |of: &dyn Fn(&[f64; 2]) -> f64| errors.iter().map(of).sum::<f64>() / errors.len().max(1) as f64;
        RenderQuality {
            psnr: mean(&|&[square, _]| decibels(square)),
            error: mean(&|&[square, _]| square).sqrt(),
            dissimilarity: mean(&|&[_, dissimilarity]| dissimilarity),
        }
    }
}

/// Returns the target view `target`, given as 16-bit color values, as an image of the width and height of `render`.
fn image(render: &Image, target: &[u16]) -> Image {
    Image { data: target.iter().copied().map(wide).collect(), ..*render }
}

/// Limits the derivatives `gradient` of the loss of a guard view ([`Targets::is_guard`]) with respect to its color
/// values. If their root mean square is above the root of `mean_square`, they are scaled down to it; if there is no
/// mean yet, to 0. Without the limit, the large errors of guard views would raise the gradient magnitudes by which Adam
/// divides, and so shorten later steps. The derivatives of any other view stay as they are, and their mean square
/// updates `mean_square`. Values that are not finite do not count: the renderer ignores their pixels.
pub(super) fn limit_gradient(gradient: &mut Image, is_guard: bool, mean_square: &mut Option<f64>) {
    let squares = gradient.data.iter().map(|&value| f64::from(value).powi(2)).filter(|square| square.is_finite());
    let (sum, count) = squares.fold((0.0, 0u32), |(sum, count), square| (sum + square, count + 1));
    if count == 0 {
        return;
    }
    let own = sum / f64::from(count);
    match *mean_square {
        mean if is_guard => {
            let factor = (mean.unwrap_or(0.0) / own.max(f64::MIN_POSITIVE)).sqrt().min(1.0) as f32;
            gradient.data.iter_mut().for_each(|value| *value *= factor);
        }
        Some(mean) => *mean_square = Some(mean + NEWEST_WEIGHT * (own - mean)),
        None => *mean_square = Some(own),
    }
}

#[cfg(test)]
mod tests {
    use super::super::targets::narrow;
    use super::*;

    #[test]
    fn slopes_are_finite_differences_of_the_loss() {
        let (width, height) = (16, 13);
        let values = |step: f32, from: f32, span: f32| -> Vec<f32> {
            (0..3 * width * height).map(|k| from + span * (k as f32 * step).fract()).collect()
        };
        let image = |data: Vec<f32>| Image { width: width as u32, height: height as u32, data };
        let target = narrow(&image(values(0.618, 0.1, 0.8)));
        let render = image(values(0.414, -0.1, 1.2));
        let count = render.data.len() as f64;
        for ssim in [0.0, 0.5, 1.0] {
            let loss = Loss { ssim };
            let slopes = loss.gradient(&render, &target).data;
            // Without SSIM the squared error is not scaled.
            let squared = if ssim > 0.0 { (1.0 - ssim) * SQUARED_WEIGHT } else { 1.0 };
            let at = |k: usize, by: f32| {
                let mut moved = render.clone();
                moved.data[k] += by;
                let [square, dissimilarity] = loss.errors(&moved, &target);
                count * (squared * square + ssim * dissimilarity)
            };
            // Skips values near 0 and 1, where the loss has a kink, so that a finite difference is the derivative on
            // neither side.
            let clear = |k: &usize| [0.0, 1.0].iter().all(|end| (render.data[*k] - end).abs() > 2e-3);
            for k in (0..render.data.len()).step_by(7).filter(clear) {
                let expected =
                    if (0.0..=1.0).contains(&render.data[k]) { (at(k, 2e-3) - at(k, -2e-3)) / 4e-3 } else { 0.0 };
                let got = f64::from(slopes[k]);
                assert!(
                    (got - expected).abs() < 0.02 * expected.abs() + 0.02,
                    "{ssim}, {k}: got {got}, expected {expected}"
                );
            }
        }
    }

    #[test]
    fn closer_means_higher_psnr_or_lower_loss() {
        let close = |square: f64, dissimilarity: f64| {
            RenderQuality::from_errors(&[[square, dissimilarity], [square, dissimilarity]])
        };
        let (sharp, soft) = (close(1e-3, 0.02), close(0.9e-3, 0.08));
        assert!((sharp.psnr - 30.0).abs() < 1e-9 && (sharp.error - 1e-3f64.sqrt()).abs() < 1e-12);
        assert!(Loss { ssim: 0.0 }.is_closer(&soft, &sharp) && !Loss { ssim: 0.0 }.is_closer(&sharp, &sharp));
        assert!(Loss { ssim: 0.5 }.is_closer(&sharp, &soft) && !Loss { ssim: 0.5 }.is_closer(&soft, &sharp));
        let unknown = close(f64::NAN, f64::NAN);
        assert!(!Loss { ssim: 0.0 }.is_closer(&unknown, &soft) && !Loss { ssim: 0.5 }.is_closer(&unknown, &soft));
    }

    #[test]
    fn guard_views_pull_no_harder_than_other_views() {
        let image = |value: f32| Image { width: 2, height: 1, data: vec![value, -value, 0.0, value, -value, 0.0] };
        let limited = |value: f32, is_guard: bool, mean: &mut Option<f64>| {
            let mut gradient = image(value);
            limit_gradient(&mut gradient, is_guard, mean);
            gradient.data[0]
        };
        let mut mean = None;
        assert_eq!((limited(0.5, true, &mut mean), mean), (0.0, None));
        assert_eq!(limited(0.1, false, &mut mean), 0.1);
        assert!((mean.unwrap() - 2.0 / 3.0 * 0.01).abs() < 1e-9);
        assert!((limited(0.5, true, &mut mean) - 0.1).abs() < 1e-6, "scaled to the mean");
        assert_eq!(limited(0.05, true, &mut mean), 0.05, "never scaled up");
        let before = mean.unwrap();
        limited(0.2, false, &mut mean);
        assert!((mean.unwrap() - (before + 0.1 * (2.0 / 3.0 * 0.04 - before))).abs() < 1e-9);
        let before = mean;
        let mut odd = image(f32::NAN);
        limit_gradient(&mut odd, false, &mut mean);
        assert!(mean.unwrap() < before.unwrap(), "NaN is left out, and zeros lower the mean");
        limit_gradient(&mut Image { width: 0, height: 0, data: Vec::new() }, false, &mut mean);
        assert!(mean.unwrap() > 0.0);
    }
}
