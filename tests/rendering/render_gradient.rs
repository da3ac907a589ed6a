//! Tests that compare gradients of the rasterizer with differences of the f64 oracle (slow reference), closed forms and
//! invariants.

use std::path::Path;

use glam::DVec3;
use splatsieve::diagnostics::selfcheck::generated::clouds::{
    Random, plain_camera, random_gaussians, single_gaussian, tilted_camera,
};
use splatsieve::diagnostics::selfcheck::oracle::render as oracle;
use splatsieve::model::{Attributes, Camera, Gaussians, Gradients, StoredParams};
use splatsieve::models::ModelFolder;
use splatsieve::render::{Image, Renderer, render};
use splatsieve::source::FrameSource;

const BACKGROUND: [f32; 3] = [0.1, 0.9, 0.4];

/// Returns the gradients of a loss with respect to the attributes of `gaussians`. `pull` returns the derivative of the
/// loss with respect to the image.
fn gradients(gaussians: &Gaussians, camera: &Camera, pull: impl FnOnce(&Image) -> Image) -> Gradients {
    let mut gradients = Gradients::new(gaussians.len(), Attributes::all(), gaussians.sh_degree());
    Renderer::new().gradient(gaussians, camera, BACKGROUND, |image| (0.0, pull(image)), &mut gradients);
    gradients
}

/// Returns an image with the same value in all pixels.
fn plain_image(camera: &Camera, value: [f32; 3]) -> Image {
    let pixels = camera.width as usize * camera.height as usize;
    Image { width: camera.width, height: camera.height, data: value.repeat(pixels) }
}

/// Returns two points for a central difference: `x` minus `step` and `x` plus `step` as f32, and their exact difference
/// in f64.
fn step_both_ways(x: f32, step: f32) -> ([f32; 2], f64) {
    let both = [x - step, x + step];
    (both, f64::from(both[1]) - f64::from(both[0]))
}

#[test]
fn gradients_match_central_differences_of_the_oracle() {
    for (seed, count, degree, width, height) in [(1, 300, 3, 67, 45), (2, 900, 1, 64, 64), (3, 40, 2, 33, 100)] {
        let (gaussians, camera) = (random_gaussians(seed, count, degree), tilted_camera(width, height));
        // The loss is half the squared difference from noise, over the pixels in which f32 makes the same decisions as
        // f64.
        let sure: Vec<f64> = oracle::render_view(&gaussians, &camera, BACKGROUND, 1)
            .doubtful
            .iter()
            .map(|&doubtful| if doubtful { 0.0 } else { 1.0 })
            .collect();
        let mut random = Random(seed + 100);
        let target: Vec<f32> = (0..3 * sure.len()).map(|_| random.next_f32()).collect();
        let found = gradients(&gaussians, &camera, |image| Image {
            data: (0..target.len()).map(|at| sure[at / 3] as f32 * (image.data[at] - target[at])).collect(),
            ..*image
        });

        let blended = oracle::blended_indices(&gaussians, &camera);
        let loss = |changed: &Gaussians| -> f64 {
            let pixels = oracle::render_blended(changed, &camera, BACKGROUND, &blended);
            let square = |at: usize| (pixels[at / 3][at % 3] - f64::from(target[at])).powi(2);
            (0..target.len()).map(|at| 0.5 * sure[at / 3] * square(at)).sum()
        };
        for column in Attributes::all().iter() {
            let got = found.derivatives(column).planes();
            let mut largest: Vec<usize> = (0..got.len()).collect();
            largest.sort_by(|&a, &b| got[b].abs().total_cmp(&got[a].abs()));
            for &at in largest.iter().take(60) {
                let mut changed = gaussians.clone();
                let (both, apart) = step_both_ways(gaussians.attribute_values(column).planes()[at], 3e-5);
                let losses = both.map(|x| {
                    changed.attribute_values_mut(column).planes_mut()[at] = x;
                    loss(&changed)
                });
                let expected = (losses[1] - losses[0]) / apart;
                let got = f64::from(got[at]);
                // The set of blended Gaussians is fixed beforehand, so the loss has kinks (an alpha of 0.99, a channel
                // at 0) but no steps. The rest is the error of f32: sums of terms of both signs, and the render they
                // start from.
                let tolerance = 5e-4 * expected.abs();
                assert!(
                    (got - expected).abs() <= tolerance,
                    "seed {seed}, {} {} of Gaussian {}: got {got}, expected {expected} ± {tolerance}",
                    column.name(),
                    at / count,
                    at % count
                );
            }
        }
    }
}

