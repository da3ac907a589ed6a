//! Self-check cases for the statistics that a scan of all frames computes.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};

use super::case::LargestError;
use super::generated::clouds::{Random, tilted_camera};
use super::oracle::statistics::{OracleRow, row};
use crate::error::Result;
use crate::model::{Attributes, Camera, Gaussians, StatisticRows, ViewSchedule};
use crate::recipe::{MotionParams, Recipe, ScanParams};
use crate::statistics::{BlockScan, ScanPlan};

const DEFINITIONS: [MotionParams; 2] = [MotionParams::Literal, MotionParams::Runs];

/// Compares statistics with their definitions in f64, for Gaussians whose life spans have many gaps: trajectory
/// magnitude D, curvature κ, opacity variance V and the number of frames in which a Gaussian is alive. In f64, a sum of
/// 40 terms has a rounding error of about 1e-15; a variance loses a few more digits.
pub(super) fn motion(worst: &mut LargestError) -> Result<()> {
    let frames = random_frames(500, 40);
    for motion in DEFINITIONS {
        let (schedule, recipe) = (without_views(frames.len()), recipe(motion)?);
        let got = scan(&frames, &schedule, &recipe)?;
        for i in 0..got.len() {
            let OracleRow { d, kappa, v, life, .. } = row(i, &frames, &schedule, &recipe);
            worst.relative(got.d[i], d);
            worst.relative(got.kappa[i], kappa);
            worst.relative(got.v[i], v);
            worst.same(&got.life[i], &life);
        }
    }
    Ok(())
}

/// Compares trajectory magnitude D and curvature κ of a Gaussian far from the origin with exact values. Each step of
/// the Gaussian is a whole number of ulps (units in the last place) of its f32 position, so the differences are exact.
/// A sum of 2000 squares in f64 loses at most 1e-14.
pub(super) fn motion_far_away(worst: &mut LargestError) -> Result<()> {
    compare_walks(&[(1e6, 0.0625)], worst)
}

/// Compares trajectory magnitude D and curvature κ with exact values, for two extreme motions of a Gaussian: one at
/// subnormal positions, and one at positions whose squares overflow f32.
pub(super) fn motion_of_any_size(worst: &mut LargestError) -> Result<()> {
    compare_walks(&[(0.0, f32::from_bits(1)), (0.0, 2f32.powi(115))], worst)
}

/// Compares trajectory magnitude D and curvature κ of a Gaussian at unevenly spaced frames with a formula. All times t
/// are whole numbers, and one coordinate of the Gaussian is t². With m as the mean time step, its velocity between the
/// times t and t' is m·(t + t'), and its turns (second differences) are 2m². Sums have 40 terms in f64.
pub(super) fn uneven_frames(worst: &mut LargestError) -> Result<()> {
    let times: Vec<f64> = (0..40).map(|k| f64::from(k + k / 3 + 5 * (k / 7))).collect();
    let frames: Vec<Gaussians> = times
        .iter()
        .map(|&time| {
            let mut frame = resting(1);
            frame.position.set_row(0, [0.0, (time * time) as f32, 0.0]);
            frame
        })
        .collect();
    let got = scan_at(&times, &frames, &without_views(frames.len()), &recipe(MotionParams::Runs)?)?;
    let steps = times.len() - 1;
    let mean_step = times[steps] / steps as f64;
    let squares: f64 = times.windows(2).map(|pair| (mean_step * (pair[0] + pair[1])).powi(2)).sum();
    worst.relative(got.d[0], (squares / steps as f64).sqrt());
    worst.relative(got.kappa[0], 2.0 * mean_step * mean_step);
    Ok(())
}

