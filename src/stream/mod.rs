//! Driving a pass over the frames of a source on all threads, with progress.

mod blocks;
mod contribution;
mod frames;
mod gather;
mod held;
mod look;
mod merged;
pub mod motion;
mod parts;
mod progress;
mod recolored;
mod removal;
mod scan;
mod stages;
mod states;
mod trajectories;

pub use contribution::{Looking, Seen, visible_contribution};
pub use frames::Frames;
pub use gather::{gather, gather_all};
pub use held::HeldFrames;
pub use look::{PICTURES_PER_THREAD, Sample, Sampler, VIEWS_AT_ONCE};
pub use merged::MergedSequence;
pub use progress::{Mode, Progress, begin_run};
pub use recolored::{Recolored, recolor};
pub use removal::removal_error;
pub use scan::{RunningScan, Scanned, scan};
pub use states::States;

/// Gaussians per unit of parallel work: their state at a frame and their accumulators fit the caches.
/// Results do not depend on it.
pub const BLOCK: usize = 1024;
