//! Memory budget of a run, and the memory of the program itself.

use bytesize::ByteSize;

use crate::limits::ReadLimit;
use crate::machine::{memory_limit, peak_memory_bytes};

/// Resident bytes without any Gaussian: the program (12.5 MiB without optimization), its libraries (3.6 MiB), stacks
/// and heaps of its threads, and messages.
pub(super) const PROGRAM_BYTES: u64 = 18 << 20;
/// Resident bytes per thread.
pub(super) const PER_THREAD: u64 = 2 << 20;

/// Information that a run gives before it starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Verbosity {
    /// No information.
    #[default]
    Nothing,
    /// Estimated time and maximum memory.
    Time,
    /// Memory of every stage, number of full reads, and estimated time.
    Plan,
}

/// Memory that a run may take, and the information it gives in advance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Budget {
    /// Number of bytes; `None`: a quarter of what this process may take, see [`memory_limit`].
    pub bytes: Option<u64>,
    /// Information sent before any work.
    pub tell: Verbosity,
}

impl Budget {
    /// Returns the number of bytes that the run may take.
    pub fn limit(self) -> u64 {
        self.bytes.unwrap_or_else(|| Budget::by_default().0)
    }

    /// Returns the memory that opening an input may take: the budget without the program itself, and at least 4 MiB, so
    /// that small inputs can be opened and the memory plan can state what a run needs.
    pub fn read_limit(self) -> ReadLimit {
        let program = PROGRAM_BYTES + PER_THREAD * rayon::current_num_threads() as u64;
        ReadLimit::new(self.limit().saturating_sub(program).max(4 << 20))
    }

    /// Returns the default budget in bytes, and a description of where it comes from.
    pub(super) fn by_default() -> (u64, String) {
        let (bytes, origin) = memory_limit();
        (bytes / 4, format!("a quarter of {}, {origin}", size(bytes)))
    }

    /// Returns the budget as text.
    pub fn named(self) -> String {
        match self.bytes {
            Some(bytes) => format!("{}, as asked for", size(bytes)),
            None => {
                let (bytes, origin) = Budget::by_default();
                format!("{}, {origin}", size(bytes))
            }
        }
    }
}

/// Returns the peak memory of this process so far as text; `None` if the system does not report it.
pub fn taken() -> Option<String> {
    peak_memory_bytes().map(|bytes| format!("memory: at most {} taken", size(bytes)))
}

/// Returns a number of bytes as text with a binary unit.
pub fn size(bytes: u64) -> String {
    ByteSize(bytes).display().iec().to_string()
}
