//! What is left, on the move: the states that its pictures show.

use rayon::prelude::*;
use serde::Serialize;

use super::local::{Keeping, Local, Locals};
use super::loss::{Loss, RenderQuality};
use super::targets::Targets;
use crate::compressed_model::{ParamDelta, TrajectoryDelta};
use crate::error::{Error, Result};
use crate::model::{Columns, Gaussians, Gradients, Raw, SequenceInfo};
use crate::passes::States;
use crate::refinement::optimizer::{Descent, RateSchedule};
use crate::render::{RemovalError, Renderer};
use crate::scene::Scene;
use crate::source::{Deformation, FrameSource, ReadPlan};

/// How what is left moves.
#[derive(Debug, Clone, Copy)]
pub(super) struct StepParams {
    /// What moves.
    pub(super) columns: Columns,
    /// Up to which harmonics.
    pub(super) sh_degree: usize,
    /// What is made small.
    pub(super) loss: Loss,
}

/// A knot of a [`TrajectoryDelta`] for every so many frames, at most.
const FRAMES_PER_KNOT: usize = 4;

/// How many knots the course of a sequence of `frames` frames has, of at most `most`; none where there would be one.
pub(super) fn knots(most: usize, frames: usize) -> usize {
    let knots = most.min(frames / FRAMES_PER_KNOT);
    if knots > 1 { knots } else { 0 }
}

/// Steps after which states are found anew, where they follow from what is stored by more than a sum.
pub(super) const FOUND_EVERY: usize = 200;

/// What is left, its states at the frames that are shown, and how far it moved.
///
/// Where states follow from what is stored by more than a sum they are found every [`FOUND_EVERY`] steps, and move along
/// their Jacobians in between: a field and its derivative at every step take a third of the time and gain nothing
/// (method.md, section 6.2).
///
/// Memory: six states, [`Descent`], and a differentiated picture; on a scratch file a state for every frame shown, of those
/// that are there if they are few.
pub(super) struct OptimizerState<'a> {
    scene: &'a Scene,
    targets: &'a Targets,
    deformation: Option<&'a dyn Deformation>,
    /// Increasing.
    frames: Vec<usize>,
    varying: Columns,
    /// What is at each of them, before `descent` moved anything.
    locals: Locals,
    /// What is stored, before `descent` moved anything, where states follow from it by more than a sum.
    stored: Raw,
    /// What was added to what is stored before that.
    before: ParamDelta,
    fixed: Vec<bool>,
    /// Of what the states have.
    manner: StepParams,
    descent: Descent,
    /// The knots of the course along time, if there is one.
    course: Vec<Descent>,
    /// Columns of each Gaussian that are not the same at all frames, where they do not follow from anything.
    changing: Vec<Columns>,
    gradients: Gradients,
    /// What the picture in the making shows.
    now: Local,
    renderer: Renderer,
    /// Steps since states were found.
    steps: usize,
    /// Whether that was since some were let go of last, or since the beginning.
    found: bool,
}

/// What states follow from: what was stored when they were found last and what had been added by then, none as long as
/// that is what a leg began with; what the descent added, with its means and steps; the steps since states were found; and
/// what each knot of the course added.
type OptimizerCheckpoint<Stored, Added, Means> =
    (Option<(Stored, Added)>, (Added, Means, usize), usize, Vec<(Added, Means, usize)>);

/// A [`OptimizerCheckpoint`] that was kept.
pub(super) type KeptCheckpoint = OptimizerCheckpoint<Raw, ParamDelta, [Gaussians; 2]>;

