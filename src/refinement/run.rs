//! Execution of refinement: optimization steps, prune steps, validation and checkpoints.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::loss::RenderQuality;
use super::optimizer::RateSchedule;
use super::optimizer_state::{KeptCheckpoint, OptimizerState, keyframe_count};
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
use crate::scene::between::SplitMix64;
use crate::source::FrameSource;

/// Limits of the number of steps between two evaluations of the validation views; a third of all steps lies within
/// them.
const VALIDATE_EVERY: [usize; 2] = [100, 500];
/// Minimum interval between two checkpoints, as a multiple of the time that the last one took.
const CHECKPOINT_COST_FACTOR: u32 = 40;
/// Limits of the checkpoint interval: an interrupted run loses less than a minute.
const CHECKPOINT_INTERVAL: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(30)];
/// Minimum gain in dB of deltas that vary in time; with a smaller gain they are not worth their bytes.
const MIN_KEYFRAME_GAIN: f64 = 0.01;
/// Factor applied to the learning rates after steps that made the validation views worse.
const RATE_REDUCTION: f32 = 0.3;
/// Learning rate of the last step, as a fraction of the first step's: before a prune step, and at the end.
const LAST_RATES: [f32; 2] = [1.0, 0.05];

impl RefineStage {
    /// Refines the survivors and prunes them down to `wanted`. The result is the state with the best validation
    /// quality. Protected Gaussians keep their stored parameters.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub fn run(
        &self,
        scene: &Scene,
        scored: &Scored,
        reduction: CompressedModel,
        wanted: usize,
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let count = reduction.len();
        let steps = self.last_steps(wanted as f64 / scored.count().max(1) as f64);
        if count == 0 || scene.schedule.pairs() == 0 {
            journal.leave_out("refinement", "there are no Gaussians or no views");
            return Ok(reduction);
        }
        if steps == 0 {
            journal.leave_out("refinement", "no Gaussians were removed");
            return Ok(reduction);
        }
        let key = scene.work.key(&(self.key(), &reduction, wanted, steps, &scored.protected));
        let run = |journal: &mut Journal| {
            journal.stage(NAME, count, scene.source(), |journal| {
                let targets = Targets::new(scene, self.pictures)?;
                scene.work.end_shard_before(NAME)?;
                let mut run = RefineRun::new(NAME, self, scene, scored, &targets, targets.parted(false));
                Ok((run.run_all(&reduction, wanted, steps, journal)?.0, wanted))
            })
        };
        journal.kept(&scene.work, NAME, key, run)
    }

    /// Returns the mean PSNR in dB of the validation views against the original after such a refinement, as a part of
    /// the stage `stage`.
    ///
    /// # Errors
    /// Fails like [`RefineStage::run`].
    pub(crate) fn closeness(
        &self,
        stage: &'static str,
        scene: &Scene,
        scored: &Scored,
        targets: &Targets,
        reduction: &CompressedModel,
        wanted: usize,
    ) -> Result<f64> {
        let steps = self.last_steps(wanted as f64 / scored.count().max(1) as f64);
        let mut run = RefineRun::new(stage, self, scene, scored, targets, targets.parted(false));
        let key = run.key(reduction, wanted, wanted).and(&steps);
        let all = || Ok(run.run_all(reduction, wanted, steps, &mut Journal::default())?.1);
        scene.work.known(&format!("{stage}-size"), key, all)
    }
}

/// Order of the target views: every epoch takes all of them in a new random order.
struct EpochSampler {
    pictures: Vec<usize>,
    at: usize,
    random: SplitMix64,
    /// Number of views taken so far.
    taken: usize,
}

impl EpochSampler {
    fn new(pictures: Vec<usize>) -> EpochSampler {
        EpochSampler { at: pictures.len(), pictures, random: SplitMix64(1), taken: 0 }
    }

    fn next(&mut self) -> usize {
        if self.at == self.pictures.len() {
            self.random.shuffle(&mut self.pictures);
            self.at = 0;
        }
        self.at += 1;
        self.taken += 1;
        self.pictures[self.at - 1]
    }

    /// Advances to the state after `taken` views.
    fn skip_to(&mut self, taken: usize) {
        while self.taken < taken {
            self.next();
        }
    }
}

