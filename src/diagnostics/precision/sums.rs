//! Measurement of the rounding errors of the sums that the scan (pass over all frames for the statistics) accumulates:
//! in f32, in f32 with compensation, and in f64 as the program uses it.
//!
//! The frames of some Gaussians are played forward and backward again and again, for up to 100,000 frames, because
//! rounding errors grow with the number of terms. The expected sums are computed in f64 with compensation.

use std::collections::BTreeMap;

use num_traits::Float;

use super::Bench;
use crate::error::Result;
use crate::evaluation::precision::{InaccuracySource, PrecisionCurve, PrecisionKnob, PrecisionSetting, relative_l2};
use crate::model::{AnomalyFlags, Attributes, Gaussians, ViewSchedule, opacity};
use crate::passes::FrameReaders;
use crate::recipe::{self, MotionParams, Recipe};
use crate::source::{BlockReader, Ids, ReadPlan};
use crate::statistics::{BlockScan, NEEDED_ATTRIBUTES, ScanPlan};

/// Number of Gaussians whose sums are computed, spaced evenly over all Gaussians.
const GAUSSIANS: usize = 64;
/// Maximum number of different frames of the scene that are played, spaced evenly over all its frames.
const MOST_FRAMES: usize = 240;
/// Numbers of frames for which sums are computed. For each of them, a sequence plays the frames of the scene forward
/// and backward again and again until it has this number of frames.
const PLAYED: [usize; 4] = [100, 1000, 10_000, 100_000];

/// Description, in the results, of the reference with which sums are compared.
const AGAINST: &str = "f64, compensated";

/// Running sum of numbers of type `T`, which are added one after the other. A compensated sum (Kahan) also holds the
/// rounding error that the rounded sum contains, and subtracts it from the next value.
struct RunningSum<T> {
    sum: T,
    /// Rounding error of `sum`; 0 if the sum is not compensated.
    error: T,
    is_compensated: bool,
}

impl<T: Float> RunningSum<T> {
    fn new(is_compensated: bool) -> Self {
        RunningSum { sum: T::zero(), error: T::zero(), is_compensated }
    }

    fn add(&mut self, value: T) {
        let value = value - self.error;
        let sum = self.sum + value;
        if self.is_compensated {
            self.error = (sum - self.sum) - value;
        }
        self.sum = sum;
    }

    fn total(&self) -> f64 {
        to_f64(self.sum) - to_f64(self.error)
    }
}

fn to_f64<T: Float>(value: T) -> f64 {
    value.to_f64().unwrap_or(f64::NAN)
}

fn from_f64<T: Float>(value: f64) -> T {
    T::from(value).unwrap_or(T::nan())
}

/// Trajectory magnitude D, curvature κ and opacity variance V, in this order, each as a list of one value per Gaussian.
type SummedStatistics = [Vec<f64>; 3];

