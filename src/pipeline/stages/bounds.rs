//! Within which bounds the values of an archive of frames lie, which is a container (`format/SPEC.md`).
//!
//! A column that is off by at most its bound adds a squared error to the pictures that goes with the square of the bound, and
//! an octave of it saves a bit of every value that says anything new. As with the grids of a model's archive bits are fewest
//! for an error where every column's goes by how many bits an octave saves: both are measured, errors on pictures of values
//! rounded to twice their bound, bits on some blocks as they are encoded. Then all bounds together are as wide as pictures
//! allow.

use std::collections::BTreeMap;
use std::fs;

use crate::error::{Error, Result};
use crate::files::atomic::ScratchFolder;
use crate::memory_plan::{MemoryPart, Workload};
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::outputs::bounds::Bounds;
use crate::outputs::container::{BOUNDED_FRAME_BLOCK, GAUSSIAN_BLOCK, Packing, column_bytes, write_container};
use crate::pipeline::stages::reference_views::{
    ADDED, ArchiveTarget, BYTES_ADDED, BYTES_HALVINGS, HALVINGS, QualityTarget, ROUNDS, ReferenceViews, balanced,
    bisected, check_met, measurable,
};
use crate::pipeline::summary::ArchiveSummary;
use crate::scene::{Scene, first_box};
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan, Reads};

/// zstd's level.
const LEVEL: i32 = 15;
/// Bounds that measuring begins with, finer than most end, in the columns' units, of positions in extents of the scene.
const FIRST: [f64; 5] = [1e-4, 2e-3, 5e-3, 1e-2, 5e-3];
/// Bounds are at most so many of these: of a wider one nothing is left that moves or shines.
const WIDEST: f64 = 64.0;
/// Blocks of Gaussians whose bits are counted.
const BLOCKS: usize = 4;
/// How much wider bounds that no picture was looked at for are taken to be in the end, octaves.
const GUESSED: f64 = 2.0;

/// How a container within `bounds` is stored.
pub(crate) fn packing(bounds: Bounds) -> Packing {
    Packing::within(bounds, LEVEL)
}

/// What it takes to store frames of such an input within bounds; nothing of a model or a cloud, whose archive is another.
pub(crate) fn storing(work: &Workload) -> Vec<MemoryPart> {
    if work.input.reduced > 0 || work.frames == 1 {
        return Vec::new();
    }
    [work.writing_together(BOUNDED_FRAME_BLOCK), vec![work.compressing(LEVEL, BOUNDED_FRAME_BLOCK)]].concat()
}

/// The bounds within which `source`, a result of `scene`, is what it is `asked` for, or `psnr` close.
///
/// # Errors
/// Frames that cannot be read; pictures that are not finite; too few bytes.
pub(crate) fn find(
    scene: &Scene,
    source: &dyn FrameSource,
    psnr: Option<f64>,
    asked: ArchiveTarget,
) -> Result<(Bounds, ArchiveSummary)> {
    let (looks, original) = (ReferenceViews::new(scene, source)?, ReferenceViews::new(scene, scene.source())?);
    let level = measurable(looks.psnr(scene.source())?)?;
    let aim = QualityTarget::new(psnr, asked, level);
    let asked = aim.close(level);
    let first = first(source)?;
    let mut widths = first;
    let mut measured = Vec::new();
    for _ in 0..ROUNDS {
        let error = 10f64.powf(-0.1 * asked);
        let errors = errors(&looks, source, &widths)?;
        let [fine, wide] = [0.0, 0.5].map(|octaves| bits(source, wider(&widths, octaves)));
        let (fine, wide) = (fine?, wide?);
        let saved: Vec<f64> = (0..5).map(|k| (2.0 * (fine[k] - wide[k])).max(1.0 + 0.05 * fine[k])).collect();
        let all: f64 = saved.iter().sum();
        measured.clear();
        for (k, column) in Columns::all().iter().enumerate() {
            measured.push((column.name().to_owned(), (2.0 * widths[k]).log2(), errors[k], fine[k]));
            let by = balanced(error * saved[k] / all, errors[k]);
            widths[k] = (widths[k] * by.exp2()).min(WIDEST * first[k]);
        }
    }
    let looked_at = |widths: [f64; 5]| -> Result<([f64; 5], [f64; 2])> {
        let shown = Rounded { source, bounds: Bounds::new(widths) };
        Ok((widths, [looks.psnr(&shown)?, level - original.psnr(&shown)?]))
    };
    let (widths, [psnr, loss]) = match aim {
        QualityTarget::Bytes(most) => {
            // The finest that fits.
            let size = |widths| stored(scene, source, widths);
            let fits = |finer: f64| {
                let found = wider(&widths, -finer);
                Ok((size(found)? <= most).then_some(found))
            };
            looked_at(match bisected(BYTES_ADDED.map(|added| -added), BYTES_HALVINGS, fits)? {
                Some(best) => best,
                None => {
                    let widest = wider(&widths, BYTES_ADDED[0]);
                    let least = size(widest)?;
                    if least > most {
                        return Err(Error::usage(format!(
                            "--target-size: an archive of {} Gaussians has {least} bytes within the widest bounds; \
                             expected at least that, found {most}",
                            source.info().count
                        )));
                    }
                    widest
                }
            })?
        }
        QualityTarget::Close(_) | QualityTarget::Loss(_) => {
            let best = bisected(ADDED, HALVINGS, |added| {
                Ok(Some(looked_at(wider(&widths, added))?).filter(|&(_, found)| aim.does(found, asked)))
            })?;
            best.map_or_else(|| looked_at(wider(&widths, ADDED[0])), Ok)?
        }
    };
    check_met(aim, asked, psnr)?;
    let names = Columns::all().iter().map(|column| column.name().to_owned());
    let bounds = names.zip(widths).collect();
    let bits = BTreeMap::new();
    let summary = ArchiveSummary { asked, psnr, level, loss, parts: None, bounds: Some(bounds), bits, measured };
    Ok((Bounds::new(widths), summary))
}

