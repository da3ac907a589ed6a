//! Charts as SVG elements of a page.
//!
//! Input: numbers and names. Output: one `<svg>` element with colors from `chart.css` and the font of the page around
//! it. Values that are not finite are not drawn. Series differ by shape and dash as well as by color. The colors are
//! those of Okabe and Ito ("Color Universal Design", 2008), which color-blind people can tell apart.

use std::fmt::{self, Write as _};

use super::document::figure_of;
use super::html::{escape, figure};

/// Width of a chart in SVG units, which are about a pixel each.
const WIDTH: f64 = 480.0;
/// Height of a chart in SVG units (about pixels).
const HEIGHT: f64 = 270.0;
/// Left margin of a chart, in SVG units (about pixels).
const LEFT: f64 = 80.0;
/// Right margin of a chart, in SVG units (about pixels).
const RIGHT: f64 = 14.0;
/// Bottom margin of a chart, in SVG units (about pixels).
const BOTTOM: f64 = 46.0;
/// Height of a line of a chart's legend, in SVG units (about pixels).
const LINE: f64 = 18.0;
/// Approximate width of a letter in SVG units (about pixels), on a narrow page, where letters are largest.
const LETTER: f64 = 8.2;
/// Number of different styles of series (color, shape, dash) that `chart.css` defines.
const STYLE_COUNT: usize = 9;

/// Axis of a chart, as the caller describes it.
#[derive(Debug, Clone, Default)]
pub struct ChartAxis {
    /// Measured quantity and its unit, written beside the axis.
    pub label: String,
    /// Whether the axis is logarithmic. Values that are not positive are then left out.
    pub log: bool,
}

impl ChartAxis {
    /// Returns a linear axis for the quantity `label`.
    pub fn linear(label: &str) -> ChartAxis {
        ChartAxis { label: label.to_owned(), log: false }
    }

    /// Returns a logarithmic axis for the quantity `label`.
    pub fn log(label: &str) -> ChartAxis {
        ChartAxis { label: label.to_owned(), log: true }
    }
}

/// Series of points in a plot, drawn in one style.
#[derive(Debug, Clone, Default)]
pub struct Series {
    /// Name in the legend; a series without a name is not listed.
    pub name: String,
    /// Points (x, y) of the series, in the order in which a line joins them.
    pub points: Vec<(f64, f64)>,
    /// Whether a line joins the points of the series.
    pub joined: bool,
    /// Whether the series is paired with the series before it. It then has the same color, dashed lines and hollow
    /// marks.
    pub paired: bool,
    /// Texts beside the points, shown where there is space: one per point, or none at all.
    pub labels: Vec<String>,
}

/// Plot of series over two axes.
#[derive(Debug, Clone, Default)]
pub struct Plot {
    /// Caption of the chart.
    pub title: String,
    /// Horizontal axis.
    pub x: ChartAxis,
    /// Vertical axis.
    pub y: ChartAxis,
    /// Series in the order of the legend.
    pub series: Vec<Series>,
}

/// Chart of stacked counts: for each bin of values, the counts of several groups of items on top of one another.
#[derive(Debug, Clone, Default)]
pub struct StackedHistogram {
    /// Description of the chart for readers who do not see it.
    pub title: String,
    /// Axis of the binned values.
    pub x: ChartAxis,
    /// Edges of the bins in increasing order; one more than there are bins.
    pub edges: Vec<f64>,
    /// Groups whose counts are stacked in every bin, from bottom to top: the name of the group, and its count in each
    /// bin.
    pub groups: Vec<(String, Vec<usize>)>,
}

/// Scale of an axis: its range of values, and the range of SVG units (about pixels) onto which it is mapped.
struct AxisScale {
    log: bool,
    low: f64,
    high: f64,
    start: f64,
    end: f64,
}

impl AxisScale {
    /// Returns a scale for the axis `axis` that covers the numbers in `values` with a margin. The axis runs from
    /// `start` to `end`, positions in the chart in SVG units (about pixels). Returns `None` if there are no values to
    /// draw.
    fn new(axis: &ChartAxis, values: impl Iterator<Item = f64>, [start, end]: [f64; 2]) -> Option<AxisScale> {
        let fits = |v: &f64| v.is_finite() && (!axis.log || *v > 0.0);
        let (mut low, mut high) =
            values.filter(fits).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        if low > high {
            return None;
        }
        if axis.log {
            (low, high) = (low.log10(), high.log10());
        }
        if high - low < 1e-12 * high.abs().max(1e-9) {
            let margin = if axis.log { 0.3 } else { 0.05 * high.abs().max(1e-9) };
            (low, high) = (low - margin, high + margin);
        }
        let margin = 0.04 * (high - low);
        Some(AxisScale { log: axis.log, low: low - margin, high: high + margin, start, end })
    }

