//! Standard output: data and results of commands. Only this module writes to standard output.

use std::io::{self, IsTerminal, Write};
use std::path::Path;

use super::message::show;
use splatsieve::error::{Error, Result, printable};
use splatsieve::files::atomic::is_standard_output_used;

/// Name of standard output in error messages.
const NAME: &str = "standard output";

/// Returns standard output.
#[expect(clippy::disallowed_methods, reason = "the one place that opens standard output")]
pub(super) fn stdout() -> io::Stdout {
    io::stdout()
}

/// Writes `text` to standard output, with control characters replaced by their codes.
///
/// # Errors
/// Fails if standard output cannot be written; see [`has_no_reader`].
pub(super) fn print(text: &str) -> Result<()> {
    write(printable(text).as_bytes())
}

/// Prints a result as JSON if `is_json`, else as text. `json` and `text` return the result in these two forms; only one
/// of them is called. In JSON, control characters are written as escapes.
///
/// # Errors
/// Fails as [`print`].
pub(super) fn print_as(is_json: bool, json: impl FnOnce() -> String, text: impl FnOnce() -> String) -> Result<()> {
    if is_json { write(json_escaped(&json()).as_bytes()) } else { print(&text()) }
}

/// Writes `bytes` unchanged to standard output. If the command wrote its result (such as a frame stream) to standard
/// output, writes them to standard error instead.
///
/// # Errors
/// Fails as [`print`].
pub(super) fn write(bytes: &[u8]) -> Result<()> {
    // Text after a result on standard output would corrupt the result.
    if is_standard_output_used() {
        show(String::from_utf8_lossy(bytes).trim_end());
        return Ok(());
    }
    let mut out = stdout().lock();
    out.write_all(bytes).and_then(|()| out.flush()).map_err(Error::io("write", Path::new(NAME)))
}

/// Prints a message of the argument parser clap: help and version to standard output, argument errors to standard
/// error.
///
/// # Errors
/// Fails as [`print`]. A failure to write to standard error is ignored.
pub(super) fn print_clap(error: &clap::Error) -> Result<()> {
    // The text contains escape sequences for colors, so it cannot be filtered here; the caller ensures that it quotes
    // no argument with control characters.
    let done = error.print().and_then(|()| if error.use_stderr() { Ok(()) } else { stdout().flush() });
    if error.use_stderr() { Ok(()) } else { done.map_err(Error::io("write", Path::new(NAME))) }
}

/// Returns whether `error` means that the reader of standard output has ended, as `head` does after it has read enough
/// lines.
pub(super) fn has_no_reader(error: &Error) -> bool {
    match error {
        Error::Io { source, path, .. } => source.kind() == io::ErrorKind::BrokenPipe && path == Path::new(NAME),
        _ => false,
    }
}

/// Returns whether standard output is a terminal.
pub(super) fn is_terminal() -> bool {
    stdout().is_terminal()
}

/// Replaces every character of the JSON text `text` that is unsafe on a terminal (see [`printable`]) by its JSON escape
/// `\uXXXX`, and returns the text. The encoded values stay the same, because in JSON these characters occur only inside
/// strings.
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
    fn escaped_json_parses_to_the_same_value() {
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
