//! Limits on the memory of a run.

use std::path::Path;

use crate::error::{Error, Result};

/// Maximum amounts of data (frames, views, Gaussians) that stages keep in memory at a time. Lower limits make a run
/// slower and smaller in memory; they never change its result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Maximum number of decoded frames that a reader keeps in memory for later reads, at least 1. Consecutive frames
    /// of a container are decoded together, because a tile holds several frames.
    pub max_kept_frames: usize,
    /// Maximum number of frames that are rendered together, at least 1. For each, the states of all Gaussians are in
    /// memory.
    pub frames_together: usize,
    /// Maximum number of views rendered at the same time; at least 1.
    pub views_together: usize,
    /// Maximum number of output Gaussians that are written together. Their values at all frames are in memory until
    /// they are written.
    pub gaussians_together: usize,
    /// Maximum number of pairs of Gaussians whose motion is compared at the same time; at least 1.
    pub pairs_together: usize,
    /// Whether the statistics of the Gaussians are moved from memory to a temporary file after they have been scored.
    pub statistics_on_disk: bool,
    /// Whether all decoded tiles of a container stay in memory. A tile holds some Gaussians and frames of one
    /// attribute.
    pub keeps_tiles: bool,
}

impl Limits {
    /// No limits on the amounts in memory, for the fastest run.
    pub const NONE: Limits = Limits {
        max_kept_frames: usize::MAX,
        frames_together: usize::MAX,
        views_together: usize::MAX,
        gaussians_together: usize::MAX,
        pairs_together: usize::MAX,
        statistics_on_disk: false,
        keeps_tiles: false,
    };
}

/// Maximum number of bytes of memory that reading an input may take, without the memory of the program itself.
///
/// Readers check this limit before they allocate memory for a length given in a file. If the file gives no length, they
/// check it while they read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadLimit {
    bytes: u64,
}

impl Default for ReadLimit {
    fn default() -> Self {
        ReadLimit::NONE
    }
}

impl ReadLimit {
    /// No limit, for tests and for programs that trust their input.
    pub const NONE: ReadLimit = ReadLimit { bytes: u64::MAX };

    /// Creates a limit of `bytes` bytes of memory.
    pub fn new(bytes: u64) -> ReadLimit {
        ReadLimit { bytes }
    }

    /// Returns the maximum number of bytes of memory that reading may take.
    pub fn bytes(self) -> u64 {
        self.bytes
    }

    /// Checks that `bytes` bytes of memory are within this limit. `what` names the purpose of the memory, as in "the
    /// rows of the header".
    ///
    /// # Errors
    /// Fails if `bytes` exceeds the limit. The error names the file `path`, the place `place` in it, and the option
    /// `--memory`.
    pub fn check(self, path: &Path, place: &str, what: &str, bytes: u64) -> Result<()> {
        if bytes <= self.bytes {
            return Ok(());
        }
        let mebibytes = |bytes: u64| format!("{:.1} MiB", bytes as f64 / (1u64 << 20) as f64);
        let (expected, found) = (mebibytes(self.bytes), mebibytes(bytes));
        Err(Error::input(path, place, format!("at most {expected} for {what}"), found)
            .hint("if the file is meant to be this large, allow more memory with --memory"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn read_limit_accepts_its_own_size_and_refuses_more() {
        let limit = ReadLimit::new(3 << 20);
        assert!(limit.check(Path::new("a.ply"), "header", "its properties", 3 << 20).is_ok());
        let message = limit.check(Path::new("a.ply"), "header", "its properties", 4 << 20).unwrap_err().to_string();
        for part in ["a.ply, header", "at most 3.0 MiB for its properties", "4.0 MiB", "--memory"] {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    }
}
