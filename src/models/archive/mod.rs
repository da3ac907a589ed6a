//! Archives (`.gsz`) as a model format. The content of an archive is decoded into a temporary folder and opened there
//! as a model of its own format.
//!
//! The file format is specified in `format/ARCHIVE.md`. Paths in an archive are checked before files are written
//! ([`layout`]).

#[cfg(test)]
pub(super) mod checks;
pub(super) mod files;
mod layout;
pub(super) mod pack;
pub(super) mod reopen;
#[cfg(test)]
mod tests;

use std::fs;
use std::io::Read;
use std::path::Path;

use xxhash_rust::xxh3::xxh3_128;

use files::{CFG_ARGS, ITERATION, write_cloud};
use layout::Layout;

use super::{
    deformable_3d_gaussians, dynamic_3d_gaussians, four_d_gaussians, free_time_gs, native_4d_gaussians, ply_sequence,
    sc_gs, spacetime_gaussians, windowed,
};
use crate::archive::{self, ArchiveContent, ArchiveSize};
use crate::error::{Error, Result};
use crate::files::atomic::ScratchFolder;
use crate::files::open::open_file;
use crate::limits::ReadLimit;
use crate::models::input_model::{FoundInput, OpenOptions};
use crate::models::opened::{InputFormat, Opened};
use crate::models::unpacked::{Original, Unpacked};
use crate::outputs::kind::OutputKind;

/// Model format of archives of compressed models (`.gsz`): recognizes and opens a file.
pub(super) const ENTRY: InputFormat =
    InputFormat { recognizes: |found| found.is_file_of(&archive::MAGIC, "gsz"), open };

/// Model formats whose files an archive stores together with a layout, which states how each file is restored. The
/// first of these formats that recognizes the restored files opens them.
const FORMATS_WITH_LAYOUT: [InputFormat; 8] = [
    windowed::FTGS,
    spacetime_gaussians::ENTRY,
    spacetime_gaussians::SPLATV,
    sc_gs::ENTRY,
    deformable_3d_gaussians::ENTRY,
    native_4d_gaussians::ENTRY,
    free_time_gs::ENTRY,
    dynamic_3d_gaussians::ENTRY,
];

/// Reads the archive at `path`. Returns its decoded content, and the numbers of bytes that the Gaussians, the
/// deformation field and all other data take in the archive.
///
/// # Errors
/// Fails if the archive is damaged or needs more than `memory`.
pub fn read_archive(path: &Path, memory: ReadLimit) -> Result<(ArchiveContent, ArchiveSize)> {
    archive::decode(&load(path, memory)?, path, memory)
}

/// Reads the bytes of the archive at `path`. Checks the header before reading the rest.
fn load(path: &Path, memory: ReadLimit) -> Result<Vec<u8>> {
    let failed = |error| Error::io("read", path)(error);
    let mut file = open_file(path)?;
    let length = file.metadata().map_err(failed)?.len();
    let mut bytes = Vec::new();
    file.by_ref().take(archive::HEADER_BYTES as u64).read_to_end(&mut bytes).map_err(failed)?;
    archive::check_header(&bytes, length, path, memory)?;
    // `check_header` compared the length of the file with the header, so the length is safe to allocate.
    bytes.reserve_exact((length - bytes.len() as u64) as usize);
    file.take(length - bytes.len() as u64).read_to_end(&mut bytes).map_err(failed)?;
    Ok(bytes)
}

/// Writes the content of an archive, which was read from `path`, as the original files: a model folder into the folder
/// `to`, or a single file to the new file `to`.
///
/// # Errors
/// Fails if the content is not a complete model or a write fails.
pub fn unpack(content: &ArchiveContent, path: &Path, to: &Path) -> Result<()> {
    if let Some(layout) = Layout::read(content, path)? {
        return layout.write(content, path, to);
    }
    let Some(cfg_args) = content.files.get(CFG_ARGS) else { return write_cloud(content, path, to) };
    let number = content.files.get(ITERATION).and_then(|text| std::str::from_utf8(text).ok()?.parse::<u32>().ok());
    let Some(iteration) = number else {
        return Err(Error::input(path, ITERATION, "the number of a training iteration", "none"));
    };
    let folder = four_d_gaussians::iteration_folder(to, iteration);
    fs::create_dir_all(&folder).map_err(Error::io("create", &folder))?;
    let config = to.join(CFG_ARGS);
    fs::write(&config, cfg_args).map_err(Error::io("write", &config))?;
    four_d_gaussians::write_field(&content.tensors, &folder.join("deformation.pth"))?;
    write_cloud(content, path, &folder.join("point_cloud.ply"))
}

/// Returns the kind of output that [`unpack`] writes for `content`, the content of the archive at `path`. Returns
/// `None` for a 4DGaussians model folder or a single PLY: only models of other formats have a layout that states the
/// kind.
///
/// # Errors
/// Fails if the layout is malformed.
pub fn restored_output_kind(content: &ArchiveContent, path: &Path) -> Result<Option<OutputKind>> {
    let layout = Layout::read(content, path)?;
    Ok(layout.map(|layout| match layout.files.first().filter(|_| !layout.folder) {
        Some(file) => OutputKind::from_path(Path::new(&file.path), None, OutputKind::Model),
        None => OutputKind::Model,
    }))
}

/// Returns whether `content`, the content of an archive without a layout, is a 4DGaussians model folder rather than a
/// single PLY.
pub fn holds_model_folder(content: &ArchiveContent) -> bool {
    content.files.contains_key(CFG_ARGS)
}

/// Opens the archive at `path`: writes its files to a temporary folder and opens them there.
fn open(path: &Path, options: &OpenOptions) -> Result<Opened> {
    options.refuse_for(path)?;
    let bytes = load(path, options.memory)?;
    let (content, parts) = archive::decode(&bytes, path, options.memory)?;
    let digest = format!("{:032x}", xxh3_128(&bytes));
    drop(bytes);
    let scratch = ScratchFolder::new(&options.scratch())?;
    let opened = if let Some(layout) = Layout::read(&content, path)? {
        let model = layout.restore(&content, path, scratch.path())?;
        drop(content);
        open_restored(&model, path, options)?
    } else if holds_model_folder(&content) {
        unpack(&content, path, scratch.path())?;
        drop(content);
        (four_d_gaussians::ENTRY.open)(scratch.path(), options)?
    } else {
        let file = scratch.path().join("cloud.ply");
        unpack(&content, path, &file)?;
        drop(content);
        (ply_sequence::FILE.open)(&file, options)?
    };
    let original = Original::Archive { digest, size: parts.into() };
    Ok(Opened::Model(Unpacked { _scratch: scratch, kind: "gsz archive", original }.into_model(opened.into_linked()?)))
}

/// Opens the model at `model`, whose files were restored from the archive at `path`.
fn open_restored(model: &Path, path: &Path, options: &OpenOptions) -> Result<Opened> {
    let found = FoundInput::new(model, options.memory)?;
    let format = FORMATS_WITH_LAYOUT.iter().find(|format| (format.recognizes)(&found));
    let unknown = || {
        Error::input(path, layout::LAYOUT, "the files of a model", "files of no known format")
            .hint("the archive is damaged; copy it again")
    };
    (format.ok_or_else(unknown)?.open)(model, options)
}
