//! The compressed model: survivors (Gaussians that are not removed), proxies (Gaussians that each replace a merged
//! cluster), and parameter deltas (what refinement adds to stored values).

use serde::{Deserialize, Serialize};

use crate::model::{AttributeValues, Attributes, Gaussians, NO_SH_LIMIT, StoredParams};
use crate::recipe::{FieldPrecision, MergeParams};

/// Reference frame, at which Gaussians are compared for merging, and the extent of the scene at this frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ReferenceFrame {
    /// Index of the frame with the most Gaussians alive (opacity ≥ alpha_min); the first one in a tie; 0 if there are
    /// no frames.
    pub frame: usize,
    /// Longest side of the box between the 1st and the 99th percentile of the positions at this frame, scene units.
    pub extent: f64,
}

/// Cluster of input Gaussians that are merged into one output Gaussian, the proxy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cluster {
    /// Index in the output of the proxy that replaces this cluster.
    pub output: u32,
    /// Id of the leader of this cluster: the Gaussian to which merging joined the other members.
    pub leader: u32,
    /// Ids and weights of the members of this cluster, in increasing order of ids. The leader is one of the members.
    /// The proxy is the weighted mean of the members; the weights sum to 1.
    pub members: Vec<(u32, f64)>,
}

/// Proxies (Gaussians that each replace a merged cluster), computed before anything is written.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Proxies {
    /// Stored parameters of the proxies (Gaussians that replace merged clusters), one row per cluster. `None` if the
    /// model format cannot store a proxy like any other Gaussian: each proxy is then computed from its members at each
    /// frame.
    pub raw: Option<StoredParams>,
    /// Increasing indices of the clusters whose proxy (Gaussian to replace the cluster) was refused, because no
    /// Gaussian of the model format moves and fades like the members together. Such a cluster is not merged: its leader
    /// (most important member) stays, and the other members are removed.
    pub refused: Vec<usize>,
    /// Largest distance between the position of a proxy (Gaussian that replaces a merged cluster) and the position
    /// expected from its members (the Gaussians of the cluster), over all proxies and sampled frames, scene units.
    /// `None` if every proxy follows its members exactly.
    pub deviation: Option<f64>,
    /// Notes for the user about the proxies (Gaussians that replace merged clusters).
    pub notes: Vec<String>,
}

/// Parameter delta, constant in time: values that refinement adds to the stored parameters of the output's Gaussians.
///
/// Each changed attribute has one row per Gaussian of the output; an unchanged attribute is empty. SH coefficients may
/// be of a lower degree than the output's; coefficients above that degree do not change.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ParamDelta(pub Gaussians);

impl ParamDelta {
    /// Returns the attributes for which this delta has values.
    pub fn attributes(&self) -> Attributes {
        let changes = |&column: &Attributes| !self.0.attribute_values(column).is_empty();
        Attributes::all().iter().filter(changes).collect()
    }

    /// Returns whether this delta has no values for any attribute.
    pub fn is_empty(&self) -> bool {
        self.attributes().is_empty()
    }

    /// Returns the delta of the Gaussians at the output indices `places`, in the order of `places`.
    pub fn pick(&self, places: &[u32]) -> ParamDelta {
        let mut picked = ParamDelta::default();
        for column in self.attributes().iter() {
            *picked.0.attribute_values_mut(column) = self.0.attribute_values(column).pick(places);
        }
        picked
    }

    /// Multiplies every value of this delta by `by`.
    pub fn scale(&mut self, by: f32) {
        self.0
            .selected_attribute_values_mut(Attributes::all())
            .flat_map(AttributeValues::planes_mut)
            .for_each(|x| *x *= by);
    }

    /// Returns the sum of this delta and `more`. If both have SH coefficients, the SH degree of `more` must be at least
    /// that of this delta.
    pub fn plus(self, mut more: ParamDelta) -> ParamDelta {
        for column in self.attributes().iter() {
            let (from, to) = (self.0.attribute_values(column), more.0.attribute_values_mut(column));
            if to.is_empty() {
                *to = from.clone();
            } else {
                to.planes_mut().iter_mut().zip(from.planes()).for_each(|(to, from)| *to += from);
            }
        }
        more
    }

    /// Returns the difference `self - before`.
    pub fn minus(&self, before: &ParamDelta) -> ParamDelta {
        let mut back = before.clone();
        back.scale(-1.0);
        back.plus(self.clone())
    }

