//! Fit of curves to the track of a Gaussian (its states at all frames). A curve is a Gaussian that moves along a
//! polynomial of time and is visible in a soft window of time. Curves have one of two forms ([`CurveForm`]):
//! - cubic motion and linear rotation, which players of SpacetimeGaussians support, or
//! - linear motion and constant rotation.
//!
//! A window is exp(−((t − center)/width)²). The number of curves depends on the Gaussian:
//! - Constant opacity, and motion of the given form: one curve of infinite width.
//! - Opacity that rises and fades once: one curve.
//! - Any other Gaussian: overlapping curves, 3, 5, 9 … of them with cubic motion, or 2, 3, 4, 5, 7, 9 … with linear
//!   motion, which needs more curves.
//!
//! The centers of overlapping windows are evenly spaced over the visible time, and each width is three quarters of the
//! spacing. The sum of such windows is 1 with an error of at most 2·exp(−(3π/4)²) = 0.8%.
//!
//! Optical depths −ln(1 − α), where α is the opacity, add up where Gaussians overlap. So the optical depth of the
//! Gaussian is distributed among the curves, by multiplicative updates that keep all depths positive (Richardson 1972,
//! Lucy 1974).

use super::least_squares::polynomial;
use super::{FitError, FittedTrack, MIN_VISIBLE_OPACITY, Tolerance};

/// Gaussian with cubic motion and linear rotation, visible in a window of time.
#[derive(Debug, Clone, PartialEq)]
pub struct CubicTrack {
    /// Center of the time window, and time at which dt = 0 in the polynomials of position and rotation.
    pub center: f64,
    /// Width of the time window, in units of time; infinite for constant opacity.
    pub width: f64,
    /// Coefficients of the position, in scene units: `position[k]` is the coefficient of dtᵏ, where dt is the time
    /// since `center`.
    pub position: [[f64; 3]; 4],
    /// Coefficients of the rotation quaternion (w, x, y, z): `rotation[k]` is the coefficient of dtᵏ, where dt is the
    /// time since `center`.
    pub rotation: [[f64; 4]; 2],
    /// Natural logarithms of the three scales (scene units).
    pub log_scale: [f64; 3],
    /// Opacity at the center of the time window, in [0, 1].
    pub opacity: f64,
    /// SH coefficients, constant in time.
    pub sh: Vec<f32>,
}

impl CubicTrack {
    /// Returns the position of the curve at `time`, in scene units.
    pub fn position_at(&self, time: f64) -> [f64; 3] {
        let dt = time - self.center;
        std::array::from_fn(|c| self.position.iter().rev().fold(0.0, |sum, row| sum * dt + row[c]))
    }

    /// Returns the opacity of the curve at `time`.
    pub fn opacity_at(&self, time: f64) -> f64 {
        self.opacity * window(time, self.center, self.width)
    }
}

/// Form of the curves that are fitted to a track (states of a Gaussian at all frames): degree of the motion, minimum
/// width of the time windows, and maximum number of curves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CurveForm {
    /// Whether positions are linear and rotations are constant in time. If not, positions are cubic and rotations are
    /// linear.
    has_linear_motion: bool,
    /// Minimum width of the time window, in units of time.
    min_width: f64,
    /// Maximum number of intervals between the centers of overlapping curves: the number of curves minus 1.
    max_intervals: usize,
}

impl CurveForm {
    /// Form of curves with cubic motion, linear rotation, and time windows of any width.
    pub const CUBIC: CurveForm = CurveForm { has_linear_motion: false, min_width: 0.0, max_intervals: 32 };

    /// Returns the form with linear motion, constant rotation, and time windows of at least `min_width` units of time.
    /// A [`CubicTrack`] of this form has quadratic and cubic coefficients of 0.
    pub fn linear(min_width: f64) -> CurveForm {
        CurveForm { has_linear_motion: true, min_width, max_intervals: 32 }
    }

    /// Returns this form with at most `max_intervals` intervals between the centers of overlapping curves, that is,
    /// with at most `max_intervals` + 1 curves.
    pub fn with_intervals(self, max_intervals: usize) -> CurveForm {
        CurveForm { max_intervals, ..self }
    }

