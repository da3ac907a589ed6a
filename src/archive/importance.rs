//! Estimates how strongly quantization errors in each channel, row and column of a tensor change the output of the
//! deformation field.
//!
//! Input: a state dict (tensors by name), positions and times. Output: for every tensor the offsets added to its
//! quantization step, one per channel of a plane, or one per row and column of a matrix. The estimate is of first order
//! and assumes that the errors of different values are independent. It multiplies an error of a plane by the product of
//! the five other planes, an error of a weight by the input of that weight, and both by the weights of all later
//! layers. Only the writer of an archive uses these numbers, so rounding differences between machines are harmless.

use std::collections::BTreeMap;

use super::field::TensorRole;
use crate::deform::{Box3, Tensor, Tensors, TexelPair, texel_pair};
use crate::model::AttributeValues;

/// Maximum number of Gaussians at whose positions the deformation field is evaluated to estimate the effect of errors.
const MAX_SAMPLED_GAUSSIANS: usize = 256;
/// Number of points in time at which the deformation field is evaluated for each sampled Gaussian.
const TIMES_PER_GAUSSIAN: usize = 4;
/// Step between possible offsets of quantization steps, in eighths of an octave. Offsets are multiples of 4 eighths,
/// that is, of half an octave (a factor of √2).
const OFFSET_UNIT: f64 = 4.0;
/// Maximum absolute offset of a quantization step, in units of [`OFFSET_UNIT`].
const MAX_OFFSET: f64 = 6.0;

