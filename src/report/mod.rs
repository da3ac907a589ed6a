//! Report: one page that shows the effect of compression on a model, with the data behind it.
//!
//! Input: the original, one or more compressed models, their cameras, and the files that `compress` wrote beside its
//! results. Output: a folder with `report.html`, which needs nothing but a browser, and all its data as JSON and CSV.
//!
//! Steps and their modules:
//! - `run` reads the files of `compress`.
//! - `gaussian_kinds` finds the Gaussians at risk.
//! - `failure` looks at every render of the evaluation for damage to these Gaussians.
//! - `histogram`, `shown_images` and `film` make histograms, images and animations.
//! - `page` writes the page, with `overview`, `compare`, `quality` and `details`.
//!
//! Memory: the memory of an evaluation or of scoring, which run one after the other, and the page.

mod analysis;
pub mod chart;
mod compare;
mod details;
mod document;
pub mod failure;
mod failure_section;
pub mod film;
mod findings;
pub mod gaussian_kinds;
pub mod histogram;
mod html;
mod overview;
mod page;
pub mod precision;
mod quality;
pub mod run;
pub mod shown_images;
mod tables;
pub mod trade_off;
mod verdict;

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::cache::{CacheKey, Completion};
use crate::error::{Error, Result};
use crate::evaluation;
use crate::evaluation::{EvaluateOptions, ModelPair, RenderedViews};
use crate::files::atomic::{Replace, StagedFolder, TargetKind, check_target, write_summary, write_text};
use crate::files::text::{json_text, read_text};
use crate::journal::Journal;
use crate::journal::records::TermSummary;
use crate::model::{Camera, Gaussians, Split, StatisticRows, ViewSchedule};
use crate::outputs::kind::check_folder_name;
use crate::pipeline::stage::MeasuredOnArrival;
use crate::pipeline::stages::measure::MeasureStages;
use crate::pipeline::stages::rounds;
use crate::pruning::score::{SCORING_BYTES_PER_GAUSSIAN, Scored, UserOverrides};
use crate::recipe::{NonFinitePolicy, Recipe, ScanFrames};
use crate::scene::Scene;
pub use findings::{CompressedModelData, ReportData};

use analysis::Analysis;
use failure::{FailureMode, KindTotals, assess_failure_mode};
use findings::WorstPlaceImages;
use gaussian_kinds::{GaussianKind, KindFlags, contribution_shares, kind_flags};
use histogram::histograms;
use run::{Fate, RunFiles};
use shown_images::{ChosenRender, ShownImage, choose_renders, create_images, with_scores_from};

/// File name of the report page.
pub const PAGE_FILE: &str = "report.html";

/// Options of the command `report`.
#[derive(Debug, Clone)]
pub struct ReportOptions {
    /// Original, first compressed model, and views to compare. The CSV file named in these options is not written.
    pub evaluate: EvaluateOptions,
    /// Paths of further compressed models of the same original.
    pub further_compressed: Vec<PathBuf>,
    /// Path of a file `sweep.json` that the command `sweep` wrote, to include its curves.
    pub sweep: Option<PathBuf>,
    /// Path of a file `precision.json` that the command `precision` wrote, to include its plots.
    pub precision: Option<PathBuf>,
    /// Whether to measure the time for rendering a view of each model. Measured times differ between runs.
    pub render_time: bool,
    /// Path of the output folder.
    pub output: PathBuf,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
}

/// Compares one or more compressed models with their original and writes the report. Returns its data, unless the run
/// computed only one shard (part of a divided stage).
///
/// # Errors
/// Fails if an input, the cameras, the photographs, the sweep or the output is invalid. Nothing is written then.
pub fn report(options: &ReportOptions) -> Result<Completion<ReportData>> {
    Completion::from_result(report_whole(options))
}

