//! What can go wrong, sorted by what the caller can do about it.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

pub use gseq::{ShowPath, printable, quoted};

/// Result of anything that can fail here.
pub type Result<T> = std::result::Result<T, Error>;

/// Every failure of this library.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file holds something other than what it must hold: mend or replace the file.
    #[error("{0}")]
    Input(Box<InputError>),
    /// The operating system refused: check the path, the permissions, the space left.
    #[error("cannot {action} {path}: {source}{advice}", path = path.shown(), advice = advice(source))]
    Io {
        /// What was being done, as a verb: "open", "create", "rename".
        action: &'static str,
        /// The file it was done to.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The request itself makes no sense: change the arguments or the recipe. Exit code 2.
    #[error("{0}")]
    Usage(String),
    /// A run that was asked for a part of the work has done it. Exit code 0.
    #[error("{0}")]
    Stopped(String),
    /// Numbers that must agree do not: a broken build, or a broken machine.
    #[error("selfcheck failed: {0}\n  trust no result of this program on this machine, and report the table above")]
    Unsound(String),
    /// A `gseq` container is malformed.
    #[error(transparent)]
    Container(#[from] gseq::Error),
}

/// A malformed input: which file, where in it, what was expected, what was found, what to do.
#[derive(Debug)]
pub struct InputError {
    /// The file (or folder) that was read.
    pub path: PathBuf,
    /// The place in it: "byte 1234", "element vertex", "frame 12, Gaussian 7"; may be empty.
    pub place: String,
    /// What a valid file would hold there.
    pub expected: String,
    /// What this one holds.
    pub found: String,
    /// What to do next; may be empty.
    pub hint: String,
}

impl fmt::Display for InputError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.path.shown())?;
        if !self.place.is_empty() {
            write!(f, ", {}", self.place)?;
        }
        write!(f, ": expected {}, found {}", self.expected, self.found)?;
        if !self.hint.is_empty() {
            write!(f, "\n  {}", self.hint)?;
        }
        Ok(())
    }
}

fn advice(source: &io::Error) -> &'static str {
    match source.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            "\n  make room there, or name another place: the output with -o, scratch files with --scratch-dir"
        }
        _ => "",
    }
}

impl Error {
    /// A malformed input file; see [`InputError`].
    pub fn input(path: &Path, place: impl Into<String>, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Error::Input(Box::new(InputError {
            path: path.to_owned(),
            place: place.into(),
            expected: expected.into(),
            found: found.into(),
            hint: String::new(),
        }))
    }

    /// The same error with advice on what to do next.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        if let Error::Input(input) = &mut self {
            input.hint = hint.into();
        }
        self
    }

    /// A failed system call on `path`; use as `.map_err(Error::io("open", path))`.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Error::Io { action, path, source }
    }

    /// A request that makes no sense.
    pub fn usage(message: impl Into<String>) -> Self {
        Error::Usage(message.into())
    }
}
