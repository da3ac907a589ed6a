//! Optimizer with the frame states that it needs: the attributes of the survivors (Gaussians left by pruning) at the
//! frames of the target views.

use std::borrow::Cow;
use std::num::NonZeroU32;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::linearized::{LinearizedFrames, LinearizedFramesWriter, LinearizedState};
use super::loss::{Loss, RenderQuality, limit_gradient};
use super::rounding::Rounding;
use super::step_input::{StepFiles, StepInput};
use super::targets::Targets;
use crate::archive::CloudSteps;
use crate::compressed_model::{ParamDelta, TrajectoryDelta};
use crate::error::{Error, Result};
use crate::model::{AttributeValues, Attributes, Gaussians, Gradients, Jacobian, SequenceInfo, StoredParams};
use crate::passes::FrameStates;
use crate::refinement::optimizer::{Adam, RateSchedule};
use crate::render::{GridStrides, RemovalError, Renderer};
use crate::scene::Scene;
use crate::source::{Deformation, FrameSource, ReadPlan};

/// Settings of optimization steps: the loss and the attributes that are optimized.
#[derive(Debug, Clone, Copy)]
pub(super) struct StepParams {
    /// Attributes of the Gaussians that optimization steps change.
    pub(super) columns: Attributes,
    /// Maximum degree of the SH coefficients that optimization steps change.
    pub(super) sh_degree: usize,
    /// Loss that optimization steps minimize.
    pub(super) loss: Loss,
}

/// Minimum number of frames per keyframe of the time-varying delta ([`TrajectoryDelta`]: values that refinement adds to
/// each frame, interpolated between keyframes).
const FRAMES_PER_KEYFRAME: usize = 4;

/// Returns the number of keyframes of the time-varying delta (values that refinement adds to each frame) for a sequence
/// of `frames` frames: one for every [`FRAMES_PER_KEYFRAME`] frames, and at most `max_keyframes`. Returns 0 in place of
/// 1, because a delta with a single keyframe does not vary with time.
pub(super) fn keyframe_count(max_keyframes: usize, frames: usize) -> usize {
    let keyframe_count = max_keyframes.min(frames / FRAMES_PER_KEYFRAME);
    if keyframe_count > 1 { keyframe_count } else { 0 }
}

/// Approximate number of optimization steps between two evaluations of the frame states from the stored parameters.
/// Needed only if the model has a deformation field; otherwise a frame state is always the state at the start plus the
/// delta. 200 gain up to 0.1 dB in 3% more time. The derivatives have to be evaluated as often: with those of the start,
/// results lose 1 to 2 dB.
pub(super) const REEVALUATE_EVERY: usize = 250;

/// Optimizer together with its data: the frame states (attributes at one frame) of the Gaussians left by pruning, at
/// the frames of the target views, and the delta (change of the parameters since the start of refinement).
///
/// If the model has a deformation field, a frame state is not simply the stored parameters plus a delta. Each state is
/// then evaluated anew about every [`REEVALUATE_EVERY`] steps, and extrapolated with its derivatives (Jacobian) in between.
/// Evaluating the field and its derivatives at every step would take three times as long and gain nothing (method.md,
/// section 6.2).
///
/// Memory: six frame states, [`Adam`], and a view with its gradient. A scratch file holds one state per frame; for a
/// frame in which few Gaussians are visible, only the states of these.
pub(super) struct OptimizerState<'a> {
    scene: &'a Scene,
    targets: &'a Targets,
    deformation: Option<&'a dyn Deformation>,
    /// Indices of the frames of the target views, increasing.
    frames: Vec<usize>,
    varying: Attributes,
    /// State of each frame in `frames`, without the delta (change of the stored parameters) of `constant_optimizer`.
    linearized: LinearizedFrames,
    /// Stored parameters, without the delta of `constant_optimizer`. Used only if the model has a deformation field.
    stored: StoredParams,
    /// Part of the constant delta (change of the stored parameters since the start of refinement) that `stored` and the
    /// frame states `linearized` already include. The rest is the delta of `constant_optimizer`.
    baked_delta: ParamDelta,
    fixed: Vec<bool>,
    /// Settings of optimization steps. Attributes and SH degrees are left out if the model does not have them, or if
    /// its deformation field cannot compute their derivatives.
    step_params: StepParams,
    constant_optimizer: Adam,
    /// One optimizer per keyframe of the time-varying delta; empty if the delta is constant in time.
    keyframe_optimizers: Vec<Adam>,
    /// Rounding of the parameters before every render; `None` if they are rendered as they are.
    rounding: Option<Rounding>,
    /// For each Gaussian, the attributes that vary between frames; no attributes if the model has a deformation field.
    changing: Vec<Attributes>,
    gradients: Gradients,
    /// Buffer for the state of the frame that is being rendered.
    now: LinearizedState,
    /// Data of the next optimization step if it was read during the last one.
    prefetched: Option<StepInput>,
    renderer: Renderer,
    /// Strides of the grid of pixels of training views that are rendered in optimization steps and for the ranking of a
    /// prune step.
    strides: GridStrides,
    /// Running mean square of the derivatives of the loss with respect to color values ([`Loss::gradient`]), over the
    /// optimization steps on views that are not guard views ([`Targets::is_guard`]). `None` before the first such step.
    mean_square_gradient: Option<f64>,
    /// Number of optimization steps since the frame states were last evaluated.
    steps: usize,
    /// Number of optimization steps between two evaluations of the frame states.
    reevaluate_every: usize,
    /// Whether the frame states were evaluated again after `constant_optimizer` (optimizer of the stored parameters)
    /// was created. It is created at the beginning and again in every prune step.
    reevaluated: bool,
}

