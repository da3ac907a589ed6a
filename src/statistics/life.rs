//! Life span and opacity variance: both follow from the time-dependent opacity alone.

use std::mem::size_of;

/// Running life span and opacity moments of a block.
///
/// V = s₂/n − (s₁/n)² with s₁, s₂ the sums of α − α₁ and (α − α₁)² over life, α₁ the opacity of the
/// first life frame. The shift makes a constant opacity give exactly 0 and keeps full precision for
/// a nearly constant one, where the unshifted moments cancel.
pub(super) struct Life {
    first: Vec<f64>,
    sum: Vec<f64>,
    sum_of_squares: Vec<f64>,
    frames: Vec<u32>,
    /// Living Gaussians in the last frame.
    alive: u32,
    /// Frames after the first that were like it and are not in `frames` yet.
    repeats: u32,
}

impl Life {
    pub(super) const BYTES_PER_GAUSSIAN: usize = 3 * size_of::<f64>() + size_of::<u32>();

    pub(super) fn new(len: usize) -> Self {
        Life {
            first: vec![0.0; len],
            sum: vec![0.0; len],
            sum_of_squares: vec![0.0; len],
            frames: vec![0; len],
            alive: 0,
            repeats: 0,
        }
    }

    /// Adds a frame of opacities in [0, 1]; says how many Gaussians are alive in it.
    #[inline(always)]
    pub(super) fn frame(&mut self, opacity: &[f64], alpha_min: f64) -> u32 {
        self.settle();
        let n = opacity.len();
        let (first, sum, sum_of_squares) = (&mut self.first[..n], &mut self.sum[..n], &mut self.sum_of_squares[..n]);
        let frames = &mut self.frames[..n];
        let mut all = 0;
        for i in 0..n {
            let alive = opacity[i] >= alpha_min;
            first[i] = if alive & (frames[i] == 0) { opacity[i] } else { first[i] };
            let shifted = if alive { opacity[i] - first[i] } else { 0.0 };
            sum[i] += shifted;
            sum_of_squares[i] += shifted * shifted;
            frames[i] += u32::from(alive);
            all += u32::from(alive);
        }
        self.alive = all;
        all
    }

    /// Adds a frame like the first, when all since were like it: every α − α₁ is 0. Says how many Gaussians are alive.
    #[inline(always)]
    pub(super) fn repeat(&mut self) -> u32 {
        self.repeats += 1;
        self.alive
    }

    /// Counts the frames that were repeats; call before reading results.
    #[inline(always)]
    pub(super) fn settle(&mut self) {
        if self.repeats > 0 {
            // One frame is counted so far, for those that are alive.
            self.frames.iter_mut().for_each(|frames| *frames *= 1 + self.repeats);
            self.repeats = 0;
        }
    }

    /// Life frames of every Gaussian so far.
    pub(super) fn frames(&self) -> &[u32] {
        &self.frames
    }

    /// V of every Gaussian; 0 for one that never lived.
    pub(super) fn variance(&self) -> Vec<f64> {
        (0..self.frames.len())
            .map(|i| {
                let n = f64::from(self.frames[i].max(1));
                let mean = self.sum[i] / n;
                // Rounding can leave a hair below zero.
                (self.sum_of_squares[i] / n - mean * mean).max(0.0)
            })
            .collect()
    }

    #[cfg(test)]
    pub(super) fn resident_bytes(&self) -> usize {
        let Life { first, sum, sum_of_squares, frames, alive: _, repeats: _ } = self;
        size_of_val(&first[..]) + size_of_val(&sum[..]) + size_of_val(&sum_of_squares[..]) + size_of_val(&frames[..])
    }
}
