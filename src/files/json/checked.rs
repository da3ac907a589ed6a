//! Checks the bytes of a JSON file before the parser sees them: they must be UTF-8, and strings, numbers and nesting
//! depth must not exceed their limits.

use std::io::{Error as IoError, ErrorKind, Read, Result as IoResult};
use std::path::{Path, PathBuf};

use crate::error::Error;
use crate::files::text::{not_utf_8, without_mark};

/// Size in bytes of the buffer through which a JSON file is read. The file is read and checked in blocks of at most
/// this size.
const BUFFER: usize = 1 << 16;
/// Maximum length in bytes of a string in a JSON file, without its quotes.
const MAX_TEXT: u32 = 1 << 20;
/// Maximum length in bytes of a number in a JSON file.
const MAX_NUMBER: u32 = 1 << 10;
/// Maximum nesting depth of lists and objects in a JSON file.
const MAX_DEPTH: u32 = 64;

/// Kind of the JSON token that contains the last byte read. It determines the meaning of the next byte.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Token {
    None,
    Text,
    /// Backslash in a string: the next byte is escaped.
    Escape,
    /// Number or keyword (`true`, `false` or `null`).
    Word,
}

/// Reader that passes on the text of a JSON file to the parser. Fails for bytes that are not UTF-8, and for strings,
/// numbers or nesting depths that exceed their limits.
#[derive(Debug)]
pub(super) struct CheckedReader<R> {
    file: R,
    path: PathBuf,
    buffer: Vec<u8>,
    /// Number of bytes at the start of the buffer that the parser has taken.
    taken: usize,
    /// Number of bytes at the start of the buffer that have been checked.
    checked: usize,
    /// Number of bytes of the buffer that have been read from the file. All of them have been checked, except up to 3
    /// bytes of an incomplete character at their end.
    filled: usize,
    /// Offset in the file of the first byte of `buffer`.
    start: u64,
    is_begun: bool,
    is_blank: bool,
    token: Token,
    token_bytes: u32,
    depth: u32,
    refusal: Option<Error>,
}

impl<R: Read> CheckedReader<R> {
    /// Creates a checked reader of `file`; error messages call the file `path`.
    pub(super) fn new(file: R, path: &Path) -> CheckedReader<R> {
        CheckedReader {
            file,
            path: path.to_owned(),
            buffer: vec![0; BUFFER],
            taken: 0,
            checked: 0,
            filled: 0,
            start: 0,
            is_begun: false,
            is_blank: true,
            token: Token::None,
            token_bytes: 0,
            depth: 0,
            refusal: None,
        }
    }

    /// Removes and returns the error that stopped reading, if there was one.
    pub(super) fn refusal(&mut self) -> Option<Error> {
        self.refusal.take()
    }

    /// Returns whether all text read so far is white space.
    pub(super) fn is_blank(&self) -> bool {
        self.is_blank
    }

    /// Returns bytes of the file around the position of the parser, for error messages: the last two bytes that the
    /// parser has taken, and at least 14 bytes after them unless the file ends earlier.
    pub(super) fn around(&mut self) -> Vec<u8> {
        let mut around = self.buffer[self.taken.saturating_sub(2)..self.checked].to_vec();
        if around.len() < 16 && self.fill().is_ok() {
            around.extend(&self.buffer[..self.checked.min(16)]);
        }
        around
    }

