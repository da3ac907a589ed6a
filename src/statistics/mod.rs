//! Statistics of every Gaussian, computed in one pass over the frames (method.md, section 1).
//!
//! Input: the attributes of a block of Gaussians, frame after frame, and the cameras that see each frame. Output: one
//! row of statistics per Gaussian. Memory: [`BYTES_PER_GAUSSIAN`] for every Gaussian of a block, independent of the
//! number of frames. Source: "Temporally-Aware Pruning for Compact 4D Gaussian Splatting Models", section 3.2.
//!
//! The code that accumulates statistics knows nothing of files or threads (only [`pass`] does), and a row depends on
//! its own Gaussian only. Gaussians may therefore be divided into blocks anywhere, and blocks may be processed in any
//! order, without changing a bit of the result.

mod anisotropy;
mod life;
mod motion;
mod noise;
pub mod pass;
mod plan;
pub mod projection;
mod scan;
pub mod score;
pub(crate) mod spilled;
mod state;
#[cfg(test)]
mod tests;

pub use anisotropy::fill_anisotropy;
pub use noise::{SnapCounts, snap_noise_to_zero, ulp};
pub use plan::ScanPlan;
use scan::attributes_to_read;
pub use scan::{BYTES_PER_GAUSSIAN, BlockScan, BlockStatistics, NEEDED_ATTRIBUTES};
