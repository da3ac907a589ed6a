//! Streaming access to the list of images in a JSON camera file, and to the keys outside that list.

use std::path::Path;

use crate::error::{Error, Result};
use crate::files::json::lists::{ListSelection, each_element};
use crate::files::json::small::{Keep, SmallValue};
use crate::files::json::{ParseAbort, read};

/// Keys by which a document is recognized, and keys that hold for all of its images.
const OUTLINE_KEYS: [&str; 14] = [
    "frames",
    "w2c",
    "transform_matrix",
    "k",
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "camera_angle_x",
    "camera_angle_y",
    "background",
    "rotation",
];
/// Number of elements kept of each list: a background has three.
const MAX_ELEMENTS: usize = 4;

/// Reads the document in `file` except its images: of each list only the first elements and the length.
///
/// # Errors
/// The file is not valid JSON.
pub(super) fn outline(file: &Path) -> Result<SmallValue> {
    read(file, &ParseAbort::default(), Keep { wanted: &OUTLINE_KEYS, elements: MAX_ELEMENTS })
}

/// Reads the keys `wanted` of a small document.
///
/// # Errors
/// The file is not valid JSON.
pub(super) fn read_keys(file: &Path, wanted: &[&str]) -> Result<SmallValue> {
    read(file, &ParseAbort::default(), Keep { wanted, elements: MAX_ELEMENTS })
}

/// Passes every element of the list under `key`, or of the document itself if `key` is `None`, to `take`, with its
/// index. `wanted` are the keys of each element that are kept.
///
/// # Errors
/// An error of `take`; a key that occurs twice; a file that is not valid JSON.
pub(super) fn each_image(
    file: &Path,
    key: Option<&str>,
    wanted: &[&str],
    mut take: impl FnMut(usize, &SmallValue) -> Result<()>,
) -> Result<()> {
    let mut next = 0;
    each_element(file, ListSelection { keys: key.as_slice(), nested: false, wanted }, |at, element| {
        if at.index != next {
            let place = format!("key \"{}\"", key.unwrap_or_default());
            return Err(Error::input(file, place, "this key once", "twice"));
        }
        next += 1;
        take(at.index, &element)
    })
}