/// Does the work of [`report`], and returns the data of the report. A run that computes only one shard (part of a
/// divided stage) ends with the error [`Error::ShardDone`].
///
/// # Errors
/// Fails as [`report`] does.
pub(crate) fn report_whole(options: &ReportOptions) -> Result<ReportData> {
    let mut inputs = options.evaluate.input_paths();
    inputs.extend(options.further_compressed.iter().map(PathBuf::as_path));
    inputs.extend(options.sweep.as_deref());
    inputs.extend(options.precision.as_deref());
    check_folder_name(&options.output, "report")?;
    check_target(&options.output, TargetKind::Folder, &inputs, options.overwrite)?;
    if !options.further_compressed.is_empty() && options.evaluate.original.is_stream() {
        return Err(Error::usage(
            "several results: expected an original that can be read again, found standard input (-)",
        ));
    }
    let trade_off = options.sweep.as_deref().map(|path| read_result(path, "sweep")).transpose()?;
    let precision = options.precision.as_deref().map(|path| read_result(path, "precision")).transpose()?;
    let mut results = vec![analyze(&options.evaluate, None, options.render_time)?];
    for path in &options.further_compressed {
        let evaluate = EvaluateOptions { compressed: path.clone(), ..options.evaluate.clone() };
        let choices: Vec<ChosenRender> = results[0].shown.iter().map(|shown| shown.choice.clone()).collect();
        results.push(analyze(&evaluate, Some(&choices), options.render_time)?);
    }
    let page = page::page(&results, trade_off.as_ref(), precision.as_ref());
    let mut results = results.into_iter();
    let first = results.next().ok_or_else(|| Error::internal("a report without results"))?;
    let report = ReportData {
        tool: first.data.evaluation.tool.clone(),
        result: first.data,
        shown: first.shown.into_iter().map(|shown| shown.choice).collect(),
        films: first.films,
        trade_off,
        precision,
        others: results.map(|result| result.data).collect(),
    };
    write(options, &report, &page, &first.run)?;
    Ok(report)
}

/// Compares the compressed model that `options` name with the original, and returns everything that the page shows of
/// this compressed model. `chosen_renders` lists the renders to show; if it is `None`, this function chooses them.
/// `render_time` states whether to measure render times.
fn analyze(options: &EvaluateOptions, chosen_renders: Option<&[ChosenRender]>, render_time: bool) -> Result<Analysis> {
    let mut pair = ModelPair::open(options)?;
    let info = pair.scene.source().info();
    let (count, frames) = (info.count, info.times.len());
    let run = RunFiles::read_files_beside(&options.compressed, count, pair.compressed_count());
    let mut notes = notes_on(&run, &pair.scene)?;

    let recipe = recipe_to_score_with(&run)?;
    let measure = MeasureStages::new(&recipe, pair.scene.has_cameras, UserOverrides::default());
    pair.plan_memory(options.original.memory, |work, limits| {
        let mut needs = measure.resource_estimates(work, limits, MeasuredOnArrival::default());
        needs.push(gaussian_kinds::resource_estimate(work));
        needs.extend(evaluation::resource_estimates(work, limits).into_iter().map(|mut need| {
            need.per_gaussian.push(("statistics", SCORING_BYTES_PER_GAUSSIAN + 8));
            need.fixed.push(("films", film::memory_bytes(work)));
            need
        }));
        needs
    })?;
    let has_cache = pair.scene.work.is_enabled();
    let compared = if has_cache { Some(pair.evaluate_as_first_stage()?) } else { None };
    pair.scene.schedule = scored_views(&pair.scene, &run)?;
    if has_cache {
        // The comparison above has the cache key of the command `evaluate`, so both commands share its result. The keys
        // of later stages also depend on the views that score Gaussians, and on the recipe.
        pair.scene.work.depend_on(CacheKey::new(&(&pair.scene.schedule, &recipe)));
    }
    let scored = measure.measure(&pair.scene, None, &mut Journal::default())?;
    notes.extend(differing_terms(&run, &scored));
    let find_kinds = || kind_flags(pair.scene.source(), &scored, recipe.scan.alpha_min);
    let kinds = pair.scene.work.get_or_compute("traits", pair.scene.work.key(&()), find_kinds)?;
    let rows = scored.rows()?;
    let totals = kind_totals(&rows, &kinds, run.fates.as_deref());
    let sum_errors = |state: &Gaussians, camera: &Camera, renders: &RenderedViews| {
        failure::sum_errors(state, &kinds, camera, renders)
    };
    let (evaluation, error_sums) = match compared {
        None => pair.observe(sum_errors)?,
        Some(compared) => (compared, pair.observe_sharded("failure", sum_errors)?),
    };
    pair.scene.work.end_shard_run_before("the page")?;
    let names: Vec<(usize, u32)> = evaluation.views.iter().map(|view| (view.frame, view.view)).collect();
    let failure_modes: Vec<FailureMode> = GaussianKind::ALL
        .iter()
        .zip(totals)
        .map(|(&kind, totals)| assess_failure_mode(kind, totals, &error_sums, &names))
        .collect();
    let choices =
        chosen_renders.map_or_else(|| choose_renders(&evaluation), |chosen| with_scores_from(&evaluation, chosen));
    let (shown, worst_places) = show_again(&pair, &choices, &failure_modes, &kinds)?;
    let films = film::render_films(&pair, &shown)?;
    let render_time = if render_time { pair.render_time()? } else { None };

    notes.extend(evaluation.notes.iter().cloned());
    let work_notes = evaluation.work_notes.iter().cloned().chain(pair.scene.work.take_notes()).collect();
    let histograms = match &run.fates {
        Some(fates) => Some(histograms(&rows, &scored.scores(&recipe.score)?, frames, fates)),
        None => None,
    };
    let data = CompressedModelData {
        verdict: verdict::verdict(&evaluation, &failure_modes),
        view_scores: evaluation.views.clone(),
        evaluation: evaluation.without_folder_paths(),
        render_time,
        failure_modes,
        histograms,
        missing: run.missing.clone(),
        run: run.summary.as_ref().map(|(_, whole)| whole.clone()),
        notes,
        work_notes,
    };
    Ok(Analysis { data, run, shown, films, worst_places })
}

