//! Deformation fields with random weights for tests. The weights are the same on every run.

pub mod deep;

use crate::{FieldConfig, Tensor, Tensors};
use splat_core::Attributes;

/// Generator of pseudo-random values in [−1, 1): the upper bits of a linear congruential generator. The number in this
/// type is the state of the generator.
pub struct Noise(pub u64);

impl Noise {
    /// Returns the next pseudo-random value in [−1, 1).
    #[allow(clippy::should_implement_trait)]
    pub fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

/// Number of outputs of the hidden layers. Deliberately not a multiple of 4, the number of outputs that a layer
/// computes together.
const WIDTH: usize = 22;
/// Number of channels of each feature plane.
const CHANNELS: usize = 5;

/// Returns options of a field in which every attribute is deformed and every other option is off.
pub fn plain_config() -> FieldConfig {
    FieldConfig {
        deformed_attributes: Attributes::all(),
        static_mlp: false,
        empty_voxel: false,
        grid_pe: 0,
        no_grid: false,
        apply_rotation: false,
    }
}

/// Returns a state dict with random weights for a field with the options `config`, `depth` layers in its trunk (the MLP
/// shared by all attributes), and SH degree 3. Feature planes have a different resolution along each axis, so that a
/// test fails if axes are swapped.
pub fn random_tensors(config: &FieldConfig, depth: usize) -> Tensors {
    let mut noise = Noise(7);
    let mut tensors = Tensors::new();
    let mut add = |name: &str, shape: &[usize], scale: f32| {
        let data = (0..shape.iter().product()).map(|_| scale * noise.next()).collect();
        tensors.insert(format!("deformation_net.{name}"), Tensor { shape: shape.to_vec(), data });
    };
    for level in 0..2 {
        let size = [6 << level, 4 << level, 5 << level, 7];
        for (plane, (a, b)) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)].into_iter().enumerate() {
            add(&format!("grid.grids.{level}.{plane}"), &[1, CHANNELS, size[b], size[a]], 1.5);
        }
    }
    let features = match (config.no_grid, config.grid_pe > 1) {
        (true, _) => 4,
        (_, true) => 6 * CHANNELS,
        _ => 2 * CHANNELS,
    };
    for layer in 0..depth {
        let inputs = if layer == 0 { features } else { WIDTH };
        add(&format!("feature_out.{}.weight", 2 * layer), &[WIDTH, inputs], 0.5);
        add(&format!("feature_out.{}.bias", 2 * layer), &[WIDTH], 0.5);
    }
    let heads = [
        ("pos_deform", 3),
        ("scales_deform", 3),
        ("rotations_deform", 4),
        ("opacity_deform", 1),
        ("shs_deform", 48),
        ("static_mlp", 1),
    ];
    for (head, outputs) in heads {
        add(&format!("{head}.1.weight"), &[WIDTH, WIDTH], 0.4);
        add(&format!("{head}.1.bias"), &[WIDTH], 0.4);
        add(&format!("{head}.3.weight"), &[outputs, WIDTH], 0.4);
        add(&format!("{head}.3.bias"), &[outputs], 0.4);
    }
    add("empty_voxel.grid", &[1, 1, 3, 4, 5], 1.0);
    for (name, shape, data) in [
        ("grid.aabb", vec![2, 3], vec![1.5, 1.25, 1.0, -1.0, -1.25, -0.5]),
        ("empty_voxel.xyz_min", vec![3], vec![-0.75, -1.0, -0.5]),
        ("empty_voxel.xyz_max", vec![3], vec![1.0, 0.75, 1.0]),
    ] {
        tensors.insert(format!("deformation_net.{name}"), Tensor { shape, data });
    }
    tensors
}
