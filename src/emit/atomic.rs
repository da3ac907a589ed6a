//! Outputs that appear whole or not at all.
//!
//! In: where the user wants the output. Out: a temporary name beside it to write under; `commit` syncs
//! what was written and renames it. Dropped without commit, it is removed. Temporaries of runs
//! that were killed are removed when the next output for the same target begins (where the system can
//! say which processes run: Linux), and a folder that such a run had moved aside is put back.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File, OpenOptions};
use std::path::{Path, PathBuf};
use std::process;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::error::{Error, Result};

/// The file by which a folder is known as this program's: a JSON object whose `tool` names it.
pub const MARKER: &str = "summary.json";

/// Ends the name of an output being written.
const WRITING: &str = "splatsieve-tmp";
/// Ends the name of an earlier output about to be deleted.
const REPLACED: &str = "splatsieve-old";

/// What the names of scratch files are made of, in whatever folder.
const SCRATCH: &str = "splatsieve-scratch";

/// What an output is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// One file.
    File,
    /// A folder with everything in it.
    Folder,
}

/// Confirms, before any work, that an output may be written to `target` by a run that reads `inputs`.
///
/// Refused are: a target without a name or in a folder that does not exist; a target that is an input,
/// holds one or lies inside one, overwriting or not, whatever links lead there; an existing target unless `overwrite`;
/// and with it a file in place of a folder or the reverse, what is neither, and a folder that is neither
/// empty nor known by its [`MARKER`]: `--overwrite` never deletes what this program did not write.
///
/// # Errors
/// Each of these, as a matter of usage; a system that will not say what is there.
pub fn check_target(target: &Path, kind: Kind, inputs: &[&Path], overwrite: bool) -> Result<()> {
    let shown = target.display();
    let (parent, name) = parts(target)?;
    let real_parent = fs::canonicalize(&parent).map_err(|_| {
        Error::usage(format!(
            "{shown}: the folder {} to write it into does not exist; create it first",
            parent.display()
        ))
    })?;
    if !real_parent.is_dir() {
        return Err(Error::usage(format!("{shown}: {} is not a folder", parent.display())));
    }
    // Both what the name is and what it leads to: renaming over a link replaces the link alone,
    // but a user who names the input through one does not mean it.
    let named = real_parent.join(name);
    let meant = fs::canonicalize(target).unwrap_or_else(|_| named.clone());
    for input in inputs {
        let Ok(real) = fs::canonicalize(input) else { continue };
        if real == named || real == meant {
            return Err(Error::usage(format!("{shown} is the input itself; give another output")));
        }
        if real.starts_with(&named) || real.starts_with(&meant) {
            let input = input.display();
            return Err(Error::usage(format!("{shown} contains the input {input}; give another output")));
        }
        // A PLY among frames would be another frame, a folder in a model another iteration.
        if named.starts_with(&real) || meant.starts_with(&real) {
            let input = input.display();
            return Err(Error::usage(format!("{shown} lies inside the input {input}; give another output")));
        }
    }
    let Ok(found) = fs::symlink_metadata(target) else { return Ok(()) };
    if !overwrite {
        return Err(exists(target));
    }
    match kind {
        Kind::File if found.is_dir() => Err(Error::usage(format!("{shown} is a folder; a file cannot replace it"))),
        Kind::File if !found.is_file() && !found.is_symlink() => {
            Err(Error::usage(format!("{shown} is neither a file nor a folder; give another output")))
        }
        Kind::Folder if !found.is_dir() => {
            Err(Error::usage(format!("{shown} is no folder; a folder cannot replace it")))
        }
        Kind::Folder if !is_ours(target)? => Err(Error::usage(format!(
            "{shown} is not a result of splatsieve (no {MARKER} of its own), so --overwrite leaves it alone\n  \
             remove it yourself, or give another output"
        ))),
        _ => Ok(()),
    }
}

/// A file that appears under its name at [`StagedFile::commit`].
#[derive(Debug)]
pub struct StagedFile(Staged);

impl StagedFile {
    /// Prepares to write `target`, which [`check_target`] has passed. Nothing is created yet.
    ///
    /// # Errors
    /// A target without a name; an existing one unless `overwrite`.
    pub fn new(target: &Path, overwrite: bool) -> Result<StagedFile> {
        Staged::new(target, overwrite).map(StagedFile)
    }

    /// Where to write it meanwhile.
    pub fn path(&self) -> &Path {
        &self.0.temporary
    }

