//! Options for opening an input (a model, a sequence of frames or a frame stream) together with its cameras.

use std::fs;
use std::path::{Path, PathBuf};

use crate::cache;
use crate::error::{Error, Result, ShowPath};
use crate::files::cameras;
use crate::files::cameras::{CameraOptions, TimeConvention, TimesSource};
use crate::memory_plan::Budget;
use crate::model::{Rig, Split};
use crate::models;
use crate::models::{InputModel, LinkMode, OpenOptions, Opened, TimeOrigin, TrainingConventions};
use crate::progress::Events;

/// Options for opening an input (a model, a sequence of frames or a frame stream) together with its cameras.
#[derive(Debug, Clone, Default)]
pub struct InputOptions {
    /// Model folder, folder of PLY files, .ply or .gseq file; `-`: a frame stream on standard input.
    pub path: PathBuf,
    /// Training iteration to read from a model folder; `None`: the latest one found.
    pub iteration: Option<u32>,
    /// Conventions of the training, such as the period of colors, that the files of some model formats do not state.
    pub conventions: TrainingConventions,
    /// Whether a folder with one PLY file per frame may lack the files of some frames.
    pub allow_gaps: bool,
    /// Whether Gaussians of successive frames are matched, so that each Gaussian is followed through the frames as a
    /// track.
    pub link: LinkMode,
    /// Number of frames at which a model that is continuous in time is evaluated; `None`: the times of the cameras are
    /// used.
    pub frames: Option<usize>,
    /// Camera file or folder; `None`: cameras are searched for near the input.
    pub cameras: Option<PathBuf>,
    /// Image width and height in pixels, for cameras whose file does not state them.
    pub size: Option<(u32, u32)>,
    /// Source of the times of views: the camera file or, if it states no times, the names of the images, a table, or
    /// none.
    pub times: TimesSource,
    /// Split (training, validation or test) whose views are used; `None`: the views of all splits.
    pub split: Option<Split>,
    /// Folder for temporary files during the run: the packed frames of a stream, and data that does not fit into
    /// `memory`; `None`: the system's folder for temporary files.
    pub scratch: Option<PathBuf>,
    /// Whether the user chose the folder `scratch`. If not, it was derived from the path of the output.
    pub is_scratch_named: bool,
    /// Memory that the run may take.
    pub memory: Budget,
    /// Cache folder for the results of stages; `None`: results are not cached.
    pub work: Option<cache::CacheRequest>,
    /// Receiver of progress, notes and warnings during the run.
    pub events: Events,
}

impl InputOptions {
    /// Returns whether the input is the frame stream on standard input.
    pub fn is_stream(&self) -> bool {
        self.path == Path::new("-")
    }

    /// Returns the options for opening the input alone, without its cameras.
    pub fn open_options(&self) -> OpenOptions {
        OpenOptions {
            iteration: self.iteration,
            allow_gaps: self.allow_gaps,
            link: self.link,
            scratch: self.scratch.clone(),
            conventions: self.conventions,
            memory: self.memory.read_limit(),
            events: self.events.clone(),
        }
    }

    /// Checks that neither the cache folder (`--cache`) nor the folder for temporary files is the input or lies inside
    /// it. Files that appear in an input folder would change the input.
    ///
    /// # Errors
    /// Fails with [`Error::Usage`] if one of the two folders is the input or lies inside it.
    pub(super) fn check_folders(&self) -> Result<()> {
        let Ok(input) = fs::canonicalize(&self.path) else { return Ok(()) };
        if !input.is_dir() {
            return Ok(());
        }
        let work = self.work.as_ref().map(|asked| asked.folder.as_path());
        // A folder that was derived from the output is not checked here: an output inside the input is refused
        // elsewhere.
        let scratch = self.scratch.as_deref().filter(|_| self.is_scratch_named);
        for (option, folder) in [("--cache", work), ("--scratch-dir", scratch)] {
            let Some(folder) = folder else { continue };
            // The folder may not exist yet, so its parent is checked instead.
            let parent = folder.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
            let real = fs::canonicalize(folder).or_else(|_| fs::canonicalize(parent));
            if real.is_ok_and(|real| real.starts_with(&input)) {
                return Err(Error::usage(format!(
                    "{option} {} lies inside the input {}; give a folder outside it",
                    folder.shown(),
                    self.path.shown()
                )));
            }
        }
        Ok(())
    }

    /// Returns the folder for temporary files: `scratch`, or else the system's folder.
    pub fn scratch_folder(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }
}

/// Opened input, together with its cameras if it has any.
pub struct OpenedInput {
    /// Model or sequence that was opened.
    pub input: Box<dyn InputModel>,
    /// Cameras given by the user or found with the input.
    pub rig: Option<Rig>,
    /// Notes about the input to show to the user.
    pub notes: Vec<String>,
}

