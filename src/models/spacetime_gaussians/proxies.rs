//! Proxies in the family's own parameters.
//!
//! Members are told from the center of the proxy's window, exactly; weighted means of their coefficients then give the
//! weighted mean of their states at every time. Where their windows differ, so that who is there changes with time, the path
//! is the one nearest to the weighted mean of those that are. Size and shape: second moments over the window, in axes that turn
//! with the proxy. Opacity: the amplitude of the window nearest to the opacity of the members' moment match.

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::decoder::Act;
use super::law::{FEATURES, FULL_WIDTH, Spacetime, WIDTH};
use super::motion::{SpacetimeMotion, TargetState, dot, fitted, mean, merged_window, product};
use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::merging::moments::{WeightedGaussian, align_axes, moments};
use crate::merging::proxy::merge_state;
use crate::model::{Columns, Gaussians, Raw, harmonic, opacity};
use crate::models::motion_model::{MotionModel, MotionModelFrames};
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Windows differ where one is wider by this factor than another, or off its proxy's center by half its width.
const MOST_WIDER: f64 = 1.5;
/// Part of its full height below which a window holds nothing that counts.
const OPEN: f64 = 0.05;
/// Times at which shape and opacity are compared, at most.
const SAMPLED_TIMES: usize = 12;
/// Opacities of proxies stay within [this, 1 − this].
const OPACITY_MARGIN: f64 = 1e-6;

/// A row for each of `clusters`; `act` makes colors of the full model's first features.
///
/// # Errors
/// States that cannot be evaluated.
pub(super) fn propose(
    model: &MotionModelFrames<Spacetime>,
    clusters: &[Cluster],
    rule: &MergeParams,
    act: Act,
) -> Result<Raw> {
    let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
    let mut raw = model.raw().pick(&leaders);
    let made: Vec<Raw> = clusters.par_iter().map(|cluster| proxy(model, cluster, rule, act)).collect::<Result<_>>()?;
    made.iter().enumerate().for_each(|(row, made)| raw.set_row(row, made, 0));
    Ok(raw)
}

/// The members of a cluster, with all that is asked of them again and again.
struct ClusterMembers<'a> {
    model: &'a MotionModelFrames<Spacetime>,
    raw: Raw,
    prepared: <Spacetime as MotionModel>::Prepared,
    /// Weights, and motions as they are.
    motions: Vec<(f64, SpacetimeMotion)>,
    /// Rows and weights.
    rows: Vec<(u32, f64)>,
    leader: u32,
}

impl ClusterMembers<'_> {
    fn new<'a>(model: &'a MotionModelFrames<Spacetime>, cluster: &Cluster) -> ClusterMembers<'a> {
        let ids: Vec<u32> = cluster.members.iter().map(|&(id, _)| id).collect();
        let raw = model.raw().pick(&ids);
        let rows: Vec<(u32, f64)> = (0..).zip(&cluster.members).map(|(row, &(_, weight))| (row, weight)).collect();
        let motions =
            rows.iter().map(|&(row, weight)| (weight, SpacetimeMotion::from_raw(&raw, row as usize))).collect();
        let leader = ids.iter().position(|&id| id == cluster.leader).unwrap_or(0) as u32;
        ClusterMembers { prepared: model.law().prepare(&raw), model, raw, motions, rows, leader }
    }

    fn state(&self, time: f64) -> Result<Gaussians> {
        let mut state = Gaussians::zeros(self.raw.len(), self.raw.gaussians.sh_degree());
        self.model.law().state(time, &self.raw, &self.prepared, Columns::all(), &mut state)?;
        Ok(state)
    }

    /// Times of frames at which `of` is open, evenly spread if they are many; its center where there are none.
    fn times(&self, of: &SpacetimeMotion) -> Vec<f64> {
        let times = &self.model.info().times;
        let open: Vec<f64> = times.iter().copied().filter(|&time| of.window(time) >= OPEN).collect();
        let count = open.len().min(SAMPLED_TIMES);
        match count {
            0 => vec![of.center],
            1 => open,
            _ => (0..count).map(|k| open[k * (open.len() - 1) / (count - 1)]).collect(),
        }
    }
}