    /// Reads the next bytes of the file into the buffer. The bytes already checked are dropped from it; an incomplete
    /// character at the end stays.
    fn fill(&mut self) -> IoResult<()> {
        if self.refusal.is_some() {
            return Err(ErrorKind::InvalidData.into());
        }
        self.buffer.copy_within(self.checked..self.filled, 0);
        self.start += self.checked as u64;
        self.filled -= self.checked;
        (self.taken, self.checked) = (0, 0);
        // Read again if only a few bytes arrive: a byte order mark has three bytes, a character up to four.
        loop {
            let count = match self.file.read(&mut self.buffer[self.filled..]) {
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) => {
                    self.refusal = Some(Error::io("read", &self.path)(IoError::new(error.kind(), error.to_string())));
                    return Err(ErrorKind::Other.into());
                }
                Ok(count) => count,
            };
            self.filled += count;
            if !self.is_begun && (count == 0 || self.filled >= 3) {
                self.is_begun = true;
                match without_mark(&self.path, &self.buffer[..self.filled]) {
                    Ok(text) => {
                        let mark = self.filled - text.len();
                        (self.taken, self.checked) = (mark, mark);
                    }
                    Err(error) => return self.refuse(0, error),
                }
            }
            if self.is_begun {
                self.check(count == 0)?;
            }
            if self.checked > self.taken || count == 0 {
                return Ok(());
            }
        }
    }

    /// Refuses the byte at index `at` of the buffer: stores `error`, which describes the reason, so that the parser
    /// gets no byte from there on.
    ///
    /// - If the parser has not taken all bytes before `at`, returns `Ok`. The parser gets these bytes first, because
    ///   they may contain an earlier error, and the next read fails.
    /// - If the parser has taken all of them, returns an I/O error at once.
    fn refuse(&mut self, at: usize, error: Error) -> IoResult<()> {
        self.refusal = Some(error);
        // If there are bytes before the invalid one, pass them on first: they may contain an earlier error that the
        // parser reports.
        match at > self.taken {
            true => Ok(()),
            false => Err(ErrorKind::InvalidData.into()),
        }
    }

    /// Checks the bytes of the buffer that were read but not checked yet. They must be UTF-8 text, and the strings,
    /// numbers and nesting in them must not exceed their limits. At the first invalid byte, stops and calls
    /// [`CheckedReader::refuse`]. If `is_end` is true, the file ends after these bytes, and an incomplete character at
    /// the end is an error. If it is false, such a character stays unchecked until more bytes are read.
    fn check(&mut self, is_end: bool) -> IoResult<()> {
        let from = self.checked;
        let bad = match str::from_utf8(&self.buffer[from..self.filled]) {
            Ok(_) => None,
            Err(error) => Some((from + error.valid_up_to(), error.error_len().is_some() || is_end)),
        };
        let valid = bad.map_or(self.filled, |(at, _)| at);
        for at in from..valid {
            if let Some(expected) = self.step(self.buffer[at]) {
                self.checked = at;
                let place = format!("byte {}", self.start + at as u64);
                let error = Error::input(&self.path, place, expected, "more");
                return self.refuse(at, error.hint("check that this is a file of cameras"));
            }
        }
        self.checked = valid;
        match bad {
            Some((at, true)) => {
                let error = not_utf_8(&self.path, self.start + at as u64, self.buffer[at]);
                self.refuse(at, error)
            }
            _ => Ok(()),
        }
    }

    /// Advances the state of the check by `byte`, the next byte of the file: the kind and length of the present token,
    /// and the nesting depth. Returns `None` if no limit is exceeded, else a description of the limit for the message.
    fn step(&mut self, byte: u8) -> Option<String> {
        if self.is_blank && !byte.is_ascii_whitespace() {
            self.is_blank = false;
        }
        self.token_bytes = self.token_bytes.saturating_add(1);
        self.token = match (self.token, byte) {
            (Token::Text, b'"') => Token::None,
            (Token::Text, b'\\') => Token::Escape,
            (Token::Text | Token::Escape, _) if self.token_bytes > MAX_TEXT => {
                return Some(format!("a text of at most {MAX_TEXT} bytes"));
            }
            (Token::Text | Token::Escape, _) => Token::Text,
            (_, b'"') => {
                self.token_bytes = 0;
                Token::Text
            }
            (Token::Word, b'0'..=b'9' | b'a'..=b'z' | b'A'..=b'Z' | b'+' | b'-' | b'.') => {
                if self.token_bytes > MAX_NUMBER {
                    return Some(format!("a number of at most {MAX_NUMBER} characters"));
                }
                Token::Word
            }
            (_, b'0'..=b'9' | b'a'..=b'z' | b'A'..=b'Z' | b'+' | b'-' | b'.') => {
                self.token_bytes = 1;
                Token::Word
            }
            (_, b'[' | b'{') => {
                self.depth += 1;
                if self.depth > MAX_DEPTH {
                    return Some(format!("lists and objects nested at most {MAX_DEPTH} deep"));
                }
                Token::None
            }
            (_, b']' | b'}') => {
                self.depth = self.depth.saturating_sub(1);
                Token::None
            }
            _ => Token::None,
        };
        None
    }
}

impl<R: Read> Read for CheckedReader<R> {
    #[inline]
    fn read(&mut self, out: &mut [u8]) -> IoResult<usize> {
        if self.taken == self.checked {
            self.fill()?;
        }
        let rest = &self.buffer[self.taken..self.checked];
        let count = rest.len().min(out.len());
        out[..count].copy_from_slice(&rest[..count]);
        self.taken += count;
        Ok(count)
    }
}
