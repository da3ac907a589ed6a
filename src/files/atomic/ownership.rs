//! Ownership of files: which files belong to a result, and which were added by others (foreign files).
//!
//! The summary of a result lists the files of the result under `files`, relative to the folder of the summary. Foreign
//! files in the folder of a result, such as images and scores of other programs, are not in the list.

use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use splat_platform::{FolderHandle, open_without_waiting};

use crate::error::{Error, Result, ShowPath, quoted};

/// Name of the summary file, which identifies a folder as a result of this program. The file is a JSON object. Its
/// member `tool` names the program, and its member `files` lists the files of the result.
/// [`super::StagedFolder::commit`] and [`super::StagedFile::commit`] add this list.
pub const SUMMARY_FILE: &str = "summary.json";

/// Maximum length in bytes of the name of an output: 255, the limit of common file systems, less the 24 bytes that the
/// name of the hidden folder beside it adds ([`super::workspace::publishing_name`]).
pub(super) const MAX_NAME_BYTES: usize = 231;

/// Maximum size in bytes of a file that is read as a summary: 16 MiB, enough to list about 500,000 files. Larger files
/// are not summaries of this program and are not read.
const MAX_SUMMARY: u64 = 16 << 20;

/// Files that belong to a result, according to the summary of the result.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum ListedFiles {
    /// There is no summary with a list of files, or another program wrote the summary.
    Unknown,
    /// This program wrote the summary, which lists these files of the result by their paths relative to the summary.
    Listed(BTreeSet<String>),
}

/// Fields of a summary that say which files belong to the result: `tool` is the name and version of the program, and
/// `files` are the paths relative to the summary. Other fields are skipped while the summary is parsed.
#[derive(Deserialize)]
struct Declared {
    tool: String,
    files: BTreeSet<String>,
}

impl ListedFiles {
    /// Reads the summary at `path`, which may be a link, and returns the list of the files that belong to the result.
    /// Returns [`ListedFiles::Unknown`] if the file cannot be read or is not a summary of this program with a list of
    /// files.
    pub(super) fn read(path: &Path) -> ListedFiles {
        // Open without waiting: a plain open of a FIFO would wait until another program opens it for writing.
        open_without_waiting(path).map_or(ListedFiles::Unknown, ListedFiles::read_file)
    }

    /// Reads the open summary `file` and returns the list of the files that belong to the result. Returns
    /// [`ListedFiles::Unknown`] if `file` cannot be read or is not a summary of this program with a list of files.
    pub(super) fn read_file(mut file: File) -> ListedFiles {
        if !file.metadata().is_ok_and(|found| found.is_file() && found.len() <= MAX_SUMMARY) {
            return ListedFiles::Unknown;
        }
        let mut text = Vec::new();
        if (&mut file).take(MAX_SUMMARY).read_to_end(&mut text).is_err() || !text.trim_ascii_start().starts_with(b"{") {
            return ListedFiles::Unknown;
        }
        match serde_json::from_slice::<Declared>(&text) {
            Ok(Declared { tool, files }) if tool.starts_with("splatsieve") => ListedFiles::Listed(files),
            _ => ListedFiles::Unknown,
        }
    }
}

/// Adds the field `files` with the paths `files` to the summary at `path`, a JSON file that describes a result. Fails
/// if the summary is not a JSON object.
pub(super) fn add_file_list(path: &Path, files: &[String]) -> Result<()> {
    let text = fs::read_to_string(path).map_err(Error::io("read back", path))?;
    let found: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    // Edit the text instead of writing the parsed object, so that the other entries keep their order.
    let Some(entries) = text.trim_end().strip_suffix('}').filter(|_| found.is_object()) else {
        return Err(Error::internal(format!(
            "{}: expected a JSON object to list files in, found {}",
            path.shown(),
            quoted(&text)
        )));
    };
    let entries = entries.trim_end();
    let comma = if entries.ends_with('{') { "" } else { "," };
    let quoted: Vec<String> =
        files.iter().map(|file| format!("\n    {}", serde_json::Value::from(file.as_str()))).collect();
    let text = format!("{entries}{comma}\n  \"files\": [{}\n  ]\n}}\n", quoted.join(","));
    fs::write(path, text).map_err(Error::io("write", path))
}

/// Returns the paths of all files below `folder`, relative to `folder` and sorted.
pub(super) fn files_below(folder: &Path) -> Result<Vec<String>> {
    fn visit(folder: &Path, inside: &Path, out: &mut Vec<String>) -> Result<()> {
        for entry in entries(folder)? {
            let (path, relative) = (folder.join(&entry), inside.join(&entry));
            if is_folder(&path) { visit(&path, &relative, out)? } else { out.push(listed_name(&relative)) }
        }
        Ok(())
    }
    let mut files = Vec::new();
    visit(folder, Path::new(""), &mut files)?;
    files.sort();
    Ok(files)
}

/// Moves the foreign entries of `old`, the folder of an earlier result, into `new`, the folder of the new result.
/// Foreign entries are files and folders that the summary in `old` does not list. An entry whose name exists in `new`
/// gets `.kept` appended to its name.
///
/// Entries that cannot be moved stay in `old`, and the first failure is returned. The function may be called again
/// after an interruption at any point: every entry is always in exactly one of the two folders.
pub(super) fn move_foreign_entries(old: &FolderHandle, new: &Path) -> io::Result<()> {
    let listed = match old.open_file(SUMMARY_FILE, false).map(ListedFiles::read_file) {
        Ok(ListedFiles::Listed(listed)) => listed,
        _ => BTreeSet::new(),
    };
    let mut foreign = Vec::new();
    let mut result = find_foreign(old, new, Path::new(""), &listed, &mut foreign);
    for relative in foreign {
        let to = unused_path(new, &relative);
        let made = to.parent().map_or(Ok(()), fs::create_dir_all);
        result = result.and(made.and_then(|()| old.move_entry(&relative, &to)));
    }
    result
}

