//! Measurement of the time and memory of a piece of work, by running the work several times.

use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::journal::Stopwatch;
use crate::machine::{peak_memory_bytes, reset_peak_memory};

/// Time and memory of repeated runs of the same work.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Number of runs that were measured.
    pub runs: usize,
    /// Wall-clock seconds of one run.
    pub seconds: MedianAndRange,
    /// CPU seconds of one run, summed over all threads; `None` if the system does not report them.
    pub processor_seconds: Option<MedianAndRange>,
    /// Maximum resident memory of the process in bytes over all runs, including memory that the work does not use;
    /// `None` if the system does not report it.
    pub peak_memory_bytes: Option<u64>,
}

/// Median and range of the values of repeated runs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MedianAndRange {
    /// Median of the measured values; the mean of the two middle values if their number is even.
    pub median: f64,
    /// Smallest of the measured values.
    #[serde(rename = "least")]
    pub min: f64,
    /// Largest of the measured values.
    #[serde(rename = "most")]
    pub max: f64,
}

impl MedianAndRange {
    /// Computes the median, smallest and largest of `values`.
    ///
    /// # Panics
    /// Panics if `values` is empty.
    pub fn from_values(mut values: Vec<f64>) -> MedianAndRange {
        values.sort_unstable_by(f64::total_cmp);
        let last = values.len() - 1;
        MedianAndRange {
            median: 0.5 * (values[last / 2] + values[values.len() / 2]),
            min: values[0],
            max: values[last],
        }
    }
}

/// Limits on how often a piece of work is repeated to measure it.
#[derive(Debug, Clone, Copy)]
pub struct RepeatLimits {
    /// Maximum number of runs; the work always runs at least once.
    pub most: usize,
    /// Limit on the total time of the runs, seconds. No further run starts after this time is reached.
    pub max_total_seconds: f64,
}

impl RepeatLimits {
    /// Returns limits that allow exactly `most` runs (at least one), without a time limit.
    pub fn exactly(most: usize) -> RepeatLimits {
        RepeatLimits { most, max_total_seconds: f64::INFINITY }
    }

    /// Runs `work` repeatedly within these limits and measures each run. Calls `clear` between two runs, for example to
    /// delete what a run wrote; the time of `clear` is not measured. Returns the value of the last run, and the cost
    /// (time and memory) of all runs.
    ///
    /// # Errors
    /// Fails if `work` or `clear` fails.
    pub fn measure_cost<T>(
        self,
        mut work: impl FnMut() -> Result<T>,
        mut clear: impl FnMut() -> Result<()>,
    ) -> Result<(T, Cost)> {
        let (mut seconds, mut processors, mut peak) = (Vec::new(), Vec::new(), None);
        loop {
            let is_peak_reset = reset_peak_memory();
            let clock = Stopwatch::start();
            let value = work()?;
            seconds.push(clock.seconds());
            processors.extend(clock.processor_seconds());
            // `None` is less than every `Some`.
            peak = peak.max(if is_peak_reset { peak_memory_bytes() } else { None });
            if seconds.len() >= self.most || seconds.iter().sum::<f64>() >= self.max_total_seconds {
                let runs = seconds.len();
                let processor_seconds = (processors.len() == runs).then(|| MedianAndRange::from_values(processors));
                let seconds = MedianAndRange::from_values(seconds);
                return Ok((value, Cost { runs, seconds, processor_seconds, peak_memory_bytes: peak }));
            }
            clear()?;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_is_median_smallest_and_largest() {
        for (values, expected) in
            [(vec![7.0], [7.0; 3]), (vec![9.0, 1.0], [5.0, 1.0, 9.0]), (vec![9.0, 1.0, 2.0], [2.0, 1.0, 9.0])]
        {
            let MedianAndRange { median, min, max } = MedianAndRange::from_values(values);
            assert_eq!([median, min, max], expected);
        }
    }

    #[test]
    fn work_repeats_until_run_or_time_limit() {
        for (repeats, expected) in [
            (RepeatLimits::exactly(3), 3),
            (RepeatLimits { most: 3, max_total_seconds: 0.0 }, 1),
            (RepeatLimits { most: 1, max_total_seconds: 1e9 }, 1),
            (RepeatLimits::exactly(0), 1),
        ] {
            let (mut runs, mut clears) = (0, 0);
            let count = |n: &mut usize| {
                *n += 1;
                Ok(*n)
            };
            let (last, cost) = repeats.measure_cost(|| count(&mut runs), || count(&mut clears).map(|_| ())).unwrap();
            assert_eq!((last, cost.runs, runs, clears), (expected, expected, expected, expected - 1));
            assert!(cost.seconds.min <= cost.seconds.median && cost.seconds.median <= cost.seconds.max);
        }
    }
}
