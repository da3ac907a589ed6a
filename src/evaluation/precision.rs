//! What turning the knobs of a run showed, for people and for programs: what every setting costs, and what it leaves to be
//! desired.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::evaluation::cost::{Cost, Spread};
use crate::files::csv::{known, table};

/// Every knob that was turned on a model, and what all of it shares.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecisionDiagram {
    /// Program and version.
    pub tool: String,
    /// Input, as given.
    pub path: String,
    /// Hash over the input's bytes.
    pub digest: String,
    /// Gaussians of the input.
    pub gaussians: usize,
    /// Its frames.
    pub frames: usize,
    /// Frames, evenly from first to last, of which pictures are looked at and ranked by at most.
    pub frames_looked_at: usize,
    /// Pictures of these.
    pub pictures: usize,
    /// Pictures that rankings are judged by: held-out ones, where there are some.
    pub judged: usize,
    /// File of the cameras.
    pub cameras: String,
    /// Gaussians that every setting is compared at.
    pub kept: usize,
    /// Threads at work, but where threads are turned.
    pub threads: usize,
    /// Maximum number of runs of each setting; fewer where the runs so far took [`PrecisionDiagram::enough`] seconds in all.
    pub runs: usize,
    /// Total time of the runs of one setting after which it is not run again, seconds.
    pub enough: f64,
    /// What was turned.
    pub knobs: Vec<PrecisionKnob>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// Where an error comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Source {
    /// Something is looked at in samples or in steps.
    Discretization,
    /// Numbers have so many digits.
    Rounding,
    /// A smaller model stands for a larger one.
    Model,
}

impl Source {
    /// As text has it.
    pub fn name(self) -> &'static str {
        match self {
            Source::Discretization => "discretisation",
            Source::Rounding => "rounding",
            Source::Model => "model",
        }
    }
}

/// Something that can be had cheaper or finer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecisionKnob {
    /// As `--knobs` names it.
    pub name: String,
    /// What is turned, and what its errors are.
    pub about: String,
    /// What error turning it changes.
    pub source: Source,
    /// Ways to turn it.
    pub curves: Vec<PrecisionCurve>,
}

/// One way to turn a knob.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecisionCurve {
    /// What is turned; a recipe's parameter by its name.
    pub name: String,
    /// What errors are measured against.
    pub against: String,
    /// In the order in which they were tried: mostly from coarse to fine.
    pub marks: Vec<PrecisionSetting>,
    /// How errors go with the step.
    pub orders: Vec<ObservedOrder>,
    /// The recipe's own value, if it is among the marks.
    pub own: Option<f64>,
    /// The coarsest value from which on errors added to pictures stay below a tenth of the model's own.
    pub enough: Option<f64>,
}

/// One setting.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecisionSetting {
    /// Value of what is turned.
    pub value: f64,
    /// What errors go with as a power, of which the exponent is the order: a step h, or of sums the number of frames.
    pub step: f64,
    /// Time and memory.
    pub cost: Cost,
    /// By what they are of: see [`meaning`].
    pub errors: BTreeMap<String, f64>,
    /// Mean PSNR on the pictures judged by, dB, where a model came of it.
    pub psnr: Option<f64>,
}

/// An observed order: of convergence, or of sums of growth.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ObservedOrder {
    /// Of which error.
    pub of: String,
    /// Slope of log error by log step, by least squares.
    pub observed: f64,
    /// What theory predicts, where it does.
    pub expected: Option<f64>,
}

/// Root mean square error of the pictures judged by, colors from 0 to 1, against the whole model's own.
pub const PICTURES: &str = "pictures";
/// What a setting adds to [`PICTURES`] in squares, as a part of what the finest setting has: the model's own.
pub const ADDED: &str = "added";
/// See [`meaning`].
pub const KEPT: &str = "kept";
/// See [`meaning`].
pub const STAYING: &str = "staying";
/// See [`meaning`].
pub const PERCENTILES: &str = "percentiles";
/// See [`meaning`].
pub const BYTES: &str = "bytes";

/// A tenth: what [`PrecisionCurve::enough`] allows.
const SMALL: f64 = 0.1;

/// What an error is of, for an axis.
pub fn meaning(error: &str) -> String {
    match error {
        PICTURES => "root mean square error of pictures".to_owned(),
        ADDED => "error added / error of the model".to_owned(),
        KEPT => "1 - Jaccard of the kept set".to_owned(),
        STAYING => "relative error of how many stay".to_owned(),
        PERCENTILES => "worst relative error of P1 and P99".to_owned(),
        BYTES => "results of other bytes".to_owned(),
        statistic => format!("relative L2 error of {statistic}"),
    }
}

