//! Workspaces: hidden folders in which outputs are written before they get their names.
//!
//! A workspace `.<name>.<random>.splatsieve-tmp` lies beside its target. It holds the file `lock`, the output being
//! written, and, while an earlier folder is replaced, that folder. The lock file contains a line that marks the
//! workspace as created by this program; a folder without it is foreign and stays untouched, whatever its name is.
//!
//! The system releases a lock when the process that holds it ends for any reason, so a workspace whose lock can be
//! taken is a leftover. Locks work between containers and, if the file system supports it, between machines. Process
//! ids are not used, because they have another meaning in every container. On a file system without locks no workspace
//! is recognized as a leftover; the user has to remove it.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File, TryLockError};
use std::io::{self, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use splat_platform::{FileIdentity, FolderHandle, create_private_folder, private_permissions};

use super::named::{exists, split_target};
use crate::error::{Error, Result};

/// Target name of scratch files in any folder.
pub(super) const SCRATCH: &str = "splatsieve-scratch";
/// End of the names of workspaces.
const ENDING: &str = ".splatsieve-tmp";
/// Name of the file whose lock shows that the run is still going on.
const LOCK: &str = "lock";
/// Content of the lock file, which marks the folder as a workspace of this program.
pub(super) const LOCK_LINE: &str = "workspace of a splatsieve run\n";
/// Name in the workspace of the file or folder being written.
pub(super) const CONTENT: &str = "content";
/// Name in the workspace of an earlier folder that is being replaced. Entries that its summary does not list are moved
/// into the new one.
pub(super) const REPLACED: &str = "replaced";
/// Name in the workspace of content that only has to be deleted.
pub(super) const DISCARDED: &str = "discarded";
/// Name of the journal of files that are being published together.
pub(super) const JOURNAL: &str = "journal";
/// Entries that must not be deleted with their workspace: the next run with the same output handles them.
const UNFINISHED: [&str; 2] = [REPLACED, JOURNAL];

/// Workspaces of this process and the identity of their folders. A thread that publishes a result holds the guard, so
/// that a signal is handled either before the result has its name or after.
static LIVE_WORKSPACES: Mutex<BTreeMap<PathBuf, FileIdentity>> = Mutex::new(BTreeMap::new());

/// Locks the table of workspaces of this process.
pub(super) fn live_workspaces() -> MutexGuard<'static, BTreeMap<PathBuf, FileIdentity>> {
    // The map is consistent even if a thread panicked while holding the lock.
    LIVE_WORKSPACES.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Hidden folder for the content of one target. Dropping it removes the folder.
#[derive(Debug)]
pub(super) struct Workspace {
    pub(super) folder: PathBuf,
    identity: FileIdentity,
    /// `None` on a file system without locks.
    lock: Option<File>,
}

impl Workspace {
    /// Creates a workspace beside `target`.
    pub(super) fn beside(target: &Path) -> Result<Workspace> {
        let (parent, name) = split_target(target)?;
        let mut prefix = OsString::from(".");
        prefix.push(name);
        prefix.push(".");
        loop {
            // Held until the folder is in the table, so that a signal handler knows it.
            let mut live = live_workspaces();
            let mut builder = tempfile::Builder::new();
            builder.prefix(&prefix).suffix(ENDING);
            // Private permissions: [`Leftover::take`] recognizes the folder by them before its lock file has the line.
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

    /// Creates the workspace `name` in the folder `parent`; `None` if the name is taken.
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

    /// Returns the path of the output being written in this workspace.
    pub(super) fn content(&self) -> PathBuf {
        self.folder.join(CONTENT)
    }

    /// Returns whether the workspace holds entries that must not be deleted with it.
    fn is_unfinished(&self) -> bool {
        UNFINISHED.iter().any(|name| exists(&self.folder.join(name)))
    }

    /// Syncs the lock file and the names in the workspace to disk.
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
        if !self.is_unfinished() {
            remove_workspace(&self.folder, self.identity, self.lock.take());
        }
    }
}

/// Returns the fixed workspace name that serves as lock for publishing a result called `name`.
pub(super) fn publishing_name(name: &OsStr) -> OsString {
    let mut workspace = OsString::from(".");
    workspace.push(name);
    workspace.push(".publish");
    workspace.push(ENDING);
    workspace
}

/// Returns whether a workspace holds an earlier folder or a journal, which must be handled before it is removed.
pub(super) fn is_unfinished(folder: &FolderHandle) -> bool {
    UNFINISHED.iter().any(|name| folder.has(name))
}

/// Returns whether `entry` is the name of a workspace with a random part for the target `name`.
pub(super) fn is_workspace(entry: &OsStr, name: &OsStr) -> bool {
    let rest = entry.as_encoded_bytes().strip_prefix(b".").and_then(|rest| rest.strip_prefix(name.as_encoded_bytes()));
    let random = rest.and_then(|rest| rest.strip_prefix(b".")?.strip_suffix(ENDING.as_bytes()));
    random.is_some_and(|random| !random.is_empty() && random.iter().all(u8::is_ascii_alphanumeric))
}

/// Returns the target name of the workspace `entry`, or `None` if `entry` is not the name of a workspace.
pub(super) fn target_name(entry: &OsStr) -> Option<&str> {
    hidden_name(entry, ENDING)
}

/// Returns `name` from an entry `.name.random` followed by `ending`.
fn hidden_name<'a>(entry: &'a OsStr, ending: &str) -> Option<&'a str> {
    let name = entry.to_str()?.strip_prefix('.')?.strip_suffix(ending)?;
    Some(name.rsplit_once('.')?.0)
}

