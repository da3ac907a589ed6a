//! Derivative of the attributes at one frame (the frame state) with respect to the stored attributes.

use super::{AttributeValues, Attributes, Gaussians, Gradients};

/// Derivatives ∂state/∂stored of N Gaussians at one frame. "State" means the attributes at this frame, "stored" the
/// attributes in the model file. Each attribute of the state depends only on the stored values of the same attribute.
///
/// The derivative of an attribute of w components has one of three forms, by its number of planes:
///
/// - no planes: the identity; state and stored values change by the same amount;
/// - one plane: each Gaussian has one factor for all components;
/// - w² planes: plane `i·w + j` is ∂ state component i / ∂ stored component j.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Jacobian {
    columns: [AttributeValues; 5],
}

/// Returns the index of a single attribute in the order of [`Attributes::all`].
fn attribute_index(column: Attributes) -> usize {
    column.bits().trailing_zeros() as usize
}

impl Jacobian {
    /// Maximum number of bytes per Gaussian that a [`Jacobian`] takes, in f32: 3×3 values for the position, 4×4 for the
    /// rotation, and one factor for each of the three other attributes.
    pub const BYTES_PER_GAUSSIAN: usize = 4 * (9 + 16 + 3);

    /// Returns the derivative of the single attribute `which` at the frame with respect to its stored values. The
    /// derivative has no planes (width 0) if it is the identity.
    pub fn derivative(&self, which: Attributes) -> &AttributeValues {
        &self.columns[attribute_index(which)]
    }

    /// Returns the derivative of the single attribute `which` at the frame with respect to its stored values, for
    /// writing.
    pub fn derivative_mut(&mut self, which: Attributes) -> &mut AttributeValues {
        &mut self.columns[attribute_index(which)]
    }

    /// Returns the derivative of each attribute at the frame with respect to its stored values, in the order of
    /// [`Attributes::all`].
    pub fn derivatives(&self) -> &[AttributeValues; 5] {
        &self.columns
    }

    /// Returns the derivative of each attribute at the frame with respect to its stored values, for writing, in the
    /// order of [`Attributes::all`].
    pub fn derivatives_mut(&mut self) -> &mut [AttributeValues; 5] {
        &mut self.columns
    }

    /// Returns a copy of the derivatives of the Gaussians with the indices `rows`, in the order of `rows`.
    pub fn pick(&self, rows: &[u32]) -> Jacobian {
        let picked =
            |column: &AttributeValues| if column.width() > 0 { column.pick(rows) } else { AttributeValues::default() };
        Jacobian { columns: self.columns.each_ref().map(picked) }
    }

    /// Concatenates the derivatives of consecutive `blocks` of Gaussians, `len` Gaussians in total. The derivative of
    /// an attribute must have the same form (identity, one factor or a matrix per Gaussian) in all blocks.
    pub fn joined(blocks: &[Jacobian], len: usize) -> Jacobian {
        let mut whole = Jacobian::default();
        for (index, to) in whole.columns.iter_mut().enumerate() {
            let width = blocks.first().map_or(0, |block| block.columns[index].width());
            if width == 0 {
                continue;
            }
            *to = AttributeValues::zeros(width, len);
            for c in 0..width {
                let mut rest = to.plane_mut(c);
                for part in blocks.iter().map(|block| &block.columns[index]) {
                    let (here, after) = rest.split_at_mut(part.len());
                    here.copy_from_slice(part.plane(c));
                    rest = after;
                }
            }
        }
        whole
    }

    /// Adds ∂state/∂stored · `change` to the attributes `attributes` of `state`. `change` is the change of the stored
    /// attributes, `state` holds the attributes at the frame, and the added product is their change to first order.
    ///
    /// Skips attributes for which `change` is empty. If `change` has a lower SH degree than `state`, the higher SH
    /// coefficients stay unchanged.
    pub fn add_to(&self, change: &Gaussians, attributes: Attributes, state: &mut Gaussians) {
        for which in attributes.iter() {
            let (factors, delta, to) =
                (self.derivative(which), change.attribute_values(which), state.attribute_values_mut(which));
            if delta.is_empty() {
                continue;
            }
            let (len, width) = (delta.len(), delta.width().min(to.width()));
            for i in 0..width {
                let to = &mut to.plane_mut(i)[..len];
                match factors.width() {
                    0 => to.iter_mut().zip(delta.plane(i)).for_each(|(to, delta)| *to += delta),
                    1 => {
                        let terms = delta.plane(i).iter().zip(factors.plane(0));
                        to.iter_mut().zip(terms).for_each(|(to, (delta, factor))| *to += factor * delta);
                    }
                    _ => (0..width).for_each(|j| {
                        let terms = delta.plane(j).iter().zip(factors.plane(i * width + j));
                        to.iter_mut().zip(terms).for_each(|(to, (delta, factor))| *to += factor * delta);
                    }),
                }
            }
        }
    }

