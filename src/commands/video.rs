//! A film of an input: one view along time, or a way through cameras; beside that of another model, if there is one.
//!
//! Frames stream: at a time one state of either model, and one picture of each for every thread at most.

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::error::{Error, Result, ShowPath};
use crate::files::atomic::{Kind, Replace, StagedFile, check_target};
use crate::limits::Limits;
use crate::memory_plan::ResourceEstimate;
use crate::model::{Camera, FrameView, Rig, Shot};
use crate::outputs::film::{FilmFormat, FilmOutput};
use crate::passes::{Batch, RenderedSource, ViewStates, show};
use crate::progress::Events;
use crate::render::Image;
use crate::scene::open_compressed;
use crate::scene::path::along;
use crate::scene::pictures::{self, ViewSet, background};
use crate::scene::{InputOptions, OpenedInput, from_input, open_input};

/// What rendering a film is called.
const NAME: &str = "render";
/// Pictures between two cameras of a way through a scene that stands still.
const STEPS: usize = 24;

/// From where a film is taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FilmPath {
    /// One view, wherever its camera is at a time; none: that of the lowest number.
    View(Option<u32>),
    /// Through the cameras of these views, in order; empty: of all, by number.
    Path(Vec<u32>),
}

/// What to film.
#[derive(Debug, Clone)]
pub struct VideoOptions {
    /// What to read; of its split nothing is used. Frames, if any, need not be those of the cameras.
    pub input: InputOptions,
    /// Another model of the same frames, to the right.
    pub beside: Option<PathBuf>,
    /// From where.
    pub way: FilmPath,
    /// Part of the cameras' pictures whose views count.
    pub part: ViewSet,
    /// Frames per second, at least 1.
    pub fps: u32,
    /// Red, green, blue in [0, 1]; none: see [`background`].
    pub background: Option<[f32; 3]>,
    /// File to write, whose name says its format.
    pub output: PathBuf,
    /// Replace an earlier file.
    pub overwrite: Replace,
}

/// What was filmed.
#[derive(Debug)]
pub struct Filmed {
    /// Frames of the film.
    pub frames: usize,
    /// Pixels across and down.
    pub size: (u32, u32),
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// Films an input: a picture for every frame, in order.
///
/// # Errors
/// Whatever is wrong with inputs, cameras, choice or output; models whose frames are not the same; an encoder that is not
/// there or fails. Nothing is left behind then.
pub fn video(options: &VideoOptions) -> Result<Filmed> {
    let output = options.output.as_path();
    let format = FilmFormat::from_path(output)?;
    if options.input.work.is_some() {
        return Err(Error::usage("--cache: a film is not divided; --all renders pictures in parts"));
    }
    let mut inputs = vec![options.input.path.as_path()];
    inputs.extend(options.input.cameras.as_deref());
    inputs.extend(options.beside.as_deref());
    check_target(output, Kind::File, &inputs, options.overwrite)?;

    let mut opened = open_input(&InputOptions { split: None, ..options.input.clone() })?;
    let own = own_shots(&mut opened, options.input.frames.is_some());
    let mut scene = from_input(opened, &InputOptions { split: None, ..options.input.clone() })?;
    let beside = options.beside.as_deref().map(|path| open_compressed(path, &scene, &options.input)).transpose()?;
    let models = 1 + u64::from(beside.is_some());
    scene.keep_to(options.input.memory, |work, limits: &Limits| -> Vec<ResourceEstimate> {
        // Two pictures, and the frame that they make up, with its bytes and, of a GIF, those that colors are chosen from.
        let mut need = pictures::need(work, limits, NAME, models, models * 12);
        need.fixed.push(("frame", models * work.pixels * (12 + 3 + 5)));
        vec![need]
    })?;
    let background = background(options.background, &scene)?;
    let shots = shots(own.as_deref().unwrap_or(&scene.rig.shots), &scene.rig, options.part)?;
    let (cameras, pictures) = plan(&options.way, &shots, &scene.rig, &scene.source().info().times)?;
    let size = one_size(&cameras)?;
    let size = (size.0 * models as u32, size.1);

    let staged = StagedFile::new(output, options.overwrite)?;
    let mut film = FilmOutput::create((staged.path(), output), &format, size, pictures.len() as u32, options.fps)?;
    let shown =
        FilmSource { cameras: &cameras, pictures: &pictures, limits: &scene.limits, background, events: &scene.events };
    match &beside {
        None => shown.film([RenderedSource::all(scene.source())], &mut film)?,
        Some(other) => shown.film([scene.source(), other.source()].map(RenderedSource::all), &mut film)?,
    }
    film.finish()?;
    staged.commit()?;
    Ok(Filmed { frames: pictures.len(), size, notes: scene.notes })
}

/// The shots with their times, where the frames are none of theirs: every camera may then look at every frame.
fn own_shots(opened: &mut OpenedInput, are_others: bool) -> Option<Vec<Shot>> {
    let rig = opened.rig.as_mut().filter(|_| are_others)?;
    let own = rig.shots.clone();
    rig.shots.iter_mut().for_each(|shot| shot.time = None);
    Some(own)
}

/// The shots of `part`, by view, then time, those without one first.
fn shots(all: &[Shot], rig: &Rig, part: ViewSet) -> Result<Vec<Shot>> {
    let split = part.split(rig);
    let mut found: Vec<Shot> =
        all.iter().filter(|shot| split.is_none_or(|split| split == shot.split)).cloned().collect();
    let time = |shot: &Shot| shot.time.unwrap_or(f64::NEG_INFINITY);
    found.sort_by(|a, b| a.view.cmp(&b.view).then(time(a).total_cmp(&time(b))));
    match found.is_empty() {
        true => Err(Error::usage(format!("{}: no picture in this split (--split)", rig.origin))),
        false => Ok(found),
    }
}

/// The cameras of the film and its pictures, one after the other.
fn plan(way: &FilmPath, shots: &[Shot], rig: &Rig, times: &[f64]) -> Result<(Vec<Camera>, Vec<FrameView>)> {
    match way {
        FilmPath::View(view) => {
            let view = view.unwrap_or_else(|| shots.first().map_or(0, |shot| shot.view));
            let own = of_view(shots, view, "--view", rig)?;
            let away = |shot: &Shot, time: f64| shot.time.map_or(0.0, |at| (at - time).abs());
            let nearest = |time: f64| own.iter().min_by(|a, b| away(a, time).total_cmp(&away(b, time)));
            let camera = |&time: &f64| nearest(time).map_or(0, |shot| shot.camera);
            let picture = |(frame, time)| FrameView { frame, view, camera: camera(time) };
            Ok((rig.cameras.clone(), times.iter().enumerate().map(picture).collect()))
        }
        FilmPath::Path(views) => {
            let all = || shots.chunk_by(|a, b| a.view == b.view).map(|of| of[0].view).collect();
            let views: Vec<u32> = if views.is_empty() { all() } else { views.clone() };
            if views.len() < 2 {
                return Err(Error::usage(format!(
                    "--path: expected two views or more, found {} in {}\n  --split all takes those of all pictures; \
                     --path 0,2,5 goes through these",
                    views.len(),
                    rig.origin
                )));
            }
            let stop = |&view: &u32| Ok(rig.cameras[of_view(shots, view, "--path", rig)?[0].camera as usize].clone());
            let stops = views.iter().map(stop).collect::<Result<Vec<Camera>>>()?;
            one_size(&stops)?;
            let count = if times.len() > 1 { times.len() } else { STEPS * (stops.len() - 1) + 1 };
            let picture = |k: usize| FrameView { frame: k.min(times.len() - 1), view: 0, camera: k as u32 };
            Ok((along(&stops, count), (0..count).map(picture).collect()))
        }
    }
}

/// The shots of a view.
fn of_view<'a>(shots: &'a [Shot], view: u32, flag: &str, rig: &Rig) -> Result<&'a [Shot]> {
    let mut views = shots.chunk_by(|a, b| a.view == b.view);
    views.find(|of| of[0].view == view).ok_or_else(|| {
        let views: Vec<String> = shots.chunk_by(|a, b| a.view == b.view).map(|of| of[0].view.to_string()).collect();
        Error::usage(format!("{flag} {view}: expected one of the views {} ({})", views.join(", "), rig.origin))
    })
}

