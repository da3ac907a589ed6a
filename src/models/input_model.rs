//! The interface that every model format implements.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::size::{ModelSize, bytes_below};
use super::trajectories::{DEFAULT_OUTPUT, NO_ARCHIVE, check_output, compressed_trajectories, write_trajectories};
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::{Error, Result, ShowPath};
use crate::files::cameras::TimeConvention;
use crate::files::open::open_file;
use crate::files::ply::PlyOptions;
use crate::files::splatv::rows::ZeroRotation;
use crate::limits::{Limits, ReadLimit};
use crate::model::{Attributes, Gaussians};
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Opened input in some model format.
///
/// The default methods suit explicit trajectories, where the state of every Gaussian is stored for every frame. Formats
/// that compute frames from stored parameters override them.
pub trait InputModel: Send + Sync {
    /// Returns the properties of the input that do not depend on single Gaussians, and notes for the user.
    fn description(&self) -> ModelDescription;

    /// Returns the source from which the attributes of the Gaussians at each frame are read.
    fn source(&self) -> &dyn FrameSource;

    /// Returns a hash of all bytes of the input that were read.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    fn digest(&self) -> Result<String>;

    /// Returns the size of all files that a renderer opens, divided into Gaussians, deformation field, frames and rest;
    /// for a stream, the number of bytes received.
    ///
    /// # Errors
    /// Fails if a file no longer exists.
    fn size(&self) -> Result<ModelSize>;

    /// Returns the total of [`InputModel::size`], bytes.
    ///
    /// # Errors
    /// Fails if a file no longer exists.
    fn bytes(&self) -> Result<u64> {
        Ok(self.size()?.total())
    }

    /// Returns the size of the output that [`InputModel::write`] wrote to `path` as `kind`, divided into Gaussians,
    /// deformation field, frames and rest. No other files may have been added to the output yet.
    ///
    /// # Errors
    /// Fails if a file no longer exists.
    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        let _ = kind;
        Ok(ModelSize::from_frames(bytes_below(path)?))
    }

    /// Returns the size in bytes of the files that frames are read from.
    ///
    /// # Errors
    /// Fails if a file no longer exists.
    fn stored_bytes(&self) -> Result<u64> {
        self.bytes()
    }

    /// Returns how much memory the open input takes, and how much time and memory reading it takes.
    fn memory_profile(&self) -> MemoryProfile;

    /// Tells the input that it may keep decoded values in memory, up to the bytes of [`MemoryProfile::decoded`].
    fn hold_decoded(&self) {}

    /// Returns the input with frames at `times`.
    ///
    /// # Errors
    /// Fails if times are not finite or do not increase, or if the input has a fixed number of frames and `times` has
    /// another number of entries. Always fails for an input whose files store the times of frames
    /// ([`TimeOrigin::Stamped`]).
    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>>;

    /// Returns the merge class of Gaussian `id`, such as foreground or background. Gaussians of different classes are
    /// never merged.
    fn merge_class(&self, id: u32) -> u8 {
        let _ = id;
        0
    }

    /// Returns the stored parameters of the Gaussians, before any motion, if all frames are computed from them; else
    /// `None`.
    fn canonical(&self) -> Option<&Gaussians> {
        None
    }

    /// Returns statistics of each column (attribute) if the input is a container; else an empty list.
    ///
    /// # Errors
    /// Fails if the index of the container cannot be read.
    fn columns(&self) -> Result<Vec<ColumnInfo>> {
        Ok(Vec::new())
    }

    /// Returns whether an output of the kind `kind` stores the motion of this model itself, in the model's own time
    /// unit, instead of frames or of motion that is fitted to frames.
    fn keeps_motion(&self, kind: OutputKind) -> bool {
        match kind {
            OutputKind::Model => true,
            OutputKind::Archive => !self.description().archives_as_frames,
            _ => false,
        }
    }

    /// Returns a note for the user if an output of the kind `kind` leaves out the motion of this model: if it stores
    /// the Gaussians before any motion, although the model has several frames.
    fn motion_note(&self, _kind: OutputKind) -> Option<&'static str> {
        None
    }

    /// Checks that this input can be written as `kind` to `path`.
    ///
    /// # Errors
    /// Fails if it cannot be written; the message lists kinds of output that work.
    fn check_output(&self, kind: OutputKind, path: &Path) -> Result<()> {
        match kind {
            OutputKind::Archive => Ok(()),
            OutputKind::Model if self.description().default_output_kind == OutputKind::Model => Ok(()),
            _ => check_output(self.source().info().times.len(), kind, path),
        }
    }

    /// Computes the stored parameters of one proxy (Gaussian that replaces merged ones) per cluster. `reference` is the
    /// frame at which proxies are compared with their members (the merged Gaussians); `rule` holds the merge
    /// parameters. By default no parameters are computed, and each proxy is computed from its members frame by frame.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        let _ = (clusters, reference, rule);
        Ok(Proxies::default())
    }

    /// Returns whether the model has a deformation field that can be written in half precision.
    ///
    /// # Errors
    /// Fails if the field can no longer be read.
    fn can_round_field(&self) -> Result<bool> {
        Ok(false)
    }

    /// Returns everything that an archive (`.gsz`) of the compressed model `compressed` stores.
    ///
    /// # Errors
    /// Fails if the input cannot be archived or its files cannot be read.
    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        let _ = compressed;
        Err(Error::usage(NO_ARCHIVE))
    }

    /// Returns the frames of the model that `content` describes, at the times of this input. `content` is the decoded
    /// content of an archive of this input, or of a compressed model of it.
    ///
    /// # Errors
    /// Fails if `content` belongs to another kind of input.
    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        let _ = content;
        Err(Error::usage(NO_ARCHIVE))
    }

    /// Returns the frames of the compressed model `compressed` as they will be read from the output.
    ///
    /// # Errors
    /// Fails if the deformation field cannot be evaluated.
    fn compressed_frames<'a>(&'a self, compressed: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        Ok(compressed_trajectories(self.source(), compressed))
    }

    /// Writes the compressed model `compressed` as the kind of output `kind` to `path`, a new file or an empty folder.
    /// Returns notes for the user. Write buffers stay within the memory of `limits`. Progress is reported to `events`.
    ///
    /// # Errors
    /// Fails if frames cannot be read or a write fails.
    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        write_trajectories(self.source(), compressed, kind, path, limits, events)
    }
}

