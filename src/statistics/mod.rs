//! Statistics of every Gaussian in one pass over the frames (method.md, section 1).
//!
//! In: the columns of a block of Gaussians, frame after frame, with the cameras of each frame.
//! Out: one row per Gaussian. Memory: [`BYTES_PER_GAUSSIAN`] for every Gaussian of a block, whatever
//! the number of frames. Source: "Temporally-Aware Pruning for Compact 4D Gaussian Splatting
//! Models", section 3.2.
//!
//! Nothing here knows about files or threads, and a row depends on its own Gaussian only, so blocks
//! may be cut anywhere and run in any order without changing a bit.

mod anisotropy;
pub(crate) mod aside;
mod life;
mod motion;
mod noise;
pub mod pass;
mod plan;
pub mod projection;
mod scan;
pub mod score;
mod state;
#[cfg(test)]
mod tests;

pub use anisotropy::fill_anisotropy;
pub use noise::{Snapped, snap, ulp};
pub use plan::ScanPlan;
use scan::wanted;
pub use scan::{BYTES_PER_GAUSSIAN, BlockScan, BlockStatistics, NEEDED};
