//! Measures the time per value of computing the 1st and the 99th percentile of N values, by which scores are
//! normalized, on one thread.
//!
//! - `sketch`: the method of the program. It counts the values in buckets, then reads them twice more, for the buckets
//!   of the two percentiles.
//! - `count`: only the first of these three passes.
//! - `sort`: sorts a copy of the values.
//! - `select`: selects both percentiles in a copy without sorting it.
//!
//! Values are log-normal, like scores, with 10% zeros.
//!
//! Usage: `cargo bench --bench score`. The time per value is the inverse of the throughput that is printed.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use splatsieve::model::hash_id;
use splatsieve::statistics::score::FloatSketch;

fn value(k: usize) -> f64 {
    let uniform = |salt: u64| ((hash_id(k as u64 | salt << 48) >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
    if uniform(0) < 0.1 {
        return 0.0;
    }
    let normal = (-2.0 * uniform(1).ln()).sqrt() * (std::f64::consts::TAU * uniform(2)).cos();
    (2.0 * normal - 5.0).exp()
}

/// Returns the index at which a sorted list of `len` values has its `p`-th percentile.
fn percentile_index(p: usize, len: usize) -> usize {
    (p * len).div_ceil(100).max(1) - 1
}

fn benches(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("percentiles");
    group.sample_size(20);
    for len in [10_000, 200_000, 2_000_000] {
        let values: Vec<f64> = (0..len).map(value).collect();
        let all = || values.iter().copied();
        group.throughput(Throughput::Elements(len as u64));
        group.bench_function(BenchmarkId::new("count", len), |bencher| {
            bencher.iter(|| black_box(FloatSketch::from_values(all())));
        });
        group.bench_function(BenchmarkId::new("sketch", len), |bencher| {
            bencher.iter(|| {
                let sketch = FloatSketch::from_values(all());
                (sketch.percentile(1.0, all()), sketch.percentile(99.0, all()))
            });
        });
        group.bench_function(BenchmarkId::new("sort", len), |bencher| {
            bencher.iter(|| {
                let mut sorted = values.clone();
                sorted.sort_unstable_by(f64::total_cmp);
                (sorted[percentile_index(1, len)], sorted[percentile_index(99, len)])
            });
        });
        group.bench_function(BenchmarkId::new("select", len), |bencher| {
            bencher.iter(|| {
                let mut part = values.clone();
                let p99 = *part.select_nth_unstable_by(percentile_index(99, len), f64::total_cmp).1;
                (*part.select_nth_unstable_by(percentile_index(1, len), f64::total_cmp).1, p99)
            });
        });
    }
}

criterion_group!(all, benches);
criterion_main!(all);
