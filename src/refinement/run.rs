//! Execution of refinement: optimization steps, prune steps, validation and checkpoints.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::epoch_sampler::EpochSampler;
use super::loss::RenderQuality;
use super::mean_delta::{MeanDelta, is_averaged};
use super::optimizer::RateSchedule;
use super::optimizer_state::{LoadedCheckpoint, OptimizerState, keyframe_count};
use super::survivors::survivors;
use super::targets::{Targets, ViewSplit};
use super::{MAX_USEFUL_PSNR, NAME, RANKING_VIEWS, RATE_VIEWS, RefineStage, along_time, prune_counts};
use crate::cache::CacheKey;
use crate::compressed_model::{CompressedModel, ParamDelta, TrajectoryDelta};
use crate::error::Result;
use crate::journal::Journal;
use crate::journal::records::RefinedSummary;
use crate::metrics::decibels_text;
use crate::progress::Progress;
use crate::pruning::score::Scored;
use crate::scene::Scene;
use crate::source::FrameSource;

/// Minimum and maximum number of optimization steps between two renderings of the validation views. Within these limits
/// the number is a third of the final steps.
const VALIDATE_EVERY: [usize; 2] = [100, 500];
/// Minimum time between two checkpoints, divided by the time that writing the last one took.
const CHECKPOINT_COST_FACTOR: u32 = 40;
/// Minimum and maximum time between two checkpoints. With this maximum an interrupted run loses less than a minute.
const CHECKPOINT_INTERVAL: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(30)];
/// Minimum gain in validation PSNR, dB, for which deltas that vary with time are kept; a smaller gain is not worth the
/// bytes that these deltas take.
const MIN_KEYFRAME_GAIN: f64 = 0.01;
/// Factor applied to the learning rates when the optimization steps since the last validation have not improved the
/// quality of the validation views.
const RATE_REDUCTION: f32 = 0.3;
/// Learning rate at the last of the optimization steps before a prune step, divided by the rate at the first of them.
const LAST_RATE_BEFORE_PRUNING: f32 = 1.0;
/// Learning rate at the last of the final steps, divided by the rate at the first of them.
const LAST_RATE_OF_FINAL_STEPS: f32 = 0.2;

impl RefineStage {
    /// Prunes the model `compressed` in prune steps and refines it. Returns the model with the parameters that have the
    /// best quality on the validation views. Protected Gaussians (which the user keeps) are not changed. `unrefined`:
    /// ids of the Gaussians that ranking alone keeps, increasing, as many as are to stay; the result holds these,
    /// unchanged, if refinement gives no better quality. `scored`: ranking and protected Gaussians. `journal` gets notes
    /// for the user, and the reason if nothing was done.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub fn run(
        &self,
        scene: &Scene,
        scored: &Scored,
        compressed: CompressedModel,
        unrefined: &[u32],
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let (count, target_count) = (compressed.len(), unrefined.len());
        let steps = self.final_steps_in(scene, scored, target_count);
        if count == 0 || scene.schedule.pair_count() == 0 {
            journal.leave_out("refinement", "there are no Gaussians or no views");
            return Ok(compressed);
        }
        if steps == 0 {
            journal.leave_out("refinement", "no Gaussians were removed");
            return Ok(compressed);
        }
        let target_views = self.target_views.with_frames(scored.frames_needed_to_see_all);
        let key = scene.work.key(&(self.key(), target_views, &compressed, unrefined, steps, &scored.protected));
        let run = |journal: &mut Journal| {
            journal.run_stage(NAME, count, scene.source(), |journal| {
                let strides = self.stored_strides(&scene.workload(), count);
                let targets = Targets::new(scene, target_views, strides, false)?;
                scene.work.end_shard_run_before(NAME)?;
                let mut run = RefineRun::new(NAME, self, scene, scored, &targets);
                Ok((run.run_all(&compressed, unrefined, steps, journal)?.0, target_count))
            })
        };
        journal.cached(&scene.work, NAME, key, run)
    }

    /// Refines the model `compressed` like [`RefineStage::run`], which explains `unrefined`, as part of the stage named
    /// `stage`, with the target views `targets`. Returns only the mean PSNR, dB, of the refined model against the
    /// original on the validation views.
    ///
    /// # Errors
    /// Fails like [`RefineStage::run`].
    pub(crate) fn validation_psnr(
        &self,
        stage: &'static str,
        scene: &Scene,
        scored: &Scored,
        targets: &Targets,
        compressed: &CompressedModel,
        unrefined: &[u32],
    ) -> Result<f64> {
        let target_count = unrefined.len();
        let steps = self.final_steps_in(scene, scored, target_count);
        let mut run = RefineRun::new(stage, self, scene, scored, targets);
        let key = run.key(compressed, target_count, target_count).extended_by(&(steps, unrefined));
        let all = || Ok(run.run_all(compressed, unrefined, steps, &mut Journal::default())?.1);
        scene.work.get_or_compute(&format!("{stage}-size"), key, all)
    }
}

