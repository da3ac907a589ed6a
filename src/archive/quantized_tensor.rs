//! Codes a tensor as channels of rows of values. Each value is predicted from its neighbors to the left and above.
//!
//! Input: values `[channels, rows, columns]`, and a class for every place (row and column). The class selects the
//! quantization step of the place, or marks the place as never read by the deformation field. Output: symbols, and the
//! values that a decoder restores. Memory: three rows, and one value per place (row and column) if there are several
//! channels.

use super::entropy::{SymbolDecoder, SymbolEncoder};
use super::predict::{PredictorFit, PredictorWeights, expected, factors};
use super::residual::Residuals;
use super::step::QuantizationGrid;

/// Number of neighbors from which a value is predicted: left, above, above left, above right, two to the left, two
/// above.
pub(super) const NEIGHBORS: usize = 6;

/// Class that marks a place (row and column) which the deformation field never reads.
pub(super) const UNREAD: u8 = u8::MAX;

/// Shape of a tensor and the quantization grids of its values.
pub(super) struct QuantizedTensor<'a> {
    pub(super) channels: usize,
    pub(super) rows: usize,
    pub(super) columns: usize,
    /// Range of rows that are stored. Rows before and after it are restored as copies of the nearest stored row.
    pub(super) stored: std::ops::Range<usize>,
    /// Class of every place (row and column), which selects the quantization grid. Either `[rows, columns]`, or
    /// `[columns]` if all rows have the same classes. All channels have the same classes.
    pub(super) classes: &'a [u8],
    /// Function that returns a quantization grid, given the index of a channel and the class of a place (row and
    /// column).
    pub(super) grids: &'a dyn Fn(usize, u8) -> QuantizationGrid,
    /// Number of classes that select a quantization grid. [`UNREAD`] is not counted.
    pub(super) class_count: usize,
    /// Value from which predictions start: the mean of a feature plane; 0 for weights.
    pub(super) mean: f32,
}

/// Known values from which the value at a place (row and column) is predicted.
struct Context {
    /// Values of the neighbors of the place, minus the mean of the tensor.
    values: [f32; NEIGHBORS],
    /// Expected absolute prediction error at the place, in quantization steps. If the tensor has several channels, it
    /// is a weighted mean of the errors at neighboring places and the moving average of the errors at this place in
    /// earlier channels. Otherwise it is the mean of the errors at neighboring places.
    size: f32,
}

