//! Opens a scene and computes the statistics of its Gaussians. For a stream they are computed while its frames arrive,
//! so that the frames are read only once.
//!
//! Memory for a stream: packing it into a scratch container ([`crate::models::stream`]). If statistics are computed
//! while frames arrive, also the running statistics of all Gaussians ([`crate::statistics::BYTES_PER_GAUSSIAN`] bytes
//! each) and the memory of [`RunningContribution`].
//!
//! The time span and the number of frames are known only at the end of the stream. Until then two assumptions are made:
//! frames are evenly spaced, and every view, with its time as a fraction of the last view's, has exactly the time of a
//! frame. If an assumption proves wrong, the statistics are computed again from the packed frames in the container; the
//! result is the same in both cases.

use std::cell::OnceCell;
use std::io::Stdin;

use glam::DVec3;

use crate::error::Result;
use crate::files::cameras;
use crate::files::frame_stream::FrameStream;
use crate::journal::records::Forecast;
use crate::journal::{Journal, Stopwatch};
use crate::memory_plan::{Budget, MemoryPlan, Verbosity, Workload, format_bytes};
use crate::model::RobustBox;
use crate::model::{Camera, FrameView, Rig, Split, ViewSchedule};
use crate::models::Opened;
use crate::models::stream::{PREFETCH_FRAMES, frames_per_tile, receive_and_pack};
use crate::passes::{FramesInMemory, ViewSampler};
use crate::pipeline::plan::RunPlan;
use crate::pipeline::planning::InputMeta;
use crate::pipeline::stage::{Measured, MeasuredOnArrival};
use crate::pipeline::stages::measure::MeasureStages;
use crate::pipeline::stages::{quality, track};
use crate::progress::Message;
use crate::pruning::contribution::RunningContribution;
use crate::recipe;
use crate::scene::{
    FrameQuota, InputOptions, Scene, from_input, is_linked, load_stream_cameras, open_stream, open_untracked,
    receive_untracked, receiving_estimate, with_cameras,
};
use crate::source::{FrameSource, ReadCounts};
use crate::statistics::ScanPlan;
use crate::statistics::pass::RunningScan;

/// Opens the scene that `options` describe, and limits what the stages of the run keep in memory, so that the run stays
/// within the memory budget. The function `plan` makes the plan of the run from facts about the scene. It is called at
/// a time that depends on the input:
/// - stream: before any frame is read;
/// - frames whose Gaussians have to be linked: after the stage [`track`], which finds how many Gaussians there are;
/// - other input: after it is opened.
///
/// Frames that arrive on a stream or have to be linked take long to open. For them, the function `check` is called
/// earlier, to find errors of the request: before a stream is received, and before frames are linked. Its argument is
/// the number of frames, if known.
///
/// Returns the scene and the plan of the run. Also returns the statistics of the Gaussians if the input is a stream and
/// they were computed while it arrived (see [`receive_measured`]).
///
/// # Errors
/// Fails if the input, the cameras or the budget is invalid, or if `check` or `plan` fails.
pub fn open_to_measure(
    options: &InputOptions,
    check: impl Fn(Option<usize>) -> Result<()>,
    plan: impl FnOnce(InputMeta, &Workload) -> Result<RunPlan>,
    journal: &mut Journal,
) -> Result<(Scene, RunPlan, Option<Measured>)> {
    let mut start = Stopwatch::start();
    let opened = if options.is_stream() {
        check(None)?;
        let rig = load_stream_cameras(options)?;
        let stream = open_stream(options)?;
        if !is_linked(stream.header(), options) {
            let (mut scene, stages, measured) = receive_measured(stream, rig, options, plan, journal)?;
            warn_of_virtual_views(&scene);
            scene.add_outside_views(stages.measure.scan.recipe.outside);
            journal.record_opening("receive", start, scene.source().info().count, ReadCounts::default());
            return Ok((scene, stages, measured));
        }
        receive_untracked(stream, rig, options)?
    } else {
        open_untracked(options)?
    };
    if let Opened::Unlinked(frames) = &opened.opened {
        check(Some(frames.times().len()))?;
    }
    let mut scene = from_input(track::run(opened, options, &mut start, journal)?, options)?;
    warn_of_virtual_views(&scene);
    let stages = plan(InputMeta::from_scene(&scene), &scene.workload())?;
    scene.add_outside_views(stages.measure.scan.recipe.outside);
    let plan = MemoryPlan::fit_budget(scene.workload(), options.memory, &options.events, |work, limits| {
        stages.estimates(work, limits)
    })?;
    scene.apply_plan(&plan);
    send_forecast(&scene, &plan, &stages, MeasuredOnArrival::default(), options, journal);
    journal.record_opening("read", start, scene.source().info().count, scene.source().reads());
    Ok((scene, stages, None))
}