/// Maximum size in bytes of a JSON file of `sweep` or `precision`; a larger file is not read. A file about a thousand
/// runs has less than one million bytes.
const MAX_JSON_BYTES: u64 = 16 << 20;

/// Reads the JSON file at `path`, which the command `command` (`sweep` or `precision`) wrote.
fn read_result<T: DeserializeOwned>(path: &Path, command: &str) -> Result<T> {
    let text = read_text(path, MAX_JSON_BYTES)?;
    serde_json::from_str(&text).map_err(|error| {
        let expected = format!("the data of `splatsieve {command}`");
        Error::input(path, format!("line {}", error.line()), expected, error.to_string())
            .hint(format!("splatsieve {command} ORIGINAL --cameras F -o FOLDER writes a {command}.json"))
    })
}

/// Returns a note if the summary that was found beside the compressed model belongs to another original; otherwise no
/// note.
fn notes_on(run: &RunFiles, scene: &Scene) -> Result<Vec<String>> {
    let Some((summary, _)) = &run.summary else { return Ok(Vec::new()) };
    let digest = scene.input.digest()?;
    Ok(match summary.input.digest == digest {
        true => Vec::new(),
        false => vec![format!(
            "the summary beside the result belongs to another original (digest {}, this one has {digest})",
            summary.input.digest
        )],
    })
}

/// Returns the recipe with which the report scores Gaussians: the recipe found beside the compressed model, else the
/// default. It is changed so that Gaussians with NaN or infinite values are kept and do not stop the report.
fn recipe_to_score_with(run: &RunFiles) -> Result<Recipe> {
    let mut recipe = match &run.recipe {
        Some(recipe) => recipe.clone(),
        None => Recipe::preset("default")?,
    };
    recipe.scan.non_finite = NonFinitePolicy::Keep;
    Ok(recipe)
}

/// Returns the views by which the run that wrote the compressed model scored Gaussians. The summary of the run states
/// only the number of these views, so this function finds them by the number:
/// - Returns the first of these sets that has the stated number of views: training views, all views, held-out views.
/// - If no set has this number, or if there is no summary, returns the training views, or all views if there are no
///   training views.
fn scored_views(scene: &Scene, run: &RunFiles) -> Result<ViewSchedule> {
    let times = &scene.source().info().times;
    let wanted = run.summary.as_ref().map(|(summary, _)| summary.cameras.pairs);
    let mut first = None;
    for split in [Some(Split::Train), None, scene.rig.held_out_split()] {
        let schedule = scene.rig.schedule(times, split)?;
        if schedule.pair_count() == 0 {
            continue;
        }
        if wanted.is_none_or(|wanted| wanted == schedule.pair_count()) {
            return Ok(schedule);
        }
        first.get_or_insert(schedule);
    }
    first.map_or_else(|| scene.rig.schedule(times, None), Ok)
}

/// Returns a note if the 1st or 99th percentile of a term of the score differs from that of the run that wrote the
/// compressed model. The scores in the report then differ from the scores by which Gaussians were removed. Returns no
/// note if pruning rounds removed the Gaussians, down to a number that the user gave: the run then measured its scores
/// on few frames and pixels.
fn differing_terms(run: &RunFiles, scored: &Scored) -> Option<String> {
    // Numbers lose their last bit on the way through JSON.
    let same = |a: f64, b: f64| (a - b).abs() <= 1e-12 * a.abs().max(b.abs());
    let (summary, _) = run.summary.as_ref()?;
    let may_measure_little = run.recipe.as_ref().is_some_and(|recipe| recipe.scan.scan_frames == ScanFrames::Needed);
    if may_measure_little && run.has_target && summary.stages.iter().any(|stage| stage.name == rounds::NAME) {
        return None;
    }
    let found = scored.term_summaries();
    let differs = |then: &&TermSummary| {
        !found.iter().any(|now| now.name == then.name && same(now.p1, then.p1) && same(now.p99, then.p99))
    };
    let then = summary.terms.iter().find(differs)?;
    Some(format!(
        "the scores shown are computed anew and differ from those of the run, whose 99th percentile of {} was {:.4}: \
         cameras, split or frames are not the same",
        then.name, then.p99
    ))
}