/// Bytes of an archive of `source`, about: within bounds as they are before any picture is looked at.
///
/// # Errors
/// Frames that cannot be read; a failed write.
pub(crate) fn bytes(scene: &Scene, source: &dyn FrameSource) -> Result<u64> {
    stored(scene, source, wider(&first(source)?, GUESSED))
}

/// Writes `source` within such bounds to a scratch file; gives its bytes.
fn stored(scene: &Scene, source: &dyn FrameSource, widths: [f64; 5]) -> Result<u64> {
    let folder = ScratchFolder::new(&scene.scratch)?;
    let path = folder.path().join("result");
    write_container(source, &path, packing(Bounds::new(widths)), BTreeMap::new(), |_| ())?;
    Ok(fs::metadata(&path).map_err(Error::io("read", &path))?.len())
}

/// [`FIRST`] of a scene.
fn first(source: &dyn FrameSource) -> Result<[f64; 5]> {
    let extent = first_box(source)?.map_or(1.0, |found| found.extent());
    let [position, others @ ..] = FIRST;
    let [rotation, log_scale, opacity, sh] = others;
    let extent = if extent.is_finite() && extent > 0.0 { extent } else { 1.0 };
    Ok([position * extent, rotation, log_scale, opacity, sh])
}

fn wider(widths: &[f64; 5], octaves: f64) -> [f64; 5] {
    widths.map(|width| width * octaves.exp2())
}

/// Squared errors of pictures where one column is off and all others are not.
fn errors(looks: &ReferenceViews<'_>, source: &dyn FrameSource, widths: &[f64; 5]) -> Result<Vec<f64>> {
    let alone = |k: usize| std::array::from_fn(|other| if other == k { widths[k] } else { 0.0 });
    (0..5).map(|k| looks.error(&Rounded { source, bounds: Bounds::new(alone(k)) })).collect()
}

/// Bits of every column in some blocks of Gaussians, over the frames in the middle.
fn bits(source: &dyn FrameSource, widths: [f64; 5]) -> Result<Vec<f64>> {
    let (info, packing) = (source.info(), packing(Bounds::new(widths)));
    let blocks = info.count.div_ceil(GAUSSIAN_BLOCK);
    let looked_at = blocks.min(BLOCKS);
    let spread: Vec<usize> = (0..looked_at).map(|k| (2 * k + 1) * blocks / (2 * looked_at)).collect();
    let frames = info.times.len().min(packing.frame_block());
    let start = (info.times.len() - frames) / 2;
    let bytes = column_bytes(source, &spread, start..start + frames, &packing)?;
    Ok(bytes.into_iter().map(|bytes| 8.0 * bytes as f64).collect())
}

/// A source whose values are rounded to multiples of twice their bounds.
struct Rounded<'a> {
    source: &'a dyn FrameSource,
    bounds: Bounds,
}

impl FrameSource for Rounded<'_> {
    fn info(&self) -> &SequenceInfo {
        self.source.info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(RoundedReader { reader: self.source.open(ids)?, bounds: self.bounds }))
    }

    fn reads(&self) -> Reads {
        self.source.reads()
    }
}

struct RoundedReader<'a> {
    reader: Box<dyn BlockReader + 'a>,
    bounds: Bounds,
}

impl BlockReader for RoundedReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        self.reader.read(frame, want, out)?;
        for column in want.iter() {
            let step = 2.0 * self.bounds.column(column);
            if step > 0.0 {
                let values = out.column_mut(column).planes_mut().iter_mut();
                values.for_each(|value| *value = ((f64::from(*value) / step).round() * step) as f32);
            }
        }
        Ok(())
    }

    fn expect(&mut self, wanted: &ReadPlan) {
        self.reader.expect(wanted);
    }

    fn prepare(&mut self, frame: usize, want: Columns) -> Result<()> {
        self.reader.prepare(frame, want)
    }
}
