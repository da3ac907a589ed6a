//! Detection of failure modes in renders. A failure mode is visible damage by compression to one kind of Gaussian.
//!
//! Input: the kinds of every Gaussian ([`mod@super::gaussian_kinds`]: fast, thin or changing in appearance) and the
//! renders of both models. Output, for each kind: the error where the kind is visible, the error elsewhere, the worst
//! place, and a verdict. The visibility of a kind is known exactly: the original is rendered once more with colors that
//! encode the kinds, which gives for every pixel the share w of each kind.
//!
//! The failure modes are from "Temporally-Aware Pruning for Compact 4D Gaussian Splatting Models", section 4.5. Memory:
//! per thread one more render, and the original's state without its colors.

use serde::{Deserialize, Serialize};

use super::gaussian_kinds::{GaussianKind, KindFlags};
use crate::evaluation::RenderedViews;
use crate::metrics::{PSNR_CAP_DB, clamped, psnr};
use crate::model::{AttributeValues, Camera, Gaussians, SH_C0};
use crate::render::{Image, render};

/// PSNR in dB below which an error counts as visible: at 40 dB the root mean square error is 1/100 of the range of
/// colors.
pub const VISIBLE_ERROR_PSNR_DB: f64 = 40.0;
/// Minimum difference in dB for a failure mode to be flagged: PSNR where its kind of Gaussian is not visible, minus
/// PSNR where it is visible. A PSNR lower by 3 dB means twice the squared error.
pub const MIN_PSNR_GAP_DB: f64 = 3.0;
/// Minimum share of a kind of Gaussian in a render, from 0 to 1. The share in a pixel is Σ alpha · transmittance of the
/// Gaussians of this kind; the share in a render is the mean over its pixels. Renders with a smaller share are ignored
/// in the search for the worst damage to this kind. If all renders are ignored, the damage is not judged.
pub const MIN_PIXEL_SHARE: f64 = 1e-3;
/// Minimum lost fraction of the contribution of a kind of Gaussian to renders, from 0 to 1, for its failure mode to be
/// flagged. The lost fraction is the contribution of the Gaussians of this kind that were dropped or merged, divided by
/// the contribution of all Gaussians of this kind. If the lost fraction is unknown (without an index map), it is not
/// checked.
pub const MIN_LOST_CONTRIBUTION: f64 = 0.01;
/// Side length in pixels of the square that is shown where a failure mode is worst.
pub const CROP_SIDE_PX: u32 = 64;

/// Squared error between the renders of both models in one view, summed over its pixels: in total, and for each kind of
/// Gaussian (fast, thin or changing in appearance).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ViewErrorSums {
    /// Error sums of each kind of Gaussian, in the order of [`GaussianKind::ALL`]: fast, thin, changing in appearance.
    /// The squared error of a pixel is divided among the kinds in proportion to their shares in the pixel. The share of
    /// a kind is the sum of alpha · transmittance over its Gaussians.
    kinds: [FailureSums; 3],
    /// Sum over pixels of e²: the squared difference between the renders of the two models, averaged over color
    /// channels.
    error: f64,
    pixels: f64,
}

/// Sums over the pixels of one view, for one kind of Gaussian (fast, thin or changing in appearance).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct FailureSums {
    /// Sum over pixels of w, the share of one kind of Gaussian in the pixel.
    weight: f64,
    /// Sum over pixels of w e²: the share w of one kind of Gaussian in the pixel, times the squared difference e²
    /// between the renders of the two models.
    error: f64,
    /// Sum over pixels of w ∇c·∇o. Symbols: w is the share of one kind of Gaussian in the pixel; ∇c and ∇o are the
    /// brightness gradients of the compressed and of the original render.
    kept_detail: f64,
    /// Sum over pixels of w ∇o·∇o. Symbols: w is the share of one kind of Gaussian in the pixel; ∇o is the brightness
    /// gradient of the original render.
    detail: f64,
}

