//! The pipeline of a compression: scan, score, rank, prune, merge, refine, write.
//!
//! Before any work, a request is turned into a [`RunPlan`]: the list of the stages that the request needs, in the order
//! in which they run. The stages are taken from [`stages::STAGES`]; [`run_stages`] runs them.

pub mod dry_run;
mod ids;
pub(crate) mod open;
pub(crate) mod plan;
pub mod planning;
mod quality_meter;
mod record;
mod request;
mod search;
pub(crate) mod stage;
pub mod stages;
pub mod summary;
mod summary_text;
pub mod time_estimate;

pub use dry_run::dry_run;
pub use open::open_to_measure;
pub use plan::RunPlan;
pub use record::{FitTarget, RecipeRecord, RunOptions};
pub use request::{Goal, PruneOrMerge, Quality, Request, Target};
pub use stage::CompressedScene;

use crate::cache::Completion;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::memory_plan::{Budget, Verbosity, Workload};
use crate::pruning::score::{Scored, UserOverrides};
use crate::recipe::Recipe;
use crate::scene::{InputOptions, Scene};
use planning::InputMeta;
use stage::{Measured, Phase, RunState};
use stages::measure::MeasureStages;
use summary::{InputSummary, Summary};

/// Compresses the input of `request`, writes the result and returns the summary of the run. A run that is limited to
/// one shard (part of a divided stage) computes only this shard, writes no result and returns [`Completion::Shard`].
///
/// # Errors
/// Fails if the input, the cameras, the recipe or the output is invalid. An error leaves no output behind.
///
/// # Examples
/// Keeps half of the Gaussians of a container and does not refine them:
///
/// ```
/// # use splatsieve::diagnostics::{demo_scene::DemoScene, test_scene::write_scene};
/// # use splatsieve::progress::Events;
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let folder = tempfile::tempdir()?;
/// # let [model, cameras] = write_scene(&DemoScene::new(400, 4), folder.path(), &Events::default())?;
/// use splatsieve::cache::Completion;
/// use splatsieve::pipeline::{Request, Target, compress};
/// use splatsieve::recipe::Recipe;
/// use splatsieve::scene::InputOptions;
///
/// let input = InputOptions { path: model, cameras: Some(cameras), ..InputOptions::default() };
/// let recipe = Recipe::from_toml("[refine]\nrefine = \"none\"\n", "default")?;
/// let output = folder.path().join("small.gseq");
/// let request = Request { target: Some(Target::Ratio(0.5)), ..Request::new(input, output.clone(), recipe) };
/// let Completion::Whole(summary) = compress(&request)? else { panic!("the run is not divided into shards") };
/// assert_eq!(summary.gaussians, 200);
/// assert!(output.is_file());
/// # Ok(())
/// # }
/// ```
pub fn compress(request: &Request) -> Result<Completion<Summary>> {
    Completion::from_result(compress_whole(request))
}

fn compress_whole(request: &Request) -> Result<Summary> {
    let mut journal = Journal::default();
    let (path, cameras) = (&request.input.path, request.input.cameras.as_deref());
    let check = |frames| RunPlan::before_reading(request, frames)?.check_target(path, cameras);
    let plan = |input, work: &Workload| {
        let plan = RunPlan::within_memory(request, input, work)?;
        plan.check_target(path, cameras)?;
        Ok(plan)
    };
    let (scene, plan, arrived) = open_to_measure(&request.input, check, plan, &mut journal)?;
    Ok(run_stages(&scene, &plan, arrived, request, journal)?.summary)
}

/// Compresses the open scene `scene` as `request` asks and writes the result, like [`compress`].
///
/// # Errors
/// Fails in the cases in which [`compress`] fails. A run of only one shard (part of a divided stage) ends with
/// [`Error::ShardDone`].
pub fn compress_scene(scene: &Scene, request: &Request) -> Result<CompressedScene> {
    let plan = RunPlan::within_memory(request, InputMeta::from_scene(scene), &scene.workload())?;
    plan.check_target(&scene.path, request.input.cameras.as_deref())?;
    run_stages(scene, &plan, None, request, Journal::default())
}

