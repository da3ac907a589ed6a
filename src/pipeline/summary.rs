//! Summary of a run for people and programs: counts before and after every stage, omitted stages with reasons, memory
//! and time. It is the only output whose bytes differ between runs.
//!
//! These types are the only definition of the schema of `summary.json`: `compress` writes and `report` reads the file
//! through them. `format/SUMMARY.md` documents the fields for other programs.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::archive::ArchiveSize;
use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::files::names::name_of;
use crate::journal::records::{
    BandsSummary, FieldSummary, FlagSummary, Forecast, LeftOut, QualitySummary, RefinedSummary, StageRecord,
    TermSummary, number, sizes,
};
use crate::merging::PassCounts;
use crate::models::{InputModel, Size};
use crate::pruning::Counts;
use crate::recipe::ProxyOpacity;
use crate::scene::Scene;

/// Result of the search for a quality.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GoalSummary {
    /// Kind of the goal: `min_psnr` or `max_loss`, both in dB.
    pub name: String,
    /// Requested value, dB.
    pub asked: f64,
    /// Value of the output on the views of the search, dB.
    #[serde(deserialize_with = "number")]
    pub searched: f64,
    /// Value of the output on views that were held back from the search, dB.
    #[serde(deserialize_with = "number")]
    pub held: f64,
    /// Names of the held-back views. A view between the cameras of the scene is named by its frame.
    pub held_pictures: Vec<String>,
    /// Every tried number of Gaussians, with its value on the views of the search, dB.
    #[serde(deserialize_with = "sizes")]
    pub tried: Vec<(usize, f64)>,
}

/// Quality and contents of an archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ArchiveSummary {
    /// Requested PSNR of the archive's views against views of the result before quantization, dB.
    pub asked: f64,
    /// PSNR that was reached, dB.
    pub psnr: f64,
    /// PSNR of the result before quantization against the original, on the same views, dB.
    pub level: f64,
    /// Loss of PSNR against the original caused by quantization, dB.
    pub loss: f64,
    /// Bytes by part; `None` for an archive of frames, which has one part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parts: Option<ArchiveSize>,
    /// Error bound of every attribute, by name, in the attribute's unit; only for an archive of frames.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bounds: Option<BTreeMap<String, f64>>,
    /// Bits of every attribute and tensor, by name; empty for an archive of frames.
    pub bits: BTreeMap<String, f64>,
    /// Measurements from which the quantization steps were derived, one entry per attribute or tensor: name, log2 of
    /// the step (twice the error bound for frames), squared error of views caused by this step alone, and bits at this
    /// step (for frames: in some blocks of Gaussians).
    pub measured: Vec<(String, f64, f64, f64)>,
}

/// Description of the input.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct InputSummary {
    /// Path of the input: only the last component in files, the path as given on standard output.
    pub path: String,
    /// Kind of the input: "4DGaussians model", "PLY sequence", ...
    pub kind: String,
    /// Digest of the bytes read.
    pub digest: String,
    /// Number of Gaussians, N.
    pub gaussians: usize,
    /// Number of frames, T; `None` for a model whose frames have not been chosen yet.
    pub frames: Option<usize>,
    /// SH degree.
    pub sh_degree: usize,
    /// Names of the attributes that differ between frames.
    pub varying: Vec<String>,
    /// Bytes of all files that a renderer opens, or bytes that arrived of a stream.
    pub bytes: u64,
    /// Bytes by part.
    pub size: Size,
}