fn proxy(model: &MotionModelFrames<Spacetime>, cluster: &Cluster, rule: &MergeParams, act: Act) -> Result<Raw> {
    let members = ClusterMembers::new(model, cluster);
    let (center, log_width) = merged_window(&members.motions);
    let about: Vec<(f64, SpacetimeMotion)> =
        members.motions.iter().map(|(weight, motion)| (*weight, motion.about(center))).collect();
    let mut out = members.raw.pick(&[members.leader]);
    let Some(mean) = mean(&about) else { return Ok(out) };
    let mut motion = SpacetimeMotion { center, log_width, ..mean };
    if differ(&members.motions, &motion) {
        motion = fitted(&motion, &wanted(&members, &about, &motion));
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
    if model.law().is_full {
        for plane in WIDTH..FULL_WIDTH {
            out.own.plane_mut(plane)[0] = average(&members, members.raw.own.plane(plane)) as f32;
        }
        for c in 0..3 {
            let feature = f64::from(out.own.plane(FEATURES + c)[0]);
            out.gaussians.sh.plane_mut(c)[0] = harmonic(act.apply(feature));
        }
    }
    Ok(out)
}

/// Weighted mean; alike values stay as they are.
fn average(members: &ClusterMembers<'_>, plane: &[f32]) -> f64 {
    let base = f64::from(plane[members.leader as usize]);
    base + members.rows.iter().map(|&(row, weight)| weight * (f64::from(plane[row as usize]) - base)).sum::<f64>()
}

/// Whether windows differ so much that who is there changes with time.
fn differ(members: &[(f64, SpacetimeMotion)], proxy: &SpacetimeMotion) -> bool {
    members.iter().any(|(_, member)| {
        let wider = (member.log_width - proxy.log_width).abs() > MOST_WIDER.ln();
        wider || (member.center - proxy.center).abs() > 0.5 * proxy.log_width.exp()
    })
}

/// States that a motion should be near to, quaternions in the sign of the mean's; weights change as the members' windows do.
fn wanted(members: &ClusterMembers<'_>, about: &[(f64, SpacetimeMotion)], mean: &SpacetimeMotion) -> Vec<TargetState> {
    let of_time = |&time: &f64| {
        let (mut total, mut position, mut rotation) = (0.0, [0.0; 3], [0.0; 4]);
        let near = mean.rotation(time);
        for ((weight, motion), (_, member)) in about.iter().zip(&members.motions) {
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

/// Natural logs of the proxy's scales, and its axes turned to go with them.
fn shape(members: &ClusterMembers<'_>, states: &[Gaussians], times: &[f64], motion: &mut SpacetimeMotion) -> [f64; 3] {
    let mut parts = Vec::with_capacity(members.rows.len() * times.len());
    for (state, &time) in states.iter().zip(times) {
        let (middle, axes) = (DVec3::from(motion.position(time)), quaternion(motion.rotation(time)));
        let open = motion.window(time);
        for &(row, weight) in &members.rows {
            let at = row as usize;
            let position = DVec3::from(state.position.row::<3>(at).map(f64::from));
            let own = quaternion(state.rotation.row::<4>(at).map(f64::from));
            parts.push(WeightedGaussian {
                weight: weight * open,
                position: axes.inverse() * (position - middle),
                rotation: (axes.inverse() * own).normalize(),
                scales: DVec3::from(state.log_scale.row::<3>(at).map(|log| f64::from(log).exp())),
            });
        }
    }
    let total: f64 = parts.iter().map(|part| part.weight).sum();
    parts.iter_mut().for_each(|part| part.weight /= total);
    let found = align_axes(&moments(&parts, Some(DVec3::ZERO)), DQuat::IDENTITY);
    let turn = [found.rotation.w, found.rotation.x, found.rotation.y, found.rotation.z];
    // A product is linear in either factor: a quaternion that is linear in time stays so.
    (motion.rotation, motion.omega) = (product(motion.rotation, turn), product(motion.omega, turn));
    found.scales.to_array().map(|scale| scale.max(1e-7).ln())
}

/// Unit; the identity where there is no direction.
fn quaternion([w, x, y, z]: [f64; 4]) -> DQuat {
    let found = DQuat::from_xyzw(x, y, z, w).normalize();
    if found.is_finite() { found } else { DQuat::IDENTITY }
}

/// The logit of what the window is multiplied by.
fn amplitude(
    members: &ClusterMembers<'_>,
    states: &[Gaussians],
    times: &[f64],
    motion: &SpacetimeMotion,
    rule: &MergeParams,
) -> f64 {
    let (mut of, mut by) = (0.0, 0.0);
    for (state, &time) in states.iter().zip(times) {
        let merged = merge_state(&members.rows, state, members.leader, rule, Columns::OPACITY);
        let window = motion.window(time);
        of += window * opacity(merged.opacity_logit as f32);
        by += window * window;
    }
    let found = (of / by).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    (found / (1.0 - found)).ln()
}
