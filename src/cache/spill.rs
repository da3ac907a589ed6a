//! Values that wait on the disk: in a file without a name while a run lasts, or in a piece that stays.

use std::fs::File;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;
use splat_platform::read_exact_at;

use crate::cache::entry::EntryWriter;
use crate::error::{Error, Result};
use crate::files::atomic::{Replace, StagedFile};

/// Bytes that this process has read back of all [`Spill`]s.
static READ_BACK: AtomicU64 = AtomicU64::new(0);

/// Content that was written once from its start, to be read in pieces.
#[derive(Debug)]
pub struct Spill {
    file: File,
    start: u64,
    at: PathBuf,
}

/// A [`Spill`] that is being written.
pub struct SpillWriter {
    writer: EntryWriter,
    /// What it is called in messages: its own name, or the folder of one without.
    at: PathBuf,
    /// Where it gets its name.
    staged: Option<StagedFile>,
}

impl Spill {
    /// The content of `file` from byte `start` on.
    pub(super) fn of(file: File, start: u64, at: PathBuf) -> Spill {
        Spill { file, start, at }
    }

    /// Reads as many bytes as `bytes` has from byte `start` on.
    ///
    /// # Errors
    /// A failed read; the end of the file.
    pub fn read(&self, start: u64, bytes: &mut [u8]) -> Result<()> {
        READ_BACK.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        read_exact_at(&self.file, bytes, self.start + start).map_err(Error::io("read back values from", &self.at))
    }

    /// Reads into `bytes` what [`SpillWriter::write_record`] wrote at `start`; gives where the next one is.
    ///
    /// # Errors
    /// Those of [`Spill::read`].
    pub fn read_record(&self, start: u64, bytes: &mut Vec<u8>) -> Result<u64> {
        let mut length = [0; 8];
        self.read(start, &mut length)?;
        let length = u64::from_le_bytes(length);
        bytes.resize(length as usize, 0);
        self.read(start + 8, bytes)?;
        Ok(start + 8 + length)
    }

    /// Bytes that this process has read back so far, of all of them.
    pub fn read_back() -> u64 {
        READ_BACK.load(Ordering::Relaxed)
    }
}

impl SpillWriter {
    /// An empty one without a name in `folder`: the system removes it with the process.
    ///
    /// # Errors
    /// A folder that does not exist; the system refuses.
    pub fn new(folder: &Path) -> Result<SpillWriter> {
        let file = tempfile::tempfile_in(folder).map_err(Error::io("create a scratch file in", folder))?;
        let writer = EntryWriter::new(file, 0, "").map_err(Error::io("write a scratch file in", folder))?;
        Ok(SpillWriter { writer, at: folder.to_owned(), staged: None })
    }

    /// An empty one that gets the name `target` at its end.
    pub(super) fn named(target: &Path, key: u128, about: &str) -> Result<SpillWriter> {
        let staged = StagedFile::new(target, Replace::Existing)?;
        let file = File::options().read(true).write(true).create_new(true).open(staged.path());
        let file = file.map_err(Error::io("create", target))?;
        let writer = EntryWriter::new(file, key, about).map_err(Error::io("write", target))?;
        Ok(SpillWriter { writer, at: target.to_owned(), staged: Some(staged) })
    }

    /// What fails with a write: a scratch file has no name to call it by.
    fn action(&self) -> &'static str {
        if self.staged.is_some() { "write values to" } else { "write a scratch file in" }
    }

    /// Writes `bytes` behind what is there.
    ///
    /// # Errors
    /// A failed write.
    pub fn write(&mut self, bytes: &[u8]) -> Result<()> {
        let failed = Error::io(self.action(), &self.at);
        self.writer.write_all(bytes).map_err(failed)
    }

    /// Writes the length of `bytes`, then these, behind what is there.
    ///
    /// # Errors
    /// A failed write.
    pub fn write_record(&mut self, bytes: &[u8]) -> Result<()> {
        self.write(&(bytes.len() as u64).to_le_bytes())?;
        self.write(bytes)
    }

    /// Writes `value` behind what is there.
    pub(super) fn write_value(&mut self, value: &impl Serialize) -> Result<()> {
        let Err(error) = postcard::to_io(value, &mut self.writer) else { return Ok(()) };
        let failed = self.writer.failed.take().unwrap_or_else(|| io::Error::other(error));
        Err(Error::io(self.action(), &self.at)(failed))
    }

    /// Ends writing: only then can be read, and only then it has its name, if it gets one.
    ///
    /// # Errors
    /// A failed write.
    pub fn finish(self) -> Result<Spill> {
        let action = self.action();
        let SpillWriter { writer, at, staged } = self;
        let start = writer.start();
        let file = writer.finish().map_err(Error::io(action, &at))?;
        staged.map_or(Ok(()), StagedFile::commit)?;
        Ok(Spill { file, start, at })
    }
}
