//! Memory limits of a run.

use std::path::Path;

use crate::error::{Error, Result};

/// Amounts that stages keep in memory at a time. No result depends on them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Maximum number of frames that a reader of consecutive frames keeps of those it decodes together; at least 1.
    pub frames_held: usize,
    /// Maximum number of frames whose states are in memory, ready to be rendered; at least 1.
    pub frames_together: usize,
    /// Maximum number of views rendered at once; at least 1.
    pub pictures_together: usize,
    /// Maximum number of Gaussians of a result whose frames are in memory until they are written.
    pub gaussians_together: usize,
    /// Maximum number of pairs of Gaussians whose motion is compared together; at least 1.
    pub pairs_together: usize,
    /// Whether statistics are spilled to a scratch file once they have been scored.
    pub rows_aside: bool,
    /// Whether all decoded tiles of a container stay in memory.
    pub tiles_held: bool,
}

impl Limits {
    /// Limits that allow the fastest run.
    pub const NONE: Limits = Limits {
        frames_held: usize::MAX,
        frames_together: usize::MAX,
        pictures_together: usize::MAX,
        gaussians_together: usize::MAX,
        pairs_together: usize::MAX,
        rows_aside: false,
        tiles_held: false,
    };
}

/// Memory that opening an input may take, without the program itself.
///
/// Readers check the limit before they allocate for a length given in a file, and during reading if the file gives
/// none.
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

    /// Creates a limit of `bytes` bytes.
    pub fn new(bytes: u64) -> ReadLimit {
        ReadLimit { bytes }
    }

    /// Returns the number of bytes that reading may take.
    pub fn bytes(self) -> u64 {
        self.bytes
    }

    /// Checks that `bytes` fit within the limit. `what` names their purpose, as in "the rows of the header".
    ///
    /// # Errors
    /// More bytes than the limit: an input error at `place` of `path` that says what to do.
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
