//! Computes the anisotropy E of every Gaussian: how long its longest axis is compared with its other axes.
//!
//! E is computed from one set of scales per Gaussian: the canonical scales of the model. A model without canonical
//! Gaussians takes the scales of the reference frame instead, which is the frame in which most Gaussians are alive.

use crate::model::{AnomalyFlags, AttributeValues, StatisticRows};
use crate::recipe::Anisotropy;

/// Minimum scale in the logarithmic form of the anisotropy E, as a fraction of the scene extent. Smaller scales are
/// raised to it, because renders do not show how much flatter a disc is.
const SCALE_FLOOR: f64 = 1e-7;

/// Upper limit of ln(s_max / s_min), where s_max and s_min are the largest and the smallest scale of a Gaussian: e⁷⁰⁰ ≈
/// 1e304 is close to the largest f64.
const MAX_LOG_RATIO: f64 = 700.0;

/// Fills the anisotropy `rows.e` from `log_scale` (`[3, N]`, natural logs of the scales in scene units).
///
/// [`Anisotropy::Ratio`]: s_max / s_min (the paper, section 3.2.1). [`Anisotropy::Log`]: ln(s_max / s_mid), where both
/// scales are raised to at least 1e-7 of `extent` (scene units). A Gaussian whose scales are not finite gets the flag
/// [`AnomalyFlags::NON_FINITE`]. Every Gaussian with this flag gets the anisotropy 0.
///
/// # Panics
/// Panics if `rows` and `log_scale` differ in the number of Gaussians.
pub fn fill_anisotropy(rows: &mut StatisticRows, log_scale: &AttributeValues, kind: Anisotropy, extent: f64) {
    assert_eq!(rows.len(), log_scale.len(), "one row per Gaussian");
    let floor = (SCALE_FLOOR * extent).ln();
    rows.e = (0..rows.len())
        .map(|i| {
            let mut log: [f32; 3] = log_scale.row(i);
            if !log.iter().all(|x| x.is_finite()) {
                rows.flags[i] |= AnomalyFlags::NON_FINITE;
            }
            if rows.flags[i].contains(AnomalyFlags::NON_FINITE) {
                return 0.0;
            }
            log.sort_unstable_by(f32::total_cmp);
            let [min, mid, max] = log.map(f64::from);
            match kind {
                Anisotropy::Ratio => (max - min).min(MAX_LOG_RATIO).exp(),
                // In a scene of extent 0 the smallest log scale is −∞, so no scale is raised.
                Anisotropy::Log => max.max(floor) - mid.max(floor),
            }
        })
        .collect();
}

#[cfg(test)]
mod tests {
    use super::*;

    fn anisotropy_and_flags(log_scale: [f32; 3], kind: Anisotropy, extent: f64) -> (f64, AnomalyFlags) {
        let mut column = AttributeValues::zeros(3, 1);
        column.set_row(0, log_scale);
        let mut rows = StatisticRows { d: vec![0.0], flags: vec![AnomalyFlags::empty()], ..StatisticRows::default() };
        fill_anisotropy(&mut rows, &column, kind, extent);
        (rows.e[0], rows.flags[0])
    }

    #[test]
    fn ratio_and_log_ignore_the_axis_order() {
        for log in [[0.0, 1.0, 3.0], [3.0, 0.0, 1.0], [1.0, 3.0, 0.0]] {
            assert!((anisotropy_and_flags(log, Anisotropy::Ratio, 1.0).0 - 3f64.exp()).abs() < 1e-12);
            assert_eq!(anisotropy_and_flags(log, Anisotropy::Log, 1.0).0, 2.0);
        }
    }

    #[test]
    fn extreme_scales_give_a_finite_anisotropy() {
        let needle = [1e6f32.ln(), 1e-12f32.ln(), 1e-12f32.ln()];
        let (ratio, _) = anisotropy_and_flags(needle, Anisotropy::Ratio, 1.0);
        assert!((ratio / 1e18 - 1.0).abs() < 1e-5, "{ratio:e}");
        let (log, _) = anisotropy_and_flags(needle, Anisotropy::Log, 1.0);
        assert!((log - 1e13f64.ln()).abs() < 1e-5, "the middle scale is floored at 1e-7: {log}");
        assert!(anisotropy_and_flags([3e38, -3e38, 0.0], Anisotropy::Ratio, 1.0).0.is_finite());
        assert!(anisotropy_and_flags([0.0, -40.0, -80.0], Anisotropy::Log, 0.0).0.is_finite());
    }

    #[test]
    fn non_finite_scales_are_flagged_and_give_zero() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let (e, flags) = anisotropy_and_flags([0.0, bad, 1.0], Anisotropy::Ratio, 1.0);
            assert!(e == 0.0 && flags.contains(AnomalyFlags::NON_FINITE));
        }
    }
}
