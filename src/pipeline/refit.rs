//! Recolouring what is left: least squares on some scoring pictures, put to the test on others.
//!
//! Memory: [`Refit`], the pictures of the test and of one frame, and the states of original and result at one frame.

use super::input::Scene;
use super::merging::Sieved;
use super::pictures::{background, spread};
use super::result::result_frames;
use super::scored::Scored;
use super::summary::{LeftOut, Stages};
use crate::error::{Error, Result};
use crate::metrics::psnr;
use crate::model::{Camera, Columns, SH_C0};
use crate::pass::FrameSource;
use crate::recipe::Recipe;
use crate::refit::Refit;
use crate::render::{Image, render};
use crate::stream::{gather_all, recolor};

/// Iterations: METHOD section 6 takes 12; not tuned here.
const ITERATIONS: usize = 10;
/// Of the pictures looked at every fourth is kept for the test.
const TEST_EVERY: usize = 4;

/// What came of it.
#[derive(Debug, Default)]
pub struct Refitted {
    /// What is to be added to the base colours (`f_dc`), by place in the output; empty: nothing.
    pub recolor: Vec<[f32; 3]>,
    /// That it did not pay.
    pub left_out: Option<LeftOut>,
    /// What it gained.
    pub note: Option<String>,
}

/// A picture that the colours are not fitted to.
struct Test {
    frame: usize,
    camera: u32,
    original: Image,
}

/// Fits the base colours of `sieved` to the original's pictures; protected Gaussians keep theirs.
///
/// Nothing happens without visible contributions, and if the recipe asks for no pictures.
pub fn refit(
    scene: &Scene,
    scored: &Scored,
    recipe: &Recipe,
    sieved: &Sieved,
    stages: &mut Stages,
) -> Result<Refitted> {
    let wanted = recipe.refit.refit_pictures as usize;
    let count = sieved.kept.len();
    let pictures = spread(&scene.schedule, wanted + wanted.div_ceil(TEST_EVERY - 1));
    // A single picture cannot be fitted to and tested on.
    if !scored.has_seen() || pictures.len() < 2 || count == 0 {
        return Ok(Refitted::default());
    }
    let reads = pictures.len() as f64 / scene.schedule.frames.len().max(1) as f64;
    stages.run("refit", count, reads, || {
        let result = result_frames(&scene.input, scored.reference, &recipe.merge, sieved)?;
        let fixed = sieved.kept.iter().map(|id| scored.protected.binary_search(id).is_ok()).collect();
        let kept = scene.limits.sights_together;
        let mut equations = Refit::new(fixed, kept);
        let tests = look(scene, &*result, &pictures, &mut equations)?;
        let unkept: Vec<(usize, u32)> = fitted(&pictures).skip(kept).collect();
        let colors = equations.solve(recipe.refit.refit_ridge, ITERATIONS, |see| {
            for of_frame in unkept.chunk_by(|a, b| a.0 == b.0) {
                let cameras: Vec<&Camera> =
                    of_frame.iter().map(|&(_, camera)| &scene.schedule.cameras[camera as usize]).collect();
                see(&gather_all(&*result, of_frame[0].0, Columns::ALL)?, &cameras);
            }
            Ok::<_, Error>(())
        })?;
        drop(equations);
        let change: Vec<[f32; 3]> = colors.iter().map(|rgb| rgb.map(|x| (f64::from(x) / SH_C0) as f32)).collect();
        let [before, after] = quality(scene, &*result, &tests, &change)?;
        let refitted = match after > before {
            true => Refitted {
                recolor: change,
                note: Some(format!(
                    "base colours refitted: pictures that they were not fitted to keep {after:.2} dB, not {before:.2}"
                )),
                left_out: None,
            },
            false => Refitted {
                left_out: Some(LeftOut {
                    what: "refitting colours",
                    why: format!("pictures not fitted to keep {before:.2} dB without it, {after:.2} with it"),
                }),
                ..Refitted::default()
            },
        };
        Ok::<_, Error>((refitted, count))
    })
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
    equations: &mut Refit,
) -> Result<Vec<Test>> {
    let background = background(None, scene)?;
    let camera = |index: u32| &scene.schedule.cameras[index as usize];
    let mut tests = Vec::new();
    let numbered: Vec<(usize, usize, u32)> =
        pictures.iter().enumerate().map(|(k, &(frame, camera))| (k, frame, camera)).collect();
    for of_frame in numbered.chunk_by(|a, b| a.1 == b.1) {
        let frame = of_frame[0].1;
        // The result first: its members are in memory while it is made.
        let state = gather_all(result, frame, Columns::ALL)?;
        let original = gather_all(scene.input.source(), frame, Columns::ALL)?;
        let mut lacks: Vec<(&Camera, Image)> = Vec::new();
        for &(k, _, index) in of_frame {
            let mut picture = render(&original, camera(index), background);
            if is_test(k, pictures.len()) {
                tests.push(Test { frame, camera: index, original: picture });
                continue;
            }
            let now = render(&state, camera(index), background);
            picture.data.iter_mut().zip(&now.data).for_each(|(lack, now)| *lack -= now);
            lacks.push((camera(index), picture));
        }
        equations.add(&state, &lacks);
    }
    Ok(tests)
}

/// Mean PSNR over `tests` without `change` and with it, dB.
fn quality(scene: &Scene, result: &dyn FrameSource, tests: &[Test], change: &[[f32; 3]]) -> Result<[f64; 2]> {
    let background = background(None, scene)?;
    let mut sums = [0.0; 2];
    for of_frame in tests.chunk_by(|a, b| a.frame == b.frame) {
        let before = gather_all(result, of_frame[0].frame, Columns::ALL)?;
        let mut after = before.clone();
        recolor(&mut after, change);
        for test in of_frame {
            let camera = &scene.schedule.cameras[test.camera as usize];
            for (sum, state) in sums.iter_mut().zip([&before, &after]) {
                *sum += psnr(&render(state, camera, background), &test.original);
            }
        }
    }
    Ok(sums.map(|sum| sum / tests.len().max(1) as f64))
}
