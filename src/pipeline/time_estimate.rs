//! Forecast of a run before it begins: expected time with its range, and memory.

use std::fmt::Write as _;

use crate::journal::records::{EstimateRange, Forecast, StageForecast};
use crate::memory_plan::{ResourceEstimate, Verbosity, Workload, format_bytes};
use crate::progress::{counted, format_duration};

/// Lowest and highest ratio of actual to estimated time. The range covers machines of different speed, and runs whose
/// amount of work depends on intermediate results: a search for a quality repeats stages, and refinement is skipped if
/// renders are close enough without it.
const ERROR_RANGE: [f64; 2] = [0.15, 4.0];
/// Fraction of the processors that the stages of a run keep busy on average. It is below 1 because some work is not
/// divided among threads.
const UTILIZATION: f64 = 0.9;
/// Time that every run takes at most to start, to open its input and to write its output, seconds.
const FIXED_SECONDS: f64 = 0.5;

impl Forecast {
    /// Returns the forecast (expected time and memory) of a run. `work`: sizes of its input and views. `needs`:
    /// resource estimates of its stages. `memory_bytes`: maximum memory.
    pub(super) fn new(work: &Workload, needs: &[ResourceEstimate], memory_bytes: u64) -> Forecast {
        let core_seconds: f64 = needs.iter().map(|need| need.seconds).sum();
        let range = |likely: f64| EstimateRange {
            least: ERROR_RANGE[0] * likely,
            likely,
            most: ERROR_RANGE[1] * likely + FIXED_SECONDS,
        };
        Forecast {
            seconds: range(core_seconds / (UTILIZATION * work.threads as f64).max(1.0)),
            core_seconds: range(core_seconds),
            threads: work.threads,
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
    use crate::pipeline::tests::work;

    fn need(seconds: f64) -> ResourceEstimate {
        ResourceEstimate { stage: "scan", reads: 0.0, seconds, per_gaussian: Vec::new(), fixed: Vec::new() }
    }

    #[test]
    fn range_contains_the_expected_value_and_text_names_stages_on_request() {
        let forecast = Forecast::new(&work(1000), &[need(40.0)], 1 << 20);
        for range in [forecast.seconds, forecast.core_seconds] {
            assert!(range.least < range.likely && range.likely < range.most, "{range:?}");
        }
        assert_eq!(forecast.core_seconds.likely, 40.0);
        let text = forecast.text(Verbosity::Plan);
        assert!(text.starts_with("time: about ") && text.contains(" core-seconds\n"), "{text}");
        assert!(text.contains("\ncore-seconds: scan 40.0\n") && text.ends_with("memory: at most 1.0 MiB\n"), "{text}");
        assert!(!forecast.text(Verbosity::Time).contains("scan"));
    }

    #[test]
    fn approximate_values_are_formatted_with_two_digits() {
        for (value, text) in [(0.44, "0.4"), (9.6, "10"), (47.4, "47"), (1234.0, "1200"), (99.7, "100")] {
            assert_eq!(two_digits(value), text);
        }
        assert_eq!([42.4, 127.0, 4000.0].map(approximate_time), ["42 s", "2 min 10 s", "1 h 07 min"]);
    }
}
