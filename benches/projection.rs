//! Measures how many projections of a Gaussian into a view one core makes per second.
//!
//! - `scan/16 views`: a block of 16,384 Gaussians is projected into 16 cameras, and its four needed attributes are
//!   decoded once. This is the inner loop of the scan for a data set with several cameras.
//! - `scan/1 views`: one camera, and every attribute counts as changed in every frame. This is the worst case, a
//!   capture with one moving camera.
//!
//! Usage: `cargo bench --bench projection`

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::{DMat3, DVec3};
use splatsieve::model::hash_id;
use splatsieve::model::{Attributes, Camera, Gaussians, ViewSchedule};
use splatsieve::recipe::Recipe;
use splatsieve::statistics::{BlockScan, ScanPlan};

const GAUSSIANS: usize = 16_384;

fn random(k: usize) -> f32 {
    (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32
}

fn block() -> Gaussians {
    let mut block = Gaussians::zeros(GAUSSIANS, 0);
    for i in 0..GAUSSIANS {
        block.position.set_row::<3>(i, std::array::from_fn(|a| 4.0 * random(16 * i + a) - 2.0));
        block.rotation.set_row::<4>(i, std::array::from_fn(|a| random(16 * i + 3 + a) - 0.5));
        block.log_scale.set_row::<3>(i, std::array::from_fn(|a| -5.0 + 3.0 * random(16 * i + 7 + a)));
        block.opacity_logit.set_row(i, [6.0 * random(16 * i + 10) - 3.0]);
    }
    block
}

fn cameras(views: usize) -> Vec<Camera> {
    (0..views)
        .map(|v| Camera {
            width: 320,
            height: 256,
            fx: 250.0,
            fy: 250.0,
            cx: 160.0,
            cy: 128.0,
            rotation: DMat3::from_rotation_y(v as f64 * 0.4),
            translation: DVec3::new(0.0, 0.0, 4.0),
            near: Camera::NEAR,
        })
        .collect()
}

fn projection(c: &mut Criterion) {
    let scan = Recipe::preset("default").unwrap().scan;
    let block = block();
    let mut group = c.benchmark_group("scan");
    for (views, changed) in [(16, Attributes::POSITION), (1, Attributes::all())] {
        let cameras = cameras(views);
        let mut schedule = ViewSchedule::new(cameras.clone());
        schedule.push_frames(1, &(0..views as u32).map(|v| (v, v)).collect::<Vec<_>>());
        let plan = ScanPlan::new(&scan, &[0.0], &schedule).unwrap();
        let seen: Vec<&Camera> = cameras.iter().collect();
        let mut running = BlockScan::new(GAUSSIANS, 0, &plan);
        let mut t = 0;
        group.throughput(Throughput::Elements((GAUSSIANS * views) as u64));
        group.bench_function(BenchmarkId::from_parameter(format!("{views} views")), |bencher| {
            bencher.iter(|| {
                running.add_frame(t, &block, &seen, changed);
                t += 1;
            });
        });
    }
    group.finish();
}

criterion_group!(benches, projection);
criterion_main!(benches);
