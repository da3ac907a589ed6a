//! Errors, and the exit code of each kind of error.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

pub use gseq::{ShowPath, printable, quoted};

/// Result of anything that can fail here.
pub type Result<T> = std::result::Result<T, Error>;

/// Every failure of this library.
///
/// [`Error::kind`] says which kind a failure is of, and [`ErrorKind::exit_code`] how the command ends:
///
/// | exit code | kind | meaning |
/// |---|---|---|
/// | 0 | – | Done. Also: the part of the work that was asked for is done. |
/// | 1 | [`Input`](ErrorKind::Input) | A file that is read is missing, malformed, or larger than may be read. |
/// | 1 | [`Output`](ErrorKind::Output) | The result or a temporary file cannot be written. |
/// | 1 | [`Internal`](ErrorKind::Internal) | Splatsieve contradicts itself, or the self-check failed. |
/// | 2 | [`Usage`](ErrorKind::Usage) | The arguments or the recipe make no sense, or do not fit the input. |
/// | 2 | [`MemoryLimit`](ErrorKind::MemoryLimit) | The request takes more memory than `--memory` allows. |
/// | 128 + signal | [`Interrupted`](ErrorKind::Interrupted) | A signal ended the run. |
///
/// A panic is an internal fault too; the Rust runtime ends it with exit code 101.
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
    /// The request itself makes no sense: change the arguments or the recipe.
    #[error("{0}")]
    Usage(String),
    /// The request takes more memory than it may take: raise the limit.
    #[error("{0}")]
    MemoryLimit(String),
    /// Early end of a run that was asked for one part of the work and has done it. Stages return it to their callers; the
    /// public entry points of the library turn it into a success, so no caller of the library sees it.
    #[error("{0}")]
    ShardDone(String),
    /// The program contradicts itself, whatever the request and the input.
    #[error("internal error: {0}\n  this is a fault of splatsieve: report it with the command line and this message")]
    Internal(String),
    /// Numbers that must agree do not: a broken build, or a broken machine.
    #[error("selfcheck failed: {0}\n  trust no result of this program on this machine, and report the table above")]
    Unsound(String),
    /// A `gseq` container is malformed.
    #[error(transparent)]
    Container(#[from] gseq::Error),
}

/// Kind of a failure, which decides the exit code; see the table at [`Error`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorKind {
    /// The arguments or the recipe make no sense, or do not fit the input.
    Usage,
    /// A file that is read is missing, malformed, or larger than may be read.
    Input,
    /// The result or a temporary file cannot be written.
    Output,
    /// The request takes more memory than it may take.
    MemoryLimit,
    /// A signal ended the run. No [`Error`] is of this kind: the handler of the signal ends the process.
    Interrupted {
        /// Number of the signal.
        signal: u8,
    },
    /// The program contradicts itself, or the self-check failed.
    Internal,
}

impl ErrorKind {
    /// Returns the exit code of a process that ends with a failure of this kind.
    pub fn exit_code(self) -> u8 {
        match self {
            ErrorKind::Input | ErrorKind::Output | ErrorKind::Internal => 1,
            ErrorKind::Usage | ErrorKind::MemoryLimit => 2,
            ErrorKind::Interrupted { signal } => 128u8.saturating_add(signal),
        }
    }

    /// Returns the kind of a failed system call, by what was being done.
    fn from_action(action: &str) -> ErrorKind {
        const READING: [&str; 7] = ["open", "read", "list", "find", "map", "examine", "decompress"];
        let verb = action.split(' ').next().unwrap_or_default();
        // Only what this run wrote itself is read back.
        let is_reading = READING.contains(&verb) && !action.starts_with("read back");
        if is_reading { ErrorKind::Input } else { ErrorKind::Output }
    }
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

    /// A contradiction within the program.
    pub fn internal(message: impl Into<String>) -> Self {
        Error::Internal(message.into())
    }

    /// Returns the kind of this failure.
    pub fn kind(&self) -> ErrorKind {
        match self {
            Error::Usage(_) => ErrorKind::Usage,
            Error::MemoryLimit(_) => ErrorKind::MemoryLimit,
            Error::Input(_) | Error::Container(gseq::Error::Malformed { .. }) => ErrorKind::Input,
            Error::Io { action, .. } | Error::Container(gseq::Error::Io { action, .. }) => {
                ErrorKind::from_action(action)
            }
            Error::ShardDone(_) | Error::Internal(_) | Error::Unsound(_) | Error::Container(gseq::Error::Usage(_)) => {
                ErrorKind::Internal
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exit_codes_follow_from_the_kind() {
        let io = |action| Error::io(action, Path::new("x"))(io::Error::other("no"));
        for (error, kind, code) in [
            (Error::usage("no such frame"), ErrorKind::Usage, 2),
            (Error::MemoryLimit("--memory 1 MiB".to_owned()), ErrorKind::MemoryLimit, 2),
            (Error::input(Path::new("x"), "", "a PLY", "a text"), ErrorKind::Input, 1),
            (io("open"), ErrorKind::Input, 1),
            (io("read the size of"), ErrorKind::Input, 1),
            (io("read back values from"), ErrorKind::Output, 1),
            (io("create a folder in"), ErrorKind::Output, 1),
            (io("write"), ErrorKind::Output, 1),
            (Error::internal("frame 7 of 5"), ErrorKind::Internal, 1),
            (Error::Unsound("motion far away".to_owned()), ErrorKind::Internal, 1),
        ] {
            assert_eq!((error.kind(), error.kind().exit_code()), (kind, code), "{error}");
        }
        assert_eq!(ErrorKind::Interrupted { signal: 15 }.exit_code(), 143);
    }
}
