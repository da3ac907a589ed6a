//! Comparison of one compressed model with the original, with everything that the report page shows of it.

use super::film::FilmPanel;
use super::findings::{ResultData, WorstPlaceImages};
use super::run::RunFiles;
use super::shown::ShownImage;

/// Comparison of one compressed model with the original, for the report page.
pub(super) struct Analysis {
    /// Scores, failure modes and notes of the compressed model.
    pub(super) data: ResultData,
    /// Files that `compress` left beside the compressed model.
    pub(super) run: RunFiles,
    /// Images of the renders that the page shows.
    pub(super) shown: Vec<ShownImage>,
    /// Animations that the page shows.
    pub(super) films: Vec<FilmPanel>,
    /// For each failure mode that can be judged, the images of the place where it is worst.
    pub(super) close: Vec<WorstPlaceImages>,
}
