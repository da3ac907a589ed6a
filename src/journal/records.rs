//! Parts of the summary that stages write while a run goes on.

use bytesize::ByteSize;
use serde::{Deserialize, Deserializer, Serialize};

use crate::metrics::decibels_text;
use crate::progress::duration;
use crate::source::Reads;

/// One stage of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageRecord {
    /// Its name.
    pub name: String,
    /// Gaussians that entered it.
    pub gaussians_in: usize,
    /// Gaussians that left it.
    pub gaussians_out: usize,
    /// What it read of the input, counted where it happened.
    pub reads: Reads,
    /// The same as full reads of the input: by bytes where it is stored in tiles, else by states.
    pub full_reads: f64,
    /// Bytes that it read back of scratch files, which are no part of the input.
    pub scratch_bytes: u64,
    /// Whether it was found in a work folder: then its times and reads are those of the run that it was found by.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub kept: bool,
    /// Wall-clock time.
    pub seconds: f64,
    /// Time of all processors together, where the system tells.
    pub processor_seconds: Option<f64>,
    /// Largest resident memory of the process up to the end of this stage, where the system tells.
    pub peak_memory_bytes: Option<u64>,
}

/// Something the scene did not need.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// What was not done.
    pub what: String,
    /// Why not.
    pub why: String,
    /// What it would have taken, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub saved: Option<Saved>,
}

/// What something would have taken that was left out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Saved {
    /// A stage: about so many seconds on all threads, and full reads of the frames at most.
    Stage {
        /// Seconds.
        seconds: f64,
        /// Full reads.
        reads: f64,
    },
    /// Values that are the same as before, not read again.
    Values {
        /// Their bytes.
        bytes: u64,
    },
}

impl Saved {
    /// For a person.
    pub fn text(self) -> String {
        match self {
            Saved::Stage { seconds, reads } => format!("about {}, {reads:.2} full reads", duration(seconds)),
            Saved::Values { bytes } => format!("{} of values", ByteSize(bytes).display().si()),
        }
    }
}

impl LeftOut {
    /// Why, and what that saved, for a person.
    pub fn reason(&self) -> String {
        match self.saved {
            Some(saved) => format!("{}; saves {}", self.why, saved.text()),
            None => self.why.clone(),
        }
    }
}

/// Sizes or degrees with a number each.
pub(crate) fn sizes<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<Vec<(usize, f64)>, D::Error> {
    let found = Vec::<(usize, Option<f64>)>::deserialize(from)?;
    Ok(found.into_iter().map(|(size, of)| (size, of.unwrap_or(f64::NAN))).collect())
}

/// A number as JSON has it: null stands for what is not finite.
pub(crate) fn number<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(from)?.unwrap_or(f64::NAN))
}

/// What half precision of the field does to pictures of the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FieldSummary {
    /// Whether the field is written in half precision.
    pub half: bool,
    /// Pictures that were compared.
    pub pictures: usize,
    /// Mean PSNR of pictures with the field in half precision against those with the exact field, dB.
    #[serde(deserialize_with = "number")]
    pub rounding: f64,
    /// Mean PSNR of pictures with the exact field against the original's, dB; none where it did not matter.
    pub result: Option<f64>,
    /// What `rounding` was to be at least, dB.
    #[serde(deserialize_with = "number")]
    pub least: f64,
}

impl FieldSummary {
    /// Why the field is as it is.
    pub(crate) fn why(&self) -> String {
        let FieldSummary { pictures, rounding, result, least, .. } = self;
        let from = |psnr: f64, what: &str| format!("{} from {what}", decibels_text(psnr, 1));
        let result = result.map_or(String::new(), |result| format!(", {}", from(result, "the original's to these")));
        format!(
            "{pictures} pictures with it are {}{result}; at least {least:.1} dB were asked for",
            from(*rounding, "those with the exact field")
        )
    }
}

/// What refining the result gained.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RefinedSummary {
    /// Pictures that were compared, apart from those that were refined toward.
    pub pictures: usize,
    /// Their mean PSNR against the original's before, dB.
    #[serde(deserialize_with = "number")]
    pub before: f64,
    /// And after, dB.
    #[serde(deserialize_with = "number")]
    pub result: f64,
}

