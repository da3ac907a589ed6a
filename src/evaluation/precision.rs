//! Result of the command `precision` as JSON, text and CSV. The command runs each stage with several values of one
//! parameter, and measures run time and errors at each value.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::evaluation::cost::{Cost, MedianAndRange};
use crate::files::csv::{optional_field, table};

/// Result of the command `precision`: errors, run time and memory of the program for several values of each parameter,
/// and the conditions (such as input and cameras) that are the same for all these measurements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecisionDiagram {
    /// Name and version of the program.
    pub tool: String,
    /// Name of the input: the last component of its path.
    pub path: String,
    /// Hash of the bytes of the input.
    pub digest: String,
    /// Number of Gaussians of the input.
    pub gaussians: usize,
    /// Number of frames of the input.
    pub frames: usize,
    /// Number of frames whose views are used to score and rank Gaussians. They are spread evenly from the first frame
    /// to the last.
    #[serde(rename = "frames_looked_at")]
    pub frames_scored: usize,
    /// Number of views that are used to score and rank Gaussians, over all [`PrecisionDiagram::frames_scored`] frames.
    pub views_scored: usize,
    /// Number of views on which settings are judged: in these views, renders of the Gaussians that a setting keeps are
    /// compared with renders of the whole model. They are test views, if there are any.
    pub judged: usize,
    /// File of the cameras, or description of the virtual rig (cameras that the program placed).
    pub cameras: String,
    /// Number of Gaussians that every setting keeps.
    pub kept: usize,
    /// Number of threads of all measurements except those that vary the number of threads.
    pub threads: usize,
    /// Maximum number of runs of each setting. There are fewer if the total time of its runs reaches
    /// [`PrecisionDiagram::max_setting_seconds`].
    pub runs: usize,
    /// Limit on the time spent on one setting, in seconds. Once all runs of a setting together take this time, it is
    /// not run again.
    #[serde(rename = "enough")]
    pub max_setting_seconds: f64,
    /// Results of the varied knobs (parameters, or groups of parameters).
    pub knobs: Vec<PrecisionKnob>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Cause of the errors that the command `precision` measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum InaccuracySource {
    /// Error of sampling, such as leaving out views or using a finite step size.
    Discretization,
    /// Error of rounding to a finite number of digits.
    Rounding,
    /// Error of the compressed model: it has fewer Gaussians than the original.
    Model,
}

impl InaccuracySource {
    /// Returns the name of this error source in tables and CSV files.
    pub fn name(self) -> &'static str {
        match self {
            InaccuracySource::Discretization => "discretization",
            InaccuracySource::Rounding => "rounding",
            InaccuracySource::Model => "model",
        }
    }
}

/// Results for one group of parameters (in the option `--knobs`: a knob) that trade run time for error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecisionKnob {
    /// Name of the group, as in the option `--knobs`.
    pub name: String,
    /// Description of the parameters and their errors, for the user.
    pub about: String,
    /// Source of the errors that these parameters change: sampling, rounding or the smaller model.
    pub source: InaccuracySource,
    /// Measurements of each parameter of the group.
    pub curves: Vec<PrecisionCurve>,
}

/// Measurements of one parameter at several values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecisionCurve {
    /// Name of the parameter; the name in the recipe if it is a recipe parameter.
    pub name: String,
    /// Description of the reference values from which the errors are measured.
    #[serde(rename = "against")]
    pub reference: String,
    /// Measurements at each value of the parameter, in the order in which they were made. For most parameters this is
    /// from coarse (fast, inaccurate) to fine (slow, accurate).
    #[serde(rename = "marks")]
    pub settings: Vec<PrecisionSetting>,
    /// Observed orders of the errors: the exponents with which the errors depend on the step size.
    pub orders: Vec<ObservedOrder>,
    /// Value that the recipe has for the parameter; `None` if this value was not measured.
    #[serde(rename = "own")]
    pub recipe_value: Option<f64>,
    /// Coarsest value of the parameter that is accurate enough; `None` if there is none. A value is accurate enough if,
    /// at this value and at all finer values, the error that it adds to renders is below a tenth of the error of the
    /// compressed model itself. The finest value does not count, because the errors are measured against it.
    #[serde(rename = "enough")]
    pub sufficient_value: Option<f64>,
}

/// Measurements with one setting, that is, at one value of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PrecisionSetting {
    /// Value of the varied parameter in this setting.
    pub value: f64,
    /// Step size h that belongs to this value: an error of order p is proportional to h^p. For sums over frames, h is
    /// the number of frames, because rounding errors grow with it.
    pub step: f64,
    /// Time and memory of the runs with this setting.
    pub cost: Cost,
    /// Errors of the results with this setting, by the name of the error; [`axis_label`] describes the names.
    pub errors: BTreeMap<String, f64>,
    /// Mean PSNR in dB, against renders of the whole model, on the views by which settings are judged; `None` if the
    /// setting yields no model.
    pub psnr: Option<f64>,
}

