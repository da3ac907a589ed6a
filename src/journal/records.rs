//! Records for the summary that stages write during a run.

use bytesize::ByteSize;
use serde::{Deserialize, Deserializer, Serialize};

use crate::metrics::decibels_text;
use crate::progress::duration;
use crate::source::Reads;

/// Record of one stage of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageRecord {
    /// Name of the stage.
    pub name: String,
    /// Number of Gaussians before the stage.
    pub gaussians_in: usize,
    /// Number of Gaussians after the stage.
    pub gaussians_out: usize,
    /// Reads of the input, counted where they happened.
    pub reads: Reads,
    /// Reads as a number of full reads of the input: by bytes if it is stored in tiles, otherwise by states.
    pub full_reads: f64,
    /// Bytes read back from scratch files, which are not part of the input.
    pub scratch_bytes: u64,
    /// Whether the result came from the cache. Times and reads are then those of the run that computed it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub kept: bool,
    /// Wall-clock time, seconds.
    pub seconds: f64,
    /// Time of all processors together, seconds, where the system reports it.
    pub processor_seconds: Option<f64>,
    /// Largest resident memory of the process up to the end of this stage, bytes, where the system reports it.
    pub peak_memory_bytes: Option<u64>,
}

/// Stage or step that was omitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// Name of the omitted work.
    pub what: String,
    /// Reason.
    pub why: String,
    /// Cost that was saved, where it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub saved: Option<Saved>,
}

/// Cost that was saved by omitting work.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Saved {
    /// Cost of a stage: approximate time on all threads, and maximum full reads of the frames.
    Stage {
        /// Time, seconds.
        seconds: f64,
        /// Number of full reads.
        reads: f64,
    },
    /// Values that did not change and were not read again.
    Values {
        /// Bytes of these values.
        bytes: u64,
    },
}

impl Saved {
    /// Formats the saved cost for display.
    pub fn text(self) -> String {
        match self {
            Saved::Stage { seconds, reads } => format!("about {}, {reads:.2} full reads", duration(seconds)),
            Saved::Values { bytes } => format!("{} of values", ByteSize(bytes).display().si()),
        }
    }
}

impl LeftOut {
    /// Returns the reason and the saved cost as text for display.
    pub fn reason(&self) -> String {
        match self.saved {
            Some(saved) => format!("{}; saves {}", self.why, saved.text()),
            None => self.why.clone(),
        }
    }
}

/// Deserializes pairs of an integer (size or SH degree) and a number; null becomes NaN.
pub(crate) fn sizes<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<Vec<(usize, f64)>, D::Error> {
    let found = Vec::<(usize, Option<f64>)>::deserialize(from)?;
    Ok(found.into_iter().map(|(size, value)| (size, value.unwrap_or(f64::NAN))).collect())
}

/// Deserializes a number; null, which JSON writes for numbers that are not finite, becomes NaN.
pub(crate) fn number<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(from)?.unwrap_or(f64::NAN))
}

/// Effect of half precision of the deformation field on renders of the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FieldSummary {
    /// Whether the field is written in half precision.
    pub half: bool,
    /// Number of compared views.
    pub pictures: usize,
    /// Mean PSNR of renders with the half-precision field against those with the exact field, dB.
    #[serde(deserialize_with = "number")]
    pub rounding: f64,
    /// Mean PSNR of renders with the exact field against the original, dB; `None` if the decision did not need it.
    pub result: Option<f64>,
    /// Minimum of `rounding` for which half precision is accepted, dB.
    #[serde(deserialize_with = "number")]
    pub least: f64,
}

impl FieldSummary {
    /// Returns the reason for the precision of the field as text.
    pub(crate) fn why(&self) -> String {
        let FieldSummary { pictures, rounding, result, least, .. } = self;
        let against = |psnr: f64, what: &str| format!("{} {what}", decibels_text(psnr, 1));
        let result = result.map_or(String::new(), |psnr| {
            format!(", {}", against(psnr, "of the result with the exact field against the original"))
        });
        format!(
            "PSNR over {pictures} views: {}{result}; at least {least:.1} dB against the exact field required",
            against(*rounding, "against the exact field")
        )
    }
}

/// Quality gained by refinement.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RefinedSummary {
    /// Number of validation views, which are not used for fitting.
    pub pictures: usize,
    /// Mean PSNR against the original before refinement, dB.
    #[serde(deserialize_with = "number")]
    pub before: f64,
    /// Mean PSNR against the original after refinement, dB.
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

/// Effect of lower SH degrees on renders of the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BandsSummary {
    /// SH degree of the output.
    pub sh_degree: usize,
    /// Number of compared views.
    pub pictures: usize,
    /// Tried lower SH degrees, each with the mean PSNR of its renders against those with all degrees, dB.
    #[serde(deserialize_with = "sizes")]
    pub tried: Vec<(usize, f64)>,
    /// Mean PSNR of renders with all SH degrees against the original, dB.
    #[serde(deserialize_with = "number")]
    pub result: f64,
    /// Minimum PSNR that a lower degree needed to be chosen, dB.
    #[serde(deserialize_with = "number")]
    pub least: f64,
}

impl BandsSummary {
    /// Returns the reason for the SH degree as text.
    pub(crate) fn why(&self) -> String {
        let BandsSummary { pictures, tried, result, least, .. } = self;
        let line = |(degree, apart): &(usize, f64)| format!("{} at degree {degree}", decibels_text(*apart, 1));
        let tried: Vec<String> = tried.iter().map(line).collect();
        format!(
            "PSNR over {pictures} views: {} against all degrees, {} of the result with all degrees against the \
             original; at least {least:.1} dB against all degrees required",
            tried.join(", "),
            decibels_text(*result, 1)
        )
    }
}

/// Range of an estimated value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Range {
    /// Lower bound; smaller values are unlikely.
    pub least: f64,
    /// Expected value.
    pub likely: f64,
    /// Upper bound; larger values are unlikely.
    pub most: f64,
}

/// Expected processor time of a stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageForecast {
    /// Name of the stage.
    pub name: String,
    /// Expected time of all processors together, seconds.
    pub core_seconds: f64,
}

/// Expected time and memory of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// Wall-clock time, seconds.
    pub seconds: Range,
    /// Time of all processors together, seconds.
    pub core_seconds: Range,
    /// Number of threads.
    pub threads: u64,
    /// Whether the forecast is based on a calibration on this machine.
    pub measured: bool,
    /// Maximum memory, bytes.
    pub memory_bytes: u64,
    /// Forecasts of all stages in order.
    pub stages: Vec<StageForecast>,
}

/// Percentiles of a term of the score.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TermSummary {
    /// Name of the term, see [`Quantity::name`](crate::statistics::score::Graded::name).
    pub name: String,
    /// 1st percentile.
    #[serde(deserialize_with = "number")]
    pub p1: f64,
    /// 99th percentile.
    #[serde(deserialize_with = "number")]
    pub p99: f64,
    /// Whether the percentiles differ. If they are equal, the term only splits Gaussians into two groups.
    pub active: bool,
}

/// Counts of unusual Gaussians.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct FlagSummary {
    /// Gaussians with NaN or infinity in some frame.
    pub non_finite: usize,
    /// Gaussians with a zero quaternion in some frame.
    pub zero_rotation: usize,
    /// Gaussians whose motion D was set to 0 as rounding noise.
    pub snapped_d: usize,
    /// Gaussians whose curvature κ was set to 0 as rounding noise.
    pub snapped_kappa: usize,
    /// Gaussians that are never alive.
    pub never_alive: usize,
    /// Gaussians that are in no scored view.
    pub never_in_view: usize,
}
