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
//! The optical depth of the Gaussian is distributed among overlapping curves ([`super::optical_depths`]).

use super::least_squares::polynomial;
use super::optical_depths::{
    MAX_OPACITY, WIDTH_PER_INTERVAL, add_curve, depth, estimate_depths, opacity_from_depth, refine_depths,
};
use super::windows::Windows;
use super::{FitError, FittedTrack, MIN_VISIBLE_OPACITY, Tolerance};
use crate::model::exp_log::ln;

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
}

/// Form of the curves that are fitted to a track (states of a Gaussian at all frames): degree of the motion, minimum
/// width of the time windows, and maximum number of overlapping curves.
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
    pub fn linear_with_min_width(min_width: f64) -> CurveForm {
        CurveForm { has_linear_motion: true, min_width, max_intervals: 32 }
    }

    /// Returns this form with at most `max_intervals` intervals between the centers of overlapping curves, that is,
    /// with at most `max_intervals` + 1 curves.
    pub fn with_intervals(self, max_intervals: usize) -> CurveForm {
        CurveForm { max_intervals, ..self }
    }

    /// Returns the numbers n to try, in this order. For each n, a fit uses n + 1 overlapping curves; the centers of
    /// their time windows divide the visible time of the Gaussian into n intervals.
    fn intervals(self) -> &'static [usize] {
        if self.has_linear_motion { &[1, 2, 3, 4, 6, 8, 12, 16, 24, 32] } else { &[2, 4, 8, 16, 32] }
    }
}

/// Weight of the term that keeps polynomial coefficients small if the frames do not determine them (ridge regression).
const RIDGE: f64 = 1e-6;
/// The fit of the motion of a curve uses the frames whose weight (window × opacity) is above this value times
/// [`MIN_VISIBLE_OPACITY`].
const MIN_WEIGHT: f64 = 1e-3;
/// Maximum number of iterations that distribute the optical depth of a Gaussian among the curves that replace it
/// ([`refine_depths`]), in addition to the [`FIRST_UPDATES`].
const MAX_UPDATES: usize = 60;
/// Number of iterations in [`refine_depths`] after which the error of overlapping curves is compared with
/// [`MAX_FIRST_ERROR`].
const FIRST_UPDATES: usize = 4;
/// Largest error that overlapping curves may have after [`FIRST_UPDATES`] iterations, as a multiple of the error with
/// which they would be kept ([`TrackFit::max_excess`]). Curves with a larger error are skipped, because more iterations
/// rarely reduce the error by this factor.
const MAX_FIRST_ERROR: f64 = 2.0;

/// Returns curves of the form `form` that represent `track`, the states of a Gaussian at all frames. Tries increasing
/// numbers of curves, and returns the first curves that meet `tolerance` at every visible frame. Numbers of curves
/// whose error is far too large after a few iterations are skipped ([`MAX_FIRST_ERROR`]). If no curves meet the
/// tolerance, tries all numbers again, from the largest to one curve, and returns the curves with the smallest error
/// found. Adds the errors of the returned curves to `misfit`.
pub fn fit_curves(
    track: &FittedTrack,
    form: CurveForm,
    tolerance: &Tolerance,
    misfit: &mut FitError,
) -> Vec<CubicTrack> {
    let Some(first) = (0..track.len()).find(|&frame| track.is_visible(frame)) else { return Vec::new() };
    let last = (first..track.len()).rev().find(|&frame| track.is_visible(frame)).unwrap_or(first);
    let mut fit = TrackFit::new(track, form, tolerance);
    let span = [track.times[first], track.times[last]];
    let is_wide = |count: usize| WIDTH_PER_INTERVAL * (span[1] - span[0]) / count as f64 >= form.min_width;
    let max_intervals = form.max_intervals.min((last - first + 1).max(2));
    let tried = form.intervals().iter().take_while(|&&count| count <= max_intervals && is_wide(count)).count();
    let counts = &form.intervals()[..tried];
    // The first pass stops each attempt as soon as its error is above the tolerance.
    let has_fit = fit.try_constant_curve()
        || (form.has_linear_motion && fit.try_fading_curve())
        || fit.try_single_window()
        || counts.iter().any(|&count| fit.try_overlapping_curves(span, count));
    if !has_fit {
        // The second pass finds the curves with the smallest error. It begins with the largest number of curves, whose
        // error is usually the smallest. It stops every later attempt whose error exceeds the smallest so far.
        fit.seeks_best = true;
        counts.iter().rev().for_each(|&count| _ = fit.try_overlapping_curves(span, count));
        fit.try_single_window();
        if form.has_linear_motion {
            fit.try_fading_curve();
        }
        fit.try_constant_curve();
    }
    let (_, curves, found) = fit.best.unwrap_or_default();
    *misfit = misfit.merged_with(found);
    curves.into_iter().filter(|curve| curve.opacity >= MIN_VISIBLE_OPACITY).collect()
}

