//! Publication: moves finished outputs to their final names. Only one run at a time moves outputs to the same name.

use std::ffi::OsString;
use std::fs;
use std::path::Path;

use splat_platform::{FolderHandle, sync_file, sync_folder};

use super::destination::{Replace, TargetKind, check_replace};
use super::leftovers::{PublicationJournal, PublishLock, finish_publication, repair};
use super::ownership::{exists, split_target};
use super::warnings::warn;
use super::workspace::{JOURNAL, REPLACED, Workspace, live_workspaces};
use crate::error::{Error, Result, ShowPath};

/// Renames files from `workspace` (a hidden folder) to their targets, in the order of `files`. Each element of `files`
/// is the name in the workspace and the target path. The last file is the output itself, the others are its companions.
/// The files must have been synced to disk.
///
/// For more than one file, a journal records which files belong together: if the process is killed or fails between two
/// renames, the next run with this output completes the set.
///
/// # Errors
/// Fails if a file appeared meanwhile at a target and `replace` does not allow replacing it, or if a system call fails.
pub(super) fn publish_files(workspace: &Workspace, files: &[(String, &Path)], replace: Replace) -> Result<()> {
    let Some((_, target)) = files.last() else { return Ok(()) };
    let lock = PublishLock::acquire(target)?;
    repair(target, true);
    for (_, target) in files {
        check_replace(target, TargetKind::File, replace)?;
    }
    let held = live_workspaces();
    let journal = workspace.folder.join(JOURNAL);
    if files.len() > 1 {
        write_journal(workspace, files, replace)?;
    }
    for (done, (content, target)) in files.iter().enumerate() {
        let Err(error) = fs::rename(workspace.folder.join(content), target) else { continue };
        if done == 0 {
            let _ = fs::remove_file(&journal);
        }
        return Err(Error::io("write", target)(error));
    }
    let _ = fs::remove_file(&journal);
    drop(held);
    drop(lock);
    sync_parent(target);
    Ok(())
}

/// Writes a journal into `workspace` (a hidden folder) and syncs it to disk. The journal lists `files`, which are
/// renamed together: each element is the name in the workspace and the target path. It also holds `replace`, the policy
/// for existing targets.
fn write_journal(workspace: &Workspace, files: &[(String, &Path)], replace: Replace) -> Result<()> {
    let names = files.iter().map(|(content, target)| Ok((content.clone(), split_target(target)?.1.to_owned())));
    let journal = PublicationJournal { replace, files: names.collect::<Result<Vec<(String, OsString)>>>()? };
    let text = serde_json::to_vec(&journal).expect("plain data");
    // Write the journal under another name until it is complete, so that a file called `journal` is never partial.
    let (begun, path) = (workspace.folder.join("journal-begun"), workspace.folder.join(JOURNAL));
    let written = fs::write(&begun, text).and_then(|()| sync_file(&begun));
    let written = written.and_then(|()| fs::rename(&begun, &path)).and_then(|()| workspace.sync());
    written.map_err(|error| {
        let _ = fs::remove_file(&path);
        Error::io("write a journal in", &workspace.folder)(error)
    })
}

/// Renames the new folder in `workspace` (a hidden folder) to `target`. Replaces an earlier folder of that name.
///
/// If the process is killed meanwhile, the next run with this output either puts the earlier folder back or completes
/// the replacement.
///
/// # Errors
/// Fails if an entry appeared meanwhile at `target` and `replace` does not allow replacing it, or if a system call
/// fails. The target is then unchanged. A failure after the rename is only a warning.
pub(super) fn publish_folder(workspace: &Workspace, target: &Path, replace: Replace) -> Result<()> {
    let lock = PublishLock::acquire(target)?;
    repair(target, true);
    check_replace(target, TargetKind::Folder, replace)?;
    let held = live_workspaces();
    let aside = workspace.folder.join(REPLACED);
    if exists(target) {
        workspace.sync().map_err(Error::io("sync", &workspace.folder))?;
        fs::rename(target, &aside).map_err(Error::io("move aside", target))?;
    }
    if let Err(error) = fs::rename(workspace.content(), target) {
        let _ = fs::rename(&aside, target);
        return Err(Error::io("write", target)(error));
    }
    let (parent, _) = split_target(target)?;
    let handles = FolderHandle::open(&workspace.folder).and_then(|folder| Ok((folder, FolderHandle::open(&parent)?)));
    let settled = handles
        .map_err(Error::io("open", &parent))
        .and_then(|(folder, parent)| finish_publication(&folder, &parent, target));
    if let Err(error) = settled {
        warn(format!(
            "{} is complete and in place, but the earlier folder could not be cleaned up ({error}); the next run with this \
             output tries again",
            target.shown()
        ));
    }
    drop(held);
    drop(lock);
    sync_parent(target);
    Ok(())
}

/// Syncs the folder that holds the output `target` to disk, so that the name of the output is stored. A failure is only
/// a warning, because the output is in place.
fn sync_parent(target: &Path) {
    let Ok((parent, _)) = split_target(target) else { return };
    if let Err(error) = sync_folder(&parent) {
        warn(format!(
            "{} is complete and in place, but its name could not be written through to the disk ({error}): a power failure \
             may lose it",
            target.shown()
        ));
    }
}
