//! What a kind of input can do.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::size::{Size, bytes_below};
use super::trajectories::{NO_ARCHIVE, OWN_OUTPUT, check_output, reduced_trajectories, write_trajectories};
use crate::archive::Content;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, Reference};
use crate::error::{Error, Result, ShowPath};
use crate::files::cameras::Clock;
use crate::files::ply::PlyOptions;
use crate::files::splatv::rows::ZeroRotation;
use crate::limits::{Limits, ReadLimit};
use crate::model::{Columns, Gaussians};
use crate::outputs::container::GAUSSIAN_BLOCK;
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// An open input of some kind.
///
/// What has a body here is right for explicit trajectories, of which each state stands in every frame; a family whose
/// frames follow from raw parameters has its own.
pub trait InputModel: Send + Sync {
    /// What it is, for people.
    fn kind(&self) -> &'static str;

    /// Its frames.
    fn source(&self) -> &dyn FrameSource;

    /// Hash over the bytes read.
    ///
    /// # Errors
    /// A file that cannot be read.
    fn digest(&self) -> Result<String>;

    /// Bytes of everything that a renderer opens of the model; of a stream, those that arrived.
    ///
    /// # Errors
    /// A file that is not there any more.
    fn bytes(&self) -> Result<u64>;

    /// The same by part.
    ///
    /// # Errors
    /// Those of [`InputModel::bytes`].
    fn size(&self) -> Result<Size> {
        Ok(Size::of_frames(self.bytes()?))
    }

    /// Bytes, by part, of what [`InputModel::write`] wrote to `path` as a result of `kind`, with nothing beside it yet.
    ///
    /// # Errors
    /// A file that is not there any more.
    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<Size> {
        let _ = kind;
        Ok(Size::of_frames(bytes_below(path)?))
    }

    /// Bytes of the files that its frames are read from.
    ///
    /// # Errors
    /// A file that is not there any more.
    fn stored_bytes(&self) -> Result<u64> {
        self.bytes()
    }

    /// What it keeps in memory, and how it is read.
    fn residence(&self) -> MemoryProfile;

    /// Lets values that were decoded stay in memory, where [`MemoryProfile::decoded`] says that they can.
    fn hold_decoded(&self) {}

    /// Where its frames get their times.
    fn timing(&self) -> Timing;

    /// What its time counts, where cameras say when its frames are.
    fn clock(&self) -> Clock {
        Clock::Normalized
    }

    /// How long it lasts in its own time, where nothing says when its frames are.
    fn span(&self) -> f64 {
        1.0
    }

    /// The same input with frames at `times`; refused where [`Timing::Stamped`].
    ///
    /// # Errors
    /// Times that are not finite or do not increase; another number of them than there are frames.
    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>>;

    /// Things a person should know of it.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Folder of the data it was trained on, as the input names it, where it does: there cameras may be.
    fn data_folder(&self) -> Option<&str> {
        None
    }

    /// Frames of that data it was trained on, where the input says how many: the last is one step before the end of its time.
    fn data_frames(&self) -> Option<usize> {
        None
    }

    /// Color behind the scene that it was trained with, where it names one.
    fn background(&self) -> Option<[f32; 3]> {
        None
    }

    /// To what a Gaussian belongs: those of different classes never merge.
    fn class(&self, id: u32) -> u8 {
        let _ = id;
        0
    }

    /// The raw parameters that all frames follow from, of a family that has such.
    fn canonical(&self) -> Option<&Gaussians> {
        None
    }

    /// What its container holds, column by column; empty where it is no container.
    ///
    /// # Errors
    /// An index that cannot be read.
    fn columns(&self) -> Result<Vec<ColumnInfo>> {
        Ok(Vec::new())
    }

    /// The kind of a result to which neither the user nor its name gives one.
    fn own_output(&self) -> OutputKind {
        OWN_OUTPUT
    }

    /// Confirms that a result can be of `kind`, written to `path`.
    ///
    /// # Errors
    /// A kind that this input cannot be written as, naming those that it can.
    fn check_output(&self, kind: OutputKind, path: &Path) -> Result<()> {
        match kind {
            OutputKind::Archive if self.archives_frames() => Ok(()),
            _ => check_output(self.source().info().times.len(), kind, path),
        }
    }

