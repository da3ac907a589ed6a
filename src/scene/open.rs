//! Opens inputs of every kind, together with their cameras.

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::Scene;
use super::input::{InputOptions, OpenedInput, UntrackedInput, camera_path, has_one_frame, load_cameras, with_cameras};
use super::stream::{load_stream_cameras, open_stream, receive_untracked};
use super::view_selection::no_view_error;
use crate::error::{Error, Result, ShowPath};
use crate::files::cameras;
use crate::files::cameras::{TimeConvention, TimesSource};
use crate::model::RobustBox;
use crate::model::{Attributes, Rig, opacity};
use crate::models;
use crate::models::{Opened, TimeOrigin};
use crate::passes::gather_all;
use crate::progress::Message;
use crate::source::FrameSource;

/// Opens an input, and loads its cameras if it has any. If the input does not state the times of its frames, the times
/// of the cameras' views are used. Frames that do not identify Gaussians are linked into tracks (Gaussians followed
/// through frames).
///
/// # Errors
/// Fails as [`open_untracked`] does, and if the frames cannot be linked.
pub fn open_input(options: &InputOptions) -> Result<OpenedInput> {
    open_untracked(options)?.track(&options.path)
}

/// Opens an input, and loads its cameras if it has any, like [`open_input`], but links no frames.
///
/// # Errors
/// Fails if the input or the cameras are invalid, if the cameras belong to a sequence with other frames, or if an
/// option does not apply to the input.
pub fn open_untracked(options: &InputOptions) -> Result<UntrackedInput> {
    options.check_folders()?;
    if options.is_stream() {
        let rig = load_stream_cameras(options)?;
        return receive_untracked(open_stream(options)?, rig, options);
    }
    let path = &options.path;
    let opened = models::open(path, &options.open_options())?;
    let rig = load_input_cameras(options, &opened)?;
    let UntrackedInput { opened, rig, mut notes, .. } = with_cameras(options, opened, rig)?;
    let times = rig.as_ref().map(Rig::times).unwrap_or_default();
    let times = match opened.timing() {
        TimeOrigin::Continuous => Some(match options.frames {
            None if !times.is_empty() => times,
            // The given number of frames equals the number of the cameras' times, so these times are used.
            Some(frames) if frames == times.len() => times,
            given => {
                evenly_spaced(given, opened.model().map_or(1.0, |model| model.description().duration), &mut notes)?
            }
        }),
        _ if options.frames.is_some() => {
            return Err(Error::usage(format!("{}: --frames is for models that are continuous in time", path.shown())));
        }
        TimeOrigin::Numbered if !times.is_empty() => {
            let found = opened.times().len();
            if times.len() != found {
                return Err(Error::usage(format!(
                    "{}: {found} frames, but the cameras of {} have {} distinct times\n  give the cameras of this sequence",
                    path.shown(),
                    rig.as_ref().map_or("", |rig| rig.origin.as_str()),
                    times.len()
                )));
            }
            Some(times)
        }
        TimeOrigin::Numbered | TimeOrigin::Stamped => None,
    };
    Ok(UntrackedInput { opened, rig, times, notes })
}

/// Loads the cameras that `options` name, or else the cameras found with the input `opened`, in the time convention of
/// the input. Returns `None` if there are neither.
fn load_input_cameras(options: &InputOptions, opened: &Opened) -> Result<Option<Rig>> {
    let model = opened.model();
    let path = camera_path(options, model);
    let by_name = path.as_deref().is_some_and(cameras::are_timed_by_name);
    let times = match options.times {
        // Numbers in the image names of a still scene are not times.
        TimesSource::Own if has_one_frame(opened) && by_name => TimesSource::None,
        _ => options.times.clone(),
    };
    let clock = model.map_or(TimeConvention::Normalized, |model| model.description().time_convention);
    load_cameras(options, path.as_deref(), times, clock, model)
}

/// Returns evenly spaced frame times from 0 up to but not including `span`, for a model whose cameras give no times.
/// `requested` is the number of frames that the user asked for. If it is `None`, uses [`DEFAULT_FRAMES`] and adds a
/// message about this to `notes`.
///
/// # Errors
/// Fails if the number of frames is not from 1 to 1,000,000.
fn evenly_spaced(requested: Option<usize>, span: f64, notes: &mut Vec<String>) -> Result<Vec<f64>> {
    let frames = requested.unwrap_or(DEFAULT_FRAMES);
    if !(1..=MAX_FRAMES).contains(&frames) {
        return Err(Error::usage(format!("--frames: expected 1 to {MAX_FRAMES}, found {frames}")));
    }
    if requested.is_none() {
        notes.push(format!(
            "neither the cameras nor --frames give the model's frames; using {frames} evenly spaced ones"
        ));
    }
    Ok((0..frames).map(|i| span * i as f64 / frames as f64).collect())
}

