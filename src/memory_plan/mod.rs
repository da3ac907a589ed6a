//! Plan of a run's memory: the memory and time that the run needs, and limits that keep it within the memory budget
//! (`--memory`). This module knows no stage: every stage states its own [`ResourceEstimate`].
//!
//! The memory of a stage is a number of bytes per Gaussian plus a fixed number of bytes, both as sums of named parts.
//! The stage that takes most memory determines the peak. [`MemoryPlan::fit_budget`] starts with limits that cost no
//! time, and halves the limit that frees most memory until all stages fit. Results never depend on the limits.
//!
//! Only four parts of the memory grow with the number of frames, and each has a name too: time stamps, lists of views,
//! the number of Gaussians alive in each frame, and one byte per tile (values of consecutive Gaussians × frames) of a
//! container.

mod budget;
mod estimate;
mod plan;
mod workload;

pub use budget::{Budget, Verbosity, format_bytes, peak_memory_text};
pub use estimate::{ResourceEstimate, bytes_of_survivors, stage_seconds};
pub use plan::MemoryPlan;
pub use workload::{
    CONTRIBUTION_COST, MemoryPart, REMOVAL_COST, RENDER_COST, RenderCost, SHARED_VIEW_BYTES_PER_GAUSSIAN, Throughput,
    Workload,
};
