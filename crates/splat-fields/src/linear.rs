//! Fully connected layers, evaluated for [`LANES`] Gaussians side by side.
//!
//! On loading, weights are reordered into panels of four outputs each. The sums of a panel (four outputs of [`LANES`]
//! Gaussians) take eight of the sixteen AVX2 registers, enough to hide the latency of the multiply-adds; with AVX-512,
//! the sums of four panels take sixteen of 32 registers. The lanes of a register belong to different Gaussians, not to
//! different outputs, so layers with few outputs are not slower per output. A matrix library that reorders its operands
//! in every call would spend a seventh of its time on this reordering, because these matrices are small.

use splat_core::error::Result;

use super::instruction_set::InstructionSet;
use super::tensors::Lookup;

/// Number of Gaussians that are evaluated side by side, one per lane of the vectors.
pub(super) const LANES: usize = 16;
/// One value for each of [`LANES`] Gaussians, aligned to a cache line: loading a register from two lines takes twice
/// the time.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct CacheLine(pub(super) [f32; LANES]);

/// Number of outputs of a layer whose sums are computed together (a panel).
const PANEL: usize = 4;

/// Number of panels whose sums are computed together with AVX-512.
const WIDE: usize = 4;

/// Fully connected layer `y = W·x + b` with inputs x and outputs y.
#[derive(Debug, Clone)]
pub(super) struct Linear {
    /// Weights `[panels, inputs, PANEL]`, in panels of [`PANEL`] outputs. The last panel is filled up with zeros.
    weight: Vec<[f32; PANEL]>,
    /// Biases `[panels, PANEL]`, in panels of [`PANEL`] outputs. The last panel is filled up with zeros.
    bias: Vec<[f32; PANEL]>,
    inputs: usize,
    pub(super) outputs: usize,
}

impl Linear {
    /// Reads the layer from the tensors `{name}.weight` `[outputs, inputs]` and `{name}.bias` `[outputs]`. If `outputs`
    /// is `None`, any number of outputs is accepted. Errors show `why`, the reason why the tensors are expected with
    /// these shapes.
    pub(super) fn load(
        lookup: Lookup<'_>,
        name: &str,
        inputs: usize,
        outputs: Option<usize>,
        why: &str,
    ) -> Result<Self> {
        let weight = lookup.get_shaped(&format!("{name}.weight"), &[outputs, Some(inputs)], why)?;
        let outputs = weight.shape[0];
        let bias = lookup.get_shaped(&format!("{name}.bias"), &[Some(outputs)], why)?;
        let panels = outputs.div_ceil(PANEL);
        let mut layer =
            Linear { weight: vec![[0.0; PANEL]; panels * inputs], bias: vec![[0.0; PANEL]; panels], inputs, outputs };
        for (o, row) in weight.data.chunks_exact(inputs).enumerate() {
            let (panel, place) = (o / PANEL, o % PANEL);
            layer.bias[panel][place] = bias.data[o];
            for (packed, &value) in layer.weight[panel * inputs..].iter_mut().zip(row) {
                packed[place] = value;
            }
        }
        Ok(layer)
    }

    /// Returns the number of outputs of the layer, rounded up to a multiple of [`PANEL`].
    pub(super) fn padded_outputs(&self) -> usize {
        self.bias.len() * PANEL
    }

    /// Returns the number of multiplications by weights that one evaluation of one Gaussian takes.
    pub(super) fn multiplications(&self) -> usize {
        self.weight.len() * PANEL
    }

    /// Computes the outputs of the layer after ReLU for `input` `[inputs, LANES]`, into `out` `[outputs, LANES]`. A NaN
    /// stays NaN, unlike with `f32::max`.
    #[inline(always)]
    pub(super) fn activate<S: InstructionSet>(&self, input: &[CacheLine], out: &mut Vec<CacheLine>) {
        out.resize(self.padded_outputs(), CacheLine([0.0; LANES]));
        self.for_each_output::<S>(input, |o, y| {
            for (out, &y) in out[o].0.iter_mut().zip(&y.0) {
                *out = if y < 0.0 { 0.0 } else { y };
            }
        });
    }

    /// Computes the outputs of the layer for `input`, without ReLU, and writes the outputs of the first `lanes`
    /// Gaussians to `planes`. `planes` holds one plane of `len` values per output. Output o of the first Gaussian is
    /// written to index `o·len + start`, and the outputs o of the next Gaussians follow.
    #[inline(always)]
    pub(super) fn write<S: InstructionSet>(
        &self,
        input: &[CacheLine],
        lanes: usize,
        planes: &mut [f32],
        len: usize,
        start: usize,
    ) {
        self.for_each_output::<S>(input, |o, y| {
            if o < self.outputs {
                planes[o * len + start..][..lanes].copy_from_slice(&y.0[..lanes]);
            }
        });
    }

