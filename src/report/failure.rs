//! Failure modes that the paper names, detected in renders.
//!
//! In: the kinds of every Gaussian ([`mod@super::traits`]) and the renders of both models. Out: for each kind the error
//! where the kind is visible and elsewhere, the worst place, and a verdict. Where a kind is visible is
//! known exactly: the original is rendered once more with colors that encode the kinds, which gives for every pixel the
//! share w of each kind.
//!
//! The failure modes are from "Temporally-Aware Pruning for Compact 4D Gaussian Splatting Models", section 4.5.
//! Memory: per thread one more render, and the original's state without its colors.

use serde::{Deserialize, Serialize};

use super::traits::{GaussianKind, Traits};
use crate::evaluation::RenderedViews;
use crate::metrics::{PSNR_CAP_DB, clamped, psnr};
use crate::model::{AttributeValues, Camera, Gaussians, SH_C0};
use crate::render::{Image, render};

/// PSNR below which an error is visible, dB: one part in a hundred, root mean square.
pub const VISIBLE_DB: f64 = 40.0;
/// Least distance to the PSNR elsewhere for a flag, dB: 3 dB are twice the squared error.
pub const APART_DB: f64 = 3.0;
/// Least share of the pixels for a kind to be judged.
pub const SHOWN: f64 = 1e-3;
/// Least share of a kind's coverage that was dropped or merged for a flag.
pub const LOST: f64 = 0.01;
/// Side of the square of the worst place, pixels.
pub const CROP: u32 = 64;

/// Error sums of one render, in f64 over pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Observed {
    /// Sums by kind, in the order of [`GaussianKind::ALL`].
    kinds: [FailureSums; 3],
    /// Σ e², e² the mean over channels of the squared difference.
    error: f64,
    pixels: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct FailureSums {
    /// Σ w.
    weight: f64,
    /// Σ w e².
    error: f64,
    /// Σ w ∇c·∇o and Σ w ∇o·∇o; c and o are the brightness of the compressed and the original render.
    kept_detail: f64,
    detail: f64,
}

/// Result of the search for one failure mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The scene has no Gaussian of the kind.
    Absent,
    /// The scene has such Gaussians, but their share of every render is too small to be judged.
    Unseen,
    /// No Gaussian of the kind was dropped or merged, or almost none.
    Untouched,
    /// The error there is not visible, or not larger than elsewhere.
    Passed,
    /// The error there is visible and much larger than elsewhere.
    Flagged,
}

/// Render in which a failure mode is worst.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WorstPlace {
    /// Index into the evaluation's renders.
    #[serde(skip)]
    pub place: usize,
    /// Frame of the sequence.
    pub frame: usize,
    /// View number.
    pub view: u32,
    /// PSNR of this render where the kind is visible, dB.
    pub psnr: f64,
}

/// Figures and verdict of one failure mode.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FailureMode {
    /// Name of the mode.
    pub name: &'static str,
    /// Description of the Gaussians of this kind.
    pub happens_to: String,
    /// Verdict.
    pub verdict: Verdict,
    /// Number of Gaussians of this kind in the original.
    pub gaussians: usize,
    /// Number of them that were dropped; `None` without an index map.
    pub dropped: Option<usize>,
    /// Number of them that were merged; `None` without an index map.
    pub merged: Option<usize>,
    /// Share of the scene's coverage.
    pub coverage: f64,
    /// Share of their coverage that was dropped or merged; `None` without an index map.
    pub coverage_lost: Option<f64>,
    /// Share of all pixels.
    pub shown: f64,
    /// PSNR where the kind is visible, weighted by its shares, dB; `None` where it is nowhere.
    pub psnr_there: Option<f64>,
    /// PSNR elsewhere, dB.
    pub psnr_elsewhere: Option<f64>,
    /// Share of the original's brightness gradients that the compressed renders do not follow; negative where they
    /// exaggerate.
    pub detail_lost: Option<f64>,
    /// Render in which the mode is worst.
    pub worst: Option<WorstPlace>,
}

