//! Atomic outputs: an output appears under its name either complete or not at all.
//!
//! An output is written in a hidden workspace beside its target ([`workspace`]). `commit` syncs it to disk and
//! publishes it under its name ([`publish`]); runs with the same output publish one after the other. Dropping an output
//! without `commit` removes it. When a signal ends the process, [`remove_unfinished`] removes all outputs that have not
//! been published. The workspaces of killed runs are repaired and removed by the next run with the same output
//! ([`leftovers`]). Runs in different containers and on different machines may share folders.
//!
//! [`Replace`] determines which existing outputs are overwritten. Only regular files, folders and links to regular
//! files are ever replaced; output to a character device or FIFO is written into it.

mod destination;
mod leftovers;
mod ownership;
mod publish;
mod stream;
mod warnings;
mod workspace;

use std::fs;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result, ShowPath};
use destination::{Destination, check_replace, destination, real_parent};
pub use destination::{Replace, TargetKind};
use leftovers::clean_up;
pub use leftovers::remove_leftovers;
pub use ownership::SUMMARY_FILE;
use ownership::{
    add_file_list, check_ending, check_name_length, check_no_stream, entries, exists, files_below, split_target,
};
pub use stream::is_standard_output_used;
pub use warnings::take_warnings;
pub use workspace::{ExitGuard, remove_unfinished};
use workspace::{SCRATCH, Workspace, user_path};

/// Checks, before a run does any work, that it may write its output to `target`. `kind` says whether the output is a
/// file or a folder, and `inputs` are the paths that the run reads. If a killed run left an unfinished output of this
/// name, completes or removes it.
///
/// Refuses these targets:
///
/// - a target without a name, or in a folder that does not exist
/// - `-`, which stands for standard output
/// - a name of more than [`MAX_NAME_BYTES`](ownership::MAX_NAME_BYTES) bytes
/// - a file whose name is followed by `/`, and a file or folder whose name is followed by `/.`
/// - a target that is an input, contains an input or lies inside an input, even if the path leads there only through
///   links; this holds for every value of `replace`
/// - an existing target that `replace` does not allow replacing (a folder may always replace an empty folder)
/// - a file in place of a folder, or the reverse
/// - sockets, block devices and dangling links
///
/// # Errors
/// Fails with [`Error::Usage`] in each of these cases, and if a system call fails.
pub fn check_target(target: &Path, kind: TargetKind, inputs: &[&Path], replace: Replace) -> Result<()> {
    let shown = target.shown();
    check_no_stream(target)?;
    check_ending(target, kind == TargetKind::Folder)?;
    check_name_length(target)?;
    let real_parent = real_parent(target)?;
    let (_, name) = split_target(target)?;
    // Compare both the entry `target` and the file that it links to. Renaming over a link replaces only the link, but a
    // user who names the input through a link does not want that link replaced.
    let named = real_parent.join(name);
    let linked = fs::canonicalize(target).unwrap_or_else(|_| named.clone());
    for input in inputs {
        let Ok(real) = fs::canonicalize(input) else { continue };
        if real == named || real == linked {
            return Err(Error::usage(format!("{shown} is the input itself; give another output")));
        }
        if real.starts_with(&named) || real.starts_with(&linked) {
            let input = input.shown();
            return Err(Error::usage(format!("{shown} contains the input {input}; give another output")));
        }
        // Do not write into an input folder: a PLY file added to a folder of frames would become another frame, and a
        // folder added to a model would become another iteration.
        if named.starts_with(&real) || linked.starts_with(&real) {
            let input = input.shown();
            return Err(Error::usage(format!("{shown} lies inside the input {input}; give another output")));
        }
    }
    if kind == TargetKind::File && destination(target)? == Destination::Stream {
        return Ok(());
    }
    clean_up(target);
    check_replace(target, kind, replace)?;
    check_writable(target, &real_parent)
}

/// Checks that a file can be created in `parent`, the folder that `target` is written into. Creates a file without a
/// name there and removes it again.
///
/// # Errors
/// Fails with [`Error::Usage`] if the folder has no write permission, the file system is read-only or no space is left.
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

/// Checks, before a run does any work, that it may write the file `target` and the files `companions` beside it. Each
/// of them is checked as in [`check_target`]. `inputs` are the paths that the run reads, and `replace` says which
/// existing files may be replaced.
///
/// # Errors
/// Fails like [`check_target`], and if one of these paths is a device or FIFO, which can hold only one file.
pub fn check_targets(target: &Path, companions: &[PathBuf], inputs: &[&Path], replace: Replace) -> Result<()> {
    for path in std::iter::once(target).chain(companions.iter().map(PathBuf::as_path)) {
        check_target(path, TargetKind::File, inputs, replace)?;
        if destination(path)? == Destination::Stream {
            return Err(Error::usage(format!(
                "{} is a device or FIFO, and the result is several files; give the name of a file",
                path.shown()
            )));
        }
    }
    Ok(())
}