/// Result of the check for one failure mode, that is, for one kind of Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Verdict if the scene has no Gaussian of the kind that the failure mode concerns.
    Absent,
    /// Verdict if the scene has Gaussians of the kind that the failure mode concerns, but their share of every render
    /// is below [`MIN_PIXEL_SHARE`].
    Unseen,
    /// Verdict if compression dropped or merged almost no Gaussian of the kind that the failure mode concerns: less
    /// than the fraction [`MIN_LOST_CONTRIBUTION`] of the contribution of this kind to renders.
    Untouched,
    /// Verdict if damage to this failure mode's kind of Gaussian is not visible. Where this kind is visible, PSNR is at
    /// least [`VISIBLE_ERROR_PSNR_DB`], or it is lower than elsewhere by less than [`MIN_PSNR_GAP_DB`].
    Passed,
    /// Verdict if damage to this failure mode's kind of Gaussian is visible. Where this kind is visible, PSNR is below
    /// [`VISIBLE_ERROR_PSNR_DB`], and it is lower than elsewhere by at least [`MIN_PSNR_GAP_DB`].
    Flagged,
}

/// Render in which a failure mode is worst.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WorstPlace {
    /// Index of the render in [`crate::evaluation::results::Evaluation::views`].
    #[serde(skip)]
    pub place: usize,
    /// Index of the frame that the render shows.
    pub frame: usize,
    /// Number of the view that the render shows.
    pub view: u32,
    /// PSNR of this render, dB, where the kind of Gaussian that the failure mode concerns is visible.
    pub psnr: f64,
}

/// Measurements and verdict of one failure mode: damage to one kind of Gaussian.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FailureMode {
    /// Name of the failure mode, as the page shows it.
    pub name: &'static str,
    /// Description of the kind of Gaussian that this failure mode concerns.
    #[serde(rename = "happens_to")]
    pub kind_description: String,
    /// Verdict on the failure mode.
    pub verdict: Verdict,
    /// Number of Gaussians in the original of the kind that this failure mode concerns.
    pub gaussians: usize,
    /// Number of Gaussians of this kind that were dropped; `None` without an index map (file that maps input to output
    /// Gaussians).
    pub dropped: Option<usize>,
    /// Number of Gaussians of this kind that were merged; `None` without an index map (file that maps input to output
    /// Gaussians).
    pub merged: Option<usize>,
    /// Contribution of the Gaussians of this kind to renders, as a fraction of the contribution of all Gaussians.
    pub coverage: f64,
    /// Fraction of this kind's contribution to renders that is lost: the part of the Gaussians that were dropped or
    /// merged. `None` without an index map (file that maps input to output Gaussians).
    pub coverage_lost: Option<f64>,
    /// Mean share of this kind of Gaussian in a pixel, from 0 to 1, over all pixels of all compared renders. The share
    /// in a pixel is Σ alpha · transmittance of the Gaussians of this kind.
    #[serde(rename = "shown")]
    pub pixel_share: f64,
    /// PSNR where this kind of Gaussian is visible, dB. The weight of a pixel is the share of this kind in the pixel.
    /// `None` if all weights are 0.
    #[serde(rename = "psnr_there")]
    pub psnr_on_kind: Option<f64>,
    /// PSNR where this kind of Gaussian is not visible, dB. The weight of a pixel is 1 minus the share of this kind in
    /// the pixel. `None` if all weights are 0.
    pub psnr_elsewhere: Option<f64>,
    /// Lost fraction of the original's brightness gradients where this kind of Gaussian is visible: 1 − Σ w ∇c·∇o / Σ w
    /// ∇o·∇o over all pixels. Symbols: w is the share of this kind in the pixel; ∇o and ∇c are the brightness gradients
    /// of the original and of the compressed render. Negative if the compressed model exaggerates the gradients. `None`
    /// if the original has no gradients there.
    pub detail_lost: Option<f64>,
    /// Render in which the damage to this kind of Gaussian is worst; `None` if the damage cannot be judged in any
    /// render.
    pub worst: Option<WorstPlace>,
}

