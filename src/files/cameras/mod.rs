//! Reads the cameras of a data set, in any supported file format, as a [`Rig`].
//!
//! | file | times | splits |
//! |---|---|---|
//! | a folder with `transforms_train.json`, `_val` and `_test`, or `transforms.json` (NeRF, D-NeRF); one of them alone | `time` | from the names |
//! | `cameras.json` of this project (`cameras_json.rs`) | `time` | `split` |
//! | `cameras.json` of a 3DGS model folder (`cameras_json.rs`) | none: every frame | all train |
//! | `poses_bounds.npy` (LLFF, DyNeRF; `llff.rs`) | i/n | camera 0 is test |
//! | `dataset.json` with `camera/` (NeRFies, HyperNeRF; `nerfies.rs`) | `warp_id` divided by the largest | `val_ids` are test |
//! | COLMAP's `cameras` and `images`, `.bin` or `.txt` (`colmap.rs`) | from names or a table (`times.rs`) | from folders in names |
//! | the first of several folders `colmap_K`, one for each frame, with a reconstruction in `sparse/0` (SpacetimeGaussians) | i/n | the first camera is test |
//!
//! "i/n" means that frame i of n frames is at time i/n.
//!
//! All cameras are returned in OpenCV axes, world to camera, in f64. Rotation matrices are checked to be rotations.
//! Memory: one record per image, and the text of a JSON file; both are checked against the memory limit for reading
//! before they are allocated. Other text files are read line by line.

mod assemble;
mod cameras_json;
mod colmap;
mod fields;
mod frames;
mod llff;
mod memory;
mod meta_json;
mod nerfies;
mod times;
mod transforms;
mod virtual_rig;

#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use crate::error::ShowPath;
use crate::error::{Error, Result};
use crate::limits::ReadLimit;
use crate::model::Rig;

use fields::{CameraFields, read_camera_text, shorten};
use memory::MemoryCounter;
pub use times::TimesSource;
pub use virtual_rig::{surrounding_rig, virtual_rig};

/// Maximum image width and height in pixels. Such an image has at most 2³⁰ pixels, so the number of pixels fits into 32
/// bits.
const MAX_SIDE_PX: u32 = 1 << 15;
/// Maximum number of images in a data set.
const MAX_IMAGES: usize = 1 << 24;

/// Names of the camera files that are searched for in a folder, in this order; the first existing one is used.
/// `transforms*.json` come before `cameras.json`, because the `cameras.json` that 3DGS writes beside them has no times.
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
/// Name of the file that lists the images of a NeRFies or HyperNeRF data set.
const NERFIES: &str = "dataset.json";

/// Paths, relative to a data set, at which a COLMAP reconstruction is searched for.
const COLMAP: [&str; 6] = ["sparse/0", "sparse", "cameras.bin", "cameras.txt", "images.bin", "images.txt"];

/// Options for reading cameras: values that are used where a camera file does not state them, and the memory limit.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CameraOptions {
    /// Image (width, height) in pixels. Its use depends on the format:
    ///
    /// - `poses_bounds.npy`, NeRFies and COLMAP: it replaces their default image size.
    /// - `transforms*.json`: it is used if the file states no size and the size of the image file cannot be read.
    /// - Other formats: it is not used, because their files state the size.
    pub size: Option<(u32, u32)>,
    /// Number of frames, for formats that do not state it: `poses_bounds.npy` (default: 300) and folders `colmap_K`
    /// (default: the number of consecutive folders).
    pub frames: Option<usize>,
    /// Source of the times of images whose camera file has none.
    pub times: TimesSource,
    /// Meaning of the times in `transforms*.json`.
    pub clock: TimeConvention,
    /// Maximum memory in bytes that reading the cameras may take.
    pub memory: ReadLimit,
}

/// Meaning of the times in `transforms*.json`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum TimeConvention {
    /// Times in any unit. They are divided by the largest time, as the loaders of D-NeRF do.
    #[default]
    Normalized,
    /// Times in the unit of the model's own time. They are used unchanged.
    Given,
}

/// Reads the cameras of the data set at `path`, which is a camera file or a folder that contains one. The format is
/// recognized by file name and content.
///
/// # Errors
/// Fails with [`Error::Input`] if a value is missing, not finite or out of range, if a matrix is not a rotation, or if
/// a view occurs twice at the same time. The message names the file and the image ("frame 12" counts from 0 in file
/// order). Fails with [`Error::Usage`] if `options` are out of range.
pub fn load(path: &Path, options: &CameraOptions) -> Result<Rig> {
    check_options(options)?;
    let Some(file) = locate(path) else {
        // If the path cannot be opened at all, report that error, which is more useful to the user.
        path.metadata().map_err(Error::io("open", path))?;
        let expected = format!("a folder with one of {}, or with COLMAP's sparse/0", NAMES.join(", "));
        return Err(Error::input(path, "", expected, "none of them"));
    };
    if is_colmap(&file) {
        return colmap::load(&file, options);
    }
    let kind = kind(&file, options.memory)?;
    if kind != Kind::PerCamera && options.times != TimesSource::Own {
        return Err(Error::usage(format!("{}: --times is for cameras without times of their own", file.shown())));
    }
    match kind {
        Kind::Nerfies => nerfies::load(&file, options),
        Kind::Llff => llff::load(&file, options),
        Kind::Transforms => transforms::load(&file, path.is_dir(), options),
        Kind::PerImage => cameras_json::load_per_image(&file, options.memory),
        Kind::PerCamera => cameras_json::load_per_camera(&file, options),
        Kind::PerFrame => meta_json::load(&file, path.is_dir(), options.memory),
    }
}

