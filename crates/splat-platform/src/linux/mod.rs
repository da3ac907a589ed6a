//! Functions that are implemented separately for Linux: memory limits, page cache, and truncation of mapped files.

mod memory;
mod truncated_map;

use std::fs::File;
use std::io::IoSliceMut;

use rustix::io::{Errno, ReadWriteFlags, preadv2};

pub use memory::{memory_limits, peak_memory_bytes, reset_peak_memory, return_freed_memory};
pub use truncated_map::report_truncated_maps;

/// Returns whether the byte at `offset` of `file` is in memory (the page cache), so that reading it needs no disk
/// access. Returns `None` if the system gives no answer.
pub fn is_cached(file: &File, offset: u64) -> Option<bool> {
    let mut byte = [0];
    match preadv2(file, &mut [IoSliceMut::new(&mut byte)], offset, ReadWriteFlags::NOWAIT) {
        Ok(read) => Some(read == 1),
        Err(Errno::AGAIN) => Some(false),
        Err(_) => None,
    }
}