/// Numbers and contribution of the Gaussians of one kind (fast, thin or changing in appearance). They come from the
/// statistics, not from the compared renders.
#[derive(Debug, Clone, Copy, Default)]
pub struct KindTotals {
    /// Number of Gaussians of this kind.
    pub count: usize,
    /// Two numbers of Gaussians of this kind: dropped, and merged. `None` without an index map (file that maps input to
    /// output Gaussians).
    pub fates: Option<(usize, usize)>,
    /// Two fractions. First: the contribution of this kind to renders, divided by the contribution of all Gaussians.
    /// Second: the contribution of the Gaussians of this kind that were dropped or merged, divided by the contribution
    /// of this kind.
    pub shares: (f64, f64),
}

/// Renders an image that shows where each kind of Gaussian is visible. Red, green and blue of a pixel are the shares (Σ
/// alpha · transmittance) of the three kinds in [`GaussianKind::ALL`]: fast, thin, changing in appearance.
/// - `state`: all Gaussians of the original at one frame
/// - `kinds`: for each Gaussian, whether it belongs to each kind
pub fn render_kind_shares(state: &Gaussians, kinds: &[KindFlags], camera: &Camera) -> Image {
    let mut sh = AttributeValues::zeros(3, state.len());
    for (i, kinds) in kinds.iter().enumerate() {
        // Color is 0.5 + SH_C0 · coefficient.
        sh.set_row(i, kinds.map(|of| ((f64::from(u8::from(of)) - 0.5) / SH_C0) as f32));
    }
    let marked = Gaussians {
        position: state.position.clone(),
        rotation: state.rotation.clone(),
        log_scale: state.log_scale.clone(),
        opacity_logit: state.opacity_logit.clone(),
        sh,
    };
    render(&marked, camera, [0.0; 3])
}

/// Returns the squared error between the renders of both models in one view, summed over its pixels: in total, and for
/// each kind of Gaussian (fast, thin or changing in appearance).
/// - `state`: Gaussians of the original at the frame of the view
/// - `kinds`: for each Gaussian, whether it belongs to each kind
/// - `renders`: renders of both models
///
/// # Panics
/// Panics if the sizes of the two renders and of the camera's images differ.
pub fn sum_errors(state: &Gaussians, kinds: &[KindFlags], camera: &Camera, renders: &RenderedViews) -> ViewErrorSums {
    let shares = render_kind_shares(state, kinds, camera);
    let (original, compressed) = (brightness(&renders.original), brightness(&renders.compressed));
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut view_sums = ViewErrorSums { pixels: (width * height) as f64, ..ViewErrorSums::default() };
    let error = squared_error(&renders.original, &renders.compressed);
    for (i, (error, shares)) in error.iter().zip(shares.data.chunks_exact(3)).enumerate() {
        view_sums.error += error;
        // Forward differences; 0 at the far borders.
        let step = |of: &[f64]| {
            let along = if (i + 1).is_multiple_of(width) { 0.0 } else { of[i + 1] - of[i] };
            let down = if i + width >= of.len() { 0.0 } else { of[i + width] - of[i] };
            [along, down]
        };
        let (o, c) = (step(&original), step(&compressed));
        for (sums, &share) in view_sums.kinds.iter_mut().zip(shares) {
            let w = f64::from(share);
            sums.weight += w;
            sums.error += w * error;
            sums.kept_detail += w * (c[0] * o[0] + c[1] * o[1]);
            sums.detail += w * (o[0] * o[0] + o[1] * o[1]);
        }
    }
    view_sums
}

