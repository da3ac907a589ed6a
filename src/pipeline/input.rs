//! Opening whatever the user names: a model, frames, a container; and the cameras that look at it.

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::arrival::open_arriving;
use super::memory::Budget;
use crate::emit::atomic::ScratchFile;
use crate::error::{Error, Result};
use crate::ingest::ModelFolder;
use crate::ingest::cameras::{self, CameraOptions};
use crate::ingest::container::Container;
use crate::ingest::ply_sequence::PlySequence;
use crate::model::{Column, Columns, Rig, Schedule, Split};
use crate::pass::FrameSource;
use crate::pipeline::summary::InputSummary;
use crate::plan::Limits;
use crate::stats::RobustBox;
use crate::stream::gather_all;

/// What to read and from where to look.
#[derive(Debug, Clone, Default)]
pub struct InputOptions {
    /// Model folder, folder of PLY files, .ply or .gseq; `-`: a frame stream on standard input.
    pub path: PathBuf,
    /// Training iteration of a model folder; none: the largest.
    pub iteration: Option<u32>,
    /// Frames of a model that is continuous in time; none: the cameras' times.
    pub frames: Option<usize>,
    /// Camera file or folder; none: searched for.
    pub cameras: Option<PathBuf>,
    /// Picture size where the cameras name none.
    pub size: Option<(u32, u32)>,
    /// Which pictures to score with; none: all.
    pub split: Option<Split>,
    /// Folder for scratch files while the run lasts: the packed frames of a stream, what does not fit into
    /// `memory`; none: the system's for such files.
    pub scratch: Option<PathBuf>,
    /// Memory that the run may take.
    pub memory: Budget,
}

impl InputOptions {
    /// Whether the input is the stream on standard input.
    pub fn is_stream(&self) -> bool {
        self.path == Path::new("-")
    }
}

/// An open input.
pub enum Input {
    /// A trained 4DGaussians model.
    Model(ModelFolder),
    /// PLY files, one per frame.
    Frames(PlySequence),
    /// A container.
    Container(Container),
    /// A stream that was packed as it arrived.
    Stream(Streamed),
}

/// What a stream has become.
pub struct Streamed {
    /// Its frames.
    pub container: Container,
    /// Bytes that arrived.
    pub received: u64,
    /// Keeps the container's file until nobody reads it any more.
    pub(super) _scratch: ScratchFile,
}

/// An input with the cameras that look at it.
pub struct Scene {
    /// Path as given.
    pub path: PathBuf,
    /// The input.
    pub input: Input,
    /// All cameras.
    pub rig: Rig,
    /// The cameras of the chosen split, frame by frame.
    pub schedule: Schedule,
    /// Whether the cameras were given or found; else they are a virtual rig.
    pub has_cameras: bool,
    /// What passes over it keep in memory at a time.
    pub limits: Limits,
    /// Folder for scratch files while the run lasts; none: the system's for such files.
    pub scratch: Option<PathBuf>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

impl Scene {
    /// Where scratch files go.
    pub(super) fn scratch_folder(&self) -> PathBuf {
        self.scratch.clone().unwrap_or_else(std::env::temp_dir)
    }

