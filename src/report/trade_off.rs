//! Charts and page of a sweep, which measures several methods at several sizes: quality against number of Gaussians,
//! bytes, time and memory.
//!
//! Input: a [`TradeOff`]. Output: charts and pages with charts.

use super::chart::{ChartAxis, Plot, Series};
use super::document::{list, measurements_page};
use super::html::{escape, figure};
use crate::evaluation::method::Method;
use crate::evaluation::trade_off::{EffortCurve, TradeOff, TradeOffPoint};
use crate::pipeline::summary::GoalSummary;
use crate::progress::{decimal_bytes, grouped};

/// File name of the page that the command `sweep` writes.
pub const PAGE_FILE: &str = "sweep.html";

/// Function that returns the x or the y coordinate of a measurement in a chart; `None` if it is not known.
type Value<'a> = &'a dyn Fn(&TradeOffPoint) -> Option<f64>;

/// Returns the HTML of the page that the command `sweep` writes.
pub fn page(trade_off: &TradeOff) -> String {
    let mut files = vec!["sweep.json", "sweep.csv"];
    files.extend((!trade_off.knobs.is_empty()).then_some("knobs.csv"));
    let body = format!("<section>\n{}</section>\n", section(trade_off));
    measurements_page("What quality costs", &trade_off.path, &body, &files, &trade_off.tool)
}

/// Returns an HTML section with a description of the sweep, its charts and its notes.
pub(super) fn section(trade_off: &TradeOff) -> String {
    let runs =
        if trade_off.runs > 1 { format!("; times are medians of {} runs", trade_off.runs) } else { String::new() };
    let paired = curves(trade_off).iter().any(|curve| curve.paired);
    let pair = if paired { " Hollow, in the same color: the same method without refinement." } else { "" };
    let mut out = format!(
        "<p class=\"note\">{}: {} Gaussians, {}; {} renders, {} threads{runs}. Lines go from few Gaussians to \
         many.{pair}</p>\n<div class=\"charts\">\n",
        escape(&trade_off.path),
        grouped(trade_off.gaussians),
        decimal_bytes(trade_off.bytes),
        trade_off.views,
        trade_off.threads
    );
    out.extend(charts(trade_off).iter().map(Plot::figure));
    out + "</div>\n" + &list(&trade_off.notes)
}

/// Returns the HTML of a chart of a search for a quality goal: the numbers of Gaussians that it tried, and the quality
/// of each.
pub(super) fn search(goal: &GoalSummary) -> String {
    let mut tried: Vec<(f64, f64)> = goal.tried.iter().map(|&(size, quality)| (size as f64, quality)).collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    let ends = [tried.first(), tried.last()].into_iter().flatten().map(|end| (end.0, goal.asked)).collect();
    let what = if goal.name == "max_loss" { "PSNR lost against photographs, dB" } else { "PSNR, dB" };
    let series = vec![
        Series { name: "tried".to_owned(), points: tried, joined: true, ..Series::default() },
        Series {
            name: format!("asked for: {} dB", figure(goal.asked)),
            points: ends,
            joined: true,
            ..Series::default()
        },
    ];
    let title = format!("Sizes that the run tried for --{}", goal.name.replace('_', "-"));
    let plot = Plot { title, x: ChartAxis::log("Gaussians"), y: ChartAxis::linear(what), series };
    format!("<div class=\"charts\">\n{}</div>\n", plot.figure())
}

