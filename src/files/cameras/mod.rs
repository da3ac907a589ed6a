//! Cameras of a data set, from whichever file describes them, as a [`Rig`].
//!
//! | file | times | splits |
//! |---|---|---|
//! | a folder with `transforms_train.json`, `_val` and `_test`, or `transforms.json` (NeRF, D-NeRF); one of them alone | `time` | from the names |
//! | `cameras.json` of this project (`cameras_json.rs`) | `time` | `split` |
//! | `cameras.json` of a 3DGS model folder (`cameras_json.rs`) | none: every frame | all train |
//! | `poses_bounds.npy` (LLFF, DyNeRF; `llff.rs`) | i/n | camera 0 is test |
//! | `dataset.json` with `camera/` (NeRFies, HyperNeRF; `nerfies.rs`) | `warp_id` by the largest | `val_ids` are test |
//! | COLMAP's `cameras` and `images`, `.bin` or `.txt` (`colmap.rs`) | from names or a table (`times.rs`) | from folders in names |
//! | the first of several `colmap_K` with such in `sparse/0`, a folder for each frame (SpacetimeGaussians) | i/n | the first is test |
//!
//! Everything leaves in OpenCV axes, world to camera, in f64, rotations checked to be rotations.
//! Memory: one record per picture, which is checked against the limit before it is made. JSON and text are read as streams:
//! once for what lies around the pictures, and once for these.

mod assemble;
mod cameras_json;
mod colmap;
mod fields;
mod frames;
mod llff;
mod meta_json;
mod nerfies;
mod pictures;
mod times;
mod transforms;
mod virtual_rig;

#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use crate::error::ShowPath;
use crate::error::{Error, Result};
use crate::files::json::small::Small;
use crate::limits::ReadLimit;
use crate::model::Rig;

use pictures::outline;
pub use times::Times;
pub use virtual_rig::{surrounding_rig, virtual_rig};

/// Largest picture side in pixels: beyond it the width times the height of one picture nears 2³².
const MAX_SIDE_PX: u32 = 1 << 15;
/// Most pictures of a rig.
const MAX_PICTURES: usize = 1 << 24;

/// What a folder is searched for, first match wins. `transforms*.json` come before `cameras.json`
/// because a 3DGS `cameras.json` beside them has lost the times.
const NAMES: [&str; 9] = [
    "transforms_train.json",
    "transforms_test.json",
    "transforms_val.json",
    "transforms.json",
    "train_meta.json",
    "test_meta.json",
    NERFIES,
    "cameras.json",
    "poses_bounds.npy",
];
/// What NeRFies and HyperNeRF call the file that lists their pictures.
const NERFIES: &str = "dataset.json";

/// Where COLMAP puts a reconstruction inside a data set.
const COLMAP: [&str; 6] = ["sparse/0", "sparse", "cameras.bin", "cameras.txt", "images.bin", "images.txt"];

/// What the camera files may leave open.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CameraOptions {
    /// Picture (width, height) in pixels where the file names none and the picture is not there to
    /// be asked. For `poses_bounds.npy`: instead of half the recorded size.
    pub size: Option<(u32, u32)>,
    /// Frames of what does not count them, a `poses_bounds.npy` (300 if not given) and folders `colmap_K` (as many as follow
    /// one another).
    pub frames: Option<usize>,
    /// Where the times of pictures come from whose file has none.
    pub times: Times,
    /// What the times of `transforms*.json` count.
    pub clock: Clock,
    /// Memory that the cameras may take while they are read.
    pub memory: ReadLimit,
}

/// What the times of `transforms*.json` count.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Clock {
    /// Anything: they are divided by the largest, as the D-NeRF loaders do.
    #[default]
    Normalized,
    /// What the model's time counts.
    Given,
}

