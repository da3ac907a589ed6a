//! Fully connected layers over [`LANES`] Gaussians side by side.
//!
//! Weights are packed once, on loading, into panels of four outputs. The sums of a panel are eight of the sixteen
//! registers that AVX2 has, enough to hide the latency of its multiply-adds; the other operands are one input of all
//! lanes and one weight, so few outputs cost no more than their share. A library that packs its operands in every call
//! spends a seventh of its time on that with matrices as small as these.

use splat_core::error::Result;

use super::tensors::Lookup;

/// Gaussians evaluated side by side.
pub(super) const LANES: usize = 16;
/// One value of each of them: a line of the cache, as a register that spans two is loaded at half the speed.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct CacheLine(pub(super) [f32; LANES]);

/// Outputs whose sums are made together.
const PANEL: usize = 4;

/// `y = W·x + b`.
#[derive(Debug, Clone)]
pub(super) struct Linear {
    /// `[panels, inputs, PANEL]`, zero beyond the last output.
    weight: Vec<[f32; PANEL]>,
    /// `[panels, PANEL]`
    bias: Vec<[f32; PANEL]>,
    inputs: usize,
    pub(super) outputs: usize,
}

impl Linear {
    /// Reads `{name}.weight` `[outputs, inputs]` and `{name}.bias` `[outputs]`; `None` accepts any extent.
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

    /// Outputs in whole panels.
    pub(super) fn padded_outputs(&self) -> usize {
        self.bias.len() * PANEL
    }

    /// Multiplications by weights that a Gaussian takes.
    pub(super) fn multiplications(&self) -> usize {
        self.weight.len() * PANEL
    }

    /// ReLU(y) of `input` `[inputs, LANES]` into `out` `[outputs, LANES]`. NaN stays NaN, as it would not through
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

    /// Derivatives by the inputs into `out`, given those by the outputs, both in whole panels that are 0 beyond the
    /// last; 0 where `kept`, the inputs as ReLU left them, is not positive.
    #[inline(always)]
    pub(super) fn pull<const FMA: bool>(
        &self,
        by_output: &[CacheLine],
        kept: Option<&[CacheLine]>,
        out: &mut Vec<CacheLine>,
    ) {
        out.resize(self.inputs.next_multiple_of(PANEL), CacheLine([0.0; LANES]));
        for (first, out) in (0..self.inputs).step_by(PANEL).zip(out.chunks_exact_mut(PANEL)) {
            let mut sums = [CacheLine([0.0; LANES]); PANEL];
            for (weight, by) in self.weight.chunks_exact(self.inputs).zip(by_output.chunks_exact(PANEL)) {
                for (sum, weight) in sums.iter_mut().zip(&weight[first..]) {
                    for (&w, by) in weight.iter().zip(by) {
                        for (sum, &by) in sum.0.iter_mut().zip(&by.0) {
                            *sum = if FMA { by.mul_add(w, *sum) } else { by * w + *sum };
                        }
                    }
                }
            }
            out.copy_from_slice(&sums);
        }
        for (out, kept) in out.iter_mut().zip(kept.unwrap_or_default()) {
            for (out, &kept) in out.0.iter_mut().zip(&kept.0) {
                *out = if kept > 0.0 { *out } else { 0.0 };
            }
        }
    }

    /// The first `lanes` values of output o into `planes[o·len + start ..]`.
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

/// One panel's outputs. Each sum starts from its bias and adds the inputs in their order, so the result of a Gaussian
/// does not depend on those beside it. Fused multiply-adds only where the processor has them: elsewhere each would be a
/// call.
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
