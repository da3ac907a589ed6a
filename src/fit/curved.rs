//! Fit of curves with cubic motion and linear rotation, each visible in a soft window of time: the form that players of
//! SpacetimeGaussians support.
//!
//! A window is exp(−((t − center)/width)²). A Gaussian with constant opacity and cubic motion needs one curve of
//! infinite width; a Gaussian that fades once needs one curve. Any other Gaussian is covered by 3, 5, 9 … overlapping
//! curves. Their centers are evenly spaced over the visible time, and each width is three quarters of the spacing. The
//! sum of such windows is 1 with an error of at most 2·exp(−(3π/4)²) = 0.8%. Optical depths −ln(1 − α), where α is the
//! opacity, add up where Gaussians overlap. So the depth of the Gaussian is distributed among the curves, by
//! multiplicative updates that keep all depths positive (Richardson 1972, Lucy 1974).

use super::least_squares::polynomial;
use super::{FittedTrack, MIN_VISIBLE_OPACITY, Misfit, Tolerance};

/// Gaussian with cubic motion and linear rotation, visible in a window of time.
#[derive(Debug, Clone, PartialEq)]
pub struct CubicTrack {
    /// Center of the time window, and time at which dt = 0 in the polynomials of position and rotation.
    pub center: f64,
    /// Width of the time window, in units of time; infinite for constant opacity.
    pub width: f64,
    /// Coefficients of the position in scene units, from dt⁰ to dt³, where dt is the time since `center`.
    pub position: [[f64; 3]; 4],
    /// Coefficients of the rotation quaternion (w, x, y, z), dt⁰ and dt¹, where dt is the time since `center`.
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

/// Maximum number of intervals between the centers of overlapping curves, one less than the number of curves.
const MAX_INTERVALS: usize = 32;
/// Maximum number of iterations that distribute the optical depth among overlapping curves.
const MAX_UPDATES: usize = 60;
/// Largest change of an optical depth in one iteration below which the iterations end.
const CONVERGED: f64 = 1e-3;
/// Largest opacity that is fitted, so that the optical depth −ln(1 − opacity) stays finite.
const MAX_OPACITY: f64 = 0.999;
/// Weight of the term that keeps polynomial coefficients small if the frames do not determine them (ridge regression).
const RIDGE: f64 = 1e-6;
/// Value of a curve's time window at a frame below which the frame does not affect the curve. The limit for window ×
/// opacity is this times the smallest visible opacity.
const MIN_WEIGHT: f64 = 1e-3;

/// Returns the curves that represent `track`: as few as meet `tolerance` at every visible frame, or, if none do, the
/// closest ones that were tried. Adds their errors to `misfit`.
pub fn curved(track: &FittedTrack, tolerance: &Tolerance, misfit: &mut Misfit) -> Vec<CubicTrack> {
    let Some(first) = (0..track.len()).find(|&frame| track.is_seen(frame)) else { return Vec::new() };
    let last = (first..track.len()).rev().find(|&frame| track.is_seen(frame)).unwrap_or(first);
    let mut best: Option<(f64, Vec<CubicTrack>, Misfit)> = None;
    let mut attempt = |curves: Vec<CubicTrack>| {
        let (excess, found) = measure_misfit(track, &curves, tolerance);
        if best.as_ref().is_none_or(|(least, _, _)| excess < *least) {
            best = Some((excess, curves, found));
        }
        excess <= 1.0
    };
    let mut done = attempt(vec![constant_curve(track)]) || attempt(vec![single_window_curve(track)]);
    let mut count = 2;
    while !done && count <= MAX_INTERVALS.min((last - first + 1).max(2)) {
        done = attempt(overlapping_curves(track, [track.times[first], track.times[last]], count));
        count *= 2;
    }
    let (_, curves, found) = best.unwrap_or_default();
    *misfit = misfit.and(found);
    curves.into_iter().filter(|curve| curve.opacity >= MIN_VISIBLE_OPACITY).collect()
}

fn window(time: f64, center: f64, width: f64) -> f64 {
    (-((time - center) / width).powi(2)).exp()
}

fn depth(opacity: f64) -> f64 {
    -(-opacity.clamp(0.0, MAX_OPACITY)).ln_1p()
}

/// Returns one curve of constant opacity, whose window is infinitely wide.
fn constant_curve(track: &FittedTrack) -> CubicTrack {
    let center = track.times[0].midpoint(track.times[track.len() - 1]);
    let seen = (0..track.len()).filter(|&frame| track.is_seen(frame));
    let (sum, count) = seen.fold((0.0, 0.0), |(sum, count), frame| (sum + track.opacity[frame], count + 1.0));
    let curve = fit_motion(track, center, f64::INFINITY, |_| 1.0);
    CubicTrack { opacity: sum / f64::max(count, 1.0), ..curve }
}

/// Returns one curve whose time window has the mean and the variance of the opacity over time.
fn single_window_curve(track: &FittedTrack) -> CubicTrack {
    let moment = |value: &dyn Fn(f64) -> f64| -> f64 {
        (0..track.len()).map(|frame| track.opacity[frame] * value(track.times[frame])).sum()
    };
    let whole = moment(&|_| 1.0);
    let center = moment(&|t| t) / whole;
    let variance = moment(&|t| (t - center).powi(2)) / whole;
    let step = (track.times[track.len() - 1] - track.times[0]) / track.len().max(2) as f64;
    // exp(−(dt/w)²) has the variance w²/2. Frames one step apart cannot resolve a width below half a step.
    let width = (2.0 * variance).sqrt().max(0.5 * step).max(1e-9);
    let windows = |frame: usize| window(track.times[frame], center, width);
    let (mut right, mut normal) = (0.0, 0.0);
    for frame in 0..track.len() {
        right += windows(frame) * track.opacity[frame];
        normal += windows(frame).powi(2);
    }
    let curve = fit_motion(track, center, width, |frame| window(track.times[frame], center, width));
    CubicTrack { opacity: (right / normal.max(1e-300)).min(MAX_OPACITY), ..curve }
}

/// Returns `count` + 1 overlapping curves for the visible time from `start` to `end`.
fn overlapping_curves(track: &FittedTrack, [start, end]: [f64; 2], count: usize) -> Vec<CubicTrack> {
    let apart = ((end - start) / count as f64).max(1e-9);
    let width = 0.75 * apart;
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
    let most = target_depths.iter().copied().fold(0.0, f64::max);
    let mut depths = vec![most / 2.0; centers.len()];
    let mut shown = vec![0.0; track.len()];
    for _ in 0..MAX_UPDATES {
        // A window multiplies the opacity, not the depth, so each curve adds the depth of its windowed opacity.
        shown.fill(0.0);
        for (shares, d) in shares.iter().zip(&depths) {
            let opacity = 1.0 - (-d).exp();
            shares.iter().for_each(|&(frame, share)| shown[frame] += depth(opacity * share));
        }
        let mut moved = 0.0f64;
        for (shares, depth) in shares.iter().zip(&mut depths) {
            let ratio: f64 =
                shares.iter().map(|&(frame, share)| share * target_depths[frame] / shown[frame].max(1e-9)).sum();
            let weight: f64 = shares.iter().map(|(_, share)| share).sum();
            let by = if weight > 0.0 { (ratio / weight).min(4.0) } else { 0.0 };
            moved = moved.max((by - 1.0).abs().min(*depth));
            *depth = (*depth * by).min(self::depth(MAX_OPACITY));
        }
        if moved < CONVERGED {
            break;
        }
    }
    let curve = |(k, depth): (usize, f64)| {
        let curve = fit_motion(track, centers[k], width, |frame| window(track.times[frame], centers[k], width));
        CubicTrack { opacity: 1.0 - (-depth).exp(), ..curve }
    };
    depths.into_iter().enumerate().map(curve).collect()
}

/// Returns a curve that follows the position and rotation of `track` by least squares; `weight` is multiplied by the
/// opacity of a frame. The returned opacity is 0.
fn fit_motion(track: &FittedTrack, center: f64, width: f64, weight: impl Fn(usize) -> f64) -> CubicTrack {
    let weight = |frame: usize| if track.is_seen(frame) { weight(frame) * track.opacity[frame] } else { 0.0 };
    let samples: Vec<(usize, f64)> = (0..track.len())
        .map(|frame| (frame, weight(frame)))
        .filter(|(_, weight)| *weight > MIN_WEIGHT * MIN_VISIBLE_OPACITY)
        .collect();
    let reach = samples.iter().map(|&(frame, _)| (track.times[frame] - center).abs()).fold(1e-9, f64::max);
    let scaled = |frame: usize| (track.times[frame] - center) / reach;
    let position: [[f64; 3]; 4] =
        polynomial(samples.iter().map(|&(frame, weight)| (scaled(frame), track.position[frame], weight)), RIDGE);
    let rotation: [[f64; 4]; 2] =
        polynomial(samples.iter().map(|&(frame, weight)| (scaled(frame), track.rotation[frame], weight)), RIDGE);
    let whole: f64 = samples.iter().map(|&(_, weight)| weight).sum();
    let mean = |value: &dyn Fn(usize) -> f64| {
        samples.iter().map(|&(frame, weight)| weight * value(frame)).sum::<f64>() / whole.max(1e-300)
    };
    let width_of_sh = track.sh(0).len();
    let unscaled = |k: usize| reach.powi(k as i32);
    CubicTrack {
        center,
        width,
        position: std::array::from_fn(|k| position[k].map(|value| value / unscaled(k))),
        rotation: std::array::from_fn(|k| rotation[k].map(|value| value / unscaled(k))),
        log_scale: std::array::from_fn(|c| mean(&|frame| track.log_scale[frame][c])),
        opacity: 0.0,
        sh: (0..width_of_sh).map(|c| mean(&|frame| f64::from(track.sh(frame)[c])) as f32).collect(),
    }
}

/// Returns the largest error of `curves` in units of `tolerance`, and the errors over all visible frames. Where several
/// curves are visible, each must be close to the Gaussian, in proportion to its share of the optical depth.
fn measure_misfit(track: &FittedTrack, curves: &[CubicTrack], tolerance: &Tolerance) -> (f64, Misfit) {
    let (mut worst, mut misfit) = (0.0f64, Misfit::default());
    for frame in 0..track.len() {
        let time = track.times[frame];
        let (mut shown, mut away) = (0.0, 0.0);
        for curve in curves {
            let share = depth(curve.opacity_at(time));
            shown += share;
            if curve.opacity_at(time) < MIN_VISIBLE_OPACITY {
                continue;
            }
            let dt = time - curve.center;
            let rotation = std::array::from_fn(|c| curve.rotation[0][c] + dt * curve.rotation[1][c]);
            let scale = (0..3).map(|c| (curve.log_scale[c] - track.log_scale[frame][c]).abs()).fold(0.0, f64::max);
            let sh = curve.sh.iter().zip(track.sh(frame)).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max);
            let distance = track.distance(frame, curve.position_at(time));
            away += share * distance;
            worst = [
                distance / tolerance.position,
                track.rotation_error(frame, rotation) / tolerance.rotation,
                scale / tolerance.log_scale,
                sh / tolerance.sh,
            ]
            .into_iter()
            // A curve that is hardly visible in this frame need not be as close.
            .map(|excess| excess * (share / depth(track.opacity[frame]).max(MIN_VISIBLE_OPACITY)).min(1.0))
            .fold(worst, f64::max);
        }
        let apart = 1.0 - (-shown).exp() - track.opacity[frame];
        if track.is_seen(frame) || apart > MIN_VISIBLE_OPACITY {
            worst = worst.max(apart.abs() / tolerance.opacity);
            misfit.add(if shown > 0.0 { away / shown } else { 0.0 }, apart);
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
        let mut misfit = Misfit::default();
        let one = curved(&track(60, cubic, |_| 0.8), &Tolerance::default(), &mut misfit);
        assert!(one.len() == 1 && one[0].width.is_infinite() && (one[0].opacity - 0.8).abs() < 1e-9);
        assert!(misfit.position < 1e-3 && misfit.states == 60, "{misfit:?}");
        let fading = track(60, cubic, |t| 0.9 * window(t, 0.4, 0.15));
        let one = curved(&fading, &Tolerance::default(), &mut misfit);
        assert_eq!(one.len(), 1);
        assert!((one[0].center - 0.4).abs() < 1e-3 && (one[0].width - 0.15).abs() < 2e-3, "{:?}", one[0]);
        assert!((one[0].opacity - 0.9).abs() < 0.01 && misfit.opacity < 0.01);
    }

    #[test]
    fn complex_tracks_are_shared_by_curves_whose_opacity_adds_up() {
        let wave = |t: f64| [(18.0 * t).sin(), 0.0, 0.0];
        let mut misfit = Misfit::default();
        let many = curved(&track(120, wave, |_| 0.6), &Tolerance::default(), &mut misfit);
        assert!((4..=MAX_INTERVALS + 1).contains(&many.len()), "{} curves", many.len());
        assert!(misfit.opacity < 0.05 && misfit.rms() < 0.1, "{misfit:?}");
        let mut misfit = Misfit::default();
        let step =
            curved(&track(120, |_| [0.0; 3], |t| if t < 0.5 { 0.7 } else { 0.0 }), &Tolerance::default(), &mut misfit);
        assert!(step.len() > 2 && misfit.opacity < 0.4, "{} curves, {misfit:?}", step.len());
    }

    #[test]
    fn invisible_track_has_no_curve_and_single_frame_has_one() {
        let mut misfit = Misfit::default();
        assert!(curved(&track(20, |_| [0.0; 3], |_| 1e-3), &Tolerance::default(), &mut misfit).is_empty());
        let still = curved(&track(1, |_| [1.0; 3], |_| 0.5), &Tolerance::default(), &mut misfit);
        assert!(still.len() == 1 && still[0].position_at(0.0).iter().all(|x| (x - 1.0).abs() < 1e-9), "{still:?}");
        let flash = track(30, |_| [0.0; 3], |t| if (t - 0.5).abs() < 1e-9 { 0.5 } else { 0.0 });
        assert!(!curved(&flash, &Tolerance::default(), &mut misfit).is_empty());
    }
}
