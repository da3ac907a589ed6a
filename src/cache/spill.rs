//! Data moved from memory to disk: to an unnamed file that lasts as long as the run, or to a cache entry that stays.

use std::fs::File;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;
use splat_platform::read_exact_at;

use crate::cache::entry::EntryWriter;
use crate::error::{Error, Result};
use crate::files::atomic::{Replace, StagedFile};

/// Number of bytes that this process has read back so far from all [`Spill`]s (data moved from memory to files).
static READ_BACK: AtomicU64 = AtomicU64::new(0);

/// Data that was moved from memory to a file. Any range of its bytes can be read, in any order.
#[derive(Debug)]
pub struct Spill {
    file: File,
    start: u64,
    path: PathBuf,
}

/// Writer of a [`Spill`], that is, of data that is moved from memory to a file.
pub struct SpillWriter {
    writer: EntryWriter,
    /// Path shown in error messages: the path of the file itself or, for an unnamed file, of its folder.
    path: PathBuf,
    /// Temporary file that gets its final name when all data is written; `None` for an unnamed file.
    staged: Option<StagedFile>,
}

impl Spill {
    /// Creates a spill (temporary data on disk) whose content is the bytes of `file` from byte `start` on. `path` is
    /// shown in error messages.
    pub(super) fn from_file(file: File, start: u64, path: PathBuf) -> Spill {
        Spill { file, start, path }
    }

    /// Fills `bytes` with data from byte `start` of the content on.
    ///
    /// # Errors
    /// Fails if a read fails or the content ends before `bytes` is full.
    pub fn read(&self, start: u64, bytes: &mut [u8]) -> Result<()> {
        READ_BACK.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        read_exact_at(&self.file, bytes, self.start + start).map_err(Error::io("read back values from", &self.path))
    }

    /// Reads the record (length and bytes of one value, written by [`SpillWriter::write_record`]) at byte `start` of
    /// the content. Stores its bytes in `bytes`, and returns the start of the next record.
    ///
    /// # Errors
    /// Fails where [`Spill::read`] fails.
    pub fn read_record(&self, start: u64, bytes: &mut Vec<u8>) -> Result<u64> {
        let mut length = [0; 8];
        self.read(start, &mut length)?;
        let length = u64::from_le_bytes(length);
        bytes.resize(length as usize, 0);
        self.read(start + 8, bytes)?;
        Ok(start + 8 + length)
    }

    /// Returns the number of bytes that this process has read back so far from all spills (data that it moved from
    /// memory to files).
    pub fn bytes_read_back() -> u64 {
        READ_BACK.load(Ordering::Relaxed)
    }
}

impl SpillWriter {
    /// Creates the writer of an unnamed file in `folder`. The system removes the file when the process ends.
    ///
    /// # Errors
    /// Fails if the folder does not exist or the file cannot be created in it.
    pub fn new(folder: &Path) -> Result<SpillWriter> {
        let file = tempfile::tempfile_in(folder).map_err(Error::io("create a scratch file in", folder))?;
        let writer = EntryWriter::new(file, 0, "").map_err(Error::io("write a scratch file in", folder))?;
        Ok(SpillWriter { writer, path: folder.to_owned(), staged: None })
    }

    /// Creates the writer of a cache entry. Its file gets the path `target` when it is complete. `key`: cache key of
    /// the entry. `about`: description of the input, which is stored in the entry.
    pub(super) fn named(target: &Path, key: u128, about: &str) -> Result<SpillWriter> {
        let staged = StagedFile::new(target, Replace::Existing)?;
        let file = File::options().read(true).write(true).create_new(true).open(staged.path());
        let file = file.map_err(Error::io("create", target))?;
        let writer = EntryWriter::new(file, key, about).map_err(Error::io("write", target))?;
        Ok(SpillWriter { writer, path: target.to_owned(), staged: Some(staged) })
    }

    /// Returns the words before the path in error messages about failed writes. For a cache entry, this path is the
    /// path of the entry; for a scratch file, which has no name, it is the path of its folder.
    fn write_action(&self) -> &'static str {
        if self.staged.is_some() { "write values to" } else { "write a scratch file in" }
    }

    /// Appends `bytes` to the content.
    ///
    /// # Errors
    /// Fails if the write fails.
    pub fn write(&mut self, bytes: &[u8]) -> Result<()> {
        let failed = Error::io(self.write_action(), &self.path);
        self.writer.write_all(bytes).map_err(failed)
    }

    /// Appends `bytes` to the content as a record that [`Spill::read_record`] can read: first their number as 8 bytes,
    /// then the bytes.
    ///
    /// # Errors
    /// Fails if the write fails.
    pub fn write_record(&mut self, bytes: &[u8]) -> Result<()> {
        self.write(&(bytes.len() as u64).to_le_bytes())?;
        self.write(bytes)
    }

    /// Appends the serialized `value` to the content.
    pub(super) fn write_value(&mut self, value: &impl Serialize) -> Result<()> {
        let Err(error) = postcard::to_io(value, &mut self.writer) else { return Ok(()) };
        let failed = self.writer.failed.take().unwrap_or_else(|| io::Error::other(error));
        Err(Error::io(self.write_action(), &self.path)(failed))
    }

    /// Completes the file and returns its content for reading. The file of a cache entry gets its final name; a scratch
    /// file has none.
    ///
    /// # Errors
    /// Fails if a write fails.
    pub fn finish(self) -> Result<Spill> {
        let write_action = self.write_action();
        let SpillWriter { writer, path, staged } = self;
        let start = writer.start();
        let file = writer.finish().map_err(Error::io(write_action, &path))?;
        staged.map_or(Ok(()), StagedFile::commit)?;
        Ok(Spill { file, start, path })
    }
}
