//! Trade-off curves of size against quality. The sweep compresses the input with every method at every fraction of kept
//! Gaussians, and with the preset `default` at one fraction and several numbers of refinement steps. It compares each
//! result with the original on held-out (test) views.
//!
//! Every point of a curve is a complete run as a user would start it, from opening the input to a result on disk, so
//! that the measured time and memory are those of this run alone. The result is deleted once it has been measured.
//! Memory: first the memory of `compress`, then the memory of `evaluate`.

use std::path::PathBuf;

use super::whole_run::{WholeRun, result_name, with_training_views};
use crate::TOOL;
use crate::error::{Error, Result};
use crate::evaluation::cost::RepeatLimits;
use crate::evaluation::method::{Method, MethodKind, STEPS, refining_by};
use crate::evaluation::trade_off::{EffortCurve, EffortSetting, TradeOff, TradeOffPoint};
use crate::files::atomic::{Replace, StagedFolder, TargetKind, check_target, write_summary, write_text};
use crate::files::names::name_of;
use crate::files::text::json_text;
use crate::outputs::kind::check_folder_name;
use crate::pipeline::Target;
use crate::report::trade_off::{PAGE_FILE, page};
use crate::scene::{InputOptions, open_scene};

/// Options of the command `sweep`, which measures trade-off curves of size against quality.
#[derive(Debug, Clone)]
pub struct SweepOptions {
    /// Input and cameras. The split that these options request is ignored: Gaussians are scored by the training views.
    pub input: InputOptions,
    /// Compression methods to compare, in the order of the result.
    pub methods: Vec<Method>,
    /// Fractions of the Gaussians at which each method is run, in (0, 1].
    pub fractions: Vec<f64>,
    /// Numbers of optimization steps of refinement with which the preset `default` is run at the fraction `steps_at`;
    /// 0: no refinement.
    pub steps: Vec<u32>,
    /// Fraction of the Gaussians that the runs listed in `steps` keep, in (0, 1].
    pub steps_at: f64,
    /// Number of runs for each point of the trade-off curves, at least 1. The median time of these runs is reported.
    pub runs: usize,
    /// Maximum number of frames at which results are compared with the original, evenly spaced; `None`: all frames.
    pub max_frames: Option<usize>,
    /// Background color of the renders: red, green, blue in [0, 1]; `None`: the default of the command `evaluate`.
    pub background: Option<[f32; 3]>,
    /// Path of the output folder, for `sweep.json`, `sweep.csv`, `knobs.csv` and the page with the trade-off curves.
    pub output: PathBuf,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
}

/// Measures the trade-off curves and writes them to the output folder. Runs every method at every fraction; a method
/// that chooses the number of Gaussians itself is also run once without a given fraction. Then runs the preset
/// `default` with every number of refinement steps. Gaussians are scored by the training views; results are compared
/// with the original on the held-out views. Returns the measurements.
///
/// # Errors
/// Fails if the input, the cameras, the fractions or the output are invalid, or if a run fails. No files remain in this
/// case.
pub fn sweep(options: &SweepOptions) -> Result<TradeOff> {
    for (flag, fractions) in [("--fractions", &options.fractions[..]), ("--steps-at", &[options.steps_at])] {
        if let Some(invalid) = fractions.iter().find(|&&fraction| !(fraction > 0.0 && fraction <= 1.0)) {
            return Err(Error::usage(format!("{flag}: expected numbers above 0 and at most 1, found {invalid}")));
        }
    }
    if options.input.is_stream() {
        return Err(Error::usage("sweep reads its input many times: pack the stream first, then sweep the .gseq"));
    }
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    check_folder_name(&options.output, "sweep")?;
    check_target(&options.output, TargetKind::Folder, &inputs, options.overwrite)?;
    let staged = StagedFolder::new(&options.output, options.overwrite)?;
    let mut fractions = options.fractions.clone();
    fractions.sort_unstable_by(|a, b| b.total_cmp(a));
    fractions.dedup();
    let mut steps = options.steps.clone();
    steps.sort_unstable();
    steps.dedup();

    let (mut trade_off, name) = prepare(options)?;
    let run = WholeRun {
        input: &options.input,
        scratch: &staged.path().join("point"),
        name,
        repeats: RepeatLimits::exactly(options.runs),
        max_frames: options.max_frames,
        background: options.background,
    };
    let points: Vec<(Method, Option<f64>)> = options
        .methods
        .iter()
        .flat_map(|&method| {
            let chosen_size = method.chooses_size().then_some(None);
            chosen_size.into_iter().chain(fractions.iter().copied().map(Some)).map(move |fraction| (method, fraction))
        })
        .collect();
    let progress = options.input.events.task("sweep", "points", (points.len() + steps.len()) as u64);
    for (method, fraction) in points {
        if !exceeds_merging(method, fraction, &trade_off) {
            let point = measure(&run, method, fraction, &method.kind()?, &mut trade_off)?;
            trade_off.points.push(point);
        }
        progress.advance(1);
    }
    let mut settings = Vec::with_capacity(steps.len());
    for value in steps {
        let (method, fraction) = (Method::Default, Some(options.steps_at));
        let point = measure(&run, method, fraction, &refining_by(value)?, &mut trade_off)?;
        settings.push(EffortSetting { value, point });
        progress.advance(1);
    }
    if !settings.is_empty() {
        trade_off.knobs.push(EffortCurve { parameter: STEPS.to_owned(), settings });
    }
    if let Some(merged_count) = merge_only_count(&trade_off) {
        let name = Method::PaperMerge.name();
        trade_off
            .notes
            .push(format!("{name}: merging alone leaves {merged_count} Gaussians, so it has no smaller points"));
    }
    let write = |name: &str, text: String| write_text(&staged.path().join(name), text);
    write("sweep.csv", trade_off.csv())?;
    if !trade_off.knobs.is_empty() {
        write("knobs.csv", trade_off.knobs_csv())?;
    }
    write("sweep.json", json_text(&trade_off))?;
    write(PAGE_FILE, page(&trade_off))?;
    write_summary(staged.path(), &serde_json::json!({ "tool": trade_off.tool }))?;
    staged.commit()?;
    Ok(trade_off)
}

