//! What is left of an input: which Gaussians stay, which of them stand for several, and what was changed of them.

use serde::{Deserialize, Serialize};

use crate::model::{ALL_HARMONICS, Column, Columns, Gaussians, Raw};
use crate::recipe::{MergeParams, Precision};

/// The frame at which Gaussians are compared, and the scale of the scene there.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Reference {
    /// The frame with most Gaussians alive, ties to the first; 0 without frames.
    pub frame: usize,
    /// Robust extent of the positions there, scene units.
    pub extent: f64,
}

/// Several Gaussians of the input that became one of the output, a proxy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cluster {
    /// Place in the output.
    pub output: u32,
    /// Id of the leader.
    pub leader: u32,
    /// Ids, increasing, the leader's among them, with weights that sum to 1.
    pub members: Vec<(u32, f64)>,
}

/// What proxies are made of, and what is known of them before anything is written.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Proxies {
    /// Raw parameters, one row per cluster, of a family that has such; none where a proxy follows from its members
    /// frame by frame.
    pub raw: Option<Raw>,
    /// Clusters, by number, increasing, that no proxy stands for well enough: their leaders stay as they are, alone.
    pub refused: Vec<usize>,
    /// Furthest that a proxy strays from its place among its members over sampled frames, scene units; none where it
    /// cannot stray.
    pub deviation: Option<f64>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// What is added to the parameters of the output's Gaussians as they are stored, the same at all times.
///
/// A row for every Gaussian of the output, in columns that change; columns that do not are empty. Harmonics may be of
/// a lower degree than the output's: those above stay.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ParamDelta(pub Gaussians);

impl ParamDelta {
    /// The columns that change.
    pub fn columns(&self) -> Columns {
        let changes = |&column: &Columns| !self.0.column(column).is_empty();
        Columns::all().iter().filter(changes).collect()
    }

    /// Whether nothing changes.
    pub fn is_empty(&self) -> bool {
        self.columns().is_empty()
    }

    /// The change of the Gaussians at `places`, in that order.
    pub fn pick(&self, places: &[u32]) -> ParamDelta {
        let mut picked = ParamDelta::default();
        for column in self.columns().iter() {
            *picked.0.column_mut(column) = self.0.column(column).pick(places);
        }
        picked
    }

    /// Makes it so many times as much.
    pub fn scale(&mut self, by: f32) {
        self.0.columns_mut(Columns::all()).flat_map(Column::planes_mut).for_each(|x| *x *= by);
    }

    /// This change and then `more`, whose harmonics are of no lower degree where both have some.
    pub fn and(self, mut more: ParamDelta) -> ParamDelta {
        for column in self.columns().iter() {
            let (of, to) = (self.0.column(column), more.0.column_mut(column));
            if to.is_empty() {
                *to = of.clone();
            } else {
                to.planes_mut().iter_mut().zip(of.planes()).for_each(|(to, of)| *to += of);
            }
        }
        more
    }

    /// What leads from `before` here.
    pub fn since(&self, before: &ParamDelta) -> ParamDelta {
        let mut back = before.clone();
        back.scale(-1.0);
        back.and(self.clone())
    }

    /// Changes the columns `of` of `state`, row by row. A zero leaves the value its bits.
    pub fn add_to(&self, state: &mut Gaussians, of: Columns) {
        for column in (self.columns() & of).iter() {
            let (by, values) = (self.0.column(column), state.column_mut(column));
            for c in 0..by.width().min(values.width()) {
                for (value, &by) in values.plane_mut(c).iter_mut().zip(by.plane(c)) {
                    *value = if by == 0.0 { *value } else { *value + by };
                }
            }
        }
    }
}

/// What is added beside a [`ParamDelta`], another amount at every time: these at times that lie evenly from the first frame to
/// the last, and in between what lies on the straight line; none: nothing. All have the same columns.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryDelta(pub Vec<ParamDelta>);

impl TrajectoryDelta {
    /// Which of `knots`, 2 or more, make up what is added at `frame` of `frames`, and with which weights.
    pub fn weights(knots: usize, frame: usize, frames: usize) -> [(usize, f32); 2] {
        let along = frame as f64 * (knots - 1) as f64 / (frames.max(2) - 1) as f64;
        let first = (along as usize).min(knots - 2);
        let part = (along - first as f64) as f32;
        [(first, 1.0 - part), (first + 1, part)]
    }

    /// Whether nothing is added.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The columns that change.
    pub fn columns(&self) -> Columns {
        self.0.first().map_or(Columns::empty(), ParamDelta::columns)
    }

