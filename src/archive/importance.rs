//! How much of an error in one channel, row or column of a field's tensors arrives at what the field changes, against
//! that in another one of the same tensor.
//!
//! In: a state dict, positions and times. Out: for every tensor what is added to its step, by channel; by row and column
//! of a matrix. To first order, and as if the errors of different values had nothing to do with each other: an error of
//! a plane arrives times the product of the five others, one of a weight times what the weight multiplies, and both
//! times the weights on the way out. Only a writer needs this, so nothing depends on how it rounds.

use std::collections::BTreeMap;

use super::field::Role;
use crate::deform::{Box3, Tap, Tensor, Tensors, tap};
use crate::model::Column;

/// Gaussians and times that are looked at.
const GAUSSIANS: usize = 256;
const TIMES: usize = 4;
/// Steps follow importance to whole half octaves, ...
const UNIT: f64 = 4.0;
/// ... and no further than so many of them.
const FURTHEST: f64 = 6.0;

/// What is added to the steps of each tensor, in eighths of an octave.
pub fn offsets(
    field: &BTreeMap<String, Role>,
    tensors: &Tensors,
    position: &Column,
    space: Option<Box3>,
    times: [f32; 2],
) -> BTreeMap<String, Vec<i8>> {
    let network = FieldWeights { tensors };
    let mut found = BTreeMap::new();
    let Some(space) = space else { return found };
    let Some(trunk) = network.layers("deformation_net.feature_out", 0, 2) else { return found };
    // Samples of what the trunk reads, and squares of what each plane is multiplied by.
    let Some(samples) = Samples::new(tensors, position, space, times) else { return found };
    if trunk[0].inputs() != samples.width {
        return found;
    }
    // Forward: the mean square of what every layer reads.
    let mut reads: Vec<(WeightLayer<'_>, Vec<f64>)> = Vec::new();
    let mut now = samples.features.clone();
    for layer in &trunk {
        reads.push((layer.clone(), mean_squares(&now, layer.inputs())));
        now = layer.run(&now);
        now.iter_mut().for_each(|x| *x = x.max(0.0));
    }
    let mut leaving = vec![0.0; trunk[trunk.len() - 1].outputs()];
    let active = part_active(&now, leaving.len());
    for name in heads(field) {
        let Some([hidden, output]) = network.head(&name) else { continue };
        if hidden.inputs() != leaving.len() || output.inputs() != hidden.outputs() {
            continue;
        }
        let read = mean_squares(&now, hidden.inputs());
        let mut inside = hidden.run(&now);
        inside.iter_mut().for_each(|x| *x = x.max(0.0));
        let of_output = vec![1.0; output.outputs()];
        let of_hidden = output.back(&of_output, &part_active(&inside, hidden.outputs()));
        let back = hidden.back(&of_hidden, &active);
        // No head counts for more than another: how much each does, pictures say.
        let all: f64 = back.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        leaving.iter_mut().zip(&back).for_each(|(sum, x)| *sum += x / all);
        add(&mut found, &hidden, &of_hidden, &read);
        add(&mut found, &output, &of_output, &mean_squares(&inside, output.inputs()));
    }
    // Back through the trunk.
    for (layer, read) in reads.iter().rev() {
        add(&mut found, layer, &leaving, read);
        let ones = vec![1.0; layer.inputs()];
        leaving = layer.back(&leaving, &ones);
    }
    for (name, first, squares) in &samples.beside {
        let by_channel: Vec<f64> = squares.iter().zip(&leaving[*first..]).map(|(a, b)| a * b).collect();
        found.insert(name.clone(), steps(&by_channel));
    }
    found
}

/// Adds what a layer's rows count for and what its columns read.
fn add(found: &mut BTreeMap<String, Vec<i8>>, layer: &WeightLayer<'_>, rows: &[f64], columns: &[f64]) {
    found.insert(format!("{}.weight", layer.name), [steps(rows), steps(columns)].concat());
    found.insert(format!("{}.bias", layer.name), steps(rows));
}

/// Steps whose squares go against what counts, with a geometric mean of one.
fn steps(counts: &[f64]) -> Vec<i8> {
    let most = counts.iter().copied().fold(0.0, f64::max);
    let octaves: Vec<f64> = counts.iter().map(|count| -0.5 * (count.max(1e-4 * most) / most).log2()).collect();
    if most.is_nan() || most <= 0.0 {
        return vec![0; counts.len()];
    }
    let mean = octaves.iter().sum::<f64>() / octaves.len().max(1) as f64;
    let units = octaves.iter().map(|octave| (8.0 * (octave - mean) / UNIT).round().clamp(-FURTHEST, FURTHEST));
    units.map(|units| (units * UNIT) as i8).collect()
}

/// Names of the heads that are read.
fn heads(field: &BTreeMap<String, Role>) -> Vec<String> {
    let of = |(name, role): (&String, &Role)| {
        let head =
            name.strip_suffix(".1.weight").filter(|head| *role == Role::Weights && !head.ends_with("feature_out"));
        head.map(str::to_owned)
    };
    field.iter().filter_map(of).collect()
}

struct FieldWeights<'a> {
    tensors: &'a Tensors,
}

#[derive(Clone)]
struct WeightLayer<'a> {
    name: String,
    weight: &'a Tensor,
    bias: &'a Tensor,
}