#[test]
fn gradient_of_one_gaussian_is_its_closed_form() {
    // An isotropic Gaussian on the axis has variance (f·s/z)² + 0.3 about the center of the image.
    let (size, depth, scale, opacity) = (48u32, 2.0f64, 0.08f64, 0.7f64);
    let (gaussians, camera) = (single_gaussian(depth as f32, scale as f32, opacity as f32), plain_camera(size));
    let seen = (50.0 * scale / depth).powi(2);
    let (variance, middle) = (seen + 0.3, f64::from(size) / 2.0 - 0.5);
    // The loss is the sum of a channel; the contrast is the color minus the background.
    for (channel, contrast) in [(0, 1.0 - 0.1), (1, 0.5 - 0.9), (2, 0.0 - 0.4)] {
        let mut weights: [f32; 3] = [0.0; 3];
        weights[channel] = 1.0;
        let found = gradients(&gaussians, &camera, |_| plain_image(&camera, weights));
        let mut alphas = 0.0;
        let mut squares = [0.0; 2];
        for y in 0..size {
            for x in 0..size {
                let offset = [x, y].map(|at| f64::from(at) - middle);
                let alpha = opacity * (-0.5 * (offset[0].powi(2) + offset[1].powi(2)) / variance).exp();
                if alpha >= 1.0 / 255.0 {
                    alphas += alpha;
                    (0..2).for_each(|k| squares[k] += alpha * offset[k].powi(2));
                }
            }
        }
        let close = |what: &str, got: f32, expected: f64| {
            let tolerance = 1e-5 * alphas;
            let error = (f64::from(got) - expected).abs();
            assert!(error <= tolerance, "channel {channel}, {what}: got {got}, expected {expected} ± {tolerance}");
        };
        let row = |column| found.derivatives(column);
        close("logit", row(Attributes::OPACITY).plane(0)[0], (1.0 - opacity) * contrast * alphas);
        // Blue is clamped at 0.
        let color = if channel == 2 { 0.0 } else { splatsieve::model::SH_C0 * alphas };
        (0..3).for_each(|c| close("sh", row(Attributes::SH).plane(c)[0], if c == channel { color } else { 0.0 }));
        let widths = squares.map(|square| contrast * square * seen / variance.powi(2));
        close("scale x", row(Attributes::LOG_SCALE).plane(0)[0], widths[0]);
        close("scale y", row(Attributes::LOG_SCALE).plane(1)[0], widths[1]);
        // The Gaussian has no extent along the line of sight, a ball looks the same in every rotation, and the pixels
        // on both sides of the center are equal.
        close("scale z", row(Attributes::LOG_SCALE).plane(2)[0], 0.0);
        (0..4).for_each(|c| close("rotation", row(Attributes::ROTATION).plane(c)[0], 0.0));
        (0..2).for_each(|c| close("position", row(Attributes::POSITION).plane(c)[0], 0.0));
        // Twice the distance is half the size.
        close("depth", row(Attributes::POSITION).plane(2)[0], -(widths[0] + widths[1]) / depth);
    }
}

