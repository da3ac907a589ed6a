//! Reads the files that `compress` writes beside its result: the summary, the recipe, the index map.
//!
//! Input: the path of the result. Output: the files that exist and belong to the two compared models; for every other
//! file the reason why it is not used, which the report page shows. Memory: 8 bytes per Gaussian.

use std::io::{BufRead, BufReader};
use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use crate::files::atomic::SUMMARY_FILE;
use crate::files::names::shown_name;
use crate::files::npy::header_is_sound;
use crate::files::open::open_file;
use crate::files::text::read_text;
use crate::pipeline::RecipeRecord;
use crate::pipeline::stages::write::{INDEX_MAP_FILE, RECIPE_FILE, companion_path};
use crate::pipeline::summary::Summary;
use crate::recipe::Recipe;

/// Fate of one Gaussian of the original: what compression did to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// The Gaussian remains and was not merged.
    Kept,
    /// The Gaussian was merged with others into a proxy (one Gaussian that replaces them).
    Merged,
    /// The Gaussian was removed.
    Dropped,
}

/// Files of `compress` that were found beside a compressed model and belong to it.
#[derive(Debug, Default)]
pub struct RunFiles {
    /// Summary of the `compress` run that wrote the compressed model: parsed, and as the whole JSON content of its
    /// file.
    pub summary: Option<(Summary, Value)>,
    /// Recipe (parameters) of the `compress` run that wrote the compressed model.
    pub recipe: Option<Recipe>,
    /// Whether the user of this run gave the number or the fraction of Gaussians to keep.
    pub has_target: bool,
    /// Fate of every Gaussian of the original (kept, merged or dropped), from the index map (file that maps input to
    /// output Gaussians).
    pub fates: Option<Vec<Fate>>,
    /// One text for each file of `compress` that is absent or cannot be used: its name, and the reason.
    pub missing: Vec<String>,
}

impl RunFiles {
    /// Reads the files that `compress` wrote beside the compressed model at `result`. `original` and `compressed` are
    /// the numbers of Gaussians of the two models.
    ///
    /// A file that is absent or does not fit these numbers is no error: any two models can be compared.
    pub fn read_files_beside(result: &Path, original: usize, compressed: usize) -> RunFiles {
        let is_folder = result.is_dir();
        let mut run = RunFiles::default();
        let take = |name: &str| companion_path(result, is_folder, name);
        let (summary, recipe, map) = (take(SUMMARY_FILE), take(RECIPE_FILE), take(INDEX_MAP_FILE));
        run.summary = run.found(&summary, read_summary(&summary));
        if let Some((found, has_target)) = run.found(&recipe, read_recipe(&recipe)) {
            (run.recipe, run.has_target) = (Some(found), has_target);
        }
        run.fates = run.found(&map, read_fates(&map, original, compressed));
        run
    }

    /// Returns the content `read` of the file `path`. If it cannot be used, adds the reason to the missing files.
    fn found<T>(&mut self, path: &Path, read: Result<T, String>) -> Option<T> {
        read.map_err(|why| self.missing.push(format!("{}: {why}", shown_name(path)))).ok()
    }
}

/// Maximum size of a summary file that is read, in bytes.
const MAX_SUMMARY: u64 = 16 << 20;
/// Maximum size of a recipe file that is read, in bytes.
const MAX_RECIPE: u64 = 1 << 20;

fn read_summary(path: &Path) -> Result<(Summary, Value), String> {
    let text = read_text(path, MAX_SUMMARY).map_err(|e| e.to_string())?;
    let whole: Value = serde_json::from_str(&text).map_err(|e| e.to_string())?;
    let summary = Summary::deserialize(&whole).map_err(|e| format!("not a summary of compress: {e}"))?;
    Ok((summary, whole))
}

/// Returns the recipe in the file `path`, and whether the file states a number or a fraction of Gaussians to keep.
fn read_recipe(path: &Path) -> Result<(Recipe, bool), String> {
    let text = read_text(path, MAX_RECIPE).map_err(|e| e.to_string())?;
    let record = RecipeRecord::read(&text, Path::new(""))?;
    Ok((Recipe::from_toml(&text, "default")?, record.run.is_some_and(|run| run.target().is_some())))
}

fn read_fates(path: &Path, original: usize, compressed: usize) -> Result<Vec<Fate>, String> {
    let file = open_file(path).map_err(|e| e.to_string())?;
    let bytes = file.metadata().map_err(|e| e.to_string())?.len();
    let mut file = BufReader::new(file);
    if !header_is_sound(file.fill_buf().map_err(|e| e.to_string())?, bytes) {
        return Err("expected a NumPy array, found a header that no array of numbers has".to_owned());
    }
    let array = npyz::NpyFile::new(file).map_err(|e| e.to_string())?;
    // The shape is checked before memory for the array is allocated.
    if array.shape() != [original as u64] {
        return Err(format!("expected an array of the original's {original} Gaussians, found {:?}", array.shape()));
    }
    let map: Vec<i64> = array.into_vec().map_err(|e| e.to_string())?;
    fates(&map, compressed)
}

/// Returns the fate of each Gaussian of the original. `map` is the index map: the index of each Gaussian in the output,
/// or −1. Gaussians that share an index were merged. Fails if an index is not below `compressed`, the number of
/// Gaussians of the output.
fn fates(map: &[i64], compressed: usize) -> Result<Vec<Fate>, String> {
    let mut sharers = vec![0u32; compressed];
    for (id, &place) in map.iter().enumerate().filter(|(_, place)| **place != -1) {
        let sharer = usize::try_from(place).ok().and_then(|place| sharers.get_mut(place));
        *sharer.ok_or(format!("Gaussian {id}: expected -1 or a place below {compressed}, found {place}"))? += 1;
    }
    Ok(map
        .iter()
        .map(|&place| match place {
            -1 => Fate::Dropped,
            place if sharers[place as usize] > 1 => Fate::Merged,
            _ => Fate::Kept,
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::outputs::index_map::write_index_map;

    #[test]
    fn gaussians_that_share_a_place_are_merged() {
        use Fate::{Dropped, Kept, Merged};
        assert_eq!(fates(&[0, -1, 1, 0, 2], 3).unwrap(), [Merged, Dropped, Kept, Merged, Kept]);
        assert!(fates(&[0, 3], 3).unwrap_err().contains("Gaussian 1"));
        assert!(fates(&[-2], 3).unwrap_err().contains("-2"));
    }

    #[test]
    fn missing_or_foreign_files_are_named_without_failure() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunFiles::read_files_beside(folder.path(), 4, 2);
        assert!(run.summary.is_none() && run.recipe.is_none() && run.fates.is_none());
        assert_eq!(run.missing.len(), 3);
        write_index_map(&[Some(0), None, Some(1)], &folder.path().join(INDEX_MAP_FILE)).unwrap();
        fs::write(folder.path().join(SUMMARY_FILE), "{\"tool\": \"splatsieve\"}").unwrap();
        fs::write(folder.path().join(RECIPE_FILE), "[select]\nkeep_fraction = 7.0").unwrap();
        let run = RunFiles::read_files_beside(folder.path(), 4, 2);
        assert!(run.fates.is_none() && run.summary.is_none() && run.recipe.is_none());
        for part in ["original's 4 Gaussians, found [3]", "not a summary of compress", "keep_fraction"] {
            assert!(run.missing.iter().any(|why| why.contains(part)), "{part}: {:?}", run.missing);
        }
        assert!(RunFiles::read_files_beside(folder.path(), 3, 2).fates.is_some());
    }
}