impl<'a> OptimizerState<'a> {
    /// What `result` shows of `targets`, to move in that manner but for those `fixed`.
    ///
    /// # Errors
    /// Frames that cannot be read; a scratch file that cannot be written.
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
        let SequenceInfo { varying, sh_degree: of_state, .. } = *result.info();
        let sh_degree = sh_degree.min(of_state);
        let columns = columns & deformation.map_or(Columns::all(), Deformation::movable);
        let nothing = Gaussians::zeros(0, of_state);
        let mut moving = OptimizerState {
            scene,
            targets,
            deformation,
            locals: Keeping::new(&scene.scratch, varying)?.finish()?,
            stored: deformation.map_or_else(|| nothing.clone().into(), |deformation| deformation.stored().clone()),
            before: ParamDelta::default(),
            descent: Descent::new(&nothing, columns, sh_degree, &[]),
            course: Vec::new(),
            changing: vec![Columns::empty(); fixed.len()],
            gradients: Gradients::new(0, columns, sh_degree),
            now: Local::none(of_state),
            renderer: Renderer::on_all_threads(),
            steps: 0,
            found: false,
            frames,
            varying,
            fixed,
            manner: StepParams { columns, sh_degree, loss },
        };
        if deformation.is_some() {
            moving.reevaluate_states()?;
        } else {
            let wanted = ReadPlan::new(moving.frames.clone()).holding(scene.limits.frames_held);
            let mut states = States::open(result, &wanted)?;
            let mut locals = Keeping::new(&scene.scratch, varying)?;
            for &frame in &moving.frames {
                let state = states.at(frame)?.clone();
                if let Some(Local { state: first, .. }) = locals.first() {
                    for column in varying.iter() {
                        let (first, now) = (first.column(column), state.column(column));
                        for c in 0..now.width() {
                            let values = first.plane(c).iter().zip(now.plane(c));
                            for (changing, (first, now)) in moving.changing.iter_mut().zip(values) {
                                changing.set(column, changing.contains(column) || first != now);
                            }
                        }
                    }
                }
                locals.push(&mut Local { state, ..Local::default() })?;
            }
            moving.locals = locals.finish()?;
        }
        moving.begin();
        Ok(moving)
    }

    /// Begins to descend from here.
    fn begin(&mut self) {
        self.found = false;
        let Some(Local { state, .. }) = self.locals.first() else { return };
        let StepParams { columns, sh_degree, .. } = self.manner;
        self.descent = Descent::new(state, columns, sh_degree, &self.fixed);
        self.gradients = Gradients::new(state.len(), columns, sh_degree);
    }

    /// Begins to move along time too, from nothing, at so many knots: each Gaussian in columns that change with time anyway, as
    /// others are stored once, and of harmonics the first. Gives whether anything can.
    pub(super) fn enable_keyframes(&mut self, knots: usize) -> bool {
        let columns = self.manner.columns & self.changing.iter().copied().collect();
        let Some(Local { state, .. }) = self.locals.first().filter(|_| !columns.is_empty()) else { return false };
        self.course = (0..knots).map(|_| Descent::new(state, columns, 0, &self.fixed)).collect();
        true
    }

    /// What is to be added along time.
    pub(super) fn course(&self) -> TrajectoryDelta {
        TrajectoryDelta(self.course.iter().map(|knot| knot.change().clone()).collect())
    }

    /// The knots that tell of the frame in place `k`, with their weights.
    fn around(&self, k: usize) -> [(usize, f32); 2] {
        TrajectoryDelta::weights(self.course.len(), self.frames[k], self.scene.source().info().times.len())
    }

    /// Which Gaussians stay as they are.
    pub(super) fn fixed(&self) -> &[bool] {
        &self.fixed
    }

    /// What is to be added to what is stored.
    pub(super) fn change(&self) -> ParamDelta {
        let before = self.before.clone();
        if self.descent.has_moved() { before.and(self.descent.change().clone()) } else { before }
    }

    /// Finds states anew, where they follow from what is stored by more than a sum.
    ///
    /// # Errors
    /// A scratch file that cannot be written.
    pub(super) fn reevaluate_states(&mut self) -> Result<()> {
        let Some(deformation) = self.deformation else { return Ok(()) };
        self.bake_delta();
        let mut locals = Keeping::new(&self.scene.scratch, self.varying)?;
        for &frame in &self.frames {
            let want = if locals.is_empty() { Columns::all() } else { self.varying };
            self.now.there = None;
            deformation.state(frame, &self.stored, want, &mut self.now.state)?;
            self.now.jacobian = deformation.jacobian(frame, &self.stored, self.manner.columns)?;
            locals.push(&mut self.now)?;
        }
        self.locals = locals.finish()?;
        (self.steps, self.found) = (0, true);
        Ok(())
    }

    /// Returns the state that a checkpoint stores and [`OptimizerState::go_on`] resumes from.
    pub(super) fn standing(&self) -> impl Serialize + '_ {
        let found = self.found.then_some((&self.stored, &self.before));
        let course = self.course.iter().map(Descent::standing).collect();
        let standing: OptimizerCheckpoint<&Raw, &ParamDelta, &[Gaussians; 2]> =
            (found, self.descent.standing(), self.steps, course);
        standing
    }

    /// Goes on from where another was that had begun as this one did, and had let go of the same.
    ///
    /// # Errors
    /// A scratch file that cannot be written.
    pub(super) fn go_on(&mut self, (found, descent, steps, course): KeptCheckpoint) -> Result<()> {
        if let Some((stored, before)) = found {
            self.descent.take();
            (self.stored, self.before) = (stored, before);
            self.reevaluate_states()?;
        }
        self.descent.go_on(descent);
        self.steps = steps;
        if !course.is_empty() {
            self.enable_keyframes(course.len());
            self.course.iter_mut().zip(course).for_each(|(knot, standing)| knot.go_on(standing));
        }
        Ok(())
    }

    /// Begins anew from where `change` led, a [`OptimizerState::change`] since the last cut.
    ///
    /// # Errors
    /// A scratch file that cannot be written.
    pub(super) fn turn_back(&mut self, change: &ParamDelta) -> Result<()> {
        self.descent.restart(&change.since(&self.before));
        self.reevaluate_states()
    }

    /// What was descended so far counts as what is stored.
    fn bake_delta(&mut self) {
        if !self.descent.has_moved() {
            return;
        }
        let moved = self.descent.take();
        if self.deformation.is_some() {
            moved.add_to(&mut self.stored.gaussians, Columns::all());
        }
        self.before = std::mem::take(&mut self.before).and(moved);
    }

    /// Goes on with those at `places` alone, from where they are.
    ///
    /// # Errors
    /// A scratch file that cannot be read or written.
    pub(super) fn pick(&mut self, places: &[u32]) -> Result<()> {
        let mut locals = Keeping::new(&self.scene.scratch, self.varying)?;
        let mut now = std::mem::take(&mut self.now);
        for k in 0..self.frames.len() {
            self.show(k, &mut now)?;
            locals.push(&mut now.pick(places))?;
        }
        (self.locals, self.now) = (locals.finish()?, now);
        self.bake_delta();
        if self.deformation.is_some() {
            self.stored = self.stored.pick(places);
        }
        self.before = self.before.pick(places);
        self.changing = places.iter().map(|&place| self.changing[place as usize]).collect();
        self.fixed = places.iter().map(|&place| self.fixed[place as usize]).collect();
        self.begin();
        Ok(())
    }

    /// Makes `now` what is at the frame in place `k` by now.
    fn show(&self, k: usize, now: &mut Local) -> Result<()> {
        self.locals.read(k, now)?;
        let change = self.descent.change();
        match &now.there {
            None => now.jacobian.add_to(&change.0, &mut now.state),
            Some(there) => now.jacobian.add_to(&change.pick(there).0, &mut now.state),
        }
        if !self.course.is_empty() {
            let knots = self.around(k).map(|(knot, weight)| {
                let change = self.course[knot].change();
                let mut change = now.there.as_ref().map_or_else(|| change.clone(), |there| change.pick(there));
                change.scale(weight);
                change
            });
            knots.iter().for_each(|change| change.add_to(&mut now.state, Columns::all()));
        }
        Ok(())
    }

    /// The place of the frame of picture `k`.
    fn place(&self, k: usize) -> usize {
        self.frames.binary_search(&self.targets.pictures[k].frame).unwrap_or_default()
    }

    /// One step along picture `k`, at rates `schedule`.
    ///
    /// # Errors
    /// A scratch file that cannot be read or written.
    pub(super) fn step(&mut self, k: usize, schedule: &RateSchedule) -> Result<()> {
        if self.steps == FOUND_EVERY {
            self.reevaluate_states()?;
        }
        self.steps += 1;
        self.differentiate(k)?;
        self.descent.step(&self.gradients, 1.0, schedule);
        Ok(())
    }

    /// One step of the course along picture `k`, at rates `schedule`.
    ///
    /// # Errors
    /// A scratch file that cannot be read.
    pub(super) fn step_along(&mut self, k: usize, schedule: &RateSchedule) -> Result<()> {
        self.differentiate(k)?;
        // What does not change with time goes nowhere.
        for column in self.manner.columns.iter() {
            let slopes = self.gradients.column_mut(column);
            for c in 0..slopes.width() {
                for (slope, changing) in slopes.plane_mut(c).iter_mut().zip(&self.changing) {
                    *slope = if changing.contains(column) { *slope } else { 0.0 };
                }
            }
        }
        for (knot, weight) in self.around(self.place(k)) {
            self.course[knot].step(&self.gradients, weight, schedule);
        }
        Ok(())
    }

    /// Makes the gradients those of picture `k`.
    fn differentiate(&mut self, k: usize) -> Result<()> {
        let target = self.targets.values(k)?;
        let mut now = std::mem::take(&mut self.now);
        self.show(self.place(k), &mut now)?;
        self.gradients.clear();
        let StepParams { columns, sh_degree, loss } = self.manner;
        let mut of_those = now.there.as_ref().map(|there| Gradients::new(there.len(), columns, sh_degree));
        let gradients = of_those.as_mut().unwrap_or(&mut self.gradients);
        let pull = |picture: &_| (0.0, loss.slope(picture, &target));
        self.renderer.gradient(&now.state, self.targets.camera(k), self.scene.background, pull, gradients);
        now.jacobian.pull_back(gradients);
        if let Some((there, gradients)) = now.there.as_ref().zip(of_those) {
            self.gradients.set_rows(there, &gradients);
        }
        self.now = now;
        Ok(())
    }

    /// How close the pictures numbered `of` are.
    ///
    /// # Errors
    /// A scratch file that cannot be read.
    pub(super) fn closeness(&self, of: &[usize]) -> Result<RenderQuality> {
        let lost = |(renderer, now): &mut (Renderer, Local), &k: &usize| {
            self.show(self.place(k), now)?;
            let picture = renderer.render(&now.state, self.targets.camera(k), self.scene.background);
            Ok(self.manner.loss.errors(&picture, &self.targets.values(k)?))
        };
        let losses: Vec<[f64; 2]> = of.par_iter().map_init(|| self.worker(), lost).collect::<Result<_>>()?;
        Ok(RenderQuality::from_errors(&losses))
    }

    /// What the pictures numbered `of` would lose with each.
    ///
    /// # Errors
    /// A scratch file that cannot be read.
    pub(super) fn removal_error(&self, of: &[usize], contrast_floor: f32) -> Result<RemovalError> {
        let none = || (self.worker(), RemovalError::new(self.fixed.len(), contrast_floor));
        let of_picture = |((mut renderer, mut now), mut errors): ((Renderer, Local), RemovalError), &k: &usize| {
            self.show(self.place(k), &mut now)?;
            let mut of_those = now.there.as_ref().map(|there| RemovalError::new(there.len(), contrast_floor));
            let found = of_those.as_mut().unwrap_or(&mut errors);
            renderer.removal_error(&now.state, self.targets.camera(k), self.scene.background, found);
            if let Some((there, found)) = now.there.as_ref().zip(of_those) {
                errors.merge_rows(there, &found);
            }
            Ok::<_, Error>(((renderer, now), errors))
        };
        // Sums of integers: the order does not show.
        let sums = of.par_iter().try_fold(none, of_picture).map(|found| Ok(found?.1));
        sums.try_reduce_with(|mut sum, other| {
            sum.merge(&other);
            Ok(sum)
        })
        .unwrap_or_else(|| Ok(none().1))
    }

    /// What one thread makes its pictures with.
    fn worker(&self) -> (Renderer, Local) {
        (Renderer::new(), Local::default())
    }
}
