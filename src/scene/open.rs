//! Opening whatever the user names, with the cameras that look at it.

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::Scene;
use super::input::{InputOptions, Opened, load_cameras};
use super::pictures::no_picture;
use super::stream::open_arriving;
use crate::error::{Error, Result, ShowPath};
use crate::files::cameras;
use crate::files::cameras::{Clock, Times};
use crate::model::RobustBox;
use crate::model::{Columns, Rig, opacity};
use crate::models;
use crate::models::{InputModel, Timing};
use crate::passes::gather_all;
use crate::progress::Message;
use crate::source::FrameSource;

/// Opens an input; cameras only say which frames it has.
///
/// # Errors
/// Whatever is wrong with input or cameras; cameras of other frames; options that the input does not take.
pub fn open_input(options: &InputOptions) -> Result<Opened> {
    options.check_folders()?;
    if options.is_stream() {
        return check_frames(open_arriving(options)?, &options.path);
    }
    let path = &options.path;
    let mut notes = Vec::new();
    let input = models::open(path, &options.opening())?;
    let rig = cameras_of(options, &*input)?;
    let times = rig.as_ref().map(Rig::times).unwrap_or_default();
    let input = match input.timing() {
        Timing::Continuous => {
            let times = match options.frames {
                None if !times.is_empty() => times,
                // As many as there are: these.
                Some(frames) if frames == times.len() => times,
                given => evenly_spaced(given, input.span(), &mut notes)?,
            };
            input.with_times(times)?
        }
        _ if options.frames.is_some() => {
            return Err(Error::usage(format!("{}: --frames is for models that are continuous in time", path.shown())));
        }
        Timing::Numbered if !times.is_empty() => {
            let found = input.source().info().times.len();
            if times.len() != found {
                return Err(Error::usage(format!(
                    "{}: {found} frames, but the cameras of {} have {} distinct times\n  give the cameras of this sequence",
                    path.shown(),
                    rig.as_ref().map_or("", |rig| rig.origin.as_str()),
                    times.len()
                )));
            }
            input.with_times(times)?
        }
        Timing::Numbered | Timing::Stamped => input,
    };
    // Some depend on the times.
    let notes = [input.notes(), notes].concat();
    check_frames(Opened { input, rig, notes }, path)
}

/// The cameras that `options` name or `input` leads to. Frames that carry their times may have those of a model that counts
/// time as its cameras' file does: where divided times are no frame's, the file's own are tried.
fn cameras_of(options: &InputOptions, input: &dyn InputModel) -> Result<Option<Rig>> {
    let path = camera_path(options, input);
    // Numbers in the names of a still scene's pictures are no times.
    let is_still = input.timing() != Timing::Continuous && input.source().info().times.len() == 1;
    let by_name = path.as_deref().is_some_and(cameras::are_timed_by_name);
    let times = match options.times {
        Times::Own if is_still && by_name => Times::None,
        _ => options.times.clone(),
    };
    let load = |clock| load_cameras(options, path.as_deref(), times.clone(), clock, Some(input));
    let rig = load(input.clock())?;
    let fits = |rig: &Rig| rig.schedule(&input.source().info().times, options.split).is_ok();
    match rig.as_ref().is_some_and(|rig| input.timing() == Timing::Stamped && !fits(rig)) {
        true => Ok(load(Clock::Given)?.filter(fits).or(rig)),
        false => Ok(rig),
    }
}

/// Times of the frames of a model for which no camera names any, in `span`.
fn evenly_spaced(given: Option<usize>, span: f64, notes: &mut Vec<String>) -> Result<Vec<f64>> {
    let frames = given.unwrap_or(DEFAULT_FRAMES);
    if !(1..=MAX_FRAMES).contains(&frames) {
        return Err(Error::usage(format!("--frames: expected 1 to {MAX_FRAMES}, found {frames}")));
    }
    if given.is_none() {
        notes.push(format!("nothing names the model's frames: {frames} evenly spaced ones (--frames)"));
    }
    Ok((0..frames).map(|i| span * i as f64 / frames as f64).collect())
}

fn check_frames(opened: Opened, path: &Path) -> Result<Opened> {
    let info = opened.input.source().info();
    if info.times.is_empty() && info.count > 0 {
        let found = format!("none of {} Gaussians", info.count);
        return Err(Error::input(path, "", "at least one frame", found));
    }
    Ok(opened)
}

