//! Constants of the original CUDA rasterizer that determine pixel values, the block size of the projection, and the
//! test by which whole blocks are skipped.

use std::ops::Range;

use splat_core::Gaussians;

/// Side of a tile in pixels. It affects pixel values, because a Gaussian is drawn in whole tiles.
pub(super) const TILE: u32 = 16;
/// Smallest alpha (opacity of a Gaussian at a pixel) that is blended. Smaller ones are skipped.
pub(super) const MIN_ALPHA: f32 = 1.0 / 255.0;
/// Largest alpha (opacity of a Gaussian at a pixel). Larger ones are reduced to this value.
pub(super) const MAX_ALPHA: f32 = 0.99;
/// Smallest transmittance of a pixel. A Gaussian that would lower the transmittance below this value is not blended,
/// and neither is any Gaussian behind it: the pixel has ended.
pub(super) const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Number of Gaussians that are projected together (a block). Their arrays fit in the first-level cache.
pub(super) const BLOCK: usize = 128;
/// Opacity logit below which a Gaussian is invisible: its opacity is then at most 0.00391, which is less than 1/255.
pub const MIN_LOGIT: f32 = -5.54;

/// Returns whether the opacity of any of the Gaussians `ids` is high enough to be visible: whether its logit is not
/// below [`MIN_LOGIT`]. NaN is not below.
pub(super) fn has_visible(gaussians: &Gaussians, ids: Range<usize>) -> bool {
    !gaussians.opacity_logit.plane(0)[ids].iter().all(|&logit| logit < MIN_LOGIT)
}