impl PrecisionCurve {
    /// A curve of `marks`, with the orders of all errors, those in `expected` beside what theory says.
    pub fn new(
        name: &str,
        against: &str,
        marks: Vec<PrecisionSetting>,
        own: Option<f64>,
        expected: &[(&str, f64)],
    ) -> PrecisionCurve {
        // JSON has no infinity.
        let mut marks = marks;
        marks.iter_mut().for_each(|mark| mark.errors.retain(|_, error| error.is_finite()));
        let mut names: Vec<String> = marks.iter().flat_map(|mark| mark.errors.keys().cloned()).collect();
        names.sort_unstable();
        names.dedup();
        // What pictures lose goes to what the model loses, not to nothing.
        names.retain(|name| name != PICTURES);
        let order = |of: String| {
            let points = marks.iter().filter_map(|mark| Some((mark.step, *mark.errors.get(&of)?)));
            let expected = expected.iter().find(|(name, _)| *name == of).map(|&(_, order)| order);
            Some(ObservedOrder { observed: slope(points)?, expected, of })
        };
        let orders = names.into_iter().filter_map(order).collect();
        let is_small = |mark: &PrecisionSetting| mark.errors.get(ADDED).is_some_and(|&added| added < SMALL);
        // The finest is measured against itself.
        let small = marks.iter().rev().take_while(|mark| is_small(mark)).skip(1).last();
        let own = own.filter(|own| marks.iter().any(|mark| mark.value == *own));
        PrecisionCurve {
            name: name.to_owned(),
            against: against.to_owned(),
            enough: small.map(|mark| mark.value),
            marks,
            orders,
            own,
        }
    }
}

/// Slope of log error by log step, of the points whose errors are not 0; none of less than three steps.
fn slope(points: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    let logs: Vec<(f64, f64)> = points
        .filter(|&(step, error)| step > 0.0 && error > 0.0)
        .map(|(step, error)| (step.ln(), error.ln()))
        .collect();
    let count = logs.len() as f64;
    let (x, y) = logs.iter().fold((0.0, 0.0), |(x, y), log| (x + log.0 / count, y + log.1 / count));
    let (up, along) =
        logs.iter().fold((0.0, 0.0), |(up, along), log| (up + (log.0 - x) * (log.1 - y), along + (log.0 - x).powi(2)));
    (logs.len() >= 3 && along > 0.0).then(|| up / along)
}

/// ‖a − b‖ / ‖b‖ over all values; where `b` is 0 throughout, ‖a‖.
pub(crate) fn relative_l2(a: impl IntoIterator<Item = f64>, b: impl IntoIterator<Item = f64>) -> f64 {
    let (off, all) = a.into_iter().zip(b).fold((0.0, 0.0), |(off, all), (a, b)| (off + (a - b) * (a - b), all + b * b));
    f64::sqrt(if all > 0.0 { off / all } else { off })
}

/// 1 − |a ∩ b| / |a ∪ b| of increasing ids; 0 of two empty sets.
pub(crate) fn apart(a: &[u32], b: &[u32]) -> f64 {
    let both = a.iter().filter(|id| b.binary_search(id).is_ok()).count();
    let either = a.len() + b.len() - both;
    if either == 0 { 0.0 } else { 1.0 - both as f64 / either as f64 }
}

/// What error a setting adds to pictures whose error is `finest` at best: errors that know nothing of one another add up
/// in squares. A part of `finest`; 0 where pictures came out closer.
pub(crate) fn added(error: f64, finest: f64) -> f64 {
    ((error * error - finest * finest).max(0.0)).sqrt() / finest.max(f64::MIN_POSITIVE)
}

