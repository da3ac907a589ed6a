//! Finds the images of data sets with one COLMAP folder `colmap_K` for each frame, as SpacetimeGaussians prepares them.
//!
//! The cameras do not move: every frame has the cameras of `sparse/0` in the first folder, as in the loader of
//! SpacetimeGaussians. Frame j of n is at time j/n; its images are in the folder with the number K + j, where K is the
//! number of the first folder. A single frame has no time. Source: `readColmapSceneInfo` of the SpacetimeGaussians
//! repository.

use std::fs;
use std::path::{Path, PathBuf};

use super::assemble::ListedImage;
use crate::model::Split;

/// Beginning of the names of the folders `colmap_K`, each of which holds the COLMAP data of one frame.
const PREFIX: &str = "colmap_";

/// Returns the folder of the COLMAP reconstruction (`sparse/0`) in the folder `colmap_K` with the smallest K in `path`;
/// `None` if there is no such folder.
pub(super) fn first_in(path: &Path) -> Option<PathBuf> {
    let entries = fs::read_dir(path).ok()?.flatten();
    let first = entries.filter_map(|entry| number(&entry.path())).min()?;
    Some(path.join(format!("{PREFIX}{first}")).join("sparse/0")).filter(|found| found.is_dir())
}

/// Returns the number K of a folder called `colmap_K`; `None` for other names.
fn number(folder: &Path) -> Option<u32> {
    folder.file_name()?.to_str()?.strip_prefix(PREFIX)?.parse().ok()
}

/// Returns the folder `colmap_K` and its number K if `sparse` is the COLMAP reconstruction `colmap_K/sparse/0`; `None`
/// for other paths.
pub(super) fn find(sparse: &Path) -> Option<(PathBuf, u32)> {
    // Make the path absolute: a path relative to the working folder need not contain the name `colmap_K`.
    let sparse = std::path::absolute(sparse).ok()?;
    let root = sparse.ends_with("sparse/0").then(|| sparse.ancestors().nth(2)).flatten()?;
    number(root).map(|number| (root.to_owned(), number))
}

/// Returns the number of folders `colmap_K` with consecutive numbers K = `first`, `first` + 1, … The folder `root` is
/// the first of them, and the others lie beside it.
pub(super) fn count(root: &Path, first: u32) -> usize {
    (first..=u32::MAX).take_while(|k| root.with_file_name(format!("{PREFIX}{k}")).is_dir()).count()
}

/// Returns the images of all `frames` frames of a data set with one folder `colmap_K` per frame. Every frame has the
/// cameras of the first frame.
///
/// - `images` are the images of the first frame.
/// - `root` is the folder `colmap_K` of the first frame, and `first` its number K. The folder of each later frame has
///   the next number.
/// - The first image of each frame is a test image.
pub(super) fn repeat_for_frames<'a>(
    images: &'a [ListedImage],
    (root, first): &'a (PathBuf, u32),
    frames: usize,
) -> impl Iterator<Item = ListedImage> + 'a {
    let at = move |frame: usize| {
        let folder = root.with_file_name(format!("{PREFIX}{}", u64::from(*first) + frame as u64));
        images.iter().enumerate().map(move |(k, listed)| {
            let image = listed.image.as_ref().map(|image| {
                let whole = std::path::absolute(image).ok();
                let below = whole.as_deref().and_then(|whole| whole.strip_prefix(root).ok());
                below.map_or_else(|| image.clone(), |below| folder.join(below))
            });
            let time = (frames > 1).then(|| frame as f64 / frames as f64);
            let split = if k == 0 { Split::Test } else { listed.split };
            ListedImage { time, view: Some(k as u32), split, image, ..listed.clone() }
        })
    };
    (0..frames).flat_map(at)
}
