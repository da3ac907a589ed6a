//! From a selection to the output's Gaussians: how many survive pruning, which of them merge.

use hashbrown::HashMap;

use super::compress::Only;
use super::input::Scene;
use super::scored::Scored;
use super::summary::{MergeSummary, Stages};
use crate::error::{Error, Result};
use crate::merge::motion::PairMeasure;
use crate::merge::proxy::{Importance, weights};
use crate::merge::{self, Merged, Survivors};
use crate::model::{Columns, Gaussians};
use crate::recipe::{self, Recipe};
use crate::select::hash_id;
use crate::stream::{gather, measure_motion};

/// Several Gaussians of the input that became one of the output.
#[derive(Debug, Clone, PartialEq)]
pub struct Cluster {
    /// Place in the output.
    pub output: u32,
    /// Id of the leader.
    pub leader: u32,
    /// Ids, increasing, the leader's among them, with weights that sum to 1.
    pub members: Vec<(u32, f64)>,
}

/// What is left of the input.
#[derive(Debug, Clone)]
pub struct Sieved {
    /// For every Gaussian of the output the id of its original, or of its cluster's leader; increasing.
    pub kept: Vec<u32>,
    /// The proxies among them, by place in the output.
    pub clusters: Vec<Cluster>,
    /// State at the reference frame of every proxy, in the order of `clusters`.
    pub proxies: Gaussians,
    /// What merging did; none where it was left out.
    pub summary: Option<MergeSummary>,
    /// What is added to the base colours (`f_dc`), by place in the output; empty: nothing.
    pub recolor: Vec<[f32; 3]>,
}

impl Sieved {
    /// The Gaussians `kept` (increasing) as they are.
    pub fn pruned(kept: Vec<u32>) -> Self {
        Sieved { kept, clusters: Vec::new(), proxies: Gaussians::default(), summary: None, recolor: Vec::new() }
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

/// Prunes and merges to the recipe's own number of Gaussians, or to exactly `target`.
pub fn sieve(
    scene: &Scene,
    scored: &Scored,
    recipe: &Recipe,
    only: Only,
    target: Option<usize>,
    stages: &mut Stages,
) -> Result<Sieved> {
    let count = scene.input.source().info().count;
    let ranking = &scored.ranking;
    let all = ranking.order().len();
    let merges = only != Only::Prune && !recipe.merge.passes.is_empty();
    if let Some(target) = target {
        check_reachable(target, scored, all)?;
    }
    // What pruning alone would leave; with a target and merging, at most all.
    let survivors = match (only, target) {
        (Only::Merge, _) => all,
        (_, None) => scored.selection.counts.kept,
        (_, Some(target)) if !merges => target,
        (_, Some(_)) => all,
    };
    if !merges {
        let kept = stages.run("select", count, 0.0, || Ok::<_, Error>((ranking.take(survivors), survivors)))?;
        return Ok(Sieved::pruned(kept));
    }
    let mut job = stages.run("select", count, 0.0, || {
        Ok::<_, Error>((Job::new(scene, scored, recipe, ranking.take(survivors))?, survivors))
    })?;
    stages.run("merge", survivors, 1.0, || {
        let sieved = match target {
            None => job.merge(&ranking.take(survivors), None)?,
            Some(target) if only == Only::Merge => job.merge_to(&ranking.take(all), target)?,
            Some(target) => {
                let m = bracket(target, all, |m| Ok(job.merge(&ranking.take(m), None)?.kept.len()))?;
                job.merge_to(&ranking.take(m), target)?
            }
        };
        let kept = sieved.kept.len();
        Ok((sieved, kept))
    })
}

fn check_reachable(target: usize, scored: &Scored, all: usize) -> Result<()> {
    let protected = scored.protected.len();
    if target < protected {
        return Err(Error::usage(format!("a target of {target} Gaussians, but {protected} are to be kept")));
    }
    if target > all {
        let dropped = scored.selection.counts.total - all;
        return Err(Error::usage(format!(
            "a target of {target} Gaussians, but {dropped} are to be dropped: {all} are left"
        )));
    }
    Ok(())
}

/// The largest number m of survivors, up to `all`, that the search finds to merge into at most
/// `target`; m = `target` always does. Counts grow with m but for small dips, so the bracket closes
/// by the secant, and stops when what is missing is under a thousandth of the target: merging then
/// ends early by that much.
fn bracket(target: usize, all: usize, mut merged: impl FnMut(usize) -> Result<usize>) -> Result<usize> {
    let (mut low, mut high) = (target, all);
    let mut high_count = merged(high)?;
    if high_count <= target {
        return Ok(high);
    }
    let mut low_count = merged(low)?;
    while high - low > 1 && target - low_count > target / 1000 {
        let slope = (target - low_count) as f64 / (high_count - low_count) as f64;
        // Away from the ends, so that a curved count cannot stall the search.
        let m = low + ((high - low) as f64 * slope.clamp(0.1, 0.9)) as usize;
        let m = m.clamp(low + 1, high - 1);
        let count = merged(m)?;
        if count <= target {
            (low, low_count) = (m, count);
        } else {
            (high, high_count) = (m, count);
        }
    }
    Ok(low)
}

/// Everything merging reads, so that it can be tried on many sets of survivors.
struct Job<'a> {
    scene: &'a Scene,
    scored: &'a Scored,
    recipe: &'a Recipe,
    /// The recipe's, with a noise floor no lower than that of the positions.
    merge: recipe::Merge,
    /// Ids whose states are known, increasing, and these states at the reference frame.
    pool: Vec<u32>,
    states: Gaussians,
    /// How pairs move, by ids: it does not depend on who else survives.
    measured: HashMap<(u32, u32), PairMeasure>,
}

impl<'a> Job<'a> {
    fn new(scene: &'a Scene, scored: &'a Scored, recipe: &'a Recipe, pool: Vec<u32>) -> Result<Self> {
        let source = scene.input.source();
        let states = match source.info().times.is_empty() {
            true => Gaussians::zeros(pool.len(), source.info().sh_degree),
            false => gather(source, &pool, scored.reference.frame, Columns::ALL)?,
        };
        let mut merge = recipe.merge.clone();
        let unit = merge.length_unit.in_scene_units(scored.reference.extent);
        merge.motion_noise = merge.motion_noise.max(2.0 * scored.position_ulp / unit);
        Ok(Job { scene, scored, recipe, merge, pool, states, measured: HashMap::new() })
    }