/// Returns one line of text for each divisible stage of a run of `request`, in the order in which the stages run. A
/// stage is divisible if several processes can share its work. A line holds the name of the stage and its number of
/// units of work, such as blocks of Gaussians or views. Only opens the input; runs no stage.
///
/// # Errors
/// Fails if the input cannot be opened, if the request is invalid, or if the memory budget is too small for it.
pub fn shardable_stages(request: &Request) -> Result<Vec<String>> {
    let check = |frames| RunPlan::before_reading(request, frames).map(|_| ());
    let plan = |input, work: &Workload| RunPlan::within_memory(request, input, work);
    let memory = Budget { tell: Verbosity::Nothing, ..request.input.memory };
    let input = InputOptions { work: None, memory, ..request.input.clone() };
    let (scene, plan, _) = open_to_measure(&input, check, plan, &mut Journal::default())?;
    Ok(plan.describe_shardable_work(&scene))
}

/// Plans the memory of the run of `request`: sets how many frames, views and pairs of Gaussians its stages may keep in
/// memory at a time, so that the run stays within the memory budget of `request`. Stores these limits in `scene`.
///
/// # Errors
/// Fails if the budget is too small for the run, and in the cases in which [`RunPlan::new`] fails.
pub fn set_limits_within_budget(scene: &mut Scene, request: &Request) -> Result<()> {
    let plan = RunPlan::within_memory(request, InputMeta::from_scene(scene), &scene.workload())?;
    scene.plan_memory(request.input.memory, |work, limits| plan.estimates(work, limits))
}

/// Computes the statistics and scores of the Gaussians of `scene`, and selects the survivors (Gaussians that are not
/// removed) by the parameters of `recipe`. Returns the statistics and the selection; the scores can be computed again
/// with [`Scored::scores`]. `user` states which Gaussians the user wants to keep or to drop in any case.
///
/// # Errors
/// Fails if frames cannot be read, or if their times do not allow statistics of motion.
pub fn score_scene(scene: &Scene, recipe: &Recipe, user: &UserOverrides) -> Result<Scored> {
    MeasureStages::new(recipe, scene.has_cameras, user.clone()).measure(scene, None, &mut Journal::default())
}

/// Runs the stages of `plan`, one after the other. `arrived` holds the statistics of the Gaussians if the input is a
/// stream and they were already computed while it arrived.
fn run_stages(
    scene: &Scene,
    plan: &RunPlan,
    arrived: Option<Measured>,
    request: &Request,
    mut journal: Journal,
) -> Result<CompressedScene> {
    plan.check(scene)?;
    journal.notes.extend(scene.notes.iter().cloned());
    journal.whole = scene.full_read()?;
    let (work, measured) = (scene.workload(), arrived.as_ref().map(Measured::measured_statistics).unwrap_or_default());
    let expected = plan.remaining_estimates(&work, &scene.limits, measured);
    let _numbered = scene.events.begin_run(&expected.iter().map(|stage| stage.stage).collect::<Vec<_>>());
    let input = InputSummary::from_scene(scene)?.without_folder_paths();
    let recipe = recipe_text(&input.digest, plan, request, &mut journal);
    let output = plan.output.as_ref().map(|output| output.kind);
    let sh_degree = stages::bands::highest(scene, request.recipe.bands.bands, output, &mut journal);
    let template = CompressedModel { sh_degree, ..CompressedModel::pruned(Vec::new(), &request.recipe.merge) };
    let mut run = RunState::new(scene, request, &plan.stages, template);
    (run.journal, run.input, run.recipe) = (journal, Some(input), recipe);
    (run.arrived, run.target) = (arrived, plan.target);

    plan.stages.run(Phase::Rank, &mut run)?;
    match &plan.search {
        Some(search) => search.run(&mut run)?,
        None => reduce(plan, &mut run)?,
    }
    let scored = run.scored()?;
    // An empty input may give an empty output; losing every Gaussian of a non-empty input is an error.
    if run.result.is_empty() && scored.gaussian_count() > 0 {
        return Err(nothing_left(scene, &scored));
    }
    run.journal.notes.extend(run.result.proxies.notes.iter().cloned());
    plan.stages.record_left_out(&work, &scene.limits, &mut run.journal);
    run.journal.notes.extend(scene.work.take_notes());
    plan.stages.run(Phase::Write, &mut run)?;
    run.written.ok_or_else(|| Error::internal("no stage of the plan wrote a result"))
}

