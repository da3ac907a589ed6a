//! Summary of a run for people and programs: counts before and after every stage, omitted stages with reasons, memory
//! and time. Of all output files only the summary has bytes that differ between equal runs.
//!
//! These types are the only definition of the format of `summary.json`: `compress` writes and `report` reads the file
//! through them. `format/SUMMARY.md` documents the fields for other programs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::archive::ArchiveSize;
use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::files::names::name_of;
use crate::journal::records::{
    FieldPrecisionSummary, Forecast, OmittedWork, PhotographSummary, QualitySummary, RefinedSummary, ShDegreeSummary,
    StageRecord, TermSummary, UnusualValueCounts, number, sizes,
};
use crate::merging::PassCounts;
use crate::models::{InputModel, ModelSize};
use crate::pruning::SelectionCounts;
use crate::recipe::ProxyOpacity;
use crate::scene::Scene;

/// Start of the note about a requested quality that the result does not have.
pub(super) const UNREACHED: &str = "the requested quality is not reached";

/// Result of the search for the smallest model with a requested quality.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GoalSummary {
    /// Requested kind of quality: `min_psnr` (PSNR against the original) or `max_loss` (loss of PSNR against
    /// photographs), both in dB.
    pub name: String,
    /// Whether the output, or the model before its conversion (`before_conversion`), has the requested quality on the
    /// views that the search used.
    pub is_met: bool,
    /// Requested value, dB: minimum PSNR against the original, or maximum loss of PSNR against photographs.
    pub asked: f64,
    /// Whether the quality is that of the result before it was converted to the format of the output, which stores
    /// rounded values or fitted motion.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub before_conversion: bool,
    /// Quality of the output on the views that the search used, dB: PSNR or loss of PSNR, as `name` says.
    #[serde(deserialize_with = "number")]
    pub searched: f64,
    /// Quality of the output on views that the search did not use, dB: PSNR or loss of PSNR, as `name` says.
    #[serde(deserialize_with = "number")]
    pub held: f64,
    /// Names of the views that the search did not use. A name consists of frame and view number; the name of a view
    /// from a camera between those of the scene has only the frame.
    pub held_views: Vec<String>,
    /// Every number of Gaussians that was tried, with the quality of its model on the views that the search used, dB:
    /// PSNR or loss of PSNR, as `name` says.
    #[serde(deserialize_with = "sizes")]
    pub tried: Vec<(usize, f64)>,
}

/// Quality and contents of an archive (compact file of the result, with quantized values).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ArchiveSummary {
    /// Requested PSNR of renders of the archive, compared with renders of the result before quantization, dB. A refined
    /// archive need not have it: its requirement is the maximum loss or the size from which this PSNR was derived.
    pub asked: f64,
    /// PSNR of renders of the archive, compared with renders of the result before quantization, dB.
    pub psnr: f64,
    /// PSNR of renders of the result before quantization, compared with renders of the original on the same views, dB.
    pub level: f64,
    /// Amount by which quantization, with the refinement for it, lowers the PSNR against the original, dB.
    pub loss: f64,
    /// Whether the attributes were refined for the quantization. `psnr` then also shows this change.
    #[serde(default)]
    pub is_refined: bool,
    /// Number of bytes of each part of the archive: Gaussians, deformation field, everything else. `None` for an
    /// archive of frames, which has one part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parts: Option<ArchiveSize>,
    /// Error bound of every attribute, by name of the attribute and in its unit; `None` unless the archive stores
    /// frames.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bounds: Option<BTreeMap<String, f64>>,
    /// Number of bits that each attribute and each tensor takes in the archive, by name; empty for an archive of
    /// frames.
    pub bits: BTreeMap<String, f64>,
    /// Measurements from which the quantization steps were derived, one entry for each attribute or tensor. Elements of
    /// an entry, in order:
    /// - name of the attribute or tensor;
    /// - log2 of its quantization step; in an archive of frames, log2 of twice its error bound;
    /// - mean squared error of renders if only this attribute or tensor is quantized, with this step;
    /// - number of bits that it takes with this step; in an archive of frames, this number in some blocks of Gaussians.
    pub measured: Vec<(String, f64, f64, f64)>,
}

