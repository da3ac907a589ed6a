//! The page of a report, section by section.

use super::chart::{Bars, ChartAxis, Plot, Series, Stack};
use super::document::{document, figure_of, links, list};
use super::failure::{APART_DB, FailureMode, LOST, VISIBLE_DB, Verdict};
use super::film::{FilmPanel, KINDS, QUALITY};
use super::findings::{Close, ReportData};
use super::histogram::Histogram;
use super::html::{bytes, count, escape, figure, file_name, percent};
use super::run::RunFiles;
use super::shown::ShownImage;
use super::{precision, trade_off};
use crate::evaluation::found::{Both, Comparison, FrameMeans, QualityMeans, ViewMeans};
use crate::journal::records::StageRecord;
use crate::models::Size;
use crate::pipeline::summary::Summary;

/// What moves the slider.
const SCRIPT: &str = include_str!("page.js");
/// What plays the films.
const PLAY: &str = include_str!("film.js");

/// Puts the page together.
pub(super) fn page(report: &ReportData, run: &RunFiles, shown: &[ShownImage], close: &[Close]) -> String {
    let title = format!("{} – what compression cost", file_name(&report.evaluation.path.compressed));
    let mut out = String::new();
    let sections = [
        ("", header(report)),
        ("Compare", compare(shown)),
        ("See it move", films(&report.films)),
        ("Where it is lost", by_frame_and_view(report)),
        ("Known failure modes", failure_modes(&report.failure_modes, close)),
        ("Run", stages(run)),
        ("Scores of what was kept and dropped", score_histograms(report)),
        ("Notes and what was left out", left_out(report, run)),
        ("Trade-off", sweep(report, run)),
        ("Error against run time", report.precision.as_ref().map_or(String::new(), precision::section)),
        ("Data", data(report, run)),
    ];
    for (heading, body) in sections {
        match heading {
            _ if body.is_empty() => (),
            "" => out += &format!("<header>\n{body}</header>\n"),
            _ => {
                let id = heading.split(' ').next().unwrap_or(heading).to_lowercase();
                out += &format!("<section id=\"{id}\">\n<h2>{heading}</h2>\n{body}</section>\n");
            }
        }
    }
    document(&title, &out, &[SCRIPT, PLAY])
}

fn header(report: &ReportData) -> String {
    let found = &report.evaluation;
    let card = |label: &str, value: String, more: String| {
        format!("<div class=\"card\"><b>{value}</b><span>{label}</span><small>{more}</small></div>\n")
    };
    let from = |before: String, part: f64, whole: f64| format!("of {before} · {}", percent(part, whole));
    let (counts, sizes) = (found.count, found.bytes);
    let worst = |value: fn(&QualityMeans) -> f64| {
        found.loss.per_frame.iter().map(|of| value(&of.means)).fold(f64::INFINITY, f64::min)
    };
    let mut out = format!(
        "<p class=\"paths\">{} → {}</p>\n<h1>What compression cost</h1>\n<p class=\"verdict\">{}</p>\n<div class=\"cards\">\n",
        escape(&found.path.original),
        escape(&found.path.compressed),
        escape(&report.verdict)
    );
    out += &card(
        "Gaussians",
        count(counts.compressed),
        from(count(counts.original), counts.compressed as f64, counts.original as f64),
    );
    let whole = if size_parts(&found.size).is_empty() { "size" } else { "size of the whole model" };
    out += &card(
        whole,
        bytes(sizes.compressed),
        from(bytes(sizes.original), sizes.compressed as f64, sizes.original as f64),
    );
    for (part, before, after) in size_parts(&found.size) {
        out += &card(part, bytes(after), from(bytes(before), after as f64, before as f64));
    }
    let mean = found.loss.overall;
    out += &card("PSNR to the original", db(mean.psnr), format!("worst frame {}", db(worst(|m| m.psnr))));
    out += &card("SSIM to the original", format!("{:.4}", mean.ssim), format!("worst frame {:.4}", worst(|m| m.ssim)));
    if let Some(temporal) = mean.temporal {
        out += &card("temporal error", figure(temporal), "of frame-to-frame differences".to_owned());
    }
    if let Some(flip) = mean.flip {
        let worst = found.loss.per_frame.iter().filter_map(|of| of.means.flip).fold(0.0, f64::max);
        out += &card("FLIP to the original", format!("{flip:.4}"), format!("worst frame {worst:.4}"));
    }
    if let Some(truth) = &found.ground_truth {
        let (after, before) = (truth.compressed.overall, truth.original.overall);
        out += &card("PSNR to photographs", db(after.psnr), format!("the original {}", db(before.psnr)));
        out += &card("SSIM to photographs", format!("{:.4}", after.ssim), format!("the original {:.4}", before.ssim));
    }
    out += &format!(
        "</div>\n<p class=\"note\">{} views of {} frames, {} cameras: {}. PSNR has peak 1 and is averaged over \
         pictures; the temporal error is the root mean square of what frame-to-frame differences differ by.</p>\n",
        count(found.cameras.pairs),
        found.loss.per_frame.len(),
        found.cameras.cameras,
        escape(&found.cameras.origin)
    );
    out
}

