//! Features of Gaussians in the place of colors, blended as colors are.
//!
//! In: a state, planes of features of any sign. Out: per pixel what is blended of each. A blend is linear, so three features
//! at a time are pictures of colors: moved and scaled to 0 … 1, for colors are cut at 0, and back by the opacity that a picture
//! of ones has.

use super::render;
use splat_core::{Camera, Column, Gaussians, harmonic};

/// Σ w·f over the Gaussians of each pixel, w the weights with which colors are blended: `[height, width, planes]` of the
/// planes of `features`. Accuracy: about 1e-6 of the span of a feature's values. What is not finite counts as the least that is.
///
/// # Panics
/// If there are not as many features as Gaussians.
pub fn blend_features(gaussians: &Gaussians, features: &Column, camera: &Camera) -> Vec<f32> {
    let (planes, pixels) = (features.width(), camera.width as usize * camera.height as usize);
    assert_eq!(features.len(), gaussians.len(), "as many features as Gaussians");
    let mut state = Gaussians { sh: Column::zeros(3, gaussians.len()), ..gaussians.clone() };
    state.sh.planes_mut().fill(harmonic(1.0));
    let opacity = render(&state, camera, [0.0; 3]).data;
    let mut blended = vec![0.0; planes * pixels];
    for first in (0..planes).step_by(3) {
        let some = first..planes.min(first + 3);
        let spans: Vec<[f64; 2]> = some.clone().map(|plane| span(features.plane(plane))).collect();
        for (c, plane) in some.clone().enumerate() {
            let [least, span] = spans[c];
            for (to, &feature) in state.sh.plane_mut(c).iter_mut().zip(features.plane(plane)) {
                let value = if feature.is_finite() { f64::from(feature) } else { least };
                *to = harmonic((value - least) / span);
            }
        }
        let picture = render(&state, camera, [0.0; 3]).data;
        for (pixel, to) in blended.chunks_exact_mut(planes).enumerate() {
            for (c, plane) in some.clone().enumerate() {
                let [least, span] = spans[c];
                let [value, seen] = [&picture, &opacity].map(|of| f64::from(of[3 * pixel + c]));
                to[plane] = (span * value + least * seen) as f32;
            }
        }
    }
    blended
}

/// Least finite value, and how much larger the largest is; 1 where none is.
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

    /// Overlapping Gaussians, half of them see-through, before a camera.
    fn scene() -> (Gaussians, Camera) {
        let mut made = Gaussians::zeros(40, 0);
        let noise = |k: usize, step: f64| ((k as f64 * step).fract() - 0.5) as f32;
        for i in 0..40 {
            made.position.set_row(i, [noise(i, 0.618), noise(i, 0.7549), noise(i, 0.5698)]);
            made.rotation.set_row(i, [1.0, noise(i, 0.3), noise(i, 0.4), 0.0]);
            made.log_scale.set_row(i, [-2.0, -2.5, -1.5]);
            made.opacity_logit.set_row(i, [4.0 * noise(i, 0.9)]);
        }
        (made, Camera::look_at(DVec3::new(0.3, -2.0, 0.4), DVec3::ZERO, 0.8, (33, 20)))
    }

    fn features(planes: usize) -> Column {
        let mut made = Column::zeros(planes, 40);
        made.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = 6.0 * ((k as f32 * 0.618_034).fract() - 0.5));
        made
    }

    fn furthest(a: &[f32], b: impl Iterator<Item = f32>) -> f32 {
        a.iter().zip(b).fold(0.0, |most, (a, b)| most.max((a - b).abs()))
    }

    #[test]
    fn features_that_are_colors_are_blended_as_these() {
        let (mut state, camera) = scene();
        let mut colors = features(3);
        colors.planes_mut().iter_mut().for_each(|x| *x = x.abs());
        let harmonics = colors.planes().iter().map(|&x| harmonic(x.into())).collect();
        state.sh = Column::from_planes(3, harmonics);
        let expected = render(&state, &camera, [0.0; 3]).data;
        assert!(expected.iter().any(|&x| x > 0.5));
        let off = furthest(&blend_features(&state, &colors, &camera), expected.iter().copied());
        assert!(off < 1e-5, "{off}");
    }

    #[test]
    fn blends_are_linear_in_features_of_either_sign() {
        let (state, camera) = scene();
        let of = |features: &Column| blend_features(&state, features, &camera);
        let (plain, mut other) = (features(7), features(7));
        let blended = of(&plain);
        assert_eq!(blended.len(), 7 * 33 * 20);
        assert!(blended.iter().any(|&x| x > 0.5) && blended.iter().any(|&x| x < -0.5));
        other.planes_mut().iter_mut().for_each(|x| *x *= -2.0);
        let off = furthest(&of(&other), blended.iter().map(|x| -2.0 * x));
        assert!(off < 2e-5, "{off}");
        // One more everywhere is as much more as is there to be seen.
        let mut ones = features(1);
        ones.planes_mut().fill(1.0);
        let seen = of(&ones);
        other.planes_mut().iter_mut().zip(plain.planes()).for_each(|(to, x)| *to = x + 1.0);
        let off = furthest(&of(&other), blended.iter().enumerate().map(|(k, x)| x + seen[k / 7]));
        assert!(off < 2e-5, "{off}");
    }
}
