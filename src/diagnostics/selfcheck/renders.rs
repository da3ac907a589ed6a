//! Self-check cases for renders, their derivatives with respect to the stored parameters, and image metrics.

use std::f64::consts::TAU;
use std::num::NonZeroU32;

use glam::DVec3;

use super::case::LargestError;
use super::generated::clouds::{Random, plain_camera, random_gaussians, single_gaussian, tilted_camera};
use super::oracle::render::{blended_indices, render_blended, render_view};
use crate::error::Result;
use crate::metrics::{psnr, ssim};
use crate::model::{Attributes, Camera, Gaussians, Gradients};
use crate::render::{Contribution, Image, RemovalError, Renderer, render};

const BACKGROUND: [f32; 3] = [0.1, 0.9, 0.4];

/// Compares the render of one Gaussian with the formula of its pixels, α·c + (1 − α)·background with α =
/// o·exp(−r²/(2(f²s²/z² + 0.3))).
/// - Gaussian: color c, opacity o, scale s, at the distance z
/// - Pixel: r px from the center of the Gaussian
/// - Camera: focal length f px
///
/// In f32, values of 1 have an error of 6e-8, and exponentials a little more.
pub(super) fn one_gaussian(worst: &mut LargestError) -> Result<()> {
    let (size, depth, scale, opacity) = (48u32, 2.0f64, 0.08f64, 0.7f64);
    let image = render(&single_gaussian(depth as f32, scale as f32, opacity as f32), &plain_camera(size), [0.25; 3]);
    let variance = (50.0 * scale / depth).powi(2) + 0.3;
    let middle = f64::from(size) / 2.0 - 0.5;
    for (at, pixel) in image.data.chunks_exact(3).enumerate() {
        let [x, y] = [at % size as usize, at / size as usize].map(|k| k as f64 - middle);
        let alpha = opacity * (-0.5 * (x * x + y * y) / variance).exp();
        let alpha = if alpha < 1.0 / 255.0 { 0.0 } else { alpha };
        for (&got, color) in pixel.iter().zip([1.0, 0.5, 0.0]) {
            worst.near(got.into(), alpha * color + (1.0 - alpha) * 0.25, 1.0);
        }
    }
    Ok(())
}

/// Compares a render of many Gaussians with the same render in f64, pixel by pixel. The program adds a few dozen values
/// per pixel in f32. Skips the few pixels in which f32 may decide differently, because alpha or transmittance of a
/// Gaussian is so close to a threshold of the renderer (relative difference below 1e-4).
pub(super) fn many_gaussians(worst: &mut LargestError) -> Result<()> {
    let (scene, camera) = (random_gaussians(1, 300, 3), tilted_camera(67, 45));
    let expected = render_view(&scene, &camera, BACKGROUND, 1);
    let got = render(&scene, &camera, BACKGROUND);
    let sure = expected.doubtful.iter().filter(|&&doubtful| !doubtful).count();
    worst.same(&(20 * sure > 19 * expected.doubtful.len()), &true);
    for (at, rgb) in expected.rgb.iter().enumerate().filter(|&(at, _)| !expected.doubtful[at]) {
        (0..3).for_each(|c| worst.near(got.data[3 * at + c].into(), rgb[c], 1.0));
    }
    Ok(())
}

/// Compares the sum and the maximum of alpha · transmittance over the pixels, for each Gaussian, with values computed
/// in f64. Errors of the sum are relative to 1 + sum. The program sums in f32 over a tile of 256 pixels.
pub(super) fn weights(worst: &mut LargestError) -> Result<()> {
    let (scene, camera) = undoubtful_scene();
    let expected = render_view(&scene, &camera, BACKGROUND, 1);
    let mut seen = Contribution::new(scene.len());
    Renderer::new().contribution(&scene, &camera, NonZeroU32::MIN, &mut seen);
    for i in 0..scene.len() {
        worst.near(seen.in_pixels(i), expected.sum[i], 1.0 + expected.sum[i]);
        worst.near(seen.max[i].into(), expected.max[i], 1.0);
    }
    Ok(())
}

/// Compares the removal error of each Gaussian with its definition, Σ‖render − render without the Gaussian‖² over the
/// pixels, where both renders are in f64. The program computes the color behind a Gaussian as a difference in f32.
pub(super) fn removal(worst: &mut LargestError) -> Result<()> {
    let (scene, camera) = undoubtful_scene();
    let mut found = RemovalError::new(scene.len(), 0.0);
    Renderer::new().removal_error(&scene, &camera, BACKGROUND, &mut found);
    let all = blended_indices(&scene, &camera);
    let whole = render_blended(&scene, &camera, BACKGROUND, &all);
    for i in 0..scene.len() {
        let others: Vec<Vec<usize>> =
            all.iter().map(|ids| ids.iter().copied().filter(|&id| id != i).collect()).collect();
        let without = render_blended(&scene, &camera, BACKGROUND, &others);
        let values = whole.as_flattened().iter().zip(without.as_flattened());
        let expected: f64 = values.map(|(a, b)| (a - b).powi(2)).sum();
        worst.near(found.sum[i] as f64 * RemovalError::SUM_UNIT, expected, 1.0 + expected);
    }
    Ok(())
}

