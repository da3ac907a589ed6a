//! Cleanup after killed runs. A publication (the move of finished outputs to their names) that was interrupted is
//! completed or reverted; all other workspaces (hidden folders for unfinished outputs) of killed runs are removed.

use std::ffi::{OsStr, OsString};
use std::io::{self, Read as _};
use std::path::Path;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use splat_platform::FolderHandle;

use super::destination::{Replace, TargetKind, check_replace};
use super::ownership::{SUMMARY_FILE, move_foreign_entries, split_target};
use super::warnings::warn;
use super::workspace::{
    DISCARDED, JOURNAL, Leftover, REPLACED, Refusal, SCRATCH, Workspace, is_unfinished, is_workspace, publishing_name,
    target_name,
};
use crate::error::{Error, Result, ShowPath};

/// Maximum time to wait while another run moves a result to the same name, which takes milliseconds.
const MAX_WAIT: Duration = Duration::from_secs(60);
/// Maximum time to wait while another run inspects an unfinished workspace (hidden folder of a killed run), which takes
/// microseconds.
const MAX_INSPECTION_WAIT: Duration = Duration::from_secs(5);
/// Maximum length in bytes of a stored [`PublicationJournal`].
const MAX_JOURNAL: u64 = 1 << 20;

/// Lock that a run holds while it moves a result to its final name or repairs an interrupted move to that name.
///
/// The lock is a hidden folder whose name follows from the name of the result. A lock left by a killed run is removed
/// like any other workspace.
pub(super) struct PublishLock {
    _workspace: Workspace,
}

