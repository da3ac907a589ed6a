//! Stage `merge`: replaces clusters of similar survivors (Gaussians that are not removed) by one Gaussian each, a
//! proxy.
//!
//! Memory:
//! - [`BYTES_PER_SURVIVOR`] for every Gaussian that may survive;
//! - the memory of survivors and of candidate pairs, stated in [`crate::merging`];
//! - the memory of the pairs that are measured at the same time, stated in [`crate::merging::motion_pass`].

use std::borrow::Cow;
use std::cell::RefCell;
use std::ops::Range;

use rayon::slice::ParallelSliceMut;
use serde::{Deserialize, Serialize};

use crate::cache::Cache;
use crate::compressed_model::{Cluster, CompressedModel};
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::merging;
use crate::merging::motion::MotionThresholds;
use crate::merging::motion_pass;
use crate::merging::motion_pass::PairMeter;
use crate::merging::proxy::{Importance, weights};
use crate::merging::similarity_cache::{PairSimilarity, SimilarityCache};
use crate::merging::voxels::voxel_order;
use crate::merging::{MergeResult, RequestedPairs, Survivors};
use crate::model::{AttributeValues, Attributes, Gaussians, inverse_permutation};
use crate::models::trajectories::state_bytes;
use crate::passes::{GAUSSIANS_PER_BLOCK, gather};
use crate::pipeline::planning::Planning;
use crate::pipeline::request::PruneOrMerge;
use crate::pipeline::stage::{CountPlan, EstimateInput, Phase, RunState, Stage, StageList};
use crate::pipeline::summary::MergeSummary;
use crate::progress::Progress;
use crate::pruning::Ranking;
use crate::pruning::score::{Scored, scored_memory};
use crate::recipe;
use crate::scene::Scene;
use crate::source::FrameSource;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "merge";

/// Name under which the measured motion similarities of pairs of Gaussians are cached. The measurement can be divided
/// into shards (parts of a divided stage).
pub(crate) const PAIRS: &str = "pairs";
/// Minimum number of pairs of Gaussians for which the measurement of their motion is divided into shards (parts of a
/// divided stage).
const MIN_DIVIDED_PAIRS: usize = 20_000;

/// Bytes of memory of the stage for each Gaussian that may survive. The terms are, in order: its id in two lists (all
/// such Gaussians, and the set that is being merged); its state with base colors only; whether its state is finite, and
/// its merge class (only Gaussians of the same class may merge).
const BYTES_PER_SURVIVOR: usize = 2 * size_of::<u32>() + size_of::<[f32; 14]>() + size_of::<(bool, Option<u8>)>();

/// Assumed number of trials of the secant search ([`bracket`]), each of which merges a different number of survivors
/// (Gaussians left by pruning), until exactly the requested number of Gaussians is left. Used to estimate reads;
/// usually fewer trials are needed.
const USUAL_TRIALS: f64 = 16.0;

/// Number of Gaussians whose states with all attributes are read at a time, at the reference frame (at which Gaussians
/// are compared). Merging then keeps only the attributes that it uses.
const GATHER_CHUNK: usize = 16 * GAUSSIANS_PER_BLOCK;

/// Processor time per Gaussian of finding neighbors, testing pairs and forming clusters, seconds (`benches/merge.rs`).
const SECONDS_TO_MERGE: f64 = 1e-5;
/// Approximate fraction of the Gaussians that belong to a pair whose motion is compared over all frames.
const FOLLOWED_FRACTION: f64 = 0.3;

/// Stage that merges similar survivors (Gaussians that are not removed).
#[derive(Debug, Clone)]
pub(crate) struct MergeStage {
    /// Parameters of the tests for similarity, of the merge passes, and of the proxies (Gaussians that replace merged
    /// clusters).
    pub recipe: recipe::MergeParams,
    /// Parameters of the scan, which define in which frames a Gaussian is alive (its life span: opacity ≥ alpha_min)
    /// and how motion between frames is measured.
    pub scan: recipe::ScanParams,
    /// Whether survivors (Gaussians left by pruning) may be pruned in addition to merging, to reach the requested
    /// number of Gaussians.
    pub prunes: bool,
    /// Exact number of Gaussians in the output, if requested.
    pub target: Option<usize>,
}

/// Result of merging: the compressed model, and statistics of the merge passes.
#[derive(Serialize, Deserialize)]
pub(crate) struct MergeOutcome {
    /// Compressed model with its merged clusters.
    pub compressed: CompressedModel,
    /// Statistics of every merge pass, such as numbers of joins; `None` if nothing was merged.
    pub summary: Option<MergeSummary>,
}

