//! Passes over the frames or views of a frame source, each on all threads.

mod changed;
mod frames;
mod gather;
mod held;
mod parts;
mod sample;
mod some_frames;
mod states;
mod tracks;
pub(crate) mod views;

pub use changed::SourceWithDeltas;
pub use frames::FrameReaders;
pub use gather::{BlockwiseReader, gather, gather_all, visible_ids};
pub use held::FramesInMemory;
pub use parts::BlockSlices;
pub use sample::{
    VIEWS_PER_FRAME, ViewSampler, frames_needed_to_see_all, grid_strides, pixel_stride, scoring_views, select_evenly,
    select_evenly_over_frames,
};
pub use some_frames::SomeFrames;
pub use states::FrameStates;
pub use tracks::{TRACKS_PER_BLOCK, map_tracks};
pub use views::{BatchLimits, RenderableView, RenderedSource, VIEWS_PER_THREAD, for_each_view_batch};

/// Number of Gaussians per unit of parallel work: their attributes at one frame and the sums computed from them fit
/// into the processor's caches. No result depends on this number.
pub const GAUSSIANS_PER_BLOCK: usize = 1024;
