//! Reads `cameras.json`, a file name that is used for two formats.
//!
//! *This project's*, one entry per image:
//!
//! ```json
//! { "background": [1, 1, 1],
//!   "frames": [ { "v": 0, "time": 0.0, "split": "train", "image": "train/t000_v00.png",
//!                 "width": 288, "height": 288, "fx": 347.6, "fy": 347.6, "cx": 144, "cy": 144,
//!                 "w2c": [[1,0,0,0],[0,1,0,0],[0,0,1,3],[0,0,0,1]] } ] }
//! ```
//!
//! `w2c` is world to camera, row-major, OpenCV axes. Focal lengths and the principal point are in pixels; the middle of
//! the image is at `width / 2`. Optional keys: `background` (linear RGB in [0, 1]), `v` (view number; default: one per
//! distinct camera), `time` (default: every frame), `split` (`train`, `val` or `test`; default: train), `image`
//! (relative to the file). Other keys are ignored.
//!
//! *3DGS's*, one entry per camera, written beside a trained model: `width`, `height`, `fx`, `fy`, `position` (of the
//! camera), `rotation` (camera to world, row-major, OpenCV axes), `img_name`. The file has no times, so each camera
//! sees every frame unless `--times` gives times. It does not distinguish test from training views, so all views are
//! training views.

use std::path::Path;

use super::CameraOptions;
use super::assemble::{ListedImage, RigBuilder, from_camera_to_world, view_in_name};
use super::fields::{CameraFields, elements, place, read_camera_text};
use super::times::{self, TimesSource};
use crate::error::Result;
use crate::files::names::shown_name;
use crate::limits::ReadLimit;
use crate::model::{Camera, Rig, Split};

/// Reads the cameras of `file`, a `cameras.json` in this project's own format.
pub(super) fn load_per_image(file: &Path, memory: ReadLimit) -> Result<Rig> {
    let mut builder = RigBuilder::new(memory);
    let text = read_camera_text(file, builder.memory_counter())?;
    let shared = CameraFields::new(file, None, &text)?;
    let background = shared.optional_vector("background")?;
    if background.is_some_and(|rgb| rgb.iter().any(|c| !(0.0..=1.0).contains(c))) {
        return Err(shared.wrong("background", "red, green and blue from 0 to 1"));
    }
    let images = shared.list("frames", builder.memory_counter())?;
    builder.begin_file(file, images.len())?;
    for (index, image) in images.into_iter().enumerate() {
        builder.add(per_image(file, &CameraFields::new(file, Some(index), image.get())?)?)?;
    }
    let background = background.map(|rgb| rgb.map(|c| c as f32));
    builder.finish(background, shown_name(file))
}

/// Builds a list entry of one image (camera, time, split, path) from `fields`, the JSON object of this image in a
/// `cameras.json` in this project's own format.
fn per_image(file: &Path, fields: &CameraFields<'_>) -> Result<ListedImage> {
    let (rotation, translation) = fields.pose("w2c")?;
    let split = match fields.optional_text("split")?.as_deref() {
        None | Some("train") => Split::Train,
        Some("test") => Split::Test,
        Some("val") => Split::Val,
        Some(_) => return Err(fields.wrong("split", "\"train\", \"val\" or \"test\"")),
    };
    let camera = Camera {
        width: fields.side("width")?,
        height: fields.side("height")?,
        fx: fields.number("fx")?,
        fy: fields.number("fy")?,
        cx: fields.number("cx")?,
        cy: fields.number("cy")?,
        rotation,
        translation,
        near: Camera::NEAR,
    };
    Ok(ListedImage {
        camera,
        time: fields.optional_number("time")?,
        split,
        image: fields.optional_text("image")?.map(|name| file.with_file_name(name)),
        view: fields.optional_index("v")?,
    })
}

/// Reads the `cameras.json` of a 3DGS model folder, a list of cameras.
pub(super) fn load_per_camera(file: &Path, options: &CameraOptions) -> Result<Rig> {
    let mut builder = RigBuilder::new(options.memory);
    let text = read_camera_text(file, builder.memory_counter())?;
    let cameras = elements(file, &text, builder.memory_counter())?;
    builder.begin_file(file, cameras.len())?;
    let mut origin = shown_name(file);
    let mut times = Vec::new();
    if options.times != TimesSource::Own {
        let mut names: Vec<Box<str>> = Vec::new();
        for (index, camera) in cameras.iter().enumerate() {
            let name = CameraFields::new(file, Some(index), camera.get())?.optional_text("img_name")?;
            let name = name.unwrap_or_default();
            builder.memory_counter().take(file, &place(Some(index)), "the names of images", name.len() as u64 + 96)?;
            names.push(name.into());
        }
        let (given, source) = times::resolve(file, &names, &options.times, builder.memory_counter())?;
        origin += &format!(" ({source})");
        times = given;
    }
    for (index, camera) in cameras.into_iter().enumerate() {
        let time = times.get(index).copied().flatten();
        let fields = CameraFields::new(file, Some(index), camera.get())?;
        builder.add(ListedImage { time, ..per_camera(file, &fields)? })?;
    }
    builder.finish(None, origin)
}

/// Builds a list entry of one image from `fields`, the JSON object of one camera in a `cameras.json` of 3DGS. The list
/// entry holds the camera, the path of the image file and the view number, but no time.
fn per_camera(file: &Path, fields: &CameraFields<'_>) -> Result<ListedImage> {
    let size @ (width, height) = (fields.side("width")?, fields.side("height")?);
    let intrinsics = [fields.number("fx")?, fields.number("fy")?, 0.5 * f64::from(width), 0.5 * f64::from(height)];
    let name = fields.optional_text("img_name")?;
    Ok(ListedImage {
        camera: from_camera_to_world(size, intrinsics, fields.matrix3("rotation")?, fields.vector("position")?),
        time: None,
        split: Split::Train,
        image: name.as_deref().map(|name| file.with_file_name(name)),
        view: name.as_deref().and_then(view_in_name),
    })
}