/// Compares colors that the program computes from SH coefficients with the definition of the spherical harmonics by
/// angles, K·P(cos θ)·cos mφ. The Legendre functions P come from a recurrence; K is the normalization. A color of 1 has
/// an error of about 1e-7 in f32.
pub(super) fn harmonics(worst: &mut LargestError) -> Result<()> {
    for toward in [DVec3::new(0.3, -0.5, 0.8), DVec3::new(-0.7, 0.2, -0.4), DVec3::new(0.1, 0.9, 0.05)] {
        let toward = toward.normalize();
        let camera = Camera::look_at(DVec3::ZERO, toward, 1.0, (8, 8));
        let mut wall = Gaussians::zeros(1, 3);
        wall.position.set_row(0, toward.to_array().map(|x| 4.0 * x as f32));
        wall.rotation.set_row(0, [1.0, 0.0, 0.0, 0.0]);
        wall.log_scale.set_row(0, [9.0; 3]);
        // The wall lets through a hundredth of the light behind it, because alpha is clamped to 0.99.
        wall.opacity_logit.set_row(0, [9.0]);
        for (k, expected) in basis(toward).into_iter().enumerate() {
            wall.sh.planes_mut().fill(0.0);
            (0..3).for_each(|c| wall.sh.plane_mut(3 * k + c)[0] = 0.3 * (c as f32 - 1.0));
            let image = render(&wall, &camera, [0.0; 3]);
            for c in 0..3 {
                let color = 0.5 + f64::from(0.3 * (c as f32 - 1.0)) * expected;
                worst.near(image.data[3 * (8 * 4 + 4) + c].into(), 0.99 * color, 1.0);
            }
        }
    }
    Ok(())
}

/// Compares the 20 largest gradients of each attribute with finite differences. A gradient is the derivative of half
/// the squared error of a render with respect to one parameter. A finite difference is computed from the errors of two
/// f64 renders, whose values of the parameter differ by 6e-5. Errors are relative to the expected gradient; the
/// gradients of the program are f32 sums of terms of both signs.
pub(super) fn gradients(worst: &mut LargestError) -> Result<()> {
    let (scene, camera) = (random_gaussians(3, 40, 3), tilted_camera(33, 100));
    let doubtful = render_view(&scene, &camera, BACKGROUND, 1).doubtful;
    let mut random = Random(103);
    let target: Vec<f64> = (0..3 * doubtful.len()).map(|_| random.next_f32().into()).collect();
    let residual = |at: usize, value: f64| if doubtful[at / 3] { 0.0 } else { value - target[at] };
    let mut found = Gradients::new(scene.len(), Attributes::all(), 3);
    let slope = |image: &Image| {
        let data = image.data.iter().enumerate().map(|(at, &x)| residual(at, x.into()) as f32).collect();
        (0.0, Image { data, ..*image })
    };
    Renderer::new().gradient(&scene, &camera, BACKGROUND, slope, &mut found);

    // The list of Gaussians that each pixel blends is fixed beforehand, so that the loss is smooth.
    let blended = blended_indices(&scene, &camera);
    let loss = |changed: &Gaussians| -> f64 {
        let pixels = render_blended(changed, &camera, BACKGROUND, &blended);
        let squares = pixels.as_flattened().iter().enumerate().map(|(at, &x)| residual(at, x).powi(2));
        0.5 * squares.sum::<f64>()
    };
    for column in Attributes::all().iter() {
        let got = found.derivatives(column).planes();
        let mut largest: Vec<usize> = (0..got.len()).collect();
        largest.sort_by(|&a, &b| got[b].abs().total_cmp(&got[a].abs()));
        for &at in largest.iter().take(20) {
            let mut changed = scene.clone();
            let middle = scene.attribute_values(column).planes()[at];
            let both = [middle - 3e-5, middle + 3e-5];
            let [low, high] = both.map(|x| {
                changed.attribute_values_mut(column).planes_mut()[at] = x;
                loss(&changed)
            });
            worst.relative(got[at].into(), (high - low) / (f64::from(both[1]) - f64::from(both[0])));
        }
    }
    Ok(())
}

