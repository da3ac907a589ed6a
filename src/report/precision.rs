//! Work-precision diagrams as a page: error against time and memory, with a curve for every parameter and a mark for
//! every value of the parameter.
//!
//! Input: a [`PrecisionDiagram`]. Output: charts as SVG, and a page with charts.

use super::chart::{ChartAxis, Plot, Series};
use super::document::{list, measurements_page};
use super::html::{escape, figure};
use crate::evaluation::precision::{
    ADDED_ERROR, KEPT_COUNT_ERROR, KEPT_SET_JACCARD_DISTANCE, PrecisionCurve, PrecisionDiagram, PrecisionKnob,
    PrecisionSetting, RENDER_ERROR, axis_label,
};
use crate::progress::grouped;

/// File name of the page that the command `precision` writes.
pub const PAGE_FILE: &str = "precision.html";

/// Measure of work (time or memory): its axis label, and the function that returns its value for a measurement.
type WorkMeasure = (&'static str, fn(&PrecisionSetting) -> Option<f64>);

/// Measures of work along the horizontal axes of the charts.
const WORK: [WorkMeasure; 3] = [
    ("time of all processors, s", |mark| mark.cost.processor_seconds.map(|seconds| seconds.median)),
    ("wall time, s", |mark| Some(mark.cost.seconds.median)),
    ("peak memory, MiB", |mark| mark.cost.peak_memory_bytes.map(|bytes| bytes as f64 / f64::from(1 << 20))),
];

/// Returns the HTML of the page that the command `precision` writes.
pub fn page(diagram: &PrecisionDiagram) -> String {
    let mut body = conditions(diagram);
    for knob in &diagram.knobs {
        body += &format!(
            "<section>\n<h2>{} <small>({} error)</small></h2>\n{}</section>\n",
            escape(&knob.name),
            knob.source.name(),
            knob_html(knob)
        );
    }
    let files = ["precision.json", "precision.csv"];
    measurements_page("Error against run time", &diagram.path, &body, &files, &diagram.tool)
}

/// Returns the work-precision diagrams as an HTML section of a report.
pub(super) fn section(diagram: &PrecisionDiagram) -> String {
    let knob = |knob: &PrecisionKnob| {
        format!("<h3>{}</h3>\n{}", escape(&format!("{} ({} error)", knob.name, knob.source.name())), knob_html(knob))
    };
    conditions(diagram) + &diagram.knobs.iter().map(knob).collect::<String>()
}

/// Returns the HTML of a paragraph on the conditions under which the diagrams were measured, followed by the notes.
fn conditions(diagram: &PrecisionDiagram) -> String {
    let said = format!(
        "<p class=\"note\">{} Gaussians × {} frames; {} renders of {} frames scanned, judged by {}: {}. Every setting \
         keeps {} Gaussians. {} threads; medians of up to {} runs, fewer where they took {} s.</p>\n",
        grouped(diagram.gaussians),
        grouped(diagram.frames),
        grouped(diagram.views_scored),
        grouped(diagram.frames_scored),
        diagram.judged,
        escape(&diagram.cameras),
        grouped(diagram.kept),
        diagram.threads,
        diagram.runs,
        diagram.max_setting_seconds,
    );
    said + &list(&diagram.notes)
}

/// Returns the HTML of the charts and tables of one knob (group of parameters that were varied).
fn knob_html(knob: &PrecisionKnob) -> String {
    let mut out = format!("<p>{}</p>\n<div class=\"charts\">\n", escape(&knob.about));
    out.extend(charts(knob).iter().map(Plot::figure));
    out += "</div>\n";
    for curve in &knob.curves {
        out += &table(curve);
    }
    out
}

/// Returns the charts of one knob (group of parameters that were varied). Each kind of error has a chart against the
/// time of all processors; the first kind also has charts against wall time and memory. An error that is always 0 has
/// no chart.
pub fn charts(knob: &PrecisionKnob) -> Vec<Plot> {
    let mut errors: Vec<&String> =
        knob.curves.iter().flat_map(|curve| &curve.settings).flat_map(|m| m.errors.keys()).collect();
    // Errors of renders come first.
    errors.sort_by_key(|error| {
        (
            [ADDED_ERROR, RENDER_ERROR, KEPT_SET_JACCARD_DISTANCE, KEPT_COUNT_ERROR]
                .iter()
                .position(|of| of == error)
                .unwrap_or(4),
            *error,
        )
    });
    errors.dedup();
    let seen = |error: &&String| {
        knob.curves
            .iter()
            .flat_map(|curve| &curve.settings)
            .any(|mark| mark.errors.get(*error).is_some_and(|&e| e > 0.0))
    };
    let errors: Vec<&String> = errors.into_iter().filter(seen).collect();
    let mut charts: Vec<Plot> = errors.iter().map(|error| chart(knob, error, WORK[0])).collect();
    charts.extend(errors.first().into_iter().flat_map(|error| WORK[1..].iter().map(|&work| chart(knob, error, work))));
    charts
}

/// Returns the chart of the error called `error` against a measure of work (time or memory) for the settings of `knob`,
/// both on logarithmic axes.
fn chart(knob: &PrecisionKnob, error: &str, (work, at): WorkMeasure) -> Plot {
    let series = knob.curves.iter().map(|curve| {
        let marks: Vec<(&PrecisionSetting, f64, f64)> =
            curve.settings.iter().filter_map(|mark| Some((mark, at(mark)?, *mark.errors.get(error)?))).collect();
        Series {
            name: curve.name.clone(),
            points: marks.iter().map(|&(_, work, error)| (work, error)).collect(),
            joined: true,
            paired: false,
            labels: marks.iter().map(|(mark, ..)| label(curve, mark)).collect(),
        }
    });
    let title = format!("{}: {}, by {}", knob.name, axis_label(error), work.split(',').next().unwrap_or(work));
    Plot { title, x: ChartAxis::log(work), y: ChartAxis::log(&axis_label(error)), series: series.collect() }
}

/// Returns the label of the measurement `mark` in the chart of `curve`: the value of the varied parameter, with a star
/// if the recipe has this value.
fn label(curve: &PrecisionCurve, mark: &PrecisionSetting) -> String {
    let own = if curve.recipe_value == Some(mark.value) { "*" } else { "" };
    format!("{}{own}", figure(mark.value))
}

/// Returns an HTML table of all measurements of a curve.
fn table(curve: &PrecisionCurve) -> String {
    let mut errors: Vec<&String> = curve.settings.iter().flat_map(|mark| mark.errors.keys()).collect();
    errors.sort_unstable();
    errors.dedup();
    let names: String = errors.iter().map(|error| format!("<th>{}</th>", escape(error))).collect();
    let mut out = format!(
        "<details><summary>{}, against {}</summary>\n<div class=\"scroll\" tabindex=\"0\" role=\"region\" \
         aria-label=\"Values\"><table><tr><th>{}</th><th>s</th><th>from – to</th><th>processor s</th>\
         <th>MiB</th><th>dB</th>{names}</tr>\n",
        escape(&curve.name),
        escape(&curve.reference),
        escape(&curve.name)
    );
    for mark in &curve.settings {
        let cost = &mark.cost;
        let known = |value: Option<f64>| value.map_or("–".to_owned(), figure);
        let cells = [
            label(curve, mark),
            figure(cost.seconds.median),
            format!("{} – {}", figure(cost.seconds.min), figure(cost.seconds.max)),
            known(cost.processor_seconds.map(|seconds| seconds.median)),
            known(cost.peak_memory_bytes.map(|bytes| (bytes >> 20) as f64)),
            known(mark.psnr),
        ];
        let errors =
            errors.iter().map(|error| mark.errors.get(*error).map_or("–".to_owned(), |&error| figure(error)));
        let cells: String = cells.into_iter().chain(errors).map(|cell| format!("<td>{cell}</td>")).collect();
        out += &format!("<tr>{cells}</tr>\n");
    }
    out += "</table></div>\n";
    let mut said: Vec<String> = curve
        .orders
        .iter()
        .map(|order| {
            let expected = order.expected.map_or(String::new(), |expected| format!(" (theory: {expected})"));
            format!("order of {}: {:.2}{expected}", order.error, order.observed)
        })
        .collect();
    said.extend(curve.sufficient_value.map(|enough| {
        format!("from {} on it adds less than a tenth of the model's own error to renders", figure(enough))
    }));
    out += &list(&said);
    out + "</details>\n"
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::evaluation::cost::{Cost, MedianAndRange};
    use crate::evaluation::precision::InaccuracySource;

    fn mark(value: f64, errors: &[(&str, f64)]) -> PrecisionSetting {
        let seconds = MedianAndRange::from_values(vec![value]);
        let errors: BTreeMap<String, f64> = errors.iter().map(|&(of, error)| (of.to_owned(), error)).collect();
        let cost = Cost { runs: 1, seconds, processor_seconds: Some(seconds), peak_memory_bytes: Some(1 << 22) };
        PrecisionSetting { value, step: 1.0 / value, cost, errors, psnr: None }
    }

    fn knob(marks: Vec<PrecisionSetting>) -> PrecisionKnob {
        PrecisionKnob {
            name: "scoring".to_owned(),
            about: "<b>".to_owned(),
            source: InaccuracySource::Discretization,
            curves: vec![PrecisionCurve::new("scoring_views", "all", marks, Some(2.0), &[])],
        }
    }

    #[test]
    fn every_error_has_a_time_diagram_the_first_a_memory_diagram() {
        let marks =
            [4.0, 2.0, 1.0].map(|value| mark(value, &[("C", 0.1 / value), (ADDED_ERROR, 0.2 / value), ("W", 0.0)]));
        let charts = charts(&knob(marks.to_vec()));
        let titles: Vec<&str> = charts.iter().map(|chart| chart.title.as_str()).collect();
        assert_eq!(
            titles,
            [
                "scoring: error added / error of the model, by time of all processors",
                "scoring: relative L2 error of C, by time of all processors",
                "scoring: error added / error of the model, by wall time",
                "scoring: error added / error of the model, by peak memory",
            ]
        );
        for (title, svg) in charts.iter().map(|chart| (&chart.title, chart.svg())) {
            // One of the marks is the legend's.
            assert_eq!(svg.matches("class=\"mark ").count(), 4, "{title}");
            assert!(svg.contains(">2*</text>") && svg.contains(">4</text>"), "{title}: {svg}");
        }
    }

    #[test]
    fn errors_of_0_have_a_table_and_no_diagram() {
        let knob = knob(vec![mark(1.0, &[("bytes", 0.0)])]);
        assert!(charts(&knob).is_empty());
        let section = knob_html(&knob);
        assert!(section.contains("<td>0</td>") && !section.contains("<b>"), "{section}");
    }
}
