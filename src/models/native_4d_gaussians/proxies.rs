//! Computes proxies (Gaussians that replace merged ones) of four-dimensional Gaussians.
//!
//! [`match_proxies`] computes for each proxy a straight path with velocity v, a spatial covariance Σ, and a temporal
//! window of standard deviation s. They are combined into one 4D Gaussian with the covariance Σ₄ = [[Σ + vvᵀs², vs²],
//! [vᵀs², s²]], whose axes give two quaternions.
//!
//! SH coefficients refer to the proxy's own center in time. They are fitted to the SH coefficients of the moment
//! matches at the sampled frames (a moment match is the Gaussian with the mean and covariance of the merged Gaussians).
//! Each coefficient is fitted by the sum of three functions of time: a constant, a cosine wave, and a cosine wave of
//! twice its frequency. The fit is by least squares, with a ridge term on the waves.

use super::frame_state::{Native, ROTATION_R, SCALING_T, TERM_WIDTH, TERMS, TIME};
use super::rotation::{decomposed, quaternions};
use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::model::{Attributes, StoredParams, scale_rotation};
use crate::models::in_checkpoint::linear::{LinearPath, match_proxies};
use crate::models::motion_model::MotionModelFrames;
use crate::recipe::MergeParams;

/// Ridge term of the fit of the colors of a proxy (Gaussian that replaces a merged cluster) along time, as a fraction
/// of the total weight of the frames. It keeps the coefficients of the cosine terms near 0 if the frames do not
/// distinguish these terms from the constant term.
const RIDGE: f64 = 1e-3;

/// Returns the stored parameters of one proxy (Gaussian that replaces merged ones) for each of `clusters`, one row
/// each.
///
/// # Errors
/// Fails if frames cannot be evaluated.
pub(super) fn propose(
    model: &MotionModelFrames<Native>,
    clusters: &[Cluster],
    rule: &MergeParams,
) -> Result<StoredParams> {
    let (raw, motion_model) = (model.raw(), model.motion_model());
    let line = |id: u32| {
        let slice = motion_model.slice(raw, id as usize);
        LinearPath {
            position: raw.gaussians.position_f64(id as usize),
            velocity: slice.velocity,
            center: raw.format_specific.plane(TIME)[id as usize].into(),
            deviation: slice.variance.sqrt(),
        }
    };
    let window = |line: &LinearPath, time: f64| motion_model.marginal(time, line.center, line.deviation.powi(2));
    let mut fits = vec![ThreeFunctionFit::default(); clusters.len()];
    let matched = match_proxies(model, clusters, rule, line, window, Attributes::SH, |seen| {
        let [first, second] = motion_model.waves(seen.time, seen.line.center);
        let sh = &seen.state.sh;
        let values = (0..sh.width()).map(|c| f64::from(sh.plane(c)[seen.row]));
        fits[seen.proxy].add(seen.weight, [1.0, first, second], values);
    })?;
    let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
    let mut proxies = raw.pick(&leaders);
    for (row, (matched, fit)) in matched.iter().zip(&fits).enumerate() {
        let Some((opacity, covariance)) = matched.shape else { continue };
        let StoredParams { gaussians, format_specific: own } = &mut proxies;
        let LinearPath { position, velocity, center, deviation } = matched.line;
        let variance = deviation.powi(2);
        gaussians.position.set_row(row, position.map(|x| x as f32));
        gaussians.opacity_logit.set_row(row, [opacity]);
        own.plane_mut(TIME)[row] = center as f32;
        if motion_model.has_4d_rotation {
            let [xx, xy, xz, yy, yz, zz] = covariance;
            let space = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
            let velocity = [velocity[0], velocity[1], velocity[2], 1.0];
            let mut whole = [0, 1, 2, 3].map(|i| [0, 1, 2, 3].map(|j| velocity[i] * velocity[j] * variance));
            (0..3).for_each(|i| (0..3).for_each(|j| whole[i][j] += space[i][j]));
            let (scales, rotation) = decomposed(&whole);
            let [l, r] = quaternions(&rotation, motion_model.flipped);
            let [x, y, z, along] = scales.map(|scale| scale.ln() as f32);
            gaussians.log_scale.set_row(row, [x, y, z]);
            gaussians.rotation.set_row(row, l.map(|q| q as f32));
            own.plane_mut(SCALING_T)[row] = along;
            (0..4).for_each(|c| own.plane_mut(ROTATION_R + c)[row] = r[c] as f32);
        } else {
            let (scales, rotation) = scale_rotation(covariance, gaussians.rotation_f64(row));
            gaussians.log_scale.set_row(row, scales.map(|scale| scale.ln() as f32));
            gaussians.rotation.set_row(row, rotation.map(|q| q as f32));
            own.plane_mut(SCALING_T)[row] = variance.ln() as f32;
        }
        for (c, [constant, waves @ ..]) in fit.solve(motion_model.terms).enumerate() {
            gaussians.sh.plane_mut(c)[row] = constant as f32;
            (0..motion_model.terms)
                .for_each(|term| own.plane_mut(TERMS + term * TERM_WIDTH + c)[row] = waves[term] as f32);
        }
    }
    Ok(proxies)
}

