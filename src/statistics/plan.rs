//! Parameters of a scan (the pass that computes statistics) that are fixed before its first frame.

use serde::Serialize;

use crate::error::{Error, Result};
use crate::model::{Camera, ViewSchedule};
use crate::recipe::{MotionParams, ScanParams};

/// Frames count as evenly spaced if every time step differs from the mean step by at most this fraction of the mean
/// step. Time stamps i/T stored as f32 are off by 6e-3 of a step at T = 1e5 frames; real gaps are far larger.
const EVEN_TOLERANCE: f64 = 1e-2;

/// Shortest accepted time step, as a fraction of the mean step. The curvature κ is a difference of positions divided by
/// two steps; its square must not overflow.
const MIN_STEP: f64 = 1e-50;

/// Number of bits, in fixed point, of the largest contribution (covered pixels times opacity) that a Gaussian can have
/// in one view. [`super::projection`] rounds by adding 2⁵², so a contribution must stay below 2⁵²; one bit is kept in
/// reserve.
const CONTRIBUTION_BITS: i32 = 51;

/// Number of contributions (covered pixels times opacity in one view, in fixed point) that are added to a u64 sum
/// before its high bits must be moved to another counter: 2¹² contributions of at most 2⁵¹, with one bit in reserve.
pub(super) const PAIRS_PER_CARRY: usize = 1 << 12;

/// Parameters of the scan, the pass over all frames that computes the statistics of the Gaussians. The Gaussians are
/// scanned in blocks, and all blocks of a sequence use the same parameters.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScanPlan {
    pub(super) alpha_min: f64,
    pub(super) motion: MotionParams,
    /// For each frame t, the duration of the time step from frame t − 1 to frame t, divided by the mean duration. Empty
    /// if frames are evenly spaced or the recipe ignores time stamps ([`MotionParams::Literal`]).
    pub(super) steps: Vec<f64>,
    pub(super) frames: usize,
    #[serde(rename = "pairs")]
    pub(super) pair_count: u32,
    pub(super) coverage_exponent: i32,
}

impl ScanPlan {
    /// Creates the plan for frames at `times` (strictly increasing) seen by the cameras of `schedule`.
    ///
    /// Motion is measured per mean time step. With [`MotionParams::Runs`], a step that lasts h mean steps is divided by
    /// h; evenly spaced frames give exactly the formula without h. [`MotionParams::Literal`] ignores time stamps.
    ///
    /// # Errors
    /// Fails with [`Error::Usage`] if time stamps do not increase, if two are so close that their distance vanishes
    /// beside the mean step, or if there are more than 2³² (frame, view) pairs. Fails with an internal error if
    /// `schedule` has another number of frames.
    pub fn new(scan: &ScanParams, times: &[f64], schedule: &ViewSchedule) -> Result<Self> {
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
        let pairs = u32::try_from(schedule.pair_count())
            .map_err(|_| Error::usage(format!("{} (frame, view) pairs: 2^32 is the limit", schedule.pair_count())))?;
        let steps = if scan.motion == MotionParams::Runs { uneven_steps(times) } else { Vec::new() };
        if let Some(t) = steps.iter().position(|step| step.is_nan() || *step < MIN_STEP) {
            return Err(Error::usage(format!(
                "two time stamps are too close together: frame {} has {:e}, frame {t} has {:e}, and the sequence spans \
                 {:e}",
                t - 1,
                times[t - 1],
                times[t],
                times[times.len() - 1] - times[0]
            )));
        }
        Ok(ScanPlan {
            steps,
            frames: times.len(),
            pair_count: pairs,
            ..ScanPlan::for_arriving_frames(scan, &schedule.cameras)
        })
    }

    /// Creates the plan (parameters) with which the scan of a stream begins. The frames have not arrived then, so their
    /// number and time stamps are unknown; the plan assumes evenly spaced frames. `cameras` lists all cameras that may
    /// see the frames.
    ///
    /// After the last frame, [`ScanPlan::new`] creates a second plan, for the complete sequence, with which the scan is
    /// finished. This is possible only if the frames are in fact evenly spaced; [`ScanPlan::fits_scan_begun_with`]
    /// returns whether it is.
    pub fn for_arriving_frames(scan: &ScanParams, cameras: &[Camera]) -> Self {
        let image_px = cameras.iter().map(|c| f64::from(c.width) * f64::from(c.height)).fold(1.0, f64::max);
        ScanPlan {
            alpha_min: scan.alpha_min,
            motion: scan.motion,
            steps: Vec::new(),
            frames: 0,
            pair_count: 0,
            coverage_exponent: coverage_exponent(image_px),
        }
    }

    /// Returns whether a scan that began with the plan `arriving`, made before the frames arrived, can end with this
    /// plan, which was made for all frames. The two plans may differ only in the numbers of frames and of (frame, view)
    /// pairs.
    pub fn fits_scan_begun_with(&self, arriving: &ScanPlan) -> bool {
        *arriving == ScanPlan { frames: arriving.frames, pair_count: arriving.pair_count, ..self.clone() }
    }

