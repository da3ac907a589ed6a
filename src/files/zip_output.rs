//! Output for a zip writer that remembers a failed write and reports it once, when the output is closed.

use std::io::{self, Seek, SeekFrom, Write};

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
