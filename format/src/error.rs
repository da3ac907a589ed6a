//! What can go wrong with a container, sorted by what the caller can do about it.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use crate::text::ShowPath;
pub(crate) use crate::text::quoted;

/// Result of anything that can fail here.
pub type Result<T> = std::result::Result<T, Error>;

/// Every failure of this crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file is not what SPEC.md describes: fetch it again, or save what is left with [`crate::recover`].
    #[error("{path}, byte {offset}: expected {expected}, found {found}{advice}", path = path.shown(), advice = Advice(hint))]
    Malformed {
        /// The file that was read.
        path: PathBuf,
        /// Where in it, from its first byte.
        offset: u64,
        /// What a valid file holds there.
        expected: String,
        /// What this one holds.
        found: String,
        /// What to do next; may be empty.
        hint: &'static str,
    },
    /// The operating system refused: check the path, the permissions, the space left.
    #[error("cannot {action} {path}: {source}", path = path.shown())]
    Io {
        /// What was being done, as a verb: "open", "create", "rename".
        action: &'static str,
        /// The file it was done to.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The call itself makes no sense: a layout outside its limits, a tile written twice, a tile that does not exist.
    #[error("{0}")]
    Usage(String),
}

struct Advice<'a>(&'a str);

impl fmt::Display for Advice<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() { Ok(()) } else { write!(f, "\n  {}", self.0) }
    }
}

impl Error {
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Error::Io { action, path, source }
    }

    pub(crate) fn usage(message: impl Into<String>) -> Self {
        Error::Usage(message.into())
    }
}

/// A malformed place in a file whose name is not known here; see [`Error::Malformed`].
#[derive(Debug)]
pub(crate) struct Fault {
    offset: u64,
    expected: String,
    found: String,
    hint: &'static str,
}

impl Fault {
    pub(crate) fn new(offset: u64, expected: impl Into<String>, found: impl fmt::Display) -> Self {
        Fault { offset, expected: expected.into(), found: found.to_string(), hint: "" }
    }

    pub(crate) fn hint(mut self, hint: &'static str) -> Self {
        self.hint = hint;
        self
    }

    pub(crate) fn at(self, path: &Path) -> Error {
        let Fault { offset, expected, found, hint } = self;
        Error::Malformed { path: path.to_owned(), offset, expected, found, hint }
    }
}
