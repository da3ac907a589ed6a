//! Driving a pass over the frames of a source on all threads, with progress.

mod blocks;
mod changed;
mod contribution;
mod frames;
mod gather;
mod held;
mod merged;
mod message;
pub mod motion;
mod parts;
mod pictures;
mod progress;
mod removal;
mod sample;
mod scan;
mod stages;
mod states;
mod tracks;
mod trajectories;

pub use changed::Changed;
pub use contribution::{RunningContribution, Seen, visible_contribution};
pub use frames::Frames;
pub use gather::{InBlocks, gather, gather_all};
pub use held::HeldFrames;
pub use merged::MergedSequence;
pub use message::tell;
pub use parts::Parts;
pub use pictures::{Batch, PICTURES_PER_THREAD, Subject, View, show};
pub use progress::{Mode, Progress, begin_run, duration};
pub use removal::removal_error;
pub use sample::{Sampler, VIEWS_AT_ONCE, frames_to_see, looked_at, spread, spread_over};
pub use scan::{RunningScan, Scanned, scan, scan_blocks, scan_units};
pub use states::States;
pub use tracks::{TRACKED, tracks};

/// Gaussians per unit of parallel work: their state at a frame and their accumulators fit the caches.
/// Results do not depend on it.
pub const BLOCK: usize = 1024;
