//! Folders addressed by their paths, for Windows has no operations relative to an open folder in its documented interface.
//!
//! Before each operation the path is checked: it must still lead to the folder that was opened, without a link. Another
//! program may replace the folder between this check and the operation, which Linux and macOS exclude. No folder counts as
//! one of this user, so the program takes over and removes only folders of its own process.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::windows::fs::{FileTypeExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use windows_sys::Win32::Storage::FileSystem::{FILE_FLAG_BACKUP_SEMANTICS, FILE_FLAG_OPEN_REPARSE_POINT};

use crate::{FileIdentity, FileStatus, FolderStatus};

/// An open folder. Names are relative to it and links are never followed.
#[derive(Debug)]
pub struct FolderHandle {
    /// Absolute and without links.
    path: PathBuf,
    identity: FileIdentity,
}

impl FolderHandle {
    /// Opens the folder at `path`, or the folder that a link at `path` leads to.
    ///
    /// # Errors
    /// No folder there; the system refuses.
    pub fn open(path: &Path) -> io::Result<FolderHandle> {
        let path = fs::canonicalize(path)?;
        let identity = folder_identity(&path)?;
        Ok(FolderHandle { path, identity })
    }

    /// Opens the folder `name` in this folder. A link is an error.
    ///
    /// # Errors
    /// No folder of that name; the system refuses.
    pub fn open_folder(&self, name: impl AsRef<OsStr>) -> io::Result<FolderHandle> {
        let path = self.place(name)?;
        let identity = folder_identity(&path)?;
        Ok(FolderHandle { path, identity })
    }

    /// Opens the regular file `name` for reading and, if asked for, writing. Anything else is an error.
    ///
    /// # Errors
    /// No regular file of that name; the system refuses.
    pub fn open_file(&self, name: &str, writes: bool) -> io::Result<File> {
        let mut options = OpenOptions::new();
        options.read(true).write(writes).custom_flags(FILE_FLAG_OPEN_REPARSE_POINT);
        let file = options.open(self.place(name)?)?;
        match file.metadata()?.is_file() {
            true => Ok(file),
            false => Err(io::Error::other("not a regular file")),
        }
    }

    /// Creates the file `name`; an entry of that name is an error.
    ///
    /// # Errors
    /// An entry of that name; the system refuses.
    pub fn create_file(&self, name: &str) -> io::Result<File> {
        OpenOptions::new().read(true).write(true).create_new(true).open(self.place(name)?)
    }

    /// Whether the entry `name` is the open file `file`.
    pub fn names_file(&self, name: &str, file: &File) -> bool {
        let named = self.open_file(name, false).and_then(|named| FileStatus::from_file(&named));
        let open = FileStatus::from_file(file);
        named.is_ok_and(|named| open.is_ok_and(|open| named.identity == open.identity))
    }

    /// Identity of this folder. Owner and permissions are not read.
    ///
    /// # Errors
    /// The folder is gone.
    pub fn status(&self) -> io::Result<FolderStatus> {
        self.check()?;
        Ok(FolderStatus { identity: self.identity, is_own: false, is_private: false })
    }

    /// Names of all entries, sorted.
    ///
    /// # Errors
    /// The folder is gone; the system refuses.
    pub fn entries(&self) -> io::Result<Vec<OsString>> {
        self.check()?;
        let mut names =
            fs::read_dir(&self.path)?.map(|entry| Ok(entry?.file_name())).collect::<io::Result<Vec<_>>>()?;
        names.sort();
        Ok(names)
    }

    /// Whether an entry has this name, a link to nothing included.
    pub fn has(&self, name: impl AsRef<OsStr>) -> bool {
        self.place(name).and_then(fs::symlink_metadata).is_ok()
    }

    /// Whether the entry is a folder and not a link to one.
    pub fn has_folder(&self, name: impl AsRef<OsStr>) -> bool {
        self.place(name).and_then(fs::symlink_metadata).is_ok_and(|found| found.is_dir())
    }

    /// Renames the entry `from` to `name` in `to`.
    ///
    /// # Errors
    /// No entry of that name; the system refuses, as it does while a program has a file in it open.
    pub fn rename(&self, from: impl AsRef<OsStr>, to: &FolderHandle, name: impl AsRef<OsStr>) -> io::Result<()> {
        fs::rename(self.place(from)?, to.place(name)?)
    }

    /// Renames the entry at the relative path `from` to `to`.
    ///
    /// # Errors
    /// Those of [`FolderHandle::rename`].
    pub fn move_to(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(self.place(from)?, to)
    }

    /// Removes the entry `name`, a folder with everything in it. A link is removed, its target is not.
    ///
    /// # Errors
    /// No entry of that name; an entry that cannot be removed.
    pub fn remove(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        let path = self.place(name)?;
        match fs::symlink_metadata(&path)?.file_type() {
            // The standard library removes it by handles and follows no link.
            found if found.is_dir() => fs::remove_dir_all(path),
            found if found.is_symlink_dir() => fs::remove_dir(path),
            _ => fs::remove_file(path),
        }
    }

    /// Removes the empty folder `name`; anything else is an error and stays.
    ///
    /// # Errors
    /// No empty folder of that name; the system refuses.
    pub fn remove_empty(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        let path = self.place(name)?;
        folder_identity(&path)?;
        fs::remove_dir(path)
    }

    /// Does nothing: Windows cannot write the names in a folder through to the disk.
    ///
    /// # Errors
    /// None.
    pub fn sync(&self) -> io::Result<()> {
        Ok(())
    }

    /// Returns the path of the entry `name`, once [`FolderHandle::check`] has confirmed the path of the folder.
    fn place(&self, name: impl AsRef<OsStr>) -> io::Result<PathBuf> {
        self.check()?;
        Ok(self.path.join(name.as_ref()))
    }

    /// Confirms that the path still leads to the folder that was opened.
    fn check(&self) -> io::Result<()> {
        match folder_identity(&self.path)? == self.identity {
            true => Ok(()),
            false => Err(io::Error::other("the folder was replaced by another one")),
        }
    }
}

/// Identity of the folder at `path`. A link is an error.
fn folder_identity(path: &Path) -> io::Result<FileIdentity> {
    let flags = FILE_FLAG_BACKUP_SEMANTICS | FILE_FLAG_OPEN_REPARSE_POINT;
    let folder = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    match folder.metadata()?.is_dir() {
        true => Ok(FileStatus::from_file(&folder)?.identity),
        false => Err(io::ErrorKind::NotADirectory.into()),
    }
}
