//! Diagrams of work against precision: time, memory and error of the program for several values of each parameter, on
//! one given model.
//!
//! Errors have three sources, which are measured separately:
//! - *Discretization*: the program uses only some views, pixels, frames, pruning rounds and histogram buckets. The
//!   result of each setting is compared with that of the finest setting of the same parameter, with equal numbers of
//!   kept Gaussians.
//! - *Rounding*: sums in f32 and in f64 are compared with more accurate sums. The number of threads and the memory
//!   limit must not change any result.
//! - *Model*: fewer Gaussians, which may be merged or refined, replace those of the model.
//!
//! Memory: the memory of `compress`, the memory of the open scene, [`HELD_BYTES`] bytes per Gaussian, and 12 bytes for
//! every pixel of the views on which quality is measured. Complete runs of the program may use the memory that remains
//! within the limit.

mod judge;
mod ranking;
mod runs;
mod sums;

use std::path::{Path, PathBuf};

use super::whole_run::{result_name, with_training_views};
use crate::TOOL;
use crate::error::{Error, Result, ShowPath};
use crate::evaluation::cost::RepeatLimits;
use crate::evaluation::precision::{PrecisionDiagram, PrecisionKnob};
use crate::files::atomic::{Replace, StagedFolder, TargetKind, check_target, write_summary, write_text};
use crate::files::names::name_of;
use crate::files::text::json_text;
use crate::journal::Journal;
use crate::memory_plan::{Budget, Verbosity, Workload};
use crate::model::{StatisticRows, ViewSchedule};
use crate::outputs::kind::check_folder_name;
use crate::pipeline::planning::InputMeta;
use crate::pipeline::stages::measure::MeasureStages;
use crate::pipeline::{Request, RunPlan, Target};
use crate::progress::{Events, Progress};
use crate::pruning::score::UserOverrides;
use crate::recipe::Recipe;
use crate::report::precision::{PAGE_FILE, page};
use crate::scene::{InputOptions, Scene, open_scene};
use crate::statistics::pass::ScanResult;
use crate::statistics::score::Scores;
use crate::statistics::score::percentile_sketch::MAX_MANTISSA_BITS;
use judge::Judge;

/// Knob: parameter, or group of parameters, of which the command `precision` tries several values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Knob {
    /// Parameters of the first ranking by renders, before the pruning rounds: the number of views, and the strides of
    /// pixels, views and frames (with a stride of n, every n-th is used).
    FirstRanking,
    /// Parameters of the pruning rounds (rank, remove the lowest, repeat): the number of views per round, and the
    /// fraction of the Gaussians that a round keeps.
    Rounds,
    /// Number of mantissa bits of a value that choose its bin in a histogram. Percentiles are found from this histogram
    /// in one pass over the values. More bits mean narrower bins and more precise percentiles.
    Percentiles,
    /// Arithmetic of the sums that the scan (pass over all frames for the statistics) accumulates: f32, f32 with
    /// compensation, or f64.
    Sums,
    /// Parameters of merging: the radius, and the number of merging passes.
    Merging,
    /// Parameters of refinement: the number of optimization steps, and the number of target views (views of the
    /// original that refinement fits).
    Refining,
    /// Two settings of the machine that must not change a result: the number of threads, and the memory limit.
    Machine,
}

impl Knob {
    /// List of the knobs (parameters, or groups of parameters), in the order of the pipeline.
    pub const ALL: [Knob; 7] =
        [Knob::FirstRanking, Knob::Rounds, Knob::Percentiles, Knob::Sums, Knob::Merging, Knob::Refining, Knob::Machine];

    /// Returns the name of this knob on the command line and in the results.
    pub fn name(self) -> &'static str {
        match self {
            Knob::FirstRanking => "scoring",
            Knob::Rounds => "rounds",
            Knob::Percentiles => "percentiles",
            Knob::Sums => "sums",
            Knob::Merging => "merging",
            Knob::Refining => "refining",
            Knob::Machine => "machine",
        }
    }

    /// Returns a text for the user that says why this knob (parameter that `precision` varies) was not measured: what
    /// the scene or the recipe lacks. Each knob has only one possible reason.
    fn reason_not_run(self) -> &'static str {
        match self {
            Knob::Sums => "sums over frames need three frames",
            Knob::Refining => "the recipe refines nothing",
            _ => "the recipe ranks by no views",
        }
    }

    /// Returns whether the settings of this knob (parameter that `precision` varies) are measured by complete runs of
    /// the program, from opening the input to the result on disk.
    fn needs_whole_runs(self) -> bool {
        matches!(self, Knob::Merging | Knob::Refining | Knob::Machine)
    }
}

