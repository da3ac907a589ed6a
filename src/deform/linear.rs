//! Fully connected layers over row-major blocks.

use crate::error::Result;

use super::tensors::Lookup;

/// `y = x·Wᵀ + b`, stored with the weight transposed.
#[derive(Debug, Clone)]
pub(super) struct Linear {
    /// `[inputs, outputs]`.
    pub(super) weight: Vec<f32>,
    /// `[outputs]`.
    pub(super) bias: Vec<f32>,
    pub(super) inputs: usize,
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
        let mut transposed = vec![0.0; inputs * outputs];
        for (o, row) in weight.data.chunks_exact(inputs).enumerate() {
            for (i, &value) in row.iter().enumerate() {
                transposed[i * outputs + o] = value;
            }
        }
        Ok(Linear { weight: transposed, bias: bias.data.clone(), inputs, outputs })
    }

    /// Layers that read the same input, side by side as one layer.
    pub(super) fn fuse(layers: &[Linear]) -> Option<Linear> {
        let inputs = layers.first()?.inputs;
        let outputs = layers.iter().map(|layer| layer.outputs).sum();
        let mut weight = Vec::with_capacity(inputs * outputs);
        for i in 0..inputs {
            for layer in layers {
                weight.extend_from_slice(&layer.weight[i * layer.outputs..(i + 1) * layer.outputs]);
            }
        }
        let bias = layers.iter().flat_map(|layer| layer.bias.iter().copied()).collect();
        Some(Linear { weight, bias, inputs, outputs })
    }
}

/// A matrix inside a slice: element (i, j) is at `i·row + j·col`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stride {
    pub(super) row: usize,
    pub(super) col: usize,
}

impl Stride {
    fn reaches(self, rows: usize, cols: usize) -> usize {
        if rows == 0 || cols == 0 { 0 } else { (rows - 1) * self.row + (cols - 1) * self.col + 1 }
    }
}

/// `c = a·b` for `a` `[m, k]`, `b` `[k, n]`, `c` `[m, n]`. Every element of `c` is summed over k in the
/// same order whatever m and n, so a row's result does not depend on the rows beside it.
///
/// # Panics
/// If a matrix does not fit its slice, or elements of `c` would share a place.
pub(super) fn multiply([m, k, n]: [usize; 3], a: (&[f32], Stride), b: (&[f32], Stride), c: (&mut [f32], Stride)) {
    assert!(a.1.reaches(m, k) <= a.0.len() && b.1.reaches(k, n) <= b.0.len() && c.1.reaches(m, n) <= c.0.len());
    let (small, large) = if c.1.row < c.1.col { ((m, c.1.row), c.1.col) } else { ((n, c.1.col), c.1.row) };
    assert!(m <= 1 || n <= 1 || small.1 > 0 && (small.0 - 1) * small.1 < large);
    // SAFETY: the first assertion keeps every element addressed by the extents and strides inside its
    // slice; the second keeps the elements of `c` apart; `c` is borrowed mutably, so neither `a` nor
    // `b` overlaps it. Strides are below isize::MAX, being offsets into slices (or unused when an extent is 1).
    unsafe {
        matrixmultiply::sgemm(
            m,
            k,
            n,
            1.0,
            a.0.as_ptr(),
            a.1.row as isize,
            a.1.col as isize,
            b.0.as_ptr(),
            b.1.row as isize,
            b.1.col as isize,
            0.0,
            c.0.as_mut_ptr(),
            c.1.row as isize,
            c.1.col as isize,
        );
    }
}

/// `x + b`, cut at zero if `relu`, over the rows of a row-major block as wide as `bias`. NaN stays NaN.
pub(super) fn add_bias(rows: &mut [f32], bias: &[f32], relu: bool) {
    for row in rows.chunks_exact_mut(bias.len()) {
        for (x, b) in row.iter_mut().zip(bias) {
            *x += b;
        }
        if relu {
            cut_at_zero(row);
        }
    }
}

/// ReLU that keeps NaN, as `f32::max` would not.
pub(super) fn cut_at_zero(values: &mut [f32]) {
    for x in values {
        *x = if *x < 0.0 { 0.0 } else { *x };
    }
}
