//! Calibration of time estimates before a run: reads some frame states and renders some views on all threads to measure
//! how fast this machine processes the scene.
//!
//! Memory: the state of all Gaussians at one frame, and the memory of one rendered view. Every stage that renders views
//! takes more.

use std::num::NonZeroU32;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use crate::error::Result;
use crate::journal::Stopwatch;
use crate::journal::records::Forecast;
use crate::memory_plan::{CONTRIBUTION_COST, MemoryPlan, REMOVAL_COST, RENDER_COST, Throughput, Workload};
use crate::model::{Attributes, Camera, Gaussians};
use crate::passes::{GAUSSIANS_PER_BLOCK, gather_all};
use crate::pipeline::plan::RunPlan;
use crate::pipeline::stage::MeasuredOnArrival;
use crate::pipeline::time_estimate::core_seconds;
use crate::refinement::MAX_USEFUL_PSNR;
use crate::render::{Contribution, RemovalError, Renderer};
use crate::scene::Scene;
use crate::source::{Ids, ReadPlan};

/// Maximum duration of the calibration, as a fraction of the expected duration of the run.
const MAX_TIME_FRACTION: f64 = 0.04;
/// Maximum duration of the calibration, seconds, if it keeps all threads busy.
const MAX_SECONDS: f64 = 1.0;
/// Number of frames that the calibration reads of each block of Gaussians. If the input decodes more frames than this
/// together, the calibration reads all frames of such a group.
const FRAMES_PER_BLOCK: u64 = 16;
/// Number of views that each thread renders for each of three measurements: the time of computing contributions, of
/// computing removal errors, and of rendering images.
const VIEWS_PER_THREAD: usize = 2;

/// Minimum expected duration, seconds, of a run that is preceded by a calibration.
const MIN_RUN_SECONDS: f64 = 2.0;

/// Returns the forecast (expected time and memory) of a run of `stages` with the memory plan `plan`. `measured` states
/// which kinds of statistics were already computed; their time is not counted. If the run is expected to take at least
/// [`MIN_RUN_SECONDS`], measures the speed of this machine first, and stores it in `scene`. The limits of `scene` must
/// already be those of `plan`.
///
/// # Errors
/// Fails if frames cannot be read.
pub(super) fn forecast(
    scene: &mut Scene,
    plan: &MemoryPlan,
    stages: &RunPlan,
    measured: MeasuredOnArrival,
) -> Result<Forecast> {
    let work = scene.workload();
    let expected = core_seconds(&stages.remaining_estimates(&work, &scene.limits, measured)) / work.threads as f64;
    let found = if expected < MIN_RUN_SECONDS { Calibration::NONE } else { Calibration::measure(scene, expected)? };
    scene.pace = found.pace;
    let work = scene.workload();
    let shortest = stages.shortest_estimates(&work, &scene.limits, measured, found.hardly_seen);
    let estimates = stages.remaining_estimates(&work, &scene.limits, measured);
    Ok(Forecast::new(&work, &estimates, core_seconds(&shortest), stages.has_uncertain_duration(), plan.peak_bytes()))
}

/// Result of a calibration of time estimates.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Calibration {
    /// Measured factors by which work takes longer on this machine than is assumed without a calibration.
    pace: Throughput,
    /// Fraction of the Gaussians that can be removed before the PSNR of renders falls below [`MAX_USEFUL_PSNR`]; 0 if
    /// no view was rendered.
    hardly_seen: f64,
}

impl Calibration {
    /// Result of a calibration that measured nothing.
    const NONE: Calibration = Calibration { pace: Throughput::UNKNOWN, hardly_seen: 0.0 };

