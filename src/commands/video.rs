//! Command `render --video`: renders a video of an input from one view or along a camera path, beside another model if
//! one is given.
//!
//! Frames are read one by one. Memory holds one frame state of each model, and at most one render of each per thread.

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::{Replace, StagedFile, TargetKind, check_target};
use crate::limits::Limits;
use crate::memory_plan::ResourceEstimate;
use crate::model::{Camera, FrameView, Rig, RigView};
use crate::outputs::film::{FilmFormat, FilmOutput};
use crate::passes::{BatchLimits, RenderableView, RenderedSource, for_each_view_batch};
use crate::progress::Events;
use crate::render::Image;
use crate::scene::camera_path::cameras_along;
use crate::scene::view_selection::{self, ViewSet, render_background};
use crate::scene::{InputOptions, OpenedInput, check_compressed, from_input, open_compressed, open_input};

/// Name of the rendering stage, for progress.
const NAME: &str = "render";
/// Number of video frames from one camera of a path to the next, for a still (a model without motion).
const VIEWS_BETWEEN_STOPS: usize = 24;

/// Camera or camera path from which a video is rendered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum VideoCamera {
    /// Camera of the view with this number, which may move over time; `None`: the view with the lowest number.
    View(Option<u32>),
    /// Path through the cameras of the views with these numbers, in this order. If the list is empty: path through the
    /// cameras of all views, by increasing view number.
    Path(Vec<u32>),
}

/// Options of the command `render --video`.
#[derive(Debug, Clone)]
pub struct VideoOptions {
    /// Input and cameras. The split that these options request is ignored: the field `views` selects the views. The
    /// options may request frames at other times than those of the cameras.
    pub input: InputOptions,
    /// Path of another model with the same frames, which is shown to the right of the input; `None`: the video shows
    /// the input alone.
    pub beside: Option<PathBuf>,
    /// Camera or camera path of the video.
    pub path: VideoCamera,
    /// Set of views from which `path` selects, for example the test views.
    pub views: ViewSet,
    /// Frames per second, at least 1.
    pub fps: u32,
    /// Background color: red, green, blue in [0, 1]; `None`: the background color of the scene (see
    /// [`render_background`]).
    pub background: Option<[f32; 3]>,
    /// Path of the output file; its extension gives the video format.
    pub output: PathBuf,
    /// Policy for an output path that already exists.
    pub overwrite: Replace,
}

