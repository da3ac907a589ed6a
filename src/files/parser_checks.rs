//! Entry points for fuzzing the parsers of pickles and camera files. They read bytes in memory, because a fuzz target
//! runs millions of inputs and must not write files.

use std::path::Path;

use super::json::lists::{ListSelection, each_element_from};
use super::json::small::{Keep, MAX_ELEMENTS};
use super::json::{ParseAbort, read_from};
use super::pickle::Pickle;
use crate::error::Result;

/// Fuzzing entry point for the pickle parser: reads the pickle `bytes` with at most `memory` bytes of memory and
/// formats a description of each value, which must not panic. Returns the number of values; `None` if the pickle cannot
/// be read.
pub fn check_pickle(bytes: &[u8], memory: u64) -> Option<usize> {
    let pickle = Pickle::read(bytes, memory).ok()?;
    let described: usize = pickle.ids().map(|id| pickle.describe(id).len().min(1)).sum();
    let _ = (pickle.items(pickle.root()).map(Iterator::count), pickle.call(pickle.root()));
    Some(described)
}

/// Fuzzing entry point for the JSON reader of camera files: reads `bytes` once without the lists of images, and once
/// for each kind of list of images that camera files have. Returns the number of values found.
///
/// # Errors
/// Fails if the text is not JSON or exceeds the limits on strings, numbers and nesting.
pub fn check_cameras_json(bytes: &[u8]) -> Result<usize> {
    let path = Path::new("cameras.json");
    let keep = Keep { keys: &["frames", "w2c", "transform_matrix"], elements: MAX_ELEMENTS };
    let outline = read_from(bytes, path, &ParseAbort::default(), keep)?;
    let mut found = outline.describe().len().min(1);
    let element_keys = &["w2c", "transform_matrix", "time"];
    for (keys, nested) in [(&[][..], false), (&["frames"][..], false), (&["k", "w2c"][..], true)] {
        each_element_from(bytes, path, ListSelection { keys, nested, element_keys }, |_, value| {
            found += value.describe().len().min(1);
            Ok(())
        })?;
    }
    Ok(found)
}
