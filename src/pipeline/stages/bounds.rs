//! Choice of the error bounds of the values in an archive of frames. Such an archive is a container (`format/SPEC.md`).
//!
//! If one attribute alone has an error bound, two things hold: the squared error of renders is proportional to the
//! square of the bound, and each octave (doubling) of the bound saves one bit of every value that carries information.
//! For a given total error, the archive has the fewest bits if the error of each attribute is proportional to the bits
//! that one octave saves in this attribute. (The same rule gives the quantization steps of an archive of a model.)
//! Errors are measured on renders of values that are rounded to multiples of twice the bound. Bits are counted by
//! encoding some blocks of Gaussians. Finally all bounds are widened by a common factor, as far as the quality of
//! renders allows.

use std::collections::BTreeMap;
use std::fs;

use crate::error::{Error, Result};
use crate::files::atomic::ScratchFolder;
use crate::memory_plan::{MemoryPart, Workload};
use crate::model::{Attributes, Gaussians, SequenceInfo};
use crate::outputs::bounds::ErrorBounds;
use crate::outputs::container::{
    FRAME_BLOCK_WITH_ERROR_BOUNDS, GAUSSIAN_BLOCK, Packing, column_bytes, write_container,
};
use crate::pipeline::stages::reference_views::{
    ArchiveTarget, BALANCING_ROUNDS, BYTES_OCTAVE_HALVINGS, BYTES_OCTAVE_RANGE, OCTAVE_HALVINGS, OCTAVE_RANGE,
    QualityTarget, ReferenceViews, bisect, check_measurable, step_change,
};
use crate::pipeline::summary::ArchiveSummary;
use crate::scene::{Scene, first_frame_box};
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts, ReadPlan};

/// Compression level of zstd for archives of frames.
const LEVEL: i32 = 15;
/// Initial error bounds of position, rotation, log scale, opacity and SH: for positions as a fraction of the scene
/// extent, for the others in the units of the attributes. They are finer than most final bounds.
const INITIAL_BOUNDS: [f64; 5] = [1e-4, 2e-3, 5e-3, 1e-2, 5e-3];
/// Maximum ratio of a final error bound to its initial one; with wider bounds, rounding would remove all motion and all
/// differences of color.
const MAX_WIDENING: f64 = 64.0;
/// Maximum number of blocks of Gaussians that are encoded to count the bits of every attribute.
const COUNTED_BLOCKS: usize = 4;
/// The size of an archive is estimated without rendering, with the initial error bounds widened by this number of
/// octaves (doublings).
const ESTIMATE_OCTAVES: f64 = 2.0;

/// Returns the storage options of a container whose values may differ from the exact ones by at most `bounds`.
pub(crate) fn packing(bounds: ErrorBounds) -> Packing {
    Packing::with_bounds(bounds, LEVEL)
}

/// Returns the memory that writing an archive of frames takes, as named parts in bytes. Empty for models and point
/// clouds, whose archives store no frames.
pub(crate) fn storing_memory(work: &Workload) -> Vec<MemoryPart> {
    if work.input.compressed > 0 || work.frames == 1 {
        return Vec::new();
    }
    [
        work.tile_write_buffers(FRAME_BLOCK_WITH_ERROR_BOUNDS),
        vec![work.compressor_memory(LEVEL, FRAME_BLOCK_WITH_ERROR_BOUNDS)],
    ]
    .concat()
}

