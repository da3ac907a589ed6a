//! Computation of the proxy: the single Gaussian that replaces a cluster of merged Gaussians, its members.
//!
//! Input: attributes of all members at the reference frame, and their weights. Output: one Gaussian per cluster, in the
//! stored encoding (log scales, opacity logits). Memory beside the output: 1 KiB per cluster, for at most 4096 clusters
//! at a time. A cluster of many coincident Gaussians takes 220 bytes per member; the search for their pairs may have
//! taken more.

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::MergeGroups;
use super::appearance::unit_rotation;
use super::moments::{Ellipsoid, WeightedGaussian, moments, reorder_axes_to_match};
use crate::model::{self, Attributes, Gaussians};
use crate::recipe::{self, ProxyHigherSh, ProxyOpacity, ProxyPosition};

/// Number of proxies (Gaussians that replace merged clusters) that are computed before their values are written to the
/// output.
const BATCH: usize = 4096;
/// Minimum distance of the opacity of a proxy from 0 and from 1, so that its logit is finite in f32.
const OPACITY_MARGIN: f64 = 1.0 / (1u32 << 24) as f64;
/// Exponent p of Thomsen's approximation of the surface of an ellipsoid (Knud Thomsen, 2004; see Michon, "Surface area
/// of an ellipsoid").
const THOMSEN: f64 = 1.6075;

/// Attributes of a proxy at the reference frame, encoded as in [`Gaussians`] but in f64.
#[derive(Debug, Clone, PartialEq)]
pub struct ProxyState {
    /// Center of the proxy, in scene units.
    pub position: DVec3,
    /// Rotation of the proxy: unit quaternion (w, x, y, z). Its axes are in the order of the axes of the leader (most
    /// important member of the cluster), and its sign is the one nearest to the leader's quaternion.
    pub rotation: [f64; 4],
    /// Natural logarithms of the scales (scene units); always finite.
    pub log_scale: [f64; 3],
    /// Logit of the opacity; always finite.
    pub opacity_logit: f64,
    /// SH coefficients, in the order of a row of [`Gaussians::sh`].
    pub sh: Vec<f64>,
}

impl ProxyState {
    /// Rounds the attributes `want` to f32 and writes them to row `row` of `out`.
    pub fn write(&self, want: Attributes, row: usize, out: &mut Gaussians) {
        for column in want.iter() {
            match column {
                Attributes::POSITION => out.position.set_row(row, self.position.to_array().map(|x| x as f32)),
                Attributes::ROTATION => out.rotation.set_row(row, self.rotation.map(|x| x as f32)),
                Attributes::LOG_SCALE => out.log_scale.set_row(row, self.log_scale.map(|x| x as f32)),
                Attributes::OPACITY => out.opacity_logit.set_row(row, [self.opacity_logit as f32]),
                _ => {
                    for (plane, &value) in self.sh.iter().enumerate() {
                        out.sh.plane_mut(plane)[row] = value as f32;
                    }
                }
            }
        }
    }
}

/// Importance of Gaussians, which determines their weights when they are merged.
#[derive(Debug, Clone, Copy)]
pub struct Importance<'a> {
    /// Id of the Gaussian in each row of the table of Gaussians.
    pub ids: &'a [u32],
    /// Contribution C of every Gaussian, by id: its mean contribution to a render, in pixels.
    pub coverage: &'a [f64],
    /// Visibility Vis of every Gaussian, by id: fraction of the views in which the Gaussian is on screen.
    pub visibility: &'a [f64],
}

impl Importance<'_> {
    /// Returns the contribution C of the Gaussian in row `row`.
    pub(super) fn coverage(&self, row: u32) -> f64 {
        self.coverage[self.ids[row as usize] as usize]
    }

    /// Returns contribution times visibility, C·Vis, of the Gaussian in row `row`.
    fn weighted_contribution(&self, row: u32) -> f64 {
        self.coverage(row) * self.visibility[self.ids[row as usize] as usize]
    }
}

/// Returns the weights of the `members` of a cluster, which are rows of `states`. The weights sum to 1. They are
/// proportional to the first of these quantities that is never negative and has a positive, finite sum over the
/// members:
/// - contribution × visibility (C·Vis, from `importance`);
/// - opacity × projected area of the Gaussian, averaged over all directions;
/// - 1, so that all weights are equal.
pub fn weights(members: &[u32], importance: &Importance<'_>, states: &Gaussians) -> Vec<f64> {
    let weighted_contribution = |&i: &u32| importance.weighted_contribution(i);
    let opaque_area = |&i: &u32| opacity(states, i) * mean_area(scales(states, i));
    let share = |weights: Vec<f64>| {
        let total: f64 = weights.iter().sum();
        let sound = total.is_normal() && weights.iter().all(|&w| w >= 0.0);
        sound.then(|| weights.into_iter().map(|w| w / total).collect())
    };
    share(members.iter().map(weighted_contribution).collect())
        .or_else(|| share(members.iter().map(opaque_area).collect()))
        .unwrap_or_else(|| vec![1.0 / members.len() as f64; members.len()])
}