    /// Makes what was written durable and gives it its name, over an earlier output if that is allowed.
    ///
    /// # Errors
    /// Nothing was written; the target appeared meanwhile; the system refuses. The target is then as it was.
    pub fn commit(self) -> Result<()> {
        let Staged { target, temporary, .. } = &self.0;
        sync(temporary)?;
        self.0.refuse_newcomer()?;
        fs::rename(temporary, target).map_err(Error::io("write", target))?;
        sync(&parts(target)?.0)
    }
}

/// A folder that appears under its name at [`StagedFolder::commit`].
#[derive(Debug)]
pub struct StagedFolder(Staged);

impl StagedFolder {
    /// Creates an empty folder beside `target`, which [`check_target`] has passed.
    ///
    /// # Errors
    /// A target without a name; an existing one unless `overwrite`; the system refuses.
    pub fn new(target: &Path, overwrite: bool) -> Result<StagedFolder> {
        let staged = Staged::new(target, overwrite)?;
        fs::create_dir(&staged.temporary).map_err(Error::io("create", &staged.temporary))?;
        Ok(StagedFolder(staged))
    }

    /// The folder to write into meanwhile.
    pub fn path(&self) -> &Path {
        &self.0.temporary
    }

    /// Makes everything in it durable and gives it its name. An earlier output is moved aside, replaced,
    /// then deleted: a run killed in between leaves the old or the new one, whole.
    ///
    /// # Errors
    /// The target appeared meanwhile, or is not this program's; the system refuses. The target is then
    /// as it was.
    pub fn commit(self) -> Result<()> {
        let Staged { target, temporary, overwrite } = &self.0;
        sync_tree(temporary)?;
        self.0.refuse_newcomer()?;
        let parent = parts(target)?.0;
        if !(*overwrite && present(target)) {
            fs::rename(temporary, target).map_err(Error::io("write", target))?;
            return sync(&parent);
        }
        if !is_ours(target)? {
            // It passed `check_target` when the run began and is another folder now.
            return Err(exists(target));
        }
        let aside = sibling(target, REPLACED)?;
        fs::rename(target, &aside).map_err(Error::io("move aside", target))?;
        if let Err(error) = fs::rename(temporary, target) {
            let _ = fs::rename(&aside, target);
            return Err(Error::io("write", target)(error));
        }
        sync(&parent)?;
        fs::remove_dir_all(&aside).map_err(Error::io("remove the replaced", &aside))
    }
}

/// A file for as long as a run lasts: removed when this is dropped.
#[derive(Debug)]
pub struct ScratchFile(PathBuf);

impl ScratchFile {
    /// A name in `folder` that no other file has. Nothing is created yet; what killed runs left there is removed.
    ///
    /// # Errors
    /// A folder that does not exist; the system refuses.
    pub fn new(folder: &Path) -> Result<ScratchFile> {
        let target = folder.join(SCRATCH);
        tidy(&target)?;
        sibling(&target, WRITING).map(ScratchFile)
    }

    /// Where to write it.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Creates it, to be written and read back.
    ///
    /// # Errors
    /// The system refuses.
    pub fn create(&self) -> Result<File> {
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(&self.0);
        file.map_err(Error::io("create", &self.0))
    }
}

impl Drop for ScratchFile {
    fn drop(&mut self) {
        remove(&self.0);
    }
}

/// A target and the temporary name its content has meanwhile.
#[derive(Debug)]
struct Staged {
    target: PathBuf,
    temporary: PathBuf,
    overwrite: bool,
}

impl Staged {
    fn new(target: &Path, overwrite: bool) -> Result<Staged> {
        tidy(target)?;
        tidy(&target.with_file_name(SCRATCH))?;
        let staged = Staged { target: target.to_owned(), temporary: sibling(target, WRITING)?, overwrite };
        staged.refuse_newcomer()?;
        Ok(staged)
    }

    fn refuse_newcomer(&self) -> Result<()> {
        if !self.overwrite && present(&self.target) { Err(exists(&self.target)) } else { Ok(()) }
    }
}

impl Drop for Staged {
    /// After a commit there is nothing left under the temporary name.
    fn drop(&mut self) {
        remove(&self.temporary);
    }
}

fn exists(target: &Path) -> Error {
    Error::usage(format!("{} exists already; --overwrite replaces a result of splatsieve", target.display()))
}