/// Observed order of one error: the exponent with which the error depends on the step size, from measurements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ObservedOrder {
    /// Name of the error, as in [`PrecisionSetting::errors`].
    #[serde(rename = "of")]
    pub error: String,
    /// Observed order: slope of log error against log step size, fitted by least squares.
    pub observed: f64,
    /// Order of convergence of this error that theory predicts; `None` if theory predicts none.
    pub expected: Option<f64>,
}

/// Name of the error: root mean square error of renders of the model that a setting yields, compared with renders of
/// the whole model; color values are in [0, 1].
pub const RENDER_ERROR: &str = "renders";
/// Name of the error that a setting adds to renders: √(e² − f²) / f (see [`added_error`]). Here e is the error
/// [`RENDER_ERROR`] of the setting. f is the error [`RENDER_ERROR`] of the finest setting, which counts as the error of
/// the compressed model itself.
pub const ADDED_ERROR: &str = "added";
/// Name of the error: Jaccard distance between the set of Gaussians that a setting keeps and the set that the finest
/// setting keeps.
pub const KEPT_SET_JACCARD_DISTANCE: &str = "kept";
/// Name of the error: relative error of the number of Gaussians that the thresholds of the recipe keep, compared with
/// the finest setting.
pub const KEPT_COUNT_ERROR: &str = "staying";
/// Name of the error: largest relative error of the percentiles P1 and P99 by which the terms of the scores are
/// normalized, compared with exact percentiles.
pub const PERCENTILE_ERROR: &str = "percentiles";
/// Name of the error: 1 if the result with a setting differs in any byte from the result with the first setting, else
/// 0.
pub const DIFFERENT_BYTES: &str = "bytes";

/// Limit below which the error [`ADDED_ERROR`] counts as small. The error is below this limit at
/// [`PrecisionCurve::sufficient_value`] and at all finer values of the parameter.
const SMALL_ADDED_ERROR: f64 = 0.1;

/// Returns the axis label of a diagram for the error with the name `error`.
pub fn axis_label(error: &str) -> String {
    match error {
        RENDER_ERROR => "root mean square error of renders".to_owned(),
        ADDED_ERROR => "error added / error of the model".to_owned(),
        KEPT_SET_JACCARD_DISTANCE => "1 - Jaccard of the kept set".to_owned(),
        KEPT_COUNT_ERROR => "relative error of how many stay".to_owned(),
        PERCENTILE_ERROR => "worst relative error of P1 and P99".to_owned(),
        DIFFERENT_BYTES => "results of other bytes".to_owned(),
        statistic => format!("relative L2 error of {statistic}"),
    }
}

impl PrecisionCurve {
    /// Creates the curve of the parameter `name` from its measurements `settings`, and computes the observed order of
    /// every error. Removes infinite errors, which JSON cannot represent.
    /// - `against`: description of the reference values of the errors.
    /// - `recipe_value`: value of the parameter in the recipe.
    /// - `expected`: pairs of the name of an error and its order of convergence that theory predicts.
    pub fn new(
        name: &str,
        against: &str,
        settings: Vec<PrecisionSetting>,
        recipe_value: Option<f64>,
        expected: &[(&str, f64)],
    ) -> PrecisionCurve {
        // JSON cannot represent infinity.
        let mut settings = settings;
        settings.iter_mut().for_each(|mark| mark.errors.retain(|_, error| error.is_finite()));
        let mut names: Vec<String> = settings.iter().flat_map(|mark| mark.errors.keys().cloned()).collect();
        names.sort_unstable();
        names.dedup();
        // The error of renders converges to the error of the model itself, not to 0, so it has no order.
        names.retain(|name| name != RENDER_ERROR);
        let order = |error: String| {
            let points = settings.iter().filter_map(|mark| Some((mark.step, *mark.errors.get(&error)?)));
            let expected = expected.iter().find(|(name, _)| *name == error).map(|&(_, order)| order);
            Some(ObservedOrder { observed: slope(points)?, expected, error })
        };
        let orders = names.into_iter().filter_map(order).collect();
        let is_small =
            |mark: &PrecisionSetting| mark.errors.get(ADDED_ERROR).is_some_and(|&added| added < SMALL_ADDED_ERROR);
        // The finest setting is measured against itself, so it does not count.
        let small = settings.iter().rev().take_while(|mark| is_small(mark)).skip(1).last();
        let recipe_value = recipe_value.filter(|recipe_value| settings.iter().any(|mark| mark.value == *recipe_value));
        PrecisionCurve {
            name: name.to_owned(),
            reference: against.to_owned(),
            sufficient_value: small.map(|mark| mark.value),
            settings,
            orders,
            recipe_value,
        }
    }
}

