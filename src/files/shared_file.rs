//! An open file that several readers share, each with its own position.

use std::fs::File;
use std::io::{Error as IoError, ErrorKind, Read, Result as IoResult, Seek, SeekFrom};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use super::open::open_file;
use crate::error::{Error, Result};

/// Size in bytes of the buffer of a reader. It is small because zip readers read headers in parts of two and four
/// bytes.
const BUFFER_BYTES: usize = 512;

/// Reader of an open file. Clones share the open file but have their own positions. The file is not memory-mapped, so
/// bytes that were read do not count as memory of the process.
#[derive(Debug, Clone)]
pub(crate) struct SharedFile {
    file: Arc<Mutex<File>>,
    len: u64,
    at: u64,
    buffer: [u8; BUFFER_BYTES],
    /// Offset in the file of the first byte in the buffer, and number of bytes in the buffer.
    buffered: (u64, usize),
}

impl SharedFile {
    /// Opens the regular file at `path`.
    ///
    /// # Errors
    /// Fails if the file cannot be opened.
    pub(crate) fn open(path: &Path) -> Result<SharedFile> {
        let file = open_file(path)?;
        let len = file.metadata().map_err(Error::io("read the size of", path))?.len();
        let file = Arc::new(Mutex::new(file));
        Ok(SharedFile { file, len, at: 0, buffer: [0; BUFFER_BYTES], buffered: (0, 0) })
    }

    /// Returns the length in bytes that the file had when it was opened.
    pub(crate) fn len(&self) -> u64 {
        self.len
    }

    /// Reads bytes of the file from offset `at` into `out`. Returns the number of bytes read, 0 at the end of the file.
    fn read_from(&self, at: u64, out: &mut [u8]) -> IoResult<usize> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(at))?;
        file.read(out)
    }
}

impl Read for SharedFile {
    fn read(&mut self, out: &mut [u8]) -> IoResult<usize> {
        if out.len() >= BUFFER_BYTES {
            let count = self.read_from(self.at, out)?;
            self.at += count as u64;
            return Ok(count);
        }
        let (start, held) = self.buffered;
        let is_held = self.at >= start && self.at < start + held as u64;
        if !is_held {
            let mut buffer = [0; BUFFER_BYTES];
            let count = self.read_from(self.at, &mut buffer)?;
            self.buffer = buffer;
            self.buffered = (self.at, count);
        }
        let (start, held) = self.buffered;
        let rest = &self.buffer[(self.at - start) as usize..held];
        let count = rest.len().min(out.len());
        out[..count].copy_from_slice(&rest[..count]);
        self.at += count as u64;
        Ok(count)
    }
}

impl Seek for SharedFile {
    fn seek(&mut self, to: SeekFrom) -> IoResult<u64> {
        let place = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::End(from) => self.len.checked_add_signed(from),
            SeekFrom::Current(from) => self.at.checked_add_signed(from),
        };
        self.at = place.ok_or_else(|| IoError::from(ErrorKind::InvalidInput))?;
        Ok(self.at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clones_read_at_independent_positions() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let bytes: Vec<u8> = (0..3000u32).map(|k| (k * k) as u8).collect();
        std::fs::write(file.path(), &bytes).unwrap();
        let mut whole = SharedFile::open(file.path()).unwrap();
        let mut other = whole.clone();
        other.seek(SeekFrom::End(-700)).unwrap();
        let mut found: Vec<u8> = Vec::new();
        for step in [1, 3, 511, 512, 513, 4].into_iter().cycle() {
            let mut piece = vec![0; step];
            let count = whole.read(&mut piece).unwrap();
            found.extend(&piece[..count]);
            if count == 0 {
                break;
            }
        }
        assert_eq!(found, bytes);
        let mut tail = Vec::new();
        other.read_to_end(&mut tail).unwrap();
        assert_eq!(tail, bytes[2300..]);
        assert!(other.seek(SeekFrom::Start(5)).is_ok() && other.seek(SeekFrom::Current(-6)).is_err());
    }
}
