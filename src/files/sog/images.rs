//! Converts attributes of Gaussians to images of bytes and back. Pixel i of an image, row by row from the top, belongs
//! to Gaussian number i of the file.

use rayon::prelude::*;

use super::codebook::Codebook;
use super::palette::Palette;
use crate::archive::interleave_zeros;
use crate::files::webp::{MAX_SIDE, RgbaImage};
use crate::model::{AttributeValues, logit};

/// Largest number of 16 bits. A `.sog` file stores such a number in two images: its low byte in one, its high byte in
/// the other.
const MAX_16_BIT: f64 = 65_535.0;
/// Alpha of a pixel that stores a quaternion without its component w. The alphas 253, 254 and 255 mean that x, y or z
/// is left out, respectively.
const FIRST_ROTATION_TAG: u8 = 252;
/// Number of palette entries in one row of the image of the palette.
const ENTRIES_PER_ROW: usize = 64;

/// Size in pixels of the images in a `.sog` file that have one pixel per Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    /// Number of pixels per row, a multiple of 4.
    pub width: usize,
    /// Number of rows of pixels, a multiple of 4.
    pub height: usize,
}

impl ImageSize {
    /// Returns the size of nearly square images with a pixel for each of `count` Gaussians, both sides multiples of 4;
    /// `None` if a side would be 16384 pixels ([`MAX_SIDE`]) or more.
    pub fn for_count(count: usize) -> Option<ImageSize> {
        let width = 4 * ((count as f64).sqrt() / 4.0).ceil().max(1.0) as usize;
        let height = 4 * count.div_ceil(width).div_ceil(4).max(1);
        (width < MAX_SIDE && height < MAX_SIDE).then_some(ImageSize { width, height })
    }

    /// Creates an image of this size in which pixel i belongs to the Gaussian with index `order[i]`. `pixel` receives
    /// the index of a Gaussian and returns the four bytes (red, green, blue, alpha) of its pixel. The pixels that
    /// belong to no Gaussian are (0, 0, 0, 255).
    pub fn image(self, order: &[u32], pixel: impl Fn(usize) -> [u8; 4]) -> RgbaImage {
        let mut image = RgbaImage::new(self.width, self.height);
        image.pixels.iter_mut().zip(order).for_each(|(to, &row)| *to = pixel(row as usize));
        image
    }
}

/// Ranges of the three components of a value; each component is stored as a 16-bit number within its range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range3 {
    /// Smallest value of each component, stored as 0.
    pub mins: [f64; 3],
    /// Largest value of each component, stored as 65535.
    pub maxs: [f64; 3],
}

impl Range3 {
    /// Returns the ranges of the three components over the finite values in `values`; 0 to 0 for a component without
    /// finite values.
    pub fn from_rows(values: impl Iterator<Item = [f64; 3]>) -> Range3 {
        let (mut mins, mut maxs) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for row in values {
            for c in (0..3).filter(|&c| row[c].is_finite()) {
                (mins[c], maxs[c]) = (mins[c].min(row[c]), maxs[c].max(row[c]));
            }
        }
        for (min, max) in mins.iter_mut().zip(&mut maxs).filter(|(min, max)| min > max) {
            (*min, *max) = (0.0, 0.0);
        }
        Range3 { mins, maxs }
    }

    /// Returns the 16-bit number that stores `value`, the component with index `axis`, within the range of this
    /// component.
    pub fn encode(&self, axis: usize, value: f64) -> u16 {
        let range = self.maxs[axis] - self.mins[axis];
        if range > 0.0 { (MAX_16_BIT * (value - self.mins[axis]) / range).round() as u16 } else { 0 }
    }

    /// Returns the value of the component with index `axis` that is stored as the 16-bit number `code`. 0 stands for
    /// the smallest value in the range of this component, 65535 for the largest.
    pub fn decode(&self, axis: usize, code: u16) -> f64 {
        self.mins[axis] + (self.maxs[axis] - self.mins[axis]) * f64::from(code) / MAX_16_BIT
    }
}

