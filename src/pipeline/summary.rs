//! What a run did, for people and for programs: counts in and out of every stage, what was left out
//! and why, memory and time. The only output whose bytes differ between runs.
//!
//! These types are the one schema of `summary.json`: `compress` writes it by them and `report` reads it by them. What
//! its fields mean to other programs stands in `format/SUMMARY.md`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use bytesize::ByteSize;
use serde::{Deserialize, Serialize};

use crate::archive::ArchiveSize;
use crate::compressed_model::Cluster;
use crate::error::{Result, ShowPath};
use crate::files::names::name_of;
use crate::journal::records::{
    BandsSummary, FieldSummary, FlagSummary, Forecast, LeftOut, RefinedSummary, StageRecord, TermSummary, number, sizes,
};
use crate::merging::PassCounts;
use crate::metrics::{PSNR_CAP_DB, decibels_text};
use crate::models::{InputModel, Size};
use crate::progress::duration;
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

/// Notes that are shown unless all are asked for.
const NOTES: usize = 2;

/// So many pictures, for a person.
fn pictures(count: usize) -> String {
    format!("{count} picture{}", if count == 1 { "" } else { "s" })
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

    /// What was done, for a person: what was kept, what that costs and where it lies; before it, if all is asked for,
    /// how it came about.
    pub fn text(&self, detail: Detail) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = match detail {
            Detail::All => self.write_course(&mut out),
            Detail::Most => Ok(()),
        };
        let _ = self.write_result(&mut out, detail);
        out
    }

    /// Input, cameras, stages and what was left out.
    fn write_course(&self, out: &mut String) -> std::fmt::Result {
        let input = &self.input;
        writeln!(
            out,
            "{}: {}, {} Gaussians x {} frames, SH degree {}",
            Path::new(&input.path).shown(),
            input.kind,
            input.gaussians,
            input.frames.unwrap_or(0),
            input.sh_degree
        )?;
        writeln!(
            out,
            "cameras: {} ({} cameras, {} pictures)",
            self.cameras.origin, self.cameras.cameras, self.cameras.pairs
        )?;
        for stage in &self.stages {
            let scratch = match stage.scratch_bytes {
                0 => String::new(),
                bytes => format!(", {:.1} MiB of scratch", bytes as f64 / f64::from(1 << 20)),
            };
            let processors = stage.processor_seconds.map_or(String::new(), |s| format!(" ({s:.1} of processors)"));
            let memory = stage.peak_memory_bytes.map_or(String::new(), |b| format!(", peak {} MiB", b >> 20));
            writeln!(
                out,
                "  {:<7} {:>9} -> {:>9}  {:8.2} s{processors}, {:.2} reads{scratch}{memory}",
                stage.name, stage.gaussians_in, stage.gaussians_out, stage.seconds, stage.full_reads
            )?;
        }
        if let Some(planned) = self.planned_reads {
            writeln!(out, "full reads of the input: {:.2}, planned at most {planned:.2}", self.full_reads())?;
        }
        if let Some(field) = self.field.as_ref().filter(|field| field.half) {
            writeln!(out, "field: in half precision: {}", field.why())?;
        }
        if let Some(bands) = self.bands.as_ref().filter(|bands| bands.sh_degree < input.sh_degree) {
            writeln!(out, "bands: SH degree {} of {}: {}", bands.sh_degree, input.sh_degree, bands.why())?;
        }
        writeln!(out, "bytes: {}", self.output_size.parts_of(&input.size))?;
        for left in &self.left_out {
            writeln!(out, "  left out: {} ({})", left.what, left.reason())?;
        }
        Ok(())
    }

    /// Counts, bytes, decibels, notes, and where it lies.
    fn write_result(&self, out: &mut String, detail: Detail) -> std::fmt::Result {
        let input = &self.input;
        let percent = |part: u64, whole: u64| 100.0 * part as f64 / whole.max(1) as f64;
        let (kept, all) = (self.gaussians, input.gaussians);
        writeln!(out, "kept    {kept} of {all} Gaussians ({:.1}%)", percent(kept as u64, all as u64))?;
        let [after, before] = [self.output_bytes, input.bytes].map(|bytes| ByteSize(bytes).display().si().to_string());
        writeln!(out, "size    {after} of {before} ({:.1}%)", percent(self.output_bytes, input.bytes))?;
        writeln!(out, "cost    {}", self.cost())?;
        if let Some(archive) = &self.archive {
            write!(out, "        its archive's pictures are {:.2} dB from those of the result before", archive.psnr)?;
            // Of a result that is the original, nothing can be lost that is not counted already.
            match archive.level < PSNR_CAP_DB {
                true => writeln!(out, ", and lose {:.2} dB against the original's", archive.loss)?,
                false => writeln!(out)?,
            }
        }
        let (seconds, peak) = self.taken();
        let memory = peak.map_or(String::new(), |bytes| format!(", at most {} MiB of memory", bytes >> 20));
        writeln!(out, "took    {}{memory}", duration(seconds))?;
        if !self.output.is_empty() {
            writeln!(out, "lies in {}", Path::new(&self.output).shown())?;
        }
        let shown = match detail {
            Detail::All => self.notes.len(),
            Detail::Most => self.notes.len().min(NOTES),
        };
        for note in &self.notes[..shown] {
            writeln!(out, "note    {note}")?;
        }
        let more = self.notes.len() - shown;
        if more > 0 {
            writeln!(out, "        {more} more notes with --verbose, all in the summary")?;
        }
        Ok(())
    }

    /// Wall-clock seconds of all stages, and the largest memory.
    fn taken(&self) -> (f64, Option<u64>) {
        let seconds = self.stages.iter().filter(|stage| !stage.kept).map(|stage| stage.seconds).sum();
        (seconds, self.stages.iter().filter_map(|stage| stage.peak_memory_bytes).max())
    }

    /// How close pictures of the result come to the original's, where that was found on the way.
    fn cost(&self) -> String {
        let to = |psnr: f64, by: &str| match psnr {
            same if same >= PSNR_CAP_DB => format!("no difference in {by}"),
            _ => format!("pictures {} from the original's ({by})", decibels_text(psnr, 1)),
        };
        let bands = self.bands.as_ref().map(|bands| (bands.result, bands.pictures));
        let field = self.field.as_ref().and_then(|field| Some((field.result?, field.pictures)));
        let refined = self.refined.map(|refined| (refined.result, refined.pictures));
        match (&self.goal, bands.or(field).or(refined)) {
            (Some(goal), _) if goal.name == "max_loss" => {
                format!("{:.2} dB against photographs held back, {} asked for", goal.held, goal.asked)
            }
            (Some(goal), _) => {
                to(goal.held, &format!("{} held back; {} dB asked for", pictures(goal.held_pictures.len()), goal.asked))
            }
            (None, Some((psnr, count))) if psnr.is_finite() => to(psnr, &pictures(count)),
            _ => "not measured; `splatsieve evaluate` compares pictures".to_owned(),
        }
    }
}
