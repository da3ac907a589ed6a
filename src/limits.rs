//! How much memory a run may take, and what follows from it.

use std::path::Path;

use crate::error::{Error, Result};

/// What stages keep in memory at a time. No result depends on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Frames that a reader which goes frame by frame may hold of those it decodes together; at least 1.
    pub frames_held: usize,
    /// Frames whose states lie ready to be looked at; at least 1.
    pub frames_together: usize,
    /// Pictures worked on at once; at least 1.
    pub pictures_together: usize,
    /// Gaussians of a result whose frames wait together to be written.
    pub gaussians_together: usize,
    /// Pairs of Gaussians whose motion is measured together; at least 1.
    pub pairs_together: usize,
    /// Statistics wait in a scratch file once they have been scored.
    pub rows_aside: bool,
    /// The tiles of a container stay in memory once they are decoded, all of them.
    pub tiles_held: bool,
}

impl Limits {
    /// As much as it takes to be fast.
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

/// Memory that opening an input may take beside the program itself.
///
/// Readers ask it before they allocate for a length that a file announces, and while they read where the file does not
/// announce one.
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
    /// No limit: for tests and for programs that trust their input.
    pub const NONE: ReadLimit = ReadLimit { bytes: u64::MAX };

    /// Limit of so many bytes.
    pub fn new(bytes: u64) -> ReadLimit {
        ReadLimit { bytes }
    }

    /// Bytes that reading may take.
    pub fn bytes(self) -> u64 {
        self.bytes
    }

    /// Confirms that `bytes` fit within the limit. `what` names what they are for, as in "the rows of the header".
    ///
    /// # Errors
    /// More bytes than the limit, as an input error at `place` of `path` that says what to do.
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
