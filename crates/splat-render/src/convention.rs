//! Numbers that decide a picture, those of the original rasteriser, and the width of its loops.

/// Side of a tile in pixels; part of the result, for a Gaussian reaches whole tiles.
pub(super) const TILE: u32 = 16;
/// Alphas below this are skipped.
pub(super) const MIN_ALPHA: f32 = 1.0 / 255.0;
/// Alphas are cut to this.
pub(super) const MAX_ALPHA: f32 = 0.99;
/// A Gaussian that would leave less transmittance than this ends the pixel, unblended.
pub(super) const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Gaussians projected together: the arrays of one block stay in the first-level cache.
pub(super) const BLOCK: usize = 128;