/// Refinement of a model, with the data that all its phases share. A phase is one prune step with the optimization
/// steps before it, or the final optimization steps.
pub(crate) struct RefineRun<'a> {
    refine: &'a RefineStage,
    scene: &'a Scene,
    scored: &'a Scored,
    targets: &'a Targets,
    sampler: EpochSampler,
    /// Indices of the validation views among the target views.
    validation: Vec<usize>,
    /// Name of the stage that runs the refinement.
    stage: &'static str,
    progress: Progress,
    /// Cache key of the stage's parameters and of the target views. It does not depend on the model that is refined.
    key: CacheKey,
}

/// State that decides when the next checkpoint of a refinement is written. A phase is one prune step with the
/// optimization steps before it, or the final steps.
struct CheckpointTimer {
    /// Cache key of the refinement, under which its checkpoints are stored.
    key: CacheKey,
    phase: usize,
    /// Time of the last checkpoint. The next one is written `interval` later at the earliest.
    saved_at: Instant,
    interval: Duration,
}

/// Contents of a checkpoint that is written in the middle of a phase (one prune step with its optimization steps, or
/// the final steps).
#[derive(Serialize, Deserialize)]
struct ResumePoint<Checkpoint, Best> {
    phase: usize,
    /// Number of optimization steps of this phase that were done when the checkpoint was written.
    steps: usize,
    taken: usize,
    schedule: RateSchedule,
    checkpoint: Checkpoint,
    /// Best parameter deltas so far, if the phase is the final steps. `None` in the steps before a prune step, because
    /// these are not validated.
    best_deltas: Option<Best>,
}

/// Parameter deltas (values that refinement adds to the model) that have had the best validation quality in the final
/// optimization steps.
#[derive(Clone, Serialize, Deserialize)]
struct BestDeltas {
    before: RenderQuality,
    best: RenderQuality,
    /// Best validation quality so far of renders without the trajectory delta (values that vary with time).
    constant: RenderQuality,
    /// Constant delta that has had the best validation quality so far.
    delta: ParamDelta,
    /// Factor on the learning rates, reduced at each validation (except the last) that shows no better quality than the
    /// best so far.
    rate_factor: f32,
    /// Trajectory delta: the time-varying values, added to each frame, that have had the best validation quality so far
    /// together with `delta`.
    trajectory: TrajectoryDelta,
    mean: MeanDelta,
}

/// Progress of a phase that continues from a checkpoint: number of optimization steps done, learning rates, and, in the
/// final steps, the best parameter deltas (added values) so far.
type Resumed = (usize, RateSchedule, Option<BestDeltas>);