/// Compares trajectory magnitude D, curvature κ and opacity variance V of Gaussians that are alive (opacity ≥
/// alpha_min) in 0 to 3 frames with exact values.
pub(super) fn short_lives(worst: &mut LargestError) -> Result<()> {
    for motion in DEFINITIONS {
        // Each case lists in which frames the Gaussian is alive, then how many steps of 3 and turns (second
        // differences) of 6 count: first in the paper's definition (`literal`), then under `runs`.
        for (life, steps, turns) in [
            (&[0][..], [0, 0], [0, 0]),
            (&[1], [0, 0], [0, 0]),
            (&[1, 1], [1, 1], [0, 0]),
            (&[0, 1, 1], [2, 1], [0, 0]),
            (&[1, 0, 1], [1, 0], [0, 0]),
            (&[1, 1, 1], [2, 2], [1, 1]),
            // The turn (second difference) about the last frame in which the Gaussian is alive does not count.
            (&[1, 1, 1, 0], [2, 2], [1, 1]),
            (&[1, 1, 0, 0], [1, 1], [0, 0]),
        ] {
            let frames: Vec<Gaussians> = (0..life.len()).map(|t| zigzag(t, life[t] == 1)).collect();
            let got = scan(&frames, &without_views(frames.len()), &recipe(motion)?)?;
            let alive = life.iter().sum::<u32>();
            let (k, divisor) = match motion {
                MotionParams::Literal => (0, alive),
                MotionParams::Runs => (1, steps[1]),
            };
            worst.same(&got.life[0], &alive);
            worst.same(&got.d[0], &(f64::from(9 * steps[k]) / f64::from(divisor.max(1))).sqrt());
            worst.same(&got.kappa[0], &f64::from(6 * turns[k]));
            worst.same(&got.v[0], &0.0);
        }
    }
    Ok(())
}

/// Compares the variance V of nearly constant opacities with a computation in two passes in f64: first the mean, then
/// the deviations from it. Opacities of 0.9 that differ by 1e-6 have rounding errors of 1e-16, so V has a relative
/// error below 1e-9. If V were computed as the mean square minus the squared mean, only 2 digits would be correct.
pub(super) fn steady_opacity(worst: &mut LargestError) -> Result<()> {
    let mut random = Random(5);
    let opacity = |x: f32| 1.0 / (1.0 + (-f64::from(x)).exp());
    let logits: Vec<f32> = (0..1000).map(|_| 2.197_224_6 + random.next_in(-1e-5, 1e-5)).collect();
    let frames: Vec<Gaussians> = logits
        .iter()
        .map(|&logit| {
            let mut frame = resting(2);
            // The second Gaussian never changes.
            frame.opacity_logit.plane_mut(0).copy_from_slice(&[logit, -0.7]);
            frame
        })
        .collect();
    let got = scan(&frames, &without_views(frames.len()), &recipe(MotionParams::Runs)?)?;
    let count = logits.len() as f64;
    let mean = logits.iter().map(|&x| opacity(x)).sum::<f64>() / count;
    let variance = logits.iter().map(|&x| (opacity(x) - mean).powi(2)).sum::<f64>() / count;
    worst.relative(got.v[0], variance);
    worst.same(&got.v[1], &0.0);
    Ok(())
}

/// Compares the contribution C (projected area times opacity, in pixels) and the visibility of random Gaussians with a
/// computation by full matrices in f64. Errors of C are relative to max(C, 1 px); the program sums C in units of about
/// 3e-11 px.
pub(super) fn projected_area(worst: &mut LargestError) -> Result<()> {
    let frames = random_frames(500, 3);
    let cameras = vec![tilted_camera(320, 256), tilted_camera(40, 300)];
    let mut schedule = ViewSchedule::new(cameras);
    schedule.push_frames(frames.len(), &[(0, 0), (1, 1)]);
    let recipe = recipe(MotionParams::Runs)?;
    let got = scan(&frames, &schedule, &recipe)?;
    for i in 0..got.len() {
        let OracleRow { c, vis, .. } = row(i, &frames, &schedule, &recipe);
        worst.near(got.c[i], c, c.max(1.0));
        worst.same(&got.vis[i], &vis);
    }
    Ok(())
}

