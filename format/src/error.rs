//! Errors of this crate, grouped by what the caller can do about them.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use crate::text::ShowPath;
pub(crate) use crate::text::quoted;

/// Result of every fallible function of this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Error of every operation of this crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file violates SPEC.md: fetch it again, or save its intact part with [`crate::recover`].
    #[error("{path}, byte {offset}: expected {expected}, found {found}{advice}", path = path.shown(), advice = Advice(hint))]
    Malformed {
        /// Path of the malformed file.
        path: PathBuf,
        /// Offset of the first wrong byte from the start of the file.
        offset: u64,
        /// Content that a valid file has at this offset.
        expected: String,
        /// Content that this file has at this offset.
        found: String,
        /// Advice to the user on what to do next; may be empty.
        hint: &'static str,
    },
    /// The operating system refused an operation: check the path, the permissions and the free space.
    #[error("cannot {action} {path}: {source}", path = path.shown())]
    Io {
        /// Operation that failed, as a verb such as "open", "create" or "rename".
        action: &'static str,
        /// File or folder to which the operation was applied.
        path: PathBuf,
        /// Error that the operating system reported.
        source: io::Error,
    },
    /// The caller passed invalid arguments: a layout outside its limits, a tile written twice, a tile that does not
    /// exist.
    #[error("{0}")]
    Usage(String),
}

/// Advice of an error message, displayed on a line of its own. Empty advice displays as nothing.
struct Advice<'a>(&'a str);

impl fmt::Display for Advice<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() { Ok(()) } else { write!(f, "\n  {}", self.0) }
    }
}

impl Error {
    /// Returns a closure that turns an error of the operating system into an [`Error::Io`]. `action` is the operation
    /// that failed, applied to `path`.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Error::Io { action, path, source }
    }

    /// Creates an [`Error::Usage`], the error about invalid arguments, with the text `message`.
    pub(crate) fn usage(message: impl Into<String>) -> Self {
        Error::Usage(message.into())
    }
}

/// Malformed place in a file, as in [`Error::Malformed`], without the path of the file; [`Fault::at`] adds the path.
#[derive(Debug)]
pub(crate) struct Fault {
    offset: u64,
    expected: String,
    found: String,
    hint: &'static str,
}

impl Fault {
    /// Creates a fault at byte `offset` of the file, without advice to the user.
    pub(crate) fn new(offset: u64, expected: impl Into<String>, found: impl fmt::Display) -> Self {
        Fault { offset, expected: expected.into(), found: found.to_string(), hint: "" }
    }

    /// Sets the advice to the user on what to do next.
    pub(crate) fn hint(mut self, hint: &'static str) -> Self {
        self.hint = hint;
        self
    }

    /// Turns the fault into an [`Error::Malformed`] of the file at `path`.
    pub(crate) fn at(self, path: &Path) -> Error {
        let Fault { offset, expected, found, hint } = self;
        Error::Malformed { path: path.to_owned(), offset, expected, found, hint }
    }
}
