//! From a selection to the output's Gaussians: how many survive pruning, which of them merge.
//!
//! Memory while merging, of every Gaussian that may survive [`BYTES_PER_SURVIVOR`], what [`crate::merge`] says of
//! survivors and candidate pairs, and what [`crate::stream::motion`] says of the pairs it measures together.

use std::borrow::Cow;

use super::compress::Only;
use super::input::Scene;
use super::scored::Scored;
use super::summary::{MergeSummary, Stages};
use crate::error::{Error, Result};
use crate::merge::known::KnownPairs;
use crate::merge::motion::MotionGate;
use crate::merge::proxy::{Importance, weights};
use crate::merge::{self, Merged, Survivors};
use crate::model::{Columns, Gaussians};
use crate::pass::FrameSource;
use crate::recipe::{self, Recipe};
use crate::stream::motion::PairMeter;
use crate::stream::{BLOCK, gather};

/// Memory of a Gaussian that may survive: its id, its state with base colours only, and whether it may merge. Twice
/// the ids while merging is tried on some of them.
pub const BYTES_PER_SURVIVOR: usize = 2 * 4 + 4 * 14 + 1;

/// Gaussians whose whole state is in memory at a time, while what merging does not read of it is dropped.
const GATHERED: usize = 16 * BLOCK;

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
    /// What merging did; none where it was left out.
    pub summary: Option<MergeSummary>,
    /// What is added to the base colours (`f_dc`), by place in the output; empty: nothing.
    pub recolor: Vec<[f32; 3]>,
}

impl Sieved {
    /// The Gaussians `kept` (increasing) as they are.
    pub fn pruned(kept: Vec<u32>) -> Self {
        Sieved { kept, clusters: Vec::new(), summary: None, recolor: Vec::new() }
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
    scored: &'a Scored,
    /// The recipe's, with a noise floor no lower than that of the positions.
    merge: recipe::Merge,
    /// Ids whose states are known, increasing.
    pool: Vec<u32>,
    /// Their states at the reference frame, of the harmonics the first band.
    states: Gaussians,
    /// Whether each may merge.
    mergeable: Vec<bool>,
    /// C and Vis by id.
    importance: [Cow<'a, [f64]>; 2],
    meter: PairMeter<'a>,
    /// Pairs measured together.
    pairs_together: usize,
    /// How pairs of the pool move: it does not depend on who else survives.
    known: KnownPairs,
}

impl<'a> Job<'a> {
    fn new(scene: &'a Scene, scored: &'a Scored, recipe: &'a Recipe, pool: Vec<u32>) -> Result<Self> {
        let source = scene.input.source();
        let (states, mut mergeable) = states_of(source, &pool, scored.reference.frame)?;
        for id in &scored.protected {
            if let Ok(row) = pool.binary_search(id) {
                mergeable[row] = false;
            }
        }
        let mut merge = recipe.merge.clone();
        let unit = merge.length_unit.in_scene_units(scored.reference.extent);
        merge.motion_noise = merge.motion_noise.max(2.0 * scored.position_ulp / unit);
        let meter = PairMeter {
            source,
            scan: &recipe.scan,
            gate: MotionGate::new(&merge, unit),
            frames_held: scene.limits.frames_held,
            scratch: scene.scratch_folder(),
            gathered: None,
        };
        let (pairs_together, known) = (scene.limits.pairs_together, KnownPairs::default());
        let importance = scored.importance()?;
        Ok(Job { scored, merge, pool, states, mergeable, importance, meter, pairs_together, known })
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
        let Job { scored, merge, pool, states, mergeable, importance, meter, pairs_together, known } = self;
        let [coverage, visibility] = &*importance;
        let survivors = Survivors {
            states,
            rows: &places_of(survivors, pool),
            importance: Importance { ids: pool, coverage, visibility },
            mergeable,
            extent: scored.reference.extent,
        };
        let most = *pairs_together;
        let merged = merge::run(&survivors, merge, limit, most, |asked| {
            let missing = known.missing(asked.pairs());
            let found = match missing.is_empty() {
                true => Vec::new(),
                false => meter.measure(pool, &states.position, missing, asked.reach, asked.is_part)?,
            };
            let found = KnownPairs::new(found);
            let likeness = |pair| known.likeness(pair).or_else(|| found.likeness(pair)).unwrap_or(f64::NAN);
            let answer = asked.pairs().map(likeness).collect();
            known.add(found, most);
            Ok::<_, Error>(answer)
        })?;
        Ok(sieved(&survivors, &merged, scored.reference.frame, merge))
    }
}

/// What `merged` leaves of `survivors`.
fn sieved(survivors: &Survivors<'_>, merged: &Merged, reference_frame: usize, merge: &recipe::Merge) -> Sieved {
    let (groups, importance) = (&merged.groups, &survivors.importance);
    let id = |row: u32| importance.ids[row as usize];
    let clusters: Vec<Cluster> = groups
        .clusters()
        .map(|group| {
            let rows = groups.members(group as usize);
            let ids = rows.iter().map(|&row| id(row));
            let members = ids.zip(weights(rows, importance, survivors.states)).collect();
            Cluster { output: group, leader: id(groups.leaders()[group as usize]), members }
        })
        .collect();
    let summary = MergeSummary {
        reference_frame,
        proxies: clusters.len(),
        members: clusters.iter().map(|cluster| cluster.members.len()).sum(),
        opacity: merge.opacity,
        passes: merged.passes.clone(),
        deviation: None,
    };
    let kept = groups.leaders().iter().map(|&row| id(row)).collect();
    Sieved { kept, clusters, summary: Some(summary), recolor: Vec::new() }
}

/// States of the Gaussians `ids` (increasing) at `frame`, of the harmonics the first band; and whether the whole state
/// is finite. Without frames all is zero.
fn states_of(source: &dyn FrameSource, ids: &[u32], frame: usize) -> Result<(Gaussians, Vec<bool>)> {
    let mut states = Gaussians::zeros(ids.len(), 0);
    let mut finite = vec![true; ids.len()];
    if source.info().times.is_empty() {
        return Ok((states, finite));
    }
    for (ids, start) in ids.chunks(GATHERED).zip((0..).step_by(GATHERED)) {
        let whole = gather(source, ids, frame, Columns::ALL)?;
        states.write_rows(start, &whole);
        for (row, finite) in finite[start..].iter_mut().take(ids.len()).enumerate() {
            *finite = merge::is_finite(&whole, row);
        }
    }
    Ok((states, finite))
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