    /// Returns T, the number of frames.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Returns M, the number of (frame, view) pairs.
    pub fn pair_count(&self) -> u32 {
        self.pair_count
    }

    /// Returns the fixed-point unit of contributions in pixels. Every contribution C (covered pixels times opacity) to
    /// a view is rounded to a multiple of this unit, so the sum over views is the same in any order.
    pub fn coverage_resolution_px(&self) -> f64 {
        2f64.powi(-self.coverage_exponent)
    }

    /// Returns the duration of the time step into frame `t`, divided by the mean duration.
    pub(super) fn step(&self, t: usize) -> f64 {
        self.steps.get(t).copied().unwrap_or(1.0)
    }
}

/// Returns the durations of the steps between the frames at `times`, divided by their mean. Entry t is the step into
/// frame t; entry 0 is unused. Returns an empty list if the frames are evenly spaced: every step differs from the mean
/// by at most 1% of it.
fn uneven_steps(times: &[f64]) -> Vec<f64> {
    let [first, .., last] = times else { return Vec::new() };
    let mean = (last - first) / (times.len() - 1) as f64;
    let steps = || std::iter::once(1.0).chain(times.windows(2).map(|pair| (pair[1] - pair[0]) / mean));
    if steps().all(|step| (step - 1.0).abs() <= EVEN_TOLERANCE) { Vec::new() } else { steps().collect() }
}

/// Returns the exponent e of the fixed-point format of contributions: a contribution of x pixels is stored as the
/// integer nearest to x · 2ᵉ. e is the largest exponent for which the largest contribution, `image_px` pixels (the
/// whole image), fits in [`CONTRIBUTION_BITS`] bits.
///
/// e does not depend on the number of contributions, which is unknown for a stream. Their sums cannot overflow
/// nevertheless: after every [`PAIRS_PER_CARRY`] contributions, the high bits of a sum are moved to a second counter.
fn coverage_exponent(image_px: f64) -> i32 {
    CONTRIBUTION_BITS - image_px.log2().ceil() as i32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;

    fn plan(times: &[f64]) -> Result<ScanPlan> {
        let mut schedule = ViewSchedule::default();
        schedule.push_frames(times.len(), &[]);
        ScanPlan::new(&Recipe::preset("default").unwrap().scan, times, &schedule)
    }

    #[test]
    fn steps_off_by_more_than_one_percent_are_kept() {
        assert!(plan(&[0.0, 1.0, 2.01]).unwrap().steps.is_empty());
        for second in [1.03, 1.2] {
            assert_eq!(plan(&[0.0, 1.0, 1.0 + second]).unwrap().steps.len(), 3, "a second step of {second}");
        }
    }

    #[test]
    fn time_stamps_rounded_to_f32_count_as_even() {
        let times: Vec<f64> = (0..100_000).map(|i| f64::from(i as f32 / 1e5)).collect();
        assert!(plan(&times).unwrap().steps.is_empty());
        assert_eq!(plan(&[0.0, 1.0, 3.0]).unwrap().steps, [1.0, 2.0 / 3.0, 4.0 / 3.0]);
    }

    #[test]
    fn time_stamps_too_close_together_are_named() {
        for bad in [[0.0, 1.0, 1e300], [-1e300, 1.0, 2.0], [-1.7e308, 1.7e308, 1.75e308]] {
            let message = plan(&bad).unwrap_err().to_string();
            assert!(message.contains("too close together: frame"), "{message}");
        }
        assert!(plan(&[0.0, 1.0, 1e40]).is_ok());
    }

    #[test]
    fn time_stamps_that_do_not_increase_are_named() {
        for bad in [[0.0, 1.0, 1.0], [0.0, 1.0, 0.5], [0.0, 1.0, f64::NAN]] {
            let message = plan(&bad).unwrap_err().to_string();
            assert!(message.contains("frame 1") && message.contains("frame 2"), "{message}");
        }
    }

    #[test]
    fn coverage_never_wraps_between_carries() {
        for image_px in [1.0, 82_944.0, 8192.0 * 8192.0, 1.8e19] {
            let contribution = image_px * 2f64.powi(coverage_exponent(image_px));
            assert!(contribution <= 2f64.powi(CONTRIBUTION_BITS));
            assert!(contribution * PAIRS_PER_CARRY as f64 <= 2f64.powi(63));
        }
    }

    #[test]
    fn only_even_frames_finish_a_scan_begun_early() {
        let scan = Recipe::preset("default").unwrap().scan;
        let arriving = ScanPlan::for_arriving_frames(&scan, &[]);
        assert!(plan(&[0.0, 1.0, 2.0]).unwrap().fits_scan_begun_with(&arriving));
        assert!(plan(&[]).unwrap().fits_scan_begun_with(&arriving));
        assert!(!plan(&[0.0, 1.0, 3.0]).unwrap().fits_scan_begun_with(&arriving));
        assert!(
            !plan(&[0.0])
                .unwrap()
                .fits_scan_begun_with(&ScanPlan::for_arriving_frames(&ScanParams { alpha_min: 0.5, ..scan }, &[]))
        );
    }
}