/// Split that the views of a quality figure belong to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ViewKind {
    /// Test views: nothing was fitted to them or chosen by them.
    Test,
    /// Validation views: the best state of refinement was chosen by them.
    Validation,
    /// Training views: Gaussians were ranked by them.
    Training,
    /// Views of a virtual rig, because the scene has no cameras.
    Virtual,
}

/// Time of rendering one view on one thread, without the evaluation of the deformation field: the median of several, in
/// milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RenderTime {
    /// The original.
    pub before: f64,
    /// The result.
    pub after: f64,
}

/// Quality of the result against the original.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct QualitySummary {
    /// Split of the views.
    pub kind: ViewKind,
    /// Number of views.
    pub views: usize,
    /// Mean PSNR against the original's renders, dB.
    #[serde(deserialize_with = "number")]
    pub psnr: f64,
    /// Mean SSIM; `None` where only the PSNR of validation views is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    /// Render time before and after.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub render_ms: Option<RenderTime>,
}

/// What pictures of the result say of its bands of spherical harmonics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BandsSummary {
    /// SH degree of the output.
    pub sh_degree: usize,
    /// Pictures that were compared.
    pub pictures: usize,
    /// Every lower degree, and the mean PSNR of pictures with it against those with all bands, dB.
    #[serde(deserialize_with = "sizes")]
    pub tried: Vec<(usize, f64)>,
    /// Mean PSNR of pictures with all bands against the original's, dB.
    #[serde(deserialize_with = "number")]
    pub result: f64,
    /// Minimum PSNR that a lower degree needed to be chosen, dB.
    #[serde(deserialize_with = "number")]
    pub least: f64,
}

impl BandsSummary {
    /// Why bands went, or stayed.
    pub(crate) fn why(&self) -> String {
        let BandsSummary { pictures, tried, result, least, .. } = self;
        let of = |(degree, apart): &(usize, f64)| format!("{} at degree {degree}", decibels_text(*apart, 1));
        let tried: Vec<String> = tried.iter().map(of).collect();
        format!(
            "{pictures} pictures are {} from those with all bands, {} from the original's to these; at least \
             {least:.1} dB were asked for",
            tried.join(", "),
            decibels_text(*result, 1)
        )
    }
}

/// A value that is known within bounds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Range {
    /// Hardly less.
    pub least: f64,
    /// About.
    pub likely: f64,
    /// Hardly more.
    pub most: f64,
}

/// What a stage will take of all processors together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageForecast {
    /// Its name.
    pub name: String,
    /// Seconds, about.
    pub core_seconds: f64,
}

/// What a run will take.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// Wall-clock time.
    pub seconds: Range,
    /// Time of all processors together.
    pub core_seconds: Range,
    /// Threads at work.
    pub threads: u64,
    /// Whether some work was done to measure by.
    pub measured: bool,
    /// Most memory.
    pub memory_bytes: u64,
    /// Stage by stage.
    pub stages: Vec<StageForecast>,
}

/// A term of the scores.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TermSummary {
    /// [`Graded::name`](crate::statistics::score::Graded::name).
    pub name: String,
    /// 1st percentile.
    #[serde(deserialize_with = "number")]
    pub p1: f64,
    /// 99th percentile.
    #[serde(deserialize_with = "number")]
    pub p99: f64,
    /// Whether the percentiles differ, so that the term grades rather than splits.
    pub active: bool,
}

/// Counts of odd Gaussians.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct FlagSummary {
    /// NaN or infinity in some frame.
    pub non_finite: usize,
    /// Zero quaternion in some frame.
    pub zero_rotation: usize,
    /// D set to 0 as rounding noise.
    pub snapped_d: usize,
    /// κ set to 0 as rounding noise.
    pub snapped_kappa: usize,
    /// Never alive.
    pub never_alive: usize,
    /// In no picture of the scored cameras.
    pub never_in_view: usize,
}
