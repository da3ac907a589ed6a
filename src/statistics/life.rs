//! Computes two statistics of every Gaussian from its opacity at every frame: the life span (the frames in which the
//! Gaussian is alive) and the opacity variance V.

use std::mem::size_of;

/// Running sums over the frames added so far. The life spans and opacity variances of a block of Gaussians are computed
/// from these sums.
///
/// A Gaussian is alive in the frames in which its opacity α is at least a threshold. The variance of α over these n
/// frames is V = s₂/n − (s₁/n)². Here s₁ and s₂ are the sums of α − α₁ and (α − α₁)² over these frames, and α₁ is the
/// opacity in the first of them. Subtracting α₁ makes V of a constant opacity exactly 0, and keeps full precision for a
/// nearly constant one.
pub(super) struct LifeSpans {
    first: Vec<f64>,
    sum: Vec<f64>,
    sum_of_squares: Vec<f64>,
    frames: Vec<u32>,
    /// Number of Gaussians alive (opacity ≥ alpha_min) in the frame that was added last.
    alive: u32,
    /// Number of frames, added by [`LifeSpans::repeat_frame`], that are not counted in `frames` yet. Their opacities
    /// equal those of the first frame.
    repeats: u32,
}

impl LifeSpans {
    pub(super) const BYTES_PER_GAUSSIAN: usize = 3 * size_of::<f64>() + size_of::<u32>();

    pub(super) fn new(len: usize) -> Self {
        LifeSpans {
            first: vec![0.0; len],
            sum: vec![0.0; len],
            sum_of_squares: vec![0.0; len],
            frames: vec![0; len],
            alive: 0,
            repeats: 0,
        }
    }

    /// Adds the next frame to the running sums and to the numbers of frames in which Gaussians are alive. `opacity`
    /// holds the opacity of every Gaussian, in [0, 1]. Returns how many Gaussians are alive in this frame: those with
    /// an opacity of at least `alpha_min`.
    #[inline(always)]
    pub(super) fn add_frame(&mut self, opacity: &[f64], alpha_min: f64) -> u32 {
        self.count_repeats();
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

    /// Adds a frame in which every Gaussian has the same opacity as in the first frame. Returns how many Gaussians are
    /// alive (opacity ≥ alpha_min) in it.
    ///
    /// May be called only while all frames so far have had these opacities. The sums for V then stay unchanged, because
    /// every difference α − α₁ from the opacity of the first frame is 0.
    #[inline(always)]
    pub(super) fn repeat_frame(&mut self) -> u32 {
        self.repeats += 1;
        self.alive
    }

    /// Adds the number of frames that [`LifeSpans::repeat_frame`] has received to the life span of every Gaussian that
    /// is alive (opacity ≥ alpha_min) in them. Must be called before results are read.
    #[inline(always)]
    pub(super) fn count_repeats(&mut self) {
        if self.repeats > 0 {
            // So far `frames` is 1 for every Gaussian that is alive, and 0 for the others.
            self.frames.iter_mut().for_each(|frames| *frames *= 1 + self.repeats);
            self.repeats = 0;
        }
    }

    /// Returns for each Gaussian the number of frames so far in which it was alive (opacity ≥ alpha_min).
    pub(super) fn frames(&self) -> &[u32] {
        &self.frames
    }

    /// Returns the opacity variance V of every Gaussian; 0 if it was never alive.
    pub(super) fn variance(&self) -> Vec<f64> {
        (0..self.frames.len())
            .map(|i| {
                let n = f64::from(self.frames[i].max(1));
                let mean = self.sum[i] / n;
                // Rounding can leave a value slightly below zero.
                (self.sum_of_squares[i] / n - mean * mean).max(0.0)
            })
            .collect()
    }

    #[cfg(test)]
    pub(super) fn resident_bytes(&self) -> usize {
        let LifeSpans { first, sum, sum_of_squares, frames, alive: _, repeats: _ } = self;
        size_of_val(&first[..]) + size_of_val(&sum[..]) + size_of_val(&sum_of_squares[..]) + size_of_val(&frames[..])
    }
}
