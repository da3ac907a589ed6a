//! Reads the size of the list of files that a zip archive declares at its end, and compares checksums of its files.
//! Readers of archives check the size before they allocate memory for the list.

use std::io::{Error, Read, Result, Seek, SeekFrom};
use std::path::Path;

/// Length in bytes of the end record (end of central directory) of a zip archive, without the comment that may follow
/// it.
const END_BYTES: u64 = 22;
/// Maximum length in bytes of the comment at the end of a zip archive.
const MAX_COMMENT: u64 = 0xffff;
/// Length in bytes of the ZIP64 locator: the record that contains the offset of the ZIP64 end record.
const LOCATOR_BYTES: u64 = 20;
/// Length in bytes of the ZIP64 end record (end of central directory with 64-bit numbers), without optional data.
const END_64_BYTES: u64 = 56;

/// Size of the list of files that a zip archive declares.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct DeclaredDirectory {
    /// Number of files in the archive.
    pub(crate) entries: u64,
    /// Number of bytes from the start of the list of files to the end of the archive.
    pub(crate) bytes: u64,
}

/// Reads the declared size of the list of files of the zip archive `file`, from the records at the end of the archive.
/// Finds these records in the same way as the crate `zip`, so the checked numbers are those that `zip` will use.
///
/// # Errors
/// Fails if there are no such records, or if reading fails.
pub(crate) fn declared_directory(file: &mut (impl Read + Seek)) -> Result<DeclaredDirectory> {
    let len = file.seek(SeekFrom::End(0))?;
    let missing = || Error::other("no list of files at its end");
    let tail_at = len.saturating_sub(LOCATOR_BYTES + END_BYTES + MAX_COMMENT);
    let mut tail = Vec::new();
    file.seek(SeekFrom::Start(tail_at))?;
    file.take(LOCATOR_BYTES + END_BYTES + MAX_COMMENT).read_to_end(&mut tail)?;
    let earliest = len.saturating_sub(END_BYTES + MAX_COMMENT) - tail_at;
    let last = tail.len().checked_sub(END_BYTES as usize).ok_or_else(missing)?;
    let end = (earliest as usize..=last).rev().find(|&at| tail[at..].starts_with(b"PK\x05\x06"));
    let end = end.ok_or_else(missing)?;
    let number = |bytes: &[u8], at: usize, width: usize| -> u64 {
        bytes[at..at + width].iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte))
    };
    let end_at = tail_at + end as u64;
    let comment = number(&tail, end + 20, 2);
    // Look where the crate `zip` looks: it computes the place of the 64-bit records from the length of the comment.
    let locator = (len - tail_at).checked_sub(LOCATOR_BYTES + END_BYTES + comment).map(|at| &tail[at as usize..]);
    let Some(locator) = locator.filter(|bytes| bytes.starts_with(b"PK\x06\x07")) else {
        let bytes = number(&tail, end + 12, 4) + len - end_at;
        return Ok(DeclaredDirectory { entries: number(&tail, end + 8, 2), bytes });
    };
    let at = number(locator, 8, 8);
    if at.checked_add(END_64_BYTES).is_none_or(|stop| stop > len) {
        return Err(missing());
    }
    let mut record = [0; END_64_BYTES as usize];
    file.seek(SeekFrom::Start(at))?;
    file.read_exact(&mut record)?;
    // Refuse an archive without a record at this offset: the crate `zip` would search the whole file for it.
    if !record.starts_with(b"PK\x06\x06") {
        return Err(missing());
    }
    let start = number(&record, 48, 8);
    Ok(DeclaredDirectory { entries: number(&record, 32, 8), bytes: len.saturating_sub(start) })
}

/// Returns whether `found`, the checksum (CRC-32) of the bytes that were read, is the checksum `listed` that the archive
/// lists. A listed checksum of 0 matches everything: some programs, such as PyTorch, write it if they do not compute
/// one.
pub(crate) fn checksum_matches(listed: u32, found: u32) -> bool {
    listed == 0 || listed == found
}

/// Checks the checksum (CRC-32) of a file called `name` in the zip archive `path`: `found` is that of the bytes that
/// were read, `listed` the one that the archive lists ([`checksum_matches`]).
///
/// # Errors
/// Fails if the checksums differ, that is, if the bytes are not those that were written.
pub(crate) fn check_checksum(path: &Path, name: &str, [listed, found]: [u32; 2]) -> crate::error::Result<()> {
    match checksum_matches(listed, found) {
        true => Ok(()),
        false => {
            let (expected, found) = (format!("bytes with the checksum {listed:08x}"), format!("{found:08x}"));
            Err(crate::error::Error::input(path, name, expected, found)
                .hint("the file is damaged: copy or download it again"))
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Cursor, Write};

    use zip::ZipWriter;
    use zip::write::FileOptions;

    use super::*;

    #[test]
    fn declared_size_matches_the_archive() {
        let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
        for name in ["a", "b/c", "b/d"] {
            writer.start_file(name, FileOptions::default()).unwrap();
            writer.write_all(name.as_bytes()).unwrap();
        }
        writer.set_comment("a comment");
        let bytes = writer.finish().unwrap().into_inner();
        let found = declared_directory(&mut Cursor::new(&bytes)).unwrap();
        // Size of the list: three records of 46 bytes plus names, the end record and the comment.
        assert_eq!(found, DeclaredDirectory { entries: 3, bytes: 3 * 46 + 7 + 22 + 9 });
        for length in 0..bytes.len() - 9 - 22 {
            assert!(declared_directory(&mut Cursor::new(&bytes[..length])).is_err(), "{length}");
        }
    }
}
