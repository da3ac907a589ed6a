//! Records that stages write during a run, for the summary of the run.

use bytesize::ByteSize;
use serde::{Deserialize, Deserializer, Serialize};

use crate::metrics::decibels_text;
use crate::progress::format_duration;
use crate::source::ReadCounts;

/// Time, memory, reads and counts of one stage of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageRecord {
    /// Name of the stage.
    pub name: String,
    /// Number of Gaussians before the stage.
    pub gaussians_in: usize,
    /// Number of Gaussians after the stage.
    pub gaussians_out: usize,
    /// Amounts that the stage read from the input, counted by the code that reads.
    pub reads: ReadCounts,
    /// Amount that the stage read from the input, as a multiple of one full read (every frame once). It is measured in
    /// bytes if the input is stored in tiles (compressed blocks), otherwise in states (one Gaussian at one frame).
    pub full_reads: f64,
    /// Number of bytes read back from scratch files, which are not part of the input.
    pub scratch_bytes: u64,
    /// Whether the result came from the cache. If so, times and reads are from the run that computed it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    #[serde(rename = "kept")]
    pub from_cache: bool,
    /// Wall-clock time of the stage, seconds.
    pub seconds: f64,
    /// Processor time of the stage, summed over all processors, seconds; `None` if the system does not report it.
    pub processor_seconds: Option<f64>,
    /// Largest resident memory of the process from its start to the end of this stage, bytes; `None` if the system does
    /// not report it.
    pub peak_memory_bytes: Option<u64>,
}

/// Stage or step that a run omitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OmittedWork {
    /// Name of the omitted work.
    pub what: String,
    /// Reason for omitting the work.
    pub why: String,
    /// Time, reads or bytes that were saved, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub saved: Option<SavedCost>,
}

/// Cost (time and reads, or bytes) that was saved because work was omitted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SavedCost {
    /// Estimated cost of a whole stage.
    Stage {
        /// Estimated wall-clock time of the stage when all threads are busy, seconds.
        seconds: f64,
        /// Maximum amount that the stage would have read, in full reads (every frame of the input once).
        reads: f64,
    },
    /// Cost of values that were not read again, because their attribute is the same in every frame.
    Values {
        /// Number of bytes of the values that were not read again.
        bytes: u64,
    },
}

impl SavedCost {
    /// Formats the saved cost for display, such as "about 12.0 s, 1.00 full reads".
    pub fn text(self) -> String {
        match self {
            SavedCost::Stage { seconds, reads } => format!("about {}, {reads:.2} full reads", format_duration(seconds)),
            SavedCost::Values { bytes } => format!("{} of values", ByteSize(bytes).display().si()),
        }
    }
}

impl OmittedWork {
    /// Returns the reason why work was omitted and the saved cost (time and reads, or bytes) as text for display.
    pub fn reason(&self) -> String {
        match self.saved {
            Some(saved) => format!("{}; saves {}", self.why, saved.text()),
            None => self.why.clone(),
        }
    }
}

/// Deserializes pairs of an integer and a number, such as a number of Gaussians and a PSNR. If the number is null,
/// which JSON writes for numbers that are not finite, it becomes NaN.
pub(crate) fn sizes<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<Vec<(usize, f64)>, D::Error> {
    let found = Vec::<(usize, Option<f64>)>::deserialize(from)?;
    Ok(found.into_iter().map(|(size, value)| (size, value.unwrap_or(f64::NAN))).collect())
}

/// Deserializes a number; null, which JSON writes for numbers that are not finite, becomes NaN.
pub(crate) fn number<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(from)?.unwrap_or(f64::NAN))
}