/// Returns for each pixel the squared difference of the images `a` and `b`, averaged over the channels; values are
/// first clamped to [0, 1].
pub fn squared_error(a: &Image, b: &Image) -> Vec<f64> {
    let square = |(a, b): (&f32, &f32)| (clamped(*a) - clamped(*b)).powi(2);
    let pixels = a.data.chunks_exact(3).zip(b.data.chunks_exact(3));
    pixels.map(|(a, b)| a.iter().zip(b).map(square).sum::<f64>() / 3.0).collect()
}

fn brightness(image: &Image) -> Vec<f64> {
    image.data.chunks_exact(3).map(|p| p.iter().map(|&v| clamped(v)).sum::<f64>() / 3.0).collect()
}

/// Measures the errors of renders where Gaussians of the kind `kind` are visible. Returns the measurements and a
/// [`Verdict`], which states whether these errors are visible and much larger than elsewhere.
/// - `members`: counts and contribution of the Gaussians of this kind
/// - `error_sums`: error sums of all renders
/// - `names`: frame and view of each render
pub fn assess_failure_mode(
    kind: GaussianKind,
    members: KindTotals,
    error_sums: &[ViewErrorSums],
    names: &[(usize, u32)],
) -> FailureMode {
    let (name, happens_to) = name_and_description(kind);
    let kind_index = kind as usize;
    let sum = |value: fn(&FailureSums) -> f64| error_sums.iter().map(|of| value(&of.kinds[kind_index])).sum::<f64>();
    let (weight, error) = (sum(|s| s.weight), sum(|s| s.error));
    let pixels: f64 = error_sums.iter().map(|of| of.pixels).sum();
    let all_error: f64 = error_sums.iter().map(|of| of.error).sum();
    let shown = if pixels > 0.0 { weight / pixels } else { 0.0 };
    let psnr_there = db(error, weight);
    let psnr_elsewhere = db((all_error - error).max(0.0), pixels - weight);
    let detail = sum(|s| s.detail);
    let worst = (0..error_sums.len())
        .filter(|&place| error_sums[place].kinds[kind_index].weight >= MIN_PIXEL_SHARE * error_sums[place].pixels)
        .filter_map(|place| {
            Some((place, db(error_sums[place].kinds[kind_index].error, error_sums[place].kinds[kind_index].weight)?))
        })
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(place, psnr)| WorstPlace { place, frame: names[place].0, view: names[place].1, psnr });
    let lost = members.fates.is_some().then_some(members.shares.1);
    let is_distinct = psnr_there
        .zip(psnr_elsewhere)
        .is_some_and(|(there, elsewhere)| there < VISIBLE_ERROR_PSNR_DB && there <= elsewhere - MIN_PSNR_GAP_DB);
    let verdict = if members.count == 0 {
        Verdict::Absent
    } else if worst.is_none() {
        Verdict::Unseen
    } else if lost.is_some_and(|lost| lost < MIN_LOST_CONTRIBUTION) {
        Verdict::Untouched
    } else if is_distinct {
        Verdict::Flagged
    } else {
        Verdict::Passed
    };
    FailureMode {
        name,
        kind_description: happens_to,
        verdict,
        gaussians: members.count,
        dropped: members.fates.map(|fates| fates.0),
        merged: members.fates.map(|fates| fates.1),
        coverage: members.shares.0,
        coverage_lost: lost,
        pixel_share: shown,
        psnr_on_kind: psnr_there,
        psnr_elsewhere,
        detail_lost: (detail > 0.0).then(|| 1.0 - sum(|s| s.kept_detail) / detail),
        worst,
    }
}