    /// Extends the range of values of this axis at its upper end, so that about `margin` SVG units (about pixels) stay
    /// free after the largest value.
    fn reserve_end(&mut self, margin: f64) {
        let length = self.end - self.start;
        self.high += (self.high - self.low) * margin / (length - margin).max(0.5 * length);
    }

    /// Returns the position at which `value` is drawn, in SVG units (about pixels); `None` if the value is not finite,
    /// or not positive on a logarithmic axis.
    fn at(&self, value: f64) -> Option<f64> {
        let value = if self.log { value.log10() } else { value };
        let at = self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start);
        at.is_finite().then_some(at)
    }

    /// Returns the values of the ticks: round values within the range of the axis.
    fn ticks(&self) -> Vec<f64> {
        if self.log {
            let decades = (self.low.floor() as i32)..=(self.high.ceil() as i32);
            let few = self.high - self.low < 2.0;
            let step = ((self.high - self.low) / 6.0).ceil().max(1.0) as i32;
            let ticks: Vec<f64> = decades
                .filter(|power| few || power.rem_euclid(step) == 0)
                .flat_map(|power| {
                    let factors: &[f64] = if few { &[1.0, 2.0, 5.0] } else { &[1.0] };
                    factors.iter().map(move |factor| factor * 10f64.powi(power))
                })
                .filter(|tick| (self.low..=self.high).contains(&tick.log10()))
                .collect();
            // Within a small part of a decade a logarithm is almost linear.
            if ticks.len() >= 2 {
                return ticks;
            }
            return even_ticks(10f64.powf(self.low), 10f64.powf(self.high));
        }
        even_ticks(self.low, self.high)
    }
}

/// Returns about five round values from `low` to `high`, evenly spaced.
fn even_ticks(low: f64, high: f64) -> Vec<f64> {
    let rough = (high - low) / 5.0;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * power).into_iter().find(|&s| s >= rough);
    let step = step.unwrap_or(10.0 * power);
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|k| k as f64 * step).collect()
}

impl Plot {
    /// Returns the plot as an HTML figure, with its title as the caption.
    pub fn figure(&self) -> String {
        figure_of(&self.title, &self.svg())
    }

    /// Returns the plot as an `<svg>` element.
    pub fn svg(&self) -> String {
        let styles = self.styles();
        let legend: Vec<LegendEntry<'_>> = self
            .series
            .iter()
            .zip(&styles)
            .map(|(of, &style)| LegendEntry { name: &of.name, style, joined: of.joined })
            .collect();
        let mut out = Drawing::new(&self.title, &legend);
        let points = || self.series.iter().flat_map(|series| series.points.iter().copied());
        let x = AxisScale::new(&self.x, points().map(|p| p.0), [LEFT, WIDTH - RIGHT]);
        let y = AxisScale::new(&self.y, points().map(|p| p.1), [HEIGHT - BOTTOM, out.top]);
        let (Some(mut x), Some(y)) = (x, y) else { return out.empty() };
        let longest = self.series.iter().flat_map(|series| &series.labels).map(|label| label.chars().count()).max();
        x.reserve_end(longest.unwrap_or(0) as f64 * LETTER);
        out.axes(&x, &y, &self.x.label, &self.y.label);
        for (series, style) in self.series.iter().zip(styles) {
            let place = |(k, &(a, b)): (usize, &(f64, f64))| Some((k, x.at(a)?, y.at(b)?));
            let places: Vec<(usize, f64, f64)> = series.points.iter().enumerate().filter_map(place).collect();
            if series.joined && places.len() > 1 {
                let line: Vec<String> = places.iter().map(|p| format!("{:.1},{:.1}", p.1, p.2)).collect();
                out.push(&format!("<polyline class=\"line {style}\" points=\"{}\"/>", line.join(" ")));
            }
            for (k, px, py) in places {
                let (a, b) = series.points[k];
                let words = [series.name.as_str(), series.labels.get(k).map_or("", String::as_str)];
                let tip = format!("{} {}, {}", words.join(" ").trim(), figure(a), figure(b));
                out.mark(style, px, py, tip.trim_start());
                out.label(px, py, words[1]);
            }
        }
        out.finish()
    }

