//! The main job: scan, score, rank, prune, merge, refine, emit. Types flow scene → statistics → ranking → reduction →
//! files; the order of the passes stands in [`reduce`].

pub mod dry_run;
mod ids;
pub(crate) mod open;
pub(crate) mod plan;
mod record;
mod request;
mod search;
pub mod stages;
pub mod summary;
pub(crate) mod throughput;
pub mod time_estimate;

pub use dry_run::foresee;
pub use open::open_to_measure;
pub use plan::Job;
pub use record::{RecipeRecord, RunOptions};
pub use request::{Goal, Only, Quality, Request, Target};

use crate::TOOL;
use crate::cache::Completion;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::files::names::name_of;
use crate::journal::Journal;
use crate::memory_plan::{Budget, Verbosity, Workload, seconds};
use crate::model::ALL_HARMONICS;
use crate::models::Size;
use crate::pipeline::stages::reference_views::{ArchiveTarget, LEFT_BY_SEARCH};
use crate::progress::begin_run;
use crate::pruning::Ranking;
use crate::pruning::score::{Scored, UserOverrides};
use crate::recipe::{Precision, Recipe, WhichBands};
use crate::scene::{InputOptions, Scene};
use open::measured_already;
use search::size::ByteLimit;
use stages::archive::Archived;
use stages::measure::{InputMeta, Measure, Measured, Stages};
use stages::merge::Outcome;
use summary::{CameraSummary, InputSummary, Summary};

/// Writes a smaller model and says what was done.
///
/// # Errors
/// Whatever is wrong with input, cameras, recipe or output. Nothing is left behind then.
pub fn compress(request: &Request) -> Result<Completion<Summary>> {
    Completion::from_result(compress_whole(request))
}

fn compress_whole(request: &Request) -> Result<Summary> {
    let mut journal = Journal::default();
    let plan = |outlook, work: &Workload| {
        let job = Job::within(request, outlook, work)?;
        job.emit.check(&[&request.input.path])?;
        Ok(job)
    };
    let (scene, job, arrived) = open_to_measure(&request.input, plan, &mut journal)?;
    Ok(reduce(&scene, &job, arrived, request, journal)?.0)
}

/// [`compress`] of a scene that is open already; also gives every Gaussian's place in the output.
///
/// # Errors
/// Those of [`compress`].
pub fn compress_scene(scene: &Scene, request: &Request) -> Result<(Summary, Vec<Option<u32>>)> {
    let job = Job::within(request, InputMeta::from_scene(scene), &scene.workload())?;
    job.emit.check(&[&scene.path])?;
    reduce(scene, &job, None, request, Journal::default())
}

/// The stages of a run that can be divided among several, in order, with what their parts are made of.
///
/// # Errors
/// Those of opening the input; nothing else is read.
pub fn divided_stages(request: &Request) -> Result<Vec<String>> {
    let plan = |outlook, work: &Workload| Job::within(request, outlook, work);
    let memory = Budget { tell: Verbosity::Nothing, ..request.input.memory };
    let input = InputOptions { work: None, memory, ..request.input.clone() };
    let (scene, job, _) = open_to_measure(&input, plan, &mut Journal::default())?;
    Ok(job.divided(&scene))
}

/// Gives a scene that is open already the limits by which the request's budget holds.
///
/// # Errors
/// A budget that cannot work, and those of [`Job::new`].
pub fn keep_to_budget(scene: &mut Scene, request: &Request) -> Result<()> {
    let job = Job::within(request, InputMeta::from_scene(scene), &scene.workload())?;
    scene.keep_to(request.input.memory, |work, limits| job.needs(work, limits))
}

/// Measures a scene, scores and selects, as `recipe` has it.
///
/// # Errors
/// Whatever is wrong with the frames.
pub fn score_scene(scene: &Scene, recipe: &Recipe, user: &UserOverrides) -> Result<Scored> {
    Measure::new(recipe, scene.has_cameras, user.clone()).run(scene, None, &mut Journal::default())
}