/// Finds error bounds with which an archive of `source`, a result of `scene`, meets the quality or size
/// `archive_target`. If `psnr` is given, renders of the archive must have at least this PSNR, dB, against renders of
/// `source`. Returns the bounds and the summary of the archive.
///
/// # Errors
/// Fails if frames cannot be read, if renders are not finite, or if an archive with the widest bounds exceeds the byte
/// limit.
pub(crate) fn find(
    scene: &Scene,
    source: &dyn FrameSource,
    psnr: Option<f64>,
    archive_target: ArchiveTarget,
) -> Result<(ErrorBounds, ArchiveSummary)> {
    let (reference_views, original) =
        (ReferenceViews::new(scene, source)?, ReferenceViews::new(scene, scene.source())?);
    let level = check_measurable(reference_views.psnr(scene.source())?)?;
    let quality_target = QualityTarget::new(psnr, archive_target, level);
    let required_psnr = quality_target.required_psnr(level);
    let initial_bounds = initial_bounds(source)?;
    let mut widths = initial_bounds;
    let mut measured = Vec::new();
    let progress = scene.events.task("archive", "measurements", (BALANCING_ROUNDS + OCTAVE_HALVINGS) as u64);
    for _ in 0..BALANCING_ROUNDS {
        progress.advance(1);
        let error = 10f64.powf(-0.1 * required_psnr);
        let errors = errors(&reference_views, source, &widths)?;
        let [fine, wide] = [0.0, 0.5].map(|octaves| bits(source, widened(&widths, octaves)));
        let (fine, wide) = (fine?, wide?);
        let saved: Vec<f64> = (0..5).map(|k| (2.0 * (fine[k] - wide[k])).max(1.0 + 0.05 * fine[k])).collect();
        let all: f64 = saved.iter().sum();
        measured.clear();
        for (k, column) in Attributes::all().iter().enumerate() {
            measured.push((column.name().to_owned(), (2.0 * widths[k]).log2(), errors[k], fine[k]));
            let by = step_change(error * saved[k] / all, errors[k]);
            widths[k] = (widths[k] * by.exp2()).min(MAX_WIDENING * initial_bounds[k]);
        }
    }
    let measure_views = |widths: [f64; 5]| -> Result<([f64; 5], [f64; 2])> {
        progress.advance(1);
        let shown = Rounded { source, bounds: ErrorBounds::new(widths) };
        Ok((widths, [reference_views.psnr(&shown)?, level - original.psnr(&shown)?]))
    };
    let (widths, [psnr, loss]) = match quality_target {
        QualityTarget::Bytes(most) => {
            // Take the finest error bounds with which the archive fits the byte limit.
            let size = |widths| stored_bytes(scene, source, widths);
            let fits = |finer: f64| {
                let found = widened(&widths, -finer);
                Ok((size(found)? <= most).then_some(found))
            };
            measure_views(match bisect(BYTES_OCTAVE_RANGE.map(|added| -added), BYTES_OCTAVE_HALVINGS, fits)? {
                Some(best) => best,
                None => {
                    let widest = widened(&widths, BYTES_OCTAVE_RANGE[0]);
                    let least = size(widest)?;
                    if least > most {
                        return Err(Error::usage(format!(
                            "--size: expected at least {least} bytes, the size of an archive of {} Gaussians \
                             with the widest error bounds, found {most}",
                            source.info().count
                        )));
                    }
                    widest
                }
            })?
        }
        QualityTarget::Close(_) | QualityTarget::Loss(_) => {
            let best = bisect(OCTAVE_RANGE, OCTAVE_HALVINGS, |added| {
                Ok(Some(measure_views(widened(&widths, added))?)
                    .filter(|&(_, found)| quality_target.is_met_by(found, required_psnr)))
            })?;
            best.map_or_else(|| measure_views(widened(&widths, OCTAVE_RANGE[0])), Ok)?
        }
    };
    let names = Attributes::all().iter().map(|column| column.name().to_owned());
    let bounds = names.zip(widths).collect();
    let bits = BTreeMap::new();
    let (asked, bounds) = (required_psnr, Some(bounds));
    let summary = ArchiveSummary { asked, psnr, level, loss, is_refined: false, parts: None, bounds, bits, measured };
    Ok((ErrorBounds::new(widths), summary))
}

/// Returns an estimate of the size, in bytes, of an archive of the frames of `source`: the size with the initial error
/// bounds, widened by [`ESTIMATE_OCTAVES`]. The final error bounds of an archive are chosen by rendering; the estimate
/// renders nothing.
///
/// # Errors
/// Fails if frames cannot be read or a write fails.
pub(crate) fn bytes(scene: &Scene, source: &dyn FrameSource) -> Result<u64> {
    stored_bytes(scene, source, widened(&initial_bounds(source)?, ESTIMATE_OCTAVES))
}

