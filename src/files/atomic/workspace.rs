//! Workspaces: hidden folders in which outputs are written before they get their names.
//!
//! A workspace `.<name>.<random>.splatsieve-tmp` lies beside its target. It holds the file `lock` and the output being
//! written. While an earlier output folder is being replaced, it also holds that folder. The lock file contains a line
//! that marks the workspace as created by this program; a folder without this line is foreign and stays untouched,
//! whatever its name is.
//!
//! The system releases a lock when the process that holds it ends for any reason, so a workspace whose lock can be
//! taken is a leftover. Locks work between operating-system containers and, if the file system supports it, between
//! machines. Process ids are not used, because they have another meaning in every such container. On a file system
//! without locks no workspace is recognized as a leftover; the user has to remove it.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File, TryLockError};
use std::io::{self, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use splat_platform::{FileIdentity, FolderHandle, create_private_folder, private_permissions};

use super::ownership::{exists, split_target};
use crate::error::{Error, Result};

/// Placeholder for the name of the output in the folder name `.NAME.RANDOM.splatsieve-tmp` of a workspace (hidden
/// folder) that holds a scratch file. A scratch file belongs to no output, so it has no output name.
pub(super) const SCRATCH: &str = "splatsieve-scratch";
/// Ending of the names of workspaces (hidden folders in which outputs are written).
const ENDING: &str = ".splatsieve-tmp";
/// Name of the lock file in a workspace (hidden folder in which an output is written). A run keeps this file locked
/// until it ends.
const LOCK: &str = "lock";
/// Content of the lock file of a workspace (hidden folder in which an output is written). It marks the folder as
/// created by this program.
pub(super) const LOCK_LINE: &str = "workspace of a splatsieve run\n";
/// Name, inside a workspace (hidden folder), of the output file or folder that is being written.
pub(super) const CONTENT: &str = "content";
/// Name, inside a workspace (hidden folder), of an earlier output folder that is being replaced. Files in it that its
/// summary does not list are moved into the new output folder.
pub(super) const REPLACED: &str = "replaced";
/// Name that a file or folder gets inside a workspace (hidden folder) when it is no longer needed. It is deleted with
/// the workspace.
pub(super) const DISCARDED: &str = "discarded";
/// File name of the journal inside a workspace (hidden folder). The journal lists the files of one result, which get
/// their final names together.
pub(super) const JOURNAL: &str = "journal";
/// Names of the entries of a workspace that must not be deleted with it: an earlier output folder, and a journal (list
/// of files that get their final names together). The next run with the same output restores the earlier folder, or
/// completes or reverts the moves in the journal.
const UNFINISHED: [&str; 2] = [REPLACED, JOURNAL];

/// Table of the workspaces (hidden output folders) of this process: path and identity of each folder. A thread locks
/// the table while it moves a result to its final name, so that a signal handler runs before or after the move, not
/// during it.
static LIVE_WORKSPACES: Mutex<BTreeMap<PathBuf, FileIdentity>> = Mutex::new(BTreeMap::new());

/// Locks the table of the hidden output folders (workspaces) of this process and returns it: the identity of each
/// folder by its path.
pub(super) fn live_workspaces() -> MutexGuard<'static, BTreeMap<PathBuf, FileIdentity>> {
    // The table is consistent even if a thread panicked while holding the lock.
    LIVE_WORKSPACES.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Hidden folder in which one output is written. Dropping this value removes the folder, unless the folder holds an
/// interrupted move of a result.
#[derive(Debug)]
pub(super) struct Workspace {
    pub(super) folder: PathBuf,
    identity: FileIdentity,
    /// Locked lock file; `None` on a file system without locks.
    lock: Option<File>,
}

impl Workspace {
    /// Creates a workspace (hidden folder) beside the output path `target`.
    pub(super) fn beside(target: &Path) -> Result<Workspace> {
        let (parent, name) = split_target(target)?;
        let mut prefix = OsString::from(".");
        prefix.push(name);
        prefix.push(".");
        loop {
            // Keep the table locked until the folder is entered in it, so that a signal handler knows the folder.
            let mut live = live_workspaces();
            let mut builder = tempfile::Builder::new();
            builder.prefix(&prefix).suffix(ENDING);
            // Set private permissions: until the lock file contains the marker line, [`Leftover::take`] recognizes the
            // folder by these permissions.
            if let Some(private) = private_permissions() {
                builder.permissions(private);
            }
            let made = builder.tempdir_in(&parent).map_err(Error::io("create a folder in", &parent))?;
            let claimed = lock_and_mark(made.path()).map_err(Error::io("create a lock in", made.path()))?;
            if let Some(workspace) = claimed {
                let _ = made.keep();
                live.insert(workspace.folder.clone(), workspace.identity);
                return Ok(workspace);
            }
        }
    }

    /// Creates a workspace (hidden output folder) called `name` in the folder `parent`; returns `None` if the name is
    /// taken.
    pub(super) fn with_name(parent: &Path, name: &OsStr) -> io::Result<Option<Workspace>> {
        let folder = parent.join(name);
        let mut live = live_workspaces();
        match create_private_folder(&folder) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => return Ok(None),
            made => made?,
        }
        let claimed = lock_and_mark(&folder);
        match &claimed {
            Ok(Some(workspace)) => _ = live.insert(folder, workspace.identity),
            Ok(None) => (),
            Err(_) => {
                let _ = fs::remove_file(folder.join(LOCK));
                let _ = fs::remove_dir(&folder);
            }
        }
        claimed
    }

    /// Returns the path, inside this hidden folder, at which the output is written.
    pub(super) fn content(&self) -> PathBuf {
        self.folder.join(CONTENT)
    }

    /// Syncs the lock file and the list of entries of the workspace folder to disk, but not the output in it.
    pub(super) fn sync(&self) -> io::Result<()> {
        if let Some(lock) = &self.lock {
            lock.sync_all()?;
        }
        FolderHandle::open(&self.folder)?.sync()
    }
}