/// Whether anything has that name, be it a link to nowhere.
fn present(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// The folder and the name of a target.
fn parts(target: &Path) -> Result<(PathBuf, &OsStr)> {
    let Some(name) = target.file_name() else {
        return Err(Error::usage(format!("{:?} is no name for an output", target.display().to_string())));
    };
    let parent = target.parent().filter(|parent| !parent.as_os_str().is_empty());
    Ok((parent.unwrap_or(Path::new(".")).to_owned(), name))
}

/// Whether the folder is empty or holds the marker.
fn is_ours(folder: &Path) -> Result<bool> {
    if fs::read_dir(folder).map_err(Error::io("list", folder))?.next().is_none() {
        return Ok(true);
    }
    let Ok(text) = fs::read_to_string(folder.join(MARKER)) else { return Ok(false) };
    let summary: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    Ok(summary["tool"].as_str().is_some_and(|tool| tool.starts_with("splatsieve")))
}

/// A hidden name beside `target` that no other output has: `.<name>.<process>-<number>.<suffix>`.
fn sibling(target: &Path, suffix: &str) -> Result<PathBuf> {
    static NUMBER: AtomicU64 = AtomicU64::new(0);
    let (parent, name) = parts(target)?;
    let mut hidden = prefix(name);
    hidden.push(format!("{}-{}.{suffix}", process::id(), NUMBER.fetch_add(1, Ordering::Relaxed)));
    Ok(parent.join(hidden))
}

fn prefix(name: &OsStr) -> OsString {
    let mut prefix = OsString::from(".");
    prefix.push(name);
    prefix.push(".");
    prefix
}

/// Removes what killed runs for the same target left; puts back a folder that one had moved aside.
fn tidy(target: &Path) -> Result<()> {
    let (parent, name) = parts(target)?;
    let prefix = prefix(name);
    let mut left: Vec<(PathBuf, bool)> = Vec::new();
    for entry in fs::read_dir(&parent).map_err(Error::io("list", &parent))? {
        let entry = entry.map_err(Error::io("list", &parent))?;
        let name = entry.file_name();
        let (bytes, prefix) = (name.as_encoded_bytes(), prefix.as_encoded_bytes());
        // A container on its way to a temporary name has a hidden name of its own, made of that name.
        let nested = bytes.strip_prefix(b".").and_then(|inner| inner.strip_prefix(prefix));
        let Some(rest) = bytes.strip_prefix(prefix).or(nested) else { continue };
        let Some((owner, suffix)) = std::str::from_utf8(rest).ok().and_then(|rest| rest.split_once('.')) else {
            continue;
        };
        let Some((process, number)) = owner.split_once('-') else { continue };
        let (Ok(process), Ok(_)) = (process.parse::<u32>(), number.parse::<u64>()) else { continue };
        let writing =
            suffix == WRITING || (nested.is_some() && suffix.starts_with(WRITING) && suffix.ends_with(".tmp"));
        if !runs(process) && (writing || suffix == REPLACED) {
            left.push((entry.path(), suffix == REPLACED));
        }
    }
    // Listing order is the file system's; which leftover is put back must not depend on it.
    left.sort();
    for (path, replaced) in left {
        if replaced && !present(target) {
            fs::rename(&path, target).map_err(Error::io("put back", &path))?;
        } else {
            remove(&path);
        }
    }
    Ok(())
}

/// Whether a process of that number may still be writing. Without `/proc` nobody is said to be gone.
fn runs(process: u32) -> bool {
    !cfg!(target_os = "linux") || Path::new("/proc").join(process.to_string()).exists()
}

/// Removes a file or a folder, if it is there. A leftover that cannot be removed harms nobody.
fn remove(path: &Path) {
    if fs::symlink_metadata(path).is_ok_and(|found| found.is_dir()) {
        let _ = fs::remove_dir_all(path);
    } else {
        let _ = fs::remove_file(path);
    }
}

/// Writes a file or the list of names of a folder through to the disk.
fn sync(path: &Path) -> Result<()> {
    // Only Unix opens folders as files.
    if cfg!(not(unix)) && path.is_dir() {
        return Ok(());
    }
    File::open(path).and_then(|file| file.sync_all()).map_err(Error::io("sync", path))
}

fn sync_tree(folder: &Path) -> Result<()> {
    for entry in fs::read_dir(folder).map_err(Error::io("list", folder))? {
        let path = entry.map_err(Error::io("list", folder))?.path();
        if path.is_dir() { sync_tree(&path)? } else { sync(&path)? }
    }
    sync(folder)
}

#[cfg(test)]
mod tests;
