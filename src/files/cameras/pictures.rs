//! The pictures that a JSON file lists, one at a time, and what lies around them.

use std::path::Path;

use crate::error::{Error, Result};
use crate::files::json::lists::{Ask, each_element};
use crate::files::json::small::{Keep, Small};
use crate::files::json::{Stopped, read};

/// Keys that say what a document is, and those that hold for all of its pictures.
const AROUND: [&str; 14] = [
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
/// Elements kept of each list: a background has three.
const FEW: usize = 4;

/// Reads what lies around the pictures of the document in `file`: of each list the first elements and their number.
///
/// # Errors
/// A file that is no JSON.
pub(super) fn outline(file: &Path) -> Result<Small> {
    read(file, &Stopped::default(), Keep { wanted: &AROUND, elements: FEW })
}

/// Reads the whole of a small document.
///
/// # Errors
/// A file that is no JSON.
pub(super) fn whole(file: &Path, wanted: &[&str]) -> Result<Small> {
    read(file, &Stopped::default(), Keep { wanted, elements: FEW })
}

/// Hands every element of the list under `key`, or of the document if there is none, to `take`; `wanted` are its keys.
///
/// # Errors
/// Those of `take`; a key that is repeated; a file that is no JSON.
pub(super) fn each_picture(
    file: &Path,
    key: Option<&str>,
    wanted: &[&str],
    mut take: impl FnMut(usize, &Small) -> Result<()>,
) -> Result<()> {
    let mut next = 0;
    each_element(file, Ask { keys: key.as_slice(), nested: false, wanted }, |at, element| {
        if at.index != next {
            let place = format!("key \"{}\"", key.unwrap_or_default());
            return Err(Error::input(file, place, "this key once", "twice"));
        }
        next += 1;
        take(at.index, &element)
    })
}
