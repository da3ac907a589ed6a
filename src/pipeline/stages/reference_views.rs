//! How close the pictures of an archive are to be to those of the result before, and how close they are.

use rayon::prelude::*;
use serde::Serialize;

use crate::error::{Error, Result};
use crate::metrics::{decibels_text, psnr};
use crate::model::Picture;
use crate::passes::{Batch, Subject, show, spread};
use crate::render::{Image, render};
use crate::scene::Scene;
use crate::source::FrameSource;

/// Fewest and most pictures that are looked at: fewer of large ones, ...
const PICTURES: [u64; 2] = [4, 12];
/// ... so that those of the result and of the original take so many bytes.
const PICTURE_BYTES: u64 = 128 << 20;
/// What an archive may cost against the original's pictures where nothing is asked for, dB.
const LOSS: f64 = 0.5;
/// Of a result whose pictures are closer to the original's than this, dB, nothing was lost that noise could hide behind:
/// then the archive's are to be as close to the result's.
const ENOUGH: f64 = 50.0;
/// What a search for a quality leaves for the archive, dB: a third of the pruning's squared error. Where both are traded
/// off best, errors go by how fast bytes fall with them: about three times as fast with the number of Gaussians.
pub(crate) const LEFT_BY_SEARCH: f64 = 1.2;
/// An archive may miss what it is asked for by less than this, dB.
const SHORT: f64 = 10.0;
/// Bytes of a pixel.
pub(crate) const PIXEL: u64 = 3 * size_of::<f32>() as u64;
/// Times that errors and bits are measured.
pub(crate) const ROUNDS: usize = 2;
/// Octaves by which a step follows one measurement, at most.
const FURTHEST: f64 = 2.5;
/// Errors are not told apart below this.
const LEAST_ERROR: f64 = 1e-14;
/// Octaves by which all steps become coarser in the end: the least and the most that is thought of, ...
pub(crate) const ADDED: [f64; 2] = [-2.0, 2.0];
/// ... and how often that range is halved.
pub(crate) const HALVINGS: usize = 6;
/// The same where so many bytes are asked for, the most first.
pub(crate) const BYTES_ADDED: [f64; 2] = [4.0, -4.0];
/// See [`BYTES_ADDED`].
pub(crate) const BYTES_HALVINGS: usize = 10;

/// How many pictures of so many pixels are looked at.
pub(crate) fn pictures(pixels: u64) -> u64 {
    let [fewest, most] = PICTURES;
    (PICTURE_BYTES / (2 * PIXEL * pixels.max(1))).clamp(fewest, most)
}

/// What an archive is asked for, beside what its own flag says.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub enum ArchiveTarget {
    /// Nothing.
    Nothing,
    /// To cost no more than this against the original's pictures, dB.
    Loss(f64),
    /// To take no more bytes than this.
    Bytes(u64),
}

/// What an archive is to be.
#[derive(Debug, Clone, Copy)]
pub(crate) enum QualityTarget {
    /// So close to the result's, dB.
    Close(f64),
    /// No more than so much further from the original's than the result's are, dB.
    Loss(f64),
    /// No more than so many bytes.
    Bytes(u64),
}

impl QualityTarget {
    /// For a result whose pictures are `level` from the original's, where its own flag says `psnr`.
    pub(crate) fn new(psnr: Option<f64>, asked: ArchiveTarget, level: f64) -> QualityTarget {
        match (psnr, asked) {
            (_, ArchiveTarget::Bytes(most)) => QualityTarget::Bytes(most),
            (Some(psnr), _) => QualityTarget::Close(psnr),
            (None, ArchiveTarget::Loss(loss)) if loss > 0.0 => QualityTarget::Loss(loss),
            (None, ArchiveTarget::Nothing) if level < ENOUGH => QualityTarget::Loss(LOSS),
            _ => QualityTarget::Close(ENOUGH),
        }
    }

    /// Whether an archive does whose pictures are so close to the result's and lose so much, dB, where [close](Aim::close)
    /// says `asked`.
    pub(crate) fn does(self, [psnr, loss]: [f64; 2], asked: f64) -> bool {
        match self {
            QualityTarget::Loss(most) => loss <= most,
            QualityTarget::Close(_) | QualityTarget::Bytes(_) => psnr >= asked,
        }
    }

