//! 4DGaussians model folders as a model format: canonical Gaussians and a deformation field that moves them.
//!
//! The output is a folder of the same layout with a smaller point cloud file. The configuration is copied byte for
//! byte, except for the SH degree if that is lowered. The field is copied too, or written in half precision with the
//! same tensor names and shapes.

mod config;
mod model_folder;
mod proxies;
mod small_field;

use std::fs;
use std::path::{Path, PathBuf};

use super::archive::files::{CFG_ARGS, ITERATION, add_cloud};
use super::cfg_args;
use super::files::copy;
use super::size::{ModelSize, NO_FILES, bytes_below, file_bytes};
use super::trajectories::{state_bytes, write_sequence};
use crate::archive::{ArchiveContent, TensorRole};
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::deform::{Field, FieldConfig, Tensor, Tensors};
use crate::error::{Error, Result, ShowPath};
use crate::files::ply::Ply;
use crate::files::ply::write::{rows_of_model, write_like_template};
use crate::files::state_dict::{StoredTensor, TensorValues, is_floating, read_state_dict, write_state_dict};
use crate::limits::Limits;
use crate::model::{Attributes, Gaussians, Jacobian};
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription, TimeOrigin};
use crate::models::motion_model::compressed_raw;
use crate::models::opened::{InputFormat, Opened};
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::{FieldPrecision, MergeParams};
use crate::source::{Deformation, FrameSource};
pub use model_folder::ModelFolder;

/// Model format of 4DGaussians: recognizes and opens a model folder.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| found.is_folder && found.path.join("point_cloud").is_dir(),
    open: |path, options| Ok(Opened::from_model(ModelFolder::open_with(path, options.iteration, &options.ply())?)),
};

impl InputModel for ModelFolder {
    fn description(&self) -> ModelDescription {
        let deforms_colors = self.field().deformed_attributes().contains(Attributes::SH);
        ModelDescription {
            kind: "4DGaussians model",
            notes: self.notes().to_vec(),
            timing: TimeOrigin::Continuous,
            data_folder: self.config().source_path.clone(),
            background: self.config().white_background.then_some([1.0; 3]),
            default_output_kind: OutputKind::Model,
            reason_to_keep_sh_degree: deforms_colors
                .then_some("the SH head of the deformation field adds to coefficients of every degree"),
            ..ModelDescription::default()
        }
    }

    fn source(&self) -> &dyn FrameSource {
        self
    }

    fn digest(&self) -> Result<String> {
        self.paths().digest()
    }

    /// Returns the size in bytes of the files that a renderer opens: the point cloud file, the deformation field and
    /// `cfg_args`. Does not count `deformation_table.pth` and `deformation_accum.pth`: no renderer needs them, and no
    /// output has them.
    fn size(&self) -> Result<ModelSize> {
        let paths = self.paths();
        size_of(&paths.point_cloud, &paths.deformation, &paths.cfg_args)
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind {
            OutputKind::Model => {
                let folder = iteration_folder(path, self.paths().iteration);
                size_of(&folder.join("point_cloud.ply"), &folder.join("deformation.pth"), &path.join("cfg_args"))
            }
            OutputKind::Ply => ModelSize::from_cloud_file(path, NO_FILES),
            // All other outputs are written from the states at the frames. The caller measures an archive itself.
            _ => Ok(ModelSize::from_frames(bytes_below(path)?)),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        let whole = state_bytes(self.info().sh_degree, Attributes::all());
        MemoryProfile {
            per_gaussian: whole,
            // Besides its attributes, a Gaussian has normals and other extra properties in the file: about 24 bytes.
            opening: whole + 24,
            // A copy of the canonical values, the values prepared from them, and the field's deltas.
            reader: 2 * whole + self.field().bytes_per_gaussian() as u64 + 128,
            // The canonical values of the compressed model, and a copy while they are computed.
            compressed: 2 * whole,
            jacobian: Jacobian::BYTES_PER_GAUSSIAN as u64,
            prepared: self.field().bytes_per_gaussian_with_slopes() as u64,
            file: whole + 24,
            // Two copies of the field's tensors: as read from the file, and as used.
            fixed: 2 * self.tensor_bytes(),
            gaussian_block: GAUSSIAN_BLOCK as u64,
            // Seconds measured by `benches/deform.rs`, as a function of the size of the network.
            seconds_per_state: 1e-7 + 2e-11 * self.field().multiplications() as f64,
            ..MemoryProfile::default()
        }
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        Ok(Box::new(ModelFolder::with_times(*self, times)?))
    }

    fn canonical(&self) -> Option<&Gaussians> {
        Some(ModelFolder::canonical(self))
    }

    fn motion_note(&self, kind: OutputKind) -> Option<&'static str> {
        let leaves_out = kind == OutputKind::Ply && self.info().times.len() != 1;
        leaves_out.then_some("a .ply holds the Gaussians of the model without its motion")
    }

