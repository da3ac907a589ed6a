//! Families: kinds of input, each of which can be recognised, read as frames, reduced and written back.
//!
//! A family is one module here and one line of `FAMILIES`; outside its module nobody asks which one it is.

pub mod archive;
mod container;
mod dynamic_3d_gaussians;
mod family;
mod four_d_gaussians;
mod ply_sequence;
pub mod size;
pub mod stream;
pub mod trajectories;

use std::fs::{self, File};
use std::io::Read;
use std::path::Path;

pub use family::{ColumnInfo, Family, OpenOptions, Residence, Timing};
pub use four_d_gaussians::ModelFolder;
pub use size::Size;

use crate::error::{Error, Result};
use family::{Entry, Found};

/// Every family that lies in files; the first that recognises a path opens it.
const FAMILIES: [Entry; 6] = [
    four_d_gaussians::ENTRY,
    dynamic_3d_gaussians::ENTRY,
    ply_sequence::FOLDER,
    ply_sequence::FILE,
    container::ENTRY,
    archive::ENTRY,
];

/// Opens a path by what is there. Frames of a family that is continuous in time are still to be chosen.
///
/// # Errors
/// Nothing there, or of no family; whatever is wrong with it.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn Family>> {
    let is_folder = fs::metadata(path).map_err(Error::io("open", path))?.is_dir();
    let mut head = Vec::new();
    if !is_folder {
        let file = File::open(path).map_err(Error::io("open", path))?;
        file.take(16).read_to_end(&mut head).map_err(Error::io("read", path))?;
    }
    if is_folder {
        refuse_inside_a_model(path)?;
    }
    let found = Found { path, is_folder, head };
    match FAMILIES.iter().find(|entry| (entry.recognises)(&found)) {
        Some(entry) => (entry.open)(path, options),
        None => {
            let expected: Vec<&str> = FAMILIES.iter().map(|entry| entry.expected).collect();
            Err(Error::input(path, "", expected.join(", "), "another kind of file"))
        }
    }
}

/// Refuses a folder inside a model folder, naming that one.
fn refuse_inside_a_model(path: &Path) -> Result<()> {
    // A `.` has no name of its own.
    let Ok(real) = fs::canonicalize(path) else { return Ok(()) };
    let iteration = |folder: &Path| folder.file_name()?.to_str()?.strip_prefix("iteration_")?.parse::<u32>().ok();
    let is_clouds = |folder: &Path| folder.file_name().is_some_and(|name| name == "point_cloud");
    let (below, number) = match (iteration(&real), real.parent()) {
        (Some(number), Some(clouds)) if is_clouds(clouds) && real.join("deformation.pth").exists() => (2, Some(number)),
        _ if is_clouds(&real) => (1, None),
        _ => return Ok(()),
    };
    let Some(root) = real.ancestors().nth(below).filter(|root| root.join("cfg_args").exists()) else { return Ok(()) };
    let option = number.map_or_else(String::new, |number| format!(" --iteration {number}"));
    Err(Error::input(path, "", "a model folder", "a folder inside of one")
        .hint(format!("give the folder above: {}{option}", root.display())))
}
