//! Folders addressed by open handles, so that no rename and no link can redirect an operation to another folder.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use rustix::fs::{AtFlags, CWD, Dir, FileType, Mode, OFlags};

use crate::{FileIdentity, FolderStatus};

/// Open folder. Names are relative to it. Links are never followed.
#[derive(Debug)]
pub struct FolderHandle(OwnedFd);

impl FolderHandle {
    /// Opens the folder at `path`, or the folder that a link at `path` leads to.
    ///
    /// # Errors
    /// The folder does not exist; the system refuses.
    pub fn open(path: &Path) -> io::Result<FolderHandle> {
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        Ok(FolderHandle(rustix::fs::open(path, flags, Mode::empty())?))
    }

    /// Opens the folder `name` in this folder. A link is an error.
    ///
    /// # Errors
    /// No folder has this name; the system refuses.
    pub fn open_folder(&self, name: impl AsRef<OsStr>) -> io::Result<FolderHandle> {
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        Ok(FolderHandle(rustix::fs::openat(&self.0, name.as_ref(), flags, Mode::empty())?))
    }

    /// Opens the regular file `name` for reading and, if `writes`, for writing. Any other kind of entry is an error; a
    /// FIFO does not block.
    ///
    /// # Errors
    /// No regular file has this name; the system refuses.
    pub fn open_file(&self, name: &str, writes: bool) -> io::Result<File> {
        let access = if writes { OFlags::RDWR } else { OFlags::RDONLY };
        let flags = access | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = File::from(rustix::fs::openat(&self.0, name, flags, Mode::empty())?);
        match file.metadata()?.is_file() {
            true => Ok(file),
            false => Err(io::Error::other("not a regular file")),
        }
    }

    /// Creates the file `name`.
    ///
    /// # Errors
    /// An entry has this name; the system refuses.
    pub fn create_file(&self, name: &str) -> io::Result<File> {
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::EXCL | OFlags::CLOEXEC;
        Ok(File::from(rustix::fs::openat(&self.0, name, flags, Mode::RUSR | Mode::WUSR)?))
    }

    /// Returns whether the entry `name` is the open file `file`.
    pub fn names_file(&self, name: &str, file: &File) -> bool {
        // Does not open the file again: on network file systems that could release a lock on it.
        let named = rustix::fs::statat(&self.0, name, AtFlags::SYMLINK_NOFOLLOW);
        let open = rustix::fs::fstat(file);
        named.is_ok_and(|named| open.is_ok_and(|open| (named.st_dev, named.st_ino) == (open.st_dev, open.st_ino)))
    }

    /// Returns the identity, owner and permissions of this folder.
    ///
    /// # Errors
    /// The system refuses.
    pub fn status(&self) -> io::Result<FolderStatus> {
        let found = File::from(self.0.try_clone()?).metadata()?;
        Ok(FolderStatus {
            identity: FileIdentity::from_metadata(&found),
            is_own: found.uid() == rustix::process::geteuid().as_raw(),
            is_private: found.mode() & 0o077 == 0,
        })
    }

    /// Returns the names of all entries, sorted.
    ///
    /// # Errors
    /// The system refuses.
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

    /// Returns whether an entry has this name, including a link whose target does not exist.
    pub fn has(&self, name: impl AsRef<OsStr>) -> bool {
        rustix::fs::statat(&self.0, name.as_ref(), AtFlags::SYMLINK_NOFOLLOW).is_ok()
    }

    /// Returns whether the entry is a folder and not a link to one.
    pub fn has_folder(&self, name: impl AsRef<OsStr>) -> bool {
        let found = rustix::fs::statat(&self.0, name.as_ref(), AtFlags::SYMLINK_NOFOLLOW);
        found.is_ok_and(|found| FileType::from_raw_mode(found.st_mode) == FileType::Directory)
    }

    /// Renames the entry `from` to `name` in the folder `to`.
    ///
    /// # Errors
    /// No entry has this name; the system refuses.
    pub fn rename(&self, from: impl AsRef<OsStr>, to: &FolderHandle, name: impl AsRef<OsStr>) -> io::Result<()> {
        Ok(rustix::fs::renameat(&self.0, from.as_ref(), &to.0, name.as_ref())?)
    }

    /// Moves the entry at the relative path `from` to the path `to`.
    ///
    /// The system moves a folder to another parent only if the folder itself is writable. A read-only folder of this
    /// user is therefore made writable during its move.
    ///
    /// # Errors
    /// As for [`FolderHandle::rename`].
    pub fn move_to(&self, from: &Path, to: &Path) -> io::Result<()> {
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

    /// Removes the entry `name`; a folder is removed with its content. A link is removed, its target is not.
    ///
    /// Read-only folders of this user are made writable first.
    ///
    /// # Errors
    /// No entry has this name; an entry cannot be removed.
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

    /// Removes the empty folder `name`. Any other entry stays and is an error.
    ///
    /// # Errors
    /// No empty folder has this name; the system refuses.
    pub fn remove_empty(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        Ok(rustix::fs::unlinkat(&self.0, name.as_ref(), AtFlags::REMOVEDIR)?)
    }

    /// Writes the entries of the folder, their names, through to the disk.
    ///
    /// # Errors
    /// A write fails.
    pub fn sync(&self) -> io::Result<()> {
        Ok(rustix::fs::fsync(&self.0)?)
    }
}

/// Returns whether the system refused an operation for lack of permission.
fn is_denied(error: rustix::io::Errno) -> bool {
    error == rustix::io::Errno::ACCESS || error == rustix::io::Errno::PERM
}
