//! Statistics and scores of every Gaussian to a file, nothing removed.

use std::path::{Path, PathBuf};

use super::arrival::open_to_measure;
use super::input::InputOptions;
use super::memory::{Workload, scoring};
use super::scored::{UserOverrides, measure, score_measured};
use super::summary::Stages;
use crate::emit::atomic::{Kind, Replace, StagedFile, check_target};
use crate::emit::rows::RowTable;
use crate::error::{Error, Result};
use crate::plan::Limits;
use crate::recipe::Recipe;

/// Writes the rows of an input as `.npz` or `.csv`, by the output's name.
pub fn score(input: &InputOptions, output: &Path, recipe: &Recipe, overwrite: Replace) -> Result<ScoreReport> {
    recipe.validate().map_err(Error::usage)?;
    let extension = output.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    if !matches!(extension.as_str(), "npz" | "csv") {
        return Err(Error::usage(format!("{}: expected a name that ends in .npz or .csv", output.display())));
    }
    check_target(output, Kind::File, &[&input.path], overwrite)?;
    let stages = &mut Stages::default();
    let needs = |work: &Workload, limits: &Limits, has_cameras| scoring(work, limits, recipe, has_cameras);
    let (scene, measured) = open_to_measure(input, recipe, |_| Ok(()), needs)?;
    let measured = measured.map_or_else(|| measure(&scene, recipe, stages), Ok)?;
    let scored = score_measured(&scene, measured, recipe, &UserOverrides::default(), stages)?;
    let scores = scored.scores(&recipe.score)?;
    let rows = scored.rows()?;
    let table = RowTable {
        rows: &rows,
        static_score: &scores.static_score,
        dynamic_score: &scores.dynamic_score,
        score: &scores.score,
        keep: &scored.selection.keep,
    };
    let staged = StagedFile::new(output, overwrite)?;
    match extension.as_str() {
        "npz" => table.write_npz(staged.path())?,
        _ => table.write_csv(staged.path())?,
    }
    staged.commit()?;
    Ok(ScoreReport {
        output: output.to_owned(),
        gaussians: scored.count(),
        kept: scored.selection.counts.kept,
        notes: scene.notes,
    })
}

/// What `score` wrote.
#[derive(Debug)]
pub struct ScoreReport {
    /// The file.
    pub output: PathBuf,
    /// Rows in it.
    pub gaussians: usize,
    /// Rows the recipe would keep before merging.
    pub kept: usize,
    /// Things a person should know.
    pub notes: Vec<String>,
}
