//! Writes renders as image files: 8-bit as shown on a screen, or the exact values.
//!
//! Input: an [`Image`]. Output: an 8-bit RGB `.png`, a `.npy` of float32 `[height, width, 3]` that is not clamped, or,
//! for HTML pages, a JPEG. Memory: 3 bytes per pixel for a PNG or JPEG, no extra memory for an array.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use npyz::{WriteOptions, WriterBuilder};

use crate::error::{Error, Result};
use crate::render::Image;

/// File format in which a render is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageFormat {
    /// PNG with 8 bits per channel, values clamped to [0, 1].
    Png,
    /// NumPy array of float32, values not clamped.
    Npy,
}

impl ImageFormat {
    /// Returns the file name extension of the format. [`ImageFormat::from_path`] recognizes the format by it.
    pub fn extension(self) -> &'static str {
        match self {
            ImageFormat::Png => "png",
            ImageFormat::Npy => "npy",
        }
    }

    /// Returns the format that the extension of the file name `path` stands for, ignoring case; `None` for other
    /// extensions.
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
/// Fails if the file cannot be written, or if a PNG would have no pixels, which that format does not allow.
pub fn write_image(image: &Image, format: ImageFormat, path: &Path) -> Result<()> {
    let mut out = BufWriter::new(File::create(path).map_err(Error::io("create", path))?);
    write(&mut out, image, format).and_then(|()| out.flush()).map_err(Error::io("write", path))
}

/// Returns the content of the file that [`write_image`] writes for `image`.
///
/// # Errors
/// Fails if a PNG would have no pixels, which that format does not allow.
pub fn image_bytes(image: &Image, format: ImageFormat) -> io::Result<Vec<u8>> {
    let mut out = Vec::new();
    write(&mut out, image, format)?;
    Ok(out)
}

/// Encodes `image` in the file format `format` and writes the bytes to `out`.
fn write(out: &mut impl Write, image: &Image, format: ImageFormat) -> io::Result<()> {
    match format {
        ImageFormat::Png => write_png(out, image),
        ImageFormat::Npy => write_npy(out, image),
    }
}

/// Writes `image` as an 8-bit RGB PNG to `out`.
fn write_png(out: &mut impl Write, image: &Image) -> io::Result<()> {
    let mut encoder = png::Encoder::new(out, image.width, image.height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().map_err(png_error_to_io)?;
    writer.write_image_data(&rgb(image)).map_err(png_error_to_io)?;
    writer.finish().map_err(png_error_to_io)
}

/// Converts an error of the PNG encoder to an I/O error. If the encoder failed with an I/O error, returns that error
/// unchanged, so that callers can recognize a full disk.
pub(crate) fn png_error_to_io(error: png::EncodingError) -> io::Error {
    match error {
        png::EncodingError::IoError(error) => error,
        other => other.into(),
    }
}

/// Returns the pixels of `image` as RGB with 8 bits per channel, clamped to [0, 1].
pub(crate) fn rgb(image: &Image) -> Vec<u8> {
    image.data.iter().map(|&value| byte(value)).collect()
}

/// Returns `image` as a JPEG, for pages that hold many renders. `quality` is from 1 to 100.
///
/// # Errors
/// Fails if the image has no pixels, or more than 65535 along a side.
pub fn jpeg_bytes(image: &Image, quality: u8) -> io::Result<Vec<u8>> {
    let mut out = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut out, quality);
    encoder.encode(&rgb(image), image.width, image.height, ExtendedColorType::Rgb8).map_err(io::Error::other)?;
    Ok(out)
}

/// Converts a value in [0, 1] to the nearest of 256 steps; halves are rounded up, and NaN gives 0.
fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// Writes `image` as a NumPy float32 array `[height, width, 3]` to `out`.
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
    fn an_array_keeps_values_outside_zero_to_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.npy");
        let image = Image { width: 2, height: 1, data: vec![-1.0, 0.25, 7.5, 1e-30, 0.0, 1.0] };
        write_image(&image, ImageFormat::Npy, &path).unwrap();
        let array = npyz::NpyFile::new(File::open(&path).unwrap()).unwrap();
        assert_eq!(array.shape(), [1, 2, 3]);
        assert_eq!(array.into_vec::<f32>().unwrap(), image.data);
    }

    #[test]
    fn the_extension_gives_the_format() {
        assert_eq!(ImageFormat::from_path(Path::new("a/x.PNG")), Some(ImageFormat::Png));
        assert_eq!(ImageFormat::from_path(Path::new("x.npy")), Some(ImageFormat::Npy));
        assert_eq!(ImageFormat::from_path(Path::new("x.jpg")), None);
        assert_eq!(ImageFormat::from_path(Path::new("png")), None);
    }
}
