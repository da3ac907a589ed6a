//! Measures the cost of merging on one thread.
//!
//! The benchmarks `neighbors` measure the time per Gaussian of finding the nearest neighbors within the radius ε. The
//! inputs are trained models with ε of the presets, evenly distributed Gaussians with few or many neighbors (`strewn`),
//! clusters, and crowds (all within ε, or all at one point). Three methods are compared:
//! - `tree`: the index that the program uses, built and searched.
//! - `all_pairs`: comparison of all pairs; only for few Gaussians.
//! - `plain_hash`: a hash table of voxels with lists of their points; the voxels are looked up for each point.
//!
//! The other benchmarks measure the motion test and a complete pass:
//! - `pairs`: time per pair and frame of measuring the motion of a pair, with positions in memory.
//! - `measure`: the same with positions read from a compressed container. All pairs are measured at once, or in eight
//!   partitions. Partitions take longer, because all trajectories are written to a scratch file and read again.
//! - `merge`: time per survivor of one merging pass without motion: neighbors, tests, clusters, proxies.
//!
//! Usage: `cargo bench --bench merge`

#[path = "../tests/models/mod.rs"]
mod models;

use std::collections::{BTreeMap, HashMap};
use std::convert::Infallible;
use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gseq::Compression;
use splatsieve::diagnostics::demo_scene;
use splatsieve::files::container::Container;
use splatsieve::merging;
use splatsieve::merging::motion::{MotionThresholds, PairMotionAccumulator};
use splatsieve::merging::motion_pass::PairMeter;
use splatsieve::merging::neighbors::PointIndex;
use splatsieve::merging::proxy::Importance;
use splatsieve::merging::tree::TreePoint;
use splatsieve::merging::{RequestedPairs, Survivors};
use splatsieve::model::hash_id;
use splatsieve::model::{AttributeValues, Attributes, Gaussians};
use splatsieve::outputs::container::write_container;
use splatsieve::passes::gather;
use splatsieve::progress::Events;
use splatsieve::recipe::{MotionParams, Recipe};
use splatsieve::source::FrameSource;

/// Maximum number of neighbors per Gaussian that a search returns, as in the presets of the recipe.
const NEIGHBORS: usize = 32;