    fn check_output(&self, _: OutputKind, _: &Path) -> Result<()> {
        Ok(())
    }

    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        proxies::compute_proxies(self, clusters, reference, rule)
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        let paths = self.paths();
        if !self.can_round_field()? {
            return Err(Error::usage(format!(
                "{}: some tensors are not 32-bit or 16-bit floating-point numbers, and an archive holds only these\n  \
                 write a model folder instead",
                paths.deformation.shown()
            )));
        }
        let tensors = read_state_dict(&paths.deformation, self.memory())?;
        let role = |(name, tensor): (&String, &Tensor)| {
            let role = match role(self.config().field(), name) {
                // The field does not read the tensor as a feature plane, because its shape is not that of one.
                TensorRole::Plane(_) | TensorRole::TimePlane(_) if !matches!(tensor.shape[..], [1, _, _, _]) => {
                    TensorRole::Exact
                }
                role => role,
            };
            (name.clone(), role)
        };
        let first = self.info().times.first().copied().unwrap_or(0.0).min(0.0);
        let last = self.info().times.last().copied().unwrap_or(1.0).max(1.0);
        let cloud = compressed_raw(self.stored(), compressed).gaussians;
        let cfg_args = self.cfg_args(cloud.sh_degree())?;
        let cfg_args = cfg_args::without_folder_paths(&cfg_args, &paths.cfg_args)?.into_bytes();
        let mut content = ArchiveContent {
            cloud,
            field: tensors.iter().map(role).collect(),
            tensors,
            times: [first as f32, last as f32],
            ..ArchiveContent::default()
        };
        add_cloud(&mut content, &Ply::open(&paths.point_cloud)?, compressed.kept.iter().copied())?;
        content.files.insert(CFG_ARGS.to_owned(), cfg_args);
        content.files.insert(ITERATION.to_owned(), paths.iteration.to_string().into_bytes());
        Ok(content)
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        let field =
            Field::new(&content.tensors, self.config().field(), self.info().sh_degree, &self.paths().deformation)?;
        Ok(Box::new(self.with_canonical(content.cloud.clone()).with_field(field)))
    }

    fn compressed_frames<'a>(&'a self, compressed: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        let model = self.with_canonical(compressed_raw(self.stored(), compressed).gaussians);
        Ok(Box::new(match compressed.field {
            FieldPrecision::Exact => model,
            FieldPrecision::Half => model.rounded()?,
        }))
    }

    fn can_round_field(&self) -> Result<bool> {
        is_floating(&self.paths().deformation, self.memory())
    }

    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        let mut notes = Vec::new();
        let paths = self.paths();
        match kind {
            OutputKind::Model => {
                let folder = iteration_folder(path, paths.iteration);
                fs::create_dir_all(&folder).map_err(Error::io("create", &folder))?;
                let config = path.join("cfg_args");
                fs::write(&config, self.cfg_args(compressed.sh_degree)?).map_err(Error::io("write", &config))?;
                self.write_field(compressed.field, &folder.join("deformation.pth"))?;
                self.write_cloud(compressed, &folder.join("point_cloud.ply"))?;
                let training = [&paths.deformation_table, &paths.deformation_accum].into_iter().flatten();
                let bytes = file_bytes(training)?;
                if bytes > 0 {
                    notes.push(format!(
                        "deformation_table.pth and deformation_accum.pth ({bytes} bytes, read by training only) were \
                         not copied; sizes do not include them"
                    ));
                }
            }
            OutputKind::Ply if self.motion_note(kind).is_some() => self.write_cloud(compressed, path)?,
            OutputKind::Archive => {
                return Err(Error::internal("an archive is written from its content, not by the model"));
            }
            _ => notes.extend(write_sequence(
                &*self.compressed_frames(compressed)?,
                kind,
                path,
                limits.max_kept_frames,
                events,
            )?),
        }
        Ok(notes)
    }
}