/// Runs the stages that reduce the model to the target. Repeats them as long as a stage asks for it, because the result
/// is far from the requested size on disk. Of a reduction that is repeated, only the records of its stages are kept.
fn reduce(plan: &RunPlan, run: &mut RunState<'_>) -> Result<()> {
    loop {
        let (repeats, left_out, notes) = (run.repeats, run.journal.left_out.len(), run.journal.notes.len());
        plan.stages.run(Phase::Reduce, run)?;
        if run.repeats == repeats {
            return Ok(());
        }
        run.journal.left_out.truncate(left_out);
        run.journal.notes.truncate(notes);
        (run.journal.field, run.journal.bands) = (None, None);
        (run.journal.refined, run.journal.photographs) = (None, None);
    }
}

/// Returns the text of the file `recipe.toml` that is written beside the result. `input_digest` is the digest of the
/// input of this run. Adds a note to `journal`, the record of the run, if the recipe was made for an input with another
/// digest.
fn recipe_text(input_digest: &str, plan: &RunPlan, request: &Request, journal: &mut Journal) -> String {
    if let Some(other) = request.made_for.as_ref().filter(|digest| *digest != input_digest) {
        journal
            .notes
            .push(format!("the recipe was made for another input, with digest {other}; this one has {input_digest}"));
    }
    let folder = plan.output.as_ref().map(stages::write::WriteStage::recipe_folder).unwrap_or_default();
    RecipeRecord::new(request, &plan.measure.score.user, input_digest.to_owned()).text(request, &folder)
}

/// Returns the error for a result without any Gaussian, which no renderer could show.
fn nothing_left(scene: &Scene, scored: &Scored) -> Error {
    let all = scored.gaussian_count();
    // The ranking leaves out the Gaussians that are dropped in any case.
    let dropped = all - scored.selection.ranking.order().len();
    let found = match dropped {
        0 => format!("none of {all}"),
        _ => format!("none of {all}, {dropped} of which --drop-ids or --set non_finite=drop removed"),
    };
    Error::input(scene.shown_path(), "", "at least one Gaussian that stays", found)
        .hint("nothing was written: drop fewer, or ask for a size with --ratio")
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::diagnostics::demo_scene;
    use crate::files::container::Container;
    use crate::model::{Attributes, SequenceInfo, Split};
    use crate::models::MemoryProfile;
    use crate::outputs::container::{FRAME_BLOCK, write_container};

    /// Writes a small dynamic demo scene with cameras and opens it.
    pub(crate) fn scene(folder: &std::path::Path) -> Scene {
        let made = demo_scene::DemoScene::new(1500, 6);
        let path = folder.join("scene.gseq");
        write_container(&made, &path, gseq::Compression::Raw, Default::default(), |_| ()).unwrap();
        let input = Box::new(Container::open(&path).unwrap());
        let rig = made.rig();
        Scene::new(path, input, rig, Some(Split::Train)).unwrap()
    }

    pub(crate) fn score_scene(scene: &Scene, recipe: &Recipe, user: &UserOverrides) -> Scored {
        super::score_scene(scene, recipe, user).unwrap()
    }

    /// Returns the workload (sizes for estimates) of a container with `gaussians` Gaussians and 600 frames, each with
    /// two views.
    pub(crate) fn work(gaussians: u64) -> Workload {
        let info = SequenceInfo {
            count: gaussians as usize,
            times: Vec::new(),
            sh_degree: 3,
            varying: Attributes::all().difference(Attributes::SH),
        };
        Workload {
            frames: 600,
            pixels: 320 * 240,
            views: 2,
            viewpoints: 2,
            frame_views: 1200,
            rig: 560,
            threads: 2,
            ..Workload::new(&info, MemoryProfile::for_tiles(FRAME_BLOCK as u64))
        }
    }
}
