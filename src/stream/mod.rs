//! Driving a pass over the frames of a source on all threads, with progress.

mod contribution;
mod frames;
mod gather;
mod held;
mod merged;
mod motion;
mod progress;
mod scan;

pub use contribution::{Looking, Sample, Sampler, Seen, visible_contribution};
pub use frames::Frames;
pub use gather::gather;
pub use held::HeldFrames;
pub use merged::MergedSequence;
pub use motion::measure_motion;
pub use progress::Progress;
pub use scan::{RunningScan, Scanned, scan};

/// Gaussians per unit of parallel work: their state at a frame and their accumulators fit the caches.
/// Results do not depend on it.
pub const BLOCK: usize = 1024;
