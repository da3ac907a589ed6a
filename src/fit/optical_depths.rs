//! Distributes the optical depth of a Gaussian among the overlapping curves that replace it.
//!
//! Optical depths −ln(1 − α), where α is the opacity, add up where Gaussians overlap. Iterations multiply the depth of
//! each curve by a factor, so all depths stay positive (Richardson 1972, Lucy 1974). The factors are raised to the
//! power 1.5, which saves a third of the iterations.

use std::ops::Range;

use super::windows::Windows;
use crate::model::exp_log::{exp, ln};
use crate::model::vectorized;

/// Largest opacity that is fitted, so that the optical depth −ln(1 − opacity) stays finite.
pub(super) const MAX_OPACITY: f64 = 0.999;
/// Width of the time window of an overlapping curve, divided by the distance between the centers of neighboring
/// windows.
pub(super) const WIDTH_PER_INTERVAL: f64 = 0.75;
/// The depth of a curve depends on the frames at which its time window is above this value.
const MIN_WINDOW: f64 = 1e-3;
/// Tolerance of the iterations in [`refine_depths`], which change the optical depth of each curve. The iterations end
/// once each curve meets one of two conditions:
/// - The last iteration changed the curve's optical depth by less than this fraction.
/// - The curve's optical depth before the last iteration was below this value, so the curve is nearly invisible.
///
/// [`estimate_depths`] returns optical depths of at least this value, or 0 for a curve whose window covers no frame.
const CONVERGED: f64 = 2e-3;
/// Maximum factor by which an iteration multiplies a depth, before the factor is raised to the power 1.5.
const MAX_FACTOR: f64 = 4.0;

/// Returns the optical depth −ln(1 − α) of a Gaussian of opacity α = `opacity`, which is first limited to
/// [`MAX_OPACITY`].
pub(super) fn depth(opacity: f64) -> f64 {
    -ln(1.0 - opacity.clamp(0.0, MAX_OPACITY))
}

/// Returns the opacity 1 − exp(−d) of a curve of optical depth d = `depth`.
#[inline(always)]
pub(super) fn opacity_from_depth(depth: f64) -> f64 {
    1.0 - exp(-depth)
}

/// Multiplies the transmittance of all curves at each frame by that of one curve with the opacity `opacity` at the
/// center of its window. `values`: values of its window at these frames.
#[inline(always)]
pub(super) fn add_curve(transmittances: &mut [f64], opacity: f64, values: &[f64]) {
    let of_curve = values.iter().map(|value| 1.0 - (opacity * value).min(MAX_OPACITY));
    transmittances.iter_mut().zip(of_curve).for_each(|(all, one)| *all *= one);
}

/// Returns an estimate of the optical depth of each curve at the center of its window: the mean of `track_depths` under
/// the window, divided by the sum of all windows at one time. `windows`: time windows of the curves. `track_depths`:
/// optical depth of the Gaussian at each frame.
pub(super) fn estimate_depths(windows: &Windows, track_depths: &[f64]) -> Vec<f64> {
    // Evenly spaced windows add up to their integral divided by their distance.
    let overlap = WIDTH_PER_INTERVAL * std::f64::consts::PI.sqrt();
    let estimate = |k: usize| {
        let (frames, values) = windows.window_above(k, MIN_WINDOW);
        let weighted: f64 = values.iter().zip(&track_depths[frames]).map(|(value, depth)| value * depth).sum();
        let sum: f64 = values.iter().sum();
        // Never 0 if the window covers a frame: the iterations only multiply depths.
        if sum > 0.0 { (weighted / sum / overlap).max(CONVERGED) } else { 0.0 }
    };
    (0..windows.len()).map(estimate).collect()
}

/// Changes `depths`, the optical depth of each curve at the center of its window in `windows`. Afterwards, the depths
/// of all curves add up to `track_depths`, the depth of the Gaussian at each frame, as closely as the iterations reach.
/// Ends after `max_updates` iterations at the latest.
pub(super) fn refine_depths(windows: &Windows, track_depths: &[f64], depths: &mut [f64], max_updates: usize) {
    vectorized(
        #[inline(always)]
        || iterate(windows, track_depths, depths, max_updates),
    );
}

