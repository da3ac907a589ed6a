//! The verb `unpack` of an archive: the model that it holds, as files that its renderer opens.

use std::fs;
use std::io::Read;
use std::path::Path;

use crate::TOOL;
use crate::archive::{ArchiveSize, MAGIC};
use crate::error::{Error, Result};
use crate::files::atomic::{Kind, MARKER, Replace, StagedFile, StagedFolder, check_target};
use crate::files::names::name_of;
use crate::files::open::open_file;
use crate::limits::ReadLimit;
use crate::model::Columns;
use crate::models::archive::{is_folder, read_archive, unpack};
use crate::outputs::kind::check_folder_name;

/// What was unpacked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unpacked {
    /// N.
    pub gaussians: usize,
    /// Bytes of the archive.
    pub parts: ArchiveSize,
    /// Bytes of the field's tensors and the cloud's attributes, as f32.
    pub bytes: u64,
}

/// Whether the file at `path` begins as an archive does.
///
/// # Errors
/// A file that cannot be read.
pub fn is_archive(path: &Path) -> Result<bool> {
    if fs::metadata(path).map_err(Error::io("open", path))?.is_dir() {
        return Ok(false);
    }
    let file = open_file(path)?;
    let mut head = Vec::new();
    file.take(MAGIC.len() as u64).read_to_end(&mut head).map_err(Error::io("read", path))?;
    Ok(head == MAGIC)
}

/// Writes what the archive at `path` holds to `output`: a model folder, or a PLY where it is of one.
///
/// # Errors
/// An archive that is damaged, or exceeds `memory`; an output that is there already, or that cannot be written.
pub fn unpack_archive(path: &Path, output: &Path, overwrite: Replace, memory: ReadLimit) -> Result<Unpacked> {
    let (content, parts) = read_archive(path, memory)?;
    let values: usize = content.tensors.values().map(|tensor| tensor.data.len()).sum();
    let attributes = content.cloud.len() * Columns::all().width(content.cloud.sh_degree());
    let unpacked = Unpacked { gaussians: content.cloud.len(), parts, bytes: 4 * (values + attributes) as u64 };
    if !is_folder(&content) {
        check_target(output, Kind::File, &[path], overwrite)?;
        let staged = StagedFile::new(output, overwrite)?;
        unpack(&content, path, staged.path())?;
        staged.commit()?;
        return Ok(unpacked);
    }
    check_folder_name(output, "unpack")?;
    check_target(output, Kind::Folder, &[path], overwrite)?;
    let staged = StagedFolder::new(output, overwrite)?;
    unpack(&content, path, staged.path())?;
    let marker = staged.path().join(MARKER);
    let text = serde_json::json!({ "tool": TOOL, "input": { "path": name_of(path) } });
    fs::write(&marker, format!("{text:#}\n")).map_err(Error::io("write", &marker))?;
    staged.commit()?;
    Ok(unpacked)
}
