//! Options for opening an input with its cameras.

use std::fs;
use std::path::{Path, PathBuf};

use crate::cache;
use crate::error::{Error, Result, ShowPath};
use crate::files::cameras;
use crate::files::cameras::{CameraOptions, Clock, Times};
use crate::memory_plan::Budget;
use crate::model::{Rig, Split};
use crate::models;
use crate::models::{Conventions, InputModel, Link, OpenOptions};
use crate::progress::Events;

/// Options for opening an input with its cameras.
#[derive(Debug, Clone, Default)]
pub struct InputOptions {
    /// Model folder, folder of PLY files, .ply or .gseq file; `-`: a frame stream on standard input.
    pub path: PathBuf,
    /// Training iteration of a model folder; `None`: the largest one found.
    pub iteration: Option<u32>,
    /// Conventions that the files of a model do not state.
    pub conventions: Conventions,
    /// Whether a folder of frames may have missing frames.
    pub allow_gaps: bool,
    /// Whether the Gaussians of frames in a folder are linked into tracks.
    pub link: Link,
    /// Number of frames of a model that is continuous in time; `None`: the cameras' times.
    pub frames: Option<usize>,
    /// Camera file or folder; `None`: searched for.
    pub cameras: Option<PathBuf>,
    /// Image width and height for cameras that do not state them.
    pub size: Option<(u32, u32)>,
    /// Source of the times of views whose cameras state none.
    pub times: Times,
    /// Split whose views are used; `None`: all views.
    pub split: Option<Split>,
    /// Folder for scratch files during the run: the packed frames of a stream, and data that does not fit into
    /// `memory`; `None`: the system's folder for temporary files.
    pub scratch: Option<PathBuf>,
    /// Whether the user named `scratch`, as opposed to a folder derived from the output.
    pub is_scratch_named: bool,
    /// Memory that the run may take.
    pub memory: Budget,
    /// Cache of stage results; `None`: results are not cached.
    pub work: Option<cache::CacheRequest>,
    /// Receiver of the events of the run.
    pub events: Events,
}

impl InputOptions {
    /// Returns whether the input is the stream on standard input.
    pub fn is_stream(&self) -> bool {
        self.path == Path::new("-")
    }

    /// Returns the options for opening the input itself.
    pub fn opening(&self) -> OpenOptions {
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

    /// Checks that neither the cache folder (`--cache`) nor the scratch folder is the input or lies inside it. Files
    /// that appear in an input folder would change the input.
    ///
    /// # Errors
    /// Such a folder, as [`Error::Usage`].
    pub(super) fn check_folders(&self) -> Result<()> {
        let Ok(input) = fs::canonicalize(&self.path) else { return Ok(()) };
        if !input.is_dir() {
            return Ok(());
        }
        let work = self.work.as_ref().map(|asked| asked.folder.as_path());
        // A scratch folder derived from the output is not checked here: an output inside the input is refused on its
        // own.
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

    /// Returns the folder for scratch files.
    pub fn scratch_folder(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }
}

/// Opened input, with its cameras if there are any.
pub struct OpenedInput {
    /// The input.
    pub input: Box<dyn InputModel>,
    /// Cameras given by the user or found with the input.
    pub rig: Option<Rig>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Loads the cameras from `path`, with times from `times` and `clock`; returns `None` without a path. If the file does
/// not give the number of frames, it is the number that `input` was trained on, else that of `options`. The background
/// is that of the file. If the file has none and the input consists of frame states, which do not state it, it is the
/// training background of the model in whose folder the cameras are.
///
/// # Errors
/// A file that does not exist, or that holds no cameras.
pub fn load_cameras(
    options: &InputOptions,
    path: Option<&Path>,
    times: Times,
    clock: Clock,
    input: Option<&dyn InputModel>,
) -> Result<Option<Rig>> {
    let Some(path) = path else { return Ok(None) };
    let frames = input.and_then(InputModel::data_frames).or(options.frames);
    let rig = cameras::load(
        path,
        &CameraOptions { size: options.size, frames, times, clock, memory: options.memory.read_limit() },
    )?;
    let has_frame_states = input.is_none_or(InputModel::has_explicit_frames);
    let trained_background = || has_frame_states.then(|| models::trained_background(path)).flatten();
    Ok(Some(Rig { background: rig.background.or_else(trained_background), ..rig }))
}
