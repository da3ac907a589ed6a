//! A page that a person opens: what compression did to a model, and what it cost.
//!
//! Data in: two models, their cameras, and what `compress` left beside its result. Data out: a folder
//! with `report.html`, which needs nothing but a browser, and everything it shows as JSON and CSV. Reads
//! as a pipeline: `run` (what compress left), `traits` (which Gaussians are at risk), the evaluation with
//! `failure` looking on, `histogram`, `shown` (pictures), `page` with `document`, `chart` and `html`.
//!
//! Memory: that of an evaluation and of scoring, one after the other, and the page.

pub mod chart;
mod document;
pub mod failure;
pub mod film;
mod findings;
pub mod histogram;
mod html;
mod page;
pub mod precision;
pub mod run;
pub mod shown;
mod tables;
pub mod trade_off;
pub mod traits;
mod verdict;

use std::fs;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::cache::{CacheKey, Completion};
use crate::error::{Error, Result};
use crate::evaluation;
use crate::evaluation::{EvaluateOptions, ModelPair, RenderedViews};
use crate::files::atomic::{Kind as TargetKind, MARKER, Replace, StagedFolder, check_target};
use crate::files::text::read_text;
use crate::journal::Journal;
use crate::journal::records::TermSummary;
use crate::model::{Camera, Gaussians, Rows, Split, ViewSchedule};
use crate::outputs::kind::check_folder_name;
use crate::pipeline::stage::MeasuredOnArrival;
use crate::pipeline::stages::measure::Measure;
use crate::pruning::score::{SCORED_BYTES, Scored, UserOverrides};
use crate::recipe::{NonFinite, Recipe};
use crate::scene::Scene;
pub use findings::ReportData;

use failure::{FailureMode, KindMembers, judge, observe};
use findings::Close;
use histogram::histograms;
use run::{Fate, RunFiles};
use shown::{Choice, ShownImage, choices, show};
use traits::{GaussianKind, Traits, shares, traits};

/// The page's name in the folder.
pub const PAGE: &str = "report.html";

/// What to report on.
#[derive(Debug, Clone)]
pub struct ReportOptions {
    /// The models and the pictures to compare them on; its files to write are not looked at.
    pub evaluate: EvaluateOptions,
    /// What `sweep` wrote.
    pub sweep: Option<PathBuf>,
    /// What `precision` wrote.
    pub precision: Option<PathBuf>,
    /// Folder to write.
    pub output: PathBuf,
    /// Replace an earlier report.
    pub overwrite: Replace,
}

/// Compares two models and writes the report.
///
/// # Errors
/// Whatever is wrong with inputs, cameras, pictures, sweep or output. Nothing is left behind then.
pub fn report(options: &ReportOptions) -> Result<Completion<ReportData>> {
    Completion::from_result(report_whole(options))
}

