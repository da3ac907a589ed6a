//! What splats take of a picture: sums over pixels, by pair of a splat and a tile, and by splat.

/// What one splat takes from pixels, f32 sums of a tile in a fixed order or f64 sums of those.
///
/// With p = alpha · ∂L/∂alpha and a pixel's offset (x, y), pixels: y along v from the splat's center, x along u from the
/// middle of the row.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SplatSums<T> {
    /// Σ p.
    pub(super) p: T,
    /// Σ p·x and Σ p·y.
    pub(super) first: [T; 2],
    /// Σ p·x², Σ p·x·y and Σ p·y².
    pub(super) second: [T; 3],
    /// Σ weight · ∂L/∂ pixel, by channel.
    pub(super) color: [T; 3],
}

impl SplatSums<f64> {
    #[inline(always)]
    pub(super) fn add(&mut self, tile: &SplatSums<f32>) {
        self.p += f64::from(tile.p);
        (0..2).for_each(|k| self.first[k] += f64::from(tile.first[k]));
        (0..3).for_each(|k| self.second[k] += f64::from(tile.second[k]));
        (0..3).for_each(|k| self.color[k] += f64::from(tile.color[k]));
    }
}

/// What splats take of a picture.
#[derive(Debug, Default)]
pub(in super::super) struct ImageGradientSums {
    /// One for every splat.
    pub(super) totals: Vec<SplatSums<f64>>,
    /// One for every pair of a strip.
    pub(super) of_pairs: Vec<SplatSums<f32>>,
}
