//! Model folders with a subfolder `deform`: canonical Gaussians and a network that deforms them.
//!
//! Files: `cfg_args`, `cameras.json`, `point_cloud/iteration_K/point_cloud.ply`, `deform/iteration_K/deform.pth`. Each
//! model format implements how states follow from the network's outputs ([`NetworkMotionModel`]); reading files,
//! merging Gaussians and writing are shared. The output is a folder of the same layout with a smaller point cloud file.
//! The network is copied byte for byte, and so is the configuration, except for the SH degree if that is lowered.

mod paths;
mod proxies;
#[cfg(test)]
mod tests;

use std::fs;
use std::path::Path;

use paths::Paths;
pub(super) use paths::{has_network, needs_network, network_tensor_names};

use super::archive::pack::FileContent;
use super::archive::reopen::Reopener;
use super::cfg_args::{Arguments, read_for_degree};
use super::files::copy;
use super::size::{ModelSize, bytes_below, file_bytes};
use super::trajectories::write_sequence;
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::deform::Tensors;
use crate::error::{Error, Result};
use crate::files::cameras::TimeConvention;
use crate::files::ply::write::{rows_of_model, write_like_template};
use crate::files::ply::{Ply, PlyEncoding, read_plane};
use crate::limits::Limits;
use crate::model::{AttributeValues, Attributes, Gaussians, StoredParams};
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription, OpenOptions, TimeOrigin};
use crate::models::motion_model::{MotionModel, MotionModelFrames, propose_proxies};
use crate::models::opened::{InputFormat, Opened};
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Minimum scale of a Gaussian in scene units, so that its logarithm is finite.
pub(super) const MIN_SCALE: f64 = 1e-7;

/// Motion model that computes the states of Gaussians at a time from the outputs of a network.
pub(super) trait NetworkMotionModel: MotionModel {
    /// Name of the model format, shown to users.
    const KIND: &'static str;
    /// Whether a stored quaternion is normalized before the network's output is added to it.
    const NORMALIZES_ROTATION: bool;

    /// Returns the bytes of memory per Gaussian of the values prepared by [`MotionModel::prepare`].
    fn bytes_per_gaussian(&self) -> usize;

    /// Returns the bytes of memory that the motion model takes in addition to the network and to the values of each
    /// Gaussian.
    fn bytes(&self) -> usize {
        0
    }

    /// Returns the approximate CPU seconds on one core to compute the state of one Gaussian at one frame.
    fn seconds_per_state(&self) -> f64;
}

/// Data read from a model folder, from which a model format creates its motion model.
pub(super) struct ModelParts<'a> {
    /// Training arguments from the file `cfg_args`.
    pub(super) arguments: &'a Arguments,
    /// Tensors of the network, by name.
    pub(super) tensors: &'a Tensors,
    /// Path of the file with the network's tensors.
    pub(super) file: &'a Path,
    /// Number of features of a Gaussian (properties `fea_*` in the point cloud file).
    pub(super) features: usize,
    /// Path of the point cloud file, for error messages.
    pub(super) cloud: &'a Path,
}

/// Opened model folder with a subfolder `deform`.
pub(super) struct DeformFolder<L> {
    paths: Paths,
    model: MotionModelFrames<L>,
    tensor_bytes: u64,
    description: ModelDescription,
    reopener: Reopener,
}