impl<'a> RefineRun<'a> {
    /// Creates a refinement that the stage named `stage` runs. `refine`: parameters. `targets`: target views.
    pub(crate) fn new(
        stage: &'static str,
        refine: &'a RefineStage,
        scene: &'a Scene,
        scored: &'a Scored,
        targets: &'a Targets,
    ) -> RefineRun<'a> {
        let ViewSplit { training, validation, .. } = targets.split();
        let key = targets.key.extended_by(&(refine.key(), (&training, &validation), &scored.protected));
        let sampler = EpochSampler::new(training);
        let progress = scene.events.task(stage, "steps", 0);
        RefineRun { refine, scene, scored, targets, sampler, validation, stage, progress, key }
    }

    /// Restarts the progress display with `steps` as the total number of optimization steps.
    fn set_total_steps(&mut self, steps: usize) {
        self.progress.restart(steps as u64);
    }

    /// Creates the optimizer for the model `compressed`. `result`: reader of the frames of this model.
    fn start_optimizer<'b>(
        &self,
        compressed: &CompressedModel,
        result: &'b dyn FrameSource,
    ) -> Result<OptimizerState<'b>>
    where
        'a: 'b,
    {
        let fixed = compressed.kept.iter().map(|id| self.scored.is_protected(*id)).collect();
        OptimizerState::new(self.scene, result, self.targets, self.refine.step_params(), fixed)
    }

    /// Returns the cache key of a refined model that is made from `compressed`. `size`: its number of Gaussians.
    /// `target_count`: number of Gaussians after later prune steps, at most `size`; the key contains it because the
    /// number of optimization steps depends on it.
    fn key(&self, compressed: &CompressedModel, size: usize, target_count: usize) -> CacheKey {
        self.key.extended_by(&(compressed, size, target_count, self.sampler.taken))
    }

    fn timer(&self, key: CacheKey) -> CheckpointTimer {
        CheckpointTimer { key, phase: 0, saved_at: Instant::now(), interval: CHECKPOINT_INTERVAL[0] }
    }

    /// Prunes `compressed` in prune steps and then runs `steps` final optimization steps. Returns the refined model, and
    /// the mean PSNR, dB, of its renders of the validation views against the original. `unrefined`: ids of the Gaussians
    /// that ranking alone keeps; as many are left after the last prune step. If the model of these, unchanged, has a
    /// better validation quality, it is returned. If its PSNR is at least [`MAX_USEFUL_PSNR`], no step is made.
    fn run_all(
        &mut self,
        compressed: &CompressedModel,
        unrefined: &[u32],
        steps: usize,
        journal: &mut Journal,
    ) -> Result<(CompressedModel, f64)> {
        let target_count = unrefined.len();
        let mut timer = self.timer(self.key(compressed, target_count, target_count).extended_by(&steps));
        let result = self.scene.input.compressed_frames(compressed)?;
        let mut optimizer = self.start_optimizer(compressed, &*result)?;
        let unrefined = compressed.indices(unrefined).filter(|_| target_count < compressed.len());
        let unrefined_quality =
            unrefined.as_deref().map(|places| optimizer.quality_of(&self.validation, Some(places))).transpose()?;
        let unrefined = unrefined.zip(unrefined_quality);
        if let Some((places, quality)) = &unrefined
            && self.is_good_enough(quality, journal)
        {
            return Ok((compressed.pick(places), quality.psnr));
        }
        let prune_counts = prune_counts(compressed.len(), target_count);
        let prune_steps_total: usize =
            prune_counts.windows(2).map(|pair| self.refine.steps_before(pair[0], target_count)).sum();
        self.set_total_steps(prune_steps_total + steps + self.steps_along_time(steps));
        let mut left = compressed.clone();
        for pair in prune_counts.windows(2) {
            let steps = self.refine.steps_before(pair[0], target_count);
            left = left.pick(&self.prune_step(&mut optimizer, &mut timer, steps, pair[1])?);
        }
        let BestDeltas { delta, trajectory, best, .. } =
            self.final_steps(&mut optimizer, &mut timer, steps, unrefined_quality, journal)?;
        if let Some((places, quality)) = &unrefined
            && !self.keeps(&best, quality)
        {
            return Ok((compressed.pick(places), quality.psnr));
        }
        (left.delta, left.trajectory_delta) = (left.delta.plus(delta), left.trajectory_delta.plus(trajectory));
        Ok((left, best.psnr))
    }

    /// Makes one prune step: runs optimization steps, then removes all but `size` Gaussians of `compressed`. Returns
    /// the pruned model. `target_count`: number of Gaussians that remain after the last prune step.
    pub(crate) fn prune_to(
        &mut self,
        compressed: &CompressedModel,
        size: usize,
        target_count: usize,
    ) -> Result<CompressedModel> {
        let key = self.key(compressed, size, target_count);
        let (left, taken) = self.scene.work.get_or_compute(&format!("{}-cut", self.stage), key, || {
            let mut timer = self.timer(key);
            let result = self.scene.input.compressed_frames(compressed)?;
            let mut optimizer = self.start_optimizer(compressed, &*result)?;
            let steps = self.refine.steps_before(compressed.len(), target_count);
            self.set_total_steps(steps);
            let mut left = compressed.pick(&self.prune_step(&mut optimizer, &mut timer, steps, size)?);
            left.delta = left.delta.plus(optimizer.change());
            Ok((left, self.sampler.taken))
        })?;
        self.sampler.skip_to(taken);
        Ok(left)
    }

    /// Returns the quality of renders of the validation views with the model `compressed`.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub(super) fn validation_quality(&self, compressed: &CompressedModel) -> Result<RenderQuality> {
        let key = self.key.extended_by(&(compressed, "unrefined"));
        self.scene.work.get_or_compute(&format!("{}-unrefined", self.stage), key, || {
            let result = self.scene.input.compressed_frames(compressed)?;
            self.start_optimizer(compressed, &*result)?.quality(&self.validation)
        })
    }

    /// Runs the final optimization steps on the model `compressed`. Returns this model with the parameter deltas that
    /// have given the best validation quality. `unrefined`: the model of as many Gaussians that ranking alone keeps, and
    /// its validation quality; it is returned if its quality is better.
    pub(super) fn refine_best(
        &mut self,
        mut compressed: CompressedModel,
        unrefined: Option<(CompressedModel, RenderQuality)>,
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let quality = unrefined.as_ref().map(|(_, quality)| *quality);
        let steps = self.refine.final_steps_in(self.scene, self.scored, compressed.len());
        let key = self.key(&compressed, compressed.len(), compressed.len());
        let (key, work) = (key.extended_by(&quality.map(|quality| quality.psnr.to_bits())), &self.scene.work);
        let (delta, trajectory, is_better, taken) =
            journal.cached(work, &format!("{}-best", self.stage), key, |journal| {
                self.set_total_steps(steps + self.steps_along_time(steps));
                let mut timer = self.timer(key);
                let result = self.scene.input.compressed_frames(&compressed)?;
                let mut optimizer = self.start_optimizer(&compressed, &*result)?;
                let BestDeltas { delta, trajectory, best, .. } =
                    self.final_steps(&mut optimizer, &mut timer, steps, quality, journal)?;
                let is_better = quality.is_none_or(|quality| self.keeps(&best, &quality));
                Ok((delta, trajectory, is_better, self.sampler.taken))
            })?;
        self.sampler.skip_to(taken);
        (compressed.delta, compressed.trajectory_delta) =
            (compressed.delta.plus(delta), compressed.trajectory_delta.plus(trajectory));
        Ok(unrefined.filter(|_| !is_better).map_or(compressed, |(unrefined, _)| unrefined))
    }

    /// Returns the number of keyframes of the time-varying delta; 0 if the added values are constant in time, as for
    /// inputs without explicit frames.
    fn keyframe_count(&self) -> usize {
        match self.scene.input.description().has_explicit_frames {
            true => keyframe_count(self.refine.keyframes, self.scene.source().info().times.len()),
            false => 0,
        }
    }

    /// Returns the number of optimization steps of the time-varying delta, which follow `steps` steps of the constant
    /// delta; 0 if there is no time-varying delta.
    fn steps_along_time(&self, steps: usize) -> usize {
        if self.keyframe_count() > 0 { along_time(steps) } else { 0 }
    }

    /// Makes an optimization step by the function `step`, whose arguments are the target view and, if `has_next`, the
    /// target view of the next step. `has_next`: whether the next step follows without a validation before it.
    fn step(&mut self, has_next: bool, step: impl FnOnce(usize, Option<usize>) -> Result<()> + Send) -> Result<()> {
        let view = self.sampler.next();
        let next = has_next.then(|| self.sampler.peek());
        // Enters the thread pool once. From outside, every parallel loop of the step would have to wake a thread.
        rayon::scope(|_| step(view, next))?;
        self.progress.advance(1);
        Ok(())
    }

    /// Returns the name of the cache entry that holds the checkpoint of this refinement.
    fn checkpoint_name(&self) -> String {
        format!("{}-steps", self.stage)
    }

    /// Restores the optimizer and the position in the random order of views from the last checkpoint of the current
    /// phase of `timer`. Returns the progress of this phase, or `None` if there is no checkpoint of it.
    fn resume(&mut self, optimizer: &mut OptimizerState<'_>, timer: &CheckpointTimer) -> Result<Option<Resumed>> {
        let kept: Option<ResumePoint<LoadedCheckpoint, BestDeltas>> =
            self.scene.work.load(&self.checkpoint_name(), timer.key)?;
        let Some(kept) = kept.filter(|kept| kept.phase == timer.phase) else { return Ok(None) };
        optimizer.resume(kept.checkpoint)?;
        self.sampler.skip_to(kept.taken);
        self.progress.advance(kept.steps as u64);
        Ok(Some((kept.steps, kept.schedule, kept.best_deltas)))
    }

    /// Writes a checkpoint of the current phase, after `steps` optimization steps of this phase. `schedule`: learning
    /// rates. `best_deltas`: best parameter deltas so far, `None` before the final steps. Does nothing if less time
    /// than `timer.interval` has passed since the last checkpoint, or if the cache is disabled.
    fn save_checkpoint(
        &self,
        optimizer: &OptimizerState<'_>,
        timer: &mut CheckpointTimer,
        (steps, schedule): (usize, RateSchedule),
        best_deltas: Option<&BestDeltas>,
    ) -> Result<()> {
        if !self.scene.work.is_enabled() || timer.saved_at.elapsed() < timer.interval {
            return Ok(());
        }
        let (phase, taken) = (timer.phase, self.sampler.taken);
        let kept = ResumePoint { phase, steps, taken, schedule, checkpoint: optimizer.checkpoint(), best_deltas };
        let start = Instant::now();
        self.scene.work.store(&self.checkpoint_name(), timer.key, &kept)?;
        timer.saved_at = Instant::now();
        timer.interval =
            (CHECKPOINT_COST_FACTOR * (timer.saved_at - start)).clamp(CHECKPOINT_INTERVAL[0], CHECKPOINT_INTERVAL[1]);
        Ok(())
    }

    /// Runs `steps` optimization steps, then removes all but `size` Gaussians from `optimizer`. Mainly those Gaussians
    /// stay whose removal would cause the largest squared errors (see [`survivors`]). Returns the indices of the
    /// Gaussians that stay.
    fn prune_step(
        &mut self,
        optimizer: &mut OptimizerState<'_>,
        timer: &mut CheckpointTimer,
        steps: usize,
        size: usize,
    ) -> Result<Vec<u32>> {
        let (name, key, work) = (format!("{}-cut-{:02}", self.stage, timer.phase + 1), timer.key, &self.scene.work);
        let kept: Option<(LoadedCheckpoint, Vec<u32>, usize)> = work.load(&name, key)?;
        let left = match kept {
            Some((checkpoint, left, taken)) => {
                optimizer.resume(checkpoint)?;
                self.sampler.skip_to(taken);
                self.progress.advance(steps as u64);
                left
            }
            None => {
                let (done, schedule) = match self.resume(optimizer, timer)? {
                    Some((done, schedule, _)) => (done, schedule),
                    None => {
                        let some = self.validation.iter().step_by(self.validation.len().div_ceil(RATE_VIEWS).max(1));
                        let start = optimizer.quality(&some.copied().collect::<Vec<_>>())?;
                        (0, RateSchedule::new(steps, LAST_RATE_BEFORE_PRUNING, start.typical_error()))
                    }
                };
                for step in done..steps {
                    self.step(step + 1 < steps, |view, next| optimizer.step(view, next, &schedule))?;
                    self.save_checkpoint(optimizer, timer, (step + 1, schedule), None)?;
                }
                let views: Vec<usize> = (0..RANKING_VIEWS).map(|_| self.sampler.next()).collect();
                let errors = optimizer.removal_error(&views, self.refine.contrast_floor as f32)?;
                let left = survivors(&errors.sum, size, optimizer.fixed(), &optimizer.positions());
                work.store(&name, key, &(optimizer.checkpoint(), &left, self.sampler.taken))?;
                left
            }
        };
        timer.phase += 1;
        optimizer.pick(&left)?;
        Ok(left)
    }

    /// Runs `steps` optimization steps of the constant delta, then the steps of the time-varying delta. Returns the
    /// deltas with the best validation quality. Records in `journal` the gain in validation PSNR, or the reason why
    /// nothing was gained. `unrefined`: quality of another model with as many Gaussians, which ranking alone keeps; the
    /// gain is the gain over the better one of this model and the model before the steps.
    fn final_steps(
        &mut self,
        optimizer: &mut OptimizerState<'_>,
        timer: &mut CheckpointTimer,
        steps: usize,
        unrefined: Option<RenderQuality>,
        journal: &mut Journal,
    ) -> Result<BestDeltas> {
        let count = self.validation.len();
        let (done, mut schedule, mut best_deltas) = match self.resume(optimizer, timer)? {
            Some((done, schedule, Some(best_deltas))) => (done, schedule, best_deltas),
            _ => {
                optimizer.reevaluate_states()?;
                let before = optimizer.quality(&self.validation)?;
                let best_deltas = BestDeltas::new(before, optimizer.change());
                if self.is_good_enough(&before, journal) {
                    return Ok(best_deltas);
                }
                (0, RateSchedule::new(steps, LAST_RATE_OF_FINAL_STEPS, before.typical_error()), best_deltas)
            }
        };
        let validate_every = steps.div_ceil(3).clamp(VALIDATE_EVERY[0], VALIDATE_EVERY[1]);
        optimizer.reevaluate_between_validations(validate_every);
        for step in done + 1..=steps {
            let is_validated = self.refine.validates && step % validate_every == 0 || step == steps;
            self.step(!is_validated, |view, next| optimizer.step(view, next, &schedule))?;
            if is_averaged(step, steps) {
                best_deltas.mean.add(optimizer.change());
            }
            if is_validated {
                match step == steps && best_deltas.mean.count > 0 {
                    true => optimizer.restart_from(&best_deltas.mean.delta)?,
                    false => optimizer.reevaluate_states()?,
                }
                let now = optimizer.quality(&self.validation)?;
                if self.keeps(&now, &best_deltas.best) {
                    (best_deltas.best, best_deltas.delta) = (now, optimizer.change());
                } else if step < steps {
                    best_deltas.mean = MeanDelta::default();
                    best_deltas.rate_factor *= RATE_REDUCTION;
                    optimizer.restart_from(&best_deltas.delta)?;
                    schedule =
                        RateSchedule::new(steps - step, LAST_RATE_OF_FINAL_STEPS, best_deltas.best.typical_error())
                            .scaled_by(best_deltas.rate_factor);
                }
            }
            best_deltas.constant = best_deltas.best;
            self.save_checkpoint(optimizer, timer, (step, schedule), Some(&best_deltas))?;
        }
        let is_along = self.refine_along_time(optimizer, timer, (done, schedule), &mut best_deltas, steps)?;
        let start = unrefined.filter(|unrefined| self.refine.loss.is_closer(unrefined, &best_deltas.before));
        let start = start.unwrap_or(best_deltas.before);
        let is_better = self.keeps(&best_deltas.best, &start);
        let [start, best] = [start.psnr, best_deltas.best.psnr];
        if is_better {
            journal.notes.push(format!("refinement: validation PSNR {start:.2} → {best:.2} dB ({count} views)"));
            journal.refined = Some(RefinedSummary { views: count, before: start, result: best });
        } else {
            let why = format!("it did not improve the validation PSNR of {start:.2} dB ({count} views)");
            journal.leave_out("refinement", why);
        }
        if !best_deltas.trajectory.is_empty() {
            let gain = best - best_deltas.constant.psnr;
            journal.notes.push(format!("refinement: {gain:.2} dB of this gain are due to changes along time"));
        } else if is_along {
            let why = format!("they did not improve the validation PSNR of {best:.2} dB");
            journal.leave_out("changes along time", why);
        }
        Ok(best_deltas)
    }

    /// Returns whether a model whose renders of the validation views have the quality `quality` needs no refinement:
    /// their PSNR is at least [`MAX_USEFUL_PSNR`], or not a number. Records in `journal` that refinement is left out.
    pub(super) fn is_good_enough(&self, quality: &RenderQuality, journal: &mut Journal) -> bool {
        let (count, psnr) = (self.validation.len(), quality.psnr);
        if psnr < MAX_USEFUL_PSNR {
            return false;
        }
        let why = match psnr.is_nan() {
            true => format!("the PSNR of the {count} validation views is {}", decibels_text(psnr, 2)),
            false => format!("the {count} validation views have {psnr:.2} dB PSNR without it"),
        };
        journal.leave_out("refinement", why);
        true
    }

    /// Returns whether the current parameters, of validation quality `now`, replace the best parameters so far, of
    /// quality `best`. Without validation ([`RefineStage::validates`]) they always do, unless a render is not a number.
    fn keeps(&self, now: &RenderQuality, best: &RenderQuality) -> bool {
        self.refine.loss.is_closer(now, best) || !self.refine.validates && !now.psnr.is_nan()
    }

    /// Runs the optimization steps of the time-varying delta, and stores the best deltas in `best_deltas`. These steps
    /// follow the `steps` steps of the constant delta. `done`: number of steps of both deltas in the loaded checkpoint;
    /// 0 without a checkpoint.
    /// - If `done` is above `steps`, continues from the checkpoint with the learning rates `schedule`.
    /// - Otherwise starts from the best constant delta.
    ///
    /// Returns false if no step was run: either no attribute may vary with time, or the PSNR is at least
    /// [`MAX_USEFUL_PSNR`] already.
    fn refine_along_time(
        &mut self,
        optimizer: &mut OptimizerState<'_>,
        timer: &mut CheckpointTimer,
        (done, mut schedule): (usize, RateSchedule),
        best_deltas: &mut BestDeltas,
        steps: usize,
    ) -> Result<bool> {
        let keyframe_steps = self.steps_along_time(steps);
        if keyframe_steps == 0 || best_deltas.constant.psnr >= MAX_USEFUL_PSNR {
            return Ok(false);
        }
        if done <= steps {
            let keyframe_count = self.keyframe_count();
            optimizer.restart_from(&best_deltas.delta)?;
            if !optimizer.enable_keyframes(keyframe_count) {
                return Ok(false);
            }
            // Every view changes the two keyframes around its frame, so this is the mean number of steps per keyframe.
            schedule = RateSchedule::new(
                2 * keyframe_steps / keyframe_count,
                LAST_RATE_OF_FINAL_STEPS,
                best_deltas.constant.error,
            );
        }
        let validate_every = keyframe_steps.div_ceil(3);
        for step in done.saturating_sub(steps) + 1..=keyframe_steps {
            let is_validated = self.refine.validates && step % validate_every == 0 || step == keyframe_steps;
            self.step(!is_validated, |view, next| optimizer.step_trajectory(view, next, &schedule))?;
            if is_validated {
                let now = optimizer.quality(&self.validation)?;
                let gains = self.refine.loss.ssim > 0.0 || now.psnr >= best_deltas.best.psnr + MIN_KEYFRAME_GAIN;
                if (gains || !self.refine.validates) && self.keeps(&now, &best_deltas.best) {
                    (best_deltas.best, best_deltas.trajectory) = (now, optimizer.trajectory_delta());
                }
            }
            self.save_checkpoint(optimizer, timer, (steps + step, schedule), Some(best_deltas))?;
        }
        Ok(true)
    }
}

impl BestDeltas {
    /// Creates the best state before any optimization step: `delta` is the change of the parameters so far, and
    /// `before` the validation quality with this change.
    fn new(before: RenderQuality, delta: ParamDelta) -> Self {
        BestDeltas {
            before,
            best: before,
            constant: before,
            delta,
            rate_factor: 1.0,
            trajectory: TrajectoryDelta::default(),
            mean: MeanDelta::default(),
        }
    }
}
