//! The curves of a sweep: what quality costs in Gaussians, bytes, time and memory.
//!
//! Data in: a [`TradeOff`]. Data out: charts as SVG, which need [`super::chart::STYLE`] around them.

use super::chart::{Axis, Plot, Series};
use crate::verbs::trade_off::{Point, TradeOff};

/// What a chart is about, and its SVG.
pub type Chart = (&'static str, String);

/// A coordinate of a point, if it is known.
type Value<'a> = &'a dyn Fn(&Point) -> Option<f64>;

/// Every curve of a sweep, a series per method in the order of its points.
pub fn charts(found: &TradeOff) -> Vec<Chart> {
    let whole = found.gaussians.max(1) as f64;
    let kept = |point: &Point| Some(100.0 * point.count as f64 / whole);
    let megabytes = |point: &Point| Some(point.bytes as f64 / 1e6);
    let psnr = |point: &Point| Some(point.psnr);
    let ssim = |point: &Point| Some(point.ssim);
    let error = |point: &Point| Some(10f64.powf(-point.psnr / 20.0));
    let seconds = |point: &Point| Some(point.seconds);
    let memory = |point: &Point| point.peak_memory_bytes.map(|bytes| bytes as f64 / (1 << 20) as f64);
    let linear = |label: &str| Axis { label: label.to_owned(), ..Axis::default() };
    let log = |label: &str| Axis { label: label.to_owned(), log: true, from_zero: false };
    let plot = |title: &'static str, x: Axis, y: Axis, of: [Value<'_>; 2], joined: bool| {
        let series = methods(found)
            .into_iter()
            .map(|(name, points)| {
                let mut points: Vec<(f64, f64)> = points.iter().filter_map(|p| Some((of[0](p)?, of[1](p)?))).collect();
                points.sort_by(|a, b| a.0.total_cmp(&b.0));
                Series { name: name.to_owned(), points, joined }
            })
            .collect();
        (title, Plot { title: title.to_owned(), x, y, series }.svg())
    };
    vec![
        plot("PSNR by kept Gaussians", linear("Gaussians kept, %"), linear("PSNR, dB"), [&kept, &psnr], true),
        plot("SSIM by kept Gaussians", linear("Gaussians kept, %"), linear("SSIM"), [&kept, &ssim], true),
        plot("PSNR by size", log("size, MB"), linear("PSNR, dB"), [&megabytes, &psnr], true),
        plot("Error by run time", log("time to compress, s"), log("root mean square error"), [&seconds, &error], false),
        plot("Error by memory", log("peak memory, MiB"), log("root mean square error"), [&memory, &error], false),
    ]
}

/// Points by method, as they come.
fn methods(found: &TradeOff) -> Vec<(&str, Vec<&Point>)> {
    let mut methods: Vec<(&str, Vec<&Point>)> = Vec::new();
    for point in &found.points {
        match methods.iter_mut().find(|(name, _)| *name == point.method) {
            Some((_, points)) => points.push(point),
            None => methods.push((&point.method, vec![point])),
        }
    }
    methods
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(method: &str, count: usize, psnr: f64, peak_memory_bytes: Option<u64>) -> Point {
        let bytes = count as u64 * 248;
        Point {
            method: method.to_owned(),
            asked: None,
            count,
            bytes,
            psnr,
            ssim: 0.9,
            temporal: None,
            seconds: 2.0,
            peak_memory_bytes,
        }
    }

    #[test]
    fn every_point_that_is_known_is_drawn_once_in_its_methods_series() {
        let found = TradeOff {
            tool: String::new(),
            path: String::new(),
            digest: String::new(),
            gaussians: 100,
            bytes: 24_800,
            threads: 1,
            pictures: 3,
            cameras: String::new(),
            points: vec![
                point("random", 50, 20.0, None),
                point("default", 50, 40.0, Some(1 << 20)),
                point("random", 20, 15.0, Some(3 << 20)),
            ],
            notes: Vec::new(),
        };
        let charts = charts(&found);
        let marks = |svg: &str| svg.matches("class=\"mark ").count();
        // Two of every chart are the legend's.
        assert_eq!(charts.iter().map(|chart| marks(&chart.1) - 2).collect::<Vec<_>>(), [3, 3, 3, 3, 2]);
        assert!(charts.iter().all(|chart| chart.1.contains(">random</text>")));
        assert_eq!(charts[0].1.matches("<polyline").count(), 1, "a single point has no line");
    }
}
