//! What a piece of work costs: time and memory of repeated runs of it alone.

use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::journal::Clock;
use crate::machine::{peak_memory_bytes, reset_peak_memory};

/// What some runs of the same work took.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// How many runs.
    pub runs: usize,
    /// Wall-clock seconds.
    pub seconds: Spread,
    /// Seconds of all processors together; none where the system does not tell.
    pub processor_seconds: Option<Spread>,
    /// Largest resident memory of any run, with all that this process holds beside it; none where the system does not
    /// tell.
    pub peak_memory_bytes: Option<u64>,
}

/// Values of repeated runs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// The middle one, or the mean of the two there.
    pub median: f64,
    /// Smallest.
    pub least: f64,
    /// Largest.
    pub most: f64,
}

impl Spread {
    /// Of at least one value.
    pub fn from_values(mut values: Vec<f64>) -> Spread {
        values.sort_unstable_by(f64::total_cmp);
        let last = values.len() - 1;
        Spread { median: 0.5 * (values[last / 2] + values[values.len() / 2]), least: values[0], most: values[last] }
    }
}

/// How often work is repeated.
#[derive(Debug, Clone, Copy)]
pub struct Repeats {
    /// At most so often, at least once.
    pub most: usize,
    /// Not again once all runs together took as many seconds.
    pub enough: f64,
}

impl Repeats {
    /// So often, whatever it takes.
    pub fn always(most: usize) -> Repeats {
        Repeats { most, enough: f64::INFINITY }
    }

    /// Runs `work` and gives what the last run gave, and what all cost. `clear` comes between two runs, at nobody's cost.
    ///
    /// # Errors
    /// Those of both.
    pub fn measure<T>(
        self,
        mut work: impl FnMut() -> Result<T>,
        mut clear: impl FnMut() -> Result<()>,
    ) -> Result<(T, Cost)> {
        let (mut seconds, mut processors, mut peak) = (Vec::new(), Vec::new(), None);
        loop {
            let resets = reset_peak_memory();
            let clock = Clock::start();
            let value = work()?;
            seconds.push(clock.seconds());
            processors.extend(clock.processor_seconds());
            // None is less than any.
            peak = peak.max(if resets { peak_memory_bytes() } else { None });
            if seconds.len() >= self.most || seconds.iter().sum::<f64>() >= self.enough {
                let runs = seconds.len();
                let processor_seconds = (processors.len() == runs).then(|| Spread::from_values(processors));
                let seconds = Spread::from_values(seconds);
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
    fn a_spread_is_the_middle_and_both_ends_of_any_number() {
        for (values, expected) in
            [(vec![7.0], [7.0; 3]), (vec![9.0, 1.0], [5.0, 1.0, 9.0]), (vec![9.0, 1.0, 2.0], [2.0, 1.0, 9.0])]
        {
            let Spread { median, least, most } = Spread::from_values(values);
            assert_eq!([median, least, most], expected);
        }
    }

    #[test]
    fn work_is_repeated_until_it_was_often_enough_or_took_long_enough() {
        for (repeats, expected) in [
            (Repeats::always(3), 3),
            (Repeats { most: 3, enough: 0.0 }, 1),
            (Repeats { most: 1, enough: 1e9 }, 1),
            (Repeats::always(0), 1),
        ] {
            let (mut runs, mut clears) = (0, 0);
            let count = |n: &mut usize| {
                *n += 1;
                Ok(*n)
            };
            let (last, cost) = repeats.measure(|| count(&mut runs), || count(&mut clears).map(|_| ())).unwrap();
            assert_eq!((last, cost.runs, runs, clears), (expected, expected, expected, expected - 1));
            assert!(cost.seconds.least <= cost.seconds.median && cost.seconds.median <= cost.seconds.most);
        }
    }
}
