//! Outputs that appear whole or not at all.
//!
//! An output is written in a hidden workspace beside its target ([`workspace`]). `commit` writes it through to the disk
//! and publishes it under its name ([`publish`]); runs with the same output publish one after the other. Dropping an
//! output without commit removes it, and [`withdraw_all`] removes everything begun when a signal ends the process. The next
//! run with the same output repairs and removes what killed runs left ([`leftovers`]). Runs may share folders between
//! containers and machines.
//!
//! [`Replace`] says what is overwritten. Only regular files, folders and links to regular files are ever replaced;
//! output to a character device or FIFO is written into it.

mod destination;
mod leftovers;
mod named;
mod publish;
mod stream;
mod warnings;
mod workspace;

use std::fs;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result, ShowPath};
use destination::{Destination, check_replace, destination, real_parent};
pub use destination::{Kind, Replace};
pub use leftovers::remove_leftovers;
use leftovers::tidy;
pub use named::MARKER;
use named::{entries, files_below, name_files, parts, present};
pub use stream::is_standard_output_used;
pub use warnings::take_warnings;
use workspace::{SCRATCH, Workspace, named_in};
pub use workspace::{Withdrawn, withdraw_all};

/// Confirms, before any work, that an output may be written to `target` by a run that reads `inputs`. Completes or removes
/// an output with this name that a killed run left unfinished.
///
/// Refused are: a target without a name or in a folder that does not exist; a target that is an input,
/// contains one or lies inside one, whatever `replace` is and whatever links lead there; an existing target that `replace`
/// does not allow to replace, except an empty folder in place of a folder; a file in place of a folder or the reverse;
/// sockets, block devices and links to nothing.
///
/// # Errors
/// Each of these, as [`Error::Usage`]; a failure of the system.
pub fn check_target(target: &Path, kind: Kind, inputs: &[&Path], replace: Replace) -> Result<()> {
    let shown = target.shown();
    let real_parent = real_parent(target)?;
    let (_, name) = parts(target)?;
    // The entry itself and what it leads to: renaming over a link replaces only the link, but a user who names the
    // input through a link does not mean that.
    let named = real_parent.join(name);
    let meant = fs::canonicalize(target).unwrap_or_else(|_| named.clone());
    for input in inputs {
        let Ok(real) = fs::canonicalize(input) else { continue };
        if real == named || real == meant {
            return Err(Error::usage(format!("{shown} is the input itself; give another output")));
        }
        if real.starts_with(&named) || real.starts_with(&meant) {
            let input = input.shown();
            return Err(Error::usage(format!("{shown} contains the input {input}; give another output")));
        }
        // A PLY among frames would be another frame, a folder in a model another iteration.
        if named.starts_with(&real) || meant.starts_with(&real) {
            let input = input.shown();
            return Err(Error::usage(format!("{shown} lies inside the input {input}; give another output")));
        }
    }
    if kind == Kind::File && destination(target)? == Destination::Stream {
        return Ok(());
    }
    tidy(target);
    check_replace(target, kind, replace)?;
    check_writable(target, &real_parent)
}

/// Confirms that a file can be created in `parent`, the folder that `target` is written into. The file has no name and is
/// gone when this returns.
///
/// # Errors
/// As [`Error::Usage`]: a folder without write permission, a read-only file system, no space left.
fn check_writable(target: &Path, parent: &Path) -> Result<()> {
    match tempfile::tempfile_in(parent) {
        Ok(_) => Ok(()),
        Err(error) => Err(Error::usage(format!(
            "{}: cannot write into the folder {}: {error}\n  name an output in a folder that can be written",
            target.shown(),
            parent.shown()
        ))),
    }
}

/// Confirms with [`check_target`] that a file and its `companions` may be written.
///
/// # Errors
/// Those of [`check_target`]; a `target` that is a device or FIFO, which takes only one file.
pub fn check_targets(target: &Path, companions: &[PathBuf], inputs: &[&Path], replace: Replace) -> Result<()> {
    for path in std::iter::once(target).chain(companions.iter().map(PathBuf::as_path)) {
        check_target(path, Kind::File, inputs, replace)?;
        if destination(path)? == Destination::Stream {
            return Err(Error::usage(format!(
                "{} is a device or FIFO, and the result is several files; give the name of a file",
                path.shown()
            )));
        }
    }
    Ok(())
}

/// A file that appears under its name at [`StagedFile::commit`], or is written into a device or FIFO then.
#[derive(Debug)]
pub struct StagedFile {
    target: PathBuf,
    content: PathBuf,
    replace: Replace,
    is_stream: bool,
    workspace: Workspace,
}

impl StagedFile {
    /// Prepares to write `target`, which [`check_target`] has passed. The file itself is not created yet.
    ///
    /// # Errors
    /// A target without a name; an existing one that `replace` does not allow to replace; the system refuses.
    pub fn new(target: &Path, replace: Replace) -> Result<StagedFile> {
        let is_stream = destination(target)? == Destination::Stream;
        let workspace = match is_stream {
            // Beside a device is no room.
            true => scratch_in(&std::env::temp_dir())?,
            false => staged(target, Kind::File, replace)?,
        };
        Ok(StagedFile { target: target.to_owned(), content: workspace.content(), replace, is_stream, workspace })
    }

    /// Path to write the file to before [`StagedFile::commit`].
    pub fn path(&self) -> &Path {
        &self.content
    }