/// Searches `folder`, a folder in the tree of an earlier result, and its subfolders for foreign entries (entries that
/// do not belong to the earlier result). Appends their paths, relative to the top folder of the earlier result, to
/// `out`.
///
/// - `inside` is the path of `folder`, relative to the top folder of the earlier result.
/// - `listed` holds the paths of the files that belong to the earlier result.
/// - `new` is the top folder of the new result.
///
/// Foreign entries are files that are not in `listed`, and folders that contain no file in `listed` and do not exist in
/// `new`. A subfolder that cannot be read is skipped; the first such error is returned at the end.
fn find_foreign(
    folder: &FolderHandle,
    new: &Path,
    inside: &Path,
    listed: &BTreeSet<String>,
    out: &mut Vec<PathBuf>,
) -> io::Result<()> {
    let mut result = Ok(());
    for entry in folder.entries()? {
        let relative = inside.join(&entry);
        let name = listed_name(&relative);
        if !folder.has_folder(&entry) {
            if !listed.contains(&name) {
                out.push(relative);
            }
            continue;
        }
        let below = format!("{name}/");
        let is_shared = listed.range(below.clone()..).next().is_some_and(|next| next.starts_with(&below));
        if is_shared || is_folder(&new.join(&relative)) {
            let found = folder.open_folder(&entry);
            result = result.and(found.and_then(|inner| find_foreign(&inner, new, &relative, listed, out)));
        } else {
            out.push(relative);
        }
    }
    result
}

/// Returns an unused path below `folder` for a foreign entry with the relative path `relative`. This is `relative`
/// itself, except that `.kept` is appended to a component whose name is taken:
///
/// - to the last component, if a file or folder of this name exists
/// - to any other component, if something that is not a folder has this name
fn unused_path(folder: &Path, relative: &Path) -> PathBuf {
    let mut place = folder.to_owned();
    let mut components = relative.components().peekable();
    while let Some(component) = components.next() {
        let mut name = component.as_os_str().to_owned();
        let is_last = components.peek().is_none();
        while exists(&place.join(&name)) && (is_last || !is_folder(&place.join(&name))) {
            name.push(".kept");
        }
        place.push(name);
    }
    place
}

/// Returns a relative path as it is written in summaries: with `/` as separator on every system.
fn listed_name(relative: &Path) -> String {
    let components: Vec<_> = relative.iter().map(OsStr::to_string_lossy).collect();
    components.join("/")
}

/// Returns the names of the entries in `folder`, sorted because the file system determines the order of a listing.
pub(super) fn entries(folder: &Path) -> Result<Vec<OsString>> {
    let listed = fs::read_dir(folder).and_then(|entries| entries.map(|entry| Ok(entry?.file_name())).collect());
    let mut names: Vec<OsString> = listed.map_err(Error::io("list", folder))?;
    names.sort();
    Ok(names)
}

/// Returns whether a file, a folder or a link, even a dangling one, exists at `path`.
pub(super) fn exists(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// Returns whether `path` is a folder and not a link to one.
fn is_folder(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_dir())
}

/// Splits the output path `target` into its folder and its name. Fails if it has no name.
pub(super) fn split_target(target: &Path) -> Result<(PathBuf, &OsStr)> {
    let Some(name) = target.file_name() else {
        return Err(Error::usage(format!(
            "{} cannot be the name of an output; give a file or folder name",
            quoted(&target.to_string_lossy())
        )));
    };
    let parent = target.parent().filter(|parent| !parent.as_os_str().is_empty());
    Ok((parent.unwrap_or(Path::new(".")).to_owned(), name))
}

/// Checks that the output path `target` is not `-`, which other programs take for standard output.
pub(super) fn check_no_stream(target: &Path) -> Result<()> {
    match target == Path::new("-") {
        true => Err(Error::usage(
            "-: expected the name of a file or folder to write, found '-', which stands for standard output\n  \
             only `splatsieve convert INPUT -` writes there, a frame stream; ./- is a file or folder named '-'",
        )),
        false => Ok(()),
    }
}

/// Checks that the name of the output `target` is short enough for the names that are made of it while it is written.
pub(super) fn check_name_length(target: &Path) -> Result<()> {
    let (_, name) = split_target(target)?;
    match name.len() {
        ..=MAX_NAME_BYTES => Ok(()),
        length => Err(Error::usage(format!(
            "{}: expected a name of at most {MAX_NAME_BYTES} bytes, because temporary files beside the output have longer \
             names; found {length} bytes\n  choose a shorter name",
            target.shown()
        ))),
    }
}

/// Checks that the output path `target` ends in the name of the output, which is a folder if `is_folder` is set.
/// `file_name` of the standard library ignores `/` and `/.` after a name, but system calls do not: they take `/` after a
/// name for that of a folder, and rename nothing to a path that ends in `/.`.
pub(super) fn check_ending(target: &Path, is_folder: bool) -> Result<()> {
    let (_, name) = split_target(target)?;
    let path = target.to_string_lossy();
    let path = if is_folder { path.trim_end_matches(std::path::is_separator) } else { &path };
    if path.ends_with(&*name.to_string_lossy()) {
        return Ok(());
    }
    let (expected, ending) = if is_folder { ("folder", "/.") } else { ("file", "/") };
    Err(Error::usage(format!(
        "{}: the output is a {expected}: expected its name, found a path that ends in '{ending}'\n  \
         leave out what follows the name: {}",
        target.shown(),
        target.with_file_name(name).shown()
    )))
}