/// Returns the totals of each of the three kinds of Gaussian ([`GaussianKind`]: fast, thin, changing in appearance).
///
/// Arguments, each with one entry per Gaussian:
/// - `rows`: statistics.
/// - `kinds`: for each kind, whether the Gaussian is of this kind.
/// - `fates`: whether the Gaussian was kept, merged or dropped. `None` if there is no index map (file that maps input
///   to output Gaussians).
fn kind_totals(rows: &StatisticRows, kinds: &[KindFlags], fates: Option<&[Fate]>) -> [KindTotals; 3] {
    let fate = |i: usize| fates.map_or(Fate::Kept, |fates| fates[i]);
    let shares = contribution_shares(rows, kinds, |i| fate(i) != Fate::Kept);
    std::array::from_fn(|kind| {
        let with = |wanted: Fate| (0..kinds.len()).filter(|&i| kinds[i][kind] && fate(i) == wanted).count();
        KindTotals {
            count: kinds.iter().filter(|flags| flags[kind]).count(),
            fates: fates.map(|_| (with(Fate::Dropped), with(Fate::Merged))),
            shares: shares[kind],
        }
    })
}

/// Renders some views again to show them on the page: the views of `choices`, and for each failure mode of `modes` the
/// view in which its damage is worst. Returns two lists:
/// - the images of each element of `choices`
/// - for each failure mode that has such a view, the images of a square around the worst damage
///
/// `kinds` states for every Gaussian whether it belongs to each kind (fast, thin, changing in appearance).
fn show_again(
    pair: &ModelPair,
    choices: &[ChosenRender],
    modes: &[FailureMode],
    kinds: &[KindFlags],
) -> Result<(Vec<ShownImage>, Vec<WorstPlaceImages>)> {
    let worst = || modes.iter().enumerate().filter_map(|(number, mode)| Some((number, mode.worst?.place)));
    let places: Vec<usize> = choices.iter().map(|choice| choice.place).chain(worst().map(|(_, place)| place)).collect();
    let (mut shown, mut worst_places) = (Vec::new(), Vec::new());
    let made = pair.render_views_again(&places, |place, state, camera, renders| {
        for choice in choices.iter().filter(|choice| choice.place == place) {
            shown.push(create_images(choice, &renders)?);
        }
        for (mode, _) in worst().filter(|&(_, at)| at == place) {
            let shares = failure::render_kind_shares(state, kinds, camera);
            let corner = failure::worst_corner(&renders, &shares, GaussianKind::ALL[mode]);
            let square = |image| shown_images::png_uri(&failure::crop_square(image, corner));
            let images = [square(&renders.original)?, square(&renders.compressed)?];
            worst_places.push(WorstPlaceImages { mode, corner, psnr: failure::crop_psnr(&renders, corner), images });
        }
        Ok(())
    })?;
    made.into_iter().collect::<Result<()>>()?;
    // Renders come back sorted by frame; the page shows them in the order of the choices.
    shown.sort_by_key(|shown| choices.iter().position(|choice| choice.place == shown.choice.place));
    Ok((shown, worst_places))
}

/// Writes the report to the output folder of `options`: the HTML page `page`, and data files (JSON and CSV) with the
/// content of `report` and the stages of `run`.
fn write(options: &ReportOptions, report: &ReportData, page: &str, run: &RunFiles) -> Result<()> {
    let staged = StagedFolder::new(&options.output, options.overwrite)?;
    let mut files = vec![
        (PAGE_FILE, page.to_owned()),
        ("report.json", json_text(report)),
        ("views.csv", report.result.evaluation.csv()),
        ("failure_modes.csv", tables::failure_modes(&report.result.failure_modes)),
    ];
    files.extend(report.result.histograms.as_ref().map(|of| ("histograms.csv", histogram::csv(of))));
    files.extend(run.summary.as_ref().map(|(of, _)| ("stages.csv", tables::stages(&of.stages))));
    files.extend(report.trade_off.as_ref().map(|of| ("trade_off.csv", of.csv())));
    let turned = report.trade_off.as_ref().filter(|of| !of.knobs.is_empty());
    files.extend(turned.map(|of| ("knobs.csv", of.knobs_csv())));
    files.extend(report.precision.as_ref().map(|of| ("precision.csv", of.csv())));
    for (name, text) in files {
        write_text(&staged.path().join(name), text)?;
    }
    let summary = serde_json::json!({
        "tool": report.tool,
        "original": report.result.evaluation.path.original,
        "compressed": report.result.evaluation.path.compressed,
        "verdict": report.result.verdict,
    });
    write_summary(staged.path(), &summary)?;
    staged.commit()
}
