//! The main job: scan, score, select, merge, emit.

use std::path::PathBuf;

use super::arrival::open_to_measure;
use super::choose::{Chosen, choose};
use super::input::{InputOptions, Scene};
use super::memory::{Workload, compressing};
use super::merging::sieve;
use super::output::{OutputKind, check_output, write_result};
use super::overrides::parse_ids;
use super::refit::refit;
use super::rounds::rank_in_rounds;
use super::scored::{Measured, Scored, UserOverrides, measure, score_measured};
use super::summary::{CameraSummary, LeftOut, Stages, Summary};
use crate::emit::atomic::Replace;
use crate::error::{Error, Result};
use crate::plan::Limits;
use crate::recipe::{Coverage, Recipe};

/// Which of pruning and merging to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Only {
    /// Prune, then merge.
    #[default]
    Both,
    /// The paper's "pruned".
    Prune,
    /// The paper's "merged".
    Merge,
}

/// How many Gaussians the output is to have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    /// This many.
    Count(u64),
    /// This fraction of the input, in (0, 1], rounded to the nearest and at least one.
    Ratio(f64),
}

/// Everything a compression is asked for.
#[derive(Debug, Clone)]
pub struct CompressOptions {
    /// What to read.
    pub input: InputOptions,
    /// Where to write.
    pub output: PathBuf,
    /// What to write; none: by the output's name.
    pub kind: Option<OutputKind>,
    /// All hyper-parameters.
    pub recipe: Recipe,
    /// Which stages to run.
    pub only: Only,
    /// Exact size of the output, if asked for.
    pub target: Option<Target>,
    /// Ids to keep: a list or a file.
    pub keep_ids: Option<String>,
    /// Ids to drop: a list or a file.
    pub drop_ids: Option<String>,
    /// Box whose Gaussians are kept.
    pub keep_box: Option<[f64; 6]>,
    /// Write nothing.
    pub dry_run: bool,
    /// Replace an earlier output.
    pub overwrite: Replace,
}

impl CompressOptions {
    /// Prunes and merges `input` to the recipe's own size, keeps and drops nobody in particular, replaces nothing.
    pub fn new(input: InputOptions, output: PathBuf, recipe: Recipe) -> Self {
        CompressOptions {
            input,
            output,
            kind: None,
            recipe,
            only: Only::Both,
            target: None,
            keep_ids: None,
            drop_ids: None,
            keep_box: None,
            dry_run: false,
            overwrite: Replace::Never,
        }
    }
}

/// Writes a smaller model and says what was done.
///
/// # Errors
/// Whatever is wrong with input, cameras, recipe or output. Nothing is left behind then.
pub fn compress(options: &CompressOptions) -> Result<Summary> {
    options.recipe.validate().map_err(Error::usage)?;
    let mut stages = Stages::default();
    let is_stream = options.input.is_stream();
    let needs = |work: &Workload, limits: &Limits, has_cameras| {
        let kind = OutputKind::planned(&options.output, options.kind, work.resident > 0);
        compressing(work, limits, &options.recipe, options.only, kind, has_cameras)
    };
    let name = if is_stream { "receive" } else { "read" };
    let (scene, measured) = stages.run(name, 0, f64::from(u8::from(is_stream)), || {
        let check = |count| options.check_stream(count);
        let (scene, measured) = open_to_measure(&options.input, &options.recipe, check, needs)?;
        let count = scene.input.source().info().count;
        Ok::<_, Error>(((scene, measured), count))
    })?;
    Ok(compress_measured(&scene, measured, options, stages)?.0)
}

/// [`compress`] of a scene that is open already; also gives every Gaussian's place in the output.
pub fn compress_scene(scene: &Scene, options: &CompressOptions, stages: Stages) -> Result<(Summary, Vec<Option<u32>>)> {
    compress_measured(scene, None, options, stages)
}