/// Writes the frames of `source` to a scratch file, as a container with the error bounds `widths`, one per attribute.
/// Returns the size of the file in bytes.
fn stored_bytes(scene: &Scene, source: &dyn FrameSource, widths: [f64; 5]) -> Result<u64> {
    let folder = ScratchFolder::new(&scene.scratch)?;
    let path = folder.path().join("result");
    write_container(source, &path, packing(ErrorBounds::new(widths)), BTreeMap::new(), |_| ())?;
    Ok(fs::metadata(&path).map_err(Error::io("read", &path))?.len())
}

/// Returns the initial error bounds [`INITIAL_BOUNDS`], in which the bound of positions is converted to scene units by
/// the extent of the first frame of `source`.
fn initial_bounds(source: &dyn FrameSource) -> Result<[f64; 5]> {
    let extent = first_frame_box(source)?.map_or(1.0, |found| found.extent());
    let [position, others @ ..] = INITIAL_BOUNDS;
    let [rotation, log_scale, opacity, sh] = others;
    let extent = if extent.is_finite() && extent > 0.0 { extent } else { 1.0 };
    Ok([position * extent, rotation, log_scale, opacity, sh])
}

fn widened(widths: &[f64; 5], octaves: f64) -> [f64; 5] {
    widths.map(|width| width * octaves.exp2())
}

/// Returns for each attribute the mean squared error of renders if only this attribute is rounded within its bound in
/// `widths` and all others are exact.
fn errors(reference_views: &ReferenceViews<'_>, source: &dyn FrameSource, widths: &[f64; 5]) -> Result<Vec<f64>> {
    let alone = |k: usize| std::array::from_fn(|other| if other == k { widths[k] } else { 0.0 });
    (0..5).map(|k| reference_views.error(&Rounded { source, bounds: ErrorBounds::new(alone(k)) })).collect()
}

/// Returns for each attribute the size in bits of a sample of the archive, encoded with the error bounds `widths`. The
/// sample is at most [`COUNTED_BLOCKS`] evenly spaced blocks of Gaussians over one block of frames in the middle of the
/// sequence.
fn bits(source: &dyn FrameSource, widths: [f64; 5]) -> Result<Vec<f64>> {
    let (info, packing) = (source.info(), packing(ErrorBounds::new(widths)));
    let blocks = info.count.div_ceil(GAUSSIAN_BLOCK);
    let counted = blocks.min(COUNTED_BLOCKS);
    let spread: Vec<usize> = (0..counted).map(|k| (2 * k + 1) * blocks / (2 * counted)).collect();
    let frames = info.times.len().min(packing.frame_block());
    let start = (info.times.len() - frames) / 2;
    let bytes = column_bytes(source, &spread, start..start + frames, &packing)?;
    Ok(bytes.into_iter().map(|bytes| 8.0 * bytes as f64).collect())
}

/// Source that returns the values of another source rounded to multiples of twice their error bounds.
struct Rounded<'a> {
    source: &'a dyn FrameSource,
    bounds: ErrorBounds,
}

impl FrameSource for Rounded<'_> {
    fn info(&self) -> &SequenceInfo {
        self.source.info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(RoundedReader { reader: self.source.open(ids)?, bounds: self.bounds }))
    }

    fn reads(&self) -> ReadCounts {
        self.source.reads()
    }
}

struct RoundedReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    bounds: ErrorBounds,
}

impl BlockReader for RoundedReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        for column in want.iter() {
            let step = 2.0 * self.bounds.max_error(column);
            if step > 0.0 {
                let values = out.attribute_values_mut(column).planes_mut().iter_mut();
                values.for_each(|value| *value = ((f64::from(*value) / step).round() * step) as f32);
            }
        }
        Ok(())
    }

    fn expect(&mut self, plan: &ReadPlan) {
        self.reader.expect(plan);
    }
}
