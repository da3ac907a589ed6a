//! What the quality of a reduction is measured by, and what of it is held back.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::metrics::{decibels, psnr};
use crate::model::{Camera, Picture};
use crate::passes::{Batch, Subject, ViewStates, show};
use crate::refinement::targets::{Targets, mean_square};
use crate::render::render;
use crate::scene::Scene;
use crate::scene::photographs::Photographs;
use crate::source::FrameSource;

/// What pictures are compared with.
pub(super) enum With<'a> {
    /// The original's own, by their numbers.
    Original(&'a Targets, Vec<usize>),
    /// Photographs.
    Photographs(Photographs),
}

/// Pictures that models are measured on.
pub(super) struct QualityMeter<'a> {
    scene: &'a Scene,
    cameras: &'a [Camera],
    /// By frame, and whether each is held back.
    pictures: Vec<(Picture, bool)>,
    with: With<'a>,
}

impl<'a> QualityMeter<'a> {
    /// By `pictures`, by frame, of which some are held back.
    ///
    /// # Errors
    /// None that is held back, or none that is not.
    pub(super) fn new(
        scene: &'a Scene,
        cameras: &'a [Camera],
        pictures: Vec<(Picture, bool)>,
        with: With<'a>,
    ) -> Result<QualityMeter<'a>> {
        let held = pictures.iter().filter(|picture| picture.1).count();
        if held == 0 || held == pictures.len() {
            let found = pictures.len();
            return Err(Error::usage(format!(
                "a quality is searched on some pictures and reported by others: expected 4 or more, found {found}"
            )));
        }
        Ok(QualityMeter { scene, cameras, pictures, with })
    }

    /// Mean PSNR, dB, of what `source` shows, by the pictures that are searched on or by those held back.
    ///
    /// # Errors
    /// Frames or photographs that cannot be read.
    pub(super) fn measure(&self, source: &dyn FrameSource, held: bool) -> Result<f64> {
        let background = self.scene.background;
        let places: Vec<usize> = (0..self.pictures.len()).filter(|&k| self.pictures[k].1 == held).collect();
        let pictures: Vec<Picture> = places.iter().map(|&k| self.pictures[k].0).collect();
        let mut found = Vec::with_capacity(pictures.len());
        show([Subject::all(source)], self.cameras, &pictures, Batch::of_frame(&self.scene.limits), |views| {
            let first = found.len();
            let of_view = |(place, view): (usize, &ViewStates<'_, 1>)| {
                match &self.with {
                    With::Photographs(photographs) => {
                        let picture = view.render(0, background);
                        Ok(psnr(&picture, &photographs.read(view.picture, view.camera, background)?))
                    }
                    With::Original(targets, numbers) => {
                        // As the targets are made.
                        let picture = render(view.states[0], view.camera, background);
                        Ok(decibels(mean_square(&picture, &targets.values(numbers[places[first + place]])?)))
                    }
                }
            };
            let of_batch: Vec<f64> = views.par_iter().enumerate().map(of_view).collect::<Result<_>>()?;
            found.extend(of_batch);
            Ok(())
        })?;
        Ok(found.iter().sum::<f64>() / found.len() as f64)
    }

    /// How many pictures are searched on.
    pub(super) fn searched(&self) -> usize {
        self.pictures.iter().filter(|picture| !picture.1).count()
    }

    /// Names of the pictures held back: frame and view; of those in between the scene's cameras the frame.
    pub(super) fn held(&self) -> Vec<String> {
        let name = |picture: &Picture| match picture.view {
            u32::MAX => format!("t{:03}_between", picture.frame),
            _ => picture.name(),
        };
        self.pictures.iter().filter(|picture| picture.1).map(|(picture, _)| name(picture)).collect()
    }
}