/// Effect on renders of writing the deformation field of the result in half precision (2 bytes per value).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FieldPrecisionSummary {
    /// Whether the deformation field is written in half precision.
    pub half: bool,
    /// Number of views on which renders were compared.
    pub views: usize,
    /// Mean PSNR of renders with the half-precision deformation field, compared with renders with the exact field, dB.
    #[serde(deserialize_with = "number")]
    pub rounding: f64,
    /// Mean PSNR of renders with the exact deformation field, compared with renders of the original, dB; `None` if it
    /// was not measured, because `rounding` is so high (60 dB or more) that half precision is used in any case.
    pub result: Option<f64>,
    /// Minimum of `rounding`, dB, at which the deformation field is written in half precision. `rounding` is the PSNR
    /// of renders with the half-precision field against renders with the exact field.
    #[serde(deserialize_with = "number")]
    pub least: f64,
}

impl FieldPrecisionSummary {
    /// Returns a text with the measured values that explain why the deformation field is or is not written in half
    /// precision.
    pub(crate) fn why(&self) -> String {
        let FieldPrecisionSummary { views, rounding, result, least, .. } = self;
        let against = |psnr: f64, what: &str| format!("{} {what}", decibels_text(psnr, 1));
        let result = result.map_or(String::new(), |psnr| {
            format!(", {}", against(psnr, "of the result with the exact field against the original"))
        });
        format!(
            "PSNR over {views} views: {}{result}; at least {least:.1} dB against the exact field required",
            against(*rounding, "against the exact field")
        )
    }
}

/// PSNR before and after refinement, measured on validation views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RefinedSummary {
    /// Number of validation views, which are used to choose the best state but not to fit.
    pub views: usize,
    /// Mean PSNR before refinement, against renders of the original, dB.
    #[serde(deserialize_with = "number")]
    pub before: f64,
    /// Mean PSNR after refinement, against renders of the original, dB.
    #[serde(deserialize_with = "number")]
    pub result: f64,
}

/// PSNR against photographs before and after the model was fitted to photographs, measured on photographs that were
/// held back from the fit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PhotographSummary {
    /// Number of photographs that were held back, which are used to choose the best state but not to fit.
    pub photographs: usize,
    /// Mean PSNR before the fit, of the model refined toward renders, dB.
    #[serde(deserialize_with = "number")]
    pub before: f64,
    /// Mean PSNR after the fit, dB.
    #[serde(deserialize_with = "number")]
    pub result: f64,
}

/// Kind of the views on which the quality of a result was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ViewKind {
    /// Test views: used neither to fit nor to choose anything.
    Test,
    /// Validation views: the best state of refinement was chosen on them.
    Validation,
    /// Training views: Gaussians were ranked by their contribution to these views, so the quality may look too high.
    Training,
    /// Views of a virtual rig (cameras placed by the program), because the scene has no cameras.
    Virtual,
}

/// Time of rendering one view on one thread, milliseconds: median over views, without the evaluation of the deformation
/// field.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RenderTime {
    /// Render time of the original, milliseconds.
    pub before: f64,
    /// Render time of the result, milliseconds.
    pub after: f64,
}

/// Quality of renders of the result compared with renders of the original.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct QualitySummary {
    /// Kind of the views on which the quality was measured.
    pub kind: ViewKind,
    /// Number of views on which the quality was measured.
    pub views: usize,
    /// Mean PSNR of renders of the result against renders of the original, dB.
    #[serde(deserialize_with = "number")]
    pub psnr: f64,
    /// Mean SSIM of renders of the result against renders of the original; `None` if only the PSNR on validation views
    /// is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    /// Whether the quality is that of the result before it was converted to the format of the output, because the
    /// output was not read back. The output stores rounded values, fitted motion or no motion, so it may be worse.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub before_conversion: bool,
    /// Render times of the original and the result, if measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub render_ms: Option<RenderTime>,
}

