//! Measures the time of the deformation field per Gaussian and frame, on one thread.
//!
//! Two synthetic fields have the shapes of real models:
//! - D-NeRF: width 64, two levels of 32 channels, and heads for position, scale and rotation. The original PyTorch code
//!   needs 2.3 to 3.1 µs per Gaussian and frame.
//! - DyNeRF: width 128, two levels of 16 channels, and all five heads. The original PyTorch code needs 4.6 µs.
//!
//! The PyTorch times are for one core of the machine on which these benchmarks were first run. Two further cases are
//! measured: positions alone (DyNeRF: and opacities), because the scan of a model reads nothing else, and the
//! derivatives of the positions at a frame with respect to the stored positions, which refinement needs in every step.
//! The time per Gaussian and frame is the inverse of the throughput that is printed.
//!
//! Lower limit of the time: all attributes take 17,152 multiply-adds (D-NeRF) or 94,208 (DyNeRF) in the layers. A core
//! that makes two vector multiply-adds per cycle needs at least 536 or 2,944 cycles with AVX-512, twice as many with
//! AVX2.

use std::path::Path;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use splatsieve::deform::{Deltas, Field, FieldConfig, LayerBuffers, Tensor, Tensors};
use splatsieve::model::{AttributeValues, Attributes, Gaussians};

const BLOCK: usize = 1024;

/// Returns the next pseudo-random number in [−1, 1) and updates `seed`. Every run gets the same numbers.
fn noise(seed: &mut u64) -> f32 {
    *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*seed >> 40) as f32 / (1 << 23) as f32 - 1.0
}

fn field(width: usize, channels: usize, active: Attributes) -> Field {
    let mut seed = 1;
    let mut tensors = Tensors::new();
    let mut add = |name: String, shape: &[usize]| {
        let data = (0..shape.iter().product()).map(|_| 0.1 * noise(&mut seed)).collect();
        tensors.insert(format!("deformation_net.{name}"), Tensor { shape: shape.to_vec(), data });
    };
    for level in 0..2 {
        let space = 64 << level;
        for plane in 0..6 {
            let size_b = if matches!(plane, 2 | 4 | 5) { 50 } else { space };
            add(format!("grid.grids.{level}.{plane}"), &[1, channels, size_b, space]);
        }
    }
    add("feature_out.0.weight".into(), &[width, 2 * channels]);
    add("feature_out.0.bias".into(), &[width]);
    for (head, outputs) in
        [("pos_deform", 3), ("scales_deform", 3), ("rotations_deform", 4), ("opacity_deform", 1), ("shs_deform", 48)]
    {
        add(format!("{head}.1.weight"), &[width, width]);
        add(format!("{head}.1.bias"), &[width]);
        add(format!("{head}.3.weight"), &[outputs, width]);
        add(format!("{head}.3.bias"), &[outputs]);
    }
    let aabb = Tensor { shape: vec![2, 3], data: vec![1.0, 1.0, 1.0, -1.0, -1.0, -1.0] };
    tensors.insert("deformation_net.grid.aabb".into(), aabb);
    let config = FieldConfig {
        deformed_attributes: active,
        static_mlp: false,
        empty_voxel: false,
        grid_pe: 0,
        no_grid: false,
        apply_rotation: false,
    };
    Field::new(&tensors, config, 3, Path::new("synthetic")).expect("a well-formed field")
}

fn deform(criterion: &mut Criterion) {
    let mut seed = 2;
    let mut position = AttributeValues::zeros(3, BLOCK);
    position.planes_mut().iter_mut().for_each(|x| *x = noise(&mut seed));
    let three = Attributes::POSITION | Attributes::LOG_SCALE | Attributes::ROTATION;
    let mut group = criterion.benchmark_group("deform");
    group.throughput(Throughput::Elements(BLOCK as u64));
    for (name, field, want) in [
        ("dnerf_all", field(64, 32, three), Attributes::all()),
        ("dnerf_position", field(64, 32, three), Attributes::POSITION),
        ("dynerf_all", field(128, 16, Attributes::all()), Attributes::all()),
        ("dynerf_position_opacity", field(128, 16, Attributes::all()), Attributes::POSITION | Attributes::OPACITY),
    ] {
        let prepared = field.prepare(&position);
        let mut scratch = LayerBuffers::default();
        let mut out = Deltas::new(3);
        let mut frame = 0;
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                frame = (frame + 1) % 60;
                field.deltas(&prepared, frame as f64 / 60.0, want, &mut scratch, &mut out)
            });
        });
    }
    // Derivatives of the positions at a frame with respect to the stored positions. They take one forward pass through
    // the position head, and one backward pass for each of the three coordinates.
    let mut raw = Gaussians::zeros(BLOCK, 3);
    raw.position = position;
    for (name, field) in
        [("dnerf_jacobian", field(64, 32, three)), ("dynerf_jacobian", field(128, 16, Attributes::all()))]
    {
        let prepared = field.prepare_with_slopes(&raw.position);
        group.bench_function(name, |bencher| {
            bencher.iter(|| field.jacobian(&raw, &prepared, 0.4, Attributes::POSITION))
        });
    }
    group.finish();
}

criterion_group!(benches, deform);
criterion_main!(benches);
