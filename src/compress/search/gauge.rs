//! What the quality of a reduction is measured by, and what of it is held back.

use rayon::prelude::*;

use crate::compress::refine::targets::{Targets, mean_square};
use crate::error::{Error, Result};
use crate::metrics::{decibels, psnr};
use crate::model::{Camera, Picture};
use crate::render::render;
use crate::scene::Scene;
use crate::scene::photographs::Photographs;
use crate::source::FrameSource;
use crate::stream::{Batch, Subject, show};

/// Mean PSNR, dB, by the pictures that are searched on, and by those held back.
pub(super) type Found = [f64; 2];

/// What pictures are compared with.
pub(super) enum With<'a> {
    /// The original's own, by their numbers.
    Original(&'a Targets, Vec<usize>),
    /// Photographs.
    Photographs(Photographs),
}

/// Pictures that models are measured on.
pub(super) struct Gauge<'a> {
    scene: &'a Scene,
    cameras: &'a [Camera],
    /// By frame, and whether each is held back.
    pictures: Vec<(Picture, bool)>,
    with: With<'a>,
}

impl<'a> Gauge<'a> {
    /// By `pictures`, by frame, of which some are held back.
    ///
    /// # Errors
    /// None that is held back, or none that is not.
    pub(super) fn new(
        scene: &'a Scene,
        cameras: &'a [Camera],
        pictures: Vec<(Picture, bool)>,
        with: With<'a>,
    ) -> Result<Gauge<'a>> {
        let held = pictures.iter().filter(|picture| picture.1).count();
        if held == 0 || held == pictures.len() {
            let found = pictures.len();
            return Err(Error::usage(format!(
                "a quality is searched on some pictures and reported by others: expected 4 or more, found {found}"
            )));
        }
        Ok(Gauge { scene, cameras, pictures, with })
    }

    /// How close what `source` shows is.
    ///
    /// # Errors
    /// Frames or photographs that cannot be read.
    pub(super) fn measure(&self, source: &dyn FrameSource) -> Result<Found> {
        let background = self.scene.background;
        let pictures: Vec<Picture> = self.pictures.iter().map(|picture| picture.0).collect();
        let mut found = Vec::with_capacity(pictures.len());
        show([Subject::all(source)], self.cameras, &pictures, Batch::of_frame(&self.scene.limits), |views| {
            let first = found.len();
            let of_view = |(place, view): (usize, &crate::stream::View<'_, 1>)| {
                let picture = render(view.states[0], view.camera, background);
                match &self.with {
                    With::Photographs(photographs) => {
                        Ok(psnr(&picture, &photographs.read(view.picture, view.camera, background)?))
                    }
                    With::Original(targets, numbers) => {
                        Ok(decibels(mean_square(&picture, &targets.values(numbers[first + place])?)))
                    }
                }
            };
            let of_batch: Vec<f64> = views.par_iter().enumerate().map(of_view).collect::<Result<_>>()?;
            found.extend(of_batch);
            Ok(())
        })?;
        Ok([false, true].map(|held| {
            let of: Vec<f64> =
                found.iter().zip(&self.pictures).filter(|(_, of)| of.1 == held).map(|of| *of.0).collect();
            of.iter().sum::<f64>() / of.len() as f64
        }))
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
