//! Measures the time of a render on one core, of scoring (finding the contributions of all Gaussians to a view), and of
//! a render with its gradients.
//!
//! The images are:
//! - `view/*`: one view of each trained model, with its frame state given (skipped if the models are missing). The
//!   goal is 25 ms for the render of `room2_big`. The C++ AVX-512 port of the original rasterizer takes 26, 14 and 12
//!   ms for `room2_big`, `room2_dynerf` and `deform2`, measured elsewhere.
//! - `view/large`: a 1352×1014 view of 200,313 Gaussians: `room2_dynerf` with each Gaussian split into nine.
//! - `view/demo`: a view of the demo scene.
//! - `size/*`: 10,000 to a million synthetic Gaussians in a 640×512 image.
//!
//! The benchmarks of an image are:
//! - `render`: the render alone.
//! - `gradient`: the render with the derivative of its squared error by every stored value. The goal is 2.6 times the
//!   render alone; `view/large` misses it with 2.7. The ratio of the median times is printed before each group. It
//!   includes the subtraction of two images for the loss.
//! - `score_every_1`, `_2` and `_4`: scoring on every pixel, or every second or fourth in each direction.
//!
//! The throughput that criterion prints is in Gaussians per second, so the inverse of it is the cost of one (Gaussian,
//! frame, view). Before each group the benchmark also prints the numbers of Gaussians, pixels and blend events (pairs
//! of a pixel and a Gaussian that changed it, counted by the oracle of the tests), and how many of each are processed
//! per second at the median time.
//!
//! The times of the parts of a render are differences between medians of renders that lack one part after the other,
//! measured in alternation. Lower bounds are printed below them: for the blend, [`blend_limit`]; for all other parts,
//! the bytes that must be moved at the measured memory bandwidth.
//!
//! Times are wall-clock times: on a busy machine they are several times the cost. Criterion arguments filter: `cargo
//! bench --bench render -- view`.

#[path = "../tests/models/mod.rs"]
mod models;
mod synthetic;

use std::hint::black_box;
use std::num::NonZeroU32;
use std::time::Instant;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::{DMat3, DVec3, Quat, Vec3};
use splatsieve::diagnostics::demo_scene::DemoScene;
use splatsieve::diagnostics::selfcheck::oracle::render as oracle;
use splatsieve::model::{Attributes, Camera, Gaussians, Gradients};
use splatsieve::render::{Contribution, Image, Renderer};
use splatsieve::source::{FrameSource, Ids};

use synthetic::{blend_limit, cloud, fastest};

/// Number of renders from which each median time is computed. The printed rates, and the ratio of a render with
/// gradients to a render without, follow from these medians.
const RENDERS: usize = 21;

