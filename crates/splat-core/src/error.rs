//! Errors of the library, and the exit code of the command for each kind of error.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

pub use gseq::{ShowPath, printable, quoted};

/// Result whose error type is [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// Failure of any operation of the library.
///
/// [`Error::kind`] returns the kind of a failure, and [`ErrorKind::exit_code`] the exit code of the command:
///
/// | exit code | kind | meaning |
/// |---|---|---|
/// | 0 | – | Success, or the requested shard (part) of the work is finished. |
/// | 1 | [`Input`](ErrorKind::Input) | An input file is missing, malformed, or larger than allowed. |
/// | 1 | [`Output`](ErrorKind::Output) | The result or a temporary file cannot be written. |
/// | 1 | [`Internal`](ErrorKind::Internal) | A bug in splatsieve, or the self-check failed. |
/// | 2 | [`Usage`](ErrorKind::Usage) | The arguments or the recipe are invalid, or do not fit the input. |
/// | 2 | [`MemoryLimit`](ErrorKind::MemoryLimit) | The request needs more memory than `--memory` allows. |
/// | 128 + signal | [`Interrupted`](ErrorKind::Interrupted) | A signal ended the run. |
///
/// A panic is also a bug. The Rust runtime then ends the process with exit code 101.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file has malformed content. The user should repair or replace the file.
    #[error("{0}")]
    Input(Box<InputError>),
    /// A system call failed. The user should check the path, the permissions and the free disk space.
    #[error("cannot {action} {path}: {source}{advice}", path = path.shown(), advice = advice(source))]
    Io {
        /// Attempted operation, as a verb for the message: "open", "create", "rename".
        action: &'static str,
        /// File or folder that the operation was applied to.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The request is invalid. The user should change the arguments or the recipe.
    #[error("{0}")]
    Usage(String),
    /// The request needs more memory than the limit (`--memory`) allows. The user should raise the limit.
    #[error("{0}")]
    MemoryLimit(String),
    /// The run was asked for one shard (one of n equal parts) of a stage, and this shard is finished, so the run ends
    /// early. Stages return this value to their callers; the public entry points of the library turn it into a success,
    /// so callers of the library never see it.
    #[error("{0}")]
    ShardDone(String),
    /// The program reached an inconsistent state, which no request or input should cause: a bug.
    #[error(
        "internal error: {0}\n  this is a bug in splatsieve: please report it with the command line and this message"
    )]
    Internal(String),
    /// Results of the self-check differ although they should agree: the program or the machine is defective.
    #[error(
        "selfcheck failed: {0}\n  do not trust results of this program on this machine, and report the table above"
    )]
    SelfCheckFailed(String),
    /// A `gseq` container (the file format for sequences of Gaussians) is malformed, or cannot be read or written.
    #[error(transparent)]
    Container(#[from] gseq::Error),
}

/// Kind of a failure, which decides the exit code. See the table at [`Error`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorKind {
    /// The arguments or the recipe are invalid, or do not fit the input.
    Usage,
    /// An input file is missing, malformed, or larger than allowed.
    Input,
    /// The result or a temporary file cannot be written.
    Output,
    /// The request needs more memory than the limit (`--memory`) allows.
    MemoryLimit,
    /// A signal ended the run. No [`Error`] has this kind, because the signal handler ends the process.
    Interrupted {
        /// Number of the signal.
        signal: u8,
    },
    /// A bug in splatsieve, or a failed self-check.
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

    /// Returns the kind of the error that a failed system call causes. `action` is the attempted operation, as a phrase
    /// for the message that begins with a verb ("open", "create a folder in"):
    ///
    /// - verb of reading, such as "open" or "list": input error;
    /// - any other verb: output error;
    /// - the action "read back", which reads a file that this run wrote: output error.
    fn from_action(action: &str) -> ErrorKind {
        const READING: [&str; 7] = ["open", "read", "list", "find", "map", "examine", "decompress"];
        let verb = action.split(' ').next().unwrap_or_default();
        // The action "read back" concerns files that this run wrote, so its failure is an output error.
        let is_reading = READING.contains(&verb) && !action.starts_with("read back");
        if is_reading { ErrorKind::Input } else { ErrorKind::Output }
    }
}

/// Description of a malformed input file: where the file is malformed, what was expected and found there, and advice
/// for the user.
#[derive(Debug)]
pub struct InputError {
    /// File or folder that was read.
    pub path: PathBuf,
    /// Place of the malformed content in the file, such as "byte 1234" or "frame 12, Gaussian 7". May be empty.
    pub place: String,
    /// Content that a valid file has at this place.
    pub expected: String,
    /// Content that this file has at this place.
    pub found: String,
    /// Advice to the user on what to do about the malformed file. May be empty.
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

/// Returns advice for the user, as a line to append to the message, if `source` says that the disk or the quota is
/// full. Returns an empty text for other errors.
fn advice(source: &io::Error) -> &'static str {
    match source.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            "\n  free disk space there, or choose another place: -o for the output, --scratch-dir for temporary files"
        }
        _ => "",
    }
}

impl Error {
    /// Creates the error of a malformed input file, without advice to the user ([`Error::hint`] adds it). The arguments
    /// are the fields of [`InputError`] with the same names.
    pub fn input(path: &Path, place: impl Into<String>, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Error::Input(Box::new(InputError {
            path: path.to_owned(),
            place: place.into(),
            expected: expected.into(),
            found: found.into(),
            hint: String::new(),
        }))
    }

    /// Adds advice for the user on the next step to an [`Error::Input`]. Leaves other errors unchanged.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        if let Error::Input(input) = &mut self {
            input.hint = hint.into();
        }
        self
    }

    /// Returns a function that converts the error of a failed system call on `path` to an [`Error::Io`]. Use it as
    /// `.map_err(Error::io("open", path))`.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Error::Io { action, path, source }
    }

    /// Creates the error of an invalid request.
    pub fn usage(message: impl Into<String>) -> Self {
        Error::Usage(message.into())
    }

    /// Creates the error of an inconsistent state inside the program, which is a bug.
    pub fn internal(message: impl Into<String>) -> Self {
        Error::Internal(message.into())
    }

    /// Returns the kind of this failure, which decides the exit code of the command.
    pub fn kind(&self) -> ErrorKind {
        match self {
            Error::Usage(_) => ErrorKind::Usage,
            Error::MemoryLimit(_) => ErrorKind::MemoryLimit,
            Error::Input(_) | Error::Container(gseq::Error::Malformed { .. }) => ErrorKind::Input,
            Error::Io { action, .. } | Error::Container(gseq::Error::Io { action, .. }) => {
                ErrorKind::from_action(action)
            }
            Error::ShardDone(_)
            | Error::Internal(_)
            | Error::SelfCheckFailed(_)
            | Error::Container(gseq::Error::Usage(_)) => ErrorKind::Internal,
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
            (Error::SelfCheckFailed("motion far away".to_owned()), ErrorKind::Internal, 1),
        ] {
            assert_eq!((error.kind(), error.kind().exit_code()), (kind, code), "{error}");
        }
        assert_eq!(ErrorKind::Interrupted { signal: 15 }.exit_code(), 143);
    }
}
