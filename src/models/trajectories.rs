//! Functions shared by formats of explicit trajectories, where the state of each Gaussian is stored for every frame. A
//! proxy (Gaussian that replaces merged ones) is computed from the merged Gaussians in each frame (mean and covariance
//! of their mixture), so it needs no parameters of its own.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use gseq::Compression;

use crate::compressed_model::{CompressedModel, TrajectoryDelta};
use crate::error::{Error, Result};
use crate::files::glb::write::write_glb;
use crate::files::ply::write::write_inria;
use crate::files::sog::write::{SogErrors, visible_only, write_sog};
use crate::files::spz::{SpzVersion, write_spz};
use crate::fit::MIN_VISIBLE_OPACITY;
use crate::limits::Limits;
use crate::merging::merged_sequence::MergedSequence;
use crate::model::{Attributes, Gaussians, SequenceInfo, opacity};
use crate::outputs::container::{ContainerWriter, FRAME_BLOCK, GAUSSIAN_BLOCK, write_container};
use crate::outputs::curves::write_fitted_splatv;
use crate::outputs::four_dgs::write_four_dgs;
use crate::outputs::gsd::write_gsd;
use crate::outputs::kind::{OutputKind, too_many_frames};
use crate::outputs::time_windows::write_fitted_windows;
use crate::passes::{FrameStates, FramesInMemory, SourceWithDeltas, gather_all};
use crate::progress::Events;
use crate::source::{FrameSource, ReadPlan};

/// zstd compression level of output containers. Higher levels save about 1% of the bytes of trained models.
const ZSTD_LEVEL: i32 = 1;

/// Kind of output that is written for explicit trajectories if the user chooses none.
pub const DEFAULT_OUTPUT: OutputKind = OutputKind::PlySequence;

/// Error message for inputs that cannot be written as an archive.
pub(super) const NO_ARCHIVE: &str = "this input cannot be written as an archive\n  write a .gseq instead, or \
                                     pack the input into a .gseq first";

/// Returns the bytes that the attributes `columns` of one Gaussian at one frame take if every value is stored as f32.
pub fn state_bytes(sh_degree: usize, columns: Attributes) -> u64 {
    columns.iter().map(|column| 4 * column.width(sh_degree) as u64).sum()
}

/// Returns the frames of `source` after Gaussians have been removed and merged as `compressed` says, without its
/// deltas.
pub(super) fn merged<'a>(source: &'a dyn FrameSource, compressed: &'a CompressedModel) -> MergedSequence<'a> {
    let members = compressed.clusters.iter().map(|cluster| (cluster.output, &cluster.members[..]));
    MergedSequence::new(source, &compressed.kept, members, &compressed.merge_params)
}

/// Returns the frames of the compressed model: Gaussians of `source` removed and merged, parameter deltas added and the
/// SH degree lowered, as `compressed` says.
pub(super) fn compressed_trajectories<'a>(
    source: &'a dyn FrameSource,
    compressed: &'a CompressedModel,
) -> Box<dyn FrameSource + 'a> {
    let CompressedModel { delta, trajectory_delta, sh_degree, .. } = compressed;
    Box::new(SourceWithDeltas::new(Box::new(merged(source, compressed)), delta, trajectory_delta, *sh_degree))
}

/// Fails if a sequence of `frames` frames cannot be written as the kind of output `kind` to `path`, except for kinds that
/// hold a single frame ([`OutputKind::check_frames`]). The message says which kinds of output work.
pub(super) fn check_output(frames: usize, kind: OutputKind, path: &Path) -> Result<()> {
    match kind {
        OutputKind::Model => Err(Error::usage(
            "only a trained model can be written as a model folder\n  write a .gseq or --as ply-sequence",
        )),
        OutputKind::Ply if frames != 1 => Err(too_many_frames(frames, "ply", "a .gseq or --as ply-sequence", path)),
        _ => Ok(()),
    }
}

/// Checks that a sequence of `frames` stored frames can be written to `path` as an output of the kind `kind`.
///
/// # Errors
/// Fails if it cannot be written; the message lists kinds of output that work.
pub fn check_frames_output(frames: usize, kind: OutputKind, path: &Path) -> Result<()> {
    kind.check_frames(frames, path)?;
    check_output(frames, kind, path)
}

