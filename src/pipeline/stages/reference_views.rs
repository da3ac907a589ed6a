//! Quality targets of archives, and renders of the result before quantization, with which renders of an archive are
//! compared.

use rayon::prelude::*;
use serde::Serialize;

use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result, ShowPath};
use crate::files::accuracy::far_gaussians;
use crate::metrics::{decibels_text, psnr};
use crate::model::{Attributes, FrameView};
use crate::passes::{BatchLimits, RenderedSource, for_each_view_batch, gather, select_evenly};
use crate::pipeline::summary::ArchiveSummary;
use crate::render::Image;
use crate::scene::Scene;
use crate::source::FrameSource;

/// Minimum and maximum number of views on which an archive is compared with the result before quantization. Between
/// these limits, [`MAX_VIEW_BYTES`] determines the number.
const VIEW_COUNTS: [u64; 2] = [4, 12];
/// Maximum bytes of memory of all renders of the result and of the original together. The number of compared views
/// follows from this limit.
const MAX_VIEW_BYTES: u64 = 128 << 20;
/// Maximum amount by which quantization may lower the PSNR against the original if the user requests no quality and no
/// size, dB.
const DEFAULT_LOSS: f64 = 0.5;
/// PSNR of the result against the original, dB, above which the errors of pruning are too small to hide quantization
/// noise. The archive then has to reach this PSNR against the result before quantization.
pub(crate) const ENOUGH_PSNR: f64 = 50.0;
/// Loss of PSNR, dB, that a run allows for the quantization of an archive. A search for a requested PSNR therefore
/// looks for a model that exceeds the request by this amount. With this value, quantization may add a third of the
/// squared error of pruning: 10·log10(1 + 1/3) ≈ 1.2. A third is the best trade-off: raising the error of pruning by
/// some percentage saves about three times as many bytes as raising the error of quantization by the same percentage.
pub(crate) const ARCHIVE_HEADROOM: f64 = 1.2;
/// Maximum amount, dB, by which an archive may miss its required PSNR against the result before quantization. If it
/// misses more, the run fails.
const MAX_SHORTFALL: f64 = 10.0;
/// Amount, dB, by which an archive may miss its quality without a note to the user.
const NOTED_SHORTFALL: f64 = 0.5;
/// Bytes of memory per pixel of a rendered view.
pub(crate) const BYTES_PER_PIXEL: u64 = 3 * size_of::<f32>() as u64;
/// Number of balancing rounds. Each round measures the error and the bits of every group of values (attribute or
/// tensor), and adjusts the quantization steps of the groups.
pub(crate) const BALANCING_ROUNDS: usize = 2;
/// Maximum change of a quantization step in one balancing round, octaves (doublings).
const MAX_STEP_CHANGE: f64 = 2.5;
/// Smallest mean squared error of renders that is distinguished from 0.
const MIN_ERROR: f64 = 1e-14;
/// Range of the search for the coarsest quantization steps (or error bounds) with which an archive has the required
/// PSNR. After the balancing rounds ([`BALANCING_ROUNDS`]), the search multiplies all steps by one common factor. First
/// value: log2 of the smallest factor (finest steps); second value: log2 of the largest factor (coarsest steps).
pub(crate) const OCTAVE_RANGE: [f64; 2] = [-2.0, 2.0];
/// Number of bisection steps of the search in [`OCTAVE_RANGE`] for the coarsest quantization steps with which an
/// archive has the required PSNR.
pub(crate) const OCTAVE_HALVINGS: usize = 6;
/// Range of the search for the finest quantization steps (or error bounds) with which an archive fits a byte limit.
/// After the balancing rounds ([`BALANCING_ROUNDS`]), the search multiplies all steps by one common factor. First
/// value: log2 of the largest factor (coarsest steps); second value: log2 of the smallest factor (finest steps).
pub(crate) const BYTES_OCTAVE_RANGE: [f64; 2] = [4.0, -4.0];
/// Number of bisection steps of the search in [`BYTES_OCTAVE_RANGE`] for the finest quantization steps with which an
/// archive fits its byte limit. Each bisection step encodes an archive and halves the range.
pub(crate) const BYTES_OCTAVE_HALVINGS: usize = 10;

/// Returns the number of views on which an archive is compared with the result before quantization, if each view has
/// `pixels` pixels.
pub(crate) fn view_count(pixels: u64) -> u64 {
    let [fewest, most] = VIEW_COUNTS;
    (MAX_VIEW_BYTES / (2 * BYTES_PER_PIXEL * pixels.max(1))).clamp(fewest, most)
}

/// Returns the views of `scene` on which an archive is compared with the result before quantization.
pub(crate) fn reference_views(scene: &Scene) -> Vec<FrameView> {
    select_evenly(&scene.schedule, view_count(scene.workload().pixels) as usize, 1)
}