/// Adds the stage that merges survivors (Gaussians left by pruning) to `stages` if the run merges. If it does not,
/// records the reason in `stages`.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    let recipe = &planning.request.recipe;
    let stage = MergeStage {
        recipe: recipe.merge.clone(),
        scan: recipe.scan.clone(),
        prunes: planning.prunes,
        target: planning.target,
    };
    if planning.merges {
        stages.add(Phase::Reduce, stage);
        return;
    }
    let what = "merging, and its pass over the frames";
    let has_passes = !recipe.merge.passes.is_empty();
    let why = match planning.request.only {
        PruneOrMerge::Prune => "--prune-only",
        _ if !has_passes => "the recipe has no merge pass",
        _ if planning.request.goal.is_some() => "a quality or a size on disk is reached by pruning alone",
        _ => "refinement gives better quality at the same count (--no-refine merges instead)",
    };
    match has_passes {
        true => stages.leave_out_stage(what, why, move |work, limits| stage.resource_estimate(work, limits)),
        false => stages.leave_out(what, why),
    }
}

impl Stage for MergeStage {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits)]
    }

    fn parameters(&self) -> String {
        format!("merge: {} passes", self.recipe.passes.len())
    }

    fn describe_shardable_work(&self, _: &Scene, _: &CountPlan) -> Vec<String> {
        self.recipe.passes.iter().map(|_| format!("{PAIRS}: pairs of neighbors")).collect()
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scored, ranking) = (run.scored()?, run.ranking()?);
        let found = self.merge(run.scene, &scored, &ranking, run.result.len(), &mut run.journal)?;
        run.result = CompressedModel { sh_degree: run.template.sh_degree, ..found.compressed };
        run.merge = found.summary;
        Ok(())
    }
}

impl MergeStage {
    /// Returns the resource estimate of the stage. Its memory holds the pairs that are measured at the same time, all
    /// Gaussians that may survive, and the proxies (Gaussians that replace merged clusters).
    pub(crate) fn resource_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let pairs = (merging::BYTES_PER_PAIR + motion_pass::BYTES_PER_PAIR) as u64;
        // Only base colors are compared, so proxies are held without higher SH degrees before and after a pass (twice).
        // Later they are held once, with all SH coefficients. There is at most one proxy for every two Gaussians.
        let proxies = state_bytes(0, Attributes::all()).max(work.state_bytes(Attributes::all()).div_ceil(2));
        let per_gaussian = vec![
            // The importances C (contribution) and Vis (fraction of views that may show the Gaussian) are read back
            // from disk if they were moved there.
            ("importance", if limits.statistics_on_disk { 16 } else { 0 }),
            ("candidates", BYTES_PER_SURVIVOR as u64),
            ("proxies", proxies),
            ("survivors", merging::BYTES_PER_SURVIVOR as u64),
            ("passing pairs", (self.recipe.max_neighbors * merging::BYTES_PER_PASSED_PAIR) as u64),
            ("readers", work.input.reader),
            ("pair motion", motion_pass::bytes_per_gaussian(limits.max_kept_frames) as u64),
        ];
        // States are read once. Every pass of every trial follows its pairs over all frames twice, because coinciding
        // pairs, if there are any, are merged first.
        let trials = if self.target.is_some() && self.prunes { USUAL_TRIALS } else { 1.0 };
        let followed =
            2.0 * trials * self.recipe.passes.len() as f64 * work.scattered_whole_input_reads(work.frames, limits);
        ResourceEstimate {
            stage: NAME,
            reads: work.scattered_whole_input_reads(1, limits) + followed,
            seconds: SECONDS_TO_MERGE * work.gaussian_count()
                + FOLLOWED_FRACTION * work.reading_seconds(work.gaussian_count(), work.frames as f64),
            per_gaussian: [scored_memory(limits), per_gaussian].concat(),
            fixed: vec![("pairs", (limits.pairs_together as u64).saturating_mul(pairs)), work.block_buffer_memory()],
        }
    }

    /// Merges the first `survivors` Gaussians of the ranking, computes the parameters of the proxies (Gaussians that
    /// replace merged clusters), and returns the merged model. If an exact number of Gaussians is requested and
    /// Gaussians may be pruned, merges only the first m Gaussians of the ranking, where m is chosen so that merging
    /// leaves exactly the requested number.
    ///
    /// # Errors
    /// Fails if frames cannot be read, or if merging without pruning cannot reach the requested number.
    pub(crate) fn merge(
        &self,
        scene: &Scene,
        scored: &Scored,
        ranking: &Ranking,
        survivors: usize,
        journal: &mut Journal,
    ) -> Result<MergeOutcome> {
        // Importances may have to be read from disk, so they are read only if a cache key is needed.
        let importance = scene.work.is_enabled().then(|| scored.importance()).transpose()?;
        let key = scene.work.key(&(
            (&self.recipe, self.scan.alpha_min, self.scan.motion, self.prunes, self.target, survivors),
            (ranking, &scored.protected, scored.reference, scored.position_ulp, importance),
        ));
        let run = |journal: &mut Journal| {
            journal.run_stage(NAME, survivors, scene.source(), |_| {
                // The progress task also covers the computation of the proxies.
                let progress = scene.events.counting_task(NAME, "survivor sets");
                let mut trial = Trial::new(scene, scored, self, ranking.best_ids(survivors), &progress)?;
                let mut merged = match self.target {
                    None => trial.merge(&ranking.best_ids(survivors), None)?,
                    Some(target) if !self.prunes => trial.merge_to(&ranking.best_ids(survivors), target)?,
                    Some(target) => {
                        let count = |m| Ok(trial.merge(&ranking.best_ids(m), None)?.compressed.len());
                        let m = bracket(target, survivors, count)?;
                        trial.merge_to(&ranking.best_ids(m), target)?
                    }
                };
                drop(trial);
                scene.work.end_shard_run_before(NAME)?;
                let MergeOutcome { compressed, summary } = &mut merged;
                let proxies = scene.input.compute_proxies(&compressed.clusters, scored.reference, &self.recipe)?;
                compressed.set_proxies(proxies);
                if let Some(summary) = summary {
                    summary.deviation = compressed.proxies.deviation;
                    summary.count(&compressed.clusters);
                }
                let left = compressed.len();
                Ok((merged, left))
            })
        };
        journal.cached(&scene.work, NAME, key, run)
    }
}

