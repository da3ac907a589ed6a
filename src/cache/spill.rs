//! Data kept on disk: in an unnamed file that lasts as long as the run, or in a cache entry that stays.

use std::fs::File;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;
use splat_platform::read_exact_at;

use crate::cache::entry::EntryWriter;
use crate::error::{Error, Result};
use crate::files::atomic::{Replace, StagedFile};

/// Number of bytes that this process has read back from all [`Spill`]s.
static READ_BACK: AtomicU64 = AtomicU64::new(0);

/// Content of a file that is written once and then read in arbitrary pieces.
#[derive(Debug)]
pub struct Spill {
    file: File,
    start: u64,
    path: PathBuf,
}

/// Writer of a [`Spill`].
pub struct SpillWriter {
    writer: EntryWriter,
    /// Path for error messages: the file itself, or the folder of an unnamed file.
    path: PathBuf,
    /// Temporary file that is renamed when the spill is complete; `None` for an unnamed file.
    staged: Option<StagedFile>,
}

impl Spill {
    /// Returns the content of `file` from byte `start` on.
    pub(super) fn from_file(file: File, start: u64, path: PathBuf) -> Spill {
        Spill { file, start, path }
    }

    /// Reads `bytes.len()` bytes, beginning at byte `start` of the content.
    ///
    /// # Errors
    /// Fails if a read fails or the content ends.
    pub fn read(&self, start: u64, bytes: &mut [u8]) -> Result<()> {
        READ_BACK.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        read_exact_at(&self.file, bytes, self.start + start).map_err(Error::io("read back values from", &self.path))
    }

    /// Reads the record that [`SpillWriter::write_record`] wrote at `start` into `bytes`. Returns the start of the next
    /// record.
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

    /// Returns the number of bytes that this process has read back from all spills.
    pub fn read_back() -> u64 {
        READ_BACK.load(Ordering::Relaxed)
    }
}

impl SpillWriter {
    /// Creates an unnamed file in `folder`. The system removes it when the process ends.
    ///
    /// # Errors
    /// Fails if the folder does not exist or the system refuses.
    pub fn new(folder: &Path) -> Result<SpillWriter> {
        let file = tempfile::tempfile_in(folder).map_err(Error::io("create a scratch file in", folder))?;
        let writer = EntryWriter::new(file, 0, "").map_err(Error::io("write a scratch file in", folder))?;
        Ok(SpillWriter { writer, path: folder.to_owned(), staged: None })
    }

    /// Creates a file that gets the name `target` when it is complete.
    pub(super) fn named(target: &Path, key: u128, about: &str) -> Result<SpillWriter> {
        let staged = StagedFile::new(target, Replace::Existing)?;
        let file = File::options().read(true).write(true).create_new(true).open(staged.path());
        let file = file.map_err(Error::io("create", target))?;
        let writer = EntryWriter::new(file, key, about).map_err(Error::io("write", target))?;
        Ok(SpillWriter { writer, path: target.to_owned(), staged: Some(staged) })
    }

    /// Returns the action for error messages; a scratch file has no name that could be shown.
    fn write_action(&self) -> &'static str {
        if self.staged.is_some() { "write values to" } else { "write a scratch file in" }
    }

    /// Appends `bytes`.
    ///
    /// # Errors
    /// Fails if the write fails.
    pub fn write(&mut self, bytes: &[u8]) -> Result<()> {
        let failed = Error::io(self.write_action(), &self.path);
        self.writer.write_all(bytes).map_err(failed)
    }

    /// Appends the length of `bytes`, then `bytes`.
    ///
    /// # Errors
    /// Fails if the write fails.
    pub fn write_record(&mut self, bytes: &[u8]) -> Result<()> {
        self.write(&(bytes.len() as u64).to_le_bytes())?;
        self.write(bytes)
    }

    /// Appends the serialized `value`.
    pub(super) fn write_value(&mut self, value: &impl Serialize) -> Result<()> {
        let Err(error) = postcard::to_io(value, &mut self.writer) else { return Ok(()) };
        let failed = self.writer.failed.take().unwrap_or_else(|| io::Error::other(error));
        Err(Error::io(self.write_action(), &self.path)(failed))
    }

    /// Completes the file and gives it its name, if it has one. The content can be read only then.
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
