//! What is left of an input: which Gaussians stay, which of them stand for several, and what was changed of them.

use crate::model::Gaussians;
use crate::recipe::Merge;

/// The frame at which Gaussians are compared, and the scale of the scene there.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Reference {
    /// The frame with most Gaussians alive, ties to the first; 0 without frames.
    pub frame: usize,
    /// Robust extent of the positions there, scene units.
    pub extent: f64,
}

/// Several Gaussians of the input that became one of the output, a proxy.
#[derive(Debug, Clone, PartialEq)]
pub struct Cluster {
    /// Place in the output.
    pub output: u32,
    /// Id of the leader.
    pub leader: u32,
    /// Ids, increasing, the leader's among them, with weights that sum to 1.
    pub members: Vec<(u32, f64)>,
}

/// What proxies are made of, and what is known of them before anything is written.
#[derive(Debug, Clone, Default)]
pub struct Proxies {
    /// Raw parameters, one row per cluster, of a family that has such; none where a proxy follows from its members
    /// frame by frame.
    pub raw: Option<Gaussians>,
    /// Furthest that a proxy strays from its place among its members over sampled frames, scene units; none where it
    /// cannot stray.
    pub deviation: Option<f64>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// The Gaussians of the output in terms of those of the input.
#[derive(Debug, Clone)]
pub struct Reduction {
    /// For every Gaussian of the output the id of its original, or of its cluster's leader; increasing.
    pub kept: Vec<u32>,
    /// The proxies among them, by place in the output.
    pub clusters: Vec<Cluster>,
    /// How members make up a proxy.
    pub rule: Merge,
    /// The proxies, solved.
    pub proxies: Proxies,
    /// What is added to the base colours (`f_dc`), by place in the output; empty: nothing.
    pub recolor: Vec<[f32; 3]>,
}

impl Reduction {
    /// The Gaussians `kept` (increasing) as they are. Nothing is merged, so that nothing goes by `rule`.
    pub fn pruned(kept: Vec<u32>, rule: &Merge) -> Self {
        let (clusters, proxies, recolor) = (Vec::new(), Proxies::default(), Vec::new());
        Reduction { kept, clusters, rule: rule.clone(), proxies, recolor }
    }

    /// Number of Gaussians in the output.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// Whether nothing is left.
    pub fn is_empty(&self) -> bool {
        self.kept.is_empty()
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
    fn members_of_a_cluster_share_its_place() {
        let rule = Recipe::preset("default").unwrap().merge;
        let mut reduction = Reduction::pruned(vec![1, 4], &rule);
        assert_eq!(reduction.index_map(6), [None, Some(0), None, None, Some(1), None]);
        reduction.clusters.push(Cluster { output: 1, leader: 4, members: vec![(2, 0.25), (4, 0.75)] });
        assert_eq!(reduction.index_map(6), [None, Some(0), Some(1), None, Some(1), None]);
        assert_eq!((reduction.len(), reduction.is_empty()), (2, false));
    }
}