/// Returns, for each tensor of the deformation field, offsets of its quantization steps, by tensor name. An offset of 8
/// doubles a step. A feature plane has one offset per channel; a matrix has one per row, then one per column. Returns
/// an empty map if the field has no planes or an unknown structure.
/// - `field`: role of each tensor, by name
/// - `tensors`: values of the tensors, by name
/// - `position`: canonical positions of the Gaussians
/// - `space`: box of space that the planes cover
/// - `times`: first and last time of the sequence
pub fn step_offsets(
    field: &BTreeMap<String, TensorRole>,
    tensors: &Tensors,
    position: &AttributeValues,
    space: Option<Box3>,
    times: [f32; 2],
) -> BTreeMap<String, Vec<i8>> {
    let mut found = BTreeMap::new();
    let Some(space) = space else { return found };
    let Some(trunk) = trunk_layers(tensors) else { return found };
    // Inputs of the trunk (the layers that all heads share) at some samples, and for each plane the squares of the
    // factors that its values are multiplied by.
    let Some(samples) = Samples::new(tensors, position, space, times) else { return found };
    if trunk[0].inputs() != samples.width {
        return found;
    }
    // Forward pass: computes the mean squares of the inputs of every layer.
    let mut reads: Vec<(WeightLayer<'_>, Vec<f64>)> = Vec::new();
    let mut now = samples.features.clone();
    for layer in &trunk {
        reads.push((layer.clone(), mean_squares(&now, layer.inputs())));
        now = layer.run(&now);
        now.iter_mut().for_each(|x| *x = x.max(0.0));
    }
    let mut leaving = vec![0.0; trunk[trunk.len() - 1].outputs()];
    let active = active_fraction(&now, leaving.len());
    for name in heads(field) {
        let Some([hidden, output]) = head_layers(tensors, &name) else { continue };
        if hidden.inputs() != leaving.len() || output.inputs() != hidden.outputs() {
            continue;
        }
        let read = mean_squares(&now, hidden.inputs());
        let mut inside = hidden.run(&now);
        inside.iter_mut().for_each(|x| *x = x.max(0.0));
        let output_importance = vec![1.0; output.outputs()];
        let hidden_importance = output.backward(&output_importance, &active_fraction(&inside, hidden.outputs()));
        let input_importance = hidden.backward(&hidden_importance, &active);
        // Every head gets the same total importance here. The relation between the steps of different heads is chosen
        // elsewhere, by rendering.
        let all: f64 = input_importance.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        leaving.iter_mut().zip(&input_importance).for_each(|(sum, x)| *sum += x / all);
        insert_offsets(&mut found, &hidden, &hidden_importance, &read);
        insert_offsets(&mut found, &output, &output_importance, &mean_squares(&inside, output.inputs()));
    }
    // Backward pass through the trunk (the layers that all heads share).
    for (layer, read) in reads.iter().rev() {
        insert_offsets(&mut found, layer, &leaving, read);
        let ones = vec![1.0; layer.inputs()];
        leaving = layer.backward(&leaving, &ones);
    }
    for (name, first, squares) in &samples.plane_factors {
        let by_channel: Vec<f64> = squares.iter().zip(&leaving[*first..]).map(|(a, b)| a * b).collect();
        found.insert(name.clone(), importance_offsets(&by_channel));
    }
    found
}

/// Inserts two entries into `offsets_by_tensor`, by tensor name: the quantization step offsets ([`importance_offsets`])
/// of the weights of `layer`, and those of its bias. `rows`: importance of each output of the layer, that is, how
/// strongly an error of the output changes the result of the field. `columns`: mean square of each input of the layer.
fn insert_offsets(
    offsets_by_tensor: &mut BTreeMap<String, Vec<i8>>,
    layer: &WeightLayer<'_>,
    rows: &[f64],
    columns: &[f64],
) {
    offsets_by_tensor
        .insert(format!("{}.weight", layer.name), [importance_offsets(rows), importance_offsets(columns)].concat());
    offsets_by_tensor.insert(format!("{}.bias", layer.name), importance_offsets(rows));
}

/// Returns one offset of a quantization step per entry of `importance`, in eighths of an octave. The offsets make steps
/// proportional to 1/√importance and leave their geometric mean unchanged, apart from rounding to [`OFFSET_UNIT`].
/// Importance below 1e-4 of the largest counts as 1e-4 of the largest.
fn importance_offsets(importance: &[f64]) -> Vec<i8> {
    let most = importance.iter().copied().fold(0.0, f64::max);
    let octaves: Vec<f64> = importance.iter().map(|x| -0.5 * (x.max(1e-4 * most) / most).log2()).collect();
    if most.is_nan() || most <= 0.0 {
        return vec![0; importance.len()];
    }
    let mean = octaves.iter().sum::<f64>() / octaves.len().max(1) as f64;
    let units =
        octaves.iter().map(|octave| (8.0 * (octave - mean) / OFFSET_UNIT).round().clamp(-MAX_OFFSET, MAX_OFFSET));
    units.map(|units| (units * OFFSET_UNIT) as i8).collect()
}

/// Returns the names of the heads (output networks) that the deformation field `field` uses.
fn heads(field: &BTreeMap<String, TensorRole>) -> Vec<String> {
    let head_name = |(name, role): (&String, &TensorRole)| {
        let head = name
            .strip_suffix(".1.weight")
            .filter(|head| *role == TensorRole::Weights && !head.ends_with("feature_out"));
        head.map(str::to_owned)
    };
    field.iter().filter_map(head_name).collect()
}

/// Linear layer of a network: weights `[outputs, inputs]` and a bias.
#[derive(Clone)]
struct WeightLayer<'a> {
    name: String,
    weight: &'a Tensor,
    bias: &'a Tensor,
}

/// Returns the linear layer called `name` among `tensors`; `None` if it is missing or malformed.
fn layer(tensors: &Tensors, name: String) -> Option<WeightLayer<'_>> {
    let weight = tensors.get(&format!("{name}.weight")).filter(|weight| weight.shape.len() == 2)?;
    let bias = tensors.get(&format!("{name}.bias")).filter(|bias| bias.data.len() == weight.shape[0])?;
    Some(WeightLayer { name, weight, bias })
}

