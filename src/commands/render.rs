//! Command `render`: renders views of an input to image files.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::TOOL;
use crate::cache::{Completion, Spill, SpillWriter};
use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::{Replace, StagedFile, StagedFolder, TargetKind, check_target, write_summary};
use crate::files::image::write::{ImageFormat, image_bytes, write_image};
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::model::{Camera, FrameView};
use crate::outputs::kind::check_folder_name;
use crate::passes::{BatchLimits, RenderableView, RenderedSource, for_each_view_batch};
use crate::pipeline::summary::{CameraSummary, InputSummary};
use crate::progress::Events;
use crate::render::Image;
use crate::scene::view_selection::{self, ViewSet, render_background, select_view, select_views};
use crate::scene::{InputOptions, open_scene};
use crate::source::FrameSource;

/// Name of the rendering stage, for progress and cache entries.
const NAME: &str = "render";

/// Selection of the views to render.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RenderSelection {
    /// One view at one frame, written to a file whose extension gives the image format.
    One {
        /// Index of the frame in the sequence.
        frame: usize,
        /// View number of the camera, as in the list of cameras.
        view: u32,
    },
    /// Every view of [`RenderOptions::views`], written to a folder in this image format, as files named `tNNN_vNN`
    /// (frame, view).
    All(ImageFormat),
}

/// Options of the command `render`.
#[derive(Debug, Clone)]
pub struct RenderOptions {
    /// Input and cameras. The split that these options request is ignored: the field `views` selects the views.
    pub input: InputOptions,
    /// Selection of the views to render from the set `views`.
    pub selection: RenderSelection,
    /// Set of views from which `selection` selects, for example the test views.
    pub views: ViewSet,
    /// Background color: red, green, blue in [0, 1]; `None`: the background color of the scene (see
    /// [`render_background`]).
    pub background: Option<[f32; 3]>,
    /// Path of the output file or folder.
    pub output: PathBuf,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
}

/// Result of the command `render`.
#[derive(Debug)]
pub struct RenderReport {
    /// Number of rendered views.
    pub views: usize,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Renders views of an input to image files. Returns the number of rendered views; if the run is limited to one shard
/// (part of a divided stage), returns a report about this shard.
///
/// Memory: one frame state, and for each thread one render with its projected Gaussians
/// ([`crate::scene::view_selection::render_estimate`]).
///
/// # Errors
/// Fails if input or cameras cannot be read, if a selected view does not exist, or if the output exists already or
/// cannot be written. Leaves no partial output.
pub fn render(options: &RenderOptions) -> Result<Completion<RenderReport>> {
    Completion::from_result(render_whole(options))
}

/// Renders views to image files, as [`render`] does, and returns the report. If the run computes only one shard (part
/// of a divided stage), it ends with the error [`Error::ShardDone`].
fn render_whole(options: &RenderOptions) -> Result<RenderReport> {
    let output = options.output.as_path();
    let (kind, format) = match options.selection {
        RenderSelection::All(format) => {
            check_folder_name(output, "--all")?;
            (TargetKind::Folder, format)
        }
        RenderSelection::One { .. } => (TargetKind::File, format_of(output)?),
    };
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    check_target(output, kind, &inputs, options.overwrite)?;
    if options.input.work.is_some() && kind == TargetKind::File {
        return Err(Error::usage("--cache: expected --all, found a single view, which cannot be divided into shards"));
    }
    let mut scene = open_scene(&InputOptions { split: None, ..options.input.clone() })?;
    scene.plan_memory(options.input.memory, |work, limits| estimates(work, limits, options.input.work.is_some()))?;
    let source = scene.source();
    let times = &source.info().times;
    let background = render_background(options.background, &scene)?;
    let chosen = match options.selection {
        RenderSelection::One { frame, view } => vec![select_view(&scene.rig, times, options.views, frame, view)?],
        RenderSelection::All(_) => select_views(&scene.rig, times, options.views)?,
    };
    let job = RenderJob {
        source,
        cameras: &scene.rig.cameras,
        limits: scene.limits,
        background,
        format,
        events: &scene.events,
    };
    if kind == TargetKind::File {
        let staged = StagedFile::new(output, options.overwrite)?;
        job.write(&chosen, |_| staged.path().to_owned())?;
        staged.commit()?;
    } else {
        let name = |view: &FrameView| format!("{}.{}", view.name(), format.extension());
        let staged = if scene.work.is_enabled() {
            let key = scene.work.key(&(&chosen, background, format.extension()));
            let make = |some: Range<usize>, to: &mut SpillWriter| job.spill(&chosen[some], to);
            let spills = scene.work.spill_in_shards(NAME, key, chosen.len(), &scene.scratch, make)?;
            scene.work.end_shard_run_before("writing")?;
            let staged = StagedFolder::new(output, options.overwrite)?;
            for (some, spill) in spills {
                write_spilled(&chosen[some], &spill, |view| staged.path().join(name(view)))?;
            }
            staged
        } else {
            let staged = StagedFolder::new(output, options.overwrite)?;
            job.write(&chosen, |view| staged.path().join(name(view)))?;
            staged
        };
        let summary = serde_json::json!({
            "tool": TOOL,
            "input": InputSummary::new(&*scene.input, &scene.path, scene.digest()?)?.without_folder_paths(),
            "cameras": CameraSummary {
                origin: scene.rig.origin.clone(),
                cameras: scene.rig.cameras.len(),
                pairs: chosen.len(),
            },
            "background": background,
        });
        write_summary(staged.path(), &summary)?;
        staged.commit()?;
    }
    let notes = scene.notes.into_iter().chain(scene.work.take_notes()).collect();
    Ok(RenderReport { views: chosen.len(), notes })
}

/// Returns the resource estimate (memory and time) of rendering. `keeps_files`: whether the encoded image files of a
/// batch of views stay in memory until they are written.
fn estimates(work: &Workload, limits: &Limits, keeps_files: bool) -> Vec<ResourceEstimate> {
    vec![view_selection::render_estimate(work, limits, NAME, 1, if keeps_files { 24 } else { 12 })]
}

/// Returns the image format that the extension of `output` gives; fails for extensions other than `.png` and `.npy`.
fn format_of(output: &Path) -> Result<ImageFormat> {
    ImageFormat::from_path(output).ok_or_else(|| {
        Error::usage(format!(
            "{}: expected a name that ends in .png or .npy\n  use --all to render every view to a folder",
            output.shown()
        ))
    })
}

/// Renderer of views to image files, with the settings that all views share.
struct RenderJob<'a> {
    source: &'a dyn FrameSource,
    cameras: &'a [Camera],
    limits: Limits,
    background: [f32; 3],
    format: ImageFormat,
    events: &'a Events,
}

