//! Model formats: each recognizes, opens, evaluates and writes the models of one trainer.
//!
//! A model format is one module in this folder, with its entries in `INPUT_FORMATS`. Code outside its module never asks
//! which format an input has.

pub mod archive;
mod cfg_args;
mod container;
mod deform_folder;
mod deformable_3d_gaussians;
mod dynamic_3d_gaussians;
mod files;
mod foreign;
mod four_d_gaussians;
mod free_time_gs;
mod in_checkpoint;
pub(crate) mod input_model;
mod iterations;
mod linked;
pub(crate) mod motion_model;
mod native_4d_gaussians;
pub(crate) mod opened;
mod ply_sequence;
mod sc_gs;
pub mod size;
mod spacetime_gaussians;
mod static_3d_gaussians;
mod still_files;
pub mod stream;
pub mod trajectories;
mod unpacked;
mod unrecognized;
mod windowed;

use std::fs;
use std::path::Path;

pub use crate::files::splatv::rows::ZeroRotation;
pub use crate::models::input_model::{
    ColumnInfo, InputModel, LinkMode, MemoryProfile, ModelDescription, OpenOptions, TimeOrigin, TrainingConventions,
};
use cfg_args::Arguments;
pub use four_d_gaussians::ModelFolder;
pub use linked::UnlinkedFrames;
pub use opened::Opened;
pub use size::ModelSize;

use crate::error::{Error, Result, ShowPath};
use crate::files::checkpoint::{has_legacy_magic, legacy_format};
use crate::models::input_model::FoundInput;
use crate::models::opened::InputFormat;

/// Formats that are read from files. The first entry that recognizes a path opens it.
const INPUT_FORMATS: [InputFormat; 17] = [
    windowed::FTGS,
    windowed::TSOG,
    spacetime_gaussians::ENTRY,
    spacetime_gaussians::SPLATV,
    still_files::ENTRY,
    sc_gs::ENTRY,
    deformable_3d_gaussians::ENTRY,
    native_4d_gaussians::ENTRY,
    free_time_gs::ENTRY,
    foreign::ENTRY,
    static_3d_gaussians::ENTRY,
    four_d_gaussians::ENTRY,
    dynamic_3d_gaussians::ENTRY,
    ply_sequence::FOLDER,
    ply_sequence::FILE,
    container::ENTRY,
    archive::ENTRY,
];

/// Returns white if the model in the folder `cameras`, or in the folder of the file `cameras`, was trained with a white
/// background: its file `cfg_args`, which 3DGS and trainers derived from it write, has `white_background=True`. Returns
/// `None` if this key is false or missing, or if the file cannot be read.
pub fn trained_background(cameras: &Path) -> Option<[f32; 3]> {
    let folder = if cameras.is_dir() { cameras } else { cameras.parent()? };
    let arguments = Arguments::read(&folder.join("cfg_args")).ok()?;
    arguments.get("white_background").bool(false).ok()?.then_some([1.0; 3])
}

/// Opens the model, frames or container at `path`, whose format is recognized by its content. Models that are
/// continuous in time have no frames until [`InputModel::with_times`] is called. Frames that do not identify Gaussians
/// are not linked yet.
///
/// # Errors
/// Fails if the path does not exist, has no known format, or holds a damaged file.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Opened> {
    let found = FoundInput::new(path, options.memory)?;
    let is_folder = found.is_folder;
    if is_folder {
        refuse_inside_a_model(path)?;
    }
    match INPUT_FORMATS.iter().find(|format| (format.recognizes)(&found)) {
        Some(format) => (format.open)(path, options),
        None if is_folder => Err(unrecognized::unrecognized_folder(path)),
        None if has_legacy_magic(&found.head) => Err(legacy_format(path)),
        None => Err(unrecognized::unrecognized_file(path)),
    }
}

/// Fails if `path` is a folder inside a model folder; the error names the model folder.
fn refuse_inside_a_model(path: &Path) -> Result<()> {
    // A path such as `.` has no file name, so resolve it first.
    let Ok(real) = fs::canonicalize(path) else { return Ok(()) };
    let iteration = |folder: &Path| folder.file_name()?.to_str()?.strip_prefix("iteration_")?.parse::<u32>().ok();
    let is_point_cloud_folder = |folder: &Path| folder.file_name().is_some_and(|name| name == "point_cloud");
    // A PLY file in such a folder is a model by itself unless the Gaussians are deformed.
    let is_deformed_model = |folder: &Path| {
        folder.join("deformation.pth").exists()
            || spacetime_gaussians::has_marker_property(&folder.join("point_cloud.ply"))
    };
    let (levels, number) = match (iteration(&real), real.parent()) {
        (Some(number), Some(clouds)) if is_point_cloud_folder(clouds) && is_deformed_model(&real) => (2, Some(number)),
        _ if is_point_cloud_folder(&real) => (1, None),
        _ => return Ok(()),
    };
    let Some(root) = real.ancestors().nth(levels).filter(|root| root.join("cfg_args").exists()) else { return Ok(()) };
    let option = number.map_or_else(String::new, |number| format!(" --iteration {number}"));
    Err(Error::input(path, "", "a model folder", "a folder inside a model folder")
        .hint(format!("give the folder above: {}{option}", root.shown())))
}