    /// Raw parameters of the proxies that `clusters` become, compared at `reference`. A family without raw
    /// parameters has nothing to solve: its proxies follow from their members frame by frame.
    ///
    /// # Errors
    /// Frames that cannot be read.
    fn solve(&self, clusters: &[Cluster], reference: Reference, rule: &MergeParams) -> Result<Proxies> {
        let _ = (clusters, reference, rule);
        Ok(Proxies::default())
    }

    /// Whether a model of it has a field that can be written in half precision.
    ///
    /// # Errors
    /// A field that cannot be read any more.
    fn can_round_field(&self) -> Result<bool> {
        Ok(false)
    }

    /// Why harmonics of every degree have to stay, if they have to.
    fn needs_all_bands(&self) -> Option<&'static str> {
        None
    }

    /// What an archive of what `reduction` leaves holds.
    ///
    /// # Errors
    /// An input that no archive holds; files that cannot be read.
    fn content(&self, reduction: &CompressedModel) -> Result<Content> {
        let _ = reduction;
        Err(Error::usage(NO_ARCHIVE))
    }

    /// The frames of `content`, of this input or of what is left of it, at this input's times.
    ///
    /// # Errors
    /// A content of another kind.
    fn decode_frames<'a>(&'a self, content: &Content) -> Result<Box<dyn FrameSource + 'a>> {
        let _ = content;
        Err(Error::usage(NO_ARCHIVE))
    }

    /// Whether it says which Gaussian is which and can be linked all the same.
    fn may_be_linked(&self) -> bool {
        false
    }

    /// Whether every Gaussian's state stands in every frame, so that it may change along time ([`CompressedModel::course`]).
    fn has_explicit_frames(&self) -> bool {
        false
    }

    /// Whether an archive of it is one of its frames: a container within bounds.
    fn archives_frames(&self) -> bool {
        self.has_explicit_frames()
    }

    /// The frames of what `reduction` leaves, as they will be once it is written.
    ///
    /// # Errors
    /// A field that cannot be evaluated.
    fn reduced<'a>(&'a self, reduction: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        Ok(reduced_trajectories(self.source(), reduction))
    }

    /// Writes what `reduction` leaves to `path`, a new file or an empty folder; gives things a person should know.
    /// What waits in memory to be written keeps to `limits`. Progress goes to `events`.
    ///
    /// # Errors
    /// Frames that cannot be read, a failed write.
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

/// Where frames get their times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Timing {
    /// Any instant can be a frame.
    Continuous,
    /// There are so many frames; cameras may say when.
    Numbered,
    /// The input says when its frames are.
    Stamped,
}

/// What an open input keeps in memory, and how it is read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MemoryProfile {
    /// Bytes per Gaussian that are resident while it is open.
    pub per_gaussian: u64,
    /// Bytes per Gaussian while it is opened, beside these.
    pub opening: u64,
    /// Bytes per Gaussian of an open reader, beside the frames it holds.
    pub reader: u64,
    /// Bytes per Gaussian of a reduced copy of it, of which frames are read.
    pub reduced: u64,
    /// Bytes per Gaussian of how states change with what is stored, where that is by more than a sum; else 0.
    pub jacobian: u64,
    /// Bytes per Gaussian of a file that is mapped while it is read whole.
    pub file: u64,
    /// Bytes however many Gaussians there are.
    pub fixed: u64,
    /// Frames that are decoded together, so that a reader may hold some; 0 where each is read by itself.
    pub frame_block: u64,
    /// Gaussians that are decoded together.
    pub gaussian_block: u64,
    /// Columns of a container.
    pub columns: u64,
    /// Seconds of one processor that a state (a Gaussian at a frame) takes to read, about.
    pub seconds_per_state: f64,
    /// Bytes of all values of a container, decoded; 0 where nothing is decoded, or where it cannot be kept.
    pub decoded: u64,
}

impl MemoryProfile {
    /// Of a container in tiles of `frame_block` frames.
    pub fn of_tiles(frame_block: u64) -> MemoryProfile {
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
            columns: Columns::all().iter().count() as u64,
            // Decoding, of tiles that are read whole (`benches/scan.rs`).
            seconds_per_state: 5e-8,
            decoded: 0,
        }
    }
}