/// [`compress_scene`] of a scene that may have been measured as it arrived.
fn compress_measured(
    scene: &Scene,
    measured: Option<Measured>,
    options: &CompressOptions,
    mut stages: Stages,
) -> Result<(Summary, Vec<Option<u32>>)> {
    let recipe = &options.recipe;
    let info = scene.input.source().info();
    let kind = OutputKind::of(&options.output, options.kind, &scene.input)?;
    check_output(&options.output, kind, &[&scene.path], options.overwrite)?;
    let target = options.target.map(|target| target.count(info.count)).transpose()?;
    let user = options.overrides(info.count)?;
    let input = scene.input.summary(&scene.path)?;
    let measured = measured.map_or_else(|| measure(scene, recipe, &mut stages), Ok)?;
    let mut scored = score_measured(scene, measured, recipe, &user, &mut stages)?;
    if options.only != Only::Merge {
        let fewest = target.unwrap_or(scored.selection.counts.kept);
        rank_in_rounds(scene, &mut scored, recipe, fewest, &mut stages)?;
    }
    let sieved = sieve(scene, &scored, recipe, options.only, target, &mut stages)?;
    let chosen = match recipe.select.choose_by_views && options.only != Only::Merge {
        true => choose(scene, &scored, recipe, sieved, target, &mut stages)?,
        false => Chosen { sieved, left_out: Vec::new(), notes: Vec::new() },
    };
    let mut sieved = chosen.sieved;
    let refitted = refit(scene, &scored, recipe, &sieved, &mut stages)?;
    sieved.recolor = refitted.recolor;

    let mut left_out = scored.left_out(scene);
    left_out.extend(stages_left_out(options, recipe));
    if recipe.scan.coverage == Coverage::Auto && !scene.has_cameras {
        let why = "no cameras given or found: a virtual rig may see only what is in front of the scene".to_owned();
        left_out.push(LeftOut { what: "visible coverage", why });
    }
    left_out.extend(chosen.left_out);
    left_out.extend(refitted.left_out);
    let mut notes = scene.notes.clone();
    notes.extend(selection_notes(&scored));
    notes.extend(chosen.notes);
    notes.extend(refitted.note);
    let mut summary = Summary {
        tool: format!("splatsieve {}", env!("CARGO_PKG_VERSION")),
        input,
        cameras: CameraSummary {
            origin: scene.rig.origin.clone(),
            cameras: scene.schedule.cameras.len(),
            pairs: scene.schedule.pairs(),
        },
        gaussians: sieved.kept.len(),
        output_bytes: None,
        selection: scored.selection.counts,
        terms: scored.term_summaries(),
        flags: scored.flags.clone(),
        merge: sieved.summary.clone(),
        left_out,
        notes,
        stages: Vec::new(),
    };
    if options.dry_run {
        summary.notes.push("dry run: nothing was written".to_owned());
        summary.stages = stages.finish();
        return Ok((summary, sieved.index_map(info.count)));
    }
    let summary = write_result(scene, &scored, &sieved, options, kind, summary, stages)?;
    Ok((summary, sieved.index_map(info.count)))
}

impl CompressOptions {
    /// The user's overrides for an input of `count` Gaussians.
    fn overrides(&self, count: usize) -> Result<UserOverrides> {
        Ok(UserOverrides {
            keep: self.keep_ids.as_deref().map_or(Ok(Vec::new()), |ids| parse_ids(ids, count))?,
            drop: self.drop_ids.as_deref().map_or(Ok(Vec::new()), |ids| parse_ids(ids, count))?,
            keep_box: self.keep_box,
        })
    }

    /// What can be refused of a stream of `count` Gaussians before its frames, which may take hours, arrive.
    fn check_stream(&self, count: usize) -> Result<()> {
        check_output(&self.output, OutputKind::of_sequence(&self.output, self.kind)?, &[], self.overwrite)?;
        self.target.map(|target| target.count(count)).transpose()?;
        self.overrides(count).map(|_| ())
    }
}

impl Target {
    /// The number of Gaussians it means for an input of `count`.
    pub fn count(self, count: usize) -> Result<usize> {
        let wanted = match self {
            Target::Count(wanted) => wanted,
            Target::Ratio(ratio) if ratio > 0.0 && ratio <= 1.0 => ((ratio * count as f64).round() as u64).max(1),
            Target::Ratio(ratio) => {
                return Err(Error::usage(format!(
                    "--target-ratio: expected a number above 0 and at most 1, found {ratio}"
                )));
            }
        };
        match usize::try_from(wanted) {
            Ok(wanted @ 1..) if wanted <= count => Ok(wanted),
            // The empty scene has one size only.
            _ if count == 0 => Ok(0),
            _ => Err(Error::usage(format!(
                "--target-count: expected 1 to {count}, the Gaussians of the input, found {wanted}"
            ))),
        }
    }
}

fn stages_left_out(options: &CompressOptions, recipe: &Recipe) -> Vec<LeftOut> {
    let mut out = Vec::new();
    if options.only == Only::Merge {
        out.push(LeftOut { what: "pruning", why: "--merge-only".to_owned() });
    }
    if options.only == Only::Prune {
        out.push(LeftOut { what: "merging, and its pass over the frames", why: "--prune-only".to_owned() });
    } else if recipe.merge.passes.is_empty() {
        out.push(LeftOut {
            what: "merging, and its pass over the frames",
            why: "the recipe has no merge pass".to_owned(),
        });
    }
    out
}

fn selection_notes(scored: &Scored) -> Vec<String> {
    let flags = &scored.flags;
    let mut notes = Vec::new();
    for (count, what) in [
        (flags.non_finite, "with NaN or infinity"),
        (flags.zero_rotation, "with a zero quaternion (taken as the identity)"),
        (flags.snapped_d, "whose motion D is rounding noise (set to 0)"),
        (flags.snapped_kappa, "whose curvature kappa is rounding noise (set to 0)"),
        (flags.never_alive, "never alive"),
    ] {
        if count > 0 {
            notes.push(format!("{count} Gaussians {what}"));
        }
    }
    notes
}