/// Returns the layers of the trunk (the layers that all heads share), which have the numbers 0, 2, 4 and so on; `None`
/// if there are none.
fn trunk_layers(tensors: &Tensors) -> Option<Vec<WeightLayer<'_>>> {
    let layers = (0..).map_while(|k| layer(tensors, format!("deformation_net.feature_out.{}", 2 * k)));
    Some(layers.collect::<Vec<_>>()).filter(|layers| !layers.is_empty())
}

/// Returns the two layers of the head (output network) `name`; `None` if one is missing or malformed.
fn head_layers<'a>(tensors: &'a Tensors, name: &str) -> Option<[WeightLayer<'a>; 2]> {
    Some([layer(tensors, format!("{name}.1"))?, layer(tensors, format!("{name}.3"))?])
}

impl WeightLayer<'_> {
    /// Returns the number of inputs of the layer.
    fn inputs(&self) -> usize {
        self.weight.shape[1]
    }

    /// Returns the number of outputs of the layer.
    fn outputs(&self) -> usize {
        self.weight.shape[0]
    }

    /// Returns the outputs of the layer for all samples, given its `inputs` for all samples.
    fn run(&self, inputs: &[f32]) -> Vec<f32> {
        let outputs_of = |sample: &[f32]| -> Vec<f32> {
            let rows = self.weight.data.chunks_exact(self.inputs()).zip(&self.bias.data);
            rows.map(|(row, bias)| bias + row.iter().zip(sample).map(|(w, x)| w * x).sum::<f32>()).collect()
        };
        inputs.chunks_exact(self.inputs()).flat_map(outputs_of).collect()
    }

    /// Returns the importance of each input of the layer, given the importance of each output, `outputs`. Importance
    /// says how strongly an error of a value changes the result of the field. `active`: for each input, the fraction of
    /// samples in which the input is above zero, that is, passes the ReLU before this layer.
    fn backward(&self, outputs: &[f64], active: &[f64]) -> Vec<f64> {
        let mut inputs = vec![0.0; self.inputs()];
        for (row, output_importance) in self.weight.data.chunks_exact(self.inputs()).zip(outputs) {
            inputs.iter_mut().zip(row).for_each(|(sum, &w)| *sum += f64::from(w) * f64::from(w) * output_importance);
        }
        inputs.iter_mut().zip(active).for_each(|(sum, active)| *sum *= active);
        inputs
    }
}

/// Returns, for each of the `width` values that a sample has, its mean square over all samples.
fn mean_squares(samples: &[f32], width: usize) -> Vec<f64> {
    let mut sums = vec![0.0; width];
    for sample in samples.chunks_exact(width) {
        sums.iter_mut().zip(sample).for_each(|(sum, &x)| *sum += f64::from(x) * f64::from(x));
    }
    let count = (samples.len() / width).max(1) as f64;
    sums.iter().map(|sum| sum / count).collect()
}

/// Returns, for each of the `width` values that a sample has, the fraction of the samples in which this value is above
/// zero.
fn active_fraction(samples: &[f32], width: usize) -> Vec<f64> {
    let mut counts = vec![0.0; width];
    for sample in samples.chunks_exact(width) {
        counts.iter_mut().zip(sample).for_each(|(count, &x)| *count += f64::from(u8::from(x > 0.0)));
    }
    let all = (samples.len() / width).max(1) as f64;
    counts.iter().map(|count| count / all).collect()
}

/// Inputs of the trunk (the layers that all heads share) at some positions and times.
struct Samples {
    /// Number of inputs of the trunk (the layers that all heads share).
    width: usize,
    /// Inputs of the trunk (the layers that all heads share), `[samples, width]`.
    features: Vec<f32>,
    /// For every plane: its name, the index of its first channel among the inputs of the trunk, and one number per
    /// channel. This number is the sum over all samples of p², where p is the product of the values that the five other
    /// planes have in this channel.
    plane_factors: Vec<(String, usize, Vec<f64>)>,
}

/// The two axes of each of the six feature planes; 0 to 2 are x, y and z, 3 is time.
const AXES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

