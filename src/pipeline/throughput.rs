//! How fast this machine is at this scene: some states read, and some pictures made on all threads, before a run says what
//! it will take.
//!
//! Memory: a state of all Gaussians and what a picture takes, which is less than any stage that looks at pictures takes.

use std::num::NonZeroU32;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use crate::error::Result;
use crate::journal::Clock;
use crate::journal::records::Forecast;
use crate::memory_plan::{LOOK, Plan, REMOVE, RENDER, Throughput, Workload};
use crate::model::{Camera, Columns, Gaussians};
use crate::passes::{BLOCK, gather_all};
use crate::pipeline::plan::RunPlan;
use crate::pipeline::stage::MeasuredOnArrival;
use crate::pipeline::time_estimate::core_seconds;
use crate::render::{Contribution, RemovalError, Renderer};
use crate::scene::Scene;
use crate::source::{Ids, ReadPlan};

/// Part of what a run is expected to take that may go into finding out, ...
const PART: f64 = 0.04;
/// ... and at most so many seconds on all threads.
const MOST_SECONDS: f64 = 1.0;
/// Frames that are read of each block, unless some are stored together.
const FRAMES: u64 = 16;
/// Pictures that each thread makes in every way.
const PICTURES: usize = 2;
/// PSNR, dB, of what the pictures that were looked at lose by pruning alone, above which there may be nothing to refine
/// ([`crate::refinement::CLOSE_ENOUGH`]).
const HARDLY_LOST: f64 = 60.0;

/// Runs that are expected to take less seconds than this are not measured beforehand.
const SHORT: f64 = 2.0;

/// What `stages` will take, as `plan` has them, but for those that are `measured` already, on `scene`, once it follows that plan; measures
/// first, unless the run is short. The scene's pace is set by that.
///
/// # Errors
/// Frames that cannot be read.
pub(super) fn forecast(
    scene: &mut Scene,
    plan: &Plan,
    stages: &RunPlan,
    measured: MeasuredOnArrival,
) -> Result<Forecast> {
    let work = scene.workload();
    let expected = core_seconds(&stages.remaining_estimates(&work, &scene.limits, measured)) / work.threads as f64;
    let found = if expected < SHORT { Calibration::NONE } else { Calibration::measure(scene, expected)? };
    scene.pace = found.pace;
    let work = scene.workload();
    let shortest = stages.shortest_estimates(&work, &scene.limits, measured, found.hardly_seen);
    let estimates = stages.remaining_estimates(&work, &scene.limits, measured);
    Ok(Forecast::new(&work, &estimates, core_seconds(&shortest), stages.is_open_ended(), plan.peak()))
}

/// What was found before a run.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Calibration {
    /// How fast.
    pace: Throughput,
    /// Part of the Gaussians that pictures hardly differ without; 0 if nothing was looked at.
    hardly_seen: f64,
}

impl Calibration {
    /// Of nothing.
    const NONE: Calibration = Calibration { pace: Throughput::UNKNOWN, hardly_seen: 0.0 };

    /// Of `scene`, for a run that is expected to take so many seconds on all threads; of a short one nothing but the states
    /// of some Gaussians is looked at.
    ///
    /// # Errors
    /// Frames that cannot be read.
    fn measure(scene: &Scene, expected: f64) -> Result<Calibration> {
        let work = scene.workload();
        if work.gaussians == 0 || work.frames == 0 {
            return Ok(Calibration::NONE);
        }
        let room = (PART * expected).min(MOST_SECONDS) * work.threads as f64;
        let mut spent = Spent::default();
        let states = states(scene, &work, room, &mut spent)?;
        let machine = Throughput { states, look: states, remove: states, render: states, processors: None };
        let work = Workload { pace: machine, ..work };
        let each = PICTURES as f64 * work.threads as f64;
        let pictures = [LOOK, REMOVE, RENDER].map(|way| work.picturing(each, work.count(), way));
        let takes = work.reading(work.count(), work.input.frame_block.max(1) as f64)
            + pictures.iter().sum::<f64>()
            + pictures[2];
        let mut found = Calibration { pace: machine, hardly_seen: 0.0 };
        if takes <= room && work.pictures > 0 {
            found.look_at(scene, pictures, &mut spent)?;
        }
        found.pace.processors = spent.processors(work.threads);
        Ok(found)
    }