    /// Returns the numbers n to try, in this order, for fits by n + 1 overlapping curves. The centers of their time
    /// windows divide the visible time of the Gaussian into n intervals.
    fn intervals(self) -> &'static [usize] {
        if self.has_linear_motion { &[1, 2, 3, 4, 6, 8, 12, 16, 24, 32] } else { &[2, 4, 8, 16, 32] }
    }
}

/// Width of an overlapping window, divided by the distance between the centers of neighboring windows.
const WIDTH_PER_INTERVAL: f64 = 0.75;
/// Maximum number of iterations in [`overlapping_curves`], which distribute the optical depth −ln(1 − opacity) of a
/// Gaussian among the curves that replace it.
const MAX_UPDATES: usize = 60;
/// Tolerance of the iterations in [`overlapping_curves`], which distribute the optical depth −ln(1 − opacity) of a
/// Gaussian among the curves that replace it. The iterations end once each curve meets one of two conditions:
/// - The last iteration changed the curve's optical depth by less than this fraction.
/// - The curve's optical depth before the last iteration was below this value, so the curve is nearly invisible.
const CONVERGED: f64 = 1e-3;
/// Largest opacity that is fitted, so that the optical depth −ln(1 − opacity) stays finite.
const MAX_OPACITY: f64 = 0.999;
/// Weight of the term that keeps polynomial coefficients small if the frames do not determine them (ridge regression).
const RIDGE: f64 = 1e-6;
/// Distance in time from the center of a window, in widths of the window, from which on the window counts as 0. Its true
/// value there is exp(−36).
const MAX_WIDTHS: f64 = 6.0;
/// Limit that decides which frames the fit of a curve uses:
/// - The fit of the opacities of overlapping curves uses frames at which the time window is above this value.
/// - The fit of the motion uses frames whose weight (window × opacity) is above this value times
///   [`MIN_VISIBLE_OPACITY`].
const MIN_WEIGHT: f64 = 1e-3;

/// Returns curves of the form `form` that represent `track`, the states of a Gaussian at all frames. Tries increasing
/// numbers of curves, and returns the first curves that meet `tolerance` at every visible frame. If none do, returns
/// the curves with the smallest error. Adds the errors of the returned curves to `misfit`.
pub fn fit_curves(
    track: &FittedTrack,
    form: CurveForm,
    tolerance: &Tolerance,
    misfit: &mut FitError,
) -> Vec<CubicTrack> {
    let Some(first) = (0..track.len()).find(|&frame| track.is_visible(frame)) else { return Vec::new() };
    let last = (first..track.len()).rev().find(|&frame| track.is_visible(frame)).unwrap_or(first);
    let mut best: Option<(f64, Vec<CubicTrack>, FitError)> = None;
    let mut attempt = |curves: Vec<CubicTrack>| {
        let (excess, found) = measure_misfit(track, &curves, tolerance);
        if best.as_ref().is_none_or(|(least, _, _)| excess < *least) {
            best = Some((excess, curves, found));
        }
        excess <= 1.0
    };
    let mut done = attempt(vec![constant_curve(track, form)]);
    let fading = if form.has_linear_motion { fading_curve(track, form) } else { None };
    done = done || fading.is_some_and(|curve| attempt(vec![curve]));
    done = done || attempt(vec![single_window_curve(track, form)]);
    let visible = [track.times[first], track.times[last]];
    let is_wide = |count: usize| WIDTH_PER_INTERVAL * (visible[1] - visible[0]) / count as f64 >= form.min_width;
    for &count in form
        .intervals()
        .iter()
        .take_while(|&&count| count <= form.max_intervals.min((last - first + 1).max(2)) && is_wide(count))
    {
        done = done || attempt(overlapping_curves(track, form, visible, count));
    }
    let (_, curves, found) = best.unwrap_or_default();
    *misfit = misfit.merged_with(found);
    curves.into_iter().filter(|curve| curve.opacity >= MIN_VISIBLE_OPACITY).collect()
}

fn window(time: f64, center: f64, width: f64) -> f64 {
    let widths = (time - center) / width;
    if widths.abs() < MAX_WIDTHS { (-widths * widths).exp() } else { 0.0 }
}

fn depth(opacity: f64) -> f64 {
    -(-opacity.clamp(0.0, MAX_OPACITY)).ln_1p()
}