    /// Writes the file through to the disk and gives it its name, in place of an earlier output if that is allowed.
    ///
    /// # Errors
    /// Nothing was written; the target appeared meanwhile; the system refuses. The target is then as it was.
    pub fn commit(self) -> Result<()> {
        if self.is_stream {
            return stream::copy(&self.content, &self.target);
        }
        sync(&self.content)?;
        publish::publish_files(&self.workspace, &[(workspace::CONTENT.to_owned(), &self.target)], self.replace)
    }
}

/// A file and its companions beside it, which appear together at [`StagedFiles::commit`].
#[derive(Debug)]
pub struct StagedFiles {
    file: StagedFile,
    companions: Vec<PathBuf>,
}

impl StagedFiles {
    /// Prepares to write `target` and its `companions`, which [`check_targets`] has passed. The names of the companions
    /// begin with that of `target`, and the first companion is the summary.
    ///
    /// # Errors
    /// Those of [`StagedFile::new`] for each of them.
    pub fn new(target: &Path, companions: Vec<PathBuf>, replace: Replace) -> Result<StagedFiles> {
        let file = StagedFile::new(target, replace)?;
        for companion in &companions {
            check_replace(companion, Kind::File, replace)?;
        }
        Ok(StagedFiles { file, companions })
    }

    /// Path to write the file to before [`StagedFiles::commit`].
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Path to write the companion with this index to.
    pub fn companion(&self, index: usize) -> PathBuf {
        self.file.workspace.folder.join(companion_content(index))
    }

    /// Lists all files in the summary, writes them through to the disk and publishes them: the summary first, so that the
    /// others are known as results from the start, the file itself last.
    ///
    /// Runs with the same output publish one after the other, so files of different runs are never mixed. After a kill in
    /// between the next run with this output publishes the remaining files.
    ///
    /// # Errors
    /// A summary that is no JSON object; those of [`StagedFile::commit`] for each.
    pub fn commit(self) -> Result<()> {
        let StagedFiles { file, companions } = &self;
        let names = companions.iter().chain([&file.target]);
        let names = names.map(|path| Ok(parts(path)?.1.to_string_lossy().into_owned()));
        let mut names = names.collect::<Result<Vec<String>>>()?;
        names.sort();
        if !companions.is_empty() {
            name_files(&self.companion(0), &names)?;
        }
        let mut files: Vec<(String, &Path)> = Vec::new();
        for (index, target) in companions.iter().enumerate() {
            sync(&self.companion(index))?;
            files.push((companion_content(index), target));
        }
        sync(file.path())?;
        files.push((workspace::CONTENT.to_owned(), &file.target));
        publish::publish_files(&file.workspace, &files, file.replace)
    }
}

fn companion_content(index: usize) -> String {
    format!("companion-{index}")
}

/// A folder that appears under its name at [`StagedFolder::commit`].
#[derive(Debug)]
pub struct StagedFolder {
    target: PathBuf,
    content: PathBuf,
    replace: Replace,
    workspace: Workspace,
}

impl StagedFolder {
    /// Creates an empty folder for `target`, which [`check_target`] has passed.
    ///
    /// # Errors
    /// A target without a name; an existing one that `replace` does not allow to replace; the system refuses.
    pub fn new(target: &Path, replace: Replace) -> Result<StagedFolder> {
        let workspace = staged(target, Kind::Folder, replace)?;
        let content = workspace.content();
        fs::create_dir(&content).map_err(Error::io("create", &content))?;
        Ok(StagedFolder { target: target.to_owned(), content, replace, workspace })
    }

    /// Folder to write into before [`StagedFolder::commit`].
    pub fn path(&self) -> &Path {
        &self.content
    }

    /// Lists the files in the folder's summary, if it has one, writes everything through to the disk and publishes it.
    ///
    /// An earlier output is moved aside, replaced, then deleted, and files in it that are not its own are moved into the new
    /// one. A run that is killed in between leaves the earlier or the new folder whole; the foreign files are in it or in the
    /// hidden workspace, from where the next run with this output moves them.
    ///
    /// # Errors
    /// A summary that is no JSON object; the target appeared meanwhile and may not be replaced; the system refuses.
    /// The target is then as it was.
    pub fn commit(self) -> Result<()> {
        let summary = self.content.join(MARKER);
        if present(&summary) {
            name_files(&summary, &files_below(&self.content)?)?;
        }
        sync_tree(&self.content)?;
        publish::publish_folder(&self.workspace, &self.target, self.replace)
    }
}

/// Creates the workspace of an output. Leftovers of killed runs with this output are repaired and removed first.
fn staged(target: &Path, kind: Kind, replace: Replace) -> Result<Workspace> {
    tidy(target);
    check_replace(target, kind, replace)?;
    Workspace::beside(target)
}

/// Creates a workspace for scratch files in `folder`. Scratch files of killed runs are removed first.
fn scratch_in(folder: &Path) -> Result<Workspace> {
    let target = folder.join(SCRATCH);
    tidy(&target);
    Workspace::beside(&target)
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
        let workspace = scratch_in(folder)?;
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

/// Writes a file through to the disk.
fn sync(path: &Path) -> Result<()> {
    splat_platform::sync_file(path).map_err(Error::io("sync", path))
}

fn sync_tree(folder: &Path) -> Result<()> {
    for path in entries(folder)?.iter().map(|entry| folder.join(entry)) {
        if path.is_dir() { sync_tree(&path)? } else { sync(&path)? }
    }
    splat_platform::sync_folder(folder).map_err(Error::io("sync", folder))
}

#[cfg(test)]
mod tests;