/// Translates a path in a workspace into the path that the user gave: the target or a file in it. For a scratch file,
/// whose name means nothing to the user, returns its folder and `true`. Returns `None` for other paths.
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
    // Containers are written under a hidden name of their own.
    before.extend(
        parts
            .skip(1)
            .map(|part| hidden_name(part.as_os_str(), ".tmp").map_or_else(|| part.as_os_str().to_owned(), Into::into)),
    );
    Some((before, false))
}

/// Guard during whose lifetime this process neither publishes nor removes an output; see [`withdraw_all`].
#[must_use = "runs go on as soon as this is dropped"]
pub struct Withdrawn(
    #[allow(dead_code, reason = "held, not read")] MutexGuard<'static, BTreeMap<PathBuf, FileIdentity>>,
);

/// Removes all unpublished outputs of this process, for a process that is about to end.
///
/// Waits for a result that is being published, which is then complete. Files outside workspaces stay.
pub fn withdraw_all() -> Withdrawn {
    let mut live = live_workspaces();
    for (folder, identity) in std::mem::take(&mut *live) {
        if UNFINISHED.iter().any(|name| exists(&folder.join(name))) {
            continue;
        }
        // Threads that are still writing into it fail from here on, because the folder is gone.
        let _ = fs::rename(folder.join(CONTENT), folder.join(DISCARDED));
        // A thread may be creating a file while the folder is emptied, so try again.
        for _ in 0..100 {
            remove_workspace(&folder, identity, None);
            if !exists(&folder) {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    Withdrawn(live)
}

/// Locks and marks the new workspace `folder`; `None` if another run mistook it for a leftover and is removing it.
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
        // has its name, the workspace is not being removed.
        Ok(()) if handle.names_file(LOCK, &file) => true,
        Ok(()) => return Ok(None),
        Err(TryLockError::Error(_)) => false,
    };
    file.write_all(LOCK_LINE.as_bytes())?;
    let identity = handle.status()?.identity;
    Ok(Some(Workspace { folder: folder.to_owned(), identity, lock: lock.then_some(file) }))
}

/// Workspace whose run has ended, with its lock held by this process.
pub(super) struct Leftover {
    name: OsString,
    pub(super) folder: FolderHandle,
    lock: File,
}

/// Reason why a workspace may not be taken as a leftover.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refusal {
    /// Workspace whose run is going on, or that another run is inspecting.
    Busy,
    /// Workspace that is gone, or that this program did not create for this user.
    Foreign,
}

impl Leftover {
    /// Takes the workspace `name` in `parent` if this program created it for this user and its run has ended.
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
                // The run is about to create the lock file (it will fail and try again), or the folder is almost
                // removed.
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
        // A run killed before it wrote the line leaves a private folder with an empty or partly written lock file.
        let is_begun =
            || LOCK_LINE.starts_with(&line) && status.is_private && folder.entries().is_ok_and(|names| names == [LOCK]);
        let is_marked = line == LOCK_LINE || is_begun();
        if is_marked { Ok(Leftover { name: name.to_owned(), folder, lock }) } else { Err(Refusal::Foreign) }
    }

    /// Removes the workspace. Entries that cannot be removed stay and are harmless.
    pub(super) fn remove(self, parent: &FolderHandle) {
        remove_content(&self.folder, Some(self.lock));
        let _ = parent.remove_empty(&self.name);
    }
}

/// Removes the workspace at `folder` if it still has this identity.
fn remove_workspace(folder: &Path, identity: FileIdentity, lock: Option<File>) {
    let Ok((parent, name)) = split_target(folder) else { return };
    let Ok(parent) = FolderHandle::open(&parent) else { return };
    let Ok(handle) = parent.open_folder(name) else { return };
    if handle.status().is_ok_and(|status| status.identity == identity) {
        remove_content(&handle, lock);
        let _ = parent.remove_empty(name);
    }
}

/// Removes everything in a workspace. The lock file goes last and before the lock is released: a run that gets the lock
/// afterwards sees that the file is gone.
fn remove_content(folder: &FolderHandle, lock: Option<File>) {
    for entry in folder.entries().unwrap_or_default().iter().filter(|entry| *entry != LOCK) {
        let _ = folder.remove(entry);
    }
    if folder.entries().is_ok_and(|entries| entries.iter().all(|entry| entry == LOCK)) {
        let _ = folder.remove(LOCK);
    }
    drop(lock);
}
