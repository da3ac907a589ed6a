//! What does merging cost, on one thread?
//!
//! `neighbours`: the nearest neighbours within ε, per Gaussian: the tree, built and asked, over evenly strewn Gaussians
//! with 3.5 candidates each and over a crowd at one point. Rivals: looking at all pairs, on few Gaussians, where it still
//! has a chance; and a hash of voxels of side ε, asked cell by cell.
//! `pairs`: the motion of a pair, per pair and frame, positions in memory.
//! `measure`: the same from a packed container, per pair and frame: at once, and in eight partitions, whose cost over
//! the first is what gathering and reading again costs.
//! `merge`: a whole pass without motion, per survivor: neighbours, gates, clusters, proxies.
//!
//! `cargo bench --bench merge`

use std::collections::{BTreeMap, HashMap};
use std::convert::Infallible;
use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gseq::Compression;
use splatsieve::demo;
use splatsieve::emit::container::write_container;
use splatsieve::ingest::container::Container;
use splatsieve::merge::motion::{MotionGate, PairMotion};
use splatsieve::merge::neighbors::{PointIndex, Search};
use splatsieve::merge::proxy::Importance;
use splatsieve::merge::{self, Asked, Survivors};
use splatsieve::model::{Column, Columns, Gaussians};
use splatsieve::pass::FrameSource;
use splatsieve::recipe::{Motion, Recipe};
use splatsieve::select::hash_id;
use splatsieve::stream::gather;
use splatsieve::stream::motion::PairMeter;

const NEIGHBOURS: usize = 8;