impl<L: NetworkMotionModel + 'static> DeformFolder<L> {
    /// Opens the model folder `root` of the model format `format`. `make` creates the motion model from the files that
    /// were read, and returns it with notes for the user.
    ///
    /// # Errors
    /// Fails if files are missing or damaged, or if `make` refuses the model.
    pub(super) fn open(
        root: &Path,
        options: &OpenOptions,
        format: &InputFormat,
        make: impl FnOnce(&ModelParts<'_>) -> Result<(L, Vec<String>)>,
    ) -> Result<Opened> {
        let paths = Paths::locate(root, options.iteration)?;
        let arguments = Arguments::read(&paths.cfg_args)?;
        let (tensors, prefix_note) = paths.tensors(options.memory)?;
        let ply = Ply::open_with(&paths.point_cloud, &options.ply())?;
        let raw = raw(&ply)?;
        let (features, file, cloud) = (raw.format_specific.width(), &*paths.network, &*paths.point_cloud);
        let parts = ModelParts { arguments: &arguments, tensors: &tensors, file, features, cloud };
        let (motion_model, mut notes) = make(&parts)?;
        notes.extend(prefix_note);
        notes.extend(ply.notes_with(&raw.gaussians));
        let values = tensors.values().map(|tensor| tensor.data.len()).sum::<usize>();
        let description = ModelDescription {
            kind: L::KIND,
            notes,
            timing: TimeOrigin::Continuous,
            // Camera times are used unchanged, because the network was trained with them.
            time_convention: TimeConvention::Given,
            data_folder: arguments.get("source_path").string()?,
            background: arguments.get("white_background").bool(false)?.then_some([1.0; 3]),
            default_output_kind: OutputKind::Model,
            ..ModelDescription::default()
        };
        let model = MotionModelFrames::new(motion_model, raw, ply.sh_degree());
        let (tensor_bytes, reopener) = (4 * values as u64, Reopener::new(format.open, options));
        Ok(Opened::from_model(DeformFolder { paths, model, tensor_bytes, description, reopener }))
    }

    /// Returns the text of the input's `cfg_args` file, in which an SH degree higher than `sh_degree` is replaced by
    /// `sh_degree`.
    fn cfg_args(&self, sh_degree: usize) -> Result<String> {
        read_for_degree(&self.paths.cfg_args, self.model.info().sh_degree, sh_degree)
    }

    /// Writes the compressed model as a model folder at `path`.
    fn write_folder(&self, compressed: &CompressedModel, path: &Path) -> Result<()> {
        let to = Paths::new(path, self.paths.iteration);
        for file in [&to.point_cloud, &to.network] {
            let folder = file.parent().unwrap_or(path);
            fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
        }
        fs::write(&to.cfg_args, self.cfg_args(compressed.sh_degree)?).map_err(Error::io("write", &to.cfg_args))?;
        copy(&self.paths.network, &to.network)?;
        let cameras = self.paths.root.join("cameras.json");
        if cameras.is_file() {
            copy(&cameras, &path.join("cameras.json"))?;
        }
        let none = Gaussians::zeros(0, self.model.info().sh_degree);
        let proxies = compressed.proxies.raw.as_ref().map_or(&none, |raw| &raw.gaussians);
        let mut rows = rows_of_model(compressed);
        for cluster in &compressed.clusters {
            // A proxy gets the features of its member (merged Gaussian) with the largest weight.
            rows[cluster.output as usize].template_row = heaviest(cluster);
        }
        let template = Ply::open(&self.paths.point_cloud)?;
        write_like_template(&template, &rows, proxies, &compressed.delta, compressed.sh_degree, &to.point_cloud)
    }
}

/// Returns the id of the Gaussian that has the largest weight in `cluster` (Gaussians merged into one); the first such
/// Gaussian in a tie.
fn heaviest(cluster: &Cluster) -> u32 {
    let first = (cluster.leader, f64::NEG_INFINITY);
    cluster.members.iter().fold(first, |most, &member| if member.1 > most.1 { member } else { most }).0
}