impl Drop for Workspace {
    fn drop(&mut self) {
        let mut live = live_workspaces();
        live.remove(&self.folder);
        if !must_stay(&self.folder) {
            remove_workspace(&self.folder, self.identity, self.lock.take());
        }
    }
}

/// Returns whether the workspace at the path `folder` holds an earlier output folder, or a journal of files to be
/// renamed. Both are needed to repair an interrupted move of a result, so such a workspace must not be deleted.
fn must_stay(folder: &Path) -> bool {
    UNFINISHED.iter().any(|name| exists(&folder.join(name)))
}

/// Returns the name of the hidden folder that serves as a lock while a result called `name` is moved to its final path.
/// Every run uses the same name, so only one run can create the folder.
pub(super) fn publishing_name(name: &OsStr) -> OsString {
    let mut workspace = OsString::from(".");
    workspace.push(name);
    workspace.push(".publish");
    workspace.push(ENDING);
    workspace
}

/// Returns whether the workspace `folder` holds traces of an interrupted run: the previous output folder, set aside
/// while it was being replaced, or a journal (list of files that get their final names together). The previous folder
/// must be restored, or the moves completed or reverted, before the workspace is removed.
pub(super) fn is_unfinished(folder: &FolderHandle) -> bool {
    UNFINISHED.iter().any(|name| folder.has(name))
}

/// Returns whether `entry` is the folder name of a workspace for an output called `name`. Such a folder name has the
/// form `.NAME.RANDOM.splatsieve-tmp`, where NAME is `name`.
pub(super) fn is_workspace(entry: &OsStr, name: &OsStr) -> bool {
    let rest = entry.as_encoded_bytes().strip_prefix(b".").and_then(|rest| rest.strip_prefix(name.as_encoded_bytes()));
    let random = rest.and_then(|rest| rest.strip_prefix(b".")?.strip_suffix(ENDING.as_bytes()));
    random.is_some_and(|random| !random.is_empty() && random.iter().all(u8::is_ascii_alphanumeric))
}

/// Returns the name of the output that is written in a workspace (hidden folder), given the folder name `entry` of this
/// workspace. Returns `None` if `entry` is not the name of a workspace.
pub(super) fn target_name(entry: &OsStr) -> Option<&str> {
    hidden_name(entry, ENDING)
}

