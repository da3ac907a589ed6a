//! Models whose Gaussians are stored in the tensors of a training checkpoint, one row per Gaussian. Several model
//! formats share this module.
//!
//! The output is the same checkpoint with fewer rows, and copies of the small files beside it.

pub(super) mod linear;
pub(super) mod rows;
pub(super) mod still;

use std::fs;
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::archive::pack::FileContent;
use super::archive::reopen::Reopener;
use super::files::copy;
use super::size::{ModelSize, bytes_below, bytes_read_for};
use super::trajectories::{check_output, state_bytes, write_sequence};
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::{Error, Result};
use crate::files::cameras::TimeConvention;
use crate::files::digest::hash_file;
use crate::files::tsog::TimedGaussians;
use crate::limits::Limits;
use crate::model::{Attributes, Jacobian, StoredParams};
use crate::models::input_model::{InputModel, MemoryProfile, TimeOrigin};
use crate::models::motion_model;
use crate::models::motion_model::{MotionModel, MotionModelFrames};
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;
use crate::outputs::time_windows::{can_store, is_windowed, write_timed};
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;
pub(super) use rows::{CheckpointReader, RowElement, RowTensors, row_count};

/// Maximum bytes of a file beside the checkpoint; larger files are not copied to the output.
const MAX_COPIED_BYTES: u64 = 1 << 20;

/// Motion model that can compute the stored parameters of proxies (Gaussians that replace merged ones).
pub(super) trait ProxyRule: MotionModel {
    /// Returns the stored parameters of one proxy (Gaussian that replaces merged ones) per cluster. The caller compares
    /// the proxies with the merged Gaussians, and may refuse them.
    ///
    /// # Errors
    /// Fails if frames cannot be evaluated.
    fn propose(model: &MotionModelFrames<Self>, clusters: &[Cluster], rule: &MergeParams) -> Result<StoredParams>
    where
        Self: Sized;

    /// Adds to `hash` the settings that determine the states of Gaussians but are not stored in the checkpoint.
    fn hash_settings(&self, hash: &mut Xxh3);

    /// Returns the motion model to use for frames at `times`; `None` if this motion model serves for all times.
    fn for_times(&self, times: &[f64]) -> Option<Self>
    where
        Self: Sized,
    {
        let _ = times;
        None
    }

    /// Returns the Gaussians `raw` in the form in which player files (`.ftgs.ply`, `.tsog`) store motion, so that no
    /// curves have to be fitted. Returns `None` if their motion does not have this form.
    fn timed(&self, raw: &StoredParams) -> Option<TimedGaussians> {
        let _ = raw;
        None
    }

    /// Returns notes for the user about the motion model; by default none.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Returns the duration of the model in its own time unit.
    fn duration(&self) -> f64 {
        1.0
    }
}

/// Properties of a model besides its Gaussians.
#[derive(Debug, Default)]
pub(super) struct ModelDescription {
    /// Name of the model format, shown to users.
    pub(super) kind: &'static str,
    /// Path of the model folder if the user gave one; `None` if the user gave the checkpoint.
    pub(super) root: Option<PathBuf>,
    /// Path of the checkpoint file.
    pub(super) file: PathBuf,
    /// Function and options with which the model was opened, to open it again from an archive; `None` if there are
    /// none.
    pub(super) reopener: Option<Reopener>,
    /// Notes for the user.
    pub(super) notes: Vec<String>,
    /// Path of the folder with the training data.
    pub(super) data_folder: Option<String>,
    /// Whether the background of the training images is white.
    pub(super) white_background: bool,
    /// CPU seconds on one core to compute the state of one Gaussian at one frame (`benches/families.rs`).
    pub(super) seconds_per_state: f64,
}

/// Opened model whose Gaussians are rows of the tensors of a checkpoint.
#[derive(Debug)]
pub(super) struct CheckpointModel<L: MotionModel> {
    tensors: RowTensors,
    model: MotionModelFrames<L>,
    description: ModelDescription,
}

impl<L: ProxyRule> CheckpointModel<L> {
    /// Creates a model from the parameters that `reader` has read. `motion_model` computes the states of the Gaussians
    /// at each frame. A model that does not vary with time gets one frame at time 0.
    pub(super) fn new(
        reader: CheckpointReader,
        motion_model: L,
        mut description: ModelDescription,
    ) -> Result<CheckpointModel<L>> {
        description.notes.extend(reader.note());
        let sh_degree = reader.raw.gaussians.sh_degree();
        let model = MotionModelFrames::new(motion_model, reader.raw, sh_degree);
        let is_still = model.motion_model().varying().is_empty();
        let model = if is_still { model.with_times(vec![0.0])? } else { model };
        Ok(CheckpointModel { tensors: reader.tensors, model, description })
    }

