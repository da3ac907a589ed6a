//! Size of a model on disk, divided into parts.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::archive::ArchiveSize;
use crate::error::{Error, Result};
use crate::files::open::sorted_entries;

/// Files of a model besides its Gaussians, for [`ModelSize::from_cloud_file`]: none.
pub(super) const NO_FILES: [&str; 0] = [];

/// Size in bytes of all files of a model that a renderer opens, divided into parts. Files that only training reads are
/// not counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelSize {
    /// Bytes of the canonical Gaussians.
    pub cloud: u64,
    /// Bytes of the deformation field.
    pub field: u64,
    /// Bytes of the states of Gaussians that are stored frame by frame.
    pub frames: u64,
    /// Bytes of data other than Gaussians, deformation field and frames, such as the configuration.
    pub rest: u64,
}

impl From<ArchiveSize> for ModelSize {
    fn from(ArchiveSize { cloud, field, rest }: ArchiveSize) -> ModelSize {
        ModelSize { cloud, field, rest, ..ModelSize::default() }
    }
}

impl ModelSize {
    /// Returns the size of a model that consists only of stored frames, which take `frames` bytes.
    pub fn from_frames(frames: u64) -> ModelSize {
        ModelSize { frames, ..ModelSize::default() }
    }

    /// Returns the size of a model whose canonical Gaussians are in the file `cloud`, and whose other data except the
    /// deformation field are in the files `rest`. Fails if the size of a file cannot be read.
    pub(super) fn from_cloud_file(cloud: &Path, rest: impl IntoIterator<Item: AsRef<Path>>) -> Result<ModelSize> {
        Ok(ModelSize { cloud: file_bytes([cloud])?, rest: file_bytes(rest)?, ..ModelSize::default() })
    }

    /// Returns the size of an output folder whose canonical Gaussians are in its file `cloud`. Fails if a size cannot be
    /// read.
    pub(super) fn from_folder(folder: &Path, cloud: &Path) -> Result<ModelSize> {
        let cloud = file_bytes([cloud])?;
        Ok(ModelSize { cloud, rest: bytes_below(folder)?.saturating_sub(cloud), ..ModelSize::default() })
    }

    /// Returns the size of the whole model in bytes.
    pub fn total(&self) -> u64 {
        self.cloud + self.field + self.frames + self.rest
    }

    /// Returns the name and the size in bytes of each of the four parts: canonical Gaussians (`cloud`), deformation
    /// field, frames and rest.
    pub fn named_parts(&self) -> [(&'static str, u64); 4] {
        [("cloud", self.cloud), ("field", self.field), ("frames", self.frames), ("rest", self.rest)]
    }

    /// Returns a text for messages with the name and the bytes of every part whose size is not 0: `cloud 248, field
    /// 1000`.
    pub fn parts_text(&self) -> String {
        let parts = self.named_parts().into_iter().filter(|part| part.1 > 0);
        parts.map(|(name, bytes)| format!("{name} {bytes}")).collect::<Vec<_>>().join(", ")
    }

    /// Returns a text for messages with the bytes of each part of this model, compared with the same part of `before`:
    /// `cloud 248 of 2480 (10.0%)`. A part that only one of the two models has is compared with `none`.
    pub fn format_relative_to(&self, before: &ModelSize) -> String {
        let part = |((name, after), (_, before)): ((_, u64), (_, u64))| match (after, before) {
            (0, 0) => None,
            (0, before) => Some(format!("{name} none of {before}")),
            (after, 0) => Some(format!("{name} {after} of none")),
            (after, before) => Some(format!("{name} {}", format_ratio(after, before))),
        };
        self.named_parts().into_iter().zip(before.named_parts()).filter_map(part).collect::<Vec<_>>().join(", ")
    }

    /// Returns a message that explains why an output of this size is larger than the input, whose size is `before`;
    /// `None` if the output is not larger.
    pub fn why_larger_than(&self, before: &ModelSize) -> Option<String> {
        let (after, whole) = (self.total(), before.total());
        let why = match (self.frames > 0, before.frames > 0) {
            (true, false) => {
                "it holds the states of every frame or motions fitted to them, while the input holds parameters from \
                 which all frames are computed"
            }
            _ => "the input stores its values in fewer bytes than this output format",
        };
        (after > whole).then(|| format!("the result is larger than its input, {after} bytes instead of {whole}: {why}"))
    }
}

/// Formats two numbers of bytes as `{after} of {before}`, followed by the percentage `after` / `before`.
pub fn format_ratio(after: u64, before: u64) -> String {
    format!("{after} of {before} ({:.1}%)", 100.0 * after as f64 / before.max(1) as f64)
}

/// Returns the sum of the sizes of the files `paths` in bytes. Fails if the size of a file cannot be read.
pub(super) fn file_bytes(paths: impl IntoIterator<Item: AsRef<Path>>) -> Result<u64> {
    paths.into_iter().map(|path| Ok(fs::metadata(path.as_ref()).map_err(Error::io("read", path.as_ref()))?.len())).sum()
}

/// Returns the size in bytes of a file, or of all files below a folder.
pub(crate) fn bytes_below(path: &Path) -> Result<u64> {
    let found = fs::metadata(path).map_err(Error::io("read", path))?;
    if !found.is_dir() {
        return Ok(found.len());
    }
    sorted_entries(path)?.iter().map(|entry| bytes_below(entry)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folder_size_is_the_sum_of_its_files() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("a")).unwrap();
        fs::write(folder.path().join("a/b"), [0; 7]).unwrap();
        fs::write(folder.path().join("c"), [0; 5]).unwrap();
        assert_eq!(bytes_below(folder.path()).unwrap(), 12);
        assert_eq!(bytes_below(&folder.path().join("c")).unwrap(), 5);
    }

    #[test]
    fn each_part_is_compared_with_its_counterpart() {
        let model = ModelSize { cloud: 1000, field: 4000, rest: 10, ..ModelSize::default() };
        let small = ModelSize { cloud: 100, field: 2000, rest: 10, ..ModelSize::default() };
        assert_eq!(small.total(), 2110);
        assert_eq!(small.parts_text(), "cloud 100, field 2000, rest 10");
        assert_eq!(
            small.format_relative_to(&model),
            "cloud 100 of 1000 (10.0%), field 2000 of 4000 (50.0%), rest 10 of 10 (100.0%)"
        );
        assert_eq!(
            ModelSize::from_frames(9).format_relative_to(&model),
            "cloud none of 1000, field none of 4000, frames 9 of none, rest none of 10"
        );
    }

    #[test]
    fn only_larger_results_are_explained() {
        let model = ModelSize { cloud: 1000, field: 4000, ..ModelSize::default() };
        assert_eq!(ModelSize::from_frames(5000).why_larger_than(&model), None);
        let why = ModelSize::from_frames(5001).why_larger_than(&model).unwrap();
        assert!(why.contains("5001 bytes instead of 5000") && why.contains("every frame"), "{why}");
        let why = ModelSize::from_frames(3).why_larger_than(&ModelSize::from_frames(2)).unwrap();
        assert!(why.contains("fewer bytes"), "{why}");
    }
}