/// Description of the input of a run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct InputSummary {
    /// Path of the input. Summary files hold only its last component; a summary on standard output holds the path as
    /// given by the user.
    pub path: String,
    /// Kind of the input: "4DGaussians model", "PLY sequence", ...
    pub kind: String,
    /// Digest of the bytes of the input.
    pub digest: String,
    /// Number of Gaussians in the input, N.
    pub gaussians: usize,
    /// Number of frames of the input, T; `None` for a model whose frames have not been chosen yet.
    pub frames: Option<usize>,
    /// SH degree of the input.
    pub sh_degree: usize,
    /// Names of the attributes of the input that vary in time.
    pub varying: Vec<String>,
    /// Number of bytes of all files of the input that a renderer opens; for a stream, number of bytes that arrived.
    pub bytes: u64,
    /// Number of bytes of each part of the input: canonical Gaussians, deformation field, explicit frames, everything
    /// else.
    pub size: ModelSize,
}

impl InputSummary {
    /// Returns the description of the input of an open scene.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    pub fn from_scene(scene: &Scene) -> Result<InputSummary> {
        InputSummary::new(&*scene.input, &scene.path, scene.digest()?)
    }

    /// Returns the description of the open input `input`, with the path `path` and the digest `digest`.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    pub fn new(input: &dyn InputModel, path: &Path, digest: String) -> Result<InputSummary> {
        let info = input.source().info();
        Ok(InputSummary {
            path: path.to_string_lossy().into_owned(),
            kind: input.description().kind.to_owned(),
            digest,
            gaussians: info.count,
            frames: Some(info.times.len()),
            sh_degree: info.sh_degree,
            varying: info.varying.iter().map(|column| column.name().to_owned()).collect(),
            bytes: input.bytes()?,
            size: input.size()?,
        })
    }
}

impl InputSummary {
    /// Returns this description of the input with its path reduced to the last component, for a file that may be
    /// published.
    pub fn without_folder_paths(self) -> InputSummary {
        InputSummary { path: name_of(Path::new(&self.path)), ..self }
    }
}

/// Description of the cameras whose views are used for scoring.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CameraSummary {
    /// File of the cameras, or the description of a virtual rig.
    pub origin: String,
    /// Number of different cameras.
    pub cameras: usize,
    /// Number M of views used for scoring, each a camera at a frame.
    pub pairs: usize,
}

impl CameraSummary {
    /// Returns the description of the cameras of `scene` whose views are used for scoring.
    pub fn from_scene(scene: &Scene) -> CameraSummary {
        CameraSummary {
            origin: scene.rig.origin.clone(),
            cameras: scene.rig.cameras.len(),
            pairs: scene.schedule.pair_count(),
        }
    }
}

/// Summary of the merge stage, which replaces clusters of Gaussians by one Gaussian each, a proxy.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MergeSummary {
    /// Reference frame, at which Gaussians were compared and merged.
    pub reference_frame: usize,
    /// Number of proxies in the output (Gaussians that replace merged clusters).
    pub proxies: usize,
    /// Number of Gaussians that were merged, each into a proxy (Gaussian that replaces a cluster).
    pub members: usize,
    /// Rule by which the opacity of a proxy (Gaussian that replaces a merged cluster) is computed.
    pub opacity: ProxyOpacity,
    /// Statistics of every merge pass, in order: numbers of candidate pairs, of joins, and others.
    pub passes: Vec<PassCounts>,
    /// Largest distance between the position of a proxy (Gaussian that replaces a cluster) and the position expected
    /// from the members of the cluster, over all proxies and sampled frames, in scene units. `None` if every proxy
    /// follows its members exactly.
    pub deviation: Option<f64>,
}

impl MergeSummary {
    /// Sets the numbers of proxies (Gaussians that replace merged clusters) and of merged Gaussians from `clusters`,
    /// the merged clusters.
    pub(super) fn count(&mut self, clusters: &[Cluster]) {
        self.proxies = clusters.len();
        self.members = clusters.iter().map(|cluster| cluster.members.len()).sum();
    }
}