/// Returns one curve of the form `form` for `track` (states of a Gaussian at all frames), with an infinitely wide
/// window. Its opacity is constant: the mean over the visible frames.
fn constant_curve(track: &FittedTrack, form: CurveForm) -> CubicTrack {
    let center = track.times[0].midpoint(track.times[track.len() - 1]);
    let seen = (0..track.len()).filter(|&frame| track.is_visible(frame));
    let (sum, count) = seen.fold((0.0, 0.0), |(sum, count), frame| (sum + track.opacity[frame], count + 1.0));
    let curve = fit_motion(track, form, center, f64::INFINITY, |_| 1.0);
    CubicTrack { opacity: sum / f64::max(count, 1.0), ..curve }
}

/// Returns one curve of the form `form` for `track` (states of a Gaussian at all frames). The logarithm of its opacity
/// is a parabola in time, fitted to the visible frames with the squared opacity as weight. The fit is exact if the
/// opacity of `track` is a time window, even if only a part of the window lies within the sequence.
///
/// Returns `None` in these cases:
/// - Fewer than three frames are visible.
/// - The parabola does not open downward.
/// - The opacity at the vertex of the parabola exceeds [`MAX_OPACITY`].
/// - The vertex lies further outside the sequence than the sequence is long.
fn fading_curve(track: &FittedTrack, form: CurveForm) -> Option<CubicTrack> {
    let (first, last) = (track.times[0], track.times[track.len() - 1]);
    let (middle, half) = (first.midpoint(last), ((last - first) / 2.0).max(f64::MIN_POSITIVE));
    let seen: Vec<usize> = (0..track.len()).filter(|&frame| track.is_visible(frame)).collect();
    if seen.len() < 3 {
        return None;
    }
    let samples = seen.iter().map(|&frame| {
        let opacity = track.opacity[frame];
        ((track.times[frame] - middle) / half, [opacity.ln()], opacity * opacity)
    });
    let [[a], [b], [c]] = polynomial(samples, 0.0);
    let (vertex, peak) = (-b / (2.0 * c), (a - b * b / (4.0 * c)).exp());
    let (center, width) = (middle + half * vertex, half * (-1.0 / c).sqrt());
    let is_usable = c < 0.0 && vertex.abs() <= 3.0 && peak <= MAX_OPACITY && width.is_finite();
    if !is_usable {
        return None;
    }
    let width = width.max(form.min_width);
    let curve = fit_motion(track, form, center, width, |frame| window(track.times[frame], center, width));
    Some(CubicTrack { opacity: peak, ..curve })
}

/// Returns one curve of the form `form` for `track` (states of a Gaussian at all frames). Its time window has the same
/// mean and the same variance over time as the opacity of the track.
fn single_window_curve(track: &FittedTrack, form: CurveForm) -> CubicTrack {
    let moment = |value: &dyn Fn(f64) -> f64| -> f64 {
        (0..track.len()).map(|frame| track.opacity[frame] * value(track.times[frame])).sum()
    };
    let whole = moment(&|_| 1.0);
    let center = moment(&|t| t) / whole;
    let variance = moment(&|t| (t - center).powi(2)) / whole;
    let step = (track.times[track.len() - 1] - track.times[0]) / track.len().max(2) as f64;
    // exp(−(dt/w)²) has the variance w²/2. Frames one step apart cannot resolve a width below half a step.
    let width = (2.0 * variance).sqrt().max(0.5 * step).max(1e-9).max(form.min_width);
    let windows = |frame: usize| window(track.times[frame], center, width);
    let (mut right, mut normal) = (0.0, 0.0);
    for frame in 0..track.len() {
        right += windows(frame) * track.opacity[frame];
        normal += windows(frame).powi(2);
    }
    let curve = fit_motion(track, form, center, width, |frame| window(track.times[frame], center, width));
    CubicTrack { opacity: (right / normal.max(1e-300)).min(MAX_OPACITY), ..curve }
}

