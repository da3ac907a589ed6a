//! Stage `refit`: recolouring what is left by least squares on some scoring pictures, put to the test on others.
//!
//! Memory: [`Refit`](crate::refit::Refit), the pictures of the test and of one frame, and the states of original and
//! result at one frame.

use super::journal::Journal;
use super::score::{Scored, scored};
use crate::budget::{LOOK, Need, RENDER, Workload};
use crate::error::Result;
use crate::limits::Limits;
use crate::metrics::psnr;
use crate::model::{Camera, Column, Columns, Gaussians, Picture, SH_C0};
use crate::recipe;
use crate::reduction::{Change, Reduction};
use crate::refit::{self, Refit as Equations};
use crate::render::{self, Image, render};
use crate::scene::Scene;
use crate::source::FrameSource;
use crate::stream::{Batch, Progress, Subject, View, show, spread};

/// What the stage is called.
const NAME: &str = "refit";

/// Iterations: not tuned (method.md, section 6.2).
const ITERATIONS: usize = 10;
/// Of the pictures looked at every fourth is kept for the test.
const TEST_EVERY: usize = 4;

/// The refit of a run.
#[derive(Debug, Clone)]
pub struct Refit {
    /// Pictures that colours are fitted to.
    pub pictures: usize,
    /// Weight of the colours there were.
    pub ridge: f64,
}

/// A picture that the colours are not fitted to.
struct Test {
    picture: Picture,
    original: Image,
}

impl Refit {
    /// The stage, unless `recipe` asks for no pictures.
    pub fn of(recipe: &recipe::Refit) -> Option<Refit> {
        let pictures = recipe.refit_pictures as usize;
        (pictures > 0).then_some(Refit { pictures, ridge: recipe.refit_ridge })
    }

    /// Two states of a frame, the equations, and the pictures fitted to.
    pub fn need(&self, work: &Workload, limits: &Limits) -> Need {
        // Of a stream nobody knows how many pictures there will be.
        let most = if work.frames == 0 { 1 << 16 } else { work.pictures };
        let fitted = (self.pictures as u64).min(most);
        let tests = fitted.div_ceil(3);
        let operators = fitted.min(limits.operators_together as u64);
        let at_once = work.threads.min(limits.pictures_together as u64);
        // Those whose footprints are not kept are looked at in every iteration.
        let again = if operators < fitted { ITERATIONS as f64 + 1.0 } else { 0.0 };
        let per_gaussian = vec![
            ("kept", 24),
            ("states", 2 * work.state(Columns::all())),
            ("result", work.input.reduced),
            ("readers", 2 * work.input.reader),
            ("held", 2 * work.held(limits, Columns::all())),
            ("equations", refit::BYTES_PER_GAUSSIAN as u64),
            ("operators", operators * render::BYTES_PER_VISIBLE as u64),
            // Made at a time, with what they pull at: twice three f64.
            ("pictures", work.threads * (render::BYTES_PER_VISIBLE as u64 + 48)),
        ];
        let (rendered, solved) = (2 * fitted + 3 * tests, fitted * (ITERATIONS as u64 + 1));
        Need {
            stage: NAME,
            seconds: work.reading(work.count(), (fitted + tests) as f64)
                + work.picturing(rendered as f64, 0.5 * work.count(), RENDER)
                + work.picturing(solved as f64, 0.5 * work.count(), LOOK),
            reads: 2.0 * work.scattered_reads(fitted + tests, limits)
                + again * work.scattered_reads(fitted - operators, limits)
                + work.scattered_reads(tests, limits),
            per_gaussian: [scored(limits), per_gaussian].concat(),
            fixed: vec![
                work.arriving(),
                ("pictures", (tests + at_once + 1) * 12 * work.pixels),
                ("pairs", (operators + work.threads) * render::STRIP_BYTES as u64 / 3),
            ],
        }
    }

