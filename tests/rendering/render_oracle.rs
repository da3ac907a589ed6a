//! Tests that compare the rasterizer with closed forms, with a slow f64 oracle, and with invariants.

use std::num::NonZeroU32;

use glam::DVec3;
use splatsieve::diagnostics::selfcheck::generated::clouds::{
    plain_camera, random_gaussians, single_gaussian, tilted_camera,
};
use splatsieve::diagnostics::selfcheck::oracle::render as oracle;
use splatsieve::model::{Camera, Gaussians};
use splatsieve::render::{Contribution, Image, Renderer, contribution, render};

fn nonzero(s: u32) -> NonZeroU32 {
    NonZeroU32::new(s).unwrap()
}

fn measure_contribution(gaussians: &Gaussians, camera: &Camera, s: u32) -> Contribution {
    let mut result = Contribution::new(gaussians.len());
    contribution(gaussians, camera, nonzero(s), &mut result);
    result
}

fn pixel(image: &Image, x: usize, y: usize) -> [f32; 3] {
    let at = (y * image.width as usize + x) * 3;
    image.data[at..at + 3].try_into().unwrap()
}

#[test]
fn render_of_one_gaussian_is_its_closed_form() {
    let (size, depth, scale, opacity) = (48u32, 2.0f64, 0.08f64, 0.7f64);
    let image = render(&single_gaussian(depth as f32, scale as f32, opacity as f32), &plain_camera(size), [0.25; 3]);
    // An isotropic Gaussian on the axis has variance (f·s/z)² + 0.3 about the center of the image.
    let variance = (50.0 * scale / depth).powi(2) + 0.3;
    let middle = f64::from(size) / 2.0 - 0.5;
    for y in 0..size as usize {
        for x in 0..size as usize {
            let square = (x as f64 - middle).powi(2) + (y as f64 - middle).powi(2);
            let alpha = opacity * (-0.5 * square / variance).exp();
            let alpha = if alpha < 1.0 / 255.0 { 0.0 } else { alpha };
            for (c, color) in [1.0, 0.5, 0.0].into_iter().enumerate() {
                let expected = alpha * color + (1.0 - alpha) * 0.25;
                let got = f64::from(pixel(&image, x, y)[c]);
                assert!((got - expected).abs() < 1e-6, "pixel {x},{y} channel {c}: got {got}, expected {expected}");
            }
        }
    }
}

#[test]
fn random_scenes_match_the_oracle() {
    for (seed, count, degree, width, height) in
        [(1, 300, 3, 67, 45), (2, 2000, 2, 64, 64), (3, 40, 1, 33, 100), (4, 6000, 0, 80, 50)]
    {
        let (scene, camera) = (random_gaussians(seed, count, degree), tilted_camera(width, height));
        let background = [0.1, 0.9, 0.4];
        let expected = oracle::render_view(&scene, &camera, background, 1);
        let got = render(&scene, &camera, background);
        let doubtful = expected.doubtful.iter().filter(|&&doubtful| doubtful).count();
        assert!(doubtful * 20 < expected.doubtful.len(), "seed {seed}: {doubtful} pixels say nothing");
        for (i, (got, rgb)) in got.data.chunks_exact(3).zip(&expected.rgb).enumerate() {
            // A decision that f32 makes differently changes a pixel by an alpha of 1/255 times a color.
            let tolerance = if expected.doubtful[i] { 4.0 / 255.0 } else { 4e-6 };
            for c in 0..3 {
                let error = (f64::from(got[c]) - rgb[c]).abs();
                assert!(error <= tolerance, "seed {seed} pixel {i}: got {got:?}, expected {rgb:?} ± {tolerance}");
            }
        }
    }
}

#[test]
fn opaque_gaussian_is_cut_at_the_tiles_of_three_sigma() {
    // Above opacity 0.36, alpha is still above 1/255 beyond 3σ: there the square of tiles decides. Centered on pixel
    // 32, a radius of 16 ends before pixel 48.
    let camera = Camera { cx: 32.5, ..plain_camera(64) };
    let mut cut = 0;
    for step in 0..60 {
        let one = single_gaussian(2.0, 0.15 + 0.001 * step as f32, 0.95);
        let expected = oracle::render_view(&one, &camera, [0.0; 3], 1);
        let got = measure_contribution(&one, &camera, 1);
        assert!(
            (got.in_pixels(0) - expected.sum[0]).abs() < 1e-5 * expected.sum[0],
            "step {step}: got {}, expected {}",
            got.in_pixels(0),
            expected.sum[0]
        );
        // Extent without the square of tiles, in pixels of the middle row of the image.
        let sigma = (25.0 * f64::from(0.15 + 0.001 * step as f32)).hypot(0.3f64.sqrt());
        let half = sigma * (2.0 * (255.0f64 * 0.95).ln()).sqrt();
        let drawn = render(&one, &camera, [0.0; 3]);
        let in_row = (0..64).filter(|&x| pixel(&drawn, x, 32)[0] > 0.0).count();
        cut += usize::from(in_row < 2 * half as usize + 1);
    }
    assert!(cut > 5, "only {cut} Gaussians were cut: the rule is not put to the test");
}