/// Reads the stored parameters of all Gaussians; the properties `fea_0`, `fea_1`, … become format-specific parameters
/// ([`StoredParams::format_specific`]). Fails if a value is NaN or infinite and is an input of the network or
/// determines a covariance.
fn raw(ply: &Ply) -> Result<StoredParams> {
    let count = ply.count();
    let gaussians = ply.whole()?;
    let find = |k: usize| ply.properties().iter().find(|property| property.name == format!("fea_{k}"));
    let features: Vec<_> = (0..).map_while(find).collect();
    let mut own = AttributeValues::zeros(features.len(), count);
    let big_endian = ply.header().encoding == PlyEncoding::BigEndian;
    for (k, property) in features.into_iter().enumerate() {
        let plane = own.plane_mut(k);
        for (row, value) in plane.iter_mut().enumerate() {
            read_plane(ply.row(row), &[0], property, big_endian, std::slice::from_mut(value));
        }
    }
    // Check the parameters that the network reads or that are needed for the covariance.
    let read = [&gaussians.position, &gaussians.rotation, &gaussians.log_scale, &own];
    for (column, name) in read.into_iter().zip(["x y z", "rot", "scale", "fea"]) {
        if let Some(at) = column.planes().iter().position(|value| !value.is_finite()) {
            let (row, value) = (at % count, column.planes()[at]);
            return Err(Error::input(
                ply.path(),
                format!("Gaussian {row}, {name}"),
                "a finite number",
                value.to_string(),
            )
            .hint("remove this Gaussian from the model, or train and save it again"));
        }
    }
    Ok(StoredParams { gaussians, format_specific: own })
}

/// Returns the size in bytes of the files that a renderer opens: the point cloud file, the network and `cfg_args`.
fn size_of(paths: &Paths) -> Result<ModelSize> {
    let size = ModelSize::from_cloud_file(&paths.point_cloud, [&paths.cfg_args])?;
    Ok(ModelSize { field: file_bytes([&paths.network])?, ..size })
}

impl<L: NetworkMotionModel + 'static> InputModel for DeformFolder<L> {
    fn description(&self) -> ModelDescription {
        self.description.clone()
    }

    fn source(&self) -> &dyn FrameSource {
        &self.model
    }

    fn digest(&self) -> Result<String> {
        self.paths.digest()
    }

    fn size(&self) -> Result<ModelSize> {
        size_of(&self.paths)
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind {
            OutputKind::Model => size_of(&Paths::new(path, self.paths.iteration)),
            _ => Ok(ModelSize::from_frames(bytes_below(path)?)),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        let motion_model = self.model.motion_model();
        let profile = self.model.memory_profile(motion_model.seconds_per_state());
        let whole = profile.per_gaussian;
        MemoryProfile {
            // Besides its attributes, a Gaussian has normals and other extra properties in the file: about 24 bytes.
            opening: whole + 24,
            // A copy of the stored parameters, the values prepared from them, and the network's outputs for a block of
            // Gaussians.
            reader: 2 * whole + motion_model.bytes_per_gaussian() as u64 + 128,
            jacobian: profile.jacobian + 36,
            // Two copies of the network's tensors: as read from the file, and as used.
            fixed: 2 * self.tensor_bytes + motion_model.bytes() as u64,
            ..profile
        }
    }

    fn with_times(mut self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        self.model = self.model.with_times(times)?;
        Ok(self)
    }

    fn canonical(&self) -> Option<&Gaussians> {
        Some(&self.model.raw().gaussians)
    }

    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        propose_proxies(&self.model, clusters, reference, rule, |clusters| {
            proxies::propose(&self.model, clusters, rule)
        })
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        self.reopener.content(self, compressed, (OutputKind::Model, "model"), FileContent::from_name)
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.reopener.frames(content, &self.model.info().times)
    }

    fn compressed_frames<'a>(&'a self, compressed: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        Ok(Box::new(self.model.compressed_frames(compressed)))
    }

    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        let mut notes = match kind {
            OutputKind::Model => self.write_folder(compressed, path).map(|()| Vec::new())?,
            _ => write_sequence(&*self.compressed_frames(compressed)?, kind, path, limits.max_kept_frames, events)?,
        };
        let left = Attributes::all().difference(self.model.motion_model().movable());
        if !compressed.delta.is_empty() && !left.is_empty() {
            notes.push(
                "scales and rotations were not refined: the covariances of this model do not follow from its \
                 quaternions alone"
                    .to_owned(),
            );
        }
        Ok(notes)
    }
}