/// Returns sign(x)·ln(|x| + 1), the logarithmic scale of coordinates.
pub fn log_coordinate(x: f64) -> f64 {
    x.abs().ln_1p().copysign(x)
}

/// Returns the coordinate x whose [`log_coordinate`] is `n`.
pub fn from_log_coordinate(n: f64) -> f64 {
    n.abs().exp_m1().copysign(n)
}

/// Returns the indices of the Gaussians at `position`, sorted by the Morton code of their logarithmic coordinates with
/// 16 bits per axis. In this order, Gaussians that are near one another in space are also near in the images, which
/// then compress better.
pub fn morton_order(position: &AttributeValues) -> Vec<u32> {
    let logs = |row: usize| position.row::<3>(row).map(|x| log_coordinate(f64::from(x)));
    let range = Range3::from_rows((0..position.len()).map(logs));
    let code = |row: u32| {
        let logs = logs(row as usize);
        (0..3).map(|axis| interleave_zeros(u64::from(range.encode(axis, logs[axis]))) << axis).sum::<u64>()
    };
    let mut keys: Vec<(u64, u32)> = (0..position.len() as u32).into_par_iter().map(|row| (code(row), row)).collect();
    keys.par_sort_unstable();
    keys.into_iter().map(|(_, row)| row).collect()
}

/// Returns two images of size `size`: one of the low bytes and one of the high bytes of 16-bit numbers. `codes` returns
/// the three numbers (x, y, z) of the Gaussian with a given index. Pixel i holds the Gaussian `order[i]`: x, y and z
/// are red, green and blue.
pub fn encode_16_bit(size: ImageSize, order: &[u32], codes: impl Fn(usize) -> [u16; 3]) -> [RgbaImage; 2] {
    [0, 1].map(|byte| {
        size.image(order, |row| {
            let [x, y, z] = codes(row).map(|code| code.to_le_bytes()[byte]);
            [x, y, z, 255]
        })
    })
}

/// Returns three 16-bit numbers, for red, green and blue. The pixel `low` holds their low bytes and the pixel `high`
/// their high bytes.
pub fn decode_16_bit(low: [u8; 4], high: [u8; 4]) -> [u16; 3] {
    [0, 1, 2].map(|c| u16::from_le_bytes([low[c], high[c]]))
}

/// Returns the ranges of the logarithmic coordinates of `position`, and two images of size `size`: the low and the high
/// bytes of the coordinates as 16-bit numbers. Pixel i holds the Gaussian `order[i]`.
pub fn encode_positions(position: &AttributeValues, size: ImageSize, order: &[u32]) -> (Range3, [RgbaImage; 2]) {
    let logs = |row: usize| position.row::<3>(row).map(|x| log_coordinate(f64::from(x)));
    let range = Range3::from_rows(order.iter().map(|&row| logs(row as usize)));
    let images = encode_16_bit(size, order, |row| {
        let logs = logs(row);
        [0, 1, 2].map(|axis| range.encode(axis, logs[axis]))
    });
    (range, images)
}

/// Returns the position, in scene units, that is stored as the low bytes `low` and the high bytes `high` of its
/// logarithmic coordinates within `range`.
pub fn decode_position(range: &Range3, low: [u8; 4], high: [u8; 4]) -> [f32; 3] {
    let codes = decode_16_bit(low, high);
    [0, 1, 2].map(|axis| from_log_coordinate(range.decode(axis, codes[axis])) as f32)
}

