//! Converts the rows of text PLY files to the binary form of PLY, so that the same code reads text and binary files.
//!
//! Input: a header and the text after it. Output: little-endian rows of every element, appended to a scratch file.
//! Memory: one line of text.

use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::header::{Element, PlyHeader, Property, Scalar};
use crate::error::{Error, Result, quoted};

/// Constant part of the maximum length in bytes of a line of a text PLY file. The maximum for a line of n numbers is
/// `LINE_BYTES` + [`LINE_BYTES_PER_NUMBER`] · n.
const LINE_BYTES: u64 = 1 << 20;
/// Number of bytes that each number in a line of a text PLY file adds to the maximum length of the line. The longest
/// usual form of an f64 has 24 characters.
const LINE_BYTES_PER_NUMBER: u64 = 64;

/// Unnamed scratch file that holds the rows of any number of text PLY files in binary form. Created when the first text
/// file is read.
#[derive(Debug)]
pub(crate) struct TextStore {
    folder: PathBuf,
    file: Mutex<Option<Arc<File>>>,
}

/// Rows of a text PLY file, converted to binary form.
#[derive(Debug, Clone)]
pub(crate) struct TextRows {
    pub(super) file: Arc<File>,
    /// Byte range of the rows in the scratch file.
    pub(super) range: Range<u64>,
}

impl TextStore {
    /// Returns a store for the converted rows of text PLY files. It creates its scratch file in `folder` when the first
    /// rows are converted.
    pub(crate) fn new(folder: &Path) -> TextStore {
        TextStore { folder: folder.to_owned(), file: Mutex::new(None) }
    }

    /// Converts the text PLY file `text`, opened from `path`, to binary rows in the scratch file. `header` is its
    /// parsed header. Returns the byte range of the rows in the scratch file. Every line of the text holds one row.
    /// Blank lines are skipped; text after the last row is ignored.
    ///
    /// # Errors
    /// Fails, naming the line, if there are too few rows, if a row has too few or too many numbers, if a word is not a
    /// number of its type, or if a line is far longer than its numbers require. Also fails if the scratch file cannot
    /// be written.
    pub(super) fn convert(&self, path: &Path, header: &PlyHeader, mut text: File) -> Result<TextRows> {
        let failed = |action| Error::io(action, path);
        let whole = text.metadata().map_err(failed("read the size of"))?.len();
        check_counts(path, header, whole.saturating_sub(header.text.len() as u64))?;
        text.seek(SeekFrom::Start(header.text.len() as u64)).map_err(failed("read"))?;
        // Keep the scratch file locked until all rows are written, so that the rows of one file are contiguous.
        let mut slot = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let scratch = |action| Error::io(action, &self.folder);
        let file = match &*slot {
            Some(file) => Arc::clone(file),
            None => Arc::new(tempfile::tempfile_in(&self.folder).map_err(scratch("create a scratch file in"))?),
        };
        let start = (&*file).seek(SeekFrom::End(0)).map_err(scratch("write a scratch file in"))?;
        let mut out = BufWriter::with_capacity(1 << 18, &*file);
        let mut lines = AsciiLines { path, text: BufReader::new(text), number: header.lines, line: Vec::new() };
        let mut row_bytes = Vec::new();
        for element in header.elements.iter().filter(|element| !element.properties.is_empty()) {
            for row in 0..element.count {
                row_bytes.clear();
                lines.read_row(element, row, &mut row_bytes)?;
                out.write_all(&row_bytes).map_err(scratch("write a scratch file in"))?;
            }
        }
        out.flush().map_err(scratch("write a scratch file in"))?;
        drop(out);
        let end = (&*file).stream_position().map_err(scratch("write a scratch file in"))?;
        *slot = Some(Arc::clone(&file));
        Ok(TextRows { file, range: start..end })
    }
}

/// Checks that a text file can hold as many rows as its header declares. `available` is the number of bytes after the
/// header, and a number takes at least two of them: a digit and a separator.
fn check_counts(path: &Path, header: &PlyHeader, available: u64) -> Result<()> {
    for element in &header.elements {
        let least = element.count.checked_mul(2 * element.properties.len() as u64);
        if least.is_none_or(|least| least > available + 1) {
            let expected = format!("{} rows of {} numbers", element.count, element.properties.len());
            return Err(Error::input(path, place(element), expected, format!("{available} bytes of text"))
                .hint("the file is cut short or its header is wrong"));
        }
    }
    Ok(())
}