fn random(k: usize) -> f32 {
    (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32
}

/// Returns `n` similar Gaussians distributed evenly over the unit cube, and a radius within which each has a few
/// neighbors.
fn evenly_distributed(n: usize) -> (Gaussians, f64) {
    let mut states = Gaussians::zeros(n, 0);
    let spacing = (n as f64).powf(-1.0 / 3.0);
    for i in 0..n {
        let value = |salt: usize| random(16 * i + salt);
        states.position.set_row(i, [value(0), value(1), value(2)]);
        states.rotation.set_row(i, [value(3) - 0.5, value(4) - 0.5, value(5) - 0.5, 0.6]);
        states.log_scale.set_row(i, [6, 7, 8].map(|salt| (0.7 * spacing).ln() as f32 + 0.8 * (value(salt) - 0.5)));
        states.sh.set_row(i, [9, 10, 11].map(|salt| 0.5 + 0.1 * value(salt)));
    }
    (states, 1.2 * spacing)
}

/// Function that searches the neighbors of every position, by one of the compared methods. The arguments are the
/// positions and the radius ε; the result is the total number of neighbors found.
type Find = fn(&AttributeValues, f64) -> usize;

fn points(position: &AttributeValues) -> Vec<TreePoint> {
    (0..position.len()).map(|i| TreePoint { position: position.row(i), index: i as u32 }).collect()
}

fn by_tree(position: &AttributeValues, epsilon: f64) -> usize {
    let index = PointIndex::new(points(position), epsilon);
    let mut search = index.search();
    index.points().iter().map(|point| search.nearest(point.index, point.position, NEIGHBORS).0.len()).sum()
}

fn squared(a: [f32; 3], b: [f32; 3]) -> f64 {
    (0..3).map(|c| (f64::from(a[c]) - f64::from(b[c])).powi(2)).sum()
}

/// Removes all entries of `near` except the nearest [`NEIGHBORS`]. An entry is a pair (squared distance, index of a
/// point). Returns the number of remaining entries.
fn nearest(near: &mut Vec<(f64, u32)>) -> usize {
    near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    near.truncate(NEIGHBORS);
    near.len()
}

fn by_all_pairs(position: &AttributeValues, epsilon: f64) -> usize {
    let mut near = Vec::new();
    let count_neighbors = |i: usize| {
        let at = position.row(i);
        let others = (0..position.len()).filter(|&j| j != i).map(|j| (squared(at, position.row(j)), j as u32));
        near.clear();
        near.extend(others.filter(|&(d2, _)| d2 <= epsilon * epsilon));
        nearest(&mut near)
    };
    (0..position.len()).map(count_neighbors).sum()
}

fn by_plain_hash(position: &AttributeValues, epsilon: f64) -> usize {
    let voxel = |i: usize| position.row::<3>(i).map(|x| (f64::from(x) / epsilon).floor() as i32);
    let mut voxels: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
    (0..position.len()).for_each(|i| voxels.entry(voxel(i)).or_default().push(i as u32));
    let mut near = Vec::new();
    let count_neighbors = |i: usize| {
        let ([x, y, z], at) = (voxel(i), position.row(i));
        near.clear();
        for cell in 0..27 {
            let cell = [x + cell % 3 - 1, y + cell / 3 % 3 - 1, z + cell / 9 - 1];
            for &j in voxels.get(&cell).into_iter().flatten().filter(|&&j| j as usize != i) {
                let d2 = squared(at, position.row(j as usize));
                if d2 <= epsilon * epsilon {
                    near.push((d2, j));
                }
            }
        }
        nearest(&mut near)
    };
    (0..position.len()).map(count_neighbors).sum()
}

/// Returns `n` points in clusters of 200, each about 0.005 wide.
fn clustered(n: usize) -> AttributeValues {
    let mut position = AttributeValues::zeros(3, n);
    for i in 0..n {
        let cluster = hash_id(i as u64) as usize % (n / 200);
        let spread = |c: usize| (0..3).map(|k| random(16 * i + 3 * k + c) - 0.5).sum::<f32>();
        position.set_row::<3>(i, std::array::from_fn(|c| random((1 << 30) + 4 * cluster + c) + 0.003 * spread(c)));
    }
    position
}

/// Returns the extent of the points `position`: the largest side of the box between the 1st and the 99th percentile of
/// each coordinate.
fn extent(position: &AttributeValues) -> f64 {
    let side = |c: usize| {
        let mut plane = position.plane(c).to_vec();
        plane.sort_unstable_by(f32::total_cmp);
        f64::from(plane[plane.len() * 99 / 100]) - f64::from(plane[plane.len() / 100])
    };
    (0..3).map(side).fold(0.0, f64::max)
}

fn neighbors(criterion: &mut Criterion) {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let mut cases: Vec<(String, AttributeValues, f64)> = Vec::new();
    if let Some(folder) = models::found() {
        for name in models::NAMES {
            let model = models::Model::open(&folder, name);
            let position = model.state(model.frames()[0]).position;
            let unit = extent(&position);
            // The radii of `default` and `strong`, in extents, and of `paper`, in scene units.
            for (preset, epsilon) in [("0.005", 0.005 * unit), ("0.01", 0.01 * unit), ("paper", 0.02)] {
                cases.push((format!("{name} {preset}"), position.clone(), epsilon));
            }
        }
    }
    for n in [2_000, 100_000, 1_000_000] {
        let (states, epsilon) = evenly_distributed(n);
        cases.push((format!("strewn {n}"), states.position.clone(), epsilon));
        cases.push((format!("strewn densely {n}"), states.position, 2.5 * epsilon));
        cases.push((format!("clustered {n}"), clustered(n), 0.001));
        cases.push((format!("clustered densely {n}"), clustered(n), 0.01));
    }
    cases.push(("all near".into(), evenly_distributed(100_000).0.position, 2.0));
    cases.push(("one point".into(), AttributeValues::zeros(3, 100_000), 0.1));
    for (name, position, epsilon) in cases {
        let mut group = criterion.benchmark_group(format!("neighbors/{name}"));
        group.sample_size(10).throughput(Throughput::Elements(position.len() as u64));
        let mut rivals: Vec<(&str, Find)> = vec![("tree", by_tree)];
        if name.starts_with("strewn") && position.len() <= 100_000 {
            rivals.push(("plain_hash", by_plain_hash));
        }
        if position.len() <= 2_000 {
            rivals.push(("all_pairs", by_all_pairs));
        }
        let expected = by_tree(&position, epsilon);
        for (rival, find) in rivals {
            assert_eq!(find(&position, epsilon), expected, "{rival}");
            group.bench_function(rival, |bencher| {
                bencher.iter(|| one_thread.install(|| black_box(find(&position, epsilon))));
            });
        }
    }
}

/// Returns pairs of Gaussians, lower index first: each Gaussian with those of its eight nearest neighbors that have a
/// higher index.
fn neighbor_pairs(position: &AttributeValues) -> Vec<(u32, u32)> {
    let index = PointIndex::new(points(position), f64::INFINITY);
    let mut search = index.search();
    let mut pairs = Vec::new();
    for i in 0..position.len() as u32 {
        let (near, _) = search.nearest(i, position.row(i as usize), 8);
        pairs.extend(near.filter(|&j| i < j).map(|j| (i, j)));
    }
    pairs
}

fn motion(criterion: &mut Criterion) {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let recipe = Recipe::preset("default").unwrap();
    let frames = 8;
    let (states, _) = evenly_distributed(20_000);
    let position = &states.position;
    let pairs = neighbor_pairs(position);
    let mut group = criterion.benchmark_group("pairs");
    group.sample_size(10).throughput(Throughput::Elements((frames * pairs.len()) as u64));
    group.bench_function("motion", |bencher| {
        bencher.iter(|| {
            one_thread.install(|| {
                let reference = (0..position.len()).map(|i| position.row(i));
                let mut motion = PairMotionAccumulator::new(pairs.iter().copied(), reference, MotionParams::Runs);
                for frame in 0..frames {
                    motion.add_frame(|i| (position.row::<3>(i).map(|x| x + 0.01 * frame as f32), true));
                }
                motion.finish().map(|pair| pair.drift).fold(0.0, f64::max)
            })
        });
    });
    group.finish();

    let scene = demo_scene::DemoScene::new(20_000, 48);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.gseq");
    write_container(&scene, &path, Compression::Zstd(1), BTreeMap::new(), |_| ()).unwrap();
    let container = Container::open(&path).unwrap();
    let ids: Vec<u32> = (0..scene.info().count as u32).collect();
    let reference = gather(&container, &ids, 0, Attributes::POSITION).unwrap().position;
    let pairs = neighbor_pairs(&reference);
    let mut group = criterion.benchmark_group("measure");
    group.sample_size(10).throughput(Throughput::Elements((48 * pairs.len()) as u64));
    for partitions in [1, 8] {
        let measure = || {
            let thresholds = MotionThresholds::new(&recipe.merge, 4.0);
            let scratch = folder.path().to_owned();
            let mut meter = PairMeter::new(&container, &recipe.scan, thresholds, usize::MAX, scratch, Events::IGNORED);
            let parts = pairs.chunks(pairs.len().div_ceil(partitions));
            parts
                .map(|part| meter.measure(&ids, &reference, part.to_vec(), 0.05, partitions > 1).unwrap().len())
                .sum::<usize>()
        };
        group.bench_function(BenchmarkId::new("partitions", partitions), |bencher| {
            bencher.iter(|| one_thread.install(measure));
        });
    }
}

fn whole(criterion: &mut Criterion) {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let n = 100_000;
    let (states, epsilon) = evenly_distributed(n);
    let mut recipe = Recipe::preset("default").unwrap().merge;
    recipe.passes.truncate(1);
    (recipe.passes[0].epsilon, recipe.passes[0].d0) = (epsilon, 2.0);
    let rows: Vec<u32> = (0..n as u32).collect();
    let seen: Vec<f64> = (0..n).map(|i| f64::from(random(i))).collect();
    let survivors = Survivors {
        states: &states,
        rows: &rows,
        importance: Importance { ids: &rows, coverage: &seen, visibility: &seen },
        classes: &vec![Some(0); n],
        extent: 1.0,
    };
    let alike = |asked: RequestedPairs<'_>| Ok::<_, Infallible>(vec![1.0; asked.pairs().len()]);
    let mut group = criterion.benchmark_group("merge");
    group.sample_size(10).throughput(Throughput::Elements(n as u64));
    group.bench_function("pass", |bencher| {
        bencher.iter(|| one_thread.install(|| merging::merge_survivors(&survivors, &recipe, None, usize::MAX, alike)));
    });
}

criterion_group!(all, neighbors, motion, whole);
criterion_main!(all);