/// Encodes the quaternion `q`, wxyz of any length, as a pixel. Red, green and blue hold the components of the unit
/// quaternion except the largest one, from −1/√2 to 1/√2. Alpha says which component is left out. A quaternion of
/// length 0 is stored as the identity.
pub fn encode_rotation(q: [f32; 4]) -> [u8; 4] {
    let q = q.map(f64::from);
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    let unit = if length > 0.0 { q.map(|x| x / length) } else { [1.0, 0.0, 0.0, 0.0] };
    let largest = (1..4).fold(0, |largest: usize, k| if unit[k].abs() > unit[largest].abs() { k } else { largest });
    // q and −q are the same rotation; the component that is left out must be positive.
    let sign = if unit[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut pixel = [0, 0, 0, FIRST_ROTATION_TAG + largest as u8];
    for (to, k) in (0..4).filter(|&k| k != largest).enumerate() {
        pixel[to] = (127.5 * (sign * unit[k] * std::f64::consts::SQRT_2 + 1.0)).round() as u8;
    }
    pixel
}

/// Returns the unit quaternion wxyz that `pixel` stands for; `None` if the alpha of the pixel is not 252, 253, 254 or
/// 255.
pub fn decode_rotation(pixel: [u8; 4]) -> Option<[f32; 4]> {
    let largest = usize::from(pixel[3].checked_sub(FIRST_ROTATION_TAG)?);
    let mut q = [0.0; 4];
    for (from, k) in (0..4).filter(|&k| k != largest).enumerate() {
        q[k] = (f64::from(pixel[from]) / 127.5 - 1.0) * std::f64::consts::FRAC_1_SQRT_2;
    }
    q[largest] = (1.0 - q.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    Some(q.map(|x| (x / length) as f32))
}

/// Returns an image of size `size` in which pixel i belongs to the Gaussian with index `order[i]`. Red, green and blue
/// are the indices in `codebook` of the entries nearest to the three components of the Gaussian in `values`. `alpha`
/// receives the index of a Gaussian and returns the alpha of its pixel.
pub fn encode_by_codebook(
    values: &AttributeValues,
    codebook: &Codebook,
    size: ImageSize,
    order: &[u32],
    alpha: impl Fn(usize) -> u8,
) -> RgbaImage {
    size.image(order, |row| {
        let [x, y, z] = values.row::<3>(row).map(|value| codebook.nearest(value));
        [x, y, z, alpha(row)]
    })
}

/// Returns the three values whose indices in `codebook` are red, green and blue of `pixel`; `None` if the codebook is
/// too short.
pub fn decode_by_codebook(codebook: &Codebook, pixel: [u8; 4]) -> Option<[f32; 3]> {
    Some([codebook.decode(pixel[0])?, codebook.decode(pixel[1])?, codebook.decode(pixel[2])?])
}

/// Returns the byte that stores an opacity in [0, 1].
pub fn encode_opacity(opacity: f64) -> u8 {
    (255.0 * opacity).round() as u8
}

/// Returns the opacity logit that the byte `code` stands for. It is finite: the bytes 0 and 255 are decoded as the
/// opacities 0.25/255 and 254.75/255 instead of 0 and 1.
pub fn decode_opacity(code: u8) -> f32 {
    logit(f64::from(code).clamp(0.25, 254.75) / 255.0) as f32
}

/// Returns the codebook of the values in `palette`, and the image of the palette entries: 64 entries per row, and for
/// each entry one pixel (red, green, blue) per SH coefficient above degree 0. The vectors of `palette` have red, green
/// and blue of each coefficient one after the other.
pub fn encode_palette(palette: &Palette) -> (Codebook, RgbaImage) {
    let coefficients = palette.width / 3;
    let codebook = Codebook::fit(|| palette.centroids.iter().copied());
    let mut image = RgbaImage::new(ENTRIES_PER_ROW * coefficients, palette.len().div_ceil(ENTRIES_PER_ROW).max(1));
    for (entry, values) in palette.centroids.chunks_exact(palette.width).enumerate() {
        let pixels = &mut image.pixels[entry * coefficients..][..coefficients];
        for (pixel, rgb) in pixels.iter_mut().zip(values.as_chunks::<3>().0) {
            let [red, green, blue] = rgb.map(|value| codebook.nearest(value));
            *pixel = [red, green, blue, 255];
        }
    }
    (codebook, image)
}

/// Returns the pixels that store the palette entry with index `label` in `image`, the image of a palette: one pixel per
/// SH coefficient above degree 0. Returns `None` if the palette has no such entry.
pub fn palette_entry(image: &RgbaImage, label: usize) -> Option<&[[u8; 4]]> {
    let coefficients = image.width / ENTRIES_PER_ROW;
    image.pixels.get(label.checked_mul(coefficients)?..)?.get(..coefficients)
}

/// Returns the image of size `size` that stores the palette label (index of the palette entry) of each Gaussian: the
/// low byte in red, the high byte in green. Pixel i holds the Gaussian `order[i]`.
pub fn encode_labels(labels: &[u32], size: ImageSize, order: &[u32]) -> RgbaImage {
    size.image(order, |row| {
        let [low, high, ..] = labels[row].to_le_bytes();
        [low, high, 0, 255]
    })
}

/// Returns the palette label (index of a palette entry) that `pixel` stores: the low byte in red, the high byte in
/// green.
pub fn decode_label(pixel: [u8; 4]) -> usize {
    usize::from(u16::from_le_bytes([pixel[0], pixel[1]]))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn images_have_room_for_every_gaussian() {
        for count in [0, 1, 4, 15, 16, 17, 1000, 31_658, 1 << 20, 260_000_000] {
            let ImageSize { width, height } = ImageSize::for_count(count).unwrap();
            assert!(width * height >= count && width % 4 == 0 && height % 4 == 0, "{count}: {width} × {height}");
        }
        assert_eq!(ImageSize::for_count(16_384 * 16_384), None);
    }

    #[test]
    fn kept_components_follow_in_the_order_wxyz() {
        assert_eq!(encode_rotation([0.0; 4]), [128, 128, 128, 252]);
        let half = std::f32::consts::FRAC_1_SQRT_2;
        assert_eq!(encode_rotation([half, 0.0, -0.75, 0.0]), [4, 128, 128, 254]);
        assert_eq!(decode_rotation([0, 0, 0, 251]), None);
    }

    proptest! {
        #[test]
        fn rotations_are_within_half_a_step(q in proptest::array::uniform4(-1.0f32..1.0)) {
            let length = q.iter().map(|x| x * x).sum::<f32>().sqrt();
            prop_assume!(length > 0.1);
            let found = decode_rotation(encode_rotation(q)).unwrap();
            let dot: f32 = found.iter().zip(q).map(|(a, b)| a * b / length).sum();
            let error = found.iter().zip(q).map(|(a, b)| (a - dot.signum() * b / length).abs()).fold(0.0, f32::max);
            prop_assert!(error < 0.0084, "{found:?}: {error}");
        }

        #[test]
        fn coordinates_are_within_half_a_step(rows in proptest::collection::vec(proptest::array::uniform3(-300.0f32..9000.0), 1..40)) {
            let mut position = AttributeValues::zeros(3, rows.len());
            rows.iter().enumerate().for_each(|(i, &row)| position.set_row(i, row));
            let order: Vec<u32> = (0..rows.len() as u32).rev().collect();
            let size = ImageSize::for_count(rows.len()).unwrap();
            let (range, [low, high]) = encode_positions(&position, size, &order);
            for (place, &row) in order.iter().enumerate() {
                let found = decode_position(&range, low.pixels[place], high.pixels[place]);
                for (axis, expected) in rows[row as usize].into_iter().enumerate() {
                    let step = (range.maxs[axis] - range.mins[axis]) / 65_535.0 * (f64::from(expected.abs()) + 1.0);
                    let error = f64::from((found[axis] - expected).abs());
                    prop_assert!(error <= 0.5 * step * 1.001 + 1e-6 * f64::from(expected.abs()), "{error}, step {step}");
                }
            }
        }

        #[test]
        fn opacities_are_within_half_a_step(opacity in 0.0f64..1.0) {
            let found = crate::model::opacity(decode_opacity(encode_opacity(opacity)));
            prop_assert!((found - opacity).abs() <= 0.5 / 255.0 + 1e-7);
        }
    }
}
