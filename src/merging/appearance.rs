//! Tests 1 (place and size) and 2 (color) of merging: whether two Gaussians look alike at the reference frame, the
//! frame in which most Gaussians are alive.
//!
//! Input: the attributes of two Gaussians. Output: pass or fail. No memory is allocated. A NaN fails every test.

use glam::{DMat3, DQuat, DVec3};

use crate::model::{Gaussians, SH_C0};
use crate::recipe;

/// Term added to the denominator of the cosines of base colors and of velocities, against division by 0; value of the
/// paper (section 3.5.1).
pub(super) const COSINE_EPSILON: f64 = 1e-8;
/// Fraction of the trace of the mean covariance that is added to its diagonal, so that coplanar flat Gaussians have a
/// finite Mahalanobis distance.
const REGULARIZATION: f64 = 1e-6;
/// Ratio of the smallest to the middle scale below which a Gaussian counts as flat. A smaller thickness is training
/// noise that no render shows.
const MIN_THICKNESS: f64 = 0.1;

/// Thresholds of tests 1 (place and size) and 2 (color) of one merging pass. The recipe may have several passes with
/// different thresholds.
#[derive(Debug, Clone, Copy)]
pub struct AppearanceThresholds {
    /// Maximum Mahalanobis distance of the two centers, under the mean of the two covariances; exclusive.
    d0: f64,
    /// Minimum cosine between the base colors (SH coefficients of degree 0); exclusive.
    rho: f64,
    /// Maximum difference of the largest, of the middle and of the smallest log scale.
    max_log_scale_ratio: f64,
    /// Maximum distance of the base colors in RGB, where 1 is full intensity.
    max_color_difference: f64,
}

impl AppearanceThresholds {
    /// Creates the thresholds of the merging pass `pass`. The thresholds that all passes share are taken from `merge`.
    pub fn new(merge: &recipe::MergeParams, pass: &recipe::MergePass) -> Self {
        AppearanceThresholds {
            d0: pass.d0,
            rho: pass.rho,
            max_log_scale_ratio: merge.max_scale_ratio.ln(),
            max_color_difference: merge.max_color_difference,
        }
    }

    /// Returns whether the Gaussians `a` and `b` pass test 1 (place and size) and test 2 (color). The order of `a` and
    /// `b` does not matter. The cheap comparisons run first.
    pub fn pass(&self, a: &Appearance, b: &Appearance) -> bool {
        (a.color - b.color).length() <= self.max_color_difference
            && cosine(a.dc, b.dc) > self.rho
            && are_sizes_alike(a.log_scale, b.log_scale, self.max_log_scale_ratio)
            && mahalanobis(a.position - b.position, &((a.covariance() + b.covariance()) * 0.5)) < self.d0
    }
}

/// Values of one Gaussian that tests 1 (place and size) and 2 (color) compare.
#[derive(Debug, Clone, Copy)]
pub struct Appearance {
    position: DVec3,
    rotation: DQuat,
    /// Natural logarithms of the scales, descending. For the comparison of sizes the smallest scale is raised to at
    /// least [`MIN_THICKNESS`] times the middle one.
    log_scale: [f64; 3],
    /// Standard deviations along the axes of `rotation`, in scene units.
    scales: DVec3,
    /// SH coefficients of degree 0: red, green, blue.
    dc: DVec3,
    /// Base color as red, green and blue, with negative values raised to 0.
    color: DVec3,
}

impl Appearance {
    /// Creates the appearance of the Gaussian in row `i` of `states`.
    pub fn new(states: &Gaussians, i: usize) -> Self {
        let log_scale = states.log_scale.row::<3>(i).map(f64::from);
        let mut sorted = log_scale;
        sorted.sort_by(|a, b| b.total_cmp(a));
        // Only a finite scale is raised: minus infinity is not a thickness and must fail the test of sizes.
        if sorted[2].is_finite() {
            sorted[2] = sorted[2].max(sorted[1] + MIN_THICKNESS.ln());
        }
        let dc = DVec3::from(states.sh.row::<3>(i).map(f64::from));
        Appearance {
            position: DVec3::from(states.position_f64(i)),
            rotation: unit_rotation(states.rotation.row(i)),
            log_scale: sorted,
            scales: DVec3::from(log_scale.map(f64::exp)),
            dc,
            color: (DVec3::splat(0.5) + SH_C0 * dc).max(DVec3::ZERO),
        }
    }

