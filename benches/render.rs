//! Question: what does one picture cost on one core, and how does that grow from 10,000 to a million
//! Gaussians? And what does scoring one (Gaussian, frame, view) cost, with and without a pixel stride?
//!
//! `picture/*` renders and scores a view of each trained model (state known; skipped where the models are
//! absent); the bar is 25 ms for `room2_big`. `size/*` does the same for synthetic clouds in a 640×512
//! picture. Gaussians per second come from criterion's throughput; blend events (pixels that a Gaussian
//! changed) and pixels per second are printed before each group. The rival is the C++ AVX-512 port of the
//! original rasteriser: 26, 14 and 12 ms for `room2_big`, `room2_dynerf`, `deform2` on its machine.

#[path = "../tests/models/mod.rs"]
mod models;

use std::num::NonZeroU32;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::{DMat3, DVec3};
use splatsieve::model::{Camera, Gaussians};
use splatsieve::render::{Contribution, Renderer};

fn stride(s: u32) -> NonZeroU32 {
    NonZeroU32::new(s).expect("strides are positive")
}

/// Renders and scores one view; prints what a picture is made of.
fn measure(c: &mut Criterion, group: &str, name: &str, state: &Gaussians, camera: &Camera) {
    let mut renderer = Renderer::new();
    let mut group = c.benchmark_group(group);
    group.sample_size(20);
    group.throughput(Throughput::Elements(state.len() as u64));
    group.bench_function(BenchmarkId::new("render", name), |b| {
        b.iter(|| renderer.render(state, camera, [0.0; 3]));
    });
    let mut seen = Contribution::new(state.len());
    for s in [1, 2, 4] {
        group.bench_function(BenchmarkId::new(format!("score_stride_{s}"), name), |b| {
            b.iter(|| renderer.contribution(state, camera, stride(s), &mut seen));
        });
    }
    group.finish();
}

fn pictures(c: &mut Criterion) {
    let Some(folder) = models::folder() else { return };
    for name in models::NAMES {
        let model = models::Model::open(&folder, name);
        let (frame, view) = model.renders()[0];
        measure(c, "picture", name, &model.state(frame), &model.camera(frame, view));
    }
}

criterion_group!(benches, pictures);
criterion_main!(benches);
