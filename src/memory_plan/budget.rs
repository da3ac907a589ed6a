//! Memory budget of a run (`--memory`), and the memory of the program itself.

use bytesize::ByteSize;

use crate::limits::ReadLimit;
use crate::machine::{memory_limit, peak_memory_bytes};

/// Bytes of memory that a run takes without any Gaussian: the program (12.5 MiB if it is compiled without
/// optimization), its libraries (3.6 MiB), stacks and heaps of its threads, and messages.
pub(super) const PROGRAM_BYTES: u64 = 18 << 20;
/// Bytes of memory that each thread takes in addition to [`PROGRAM_BYTES`].
pub(super) const PER_THREAD: u64 = 2 << 20;

/// Amount of information about memory and time that a run sends as events before it starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Verbosity {
    /// The run reports nothing about memory and time.
    #[default]
    Nothing,
    /// The run reports its estimated time and its maximum memory.
    Time,
    /// The run reports the memory and the estimated time of every stage, and the number of full reads of the input.
    Plan,
}

/// Memory that a run may take, and amount of information about memory and time that the run reports before it starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Budget {
    /// Number of bytes that the run may take; `None`: a quarter of the memory available to this process, see
    /// [`memory_limit`].
    pub bytes: Option<u64>,
    /// Amount of information about memory and time that the run reports before it starts.
    pub tell: Verbosity,
}

impl Budget {
    /// Returns the number of bytes of memory that the run may take.
    pub fn limit(self) -> u64 {
        self.bytes.unwrap_or_else(|| Budget::by_default().0)
    }

    /// Returns the limit on the memory for opening an input: the budget minus the memory of the program itself, but at
    /// least 4 MiB. With this minimum, small inputs can be opened with any budget, and the memory plan can then state
    /// how much the run needs.
    pub fn read_limit(self) -> ReadLimit {
        let program = PROGRAM_BYTES + PER_THREAD * rayon::current_num_threads() as u64;
        ReadLimit::new(self.limit().saturating_sub(program).max(4 << 20))
    }

    /// Returns the default budget in bytes, and a text for the user that says how it follows from the memory of this
    /// machine.
    pub(super) fn by_default() -> (u64, String) {
        let (bytes, origin) = memory_limit();
        (bytes / 4, format!("a quarter of {}, {origin}", format_bytes(bytes)))
    }

    /// Returns the budget as text: the amount with a unit, and whether the user asked for it or how it follows from the
    /// memory of this machine.
    pub fn text(self) -> String {
        match self.bytes {
            Some(bytes) => format!("{}, as asked for", format_bytes(bytes)),
            None => {
                let (bytes, origin) = Budget::by_default();
                format!("{}, {origin}", format_bytes(bytes))
            }
        }
    }
}

/// Returns a message with the peak memory of this process so far; `None` if the operating system does not report it.
pub fn peak_memory_text() -> Option<String> {
    peak_memory_bytes().map(|bytes| format!("memory: at most {} taken", format_bytes(bytes)))
}

/// Returns a number of bytes as text with a binary unit, such as `1.5 GiB`.
pub fn format_bytes(bytes: u64) -> String {
    ByteSize(bytes).display().iec().to_string()
}
