//! Computes proxies (Gaussians that replace merged ones) with stored parameters of SpacetimeGaussians.
//!
//! The motions of the members (merged Gaussians) are expressed around the center of the proxy's temporal window, which
//! is exact. The weighted mean of their coefficients then gives the weighted mean of their states at every time. If
//! their windows differ, so that different members are visible at different times, the path is a least-squares fit to
//! the weighted mean of the visible members. Size and shape are second moments over the window, in axes that rotate
//! with the proxy. The opacity is the amplitude of the window that best fits the opacity of the members' moment match
//! (the Gaussian with the mean and covariance of their mixture).

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::decoder::ColorActivation;
use super::frame_state::{FIRST_FEATURE, FULL_PARAM_COUNT, SHARED_PARAM_COUNT, Spacetime};
use super::motion::{SpacetimeMotion, TargetState, dot, fitted, mean, merged_window, product};
use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::merging::moments::{WeightedGaussian, moments, reorder_axes_to_match};
use crate::merging::proxy::merge_member_states;
use crate::model::{Attributes, Gaussians, StoredParams, opacity, sh_from_color};
use crate::models::motion_model::{MotionModel, MotionModelFrames};
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Maximum ratio between the widths of the temporal windows of a proxy (Gaussian that replaces merged ones) and of a
/// member (merged Gaussian) that count as similar. The windows count as different if the ratio is larger, or if their
/// centers are further apart than half of the width of the proxy's window.
const MAX_WIDTH_RATIO: f64 = 1.5;
/// Minimum value of a temporal window, whose maximum is 1. Times at which its value is smaller are ignored.
const MIN_WINDOW: f64 = 0.05;
/// Maximum number of points in time at which shape and opacity of a proxy (Gaussian that replaces merged ones) are
/// compared with those of the merged Gaussians.
const SAMPLED_TIMES: usize = 12;
/// Minimum distance of the opacity of a proxy (Gaussian that replaces merged ones) from 0 and from 1, so that its logit
/// is finite.
const OPACITY_MARGIN: f64 = 1e-6;

/// Computes the stored parameters of one proxy (Gaussian that replaces merged ones) for each of `clusters`.
/// `activation` turns the first three features of the full model into colors.
///
/// # Errors
/// Fails if states cannot be evaluated.
pub(super) fn propose(
    model: &MotionModelFrames<Spacetime>,
    clusters: &[Cluster],
    rule: &MergeParams,
    activation: ColorActivation,
) -> Result<StoredParams> {
    let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
    let mut raw = model.raw().pick(&leaders);
    let made: Vec<StoredParams> =
        clusters.par_iter().map(|cluster| proxy_parameters(model, cluster, rule, activation)).collect::<Result<_>>()?;
    made.iter().enumerate().for_each(|(row, made)| raw.set_row(row, made, 0));
    Ok(raw)
}

/// Members of a cluster (Gaussians to be merged), with values that are used repeatedly.
struct ClusterMembers<'a> {
    model: &'a MotionModelFrames<Spacetime>,
    raw: StoredParams,
    prepared: <Spacetime as MotionModel>::Prepared,
    /// For each member its weight in the proxy (Gaussian that replaces the members), and its motion.
    motions: Vec<(f64, SpacetimeMotion)>,
    /// For each member its row in `raw`, and its weight in the proxy (Gaussian that replaces the members).
    rows: Vec<(u32, f64)>,
    /// Row in `raw` of the leader, the member to which the others were joined.
    leader: u32,
}

