//! Stage `rounds`: ranks the Gaussians by removal error (squared error of renders caused by removing one) in pruning
//! rounds, each of which measures the errors anew on a smaller model.
//!
//! For strong reductions, one measurement on the full model is not enough. When a Gaussian is removed, Gaussians behind
//! it become visible, and others become necessary that were redundant beside it. So each round measures the survivors
//! (Gaussians not removed so far), ranks them by [`RemovalError`](crate::render::RemovalError) and removes the lowest.
//! The survivors of a round do not depend on the final number of Gaussians, so a smaller target keeps a subset of a
//! larger one. Memory: see [`removal_error`].

use std::ops::Range;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::cache::CacheKey;
use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{REMOVAL_COST, ResourceEstimate, Workload};
use crate::model::{Attributes, FrameView};
use crate::passes::{VIEWS_PER_FRAME, pixel_stride, select_evenly_over_frames};
use crate::pipeline::planning::Planning;
use crate::pipeline::stage::{CountPlan, EstimateInput, Phase, RunState, Stage, StageList};
use crate::progress::Progress;
use crate::pruning::Ranking;
use crate::pruning::removal::removal_error;
use crate::pruning::score::{Scored, scored_memory};
use crate::recipe;
use crate::render::GridStrides;
use crate::scene::Scene;

/// Name of this stage in plans, progress and summaries.
pub(crate) const NAME: &str = "rounds";

/// Stage that ranks Gaussians in pruning rounds. A round ranks the survivors (Gaussians not removed so far) by removal
/// error, the squared error of renders caused by removing one of them, and removes the lowest-ranked.
#[derive(Debug, Clone)]
pub(crate) struct Rounds {
    /// Fraction of the remaining Gaussians that one pruning round keeps.
    pub fraction: f64,
    /// Number of views by which Gaussians are ranked. It does not grow with the number of frames.
    pub views: usize,
    /// Whether fewer frames are read, with more views of each, if opacities do not vary with time.
    pub fewer_frames: bool,
    /// Number of groups into which the views are divided. The first round renders the views of all groups. Every later
    /// round renders only one group; for all other groups it uses the errors that earlier rounds measured.
    pub groups: usize,
    /// Constant c of the removal errors: c² is added to each squared difference between the color of a Gaussian and the
    /// color behind it (norm over red, green and blue, each from 0 to 1). Otherwise a Gaussian with the color of its
    /// background would have a removal error of 0.
    pub contrast_floor: f64,
    /// Wanted number of rendered pixels of a view per Gaussian of the first round. It determines the stride of the
    /// rendered pixels. More pixels change the ranking less than a different choice of views does.
    pub pixels_per_gaussian: f64,
    /// Smallest fraction of the Gaussians of the input that the last pruning round may leave, as assumed in estimates.
    /// It bounds the number of pruning rounds.
    pub fewest: f64,
    /// Fraction of the Gaussians of the input that the last pruning round usually leaves; used for estimates of time.
    pub usual: f64,
}

/// Value of [`Rounds::pixels_per_gaussian`] if the ranking alone decides which Gaussians stay. Three trained scenes have
/// the same quality with 0.5 as with 1, at 60 and 30% kept; with 0.35 they have 0.1 to 0.3 dB less.
const PIXELS_PER_GAUSSIAN: f64 = 0.5;
/// Value of [`Rounds::pixels_per_gaussian`] if refinement follows, which makes up for the difference.
const PIXELS_BEFORE_REFINEMENT: f64 = 0.35;
/// Maximum number of views of one frame by which Gaussians are ranked if [`Rounds::fewer_frames`] is true and opacities
/// do not vary with time. Two such models have at least the mean PSNR over four counts that they have with
/// [`VIEWS_PER_FRAME`]. With varying opacities, [`VIEWS_PER_FRAME`] stays the maximum: otherwise `spinach_4`, whose
/// Gaussians fade in and out, would lose 0.4 dB at 10% kept and 13 dB at 40%.
const VIEWS_OF_FEWER_FRAMES: usize = 2 * VIEWS_PER_FRAME;
/// Power of the recipe's fraction of the Gaussians that a round keeps, if refinement follows, so that there are fewer
/// rounds. The prune steps of refinement choose again among what the rounds leave. If refinement has no prune steps, or
/// is left out because the result is good enough, the rounds alone choose (`spinach_4`, 40% kept: 66.1 dB with both
/// fractions).
const FRACTION_POWER_BEFORE_REFINEMENT: f64 = 1.4;
/// Value of [`Rounds::fewest`] (smallest fraction of the Gaussians that the last pruning round is assumed to leave) if
/// the user requests no number of Gaussians.
const MIN_LEFT: f64 = 0.05;
/// Value of [`Rounds::usual`] (fraction of the Gaussians that the last pruning round usually leaves) if the user
/// requests no number of Gaussians.
const USUAL_LEFT: f64 = 0.5;

