//! Choice of the renders that the page shows, and their images.
//!
//! Input: first the quality measures of all renders, from which some renders are chosen; then the chosen renders, which
//! the caller renders a second time. Output: PNG files as data URIs. A page has at most four renders (the worst one, the
//! worst one of the worst view, the worst one of the worst frame, and the median one) of at most [`MAX_PIXELS`] pixels,
//! with three or four images of each: at most 5 MB per result.

use std::io;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;

use crate::error::{Error, Result};
use crate::evaluation::RenderedViews;
use crate::evaluation::results::{Evaluation, ImageQuality};
use crate::files::image::write::{ImageFormat, image_bytes};
use crate::render::Image;

/// Reason for showing the render with the lowest PSNR, as text for the page.
pub(super) const WORST: &str = "worst render";
/// Reason for showing the render with the median PSNR, as text for the page.
pub(super) const MEDIAN: &str = "median render";

/// Maximum number of pixels of a shown image; larger renders are scaled down. Images of trained scenes take about 2
/// bytes per pixel in base64.
pub const MAX_PIXELS: u64 = 160_000;
/// Fraction of the values of a difference image that must stay at or below 1 when the image is brightened.
const UNCLIPPED: f64 = 0.999;
/// Maximum factor by which difference images are brightened. At 64, a difference of 1/255 becomes a quarter of the
/// range.
const MAX_FACTOR: u32 = 64;

/// Render that is chosen for the page, with its quality measures (PSNR, SSIM, …).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChosenRender {
    /// Reasons why this render is shown on the page, such as "worst render".
    pub why: Vec<String>,
    /// Index of the render in [`Evaluation::views`].
    #[serde(skip)]
    pub place: usize,
    /// Index of the frame that the render shows.
    pub frame: usize,
    /// Number of the view that the render shows.
    pub view: u32,
    /// PSNR of the compressed model's render against the original's, dB.
    pub psnr: f64,
    /// SSIM of the compressed model's render against the original's.
    pub ssim: f64,
    /// FLIP of the compressed model's render against the original's; `None` if it was not computed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flip: Option<f64>,
}

/// Returns the renders that the page shows, chosen from the comparison `evaluation`; the worst render comes first. A
/// render that is chosen for several reasons occurs once, with all its reasons.
pub fn choose_renders(evaluation: &Evaluation) -> Vec<ChosenRender> {
    let scores = &evaluation.views;
    let lowest = |places: &mut dyn Iterator<Item = usize>| -> Option<usize> {
        places.min_by(|&a, &b| scores[a].loss.psnr.total_cmp(&scores[b].loss.psnr))
    };
    let mut by_psnr: Vec<usize> = (0..scores.len()).collect();
    by_psnr.sort_by(|&a, &b| scores[a].loss.psnr.total_cmp(&scores[b].loss.psnr));
    let view = evaluation.loss.per_view.iter().min_by(|a, b| a.means.psnr.total_cmp(&b.means.psnr)).map(|of| of.view);
    let frame =
        evaluation.loss.per_frame.iter().min_by(|a, b| a.means.psnr.total_cmp(&b.means.psnr)).map(|of| of.frame);
    let of_view = lowest(&mut (0..scores.len()).filter(|&i| Some(scores[i].view) == view));
    let of_frame = lowest(&mut (0..scores.len()).filter(|&i| Some(scores[i].frame) == frame));
    let candidates = [
        (WORST, by_psnr.first().copied()),
        ("worst view", of_view),
        ("worst frame", of_frame),
        (MEDIAN, by_psnr.get(by_psnr.len().saturating_sub(1) / 2).copied()),
    ];
    let mut chosen: Vec<ChosenRender> = Vec::new();
    for (why, place) in candidates {
        let Some(place) = place else { continue };
        if let Some(same) = chosen.iter_mut().find(|choice| choice.place == place) {
            same.why.push(why.to_owned());
            continue;
        }
        let of = &scores[place];
        let ImageQuality { psnr, ssim, flip, .. } = of.loss;
        chosen.push(ChosenRender {
            why: vec![why.to_owned()],
            place,
            frame: of.frame,
            view: of.view,
            psnr,
            ssim,
            flip,
        });
    }
    chosen
}

