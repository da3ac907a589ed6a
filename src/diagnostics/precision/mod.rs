//! Work-precision diagrams: what every knob of a run costs in time and memory, and what error it leaves, on a given model.
//!
//! Errors of three sources are kept apart. *Discretization*: pictures, pixels, frames, rounds and buckets are samples; the
//! error of each is measured against the finest of its kind, at an equal number of kept Gaussians. *Rounding*: sums in f32
//! and in f64 against longer ones; threads and memory, which must change nothing. *Model*: fewer Gaussians stand for more,
//! merged or refined.
//!
//! Memory: that of `compress`, and beside it the scene, [`HELD`] bytes a Gaussian, and 12 bytes for every pixel of the pictures
//! that results are judged by; a budget for whole runs is what that leaves of it.

mod judge;
mod ranking;
mod runs;
mod sums;

use std::fs;
use std::path::{Path, PathBuf};

use super::whole_run::{result_name, trained};
use crate::TOOL;
use crate::error::{Error, Result, ShowPath};
use crate::evaluation::cost::Repeats;
use crate::evaluation::precision::{PrecisionDiagram, PrecisionKnob};
use crate::files::atomic::{Kind, MARKER, Replace, StagedFolder, check_target};
use crate::files::names::name_of;
use crate::journal::Journal;
use crate::memory_plan::{Budget, Verbosity, Workload};
use crate::model::{Rows, Schedule};
use crate::outputs::kind::check_folder_name;
use crate::pipeline::planning::InputMeta;
use crate::pipeline::stages::measure::Measure;
use crate::pipeline::{Request, RunPlan, Target};
use crate::progress::{Events, Progress};
use crate::pruning::score::UserOverrides;
use crate::recipe::Recipe;
use crate::report::precision::{PAGE, page};
use crate::scene::{InputOptions, Scene, open_scene};
use crate::statistics::pass::Scanned;
use crate::statistics::score::Scores;
use crate::statistics::score::sketch::MOST_BITS;
use judge::Judge;

/// Something to turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turned {
    /// The first look: pictures, and strides of pixels, views and frames.
    Look,
    /// Rounds: pictures of each, and the part that each leaves.
    Rounds,
    /// Percentiles: bits of one look.
    Percentiles,
    /// Running sums: f32, compensated, f64.
    Sums,
    /// Merging: radius and passes.
    Merging,
    /// Refining: steps and pictures.
    Refining,
    /// Threads and memory.
    Machine,
}

impl Turned {
    /// Every one, in the order of the pipeline.
    pub const ALL: [Turned; 7] = [
        Turned::Look,
        Turned::Rounds,
        Turned::Percentiles,
        Turned::Sums,
        Turned::Merging,
        Turned::Refining,
        Turned::Machine,
    ];

    /// As the command line and the results name it.
    pub fn name(self) -> &'static str {
        match self {
            Turned::Look => "look",
            Turned::Rounds => "rounds",
            Turned::Percentiles => "percentiles",
            Turned::Sums => "sums",
            Turned::Merging => "merging",
            Turned::Refining => "refining",
            Turned::Machine => "machine",
        }
    }

    /// Why there may be nothing to turn.
    fn needs(self) -> &'static str {
        match self {
            Turned::Sums => "sums over frames need three frames",
            Turned::Refining => "the recipe refines nothing",
            _ => "the recipe looks at no pictures",
        }
    }

    /// Whether every one of its settings is a run from beginning to end.
    fn is_of_whole_runs(self) -> bool {
        matches!(self, Turned::Merging | Turned::Refining | Turned::Machine)
    }
}

/// What to turn, and on what.
#[derive(Debug, Clone)]
pub struct PrecisionOptions {
    /// What to read, and the cameras; of its split nothing is used.
    pub input: InputOptions,
    /// What every knob starts from.
    pub recipe: Recipe,
    /// What to turn; none: everything, but whole runs only of models that are not too long.
    pub knobs: Option<Vec<Turned>>,
    /// How many Gaussians every setting keeps.
    pub target: Target,
    /// Look at pictures of at most this many frames, evenly from first to last.
    pub max_frames: usize,
    /// Times to run every setting at most, at least 1: the median time counts.
    pub runs: usize,
    /// Folder for `precision.json`, `precision.csv` and the page.
    pub output: PathBuf,
    /// Replace an earlier folder.
    pub overwrite: Replace,
}

/// Seconds after which a setting is not run again.
const ENOUGH: f64 = 10.0;

/// Gaussians times frames up to which whole runs are part of everything.
const SHORT: u64 = 10_000_000;

