//! Question: what does one picture cost on one core, and how does that grow from 10,000 to a million
//! Gaussians? What does scoring one (Gaussian, frame, view) cost, with and without a pixel stride? And what does a
//! picture cost together with its derivative?
//!
//! `picture/*` renders and scores a view of each trained model, its state known (skipped where the models
//! are absent); the bar is 25 ms for `room2_big`. `size/*` does the same for synthetic clouds in a 640×512
//! picture. criterion's throughput is Gaussians per second, so for `score` its inverse is the cost of one
//! (Gaussian, frame, view); before each group the Gaussians, pixels and blend events (pixels that a Gaussian
//! changed, counted by the tests' oracle) of the picture are printed, and how many of each a second at the
//! median time of some renders. The rival is the C++ AVX-512 port of the
//! original rasteriser, measured elsewhere: 26, 14 and 12 ms for `room2_big`, `room2_dynerf`, `deform2`.
//!
//! The bar for `gradient`, a picture with the derivative of its squared error by every stored value, is 2.6 times the
//! picture alone; before each group the ratio is printed, of medians of pictures and derivatives taken by turns. What
//! the loss takes to subtract two pictures counts. `picture/demo` is a view of the demo scene.
//!
//! Times are wall-clock: on a busy machine they are several times the cost. Criterion arguments filter:
//! `cargo bench --bench render -- picture`.

#[path = "../tests/models/mod.rs"]
mod models;

use std::hint::black_box;
use std::num::NonZeroU32;
use std::time::Instant;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::{DMat3, DVec3};
use splatsieve::demo::Scene;
use splatsieve::model::{Camera, Columns, Gaussians, Gradients};
use splatsieve::render::{Contribution, Image, Renderer};
use splatsieve::selfcheck::oracle::picture as oracle;
use splatsieve::source::{FrameSource, Ids};

/// Pictures, without and with their derivative, whose median times give the rates and the ratio.
const PICTURES: usize = 21;

/// Renders and scores one view.
fn measure(criterion: &mut Criterion, group: &str, name: &str, state: &Gaussians, camera: &Camera) {
    let events = oracle::picture(state, camera, [0.0; 3], 1).events;
    let (count, pixels) = (state.len(), u64::from(camera.width) * u64::from(camera.height));
    let mut renderer = Renderer::new();
    let target = renderer.render(state, camera, [0.5; 3]);
    // The derivative of half the squared error; nobody reads its value.
    let squared_error = |picture: &Image| {
        let pull: Vec<f32> = picture.data.iter().zip(&target.data).map(|(a, b)| a - b).collect();
        (0.0, Image { data: pull, ..*picture })
    };
    let mut gradients = Gradients::new(count, Columns::all(), state.sh_degree());
    // By turns, so that what else the machine does slows both.
    let (mut pictures, mut derivatives) = (Vec::new(), Vec::new());
    for _ in 0..PICTURES {
        let start = Instant::now();
        drop(black_box(renderer.render(state, camera, [0.0; 3])));
        pictures.push(start.elapsed().as_secs_f64());
        let start = Instant::now();
        black_box(renderer.gradient(state, camera, [0.0; 3], squared_error, &mut gradients));
        derivatives.push(start.elapsed().as_secs_f64());
    }
    let (seconds, differentiated) = (median(pictures), median(derivatives));
    let rate = |amount: f64| amount / seconds / 1e6;
    eprintln!(
        "{group} {name}: {count} Gaussians, {pixels} pixels, {events} blend events in {:.1} ms: {:.1}, {:.1} and {:.0} million a second; with its derivative {:.2} times as long",
        1e3 * seconds,
        rate(count as f64),
        rate(pixels as f64),
        rate(events as f64),
        differentiated / seconds
    );
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

/// The middle one of an odd number of values.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn pictures(criterion: &mut Criterion) {
    let demo = Scene::new(Scene::COUNT, Scene::FRAMES);
    let mut state = Gaussians::zeros(0, demo.info().sh_degree);
    let everything = Ids::Range(0..demo.info().count);
    demo.open(everything).unwrap().read(Scene::FRAMES / 2, Columns::all(), &mut state).unwrap();
    measure(criterion, "picture", "demo", &state, &demo.rig().cameras[0]);
    let Some(folder) = models::found() else { return };
    for name in models::NAMES {
        let model = models::Model::open(&folder, name);
        let (frame, view) = model.renders()[0];
        measure(criterion, "picture", name, &model.state(frame), &model.camera(frame, view));
    }
}

/// `count` Gaussians that fill a box before the camera, smaller the more there are, so that the picture
/// stays about as opaque.
fn cloud(count: usize) -> Gaussians {
    let mut cloud = Gaussians::zeros(count, 3);
    let size = -1.2 - (count as f32).ln() / 3.0;
    for i in 0..count {
        // Additive recurrence of irrational steps: even, and the same everywhere.
        let step = |k: f64| (i as f64 * k).fract() as f32;
        let position = [4.0 * step(0.819_172_51) - 2.0, 3.2 * step(0.671_043_61) - 1.6, 2.0 + 3.0 * step(0.549_700_48)];
        cloud.position.set_row(i, position);
        cloud.rotation.set_row(i, [1.0, step(0.618_034), step(0.754_877_67), step(0.569_840_3)]);
        cloud.log_scale.set_row(i, [size + step(0.380_278), size - step(0.733_891_86), size]);
        cloud.opacity_logit.set_row(i, [8.0 * step(0.856_674_88) - 4.0]);
        for c in 0..48 {
            cloud.sh.plane_mut(c)[i] = 0.3 * step(0.1 + 0.017 * f64::from(c as u8)) - 0.1;
        }
    }
    cloud
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

criterion_group!(benches, pictures, sizes);
criterion_main!(benches);
