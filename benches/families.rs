//! Measures the time of computing a frame state per Gaussian and frame, on one thread, for model formats other than
//! 4DGaussians.
//!
//! The benchmarks `network/*` measure only the network of Deformable-3D-Gaussians, for 1024 Gaussians:
//! - `d3g`: the network with a time network; the encoded positions are computed once. It makes 0.5 million
//!   multiplications per Gaussian.
//! - `d3g_slopes`: the derivatives of the predicted motion of the positions with respect to the stored positions.
//! - `bare_product`: for comparison, products of matrices of the same sizes by `matrixmultiply`, without biases, ReLUs
//!   and sines.
//!
//! The benchmarks `state/*` measure complete frame states, if the trained models are available:
//! - `d3g`: Deformable-3D-Gaussians; `d3g_6dof`: with motions as screws. Both include the decomposition of a
//!   covariance.
//! - `sc_gs`: SC-GS with 64 copies of each Gaussian. All Gaussians share the network outputs for the control nodes,
//!   which are computed for every time.
//! - `spacetime` and `free_time`: SpacetimeGaussians and FreeTimeGS, in which positions are polynomials of time and a
//!   temporal window multiplies the opacity.
//! - `native_4d`: native 4D Gaussians, which are slices of 4D covariances; `native_4d_colors`: with colors.
//! - `native_4d_open`: the time of opening a block of native 4D Gaussians, which is needed once for all frames.
//!
//! `scripts/torch_speed.py` measures the same in PyTorch. Times are processor times, so other load on the machine does
//! not count. The time per Gaussian and frame is the inverse of the throughput that is printed.

#[path = "../tests/models/mod.rs"]
mod models;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use cpu_time::ProcessTime;
use criterion::measurement::{Measurement, ValueFormatter, WallTime};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use splatsieve::deform::{Network, PredictedMotion, Tensor, Tensors};
use splatsieve::model::{AttributeValues, Attributes, Gaussians};

use splatsieve::models::OpenOptions;
use splatsieve::source::Ids;

const BLOCK: usize = 1024;
const WIDTH: usize = 256;
/// Number of copies of each Gaussian in the measured model of the format SC-GS.
const REPEATED: usize = 64;
/// Number of inputs of the network: the encoded position has 63 values, the encoded time 30.
const INPUTS: usize = 63 + 30;

/// Measurement of the processor time of this process.
struct Processor;

impl Measurement for Processor {
    type Intermediate = ProcessTime;
    type Value = Duration;

    fn start(&self) -> ProcessTime {
        ProcessTime::now()
    }

    fn end(&self, start: ProcessTime) -> Duration {
        start.elapsed()
    }

    fn add(&self, a: &Duration, b: &Duration) -> Duration {
        *a + *b
    }

    fn zero(&self) -> Duration {
        Duration::ZERO
    }

    fn to_f64(&self, value: &Duration) -> f64 {
        value.as_nanos() as f64
    }

    fn formatter(&self) -> &dyn ValueFormatter {
        const WALL: &WallTime = &WallTime;
        WALL.formatter()
    }
}

/// Returns the next pseudo-random number in [−1, 1) and updates `seed`. Every run gets the same numbers.
fn noise(seed: &mut u64) -> f32 {
    *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*seed >> 40) as f32 / (1 << 23) as f32 - 1.0
}

/// Returns, for every layer of the network, the pair (number of outputs, number of inputs).
fn layers() -> Vec<[usize; 2]> {
    let inputs = |k: usize| if k == 0 { INPUTS } else { WIDTH + if k == 5 { INPUTS } else { 0 } };
    (0..8).map(|k| [WIDTH, inputs(k)]).collect()
}

fn network() -> Network {
    let mut seed = 1;
    let mut tensors = Tensors::new();
    let mut add = |name: &str, [outputs, inputs]: [usize; 2]| {
        let mut made = |shape: &[usize]| {
            let size = (3.0 / inputs as f32).sqrt();
            let data = (0..shape.iter().product()).map(|_| size * noise(&mut seed)).collect();
            Tensor { shape: shape.to_vec(), data }
        };
        tensors.insert(format!("{name}.weight"), made(&[outputs, inputs]));
        tensors.insert(format!("{name}.bias"), made(&[outputs]));
    };
    add("timenet.0", [WIDTH, 13]);
    add("timenet.2", [30, WIDTH]);
    layers().into_iter().enumerate().for_each(|(k, shape)| add(&format!("linear.{k}"), shape));
    for (name, outputs) in [("gaussian_warp", 3), ("gaussian_rotation", 4), ("gaussian_scaling", 3)] {
        add(name, [outputs, WIDTH]);
    }
    Network::new(&tensors, "", Path::new("synthetic")).expect("a well-formed network")
}

