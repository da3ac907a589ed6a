//! Opening whatever the user names, with the cameras that look at it.

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::Scene;
use super::input::{InputOptions, Opened, load_cameras};
use super::pictures::no_picture;
use super::stream::open_arriving;
use crate::error::{Error, Result};
use crate::families::{self, Family, Timing};
use crate::ingest::cameras::{self, Times};
use crate::model::{Columns, Rig};
use crate::source::FrameSource;
use crate::stats::RobustBox;
use crate::stream::gather_all;

/// Opens an input; cameras only say which frames it has.
///
/// # Errors
/// Whatever is wrong with input or cameras; cameras of other frames; options that the input does not take.
pub fn open_input(options: &InputOptions) -> Result<Opened> {
    if options.is_stream() {
        return check_frames(open_arriving(options)?, &options.path);
    }
    let path = &options.path;
    let mut notes = Vec::new();
    let input = families::open(path, &options.opening())?;
    notes.extend(input.notes());
    // Numbers in the names of a still scene's pictures are no times.
    let is_still = input.timing() != Timing::Continuous && input.source().info().times.len() == 1;
    let times = if is_still && options.times == Times::Own { Times::None } else { options.times.clone() };
    let rig = load_cameras(options, camera_path(options, &*input).as_deref(), times)?;
    let times = rig.as_ref().map(Rig::times).unwrap_or_default();
    let input = match input.timing() {
        Timing::Continuous => {
            let times = match options.frames {
                None if !times.is_empty() => times,
                // As many as there are: these.
                Some(frames) if frames == times.len() => times,
                given => evenly_spaced(given, &mut notes)?,
            };
            input.with_times(times)?
        }
        _ if options.frames.is_some() => {
            return Err(Error::usage(format!(
                "{}: --frames is for models that are continuous in time",
                path.display()
            )));
        }
        Timing::Numbered if !times.is_empty() => {
            let found = input.source().info().times.len();
            if times.len() != found {
                return Err(Error::usage(format!(
                    "{}: {found} frames, but the cameras of {} have {} distinct times\n  give the cameras of this sequence",
                    path.display(),
                    rig.as_ref().map_or("", |rig| rig.origin.as_str()),
                    times.len()
                )));
            }
            input.with_times(times)?
        }
        Timing::Numbered | Timing::Stamped => input,
    };
    check_frames(Opened { input, rig, notes }, path)
}

/// Times of the frames of a model for which no camera names any.
fn evenly_spaced(given: Option<usize>, notes: &mut Vec<String>) -> Result<Vec<f64>> {
    let frames = given.unwrap_or(DEFAULT_FRAMES);
    if !(1..=MAX_FRAMES).contains(&frames) {
        return Err(Error::usage(format!("--frames: expected 1 to {MAX_FRAMES}, found {frames}")));
    }
    if given.is_none() {
        notes.push(format!("nothing names the model's frames: {frames} evenly spaced ones (--frames)"));
    }
    Ok((0..frames).map(|i| i as f64 / frames as f64).collect())
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
    let has_cameras = rig.is_some();
    let rig = match rig {
        Some(rig) => rig,
        None => {
            let rig = virtual_rig(input.source())?;
            notes.push(format!("no cameras given or found: {}", rig.origin));
            rig
        }
    };
    let scene = Scene::new(options.path.clone(), input, rig, options.split)?;
    if scene.schedule.pairs() == 0 && !scene.source().info().times.is_empty() {
        return Err(no_picture(&scene.rig));
    }
    let mut scene = Scene { has_cameras, scratch: options.scratch_folder(), notes, ..scene };
    scene.keep_work(options)?;
    Ok(scene)
}

/// Frames of a model for which neither cameras nor the user name any.
const DEFAULT_FRAMES: usize = 60;
/// Most frames a model is evaluated at; each costs 8 bytes before any work.
const MAX_FRAMES: usize = 1_000_000;

fn camera_path(options: &InputOptions, input: &dyn Family) -> Option<PathBuf> {
    options.cameras.clone().or_else(|| cameras::find(input.data_folder()?, &options.path))
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
    Ok(Some(RobustBox::of(&gather_all(source, 0, Columns::POSITION)?.position)))
}

/// Folder for scratch files of a run that writes `output`: where the result goes there is room for its input.
pub fn scratch_beside(output: &Path) -> Option<PathBuf> {
    let parent = output.parent()?;
    Some(if parent.as_os_str().is_empty() { PathBuf::from(".") } else { parent.to_owned() })
}