/// Returns all charts of a sweep: quality against size, time and memory with a series per method, and a chart of error
/// against run time for each varied parameter.
pub fn charts(trade_off: &TradeOff) -> Vec<Plot> {
    let curves = curves(trade_off);
    let kept = |point: &TradeOffPoint| Some(100.0 * trade_off.kept_fraction(point));
    let megabytes = |point: &TradeOffPoint| Some(point.bytes as f64 / 1e6);
    let seconds = |point: &TradeOffPoint| Some(point.seconds);
    let memory = |point: &TradeOffPoint| point.peak_memory_bytes.map(|bytes| bytes as f64 / (1 << 20) as f64);
    let psnr = |point: &TradeOffPoint| Some(point.psnr);
    let ssim = |point: &TradeOffPoint| Some(point.ssim);
    let plot = |title: &str, x: ChartAxis, y: ChartAxis, of: [Value<'_>; 2], joined: bool| {
        let series = curves.iter().map(|curve| Series {
            name: curve.name.to_owned(),
            points: curve.points.iter().filter_map(|p| Some((of[0](p)?, of[1](p)?))).collect(),
            joined,
            paired: curve.paired,
            labels: Vec::new(),
        });
        Plot { title: title.to_owned(), x, y, series: series.collect() }
    };
    let (linear, log) = (ChartAxis::linear, ChartAxis::log);
    let mut charts = vec![
        plot("PSNR by kept Gaussians", linear("Gaussians kept, %"), linear("PSNR, dB"), [&kept, &psnr], true),
        plot("SSIM by kept Gaussians", linear("Gaussians kept, %"), linear("SSIM"), [&kept, &ssim], true),
        plot("PSNR by size", log("size, MB"), linear("PSNR, dB"), [&megabytes, &psnr], true),
        plot("SSIM by size", log("size, MB"), linear("SSIM"), [&megabytes, &ssim], true),
        plot("PSNR by run time", log("time to compress, s"), linear("PSNR, dB"), [&seconds, &psnr], true),
        plot("SSIM by run time", log("time to compress, s"), linear("SSIM"), [&seconds, &ssim], true),
    ];
    charts.extend(trade_off.knobs.iter().map(|knob| effort_chart(knob, trade_off)));
    charts.push(plot("Error by memory", log("peak memory, MiB"), log(ERROR), [&memory, &|p| Some(error(p))], false));
    charts
}

/// Returns the chart of error against run time with a mark for each tried value of the parameter `knob`. For
/// comparison, the chart also has a mark for the same method without refinement, at the same number of Gaussians.
fn effort_chart(knob: &EffortCurve, trade_off: &TradeOff) -> Plot {
    let at = |point: &TradeOffPoint| (point.seconds, error(point));
    let first = knob.settings.first().map(|setting| &setting.point);
    let is_beside = |point: &&TradeOffPoint| {
        let without = Method::ALL.into_iter().find(|method| method.name() == point.method);
        let refined = without.and_then(Method::with_refinement).map(Method::name);
        first.is_some_and(|first| {
            first.requested_fraction == point.requested_fraction && refined == Some(first.method.as_str())
        })
    };
    let mut series = vec![Series {
        name: format!("{}, {} beside the marks", first.map_or("", |point| &point.method), knob.parameter),
        points: knob.settings.iter().map(|setting| at(&setting.point)).collect(),
        joined: true,
        paired: false,
        labels: knob.settings.iter().map(|setting| setting.value.to_string()).collect(),
    }];
    series.extend(trade_off.points.iter().filter(is_beside).map(|point| Series {
        name: point.method.clone(),
        points: vec![at(point)],
        paired: true,
        ..Series::default()
    }));
    let kept = first.map_or(1.0, |point| trade_off.kept_fraction(point));
    let title = format!("Error by run time, {}% kept, by {}", figure(100.0 * kept), knob.parameter);
    Plot { title, x: ChartAxis::log("time to compress, s"), y: ChartAxis::log(ERROR), series }
}

/// Axis label of the values that [`error`] returns.
const ERROR: &str = "root mean square error";

/// Returns the root mean square error, of colors in [0, 1], that corresponds to the mean PSNR of `point`.
fn error(point: &TradeOffPoint) -> f64 {
    10f64.powf(-point.psnr / 20.0)
}

/// Measurements of one method in a sweep.
struct MethodCurve<'a> {
    name: &'a str,
    /// Measurements by increasing number of Gaussians.
    points: Vec<&'a TradeOffPoint>,
    /// Whether this curve shows the same method as the curve before it, but without refinement.
    paired: bool,
}