impl ClusterMembers<'_> {
    /// Collects the members of `cluster` (Gaussians to be merged) from `model`.
    fn new<'a>(model: &'a MotionModelFrames<Spacetime>, cluster: &Cluster) -> ClusterMembers<'a> {
        let ids: Vec<u32> = cluster.members.iter().map(|&(id, _)| id).collect();
        let raw = model.raw().pick(&ids);
        let rows: Vec<(u32, f64)> = (0..).zip(&cluster.members).map(|(row, &(_, weight))| (row, weight)).collect();
        let motions =
            rows.iter().map(|&(row, weight)| (weight, SpacetimeMotion::from_raw(&raw, row as usize))).collect();
        let leader = ids.iter().position(|&id| id == cluster.leader).unwrap_or(0) as u32;
        ClusterMembers { prepared: model.motion_model().prepare(&raw), model, raw, motions, rows, leader }
    }

    /// Returns the states of all members (Gaussians to be merged) at `time`, one row per member.
    fn state(&self, time: f64) -> Result<Gaussians> {
        let mut state = Gaussians::zeros(self.raw.len(), self.raw.gaussians.sh_degree());
        self.model.motion_model().state(time, &self.raw, &self.prepared, Attributes::all(), &mut state)?;
        Ok(state)
    }

    /// Returns up to [`SAMPLED_TIMES`] frame times, evenly spread, at which the window of `motion` is at least
    /// [`MIN_WINDOW`]; the center of the window if there are none.
    fn times(&self, motion: &SpacetimeMotion) -> Vec<f64> {
        let times = &self.model.info().times;
        let open: Vec<f64> = times.iter().copied().filter(|&time| motion.window(time) >= MIN_WINDOW).collect();
        let count = open.len().min(SAMPLED_TIMES);
        match count {
            0 => vec![motion.center],
            1 => open,
            _ => (0..count).map(|k| open[k * (open.len() - 1) / (count - 1)]).collect(),
        }
    }
}

/// Computes the stored parameters of one proxy, the Gaussian that replaces the members of `cluster`, as a single row.
/// `activation` turns the first three features of the full model into colors.
fn proxy_parameters(
    model: &MotionModelFrames<Spacetime>,
    cluster: &Cluster,
    rule: &MergeParams,
    activation: ColorActivation,
) -> Result<StoredParams> {
    let members = ClusterMembers::new(model, cluster);
    let (center, log_width) = merged_window(&members.motions);
    let recentered: Vec<(f64, SpacetimeMotion)> =
        members.motions.iter().map(|(weight, motion)| (*weight, motion.recentered(center))).collect();
    let mut out = members.raw.pick(&[members.leader]);
    let Some(mean) = mean(&recentered) else { return Ok(out) };
    let mut motion = SpacetimeMotion { center, log_width, ..mean };
    if windows_differ(&members.motions, &motion) {
        motion = fitted(&motion, &target_states(&members, &recentered, &motion));
    }
    let times = members.times(&motion);
    let states: Vec<Gaussians> = times.iter().map(|&time| members.state(time)).collect::<Result<_>>()?;
    let log_scale = shape(&members, &states, &times, &mut motion);
    let logit = amplitude(&members, &states, &times, &motion, rule);
    motion.write(&mut out, 0);
    out.gaussians.log_scale.set_row(0, log_scale.map(|x| x as f32));
    out.gaussians.opacity_logit.set_row(0, [logit as f32]);
    for c in 0..3 {
        let plane = members.raw.gaussians.sh.plane(c);
        out.gaussians.sh.plane_mut(c)[0] = average(&members, plane) as f32;
    }
    if model.motion_model().is_full {
        for plane in SHARED_PARAM_COUNT..FULL_PARAM_COUNT {
            out.format_specific.plane_mut(plane)[0] =
                average(&members, members.raw.format_specific.plane(plane)) as f32;
        }
        for c in 0..3 {
            let feature = f64::from(out.format_specific.plane(FIRST_FEATURE + c)[0]);
            out.gaussians.sh.plane_mut(c)[0] = sh_from_color(activation.apply(feature));
        }
    }
    Ok(out)
}

/// Returns the mean of a parameter over the members of a cluster (Gaussians to be merged), by weight. `plane` holds the
/// value of the parameter for each member. If all values are equal, the result is exactly this value.
fn average(members: &ClusterMembers<'_>, plane: &[f32]) -> f64 {
    let base = f64::from(plane[members.leader as usize]);
    base + members.rows.iter().map(|&(row, weight)| weight * (f64::from(plane[row as usize]) - base)).sum::<f64>()
}

/// Returns whether the temporal windows of `members` differ so much from that of `proxy`, the motion of the Gaussian
/// that replaces them, that different members are visible at different times. Each member is a weight and a motion.
fn windows_differ(members: &[(f64, SpacetimeMotion)], proxy: &SpacetimeMotion) -> bool {
    members.iter().any(|(_, member)| {
        let wider = (member.log_width - proxy.log_width).abs() > MAX_WIDTH_RATIO.ln();
        wider || (member.center - proxy.center).abs() > 0.5 * proxy.log_width.exp()
    })
}

