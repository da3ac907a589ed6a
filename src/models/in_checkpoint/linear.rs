//! Computes path, temporal window and shape of proxies (Gaussians that replace merged ones), for models whose Gaussians
//! move along straight lines and fade with the distance in time. [`match_proxies`] computes them from the members
//! (merged Gaussians):
//!
//! - Path: the straight paths of the members are expressed around the proxy's center in time and averaged by weight.
//!   This is exact: the proxy is at the weighted mean of its members at every time.
//! - Temporal window: has the mean and the variance in time of the members' windows, each of which counts with its
//!   weight times its duration.
//! - Shape and opacity: fitted by least squares to one Gaussian at each sampled frame. It has the mean and covariance
//!   of the mixture of the members, and is called their moment match (method.md, section 5.6).

use crate::compressed_model::Cluster;
use crate::error::Result;
use crate::merging::merged_sequence::MergedSequence;
use crate::model::{Attributes, Gaussians, logit, opacity};
use crate::passes::{GAUSSIANS_PER_BLOCK, gather_all};
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Maximum number of frames at which proxies (Gaussians that replace merged ones) are fitted to the merged Gaussians.
const SAMPLED_FRAMES: usize = 48;
/// Minimum product of opacity and temporal window of a proxy (Gaussian that replaces merged ones) at a frame. Frames
/// with a smaller product are not used to fit the proxy.
const MIN_VISIBLE: f64 = 1e-4;
/// Minimum and maximum opacity of a proxy (Gaussian that replaces merged ones). They bound its opacity logit.
const OPACITY_RANGE: [f64; 2] = [1e-3, 1.0 - 1e-4];

/// Straight path with a Gaussian window in time. Position: x(t) = position + velocity·(t − center). Factor of the
/// opacity: exp(−½((t − center)/deviation)²).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(in crate::models) struct LinearPath {
    /// Position at the time `center`, scene units.
    pub(in crate::models) position: [f64; 3],
    /// Velocity, scene units per unit of time.
    pub(in crate::models) velocity: [f64; 3],
    /// Center of the window in time, where its value is 1.
    pub(in crate::models) center: f64,
    /// Standard deviation of the window in time, in the model's time unit.
    pub(in crate::models) deviation: f64,
}

impl LinearPath {
    /// Returns the weighted mean of the paths and windows of `members`. Each member is a weight, and a path with its
    /// window; the weights sum to 1.
    pub(in crate::models) fn blended(members: &[(f64, LinearPath)]) -> LinearPath {
        let total_duration: f64 = members.iter().map(|(weight, line)| weight * line.deviation).sum();
        let mean = |value_of: &dyn Fn(&LinearPath) -> f64| {
            members.iter().map(|(weight, line)| weight * line.deviation / total_duration * value_of(line)).sum::<f64>()
        };
        let center = mean(&|line| line.center);
        let variance = mean(&|line| line.deviation.powi(2) + (line.center - center).powi(2));
        let sum = |value_of: &dyn Fn(&LinearPath) -> f64| {
            members.iter().map(|(weight, line)| weight * value_of(line)).sum::<f64>()
        };
        LinearPath {
            position: [0, 1, 2].map(|c| sum(&|line| line.position[c] + line.velocity[c] * (center - line.center))),
            velocity: [0, 1, 2].map(|c| sum(&|line| line.velocity[c])),
            center,
            deviation: variance.sqrt(),
        }
    }
}

/// Path, temporal window and shape of a proxy (Gaussian that replaces others), matched to its members (the merged
/// Gaussians) over the sampled frames.
#[derive(Debug, Clone)]
pub(in crate::models) struct Matched {
    /// Path and temporal window of the proxy: the weighted mean of the paths and windows of its members (merged
    /// Gaussians), with the weights of the cluster. See [`LinearPath::blended`].
    pub(in crate::models) line: LinearPath,
    /// Opacity logit at the center of the window, and spatial covariance (xx xy xz yy yz zz). `None` if the proxy
    /// (Gaussian that replaces merged ones) is visible at no sampled frame.
    pub(in crate::models) shape: Option<(f32, [f64; 6])>,
}

