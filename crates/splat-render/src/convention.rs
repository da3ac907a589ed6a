//! Constants of the original rasterizer that decide pixel values, and the block size of the projection.

/// Side of a tile in pixels. Part of the result, because a Gaussian affects whole tiles.
pub(super) const TILE: u32 = 16;
/// Smallest alpha that is blended.
pub(super) const MIN_ALPHA: f32 = 1.0 / 255.0;
/// Largest alpha. Larger values are clamped to it.
pub(super) const MAX_ALPHA: f32 = 0.99;
/// Smallest transmittance of a pixel. A Gaussian that would leave less ends the pixel and is not blended.
pub(super) const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Number of Gaussians projected together. The arrays of one block stay in the first-level cache.
pub(super) const BLOCK: usize = 128;
