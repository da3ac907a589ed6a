//! State of the optimization: the states of the survivors at the frames of the target views.

use rayon::prelude::*;
use serde::Serialize;

use super::local::{LinearizedFrames, LinearizedFramesWriter, LinearizedState};
use super::loss::{Loss, RenderQuality};
use super::targets::Targets;
use crate::compressed_model::{ParamDelta, TrajectoryDelta};
use crate::error::{Error, Result};
use crate::model::{Attributes, Gaussians, Gradients, SequenceInfo, StoredParams};
use crate::passes::States;
use crate::refinement::optimizer::{Adam, RateSchedule};
use crate::render::{RemovalError, Renderer};
use crate::scene::Scene;
use crate::source::{Deformation, FrameSource, ReadPlan};

/// Attributes and loss of the optimization.
#[derive(Debug, Clone, Copy)]
pub(super) struct StepParams {
    /// Attributes that are optimized.
    pub(super) columns: Attributes,
    /// Maximum SH degree that is optimized.
    pub(super) sh_degree: usize,
    /// Loss to be minimized.
    pub(super) loss: Loss,
}

/// Minimum number of frames per keyframe of a [`TrajectoryDelta`].
const FRAMES_PER_KEYFRAME: usize = 4;

/// Returns the number of keyframes of the time-varying delta of a sequence of `frames` frames, at most `most`; 0
/// instead of 1.
pub(super) fn keyframe_count(max_keyframes: usize, frames: usize) -> usize {
    let keyframe_count = max_keyframes.min(frames / FRAMES_PER_KEYFRAME);
    if keyframe_count > 1 { keyframe_count } else { 0 }
}

/// Number of steps after which states are reevaluated, if they depend on the stored parameters by more than a sum.
pub(super) const REEVALUATE_EVERY: usize = 200;

/// The survivors, their states at the frames of the target views, and the delta so far.
///
/// States that depend on the stored parameters by more than a sum, as with a deformation field, are reevaluated every
/// [`REEVALUATE_EVERY`] steps and extrapolated along their Jacobians in between. Evaluating a field and its derivative
/// at every step would take three times as long and gain nothing (method.md, section 6.2).
///
/// Memory: six states, [`Adam`], and a view with its gradient; in a scratch file one state per frame, of the
/// Gaussians present if they are few.
pub(super) struct OptimizerState<'a> {
    scene: &'a Scene,
    targets: &'a Targets,
    deformation: Option<&'a dyn Deformation>,
    /// Frames of the target views, increasing.
    frames: Vec<usize>,
    varying: Attributes,
    /// State of each of these frames before `descent` changed anything.
    linearized: LinearizedFrames,
    /// Stored parameters before `descent` changed anything, if states depend on them by more than a sum.
    stored: StoredParams,
    /// Delta that was added to the stored parameters before that.
    before: ParamDelta,
    fixed: Vec<bool>,
    /// Attributes and loss, limited to what the states have.
    step_params: StepParams,
    descent: Adam,
    /// One optimizer per keyframe of the time-varying delta; empty if there is none.
    course: Vec<Adam>,
    /// Attributes of each Gaussian that vary between frames; empty with a deformation field.
    changing: Vec<Attributes>,
    gradients: Gradients,
    /// Buffer for the state of the view being rendered.
    now: LinearizedState,
    renderer: Renderer,
    /// Number of steps since states were evaluated.
    steps: usize,
    /// Whether states were reevaluated since the last prune step, or since the beginning.
    reevaluated: bool,
}

/// Contents of a checkpoint: the stored parameters at the last reevaluation with the delta added by then (`None` if
/// there was no reevaluation since the phase began); the optimizer's delta, means and steps; the number of steps since
/// states were evaluated; and the same three values of the optimizer of each keyframe.
type OptimizerCheckpoint<Stored, Added, Means> =
    (Option<(Stored, Added)>, (Added, Means, usize), usize, Vec<(Added, Means, usize)>);

/// An [`OptimizerCheckpoint`] read back from the cache.
pub(super) type KeptCheckpoint = OptimizerCheckpoint<StoredParams, ParamDelta, [Gaussians; 2]>;