    /// Returns the paths of the files in the model folder that are copied to the output.
    fn copied_files(&self) -> Vec<PathBuf> {
        const NAMES: [&str; 2] = ["cfg_args", "cameras.json"];
        let Some(root) = &self.description.root else { return Vec::new() };
        let named = NAMES.iter().map(|name| root.join(name)).filter(|path| is_small(path));
        let mut found: Vec<PathBuf> = named.chain(yaml_files_in(root)).collect();
        found.sort();
        found
    }

    /// Returns the function and options with which the model was opened, to open it again from an archive. Fails if the
    /// model has none.
    fn reopener(&self) -> Result<&Reopener> {
        self.description.reopener.as_ref().ok_or_else(|| Error::internal("a model does not know how it was opened"))
    }

    /// Returns the path of the checkpoint relative to the output folder.
    fn relative_path(&self) -> PathBuf {
        let root = self.description.root.as_deref().or(self.description.file.parent()).unwrap_or(Path::new(""));
        self.description.file.strip_prefix(root).unwrap_or(&self.description.file).to_owned()
    }

    /// Writes the compressed model to `path`: the checkpoint, and copies of the files beside it.
    fn write_model(&self, compressed: &CompressedModel, path: &Path) -> Result<()> {
        for file in self.copied_files() {
            copy(&file, &path.join(file.file_name().unwrap_or_default()))?;
        }
        let to = path.join(self.relative_path());
        let folder = to.parent().unwrap_or(path);
        fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
        self.tensors.write(
            self.model.raw(),
            &motion_model::compressed_raw(self.model.raw(), compressed),
            compressed,
            &to,
        )
    }
}

impl<L: ProxyRule + 'static> InputModel for CheckpointModel<L> {
    fn kind(&self) -> &'static str {
        self.description.kind
    }

    fn source(&self) -> &dyn FrameSource {
        &self.model
    }

    fn digest(&self) -> Result<String> {
        let mut hash = Xxh3::new();
        hash_file(&self.description.file, &mut hash)?;
        self.model.motion_model().hash_settings(&mut hash);
        Ok(format!("{:032x}", hash.digest128()))
    }

    fn bytes(&self) -> Result<u64> {
        Ok(self.size()?.total())
    }

    fn size(&self) -> Result<ModelSize> {
        let rest = bytes_read_for(self.copied_files().iter().map(PathBuf::as_path))?;
        Ok(ModelSize { cloud: bytes_read_for([&*self.description.file])?, rest, ..ModelSize::default() })
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind {
            OutputKind::Model => {
                let cloud = bytes_read_for([&*path.join(self.relative_path())])?;
                Ok(ModelSize { cloud, rest: bytes_below(path)?.saturating_sub(cloud), ..ModelSize::default() })
            }
            _ => Ok(ModelSize::from_frames(bytes_below(path)?)),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        let raw = self.model.raw();
        let whole = state_bytes(raw.gaussians.sh_degree(), Attributes::all()) + 4 * raw.format_specific.width() as u64;
        MemoryProfile {
            per_gaussian: whole,
            // The widest tensor, both as stored and as f32.
            opening: 2 * whole,
            // A copy of the stored parameters and the values prepared from them.
            reader: whole + 128,
            compressed: 2 * whole,
            jacobian: Jacobian::BYTES_PER_GAUSSIAN as u64,
            // The training stores two optimizer values per parameter in addition.
            file: 3 * whole,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            seconds_per_state: self.description.seconds_per_state,
            ..MemoryProfile::default()
        }
    }

    fn timing(&self) -> TimeOrigin {
        if self.model.motion_model().varying().is_empty() { TimeOrigin::Numbered } else { TimeOrigin::Continuous }
    }

    fn time_convention(&self) -> TimeConvention {
        TimeConvention::Given
    }

    fn duration(&self) -> f64 {
        self.model.motion_model().duration()
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        let CheckpointModel { tensors, model, description } = *self;
        let found = model.info().times.len();
        if !model.info().times.is_empty() && model.motion_model().varying().is_empty() && times.len() != found {
            return Err(Error::usage(format!("{} times were given for {found} frames", times.len())));
        }
        let model = match model.motion_model().for_times(&times) {
            Some(motion_model) => MotionModelFrames::new(motion_model, model.raw().clone(), model.info().sh_degree),
            None => model,
        };
        Ok(Box::new(CheckpointModel { tensors, model: model.with_times(times)?, description }))
    }

    fn notes(&self) -> Vec<String> {
        self.description.notes.iter().cloned().chain(self.model.motion_model().notes()).collect()
    }

    fn data_folder(&self) -> Option<&str> {
        self.description.data_folder.as_deref()
    }

    fn background(&self) -> Option<[f32; 3]> {
        self.description.white_background.then_some([1.0; 3])
    }

    fn default_output_kind(&self) -> OutputKind {
        OutputKind::Model
    }

    fn check_output(&self, kind: OutputKind, path: &Path) -> Result<()> {
        match kind {
            OutputKind::Model | OutputKind::Archive => Ok(()),
            _ => check_output(self.model.info().times.len(), kind, path),
        }
    }

    fn reason_to_keep_sh_degree(&self) -> Option<&'static str> {
        Some("loaders of the checkpoint expect coefficients of every degree")
    }

    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        motion_model::propose_proxies(&self.model, clusters, reference, rule, |clusters| {
            L::propose(&self.model, clusters, rule)
        })
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        let checkpoint = self.relative_path();
        self.reopener()?.content(self, compressed, (self.default_output_kind(), "model"), |name| {
            match Path::new(name) == checkpoint {
                true => FileContent::Checkpoint(&self.tensors),
                false => FileContent::Other,
            }
        })
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.reopener()?.frames(content, &self.model.info().times)
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
        if kind == OutputKind::Model {
            return self.write_model(compressed, path).map(|()| Vec::new());
        }
        write_frames(&self.model, compressed, kind, path, limits.max_kept_frames, events)
    }
}

