//! Reader of photographs and renders in PNG and JPEG files.
//!
//! Input: a PNG of any color type and bit depth, or a JPEG; and the size that the image must have. Output: an [`Image`]
//! with values in [0, 1], transparent pixels blended over a background. Memory: the bytes of a JPEG, the decoded rows
//! and the result; the sizes of the image and of a JPEG file are checked before memory for them is allocated.

pub mod write;

use std::fs::File;
use std::io::{BufReader, Cursor, Read as _, Seek as _};
use std::path::Path;

use image::codecs::jpeg::JpegDecoder;
use image::{ImageDecoder as _, ImageError};
use png::{BitDepth, ColorType, Decoder, DecodingError, Transformations};

use super::open::open_file;
use crate::error::{Error, Result};
use crate::render::Image;

/// Maximum size in bytes of a JPEG file: a part that does not depend on the number of pixels, such as metadata, and a
/// part for each pixel.
const MAX_JPEG_BYTES: (u64, u64) = (16 << 20, 8);

/// Advice to the user if a photograph cannot be read.
const UNREADABLE: &str = "give photographs as PNG or JPEG files, and copy or export a damaged one again";

/// Reads the PNG or JPEG at `path`, which must have `width` × `height` pixels. The first bytes of the file tell which
/// of the two it is. The orientation in the metadata of a JPEG is ignored, as in the loaders of training code.
///
/// # Errors
/// Fails if the file is neither a PNG nor a JPEG, is damaged, or has another size.
pub fn read_image(path: &Path, size: (u32, u32), background: [f32; 3]) -> Result<Image> {
    let mut file = open_file(path)?;
    let mut first = Vec::new();
    let read = (&mut file).take(3).read_to_end(&mut first).and_then(|_| file.rewind());
    read.map_err(Error::io("read", path))?;
    match first.as_slice() {
        [0xff, 0xd8, 0xff] => read_jpeg(file, path, size),
        _ => read_png(file, path, size, background),
    }
}

/// Reads the JPEG `file`, which must have `width` × `height` pixels. `path` is its path for messages.
fn read_jpeg(file: File, path: &Path, (width, height): (u32, u32)) -> Result<Image> {
    let malformed = |found: String| Error::input(path, "", "a JPEG image", found).hint(UNREADABLE);
    let most = MAX_JPEG_BYTES.0 + MAX_JPEG_BYTES.1 * u64::from(width) * u64::from(height);
    let mut bytes = Vec::new();
    file.take(most + 1).read_to_end(&mut bytes).map_err(Error::io("read", path))?;
    if bytes.len() as u64 > most {
        return Err(malformed(format!("more than {most} bytes")));
    }
    // The decoder fills missing rows of a file that is cut short. So look for the end marker after the last scan.
    let last = |marker: u8| bytes.windows(2).rposition(|two| two == [0xff, marker]);
    if last(0xd9) <= last(0xda) {
        return Err(malformed("the end of the file before the end of the image: the file is cut short".to_owned()));
    }
    let undecodable = |error: ImageError| malformed(error.to_string());
    let decoder = JpegDecoder::new(Cursor::new(&bytes)).map_err(undecodable)?;
    check_size(path, decoder.dimensions(), (width, height))?;
    let is_gray = decoder.color_type().channel_count() == 1;
    // The size of the camera is limited, so the number of bytes does not overflow.
    let mut decoded = vec![0; decoder.total_bytes() as usize];
    decoder.read_image(&mut decoded).map_err(undecodable)?;
    let values = decoded.iter().map(|&byte| f32::from(byte) / 255.0);
    let data = if is_gray { values.flat_map(|gray| [gray; 3]).collect() } else { values.collect() };
    Ok(Image { width, height, data })
}

/// Checks that the image at `path`, whose size is `found`, has the size `expected` (width and height in pixels).
fn check_size(path: &Path, found: (u32, u32), expected: (u32, u32)) -> Result<()> {
    if found == expected {
        return Ok(());
    }
    let shown = |(width, height): (u32, u32)| format!("{width} x {height}");
    Err(Error::input(path, "", format!("{} pixels, as its camera has", shown(expected)), shown(found))
        .hint("give images of the cameras' size, or the cameras of these images"))
}

