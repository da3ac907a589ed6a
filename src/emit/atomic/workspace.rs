//! Where an output grows: a hidden folder beside its target, which a lock marks as somebody's.
//!
//! `.<name>.<random>.splatsieve-tmp` holds `lock`; `content`, what is being written; and, while an earlier folder
//! is replaced, that one. The system drops the lock with the process that holds it, whatever ends it, so a lock that
//! can be taken is a leftover's. It holds between containers and, where the file system passes locks on, between
//! machines; process ids, which mean something else in every container, decide nothing. On a file
//! system without locks nothing is ever a leftover: it is for a person to remove.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use fs4::{FileExt, TryLockError};

use super::named::{carry_foreign, entries, parts, present};
use crate::error::{Error, Result};

/// What the names of scratch files are made of, in whatever folder.
pub(super) const SCRATCH: &str = "splatsieve-scratch";
/// Ends the names of these folders.
const ENDING: &str = ".splatsieve-tmp";
/// The file whose lock says that a run goes on.
const LOCK: &str = "lock";
/// What is being written.
const CONTENT: &str = "content";
/// An earlier folder that is replaced but for files that are not its own: they have still to follow its name.
const REPLACED: &str = "replaced";
/// An earlier folder that is replaced with all in it.
const REPLACED_WHOLE: &str = "replaced-whole";
/// What has only to be deleted.
const DISCARDED: &str = "discarded";

/// The folders of this process with their targets. Whoever renames holds it, so that a signal comes before a
/// result has its name or after.
static LIVE: Mutex<BTreeMap<PathBuf, PathBuf>> = Mutex::new(BTreeMap::new());

fn live() -> MutexGuard<'static, BTreeMap<PathBuf, PathBuf>> {
    // A map stays whole whatever panics beside it.
    LIVE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A hidden folder for the content of one target, gone when this is dropped.
#[derive(Debug)]
pub(super) struct Workspace {
    folder: PathBuf,
    target: PathBuf,
    /// None on a file system without locks.
    lock: Option<File>,
}

impl Workspace {
    /// A new one beside `target`. What killed runs left there of theirs, and of scratch files, is settled and removed.
    pub(super) fn beside(target: &Path) -> Result<Workspace> {
        let (parent, name) = parts(target)?;
        tidy(target)?;
        tidy(&target.with_file_name(SCRATCH))?;
        let mut prefix = std::ffi::OsString::from(".");
        prefix.push(name);
        prefix.push(".");
        loop {
            // Held until the folder is listed: no signal finds it unknown.
            let mut live = live();
            let made = tempfile::Builder::new().prefix(&prefix).suffix(ENDING).tempdir_in(&parent);
            let made = made.map_err(Error::io("create a folder in", &parent))?;
            let claimed = claim(made.path()).map_err(Error::io("create a lock in", made.path()))?;
            if let Claim::Held(lock) = claimed {
                let folder = made.keep();
                live.insert(folder.clone(), target.to_owned());
                return Ok(Workspace { folder, target: target.to_owned(), lock });
            }
        }
    }

    /// Where to write.
    pub(super) fn content(&self) -> PathBuf {
        self.folder.join(CONTENT)
    }

    /// Gives the content its name, over an earlier folder if there is one: with all in it if `whole`, else but for the
    /// files that it does not name as its own.
    ///
    /// A run that is killed meanwhile leaves the old or the new one whole; the next output of that name or, after a
    /// signal, this run moves what has still to follow.
    pub(super) fn replace_folder(&self, whole: bool) -> Result<()> {
        let held = live();
        let aside = self.folder.join(if whole { REPLACED_WHOLE } else { REPLACED });
        if present(&self.target) {
            fs::rename(&self.target, &aside).map_err(Error::io("move aside", &self.target))?;
        }
        if let Err(error) = fs::rename(self.content(), &self.target) {
            let _ = fs::rename(&aside, &self.target);
            return Err(Error::io("write", &self.target)(error));
        }
        settle(&self.folder, &self.target)?;
        drop(held);
        Ok(())
    }
}

impl Drop for Workspace {
    fn drop(&mut self) {
        let mut live = live();
        live.remove(&self.folder);
        // Nobody is left to tell of a failure; the next output of that name meets it again.
        if settle(&self.folder, &self.target).is_ok() {
            dismantle(&self.folder, self.lock.take());
        }
    }
}

/// What a person calls the file at `path`, if it is one that grows in such a folder: the target, or a file in it; of a
/// scratch file, which has no name that says anything, the folder that it is in.
pub(super) fn named_in(path: &Path) -> Option<(PathBuf, bool)> {
    // Of `.name.random` the name.
    let name_of = |part: &OsStr, ending: &str| -> Option<String> {
        let name = part.to_str()?.strip_prefix('.')?.strip_suffix(ending)?;
        Some(name.rsplit_once('.')?.0.to_owned())
    };
    let mut parts = path.components();
    let mut before = PathBuf::new();
    let name = loop {
        let part = parts.next()?;
        match name_of(part.as_os_str(), ENDING) {
            Some(name) => break name,
            None => before.push(part),
        }
    };
    if name == SCRATCH {
        return Some((before, true));
    }
    before.push(name);
    // Containers grow under a hidden name of their own.
    before.extend(
        parts
            .skip(1)
            .map(|part| name_of(part.as_os_str(), ".tmp").map_or_else(|| part.as_os_str().to_owned(), Into::into)),
    );
    Some((before, false))
}

