//! Trade-off curves: every method at every kept fraction, and `default` at one of them with more and less time to
//! refine, compressed as a user would and compared with the original on held-out pictures.
//!
//! Every point is a whole run, from opening the input to a result on the disk, so that its time and
//! memory are those of that run alone; the result is deleted once it is measured. Memory: that of
//! `compress`, then that of `evaluate`.

use std::fs;
use std::path::PathBuf;

use super::whole_run::{WholeRun, result_name, trained};
use crate::TOOL;
use crate::error::{Error, Result};
use crate::evaluation::cost::Repeats;
use crate::evaluation::method::{Method, MethodKind, STEPS, refining_by};
use crate::evaluation::trade_off::{EffortCurve, Setting, TradeOff, TradeOffPoint};
use crate::files::atomic::{Kind, MARKER, Replace, StagedFolder, check_target};
use crate::files::names::name_of;
use crate::outputs::kind::check_folder_name;
use crate::pipeline::Target;
use crate::report::trade_off::{PAGE, page};
use crate::scene::{InputOptions, open_scene};

/// What to sweep.
#[derive(Debug, Clone)]
pub struct SweepOptions {
    /// What to read, and the cameras; of its split nothing is used.
    pub input: InputOptions,
    /// Methods, in the order of the result.
    pub methods: Vec<Method>,
    /// Kept fractions, in (0, 1].
    pub fractions: Vec<f64>,
    /// Steps of refinement to run `default` with; 0 refines nothing.
    pub steps: Vec<u32>,
    /// Kept fraction of these, in (0, 1].
    pub steps_at: f64,
    /// Times to run every point, at least 1: the median time counts.
    pub runs: usize,
    /// Compare on at most this many frames, evenly; none: all.
    pub max_frames: Option<usize>,
    /// Red, green, blue in [0, 1]; none: as `evaluate`.
    pub background: Option<[f32; 3]>,
    /// Folder for `sweep.json`, `sweep.csv`, `knobs.csv` and the page.
    pub output: PathBuf,
    /// Replace an earlier folder.
    pub overwrite: Replace,
}

/// Runs every method at every fraction, and those that choose a size by themselves at that too; then `default` with
/// every number of steps. Scores by the training pictures, compares by the held-out ones.
///
/// # Errors
/// Whatever is wrong with input, cameras, fractions or output. Nothing is left behind then.
pub fn sweep(options: &SweepOptions) -> Result<TradeOff> {
    for (flag, fractions) in [("--fractions", &options.fractions[..]), ("--steps-at", &[options.steps_at])] {
        if let Some(odd) = fractions.iter().find(|&&fraction| !(fraction > 0.0 && fraction <= 1.0)) {
            return Err(Error::usage(format!("{flag}: expected numbers above 0 and at most 1, found {odd}")));
        }
    }
    if options.input.is_stream() {
        return Err(Error::usage("sweep reads its input many times: pack the stream first, then sweep the .gseq"));
    }
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    check_folder_name(&options.output, "sweep")?;
    check_target(&options.output, Kind::Folder, &inputs, options.overwrite)?;
    let staged = StagedFolder::new(&options.output, options.overwrite)?;
    let mut fractions = options.fractions.clone();
    fractions.sort_unstable_by(|a, b| b.total_cmp(a));
    fractions.dedup();
    let mut steps = options.steps.clone();
    steps.sort_unstable();
    steps.dedup();

    let (mut found, name) = start(options)?;
    let run = WholeRun {
        input: &options.input,
        scratch: &staged.path().join("point"),
        name,
        repeats: Repeats::always(options.runs),
        max_frames: options.max_frames,
        background: options.background,
    };
    let points: Vec<(Method, Option<f64>)> = options
        .methods
        .iter()
        .flat_map(|&method| {
            let own = method.chooses_size().then_some(None);
            own.into_iter().chain(fractions.iter().copied().map(Some)).map(move |asked| (method, asked))
        })
        .collect();
    let progress = options.input.events.task("sweep", "points", (points.len() + steps.len()) as u64);
    for (method, asked) in points {
        if !beyond_merging(method, asked, &found) {
            let point = measure(&run, method, asked, &method.means()?, &mut found)?;
            found.points.push(point);
        }
        progress.advance(1);
    }
    let mut settings = Vec::with_capacity(steps.len());
    for value in steps {
        let (method, asked) = (Method::Default, Some(options.steps_at));
        let point = measure(&run, method, asked, &refining_by(value)?, &mut found)?;
        settings.push(Setting { value, point });
        progress.advance(1);
    }
    if !settings.is_empty() {
        found.knobs.push(EffortCurve { parameter: STEPS.to_owned(), settings });
    }
    if let Some(least) = merged_alone(&found) {
        let name = Method::PaperMerge.name();
        found.notes.push(format!("{name}: merging alone leaves {least} Gaussians, so it has no smaller points"));
    }
    let write = |name: &str, text: String| {
        let path = staged.path().join(name);
        fs::write(&path, text).map_err(Error::io("write", &path))
    };
    write("sweep.csv", found.csv())?;
    if !found.knobs.is_empty() {
        write("knobs.csv", found.knobs_csv())?;
    }
    write("sweep.json", found.json())?;
    write(PAGE, page(&found))?;
    // By this a later run knows the folder as one that it may replace.
    write(MARKER, format!("{:#}\n", serde_json::json!({ "tool": found.tool })))?;
    staged.commit()?;
    Ok(found)
}

/// What all points share, and the name by which a result is of the input's kind.
fn start(options: &SweepOptions) -> Result<(TradeOff, &'static str)> {
    let scene = open_scene(&trained(&options.input))?;
    let name = result_name(&scene)?;
    let found = TradeOff {
        tool: TOOL.to_owned(),
        path: name_of(&scene.path),
        digest: scene.input.digest()?,
        gaussians: scene.source().info().count,
        bytes: scene.input.bytes()?,
        threads: rayon::current_num_threads(),
        pictures: 0,
        cameras: scene.rig.origin.clone(),
        runs: options.runs.max(1),
        points: Vec::new(),
        knobs: Vec::new(),
        notes: scene.notes,
    };
    Ok((found, name))
}

/// Gaussians that merging leaves where nothing is pruned, once that point is measured.
fn merged_alone(found: &TradeOff) -> Option<usize> {
    let own = |point: &&TradeOffPoint| point.method == Method::PaperMerge.name() && point.asked.is_none();
    found.points.iter().find(own).map(|point| point.count)
}

/// Whether `method` merges only, and cannot merge that much.
fn beyond_merging(method: Method, asked: Option<f64>, found: &TradeOff) -> bool {
    let wanted = asked.filter(|_| method == Method::PaperMerge).map(|fraction| fraction * found.gaussians as f64);
    wanted.zip(merged_alone(found)).is_some_and(|(wanted, least)| wanted.round() < least as f64)
}

/// One point of the sweep.
fn measure(
    run: &WholeRun<'_>,
    method: Method,
    asked: Option<f64>,
    means: &MethodKind,
    found: &mut TradeOff,
) -> Result<TradeOffPoint> {
    let (evaluation, cost) = run.run(means, asked.map(Target::Ratio), |result| run.compared(result))?;
    found.pictures = evaluation.cameras.pairs;
    let means = evaluation.loss.overall;
    Ok(TradeOffPoint {
        method: method.name().to_owned(),
        asked,
        count: evaluation.count.compressed,
        bytes: evaluation.bytes.compressed,
        psnr: means.psnr,
        ssim: means.ssim,
        temporal: means.temporal,
        seconds: cost.seconds.median,
        peak_memory_bytes: cost.peak_memory_bytes,
    })
}