fn random(k: usize) -> f32 {
    (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32
}

/// `n` similar Gaussians, strewn evenly over the unit cube, and a reach that finds a few neighbours each.
fn strewn(n: usize) -> (Gaussians, f64) {
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

fn by_tree(position: &Column, epsilon: f64) -> usize {
    let index = PointIndex::new(position.len(), |i| Some(position.row(i)));
    let mut search = Search::default();
    (0..position.len())
        .map(|i| index.nearest(i as u32, position.row(i), NEIGHBOURS, epsilon, &mut search).0.len())
        .sum()
}

fn squared(a: [f32; 3], b: [f32; 3]) -> f64 {
    (0..3).map(|c| (f64::from(a[c]) - f64::from(b[c])).powi(2)).sum()
}

/// The nearest of `near` (squared distance, index), as many as are asked for.
fn nearest(near: &mut Vec<(f64, u32)>) -> usize {
    near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    near.truncate(NEIGHBOURS);
    near.len()
}

fn by_all_pairs(position: &Column, epsilon: f64) -> usize {
    let mut near = Vec::new();
    let of_one = |i: usize| {
        let at = position.row(i);
        let others = (0..position.len()).filter(|&j| j != i).map(|j| (squared(at, position.row(j)), j as u32));
        near.clear();
        near.extend(others.filter(|&(d2, _)| d2 <= epsilon * epsilon));
        nearest(&mut near)
    };
    (0..position.len()).map(of_one).sum()
}

fn by_voxels(position: &Column, epsilon: f64) -> usize {
    let voxel = |i: usize| position.row::<3>(i).map(|x| (f64::from(x) / epsilon).floor() as i32);
    let mut voxels: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
    (0..position.len()).for_each(|i| voxels.entry(voxel(i)).or_default().push(i as u32));
    let mut near = Vec::new();
    let of_one = |i: usize| {
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
    (0..position.len()).map(of_one).sum()
}

fn neighbours(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("neighbours");
    group.sample_size(10);
    for n in [2_000, 100_000] {
        let (states, epsilon) = strewn(n);
        let position = &states.position;
        assert_eq!(by_tree(position, epsilon), by_voxels(position, epsilon));
        group.throughput(Throughput::Elements(n as u64));
        group.bench_function(BenchmarkId::new("tree", n), |b| b.iter(|| black_box(by_tree(position, epsilon))));
        group.bench_function(BenchmarkId::new("voxel_hash", n), |b| b.iter(|| black_box(by_voxels(position, epsilon))));
        if n <= 2_000 {
            assert_eq!(by_tree(position, epsilon), by_all_pairs(position, epsilon));
            group.bench_function(BenchmarkId::new("all_pairs", n), |b| {
                b.iter(|| black_box(by_all_pairs(position, epsilon)));
            });
        }
    }
    let crowd = Column::zeros(3, 2_000);
    group.throughput(Throughput::Elements(2_000));
    group.bench_function("crowd/tree", |b| b.iter(|| black_box(by_tree(&crowd, 0.1))));
    group.bench_function("crowd/voxel_hash", |b| b.iter(|| black_box(by_voxels(&crowd, 0.1))));
}

/// Each with its nearest neighbours of higher index.
fn pairs_of(position: &Column) -> Vec<(u32, u32)> {
    let index = PointIndex::new(position.len(), |i| Some(position.row(i)));
    let mut search = Search::default();
    let mut pairs = Vec::new();
    for i in 0..position.len() as u32 {
        let (near, _) = index.nearest(i, position.row(i as usize), NEIGHBOURS, f64::INFINITY, &mut search);
        pairs.extend(near.filter(|&j| i < j).map(|j| (i, j)));
    }
    pairs
}

fn motion(criterion: &mut Criterion) {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let recipe = Recipe::preset("default").unwrap();
    let frames = 8;
    let (states, _) = strewn(20_000);
    let position = &states.position;
    let pairs = pairs_of(position);
    let mut group = criterion.benchmark_group("pairs");
    group.sample_size(10).throughput(Throughput::Elements((frames * pairs.len()) as u64));
    group.bench_function("motion", |bencher| {
        bencher.iter(|| {
            one_thread.install(|| {
                let reference = (0..position.len()).map(|i| position.row(i));
                let mut motion = PairMotion::new(pairs.iter().copied(), reference, Motion::Runs);
                for frame in 0..frames {
                    motion.frame(|i| (position.row::<3>(i).map(|x| x + 0.01 * frame as f32), true));
                }
                motion.finish().map(|pair| pair.drift).fold(0.0, f64::max)
            })
        });
    });
    group.finish();

    let scene = demo::Scene::new(20_000, 48);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.gseq");
    write_container(&scene, &path, Compression::Zstd(1), BTreeMap::new(), |_| ()).unwrap();
    let container = Container::open(&path).unwrap();
    let ids: Vec<u32> = (0..scene.info().count as u32).collect();
    let reference = gather(&container, &ids, 0, Columns::POSITION).unwrap().position;
    let pairs = pairs_of(&reference);
    let mut group = criterion.benchmark_group("measure");
    group.sample_size(10).throughput(Throughput::Elements((48 * pairs.len()) as u64));
    for partitions in [1, 8] {
        let measure = || {
            let mut meter = PairMeter {
                source: &container,
                scan: &recipe.scan,
                gate: MotionGate::new(&recipe.merge, 4.0),
                frames_held: usize::MAX,
                scratch: folder.path().to_owned(),
                gathered: None,
            };
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
    let (states, epsilon) = strewn(n);
    let mut recipe = Recipe::preset("default").unwrap().merge;
    recipe.passes.truncate(1);
    (recipe.passes[0].epsilon, recipe.passes[0].d0) = (epsilon, 2.0);
    let rows: Vec<u32> = (0..n as u32).collect();
    let seen: Vec<f64> = (0..n).map(|i| f64::from(random(i))).collect();
    let survivors = Survivors {
        states: &states,
        rows: &rows,
        importance: Importance { ids: &rows, coverage: &seen, visibility: &seen },
        mergeable: &vec![true; n],
        extent: 1.0,
    };
    let alike = |asked: Asked<'_>| Ok::<_, Infallible>(vec![1.0; asked.pairs().len()]);
    let mut group = criterion.benchmark_group("merge");
    group.sample_size(10).throughput(Throughput::Elements(n as u64));
    group.bench_function("pass", |bencher| {
        bencher.iter(|| one_thread.install(|| merge::run(&survivors, &recipe, None, usize::MAX, alike)));
    });
}

criterion_group!(all, neighbours, motion, whole);
criterion_main!(all);
