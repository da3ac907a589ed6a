//! Functions that read bytes in memory, for the fuzz targets: these run millions of inputs and must not write files.

use std::path::Path;

use super::json::lists::{ListSelection, each_element_from};
use super::json::small::{Keep, MAX_ELEMENTS};
use super::json::{ParseAbort, read_from};
use super::pickle::Pickle;
use crate::error::Result;

/// Reads the pickle `bytes`, using at most `memory` bytes of memory, and describes each value as text, to test that the
/// description does not panic. Returns the number of values, or `None` if the pickle cannot be read.
pub fn check_pickle(bytes: &[u8], memory: u64) -> Option<usize> {
    let pickle = Pickle::read(bytes, memory).ok()?;
    let described: usize = pickle.ids().map(|id| pickle.describe(id).len().min(1)).sum();
    let _ = (pickle.items(pickle.root()).map(Iterator::count), pickle.call(pickle.root()));
    Some(described)
}

/// Reads `bytes` as the JSON of a camera file: first the values outside the list of frames, then each frame. Returns
/// the number of values found.
///
/// # Errors
/// Fails if the text is not JSON or exceeds the limits on strings, numbers and nesting.
pub fn check_cameras_json(bytes: &[u8]) -> Result<usize> {
    let path = Path::new("cameras.json");
    let keep = Keep { wanted: &["frames", "w2c", "transform_matrix"], elements: MAX_ELEMENTS };
    let outline = read_from(bytes, path, &ParseAbort::default(), keep)?;
    let mut found = outline.describe().len().min(1);
    let wanted = &["w2c", "transform_matrix", "time"];
    for (keys, nested) in [(&[][..], false), (&["frames"][..], false), (&["k", "w2c"][..], true)] {
        each_element_from(bytes, path, ListSelection { keys, nested, wanted }, |_, value| {
            found += value.describe().len().min(1);
            Ok(())
        })?;
    }
    Ok(found)
}
