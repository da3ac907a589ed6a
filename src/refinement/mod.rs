//! Stage `refine`: fits the stored parameters of the survivors (the Gaussians that pruning left) to renders of the
//! original model.
//!
//! Pruning leaves holes that only the survivors can fill, by growing their footprints over them. Gradient descent
//! reduces the squared error (and, if set, 1 − SSIM) of one target view after another. Target views are renders of the
//! original from the cameras by which Gaussians are scored and from cameras in between, so that the result is not
//! overfitted to a few views; a few are from outside the rig (`outside`). If many Gaussians have to go, refinement
//! removes them in prune steps: optimize, rank the Gaussians again, remove the lowest-ranked, repeat. The final
//! optimization steps follow the last prune step.
//!
//! Some target views are used for validation only. They are rendered before the final steps and several times during
//! them, and the parameters with the best validation quality are written. A deformation field is not changed.
//!
//! Memory: an [`optimizer::Adam`], one view with its gradient, a few frame states (the exact number is in
//! [`RefineStage::resource_estimate`]), and the best parameter delta so far. The target views and the states at their
//! frames are in scratch files.

mod epoch_sampler;
mod linearized;
mod loss;
mod mean_delta;
pub mod optimizer;
pub(crate) mod optimizer_state;
pub(crate) mod photographs;
pub(crate) mod prune_steps;
mod quantized;
mod rounding;
mod run;
mod step_input;
mod survivors;
pub(crate) mod targets;

pub(crate) use run::RefineRun;

use crate::cache::CacheKey;
use crate::limits::Limits;
use crate::memory_plan::{
    MemoryPart, REMOVAL_COST, RENDER_COST, ResourceEstimate, SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload,
    bytes_of_survivors,
};
use crate::model::{Attributes, NO_SH_LIMIT};
use crate::passes::grid_strides;
use crate::pruning::score::{Scored, scored_memory};
use crate::recipe;
use crate::refinement::optimizer_state::{REEVALUATE_EVERY, StepParams, keyframe_count};
use crate::render::{ALL_PIXELS, GRADIENT_BYTES_PER_VISIBLE, GRADIENT_STRIP_BYTES, GridStrides, STRIP_BYTES};
use crate::scene::Scene;
use loss::Loss;
use targets::{TargetViewParams, ViewStrides};

/// Name of the refinement stage in messages and in the cache.
const NAME: &str = "refine";

/// Time of one optimization step, divided by the time to render its view.
const STEP_RENDERS: f64 = 3.0;

/// Validation PSNR in dB at or above which refinement is skipped as useless: the root mean square error is then at most
/// about a quarter of an 8-bit step.
pub(crate) const MAX_USEFUL_PSNR: f64 = 60.0;
/// Refinement to the fraction k of all Gaussians begins with the fraction `START_FACTOR` · √k, or with k if that is
/// more. Ranking alone chooses the Gaussians at the beginning; prune steps between optimization steps then remove more of
/// them. Prune steps choose better than the ranking, because they rank optimized Gaussians and protect neighbors, but
/// steps with more Gaussians take longer.
const START_FACTOR: f64 = 0.9;
/// Largest fraction of all Gaussians with which refinement begins, unless more are to stay, if there is little memory.
const SMALL_START: f64 = 0.4;
/// If more than this fraction of all Gaussians stay, there are fewer final steps, in proportion to the fraction removed:
/// less has to be made up for.
const FULL_STEPS_FRACTION: f64 = 0.4;
/// If more than this fraction of all Gaussians stay, there are fewer final steps, because each takes longer.
const CHEAP_STEPS_FRACTION: f64 = 0.1;
/// If the fraction k of all Gaussians stays, the number of final steps has the factor ([`CHEAP_STEPS_FRACTION`] / k) to
/// this power, at most 1.
const STEP_COST_POWER: f64 = 0.6;
/// Numerator and denominator of the factor on the number of final steps if opacities vary with time. The states of such
/// inputs take longer to read, so that steps are a smaller part of the time. `room2_dynerf` gains 0.15 and 0.1 dB at 20
/// and 10% kept, `spinach_4` 0.1 dB at 10%, in about 8% more time.
const STEPS_IF_OPACITY_VARIES: [usize; 2] = [4, 3];
/// A validation view is rendered at the largest strides, from 1 to 4, that leave at least this many of its pixels.
const VALIDATION_PIXELS: f64 = 20_000.0;
/// Minimum fraction of the remaining Gaussians that one prune step keeps.
pub(crate) const MIN_KEPT_FRACTION: f64 = 0.8;
/// Number of views by which the Gaussians are ranked for one prune step, less the guard views among them. Each prune
/// step takes the next views of the random order of the training views.
const RANKING_VIEWS: usize = 48;
/// Bytes of memory per Gaussian for its removal error, its position, a k-d tree and marks while a prune step chooses
/// the Gaussians that stay.
const NEIGHBOR_BYTES: u64 = 64;
/// Maximum number of validation views that are rendered to set the learning rates of the optimization steps before a
/// prune step. The rates depend on the error of these renders.
const RATE_VIEWS: usize = 16;