    /// `input` as the cameras of `rig` in `split` see it, without limits.
    pub fn new(path: PathBuf, input: Input, rig: Rig, split: Option<Split>) -> Result<Scene> {
        let schedule = rig.schedule(&input.source().info().times, split)?;
        let (limits, scratch, notes) = (Limits::NONE, None, Vec::new());
        Ok(Scene { path, input, rig, schedule, has_cameras: true, limits, scratch, notes })
    }
}

/// An input with its frames, and the cameras if there are any.
pub struct Opened {
    /// The input.
    pub input: Input,
    /// Cameras given or found.
    pub rig: Option<Rig>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// Opens an input; cameras only say which frames it has.
pub fn open_input(options: &InputOptions) -> Result<Opened> {
    if options.is_stream() {
        return check_frames(open_arriving(options)?, &options.path);
    }
    let path = &options.path;
    let mut notes = Vec::new();
    let input = Input::open(path, options.iteration)?;
    let rig = load_cameras(options, camera_path(options, &input).as_deref())?;
    let times = rig.as_ref().map(Rig::times).unwrap_or_default();
    let input = match input {
        Input::Model(model) => {
            let times = match options.frames {
                None if !times.is_empty() => times,
                given => {
                    let frames = given.unwrap_or(DEFAULT_FRAMES);
                    if !(1..=MAX_FRAMES).contains(&frames) {
                        return Err(Error::usage(format!("--frames: expected 1 to {MAX_FRAMES}, found {frames}")));
                    }
                    if given.is_none() {
                        notes.push(format!("nothing names the model's frames: {frames} evenly spaced ones (--frames)"));
                    }
                    (0..frames).map(|i| i as f64 / frames as f64).collect()
                }
            };
            Input::Model(model.with_times(times)?)
        }
        _ if options.frames.is_some() => {
            return Err(Error::usage(format!(
                "{}: --frames is for models that are continuous in time",
                path.display()
            )));
        }
        Input::Frames(frames) if !times.is_empty() => {
            let found = frames.info().times.len();
            if times.len() != found {
                return Err(Error::usage(format!(
                    "{}: {found} frames, but the cameras of {} have {} distinct times\n  give the cameras of this sequence",
                    path.display(),
                    rig.as_ref().map_or("", |rig| rig.origin.as_str()),
                    times.len()
                )));
            }
            Input::Frames(frames.with_times(times)?)
        }
        input => input,
    };
    check_frames(Opened { input, rig, notes }, path)
}

fn check_frames(opened: Opened, path: &Path) -> Result<Opened> {
    let info = opened.input.source().info();
    if info.times.is_empty() && info.count > 0 {
        let found = format!("none of {} Gaussians", info.count);
        return Err(Error::input(path, "", "at least one frame", found));
    }
    Ok(opened)
}

/// The cameras of a file, if there is one.
pub(super) fn load_cameras(options: &InputOptions, path: Option<&Path>) -> Result<Option<Rig>> {
    let camera_options = CameraOptions { size: options.size, frames: options.frames };
    path.map(|path| cameras::load(path, &camera_options)).transpose()
}

/// Opens an input and the cameras that look at it.
pub fn open_scene(options: &InputOptions) -> Result<Scene> {
    scene_of(open_input(options)?, options)
}

/// An open input as the cameras of the split that `options` name see it.
pub(super) fn scene_of(opened: Opened, options: &InputOptions) -> Result<Scene> {
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
    if scene.schedule.pairs() == 0 && !scene.input.source().info().times.is_empty() {
        return Err(Error::usage(format!("{}: no picture in this split (--split)", scene.rig.origin)));
    }
    Ok(Scene { has_cameras, scratch: options.scratch.clone(), notes, ..scene })
}

/// Frames of a model for which neither cameras nor the user name any.
const DEFAULT_FRAMES: usize = 60;
/// Most frames a model is evaluated at; each costs 8 bytes before any work.
const MAX_FRAMES: usize = 1_000_000;

fn camera_path(options: &InputOptions, input: &Input) -> Option<PathBuf> {
    options.cameras.clone().or_else(|| match input {
        Input::Model(model) => cameras::find(model.config().source_path.as_deref()?, &options.path),
        _ => None,
    })
}

/// A rig around the robust middle of the first frame.
fn virtual_rig(source: &dyn FrameSource) -> Result<Rig> {
    if source.info().times.is_empty() {
        return Ok(cameras::virtual_rig(DVec3::ZERO, 1.0));
    }
    let state = gather_all(source, 0, Columns::POSITION)?;
    let bounds = RobustBox::of(&state.position);
    Ok(cameras::virtual_rig(bounds.middle, bounds.extent()))
}

impl Input {
    /// Opens a path by what it is.
    pub fn open(path: &Path, iteration: Option<u32>) -> Result<Input> {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
        let meta = std::fs::metadata(path).map_err(Error::io("open", path))?;
        let input = if meta.is_dir() {
            if path.join("cfg_args").exists() || path.join("point_cloud").is_dir() {
                return Ok(Input::Model(ModelFolder::open(path, iteration)?));
            }
            Input::Frames(PlySequence::open(path)?)
        } else if extension == "ply" {
            Input::Frames(PlySequence::single(path)?)
        } else if extension == "gseq" {
            Input::Container(Container::open(path)?)
        } else {
            return Err(Error::input(
                path,
                "",
                "a 4DGaussians model folder, a folder of PLY files, a .ply or a .gseq",
                "another kind of file",
            ));
        };
        match iteration {
            Some(_) => Err(Error::usage(format!("{}: --iteration is for model folders", path.display()))),
            None => Ok(input),
        }
    }

    /// Its frames.
    pub fn source(&self) -> &dyn FrameSource {
        match self {
            Input::Model(model) => model,
            Input::Frames(frames) => frames,
            Input::Container(container) => container,
            Input::Stream(streamed) => &streamed.container,
        }
    }

    /// Scales before any deformation, of an input that has such.
    pub fn canonical_log_scale(&self) -> Option<&Column> {
        match self {
            Input::Model(model) => Some(&model.canonical().log_scale),
            _ => None,
        }
    }

    /// What it is, for people.
    pub fn kind(&self) -> &'static str {
        match self {
            Input::Model(_) => "4DGaussians model",
            Input::Frames(_) => "PLY frames",
            Input::Container(_) => "gseq container",
            Input::Stream(_) => "frame stream",
        }
    }

    /// Hash over the bytes read.
    pub fn digest(&self) -> Result<String> {
        match self {
            Input::Model(model) => model.paths().digest(),
            Input::Frames(frames) => frames.digest(),
            Input::Container(container) => Ok(container.digest()),
            Input::Stream(streamed) => Ok(streamed.container.digest()),
        }
    }

    /// What the summary says of it.
    pub fn summary(&self, path: &Path) -> Result<InputSummary> {
        let info = self.source().info();
        Ok(InputSummary {
            path: path.display().to_string(),
            kind: self.kind(),
            digest: self.digest()?,
            gaussians: info.count,
            frames: Some(info.times.len()),
            sh_degree: info.sh_degree,
            varying: info.varying.iter().map(Columns::name).collect(),
            bytes: self.bytes()?,
        })
    }

    /// Bytes of the files that grow with the Gaussians; of a stream, those that arrived.
    pub fn bytes(&self) -> Result<u64> {
        let paths: Vec<&Path> = match self {
            Input::Model(model) => vec![&model.paths().point_cloud],
            Input::Frames(frames) => frames.paths().iter().map(PathBuf::as_path).collect(),
            Input::Container(container) => vec![container.path()],
            Input::Stream(streamed) => return Ok(streamed.received),
        };
        paths.iter().map(|path| Ok(std::fs::metadata(path).map_err(Error::io("read", path))?.len())).sum()
    }
}