/// Writes the compressed model `compressed` of `model` to `path` as `kind`, any kind of output except
/// [`OutputKind::Model`]. Returns notes for the user. What is written depends on `kind`:
/// - A player format that can store the motion of the model: the motion.
/// - Any other format: the states of the Gaussians at every frame. At most `max_kept_frames` frames are kept in memory.
///
/// # Errors
/// Fails if the format cannot hold the values or the file cannot be written.
pub(super) fn write_frames<L: ProxyRule>(
    model: &MotionModelFrames<L>,
    compressed: &CompressedModel,
    kind: OutputKind,
    path: &Path,
    max_kept_frames: usize,
    events: &Events,
) -> Result<Vec<String>> {
    match write_windowed(model, compressed, kind, path)? {
        Some(notes) => Ok(notes),
        None => write_sequence(&model.compressed_frames(compressed), kind, path, max_kept_frames, events),
    }
}

/// Writes the motion of the compressed model `compressed` of `model` to `path`, if `kind` is a player format that can
/// store this motion. Returns notes for the user. For any other `kind`, writes nothing and returns `None`; the caller
/// then writes the states at the frames instead.
///
/// # Errors
/// Fails if the format cannot hold the values or the file cannot be written.
fn write_windowed<L: ProxyRule>(
    model: &MotionModelFrames<L>,
    compressed: &CompressedModel,
    kind: OutputKind,
    path: &Path,
) -> Result<Option<Vec<String>>> {
    let raw = || motion_model::compressed_raw(model.raw(), compressed);
    let timed = if is_windowed(kind) { model.motion_model().timed(&raw()) } else { None };
    let Some(mut timed) = timed.filter(|timed| can_store(kind, timed.timeline)) else { return Ok(None) };
    timed.clip.frames = timed.clip.frames.or(Some(model.info().times.len()).filter(|&frames| frames > 0));
    write_timed(&timed, kind, path).map(Some)
}

/// Returns whether `path` is a file of at most [`MAX_COPIED_BYTES`] bytes.
fn is_small(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|found| found.is_file() && found.len() <= MAX_COPIED_BYTES)
}

/// Returns the paths of the YAML files of at most [`MAX_COPIED_BYTES`] bytes in the folder `root`, sorted by name.
pub(super) fn yaml_files_in(root: &Path) -> Vec<PathBuf> {
    let is_small_yaml = |path: &Path| {
        path.extension().is_some_and(|found| ["yaml", "yml"].iter().any(|ending| found == *ending)) && is_small(path)
    };
    let entries = fs::read_dir(root).into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(|path| is_small_yaml(path)).collect();
    found.sort();
    found
}

/// Returns the number and the path of each file in `folder` that is named `<prefix><number><suffix>`, in increasing
/// order of the numbers.
pub(super) fn numbered_files(folder: &Path, prefix: &str, suffix: &str) -> Vec<(u32, PathBuf)> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let number = |name: &str| name.strip_prefix(prefix)?.strip_suffix(suffix)?.parse::<u32>().ok();
    let mut found: Vec<(u32, PathBuf)> =
        entries.filter_map(|entry| Some((number(entry.file_name().to_str()?)?, entry.path()))).collect();
    found.sort();
    found
}
