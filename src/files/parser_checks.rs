//! Entry point for fuzzing the parser of pickles. It reads bytes in memory, because a fuzz target runs millions of inputs
//! and must not write files.

use super::pickle::Pickle;

/// Fuzzing entry point for the pickle parser: reads the pickle `bytes` with at most `memory` bytes of memory and
/// formats a description of each value, which must not panic. Returns the number of values; `None` if the pickle cannot
/// be read.
pub fn check_pickle(bytes: &[u8], memory: u64) -> Option<usize> {
    let pickle = Pickle::read(bytes, memory).ok()?;
    let described: usize = pickle.ids().map(|id| pickle.describe(id).len().min(1)).sum();
    let _ = (pickle.items(pickle.root()).map(Iterator::count), pickle.call(pickle.root()));
    Some(described)
}