/// Computes the matrix product y = W·x for `BLOCK` columns of `x`. W is `weight`, `[outputs, inputs]`.
fn product([outputs, inputs]: [usize; 2], weight: &[f32], x: &[f32], y: &mut [f32]) {
    assert!(weight.len() >= outputs * inputs && x.len() >= inputs * BLOCK && y.len() >= outputs * BLOCK);
    let (rows, columns) = (inputs as isize, BLOCK as isize);
    // SAFETY: the assertion above checks that the three row-major matrices lie within their slices.
    unsafe {
        matrixmultiply::sgemm(
            outputs,
            inputs,
            BLOCK,
            1.0,
            weight.as_ptr(),
            rows,
            1,
            x.as_ptr(),
            columns,
            1,
            0.0,
            y.as_mut_ptr(),
            columns,
            1,
        );
    }
}

fn networks(criterion: &mut Criterion<Processor>) {
    let mut group = criterion.benchmark_group("network");
    group.throughput(Throughput::Elements(BLOCK as u64));
    let (network, mut seed) = (network(), 2);
    let mut position = AttributeValues::zeros(3, BLOCK);
    position.planes_mut().iter_mut().for_each(|x| *x = noise(&mut seed));
    let (encoded, mut motion, mut frame) = (network.encode(&position), PredictedMotion::default(), 0);
    group.bench_function("d3g", |bencher| {
        bencher.iter(|| {
            frame = (frame + 1) % 60;
            network.motion(&encoded, f64::from(frame) / 60.0, Attributes::all(), &mut motion)
        });
    });
    let mut filled = |len: usize| (0..len).map(|_| noise(&mut seed)).collect::<Vec<f32>>();
    let all: Vec<_> = layers().into_iter().chain([[10, WIDTH]]).collect();
    let weights: Vec<Vec<f32>> = all.iter().map(|[outputs, inputs]| filled(outputs * inputs)).collect();
    let (x, mut y) = (filled((WIDTH + INPUTS) * BLOCK), vec![0.0; WIDTH * BLOCK]);
    group.bench_function("bare_product", |bencher| {
        bencher.iter(|| all.iter().zip(&weights).for_each(|(shape, weight)| product(*shape, weight, &x, &mut y)));
    });
    group.bench_function("d3g_slopes", |bencher| bencher.iter(|| network.warp_jacobian(&position, 0.4)));
    group.finish();
}

/// Copies the SC-GS model at `path` to the folder `to`, with each of its Gaussians [`REPEATED`] times. Returns `to`.
fn repeated(path: &Path, to: &Path) -> PathBuf {
    for file in ["cfg_args", "deform/iteration_80000/deform.pth", "point_cloud/iteration_80000/point_cloud.ply"] {
        let mut bytes = fs::read(path.join(file)).expect("a trained model");
        if file.ends_with("ply") {
            let end = b"end_header\n";
            let start = bytes.windows(end.len()).position(|part| part == end).expect("a header") + end.len();
            let header = String::from_utf8_lossy(&bytes[..start]);
            let header = header.replace("vertex 1500", &format!("vertex {}", REPEATED * 1500));
            bytes = [header.as_bytes(), &bytes[start..].repeat(REPEATED)].concat();
        }
        fs::create_dir_all(to.join(file).parent().expect("a folder")).expect("a folder");
        fs::write(to.join(file), bytes).expect("a copy");
    }
    to.to_owned()
}

fn states(criterion: &mut Criterion<Processor>) {
    let Some(folder) = models::found() else { return };
    let mut group = criterion.benchmark_group("state");
    // More times than there are cached node outputs.
    let times: Vec<f64> = (0..1500).map(|frame| f64::from(frame) / 1499.0).collect();
    let scratch = tempfile::tempdir().expect("a folder for temporary files");
    let all_but_sh = Attributes::all().difference(Attributes::SH);
    for (name, model, want) in [
        ("d3g", "deformable3d", all_but_sh),
        ("d3g_6dof", "deformable3d_6dof", all_but_sh),
        ("sc_gs", "scgs", all_but_sh),
        ("spacetime", "stg_lite", Attributes::all()),
        ("free_time", "ftgs", all_but_sh),
        ("native_4d", "yang4d", all_but_sh),
        ("native_4d_colors", "yang4d", Attributes::all()),
    ] {
        let model = folder.join("families").join(model);
        let (path, count) = match name {
            "sc_gs" => (repeated(&model, scratch.path()), REPEATED * 1500),
            _ => (model, BLOCK),
        };
        group.throughput(Throughput::Elements(count as u64));
        let opened =
            splatsieve::models::open(&path, &OpenOptions::default()).and_then(splatsieve::models::Opened::into_linked);
        let family = opened.and_then(|family| family.with_times(times.clone())).expect("a trained model");
        let mut reader = family.source().open(Ids::Range(0..count)).expect("Gaussians");
        let (mut frame, mut out) = (0, Gaussians::zeros(0, family.source().info().sh_degree));
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                frame = (frame + 1) % times.len();
                reader.read(frame, want, &mut out)
            });
        });
        if name == "native_4d" {
            group.bench_function("native_4d_open", |bencher| {
                bencher.iter(|| family.source().open(Ids::Range(0..BLOCK)).map(drop));
            });
        }
    }
    group.finish();
}

criterion_group! {
    name = benches;
    config = Criterion::default().with_measurement(Processor);
    targets = networks, states
}
criterion_main!(benches);
