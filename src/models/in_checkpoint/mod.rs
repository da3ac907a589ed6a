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
use super::size::{ModelSize, bytes_below};
use super::trajectories::write_sequence;
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::{Error, Result};
use crate::files::cameras::TimeConvention;
use crate::files::digest::hash_file;
use crate::files::names::shown_name;
use crate::files::tsog::TimedGaussians;
use crate::limits::Limits;
use crate::model::StoredParams;
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription, OpenOptions, TimeOrigin};
use crate::models::motion_model;
use crate::models::motion_model::{MotionModel, MotionModelFrames};
use crate::models::opened::OpenInput;
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

    /// Adds to `hash` the settings that determine the states of Gaussians but are not stored in the checkpoint; by
    /// default none.
    fn hash_settings(&self, hash: &mut Xxh3) {
        let _ = hash;
    }

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
}

/// Paths of files, each with the number in its name if it has one.
pub(super) type NumberedFiles = Vec<(Option<u32>, PathBuf)>;

/// Checkpoint that was found in a model folder or given by the user.
#[derive(Debug)]
pub(super) struct CheckpointFile {
    /// Path of the model folder if the user gave one; `None` if the user gave the checkpoint.
    pub(super) root: Option<PathBuf>,
    /// Path of the checkpoint file.
    pub(super) file: PathBuf,
    /// Function and options with which the model was opened, to open it again from an archive.
    reopener: Reopener,
    /// Note for the user if the folder has several checkpoints.
    pub(super) note: Option<String>,
}

impl CheckpointFile {
    /// Finds the checkpoint at `path`, a file or a model folder. `list` returns the checkpoints in a folder, the
    /// preferred one first, each with its training iteration if its name gives one. Chooses the iteration that `options`
    /// request, or else the first in the list. `name` is the name of such a file, with `<K>` in place of the iteration;
    /// `open` is the function that opens the model.
    ///
    /// # Errors
    /// Fails if there is no such checkpoint.
    pub(super) fn find(
        path: &Path,
        options: &OpenOptions,
        list: fn(&Path) -> NumberedFiles,
        name: &str,
        open: OpenInput,
    ) -> Result<CheckpointFile> {
        let reopener = Reopener::new(open, options);
        if !path.is_dir() {
            options.refuse_for(path)?;
            return Ok(CheckpointFile { root: None, file: path.to_owned(), reopener, note: None });
        }
        let found = list(path);
        let names = found.iter().map(|(_, file)| shown_name(file)).collect::<Vec<_>>().join(", ");
        let requested = options.iteration;
        let Some((_, file)) = found.iter().find(|(number, _)| requested.is_none() || *number == requested) else {
            let expected = requested.map_or(name.to_owned(), |k| name.replace("<K>", &k.to_string()));
            let available = if names.is_empty() { "none".to_owned() } else { names };
            return Err(Error::input(path, "", format!("a file {expected}"), available));
        };
        let note = (found.len() > 1 && requested.is_none())
            .then(|| format!("found {names}: {} is read (choose another with --iteration)", shown_name(file)));
        Ok(CheckpointFile { root: Some(path.to_owned()), file: file.clone(), reopener, note })
    }
}

/// Opened model whose Gaussians are rows of the tensors of a checkpoint.
#[derive(Debug)]
pub(super) struct CheckpointModel<L: MotionModel> {
    tensors: RowTensors,
    model: MotionModelFrames<L>,
    checkpoint: CheckpointFile,
    description: ModelDescription,
    /// CPU seconds on one core to compute the state of one Gaussian at one frame (`benches/families.rs`).
    seconds_per_state: f64,
}

impl<L: ProxyRule> CheckpointModel<L> {
    /// Creates a model from the parameters that `reader` has read. `motion_model` computes the states of the Gaussians
    /// at each frame, in `seconds_per_state` CPU seconds per state on one core. A model that does not vary with time gets
    /// one frame at time 0. `description` has the properties of the model that do not follow from the other arguments.
    pub(super) fn new(
        reader: CheckpointReader,
        motion_model: L,
        checkpoint: CheckpointFile,
        seconds_per_state: f64,
        description: ModelDescription,
    ) -> Result<CheckpointModel<L>> {
        let is_still = motion_model.varying().is_empty();
        let description = ModelDescription {
            notes: description.notes.into_iter().chain(reader.note()).collect(),
            timing: if is_still { TimeOrigin::Numbered } else { TimeOrigin::Continuous },
            time_convention: TimeConvention::Given,
            default_output_kind: OutputKind::Model,
            reason_to_keep_sh_degree: Some("loaders of the checkpoint expect coefficients of every degree"),
            ..description
        };
        let sh_degree = reader.raw.gaussians.sh_degree();
        let model = MotionModelFrames::new(motion_model, reader.raw, sh_degree);
        let model = if is_still { model.with_times(vec![0.0])? } else { model };
        Ok(CheckpointModel { tensors: reader.tensors, model, checkpoint, description, seconds_per_state })
    }