/// Properties of an input that do not depend on single Gaussians. The defaults are those of frames in files.
#[derive(Debug, Clone)]
pub struct ModelDescription {
    /// Name of the model format, shown to users.
    pub kind: &'static str,
    /// Notes for the user, such as repairs or guesses made while opening.
    pub notes: Vec<String>,
    /// Origin of the time stamps of frames.
    pub timing: TimeOrigin,
    /// Unit of the camera times, for models whose frame times come from cameras.
    pub time_convention: TimeConvention,
    /// Duration of the model in its own time unit. It is used if no frame times are given.
    pub duration: f64,
    /// Folder of the training data, where the cameras may be found, if the input names it.
    pub data_folder: Option<String>,
    /// Number n of training frames if the input gives it. Frame i, counted from 0, lies at the fraction i/n of the time
    /// span. So the last frame is one frame interval before the end of the time span.
    pub data_frames: Option<usize>,
    /// Background color used in training if the input names it.
    pub background: Option<[f32; 3]>,
    /// Kind of output that is written if neither the user nor the output path specifies one.
    pub default_output_kind: OutputKind,
    /// Reason why SH coefficients of every degree must be kept; `None` if the SH degree may be lowered.
    pub reason_to_keep_sh_degree: Option<&'static str>,
    /// Whether the user may ask to link the frames anew, that is, to match the Gaussians of different frames, although
    /// the input already identifies each Gaussian across frames.
    pub may_be_linked: bool,
    /// Whether the state of every Gaussian is stored for every frame. Refinement may then add a delta that varies in
    /// time ([`CompressedModel::trajectory_delta`]).
    pub has_explicit_frames: bool,
    /// Whether an archive of this input holds its frames, instead of the parameters of a model. Such an archive is a
    /// container in the format `.gseq` with an error bound for each attribute.
    pub archives_as_frames: bool,
    /// Note for the user about the renders of frames that were changed when they were linked; `None` if each frame has
    /// the renders of the input.
    pub tracking_note: Option<String>,
}

impl Default for ModelDescription {
    fn default() -> ModelDescription {
        ModelDescription {
            kind: "",
            notes: Vec::new(),
            timing: TimeOrigin::Numbered,
            time_convention: TimeConvention::Normalized,
            duration: 1.0,
            data_folder: None,
            data_frames: None,
            background: None,
            default_output_kind: DEFAULT_OUTPUT,
            reason_to_keep_sh_degree: None,
            may_be_linked: false,
            has_explicit_frames: false,
            archives_as_frames: false,
            tracking_note: None,
        }
    }
}

/// Origin of the time stamps of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeOrigin {
    /// The model is continuous in time: a frame can be at any time.
    Continuous,
    /// The number of frames is fixed. The input stores no times for them; the times may come from cameras.
    Numbered,
    /// The times of the frames are stored in the input.
    Stamped,
}