/// Result of rendering a video.
#[derive(Debug)]
pub struct VideoReport {
    /// Number of video frames.
    pub frames: usize,
    /// Width and height of the video, pixels.
    pub size: (u32, u32),
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Renders a video of an input, with one image per frame of the model, in order. Exception: if a camera path leads
/// through a still (a model without motion), the video has a fixed number of images from each camera of the path to the
/// next. Returns the number and the size of the video frames.
///
/// # Errors
/// Fails if inputs or cameras cannot be read, if a selected view does not exist, if the models have different frames,
/// if the views have different sizes, if the output cannot be written, or if the encoder is missing or fails. Leaves no
/// partial output.
pub fn video(options: &VideoOptions) -> Result<VideoReport> {
    let output = options.output.as_path();
    let format = FilmFormat::from_path(output)?;
    if options.input.work.is_some() {
        return Err(Error::usage(
            "--cache: a video cannot be divided into shards\n  leave out --cache, or use --all, which renders views in shards",
        ));
    }
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    inputs.extend(options.beside.as_deref());
    check_target(output, TargetKind::File, &inputs, options.overwrite)?;
    options.beside.as_deref().map_or(Ok(()), check_compressed)?;

    let mut opened = open_input(&InputOptions { split: None, ..options.input.clone() })?;
    let own = views_with_times(&mut opened, options.input.frames.is_some());
    let mut scene = from_input(opened, &InputOptions { split: None, ..options.input.clone() })?;
    let beside = options.beside.as_deref().map(|path| open_compressed(path, &scene, &options.input)).transpose()?;
    let (beside, note) = beside.unzip();
    scene.notes.extend(note.flatten());
    let models = 1 + u64::from(beside.is_some());
    scene.plan_memory(options.input.memory, |work, limits: &Limits| -> Vec<ResourceEstimate> {
        // Bytes per pixel and model, besides the render: the joined frame (12), its 8-bit values (3) and, for a GIF,
        // the samples of its palette (5).
        let mut estimate = view_selection::render_estimate(work, limits, NAME, models, models * 12);
        estimate.fixed.push(("frame", models * work.pixels * (12 + 3 + 5)));
        vec![estimate]
    })?;
    let background = render_background(options.background, &scene)?;
    let rig_views = rig_views(own.as_deref().unwrap_or(&scene.rig.views), &scene.rig, options.views)?;
    let (cameras, views) = plan_views(&options.path, &rig_views, &scene.rig, &scene.source().info().times)?;
    let size = common_size(&cameras)?;
    let size = (size.0 * models as u32, size.1);

    let staged = StagedFile::new(output, options.overwrite)?;
    let mut film = FilmOutput::create((staged.path(), output), &format, size, views.len() as u32, options.fps)?;
    let source = FilmSource {
        cameras: &cameras,
        views: &views,
        limits: &scene.limits,
        background,
        gap: 0,
        events: &scene.events,
    };
    match &beside {
        None => source.film([RenderedSource::all_gaussians(scene.source())], &mut film)?,
        Some(other) => source.film([scene.source(), other.source()].map(RenderedSource::all_gaussians), &mut film)?,
    }
    film.finish()?;
    staged.commit()?;
    Ok(VideoReport { frames: views.len(), size, notes: scene.notes })
}

/// Removes the times from the views (pairs of a camera and a time) of `opened`, so that every camera can show every
/// frame. Returns a copy of the views with their times. `has_other_frames`: whether the user requested frames at other
/// times than those of the cameras. If not, or if there are no cameras, changes nothing and returns `None`.
fn views_with_times(opened: &mut OpenedInput, has_other_frames: bool) -> Option<Vec<RigView>> {
    let rig = opened.rig.as_mut().filter(|_| has_other_frames)?;
    let own = rig.views.clone();
    rig.views.iter_mut().for_each(|rig_view| rig_view.time = None);
    Some(own)
}

/// Returns the views (pairs of a camera and a time) in `all` that belong to the set `views`, sorted by view number,
/// then by time; views without a time come first. Fails if there are none.
fn rig_views(all: &[RigView], rig: &Rig, views: ViewSet) -> Result<Vec<RigView>> {
    let split = views.split(rig);
    let mut found: Vec<RigView> =
        all.iter().filter(|rig_view| split.is_none_or(|split| split == rig_view.split)).cloned().collect();
    let time = |rig_view: &RigView| rig_view.time.unwrap_or(f64::NEG_INFINITY);
    found.sort_by(|a, b| a.view.cmp(&b.view).then(time(a).total_cmp(&time(b))));
    match found.is_empty() {
        true => {
            Err(Error::usage(format!("{}: expected at least one view in this split (--split), found none", rig.origin)))
        }
        false => Ok(found),
    }
}

/// Plans a video of `rig_views` (pairs of a camera and a time). Returns the cameras of the video and, for each image in
/// order, the frame of the model and the index of its camera. `times`: times of the frames.
/// - For one view: one image per frame, from the camera of this view whose time is nearest.
/// - For a path: one new camera per image, on a path through the cameras of the views that `path` lists.
fn plan_views(
    path: &VideoCamera,
    rig_views: &[RigView],
    rig: &Rig,
    times: &[f64],
) -> Result<(Vec<Camera>, Vec<FrameView>)> {
    match path {
        VideoCamera::View(view) => {
            let view = view.unwrap_or_else(|| rig_views.first().map_or(0, |rig_view| rig_view.view));
            let own = views_with_number(rig_views, view, "--view", rig)?;
            let time_distance = |rig_view: &RigView, time: f64| rig_view.time.map_or(0.0, |at| (at - time).abs());
            let nearest =
                |time: f64| own.iter().min_by(|a, b| time_distance(a, time).total_cmp(&time_distance(b, time)));
            let camera = |&time: &f64| nearest(time).map_or(0, |rig_view| rig_view.camera);
            let film_view = |(frame, time)| FrameView { frame, view, camera: camera(time) };
            Ok((rig.cameras.clone(), times.iter().enumerate().map(film_view).collect()))
        }
        VideoCamera::Path(views) => {
            let all = || rig_views.chunk_by(|a, b| a.view == b.view).map(|rig_views| rig_views[0].view).collect();
            let views: Vec<u32> = if views.is_empty() { all() } else { views.clone() };
            if views.len() < 2 {
                return Err(Error::usage(format!(
                    "--path: expected two views or more, found {} in {}\n  --split all takes the views of all splits; \
                     --path 0,2,5 goes through these",
                    views.len(),
                    rig.origin
                )));
            }
            let stop = |&view: &u32| {
                Ok(rig.cameras[views_with_number(rig_views, view, "--path", rig)?[0].camera as usize].clone())
            };
            let stops = views.iter().map(stop).collect::<Result<Vec<Camera>>>()?;
            common_size(&stops)?;
            let count = if times.len() > 1 { times.len() } else { VIEWS_BETWEEN_STOPS * (stops.len() - 1) + 1 };
            let film_view = |k: usize| FrameView { frame: k.min(times.len() - 1), view: 0, camera: k as u32 };
            Ok((cameras_along(&stops, count), (0..count).map(film_view).collect()))
        }
    }
}

/// Returns the views (pairs of a camera and a time) with the view number `view`. `rig_views` must be sorted by view
/// number. Fails if there is no such view; the message names the command line option `flag`.
fn views_with_number<'a>(rig_views: &'a [RigView], view: u32, flag: &str, rig: &Rig) -> Result<&'a [RigView]> {
    let mut views = rig_views.chunk_by(|a, b| a.view == b.view);
    views.find(|rig_views| rig_views[0].view == view).ok_or_else(|| {
        let views: Vec<String> =
            rig_views.chunk_by(|a, b| a.view == b.view).map(|rig_views| rig_views[0].view.to_string()).collect();
        Error::usage(format!("{flag} {view}: expected one of the views {} ({})", views.join(", "), rig.origin))
    })
}

