//! Kinds of outputs, the policy for replacing existing files, and the check of an output path.

use std::fs;
use std::path::{Path, PathBuf};

use splat_platform::{FileKind, is_system_folder};

use super::ownership::{ListedFiles, SUMMARY_FILE, entries, split_target};
use crate::error::{Error, Result, ShowPath};

/// Kind of an output: file or folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TargetKind {
    /// A single file.
    File,
    /// A folder with all its content.
    Folder,
}

/// Policy for an output path that already exists: replace the existing file or folder, or refuse.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
pub enum Replace {
    /// Existing outputs are never replaced.
    #[default]
    Never,
    /// A file is replaced, whatever it holds: the user named it. A folder is replaced only if it is empty or has a
    /// summary of this program (`summary.json`, which lists the files of a result):
    ///
    /// - Files that the summary lists are replaced.
    /// - All other files stay. If the new result has a file of the same name, `.kept` is appended to the name of the
    ///   old file.
    Existing,
}

/// Kind of file or folder that exists at an output path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Destination {
    /// Nothing exists at the path.
    Free,
    /// A regular file or a link to a regular file.
    File,
    /// A folder.
    Folder,
    /// A link that leads to a folder.
    FolderLink,
    /// A character device or FIFO, or a link to one. The output is written into the device or FIFO, which is never
    /// replaced.
    Stream,
}

/// Returns what exists at the path `target`.
///
/// # Errors
/// Fails with [`Error::Usage`] for sockets, block devices, dangling links, and links that lead to a regular file
/// through a link in a system folder, such as `/dev/stdout` if it is redirected to a file. This program neither writes
/// nor replaces any of these.
pub(super) fn destination(target: &Path) -> Result<Destination> {
    // Without a separator at the end, because `link/` is the folder that the link leads to.
    let (parent, name) = split_target(target)?;
    let entry = parent.join(name);
    let refuse = |what: &str| Err(Error::usage(format!("{} is {what}; give another output", target.shown())));
    let Ok(named) = fs::symlink_metadata(&entry) else { return Ok(Destination::Free) };
    let is_link = named.is_symlink();
    let found = match fs::metadata(&entry) {
        Ok(found) => found.file_type(),
        Err(_) if is_link => return refuse("a link to nothing (its target does not exist), which is not replaced"),
        Err(error) => return Err(Error::io("examine", target)(error)),
    };
    match FileKind::from_type(found) {
        FileKind::CharacterDevice | FileKind::Fifo => Ok(Destination::Stream),
        // Standard output that is redirected to a file, for example `/dev/stdout`: replacing the link would replace a
        // link that belongs to the system.
        FileKind::File if is_link && leads_through_system_link(&entry) => {
            refuse("a link of the system, which is not replaced")
        }
        FileKind::File => Ok(Destination::File),
        FileKind::Folder if is_link => Ok(Destination::FolderLink),
        FileKind::Folder => Ok(Destination::Folder),
        FileKind::Socket => refuse("a socket, which cannot be written"),
        FileKind::BlockDevice | FileKind::Link | FileKind::Other => refuse("a block device, which is not replaced"),
    }
}

/// Returns whether `target` is a link that lies in a system folder, as `/dev/stdout` does, or leads to such a link.
/// Such a link must not be replaced.
fn leads_through_system_link(target: &Path) -> bool {
    let mut link = target.to_owned();
    // Follow at most 40 links, as Linux does.
    for _ in 0..40 {
        let Ok((parent, name)) = split_target(&link) else { return false };
        let Ok(parent) = fs::canonicalize(parent) else { return false };
        let Ok(leads_to) = fs::read_link(parent.join(name)) else { return false };
        if is_system_folder(&parent) {
            return true;
        }
        link = parent.join(leads_to);
    }
    false
}

/// Checks that an existing file or folder at `target` may be replaced by an output of `kind`. Passes if nothing exists
/// there.
///
/// # Errors
/// Fails with [`Error::Usage`] if a file would replace a folder or a folder would replace a file, or if `replace` does
/// not allow replacing what exists.
pub(super) fn check_replace(target: &Path, kind: TargetKind, replace: Replace) -> Result<()> {
    let shown = target.shown();
    let found = destination(target)?;
    match (kind, found) {
        (_, Destination::Free) => Ok(()),
        (TargetKind::File, Destination::Stream) => {
            Err(Error::usage(format!("{shown} became a device or FIFO, which is not replaced; give another output")))
        }
        (TargetKind::Folder, Destination::Folder) if is_empty_folder(target) => Ok(()),
        (_, Destination::File | Destination::Folder | Destination::FolderLink) if replace == Replace::Never => {
            Err(Error::usage(format!(
                "{shown} exists already\n  --overwrite replaces a file, or the files of an earlier result in a folder; or name another output"
            )))
        }
        (TargetKind::File, Destination::Folder | Destination::FolderLink) => {
            Err(Error::usage(format!("{shown} is a folder; a file cannot replace it")))
        }
        (TargetKind::Folder, Destination::FolderLink) => {
            Err(Error::usage(format!("{shown} is a link to a folder, which is not replaced; name the folder itself")))
        }
        (TargetKind::Folder, Destination::File | Destination::Stream) => {
            Err(Error::usage(format!("{shown} is no folder; a folder cannot replace it")))
        }
        (TargetKind::File, Destination::File) => Ok(()),
        (TargetKind::Folder, Destination::Folder) => check_folder(target),
    }
}

/// Checks that the folder at `target` is an earlier result of this program whose summary lists its files. Fails with
/// [`Error::Usage`] if it is not.
fn check_folder(target: &Path) -> Result<()> {
    let shown = target.shown();
    match ListedFiles::read(&target.join(SUMMARY_FILE)) {
        ListedFiles::Listed(_) => Ok(()),
        ListedFiles::Unknown => Err(Error::usage(format!(
            "{shown} is not a result of splatsieve (no {SUMMARY_FILE} in it that lists its files), so --overwrite leaves it as it is\n  \
             remove the folder first, or name another output"
        ))),
    }
}

/// Returns whether `target` is an empty folder and not a link to one.
fn is_empty_folder(target: &Path) -> bool {
    fs::symlink_metadata(target).is_ok_and(|found| found.is_dir())
        && entries(target).is_ok_and(|entries| entries.is_empty())
}

/// Returns the real path (without links) of the folder that `target` is written into.
///
/// # Errors
/// Fails with [`Error::Usage`] if the target has no name, or if its folder does not exist or is not a folder.
pub(super) fn real_parent(target: &Path) -> Result<PathBuf> {
    let (parent, _) = split_target(target)?;
    let real = fs::canonicalize(&parent).map_err(|_| {
        Error::usage(format!(
            "{}: the folder {} to write it into does not exist; create it first",
            target.shown(),
            parent.shown()
        ))
    })?;
    match real.is_dir() {
        true => Ok(real),
        false => Err(Error::usage(format!("{}: {} is not a folder", target.shown(), parent.shown()))),
    }
}
