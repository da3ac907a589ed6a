//! Fully connected layers over [`LANES`] Gaussians side by side.
//!
//! Weights are packed once, on loading, into panels of four outputs. The sums of a panel take eight of the sixteen AVX2
//! registers, enough to hide the latency of the multiply-adds. The other operands are one input of all lanes and one
//! weight, so layers with few outputs are not slower per output. A library that packs its operands in every call spends
//! a seventh of its time on packing matrices as small as these.

use splat_core::error::Result;

use super::tensors::Lookup;

/// Number of Gaussians evaluated side by side.
pub(super) const LANES: usize = 16;
/// One value per lane, aligned to a cache line: loading a register from two lines takes twice the time.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct CacheLine(pub(super) [f32; LANES]);

/// Number of outputs whose sums are computed together.
const PANEL: usize = 4;

/// Fully connected layer `y = W·x + b`.
#[derive(Debug, Clone)]
pub(super) struct Linear {
    /// Weights `[panels, inputs, PANEL]`, zero beyond the last output.
    weight: Vec<[f32; PANEL]>,
    /// Biases `[panels, PANEL]`.
    bias: Vec<[f32; PANEL]>,
    inputs: usize,
    pub(super) outputs: usize,
}

impl Linear {
    /// Reads `{name}.weight` `[outputs, inputs]` and `{name}.bias` `[outputs]`. `None` for `outputs` accepts any
    /// number.
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

    /// Returns the number of outputs, rounded up to whole panels.
    pub(super) fn padded_outputs(&self) -> usize {
        self.bias.len() * PANEL
    }

    /// Returns the number of multiplications by weights per Gaussian.
    pub(super) fn multiplications(&self) -> usize {
        self.weight.len() * PANEL
    }

    /// Computes ReLU(y) of `input` `[inputs, LANES]` into `out` `[outputs, LANES]`. NaN stays NaN, unlike with
    /// `f32::max`.
    #[inline(always)]
    pub(super) fn activate<const FMA: bool>(&self, input: &[CacheLine], out: &mut Vec<CacheLine>) {
        out.resize(self.padded_outputs(), CacheLine([0.0; LANES]));
        let panels = self.weight.chunks_exact(self.inputs).zip(&self.bias);
        for (out, (weight, bias)) in out.chunks_exact_mut(PANEL).zip(panels) {
            let sums = sums::<FMA>(input, weight, bias);
            for (out, y) in out.iter_mut().zip(&sums) {
                for (out, &y) in out.0.iter_mut().zip(&y.0) {
                    *out = if y < 0.0 { 0.0 } else { y };
                }
            }
        }
    }

    /// Computes the derivatives with respect to the inputs into `out`, given those with respect to the outputs.
    ///
    /// Both are in whole panels that are 0 beyond the last value. `activations` are the inputs if ReLU produced them;
    /// the derivative is 0 where they are not positive.
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

    /// Writes the first `lanes` values of output o into `planes[o·len + start ..]`, without ReLU.
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
            let sums = sums::<FMA>(input, weight, bias);
            for (o, y) in (first..self.outputs).zip(&sums) {
                planes[o * len + start..][..lanes].copy_from_slice(&y.0[..lanes]);
            }
        }
    }
}

/// Computes the outputs of one panel. Each sum starts from its bias and adds the inputs in their order, so the result
/// of a Gaussian does not depend on the other lanes. Uses fused multiply-adds only if the processor has them: otherwise
/// each one would be a function call.
#[inline(always)]
fn sums<const FMA: bool>(input: &[CacheLine], weight: &[[f32; PANEL]], bias: &[f32; PANEL]) -> [CacheLine; PANEL] {
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