/// Bytes of a sketch of the most bits.
const COUNTS: u64 = 4 << (9 + MOST_BITS);

/// Bytes per Gaussian that are held between settings: statistics twice, two looks and two scores, and sets that were kept.
const HELD: u64 =
    (2 * Rows::BYTES_PER_GAUSSIAN + 2 * 16 + 2 * Scores::BYTES_PER_GAUSSIAN + 12 * size_of::<u32>()) as u64;

/// What all knobs are turned on.
struct Bench<'a> {
    /// As the training cameras see it, at some of its frames.
    scene: &'a Scene,
    input: &'a InputOptions,
    /// Of all pictures.
    work: Workload,
    recipe: &'a Recipe,
    scanned: Scanned,
    judge: Judge,
    /// Gaussians that every setting keeps.
    kept: usize,
    repeats: Repeats,
    /// Folder for results of whole runs, and their name.
    scratch: &'a Path,
    name: &'a str,
    progress: Progress,
}

impl Bench<'_> {
    /// Another setting is done.
    fn advance(&self) {
        self.progress.advance(1);
    }
}

/// Turns knobs of a run on a model and writes what it finds.
///
/// # Errors
/// Whatever is wrong with input, cameras, recipe, options or output. Nothing is left behind then.
pub fn precision(options: &PrecisionOptions) -> Result<PrecisionDiagram> {
    if options.input.is_stream() {
        return Err(Error::usage("precision reads its input many times: pack the stream first, then give the .gseq"));
    }
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    check_folder_name(&options.output, "precision")?;
    check_target(&options.output, Kind::Folder, &inputs, options.overwrite)?;
    let staged = StagedFolder::new(&options.output, options.overwrite)?;

    let input = trained(&options.input);
    let mut scene = open_scene(&input)?;
    if !scene.has_cameras {
        return Err(Error::usage(format!(
            "{}: precision looks at pictures, and no cameras were found\n  give --cameras",
            scene.path.shown()
        )));
    }
    let info = scene.source().info();
    let (gaussians, frames) = (info.count, info.times.len());
    let kept = options.target.count(gaussians)?;
    let name = result_name(&scene)?;
    let request = Request {
        target: Some(options.target),
        ..Request::new(input.clone(), options.output.join(name), options.recipe.clone())
    };
    let plan = RunPlan::within_memory(&request, InputMeta::from_scene(&scene), &scene.workload())?;
    scene.keep_to(input.memory, |work, limits| {
        let mut needs = plan.estimates(work, limits);
        for need in &mut needs {
            need.per_gaussian.push(("settings", HELD));
            need.fixed.extend([("judged", Judge::bytes(work.pixels)), ("counts", COUNTS)]);
            need.fixed.push(("thinned", thinned_bytes(work, options.max_frames)));
        }
        needs
    })?;
    let work = scene.workload();
    let beside = work.count() as u64 * (HELD + work.input.per_gaussian) + work.input.fixed + Judge::bytes(work.pixels);
    let left = input.memory.bytes.map(|bytes| bytes.saturating_sub(beside));
    let memory = Budget { bytes: left, tell: Verbosity::Nothing };
    let input = InputOptions { memory, events: Events::IGNORED, ..input };
    let mut notes = scene.notes.clone();
    scene.schedule = thin(std::mem::take(&mut scene.schedule), options.max_frames);
    let looked_at = scene.schedule.iter().filter(|views| !views.is_empty()).count();
    if scene.rig.held_out().is_none() {
        notes.push("no pictures are held out: those judged by are also looked at".to_owned());
    }
    let mut knobs = Turned::ALL.to_vec();
    knobs.retain(|knob| options.knobs.as_ref().is_none_or(|asked| asked.contains(knob)));
    let is_long = gaussians as u64 * frames as u64 > SHORT;
    let (left_out, turned): (Vec<Turned>, Vec<Turned>) =
        knobs.into_iter().partition(|knob| options.knobs.is_none() && is_long && knob.is_of_whole_runs());
    if !left_out.is_empty() {
        let names: Vec<&str> = left_out.iter().map(|knob| knob.name()).collect();
        let names = names.join(",");
        notes.push(format!("{names}: left out for {gaussians} Gaussians x {frames} frames (--knobs {names})"));
    }

    let measure = Measure::new(&options.recipe, true, UserOverrides::default());
    let scanned = measure.scan(&scene, &mut Journal::default())?;
    let judge = Judge::new(&scene)?;
    // Hundreds of stages would hide which setting it is at.
    scene.events = Events::IGNORED;
    let bench = Bench {
        scanned,
        judge,
        scene: &scene,
        input: &input,
        work,
        recipe: &options.recipe,
        kept,
        repeats: Repeats { most: options.runs, enough: ENOUGH },
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
        frames_looked_at: looked_at,
        pictures: scene.schedule.pairs(),
        judged: bench.judge.pictures(),
        cameras: scene.rig.origin.clone(),
        kept,
        threads: rayon::current_num_threads(),
        runs: options.runs.max(1),
        enough: ENOUGH,
        knobs: Vec::new(),
        notes,
    };
    for knob in turned {
        match bench.turn(knob)? {
            Some(knob) => found.knobs.push(knob),
            None => found.notes.push(format!("{}: left out, as {}", knob.name(), knob.needs())),
        }
    }
    let write = |name: &str, text: String| {
        let path = staged.path().join(name);
        fs::write(&path, text).map_err(Error::io("write", &path))
    };
    write("precision.csv", found.csv())?;
    write("precision.json", found.json())?;
    write(PAGE, page(&found))?;
    // By this a later run knows the folder as one that it may replace.
    write(MARKER, format!("{:#}\n", serde_json::json!({ "tool": found.tool })))?;
    staged.commit()?;
    Ok(found)
}

