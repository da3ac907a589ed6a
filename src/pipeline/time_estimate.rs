//! Forecast of a run before it begins: expected time with its range, and memory.

use std::fmt::Write as _;

use crate::journal::records::{EstimateRange, Forecast, StageForecast};
use crate::memory_plan::{ResourceEstimate, Verbosity, Workload, format_bytes};
use crate::progress::{counted, format_duration};

/// Lowest and highest ratio of measured to estimated core-seconds of runs after a calibration, found on three trained
/// models at several sizes (`scripts/estimate.py`) and slightly widened.
const ERROR_RANGE: [f64; 2] = [0.5, 1.6];
/// Lowest and highest ratio of measured to estimated core-seconds of runs without a calibration.
const ERROR_RANGE_UNCALIBRATED: [f64; 2] = [0.25, 4.0];
/// Lowest and highest ratio of measured to estimated core-seconds of runs whose amount of work depends on intermediate
/// results. An example is a search for a requested quality: how many models it refines is not known in advance.
const ERROR_RANGE_SEARCH: [f64; 2] = [0.15, 2.5];
/// Minimum fraction of the processors that the stages of a run keep busy on average. It is below 1 because some work is
/// not divided among threads.
const MIN_UTILIZATION: f64 = 0.6;
/// Time that every run takes to start, to open its input and to write its output, seconds.
const FIXED_SECONDS: f64 = 0.5;

impl Forecast {
    /// Returns the forecast (expected time and memory) of a run. `work`: sizes of its input and views. `needs`:
    /// resource estimates of its stages. `least`: estimated core-seconds without the stages that may turn out to be
    /// unnecessary; the expected time is the geometric mean of the times with and without them. `searches`: whether the amount of work depends on intermediate results. `memory_bytes`: maximum
    /// memory.
    pub(super) fn new(
        work: &Workload,
        needs: &[ResourceEstimate],
        least: f64,
        searches: bool,
        memory_bytes: u64,
    ) -> Forecast {
        // Stages that may turn out to be unnecessary take either their whole time or none. The geometric mean differs
        // from both times by the same factor.
        let all_stages = core_seconds(needs);
        let likely = (least * all_stages).sqrt();
        let measured = work.throughput.processors;
        let error_range = match (searches, measured) {
            (true, _) => ERROR_RANGE_SEARCH,
            (_, Some(_)) => ERROR_RANGE,
            (_, None) => ERROR_RANGE_UNCALIBRATED,
        };
        let core =
            EstimateRange { least: error_range[0] * least, likely, most: error_range[1] * all_stages + FIXED_SECONDS };
        let threads = work.threads as f64;
        let processors = measured.unwrap_or(threads).min(threads);
        let usual = (0.9 * processors).max(1f64.min(processors));
        let fewest = (MIN_UTILIZATION * processors).max(1f64.min(processors));
        Forecast {
            seconds: EstimateRange {
                least: core.least / threads,
                likely: core.likely / usual,
                most: core.most / fewest,
            },
            core_seconds: core,
            threads: work.threads,
            measured: measured.is_some(),
            memory_bytes,
            stages: needs
                .iter()
                .map(|need| StageForecast { name: need.stage.to_owned(), core_seconds: need.seconds })
                .collect(),
        }
    }

    /// Returns this forecast of a run as text for display: a line for the time and one for the memory; with
    /// [`Verbosity::Plan`] also the core-seconds of every stage.
    pub fn text(&self, tell: Verbosity) -> String {
        let Forecast { seconds, core_seconds: core, threads, stages, .. } = self;
        let threads = counted(*threads as usize, "thread");
        let mut out = String::new();
        // Writing to a String cannot fail.
        let _ = match seconds.most {
            ..2.0 => writeln!(out, "time: a second or two on {threads}"),
            _ => writeln!(
                out,
                "time: about {}, {} to {} on {threads}; {} to {} core-seconds",
                approximate_time(seconds.likely),
                approximate_time(seconds.least),
                approximate_time(seconds.most),
                two_digits(core.least),
                two_digits(core.most)
            ),
        };
        if tell == Verbosity::Plan {
            let named = stages.iter().map(|stage| format!("{} {:.1}", stage.name, stage.core_seconds));
            let _ = writeln!(out, "core-seconds: {}", named.collect::<Vec<_>>().join(" + "));
        }
        let _ = writeln!(out, "memory: at most {}", format_bytes(self.memory_bytes));
        out
    }
}

/// Returns the sum of the estimated core-seconds of the stages `needs`.
pub(super) fn core_seconds(needs: &[ResourceEstimate]) -> f64 {
    needs.iter().map(|need| need.seconds).sum()
}

/// Formats `value` with two significant digits; more would suggest a precision that a forecast does not have.
fn two_digits(value: f64) -> String {
    match value {
        ..0.95 => format!("{value:.1}"),
        ..100.0 => format!("{value:.0}"),
        _ => {
            let unit = 10f64.powf(value.log10().floor() - 1.0);
            format!("{:.0}", (value / unit).round() * unit)
        }
    }
}

/// Formats an approximate time in seconds with about two significant digits.
fn approximate_time(seconds: f64) -> String {
    match seconds {
        ..60.0 => format!("{} s", two_digits(seconds)),
        ..600.0 => format_duration((seconds / 10.0).round() * 10.0),
        _ => format_duration((seconds / 60.0).round() * 60.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::memory_plan::Throughput;
    use crate::pipeline::tests::work;

    fn need(seconds: f64) -> ResourceEstimate {
        ResourceEstimate { stage: "scan", reads: 0.0, seconds, per_gaussian: Vec::new(), fixed: Vec::new() }
    }

    #[test]
    fn range_contains_expected_value_and_widens_if_uncertain() {
        let unmeasured = work(1000);
        let measured = crate::memory_plan::Workload {
            throughput: Throughput { processors: Some(1.5), ..Throughput::UNKNOWN },
            ..unmeasured
        };
        let forecast = |work: &Workload, searches| Forecast::new(work, &[need(40.0)], 40.0, searches, 1 << 20);
        let all = [forecast(&measured, false), forecast(&unmeasured, false), forecast(&measured, true)];
        for Forecast { seconds, core_seconds, .. } in &all {
            for range in [seconds, core_seconds] {
                assert!(range.least < range.likely && range.likely < range.most, "{range:?}");
            }
        }
        let may_skip = Forecast::new(&measured, &[need(40.0)], 10.0, false, 1 << 20).core_seconds;
        assert_eq!((may_skip.likely, may_skip.most), (20.0, all[0].core_seconds.most));
        let width = |forecast: &Forecast| forecast.core_seconds.most / forecast.core_seconds.least;
        assert!(width(&all[0]) < width(&all[1]) && width(&all[0]) < width(&all[2]));
        let text = all[0].text(Verbosity::Plan);
        assert!(text.starts_with("time: about ") && text.contains(" core-seconds\n"), "{text}");
        assert!(text.contains("\ncore-seconds: scan 40.0\n") && text.ends_with("memory: at most 1.0 MiB\n"), "{text}");
        assert!(!all[0].text(Verbosity::Time).contains("scan"));
    }

    #[test]
    fn approximate_values_are_formatted_with_two_digits() {
        for (value, text) in [(0.44, "0.4"), (9.6, "10"), (47.4, "47"), (1234.0, "1200"), (99.7, "100")] {
            assert_eq!(two_digits(value), text);
        }
        assert_eq!([42.4, 127.0, 4000.0].map(approximate_time), ["42 s", "2 min 10 s", "1 h 07 min"]);
    }
}
