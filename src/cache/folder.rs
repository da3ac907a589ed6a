//! Listing and cleaning of a work folder, for the command `cache`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use bytesize::ByteSize;
use serde::Serialize;

use crate::cache::entry::{CacheEntry, EXTENSION, EntryName, names};
use crate::error::{Error, Result};
use crate::files::atomic::remove_leftovers;
use crate::model::format_ranges;

/// Stored result of a stage in a work folder, complete or in shards (parts of a divided stage).
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct StoredResult {
    /// Name of the stage.
    pub stage: String,
    /// Cache key of the result, 32 hexadecimal digits.
    pub key: String,
    /// Number of shards (parts of a divided stage) into which the stage was divided; 1: the result is not divided.
    pub parts: usize,
    /// Indices, counted from 1, of the shards (parts of a divided stage) that are not stored.
    pub missing: Vec<usize>,
    /// Indices, counted from 1, of the stored shards (parts of a divided stage) that are damaged and will be computed
    /// again.
    pub damaged: Vec<usize>,
    /// Number of bytes of all files of the result.
    pub bytes: u64,
    /// Description of the input to which the result belongs.
    pub belongs_to: String,
}

/// Returns all stored results in the work folder `folder`, sorted by input and stage. Reads and verifies every byte of
/// them.
///
/// # Errors
/// Fails if the folder cannot be read.
pub fn list_results(folder: &Path) -> Result<Vec<StoredResult>> {
    let mut found: BTreeMap<(String, String, usize), StoredResult> = BTreeMap::new();
    for name in names(folder)? {
        let path = folder.join(name.file());
        let EntryName { stage, key, part: (index, count) } = name;
        let listed = found.entry((stage.clone(), key.clone(), count)).or_insert_with(|| StoredResult {
            stage,
            key: key.clone(),
            parts: count,
            missing: (1..=count).collect(),
            damaged: Vec::new(),
            bytes: 0,
            belongs_to: String::new(),
        });
        listed.missing.retain(|&missing| missing != index);
        listed.bytes += fs::metadata(&path).map_err(Error::io("read the size of", &path))?.len();
        match CacheEntry::open(&path, &key)? {
            Ok(entry) => entry.about().clone_into(&mut listed.belongs_to),
            Err(_) => listed.damaged.push(index),
        }
    }
    let mut found: Vec<StoredResult> = found.into_values().collect();
    found.sort_by(|a, b| (&a.belongs_to, &a.stage, a.parts, &a.key).cmp(&(&b.belongs_to, &b.stage, b.parts, &b.key)));
    Ok(found)
}

/// Formats `results`, the stored results of a work folder, as text for the terminal: a line for each input that results
/// belong to, and below it one line per result.
pub fn format_list(results: &[StoredResult]) -> String {
    let mut out = String::new();
    for run_entries in results.chunk_by(|a, b| a.belongs_to == b.belongs_to) {
        let bytes = ByteSize(run_entries.iter().map(|entry| entry.bytes).sum());
        let belongs_to = if run_entries[0].belongs_to.is_empty() { "damaged" } else { &run_entries[0].belongs_to };
        _ = writeln!(out, "{belongs_to}: {}", bytes.display().si());
        for StoredResult { stage, key, parts, missing, damaged, bytes, .. } in run_entries {
            let mut state = if *parts == 1 { "whole".to_owned() } else { format!("{parts} parts") };
            for (what, which) in [("missing", missing), ("damaged", damaged)] {
                if !which.is_empty() {
                    _ = write!(state, ", {what}: {}", format_ranges(which).join(", "));
                }
            }
            let bytes = ByteSize(*bytes).display().si().to_string();
            _ = writeln!(out, "  {stage:<12} {bytes:>10}  {state}  {}", &key[..8]);
        }
    }
    if results.is_empty() {
        out.push_str("no results are stored here\n");
    }
    out
}

/// Removes all cache entries from the work folder `folder`, and the folder itself if it is empty then. Returns the
/// number of removed files, and the number of their bytes.
///
/// # Errors
/// Fails if the folder cannot be read or a file cannot be removed.
pub fn remove_entries(folder: &Path) -> Result<(usize, u64)> {
    let (mut files, mut bytes) = (0, 0);
    for name in names(folder)? {
        let path = folder.join(name.file());
        bytes += fs::metadata(&path).map_err(Error::io("read the size of", &path))?.len();
        fs::remove_file(&path).map_err(Error::io("remove", &path))?;
        files += 1;
    }
    remove_leftovers(folder, EXTENSION);
    // A folder with files of other programs is not empty, so removing it fails and it stays.
    let _ = fs::remove_dir(folder);
    Ok((files, bytes))
}
