//! Removes apparent motion that is only the rounding of positions to f32.
//!
//! The trajectory magnitude D states how far a Gaussian moves per frame, the curvature κ how much its motion turns or
//! accelerates. Rounding moves even a resting Gaussian: D ≈ 0.71 ulp and κ ≈ 1.2 ulp, where one ulp is the distance
//! between neighboring f32 values. All coordinates of a scene may contain one large common offset, so the ulp of the
//! largest coordinate is used for every Gaussian.

use crate::model::{AnomalyFlags, StatisticRows};

/// Trajectory magnitude D (how far a Gaussian moves per frame) below which the motion counts as rounding noise. In ulp
/// (distance between neighboring f32 values) of the scene's largest coordinate.
const D_NOISE_ULP: f64 = 2.0;
/// Curvature κ (how much the motion of a Gaussian turns or accelerates) below which it counts as rounding noise. In ulp
/// (distance between neighboring f32 values) of the scene's largest coordinate.
const KAPPA_NOISE_ULP: f64 = 4.0;

/// Numbers of Gaussians with motion statistics that were replaced by 0, because they were rounding noise of the
/// positions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SnapCounts {
    /// Number of Gaussians whose trajectory magnitude D (how far they move per frame) was rounding noise and was set to
    /// 0.
    pub d: usize,
    /// Number of Gaussians whose curvature κ (how much their motion turns or accelerates) was rounding noise and was
    /// set to 0.
    pub kappa: usize,
}

/// Returns the ulp of `x` (finite, not negative): the distance to the next larger f32. The result is f64, so that it
/// exists for [`f32::MAX`] too.
pub fn ulp(x: f32) -> f64 {
    let exponent = (x.to_bits() >> 23 & 0xff) as i32;
    2f64.powi(exponent.max(1) - 127 - 23)
}

/// Sets every trajectory magnitude D below 2 ulp and every curvature κ below 4 ulp to exactly 0, because such small
/// motion is rounding noise. One ulp is the distance between neighboring f32 values at `largest_coordinate`. Marks each
/// Gaussian whose D or κ changes with the flag `SNAPPED_D` or `SNAPPED_KAPPA`. Returns how many values of D and of κ
/// were set to 0.
///
/// `largest_coordinate` is the largest |coordinate| of the whole scene, at least 0. Values that are 0 already are
/// neither flagged nor counted.
pub fn snap_noise_to_zero(rows: &mut StatisticRows, largest_coordinate: f32) -> SnapCounts {
    let ulp = ulp(largest_coordinate);
    SnapCounts {
        d: snap_below(&mut rows.d, D_NOISE_ULP * ulp, &mut rows.flags, AnomalyFlags::SNAPPED_D),
        kappa: snap_below(&mut rows.kappa, KAPPA_NOISE_ULP * ulp, &mut rows.flags, AnomalyFlags::SNAPPED_KAPPA),
    }
}

fn snap_below(values: &mut [f64], floor: f64, flags: &mut [AnomalyFlags], flag: AnomalyFlags) -> usize {
    let mut snapped = 0;
    for (value, flags) in values.iter_mut().zip(flags) {
        if *value > 0.0 && *value < floor {
            *value = 0.0;
            *flags |= flag;
            snapped += 1;
        }
    }
    snapped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ulp_is_the_distance_to_the_next_f32() {
        for x in [0.0f32, 1e-45, 1e-39, f32::MIN_POSITIVE, 0.5, 1.0, 1.5, 1e7, 3.3e38] {
            assert_eq!(ulp(x), f64::from(x.next_up()) - f64::from(x), "{x:e}");
        }
        assert_eq!(ulp(f32::MAX), f64::from(f32::MAX) - f64::from(f32::MAX.next_down()));
    }

    #[test]
    fn only_values_between_zero_and_the_floor_are_snapped() {
        let floor = 2.0 * ulp(1e6);
        let mut rows = StatisticRows {
            d: vec![0.0, floor * 0.99, floor],
            kappa: vec![floor, 2.0 * floor, 0.0],
            flags: vec![AnomalyFlags::empty(); 3],
            ..StatisticRows::default()
        };
        assert_eq!(snap_noise_to_zero(&mut rows, 1e6), SnapCounts { d: 1, kappa: 1 });
        assert_eq!((rows.d, rows.kappa), (vec![0.0, 0.0, floor], vec![0.0, 2.0 * floor, 0.0]));
        assert_eq!(rows.flags, [AnomalyFlags::SNAPPED_KAPPA, AnomalyFlags::SNAPPED_D, AnomalyFlags::empty()]);
    }
}
