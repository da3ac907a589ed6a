//! The interface of every model format.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::size::{Size, bytes_below};
use super::trajectories::{DEFAULT_OUTPUT, NO_ARCHIVE, check_output, reduced_trajectories, write_trajectories};
use crate::archive::Content;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, Reference};
use crate::error::{Error, Result, ShowPath};
use crate::files::cameras::Clock;
use crate::files::ply::PlyOptions;
use crate::files::splatv::rows::ZeroRotation;
use crate::limits::{Limits, ReadLimit};
use crate::model::{Attributes, Gaussians};
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Open input of some model format.
///
/// The default methods suit explicit trajectories, whose frame states are stored for every frame. Formats that derive
/// frames from raw parameters override them.
pub trait InputModel: Send + Sync {
    /// Returns the name of the model format, shown to users.
    fn kind(&self) -> &'static str;

    /// Returns the source of frame states.
    fn source(&self) -> &dyn FrameSource;

    /// Returns a hash of the bytes read.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    fn digest(&self) -> Result<String>;

    /// Returns the bytes of all files that a renderer opens; for a stream, the bytes received.
    ///
    /// # Errors
    /// Fails if a file no longer exists.
    fn bytes(&self) -> Result<u64>;

    /// Returns [`InputModel::bytes`] divided by part.
    ///
    /// # Errors
    /// Fails if a file no longer exists.
    fn size(&self) -> Result<Size> {
        Ok(Size::from_frames(self.bytes()?))
    }

    /// Returns the bytes, by part, that [`InputModel::write`] wrote to `path` as `kind`. No other files may have been
    /// added yet.
    ///
    /// # Errors
    /// Fails if a file no longer exists.
    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<Size> {
        let _ = kind;
        Ok(Size::from_frames(bytes_below(path)?))
    }

    /// Returns the bytes of the files that frames are read from.
    ///
    /// # Errors
    /// Fails if a file no longer exists.
    fn stored_bytes(&self) -> Result<u64> {
        self.bytes()
    }

    /// Returns the memory that the input takes and the costs of reading it.
    fn residence(&self) -> MemoryProfile;

    /// Allows decoded values to stay in memory if [`MemoryProfile::decoded`] is not 0.
    fn hold_decoded(&self) {}

    /// Returns how frames get their times.
    fn timing(&self) -> Timing;

    /// Returns the unit of camera times if cameras give the times of frames.
    fn clock(&self) -> Clock {
        Clock::Normalized
    }

    /// Returns the duration of the model in its own time unit. Used if no times are given.
    fn span(&self) -> f64 {
        1.0
    }

    /// Returns the input with frames at `times`. Inputs with [`Timing::Stamped`] refuse.
    ///
    /// # Errors
    /// Fails if times are not finite or do not increase, or if their number differs from a fixed number of frames.
    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>>;

    /// Returns notes for the user, such as repairs or guesses made while opening.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Returns the folder of the training data if the input names it. The cameras may be found there.
    fn data_folder(&self) -> Option<&str> {
        None
    }

    /// Returns the number of training frames if the input gives it. The last of them is one step before the end of the
    /// time span.
    fn data_frames(&self) -> Option<usize> {
        None
    }

    /// Returns the background color used in training if the input names it.
    fn background(&self) -> Option<[f32; 3]> {
        None
    }

    /// Returns the merge class of a Gaussian. Gaussians of different classes never merge.
    fn class(&self, id: u32) -> u8 {
        let _ = id;
        0
    }

    /// Returns the raw parameters that all frames are computed from, if the format has any.
    fn canonical(&self) -> Option<&Gaussians> {
        None
    }

    /// Returns a description of each column of a container; empty for other inputs.
    ///
    /// # Errors
    /// Fails if the index cannot be read.
    fn columns(&self) -> Result<Vec<ColumnInfo>> {
        Ok(Vec::new())
    }

    /// Returns the kind of output to write if neither the user nor the output path specifies one.
    fn own_output(&self) -> OutputKind {
        DEFAULT_OUTPUT
    }

    /// Checks that this input can be written as `kind` to `path`.
    ///
    /// # Errors
    /// Fails if it cannot; the message lists kinds that work.
    fn check_output(&self, kind: OutputKind, path: &Path) -> Result<()> {
        match kind {
            OutputKind::Archive if self.archives_as_frames() => Ok(()),
            _ => check_output(self.source().info().times.len(), kind, path),
        }
    }

    /// Computes the raw parameters of the proxies of `clusters`, compared at `reference`. The default returns no
    /// proxies: without raw parameters, a proxy follows from its members in each frame.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    fn solve(&self, clusters: &[Cluster], reference: Reference, rule: &MergeParams) -> Result<Proxies> {
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

