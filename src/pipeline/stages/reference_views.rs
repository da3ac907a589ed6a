//! Quality targets of archives, and the views on which an archive is compared with the result before quantization.

use rayon::prelude::*;
use serde::Serialize;

use crate::error::{Error, Result};
use crate::metrics::{decibels_text, psnr};
use crate::model::FrameView;
use crate::passes::{BatchLimits, RenderedSource, for_each_view_batch, select_evenly};
use crate::render::Image;
use crate::scene::Scene;
use crate::source::FrameSource;

/// Minimum and maximum number of views on which an archive is compared. Between these, [`MAX_VIEW_BYTES`] decides.
const VIEW_COUNTS: [u64; 2] = [4, 12];
/// Maximum bytes of memory of all renders of the result and of the original, from which the number of compared views
/// follows.
const MAX_VIEW_BYTES: u64 = 128 << 20;
/// Maximum loss of PSNR against the original by quantization if the user requests nothing, dB.
const DEFAULT_LOSS: f64 = 0.5;
/// PSNR of the result against the original, dB, above which the errors of pruning are too small to hide quantization
/// noise. The archive then has to reach this PSNR against the result before quantization.
const ENOUGH_PSNR: f64 = 50.0;
/// Surplus of quality that a search for a quality leaves for quantization, dB. It corresponds to a third of the squared
/// error of pruning: at the best trade-off, errors are proportional to how fast bytes fall with them, which is about
/// three times as fast for the number of Gaussians as for quantization.
pub(crate) const ARCHIVE_HEADROOM: f64 = 1.2;
/// Maximum shortfall of the PSNR of an archive against its target, dB.
const MAX_SHORTFALL: f64 = 10.0;
/// Bytes of memory per pixel of a rendered view.
pub(crate) const BYTES_PER_PIXEL: u64 = 3 * size_of::<f32>() as u64;
/// Number of rounds in which the error and the bits of every group of values are measured and the quantization steps
/// adjusted.
pub(crate) const BALANCING_ROUNDS: usize = 2;
/// Maximum change of a quantization step after one measurement, octaves (doublings).
const MAX_STEP_CHANGE: f64 = 2.5;
/// Smallest squared error of renders that is distinguished from 0.
const MIN_ERROR: f64 = 1e-14;
/// Range of the final common change of all quantization steps, octaves (doublings), from finer to coarser.
pub(crate) const OCTAVE_RANGE: [f64; 2] = [-2.0, 2.0];
/// Number of times that [`OCTAVE_RANGE`] is halved to find the change.
pub(crate) const OCTAVE_HALVINGS: usize = 6;
/// Search range if the archive has a byte limit. At the end, all quantization steps are multiplied by one factor
/// 2^octaves, chosen so that the archive just fits the limit. First the coarsest, then the finest allowed number of
/// octaves.
pub(crate) const BYTES_OCTAVE_RANGE: [f64; 2] = [4.0, -4.0];
/// Number of times that [`BYTES_OCTAVE_RANGE`] is halved to find the change.
pub(crate) const BYTES_OCTAVE_HALVINGS: usize = 10;

/// Returns the number of views on which an archive is compared, for views of `pixels` pixels each.
pub(crate) fn pictures(pixels: u64) -> u64 {
    let [fewest, most] = VIEW_COUNTS;
    (MAX_VIEW_BYTES / (2 * BYTES_PER_PIXEL * pixels.max(1))).clamp(fewest, most)
}

/// What the goal of the run requires of an archive. The PSNR of the option `--archive-psnr` is passed separately.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub enum ArchiveTarget {
    /// The goal requires nothing.
    Nothing,
    /// Maximum loss of PSNR against the original by quantization, dB.
    Loss(f64),
    /// Maximum number of bytes of the archive.
    Bytes(u64),
}

/// Requirement that the quantization steps of an archive have to meet.
#[derive(Debug, Clone, Copy)]
pub(crate) enum QualityTarget {
    /// Minimum PSNR against the result before quantization, dB.
    Close(f64),
    /// Maximum loss of PSNR against the original, compared with the result before quantization, dB.
    Loss(f64),
    /// Maximum number of bytes of the archive.
    Bytes(u64),
}

impl QualityTarget {
    /// Returns the requirement for an archive of a result whose PSNR against the original is `level`, dB. `psnr` is the
    /// value of the option `--archive-psnr`, if given; `asked` is what the goal of the run requires.
    pub(crate) fn new(psnr: Option<f64>, asked: ArchiveTarget, level: f64) -> QualityTarget {
        match (psnr, asked) {
            (_, ArchiveTarget::Bytes(most)) => QualityTarget::Bytes(most),
            (Some(psnr), _) => QualityTarget::Close(psnr),
            (None, ArchiveTarget::Loss(loss)) if loss > 0.0 => QualityTarget::Loss(loss),
            (None, ArchiveTarget::Nothing) if level < ENOUGH_PSNR => QualityTarget::Loss(DEFAULT_LOSS),
            _ => QualityTarget::Close(ENOUGH_PSNR),
        }
    }

    /// Returns whether an archive meets the requirement. `psnr` is its PSNR against the result before quantization,
    /// `loss` its loss of PSNR against the original, both in dB. `asked` is the value of
    /// [`required_psnr`](QualityTarget::required_psnr).
    pub(crate) fn is_met_by(self, [psnr, loss]: [f64; 2], asked: f64) -> bool {
        match self {
            QualityTarget::Loss(most) => loss <= most,
            QualityTarget::Close(_) | QualityTarget::Bytes(_) => psnr >= asked,
        }
    }

