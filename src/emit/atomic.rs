//! Outputs that appear whole or not at all.
//!
//! In: where the user wants the output. Out: a hidden name beside it to write under; `commit` syncs what was written
//! and gives it its name. Dropped without commit it is removed, and so is, by [`withdraw_all`], everything begun
//! when the process is told to end. What killed runs left is removed when the next output of the same name begins,
//! and a folder that such a run had moved aside is put back. Runs may share folders between containers and machines.
//!
//! What overwriting does to files that are not this program's is said at [`Replace`].

mod named;
mod workspace;

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
pub use named::MARKER;
use named::{Owner, entries, files_below, is_our_file, name_files, parts, present};
use workspace::{SCRATCH, Workspace, named_in};
pub use workspace::{Withdrawn, withdraw_all};

/// What an output is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// One file.
    File,
    /// A folder with everything in it.
    Folder,
}

/// What an output may replace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Replace {
    /// Nothing.
    #[default]
    Never,
    /// What is known as a result of this program. In its folder the files that its summary lists are replaced; every
    /// other stays where it is, or with `.kept` behind its name where the new result has a file of that name. A single
    /// file is known as a result if it is a container or a summary beside it lists it.
    Ours,
    /// Whatever is there; of a folder everything in it.
    Any,
}

/// Confirms, before any work, that an output may be written to `target` by a run that reads `inputs`.
///
/// Refused are: a target without a name or in a folder that does not exist; a target that is an input,
/// holds one or lies inside one, overwriting or not, whatever links lead there; an existing target that `replace` does
/// not let go, but for an empty folder in place of a folder; a file in place of a folder or the reverse, and what is neither.
///
/// # Errors
/// Each of these, as a matter of usage; a system that will not say what is there.
pub fn check_target(target: &Path, kind: Kind, inputs: &[&Path], replace: Replace) -> Result<()> {
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
    if kind == Kind::Folder && is_empty_folder(target) {
        return Ok(());
    }
    if replace == Replace::Never {
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
        _ => may_go(target, kind, replace),
    }
}

/// A file that appears under its name at [`StagedFile::commit`].
#[derive(Debug)]
pub struct StagedFile(Staged);

impl StagedFile {
    /// Prepares to write `target`, which [`check_target`] has passed. The file itself is not created yet.
    ///
    /// # Errors
    /// A target without a name; an existing one that `replace` does not let go; the system refuses.
    pub fn new(target: &Path, replace: Replace) -> Result<StagedFile> {
        Staged::new(target, Kind::File, replace).map(StagedFile)
    }

    /// Where to write it meanwhile.
    pub fn path(&self) -> &Path {
        &self.0.content
    }

    /// Makes what was written durable and gives it its name, over an earlier output if that is allowed.
    ///
    /// # Errors
    /// Nothing was written; the target appeared meanwhile; the system refuses. The target is then as it was.
    pub fn commit(self) -> Result<()> {
        commit_all(&[self])
    }
}

/// Commits a result of several files side by side, the last of which is its summary: it lists all of them.
/// They get their names in order, so that the summary says that all are there.
///
/// # Errors
/// A summary that is no JSON object; those of [`StagedFile::commit`] for each.
pub fn commit_files(files: &[StagedFile]) -> Result<()> {
    if let Some(summary) = files.last() {
        let names = files.iter().map(|file| Ok(parts(&file.0.target)?.1.to_string_lossy().into_owned()));
        let mut names = names.collect::<Result<Vec<String>>>()?;
        names.sort();
        name_files(summary.path(), &names)?;
    }
    commit_all(files)
}

fn commit_all(files: &[StagedFile]) -> Result<()> {
    for file in files {
        sync(file.path())?;
        file.0.refuse_newcomer()?;
    }
    let named: Vec<_> = files.iter().map(|StagedFile(staged)| (&staged.workspace, staged.target.as_path())).collect();
    workspace::rename_files(&named)?;
    for file in files {
        sync(&parts(&file.0.target)?.0)?;
    }
    Ok(())
}

/// A folder that appears under its name at [`StagedFolder::commit`].
#[derive(Debug)]
pub struct StagedFolder(Staged);

impl StagedFolder {
    /// Creates an empty folder for `target`, which [`check_target`] has passed.
    ///
    /// # Errors
    /// A target without a name; an existing one that `replace` does not let go; the system refuses.
    pub fn new(target: &Path, replace: Replace) -> Result<StagedFolder> {
        let staged = Staged::new(target, Kind::Folder, replace)?;
        fs::create_dir(&staged.content).map_err(Error::io("create", &staged.content))?;
        Ok(StagedFolder(staged))
    }

    /// The folder to write into meanwhile.
    pub fn path(&self) -> &Path {
        &self.0.content
    }

