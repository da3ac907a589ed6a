//! Time windows exp(−((t − center)/width)²) of fitted curves, with their values at the frames of a track. The opacity
//! of a curve at the time t is its opacity at the center, multiplied by its window.

use std::ops::Range;

use crate::model::exp_log::exp;

/// Value of |t − center| / width from which on a time window counts as 0 at the time t. Its true value there is
/// exp(−16) or less, so the curve is invisible.
const MAX_WIDTHS: f64 = 4.0;

/// Returns the value at `time` of the time window exp(−((time − center)/width)²). The width may be infinite. The time
/// must be less than 26 widths from the center, because of the range of [`exp`].
pub(super) fn window(time: f64, center: f64, width: f64) -> f64 {
    let widths = (time - center) / width;
    exp(-widths * widths)
}

/// Time windows of several curves that are fitted to one track, with the values of each window at the frames of the
/// track. A window is a factor on the opacity of its curve: exp(−((t − center)/width)²) at the time t.
#[derive(Default)]
pub(super) struct Windows {
    /// For each window, its center and its width, in units of time.
    shapes: Vec<[f64; 2]>,
    /// For each window, the frames at which it is not 0, and the index in `values` of its value at the first of these
    /// frames.
    frames: Vec<(Range<usize>, usize)>,
    /// Values of all windows at the frames in `frames`, one window after the other.
    values: Vec<f64>,
}

impl Windows {
    /// Removes all windows.
    pub(super) fn clear(&mut self) {
        self.shapes.clear();
        self.frames.clear();
        self.values.clear();
    }

    /// Adds the window with the given center and width. `times` are the times of the frames, increasing.
    pub(super) fn push(&mut self, times: &[f64], center: f64, width: f64) {
        debug_assert!(times.is_sorted());
        let first = times.partition_point(|time| (time - center) / width <= -MAX_WIDTHS);
        let end = times.partition_point(|time| (time - center) / width < MAX_WIDTHS).max(first);
        self.shapes.push([center, width]);
        self.frames.push((first..end, self.values.len()));
        self.values.extend(times[first..end].iter().map(|&time| window(time, center, width)));
    }

    /// Returns the number of windows.
    pub(super) fn len(&self) -> usize {
        self.shapes.len()
    }

    /// Returns the center and the width of window `k`.
    pub(super) fn shape(&self, k: usize) -> [f64; 2] {
        self.shapes[k]
    }

    /// Returns the frames at which window `k` is not 0, and its values there.
    pub(super) fn window(&self, k: usize) -> (Range<usize>, &[f64]) {
        let (frames, start) = &self.frames[k];
        (frames.clone(), &self.values[*start..start + frames.len()])
    }

    /// Returns the frames at which window `k` is above `limit`, and its values there.
    pub(super) fn window_above(&self, k: usize, limit: f64) -> (Range<usize>, &[f64]) {
        // A window has one maximum, so these frames are consecutive.
        let (frames, values) = self.window(k);
        let first = values.iter().position(|value| *value > limit).unwrap_or(0);
        let end = values.iter().rposition(|value| *value > limit).map_or(first, |last| last + 1);
        (frames.start + first..frames.start + end, &values[first..end])
    }

    /// Returns the value of window `k` at `frame`.
    #[cfg(test)]
    pub(super) fn value(&self, k: usize, frame: usize) -> f64 {
        let (frames, start) = &self.frames[k];
        if frames.contains(&frame) { self.values[start + frame - frames.start] } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stored_values_equal_the_window_at_every_frame() {
        let times: Vec<f64> = (0..50).map(|frame| f64::from(frame) * 0.02).collect();
        let mut windows = Windows::default();
        let shapes = [(0.3, 0.05), (-0.1, 0.2), (0.5, f64::INFINITY), (3.0, 0.1), (0.41, 1e-9)];
        for (center, width) in shapes {
            windows.push(&times, center, width);
        }
        for (k, (center, width)) in shapes.into_iter().enumerate() {
            for (frame, &time) in times.iter().enumerate() {
                let is_near = ((time - center) / width).abs() < MAX_WIDTHS;
                let expected = if is_near { window(time, center, width) } else { 0.0 };
                assert_eq!(windows.value(k, frame), expected, "window {k}, frame {frame}");
                let (frames, values) = windows.window_above(k, 0.1);
                assert_eq!(frames.contains(&frame), expected > 0.1, "window {k}, frame {frame}");
                assert!(!frames.contains(&frame) || values[frame - frames.start] == expected);
            }
        }
    }
}
