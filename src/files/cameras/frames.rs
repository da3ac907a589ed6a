//! Folders `colmap_K`, one for each frame, as SpacetimeGaussians prepares its data.
//!
//! Cameras stand still: those of the first folder's `sparse/0` are those of all, as its loader has it. Frame j of n is at j/n,
//! and its pictures are those of folder K + j; where there is but one frame, it has no time. Source: `readColmapSceneInfo` of
//! the repository.

use std::fs;
use std::path::{Path, PathBuf};

use super::assemble::ListedImage;
use crate::model::Split;

const PREFIX: &str = "colmap_";

/// The reconstruction in the first of the folders `colmap_K` in `path`.
pub(super) fn first_in(path: &Path) -> Option<PathBuf> {
    let entries = fs::read_dir(path).ok()?.flatten();
    let first = entries.filter_map(|entry| number(&entry.path())).min()?;
    Some(path.join(format!("{PREFIX}{first}")).join("sparse/0")).filter(|found| found.is_dir())
}

/// K of a folder `colmap_K`.
fn number(folder: &Path) -> Option<u32> {
    folder.file_name()?.to_str()?.strip_prefix(PREFIX)?.parse().ok()
}

/// The folder `colmap_K` that a reconstruction lies in, and K.
pub(super) fn find(sparse: &Path) -> Option<(PathBuf, u32)> {
    // A path may begin where it was called.
    let sparse = std::path::absolute(sparse).ok()?;
    let root = sparse.ends_with("sparse/0").then(|| sparse.ancestors().nth(2)).flatten()?;
    number(root).map(|number| (root.to_owned(), number))
}

/// How many folders follow one another from that of frame `first` on, beside `root`.
pub(super) fn count(root: &Path, first: u32) -> usize {
    (first..=u32::MAX).take_while(|k| root.with_file_name(format!("{PREFIX}{k}")).is_dir()).count()
}

/// `pictures`, all of frame `first` in `root`, at each of `frames` frames; the first of them is held out.
pub(super) fn repeated<'a>(
    pictures: &'a [ListedImage],
    (root, first): &'a (PathBuf, u32),
    frames: usize,
) -> impl Iterator<Item = ListedImage> + 'a {
    let at = move |frame: usize| {
        let folder = root.with_file_name(format!("{PREFIX}{}", u64::from(*first) + frame as u64));
        pictures.iter().enumerate().map(move |(k, picture)| {
            let image = picture.image.as_ref().map(|image| {
                let whole = std::path::absolute(image).ok();
                let below = whole.as_deref().and_then(|whole| whole.strip_prefix(root).ok());
                below.map_or_else(|| image.clone(), |below| folder.join(below))
            });
            let time = (frames > 1).then(|| frame as f64 / frames as f64);
            let split = if k == 0 { Split::Test } else { picture.split };
            ListedImage { time, view: Some(k as u32), split, image, ..picture.clone() }
        })
    };
    (0..frames).flat_map(at)
}