    /// Adds this delta to the values in `state`, for the attributes `attributes` only. Row i of the delta belongs to
    /// row i of `state`. Adding 0 leaves the bits of a value unchanged.
    pub fn add_to(&self, state: &mut Gaussians, attributes: Attributes) {
        for column in (self.attributes() & attributes).iter() {
            let (by, values) = (self.0.attribute_values(column), state.attribute_values_mut(column));
            for c in 0..by.width().min(values.width()) {
                for (value, &by) in values.plane_mut(c).iter_mut().zip(by.plane(c)) {
                    *value = if by == 0.0 { *value } else { *value + by };
                }
            }
        }
    }
}

/// Trajectory delta: values that refinement adds to the attributes of the Gaussians and that vary in time, while a
/// [`ParamDelta`] is constant. The field holds one delta per keyframe. Keyframes are evenly spaced from the first frame
/// to the last; between them, deltas are interpolated linearly. All keyframes have values for the same attributes. An
/// empty list adds nothing.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryDelta(pub Vec<ParamDelta>);

impl TrajectoryDelta {
    /// Returns the two keyframes between which frame `frame` of a sequence of `frames` frames lies. Each is given by
    /// its index and its weight in the linear interpolation. `keyframes`: number of keyframes, at least 2.
    pub fn keyframe_weights(keyframes: usize, frame: usize, frames: usize) -> [(usize, f32); 2] {
        let along = frame as f64 * (keyframes - 1) as f64 / (frames.max(2) - 1) as f64;
        let first = (along as usize).min(keyframes - 2);
        let part = (along - first as f64) as f32;
        [(first, 1.0 - part), (first + 1, part)]
    }

    /// Returns whether this trajectory delta has no keyframes. Such a delta leaves all attributes unchanged.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the attributes for which the keyframes have values.
    pub fn attributes(&self) -> Attributes {
        self.0.first().map_or(Attributes::empty(), ParamDelta::attributes)
    }

    /// Returns the delta at frame `frame` of a sequence of `frames` frames, interpolated between two keyframes; empty
    /// if there are no keyframes.
    pub fn at_frame(&self, frame: usize, frames: usize) -> ParamDelta {
        if self.is_empty() {
            return ParamDelta::default();
        }
        let [(first, before), (second, after)] = TrajectoryDelta::keyframe_weights(self.0.len(), frame, frames);
        let [mut change, mut more] = [first, second].map(|keyframe| self.0[keyframe].clone());
        change.scale(before);
        more.scale(after);
        change.plus(more)
    }

    /// Returns the trajectory delta of the Gaussians at the output indices `places`, in the order of `places`.
    pub fn pick(&self, places: &[u32]) -> TrajectoryDelta {
        TrajectoryDelta(self.0.iter().map(|keyframe| keyframe.pick(places)).collect())
    }

    /// Returns the sum of this trajectory delta and `more`. If both have keyframes, their numbers of keyframes must be
    /// equal.
    pub fn plus(self, more: TrajectoryDelta) -> TrajectoryDelta {
        match (self.is_empty(), more.is_empty()) {
            (_, true) => self,
            (true, _) => more,
            _ => TrajectoryDelta(self.0.into_iter().zip(more.0).map(|(keyframe, more)| keyframe.plus(more)).collect()),
        }
    }
}

/// Compressed model: describes every Gaussian of the output by the Gaussians of the input that it comes from.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CompressedModel {
    /// For every Gaussian of the output, in order, the id of an input Gaussian. For an unmerged Gaussian it is the
    /// Gaussian itself. For a proxy (Gaussian that replaces a merged cluster) it is the leader (most important member)
    /// of its cluster. The ids increase.
    pub kept: Vec<u32>,
    /// Clusters of input Gaussians that are merged, in increasing order of the index in the output of their proxy (the
    /// Gaussian that replaces the cluster).
    pub clusters: Vec<Cluster>,
    /// Merge parameters by which proxies (Gaussians that replace merged clusters) are computed from the members of
    /// their clusters.
    #[serde(rename = "rule")]
    pub merge_params: MergeParams,
    /// Proxies, which replace the merged clusters.
    pub proxies: Proxies,
    /// Parameter delta: values that refinement adds to the stored parameters, constant in time.
    #[serde(rename = "change")]
    pub delta: ParamDelta,
    /// Trajectory delta: values that refinement adds to the attributes at each frame, on top of the constant `delta`.
    /// It has values only if the model format stores the state of every Gaussian for every frame, and no Gaussians are
    /// merged.
    #[serde(rename = "course")]
    pub trajectory_delta: TrajectoryDelta,
    /// Precision in which the deformation field is written, if the model has one.
    pub field: FieldPrecision,
    /// Highest SH degree in the output. SH coefficients above it are dropped.
    pub sh_degree: usize,
}

