//! Data of a report.

use serde::Serialize;

use super::failure::FailureMode;
use super::film::FilmPanel;
use super::histogram::Histogram;
use super::shown::Choice;
use crate::evaluation::found::{Evaluation, PictureScores};
use crate::evaluation::precision::PrecisionDiagram;
use crate::evaluation::trade_off::TradeOff;
use crate::journal::records::RenderTime;

/// Content of `report.json`. The first result's values stand at the top level.
#[derive(Debug, Serialize)]
pub struct ReportData {
    /// Program and version.
    pub tool: String,
    /// The first result.
    #[serde(flatten)]
    pub result: ResultData,
    /// Renders that the page shows.
    pub shown: Vec<Choice>,
    /// Animations that the page shows.
    pub films: Vec<FilmPanel>,
    /// Sweep over the original.
    pub trade_off: Option<TradeOff>,
    /// Work-precision diagrams of the original.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub precision: Option<PrecisionDiagram>,
    /// Further results, in the order of the command line.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub others: Vec<ResultData>,
}

/// Data of one result.
#[derive(Debug, Serialize)]
pub struct ResultData {
    /// The verdict: two or three sentences.
    pub verdict: String,
    /// Means overall, by view and by frame.
    pub evaluation: Evaluation,
    /// Scores of every render.
    pub pictures: Vec<PictureScores>,
    /// Time of a render before and after, where it was measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub render_time: Option<RenderTime>,
    /// For each kind of Gaussian (fast, thin, …), in the order of [`super::traits::GaussianKind::ALL`], whether the loss shows
    /// where Gaussians of this kind are visible.
    pub failure_modes: Vec<FailureMode>,
    /// Histograms of the scores by fate; `None` without an index map.
    pub histograms: Option<Vec<Histogram>>,
    /// Content of the run's `summary.json`.
    pub run: Option<serde_json::Value>,
    /// Files that were not found beside the result, with the reason.
    pub missing: Vec<String>,
    /// Notes for a person.
    pub notes: Vec<String>,
    /// Notes of the cache, which are no part of the result.
    #[serde(skip)]
    pub work_notes: Vec<String>,
}

/// Part of a render of both models where a failure mode is worst.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Close {
    /// Index into the failure modes.
    pub(super) mode: usize,
    /// Upper left pixel of the part.
    pub(super) corner: (u32, u32),
    /// PSNR inside, dB.
    pub(super) psnr: f64,
    /// Data URIs: original, compressed.
    pub(super) images: [String; 2],
}