impl PublishLock {
    /// Waits until no other run moves a result to the name of `target`, then takes the lock. Returns the lock, which is
    /// released when it is dropped.
    ///
    /// # Errors
    /// Fails if the lock cannot be taken within a minute, because another run holds it or because a folder that this
    /// program did not create has its name. Also fails if a system call fails.
    pub(super) fn acquire(target: &Path) -> Result<PublishLock> {
        let (parent, name) = split_target(target)?;
        let name = publishing_name(name);
        let start = Instant::now();
        loop {
            let made = Workspace::with_name(&parent, &name).map_err(Error::io("create a folder in", &parent))?;
            if let Some(workspace) = made {
                return Ok(PublishLock { _workspace: workspace });
            }
            let folder = FolderHandle::open(&parent).map_err(Error::io("open", &parent))?;
            match Leftover::take(&folder, &name) {
                Ok(leftover) => leftover.remove(&folder),
                Err(_) if start.elapsed() > MAX_WAIT => {
                    let source = io::Error::new(
                        io::ErrorKind::TimedOut,
                        format!(
                            "{} has existed for {} s: another run is writing this output, or was killed on a file system \
                             without locks or by another user\n  remove that folder if no other run is going on",
                            parent.join(&name).shown(),
                            MAX_WAIT.as_secs()
                        ),
                    );
                    return Err(Error::io("write", target)(source));
                }
                Err(_) => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    }
}

/// List of the files of one result, in the order in which they are renamed to their final names. The renames are a
/// unit: if they are interrupted, the next run completes or reverts all of them.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct PublicationJournal {
    pub(super) replace: Replace,
    /// For each file, its name in the workspace (hidden folder) and its final name in the folder that holds the
    /// workspace.
    pub(super) files: Vec<(String, OsString)>,
}

/// Repairs and removes the hidden folders (workspaces) that killed runs left beside `target`. These are the workspaces
/// of outputs with the name of `target`, and the workspaces of scratch files.
///
/// Never fails. A workspace that cannot be repaired stays and causes a warning.
pub(super) fn clean_up(target: &Path) {
    let Ok((path, name)) = split_target(target) else { return };
    let Ok(parent) = FolderHandle::open(&path) else { return };
    let entries = parent.entries().unwrap_or_default();
    let left = |name: &OsStr| entries.iter().filter(|entry| is_workspace(entry, name)).collect::<Vec<_>>();
    if left(name).iter().any(|entry| parent.open_folder(entry).is_ok_and(|folder| is_unfinished(&folder))) {
        match PublishLock::acquire(target) {
            Ok(_lock) => repair(target, false),
            Err(error) => warn(error.to_string()),
        }
    }
    for entry in left(name).into_iter().chain(left(SCRATCH.as_ref())) {
        // If another run was killed meanwhile while publishing from this workspace, leave it to the next run.
        if let Ok(leftover) = Leftover::take(&parent, entry)
            && !is_unfinished(&leftover.folder)
        {
            leftover.remove(&parent);
        }
    }
}

/// Removes the workspaces (hidden folders in which outputs are written) that killed runs left in `folder`. Only those
/// of outputs whose names end with `ending` are removed. A workspace that holds an interrupted move of a result stays.
pub fn remove_leftovers(folder: &Path, ending: &str) {
    let Ok(parent) = FolderHandle::open(folder) else { return };
    for entry in parent.entries().unwrap_or_default() {
        let is_ours = target_name(&entry).is_some_and(|name| name.ends_with(ending));
        let leftover = if is_ours { Leftover::take(&parent, &entry).ok() } else { None };
        if let Some(leftover) = leftover.filter(|leftover| !is_unfinished(&leftover.folder)) {
            leftover.remove(&parent);
        }
    }
}

/// Repairs interrupted moves of results to the name of `target`. A run first writes its result into a workspace (hidden
/// folder beside `target`). It then moves the result to its final name by one or more renames. If the run is killed
/// between these renames, the move is interrupted. This function completes such a move, or gives the earlier result its
/// name back. If that fails, it warns the user. The caller holds the [`PublishLock`].
///
/// A result of several files has a journal in its workspace: the list of files and final names, from which a later run
/// can complete the move. `supersedes` states what happens to the journal if the repair fails:
/// - If true, it is deleted. The caller is about to move its own result to this name, and no later run may overwrite
///   that result by completing the old move.
/// - If false, it stays, and a later run tries again.
pub(super) fn repair(target: &Path, supersedes: bool) {
    let Ok((path, name)) = split_target(target) else { return };
    let Ok(parent) = FolderHandle::open(&path) else { return };
    for entry in parent.entries().unwrap_or_default().iter().filter(|entry| is_workspace(entry, name)) {
        if !parent.open_folder(entry).is_ok_and(|folder| is_unfinished(&folder)) {
            continue;
        }
        let Some(leftover) = take_unfinished(&parent, entry) else { continue };
        if let Err(error) = finish_publication(&leftover.folder, &parent, target) {
            let _ = if supersedes { leftover.folder.remove(JOURNAL) } else { Ok(()) };
            warn(format!("an interrupted run that wrote {} could not be repaired: {error}", target.shown()));
        }
    }
}

/// Locks and returns a workspace (hidden folder) that a killed run left with an interrupted move of its result. `name`
/// is the name of the workspace in the folder `parent`. Returns `None` if the workspace cannot be locked. The caller
/// holds the [`PublishLock`].
///
/// Another run may hold the lock of this workspace: the run that created it and is about to end after a failure, or a
/// run that inspects it for a moment. So this function tries for up to 5 s ([`MAX_INSPECTION_WAIT`]).
fn take_unfinished(parent: &FolderHandle, name: &OsStr) -> Option<Leftover> {
    let start = Instant::now();
    loop {
        match Leftover::take(parent, name) {
            Ok(leftover) => return Some(leftover),
            Err(Refusal::Busy) if start.elapsed() < MAX_INSPECTION_WAIT => std::thread::sleep(Duration::from_millis(1)),
            Err(_) => return None,
        }
    }
}

/// Completes or reverts an interrupted move of a result to `target`. The result lies in the workspace `folder` (hidden
/// folder of the killed run), which is a subfolder of `parent`. The caller holds the [`PublishLock`].
///
/// - If the workspace holds a journal (list of the files of the result), the move is completed: these files are renamed
///   to their final names.
/// - If it holds an earlier result folder and nothing has the name of `target`, the move is reverted: the earlier
///   folder gets its name back.
/// - If it holds an earlier result folder and the new one is in place, the move is completed: the foreign entries of
///   the earlier folder (those that its summary does not list) are moved into the new one. The earlier folder with its
///   other entries is discarded.
/// - If foreign entries cannot be moved, for example because another user owns a folder, the earlier folder stays
///   beside the result under its name with `.kept` appended.
pub(super) fn finish_publication(folder: &FolderHandle, parent: &FolderHandle, target: &Path) -> Result<()> {
    let (_, name) = split_target(target)?;
    if folder.has(JOURNAL) {
        complete_journal(folder, parent, target)?;
    }
    if folder.has(REPLACED) && !parent.has(name) {
        folder.rename(REPLACED, parent, name).map_err(Error::io("put back", target))?;
    }
    // Discard by a rename, which is one step: a partly deleted earlier result must not be mistaken for a result.
    if !folder.has(REPLACED) {
        return Ok(());
    }
    let old = folder.open_folder(REPLACED).map_err(Error::io("open the earlier folder of", target))?;
    let carried = match parent.has_folder(name) {
        true => move_foreign_entries(&old, target),
        false => Err(io::Error::from(io::ErrorKind::NotADirectory)),
    };
    let Err(refused) = carried else {
        return folder.rename(REPLACED, folder, DISCARDED).map_err(Error::io("discard the earlier folder of", target));
    };
    let _ = old.remove(SUMMARY_FILE);
    let mut kept = name.to_owned();
    kept.push(".kept");
    while parent.has(&kept) {
        kept.push(".kept");
    }
    folder.rename(REPLACED, parent, &kept).map_err(Error::io("keep files of the earlier", target))?;
    warn(format!(
        "{} is in place, but files of the earlier folder that are not splatsieve's could not be moved into it ({refused}); \
         they are in {}",
        target.shown(),
        target.with_file_name(kept).shown()
    ));
    Ok(())
}

/// Completes an interrupted move: renames the files that are still in the workspace `folder` to their final names in
/// the folder `parent`. The journal (list of the files of one result) in the workspace states these names. Skips names
/// that do not begin with the name of `target`. Fails if the journal cannot be read, or if a file must not be replaced
/// or cannot be moved.
fn complete_journal(folder: &FolderHandle, parent: &FolderHandle, target: &Path) -> Result<()> {
    let failed = |error| Error::io("complete the interrupted output of", target)(error);
    let (_, name) = split_target(target)?;
    let mut text = Vec::new();
    let mut file = folder.open_file(JOURNAL, false).map_err(failed)?;
    (&mut file).take(MAX_JOURNAL).read_to_end(&mut text).map_err(failed)?;
    let journal: PublicationJournal = serde_json::from_slice(&text).map_err(|error| failed(error.into()))?;
    for (content, published) in &journal.files {
        let is_beside = published.as_encoded_bytes().starts_with(name.as_encoded_bytes());
        if !is_beside || Path::new(published).components().count() != 1 || !folder.has(content) {
            continue;
        }
        check_replace(&target.with_file_name(published), TargetKind::File, journal.replace)?;
        folder.rename(content, parent, published).map_err(failed)?;
    }
    folder.remove(JOURNAL).map_err(failed)
}
