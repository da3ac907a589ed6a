//! Error for a path that no model format recognizes: names the most similar known layout and its missing file, or lists
//! all layouts.

use std::fs;
use std::io::Read;
use std::path::Path;

use crate::error::{Error, ShowPath};
use crate::files::checkpoint::{has_legacy_magic, legacy_format};
use crate::files::names::{has_ending, shown_name};
use crate::files::open::open_file;

/// Layout of a kind of model folder: paths, relative to the folder, of the files by which it is recognized.
/// `iteration_N` stands for a folder with any number.
struct FolderLayout {
    name: &'static str,
    files: &'static [&'static str],
}

/// Known layouts of model folders, the more specific ones first.
const LAYOUTS: [FolderLayout; 6] = [
    FolderLayout {
        name: "4DGaussians model",
        files: &["cfg_args", "point_cloud/iteration_N/point_cloud.ply", "point_cloud/iteration_N/deformation.pth"],
    },
    FolderLayout {
        name: "Deformable-3D-Gaussians or SC-GS model",
        files: &["cfg_args", "point_cloud/iteration_N/point_cloud.ply", "deform/iteration_N/deform.pth"],
    },
    FolderLayout {
        name: "SpacetimeGaussians or 3D Gaussian Splatting model",
        files: &["point_cloud/iteration_N/point_cloud.ply"],
    },
    FolderLayout { name: "Dynamic3DGaussians model", files: &["params.npz"] },
    FolderLayout { name: "4D Gaussian Splatting model", files: &["chkpntN.pth"] },
    FolderLayout { name: "PLY frames", files: &["one .ply per frame, such as frame_00000.ply"] },
];

/// Names of files that belong to a data set for training and not to a model.
const DATA: [&str; 6] =
    ["transforms_train.json", "transforms.json", "poses_bounds.npy", "sparse", "dataset.json", "images"];

/// Returns the error for a folder that is no input: says what the folder looks like and what is missing, or lists all
/// layouts.
pub(super) fn unrecognized_folder(path: &Path) -> Error {
    let entries = names(path);
    let found = match entries.len() {
        0 => "an empty folder".to_owned(),
        1 => format!("a folder with {}", entries[0]),
        count => format!("a folder with {count} entries, such as {}", entries[0]),
    };
    let expected = "a trained model or frames of one";
    let error = |found: String| Error::input(path, "", expected, found);
    let is_checkpoint = |name: &&String| [".pth", ".pt"].iter().any(|ending| name.ends_with(ending));
    for file in entries.iter().filter(is_checkpoint).map(|name| path.join(name)) {
        let mut head = Vec::new();
        let read =
            open_file(&file).and_then(|open| open.take(64).read_to_end(&mut head).map_err(Error::io("read", &file)));
        if read.is_ok() && has_legacy_magic(&head) {
            return legacy_format(&file);
        }
    }
    let mut closest: Option<(&FolderLayout, Vec<&str>)> = None;
    for layout in &LAYOUTS {
        let missing: Vec<&str> = layout.files.iter().copied().filter(|file| !has(path, file)).collect();
        let is_close = missing.len() < layout.files.len();
        if is_close && closest.as_ref().is_none_or(|(_, fewest)| missing.len() < fewest.len()) {
            closest = Some((layout, missing));
        }
    }
    if let Some((layout, missing)) = closest {
        let found = format!("what looks like a {}, but {} is missing", layout.name, missing.join(" and "));
        return error(found).hint("copy the missing file into the folder, or give another folder");
    }
    let inside = entries
        .iter()
        .find(|name| LAYOUTS.iter().any(|layout| layout.files.iter().all(|file| has(&path.join(name), file))));
    if let Some(name) = inside {
        let folder = path.join(name);
        return error(found).hint(format!("a model lies one level down: give {}", folder.shown()));
    }
    if DATA.iter().any(|name| path.join(name).exists()) {
        return error("a data set: images and cameras".to_owned())
            .hint(format!("give the folder of the trained model, and this one as --cameras {}", path.shown()));
    }
    error(found).hint(layouts())
}