/// Memory that an open input takes, and the time and memory that reading it takes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MemoryProfile {
    /// Bytes of memory per Gaussian while the input is open.
    pub per_gaussian: u64,
    /// Additional bytes of memory per Gaussian while the input is being opened.
    pub opening: u64,
    /// Bytes of memory per Gaussian of an open reader, besides the frames that it keeps in memory.
    pub reader: u64,
    /// Bytes of memory per Gaussian of a copy of the compressed model, from which its frames are read.
    pub compressed: u64,
    /// Bytes of memory per Gaussian of the derivative (Jacobian) of frame states with respect to stored parameters; 0
    /// if a change of a stored parameter changes the states by the same amount, so that no derivative is stored.
    pub jacobian: u64,
    /// Bytes of memory per Gaussian of the values that [`Deformation::with_params`] computes once for all frames; 0 if
    /// it computes none.
    ///
    /// [`Deformation::with_params`]: crate::source::Deformation::with_params
    pub prepared: u64,
    /// Bytes per Gaussian of a memory-mapped input file that is read as a whole.
    pub file: u64,
    /// Bytes of memory that the open input takes regardless of its number of Gaussians.
    pub fixed: u64,
    /// Number of frames that are decoded together; a reader may keep all of them in memory. 0 if each frame is read
    /// alone.
    pub frame_block: u64,
    /// Number of Gaussians that are decoded together, in one block.
    pub gaussian_block: u64,
    /// Number of columns (attributes) of a container.
    pub columns: u64,
    /// Approximate CPU seconds on one core to read the state of one Gaussian at one frame.
    pub seconds_per_state: f64,
    /// Bytes of memory that all decoded values of a container take together. 0 if the input has no encoded values, or
    /// cannot keep decoded ones in memory.
    pub decoded: u64,
}

impl MemoryProfile {
    /// Returns the memory profile of a container whose tiles (the units of decoding) each hold `frame_block` frames.
    pub fn for_tiles(frame_block: u64) -> MemoryProfile {
        MemoryProfile {
            reader: 8,
            frame_block,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            columns: Attributes::all().iter().count() as u64,
            // Measured decoding time of tiles that are read whole (`benches/scan.rs`).
            seconds_per_state: 5e-8,
            ..MemoryProfile::default()
        }
    }
}

/// Size and value range of one column (attribute) of a container.
#[derive(Debug, Serialize)]
pub struct ColumnInfo {
    /// Name of the column (attribute).
    pub name: String,
    /// Number of f32 components that the column (attribute) has per Gaussian.
    pub width: u32,
    /// Maximum absolute difference between decoded values and the values from which the container was made, in the unit
    /// of the column (attribute); 0 means exact to the bit.
    pub max_error: f64,
    /// Number of tiles (blocks of Gaussians × frames) into which the column (attribute) is divided.
    pub tiles: usize,
    /// Number of tiles (blocks of Gaussians × frames) that store only one frame, because their values are the same in
    /// all frames.
    pub constant_tiles: usize,
    /// Number of tiles (blocks of Gaussians × frames) that are stored without compression.
    pub raw_tiles: usize,
    /// Bytes that the column (attribute) takes in the file. Equal tiles (blocks of Gaussians × frames) may share bytes,
    /// which count once.
    pub stored_bytes: u64,
    /// Bytes that the column (attribute) would take with one f32 per frame, component and Gaussian.
    pub raw_bytes: u64,
    /// Smallest finite value of the column (attribute); `None` if it has no finite values.
    pub min: Option<f32>,
    /// Largest finite value of the column (attribute); `None` if it has no finite values.
    pub max: Option<f32>,
}

/// Number of bytes at the start of a file by which its format is recognized; enough for the header of a
/// `.compressed.ply`.
const HEAD_BYTES: u64 = 512;

/// Path that the user asked to open, with the facts by which its format is recognized.
pub(super) struct FoundInput<'a> {
    pub(super) path: &'a Path,
    pub(super) is_folder: bool,
    /// First [`HEAD_BYTES`] bytes of the file, if the path is a file.
    pub(super) head: Vec<u8>,
    /// Maximum memory that may be used to recognize the format.
    pub(super) memory: ReadLimit,
}