/// The passes of a run, one after the other.
fn reduce(
    scene: &Scene,
    job: &Job,
    arrived: Option<Measured>,
    request: &Request,
    mut journal: Journal,
) -> Result<(Summary, Vec<Option<u32>>)> {
    job.emit.kind.check_frames(scene.source().info().times.len(), &request.output)?;
    scene.input.check_output(job.emit.kind, &request.output)?;
    journal.notes.extend(scene.notes.iter().cloned());
    journal.whole = scene.whole()?;
    let work = scene.workload();
    let stages = seconds(&work, &job.needs(&work, &scene.limits));
    // What was measured on arrival is not done again.
    let _numbered = begin_run(stages[measured_already(&arrived)..].to_vec());
    let input = InputSummary::new(&*scene.input, &scene.path, scene.digest()?)?.without_folders();
    if let Some(other) = request.made_for.as_ref().filter(|digest| **digest != input.digest) {
        let own = &input.digest;
        journal.notes.push(format!("the recipe was made for another input, with digest {other}; this one has {own}"));
    }
    let recipe = RecipeRecord::new(request, &job.measure.score.user, input.digest.clone());
    let recipe = recipe.text(request, &job.emit.recipe_folder());

    let sh_degree = match request.recipe.bands.bands {
        WhichBands::UpTo(degree) => stages::bands::highest(scene, degree, &mut journal),
        WhichBands::All | WhichBands::Needed => ALL_HARMONICS,
    };
    let mut like = CompressedModel { sh_degree, ..CompressedModel::pruned(Vec::new(), &request.recipe.merge) };
    let emit = job.emit.clone();
    let space = match request.goal {
        Some(Goal::Bytes(most)) => Some(ByteLimit { emit: &emit, most, recipe: recipe.len() as u64 }),
        _ => None,
    };
    if let Some(search) = &job.search {
        search.check(scene)?;
    }
    let scored = job.measure.run(scene, arrived, &mut journal)?;
    let outlook = InputMeta::from_scene(scene);
    let (mut job, fits) = match &space {
        Some(space) => {
            // A field that is to stay exact takes its room at the end.
            let field = if job.field.is_some() { Precision::Half } else { Precision::Exact };
            let like = CompressedModel { field, ..like.clone() };
            let fits = space.fits(scene, &scored.present(), &like, job.degree.is_some(), &mut journal)?;
            (job.again(request, outlook, fits[0].gaussians)?, fits)
        }
        None => (job.clone(), Vec::new()),
    };
    let mut ranked = scored.ranked();
    if let Some(rounds) = &job.rounds {
        let fewest = job.prune.target.unwrap_or(scored.selection.counts.kept);
        let fewest =
            job.search.as_ref().map_or(job.before_cuts(fewest, scored.count()), |search| search.fewest(scored.count()));
        ranked = rounds.run(scene, &scored, ranked, fewest, &mut journal)?;
    }
    if let Some(degree) = job.degree.as_ref().filter(|_| fits.len() > 1) {
        let fit = degree.run(scene, &scored, &ranked, &like, &fits, &mut journal)?;
        like.sh_degree = fit.sh_degree;
        job = job.again(request, outlook, fit.gaussians)?;
    }
    if request.goal.is_some() {
        // More may fit than may stay.
        job.prune.target = job.prune.target.map(|target| target.min(ranked.order().len()));
    }
    let (reduction, merge, mut goal) = match &job.search {
        Some(search) => {
            let (reduction, goal) = search.run(scene, &scored, &ranked, &like, &mut journal)?;
            (reduction, None, Some(goal))
        }
        None => {
            let Outcome { reduction, summary } =
                of_size(scene, &job, space.as_ref(), (&scored, &ranked), &like, &mut journal)?;
            (reduction, summary, None)
        }
    };
    // Of nothing nothing stays, which is right.
    if reduction.is_empty() && scored.count() > 0 {
        return Err(nothing_left(scene, &scored));
    }
    job.write_down(request, &work, &scene.limits, &mut journal);

    // What the search was given was more.
    if let (Some(goal), Some(Goal::Quality(Quality::Psnr(least)))) = (&mut goal, &request.goal) {
        goal.asked = *least;
    }
    journal.notes.extend(scene.work.take_notes());
    let archived = match &job.archive {
        Some(archive) => {
            let asked = match (&goal, &request.goal) {
                (Some(goal), _) => ArchiveTarget::Loss(goal.searched - goal.asked),
                (None, Some(Goal::Bytes(most))) => ArchiveTarget::Bytes(*most),
                _ => ArchiveTarget::Nothing,
            };
            Some(archive.run(scene, &reduction, asked, &mut journal)?)
        }
        None => None,
    };
    let (archived, archive) = archived.unzip();
    if let (Some(goal), Some(archive)) = (&mut goal, &archive) {
        (goal.searched, goal.held) = (goal.searched - archive.loss, goal.held - archive.loss);
        journal.notes.push(format!(
            "{LEFT_BY_SEARCH} dB of what was searched for were left for the archive, which takes {:.2}: at least {} dB asked \
             for, {:.2} dB by the pictures searched on, {:.2} dB by those held back",
            archive.loss, goal.asked, goal.searched, goal.held
        ));
    }
    let mut map = reduction.index_map(scene.source().info().count);
    if let Some(Archived::Content(encoded)) = &archived {
        follow(&mut map, &encoded.order);
    }
    let summarize = |journal: Journal, output: Size| Summary {
        schema: summary::SCHEMA,
        files: Vec::new(),
        tool: TOOL.to_owned(),
        cameras: CameraSummary::from_scene(scene),
        output: name_of(&request.output),
        gaussians: reduction.len(),
        output_bytes: output.whole(),
        output_size: output,
        selection: scored.selection.counts,
        terms: scored.term_summaries(),
        flags: scored.flags.clone(),
        merge,
        goal,
        field: journal.field,
        bands: journal.bands,
        refined: journal.refined,
        archive,
        left_out: journal.left_out,
        notes: journal.notes,
        planned_reads: scene.planned_reads,
        forecast: journal.forecast,
        stages: journal.stages,
        input,
    };
    scene.work.not_divided("writing")?;
    let mut summary = job.emit.run(scene, &reduction, (&map, archived.as_ref()), &recipe, journal, summarize)?;
    // The file has names alone, for it is published; whoever asked for the run sees the paths as they were given.
    summary.input.path = scene.path.to_string_lossy().into_owned();
    summary.output = request.output.to_string_lossy().into_owned();
    Ok((summary, map))
}