/// Compares the contribution C (projected area times opacity, in pixels) of one needle-shaped Gaussian of opacity 0.5
/// with a closed formula.
/// - The Gaussian has the variances a and b, in px², along its axes in the image; these axes are rotated in the image
///   plane. Projection adds 0.3 px² to both variances.
/// - So the projected covariance Σ has the determinant (a + 0.3)(b + 0.3), and the area is proportional to its root.
/// - The entries of Σ are up to 1e10 px². The expression Σxx·Σyy − Σxy² would lose up to ten of 16 digits, because it
///   subtracts nearly equal numbers.
/// - Errors are relative to max(C, 1 px), as in [`projected_area`].
pub(super) fn needle_on_screen(worst: &mut LargestError) -> Result<()> {
    let (size, focal) = (256, 250.0);
    let camera = Camera {
        width: size,
        height: size,
        near: Camera::NEAR,
        fx: focal,
        fy: focal,
        // Pixel centers have whole coordinates, so the center of the image is at half its size minus half a pixel.
        cx: f64::from(size) / 2.0,
        cy: f64::from(size) / 2.0,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    };
    let mut schedule = ViewSchedule::new(vec![camera]);
    schedule.push_frames(1, &[(0, 0)]);
    for (turn, length) in [(0.1f32, 1e2f64), (0.4, 1e3), (0.9, 1e4), (1.3, 1e5)] {
        let mut frame = resting(1);
        let depth = 2.0f32;
        frame.position.set_row(0, [0.0, 0.0, depth]);
        frame.rotation.set_row(0, [1.0, 0.0, 0.0, turn]);
        let logs = [length, 1e-8, 1e-8].map(|px| (px * f64::from(depth) / focal).ln() as f32);
        frame.log_scale.set_row(0, logs);
        let got = scan(&[frame], &schedule, &recipe(MotionParams::Runs)?)?;
        let variance = |k: usize| (f64::from(logs[k]).exp() * focal / f64::from(depth)).powi(2);
        let (a, b) = (variance(0), variance(1));
        let (sine, cosine) = (2.0 * f64::from(turn).atan()).sin_cos();
        let sides = [cosine * cosine * a + sine * sine * b, sine * sine * a + cosine * cosine * b];
        let share = |variance: f64| (f64::from(size) / (6.0 * (variance + 0.3).sqrt())).min(1.0);
        let area = 9.0 * PI * ((a + 0.3) * (b + 0.3)).sqrt() * share(sides[0]) * share(sides[1]);
        // The opacity of the Gaussian is one half, so its contribution is half its area.
        worst.near(got.c[0], area / 2.0, (area / 2.0).max(1.0));
    }
    Ok(())
}

/// Scans sequences of one moving Gaussian and compares the trajectory magnitude D and the curvature κ with their exact
/// values. Each pair in `sizes` gives a sequence: the x coordinate at which the Gaussian starts, and the unit of its
/// motion along x, in scene units. In each frame it moves by a whole multiple of the unit. Adds the relative errors
/// of D and κ to `worst`.
fn compare_walks(sizes: &[(f32, f32)], worst: &mut LargestError) -> Result<()> {
    for &(from, unit) in sizes {
        let mut random = Random(9);
        let mut place = 0i64;
        let places: Vec<i64> = (0..2000)
            .map(|_| {
                // Steps lead back toward the start, so every position is exact in f32.
                let step = (1000.0 * random.next_f32()) as i64;
                place += if place > 0 { -step } else { step };
                place
            })
            .collect();
        let frames: Vec<Gaussians> = places
            .iter()
            .map(|&place| {
                let mut frame = resting(1);
                frame.position.set_row(0, [from + place as f32 * unit, 0.0, 0.0]);
                frame
            })
            .collect();
        let got = scan(&frames, &without_views(frames.len()), &recipe(MotionParams::Runs)?)?;
        let steps: Vec<i64> = places.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let squares: i64 = steps.iter().map(|step| step * step).sum();
        let turns: i64 = steps.windows(2).map(|pair| (pair[1] - pair[0]).abs()).sum();
        worst.relative(got.d[0], (squares as f64 / steps.len() as f64).sqrt() * f64::from(unit));
        worst.relative(got.kappa[0], turns as f64 / (steps.len() - 1) as f64 * f64::from(unit));
    }
    Ok(())
}

