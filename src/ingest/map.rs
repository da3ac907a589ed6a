//! Files mapped into memory: the only module that maps.
//!
//! In: a path. Out: its bytes as a slice. Memory: pages the system may drop at any time.

use std::fs::{self, Metadata};
use std::ops::Deref;
use std::path::{Path, PathBuf};

use memmap2::Mmap;

use super::open::open_file;
use crate::error::{Error, Result};

/// A whole file as bytes, read-only. No file descriptor stays open.
#[derive(Debug)]
pub(crate) struct FileMap {
    path: PathBuf,
    identity: Identity,
    map: Mmap,
}

impl FileMap {
    /// Maps the file at `path`.
    ///
    /// # Errors
    /// When it cannot be opened or mapped (a folder, a pipe).
    pub(crate) fn open(path: &Path) -> Result<FileMap> {
        let file = open_file(path)?;
        let identity = Identity::of(&file.metadata().map_err(Error::io("read the size of", path))?);
        // SAFETY: the map is read-only and private to this value. The bytes must not change while it
        // lives: the user promises not to write to a model that is being read, and this program never
        // writes in place (outputs are renamed over, which leaves a mapped file's pages alone).
        // Shrinking, the one change that would end in SIGBUS, is looked for by `check`.
        let map = unsafe { Mmap::map(&file) }.map_err(Error::io("map", path))?;
        Ok(FileMap { path: path.to_owned(), identity, map })
    }

    /// Confirms that the file has not been cut short since it was mapped; call before each block
    /// that is read. A file that was replaced or removed meanwhile is fine: the map keeps the old one.
    pub(crate) fn check(&self) -> Result<()> {
        match fs::metadata(&self.path) {
            Ok(now) if Identity::of(&now) == self.identity && now.len() < self.map.len() as u64 => Err(Error::input(
                &self.path,
                "end of file",
                format!("{} bytes, as when it was opened", self.map.len()),
                format!("{} bytes", now.len()),
            )
            .hint("the file was cut short while it was being read; start again when nothing writes to it")),
            _ => Ok(()),
        }
    }
}

impl Deref for FileMap {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        &self.map
    }
}

/// What tells a file from another one that took its name: device and inode.
#[cfg(unix)]
#[derive(Debug, PartialEq)]
struct Identity(u64, u64);

#[cfg(unix)]
impl Identity {
    fn of(metadata: &Metadata) -> Identity {
        use std::os::unix::fs::MetadataExt;
        Identity(metadata.dev(), metadata.ino())
    }
}

/// Elsewhere a mapped file can be neither removed nor cut, so that any file of that name is it.
#[cfg(not(unix))]
#[derive(Debug, PartialEq)]
struct Identity;

#[cfg(not(unix))]
impl Identity {
    fn of(_: &Metadata) -> Identity {
        Identity
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_cut_short_under_the_map_is_an_error_not_a_signal() {
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
    fn a_file_replaced_or_removed_under_the_map_reads_on() {
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
