//! Reads and writes lossless WebP images (VP8L) whose pixels hold numbers instead of colors. All four bytes of every
//! pixel are kept exactly, even the colors of transparent pixels.

use std::io::Cursor;

use image_webp::{ColorType, DecodingError, WebPDecoder, WebPEncoder};

/// Maximum width and height of a WebP image in pixels.
pub const MAX_SIDE: usize = 16_384;

/// Image of four bytes (red, green, blue, alpha) per pixel, row by row from the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbaImage {
    /// Width of the image in pixels.
    pub width: usize,
    /// Height of the image in pixels.
    pub height: usize,
    /// Pixels, `width` × `height` of them.
    pub pixels: Vec<[u8; 4]>,
}

impl RgbaImage {
    /// Creates an image of `width` × `height` pixels (0, 0, 0, 255).
    pub fn new(width: usize, height: usize) -> RgbaImage {
        RgbaImage { width, height, pixels: vec![[0, 0, 0, 255]; width * height] }
    }

    /// Encodes the image as a lossless WebP file. The bytes depend only on the image.
    ///
    /// # Errors
    /// Fails if a side is 0 or above [`MAX_SIDE`], or if the number of pixels is not `width` × `height`.
    pub fn to_webp(&self) -> std::io::Result<Vec<u8>> {
        let in_range = |side: usize| (1..=MAX_SIDE).contains(&side);
        if !in_range(self.width) || !in_range(self.height) || self.pixels.len() != self.width * self.height {
            return Err(std::io::Error::other(format!("a WebP cannot store {} × {} pixels", self.width, self.height)));
        }
        let mut bytes = Vec::new();
        WebPEncoder::new(&mut bytes)
            .encode(self.pixels.as_flattened(), self.width as u32, self.height as u32, ColorType::Rgba8)
            .map_err(std::io::Error::other)?;
        Ok(bytes)
    }

    /// Decodes a lossless WebP file. Images without an alpha channel get an alpha of 255.
    ///
    /// # Errors
    /// Fails if `bytes` are not a still lossless WebP, if they are damaged, or if the image has more than `max_pixels`
    /// pixels. The error is a description of the content found, for a message. The number of pixels is checked before
    /// memory is allocated for them.
    pub fn from_webp(bytes: &[u8], max_pixels: usize) -> Result<RgbaImage, String> {
        let described = |error: DecodingError| format!("a file that cannot be decoded ({error})");
        let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(described)?;
        let (width, height) = decoder.dimensions();
        let (width, height) = (width as usize, height as usize);
        let count = width * height;
        if count > max_pixels {
            return Err(format!("{width} × {height} pixels"));
        }
        if decoder.is_animated() {
            return Err("an animation".to_owned());
        }
        if decoder.is_lossy() {
            return Err("lossy compression, which changes the stored numbers".to_owned());
        }
        // Decoding takes up to three buffers of four bytes per pixel, besides tables of a fixed size.
        decoder.set_memory_limit(12 * count + (4 << 20));
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        if decoder.output_buffer_size() != Some(channels * count) {
            return Err("an image whose size contradicts its header".to_owned());
        }
        let mut values = vec![0; channels * count];
        decoder.read_image(&mut values).map_err(described)?;
        let pixels = match channels {
            4 => values.as_chunks::<4>().0.to_vec(),
            _ => values.as_chunks::<3>().0.iter().map(|&[red, green, blue]| [red, green, blue, 255]).collect(),
        };
        Ok(RgbaImage { width, height, pixels })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns an image of `width` × `height` pixels in which every byte differs from its neighbors; a quarter of the
    /// pixels is transparent.
    fn numbers(width: usize, height: usize) -> RgbaImage {
        let value = |i: usize| (i.wrapping_mul(2_654_435_761) >> 13) as u8;
        let pixel = |i: usize| {
            [value(4 * i), value(4 * i + 1), value(4 * i + 2), if i.is_multiple_of(4) { 0 } else { value(i) }]
        };
        RgbaImage { width, height, pixels: (0..width * height).map(pixel).collect() }
    }

    #[test]
    fn colors_of_transparent_pixels_are_kept() {
        for (width, height) in [(1, 1), (4, 8), (37, 5), (128, 128)] {
            let image = numbers(width, height);
            let bytes = image.to_webp().unwrap();
            assert_eq!(RgbaImage::from_webp(&bytes, width * height).unwrap(), image, "{width} × {height}");
            assert_eq!(bytes, image.to_webp().unwrap());
        }
        let flat = RgbaImage::new(64, 3);
        assert_eq!(RgbaImage::from_webp(&flat.to_webp().unwrap(), 192).unwrap(), flat);
    }

    #[test]
    fn damaged_images_are_refused() {
        let whole = numbers(16, 16).to_webp().unwrap();
        assert!(RgbaImage::from_webp(&whole, 255).unwrap_err().contains("16 × 16"));
        for length in 0..whole.len() - 2 {
            assert!(RgbaImage::from_webp(&whole[..length], 256).is_err(), "{length}");
        }
        for at in 0..whole.len() {
            let mut changed = whole.clone();
            changed[at] ^= 0x55;
            // A change may give another valid image; it must not panic.
            _ = RgbaImage::from_webp(&changed, 256);
        }
        assert!(RgbaImage { width: 0, height: 4, pixels: Vec::new() }.to_webp().is_err());
    }
}