/// Groups the measurements by method, one curve per method. If a method was measured with and without refinement, its
/// two curves come first: with refinement, then without.
fn curves(trade_off: &TradeOff) -> Vec<MethodCurve<'_>> {
    let mut curves: Vec<MethodCurve<'_>> = Vec::new();
    for point in &trade_off.points {
        match curves.iter_mut().find(|curve| curve.name == point.method) {
            Some(curve) => curve.points.push(point),
            None => curves.push(MethodCurve { name: &point.method, points: vec![point], paired: false }),
        }
    }
    curves.iter_mut().for_each(|curve| curve.points.sort_by_key(|point| point.count));
    for (method, refined) in Method::ALL.into_iter().filter_map(|method| Some((method, method.with_refinement()?))) {
        let pair = [refined, method].map(Method::name);
        if pair.iter().all(|&name| curves.iter().any(|curve| curve.name == name)) {
            let place =
                |curve: &MethodCurve<'_>| pair.iter().position(|&name| name == curve.name).unwrap_or(pair.len());
            // The sort is stable, so all other curves stay in their order.
            curves.sort_by_key(place);
            curves[1].paired = true;
        }
    }
    curves
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::trade_off::EffortSetting;

    fn point(method: &str, count: usize, psnr: f64, peak_memory_bytes: Option<u64>) -> TradeOffPoint {
        let bytes = count as u64 * 248;
        TradeOffPoint {
            method: method.to_owned(),
            requested_fraction: None,
            count,
            bytes,
            psnr,
            ssim: 0.9,
            temporal: None,
            seconds: 2.0,
            peak_memory_bytes,
        }
    }

    fn found(points: Vec<TradeOffPoint>, knobs: Vec<EffortCurve>) -> TradeOff {
        TradeOff {
            tool: String::new(),
            path: "<b>/scene".to_owned(),
            digest: String::new(),
            gaussians: 100,
            bytes: 24_800,
            threads: 1,
            views: 3,
            cameras: String::new(),
            runs: 3,
            points,
            knobs,
            notes: Vec::new(),
        }
    }

    fn marks(svg: &str) -> usize {
        svg.matches("class=\"mark ").count()
    }

    #[test]
    fn every_known_point_is_drawn_once_in_the_series_of_its_method() {
        let points = vec![
            point("random", 50, 20.0, None),
            point("default", 50, 40.0, Some(1 << 20)),
            point("random", 20, 15.0, Some(3 << 20)),
        ];
        let charts = charts(&found(points, Vec::new()));
        // Two marks of every chart belong to the legend.
        let svg: Vec<String> = charts.iter().map(Plot::svg).collect();
        assert_eq!(svg.iter().map(|svg| marks(svg) - 2).collect::<Vec<_>>(), [3, 3, 3, 3, 3, 3, 2]);
        assert!(svg.iter().all(|svg| svg.contains(">random</text>")));
        assert_eq!(svg[0].matches("<polyline").count(), 1, "a single point has no line");
    }

    #[test]
    fn a_method_and_its_unrefined_form_are_a_pair_in_any_order() {
        let points = ["no-refine", "random", "default"].map(|name| point(name, 50, 30.0, None)).to_vec();
        let all = found(points.clone(), Vec::new());
        let drawn: Vec<(&str, bool)> = curves(&all).iter().map(|curve| (curve.name, curve.paired)).collect();
        assert_eq!(drawn, [("default", false), ("no-refine", true), ("random", false)]);
        let alone = found(points[..2].to_vec(), Vec::new());
        assert!(curves(&alone).iter().all(|curve| !curve.paired));
    }

    #[test]
    fn effort_chart_shows_values_and_the_unrefined_method() {
        let setting = |(value, psnr): (u32, f64)| EffortSetting { value, point: point("default", 10, psnr, None) };
        let settings = [(100, 20.0), (1500, 40.0)].map(setting).to_vec();
        let knob = EffortCurve { parameter: "refine_steps".to_owned(), settings };
        let mut other_size = point("no-refine", 50, 30.0, None);
        other_size.requested_fraction = Some(0.5);
        let points = vec![point("no-refine", 10, 15.0, None), other_size, point("random", 10, 5.0, None)];
        let found = found(points, vec![knob]);
        let charts = charts(&found);
        let svg = charts[6].svg();
        assert_eq!(charts[6].title, "Error by run time, 10% kept, by refine_steps");
        assert_eq!(marks(&svg), 2 + 3, "the legend's two, the knob's two and no-refine at this size: {svg}");
        assert!(svg.contains(">100</text>") && svg.contains(">1500</text>"), "{svg}");
        let page = page(&found);
        assert!(page.contains("knobs.csv") && page.contains("medians of 3 runs") && !page.contains("<b>"), "{page}");
    }
}
