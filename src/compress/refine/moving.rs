//! What is left, on the move: the states that its pictures show.

use rayon::prelude::*;

use super::targets::{Targets, mean_square, slope};
use crate::emit::atomic::Spill;
use crate::error::{Error, Result};
use crate::metrics::decibels;
use crate::model::{Columns, Gaussians, Gradients};
use crate::refine::{Descent, Schedule};
use crate::render::{RemovalError, Renderer};
use crate::scene::Scene;
use crate::source::{Deformation, FrameSource, Wanted};
use crate::stream::States;

/// How close pictures are to the original's.
#[derive(Debug, Clone, Copy)]
pub(super) struct Closeness {
    /// Mean, dB.
    pub(super) psnr: f64,
    /// Root of the mean square error of all.
    pub(super) error: f64,
}

/// What is left, the states in which pictures show it before anything moved, and how far it moved.
///
/// Memory: three states, [`Descent`], and a differentiated picture; on a scratch file a state for every frame shown.
pub(super) struct Moving<'a> {
    targets: &'a Targets,
    background: [f32; 3],
    deformation: Option<&'a dyn Deformation>,
    /// Of every frame that is shown the columns that vary.
    states: Spill,
    frames: Vec<usize>,
    varying: Columns,
    /// The state at the first frame that is shown: the other columns.
    still: Gaussians,
    pub(super) descent: Descent,
    /// What is stored, where states follow from it by more than a sum; moved in columns that are asked for.
    stored: Gaussians,
    gradients: Gradients,
    /// The state of the picture in the making.
    now: Gaussians,
    renderer: Renderer,
}