    /// Returns the paths of the files in the model folder that are copied to the output.
    fn copied_files(&self) -> Vec<PathBuf> {
        const NAMES: [&str; 2] = ["cfg_args", "cameras.json"];
        let Some(root) = &self.checkpoint.root else { return Vec::new() };
        let named = NAMES.iter().map(|name| root.join(name)).filter(|path| is_small(path));
        let mut found: Vec<PathBuf> = named.chain(yaml_files_in(root)).collect();
        found.sort();
        found
    }

    /// Returns the path of the checkpoint relative to the output folder.
    fn relative_path(&self) -> PathBuf {
        let CheckpointFile { root, file, .. } = &self.checkpoint;
        let root = root.as_deref().or(file.parent()).unwrap_or(Path::new(""));
        file.strip_prefix(root).unwrap_or(file).to_owned()
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
    fn description(&self) -> ModelDescription {
        let notes = [&self.description.notes[..], &self.model.motion_model().notes()].concat();
        ModelDescription { notes, ..self.description.clone() }
    }

    fn source(&self) -> &dyn FrameSource {
        &self.model
    }

    fn digest(&self) -> Result<String> {
        let mut hash = Xxh3::new();
        hash_file(&self.checkpoint.file, &mut hash)?;
        self.model.motion_model().hash_settings(&mut hash);
        Ok(format!("{:032x}", hash.digest128()))
    }

    fn size(&self) -> Result<ModelSize> {
        ModelSize::from_cloud_file(&self.checkpoint.file, self.copied_files())
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind {
            OutputKind::Model => ModelSize::from_folder(path, &path.join(self.relative_path())),
            _ => Ok(ModelSize::from_frames(bytes_below(path)?)),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        let profile = self.model.memory_profile(self.seconds_per_state);
        let whole = profile.per_gaussian;
        MemoryProfile {
            // The widest tensor, both as stored and as f32.
            opening: 2 * whole,
            reader: whole + 128,
            // The training stores two optimizer values per parameter in addition.
            file: 3 * whole,
            ..profile
        }
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        let model = with_times(self.model, times, self.description.timing)?;
        Ok(Box::new(CheckpointModel { model, ..*self }))
    }

    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        motion_model::propose_proxies(&self.model, clusters, reference, rule, |clusters| {
            L::propose(&self.model, clusters, rule)
        })
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        let checkpoint = self.relative_path();
        self.checkpoint.reopener.content(self, compressed, (OutputKind::Model, "model"), |name| {
            match Path::new(name) == checkpoint {
                true => FileContent::Checkpoint(&self.tensors),
                false => FileContent::Other,
            }
        })
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.checkpoint.reopener.frames(content, &self.model.info().times)
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

/// Returns `model` with frames at `times`, and with the motion model for these times. `timing` states whether the number
/// of frames is fixed.
///
/// # Errors
/// Fails if the number of frames is fixed and differs from the number of `times`, or if times do not increase.
pub(super) fn with_times<L: ProxyRule>(
    model: MotionModelFrames<L>,
    times: Vec<f64>,
    timing: TimeOrigin,
) -> Result<MotionModelFrames<L>> {
    let found = model.info().times.len();
    if timing == TimeOrigin::Numbered && times.len() != found {
        return Err(Error::usage(format!("{} times were given for {found} frames", times.len())));
    }
    let model = match model.motion_model().for_times(&times) {
        Some(motion_model) => MotionModelFrames::new(motion_model, model.raw().clone(), model.info().sh_degree),
        None => model,
    };
    model.with_times(times)
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

/// Returns the number and the path of each file in `folder` that is named `<prefix><number><suffix>`, in decreasing
/// order of the numbers.
pub(super) fn numbered_files(folder: &Path, prefix: &str, suffix: &str) -> NumberedFiles {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let number = |name: &str| name.strip_prefix(prefix)?.strip_suffix(suffix)?.parse::<u32>().ok();
    let numbered = entries.filter_map(|entry| Some((Some(number(entry.file_name().to_str()?)?), entry.path())));
    let mut found: NumberedFiles = numbered.collect();
    found.sort_unstable_by(|a, b| b.cmp(a));
    found
}