impl CompressedModel {
    /// Returns the compressed model that keeps the Gaussians `kept` (increasing ids of the input) unchanged and removes
    /// all others. Nothing is merged, and deformation field and SH coefficients stay exact. `rule` (merge parameters)
    /// is stored, but has no effect without merged Gaussians.
    pub fn pruned(kept: Vec<u32>, rule: &MergeParams) -> Self {
        CompressedModel {
            kept,
            clusters: Vec::new(),
            merge_params: rule.clone(),
            proxies: Proxies::default(),
            delta: ParamDelta::default(),
            trajectory_delta: TrajectoryDelta::default(),
            field: FieldPrecision::Exact,
            sh_degree: NO_SH_LIMIT,
        }
    }

    /// Returns the indices in [`CompressedModel::kept`] of the ids `ids`, in their order; `None` if an id is not kept.
    pub(crate) fn indices(&self, ids: &[u32]) -> Option<Vec<u32>> {
        ids.iter().map(|id| self.kept.binary_search(id).ok().map(|index| index as u32)).collect()
    }

    /// Returns a copy of this model in which the list of kept Gaussians is replaced by `kept` (increasing ids of the
    /// input).
    pub fn with_kept(&self, kept: Vec<u32>) -> Self {
        CompressedModel { kept, ..self.clone() }
    }

    /// Sets the computed `proxies` (Gaussians that replace merged clusters). A cluster whose proxy was refused
    /// ([`Proxies::refused`]) is dissolved: its leader, the Gaussian to which the others were joined, stays unchanged,
    /// and the other members are removed.
    pub fn set_proxies(&mut self, mut proxies: Proxies) {
        let refused = std::mem::take(&mut proxies.refused);
        if !refused.is_empty() {
            let is_made: Vec<bool> = (0..self.clusters.len()).map(|k| refused.binary_search(&k).is_err()).collect();
            let made: Vec<u32> = (0..).zip(&is_made).filter(|(_, is_made)| **is_made).map(|(k, _)| k).collect();
            proxies.raw = proxies.raw.map(|raw| raw.pick(&made));
            let mut is_made = is_made.into_iter();
            self.clusters.retain(|_| is_made.next().unwrap_or(true));
        }
        self.proxies = proxies;
    }

    /// Returns the number of Gaussians in the output.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// Returns whether the output has no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    /// Returns the compressed model that consists of only the output Gaussians with the indices `places` (increasing).
    /// The model must have no proxies (Gaussians that replace merged clusters).
    ///
    /// # Panics
    /// Panics if there is a proxy.
    pub fn pick(&self, places: &[u32]) -> CompressedModel {
        assert!(self.clusters.is_empty(), "proxies have no place to pick them by");
        let kept = places.iter().map(|&place| self.kept[place as usize]).collect();
        let (change, course) = (self.delta.pick(places), self.trajectory_delta.pick(places));
        let (field, sh_degree) = (self.field, self.sh_degree);
        CompressedModel {
            delta: change,
            trajectory_delta: course,
            field,
            sh_degree,
            ..CompressedModel::pruned(kept, &self.merge_params)
        }
    }

    /// Returns everything that refinement adds to the Gaussians at frame `frame` of a sequence of `frames` frames: the
    /// sum of the constant delta and of the trajectory delta at this frame.
    pub fn delta_at(&self, frame: usize, frames: usize) -> ParamDelta {
        // The trajectory delta never has a higher SH degree than the constant one.
        self.trajectory_delta.at_frame(frame, frames).plus(self.delta.clone())
    }