/// Compares PSNR in dB with its value from an exact sum of squared whole numbers, and SSIM with its definition. The f64
/// sums of 786,432 squares lose at most 1e-12.
pub(super) fn comparison(worst: &mut LargestError) -> Result<()> {
    let mut random = Random(8);
    let mut image = |size: u32| -> (Image, Vec<i64>) {
        let levels: Vec<i64> = (0..3 * size * size).map(|_| (256.0 * random.next_f32()) as i64).collect();
        let data = levels.iter().map(|&level| level as f32 / 256.0).collect();
        (Image { width: size, height: size, data }, levels)
    };
    let ((a, levels), (b, others)) = (image(512), image(512));
    let squares: i64 = levels.iter().zip(&others).map(|(a, b)| (a - b).pow(2)).sum();
    worst.near(psnr(&a, &b), -10.0 * (squares as f64 / 65536.0 / levels.len() as f64).log10(), 1.0);
    let ((a, _), (b, _)) = (image(16), image(16));
    worst.near(ssim(&a, &b), reference_ssim(&a, &b), 1.0);
    Ok(())
}

/// Seed of the random Gaussians of [`undoubtful_scene`]. With this seed, no alpha or transmittance in the render of the
/// scene is so close to a threshold of the renderer that f32 and f64 may decide differently.
const UNDOUBTFUL_SEED: u64 = 1;

/// Returns a scene and a camera. In the render, no alpha or transmittance is so close to a threshold of the renderer
/// that f32 may decide differently from f64, and no alpha is clamped.
fn undoubtful_scene() -> (Gaussians, Camera) {
    let mut scene = random_gaussians(UNDOUBTFUL_SEED, 60, 1);
    scene.opacity_logit.planes_mut().iter_mut().for_each(|logit| *logit = logit.min(2.0));
    (scene, tilted_camera(40, 33))
}

/// Returns the 16 real spherical harmonics up to degree 3 in the direction `toward`, from its angles θ and φ:
/// - order m > 0: √2·K·P(cos θ)·cos mφ
/// - order m < 0: √2·K·P(cos θ)·sin |m|φ
/// - order m = 0: K·P(cos θ)
///
/// P is an associated Legendre function and K its normalization.
fn basis(toward: DVec3) -> [f64; 16] {
    let (height, angle) = (toward.z, toward.y.atan2(toward.x));
    std::array::from_fn(|k| {
        let degree = k.isqrt();
        let order = k as i32 - (degree * degree + degree) as i32;
        let m = order.unsigned_abs() as usize;
        let factorial = |n: usize| (1..=n).map(|k| k as f64).product::<f64>();
        let scale = ((2 * degree + 1) as f64 / (2.0 * TAU) * factorial(degree - m) / factorial(degree + m)).sqrt();
        let wave = match order {
            0 => 1.0,
            1.. => 2f64.sqrt() * (m as f64 * angle).cos(),
            _ => 2f64.sqrt() * (m as f64 * angle).sin(),
        };
        scale * legendre(degree, m, height) * wave
    })
}

/// Returns the associated Legendre function of `degree` and order `m` at `x`, including the sign (−1)^m, by the
/// recurrence over degrees.
fn legendre(degree: usize, m: usize, x: f64) -> f64 {
    let sine = (1.0 - x * x).sqrt();
    let (mut before, mut last) = (0.0, (0..m).map(|k| -((2 * k + 1) as f64) * sine).product::<f64>());
    for l in m + 1..=degree {
        let next = (((2 * l - 1) as f64) * x * last - ((l + m - 1) as f64) * before) / (l - m) as f64;
        (before, last) = (last, next);
    }
    last
}

/// Computes the SSIM of two square images by its definition, window by window. Windows have 11×11 values, weighted by a
/// Gaussian of σ = 1.5; values beyond the border are zero.
fn reference_ssim(a: &Image, b: &Image) -> f64 {
    let size = a.width as i64;
    let bell = |d: i64| (-(d * d) as f64 / 4.5).exp();
    let total: f64 = (-5..=5).map(bell).sum();
    let value = |image: &Image, x: i64, y: i64, c: i64| match (0..size).contains(&x) && (0..size).contains(&y) {
        true => f64::from(image.data[(3 * (y * size + x) + c) as usize]),
        false => 0.0,
    };
    let mut sum = 0.0;
    for (y, x, c) in (0..size).flat_map(|y| (0..size).flat_map(move |x| (0..3).map(move |c| (y, x, c)))) {
        let [mut a1, mut b1, mut aa, mut bb, mut ab] = [0.0; 5];
        for (v, u) in (-5..=5).flat_map(|v| (-5..=5).map(move |u| (v, u))) {
            let weight = bell(u) * bell(v) / (total * total);
            let (a, b) = (value(a, x + u, y + v, c), value(b, x + u, y + v, c));
            (a1, b1) = (a1 + weight * a, b1 + weight * b);
            (aa, bb, ab) = (aa + weight * a * a, bb + weight * b * b, ab + weight * a * b);
        }
        let means = (2.0 * a1 * b1 + 1e-4) / (a1 * a1 + b1 * b1 + 1e-4);
        sum += means * (2.0 * (ab - a1 * b1) + 9e-4) / (aa - a1 * a1 + bb - b1 * b1 + 9e-4);
    }
    sum / (3 * size * size) as f64
}