    /// Makes pictures of one frame, which are expected to take so long in each way.
    fn look_at(&mut self, scene: &Scene, expected: [f64; 3], spent: &mut Spent) -> Result<()> {
        let schedule = &scene.schedule;
        let middle = schedule.iter().count() / 2;
        let seen = schedule.iter().enumerate().filter(|(_, views)| !views.is_empty());
        let Some((frame, views)) = seen.min_by_key(|(frame, _)| frame.abs_diff(middle)) else { return Ok(()) };
        let state = gather_all(scene.source(), frame, Columns::all())?;
        let threads = rayon::current_num_threads();
        let camera =
            |k: usize| &schedule.cameras[views[k * views.len() / (PICTURES * threads) % views.len()].1 as usize];
        let renderers: Vec<_> = (0..threads).map(|_| Mutex::new(Renderer::new())).collect();
        let each = |visit: &(dyn Fn(&mut Renderer, usize, &Camera) + Sync)| {
            (0..threads).into_par_iter().for_each(|thread| {
                let mut renderer = renderers[thread].lock().unwrap_or_else(PoisonError::into_inner);
                (0..PICTURES).for_each(|k| visit(&mut renderer, thread, camera(thread * PICTURES + k)));
            });
        };
        // Its first pictures also make room for themselves.
        each(&|renderer, _, camera| _ = renderer.render(&state, camera, scene.background));
        let [look, remove, render] = expected;
        let pace = &mut self.pace;
        let looked = spent.on(|| {
            each(&|renderer, _, camera| {
                renderer.contribution(&state, camera, NonZeroU32::MIN, &mut Contribution::new(state.len()));
            });
        });
        let errors: Vec<_> = (0..threads).map(|_| Mutex::new(RemovalError::new(state.len(), 0.0))).collect();
        let removed = spent.on(|| {
            each(&|renderer, thread, camera| {
                let mut errors = errors[thread].lock().unwrap_or_else(PoisonError::into_inner);
                renderer.removal_error(&state, camera, scene.background, &mut errors);
            });
        });
        let rendered = spent.on(|| each(&|renderer, _, camera| _ = renderer.render(&state, camera, scene.background)));
        for (measured, expected, pace) in
            [(looked, look, &mut pace.look), (removed, remove, &mut pace.remove), (rendered, render, &mut pace.render)]
        {
            *pace *= measured.unwrap_or(expected) / expected;
        }
        let mut sum = RemovalError::new(state.len(), 0.0);
        errors.into_iter().for_each(|of| sum.merge(&of.into_inner().unwrap_or_else(PoisonError::into_inner)));
        let pixels: f64 = (0..PICTURES * threads).map(camera).map(|c| f64::from(c.width) * f64::from(c.height)).sum();
        self.hardly_seen = hardly_seen(sum.sum, 3.0 * pixels);
        Ok(())
    }
}

/// Part of the Gaussians whose `errors`, the least ones, together leave so many `values` that close.
fn hardly_seen(mut errors: Vec<u64>, values: f64) -> f64 {
    errors.sort_unstable();
    let most = values * 10f64.powf(-HARDLY_LOST / 10.0) / RemovalError::UNIT;
    let mut sum = 0.0;
    let few = errors.iter().take_while(|&&error| {
        sum += error as f64;
        sum <= most
    });
    few.count() as f64 / errors.len().max(1) as f64
}

/// Times the expected seconds that states take.
fn states(scene: &Scene, work: &Workload, room: f64, spent: &mut Spent) -> Result<f64> {
    let source = scene.source();
    let frames = work.frames.min(FRAMES.max(work.input.frame_block)) as usize;
    let of_block = work.reading(BLOCK.min(source.info().count) as f64, frames as f64);
    let all = source.info().count.div_ceil(BLOCK);
    let blocks = ((0.3 * room / of_block) as usize).clamp(1, 4 * work.threads as usize).min(all);
    // Most stages read everything but harmonics; readers are opened once for many frames.
    let columns = Columns::all().difference(Columns::SH);
    let open = |k: usize| -> Result<_> {
        let start = k * all / blocks * BLOCK;
        let mut reader = source.open(Ids::Range(start..source.info().count.min(start + BLOCK)))?;
        reader.expect(&ReadPlan::new(0..frames));
        let mut state = Gaussians::zeros(0, source.info().sh_degree);
        reader.read(0, columns, &mut state)?;
        Ok((reader, state))
    };
    let mut readers = (0..blocks).into_par_iter().map(open).collect::<Result<Vec<_>>>()?;
    let mut done = Ok(());
    let took = spent.on(|| {
        done = readers
            .par_iter_mut()
            .try_for_each(|(reader, state)| (0..frames).try_for_each(|frame| reader.read(frame, columns, state)));
    });
    done?;
    let expected = of_block * blocks as f64;
    Ok(took.map_or(1.0, |took| took / expected).clamp(0.05, 20.0))
}

/// Seconds of all threads, and of the wall, that measuring took.
#[derive(Debug, Default)]
struct Spent {
    processors: f64,
    wall: f64,
}

impl Spent {
    /// Seconds of all processors that `work` takes; none where the system does not say.
    fn on(&mut self, work: impl FnOnce()) -> Option<f64> {
        let clock = Clock::start();
        work();
        let (processors, wall) = (clock.processor_seconds()?, clock.seconds());
        self.processors += processors;
        self.wall += wall;
        Some(processors)
    }

    /// Processors at work at a time; none where it took no time.
    fn processors(&self, threads: u64) -> Option<f64> {
        (self.wall > 0.01).then(|| (self.processors / self.wall).clamp(0.1, threads as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::tests::scene;

    #[test]
    fn a_calibration_measures_what_it_has_room_for_and_leaves_the_scene_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let before = scene.workload();
        let found = Calibration::measure(&scene, 1e3).unwrap();
        assert!(found.pace.states > 0.0 && found.pace.look > 0.0 && found.pace.remove > 0.0, "{found:?}");
        assert_ne!(found.pace.look, found.pace.states, "pictures were made");
        let short = Calibration::measure(&scene, 1e-6).unwrap();
        assert_eq!((short.pace.look, short.hardly_seen), (short.pace.states, 0.0));
        assert_eq!(scene.workload(), before);
    }

    #[test]
    fn the_part_that_is_hardly_seen_is_of_least_errors_that_leave_pictures_close() {
        // 1000 values of 60 dB: a squared error of 0.001 in all.
        let units = |error: f64| (error / RemovalError::UNIT) as u64;
        let errors = vec![0, units(0.05), units(0.0004), units(0.0005), 0, units(0.0002), units(0.1), 0];
        assert_eq!(hardly_seen(errors, 1000.0), 5.0 / 8.0);
        assert_eq!(hardly_seen(Vec::new(), 1000.0), 0.0);
    }
}