/// Returns the least-squares slope of log error against log step size. `points`: pairs (step, error); pairs with a step
/// or an error of 0 are ignored. Returns `None` if fewer than three pairs remain or all have the same step.
fn slope(points: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    let logs: Vec<(f64, f64)> = points
        .filter(|&(step, error)| step > 0.0 && error > 0.0)
        .map(|(step, error)| (step.ln(), error.ln()))
        .collect();
    let count = logs.len() as f64;
    let (x, y) = logs.iter().fold((0.0, 0.0), |(x, y), log| (x + log.0 / count, y + log.1 / count));
    let (covariance, variance) = logs.iter().fold((0.0, 0.0), |(covariance, variance), log| {
        (covariance + (log.0 - x) * (log.1 - y), variance + (log.0 - x).powi(2))
    });
    (logs.len() >= 3 && variance > 0.0).then(|| covariance / variance)
}

/// Returns the relative difference of the values `a` from the reference `b` in the L2 norm, ‖a − b‖ / ‖b‖. Returns ‖a‖
/// if `b` is all zero.
pub(crate) fn relative_l2(a: impl IntoIterator<Item = f64>, b: impl IntoIterator<Item = f64>) -> f64 {
    let (off, all) = a.into_iter().zip(b).fold((0.0, 0.0), |(off, all), (a, b)| (off + (a - b) * (a - b), all + b * b));
    f64::sqrt(if all > 0.0 { off / all } else { off })
}

/// Returns the Jaccard distance 1 − |a ∩ b| / |a ∪ b| of two lists of increasing ids; 0 for two empty lists.
pub(crate) fn jaccard_distance(a: &[u32], b: &[u32]) -> f64 {
    let both = a.iter().filter(|id| b.binary_search(id).is_ok()).count();
    let either = a.len() + b.len() - both;
    if either == 0 { 0.0 } else { 1.0 - both as f64 / either as f64 }
}

/// Returns the error that a setting adds to the error of the finest setting, relative to it: √(`error`² − `finest`²) /
/// `finest`, or 0 if `error` is below `finest`. Independent errors add in squares. `error`: whole error of the setting.
/// `finest`: error of the finest setting.
pub(crate) fn added_error(error: f64, finest: f64) -> f64 {
    ((error * error - finest * finest).max(0.0)).sqrt() / finest.max(f64::MIN_POSITIVE)
}

