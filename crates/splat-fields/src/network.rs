//! Deep MLP that computes the motion of Gaussians: encoding of position and time, fully connected layers, and one
//! linear output layer (head) per attribute.
//!
//! The first layer reads [e(x), e(t)], where x is the stored position, t the time, and e(v) = [v, sin(2⁰v), cos(2⁰v),
//! sin(2¹v), cos(2¹v), …]; every entry contains all components of v. Positions are encoded with ten octaves (powers of
//! 2). In models with a time network, e(t) is the output of that network. The next layers read the output h of the
//! previous layer, or [e(x), e(t), h] if they have a skip connection. Each layer is a linear map followed by a ReLU.
//! Heads are linear maps of the output of the last layer.
//!
//! Input: tensors of a state dict, stored positions, a time. Output: [`PredictedMotion`]. Memory: the tensors twice,
//! [`Network::BYTES_PER_GAUSSIAN`] per encoded Gaussian, and about 64 kB per call for the outputs of the layers.
//! Sources: Yang et al., "Deformable 3D Gaussians for High-Fidelity Monocular Dynamic Scene Reconstruction", 2024;
//! Huang et al., "SC-GS: Sparse-Controlled Gaussian Splatting for Editable Dynamic Scenes", 2024; and their public
//! code.

use std::path::Path;

use super::instruction_set::{Evaluation, InstructionSet, run_on_best};
use super::linear::{CacheLine, LANES, Linear};
use super::tensors::{Lookup, Tensors};
use splat_core::error::{Error, Result};
use splat_core::{AttributeValues, Attributes};

/// Number of octaves (frequencies 2⁰ to 2⁹) in the encoding of a position.
const POSITION_OCTAVES: usize = 10;
/// Number of values in the encoding of a position: its 3 components, and their sines and cosines for each octave.
const POSITION_INPUTS: usize = 3 + 6 * POSITION_OCTAVES;

/// Deep MLP of position and time that computes the motion of Gaussians. Gaussians are evaluated in blocks; the result
/// for a Gaussian has the same bits whichever other Gaussians are in its block.
#[derive(Debug, Clone)]
pub struct Network {
    /// Number of octaves (frequencies 2⁰, 2¹, …) in the encoding of the time.
    octaves: usize,
    /// Two layers of the time network, which turn the encoded time into the time input of the first layer. `None`: the
    /// first layer reads the encoded time.
    time: Option<[Linear; 2]>,
    layers: Vec<NetworkLayer>,
    heads: Vec<NetworkHead>,
}

/// Fully connected layer with ReLU.
#[derive(Debug, Clone)]
struct NetworkLayer {
    linear: Linear,
    /// Whether the layer has a skip connection: its input is then the encodings of position and time, followed by the
    /// output of the previous layer.
    has_skip: bool,
}

/// Linear output layer (head) that computes the offset of one attribute. A network that predicts screw motions (a
/// rotation and a translation) has two heads for the position: one for the rotation part w, the other for the
/// translation part v.
#[derive(Debug, Clone)]
struct NetworkHead {
    column: Attributes,
    /// First plane (array of one component) of the attribute `column` in [`PredictedMotion`] to which the outputs of
    /// the layer are written: 3 for the translation part v of a screw motion, 0 for every other head.
    plane: usize,
    output: Linear,
}

/// Encoded positions of a block of Gaussians. They do not depend on time.
#[derive(Debug, Clone, Default)]
pub struct EncodedPositions {
    rows: usize,
    /// Encodings in groups of [`LANES`] Gaussians: [`POSITION_INPUTS`] entries per group, each with one value per
    /// Gaussian. The values of unused lanes of the last group are 0.
    values: Vec<CacheLine>,
}

/// Motion that the network computes for a block of Gaussians at one time: the outputs of its heads (output layers).
/// Each field holds an attribute as planes. A plane is an array of one component of the attribute, such as x, with one
/// value per Gaussian. An attribute for which the network has no head is empty. All attributes are empty until
/// [`Network::motion`] computes them.
#[derive(Debug, Clone, Default)]
pub struct PredictedMotion {
    /// Offset that is added to the position: 3 planes (x, y, z of all Gaussians), scene units. If the network predicts
    /// screw motions: 6 planes, 3 for the rotation part w and then 3 for the translation part v of the screw.
    pub warp: AttributeValues,
    /// Offset that is added to the quaternion: 4 planes (w, x, y, z of all Gaussians).
    pub rotation: AttributeValues,
    /// Offset that is added to the scales (not to their logarithms): 3 planes (x, y, z of all Gaussians), scene units.
    pub scaling: AttributeValues,
    /// Offset that is added to the opacity (not to its logit): 1 plane, with one value per Gaussian.
    pub opacity: AttributeValues,
    /// Offset that is added to the SH coefficients of degree 0 (the color): 3 planes (red, green, blue of all
    /// Gaussians).
    pub color: AttributeValues,
}

