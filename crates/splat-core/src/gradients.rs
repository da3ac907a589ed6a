//! Derivatives of a scalar loss with respect to the stored attributes of Gaussians.

use std::ops::Range;

use super::{AttributeValues, Attributes, Gaussians};

/// Derivatives ∂L/∂value of a loss L with respect to the stored values of N Gaussians, in the layout of [`Gaussians`].
/// Each derivative is a sum in f32, to which callers add terms, for example one for each view.
///
/// The caller chooses the attributes to differentiate; the SH degree may be lower than that of the Gaussians. Values
/// that are not differentiated take neither memory nor time. Memory: 4 bytes per differentiated value.
#[derive(Debug, Clone, PartialEq)]
pub struct Gradients {
    len: usize,
    attributes: Attributes,
    /// Derivatives of the loss, in the layout of [`Gaussians`]. The planes of attributes that are not differentiated
    /// have length 0.
    sums: Gaussians,
}

impl Gradients {
    /// Creates derivatives that are all 0, for the attributes `attributes` of `len` Gaussians, with SH coefficients up
    /// to degree `sh_degree`.
    pub fn new(len: usize, attributes: Attributes, sh_degree: usize) -> Self {
        let mut sums = Gaussians::zeros(0, sh_degree);
        sums.selected_attribute_values_mut(attributes).for_each(|column| column.resize(len));
        Gradients { len, attributes, sums }
    }

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns the attributes that are differentiated.
    pub fn attributes(&self) -> Attributes {
        self.attributes
    }

    /// Returns the derivatives of the loss with respect to the single attribute `which`. Their planes have length 0 if
    /// the attribute is not differentiated.
    ///
    /// # Panics
    /// Panics if `which` is not exactly one attribute.
    pub fn derivatives(&self, which: Attributes) -> &AttributeValues {
        self.sums.attribute_values(which)
    }

    /// Returns the derivatives of the loss with respect to the single attribute `which` for writing.
    ///
    /// # Panics
    /// Panics if `which` is not exactly one attribute.
    pub fn derivatives_mut(&mut self, which: Attributes) -> &mut AttributeValues {
        self.sums.attribute_values_mut(which)
    }

    /// Sets all derivatives to 0.
    pub fn clear(&mut self) {
        self.sums.selected_attribute_values_mut(self.attributes).for_each(|column| column.planes_mut().fill(0.0));
    }

    /// Copies the derivatives of Gaussian k of `source` to Gaussian `rows[k]`, for every k.
    ///
    /// # Panics
    /// Panics if `source` lacks an attribute, if its number of Gaussians is not the length of `rows`, or if an index in
    /// `rows` is out of range.
    pub fn set_rows(&mut self, rows: &[u32], source: &Gradients) {
        for column in self.attributes.iter() {
            let (from, to) = (source.derivatives(column), self.sums.attribute_values_mut(column));
            for c in 0..to.width() {
                let (from, to) = (from.plane(c), to.plane_mut(c));
                assert_eq!(from.len(), rows.len(), "one row per Gaussian of the source expected");
                rows.iter().zip(from).for_each(|(&row, sum)| to[row as usize] = *sum);
            }
        }
    }

    /// Splits the derivatives into spans of `len` consecutive Gaussians, to which different threads can add. The last
    /// span may be shorter.
    ///
    /// # Panics
    /// Panics if `len` is 0.
    pub fn spans(&mut self, len: usize) -> Vec<GradientSpan<'_>> {
        let ids = (0..self.len).step_by(len).map(|first| first..self.len.min(first + len));
        let mut spans: Vec<GradientSpan<'_>> =
            ids.map(|ids| GradientSpan { ids, attributes: self.attributes, planes: Default::default() }).collect();
        for (index, column) in self.sums.selected_attribute_values_mut(Attributes::all()).enumerate() {
            // An attribute that is not differentiated has no values, hence no chunks.
            for plane in column.planes_mut().chunks_exact_mut(self.len.max(1)) {
                spans.iter_mut().zip(plane.chunks_mut(len)).for_each(|(span, part)| span.planes[index].push(part));
            }
        }
        spans
    }
}

/// Part of [`Gradients`] to which one thread adds: the derivatives of the loss with respect to the attributes of
/// consecutive Gaussians.
#[derive(Debug)]
pub struct GradientSpan<'a> {
    ids: Range<usize>,
    attributes: Attributes,
    /// Derivatives of the loss with respect to each attribute, in the order of [`Attributes::all`]: one plane per
    /// component, and no planes for an attribute that is not differentiated.
    planes: [Vec<&'a mut [f32]>; 5],
}

impl<'a> GradientSpan<'a> {
    /// Returns the indices of the Gaussians of this span.
    pub fn ids(&self) -> Range<usize> {
        self.ids.clone()
    }

    /// Returns the attributes that are differentiated.
    pub fn attributes(&self) -> Attributes {
        self.attributes
    }

    /// Returns the derivatives of the loss with respect to the single attribute `column`, one plane per component.
    /// Returns no planes if the attribute is not differentiated.
    pub fn planes(&mut self, column: Attributes) -> &mut [&'a mut [f32]] {
        &mut self.planes[column.bits().trailing_zeros() as usize]
    }

    /// Adds `terms` to the derivatives with respect to component `component` of the single attribute `column`: term k
    /// to the derivative of Gaussian `first` + k.
    ///
    /// - Does nothing if the attribute or the component is not differentiated.
    /// - Skips a term that is not finite, or whose addition would overflow f32.
    /// - Ignores terms for Gaussians beyond the end of the span.
    ///
    /// # Panics
    /// Panics if `first` lies before the span, or more than one index after its last Gaussian.
    #[inline(always)]
    pub fn add(&mut self, column: Attributes, component: usize, first: usize, terms: impl IntoIterator<Item = f32>) {
        let start = first - self.ids.start;
        let Some(plane) = self.planes(column).get_mut(component) else { return };
        for (sum, term) in plane[start..].iter_mut().zip(terms) {
            // Adds 0 instead of skipping the store: a store that depends on a condition is slow.
            *sum += if (*sum + term).is_finite() { term } else { 0.0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_cover_every_differentiated_sum_once() {
        let attributes = Attributes::POSITION | Attributes::SH;
        for (len, span) in [(0, 3), (1, 3), (7, 3), (6, 3), (5, 100)] {
            let mut gradients = Gradients::new(len, attributes, 1);
            for mut span in gradients.spans(span) {
                let ids = span.ids();
                for c in 0..48 {
                    for column in [Attributes::POSITION, Attributes::ROTATION, Attributes::SH] {
                        span.add(column, c, ids.start, vec![c as f32; ids.len()]);
                    }
                }
            }
            assert!(gradients.derivatives(Attributes::ROTATION).is_empty());
            for id in 0..len {
                assert_eq!(gradients.derivatives(Attributes::POSITION).row(id), [0.0, 1.0, 2.0]);
                assert_eq!(gradients.derivatives(Attributes::SH).row::<12>(id), std::array::from_fn(|c| c as f32));
            }
        }
    }

    #[test]
    fn terms_that_overflow_f32_are_skipped() {
        let mut gradients = Gradients::new(1, Attributes::OPACITY, 0);
        for term in [3e38, f32::NAN, 3e38, f32::NEG_INFINITY, -1e38] {
            gradients.spans(1)[0].add(Attributes::OPACITY, 0, 0, [term]);
        }
        assert_eq!(gradients.derivatives(Attributes::OPACITY).plane(0), [3e38f32 - 1e38]);
    }
}