    /// What is added at `frame` of `frames`.
    pub fn at(&self, frame: usize, frames: usize) -> ParamDelta {
        if self.is_empty() {
            return ParamDelta::default();
        }
        let [(first, before), (second, after)] = TrajectoryDelta::weights(self.0.len(), frame, frames);
        let [mut change, mut more] = [first, second].map(|knot| self.0[knot].clone());
        change.scale(before);
        more.scale(after);
        change.and(more)
    }

    /// The course of the Gaussians at `places`, in that order.
    pub fn pick(&self, places: &[u32]) -> TrajectoryDelta {
        TrajectoryDelta(self.0.iter().map(|knot| knot.pick(places)).collect())
    }

    /// This course and then `more`, of as many knots if both have any.
    pub fn and(self, more: TrajectoryDelta) -> TrajectoryDelta {
        match (self.is_empty(), more.is_empty()) {
            (_, true) => self,
            (true, _) => more,
            _ => TrajectoryDelta(self.0.into_iter().zip(more.0).map(|(knot, more)| knot.and(more)).collect()),
        }
    }
}

/// The Gaussians of the output in terms of those of the input.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CompressedModel {
    /// For every Gaussian of the output the id of its original, or of its cluster's leader; increasing.
    pub kept: Vec<u32>,
    /// The proxies among them, by place in the output.
    pub clusters: Vec<Cluster>,
    /// How members make up a proxy.
    pub rule: MergeParams,
    /// The proxies, solved.
    pub proxies: Proxies,
    /// What is added to their parameters.
    pub change: ParamDelta,
    /// And beside that along time, where their state stands in every frame and there are no proxies.
    pub course: TrajectoryDelta,
    /// How the field that deforms them is written, where there is one.
    pub field: Precision,
    /// Degree of the harmonics that stay of them; those above go, if there are any.
    pub sh_degree: usize,
}

impl CompressedModel {
    /// The Gaussians `kept` (increasing) as they are, with their field and all of their harmonics. Nothing is merged, so
    /// that nothing goes by `rule`.
    pub fn pruned(kept: Vec<u32>, rule: &MergeParams) -> Self {
        CompressedModel {
            kept,
            clusters: Vec::new(),
            rule: rule.clone(),
            proxies: Proxies::default(),
            change: ParamDelta::default(),
            course: TrajectoryDelta::default(),
            field: Precision::Exact,
            sh_degree: ALL_HARMONICS,
        }
    }

    /// The Gaussians `kept` (increasing) in the same manner.
    pub fn with(&self, kept: Vec<u32>) -> Self {
        CompressedModel { kept, ..self.clone() }
    }

