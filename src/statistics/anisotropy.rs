//! Anisotropy E, from one set of scales: the canonical ones, or those of the reference frame.

use crate::model::{Column, Flags, Rows};
use crate::recipe::Anisotropy;

/// Scales below this fraction of the scene extent count as it in the logarithmic form: how flat a
/// pancake is beyond that, no picture shows.
const SCALE_FLOOR: f64 = 1e-7;

/// Largest logarithm of a ratio: e⁷⁰⁰ is the last power of ten or so that f64 holds.
const MAX_LOG_RATIO: f64 = 700.0;

/// Fills `rows.e` from `log_scale` (`[3, N]`, natural log of scene units).
///
/// [`Anisotropy::Ratio`]: s_max / s_min (the paper, section 3.2.1). [`Anisotropy::Log`]:
/// ln(s_max / s_mid), both floored at 1e-7 of `extent` (scene units). A row whose scales are not
/// finite is flagged; a flagged row gets 0.
///
/// # Panics
/// If the number of rows differs.
pub fn fill_anisotropy(rows: &mut Rows, log_scale: &Column, kind: Anisotropy, extent: f64) {
    assert_eq!(rows.len(), log_scale.len(), "one row per Gaussian");
    let floor = (SCALE_FLOOR * extent).ln();
    rows.e = (0..rows.len())
        .map(|i| {
            let mut log: [f32; 3] = log_scale.row(i);
            if !log.iter().all(|x| x.is_finite()) {
                rows.flags[i] |= Flags::NON_FINITE;
            }
            if rows.flags[i].contains(Flags::NON_FINITE) {
                return 0.0;
            }
            log.sort_unstable_by(f32::total_cmp);
            let [min, mid, max] = log.map(f64::from);
            match kind {
                Anisotropy::Ratio => (max - min).min(MAX_LOG_RATIO).exp(),
                // A scene without extent has floor −∞: nothing is floored.
                Anisotropy::Log => max.max(floor) - mid.max(floor),
            }
        })
        .collect();
}

#[cfg(test)]
mod tests {
    use super::*;

    fn anisotropy(log_scale: [f32; 3], kind: Anisotropy, extent: f64) -> (f64, Flags) {
        let mut column = Column::zeros(3, 1);
        column.set_row(0, log_scale);
        let mut rows = Rows { d: vec![0.0], flags: vec![Flags::empty()], ..Rows::default() };
        fill_anisotropy(&mut rows, &column, kind, extent);
        (rows.e[0], rows.flags[0])
    }

    #[test]
    fn ratio_and_log_follow_their_definitions_whatever_the_axis_order() {
        for log in [[0.0, 1.0, 3.0], [3.0, 0.0, 1.0], [1.0, 3.0, 0.0]] {
            assert!((anisotropy(log, Anisotropy::Ratio, 1.0).0 - 3f64.exp()).abs() < 1e-12);
            assert_eq!(anisotropy(log, Anisotropy::Log, 1.0).0, 2.0);
        }
    }

    #[test]
    fn scales_from_1e_minus_12_to_1e6_and_beyond_stay_finite() {
        let needle = [1e6f32.ln(), 1e-12f32.ln(), 1e-12f32.ln()];
        let (ratio, _) = anisotropy(needle, Anisotropy::Ratio, 1.0);
        assert!((ratio / 1e18 - 1.0).abs() < 1e-5, "{ratio:e}");
        let (log, _) = anisotropy(needle, Anisotropy::Log, 1.0);
        assert!((log - 1e13f64.ln()).abs() < 1e-5, "the middle scale is floored at 1e-7: {log}");
        assert!(anisotropy([3e38, -3e38, 0.0], Anisotropy::Ratio, 1.0).0.is_finite());
        assert!(anisotropy([0.0, -40.0, -80.0], Anisotropy::Log, 0.0).0.is_finite());
    }

    #[test]
    fn scales_that_are_not_finite_are_flagged_and_harmless() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let (e, flags) = anisotropy([0.0, bad, 1.0], Anisotropy::Ratio, 1.0);
            assert!(e == 0.0 && flags.contains(Flags::NON_FINITE));
        }
    }
}
