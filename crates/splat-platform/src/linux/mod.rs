//! Functions that are implemented separately for Linux: memory limits and truncation of mapped files.

mod memory;
mod truncated_map;

pub use memory::{memory_limits, peak_memory_bytes, reset_peak_memory, return_freed_memory};
pub use truncated_map::report_truncated_maps;