/// Returns NAME if `entry` has the form `.NAME.RANDOM` followed by `ending`; `None` for other entries.
fn hidden_name<'a>(entry: &'a OsStr, ending: &str) -> Option<&'a str> {
    let name = entry.to_str()?.strip_prefix('.')?.strip_suffix(ending)?;
    Some(name.rsplit_once('.')?.0)
}

/// Translates `path`, a path in a workspace (hidden folder), into a path that the user knows, and returns whether it
/// was the path of a scratch file:
///
/// - for an output: the output path that the user gave, or a file in the output folder, and `false`
/// - for a scratch file: the folder that contains the workspace, and `true`
/// - for a path outside workspaces: `None`
pub(super) fn user_path(path: &Path) -> Option<(PathBuf, bool)> {
    let mut parts = path.components();
    let mut before = PathBuf::new();
    let name = loop {
        let part = parts.next()?;
        match target_name(part.as_os_str()) {
            Some(name) => break name,
            None => before.push(part),
        }
    };
    if name == SCRATCH {
        return Some((before, true));
    }
    before.push(name);
    // An output that is a container lies in the workspace under one more hidden name.
    before.extend(
        parts
            .skip(1)
            .map(|part| hidden_name(part.as_os_str(), ".tmp").map_or_else(|| part.as_os_str().to_owned(), Into::into)),
    );
    Some((before, false))
}

/// Guard returned by [`remove_unfinished`] when the process is about to end. As long as it exists, no thread of this
/// process can create, publish or remove an output.
#[must_use = "runs go on as soon as this is dropped"]
pub struct ExitGuard(
    #[allow(dead_code, reason = "held, not read")] MutexGuard<'static, BTreeMap<PathBuf, FileIdentity>>,
);