    /// PSNR against the result's pictures, dB, that comes to where these are `level` from the original's.
    pub(crate) fn close(self, level: f64) -> f64 {
        match self {
            QualityTarget::Close(psnr) => psnr,
            // Squared errors add.
            QualityTarget::Loss(loss) => level - 10.0 * (10f64.powf(0.1 * loss) - 1.0).log10(),
            QualityTarget::Bytes(_) => QualityTarget::Loss(LEFT_BY_SEARCH).close(level.min(ENOUGH)),
        }
    }
}

/// Pictures of the result, which others are compared with.
pub(crate) struct ReferenceViews<'a> {
    scene: &'a Scene,
    pictures: Vec<Picture>,
    images: Vec<Image>,
}

impl ReferenceViews<'_> {
    pub(crate) fn new<'a>(scene: &'a Scene, source: &dyn FrameSource) -> Result<ReferenceViews<'a>> {
        let count = pictures(scene.workload().pixels) as usize;
        let mut looks = ReferenceViews { scene, pictures: spread(&scene.schedule, count, 1), images: Vec::new() };
        looks.images = looks.render(source, |_, image| image)?;
        Ok(looks)
    }

    fn render<T: Send>(&self, source: &dyn FrameSource, of: impl Fn(usize, Image) -> T + Sync) -> Result<Vec<T>> {
        let mut made = Vec::with_capacity(self.pictures.len());
        let batch = Batch::of_frame(&self.scene.limits);
        show([Subject::all(source)], &self.scene.schedule.cameras, &self.pictures, batch, |views| {
            let first = made.len();
            let view = |(k, view): (usize, &crate::passes::ViewStates<'_, 1>)| {
                of(first + k, render(view.states[0], view.camera, self.scene.background))
            };
            made.par_extend(views.par_iter().enumerate().map(view));
            Ok(())
        })?;
        Ok(made)
    }

    /// Mean PSNR, dB.
    pub(crate) fn psnr(&self, source: &dyn FrameSource) -> Result<f64> {
        let found = self.render(source, |k, image| psnr(&image, &self.images[k]))?;
        Ok(found.iter().sum::<f64>() / found.len().max(1) as f64)
    }

    /// Mean squared error.
    pub(crate) fn error(&self, source: &dyn FrameSource) -> Result<f64> {
        let found = self.render(source, |k, image| 10f64.powf(-0.1 * psnr(&image, &self.images[k])))?;
        Ok(found.iter().sum::<f64>() / found.len().max(1) as f64)
    }
}

/// Returns the PSNR of a result's pictures against the original's if it is a number.
///
/// # Errors
/// NaN, which says that some pixels are NaN.
pub(crate) fn measurable(psnr: f64) -> Result<f64> {
    if psnr.is_nan() {
        return Err(Error::usage(
            "an archive is made by its pictures: expected numbers in every pixel, found NaN in some\n  \
             --non-finite drop removes the Gaussians that are not finite; a .gseq holds them as they are",
        ));
    }
    Ok(psnr)
}

/// Confirms that an archive has about the PSNR against the result's pictures that it is `asked` for, dB; one that is to have
/// no more than so many bytes has what fits.
///
/// # Errors
/// One that has [`SHORT`] less than that or than [`ENOUGH`]: there are values that its grids cannot hold beside the others.
pub(crate) fn check_met(aim: QualityTarget, asked: f64, found: f64) -> Result<()> {
    let is_met = matches!(aim, QualityTarget::Bytes(_)) || found >= asked.min(ENOUGH) - SHORT;
    match is_met {
        true => Ok(()),
        false => Err(Error::usage(format!(
            "an archive's pictures cannot come as close to the result's as asked for: expected {asked:.1} dB, found {}\n  \
             some values may be far larger than all others: drop their Gaussians (--drop-ids), or write a .gseq",
            decibels_text(found, 1)
        ))),
    }
}

/// What `of` finds at the largest number between two, as far as halving their distance so often tells, that it finds
/// something at.
pub(crate) fn bisected<T>(
    [mut low, mut high]: [f64; 2],
    halvings: usize,
    of: impl Fn(f64) -> Result<Option<T>>,
) -> Result<Option<T>> {
    let mut best = None;
    for _ in 0..halvings {
        let middle = 0.5 * (low + high);
        match of(middle)? {
            Some(found) => (low, best) = (middle, Some(found)),
            None => high = middle,
        }
    }
    Ok(best)
}

/// Octaves by which a step that adds the squared error `found` becomes coarser, so that it adds about `error`.
pub(crate) fn balanced(error: f64, found: f64) -> f64 {
    (0.5 * (error / found.max(LEAST_ERROR)).log2()).clamp(-FURTHEST, FURTHEST)
}