impl<'a> OptimizerState<'a> {
    /// Creates the state for the survivors in `result`, to be optimized with these parameters except for the Gaussians
    /// `fixed`.
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
        let mut frames: Vec<usize> = targets.pictures.iter().map(|picture| picture.frame).collect();
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
            before: ParamDelta::default(),
            descent: Adam::new(&empty, columns, sh_degree, &[]),
            course: Vec::new(),
            changing: vec![Attributes::empty(); fixed.len()],
            gradients: Gradients::new(0, columns, sh_degree),
            now: LinearizedState::none(state_degree),
            renderer: Renderer::on_all_threads(),
            steps: 0,
            reevaluated: false,
            frames,
            varying,
            fixed,
            step_params: StepParams { columns, sh_degree, loss },
        };
        if deformation.is_some() {
            optimizer.reevaluate_states()?;
        } else {
            let wanted = ReadPlan::new(optimizer.frames.clone()).holding(scene.limits.frames_held);
            let mut states = States::open(result, &wanted)?;
            let mut linearized = LinearizedFramesWriter::new(&scene.scratch, varying)?;
            for &frame in &optimizer.frames {
                let state = states.at(frame)?.clone();
                if let Some(LinearizedState { state: first, .. }) = linearized.first() {
                    for column in varying.iter() {
                        let (first, now) = (first.column(column), state.column(column));
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

    /// Starts the optimizer anew at the current states.
    fn start_optimizer(&mut self) {
        self.reevaluated = false;
        let Some(LinearizedState { state, .. }) = self.linearized.first() else { return };
        let StepParams { columns, sh_degree, .. } = self.step_params;
        self.descent = Adam::new(state, columns, sh_degree, &self.fixed);
        self.gradients = Gradients::new(state.len(), columns, sh_degree);
    }

    /// Starts optimizing a time-varying delta of 0 with `keyframe_count` keyframes. A Gaussian's delta varies only in
    /// attributes that vary in the input (others are stored once), and only in SH coefficients of degree 0. Returns
    /// whether there is anything to optimize.
    pub(super) fn enable_keyframes(&mut self, keyframe_count: usize) -> bool {
        let columns = self.step_params.columns & self.changing.iter().copied().collect();
        let Some(LinearizedState { state, .. }) = self.linearized.first().filter(|_| !columns.is_empty()) else {
            return false;
        };
        self.course = (0..keyframe_count).map(|_| Adam::new(state, columns, 0, &self.fixed)).collect();
        true
    }

    /// Returns the time-varying delta.
    pub(super) fn course(&self) -> TrajectoryDelta {
        TrajectoryDelta(self.course.iter().map(|knot| knot.change().clone()).collect())
    }

    /// Returns the keyframes around frame index `k`, with their weights.
    fn keyframes_around(&self, k: usize) -> [(usize, f32); 2] {
        TrajectoryDelta::weights(self.course.len(), self.frames[k], self.scene.source().info().times.len())
    }

    /// Returns which Gaussians are not optimized.
    pub(super) fn fixed(&self) -> &[bool] {
        &self.fixed
    }

    /// Returns the delta of the stored parameters that is constant in time.
    pub(super) fn change(&self) -> ParamDelta {
        let before = self.before.clone();
        if self.descent.has_moved() { before.and(self.descent.change().clone()) } else { before }
    }

    /// Reevaluates the states if they depend on the stored parameters by more than a sum.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be written.
    pub(super) fn reevaluate_states(&mut self) -> Result<()> {
        let Some(deformation) = self.deformation else { return Ok(()) };
        self.bake_delta();
        let mut linearized = LinearizedFramesWriter::new(&self.scene.scratch, self.varying)?;
        for &frame in &self.frames {
            let want = if linearized.is_empty() { Attributes::all() } else { self.varying };
            self.now.present = None;
            deformation.state(frame, &self.stored, want, &mut self.now.state)?;
            self.now.jacobian = deformation.jacobian(frame, &self.stored, self.step_params.columns)?;
            linearized.push(&mut self.now)?;
        }
        self.linearized = linearized.finish()?;
        (self.steps, self.reevaluated) = (0, true);
        Ok(())
    }

    /// Returns the state that a checkpoint stores and [`OptimizerState::resume`] resumes from.
    pub(super) fn checkpoint(&self) -> impl Serialize + '_ {
        let reevaluated = self.reevaluated.then_some((&self.stored, &self.before));
        let course = self.course.iter().map(Adam::checkpoint).collect();
        let checkpoint: OptimizerCheckpoint<&StoredParams, &ParamDelta, &[Gaussians; 2]> =
            (reevaluated, self.descent.checkpoint(), self.steps, course);
        checkpoint
    }

    /// Resumes from the checkpoint of another optimization that started equally and removed the same Gaussians.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be written.
    pub(super) fn resume(&mut self, (reevaluated, descent, steps, course): KeptCheckpoint) -> Result<()> {
        if let Some((stored, before)) = reevaluated {
            self.descent.take();
            (self.stored, self.before) = (stored, before);
            self.reevaluate_states()?;
        }
        self.descent.resume(descent);
        self.steps = steps;
        if !course.is_empty() {
            self.enable_keyframes(course.len());
            self.course.iter_mut().zip(course).for_each(|(knot, checkpoint)| knot.resume(checkpoint));
        }
        Ok(())
    }

    /// Restarts the optimizer from `change`, a [`OptimizerState::change`] since the last prune step.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be written.
    pub(super) fn restart_from(&mut self, change: &ParamDelta) -> Result<()> {
        self.descent.restart(&change.since(&self.before));
        self.reevaluate_states()
    }

    /// Adds the optimizer's delta to the stored parameters, and resets it to 0.
    fn bake_delta(&mut self) {
        if !self.descent.has_moved() {
            return;
        }
        let moved = self.descent.take();
        if self.deformation.is_some() {
            moved.add_to(&mut self.stored.gaussians, Attributes::all());
        }
        self.before = std::mem::take(&mut self.before).and(moved);
    }

    /// Keeps only the Gaussians at `places`, with their current states.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read or written.
    pub(super) fn pick(&mut self, places: &[u32]) -> Result<()> {
        let mut linearized = LinearizedFramesWriter::new(&self.scene.scratch, self.varying)?;
        let mut now = std::mem::take(&mut self.now);
        for k in 0..self.frames.len() {
            self.show(k, &mut now)?;
            linearized.push(&mut now.pick(places))?;
        }
        (self.linearized, self.now) = (linearized.finish()?, now);
        self.bake_delta();
        if self.deformation.is_some() {
            self.stored = self.stored.pick(places);
        }
        self.before = self.before.pick(places);
        self.changing = places.iter().map(|&frame_index| self.changing[frame_index as usize]).collect();
        self.fixed = places.iter().map(|&frame_index| self.fixed[frame_index as usize]).collect();
        self.start_optimizer();
        Ok(())
    }

    /// Computes the current state at frame index `k` into `now`.
    fn show(&self, k: usize, now: &mut LinearizedState) -> Result<()> {
        self.linearized.read(k, now)?;
        let change = self.descent.change();
        match &now.present {
            None => now.jacobian.add_to(&change.0, &mut now.state),
            Some(present) => now.jacobian.add_to(&change.pick(present).0, &mut now.state),
        }
        if !self.course.is_empty() {
            let deltas = self.keyframes_around(k).map(|(knot, weight)| {
                let change = self.course[knot].change();
                let mut change = now.present.as_ref().map_or_else(|| change.clone(), |present| change.pick(present));
                change.scale(weight);
                change
            });
            deltas.iter().for_each(|change| change.add_to(&mut now.state, Attributes::all()));
        }
        Ok(())
    }

    /// Returns the frame index of view `k`.
    fn frame_index(&self, k: usize) -> usize {
        self.frames.binary_search(&self.targets.pictures[k].frame).unwrap_or_default()
    }

    /// Makes one optimization step on view `k`, with the learning rates of `schedule`.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read or written.
    pub(super) fn step(&mut self, k: usize, schedule: &RateSchedule) -> Result<()> {
        if self.steps == REEVALUATE_EVERY {
            self.reevaluate_states()?;
        }
        self.steps += 1;
        self.differentiate(k)?;
        self.descent.step(&self.gradients, 1.0, schedule);
        Ok(())
    }

    /// Makes one optimization step of the time-varying delta on view `k`, with the learning rates of `schedule`.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read.
    pub(super) fn step_along(&mut self, k: usize, schedule: &RateSchedule) -> Result<()> {
        self.differentiate(k)?;
        // Attributes that do not vary in the input get no delta.
        for column in self.step_params.columns.iter() {
            let slopes = self.gradients.column_mut(column);
            for c in 0..slopes.width() {
                for (slope, changing) in slopes.plane_mut(c).iter_mut().zip(&self.changing) {
                    *slope = if changing.contains(column) { *slope } else { 0.0 };
                }
            }
        }
        for (knot, weight) in self.keyframes_around(self.frame_index(k)) {
            self.course[knot].step(&self.gradients, weight, schedule);
        }
        Ok(())
    }

    /// Computes the gradients of view `k`.
    fn differentiate(&mut self, k: usize) -> Result<()> {
        let target = self.targets.values(k)?;
        let mut now = std::mem::take(&mut self.now);
        self.show(self.frame_index(k), &mut now)?;
        self.gradients.clear();
        let StepParams { columns, sh_degree, loss } = self.step_params;
        let mut sparse = now.present.as_ref().map(|present| Gradients::new(present.len(), columns, sh_degree));
        let gradients = sparse.as_mut().unwrap_or(&mut self.gradients);
        let pull = |picture: &_| (0.0, loss.slope(picture, &target));
        self.renderer.gradient(&now.state, self.targets.camera(k), self.scene.background, pull, gradients);
        now.jacobian.pull_back(gradients);
        if let Some((present, gradients)) = now.present.as_ref().zip(sparse) {
            self.gradients.set_rows(present, &gradients);
        }
        self.now = now;
        Ok(())
    }

    /// Returns the quality of the views `views` against their targets.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read.
    pub(super) fn quality(&self, views: &[usize]) -> Result<RenderQuality> {
        let errors = |(renderer, now): &mut (Renderer, LinearizedState), &k: &usize| {
            self.show(self.frame_index(k), now)?;
            let picture = renderer.render(&now.state, self.targets.camera(k), self.scene.background);
            Ok(self.step_params.loss.errors(&picture, &self.targets.values(k)?))
        };
        let losses: Vec<[f64; 2]> = views.par_iter().map_init(|| self.new_worker(), errors).collect::<Result<_>>()?;
        Ok(RenderQuality::from_errors(&losses))
    }

    /// Returns the removal error of each Gaussian, summed over the views `views`.
    ///
    /// # Errors
    /// Fails if a scratch file cannot be read.
    pub(super) fn removal_error(&self, views: &[usize], contrast_floor: f32) -> Result<RemovalError> {
        let zero = || (self.new_worker(), RemovalError::new(self.fixed.len(), contrast_floor));
        let add_view = |((mut renderer, mut now), mut errors): ((Renderer, LinearizedState), RemovalError),
                        &k: &usize| {
            self.show(self.frame_index(k), &mut now)?;
            let mut sparse = now.present.as_ref().map(|present| RemovalError::new(present.len(), contrast_floor));
            let found = sparse.as_mut().unwrap_or(&mut errors);
            renderer.removal_error(&now.state, self.targets.camera(k), self.scene.background, found);
            if let Some((present, found)) = now.present.as_ref().zip(sparse) {
                errors.merge_rows(present, &found);
            }
            Ok::<_, Error>(((renderer, now), errors))
        };
        // The sums are integers, so the order of addition does not matter.
        let sums = views.par_iter().try_fold(zero, add_view).map(|found| Ok(found?.1));
        sums.try_reduce_with(|mut sum, other| {
            sum.merge(&other);
            Ok(sum)
        })
        .unwrap_or_else(|| Ok(zero().1))
    }

    /// Creates the renderer and state buffer of one thread.
    fn new_worker(&self) -> (Renderer, LinearizedState) {
        (Renderer::new(), LinearizedState::default())
    }
}