    /// Returns the PSNR against the result before quantization, dB, that corresponds to the requirement. `level` is the
    /// PSNR of the result against the original, dB.
    pub(crate) fn required_psnr(self, level: f64) -> f64 {
        match self {
            QualityTarget::Close(psnr) => psnr,
            // The squared errors of pruning and of quantization add up.
            QualityTarget::Loss(loss) => level - 10.0 * (10f64.powf(0.1 * loss) - 1.0).log10(),
            QualityTarget::Bytes(_) => QualityTarget::Loss(ARCHIVE_HEADROOM).required_psnr(level.min(ENOUGH_PSNR)),
        }
    }
}

/// Renders of one model (usually the result before quantization), with which renders of other models are compared.
pub(crate) struct ReferenceViews<'a> {
    scene: &'a Scene,
    pictures: Vec<FrameView>,
    images: Vec<Image>,
}

impl ReferenceViews<'_> {
    pub(crate) fn new<'a>(scene: &'a Scene, source: &dyn FrameSource) -> Result<ReferenceViews<'a>> {
        let count = pictures(scene.workload().pixels) as usize;
        let mut reference_views =
            ReferenceViews { scene, pictures: select_evenly(&scene.schedule, count, 1), images: Vec::new() };
        reference_views.images = reference_views.render(source, |_, image| image)?;
        Ok(reference_views)
    }

    fn render<T: Send>(&self, source: &dyn FrameSource, finish: impl Fn(usize, Image) -> T + Sync) -> Result<Vec<T>> {
        let mut rendered = Vec::with_capacity(self.pictures.len());
        let batch = BatchLimits::one_frame(&self.scene.limits);
        for_each_view_batch(
            [RenderedSource::all(source)],
            &self.scene.schedule.cameras,
            &self.pictures,
            batch,
            |views| {
                let first = rendered.len();
                let view = |(k, view): (usize, &crate::passes::ViewStates<'_, 1>)| {
                    finish(first + k, view.render(0, self.scene.background))
                };
                rendered.par_extend(views.par_iter().enumerate().map(view));
                Ok(())
            },
        )?;
        Ok(rendered)
    }

    /// Returns the mean PSNR of renders of `source` against the reference renders, dB.
    pub(crate) fn psnr(&self, source: &dyn FrameSource) -> Result<f64> {
        let found = self.render(source, |k, image| psnr(&image, &self.images[k]))?;
        Ok(found.iter().sum::<f64>() / found.len().max(1) as f64)
    }

    /// Returns the mean squared error of renders of `source` against the reference renders.
    pub(crate) fn error(&self, source: &dyn FrameSource) -> Result<f64> {
        let found = self.render(source, |k, image| 10f64.powf(-0.1 * psnr(&image, &self.images[k])))?;
        Ok(found.iter().sum::<f64>() / found.len().max(1) as f64)
    }
}

/// Returns `psnr`, the PSNR of a result against the original, if it is a number.
///
/// # Errors
/// Fails if `psnr` is NaN, which means that some pixels are NaN.
pub(crate) fn check_measurable(psnr: f64) -> Result<f64> {
    if psnr.is_nan() {
        return Err(Error::usage(
            "the quantization of an archive is chosen by renders: expected numbers in every pixel, found NaN in \
             some\n  \
             --set non_finite=drop removes the Gaussians that are not finite; a .gseq holds them as they are",
        ));
    }
    Ok(psnr)
}

/// Checks that the PSNR `found` of an archive against the result before quantization is about as high as `asked`, dB.
/// An archive with a byte limit always passes.
///
/// # Errors
/// Fails if `found` is more than [`MAX_SHORTFALL`] below the smaller of `asked` and [`ENOUGH_PSNR`]. Then some values
/// are so large that a quantization grid for them cannot represent the others.
pub(crate) fn check_met(quality_target: QualityTarget, asked: f64, found: f64) -> Result<()> {
    let is_met = matches!(quality_target, QualityTarget::Bytes(_)) || found >= asked.min(ENOUGH_PSNR) - MAX_SHORTFALL;
    match is_met {
        true => Ok(()),
        false => Err(Error::usage(format!(
            "an archive cannot reach the requested PSNR against the result before quantization: expected {asked:.1} \
             dB, found {}\n  \
             some values may be far larger than all others: drop their Gaussians (--drop-ids), or write a .gseq",
            decibels_text(found, 1)
        ))),
    }
}

/// Searches a range for the number nearest to its second end at which `evaluate` returns a result, by bisection with
/// `halvings` steps from the first end. Returns this result, or `None` if no tried number has one.
pub(crate) fn bisect<T>(
    [mut low, mut high]: [f64; 2],
    halvings: usize,
    evaluate: impl Fn(f64) -> Result<Option<T>>,
) -> Result<Option<T>> {
    let mut best = None;
    for _ in 0..halvings {
        let middle = 0.5 * (low + high);
        match evaluate(middle)? {
            Some(found) => (low, best) = (middle, Some(found)),
            None => high = middle,
        }
    }
    Ok(best)
}

/// Returns by how many octaves (doublings) a quantization step that causes the squared error `found` must grow to cause
/// about `error`. The change is limited to [`MAX_STEP_CHANGE`] in both directions.
pub(crate) fn step_change(error: f64, found: f64) -> f64 {
    (0.5 * (error / found.max(MIN_ERROR)).log2()).clamp(-MAX_STEP_CHANGE, MAX_STEP_CHANGE)
}
