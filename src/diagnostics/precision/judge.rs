//! How close what is left comes to the whole, on pictures that nothing was ranked or fitted by.

use rayon::prelude::*;

use crate::error::Result;
use crate::metrics::psnr;
use crate::model::{Camera, Columns, Picture};
use crate::passes::{Batch, Subject, show};
use crate::render::{Image, render};
use crate::scene::Scene;
use crate::scene::pictures::{PictureSet, pictures};
use crate::source::Ids;

/// Pictures to judge by at most.
const PICTURES: usize = 24;

/// Pictures of the whole.
///
/// Memory: 12 bytes for every pixel of at most 24 pictures.
pub(super) struct Judge {
    pictures: Vec<Picture>,
    originals: Vec<Image>,
}

/// How close something comes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct JudgedQuality {
    /// Root mean square error over all pixels, channels and pictures, of colors from 0 to 1.
    pub(super) error: f64,
    /// Mean PSNR, dB.
    pub(super) psnr: f64,
}

impl Judge {
    /// The held-out pictures of `scene`, or some of them, evenly; where none are held out, of all.
    ///
    /// # Errors
    /// Cameras without pictures; frames that cannot be read.
    pub(super) fn new(scene: &Scene) -> Result<Judge> {
        let all = pictures(&scene.rig, &scene.source().info().times, PictureSet::HeldOut)?;
        let count = all.len().min(PICTURES);
        let pictures: Vec<Picture> = (0..count).map(|k| all[(2 * k + 1) * all.len() / (2 * count)]).collect();
        let mut originals = Vec::with_capacity(count);
        made(scene, Subject::all(scene.source()), &pictures, |image| originals.push(image))?;
        Ok(Judge { pictures, originals })
    }

    /// Bytes that it holds of pictures of `pixels` pixels.
    pub(super) fn bytes(pixels: u64) -> u64 {
        12 * pixels * PICTURES as u64
    }

    /// How many pictures there are.
    pub(super) fn pictures(&self) -> usize {
        self.pictures.len()
    }

    /// How close the Gaussians `kept` of `scene` come.
    ///
    /// # Errors
    /// Frames that cannot be read.
    pub(super) fn closeness(&self, scene: &Scene, kept: &[u32]) -> Result<JudgedQuality> {
        let subject = Subject { source: scene.source(), ids: Some(Ids::List(kept)), columns: Columns::all() };
        let mut originals = self.originals.iter();
        let mut found = Vec::with_capacity(self.originals.len());
        made(scene, subject, &self.pictures, |image| found.extend(originals.next().map(|of| psnr(&image, of))))?;
        Ok(JudgedQuality::from_psnr(&found))
    }
}

impl JudgedQuality {
    /// Of the PSNR of pictures of one size.
    pub(super) fn from_psnr(psnr: &[f64]) -> JudgedQuality {
        let count = psnr.len().max(1) as f64;
        let mean_square = psnr.iter().map(|psnr| 10f64.powf(-psnr / 10.0)).sum::<f64>() / count;
        JudgedQuality { error: mean_square.sqrt(), psnr: psnr.iter().sum::<f64>() / count }
    }
}

/// Renders `pictures` of `subject` and hands them on in order.
fn made(scene: &Scene, subject: Subject<'_>, pictures: &[Picture], mut take: impl FnMut(Image)) -> Result<()> {
    let cameras: &[Camera] = &scene.schedule.cameras;
    show([subject], cameras, pictures, Batch::of_frame(&scene.limits), |views| {
        let images: Vec<Image> =
            views.par_iter().map(|view| render(view.states[0], view.camera, scene.background)).collect();
        images.into_iter().for_each(&mut take);
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_pictures_add_up_in_squares_and_decibels_are_their_mean() {
        // A tenth and a hundredth of the range.
        let JudgedQuality { error, psnr } = JudgedQuality::from_psnr(&[20.0, 40.0]);
        assert!((error - (0.5f64 * (0.01 + 0.0001)).sqrt()).abs() < 1e-15, "{error}");
        assert_eq!((psnr, JudgedQuality::from_psnr(&[f64::INFINITY]).error), (30.0, 0.0));
    }
}