    /// Returns the style (color, shape, dash) of every series.
    fn styles(&self) -> Vec<SeriesStyle> {
        let mut colors = 0;
        let style = |series: &Series| {
            let hollow = series.paired && colors > 0;
            colors += usize::from(!hollow);
            SeriesStyle { hollow, ..SeriesStyle::from_number(colors - 1) }
        };
        self.series.iter().map(style).collect()
    }
}

impl StackedHistogram {
    /// Returns the stacked counts as an `<svg>` element.
    pub fn svg(&self) -> String {
        let names = self.groups.iter().enumerate();
        let legend: Vec<LegendEntry<'_>> = names
            .map(|(number, of)| LegendEntry { name: &of.0, style: SeriesStyle::from_number(number), joined: false })
            .collect();
        let mut out = Drawing::new(&self.title, &legend);
        let bins = self.edges.len().saturating_sub(1);
        let count = |group: &(String, Vec<usize>), bin: usize| group.1.get(bin).copied().unwrap_or(0);
        let total = |bin| self.groups.iter().map(|group| count(group, bin)).sum::<usize>() as f64;
        let x = AxisScale::new(&self.x, self.edges.iter().copied(), [LEFT, WIDTH - RIGHT]);
        let y = AxisScale::new(&ChartAxis::default(), (0..bins).map(total), [HEIGHT - BOTTOM, out.top]);
        let (Some(x), Some(mut y)) = (x, y) else { return out.empty() };
        // Bars stand on 0.
        y.low = 0.0;
        out.axes(&x, &y, &self.x.label, "Gaussians");
        for bin in 0..bins {
            let (low, high) = (self.edges[bin], self.edges[bin + 1]);
            let (Some(left), Some(right)) = (x.at(low), x.at(high)) else { continue };
            let mut below = 0;
            for (number, group) in self.groups.iter().enumerate() {
                let here = count(group, bin);
                let (Some(bottom), Some(top)) = (y.at(below as f64), y.at((below + here) as f64)) else { continue };
                below += here;
                if here > 0 {
                    out.push(&format!(
                        "<rect class=\"area {}\" x=\"{left:.1}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{:.1}\">\
                         <title>{}: {here} from {} to {}</title></rect>",
                        SeriesStyle::from_number(number),
                        (right - left - 0.6).max(0.4),
                        bottom - top,
                        escape(&group.0),
                        figure(low),
                        figure(high),
                    ));
                }
            }
        }
        out.finish()
    }
}

/// Style of a series, which selects CSS classes of `chart.css`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct SeriesStyle {
    /// Index of the style (color, shape, dash) in `chart.css`; less than [`STYLE_COUNT`].
    number: usize,
    hollow: bool,
}

impl SeriesStyle {
    /// Returns the style with the index `number` modulo [`STYLE_COUNT`], with solid lines and filled marks.
    fn from_number(number: usize) -> SeriesStyle {
        SeriesStyle { number: number % STYLE_COUNT, hollow: false }
    }
}

impl fmt::Display for SeriesStyle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "s{}{}", self.number, if self.hollow { " hollow" } else { "" })
    }
}

/// Entry of a legend: a name and the style of its mark.
struct LegendEntry<'a> {
    name: &'a str,
    style: SeriesStyle,
    joined: bool,
}

/// Chart that is being written, as an SVG element.
struct Drawing {
    text: String,
    /// Top of the plot area, below the legend, in SVG units (about pixels).
    top: f64,
    /// Left end, baseline and width of each label placed so far, in SVG units (about pixels).
    labels: Vec<(f64, f64, f64)>,
}

