//! Subfolders `iteration_K` of a model, as 3DGS and trainers derived from it write them.

use std::fs;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// Returns the number K of each subfolder `iteration_K` of `within`, in increasing order.
///
/// # Errors
/// Fails if the folder cannot be listed.
pub(super) fn iteration_numbers(within: &Path) -> Result<Vec<u32>> {
    let entries = fs::read_dir(within).map_err(Error::io("open", within))?;
    let mut numbers = Vec::new();
    for entry in entries {
        let name = entry.map_err(Error::io("list", within))?.file_name();
        let number = name.to_str().and_then(|name| name.strip_prefix("iteration_"));
        numbers.extend(number.and_then(|number| number.parse::<u32>().ok()));
    }
    numbers.sort_unstable();
    Ok(numbers)
}

/// Finds the subfolder `iteration_K` of `within` for the training iteration `requested`, or for the largest K if
/// `requested` is `None`. Returns K and the path of the subfolder.
///
/// # Errors
/// Fails if the folder cannot be listed or the requested iteration does not exist; the message lists the existing ones.
pub(super) fn find_iteration(within: &Path, requested: Option<u32>) -> Result<(u32, PathBuf)> {
    let numbers = iteration_numbers(within)?;
    let chosen = requested.map_or(numbers.last().copied(), |k| numbers.contains(&k).then_some(k));
    let Some(k) = chosen else {
        let names: Vec<String> = numbers.iter().map(|k| format!("iteration_{k}")).collect();
        let available = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        let expected =
            requested.map_or("a folder iteration_<number>".to_owned(), |k| format!("a folder iteration_{k}"));
        return Err(Error::input(within, "", expected, available));
    };
    Ok((k, within.join(format!("iteration_{k}"))))
}
