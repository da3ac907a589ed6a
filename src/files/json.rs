//! Parser of JSON text that is in memory. Errors name the line and the column.

use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::text::read_text;
use crate::error::{Error, Result};

/// Parses the JSON document `text`, the content of the file at `path`. The result may borrow from the text.
///
/// # Errors
/// Fails if the text is not JSON or does not have the form of a `T`.
pub(crate) fn parse<'a, T: Deserialize<'a>>(text: &'a str, path: &Path) -> Result<T> {
    serde_json::from_str(text).map_err(|error| describe(&error, text, path))
}

/// Reads the JSON document in the file at `path`, which may have at most `most_bytes` bytes.
///
/// # Errors
/// Fails like [`read_text`] and [`parse`].
pub(crate) fn read_json(path: &Path, most_bytes: u64) -> Result<Value> {
    parse(&read_text(path, most_bytes)?, path)
}

/// Returns the message for `error`, with which serde_json refused `text`, the content of the file at `path`.
fn describe(error: &serde_json::Error, text: &str, path: &Path) -> Error {
    let (line, column) = (error.line(), error.column());
    let place = format!("line {line}, column {column}");
    if error.is_eof() {
        let found = if text.trim_ascii().is_empty() { "an empty file" } else { "the end of the file within it" };
        return Error::input(path, place, "JSON", found)
            .hint("it was cut short when it was written or copied: write or copy it again");
    }
    let whole = error.to_string();
    let found = whole.strip_suffix(&format!(" at line {line} column {column}")).unwrap_or(&whole);
    let expected = if error.is_data() { "JSON of the expected form" } else { "JSON" };
    let refused = Error::input(path, place, expected, found);
    // Search for the word from two bytes before the position: the parser may stop within it.
    let bytes = text.lines().nth(line.saturating_sub(1)).unwrap_or_default().as_bytes();
    let rest = bytes.get(column.saturating_sub(3)..).unwrap_or_default();
    let around = String::from_utf8_lossy(&rest[..rest.len().min(12)]).to_lowercase();
    if ["nan", "inf"].iter().any(|word| around.contains(word)) {
        return refused.hint("NaN and Infinity are not JSON: if a pose holds them, remove that image from the file");
    }
    refused
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::text::decode_text;

    fn read(bytes: &[u8]) -> Result<Value> {
        parse(decode_text(Path::new("a.json"), bytes)?, Path::new("a.json"))
    }

    fn refused(bytes: &[u8]) -> String {
        read(bytes).unwrap_err().to_string()
    }

    #[test]
    fn hints_match_the_error() {
        for (bytes, expected, absent) in [
            (&b"{\"frames\": [{\"a"[..], "cut short", "NaN"),
            (b"", "an empty file", "NaN"),
            (b" \n", "an empty file", "NaN"),
            (b"{\"a\": NaN}", "NaN and Infinity are not JSON", "cut short"),
            (b"{\"a\": NaN}", "line 1, column 7", "cut short"),
            (b"{\"a\": -Infinity}", "line 1, column 8", "cut short"),
            (b"{\"a\": \"caf\xe9\"}", "Latin-1", "NaN"),
            (b"\xff\xfe{\0}\0", "UTF-16", "Latin-1"),
            (b"{\"a\": 1,}", "line 1, column 9", "NaN"),
            (b"{\"a\"; 1}", "expected `:`", "NaN"),
            (b"[1] 2", "trailing characters", "NaN"),
        ] {
            let message = refused(bytes);
            assert!(message.contains(expected), "{expected:?} is not in {message:?}");
            assert!(!message.contains(absent) && !message.contains("at line"), "{absent:?} is in {message:?}");
        }
    }

    #[test]
    fn utf_8_byte_order_mark_is_skipped() {
        assert_eq!(read(b"\xef\xbb\xbf{\"a\": 1}").unwrap()["a"], 1);
        assert!(refused(b"\xef\xbb\xbf\"\xe9").contains("byte 4"));
    }
}
