//! Pictures as files: what a screen shows, or the very values.
//!
//! In: an [`Image`]. Out: an 8-bit RGB `.png`, or a `.npy` of float32 `[height, width, 3]`, not clamped; for pages a JPEG.
//! Memory: for a PNG or JPEG 3 bytes per pixel, for an array none of its own.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use npyz::{WriteOptions, WriterBuilder};

use crate::error::{Error, Result};
use crate::render::Image;

/// How a picture is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageFormat {
    /// 8 bits per channel, clamped.
    Png,
    /// float32, not clamped.
    Npy,
}

impl ImageFormat {
    /// The end of a file's name, which is also how its format is recognized.
    pub fn extension(self) -> &'static str {
        match self {
            ImageFormat::Png => "png",
            ImageFormat::Npy => "npy",
        }
    }

    /// The format a file's name asks for, in letters of either case.
    pub fn from_path(path: &Path) -> Option<ImageFormat> {
        let extension = path.extension()?;
        [ImageFormat::Png, ImageFormat::Npy]
            .into_iter()
            .find(|format| extension.eq_ignore_ascii_case(format.extension()))
    }
}

/// Writes `image` to `path`.
///
/// # Errors
/// A failed write; a PNG without pixels, which the format does not know.
pub fn write_image(image: &Image, format: ImageFormat, path: &Path) -> Result<()> {
    let mut out = BufWriter::new(File::create(path).map_err(Error::io("create", path))?);
    write(&mut out, image, format).and_then(|()| out.flush()).map_err(Error::io("write", path))
}

/// The bytes that [`write_image`] writes.
///
/// # Errors
/// A PNG without pixels, which the format does not know.
pub fn image_bytes(image: &Image, format: ImageFormat) -> io::Result<Vec<u8>> {
    let mut out = Vec::new();
    write(&mut out, image, format)?;
    Ok(out)
}

fn write(out: &mut impl Write, image: &Image, format: ImageFormat) -> io::Result<()> {
    match format {
        ImageFormat::Png => write_png(out, image),
        ImageFormat::Npy => write_npy(out, image),
    }
}

fn write_png(out: &mut impl Write, image: &Image) -> io::Result<()> {
    let mut encoder = png::Encoder::new(out, image.width, image.height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().map_err(of_png)?;
    writer.write_image_data(&rgb(image)).map_err(of_png)?;
    writer.finish().map_err(of_png)
}

/// A failure of the system as it was, by which a full disk is known.
pub(crate) fn of_png(error: png::EncodingError) -> io::Error {
    match error {
        png::EncodingError::IoError(error) => error,
        other => other.into(),
    }
}

/// What a screen shows, 8 bits a channel.
pub(crate) fn rgb(image: &Image) -> Vec<u8> {
    image.data.iter().map(|&value| byte(value)).collect()
}

/// A JPEG of `quality` from 1 to 100, for pages that hold many pictures.
///
/// # Errors
/// A picture without pixels, or of more than 65535 each way.
pub fn jpeg_bytes(image: &Image, quality: u8) -> io::Result<Vec<u8>> {
    let mut out = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut out, quality);
    encoder.encode(&rgb(image), image.width, image.height, ExtendedColorType::Rgb8).map_err(io::Error::other)?;
    Ok(out)
}

/// The nearest of the 256 steps from 0 to 1, halves upward; NaN is 0.
fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn write_npy(out: &mut impl Write, image: &Image) -> io::Result<()> {
    let shape = [u64::from(image.height), u64::from(image.width), 3];
    let mut array = WriteOptions::<f32>::new().default_dtype().shape(&shape).writer(out).begin_nd()?;
    array.extend(image.data.iter().copied())?;
    array.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_takes_the_nearest_of_256_steps() {
        for step in 0..=255u8 {
            let value = f32::from(step) / 255.0;
            assert_eq!(byte(value), step);
            assert_eq!(byte(value - 0.001), step.max(1) - u8::from(step == 0), "{step} less a quarter of a step");
        }
        let odd = [f32::NAN, f32::NEG_INFINITY, -0.5, 1.5, f32::INFINITY, 0.5 / 255.0, 0.49 / 255.0];
        assert_eq!(odd.map(byte), [0, 0, 0, 255, 255, 1, 0]);
    }

    #[test]
    fn an_array_keeps_values_that_no_screen_shows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.npy");
        let image = Image { width: 2, height: 1, data: vec![-1.0, 0.25, 7.5, 1e-30, 0.0, 1.0] };
        write_image(&image, ImageFormat::Npy, &path).unwrap();
        let array = npyz::NpyFile::new(File::open(&path).unwrap()).unwrap();
        assert_eq!(array.shape(), [1, 2, 3]);
        assert_eq!(array.into_vec::<f32>().unwrap(), image.data);
    }

    #[test]
    fn a_name_says_the_format() {
        assert_eq!(ImageFormat::from_path(Path::new("a/x.PNG")), Some(ImageFormat::Png));
        assert_eq!(ImageFormat::from_path(Path::new("x.npy")), Some(ImageFormat::Npy));
        assert_eq!(ImageFormat::from_path(Path::new("x.jpg")), None);
        assert_eq!(ImageFormat::from_path(Path::new("png")), None);
    }
}