/// That no Gaussian is left: nothing renders such a result.
fn nothing_left(scene: &Scene, scored: &Scored) -> Error {
    let all = scored.count();
    let dropped = scored.selection.counts.forced_drop;
    let found = match dropped {
        0 => format!("none of {all}"),
        _ => format!("none of {all}, {dropped} of which --drop-ids or --non-finite drops"),
    };
    Error::input(&scene.path, "", "at least one Gaussian that stays", found)
        .hint("nothing was written: drop fewer, or ask for a size with --target-ratio")
}

/// Has places follow those of an archive, whose Gaussian `i` was at `order[i]`.
fn follow(map: &mut [Option<u32>], order: &[u32]) {
    let mut places = vec![0; order.len()];
    order.iter().zip(0..).for_each(|(&before, now)| places[before as usize] = now);
    map.iter_mut().flatten().for_each(|place| *place = places[*place as usize]);
}

/// What is left, in the manner of `like`, where its size is known before, or is the recipe's own.
fn of_size(
    scene: &Scene,
    job: &Job,
    space: Option<&ByteLimit<'_>>,
    (scored, ranked): (&Scored, &Ranking),
    like: &CompressedModel,
    journal: &mut Journal,
) -> Result<Outcome> {
    let wanted = job.prune.run(scene, scored, ranked, journal)?;
    let survivors = job.before_cuts(wanted, scored.count()).min(ranked.order().len());
    let mut outcome = match &job.merge {
        Some(merge) => merge.run(scene, scored, ranked, survivors, journal)?,
        None => Outcome { reduction: like.with(ranked.take(survivors)), summary: None },
    };
    if let Some(choose) = &job.choose {
        outcome = choose.run(scene, scored, ranked, outcome, journal)?;
    }
    journal.notes.extend(outcome.reduction.proxies.notes.iter().cloned());
    outcome.reduction.sh_degree = like.sh_degree;
    if let Some(refine) = &job.refine {
        let wanted = wanted.min(outcome.reduction.len());
        outcome.reduction = refine.run(scene, scored, outcome.reduction, wanted, journal)?;
    }
    if let Some(field) = &job.field {
        outcome.reduction = field.run(scene, outcome.reduction, journal)?;
    }
    // A degree that was chosen is one that pictures need.
    if let Some(bands) = job.bands.as_ref().filter(|_| like.sh_degree >= scene.source().info().sh_degree) {
        outcome.reduction = bands.run(scene, outcome.reduction, journal)?;
    }
    // An archive of any of them fits on some grids.
    if let Some(space) = space.filter(|_| job.archive.is_none()) {
        outcome.reduction = space.shrink(scene, scored, outcome.reduction, journal)?;
    }
    Ok(outcome)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::diagnostics::demo_scene;
    use crate::files::container::Container;
    use crate::model::{Columns, SequenceInfo, Split};
    use crate::models::MemoryProfile;
    use crate::outputs::container::{FRAME_BLOCK, write_container};

    /// A small dynamic scene with its cameras.
    pub(crate) fn scene(folder: &std::path::Path) -> Scene {
        let made = demo_scene::Scene::new(1500, 6);
        let path = folder.join("scene.gseq");
        write_container(&made, &path, gseq::Compression::Raw, Default::default(), |_| ()).unwrap();
        let input = Box::new(Container::open(&path).unwrap());
        let rig = made.rig();
        Scene::new(path, input, rig, Some(Split::Train)).unwrap()
    }

    pub(crate) fn score_scene(scene: &Scene, recipe: &Recipe, user: &UserOverrides) -> Scored {
        super::score_scene(scene, recipe, user).unwrap()
    }

    /// A container of `gaussians` Gaussians in 600 frames of two views.
    pub(crate) fn work(gaussians: u64) -> Workload {
        let info = SequenceInfo {
            count: gaussians as usize,
            times: Vec::new(),
            sh_degree: 3,
            varying: Columns::all().difference(Columns::SH),
        };
        Workload {
            frames: 600,
            pixels: 320 * 240,
            views: 2,
            viewpoints: 2,
            pictures: 1200,
            rig: 560,
            threads: 2,
            ..Workload::new(&info, MemoryProfile::of_tiles(FRAME_BLOCK as u64))
        }
    }
}