/// Computes the proxy that replaces the cluster `members`: rows of `states` and their weights, which sum to 1. The row
/// `leader` is one of them.
///
/// - Mean and covariance are those of the weighted mixture. With [`ProxyPosition::Leader`] the proxy has the leader's
///   position instead, and the second moments are taken about it.
/// - The base color is the weighted mean. Coefficients of higher SH degrees are the weighted mean or those of the
///   member with the largest weight (the first on a tie).
/// - The opacity follows the rule [`ProxyOpacity`]. The area in this rule is the projected area of an ellipsoid,
///   averaged over all directions.
///
/// Exact duplicates give the leader's own position, axes, scales and color. A zero quaternion counts as the identity.
///
/// Colors are computed only if `want` contains them: they are slow to read, and in most sequences they are the same at
/// every frame.
pub fn merge_member_states(
    members: &[(u32, f64)],
    states: &Gaussians,
    leader: u32,
    merge: &recipe::MergeParams,
    want: Attributes,
) -> ProxyState {
    // All values are relative to the leader. Thus coordinates far from the origin cancel once, and the Jacobi iteration
    // starts from the leader's axes and rotates them only as far as the other members require.
    let position = |i: u32| DVec3::from(states.position_f64(i as usize));
    let origin = position(leader);
    let frame = unit_rotation(states.rotation.row(leader as usize));
    let part = |&(i, weight): &(u32, f64)| {
        let rotation = unit_rotation(states.rotation.row(i as usize));
        let relative = if rotation == frame { DQuat::IDENTITY } else { (frame.inverse() * rotation).normalize() };
        WeightedGaussian {
            weight,
            position: frame.inverse() * (position(i) - origin),
            rotation: relative,
            scales: scales(states, i),
        }
    };
    let parts: Vec<WeightedGaussian> = members.iter().map(part).collect();
    let about = match merge.placement {
        ProxyPosition::Mean => None,
        ProxyPosition::Leader => Some(DVec3::ZERO),
    };
    let local = reorder_axes_to_match(&moments(&parts, about), DQuat::IDENTITY);
    ProxyState {
        position: origin + frame * local.mean,
        rotation: nearest_sign(frame * local.rotation, frame),
        // A scale that has underflowed to 0 is replaced by the smallest positive number, whose logarithm is finite.
        log_scale: local.scales.to_array().map(|scale| scale.max(f64::MIN_POSITIVE).ln()),
        opacity_logit: logit(merged_opacity(members, states, &local, merge.opacity)),
        sh: match want.contains(Attributes::SH) {
            true => merged_sh(members, states, leader, merge.sh_high),
            false => Vec::new(),
        },
    }
}

/// Computes the proxy of every group in `groups` that has more than one Gaussian, from the Gaussians `states` and their
/// `importance`, by the parameters `merge`. The result has one row for each such group, in the order of the groups.
pub fn merge_groups(
    groups: &MergeGroups,
    importance: &Importance<'_>,
    states: &Gaussians,
    merge: &recipe::MergeParams,
) -> Gaussians {
    let clusters: Vec<u32> = groups.clusters().collect();
    let mut out = states.pick(&[]);
    out.resize(clusters.len());
    let proxy = |&group: &u32| {
        let rows = groups.members(group as usize);
        let weights = weights(rows, importance, states);
        let members: Vec<(u32, f64)> = rows.iter().copied().zip(weights).collect();
        merge_member_states(&members, states, groups.leaders()[group as usize], merge, Attributes::all())
    };
    let mut row = 0;
    for_each_proxy(&clusters, proxy, |_, proxy| {
        proxy.write(Attributes::all(), row, &mut out);
        row += 1;
    });
    out
}

/// Computes a proxy for each of `items` by `compute`, in parallel, and passes the items and their proxies to `write` in
/// order. At most [`BATCH`] proxies are in memory.
pub(super) fn for_each_proxy<T: Sync>(
    items: &[T],
    compute: impl Fn(&T) -> ProxyState + Sync,
    mut write: impl FnMut(&T, &ProxyState),
) {
    for batch in items.chunks(BATCH) {
        let proxies: Vec<ProxyState> = batch.par_iter().map(&compute).collect();
        batch.iter().zip(&proxies).for_each(|(item, proxy)| write(item, proxy));
    }
}

