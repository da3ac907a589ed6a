//! Paths and tensors of a model folder with a subfolder `deform`.

use std::path::{Path, PathBuf};

use crate::deform::Tensors;
use crate::error::{Error, Result};
use crate::files::digest::digest_of_files;
use crate::files::state_dict::{is_pair, names, read_state_dict_with_note};
use crate::limits::ReadLimit;
use crate::models::cfg_args::read;
use crate::models::iterations::iteration_numbers;

/// Name of the subfolder that holds the point cloud files.
const POINT_CLOUD_FOLDER: &str = "point_cloud";
/// Name of the subfolder that holds the networks.
const NETWORK_FOLDER: &str = "deform";
/// Name of the file with the network in a folder `iteration_K`.
const NETWORK_FILE: &str = "deform.pth";

/// Paths of the files of a model folder.
#[derive(Debug, Clone)]
pub(in crate::models) struct Paths {
    pub(super) root: PathBuf,
    /// Number K of the training iteration whose files are in `point_cloud/iteration_K` and `deform/iteration_K`.
    pub(super) iteration: u32,
    pub(super) cfg_args: PathBuf,
    pub(super) point_cloud: PathBuf,
    /// Path of the state dict (tensors by name) of the network.
    pub(super) network: PathBuf,
}

/// Returns whether the folder `root` contains a network in a file `deform/iteration_K/deform.pth`.
pub(in crate::models) fn has_network(root: &Path) -> bool {
    iterations(&root.join(NETWORK_FOLDER), NETWORK_FILE).is_ok_and(|found| !found.is_empty())
}

/// Returns whether the model in the folder `root` needs a network: `cfg_args` has a key that only trainers of such
/// networks write.
pub(in crate::models) fn needs_network(root: &Path) -> bool {
    let arguments = read(&root.join("cfg_args")).unwrap_or_default();
    let names_network = ["deform_type=", "is_6dof="].iter().any(|key| arguments.contains(key));
    let is_still = arguments.contains("deform_type='static'");
    root.join(POINT_CLOUD_FOLDER).is_dir() && names_network && !is_still
}

/// Returns the names of the tensors in the network of the largest iteration; empty if the file cannot be read. Opening
/// the model then reports the error.
pub(in crate::models) fn network_tensor_names(root: &Path, memory: ReadLimit) -> Vec<String> {
    let last = iterations(&root.join(NETWORK_FOLDER), NETWORK_FILE).ok().and_then(|found| found.last().copied());
    last.and_then(|k| names(&Paths::new(root, k).network, memory).ok()).unwrap_or_default()
}

/// Returns the number K of each subfolder `iteration_K` of `within` that contains `file`, in increasing order. Fails if
/// `within` cannot be listed.
fn iterations(within: &Path, file: &str) -> Result<Vec<u32>> {
    let mut found = iteration_numbers(within)?;
    found.retain(|k| within.join(format!("iteration_{k}")).join(file).is_file());
    Ok(found)
}

impl Paths {
    /// Finds the files of the model folder `root` that belong to the training iteration `iteration`. `None` selects the
    /// largest iteration that has both a point cloud file and a network.
    ///
    /// # Errors
    /// Fails if a folder or file is missing.
    pub(super) fn locate(root: &Path, iteration: Option<u32>) -> Result<Paths> {
        let (clouds, networks) = (root.join(POINT_CLOUD_FOLDER), root.join(NETWORK_FOLDER));
        if !networks.is_dir() {
            let expected = format!("this folder of the model, with iteration_K/{NETWORK_FILE}");
            return Err(Error::input(&networks, "", expected, "no such folder")
                .hint("training writes it: copy it from where the model was trained"));
        }
        let (of_cloud, of_network) = (iterations(&clouds, "point_cloud.ply")?, iterations(&networks, NETWORK_FILE)?);
        let both: Vec<u32> = of_cloud.iter().copied().filter(|k| of_network.contains(k)).collect();
        let chosen = iteration.map_or(both.last().copied(), |k| both.contains(&k).then_some(k));
        let Some(k) = chosen else {
            let names = |found: &[u32]| match found {
                [] => "none".to_owned(),
                found => found.iter().map(u32::to_string).collect::<Vec<_>>().join(", "),
            };
            let expected = iteration.map_or("iteration_<number>".to_owned(), |k| format!("iteration_{k}"));
            let found = format!(
                "point clouds of iterations {}, networks of iterations {}",
                names(&of_cloud),
                names(&of_network)
            );
            return Err(Error::input(
                root,
                "",
                format!(
                    "folders {POINT_CLOUD_FOLDER} and {NETWORK_FOLDER} with the \
                                                       same {expected}"
                ),
                found,
            ));
        };
        let paths = Paths::new(root, k);
        match paths.cfg_args.is_file() {
            true => Ok(paths),
            false => Err(Error::input(&paths.cfg_args, "", "this file of the model folder", "no such file")
                .hint("training writes it: copy it from where the model was trained")),
        }
    }

    /// Returns the paths of the files of training iteration `k` in the model folder `root`.
    pub(super) fn new(root: &Path, k: u32) -> Paths {
        let within = |folder: &str| root.join(folder).join(format!("iteration_{k}"));
        Paths {
            root: root.to_owned(),
            iteration: k,
            cfg_args: root.join("cfg_args"),
            point_cloud: within(POINT_CLOUD_FOLDER).join("point_cloud.ply"),
            network: within(NETWORK_FOLDER).join(NETWORK_FILE),
        }
    }

    /// Reads the tensors of the network, using at most `memory`. If the names of all tensors in the file have the same
    /// prefix, removes the prefix and also returns a note for the user.
    ///
    /// # Errors
    /// Fails if the file is not a state dict (tensors by name), or belongs to a Grid4D model.
    pub(super) fn tensors(&self, memory: ReadLimit) -> Result<(Tensors, Option<String>)> {
        let grid4d_hint = "hash grids are not supported: export the Gaussians of each frame as a PLY with the model's \
                           own code, and give the folder of these files";
        read_state_dict_with_note(&self.network, memory).map_err(|error| match is_pair(&self.network, memory) {
            true => Error::input(
                &self.network,
                "",
                "the state dict of one network",
                "two state dicts, as Grid4D saves \
                                                                                  them",
            )
            .hint(grid4d_hint),
            false => error,
        })
    }

    /// Returns the xxh3-128 hash of the bytes of the point cloud file, the network and `cfg_args`, as 32 hex digits.
    /// Fails if a file cannot be read.
    pub(super) fn digest(&self) -> Result<String> {
        digest_of_files([&*self.point_cloud, &*self.network, &*self.cfg_args])
    }
}