/// Returns the error for the file at `path`, which has none of the input formats.
pub(super) fn unrecognized_file(path: &Path) -> Error {
    let error = |found: &str| Error::input(path, "", "a model or frames in a file", found).hint(layouts());
    for ending in ["4dgs", "gsd"] {
        if has_ending(path, &format!(".{ending}")) {
            return error(&format!("a .{ending}, which this program writes but does not read"));
        }
    }
    error("a file of none of the known formats")
}

/// Returns a text with one line for each kind of input that can be read.
fn layouts() -> String {
    let folders = LAYOUTS.iter().map(|layout| format!("{}: a folder with {}", layout.name, layout.files.join(", ")));
    let files =
        "files: .gseq, .gsz, .splatv, .tsog, .ftgs.ply, .ply, .sog, .spz, .splat, .glb, params.npz, a checkpoint \
                 (.pth, .pt)"
            .to_owned();
    let lines: Vec<String> = folders.chain([files]).collect();
    format!("inputs that can be read:\n    {}", lines.join("\n    "))
}

/// Returns whether `folder` contains a file or folder that matches the pattern `file`, an entry of
/// [`FolderLayout::files`].
fn has(folder: &Path, file: &str) -> bool {
    let Some((head, rest)) = file.split_once('/') else {
        return match file {
            "chkpntN.pth" => names(folder).iter().any(|name| name.starts_with("chkpnt") && name.ends_with(".pth")),
            _ if file.contains(' ') => names(folder).iter().any(|name| name.ends_with(".ply")),
            _ => folder.join(file).exists(),
        };
    };
    match head {
        "iteration_N" => {
            names(folder).iter().filter(|name| name.starts_with("iteration_")).any(|name| has(&folder.join(name), rest))
        }
        _ => has(&folder.join(head), rest),
    }
}

/// Returns the sorted names of at most 1,000 entries of `folder`; an empty list if it cannot be read.
fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten().take(1000);
    let mut names: Vec<String> = entries.map(|entry| shown_name(&entry.path())).collect();
    names.sort();
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates empty files at the paths `files` in a new folder. Returns the error message for opening this folder as a
    /// model.
    fn message(files: &[&str]) -> String {
        let folder = tempfile::tempdir().unwrap();
        for file in files {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        unrecognized_folder(folder.path()).to_string()
    }

    #[test]
    fn the_closest_layout_and_its_missing_file_are_named() {
        let text = message(&["cfg_args", "point_cloud/iteration_7/point_cloud.ply"]);
        assert!(text.contains("3D Gaussian Splatting model"), "{text}");
        let text = message(&["cfg_args"]);
        assert!(text.contains("4DGaussians model") && text.contains("deformation.pth is missing"), "{text}");
        let text = message(&["cfg_args", "point_cloud/iteration_7/deformation.pth"]);
        assert!(text.contains("4DGaussians model") && text.contains("point_cloud.ply is missing"), "{text}");
    }

    #[test]
    fn a_data_set_is_told_from_a_model() {
        let text = message(&["transforms_train.json", "train/r_000.png"]);
        assert!(text.contains("a data set") && text.contains("--cameras"), "{text}");
    }

    #[test]
    fn a_model_one_level_down_is_found() {
        let text = message(&["output/point_cloud/iteration_7/point_cloud.ply", "notes.txt"]);
        assert!(text.contains("one level down") && text.contains("output"), "{text}");
    }

    #[test]
    fn files_that_are_only_written_are_named() {
        for name in ["a.4dgs", "a.GSD"] {
            let text = unrecognized_file(Path::new(name)).to_string();
            assert!(text.contains("writes but does not read"), "{text}");
        }
        assert!(unrecognized_file(Path::new("a.txt")).to_string().contains("none of the known formats"));
    }

    #[test]
    fn other_folders_get_the_list_of_layouts() {
        for files in [&[][..], &["thesis.txt"]] {
            let text = message(files);
            for part in ["4DGaussians model", "deformation.pth", "PLY frames", ".gseq"] {
                assert!(text.contains(part), "{part} is not in {text}");
            }
        }
    }
}