/// Requirement on an archive that follows from the goal of the run. The PSNR of the option `--archive-psnr` is passed
/// separately.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub enum ArchiveTarget {
    /// No requirement.
    Nothing,
    /// Maximum amount by which quantization may lower the PSNR against the original, dB.
    Loss(f64),
    /// Maximum number of bytes of the archive.
    Bytes(u64),
}

/// Requirement that an archive has to meet. It results from the goal of the run, the option `--archive-psnr` and the
/// defaults.
#[derive(Debug, Clone, Copy)]
pub(crate) enum QualityTarget {
    /// Minimum PSNR of renders of the archive against renders of the result before quantization, dB.
    Close(f64),
    /// Maximum amount by which the PSNR against the original may be lower for the archive than for the result before
    /// quantization, dB.
    Loss(f64),
    /// Maximum number of bytes of the archive.
    Bytes(u64),
}

impl QualityTarget {
    /// Returns the requirement for an archive of a result whose PSNR against the original is `level`, dB. `psnr` is the
    /// value of the option `--archive-psnr`, if given; `archive_target` is the requirement that follows from the goal
    /// of the run.
    pub(crate) fn new(psnr: Option<f64>, archive_target: ArchiveTarget, level: f64) -> QualityTarget {
        match (psnr, archive_target) {
            (_, ArchiveTarget::Bytes(most)) => QualityTarget::Bytes(most),
            (Some(psnr), _) => QualityTarget::Close(psnr),
            (None, ArchiveTarget::Loss(loss)) if loss > 0.0 => QualityTarget::Loss(loss),
            (None, ArchiveTarget::Nothing) if level < ENOUGH_PSNR => QualityTarget::Loss(DEFAULT_LOSS),
            _ => QualityTarget::Close(ENOUGH_PSNR),
        }
    }

    /// Returns whether an archive meets the requirement. `psnr` is its PSNR against the result before quantization,
    /// `loss` is the amount by which quantization lowered its PSNR against the original; both are in dB.
    /// `required_psnr` is the result of [`required_psnr`](QualityTarget::required_psnr).
    pub(crate) fn is_met_by(self, [psnr, loss]: [f64; 2], required_psnr: f64) -> bool {
        match self {
            QualityTarget::Loss(most) => loss <= most,
            QualityTarget::Close(_) | QualityTarget::Bytes(_) => psnr >= required_psnr,
        }
    }

    /// Returns the PSNR, dB, that renders of the archive must have against renders of the result before quantization.
    /// `level` is the PSNR of the result before quantization against the original, dB; the returned PSNR depends on it
    /// if the requirement is a maximum loss or a byte limit.
    pub(crate) fn required_psnr(self, level: f64) -> f64 {
        match self {
            QualityTarget::Close(psnr) => psnr,
            // The squared errors of pruning and of quantization add up.
            QualityTarget::Loss(loss) => level - 10.0 * error_from_loss(loss).log10(),
            QualityTarget::Bytes(_) => QualityTarget::Loss(ARCHIVE_HEADROOM).required_psnr(level.min(ENOUGH_PSNR)),
        }
    }
}

/// Returns the squared error that quantization adds if it lowers the PSNR by `loss` dB. The unit is the squared error
/// before quantization.
pub(crate) fn error_from_loss(loss: f64) -> f64 {
    10f64.powf(0.1 * loss) - 1.0
}

/// Returns by how many dB quantization lowers the PSNR if it adds the squared error `error`. The unit of `error` is the
/// squared error before quantization. Inverse of [`error_from_loss`].
pub(crate) fn loss_from_error(error: f64) -> f64 {
    10.0 * (1.0 + error).log10()
}

/// Renders of one model (usually the result before quantization), with which renders of other models are compared.
pub(crate) struct ReferenceViews<'a> {
    scene: &'a Scene,
    views: Vec<FrameView>,
    images: Vec<Image>,
}

impl ReferenceViews<'_> {
    pub(crate) fn new<'a>(scene: &'a Scene, source: &dyn FrameSource) -> Result<ReferenceViews<'a>> {
        let mut reference_views = ReferenceViews { scene, views: reference_views(scene), images: Vec::new() };
        reference_views.images = reference_views.render(source, |_, image| image)?;
        Ok(reference_views)
    }

    /// Returns the camera and frame of every view.
    pub(crate) fn views(&self) -> &[FrameView] {
        &self.views
    }

    fn render<T: Send>(&self, source: &dyn FrameSource, finish: impl Fn(usize, Image) -> T + Sync) -> Result<Vec<T>> {
        let mut rendered = Vec::with_capacity(self.views.len());
        let batch = BatchLimits::one_frame(&self.scene.limits);
        for_each_view_batch(
            [RenderedSource::all_gaussians(source)],
            &self.scene.schedule.cameras,
            &self.views,
            batch,
            |views| {
                let first = rendered.len();
                let view = |(k, view): (usize, &crate::passes::RenderableView<'_, 1>)| {
                    finish(first + k, view.render(0, self.scene.background))
                };
                rendered.par_extend(views.par_iter().enumerate().map(view));
                Ok(())
            },
        )?;
        Ok(rendered)
    }

    /// Returns the mean PSNR, dB, of renders of `source` against the stored renders of the reference model (usually the
    /// result before quantization).
    pub(crate) fn psnr(&self, source: &dyn FrameSource) -> Result<f64> {
        let found = self.render(source, |k, image| psnr(&image, &self.images[k]))?;
        Ok(found.iter().sum::<f64>() / found.len().max(1) as f64)
    }

    /// Returns the mean squared error of renders of `source` against the stored renders of the reference model (usually
    /// the result before quantization). Color values are from 0 to 1.
    pub(crate) fn error(&self, source: &dyn FrameSource) -> Result<f64> {
        let found = self.render(source, |k, image| 10f64.powf(-0.1 * psnr(&image, &self.images[k])))?;
        Ok(found.iter().sum::<f64>() / found.len().max(1) as f64)
    }
}

