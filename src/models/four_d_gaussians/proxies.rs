//! Computes proxies (Gaussians that replace merged ones) for a model with a deformation field. The stored parameters of
//! a proxy are chosen such that its state at the reference frame is the merged state of its members (method.md, section
//! 5.6).

use super::ModelFolder;
use crate::compressed_model::{Cluster, Proxies, ReferenceFrame};
use crate::deform::Deltas;
use crate::error::Result;
use crate::merging::proxy::merge_member_states;
use crate::model::{Attributes, Gaussians};
use crate::passes::{GAUSSIANS_PER_BLOCK, gather};
use crate::recipe::{MergeParams, ProxyPosition};
use crate::source::FrameSource;

/// Maximum number of frames at which a proxy is compared with its members (the Gaussians that it replaces).
const SAMPLED_FRAMES: usize = 16;

/// Returns the stored parameters of one proxy (Gaussian that replaces merged ones) for each of `clusters`. The
/// parameters are the merged state of the cluster at the reference frame, minus the changes (deltas) that the field
/// makes at this frame to the leader, the most important member of the cluster. `merge` selects whether a proxy is
/// placed at the mean of its members or at the canonical position of its leader.
///
/// Two kinds of proxies get other parameters:
/// - A proxy at the mean may drift away from its members, because the field moves it differently. If the distance
///   exceeds `max_drift` of `merge`, the proxy is placed at the canonical position of its leader; its other parameters
///   stay the same.
/// - A proxy with a parameter that is not finite gets all parameters of its leader.
///
/// # Errors
/// Fails if frames cannot be evaluated.
pub(super) fn compute_proxies(
    model: &ModelFolder,
    clusters: &[Cluster],
    reference: ReferenceFrame,
    merge: &MergeParams,
) -> Result<Proxies> {
    let leaders: Vec<u32> = clusters.iter().map(|cluster| cluster.leader).collect();
    let of_leaders = model.canonical().pick(&leaders);
    let mut raw = of_leaders.clone();
    let mut notes = Vec::new();
    if leaders.is_empty() {
        return Ok(Proxies { raw: Some(raw.into()), notes, ..Proxies::default() });
    }
    // A proxy placed at its leader has exactly the canonical position of the leader, and so the same path.
    let solved = match merge.placement {
        ProxyPosition::Mean => Attributes::all(),
        ProxyPosition::Leader => Attributes::all().difference(Attributes::POSITION),
    };
    for (block, first) in clusters.chunks(GAUSSIANS_PER_BLOCK).zip((0..).step_by(GAUSSIANS_PER_BLOCK)) {
        let of_leaders = model.canonical().pick(&leaders[first..first + block.len()]);
        let deltas = model.deltas_at(&of_leaders.position, model.info().times[reference.frame])?;
        let states = merged_states(model, reference, block, merge)?;
        let mut of_block = of_leaders.clone();
        deltas.invert(&with_leader_lengths(&deltas, &of_leaders, states), solved, &mut of_block);
        raw.write_rows(first, &of_block);
    }
    let unsolved = restore_unsolved(&mut raw, &of_leaders);
    if unsolved > 0 {
        notes.push(format!(
            "{unsolved} proxies kept the parameters of their leaders: the mask of the deformation \
                            field allows no others"
        ));
    }
    let mut placements = vec![merge.placement; leaders.len()];
    let mut deviations = deviations(model, reference, clusters, &raw, &placements)?;
    let tolerance = merge.max_drift * merge.length_unit.in_scene_units(reference.extent);
    let strayed: Vec<usize> = (0..leaders.len()).filter(|&i| deviations[i] > tolerance).collect();
    if merge.placement == ProxyPosition::Mean && !strayed.is_empty() {
        for &proxy in &strayed {
            raw.position.set_row::<3>(proxy, of_leaders.position.row(proxy));
            placements[proxy] = ProxyPosition::Leader;
        }
        notes.push(format!(
            "{} proxies drifted too far from their members and were placed at their leaders",
            strayed.len()
        ));
        deviations = self::deviations(model, reference, clusters, &raw, &placements)?;
    }
    let deviation = deviations.into_iter().reduce(f64::max);
    Ok(Proxies { raw: Some(raw.into()), deviation, notes, ..Proxies::default() })
}

/// Returns for each of `clusters` the state of its proxy (Gaussian that replaces merged ones) at the reference frame.
/// It is merged from the states of the members.
fn merged_states(
    model: &ModelFolder,
    reference: ReferenceFrame,
    clusters: &[Cluster],
    merge: &MergeParams,
) -> Result<Gaussians> {
    let mut states = Gaussians::zeros(clusters.len(), model.info().sh_degree);
    let ids: Vec<u32> = clusters.iter().flat_map(|cluster| cluster.members.iter().map(|&(id, _)| id)).collect();
    let of_members = gather(model, &ids, reference.frame, Attributes::all())?;
    let mut rows = 0..;
    for (proxy, cluster) in clusters.iter().enumerate() {
        let members: Vec<(u32, f64)> =
            cluster.members.iter().zip(rows.by_ref()).map(|(&(_, weight), row)| (row, weight)).collect();
        let leader = cluster.members.iter().position(|&(id, _)| id == cluster.leader).unwrap_or(0);
        merge_member_states(&members, &of_members, members[leader].0, merge, Attributes::all()).write(
            Attributes::all(),
            proxy,
            &mut states,
        );
    }
    Ok(states)
}