/// Finds how many survivors (Gaussians left by pruning) to merge, so that about `target` Gaussians are left afterwards.
/// Merging consists of joins; each join replaces two similar Gaussians or clusters by one, so it lowers the number of
/// Gaussians by 1.
/// - `survivor_count`: number of all survivors.
/// - `merged_count`: merges the given number of survivors with all possible joins, and returns the number of Gaussians
///   left.
///
/// Returns a number m, from `target` to `survivor_count`, for which at most `target` Gaussians are left; it is about
/// the largest. Such an m exists, because `target` survivors leave at most `target` Gaussians. The caller merges m
/// survivors again and stops after m − `target` joins. Then exactly `target` Gaussians are left.
///
/// The search narrows the interval of possible m by the secant method. This works because more survivors leave more
/// Gaussians after merging, except for small dips. It ends early if at most `target`/1000 Gaussians too few are left.
fn bracket(
    target: usize,
    survivor_count: usize,
    mut merged_count: impl FnMut(usize) -> Result<usize>,
) -> Result<usize> {
    let (mut low, mut high) = (target, survivor_count);
    let mut high_count = merged_count(high)?;
    if high_count <= target {
        return Ok(high);
    }
    let mut low_count = merged_count(low)?;
    while high - low > 1 && target - low_count > target / 1000 {
        let slope = (target - low_count) as f64 / (high_count - low_count) as f64;
        // Stay away from the ends of the interval, so that a curved count cannot stall the search.
        let m = low + ((high - low) as f64 * slope.clamp(0.1, 0.9)) as usize;
        let m = m.clamp(low + 1, high - 1);
        let count = merged_count(m)?;
        if count <= target {
            (low, low_count) = (m, count);
        } else {
            (high, high_count) = (m, count);
        }
    }
    Ok(low)
}

/// Input of merging, kept in memory so that merging can be tried on many sets of survivors (Gaussians left by pruning).
struct Trial<'a> {
    scored: &'a Scored,
    /// Merge parameters of the recipe, with a larger `motion_noise` if necessary: at least twice the distance between
    /// neighboring f32 values at the scene's largest coordinate. (`motion_noise` is the noise of a step from frame to
    /// frame, when motions are compared.)
    merge: recipe::MergeParams,
    /// Ids, in increasing order, of the Gaussians whose states are in memory. These Gaussians are called the pool.
    pool: Vec<u32>,
    /// States at the reference frame of the Gaussians in the pool (Gaussians in memory), with base colors only.
    states: Gaussians,
    /// Merge class of each Gaussian in the pool (Gaussians in memory). Only Gaussians of the same class may merge.
    /// `None`: the Gaussian never merges.
    classes: Vec<Option<u8>>,
    /// Two importances of all Gaussians, by id: contribution C, and Vis, the fraction of the views in which the
    /// Gaussian is alive and on screen.
    importance: [Cow<'a, [f64]>; 2],
    meter: PairMeter<'a>,
    work: &'a Cache,
    /// Maximum number of pairs of Gaussians whose motion is compared at the same time.
    pairs_together: usize,
    /// Similarities of motion measured so far, by pair of Gaussians. They stay valid for every set of survivors
    /// (Gaussians left by pruning) that is tried.
    similarities: SimilarityCache,
    /// Progress display of the stage: one unit per set of survivors (Gaussians left by pruning) on which merging was
    /// tried.
    progress: &'a Progress,
}