    /// Converts `gradients` in place by the chain rule: from derivatives of a loss with respect to the attributes at
    /// the frame to derivatives with respect to the stored attributes. Results that are not finite become 0.
    pub fn pull_back(&self, gradients: &mut Gradients) {
        for which in gradients.attributes().iter() {
            let (factors, gradient) = (self.derivative(which), gradients.derivatives_mut(which));
            let finite = |x: f32| if x.is_finite() { x } else { 0.0 };
            match (factors.width(), gradient.width()) {
                (0, _) => (),
                (1, width) => (0..width).for_each(|c| {
                    let sums = gradient.plane_mut(c).iter_mut().zip(factors.plane(0));
                    sums.for_each(|(sum, factor)| *sum = finite(*sum * factor));
                }),
                (_, width) => {
                    let by_state = gradient.clone();
                    for j in 0..width {
                        let to = gradient.plane_mut(j);
                        to.fill(0.0);
                        for i in 0..width {
                            let terms = by_state.plane(i).iter().zip(factors.plane(i * width + j));
                            to.iter_mut().zip(terms).for_each(|(to, (sum, factor))| *to += factor * sum);
                        }
                        to.iter_mut().for_each(|x| *x = finite(*x));
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fills `column` with noise: a low-discrepancy sequence in [−0.5, 0.5) in which each term exceeds the previous one
    /// by `step` (modulo 1).
    fn fill_with_noise(column: &mut AttributeValues, step: f32) {
        column.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k as f32 * step).fract() - 0.5);
    }

    fn noisy_gaussians(len: usize, step: f32) -> Gaussians {
        let mut filled = Gaussians::zeros(len, 1);
        filled.selected_attribute_values_mut(Attributes::all()).for_each(|column| fill_with_noise(column, step));
        filled
    }

    /// Returns a Jacobian of `len` Gaussians: full matrices for position and rotation, one factor for opacity, and the
    /// identity for the other attributes.
    fn jacobian(len: usize) -> Jacobian {
        let mut filled = Jacobian::default();
        for (which, width) in [(Attributes::POSITION, 9), (Attributes::ROTATION, 16), (Attributes::OPACITY, 1)] {
            *filled.derivative_mut(which) = AttributeValues::zeros(width, len);
            fill_with_noise(filled.derivative_mut(which), 0.618_034);
        }
        filled
    }

    #[test]
    fn pull_back_is_the_adjoint_of_add_to() {
        let (jacobian, change) = (jacobian(11), noisy_gaussians(11, 0.754_878));
        let mut state = Gaussians::zeros(11, 1);
        jacobian.add_to(&change, Attributes::all(), &mut state);
        let mut gradients = Gradients::new(11, Attributes::all(), 1);
        Attributes::all().iter().for_each(|which| fill_with_noise(gradients.derivatives_mut(which), 0.569_84));
        let dot = |a: &AttributeValues, b: &AttributeValues| -> f64 {
            a.planes().iter().zip(b.planes()).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
        };
        let expected =
            Attributes::all().iter().map(|which| dot(gradients.derivatives(which), state.attribute_values(which)));
        let expected: Vec<f64> = expected.collect();
        jacobian.pull_back(&mut gradients);
        for (which, expected) in Attributes::all().iter().zip(expected) {
            let got = dot(gradients.derivatives(which), change.attribute_values(which));
            assert!((got - expected).abs() < 1e-5, "{}: got {got}, expected {expected}", which.name());
        }
    }

    #[test]
    fn add_to_changes_only_the_given_attributes_and_degrees() {
        let (mut change, mut state) = (Gaussians::zeros(0, 0), noisy_gaussians(5, 0.3));
        change.sh = AttributeValues::from_planes(3, vec![1.0; 15]);
        let before = state.clone();
        jacobian(5).add_to(&change, Attributes::all(), &mut state);
        assert_eq!(state.sh.plane(2)[4], before.sh.plane(2)[4] + 1.0);
        assert_eq!(state.sh.plane(3), before.sh.plane(3));
        assert_eq!((state.position, state.opacity_logit), (before.position, before.opacity_logit));
    }

    #[test]
    fn pulled_back_values_that_are_not_finite_become_zero() {
        let mut jacobian = jacobian(2);
        jacobian.derivative_mut(Attributes::POSITION).planes_mut()[0] = f32::MAX;
        jacobian.derivative_mut(Attributes::OPACITY).planes_mut()[0] = f32::MAX;
        let mut gradients = Gradients::new(2, Attributes::all(), 0);
        Attributes::all().iter().for_each(|which| gradients.derivatives_mut(which).planes_mut().fill(3.0));
        jacobian.pull_back(&mut gradients);
        assert_eq!(gradients.derivatives(Attributes::POSITION).plane(0)[0], 0.0);
        assert_eq!(gradients.derivatives(Attributes::OPACITY).plane(0)[0], 0.0);
        assert_ne!(gradients.derivatives(Attributes::OPACITY).plane(0)[1], 0.0);
    }
}
