//! Memory-mapped files. No other module of this crate maps files.
//!
//! Input: a path. Output: the bytes of the file as a slice. Mapped pages count as memory of this process until they are
//! released. So readers report the ranges that they read ([`FileMap::touched`]), and at most about 2 MiB of a mapped
//! file stay resident.

use std::fs::File;
use std::ops::{Deref, Range};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use memmap2::{Mmap, MmapOptions};
use splat_platform::{FileIdentity, FileStatus, release_pages};

use super::open::open_file;
use crate::error::{Error, Result};

/// Maximum number of bytes of a mapped file that are resident (in memory). When it is exceeded, the map releases all
/// its pages, which takes about 2 µs.
const MAX_RESIDENT_BYTES: usize = 2 << 20;
/// Bytes around a page read by this process that the system may map together with it (Linux: fault-around of 64 KiB).
const FAULT_AROUND_BYTES: usize = 1 << 16;

/// Read-only memory map of a whole file, or of a range of a scratch file. Keeps no file descriptor open.
#[derive(Debug)]
pub(crate) struct FileMap {
    path: PathBuf,
    /// Identity of the mapped file. With it, [`FileMap::check`] distinguishes the mapped file from another file that
    /// has taken its path. `None` for a scratch file, which no other process can reach.
    identity: Option<FileIdentity>,
    map: Mmap,
    /// Estimated number of bytes of the map that are in memory: the bytes reported as read since pages were last
    /// released, and for each reported range up to 64 KiB of the gap to the range before it, which the system may have
    /// mapped too.
    resident: AtomicUsize,
    /// End of the range of the map that was reported last.
    last_end: AtomicUsize,
}

impl FileMap {
    /// Maps the file at `path`.
    ///
    /// # Errors
    /// Fails if the file is not regular or cannot be opened or mapped.
    pub(crate) fn open(path: &Path) -> Result<FileMap> {
        let file = open_file(path)?;
        let identity = FileStatus::from_file(&file).map_err(Error::io("read the size of", path))?.identity;
        // SAFETY: the map is read-only and private to this value. The bytes must not change while the map lives. The
        // user must not write to a model that is being read; this program never writes in place (outputs are renamed
        // over existing files, which leaves the pages of a mapped file unchanged). Shrinking, the one change that would
        // end in SIGBUS, is detected by `check`.
        let map = unsafe { Mmap::map(&file) }.map_err(Error::io("map", path))?;
        Ok(FileMap::new(path, Some(identity), map))
    }

    /// Maps the bytes `range` of an unnamed scratch file, which hold converted data of the file at `path`.
    ///
    /// # Errors
    /// Fails if the file cannot be mapped.
    pub(crate) fn from_scratch(file: &File, range: Range<u64>, path: &Path) -> Result<FileMap> {
        let mut options = MmapOptions::new();
        options.offset(range.start).len((range.end - range.start) as usize);
        // SAFETY: the map is read-only. The file has no name, so only this process reaches it, and its writer only
        // appends: the bytes of `range` were written before and do not change.
        let map = unsafe { options.map(file) }.map_err(Error::io("map the scratch file of", path))?;
        Ok(FileMap::new(path, None, map))
    }

    /// Wraps `map`, a memory map of the file at `path` of which no page has been read yet. `identity` is the identity
    /// of the file, or `None` for a scratch file.
    fn new(path: &Path, identity: Option<FileIdentity>, map: Mmap) -> FileMap {
        let (resident, last_end) = (AtomicUsize::new(0), AtomicUsize::new(0));
        FileMap { path: path.to_owned(), identity, map, resident, last_end }
    }

    /// Checks that the file has not been cut short since it was mapped. Readers call this before they read each block.
    /// A file that was replaced or removed meanwhile is no error, because the map keeps the old file.
    pub(crate) fn check(&self) -> Result<()> {
        let Some(identity) = &self.identity else { return Ok(()) };
        match FileStatus::from_path(&self.path) {
            Ok(now) if now.identity == *identity && now.length < self.map.len() as u64 => Err(Error::input(
                &self.path,
                "end of file",
                format!("{} bytes, as when it was opened", self.map.len()),
                format!("{} bytes", now.length),
            )
            .hint("the file was cut short while it was being read; start again when nothing writes to it")),
            _ => Ok(()),
        }
    }

    /// Records that a reader has read or is about to read the bytes `range` of the map. Every reader calls this, so
    /// that the map can release its pages when about 2 MiB of them may be resident (in memory). Slices of the map stay
    /// valid, because released pages are read from the file again on access.
    pub(crate) fn touched(&self, range: Range<usize>) {
        let gap = self.last_end.swap(range.end, Ordering::Relaxed).abs_diff(range.start).min(FAULT_AROUND_BYTES);
        let more = gap + range.len();
        if self.resident.fetch_add(more, Ordering::Relaxed) + more > MAX_RESIDENT_BYTES {
            self.resident.store(0, Ordering::Relaxed);
            self.release();
        }
    }

    /// Calls `each` with the bytes of `range` of the mapped file, in chunks of at most 1 MiB. Ends with the first error
    /// that `each` returns.
    pub(crate) fn pieces<E>(
        &self,
        range: Range<usize>,
        mut each: impl FnMut(&[u8]) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        for start in range.clone().step_by(1 << 20) {
            let piece = start..range.end.min(start + (1 << 20));
            self.touched(piece.clone());
            each(&self.map[piece])?;
        }
        Ok(())
    }

    /// Releases all resident pages of the map.
    fn release(&self) {
        // SAFETY: the map is backed by a file, so released pages are read from this file again. This also holds for
        // scratch files.
        unsafe { release_pages(&self.map, 0..self.map.len()) };
    }
}

impl Deref for FileMap {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        &self.map
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn shrinking_mapped_file_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, vec![7; 10_000]).unwrap();
        let map = FileMap::open(&path).unwrap();
        map.check().unwrap();
        fs::File::options().write(true).open(&path).unwrap().set_len(10).unwrap();
        let message = map.check().unwrap_err().to_string();
        assert!(message.contains("10000 bytes") && message.contains("10 bytes"), "{message}");
    }

    #[cfg(unix)]
    #[test]
    fn replaced_or_removed_file_stays_readable() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, vec![7; 10_000]).unwrap();
        let map = FileMap::open(&path).unwrap();
        let shorter = folder.path().join("b");
        fs::write(&shorter, b"x").unwrap();
        fs::rename(&shorter, &path).unwrap();
        map.check().unwrap();
        fs::remove_file(&path).unwrap();
        map.check().unwrap();
        assert_eq!(map[9_999], 7);
    }

    #[test]
    fn an_empty_file_is_an_empty_slice() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, b"").unwrap();
        assert!(FileMap::open(&path).unwrap().is_empty());
    }
}
