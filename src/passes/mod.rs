//! Passes over the frames or views of a frame source, each on all threads.

mod changed;
mod frames;
mod gather;
mod held;
mod parts;
pub(crate) mod pictures;
mod sample;
mod some_frames;
mod states;
mod tracks;

pub use changed::WithDelta;
pub use frames::FrameReaders;
pub use gather::{BlockwiseReader, gather, gather_all};
pub use held::HeldFrames;
pub use parts::BlockSlices;
pub use pictures::{Batch, RenderedSource, VIEWS_PER_THREAD, ViewStates, show};
pub use sample::{Sampler, VIEWS_PER_FRAME, frames_to_see, looked_at, pixel_stride, spread, spread_over};
pub use some_frames::SomeFrames;
pub use states::States;
pub use tracks::{TRACK_BLOCK, tracks};

/// Number of Gaussians per unit of parallel work: their attributes at one frame and the sums computed from them fit
/// into the processor's caches. No result depends on this number.
pub const BLOCK: usize = 1024;