/// Stage that refines the Gaussians left by pruning, with its parameters.
#[derive(Debug, Clone)]
pub struct RefineStage {
    /// Attributes of the Gaussians that refinement optimizes.
    pub columns: Attributes,
    /// Maximum degree of the SH coefficients that refinement optimizes.
    pub sh_degree: usize,
    /// Loss that refinement minimizes.
    loss: Loss,
    /// Number of optimization steps after the last prune step; each uses one view.
    pub steps: usize,
    /// Upper limit of the number of optimization steps before a prune step. [`RefineStage::steps_before`] returns a
    /// smaller number while many Gaussians are left.
    pub steps_per_prune: usize,
    /// Number and kinds of target views (renders of the original that the Gaussians are fitted to).
    pub target_views: TargetViewParams,
    /// Whether validation views choose among the parameters that the final steps pass through. Otherwise the mean over
    /// the last of these steps is kept.
    pub validates: bool,
    /// Whether refinement may remove Gaussians in prune steps between optimization steps.
    pub prunes: bool,
    /// Largest fraction of all Gaussians with which a refinement with prune steps begins, unless more are to stay.
    pub max_start: f64,
    /// Constant c of the removal errors by which Gaussians are ranked for a prune step: c² is added to each squared
    /// difference between the color of a Gaussian and the colors that it hides (norm over red, green, blue, each from 0
    /// to 1). See [`crate::render::RemovalError`].
    pub contrast_floor: f64,
    /// Maximum number of keyframes of the time-varying delta, for inputs with explicit frames. This delta holds values
    /// that refinement adds to each frame, interpolated between keyframes. With 0 keyframes, all added values are
    /// constant in time.
    pub keyframes: usize,
    /// Number of optimization steps that refine the result again for the quantization of an archive.
    pub archive_steps: usize,
    /// Fraction of the Gaussians that the user wants to keep; `None` if not given.
    pub target: Option<f64>,
}

impl RefineStage {
    /// Returns the refinement stage with the parameters of `recipe`, or `None` if `recipe` optimizes no attribute or
    /// has no optimization steps.
    /// - `target`: fraction of the Gaussians that the user wants to keep; `None` if not given.
    /// - `prunes`: whether refinement may remove Gaussians in prune steps between optimization steps. Prune steps need
    ///   a run that ranks Gaussians by renders.
    pub fn from_recipe(recipe: &recipe::Recipe, target: Option<f64>, prunes: bool) -> Option<RefineStage> {
        let recipe::RefineParams {
            refine,
            refine_steps,
            refine_steps_per_prune,
            refine_target_views: _,
            refine_between: _,
            refine_validate,
            refine_ssim,
            refine_keyframes,
            refine_archive_steps,
        } = recipe.refine;
        let refine = RefineStage {
            columns: refine.0,
            sh_degree: NO_SH_LIMIT,
            loss: Loss { ssim: refine_ssim },
            steps: refine_steps as usize,
            steps_per_prune: refine_steps_per_prune as usize,
            target_views: TargetViewParams::from_recipe(&recipe.refine),
            validates: refine_validate,
            prunes,
            max_start: 1.0,
            contrast_floor: recipe.select.contrast_floor,
            keyframes: refine_keyframes,
            archive_steps: refine_archive_steps as usize,
            target,
        };
        (!refine.columns.is_empty() && refine.steps > 0).then_some(refine)
    }