/// Measures rendering, scoring and gradients of the Gaussians `state` seen from `camera`, as the benchmark `name` of
/// the group `group`.
fn measure(criterion: &mut Criterion, group: &str, name: &str, state: &Gaussians, camera: &Camera) {
    let events = oracle::render_view(state, camera, [0.0; 3], 1).events;
    let (count, pixels) = (state.len(), u64::from(camera.width) * u64::from(camera.height));
    let mut renderer = Renderer::new();
    let target = renderer.render(state, camera, [0.5; 3]);
    // Derivative of half the squared error; its value is not used.
    let squared_error = |image: &Image| {
        let pull: Vec<f32> = image.data.iter().zip(&target.data).map(|(a, b)| a - b).collect();
        (0.0, Image { data: pull, ..*image })
    };
    let mut gradients = Gradients::new(count, Attributes::all(), state.sh_degree());
    // In alternation, so that other load on the machine slows both.
    let (mut renders, mut derivatives) = (Vec::new(), Vec::new());
    for _ in 0..RENDERS {
        let start = Instant::now();
        drop(black_box(renderer.render(state, camera, [0.0; 3])));
        renders.push(start.elapsed().as_secs_f64());
        let start = Instant::now();
        black_box(renderer.gradient(state, camera, [0.0; 3], squared_error, &mut gradients));
        derivatives.push(start.elapsed().as_secs_f64());
    }
    let (seconds, differentiated) = (median(renders), median(derivatives));
    let rate = |amount: f64| amount / seconds / 1e6;
    eprintln!(
        "{group} {name}: {count} Gaussians, {pixels} pixels, {events} blend events in {:.1} ms: {:.1}, {:.1} and {:.0} million a second; with its derivative {:.2} times as long",
        1e3 * seconds,
        rate(count as f64),
        rate(pixels as f64),
        rate(events as f64),
        differentiated / seconds
    );
    print_parts(&mut renderer, state, camera, events as f64);
    let mut group = criterion.benchmark_group(group);
    group.sample_size(20).throughput(Throughput::Elements(count as u64));
    group.bench_function(BenchmarkId::new("render", name), |b| {
        b.iter(|| renderer.render(state, camera, [0.0; 3]));
    });
    group.bench_function(BenchmarkId::new("gradient", name), |b| {
        b.iter(|| renderer.gradient(state, camera, [0.0; 3], squared_error, &mut gradients));
    });
    let mut seen = Contribution::new(count);
    for stride in [1, 2, 4].into_iter().filter_map(NonZeroU32::new) {
        group.bench_function(BenchmarkId::new(format!("score_every_{stride}"), name), |b| {
            b.iter(|| renderer.contribution(state, camera, stride, &mut seen));
        });
    }
    group.finish();
}

/// Prints the time of the parts of one render (project, sort, harmonics, blend), and lower bounds for the blend and for
/// the memory traffic. `events` is the number of blend events: pairs of a pixel and a Gaussian that changes it.
fn print_parts(renderer: &mut Renderer, state: &Gaussians, camera: &Camera, events: f64) {
    let gray = Gaussians { sh: Gaussians::zeros(state.len(), 0).sh, ..state.clone() };
    let empty = Camera { width: 0, height: 0, ..camera.clone() };
    let mut seen = Contribution::new(state.len());
    let mut times = [const { Vec::new() }; 4];
    for _ in 0..RENDERS {
        for (lacking, times) in times.iter_mut().enumerate() {
            let start = Instant::now();
            match lacking {
                0 => drop(black_box(renderer.render(state, camera, [0.0; 3]))),
                // Without SH to read.
                1 => drop(black_box(renderer.render(&gray, camera, [0.0; 3]))),
                // Without a pixel to evaluate.
                2 => renderer.contribution(state, camera, NonZeroU32::MAX, &mut seen),
                // Without a tile.
                _ => drop(black_box(renderer.render(state, &empty, [0.0; 3]))),
            }
            times.push(start.elapsed().as_secs_f64());
        }
    }
    let [whole, gray, unseen, projected] = times.map(median);
    let blend = gray - unseen;
    let least = blend_limit(events);
    let pixels = f64::from(camera.width) * f64::from(camera.height);
    let bytes = 4.0 * (11 + state.sh.width()) as f64 * state.len() as f64 + 12.0 * pixels;
    eprintln!(
        "  project {:.1} ms, sort and bin {:.1}, harmonics {:.1}, blend {:.1}: {:.2} ns an event",
        1e3 * projected,
        1e3 * (unseen - projected),
        1e3 * (whole - gray),
        1e3 * blend,
        1e9 * blend / events,
    );
    eprintln!(
        "  at least {:.1} ms for the blend ({:.0}% of what it takes), and {:.1} ms for {:.0} MB of Gaussians and pixels",
        1e3 * least,
        100.0 * least / blend,
        1e3 * bytes / bandwidth(),
        bytes / 1e6,
    );
}