impl Bench<'_> {
    /// All settings of a knob; none where the scene has nothing to turn it on.
    fn turn(&self, knob: Turned) -> Result<Option<PrecisionKnob>> {
        match knob {
            Turned::Look => self.look(),
            Turned::Rounds => self.rounds(),
            Turned::Percentiles => self.percentiles().map(Some),
            Turned::Sums => self.sums(),
            Turned::Merging => self.merging().map(Some),
            Turned::Refining => self.refining(),
            Turned::Machine => self.machine().map(Some),
        }
    }
}

/// The same with the pictures of at most `most` (at least one) of the frames that have some, evenly from first to last.
fn thin(mut schedule: Schedule, most: usize) -> Schedule {
    let seen = schedule.iter().filter(|views| !views.is_empty()).count();
    let most = most.max(1);
    if seen <= most {
        return schedule;
    }
    let mut thinned = Schedule::new(std::mem::take(&mut schedule.cameras));
    let (mut place, mut kept) = (0, 0);
    for views in schedule.iter() {
        let wanted = !views.is_empty() && kept < most && place == (2 * kept + 1) * seen / (2 * most);
        thinned.push(1, if wanted { views } else { &[] });
        kept += usize::from(wanted);
        place += usize::from(!views.is_empty());
    }
    thinned
}

/// Bytes of what [`thin`] makes: of every frame it keeps one run, and of those up to the next another.
fn thinned_bytes(work: &Workload, most: usize) -> u64 {
    let most = most.max(1) as u64;
    if work.frames <= most { 0 } else { Schedule::bytes(2 * most, work.views) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Columns, SequenceInfo};
    use crate::models::MemoryProfile;

    #[test]
    fn thinned_schedules_keep_frames_evenly_and_all_of_their_pictures() {
        let of = |frames: usize, most: usize| -> Vec<usize> {
            let mut schedule = Schedule::default();
            for frame in 0..frames {
                schedule.push(1, if frame % 2 == 0 { &[(0, 0), (1, 1)] } else { &[] });
            }
            let thinned = thin(schedule, most);
            assert_eq!(thinned.frames(), frames);
            assert!(thinned.iter().all(|views| views.is_empty() || views.len() == 2));
            thinned.iter().enumerate().filter(|(_, views)| !views.is_empty()).map(|(frame, _)| frame).collect()
        };
        assert_eq!(of(12, 3), [2, 6, 10]);
        assert_eq!((of(5, 100), of(5, 0), of(0, 5)), (vec![0, 2, 4], vec![2], vec![]));
    }

    #[test]
    fn what_thinning_makes_is_counted_and_what_stays_as_it_is_takes_nothing() {
        let info = SequenceInfo { count: 1, times: vec![0.0; 1000], sh_degree: 0, varying: Columns::empty() };
        let work = Workload { views: 3, ..Workload::new(&info, MemoryProfile::of_tiles(1)) };
        assert_eq!((thinned_bytes(&work, 1000), thinned_bytes(&work, 5000)), (0, 0));
        // Two runs of 16 bytes, and a pair of 8 for every view.
        assert!(thinned_bytes(&work, 60) >= 60 * (2 * 16 + 3 * 8));
        assert!(thinned_bytes(&work, 0) > 0);
    }
}