/// Amount of detail in the text of a summary.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SummaryDetail {
    /// Number of Gaussians, size, quality, time, output and a few notes.
    Brief,
    /// Number of Gaussians, size, quality, time and output, every stage, omitted stages with reasons, and all notes.
    All,
}

/// Version of the format of `summary.json`; grows when a field is removed or changes its meaning.
pub const SCHEMA: u32 = 3;

/// Summary of a run from input to output, the content of `summary.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Summary {
    /// Version of the format, [`SCHEMA`].
    pub schema: u32,
    /// Name and version of the program.
    pub tool: String,
    /// Description of the input.
    pub input: InputSummary,
    /// Cameras whose views were used for scoring.
    pub cameras: CameraSummary,
    /// Path of the output. Summary files hold only its last component; a summary on standard output holds the path as
    /// given by the user.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub output: String,
    /// Path of the cameras, if the user gave one. It is part of the command that the text of the summary proposes, and
    /// is not written to files.
    #[serde(skip)]
    pub given_cameras: Option<PathBuf>,
    /// Whether the output leaves out the motion of the model. Not written to files.
    #[serde(skip)]
    pub leaves_out_motion: bool,
    /// Whether the output has a format that this program does not read. Not written to files.
    #[serde(skip)]
    pub is_unreadable: bool,
    /// Number of Gaussians in the output.
    pub gaussians: usize,
    /// Number of bytes of all output files that a renderer opens.
    pub output_bytes: u64,
    /// Number of bytes of each part of the output: canonical Gaussians, deformation field, explicit frames, everything
    /// else.
    pub output_size: ModelSize,
    /// Numbers of Gaussians kept and removed by scoring and selection (stages 1 and 2 of the paper).
    pub selection: SelectionCounts,
    /// Maximum number of full reads of the input (every frame once) in the memory plan; `None` if there was no plan.
    pub planned_reads: Option<f64>,
    /// Forecast of time and memory that was made before the run, if there was one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub forecast: Option<Forecast>,
    /// Records of all stages in order: numbers of Gaussians, reads, time and memory of each stage.
    pub stages: Vec<StageRecord>,
    /// Percentiles of every term of the score by which Gaussians were ranked.
    pub terms: Vec<TermSummary>,
    /// Number of Gaussians with unusual values, for each kind of unusual value (such as NaN).
    pub flags: UnusualValueCounts,
    /// Numbers of Gaussians that were merged (stage 3 of the paper); `None` if nothing was merged.
    pub merge: Option<MergeSummary>,
    /// Result of the search for the smallest model with a requested quality, if a quality was requested.
    pub goal: Option<GoalSummary>,
    /// Measured effect of writing the deformation field in half precision; `None` if it was not requested.
    pub field: Option<FieldPrecisionSummary>,
    /// Measured effect of dropping SH degrees; `None` if it was not requested or is impossible.
    pub bands: Option<ShDegreeSummary>,
    /// PSNR before and after refinement; `None` if nothing was refined.
    pub refined: Option<RefinedSummary>,
    /// PSNR against photographs before and after the fit to them; `None` if the result was not fitted to photographs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub photographs: Option<PhotographSummary>,
    /// Quality of the result on test views, or on validation or training views if there are none, and render times.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality: Option<QualitySummary>,
    /// Quality and contents of the archive, if one was written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub archive: Option<ArchiveSummary>,
    /// Stages that the run omitted, with reasons.
    pub left_out: Vec<OmittedWork>,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Paths of the files of the result, relative to the folder of the summary. Overwriting the result replaces these
    /// files. Set once all files are written.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub files: Vec<String>,
}

impl Summary {
    /// Returns the amount that all stages together read from the input. Unit: full reads (reading every frame once).
    pub fn full_reads(&self) -> f64 {
        self.stages.iter().map(|stage| stage.full_reads).sum()
    }
}