/// Searches for the data set whose cameras a model was trained with, and returns its path. `source_path` is the path of
/// the data set in the configuration of the model. If it is relative, it is tried from the working folder, then from
/// each parent folder of the model folder `model_folder`, the nearest first. The first path at which there is a camera
/// file is returned, or `None` if there is none. Never fails.
pub fn find_training_cameras(source_path: &str, model_folder: &Path) -> Option<PathBuf> {
    if source_path.is_empty() {
        return None;
    }
    let model_folder = std::path::absolute(model_folder).ok()?;
    let beside = model_folder.ancestors().skip(1).map(|folder| folder.join(source_path));
    std::iter::once(PathBuf::from(source_path)).chain(beside).find(|path| locate(path).is_some())
}

/// Returns whether there is a camera file in the folder `path`.
pub fn are_in(path: &Path) -> bool {
    locate(path).is_some()
}

/// Returns whether the data set at `path` takes the times of its images from their file names, as COLMAP data sets do.
pub fn are_timed_by_name(path: &Path) -> bool {
    locate(path).is_some_and(|file| is_colmap(&file))
}

/// Returns the file or folder from which the cameras of the data set at `path` are read. This is `path` itself if it is
/// a file or the folder of a COLMAP reconstruction. Otherwise it is the first of these that exists in the folder
/// `path`: a file of [`NAMES`], a COLMAP reconstruction, a folder `colmap_K`. Returns `None` if none exists.
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

/// Returns whether `path` ends with the name of a file or folder of a COLMAP reconstruction.
fn is_colmap(path: &Path) -> bool {
    COLMAP.iter().any(|name| path.ends_with(name))
}

/// Format of a camera file that is not a COLMAP reconstruction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// `dataset.json` of NeRFies and HyperNeRF.
    Nerfies,
    /// `poses_bounds.npy` of LLFF and DyNeRF.
    Llff,
    /// `transforms*.json` of NeRF: camera-to-world poses in OpenGL axes, one entry per image.
    Transforms,
    /// This project's `cameras.json`: one entry per image.
    PerImage,
    /// 3DGS `cameras.json`: one entry per camera.
    PerCamera,
    /// `train_meta.json` and `test_meta.json` of Dynamic3DGaussians: one list of cameras per frame.
    PerFrame,
}

/// Returns the format of the camera file `file`, recognized by its name or by the keys of its JSON text. Fails if the
/// text is not JSON or if the format is unknown. `memory` limits the memory.
fn kind(file: &Path, memory: ReadLimit) -> Result<Kind> {
    if file.ends_with(NERFIES) {
        return Ok(Kind::Nerfies);
    }
    if file.extension().is_some_and(|extension| extension == "npy") {
        return Ok(Kind::Llff);
    }
    let mut counter = MemoryCounter::new(memory);
    let text = read_camera_text(file, &mut counter)?;
    if text.trim_start().starts_with('[') {
        return Ok(Kind::PerCamera);
    }
    let fields = CameraFields::new(file, None, &text)?;
    if fields.is_list("k") && fields.is_list("w2c") {
        return Ok(Kind::PerFrame);
    }
    let images = if fields.is_list("frames") { fields.list("frames", &mut counter)? } else { Vec::new() };
    let first = images.first().map(|image| CameraFields::new(file, Some(0), image.get())).transpose()?;
    match first {
        Some(first) if first.has("w2c") => Ok(Kind::PerImage),
        Some(first) if first.has("transform_matrix") => Ok(Kind::Transforms),
        _ => {
            let expected = "a list of cameras, or an object with a non-empty list \"frames\" of objects with \
                            \"transform_matrix\" or \"w2c\"";
            Err(Error::input(file, "", expected, shorten(&text)))
        }
    }
}

/// Checks that the image size and the number of frames in `options` are in range.
fn check_options(options: &CameraOptions) -> Result<()> {
    let side = 1..=MAX_SIDE_PX;
    if let Some((width, height)) = options.size.filter(|(w, h)| !side.contains(w) || !side.contains(h)) {
        return Err(Error::usage(format!("image size {width}x{height}: each side must be 1 to {MAX_SIDE_PX} pixels")));
    }
    if options.frames == Some(0) {
        return Err(Error::usage("frames 0: there must be at least one"));
    }
    Ok(())
}