impl QuantizedTensor<'_> {
    /// Returns the mean of the values `data` at the places that the deformation field reads.
    pub(super) fn mean(&self, data: &[f32]) -> f64 {
        let (mut sum, mut count) = (0.0, 0usize);
        for plane in data.chunks_exact((self.rows * self.columns).max(1)) {
            for row in self.stored.clone() {
                let values = plane[row * self.columns..].iter().zip(self.row_classes(row));
                for (value, _) in values.filter(|&(_, &class)| class != UNREAD) {
                    sum += f64::from(*value);
                    count += 1;
                }
            }
        }
        sum / count.max(1) as f64
    }

    /// Returns, for each place in row `row`, the class that selects its quantization grid (`TensorEntry::grid`).
    fn row_classes(&self, row: usize) -> &[u8] {
        if self.classes.len() == self.columns {
            self.classes
        } else {
            &self.classes[row * self.columns..][..self.columns]
        }
    }

    /// Rounds the values `data` in place to the quantization grids. Returns the predictor weights (with which a value
    /// is predicted from its neighbors) that give the least squared prediction error for the rounded values.
    pub(super) fn fit(&self, data: &mut [f32]) -> PredictorWeights<NEIGHBORS> {
        let mut fit = PredictorFit::new();
        self.code_data(data, |_, value, context, grid| {
            let value = grid.round(value);
            fit.add(&context.values, value - self.mean);
            (value, 0.0)
        });
        fit.weights()
    }

    /// Encodes the values `data` with the predictor weights `weights` and the entropy models `models`, and writes the
    /// symbols to `encoder`. Replaces `data` by the values that a decoder restores.
    pub(super) fn encode(
        &self,
        weights: &PredictorWeights<NEIGHBORS>,
        models: &mut Residuals,
        data: &mut [f32],
        encoder: &mut SymbolEncoder,
    ) {
        let factors = factors(weights);
        self.code_data(data, |_, value, context, grid| {
            let predicted = grid.predicted(expected(self.mean, &factors, &context.values));
            let multiple = grid.multiple(value);
            let residual = models.encode(multiple, predicted, context.size, encoder);
            (grid.value(multiple), residual.unsigned_abs() as f32)
        });
    }

    /// Decodes values from `decoder` into `data`. `weights` and `models` must equal those with which
    /// [`QuantizedTensor::encode`] was called.
    pub(super) fn decode(
        &self,
        weights: &PredictorWeights<NEIGHBORS>,
        models: &mut Residuals,
        data: &mut [f32],
        decoder: &mut SymbolDecoder<'_>,
    ) {
        let factors = factors(weights);
        self.code_data(data, |_, _, context, grid| {
            let predicted = grid.predicted(expected(self.mean, &factors, &context.values));
            let (multiple, residual) = models.decode(predicted, context.size, decoder);
            (grid.value(multiple), residual.unsigned_abs() as f32)
        });
    }

    /// Codes the tensor and replaces each value of `data` by its decoded value. Visits the channels in order, and the
    /// places (row and column) of a channel row by row. The rows in [`QuantizedTensor::stored`] are the stored rows.
    /// The decoded value depends on the place:
    /// - place in a stored row that the deformation field reads: the value that `code` returns
    /// - place in a stored row that the field never reads ([`UNREAD`]): the mean of the decoded values at four
    ///   neighbors (left, above, above left and above right)
    /// - place in a row that is not stored: the decoded value in the same column of the nearest stored row
    ///
    /// `code` encodes or decodes one value:
    /// - Arguments: index of the place in its channel, old value in `data`, known neighbors, quantization grid.
    /// - Results: restored value, and absolute prediction error in quantization steps. Later places are predicted from
    ///   the restored value. The error is used to estimate the errors of these predictions.
    #[inline(always)]
    fn code_data(&self, data: &mut [f32], mut code: impl FnMut(usize, f32, &Context, QuantizationGrid) -> (f32, f32)) {
        let columns = self.columns;
        // Each line has two extra places at the left and one at the right.
        let line = || vec![0.0f32; columns + 3];
        let (mut above2, mut above, mut here) = (line(), line(), line());
        let (mut sizes_above, mut sizes) = (line(), line());
        // Moving average of the errors at every place over the channels, in quantization steps.
        let mut averages = vec![1.0f32; if self.channels > 1 { self.rows * columns } else { 0 }];
        for (channel, data) in data.chunks_exact_mut((self.rows * columns).max(1)).take(self.channels).enumerate() {
            let grids: Vec<QuantizationGrid> =
                (0..self.class_count).map(|class| (self.grids)(channel, class as u8)).collect();
            [&mut above2, &mut above, &mut sizes_above].into_iter().for_each(|line| line.fill(0.0));
            for row in self.stored.clone() {
                let classes = self.row_classes(row);
                // The two places to the left of the first column get the value above the first column.
                (here[0], here[1]) = (above[2], above[2]);
                (sizes[0], sizes[1]) = (sizes_above[2], sizes_above[2]);
                let out = &mut data[row * columns..][..columns];
                for (column, value) in out.iter_mut().enumerate() {
                    let at = column + 2;
                    let class = classes[column];
                    let [left, up, up_left, up_right] = [here[at - 1], above[at], above[at - 1], above[at + 1]];
                    let near = [sizes[at - 1], sizes_above[at], sizes_above[at - 1], sizes_above[at + 1]];
                    let size = (2.0 * (near[0] + near[1]) + near[2] + near[3]) * (1.0 / 6.0);
                    let Some(&grid) = grids.get(usize::from(class)) else {
                        here[at] = (left + up + up_left + up_right) * 0.25;
                        sizes[at] = size;
                        *value = here[at] + self.mean;
                        continue;
                    };
                    let values = [left, up, up_left, up_right, here[at - 2], above2[at]];
                    let (place, nearby) = (row * columns + column, grid.in_steps(size));
                    let size = averages.get(place).map_or(nearby, |average| 0.25 * nearby + 0.75 * average);
                    let (coded, off) = code(place, *value, &Context { values, size }, grid);
                    *value = coded;
                    here[at] = coded - self.mean;
                    sizes[at] = off * grid.size();
                    if let Some(average) = averages.get_mut(place) {
                        *average = 0.875 * *average + 0.125 * off;
                    }
                }
                // The place to the right of the last column gets the value of the last column.
                (here[columns + 2], sizes[columns + 2]) = (here[columns + 1], sizes[columns + 1]);
                std::mem::swap(&mut above2, &mut above);
                std::mem::swap(&mut above, &mut here);
                std::mem::swap(&mut sizes_above, &mut sizes);
            }
            if let (Some(first), Some(last)) = (self.stored.clone().next(), self.stored.clone().last()) {
                (0..first).for_each(|row| data.copy_within(first * columns..(first + 1) * columns, row * columns));
                (last + 1..self.rows)
                    .for_each(|row| data.copy_within(last * columns..(last + 1) * columns, row * columns));
            }
        }
    }
}
