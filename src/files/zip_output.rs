//! A place for a zip archive to be written to that tells of a failed write once, at its end.

use std::io::{self, Seek, SeekFrom, Write};

/// What a zip archive is written into. A writer of archives that is dropped after a failed write writes its directory all
/// the same and prints what that meets; so after a failure everything is taken, and none of it written.
pub(crate) struct ZipOutput<W> {
    inner: W,
    failed: Option<io::Error>,
    /// Where the next byte would go.
    at: u64,
}

impl<W: Write + Seek> ZipOutput<W> {
    /// Into `inner`, from its beginning.
    pub(crate) fn new(inner: W) -> Self {
        ZipOutput { inner, failed: None, at: 0 }
    }

    /// Ends writing.
    ///
    /// # Errors
    /// The first write that failed.
    pub(crate) fn close(mut self) -> io::Result<()> {
        self.flush()?;
        self.failed.map_or(Ok(()), Err)
    }

    /// What `done` gives, or in its place `instead` once a write has failed.
    fn or<T>(&mut self, instead: T, done: impl FnOnce(&mut W) -> io::Result<T>) -> T {
        if self.failed.is_some() {
            return instead;
        }
        done(&mut self.inner).unwrap_or_else(|error| {
            self.failed = Some(error);
            instead
        })
    }
}

impl<W: Write + Seek> Write for ZipOutput<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.or(bytes.len(), |inner| inner.write(bytes));
        self.at += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.or((), W::flush);
        Ok(())
    }
}

impl<W: Write + Seek> Seek for ZipOutput<W> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let instead = match to {
            SeekFrom::Start(at) => at,
            SeekFrom::Current(by) => self.at.saturating_add_signed(by),
            SeekFrom::End(_) => self.at,
        };
        self.at = self.or(instead, |inner| inner.seek(to));
        Ok(self.at)
    }
}