fn db(value: f64) -> String {
    format!("{value:.2} dB")
}

/// The slider: all images lie on one another, and which two are seen is a matter of classes.
fn compare(shown: &[ShownImage]) -> String {
    let mut out = String::from("<div class=\"bar\" role=\"group\" aria-label=\"render\">\n");
    for (number, picture) in shown.iter().enumerate() {
        let choice = &picture.choice;
        out += &format!(
            "<button type=\"button\" data-show=\"{number}\" aria-pressed=\"{}\">{}<small>frame {}, view {} · {}</small></button>\n",
            number == 0,
            escape(&choice.why.join(", ")),
            choice.frame,
            choice.view,
            db(choice.psnr)
        );
    }
    out += "</div>\n<div class=\"bar sides\">\n";
    for (side, other) in [("left", "original"), ("right", "compressed")] {
        out += &format!("<label>{side} <select data-side=\"{side}\">");
        for (name, _) in shown.first().map_or(&[][..], |picture| &picture.images[..]) {
            let selected = if *name == other { " selected" } else { "" };
            out += &format!("<option value=\"{name}\"{selected}>{name}</option>");
        }
        out += "</select></label>\n";
    }
    out += "</div>\n<div id=\"stage\" style=\"--cut: 50%\">\n";
    for (number, picture) in shown.iter().enumerate() {
        let (width, height) = picture.size;
        let active = if number == 0 { " active" } else { "" };
        out += &format!(
            "<div class=\"picture{active}\" data-picture=\"{number}\" style=\"--ratio: {width} / {height}\">\n"
        );
        for (name, uri) in &picture.images {
            let side = match *name {
                "original" => " class=\"left\"",
                "compressed" => " class=\"right\"",
                _ => "",
            };
            out += &format!("<img data-kind=\"{name}\"{side} alt=\"{name}\" draggable=\"false\" src=\"{uri}\">\n");
        }
        let shrunk = at_size(picture.shrunk);
        let flip = picture.choice.flip.map_or(String::new(), |flip| format!(", FLIP {}", figure(flip)));
        out += &format!(
            "<p class=\"caption\" hidden>frame {}, view {}: PSNR {}, SSIM {:.4}{flip}; the difference is {} times as bright as it \
             is{shrunk}</p>\n</div>\n",
            picture.choice.frame,
            picture.choice.view,
            db(picture.choice.psnr),
            picture.choice.ssim,
            picture.factor
        );
    }
    out += "<span class=\"tag tag-left\"></span><span class=\"tag tag-right\"></span><i id=\"handle\"></i>\n</div>\n\
            <input id=\"cut\" type=\"range\" min=\"0\" max=\"100\" step=\"0.5\" value=\"50\" \
            aria-label=\"how much of the left render is shown\">\n<p class=\"note\" id=\"caption\"></p>\n";
    out
}

/// Of pictures of which that many pixels each way became one.
fn at_size(shrunk: u32) -> String {
    match shrunk {
        1 => String::new(),
        by => format!("; shown at 1/{by} of its size"),
    }
}

