//! The page's films: how one or two views go on, before and after, with the difference, at some of the frames.
//!
//! In: pictures chosen to be looked at, and both models again. Out: JPEG files as data URIs. A page holds at most [`VIEWS`]
//! films of at most [`FRAMES`] frames, each with two images of at most [`MAX_PIXELS`] pixels and their difference: about 3 MB.

use std::io;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;

use super::shown::{ShownImage, brighter, difference, shrink, shrinkage};
use crate::error::{Error, Result};
use crate::evaluation::ModelPair;
use crate::files::image::write::jpeg_bytes;
use crate::memory_plan::Workload;
use crate::metrics::psnr;
use crate::model::FrameView;
use crate::render::Image;
use crate::scene::pictures::thin;

/// Views that are followed: that of the worst picture, and that of the median one if it is another.
pub const VIEWS: usize = 2;
/// Frames of a film, evenly from first to last.
pub const FRAMES: usize = 24;
/// A picture of more pixels is shown smaller.
pub const MAX_PIXELS: u64 = 90_000;
/// The same of differences, whose noise takes most bytes.
pub const MAX_PIXELS_OF_DIFFERENCE: u64 = 30_000;
/// Of 100.
pub const QUALITY: u8 = 80;

/// A film of the page.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FilmPanel {
    /// Why its view was chosen: "worst render", ...
    pub why: Vec<String>,
    /// View number.
    pub view: u32,
    /// Frame of the picture whose camera it is, for views whose camera moves.
    pub camera_of_frame: usize,
    /// Frames of the sequence, in order.
    pub frames: Vec<usize>,
    /// PSNR of compressed against original at each, in full size, dB.
    pub psnr: Vec<f64>,
    /// Data URIs of original, compressed and difference of every frame.
    #[serde(skip)]
    pub images: Vec<[String; 3]>,
    /// Pixels across and down, as shown.
    #[serde(skip)]
    pub size: (u32, u32),
    /// Pixels of the picture, each way, that one shown pixel stands for.
    #[serde(skip)]
    pub shrunk: u32,
    /// By how much the difference was made brighter.
    #[serde(skip)]
    pub factor: u32,
}

/// What the images are of, in order.
pub const KINDS: [&str; 3] = ["original", "compressed", "difference"];

/// Memory that films take, and the page with them: about a byte a pixel.
pub fn bytes(work: &Workload) -> u64 {
    let images = 3 * VIEWS as u64 * work.frames.min(FRAMES as u64);
    2 * images * work.pixels.min(MAX_PIXELS)
}

/// Films from where pictures of `shown` were taken; none of a scene of one frame.
///
/// # Errors
/// A source that cannot be read.
pub fn films(side: &ModelPair, shown: &[ShownImage]) -> Result<Vec<FilmPanel>> {
    let every = side.scene.source().info().times.len();
    let mut films: Vec<FilmPanel> = Vec::new();
    let mut cameras = Vec::new();
    for (k, ShownImage { choice, factor, .. }) in shown.iter().enumerate() {
        let FrameView { view, camera, .. } = side.picture(choice.place);
        let wanted = k == 0 || choice.why.iter().any(|why| why == "median render");
        if every < 2 || !wanted || cameras.contains(&camera) || films.len() == VIEWS {
            continue;
        }
        cameras.push(camera);
        let pictures = thin((0..every).map(|frame| FrameView { frame, view, camera }).collect(), FRAMES);
        let made = side.both(&pictures, |[original, compressed]| {
            let bright = brighter(&difference(compressed, original), *factor);
            let small = |image: &Image, most: u64| data_uri(&shrink(image, shrinkage(image, most)));
            let images = [
                small(original, MAX_PIXELS)?,
                small(compressed, MAX_PIXELS)?,
                small(&bright, MAX_PIXELS_OF_DIFFERENCE)?,
            ];
            Ok((psnr(compressed, original), shrinkage(original, MAX_PIXELS), images))
        })?;
        let shrunk = made.first().map_or(1, |made| made.1);
        let of = &side.scene.rig.cameras[camera as usize];
        films.push(FilmPanel {
            why: choice.why.clone(),
            view,
            camera_of_frame: choice.frame,
            frames: pictures.iter().map(|picture| picture.frame).collect(),
            psnr: made.iter().map(|made| made.0).collect(),
            size: (of.width.div_ceil(shrunk), of.height.div_ceil(shrunk)),
            shrunk,
            factor: *factor,
            images: made.into_iter().map(|made| made.2).collect(),
        });
    }
    Ok(films)
}

/// A picture as a JPEG inside a URI.
fn data_uri(image: &Image) -> Result<String> {
    let bytes = jpeg_bytes(image, QUALITY)
        .map_err(|e: io::Error| Error::internal(format!("a render cannot be shown: {e}")))?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(bytes)))
}