/// Returns two texts for a kind of Gaussian: the name of its failure mode, and a description of the Gaussians of this
/// kind.
fn name_and_description(kind: GaussianKind) -> (&'static str, String) {
    use super::gaussian_kinds::{
        MAX_STILL_MOTION, MIN_COLOR_CHANGE, MIN_FAST_MOTION, MIN_NON_RIGID_CHANGE, MIN_OPACITY_CHANGE, MIN_THIN_RATIO,
        NEIGHBORS,
    };
    match kind {
        GaussianKind::Motion => (
            "fast, non-rigid motion",
            format!(
                "Gaussians that move by {}% of the scene extent per frame or more (root mean square), while the \
                 distance to half of their {NEIGHBORS} nearest neighbors changes by {}% or more",
                100.0 * MIN_FAST_MOTION,
                100.0 * MIN_NON_RIGID_CHANGE
            ),
        ),
        GaussianKind::Thin => ("thin structures", format!("Gaussians {MIN_THIN_RATIO} times as long as wide or more")),
        GaussianKind::Appearance => (
            "fine changes of appearance",
            format!(
                "Gaussians that stand still (up to {}% of the extent per frame) while their opacity varies by {} or \
                 their color by {} (standard deviation) or more",
                100.0 * MAX_STILL_MOTION,
                MIN_OPACITY_CHANGE,
                MIN_COLOR_CHANGE
            ),
        ),
    }
}

/// Returns the PSNR −10 log10(`error` / `weight`) in dB, but at most [`PSNR_CAP_DB`]. `error`: weighted sum of squared
/// errors. `weight`: sum of the weights; if it is 0, the result is `None`.
fn db(error: f64, weight: f64) -> Option<f64> {
    (weight > 0.0).then(|| (-10.0 * (error / weight).log10()).min(PSNR_CAP_DB))
}

/// Returns the upper left corner (column, row) of the square of a render in which the error of the kind `kind` of
/// Gaussian is largest.
/// - `renders`: renders of both models
/// - `shares`: share of each kind of Gaussian in every pixel, from [`render_kind_shares`]
///
/// The error of a square is the sum of w e² over its pixels, where w is the share of the kind and e² the squared
/// difference of the renders. A square has a side of [`CROP_SIDE_PX`] pixels, or less in a smaller render. Of equal
/// squares, the first is taken, row by row.
pub fn worst_corner(renders: &RenderedViews, shares: &Image, kind: GaussianKind) -> (u32, u32) {
    let (width, height) = (renders.original.width as usize, renders.original.height as usize);
    let (across, down) = ((CROP_SIDE_PX as usize).min(width), (CROP_SIDE_PX as usize).min(height));
    // sums[y][x] is the sum over the rectangle above and left of (x, y).
    let stride = width + 1;
    let mut sums = vec![0.0; stride * (height + 1)];
    let error = squared_error(&renders.original, &renders.compressed);
    for y in 0..height {
        let mut row = 0.0;
        for x in 0..width {
            let i = y * width + x;
            row += f64::from(shares.data[3 * i + kind as usize]) * error[i];
            sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
        }
    }
    let mut best = (f64::NEG_INFINITY, (0, 0));
    for y in 0..=height - down {
        for x in 0..=width - across {
            let (low, high) = (y * stride, (y + down) * stride);
            let inside = sums[high + x + across] - sums[high + x] - sums[low + x + across] + sums[low + x];
            if inside > best.0 {
                best = (inside, (x as u32, y as u32));
            }
        }
    }
    best.1
}

/// Returns the square part of `image` whose upper left pixel is (`left`, `top`). Its side is [`CROP_SIDE_PX`] pixels,
/// or less at the border of the image.
pub fn crop_square(image: &Image, (left, top): (u32, u32)) -> Image {
    let (width, height) = (CROP_SIDE_PX.min(image.width - left), CROP_SIDE_PX.min(image.height - top));
    let row = |y: u32| {
        let start = 3 * (y as usize * image.width as usize + left as usize);
        &image.data[start..start + 3 * width as usize]
    };
    Image { width, height, data: (top..top + height).flat_map(row).copied().collect() }
}

/// Returns the PSNR in dB, compressed against original, in the square that [`crop_square`] cuts out at `corner`.
pub fn crop_psnr(renders: &RenderedViews, corner: (u32, u32)) -> f64 {
    psnr(&crop_square(&renders.compressed, corner), &crop_square(&renders.original, corner))
}

#[cfg(test)]
mod tests;