/// Opens an input and the cameras that look at it.
///
/// # Errors
/// Those of [`open_input`]; a split without pictures.
pub fn open_scene(options: &InputOptions) -> Result<Scene> {
    scene_of(open_input(options)?, options)
}

/// An open input as the cameras of the split that `options` name see it.
///
/// # Errors
/// Cameras of another scene; a split without pictures.
pub fn scene_of(opened: Opened, options: &InputOptions) -> Result<Scene> {
    let Opened { input, rig, mut notes } = check_frames(opened, &options.path)?;
    // What a stream has is not known when its run is planned.
    let is_still = !options.is_stream() && input.source().info().times.len() == 1;
    let has_cameras = rig.is_some() || is_still;
    let rig = match rig {
        Some(rig) => rig,
        None => {
            let rig = if is_still { surrounding_rig(input.source())? } else { virtual_rig(input.source())? };
            let origin = &rig.origin;
            notes.push(match is_still {
                true => format!("no cameras were given or found: {origin}"),
                false => format!("{NO_CAMERAS} ({origin})"),
            });
            if !is_still {
                options.events.send(Message::Warning(NO_CAMERAS));
            }
            rig
        }
    };
    let scene = Scene::new(options.path.clone(), input, rig, options.split)?;
    if scene.schedule.pairs() == 0 && !scene.source().info().times.is_empty() {
        return Err(no_picture(&scene.rig));
    }
    let mut scene =
        Scene { has_cameras, scratch: options.scratch_folder(), notes, events: options.events.clone(), ..scene };
    scene.keep_work(options)?;
    Ok(scene)
}

/// Warning about a scene without cameras, at the start and at the end of a run.
const NO_CAMERAS: &str = "no cameras were given or found. Gaussians are ranked and refined for invented views, which costs \
                          most of the quality; give the training cameras with --cameras";

/// Frames of a model for which neither cameras nor the user name any.
const DEFAULT_FRAMES: usize = 60;
/// Most frames a model is evaluated at; each costs 8 bytes before any work.
const MAX_FRAMES: usize = 1_000_000;

fn camera_path(options: &InputOptions, input: &dyn InputModel) -> Option<PathBuf> {
    options.cameras.clone().or_else(|| cameras::find(input.data_folder()?, &options.path))
}

/// A rig around the surface of the only frame. Memory: 64 bytes a Gaussian.
fn surrounding_rig(source: &dyn FrameSource) -> Result<Rig> {
    let state = gather_all(source, 0, Columns::POSITION | Columns::LOG_SCALE | Columns::OPACITY)?;
    let places: Vec<DVec3> =
        (0..state.len()).map(|i| DVec3::from_array(state.position.row::<3>(i).map(f64::from))).collect();
    let covered = |i: usize| {
        let mut scales = state.log_scale.row::<3>(i).map(f64::from);
        scales.sort_by(f64::total_cmp);
        opacity(state.opacity_logit.row::<1>(i)[0]) * (scales[1] + scales[2]).exp()
    };
    let weights: Vec<f64> = (0..state.len()).map(covered).collect();
    Ok(cameras::surrounding_rig(&places, &weights))
}

/// A rig around the robust middle of the first frame.
fn virtual_rig(source: &dyn FrameSource) -> Result<Rig> {
    let (middle, extent) = first_box(source)?.map_or((DVec3::ZERO, 1.0), |found| (found.middle, found.extent()));
    Ok(cameras::virtual_rig(middle, extent))
}

/// The robust box of the first frame; none without frames. Memory: 16 bytes a Gaussian.
///
/// # Errors
/// A frame that cannot be read.
pub fn first_box(source: &dyn FrameSource) -> Result<Option<RobustBox>> {
    if source.info().times.is_empty() {
        return Ok(None);
    }
    Ok(Some(RobustBox::from_positions(&gather_all(source, 0, Columns::POSITION)?.position)))
}

/// Folder for scratch files of a run that writes `output`: where the result goes there is room for its input. `None` for a
/// device or FIFO.
pub fn scratch_beside(output: &Path) -> Option<PathBuf> {
    if std::fs::metadata(output).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        return None;
    }
    let parent = output.parent()?;
    Some(if parent.as_os_str().is_empty() { PathBuf::from(".") } else { parent.to_owned() })
}
