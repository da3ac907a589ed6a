//! Computes proxies (Gaussians that replace merged ones) that have stored parameters of a model format, and compares
//! them with the moment match of the merged Gaussians (the Gaussian with the mean and covariance of their mixture).

use super::{MotionModel, MotionModelFrames};
use crate::compressed_model::{Cluster, Proxies, ReferenceFrame};
use crate::error::Result;
use crate::fit::MIN_VISIBLE_OPACITY;
use crate::merging::merged_sequence::MergedSequence;
use crate::model::{Attributes, StoredParams, opacity};
use crate::passes::gather_all;
use crate::recipe::MergeParams;
use crate::source::FrameSource;

/// Maximum difference in opacity, at any frame, between a proxy (Gaussian that replaces merged ones) and the moment
/// match of its members (the Gaussian with the mean and covariance of the merged Gaussians).
const MAX_OPACITY_DIFFERENCE: f64 = 0.1;

/// Computes a proxy (Gaussian that replaces merged ones) for each of `clusters`, and refuses those that do not move
/// like their members. `propose` returns the stored parameters of the proxies, one row per cluster. At every frame, a
/// proxy is compared with the moment match of its members (the Gaussian with the mean and covariance of their mixture);
/// frames in which both are invisible are skipped. A proxy is refused if at any frame they differ by
/// - more than `max_drift` in position (if it is relative, it refers to the extent of `reference`), or
/// - more than 0.1 in opacity.
///
/// # Errors
/// Fails if `propose` fails or frames cannot be evaluated.
pub(in crate::models) fn propose_proxies<L: MotionModel>(
    model: &MotionModelFrames<L>,
    clusters: &[Cluster],
    reference: ReferenceFrame,
    rule: &MergeParams,
    propose: impl FnOnce(&[Cluster]) -> Result<StoredParams>,
) -> Result<Proxies> {
    if clusters.is_empty() {
        return Ok(Proxies::default());
    }
    let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
    let members = clusters.iter().zip(0..).map(|(cluster, place)| (place, &cluster.members[..]));
    let wanted = MergedSequence::new(model, &leaders, members, rule);
    let made = model.with_raw(propose(clusters)?);
    let drift = rule.max_drift * rule.length_unit.in_scene_units(reference.extent);
    let mut furthest = vec![0.0f64; clusters.len()];
    let mut drifts = vec![false; clusters.len()];
    let compared = Attributes::POSITION | Attributes::OPACITY;
    for frame in 0..model.info().times.len() {
        let (wanted, made) = (gather_all(&wanted, frame, compared)?, gather_all(&made, frame, compared)?);
        for proxy in 0..clusters.len() {
            let [a, b] = [&wanted, &made].map(|state| opacity(state.opacity_logit.row::<1>(proxy)[0]));
            if a.max(b) < MIN_VISIBLE_OPACITY {
                continue;
            }
            let [to, from] = [&wanted, &made].map(|state| state.position_f64(proxy));
            let distance = to.iter().zip(from).map(|(to, from)| (to - from).powi(2)).sum::<f64>().sqrt();
            // The comparison is false for values that are not finite.
            drifts[proxy] |= !(distance <= drift && (a - b).abs() <= MAX_OPACITY_DIFFERENCE);
            furthest[proxy] = furthest[proxy].max(distance);
        }
    }
    let refused: Vec<usize> = (0..clusters.len()).filter(|&proxy| drifts[proxy]).collect();
    let accepted = furthest.iter().zip(&drifts).filter(|(_, drifts)| !**drifts).map(|(furthest, _)| *furthest);
    let mut notes = Vec::new();
    if !refused.is_empty() {
        notes.push(format!(
            "{} of {} clusters were reduced to their leaders: no Gaussian of this model moves like the whole cluster",
            refused.len(),
            clusters.len()
        ));
    }
    Ok(Proxies { raw: Some(made.raw().clone()), refused, deviation: accepted.reduce(f64::max), notes })
}