#[test]
fn contributions_match_the_oracle_at_every_stride() {
    for (seed, s) in [(11, 1), (12, 2), (13, 3), (14, 4), (15, 7), (16, 40)] {
        let (scene, camera) = (random_gaussians(seed, 400, 0), tilted_camera(67, 45));
        let expected = oracle::render_view(&scene, &camera, [0.0; 3], s);
        let got = measure_contribution(&scene, &camera, s);
        // Doubtful pixels may or may not count an alpha of 1/255.
        let doubtful = expected.doubtful.iter().filter(|&&doubtful| doubtful).count() as f64;
        for i in 0..scene.len() {
            let (sum, max) = (expected.sum[i], expected.max[i]);
            let tolerance = 1e-5 * sum + 1e-7 + if s < 3 { doubtful / 255.0 } else { 2.0 / 255.0 };
            assert!(
                (got.in_pixels(i) - sum).abs() <= tolerance,
                "seed {seed} Gaussian {i}: sum {} for {sum}",
                got.in_pixels(i)
            );
            assert!(
                (f64::from(got.max[i]) - max).abs() <= 1e-5 + 1.0 / 255.0,
                "Gaussian {i}: max {} for {max}",
                got.max[i]
            );
        }
        let (total, expected) =
            ((0..scene.len()).map(|i| got.in_pixels(i)).sum::<f64>(), expected.sum.iter().sum::<f64>());
        assert!((total / expected - 1.0).abs() < 1e-4, "seed {seed}: total {total}, expected {expected}");
    }
}

#[test]
fn weights_and_transmittance_add_up_to_every_pixel() {
    // White Gaussians in front of black: the image is the sum of the weights.
    let (mut scene, camera) = (random_gaussians(21, 500, 0), tilted_camera(70, 41));
    (0..3).for_each(|c| scene.sh.plane_mut(c).fill(0.5 / 0.282_094_8));
    let light: f64 = render(&scene, &camera, [0.0; 3]).data.iter().map(|&v| f64::from(v)).sum::<f64>() / 3.0;
    let contribution = measure_contribution(&scene, &camera, 1);
    let weights: f64 = (0..scene.len()).map(|i| contribution.in_pixels(i)).sum();
    assert!((light / weights - 1.0).abs() < 1e-6, "light {light}, weights {weights}");
}

#[test]
fn stride_larger_than_the_image_counts_nothing() {
    // A stride of 1 counts what the render shows; a stride larger than the image counts nothing.
    let (scene, camera) = (random_gaussians(22, 200, 0), tilted_camera(40, 40));
    assert!(measure_contribution(&scene, &camera, 1).sum.iter().any(|&sum| sum > 0));
    assert!(measure_contribution(&scene, &camera, 1000).sum.iter().all(|&sum| sum == 0));
}

#[test]
fn renders_ignore_thread_count_and_kept_buffers() {
    let camera = tilted_camera(131, 77);
    let mut kept = Renderer::new();
    for (seed, count) in [(31, 20_000), (32, 300), (33, 9000)] {
        let scene = random_gaussians(seed, count, 1);
        let expected = (kept.render(&scene, &camera, [0.2; 3]), {
            let mut contribution = Contribution::new(count);
            kept.contribution(&scene, &camera, nonzero(2), &mut contribution);
            contribution
        });
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let got = pool.install(|| (render(&scene, &camera, [0.2; 3]), measure_contribution(&scene, &camera, 2)));
            assert!(got == expected, "seed {seed}: {threads} threads differ from the single-thread renderer");
        }
    }
}

#[test]
fn contributions_ignore_the_order_of_renders() {
    let scene = random_gaussians(41, 500, 0);
    let cameras: Vec<Camera> = (0..4)
        .map(|k| Camera { translation: DVec3::new(0.2 * f64::from(k), 0.0, 0.1), ..tilted_camera(50, 50) })
        .collect();
    let mut forward = Contribution::new(scene.len());
    cameras.iter().for_each(|camera| contribution(&scene, camera, nonzero(1), &mut forward));
    let mut parts: Vec<Contribution> = cameras.iter().map(|camera| measure_contribution(&scene, camera, 1)).collect();
    let mut backward = parts.pop().unwrap();
    parts.iter().rev().for_each(|part| backward.merge(part));
    assert_eq!(forward, backward);
}