/// Output file, possibly with companion files beside it, all first written under hidden names. [`StagedFile::commit`]
/// moves all of them to their output paths together, or copies the file into the device or FIFO at its path.
#[derive(Debug)]
pub struct StagedFile {
    target: PathBuf,
    companions: Vec<PathBuf>,
    content: PathBuf,
    replace: Replace,
    is_stream: bool,
    workspace: Workspace,
}

impl StagedFile {
    /// Prepares to write the output file `target`, which must have passed [`check_target`]. Does not create the file
    /// yet. Returns the handle through which the file is written and published.
    ///
    /// # Errors
    /// Fails if the target has no name, if it exists and `replace` does not allow replacing it, or if a system call
    /// fails.
    pub fn new(target: &Path, replace: Replace) -> Result<StagedFile> {
        StagedFile::with_companions(target, Vec::new(), replace)
    }

    /// Prepares to write the output file `target` and the files `companions` beside it. All of them must have passed
    /// [`check_targets`]. The name of each companion must begin with the name of `target`. The first companion is the
    /// summary (JSON file that describes the result). `replace` says which existing files may be replaced. Returns the
    /// handle through which the files are written and published.
    ///
    /// # Errors
    /// Fails like [`StagedFile::new`] for each of the files.
    pub fn with_companions(target: &Path, companions: Vec<PathBuf>, replace: Replace) -> Result<StagedFile> {
        let is_stream = companions.is_empty() && destination(target)? == Destination::Stream;
        let workspace = match is_stream {
            // Write in the system's folder for temporary files, because no folder can be created beside a device.
            true => scratch_workspace(&std::env::temp_dir())?,
            false => output_workspace(target, TargetKind::File, replace)?,
        };
        for companion in &companions {
            check_replace(companion, TargetKind::File, replace)?;
        }
        let (target, content) = (target.to_owned(), workspace.content());
        Ok(StagedFile { target, companions, content, replace, is_stream, workspace })
    }

    /// Returns the hidden path to which the caller writes the output file before [`StagedFile::commit`].
    pub fn path(&self) -> &Path {
        &self.content
    }

    /// Returns the hidden path to which the caller writes the companion file with index `index`.
    pub fn companion_path(&self, index: usize) -> PathBuf {
        self.workspace.folder.join(companion_name(index))
    }

    /// Publishes the output file and its companions: adds the list of all these files to the summary (the first
    /// companion), syncs the files to disk and renames them to their final names. The summary is renamed first and the
    /// output file last, so that at every moment a summary says to which result a published file belongs. Replaces
    /// existing files if the policy allows it.
    ///
    /// Runs with the same output publish one after the other, so files of different runs are never mixed. If the
    /// process is killed between two renames, the next run with this output completes the set.
    ///
    /// # Errors
    /// Fails if nothing was written, if the summary is not a JSON object, if a file that may not be replaced appeared
    /// meanwhile, or if a system call fails.
    pub fn commit(self) -> Result<()> {
        if self.is_stream {
            return stream::copy(&self.content, &self.target);
        }
        let names = self.companions.iter().chain([&self.target]);
        let names = names.map(|path| Ok(split_target(path)?.1.to_string_lossy().into_owned()));
        let mut names = names.collect::<Result<Vec<String>>>()?;
        names.sort();
        if !self.companions.is_empty() {
            add_file_list(&self.companion_path(0), &names)?;
        }
        let mut files: Vec<(String, &Path)> = Vec::new();
        for (index, target) in self.companions.iter().enumerate() {
            sync(&self.companion_path(index))?;
            files.push((companion_name(index), target));
        }
        sync(&self.content)?;
        files.push((workspace::CONTENT.to_owned(), &self.target));
        publish::publish_files(&self.workspace, &files, self.replace)
    }
}

/// Returns the hidden file name that companion `index` has in the workspace.
fn companion_name(index: usize) -> String {
    format!("companion-{index}")
}

/// Output folder that is first written under a hidden name. [`StagedFolder::commit`] moves it to the output path.
#[derive(Debug)]
pub struct StagedFolder {
    target: PathBuf,
    content: PathBuf,
    replace: Replace,
    workspace: Workspace,
}

impl StagedFolder {
    /// Creates an empty hidden folder that will become `target`, which must have passed [`check_target`].
    ///
    /// # Errors
    /// Fails if the target has no name, if it exists and `replace` does not allow replacing it, or if a system call
    /// fails.
    pub fn new(target: &Path, replace: Replace) -> Result<StagedFolder> {
        let workspace = output_workspace(target, TargetKind::Folder, replace)?;
        let content = workspace.content();
        fs::create_dir(&content).map_err(Error::io("create", &content))?;
        Ok(StagedFolder { target: target.to_owned(), content, replace, workspace })
    }

    /// Returns the hidden folder into which the caller writes before [`StagedFolder::commit`].
    pub fn path(&self) -> &Path {
        &self.content
    }