fn report_whole(options: &ReportOptions) -> Result<ReportData> {
    let mut inputs = options.evaluate.inputs();
    inputs.extend(options.sweep.as_deref());
    inputs.extend(options.precision.as_deref());
    check_folder_name(&options.output, "report")?;
    check_target(&options.output, TargetKind::Folder, &inputs, options.overwrite)?;
    let trade_off = options.sweep.as_deref().map(|path| read_found(path, "sweep")).transpose()?;
    let precision = options.precision.as_deref().map(|path| read_found(path, "precision")).transpose()?;
    let mut side = ModelPair::open(&options.evaluate)?;
    let info = side.scene.source().info();
    let (count, frames) = (info.count, info.times.len());
    let run = RunFiles::beside(&options.evaluate.compressed, count, side.compressed_count());
    let mut notes = notes_on(&run, &side.scene)?;

    let recipe = recipe_to_score_with(&run)?;
    let measure = Measure::new(&recipe, side.scene.has_cameras, UserOverrides::default());
    side.keep_to(options.evaluate.original.memory, |work, limits| {
        let mut needs = measure.needs(work, limits, MeasuredOnArrival::default());
        needs.push(traits::need(work));
        needs.extend(evaluation::needs(work, limits).into_iter().map(|mut need| {
            need.per_gaussian.push(("rows", SCORED_BYTES + 8));
            need.fixed.push(("films", film::bytes(work)));
            need
        }));
        needs
    })?;
    let in_parts = side.scene.work.keeps();
    let compared = if in_parts { Some(side.compare()?) } else { None };
    side.scene.schedule = scored_pictures(&side.scene, &run)?;
    if in_parts {
        // What comes now follows from this too; the comparison is that of `evaluate`.
        side.scene.work.follow_from(CacheKey::new(&(&side.scene.schedule, &recipe)));
    }
    let scored = measure.measure(&side.scene, None, &mut Journal::default())?;
    notes.extend(differing_terms(&run, &scored));
    let find_traits = || traits(side.scene.source(), &scored, recipe.scan.alpha_min);
    let traits = side.scene.work.known("traits", side.scene.work.key(&()), find_traits)?;
    let rows = scored.rows()?;
    let members = members(&rows, &traits, run.fates.as_deref());
    let look = |state: &Gaussians, camera: &Camera, taken: &RenderedViews| observe(state, &traits, camera, taken);
    let (evaluation, seen) = match compared {
        None => side.observe(look)?,
        Some(compared) => (compared, side.observe_in_parts("failure", look)?),
    };
    side.scene.work.end_shard_before("the page")?;
    let names: Vec<(usize, u32)> = evaluation.pictures.iter().map(|picture| (picture.frame, picture.view)).collect();
    let failure_modes: Vec<FailureMode> =
        GaussianKind::ALL.iter().zip(members).map(|(&kind, members)| judge(kind, members, &seen, &names)).collect();
    let choices = choices(&evaluation);
    let (shown, close) = show_again(&side, &choices, &failure_modes, &traits)?;
    let films = film::films(&side, &shown)?;

    notes.extend(evaluation.notes.iter().cloned());
    let work_notes = evaluation.work_notes.iter().cloned().chain(side.scene.work.take_notes()).collect();
    let histograms = match &run.fates {
        Some(fates) => Some(histograms(&rows, &scored.scores(&recipe.score)?, frames, fates)),
        None => None,
    };
    let report = ReportData {
        tool: evaluation.tool.clone(),
        verdict: verdict::verdict(&evaluation, &failure_modes),
        pictures: evaluation.pictures.clone(),
        evaluation: evaluation.without_folders(),
        shown: choices,
        films,
        failure_modes,
        histograms,
        missing: run.missing.clone(),
        run: run.summary.as_ref().map(|(_, whole)| whole.clone()),
        trade_off,
        precision,
        notes,
        work_notes,
    };
    write(options, &report, &page::page(&report, &run, &shown, &close), &run)?;
    Ok(report)
}

/// Maximum number of bytes of the data that another command wrote: a thousand runs take less than one million.
const MAX_FOUND: u64 = 16 << 20;

/// Reads the data that `verb` wrote.
fn read_found<T: DeserializeOwned>(path: &Path, verb: &str) -> Result<T> {
    let text = read_text(path, MAX_FOUND)?;
    serde_json::from_str(&text).map_err(|error| {
        let expected = format!("what `splatsieve {verb}` wrote");
        Error::input(path, format!("line {}", error.line()), expected, error.to_string())
            .hint(format!("splatsieve {verb} ORIGINAL --cameras F -o FOLDER writes a {verb}.json"))
    })
}

/// What beside the result does not fit these two models.
fn notes_on(run: &RunFiles, scene: &Scene) -> Result<Vec<String>> {
    let Some((summary, _)) = &run.summary else { return Ok(Vec::new()) };
    let digest = scene.input.digest()?;
    Ok(match summary.input.digest == digest {
        true => Vec::new(),
        false => vec![format!(
            "the summary beside the result is of an original with digest {}, this one has {digest}",
            summary.input.digest
        )],
    })
}

/// The recipe of the result, else the usual one. The report looks at what is there: values that are not
/// finite do not stop it.
fn recipe_to_score_with(run: &RunFiles) -> Result<Recipe> {
    let mut recipe = match &run.recipe {
        Some(recipe) => recipe.clone(),
        None => Recipe::preset("default")?,
    };
    recipe.scan.non_finite = NonFinite::Keep;
    Ok(recipe)
}

/// The pictures that the run scored with: the split that has as many as its summary says, else those of
/// training, else all.
fn scored_pictures(scene: &Scene, run: &RunFiles) -> Result<ViewSchedule> {
    let times = &scene.source().info().times;
    let wanted = run.summary.as_ref().map(|(summary, _)| summary.cameras.pairs);
    let mut first = None;
    for split in [Some(Split::Train), None, scene.rig.held_out()] {
        let schedule = scene.rig.schedule(times, split)?;
        if schedule.pairs() == 0 {
            continue;
        }
        if wanted.is_none_or(|wanted| wanted == schedule.pairs()) {
            return Ok(schedule);
        }
        first.get_or_insert(schedule);
    }
    first.map_or_else(|| scene.rig.schedule(times, None), Ok)
}