    /// Measures the speed of this machine on `scene`, and returns it. The run is expected to take `expected` seconds on
    /// all threads. Before a short run, only states of some Gaussians are read and no view is rendered.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    fn measure(scene: &Scene, expected: f64) -> Result<Calibration> {
        let work = scene.workload();
        if work.gaussians == 0 || work.frames == 0 {
            return Ok(Calibration::NONE);
        }
        let budget = (MAX_TIME_FRACTION * expected).min(MAX_SECONDS) * work.threads as f64;
        let mut spent = MeasuredTime::default();
        let states = measure_states(scene, &work, budget, &mut spent)?;
        let machine = Throughput {
            states,
            contribution_time: states,
            removal_time: states,
            render_time: states,
            processors: None,
        };
        let work = Workload { throughput: machine, ..work };
        let views_per_way = VIEWS_PER_THREAD as f64 * work.threads as f64;
        let render_seconds = [CONTRIBUTION_COST, REMOVAL_COST, RENDER_COST]
            .map(|way| work.render_seconds(views_per_way, work.gaussian_count(), way));
        let needed_seconds = work.reading_seconds(work.gaussian_count(), work.input.frame_block.max(1) as f64)
            + render_seconds.iter().sum::<f64>()
            + render_seconds[2];
        let mut found = Calibration { pace: machine, hardly_seen: 0.0 };
        if needed_seconds <= budget && work.frame_views > 0 {
            found.render_views(scene, render_seconds, &mut spent)?;
        }
        found.pace.processors = spent.processors(work.threads);
        Ok(found)
    }

    /// Renders views of one frame to measure the speed of three kinds of work: computing contributions, computing
    /// removal errors, and rendering images. `expected` holds the estimated core-seconds of each kind, in this order.
    /// Stores two results in `self`: `pace` (for each kind, measured time divided by estimated time) and `hardly_seen`
    /// (fraction of the Gaussians whose removal hardly changes renders). Adds the measured time to `spent`.
    fn render_views(&mut self, scene: &Scene, expected: [f64; 3], spent: &mut MeasuredTime) -> Result<()> {
        let schedule = &scene.schedule;
        let middle = schedule.iter().count() / 2;
        let seen = schedule.iter().enumerate().filter(|(_, views)| !views.is_empty());
        let Some((frame, views)) = seen.min_by_key(|(frame, _)| frame.abs_diff(middle)) else { return Ok(()) };
        let state = gather_all(scene.source(), frame, Attributes::all())?;
        let threads = rayon::current_num_threads();
        let camera = |k: usize| {
            &schedule.cameras[views[k * views.len() / (VIEWS_PER_THREAD * threads) % views.len()].1 as usize]
        };
        let renderers: Vec<_> = (0..threads).map(|_| Mutex::new(Renderer::new())).collect();
        let on_all_threads = |visit: &(dyn Fn(&mut Renderer, usize, &Camera) + Sync)| {
            (0..threads).into_par_iter().for_each(|thread| {
                let mut renderer = renderers[thread].lock().unwrap_or_else(PoisonError::into_inner);
                (0..VIEWS_PER_THREAD).for_each(|k| visit(&mut renderer, thread, camera(thread * VIEWS_PER_THREAD + k)));
            });
        };
        // The first views also allocate the buffers of the renderers, so their time is not measured.
        on_all_threads(&|renderer, _, camera| _ = renderer.render(&state, camera, scene.background));
        let [look, remove, render] = expected;
        let pace = &mut self.pace;
        let looked = spent.time(|| {
            on_all_threads(&|renderer, _, camera| {
                renderer.contribution(&state, camera, NonZeroU32::MIN, &mut Contribution::new(state.len()));
            });
        });
        let errors: Vec<_> = (0..threads).map(|_| Mutex::new(RemovalError::new(state.len(), 0.0))).collect();
        let removed = spent.time(|| {
            on_all_threads(&|renderer, thread, camera| {
                let mut errors = errors[thread].lock().unwrap_or_else(PoisonError::into_inner);
                renderer.removal_error(&state, camera, scene.background, &mut errors);
            });
        });
        let rendered =
            spent.time(|| on_all_threads(&|renderer, _, camera| _ = renderer.render(&state, camera, scene.background)));
        for (measured, expected, pace) in [
            (looked, look, &mut pace.contribution_time),
            (removed, remove, &mut pace.removal_time),
            (rendered, render, &mut pace.render_time),
        ] {
            *pace *= measured.unwrap_or(expected) / expected;
        }
        let mut sum = RemovalError::new(state.len(), 0.0);
        errors.into_iter().for_each(|errors| sum.merge(&errors.into_inner().unwrap_or_else(PoisonError::into_inner)));
        let pixels: f64 =
            (0..VIEWS_PER_THREAD * threads).map(camera).map(|c| f64::from(c.width) * f64::from(c.height)).sum();
        self.hardly_seen = hardly_seen(sum.sum, 3.0 * pixels);
        Ok(())
    }
}

/// Returns the fraction of the Gaussians that can be removed, in the order of increasing removal error, before the PSNR
/// of renders falls below [`MAX_USEFUL_PSNR`]. `errors` holds the removal error of every Gaussian in units of
/// [`RemovalError::SUM_UNIT`]; `values` is the number of color values in the renders (3 per pixel).
fn hardly_seen(mut errors: Vec<u64>, values: f64) -> f64 {
    errors.sort_unstable();
    let most = values * 10f64.powf(-MAX_USEFUL_PSNR / 10.0) / RemovalError::SUM_UNIT;
    let mut sum = 0.0;
    let few = errors.iter().take_while(|&&error| {
        sum += error as f64;
        sum <= most
    });
    few.count() as f64 / errors.len().max(1) as f64
}

