//! Computes proxies (Gaussians that replace merged ones) for models where a network deforms the Gaussians.
//!
//! The network's output depends on the canonical position of a Gaussian, so the position of a proxy is searched for and
//! not averaged. Candidates are the positions of the members (merged Gaussians) with the largest weights, and the mean
//! of all members. The target at a frame is the moment match of the members: the Gaussian with the mean and covariance
//! of their mixture. The candidate whose path is nearest to the target is improved by Gauss-Newton steps. Scale and
//! rotation are then the target values minus the network's output at that position, on average over sampled frames.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{MIN_SCALE, NetworkMotionModel, heaviest};
use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::merging::merged_sequence::MergedSequence;
use crate::model::{Attributes, Gaussians, StoredParams, logit, opacity};
use crate::models::motion_model::MotionModelFrames;
use crate::passes::gather_all;
use crate::recipe::MergeParams;
use crate::source::{Deformation, FrameSource};

/// Maximum number of frames at which a proxy (Gaussian that replaces merged ones) is compared with its target state.
const SAMPLED_FRAMES: usize = 16;
/// Maximum number of members of a cluster (merged Gaussians) whose positions are tried as the position of the proxy,
/// the Gaussian that replaces the cluster. The mean of all members is tried as well.
const MAX_CANDIDATES: usize = 4;
/// Number of Gauss-Newton steps that improve the position of a proxy (Gaussian that replaces merged ones).
const STEPS: usize = 2;
/// Number of times that scale and rotation of a proxy (Gaussian that replaces merged ones) are corrected toward its
/// target state.
const CORRECTIONS: usize = 3;
/// Damping of a Gauss-Newton step: this fraction of the mean diagonal element of the normal matrix is added to each
/// diagonal element. The damping hardly changes the step if the normal matrix is well conditioned, for example if the
/// position moves alike in all frames. It shortens the step if the matrix is badly conditioned.
const DAMPING: f64 = 1e-3;

/// Returns the stored parameters of one proxy (Gaussian that replaces merged ones) for each of `clusters`, one row
/// each. A proxy approximates the motion of the members of its cluster (the merged Gaussians).
///
/// # Errors
/// Fails if frames cannot be evaluated.
pub(super) fn propose<L: NetworkMotionModel>(
    model: &MotionModelFrames<L>,
    clusters: &[Cluster],
    rule: &MergeParams,
) -> Result<StoredParams> {
    let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
    let members = clusters.iter().zip(0..).map(|(cluster, position)| (position, &cluster.members[..]));
    let wanted = MergedSequence::new(model, &leaders, members, rule);
    let count = model.info().times.len();
    let sampled = count.min(SAMPLED_FRAMES);
    let frames: Vec<usize> =
        (0..sampled).map(|k| if sampled < 2 { 0 } else { k * (count - 1) / (sampled - 1) }).collect();
    let of_frame = |(k, &frame): (usize, &usize)| {
        let constant = if k == 0 { Attributes::SH } else { Attributes::empty() };
        gather_all(&wanted, frame, Attributes::all().difference(Attributes::SH) | constant)
    };
    let wanted: Vec<Gaussians> = frames.iter().enumerate().map(of_frame).collect::<Result<_>>()?;

    let (mut candidates, mut candidate_rows) = (Vec::new(), Vec::new());
    let mut features = Vec::new();
    for cluster in clusters {
        let first = candidates.len();
        let mut by_weight = cluster.members.clone();
        by_weight.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        by_weight.truncate(MAX_CANDIDATES);
        candidates.extend(by_weight.into_iter().map(|(id, _)| id));
        // The position of the last candidate is set to the mean of the members below.
        candidates.push(cluster.leader);
        candidate_rows.push(first..candidates.len());
        features.resize(candidates.len(), heaviest(cluster));
    }
    let mut candidate_params = model.raw().pick(&candidates);
    candidate_params.format_specific = model.raw().format_specific.pick(&features);
    for (cluster, rows) in clusters.iter().zip(&candidate_rows) {
        let mut mean = DVec3::ZERO;
        for &(id, weight) in &cluster.members {
            mean += weight * position(&model.raw().gaussians, id as usize);
        }
        candidate_params.gaussians.position.set_row(rows.end - 1, mean.as_vec3().to_array());
    }
    let cluster_of_candidate: Vec<usize> =
        (0..clusters.len()).flat_map(|c| candidate_rows[c].clone().map(move |_| c)).collect();
    let off =
        squared_distances(model, &candidate_params, &frames, |k, row| position(&wanted[k], cluster_of_candidate[row]))?;
    let best: Vec<u32> = candidate_rows
        .iter()
        .map(|rows| rows.clone().fold(rows.start, |best, row| if off[row] < off[best] { row } else { best }) as u32)
        .collect();
    let mut made = candidate_params.pick(&best);
    let mut least: Vec<f64> = best.iter().map(|&row| off[row as usize]).collect();

    for _ in 0..STEPS {
        let better = gauss_newton_step(model, &made, &frames, &wanted)?;
        let found = squared_distances(model, &better, &frames, |k, row| position(&wanted[k], row))?;
        for (row, (least, found)) in least.iter_mut().zip(found).enumerate() {
            if found < *least {
                *least = found;
                made.set_row(row, &better, row);
            }
        }
    }
    fit_parameters(model, &mut made, &leaders, &frames, &wanted)?;
    Ok(made)
}

