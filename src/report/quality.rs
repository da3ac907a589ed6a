//! Charts of quality by frame and by view. Their axes cover only the range of the values, so that differences are
//! visible. A chart whose values are all equal is left out.

use super::analysis::Analysis;
use super::chart::{BarChart, ChartAxis, Plot, Series};
use super::document::figure_of;
use crate::evaluation::results::{Comparison, FrameMeans, QualityMeans, ViewMeans};

/// Maximum number of views in a chart. If there are more views, only the worst are shown.
const MOST_VIEWS: usize = 16;

/// Returns the HTML of the charts of PSNR by frame and by view; empty for a single view of a single frame.
pub(super) fn charts(results: &[Analysis], names: &[String]) -> String {
    let mut charts = by_frame(results, names, "PSNR", "PSNR, dB", &|means| Some(means.psnr));
    for (result, name) in results.iter().zip(names) {
        let title = if results.len() == 1 { "PSNR by view".to_owned() } else { format!("PSNR by view, {name}") };
        charts += &by_view(&result.data.evaluation.loss, &title);
    }
    wrapped(charts)
}

/// Returns the HTML of charts over the frames, one for each quality measure other than PSNR.
pub(super) fn other_charts(results: &[Analysis], names: &[String]) -> String {
    let mut charts = by_frame(results, names, "SSIM", "SSIM", &|means| Some(means.ssim));
    charts += &by_frame(results, names, "Temporal error", "error", &|means| means.temporal);
    charts += &by_frame(results, names, "FLIP", "FLIP", &|means| means.flip);
    wrapped(charts)
}

fn wrapped(charts: String) -> String {
    if charts.is_empty() { charts } else { format!("<div class=\"charts\">\n{charts}</div>\n") }
}

/// Returns the HTML of a chart of one quality measure over the frames; empty for fewer than two frames. `value` returns
/// the measure from the mean quality measures of a frame. `title`: caption of the chart. `label`: axis label of the
/// measure.
fn by_frame(
    results: &[Analysis],
    names: &[String],
    title: &str,
    label: &str,
    value: &dyn Fn(&QualityMeans) -> Option<f64>,
) -> String {
    let mut against: Vec<(String, &Comparison)> = Vec::new();
    for (result, name) in results.iter().zip(names) {
        let found = &result.data.evaluation;
        let name = if results.len() == 1 { "compressed" } else { name.as_str() };
        against.push((format!("{name}, to original"), &found.loss));
        if let Some(truth) = &found.ground_truth {
            against.push((format!("{name}, to photographs"), &truth.compressed));
        }
    }
    if let Some(truth) = &results[0].data.evaluation.ground_truth {
        against.push(("original, to photographs".to_owned(), &truth.original));
    }
    let point = |of: &FrameMeans| Some((of.frame as f64, value(&of.means)?));
    let series: Vec<Series> = against
        .iter()
        .map(|(name, of)| Series {
            // A single line needs no legend.
            name: if against.len() == 1 { String::new() } else { name.clone() },
            points: of.per_frame.iter().filter_map(point).collect(),
            joined: true,
            ..Series::default()
        })
        .collect();
    if series.iter().all(|series| series.points.len() < 2) {
        return String::new();
    }
    let title = format!("{title} by frame");
    let axis = |label: &str| ChartAxis { label: label.to_owned(), ..ChartAxis::default() };
    let plot = Plot { title: title.clone(), x: axis("frame"), y: axis(label), series };
    figure_of(&title, &plot.svg())
}

/// Returns the HTML of a chart of the PSNR of each view, worst first; empty for a single view.
fn by_view(of: &Comparison, title: &str) -> String {
    let bar = |view: &ViewMeans| (format!("view {}", view.view), view.means.psnr);
    let mut bars: Vec<(String, f64)> = of.per_view.iter().map(bar).collect();
    if bars.len() < 2 {
        return String::new();
    }
    bars.sort_by(|a, b| a.1.total_cmp(&b.1));
    let hidden = bars.len().saturating_sub(MOST_VIEWS);
    bars.truncate(MOST_VIEWS);
    let more = if hidden > 0 { format!(" (the {MOST_VIEWS} worst of {})", hidden + MOST_VIEWS) } else { String::new() };
    let chart = BarChart { title: title.to_owned(), label: format!("PSNR, dB{more}"), bars, is_fitted: true };
    figure_of(title, &chart.svg())
}
