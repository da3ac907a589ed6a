//! Pictures of an input, as files.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::TOOL;
use crate::cache::{Completion, Spill, SpillWriter};
use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::{Kind, MARKER, Replace, StagedFile, StagedFolder, check_target};
use crate::files::image::write::{ImageFormat, image_bytes, write_image};
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::model::{Camera, FrameView};
use crate::outputs::kind::check_folder_name;
use crate::passes::{Batch, RenderedSource, ViewStates, show};
use crate::pipeline::summary::{CameraSummary, InputSummary};
use crate::progress::Events;
use crate::render::Image;
use crate::scene::pictures::{self, ViewSet, background, picture, pictures};
use crate::scene::{InputOptions, open_scene};
use crate::source::FrameSource;

/// What rendering is called.
const NAME: &str = "render";

/// Which pictures to render.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RenderSelection {
    /// One, into a file whose name says its format.
    One {
        /// Frame of the sequence.
        frame: usize,
        /// View number.
        view: u32,
    },
    /// All of the part, into a folder, named `tNNN_vNN`.
    All(ImageFormat),
}

/// What to render.
#[derive(Debug, Clone)]
pub struct RenderOptions {
    /// What to read; of its split nothing is used.
    pub input: InputOptions,
    /// Which pictures.
    pub wanted: RenderSelection,
    /// Part of the cameras' pictures they are among.
    pub part: ViewSet,
    /// Red, green, blue in [0, 1]; none: see [`background`].
    pub background: Option<[f32; 3]>,
    /// File or folder to write.
    pub output: PathBuf,
    /// Replace an earlier output.
    pub overwrite: Replace,
}

/// What was rendered.
#[derive(Debug)]
pub struct Rendered {
    /// Number of pictures.
    pub pictures: usize,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// Renders pictures of an input.
///
/// Memory: one frame's state, and per thread one picture with its footprints ([`crate::scene::pictures::need`]).
///
/// # Errors
/// Whatever is wrong with input, cameras, choice or output. Nothing is left behind then.
pub fn render(options: &RenderOptions) -> Result<Completion<Rendered>> {
    Completion::from_result(render_whole(options))
}

fn render_whole(options: &RenderOptions) -> Result<Rendered> {
    let output = options.output.as_path();
    let (kind, format) = match options.wanted {
        RenderSelection::All(format) => {
            check_folder_name(output, "--all")?;
            (Kind::Folder, format)
        }
        RenderSelection::One { .. } => (Kind::File, format_of(output)?),
    };
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    check_target(output, kind, &inputs, options.overwrite)?;
    if options.input.work.is_some() && kind == Kind::File {
        return Err(Error::usage("--cache: one picture is not divided; expected --all"));
    }
    let mut scene = open_scene(&InputOptions { split: None, ..options.input.clone() })?;
    scene.keep_to(options.input.memory, |work, limits| needs(work, limits, options.input.work.is_some()))?;
    let source = scene.source();
    let times = &source.info().times;
    let background = background(options.background, &scene)?;
    let chosen = match options.wanted {
        RenderSelection::One { frame, view } => vec![picture(&scene.rig, times, options.part, frame, view)?],
        RenderSelection::All(_) => pictures(&scene.rig, times, options.part)?,
    };
    let job = RenderJob {
        source,
        cameras: &scene.rig.cameras,
        limits: scene.limits,
        background,
        format,
        events: &scene.events,
    };
    if kind == Kind::File {
        let staged = StagedFile::new(output, options.overwrite)?;
        job.write(&chosen, |_| staged.path().to_owned())?;
        staged.commit()?;
    } else {
        let name = |picture: &FrameView| format!("{}.{}", picture.name(), format.extension());
        let staged = if scene.work.keeps() {
            let key = scene.work.key(&(&chosen, background, format.extension()));
            let make = |some: Range<usize>, to: &mut SpillWriter| job.spill(&chosen[some], to);
            let spills = scene.work.sharded_spill(NAME, key, chosen.len(), &scene.scratch, make)?;
            scene.work.end_shard_before("writing")?;
            let staged = StagedFolder::new(output, options.overwrite)?;
            for (some, spill) in spills {
                write_spilled(&chosen[some], &spill, |picture| staged.path().join(name(picture)))?;
            }
            staged
        } else {
            let staged = StagedFolder::new(output, options.overwrite)?;
            job.write(&chosen, |picture| staged.path().join(name(picture)))?;
            staged
        };
        let marker = serde_json::json!({
            "tool": TOOL,
            "input": InputSummary::new(&*scene.input, &scene.path, scene.digest()?)?.without_folders(),
            "cameras": CameraSummary {
                origin: scene.rig.origin.clone(),
                cameras: scene.rig.cameras.len(),
                pairs: chosen.len(),
            },
            "background": background,
        });
        let path = staged.path().join(MARKER);
        fs::write(&path, format!("{marker:#}\n")).map_err(Error::io("write", &path))?;
        staged.commit()?;
    }
    let notes = scene.notes.into_iter().chain(scene.work.take_notes()).collect();
    Ok(Rendered { pictures: chosen.len(), notes })
}

/// What it takes to make pictures of a model; `waiting`: the files of those that are made together wait to be written.
fn needs(work: &Workload, limits: &Limits, waiting: bool) -> Vec<ResourceEstimate> {
    vec![pictures::need(work, limits, NAME, 1, if waiting { 24 } else { 12 })]
}

fn format_of(output: &Path) -> Result<ImageFormat> {
    ImageFormat::from_path(output).ok_or_else(|| {
        Error::usage(format!(
            "{}: expected a name that ends in .png or .npy\n  for every picture into a folder, say --all",
            output.shown()
        ))
    })
}

/// Rendering into files.
struct RenderJob<'a> {
    source: &'a dyn FrameSource,
    cameras: &'a [Camera],
    limits: Limits,
    background: [f32; 3],
    format: ImageFormat,
    events: &'a Events,
}

