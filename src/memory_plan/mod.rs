//! Memory and time that a run needs, and limits that keep it within a memory budget. This module knows no stage: every
//! stage states its own [`ResourceEstimate`].
//!
//! The memory of a stage is a number of bytes per Gaussian plus a fixed number of bytes, both as sums of named parts.
//! The largest stage determines the peak. [`Plan::fit`] starts with limits that cost no time, and halves the limit that
//! frees most memory until all stages fit. Results never depend on the limits. Only four things grow with the number of
//! frames, and they are named parts too: time stamps, lists of views, the number of Gaussians alive in each frame, and
//! one byte per tile of a container.

mod budget;
mod estimate;
mod plan;
mod workload;

pub use budget::{Budget, Verbosity, size, taken};
pub use estimate::{ResourceEstimate, bytes_of_survivors, seconds};
pub use plan::Plan;
pub use workload::{
    LOOK, MemoryPart, REMOVE, RENDER, RenderCost, SHARED_VIEW_BYTES_PER_GAUSSIAN, Throughput, Workload,
};