    /// Returns a copy of this stage that leaves SH coefficients above degree 0 unchanged.
    pub fn with_fixed_higher_sh(self) -> RefineStage {
        RefineStage { sh_degree: 0, ..self }
    }

    /// Returns a copy of this stage whose parameter deltas (values that refinement adds to the stored parameters) do
    /// not vary with time.
    pub fn with_time_independent_deltas(self) -> RefineStage {
        RefineStage { keyframes: 0, ..self }
    }

    /// Returns a copy of this stage that begins with fewer Gaussians, at most the fraction [`SMALL_START`] unless more
    /// are to stay. It takes less memory.
    pub fn with_small_start(self) -> RefineStage {
        RefineStage { max_start: SMALL_START, ..self }
    }

    /// Returns whether this stage may begin with fewer Gaussians than it would without the limit
    /// [`RefineStage::max_start`].
    pub(crate) fn has_smaller_start(&self) -> bool {
        let is_limited = |target| start_fraction(target, self.max_start) < start_fraction(target, 1.0);
        self.prunes && self.target.is_some_and(is_limited)
    }

    /// Returns the fraction of all Gaussians with which this stage begins, if it ends with the fraction `target`.
    fn first_fraction(&self, target: f64) -> f64 {
        if self.prunes { start_fraction(target, self.max_start) } else { target }
    }

    /// Returns a copy of this stage that removes no Gaussians.
    pub fn without_prune_steps(self) -> RefineStage {
        RefineStage { prunes: false, ..self }
    }

    /// Returns a copy of this stage with the numbers of optimization steps multiplied by `part` and rounded up, and
    /// with parameter deltas that do not vary with time.
    pub fn with_step_fraction(&self, part: f64) -> RefineStage {
        let scaled = |steps: usize| (part * steps as f64).ceil() as usize;
        RefineStage { steps: scaled(self.steps), steps_per_prune: scaled(self.steps_per_prune), ..self.clone() }
            .with_time_independent_deltas()
    }

    /// Returns the cache key of the parameters of this stage. It does not depend on the input.
    pub(crate) fn key(&self) -> CacheKey {
        let step_settings = (self.steps, self.steps_per_prune, self.prunes, self.max_start, self.keyframes);
        let view_settings = (self.target_views, self.validates, self.contrast_floor);
        CacheKey::new(&(self.columns.bits(), self.sh_degree, self.loss, step_settings, view_settings))
    }

    fn step_params(&self) -> StepParams {
        StepParams { columns: self.columns, sh_degree: self.sh_degree, loss: self.loss }
    }

    /// Returns the strides at which the target views are stored. Those of the training views are [`RefineStage::strides`]
    /// for `first` Gaussians, the number with which refinement begins. If prune steps remove Gaussians, they are the
    /// strides for a third of `first`, because fewer Gaussians allow larger strides. `work`: the input.
    pub(crate) fn stored_strides(&self, work: &Workload, first: usize) -> ViewStrides {
        let fewer = if self.prunes { first / 3 } else { first };
        ViewStrides { training: self.strides(work, fewer), validation: self.validation_strides(work.pixels) }
    }

    /// Returns the strides at which the training views are stored for the input `work`, if refinement begins with `first`
    /// Gaussians. A search, which has no target, stores them at the strides for all Gaussians.
    fn stored_training_strides(&self, work: &Workload, first: f64) -> GridStrides {
        match self.target {
            Some(_) => self.stored_strides(work, first as usize).training,
            None => self.strides(work, work.gaussian_count() as usize),
        }
    }