/// Returns the position of the Gaussian in row `row` of `state`.
fn position(state: &Gaussians, row: usize) -> DVec3 {
    DVec3::from(state.position_f64(row))
}

/// Returns for each Gaussian of `raw` (stored parameters) the sum over `frames` of the squared distance between the
/// position that `model` computes and a target position, in scene units squared. `targets(k, row)` returns the target
/// position of the Gaussian in row `row` at frame `frames[k]`.
fn squared_distances<L: NetworkMotionModel>(
    model: &MotionModelFrames<L>,
    raw: &StoredParams,
    frames: &[usize],
    targets: impl Fn(usize, usize) -> DVec3,
) -> Result<Vec<f64>> {
    let (mut off, mut state) = (vec![0.0; raw.len()], Gaussians::zeros(0, 0));
    let gaussians = model.with_params(raw);
    for (k, &frame) in frames.iter().enumerate() {
        gaussians.state(frame, Attributes::POSITION, &mut state)?;
        for (row, off) in off.iter_mut().enumerate() {
            *off += (position(&state, row) - targets(k, row)).length_squared();
        }
    }
    Ok(off)
}

/// Returns the stored parameters `raw` of proxies (Gaussians that replace merged ones) with other positions. The
/// position of every proxy is moved by one Gauss-Newton step, which brings its path nearer to its target. `targets`
/// holds the target states of all proxies, one entry for each of `frames`.
fn gauss_newton_step<L: NetworkMotionModel>(
    model: &MotionModelFrames<L>,
    raw: &StoredParams,
    frames: &[usize],
    targets: &[Gaussians],
) -> Result<StoredParams> {
    let mut sums = vec![(DMat3::ZERO, DVec3::ZERO); raw.len()];
    let mut state = Gaussians::zeros(0, 0);
    let gaussians = model.with_params(raw);
    for (&frame, target) in frames.iter().zip(targets) {
        gaussians.state(frame, Attributes::POSITION, &mut state)?;
        let slopes = gaussians.jacobian(frame, Attributes::POSITION)?;
        let slopes = slopes.derivative(Attributes::POSITION);
        for (row, (matrix, vector)) in sums.iter_mut().enumerate() {
            // Plane 3·i + j holds the derivative of component i by component j, so reading columns gives the transpose.
            let transposed = DMat3::from_cols_array(&slopes.row::<9>(row).map(f64::from));
            *matrix += transposed * transposed.transpose();
            *vector += transposed * (position(target, row) - position(&state, row));
        }
    }
    let mut better = raw.clone();
    for (row, (matrix, vector)) in sums.into_iter().enumerate() {
        let mean = (matrix.x_axis.x + matrix.y_axis.y + matrix.z_axis.z) / 3.0;
        let by = (matrix + DMat3::from_diagonal(DVec3::splat(DAMPING * mean))).inverse() * vector;
        if by.is_finite() {
            let moved = position(&raw.gaussians, row) + by;
            better.gaussians.position.set_row(row, moved.as_vec3().to_array());
        }
    }
    Ok(better)
}