    /// Computes the outputs before ReLU for `input` `[inputs, LANES]`, and calls `take` with the index and the values
    /// of each. The outputs that fill up the last panel are included.
    #[inline(always)]
    fn for_each_output<S: InstructionSet>(&self, input: &[CacheLine], mut take: impl FnMut(usize, &CacheLine)) {
        // Loops instead of `for_each`, because a closure that is not inlined is compiled without the instructions of
        // `S`.
        let input = &input[..self.inputs];
        let wide = if S::IS_WIDE { self.bias.len() / WIDE * WIDE } else { 0 };
        for panel in (0..wide).step_by(WIDE) {
            let sums = self.panel_outputs::<S, WIDE>(input, panel);
            for (o, sum) in sums.as_flattened().iter().enumerate() {
                take(PANEL * panel + o, sum);
            }
        }
        for panel in wide..self.bias.len() {
            let sums = self.panel_outputs::<S, 1>(input, panel);
            for (o, sum) in sums.as_flattened().iter().enumerate() {
                take(PANEL * panel + o, sum);
            }
        }
    }

    /// Computes the outputs of the `N` panels from `panel` on, before ReLU, for `input` `[inputs, LANES]`.
    ///
    /// Each output is the bias plus the products of inputs and weights, added in the order of the inputs. The result
    /// for a Gaussian therefore depends neither on the Gaussians beside it nor on `N`.
    #[inline(always)]
    fn panel_outputs<S: InstructionSet, const N: usize>(
        &self,
        input: &[CacheLine],
        panel: usize,
    ) -> [[CacheLine; PANEL]; N] {
        // A loop instead of `from_fn` and `map`, because a closure that is not inlined is compiled without the
        // instructions of `S`.
        let mut sums = [[CacheLine([0.0; LANES]); PANEL]; N];
        for (sum, &bias) in sums.as_flattened_mut().iter_mut().zip(self.bias[panel..][..N].as_flattened()) {
            *sum = CacheLine([bias; LANES]);
        }
        let weights: [_; N] = std::array::from_fn(|p| &self.weight[(panel + p) * self.inputs..][..input.len()]);
        for (i, x) in input.iter().enumerate() {
            for (sums, weight) in sums.iter_mut().zip(&weights) {
                for (sum, &w) in sums.iter_mut().zip(&weight[i]) {
                    S::add_product(sum, x, w);
                }
            }
        }
        sums
    }

    /// Computes the backward pass of the layer: converts derivatives of a value with respect to the outputs
    /// (`output_gradient`) to derivatives with respect to the inputs (`out`). Both arrays are padded with zeros to a
    /// multiple of [`PANEL`] entries.
    ///
    /// `activations` holds the inputs of the layer if they come out of a ReLU, and is `None` if not. With it, the
    /// derivative is continued through the ReLU: it becomes 0 for an input that is not positive.
    #[inline(always)]
    pub(super) fn backward<S: InstructionSet>(
        &self,
        output_gradient: &[CacheLine],
        activations: Option<&[CacheLine]>,
        out: &mut Vec<CacheLine>,
    ) {
        out.resize(self.inputs.next_multiple_of(PANEL), CacheLine([0.0; LANES]));
        let together = PANEL * WIDE;
        let wide = if S::IS_WIDE { self.inputs / together * together } else { 0 };
        for first in (0..wide).step_by(together) {
            let sums = self.input_gradients::<S, { PANEL * WIDE }>(output_gradient, first);
            out[first..][..together].copy_from_slice(&sums);
        }
        for first in (wide..self.inputs).step_by(PANEL) {
            let sums = self.input_gradients::<S, PANEL>(output_gradient, first);
            out[first..][..PANEL].copy_from_slice(&sums);
        }
        for (out, activations) in out.iter_mut().zip(activations.unwrap_or_default()) {
            for (out, &activation) in out.0.iter_mut().zip(&activations.0) {
                *out = if activation > 0.0 { *out } else { 0.0 };
            }
        }
    }

