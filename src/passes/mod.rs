//! Driving a pass over the frames of a source on all threads.

mod changed;
mod frames;
mod gather;
mod held;
mod parts;
pub(crate) mod pictures;
mod sample;
mod states;
mod tracks;

pub use changed::Changed;
pub use frames::FrameReaders;
pub use gather::{InBlocks, gather, gather_all};
pub use held::HeldFrames;
pub use parts::BlockSlices;
pub use pictures::{Batch, PICTURES_PER_THREAD, Subject, ViewStates, show};
pub use sample::{Sampler, VIEWS_AT_ONCE, frames_to_see, looked_at, spread, spread_over};
pub use states::States;
pub use tracks::{TRACKED, tracks};

/// Gaussians per unit of parallel work: their state at a frame and their accumulators fit the caches.
/// Results do not depend on it.
pub const BLOCK: usize = 1024;