    /// Makes the clusters what `proxies` say that they are; those refused are their leaders, as these are.
    pub fn make(&mut self, mut proxies: Proxies) {
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

    /// Number of Gaussians in the output.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// Whether nothing is left.
    pub fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    /// Those at `places` (increasing) alone, of a reduction without proxies.
    ///
    /// # Panics
    /// If there is a proxy.
    pub fn pick(&self, places: &[u32]) -> CompressedModel {
        assert!(self.clusters.is_empty(), "proxies have no place to pick them by");
        let kept = places.iter().map(|&place| self.kept[place as usize]).collect();
        let (change, course) = (self.change.pick(places), self.course.pick(places));
        let (field, sh_degree) = (self.field, self.sh_degree);
        CompressedModel { change, course, field, sh_degree, ..CompressedModel::pruned(kept, &self.rule) }
    }

    /// All that is added at `frame` of `frames`.
    pub fn change_at(&self, frame: usize, frames: usize) -> ParamDelta {
        // The course has no higher bands.
        self.course.at(frame, frames).and(self.change.clone())
    }

    /// For every Gaussian of an input of `count` its place in the output, if it has one.
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
    fn a_change_adds_to_its_own_columns_and_zeros_keep_even_the_sign_of_zero() {
        let mut state = Gaussians::zeros(2, 1);
        state.opacity_logit.set_row(0, [-0.0]);
        let mut by = Gaussians::zeros(2, 0);
        by.rotation = Default::default();
        by.position.set_row(1, [1.0, 0.0, -2.0]);
        by.sh.set_row(0, [0.5, 0.0, 0.25]);
        let change = ParamDelta(by);
        assert_eq!(change.columns(), Columns::all().difference(Columns::ROTATION));
        let mut changed = state.clone();
        change.add_to(&mut changed, change.columns().difference(Columns::LOG_SCALE));
        assert_eq!(changed.opacity_logit.row::<1>(0)[0].to_bits(), (-0.0f32).to_bits());
        assert_eq!(changed.position.row(1), [1.0, 0.0, -2.0]);
        assert_eq!(changed.sh.row(0), [0.5, 0.0, 0.25, 0.0, 0.0]);
        assert_eq!((&changed.rotation, &changed.log_scale), (&state.rotation, &state.log_scale));
        change.pick(&[1, 0]).add_to(&mut state, Columns::all());
        assert_eq!((state.position.row(0), state.sh.row(1)), ([1.0, 0.0, -2.0], [0.5, 0.0, 0.25]));
        assert!(ParamDelta::default().is_empty() && !change.is_empty());
    }

    #[test]
    fn a_course_goes_through_its_knots_and_straight_in_between() {
        let knot = |x: f32, logit: f32| {
            let mut by = Gaussians::zeros(0, 0);
            by.position = Column::from_planes(3, vec![x, 0.0, 2.0 * x, 0.0, 0.0, -x]);
            by.opacity_logit = Column::from_planes(1, vec![logit, 1.0]);
            ParamDelta(by)
        };
        let course = TrajectoryDelta(vec![knot(1.0, 0.0), knot(3.0, 4.0), knot(-1.0, 4.0)]);
        assert_eq!(course.columns(), Columns::POSITION | Columns::OPACITY);
        for (frame, x, logit) in [(0, 1.0, 0.0), (1, 1.5, 1.0), (4, 3.0, 4.0), (7, 0.0, 4.0), (8, -1.0, 4.0)] {
            assert_eq!(course.at(frame, 9), knot(x, logit), "frame {frame}");
            assert_eq!(course.pick(&[1, 0, 1]).at(frame, 9), knot(x, logit).pick(&[1, 0, 1]));
            assert_eq!(course.clone().and(course.clone()).at(frame, 9), knot(x, logit).and(knot(x, logit)));
        }
        assert_eq!(course.at(0, 1), knot(1.0, 0.0));
        assert!(
            TrajectoryDelta::default().at(3, 9).is_empty() && TrajectoryDelta::default().and(course.clone()) == course
        );
        let mut of_all = Gaussians::zeros(2, 1);
        of_all.sh.planes_mut().fill(0.5);
        let mut reduction = CompressedModel::pruned(vec![2, 7], &Recipe::preset("default").unwrap().merge);
        (reduction.change, reduction.course) = (ParamDelta(of_all), course);
        let both = reduction.change_at(4, 9);
        assert_eq!((both.0.position.row(0), both.0.sh.row::<12>(1)), ([3.0, 6.0, 0.0], [0.5; 12]));
        assert_eq!(reduction.pick(&[1]).change_at(4, 9), both.pick(&[1]));
    }

    #[test]
    fn clusters_that_are_refused_are_their_leaders_and_the_others_keep_their_proxies() {
        let rule = Recipe::preset("default").unwrap().merge;
        let mut reduction = CompressedModel::pruned(vec![1, 4, 6], &rule);
        let cluster = |output: u32, leader: u32, other: u32| Cluster {
            output,
            leader,
            members: vec![(leader, 0.5), (other, 0.5)],
        };
        reduction.clusters = vec![cluster(0, 1, 2), cluster(1, 4, 5), cluster(2, 6, 7)];
        let mut raw = Raw::from(Gaussians::zeros(3, 0));
        (0..3).for_each(|row| raw.gaussians.position.set_row(row, [row as f32; 3]));
        reduction.make(Proxies { raw: Some(raw), refused: vec![1], ..Proxies::default() });
        assert_eq!(reduction.index_map(8), [None, Some(0), Some(0), None, Some(1), None, Some(2), Some(2)]);
        assert_eq!(reduction.proxies.raw.unwrap().gaussians.position.plane(0), [0.0, 2.0]);
        assert!(reduction.proxies.refused.is_empty());
    }

    #[test]
    fn members_of_a_cluster_share_its_place() {
        let rule = Recipe::preset("default").unwrap().merge;
        let mut reduction = CompressedModel::pruned(vec![1, 4], &rule);
        assert_eq!(reduction.index_map(6), [None, Some(0), None, None, Some(1), None]);
        reduction.clusters.push(Cluster { output: 1, leader: 4, members: vec![(2, 0.25), (4, 0.75)] });
        assert_eq!(reduction.index_map(6), [None, Some(0), Some(1), None, Some(1), None]);
        assert_eq!((reduction.len(), reduction.is_empty()), (2, false));
    }
}