/// Gives files their names, all or none where a signal comes.
pub(super) fn rename_files(files: &[(&Workspace, &Path)]) -> Result<()> {
    let held = live();
    for (workspace, target) in files {
        fs::rename(workspace.content(), target).map_err(Error::io("write", target))?;
    }
    drop(held);
    Ok(())
}

/// While this lasts nothing of this process gets a name any more, or is removed; see [`withdraw_all`].
#[must_use = "runs go on as soon as this is dropped"]
pub struct Withdrawn(#[allow(dead_code, reason = "held, not read")] MutexGuard<'static, BTreeMap<PathBuf, PathBuf>>);

/// Removes everything that this process has begun and not yet given its name; for a process about to end.
///
/// A result that is being renamed is waited for, and is then whole. Files that this module did not hand out stay.
pub fn withdraw_all() -> Withdrawn {
    let mut live = live();
    for (folder, target) in std::mem::take(&mut *live) {
        if settle(&folder, &target).is_err() {
            continue;
        }
        // Whoever still writes into it finds no folder from here on.
        let _ = fs::rename(folder.join(CONTENT), folder.join(DISCARDED));
        // What a writer just began may appear while the folder is emptied.
        for _ in 0..100 {
            dismantle(&folder, None);
            if !present(&folder) {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    Withdrawn(live)
}

/// What became of a new folder.
enum Claim {
    /// It is this run's, with its lock where there are locks.
    Held(Option<File>),
    /// A run that tidies was faster.
    Lost,
}

fn claim(folder: &Path) -> io::Result<Claim> {
    let path = folder.join(LOCK);
    let file = match OpenOptions::new().read(true).write(true).create_new(true).open(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Claim::Lost),
        opened => opened?,
    };
    Ok(match FileExt::try_lock(&file) {
        Err(TryLockError::WouldBlock) => Claim::Lost,
        // Whoever removes a folder holds its lock: what is still there under this one stays.
        Ok(()) if present(&path) => Claim::Held(Some(file)),
        Ok(()) => Claim::Lost,
        Err(TryLockError::Error(_)) => Claim::Held(None),
    })
}

/// Settles and removes what killed runs left beside `target` of their own outputs of that name.
fn tidy(target: &Path) -> Result<()> {
    let (parent, name) = parts(target)?;
    let mut left = entries(&parent)?;
    left.retain(|entry| is_workspace(entry, name));
    // A lock of this process may be lost by opening its file once more, where locks are the network's.
    let live: Vec<PathBuf> = live().keys().cloned().collect();
    for folder in left.iter().map(|entry| parent.join(entry)).filter(|folder| !live.contains(folder)) {
        let lock = match OpenOptions::new().read(true).write(true).open(folder.join(LOCK)) {
            Ok(lock) => lock,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                // About to get its lock, which then fails and is tried again; or nearly gone.
                let _ = fs::remove_dir(&folder);
                continue;
            }
            Err(_) => continue,
        };
        if FileExt::try_lock(&lock).is_ok() {
            settle(&folder, target)?;
            dismantle(&folder, Some(lock));
        }
    }
    Ok(())
}

/// Whether an entry has the name of a folder for the content of `name`.
fn is_workspace(entry: &OsStr, name: &OsStr) -> bool {
    let rest = entry.as_encoded_bytes().strip_prefix(b".").and_then(|rest| rest.strip_prefix(name.as_encoded_bytes()));
    let random = rest.and_then(|rest| rest.strip_prefix(b".")?.strip_suffix(ENDING.as_bytes()));
    random.is_some_and(|random| !random.is_empty() && random.iter().all(u8::is_ascii_alphanumeric))
}

/// Ends what was between its renames: the earlier folder gets its name back if nothing else has it, else what is
/// not its own follows the name.
fn settle(folder: &Path, target: &Path) -> Result<()> {
    let (replaced, discarded) = (folder.join(REPLACED), folder.join(DISCARDED));
    for aside in [&replaced, &folder.join(REPLACED_WHOLE)] {
        if present(aside) && !present(target) {
            fs::rename(aside, target).map_err(Error::io("put back", aside))?;
        }
    }
    if present(&replaced) {
        carry_foreign(&replaced, target)?;
        // In one step: half of an earlier folder is not to be taken for one.
        fs::rename(&replaced, &discarded).map_err(Error::io("discard", &replaced))?;
    }
    Ok(())
}

/// Removes a folder, its lock last. What cannot be removed harms nobody.
fn dismantle(folder: &Path, lock: Option<File>) {
    for entry in entries(folder).unwrap_or_default().iter().filter(|entry| *entry != LOCK) {
        let path = folder.join(entry);
        let _ = if path.is_dir() && !path.is_symlink() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
    }
    // Network file systems keep a file that is open, under another name.
    drop(lock);
    let _ = fs::remove_dir_all(folder);
}