impl PrecisionDiagram {
    /// As JSON, for programs.
    pub fn json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self).expect("plain data");
        text.push('\n');
        text
    }

    /// A line for every error of every setting, under a line of names; a value that does not exist is empty.
    pub fn csv(&self) -> String {
        let names = [
            "knob",
            "source",
            "curve",
            "value",
            "step",
            "error",
            "of",
            "psnr",
            "runs",
            "seconds",
            "seconds_least",
            "seconds_most",
            "processor_seconds",
            "processor_seconds_least",
            "processor_seconds_most",
            "peak_memory_bytes",
        ];
        let mut rows = Vec::new();
        for (knob, curve) in self.curves() {
            for mark in &curve.marks {
                let Cost { runs, seconds, processor_seconds, peak_memory_bytes } = &mark.cost;
                let spread = |of: Option<&Spread>| {
                    [of.map(|of| of.median), of.map(|of| of.least), of.map(|of| of.most)].map(known)
                };
                rows.extend(mark.errors.iter().map(|(of, error)| {
                    let mut row = vec![knob.name.clone(), knob.source.name().to_owned(), curve.name.clone()];
                    row.extend([mark.value, mark.step, *error].map(|value| value.to_string()));
                    row.extend([of.clone(), known(mark.psnr), runs.to_string()]);
                    row.extend(spread(Some(seconds)).into_iter().chain(spread(processor_seconds.as_ref())));
                    row.push(known(*peak_memory_bytes));
                    row
                }));
            }
        }
        table(&names, rows)
    }

    fn curves(&self) -> impl Iterator<Item = (&PrecisionKnob, &PrecisionCurve)> {
        self.knobs.iter().flat_map(|knob| knob.curves.iter().map(move |curve| (knob, curve)))
    }

    /// A table for a person.
    pub fn text(&self) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "{}: {} Gaussians x {} frames; {} pictures of {} frames looked at, {} judged by; {} kept",
            self.path, self.gaussians, self.frames, self.pictures, self.frames_looked_at, self.judged, self.kept
        );
        for (knob, curve) in self.curves() {
            let _ = writeln!(
                out,
                "{} ({} error): {}, against {}",
                knob.name,
                knob.source.name(),
                curve.name,
                curve.against
            );
            for mark in &curve.marks {
                let errors: Vec<String> = mark.errors.iter().map(|(of, error)| format!("{of} {error:.1e}")).collect();
                let psnr = mark.psnr.map_or(String::new(), |psnr| format!("{psnr:>7.2} dB"));
                let own = if curve.own == Some(mark.value) { "*" } else { " " };
                let seconds = mark.cost.seconds.median;
                let _ = writeln!(out, " {own}{:>12} {seconds:>9.3} s {psnr:>10}  {}", mark.value, errors.join(", "));
            }
            let orders = curve.orders.iter().map(|order| {
                let expected = order.expected.map_or(String::new(), |expected| format!(" ({expected} expected)"));
                format!("{} {:.2}{expected}", order.of, order.observed)
            });
            let orders: Vec<String> = orders.collect();
            if !orders.is_empty() {
                let _ = writeln!(out, "  order by the step: {}", orders.join(", "));
            }
            if let Some(enough) = curve.enough {
                let _ = writeln!(out, "  adds less than a tenth of the model's own error to pictures from {enough} on");
            }
        }
        for note in &self.notes {
            let _ = writeln!(out, "note: {note}");
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mark(value: f64, step: f64, errors: &[(&str, f64)]) -> PrecisionSetting {
        let seconds = Spread::from_values(vec![value]);
        PrecisionSetting {
            value,
            step,
            cost: Cost { runs: 1, seconds, processor_seconds: None, peak_memory_bytes: Some(7) },
            errors: errors.iter().map(|&(of, error)| (of.to_owned(), error)).collect(),
            psnr: None,
        }
    }

    #[test]
    fn the_order_of_a_power_is_its_exponent_and_zeros_tell_nothing() {
        let marks = [8.0, 4.0, 2.0, 1.0].map(|h: f64| mark(1.0 / h, h, &[("C", 3.0 * h.powf(1.5)), ("W", 0.0)]));
        let curve = PrecisionCurve::new("strides", "all", marks.to_vec(), None, &[("C", 1.5)]);
        assert_eq!(curve.orders.len(), 1);
        assert!((curve.orders[0].observed - 1.5).abs() < 1e-12, "{:?}", curve.orders);
        assert_eq!(curve.orders[0].expected, Some(1.5));
    }

    #[test]
    fn enough_is_the_coarsest_value_from_which_on_all_are_small() {
        let of = |added: &[f64]| {
            let marks = added.iter().zip(1..).map(|(&added, k)| mark(f64::from(k), 1.0, &[(ADDED, added)])).collect();
            PrecisionCurve::new("pictures", "all", marks, Some(2.0), &[])
        };
        assert_eq!(of(&[0.5, 0.05, 0.2, 0.09, 0.0]).enough, Some(4.0));
        assert_eq!(of(&[0.5, 0.5]).enough, None);
        assert_eq!((of(&[0.0; 5]).enough, of(&[0.0; 5]).own, of(&[0.0]).own), (Some(1.0), Some(2.0), None));
        assert_eq!(of(&[0.5, 0.5, 0.0]).enough, None, "the finest tells nothing");
    }

    #[test]
    fn distances_are_those_of_their_definitions() {
        assert_eq!(relative_l2([3.0, 0.0], [0.0, 4.0]), 1.25);
        assert_eq!(relative_l2([3.0, 4.0], [0.0, 0.0]), 5.0);
        assert_eq!(apart(&[1, 2, 3], &[2, 3, 4, 5]), 1.0 - 2.0 / 5.0);
        assert_eq!((apart(&[], &[]), apart(&[1], &[1])), (0.0, 0.0));
        assert_eq!((added(0.5, 0.3), added(0.2, 0.3)), (0.4 / 0.3, 0.0));
    }

    #[test]
    fn csv_has_a_line_for_every_error_and_reads_back_from_json() {
        let curve = PrecisionCurve::new("bits", "exact", vec![mark(2.0, 0.25, &[("C", 0.5), (KEPT, 0.0)])], None, &[]);
        let knob = PrecisionKnob {
            name: "percentiles".to_owned(),
            about: String::new(),
            source: Source::Discretization,
            curves: vec![curve],
        };
        let found = PrecisionDiagram {
            tool: String::new(),
            path: "p".to_owned(),
            digest: String::new(),
            gaussians: 1,
            frames: 1,
            frames_looked_at: 1,
            pictures: 1,
            judged: 1,
            cameras: String::new(),
            kept: 1,
            threads: 1,
            runs: 1,
            enough: 1.0,
            knobs: vec![knob],
            notes: Vec::new(),
        };
        let csv = found.csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines[1], "percentiles,discretisation,bits,2,0.25,0.5,C,,1,2,2,2,,,,7");
        assert_eq!(lines.len(), 3);
        assert_eq!(serde_json::from_str::<PrecisionDiagram>(&found.json()).unwrap(), found);
    }
}