    /// Merges `survivors` to exactly `target`.
    fn merge_to(&mut self, survivors: &[u32], target: usize) -> Result<Sieved> {
        let sieved = self.merge(survivors, Some(survivors.len() - target))?;
        if sieved.kept.len() > target {
            return Err(Error::usage(format!(
                "a target of {target} Gaussians, but merging alone leaves {} at the least\n  allow pruning, or looser merge passes",
                sieved.kept.len()
            )));
        }
        Ok(sieved)
    }

    /// Merges `survivors` (increasing, all in the pool), stopping after `limit` joins.
    fn merge(&mut self, survivors: &[u32], limit: Option<usize>) -> Result<Sieved> {
        let Job { scene, scored, recipe, .. } = *self;
        let places: Vec<u32> = places_of(survivors, &self.pool);
        let states = self.states.pick(&places);
        let column = |values: &[f64]| -> Vec<f64> { survivors.iter().map(|&id| values[id as usize]).collect() };
        let (coverage, visibility) = (column(&scored.rows.c), column(&scored.rows.vis));
        let hash: Vec<u64> = survivors.iter().map(|&id| hash_id(id.into())).collect();
        let mergeable: Vec<bool> = survivors.iter().map(|id| scored.protected.binary_search(id).is_err()).collect();
        let merged = merge::run(
            &Survivors {
                states: &states,
                coverage: &coverage,
                visibility: &visibility,
                hash: &hash,
                mergeable: &mergeable,
                extent: scored.reference.extent,
            },
            &self.merge,
            limit,
            |pairs| measure(scene, recipe, survivors, &states, pairs, &mut self.measured),
        )?;
        let importance = Importance { coverage: &coverage, visibility: &visibility };
        Ok(self.sieved(survivors, &states, &importance, merged))
    }