/// Options of the command `precision`, which measures run time and error for several values of each parameter.
#[derive(Debug, Clone)]
pub struct PrecisionOptions {
    /// Input and cameras. The split that these options request is ignored: Gaussians are ranked by the training views.
    pub input: InputOptions,
    /// Recipe from which every setting is derived, by changing one parameter.
    pub recipe: Recipe,
    /// Knobs (parameters, or groups of parameters) to vary. `None`: every knob, but for a large model only the knobs
    /// whose settings can be compared without running the whole compression.
    pub knobs: Option<Vec<Knob>>,
    /// Number or fraction of Gaussians that every setting keeps.
    pub target: Target,
    /// Maximum number of frames whose views are used for ranking, evenly spaced from the first frame to the last.
    pub max_frames: usize,
    /// Maximum number of times that each setting is run, at least 1. The median time is reported.
    pub runs: usize,
    /// Path of the output folder, for `precision.json`, `precision.csv` and the page with the diagrams.
    pub output: PathBuf,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
}

/// Limit on the time spent on one setting, in seconds. Once all runs of a setting together take this time, it is not
/// run again.
const MAX_SETTING_SECONDS: f64 = 10.0;

/// Maximum size of a model (number of Gaussians × number of frames) at which `precision` by default also varies the
/// parameters whose effect is measured by complete runs of the program.
const MAX_STATES_OF_WHOLE_RUNS: u64 = 10_000_000;

/// Bytes of memory of the histogram for percentiles with [`MAX_MANTISSA_BITS`] mantissa bits.
const SKETCH_BYTES: u64 = 4 << (9 + MAX_MANTISSA_BITS);

/// Bytes of memory per Gaussian that are held from one setting to the next: two copies of the statistics, two of the
/// contributions, two of the scores, and twelve lists of ids of kept Gaussians.
const HELD_BYTES: u64 =
    (2 * StatisticRows::BYTES_PER_GAUSSIAN + 2 * 16 + 2 * Scores::BYTES_PER_GAUSSIAN + 12 * size_of::<u32>()) as u64;

/// Data that all measurements share. A measurement computes with one setting (one value of a parameter of the program)
/// and measures its error, time and memory.
struct Bench<'a> {
    /// Scene, with the training views of at most [`PrecisionOptions::max_frames`] of its frames.
    scene: &'a Scene,
    input: &'a InputOptions,
    /// Properties of the input (such as its numbers of Gaussians, frames and training views) from which memory and time
    /// are estimated. All frames count, also those that [`PrecisionOptions::max_frames`] leaves out.
    work: Workload,
    recipe: &'a Recipe,
    scanned: ScanResult,
    judge: Judge,
    /// Number of Gaussians that every setting keeps.
    kept: usize,
    repeats: RepeatLimits,
    /// Path of the folder to which complete runs write their results.
    scratch: &'a Path,
    /// File name of the result of a complete run, in the folder `scratch`.
    name: &'a str,
    progress: Progress,
}

impl Bench<'_> {
    /// Advances the progress display by one setting.
    fn advance(&self) {
        self.progress.advance(1);
    }
}