/// Checks that `psnr`, the PSNR of a result against the original in dB, is a number, and returns it.
///
/// # Errors
/// Fails if `psnr` is NaN, which means that some pixels are NaN.
pub(crate) fn check_measurable(psnr: f64) -> Result<f64> {
    if psnr.is_nan() {
        return Err(Error::usage(
            "the quantization of an archive is chosen by renders: expected numbers in every pixel, found NaN in \
             some\n  \
             compress --set non_finite=drop removes the Gaussians that are not finite; a .gseq holds them as they are",
        ));
    }
    Ok(psnr)
}

/// Checks that the PSNR of an archive against the result before quantization, `summary.psnr`, is not far below the
/// PSNR that `quality_target` requires. Returns a note for the user if the archive misses its target by more than
/// [`NOTED_SHORTFALL`]. `requested`: the PSNR that the user gave for it (`--archive-psnr`). An archive with a byte
/// limit and a refined archive always pass.
///
/// # Errors
/// Fails if the PSNR is more than [`MAX_SHORTFALL`] below the smaller of the required PSNR and [`ENOUGH_PSNR`]. Then
/// some values are so large that a quantization grid for them cannot represent the others. Also fails if frames cannot
/// be read.
pub(crate) fn check_met(
    scene: &Scene,
    compressed: &CompressedModel,
    (quality_target, requested): (QualityTarget, Option<f64>),
    summary: &ArchiveSummary,
) -> Result<Option<String>> {
    let required_psnr = quality_target.required_psnr(summary.level);
    let shortfall = match quality_target {
        QualityTarget::Bytes(_) => return Ok(None),
        _ if summary.is_refined => return Ok(None),
        QualityTarget::Close(_) => required_psnr - summary.psnr,
        QualityTarget::Loss(most) => summary.loss - most,
    };
    let fails = summary.psnr < required_psnr.min(ENOUGH_PSNR) - MAX_SHORTFALL;
    if !fails && shortfall <= NOTED_SHORTFALL {
        return Ok(None);
    }
    let state = gather(scene.source(), &compressed.kept, 0, Attributes::POSITION)?;
    let far = far_gaussians(&state.position, |row| compressed.kept[row] as usize);
    let cause = match far {
        Some(far) => format!("far from all others: {far}; drop them (compress --drop-ids), or write a .ply or .gseq"),
        None => {
            "some values may be far larger than all others: drop their Gaussians (compress --drop-ids), or write a \
                 .ply or .gseq"
                .to_owned()
        }
    };
    let expected = if requested.is_some() { "the requested " } else { "" };
    let found = decibels_text(summary.psnr, 1);
    match fails {
        true => Err(Error::usage(format!(
            "{}: the values of an archive of this model would be too coarse: expected {expected}{required_psnr:.1} dB \
             PSNR against renders before quantization, found {found}\n  {cause}",
            scene.shown_path().shown()
        ))),
        false => Ok(Some(format!(
            "the archive misses its quality: expected {expected}{required_psnr:.1} dB PSNR against renders before \
             quantization, found {found}\n  {cause}"
        ))),
    }
}

/// Searches the numbers from `low` to `high` for the one nearest to `high` at which `evaluate` returns a result (not
/// `None`), by `halvings` bisection steps. Assumes that `evaluate` returns results from `low` up to some number, and
/// none beyond it. `low` may be larger than `high`. Returns the result at the best tried number, or `None` if no tried
/// number has a result.
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

/// Returns the number of octaves (doublings) by which a quantization step must grow so that it causes about the squared
/// error `error`. `actual` is the error that the present step causes. The result is limited to ±[`MAX_STEP_CHANGE`].
pub(crate) fn step_change(error: f64, actual: f64) -> f64 {
    (0.5 * (error / actual.max(MIN_ERROR)).log2()).clamp(-MAX_STEP_CHANGE, MAX_STEP_CHANGE)
}