/// A term whose percentiles are not those of the run: the scores shown are then not those that decided.
fn differing_terms(run: &RunFiles, scored: &Scored) -> Option<String> {
    // Numbers lose their last bit on the way through JSON.
    let same = |a: f64, b: f64| (a - b).abs() <= 1e-12 * a.abs().max(b.abs());
    let (summary, _) = run.summary.as_ref()?;
    let found = scored.term_summaries();
    let differs = |then: &&TermSummary| {
        !found.iter().any(|now| now.name == then.name && same(now.p1, then.p1) && same(now.p99, then.p99))
    };
    let then = summary.terms.iter().find(differs)?;
    Some(format!(
        "the scores shown are computed anew and differ from those of the run: its 99th percentile of {} was {}; other \
         cameras, another split or other frames",
        then.name, then.p99
    ))
}

/// How many Gaussians of each kind there are, and what became of them.
fn members(rows: &Rows, traits: &[Traits], fates: Option<&[Fate]>) -> [KindMembers; 3] {
    let fate = |i: usize| fates.map_or(Fate::Kept, |fates| fates[i]);
    let shares = shares(rows, traits, |i| fate(i) != Fate::Kept);
    std::array::from_fn(|kind| {
        let with = |wanted: Fate| (0..traits.len()).filter(|&i| traits[i][kind] && fate(i) == wanted).count();
        KindMembers {
            count: traits.iter().filter(|of| of[kind]).count(),
            fates: fates.map(|_| (with(Fate::Dropped), with(Fate::Merged))),
            shares: shares[kind],
        }
    })
}

/// Makes the pictures of the page, and of the failure modes' worst ones the worst part.
fn show_again(
    side: &ModelPair,
    choices: &[Choice],
    modes: &[FailureMode],
    traits: &[Traits],
) -> Result<(Vec<ShownImage>, Vec<Close>)> {
    let worst = || modes.iter().enumerate().filter_map(|(mode, of)| Some((mode, of.worst?.place)));
    let places: Vec<usize> = choices.iter().map(|choice| choice.place).chain(worst().map(|(_, place)| place)).collect();
    let (mut shown, mut close) = (Vec::new(), Vec::new());
    let made = side.again(&places, |place, state, camera, taken| {
        for choice in choices.iter().filter(|choice| choice.place == place) {
            shown.push(show(choice, &taken)?);
        }
        for (mode, _) in worst().filter(|&(_, at)| at == place) {
            let shares = failure::shares_of_pixels(state, traits, camera);
            let corner = failure::worst_corner(&taken, &shares, GaussianKind::ALL[mode]);
            let part = |image| shown::data_uri(&failure::crop(image, corner));
            let images = [part(&taken.original)?, part(&taken.compressed)?];
            close.push(Close { mode, corner, psnr: failure::crop_psnr(&taken, corner), images });
        }
        Ok(())
    })?;
    made.into_iter().collect::<Result<()>>()?;
    // As chosen: pictures come back by frame.
    shown.sort_by_key(|shown| choices.iter().position(|choice| choice.place == shown.choice.place));
    Ok((shown, close))
}

fn write(options: &ReportOptions, report: &ReportData, page: &str, run: &RunFiles) -> Result<()> {
    let staged = StagedFolder::new(&options.output, options.overwrite)?;
    let mut json = serde_json::to_string_pretty(report).expect("a report is plain data");
    json.push('\n');
    let marker = serde_json::json!({
        "tool": report.tool,
        "original": report.evaluation.path.original,
        "compressed": report.evaluation.path.compressed,
        "verdict": report.verdict,
    });
    let mut files = vec![
        (PAGE, page.to_owned()),
        ("report.json", json),
        ("pictures.csv", report.evaluation.csv()),
        ("failure_modes.csv", tables::failure_modes(&report.failure_modes)),
        (MARKER, format!("{marker:#}\n")),
    ];
    files.extend(report.histograms.as_ref().map(|of| ("histograms.csv", histogram::csv(of))));
    files.extend(run.summary.as_ref().map(|(of, _)| ("stages.csv", tables::stages(&of.stages))));
    files.extend(report.trade_off.as_ref().map(|of| ("trade_off.csv", of.csv())));
    let turned = report.trade_off.as_ref().filter(|of| !of.knobs.is_empty());
    files.extend(turned.map(|of| ("knobs.csv", of.knobs_csv())));
    files.extend(report.precision.as_ref().map(|of| ("precision.csv", of.csv())));
    for (name, text) in files {
        let path = staged.path().join(name);
        fs::write(&path, text).map_err(Error::io("write", &path))?;
    }
    staged.commit()
}
