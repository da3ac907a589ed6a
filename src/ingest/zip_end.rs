//! The end of a zip archive, checked before a reader of zip archives is given the file: such a reader makes room for as many
//! files as the end announces, and searches the whole file for records that are not where they should be.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

/// Most files of an archive.
const MOST_FILES: u64 = 4096;
/// Most bytes of the list of files.
const MOST_LIST: u64 = 4 << 20;
/// Bytes of the end record, of the locator of its 64-bit form, and of that form.
const END: usize = 22;
const LOCATOR: usize = 20;
const END_64: usize = 56;

/// Checks the end of the zip archive `file`, and leaves it at its beginning. The inner error says what was found.
pub(crate) fn check_end(file: &mut File) -> io::Result<Result<(), String>> {
    let length = file.seek(SeekFrom::End(0))?;
    let start = length.saturating_sub((END + usize::from(u16::MAX) + LOCATOR + END_64) as u64);
    file.seek(SeekFrom::Start(start))?;
    let mut tail = Vec::new();
    file.by_ref().take(length - start).read_to_end(&mut tail)?;
    file.seek(SeekFrom::Start(0))?;
    Ok(check_tail(&tail, start))
}

/// Checks the last bytes of an archive, which begin at byte `start`.
fn check_tail(tail: &[u8], start: u64) -> Result<(), String> {
    let end = (0..=tail.len().saturating_sub(END)).rev().find(|&at| tail[at..].starts_with(b"PK\x05\x06"));
    let Some(end) = end else { return Err("no list of files at the end".to_owned()) };
    let number = |at: usize, bytes: usize| {
        let digits = tail.get(at..at + bytes).unwrap_or_default();
        digits.iter().rev().fold(0u64, |sum, &digit| sum << 8 | u64::from(digit))
    };
    let mut found = [number(end + 8, 2), number(end + 10, 2), number(end + 12, 4)];
    let is_64 =
        found[..2].contains(&u64::from(u16::MAX)) || [found[2], number(end + 16, 4)].contains(&u64::from(u32::MAX));
    if is_64 {
        let record = end.checked_sub(LOCATOR + END_64);
        let record = record.filter(|&at| {
            tail[at..].starts_with(b"PK\x06\x06")
                && tail[at + END_64..].starts_with(b"PK\x06\x07")
                && number(at + END_64 + 8, 8) == start + at as u64
        });
        let Some(at) = record else { return Err("a list of files without its 64-bit record".to_owned()) };
        found = [number(at + 24, 8), number(at + 32, 8), number(at + 40, 8)];
    }
    let [here, files, list] = found;
    if here > MOST_FILES || files > MOST_FILES {
        return Err(format!("{} files, where at most {MOST_FILES} can be", here.max(files)));
    }
    if list > MOST_LIST {
        return Err(format!("a list of files of {list} bytes, where at most {MOST_LIST} can be"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn end(files: u16, list: u32) -> Vec<u8> {
        let mut out = b"PK\x05\x06\0\0\0\0".to_vec();
        out.extend([files.to_le_bytes(), files.to_le_bytes()].concat());
        out.extend([list.to_le_bytes(), 0u32.to_le_bytes()].concat());
        out.extend([0, 0]);
        out
    }

    fn end_64(at: u64, files: u64) -> Vec<u8> {
        let mut out = b"PK\x06\x06".to_vec();
        out.extend([0; 20]);
        [files, files, 100, 0].iter().for_each(|number| out.extend(number.to_le_bytes()));
        out.extend(b"PK\x06\x07\0\0\0\0");
        out.extend(at.to_le_bytes());
        out.extend([1, 0, 0, 0]);
        out.extend(end(u16::MAX, u32::MAX));
        out
    }

    #[test]
    fn announced_files_are_bounded_in_either_form() {
        assert!(check_tail(&end(7, 400), 0).is_ok());
        assert!(check_tail(&end(5000, 400), 0).unwrap_err().contains("5000 files"));
        assert!(check_tail(&end(7, 1 << 30), 0).unwrap_err().contains("list of files of"));
        assert!(check_tail(&end_64(10, 7), 10).is_ok());
        assert!(check_tail(&end_64(10, 1 << 40), 10).unwrap_err().contains("files, where"));
        assert!(check_tail(&end_64(11, 7), 10).unwrap_err().contains("64-bit record"));
        assert!(check_tail(b"no archive", 0).is_err() && check_tail(b"", 0).is_err());
    }
}