/// Data shared by all phases of a refinement.
pub(crate) struct RefineRun<'a> {
    refine: &'a RefineStage,
    scene: &'a Scene,
    scored: &'a Scored,
    targets: &'a Targets,
    sampler: EpochSampler,
    /// Indices of the validation views.
    validation: Vec<usize>,
    /// Name of the stage that runs the refinement.
    stage: &'static str,
    progress: Progress,
    /// Cache key of the parameters and target views; the compressed model is not included.
    key: CacheKey,
}

/// Checkpoint bookkeeping of a refinement that can be resumed. A phase is a prune step with its optimization steps, or
/// the final steps.
struct CheckpointTimer {
    /// Cache key of the refinement.
    key: CacheKey,
    phase: usize,
    /// Time of the last checkpoint, and interval to the next one.
    saved_at: Instant,
    interval: Duration,
}

/// Checkpoint within a phase.
#[derive(Serialize, Deserialize)]
struct ResumePoint<Checkpoint, Best> {
    phase: usize,
    /// Number of optimization steps done in this phase.
    steps: usize,
    taken: usize,
    schedule: RateSchedule,
    checkpoint: Checkpoint,
    /// Best state so far; only in the last phase.
    best_state: Option<Best>,
}

/// Best state of the last phase.
#[derive(Clone, Serialize, Deserialize)]
struct BestState<Delta, Trajectory> {
    before: RenderQuality,
    best: RenderQuality,
    /// Validation quality of the best delta that is constant in time.
    constant: RenderQuality,
    /// Delta of the best state.
    delta: Delta,
    /// Factor on the learning rates.
    rate_factor: f32,
    /// Time-varying delta of the best state.
    trajectory: Trajectory,
}

/// Progress of a resumed phase: steps done, learning rates, and the best state in the last phase.
type Resumed = (usize, RateSchedule, Option<BestState<ParamDelta, TrajectoryDelta>>);

