//! Quality of a compressed model, measured on views for the search and on views held back for the report.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::metrics::{decibels, psnr};
use crate::model::{Camera, FrameView};
use crate::passes::{Batch, RenderedSource, ViewStates, show};
use crate::refinement::targets::{Targets, mean_square};
use crate::render::render;
use crate::scene::Scene;
use crate::scene::photographs::Photographs;
use crate::source::FrameSource;

/// Images that renders of a model are compared with.
pub(super) enum QualityReference<'a> {
    /// Renders of the original: targets, and the indices of the views among them.
    Original(&'a Targets, Vec<usize>),
    /// Photographs of the scene.
    Photographs(Photographs),
}

/// Set of views on which models are measured.
pub(super) struct QualityMeter<'a> {
    scene: &'a Scene,
    cameras: &'a [Camera],
    /// Views in order of frames; the flag tells whether a view is held back.
    pictures: Vec<(FrameView, bool)>,
    comparison: QualityReference<'a>,
}

impl<'a> QualityMeter<'a> {
    /// Returns a meter for `pictures`, in order of frames, each with a flag that tells whether it is held back.
    ///
    /// # Errors
    /// Fails if no view is held back, or all are.
    pub(super) fn new(
        scene: &'a Scene,
        cameras: &'a [Camera],
        pictures: Vec<(FrameView, bool)>,
        comparison: QualityReference<'a>,
    ) -> Result<QualityMeter<'a>> {
        let held = pictures.iter().filter(|picture| picture.1).count();
        if held == 0 || held == pictures.len() {
            let found = pictures.len();
            return Err(Error::usage(format!(
                "a search for a quality uses some views to search and others to report: expected 4 or more views, \
                 found {found}"
            )));
        }
        Ok(QualityMeter { scene, cameras, pictures, comparison })
    }

    /// Returns the mean PSNR of renders of `source`, dB: on the views held back if `held`, otherwise on the views for
    /// the search.
    ///
    /// # Errors
    /// Fails if frames or photographs cannot be read.
    pub(super) fn measure(&self, source: &dyn FrameSource, held: bool) -> Result<f64> {
        let background = self.scene.background;
        let places: Vec<usize> = (0..self.pictures.len()).filter(|&k| self.pictures[k].1 == held).collect();
        let pictures: Vec<FrameView> = places.iter().map(|&k| self.pictures[k].0).collect();
        let mut found = Vec::with_capacity(pictures.len());
        show([RenderedSource::all(source)], self.cameras, &pictures, Batch::one_frame(&self.scene.limits), |views| {
            let first = found.len();
            let view_psnr = |(place, view): (usize, &ViewStates<'_, 1>)| {
                match &self.comparison {
                    QualityReference::Photographs(photographs) => {
                        let picture = view.render(0, background);
                        Ok(psnr(&picture, &photographs.read(view.picture, view.camera, background)?))
                    }
                    QualityReference::Original(targets, numbers) => {
                        // Rendered like the targets.
                        let picture = render(view.states[0], view.camera, background);
                        Ok(decibels(mean_square(&picture, &targets.values(numbers[places[first + place]])?)))
                    }
                }
            };
            let of_batch: Vec<f64> = views.par_iter().enumerate().map(view_psnr).collect::<Result<_>>()?;
            found.extend(of_batch);
            Ok(())
        })?;
        Ok(found.iter().sum::<f64>() / found.len() as f64)
    }

    /// Returns the number of views for the search.
    pub(super) fn search_view_count(&self) -> usize {
        self.pictures.iter().filter(|picture| !picture.1).count()
    }

    /// Returns the names of the views held back, made of frame and view. A view between the cameras of the scene is
    /// named by its frame.
    pub(super) fn held_back_names(&self) -> Vec<String> {
        let name = |picture: &FrameView| match picture.view {
            u32::MAX => format!("t{:03}_between", picture.frame),
            _ => picture.name(),
        };
        self.pictures.iter().filter(|picture| picture.1).map(|(picture, _)| name(picture)).collect()
    }
}
