//! Readers of text files in UTF-8, with or without a byte order mark, and JSON text for output.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use serde::{Serialize, Serializer};

use super::open::{open_file, read_small};
use crate::error::{Error, Result};

/// Returns `value` as indented JSON that ends with a line feed.
///
/// # Panics
/// Panics if the serializer of `value` fails, which the derived ones of results never do.
pub fn json_text(value: &impl Serialize) -> String {
    let mut text = serde_json::to_string_pretty(value).expect("plain data");
    text.push('\n');
    text
}

/// Serializes a path as text. Bytes that are not UTF-8 become replacement characters, as in messages.
///
/// # Errors
/// Fails if the serializer fails.
pub fn serialize_path<S: Serializer>(path: &Path, serializer: S) -> std::result::Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.to_string_lossy())
}

/// Reads the text file at `path`, which may have at most `most_bytes` bytes, and removes a byte order mark.
///
/// # Errors
/// Fails like [`read_small`] and [`decode_text`].
pub fn read_text(path: &Path, most_bytes: u64) -> Result<String> {
    decode_text(path, &read_small(path, most_bytes, "a text")?).map(str::to_owned)
}

/// Returns `bytes`, the content of the file at `path`, as text without a byte order mark.
///
/// # Errors
/// Fails if the text is not UTF-8; the message then names the first invalid byte.
pub(super) fn decode_text<'a>(path: &Path, bytes: &'a [u8]) -> Result<&'a str> {
    let text = without_mark(path, bytes)?;
    utf_8(path, text, (bytes.len() - text.len()) as u64)
}

/// Returns `bytes`, the first bytes of the file at `path`, without a UTF-8 byte order mark.
///
/// # Errors
/// Fails if `bytes` begin with a UTF-16 byte order mark.
fn without_mark<'a>(path: &Path, bytes: &'a [u8]) -> Result<&'a [u8]> {
    if let [0xff, 0xfe, ..] | [0xfe, 0xff, ..] = bytes {
        let found = "the byte order mark of UTF-16";
        return Err(Error::input(path, "byte 0", "text in UTF-8", found).hint("save it as UTF-8"));
    }
    Ok(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes))
}

/// Returns `bytes` as text. The bytes begin at offset `start` of the file at `path`. Fails if they are not UTF-8.
fn utf_8<'a>(path: &Path, bytes: &'a [u8], start: u64) -> Result<&'a str> {
    str::from_utf8(bytes).map_err(|error| {
        let at = error.valid_up_to();
        let place = format!("byte {}", start + at as u64);
        Error::input(path, place, "text in UTF-8", format!("the byte 0x{:02x}", bytes[at]))
            .hint("save it as UTF-8: it may be in Latin-1 or another encoding")
    })
}

/// Maximum length in bytes of a line that [`TextLines`] returns.
const MAX_LINE: u64 = 1 << 16;

/// Reader that returns the lines of a text file one by one; the file may have any length.
#[derive(Debug)]
pub(crate) struct TextLines {
    path: PathBuf,
    file: BufReader<File>,
    line: Vec<u8>,
    number: usize,
    /// Offset of the next line in the file, in bytes.
    at: u64,
}

impl TextLines {
    /// Opens the text file at `path`.
    ///
    /// # Errors
    /// Fails if the file cannot be opened.
    pub(crate) fn open(path: &Path) -> Result<TextLines> {
        let file = BufReader::new(open_file(path)?);
        Ok(TextLines { path: path.to_owned(), file, line: Vec::new(), number: 0, at: 0 })
    }

    /// Returns the number (from 1) and the text of the next line without its line ending; `None` at the end of the
    /// file.
    ///
    /// # Errors
    /// Fails if the line is too long or not UTF-8, or if reading fails.
    pub(crate) fn next_line(&mut self) -> Result<Option<(usize, &str)>> {
        self.line.clear();
        let mut limited = (&mut self.file).take(MAX_LINE + 1);
        let count = limited.read_until(b'\n', &mut self.line).map_err(Error::io("read", &self.path))? as u64;
        if count == 0 {
            return Ok(None);
        }
        self.number += 1;
        let start = self.at;
        self.at += count;
        if count > MAX_LINE {
            let place = format!("line {}", self.number);
            return Err(Error::input(&self.path, place, format!("a line of at most {MAX_LINE} bytes"), "a longer one"));
        }
        let line = self.line.strip_suffix(b"\n").unwrap_or(&self.line);
        let line = line.strip_suffix(b"\r").unwrap_or(line);
        let text = if start == 0 { without_mark(&self.path, line)? } else { line };
        Ok(Some((self.number, utf_8(&self.path, text, start + (line.len() - text.len()) as u64)?)))
    }

    /// Skips the next line, whatever its length is.
    ///
    /// # Errors
    /// Fails if reading fails.
    pub(crate) fn skip_line(&mut self) -> Result<()> {
        self.at += self.file.skip_until(b'\n').map_err(Error::io("read", &self.path))? as u64;
        self.number += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), bytes).unwrap();
        file
    }

    #[test]
    fn lines_are_those_of_the_whole_text() {
        for text in ["", "\n", "a", "a\n", "\na\r\n\r\nb\rc\n\n d ", "\u{feff}ä\nö"] {
            let file = file(text.as_bytes());
            let mut lines = TextLines::open(file.path()).unwrap();
            let mut found = Vec::new();
            while let Some((number, line)) = lines.next_line().unwrap() {
                found.push(line.to_owned());
                assert_eq!(number, found.len());
            }
            assert_eq!(found, read_text(file.path(), 100).unwrap().lines().collect::<Vec<_>>(), "{text:?}");
        }
    }

    #[test]
    fn length_limit_applies_only_to_lines_read() {
        let long = [b"a\n".to_vec(), vec![b'x'; 1 << 20], b"\nb\n\xff\n".to_vec()].concat();
        let file = file(&long);
        let mut lines = TextLines::open(file.path()).unwrap();
        assert_eq!(lines.next_line().unwrap(), Some((1, "a")));
        lines.skip_line().unwrap();
        assert_eq!(lines.next_line().unwrap(), Some((3, "b")));
        assert!(lines.next_line().unwrap_err().to_string().contains("byte 1048581"));
        let mut lines = TextLines::open(file.path()).unwrap();
        lines.next_line().unwrap();
        assert!(lines.next_line().unwrap_err().to_string().contains("line 2: expected a line of at most 65536 bytes"));
    }

    #[test]
    fn other_encodings_are_named_in_errors() {
        let refused = |bytes: &[u8]| read_text(file(bytes).path(), 100).unwrap_err().to_string();
        assert!(refused(b"\xef\xbb\xbf\"\xe9").contains("byte 4") && refused(b"caf\xe9").contains("Latin-1"));
        assert!(refused(b"\xff\xfe{\0}\0").contains("UTF-16") && refused(&[b'a'; 101]).contains("at most 100 bytes"));
    }
}
