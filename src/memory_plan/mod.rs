//! Plan of a run's memory. Estimates the memory and time that the stages of a run need, and chooses limits that keep
//! the run within its memory budget (`--memory`). Every stage provides its own [`ResourceEstimate`]; this module knows
//! no stage.
//!
//! The memory of a stage is a number of bytes per Gaussian, plus a fixed number of bytes. Both are sums of parts with
//! names, such as "views". The stage that takes most memory determines the peak of the run. [`MemoryPlan::fit_budget`]
//! starts with limits that cost no time. It then halves the limit that frees most memory, until all stages fit. Limits
//! never change the result of a run.
//!
//! Only four parts of the memory grow with the number of frames. Each of them has a name too: time stamps, lists of
//! views, the number of Gaussians alive (opacity ≥ alpha_min) in each frame, and one byte per tile of a container (the
//! values of some consecutive Gaussians at some consecutive frames).

mod budget;
mod estimate;
mod plan;
mod workload;

pub use budget::{Budget, Verbosity, format_bytes, peak_memory_text};
pub use estimate::{ResourceEstimate, bytes_of_survivors};
pub use plan::MemoryPlan;
pub use workload::{
    CONTRIBUTION_COST, MemoryPart, REMOVAL_COST, RENDER_COST, RenderCost, SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload,
};