impl<'a> Trial<'a> {
    fn new(
        scene: &'a Scene,
        scored: &'a Scored,
        stage: &'a MergeStage,
        pool: Vec<u32>,
        progress: &'a Progress,
    ) -> Result<Self> {
        let source = scene.source();
        let (states, finite) = states_of(source, &pool, scored.reference.frame)?;
        let class = |(&id, is_finite): (&u32, bool)| is_finite.then(|| scene.input.merge_class(id));
        let mut classes: Vec<Option<u8>> = pool.iter().zip(finite).map(class).collect();
        for id in &scored.protected {
            if let Ok(row) = pool.binary_search(id) {
                classes[row] = None;
            }
        }
        let mut merge = stage.recipe.clone();
        let unit = merge.length_unit.in_scene_units(scored.reference.extent);
        merge.motion_noise = merge.motion_noise.max(2.0 * scored.position_ulp / unit);
        let meter = PairMeter::new(
            source,
            &stage.scan,
            MotionThresholds::new(&merge, unit),
            scene.limits.max_kept_frames,
            scene.scratch.clone(),
            scene.events.clone(),
        );
        let (pairs_together, similarities) = (scene.limits.pairs_together, SimilarityCache::default());
        let importance = scored.importance()?;
        let work = &scene.work;
        Ok(Trial {
            scored,
            merge,
            pool,
            states,
            classes,
            importance,
            meter,
            work,
            pairs_together,
            similarities,
            progress,
        })
    }

    /// Merges `survivors` (increasing ids of Gaussians left by pruning) so that exactly `target` Gaussians are left,
    /// and returns the result. Fails if merging cannot reduce their number to `target`.
    fn merge_to(&mut self, survivors: &[u32], target: usize) -> Result<MergeOutcome> {
        let merged = self.merge(survivors, Some(survivors.len() - target))?;
        let remaining = merged.compressed.len();
        if remaining > target {
            return Err(Error::usage(format!(
                "a target of {target} Gaussians, but merging alone leaves {remaining} at the least\n  \
                 allow pruning, or looser merge passes"
            )));
        }
        Ok(merged)
    }

    /// Merges `survivors` (increasing ids, all in the pool of Gaussians in memory), and returns the result. If `limit`
    /// is given, stops after this number of joins (a join reduces the number of Gaussians by one).
    fn merge(&mut self, survivors: &[u32], limit: Option<usize>) -> Result<MergeOutcome> {
        let Trial {
            scored,
            merge,
            pool,
            states,
            classes,
            importance,
            meter,
            work,
            pairs_together,
            similarities,
            progress,
        } = self;
        let [coverage, visibility] = &*importance;
        let survivors = Survivors {
            states,
            rows: &indices_in(survivors, pool),
            importance: Importance { ids: pool, coverage, visibility },
            classes,
            extent: scored.reference.extent,
        };
        let max_pairs = *pairs_together;
        let merged = merging::merge_survivors(&survivors, merge, limit, max_pairs, |requested| {
            let missing = similarities.missing(requested.pairs());
            let measured = match missing.is_empty() {
                true => Vec::new(),
                false => measure(work, meter, (pool, &states.position), missing, &requested, merge)?,
            };
            let measured = SimilarityCache::new(measured);
            let similarity =
                |pair| similarities.similarity(pair).or_else(|| measured.similarity(pair)).unwrap_or(f64::NAN);
            let answer = requested.pairs().map(similarity).collect();
            similarities.merge_from(measured, max_pairs);
            Ok::<_, Error>(answer)
        })?;
        progress.advance(1);
        Ok(outcome(&survivors, &merged, scored.reference.frame, merge))
    }
}