/// Buffers for the inputs and outputs of the layers, for one group of [`LANES`] Gaussians.
#[derive(Default)]
struct NetworkScratch {
    /// Input of the first layer: the encodings of position and time. For a layer with a skip connection, the output of
    /// the previous layer is appended.
    input: Vec<CacheLine>,
    /// Outputs of the layer that is being evaluated.
    last: Vec<CacheLine>,
    /// Outputs of the previous layer, which the layer that is being evaluated reads.
    spare: Vec<CacheLine>,
}

impl PredictedMotion {
    /// Returns a mutable reference to the predicted motion of the attribute `which`.
    fn column_mut(&mut self, which: Attributes) -> &mut AttributeValues {
        match which {
            Attributes::POSITION => &mut self.warp,
            Attributes::ROTATION => &mut self.rotation,
            Attributes::LOG_SCALE => &mut self.scaling,
            Attributes::OPACITY => &mut self.opacity,
            _ => &mut self.color,
        }
    }
}

impl Network {
    /// Bytes of memory per Gaussian that [`EncodedPositions`] takes.
    pub const BYTES_PER_GAUSSIAN: usize = 4 * POSITION_INPUTS;

    /// Builds the network from the tensors of the file `path` whose names begin with `prefix`. The tensors give the
    /// number and widths of the layers, the skip connections, the octaves of the encoded time, and the heads.
    ///
    /// # Errors
    /// Fails if a tensor is missing, has the wrong shape, or contains values that are not finite. The message names the
    /// tensor.
    pub fn new(tensors: &Tensors, prefix: &str, path: &Path) -> Result<Network> {
        let lookup = Lookup { tensors, path };
        let name = |layer: &str| format!("{prefix}{layer}");
        let has = |layer: &str| lookup.has(&format!("{prefix}{layer}.weight"));
        let load = |layer: &str, inputs: usize, outputs: Option<usize>, why: &str| {
            Linear::load(lookup, &name(layer), inputs, outputs, why)
        };
        let weight_shape =
            |layer: &str| lookup.matrix(&format!("{prefix}{layer}.weight"), "layer of the deformation network");

        let [_, inputs] = weight_shape("linear.0")?;
        let time = match has("timenet.0") {
            true => {
                let [_, inputs] = weight_shape("timenet.0")?;
                let first = load("timenet.0", inputs, None, "input layer of the time network")?;
                let outputs = first.outputs;
                Some((inputs, [first, load("timenet.2", outputs, None, "output layer of the time network")?]))
            }
            false => None,
        };
        let time_inputs = inputs.checked_sub(POSITION_INPUTS).filter(|&width| width > 0);
        let encoded_time = time.as_ref().map_or(time_inputs, |(inputs, _)| Some(*inputs));
        let octaves = encoded_time.filter(|width| width % 2 == 1).map(|width| width / 2);
        let Some((time_inputs, octaves)) = time_inputs.zip(octaves) else {
            let (layer, expected) = match time {
                Some(_) => (
                    "timenet.0",
                    "an odd number of inputs (time, sines and cosines), and more than 63 inputs of linear.0",
                ),
                None => ("linear.0", "63 inputs for the position and an odd number of inputs for the time"),
            };
            let found = format!(
                "linear.0 has {inputs} inputs{}",
                encoded_time.map_or(String::new(), |width| format!(", the time is encoded in {width}"))
            );
            return Err(lookup.mismatch(&name(&format!("{layer}.weight")), expected, found));
        };
        let time = time.map(|(_, layers)| layers);
        if let Some([_, last]) = &time
            && last.outputs != time_inputs
        {
            let expected =
                format!("{time_inputs} outputs, the inputs of linear.0 beyond {POSITION_INPUTS} for the position");
            return Err(lookup.mismatch(&name("timenet.2.weight"), expected, last.outputs.to_string()));
        }

        let mut layers: Vec<NetworkLayer> = Vec::new();
        let mut width = 0;
        while has(&format!("linear.{}", layers.len())) {
            let layer = format!("linear.{}", layers.len());
            let has_skip = !layers.is_empty() && weight_shape(&layer)?[1] == width + inputs;
            let layer_inputs = if layers.is_empty() || has_skip { width + inputs } else { width };
            let why = "outputs of the previous layer, with or without the encodings of position and time";
            let linear = load(&layer, layer_inputs, None, why)?;
            width = linear.outputs;
            layers.push(NetworkLayer { linear, has_skip });
        }

        let mut heads = Vec::new();
        let mut add = |column: Attributes, plane: usize, layer: &str, outputs: usize, why: &str| -> Result<()> {
            let output = load(layer, width, Some(outputs), why)?;
            heads.push(NetworkHead { column, plane, output });
            Ok(())
        };
        if has("branch_w") {
            add(Attributes::POSITION, 0, "branch_w", 3, "rotation axis of a screw motion")?;
            add(Attributes::POSITION, 3, "branch_v", 3, "translation of a screw motion")?;
        } else {
            add(Attributes::POSITION, 0, "gaussian_warp", 3, "position offset")?;
        }
        add(Attributes::ROTATION, 0, "gaussian_rotation", 4, "rotation offset")?;
        add(Attributes::LOG_SCALE, 0, "gaussian_scaling", 3, "scale offset")?;
        if has("gaussian_opacity") {
            add(Attributes::OPACITY, 0, "gaussian_opacity", 1, "opacity offset")?;
        }
        if has("gaussian_color") {
            add(Attributes::SH, 0, "gaussian_color", 3, "color offset")?;
        }
        Ok(Network { octaves, time, layers, heads })
    }

