//! Gradient sums: sums over pixels from which ∂L/∂attribute, the derivatives of a loss L with respect to the stored
//! attributes of a Gaussian, are computed. There are sums over the pixels of one tile, and sums over the pixels of all
//! tiles.

/// Gradient sums of one splat: the sums over pixels from which the derivatives of a loss L with respect to the
/// attributes of its Gaussian are computed. `SplatSums<f32>` holds sums over the pixels of one tile, added in a fixed
/// order, and `SplatSums<f64>` sums over the pixels of all tiles.
///
/// In the fields, p = alpha · ∂L/∂alpha, and (x, y) is the offset of a pixel, in pixels: y from the center of the
/// splat, x from the position of the largest alpha in the row of the pixel.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SplatSums<T> {
    /// Σ p over the pixels, where p = alpha · ∂L/∂alpha.
    pub(super) p: T,
    /// Σ p·x and Σ p·y over the pixels, where p = alpha · ∂L/∂alpha and (x, y) is the offset of the pixel as defined at
    /// [`SplatSums`].
    pub(super) first: [T; 2],
    /// Σ p·x², Σ p·x·y and Σ p·y² over the pixels, where p = alpha · ∂L/∂alpha and (x, y) is the offset of the pixel as
    /// defined at [`SplatSums`].
    pub(super) second: [T; 3],
    /// Σ weight · ∂L/∂pixel for each color channel, where weight = alpha · transmittance.
    pub(super) color: [T; 3],
}

impl SplatSums<f64> {
    /// Adds `tile`, the sums of the same splat over the pixels of one tile.
    #[inline(always)]
    pub(super) fn add(&mut self, tile: &SplatSums<f32>) {
        self.p += f64::from(tile.p);
        (0..2).for_each(|k| self.first[k] += f64::from(tile.first[k]));
        (0..3).for_each(|k| self.second[k] += f64::from(tile.second[k]));
        (0..3).for_each(|k| self.color[k] += f64::from(tile.color[k]));
    }
}

/// Gradient sums of all splats of a render, from which the derivatives of a loss of this render with respect to the
/// attributes of all Gaussians are computed. See [`SplatSums`].
#[derive(Debug, Default)]
pub(in super::super) struct ImageGradientSums {
    /// For each splat, its gradient sums over the pixels of all tiles.
    pub(super) totals: Vec<SplatSums<f64>>,
    /// For each (splat, tile) pair of the tiles that are being processed, the gradient sums of the splat over the
    /// pixels of the tile.
    pub(super) pairs: Vec<SplatSums<f32>>,
}
