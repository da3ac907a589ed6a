//! Writing of an archive, and unpacking of an archive into files that the renderer of the model opens. Part of the
//! command `convert`.

use std::fs;
use std::io::Read;
use std::path::Path;

use crate::TOOL;
use crate::archive::MAGIC;
use crate::commands::convert_report::ConvertReport;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::{Replace, StagedFile, StagedFolder, TargetKind, check_target, write_summary};
use crate::files::names::name_of;
use crate::files::open::open_file;
use crate::journal::Journal;
use crate::limits::ReadLimit;
use crate::model::Attributes;
use crate::models::archive::{holds_model_folder, read_archive, restored_output_kind, unpack};
use crate::models::size::bytes_below;
use crate::models::{InputModel, TimeOrigin};
use crate::outputs::kind::{OutputKind, check_folder_name};
use crate::pipeline::stage::PreparedArchive;
use crate::pipeline::stages::archive::ArchiveStage;
use crate::pipeline::stages::reference_views::{ArchiveTarget, reference_views};
use crate::pipeline::stages::write::write_within;
use crate::recipe::Recipe;
use crate::scene::{InputOptions, open_scene};

/// Returns whether the file at `path` begins with the magic bytes of an archive; false for a folder.
///
/// # Errors
/// Fails if the file cannot be read.
pub fn is_archive(path: &Path) -> Result<bool> {
    if fs::metadata(path).map_err(Error::io("open", path))?.is_dir() {
        return Ok(false);
    }
    let file = open_file(path)?;
    let mut head = Vec::new();
    file.take(MAGIC.len() as u64).read_to_end(&mut head).map_err(Error::io("read", path))?;
    Ok(head == MAGIC)
}

/// Restores the model in the archive at `path` in its original form, a model folder or a single file, and writes it to
/// `output`. Returns `None` and writes nothing if `kind`, the requested format, is not the original format:
/// - If the archive states the file layout of its model format, this layout determines the original format.
/// - Otherwise the archive holds a model folder or a PLY file. A folder is restored if `kind` is either of the two, a
///   PLY file if `kind` is this format.
///
/// After `None`, the caller opens the archive as an input and converts it.
///
/// # Errors
/// Fails if the archive is damaged or needs more than `memory`, if it holds a PLY file and `kind` is a model folder, or
/// if the output exists already or cannot be written.
pub fn unpack_archive(
    path: &Path,
    (output, kind): (&Path, OutputKind),
    overwrite: Replace,
    memory: ReadLimit,
) -> Result<Option<ConvertReport>> {
    let (content, parts) = read_archive(path, memory)?;
    let with_layout = restored_output_kind(&content, path)?;
    match with_layout {
        Some(own) if own != kind => return Ok(None),
        // An archive without a file layout holds a model folder or a PLY file.
        None if !matches!(kind, OutputKind::Model | OutputKind::Ply) => return Ok(None),
        _ => (),
    }
    let columns = content.columns.iter().map(|column| column.values.planes().len());
    let values: usize = content.tensors.values().map(|tensor| tensor.data.len()).chain(columns).sum();
    let attributes = content.cloud.len() * Attributes::all().width(content.cloud.sh_degree());
    let converted = |kind, bytes| ConvertReport {
        path: output.to_owned(),
        kind,
        gaussians: content.cloud.len(),
        frames: None,
        bytes,
        larger: None,
        notes: vec![format!(
            "{} bytes of values from an archive of {} bytes",
            4 * (values + attributes),
            parts.total()
        )],
    };
    let single = with_layout.map_or(!holds_model_folder(&content), |own| own != OutputKind::Model);
    if single {
        if with_layout.is_none() && kind == OutputKind::Model {
            return Err(Error::usage(format!(
                "{}: the archive {} holds one PLY and no model folder\n  give a name that ends in .ply",
                output.shown(),
                path.shown()
            )));
        }
        check_target(output, TargetKind::File, &[path], overwrite)?;
        let staged = StagedFile::new(output, overwrite)?;
        unpack(&content, path, staged.path())?;
        let bytes = bytes_below(staged.path())?;
        staged.commit()?;
        return Ok(Some(converted(with_layout.unwrap_or(OutputKind::Ply), bytes)));
    }
    check_folder_name(output, "convert")?;
    check_target(output, TargetKind::Folder, &[path], overwrite)?;
    let staged = StagedFolder::new(output, overwrite)?;
    unpack(&content, path, staged.path())?;
    let bytes = bytes_below(staged.path())?;
    write_summary(staged.path(), &serde_json::json!({ "tool": TOOL, "input": { "path": name_of(path) } }))?;
    staged.commit()?;
    Ok(Some(converted(OutputKind::Model, bytes)))
}

