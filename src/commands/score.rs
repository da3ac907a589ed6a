//! Command `score`: writes statistics and scores of every Gaussian to a file and removes none.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::{Replace, StagedFile, TargetKind, check_target};
use crate::files::text::serialize_path;
use crate::journal::Journal;
use crate::memory_plan::Workload;
use crate::outputs::rows::RowTable;
use crate::pipeline::planning::InputMeta;
use crate::pipeline::stages::measure::MeasureStages;
use crate::pipeline::{RunPlan, open_to_measure};
use crate::pruning::score::UserOverrides;
use crate::recipe::Recipe;
use crate::scene::InputOptions;

/// Writes statistics and scores of every Gaussian as `.npz` or `.csv`, according to the extension of `output`. Returns
/// the path of the file, and the numbers of all and of the kept Gaussians.
///
/// # Errors
/// Fails if the recipe is invalid, if `output` has another extension, or if the input cannot be read or the output
/// cannot be written.
pub fn score(input: &InputOptions, output: &Path, recipe: &Recipe, overwrite: Replace) -> Result<ScoreReport> {
    recipe.validate().map_err(Error::usage)?;
    let extension = output.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    if !matches!(extension.as_str(), "npz" | "csv") {
        return Err(Error::usage(format!("{}: expected a name that ends in .npz or .csv", output.shown())));
    }
    check_target(output, TargetKind::File, &[&input.path], overwrite)?;
    let journal = &mut Journal::default();
    let plan = |meta: InputMeta, _: &Workload| {
        Ok(RunPlan::measure_only(MeasureStages::new(recipe, meta.has_cameras, UserOverrides::default()), meta))
    };
    let (scene, plan, arrived) = open_to_measure(input, |_| Ok(()), plan, journal)?;
    let scored = plan.measure.measure(&scene, arrived, journal)?;
    let scores = scored.scores(&recipe.score)?;
    let rows = scored.rows()?;
    let table = RowTable {
        rows: &rows,
        static_score: &scores.static_score,
        dynamic_score: &scores.dynamic_score,
        score: &scores.score,
        keep: &scored.selection.keep(),
    };
    let staged = StagedFile::new(output, overwrite)?;
    match extension.as_str() {
        "npz" => table.write_npz(staged.path())?,
        _ => table.write_csv(staged.path())?,
    }
    staged.commit()?;
    Ok(ScoreReport {
        output: output.to_owned(),
        gaussians: scored.gaussian_count(),
        kept: scored.selection.counts.kept,
        notes: scene.notes,
    })
}

/// Result of the command `score`.
#[derive(Debug, Serialize)]
pub struct ScoreReport {
    /// Path of the written file.
    #[serde(serialize_with = "serialize_path")]
    pub output: PathBuf,
    /// Number of rows of the written file, one per Gaussian.
    pub gaussians: usize,
    /// Number of Gaussians that a compression with the recipe would keep before merging.
    pub kept: usize,
    /// Notes for the user.
    pub notes: Vec<String>,
}
