//! Self-check cases for merging: properties that a proxy (Gaussian that replaces a cluster) must have in common with
//! the members of its cluster.

use glam::{DMat3, DQuat, DVec3};

use super::case::LargestError;
use super::generated::clouds::{Random, random_gaussians};
use crate::error::{Error, Result};
use crate::merging::moments::{Ellipsoid, WeightedGaussian, moments, reorder_axes_to_match};
use crate::merging::proxy::{Importance, merge_member_states, weights};
use crate::merging::{Survivors, merge_survivors};
use crate::model::{Attributes, Gaussians};
use crate::recipe::{MergeParams, ProxyOpacity, ProxyPosition, Recipe};

/// Compares the mean and covariance Σ that the program computes for a mixture of Gaussians with those by the textbook
/// formula in f64, which forms Σ as a matrix. Errors are relative to the largest entry of Σ. Rounding of a dozen
/// Gaussians causes an error of about 1e-15.
pub(super) fn mixture(worst: &mut LargestError) -> Result<()> {
    let mut random = Random(1);
    for count in [1, 2, 3, 12] {
        let mut within = |low, high| f64::from(random.next_in(low, high));
        let parts: Vec<WeightedGaussian> = (1..=count)
            .map(|k| WeightedGaussian {
                weight: 2.0 * f64::from(k) / f64::from(count * (count + 1)),
                position: DVec3::new(within(-1.0, 1.0), within(-1.0, 1.0), within(-1.0, 1.0)),
                rotation: DQuat::from_xyzw(within(-1.0, 1.0), within(-1.0, 1.0), within(-1.0, 1.0), 0.3).normalize(),
                scales: DVec3::new(within(0.01, 1.0), within(0.01, 1.0), within(0.01, 1.0)),
            })
            .collect();
        compare_moments(&moments(&parts, None), &parts, worst);
    }
    Ok(())
}

/// Merges a Gaussian with its exact copy, which must give the same scales again. The ratio of the smallest to the
/// largest scale is 1 : 1e12, and each scale must be exact to 1e-12. A covariance matrix formed in f64 would lose the
/// smallest scale entirely.
pub(super) fn needle(worst: &mut LargestError) -> Result<()> {
    let rotation = DQuat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize();
    for scales in [DVec3::new(1e6, 1.0, 1e-6), DVec3::new(1e-6, 1e6, 1e-6), DVec3::new(1e-6, 3e-6, 1e6)] {
        let part = WeightedGaussian { weight: 0.5, position: DVec3::new(1.0, 2.0, 3.0), rotation, scales };
        let found = reorder_axes_to_match(&moments(&[part, part], None), rotation);
        (0..3).for_each(|axis| worst.relative(found.scales[axis], scales[axis]));
    }
    Ok(())
}

/// Compares a proxy (Gaussian that replaces merged ones) with its five members (the merged Gaussians):
/// - its mean and covariance, with those of the mixture of the members
/// - its SH coefficients, with the weighted mean of the members
/// - its opacity, with 1 − Π(1 − α), where α are the opacities of the members
///
/// The members lie 1000 units from the origin, where the rounding of f64 changes their offsets by 1e-13.
pub(super) fn proxy(worst: &mut LargestError) -> Result<()> {
    let mut states = random_gaussians(4, 5, 1);
    states.position.planes_mut().iter_mut().for_each(|x| *x = 1000.0 + 0.1 * *x);
    let (coverage, visibility) = ([1.0, 2.0, 3.0, 4.0, 5.0], [0.5, 1.0, 0.25, 1.0, 0.75]);
    let seen: Vec<f64> = coverage.iter().zip(&visibility).map(|(c, vis)| c * vis).collect();
    let total: f64 = seen.iter().sum();
    let rows = [0, 1, 2, 3, 4];
    let importance = Importance { ids: &rows, coverage: &coverage, visibility: &visibility };
    let members: Vec<(u32, f64)> = rows.into_iter().zip(weights(&rows, &importance, &states)).collect();
    let recipe = MergeParams { placement: ProxyPosition::Mean, ..recipe(ProxyOpacity::Union)? };
    let found = merge_member_states(&members, &states, 2, &recipe, Attributes::all());

    let parts: Vec<WeightedGaussian> = (0..5).map(|i| part(&states, i, seen[i] / total)).collect();
    let [w, x, y, z] = found.rotation;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let scales = DVec3::from(found.log_scale).exp();
    compare_moments(&Ellipsoid { mean: found.position, rotation, scales }, &parts, worst);
    let opacity = |logit: f64| 1.0 / (1.0 + (-logit).exp());
    let clear: f64 = states.opacity_logit.plane(0).iter().map(|&logit| 1.0 - opacity(logit.into())).product();
    worst.near(opacity(found.opacity_logit), 1.0 - clear, 1.0);
    for c in 0..3 {
        let plane = states.sh.plane(c);
        let average: f64 = parts.iter().zip(plane).map(|(part, &x)| part.weight * f64::from(x)).sum();
        worst.near(found.sh[c], average, 1.0);
    }
    Ok(())
}

