//! Which files are a result's own, and which are somebody else's.
//!
//! The summary of a result names them: its `files`, relative to the summary's folder. Files that came into a result's
//! folder from elsewhere, pictures and scores that other programs wrote, are in no such list.

use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use splat_platform::{FolderHandle, open_without_waiting};

use crate::error::{Error, Result, ShowPath, quoted};

/// The file by which a folder is known as this program's: a JSON object whose `tool` names it. Its `files` are the
/// result's own; [`super::StagedFolder::commit`] and [`super::commit_files`] enter them.
pub const MARKER: &str = "summary.json";

/// Bytes of the largest file that is read as a summary, 16 MiB: the list of some 500,000 files. A larger file is not a
/// summary of this program, and not read.
const MAX_SUMMARY: u64 = 16 << 20;

/// Ownership that a summary declares.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Owner {
    /// There is no summary that lists its files, or it is another program's.
    Unknown,
    /// A result of this program with these files.
    Listed(BTreeSet<String>),
}

/// Entries of a summary that say whose it is. Other entries are skipped without keeping them in memory.
#[derive(Deserialize)]
struct Declared {
    tool: String,
    files: BTreeSet<String>,
}

impl Owner {
    /// Reads the summary at `path`; a link to a summary counts as one.
    pub(super) fn read(path: &Path) -> Owner {
        // Opening a FIFO would wait for its writer.
        open_without_waiting(path).map_or(Owner::Unknown, Owner::read_file)
    }

    /// Reads the summary in `file`.
    pub(super) fn read_file(mut file: File) -> Owner {
        if !file.metadata().is_ok_and(|found| found.is_file() && found.len() <= MAX_SUMMARY) {
            return Owner::Unknown;
        }
        let mut text = Vec::new();
        if (&mut file).take(MAX_SUMMARY).read_to_end(&mut text).is_err() || !text.trim_ascii_start().starts_with(b"{") {
            return Owner::Unknown;
        }
        match serde_json::from_slice::<Declared>(&text) {
            Ok(Declared { tool, files }) if tool.starts_with("splatsieve") => Owner::Listed(files),
            _ => Owner::Unknown,
        }
    }
}

/// Writes into the summary at `path` that these are its files.
pub(super) fn name_files(path: &Path, files: &[String]) -> Result<()> {
    let text = fs::read_to_string(path).map_err(Error::io("read back", path))?;
    let found: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    // As text, for the other entries keep their order.
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

/// Every file below `folder`, relative to it, sorted.
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

/// Moves the entries of the folder `old` that its summary does not list into the folder `new`. Where `new` has an entry of
/// the same name, the moved one gets `.kept` behind its name.
///
/// Entries that cannot be moved stay, and the first failure is returned. May be repeated after it was interrupted at
/// any point: every entry is always in exactly one of both folders.
pub(super) fn carry_foreign(old: &FolderHandle, new: &Path) -> io::Result<()> {
    let listed = match old.open_file(MARKER, false).map(Owner::read_file) {
        Ok(Owner::Listed(listed)) => listed,
        _ => BTreeSet::new(),
    };
    let mut foreign = Vec::new();
    let mut result = find_foreign(old, new, Path::new(""), &listed, &mut foreign);
    for relative in foreign {
        let to = free_place(new, &relative);
        let made = to.parent().map_or(Ok(()), fs::create_dir_all);
        result = result.and(made.and_then(|()| old.move_to(&relative, &to)));
    }
    result
}

/// Collects the relative paths of files in `folder`, which is `inside` the old result, that `listed` does not hold, and of
/// folders that hold no listed file and do not exist in `new`. Folders that cannot be read are skipped; the first failure
/// is returned.
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

/// A path below `folder` that nothing has and that can be made: `relative`, but for what is in its way.
fn free_place(folder: &Path, relative: &Path) -> PathBuf {
    let mut place = folder.to_owned();
    let mut components = relative.components().peekable();
    while let Some(component) = components.next() {
        let mut name = component.as_os_str().to_owned();
        let is_last = components.peek().is_none();
        while present(&place.join(&name)) && (is_last || !is_folder(&place.join(&name))) {
            name.push(".kept");
        }
        place.push(name);
    }
    place
}

/// How lists write a relative path, on every system.
fn listed_name(relative: &Path) -> String {
    let components: Vec<_> = relative.iter().map(OsStr::to_string_lossy).collect();
    components.join("/")
}

/// Names in a folder, sorted: the order of a listing is the file system's.
pub(super) fn entries(folder: &Path) -> Result<Vec<OsString>> {
    let listed = fs::read_dir(folder).and_then(|entries| entries.map(|entry| Ok(entry?.file_name())).collect());
    let mut names: Vec<OsString> = listed.map_err(Error::io("list", folder))?;
    names.sort();
    Ok(names)
}

/// Whether anything has that name, be it a link to nowhere.
pub(super) fn present(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// Whether that is a folder, and no link to one.
fn is_folder(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_dir())
}

/// The folder and the name of a target.
pub(super) fn parts(target: &Path) -> Result<(PathBuf, &OsStr)> {
    let Some(name) = target.file_name() else {
        return Err(Error::usage(format!("{} is no name for an output", quoted(&target.to_string_lossy()))));
    };
    let parent = target.parent().filter(|parent| !parent.as_os_str().is_empty());
    Ok((parent.unwrap_or(Path::new(".")).to_owned(), name))
}
