//! Measures how good a selection of Gaussians is: compares its renders with renders of the whole model, from test
//! views, which were not used for ranking or fitting. A scene without test views is judged from all its views.

use rayon::prelude::*;

use crate::error::Result;
use crate::metrics::psnr;
use crate::model::{Attributes, Camera, FrameView};
use crate::passes::{BatchLimits, RenderedSource, for_each_view_batch};
use crate::render::{Image, render};
use crate::scene::Scene;
use crate::scene::view_selection::{ViewSet, select_views};
use crate::source::Ids;

/// Maximum number of views on which quality is measured.
const MAX_VIEWS: usize = 24;

/// Renders of the whole model, with which renders of a selection of its Gaussians are compared.
///
/// Memory: 12 bytes for every pixel of at most 24 views.
pub(super) struct Judge {
    views: Vec<FrameView>,
    originals: Vec<Image>,
}

/// Quality of renders of a selection of Gaussians, compared with renders of the whole model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct JudgedQuality {
    /// Root mean square error over all pixels, color channels and views; color values are from 0 to 1.
    pub(super) error: f64,
    /// Mean PSNR over the views, in dB.
    pub(super) psnr: f64,
}

impl Judge {
    /// Renders the held-out views of `scene` (test views, else validation views), or all views if none are held out: at
    /// most [`MAX_VIEWS`] of them, evenly spaced. Returns these renders as the reference for [`Judge::quality`].
    ///
    /// # Errors
    /// Fails if the cameras have no views or if a frame cannot be read.
    pub(super) fn new(scene: &Scene) -> Result<Judge> {
        let all = select_views(&scene.rig, &scene.source().info().times, ViewSet::HeldOut)?;
        let count = all.len().min(MAX_VIEWS);
        let views: Vec<FrameView> = (0..count).map(|k| all[(2 * k + 1) * all.len() / (2 * count)]).collect();
        let mut originals = Vec::with_capacity(count);
        render_views(scene, RenderedSource::all_gaussians(scene.source()), &views, |image| originals.push(image))?;
        Ok(Judge { views, originals })
    }

    /// Returns the bytes of memory that the renders of a [`Judge`] take if each view has `pixels` pixels.
    pub(super) fn bytes(pixels: u64) -> u64 {
        12 * pixels * MAX_VIEWS as u64
    }

    /// Returns the number of views on which quality is measured.
    pub(super) fn view_count(&self) -> usize {
        self.views.len()
    }

    /// Renders only the Gaussians of `scene` with the ids `kept`, and compares these renders with those of the whole
    /// model. Returns their error and PSNR.
    ///
    /// # Errors
    /// Fails if a frame cannot be read.
    pub(super) fn quality(&self, scene: &Scene, kept: &[u32]) -> Result<JudgedQuality> {
        let subject = RenderedSource { source: scene.source(), ids: Some(Ids::List(kept)), columns: Attributes::all() };
        let mut originals = self.originals.iter();
        let mut found = Vec::with_capacity(self.originals.len());
        render_views(scene, subject, &self.views, |image| found.extend(originals.next().map(|of| psnr(&image, of))))?;
        Ok(JudgedQuality::from_psnr(&found))
    }
}

impl JudgedQuality {
    /// Computes the quality over all views (root mean square error and mean PSNR) from the PSNR of each view, in dB.
    /// The squared error of a view follows from its PSNR. All views must have the same number of pixels.
    pub(super) fn from_psnr(psnr: &[f64]) -> JudgedQuality {
        let count = psnr.len().max(1) as f64;
        let mean_square = psnr.iter().map(|psnr| 10f64.powf(-psnr / 10.0)).sum::<f64>() / count;
        JudgedQuality { error: mean_square.sqrt(), psnr: psnr.iter().sum::<f64>() / count }
    }
}

/// Renders `subject`, a model or some of its Gaussians, in each of `views` and passes the images to `take`, in order.
fn render_views(
    scene: &Scene,
    subject: RenderedSource<'_>,
    views: &[FrameView],
    mut take: impl FnMut(Image),
) -> Result<()> {
    let cameras: &[Camera] = &scene.schedule.cameras;
    for_each_view_batch([subject], cameras, views, BatchLimits::one_frame(&scene.limits), |batch| {
        let images: Vec<Image> =
            batch.par_iter().map(|view| render(view.states[0], view.camera, scene.background)).collect();
        images.into_iter().for_each(&mut take);
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squared_errors_and_decibels_are_averaged() {
        // The root mean square errors of these PSNRs are a tenth and a hundredth of the range of colors.
        let JudgedQuality { error, psnr } = JudgedQuality::from_psnr(&[20.0, 40.0]);
        assert!((error - (0.5f64 * (0.01 + 0.0001)).sqrt()).abs() < 1e-15, "{error}");
        assert_eq!((psnr, JudgedQuality::from_psnr(&[f64::INFINITY]).error), (30.0, 0.0));
    }
}
