//! Reader of photographs and renders in PNG files.
//!
//! Input: a PNG of any color type and bit depth, and the size it must have. Output: an [`Image`] with values in [0, 1],
//! transparent pixels blended over a background. Memory: the decoded rows and the result; the image size is checked
//! before memory for them is allocated.

pub mod write;

use std::io::BufReader;
use std::path::Path;

use png::{BitDepth, ColorType, Decoder, DecodingError, Transformations};

use super::open::open_file;
use crate::error::{Error, Result};
use crate::render::Image;

/// Reads the PNG at `path`, which must have `width` × `height` pixels.
///
/// Gray values are copied to the three channels. Transparent pixels (color c, opacity a) are blended over `background`
/// as c·a + background·(1 − a), as in the D-NeRF loaders.
///
/// # Errors
/// Fails if the file is not a PNG, is damaged, or has another size.
pub fn read_png(path: &Path, (width, height): (u32, u32), background: [f32; 3]) -> Result<Image> {
    let file = open_file(path)?;
    let mut decoder = Decoder::new(BufReader::new(file));
    decoder.set_transformations(Transformations::EXPAND);
    // Ignore text chunks and color profiles: they are not used and could decompress to any length.
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let mut reader = decoder.read_info().map_err(malformed(path))?;
    let found = (reader.info().width, reader.info().height);
    if found != (width, height) {
        let found = format!("{} x {}", found.0, found.1);
        return Err(Error::input(path, "", format!("{width} x {height} pixels, as its camera has"), found)
            .hint("give images of the cameras' size, or the cameras of these images"));
    }
    let (color, depth) = reader.output_color_type();
    // The size is `None` only if it overflows `usize`, which the limits on camera sizes exclude.
    let mut bytes = vec![0; reader.output_buffer_size().unwrap_or(0)];
    reader.next_frame(&mut bytes).map_err(malformed(path))?;
    let values: Vec<f32> = match depth {
        BitDepth::Sixteen => {
            bytes.chunks_exact(2).map(|two| f32::from(u16::from_be_bytes([two[0], two[1]])) / 65535.0).collect()
        }
        _ => bytes.iter().map(|&byte| f32::from(byte) / 255.0).collect(),
    };
    let over = |rgb: [f32; 3], alpha: f32| -> [f32; 3] {
        std::array::from_fn(|c| rgb[c] * alpha + background[c] * (1.0 - alpha))
    };
    let data = match color {
        ColorType::Grayscale => values.iter().flat_map(|&gray| [gray; 3]).collect(),
        ColorType::GrayscaleAlpha => values.chunks_exact(2).flat_map(|p| over([p[0]; 3], p[1])).collect(),
        ColorType::Rgba => values.chunks_exact(4).flat_map(|p| over([p[0], p[1], p[2]], p[3])).collect(),
        // The decoder has already replaced palette indices by colors.
        ColorType::Rgb | ColorType::Indexed => values,
    };
    Ok(Image { width, height, data })
}

/// Returns the size in pixels of the PNG or JPEG at `path`, or `None` if it cannot be read.
pub(crate) fn measure(path: &Path) -> Option<(u32, u32)> {
    let size = imagesize::reader_size(BufReader::new(open_file(path).ok()?)).ok()?;
    Some((u32::try_from(size.width).ok()?, u32::try_from(size.height).ok()?))
}

/// Returns a closure that turns a PNG decoding error of the file at `path` into an error of this crate.
fn malformed(path: &Path) -> impl Fn(DecodingError) -> Error {
    move |error| match error {
        DecodingError::IoError(source) if source.kind() != std::io::ErrorKind::UnexpectedEof => {
            Error::Io { action: "read", path: path.to_owned(), source }
        }
        other => Error::input(path, "", "a PNG image", other.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes a PNG of 2 × 1 pixels to a temporary file. `bytes` are its pixels in the given color type and bit depth;
    /// `palette` holds the colors of an indexed image.
    fn written(color: ColorType, depth: BitDepth, bytes: &[u8], palette: Option<&[u8]>) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut encoder = png::Encoder::new(file.reopen().unwrap(), 2, 1);
        encoder.set_color(color);
        encoder.set_depth(depth);
        if let Some(palette) = palette {
            encoder.set_palette(palette.to_vec());
        }
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(bytes).unwrap();
        writer.finish().unwrap();
        file
    }

    #[test]
    fn color_types_decode_to_equal_values() {
        let expected = [1.0, 0.0, 0.0, 0.2, 0.2, 0.2].map(|v: f32| v);
        let wide: Vec<u8> = [65535u16, 0, 0, 13107, 13107, 13107].iter().flat_map(|v| v.to_be_bytes()).collect();
        let images = [
            written(ColorType::Rgb, BitDepth::Eight, &[255, 0, 0, 51, 51, 51], None),
            written(ColorType::Rgb, BitDepth::Sixteen, &wide, None),
            written(ColorType::Rgba, BitDepth::Eight, &[255, 0, 0, 255, 51, 51, 51, 255], None),
            written(ColorType::Indexed, BitDepth::One, &[0b1000_0000], Some(&[51, 51, 51, 255, 0, 0])),
        ];
        for (i, file) in images.iter().enumerate() {
            let got = read_png(file.path(), (2, 1), [0.5; 3]).unwrap();
            assert_eq!(got.data, expected, "image {i}");
        }
        let gray = written(ColorType::Grayscale, BitDepth::Eight, &[255, 51], None);
        assert_eq!(read_png(gray.path(), (2, 1), [0.5; 3]).unwrap().data, [1.0, 1.0, 1.0, 0.2, 0.2, 0.2]);
    }

    #[test]
    fn transparent_pixels_show_the_background() {
        let file = written(ColorType::Rgba, BitDepth::Eight, &[255, 0, 0, 0, 255, 0, 0, 51], None);
        let got = read_png(file.path(), (2, 1), [0.0, 0.5, 1.0]).unwrap();
        for (got, expected) in got.data.iter().zip([0.0, 0.5, 1.0, 0.2, 0.4, 0.8]) {
            assert!((got - expected).abs() < 1e-6, "got {got}, expected {expected}");
        }
        let gray = written(ColorType::GrayscaleAlpha, BitDepth::Eight, &[255, 0, 255, 255], None);
        assert_eq!(read_png(gray.path(), (2, 1), [0.25; 3]).unwrap().data, [0.25, 0.25, 0.25, 1.0, 1.0, 1.0]);
    }

    #[test]
    fn wrong_size_damage_and_other_files_are_refused() {
        let file = written(ColorType::Rgb, BitDepth::Eight, &[255, 0, 0, 51, 51, 51], None);
        let message = |path: &Path, size| read_png(path, size, [0.0; 3]).unwrap_err().to_string();
        let text = message(file.path(), (3, 1));
        assert!(text.contains("expected 3 x 1 pixels") && text.contains("found 2 x 1"), "{text}");
        let whole = std::fs::read(file.path()).unwrap();
        for cut in 0..whole.len() - 12 {
            std::fs::write(file.path(), &whole[..cut]).unwrap();
            let text = message(file.path(), (2, 1));
            assert!(text.contains("expected a PNG image"), "cut at {cut}: {text}");
        }
        std::fs::write(file.path(), b"\xff\xd8\xff\xe0 a JPEG begins like this").unwrap();
        assert!(message(file.path(), (2, 1)).contains("a PNG image"));
    }
}