/// Returns `count` + 1 overlapping curves of the form `form` for `track` (states of a Gaussian at all frames). The
/// centers of their time windows are evenly spaced from the time `start` to the time `end`, between which the Gaussian
/// is visible.
fn overlapping_curves(track: &FittedTrack, form: CurveForm, [start, end]: [f64; 2], count: usize) -> Vec<CubicTrack> {
    let apart = ((end - start) / count as f64).max(1e-9);
    let width = WIDTH_PER_INTERVAL * apart;
    let centers: Vec<f64> = (0..=count).map(|k| start + k as f64 * apart).collect();
    let target_depths: Vec<f64> = track.opacity.iter().map(|&opacity| depth(opacity)).collect();
    // For each curve, the frames that affect it, each with the value of the curve's window.
    let shares: Vec<Vec<(usize, f64)>> = centers
        .iter()
        .map(|&center| {
            let share = |frame: usize| (frame, window(track.times[frame], center, width));
            (0..track.len()).map(share).filter(|(_, share)| *share > MIN_WEIGHT).collect()
        })
        .collect();
    let sums: Vec<f64> = shares.iter().map(|shares| shares.iter().map(|(_, share)| share).sum()).collect();
    let most = target_depths.iter().copied().fold(0.0, f64::max);
    let mut depths = vec![most / 2.0; centers.len()];
    // For each frame: the product of the transmittances of all curves, then target depth divided by depth.
    let mut ratios = vec![1.0; track.len()];
    for _ in 0..MAX_UPDATES {
        // A window multiplies the opacity, not the depth, so each curve adds the depth of its windowed opacity.
        ratios.fill(1.0);
        for (shares, d) in shares.iter().zip(&depths) {
            let opacity = 1.0 - (-d).exp();
            shares.iter().for_each(|&(frame, share)| ratios[frame] *= 1.0 - (opacity * share).min(MAX_OPACITY));
        }
        for (ratio, target) in ratios.iter_mut().zip(&target_depths) {
            *ratio = target / (-ratio.ln()).max(1e-9);
        }
        let mut moved = 0.0f64;
        for ((shares, sum), depth) in shares.iter().zip(&sums).zip(&mut depths) {
            let weighted: f64 = shares.iter().map(|&(frame, share)| share * ratios[frame]).sum();
            let by = if *sum > 0.0 { (weighted / sum).min(4.0) } else { 0.0 };
            moved = moved.max((by - 1.0).abs().min(*depth));
            *depth = (*depth * by).min(self::depth(MAX_OPACITY));
        }
        if moved < CONVERGED {
            break;
        }
    }
    let curve = |(k, depth): (usize, f64)| {
        let curve = fit_motion(track, form, centers[k], width, |frame| window(track.times[frame], centers[k], width));
        CubicTrack { opacity: 1.0 - (-depth).exp(), ..curve }
    };
    depths.into_iter().enumerate().map(curve).collect()
}

/// Returns a curve of the form `form` that follows the position and rotation of `track` (states of a Gaussian at all
/// frames) by least squares. Its time window has the center `center` and the width `width`. The weight of a frame is
/// its opacity times `weight(frame)`. Scales and SH coefficients are weighted means. The opacity of the curve is left
/// at 0, for the caller to set.
fn fit_motion(
    track: &FittedTrack,
    form: CurveForm,
    center: f64,
    width: f64,
    weight: impl Fn(usize) -> f64,
) -> CubicTrack {
    let weight = |frame: usize| if track.is_visible(frame) { weight(frame) * track.opacity[frame] } else { 0.0 };
    let samples: Vec<(usize, f64)> = (0..track.len())
        .map(|frame| (frame, weight(frame)))
        .filter(|(_, weight)| *weight > MIN_WEIGHT * MIN_VISIBLE_OPACITY)
        .collect();
    let reach = samples.iter().map(|&(frame, _)| (track.times[frame] - center).abs()).fold(1e-9, f64::max);
    let scaled = |frame: usize| (track.times[frame] - center) / reach;
    let positions = samples.iter().map(|&(frame, weight)| (scaled(frame), track.position[frame], weight));
    let rotations = samples.iter().map(|&(frame, weight)| (scaled(frame), track.rotation[frame], weight));
    let (position, rotation): ([[f64; 3]; 4], [[f64; 4]; 2]) = if form.has_linear_motion {
        let [at, velocity] = polynomial(positions, RIDGE);
        let [mean] = polynomial(rotations, RIDGE);
        ([at, velocity, [0.0; 3], [0.0; 3]], [mean, [0.0; 4]])
    } else {
        (polynomial(positions, RIDGE), polynomial(rotations, RIDGE))
    };
    let whole: f64 = samples.iter().map(|&(_, weight)| weight).sum();
    let mean = |value: &dyn Fn(usize) -> f64| {
        samples.iter().map(|&(frame, weight)| weight * value(frame)).sum::<f64>() / whole.max(1e-300)
    };
    let unscaled = |k: usize| reach.powi(k as i32);
    CubicTrack {
        center,
        width,
        position: std::array::from_fn(|k| position[k].map(|value| value / unscaled(k))),
        rotation: std::array::from_fn(|k| rotation[k].map(|value| value / unscaled(k))),
        log_scale: std::array::from_fn(|c| mean(&|frame| track.log_scale[frame][c])),
        opacity: 0.0,
        sh: track.mean_sh(mean),
    }
}