impl PrecisionDiagram {
    /// Returns the measurements as a CSV table with one row per error of every setting. A missing value is an empty
    /// field.
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
            for mark in &curve.settings {
                let Cost { runs, seconds, processor_seconds, peak_memory_bytes } = &mark.cost;
                let spread_columns = |spread: Option<&MedianAndRange>| {
                    [spread.map(|s| s.median), spread.map(|s| s.min), spread.map(|s| s.max)].map(optional_field)
                };
                rows.extend(mark.errors.iter().map(|(of, error)| {
                    let mut row = vec![knob.name.clone(), knob.source.name().to_owned(), curve.name.clone()];
                    row.extend([mark.value, mark.step, *error].map(|value| value.to_string()));
                    row.extend([of.clone(), optional_field(mark.psnr), runs.to_string()]);
                    row.extend(
                        spread_columns(Some(seconds)).into_iter().chain(spread_columns(processor_seconds.as_ref())),
                    );
                    row.push(optional_field(*peak_memory_bytes));
                    row
                }));
            }
        }
        table(&names, rows)
    }

    /// Returns every curve together with the knob that it belongs to.
    fn curves(&self) -> impl Iterator<Item = (&PrecisionKnob, &PrecisionCurve)> {
        self.knobs.iter().flat_map(|knob| knob.curves.iter().map(move |curve| (knob, curve)))
    }

    /// Returns the measurements as a table for the terminal. A star marks the value in the recipe.
    pub fn text(&self) -> String {
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "{}: {} Gaussians x {} frames; scoring on {} views of {} frames, judged on {} views; {} kept",
            self.path, self.gaussians, self.frames, self.views_scored, self.frames_scored, self.judged, self.kept
        );
        for (knob, curve) in self.curves() {
            let _ = writeln!(
                out,
                "{} ({} error): {}, against {}",
                knob.name,
                knob.source.name(),
                curve.name,
                curve.reference
            );
            for mark in &curve.settings {
                let errors: Vec<String> =
                    mark.errors.iter().map(|(name, error)| format!("{name} {error:.1e}")).collect();
                let psnr = mark.psnr.map_or(String::new(), |psnr| format!("{psnr:>7.2} dB"));
                let own = if curve.recipe_value == Some(mark.value) { "*" } else { " " };
                let seconds = mark.cost.seconds.median;
                let _ = writeln!(out, " {own}{:>12} {seconds:>9.3} s {psnr:>10}  {}", mark.value, errors.join(", "));
            }
            let orders = curve.orders.iter().map(|order| {
                let expected = order.expected.map_or(String::new(), |expected| format!(" ({expected} expected)"));
                format!("{} {:.2}{expected}", order.error, order.observed)
            });
            let orders: Vec<String> = orders.collect();
            if !orders.is_empty() {
                let _ = writeln!(out, "  order by the step: {}", orders.join(", "));
            }
            if let Some(enough) = curve.sufficient_value {
                let _ = writeln!(out, "  from {enough} on, adds less than a tenth of the model's own error to renders");
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
    use crate::files::text::json_text;

    fn mark(value: f64, step: f64, errors: &[(&str, f64)]) -> PrecisionSetting {
        let seconds = MedianAndRange::from_values(vec![value]);
        PrecisionSetting {
            value,
            step,
            cost: Cost { runs: 1, seconds, processor_seconds: None, peak_memory_bytes: Some(7) },
            errors: errors.iter().map(|&(of, error)| (of.to_owned(), error)).collect(),
            psnr: None,
        }
    }

    #[test]
    fn observed_order_is_the_exponent_and_ignores_zeros() {
        let marks = [8.0, 4.0, 2.0, 1.0].map(|h: f64| mark(1.0 / h, h, &[("C", 3.0 * h.powf(1.5)), ("W", 0.0)]));
        let curve = PrecisionCurve::new("strides", "all", marks.to_vec(), None, &[("C", 1.5)]);
        assert_eq!(curve.orders.len(), 1);
        assert!((curve.orders[0].observed - 1.5).abs() < 1e-12, "{:?}", curve.orders);
        assert_eq!(curve.orders[0].expected, Some(1.5));
    }

    #[test]
    fn enough_is_the_coarsest_value_with_small_finer_errors() {
        let curve = |added: &[f64]| {
            let marks =
                added.iter().zip(1..).map(|(&added, k)| mark(f64::from(k), 1.0, &[(ADDED_ERROR, added)])).collect();
            PrecisionCurve::new("views", "all", marks, Some(2.0), &[])
        };
        assert_eq!(curve(&[0.5, 0.05, 0.2, 0.09, 0.0]).sufficient_value, Some(4.0));
        assert_eq!(curve(&[0.5, 0.5]).sufficient_value, None);
        assert_eq!(
            (curve(&[0.0; 5]).sufficient_value, curve(&[0.0; 5]).recipe_value, curve(&[0.0]).recipe_value),
            (Some(1.0), Some(2.0), None)
        );
        assert_eq!(curve(&[0.5, 0.5, 0.0]).sufficient_value, None, "the finest setting is not counted");
    }

    #[test]
    fn distances_match_their_definitions() {
        assert_eq!(relative_l2([3.0, 0.0], [0.0, 4.0]), 1.25);
        assert_eq!(relative_l2([3.0, 4.0], [0.0, 0.0]), 5.0);
        assert_eq!(jaccard_distance(&[1, 2, 3], &[2, 3, 4, 5]), 1.0 - 2.0 / 5.0);
        assert_eq!((jaccard_distance(&[], &[]), jaccard_distance(&[1], &[1])), (0.0, 0.0));
        assert_eq!((added_error(0.5, 0.3), added_error(0.2, 0.3)), (0.4 / 0.3, 0.0));
    }

    #[test]
    fn csv_has_a_line_for_every_error_and_reads_back_from_json() {
        let curve = PrecisionCurve::new(
            "bits",
            "exact",
            vec![mark(2.0, 0.25, &[("C", 0.5), (KEPT_SET_JACCARD_DISTANCE, 0.0)])],
            None,
            &[],
        );
        let knob = PrecisionKnob {
            name: "percentiles".to_owned(),
            about: String::new(),
            source: InaccuracySource::Discretization,
            curves: vec![curve],
        };
        let found = PrecisionDiagram {
            tool: String::new(),
            path: "p".to_owned(),
            digest: String::new(),
            gaussians: 1,
            frames: 1,
            frames_scored: 1,
            views_scored: 1,
            judged: 1,
            cameras: String::new(),
            kept: 1,
            threads: 1,
            runs: 1,
            max_setting_seconds: 1.0,
            knobs: vec![knob],
            notes: Vec::new(),
        };
        let csv = found.csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines[1], "percentiles,discretization,bits,2,0.25,0.5,C,,1,2,2,2,,,,7");
        assert_eq!(lines.len(), 3);
        assert_eq!(serde_json::from_str::<PrecisionDiagram>(&json_text(&found)).unwrap(), found);
    }
}