impl RenderJob<'_> {
    fn write(&self, pictures: &[FrameView], path: impl Fn(&FrameView) -> PathBuf + Sync) -> Result<()> {
        self.make(pictures, |picture, image| write_image(image, self.format, &path(&picture)), |()| Ok(()))
    }

    /// Writes a record of the file of each of `pictures`, in order.
    fn spill(&self, pictures: &[FrameView], to: &mut SpillWriter) -> Result<()> {
        let encode = |picture: FrameView, image: &Image| {
            let named = PathBuf::from(format!("{}.{}", picture.name(), self.format.extension()));
            image_bytes(image, self.format).map_err(Error::io("make", &named))
        };
        self.make(pictures, encode, |bytes| to.write_record(&bytes))
    }

    /// Has `of_each` do something with each of `pictures`, from any thread, and `then` with what comes of it, in order.
    fn make<T: Send>(
        &self,
        pictures: &[FrameView],
        of_each: impl Fn(FrameView, &Image) -> Result<T> + Sync,
        mut then: impl FnMut(T) -> Result<()>,
    ) -> Result<()> {
        let progress = self.events.task(NAME, "pictures", pictures.len() as u64);
        show([RenderedSource::all(self.source)], self.cameras, pictures, Batch::of_frame(&self.limits), |views| {
            // Tasks within a picture too: a frame may have fewer pictures than there are threads.
            let made = views.par_iter().map(|view: &ViewStates<'_, 1>| {
                let made = of_each(view.picture, &view.render(0, self.background))?;
                progress.advance(1);
                Ok(made)
            });
            made.collect::<Result<Vec<T>>>()?.into_iter().try_for_each(&mut then)
        })
    }
}

/// Writes the files that [`RenderJob::spill`] has made of `pictures`, one at a time.
fn write_spilled(pictures: &[FrameView], spill: &Spill, path: impl Fn(&FrameView) -> PathBuf) -> Result<()> {
    let (mut at, mut bytes) = (0, Vec::new());
    for picture in pictures {
        at = spill.read_record(at, &mut bytes)?;
        let path = path(picture);
        fs::write(&path, &bytes).map_err(Error::io("write", &path))?;
    }
    Ok(())
}
