//! A 4DGaussians model folder as a sequence of frames.
//!
//! Input: `cfg_args`, `point_cloud/iteration_K/{point_cloud.ply, deformation.pth}`, frame times. Output: states of any
//! Gaussians at any frame. Memory: the canonical Gaussians (44 + 12·(d+1)² bytes per Gaussian at SH degree d) and the
//! tensors of the field. Each open reader takes in addition [`Field::bytes_per_gaussian`] per Gaussian and, if it reads
//! only some Gaussians, a copy of their canonical values. [`Deformation::with_params`] takes
//! [`Field::bytes_per_gaussian_with_slopes`] per Gaussian.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::deform::{Deltas, Field, LayerBuffers, PreparedPositions};
use crate::error::{Error, Result};
use crate::limits::ReadLimit;
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, SequenceInfo, StoredParams};
use crate::passes::{BlockSlices, BlockwiseReader, GAUSSIANS_PER_BLOCK};
use crate::source::{
    BlockReader, Deformation, FrameSource, Ids, PreparedDeformation, ReadCounts, ReadPlan, SharedCounter,
};
use rayon::prelude::*;

use super::config::ModelConfig;
use super::small_field::rounded;
use crate::files::digest::digest_of_files;
use crate::files::ply::{Ply, PlyOptions};
use crate::files::state_dict::{read_state_dict, read_state_dict_with_note};
use crate::models::iterations::find_iteration;

/// Paths of the files of a model folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelPaths {
    /// Path of the model folder.
    pub root: PathBuf,
    /// Training iteration K of the folder `iteration_K`.
    pub iteration: u32,
    /// Path of `<root>/cfg_args`.
    pub cfg_args: PathBuf,
    /// Path of the point cloud file, which holds the canonical Gaussians.
    pub point_cloud: PathBuf,
    /// Path of the state dict (tensors by name) of the deformation field.
    pub deformation: PathBuf,
    /// Path of `deformation_table.pth`, if it exists.
    pub deformation_table: Option<PathBuf>,
    /// Path of `deformation_accum.pth`, if it exists.
    pub deformation_accum: Option<PathBuf>,
}

impl ModelPaths {
    /// Finds the files of the model folder `root` that belong to the training iteration `iteration`; `None` selects the
    /// largest iteration.
    ///
    /// # Errors
    /// Fails if a folder or a required file is missing.
    pub fn locate(root: &Path, iteration: Option<u32>) -> Result<Self> {
        let clouds = root.join("point_cloud");
        let (iteration, folder) = find_iteration(&clouds, iteration)?;
        let optional = |name: &str| Some(folder.join(name)).filter(|path| path.exists());
        let paths = ModelPaths {
            root: root.to_owned(),
            iteration,
            cfg_args: root.join("cfg_args"),
            point_cloud: folder.join("point_cloud.ply"),
            deformation: folder.join("deformation.pth"),
            deformation_table: optional("deformation_table.pth"),
            deformation_accum: optional("deformation_accum.pth"),
        };
        for path in paths.required() {
            if !path.is_file() {
                return Err(Error::input(path, "", "this file of the model folder", "no such file")
                    .hint("a 4DGaussians model folder holds cfg_args and point_cloud/iteration_K/{point_cloud.ply, deformation.pth}"));
            }
        }
        Ok(paths)
    }

    /// Returns the paths of the point cloud file, the deformation file and `cfg_args`, in the order in which
    /// [`ModelPaths::digest`] reads them.
    fn required(&self) -> [&Path; 3] {
        [&self.point_cloud, &self.deformation, &self.cfg_args]
    }

    /// Returns the xxh3-128 hash of the bytes of the point cloud file, the deformation file and `cfg_args`, as 32 hex
    /// digits.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    pub fn digest(&self) -> Result<String> {
        digest_of_files(self.required())
    }
}