/// Writes the compressed model `compressed` of `source` as the kind of output `kind` to `path`; returns notes for the
/// user. Fails if frames cannot be read or a write fails.
pub(super) fn write_trajectories(
    source: &dyn FrameSource,
    compressed: &CompressedModel,
    kind: OutputKind,
    path: &Path,
    limits: &Limits,
    events: &Events,
) -> Result<Vec<String>> {
    if kind == OutputKind::Gseq && !compressed.clusters.is_empty() {
        write_merged(source, compressed, path, limits.gaussians_together, events)?;
        return Ok(Vec::new());
    }
    write_sequence(&*compressed_trajectories(source, compressed), kind, path, limits.max_kept_frames, events)
}

/// Writes the compressed model `compressed` of `source`, which has proxies (Gaussians that replace merged ones), to
/// `path` as a container. Writes one block of frames after another, and each of them in ranges of output Gaussians. A
/// range is computed from at most `max_gaussians` source Gaussians, which are kept in memory, because the members of a
/// proxy (merged Gaussians) can be anywhere in the source. A single block of Gaussians may need more.
fn write_merged(
    source: &dyn FrameSource,
    compressed: &CompressedModel,
    path: &Path,
    max_gaussians: usize,
    events: &Events,
) -> Result<()> {
    let merged = merged(source, compressed);
    let SequenceInfo { count, times, sh_degree, varying } = merged.info();
    let (compression, left) = (Compression::Zstd(ZSTD_LEVEL), compressed.sh_degree.min(*sh_degree));
    let mut writer = ContainerWriter::create(path, *count, left, FRAME_BLOCK, compression, BTreeMap::new())?;
    let progress = events.task("emit", "states", (count * times.len()) as u64);
    let parts = block_ranges(&merged, max_gaussians);
    for start in (0..times.len()).step_by(FRAME_BLOCK) {
        let of_block = start..times.len().min(start + FRAME_BLOCK);
        writer.begin_block(&times[of_block.clone()])?;
        for part in &parts {
            let mut frames = merged
                .open_together(part.clone(), &ReadPlan::new(of_block.clone()).with_max_kept_frames(FRAME_BLOCK))?;
            let mut constant = Gaussians::zeros(0, *sh_degree);
            if start == 0 {
                frames.read(start, Attributes::all().difference(*varying), &mut constant)?;
            }
            let mut held = FramesInMemory::new(part.len(), *sh_degree, *varying, constant);
            for frame in of_block.clone() {
                let mut state = Gaussians::zeros(0, *sh_degree);
                frames.read(frame, *varying, &mut state)?;
                held.push(times[frame], state);
            }
            drop(frames);
            let places: Vec<u32> = (part.start as u32..part.end as u32).collect();
            let change = compressed.delta.pick(&places);
            // Compressed models with proxies have no delta that varies in time.
            let no_trajectory_delta = TrajectoryDelta::default();
            let held = SourceWithDeltas::new(Box::new(held), &change, &no_trajectory_delta, compressed.sh_degree);
            writer.add_gaussians(&held, part.start, 0..of_block.len(), |done| progress.advance(done))?;
        }
    }
    writer.finish()
}

/// Divides the output Gaussians into consecutive ranges and returns them. A range consists of whole blocks of
/// [`GAUSSIAN_BLOCK`] Gaussians, which are computed from at most `max_gaussians` source Gaussians. A block that needs
/// more is a range of its own.
fn block_ranges(merged: &MergedSequence<'_>, max_gaussians: usize) -> Vec<Range<usize>> {
    let count = merged.info().count;
    let (mut parts, mut start, mut source_gaussians) = (Vec::new(), 0, 0);
    for block in (0..count).step_by(GAUSSIAN_BLOCK) {
        let places = block..count.min(block + GAUSSIAN_BLOCK);
        let members: usize = places.map(|place| merged.member_count(place)).sum();
        if source_gaussians > 0 && source_gaussians + members > max_gaussians {
            parts.push(start..block);
            (start, source_gaussians) = (block, 0);
        }
        source_gaussians += members;
    }
    parts.push(start..count);
    parts
}