/// Search for curves that represent one track. Each attempt of the search fits a certain number of curves and measures
/// their error. Holds the values that all attempts use, and the best curves so far.
struct TrackFit<'a> {
    track: &'a FittedTrack,
    form: CurveForm,
    tolerance: &'a Tolerance,
    /// For each frame, whether the Gaussian is visible ([`FittedTrack::is_visible`]).
    visible: Vec<bool>,
    /// For each frame, the optical depth −ln(1 − opacity) of the Gaussian.
    depths: Vec<f64>,
    /// For each frame, the middle scale of the Gaussian ([`FittedTrack::middle_scale`]).
    middle_scales: Vec<f64>,
    /// Frames that the fit of a motion uses: frame, time since the center of the window, and weight. Kept to reuse the
    /// memory.
    samples: Vec<(usize, f64, f64)>,
    /// Time windows of the curves of the current attempt, in their order.
    windows: Windows,
    /// For each frame, the fraction of light that all curves together let through, for the curves that were compared
    /// last.
    transmittances: Vec<f64>,
    /// Whether the curves with the smallest error are kept even if they do not meet the tolerance: false in the first
    /// pass over all attempts, true in the second one.
    seeks_best: bool,
    /// The curves that are kept so far: largest ratio of an error to its tolerance, curves, and errors.
    best: Option<(f64, Vec<CubicTrack>, FitError)>,
}