/// Trained 4DGaussians model: canonical Gaussians and the field that deforms them.
///
/// The model is continuous in time; [`ModelFolder::with_times`] sets the times of its frames.
#[derive(Debug, Clone)]
pub struct ModelFolder {
    paths: ModelPaths,
    config: ModelConfig,
    canonical: Arc<StoredParams>,
    field: Arc<Field>,
    tensor_bytes: u64,
    info: SequenceInfo,
    states: SharedCounter,
    notes: Vec<String>,
    memory: ReadLimit,
}

impl ModelFolder {
    /// Reads the configuration and the deformation field of the model at `paths`, using at most `memory`. `canonical`
    /// holds its Gaussians, with SH degree `sh_degree`. The returned model has no frames yet.
    ///
    /// # Errors
    /// Fails if a file cannot be read, contradicts another, or needs more than `memory`.
    pub fn with_gaussians(
        paths: ModelPaths,
        canonical: Gaussians,
        sh_degree: usize,
        memory: ReadLimit,
    ) -> Result<Self> {
        let config = ModelConfig::read(&paths.cfg_args)?;
        let (tensors, prefix_note) = read_state_dict_with_note(&paths.deformation, memory)?;
        let mut notes = config.contradicted_by(&tensors);
        notes.extend(prefix_note);
        let values = tensors.values().map(|tensor| tensor.data.len()).sum::<usize>();
        let tensor_bytes = (values * size_of::<f32>()) as u64;
        let field = Field::new(&tensors, config.field(), sh_degree, &paths.deformation)?;
        let info =
            SequenceInfo { count: canonical.len(), times: Vec::new(), sh_degree, varying: field.deformed_attributes() };
        let (canonical, field, states) = (Arc::new(canonical.into()), Arc::new(field), SharedCounter::default());
        Ok(ModelFolder { paths, config, canonical, field, tensor_bytes, info, states, notes, memory })
    }

    /// Returns notes on contradictions between `cfg_args` and the weights of the deformation field.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Opens the model folder `root` at the training iteration `iteration`; `None` selects the largest iteration. The
    /// returned model has no frames yet.
    ///
    /// # Errors
    /// Fails if a file is missing or damaged.
    pub fn open(root: &Path, iteration: Option<u32>) -> Result<Self> {
        Self::open_with(root, iteration, &PlyOptions::default())
    }

    /// Opens a model like [`ModelFolder::open`], within the memory limit of `options`.
    pub fn open_with(root: &Path, iteration: Option<u32>, options: &PlyOptions) -> Result<Self> {
        let paths = ModelPaths::locate(root, iteration)?;
        let ply = Ply::open_with(&paths.point_cloud, options)?;
        let whole = ply.whole()?;
        let ply_notes = ply.notes_with(&whole);
        let mut model = Self::with_gaussians(paths, whole, ply.sh_degree(), options.memory)?;
        model.notes.extend(ply_notes);
        Ok(model)
    }

    /// Returns the maximum memory that may be used when files of the model are read again.
    pub(super) fn memory(&self) -> ReadLimit {
        self.memory
    }

    /// Returns a model with the same deformation field and frames, but with the Gaussians `canonical`. Their SH degree
    /// may differ only if the field does not deform color.
    pub fn with_canonical(&self, canonical: Gaussians) -> Self {
        let (count, sh_degree) = (canonical.len(), canonical.sh_degree());
        let info = SequenceInfo { count, sh_degree, ..self.info.clone() };
        ModelFolder { canonical: Arc::new(canonical.into()), info, ..self.clone() }
    }

    /// Returns the model with the deformation field that results from storing the field in half precision and reading
    /// it back.
    ///
    /// # Errors
    /// Fails if the file of the field can no longer be read.
    pub(super) fn rounded(self) -> Result<Self> {
        let (path, degree) = (&self.paths.deformation, self.info.sh_degree);
        let field = Field::new(&rounded(read_state_dict(path, self.memory)?), self.config.field(), degree, path)?;
        Ok(ModelFolder { field: Arc::new(field), ..self })
    }

    /// Returns the model with another deformation field of the same configuration.
    pub fn with_field(self, field: Field) -> Self {
        ModelFolder { field: Arc::new(field), ..self }
    }