impl<'a> FieldWeights<'a> {
    fn layer(&self, name: String) -> Option<WeightLayer<'a>> {
        let weight = self.tensors.get(&format!("{name}.weight")).filter(|weight| weight.shape.len() == 2)?;
        let bias = self.tensors.get(&format!("{name}.bias")).filter(|bias| bias.data.len() == weight.shape[0])?;
        Some(WeightLayer { name, weight, bias })
    }

    /// Layers of numbers from `first` on; none if there is not even one.
    fn layers(&self, name: &str, first: usize, by: usize) -> Option<Vec<WeightLayer<'a>>> {
        let layers = (0..).map_while(|k| self.layer(format!("{name}.{}", first + k * by)));
        Some(layers.collect::<Vec<_>>()).filter(|layers| !layers.is_empty())
    }

    fn head(&self, name: &str) -> Option<[WeightLayer<'a>; 2]> {
        Some([self.layer(format!("{name}.1"))?, self.layer(format!("{name}.3"))?])
    }
}

impl WeightLayer<'_> {
    fn inputs(&self) -> usize {
        self.weight.shape[1]
    }

    fn outputs(&self) -> usize {
        self.weight.shape[0]
    }

    /// Outputs of all samples.
    fn run(&self, inputs: &[f32]) -> Vec<f32> {
        let of = |sample: &[f32]| -> Vec<f32> {
            let rows = self.weight.data.chunks_exact(self.inputs()).zip(&self.bias.data);
            rows.map(|(row, bias)| bias + row.iter().zip(sample).map(|(w, x)| w * x).sum::<f32>()).collect()
        };
        inputs.chunks_exact(self.inputs()).flat_map(of).collect()
    }

    /// What inputs count for, given what outputs do, times how often each is let through.
    fn back(&self, outputs: &[f64], active: &[f64]) -> Vec<f64> {
        let mut inputs = vec![0.0; self.inputs()];
        for (row, count) in self.weight.data.chunks_exact(self.inputs()).zip(outputs) {
            inputs.iter_mut().zip(row).for_each(|(sum, &w)| *sum += f64::from(w) * f64::from(w) * count);
        }
        inputs.iter_mut().zip(active).for_each(|(sum, active)| *sum *= active);
        inputs
    }
}

fn mean_squares(samples: &[f32], width: usize) -> Vec<f64> {
    let mut sums = vec![0.0; width];
    for sample in samples.chunks_exact(width) {
        sums.iter_mut().zip(sample).for_each(|(sum, &x)| *sum += f64::from(x) * f64::from(x));
    }
    let count = (samples.len() / width).max(1) as f64;
    sums.iter().map(|sum| sum / count).collect()
}

/// How often each is above zero.
fn part_active(samples: &[f32], width: usize) -> Vec<f64> {
    let mut counts = vec![0.0; width];
    for sample in samples.chunks_exact(width) {
        counts.iter_mut().zip(sample).for_each(|(count, &x)| *count += f64::from(u8::from(x > 0.0)));
    }
    let all = (samples.len() / width).max(1) as f64;
    counts.iter().map(|count| count / all).collect()
}

/// What the trunk reads at some positions and times.
struct Samples {
    width: usize,
    /// `[samples, width]`.
    features: Vec<f32>,
    /// Of every plane its name, the first of its channels among the features, and by channel the mean square of the
    /// product of the five others.
    beside: Vec<(String, usize, Vec<f64>)>,
}

/// Axes of the six planes; 3 is time.
const AXES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

impl Samples {
    /// None where the planes are not as they are to be.
    fn new(tensors: &Tensors, position: &Column, space: Box3, [first, last]: [f32; 2]) -> Option<Samples> {
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
        let count = GAUSSIANS.min(position.len());
        let mut features = Vec::with_capacity(count * TIMES * width);
        let mut squares = vec![vec![0.0f64; width]; 6];
        for sample in 0..count * TIMES {
            let (i, k) = (sample / TIMES, sample % TIMES);
            let [x, y, z] = space.normalized(position.row(i * position.len() / count));
            // Not the same times for all.
            let part = (k as f32 + (i as f32 * 0.618).fract()) / TIMES as f32;
            let at = [x, y, z, first + part * (last - first)];
            for planes in &levels {
                let channels = planes[0].shape[1];
                let from = features.len() % width;
                let read: Vec<Vec<f32>> = planes.iter().zip(AXES).map(|(plane, axes)| read(plane, axes, at)).collect();
                for c in 0..channels {
                    for (p, squares) in squares.iter_mut().enumerate() {
                        let others: f32 = (0..6).filter(|&q| q != p).map(|q| read[q][c]).product();
                        squares[from + c] += f64::from(others) * f64::from(others);
                    }
                    features.push((0..6).map(|q| read[q][c]).product());
                }
            }
        }
        let mut beside = Vec::new();
        let mut from = 0;
        for (level, planes) in levels.iter().enumerate() {
            let channels = planes[0].shape[1];
            for (p, squares) in squares.iter().enumerate() {
                beside.push((name(level, p), from, squares[from..from + channels].to_vec()));
            }
            from += channels;
        }
        Some(Samples { width, features, beside }).filter(|samples| samples.width > 0 && count > 0)
    }
}

/// All channels of a plane at a place.
fn read(plane: &Tensor, axes: [usize; 2], at: [f32; 4]) -> Vec<f32> {
    let [channels, rows, columns] = [plane.shape[1], plane.shape[2], plane.shape[3]];
    let (a, b): (Tap, Tap) = (tap(at[axes[0]], columns), tap(at[axes[1]], rows));
    let of = |channel: usize| {
        let texel = |row: u32, column: u32| plane.data[(channel * rows + row as usize) * columns + column as usize];
        let along = |row: u32| texel(row, a.low) * (1.0 - a.fraction) + texel(row, a.high) * a.fraction;
        along(b.low) * (1.0 - b.fraction) + along(b.high) * b.fraction
    };
    (0..channels).map(of).collect()
}