    /// Returns the strides of validation views with `pixels` pixels. They leave at least [`VALIDATION_PIXELS`], and all
    /// pixels if SSIM is part of the loss.
    fn validation_strides(&self, pixels: u64) -> GridStrides {
        if self.loss.ssim > 0.0 { ALL_PIXELS } else { grid_strides(pixels, VALIDATION_PIXELS) }
    }

    /// Returns the strides of the grid of pixels of training views of the input `work` that are rendered and compared.
    /// `survivors`: number of Gaussians left by pruning. See [`Loss::strides`].
    pub(crate) fn strides(&self, work: &Workload, survivors: usize) -> GridStrides {
        self.loss.strides(work, survivors)
    }

    /// Returns the number of final steps (optimization steps after the last prune step) for a model that keeps `count`
    /// of `all` Gaussians of an input whose attributes `varying` vary with time. It is [`RefineStage::steps`] times
    /// three factors, rounded up. With k = `count` / `all`, they are:
    /// - (1 − k) / (1 − [`FULL_STEPS_FRACTION`]), at most 1;
    /// - ([`CHEAP_STEPS_FRACTION`] / k) to the power of [`STEP_COST_POWER`], at most 1;
    /// - [`STEPS_IF_OPACITY_VARIES`] if opacities vary, otherwise 1.
    fn final_step_count(&self, varying: Attributes, count: usize, all: usize) -> usize {
        let kept = count as f64 / all.max(1) as f64;
        let removed_part = ((1.0 - kept) / (1.0 - FULL_STEPS_FRACTION)).clamp(0.0, 1.0);
        let cost_factor = (CHEAP_STEPS_FRACTION / kept).powf(STEP_COST_POWER).min(1.0);
        let [more, less] = if varying.contains(Attributes::OPACITY) { STEPS_IF_OPACITY_VARIES } else { [1, 1] };
        (removed_part * cost_factor * (self.steps * more) as f64 / less as f64).ceil() as usize
    }

    /// Returns the number of final steps ([`RefineStage::final_step_count`]) for a model that keeps `count` of the
    /// Gaussians of `scene`. `scored`: scores of all Gaussians of the scene.
    fn final_steps_in(&self, scene: &Scene, scored: &Scored, count: usize) -> usize {
        self.final_step_count(scene.source().info().varying, count, scored.gaussian_count())
    }

    /// Returns the number of keyframes of the time-varying delta (values that refinement adds to each frame,
    /// interpolated between keyframes) for the input described by `work`; 0 if the delta is constant in time.
    fn keyframes_for(&self, work: &Workload) -> usize {
        match (work.input.jacobian, work.frames) {
            // The number of frames of a stream is not known in advance, so the maximum number of keyframes is assumed.
            (0, 0) => self.keyframes,
            (0, frames) => keyframe_count(self.keyframes, frames as usize),
            _ => 0,
        }
    }

    /// Returns the number of optimization steps before a prune step: `steps_per_prune` · `target_count` / `count`,
    /// rounded up, for `count` Gaussians now and `target_count` Gaussians after the last prune step. With more
    /// Gaussians there are fewer steps, because a step takes longer and more of its effect is removed later.
    fn steps_before(&self, count: usize, target_count: usize) -> usize {
        (self.steps_per_prune as f64 * target_count as f64 / count.max(1) as f64).ceil() as usize
    }

