//! Counts the memory that is in use while cameras are read.

use std::path::Path;

use crate::error::Result;
use crate::limits::ReadLimit;

/// Counter of the bytes of memory that are in use while cameras are read, and their limit.
#[derive(Debug)]
pub(super) struct MemoryCounter {
    pub(super) limit: ReadLimit,
    /// Number of bytes that are in use.
    pub(super) used: u64,
}

impl MemoryCounter {
    /// Returns a counter of no bytes with the limit `limit`.
    pub(super) fn new(limit: ReadLimit) -> MemoryCounter {
        MemoryCounter { limit, used: 0 }
    }

    /// Counts `bytes` of memory that are about to be allocated. For the error message, `path` is the file, `place` the
    /// position in the file, and `what` the purpose of the memory.
    ///
    /// # Errors
    /// Fails if the memory limit for reading would be exceeded.
    pub(super) fn take(&mut self, path: &Path, place: &str, what: &str, bytes: u64) -> Result<()> {
        let used = self.used.saturating_add(bytes);
        self.limit.check(path, place, what, used)?;
        self.used = used;
        Ok(())
    }
}