impl RenderJob<'_> {
    /// Renders `views` and writes each render to the file whose path `path` returns for the view.
    fn write(&self, views: &[FrameView], path: impl Fn(&FrameView) -> PathBuf + Sync) -> Result<()> {
        self.for_each_view(views, |view, image| write_image(image, self.format, &path(&view)), |()| Ok(()))
    }

    /// Renders `views`, encodes each render as an image file, and writes the files to the temporary data `to` instead
    /// of the output folder: one record (length and bytes) per view, in order.
    fn spill(&self, views: &[FrameView], to: &mut SpillWriter) -> Result<()> {
        let encode = |view: FrameView, image: &Image| {
            let named = PathBuf::from(format!("{}.{}", view.name(), self.format.extension()));
            image_bytes(image, self.format).map_err(Error::io("make", &named))
        };
        self.for_each_view(views, encode, |bytes| to.write_record(&bytes))
    }

    /// Renders `views` in batches. Calls `render_one` with each view and its finished render, on any thread. After each
    /// batch, calls `take` with each value that `render_one` returned, in the order of the views.
    fn for_each_view<T: Send>(
        &self,
        views: &[FrameView],
        render_one: impl Fn(FrameView, &Image) -> Result<T> + Sync,
        mut take: impl FnMut(T) -> Result<()>,
    ) -> Result<()> {
        let progress = self.events.task(NAME, "views", views.len() as u64);
        for_each_view_batch(
            [RenderedSource::all_gaussians(self.source)],
            self.cameras,
            views,
            BatchLimits::one_frame(&self.limits),
            |batch| {
                // Renders are parallel inside too, because a frame can have fewer views than there are threads.
                let made = batch.par_iter().map(|view: &RenderableView<'_, 1>| {
                    let made = render_one(view.frame_view, &view.render(0, self.background))?;
                    progress.advance(1);
                    Ok(made)
                });
                made.collect::<Result<Vec<T>>>()?.into_iter().try_for_each(&mut take)
            },
        )
    }
}

/// Copies image files from the temporary data `spill` to files of their own. [`RenderJob::spill`] wrote them, one per
/// view of `views`, in order. `path` returns the path of the file for a view.
fn write_spilled(views: &[FrameView], spill: &Spill, path: impl Fn(&FrameView) -> PathBuf) -> Result<()> {
    let (mut at, mut bytes) = (0, Vec::new());
    for view in views {
        at = spill.read_record(at, &mut bytes)?;
        let path = path(view);
        fs::write(&path, &bytes).map_err(Error::io("write", &path))?;
    }
    Ok(())
}
