//! Gradients of splats: sums over pixels, per pair of a splat and a tile, and per splat.

/// Gradient sums of one splat: f32 sums of a tile in a fixed order, or f64 sums of those.
///
/// p = alpha · ∂L/∂alpha, and (x, y) is the offset of a pixel: y along v from the center of the splat, x along u from
/// the maximum of the row.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SplatSums<T> {
    /// Σ p.
    pub(super) p: T,
    /// Σ p·x and Σ p·y.
    pub(super) first: [T; 2],
    /// Σ p·x², Σ p·x·y and Σ p·y².
    pub(super) second: [T; 3],
    /// Σ weight · ∂L/∂pixel, by channel.
    pub(super) color: [T; 3],
}

impl SplatSums<f64> {
    /// Adds the sums of one tile.
    #[inline(always)]
    pub(super) fn add(&mut self, tile: &SplatSums<f32>) {
        self.p += f64::from(tile.p);
        (0..2).for_each(|k| self.first[k] += f64::from(tile.first[k]));
        (0..3).for_each(|k| self.second[k] += f64::from(tile.second[k]));
        (0..3).for_each(|k| self.color[k] += f64::from(tile.color[k]));
    }
}

/// Gradient sums of all splats of a render.
#[derive(Debug, Default)]
pub(in super::super) struct ImageGradientSums {
    /// Sums of every splat.
    pub(super) totals: Vec<SplatSums<f64>>,
    /// Sums of every pair of a strip.
    pub(super) pairs: Vec<SplatSums<f32>>,
}
