//! One result with everything that the page shows of it.

use super::film::FilmPanel;
use super::findings::{Close, ResultData};
use super::run::RunFiles;
use super::shown::ShownImage;

/// Comparison of one result with the original.
pub(super) struct Analysis {
    /// Data of the result.
    pub(super) data: ResultData,
    /// Files beside the result.
    pub(super) run: RunFiles,
    /// Images of the chosen renders.
    pub(super) shown: Vec<ShownImage>,
    /// Animations.
    pub(super) films: Vec<FilmPanel>,
    /// Worst parts of the failure modes.
    pub(super) close: Vec<Close>,
}