    /// Syncs the folder with all its files to disk and gives it its final name. Before that, adds the list of all files
    /// in the folder to its summary (`summary.json`), if it has one.
    ///
    /// An earlier folder of this name is moved aside and deleted after the new one is in place. Foreign files in the
    /// earlier folder (files that its summary does not list) are moved into the new folder. If the run is killed
    /// meanwhile, either the earlier or the new folder is complete. The foreign files are then in the complete folder
    /// or in the hidden workspace, from where the next run with this output moves them.
    ///
    /// # Errors
    /// Fails if the summary is not a JSON object, if the target appeared meanwhile and may not be replaced, or if a
    /// system call fails. The target is then unchanged.
    pub fn commit(self) -> Result<()> {
        let summary = self.content.join(SUMMARY_FILE);
        if exists(&summary) {
            add_file_list(&summary, &files_below(&self.content)?)?;
        }
        sync_tree(&self.content)?;
        publish::publish_folder(&self.workspace, &self.target, self.replace)
    }
}

/// Writes `text` to the file `path`.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_text(path: &Path, text: impl AsRef<[u8]>) -> Result<()> {
    fs::write(path, text).map_err(Error::io("write", path))
}

/// Writes the JSON object `summary` to the file [`SUMMARY_FILE`] in the output folder `folder`. By this file a later run
/// recognizes the folder as one that it may replace.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_summary(folder: &Path, summary: &serde_json::Value) -> Result<()> {
    write_text(&folder.join(SUMMARY_FILE), format!("{summary:#}\n"))
}

/// Creates the workspace (hidden folder) in which the output `target` is written. First repairs and removes the
/// workspaces that killed runs with this output left behind. Fails if `target` exists and `replace` does not allow an
/// output of the kind `kind` to replace it, or if a system call fails.
fn output_workspace(target: &Path, kind: TargetKind, replace: Replace) -> Result<Workspace> {
    clean_up(target);
    check_replace(target, kind, replace)?;
    Workspace::beside(target)
}

/// Creates a workspace (hidden folder) for scratch files in `folder`. First removes scratch files of killed runs.
fn scratch_workspace(folder: &Path) -> Result<Workspace> {
    let target = folder.join(SCRATCH);
    clean_up(&target);
    Workspace::beside(&target)
}

/// Path for a temporary file. The file is removed when this value is dropped.
#[derive(Debug)]
pub struct ScratchFile {
    content: PathBuf,
    _workspace: Workspace,
}

impl ScratchFile {
    /// Reserves an unused path for a scratch file in `folder`. Does not create the file yet. Returns the handle of the
    /// path, which removes the file when it is dropped.
    ///
    /// # Errors
    /// Fails if the folder does not exist or a system call fails.
    pub fn new(folder: &Path) -> Result<ScratchFile> {
        let workspace = scratch_workspace(folder)?;
        Ok(ScratchFile { content: workspace.content(), _workspace: workspace })
    }

    /// Returns the path to which the caller writes the scratch file.
    pub fn path(&self) -> &Path {
        &self.content
    }
}

/// Temporary folder, removed when this value is dropped.
#[derive(Debug)]
pub struct ScratchFolder(ScratchFile);

impl ScratchFolder {
    /// Creates an empty temporary folder in `folder`.
    ///
    /// # Errors
    /// Fails if the folder does not exist or a system call fails.
    pub fn new(folder: &Path) -> Result<ScratchFolder> {
        let scratch = ScratchFile::new(folder)?;
        fs::create_dir(scratch.path()).map_err(Error::io("create", scratch.path()))?;
        Ok(ScratchFolder(scratch))
    }

    /// Returns the path of the temporary folder.
    pub fn path(&self) -> &Path {
        self.0.path()
    }
}

/// Returns `error` with a path that the user knows. Errors of system calls, and messages of writers that begin with the
/// path of the file, may contain a path in a hidden workspace, which the user has never seen. The path in the returned
/// error is then:
///
/// - for an output: the output path that the user gave
/// - for a scratch file: the folder that holds the scratch file
///
/// Other errors are returned unchanged.
pub fn with_user_path(error: Error) -> Error {
    let (action, path, source) = match error {
        Error::Io { action, path, source } | Error::Container(gseq::Error::Io { action, path, source }) => {
            (action, path, source)
        }
        Error::Usage(text) => {
            let output = text.split_once(": ").and_then(|(path, rest)| match user_path(Path::new(path))? {
                (output, false) => Some(format!("{}: {rest}", output.shown())),
                _ => None,
            });
            return Error::Usage(output.unwrap_or(text));
        }
        error => return error,
    };
    match user_path(&path) {
        Some((path, true)) => Error::Io { action: "write a scratch file in", path, source },
        Some((path, false)) => Error::Io { action, path, source },
        None => Error::Io { action, path, source },
    }
}

/// Syncs the file at `path` to disk.
fn sync(path: &Path) -> Result<()> {
    splat_platform::sync_file(path).map_err(Error::io("sync", path))
}

/// Syncs `folder`, and all files and folders below it, to disk.
fn sync_tree(folder: &Path) -> Result<()> {
    for path in entries(folder)?.iter().map(|entry| folder.join(entry)) {
        if path.is_dir() { sync_tree(&path)? } else { sync(&path)? }
    }
    splat_platform::sync_folder(folder).map_err(Error::io("sync", folder))
}

#[cfg(test)]
mod tests;