impl<'a> FoundInput<'a> {
    /// Reads the first bytes of `path` if it is a file. Fails if `path` does not exist or cannot be read.
    pub(super) fn new(path: &'a Path, memory: ReadLimit) -> Result<FoundInput<'a>> {
        let is_folder = fs::metadata(path).map_err(Error::io("open", path))?.is_dir();
        let mut head = Vec::new();
        if !is_folder {
            let file = open_file(path)?;
            file.take(HEAD_BYTES).read_to_end(&mut head).map_err(Error::io("read", path))?;
        }
        Ok(FoundInput { path, is_folder, head, memory })
    }

    /// Returns whether the file looks as if PyTorch's `torch.save` wrote it: a ZIP archive, but not an `.npz` of NumPy.
    pub(super) fn is_checkpoint(&self) -> bool {
        let is_npz = self.path.extension().is_some_and(|found| found.eq_ignore_ascii_case("npz"));
        !self.is_folder && self.head.starts_with(b"PK") && !is_npz
    }

    /// Returns whether the path is a file that begins with `magic` or has the extension `extension`. The extension also
    /// catches files whose first bytes are damaged.
    pub(super) fn is_file_of(&self, magic: &[u8], extension: &str) -> bool {
        let named = || self.path.extension().is_some_and(|found| found.eq_ignore_ascii_case(extension));
        !self.is_folder && (self.head.starts_with(magic) || named())
    }
}

/// Options for opening an input.
#[derive(Debug, Clone, Default)]
pub struct OpenOptions {
    /// Number K of the training iteration to open in a model folder; `None` selects the largest.
    pub iteration: Option<u32>,
    /// Whether frame numbers may be missing in a folder of frames.
    pub allow_gaps: bool,
    /// Whether frames are linked, so that the same Gaussian is found across frames.
    pub link: LinkMode,
    /// Folder for temporary files (decoded archives, linked frames) while the input is open; `None` selects the
    /// temporary folder of the system.
    pub scratch: Option<PathBuf>,
    /// Training conventions that the files of the model do not record.
    pub conventions: TrainingConventions,
    /// Maximum memory that may be used to open the input.
    pub memory: ReadLimit,
    /// Receiver of progress events while the input is opened.
    pub events: Events,
}

/// Training conventions that the files of some formats do not record, and how ambiguous values are treated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct TrainingConventions {
    /// Length of `time_duration` of 4D Gaussian Splatting, the period after which colors repeat, in the model's time
    /// unit. `None` uses the guess of the model format and adds a note.
    pub time_duration: Option<f64>,
    /// Whether the rotations of 4D Gaussian Splatting use the convention from before 15 September 2024: the order of
    /// the axes of the 4D rotation matrix is not reversed.
    pub rot4d_unflipped: bool,
    /// How Gaussians of a `.splatv` or `.ftgs.ply` with a zero quaternion are treated. `None` leaves them out, as
    /// [`ZeroRotation::Drop`] does.
    pub zero_rotation: Option<ZeroRotation>,
}

/// Whether frames are linked: whether Gaussians of successive frames are matched, to find the same Gaussian in each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LinkMode {
    /// Links frames (finds which Gaussian of a frame is which Gaussian of the next frame) only if needed. The frames of
    /// a folder are linked if they have different numbers of Gaussians, or if the same index means different Gaussians
    /// in different frames. A stream is linked if its header says that its frames share no Gaussian ids.
    #[default]
    Auto,
    /// Always links frames (matches their Gaussians): also those of containers and streams, and frames in which each
    /// index already means the same Gaussian.
    Always,
    /// Always links frames (matches their Gaussians), as [`LinkMode::Always`], but leaves the result unchanged: does
    /// not join tracks (Gaussians followed through frames) that seem to be one Gaussian, and does not make nearly
    /// constant attributes constant.
    Apart,
    /// Never links frames (matches their Gaussians): the same index is taken to mean the same Gaussian in every frame.
    Never,
}

impl LinkMode {
    /// Reason for linking frames that the user asked to link, for messages to the user.
    pub(super) const REQUESTED: &str = "as requested";

    /// Returns whether frames are linked even if the input already identifies each Gaussian across frames.
    pub fn links_frames_always(self) -> bool {
        matches!(self, LinkMode::Always | LinkMode::Apart)
    }

    /// Returns whether tracks (Gaussians followed through frames) that seem to be one Gaussian are joined.
    pub fn joins_tracks(self) -> bool {
        self != LinkMode::Apart
    }
}

impl OpenOptions {
    /// Returns the folder for temporary files.
    pub(super) fn scratch(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }

    /// Returns the options for reading the PLY files of the input.
    pub(crate) fn ply(&self) -> PlyOptions {
        PlyOptions { scratch: self.scratch(), memory: self.memory, events: self.events.clone() }
    }

    /// Fails if the user gave `--iteration`. Called for an input at `path` that is not a model folder and so has no
    /// training iterations.
    pub(super) fn refuse_for(&self, path: &Path) -> Result<()> {
        match self.iteration {
            Some(_) => Err(Error::usage(format!("{}: --iteration applies to model folders only", path.shown()))),
            None => Ok(()),
        }
    }
}