    /// Returns for each of the `count` input Gaussians its index in the output, or `None` if it was removed. All
    /// members of a cluster have the index of the proxy that replaces it.
    pub fn index_map(&self, count: usize) -> Vec<Option<u32>> {
        let mut map = vec![None; count];
        for (place, &id) in self.kept.iter().enumerate() {
            map[id as usize] = Some(place as u32);
        }
        for cluster in &self.clusters {
            for &(id, _) in &cluster.members {
                map[id as usize] = Some(cluster.output);
            }
        }
        map
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;

    #[test]
    fn delta_adds_to_its_attributes_and_zero_keeps_bits() {
        let mut state = Gaussians::zeros(2, 1);
        state.opacity_logit.set_row(0, [-0.0]);
        let mut by = Gaussians::zeros(2, 0);
        by.rotation = Default::default();
        by.position.set_row(1, [1.0, 0.0, -2.0]);
        by.sh.set_row(0, [0.5, 0.0, 0.25]);
        let change = ParamDelta(by);
        assert_eq!(change.attributes(), Attributes::all().difference(Attributes::ROTATION));
        let mut changed = state.clone();
        change.add_to(&mut changed, change.attributes().difference(Attributes::LOG_SCALE));
        assert_eq!(changed.opacity_logit.row::<1>(0)[0].to_bits(), (-0.0f32).to_bits());
        assert_eq!(changed.position.row(1), [1.0, 0.0, -2.0]);
        assert_eq!(changed.sh.row(0), [0.5, 0.0, 0.25, 0.0, 0.0]);
        assert_eq!((&changed.rotation, &changed.log_scale), (&state.rotation, &state.log_scale));
        change.pick(&[1, 0]).add_to(&mut state, Attributes::all());
        assert_eq!((state.position.row(0), state.sh.row(1)), ([1.0, 0.0, -2.0], [0.5, 0.0, 0.25]));
        assert!(ParamDelta::default().is_empty() && !change.is_empty());
    }

    #[test]
    fn trajectory_delta_is_linear_between_keyframes() {
        let keyframe = |x: f32, logit: f32| {
            let mut by = Gaussians::zeros(0, 0);
            by.position = AttributeValues::from_planes(3, vec![x, 0.0, 2.0 * x, 0.0, 0.0, -x]);
            by.opacity_logit = AttributeValues::from_planes(1, vec![logit, 1.0]);
            ParamDelta(by)
        };
        let course = TrajectoryDelta(vec![keyframe(1.0, 0.0), keyframe(3.0, 4.0), keyframe(-1.0, 4.0)]);
        assert_eq!(course.attributes(), Attributes::POSITION | Attributes::OPACITY);
        for (frame, x, logit) in [(0, 1.0, 0.0), (1, 1.5, 1.0), (4, 3.0, 4.0), (7, 0.0, 4.0), (8, -1.0, 4.0)] {
            assert_eq!(course.at_frame(frame, 9), keyframe(x, logit), "frame {frame}");
            assert_eq!(course.pick(&[1, 0, 1]).at_frame(frame, 9), keyframe(x, logit).pick(&[1, 0, 1]));
            assert_eq!(
                course.clone().plus(course.clone()).at_frame(frame, 9),
                keyframe(x, logit).plus(keyframe(x, logit))
            );
        }
        assert_eq!(course.at_frame(0, 1), keyframe(1.0, 0.0));
        assert!(
            TrajectoryDelta::default().at_frame(3, 9).is_empty()
                && TrajectoryDelta::default().plus(course.clone()) == course
        );
        let mut of_all = Gaussians::zeros(2, 1);
        of_all.sh.planes_mut().fill(0.5);
        let mut compressed = CompressedModel::pruned(vec![2, 7], &Recipe::preset("default").unwrap().merge);
        (compressed.delta, compressed.trajectory_delta) = (ParamDelta(of_all), course);
        let both = compressed.delta_at(4, 9);
        assert_eq!((both.0.position.row(0), both.0.sh.row::<12>(1)), ([3.0, 6.0, 0.0], [0.5; 12]));
        assert_eq!(compressed.pick(&[1]).delta_at(4, 9), both.pick(&[1]));
    }

    #[test]
    fn refused_clusters_keep_only_their_leaders() {
        let rule = Recipe::preset("default").unwrap().merge;
        let mut compressed = CompressedModel::pruned(vec![1, 4, 6], &rule);
        let cluster = |output: u32, leader: u32, other: u32| Cluster {
            output,
            leader,
            members: vec![(leader, 0.5), (other, 0.5)],
        };
        compressed.clusters = vec![cluster(0, 1, 2), cluster(1, 4, 5), cluster(2, 6, 7)];
        let mut raw = StoredParams::from(Gaussians::zeros(3, 0));
        (0..3).for_each(|row| raw.gaussians.position.set_row(row, [row as f32; 3]));
        compressed.set_proxies(Proxies { raw: Some(raw), refused: vec![1], ..Proxies::default() });
        assert_eq!(compressed.index_map(8), [None, Some(0), Some(0), None, Some(1), None, Some(2), Some(2)]);
        assert_eq!(compressed.proxies.raw.unwrap().gaussians.position.plane(0), [0.0, 2.0]);
        assert!(compressed.proxies.refused.is_empty());
    }

    #[test]
    fn members_of_a_cluster_share_its_index() {
        let rule = Recipe::preset("default").unwrap().merge;
        let mut compressed = CompressedModel::pruned(vec![1, 4], &rule);
        assert_eq!(compressed.index_map(6), [None, Some(0), None, None, Some(1), None]);
        compressed.clusters.push(Cluster { output: 1, leader: 4, members: vec![(2, 0.25), (4, 0.75)] });
        assert_eq!(compressed.index_map(6), [None, Some(0), Some(1), None, Some(1), None]);
        assert_eq!((compressed.len(), compressed.is_empty()), (2, false));
    }
}