/// Reads the PNG `file`, which must have `width` × `height` pixels. `path` is its path for messages.
///
/// Gray values are copied to the three channels. Transparent pixels (color c, opacity a) are blended over `background`
/// as c·a + background·(1 − a), as in the D-NeRF loaders.
fn read_png(file: File, path: &Path, (width, height): (u32, u32), background: [f32; 3]) -> Result<Image> {
    let mut decoder = Decoder::new(BufReader::new(file));
    decoder.set_transformations(Transformations::EXPAND);
    // Ignore text chunks and color profiles: they are not used and could decompress to any length.
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let mut reader = decoder.read_info().map_err(malformed(path))?;
    check_size(path, (reader.info().width, reader.info().height), (width, height))?;
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
        other => Error::input(path, "", "a PNG or JPEG image", other.to_string()).hint(UNREADABLE),
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
            let got = read_image(file.path(), (2, 1), [0.5; 3]).unwrap();
            assert_eq!(got.data, expected, "image {i}");
        }
        let gray = written(ColorType::Grayscale, BitDepth::Eight, &[255, 51], None);
        assert_eq!(read_image(gray.path(), (2, 1), [0.5; 3]).unwrap().data, [1.0, 1.0, 1.0, 0.2, 0.2, 0.2]);
    }

    #[test]
    fn transparent_pixels_show_the_background() {
        let file = written(ColorType::Rgba, BitDepth::Eight, &[255, 0, 0, 0, 255, 0, 0, 51], None);
        let got = read_image(file.path(), (2, 1), [0.0, 0.5, 1.0]).unwrap();
        for (got, expected) in got.data.iter().zip([0.0, 0.5, 1.0, 0.2, 0.4, 0.8]) {
            assert!((got - expected).abs() < 1e-6, "got {got}, expected {expected}");
        }
        let gray = written(ColorType::GrayscaleAlpha, BitDepth::Eight, &[255, 0, 255, 255], None);
        assert_eq!(read_image(gray.path(), (2, 1), [0.25; 3]).unwrap().data, [0.25, 0.25, 0.25, 1.0, 1.0, 1.0]);
    }

    #[test]
    fn wrong_size_damage_and_other_files_are_refused() {
        let file = written(ColorType::Rgb, BitDepth::Eight, &[255, 0, 0, 51, 51, 51], None);
        let message = |path: &Path, size| read_image(path, size, [0.0; 3]).unwrap_err().to_string();
        let text = message(file.path(), (3, 1));
        assert!(text.contains("expected 3 x 1 pixels") && text.contains("found 2 x 1"), "{text}");
        let whole = std::fs::read(file.path()).unwrap();
        for cut in 0..whole.len() - 12 {
            std::fs::write(file.path(), &whole[..cut]).unwrap();
            let text = message(file.path(), (2, 1));
            assert!(text.contains("expected a PNG or JPEG image"), "cut at {cut}: {text}");
        }
        std::fs::write(file.path(), b"\xff\xd8\xff\xe0 a JPEG begins like this").unwrap();
        assert!(message(file.path(), (2, 1)).contains("a JPEG image"));
        std::fs::write(file.path(), b"RIFF a WebP image").unwrap();
        assert!(message(file.path(), (2, 1)).contains("give photographs as PNG or JPEG files"));
    }

    /// Writes a JPEG of 40 × 24 pixels to a temporary file. Returns it with its pixels; `color` is their color type.
    fn written_jpeg(color: image::ExtendedColorType) -> (tempfile::NamedTempFile, Vec<u8>) {
        let channels = usize::from(color.channel_count());
        let value = |i: usize| ((i / channels % 40) * 4 + i % channels * 30) as u8;
        let bytes: Vec<u8> = (0..40 * 24 * channels).map(value).collect();
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(file.reopen().unwrap(), 100);
        encoder.encode(&bytes, 40, 24, color).unwrap();
        (file, bytes)
    }

    #[test]
    fn a_jpeg_decodes_to_nearly_its_pixels() {
        for color in [image::ExtendedColorType::Rgb8, image::ExtendedColorType::L8] {
            let (file, bytes) = written_jpeg(color);
            let got = read_image(file.path(), (40, 24), [0.5; 3]).unwrap();
            let each = 3 / usize::from(color.channel_count());
            let expected = bytes.iter().flat_map(|&byte| std::iter::repeat_n(f32::from(byte) / 255.0, each));
            assert_eq!(got.data.len(), 3 * 40 * 24);
            let worst = got.data.iter().zip(expected).map(|(got, expected)| (got - expected).abs()).fold(0.0, f32::max);
            assert!(worst < 0.02, "off by {worst}");
        }
    }

    #[test]
    fn a_damaged_jpeg_is_no_panic() {
        let (file, _) = written_jpeg(image::ExtendedColorType::Rgb8);
        let whole = std::fs::read(file.path()).unwrap();
        for at in 3..whole.len() {
            let mut damaged = whole.clone();
            damaged[at] ^= 0xff;
            std::fs::write(file.path(), damaged).unwrap();
            if let Ok(image) = read_image(file.path(), (40, 24), [0.0; 3]) {
                assert_eq!(image.data.len(), 3 * 40 * 24, "byte {at}");
            }
        }
    }

    #[test]
    fn a_jpeg_of_another_size_or_cut_short_is_refused() {
        let (file, _) = written_jpeg(image::ExtendedColorType::Rgb8);
        let message = |size| read_image(file.path(), size, [0.0; 3]).unwrap_err().to_string();
        assert!(message((40, 25)).contains("expected 40 x 25 pixels, as its camera has, found 40 x 24"));
        let whole = std::fs::read(file.path()).unwrap();
        for cut in 3..whole.len() - 1 {
            std::fs::write(file.path(), &whole[..cut]).unwrap();
            let text = message((40, 24));
            assert!(text.contains("expected a JPEG image"), "cut at {cut}: {text}");
        }
    }
}