    /// Returns the reason why SH coefficients of every degree must be kept; `None` if the degree may be lowered.
    fn needs_all_bands(&self) -> Option<&'static str> {
        None
    }

    /// Returns the content of an archive of the compressed model `reduction`.
    ///
    /// # Errors
    /// Fails if the input cannot be archived or its files cannot be read.
    fn content(&self, reduction: &CompressedModel) -> Result<Content> {
        let _ = reduction;
        Err(Error::usage(NO_ARCHIVE))
    }

    /// Returns the frames that `content` decodes to, at the times of this input. `content` is an archive of this input
    /// or of a compressed model of it.
    ///
    /// # Errors
    /// Fails if `content` belongs to another kind of input.
    fn decode_frames<'a>(&'a self, content: &Content) -> Result<Box<dyn FrameSource + 'a>> {
        let _ = content;
        Err(Error::usage(NO_ARCHIVE))
    }

    /// Returns whether the input already identifies Gaussians across frames and can still be linked anew.
    fn may_be_linked(&self) -> bool {
        false
    }

    /// Returns whether the state of every Gaussian is stored for every frame, so that refinement may add a delta that
    /// varies in time ([`CompressedModel::course`]).
    fn has_explicit_frames(&self) -> bool {
        false
    }

    /// Returns whether an archive of this input is a lossy container of its frames (`.gseq` within error bounds).
    fn archives_as_frames(&self) -> bool {
        self.has_explicit_frames()
    }

    /// Returns the frames of the compressed model `reduction`, as they will be after writing.
    ///
    /// # Errors
    /// Fails if the deformation field cannot be evaluated.
    fn reduced<'a>(&'a self, reduction: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        Ok(reduced_trajectories(self.source(), reduction))
    }

    /// Writes the compressed model `reduction` to `path`, a new file or an empty folder, and returns notes for the
    /// user. Write buffers stay within `limits`. Progress is reported to `events`.
    ///
    /// # Errors
    /// Fails if frames cannot be read or a write fails.
    fn write(
        &self,
        reduction: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        write_trajectories(self.source(), reduction, kind, path, limits, events)
    }
}

/// Source of frame times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Timing {
    /// Continuous in time: a frame can be at any time.
    Continuous,
    /// Fixed number of frames; their times may come from cameras.
    Numbered,
    /// Frame times stored in the input.
    Stamped,
}

/// Memory of an open input and costs of reading it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MemoryProfile {
    /// Bytes per Gaussian that are resident while the input is open.
    pub per_gaussian: u64,
    /// Additional bytes per Gaussian while the input is being opened.
    pub opening: u64,
    /// Bytes per Gaussian of an open reader, in addition to the frames it holds.
    pub reader: u64,
    /// Bytes per Gaussian of a compressed copy from which frames are read.
    pub reduced: u64,
    /// Bytes per Gaussian of the Jacobian of frame states with respect to stored parameters; 0 if changes are simply
    /// added.
    pub jacobian: u64,
    /// Bytes per Gaussian of a memory-mapped file that is read whole.
    pub file: u64,
    /// Bytes that do not depend on the number of Gaussians.
    pub fixed: u64,
    /// Number of frames that are decoded together, so that a reader may hold several; 0 if each frame is read by
    /// itself.
    pub frame_block: u64,
    /// Number of Gaussians that are decoded together.
    pub gaussian_block: u64,
    /// Number of columns of a container.
    pub columns: u64,
    /// Approximate CPU seconds on one core to read one state (one Gaussian at one frame).
    pub seconds_per_state: f64,
    /// Bytes of all decoded values of a container; 0 if nothing is decoded or the values cannot be kept.
    pub decoded: u64,
}

impl MemoryProfile {
    /// Returns the profile of a container whose tiles hold `frame_block` frames.
    pub fn for_tiles(frame_block: u64) -> MemoryProfile {
        MemoryProfile {
            per_gaussian: 0,
            opening: 0,
            reader: 8,
            reduced: 0,
            jacobian: 0,
            file: 0,
            fixed: 0,
            frame_block,
            gaussian_block: GAUSSIAN_BLOCK as u64,
            columns: Attributes::all().iter().count() as u64,
            // Decoding time of tiles that are read whole (`benches/scan.rs`).
            seconds_per_state: 5e-8,
            decoded: 0,
        }
    }
}