/// Checks that `--frames 1` is not combined with an output of the kind `kind` that stores the motion of the continuous
/// model `model`: it would hold all frames. `input` holds the options of the user, `output` the path of the output.
///
/// # Errors
/// Returns [`Error::Usage`] with outputs that hold one frame.
pub fn check_frame_count_applies(
    input: &InputOptions,
    model: &dyn InputModel,
    kind: OutputKind,
    output: &Path,
) -> Result<()> {
    let is_one_frame = input.frames == Some(1) && model.description().timing == TimeOrigin::Continuous;
    match is_one_frame && model.keeps_motion(kind) {
        true => Err(Error::usage(format!(
            "{}: --frames 1 asks for one frame, but this output holds the whole model with its motion\n  leave out \
             --frames, or write one frame as .spz, .sog, .glb or --as ply-sequence",
            output.shown()
        ))),
        false => Ok(()),
    }
}

/// Writes all Gaussians of `input` to the archive `output`. The quantization steps are chosen so that renders of the
/// archive have about 50 dB PSNR against renders of the input. If the input stores every frame explicitly, the archive
/// is a container with an error bound for each attribute; the bounds are chosen for the same PSNR. Returns the report
/// on the written file.
///
/// # Errors
/// Fails if the input cannot be read or cannot be stored in an archive (such as a frame stream), or if the output
/// exists already or cannot be written.
pub fn write_archive(input: &InputOptions, output: &Path, overwrite: Replace) -> Result<ConvertReport> {
    if input.is_stream() {
        return Err(Error::usage(
            "convert writes no archive of a stream\n  write a .gseq, or use compress - -o NAME.gsz",
        ));
    }
    check_target(output, TargetKind::File, &[&input.path], overwrite)?;
    let mut scene = open_scene(input)?;
    check_frame_count_applies(input, &*scene.input, OutputKind::Archive, output)?;
    scene.input.check_output(OutputKind::Archive, output)?;
    let stage = ArchiveStage { psnr: None, refine: None };
    scene.plan_memory(input.memory, |work, limits| vec![stage.resource_estimate(work, limits)])?;
    let info = scene.source().info();
    let (gaussians, frames) = (info.count, info.times.len());
    let all = CompressedModel::pruned((0..gaussians as u32).collect(), &Recipe::preset("default")?.merge);
    let mut journal = Journal { whole: scene.full_read()?, notes: scene.notes.clone(), ..Journal::default() };
    let (archived, summary) = stage.archive(&scene, &all, ArchiveTarget::Nothing, &[], &mut journal)?;
    let staged = StagedFile::new(output, overwrite)?;
    match archived {
        PreparedArchive::Content(encoded) => {
            fs::write(staged.path(), &encoded.bytes).map_err(Error::io("write", staged.path()))?;
        }
        PreparedArchive::Frames(bounds) => {
            write_within(&*scene.input.compressed_frames(&all)?, bounds, staged.path(), &scene.events)?;
        }
    }
    let bytes = fs::metadata(staged.path()).map_err(Error::io("read", staged.path()))?.len();
    staged.commit()?;
    let views = reference_views(&scene).len();
    let of_cameras = if scene.has_virtual_rig { "virtual views" } else { "views of the cameras" };
    journal
        .notes
        .push(format!("archive: {:.2} dB PSNR against renders of the input ({views} {of_cameras})", summary.psnr));
    Ok(ConvertReport {
        path: output.to_owned(),
        kind: OutputKind::Archive,
        gaussians,
        frames: Some(frames),
        bytes,
        larger: None,
        notes: journal.notes,
    })
}