/// One column of a container.
#[derive(Debug, Serialize)]
pub struct ColumnInfo {
    /// Its name.
    pub name: String,
    /// f32 components per Gaussian.
    pub width: u32,
    /// How far values may be off those that were packed, in the column's unit; 0: not one bit.
    pub max_error: f64,
    /// Number of tiles.
    pub tiles: usize,
    /// Of those, tiles that hold one frame for all.
    pub constant_tiles: usize,
    /// Of those, tiles stored as they are.
    pub raw_tiles: usize,
    /// Bytes stored, of shared tiles once.
    pub stored_bytes: u64,
    /// Bytes of the same values as one f32 per frame, component and Gaussian.
    pub raw_bytes: u64,
    /// Smallest finite value; none if there is no finite value.
    pub min: Option<f32>,
    /// Largest finite value; none if there is no finite value.
    pub max: Option<f32>,
}

/// How a family takes part.
pub(super) struct ModelFormat {
    /// Whether a path is of this family, told by what is there.
    pub(super) recognizes: fn(&FoundInput) -> bool,
    /// Opens it; without frames where [`Timing::Continuous`].
    pub(super) open: fn(&Path, &OpenOptions) -> Result<Box<dyn InputModel>>,
}

/// What lies at a path.
pub(super) struct FoundInput<'a> {
    pub(super) path: &'a Path,
    pub(super) is_folder: bool,
    /// The first bytes of a file.
    pub(super) head: Vec<u8>,
    /// Memory that looking at it may take.
    pub(super) memory: ReadLimit,
}

impl FoundInput<'_> {
    /// Whether a file looks like one of `torch.save`: an archive that is not numpy's.
    pub(super) fn is_checkpoint(&self) -> bool {
        let of_numpy = self.path.extension().is_some_and(|found| found.eq_ignore_ascii_case("npz"));
        !self.is_folder && self.head.starts_with(b"PK") && !of_numpy
    }

    /// Whether a file begins with `magic`, or, where it is so damaged that it does not, has that extension.
    pub(super) fn is_file_of(&self, magic: &[u8], extension: &str) -> bool {
        let named = || self.path.extension().is_some_and(|found| found.eq_ignore_ascii_case(extension));
        !self.is_folder && (self.head.starts_with(magic) || named())
    }
}

/// What a user may say about an input beside its path.
#[derive(Debug, Clone, Default)]
pub struct OpenOptions {
    /// Training iteration of a model folder; none: the largest.
    pub iteration: Option<u32>,
    /// Whether frames may be missing from a folder of them.
    pub allow_gaps: bool,
    /// Whether frames are linked.
    pub link: Link,
    /// Folder for what an archive decodes to and linked frames are packed into, while they are open; none: the system's
    /// for such files.
    pub scratch: Option<PathBuf>,
    /// What its files do not say.
    pub conventions: Conventions,
    /// Memory that opening it may take.
    pub memory: ReadLimit,
    /// Where the progress of opening goes.
    pub events: Events,
}

/// What the files of some families do not say of how their models were trained, or what to do where they are unclear.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Conventions {
    /// Length of `time_duration`, after which colors repeat; none: the family's guess, with a note.
    pub time_duration: Option<f64>,
    /// Whether rotations of four dimensions are those of before 15 September 2024, without the reversal of axes.
    pub rot4d_unflipped: bool,
    /// What becomes of zero quaternions of a `.splatv`; none: [`ZeroRotation::Drop`].
    pub zero_rotation: Option<ZeroRotation>,
}

/// Whether frames are linked, so that they say which Gaussian is which.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Link {
    /// Those of a folder where they have different numbers of Gaussians, or their order does not tell.
    #[default]
    Auto,
    /// Whatever their order tells, or a container or stream.
    Always,
    /// Whatever their order tells; lives that seem to be one stay apart, and what hardly changes along them is not held.
    Apart,
    /// The same place means the same Gaussian.
    Never,
}

impl Link {
    /// Whether frames are linked that say which Gaussian is which.
    pub fn is_asked(self) -> bool {
        matches!(self, Link::Always | Link::Apart)
    }

    /// Whether lives are joined that are one.
    pub fn joins(self) -> bool {
        self != Link::Apart
    }
}

impl OpenOptions {
    /// Folder for scratch files.
    pub(super) fn scratch(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }

    /// How PLY files of the input are read.
    pub(crate) fn ply(&self) -> PlyOptions {
        PlyOptions { scratch: self.scratch(), memory: self.memory, events: self.events.clone() }
    }

    /// Refuses what only model folders take.
    pub(super) fn refuse_for(&self, path: &Path) -> Result<()> {
        match self.iteration {
            Some(_) => Err(Error::usage(format!("{}: --iteration is for model folders", path.shown()))),
            None => Ok(()),
        }
    }
}