#[test]
fn image_moves_by_focal_length_over_depth() {
    // The loss is the first moment of the image along u. Its derivative with respect to the position x is Σ alpha times
    // contrast and f/z.
    let (gaussians, camera) = (single_gaussian(2.0, 0.05, 0.6), plain_camera(48));
    let found = gradients(&gaussians, &camera, |image| {
        let mut moment = plain_image(&camera, [0.0; 3]);
        (0..moment.data.len()).step_by(3).for_each(|at| moment.data[at] = ((at / 3) as u32 % image.width) as f32);
        moment
    });
    let image = render(&gaussians, &camera, [0.0; 3]);
    // Alpha drops from 1/255 to 0 at the edge of the splat. By integration by parts, the derivative is therefore Σ
    // (alpha − 1/255) times contrast and f/z.
    let above = |red: f32| (f64::from(red) - 1.0 / 255.0).max(0.0);
    let red: f64 = image.data.chunks_exact(3).map(|pixel| above(pixel[0])).sum();
    let expected = red * (1.0 - 0.1) * 50.0 / 2.0;
    let got = f64::from(found.derivatives(Attributes::POSITION).plane(0)[0]);
    // The sum over whole pixels is the integral, except for pixels on the edge.
    assert!((got / expected - 1.0).abs() < 0.005, "got {got}, expected {expected}");
}

#[test]
fn gradients_ignore_threads_buffers_frozen_attributes() {
    let camera = tilted_camera(131, 77);
    let noise = |image: &Image| {
        let mut random = Random(7);
        Image { data: image.data.iter().map(|x| x - random.next_f32()).collect(), ..*image }
    };
    let mut kept = Renderer::new();
    for (seed, count) in [(31, 20_000), (32, 300), (33, 9000)] {
        let scene = random_gaussians(seed, count, 2);
        let with = |renderer: &mut Renderer, columns, degree| {
            let mut found = Gradients::new(count, columns, degree);
            let value = renderer.gradient(&scene, &camera, BACKGROUND, |image| (1.5, noise(image)), &mut found);
            assert_eq!(value, 1.5);
            found
        };
        let expected = with(&mut kept, Attributes::all(), 2);
        for threads in [1, 2, 3] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let got = pool.install(|| with(&mut Renderer::on_all_threads(), Attributes::all(), 2));
            assert!(got == expected, "seed {seed}: {threads} threads differ from the single-thread renderer");
        }
        for columns in
            [Attributes::SH, Attributes::POSITION | Attributes::OPACITY, Attributes::all(), Attributes::empty()]
        {
            let got = with(&mut kept, columns, 0);
            for column in columns.iter() {
                let planes = got.derivatives(column).planes();
                assert!(
                    planes == &expected.derivatives(column).planes()[..planes.len()],
                    "{columns:?}: {}",
                    column.name()
                );
                assert!(planes.iter().any(|&x| x != 0.0));
            }
            assert!(Attributes::all().difference(columns).iter().all(|column| got.derivatives(column).is_empty()));
        }
    }
}

#[test]
fn gradients_of_several_renders_add_up() {
    let (scene, views) = (random_gaussians(51, 200, 1), [tilted_camera(40, 40), tilted_camera(50, 30)]);
    let mut both = Gradients::new(200, Attributes::all(), 1);
    let mut renderer = Renderer::new();
    for camera in &views {
        renderer.gradient(&scene, camera, BACKGROUND, |image| (0.0, image.clone()), &mut both);
    }
    let apart = views.each_ref().map(|camera| gradients(&scene, camera, Image::clone));
    for column in Attributes::all().iter() {
        let [first, second] = [0, 1].map(|k: usize| apart[k].derivatives(column).planes());
        let sums = first.iter().zip(second).map(|(a, b)| a + b);
        // A position gets two contributions from each render.
        let close = |(&got, expected): (&f32, f32)| (got - expected).abs() <= 1e-6 * (1.0 + expected.abs());
        assert!(both.derivatives(column).planes().iter().zip(sums).all(close), "{}", column.name());
    }
    both.clear();
    assert!(both == Gradients::new(200, Attributes::all(), 1));
}