fn scales(states: &Gaussians, i: u32) -> DVec3 {
    states.scales_f64(i as usize).into()
}

fn opacity(states: &Gaussians, i: u32) -> f64 {
    model::opacity(states.opacity_logit.plane(0)[i as usize])
}

fn logit(opacity: f64) -> f64 {
    (opacity / (1.0 - opacity)).ln()
}

/// Returns the unit quaternion `rotation` as (w, x, y, z), with the sign nearest to `reference`.
fn nearest_sign(rotation: DQuat, reference: DQuat) -> [f64; 4] {
    let rotation = rotation.normalize();
    let q = if rotation.dot(reference) < 0.0 { -rotation } else { rotation };
    [q.w, q.x, q.y, q.z]
}

/// Returns the projected area of an ellipsoid with the half axes `scales`, averaged over all directions. It is a
/// quarter of the surface (Cauchy), computed by Thomsen's formula, with an error of at most 1.1%. The mean of the three
/// cross sections along the axes would be less exact: if a flat Gaussian thickens to 0.3 of its width, its area grows
/// by 18%, but this mean grows by 60%.
fn mean_area(scales: DVec3) -> f64 {
    let largest = scales.max_element();
    if largest <= 0.0 {
        return 0.0;
    }
    let s = scales / largest;
    let mean = [s.x * s.y, s.y * s.z, s.z * s.x].map(|section| section.powf(THOMSEN)).iter().sum::<f64>() / 3.0;
    std::f64::consts::PI * mean.powf(1.0 / THOMSEN) * largest * largest
}

/// Returns the opacity of `proxy`, the Gaussian that replaces `members` (rows of `states` with weights), by the rule
/// `rule`, clamped so that its logit is finite.
fn merged_opacity(members: &[(u32, f64)], states: &Gaussians, proxy: &Ellipsoid, rule: ProxyOpacity) -> f64 {
    let sum = || members.iter().map(|&(i, _)| opacity(states, i)).sum::<f64>();
    let opacity = match rule {
        ProxyOpacity::Sum => sum(),
        ProxyOpacity::Union => 1.0 - members.iter().map(|&(i, _)| 1.0 - opacity(states, i)).product::<f64>(),
        ProxyOpacity::Area => {
            let opaque_area: f64 =
                members.iter().map(|&(i, _)| opacity(states, i) * mean_area(scales(states, i))).sum();
            let area = mean_area(proxy.scales);
            // A proxy whose scales have underflowed has no area, so the sum of opacities is used.
            if area.is_normal() { opaque_area / area } else { sum() }
        }
    };
    opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN)
}

