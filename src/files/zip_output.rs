//! Writes zip archives whose bytes depend only on their content. A failed write is reported once, when the archive is
//! complete.

use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

use zip::write::FileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

use crate::error::{Error, Result};

/// Zip archive that is written to a file.
pub(crate) type ZipFileWriter = ZipWriter<ZipOutput<BufWriter<File>>>;

/// Creates the zip archive `path` without files.
///
/// # Errors
/// Fails if the file cannot be created.
pub(crate) fn create_zip(path: &Path) -> Result<ZipFileWriter> {
    let file = File::create(path).map_err(Error::io("create", path))?;
    Ok(ZipWriter::new(ZipOutput::new(BufWriter::new(file))))
}

/// Completes the zip archive `path`.
///
/// # Errors
/// Fails if this write or an earlier one failed.
pub(crate) fn finish_zip(mut archive: ZipFileWriter, path: &Path) -> Result<()> {
    archive.finish().map_err(Into::into).and_then(ZipOutput::close).map_err(Error::io("write", path))
}

/// Returns the options for a file of at most `bytes` bytes in a zip archive: uncompressed, and dated 1980-01-01, so that
/// the archive does not depend on the time at which it is written.
pub(crate) fn stored_file_options(bytes: u64) -> FileOptions {
    FileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .last_modified_time(DateTime::default())
        .large_file(bytes > u64::from(u32::MAX))
}

/// Output for a zip writer that reports a failed write only in [`ZipOutput::close`], and accepts and discards all bytes
/// after the failure. This is necessary because a zip writer that is dropped after an error writes its list of files
/// all the same, and prints any error of this write.
pub(crate) struct ZipOutput<W> {
    inner: W,
    failed: Option<io::Error>,
    /// Offset in the output of the next byte to be written.
    at: u64,
}

impl<W: Write + Seek> ZipOutput<W> {
    /// Wraps the output `inner`, to which nothing may have been written yet.
    pub(crate) fn new(inner: W) -> Self {
        ZipOutput { inner, failed: None, at: 0 }
    }

    /// Flushes the output and reports a failed write.
    ///
    /// # Errors
    /// Fails with the error of the first write that failed.
    pub(crate) fn close(mut self) -> io::Result<()> {
        self.flush()?;
        self.failed.map_or(Ok(()), Err)
    }

    /// Calls the operation `done` with the inner output and returns its result. If the operation or an earlier one
    /// failed, returns `fallback` instead. The first error is kept for [`ZipOutput::close`].
    fn unless_failed<T>(&mut self, fallback: T, done: impl FnOnce(&mut W) -> io::Result<T>) -> T {
        if self.failed.is_some() {
            return fallback;
        }
        done(&mut self.inner).unwrap_or_else(|error| {
            self.failed = Some(error);
            fallback
        })
    }
}

impl<W: Write + Seek> Write for ZipOutput<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.unless_failed(bytes.len(), |inner| inner.write(bytes));
        self.at += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.unless_failed((), W::flush);
        Ok(())
    }
}

impl<W: Write + Seek> Seek for ZipOutput<W> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let fallback = match to {
            SeekFrom::Start(at) => at,
            SeekFrom::Current(by) => self.at.saturating_add_signed(by),
            SeekFrom::End(_) => self.at,
        };
        self.at = self.unless_failed(fallback, |inner| inner.seek(to));
        Ok(self.at)
    }
}
