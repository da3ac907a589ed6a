//! Stage `refit`: recolouring what is left by least squares on some scoring pictures, put to the test on others.
//!
//! Memory: [`Refit`](crate::refit::Refit), the pictures of the test and of one frame, and the states of original and
//! result at one frame.

use super::journal::Journal;
use super::score::{Scored, scored};
use crate::budget::{Need, Workload};
use crate::error::{Error, Result};
use crate::metrics::psnr;
use crate::model::{Camera, Columns, SH_C0};
use crate::pass::{FrameSource, Wanted};
use crate::plan::Limits;
use crate::recipe;
use crate::reduction::Reduction;
use crate::refit::{self, Refit as Equations};
use crate::render::{self, Image, render};
use crate::scene::Scene;
use crate::scene::pictures::spread;
use crate::stream::{States, recolor};

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
    frame: usize,
    camera: u32,
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
        let sights = fitted.min(limits.sights_together as u64);
        // Those whose footprints are not kept are looked at in every iteration.
        let again = if sights < fitted { ITERATIONS as f64 + 1.0 } else { 0.0 };
        let per_gaussian = vec![
            ("kept", 24),
            ("states", 2 * work.state(Columns::all())),
            ("result", work.input.reduced),
            ("readers", 2 * work.input.reader),
            ("held", 2 * work.held(limits, Columns::all())),
            ("equations", refit::BYTES_PER_GAUSSIAN as u64),
            ("sights", sights * render::BYTES_PER_VISIBLE as u64),
            // Made at a time, with what they pull at: twice three f64.
            ("pictures", work.threads * (render::BYTES_PER_VISIBLE as u64 + 48)),
        ];
        Need {
            stage: NAME,
            reads: 2.0 * work.scattered_reads(fitted + tests, limits)
                + again * work.scattered_reads(fitted - sights, limits)
                + work.scattered_reads(tests, limits),
            per_gaussian: [scored(limits), per_gaussian].concat(),
            fixed: vec![
                work.arriving(),
                ("pictures", (tests + work.views + 1) * 12 * work.pixels),
                ("pairs", (sights + work.threads) * render::STRIP_BYTES as u64 / 3),
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
        let pictures = spread(&scene.schedule, self.pictures + self.pictures.div_ceil(TEST_EVERY - 1));
        // A single picture cannot be fitted to and tested on.
        if pictures.len() < 2 || count == 0 {
            return Ok(reduction);
        }
        let change = journal.stage(NAME, count, scene.source(), |journal| {
            let result = scene.input.reduced(&reduction)?;
            let fixed = reduction.kept.iter().map(|id| scored.protected.binary_search(id).is_ok()).collect();
            let kept = scene.limits.sights_together;
            let mut equations = Equations::new(fixed, kept);
            let tests = look(scene, &*result, &pictures, &mut equations)?;
            let unkept: Vec<(usize, u32)> = fitted(&pictures).skip(kept).collect();
            let colors = equations.solve(self.ridge, ITERATIONS, |see| {
                let mut states = open(scene, &*result, unkept.iter().map(|&(frame, _)| frame))?;
                for of_frame in unkept.chunk_by(|a, b| a.0 == b.0) {
                    let cameras: Vec<&Camera> =
                        of_frame.iter().map(|&(_, camera)| &scene.schedule.cameras[camera as usize]).collect();
                    see(states.at(of_frame[0].0)?, &cameras);
                }
                Ok::<_, Error>(())
            })?;
            drop(equations);
            let change: Vec<[f32; 3]> = colors.iter().map(|rgb| rgb.map(|x| (f64::from(x) / SH_C0) as f32)).collect();
            let [before, after] = quality(scene, &*result, &tests, &change)?;
            if after > before {
                journal.notes.push(format!(
                    "base colours refitted: pictures that they were not fitted to keep {after:.2} dB, not {before:.2}"
                ));
                return Ok((change, count));
            }
            let why = format!("pictures not fitted to keep {before:.2} dB without it, {after:.2} with it");
            journal.leave_out("refitting colours", why);
            Ok((Vec::new(), count))
        })?;
        reduction.recolor = change;
        Ok(reduction)
    }
}

/// The states of `source`, which is the scene's or made of it, at `frames`.
fn open<'a>(scene: &Scene, source: &'a dyn FrameSource, frames: impl IntoIterator<Item = usize>) -> Result<States<'a>> {
    States::open(source, &Wanted::of(frames).holding(scene.limits.frames_held))
}

/// Whether picture `k` of `count` is for the test; a few pictures spare one too.
fn is_test(k: usize, count: usize) -> bool {
    k % TEST_EVERY == TEST_EVERY - 1 || k + 1 == count.min(TEST_EVERY)
}

/// The pictures that are not for the test.
fn fitted(pictures: &[(usize, u32)]) -> impl Iterator<Item = (usize, u32)> {
    let of = pictures.iter().enumerate().filter(|&(k, _)| !is_test(k, pictures.len()));
    of.map(|(_, &picture)| picture)
}

/// Adds what all but every fourth of `pictures` lack to `equations`; gives the others.
fn look(
    scene: &Scene,
    result: &dyn FrameSource,
    pictures: &[(usize, u32)],
    equations: &mut Equations,
) -> Result<Vec<Test>> {
    let background = scene.background;
    let camera = |index: u32| &scene.schedule.cameras[index as usize];
    let mut tests = Vec::new();
    let frames = || pictures.iter().map(|&(frame, _)| frame);
    let (mut of_result, mut of_source) = (open(scene, result, frames())?, open(scene, scene.source(), frames())?);
    let numbered: Vec<(usize, usize, u32)> =
        pictures.iter().enumerate().map(|(k, &(frame, camera))| (k, frame, camera)).collect();
    for of_frame in numbered.chunk_by(|a, b| a.1 == b.1) {
        let frame = of_frame[0].1;
        let (state, original) = (of_result.at(frame)?, of_source.at(frame)?);
        let mut lacks: Vec<(&Camera, Image)> = Vec::new();
        for &(k, _, index) in of_frame {
            let mut picture = render(original, camera(index), background);
            if is_test(k, pictures.len()) {
                tests.push(Test { frame, camera: index, original: picture });
                continue;
            }
            let now = render(state, camera(index), background);
            picture.data.iter_mut().zip(&now.data).for_each(|(lack, now)| *lack -= now);
            lacks.push((camera(index), picture));
        }
        equations.add(state, &lacks);
    }
    Ok(tests)
}

/// Mean PSNR over `tests` without `change` and with it, dB.
fn quality(scene: &Scene, result: &dyn FrameSource, tests: &[Test], change: &[[f32; 3]]) -> Result<[f64; 2]> {
    let background = scene.background;
    let mut sums = [0.0; 2];
    let mut states = open(scene, result, tests.iter().map(|test| test.frame))?;
    for of_frame in tests.chunk_by(|a, b| a.frame == b.frame) {
        let before = states.at(of_frame[0].frame)?;
        let mut after = before.clone();
        recolor(&mut after, change);
        for test in of_frame {
            let camera = &scene.schedule.cameras[test.camera as usize];
            for (sum, state) in sums.iter_mut().zip([before, &after]) {
                *sum += psnr(&render(state, camera, background), &test.original);
            }
        }
    }
    Ok(sums.map(|sum| sum / tests.len().max(1) as f64))
}
