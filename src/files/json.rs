//! Streaming reader of JSON files.
//!
//! Input: the path of a file of any length. Output: the value built by a [`DeserializeSeed`]. Memory: a buffer of 64
//! KiB, one string, and the values that the seed keeps. A seed is a deserializer of serde that carries state. The
//! limits on strings, numbers and nesting depth are larger than in any camera file. They are checked before the parser
//! sees the bytes, because the parser keeps a whole string in memory.

mod checked;
pub(crate) mod lists;
pub(crate) mod small;

use std::cell::RefCell;
use std::io::Read;
use std::marker::PhantomData;
use std::path::Path;

use serde::de::DeserializeSeed;
use serde_json::Value;
use serde_json::error::Category;

use super::open::{open_file, read_small};
use crate::error::{Error, Result};
use checked::CheckedReader;

/// Slot for the error with which a seed (deserializer of a value) wants to stop the JSON parser. The seed cannot return
/// this error itself, because it must return an error of the parser's type.
#[derive(Debug, Default)]
pub(crate) struct ParseAbort(RefCell<Option<Error>>);

impl ParseAbort {
    /// Stores `error` and returns an error of the parser's type, with which a seed (deserializer of a value) stops the
    /// JSON parser. [`read`] then fails with `error`.
    pub(crate) fn by<E: serde::de::Error>(&self, error: Error) -> E {
        *self.0.borrow_mut() = Some(error);
        E::custom("stopped")
    }
}

/// Reads the JSON document in the file at `path` and returns the value that `seed` (a deserializer) builds from it.
/// `stopped` is the slot into which `seed` puts an error of its own before it stops; see [`ParseAbort`].
///
/// # Errors
/// Fails if the seed fails, the file cannot be read, the text is not UTF-8 or not JSON (the message names the place),
/// or if a string, a number or the nesting depth exceeds its limit.
pub(crate) fn read<T, S: for<'de> DeserializeSeed<'de, Value = T>>(
    path: &Path,
    stopped: &ParseAbort,
    seed: S,
) -> Result<T> {
    read_from(open_file(path)?, path, stopped, seed)
}

/// Reads the JSON document in the open `file` as [`read`] does, and returns the value that `seed` builds from it. Error
/// messages call the file `path`.
///
/// # Errors
/// Fails like [`read`].
pub(crate) fn read_from<T, S: for<'de> DeserializeSeed<'de, Value = T>>(
    file: impl Read,
    path: &Path,
    stopped: &ParseAbort,
    seed: S,
) -> Result<T> {
    let mut text = CheckedReader::new(file, path);
    let mut parser = serde_json::Deserializer::from_reader(&mut text);
    let read = seed.deserialize(&mut parser).and_then(|value| parser.end().map(|()| value));
    read.map_err(|error| {
        if let Some(error) = stopped.0.borrow_mut().take().or_else(|| text.refusal()) {
            return error;
        }
        let (line, column) = (error.line(), error.column());
        let place = format!("line {line}, column {column}");
        if error.classify() == Category::Eof {
            let found = if text.is_blank() { "an empty file" } else { "the end of the file within it" };
            return Error::input(path, place, "JSON", found)
                .hint("it was cut short when it was written or copied: write or copy it again");
        }
        let whole = error.to_string();
        let found = whole.strip_suffix(&format!(" at line {line} column {column}")).unwrap_or(&whole);
        let refused = Error::input(path, place, "JSON", found);
        let around = text.around();
        let is_number = ["NaN", "Infinity", "nan", "inf"]
            .iter()
            .any(|word| (0..3).any(|at| around.get(at..).is_some_and(|rest| rest.starts_with(word.as_bytes()))));
        match is_number {
            true => {
                refused.hint("NaN and Infinity are not JSON: if a pose holds them, remove that image from the file")
            }
            false => refused,
        }
    })
}

/// Reads the whole JSON document in the file at `path`, which may have at most `most_bytes` bytes.
///
/// # Errors
/// Fails like [`read_small`] and [`read`].
pub(crate) fn read_json(path: &Path, most_bytes: u64) -> Result<Value> {
    let bytes = read_small(path, most_bytes, "JSON")?;
    read_from(&bytes[..], path, &ParseAbort::default(), PhantomData::<Value>)
}

#[cfg(test)]
mod tests {
    use serde::de::IgnoredAny;

    use super::*;

    fn refused(bytes: &[u8]) -> String {
        read_from(bytes, Path::new("a.json"), &ParseAbort::default(), PhantomData::<Value>).unwrap_err().to_string()
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
        let read = |bytes: &[u8]| read_from(bytes, Path::new("a"), &ParseAbort::default(), PhantomData::<Value>);
        assert_eq!(read(b"\xef\xbb\xbf{\"a\": 1}").unwrap()["a"], 1);
        assert!(refused(b"\xef\xbb\xbf\"\xe9").contains("byte 4"));
    }

    #[test]
    fn values_equal_those_of_serde_json() {
        let text = r#" {"a\n\u00e9\ud83d\ude00": [1, -2.5e3, true, null, "\"[{\\", {}], "größe": [[[]]], "b": 18446744073709551615} "#;
        let read = read_from(text.as_bytes(), Path::new("a"), &ParseAbort::default(), PhantomData::<Value>).unwrap();
        assert_eq!(read, serde_json::from_str::<Value>(text).unwrap());
    }

    #[test]
    fn values_beyond_limits_are_refused_even_if_ignored() {
        let text = format!("{{\"a\": \"{}\"}}", "x".repeat(2 << 20));
        let escapes = format!("\"{}\"", "\\\"".repeat(1 << 20));
        let key = format!("{{\"{}\": 1}}", "k".repeat(2 << 20));
        let number = format!("[{}]", "7".repeat(5000));
        let fraction = format!("[0.{}]", "0".repeat(5000));
        let deep = "[".repeat(100_000);
        for (text, expected) in [
            (&text, "a text of at most"),
            (&escapes, "a text of at most"),
            (&key, "a text of at most"),
            (&number, "a number of at most"),
            (&fraction, "a number of at most"),
            (&deep, "nested at most"),
        ] {
            let ignored =
                read_from(text.as_bytes(), Path::new("a.json"), &ParseAbort::default(), PhantomData::<IgnoredAny>);
            for message in [refused(text.as_bytes()), ignored.unwrap_err().to_string()] {
                assert!(message.contains(expected) && message.contains("byte"), "{expected:?} is not in {message:?}");
            }
        }
    }
}