/// Statistics of one column of a container.
#[derive(Debug, Serialize)]
pub struct ColumnInfo {
    /// Name of the column.
    pub name: String,
    /// Number of f32 components per Gaussian.
    pub width: u32,
    /// Maximum absolute error against the packed values, in the unit of the column; 0 means exact to the bit.
    pub max_error: f64,
    /// Number of tiles.
    pub tiles: usize,
    /// Number of these tiles that store one frame for all frames.
    pub constant_tiles: usize,
    /// Number of these tiles stored without compression.
    pub raw_tiles: usize,
    /// Stored bytes; shared tiles count once.
    pub stored_bytes: u64,
    /// Bytes of the same values as one f32 per frame, component and Gaussian.
    pub raw_bytes: u64,
    /// Smallest finite value; `None` without finite values.
    pub min: Option<f32>,
    /// Largest finite value; `None` without finite values.
    pub max: Option<f32>,
}

/// Entry of a model format: how its files are recognized and opened.
pub(super) struct ModelFormat {
    /// Returns whether the input has this format, judged by its content.
    pub(super) recognizes: fn(&FoundInput) -> bool,
    /// Opens the input; without frames if its timing is [`Timing::Continuous`].
    pub(super) open: fn(&Path, &OpenOptions) -> Result<Box<dyn InputModel>>,
}

/// Path to open and its type.
pub(super) struct FoundInput<'a> {
    pub(super) path: &'a Path,
    pub(super) is_folder: bool,
    /// First 16 bytes of a file.
    pub(super) head: Vec<u8>,
    /// Maximum memory for recognizing the format.
    pub(super) memory: ReadLimit,
}

impl FoundInput<'_> {
    /// Returns whether a file looks like one of `torch.save`: a ZIP archive that is not an `.npz` of NumPy.
    pub(super) fn is_checkpoint(&self) -> bool {
        let is_npz = self.path.extension().is_some_and(|found| found.eq_ignore_ascii_case("npz"));
        !self.is_folder && self.head.starts_with(b"PK") && !is_npz
    }

    /// Returns whether a file begins with `magic` or has `extension`. The extension also catches files with damaged
    /// heads.
    pub(super) fn is_file_of(&self, magic: &[u8], extension: &str) -> bool {
        let named = || self.path.extension().is_some_and(|found| found.eq_ignore_ascii_case(extension));
        !self.is_folder && (self.head.starts_with(magic) || named())
    }
}

/// Options of opening an input.
#[derive(Debug, Clone, Default)]
pub struct OpenOptions {
    /// Training iteration of a model folder; `None` selects the largest.
    pub iteration: Option<u32>,
    /// Whether a folder of frames may have missing frames.
    pub allow_gaps: bool,
    /// Whether frames are linked.
    pub link: Link,
    /// Folder for scratch files (decoded archives, linked frames) while the input is open; `None` selects the temporary
    /// folder of the system.
    pub scratch: Option<PathBuf>,
    /// Training conventions that the files do not record.
    pub conventions: Conventions,
    /// Maximum memory for opening the input.
    pub memory: ReadLimit,
    /// Receiver of progress events while opening.
    pub events: Events,
}

/// Training conventions that the files of some formats do not record, and how to treat ambiguous values.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Conventions {
    /// Length of `time_duration`, the period after which colors repeat; `None` uses the guess of the model format and
    /// adds a note.
    pub time_duration: Option<f64>,
    /// Whether 4D rotations use the convention before 15 September 2024, without the reversal of axes.
    pub rot4d_unflipped: bool,
    /// Treatment of zero quaternions of a `.splatv`; `None` means [`ZeroRotation::Drop`].
    pub zero_rotation: Option<ZeroRotation>,
}

/// Whether frames are linked to identify the same Gaussian across frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Link {
    /// Links a folder of frames only if their numbers of Gaussians differ or their order does not identify Gaussians.
    #[default]
    Auto,
    /// Always links, also frames in a common order, containers and streams.
    Always,
    /// Always links, but neither joins tracks that seem to be one Gaussian nor makes nearly constant attributes
    /// constant.
    Apart,
    /// Never links: the same index means the same Gaussian.
    Never,
}

impl Link {
    /// Returns whether inputs that already identify Gaussians across frames are linked as well.
    pub fn always_links(self) -> bool {
        matches!(self, Link::Always | Link::Apart)
    }

    /// Returns whether tracks of the same Gaussian are joined.
    pub fn joins(self) -> bool {
        self != Link::Apart
    }
}

impl OpenOptions {
    /// Returns the folder for scratch files.
    pub(super) fn scratch(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }

    /// Returns the options for reading the PLY files of the input.
    pub(crate) fn ply(&self) -> PlyOptions {
        PlyOptions { scratch: self.scratch(), memory: self.memory, events: self.events.clone() }
    }

    /// Refuses `--iteration` for an input that is not a model folder.
    pub(super) fn refuse_for(&self, path: &Path) -> Result<()> {
        match self.iteration {
            Some(_) => Err(Error::usage(format!("{}: --iteration applies to model folders only", path.shown()))),
            None => Ok(()),
        }
    }
}