/// Opened input whose Gaussians may still have to be linked into tracks (Gaussians followed through frames), together
/// with its cameras if it has any.
pub struct UntrackedInput {
    /// Model, or frames that are not linked yet.
    pub opened: Opened,
    /// Cameras given by the user or found with the input.
    pub rig: Option<Rig>,
    /// Times that the frames get instead of their own; `None` if they keep their own.
    pub times: Option<Vec<f64>>,
    /// Notes about the input to show to the user.
    pub notes: Vec<String>,
}

impl UntrackedInput {
    /// Returns the input with the times of its frames. Frames that are not linked yet are linked first, which reads all
    /// of them and renders some. `path` is the input in messages.
    ///
    /// # Errors
    /// Fails if the frames cannot be linked, if the times do not increase, or if an input with Gaussians has no frame.
    pub fn track(self, path: &Path) -> Result<OpenedInput> {
        let UntrackedInput { opened, rig, times, notes } = self;
        let mut input = opened.into_linked()?;
        if let Some(times) = times {
            input = input.with_times(times)?;
        }
        let info = input.source().info();
        if info.times.is_empty() && info.count > 0 {
            let found = format!("no frame, but {} Gaussians", info.count);
            return Err(Error::input(path, "", "at least one frame", found));
        }
        // Some notes of the input depend on the times of its frames.
        let notes = [input.description().notes, notes].concat();
        Ok(OpenedInput { input, rig, notes })
    }
}

/// Loads the cameras from the file or folder `path`; returns `None` if `path` is `None`. `times` states where the times
/// of views come from, `clock` whether times in the camera file are normalized.
///
/// Values that the camera file does not state come from other places:
/// - Number of frames: the number on which `input` was trained, else the number in `options`.
/// - Background color: if `input` is a sequence of frames or `None`, the training background of the model in whose
///   folder the cameras lie; otherwise none.
///
/// # Errors
/// Fails if the file does not exist or contains no cameras.
pub(super) fn load_cameras(
    options: &InputOptions,
    path: Option<&Path>,
    times: TimesSource,
    clock: TimeConvention,
    input: Option<&dyn InputModel>,
) -> Result<Option<Rig>> {
    let Some(path) = path else { return Ok(None) };
    let description = input.map(InputModel::description);
    let frames = description.as_ref().and_then(|found| found.data_frames).or(options.frames);
    let rig = cameras::load(
        path,
        &CameraOptions { size: options.size, frames, times, clock, memory: options.memory.read_limit() },
    )?;
    let has_frame_states = description.is_none_or(|found| found.has_explicit_frames);
    let trained_background = || has_frame_states.then(|| models::trained_background(path)).flatten();
    Ok(Some(Rig { background: rig.background.or_else(trained_background), ..rig }))
}

/// Returns the path of the cameras: the one that `options` name, else that of the training cameras of `model`. Returns
/// `None` if there is neither.
pub(super) fn camera_path(options: &InputOptions, model: Option<&dyn InputModel>) -> Option<PathBuf> {
    options
        .cameras
        .clone()
        .or_else(|| cameras::find_training_cameras(&model?.description().data_folder?, &options.path))
}

/// Returns the input `opened`, whose frames keep their times, with its cameras `rig`, if it has any. The cameras must
/// have been read in the time convention of the input. But the times in a camera file may be on the scale of the frames'
/// time stamps: if the frames have time stamps, and the times of `rig` are not among them, the times as stated in the
/// file are tried. They are used if they are among the time stamps.
///
/// If the input has only one frame, which none of these times fits, every camera sees this frame, and a note says so.
///
/// # Errors
/// Fails if the camera file can no longer be read.
pub fn with_cameras(options: &InputOptions, opened: Opened, rig: Option<Rig>) -> Result<UntrackedInput> {
    let (model, frame_times) = (opened.model(), opened.times());
    let is_misfit = |rig: &Rig| match opened.timing() {
        TimeOrigin::Continuous => false,
        // A single frame takes the only time of its cameras.
        TimeOrigin::Numbered => frame_times.len() == 1 && rig.times().len() > 1,
        TimeOrigin::Stamped => rig.schedule(&frame_times, options.split).is_err(),
    };
    let mut notes = Vec::new();
    let rig = match rig {
        Some(rig) if is_misfit(&rig) => {
            let (path, times) = (camera_path(options, model), options.times.clone());
            let given = load_cameras(options, path.as_deref(), times, TimeConvention::Given, model)?;
            Some(match given.filter(|given| !is_misfit(given)) {
                Some(given) => given,
                None if has_one_frame(&opened) => {
                    let rig = rig.without_times();
                    let views = rig.views.len();
                    notes.push(format!(
                        "one frame: its {views} views are those of {}, whose times are ignored",
                        rig.origin
                    ));
                    rig
                }
                None => rig,
            })
        }
        rig => rig,
    };
    Ok(UntrackedInput { opened, rig, times: None, notes })
}

/// Returns whether the input `opened` has only one frame and cannot be evaluated at other times.
pub(super) fn has_one_frame(opened: &Opened) -> bool {
    opened.timing() != TimeOrigin::Continuous && opened.times().len() == 1
}
