//! Standard output: data, and what a command says at its end. This is the one place that opens it.

use std::io::{self, IsTerminal, Write};
use std::path::Path;

use super::message::tell;
use splatsieve::error::{Error, Result, printable};
use splatsieve::files::atomic::is_standard_output_used;

/// What messages call standard output.
const NAME: &str = "standard output";

#[expect(clippy::disallowed_methods, reason = "the one place that opens standard output")]
pub(super) fn stdout() -> io::Stdout {
    io::stdout()
}

/// Writes `text`, control characters by their codes.
///
/// # Errors
/// A standard output that cannot be written; see [`has_no_reader`].
pub(super) fn print(text: &str) -> Result<()> {
    write(printable(text).as_bytes())
}

/// Writes `text`; if it is JSON, characters that could control a terminal are escaped as JSON has it.
///
/// # Errors
/// Those of [`print`].
pub(super) fn print_as(is_json: bool, text: &str) -> Result<()> {
    if is_json { write(json_escaped(text).as_bytes()) } else { print(text) }
}

/// Writes `bytes` as they are.
///
/// # Errors
/// Those of [`print`].
pub(super) fn write(bytes: &[u8]) -> Result<()> {
    // The result itself went there: a report behind it would corrupt it.
    if is_standard_output_used() {
        tell(String::from_utf8_lossy(bytes).trim_end());
        return Ok(());
    }
    let mut out = stdout().lock();
    out.write_all(bytes).and_then(|()| out.flush()).map_err(Error::io("write", Path::new(NAME)))
}

/// Writes what clap has to say: help and version to standard output, what is wrong with the arguments to standard error.
///
/// # Errors
/// Those of [`print`]; a standard error that cannot be written is none.
pub(super) fn print_clap(error: &clap::Error) -> Result<()> {
    // Its text has escape sequences of its own, for colors. So it must quote no argument that has some.
    let done = error.print().and_then(|()| if error.use_stderr() { Ok(()) } else { stdout().flush() });
    if error.use_stderr() { Ok(()) } else { done.map_err(Error::io("write", Path::new(NAME))) }
}

/// Whether `error` says that whoever read standard output has ended, as `head` does when it has seen enough.
pub(super) fn has_no_reader(error: &Error) -> bool {
    match error {
        Error::Io { source, path, .. } => source.kind() == io::ErrorKind::BrokenPipe && path == Path::new(NAME),
        _ => false,
    }
}

/// Whether standard output is a terminal.
pub(super) fn is_terminal() -> bool {
    stdout().is_terminal()
}

/// Returns a JSON text in which every character that [`printable`] replaces is escaped; such characters occur in its
/// strings alone.
fn json_escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        let mut buffer = [0; 4];
        match printable(c.encode_utf8(&mut buffer)) {
            std::borrow::Cow::Borrowed(_) => out.push(c),
            std::borrow::Cow::Owned(_) => {
                let mut units = [0; 2];
                out.extend(c.encode_utf16(&mut units).iter().map(|unit| format!("\\u{unit:04x}")));
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_says_the_same_without_control_characters() {
        let name = "a\u{9b}2J\u{202e}b\u{e0041}\u{7f}é";
        let text = serde_json::to_string(name).unwrap();
        let escaped = json_escaped(&text);
        assert_eq!(escaped, "\"a\\u009b2J\\u202eb\\udb40\\udc41\\u007fé\"");
        assert_eq!(serde_json::from_str::<String>(&escaped).unwrap(), name);
    }

    #[test]
    fn only_standard_output_may_lose_its_reader() {
        let broken = |path: &str| Error::io("write", Path::new(path))(io::ErrorKind::BrokenPipe.into());
        assert!(has_no_reader(&broken(NAME)));
        assert!(!has_no_reader(&broken("film.mp4")));
    }
}
