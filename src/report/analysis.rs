//! Comparison of one compressed model with the original: image quality, renders and animations that the report page
//! shows.

use super::film::FilmPanel;
use super::findings::{CompressedModelData, WorstPlaceImages};
use super::run::RunFiles;
use super::shown_images::ShownImage;

/// Comparison of one compressed model with the original, for the report page.
pub(super) struct Analysis {
    /// Image quality, failure modes and notes of the compressed model.
    pub(super) data: CompressedModelData,
    /// Files that `compress` wrote beside the compressed model.
    pub(super) run: RunFiles,
    /// Renders that the page shows, as images.
    pub(super) shown: Vec<ShownImage>,
    /// Animations that the page shows for this compressed model.
    pub(super) films: Vec<FilmPanel>,
    /// Images of the places with the worst damage: one pair of images for each failure mode that can be judged.
    pub(super) worst_places: Vec<WorstPlaceImages>,
}