    fn sieved(&self, survivors: &[u32], states: &Gaussians, importance: &Importance<'_>, merged: Merged) -> Sieved {
        let groups = &merged.groups;
        let kept: Vec<u32> = groups.leaders().iter().map(|&row| survivors[row as usize]).collect();
        let grouped: Vec<u32> = (0..groups.len() as u32).filter(|&g| groups.members(g as usize).len() > 1).collect();
        let clusters: Vec<Cluster> = grouped
            .iter()
            .map(|&group| {
                let rows = groups.members(group as usize);
                let ids = rows.iter().map(|&row| survivors[row as usize]);
                let members = ids.zip(weights(rows, importance, states)).collect();
                Cluster { output: group, leader: kept[group as usize], members }
            })
            .collect();
        let summary = MergeSummary {
            reference_frame: self.scored.reference.frame,
            proxies: clusters.len(),
            members: clusters.iter().map(|cluster| cluster.members.len()).sum(),
            opacity: self.recipe.merge.opacity,
            passes: merged.passes.clone(),
            deviation: None,
        };
        Sieved { proxies: merged.states.pick(&grouped), kept, clusters, summary: Some(summary), recolor: Vec::new() }
    }
}

/// Place of each of `ids` in `pool`, both increasing, the first part of the second.
fn places_of(ids: &[u32], pool: &[u32]) -> Vec<u32> {
    let mut place = 0;
    ids.iter()
        .map(|&id| {
            while pool[place] < id {
                place += 1;
            }
            place as u32
        })
        .collect()
}

/// Motion of pairs of survivors, from memory where it was measured before.
fn measure(
    scene: &Scene,
    recipe: &Recipe,
    survivors: &[u32],
    states: &Gaussians,
    pairs: &[(u32, u32)],
    measured: &mut HashMap<(u32, u32), PairMeasure>,
) -> Result<Vec<PairMeasure>> {
    let key = |&(a, b): &(u32, u32)| {
        let (a, b) = (survivors[a as usize], survivors[b as usize]);
        (a.min(b), a.max(b))
    };
    let mut unknown: Vec<(u32, u32)> =
        pairs.iter().filter(|pair| !measured.contains_key(&key(pair))).map(|&(a, b)| (a.min(b), a.max(b))).collect();
    unknown.sort_unstable();
    unknown.dedup();
    if !unknown.is_empty() {
        // Only Gaussians in a pair need to be followed.
        let mut rows: Vec<u32> = unknown.iter().flat_map(|&(a, b)| [a, b]).collect();
        rows.sort_unstable();
        rows.dedup();
        let ids: Vec<u32> = rows.iter().map(|&row| survivors[row as usize]).collect();
        let place = |row: u32| rows.binary_search(&row).unwrap_or_default() as u32;
        let local: Vec<(u32, u32)> = unknown.iter().map(|&(a, b)| (place(a), place(b))).collect();
        let reference = states.position.pick(&rows);
        let found = measure_motion(scene.input.source(), &ids, &local, &reference, &recipe.scan)?;
        measured.extend(unknown.iter().map(key).zip(found));
    }
    Ok(pairs.iter().map(|pair| measured[&key(pair)]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bracket_finds_the_most_survivors_that_merge_into_the_target() {
        // Merging halves what lies beyond the first hundred.
        for target in [1, 50, 100, 101, 400, 549, 550, 1000] {
            let count = |m: usize| m.min(100) + m.saturating_sub(100) / 2;
            let m = bracket(target, 1000, |m| Ok(count(m))).unwrap();
            assert!(count(m) <= target && m >= target, "target {target}, got {m}");
            assert!(m == 1000 || count(m + 2) > target - target / 1000, "target {target}: {m} could be larger");
        }
    }

    #[test]
    fn places_follow_the_ids() {
        assert_eq!(places_of(&[2, 5, 9], &[1, 2, 3, 5, 9]), [1, 3, 4]);
        assert!(places_of(&[], &[4]).is_empty());
    }
}
