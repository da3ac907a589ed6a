//! What a scan must know before its first frame.

use serde::Serialize;

use crate::error::{Error, Result};
use crate::model::{Camera, Schedule};
use crate::recipe::{MotionParams, ScanParams};

/// Deviation of a time step from the mean step, as a fraction of it, up to which frames count as
/// even. Stamps i/T stored as f32 are off by 6e-3 of a step at T = 1e5; real gaps are far larger.
const EVEN_TOLERANCE: f64 = 1e-2;

/// Shortest time step, as a fraction of the mean step: κ divides differences of positions by two steps, and squares
/// what it finds.
const LEAST_STEP: f64 = 1e-50;

/// Largest contribution of one (frame, view) pair in fixed point: [`super::projection`] rounds by
/// adding 2⁵², so a contribution must stay below it; one bit is kept in reserve.
const CONTRIBUTION_BITS: i32 = 51;

/// Contributions that fit a u64 sum before it must be carried: 2¹² of 2⁵¹, with one bit in reserve.
pub(super) const PAIRS_PER_CARRY: usize = 1 << 12;

/// Everything the scan of any block needs: one plan serves all blocks of a sequence.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScanPlan {
    pub(super) alpha_min: f64,
    pub(super) motion: MotionParams,
    /// Step into frame t in units of the mean step; empty when frames are even.
    pub(super) steps: Vec<f64>,
    pub(super) frames: usize,
    pub(super) pairs: u32,
    pub(super) coverage_exponent: i32,
}

impl ScanPlan {
    /// The scan of frames at `times` (strictly increasing) seen by the cameras of `schedule`.
    ///
    /// Motion is measured per mean step: under [`MotionParams::Runs`] a step that lasts h mean steps is
    /// divided by h, so that even frames give the plain formula exactly. [`MotionParams::Literal`] knows
    /// no time stamps.
    ///
    /// # Errors
    /// [`Error::Usage`] for time stamps that do not increase, or of which two are nothing apart beside the others; for a
    /// schedule of another number of frames, or more than 2³² (frame, view) pairs.
    pub fn new(scan: &ScanParams, times: &[f64], schedule: &Schedule) -> Result<Self> {
        if let Some(t) =
            (1..times.len()).find(|&t| times[t - 1].partial_cmp(&times[t]) != Some(std::cmp::Ordering::Less))
        {
            return Err(Error::usage(format!(
                "time stamps must increase: frame {} has {}, frame {t} has {}",
                t - 1,
                times[t - 1],
                times[t]
            )));
        }
        if schedule.frames() != times.len() {
            return Err(Error::internal(format!(
                "the cameras are scheduled for {} frames, the sequence has {}",
                schedule.frames(),
                times.len()
            )));
        }
        let pairs = u32::try_from(schedule.pairs())
            .map_err(|_| Error::usage(format!("{} (frame, view) pairs: 2^32 is the limit", schedule.pairs())))?;
        let steps = if scan.motion == MotionParams::Runs { uneven_steps(times) } else { Vec::new() };
        if let Some(t) = steps.iter().position(|step| step.is_nan() || *step < LEAST_STEP) {
            return Err(Error::usage(format!(
                "time stamps must not be nothing apart beside the others: frame {} has {:e}, frame {t} has {:e}, and all \
                 span {:e}",
                t - 1,
                times[t - 1],
                times[t],
                times[times.len() - 1] - times[0]
            )));
        }
        Ok(ScanPlan { steps, frames: times.len(), pairs, ..ScanPlan::arriving(scan, &schedule.cameras) })
    }

    /// The scan of frames that are still to come, as it is if they prove to be even: then the plan that knows
    /// them all can finish what this one began.
    pub fn arriving(scan: &ScanParams, cameras: &[Camera]) -> Self {
        let image_px = cameras.iter().map(|c| f64::from(c.width) * f64::from(c.height)).fold(1.0, f64::max);
        ScanPlan {
            alpha_min: scan.alpha_min,
            motion: scan.motion,
            steps: Vec::new(),
            frames: 0,
            pairs: 0,
            coverage_exponent: coverage_exponent(image_px),
        }
    }

    /// Whether this plan, which knows all frames, can finish a scan begun with `arriving`.
    pub fn finishes(&self, arriving: &ScanPlan) -> bool {
        *arriving == ScanPlan { frames: arriving.frames, pairs: arriving.pairs, ..self.clone() }
    }

