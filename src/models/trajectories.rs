//! What families of explicit trajectories share: each Gaussian's state stands in every frame, so that a proxy is the
//! moment match of its members frame by frame, and nothing has to be solved.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use gseq::Compression;

use crate::compressed_model::{CompressedModel, TrajectoryDelta};
use crate::error::{Error, Result, ShowPath};
use crate::files::ply::write::write_inria;
use crate::files::spz::write_spz;
use crate::limits::Limits;
use crate::merging::merged::MergedSequence;
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::outputs::container::{ContainerWriter, FRAME_BLOCK, GAUSSIAN_BLOCK, write_container};
use crate::outputs::curves::write_curves;
use crate::outputs::four_dgs::write_four_dgs;
use crate::outputs::kind::OutputKind;
use crate::passes::{Changed, HeldFrames, States, gather_all};
use crate::progress::Events;
use crate::source::{FrameSource, ReadPlan};

/// zstd level of containers that are a result: higher ones gain about 1% on trained models.
const LEVEL: i32 = 1;

/// The kind of a result of explicit trajectories to which nothing else gives one.
pub const OWN_OUTPUT: OutputKind = OutputKind::PlySequence;

/// Why most inputs cannot become an archive.
pub(super) const NO_ARCHIVE: &str = "only a 4DGaussians or 3DGS model, a PLY, or frames can be written as an archive\n  \
                                     pack it into a .gseq first, or write one";

/// Bytes of the columns `of` of one Gaussian at one frame.
pub fn state_bytes(sh_degree: usize, of: Columns) -> u64 {
    of.iter().map(|column| 4 * column.width(sh_degree) as u64).sum()
}

/// What is left of `source`, merged.
pub(super) fn merged<'a>(source: &'a dyn FrameSource, reduction: &'a CompressedModel) -> MergedSequence<'a> {
    let members = reduction.clusters.iter().map(|cluster| (cluster.output, &cluster.members[..]));
    MergedSequence::new(source, &reduction.kept, members, &reduction.rule)
}

/// What is left of `source`, merged and changed, with what stays of its harmonics.
pub(super) fn reduced_trajectories<'a>(
    source: &'a dyn FrameSource,
    reduction: &'a CompressedModel,
) -> Box<dyn FrameSource + 'a> {
    let CompressedModel { change, course, sh_degree, .. } = reduction;
    Box::new(Changed::new(Box::new(merged(source, reduction)), change, course, *sh_degree))
}

/// Confirms that a sequence of so many frames can be written as `kind`.
pub(super) fn check_output(frames: usize, kind: OutputKind, path: &Path) -> Result<()> {
    match kind {
        OutputKind::Model => Err(Error::usage(
            "only a trained model can be written as a model folder\n  write a .gseq or --as ply-sequence",
        )),
        OutputKind::Ply if frames != 1 => Err(Error::usage(format!(
            "{}: {frames} frames do not fit one .ply\n  write a .gseq or --as ply-sequence",
            path.shown()
        ))),
        OutputKind::Archive => Err(Error::usage(NO_ARCHIVE)),
        _ => Ok(()),
    }
}

/// Writes what is left of `source` as `kind`, to `path`; gives things a person should know.
pub(super) fn write_trajectories(
    source: &dyn FrameSource,
    reduction: &CompressedModel,
    kind: OutputKind,
    path: &Path,
    limits: &Limits,
    events: &Events,
) -> Result<Vec<String>> {
    if kind == OutputKind::Gseq && !reduction.clusters.is_empty() {
        write_merged(source, reduction, path, limits.gaussians_together, events)?;
        return Ok(Vec::new());
    }
    write_sequence(&*reduced_trajectories(source, reduction), kind, path, limits.frames_held, events)
}