/// Returns the memory bandwidth in bytes per second, measured by reading more memory than the caches hold.
fn bandwidth() -> f64 {
    let words = vec![1u64; 1 << 25];
    fastest(|| {
        black_box(black_box(&words).iter().fold(0, |sum: u64, word| sum.wrapping_add(*word)));
        size_of_val(&words[..]) as f64
    })
}

/// Returns the median of an odd number of values.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn views(criterion: &mut Criterion) {
    let demo = DemoScene::new(DemoScene::DEFAULT_COUNT, DemoScene::DEFAULT_FRAMES);
    let mut state = Gaussians::zeros(0, demo.info().sh_degree);
    let everything = Ids::Range(0..demo.info().count);
    demo.open(everything).unwrap().read(DemoScene::DEFAULT_FRAMES / 2, Attributes::all(), &mut state).unwrap();
    measure(criterion, "view", "demo", &state, &demo.rig().cameras[0]);
    let Some(folder) = models::found() else { return };
    for name in models::NAMES {
        let model = models::Model::open(&folder, name);
        let (frame, view) = model.renders()[0];
        let (state, camera) = (model.state(frame), model.camera(frame, view));
        measure(criterion, "view", name, &state, &camera);
        if name == "room2_dynerf" {
            measure(criterion, "view", "large", &split(&state), &enlarged(&camera, [1352, 1014]));
        }
    }
}

/// Returns `state` with every Gaussian replaced by nine smaller ones, in a grid along its first two axes. Together they
/// are about as opaque as the original.
fn split(state: &Gaussians) -> Gaussians {
    /// Distance between neighbors among the nine Gaussians, in standard deviations of the original Gaussian. The
    /// standard deviation of each is √⅓ of the original's, so that the total variance equals that of the original.
    const APART: f32 = 1.0;
    let parents: Vec<u32> = (0..9 * state.len() as u32).map(|child| child / 9).collect();
    let mut children = state.pick(&parents);
    for child in 0..children.len() {
        let [w, x, y, z] = children.rotation.row(child);
        let turn = Quat::from_xyzw(x, y, z, w).normalize();
        let scale: [f32; 3] = children.log_scale.row(child);
        let place = [child % 9 / 3, child % 3].map(|k| (k as f32 - 1.0) * APART);
        let offset = turn * Vec3::new(place[0] * scale[0].exp(), place[1] * scale[1].exp(), 0.0);
        let position = Vec3::from_array(children.position.row(child)) + offset;
        children.position.set_row(child, position.to_array());
        let narrower = 3f32.ln() / 2.0;
        children.log_scale.set_row(child, [scale[0] - narrower, scale[1] - narrower, scale[2]]);
        let [logit] = children.opacity_logit.row(child);
        // Sum of the nine alphas in the middle, divided by the alpha at the center of one.
        let overlap = (1.0 + 2.0 * (-1.5f32).exp()).powi(2);
        let alpha = 1.0 - (1.0 / (1.0 + logit.exp())).powf(1.0 / overlap);
        children.opacity_logit.set_row(child, [(alpha / (1.0 - alpha)).ln()]);
    }
    children
}

/// Returns `camera` with an image of `size` pixels and the same field of view.
fn enlarged(camera: &Camera, size: [u32; 2]) -> Camera {
    let times = f64::from(size[0]) / f64::from(camera.width);
    let [cx, cy] = size.map(|pixels| f64::from(pixels) / 2.0);
    Camera { width: size[0], height: size[1], fx: camera.fx * times, fy: camera.fy * times, cx, cy, ..camera.clone() }
}

fn sizes(criterion: &mut Criterion) {
    let camera = Camera {
        width: 640,
        height: 512,
        fx: 600.0,
        fy: 600.0,
        cx: 320.0,
        cy: 256.0,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
        near: Camera::NEAR,
    };
    for count in [10_000, 100_000, 1_000_000] {
        measure(criterion, "size", &count.to_string(), &cloud(count), &camera);
    }
}

criterion_group!(benches, views, sizes);
criterion_main!(benches);
