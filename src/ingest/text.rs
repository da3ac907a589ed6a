//! Text files as people and editors leave them: UTF-8, with or without its byte order mark.

use std::io::Read;
use std::path::Path;

use serde_json::Value;
use serde_json::error::Category;

use super::open::open_file;
use crate::error::{Error, Result};

/// Largest text that is read: the cameras of 10⁵ pictures take some 60 MB of JSON.
const MAX_BYTES: u64 = 256 << 20;

/// The bytes of a file no larger than the limit.
///
/// # Errors
/// A file that cannot be read, or is larger.
pub fn read_limited(path: &Path) -> Result<Vec<u8>> {
    let file = open_file(path)?;
    let mut bytes = Vec::new();
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(Error::io("read", path))?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(Error::input(path, "", format!("a file of at most {MAX_BYTES} bytes"), "a larger one"));
    }
    Ok(bytes)
}

/// The text of a file, without a byte order mark.
///
/// # Errors
/// Those of [`read_limited`]; bytes that are no UTF-8, with the place of the first.
pub fn read_text(path: &Path) -> Result<String> {
    let bytes = read_limited(path)?;
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
    if let [0xff, 0xfe, ..] | [0xfe, 0xff, ..] = text {
        return Err(
            Error::input(path, "byte 0", "text in UTF-8", "the byte order mark of UTF-16").hint("save it as UTF-8")
        );
    }
    match str::from_utf8(text) {
        Ok(text) => Ok(text.to_owned()),
        Err(error) => {
            let at = error.valid_up_to();
            let place = format!("byte {}", at + bytes.len() - text.len());
            Err(Error::input(path, place, "text in UTF-8", format!("the byte 0x{:02x}", text[at]))
                .hint("save it as UTF-8: it may be in Latin-1 or another encoding"))
        }
    }
}

/// The JSON document in a file.
///
/// # Errors
/// Those of [`read_text`]; what is no JSON, with line and column.
pub fn read_json(path: &Path) -> Result<Value> {
    let text = read_text(path)?;
    serde_json::from_str(&text).map_err(|error| {
        let (line, column) = (error.line(), error.column());
        let whole = error.to_string();
        let found = whole.strip_suffix(&format!(" at line {line} column {column}")).unwrap_or(&whole);
        if error.classify() == Category::Eof {
            let found = if text.trim().is_empty() { "an empty file" } else { "the end of the file within it" };
            return Error::input(path, format!("line {line}, column {column}"), "JSON", found)
                .hint("it was cut short when it was written or copied: write or copy it again");
        }
        let here = text.lines().nth(line.saturating_sub(1)).unwrap_or("");
        let before = (0..column.min(here.len())).rev().find(|&at| here.is_char_boundary(at)).unwrap_or(0);
        let is_number =
            ["NaN", "Infinity", "-Infinity", "nan", "inf"].iter().any(|word| here[before..].starts_with(word));
        let error = Error::input(path, format!("line {line}, column {column}"), "JSON", found);
        match is_number {
            true => error.hint("NaN and Infinity are no JSON: if a pose holds them, take the picture out of the file"),
            false => error,
        }
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn refused(bytes: &[u8]) -> String {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), bytes).unwrap();
        read_json(file.path()).unwrap_err().to_string()
    }

    #[test]
    fn hints_fit_what_is_wrong() {
        for (bytes, expected, absent) in [
            (&b"{\"frames\": [{\"a"[..], "cut short", "NaN"),
            (b"", "an empty file", "NaN"),
            (b"{\"a\": NaN}", "NaN and Infinity are no JSON", "cut short"),
            (b"{\"a\": -Infinity}", "line 1, column 8", "cut short"),
            (b"{\"a\": \"caf\xe9\"}", "Latin-1", "NaN"),
            (b"\xff\xfe{\0}\0", "UTF-16", "Latin-1"),
            (b"{\"a\": 1,}", "line 1, column 9", "NaN"),
            (b"{\"a\"; 1}", "expected `:`", "NaN"),
        ] {
            let message = refused(bytes);
            assert!(message.contains(expected), "{expected:?} is not in {message:?}");
            assert!(!message.contains(absent) && !message.contains("at line"), "{absent:?} is in {message:?}");
        }
    }

    #[test]
    fn a_byte_order_mark_of_utf_8_is_passed_over() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), b"\xef\xbb\xbf{\"a\": 1}").unwrap();
        assert_eq!(read_json(file.path()).unwrap()["a"], 1);
        assert!(refused(b"\xef\xbb\xbf\"\xe9").contains("byte 4"));
    }
}