/// Returns the states that a proxy (Gaussian that replaces `members`) should approximate, one per frame. A state is the
/// mean of the members' states; the weight of a member is its weight in the proxy times the value of its temporal
/// window. Frames at which all windows are 0 have no state. `recentered` holds for each member its weight, and its
/// motion expressed around the center of the proxy. Each quaternion gets the sign that brings it nearest to the
/// quaternion of the motion `mean`.
fn target_states(
    members: &ClusterMembers<'_>,
    recentered: &[(f64, SpacetimeMotion)],
    mean: &SpacetimeMotion,
) -> Vec<TargetState> {
    let of_time = |&time: &f64| {
        let (mut total, mut position, mut rotation) = (0.0, [0.0; 3], [0.0; 4]);
        let near = mean.rotation(time);
        for ((weight, motion), (_, member)) in recentered.iter().zip(&members.motions) {
            let weight = weight * member.window(time);
            let (x, q) = (motion.position(time), motion.rotation(time));
            let sign = if dot(&q, &near) < 0.0 { -weight } else { weight };
            total += weight;
            (0..3).for_each(|c| position[c] += weight * x[c]);
            (0..4).for_each(|c| rotation[c] += sign * q[c]);
        }
        (total > 0.0).then(|| TargetState {
            time,
            weight: total,
            position: position.map(|x| x / total),
            rotation: rotation.map(|x| x / total),
        })
    };
    members.model.info().times.iter().filter_map(of_time).collect()
}

/// Returns the natural logarithms of the scales of the proxy (Gaussian that replaces `members`), and sets the rotation
/// of `motion` to the axes along which these scales are measured. `states` holds the states of the members at each of
/// `times`.
fn shape(members: &ClusterMembers<'_>, states: &[Gaussians], times: &[f64], motion: &mut SpacetimeMotion) -> [f64; 3] {
    let mut parts = Vec::with_capacity(members.rows.len() * times.len());
    for (state, &time) in states.iter().zip(times) {
        let (middle, axes) = (DVec3::from(motion.position(time)), quaternion(motion.rotation(time)));
        let open = motion.window(time);
        for &(row, weight) in &members.rows {
            let at = row as usize;
            let position = DVec3::from(state.position_f64(at));
            let own = quaternion(state.rotation_f64(at));
            parts.push(WeightedGaussian {
                weight: weight * open,
                position: axes.inverse() * (position - middle),
                rotation: (axes.inverse() * own).normalize(),
                scales: DVec3::from(state.scales_f64(at)),
            });
        }
    }
    let total: f64 = parts.iter().map(|part| part.weight).sum();
    parts.iter_mut().for_each(|part| part.weight /= total);
    let found = reorder_axes_to_match(&moments(&parts, Some(DVec3::ZERO)), DQuat::IDENTITY);
    let turn = [found.rotation.w, found.rotation.x, found.rotation.y, found.rotation.z];
    // The product of two quaternions is linear in each factor, so the quaternion stays linear in time.
    (motion.rotation, motion.omega) = (product(motion.rotation, turn), product(motion.omega, turn));
    found.scales.to_array().map(|scale| scale.max(1e-7).ln())
}

/// Returns the quaternion (w, x, y, z) scaled to length 1; the identity if its length is 0 or not finite.
fn quaternion([w, x, y, z]: [f64; 4]) -> DQuat {
    let found = DQuat::from_xyzw(x, y, z, w).normalize();
    if found.is_finite() { found } else { DQuat::IDENTITY }
}

/// Returns the logit of the opacity of the proxy (Gaussian that replaces `members`) at the center of its temporal
/// window. This opacity is the factor with which the window of `motion` best fits (least squares) the opacity of the
/// members' moment match (the Gaussian with the mean and covariance of their mixture) at `times`. `states` holds the
/// states of the members at each of `times`.
fn amplitude(
    members: &ClusterMembers<'_>,
    states: &[Gaussians],
    times: &[f64],
    motion: &SpacetimeMotion,
    rule: &MergeParams,
) -> f64 {
    let (mut of, mut by) = (0.0, 0.0);
    for (state, &time) in states.iter().zip(times) {
        let merged = merge_member_states(&members.rows, state, members.leader, rule, Attributes::OPACITY);
        let window = motion.window(time);
        of += window * opacity(merged.opacity_logit as f32);
        by += window * window;
    }
    let found = (of / by).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    (found / (1.0 - found)).ln()
}
