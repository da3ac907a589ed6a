//! Animations of the page: one or two views over time, rendered from the original and from the compressed model, with
//! the difference.
//!
//! Input: the chosen renders, and both models. Output: JPEG files as data URIs. A page has at most [`MAX_VIEWS`]
//! animations of at most [`MAX_FRAMES`] frames, each with two images of at most [`MAX_PIXELS`] pixels and their
//! difference: about 3 MB per result.

use serde::Serialize;

use super::shown_images::{MEDIAN, ShownImage, brighter, data_uri, difference, shrink, shrinkage};
use crate::error::Result;
use crate::evaluation::ModelPair;
use crate::files::image::write::jpeg_bytes;
use crate::memory_plan::Workload;
use crate::metrics::psnr;
use crate::model::FrameView;
use crate::render::Image;
use crate::scene::view_selection::select_frames;

/// Maximum number of animated views: the view of the worst render, and the view of the median render if it is another
/// one.
pub const MAX_VIEWS: usize = 2;
/// Maximum number of frames of an animation, evenly spaced from first to last.
pub const MAX_FRAMES: usize = 24;
/// Maximum number of pixels of an image in an animation; larger renders are scaled down.
pub const MAX_PIXELS: u64 = 90_000;
/// Maximum number of pixels of a difference image in an animation. It is lower than [`MAX_PIXELS`], because noise in
/// difference images takes most bytes.
pub const MAX_DIFFERENCE_PIXELS: u64 = 30_000;
/// JPEG quality of the images of animations, from 1 to 100.
pub const JPEG_QUALITY: u8 = 80;

/// Animation of one view on the report page.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FilmPanel {
    /// Reasons why this view is shown as an animation, such as "worst render".
    pub why: Vec<String>,
    /// Number of the animated view.
    pub view: u32,
    /// Index of the frame from which the camera of the animation is taken. All frames are rendered from this camera,
    /// even if the camera of the view moves.
    pub camera_of_frame: usize,
    /// Indices of the frames that the animation shows, in order.
    pub frames: Vec<usize>,
    /// PSNR of the full-size render, compressed against original, at each shown frame, dB.
    pub psnr: Vec<f64>,
    /// Data URIs of the original, the compressed and the difference image of each shown frame.
    #[serde(skip)]
    pub images: Vec<[String; 3]>,
    /// Width and height of the images of the original and the compressed model, pixels. Difference images may be
    /// smaller.
    #[serde(skip)]
    pub size: (u32, u32),
    /// Factor by which renders of the original and of the compressed model are scaled down along each axis: one pixel
    /// of the image stands for `shrunk` × `shrunk` pixels of the render.
    #[serde(skip)]
    pub shrunk: u32,
    /// Factor by which the difference images are brightened.
    #[serde(skip)]
    pub factor: u32,
}

/// Names of the three images of each frame, in the order of [`FilmPanel::images`].
pub const IMAGE_NAMES: [&str; 3] = ["original", "compressed", "difference"];

/// Returns the estimated bytes of memory of the animations: 1 byte per pixel of their images, and 1 byte per pixel in
/// the page that contains them.
pub fn memory_bytes(work: &Workload) -> u64 {
    let images = 3 * MAX_VIEWS as u64 * work.frames.min(MAX_FRAMES as u64);
    2 * images * work.pixels.min(MAX_PIXELS)
}

/// Renders the animations of at most [`MAX_VIEWS`] views: the views of the worst and of the median render in `shown`.
/// Returns no animation for a scene of one frame.
///
/// # Errors
/// Fails if a frame cannot be read.
pub fn render_films(pair: &ModelPair, shown: &[ShownImage]) -> Result<Vec<FilmPanel>> {
    let every = pair.scene.source().info().times.len();
    let mut films: Vec<FilmPanel> = Vec::new();
    let mut cameras = Vec::new();
    for (k, ShownImage { choice, factor, .. }) in shown.iter().enumerate() {
        let FrameView { view, camera, .. } = pair.view(choice.place);
        let wanted = k == 0 || choice.why.iter().any(|why| why == MEDIAN);
        if every < 2 || !wanted || cameras.contains(&camera) || films.len() == MAX_VIEWS {
            continue;
        }
        cameras.push(camera);
        let views = select_frames((0..every).map(|frame| FrameView { frame, view, camera }).collect(), MAX_FRAMES);
        let made = pair.render_pairs(&views, |[original, compressed]| {
            let bright = brighter(&difference(compressed, original), *factor);
            let small = |image: &Image, most: u64| {
                data_uri("jpeg", jpeg_bytes(&shrink(image, shrinkage(image, most)), JPEG_QUALITY))
            };
            let images =
                [small(original, MAX_PIXELS)?, small(compressed, MAX_PIXELS)?, small(&bright, MAX_DIFFERENCE_PIXELS)?];
            Ok((psnr(compressed, original), shrinkage(original, MAX_PIXELS), images))
        })?;
        let shrunk = made.first().map_or(1, |made| made.1);
        let of = &pair.scene.rig.cameras[camera as usize];
        films.push(FilmPanel {
            why: choice.why.clone(),
            view,
            camera_of_frame: choice.frame,
            frames: views.iter().map(|frame_view| frame_view.frame).collect(),
            psnr: made.iter().map(|made| made.0).collect(),
            size: (of.width.div_ceil(shrunk), of.height.div_ceil(shrunk)),
            shrunk,
            factor: *factor,
            images: made.into_iter().map(|made| made.2).collect(),
        });
    }
    Ok(films)
}