    /// Lists its files in its summary, if it has one, makes everything durable and gives it its name.
    ///
    /// An earlier output is moved aside, replaced, then deleted, and what was in it but not its own follows the name. A run
    /// killed in between leaves the old or the new one whole; the foreign files are in it or in a hidden folder
    /// beside it, from where the next output of that name moves them back.
    ///
    /// # Errors
    /// A summary that is no JSON object; the target appeared meanwhile and may not be replaced; the system refuses.
    /// The target is then as it was.
    pub fn commit(self) -> Result<()> {
        let Staged { target, content, replace, workspace, .. } = &self.0;
        let summary = content.join(MARKER);
        if present(&summary) {
            name_files(&summary, &files_below(content)?)?;
        }
        sync_tree(content)?;
        self.0.refuse_newcomer()?;
        workspace.replace_folder(*replace == Replace::Any)?;
        sync(&parts(target)?.0)
    }
}

/// A file for as long as a run lasts, for whoever needs a path: removed when this is dropped.
#[derive(Debug)]
pub struct ScratchFile {
    content: PathBuf,
    _workspace: Workspace,
}

impl ScratchFile {
    /// A name in `folder` that no other file has. The file itself is not created yet.
    ///
    /// # Errors
    /// A folder that does not exist; the system refuses.
    pub fn new(folder: &Path) -> Result<ScratchFile> {
        let workspace = Workspace::beside(&folder.join(SCRATCH))?;
        Ok(ScratchFile { content: workspace.content(), _workspace: workspace })
    }

    /// Where to write it.
    pub fn path(&self) -> &Path {
        &self.content
    }
}

/// A folder for as long as a run lasts: removed when this is dropped.
#[derive(Debug)]
pub struct ScratchFolder(ScratchFile);

impl ScratchFolder {
    /// Creates an empty folder in `folder`.
    ///
    /// # Errors
    /// A folder that does not exist; the system refuses.
    pub fn new(folder: &Path) -> Result<ScratchFolder> {
        let scratch = ScratchFile::new(folder)?;
        fs::create_dir(scratch.path()).map_err(Error::io("create", scratch.path()))?;
        Ok(ScratchFolder(scratch))
    }

    /// The folder to write into.
    pub fn path(&self) -> &Path {
        self.0.path()
    }
}

/// A target and where its content is meanwhile.
#[derive(Debug)]
struct Staged {
    target: PathBuf,
    content: PathBuf,
    kind: Kind,
    replace: Replace,
    workspace: Workspace,
}

impl Staged {
    fn new(target: &Path, kind: Kind, replace: Replace) -> Result<Staged> {
        let workspace = Workspace::beside(target)?;
        let staged = Staged { target: target.to_owned(), content: workspace.content(), kind, replace, workspace };
        staged.refuse_newcomer()?;
        Ok(staged)
    }

    /// What has the name now may be another than when the run began.
    fn refuse_newcomer(&self) -> Result<()> {
        if present(&self.target) { may_go(&self.target, self.kind, self.replace) } else { Ok(()) }
    }
}

fn exists(target: &Path) -> Error {
    Error::usage(format!(
        "{} exists already\n  --overwrite replaces a result of splatsieve, --force whatever is there",
        target.display()
    ))
}

/// Whether there is a folder, no link to one, with nothing in it.
fn is_empty_folder(target: &Path) -> bool {
    fs::symlink_metadata(target).is_ok_and(|found| found.is_dir())
        && entries(target).is_ok_and(|entries| entries.is_empty())
}

/// Confirms that what is at `target` may be replaced.
fn may_go(target: &Path, kind: Kind, replace: Replace) -> Result<()> {
    let shown = target.display();
    match (kind, replace) {
        (_, Replace::Any) => Ok(()),
        (Kind::Folder, _) if is_empty_folder(target) => Ok(()),
        (_, Replace::Never) => Err(exists(target)),
        (Kind::File, Replace::Ours) if is_our_file(target) => Ok(()),
        (Kind::File, Replace::Ours) => Err(Error::usage(format!(
            "{shown} exists already, and nothing says that splatsieve wrote it: it is no container, and no summary beside \
             it lists it\n  --force replaces it all the same; or give another output"
        ))),
        (Kind::Folder, Replace::Ours) => match Owner::of(&target.join(MARKER)) {
            Owner::Listed(_) => Ok(()),
            Owner::Unlisted => Err(Error::usage(format!(
                "{shown} is a result of a splatsieve that did not list its files yet, so nobody can tell what else is in \
                 it\n  --force replaces it with all that is in it; or give another output"
            ))),
            Owner::Unknown => Err(Error::usage(format!(
                "{shown} is not a result of splatsieve (no {MARKER} of its own), so --overwrite leaves it alone\n  \
                 --force replaces it with all that is in it; or give another output"
            ))),
        },
    }
}

/// The same failure of the system, of the file that a person asked for where it is one that it grows in meanwhile.
pub fn as_named(error: Error) -> Error {
    let (action, path, source) = match error {
        Error::Io { action, path, source } | Error::Container(gseq::Error::Io { action, path, source }) => {
            (action, path, source)
        }
        error => return error,
    };
    match named_in(&path) {
        Some((path, true)) => Error::Io { action: "write a scratch file in", path, source },
        Some((path, false)) => Error::Io { action, path, source },
        None => Error::Io { action, path, source },
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
    for path in entries(folder)?.iter().map(|entry| folder.join(entry)) {
        if path.is_dir() { sync_tree(&path)? } else { sync(&path)? }
    }
    sync(folder)
}

#[cfg(test)]
mod tests;