    /// Returns the resource estimate (bytes of memory, seconds) of refinement for the input `work`. The memory holds
    /// frame states, the optimizer, and one render with its gradient.
    pub fn resource_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        self.estimate_for_views(work, limits, self.target_views.view_counts(work))
    }

    /// Estimates memory and time as [`RefineStage::resource_estimate`] does, for `own` target views from the scene's
    /// cameras and `between` from new cameras.
    fn estimate_for_views(&self, work: &Workload, limits: &Limits, [own, between]: [usize; 2]) -> ResourceEstimate {
        let whole = work.state_bytes(Attributes::all());
        let read = [("readers", work.input.reader), ("kept frames", work.kept_frames_bytes(limits, Attributes::all()))];
        // Colors are computed for several views of a frame. Then each view is rendered; renderers keep their buffers.
        let together = work.threads.min(limits.views_together as u64);
        let rendered = [("states", whole), ("views", targets::render_bytes_per_gaussian(together))];
        let original: Vec<MemoryPart> = read.into_iter().chain(rendered).collect();
        // With a deformation field, no reader is open while steps are made. While states are evaluated again, two more
        // states and what the field computes without time are held; while views are rendered, one state per thread and
        // the renderer's buffers. A step on several threads holds the state of its frame and that of the next step.
        let is_deformed = work.input.jacobian > 0;
        let states = if is_deformed { 4 + work.threads.max(2) } else { 6 + work.threads };
        let left_readers = if is_deformed { [("readers", 0), ("kept frames", 0)] } else { read };
        // Optimization steps use one renderer, and the ranking of a prune step one per thread.
        let view_bytes = (2 * GRADIENT_BYTES_PER_VISIBLE as u64).max(work.threads * SHARED_VIEW_BYTES_PER_GAUSSIAN);
        let left = [
            ("states", states * whole),
            ("jacobians", (2 + work.threads.max(2)) * work.input.jacobian),
            ("mean", 2 * work.state_bytes(self.columns)),
            ("neighbors", NEIGHBOR_BYTES),
            (
                "optimizer",
                whole + optimizer::bytes_per_gaussian(self.columns, work.sh_degree.min(self.sh_degree)) as u64,
            ),
            ("result", work.input.compressed),
            ("views", view_bytes.max(work.input.prepared)),
        ];
        // Peak memory is the maximum of three phases: rendering the original, optimizing constant deltas of the
        // survivors, and optimizing deltas that vary with time.
        let phase = |part: f64, more: Option<MemoryPart>| -> Vec<MemoryPart> {
            let parts = left_readers.into_iter().chain(left).chain(more);
            parts.map(|(name, bytes)| (name, bytes_of_survivors(part, bytes))).collect()
        };
        let (wanted, keyframe_count) = (self.target.unwrap_or(1.0).min(1.0), self.keyframes_for(work));
        // The last two terms hold a copy of the best time-varying delta so far.
        let keyframe_bytes = optimizer::bytes_per_gaussian(self.columns, 0) as u64
            + work.state_bytes(self.columns.difference(Attributes::SH))
            + 12;
        let keyframe_steps = (keyframe_count > 0)
            .then(|| phase(wanted, Some(("trajectory delta", keyframe_count as u64 * keyframe_bytes))));
        let bytes = |parts: &Vec<MemoryPart>| parts.iter().map(|part| part.1).sum::<u64>();
        let first = self.first_fraction(wanted);
        let stages = [Some(original), Some(phase(first, None)), keyframe_steps];
        let per_gaussian = stages.into_iter().flatten().max_by_key(bytes).unwrap_or_default();
        // There may be fewer views than are asked for. Their number is 0 if it is not known.
        let own = if work.frame_views > 0 { own.min(work.frame_views as usize) } else { own };
        let (target_views, frames) = ((own + between) as f64, (own as u64).min(work.frames.max(1)));
        let wanted = self.target.unwrap_or(0.5);
        let last_count = (wanted * 1e6) as usize;
        let first_count = (self.first_fraction(wanted) * 1e6).ceil() as usize;
        let prune_counts = prune_counts(first_count, last_count);
        let final_steps = self.final_step_count(work.varying, last_count, 1_000_000);
        let steps = final_steps + if keyframe_count > 0 { along_time(final_steps) } else { 0 };
        let validations = if self.validates { 4.0 } else { 2.0 };
        let validation_renders = target_views / targets::validation_every(own + between) as f64 * validations;
        let seconds = |(k, &size): (usize, &usize)| {
            let count = size as f64 / 1e6 * work.gaussian_count();
            let (steps, renders, ranked) = match k + 1 == prune_counts.len() {
                true => (steps, validation_renders, 0.0),
                false => (self.steps_before(size, last_count), RATE_VIEWS as f64, RANKING_VIEWS as f64),
            };
            // With a deformation field, states and their Jacobians take twice as long to evaluate as states alone.
            let found = if work.input.jacobian > 0 { 2.0 * steps as f64 / REEVALUATE_EVERY as f64 } else { 0.0 };
            let strided = work.on_grid(self.strides(work, count as usize));
            work.reading_seconds(count, frames as f64 * found)
                + work.render_seconds(renders, count, RENDER_COST)
                + strided.render_seconds(STEP_RENDERS * steps as f64, count, RENDER_COST)
                + strided.render_seconds(ranked, count, REMOVAL_COST)
        };
        let first = prune_counts.first().map_or(0.0, |&first| first as f64 / 1e6 * work.gaussian_count());
        let stored = work.on_grid(self.stored_training_strides(work, first));
        // Validation and test views may be whole. `together` of them are rendered at a time, with 6 bytes per pixel of
        // the target view. Steps render pixels of a grid, and hold the image, its gradient and the target views of two
        // steps.
        let whole_views = together * 24 * work.pixels;
        let views_of_steps = (work.threads + 4) * 12 * stored.pixels;
        ResourceEstimate {
            stage: NAME,
            reads: 2.0 * work.scattered_whole_input_reads(frames, limits) + work.whole_input_reads(1, limits),
            seconds: 2.0 * work.reading_seconds(work.gaussian_count(), frames as f64)
                + stored.render_seconds(target_views, work.gaussian_count(), RENDER_COST)
                + prune_counts.iter().enumerate().map(seconds).sum::<f64>(),
            per_gaussian: [scored_memory(limits), vec![("survivors", 24)], per_gaussian].concat(),
            fixed: vec![
                work.block_buffer_memory(),
                ("pairs", (GRADIENT_STRIP_BYTES as u64).max(together * STRIP_BYTES as u64)),
                ("views", whole_views.max(views_of_steps)),
                ("similarity", self.loss.bytes_per_pixel(work.threads) * work.pixels),
            ],
        }
    }
}