/// Returns `states`, the states of proxies (Gaussians that replace merged clusters) at one frame, with quaternions of
/// other lengths. The quaternion of a proxy gets the length that the quaternion of its leader (the most important
/// member of the cluster) has at this frame. The length matters because the field adds its delta to the stored
/// quaternion, so the angle of rotation depends on the length. `of_leaders` holds the stored parameters of the leaders,
/// `deltas` the changes that the field makes to them at this frame.
fn with_leader_lengths(deltas: &Deltas, of_leaders: &Gaussians, mut states: Gaussians) -> Gaussians {
    let mut leaders = Gaussians { rotation: of_leaders.rotation.clone(), ..Gaussians::default() };
    deltas.apply(of_leaders, Attributes::ROTATION, &mut leaders);
    for row in 0..states.len() {
        let length = leaders.rotation.row::<4>(row).iter().map(|x| x * x).sum::<f32>().sqrt();
        // If the leader's quaternion has zero length, the proxy keeps its unit quaternion.
        if length > 0.0 && length.is_finite() {
            states.rotation.set_row(row, states.rotation.row::<4>(row).map(|x| x * length));
        }
    }
    states
}

/// Replaces each row of `raw` that contains a value that is not finite by the same row of `leaders`, the stored
/// parameters of the leaders (the most important members of the clusters). Returns the number of replaced rows.
fn restore_unsolved(raw: &mut Gaussians, leaders: &Gaussians) -> usize {
    let columns: Vec<Attributes> = Attributes::all().iter().collect();
    let planes = |state: &Gaussians, row: usize| -> Vec<f32> {
        columns
            .iter()
            .flat_map(|&column| {
                let column = state.attribute_values(column);
                (0..column.width()).map(|c| column.plane(c)[row]).collect::<Vec<f32>>()
            })
            .collect()
    };
    let unsolved: Vec<usize> = (0..raw.len()).filter(|&row| planes(raw, row).iter().any(|x| !x.is_finite())).collect();
    for &row in &unsolved {
        for &column in &columns {
            for c in 0..leaders.attribute_values(column).width() {
                raw.attribute_values_mut(column).plane_mut(c)[row] = leaders.attribute_values(column).plane(c)[row];
            }
        }
    }
    unsolved.len()
}

/// Returns for each proxy (Gaussian that replaces a merged cluster) the largest distance, over sampled frames, between
/// its position and its expected position, in scene units. `raw` holds the stored parameters of the proxies.
/// `placements` states where each proxy was placed; the expected position at a frame follows from it:
/// - Placed at the mean: the weighted mean of the members of its cluster.
/// - Placed at the leader (the most important member): this mean, plus the offset of the leader from the mean at the
///   reference frame.
fn deviations(
    model: &ModelFolder,
    reference: ReferenceFrame,
    clusters: &[Cluster],
    raw: &Gaussians,
    placements: &[ProxyPosition],
) -> Result<Vec<f64>> {
    let frames = model.info().times.len();
    let proxies = model.with_canonical(raw.clone());
    let places: Vec<u32> = (0..raw.len() as u32).collect();
    let ids: Vec<u32> = clusters.iter().flat_map(|cluster| cluster.members.iter().map(|&(id, _)| id)).collect();
    let offsets = |frame: usize| -> Result<Vec<[f64; 3]>> {
        let of_proxies = gather(&proxies, &places, frame, Attributes::POSITION)?.position;
        let of_members = gather(model, &ids, frame, Attributes::POSITION)?.position;
        let mut row = 0;
        Ok(clusters
            .iter()
            .enumerate()
            .map(|(proxy, cluster)| {
                let mut offset = of_proxies.row::<3>(proxy).map(f64::from);
                for &(_, weight) in &cluster.members {
                    let member = of_members.row::<3>(row).map(f64::from);
                    (0..3).for_each(|axis| offset[axis] -= weight * member[axis]);
                    row += 1;
                }
                offset
            })
            .collect())
    };
    let mut wanted = offsets(reference.frame)?;
    for (offset, _) in wanted.iter_mut().zip(placements).filter(|(_, placement)| **placement == ProxyPosition::Mean) {
        *offset = [0.0; 3];
    }
    let mut largest = vec![0.0f64; raw.len()];
    for frame in sampled(frames) {
        for (largest, (now, then)) in largest.iter_mut().zip(offsets(frame)?.iter().zip(&wanted)) {
            let change = (0..3).map(|axis| (now[axis] - then[axis]).powi(2)).sum::<f64>().sqrt();
            *largest = largest.max(change);
        }
    }
    Ok(largest)
}

/// Returns the indices of at most [`SAMPLED_FRAMES`] of `frames` frames, evenly spread, with the first and last among
/// them.
fn sampled(frames: usize) -> impl Iterator<Item = usize> {
    let count = frames.min(SAMPLED_FRAMES);
    (0..count).map(move |k| if count < 2 { 0 } else { k * (frames - 1) / (count - 1) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sampled_frames_hold_both_ends_and_no_other_twice() {
        assert_eq!(sampled(0).count(), 0);
        assert_eq!(sampled(1).collect::<Vec<_>>(), [0]);
        assert_eq!(sampled(5).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
        let many: Vec<usize> = sampled(1000).collect();
        assert!(many.len() == SAMPLED_FRAMES && many[0] == 0 && many[15] == 999);
    }
}
