//! Folders that are addressed by their paths, because the documented interface of Windows has no operations relative to
//! an open folder.
//!
//! Each operation first checks that the path still leads to the folder that was opened, without a link. Another program
//! may replace the folder between this check and the operation; the implementation for Linux and macOS excludes this.
//! The owner of a folder is not read: [`FolderStatus::is_own`] is always false. So the program reuses and removes only
//! folders that this process has created, never those that an earlier run left.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::windows::fs::{FileTypeExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use windows_sys::Win32::Storage::FileSystem::{FILE_FLAG_BACKUP_SEMANTICS, FILE_FLAG_OPEN_REPARSE_POINT};

use crate::{FileIdentity, FileStatus, FolderStatus};

/// Handle of an open folder. Its methods address the entries of this folder by name, and do not follow an entry that is
/// a link.
#[derive(Debug)]
pub struct FolderHandle {
    /// Absolute path of the folder, without links.
    path: PathBuf,
    /// Identity of the folder when it was opened.
    identity: FileIdentity,
}

impl FolderHandle {
    /// Opens the folder at `path`. Follows links in `path`.
    ///
    /// # Errors
    /// Fails if the folder does not exist or the system refuses.
    pub fn open(path: &Path) -> io::Result<FolderHandle> {
        let path = fs::canonicalize(path)?;
        let identity = folder_identity(&path)?;
        Ok(FolderHandle { path, identity })
    }

    /// Opens the folder `name` in this folder.
    ///
    /// # Errors
    /// Fails if the entry `name` is missing, is not a folder, or is a link, or if the system refuses.
    pub fn open_folder(&self, name: impl AsRef<OsStr>) -> io::Result<FolderHandle> {
        let path = self.entry_path(name)?;
        let identity = folder_identity(&path)?;
        Ok(FolderHandle { path, identity })
    }

    /// Opens the regular file `name` for reading and, if `writes`, also for writing.
    ///
    /// # Errors
    /// Fails if the entry `name` is missing or is not a regular file, or if the system refuses.
    pub fn open_file(&self, name: &str, writes: bool) -> io::Result<File> {
        let mut options = OpenOptions::new();
        options.read(true).write(writes).custom_flags(FILE_FLAG_OPEN_REPARSE_POINT);
        let file = options.open(self.entry_path(name)?)?;
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
        OpenOptions::new().read(true).write(true).create_new(true).open(self.entry_path(name)?)
    }

    /// Returns whether the entry `name` of this folder is the file that is open as `file`.
    pub fn entry_is_file(&self, name: &str, file: &File) -> bool {
        let named = self.open_file(name, false).and_then(|named| FileStatus::from_file(&named));
        let open = FileStatus::from_file(file);
        named.is_ok_and(|named| open.is_ok_and(|open| named.identity == open.identity))
    }

    /// Returns the identity of this folder. Owner and permissions are not read; their fields are false.
    ///
    /// # Errors
    /// Fails if the folder no longer exists.
    pub fn status(&self) -> io::Result<FolderStatus> {
        self.check()?;
        Ok(FolderStatus { identity: self.identity, is_own: false, is_private: false })
    }

    /// Returns the names of all entries of this folder in sorted order.
    ///
    /// # Errors
    /// Fails if the folder no longer exists or the system refuses.
    pub fn entries(&self) -> io::Result<Vec<OsString>> {
        self.check()?;
        let mut names =
            fs::read_dir(&self.path)?.map(|entry| Ok(entry?.file_name())).collect::<io::Result<Vec<_>>>()?;
        names.sort();
        Ok(names)
    }

    /// Returns whether this folder has an entry `name`, which may be a link whose target does not exist.
    pub fn has(&self, name: impl AsRef<OsStr>) -> bool {
        self.entry_path(name).and_then(fs::symlink_metadata).is_ok()
    }

    /// Returns whether the entry `name` is a folder, and not a link to one.
    pub fn has_folder(&self, name: impl AsRef<OsStr>) -> bool {
        self.entry_path(name).and_then(fs::symlink_metadata).is_ok_and(|found| found.is_dir())
    }

    /// Moves the entry `from` of this folder to the folder `to`, under the name `name`.
    ///
    /// # Errors
    /// Fails if there is no entry `from` or the system refuses, for example while a program has the file, or a file in
    /// the folder, open.
    pub fn rename(&self, from: impl AsRef<OsStr>, to: &FolderHandle, name: impl AsRef<OsStr>) -> io::Result<()> {
        fs::rename(self.entry_path(from)?, to.entry_path(name)?)
    }

    /// Moves the entry at the path `from`, relative to this folder, to the path `to`, relative to the current folder of
    /// the process.
    ///
    /// # Errors
    /// Fails if there is no entry `from` or the system refuses.
    pub fn move_entry(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(self.entry_path(from)?, to)
    }

    /// Removes the entry `name`, a folder together with its content. If the entry is a link, its target stays.
    ///
    /// # Errors
    /// Fails if there is no entry `name` or an entry cannot be removed.
    pub fn remove(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        let path = self.entry_path(name)?;
        match fs::symlink_metadata(&path)?.file_type() {
            // The standard library removes a folder through open handles and follows no link.
            found if found.is_dir() => fs::remove_dir_all(path),
            found if found.is_symlink_dir() => fs::remove_dir(path),
            _ => fs::remove_file(path),
        }
    }

    /// Removes the entry `name` if it is an empty folder.
    ///
    /// # Errors
    /// Fails, and removes nothing, if the entry `name` is missing or is not an empty folder, or if the system refuses.
    pub fn remove_empty(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        let path = self.entry_path(name)?;
        folder_identity(&path)?;
        fs::remove_dir(path)
    }

    /// Does nothing: Windows cannot write the entries of a folder through to the disk.
    ///
    /// # Errors
    /// Never fails.
    pub fn sync(&self) -> io::Result<()> {
        Ok(())
    }

    /// Returns the path of the entry `name`. First checks that the path of this folder still leads to the folder that
    /// was opened.
    fn entry_path(&self, name: impl AsRef<OsStr>) -> io::Result<PathBuf> {
        self.check()?;
        Ok(self.path.join(name.as_ref()))
    }

    /// Fails if the path of this folder no longer leads to the folder that was opened.
    fn check(&self) -> io::Result<()> {
        match folder_identity(&self.path)? == self.identity {
            true => Ok(()),
            false => Err(io::Error::other("the folder was replaced by another one")),
        }
    }
}

/// Returns the identity of the folder at `path`. Fails if `path` is a link or is not a folder.
fn folder_identity(path: &Path) -> io::Result<FileIdentity> {
    let flags = FILE_FLAG_BACKUP_SEMANTICS | FILE_FLAG_OPEN_REPARSE_POINT;
    let folder = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    match folder.metadata()?.is_dir() {
        true => Ok(FileStatus::from_file(&folder)?.identity),
        false => Err(io::ErrorKind::NotADirectory.into()),
    }
}