/// Target state of one proxy (Gaussian that replaces merged ones) at one frame: the Gaussian with the mean and
/// covariance of the mixture of the merged Gaussians, which is called their moment match.
pub(in crate::models) struct ProxyAtFrame<'a> {
    /// Index of the cluster (merged Gaussians) that the proxy replaces.
    pub(in crate::models) proxy: usize,
    /// Path and temporal window of the proxy (Gaussian that replaces merged ones).
    pub(in crate::models) line: &'a LinearPath,
    /// Time stamp of the frame.
    pub(in crate::models) time: f64,
    /// Weight m·α of this frame in fits over the frames, such as the fit of the proxy's SH coefficients. m is the value
    /// of the proxy's temporal window at this frame: a factor of its opacity, 1 at the center of the window. α is the
    /// opacity of the target state.
    pub(in crate::models) weight: f64,
    /// Target states of a block of proxies (Gaussians that replace merged ones) at this frame, one row per proxy.
    pub(in crate::models) state: &'a Gaussians,
    /// Index in `state` of the row with the target state of this proxy.
    pub(in crate::models) row: usize,
}

/// Computes the path, temporal window and shape of one proxy (Gaussian that replaces merged ones) for each of
/// `clusters`. The caller converts them to the stored parameters of its model format, which must have linear motion. At
/// every sampled frame, a proxy has a target state: the Gaussian with the mean and covariance of the mixture of its
/// members (the merged Gaussians). The shape and opacity of the proxy are fitted to its target states.
///
/// - `line_of(id)` returns the path and window of the member `id`.
/// - `window(line, time)` returns the value of the window of `line` at `time`.
/// - `visit` is called with the target state of each proxy, at each sampled frame at which the proxy is visible. The
///   target state has the attributes `target_attributes`, and always rotation, scale and opacity.
///
/// # Errors
/// Fails if frames cannot be evaluated.
pub(in crate::models) fn match_proxies(
    source: &dyn FrameSource,
    clusters: &[Cluster],
    rule: &MergeParams,
    line_of: impl Fn(u32) -> LinearPath,
    window: impl Fn(&LinearPath, f64) -> f64,
    target_attributes: Attributes,
    mut visit: impl FnMut(ProxyAtFrame<'_>),
) -> Result<Vec<Matched>> {
    let times = &source.info().times;
    let sampled = times.len().min(SAMPLED_FRAMES);
    let frames: Vec<usize> = (0..sampled).map(|k| (2 * k + 1) * times.len() / (2 * sampled)).collect();
    let target_attributes = target_attributes | Attributes::ROTATION | Attributes::LOG_SCALE | Attributes::OPACITY;
    let mut matched = Vec::with_capacity(clusters.len());
    for (chunk, first) in clusters.chunks(GAUSSIANS_PER_BLOCK).zip((0..).step_by(GAUSSIANS_PER_BLOCK)) {
        let leaders: Vec<u32> = chunk.iter().map(|cluster| cluster.leader).collect();
        let members = chunk.iter().zip(0..).map(|(cluster, place)| (place, &cluster.members[..]));
        let merged = MergedSequence::new(source, &leaders, members, rule);
        let line = |cluster: &Cluster| {
            LinearPath::blended(&cluster.members.iter().map(|&(id, weight)| (weight, line_of(id))).collect::<Vec<_>>())
        };
        let lines: Vec<LinearPath> = chunk.iter().map(line).collect();
        let mut sums = vec![FrameSums::default(); chunk.len()];
        for &frame in &frames {
            let (time, state) = (times[frame], gather_all(&merged, frame, target_attributes)?);
            for (row, (line, sums)) in lines.iter().zip(&mut sums).enumerate() {
                let (m, alpha) = (window(line, time), opacity(state.opacity_logit.row::<1>(row)[0]));
                let weight = m * alpha;
                if weight > MIN_VISIBLE {
                    sums.add(m, alpha, &state, row);
                    visit(ProxyAtFrame { proxy: first + row, line, time, weight, state: &state, row });
                }
            }
        }
        matched.extend(lines.iter().zip(&sums).map(|(&line, sums)| Matched { line, shape: sums.mean() }));
    }
    Ok(matched)
}

/// Sums over the sampled frames for one proxy (Gaussian that replaces merged ones), from which its opacity and
/// covariance are computed. At each frame, m is the value of the proxy's temporal window, and α is the opacity of its
/// target state (see [`ProxyAtFrame`]).
#[derive(Debug, Clone, Default)]
struct FrameSums {
    /// Sum over the frames of m·α, the window times the opacity.
    product: f64,
    /// Sum over the frames of m², the square of the window.
    square: f64,
    /// Sum over the frames of the spatial covariance of the target state, weighted by m·α (window times opacity).
    covariance: [f64; 6],
}

impl FrameSums {
    /// Adds one frame to the sums from which opacity and covariance of a proxy (Gaussian that replaces merged ones) are
    /// computed.
    /// - `m`: value of the proxy's temporal window at this frame.
    /// - `alpha`: opacity of the proxy's target state, the Gaussian with the mean and covariance of the mixture of the
    ///   merged Gaussians.
    /// - `state`, `row`: the target state is row `row` of `state`.
    fn add(&mut self, m: f64, alpha: f64, state: &Gaussians, row: usize) {
        self.product += m * alpha;
        self.square += m * m;
        let scales = state.scales_f64(row);
        let values = covariance(scales, state.rotation_f64(row));
        self.covariance.iter_mut().zip(values).for_each(|(sum, value)| *sum += m * alpha * value);
    }

    /// Returns the opacity logit at the center of the temporal window, and the covariance (xx, xy, xz, yy, yz, zz), of
    /// the proxy (Gaussian that replaces merged ones). The opacity is Σ m·α / Σ m², limited to [`OPACITY_RANGE`]. The
    /// covariance is the mean with the weights m·α. Returns `None` if no frame was added.
    fn mean(&self) -> Option<(f32, [f64; 6])> {
        let visible = (self.product / self.square).clamp(OPACITY_RANGE[0], OPACITY_RANGE[1]);
        let found = (logit(visible) as f32, self.covariance.map(|sum| sum / self.product));
        (self.product > 0.0).then_some(found)
    }
}

/// Returns the covariance R diag(s)² Rᵀ as xx xy xz yy yz zz, for the scales s and the rotation R of a quaternion wxyz.
/// The quaternion may have any length; length 0 counts as the identity.
pub(in crate::models) fn covariance(scales: [f64; 3], quaternion: [f64; 4]) -> [f64; 6] {
    let length = quaternion.iter().map(|x| x * x).sum::<f64>().sqrt();
    let [w, x, y, z] = if length > 0.0 { quaternion.map(|c| c / length) } else { [1.0, 0.0, 0.0, 0.0] };
    let rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let entry = |i: usize, j: usize| (0..3).map(|k| rows[i][k] * rows[j][k] * scales[k].powi(2)).sum();
    [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blended_path_is_the_weighted_mean_at_every_time() {
        let line = |k: f64| LinearPath {
            position: [k, 1.0 - k * k, 0.3],
            velocity: [0.2 * k, -1.0 / (1.0 + k), 5.0],
            center: 0.1 * k,
            deviation: 0.05 + 0.02 * k,
        };
        let members = [(0.5, line(1.0)), (0.2, line(2.5)), (0.3, line(-0.7))];
        let blended = LinearPath::blended(&members);
        for k in 0..20 {
            let time = -0.5 + 0.1 * f64::from(k);
            for c in 0..3 {
                let at = |line: &LinearPath| line.position[c] + line.velocity[c] * (time - line.center);
                let mean: f64 = members.iter().map(|(weight, line)| weight * at(line)).sum();
                assert!((at(&blended) - mean).abs() < 1e-12, "{time} {c}: {} {mean}", at(&blended));
            }
        }
        // The path of a single member, or of equal members, is returned unchanged.
        assert_eq!(LinearPath::blended(&[(1.0, line(2.0))]), line(2.0));
        let twice = LinearPath::blended(&[(0.25, line(2.0)), (0.75, line(2.0))]);
        assert!((twice.deviation - line(2.0).deviation).abs() < 1e-15 && (twice.center - 0.2).abs() < 1e-15);
    }
}