    /// Returns the attributes that the network changes, because it has a head (output layer) for them.
    pub fn deformed_attributes(&self) -> Attributes {
        self.heads.iter().map(|head| head.column).collect()
    }

    /// Returns whether positions move by screw motions (a rotation and a translation). [`PredictedMotion::warp`] then
    /// holds the screw parameters w and v.
    pub fn predicts_screw_motion(&self) -> bool {
        self.heads.iter().any(|head| head.plane > 0)
    }

    /// Returns the number of multiplications by weights that one evaluation of one Gaussian at one time takes.
    pub fn multiplications(&self) -> usize {
        let layers = self.layers.iter().map(|layer| &layer.linear);
        layers.chain(self.heads.iter().map(|head| &head.output)).map(Linear::multiplications).sum()
    }

    /// Computes the encoding of the stored positions `position` (`[3, N]`).
    ///
    /// Sines and cosines of 2ᵏ times the f32 position are exact to f32 precision. The values for k = 0 are computed in
    /// f64. The values for k + 1 follow from those for k by the double-angle formulas. Each doubling doubles the error,
    /// from 1e-16 at first to 1e-13 at the last octave.
    pub fn encode(&self, position: &AttributeValues) -> EncodedPositions {
        let rows = position.len();
        let mut values = vec![CacheLine([0.0; LANES]); rows.div_ceil(LANES) * POSITION_INPUTS];
        for (axis, row) in (0..3).flat_map(|axis| (0..rows).map(move |row| (axis, row))) {
            let (group, lane) = (row / LANES, row % LANES);
            let out = &mut values[group * POSITION_INPUTS..][..POSITION_INPUTS];
            for (k, value) in encode_scalar(position.plane(axis)[row], POSITION_OCTAVES).into_iter().enumerate() {
                out[3 * k + axis].0[lane] = value;
            }
        }
        EncodedPositions { rows, values }
    }

    /// Computes into `out` the motion of the attributes `want` at `time`. The time is rounded to f32, as in the code of
    /// the trainers. Other attributes of `out` stay unchanged.
    ///
    /// # Errors
    /// Fails if `time` is not finite.
    pub fn motion(
        &self,
        encoded: &EncodedPositions,
        time: f64,
        want: Attributes,
        out: &mut PredictedMotion,
    ) -> Result<()> {
        let time = checked_time(time)?;
        for head in self.heads.iter().filter(|head| want.contains(head.column)) {
            let column = out.column_mut(head.column);
            let width = head.plane + head.output.outputs;
            if column.width() < width {
                *column = AttributeValues::zeros(width, encoded.rows);
            }
            column.resize(encoded.rows);
        }
        run_on_best(MotionEvaluation { network: self, encoded, time, want, out });
        Ok(())
    }