impl Drawing {
    fn new(title: &str, legend: &[LegendEntry<'_>]) -> Drawing {
        let title = escape(title);
        let mut out = Drawing {
            text: format!("<svg class=\"chart\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{title}\">"),
            top: 10.0,
            labels: Vec::new(),
        };
        let (mut x, mut y) = (LEFT, 17.0);
        for LegendEntry { name, style, joined } in legend.iter().filter(|entry| !entry.name.is_empty()) {
            // Width of the mark, or of a piece of the line with the mark.
            let sample = if *joined { 26.0 } else { 12.0 };
            let wide = name.chars().count() as f64 * LETTER + sample + 22.0;
            if x + wide > WIDTH && x > LEFT {
                (x, y) = (LEFT, y + LINE);
            }
            if *joined {
                out.push(&format!("<path class=\"line {style}\" d=\"M{x:.1} {:.1}h{sample}\"/>", y - 4.0));
            }
            out.mark(*style, x + 0.5 * sample, y - 4.0, name);
            out.push(&format!("<text x=\"{:.1}\" y=\"{y:.1}\">{}</text>", x + sample + 4.0, escape(name)));
            x += wide;
            out.top = y + 12.0;
        }
        out
    }

    fn push(&mut self, element: &str) {
        self.text.push_str(element);
    }

    /// Draws a point at (`x`, `y`) in the shape of the style `style`, with the tooltip `tip`.
    fn mark(&mut self, style: SeriesStyle, x: f64, y: f64, tip: &str) {
        let shape = match style.number % 4 {
            0 => format!("<circle class=\"mark {style}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.4\">"),
            1 => format!(
                "<rect class=\"mark {style}\" x=\"{:.1}\" y=\"{:.1}\" width=\"6.4\" height=\"6.4\">",
                x - 3.2,
                y - 3.2
            ),
            2 => format!("<path class=\"mark {style}\" d=\"M{x:.1} {:.1}l4.2 7.4h-8.4z\">", y - 4.6),
            _ => format!("<path class=\"mark {style}\" d=\"M{x:.1} {:.1}l4.6 4.6l-4.6 4.6l-4.6 -4.6z\">", y - 4.6),
        };
        let close = match style.number % 4 {
            0 => "</circle>",
            1 => "</rect>",
            _ => "</path>",
        };
        let _ = write!(self.text, "{shape}<title>{}</title>{close}", escape(tip));
    }

    /// Writes the label `words` beside the point (`x`, `y`), inside the plot and without overlap with another label.
    /// Omits the label if no position allows this.
    fn label(&mut self, x: f64, y: f64, words: &str) {
        let wide = words.chars().count() as f64 * LETTER;
        // Left end and baseline of the label. Positions above the point come first, because curves of error against
        // time fall.
        let places = [(x + 6.0, y - 4.0), (x - 6.0 - wide, y - 4.0), (x - 6.0 - wide, y + 14.0), (x + 6.0, y + 14.0)];
        let is_free = |&(left, foot): &(f64, f64)| {
            let inside = left > LEFT && left + wide < WIDTH && foot >= self.top + 2.0 && foot < HEIGHT - BOTTOM;
            let apart = |&(other, at, width): &(f64, f64, f64)| {
                left + wide < other || other + width < left || (foot - at).abs() >= LINE
            };
            inside && self.labels.iter().all(apart)
        };
        if words.is_empty() {
            return;
        }
        if let Some((left, foot)) = places.into_iter().find(is_free) {
            self.labels.push((left, foot, wide));
            self.push(&format!("<text x=\"{left:.1}\" y=\"{foot:.1}\">{}</text>", escape(words)));
        }
    }

    fn axes(&mut self, x: &AxisScale, y: &AxisScale, x_label: &str, y_label: &str) {
        let bottom = HEIGHT - BOTTOM;
        for tick in y.ticks() {
            let Some(at) = y.at(tick) else { continue };
            let _ = write!(
                self.text,
                "<path class=\"grid\" d=\"M{LEFT} {at:.1}H{:.1}\"/><text class=\"end\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                WIDTH - RIGHT,
                LEFT - 7.0,
                at + 4.0,
                figure(tick)
            );
        }
        let middle = 0.5 * (bottom + self.top);
        let _ = write!(
            self.text,
            "<text class=\"middle\" transform=\"translate(17 {middle:.1}) rotate(-90)\">{}</text>",
            escape(y_label)
        );
        for tick in x.ticks() {
            let Some(at) = x.at(tick) else { continue };
            let _ = write!(
                self.text,
                "<path class=\"grid\" d=\"M{at:.1} {:.1}V{bottom:.1}\"/>\
                 <text class=\"middle\" x=\"{at:.1}\" y=\"{:.1}\">{}</text>",
                self.top,
                bottom + 21.0,
                figure(tick)
            );
        }
        let _ = write!(
            self.text,
            "<path class=\"axis\" d=\"M{:.1} {bottom:.1}H{:.1}\"/><text class=\"middle\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
            x.start,
            x.end,
            0.5 * (x.start + x.end),
            bottom + 39.0,
            escape(x_label)
        );
    }

    fn empty(mut self) -> String {
        let middle = 0.5 * HEIGHT;
        self.push(&format!("<text class=\"middle\" x=\"{}\" y=\"{middle}\">nothing to show</text>", 0.5 * WIDTH));
        self.finish()
    }

    fn finish(mut self) -> String {
        self.push("</svg>");
        self.text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: &[(f64, f64)]) -> Plot {
        let series = Series { name: "<b>".into(), points: points.to_vec(), joined: true, ..Series::default() };
        Plot { title: "t".into(), series: vec![series], ..Plot::default() }
    }

    #[test]
    fn charts_omit_non_finite_values_and_say_if_none_remain() {
        let svg = plot(&[(0.0, 1.0), (1.0, f64::NAN), (2.0, f64::INFINITY), (3.0, 2.0)]).svg();
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert_eq!(svg.matches("<circle").count(), 1 + 2, "the legend's and one per point");
        assert!(plot(&[(f64::NAN, 1.0)]).svg().contains("nothing to show"));
        assert!(StackedHistogram::default().svg().contains("nothing to show"));
    }

    #[test]
    fn series_names_are_escaped() {
        assert!(!plot(&[(0.0, 1.0)]).svg().contains("<b>"));
    }

    #[test]
    fn a_pair_has_one_color_and_labels_stay_with_their_points() {
        let series = |paired: bool| Series {
            name: "a".into(),
            points: vec![(1.0, 1.0), (f64::NAN, 2.0), (3.0, 3.0)],
            joined: true,
            paired,
            labels: ["first", "lost", "last"].map(String::from).to_vec(),
        };
        let plot = Plot { series: [false, true, false, true].map(series).to_vec(), ..Plot::default() };
        let styles: Vec<String> = plot.styles().iter().map(SeriesStyle::to_string).collect();
        assert_eq!(styles, ["s0", "s0 hollow", "s1", "s1 hollow"]);
        let svg = plot.svg();
        let times = |label: &str| svg.matches(&format!(">{label}</text>")).count();
        // In the corner below there is room for one, around the point above for all.
        assert_eq!(["first", "lost", "last"].map(times), [1, 0, 4], "{svg}");
        // A pair needs a first.
        let alone = Plot { series: vec![series(true)], ..Plot::default() };
        assert_eq!(alone.styles(), [SeriesStyle::from_number(0)]);
    }

    #[test]
    fn ticks_are_round_and_inside() {
        for (low, high) in [(0.0, 1.0), (-3.0, 17.0), (48.2, 48.9), (1e-7, 3e-7), (0.0, 5e9)] {
            let scale = AxisScale { log: false, low, high, start: 0.0, end: 100.0 };
            let ticks = scale.ticks();
            assert!((2..=12).contains(&ticks.len()), "{low} to {high}: {ticks:?}");
            assert!(ticks.iter().all(|&tick| tick >= low - 1e-9 * high && tick <= high * (1.0 + 1e-9)));
        }
        let narrow = AxisScale { log: true, low: 62f64.log10(), high: 82f64.log10(), start: 0.0, end: 100.0 };
        assert_eq!(narrow.ticks(), [65.0, 70.0, 75.0, 80.0]);
        let log = AxisScale { log: true, low: -7.0, high: 2.0, start: 0.0, end: 100.0 };
        assert!((3..=8).contains(&log.ticks().len()), "{:?}", log.ticks());
    }

    #[test]
    fn higher_values_lie_higher_and_bins_stand_on_one_another() {
        let scale = AxisScale::new(&ChartAxis::default(), [1.0, 4.0].into_iter(), [200.0, 0.0]).unwrap();
        assert!(scale.at(4.0) < scale.at(1.0));
        let groups = vec![("kept".to_owned(), vec![3, 0]), ("dropped".to_owned(), vec![1, 2])];
        let svg = StackedHistogram { edges: vec![0.0, 1.0, 2.0], groups, ..StackedHistogram::default() }.svg();
        assert_eq!(svg.matches("class=\"area").count(), 3, "an empty bin has no bar");
    }
}