/// Writes the frames of `source` to `path` as `kind`, a kind of output for explicit frames, and returns notes for the
/// user. Several consecutive frames of `source` may be decoded together; at most `max_kept_frames` of them are kept in
/// memory.
///
/// # Errors
/// Fails if frames cannot be read or a write fails.
pub fn write_sequence(
    source: &dyn FrameSource,
    kind: OutputKind,
    path: &Path,
    max_kept_frames: usize,
    events: &Events,
) -> Result<Vec<String>> {
    let info = source.info();
    match kind {
        OutputKind::Splatv => return Ok(vec![write_fitted_splatv(source, path, events)?]),
        OutputKind::Ftgs | OutputKind::Tsog => return write_fitted_windows(source, kind, path, events),
        OutputKind::Gsd => return Ok(vec![write_gsd(source, path, max_kept_frames, events)?]),
        OutputKind::FourDgs => return Ok(vec![write_four_dgs(source, path, events)?]),
        OutputKind::Spz | OutputKind::Spz4 => {
            let version = if kind == OutputKind::Spz { SpzVersion::V3 } else { SpzVersion::V4 };
            return Ok(write_spz(&gather_all(source, 0, Attributes::all())?, version, path)?.notes());
        }
        OutputKind::Sog => {
            return Ok(vec![write_sog(&gather_all(source, 0, Attributes::all())?, path)?.error_note()]);
        }
        OutputKind::Glb => {
            write_glb(&gather_all(source, 0, Attributes::all())?, path)?;
            return Ok(Vec::new());
        }
        OutputKind::SogSequence => return write_sog_sequence(source, path, max_kept_frames, events),
        OutputKind::Gseq => {
            let progress = events.task("emit", "states", info.count as u64 * info.times.len() as u64);
            let compression = Compression::Zstd(ZSTD_LEVEL);
            write_container(source, path, compression, BTreeMap::new(), |done| progress.advance(done))?;
            return Ok(Vec::new());
        }
        _ => (),
    }
    let progress = events.task("emit", "frames", info.times.len() as u64);
    let mut states = FrameStates::open(source, &ReadPlan::all_frames().with_max_kept_frames(max_kept_frames))?;
    let mut visible = 0;
    for frame in 0..info.times.len() {
        let file = match kind {
            OutputKind::Ply => path.to_owned(),
            _ => path.join(format!("frame_{frame:05}.ply")),
        };
        let state = states.read(frame)?;
        write_inria(state, &[], &file)?;
        visible += state.opacity_logit.plane(0).iter().filter(|&&logit| opacity(logit) >= MIN_VISIBLE_OPACITY).count();
        progress.advance(1);
    }
    let written = info.count * info.times.len();
    let is_sparse = kind == OutputKind::PlySequence && 2 * visible < written;
    let percent = 100.0 * visible as f64 / written as f64;
    Ok(Vec::from_iter(is_sparse.then(|| {
        format!(
            "every frame has all {} Gaussians, of which {percent:.0}% on average are visible; if the input is a \
             container, --link apart writes only the visible ones of each frame",
            info.count
        )
    })))
}

/// Writes every frame of `source` to a file `frame_0000.sog`, `frame_0001.sog`, … in the folder `path`, without the
/// Gaussians that are not drawn in this frame. Returns a note with the largest errors of all frames. At most
/// `frames_in_memory` decoded frames are kept in memory.
fn write_sog_sequence(
    source: &dyn FrameSource,
    path: &Path,
    frames_in_memory: usize,
    events: &Events,
) -> Result<Vec<String>> {
    let frames = source.info().times.len();
    let progress = events.task("emit", "frames", frames as u64);
    let mut states = FrameStates::open(source, &ReadPlan::all_frames().with_max_kept_frames(frames_in_memory))?;
    let mut errors = SogErrors::default();
    for frame in 0..frames {
        let state = visible_only(states.read(frame)?);
        errors = errors.max(write_sog(&state, &path.join(format!("frame_{frame:04}.sog")))?);
        progress.advance(1);
    }
    Ok(vec![errors.error_note()])
}