/// Compares `curves` with `track`, the states of a Gaussian, at all frames in which the Gaussian or a curve is visible.
/// Returns two results:
/// - The largest ratio of an error to its tolerance in `tolerance`. It is at most 1 if the curves meet the tolerance.
///   Errors that are NaN are ignored. The errors of a curve are multiplied by the fraction of the Gaussian's optical
///   depth that the curve has at the frame. So a curve that is hardly visible at a frame need not be close to the
///   Gaussian there.
/// - The errors over all these frames, in their own units.
fn measure_misfit(track: &FittedTrack, curves: &[CubicTrack], tolerance: &Tolerance) -> (f64, FitError) {
    let (mut worst, mut misfit) = (0.0f64, FitError::default());
    for frame in 0..track.len() {
        let time = track.times[frame];
        let (mut shown, mut away) = (0.0, 0.0);
        let weight = tolerance.weight(track.opacity[frame]);
        let own_depth = depth(track.opacity[frame]).max(MIN_VISIBLE_OPACITY);
        let middle_scale = track.middle_scale(frame);
        for curve in curves {
            let opacity = curve.opacity_at(time);
            if opacity == 0.0 {
                continue;
            }
            let share = depth(opacity);
            shown += share;
            if opacity < MIN_VISIBLE_OPACITY {
                continue;
            }
            let dt = time - curve.center;
            let rotation = std::array::from_fn(|c| curve.rotation[0][c] + dt * curve.rotation[1][c]);
            let scale = (0..3).map(|c| (curve.log_scale[c] - track.log_scale[frame][c]).abs()).fold(0.0, f64::max);
            let sh = curve.sh.iter().zip(track.sh(frame)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            let distance = track.distance(frame, curve.position_at(time)) / middle_scale;
            away += share * distance;
            worst = [
                distance / tolerance.position,
                track.rotation_error(frame, rotation) / tolerance.rotation,
                scale / tolerance.log_scale,
                f64::from(sh) / tolerance.sh,
            ]
            .into_iter()
            // A curve that is hardly visible in this frame need not be as close.
            .map(|excess| excess * weight * (share / own_depth).min(1.0))
            .fold(worst, f64::max);
        }
        let apart = 1.0 - (-shown).exp() - track.opacity[frame];
        if track.is_visible(frame) || apart > MIN_VISIBLE_OPACITY {
            worst = worst.max(apart.abs() / tolerance.opacity);
            misfit.add(if shown > 0.0 { away / shown } else { 0.0 }, apart, track.opacity[frame]);
        }
    }
    (if worst.is_nan() { f64::INFINITY } else { worst }, misfit)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(frames: usize, position: impl Fn(f64) -> [f64; 3], opacity: impl Fn(f64) -> f64) -> FittedTrack {
        let times: Vec<f64> = (0..frames).map(|i| i as f64 / frames as f64).collect();
        FittedTrack {
            position: times.iter().map(|&t| position(t)).collect(),
            rotation: times.iter().map(|t| [(0.3 * t).cos(), (0.3 * t).sin(), 0.0, 0.0]).collect(),
            log_scale: vec![[-3.0, -2.0, -3.0]; frames],
            opacity: times.iter().map(|&t| opacity(t)).collect(),
            sh: vec![vec![0.5, -0.5, 0.0]],
            times,
        }
    }

    #[test]
    fn cubic_and_fading_tracks_are_recovered_exactly() {
        let cubic = |t: f64| [t - 2.0 * t * t + t.powi(3), 0.3, -t];
        let mut misfit = FitError::default();
        let one = fit_curves(&track(60, cubic, |_| 0.8), CurveForm::CUBIC, &Tolerance::default(), &mut misfit);
        assert!(one.len() == 1 && one[0].width.is_infinite() && (one[0].opacity - 0.8).abs() < 1e-9);
        assert!(misfit.position < 1e-3 && misfit.states == 60, "{misfit:?}");
        let fading = track(60, cubic, |t| 0.9 * window(t, 0.4, 0.15));
        let one = fit_curves(&fading, CurveForm::CUBIC, &Tolerance::default(), &mut misfit);
        assert_eq!(one.len(), 1);
        assert!((one[0].center - 0.4).abs() < 1e-3 && (one[0].width - 0.15).abs() < 2e-3, "{:?}", one[0]);
        assert!((one[0].opacity - 0.9).abs() < 0.01 && misfit.opacity < 0.01);
    }

    #[test]
    fn complex_tracks_are_shared_by_curves_whose_opacity_adds_up() {
        let wave = |t: f64| [(18.0 * t).sin(), 0.0, 0.0];
        let mut misfit = FitError::default();
        let many = fit_curves(&track(120, wave, |_| 0.6), CurveForm::CUBIC, &Tolerance::default(), &mut misfit);
        assert!((4..=33).contains(&many.len()), "{} curves", many.len());
        assert!(misfit.opacity < 0.05 && misfit.rms() < 0.1, "{misfit:?}");
        let mut misfit = FitError::default();
        let half_seen = track(120, |_| [0.0; 3], |t| if t < 0.5 { 0.7 } else { 0.0 });
        let step = fit_curves(&half_seen, CurveForm::CUBIC, &Tolerance::default(), &mut misfit);
        assert!(step.len() > 2 && misfit.opacity < 0.4, "{} curves, {misfit:?}", step.len());
    }

    #[test]
    fn invisible_track_has_no_curve_and_single_frame_has_one() {
        for form in [CurveForm::CUBIC, CurveForm::linear(0.02)] {
            let fit = |track: FittedTrack| fit_curves(&track, form, &Tolerance::default(), &mut FitError::default());
            assert!(fit(track(20, |_| [0.0; 3], |_| 1e-3)).is_empty());
            let still = fit(track(1, |_| [1.0; 3], |_| 0.5));
            assert!(still.len() == 1 && still[0].position_at(0.0).iter().all(|x| (x - 1.0).abs() < 1e-9), "{still:?}");
            assert!(!fit(track(30, |_| [0.0; 3], |t| if (t - 0.5).abs() < 1e-9 { 0.5 } else { 0.0 })).is_empty());
        }
    }

    #[test]
    fn a_window_cut_by_the_end_of_the_sequence_is_one_line() {
        let mut misfit = FitError::default();
        let cut = track(40, |t| [2.0 * t, 1.0 - t, 0.0], |t| 0.8 * window(t, -0.1, 0.6));
        let cut = FittedTrack { rotation: vec![[1.0, 0.0, 0.0, 0.0]; 40], ..cut };
        let one = fit_curves(&cut, CurveForm::linear(0.0), &Tolerance::default(), &mut misfit);
        assert_eq!(one.len(), 1);
        assert!((one[0].center + 0.1).abs() < 1e-6 && (one[0].width - 0.6).abs() < 1e-6, "{:?}", one[0]);
        assert!((one[0].opacity - 0.8).abs() < 1e-6 && (one[0].position[1][0] - 2.0).abs() < 1e-2, "{:?}", one[0]);
        assert!(misfit.opacity < 1e-6 && misfit.position < 0.05, "{misfit:?}");
    }

    #[test]
    fn lines_have_no_higher_terms_and_no_narrow_window() {
        let mut misfit = FitError::default();
        let turning = track(60, |t| [(3.0 * t).sin(), (3.0 * t).cos(), 0.0], |t| 0.6 + 0.2 * (9.0 * t).sin());
        let lines = fit_curves(&turning, CurveForm::linear(0.1), &Tolerance::default(), &mut misfit);
        assert!((2..=9).contains(&lines.len()), "{} lines", lines.len());
        for line in &lines {
            assert_eq!((&line.position[2..], line.rotation[1]), (&[[0.0; 3]; 2][..], [0.0; 4]));
            assert!(line.width >= 0.1, "{}", line.width);
        }
        assert!(misfit.rms() < 1.0 && misfit.opacity < 0.1, "{misfit:?}");
    }
}