/// Films with what plays them. Without a script their first frames are seen.
fn films(films: &[FilmPanel]) -> String {
    let Some(first) = films.first() else { return String::new() };
    let mut out = String::new();
    if films.len() > 1 {
        out += "<div class=\"bar\" role=\"group\" aria-label=\"film\">\n";
        for (number, film) in films.iter().enumerate() {
            out += &format!(
                "<button type=\"button\" data-play=\"{number}\" aria-pressed=\"{}\">from the {}<small>view {}, its camera at \
                 frame {}</small></button>\n",
                number == 0,
                escape(&film.why[0]),
                film.view,
                film.camera_of_frame
            );
        }
        out += "</div>\n";
    }
    out += &format!(
        "<div id=\"reel\" class=\"bar\" hidden><button type=\"button\">Play</button><input type=\"range\" min=\"0\" max=\"{}\" \
         step=\"1\" value=\"0\" aria-label=\"frame\"><output></output></div>\n",
        first.frames.len() - 1
    );
    for (number, film) in films.iter().enumerate() {
        let join = |values: Vec<String>| values.join(" ");
        let active = if number == 0 { " active" } else { "" };
        out += &format!(
            "<div class=\"film{active}\" data-film=\"{number}\" data-frames=\"{}\" data-psnr=\"{}\" style=\"--ratio: {} / {}\">\n",
            join(film.frames.iter().map(usize::to_string).collect()),
            join(film.psnr.iter().map(|psnr| format!("{psnr:.2}")).collect()),
            film.size.0,
            film.size.1
        );
        for (k, kind) in KINDS.iter().enumerate() {
            out += &format!("<figure><figcaption>{kind}</figcaption><div class=\"pile\">");
            for (place, (images, frame)) in film.images.iter().zip(&film.frames).enumerate() {
                let now = if place == 0 { " class=\"now\"" } else { "" };
                out += &format!("<img{now} alt=\"{kind}, frame {frame}\" draggable=\"false\" src=\"{}\">", images[k]);
            }
            out += "</div></figure>\n";
        }
        out += &format!(
            "<p class=\"note\">View {}, by its camera at frame {}: {} frames, evenly from first to last; the difference is {} times as bright as it is{}; JPEG of quality {QUALITY}, the \
             figures are those of the pictures themselves.</p>\n</div>\n",
            film.view,
            film.camera_of_frame,
            film.frames.len(),
            film.factor,
            at_size(film.shrunk)
        );
    }
    out
}

fn by_frame_and_view(report: &ReportData) -> String {
    let found = &report.evaluation;
    let against: Vec<(&str, &Comparison)> = [("compressed to original", Some(&found.loss))]
        .into_iter()
        .chain(found.ground_truth.iter().flat_map(|truth| {
            [("compressed to photographs", Some(&truth.compressed)), ("original to photographs", Some(&truth.original))]
        }))
        .filter_map(|(name, of)| Some((name, of?)))
        .collect();
    let frames = |value: &dyn Fn(&QualityMeans) -> Option<f64>, label: &str, title: &str| {
        let point = |of: &FrameMeans| Some((of.frame as f64, value(&of.means)?));
        let series = against.iter().map(|(name, of)| Series {
            name: (*name).to_owned(),
            points: of.per_frame.iter().filter_map(point).collect(),
            joined: true,
            ..Series::default()
        });
        let axis = |label: &str| ChartAxis { label: label.to_owned(), ..ChartAxis::default() };
        Plot { title: title.to_owned(), x: axis("frame"), y: axis(label), series: series.collect() }.svg()
    };
    let views = |of: &Comparison, title: &str| {
        let bar = |view: &ViewMeans| (format!("view {}", view.view), view.means.psnr);
        let mut bars: Vec<(String, f64)> = of.per_view.iter().map(bar).collect();
        bars.sort_by(|a, b| a.1.total_cmp(&b.1));
        let hidden = bars.len().saturating_sub(MOST_VIEWS);
        bars.truncate(MOST_VIEWS);
        let more =
            if hidden > 0 { format!(" (the {MOST_VIEWS} worst of {})", hidden + MOST_VIEWS) } else { String::new() };
        Bars { title: title.to_owned(), label: format!("PSNR, dB{more}"), bars }.svg()
    };
    let mut out = String::from("<div class=\"charts\">\n");
    out += &figure_of("PSNR over frames", &frames(&|m| Some(m.psnr), "PSNR, dB", "PSNR over frames"));
    out += &figure_of("PSNR by view, compressed to original", &views(&found.loss, "PSNR by view"));
    out += &figure_of("SSIM over frames", &frames(&|m| Some(m.ssim), "SSIM", "SSIM over frames"));
    if found.loss.overall.temporal.is_some() {
        out +=
            &figure_of("Temporal error over frames", &frames(&|m| m.temporal, "error", "Temporal error over frames"));
    }
    if found.loss.overall.flip.is_some() {
        out += &figure_of("FLIP over frames", &frames(&|m| m.flip, "FLIP", "FLIP over frames"));
    }
    out + "</div>\n"
}

/// Views that bars are drawn for, the worst.
const MOST_VIEWS: usize = 16;

