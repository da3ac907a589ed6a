//! How long does a state of other families take per Gaussian and frame, on one thread?
//!
//! `network`: what the network of Deformable-3D-Gaussians says, with a time network, of 1024 Gaussians prepared once; it makes
//! 0.5 million multiplications. The rival is a bare product of the same matrices by `matrixmultiply`, without biases, ReLUs and
//! sines. With trained models at hand, whole states of Deformable-3D-Gaussians (a covariance is decomposed beside), with
//! screws, and of SC-GS, whose nodes' outputs are shared by all Gaussians of a time.
//! Invert the throughput to get the time per Gaussian and frame.

#[path = "../tests/models/mod.rs"]
mod models;

use std::path::Path;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use splatsieve::deform::{Motion, Network, Tensor, Tensors};
use splatsieve::families::{self, OpenOptions};
use splatsieve::model::{Column, Columns, Gaussians};
use splatsieve::source::Ids;

const BLOCK: usize = 1024;
const WIDTH: usize = 256;
/// Values of a position and of a time.
const INPUTS: usize = 63 + 30;

/// Values in [−1, 1), the same on every run.
fn noise(seed: &mut u64) -> f32 {
    *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*seed >> 40) as f32 / (1 << 23) as f32 - 1.0
}

/// Outputs and inputs of the layers.
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

/// y = W·x for `BLOCK` columns x.
fn product([outputs, inputs]: [usize; 2], weight: &[f32], x: &[f32], y: &mut [f32]) {
    assert!(weight.len() >= outputs * inputs && x.len() >= inputs * BLOCK && y.len() >= outputs * BLOCK);
    let (rows, columns) = (inputs as isize, BLOCK as isize);
    // SAFETY: the line above saw that the three matrices, row by row, lie within their slices.
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

fn networks(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("network");
    group.throughput(Throughput::Elements(BLOCK as u64));
    let (network, mut seed) = (network(), 2);
    let mut position = Column::zeros(3, BLOCK);
    position.planes_mut().iter_mut().for_each(|x| *x = noise(&mut seed));
    let (encoded, mut motion, mut frame) = (network.encode(&position), Motion::default(), 0);
    group.bench_function("d3g", |bencher| {
        bencher.iter(|| {
            frame = (frame + 1) % 60;
            network.motion(&encoded, f64::from(frame) / 60.0, Columns::all(), &mut motion)
        });
    });
    let mut filled = |len: usize| (0..len).map(|_| noise(&mut seed)).collect::<Vec<f32>>();
    let all: Vec<_> = layers().into_iter().chain([[10, WIDTH]]).collect();
    let weights: Vec<Vec<f32>> = all.iter().map(|[outputs, inputs]| filled(outputs * inputs)).collect();
    let (x, mut y) = (filled((WIDTH + INPUTS) * BLOCK), vec![0.0; WIDTH * BLOCK]);
    group.bench_function("bare_product", |bencher| {
        bencher.iter(|| all.iter().zip(&weights).for_each(|(shape, weight)| product(*shape, weight, &x, &mut y)));
    });
    group.bench_function("d3g_slopes", |bencher| bencher.iter(|| network.slopes(&position, 0.4)));
    group.finish();
}

fn states(criterion: &mut Criterion) {
    let Some(folder) = models::found() else { return };
    let mut group = criterion.benchmark_group("state");
    group.throughput(Throughput::Elements(BLOCK as u64));
    let times: Vec<f64> = (0..60).map(|frame| f64::from(frame) / 59.0).collect();
    for (name, model) in [("d3g", "deformable3d"), ("d3g_6dof", "deformable3d_6dof"), ("sc_gs", "scgs")] {
        let opened = families::open(&folder.join("families").join(model), &OpenOptions::default());
        let family = opened.and_then(|family| family.with_times(times.clone())).expect("a trained model");
        let mut reader = family.source().open(Ids::Range(0..BLOCK)).expect("a block");
        let (mut frame, mut out) = (0, Gaussians::zeros(0, family.source().info().sh_degree));
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                frame = (frame + 1) % times.len();
                reader.read(frame, Columns::all().difference(Columns::SH), &mut out)
            });
        });
    }
    group.finish();
}

criterion_group!(benches, networks, states);
criterion_main!(benches);