#[test]
fn extremes_give_finite_gradients_and_undrawn_ones_zero() {
    let camera = plain_camera(40);
    let extremes: [fn(&mut Gaussians); 16] = [
        |g| g.log_scale.set_row(0, [40.0f32; 3]),
        |g| g.log_scale.set_row(0, [-40.0f32; 3]),
        |g| g.log_scale.set_row(0, [40.0f32, -40.0, 1.0]),
        |g| g.log_scale.set_row(0, [f32::MAX, -f32::MAX, 0.0]),
        |g| g.opacity_logit.set_row(0, [1e4]),
        |g| g.opacity_logit.set_row(0, [-1e4]),
        |g| g.rotation.set_row(0, [0.0f32; 4]),
        |g| g.rotation.set_row(0, [1e-45f32, 1e-45, 0.0, 0.0]),
        |g| g.rotation.set_row(0, [f32::MAX; 4]),
        |g| g.sh.set_row(0, [f32::INFINITY, 0.0, 1.0]),
        |g| g.sh.set_row(0, [f32::MAX, f32::NEG_INFINITY, f32::NAN]),
        |g| g.sh.plane_mut(5)[0] = f32::INFINITY,
        |g| g.position.set_row(0, [0.0, 0.0, 0.200_001]),
        |g| g.position.set_row(0, [f32::NAN, 0.0, 2.0]),
        |g| g.log_scale.set_row(0, [f32::NAN, 0.0, 0.0]),
        |g| g.rotation.set_row(0, [1.0, f32::NAN, 0.0, 0.0]),
    ];
    for (k, extreme) in extremes.into_iter().enumerate() {
        let mut scene = random_gaussians(61, 50, 1);
        // The extreme Gaussian is in front of the camera.
        scene.position.set_row(0, [0.02, -0.03, 2.0]);
        scene.rotation.set_row(0, [1.0, 0.3, -0.2, 0.5]);
        extreme(&mut scene);
        let found = gradients(&scene, &camera, Image::clone);
        for column in Attributes::all().iter() {
            let planes = found.derivatives(column).planes();
            assert!(planes.iter().all(|x| x.is_finite()), "extreme {k}, {}: not finite", column.name());
            // The last three extremes and the one that is too faint are not drawn.
            let is_zero = (0..found.derivatives(column).width()).all(|c| found.derivatives(column).plane(c)[0] == 0.0);
            assert!(is_zero || (k < 13 && k != 5), "extreme {k}, {}: {planes:?}", column.name());
        }
        assert!(found.derivatives(Attributes::SH).planes().iter().any(|&x| x != 0.0), "extreme {k}: nothing is left");
    }
}

#[test]
fn gradient_of_an_image_filling_gaussian_is_its_alpha() {
    let mut wall = single_gaussian(2.0, 1.0, 0.6);
    wall.log_scale.set_row(0, [40.0f32; 3]);
    let camera = plain_camera(40);
    let found = gradients(&wall, &camera, |_| plain_image(&camera, [1.0, 0.0, 0.0]));
    let expected = 0.6 * 0.4 * (1.0 - 0.1) * 1600.0;
    let got = found.derivatives(Attributes::OPACITY).plane(0)[0];
    assert!((got / expected - 1.0).abs() < 1e-5, "logit: got {got}, expected {expected}");
    assert!(found.derivatives(Attributes::LOG_SCALE).planes().iter().all(|x| x.abs() < 1e-3), "it has no edge");
}

#[test]
fn clamped_alpha_has_gradients_only_for_color() {
    let mut wall = single_gaussian(2.0, 1.0, 0.999);
    wall.log_scale.set_row(0, [5.0f32; 3]);
    let camera = plain_camera(40);
    let found = gradients(&wall, &camera, |_| plain_image(&camera, [1.0; 3]));
    for column in Attributes::all().difference(Attributes::SH).iter() {
        assert!(found.derivatives(column).planes().iter().all(|&x| x == 0.0), "{} moves", column.name());
    }
    let got = f64::from(found.derivatives(Attributes::SH).plane(0)[0]);
    let expected = splatsieve::model::SH_C0 * 0.99 * 1600.0;
    assert!((got / expected - 1.0).abs() < 1e-5, "color: got {got}, expected {expected}");
}

