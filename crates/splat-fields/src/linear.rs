//! Fully connected layers, evaluated for [`LANES`] Gaussians side by side.
//!
//! On loading, weights are reordered into panels of four outputs each. The sums of a panel (four outputs of [`LANES`]
//! Gaussians) take eight of the sixteen AVX2 registers, enough to hide the latency of the multiply-adds. The lanes of a
//! register belong to different Gaussians, not to different outputs, so layers with few outputs are not slower per
//! output. A matrix library that reorders its operands in every call would spend a seventh of its time on this
//! reordering, because these matrices are small.

use splat_core::error::Result;

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
    pub(super) fn activate<const FMA: bool>(&self, input: &[CacheLine], out: &mut Vec<CacheLine>) {
        out.resize(self.padded_outputs(), CacheLine([0.0; LANES]));
        let panels = self.weight.chunks_exact(self.inputs).zip(&self.bias);
        for (out, (weight, bias)) in out.chunks_exact_mut(PANEL).zip(panels) {
            let sums = panel_outputs::<FMA>(input, weight, bias);
            for (out, y) in out.iter_mut().zip(&sums) {
                for (out, &y) in out.0.iter_mut().zip(&y.0) {
                    *out = if y < 0.0 { 0.0 } else { y };
                }
            }
        }
    }

    /// Computes the backward pass of the layer: converts derivatives of a value with respect to the outputs
    /// (`output_gradient`) to derivatives with respect to the inputs (`out`). Both arrays are padded with zeros to a
    /// multiple of [`PANEL`] entries.
    ///
    /// `activations` holds the inputs of the layer if they come out of a ReLU, and is `None` if not. With it, the
    /// derivative is continued through the ReLU: it becomes 0 for an input that is not positive.
    #[inline(always)]
    pub(super) fn backward<const FMA: bool>(
        &self,
        output_gradient: &[CacheLine],
        activations: Option<&[CacheLine]>,
        out: &mut Vec<CacheLine>,
    ) {
        out.resize(self.inputs.next_multiple_of(PANEL), CacheLine([0.0; LANES]));
        for (first, out) in (0..self.inputs).step_by(PANEL).zip(out.chunks_exact_mut(PANEL)) {
            let mut sums = [CacheLine([0.0; LANES]); PANEL];
            for (weight, gradient) in self.weight.chunks_exact(self.inputs).zip(output_gradient.chunks_exact(PANEL)) {
                for (sum, weight) in sums.iter_mut().zip(&weight[first..]) {
                    for (&w, gradient) in weight.iter().zip(gradient) {
                        for (sum, &gradient) in sum.0.iter_mut().zip(&gradient.0) {
                            *sum = if FMA { gradient.mul_add(w, *sum) } else { gradient * w + *sum };
                        }
                    }
                }
            }
            out.copy_from_slice(&sums);
        }
        for (out, activations) in out.iter_mut().zip(activations.unwrap_or_default()) {
            for (out, &activation) in out.0.iter_mut().zip(&activations.0) {
                *out = if activation > 0.0 { *out } else { 0.0 };
            }
        }
    }

    /// Computes the outputs of the layer for `input`, without ReLU, and writes the outputs of the first `lanes`
    /// Gaussians to `planes`. `planes` holds one plane of `len` values per output. Output o of the first Gaussian is
    /// written to index `o·len + start`, and the outputs o of the next Gaussians follow.
    #[inline(always)]
    pub(super) fn write<const FMA: bool>(
        &self,
        input: &[CacheLine],
        lanes: usize,
        planes: &mut [f32],
        len: usize,
        start: usize,
    ) {
        let panels = self.weight.chunks_exact(self.inputs).zip(&self.bias);
        for (panel, (weight, bias)) in panels.enumerate() {
            let first = panel * PANEL;
            let sums = panel_outputs::<FMA>(input, weight, bias);
            for (o, y) in (first..self.outputs).zip(&sums) {
                planes[o * len + start..][..lanes].copy_from_slice(&y.0[..lanes]);
            }
        }
    }
}

/// Computes the outputs of one panel ([`PANEL`] outputs) of a layer from the `input` of the layer, and the `weight` and
/// `bias` of the panel.
///
/// Each output is the bias plus the products of inputs and weights, added in the order of the inputs. The result for a
/// Gaussian therefore does not depend on the Gaussians beside it. `FMA` selects fused multiply-adds. On a processor
/// without these instructions, each fused multiply-add would be a function call.
#[inline(always)]
fn panel_outputs<const FMA: bool>(
    input: &[CacheLine],
    weight: &[[f32; PANEL]],
    bias: &[f32; PANEL],
) -> [CacheLine; PANEL] {
    let mut sums = bias.map(|b| CacheLine([b; LANES]));
    for (x, weight) in input.iter().zip(weight) {
        for (sums, &w) in sums.iter_mut().zip(weight) {
            for (sum, &x) in sums.0.iter_mut().zip(&x.0) {
                *sum = if FMA { x.mul_add(w, *sum) } else { x * w + *sum };
            }
        }
    }
    sums
}
