//! Command `convert`: writes any input in another format, with all its Gaussians unchanged.
//!
//! Containers are written by [`container::pack`](super::container::pack); archives are unpacked by
//! [`unpack_archive`].

use std::path::Path;

use crate::TOOL;
use crate::commands::archive::{check_frame_count_applies, is_archive, unpack_archive, write_archive};
use crate::commands::convert_report::ConvertReport;
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::files::atomic::{Replace, StagedFile, StagedFolder, TargetKind, check_target, write_summary};
use crate::limits::Limits;
use crate::memory_plan::{MemoryPlan, ResourceEstimate, Workload};
use crate::model::Attributes;
use crate::models::ModelSize;
use crate::outputs::kind::{OutputKind, check_folder_name};
use crate::outputs::time_windows::{MAX_SINGLE_FRAME_GAUSSIANS, is_windowed};
use crate::passes::TRACKS_PER_BLOCK;
use crate::pipeline::stages::write::ENCODE_SECONDS_PER_STATE;
use crate::pipeline::summary::InputSummary;
use crate::recipe::Recipe;
use crate::scene::{InputOptions, open_input};

/// Approximate bytes of memory per Gaussian for the curve segments that are fitted to its track (its values at all
/// frames), and for their encoding. Assumes a few segments per Gaussian.
const FITTED_BYTES: u64 = 4 * 600;

/// Bytes of memory per Gaussian and frame for the images of a `.tsog` file that stores every frame by itself instead of
/// curves.
const FRAME_IMAGE_BYTES: u64 = 8 * 4 + 64;

/// Returns whether `convert` writes a container to `output`. `requested`: requested format; `None`: the format follows
/// from the name of `output`.
pub fn is_container(output: &Path, requested: Option<OutputKind>) -> bool {
    OutputKind::from_path(output, requested, OutputKind::Model) == OutputKind::Gseq
}

/// Writes all Gaussians of `input` to `output` in the format `requested`. If `requested` is `None`, the format follows
/// from the name of the output. If the output is then a folder, its format is the input's own model format, or one PLY
/// file per frame if the input has no model format (a container or a frame stream).
///
/// # Errors
/// Fails if the input cannot be read or cannot be written in this format, or if the output exists already.
pub fn convert(
    input: &InputOptions,
    output: &Path,
    requested: Option<OutputKind>,
    overwrite: Replace,
) -> Result<ConvertReport> {
    if requested.is_none() {
        OutputKind::check_name(output)?;
    }
    let named = OutputKind::from_path(output, requested, OutputKind::Model);
    if named == OutputKind::Archive {
        return write_archive(input, output, overwrite);
    }
    let may_unpack = matches!(named, OutputKind::Model | OutputKind::Ply | OutputKind::Splatv | OutputKind::Ftgs)
        && !input.is_stream();
    if may_unpack
        && is_archive(&input.path)?
        && let Some(unpacked) = unpack_archive(&input.path, (output, named), overwrite, input.memory.read_limit())?
    {
        return Ok(unpacked);
    }
    let opened = open_input(input)?;
    let (model, source) = (&*opened.input, opened.input.source());
    let own = match model.description().default_output_kind {
        OutputKind::Gseq => OutputKind::PlySequence,
        own => own,
    };
    let kind = OutputKind::from_path(output, requested, own);
    if kind.is_folder() {
        check_folder_name(output, "convert")?;
    }
    let target = if kind.is_folder() { TargetKind::Folder } else { TargetKind::File };
    check_target(output, target, &[&input.path], overwrite)?;
    let (gaussians, frames) = (source.info().count, source.info().times.len());
    check_frame_count_applies(input, model, kind, output)?;
    kind.check_frames(frames, output)?;
    model.check_output(kind, output)?;
    let work = Workload::new(source.info(), model.memory_profile());
    let plan =
        MemoryPlan::fit_budget(work, input.memory, &input.events, |work, limits| vec![estimate(kind, work, limits)])?;
    plan.send_stage_times(input.memory.tell, &input.events);
    let all = CompressedModel::pruned((0..gaussians as u32).collect(), &Recipe::preset("default")?.merge);
    let mut notes = opened.notes;
    notes.extend(model.motion_note(kind).map(str::to_owned));
    let mut write = |path: &Path| -> Result<ModelSize> {
        notes.extend(model.write(&all, kind, path, &plan.limits, &input.events)?);
        model.size_written(kind, path)
    };
    let size = if kind.is_folder() {
        let staged = StagedFolder::new(output, overwrite)?;
        let size = write(staged.path())?;
        let summary = serde_json::json!({
            "tool": TOOL,
            "input": InputSummary::new(model, &input.path, model.digest()?)?.without_folder_paths(),
        });
        write_summary(staged.path(), &summary)?;
        staged.commit()?;
        size
    } else {
        let staged = StagedFile::new(output, overwrite)?;
        let size = write(staged.path())?;
        staged.commit()?;
        size
    };
    let frames = if model.motion_note(kind).is_some() { 1 } else { frames };
    let (bytes, larger) = (size.total(), size.why_larger_than(&model.size()?));
    Ok(ConvertReport { path: output.to_owned(), kind, gaussians, frames: Some(frames), bytes, larger, notes })
}

/// Returns the resource estimate (memory and time) of writing all frames once in the format `kind`, including the fit
/// of curves for formats that store curves.
fn estimate(kind: OutputKind, work: &Workload, limits: &Limits) -> ResourceEstimate {
    let state_bytes = work.state_bytes(Attributes::all());
    let fits = matches!(kind, OutputKind::Splatv | OutputKind::FourDgs) || is_windowed(kind);
    let tracked = work.threads * TRACKS_PER_BLOCK as u64 * work.frames * state_bytes;
    let mut fixed = work.write_buffers();
    fixed.push(("tracks", if fits { 2 * tracked } else { 0 }));
    let single =
        (work.gaussians * work.frames).min(MAX_SINGLE_FRAME_GAUSSIANS as u64) * (state_bytes + FRAME_IMAGE_BYTES);
    fixed.push(("single frames", if kind == OutputKind::Tsog { single } else { 0 }));
    let per_gaussian = vec![
        ("survivors", 16),
        ("result", work.input.compressed + work.input.file + state_bytes),
        ("readers", work.input.reader),
        ("kept frames", if fits { 0 } else { work.kept_frames_bytes(limits, Attributes::all()) }),
        ("fitted", if fits { FITTED_BYTES } else { 0 }),
        ("encoded", kind.encoding_bytes(state_bytes)),
    ];
    let seconds = work.reading_seconds(work.gaussian_count(), work.frames as f64)
        + work.gaussian_count() * work.frames as f64 * ENCODE_SECONDS_PER_STATE;
    ResourceEstimate { stage: "convert", reads: 1.0, seconds, per_gaussian, fixed }
}