/// Merges eight exact copies of a Gaussian, once with each rule of [`ProxyOpacity`]; a ninth copy far away must stay
/// alone. The proxy (Gaussian that replaces the merged ones) must have the position, scales and SH coefficients of the
/// copies to the bit, and the opacity that the rule gives, in f32.
pub(super) fn duplicates(worst: &mut LargestError) -> Result<()> {
    let one = random_gaussians(6, 1, 0);
    let mut states = one.pick(&[0; 9]);
    states.position.plane_mut(0)[8] += 1e3;
    let opacity = 0.05f64;
    states.opacity_logit.plane_mut(0).fill((opacity / (1.0 - opacity)).ln() as f32);
    let rows: Vec<u32> = (0..9).collect();
    let importance = Importance { ids: &rows, coverage: &[1.0; 9], visibility: &[1.0; 9] };
    let survivors = Survivors { states: &states, rows: &rows, importance, classes: &[Some(0); 9], extent: 1.0 };
    for (rule, expected) in [
        (ProxyOpacity::Sum, 8.0 * opacity),
        (ProxyOpacity::Area, 8.0 * opacity),
        (ProxyOpacity::Union, 1.0 - (1.0 - opacity).powi(8)),
    ] {
        let merged = merge_survivors(&survivors, &recipe(rule)?, None, 1000, |asked| {
            Ok::<_, Error>(vec![1.0; asked.pairs().len()])
        })?;
        let groups = &merged.groups;
        let members: Vec<&[u32]> = (0..groups.group_count()).map(|group| groups.members(group)).collect();
        let mut sorted = members;
        sorted.sort_unstable();
        worst.same(&sorted[..], &[&rows[..8], &rows[8..]]);
        for column in (Attributes::POSITION | Attributes::LOG_SCALE | Attributes::SH).iter() {
            worst.same(
                merged.proxies.attribute_values(column).planes(),
                states.attribute_values(column).pick(&[0]).planes(),
            );
        }
        let logit = f64::from(merged.proxies.opacity_logit.planes().first().copied().unwrap_or(f32::NAN));
        worst.near(1.0 / (1.0 + (-logit).exp()), expected, 1.0);
    }
    Ok(())
}

fn recipe(opacity: ProxyOpacity) -> Result<MergeParams> {
    Ok(MergeParams { opacity, ..Recipe::preset("default")?.merge })
}

/// Returns Gaussian `i` of `states` as a component of a mixture, with the weight `weight`.
fn part(states: &Gaussians, i: usize, weight: f64) -> WeightedGaussian {
    let [w, x, y, z] = states.rotation_f64(i);
    WeightedGaussian {
        weight,
        position: DVec3::from(states.position_f64(i)),
        rotation: DQuat::from_xyzw(x, y, z, w).normalize(),
        scales: DVec3::from(states.log_scale.row::<3>(i).map(f64::from)).exp(),
    }
}

/// Compares mean and covariance of `actual` with those of the mixture `parts` and adds the errors to `worst`. The
/// expected covariance Σ is formed as a matrix, by the textbook formula. Errors of the covariance are relative to the
/// largest entry of Σ, errors of the mean to the square root of this entry.
fn compare_moments(actual: &Ellipsoid, parts: &[WeightedGaussian], worst: &mut LargestError) {
    let covariance = |rotation: DQuat, scales: DVec3| {
        let axes = DMat3::from_quat(rotation);
        axes * DMat3::from_diagonal(scales * scales) * axes.transpose()
    };
    let outer = |v: DVec3| DMat3::from_cols(v * v.x, v * v.y, v * v.z);
    let mean: DVec3 = parts.iter().map(|part| part.weight * part.position).sum();
    let spread =
        |part: &WeightedGaussian| (covariance(part.rotation, part.scales) + outer(part.position - mean)) * part.weight;
    let expected = parts.iter().map(spread).fold(DMat3::ZERO, |sum, part| sum + part).to_cols_array();
    let largest = expected.iter().fold(0.0f64, |most, x| most.max(x.abs()));
    (0..3).for_each(|axis| worst.near(actual.mean[axis], mean[axis], largest.sqrt()));
    let got = covariance(actual.rotation, actual.scales).to_cols_array();
    got.iter().zip(expected).for_each(|(&got, expected)| worst.near(got, expected, largest));
}