/// Returns the number of Gaussians with which a refinement with prune steps begins: the larger of `target_count`, the
/// number with which it ends, and the fraction [`start_fraction`] of the `all` Gaussians of the model.
pub(crate) fn start_count(target_count: usize, all: usize, max_start: f64) -> usize {
    let fraction = start_fraction(target_count as f64 / all.max(1) as f64, max_start);
    target_count.max((fraction * all as f64).ceil() as usize).min(all)
}

/// Returns the fraction of all Gaussians with which a refinement with prune steps begins, if it ends with the fraction
/// `target`, from 0 to 1: [`START_FACTOR`] · √`target`, but at most `max_start` and at least `target`.
fn start_fraction(target: f64, max_start: f64) -> f64 {
    target.max((START_FACTOR * target.sqrt()).min(max_start))
}

/// Returns the number of optimization steps of the trajectory delta, which is optimized after the constant delta: two
/// thirds of `steps`, the number of steps of the constant delta.
fn along_time(steps: usize) -> usize {
    2 * steps / 3
}

/// Returns the number of Gaussians before the first prune step and after each one, for prune steps that lead from
/// `first` to `last` Gaussians.
fn prune_counts(first: usize, last: usize) -> Vec<usize> {
    let ratio = last.max(1) as f64 / first.max(1) as f64;
    let step_count = (ratio.ln() / MIN_KEPT_FRACTION.ln() - 1e-9).ceil().max(0.0) as usize;
    let after = |k: usize| (first as f64 * ratio.powf(k as f64 / step_count as f64)).round() as usize;
    let mut prune_counts: Vec<usize> = std::iter::once(first).chain((1..step_count).map(after)).collect();
    prune_counts.extend((step_count > 0).then_some(last));
    prune_counts
}

#[cfg(test)]
mod tests;