fn failure_modes(modes: &[FailureMode], close: &[Close]) -> String {
    let mut out = format!(
        "<p class=\"note\">Where a kind of Gaussian is seen is known for every pixel: the share of its colour that comes \
         from them. A mode is flagged if the PSNR there is below {VISIBLE_DB} dB and at least {APART_DB} dB below that \
         elsewhere, and {} or more of their coverage was dropped or merged.</p>\n<div class=\"modes\">\n",
        format_args!("{}%", figure(100.0 * LOST))
    );
    for (number, mode) in modes.iter().enumerate() {
        let (class, word) = match mode.verdict {
            Verdict::Absent => ("none", "not in this scene"),
            Verdict::Unseen => ("none", "hardly in any view"),
            Verdict::Untouched => ("good", "nothing lost"),
            Verdict::Passed => ("good", "does not show"),
            Verdict::Flagged => ("bad", "shows"),
        };
        out += &format!(
            "<article class=\"{class}\"><h3>{} <em>{word}</em></h3>\n<p>{}.</p>\n<table>\n",
            capitalized(mode.name),
            escape(&mode.happens_to)
        );
        let mut row = |name: &str, value: Option<String>| {
            if let Some(value) = value {
                out += &format!("<tr><th>{name}</th><td>{value}</td></tr>\n");
            }
        };
        row("Gaussians", Some(count(mode.gaussians)));
        if mode.gaussians > 0 {
            let of = |part: Option<usize>| {
                part.map(|n| format!("{} ({})", count(n), percent(n as f64, mode.gaussians as f64)))
            };
            row("dropped", of(mode.dropped));
            row("merged", of(mode.merged));
            row("part of the scene's coverage", Some(percent(mode.coverage, 1.0)));
            row("of that dropped or merged", mode.coverage_lost.map(|lost| percent(lost, 1.0)));
            row("part of all pixels", Some(percent(mode.shown, 1.0)));
            row("PSNR there", mode.psnr_there.map(db));
            row("PSNR elsewhere", mode.psnr_elsewhere.map(db));
            row(
                "edges there that are lost",
                mode.detail_lost.map(|lost| if lost <= 0.0 { "none".into() } else { percent(lost, 1.0) }),
            );
            row("worst", mode.worst.map(|w| format!("frame {}, view {}: {}", w.frame, w.view, db(w.psnr))));
        }
        out += "</table>\n";
        if let Some(close) = close.iter().find(|close| close.mode == number) {
            let [original, compressed] = &close.images;
            out += &format!(
                "<div class=\"close\"><img alt=\"original\" src=\"{original}\"><img alt=\"compressed\" src=\"{compressed}\"></div>\n\
                 <p class=\"note\">original and compressed where most of the error is, from pixel {}, {}: {}</p>\n",
                close.corner.0,
                close.corner.1,
                db(close.psnr)
            );
        }
        out += "</article>\n";
    }
    out + "</div>\n"
}