/// Reader of the lines after the header of a text PLY file.
struct AsciiLines<'a> {
    path: &'a Path,
    text: BufReader<File>,
    /// Number of the line read last, counted from 1.
    number: usize,
    line: Vec<u8>,
}

impl AsciiLines<'_> {
    /// Reads row `row` of `element` from the next line that is not blank, and appends its numbers in binary form to
    /// `out`.
    fn read_row(&mut self, element: &Element, row: u64, out: &mut Vec<u8>) -> Result<()> {
        let numbers = element.properties.len();
        if !self.read_line(numbers)? {
            let (expected, found) = (format!("{} rows", element.count), format!("{row} rows"));
            return Err(
                Error::input(self.path, place(element), expected, found).hint("the file is cut short; copy it again")
            );
        }
        let (path, number) = (self.path, self.number);
        let words = || self.line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let count = words().count();
        if count != numbers {
            let expected = format!("{numbers} numbers, as {} declares", place(element));
            return Err(Error::input(path, format!("line {number}"), expected, count.to_string()));
        }
        for (word, property) in words().zip(&element.properties) {
            push_number(out, word, property.scalar).ok_or_else(|| unreadable(path, number, property, word))?;
        }
        Ok(())
    }

    /// Reads the next line that is not blank, which should hold `numbers` numbers. Returns false at the end of the
    /// file.
    fn read_line(&mut self, numbers: usize) -> Result<bool> {
        let most = LINE_BYTES + LINE_BYTES_PER_NUMBER * numbers as u64;
        loop {
            self.line.clear();
            let read = self.text.by_ref().take(most).read_until(b'\n', &mut self.line);
            if read.map_err(Error::io("read", self.path))? == 0 {
                return Ok(false);
            }
            self.number += 1;
            if self.line.len() as u64 == most {
                let expected = format!("a row of {numbers} numbers");
                let place = format!("line {}", self.number);
                return Err(Error::input(self.path, place, expected, format!("a line of more than {most} bytes"))
                    .hint("the file is damaged: a text body has one row per line"));
            }
            if !self.line.trim_ascii().is_empty() {
                return Ok(true);
            }
        }
    }
}

/// Returns the text by which error messages name `element`.
fn place(element: &Element) -> String {
    format!("element {}", element.name)
}

/// Returns the error for `word` in line `line` of a text PLY file, which is not a number of the type of `property`.
fn unreadable(path: &Path, line: usize, property: &Property, word: &[u8]) -> Error {
    let expected = format!("a number of type {} for property {}", property.scalar.name(), quoted(&property.name));
    let word = String::from_utf8_lossy(&word[..word.len().min(60)]);
    Error::input(path, format!("line {line}"), expected, quoted(&word))
}

/// Converts the number `word` to binary form, in the type `scalar`, and appends it to `out`. Returns `None` if `word`
/// is not a number of this type.
fn push_number(out: &mut Vec<u8>, word: &[u8], scalar: Scalar) -> Option<()> {
    let word = std::str::from_utf8(word).ok()?;
    match scalar {
        Scalar::I8 => out.extend(word.parse::<i8>().ok()?.to_le_bytes()),
        Scalar::U8 => out.extend(word.parse::<u8>().ok()?.to_le_bytes()),
        Scalar::I16 => out.extend(word.parse::<i16>().ok()?.to_le_bytes()),
        Scalar::U16 => out.extend(word.parse::<u16>().ok()?.to_le_bytes()),
        Scalar::I32 => out.extend(word.parse::<i32>().ok()?.to_le_bytes()),
        Scalar::U32 => out.extend(word.parse::<u32>().ok()?.to_le_bytes()),
        Scalar::F32 => out.extend(word.parse::<f32>().ok()?.to_le_bytes()),
        Scalar::F64 => out.extend(word.parse::<f64>().ok()?.to_le_bytes()),
    }
    Some(())
}
