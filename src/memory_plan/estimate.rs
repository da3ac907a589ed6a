//! Estimate of the memory and time that one stage of a run needs.

use super::workload::{MemoryPart, Workload};

/// Memory and time that one stage of a run needs.
#[derive(Debug, Clone, PartialEq)]
pub struct ResourceEstimate {
    /// Name of the stage.
    pub stage: &'static str,
    /// Maximum number of times that the stage reads the whole input (all frames), for example 0.5 if it reads half of
    /// it.
    pub reads: f64,
    /// Estimated time of the stage on one processor core, in seconds. Computed from measured times of single
    /// operations.
    pub seconds: f64,
    /// Named parts of the stage's memory that grow with the number of Gaussians, in bytes per Gaussian of the input.
    pub per_gaussian: Vec<MemoryPart>,
    /// Named parts of the stage's memory that do not depend on the number of Gaussians, in bytes.
    pub fixed: Vec<MemoryPart>,
}

impl ResourceEstimate {
    pub(super) fn bytes_per_gaussian(&self) -> u64 {
        self.per_gaussian.iter().map(|&(_, bytes)| bytes).sum()
    }

    /// Returns the bytes of memory that the stage takes for the input that `work` describes, including the memory per
    /// Gaussian of the open input itself.
    pub(crate) fn bytes(&self, work: &Workload) -> u64 {
        let fixed: u64 = self.fixed.iter().map(|&(_, bytes)| bytes).sum();
        work.gaussians.saturating_mul(work.input.per_gaussian + self.bytes_per_gaussian()).saturating_add(fixed)
    }
}

/// Converts bytes of memory per survivor (Gaussian that has not been removed) to bytes per Gaussian of the input.
/// `fraction`: fraction of the input's Gaussians that survive.
pub fn bytes_of_survivors(fraction: f64, bytes: u64) -> u64 {
    (fraction * bytes as f64).ceil() as u64
}