#[test]
fn nonfinite_pixels_have_no_gradient() {
    let (scene, camera) = (random_gaussians(71, 300, 1), tilted_camera(50, 40));
    let spoiled = |value: f32| {
        gradients(&scene, &camera, |image| {
            let mut pull = image.clone();
            (30..33).for_each(|c| pull.data[3 * 777 + c] = value);
            pull
        })
    };
    let expected = spoiled(0.0);
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert!(spoiled(value) == expected, "{value}");
    }
    assert!(expected != gradients(&scene, &camera, Image::clone), "the pixel says nothing");
}

#[test]
fn stored_positions_get_gradients_through_the_field() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny_model");
    let model = ModelFolder::open(&root, None).unwrap().with_times(vec![0.0, 0.4, 1.0]).unwrap();
    let (deformation, frame) = (model.deformation().unwrap(), 1);
    let stored = deformation.stored();
    let state_of = |stored: &StoredParams| {
        let mut state = Gaussians::zeros(0, stored.gaussians.sh_degree());
        deformation.with_params(stored).state(frame, Attributes::all(), &mut state).unwrap();
        state
    };
    let state = state_of(stored);
    let camera = Camera::look_at(DVec3::new(0.5, -4.0, 1.0), DVec3::ZERO, 0.7, (64, 64));
    let blended = oracle::blended_indices(&state, &camera);
    let sure: Vec<f64> = oracle::render_view(&state, &camera, BACKGROUND, 1)
        .doubtful
        .iter()
        .map(|&doubtful| if doubtful { 0.0 } else { 1.0 })
        .collect();
    let mut random = Random(7);
    let target: Vec<f32> = (0..3 * sure.len()).map(|_| random.next_f32()).collect();
    let mut found = gradients(&state, &camera, |image| Image {
        data: (0..target.len()).map(|at| sure[at / 3] as f32 * (image.data[at] - target[at])).collect(),
        ..*image
    });
    let direct = found.clone();
    deformation.with_params(stored).jacobian(frame, Attributes::all()).unwrap().pull_back(&mut found);

    let loss = |stored: &StoredParams| -> f64 {
        // A step of the position changes other attributes through the field, which the derivative by the position head
        // does not include.
        let moved = Gaussians { position: state_of(stored).position, ..state.clone() };
        let pixels = oracle::render_blended(&moved, &camera, BACKGROUND, &blended);
        let square = |at: usize| (pixels[at / 3][at % 3] - f64::from(target[at])).powi(2);
        (0..target.len()).map(|at| 0.5 * sure[at / 3] * square(at)).sum()
    };
    let got = found.derivatives(Attributes::POSITION).planes();
    let mut largest: Vec<usize> = (0..got.len()).collect();
    largest.sort_by(|&a, &b| got[b].abs().total_cmp(&got[a].abs()));
    let (mut off, mut through_field) = (0, 0);
    for &at in largest.iter().take(60) {
        let mut changed = stored.clone();
        let (both, apart) = step_both_ways(stored.gaussians.position.planes()[at], 2e-4);
        let losses = both.map(|x| {
            changed.gaussians.position.planes_mut()[at] = x;
            loss(&changed)
        });
        let expected = (losses[1] - losses[0]) / apart;
        // States are f32, and some steps cross the edge of a texel or a ReLU.
        off += usize::from((f64::from(got[at]) - expected).abs() > 0.01 * expected.abs());
        let alone = direct.derivatives(Attributes::POSITION).planes()[at];
        through_field += usize::from((alone - got[at]).abs() > 0.03 * got[at].abs());
    }
    assert!(off <= 3, "{off} of 60 derivatives are off");
    assert!(through_field > 20, "the field adds to {through_field} of 60 derivatives only");
}

#[test]
fn empty_scenes_and_images_have_valid_gradients() {
    assert!(gradients(&Gaussians::zeros(0, 1), &plain_camera(17), Image::clone).is_empty());
    let nothing = Camera { width: 0, height: 0, ..plain_camera(16) };
    let found = gradients(&single_gaussian(2.0, 0.1, 0.5), &nothing, Image::clone);
    assert!(found == Gradients::new(1, Attributes::all(), 0));
}