/// Returns the state at frame `t` of one Gaussian that alternately moves by +3 and −3 scene units along x. `alive`:
/// whether the Gaussian is opaque enough at this frame to count as alive.
fn zigzag(t: usize, alive: bool) -> Gaussians {
    let mut frame = resting(1);
    frame.position.set_row(0, [3.0 * (t % 2) as f32, 0.0, 0.0]);
    frame.opacity_logit.set_row(0, [if alive { 0.0 } else { -9.0 }]);
    frame
}

/// Returns `count` Gaussians at the origin with an opacity of one half.
fn resting(count: usize) -> Gaussians {
    let mut frame = Gaussians::zeros(count, 0);
    frame.rotation.plane_mut(0).fill(1.0);
    frame
}

/// Returns `frames` frames of `count` Gaussians with new random attributes in every frame. The Gaussians lie in front
/// of a camera at the origin, a few of them behind it. A third of the opacities, chosen at random, are so low that the
/// Gaussian mostly does not count as alive.
fn random_frames(count: usize, frames: usize) -> Vec<Gaussians> {
    let mut random = Random(3);
    let mut frame = |_| {
        let mut frame = Gaussians::zeros(count, 0);
        for i in 0..count {
            let depth = random.next_in(-0.5, 6.0);
            frame.position.set_row(i, [random.next_in(-3.0, 3.0), random.next_in(-3.0, 3.0), depth]);
            frame.rotation.set_row(i, std::array::from_fn::<f32, 4, _>(|_| random.next_in(-1.0, 1.0)));
            frame.log_scale.set_row(i, std::array::from_fn::<f32, 3, _>(|_| random.next_in(-5.0, -1.0)));
            frame
                .opacity_logit
                .set_row(i, [random.next_in(-3.0, 3.0) - if random.next_f32() < 0.33 { 6.0 } else { 0.0 }]);
        }
        frame
    };
    (0..frames).map(&mut frame).collect()
}

fn recipe(motion: MotionParams) -> Result<ScanParams> {
    Ok(ScanParams { motion, ..Recipe::preset("default")?.scan })
}

fn without_views(frames: usize) -> ViewSchedule {
    let mut schedule = ViewSchedule::default();
    schedule.push_frames(frames, &[]);
    schedule
}

/// Returns the statistics of all Gaussians as [`BlockScan`], the code that is checked here, computes them. `frames`
/// holds the Gaussians at each frame; frame t is at time t. `schedule` holds the views of each frame.
fn scan(frames: &[Gaussians], schedule: &ViewSchedule, recipe: &ScanParams) -> Result<StatisticRows> {
    let times: Vec<f64> = (0..frames.len()).map(|t| t as f64).collect();
    scan_at(&times, frames, schedule, recipe)
}

/// Returns the statistics of all Gaussians as [`BlockScan`], the code that is checked here, computes them. `frames`
/// holds the Gaussians at each frame; frame t is at time `times[t]`. `schedule` holds the views of each frame. Also
/// passes to [`BlockScan`] whether the opacities of a frame equal those of the frame before, as readers of models do.
fn scan_at(times: &[f64], frames: &[Gaussians], schedule: &ViewSchedule, recipe: &ScanParams) -> Result<StatisticRows> {
    let plan = ScanPlan::new(recipe, times, schedule)?;
    let mut block = BlockScan::new(frames.first().map_or(0, Gaussians::len), 0, &plan);
    for (t, (frame, views)) in frames.iter().zip(schedule.iter()).enumerate() {
        let cameras: Vec<&Camera> = views.iter().map(|&(_, camera)| &schedule.cameras[camera as usize]).collect();
        let stays = t > 0 && frame.opacity_logit == frames[t - 1].opacity_logit;
        let changed = if stays { Attributes::all().difference(Attributes::OPACITY) } else { Attributes::all() };
        block.add_frame(t, frame, &cameras, changed);
    }
    Ok(block.finish().rows)
}