/// Adds the stage that ranks Gaussians in pruning rounds to `stages` if Gaussians are pruned by a ranking on rendered
/// views and the recipe asks for several rounds.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    let rounds = Rounds::from_recipe(&planning.request.recipe.select, planning.target_fraction());
    if let Some(mut rounds) = rounds.filter(|_| planning.prunes_by_views()) {
        if planning.refine.is_some() {
            rounds.pixels_per_gaussian = PIXELS_BEFORE_REFINEMENT;
            rounds.fewer_frames = true;
            rounds.fraction = rounds.fraction.powf(FRACTION_POWER_BEFORE_REFINEMENT);
        }
        stages.add(Phase::Rank, rounds);
    }
}

impl Stage for Rounds {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits)]
    }

    fn parameters(&self) -> String {
        let (percent, Rounds { views, groups, .. }) = (100.0 * self.fraction, self);
        format!("rounds: each keeps {percent:.0}% of the Gaussians, ranked on {views} views in {groups} groups")
    }

    fn describe_shardable_work(&self, scene: &Scene, counts: &CountPlan) -> Vec<String> {
        let count = scene.source().info().count;
        let usual = (self.usual * count as f64).ceil() as usize;
        self.shardable_rounds(count, counts.count_after_ranking(usual, count))
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scored, ranking) = (run.scored()?, run.ranking()?);
        let wanted = run.target.unwrap_or(scored.selection.counts.kept);
        let fewest = run.stages.counts.count_after_ranking(wanted, scored.gaussian_count());
        run.ranking = None;
        let ranking = Arc::unwrap_or_clone(ranking);
        run.ranking = Some(Arc::new(self.rank(run.scene, &scored, ranking, fewest, &mut run.journal)?));
        Ok(())
    }
}

impl Rounds {
    /// Returns the stage that ranks Gaussians in pruning rounds, or `None` if `recipe` ranks only once. `target` is the
    /// requested fraction of the Gaussians, if any. The stage can run only if the visible contributions of the
    /// Gaussians were measured.
    pub(crate) fn from_recipe(recipe: &recipe::SelectParams, target: Option<f64>) -> Option<Rounds> {
        let recipe::SelectParams {
            round_fraction: fraction,
            round_views: views,
            round_groups: groups,
            contrast_floor,
            ..
        } = *recipe;
        let (fewest, usual) = (target.unwrap_or(MIN_LEFT), target.unwrap_or(USUAL_LEFT));
        let (fewer_frames, pixels_per_gaussian) = (false, PIXELS_PER_GAUSSIAN);
        let rounds =
            Rounds { fraction, views, fewer_frames, groups, contrast_floor, pixels_per_gaussian, fewest, usual };
        (fraction < 1.0).then_some(rounds)
    }