impl InputSummary {
    /// Returns the description of the input of an open scene.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    pub fn from_scene(scene: &Scene) -> Result<InputSummary> {
        InputSummary::new(&*scene.input, &scene.path, scene.digest()?)
    }

    /// Returns the description of an open input with the given path and digest.
    ///
    /// # Errors
    /// Fails if a file cannot be read.
    pub fn new(input: &dyn InputModel, path: &Path, digest: String) -> Result<InputSummary> {
        let info = input.source().info();
        Ok(InputSummary {
            path: path.to_string_lossy().into_owned(),
            kind: input.kind().to_owned(),
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
    /// Returns the description with only the last component of the input's path, for a file that may be published.
    pub fn without_folders(self) -> InputSummary {
        InputSummary { path: name_of(Path::new(&self.path)), ..self }
    }
}

/// Description of the cameras.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CameraSummary {
    /// File of the cameras, or the description of a virtual rig.
    pub origin: String,
    /// Number of distinct cameras.
    pub cameras: usize,
    /// Number of scored (time, view) pairs, M.
    pub pairs: usize,
}

impl CameraSummary {
    /// Returns the description of the views of `scene` that are scored.
    pub fn from_scene(scene: &Scene) -> CameraSummary {
        CameraSummary {
            origin: scene.rig.origin.clone(),
            cameras: scene.schedule.cameras.len(),
            pairs: scene.schedule.pairs(),
        }
    }
}

/// Counts of the merge stage.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MergeSummary {
    /// Frame at which Gaussians were compared and merged.
    pub reference_frame: usize,
    /// Number of proxies in the output.
    pub proxies: usize,
    /// Number of Gaussians that were merged into proxies.
    pub members: usize,
    /// Rule for the opacity of a proxy.
    pub opacity: ProxyOpacity,
    /// Counts of every merge pass.
    pub passes: Vec<PassCounts>,
    /// Largest distance between a proxy and its position among its members over sampled frames, scene units; `None`
    /// without a deformation field.
    pub deviation: Option<f64>,
}

impl MergeSummary {
    /// Sets the numbers of proxies and members from `clusters`.
    pub(super) fn count(&mut self, clusters: &[Cluster]) {
        self.proxies = clusters.len();
        self.members = clusters.iter().map(|cluster| cluster.members.len()).sum();
    }
}

/// Amount of detail in the text of a summary.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Detail {
    /// Kept Gaussians, size, quality, time, output and a few notes.
    Most,
    /// Additionally every stage, omitted stages with reasons, and all notes.
    All,
}

/// Version of the schema; grows when a field is removed or changes its meaning.
pub const SCHEMA: u32 = 3;

/// Summary of a run from input to output.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Summary {
    /// Version of the schema, [`SCHEMA`].
    pub schema: u32,
    /// Name and version of the program.
    pub tool: String,
    /// Description of the input.
    pub input: InputSummary,
    /// Cameras whose views were scored.
    pub cameras: CameraSummary,
    /// Path of the output: only the last component in files, the path as given on standard output.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub output: String,
    /// Number of Gaussians in the output.
    pub gaussians: usize,
    /// Bytes of all files of the output that a renderer opens.
    pub output_bytes: u64,
    /// Bytes of the output by part.
    pub output_size: Size,
    /// Counts of scoring and selection (stages 1 and 2 of the paper).
    pub selection: Counts,
    /// Maximum number of full reads of the input in the memory plan; `None` if there was no plan.
    pub planned_reads: Option<f64>,
    /// Forecast that was made before the run, if there was one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub forecast: Option<Forecast>,
    /// Records of all stages in order.
    pub stages: Vec<StageRecord>,
    /// Percentiles of every term of the score.
    pub terms: Vec<TermSummary>,
    /// Counts of unusual Gaussians.
    pub flags: FlagSummary,
    /// Counts of merging (stage 3 of the paper), unless it was omitted.
    pub merge: Option<MergeSummary>,
    /// Result of the search for a quality, if one was requested.
    pub goal: Option<GoalSummary>,
    /// Measured effect of half precision on the deformation field; `None` if half precision was not requested.
    pub field: Option<FieldSummary>,
    /// Measured effect of lower SH degrees; `None` if they were not requested or are impossible.
    pub bands: Option<BandsSummary>,
    /// Quality gained by refinement; `None` if nothing was refined.
    pub refined: Option<RefinedSummary>,
    /// Quality of the result on test views, else on validation or training views, and render times.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality: Option<QualitySummary>,
    /// Quality and contents of the archive, if one was written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub archive: Option<ArchiveSummary>,
    /// Stages that the run omitted, with reasons.
    pub left_out: Vec<LeftOut>,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Files of the result, relative to the folder of the summary; overwriting the result replaces them. Filled in once
    /// all files are written.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub files: Vec<String>,
}

impl Summary {
    /// Returns the number of full reads of the input, summed over all stages.
    pub fn full_reads(&self) -> f64 {
        self.stages.iter().map(|stage| stage.full_reads).sum()
    }

    /// Returns the summary as JSON, for programs.
    pub fn json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self).expect("a summary is plain data");
        text.push('\n');
        text
    }
}
