//! Collapsed sections of the report page: all figures, the stages of the run, the scores, the notes and the data files.

use super::analysis::Analysis;
use super::chart::{ChartAxis, StackedHistogram};
use super::document::{figure_of, heading, links, list, table};
use super::findings::CompressedModelData;
use super::histogram::Histogram;
use super::html::{db, escape, figure, percent};
use super::run::RunFiles;
use super::{compare, failure_section, precision, quality, trade_off};
use crate::evaluation::precision::PrecisionDiagram;
use crate::evaluation::results::{Comparison, OriginalAndCompressed, QualityMeans};
use crate::evaluation::trade_off::TradeOff;
use crate::models::ModelSize;
use crate::pipeline::summary::Summary;
use crate::progress::{decimal_bytes, grouped};

/// Returns the HTML of the collapsed sections of the page, each with a label and one line of explanation. `results` are
/// the compressed models and `names` their names; `sweep` and `precision` hold the curves to include.
pub(super) fn details(
    results: &[Analysis],
    names: &[String],
    sweep: Option<&TradeOff>,
    precision: Option<&PrecisionDiagram>,
) -> String {
    let each = |section: &dyn Fn(&Analysis, &str) -> String| -> String {
        let of = |(number, result): (usize, &Analysis)| {
            let body = section(result, &names[number]);
            if body.is_empty() { body } else { heading(names, number) + &body }
        };
        results.iter().enumerate().map(of).collect()
    };
    let numbers = each(&|result, name| numbers(&result.data, name)) + &quality::other_charts(results, names);
    let sections = [
        (
            "numbers",
            "All figures",
            "Every measure: means of all renders, of the worst frame and of the worst view.",
            numbers,
        ),
        (
            "renders",
            "More renders",
            "The worst render of the worst camera and of the worst frame.",
            compare::other_sliders(results, names),
        ),
        (
            "weak",
            "Known weak spots",
            "Fast motion, thin structures and small changes of appearance suffer first when a model is compressed.",
            each(&|result, _| failure_section::modes(&result.data.failure_modes, &result.worst_places)),
        ),
        (
            "stages",
            "Time and memory of the run",
            "Duration of each step of the compression, and its memory.",
            each(&|r, _| stages(&r.run)),
        ),
        (
            "scores",
            "Scores of the Gaussians",
            "Scores and statistics of kept, dropped and merged Gaussians.",
            each(&|result, _| score_histograms(&result.data)),
        ),
        (
            "notes",
            "Notes and skipped steps",
            "Remarks of the run, and steps that this scene did not need.",
            each(&|result, _| notes_section(&result.data, &result.run)),
        ),
        (
            "sweep",
            "Other sizes",
            "Quality against size, time and memory, measured by a sweep.",
            each(&|result, _| result.run.summary.as_ref().map_or(String::new(), |(summary, _)| search_chart(summary)))
                + &sweep_section(&results[0], sweep),
        ),
        (
            "precision",
            "Error against run time",
            "Gain in precision from more work, for each step of the compression.",
            precision.map_or(String::new(), precision::section),
        ),
        ("data", "Data files", "Everything on this page, for other programs.", data_links(results, sweep, precision)),
    ];
    sections
        .into_iter()
        .filter(|section| !section.3.is_empty())
        .map(|(id, label, about, body)| {
            format!("<details id=\"{id}\">\n<summary><b>{label}</b> <span>{about}</span></summary>\n{body}</details>\n")
        })
        .collect()
}

/// Returns an HTML paragraph with the remark `text`, which the page shows instead of missing data.
fn absent(text: &str) -> String {
    format!("<p class=\"note\">{text}</p>\n")
}

/// Returns HTML tables of all quality measures, render times and parts of the size of one compressed model. `name` is
/// the name of the model, `result` its data.
fn numbers(result: &CompressedModelData, name: &str) -> String {
    let found = &result.evaluation;
    let mut rows = measures("compressed to original", &found.loss);
    if let Some(truth) = &found.ground_truth {
        rows.extend(measures("compressed to photographs", &truth.compressed));
        rows.extend(measures("original to photographs", &truth.original));
    }
    let mut out = format!(
        "<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"Measures of {}\">{}</div>\n",
        escape(name),
        table("wide", ["measure", "average", "worst frame (mean)", "worst view (mean)"], rows)
    );
    out += "<p class=\"note\">PSNR and SSIM: higher is better. Temporal error, the root mean square error of frame-to-frame \
            differences, and FLIP, the difference that a person would see: lower is better.</p>\n";
    if let Some(time) = result.render_time {
        out += &format!(
            "<p class=\"note\">Render time per view, median on one thread of this machine: {:.2} ms before, {:.2} ms \
             after.</p>\n",
            time.before, time.after
        );
    }
    let parts = size_parts(&found.size);
    if !parts.is_empty() {
        let rows = parts.into_iter().map(|(name, before, after)| {
            [escape(name), decimal_bytes(before), decimal_bytes(after), percent(after as f64, before as f64)]
        });
        out += &table("wide", ["part of the size", "before", "after", "share"], rows);
    }
    out
}