    /// Returns the resource estimate of the stage. Its memory holds the ranking, the measured removal errors, and the
    /// buffers for rendering all survivors (Gaussians left by pruning).
    pub(crate) fn resource_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let (looking, fixed) = work.view_pass_memory(limits, Attributes::all(), 8);
        let all = (self.views as u64).min(work.frame_views);
        let groups = (self.groups as u64).min(all).max(1);
        let per_gaussian =
            [scored_memory(limits), vec![("ranking", 32), ("errors", 8 * groups), ("new errors", 8 * groups)], looking]
                .concat();
        let seconds = (0..self.rounds(self.usual)).map(|round| {
            let left = work.gaussian_count() * self.fraction.powi(round as i32);
            let views = all as f64 / if round == 0 { 1.0 } else { groups as f64 };
            let frames = (views / self.views_per_frame(work.varying) as f64).min(work.frames as f64);
            work.reading_seconds(left, frames) + work.render_seconds(views, left, REMOVAL_COST)
        });
        // The first round renders the views of all groups one group after the other, every later round one group.
        let frames = all.min(work.frames).div_ceil(groups);
        let later = f64::from(self.rounds(self.fewest).saturating_sub(1));
        let reads = (groups as f64 + later) * work.scattered_whole_input_reads(frames, limits);
        ResourceEstimate { stage: NAME, reads, seconds: seconds.sum(), per_gaussian, fixed }
    }

    /// Returns the number of pruning rounds until at most the fraction `fewest` of the Gaussians is left. It is at most
    /// 2207, because the fraction left by a round is at most [`MAX_ROUND_FRACTION`](recipe::MAX_ROUND_FRACTION) and
    /// there are at most `u32::MAX` Gaussians.
    fn rounds(&self, fewest: f64) -> u32 {
        let fewest = fewest.max(1.0 / f64::from(u32::MAX));
        (fewest.ln() / self.fraction.ln()).ceil().max(0.0) as u32
    }

    /// Returns one line of text for display per pruning round that reduces `count` Gaussians to `fewest`. A line has
    /// the name of the round and the maximum number of views that it renders.
    pub(crate) fn shardable_rounds(&self, count: usize, fewest: usize) -> Vec<String> {
        let view_count = |round: usize| self.views.div_ceil(if round == 0 { 1 } else { self.groups.max(1) });
        let rounds = 0..self.sizes(count, 0, fewest).len();
        rounds.map(|round| format!("{}: {} views at most", entry_name(round), view_count(round))).collect()
    }

    /// Returns the maximum number of views of one frame by which Gaussians are ranked, if the attributes `varying` vary
    /// with time.
    fn views_per_frame(&self, varying: Attributes) -> usize {
        let are_fewer = self.fewer_frames && !varying.contains(Attributes::OPACITY);
        if are_fewer { VIEWS_OF_FEWER_FRAMES } else { VIEWS_PER_FRAME }
    }

    /// Returns the views by which Gaussians are ranked, divided into groups. Views of the same frame are in the same
    /// group, unless there are fewer frames than groups.
    fn view_groups(&self, scene: &Scene, scored: &Scored) -> Vec<Vec<FrameView>> {
        let views_per_frame = self.views_per_frame(scene.source().info().varying);
        let frames = scored.frames_needed_to_see_all;
        let views = select_evenly_over_frames(&scene.schedule, self.views, frames, views_per_frame);
        let by_frame: Vec<&[FrameView]> = views.chunk_by(|a, b| a.frame == b.frame).collect();
        let parts = if by_frame.len() < self.groups { views.chunks(1).collect() } else { by_frame };
        let mut groups = vec![Vec::new(); self.groups.min(parts.len())];
        let count = groups.len().max(1);
        parts.into_iter().enumerate().for_each(|(k, part)| groups[k % count].extend_from_slice(part));
        groups
    }

    /// Ranks the Gaussians of the ranking `before` anew by pruning rounds, until a round leaves at most `fewest`, and
    /// returns the new ranking. If no round is needed, returns `before`.
    ///
    /// The new ranking consists of these sets, in order:
    /// - the Gaussians that must stay, sorted by id;
    /// - the other survivors of the last round, sorted by descending removal error;
    /// - the Gaussians removed in each round, from the last round to the first, sorted in the same way within a round.
    ///
    /// Gaussians with equal removal errors keep the order that they had before the round; at first, this is the order
    /// of `before`.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    pub(crate) fn rank(
        &self,
        scene: &Scene,
        scored: &Scored,
        before: Ranking,
        fewest: usize,
        journal: &mut Journal,
    ) -> Result<Ranking> {
        let protected = &scored.protected;
        let is_free = |id: &u32| !scored.is_protected(*id);
        let mut state = RoundState {
            free: before.order().iter().copied().filter(is_free).collect(),
            removed: Vec::new(),
            errors: Vec::new(),
        };
        let first = state.free.len() + protected.len();
        let sizes = self.sizes(state.free.len(), protected.len(), fewest);
        if sizes.is_empty() {
            return Ok(before);
        }
        let groups = self.view_groups(scene, scored);
        state.errors = vec![vec![0; scored.gaussian_count()]; groups.len()];
        // All rounds use the same pixels, because a round adds errors that earlier rounds measured.
        let strides = [pixel_stride(scene.workload().pixels, self.pixels_per_gaussian * first as f64); 2];
        // The key does not depend on `fewest`, because the survivors of a round do not.
        let key = scene.work.key(&(self.fraction, self.contrast_floor, &groups, &before, protected, strides));
        let mut done = 0;
        for round in (0..sizes.len()).rev().filter(|_| scene.work.is_enabled()) {
            if let Some(found) = scene.work.load(&entry_name(round), key.extended_by(&round))? {
                (state, done) = (found, round + 1);
                break;
            }
        }
        let view_counts = (done..sizes.len())
            .map(|round| active_groups(&groups, round).map(|group| groups[group].len()).sum::<usize>());
        let progress = scene.events.task(NAME, "views", view_counts.sum::<usize>() as u64);
        let RoundState { free, removed, .. } = journal.run_stage(NAME, first, scene.source(), |_| {
            for (round, &left) in sizes.iter().enumerate().skip(done) {
                state = self.round(scene, scored, (state, &groups), round, (key, left, strides), &progress)?;
            }
            let left = state.free.len() + protected.len();
            Ok((state, left))
        })?;
        Ok(Ranking::new(protected.iter().copied().chain(free).chain(removed).collect()))
    }

    /// Returns for each pruning round the number of removable Gaussians that it leaves. At the start there are `free`
    /// removable Gaussians and `protected` Gaussians that must stay; rounds follow until both together are at most
    /// `fewest`. Every round removes at least one Gaussian.
    fn sizes(&self, mut free: usize, protected: usize, fewest: usize) -> Vec<usize> {
        let mut sizes = Vec::new();
        while free > 0 && free + protected > fewest {
            let left = (((free + protected) as f64 * self.fraction) as usize).saturating_sub(protected);
            free = left.min(free - 1);
            sizes.push(free);
        }
        sizes
    }

    /// Runs a pruning round and returns the new state. The views of the round can be divided among shards.
    ///
    /// - `state`: state before the round; `groups`: all groups of views;
    /// - `round`: number of the round, from 0;
    /// - `key`: cache key of the whole ranking;
    /// - `left`: number of removable Gaussians that the round leaves;
    /// - `strides`: strides of the grid of pixels that are rendered.
    fn round(
        &self,
        scene: &Scene,
        scored: &Scored,
        (mut state, groups): (RoundState, &[Vec<FrameView>]),
        round: usize,
        (key, left, strides): (CacheKey, usize, GridStrides),
        progress: &Progress,
    ) -> Result<RoundState> {
        let mut ids: Vec<u32> = state.free.iter().chain(&scored.protected).copied().collect();
        ids.sort_unstable();
        let active: Vec<usize> = active_groups(groups, round).collect();
        let (background, floor) = (scene.background, self.contrast_floor as f32);
        let units = active.iter().map(|&group| groups[group].len()).sum();
        // Removal errors of each group of views that this round renders, summed over the views of that group whose unit
        // numbers are in `some`; empty if there are none.
        let compute = |some: Range<usize>| -> Result<Vec<Vec<u64>>> {
            let mut start = 0;
            let group_errors = |&group: &usize| {
                let views = &groups[group];
                let place = |unit: usize| unit.saturating_sub(start).min(views.len());
                let range = place(some.start)..place(some.end);
                start += views.len();
                if range.is_empty() {
                    return Ok(Vec::new());
                }
                let rendered = (&scene.schedule.cameras[..], &views[range]);
                let advance = || progress.advance(1);
                Ok(removal_error(scene.source(), &ids, rendered, background, (floor, strides), scene.limits, advance)?
                    .sum)
            };
            active.iter().map(group_errors).collect()
        };
        scene.work.compute_in_shards(&entry_name(round), key.extended_by(&round), units, compute, |parts| {
            for &group in &active {
                ids.iter().for_each(|&id| state.errors[group][id as usize] = 0);
            }
            for part in parts {
                for (&group, found) in active.iter().zip(part?) {
                    let errors = &mut state.errors[group];
                    for (&id, error) in ids.iter().zip(found) {
                        errors[id as usize] = errors[id as usize].saturating_add(error);
                    }
                }
            }
            let error =
                |id: &u32| state.errors.iter().fold(0u64, |sum, errors| sum.saturating_add(errors[*id as usize]));
            // The sort is stable, so ties keep the earlier order.
            state.free.sort_by_cached_key(|id| std::cmp::Reverse(error(id)));
            let mut worst = state.free.split_off(left);
            worst.append(&mut state.removed);
            state.removed = worst;
            Ok(state)
        })
    }
}

