//! Measures how many Gaussians per second tracking links to Gaussians of the frame before and joins over gaps, on one
//! thread and on two.
//!
//! The cases differ in the frames, each of which has its Gaussians in another order:
//! - `still` repeats every Gaussian to the bit.
//! - `moving` moves each Gaussian on a circle of its own.
//! - `noisy` adds noise to the positions, with a standard deviation of 2% of the size of a Gaussian.
//! - `lives` also removes a seventh of the Gaussians in each frame.
//! - `crowded` is `noisy` with fifty Gaussians within the size of each Gaussian, instead of four.
//!
//! For comparison, `nearest` searches all pairs in cells as wide as the mean distance and takes the nearest Gaussian,
//! whatever its appearance. It shows the cost of the search alone.
//!
//! Usage: `cargo bench --bench link`. The goal is a million Gaussians per second and core.

use std::collections::HashMap;
use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use splatsieve::model::Gaussians;
use splatsieve::model::hash_id;
use splatsieve::tracking::{Joiner, Linker};

const COUNT: usize = 60_000;
const FRAMES: usize = 6;

fn uniform(k: u64) -> f32 {
    (hash_id(k) >> 40) as f32 / (1u64 << 24) as f32
}

/// Returns the frames of moving Gaussians, each frame in an order of its own. The typical size of the Gaussians follows
/// from `crowd`: a cube with a side of twice this size holds about `crowd` Gaussians.
///
/// - `motion`: angle in radians by which each Gaussian moves on its circle per frame.
/// - `noise`: width of the uniform noise of positions, as a multiple of the typical size.
/// - `lives`: whether a seventh of the Gaussians is missing in each frame.
fn frames(crowd: f32, motion: f32, noise: f32, lives: bool) -> Vec<Gaussians> {
    let size = (crowd / COUNT as f32).cbrt() * 0.5;
    let frame = |t: usize| {
        let mut order: Vec<u32> =
            (0..COUNT as u32).filter(|&i| !lives || !(i as usize + t).is_multiple_of(7)).collect();
        order.sort_by_key(|&i| hash_id(u64::from(i) ^ (t as u64) << 40));
        let mut state = Gaussians::zeros(order.len(), 0);
        for (row, &i) in order.iter().enumerate() {
            let value = |k: u64| uniform(u64::from(i) * 64 + k);
            let angle = motion * t as f32 * if i % 2 == 0 { 1.0 } else { -1.0 };
            let jitter = |c: u64| noise * size * (uniform(u64::from(i) * 64 + 32 + c + 3 * t as u64) - 0.5);
            let [x, y, z] = [0, 1, 2].map(|c| value(c) + jitter(c));
            state.position.set_row(row, [x + 0.05 * angle.cos(), y + 0.05 * angle.sin(), z]);
            state.rotation.set_row(row, [3, 4, 5, 6].map(|k| value(k) - 0.5));
            state.log_scale.set_row(row, [7, 8, 9].map(|k| size.ln() + 2.0 * value(k) - 1.0));
            state.opacity_logit.set_row(row, [6.0 * value(10) - 3.0]);
            state.sh.set_row(row, [11, 12, 13].map(|k| 3.0 * value(k) - 1.5));
        }
        state
    };
    (0..FRAMES).map(frame).collect()
}

fn linked(frames: &[Gaussians]) -> usize {
    let (mut linker, mut joiner) = (Linker::default(), Joiner::default());
    let link = |frame| {
        let linked = linker.link(frame).linked;
        joiner.add_frame(&linker);
        linked
    };
    frames.iter().map(link).sum()
}

fn nearest(before: &Gaussians, after: &Gaussians) -> usize {
    let side = (COUNT as f32).cbrt().recip();
    let place = |state: &Gaussians, i: usize| state.position.row::<3>(i).map(|x| (x / side).floor() as i32);
    let mut cells: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
    (0..after.len()).for_each(|i| cells.entry(place(after, i)).or_default().push(i as u32));
    let mut found = 0;
    for i in 0..before.len() {
        let (at, [x, y, z]) = (before.position.row::<3>(i), place(before, i));
        let mut best = (f32::INFINITY, 0);
        for cell in (0..27).map(|k| [x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1]) {
            for &other in cells.get(&cell).into_iter().flatten() {
                let to = after.position.row::<3>(other as usize);
                let distance = (0..3).map(|c| (to[c] - at[c]).powi(2)).sum::<f32>();
                if (distance, other) < best {
                    best = (distance, other);
                }
            }
        }
        found += usize::from(best.0.is_finite());
    }
    found
}

fn benches(criterion: &mut Criterion) {
    let cases = [
        ("still", frames(4.0, 0.0, 0.0, false)),
        ("moving", frames(4.0, 0.1, 0.0, false)),
        ("noisy", frames(4.0, 0.1, 0.07, false)),
        ("lives", frames(4.0, 0.1, 0.07, true)),
        ("crowded", frames(50.0, 0.1, 0.07, false)),
    ];
    let mut group = criterion.benchmark_group("link");
    group.sample_size(10);
    for (name, frames) in &cases {
        let states: usize = frames.iter().map(Gaussians::len).sum();
        group.throughput(Throughput::Elements(states as u64));
        for threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            group.bench_function(BenchmarkId::new(*name, threads), |bencher| {
                bencher.iter(|| pool.install(|| black_box(linked(frames))));
            });
        }
        group.bench_function(BenchmarkId::new(format!("{name}_nearest"), 1), |bencher| {
            bencher.iter(|| frames.windows(2).map(|pair| nearest(&pair[0], &pair[1])).sum::<usize>());
        });
    }
}

criterion_group!(group, benches);
criterion_main!(group);
