//! What to read and from where to look, before anything is opened.

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

/// What to read and from where to look.
#[derive(Debug, Clone, Default)]
pub struct InputOptions {
    /// Model folder, folder of PLY files, .ply or .gseq; `-`: a frame stream on standard input.
    pub path: PathBuf,
    /// Training iteration of a model folder; none: the largest.
    pub iteration: Option<u32>,
    /// What the files of a model do not say.
    pub conventions: Conventions,
    /// Whether frames may be missing from a folder of them.
    pub allow_gaps: bool,
    /// Whether frames of a folder are linked.
    pub link: Link,
    /// Frames of a model that is continuous in time; none: the cameras' times.
    pub frames: Option<usize>,
    /// Camera file or folder; none: searched for.
    pub cameras: Option<PathBuf>,
    /// Picture size where the cameras name none.
    pub size: Option<(u32, u32)>,
    /// Where the times of pictures come from whose cameras have none.
    pub times: Times,
    /// Which pictures to score with; none: all.
    pub split: Option<Split>,
    /// Folder for scratch files while the run lasts: the packed frames of a stream, what does not fit into
    /// `memory`; none: the system's for such files.
    pub scratch: Option<PathBuf>,
    /// Whether the user named `scratch`, as opposed to a folder derived from the output.
    pub is_scratch_named: bool,
    /// Memory that the run may take.
    pub memory: Budget,
    /// Where what stages find is kept; none: nowhere.
    pub work: Option<cache::CacheRequest>,
    /// Where the events of the run go.
    pub events: Events,
}

impl InputOptions {
    /// Whether the input is the stream on standard input.
    pub fn is_stream(&self) -> bool {
        self.path == Path::new("-")
    }

    /// What is said of the input beside its path.
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

    /// Confirms that neither the work folder nor the folder for scratch files is the input or lies inside it: files that
    /// appear in an input change what it is.
    ///
    /// # Errors
    /// Such a folder, as [`Error::Usage`].
    pub(super) fn check_folders(&self) -> Result<()> {
        let Ok(input) = fs::canonicalize(&self.path) else { return Ok(()) };
        if !input.is_dir() {
            return Ok(());
        }
        let work = self.work.as_ref().map(|asked| asked.folder.as_path());
        // The folder of an output inside the input is refused with the output.
        let scratch = self.scratch.as_deref().filter(|_| self.is_scratch_named);
        for (option, folder) in [("--work", work), ("--scratch-dir", scratch)] {
            let Some(folder) = folder else { continue };
            // A work folder may have to be created.
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

    /// Where scratch files go.
    pub fn scratch_folder(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }
}

/// An input with its frames, and the cameras if there are any.
pub struct Opened {
    /// The input.
    pub input: Box<dyn InputModel>,
    /// Cameras given or found.
    pub rig: Option<Rig>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// The cameras of a file, if there is one, with times as `times` and `clock` say; where the file does not count the frames,
/// there are as many as `input` was trained on, else as many as `options` say. Behind them is what the file says; of an input
/// that is states alone, which do not say it, else what the model was trained with in whose folder they are.
///
/// # Errors
/// A file that is not there, or holds no cameras.
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
    let is_states = input.is_none_or(InputModel::has_explicit_frames);
    let beside = || is_states.then(|| models::trained_background(path)).flatten();
    Ok(Some(Rig { background: rig.background.or_else(beside), ..rig }))
}
