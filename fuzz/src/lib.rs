//! What every fuzz target does: it hands bytes to the entry of its name, and then the same bytes with their checksums put
//! right. A panic, a message with Rust's own text in it or too much memory ends the run.

#[path = "../../tests/corpus/entries.rs"]
#[allow(dead_code, reason = "libFuzzer is told where the corpus lies")]
mod entries;
#[path = "../../tests/corpus/memory.rs"]
mod memory;

use std::cell::OnceCell;
use std::sync::Once;

use entries::{ENTRIES, Place};

#[doc(hidden)]
pub use libfuzzer_sys::fuzz_target;

#[global_allocator]
static ALLOCATOR: memory::Counting = memory::Counting;

static ALONE: Once = Once::new();

thread_local! {
    static PLACE: OnceCell<Place> = const { OnceCell::new() };
}

/// Runs the entry `name` on `bytes`.
///
/// # Panics
/// Where the entry breaks a promise.
pub fn run(name: &str, bytes: &[u8]) {
    let entry = ENTRIES.iter().find(|entry| entry.name == name).expect("an entry of that name");
    // Work that goes to a pool of threads stays on this one, or most of the time goes into waiting for another.
    ALONE.call_once(|| drop(rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global()));
    PLACE.with(|place| entry.check(bytes, place.get_or_init(Place::new)));
}

/// The target of an entry.
#[macro_export]
macro_rules! target {
    ($name:literal) => {
        $crate::fuzz_target!(|bytes: &[u8]| $crate::run($name, bytes));
    };
}
