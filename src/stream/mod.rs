//! Driving a pass over the frames of a source on all threads, with progress.

mod contribution;
mod gather;
mod look;
mod merged;
mod motion;
mod progress;
mod recolored;
mod removal;
mod scan;

pub use contribution::{Seen, visible_contribution};
pub use gather::gather;
pub use look::Sample;
pub use merged::MergedSequence;
pub use motion::measure_motion;
pub use progress::Progress;
pub use recolored::{Recolored, recolor};
pub use removal::removal_error;
pub use scan::{Scanned, scan};

/// Gaussians per unit of parallel work: their state at a frame and their accumulators fit the caches.
/// Results do not depend on it.
pub const BLOCK: usize = 1024;