    fn covariance(&self) -> DMat3 {
        let axes = DMat3::from_quat(self.rotation);
        axes * DMat3::from_diagonal(self.scales * self.scales) * axes.transpose()
    }
}

/// Returns the unit quaternion of the stored quaternion (w, x, y, z), or the identity if it has length zero or is not
/// finite.
pub(super) fn unit_rotation([w, x, y, z]: [f32; 4]) -> DQuat {
    let rotation = DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into());
    let length = rotation.length();
    if length > 0.0 && length.is_finite() { rotation / length } else { DQuat::IDENTITY }
}

/// Returns whether the largest, the middle and the smallest scales of two Gaussians each differ by at most the factor
/// exp(`max_log_ratio`). `a` and `b` are log scales, descending. The test keeps a very large Gaussian from swallowing
/// fine detail near it. If both have the same infinite scale, the difference is NaN and the test fails.
fn are_sizes_alike(a: [f64; 3], b: [f64; 3], max_log_ratio: f64) -> bool {
    (0..3).all(|c| (a[c] - b[c]).abs() <= max_log_ratio)
}

/// Returns the cosine (a·b)/(‖a‖‖b‖ + [`COSINE_EPSILON`]), in [−1, 1]. Returns 1 for equal vectors, even if they are
/// zero: two copies of a medium gray Gaussian have only zero color coefficients, and count as alike.
fn cosine(a: DVec3, b: DVec3) -> f64 {
    if a == b { 1.0 } else { a.dot(b) / (a.length() * b.length() + COSINE_EPSILON) }
}