impl Samples {
    /// Evaluates the feature planes for at most [`MAX_SAMPLED_GAUSSIANS`] Gaussians at [`TIMES_PER_GAUSSIAN`] times
    /// each, between the times `first` and `last`. Returns the resulting inputs of the trunk (the layers that all heads
    /// share); `None` if the planes are missing or malformed. `position` holds the canonical positions; `space` is the
    /// box that the planes cover.
    fn new(tensors: &Tensors, position: &AttributeValues, space: Box3, [first, last]: [f32; 2]) -> Option<Samples> {
        let name = |level: usize, plane: usize| format!("deformation_net.grid.grids.{level}.{plane}");
        let mut levels: Vec<[&Tensor; 6]> = Vec::new();
        while let Some(plane) = tensors.get(&name(levels.len(), 0)) {
            let mut planes = [plane; 6];
            for (k, plane) in planes.iter_mut().enumerate() {
                *plane = tensors.get(&name(levels.len(), k)).filter(|plane| plane.shape.len() == 4)?;
            }
            if planes.iter().any(|other| other.shape[1] != plane.shape[1]) {
                return None;
            }
            levels.push(planes);
        }
        let width = levels.iter().map(|planes| planes[0].shape[1]).sum();
        let count = MAX_SAMPLED_GAUSSIANS.min(position.len());
        let mut features = Vec::with_capacity(count * TIMES_PER_GAUSSIAN * width);
        let mut squares = vec![vec![0.0f64; width]; 6];
        for sample in 0..count * TIMES_PER_GAUSSIAN {
            let (i, k) = (sample / TIMES_PER_GAUSSIAN, sample % TIMES_PER_GAUSSIAN);
            let [x, y, z] = space.normalized(position.row(i * position.len() / count));
            // Different Gaussians are sampled at different times.
            let part = (k as f32 + (i as f32 * 0.618).fract()) / TIMES_PER_GAUSSIAN as f32;
            let at = [x, y, z, first + part * (last - first)];
            for planes in &levels {
                let channels = planes[0].shape[1];
                let from = features.len() % width;
                let read: Vec<Vec<f32>> =
                    planes.iter().zip(AXES).map(|(plane, axes)| sample_plane(plane, axes, at)).collect();
                for c in 0..channels {
                    for (p, squares) in squares.iter_mut().enumerate() {
                        let others: f32 = (0..6).filter(|&q| q != p).map(|q| read[q][c]).product();
                        squares[from + c] += f64::from(others) * f64::from(others);
                    }
                    features.push((0..6).map(|q| read[q][c]).product());
                }
            }
        }
        let mut plane_factors = Vec::new();
        let mut from = 0;
        for (level, planes) in levels.iter().enumerate() {
            let channels = planes[0].shape[1];
            for (p, squares) in squares.iter().enumerate() {
                plane_factors.push((name(level, p), from, squares[from..from + channels].to_vec()));
            }
            from += channels;
        }
        Some(Samples { width, features, plane_factors }).filter(|samples| samples.width > 0 && count > 0)
    }
}

/// Returns the values of all channels of a plane over the axes `axes` at the point `at` (x, y, z, time), interpolated
/// bilinearly.
fn sample_plane(plane: &Tensor, axes: [usize; 2], at: [f32; 4]) -> Vec<f32> {
    let [channels, rows, columns] = [plane.shape[1], plane.shape[2], plane.shape[3]];
    let (a, b): (TexelPair, TexelPair) = (texel_pair(at[axes[0]], columns), texel_pair(at[axes[1]], rows));
    let interpolated = |channel: usize| {
        let texel = |row: u32, column: u32| plane.data[(channel * rows + row as usize) * columns + column as usize];
        let along = |row: u32| texel(row, a.low) * (1.0 - a.fraction) + texel(row, a.high) * a.fraction;
        along(b.low) * (1.0 - b.fraction) + along(b.high) * b.fraction
    };
    (0..channels).map(interpolated).collect()
}