/// A container with proxies, whose members lie anywhere: a frame block at a time, of as many Gaussians together as
/// `most` allows.
fn write_merged(
    source: &dyn FrameSource,
    reduction: &CompressedModel,
    path: &Path,
    most: usize,
    events: &Events,
) -> Result<()> {
    let merged = merged(source, reduction);
    let SequenceInfo { count, times, sh_degree, varying } = merged.info();
    let (compression, left) = (Compression::Zstd(LEVEL), reduction.sh_degree.min(*sh_degree));
    let mut writer = ContainerWriter::create(path, *count, left, FRAME_BLOCK, compression, BTreeMap::new())?;
    let progress = events.task("emit", "states", (count * times.len()) as u64);
    let parts = parts(&merged, most);
    for start in (0..times.len()).step_by(FRAME_BLOCK) {
        let of_block = start..times.len().min(start + FRAME_BLOCK);
        writer.begin(&times[of_block.clone()])?;
        for part in &parts {
            let mut frames = merged.together(part.clone(), &ReadPlan::new(of_block.clone()).holding(FRAME_BLOCK))?;
            let mut constant = Gaussians::zeros(0, *sh_degree);
            if start == 0 {
                frames.read(start, Columns::all().difference(*varying), &mut constant)?;
            }
            let mut held = HeldFrames::new(part.len(), *sh_degree, *varying, constant);
            for frame in of_block.clone() {
                let mut state = Gaussians::zeros(0, *sh_degree);
                frames.read(frame, *varying, &mut state)?;
                held.push(times[frame], state);
            }
            drop(frames);
            let places: Vec<u32> = (part.start as u32..part.end as u32).collect();
            let change = reduction.change.pick(&places);
            // Where there are proxies there is no course.
            let course = TrajectoryDelta::default();
            let held = Changed::new(Box::new(held), &change, &course, reduction.sh_degree);
            writer.add(&held, part.start, 0..of_block.len(), |done| progress.advance(done))?;
        }
    }
    writer.finish()
}

/// The Gaussians of `merged` in whole blocks, each part made of about `most` Gaussians of the source at most.
fn parts(merged: &MergedSequence<'_>, most: usize) -> Vec<Range<usize>> {
    let count = merged.info().count;
    let (mut parts, mut start, mut made_of) = (Vec::new(), 0, 0);
    for block in (0..count).step_by(GAUSSIAN_BLOCK) {
        let of_block = block..count.min(block + GAUSSIAN_BLOCK);
        let members: usize = of_block.map(|place| merged.members(place)).sum();
        if made_of > 0 && made_of + members > most {
            parts.push(start..block);
            (start, made_of) = (block, 0);
        }
        made_of += members;
    }
    parts.push(start..count);
    parts
}

/// Writes every frame of `source` as any kind that is made of frames; gives things a person should know. Readers of whole
/// frames hold at most `held` of those they decode together.
///
/// # Errors
/// Frames that cannot be read, a failed write.
pub fn write_sequence(
    source: &dyn FrameSource,
    kind: OutputKind,
    path: &Path,
    held: usize,
    events: &Events,
) -> Result<Vec<String>> {
    let info = source.info();
    match kind {
        OutputKind::Splatv => return Ok(vec![write_curves(source, path, events)?]),
        OutputKind::FourDgs => return Ok(vec![write_four_dgs(source, path, events)?]),
        OutputKind::Spz => {
            let off = write_spz(&gather_all(source, 0, Columns::all())?, path)?;
            return Ok(vec![format!("positions are {off:.2e} scene units off at most")]);
        }
        OutputKind::Gseq => {
            let progress = events.task("emit", "states", info.count as u64 * info.times.len() as u64);
            let compression = Compression::Zstd(LEVEL);
            write_container(source, path, compression, BTreeMap::new(), |done| progress.advance(done))?;
            return Ok(Vec::new());
        }
        _ => (),
    }
    let progress = events.task("emit", "frames", info.times.len() as u64);
    let mut states = States::open(source, &ReadPlan::every().holding(held))?;
    for frame in 0..info.times.len() {
        let file = match kind {
            OutputKind::Ply => path.to_owned(),
            _ => path.join(format!("frame_{frame:05}.ply")),
        };
        write_inria(states.at(frame)?, &[], &file)?;
        progress.advance(1);
    }
    Ok(Vec::new())
}