    /// T, the number of frames.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// M, the number of (frame, view) pairs.
    pub fn pairs(&self) -> u32 {
        self.pairs
    }

    /// Resolution of C in pixels: contributions are summed as multiples of it, so that their sum is
    /// the same in any order.
    pub fn coverage_resolution_px(&self) -> f64 {
        2f64.powi(-self.coverage_exponent)
    }

    /// Duration of the step into frame `t` in mean steps.
    pub(super) fn step(&self, t: usize) -> f64 {
        self.steps.get(t).copied().unwrap_or(1.0)
    }
}

/// Steps in units of their mean (entry 0 unused), or nothing when all are one.
fn uneven_steps(times: &[f64]) -> Vec<f64> {
    let [first, .., last] = times else { return Vec::new() };
    let mean = (last - first) / (times.len() - 1) as f64;
    let steps = || std::iter::once(1.0).chain(times.windows(2).map(|pair| (pair[1] - pair[0]) / mean));
    if steps().all(|step| (step - 1.0).abs() <= EVEN_TOLERANCE) { Vec::new() } else { steps().collect() }
}

/// Largest e for which one contribution of `image_px`, times 2ᵉ, fits. It must not depend on the number of
/// pairs, which a stream does not know ahead: sums are carried instead.
fn coverage_exponent(image_px: f64) -> i32 {
    CONTRIBUTION_BITS - image_px.log2().ceil() as i32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;

    fn plan(times: &[f64]) -> Result<ScanPlan> {
        let mut schedule = Schedule::default();
        schedule.push(times.len(), &[]);
        ScanPlan::new(&Recipe::preset("default").unwrap().scan, times, &schedule)
    }

    #[test]
    fn steps_that_differ_by_more_than_a_hundredth_count_as_they_are() {
        assert!(plan(&[0.0, 1.0, 2.01]).unwrap().steps.is_empty());
        for second in [1.03, 1.2] {
            assert_eq!(plan(&[0.0, 1.0, 1.0 + second]).unwrap().steps.len(), 3, "a second step of {second}");
        }
    }

    #[test]
    fn stamps_rounded_to_f32_count_as_even() {
        let times: Vec<f64> = (0..100_000).map(|i| f64::from(i as f32 / 1e5)).collect();
        assert!(plan(&times).unwrap().steps.is_empty());
        assert_eq!(plan(&[0.0, 1.0, 3.0]).unwrap().steps, [1.0, 2.0 / 3.0, 4.0 / 3.0]);
    }

    #[test]
    fn stamps_that_are_nothing_apart_beside_the_others_are_named() {
        for bad in [[0.0, 1.0, 1e300], [-1e300, 1.0, 2.0], [-1.7e308, 1.7e308, 1.75e308]] {
            let message = plan(&bad).unwrap_err().to_string();
            assert!(message.contains("nothing apart beside the others: frame"), "{message}");
        }
        assert!(plan(&[0.0, 1.0, 1e40]).is_ok());
    }

    #[test]
    fn stamps_that_do_not_increase_are_named() {
        for bad in [[0.0, 1.0, 1.0], [0.0, 1.0, 0.5], [0.0, 1.0, f64::NAN]] {
            let message = plan(&bad).unwrap_err().to_string();
            assert!(message.contains("frame 1") && message.contains("frame 2"), "{message}");
        }
    }

    #[test]
    fn coverage_cannot_wrap_between_carries_whatever_the_pictures() {
        for image_px in [1.0, 82_944.0, 8192.0 * 8192.0, 1.8e19] {
            let contribution = image_px * 2f64.powi(coverage_exponent(image_px));
            assert!(contribution <= 2f64.powi(CONTRIBUTION_BITS));
            assert!(contribution * PAIRS_PER_CARRY as f64 <= 2f64.powi(63));
        }
    }

    #[test]
    fn only_even_frames_finish_what_began_before_they_were_known() {
        let scan = Recipe::preset("default").unwrap().scan;
        let arriving = ScanPlan::arriving(&scan, &[]);
        assert!(plan(&[0.0, 1.0, 2.0]).unwrap().finishes(&arriving));
        assert!(plan(&[]).unwrap().finishes(&arriving));
        assert!(!plan(&[0.0, 1.0, 3.0]).unwrap().finishes(&arriving));
        assert!(!plan(&[0.0]).unwrap().finishes(&ScanPlan::arriving(&ScanParams { alpha_min: 0.5, ..scan }, &[])));
    }
}