/// Returns the chosen renders `choices` with the quality measures of another compressed model of the same original.
/// `evaluation` is the evaluation of this other model; the scores in `choices` are those of the first compressed model.
pub fn with_scores_from(evaluation: &Evaluation, choices: &[ChosenRender]) -> Vec<ChosenRender> {
    let scored = |choice: &ChosenRender| {
        let ImageQuality { psnr, ssim, flip, .. } = evaluation.views[choice.place].loss;
        ChosenRender { psnr, ssim, flip, ..choice.clone() }
    };
    choices.iter().map(scored).collect()
}

/// Render that was chosen for the report, with the images that the report shows of it.
#[derive(Debug, Clone, PartialEq)]
pub struct ShownImage {
    /// Chosen render, with its quality measures (PSNR, SSIM, …).
    pub choice: ChosenRender,
    /// Names and data URIs of the images: original, compressed model, difference and, if there is one, photograph.
    pub images: Vec<(&'static str, String)>,
    /// Width and height of the shown images, pixels.
    pub size: (u32, u32),
    /// Factor by which the render is scaled down along each axis: one pixel of the shown image stands for `shrunk` ×
    /// `shrunk` pixels of the render.
    pub shrunk: u32,
    /// Factor by which the difference image is brightened.
    pub factor: u32,
}

/// Creates the images of a chosen render: original, compressed, brightened difference, and the photograph if there is
/// one.
///
/// # Errors
/// Fails if the render has no pixels, which PNG does not allow.
pub fn create_images(choice: &ChosenRender, renders: &RenderedViews) -> Result<ShownImage> {
    let shrunk = shrinkage(&renders.original, MAX_PIXELS);
    let difference = difference(&renders.compressed, &renders.original);
    let factor = brightening(&difference);
    let bright = brighter(&difference, factor);
    let mut images = Vec::new();
    for (name, image) in [
        ("original", Some(&renders.original)),
        ("compressed", Some(&renders.compressed)),
        ("difference", Some(&bright)),
        ("photograph", renders.truth.as_ref()),
    ] {
        if let Some(image) = image {
            images.push((name, png_uri(&shrink(image, shrunk))?));
        }
    }
    let size = (renders.original.width.div_ceil(shrunk), renders.original.height.div_ceil(shrunk));
    Ok(ShownImage { choice: choice.clone(), images, size, shrunk, factor })
}

/// Returns `image` as a data URI that contains a PNG file.
///
/// # Errors
/// Fails if the image has no pixels.
pub fn png_uri(image: &Image) -> Result<String> {
    data_uri("png", image_bytes(image, ImageFormat::Png))
}

/// Returns a data URI that contains `bytes`, an image file of the media type image/`kind`.
pub(super) fn data_uri(kind: &str, bytes: io::Result<Vec<u8>>) -> Result<String> {
    let bytes = bytes.map_err(|error| Error::internal(format!("an image cannot be encoded: {error}")))?;
    Ok(format!("data:image/{kind};base64,{}", STANDARD.encode(bytes)))
}

/// Returns the absolute difference |a − b| of two images, channel by channel; values are first clamped to [0, 1].
pub(super) fn difference(a: &Image, b: &Image) -> Image {
    let shown = |v: f32| v.clamp(0.0, 1.0);
    let data = a.data.iter().zip(&b.data).map(|(&a, &b)| (shown(a) - shown(b)).abs()).collect();
    Image { width: a.width, height: a.height, data }
}

/// Returns `image` with all values multiplied by `factor`.
pub(super) fn brighter(image: &Image, factor: u32) -> Image {
    Image { data: image.data.iter().map(|v| v * factor as f32).collect(), ..*image }
}

/// Returns the factor by which the image `difference` is brightened: the largest power of two, at most [`MAX_FACTOR`],
/// with which at most the fraction 1 − [`UNCLIPPED`] of the brightened values exceeds 1.
fn brightening(difference: &Image) -> u32 {
    let mut values = difference.data.clone();
    if values.is_empty() {
        return 1;
    }
    let rank = ((values.len() - 1) as f64 * UNCLIPPED) as usize;
    let high = *values.select_nth_unstable_by(rank, f32::total_cmp).1;
    let mut factor = 1;
    while factor < MAX_FACTOR && 2.0 * factor as f32 * high <= 1.0 {
        factor *= 2;
    }
    factor
}

/// Returns the smallest factor by which `image` must be scaled down along each axis so that it has at most `most`
/// pixels.
pub(super) fn shrinkage(image: &Image, most: u64) -> u32 {
    let pixels = |by: u32| u64::from(image.width.div_ceil(by)) * u64::from(image.height.div_ceil(by));
    (1..).find(|&by| pixels(by) <= most).unwrap_or(1)
}

/// Scales an image down by averaging squares of `by` × `by` pixels; squares at the right and bottom borders may be
/// smaller.
pub(super) fn shrink(image: &Image, by: u32) -> Image {
    if by == 1 {
        return image.clone();
    }
    let (width, height) = (image.width.div_ceil(by), image.height.div_ceil(by));
    let mut data = Vec::with_capacity(3 * (width * height) as usize);
    for y in 0..height {
        for x in 0..width {
            let (rows, columns) = (y * by..image.height.min((y + 1) * by), x * by..image.width.min((x + 1) * by));
            let count = (rows.len() * columns.len()) as f32;
            for channel in 0..3 {
                let at = |(y, x): (u32, u32)| {
                    image.data[3 * (y as usize * image.width as usize + x as usize) + channel].clamp(0.0, 1.0)
                };
                let all = rows.clone().flat_map(|y| columns.clone().map(move |x| (y, x)));
                data.push(all.map(at).sum::<f32>() / count);
            }
        }
    }
    Image { width, height, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, value: impl Fn(usize) -> f32) -> Image {
        Image { width, height, data: (0..(3 * width * height) as usize).map(value).collect() }
    }

    #[test]
    fn shrinking_keeps_the_mean_and_fits() {
        let large = image(1352, 1014, |i| (i % 256) as f32 / 255.0);
        let by = shrinkage(&large, MAX_PIXELS);
        let small = shrink(&large, by);
        assert_eq!((by, small.width, small.height), (3, 451, 338));
        assert!(u64::from(small.width * small.height) <= MAX_PIXELS);
        let mean = |image: &Image| image.data.iter().map(|&v| f64::from(v)).sum::<f64>() / image.data.len() as f64;
        assert!((mean(&small) - mean(&large)).abs() < 1e-3);
        assert_eq!(shrinkage(&image(320, 256, |_| 0.0), MAX_PIXELS), 1);
    }

    #[test]
    fn differences_are_brightened_until_they_clip() {
        let (a, b) = (image(8, 8, |_| 0.5), image(8, 8, |i| 0.5 + 0.1 * (i % 2) as f32));
        assert_eq!(brightening(&difference(&a, &b)), 8, "0.1 fits eight times, not sixteen");
        assert_eq!(brightening(&difference(&a, &a)), MAX_FACTOR);
        assert_eq!(brightening(&difference(&a, &image(8, 8, |_| -9.0))), 2);
    }

    #[test]
    fn a_uri_holds_the_image() {
        let uri = png_uri(&image(5, 4, |i| i as f32 / 60.0)).unwrap();
        let bytes = STANDARD.decode(uri.strip_prefix("data:image/png;base64,").unwrap()).unwrap();
        let reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        assert_eq!((reader.info().width, reader.info().height), (5, 4));
        assert!(png_uri(&image(0, 0, |_| 0.0)).is_err());
    }
}
