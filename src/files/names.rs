//! Names under which outputs mention other files. Outputs are published, so they must not contain names of folders on
//! the user's machine. An input file is mentioned by the last component of its path. A file that a recipe (file of all
//! parameters) needs again is mentioned by its path relative to the recipe.

use std::fs;
use std::path::{Component, Path, PathBuf};

use crate::error::ShowPath;

/// Minimum number of leading folders that a file and the recipe that names it must share, so that the recipe may name
/// the file by a relative path. One shared folder is enough if it is the working directory or lies below it. Otherwise
/// the recipe states only the last component of the path, because a relative path could reveal the name of a private
/// folder: a relative path from `/home/a/small` to `/home/b/data` would contain `b`.
const MIN_SHARED_FOLDERS: usize = 2;

/// Returns the last component of `path`; for `.` and paths that end in `..`, the name of the folder they stand for.
pub fn name_of(path: &Path) -> String {
    let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
    name(path).or_else(|| name(&fs::canonicalize(path).ok()?)).unwrap_or_else(|| path.to_string_lossy().into_owned())
}

/// Returns whether the file name of `path` has the ending `ending`, such as `.ply` or `.ftgs.ply`, in lower or upper
/// case. A name that is nothing but the ending does not have it.
pub fn has_ending(path: &Path, ending: &str) -> bool {
    let name = path.file_name().unwrap_or_default().as_encoded_bytes();
    name.len() > ending.len() && name[name.len() - ending.len()..].eq_ignore_ascii_case(ending.as_bytes())
}

/// Characters that separate the components of a path on any system.
const SEPARATORS: [char; 2] = ['/', '\\'];

/// Returns the last component of a path that may have been written on another system. Separators at its end are
/// ignored. Returns an empty text if `path` has only separators.
pub fn last_component(path: &str) -> &str {
    path.trim_end_matches(SEPARATORS).rsplit(SEPARATORS).next().unwrap_or_default()
}

/// Returns the last component of `path` (see [`name_of`]), escaped for display.
pub fn shown_name(path: &Path) -> String {
    Path::new(&name_of(path)).shown().to_string()
}

/// Returns `path` relative to `folder`, which need not exist yet. Returns only the last component of `path` if `path`
/// and `folder` have too few folders in common ([`MIN_SHARED_FOLDERS`]). Separators are `/` on every system.
pub fn relative_to_folder(path: &Path, folder: &Path) -> PathBuf {
    let found = (|| {
        let (path, folder) = (real_path(path)?, real_path(folder)?);
        let shared = path.components().zip(folder.components()).take_while(|(a, b)| a == b).count();
        let is_near = |common: &Path| {
            let names = common.components().filter(|part| matches!(part, Component::Normal(_))).count();
            let here = std::env::current_dir().ok().and_then(|here| fs::canonicalize(here).ok());
            names >= MIN_SHARED_FOLDERS || names > 0 && here.is_some_and(|here| common.starts_with(here))
        };
        if !is_near(&path.components().take(shared).collect::<PathBuf>()) {
            return None;
        }
        let up = folder.components().skip(shared).map(|_| "..".into());
        let down = path.components().skip(shared).map(|part| part.as_os_str().to_string_lossy().into_owned());
        let parts: Vec<String> = up.chain(down).collect();
        Some(if parts.is_empty() { ".".to_owned() } else { parts.join("/") })
    })();
    found.map_or_else(|| name_of(path).into(), PathBuf::from)
}

/// Returns `path` as an absolute path. Links and `..` in its folders are resolved; a link in the last component is
/// kept. Returns `None` if the path cannot be resolved.
fn real_path(path: &Path) -> Option<PathBuf> {
    let absolute = std::path::absolute(path).ok()?;
    match (absolute.parent(), absolute.file_name()) {
        (Some(parent), Some(name)) => {
            // If the folder does not exist yet, resolve the nearest existing folder above it.
            let parent = fs::canonicalize(parent).ok().or_else(|| real_path(parent))?;
            Some(parent.join(name))
        }
        (Some(_), None) => fs::canonicalize(&absolute).ok(),
        (None, _) => Some(absolute),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn last_component_is_found_in_paths_of_any_system() {
        for (path, last) in
            [("a/b.ply", "b.ply"), ("C:\\x\\y\\", "y"), ("/a/b//", "b"), ("plain", "plain"), ("//", ""), ("", "")]
        {
            assert_eq!(last_component(path), last, "{path}");
        }
    }

    #[test]
    fn an_input_is_named_without_its_folders() {
        assert_eq!(name_of(Path::new("/home/someone/secret/model")), "model");
        assert_eq!(name_of(Path::new("model/")), "model");
        let here = std::env::current_dir().unwrap();
        assert_eq!(name_of(Path::new(".")), here.file_name().unwrap().to_string_lossy());
    }

    #[test]
    fn relative_path_finds_the_file() {
        let top = tempfile::tempdir().unwrap();
        let top = top.path().join("place");
        fs::create_dir_all(top.join("data")).unwrap();
        fs::write(top.join("data/cameras.json"), "here").unwrap();
        for folder in ["small", "a/b/small", "."] {
            let folder = top.join(folder);
            let named = relative_to_folder(&top.join("data/cameras.json"), &folder);
            assert!(named.is_relative(), "{named:?}");
            fs::create_dir_all(&folder).unwrap();
            assert_eq!(fs::read_to_string(folder.join(&named)).unwrap(), "here", "{named:?}");
        }
        assert_eq!(relative_to_folder(&top.join("data"), &top.join("small")), Path::new("../data"));
        assert_eq!(relative_to_folder(&top, &top), Path::new("."));
    }

    #[test]
    fn distant_file_is_named_by_its_last_name() {
        for (path, folder) in [("/secret/client/data", "/elsewhere/small"), ("/home/b/data", "/home/a/small")] {
            assert_eq!(relative_to_folder(Path::new(path), Path::new(folder)), Path::new("data"));
        }
    }
}
