//! Unpacking of an archive into files of the original model format, which the renderer of the model opens. Part of the
//! command `convert`.

use std::fs;
use std::io::Read;
use std::path::Path;

use crate::TOOL;
use crate::archive::MAGIC;
use crate::commands::converted::ConvertReport;
use crate::error::{Error, Result};
use crate::files::atomic::{Replace, SUMMARY_FILE, StagedFile, StagedFolder, TargetKind, check_target};
use crate::files::names::name_of;
use crate::files::open::open_file;
use crate::limits::ReadLimit;
use crate::model::Attributes;
use crate::models::archive::{is_folder, read_archive, unpack};
use crate::outputs::kind::{OutputKind, check_folder_name};

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

/// Unpacks the archive at `path` and writes its model to `output`: a model folder, or a PLY file if the archive was
/// made from a PLY file.
///
/// # Errors
/// Fails if the archive is damaged or needs more than `memory`, or if the output exists already or cannot be written.
pub fn unpack_archive(path: &Path, output: &Path, overwrite: Replace, memory: ReadLimit) -> Result<ConvertReport> {
    let (content, parts) = read_archive(path, memory)?;
    let values: usize = content.tensors.values().map(|tensor| tensor.data.len()).sum();
    let attributes = content.cloud.len() * Attributes::all().width(content.cloud.sh_degree());
    let converted = |kind| ConvertReport {
        path: output.to_owned(),
        kind,
        gaussians: content.cloud.len(),
        frames: None,
        bytes: 4 * (values + attributes) as u64,
        larger: None,
        notes: vec![format!(
            "{} bytes of values from an archive of {} bytes",
            4 * (values + attributes),
            parts.total()
        )],
    };
    if !is_folder(&content) {
        check_target(output, TargetKind::File, &[path], overwrite)?;
        let staged = StagedFile::new(output, overwrite)?;
        unpack(&content, path, staged.path())?;
        staged.commit()?;
        return Ok(converted(OutputKind::Ply));
    }
    check_folder_name(output, "convert")?;
    check_target(output, TargetKind::Folder, &[path], overwrite)?;
    let staged = StagedFolder::new(output, overwrite)?;
    unpack(&content, path, staged.path())?;
    let marker = staged.path().join(SUMMARY_FILE);
    let text = serde_json::json!({ "tool": TOOL, "input": { "path": name_of(path) } });
    fs::write(&marker, format!("{text:#}\n")).map_err(Error::io("write", &marker))?;
    staged.commit()?;
    Ok(converted(OutputKind::Model))
}