impl<'a> TrackFit<'a> {
    /// Returns a fit of curves of the form `form` to `track`, with no curves yet.
    fn new(track: &'a FittedTrack, form: CurveForm, tolerance: &'a Tolerance) -> TrackFit<'a> {
        TrackFit {
            track,
            form,
            tolerance,
            visible: (0..track.len()).map(|frame| track.is_visible(frame)).collect(),
            depths: track.opacity.iter().map(|&opacity| depth(opacity)).collect(),
            middle_scales: (0..track.len()).map(|frame| track.middle_scale(frame)).collect(),
            samples: Vec::new(),
            windows: Windows::default(),
            transmittances: Vec::new(),
            seeks_best: false,
            best: None,
        }
    }

    /// Measures the error of `curves`, whose time windows are in `self.windows`. Keeps the curves if they meet the
    /// tolerance, or if `seeks_best` is set and no earlier curves have a smaller error. Returns whether they meet the
    /// tolerance.
    fn keep_if_good(&mut self, curves: Vec<CubicTrack>) -> bool {
        let opacities: Vec<f64> = curves.iter().map(|curve| curve.opacity).collect();
        let opacity_excess = self.compare_opacities(&opacities);
        let misfit = self.measure_misfit(&curves, opacity_excess, self.max_excess());
        let Some((excess, found)) = misfit else { return false };
        self.best = Some((excess, curves, found));
        excess <= 1.0
    }

    /// Returns the largest ratio of an error to its tolerance with which curves are kept. In the first pass over all
    /// attempts it is 1; in the second pass it is the ratio of the best curves so far. Of curves with equal ratios the
    /// later attempt is kept, because it never has more curves.
    fn max_excess(&self) -> f64 {
        match &self.best {
            _ if !self.seeks_best => 1.0,
            Some((least, ..)) => *least,
            None => f64::INFINITY,
        }
    }

    /// Makes one window with the center `center` and the width `width` the only one in `self.windows`, and returns the
    /// curve that [`TrackFit::fit_motion`] fits in it.
    fn fit_one(&mut self, center: f64, width: f64) -> CubicTrack {
        self.windows.clear();
        self.windows.push(&self.track.times, center, width);
        self.fit_motion(0)
    }

    /// Tries one curve with an infinitely wide window. Its opacity is constant: the mean over the visible frames.
    /// Returns whether the curve meets the tolerance.
    fn try_constant_curve(&mut self) -> bool {
        let times = &self.track.times;
        let center = times[0].midpoint(times[times.len() - 1]);
        let seen = (0..times.len()).filter(|&frame| self.visible[frame]);
        let (sum, count) = seen.fold((0.0, 0.0), |(sum, count), frame| (sum + self.track.opacity[frame], count + 1.0));
        let curve = self.fit_one(center, f64::INFINITY);
        self.keep_if_good(vec![CubicTrack { opacity: sum / f64::max(count, 1.0), ..curve }])
    }

    /// Tries one curve. The logarithm of its opacity is a parabola in time, fitted to the visible frames with the
    /// squared opacity as weight. The fit is exact if the opacity of the track is a time window, even if only a part of
    /// the window lies within the sequence.
    ///
    /// Returns whether the curve meets the tolerance. Returns `false` without trying a curve in these cases:
    /// - Fewer than three frames are visible.
    /// - The parabola does not open downward.
    /// - The opacity at the vertex of the parabola exceeds [`MAX_OPACITY`].
    /// - The vertex lies further outside the sequence than the sequence is long.
    fn try_fading_curve(&mut self) -> bool {
        let track = self.track;
        let (first, last) = (track.times[0], track.times[track.len() - 1]);
        let (middle, half) = (first.midpoint(last), ((last - first) / 2.0).max(f64::MIN_POSITIVE));
        let seen = || (0..track.len()).filter(|&frame| self.visible[frame]);
        if seen().nth(2).is_none() {
            return false;
        }
        let samples = seen().map(|frame| {
            let opacity = track.opacity[frame];
            ((track.times[frame] - middle) / half, [ln(opacity)], opacity * opacity)
        });
        let [[a], [b], [c]] = polynomial(samples, 0.0);
        let (vertex, peak) = (-b / (2.0 * c), (a - b * b / (4.0 * c)).exp());
        let (center, width) = (middle + half * vertex, half * (-1.0 / c).sqrt());
        let is_usable = c < 0.0 && vertex.abs() <= 3.0 && peak <= MAX_OPACITY && width.is_finite();
        if !is_usable {
            return false;
        }
        let curve = self.fit_one(center, width.max(self.form.min_width));
        self.keep_if_good(vec![CubicTrack { opacity: peak, ..curve }])
    }

    /// Tries one curve whose time window has the same mean and the same variance over time as the opacity of the track.
    /// Returns whether the curve meets the tolerance.
    fn try_single_window(&mut self) -> bool {
        let track = self.track;
        let moment = |value: &dyn Fn(f64) -> f64| -> f64 {
            (0..track.len()).map(|frame| track.opacity[frame] * value(track.times[frame])).sum()
        };
        let whole = moment(&|_| 1.0);
        let center = moment(&|t| t) / whole;
        let variance = moment(&|t| (t - center).powi(2)) / whole;
        let step = (track.times[track.len() - 1] - track.times[0]) / track.len().max(2) as f64;
        // exp(−(dt/w)²) has the variance w²/2. Frames one step apart cannot resolve a width below half a step.
        let width = (2.0 * variance).sqrt().max(0.5 * step).max(1e-9).max(self.form.min_width);
        let curve = self.fit_one(center, width);
        let (frames, values) = self.windows.window(0);
        let (mut right, mut normal) = (0.0, 0.0);
        for (value, opacity) in values.iter().zip(&track.opacity[frames]) {
            right += value * opacity;
            normal += value.powi(2);
        }
        self.keep_if_good(vec![CubicTrack { opacity: (right / normal.max(1e-300)).min(MAX_OPACITY), ..curve }])
    }

    /// Tries `count` + 1 overlapping curves. The centers of their time windows are evenly spaced from the time `start`
    /// to the time `end`, between which the Gaussian is visible. Returns whether the curves meet the tolerance; `false`
    /// also if their error after [`FIRST_UPDATES`] iterations is too large ([`MAX_FIRST_ERROR`]).
    fn try_overlapping_curves(&mut self, [start, end]: [f64; 2], count: usize) -> bool {
        let apart = ((end - start) / count as f64).max(1e-9);
        let width = WIDTH_PER_INTERVAL * apart;
        self.windows.clear();
        (0..=count).for_each(|k| self.windows.push(&self.track.times, start + k as f64 * apart, width));
        let set_depths = |curves: &mut [CubicTrack], depths: &[f64]| {
            curves.iter_mut().zip(depths).for_each(|(curve, depth)| curve.opacity = opacity_from_depth(*depth));
        };
        let mut depths = estimate_depths(&self.windows, &self.depths);
        let max_first_error = MAX_FIRST_ERROR * self.max_excess();
        let mut opacity_excess = 0.0;
        if max_first_error.is_finite() {
            refine_depths(&self.windows, &self.depths, &mut depths, FIRST_UPDATES);
            let opacities: Vec<f64> = depths.iter().map(|depth| opacity_from_depth(*depth)).collect();
            // Opacities are compared before motions are fitted, because this is faster and often decides.
            opacity_excess = self.compare_opacities(&opacities);
            if opacity_excess > max_first_error {
                return false;
            }
        }
        let mut curves: Vec<CubicTrack> = (0..=count).map(|k| self.fit_motion(k)).collect();
        if max_first_error.is_finite() {
            set_depths(&mut curves, &depths);
            if self.measure_misfit(&curves, opacity_excess, max_first_error).is_none() {
                return false;
            }
        }
        refine_depths(&self.windows, &self.depths, &mut depths, MAX_UPDATES);
        set_depths(&mut curves, &depths);
        self.keep_if_good(curves)
    }

    /// Returns a curve that follows the position and rotation of the track by least squares. Its time window is window
    /// `k` of `self.windows`. The weight of a frame is the opacity of the Gaussian times the value of the window.
    /// Scales and SH coefficients are weighted means. The opacity of the curve is 0; the caller sets it.
    fn fit_motion(&mut self, k: usize) -> CubicTrack {
        let track = self.track;
        let [center, width] = self.windows.shape(k);
        let (frames, values) = self.windows.window(k);
        self.samples.clear();
        for (frame, value) in frames.zip(values) {
            let weight = value * track.opacity[frame];
            if self.visible[frame] && weight > MIN_WEIGHT * MIN_VISIBLE_OPACITY {
                self.samples.push((frame, track.times[frame] - center, weight));
            }
        }
        let samples = &self.samples;
        let reach = samples.iter().map(|&(_, dt, _)| dt.abs()).fold(1e-9, f64::max);
        let positions = samples.iter().map(|&(frame, dt, weight)| (dt / reach, track.position[frame], weight));
        let rotations = samples.iter().map(|&(frame, dt, weight)| (dt / reach, track.rotation[frame], weight));
        let (position, rotation): ([[f64; 3]; 4], [[f64; 4]; 2]) = if self.form.has_linear_motion {
            let [at, velocity] = polynomial(positions, RIDGE);
            let [mean] = polynomial(rotations, RIDGE);
            ([at, velocity, [0.0; 3], [0.0; 3]], [mean, [0.0; 4]])
        } else {
            (polynomial(positions, RIDGE), polynomial(rotations, RIDGE))
        };
        let (mut whole, mut log_scale) = (0.0, [0.0; 3]);
        for &(frame, _, weight) in samples {
            whole += weight;
            log_scale.iter_mut().zip(track.log_scale[frame]).for_each(|(sum, value)| *sum += weight * value);
        }
        let whole = f64::max(whole, 1e-300);
        let mean = |value: &dyn Fn(usize) -> f64| {
            samples.iter().map(|&(frame, _, weight)| weight * value(frame)).sum::<f64>() / whole
        };
        let unscaled = |k: usize| reach.powi(k as i32);
        CubicTrack {
            center,
            width,
            position: std::array::from_fn(|k| position[k].map(|value| value / unscaled(k))),
            rotation: std::array::from_fn(|k| rotation[k].map(|value| value / unscaled(k))),
            log_scale: log_scale.map(|sum| sum / whole),
            opacity: 0.0,
            sh: track.mean_sh(mean),
        }
    }

    /// Compares `curves`, whose time windows are in `self.windows`, with the track at the frames that count
    /// ([`TrackFit::is_compared`]). `opacity_excess`: result of [`TrackFit::compare_opacities`] for the same curves,
    /// which must be its last call. Returns two results, or `None` if the first is above `limit`:
    /// - The largest ratio of an error to its tolerance. It is at most 1 if the curves meet the tolerance. Errors that
    ///   are NaN are ignored. All errors of a curve except that of the opacity are first multiplied by two factors:
    ///   [`Tolerance::weight`], and the fraction of the Gaussian's optical depth that the curve has at the frame. So a
    ///   curve that is hardly visible at a frame need not be close to the Gaussian there.
    /// - The errors over all these frames, in their own units.
    fn measure_misfit(&self, curves: &[CubicTrack], opacity_excess: f64, limit: f64) -> Option<(f64, FitError)> {
        if opacity_excess > limit {
            return None;
        }
        let (track, tolerance) = (self.track, self.tolerance);
        let mut worst = opacity_excess;
        // For each frame, the sum over curves of optical depth times distance from the Gaussian.
        let mut distances = vec![0.0; track.len()];
        for (k, curve) in curves.iter().enumerate() {
            let (frames, values) = self.windows.window(k);
            for (frame, value) in frames.zip(values) {
                let opacity = curve.opacity * value;
                if opacity < MIN_VISIBLE_OPACITY {
                    continue;
                }
                let curve_depth = depth(opacity);
                let distance = track.distance(frame, curve.position_at(track.times[frame])) / self.middle_scales[frame];
                distances[frame] += curve_depth * distance;
                // A curve that is hardly visible in this frame need not be as close.
                let fraction = (curve_depth / self.depths[frame].max(MIN_VISIBLE_OPACITY)).min(1.0);
                let factor = tolerance.weight(track.opacity[frame]) * fraction;
                worst = worst.max(factor * (distance / tolerance.position));
                worst = worst.max(self.excess_beyond_position(frame, curve, worst / factor) * factor);
                if worst > limit {
                    return None;
                }
            }
        }
        let mut misfit = FitError::default();
        for frame in (0..track.len()).filter(|&frame| self.is_compared(frame)) {
            let depth = -ln(self.transmittances[frame]);
            let distance = if depth > 0.0 { distances[frame] / depth } else { 0.0 };
            misfit.add_state(distance, self.opacity_error(frame), track.opacity[frame]);
        }
        Some((worst, misfit))
    }

    /// Compares the opacity of all curves together with that of the track at each frame. `opacities`: opacity of each
    /// curve at the center of its window, which is in `self.windows`. Sets `self.transmittances`. Returns the largest
    /// ratio of an error to its tolerance, over the frames that count ([`TrackFit::is_compared`]).
    fn compare_opacities(&mut self, opacities: &[f64]) -> f64 {
        self.transmittances.clear();
        self.transmittances.resize(self.track.len(), 1.0);
        for (k, opacity) in opacities.iter().enumerate() {
            let (frames, values) = self.windows.window(k);
            add_curve(&mut self.transmittances[frames], *opacity, values);
        }
        let compared = (0..self.track.len()).filter(|&frame| self.is_compared(frame));
        compared.map(|frame| self.opacity_error(frame).abs()).fold(0.0, f64::max) / self.tolerance.opacity
    }

    /// Returns the opacity of all curves together minus that of the track at `frame`.
    fn opacity_error(&self, frame: usize) -> f64 {
        1.0 - self.transmittances[frame] - self.track.opacity[frame]
    }

    /// Returns whether errors at `frame` count: the Gaussian is visible there, or the opacity of all curves together, by
    /// the values in `self.transmittances`, exceeds that of the Gaussian by more than [`MIN_VISIBLE_OPACITY`].
    fn is_compared(&self, frame: usize) -> bool {
        self.visible[frame] || self.opacity_error(frame) > MIN_VISIBLE_OPACITY
    }

    /// Returns the largest ratio of an error of `curve` at `frame` to its tolerance, over scales, SH coefficients and
    /// rotation. Leaves out the rotation if its ratio is certainly below `ignored`, because its exact error is slow to
    /// compute.
    fn excess_beyond_position(&self, frame: usize, curve: &CubicTrack, ignored: f64) -> f64 {
        let (track, tolerance) = (self.track, self.tolerance);
        let scale = (0..3).map(|c| (curve.log_scale[c] - track.log_scale[frame][c]).abs()).fold(0.0, f64::max);
        let mut excess = scale / tolerance.log_scale;
        if !track.has_constant_sh() {
            let sh = curve.sh.iter().zip(track.sh(frame)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            excess = excess.max(f64::from(sh) / tolerance.sh);
        }
        let dt = track.times[frame] - curve.center;
        let rotation = std::array::from_fn(|c| curve.rotation[0][c] + dt * curve.rotation[1][c]);
        if track.max_rotation_error(frame, rotation) / tolerance.rotation >= ignored {
            excess = excess.max(track.rotation_error(frame, rotation) / tolerance.rotation);
        }
        excess
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::windows::window;

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
        assert!(misfit.max_position_error < 1e-3 && misfit.states == 60, "{misfit:?}");
        let fading = track(60, cubic, |t| 0.9 * window(t, 0.4, 0.15));
        let one = fit_curves(&fading, CurveForm::CUBIC, &Tolerance::default(), &mut misfit);
        assert_eq!(one.len(), 1);
        assert!((one[0].center - 0.4).abs() < 1e-3 && (one[0].width - 0.15).abs() < 2e-3, "{:?}", one[0]);
        assert!((one[0].opacity - 0.9).abs() < 0.01 && misfit.max_opacity_error < 0.01);
    }

    #[test]
    fn complex_tracks_are_shared_by_curves_whose_opacity_adds_up() {
        let wave = |t: f64| [(18.0 * t).sin(), 0.0, 0.0];
        let mut misfit = FitError::default();
        let many = fit_curves(&track(120, wave, |_| 0.6), CurveForm::CUBIC, &Tolerance::default(), &mut misfit);
        assert!((4..=33).contains(&many.len()), "{} curves", many.len());
        assert!(misfit.max_opacity_error < 0.05 && misfit.rms() < 0.1, "{misfit:?}");
        let mut misfit = FitError::default();
        let half_seen = track(120, |_| [0.0; 3], |t| if t < 0.5 { 0.7 } else { 0.0 });
        let step = fit_curves(&half_seen, CurveForm::CUBIC, &Tolerance::default(), &mut misfit);
        assert!(step.len() > 2 && misfit.max_opacity_error < 0.4, "{} curves, {misfit:?}", step.len());
    }

    #[test]
    fn early_rejection_does_not_reject_curves_that_fit() {
        let tolerance = Tolerance::default();
        for opacity in [0.1, 0.4, 0.5, 0.6, 0.8] {
            let wave = track(120, |t| [0.3 * (18.0 * t).sin(), 0.0, 0.0], |_| opacity);
            for form in [CurveForm::CUBIC, CurveForm::linear_with_min_width(0.02)] {
                let found = fit_curves(&wave, form, &tolerance, &mut FitError::default());
                let span = [wave.times[0], wave.times[119]];
                let fits = |count: usize| {
                    // A fit that has no curves yet does not stop an attempt early.
                    let new_fit = TrackFit::new(&wave, form, &tolerance);
                    TrackFit { seeks_best: true, ..new_fit }.try_overlapping_curves(span, count)
                };
                let expected = form.intervals().iter().find(|&&count| fits(count));
                // Curves at the ends of the sequence may be too faint to be returned.
                let counts = expected.map(|count| count - 1..=count + 1);
                assert!(
                    counts.is_none_or(|counts| counts.contains(&found.len())),
                    "{opacity}: {} curves, {expected:?} intervals",
                    found.len()
                );
            }
        }
    }

    #[test]
    fn invisible_track_has_no_curve_and_single_frame_has_one() {
        for form in [CurveForm::CUBIC, CurveForm::linear_with_min_width(0.02)] {
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
        let one = fit_curves(&cut, CurveForm::linear_with_min_width(0.0), &Tolerance::default(), &mut misfit);
        assert_eq!(one.len(), 1);
        assert!((one[0].center + 0.1).abs() < 1e-6 && (one[0].width - 0.6).abs() < 1e-6, "{:?}", one[0]);
        assert!((one[0].opacity - 0.8).abs() < 1e-6 && (one[0].position[1][0] - 2.0).abs() < 1e-2, "{:?}", one[0]);
        assert!(misfit.max_opacity_error < 1e-6 && misfit.max_position_error < 0.05, "{misfit:?}");
    }

    #[test]
    fn lines_have_no_higher_terms_and_no_narrow_window() {
        let mut misfit = FitError::default();
        let turning = track(60, |t| [(3.0 * t).sin(), (3.0 * t).cos(), 0.0], |t| 0.6 + 0.2 * (9.0 * t).sin());
        let lines = fit_curves(&turning, CurveForm::linear_with_min_width(0.1), &Tolerance::default(), &mut misfit);
        assert!((2..=9).contains(&lines.len()), "{} lines", lines.len());
        for line in &lines {
            assert_eq!((&line.position[2..], line.rotation[1]), (&[[0.0; 3]; 2][..], [0.0; 4]));
            assert!(line.width >= 0.1, "{}", line.width);
        }
        assert!(misfit.rms() < 1.0 && misfit.max_opacity_error < 0.1, "{misfit:?}");
    }
}