/// Returns the image size that all `cameras` share: width and height, pixels. Fails if two sizes differ.
fn common_size(cameras: &[Camera]) -> Result<(u32, u32)> {
    let size = |camera: &Camera| (camera.width, camera.height);
    let first = cameras.first().map_or((0, 0), size);
    match cameras.iter().map(size).find(|&other| other != first) {
        None => Ok(first),
        Some(other) => Err(Error::usage(format!(
            "a video needs views of one size, found {}x{} and {}x{}\n  choose a view \
             (--view), or views of one size (--path 0,2,5)",
            first.0, first.1, other.0, other.1
        ))),
    }
}

/// Cameras, views and settings from which the frames of a video are rendered.
pub(crate) struct FilmSource<'a> {
    pub(crate) cameras: &'a [Camera],
    pub(crate) views: &'a [FrameView],
    pub(crate) limits: &'a Limits,
    pub(crate) background: [f32; 3],
    /// Width of the white line between the renders of two models, pixels.
    pub(crate) gap: u32,
    pub(crate) events: &'a Events,
}

impl FilmSource<'_> {
    /// Renders each view with every model in `subjects`, joins the renders of a view from left to right, and adds the
    /// joined images to `film` in order.
    pub(crate) fn film<const S: usize>(&self, subjects: [RenderedSource<'_>; S], film: &mut FilmOutput) -> Result<()> {
        let progress = self.events.task(NAME, "frames", self.views.len() as u64);
        for_each_view_batch(subjects, self.cameras, self.views, BatchLimits::one_frame(self.limits), |views| {
            let images: Vec<Image> = views
                .par_iter()
                .map(|view: &RenderableView<'_, S>| {
                    let renders = (0..S).into_par_iter().map(|subject| view.render(subject, self.background));
                    side_by_side(renders.collect(), self.gap)
                })
                .collect();
            images.iter().try_for_each(|image| {
                progress.advance(1);
                film.add_frame(image)
            })
        })
    }
}

/// Joins images of the same size from left to right, with a white line of `gap` pixels between two images, and returns
/// the joined image.
fn side_by_side(images: Vec<Image>, gap: u32) -> Image {
    let (width, height) = images.first().map_or((0, 0), |image| (image.width, image.height));
    let line = vec![1.0; 3 * gap as usize];
    let mut data = Vec::new();
    for y in 0..height as usize {
        for (k, image) in images.iter().enumerate() {
            if k > 0 {
                data.extend_from_slice(&line);
            }
            let row = 3 * width as usize;
            data.extend_from_slice(&image.data[y * row..(y + 1) * row]);
        }
    }
    let count = images.len() as u32;
    Image { width: width * count + gap * count.saturating_sub(1), height, data }
}

/// Returns a line of text that says which of two models a video shows on the left and which on the right.
pub fn left_right_legend(left: &Path, right: &Path) -> String {
    format!("left: {}; right: {}", left.shown(), right.shown())
}
