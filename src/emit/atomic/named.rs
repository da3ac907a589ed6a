//! Which files are a result's own, and which are somebody else's.
//!
//! The summary of a result names them: its `files`, relative to the summary's folder. Files that came into a result's
//! folder from elsewhere, pictures and scores that other programs wrote, are in no such list.

use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result, quoted};

/// The file by which a folder is known as this program's: a JSON object whose `tool` names it. Its `files` are the
/// result's own; [`super::StagedFolder::commit`] and [`super::commit_files`] enter them.
pub const MARKER: &str = "summary.json";

/// What a summary says of the files it stands for.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Owner {
    /// There is none, or another program's.
    Unknown,
    /// This program's, from before it listed its files.
    Unlisted,
    /// These files are a result's.
    Listed(BTreeSet<String>),
}

impl Owner {
    /// What the summary at `path` says.
    pub(super) fn of(path: &Path) -> Owner {
        let Ok(text) = fs::read_to_string(path) else { return Owner::Unknown };
        let summary: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
        if !summary["tool"].as_str().is_some_and(|tool| tool.starts_with("splatsieve")) {
            return Owner::Unknown;
        }
        match summary["files"].as_array() {
            Some(files) => Owner::Listed(files.iter().filter_map(|file| Some(file.as_str()?.to_owned())).collect()),
            None => Owner::Unlisted,
        }
    }
}

/// Whether a file is known as this program's: a container that opens, or one that a summary beside it names.
pub(super) fn is_our_file(path: &Path) -> bool {
    if !path.is_file() {
        return false;
    }
    if gseq::Reader::open(path).is_ok() {
        return true;
    }
    let Some(name) = path.file_name().and_then(OsStr::to_str) else { return false };
    // Of x.ply and of x.ply.recipe.toml it is x.ply.summary.json.
    let ends = name.match_indices('.').map(|(dot, _)| dot).chain([name.len()]);
    ends.map(|end| path.with_file_name(format!("{}.{MARKER}", &name[..end])))
        .any(|summary| matches!(Owner::of(&summary), Owner::Listed(files) if files.contains(name)))
}

/// Writes into the summary at `path` that these are its files.
pub(super) fn name_files(path: &Path, files: &[String]) -> Result<()> {
    let text = fs::read_to_string(path).map_err(Error::io("read back", path))?;
    let found: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    // As text, for the other entries keep their order.
    let Some(entries) = text.trim_end().strip_suffix('}').filter(|_| found.is_object()) else {
        return Err(Error::usage(format!(
            "{}: expected a JSON object to list files in, found {}",
            path.display(),
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

/// Moves from the folder `old` into `new` what the summary of `old` does not name. What has the place of a file
/// that `new` has goes beside it, under its name with `.kept` behind.
///
/// May be repeated after it was broken off at any point: nothing is ever in neither of the two.
pub(super) fn carry_foreign(old: &Path, new: &Path) -> Result<()> {
    let named = match Owner::of(&old.join(MARKER)) {
        Owner::Listed(named) => named,
        Owner::Unknown | Owner::Unlisted => BTreeSet::new(),
    };
    let mut foreign = Vec::new();
    find_foreign(old, new, Path::new(""), &named, &mut foreign)?;
    for relative in foreign {
        let (from, to) = (old.join(&relative), free_place(new, &relative));
        let folder = parts(&to)?.0;
        fs::create_dir_all(&folder).map_err(Error::io("create", &folder))?;
        fs::rename(&from, &to).map_err(Error::io("keep", &from))?;
    }
    Ok(())
}

/// Files of `old` that `named` does not hold, and folders that hold nothing else and are not in `new`.
fn find_foreign(old: &Path, new: &Path, inside: &Path, named: &BTreeSet<String>, out: &mut Vec<PathBuf>) -> Result<()> {
    for entry in entries(&old.join(inside))? {
        let relative = inside.join(entry);
        let name = listed_name(&relative);
        if !is_folder(&old.join(&relative)) {
            if !named.contains(&name) {
                out.push(relative);
            }
            continue;
        }
        let below = format!("{name}/");
        let is_shared = named.range(below.clone()..).next().is_some_and(|next| next.starts_with(&below));
        if is_shared || is_folder(&new.join(&relative)) {
            find_foreign(old, new, &relative, named, out)?;
        } else {
            out.push(relative);
        }
    }
    Ok(())
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