/// Returns the Mahalanobis distance √(Δᵀ (Σ + 1e-6 · tr(Σ) · I)⁻¹ Δ) of the offset Δ = `delta` under the positive
/// semidefinite covariance Σ = `sigma`. Divides Σ by its trace before the Cholesky factorization in f64, so that the
/// squares of scales between 1e-12 and 1e6 stay in range. For Σ = 0 the distance is 0 if Δ = 0, else infinite.
fn mahalanobis(delta: DVec3, sigma: &DMat3) -> f64 {
    let trace = sigma.x_axis.x + sigma.y_axis.y + sigma.z_axis.z;
    if trace == 0.0 {
        return if delta == DVec3::ZERO { 0.0 } else { f64::INFINITY };
    }
    let unit = *sigma * trace.recip();
    let [a, b, c] = [unit.x_axis.x, unit.y_axis.y, unit.z_axis.z].map(|diagonal| diagonal + REGULARIZATION);
    // Computes the lower Cholesky factor L and solves L y = Δ; the distance is ‖y‖.
    let l00 = a.sqrt();
    let (l10, l20) = (unit.x_axis.y / l00, unit.x_axis.z / l00);
    let l11 = (b - l10 * l10).sqrt();
    let l21 = (unit.y_axis.z - l20 * l10) / l11;
    let l22 = (c - l20 * l20 - l21 * l21).sqrt();
    let y0 = delta.x / l00;
    let y1 = (delta.y - l10 * y0) / l11;
    let y2 = (delta.z - l20 * y0 - l21 * y1) / l22;
    DVec3::new(y0, y1, y2).length() / trace.sqrt()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::recipe::Recipe;

    fn default_gates() -> AppearanceThresholds {
        let merge = Recipe::preset("default").unwrap().merge;
        AppearanceThresholds::new(&merge, &merge.passes[0])
    }

    fn pair_from(edit: impl Fn(&mut Gaussians)) -> [Appearance; 2] {
        let mut states = Gaussians::zeros(2, 0);
        for i in 0..2 {
            states.rotation.set_row(i, [1.0, 0.0, 0.0, 0.0]);
            states.sh.set_row(i, [0.4, 0.2, -0.3]);
        }
        edit(&mut states);
        [0, 1].map(|i| Appearance::new(&states, i))
    }

    fn passes(edit: impl Fn(&mut Gaussians)) -> bool {
        let [a, b] = pair_from(edit);
        assert_eq!(default_gates().pass(&a, &b), default_gates().pass(&b, &a));
        default_gates().pass(&a, &b)
    }

    #[test]
    fn black_and_gray_are_not_merged() {
        let edit = |states: &mut Gaussians| {
            states.sh.set_row(0, [-1.7; 3]);
            states.sh.set_row(1, [-0.2; 3]);
        };
        let [black, gray] = pair_from(edit);
        assert!(cosine(black.dc, gray.dc) > 0.99);
        assert!(!passes(edit));
        // Values below black are clamped to black by the renderer.
        assert!(passes(|states| {
            states.sh.set_row(0, [-1.8; 3]);
            states.sh.set_row(1, [-9.0; 3]);
        }));
    }

    #[test]
    fn duplicates_of_any_color_scale_and_rotation_pass() {
        assert!(passes(|_| {}));
        assert!(passes(|states| (0..2).for_each(|i| states.sh.set_row(i, [0.0; 3]))));
        assert!(passes(|states| (0..2).for_each(|i| states.rotation.set_row(i, [0.0; 4]))));
        for log_scale in [1e-12f32.ln(), 1e6f32.ln(), -400.0, 300.0] {
            assert!(passes(|states| (0..2).for_each(|i| states.log_scale.set_row(i, [log_scale; 3]))), "{log_scale}");
        }
    }

    #[test]
    fn large_and_small_gaussians_are_not_merged() {
        assert!(!passes(|states| states.log_scale.set_row(0, [6.0; 3])));
        assert!(!passes(|states| states.log_scale.set_row(0, [2.0, 0.0, 0.0])));
        assert!(!passes(|states| states.log_scale.set_row(0, [0.0, -2.0, -2.0])));
        assert!(!passes(|states| states.log_scale.set_row(0, [0.0, 0.0, -8.0])), "a sphere and a flat Gaussian");
    }

    #[test]
    fn flat_gaussians_of_different_thickness_pass() {
        assert!(passes(|states| {
            states.log_scale.set_row(0, [0.0, -20.0, 0.1]);
            states.log_scale.set_row(1, [0.0, -8.0, 0.0]);
        }));
    }

    #[test]
    fn non_finite_values_never_pass() {
        let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
        for value in bad {
            assert!(!passes(|states| states.position.set_row(0, [value, 0.0, 0.0])), "position {value}");
            assert!(!passes(|states| states.sh.set_row(0, [value, 0.0, 0.0])), "color {value}");
            assert!(
                !passes(|states| (0..2).for_each(|i| states.log_scale.set_row(i, [0.0, value, 0.0]))),
                "scale {value}"
            );
        }
    }

    proptest! {
        #[test]
        fn mahalanobis_equals_the_inverse_covariance(
            delta in prop::array::uniform3(-1.0..1.0f64),
            axes in prop::array::uniform9(-1.0..1.0f64),
            log10_size in -24.0..24.0f64,
        ) {
            let factor = DMat3::from_cols_array(&axes);
            let sigma = factor * factor.transpose() * 10f64.powf(log10_size);
            let trace = sigma.x_axis.x + sigma.y_axis.y + sigma.z_axis.z;
            let regular = sigma + DMat3::from_diagonal(DVec3::splat(REGULARIZATION * trace));
            let delta = DVec3::from(delta);
            // Inversion by cofactors has a relative error of about cond(Σ) ≤ 1e6 ulp. Σ is divided by its trace first
            // because its determinant may overflow.
            let expected = (delta.dot((regular * trace.recip()).inverse() * delta) / trace).sqrt();
            let got = mahalanobis(delta, &sigma);
            prop_assert!((got / expected - 1.0).abs() < 1e-8, "got {got:e}, expected {expected:e}");
        }
    }
}