impl<'a> RefineRun<'a> {
    /// Creates a refinement of `stage` with the training and validation views of `parts`.
    pub(crate) fn new(
        stage: &'static str,
        refine: &'a RefineStage,
        scene: &'a Scene,
        scored: &'a Scored,
        targets: &'a Targets,
        parts: ViewSplit,
    ) -> RefineRun<'a> {
        let views = (&targets.cameras, &targets.pictures, &parts.stepped, &parts.apart);
        let key = scene.work.key(&(refine.key(), views, &scored.protected));
        let (sampler, validation) = (EpochSampler::new(parts.stepped), parts.apart);
        let progress = scene.events.task(stage, "steps", 0);
        RefineRun { refine, scene, scored, targets, sampler, validation, stage, progress, key }
    }

    /// Sets the total number of steps of the progress display.
    fn set_total_steps(&mut self, steps: usize) {
        self.progress.restart(steps as u64);
    }

    /// Creates the optimizer state for `reduction`, whose frames `result` yields.
    fn start_optimizer<'b>(
        &self,
        reduction: &CompressedModel,
        result: &'b dyn FrameSource,
    ) -> Result<OptimizerState<'b>>
    where
        'a: 'b,
    {
        let fixed = reduction.kept.iter().map(|id| self.scored.is_protected(*id)).collect();
        OptimizerState::new(self.scene, result, self.targets, self.refine.step_params(), fixed)
    }

    /// Returns the cache key of a refinement of `reduction` down to `size`, on the way to `wanted`.
    fn key(&self, reduction: &CompressedModel, size: usize, wanted: usize) -> CacheKey {
        self.key.and(&(reduction, size, wanted, self.sampler.taken))
    }

    fn timer(&self, key: CacheKey) -> CheckpointTimer {
        CheckpointTimer { key, phase: 0, saved_at: Instant::now(), interval: CHECKPOINT_INTERVAL[0] }
    }

    /// Runs all phases: prunes `reduction` down to `wanted`, then runs `steps` final steps. Also returns the mean PSNR
    /// in dB of the validation views against the original.
    fn run_all(
        &mut self,
        reduction: &CompressedModel,
        wanted: usize,
        steps: usize,
        journal: &mut Journal,
    ) -> Result<(CompressedModel, f64)> {
        let mut timer = self.timer(self.key(reduction, wanted, wanted).and(&steps));
        let result = self.scene.input.reduced(reduction)?;
        let mut optimizer = self.start_optimizer(reduction, &*result)?;
        let prune_counts = prune_counts(reduction.len(), wanted);
        let prune_steps_total: usize =
            prune_counts.windows(2).map(|pair| self.refine.steps_before(pair[0], wanted)).sum();
        self.set_total_steps(prune_steps_total + steps + self.steps_along_time(steps));
        let mut left = reduction.clone();
        for pair in prune_counts.windows(2) {
            let steps = self.refine.steps_before(pair[0], wanted);
            left = left.pick(&self.prune_step(&mut optimizer, &mut timer, steps, pair[1])?);
        }
        let BestState { delta, trajectory, best, .. } = self.final_steps(&mut optimizer, &mut timer, steps, journal)?;
        (left.change, left.course) = (left.change.and(delta), left.course.and(trajectory));
        Ok((left, best.psnr))
    }

    /// Prunes `reduction` down to `size`, on the way to `wanted`, after the optimization steps of one prune step.
    pub(crate) fn cut_down(
        &mut self,
        reduction: &CompressedModel,
        size: usize,
        wanted: usize,
    ) -> Result<CompressedModel> {
        let key = self.key(reduction, size, wanted);
        let (left, taken) = self.scene.work.known(&format!("{}-cut", self.stage), key, || {
            let mut timer = self.timer(key);
            let result = self.scene.input.reduced(reduction)?;
            let mut optimizer = self.start_optimizer(reduction, &*result)?;
            let steps = self.refine.steps_before(reduction.len(), wanted);
            self.set_total_steps(steps);
            let mut left = reduction.pick(&self.prune_step(&mut optimizer, &mut timer, steps, size)?);
            left.change = left.change.and(optimizer.change());
            Ok((left, self.sampler.taken))
        })?;
        self.sampler.skip_to(taken);
        Ok(left)
    }

    /// Runs the final optimization steps on `reduction` and returns it in its best state.
    pub(crate) fn refine_best(
        &mut self,
        mut reduction: CompressedModel,
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let steps = self.refine.last_steps(reduction.len() as f64 / self.scored.count().max(1) as f64);
        let (key, work) = (self.key(&reduction, reduction.len(), reduction.len()), &self.scene.work);
        let (change, course, taken) = journal.kept(work, &format!("{}-best", self.stage), key, |journal| {
            self.set_total_steps(steps + self.steps_along_time(steps));
            let mut timer = self.timer(key);
            let result = self.scene.input.reduced(&reduction)?;
            let mut optimizer = self.start_optimizer(&reduction, &*result)?;
            let BestState { delta, trajectory, .. } = self.final_steps(&mut optimizer, &mut timer, steps, journal)?;
            Ok((delta, trajectory, self.sampler.taken))
        })?;
        self.sampler.skip_to(taken);
        (reduction.change, reduction.course) = (reduction.change.and(change), reduction.course.and(course));
        Ok(reduction)
    }

    /// Returns the number of keyframes of the time-varying delta; 0 if the input has no explicit frames.
    fn keyframe_count(&self) -> usize {
        match self.scene.input.has_explicit_frames() {
            true => keyframe_count(self.refine.knots, self.scene.source().info().times.len()),
            false => 0,
        }
    }

    /// Returns the number of steps along time that follow `steps` steps.
    fn steps_along_time(&self, steps: usize) -> usize {
        if self.keyframe_count() > 0 { along_time(steps) } else { 0 }
    }

    fn step(&mut self, optimizer: &mut OptimizerState<'_>, schedule: &RateSchedule) -> Result<()> {
        optimizer.step(self.sampler.next(), schedule)?;
        self.progress.advance(1);
        Ok(())
    }

    /// Returns the name of the checkpoint in the cache.
    fn checkpoint_name(&self) -> String {
        format!("{}-steps", self.stage)
    }

    /// Resumes the phase from its last checkpoint, if there is one.
    fn resume(&mut self, optimizer: &mut OptimizerState<'_>, timer: &CheckpointTimer) -> Result<Option<Resumed>> {
        let kept: Option<ResumePoint<KeptCheckpoint, BestState<ParamDelta, TrajectoryDelta>>> =
            self.scene.work.find(&self.checkpoint_name(), timer.key)?;
        let Some(kept) = kept.filter(|kept| kept.phase == timer.phase) else { return Ok(None) };
        optimizer.resume(kept.checkpoint)?;
        self.sampler.skip_to(kept.taken);
        self.progress.advance(kept.steps as u64);
        Ok(Some((kept.steps, kept.schedule, kept.best_state)))
    }

    /// Writes a checkpoint after so many steps if the interval has passed.
    fn save_checkpoint(
        &self,
        optimizer: &OptimizerState<'_>,
        timer: &mut CheckpointTimer,
        (steps, schedule): (usize, RateSchedule),
        best_state: Option<BestState<&ParamDelta, &TrajectoryDelta>>,
    ) -> Result<()> {
        if !self.scene.work.keeps() || timer.saved_at.elapsed() < timer.interval {
            return Ok(());
        }
        let (phase, taken) = (timer.phase, self.sampler.taken);
        let kept = ResumePoint { phase, steps, taken, schedule, checkpoint: optimizer.checkpoint(), best_state };
        let start = Instant::now();
        self.scene.work.keep(&self.checkpoint_name(), timer.key, &kept)?;
        timer.saved_at = Instant::now();
        timer.interval =
            (CHECKPOINT_COST_FACTOR * (timer.saved_at - start)).clamp(CHECKPOINT_INTERVAL[0], CHECKPOINT_INTERVAL[1]);
        Ok(())
    }

    /// Runs `steps` optimization steps, then removes all but the `size` Gaussians with the largest removal error.
    /// Returns the indices of the Gaussians that stay.
    fn prune_step(
        &mut self,
        optimizer: &mut OptimizerState<'_>,
        timer: &mut CheckpointTimer,
        steps: usize,
        size: usize,
    ) -> Result<Vec<u32>> {
        let (name, key, work) = (format!("{}-cut-{:02}", self.stage, timer.phase + 1), timer.key, &self.scene.work);
        let kept: Option<(KeptCheckpoint, Vec<u32>, usize)> = work.find(&name, key)?;
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
                        let error = optimizer.quality(&some.copied().collect::<Vec<_>>())?.error;
                        (0, RateSchedule::new(steps, LAST_RATES[0], error))
                    }
                };
                for step in done..steps {
                    self.step(optimizer, &schedule)?;
                    self.save_checkpoint(optimizer, timer, (step + 1, schedule), None)?;
                }
                let views: Vec<usize> = (0..RANKING_VIEWS).map(|_| self.sampler.next()).collect();
                let errors = optimizer.removal_error(&views, self.refine.contrast_floor as f32)?;
                let left = errors.top_by_error(size, |place| optimizer.fixed()[place]);
                work.keep(&name, key, &(optimizer.checkpoint(), &left, self.sampler.taken))?;
                left
            }
        };
        timer.phase += 1;
        optimizer.pick(&left)?;
        Ok(left)
    }

    /// Runs `steps` optimization steps, then steps along time. Returns the delta with the best validation quality, and
    /// that quality.
    fn final_steps(
        &mut self,
        optimizer: &mut OptimizerState<'_>,
        timer: &mut CheckpointTimer,
        steps: usize,
        journal: &mut Journal,
    ) -> Result<BestState<ParamDelta, TrajectoryDelta>> {
        let count = self.validation.len();
        let (done, mut schedule, mut best_state) = match self.resume(optimizer, timer)? {
            Some((done, schedule, Some(best_state))) => (done, schedule, best_state),
            _ => {
                optimizer.reevaluate_states()?;
                let before = optimizer.quality(&self.validation)?;
                if before.psnr.is_nan() {
                    let why = format!("the PSNR of the {count} validation views is {}", decibels_text(before.psnr, 2));
                    journal.leave_out("refinement", why);
                    return Ok(BestState::new(before, optimizer.change()));
                }
                if before.psnr >= MAX_USEFUL_PSNR {
                    let why = format!("the {count} validation views have {:.2} dB PSNR without it", before.psnr);
                    journal.leave_out("refinement", why);
                    return Ok(BestState::new(before, optimizer.change()));
                }
                (0, RateSchedule::new(steps, LAST_RATES[1], before.error), BestState::new(before, optimizer.change()))
            }
        };
        let validate_every = steps.div_ceil(3).clamp(VALIDATE_EVERY[0], VALIDATE_EVERY[1]);
        for step in done + 1..=steps {
            self.step(optimizer, &schedule)?;
            if step % validate_every == 0 || step == steps {
                optimizer.reevaluate_states()?;
                let now = optimizer.quality(&self.validation)?;
                if self.refine.loss.is_closer(&now, &best_state.best) {
                    (best_state.best, best_state.delta) = (now, optimizer.change());
                } else if step < steps {
                    best_state.rate_factor *= RATE_REDUCTION;
                    optimizer.restart_from(&best_state.delta)?;
                    schedule = RateSchedule::new(steps - step, LAST_RATES[1], best_state.best.error)
                        .times(best_state.rate_factor);
                }
            }
            best_state.constant = best_state.best;
            self.save_checkpoint(optimizer, timer, (step, schedule), Some(best_state.checkpoint()))?;
        }
        let is_along = self.refine_along_time(optimizer, timer, (done, schedule), &mut best_state, steps)?;
        let [start, best] = [best_state.before.psnr, best_state.best.psnr];
        if self.refine.loss.is_closer(&best_state.best, &best_state.before) {
            journal.notes.push(format!("refinement: validation PSNR {start:.2} → {best:.2} dB ({count} views)"));
            journal.refined = Some(RefinedSummary { pictures: count, before: start, result: best });
        } else {
            let why = format!("it did not improve the validation PSNR of {start:.2} dB ({count} views)");
            journal.leave_out("refinement", why);
        }
        if !best_state.trajectory.is_empty() {
            let gain = best - best_state.constant.psnr;
            journal.notes.push(format!("refinement: {gain:.2} dB of this gain are due to changes along time"));
        } else if is_along {
            let why = format!("they did not improve the validation PSNR of {best:.2} dB");
            journal.leave_out("changes along time", why);
        }
        Ok(best_state)
    }

    /// Runs the optimization steps along time that follow `steps` steps, from the best delta that is constant in time
    /// or from the checkpoint at `done` steps. Keeps the time-varying delta with the best validation quality. Returns
    /// whether such steps were run.
    fn refine_along_time(
        &mut self,
        optimizer: &mut OptimizerState<'_>,
        timer: &mut CheckpointTimer,
        (done, mut schedule): (usize, RateSchedule),
        best_state: &mut BestState<ParamDelta, TrajectoryDelta>,
        steps: usize,
    ) -> Result<bool> {
        let keyframe_steps = self.steps_along_time(steps);
        if keyframe_steps == 0 || best_state.constant.psnr >= MAX_USEFUL_PSNR {
            return Ok(false);
        }
        if done <= steps {
            let keyframe_count = self.keyframe_count();
            optimizer.restart_from(&best_state.delta)?;
            if !optimizer.enable_keyframes(keyframe_count) {
                return Ok(false);
            }
            // Each view is a step of two keyframes.
            schedule = RateSchedule::new(2 * keyframe_steps / keyframe_count, LAST_RATES[1], best_state.constant.error);
        }
        let validate_every = keyframe_steps.div_ceil(3);
        for step in done.saturating_sub(steps) + 1..=keyframe_steps {
            optimizer.step_along(self.sampler.next(), &schedule)?;
            self.progress.advance(1);
            if step % validate_every == 0 || step == keyframe_steps {
                let now = optimizer.quality(&self.validation)?;
                let gains = self.refine.loss.ssim > 0.0 || now.psnr >= best_state.best.psnr + MIN_KEYFRAME_GAIN;
                if gains && self.refine.loss.is_closer(&now, &best_state.best) {
                    (best_state.best, best_state.trajectory) = (now, optimizer.course());
                }
            }
            self.save_checkpoint(optimizer, timer, (steps + step, schedule), Some(best_state.checkpoint()))?;
        }
        Ok(true)
    }
}

impl BestState<ParamDelta, TrajectoryDelta> {
    /// Creates the state without any gain.
    fn new(before: RenderQuality, delta: ParamDelta) -> Self {
        BestState {
            before,
            best: before,
            constant: before,
            delta,
            rate_factor: 1.0,
            trajectory: TrajectoryDelta::default(),
        }
    }

    /// Returns a view of this state for a checkpoint.
    fn checkpoint(&self) -> BestState<&ParamDelta, &TrajectoryDelta> {
        let BestState { before, best, constant, ref delta, rate_factor, ref trajectory } = *self;
        BestState { before, best, constant, delta, rate_factor, trajectory }
    }
}
