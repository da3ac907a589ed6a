//! What a run did, for people and for programs: counts in and out of every stage, what was left out
//! and why, memory and time. The only output whose bytes differ between runs.
//!
//! These types are the one schema of `summary.json`: `compress` writes it by them and `report` reads it by them. What
//! its fields mean to other programs stands in `format/SUMMARY.md`.

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

/// What the output's size was found by.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GoalSummary {
    /// `min_psnr` or `max_loss`, dB.
    pub name: String,
    /// What was asked for.
    pub asked: f64,
    /// What the output has, by what was searched on.
    #[serde(deserialize_with = "number")]
    pub searched: f64,
    /// The same by pictures that nothing was searched on.
    #[serde(deserialize_with = "number")]
    pub held: f64,
    /// Names of these pictures; of those that no camera of the scene takes, their frames.
    pub held_pictures: Vec<String>,
    /// Every size that was tried, and what it has by what was searched on.
    #[serde(deserialize_with = "sizes")]
    pub tried: Vec<(usize, f64)>,
}

/// What an archive is made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ArchiveSummary {
    /// PSNR of its pictures against those of the result before it was put on grids, dB: asked for.
    pub asked: f64,
    /// The same, found.
    pub psnr: f64,
    /// PSNR of the result's pictures against the original's on the same pictures, dB.
    pub level: f64,
    /// How much less the archive's pictures have against the original's, dB.
    pub loss: f64,
    /// Bytes of its parts; none of frames, which are one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parts: Option<ArchiveSize>,
    /// Of frames the bound of every column, by name, in its unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bounds: Option<BTreeMap<String, f64>>,
    /// Bits of every attribute and tensor, by name; of frames none.
    pub bits: BTreeMap<String, f64>,
    /// Of every attribute and tensor, or column of frames, its name, log2 of a step (twice the bound), the squared error that
    /// this alone adds to pictures, and the bits that it then takes, of frames in some blocks: where the steps were found from.
    pub measured: Vec<(String, f64, f64, f64)>,
}

/// The input, as the summary names it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct InputSummary {
    /// Last name of its path in files; the path as given on standard output.
    pub path: String,
    /// "4DGaussians model", "PLY sequence", ...
    pub kind: String,
    /// Hash over the bytes read.
    pub digest: String,
    /// N.
    pub gaussians: usize,
    /// T; none for a model whose frames nobody has chosen yet.
    pub frames: Option<usize>,
    /// Degree of the spherical harmonics.
    pub sh_degree: usize,
    /// Columns that differ between frames.
    pub varying: Vec<String>,
    /// Bytes of everything that a renderer opens of the model, or that arrived of a stream.
    pub bytes: u64,
    /// The same by part.
    pub size: Size,
}

impl InputSummary {
    /// Of the input of an open scene.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn from_scene(scene: &Scene) -> Result<InputSummary> {
        InputSummary::new(&*scene.input, &scene.path, scene.digest()?)
    }

    /// Of an open input, whose path and digest are given.
    ///
    /// # Errors
    /// A file that cannot be read.
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
    /// Returns the summary with the last name of the input's path alone, for a file.
    pub fn without_folders(self) -> InputSummary {
        InputSummary { path: name_of(Path::new(&self.path)), ..self }
    }
}

/// The cameras, as the summary names them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CameraSummary {
    /// File, or the recipe of a virtual rig.
    pub origin: String,
    /// Distinct cameras.
    pub cameras: usize,
    /// M, (time, view) pairs that were scored.
    pub pairs: usize,
}

impl CameraSummary {
    /// Of the pictures that are scored.
    pub fn from_scene(scene: &Scene) -> CameraSummary {
        CameraSummary {
            origin: scene.rig.origin.clone(),
            cameras: scene.schedule.cameras.len(),
            pairs: scene.schedule.pairs(),
        }
    }
}

/// What merging did.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MergeSummary {
    /// Frame at which Gaussians were compared and merged.
    pub reference_frame: usize,
    /// Proxies in the output.
    pub proxies: usize,
    /// Gaussians that went into them.
    pub members: usize,
    /// Rule by which a proxy's opacity was made.
    pub opacity: ProxyOpacity,
    /// One entry per pass.
    pub passes: Vec<PassCounts>,
    /// Furthest that a proxy strays from its place among its members over sampled frames, scene units;
    /// none without a deformation field.
    pub deviation: Option<f64>,
}

impl MergeSummary {
    /// Counts what became of `clusters`.
    pub(super) fn count(&mut self, clusters: &[Cluster]) {
        self.proxies = clusters.len();
        self.members = clusters.iter().map(|cluster| cluster.members.len()).sum();
    }
}

/// How much of a summary a person is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Detail {
    /// What was kept, what it costs and where it lies.
    Most,
    /// And every stage, what was left out and why, and all notes.
    All,
}

/// Version of the schema: grows when a field changes its meaning or goes.
pub const SCHEMA: u32 = 3;

/// A run from input to output.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Summary {
    /// [`SCHEMA`].
    pub schema: u32,
    /// Program and version.
    pub tool: String,
    /// What was read.
    pub input: InputSummary,
    /// From where it was looked at.
    pub cameras: CameraSummary,
    /// Last name of the output in files; its path as given on standard output.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub output: String,
    /// Gaussians in the output.
    pub gaussians: usize,
    /// Bytes of everything that a renderer opens of the output.
    pub output_bytes: u64,
    /// The same by part.
    pub output_size: Size,
    /// Stages 1 and 2.
    pub selection: Counts,
    /// Full reads of the input that the plan named at most; none where nothing was planned.
    pub planned_reads: Option<f64>,
    /// What the run was expected to take before it began, where that was said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub forecast: Option<Forecast>,
    /// Everything in order.
    pub stages: Vec<StageRecord>,
    /// Percentiles of every term.
    pub terms: Vec<TermSummary>,
    /// Odd Gaussians.
    pub flags: FlagSummary,
    /// Stage 3, unless it was left out.
    pub merge: Option<MergeSummary>,
    /// What its size was found by, if by a quality.
    pub goal: Option<GoalSummary>,
    /// What half precision does to the field that is written; none where it was not asked for.
    pub field: Option<FieldSummary>,
    /// What fewer bands of spherical harmonics do; none where they were not asked for or cannot be.
    pub bands: Option<BandsSummary>,
    /// What refining gained; none where nothing was refined.
    pub refined: Option<RefinedSummary>,
    /// Quality of the result on test views, else on validation or training views, and render times.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality: Option<QualitySummary>,
    /// What an archive is made of, if one was written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub archive: Option<ArchiveSummary>,
    /// What the scene did not need.
    pub left_out: Vec<LeftOut>,
    /// Things a person should know.
    pub notes: Vec<String>,
    /// Files of the result, relative to the summary's folder: what overwriting it replaces. Entered once all lie there.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub files: Vec<String>,
}

impl Summary {
    /// Full reads of the input, all stages together.
    pub fn full_reads(&self) -> f64 {
        self.stages.iter().map(|stage| stage.full_reads).sum()
    }

    /// As JSON, for programs.
    pub fn json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self).expect("a summary is plain data");
        text.push('\n');
        text
    }
}
