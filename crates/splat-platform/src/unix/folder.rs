//! Folders that are addressed by open handles, so that no renamed folder and no link can redirect an operation to
//! another folder.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use rustix::fs::{AtFlags, CWD, Dir, FileType, Mode, OFlags};

use crate::{FileIdentity, FolderStatus};

/// Handle of an open folder. Its methods address the entries of this folder by name, and do not follow an entry that is
/// a link.
#[derive(Debug)]
pub struct FolderHandle(OwnedFd);

impl FolderHandle {
    /// Opens the folder at `path`. Follows links in `path`.
    ///
    /// # Errors
    /// Fails if the folder does not exist or the system refuses.
    pub fn open(path: &Path) -> io::Result<FolderHandle> {
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        Ok(FolderHandle(rustix::fs::open(path, flags, Mode::empty())?))
    }

    /// Opens the folder `name` in this folder.
    ///
    /// # Errors
    /// Fails if the entry `name` is missing, is not a folder, or is a link, or if the system refuses.
    pub fn open_folder(&self, name: impl AsRef<OsStr>) -> io::Result<FolderHandle> {
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        Ok(FolderHandle(rustix::fs::openat(&self.0, name.as_ref(), flags, Mode::empty())?))
    }

    /// Opens the regular file `name` for reading and, if `writes`, also for writing. Does not wait if the entry is a
    /// FIFO (named pipe), but fails.
    ///
    /// # Errors
    /// Fails if the entry `name` is missing or is not a regular file, or if the system refuses.
    pub fn open_file(&self, name: &str, writes: bool) -> io::Result<File> {
        let access = if writes { OFlags::RDWR } else { OFlags::RDONLY };
        let flags = access | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = File::from(rustix::fs::openat(&self.0, name, flags, Mode::empty())?);
        match file.metadata()?.is_file() {
            true => Ok(file),
            false => Err(io::Error::other("not a regular file")),
        }
    }

    /// Creates the file `name` in this folder and opens it for reading and writing.
    ///
    /// # Errors
    /// Fails if an entry named `name` exists or the system refuses.
    pub fn create_file(&self, name: &str) -> io::Result<File> {
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::EXCL | OFlags::CLOEXEC;
        Ok(File::from(rustix::fs::openat(&self.0, name, flags, Mode::RUSR | Mode::WUSR)?))
    }

    /// Returns whether the entry `name` of this folder is the file that is open as `file`.
    pub fn entry_is_file(&self, name: &str, file: &File) -> bool {
        // The file is not opened again: on network file systems that could release a lock on it.
        let named = rustix::fs::statat(&self.0, name, AtFlags::SYMLINK_NOFOLLOW);
        let open = rustix::fs::fstat(file);
        named.is_ok_and(|named| open.is_ok_and(|open| (named.st_dev, named.st_ino) == (open.st_dev, open.st_ino)))
    }

    /// Returns the identity, owner and permissions of this folder.
    ///
    /// # Errors
    /// Fails if the system refuses.
    pub fn status(&self) -> io::Result<FolderStatus> {
        let found = File::from(self.0.try_clone()?).metadata()?;
        Ok(FolderStatus {
            identity: FileIdentity::from_metadata(&found),
            is_own: found.uid() == rustix::process::geteuid().as_raw(),
            is_private: found.mode() & 0o077 == 0,
        })
    }

    /// Returns the names of all entries of this folder in sorted order.
    ///
    /// # Errors
    /// Fails if the system refuses.
    pub fn entries(&self) -> io::Result<Vec<OsString>> {
        let mut names = Vec::new();
        for entry in Dir::read_from(&self.0)? {
            let name = entry?.file_name().to_bytes().to_owned();
            if name != b"." && name != b".." {
                names.push(OsString::from_vec(name));
            }
        }
        names.sort();
        Ok(names)
    }