impl<'a> Moving<'a> {
    /// What `result` shows of `targets`; `columns` of it may move but for those `fixed`.
    ///
    /// # Errors
    /// Frames that cannot be read; a scratch file that cannot be written.
    pub(super) fn new(
        scene: &Scene,
        result: &'a dyn FrameSource,
        targets: &'a Targets,
        columns: Columns,
        fixed: &[bool],
    ) -> Result<Moving<'a>> {
        let mut frames: Vec<usize> = targets.pictures.iter().map(|picture| picture.frame).collect();
        frames.dedup();
        let deformation = result.deformation();
        let varying = result.info().varying;
        let mut of_result = States::open(result, &Wanted::of(frames.clone()).holding(scene.limits.frames_held))?;
        let (mut states, mut still) = (Spill::new(&scene.scratch)?, None);
        for &frame in &frames {
            let state = of_result.at(frame)?;
            varying.iter().try_for_each(|column| states.write(bytemuck::cast_slice(state.column(column).planes())))?;
            still.get_or_insert_with(|| state.clone());
        }
        states.finish()?;
        let still = still.unwrap_or_default();
        let columns = columns & deformation.map_or(Columns::all(), Deformation::movable);
        let stored = deformation.map_or(Gaussians::default(), |deformation| deformation.stored().clone());
        Ok(Moving {
            targets,
            background: scene.background,
            deformation,
            states,
            frames,
            varying,
            descent: Descent::new(&still, columns, fixed),
            stored,
            gradients: Gradients::new(still.len(), columns, scene.source().info().sh_degree),
            now: still.clone(),
            still,
            renderer: Renderer::on_all_threads(),
        })
    }

    /// Makes `now` the state that picture `k` shows. What follows from what is stored by more than a sum is found anew
    /// as far as one of `anew`.
    fn state(&self, k: usize, anew: Columns, now: &mut Gaussians) -> Result<()> {
        let frame = self.targets.pictures[k].frame;
        let place = self.frames.binary_search(&frame).unwrap_or_default() as u64;
        let bytes = |column: Columns| 4 * self.still.column(column).planes().len() as u64;
        let mut at = place * self.varying.iter().map(bytes).sum::<u64>();
        for column in Columns::all().iter() {
            let is_anew = anew.contains(column);
            let to = now.column_mut(column);
            to.resize(self.still.len());
            if self.varying.contains(column) {
                if !is_anew {
                    self.states.read(at, bytemuck::cast_slice_mut(to.planes_mut()))?;
                }
                at += bytes(column);
            } else if !is_anew {
                to.planes_mut().copy_from_slice(self.still.column(column).planes());
            }
        }
        self.descent.change().add_to(now, Columns::all().difference(anew));
        match self.deformation {
            Some(deformation) if !anew.is_empty() => deformation.state(frame, &self.stored, anew, now),
            _ => Ok(()),
        }
    }

    /// Columns that are found anew at every step.
    fn bound(&self) -> Columns {
        self.deformation.map_or(Columns::empty(), Deformation::bound)
    }

    /// Moves the columns `columns` of what is stored, as far as states follow from it by more than a sum.
    fn follow(&mut self, columns: Columns) {
        let Some(deformation) = self.deformation else { return };
        for column in columns.iter() {
            let from = deformation.stored().column(column).planes();
            self.stored.column_mut(column).planes_mut().copy_from_slice(from);
        }
        self.descent.change().add_to(&mut self.stored, columns);
    }

    /// One step along picture `k`, at rates `schedule`.
    ///
    /// # Errors
    /// A scratch file that cannot be read.
    pub(super) fn step(&mut self, k: usize, schedule: &Schedule) -> Result<()> {
        let target = self.targets.values(k)?;
        self.follow(self.bound());
        let mut now = std::mem::take(&mut self.now);
        self.state(k, self.bound(), &mut now)?;
        self.now = now;
        self.gradients.clear();
        let (camera, frame) = (self.targets.camera(k), self.targets.pictures[k].frame);
        let pull = |picture: &_| (0.0, slope(picture, &target));
        self.renderer.gradient(&self.now, camera, self.background, pull, &mut self.gradients);
        if let Some(deformation) = self.deformation {
            deformation.pull_back(frame, &self.stored, &mut self.gradients)?;
        }
        self.descent.step(&self.gradients, schedule);
        Ok(())
    }

    /// How close the pictures numbered `of` are.
    ///
    /// # Errors
    /// A scratch file that cannot be read.
    pub(super) fn closeness(&mut self, of: &[usize]) -> Result<Closeness> {
        self.follow(Columns::all());
        let anew = if self.deformation.is_some() { self.varying | self.bound() } else { Columns::empty() };
        let square = |(renderer, state): &mut (Renderer, Gaussians), &k: &usize| {
            self.state(k, anew, state)?;
            let picture = renderer.render(state, self.targets.camera(k), self.background);
            Ok(mean_square(&picture, &self.targets.values(k)?))
        };
        let squares: Vec<f64> = of.par_iter().map_init(|| self.worker(), square).collect::<Result<_>>()?;
        let count = squares.len().max(1) as f64;
        let psnr = squares.iter().map(|&square| decibels(square)).sum::<f64>() / count;
        Ok(Closeness { psnr, error: (squares.iter().sum::<f64>() / count).sqrt() })
    }

    /// What the pictures numbered `of` would lose with each.
    ///
    /// # Errors
    /// A scratch file that cannot be read.
    pub(super) fn removal_error(&mut self, of: &[usize], contrast_floor: f32) -> Result<RemovalError> {
        self.follow(self.bound());
        let none = || (self.worker(), RemovalError::new(self.still.len(), contrast_floor));
        let of_picture = |((mut renderer, mut state), mut errors): ((Renderer, Gaussians), RemovalError),
                          &k: &usize| {
            self.state(k, self.bound(), &mut state)?;
            renderer.removal_error(&state, self.targets.camera(k), self.background, &mut errors);
            Ok::<_, Error>(((renderer, state), errors))
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
    fn worker(&self) -> (Renderer, Gaussians) {
        (Renderer::new(), Gaussians::zeros(0, self.still.sh_degree()))
    }
}
