//! Charts of quality by frame and by view. Their axes cover only the range of the values, so that differences are
//! visible. A chart with fewer than two frames or views is left out.

use super::analysis::Analysis;
use super::chart::{ChartAxis, Plot, Series};
use crate::evaluation::results::{Comparison, QualityMeans};

/// Returns the HTML of the charts of PSNR by frame and by view; empty for a single view of a single frame.
pub(super) fn charts(results: &[Analysis], names: &[String]) -> String {
    let by_frame = by_frame(results, names, "PSNR", "PSNR, dB", |means| Some(means.psnr));
    let views = |of: &Comparison| of.per_view.iter().map(|view| (view.view.into(), view.means.psnr)).collect();
    wrapped(by_frame + &chart(results, names, "PSNR by view", ["view", "PSNR, dB"], false, &views))
}

/// Returns the HTML of charts over the frames, one for each quality measure other than PSNR.
pub(super) fn other_charts(results: &[Analysis], names: &[String]) -> String {
    let mut charts = by_frame(results, names, "SSIM", "SSIM", |means| Some(means.ssim));
    charts += &by_frame(results, names, "Temporal error", "error", |means| means.temporal);
    charts += &by_frame(results, names, "FLIP", "FLIP", |means| means.flip);
    wrapped(charts)
}

fn wrapped(charts: String) -> String {
    if charts.is_empty() { charts } else { format!("<div class=\"charts\">\n{charts}</div>\n") }
}

/// Returns the HTML of a chart of one quality measure over the frames. `measure`: name of the measure. `label`: axis
/// label of the measure. `value` returns the measure from the mean quality measures of a frame.
fn by_frame(
    results: &[Analysis],
    names: &[String],
    measure: &str,
    label: &str,
    value: impl Fn(&QualityMeans) -> Option<f64>,
) -> String {
    let points = |of: &Comparison| {
        of.per_frame.iter().filter_map(|frame| Some((frame.frame as f64, value(&frame.means)?))).collect()
    };
    chart(results, names, &format!("{measure} by frame"), ["frame", label], true, &points)
}

/// Returns the HTML of a chart with a series for each comparison of a model with the original or with photographs;
/// empty if every series has fewer than two points. `points` returns the points (x, y) of a comparison. `joined`:
/// whether lines join the points.
fn chart(
    results: &[Analysis],
    names: &[String],
    title: &str,
    labels: [&str; 2],
    joined: bool,
    points: &dyn Fn(&Comparison) -> Vec<(f64, f64)>,
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
    // A single series needs no legend.
    let is_alone = against.len() == 1;
    let series = |(name, of): (String, &Comparison)| Series {
        name: if is_alone { String::new() } else { name },
        points: points(of),
        joined,
        ..Series::default()
    };
    let series: Vec<Series> = against.into_iter().map(series).collect();
    if series.iter().all(|series| series.points.len() < 2) {
        return String::new();
    }
    let [x, y] = labels.map(ChartAxis::linear);
    Plot { title: title.to_owned(), x, y, series }.figure()
}