    /// Returns whether this folder has an entry `name`, which may be a link whose target does not exist.
    pub fn has(&self, name: impl AsRef<OsStr>) -> bool {
        rustix::fs::statat(&self.0, name.as_ref(), AtFlags::SYMLINK_NOFOLLOW).is_ok()
    }

    /// Returns whether the entry `name` is a folder, and not a link to one.
    pub fn has_folder(&self, name: impl AsRef<OsStr>) -> bool {
        let found = rustix::fs::statat(&self.0, name.as_ref(), AtFlags::SYMLINK_NOFOLLOW);
        found.is_ok_and(|found| FileType::from_raw_mode(found.st_mode) == FileType::Directory)
    }

    /// Moves the entry `from` of this folder to the folder `to`, under the name `name`.
    ///
    /// # Errors
    /// Fails if there is no entry `from` or the system refuses.
    pub fn rename(&self, from: impl AsRef<OsStr>, to: &FolderHandle, name: impl AsRef<OsStr>) -> io::Result<()> {
        Ok(rustix::fs::renameat(&self.0, from.as_ref(), &to.0, name.as_ref())?)
    }

    /// Moves the entry at the path `from`, relative to this folder, to the path `to`, relative to the current folder of
    /// the process.
    ///
    /// Systems move a folder to another parent only if the folder itself is writable. A read-only folder of this user
    /// is therefore made writable while it is moved.
    ///
    /// # Errors
    /// Fails if there is no entry `from` or the system refuses.
    pub fn move_entry(&self, from: &Path, to: &Path) -> io::Result<()> {
        let moved = || rustix::fs::renameat(&self.0, from, CWD, to);
        let refused = match moved() {
            Err(error) if is_denied(error) && self.has_folder(from) => error,
            moved => return Ok(moved?),
        };
        let folder = self.open_folder(from)?;
        let mode = Mode::from_raw_mode(rustix::fs::fstat(&folder.0)?.st_mode);
        rustix::fs::fchmod(&folder.0, mode | Mode::RWXU).map_err(|_| refused)?;
        let moved = moved();
        let _ = rustix::fs::fchmod(&folder.0, mode);
        Ok(moved?)
    }

    /// Removes the entry `name`, a folder together with its content. If the entry is a link, its target stays.
    ///
    /// Read-only folders of this user that cannot be emptied otherwise are made writable first.
    ///
    /// # Errors
    /// Fails if there is no entry `name` or an entry cannot be removed.
    pub fn remove(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        let name = name.as_ref();
        if !self.has_folder(name) {
            return Ok(rustix::fs::unlinkat(&self.0, name, AtFlags::empty())?);
        }
        let folder = self.open_folder(name)?;
        let mut result = Ok(());
        for entry in folder.entries()? {
            let mut removed = folder.remove(&entry);
            if removed.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::PermissionDenied)
                && rustix::fs::fchmod(&folder.0, Mode::RWXU).is_ok()
            {
                removed = folder.remove(&entry);
            }
            result = result.and(removed);
        }
        result.and_then(|()| self.remove_empty(name))
    }

    /// Removes the entry `name` if it is an empty folder.
    ///
    /// # Errors
    /// Fails, and removes nothing, if the entry `name` is missing or is not an empty folder, or if the system refuses.
    pub fn remove_empty(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        Ok(rustix::fs::unlinkat(&self.0, name.as_ref(), AtFlags::REMOVEDIR)?)
    }

    /// Makes the system write the list of entries of this folder to the disk, so that a finished rename survives a
    /// power failure.
    ///
    /// # Errors
    /// Fails if a write fails.
    pub fn sync(&self) -> io::Result<()> {
        Ok(rustix::fs::fsync(&self.0)?)
    }
}

/// Returns whether `error` says that the process lacks a permission.
fn is_denied(error: rustix::io::Errno) -> bool {
    error == rustix::io::Errno::ACCESS || error == rustix::io::Errno::PERM
}