fn merged_sh(members: &[(u32, f64)], states: &Gaussians, leader: u32, high: ProxyHigherSh) -> Vec<f64> {
    let heaviest = members
        .iter()
        .fold((leader, f64::NEG_INFINITY), |best, &(i, weight)| if weight > best.1 { (i, weight) } else { best })
        .0;
    let average = |plane: &[f32]| {
        // Averaging the differences from the leader keeps equal colors equal to the last bit.
        let base = f64::from(plane[leader as usize]);
        base + members.iter().map(|&(i, weight)| weight * (f64::from(plane[i as usize]) - base)).sum::<f64>()
    };
    let coefficient = |(k, plane): (usize, &[f32])| match high {
        ProxyHigherSh::Heaviest if k >= 3 => f64::from(plane[heaviest as usize]),
        _ => average(plane),
    };
    (0..states.sh.width()).map(|k| (k, states.sh.plane(k))).map(coefficient).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::recipe::{MergeParams, Recipe};

    fn recipe(placement: ProxyPosition, opacity: ProxyOpacity) -> MergeParams {
        MergeParams { placement, opacity, ..Recipe::preset("default").unwrap().merge }
    }

    /// Returns `n` copies of one Gaussian of SH degree 1.
    fn copies(n: usize, log_scale: [f32; 3], rotation: [f32; 4]) -> Gaussians {
        let mut states = Gaussians::zeros(n, 1);
        for i in 0..n {
            states.position.set_row(i, [1000.25, -7.125, 0.1]);
            states.rotation.set_row(i, rotation);
            states.log_scale.set_row(i, log_scale);
            states.sh.set_row::<12>(i, std::array::from_fn(|k| 0.1 * k as f32 - 0.37));
        }
        states
    }

    fn equal_weights(n: u32) -> Vec<(u32, f64)> {
        (0..n).map(|i| (i, 1.0 / f64::from(n))).collect()
    }

    #[test]
    fn duplicates_merge_to_the_leader_with_opacity_by_rule() {
        // Cases: (rule, expected opacity); three members of opacity 0.2 each.
        for (rule, expected) in
            [(ProxyOpacity::Sum, 0.6), (ProxyOpacity::Union, 1.0 - 0.8f64.powi(3)), (ProxyOpacity::Area, 0.6)]
        {
            for placement in [ProxyPosition::Mean, ProxyPosition::Leader] {
                for scale in [[-3.0, -5.0, -4.0], [-4.0, -4.0, -9.0], [0.0; 3]] {
                    let mut states = copies(3, scale, [0.9, -1.3, 0.2, 0.4]);
                    states.opacity_logit.plane_mut(0).fill(logit(0.2) as f32);
                    let got =
                        merge_member_states(&equal_weights(3), &states, 1, &recipe(placement, rule), Attributes::all());
                    assert_eq!(got.position.to_array().map(|x| x as f32), states.position.row(1));
                    assert_eq!(got.log_scale.map(|x| x as f32), scale);
                    assert_eq!(got.sh.iter().map(|&x| x as f32).collect::<Vec<_>>(), states.sh.row::<12>(1));
                    let unit = unit_rotation(states.rotation.row(1));
                    let same =
                        DQuat::from_xyzw(got.rotation[1], got.rotation[2], got.rotation[3], got.rotation[0]).dot(unit);
                    assert!((same - 1.0).abs() < 1e-14, "rotation {:?} for {unit:?}", got.rotation);
                    let opacity = 1.0 / (1.0 + (-got.opacity_logit).exp());
                    assert!((opacity - expected).abs() < 1e-6, "{rule:?}: got {opacity}, expected {expected}");
                }
            }
        }
    }

    #[test]
    fn opacities_0_and_1_and_beyond_give_finite_logits() {
        for rule in [ProxyOpacity::Sum, ProxyOpacity::Union, ProxyOpacity::Area] {
            for logit in [f32::MIN, -200.0, 0.0, 200.0, f32::MAX, f32::INFINITY, f32::NEG_INFINITY] {
                let mut states = copies(2, [0.0, -1.0, -2.0], [1.0, 0.0, 0.0, 0.0]);
                states.opacity_logit.plane_mut(0).fill(logit);
                let got = merge_member_states(
                    &equal_weights(2),
                    &states,
                    0,
                    &recipe(ProxyPosition::Mean, rule),
                    Attributes::all(),
                )
                .opacity_logit;
                assert!(got.is_finite() && got.abs() < 17.0, "{rule:?} of {logit}: {got}");
            }
        }
    }

    #[test]
    fn extreme_scales_survive_merging_with_duplicates() {
        let needle = [1e6f32.ln(), 1.0f32.ln(), 1e-6f32.ln()];
        for scale in
            [needle, [1e-12f32.ln(); 3], [1e6f32.ln(); 3], [1e6f32.ln(), 1e-12f32.ln(), 1e-12f32.ln()], [-800.0; 3]]
        {
            let states = copies(2, scale, [0.9, -1.3, 0.2, 0.4]);
            let got = merge_member_states(
                &equal_weights(2),
                &states,
                0,
                &recipe(ProxyPosition::Mean, ProxyOpacity::Area),
                Attributes::all(),
            );
            for (got, expected) in got.log_scale.iter().zip(scale.map(|x| f64::from(x).max(f64::MIN_POSITIVE.ln()))) {
                assert!((got - expected).abs() < 1e-12, "got {got}, expected {expected}");
            }
        }
    }

    #[test]
    fn a_zero_quaternion_is_the_identity() {
        let states = copies(2, [0.0, -1.0, -2.0], [0.0; 4]);
        let got = merge_member_states(
            &equal_weights(2),
            &states,
            0,
            &recipe(ProxyPosition::Mean, ProxyOpacity::Sum),
            Attributes::all(),
        );
        assert_eq!(got.rotation, [1.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn the_leader_keeps_position_axis_order_and_sign() {
        // The second axis is the longest, so the canonical order would permute the axes.
        let mut states = copies(2, [-3.0, -1.0, -5.0], [-0.9, 0.2, 0.1, 0.3]);
        states.position.set_row(1, [1000.3, -7.1, 0.12]);
        let got = merge_member_states(
            &[(0, 0.3), (1, 0.7)],
            &states,
            0,
            &recipe(ProxyPosition::Leader, ProxyOpacity::Area),
            Attributes::all(),
        );
        assert_eq!(got.position.to_array().map(|x| x as f32), states.position.row(0));
        let leader = unit_rotation(states.rotation.row(0));
        let rotation = DQuat::from_xyzw(got.rotation[1], got.rotation[2], got.rotation[3], got.rotation[0]);
        assert!(rotation.dot(leader) > 0.8, "{rotation:?} for {leader:?}");
        assert!(got.log_scale[1] > got.log_scale[0] && got.log_scale[0] > got.log_scale[2]);
        let mean = merge_member_states(
            &[(0, 0.3), (1, 0.7)],
            &states,
            0,
            &recipe(ProxyPosition::Mean, ProxyOpacity::Area),
            Attributes::all(),
        );
        assert!((mean.position.x - (1000.25 * 0.3 + f64::from(1000.3f32) * 0.7)).abs() < 1e-9);
        assert!(mean.log_scale[1] < got.log_scale[1], "moments about the leader exceed those about the mean");
    }

    #[test]
    fn higher_sh_degrees_average_or_follow_the_heaviest() {
        let mut states = copies(2, [0.0; 3], [1.0, 0.0, 0.0, 0.0]);
        states.sh.set_row(0, [1.0f32; 12]);
        states.sh.set_row(1, [0.0f32; 12]);
        let members = [(0, 0.25), (1, 0.75)];
        let average = merged_sh(&members, &states, 0, ProxyHigherSh::Average);
        assert_eq!(average, vec![0.25; 12]);
        let heaviest = merged_sh(&members, &states, 0, ProxyHigherSh::Heaviest);
        assert_eq!((&heaviest[..3], &heaviest[3..]), (&[0.25; 3][..], &[0.0; 9][..]));
    }

    #[test]
    fn unseen_clusters_weigh_by_opacity_and_area_then_evenly() {
        let mut states = copies(3, [0.0; 3], [1.0, 0.0, 0.0, 0.0]);
        states.log_scale.set_row(2, [2f32.sqrt().ln(); 3]);
        let by = |coverage: &[f64], states: &Gaussians| {
            weights(&[0, 1, 2], &Importance { ids: &[0, 1, 2], coverage, visibility: &[1.0, 0.5, 0.0] }, states)
        };
        assert_eq!(by(&[1.0, 6.0, 9.0], &states), [0.25, 0.75, 0.0]);
        for unusable in [[0.0, 0.0, 9.0], [f64::NAN, 1.0, 1.0], [f64::INFINITY, 1.0, 1.0]] {
            for (got, expected) in by(&unusable, &states).iter().zip([0.25, 0.25, 0.5]) {
                assert!((got - expected).abs() < 1e-7, "{unusable:?}: {got}, expected {expected}");
            }
        }
        states.opacity_logit.plane_mut(0).fill(f32::NEG_INFINITY);
        assert_eq!(by(&[0.0; 3], &states), [1.0 / 3.0; 3]);
    }

    #[test]
    fn mean_area_is_a_quarter_of_the_surface() {
        let pi = std::f64::consts::PI;
        assert!((mean_area(DVec3::ONE) - pi).abs() < 1e-12);
        // A flat disc has two faces of πr²; Thomsen's formula is off by 1% there.
        assert!((mean_area(DVec3::new(1.0, 1.0, 0.0)) / (pi / 2.0) - 1.0).abs() < 0.011);
        assert!((mean_area(DVec3::splat(1e6)) / (pi * 1e12) - 1.0).abs() < 1e-12);
        assert_eq!(mean_area(DVec3::ZERO), 0.0);
    }

    proptest! {
        #[test]
        fn opacity_times_area_is_conserved_below_saturation(
            offset in prop::array::uniform3(-0.1..0.1f32),
            logits in prop::array::uniform2(-9.0..-2.0f32),
        ) {
            let mut states = copies(2, [-2.0, -3.0, -5.0], [0.5, 0.5, -0.1, 0.7]);
            states.position.set_row(1, [1000.25 + offset[0], -7.125 + offset[1], 0.1 + offset[2]]);
            states.opacity_logit.plane_mut(0).copy_from_slice(&logits);
            let rule = recipe(ProxyPosition::Mean, ProxyOpacity::Area);
            let got = merge_member_states(&equal_weights(2), &states, 0, &rule, Attributes::all());
            let before: f64 = (0..2).map(|i| opacity(&states, i) * mean_area(scales(&states, i))).sum();
            let after = mean_area(DVec3::from(got.log_scale.map(f64::exp))) / (1.0 + (-got.opacity_logit).exp());
            prop_assert!((after / before - 1.0).abs() < 1e-12, "before {before}, after {after}");
        }
    }
}
