//! Everything a report shows, as data.

use serde::Serialize;

use super::failure::FailureMode;
use super::film::FilmPanel;
use super::histogram::Histogram;
use super::shown::Choice;
use crate::evaluation::found::{Evaluation, PictureScores};
use crate::evaluation::precision::PrecisionDiagram;
use crate::evaluation::trade_off::TradeOff;

/// Everything the page shows, as data.
#[derive(Debug, Serialize)]
pub struct ReportData {
    /// Program and version.
    pub tool: String,
    /// The result in a sentence or two.
    pub verdict: String,
    /// Means overall, by view and by frame.
    pub evaluation: Evaluation,
    /// The scores of every picture.
    pub pictures: Vec<PictureScores>,
    /// Pictures that the page shows.
    pub shown: Vec<Choice>,
    /// Films that it shows.
    pub films: Vec<FilmPanel>,
    /// The failure modes, by [`super::traits::GaussianKind::ALL`].
    pub failure_modes: Vec<FailureMode>,
    /// The scores of what was kept, merged and dropped; none where that is not known.
    pub histograms: Option<Vec<Histogram>>,
    /// The run's `summary.json` as it stands.
    pub run: Option<serde_json::Value>,
    /// What was not found beside the result, and why.
    pub missing: Vec<String>,
    /// A sweep over the original.
    pub trade_off: Option<TradeOff>,
    /// Work-precision diagrams of the original.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub precision: Option<PrecisionDiagram>,
    /// Things a person should know.
    pub notes: Vec<String>,
    /// The same of the work folder, which are no part of the result.
    #[serde(skip)]
    pub work_notes: Vec<String>,
}

/// Part of both models' pictures where a failure mode is worst.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Close {
    /// Index into the failure modes.
    pub(super) mode: usize,
    /// Its upper left pixel.
    pub(super) corner: (u32, u32),
    /// PSNR inside, dB.
    pub(super) psnr: f64,
    /// Data URIs: original, compressed.
    pub(super) images: [String; 2],
}