/// Contents of a checkpoint of an [`OptimizerState`].
#[derive(Serialize, Deserialize)]
pub(super) struct OptimizerCheckpoint<Stored, Added, Means> {
    /// Stored parameters at the last evaluation of the frame states, and the delta that they include; `None` if the
    /// frame states were not evaluated again after `constant_optimizer` was created.
    reevaluated: Option<(Stored, Added)>,
    /// Delta, running means and step number of the optimizer of the stored parameters.
    constant_optimizer: (Added, Means, usize),
    /// Number of steps since the frame states were evaluated.
    steps: usize,
    /// Running mean square of the derivatives with respect to color values.
    mean_square_gradient: Option<f64>,
    /// Delta, running means and step number of the optimizer of each keyframe.
    keyframe_optimizers: Vec<(Added, Means, usize)>,
}

/// Contents of a checkpoint ([`OptimizerCheckpoint`]), read back from the cache.
pub(super) type LoadedCheckpoint = OptimizerCheckpoint<StoredParams, ParamDelta, [Gaussians; 2]>;

impl<'a> OptimizerState<'a> {
    /// Creates the optimizer state for a pruned model whose frames `result` reads. Only Gaussians for which `fixed` is
    /// false are optimized.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or a scratch file cannot be written.
    pub(super) fn new(
        scene: &'a Scene,
        result: &'a dyn FrameSource,
        targets: &'a Targets,
        StepParams { columns, sh_degree, loss }: StepParams,
        fixed: Vec<bool>,
    ) -> Result<OptimizerState<'a>> {
        let mut frames: Vec<usize> = targets.views.iter().map(|view| view.frame).collect();
        frames.dedup();
        let deformation = result.deformation();
        let SequenceInfo { varying, sh_degree: state_degree, .. } = *result.info();
        let sh_degree = sh_degree.min(state_degree);
        let columns = columns & deformation.map_or(Attributes::all(), Deformation::movable);
        let empty = Gaussians::zeros(0, state_degree);
        let mut optimizer = OptimizerState {
            scene,
            targets,
            deformation,
            linearized: LinearizedFramesWriter::new(&scene.scratch, varying)?.finish()?,
            stored: deformation.map_or_else(|| empty.clone().into(), |deformation| deformation.stored().clone()),
            baked_delta: ParamDelta::default(),
            constant_optimizer: Adam::new(&empty, columns, sh_degree, &[]),
            keyframe_optimizers: Vec::new(),
            rounding: None,
            changing: vec![Attributes::empty(); fixed.len()],
            gradients: Gradients::new(0, columns, sh_degree),
            now: LinearizedState::none(state_degree),
            prefetched: None,
            renderer: Renderer::on_all_threads(),
            strides: targets.strides(),
            mean_square_gradient: None,
            steps: 0,
            reevaluate_every: REEVALUATE_EVERY,
            reevaluated: false,
            frames,
            varying,
            fixed,
            step_params: StepParams { columns, sh_degree, loss },
        };
        if deformation.is_some() {
            optimizer.reevaluate_states()?;
        } else {
            let wanted = ReadPlan::new(optimizer.frames.clone()).with_max_kept_frames(scene.limits.max_kept_frames);
            let mut states = FrameStates::open(result, &wanted)?;
            let mut linearized = LinearizedFramesWriter::new(&scene.scratch, varying)?;
            for &frame in &optimizer.frames {
                let state = states.read(frame)?.clone();
                if let Some(LinearizedState { state: first, .. }) = linearized.first() {
                    for column in varying.iter() {
                        let (first, now) = (first.attribute_values(column), state.attribute_values(column));
                        for c in 0..now.width() {
                            let values = first.plane(c).iter().zip(now.plane(c));
                            for (changing, (first, now)) in optimizer.changing.iter_mut().zip(values) {
                                changing.set(column, changing.contains(column) || first != now);
                            }
                        }
                    }
                }
                linearized.push(&mut LinearizedState { state, ..LinearizedState::default() })?;
            }
            optimizer.linearized = linearized.finish()?;
        }
        optimizer.start_optimizer();
        Ok(optimizer)
    }

    /// Replaces the optimizer of the stored parameters, `constant_optimizer`, by a new one for the Gaussians that are
    /// left. Its delta is 0. Also sets `strides`, the strides of the rendered pixels of training views, for this number
    /// of Gaussians (see [`Loss::strides`]).
    fn start_optimizer(&mut self) {
        (self.reevaluated, self.prefetched) = (false, None);
        let Some(LinearizedState { state, .. }) = self.linearized.first() else { return };
        let StepParams { columns, sh_degree, loss } = self.step_params;
        self.constant_optimizer = Adam::new(state, columns, sh_degree, &self.fixed);
        self.gradients = Gradients::new(state.len(), columns, sh_degree);
        // Multiples of the strides at which the target views are stored.
        let stored = self.targets.strides();
        let wanted = loss.strides(&self.scene.workload(), state.len());
        self.strides = [0, 1].map(|axis| {
            let multiple = NonZeroU32::new(wanted[axis].get() / stored[axis]).unwrap_or(NonZeroU32::MIN);
            stored[axis].saturating_mul(multiple)
        });
    }

    /// Adds a time-varying delta with `keyframe_count` keyframes, which starts at 0. The delta changes only attributes
    /// that vary with time in the input (others are stored once for all frames), and of the SH coefficients only degree
    /// 0. Returns whether there is an attribute to change.
    pub(super) fn enable_keyframes(&mut self, keyframe_count: usize) -> bool {
        let columns = self.step_params.columns & self.changing.iter().copied().collect();
        let Some(LinearizedState { state, .. }) = self.linearized.first().filter(|_| !columns.is_empty()) else {
            return false;
        };
        self.keyframe_optimizers = (0..keyframe_count).map(|_| Adam::new(state, columns, 0, &self.fixed)).collect();
        true
    }

    /// Sets that parameters are rounded to quantization grids before every render. Must be called before the first
    /// optimization step, and [`OptimizerState::pick`] must not be called afterward.
    /// - `start`: the stored parameters.
    /// - `quantization`: quantization steps of their attributes.
    pub(super) fn set_rounding(&mut self, start: Gaussians, quantization: CloudSteps) {
        let first = self.linearized.first().map(|first| (&first.state, Attributes::all().difference(self.varying)));
        let base = self.deformation.map(|_| (&self.stored.gaussians, Attributes::all())).or(first);
        self.rounding = base.map(|(base, constant)| Rounding::new(start, quantization, base, constant));
    }

    /// Returns the time-varying delta, the values that refinement adds to each frame: one set of values per keyframe.
    pub(super) fn trajectory_delta(&self) -> TrajectoryDelta {
        TrajectoryDelta(self.keyframe_optimizers.iter().map(|keyframe| keyframe.delta().clone()).collect())
    }

    /// Returns the two keyframes around the frame with index `k` in `self.frames`: number and interpolation weight of
    /// each.
    fn keyframes_around(&self, k: usize) -> [(usize, f32); 2] {
        TrajectoryDelta::keyframe_weights(
            self.keyframe_optimizers.len(),
            self.frames[k],
            self.scene.source().info().times.len(),
        )
    }

    /// Returns for each Gaussian whether it is excluded from optimization because it is protected.
    pub(super) fn fixed(&self) -> &[bool] {
        &self.fixed
    }

    /// Returns the total constant delta: the current stored parameters minus the stored parameters at the start. The
    /// time-varying delta is not part of it.
    pub(super) fn change(&self) -> ParamDelta {
        let baked_delta = self.baked_delta.clone();
        if self.constant_optimizer.has_moved() {
            baked_delta.plus(self.constant_optimizer.delta().clone())
        } else {
            baked_delta
        }
    }

    /// Divides the optimization steps between two validations into equal parts of about [`REEVALUATE_EVERY`] steps. The
    /// frame states are evaluated anew after each part, so that none is evaluated shortly before a validation, which
    /// evaluates them too. `validate_every`: number of steps between two validations.
    pub(super) fn reevaluate_between_validations(&mut self, validate_every: usize) {
        let parts = (validate_every as f64 / REEVALUATE_EVERY as f64).round().max(1.0);
        self.reevaluate_every = (validate_every as f64 / parts).ceil() as usize;
    }

    /// Evaluates the frame states anew from the stored parameters. Does nothing if the model has no deformation field,
    /// because the states are then exact.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be written.
    pub(super) fn reevaluate_states(&mut self) -> Result<()> {
        let Some(deformation) = self.deformation else { return Ok(()) };
        self.bake_delta();
        self.free_buffers();
        let mut linearized = LinearizedFramesWriter::new(&self.scene.scratch, self.varying)?;
        let gaussians = deformation.with_params(&self.stored);
        for &frame in &self.frames {
            let want = if linearized.is_empty() { Attributes::all() } else { self.varying };
            (self.now.present, self.now.jacobian) = (None, Jacobian::default());
            gaussians.state(frame, want, &mut self.now.state)?;
            self.now.jacobian = gaussians.jacobian(frame, self.step_params.columns)?;
            linearized.push(&mut self.now)?;
        }
        drop(gaussians);
        self.linearized = linearized.finish()?;
        (self.steps, self.reevaluated) = (0, true);
        Ok(())
    }

    /// Frees the buffers of the renderer that the optimization steps use, and the data that were read for the next
    /// step. The memory plan counts only one of three amounts, which are therefore never in memory together: these
    /// buffers, the time-independent results of a deformation field, and the renderers of
    /// [`OptimizerState::removal_error`].
    fn free_buffers(&mut self) {
        (self.renderer, self.prefetched) = (Renderer::on_all_threads(), None);
    }

    /// Returns the contents of a checkpoint, from which [`OptimizerState::resume`] continues.
    pub(super) fn checkpoint(&self) -> impl Serialize + '_ {
        OptimizerCheckpoint {
            reevaluated: self.reevaluated.then_some((&self.stored, &self.baked_delta)),
            constant_optimizer: self.constant_optimizer.checkpoint(),
            steps: self.steps,
            mean_square_gradient: self.mean_square_gradient,
            keyframe_optimizers: self.keyframe_optimizers.iter().map(Adam::checkpoint).collect(),
        }
    }

    /// Continues from a checkpoint. The run that wrote it must have started with the same model and removed the same
    /// Gaussians.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be written.
    pub(super) fn resume(&mut self, checkpoint: LoadedCheckpoint) -> Result<()> {
        if let Some((stored, baked_delta)) = checkpoint.reevaluated {
            self.constant_optimizer.take_delta();
            (self.stored, self.baked_delta) = (stored, baked_delta);
            self.reevaluate_states()?;
        }
        self.constant_optimizer.resume(checkpoint.constant_optimizer);
        (self.steps, self.mean_square_gradient) = (checkpoint.steps, checkpoint.mean_square_gradient);
        let keyframes = checkpoint.keyframe_optimizers;
        if !keyframes.is_empty() {
            self.enable_keyframes(keyframes.len());
            self.keyframe_optimizers.iter_mut().zip(keyframes).for_each(|(optimizer, saved)| optimizer.resume(saved));
        }
        Ok(())
    }

    /// Returns the present positions of all Gaussians at the first frame of the target views. They include the constant
    /// delta: the change of the stored parameters since the start of refinement, which is the same at all frames. They
    /// do not include the time-varying delta.
    pub(super) fn positions(&self) -> AttributeValues {
        let Some(LinearizedState { state, .. }) = self.linearized.first() else { return AttributeValues::default() };
        let mut moved = Gaussians { position: state.position.clone(), ..Gaussians::default() };
        self.constant_optimizer.delta().add_to(&mut moved, Attributes::POSITION);
        moved.position
    }

    /// Sets the stored parameters to the parameters at the start of refinement plus `change`, and restarts the
    /// optimizer from there. `change` must be an earlier result of [`OptimizerState::change`] with the same Gaussians.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be written.
    pub(super) fn restart_from(&mut self, change: &ParamDelta) -> Result<()> {
        self.constant_optimizer.restart(&change.minus(&self.baked_delta));
        self.reevaluate_states()
    }

    /// Moves the delta of `constant_optimizer` to `self.baked_delta`: adds it there and resets it to 0 in the
    /// optimizer. If the model has a deformation field, also adds it to `self.stored`, the parameters from which the
    /// field computes the frame states.
    fn bake_delta(&mut self) {
        if !self.constant_optimizer.has_moved() {
            return;
        }
        let moved = self.constant_optimizer.take_delta();
        if self.deformation.is_some() {
            moved.add_to(&mut self.stored.gaussians, Attributes::all());
        }
        self.baked_delta = std::mem::take(&mut self.baked_delta).plus(moved);
    }

    /// Removes all Gaussians except those with the indices `places`. The remaining ones keep their current states.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read or written.
    pub(super) fn pick(&mut self, places: &[u32]) -> Result<()> {
        let mut linearized = LinearizedFramesWriter::new(&self.scene.scratch, self.varying)?;
        let mut now = std::mem::take(&mut self.now);
        for k in 0..self.frames.len() {
            self.compute_state(k, self.constant_optimizer.delta(), &mut now)?;
            linearized.push(&mut now.pick(places))?;
        }
        (self.linearized, self.now) = (linearized.finish()?, now);
        self.bake_delta();
        if self.deformation.is_some() {
            self.stored = self.stored.pick(places);
        }
        self.baked_delta = self.baked_delta.pick(places);
        self.changing = places.iter().map(|&frame_index| self.changing[frame_index as usize]).collect();
        self.fixed = places.iter().map(|&frame_index| self.fixed[frame_index as usize]).collect();
        self.start_optimizer();
        Ok(())
    }

    /// Returns the delta of `constant_optimizer` that renders show: rounded to the quantization grids, if there are
    /// any.
    fn rendered_delta(&self) -> Cow<'_, ParamDelta> {
        let delta = self.constant_optimizer.delta();
        match &self.rounding {
            Some(rounding) => Cow::Owned(rounding.rounded_delta(&self.baked_delta, delta)),
            None => Cow::Borrowed(delta),
        }
    }

    /// Computes into `now` the current state of the frame with index `k` in `self.frames`, including all changes that
    /// refinement has made so far. `change`: delta of `constant_optimizer`.
    fn compute_state(&self, k: usize, change: &ParamDelta, now: &mut LinearizedState) -> Result<()> {
        self.linearized.read_varying(k, now)?;
        self.add_deltas(k, change, now);
        Ok(())
    }

    /// Adds all changes that refinement has made so far to `now`, the state of the frame with index `k` in
    /// `self.frames` as [`LinearizedFrames::read_varying`] returns it. `change`: delta of `constant_optimizer`.
    fn add_deltas(&self, k: usize, change: &ParamDelta, now: &mut LinearizedState) {
        self.linearized.add_change(change, now);
        if !self.keyframe_optimizers.is_empty() {
            let deltas = self.keyframes_around(k).map(|(keyframe, weight)| {
                let change = self.keyframe_optimizers[keyframe].delta();
                let mut change = now.present.as_ref().map_or_else(|| change.clone(), |present| change.pick(present));
                change.scale(weight);
                change
            });
            deltas.iter().for_each(|change| change.add_to(&mut now.state, Attributes::all()));
        }
    }

    /// Returns the index in `self.frames` of the frame of target view `k`.
    fn frame_index(&self, k: usize) -> usize {
        self.step_files().frame_index(k)
    }

    /// Returns the scratch files of the optimization steps.
    fn step_files(&self) -> StepFiles<'_> {
        let OptimizerState { targets, strides, ref frames, ref linearized, .. } = *self;
        StepFiles { targets, strides, frames, linearized }
    }

    /// Makes one optimization step of the constant delta, on target view `k` with the learning rates of `schedule`.
    /// `next`: target view of the next step, whose data are then read during this step if there are several threads;
    /// `None` if something else uses this optimizer before the next step.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read or written.
    pub(super) fn step(&mut self, k: usize, next: Option<usize>, schedule: &RateSchedule) -> Result<()> {
        if self.steps == self.reevaluate_every {
            self.reevaluate_states()?;
        }
        self.steps += 1;
        // An evaluation of the states at the start of the next step would replace the data read for it.
        let is_reevaluated = self.deformation.is_some() && self.steps == self.reevaluate_every;
        self.differentiate(k, next.filter(|_| !is_reevaluated))?;
        self.constant_optimizer.step(&self.gradients, 1.0, schedule);
        Ok(())
    }

    /// Makes one optimization step of the time-varying delta, on target view `k` with the learning rates of `schedule`.
    /// `next`: as in [`OptimizerState::step`].
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read.
    pub(super) fn step_trajectory(&mut self, k: usize, next: Option<usize>, schedule: &RateSchedule) -> Result<()> {
        self.differentiate(k, next)?;
        // Attributes that do not vary with time in the input get no time-varying delta.
        for column in self.step_params.columns.iter() {
            let slopes = self.gradients.derivatives_mut(column);
            for c in 0..slopes.width() {
                for (slope, changing) in slopes.plane_mut(c).iter_mut().zip(&self.changing) {
                    *slope = if changing.contains(column) { *slope } else { 0.0 };
                }
            }
        }
        for (keyframe, weight) in self.keyframes_around(self.frame_index(k)) {
            self.keyframe_optimizers[keyframe].step(&self.gradients, weight, schedule);
        }
        Ok(())
    }

    /// Renders target view `k` and computes the derivatives of its loss with respect to the stored parameters into
    /// `self.gradients`. If there are several threads, reads the data of the step on view `next` meanwhile: parts of
    /// the render run on one thread only.
    fn differentiate(&mut self, k: usize, next: Option<usize>) -> Result<()> {
        let now = std::mem::take(&mut self.now);
        let (StepInput { target, frame: mut now, .. }, spare) = match self.prefetched.take() {
            Some(input) if input.view == k => (input, now),
            _ => (StepInput::read(self.step_files(), k, now)?, LinearizedState::default()),
        };
        self.add_deltas(self.frame_index(k), &self.rendered_delta(), &mut now);
        self.gradients.clear();
        let StepParams { columns, sh_degree, loss } = self.step_params;
        let mut sparse = now.present.as_ref().map(|present| Gradients::new(present.len(), columns, sh_degree));
        let OptimizerState { scene, targets, strides, ref frames, ref linearized, .. } = *self;
        let gradients = sparse.as_mut().unwrap_or(&mut self.gradients);
        let (is_guard, mean_square) = (targets.is_guard(k), &mut self.mean_square_gradient);
        // Also updates the running mean.
        let pull = |render: &_| {
            let mut gradient = loss.gradient(render, &target);
            limit_gradient(&mut gradient, is_guard, mean_square);
            (0.0, gradient)
        };
        let (renderer, view) = (&mut self.renderer, targets.view(k, strides));
        let next = next.filter(|_| rayon::current_num_threads() > 1);
        let files = StepFiles { targets, strides, frames, linearized };
        let ((), read) = rayon::join(
            || _ = renderer.gradient(&now.state, view, scene.background, pull, gradients),
            || next.map(|next| StepInput::read(files, next, spare)).transpose(),
        );
        now.jacobian.pull_back(gradients);
        if let Some((present, gradients)) = now.present.as_ref().zip(sparse) {
            self.gradients.set_rows(present, &gradients);
        }
        (self.now, self.prefetched) = (now, read?);
        Ok(())
    }

    /// Renders the validation or test views with the indices `views` and returns their mean quality.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read.
    pub(super) fn quality(&self, views: &[usize]) -> Result<RenderQuality> {
        self.quality_of(views, None)
    }

    /// Returns the mean quality of the validation or test views with the indices `views`, like
    /// [`OptimizerState::quality`], for renders of only the Gaussians with the indices `places`, increasing; `None`: of
    /// all Gaussians.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read.
    pub(super) fn quality_of(&self, views: &[usize], places: Option<&[u32]>) -> Result<RenderQuality> {
        let delta = self.rendered_delta();
        let errors = |(renderer, now): &mut (Renderer, LinearizedState), &k: &usize| {
            self.compute_state(self.frame_index(k), &delta, now)?;
            let (view, values) = (self.targets.view(k, self.strides), self.targets.values(k, self.strides)?);
            let picked = places.map(|places| now.pick(places));
            let state = picked.as_ref().map_or(&now.state, |picked| &picked.state);
            let image = renderer.render(state, view, self.scene.background);
            Ok(self.step_params.loss.errors(&image, &values))
        };
        let parts = views.par_iter().with_min_len(self.views_per_part(views.len()));
        let losses: Vec<[f64; 2]> = parts.map_init(|| self.new_worker(), errors).collect::<Result<_>>()?;
        Ok(RenderQuality::from_errors(&losses))
    }

    /// Returns the squared error that removing each Gaussian would cause, summed over the target views with the indices
    /// `views`. Guard views ([`Targets::is_guard`]) among them are left out. The square of `contrast_floor` is added to
    /// each squared color difference ([`RemovalError::contrast_floor`]).
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read.
    pub(super) fn removal_error(&mut self, views: &[usize], contrast_floor: f32) -> Result<RemovalError> {
        self.free_buffers();
        let views: Vec<usize> = views.iter().copied().filter(|&k| !self.targets.is_guard(k)).collect();
        let zero = || (self.new_worker(), RemovalError::new(self.fixed.len(), contrast_floor));
        let add_view = |((mut renderer, mut now), mut errors): ((Renderer, LinearizedState), RemovalError),
                        &k: &usize| {
            self.compute_state(self.frame_index(k), self.constant_optimizer.delta(), &mut now)?;
            let mut sparse = now.present.as_ref().map(|present| RemovalError::new(present.len(), contrast_floor));
            let found = sparse.as_mut().unwrap_or(&mut errors);
            let view = self.targets.view(k, self.strides);
            renderer.removal_error(&now.state, view, self.scene.background, found);
            if let Some((present, found)) = now.present.as_ref().zip(sparse) {
                errors.merge_rows(present, &found);
            }
            Ok::<_, Error>(((renderer, now), errors))
        };
        // The sums are integers, so the order of addition does not matter.
        let parts = views.par_iter().with_min_len(self.views_per_part(views.len()));
        let sums = parts.try_fold(zero, add_view).map(|found| Ok(found?.1));
        sums.try_reduce_with(|mut sum, other| {
            sum.merge(&other);
            Ok(sum)
        })
        .unwrap_or_else(|| Ok(zero().1))
    }

    /// Returns the minimum number of views that one thread processes, if `view_count` views are divided among threads.
    /// It keeps the number of renderers that work at the same time at or below [`Limits::views_together`].
    ///
    /// [`Limits::views_together`]: crate::limits::Limits::views_together
    fn views_per_part(&self, view_count: usize) -> usize {
        let renderers = self.scene.limits.views_together;
        if renderers < rayon::current_num_threads() { view_count.div_ceil(renderers) } else { 1 }
    }

    /// Creates a renderer and a frame state buffer, as each thread needs them.
    fn new_worker(&self) -> (Renderer, LinearizedState) {
        (Renderer::new(), LinearizedState::default())
    }
}
