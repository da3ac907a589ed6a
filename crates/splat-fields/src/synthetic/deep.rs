//! Deep MLPs of position and time with random weights, for tests.

use super::Noise;
use crate::{Tensor, Tensors};

/// Number of outputs of the hidden layers. Deliberately not a multiple of 4, the number of outputs that a layer
/// computes together.
const WIDTH: usize = 22;

/// Number of values in the encoding of a position: its 3 components, and their sines and cosines in 10 octaves.
const POSITION_INPUTS: usize = 3 + 2 * 3 * 10;

/// Variant of the architecture of the deep MLP that [`random_tensors`] makes.
#[derive(Clone, Copy, Debug)]
pub struct DeepVariant {
    /// Whether a separate network encodes the time.
    pub time_network: bool,
    /// Whether positions move by screw motions (rotation and translation) instead of offsets.
    pub screws: bool,
    /// Whether the network also has output layers (heads) for opacity and color.
    pub all_heads: bool,
}

/// Variants of the deformation network that tests evaluate. Each option is on in at least one variant and off in
/// another.
pub const ALL_VARIANTS: [DeepVariant; 3] = [
    DeepVariant { time_network: true, screws: false, all_heads: false },
    DeepVariant { time_network: false, screws: true, all_heads: false },
    DeepVariant { time_network: true, screws: false, all_heads: true },
];

/// Returns random tensors `network.*` for a network of the variant `kind` with five layers, of which the fourth has a
/// skip connection. The weights are such that its outputs are of the order of 1.
pub fn random_tensors(kind: DeepVariant) -> Tensors {
    let mut noise = Noise(5);
    let mut tensors = Tensors::new();
    let mut add = |name: &str, outputs: usize, inputs: usize, size: f32| {
        let size = size / (inputs as f32).sqrt();
        let mut random_tensor = |shape: &[usize]| Tensor {
            shape: shape.to_vec(),
            data: (0..shape.iter().product()).map(|_| 2.0 * size * noise.next()).collect(),
        };
        tensors.insert(format!("network.{name}.weight"), random_tensor(&[outputs, inputs]));
        tensors.insert(format!("network.{name}.bias"), random_tensor(&[outputs]));
    };
    let time_inputs = if kind.time_network { 5 } else { 21 };
    if kind.time_network {
        add("timenet.0", 17, 13, 1.0);
        add("timenet.2", time_inputs, 17, 1.0);
    }
    let encodings = POSITION_INPUTS + time_inputs;
    for (k, inputs) in [encodings, WIDTH, WIDTH, encodings + WIDTH, WIDTH].into_iter().enumerate() {
        add(&format!("linear.{k}"), WIDTH, inputs, 1.3);
    }
    let position: &[&str] = if kind.screws { &["branch_w", "branch_v"] } else { &["gaussian_warp"] };
    position.iter().for_each(|name| add(name, 3, WIDTH, 1.0));
    add("gaussian_rotation", 4, WIDTH, 1.0);
    add("gaussian_scaling", 3, WIDTH, 1.0);
    if kind.all_heads {
        add("gaussian_opacity", 1, WIDTH, 1.0);
        add("gaussian_color", 3, WIDTH, 1.0);
    }
    tensors
}
