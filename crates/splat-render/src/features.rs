//! Renders feature vectors of Gaussians: blends features in place of colors.
//!
//! Input: Gaussians at one frame, and features; a feature has one value of any sign per Gaussian. Output: blended
//! features per pixel. Blending is linear, so three features at a time are rendered as the three color channels. Colors
//! are clamped at 0, so a feature f is rendered as (f − min) / span, which lies in 0 … 1. The blended feature of a
//! pixel is then span · render + min · opacity, where the opacity of the pixel is the render of a feature that is 1
//! everywhere.

use super::render;
use splat_core::{AttributeValues, Camera, Gaussians, sh_from_color};

/// Computes for each pixel the sum Σ w·f over the Gaussians, where f is a feature value of a Gaussian and w its weight
/// in the pixel, as in the blending of colors.
///
/// Returns `[height, width, features]`, with one value per feature (plane of `features`). Accuracy: about 1e-6 of the
/// range of values of a feature. A value that is not finite counts as the smallest finite value of its feature.
///
/// # Panics
/// Panics if `features` and `gaussians` have different numbers of Gaussians.
pub fn blend_features(gaussians: &Gaussians, features: &AttributeValues, camera: &Camera) -> Vec<f32> {
    let (planes, pixels) = (features.width(), camera.width as usize * camera.height as usize);
    assert_eq!(features.len(), gaussians.len(), "expected as many features as Gaussians");
    let mut state = Gaussians { sh: AttributeValues::zeros(3, gaussians.len()), ..gaussians.clone() };
    state.sh.planes_mut().fill(sh_from_color(1.0));
    let opacity = render(&state, camera, [0.0; 3]).data;
    let mut blended = vec![0.0; planes * pixels];
    for first in (0..planes).step_by(3) {
        let some = first..planes.min(first + 3);
        let spans: Vec<[f64; 2]> = some.clone().map(|plane| span(features.plane(plane))).collect();
        for (c, plane) in some.clone().enumerate() {
            let [least, span] = spans[c];
            for (to, &feature) in state.sh.plane_mut(c).iter_mut().zip(features.plane(plane)) {
                let value = if feature.is_finite() { f64::from(feature) } else { least };
                *to = sh_from_color((value - least) / span);
            }
        }
        let image = render(&state, camera, [0.0; 3]).data;
        for (pixel, to) in blended.chunks_exact_mut(planes).enumerate() {
            for (c, plane) in some.clone().enumerate() {
                let [least, span] = spans[c];
                let [value, opacity] = [&image, &opacity].map(|values| f64::from(values[3 * pixel + c]));
                to[plane] = (span * value + least * opacity) as f32;
            }
        }
    }
    blended
}

/// Returns two numbers: the smallest finite value in `values`, and the difference between the largest and the smallest
/// finite value. The difference is given as 1 if all values are equal or none is finite.
fn span(values: &[f32]) -> [f64; 2] {
    let finite = || values.iter().copied().filter(|x| x.is_finite()).map(f64::from);
    let (least, most) = (finite().fold(f64::INFINITY, f64::min), finite().fold(f64::NEG_INFINITY, f64::max));
    match least < most {
        true => [least, most - least],
        false => [if least.is_finite() { least } else { 0.0 }, 1.0],
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// Returns overlapping Gaussians, half of them translucent, and a camera that sees them.
    fn scene() -> (Gaussians, Camera) {
        let mut filled = Gaussians::zeros(40, 0);
        let noise = |k: usize, step: f64| ((k as f64 * step).fract() - 0.5) as f32;
        for i in 0..40 {
            filled.position.set_row(i, [noise(i, 0.618), noise(i, 0.7549), noise(i, 0.5698)]);
            filled.rotation.set_row(i, [1.0, noise(i, 0.3), noise(i, 0.4), 0.0]);
            filled.log_scale.set_row(i, [-2.0, -2.5, -1.5]);
            filled.opacity_logit.set_row(i, [4.0 * noise(i, 0.9)]);
        }
        (filled, Camera::look_at(DVec3::new(0.3, -2.0, 0.4), DVec3::ZERO, 0.8, (33, 20)))
    }

    /// Returns `planes` features of the 40 Gaussians of `scene`, with values in [−3, 3).
    fn features(planes: usize) -> AttributeValues {
        let mut filled = AttributeValues::zeros(planes, 40);
        filled.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = 6.0 * ((k as f32 * 0.618_034).fract() - 0.5));
        filled
    }

    /// Returns the largest absolute difference between corresponding values of `a` and `b`.
    fn largest_difference(a: &[f32], b: impl Iterator<Item = f32>) -> f32 {
        a.iter().zip(b).fold(0.0, |most, (a, b)| most.max((a - b).abs()))
    }

    #[test]
    fn color_features_are_blended_like_colors() {
        let (mut state, camera) = scene();
        let mut colors = features(3);
        colors.planes_mut().iter_mut().for_each(|x| *x = x.abs());
        let harmonics = colors.planes().iter().map(|&x| sh_from_color(x.into())).collect();
        state.sh = AttributeValues::from_planes(3, harmonics);
        let expected = render(&state, &camera, [0.0; 3]).data;
        assert!(expected.iter().any(|&x| x > 0.5));
        let off = largest_difference(&blend_features(&state, &colors, &camera), expected.iter().copied());
        assert!(off < 1e-5, "{off}");
    }

    #[test]
    fn blending_is_linear_in_features_of_either_sign() {
        let (state, camera) = scene();
        let blend = |features: &AttributeValues| blend_features(&state, features, &camera);
        let (plain, mut other) = (features(7), features(7));
        let blended = blend(&plain);
        assert_eq!(blended.len(), 7 * 33 * 20);
        assert!(blended.iter().any(|&x| x > 0.5) && blended.iter().any(|&x| x < -0.5));
        other.planes_mut().iter_mut().for_each(|x| *x *= -2.0);
        let off = largest_difference(&blend(&other), blended.iter().map(|x| -2.0 * x));
        assert!(off < 2e-5, "{off}");
        // Adding 1 to all features adds the opacity of the pixel.
        let mut ones = features(1);
        ones.planes_mut().fill(1.0);
        let opacity = blend(&ones);
        other.planes_mut().iter_mut().zip(plain.planes()).for_each(|(to, x)| *to = x + 1.0);
        let off = largest_difference(&blend(&other), blended.iter().enumerate().map(|(k, x)| x + opacity[k / 7]));
        assert!(off < 2e-5, "{off}");
    }
}
