//! Data of a report, as written to `report.json`.

use serde::Serialize;

use super::failure::FailureMode;
use super::film::FilmPanel;
use super::histogram::Histogram;
use super::shown_images::ChosenRender;
use crate::evaluation::precision::PrecisionDiagram;
use crate::evaluation::results::{Evaluation, ViewQuality};
use crate::evaluation::trade_off::TradeOff;
use crate::journal::records::RenderTime;

/// Content of `report.json`. The fields of [`ReportData::result`], the first compressed model, are at the top level of
/// the file.
#[derive(Debug, Serialize)]
pub struct ReportData {
    /// Name and version of the program.
    pub tool: String,
    /// Data of the first compressed model.
    #[serde(flatten)]
    pub result: CompressedModelData,
    /// Renders that the page shows, with the reasons for their choice.
    pub shown: Vec<ChosenRender>,
    /// Animations that the page shows.
    pub films: Vec<FilmPanel>,
    /// Result of the command `sweep` for the original model; `None` if the user gave no such result.
    pub trade_off: Option<TradeOff>,
    /// Result of the command `precision` for the original model; `None` if the user gave no such result.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub precision: Option<PrecisionDiagram>,
    /// Data of the further compressed models, in the order of the command line.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub others: Vec<CompressedModelData>,
}

/// Data of one compressed model in a report.
#[derive(Debug, Serialize)]
pub struct CompressedModelData {
    /// Verdict in two or three sentences: size of the model, how visible its differences from the original are, and
    /// failure modes.
    pub verdict: String,
    /// Comparison of renders with renders of the original (PSNR, SSIM and other measures): means over all views, for
    /// each view number and for each frame.
    pub evaluation: Evaluation,
    /// Image quality (PSNR, SSIM and other measures) of every compared render.
    pub view_scores: Vec<ViewQuality>,
    /// Time for rendering a view of the original and of the compressed model, if measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub render_time: Option<RenderTime>,
    /// Measurements of the failure modes (damage to one kind of Gaussian, such as fast or thin ones), in the order of
    /// [`super::gaussian_kinds::GaussianKind::ALL`]. Each states whether renders differ more where this kind is
    /// visible.
    pub failure_modes: Vec<FailureMode>,
    /// Histograms of the scores of kept, merged and dropped Gaussians; `None` without an index map (file that maps
    /// input to output Gaussians).
    pub histograms: Option<Vec<Histogram>>,
    /// Content of the file `summary.json` of the run that wrote the compressed model, if it was found.
    pub run: Option<serde_json::Value>,
    /// One text for each file of `compress` that is absent beside the compressed model or cannot be used: its name, and
    /// the reason.
    pub missing: Vec<String>,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Notes about the cache folder. They are shown to the user, but not written to the report.
    #[serde(skip)]
    pub work_notes: Vec<String>,
}

/// Images of the place where a failure mode is worst: the same square of a render of both models.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct WorstPlaceImages {
    /// Index of the failure mode in [`CompressedModelData::failure_modes`].
    pub(super) mode: usize,
    /// Column and row, in the full render, of the upper left pixel of the square where the failure mode is worst.
    pub(super) corner: (u32, u32),
    /// PSNR in dB of the compressed model against the original, inside the square where the failure mode is worst.
    pub(super) psnr: f64,
    /// Data URIs of two images of the square where the failure mode is worst: the original, then the compressed model.
    pub(super) images: [String; 2],
}