/// Fits the rotation, scale, opacity and SH coefficients of proxies (Gaussians that replace merged clusters), so that
/// their states come close to target states, and writes them to `proxies`. Positions are kept.
/// - `leaders`: id of the most important member of each cluster.
/// - `frames`: frames at which states are compared.
/// - `targets`: for each of these frames, the target states of all proxies.
///
/// The parameters start as those of the leaders. Then they are corrected [`CORRECTIONS`] times: the difference between
/// the target and the state of the proxy, averaged over `frames`, is added. One correction suffices if the network's
/// output is simply added; quaternions that are not normalized need several. Each proxy keeps the scale and rotation of
/// the correction with the smallest difference from the target.
fn fit_parameters<L: NetworkMotionModel>(
    model: &MotionModelFrames<L>,
    proxies: &mut StoredParams,
    leaders: &[u32],
    frames: &[usize],
    targets: &[Gaussians],
) -> Result<()> {
    let raw = &model.raw().gaussians;
    (proxies.gaussians.rotation, proxies.gaussians.log_scale) =
        (raw.rotation.pick(leaders), raw.log_scale.pick(leaders));
    (proxies.gaussians.opacity_logit, proxies.gaussians.sh) = (raw.opacity_logit.pick(leaders), raw.sh.pick(leaders));
    let (mut best, mut least) = (proxies.clone(), vec![f64::INFINITY; proxies.len()]);
    let share = 1.0 / frames.len().max(1) as f64;
    for correction in 0..=CORRECTIONS {
        let mut all = vec![StateDifference::default(); proxies.len()];
        let mut state = Gaussians::zeros(0, raw.sh_degree());
        for (&frame, target) in frames.iter().zip(targets) {
            model.with_params(proxies).state(frame, Attributes::all(), &mut state)?;
            all.par_iter_mut().enumerate().for_each(|(row, sum)| sum.add_frame(target, &state, row));
            if target.sh.len() == proxies.len() {
                // SH coefficients are compared at one frame only: their change over time is the same at all frames.
                for c in 0..state.sh.width() {
                    let more = target.sh.plane(c).iter().zip(state.sh.plane(c)).map(|(to, from)| to - from);
                    proxies.gaussians.sh.plane_mut(c).iter_mut().zip(more).for_each(|(of, more)| *of += more);
                }
            }
        }
        for (row, sum) in all.iter().enumerate() {
            if sum.off < least[row] {
                least[row] = sum.off;
                best.set_row(row, proxies, row);
            }
            if correction < CORRECTIONS {
                sum.apply::<L>(share, &mut proxies.gaussians, row);
            }
        }
    }
    // Opacities and SH coefficients agree with the target after the first correction.
    (proxies.gaussians.rotation, proxies.gaussians.log_scale) = (best.gaussians.rotation, best.gaussians.log_scale);
    Ok(())
}

/// Differences between the target and the actual state of one proxy (Gaussian that replaces merged ones), target minus
/// actual, each summed over frames: of the scales (scene units), of the quaternions and of the opacities. In the
/// difference of quaternions, both have the length of the actual one.
#[derive(Clone, Copy, Default)]
struct StateDifference {
    scale: [f64; 3],
    rotation: [f64; 4],
    opacity: f64,
    /// Sum over frames and components of the squared differences between target and actual state, in log scales and in
    /// unit quaternions.
    off: f64,
}

impl StateDifference {
    /// Adds one frame to the sums of one proxy (Gaussian that replaces a merged cluster). Its target state at this
    /// frame is row `row` of `target`, its actual state is row `row` of `state`.
    fn add_frame(&mut self, target: &Gaussians, state: &Gaussians, row: usize) {
        let [to, from] = [target, state].map(|state| state.log_scale.row::<3>(row).map(f64::from));
        for c in 0..3 {
            self.scale[c] += to[c].exp() - from[c].exp();
            self.off += (to[c] - from[c]).powi(2);
        }
        let [to, from] = [target, state].map(|state| state.rotation_f64(row));
        let [wide, long] = [to, from].map(|q| q.iter().map(|x| x * x).sum::<f64>().sqrt());
        let sign = 1f64.copysign((0..4).map(|c| to[c] * from[c]).sum());
        for c in 0..4 {
            let lacks = sign * to[c] / wide - from[c] / long;
            self.rotation[c] += long * lacks;
            self.off += lacks * lacks;
        }
        let [to, from] = [target, state].map(|state| opacity(state.opacity_logit.plane(0)[row]));
        self.opacity += to - from;
    }

    /// Adds the mean difference per frame to the stored parameters of the proxy (Gaussian that replaces a merged
    /// cluster) in row `row` of `to`. `share` is 1 divided by the number of added frames.
    fn apply<L: NetworkMotionModel>(&self, share: f64, to: &mut Gaussians, row: usize) {
        let scale = to.scales_f64(row);
        let scale = [0, 1, 2].map(|c| (scale[c] + share * self.scale[c]).max(MIN_SCALE).ln() as f32);
        to.log_scale.set_row(row, scale);
        let own = to.rotation_f64(row);
        // If stored quaternions are normalized first, the correction is multiplied by their length.
        let long = if L::NORMALIZES_ROTATION { own.iter().map(|x| x * x).sum::<f64>().sqrt() } else { 1.0 };
        let rotation = [0, 1, 2, 3].map(|c| (own[c] + long * share * self.rotation[c]) as f32);
        if rotation.iter().all(|x| x.is_finite()) {
            to.rotation.set_row(row, rotation);
        }
        let alpha = (opacity(to.opacity_logit.plane(0)[row]) + share * self.opacity).clamp(1e-6, 1.0 - 1e-6);
        // An opacity without a difference keeps its exact bits.
        if self.opacity != 0.0 {
            to.opacity_logit.set_row(row, [logit(alpha) as f32]);
        }
    }
}