    /// Returns the model with frames at `times`.
    ///
    /// # Errors
    /// Fails if times are not finite or not strictly increasing; the message names the frames.
    pub fn with_times(mut self, times: Vec<f64>) -> Result<Self> {
        self.info = self.info.with_frames_at(times)?;
        Ok(self)
    }

    /// Returns the paths of the model's files.
    pub fn paths(&self) -> &ModelPaths {
        &self.paths
    }

    /// Returns the hyperparameters of the model.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Returns the stored parameters of every Gaussian, before any deformation.
    pub fn canonical(&self) -> &Gaussians {
        &self.canonical.gaussians
    }

    /// Returns the deformation field.
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// Returns the number of bytes that the tensors of the deformation field take in single precision.
    pub(super) fn tensor_bytes(&self) -> u64 {
        self.tensor_bytes
    }

    /// Returns the time of frame `frame`; fails if the frame does not exist.
    fn frame_time(&self, frame: usize) -> Result<f64> {
        let times = &self.info.times;
        let missing = || Error::internal(format!("frame {frame} was asked for; the sequence has {}", times.len()));
        times.get(frame).copied().ok_or_else(missing)
    }

    /// Returns the changes (deltas) that the deformation field makes at `time` to Gaussians at the canonical positions
    /// `position` `[N, 3]`. These Gaussians need not belong to this model. From the deltas, [`Deltas::invert`] computes
    /// the stored parameters that lead to a desired state.
    ///
    /// # Errors
    /// Fails if the field cannot be evaluated.
    pub fn deltas_at(&self, position: &AttributeValues, time: f64) -> Result<Deltas> {
        let prepared = self.field.prepare(position);
        let mut deltas = Deltas::new(self.info.sh_degree);
        self.field.deltas(&prepared, time, Attributes::all(), &mut LayerBuffers::default(), &mut deltas)?;
        Ok(deltas)
    }
}

impl FrameSource for ModelFolder {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let count = self.info.count;
        if let Some(id) = ids.iter().find(|&id| id >= count) {
            return Err(Error::internal(format!("Gaussian {id} was asked for; the model has {count}")));
        }
        let mut raw = Gaussians::zeros(ids.len(), self.info.sh_degree);
        for column in Attributes::all().iter() {
            let (from, to) = (self.canonical().attribute_values(column), raw.attribute_values_mut(column));
            for c in 0..from.width() {
                let plane = from.plane(c);
                to.plane_mut(c).iter_mut().zip(ids.iter()).for_each(|(to, id)| *to = plane[id]);
            }
        }
        Ok(Box::new(FieldReader {
            model: self,
            prepared: self.field.prepare(&raw.position),
            raw,
            scratch: LayerBuffers::default(),
            deltas: Deltas::new(self.info.sh_degree),
        }))
    }

    /// Returns a reader of all Gaussians that computes them block by block. For several frames, it keeps the
    /// time-independent results of the field for all Gaussians; for one frame, it keeps nothing.
    fn open_all(&self, plan: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        Some(Ok(match plan.has_at_most_one_frame() {
            true => Box::new(BlockwiseReader::new(self)),
            false => Box::new(PreparedModel::new(self, &self.canonical, Field::prepare)),
        }))
    }

    fn deformation(&self) -> Option<&dyn Deformation> {
        Some(self)
    }

    fn reads(&self) -> ReadCounts {
        ReadCounts { states: self.states.get(), ..ReadCounts::default() }
    }
}

impl Deformation for ModelFolder {
    fn stored(&self) -> &StoredParams {
        &self.canonical
    }

    /// Returns the attributes that the optimizer can change. Excludes positions if the field has a mask (factor on the
    /// stored attributes of each Gaussian). Derivatives treat the mask as constant, so a step along them would make
    /// positions worse.
    fn movable(&self) -> Attributes {
        if self.field.has_mask() { Attributes::all().difference(Attributes::POSITION) } else { Attributes::all() }
    }

    fn with_params<'a>(&'a self, stored: &'a StoredParams) -> Box<dyn PreparedDeformation + 'a> {
        Box::new(PreparedModel::new(self, stored, Field::prepare_with_slopes))
    }
}