/// Least-squares fit of many values by the same three functions of time: the constant 1 and two waves.
#[derive(Debug, Clone, Default)]
struct ThreeFunctionFit {
    /// Matrix of the normal equations: entry [i][j] is Σ w·fᵢ·fⱼ over the samples, where w is the weight of a sample
    /// and f₀, f₁, f₂ are the basis functions of time (the constant 1 and two cosine waves).
    normal: [[f64; 3]; 3],
    /// Right-hand sides of the normal equations, for each fitted value v: entry [i] is Σ w·fᵢ·v over the samples, with
    /// the weights w and the basis functions fᵢ of `normal`.
    by_value: Vec<[f64; 3]>,
}

impl ThreeFunctionFit {
    /// Adds one sample of all fitted values to the sums. `basis` holds the three basis functions (constant and two
    /// cosine waves) at the time of the sample, `values` the values at this time, and `weight` the weight of the
    /// sample.
    fn add(&mut self, weight: f64, basis: [f64; 3], values: impl ExactSizeIterator<Item = f64>) {
        self.by_value.resize(values.len(), [0.0; 3]);
        for (i, row) in self.normal.iter_mut().enumerate() {
            row.iter_mut().zip(basis).for_each(|(sum, of)| *sum += weight * basis[i] * of);
        }
        for (sums, value) in self.by_value.iter_mut().zip(values) {
            sums.iter_mut().zip(basis).for_each(|(sum, of)| *sum += weight * of * value);
        }
    }

    /// Returns the three least-squares coefficients of each fitted value: of the constant, of the first and of the
    /// second cosine wave. Only the first `terms` waves are fitted; the coefficients of the others are 0.
    fn solve(&self, terms: usize) -> impl Iterator<Item = [f64; 3]> {
        let mut normal = self.normal;
        let ridge = RIDGE * normal[0][0];
        for (i, row) in normal.iter_mut().enumerate() {
            row[i] += if i > 0 { ridge } else { 0.0 };
            if i > terms {
                *row = [0.0; 3];
                row[i] = 1.0;
            }
        }
        let inverse = glam::DMat3::from_cols_array_2d(&normal).transpose().inverse();
        self.by_value.iter().map(move |&[a, b, c]| {
            let sums = [a, if terms > 0 { b } else { 0.0 }, if terms > 1 { c } else { 0.0 }];
            (inverse * glam::DVec3::from(sums)).to_array()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waves_are_fitted_only_if_frames_show_them() {
        let wave = |k: i32, center: f64| {
            let turn = std::f64::consts::TAU * (center - 0.05 * f64::from(k));
            [1.0, turn.cos(), (2.0 * turn).cos()]
        };
        let (mut whole, mut short) = (ThreeFunctionFit::default(), ThreeFunctionFit::default());
        for k in 0..20 {
            let basis = wave(k, 0.3);
            let value = 0.7 - 0.4 * basis[1] + 0.2 * basis[2];
            whole.add(0.5, basis, [value, -value].into_iter());
        }
        let found: Vec<[f64; 3]> = whole.solve(2).collect();
        for (got, expected) in found[0].iter().zip([0.7, -0.4, 0.2]) {
            assert!((got - expected).abs() < 2e-3, "{found:?}");
        }
        // A single frame determines the constant only.
        short.add(0.5, wave(6, 0.3), [0.7].into_iter());
        let [[constant, first, second]] = short.solve(2).collect::<Vec<_>>()[..] else { panic!("one value") };
        assert!((constant + first + second - 0.7).abs() < 1e-9 && first.abs() < 1e-2 && second.abs() < 1e-2);
        // Coefficients of terms that the model does not have stay 0.
        let [got, _] = whole.solve(0).collect::<Vec<_>>()[..] else { panic!("two values") };
        assert_eq!(got[1..], [0.0, 0.0]);
    }
}