/// Measures the time of reading frame states. Returns the measured core-seconds divided by the estimated ones, from
/// 0.05 to 20; 1 if the system does not report processor time. `budget` is the time that the whole calibration may
/// take, in core-seconds. The measured time is added to `spent`.
fn measure_states(scene: &Scene, work: &Workload, budget: f64, spent: &mut MeasuredTime) -> Result<f64> {
    let source = scene.source();
    let frames = work.frames.min(FRAMES_PER_BLOCK.max(work.input.frame_block)) as usize;
    let block_seconds = work.reading_seconds(GAUSSIANS_PER_BLOCK.min(source.info().count) as f64, frames as f64);
    let all = source.info().count.div_ceil(GAUSSIANS_PER_BLOCK);
    let blocks = ((0.3 * budget / block_seconds) as usize).clamp(1, 4 * work.threads as usize).min(all);
    // Most stages read every attribute but SH. Readers are opened before the time is taken, because stages open them
    // once for many frames.
    let columns = Attributes::all().difference(Attributes::SH);
    let open = |k: usize| -> Result<_> {
        let start = k * all / blocks * GAUSSIANS_PER_BLOCK;
        let mut reader = source.open(Ids::Range(start..source.info().count.min(start + GAUSSIANS_PER_BLOCK)))?;
        reader.expect(&ReadPlan::new(0..frames));
        let mut state = Gaussians::zeros(0, source.info().sh_degree);
        reader.read(0, columns, &mut state)?;
        Ok((reader, state))
    };
    let mut readers = (0..blocks).into_par_iter().map(open).collect::<Result<Vec<_>>>()?;
    let mut done = Ok(());
    let took = spent.time(|| {
        done = readers
            .par_iter_mut()
            .try_for_each(|(reader, state)| (0..frames).try_for_each(|frame| reader.read(frame, columns, state)));
    });
    done?;
    let expected = block_seconds * blocks as f64;
    Ok(took.map_or(1.0, |took| took / expected).clamp(0.05, 20.0))
}

/// Total time of several measurements: seconds summed over all processors, and wall-clock seconds.
#[derive(Debug, Default)]
struct MeasuredTime {
    processors: f64,
    wall: f64,
}

impl MeasuredTime {
    /// Runs `work` and adds its processor time and wall-clock time to these totals. Returns its processor time in
    /// seconds. If the system does not report processor time, adds nothing and returns `None`.
    fn time(&mut self, work: impl FnOnce()) -> Option<f64> {
        let clock = Stopwatch::start();
        work();
        let (processors, wall) = (clock.processor_seconds()?, clock.seconds());
        self.processors += processors;
        self.wall += wall;
        Some(processors)
    }

    /// Returns the average number of busy processors during the measurements, from 0.1 to `threads`; `None` if the
    /// measurements took at most 0.01 s.
    fn processors(&self, threads: u64) -> Option<f64> {
        (self.wall > 0.01).then(|| (self.processors / self.wall).clamp(0.1, threads as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::tests::scene;

    #[test]
    fn calibration_fits_its_time_and_leaves_the_scene_unchanged() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let before = scene.workload();
        let found = Calibration::measure(&scene, 1e3).unwrap();
        assert!(
            found.pace.states > 0.0 && found.pace.contribution_time > 0.0 && found.pace.removal_time > 0.0,
            "{found:?}"
        );
        assert_ne!(found.pace.contribution_time, found.pace.states, "views were rendered");
        let short = Calibration::measure(&scene, 1e-6).unwrap();
        assert_eq!((short.pace.contribution_time, short.hardly_seen), (short.pace.states, 0.0));
        assert_eq!(scene.workload(), before);
    }

    #[test]
    fn hardly_seen_counts_smallest_errors_within_60_db() {
        // At 60 dB, 1000 color values allow a squared error of 0.001 in total.
        let units = |error: f64| (error / RemovalError::SUM_UNIT) as u64;
        let errors = vec![0, units(0.05), units(0.0004), units(0.0005), 0, units(0.0002), units(0.1), 0];
        assert_eq!(hardly_seen(errors, 1000.0), 5.0 / 8.0);
        assert_eq!(hardly_seen(Vec::new(), 1000.0), 0.0);
    }
}
