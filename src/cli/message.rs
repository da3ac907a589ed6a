//! Messages on standard error. Only this module writes to standard error; Clippy lints reject such writes elsewhere.

use std::io::{self, IsTerminal, Write};

use splatsieve::error::printable;

/// Returns standard error.
#[expect(clippy::disallowed_methods, reason = "the one place that writes to standard error")]
fn stderr() -> io::Stderr {
    io::stderr()
}

/// Writes `text` and a line feed to standard error, with control characters replaced by their codes. Ignores failures
/// to write: the exit code still tells how the run ended.
pub(super) fn show(text: &str) {
    let line = format!("{}\n", printable(text));
    let mut stderr = stderr().lock();
    let _ = stderr.write_all(line.as_bytes()).and_then(|()| stderr.flush());
}

/// Returns whether standard error is a terminal.
pub(super) fn is_terminal() -> bool {
    stderr().is_terminal()
}