impl ModelFolder {
    /// Returns the text of the input's `cfg_args` file, in which an SH degree higher than `sh_degree` is replaced by
    /// `sh_degree`.
    fn cfg_args(&self, sh_degree: usize) -> Result<String> {
        cfg_args::read_for_degree(&self.paths().cfg_args, self.info().sh_degree, sh_degree)
    }

    /// Writes the tensors of the deformation field as a state dict with the given precision to `path`.
    fn write_field(&self, precision: FieldPrecision, path: &Path) -> Result<()> {
        let own = &self.paths().deformation;
        match precision {
            FieldPrecision::Exact => copy(own, path),
            FieldPrecision::Half => {
                let from_zero = self.info().times.iter().all(|&time| time >= 0.0);
                write_state_dict(path, &small_field::stored(&read_state_dict(own, self.memory())?, from_zero))
            }
        }
    }

    /// Writes the Gaussians of the compressed model to the PLY file `path`, with the properties and comments of the
    /// input's point cloud file.
    fn write_cloud(&self, compressed: &CompressedModel, path: &Path) -> Result<()> {
        let none = Gaussians::zeros(0, self.info().sh_degree);
        let proxies = compressed.proxies.raw.as_ref().map_or(&none, |raw| &raw.gaussians);
        let template = Ply::open(&self.paths().point_cloud)?;
        write_like_template(
            &template,
            &rows_of_model(compressed),
            proxies,
            &compressed.delta,
            compressed.sh_degree,
            path,
        )
    }
}

/// Returns the path of the folder in which the model folder `root` stores the files of training iteration `iteration`.
pub(super) fn iteration_folder(root: &Path, iteration: u32) -> PathBuf {
    root.join("point_cloud").join(format!("iteration_{iteration}"))
}

/// Returns the size in bytes of a model, divided into its three files: the point cloud, the deformation field and the
/// configuration.
fn size_of(cloud: &Path, field: &Path, configuration: &Path) -> Result<ModelSize> {
    Ok(ModelSize { field: file_bytes([field])?, ..ModelSize::from_cloud_file(cloud, [configuration])? })
}

/// Returns the role of the tensor called `name` in the deformation field, by which an archive chooses how to store it:
/// feature plane, weights of a layer, exact values, or unused.
fn role(config: FieldConfig, name: &str) -> TensorRole {
    let Some(name) = name.strip_prefix("deformation_net.") else { return TensorRole::Unread };
    let part = name.split('.').next().unwrap_or_default();
    let reads = |is_read: bool, role_if_read: TensorRole| if is_read { role_if_read } else { TensorRole::Unread };
    match part {
        "grid" if config.no_grid => TensorRole::Unread,
        "grid" => match name.rsplit('.').next() {
            Some("0") => TensorRole::Plane([0, 1]),
            Some("1") => TensorRole::Plane([0, 2]),
            Some("2") => TensorRole::TimePlane(0),
            Some("3") => TensorRole::Plane([1, 2]),
            Some("4") => TensorRole::TimePlane(1),
            Some("5") => TensorRole::TimePlane(2),
            _ => TensorRole::Exact,
        },
        "feature_out" => TensorRole::Weights,
        "pos_deform" => reads(config.deformed_attributes.contains(Attributes::POSITION), TensorRole::Weights),
        "scales_deform" => reads(config.deformed_attributes.contains(Attributes::LOG_SCALE), TensorRole::Weights),
        "rotations_deform" => reads(config.deformed_attributes.contains(Attributes::ROTATION), TensorRole::Weights),
        "opacity_deform" => reads(config.deformed_attributes.contains(Attributes::OPACITY), TensorRole::Weights),
        "shs_deform" => reads(config.deformed_attributes.contains(Attributes::SH), TensorRole::Weights),
        "static_mlp" => reads(config.static_mlp, TensorRole::Weights),
        "empty_voxel" => reads(config.empty_voxel, TensorRole::Exact),
        // The tensor belongs to an unknown version of the trainer.
        _ => TensorRole::Exact,
    }
}

/// Writes the tensors of a deformation field as a state dict in single precision to `path`.
pub(super) fn write_field(tensors: &Tensors, path: &Path) -> Result<()> {
    let stored = tensors.iter().map(|(name, tensor)| {
        StoredTensor::dense(name.clone(), tensor.shape.clone(), TensorValues::F32(tensor.data.clone()))
    });
    write_state_dict(path, &stored.collect::<Vec<_>>())
}