/// Gaussians with given stored parameters, deformed by the field of a 4DGaussians model. Their states are computed a
/// block of Gaussians at a time.
struct PreparedModel<'a> {
    model: &'a ModelFolder,
    stored: &'a StoredParams,
    /// Indices of all Gaussians.
    ids: Vec<u32>,
    /// Values that the field computes from positions alone and that serve all frames; one entry for each block of
    /// [`GAUSSIANS_PER_BLOCK`] Gaussians.
    prepared: Vec<PreparedPositions>,
}

impl<'a> PreparedModel<'a> {
    /// Prepares the Gaussians with the stored parameters `stored` for the field of `model`. `prepare` computes the
    /// time-independent results of the field from positions.
    fn new(
        model: &'a ModelFolder,
        stored: &'a StoredParams,
        prepare: fn(&Field, &AttributeValues) -> PreparedPositions,
    ) -> Self {
        let ids: Vec<u32> = (0..stored.len() as u32).collect();
        let of_block = |ids: &[u32]| prepare(&model.field, &stored.gaussians.position.pick(ids));
        let prepared = ids.par_chunks(GAUSSIANS_PER_BLOCK).map(of_block).collect();
        PreparedModel { model, stored, ids, prepared }
    }

    /// Copies the attributes `want` of the stored parameters of the Gaussians `ids` to `raw`.
    fn copy_stored(&self, ids: &[u32], want: Attributes, raw: &mut Gaussians) {
        for column in want.iter() {
            *raw.attribute_values_mut(column) = self.stored.gaussians.attribute_values(column).pick(ids);
        }
    }
}

impl PreparedDeformation for PreparedModel<'_> {
    fn state(&self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let (field, sh_degree, time) = (&self.model.field, self.model.info.sh_degree, self.model.frame_time(frame)?);
        let nothing = || Gaussians::zeros(0, sh_degree);
        let parts = BlockSlices::split(out, want, self.ids.len());
        self.ids.par_chunks(GAUSSIANS_PER_BLOCK).zip(&self.prepared).zip(parts).try_for_each_init(
            || (nothing(), nothing(), LayerBuffers::default(), Deltas::new(sh_degree)),
            |(raw, state, scratch, deltas), ((ids, prepared), parts)| {
                self.copy_stored(ids, want | Attributes::POSITION, raw);
                field.deltas(prepared, time, want, scratch, deltas)?;
                deltas.apply(raw, want, state);
                parts.write(state, want);
                Ok::<_, Error>(())
            },
        )
    }

    fn jacobian(&self, frame: usize, want: Attributes) -> Result<Jacobian> {
        let time = self.model.frame_time(frame)?;
        let of_block = |(ids, prepared): (&[u32], &PreparedPositions)| {
            let mut raw = Gaussians::zeros(0, self.model.info.sh_degree);
            self.copy_stored(ids, want & Attributes::ROTATION | Attributes::POSITION, &mut raw);
            self.model.field.jacobian(&raw, prepared, time, want)
        };
        let blocks = self.ids.par_chunks(GAUSSIANS_PER_BLOCK).zip(&self.prepared);
        let blocks: Vec<Jacobian> = blocks.map(of_block).collect::<Result<_>>()?;
        Ok(Jacobian::joined(&blocks, self.ids.len()))
    }
}

impl BlockReader for PreparedModel<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        if !want.is_empty() {
            self.model.states.add(self.ids.len() as u64);
        }
        self.state(frame, want, out)
    }
}

/// Reader of some Gaussians of the model, frame by frame.
struct FieldReader<'a> {
    model: &'a ModelFolder,
    raw: Gaussians,
    prepared: PreparedPositions,
    scratch: LayerBuffers,
    deltas: Deltas,
}

impl BlockReader for FieldReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let time = self.model.frame_time(frame)?;
        if !want.is_empty() {
            self.model.states.add(self.raw.len() as u64);
        }
        self.model.field.deltas(&self.prepared, time, want, &mut self.scratch, &mut self.deltas)?;
        self.deltas.apply(&self.raw, want, out);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