/// Measures all settings of the requested knobs on a model and writes the results to the output folder. Returns the
/// results.
///
/// # Errors
/// Fails if the input, the cameras, the recipe, the options or the output are invalid, or if a run fails. No files
/// remain in this case.
pub fn precision(options: &PrecisionOptions) -> Result<PrecisionDiagram> {
    if options.input.is_stream() {
        return Err(Error::usage("precision reads its input many times: pack the stream first, then give the .gseq"));
    }
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    check_folder_name(&options.output, "precision")?;
    check_target(&options.output, TargetKind::Folder, &inputs, options.overwrite)?;
    let staged = StagedFolder::new(&options.output, options.overwrite)?;

    let input = with_training_views(&options.input);
    let mut scene = open_with_cameras(&input)?;
    let info = scene.source().info();
    let (gaussians, frames) = (info.count, info.times.len());
    let kept = options.target.resolve_count(gaussians)?;
    let name = result_name(&scene)?;
    let request = Request {
        target: Some(options.target),
        ..Request::new(input.clone(), options.output.join(name), options.recipe.clone())
    };
    let plan = RunPlan::within_memory(&request, InputMeta::from_scene(&scene), &scene.workload())?;
    scene.plan_memory(input.memory, |work, limits| {
        let mut needs = plan.estimates(work, limits);
        for need in &mut needs {
            need.per_gaussian.push(("settings", HELD_BYTES));
            need.fixed.extend([("judged renders", Judge::bytes(work.pixels)), ("counts", SKETCH_BYTES)]);
            need.fixed.push(("chosen views", thinned_schedule_bytes(work, options.max_frames)));
        }
        needs
    })?;
    let work = scene.workload();
    let reserved = work.gaussian_count() as u64 * (HELD_BYTES + work.input.per_gaussian)
        + work.input.fixed
        + Judge::bytes(work.pixels);
    let remaining = input.memory.bytes.map(|bytes| bytes.saturating_sub(reserved));
    let memory = Budget { bytes: remaining, tell: Verbosity::Nothing };
    let input = InputOptions { memory, events: Events::IGNORED, ..input };
    let mut notes = scene.notes.clone();
    scene.schedule = thin_frames(std::mem::take(&mut scene.schedule), options.max_frames);
    let looked_at = scene.schedule.iter().filter(|views| !views.is_empty()).count();
    if scene.rig.held_out_split().is_none() {
        notes.push("no views are held out: results are judged by views that are also used for ranking".to_owned());
    }
    let chosen = chosen_knobs(options, gaussians, frames, &mut notes);

    let measure = MeasureStages::new(&options.recipe, true, UserOverrides::default());
    let scanned = measure.scan(&scene, &mut Journal::default())?;
    let judge = Judge::new(&scene)?;
    // Progress of the hundreds of stages would hide which setting is measured, so it is not shown.
    scene.events = Events::IGNORED;
    let bench = Bench {
        scanned,
        judge,
        scene: &scene,
        input: &input,
        work,
        recipe: &options.recipe,
        kept,
        repeats: RepeatLimits { most: options.runs, max_total_seconds: MAX_SETTING_SECONDS },
        scratch: &staged.path().join("run"),
        name,
        progress: options.input.events.counting_task("precision", "settings"),
    };
    let mut found = PrecisionDiagram {
        tool: TOOL.to_owned(),
        path: name_of(&scene.path),
        digest: scene.input.digest()?,
        gaussians,
        frames,
        frames_scored: looked_at,
        views_scored: scene.schedule.pair_count(),
        judged: bench.judge.view_count(),
        cameras: scene.rig.origin.clone(),
        kept,
        threads: rayon::current_num_threads(),
        runs: options.runs.max(1),
        max_setting_seconds: MAX_SETTING_SECONDS,
        knobs: Vec::new(),
        notes,
    };
    for knob in chosen {
        match bench.measure_knob(knob)? {
            Some(knob) => found.knobs.push(knob),
            None => found.notes.push(format!("{}: not run, because {}", knob.name(), knob.reason_not_run())),
        }
    }
    write_files(&found, staged.path())?;
    staged.commit()?;
    Ok(found)
}

/// Opens the input, which must have cameras.
///
/// # Errors
/// Fails if the input cannot be opened or has no cameras.
fn open_with_cameras(input: &InputOptions) -> Result<Scene> {
    let scene = open_scene(input)?;
    if !scene.has_cameras {
        return Err(Error::usage(format!(
            "{}: precision renders views, and no cameras were found\n  give --cameras",
            scene.path.shown()
        )));
    }
    Ok(scene)
}

/// Returns the knobs (parameters that `precision` varies) to measure:
/// - If `options` names knobs, returns these.
/// - Else returns all knobs. But for a large model it leaves out those that need complete runs of the program, and adds
///   a message about this to `notes`.
fn chosen_knobs(options: &PrecisionOptions, gaussians: usize, frames: usize, notes: &mut Vec<String>) -> Vec<Knob> {
    let mut knobs = Knob::ALL.to_vec();
    knobs.retain(|knob| options.knobs.as_ref().is_none_or(|asked| asked.contains(knob)));
    let is_long = gaussians as u64 * frames as u64 > MAX_STATES_OF_WHOLE_RUNS;
    let (left_out, chosen): (Vec<Knob>, Vec<Knob>) =
        knobs.into_iter().partition(|knob| options.knobs.is_none() && is_long && knob.needs_whole_runs());
    if !left_out.is_empty() {
        let names: Vec<&str> = left_out.iter().map(|knob| knob.name()).collect();
        let names = names.join(",");
        notes.push(format!("{names}: not run for {gaussians} Gaussians x {frames} frames (--knobs {names} runs them)"));
    }
    chosen
}