/// Warns the user at the start of the run if the program placed the cameras of `scene` and they may not show all of it.
/// A scene of one frame gets no warning, because its cameras surround it.
fn warn_of_virtual_views(scene: &Scene) {
    if !scene.has_cameras {
        let warning = "Gaussians are ranked by virtual views, which costs most of the quality";
        scene.events.send(Message::Warning(warning));
    }
}

/// Sends messages with the plan of the run and with the forecast of its time and memory, if the user asked for them. If
/// a forecast is made, also stores it in `journal`, the record of the run. A run of only one shard (part of a divided
/// stage) has no forecast.
/// - `plan`: memory plan; `stages`: plan of the run.
/// - `measured`: kinds of statistics that were already computed while the input, a stream, arrived.
fn send_forecast(
    scene: &Scene,
    plan: &MemoryPlan,
    stages: &RunPlan,
    measured: MeasuredOnArrival,
    options: &InputOptions,
    journal: &mut Journal,
) {
    let tell = options.memory.tell;
    // A process that runs only one shard does not know which fraction of the whole run it does, so it has no forecast.
    let is_part = options.work.as_ref().is_some_and(|work| work.shard.is_some());
    if tell == Verbosity::Plan && stages.output.is_some() {
        options.events.send(Message::Plan(&stages.text()));
    }
    if tell != Verbosity::Nothing && !is_part {
        let work = scene.workload();
        let estimates = stages.remaining_estimates(&work, &scene.limits, measured);
        let forecast = Forecast::new(&work, &estimates, plan.peak_bytes());
        options.events.send(Message::Plan(forecast.text(tell).trim_end()));
        journal.forecast = Some(forecast);
    }
}

/// Receives a stream, packs its frames into a scratch container, and opens the container as a scene. If memory
/// suffices, also computes the statistics of the Gaussians while the frames arrive. `loaded`: cameras given by the
/// user, if any. `plan`: function that makes the plan of the run from facts about the scene.
///
/// Returns the scene, the plan of the run, and the statistics. The statistics are `None` in three cases:
/// - memory did not suffice;
/// - an assumption about the times of the stream (see the module) proved wrong;
/// - Gaussians with NaN or infinity have to be dropped.
fn receive_measured(
    stream: FrameStream<Stdin>,
    loaded: Option<Rig>,
    options: &InputOptions,
    plan: impl FnOnce(InputMeta, &Workload) -> Result<RunPlan>,
    journal: &mut Journal,
) -> Result<(Scene, RunPlan, Option<Measured>)> {
    let has_cameras = loaded.is_some();
    let count = stream.header().count;
    let assumed_rig = loaded.clone().unwrap_or_else(|| cameras::virtual_rig(DVec3::ZERO, 1.0));
    let block = frames_per_tile(stream.header());
    let header = *stream.header();
    let counting = |frames| Workload::from_stream_header(&header, block, &assumed_rig, frames);
    let work = counting(0);
    let mut stages = plan(InputMeta::from_stream(count, has_cameras), &work)?;
    let MeasureStages { scan, visible, .. } = &stages.measure;
    let visible = visible.as_ref().filter(|visible| visible.can_render_on_arrival());
    let held = (block + PREFETCH_FRAMES) as u64;
    let fit = |tell: Verbosity, measuring: Option<bool>| {
        MemoryPlan::fit_budget(work, Budget { tell, ..options.memory }, &options.events, |work, limits| {
            let mut all = vec![receiving_estimate(work, limits, held, measuring, 0)];
            all.extend(stages.estimates(work, limits));
            all
        })
    };
    let measures = fit(Verbosity::Nothing, Some(visible.is_some())).is_ok();
    let memory = fit(options.memory.tell, measures.then_some(visible.is_some()))?;
    let receive = |budget: u64, measuring: Option<bool>, frames: u64| {
        let limits = memory.limits;
        MemoryPlan::closest(work, budget, |work, _| vec![receiving_estimate(work, &limits, held, measuring, frames)])
            .peak_bytes()
    };
    let mut quota = FrameQuota::new(options.memory, |budget, frames| {
        let later =
            MemoryPlan::closest(counting(frames), budget, |work, limits| stages.required_estimates(work, limits));
        later.peak_bytes().max(receive(budget, None, frames))
    });
    let to_measure =
        FrameQuota::new(options.memory, |budget, frames| receive(budget, Some(visible.is_some()), frames)).most;
    announce_limits(options, memory.peak_bytes(), quota.most, to_measure);
    // Without cameras, a virtual rig is placed around the first frame. The plan of the scan is made from the rig.
    let (rig, plan_of_scan) = (OnceCell::new(), OnceCell::new());
    if let Some(loaded) = loaded {
        let _ = rig.set(loaded);
    }
    let mut measuring: Option<Measuring<'_>> = None;
    let streamed = receive_and_pack(stream, &options.scratch_folder(), &options.events, |held| {
        quota.count_arrived(held.len())?;
        if quota.arrived() > to_measure {
            measuring = None;
            return Ok(());
        }
        let measuring = match &mut measuring {
            Some(measuring) => measuring,
            none if measures => {
                let rig: &Rig = rig.get_or_init(|| rig_around(held));
                let plan = plan_of_scan.get_or_init(|| ScanPlan::for_arriving_frames(&scan.recipe, &rig.cameras));
                let seen = visible.map(|_| RunningContribution::new(count, scan.recipe.pixel_stride, memory.limits));
                none.insert(Measuring::new(count, rig, options.split, plan, &scan.recipe, seen))
            }
            _ => return Ok(()),
        };
        measuring.add(held)
    })?;
    let frames_arrived = quota.arrived();
    let rig_given = rig.get().filter(|_| has_cameras).cloned();
    let opened = with_cameras(options, Opened::Model(streamed), rig_given)?;
    let mut scene = from_input(opened.track(&options.path)?, options)?;
    // The number of frames is known now.
    let (now, counted) = (scene.workload(), Budget { tell: Verbosity::Nothing, ..options.memory });
    if !MemoryPlan::fits_budget(now, counted, |work, limits| stages.estimates(work, limits)) {
        stages.stages.remove_optional();
        quality::leave_out(&mut stages.stages);
    }
    let later = MemoryPlan::fit_budget(now, counted, &options.events, |work, limits| stages.estimates(work, limits))?;
    scene.apply_plan(&later);
    if measures && measuring.is_none() && frames_arrived > 0 {
        let note = format!(
            "statistics were taken from the packed frames, not as they arrived: memory suffices \
             for measuring {to_measure} of them on arrival"
        );
        scene.notes.push(note);
    }
    let arrived = match measuring {
        Some(measuring) => finish_measuring(measuring, &stages.measure, &mut scene)?,
        None => None,
    };
    let measured = arrived.as_ref().map(Measured::measured_statistics).unwrap_or_default();
    send_forecast(&scene, &later, &stages, measured, options, journal);
    Ok((scene, stages, arrived))
}