/// Returns the parts of the size (such as Gaussians and deformation field) that both models have and that take more
/// than 1% of the compressed model's bytes. Each is a tuple: name, bytes of the original, bytes of the compressed
/// model. Returns an empty list if there are fewer than two such parts.
fn size_parts(size: &OriginalAndCompressed<ModelSize>) -> Vec<(&'static str, u64, u64)> {
    let parts = size.original.named_parts().into_iter().zip(size.compressed.named_parts());
    let parts: Vec<_> = parts.map(|((name, before), (_, after))| (name, before, after)).collect();
    // Parts below 1% of the compressed model are left out.
    let least = size.compressed.total() / 100;
    let both: Vec<_> = parts.into_iter().filter(|&(_, before, after)| before > 0 && after > least).collect();
    if both.len() > 1 { both } else { Vec::new() }
}

/// Quality measure, such as PSNR. The fields are, in order: its name, the function that returns its mean, the function
/// that formats a value, and whether larger values are better.
type Measure = (&'static str, fn(&QualityMeans) -> Option<f64>, fn(f64) -> String, bool);

/// Returns the cells of table rows, one row per quality measure, with the average, the worst frame and the worst view
/// of the comparison `of`. `name` says what is compared, such as "compressed to original".
fn measures(name: &str, of: &Comparison) -> Vec<[String; 4]> {
    const MEASURES: [Measure; 4] = [
        ("PSNR", |means| Some(means.psnr), db, true),
        ("SSIM", |means| Some(means.ssim), |value| format!("{value:.4}"), true),
        ("temporal error", |means| means.temporal, figure, false),
        ("FLIP", |means| means.flip, |value| format!("{value:.4}"), false),
    ];
    let row = |(measure, value, text, is_larger_better): Measure| {
        let average = value(&of.overall)?;
        let worse = |a: &f64, b: &f64| if is_larger_better { a.total_cmp(b) } else { b.total_cmp(a) };
        let frames = of.per_frame.iter().filter_map(|frame| Some((value(&frame.means)?, frame.frame)));
        let views = of.per_view.iter().filter_map(|view| Some((value(&view.means)?, view.view)));
        let frame =
            frames.min_by(|a, b| worse(&a.0, &b.0)).map(|(worst, frame)| format!("{} (frame {frame})", text(worst)));
        let view = views.min_by(|a, b| worse(&a.0, &b.0)).map(|(worst, view)| format!("{} (view {view})", text(worst)));
        Some([format!("{measure}, {name}"), text(average), frame.unwrap_or_default(), view.unwrap_or_default()])
    };
    MEASURES.into_iter().filter_map(row).collect()
}

fn stages(run: &RunFiles) -> String {
    let Some((summary, _)) = &run.summary else {
        return absent(
            "There is no summary of a run beside the compressed model; <code>splatsieve compress</code> writes one.",
        );
    };
    let mut rows: Vec<[String; 5]> = Vec::new();
    for stage in &summary.stages {
        let memory = stage.peak_memory_bytes.map_or("–".to_owned(), |of| format!("{:.0} MiB", of as f64 / 1048576.0));
        let seconds = format!("{:.2} s", stage.seconds);
        rows.push([escape(&stage.name), grouped(stage.gaussians_in), grouped(stage.gaussians_out), seconds, memory]);
    }
    let total: f64 = summary.stages.iter().map(|stage| stage.seconds).sum();
    rows.push(["together".to_owned(), String::new(), String::new(), format!("{total:.2} s"), String::new()]);
    table("wide figures", ["step", "Gaussians in", "out", "time", "peak memory so far"], rows)
}

/// Returns the histograms of the scores in `result` as charts; a score whose values all fall into one bin becomes a
/// line of text.
fn score_histograms(result: &CompressedModelData) -> String {
    let Some(histograms) = &result.histograms else {
        return absent(
            "Which Gaussians were dropped is not known: there is no index map beside the compressed model that fits.",
        );
    };
    let mut out = String::from(
        "<p class=\"note\">Number of Gaussians of the original by value: kept ones at the bottom of each bar, then \
         dropped ones, then those merged into others. Values go by powers of ten, but shares of the frames from none \
         to all; 0 has no place among powers of ten, and Gaussians at 0 are counted in the legend. If a value \
         decides, the bars of kept and dropped ones lie apart; otherwise they overlap. The default recipe ranks by C \
         and W, then by the error that a removal causes in renders (not shown). It does not use D, κ (kappa), V and \
         S.</p>\n<div class=\"charts\">\n",
    );
    let mut alike = Vec::new();
    for of in histograms {
        let bins = of.bins.kept.len().max(of.bins.dropped.len()).max(of.bins.merged.len());
        let filled =
            |bin: usize| [&of.bins.kept, &of.bins.dropped, &of.bins.merged].iter().any(|bins| bins.get(bin) > Some(&0));
        if (0..bins).filter(|&bin| filled(bin)).count() > 1 {
            out += &figure_of(&format!("{} ({})", of.meaning, of.name), &histogram(of));
        } else {
            let zero = of.zero.kept + of.zero.dropped + of.zero.merged;
            let value = of.edges.first().map_or(String::new(), |edge| format!(", the others near {}", figure(*edge)));
            alike.push(format!("{} ({}): all values are alike, {} at 0{value}", of.meaning, of.name, grouped(zero)));
        }
    }
    out + "</div>\n" + &list(&alike)
}

fn histogram(of: &Histogram) -> String {
    let with = |name: &str, zero: usize, bins: &[usize]| {
        let more = if zero > 0 { format!(" (and {} at 0)", grouped(zero)) } else { String::new() };
        (format!("{name}{more}"), bins.to_vec())
    };
    StackedHistogram {
        title: format!("{} of kept, dropped and merged Gaussians", of.meaning),
        x: match of.log {
            true => ChartAxis::log(of.name),
            false => ChartAxis::linear(&format!("{}, part of the frames", of.name)),
        },
        edges: of.edges.clone(),
        groups: vec![
            with("kept", of.zero.kept, &of.bins.kept),
            with("dropped", of.zero.dropped, &of.bins.dropped),
            with("merged", of.zero.merged, &of.bins.merged),
        ],
    }
    .svg()
}

/// Returns the HTML of three lists: the omitted stages with their reasons, the percentiles of the terms of the score,
/// and all notes.
fn notes_section(result: &CompressedModelData, run: &RunFiles) -> String {
    let mut out = String::new();
    if let Some((summary, _)) = &run.summary {
        let mut rows: Vec<[String; 2]> =
            summary.left_out.iter().map(|left| [escape(&left.what), escape(&left.reason())]).collect();
        if rows.is_empty() {
            rows.push(["nothing".to_owned(), "every step and term had something to do".to_owned()]);
        }
        out += &table("wide words", ["left out", "why"], rows);
        let terms = summary.terms.iter().map(|term| {
            let usage = if term.active { "grades" } else { "only splits" };
            [escape(&term.name), figure(term.p1), figure(term.p99), usage.to_owned()]
        });
        out += &table("wide", ["term of the scores", "1st percentile", "99th", "use"], terms);
    }
    let mut notes: Vec<&String> = result.notes.iter().collect();
    notes.extend(run.summary.iter().flat_map(|(summary, _)| &summary.notes));
    notes.extend(&result.missing);
    out += &list(notes);
    if out.is_empty() { absent("Nothing is known of the run.") } else { out }
}

/// Returns the chart of a search for a quality goal, with the numbers of Gaussians that the search tried. Returns an
/// empty text if the run made no search.
fn search_chart(summary: &Summary) -> String {
    summary.goal.as_ref().map_or(String::new(), trade_off::search)
}

fn sweep_section(first: &Analysis, sweep: Option<&TradeOff>) -> String {
    match sweep {
        Some(found) => trade_off::section(found),
        None => absent(&format!(
            "Curves of quality against size, time and memory come from a sweep: <code>splatsieve sweep {} --cameras F</code> \
             writes <code>sweep.json</code>, which <code>report</code> takes as <code>--sweep FILE</code>.",
            escape(&first.data.evaluation.path.original)
        )),
    }
}

fn data_links(results: &[Analysis], sweep: Option<&TradeOff>, precision: Option<&PrecisionDiagram>) -> String {
    let first = &results[0];
    let mut names = vec!["report.json", "views.csv", "failure_modes.csv"];
    names.extend(first.data.histograms.as_ref().map(|_| "histograms.csv"));
    names.extend(first.run.summary.as_ref().map(|_| "stages.csv"));
    names.extend(sweep.map(|_| "trade_off.csv"));
    names.extend(sweep.filter(|of| !of.knobs.is_empty()).map(|_| "knobs.csv"));
    names.extend(precision.map(|_| "precision.csv"));
    let of_first = if results.len() > 1 { " The CSV files are those of the first result." } else { "" };
    format!(
        "<p>Beside this page: {}.{of_first}</p>\n<p class=\"note\">Made by {}.</p>\n",
        links(&names),
        escape(&first.data.evaluation.tool)
    )
}
