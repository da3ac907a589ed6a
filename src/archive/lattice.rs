//! A tensor as channels of rows of values, each expected from those to the left of it and above.
//!
//! In: values `[channels, rows, columns]`, a class for every place of a channel that says how fine it is or that nobody
//! reads it. Out: symbols, and the values as they come back. Memory: three rows.

use super::entropy::{SymbolDecoder, SymbolEncoder};
use super::predict::{PredictorFit, PredictorWeights, expected, factors};
use super::residual::Residuals;
use super::step::QuantizationGrid;

/// Values that others are expected from: left, above, above left, above right, two to the left, two above.
pub(super) const NEIGHBOURS: usize = 6;

/// Class of a place that nobody reads.
pub(super) const UNREAD: u8 = u8::MAX;

/// How a tensor lies on its grids.
pub(super) struct QuantizedTensor<'a> {
    pub(super) channels: usize,
    pub(super) rows: usize,
    pub(super) columns: usize,
    /// Rows that are stored; those before and after repeat the nearest of them.
    pub(super) stored: std::ops::Range<usize>,
    /// Of every place of a stored row, `[rows, columns]`, or of one row for all of them, `[columns]`.
    pub(super) classes: &'a [u8],
    /// Of every class of every channel.
    pub(super) grids: &'a dyn Fn(usize, u8) -> QuantizationGrid,
    /// Number of classes.
    pub(super) class_count: usize,
    /// What values differ from.
    pub(super) mean: f32,
}

/// What lies around a place.
struct Around {
    /// Differences from the mean.
    values: [f32; NEIGHBOURS],
    /// How large differences from what was expected were, in steps of this place.
    size: f32,
}

impl QuantizedTensor<'_> {
    /// Mean of the values that are read.
    pub(super) fn mean(&self, data: &[f32]) -> f64 {
        let (mut sum, mut count) = (0.0, 0usize);
        for plane in data.chunks_exact((self.rows * self.columns).max(1)) {
            for row in self.stored.clone() {
                let values = plane[row * self.columns..].iter().zip(self.classes_of(row));
                for (value, _) in values.filter(|&(_, &class)| class != UNREAD) {
                    sum += f64::from(*value);
                    count += 1;
                }
            }
        }
        sum / count.max(1) as f64
    }

    /// Classes of a row.
    fn classes_of(&self, row: usize) -> &[u8] {
        if self.classes.len() == self.columns {
            self.classes
        } else {
            &self.classes[row * self.columns..][..self.columns]
        }
    }

    /// The parts that expect the values best.
    pub(super) fn fit(&self, data: &mut [f32]) -> PredictorWeights<NEIGHBOURS> {
        let mut fit = PredictorFit::new();
        self.walk(data, |_, value, around, grid| {
            let value = grid.round(value);
            fit.add(&around.values, value - self.mean);
            (value, 0.0)
        });
        fit.parts()
    }

    /// Writes the values; `data` becomes what they come back as.
    pub(super) fn encode(
        &self,
        parts: &PredictorWeights<NEIGHBOURS>,
        models: &mut Residuals,
        data: &mut [f32],
        to: &mut SymbolEncoder,
    ) {
        let factors = factors(parts);
        self.walk(data, |_, value, around, grid| {
            let expected = grid.nearest(f64::from(expected(self.mean, &factors, &around.values)));
            let multiple = grid.multiple(value);
            models.encode(multiple - expected, around.size, to);
            (grid.value(multiple), (multiple - expected).unsigned_abs() as f32 * grid.size())
        });
    }

    /// Reads the values into `data`.
    pub(super) fn decode(
        &self,
        parts: &PredictorWeights<NEIGHBOURS>,
        models: &mut Residuals,
        data: &mut [f32],
        from: &mut SymbolDecoder<'_>,
    ) {
        let factors = factors(parts);
        self.walk(data, |_, _, around, grid| {
            let expected = grid.nearest(f64::from(expected(self.mean, &factors, &around.values)));
            let residual = models.decode(around.size, from);
            let multiple = expected.wrapping_add(residual);
            (grid.value(multiple), residual.unsigned_abs() as f32 * grid.size())
        });
    }

    /// Visits every place that is read, row by row; what `code` makes of the value there and how far that is from what
    /// was expected is what later ones have around them. Places that nobody reads get the mean of those around them.
    #[inline(always)]
    fn walk(&self, data: &mut [f32], mut code: impl FnMut(usize, f32, &Around, QuantizationGrid) -> (f32, f32)) {
        let columns = self.columns;
        // Two more to the left and one to the right.
        let line = || vec![0.0f32; columns + 3];
        let (mut above2, mut above, mut here) = (line(), line(), line());
        let (mut sizes_above, mut sizes) = (line(), line());
        for (channel, data) in data.chunks_exact_mut((self.rows * columns).max(1)).take(self.channels).enumerate() {
            let grids: Vec<QuantizationGrid> =
                (0..self.class_count).map(|class| (self.grids)(channel, class as u8)).collect();
            [&mut above2, &mut above, &mut sizes_above].into_iter().for_each(|line| line.fill(0.0));
            for row in self.stored.clone() {
                let classes = self.classes_of(row);
                // Before the first there is what is above it.
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
                    let around = Around { values, size: grid.in_steps(size) };
                    let (coded, off) = code(row * columns + column, *value, &around, grid);
                    *value = coded;
                    here[at] = coded - self.mean;
                    sizes[at] = off;
                }
                // After the last one there is that.
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