/// Sends a message about memory before a stream is received. Its content depends on what the user asked for:
/// - forecast ([`Verbosity::Time`]): `peak`, the maximum memory of the run in bytes;
/// - plan ([`Verbosity::Plan`]): `most`, the maximum number of frames that fit the memory limit, and `to_measure`, the
///   maximum number of frames for which memory suffices to compute statistics while they arrive;
/// - nothing ([`Verbosity::Nothing`]): no message is sent.
fn announce_limits(options: &InputOptions, peak: u64, most: u64, to_measure: u64) {
    let text = match options.memory.tell {
        Verbosity::Time => {
            format!("memory: at most {}; the number of frames is unknown until the stream ends", format_bytes(peak))
        }
        Verbosity::Plan => {
            format!("frames: at most {most} fit the memory limit; up to {to_measure} are measured while they arrive")
        }
        Verbosity::Nothing => return,
    };
    options.events.send(Message::Plan(&text));
}

/// Completes the statistics that were computed while the frames of a stream arrived, and returns them. If they cannot
/// be used, adds the reason as a note to `scene` and returns `None`. There are two reasons: an assumption about the
/// times of the stream proved wrong, or Gaussians with NaN or infinity have to be dropped.
fn finish_measuring(measuring: Measuring<'_>, measure: &MeasureStages, scene: &mut Scene) -> Result<Option<Measured>> {
    let complete = ScanPlan::new(&measure.scan.recipe, &scene.source().info().times, &scene.schedule)?;
    let found = match measuring.failed_assumption(&complete, scene) {
        None => {
            let found = measuring.finish(&complete);
            // The frames were measured with all Gaussians, before some of them proved to have NaN or infinity.
            match measure.score.non_finite_ids_to_drop(&found.scanned.rows).is_empty() {
                true => Ok(found),
                false => Err("Gaussians with NaN or infinity are dropped from all frames"),
            }
        }
        Some(why) => Err(why),
    };
    match found {
        Ok(found) => Ok(Some(found)),
        Err(why) => {
            let note = format!("statistics were taken from the packed frames, not as they arrived: {why}");
            scene.notes.push(note);
            Ok(None)
        }
    }
}

/// Returns a virtual rig (cameras placed by the program) around the first frame of `frames`, the frames in memory.
fn rig_around(frames: &FramesInMemory) -> Rig {
    let bounds = RobustBox::from_positions(frames.position(0));
    cameras::virtual_rig(bounds.median, bounds.extent())
}