/// Measures the motion similarity of the two Gaussians of each pair in `pairs`, and returns the pairs with their
/// similarities, in no particular order. The pairs hold indices in `pool`, the ids of the Gaussians in memory;
/// `reference` holds the positions of these Gaussians at the reference frame. If the cache is enabled and there are at
/// least [`MIN_DIVIDED_PAIRS`] pairs, sorts them by position in space and divides them into shards, which several
/// processes can measure.
fn measure(
    work: &Cache,
    meter: &mut PairMeter<'_>,
    (pool, reference): (&[u32], &AttributeValues),
    mut pairs: Vec<(u32, u32)>,
    requested: &RequestedPairs<'_>,
    merge: &recipe::MergeParams,
) -> Result<Vec<PairSimilarity>> {
    if !work.is_enabled() || pairs.len() < MIN_DIVIDED_PAIRS {
        return meter.measure(pool, reference, pairs, requested.max_distance, requested.is_part);
    }
    // Pairs are sorted by position, so that few shards read the same Gaussians.
    let rows: Vec<u32> = (0..pool.len() as u32).collect();
    let place = inverse_permutation(&voxel_order(&rows, |row| reference.row(row as usize), requested.max_distance));
    pairs.par_sort_unstable_by_key(|&(a, b)| (place[a as usize], place[b as usize]));
    let key = work.key(&(merge, meter.scan().alpha_min, meter.scan().motion, pool, &pairs));
    let (fresh, meter) = (meter.without_trajectories(), RefCell::new(meter));
    let compute = |range: Range<usize>| match range.len() == pairs.len() {
        true => meter.borrow_mut().measure(pool, reference, pairs.clone(), requested.max_distance, requested.is_part),
        // The pairs of a shard are measured once, and share no buffers with other shards.
        false => {
            fresh.without_trajectories().measure(pool, reference, pairs[range].to_vec(), requested.max_distance, false)
        }
    };
    work.compute_in_shards(PAIRS, key, pairs.len(), compute, |parts| {
        let mut similarities = Vec::with_capacity(pairs.len());
        for part in parts {
            similarities.extend(part?);
        }
        Ok(similarities)
    })
}

/// Returns the compressed model of `survivors` (Gaussians left by pruning), and a summary of how many Gaussians each
/// merge pass joined. In the model, a proxy (one Gaussian) replaces each cluster in `merged`. `reference_frame`: frame
/// at which the Gaussians were compared. `merge`: merge parameters.
fn outcome(
    survivors: &Survivors<'_>,
    merged: &MergeResult,
    reference_frame: usize,
    merge: &recipe::MergeParams,
) -> MergeOutcome {
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
    let mut summary = MergeSummary {
        reference_frame,
        proxies: 0,
        members: 0,
        opacity: merge.opacity,
        passes: merged.passes.clone(),
        deviation: None,
    };
    summary.count(&clusters);
    let kept = groups.leaders().iter().map(|&row| id(row)).collect();
    MergeOutcome {
        compressed: CompressedModel { clusters, ..CompressedModel::pruned(kept, merge) },
        summary: Some(summary),
    }
}

/// Returns the states of the Gaussians `ids` (increasing) at `frame` with base colors only, and for each Gaussian
/// whether all its attributes are finite. All values are zero if there are no frames.
fn states_of(source: &dyn FrameSource, ids: &[u32], frame: usize) -> Result<(Gaussians, Vec<bool>)> {
    let mut states = Gaussians::zeros(ids.len(), 0);
    let mut finite = vec![true; ids.len()];
    if source.info().times.is_empty() {
        return Ok((states, finite));
    }
    for (ids, start) in ids.chunks(GATHER_CHUNK).zip((0..).step_by(GATHER_CHUNK)) {
        let whole = gather(source, ids, frame, Attributes::all())?;
        states.write_rows(start, &whole);
        for (row, finite) in finite[start..].iter_mut().take(ids.len()).enumerate() {
            *finite = merging::is_finite(&whole, row);
        }
    }
    Ok((states, finite))
}

/// Returns the index in `pool` of each of `ids`. Both are increasing, and `ids` is a subset of `pool`.
fn indices_in(ids: &[u32], pool: &[u32]) -> Vec<u32> {
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
        // Model of merging: half of the Gaussians beyond the first hundred disappear.
        for target in [1, 50, 100, 101, 400, 549, 550, 1000] {
            let count = |m: usize| m.min(100) + m.saturating_sub(100) / 2;
            let m = bracket(target, 1000, |m| Ok(count(m))).unwrap();
            assert!(count(m) <= target && m >= target, "target {target}, got {m}");
            assert!(m == 1000 || count(m + 2) > target - target / 1000, "target {target}: {m} could be larger");
        }
    }

    #[test]
    fn indices_follow_the_ids() {
        assert_eq!(indices_in(&[2, 5, 9], &[1, 2, 3, 5, 9]), [1, 3, 4]);
        assert!(indices_in(&[], &[4]).is_empty());
    }
}