    /// Fits the base colours of `reduction` to the original's pictures, if pictures that they are not fitted to come
    /// closer by it; protected Gaussians keep theirs.
    ///
    /// # Errors
    /// Frames that cannot be read.
    pub fn run(
        &self,
        scene: &Scene,
        scored: &Scored,
        mut reduction: Reduction,
        journal: &mut Journal,
    ) -> Result<Reduction> {
        let count = reduction.len();
        let pictures = spread(&scene.schedule, self.pictures + self.pictures.div_ceil(TEST_EVERY - 1), 1);
        // A single picture cannot be fitted to and tested on.
        if pictures.len() < 2 || count == 0 {
            return Ok(reduction);
        }
        reduction.change = journal.stage(NAME, count, scene.source(), |journal| {
            let result = scene.input.reduced(&reduction)?;
            let fixed = reduction.kept.iter().map(|id| scored.protected.binary_search(id).is_ok()).collect();
            let kept = scene.limits.operators_together;
            let mut equations = Equations::new(fixed, kept);
            let (fitted, tested) = divided(&pictures);
            let tests = look(scene, &*result, (&fitted, &tested), &mut equations)?;
            let unkept = fitted.get(kept..).unwrap_or_default();
            let (cameras, batch) = (&scene.schedule.cameras, Batch::of_frame(&scene.limits));
            let colors = equations.solve(self.ridge, ITERATIONS, |see| {
                show([Subject::all(&*result)], cameras, unkept, batch, |views| {
                    let cameras: Vec<&Camera> = views.iter().map(|view| view.camera).collect();
                    see(views[0].states[0], &cameras);
                    Ok(())
                })
            })?;
            drop(equations);
            let mut base = Column::zeros(3, count);
            for (i, rgb) in colors.into_iter().enumerate() {
                base.set_row(i, rgb.map(|x| (f64::from(x) / SH_C0) as f32));
            }
            let change = Change(Gaussians { sh: base, ..Gaussians::default() });
            let [before, after] = quality(scene, &*result, &tests, &change)?;
            if after > before {
                journal.notes.push(format!(
                    "base colours refitted: pictures that they were not fitted to keep {after:.2} dB, not {before:.2}"
                ));
                return Ok((change, count));
            }
            let why = format!("pictures not fitted to keep {before:.2} dB without it, {after:.2} with it");
            journal.leave_out("refitting colours", why);
            Ok((Change::default(), count))
        })?;
        Ok(reduction)
    }
}

/// `pictures` to fit to and, every fourth, to test on; a few pictures spare one too.
fn divided(pictures: &[Picture]) -> (Vec<Picture>, Vec<Picture>) {
    let is_test = |k: usize| k % TEST_EVERY == TEST_EVERY - 1 || k + 1 == pictures.len().min(TEST_EVERY);
    let (mut fitted, mut tested) = (Vec::new(), Vec::new());
    for (k, &picture) in pictures.iter().enumerate() {
        if is_test(k) { tested.push(picture) } else { fitted.push(picture) }
    }
    (fitted, tested)
}

/// Adds what the pictures `fitted` lack to `equations`; gives the original's pictures `tested`.
fn look(
    scene: &Scene,
    result: &dyn FrameSource,
    (fitted, tested): (&[Picture], &[Picture]),
    equations: &mut Equations,
) -> Result<Vec<Test>> {
    let background = scene.background;
    let (cameras, batch) = (&scene.schedule.cameras, Batch::of_frame(&scene.limits));
    let (result, original) = (Subject::all(result), Subject::all(scene.source()));
    let mut tests = Vec::with_capacity(tested.len());
    let mut pictures = [fitted, tested].concat();
    pictures.sort_unstable_by_key(|picture| (picture.frame, picture.view));
    let progress = Progress::new(NAME, "pictures", pictures.len() as u64);
    show([result, original], cameras, &pictures, batch, |views| {
        let mut lacks: Vec<(&Camera, Image)> = Vec::new();
        let state = views[0].states[0];
        for &View { picture, camera, states: [_, original] } in views {
            let mut lack = render(original, camera, background);
            if tested.contains(&picture) {
                tests.push(Test { picture, original: lack });
                continue;
            }
            let now = render(state, camera, background);
            lack.data.iter_mut().zip(&now.data).for_each(|(lack, now)| *lack -= now);
            lacks.push((camera, lack));
        }
        equations.add(state, &lacks);
        progress.advance(views.len() as u64);
        Ok(())
    })?;
    Ok(tests)
}

/// Mean PSNR over `tests` without `change` and with it, dB.
fn quality(scene: &Scene, result: &dyn FrameSource, tests: &[Test], change: &Change) -> Result<[f64; 2]> {
    let mut sums = [0.0; 2];
    let pictures: Vec<Picture> = tests.iter().map(|test| test.picture).collect();
    let mut originals = tests.iter().map(|test| &test.original);
    let (cameras, batch) = (&scene.schedule.cameras, Batch::of_frame(&scene.limits));
    show([Subject::all(result)], cameras, &pictures, batch, |views| {
        let before = views[0].states[0];
        let mut after = before.clone();
        change.add_to(&mut after, Columns::all());
        for (view, original) in views.iter().zip(&mut originals) {
            for (sum, state) in sums.iter_mut().zip([before, &after]) {
                *sum += psnr(&render(state, view.camera, scene.background), original);
            }
        }
        Ok(())
    })?;
    Ok(sums.map(|sum| sum / tests.len().max(1) as f64))
}