/// Running statistics of all Gaussians over the frames of a stream received so far.
struct Measuring<'a> {
    plan: &'a ScanPlan,
    cameras: &'a [Camera],
    assumed: AssumedTimes<'a>,
    /// Views that belong to the frames received so far, under the assumption that views have exactly the times of
    /// frames.
    schedule: ViewSchedule,
    scan: RunningScan<'a>,
    contribution: Option<(ViewSampler, RunningContribution)>,
}

impl<'a> Measuring<'a> {
    fn new(
        count: usize,
        rig: &'a Rig,
        split: Option<Split>,
        plan: &'a ScanPlan,
        scan: &recipe::ScanParams,
        contribution: Option<RunningContribution>,
    ) -> Self {
        Measuring {
            plan,
            cameras: &rig.cameras,
            assumed: AssumedTimes::new(rig, split),
            schedule: ViewSchedule::new(rig.cameras.clone()),
            scan: RunningScan::new(count, plan),
            contribution: contribution.map(|contribution| (ViewSampler::new(scan), contribution)),
        }
    }

    fn add(&mut self, frames: &FramesInMemory) -> Result<()> {
        let views_per_frame: Vec<Vec<(u32, u32)>> =
            frames.info().times.iter().map(|&time| self.assumed.at(time)).collect();
        views_per_frame.iter().for_each(|views| self.schedule.push_frames(1, views));
        let cameras: Vec<Vec<&Camera>> = views_per_frame
            .iter()
            .map(|views| views.iter().map(|&(_, camera)| &self.cameras[camera as usize]).collect())
            .collect();
        self.scan.add(frames, &cameras)?;
        if let Some((sampler, contribution)) = &mut self.contribution {
            let views_per_frame = views_per_frame.iter().enumerate();
            let views: Vec<FrameView> =
                views_per_frame.flat_map(|(frame, views)| sampler.views_of_next_frame(frame, views)).collect();
            contribution.add(frames, self.cameras, &views, || ())?;
        }
        Ok(())
    }

    /// Returns a text for the user that names the assumption about the times of the stream that proved wrong; `None` if
    /// all assumptions hold. `complete`: plan of the scan, made from the times of all frames.
    fn failed_assumption(&self, complete: &ScanPlan, scene: &Scene) -> Option<&'static str> {
        if !complete.fits_scan_begun_with(self.plan) {
            return Some("the frames are not evenly spaced in time");
        }
        (self.schedule != scene.schedule).then_some(match self.assumed.rig.views == scene.rig.views {
            true => "the cameras' times are not exactly those of the frames",
            false => "the camera file gives the times of the frames themselves, not fractions of the last time",
        })
    }

    fn finish(self, complete: &ScanPlan) -> Measured {
        Measured {
            scanned: self.scan.finish(complete),
            visible_contribution: self.contribution.map(|(_, contribution)| contribution.finish()),
        }
    }
}

/// Rule that assigns views to a frame of a stream before the times of later frames are known. A frame gets the views of
/// the rig whose time equals its own up to rounding, and all views without a time.
struct AssumedTimes<'a> {
    rig: &'a Rig,
    /// Time and index in the rig of each view that belongs to the requested split and has a time; sorted by time, then
    /// by index.
    timed: Vec<(f64, usize)>,
    timeless: Vec<usize>,
    tolerance: f64,
}

impl<'a> AssumedTimes<'a> {
    fn new(rig: &'a Rig, split: Option<Split>) -> Self {
        let (mut timed, mut timeless) = (Vec::new(), Vec::new());
        for (place, rig_view) in rig.views.iter().enumerate() {
            if split.is_none_or(|split| split == rig_view.split) {
                match rig_view.time {
                    Some(time) => timed.push((time, place)),
                    None => timeless.push(place),
                }
            }
        }
        timed.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        AssumedTimes { rig, timed, timeless, tolerance: rig.time_tolerance() }
    }

    /// Returns the views of the frame at the time `time`, in the order of the rig (cameras and their views). Each view
    /// is a pair: its view number, and the index of its camera.
    fn at(&self, time: f64) -> Vec<(u32, u32)> {
        let near = self.timed.partition_point(|&(other, _)| other < time - self.tolerance);
        let near = self.timed[near..].iter().take_while(|&&(other, _)| other <= time + self.tolerance);
        let mut places: Vec<usize> = near.map(|&(_, place)| place).chain(self.timeless.iter().copied()).collect();
        places.sort_unstable();
        places.iter().map(|&place| (self.rig.views[place].view, self.rig.views[place].camera)).collect()
    }
}