impl Bench<'_> {
    /// Measures the rounding errors of sums in each kind of arithmetic, for sequences of the lengths [`PLAYED`].
    /// Returns `None` if the scene has fewer than three frames.
    pub(super) fn sums(&self) -> Result<Option<PrecisionKnob>> {
        let source = self.scene.source();
        let info = source.info();
        let frames = info.times.len();
        if frames < 3 {
            return Ok(None);
        }
        let every = frames.div_ceil(MOST_FRAMES);
        let finite = |id: &u32| !self.scanned.rows.flags[*id as usize].contains(AnomalyFlags::NON_FINITE);
        let ids: Vec<u32> = (0..info.count as u32).filter(finite).collect();
        let count = ids.len().min(GAUSSIANS);
        let ids: Vec<u32> = (0..count).map(|k| ids[k * ids.len() / count]).collect();
        let shown: Vec<usize> = (0..frames).step_by(every).collect();
        let columns = Attributes::POSITION | Attributes::OPACITY;
        let mut reader =
            FrameReaders::open(source, Ids::List(&ids), NEEDED_ATTRIBUTES, &ReadPlan::new(shown.iter().copied()))?;
        let mut states = Vec::with_capacity(shown.len());
        for frame in shown {
            let mut state = Gaussians::zeros(0, 0);
            reader.read(frame, NEEDED_ATTRIBUTES, &mut state)?;
            states.push(state);
        }
        let decoded: Vec<Decoded> = states.iter().map(Decoded::from_state).collect();
        let mut curves = Vec::new();
        let expected = PLAYED.map(|frames_played| sum_statistics::<f64>(&decoded, frames_played, true));
        for (name, is_compensated) in [("f32", false), ("f32, compensated", true)] {
            let sums = |frames_played| Ok(sum_statistics::<f32>(&decoded, frames_played, is_compensated));
            let marks = self.measure_lengths(&expected, sums)?;
            curves.push(PrecisionCurve::new(name, AGAINST, marks, None, &[]));
        }
        let marks =
            self.measure_lengths(&expected, |frames_played| scan_statistics(&states, frames_played, columns))?;
        curves.push(PrecisionCurve::new("f64, as in the scan", AGAINST, marks, None, &[]));
        Ok(Some(PrecisionKnob {
            name: "sums".to_owned(),
            about: format!(
                "Running sums over frames: D, κ and V of {count} Gaussians whose frames are played forward and \
                 backward. Marks are numbers of frames."
            ),
            source: InaccuracySource::Rounding,
            curves,
        }))
    }

    /// Computes statistics by calling `sums` with each length in [`PLAYED`] (number of frames). Returns, for each
    /// length, the errors of these statistics and the cost (time and memory) of computing them. `expected`: the correct
    /// statistics for each length.
    fn measure_lengths(
        &self,
        expected: &[SummedStatistics],
        sums: impl Fn(usize) -> Result<SummedStatistics>,
    ) -> Result<Vec<PrecisionSetting>> {
        let mark = |(frames_played, expected): (usize, &SummedStatistics)| {
            let (found, cost) = self.repeats.measure_cost(|| sums(frames_played), || Ok(()))?;
            let errors = ["D", "kappa", "V"].into_iter().zip(found.iter().zip(expected));
            let errors: BTreeMap<String, f64> = errors
                .map(|(name, (found, expected))| {
                    (name.to_owned(), relative_l2(found.iter().copied(), expected.iter().copied()))
                })
                .collect();
            self.advance();
            Ok(PrecisionSetting { value: frames_played as f64, step: frames_played as f64, cost, errors, psnr: None })
        };
        PLAYED.into_iter().zip(expected).map(mark).collect()
    }
}

/// Returns the index of the frame at position `k`, from 0, of a sequence that plays `count` frames forward and backward
/// again and again. With three frames, the sequence is 0, 1, 2, 1, 0, 1, 2 …. `count` must be at least 2.
fn ping_pong_index(k: usize, count: usize) -> usize {
    let turn = 2 * (count - 1);
    let at = k % turn;
    at.min(turn - at)
}

/// Positions and opacities of all Gaussians at one frame, from which [`sum_statistics`] computes.
struct Decoded {
    position: Vec<[f32; 3]>,
    opacity: Vec<f64>,
}

impl Decoded {
    fn from_state(state: &Gaussians) -> Decoded {
        Decoded {
            position: (0..state.len()).map(|row| state.position.row(row)).collect(),
            opacity: state.opacity_logit.plane(0).iter().map(|&logit| opacity(logit)).collect(),
        }
    }
}

/// Computes trajectory magnitude D, curvature κ and opacity variance V of every Gaussian over a sequence of
/// `frames_played` frames, which plays `states` forward and backward. Gaussians count as alive in all frames. Numbers
/// have the type `T`. `is_compensated`: whether their sums are compensated.
fn sum_statistics<T: Float>(states: &[Decoded], frames_played: usize, is_compensated: bool) -> SummedStatistics {
    let count = states.first().map_or(0, |state| state.opacity.len());
    let length2 = |v: [T; 3]| v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    let difference = |a: [T; 3], b: [T; 3]| -> [T; 3] { std::array::from_fn(|axis| a[axis] - b[axis]) };
    let statistics_of_one = |i: usize| -> [f64; 3] {
        let at = |k: usize| &states[ping_pong_index(k, states.len())];
        let position = |k: usize| at(k).position[i].map(|x| from_f64::<T>(f64::from(x)));
        let first: T = from_f64(at(0).opacity[i]);
        let [mut steps, mut turns, mut shifted, mut squares] = [(); 4].map(|()| RunningSum::<T>::new(is_compensated));
        let mut before: Option<[T; 3]> = None;
        for k in 0..frames_played {
            let opacity = from_f64::<T>(at(k).opacity[i]) - first;
            shifted.add(opacity);
            squares.add(opacity * opacity);
            if k > 0 {
                let step = difference(position(k), position(k - 1));
                steps.add(length2(step));
                if let Some(before) = before {
                    turns.add(length2(difference(step, before)).sqrt());
                }
                before = Some(step);
            }
        }
        let divisor = |terms: usize| terms.max(1) as f64;
        [
            (steps.total() / divisor(frames_played - 1)).sqrt(),
            turns.total() / divisor(frames_played - 2),
            squares.total() / divisor(frames_played) - (shifted.total() / divisor(frames_played)).powi(2),
        ]
    };
    let found: Vec<[f64; 3]> = (0..count).map(statistics_of_one).collect();
    std::array::from_fn(|statistic| found.iter().map(|values| values[statistic]).collect())
}