/// Counts of the Gaussians of a kind, known before rendering.
#[derive(Debug, Clone, Copy, Default)]
pub struct KindMembers {
    /// Number of Gaussians.
    pub count: usize,
    /// Numbers of dropped and merged ones, where known.
    pub fates: Option<(usize, usize)>,
    /// Share of the scene's coverage, and the share of that coverage that was dropped or merged.
    pub shares: (f64, f64),
}

/// Renders the share of each kind in every pixel, as red, green and blue.
pub fn shares_of_pixels(state: &Gaussians, traits: &[Traits], camera: &Camera) -> Image {
    let mut sh = AttributeValues::zeros(3, state.len());
    for (i, traits) in traits.iter().enumerate() {
        // Color is 0.5 + SH_C0 · coefficient.
        sh.set_row(i, traits.map(|of| ((f64::from(u8::from(of)) - 0.5) / SH_C0) as f32));
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

/// Sums the error of one render by kind.
///
/// # Panics
/// If the sizes differ.
pub fn observe(state: &Gaussians, traits: &[Traits], camera: &Camera, taken: &RenderedViews) -> Observed {
    let shares = shares_of_pixels(state, traits, camera);
    let (original, compressed) = (brightness(&taken.original), brightness(&taken.compressed));
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut found = Observed { pixels: (width * height) as f64, ..Observed::default() };
    let error = squared_error(&taken.original, &taken.compressed);
    for (i, (error, shares)) in error.iter().zip(shares.data.chunks_exact(3)).enumerate() {
        found.error += error;
        // Forward differences; 0 at the far borders.
        let step = |of: &[f64]| {
            let along = if (i + 1).is_multiple_of(width) { 0.0 } else { of[i + 1] - of[i] };
            let down = if i + width >= of.len() { 0.0 } else { of[i + width] - of[i] };
            [along, down]
        };
        let (o, c) = (step(&original), step(&compressed));
        for (sums, &share) in found.kinds.iter_mut().zip(shares) {
            let w = f64::from(share);
            sums.weight += w;
            sums.error += w * error;
            sums.kept_detail += w * (c[0] * o[0] + c[1] * o[1]);
            sums.detail += w * (o[0] * o[0] + o[1] * o[1]);
        }
    }
    found
}

/// Returns per pixel the mean over channels of the squared difference of values clamped to [0, 1].
pub fn squared_error(a: &Image, b: &Image) -> Vec<f64> {
    let square = |(a, b): (&f32, &f32)| (clamped(*a) - clamped(*b)).powi(2);
    let pixels = a.data.chunks_exact(3).zip(b.data.chunks_exact(3));
    pixels.map(|(a, b)| a.iter().zip(b).map(square).sum::<f64>() / 3.0).collect()
}

fn brightness(image: &Image) -> Vec<f64> {
    image.data.chunks_exact(3).map(|p| p.iter().map(|&v| clamped(v)).sum::<f64>() / 3.0).collect()
}

/// Judges one kind by the error sums `seen` of all renders, whose (frame, view) are `names`.
pub fn judge(kind: GaussianKind, members: KindMembers, seen: &[Observed], names: &[(usize, u32)]) -> FailureMode {
    let (name, happens_to) = described(kind);
    let at = kind as usize;
    let sum = |value: fn(&FailureSums) -> f64| seen.iter().map(|of| value(&of.kinds[at])).sum::<f64>();
    let (weight, error) = (sum(|s| s.weight), sum(|s| s.error));
    let pixels: f64 = seen.iter().map(|of| of.pixels).sum();
    let all_error: f64 = seen.iter().map(|of| of.error).sum();
    let shown = if pixels > 0.0 { weight / pixels } else { 0.0 };
    let psnr_there = db(error, weight);
    let psnr_elsewhere = db((all_error - error).max(0.0), pixels - weight);
    let detail = sum(|s| s.detail);
    let worst = (0..seen.len())
        .filter(|&place| seen[place].kinds[at].weight >= SHOWN * seen[place].pixels)
        .filter_map(|place| Some((place, db(seen[place].kinds[at].error, seen[place].kinds[at].weight)?)))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(place, psnr)| WorstPlace { place, frame: names[place].0, view: names[place].1, psnr });
    let lost = members.fates.is_some().then_some(members.shares.1);
    let apart = psnr_there
        .zip(psnr_elsewhere)
        .is_some_and(|(there, elsewhere)| there < VISIBLE_DB && there <= elsewhere - APART_DB);
    let verdict = if members.count == 0 {
        Verdict::Absent
    } else if worst.is_none() {
        Verdict::Unseen
    } else if lost.is_some_and(|lost| lost < LOST) {
        Verdict::Untouched
    } else if apart {
        Verdict::Flagged
    } else {
        Verdict::Passed
    };
    FailureMode {
        name,
        happens_to,
        verdict,
        gaussians: members.count,
        dropped: members.fates.map(|fates| fates.0),
        merged: members.fates.map(|fates| fates.1),
        coverage: members.shares.0,
        coverage_lost: lost,
        shown,
        psnr_there,
        psnr_elsewhere,
        detail_lost: (detail > 0.0).then(|| 1.0 - sum(|s| s.kept_detail) / detail),
        worst,
    }
}

/// Returns the name of a kind's failure mode and the description of its Gaussians.
fn described(kind: GaussianKind) -> (&'static str, String) {
    use super::traits::{COLOR_CHANGE, FAST, NEIGHBORS, NON_RIGID, OPACITY_CHANGE, STILL, THIN};
    match kind {
        GaussianKind::Motion => (
            "fast, non-rigid motion",
            format!(
                "Gaussians that move by {}% of the scene extent per frame or more (root mean square), while the \
                 distance to half of their {NEIGHBORS} nearest neighbors changes by {}% or more",
                100.0 * FAST,
                100.0 * NON_RIGID
            ),
        ),
        GaussianKind::Thin => ("thin structures", format!("Gaussians {THIN} times as long as wide or more")),
        GaussianKind::Appearance => (
            "fine changes of appearance",
            format!(
                "Gaussians that stand still (up to {}% of the extent per frame) while their opacity varies by {} or \
                 their color by {} (standard deviation) or more",
                100.0 * STILL,
                OPACITY_CHANGE,
                COLOR_CHANGE
            ),
        ),
    }
}

/// Returns the PSNR of a weighted sum of squared errors, dB; `None` without weight.
fn db(error: f64, weight: f64) -> Option<f64> {
    (weight > 0.0).then(|| (-10.0 * (error / weight).log10()).min(PSNR_CAP_DB))
}

/// Returns the corner of the square of [`CROP`] pixels, or less in a smaller render, with the largest error of a kind,
/// Σ w e². Of equal squares the first by rows wins.
pub fn worst_corner(taken: &RenderedViews, shares: &Image, kind: GaussianKind) -> (u32, u32) {
    let (width, height) = (taken.original.width as usize, taken.original.height as usize);
    let (across, down) = ((CROP as usize).min(width), (CROP as usize).min(height));
    // sums[y][x] is the sum over the rectangle above and left of (x, y).
    let stride = width + 1;
    let mut sums = vec![0.0; stride * (height + 1)];
    let error = squared_error(&taken.original, &taken.compressed);
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

/// Returns the part of a render from `corner`, [`CROP`] pixels each way or up to the border.
pub fn crop(image: &Image, (left, top): (u32, u32)) -> Image {
    let (width, height) = (CROP.min(image.width - left), CROP.min(image.height - top));
    let row = |y: u32| {
        let start = 3 * (y as usize * image.width as usize + left as usize);
        &image.data[start..start + 3 * width as usize]
    };
    Image { width, height, data: (top..top + height).flat_map(row).copied().collect() }
}

/// Returns the PSNR of the part that [`crop`] returns, dB.
pub fn crop_psnr(taken: &RenderedViews, corner: (u32, u32)) -> f64 {
    psnr(&crop(&taken.compressed, corner), &crop(&taken.original, corner))
}

#[cfg(test)]
mod tests;