/// State of the ranking between two pruning rounds.
#[derive(Serialize, Deserialize)]
struct RoundState {
    /// Ids of the survivors (Gaussians not removed so far) that later pruning rounds may remove, most important first.
    free: Vec<u32>,
    /// Ids of the Gaussians removed so far, least important last.
    removed: Vec<u32>,
    /// For each group of views: removal error of every Gaussian, by id, from the last round that rendered this group.
    errors: Vec<Vec<u64>>,
}

/// Returns the name under which the result of round number `round` (from 0) is cached.
fn entry_name(round: usize) -> String {
    format!("{NAME}-{:02}", round + 1)
}

/// Returns the groups of views that are rendered in a round, as indices into `groups`: all groups in the first round
/// (number 0), then one group per round in turn.
fn active_groups(groups: &[Vec<FrameView>], round: usize) -> impl Iterator<Item = usize> {
    let count = groups.len().max(1);
    let active = if round == 0 { groups.len() } else { 1.min(groups.len()) };
    (0..active).map(move |k| (round + k) % count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::psnr;
    use crate::passes::{gather, select_evenly};
    use crate::pipeline::tests::{scene, score_scene};
    use crate::pruning::score::UserOverrides;
    use crate::recipe::Recipe;
    use crate::render::render;

    /// Returns two rankings of the Gaussians of `scene`: by score, and by pruning rounds down to `fewest` Gaussians.
    fn ranked(scene: &Scene, user: &UserOverrides, fewest: usize) -> (Ranking, Ranking) {
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(scene, &recipe, user);
        let rounds = Rounds::from_recipe(&recipe.select, None).unwrap();
        let found = rounds.rank(scene, &scored, scored.ranking(), fewest, &mut Journal::default()).unwrap();
        (scored.ranking(), found)
    }

    #[test]
    fn a_smaller_target_keeps_a_subset_of_a_larger_one() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let [(once, few), (_, many)] = [200, 800].map(|fewest| ranked(&scene, &UserOverrides::default(), fewest));
        assert_eq!(few.best_ids(800), many.best_ids(800));
        assert_ne!(few.best_ids(800), once.best_ids(800), "rounds changed nothing");
        let mut every = few.order().to_vec();
        every.sort_unstable();
        assert!(every.iter().copied().eq(0..1500), "a Gaussian is missing or stands twice");
    }

    #[test]
    fn rounds_keep_more_quality_than_ranking_once() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let (once, rounds) = ranked(&scene, &UserOverrides::default(), 150);
        let all: Vec<u32> = (0..1500).collect();
        for target in [150, 500] {
            let quality = |kept: &[u32]| -> f64 {
                let view_psnr = |view: &FrameView| {
                    let original = gather(scene.source(), &all, view.frame, Attributes::all()).unwrap();
                    let camera = &scene.schedule.cameras[view.camera as usize];
                    psnr(&render(&original.pick(kept), camera, [0.0; 3]), &render(&original, camera, [0.0; 3]))
                };
                select_evenly(&scene.schedule, 12, 1).iter().map(view_psnr).sum::<f64>() / 12.0
            };
            let got = quality(&rounds.best_ids(target));
            let at_once = quality(&once.best_ids(target));
            assert!(got > at_once + 1.0, "{target}: got {got} dB in rounds, {at_once} at once");
        }
    }

    #[test]
    fn kept_ids_rank_first_and_dropped_ids_do_not_rank() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let worst = ranked(&scene, &UserOverrides::default(), 100).1.order()[1490..].to_vec();
        let user = UserOverrides { keep: worst[..5].to_vec(), drop: worst[5..].to_vec(), keep_box: None };
        let (_, rounds) = ranked(&scene, &user, 100);
        let (mut first, mut kept) = (rounds.order()[..5].to_vec(), worst[..5].to_vec());
        first.sort_unstable();
        kept.sort_unstable();
        assert_eq!(first, kept);
        assert!(worst[5..].iter().all(|id| !rounds.order().contains(id)));
    }

    #[test]
    fn fewer_frames_are_read_only_if_opacities_are_constant() {
        let rounds = Rounds::from_recipe(&Recipe::preset("default").unwrap().select, None).unwrap();
        let [moving, fading] = [Attributes::POSITION, Attributes::OPACITY];
        assert_eq!([moving, fading].map(|varying| rounds.views_per_frame(varying)), [VIEWS_PER_FRAME; 2]);
        let rounds = Rounds { fewer_frames: true, ..rounds };
        assert_eq!(
            [moving, fading].map(|varying| rounds.views_per_frame(varying)),
            [VIEWS_OF_FEWER_FRAMES, VIEWS_PER_FRAME]
        );
    }

    #[test]
    fn views_are_grouped_by_frame_or_singly_if_frames_are_few() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default());
        for (groups, frames_apart) in [(1, true), (4, true), (10, false), (1000, false)] {
            let rounds = Rounds { groups, ..Rounds::from_recipe(&recipe.select, None).unwrap() };
            let parts = rounds.view_groups(&scene, &scored);
            let frames = scored.frames_needed_to_see_all;
            let all = select_evenly_over_frames(&scene.schedule, rounds.views, frames, VIEWS_PER_FRAME);
            assert_eq!(parts.len(), groups.min(all.len()));
            let mut together: Vec<FrameView> = parts.concat();
            together.sort_by_key(|view| (view.frame, view.view));
            assert_eq!(together, all, "{groups} groups");
            let frames = |part: &Vec<FrameView>| part.chunk_by(|a, b| a.frame == b.frame).count();
            let read: usize = parts.iter().map(frames).sum();
            assert_eq!(read == all.chunk_by(|a, b| a.frame == b.frame).count(), frames_apart, "{groups} groups");
        }
    }

    #[test]
    fn every_round_removes_a_gaussian_whatever_the_fraction() {
        let recipe = Recipe::preset("default").unwrap();
        for fraction in [0.1, 0.5, 0.9, recipe::MAX_ROUND_FRACTION, 0.999_999_999_9, 1.0 - f64::EPSILON / 2.0] {
            let rounds = Rounds { fraction, ..Rounds::from_recipe(&recipe.select, None).unwrap() };
            for (count, protected) in (0..=50).flat_map(|count| [(count, 0), (count, 7)]) {
                for fewest in 0..=count {
                    let sizes = rounds.sizes(count, protected, fewest);
                    let before = std::iter::once(count).chain(sizes.iter().copied());
                    assert!(
                        before.zip(&sizes).all(|(before, &left)| left < before),
                        "{fraction} of {count}: {sizes:?}"
                    );
                    assert!(sizes.last().copied().unwrap_or(count) + protected <= fewest.max(protected));
                }
            }
        }
    }

    #[test]
    fn number_of_rounds_is_bounded_even_for_a_zero_target() {
        let recipe = Recipe::preset("default").unwrap();
        let rounds =
            Rounds { fraction: recipe::MAX_ROUND_FRACTION, ..Rounds::from_recipe(&recipe.select, Some(0.0)).unwrap() };
        assert_eq!([0.0, 1e-300, 1.0, 2.0].map(|fewest| rounds.rounds(fewest)), [2207, 2207, 0, 0]);
    }

    #[test]
    fn small_enough_model_keeps_its_order() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let (once, rounds) = ranked(&scene, &UserOverrides::default(), 1500);
        assert_eq!(rounds, once);
    }
}