/// Effect on renders of dropping SH degrees of the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShDegreeSummary {
    /// SH degree of the output.
    pub sh_degree: usize,
    /// Number of views on which renders were compared.
    pub views: usize,
    /// Lower SH degrees that were tried, each with the mean PSNR of its renders compared with renders with all degrees,
    /// dB.
    #[serde(deserialize_with = "sizes")]
    pub tried: Vec<(usize, f64)>,
    /// Mean PSNR of renders with all SH degrees compared with renders of the original, dB.
    #[serde(deserialize_with = "number")]
    pub result: f64,
    /// Minimum PSNR, dB, between renders with a lower SH degree and with all degrees. A degree in `tried` with a lower
    /// PSNR was rejected.
    #[serde(deserialize_with = "number")]
    pub least: f64,
}

impl ShDegreeSummary {
    /// Returns a text with the measured values that explain the SH degree of the output.
    pub(crate) fn why(&self) -> String {
        let ShDegreeSummary { views, tried, result, least, .. } = self;
        let line = |(degree, apart): &(usize, f64)| format!("{} at degree {degree}", decibels_text(*apart, 1));
        let tried: Vec<String> = tried.iter().map(line).collect();
        format!(
            "PSNR over {views} views: {} against all degrees, {} of the result with all degrees against the \
             original; at least {least:.1} dB against all degrees required",
            tried.join(", "),
            decibels_text(*result, 1)
        )
    }
}

/// Estimate of a quantity: its expected value, with a lower and an upper bound.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EstimateRange {
    /// Lower bound of the estimated quantity; smaller values are unlikely.
    pub least: f64,
    /// Expected value of the estimated quantity.
    pub likely: f64,
    /// Upper bound of the estimated quantity; larger values are unlikely.
    pub most: f64,
}

/// Expected processor time of one stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageForecast {
    /// Name of the stage.
    pub name: String,
    /// Expected processor time summed over all processors, seconds.
    pub core_seconds: f64,
}

/// Expected time and memory of a run, estimated before it begins.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// Expected wall-clock time, seconds.
    pub seconds: EstimateRange,
    /// Expected processor time summed over all processors, seconds.
    pub core_seconds: EstimateRange,
    /// Number of threads that the run uses.
    pub threads: u64,
    /// Expected peak memory of the process by the memory plan, bytes.
    pub memory_bytes: u64,
    /// Expected processor time of each stage, in the order of the stages.
    pub stages: Vec<StageForecast>,
}

/// Percentiles, over all Gaussians, of one term of the score by which Gaussians are ranked.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TermSummary {
    /// Name of the term of the score, as returned by
    /// [`ScoredQuantity::name`](crate::statistics::score::ScoredQuantity::name).
    pub name: String,
    /// First percentile: value that 1% of the Gaussians do not exceed.
    #[serde(deserialize_with = "number")]
    pub p1: f64,
    /// 99th percentile: value that 99% of the Gaussians do not exceed.
    #[serde(deserialize_with = "number")]
    pub p99: f64,
    /// Whether `p1` and `p99` differ. If they are equal, the normalized term is 1 for Gaussians above this value and 0
    /// for all others.
    pub active: bool,
}

/// Numbers of Gaussians with unusual values, one number for each kind of unusual value. A Gaussian can count for
/// several kinds.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct UnusualValueCounts {
    /// Number of Gaussians with NaN or infinity in some frame.
    pub non_finite: usize,
    /// Number of Gaussians with a zero quaternion as rotation in some frame.
    pub zero_rotation: usize,
    /// Number of Gaussians whose opacity logit is ±100 or beyond in some frame; infinite logits are read as ±100.
    pub infinite_logit: usize,
    /// Number of Gaussians whose motion D (root mean square step) was set to 0, because it was within rounding noise of
    /// the positions.
    pub snapped_d: usize,
    /// Number of Gaussians whose curvature of motion κ was set to 0, because it was within rounding noise of the
    /// positions.
    pub snapped_kappa: usize,
    /// Number of Gaussians that are never alive (opacity below `alpha_min` in every frame).
    pub never_alive: usize,
    /// Number of Gaussians that lie in no view by which Gaussians are scored.
    pub never_in_view: usize,
}