/// Runs the iterations of [`refine_depths`].
#[inline(always)]
fn iterate(windows: &Windows, track_depths: &[f64], depths: &mut [f64], max_updates: usize) {
    // Frames that each window affects, with the values of the window there and the sum of these values.
    let supports: Vec<(Range<usize>, &[f64], f64)> = (0..depths.len())
        .map(|k| {
            let (frames, values) = windows.window_above(k, MIN_WINDOW);
            (frames, values, values.iter().sum())
        })
        .collect();
    let max_depth = depth(MAX_OPACITY);
    // For each frame: the product of the transmittances of all curves, then target depth divided by depth.
    let mut ratios = vec![1.0; track_depths.len()];
    let mut opacities = vec![0.0; depths.len()];
    for _ in 0..max_updates {
        // A window multiplies the opacity, not the depth, so each curve adds the depth of its windowed opacity.
        opacities.iter_mut().zip(depths.iter()).for_each(|(opacity, depth)| *opacity = opacity_from_depth(*depth));
        ratios.fill(1.0);
        for ((frames, values, _), opacity) in supports.iter().zip(&opacities) {
            add_curve(&mut ratios[frames.clone()], *opacity, values);
        }
        ratios.iter_mut().zip(track_depths).for_each(|(ratio, target)| *ratio = target / (-ln(*ratio)).max(1e-9));
        let mut moved = 0.0f64;
        for ((frames, values, sum), depth) in supports.iter().zip(depths.iter_mut()) {
            let weighted = dot_product(values, &ratios[frames.clone()]);
            let ratio = if *sum > 0.0 { (weighted / sum).min(MAX_FACTOR) } else { 0.0 };
            let factor = ratio * ratio.sqrt();
            moved = moved.max((factor - 1.0).abs().min(*depth));
            *depth = (*depth * factor).min(max_depth);
        }
        if moved < CONVERGED {
            break;
        }
    }
}

/// Returns the sum of `a[i]` · `b[i]`. Four partial sums let the compiler vectorize the loop.
#[inline(always)]
fn dot_product(a: &[f64], b: &[f64]) -> f64 {
    let (a, b) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    let mut sums = [0.0; 4];
    for (a, b) in a.zip(b) {
        sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a * b);
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns `count` + 1 evenly spaced windows over the times 0 to 1 of 60 frames.
    fn even_windows(count: usize) -> Windows {
        let times: Vec<f64> = (0..60).map(|frame| f64::from(frame) / 59.0).collect();
        let mut windows = Windows::default();
        let width = WIDTH_PER_INTERVAL / count as f64;
        (0..=count).for_each(|k| windows.push(&times, k as f64 / count as f64, width));
        windows
    }

    #[test]
    fn depths_of_curves_add_up_to_the_depth_of_a_faint_gaussian() {
        let windows = even_windows(8);
        let target: Vec<f64> = (0..60).map(|frame| 0.1 + 0.05 * (f64::from(frame) / 9.0).sin()).collect();
        let mut depths = estimate_depths(&windows, &target);
        refine_depths(&windows, &target, &mut depths, 60);
        for (frame, target) in target.iter().enumerate() {
            // Independent sum: the depth of each curve's windowed opacity.
            let sum: f64 = (0..9).map(|k| -(1.0 - (1.0 - (-depths[k]).exp()) * windows.value(k, frame)).ln()).sum();
            assert!((sum - target).abs() < 0.01, "frame {frame}: {sum}, expected {target}");
        }
    }

    #[test]
    fn vector_instructions_give_the_bits_of_the_baseline() {
        for count in [1, 3, 16] {
            let windows = even_windows(count);
            let target: Vec<f64> = (0..60).map(|frame| depth(f64::from(frame) / 59.0)).collect();
            let mut baseline = estimate_depths(&windows, &target);
            let mut wide = baseline.clone();
            iterate(&windows, &target, &mut baseline, 20);
            refine_depths(&windows, &target, &mut wide, 20);
            assert_eq!(baseline, wide);
        }
    }
}