#[test]
fn equally_deep_gaussians_are_drawn_in_index_order() {
    let mut two = Gaussians::zeros(2, 0);
    for i in 0..2 {
        two.position.set_row(i, [0.0, 0.0, 2.0]);
        two.log_scale.set_row(i, [-1.0; 3]);
        two.opacity_logit.set_row(i, [2.0]);
        two.sh.set_row(i, if i == 0 { [1.5, -9.0, -9.0] } else { [-9.0, 1.5, -9.0] });
    }
    let [red, green, _] = pixel(&render(&two, &plain_camera(32), [0.0; 3]), 16, 16);
    assert!(red > 4.0 * green, "the first of two at one place is in front: red {red}, green {green}");
}

// Case 26 of the table in `tests/extremes/main.rs`.
#[test]
fn gaussians_nearer_than_0_2_or_behind_are_not_drawn() {
    for depth in [-3.0, -0.1, 0.0, 0.1999, 0.2] {
        let image = render(&single_gaussian(depth, 0.5, 0.9), &plain_camera(32), [0.5; 3]);
        assert!(image.data.iter().all(|&v| v == 0.5), "something is drawn at depth {depth}");
    }
    // The camera is inside a Gaussian whose center is beyond the near plane: it is drawn.
    let image = render(&single_gaussian(0.25, 300.0, 0.9), &plain_camera(32), [0.5; 3]);
    assert!((pixel(&image, 0, 31)[0] - 0.95).abs() < 1e-4, "got {:?}", pixel(&image, 0, 31));
}

// Case 27 of the table in `tests/extremes/main.rs`.
#[test]
fn giant_across_the_near_plane_covers_just_the_image() {
    for log_scale in [7.0, 14.0, 80.0, 1e3, 3e38] {
        let mut giant = single_gaussian(0.21, 1.0, 0.9);
        giant.log_scale.set_row(0, [log_scale; 3]);
        let pixels = measure_contribution(&giant, &plain_camera(40), 1).in_pixels(0);
        assert!(
            (pixels - 0.9 * 1600.0).abs() < 1e-2,
            "scale e^{log_scale}: {pixels} pixels, expected {}",
            0.9 * 1600.0
        );
    }
}

// Case 29 of the table in `tests/extremes/main.rs`.
#[test]
fn occluded_gaussians_contribute_exactly_zero() {
    let mut stack = Gaussians::zeros(4, 0);
    for i in 0..4 {
        stack.position.set_row(i, [0.0, 0.0, 2.0 + i as f32]);
        stack.log_scale.set_row(i, [if i < 3 { 4.0f32 } else { -3.0 }; 3]);
        stack.opacity_logit.set_row(i, [3.9]);
    }
    let contribution = measure_contribution(&stack, &plain_camera(32), 1);
    // Each of the first two leaves a transmittance of 1/50; the third would go below 1e-4 and ends the pixel without
    // being blended.
    assert!(contribution.sum[0] > 0 && contribution.sum[1] > 0, "the two in front are seen: {:?}", contribution.sum);
    assert_eq!((contribution.sum[3], contribution.max[3]), (0, 0.0));
}

// Case 30 of the table in `tests/extremes/main.rs`.
#[test]
fn giant_background_is_visible_around_the_foreground() {
    let mut both = Gaussians::zeros(2, 0);
    both.position.set_row(0, [0.0, 0.0, 1000.0]);
    both.log_scale.set_row(0, [1e6f32.ln(); 3]);
    both.opacity_logit.set_row(0, [5.0]);
    both.position.set_row(1, [0.0, 0.0, 2.0]);
    both.log_scale.set_row(1, [-3.0f32; 3]);
    both.opacity_logit.set_row(1, [1.0]);
    let contribution = measure_contribution(&both, &plain_camera(64), 1);
    assert!(
        contribution.in_pixels(0) > 3900.0 && contribution.in_pixels(1) > 5.0,
        "got {} and {}",
        contribution.in_pixels(0),
        contribution.in_pixels(1)
    );
}

#[test]
fn nonfinite_gaussians_are_not_drawn() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for place in 0..3 {
            let mut one = single_gaussian(2.0, 0.1, 0.9);
            match place {
                0 => one.position.set_row(0, [bad, 0.0, 2.0]),
                1 => one.position.set_row(0, [0.0, 0.0, bad]),
                _ => one.rotation.set_row(0, [1.0, bad, 0.0, 0.0]),
            }
            let image = render(&one, &plain_camera(32), [0.5; 3]);
            assert!(image.data.iter().all(|&v| v == 0.5), "{bad} at {place} is drawn");
        }
    }
}

#[test]
fn empty_scenes_and_images_are_valid() {
    let image = render(&Gaussians::zeros(0, 3), &plain_camera(17), [0.1, 0.2, 0.3]);
    assert!(image.data.chunks_exact(3).all(|pixel| pixel == [0.1, 0.2, 0.3]));
    let nothing = Camera { width: 0, height: 0, ..plain_camera(16) };
    assert!(render(&single_gaussian(2.0, 0.1, 0.5), &nothing, [0.0; 3]).data.is_empty());
    assert_eq!(measure_contribution(&single_gaussian(2.0, 0.1, 0.5), &nothing, 1).sum, [0]);
}
