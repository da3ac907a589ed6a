//! FLIP, a metric of the difference that a person perceives when alternating between two images.

use nv_flip::{DEFAULT_PIXELS_PER_DEGREE, FlipImageRgb8};

use super::{assert_same_size, clamped};
use crate::Image;

/// Computes the LDR-FLIP error of `a` against the reference `b`, averaged over pixels, in [0, 1]. Returns 0 for empty
/// images.
///
/// The viewing distance is the default of the method (67 pixels per degree). Images are converted to 8-bit sRGB values,
/// as on a screen; NaN becomes 0. Source: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images",
/// 2020; computed by the authors' code.
///
/// # Panics
/// Panics if the sizes of the images differ.
pub fn flip(a: &Image, b: &Image) -> f64 {
    assert_same_size(a, b);
    if a.data.is_empty() {
        return 0.0;
    }
    let bytes = |image: &Image| -> Vec<u8> {
        // A float-to-integer cast turns NaN into 0.
        image.data.iter().map(|&value| (clamped(value) * 255.0).round() as u8).collect()
    };
    let flip_image = |image: &Image| FlipImageRgb8::with_data(image.width, image.height, &bytes(image));
    let errors = nv_flip::flip(flip_image(b), flip_image(a), DEFAULT_PIXELS_PER_DEGREE).to_vec();
    errors.iter().map(|&error| f64::from(error)).sum::<f64>() / errors.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flip_is_0_for_equal_images_and_near_1_for_black_and_white() {
        let image = |value| Image { width: 40, height: 30, data: vec![value; 3600] };
        assert_eq!(flip(&image(0.3), &image(0.3)), 0.0);
        let all = flip(&image(2.0), &image(f32::NAN));
        assert!((0.9..=1.0).contains(&all), "{all}");
        assert_eq!(
            flip(&Image { width: 0, height: 0, data: vec![] }, &Image { width: 0, height: 0, data: vec![] }),
            0.0
        );
    }
}