/// Computes the same statistics as [`sum_statistics`] by the code that `compress` uses ([`BlockScan`]). `changed`:
/// attributes that change from frame to frame; the code may take all other attributes from the frame before.
fn scan_statistics(states: &[Gaussians], frames_played: usize, changed: Attributes) -> Result<SummedStatistics> {
    let times: Vec<f64> = (0..frames_played).map(|k| k as f64).collect();
    let mut schedule = ViewSchedule::default();
    schedule.push_frames(frames_played, &[]);
    let scan = recipe::ScanParams { alpha_min: 0.0, motion: MotionParams::Runs, ..Recipe::preset("default")?.scan };
    let plan = ScanPlan::new(&scan, &times, &schedule)?;
    let mut block = BlockScan::new(states.first().map_or(0, Gaussians::len), 0, &plan);
    for k in 0..frames_played {
        block.add_frame(k, &states[ping_pong_index(k, states.len())], &[], changed);
    }
    let rows = block.finish().rows;
    Ok([rows.d, rows.kappa, rows.v])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_play_forward_and_backward() {
        assert_eq!((0..9).map(|k| ping_pong_index(k, 4)).collect::<Vec<_>>(), [0, 1, 2, 3, 2, 1, 0, 1, 2]);
    }

    #[test]
    fn sums_of_a_steady_walk_equal_the_formula() {
        // The Gaussian moves by a quarter per frame, forward and backward between 0 and 1, so each reversal changes the
        // step by one half. Its opacity equals its position.
        let at = |k: u32| Decoded { position: vec![[0.25 * k as f32, 0.0, 0.0]], opacity: vec![0.25 * f64::from(k)] };
        let states: Vec<Decoded> = (0..5).map(at).collect();
        // One direction takes 4 frames, so 17 frames are two round trips, with reversals at frames 4, 8 and 12.
        let d = 0.25;
        let kappa = 3.0 * 0.5 / 15.0;
        let levels: Vec<f64> = (0..17).map(|k| 0.25 * ping_pong_index(k, 5) as f64).collect();
        let mean = levels.iter().sum::<f64>() / 17.0;
        let v = levels.iter().map(|a| (a - mean).powi(2)).sum::<f64>() / 17.0;
        let variants = [
            sum_statistics::<f32>(&states, 17, false),
            sum_statistics::<f32>(&states, 17, true),
            sum_statistics::<f64>(&states, 17, true),
        ];
        for (variant, found) in variants.into_iter().enumerate() {
            let [found_d, found_kappa, found_v] = found.map(|values| values[0]);
            for (found, expected) in [(found_d, d), (found_kappa, kappa), (found_v, v)] {
                assert!((found - expected).abs() < 1e-6 * expected, "variant {variant}: {found}, expected {expected}");
            }
        }
    }

    #[test]
    fn compensated_sums_keep_what_plain_ones_lose() {
        let [mut plain, mut compensated] = [false, true].map(RunningSum::<f32>::new);
        for _ in 0..1_000_000 {
            plain.add(0.1);
            compensated.add(0.1);
        }
        let expected = 1e6 * f64::from(0.1f32);
        assert!((plain.total() / expected - 1.0).abs() > 1e-3);
        assert!((compensated.total() / expected - 1.0).abs() < 1e-7);
    }
}
