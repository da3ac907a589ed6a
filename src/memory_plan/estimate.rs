//! Memory and time that a stage needs.

use super::workload::{MemoryPart, Workload};

/// Memory and time that a stage needs.
#[derive(Debug, Clone, PartialEq)]
pub struct ResourceEstimate {
    /// Name of the stage.
    pub stage: &'static str,
    /// Maximum number of full reads of the frames.
    pub reads: f64,
    /// Estimated time in seconds of one processor, computed from measured costs of single operations.
    pub seconds: f64,
    /// Memory in bytes per Gaussian.
    pub per_gaussian: Vec<MemoryPart>,
    /// Memory in bytes that does not depend on the number of Gaussians.
    pub fixed: Vec<MemoryPart>,
}

impl ResourceEstimate {
    pub(super) fn bytes_per_gaussian(&self) -> u64 {
        self.per_gaussian.iter().map(|&(_, bytes)| bytes).sum()
    }

    /// Returns the memory in bytes that the stage takes for such an input.
    pub(crate) fn bytes(&self, work: &Workload) -> u64 {
        let fixed: u64 = self.fixed.iter().map(|&(_, bytes)| bytes).sum();
        work.gaussians.saturating_mul(work.input.per_gaussian + self.bytes_per_gaussian()).saturating_add(fixed)
    }
}

/// Returns `bytes` per survivor as bytes per Gaussian of the input, if the fraction `left` of the Gaussians survives.
pub fn bytes_of_survivors(left: f64, bytes: u64) -> u64 {
    (left * bytes as f64).ceil() as u64
}

/// Returns the names of the stages and their estimated times in seconds on all threads.
pub fn seconds(work: &Workload, estimates: &[ResourceEstimate]) -> Vec<(&'static str, f64)> {
    estimates.iter().map(|estimate| (estimate.stage, estimate.seconds / work.threads as f64)).collect()
}