/// Opens an input together with its cameras.
///
/// # Errors
/// Fails as [`open_input`] does, and if the split has no views.
///
/// # Examples
/// ```
/// # use splatsieve::diagnostics::{demo_scene::DemoScene, test_scene::write_scene};
/// # use splatsieve::progress::Events;
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let folder = tempfile::tempdir()?;
/// # let [model, cameras] = write_scene(&DemoScene::new(400, 4), folder.path(), &Events::default())?;
/// use splatsieve::scene::{InputOptions, open_scene};
///
/// let scene = open_scene(&InputOptions { path: model, cameras: Some(cameras), ..InputOptions::default() })?;
/// let info = scene.source().info();
/// assert_eq!((info.count, info.times.len()), (400, 4));
/// assert_eq!(scene.rig.cameras.len(), 6);
/// # Ok(())
/// # }
/// ```
pub fn open_scene(options: &InputOptions) -> Result<Scene> {
    from_input(open_input(options)?, options)
}

/// Creates the scene of an opened input, seen by the cameras of the split in `options`. If the input has no cameras,
/// virtual ones are placed around the Gaussians of the first frame.
///
/// # Errors
/// Fails if the cameras belong to another scene, or if the split has no views.
pub fn from_input(opened: OpenedInput, options: &InputOptions) -> Result<Scene> {
    let OpenedInput { input, rig, mut notes } = opened;
    // A stream's number of frames is unknown when its run is planned, so a stream never counts as a scene without
    // motion.
    let is_still = !options.is_stream() && input.source().info().times.len() == 1;
    let has_virtual_rig = rig.is_none();
    let has_cameras = !has_virtual_rig || is_still;
    let rig = match rig {
        Some(rig) => rig,
        None => {
            let rig = if is_still { surrounding_rig(input.source())? } else { virtual_rig(input.source())? };
            let origin = &rig.origin;
            let (path, folder) = (&options.path, options.path.shown());
            let unused = match path.is_dir() && cameras::are_in(path) {
                true => format!("; the input folder holds cameras: --cameras {folder} uses them"),
                false => String::new(),
            };
            notes.push(format!("no cameras were given or found: {origin}{unused}"));
            if !is_still {
                options.events.send(Message::Warning(NO_CAMERAS));
            }
            rig
        }
    };
    let scene = Scene::new(options.path.clone(), input, rig, options.split)?;
    if scene.schedule.pair_count() == 0 && !scene.source().info().times.is_empty() {
        return Err(no_view_error(&scene.rig));
    }
    let (scratch, events) = (options.scratch_folder(), options.events.clone());
    let mut scene = Scene { has_cameras, has_virtual_rig, scratch, notes, events, ..scene };
    scene.open_cache(options)?;
    Ok(scene)
}

/// Warning about a moving scene without cameras.
const NO_CAMERAS: &str = "no cameras were given or found. All views are virtual: the program places their cameras \
                          around the scene; give the training cameras with --cameras";

/// Number of frames at which a model is evaluated if neither its cameras nor the user give one.
const DEFAULT_FRAMES: usize = 60;
/// Maximum number of frames at which a model is evaluated. Each takes 8 bytes of memory before any work starts.
const MAX_FRAMES: usize = 1_000_000;

/// Returns a rig of virtual cameras (placed by the program) all around the surface of a scene with only one frame.
/// Memory: 64 bytes per Gaussian.
fn surrounding_rig(source: &dyn FrameSource) -> Result<Rig> {
    let state = gather_all(source, 0, Attributes::POSITION | Attributes::LOG_SCALE | Attributes::OPACITY)?;
    let positions: Vec<DVec3> = (0..state.len()).map(|i| DVec3::from_array(state.position_f64(i))).collect();
    let visible_area = |i: usize| {
        let mut scales = state.log_scale.row::<3>(i).map(f64::from);
        scales.sort_by(f64::total_cmp);
        opacity(state.opacity_logit.row::<1>(i)[0]) * (scales[1] + scales[2]).exp()
    };
    let weights: Vec<f64> = (0..state.len()).map(visible_area).collect();
    Ok(cameras::surrounding_rig(&positions, &weights))
}

/// Returns a rig of virtual cameras (placed by the program) around the robust box of the first frame. This box leaves
/// out the outermost 1% of the positions on each side.
fn virtual_rig(source: &dyn FrameSource) -> Result<Rig> {
    let (middle, extent) = first_frame_box(source)?.map_or((DVec3::ZERO, 1.0), |found| (found.median, found.extent()));
    Ok(cameras::virtual_rig(middle, extent))
}

/// Returns the robust box of the first frame's positions, which leaves out the outermost 1% on each side; `None` if
/// there are no frames. Memory: 16 bytes per Gaussian.
pub fn first_frame_box(source: &dyn FrameSource) -> Result<Option<RobustBox>> {
    if source.info().times.is_empty() {
        return Ok(None);
    }
    Ok(Some(RobustBox::from_positions(&gather_all(source, 0, Attributes::POSITION)?.position)))
}

/// Returns the folder for temporary files of a run that writes `output`: the folder that contains the output. A disk
/// with space for the output also has space for a temporary copy of packed input. Returns `None` if `output` is a
/// device or a FIFO.
pub fn scratch_beside(output: &Path) -> Option<PathBuf> {
    if std::fs::metadata(output).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        return None;
    }
    let parent = output.parent()?;
    Some(if parent.as_os_str().is_empty() { PathBuf::from(".") } else { parent.to_owned() })
}
