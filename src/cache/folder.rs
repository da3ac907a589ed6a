//! What is in a work folder, for people.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use bytesize::ByteSize;
use serde::Serialize;

use crate::cache::entry::{CacheEntry, ENDING, EntryName, names};
use crate::error::{Error, Result};
use crate::files::atomic::remove_leftovers;
use crate::model::ranges;

/// A result that is in a work folder, in one piece or in parts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Listed {
    /// The stage that found it.
    pub stage: String,
    /// Digest of all that it follows from.
    pub key: String,
    /// How many parts it is in; 1: it is whole.
    pub parts: usize,
    /// Those that are not there.
    pub missing: Vec<usize>,
    /// Those that are damaged, and will be computed again.
    pub damaged: Vec<usize>,
    /// Bytes of its files.
    pub bytes: u64,
    /// What it belongs to.
    pub belongs_to: String,
}

/// Everything in the work folder `folder`, by what it belongs to and by stage. Looks at every byte.
///
/// # Errors
/// A folder that cannot be read.
pub fn list(folder: &Path) -> Result<Vec<Listed>> {
    let mut found: BTreeMap<(String, String, usize), Listed> = BTreeMap::new();
    for name in names(folder)? {
        let path = folder.join(name.file());
        let EntryName { stage, key, part: (index, of) } = name;
        let listed = found.entry((stage.clone(), key.clone(), of)).or_insert_with(|| Listed {
            stage,
            key: key.clone(),
            parts: of,
            missing: (1..=of).collect(),
            damaged: Vec::new(),
            bytes: 0,
            belongs_to: String::new(),
        });
        listed.missing.retain(|&missing| missing != index);
        listed.bytes += fs::metadata(&path).map_err(Error::io("read the size of", &path))?.len();
        match CacheEntry::open(&path, &key)? {
            Ok(piece) => piece.about().clone_into(&mut listed.belongs_to),
            Err(_) => listed.damaged.push(index),
        }
    }
    let mut found: Vec<Listed> = found.into_values().collect();
    found.sort_by(|a, b| (&a.belongs_to, &a.stage, a.parts, &a.key).cmp(&(&b.belongs_to, &b.stage, b.parts, &b.key)));
    Ok(found)
}

/// What was listed, for a person.
pub fn text(listed: &[Listed]) -> String {
    let mut out = String::new();
    for of_run in listed.chunk_by(|a, b| a.belongs_to == b.belongs_to) {
        let bytes = ByteSize(of_run.iter().map(|of| of.bytes).sum());
        let belongs_to = if of_run[0].belongs_to.is_empty() { "damaged" } else { &of_run[0].belongs_to };
        _ = writeln!(out, "{belongs_to}: {}", bytes.display().si());
        for Listed { stage, key, parts, missing, damaged, bytes, .. } in of_run {
            let mut state = if *parts == 1 { "whole".to_owned() } else { format!("{parts} parts") };
            for (what, which) in [("missing", missing), ("damaged", damaged)] {
                if !which.is_empty() {
                    _ = write!(state, ", {what}: {}", ranges(which).join(", "));
                }
            }
            let bytes = ByteSize(*bytes).display().si().to_string();
            _ = writeln!(out, "  {stage:<12} {bytes:>10}  {state}  {}", &key[..8]);
        }
    }
    if listed.is_empty() {
        out.push_str("nothing is kept here\n");
    }
    out
}

/// Removes all pieces of the work folder `folder`, and the folder if nothing else is in it; gives their number and bytes.
///
/// # Errors
/// A folder that cannot be read, a file that cannot be removed.
pub fn clean(folder: &Path) -> Result<(usize, u64)> {
    let (mut files, mut bytes) = (0, 0);
    for name in names(folder)? {
        let path = folder.join(name.file());
        bytes += fs::metadata(&path).map_err(Error::io("read the size of", &path))?.len();
        fs::remove_file(&path).map_err(Error::io("remove", &path))?;
        files += 1;
    }
    remove_leftovers(folder, ENDING);
    // Other files are somebody else's.
    let _ = fs::remove_dir(folder);
    Ok((files, bytes))
}