    /// Computes the derivatives of [`PredictedMotion::warp`] at `time` with respect to the stored positions `position`
    /// (`[3, N]`). Plane 3·o + a of the result is ∂ output o / ∂ position component a.
    ///
    /// # Errors
    /// Fails if `time` is not finite.
    pub fn warp_jacobian(&self, position: &AttributeValues, time: f64) -> Result<AttributeValues> {
        let time = checked_time(time)?;
        let encoded = self.encode(position);
        let outputs = if self.predicts_screw_motion() { 6 } else { 3 };
        let mut out = AttributeValues::zeros(3 * outputs, encoded.rows);
        run_on_best(WarpJacobian { network: self, encoded: &encoded, time, out: &mut out });
        Ok(out)
    }

    /// Returns the encoding of `time` that the layers read: the time with its sines and cosines, or the output of the
    /// time network if there is one. All Gaussians of a group get the same values.
    #[inline(always)]
    fn encode_time<S: InstructionSet>(&self, time: f32) -> Vec<CacheLine> {
        let mut now: Vec<CacheLine> =
            encode_scalar(time, self.octaves).into_iter().map(|value| CacheLine([value; LANES])).collect();
        if let Some([first, last]) = &self.time {
            let (mut hidden, mut planes) = (Vec::new(), vec![0.0; last.outputs]);
            first.activate::<S>(&now, &mut hidden);
            last.write::<S>(&hidden, 1, &mut planes, 1, 0);
            now = planes.into_iter().map(|value| CacheLine([value; LANES])).collect();
        }
        now
    }
}

/// [`Evaluation`] that computes the result of [`Network::motion`] at `time` into `out`, for the heads of the attributes
/// `want`.
struct MotionEvaluation<'a> {
    network: &'a Network,
    encoded: &'a EncodedPositions,
    time: f32,
    want: Attributes,
    out: &'a mut PredictedMotion,
}

impl Evaluation for MotionEvaluation<'_> {
    /// Evaluates the network in groups of [`LANES`] Gaussians.
    #[inline(always)]
    fn run<S: InstructionSet>(self) {
        let MotionEvaluation { network, encoded, time, want, out } = self;
        let (encoded_time, mut scratch) = (network.encode_time::<S>(time), NetworkScratch::default());
        for (group, position_encoding) in encoded.values.chunks_exact(POSITION_INPUTS).enumerate() {
            let NetworkScratch { input, last, spare } = &mut scratch;
            input.clear();
            input.extend_from_slice(position_encoding);
            input.extend_from_slice(&encoded_time);
            for (k, layer) in network.layers.iter().enumerate() {
                std::mem::swap(last, spare);
                if layer.has_skip {
                    input.truncate(POSITION_INPUTS + encoded_time.len());
                    input.extend_from_slice(&spare[..network.layers[k - 1].linear.outputs]);
                }
                layer.linear.activate::<S>(if k == 0 || layer.has_skip { input } else { spare }, last);
            }
            let start = group * LANES;
            let lanes = LANES.min(encoded.rows - start);
            for head in network.heads.iter().filter(|head| want.contains(head.column)) {
                let planes = &mut out.column_mut(head.column).planes_mut()[head.plane * encoded.rows..];
                head.output.write::<S>(last, lanes, planes, encoded.rows, start);
            }
        }
    }
}

/// [`Evaluation`] that computes the result of [`Network::warp_jacobian`] at `time` into `out`.
struct WarpJacobian<'a> {
    network: &'a Network,
    encoded: &'a EncodedPositions,
    time: f32,
    out: &'a mut AttributeValues,
}

