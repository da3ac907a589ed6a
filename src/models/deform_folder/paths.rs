//! The files of a model folder with a `deform` folder in it.

use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use crate::deform::Tensors;
use crate::error::{Error, Result};
use crate::files::digest::hash_file;
use crate::files::state_dict::{is_pair, names, read_state_dict};
use crate::limits::ReadLimit;
use crate::models::iterations::numbers;

const CLOUDS: &str = "point_cloud";
const NETWORKS: &str = "deform";
const NETWORK: &str = "deform.pth";

/// The files.
#[derive(Debug, Clone)]
pub(in crate::models) struct Paths {
    pub(super) root: PathBuf,
    /// K of both folders `iteration_K`.
    pub(super) iteration: u32,
    pub(super) cfg_args: PathBuf,
    pub(super) point_cloud: PathBuf,
    /// The network's state dict.
    pub(super) network: PathBuf,
}

/// Whether a folder has a network of this kind.
pub(in crate::models) fn has_network(root: &Path) -> bool {
    iterations(&root.join(NETWORKS), NETWORK).is_ok_and(|found| !found.is_empty())
}

/// Names of the tensors of the last network of a folder; none of what cannot be read, which is for its reader to say.
pub(in crate::models) fn names_of_network(root: &Path, memory: ReadLimit) -> Vec<String> {
    let last = iterations(&root.join(NETWORKS), NETWORK).ok().and_then(|found| found.last().copied());
    last.and_then(|k| names(&Paths::new(root, k).network, memory).ok()).unwrap_or_default()
}

/// K of the folders `iteration_K` in `within` that hold `file`, increasing.
fn iterations(within: &Path, file: &str) -> Result<Vec<u32>> {
    let mut found = numbers(within)?;
    found.retain(|k| within.join(format!("iteration_{k}")).join(file).is_file());
    Ok(found)
}

impl Paths {
    /// Finds the files at `root`: of `iteration`, or of the largest that both folders have, as they were saved together.
    ///
    /// # Errors
    /// A folder or file that is missing.
    pub(super) fn locate(root: &Path, iteration: Option<u32>) -> Result<Paths> {
        let (clouds, networks) = (root.join(CLOUDS), root.join(NETWORKS));
        let (of_cloud, of_network) = (iterations(&clouds, "point_cloud.ply")?, iterations(&networks, NETWORK)?);
        let both: Vec<u32> = of_cloud.iter().copied().filter(|k| of_network.contains(k)).collect();
        let chosen = iteration.map_or(both.last().copied(), |k| both.contains(&k).then_some(k));
        let Some(k) = chosen else {
            let names = |found: &[u32]| match found {
                [] => "none".to_owned(),
                found => found.iter().map(u32::to_string).collect::<Vec<_>>().join(", "),
            };
            let wanted = iteration.map_or("iteration_<number>".to_owned(), |k| format!("iteration_{k}"));
            let found = format!("clouds of {}, networks of {}", names(&of_cloud), names(&of_network));
            return Err(Error::input(root, "", format!("{CLOUDS} and {NETWORKS} of the same {wanted}"), found));
        };
        let paths = Paths::new(root, k);
        match paths.cfg_args.is_file() {
            true => Ok(paths),
            false => Err(Error::input(&paths.cfg_args, "", "a file of the model folder", "none")
                .hint("training writes it: copy it from where the model was trained")),
        }
    }

    /// Those of training iteration `k` in `root`.
    pub(super) fn new(root: &Path, k: u32) -> Paths {
        let within = |folder: &str| root.join(folder).join(format!("iteration_{k}"));
        Paths {
            root: root.to_owned(),
            iteration: k,
            cfg_args: root.join("cfg_args"),
            point_cloud: within(CLOUDS).join("point_cloud.ply"),
            network: within(NETWORKS).join(NETWORK),
        }
    }

    /// The network's tensors.
    ///
    /// # Errors
    /// A file that is no state dict; one of Grid4D.
    pub(super) fn tensors(&self, memory: ReadLimit) -> Result<Tensors> {
        let pair = "its hash grids are not read here; write what it renders from as a PLY for each time, and give the folder of \
                    them";
        read_state_dict(&self.network, memory).map_err(|error| match is_pair(&self.network, memory) {
            true => {
                Error::input(&self.network, "", "the state dict of one network", "two, as Grid4D saves them").hint(pair)
            }
            false => error,
        })
    }

    /// xxh3-128 over the bytes of cloud, network and `cfg_args`, as 32 hex digits.
    pub(super) fn digest(&self) -> Result<String> {
        let mut hash = Xxh3::new();
        [&self.point_cloud, &self.network, &self.cfg_args]
            .into_iter()
            .try_for_each(|path| hash_file(path, &mut hash))?;
        Ok(format!("{:032x}", hash.digest128()))
    }
}
