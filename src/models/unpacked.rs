//! Inputs that are unpacked into temporary files, and opened from there as an input of another format.

use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::size::{ModelSize, file_bytes};
use crate::archive::ArchiveContent;
use crate::compressed_model::{Cluster, CompressedModel, Proxies, ReferenceFrame};
use crate::error::Result;
use crate::files::atomic::ScratchFolder;
use crate::files::digest::hash_file;
use crate::files::open::sorted_entries;
use crate::limits::Limits;
use crate::model::Gaussians;
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription, TimeOrigin};
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Input that was unpacked into temporary files: the files, and facts about the original input.
pub(super) struct Unpacked {
    /// Folder with the temporary files, which is deleted when this value is dropped.
    pub(super) _scratch: ScratchFolder,
    /// Name of the format of the original input, shown to users.
    pub(super) kind: &'static str,
    pub(super) original: Original,
}

/// Original of an input that was unpacked into temporary files.
pub(super) enum Original {
    /// Archive (`.gsz`): hash of its bytes, and its size.
    Archive { digest: String, size: ModelSize },
    /// Files with one frame each, or folders with the files of one frame each.
    Frames(Vec<PathBuf>),
    /// Frames with time stamps, such as a stream: their number of bytes.
    Stamped(u64),
}

/// Model or sequence of frames that was opened from temporary files.
struct UnpackedModel {
    inner: Box<dyn InputModel>,
    unpacked: Unpacked,
}

impl Unpacked {
    /// Returns the input as a model. `inner` was opened from the temporary files.
    pub(super) fn into_model(self, inner: Box<dyn InputModel>) -> Box<dyn InputModel> {
        Box::new(UnpackedModel { inner, unpacked: self })
    }
}

impl InputModel for UnpackedModel {
    fn description(&self) -> ModelDescription {
        let inner = ModelDescription { kind: self.unpacked.kind, ..self.inner.description() };
        match self.unpacked.original {
            Original::Archive { .. } => ModelDescription { has_explicit_frames: false, ..inner },
            Original::Frames(_) => inner,
            Original::Stamped(_) => ModelDescription { timing: TimeOrigin::Stamped, ..inner },
        }
    }

    fn source(&self) -> &dyn FrameSource {
        self.inner.source()
    }

    fn digest(&self) -> Result<String> {
        match &self.unpacked.original {
            Original::Archive { digest, .. } => Ok(digest.clone()),
            Original::Frames(paths) => {
                let mut hash = Xxh3::new();
                for path in files_of_frames(paths)? {
                    hash.update(path.file_name().unwrap_or_default().as_encoded_bytes());
                    hash_file(&path, &mut hash)?;
                }
                Ok(format!("{:032x}", hash.digest128()))
            }
            Original::Stamped(_) => self.inner.digest(),
        }
    }

    fn size(&self) -> Result<ModelSize> {
        Ok(match &self.unpacked.original {
            Original::Archive { size, .. } => *size,
            Original::Frames(paths) => ModelSize::from_frames(file_bytes(files_of_frames(paths)?)?),
            Original::Stamped(bytes) => ModelSize::from_frames(*bytes),
        })
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        self.inner.size_written(kind, path)
    }

    fn stored_bytes(&self) -> Result<u64> {
        self.inner.stored_bytes()
    }

    fn memory_profile(&self) -> MemoryProfile {
        self.inner.memory_profile()
    }

    fn hold_decoded(&self) {
        self.inner.hold_decoded();
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        Ok(self.unpacked.into_model(self.inner.with_times(times)?))
    }

    fn merge_class(&self, id: u32) -> u8 {
        self.inner.merge_class(id)
    }

    fn canonical(&self) -> Option<&Gaussians> {
        self.inner.canonical()
    }

    fn keeps_motion(&self, kind: OutputKind) -> bool {
        self.inner.keeps_motion(kind)
    }

    fn motion_note(&self, kind: OutputKind) -> Option<&'static str> {
        self.inner.motion_note(kind)
    }

    fn check_output(&self, kind: OutputKind, path: &Path) -> Result<()> {
        self.inner.check_output(kind, path)
    }

    fn compute_proxies(&self, clusters: &[Cluster], reference: ReferenceFrame, rule: &MergeParams) -> Result<Proxies> {
        self.inner.compute_proxies(clusters, reference, rule)
    }

    fn can_round_field(&self) -> Result<bool> {
        self.inner.can_round_field()
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        self.inner.archive_content(compressed)
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.inner.decode_frames(content)
    }

    fn compressed_frames<'a>(&'a self, compressed: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        self.inner.compressed_frames(compressed)
    }

    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        self.inner.write(compressed, kind, path, limits, events)
    }
}

/// Returns `paths` with each folder replaced by the files in it, sorted by name. Fails if a folder cannot be listed.
fn files_of_frames(paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        files.extend(sorted_entries(path)?.into_iter().filter(|file| file.is_file()));
    }
    Ok(files)
}