/// The size of all pictures.
fn one_size(cameras: &[Camera]) -> Result<(u32, u32)> {
    let size = |camera: &Camera| (camera.width, camera.height);
    let first = cameras.first().map_or((0, 0), size);
    match cameras.iter().map(size).find(|&other| other != first) {
        None => Ok(first),
        Some(other) => Err(Error::usage(format!(
            "a film has pictures of one size, but its cameras take some of {}x{} and some of {}x{}\n  choose a view \
             (--view), or views of one size (--path 0,2,5)",
            first.0, first.1, other.0, other.1
        ))),
    }
}

/// What a film shows.
struct FilmSource<'a> {
    cameras: &'a [Camera],
    pictures: &'a [FrameView],
    limits: &'a Limits,
    background: [f32; 3],
    events: &'a Events,
}

impl FilmSource<'_> {
    fn film<const S: usize>(&self, subjects: [RenderedSource<'_>; S], film: &mut FilmOutput) -> Result<()> {
        let progress = self.events.task(NAME, "frames", self.pictures.len() as u64);
        show(subjects, self.cameras, self.pictures, Batch::of_frame(self.limits), |views| {
            let made: Vec<Image> = views
                .par_iter()
                .map(|view: &ViewStates<'_, S>| {
                    let of_models = (0..S).into_par_iter().map(|subject| view.render(subject, self.background));
                    side_by_side(of_models.collect())
                })
                .collect();
            made.iter().try_for_each(|image| {
                progress.advance(1);
                film.add(image)
            })
        })
    }
}

/// One image of several of one size, from left to right.
fn side_by_side(mut images: Vec<Image>) -> Image {
    if images.len() == 1 {
        return images.swap_remove(0);
    }
    let (width, height) = images.first().map_or((0, 0), |image| (image.width, image.height));
    let row = |y: usize| {
        let values = 3 * width as usize;
        images.iter().flat_map(move |image| image.data[y * values..(y + 1) * values].iter().copied())
    };
    let data = (0..height as usize).flat_map(row).collect();
    Image { width: width * images.len() as u32, height, data }
}

/// What stands where in a film of two models.
pub fn places(left: &Path, right: &Path) -> String {
    format!("left: {}; right: {}", left.shown(), right.shown())
}