/// Writes the results `diagram` to `folder`: a CSV table, a JSON file, and the page with the diagrams.
fn write_files(diagram: &PrecisionDiagram, folder: &Path) -> Result<()> {
    write_text(&folder.join("precision.csv"), diagram.csv())?;
    write_text(&folder.join("precision.json"), json_text(diagram))?;
    write_text(&folder.join(PAGE_FILE), page(diagram))?;
    write_summary(folder, &serde_json::json!({ "tool": diagram.tool }))
}

impl Bench<'_> {
    /// Measures all settings of `knob`. Returns `None` if the scene or the recipe has no settings for it.
    fn measure_knob(&self, knob: Knob) -> Result<Option<PrecisionKnob>> {
        match knob {
            Knob::FirstRanking => self.first_ranking(),
            Knob::Rounds => self.rounds(),
            Knob::Percentiles => self.percentiles().map(Some),
            Knob::Sums => self.sums(),
            Knob::Merging => self.merging().map(Some),
            Knob::Refining => self.refining(),
            Knob::Machine => self.machine().map(Some),
        }
    }
}

/// Returns the schedule (list of views per frame) with the views of at most `most` frames, evenly spaced over the
/// frames that have views. The other frames keep no views. A `most` of 0 counts as 1.
fn thin_frames(mut schedule: ViewSchedule, most: usize) -> ViewSchedule {
    let seen = schedule.iter().filter(|views| !views.is_empty()).count();
    let most = most.max(1);
    if seen <= most {
        return schedule;
    }
    let mut thinned = ViewSchedule::new(std::mem::take(&mut schedule.cameras));
    let (mut place, mut kept) = (0, 0);
    for views in schedule.iter() {
        let wanted = !views.is_empty() && kept < most && place == (2 * kept + 1) * seen / (2 * most);
        thinned.push_frames(1, if wanted { views } else { &[] });
        kept += usize::from(wanted);
        place += usize::from(!views.is_empty());
    }
    thinned
}

/// Returns the bytes of memory of the new schedule (list of views per frame) that [`thin_frames`] makes for at most
/// `max_frames` frames. It has two entries for each frame that keeps its views: one for this frame, and one for the
/// frames without views after it. Returns 0 if the input has at most `max_frames` frames: then there is no new
/// schedule.
fn thinned_schedule_bytes(work: &Workload, max_frames: usize) -> u64 {
    let max_frames = max_frames.max(1) as u64;
    if work.frames <= max_frames { 0 } else { ViewSchedule::bytes(2 * max_frames, work.views) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Attributes, SequenceInfo};
    use crate::models::MemoryProfile;

    #[test]
    fn thinning_keeps_even_frames_with_all_views() {
        let frames_kept = |frames: usize, most: usize| -> Vec<usize> {
            let mut schedule = ViewSchedule::default();
            for frame in 0..frames {
                schedule.push_frames(1, if frame % 2 == 0 { &[(0, 0), (1, 1)] } else { &[] });
            }
            let thinned = thin_frames(schedule, most);
            assert_eq!(thinned.frames(), frames);
            assert!(thinned.iter().all(|views| views.is_empty() || views.len() == 2));
            thinned.iter().enumerate().filter(|(_, views)| !views.is_empty()).map(|(frame, _)| frame).collect()
        };
        assert_eq!(frames_kept(12, 3), [2, 6, 10]);
        assert_eq!((frames_kept(5, 100), frames_kept(5, 0), frames_kept(0, 5)), (vec![0, 2, 4], vec![2], vec![]));
    }

    #[test]
    fn thinned_schedules_are_counted_in_memory() {
        let info = SequenceInfo { count: 1, times: vec![0.0; 1000], sh_degree: 0, varying: Attributes::empty() };
        let work = Workload { views: 3, ..Workload::new(&info, MemoryProfile::for_tiles(1)) };
        assert_eq!((thinned_schedule_bytes(&work, 1000), thinned_schedule_bytes(&work, 5000)), (0, 0));
        // At least two ranges of 16 bytes, and a pair of 8 bytes for every view.
        assert!(thinned_schedule_bytes(&work, 60) >= 60 * (2 * 16 + 3 * 8));
        assert!(thinned_schedule_bytes(&work, 0) > 0);
    }
}
