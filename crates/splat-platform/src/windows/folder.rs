//! Folders addressed by their paths, because the documented interface of Windows has no operations relative to an open
//! folder.
//!
//! Before each operation the path is checked: it must still lead to the folder that was opened, without a link. Another
//! program may replace the folder between this check and the operation; Linux and macOS exclude that. No folder counts
//! as the user's own, so the program takes over and removes only folders of its own process.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::windows::fs::{FileTypeExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use windows_sys::Win32::Storage::FileSystem::{FILE_FLAG_BACKUP_SEMANTICS, FILE_FLAG_OPEN_REPARSE_POINT};

use crate::{FileIdentity, FileStatus, FolderStatus};

/// Open folder. Names are relative to it. Links are never followed.
#[derive(Debug)]
pub struct FolderHandle {
    /// Absolute path without links.
    path: PathBuf,
    /// Identity of the folder that was opened.
    identity: FileIdentity,
}

impl FolderHandle {
    /// Opens the folder at `path`, or the folder that a link at `path` leads to.
    ///
    /// # Errors
    /// The folder does not exist; the system refuses.
    pub fn open(path: &Path) -> io::Result<FolderHandle> {
        let path = fs::canonicalize(path)?;
        let identity = folder_identity(&path)?;
        Ok(FolderHandle { path, identity })
    }

    /// Opens the folder `name` in this folder. A link is an error.
    ///
    /// # Errors
    /// No folder has this name; the system refuses.
    pub fn open_folder(&self, name: impl AsRef<OsStr>) -> io::Result<FolderHandle> {
        let path = self.entry_path(name)?;
        let identity = folder_identity(&path)?;
        Ok(FolderHandle { path, identity })
    }

    /// Opens the regular file `name` for reading and, if `writes`, for writing. Any other kind of entry is an error.
    ///
    /// # Errors
    /// No regular file has this name; the system refuses.
    pub fn open_file(&self, name: &str, writes: bool) -> io::Result<File> {
        let mut options = OpenOptions::new();
        options.read(true).write(writes).custom_flags(FILE_FLAG_OPEN_REPARSE_POINT);
        let file = options.open(self.entry_path(name)?)?;
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
        OpenOptions::new().read(true).write(true).create_new(true).open(self.entry_path(name)?)
    }

    /// Returns whether the entry `name` is the open file `file`.
    pub fn names_file(&self, name: &str, file: &File) -> bool {
        let named = self.open_file(name, false).and_then(|named| FileStatus::from_file(&named));
        let open = FileStatus::from_file(file);
        named.is_ok_and(|named| open.is_ok_and(|open| named.identity == open.identity))
    }

    /// Returns the identity of this folder. Owner and permissions are not read.
    ///
    /// # Errors
    /// The folder no longer exists.
    pub fn status(&self) -> io::Result<FolderStatus> {
        self.check()?;
        Ok(FolderStatus { identity: self.identity, is_own: false, is_private: false })
    }

    /// Returns the names of all entries, sorted.
    ///
    /// # Errors
    /// The folder no longer exists; the system refuses.
    pub fn entries(&self) -> io::Result<Vec<OsString>> {
        self.check()?;
        let mut names =
            fs::read_dir(&self.path)?.map(|entry| Ok(entry?.file_name())).collect::<io::Result<Vec<_>>>()?;
        names.sort();
        Ok(names)
    }

    /// Returns whether an entry has this name, including a link whose target does not exist.
    pub fn has(&self, name: impl AsRef<OsStr>) -> bool {
        self.entry_path(name).and_then(fs::symlink_metadata).is_ok()
    }

    /// Returns whether the entry is a folder and not a link to one.
    pub fn has_folder(&self, name: impl AsRef<OsStr>) -> bool {
        self.entry_path(name).and_then(fs::symlink_metadata).is_ok_and(|found| found.is_dir())
    }

    /// Renames the entry `from` to `name` in the folder `to`.
    ///
    /// # Errors
    /// No entry has this name; the system refuses, for example while a program has a file in the entry open.
    pub fn rename(&self, from: impl AsRef<OsStr>, to: &FolderHandle, name: impl AsRef<OsStr>) -> io::Result<()> {
        fs::rename(self.entry_path(from)?, to.entry_path(name)?)
    }

    /// Moves the entry at the relative path `from` to the path `to`.
    ///
    /// # Errors
    /// As for [`FolderHandle::rename`].
    pub fn move_to(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(self.entry_path(from)?, to)
    }

    /// Removes the entry `name`; a folder is removed with its content. A link is removed, its target is not.
    ///
    /// # Errors
    /// No entry has this name; an entry cannot be removed.
    pub fn remove(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        let path = self.entry_path(name)?;
        match fs::symlink_metadata(&path)?.file_type() {
            // The standard library removes the folder by handles and follows no link.
            found if found.is_dir() => fs::remove_dir_all(path),
            found if found.is_symlink_dir() => fs::remove_dir(path),
            _ => fs::remove_file(path),
        }
    }

    /// Removes the empty folder `name`. Any other entry stays and is an error.
    ///
    /// # Errors
    /// No empty folder has this name; the system refuses.
    pub fn remove_empty(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        let path = self.entry_path(name)?;
        folder_identity(&path)?;
        fs::remove_dir(path)
    }

    /// Does nothing: Windows cannot write the entries of a folder through to the disk.
    ///
    /// # Errors
    /// None.
    pub fn sync(&self) -> io::Result<()> {
        Ok(())
    }

    /// Returns the path of the entry `name`, after [`FolderHandle::check`] has confirmed the path of the folder.
    fn entry_path(&self, name: impl AsRef<OsStr>) -> io::Result<PathBuf> {
        self.check()?;
        Ok(self.path.join(name.as_ref()))
    }

    /// Checks that the path still leads to the folder that was opened.
    fn check(&self) -> io::Result<()> {
        match folder_identity(&self.path)? == self.identity {
            true => Ok(()),
            false => Err(io::Error::other("the folder was replaced by another one")),
        }
    }
}

/// Returns the identity of the folder at `path`. A link is an error.
fn folder_identity(path: &Path) -> io::Result<FileIdentity> {
    let flags = FILE_FLAG_BACKUP_SEMANTICS | FILE_FLAG_OPEN_REPARSE_POINT;
    let folder = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    match folder.metadata()?.is_dir() {
        true => Ok(FileStatus::from_file(&folder)?.identity),
        false => Err(io::ErrorKind::NotADirectory.into()),
    }
}