fn capitalized(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

fn absent(what: &str) -> String {
    format!("<p class=\"note\">{what}</p>\n")
}

fn stages(run: &RunFiles) -> String {
    let Some((summary, _)) = &run.summary else {
        return absent(
            "There is no summary of a run beside the compressed model; <code>splatsieve compress</code> writes one.",
        );
    };
    let mut out = String::from(
        "<table class=\"wide figures\">\n<tr><th>stage</th><th>Gaussians in</th><th>out</th><th>time</th><th>peak memory so far</th></tr>\n",
    );
    for stage in &summary.stages {
        let memory = stage.peak_memory_bytes.map_or("–".to_owned(), |of| format!("{:.0} MiB", of as f64 / 1048576.0));
        out += &format!(
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{:.2} s</td><td>{memory}</td></tr>\n",
            escape(&stage.name),
            count(stage.gaussians_in),
            count(stage.gaussians_out),
            stage.seconds
        );
    }
    let total: f64 = summary.stages.iter().map(|stage| stage.seconds).sum();
    out += &format!("<tr><th>together</th><td></td><td></td><th>{total:.2} s</th><td></td></tr>\n</table>\n");
    out += "<div class=\"charts\">\n";
    out += &figure_of(
        "Time per stage",
        &stage_bars(summary, "seconds", |stage| Some((1e3 * stage.seconds).round() / 1e3)),
    );
    let mib = |stage: &StageRecord| Some(stage.peak_memory_bytes? as f64 / 1048576.0);
    out += &figure_of("Largest memory up to the end of each stage", &stage_bars(summary, "MiB", mib));
    out + "</div>\n"
}

/// Parts that both models have, if they have several: name, bytes before, bytes after.
fn size_parts(size: &Both<Size>) -> Vec<(&'static str, u64, u64)> {
    let parts = size.original.named().into_iter().zip(size.compressed.named());
    let parts: Vec<_> = parts.map(|((name, before), (_, after))| (name, before, after)).collect();
    // A hundredth of the whole is not worth a card.
    let least = size.compressed.whole() / 100;
    let both: Vec<_> = parts.into_iter().filter(|&(_, before, after)| before > 0 && after > least).collect();
    if both.len() > 1 { both } else { Vec::new() }
}

fn stage_bars(summary: &Summary, label: &str, value: impl Fn(&StageRecord) -> Option<f64>) -> String {
    let bars = summary.stages.iter().filter_map(|stage| Some((stage.name.clone(), value(stage)?))).collect();
    Bars { title: format!("{label} per stage"), label: label.to_owned(), bars }.svg()
}

fn score_histograms(report: &ReportData) -> String {
    let Some(histograms) = &report.histograms else {
        return absent(
            "Which Gaussians went is not known: there is no index map beside the compressed model that fits.",
        );
    };
    let mut out = String::from(
        "<p class=\"note\">How many Gaussians of the original have which value: those that were kept at the bottom of each bar, \
         then those dropped, then those merged into others. StatisticAccess go by powers of ten, but shares of the frames from none to \
         all; 0 has no place among powers of ten, and who has it is counted in the legend. Where kept and dropped ones lie \
         apart, the value says who goes; where they lie on one another, something else render_blended.</p>\n<div class=\"charts\">\n",
    );
    for of in histograms {
        out += &figure_of(&format!("{}: {}", of.name, of.meaning), &histogram(of));
    }
    out + "</div>\n"
}

fn histogram(of: &Histogram) -> String {
    let with = |name: &str, zero: usize, bins: &[usize]| {
        let more = if zero > 0 { format!(" (and {} at 0)", count(zero)) } else { String::new() };
        (format!("{name}{more}"), bins.to_vec())
    };
    Stack {
        title: format!("{} of kept, dropped and merged Gaussians", of.name),
        x: match of.log {
            true => ChartAxis { label: of.name.to_owned(), log: true, from_zero: false },
            false => ChartAxis { label: format!("{}, part of the frames", of.name), ..ChartAxis::default() },
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

fn left_out(report: &ReportData, run: &RunFiles) -> String {
    let mut out = String::new();
    if let Some((summary, _)) = &run.summary {
        let mut rows: Vec<[String; 2]> =
            summary.left_out.iter().map(|left| [escape(&left.what), escape(&left.reason())]).collect();
        if rows.is_empty() {
            rows.push(["nothing".to_owned(), "every stage and term had something to do".to_owned()]);
        }
        out += "<table class=\"wide words\">\n<tr><th>left out</th><th>why</th></tr>\n";
        for [what, why] in rows {
            out += &format!("<tr><td>{what}</td><td>{why}</td></tr>\n");
        }
        out += "</table>\n<table class=\"wide\">\n<tr><th>term of the scores</th><th>1st percentile</th><th>99th</th><th></th></tr>\n";
        for term in &summary.terms {
            let grades = if term.active { "grades" } else { "only splits" };
            out += &format!(
                "<tr><td>{}</td><td>{}</td><td>{}</td><td>{grades}</td></tr>\n",
                escape(&term.name),
                figure(term.p1),
                figure(term.p99)
            );
        }
        out += "</table>\n";
    }
    let mut notes: Vec<&String> = report.notes.iter().collect();
    notes.extend(run.summary.iter().flat_map(|(summary, _)| &summary.notes));
    notes.extend(&report.missing);
    out += &list(notes);
    if out.is_empty() { absent("Nothing is known of the run.") } else { out }
}

fn sweep(report: &ReportData, run: &RunFiles) -> String {
    let searched = run.summary.as_ref().and_then(|(summary, _)| summary.goal.as_ref());
    let searched = searched.map_or(String::new(), trade_off::search);
    let Some(found) = &report.trade_off else {
        return searched
            + &absent(&format!(
                "Curves of quality against size, time and memory come from a sweep: \
             <code>splatsieve sweep {} --cameras F</code> writes <code>sweep.json</code>, which <code>report</code> \
             takes as <code>--sweep FILE</code>.",
                escape(&report.evaluation.path.original)
            ));
    };
    searched + &trade_off::section(found)
}

fn data(report: &ReportData, run: &RunFiles) -> String {
    let mut names = vec!["report.json", "pictures.csv", "failure_modes.csv"];
    names.extend(report.histograms.as_ref().map(|_| "histograms.csv"));
    names.extend(run.summary.as_ref().map(|_| "stages.csv"));
    names.extend(report.trade_off.as_ref().map(|_| "trade_off.csv"));
    names.extend(report.trade_off.as_ref().filter(|of| !of.knobs.is_empty()).map(|_| "knobs.csv"));
    names.extend(report.precision.as_ref().map(|_| "precision.csv"));
    format!(
        "<p>Everything on this page, as data beside it: {}.</p>\n<p class=\"note\">Made by {}.</p>\n",
        links(&names),
        escape(&report.tool)
    )
}
