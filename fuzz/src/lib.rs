//! Code of every fuzz target. Passes the bytes of the fuzzer to a reader of user-supplied bytes (an entry), and then
//! the same bytes with repaired checksums. A panic, a message with Rust debug text or too much memory ends the run.

#[path = "../../tests/corpus/entries.rs"]
#[allow(dead_code, reason = "libFuzzer is told where the corpus lies")]
mod entries;
#[path = "../../tests/corpus/memory.rs"]
mod memory;

use std::cell::OnceCell;
use std::sync::Once;

use entries::{ENTRIES, InputFolder};

#[doc(hidden)]
pub use libfuzzer_sys::fuzz_target;

#[global_allocator]
static ALLOCATOR: memory::Counting = memory::Counting;

static ONE_THREAD: Once = Once::new();

thread_local! {
    static FOLDER: OnceCell<InputFolder> = const { OnceCell::new() };
}

/// Runs the reader of the entry `name` on `bytes`.
///
/// # Panics
/// Panics if `Entry::check` does.
pub fn run(name: &str, bytes: &[u8]) {
    let entry = ENTRIES.iter().find(|entry| entry.name == name).expect("an entry of that name");
    // Work for a thread pool stays on this thread; otherwise most of the time is spent waiting for another one.
    ONE_THREAD.call_once(|| drop(rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global()));
    FOLDER.with(|folder| entry.check(bytes, folder.get_or_init(InputFolder::new)));
}

/// Defines the fuzz target that runs the entry with the given name.
#[macro_export]
macro_rules! target {
    ($name:literal) => {
        $crate::fuzz_target!(|bytes: &[u8]| $crate::run($name, bytes));
    };
}
