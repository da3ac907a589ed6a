//! Fully connected layers over row-major blocks.
//!
//! Weights are packed once, on loading, into panels of `P` outputs; `R` rows at a time are multiplied by a panel
//! while their sums stay in registers (R·P/8 of the sixteen that AVX2 has). A library that packs its operands in
//! every call spends a seventh of its time on that with matrices as small as these.

use crate::error::Result;

use super::tensors::Lookup;

/// A layer whose outputs the next layer reads.
pub(super) type Hidden = Linear<6, 16>;
/// The last layer of a head: few outputs, so that wide panels would be mostly padding.
pub(super) type Output = Linear<12, 8>;

/// `y = x·Wᵀ + b`.
#[derive(Debug, Clone)]
pub(super) struct Linear<const R: usize, const P: usize> {
    /// `[panels, inputs, P]`, zero beyond the last output.
    weight: Vec<[f32; P]>,
    /// `[panels, P]`
    bias: Vec<[f32; P]>,
    inputs: usize,
    pub(super) outputs: usize,
}

/// Rows of `width` inputs each, `stride` apart.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rows<'a> {
    pub(super) values: &'a [f32],
    pub(super) stride: usize,
}

impl<const R: usize, const P: usize> Linear<R, P> {
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
        let panels = outputs.div_ceil(P);
        let mut layer =
            Linear { weight: vec![[0.0; P]; panels * inputs], bias: vec![[0.0; P]; panels], inputs, outputs };
        for (o, row) in weight.data.chunks_exact(inputs).enumerate() {
            let (panel, lane) = (o / P, o % P);
            layer.bias[panel][lane] = bias.data[o];
            for (packed, &value) in layer.weight[panel * inputs..].iter_mut().zip(row) {
                packed[lane] = value;
            }
        }
        Ok(layer)
    }

    /// ReLU(y) of every row of `input` into `out`; gives its rows, padded to whole panels. NaN stays NaN, as it
    /// would not through `f32::max`.
    #[inline(always)]
    pub(super) fn activate<'a, const FMA: bool>(&self, input: Rows<'_>, out: &'a mut Vec<f32>) -> Rows<'a> {
        let stride = self.bias.len() * P;
        out.resize(input.len() * stride, 0.0);
        self.multiply::<FMA>(input, |row, first, tile| {
            for (r, sums) in tile.iter().enumerate() {
                let to = &mut out[(row + r) * stride + first..][..P];
                for (to, &sum) in to.iter_mut().zip(sums) {
                    *to = if sum < 0.0 { 0.0 } else { sum };
                }
            }
        });
        Rows { values: out, stride }
    }

    /// Output o of every row of `input` into `planes[o·len + start ..]`.
    #[inline(always)]
    pub(super) fn write<const FMA: bool>(&self, input: Rows<'_>, planes: &mut [f32], len: usize, start: usize) {
        self.multiply::<FMA>(input, |row, first, tile| {
            for lane in 0..P.min(self.outputs - first) {
                let to = &mut planes[(first + lane) * len + start + row..][..tile.len()];
                for (to, sums) in to.iter_mut().zip(tile) {
                    *to = sums[lane];
                }
            }
        });
    }

    /// Calls `store(first row, first output, y)` for every few rows and panel. Every y starts from its bias and adds the inputs
    /// in their order, so a row's result does not depend on the rows beside it.
    #[inline(always)]
    fn multiply<const FMA: bool>(&self, input: Rows<'_>, mut store: impl FnMut(usize, usize, &[[f32; P]])) {
        let rows = input.len();
        let whole = rows - rows % R;
        for (panel, (weight, bias)) in self.weight.chunks_exact(self.inputs).zip(&self.bias).enumerate() {
            for row in (0..whole).step_by(R) {
                store(row, panel * P, &tile::<R, P, FMA>(input, row, weight, bias));
            }
            for row in whole..rows {
                store(row, panel * P, &tile::<1, P, FMA>(input, row, weight, bias));
            }
        }
    }
}

impl Rows<'_> {
    fn len(&self) -> usize {
        self.values.len() / self.stride
    }
}

/// `R` rows of `input` from `row` on times one panel. Fused multiply-adds only where the processor has them: elsewhere
/// each would be a call.
#[inline(always)]
fn tile<const R: usize, const P: usize, const FMA: bool>(
    input: Rows<'_>,
    row: usize,
    weight: &[[f32; P]],
    bias: &[f32; P],
) -> [[f32; P]; R] {
    let inputs = weight.len();
    // A loop, for `from_fn` stays a call here, and with it the lengths and their checks stay unknown.
    let mut rows = [&input.values[..inputs]; R];
    for (r, values) in rows.iter_mut().enumerate() {
        *values = &input.values[(row + r) * input.stride..][..inputs];
    }
    let mut sums = [*bias; R];
    for k in 0..inputs {
        let weight = weight[k];
        for r in 0..R {
            let x = rows[r][k];
            for p in 0..P {
                sums[r][p] = if FMA { x.mul_add(weight[p], sums[r][p]) } else { x * weight[p] + sums[r][p] };
            }
        }
    }
    sums
}
