//! Measurement of the quality of a compressed model during the search for the smallest model with a requested quality.
//! The search compares models on some of the views. The other views are held back from the search, and give the quality
//! that is reported.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::metrics::{decibels, psnr};
use crate::model::{Camera, FrameView};
use crate::passes::{BatchLimits, RenderableView, RenderedSource, for_each_view_batch};
use crate::refinement::targets::{Targets, mean_square};
use crate::render::render;
use crate::scene::Scene;
use crate::scene::photographs::Photographs;
use crate::source::FrameSource;

/// Images with which renders of a compressed model are compared.
pub(super) enum QualityReference<'a> {
    /// Renders of the original model. First field: stored renders. Second field: for each view of the quality meter,
    /// the index of its render among the stored renders.
    Original(&'a Targets, Vec<usize>),
    /// Photographs of the scene.
    Photographs(Photographs),
}

/// Views on which the PSNR of compressed models is measured, with the images to which renders of the models are
/// compared.
pub(super) struct QualityMeter<'a> {
    scene: &'a Scene,
    cameras: &'a [Camera],
    /// Views, in order of frames. Second element of each pair: whether the view is held back from the search for the
    /// smallest model, to report the quality.
    views: Vec<(FrameView, bool)>,
    comparison: QualityReference<'a>,
}

impl<'a> QualityMeter<'a> {
    /// Creates a quality meter, which measures the PSNR of compressed models on `views` of `cameras`.
    /// - `views`: views in the order of frames. Second element of each pair: whether the view is held back from the
    ///   search for the smallest model, to report the quality.
    /// - `comparison`: images with which renders of the models are compared.
    ///
    /// # Errors
    /// Fails if no view is held back from the search, or if every view is.
    pub(super) fn new(
        scene: &'a Scene,
        cameras: &'a [Camera],
        views: Vec<(FrameView, bool)>,
        comparison: QualityReference<'a>,
    ) -> Result<QualityMeter<'a>> {
        let held = views.iter().filter(|view| view.1).count();
        if held == 0 || held == views.len() {
            let found = views.len();
            return Err(Error::usage(format!(
                "a search for a quality uses some views to search and others to report: expected 4 or more views, \
                 found {found}"
            )));
        }
        Ok(QualityMeter { scene, cameras, views, comparison })
    }

    /// Returns the mean PSNR, dB, of renders of the model `source` against the images of the meter (renders of the
    /// original, or photographs). If `on_held_views` is true, uses the views that are held back from the search for the
    /// smallest model; otherwise uses the views of the search.
    ///
    /// # Errors
    /// Fails if frames or photographs cannot be read.
    pub(super) fn measure(&self, source: &dyn FrameSource, on_held_views: bool) -> Result<f64> {
        let background = self.scene.background;
        let places: Vec<usize> = (0..self.views.len()).filter(|&k| self.views[k].1 == on_held_views).collect();
        let views: Vec<FrameView> = places.iter().map(|&k| self.views[k].0).collect();
        let mut psnrs = Vec::with_capacity(views.len());
        for_each_view_batch(
            [RenderedSource::all_gaussians(source)],
            self.cameras,
            &views,
            BatchLimits::one_frame(&self.scene.limits),
            |batch| {
                let first = psnrs.len();
                let view_psnr = |(place, view): (usize, &RenderableView<'_, 1>)| {
                    match &self.comparison {
                        QualityReference::Photographs(photographs) => {
                            let image = view.render(0, background);
                            Ok(psnr(&image, &photographs.read(view.frame_view, view.camera, background)?))
                        }
                        QualityReference::Original(targets, numbers) => {
                            // Must be rendered in the same way as the targets.
                            let image = render(view.states[0], view.camera, background);
                            Ok(decibels(mean_square(
                                &image,
                                &targets.values(numbers[places[first + place]], targets.strides())?,
                            )))
                        }
                    }
                };
                let of_batch: Vec<f64> = batch.par_iter().enumerate().map(view_psnr).collect::<Result<_>>()?;
                psnrs.extend(of_batch);
                Ok(())
            },
        )?;
        Ok(psnrs.iter().sum::<f64>() / psnrs.len() as f64)
    }

    /// Returns the number of views on which the search for the smallest model compares models. Views that are held back
    /// from the search are not counted.
    pub(super) fn search_view_count(&self) -> usize {
        self.views.iter().filter(|view| !view.1).count()
    }

    /// Returns the names of the views that are held back from the search for the smallest model. A name has the form
    /// `tNNN_vNN` (frame, view number). A view from a camera between two cameras of the scene has no view number; its
    /// name is `tNNN_between`.
    pub(super) fn held_back_names(&self) -> Vec<String> {
        let name = |view: &FrameView| match view.view {
            u32::MAX => format!("t{:03}_between", view.frame),
            _ => view.name(),
        };
        self.views.iter().filter(|view| view.1).map(|(view, _)| name(view)).collect()
    }
}