/// Opens the input. Returns two values:
/// - a result of the sweep that describes the input and has no measured points yet
/// - the file name for the results of the runs, which are of the same kind as the input (container or not)
fn prepare(options: &SweepOptions) -> Result<(TradeOff, &'static str)> {
    let scene = open_scene(&with_training_views(&options.input))?;
    let name = result_name(&scene)?;
    let trade_off = TradeOff {
        tool: TOOL.to_owned(),
        path: name_of(&scene.path),
        digest: scene.input.digest()?,
        gaussians: scene.source().info().count,
        bytes: scene.input.bytes()?,
        threads: rayon::current_num_threads(),
        views: 0,
        cameras: scene.rig.origin.clone(),
        runs: options.runs.max(1),
        points: Vec::new(),
        knobs: Vec::new(),
        notes: scene.notes,
    };
    Ok((trade_off, name))
}

/// Returns the number of Gaussians that remain after merging without pruning, according to the points in `trade_off`.
/// Returns `None` if merging without pruning has not been measured yet.
fn merge_only_count(trade_off: &TradeOff) -> Option<usize> {
    let is_merge_only =
        |point: &&TradeOffPoint| point.method == Method::PaperMerge.name() && point.requested_fraction.is_none();
    trade_off.points.iter().find(is_merge_only).map(|point| point.count)
}

/// Returns whether a run of `method` with the kept fraction `fraction` is known to fail: the method is merging without
/// pruning, and the points in `trade_off` show that merging alone leaves more Gaussians than this fraction. Such a run
/// is skipped.
fn exceeds_merging(method: Method, fraction: Option<f64>, trade_off: &TradeOff) -> bool {
    let requested_count =
        fraction.filter(|_| method == Method::PaperMerge).map(|fraction| fraction * trade_off.gaussians as f64);
    requested_count
        .zip(merge_only_count(trade_off))
        .is_some_and(|(requested_count, merged_count)| requested_count.round() < merged_count as f64)
}

/// Measures one point of the trade-off curves by complete runs of `method`, and returns it. `method_kind`: recipe or
/// baseline that implements `method`. `fraction`: fraction of the Gaussians to keep; `None`: the method chooses their
/// number. Also stores the number of compared views in `trade_off`.
fn measure(
    run: &WholeRun<'_>,
    method: Method,
    fraction: Option<f64>,
    method_kind: &MethodKind,
    trade_off: &mut TradeOff,
) -> Result<TradeOffPoint> {
    let (evaluation, cost) = run.run(method_kind, fraction.map(Target::Ratio), |result| run.compare(result))?;
    trade_off.views = evaluation.cameras.pairs;
    let means = evaluation.loss.overall;
    Ok(TradeOffPoint {
        method: method.name().to_owned(),
        requested_fraction: fraction,
        count: evaluation.count.compressed,
        bytes: evaluation.bytes.compressed,
        psnr: means.psnr,
        ssim: means.ssim,
        temporal: means.temporal,
        seconds: cost.seconds.median,
        peak_memory_bytes: cost.peak_memory_bytes,
    })
}
