//! Reads a JSON camera file, which may be large, in two passes: [`outline`] reads everything except the list of images,
//! and [`each_image`] calls a function for one image after another.

use std::path::Path;

use crate::error::{Error, Result};
use crate::files::json::lists::{ListSelection, each_element};
use crate::files::json::small::{Keep, SmallValue};
use crate::files::json::{ParseAbort, read};

/// Keys of intrinsics and lens distortion. They belong to an image or, for all images, to the file.
pub(super) const INTRINSIC_KEYS: [&str; 16] = [
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "camera_angle_x",
    "camera_angle_y",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
    "camera_model",
    "is_fisheye",
];

/// Keys that [`outline`] reads besides [`INTRINSIC_KEYS`]: keys that show in which format the camera file is, and other
/// keys whose values hold for all images of the file.
const OUTLINE_KEYS: [&str; 9] = [
    "frames",
    "w2c",
    "transform_matrix",
    "k",
    "train_filenames",
    "val_filenames",
    "test_filenames",
    "background",
    "rotation",
];
/// Maximum number of elements of each list that are kept in memory. The longest list that is needed, a background
/// color, has three.
const MAX_ELEMENTS: usize = 4;

/// Reads the JSON document in `file` without its images: of each list, only the length and the first 4 elements are
/// kept.
///
/// # Errors
/// Fails if the file is not valid JSON.
pub(super) fn outline(file: &Path) -> Result<SmallValue> {
    read_keys(file, &[&OUTLINE_KEYS[..], &INTRINSIC_KEYS].concat())
}

/// Reads the values of the keys `keys` from a small JSON file.
///
/// # Errors
/// Fails if the file is not valid JSON.
pub(super) fn read_keys(file: &Path, keys: &[&str]) -> Result<SmallValue> {
    read(file, &ParseAbort::default(), Keep { keys, elements: MAX_ELEMENTS })
}

/// Calls `take` with the index and the content of every element of the list under `key`. If `key` is `None`, the list
/// is the document itself. Of each element only the keys `image_keys` are read.
///
/// # Errors
/// Fails if `take` fails, if a key occurs twice, or if the file is not valid JSON.
pub(super) fn each_image(
    file: &Path,
    key: Option<&str>,
    image_keys: &[&str],
    mut take: impl FnMut(usize, &SmallValue) -> Result<()>,
) -> Result<()> {
    let mut next = 0;
    each_element(
        file,
        ListSelection { keys: key.as_slice(), nested: false, element_keys: image_keys },
        |at, element| {
            if at.index != next {
                let place = format!("key \"{}\"", key.unwrap_or_default());
                return Err(Error::input(file, place, "this key once", "twice"));
            }
            next += 1;
            take(at.index, &element)
        },
    )
}