/// Removes all outputs of this process that do not have their final names yet. Called when the process is about to end.
///
/// Returns a guard: as long as it exists, no thread of this process can begin or publish an output. First waits until a
/// result that is being moved to its final name is complete. Files outside workspaces (hidden output folders) stay.
pub fn remove_unfinished() -> ExitGuard {
    let mut live = live_workspaces();
    for (folder, identity) in std::mem::take(&mut *live) {
        if must_stay(&folder) {
            continue;
        }
        // Threads that are still writing into the folder fail from now on, because its path is gone.
        let _ = fs::rename(folder.join(CONTENT), folder.join(DISCARDED));
        // Try again, because a thread may create a file while the folder is being emptied.
        for _ in 0..100 {
            remove_workspace(&folder, identity, None);
            if !exists(&folder) {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    ExitGuard(live)
}

/// Claims the new folder `folder` as a workspace: creates a lock file in it, locks the file and writes the line
/// [`LOCK_LINE`]. Returns `None` if another run took the new folder for the leftover of a killed run and is removing
/// it.
fn lock_and_mark(folder: &Path) -> io::Result<Option<Workspace>> {
    let lost = |error: io::Error| match error.kind() {
        io::ErrorKind::NotFound | io::ErrorKind::AlreadyExists => Ok(None),
        _ => Err(error),
    };
    let handle = match FolderHandle::open(folder) {
        Ok(handle) => handle,
        Err(error) => return lost(error),
    };
    let mut file = match handle.create_file(LOCK) {
        Ok(file) => file,
        Err(error) => return lost(error),
    };
    let lock = match file.try_lock() {
        Err(TryLockError::WouldBlock) => return Ok(None),
        // A run that removes a workspace deletes its lock file before it releases the lock. So if the lock file still
        // exists under its name, the workspace is not being removed.
        Ok(()) if handle.entry_is_file(LOCK, &file) => true,
        Ok(()) => return Ok(None),
        Err(TryLockError::Error(_)) => false,
    };
    file.write_all(LOCK_LINE.as_bytes())?;
    let identity = handle.status()?.identity;
    Ok(Some(Workspace { folder: folder.to_owned(), identity, lock: lock.then_some(file) }))
}

/// Workspace (hidden output folder) of a run that has ended. This process holds its lock.
pub(super) struct Leftover {
    name: OsString,
    pub(super) folder: FolderHandle,
    lock: File,
}

/// Reason why [`Leftover::take`] does not take a workspace (hidden output folder): it may still be in use, or it is not
/// a folder that a killed run of this program left.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refusal {
    /// The run that created the workspace is still alive, or another run is inspecting the workspace.
    Busy,
    /// The folder no longer exists, belongs to this process or to another user, was not created by this program, or its
    /// lock file cannot be locked.
    Foreign,
}

impl Leftover {
    /// Locks and returns the workspace (hidden output folder) `name` in the folder `parent` if this program created it
    /// for this user and its run has ended; otherwise returns the reason for refusing it.
    pub(super) fn take(parent: &FolderHandle, name: &OsStr) -> std::result::Result<Leftover, Refusal> {
        let foreign = |_: io::Error| Refusal::Foreign;
        let folder = parent.open_folder(name).map_err(foreign)?;
        let status = folder.status().map_err(foreign)?;
        // Skip workspaces of this process: a network file system may release this process's own lock when the lock file
        // is opened a second time.
        if !status.is_own || live_workspaces().values().any(|&identity| identity == status.identity) {
            return Err(Refusal::Foreign);
        }
        let mut lock = match folder.open_file(LOCK, true) {
            Ok(lock) => lock,
            Err(error) => {
                // Either the run is about to create the lock file (it will then fail and try again), or another run has
                // almost removed the folder.
                if error.kind() == io::ErrorKind::NotFound {
                    let _ = parent.remove_empty(name);
                }
                return Err(Refusal::Foreign);
            }
        };
        match lock.try_lock() {
            Ok(()) => (),
            Err(TryLockError::WouldBlock) => return Err(Refusal::Busy),
            Err(TryLockError::Error(_)) => return Err(Refusal::Foreign),
        }
        let mut line = String::new();
        (&mut lock).take(LOCK_LINE.len() as u64 + 1).read_to_string(&mut line).map_err(foreign)?;
        // A run that was killed before it wrote the marker line leaves a folder with private permissions and an empty
        // or partly written lock file.
        let is_begun =
            || LOCK_LINE.starts_with(&line) && status.is_private && folder.entries().is_ok_and(|names| names == [LOCK]);
        let is_marked = line == LOCK_LINE || is_begun();
        if is_marked { Ok(Leftover { name: name.to_owned(), folder, lock }) } else { Err(Refusal::Foreign) }
    }

    /// Removes the workspace from the folder `parent`. Entries that cannot be removed stay; they do no harm.
    pub(super) fn remove(self, parent: &FolderHandle) {
        remove_content(&self.folder, Some(self.lock));
        let _ = parent.remove_empty(&self.name);
    }
}

/// Removes the workspace (hidden output folder) at the path `folder`, but only if the folder at this path still has the
/// identity `identity`: another folder may have taken its place. `lock` is its lock file; `None` on a file system
/// without locks.
fn remove_workspace(folder: &Path, identity: FileIdentity, lock: Option<File>) {
    let Ok((parent, name)) = split_target(folder) else { return };
    let Ok(parent) = FolderHandle::open(&parent) else { return };
    let Ok(handle) = parent.open_folder(name) else { return };
    if handle.status().is_ok_and(|status| status.identity == identity) {
        remove_content(&handle, lock);
        let _ = parent.remove_empty(name);
    }
}

/// Deletes everything in the workspace `folder`. `lock` is its locked lock file, if there is one. The lock file is
/// deleted last and before its lock is released, so a run that gets the lock afterwards sees that the file is gone.
fn remove_content(folder: &FolderHandle, lock: Option<File>) {
    for entry in folder.entries().unwrap_or_default().iter().filter(|entry| *entry != LOCK) {
        let _ = folder.remove(entry);
    }
    if folder.entries().is_ok_and(|entries| entries.iter().all(|entry| entry == LOCK)) {
        let _ = folder.remove(LOCK);
    }
    drop(lock);
}
