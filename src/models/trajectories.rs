//! Functions shared by formats of explicit trajectories. The state of each Gaussian is stored for every frame, so a
//! proxy is the moment match of its members in each frame and no parameters have to be solved for.

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
use crate::model::{Attributes, Gaussians, SequenceInfo};
use crate::outputs::container::{ContainerWriter, FRAME_BLOCK, GAUSSIAN_BLOCK, write_container};
use crate::outputs::curves::write_curves;
use crate::outputs::four_dgs::write_four_dgs;
use crate::outputs::kind::OutputKind;
use crate::passes::{HeldFrames, States, WithDelta, gather_all};
use crate::progress::Events;
use crate::source::{FrameSource, ReadPlan};

/// zstd level of output containers. Higher levels gain about 1% on trained models.
const ZSTD_LEVEL: i32 = 1;

/// Default kind of output of explicit trajectories.
pub const DEFAULT_OUTPUT: OutputKind = OutputKind::PlySequence;

/// Message for inputs that cannot be written as an archive.
pub(super) const NO_ARCHIVE: &str = "only a 4DGaussians or 3DGS model, a PLY, or frames can be written as an \
                                     archive\n  write a .gseq instead, or pack the input into a .gseq first";

/// Returns the bytes of the `columns` of one Gaussian at one frame.
pub fn state_bytes(sh_degree: usize, columns: Attributes) -> u64 {
    columns.iter().map(|column| 4 * column.width(sh_degree) as u64).sum()
}

/// Returns the frames of `source` with Gaussians removed and merged as `reduction` says.
pub(super) fn merged<'a>(source: &'a dyn FrameSource, reduction: &'a CompressedModel) -> MergedSequence<'a> {
    let members = reduction.clusters.iter().map(|cluster| (cluster.output, &cluster.members[..]));
    MergedSequence::new(source, &reduction.kept, members, &reduction.rule)
}

/// Returns the frames of `source` with Gaussians removed and merged, parameter deltas added and the SH degree lowered.
pub(super) fn reduced_trajectories<'a>(
    source: &'a dyn FrameSource,
    reduction: &'a CompressedModel,
) -> Box<dyn FrameSource + 'a> {
    let CompressedModel { change, course, sh_degree, .. } = reduction;
    Box::new(WithDelta::new(Box::new(merged(source, reduction)), change, course, *sh_degree))
}

/// Checks that a sequence of `frames` frames can be written as `kind`.
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

/// Writes the compressed model of `source` as `kind` to `path` and returns notes for the user.
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

/// Writes a container with proxies, whose members can be anywhere in the source. Works by frame block and by groups of
/// Gaussians made of about `max_gaussians` source Gaussians.
fn write_merged(
    source: &dyn FrameSource,
    reduction: &CompressedModel,
    path: &Path,
    max_gaussians: usize,
    events: &Events,
) -> Result<()> {
    let merged = merged(source, reduction);
    let SequenceInfo { count, times, sh_degree, varying } = merged.info();
    let (compression, left) = (Compression::Zstd(ZSTD_LEVEL), reduction.sh_degree.min(*sh_degree));
    let mut writer = ContainerWriter::create(path, *count, left, FRAME_BLOCK, compression, BTreeMap::new())?;
    let progress = events.task("emit", "states", (count * times.len()) as u64);
    let parts = block_ranges(&merged, max_gaussians);
    for start in (0..times.len()).step_by(FRAME_BLOCK) {
        let of_block = start..times.len().min(start + FRAME_BLOCK);
        writer.begin(&times[of_block.clone()])?;
        for part in &parts {
            let mut frames = merged.together(part.clone(), &ReadPlan::new(of_block.clone()).holding(FRAME_BLOCK))?;
            let mut constant = Gaussians::zeros(0, *sh_degree);
            if start == 0 {
                frames.read(start, Attributes::all().difference(*varying), &mut constant)?;
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
            // Models with proxies have no trajectory delta.
            let course = TrajectoryDelta::default();
            let held = WithDelta::new(Box::new(held), &change, &course, reduction.sh_degree);
            writer.add(&held, part.start, 0..of_block.len(), |done| progress.advance(done))?;
        }
    }
    writer.finish()
}

/// Divides the Gaussians of `merged` into ranges of whole blocks. Each range is made of at most `max_gaussians` Gaussians of the
/// source, or is a single block.
fn block_ranges(merged: &MergedSequence<'_>, max_gaussians: usize) -> Vec<Range<usize>> {
    let count = merged.info().count;
    let (mut parts, mut start, mut source_gaussians) = (Vec::new(), 0, 0);
    for block in (0..count).step_by(GAUSSIAN_BLOCK) {
        let places = block..count.min(block + GAUSSIAN_BLOCK);
        let members: usize = places.map(|place| merged.members(place)).sum();
        if source_gaussians > 0 && source_gaussians + members > max_gaussians {
            parts.push(start..block);
            (start, source_gaussians) = (block, 0);
        }
        source_gaussians += members;
    }
    parts.push(start..count);
    parts
}

/// Writes every frame of `source` as a kind of output that consists of frames, and returns notes for the user. Readers
/// of whole frames keep at most `held` of the frames that are decoded together.
///
/// # Errors
/// Fails if frames cannot be read or a write fails.
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
            let off = write_spz(&gather_all(source, 0, Attributes::all())?, path)?;
            return Ok(vec![format!("maximum position error: {off:.2e} scene units")]);
        }
        OutputKind::Gseq => {
            let progress = events.task("emit", "states", info.count as u64 * info.times.len() as u64);
            let compression = Compression::Zstd(ZSTD_LEVEL);
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