/// Reads the cameras of `path`: a file, or a folder holding one, recognized by its name and content.
///
/// # Errors
/// [`Error::Input`] naming the file and the picture ("frame 12" counts from 0 in file order) when a
/// value is missing, not finite, out of range, when a rotation is none, or when one view is taken
/// twice at the same time; [`Error::Usage`] when `options` are out of range.
pub fn load(path: &Path, options: &CameraOptions) -> Result<Rig> {
    check_options(options)?;
    let Some(file) = locate(path) else {
        // A path that cannot be looked at at all is the more useful thing to say.
        path.metadata().map_err(Error::io("open", path))?;
        let expected = format!("a folder with one of {}, or with COLMAP's sparse/0", NAMES.join(", "));
        return Err(Error::input(path, "", expected, "none of them"));
    };
    if is_colmap(&file) {
        return colmap::load(&file, options);
    }
    let timed = || match options.times {
        Times::Own => Ok(()),
        _ => Err(Error::usage(format!("{}: --times is for cameras without times of their own", file.shown()))),
    };
    if file.ends_with(NERFIES) {
        timed()?;
        return nerfies::load(&file, options);
    }
    if file.extension().is_some_and(|extension| extension == "npy") {
        timed()?;
        return llff::load(&file, options);
    }
    let outline = outline(&file)?;
    match kind(&outline) {
        Some(Kind::Transforms) => timed().and_then(|()| transforms::load(&file, path.is_dir(), options)),
        Some(Kind::PerPicture) => {
            timed().and_then(|()| cameras_json::load_per_picture(&file, &outline, options.memory))
        }
        Some(Kind::PerCamera(count)) => cameras_json::load_per_camera(&file, count, options),
        Some(Kind::PerFrame) => timed().and_then(|()| meta_json::load(&file, path.is_dir(), options.memory)),
        None => Err(Error::input(
            &file,
            "",
            "a list of cameras, or an object with a non-empty list \"frames\" of objects with \
             \"transform_matrix\" or \"w2c\"",
            outline.describe(),
        )),
    }
}

/// Looks for the cameras a model was trained with: `source_path` is what its configuration says.
///
/// A relative path is tried from the working folder, then from each folder above the model's, the
/// nearest first. `None` when nothing there holds cameras; never an error.
pub fn find(source_path: &str, model_folder: &Path) -> Option<PathBuf> {
    if source_path.is_empty() {
        return None;
    }
    let model_folder = std::path::absolute(model_folder).ok()?;
    let beside = model_folder.ancestors().skip(1).map(|folder| folder.join(source_path));
    std::iter::once(PathBuf::from(source_path)).chain(beside).find(|path| locate(path).is_some())
}

/// Whether the pictures of the cameras at `path` get their times from their names.
pub fn are_timed_by_name(path: &Path) -> bool {
    locate(path).is_some_and(|file| is_colmap(&file))
}

/// The camera file `path` stands for: itself, or the first known name inside the folder.
fn locate(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.to_owned());
    }
    if is_colmap(path) && path.is_dir() {
        return Some(path.to_owned());
    }
    let json_or_npy = NAMES.iter().map(|name| path.join(name)).find(|file| file.is_file());
    json_or_npy
        .or_else(|| COLMAP.iter().map(|name| path.join(name)).find(|found| found.exists()))
        .or_else(|| frames::first_in(path))
}

fn is_colmap(path: &Path) -> bool {
    COLMAP.iter().any(|name| path.ends_with(name))
}

enum Kind {
    /// NeRF: camera to world, OpenGL axes.
    Transforms,
    /// This project's: one entry per picture.
    PerPicture,
    /// 3DGS: one entry per camera, so many.
    PerCamera(usize),
    /// Dynamic3DGaussians: one list of cameras per frame.
    PerFrame,
}

fn kind(outline: &Small) -> Option<Kind> {
    if let Small::List(_, count) = outline {
        return Some(Kind::PerCamera(*count));
    }
    if meta_json::is_one(outline) {
        return Some(Kind::PerFrame);
    }
    let Small::List(first, _) = outline.get("frames")? else { return None };
    let first = first.first()?;
    if first.get("w2c").is_some() {
        Some(Kind::PerPicture)
    } else if first.get("transform_matrix").is_some() {
        Some(Kind::Transforms)
    } else {
        None
    }
}

fn check_options(options: &CameraOptions) -> Result<()> {
    let side = 1..=MAX_SIDE_PX;
    if let Some((width, height)) = options.size.filter(|(w, h)| !side.contains(w) || !side.contains(h)) {
        return Err(Error::usage(format!(
            "picture size {width}x{height}: each side must be 1 to {MAX_SIDE_PX} pixels"
        )));
    }
    if options.frames == Some(0) {
        return Err(Error::usage("frames 0: there must be at least one"));
    }
    Ok(())
}