impl Evaluation for WarpJacobian<'_> {
    /// Makes, for each group of [`LANES`] Gaussians, one forward pass for all outputs, and one backward pass for each
    /// position output (offset, or parameters of the screw motion).
    #[inline(always)]
    fn run<S: InstructionSet>(self) {
        let WarpJacobian { network, encoded, time, out } = self;
        let encoded_time = network.encode_time::<S>(time);
        let encodings = POSITION_INPUTS + encoded_time.len();
        let mut activations: Vec<Vec<CacheLine>> = vec![Vec::new(); network.layers.len()];
        let (mut input, mut gradient, mut spare, mut position_gradient) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (group, position_encoding) in encoded.values.chunks_exact(POSITION_INPUTS).enumerate() {
            input.clear();
            input.extend_from_slice(position_encoding);
            input.extend_from_slice(&encoded_time);
            for (k, layer) in network.layers.iter().enumerate() {
                let (before, now) = activations.split_at_mut(k);
                let before = before.last().map_or(&[][..], |before| &before[..]);
                if layer.has_skip {
                    input.truncate(encodings);
                    input.extend_from_slice(&before[..network.layers[k - 1].linear.outputs]);
                }
                layer.linear.activate::<S>(if k == 0 || layer.has_skip { &input } else { before }, &mut now[0]);
            }
            let start = group * LANES;
            let lanes = LANES.min(encoded.rows - start);
            let heads = network.heads.iter().filter(|head| head.column == Attributes::POSITION);
            for (head, component) in heads.flat_map(|head| (0..head.output.outputs).map(move |o| (head, o))) {
                gradient.clear();
                gradient.resize(head.output.padded_outputs(), CacheLine([0.0; LANES]));
                gradient[component] = CacheLine([1.0; LANES]);
                position_gradient.clear();
                position_gradient.resize(POSITION_INPUTS, CacheLine([0.0; LANES]));
                head.output.backward::<S>(&gradient, activations.last().map(Vec::as_slice), &mut spare);
                std::mem::swap(&mut gradient, &mut spare);
                for (k, layer) in network.layers.iter().enumerate().rev() {
                    // A layer with a skip connection first reads the encodings, which do not come out of a ReLU.
                    let before = k.checked_sub(1).map(|before| &activations[before][..]);
                    layer.linear.backward::<S>(&gradient, before.filter(|_| !layer.has_skip), &mut spare);
                    std::mem::swap(&mut gradient, &mut spare);
                    if k == 0 || layer.has_skip {
                        add_to_sums(&gradient[..POSITION_INPUTS], &mut position_gradient);
                    }
                    if let Some(before) = before.filter(|_| layer.has_skip) {
                        gradient.drain(..encodings);
                        gradient.resize(before.len(), CacheLine([0.0; LANES]));
                        relu_gradient(&mut gradient, before);
                    }
                }
                for axis in 0..3 {
                    let slope = axis_derivative(axis, position_encoding, &position_gradient);
                    let plane = out.plane_mut(3 * (head.plane + component) + axis);
                    plane[start..][..lanes].copy_from_slice(&slope.0[..lanes]);
                }
            }
        }
    }
}

/// Returns `time` rounded to f32, the precision of the network. Fails if `time` is not finite.
fn checked_time(time: f64) -> Result<f32> {
    match time.is_finite() {
        true => Ok(time as f32),
        false => Err(Error::internal(format!("time of a deformation network: expected a finite number, found {time}"))),
    }
}

/// Returns the encoding `[v, sin(v), cos(v), sin(2v), cos(2v), …]` of a number v. The frequencies are `octaves` powers
/// of 2, from 1 on.
fn encode_scalar(value: f32, octaves: usize) -> Vec<f32> {
    let mut all = Vec::with_capacity(1 + 2 * octaves);
    all.push(value);
    let (mut sine, mut cosine) = f64::from(value).sin_cos();
    for _ in 0..octaves {
        all.extend([sine as f32, cosine as f32]);
        (sine, cosine) = (2.0 * sine * cosine, (cosine - sine) * (cosine + sine));
    }
    all
}

/// Adds each entry of `terms` to the entry of `sums` with the same index.
#[inline(always)]
fn add_to_sums(terms: &[CacheLine], sums: &mut [CacheLine]) {
    for (sums, terms) in sums.iter_mut().zip(terms) {
        sums.0.iter_mut().zip(&terms.0).for_each(|(sum, term)| *sum += term);
    }
}

/// Multiplies `gradient` by the derivative of ReLU: sets it to 0 where the output of the ReLU (`activations`) is not
/// positive.
#[inline(always)]
fn relu_gradient(gradient: &mut [CacheLine], activations: &[CacheLine]) {
    for (gradient, activations) in gradient.iter_mut().zip(activations) {
        for (gradient, &activation) in gradient.0.iter_mut().zip(&activations.0) {
            *gradient = if activation > 0.0 { *gradient } else { 0.0 };
        }
    }
}

/// Returns the derivative of a network output with respect to the position along `axis`. `position_encoding` holds the
/// encoded position (sines and cosines), and `gradient` the derivatives of the output with respect to the encoded
/// position.
#[inline(always)]
fn axis_derivative(axis: usize, position_encoding: &[CacheLine], gradient: &[CacheLine]) -> CacheLine {
    let mut sum = gradient[axis];
    for k in 0..POSITION_OCTAVES {
        let (sine, cosine) = (3 * (2 * k + 1) + axis, 3 * (2 * k + 2) + axis);
        let frequency = (1 << k) as f32;
        for lane in 0..LANES {
            let term = position_encoding[cosine].0[lane] * gradient[sine].0[lane]
                - position_encoding[sine].0[lane] * gradient[cosine].0[lane];
            sum.0[lane] += frequency * term;
        }
    }
    sum
}

#[cfg(test)]
mod tests;