    /// Computes the derivatives with respect to the `N` inputs from `first` on, for the derivatives `output_gradient`
    /// with respect to the outputs. Inputs after the last one have the derivative 0.
    #[inline(always)]
    fn input_gradients<S: InstructionSet, const N: usize>(
        &self,
        output_gradient: &[CacheLine],
        first: usize,
    ) -> [CacheLine; N] {
        let mut sums = [CacheLine([0.0; LANES]); N];
        for (weight, gradient) in self.weight.chunks_exact(self.inputs).zip(output_gradient.chunks_exact(PANEL)) {
            let mut padded = [[0.0; PANEL]; N];
            let weight = match weight[first..].first_chunk::<N>() {
                Some(weight) => weight,
                None => {
                    padded[..self.inputs - first].copy_from_slice(&weight[first..]);
                    &padded
                }
            };
            for (o, gradient) in gradient.iter().enumerate() {
                for (sum, weight) in sums.iter_mut().zip(weight) {
                    S::add_product(sum, gradient, weight[o]);
                }
            }
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::super::instruction_set::{InstructionSet, Portable};
    use super::*;
    use crate::synthetic::Noise;

    /// Returns a layer with random weights.
    fn layer(inputs: usize, outputs: usize) -> Linear {
        let mut noise = Noise(7);
        let mut weight = vec![[0.0; PANEL]; outputs.div_ceil(PANEL) * inputs];
        let mut bias = vec![[0.0; PANEL]; outputs.div_ceil(PANEL)];
        for o in 0..outputs {
            bias[o / PANEL][o % PANEL] = noise.next();
            (0..inputs).for_each(|i| weight[o / PANEL * inputs + i][o % PANEL] = noise.next());
        }
        Linear { weight, bias, inputs, outputs }
    }

    fn random_lines(count: usize) -> Vec<CacheLine> {
        let mut noise = Noise(8);
        (0..count).map(|_| CacheLine(std::array::from_fn(|_| noise.next()))).collect()
    }

    /// Returns the outputs of `layer` for random inputs, and the gradients of the inputs for random gradients of the
    /// outputs, computed with the instruction set `S`.
    fn outputs_and_gradients<S: InstructionSet>(layer: &Linear) -> [Vec<[f32; LANES]>; 2] {
        let (mut outputs, mut gradients) = (Vec::new(), Vec::new());
        layer.activate::<S>(&random_lines(layer.inputs), &mut outputs);
        let mut output_gradients = random_lines(layer.outputs);
        output_gradients.resize(layer.padded_outputs(), CacheLine([0.0; LANES]));
        layer.backward::<S>(&output_gradients, None, &mut gradients);
        outputs.truncate(layer.outputs);
        gradients.truncate(layer.inputs);
        [outputs, gradients].map(|lines| lines.into_iter().map(|line| line.0).collect())
    }

    /// Sizes of layers, as (inputs, outputs): with and without panels and inputs left over beside wide groups.
    const SIZES: [(usize, usize); 5] = [(1, 1), (5, 3), (16, 16), (37, 48), (64, 67)];

    #[test]
    fn layers_match_sums_in_f64() {
        for (inputs, outputs) in SIZES {
            let layer = layer(inputs, outputs);
            let [found, gradients] = outputs_and_gradients::<Portable>(&layer);
            let (x, by_y) = (random_lines(inputs), random_lines(outputs));
            let weight = |o: usize, i: usize| f64::from(layer.weight[o / PANEL * inputs + i][o % PANEL]);
            for lane in 0..LANES {
                let value = |lines: &[CacheLine], k: usize| f64::from(lines[k].0[lane]);
                for (o, found) in found.iter().enumerate() {
                    let sum: f64 = (0..inputs).map(|i| weight(o, i) * value(&x, i)).sum();
                    let expected = (sum + f64::from(layer.bias[o / PANEL][o % PANEL])).max(0.0);
                    assert!((f64::from(found[lane]) - expected).abs() < 1e-5, "{inputs}, {outputs}: output {o}");
                }
                for (i, gradient) in gradients.iter().enumerate() {
                    let expected: f64 = (0..outputs).map(|o| weight(o, i) * value(&by_y, o)).sum();
                    assert!((f64::from(gradient[lane]) - expected).abs() < 1e-5, "{inputs}, {outputs}: input {i}");
                }
            }
        }
    }

    #[cfg(target_arch = "x86_64")]
    #[test]
    #[ignore = "needs AVX-512"]
    fn avx512_gives_the_bits_of_avx2() {
        use super::super::instruction_set::{Avx2, Avx512};
        assert!(splat_core::has_avx512(), "this processor has no AVX-512");
        for (inputs, outputs) in SIZES {
            let layer = layer(inputs, outputs);
            assert_eq!(outputs_and_gradients::<Avx512>(&layer), outputs_and_gradients::<Avx2>(&layer));
        }
    }
}
