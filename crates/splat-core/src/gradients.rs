//! Derivatives of a number by what is stored of Gaussians.

use std::ops::Range;

use super::{Column, Columns, Gaussians};

/// ∂L/∂ value for values of N Gaussians in stored encoding: sums in f32, in the layout of [`Gaussians`].
///
/// Which columns are differentiated is a choice, and the harmonics may be of a lower degree than the Gaussians': the
/// rest takes neither memory nor time. Memory: 4 bytes per value that is differentiated.
#[derive(Debug, Clone, PartialEq)]
pub struct Gradients {
    len: usize,
    columns: Columns,
    /// Without rows in columns that are not differentiated.
    sums: Gaussians,
}

impl Gradients {
    /// Zeros for `columns` of `len` Gaussians, with harmonics up to `sh_degree`.
    pub fn new(len: usize, columns: Columns, sh_degree: usize) -> Self {
        let mut sums = Gaussians::zeros(0, sh_degree);
        sums.columns_mut(columns).for_each(|column| column.resize(len));
        Gradients { len, columns, sums }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Columns that are differentiated.
    pub fn columns(&self) -> Columns {
        self.columns
    }

    /// The sums of a single column; without rows if it is not differentiated.
    ///
    /// # Panics
    /// If `which` is not exactly one column.
    pub fn column(&self, which: Columns) -> &Column {
        self.sums.column(which)
    }

    /// The sums of a single column, to write.
    ///
    /// # Panics
    /// If `which` is not exactly one column.
    pub fn column_mut(&mut self, which: Columns) -> &mut Column {
        self.sums.column_mut(which)
    }

    /// Makes every sum 0.
    pub fn clear(&mut self) {
        self.sums.columns_mut(self.columns).for_each(|column| column.planes_mut().fill(0.0));
    }

    /// Makes the sums of the Gaussians `rows` those of `of`, in that order.
    ///
    /// # Panics
    /// If `of` has other columns or another number of Gaussians, or there is no such row.
    pub fn set_rows(&mut self, rows: &[u32], of: &Gradients) {
        for column in self.columns.iter() {
            let (from, to) = (of.column(column), self.sums.column_mut(column));
            for c in 0..to.width() {
                let (from, to) = (from.plane(c), to.plane_mut(c));
                assert_eq!(from.len(), rows.len(), "a row for each");
                rows.iter().zip(from).for_each(|(&row, sum)| to[row as usize] = *sum);
            }
        }
    }

    /// The sums of `len` consecutive Gaussians each, the last fewer: for threads to add to.
    ///
    /// # Panics
    /// If `len` is 0.
    pub fn spans(&mut self, len: usize) -> Vec<GradientSpan<'_>> {
        let ids = (0..self.len).step_by(len).map(|first| first..self.len.min(first + len));
        let mut spans: Vec<GradientSpan<'_>> =
            ids.map(|ids| GradientSpan { ids, columns: self.columns, planes: Default::default() }).collect();
        for (place, column) in self.sums.columns_mut(Columns::all()).enumerate() {
            // No rows, no planes.
            for plane in column.planes_mut().chunks_exact_mut(self.len.max(1)) {
                spans.iter_mut().zip(plane.chunks_mut(len)).for_each(|(span, part)| span.planes[place].push(part));
            }
        }
        spans
    }
}

/// The sums of some consecutive Gaussians.
#[derive(Debug)]
pub struct GradientSpan<'a> {
    ids: Range<usize>,
    columns: Columns,
    /// By column, in the order of [`Columns::all`]; none of those that are not differentiated.
    planes: [Vec<&'a mut [f32]>; 5],
}

impl<'a> GradientSpan<'a> {
    /// Whose sums they are.
    pub fn ids(&self) -> Range<usize> {
        self.ids.clone()
    }

    /// Columns that are differentiated.
    pub fn columns(&self) -> Columns {
        self.columns
    }

    /// The sums of a single column, a plane per component; none if it is not differentiated.
    pub fn planes(&mut self, column: Columns) -> &mut [&'a mut [f32]] {
        &mut self.planes[column.bits().trailing_zeros() as usize]
    }

    /// Adds `parts` to the sums of a component of a single column, of Gaussian `first` and those after it, if that
    /// column and component are differentiated. A part that is not finite, or that f32 could not hold the sum with, is
    /// left out, and so are parts for Gaussians beyond the span.
    ///
    /// # Panics
    /// If `first` lies before the span, or more than one beyond it.
    #[inline(always)]
    pub fn add(&mut self, column: Columns, component: usize, first: usize, parts: impl IntoIterator<Item = f32>) {
        let start = first - self.ids.start;
        let Some(plane) = self.planes(column).get_mut(component) else { return };
        for (sum, part) in plane[start..].iter_mut().zip(parts) {
            // Added either way: a store that depends on a condition is slow.
            *sum += if (*sum + part).is_finite() { part } else { 0.0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_cover_every_sum_once_and_leave_frozen_columns_out() {
        let columns = Columns::POSITION | Columns::SH;
        for (len, span) in [(0, 3), (1, 3), (7, 3), (6, 3), (5, 100)] {
            let mut gradients = Gradients::new(len, columns, 1);
            for mut span in gradients.spans(span) {
                let ids = span.ids();
                for c in 0..48 {
                    for column in [Columns::POSITION, Columns::ROTATION, Columns::SH] {
                        span.add(column, c, ids.start, vec![c as f32; ids.len()]);
                    }
                }
            }
            assert!(gradients.column(Columns::ROTATION).is_empty());
            for id in 0..len {
                assert_eq!(gradients.column(Columns::POSITION).row(id), [0.0, 1.0, 2.0]);
                assert_eq!(gradients.column(Columns::SH).row::<12>(id), std::array::from_fn(|c| c as f32));
            }
        }
    }

    #[test]
    fn what_f32_cannot_hold_is_left_out() {
        let mut gradients = Gradients::new(1, Columns::OPACITY, 0);
        for part in [3e38, f32::NAN, 3e38, f32::NEG_INFINITY, -1e38] {
            gradients.spans(1)[0].add(Columns::OPACITY, 0, 0, [part]);
        }
        assert_eq!(gradients.column(Columns::OPACITY).plane(0), [3e38f32 - 1e38]);
    }
}
