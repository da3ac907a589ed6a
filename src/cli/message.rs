//! Messages on standard error. This is the one place that writes there; lints refuse others.

use std::io::{self, IsTerminal, Write};

use splatsieve::error::printable;

#[expect(clippy::disallowed_methods, reason = "the one place that writes to standard error")]
fn stderr() -> io::Stderr {
    io::stderr()
}

/// Writes `text` and a line feed to standard error, control characters by their codes. A standard error that is full,
/// closed or has no reader is no failure: the exit code still tells how the run ended.
pub(super) fn tell(text: &str) {
    let line = format!("{}\n", printable(text));
    let mut stderr = stderr().lock();
    let _ = stderr.write_all(line.as_bytes()).and_then(|()| stderr.flush());
}

/// Whether standard error is a terminal.
pub(super) fn is_terminal() -> bool {
    stderr().is_terminal()
}
