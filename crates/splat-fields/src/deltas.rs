//! Combination of stored attributes (raw values) with the deltas and masks that a deformation field computes: state =
//! raw·mask + delta. Also computes the inverse and the derivative of this formula.

use splat_core::{AttributeValues, Attributes, Gaussians, Jacobian};

/// Deltas and masks that a deformation field computed for a block of Gaussians at one time.
///
/// The state (the attributes at that time) of an active attribute is raw·mask + delta, where raw is the stored value.
/// The rotation is never masked: its state is raw + delta or, if the field multiplies rotations, the normalized product
/// raw ⊗ delta. The state of an inactive attribute is raw, without a mask.
#[derive(Debug, Clone, PartialEq)]
pub struct Deltas {
    /// Deltas in the encoding of the stored attributes. Only the deltas of the `active` attributes are valid.
    pub delta: Gaussians,
    /// Mask (factor on the stored attributes) of each Gaussian; `None` if every mask is 1.
    pub mask: Option<Vec<f32>>,
    /// Attributes that have deltas: those that were requested and that the field changes.
    pub active: Attributes,
    /// Whether the rotation delta multiplies the stored quaternion instead of being added.
    pub multiply_rotation: bool,
}

impl Deltas {
    /// Creates empty deltas (of 0 Gaussians) of SH degree `sh_degree`, to be filled by
    /// [`Field::deltas`](super::Field::deltas).
    pub fn new(sh_degree: usize) -> Self {
        Deltas {
            delta: Gaussians::zeros(0, sh_degree),
            mask: None,
            active: Attributes::empty(),
            multiply_rotation: false,
        }
    }

    /// Prepares these deltas for writing: resizes the deltas of the `active` attributes to `rows` Gaussians, and sets
    /// the fields [`Deltas::active`] and [`Deltas::multiply_rotation`] to the arguments.
    pub(super) fn begin(&mut self, rows: usize, active: Attributes, multiply_rotation: bool) {
        for column in active.iter() {
            self.delta.attribute_values_mut(column).resize(rows);
        }
        self.active = active;
        self.multiply_rotation = multiply_rotation;
    }

    /// Applies the deltas and masks (factors on the stored attributes of each Gaussian) to the stored attributes `raw`
    /// and writes the result to `state`, for the attributes `want` only. Resizes these attributes of `state`.
    pub fn apply(&self, raw: &Gaussians, want: Attributes, state: &mut Gaussians) {
        for column in want.iter() {
            let from = raw.attribute_values(column);
            let to = state.attribute_values_mut(column);
            to.resize(from.len());
            if !self.active.contains(column) {
                to.planes_mut().copy_from_slice(from.planes());
            } else if column == Attributes::ROTATION && self.multiply_rotation {
                for i in 0..from.len() {
                    to.set_row(i, unit(product(from.row(i), self.delta.rotation.row(i))));
                }
            } else {
                let mask = self.mask.as_deref().filter(|_| column != Attributes::ROTATION);
                let delta = self.delta.attribute_values(column);
                for c in 0..from.width() {
                    let planes = to.plane_mut(c).iter_mut().zip(from.plane(c)).zip(delta.plane(c));
                    match mask {
                        None => planes.for_each(|((to, raw), delta)| *to = raw + delta),
                        Some(mask) => planes.zip(mask).for_each(|(((to, raw), delta), m)| *to = raw * m + delta),
                    }
                }
            }
        }
    }

    /// Computes into `out` the derivative ∂state/∂raw of [`Deltas::apply`]: raw are the stored attributes, and the
    /// state is its result. Deltas and masks (factors on the stored attributes) are held constant.
    ///
    /// Attributes whose derivative is the identity are not written: in an empty `out`, an attribute without values
    /// means the identity. Values that are not finite become 0. `rotation` holds the stored quaternions.
    pub(super) fn jacobian(&self, rotation: &AttributeValues, out: &mut Jacobian) {
        for column in self.active.iter() {
            if column == Attributes::ROTATION && self.multiply_rotation {
                *out.derivative_mut(column) = AttributeValues::zeros(16, rotation.len());
                for i in 0..rotation.len() {
                    let (raw, delta) = (rotation.row(i), self.delta.rotation.row(i));
                    for component in 0..4 {
                        let by_state = std::array::from_fn(|c| f32::from(u8::from(c == component)));
                        let by_raw = unit_product_gradient(raw, delta, by_state);
                        for (c, derivative) in by_raw.into_iter().enumerate() {
                            out.derivative_mut(column).plane_mut(4 * component + c)[i] = finite(derivative);
                        }
                    }
                }
            } else if let Some(mask) = self.mask.as_ref().filter(|_| column != Attributes::ROTATION) {
                *out.derivative_mut(column) =
                    AttributeValues::from_planes(1, mask.iter().copied().map(finite).collect());
            }
        }
    }

    /// Computes into `raw` the stored attributes that these deltas and masks (factors on stored attributes) turn into
    /// `state`, for the attributes `want`. This is the inverse of [`Deltas::apply`].
    ///
    /// The result is exact up to rounding, except for the length of quaternions. If a mask or a rotation delta is zero,
    /// no stored value leads to `state`, and the result is not finite.
    pub fn invert(&self, state: &Gaussians, want: Attributes, raw: &mut Gaussians) {
        for column in want.iter() {
            let from = state.attribute_values(column);
            let to = raw.attribute_values_mut(column);
            to.resize(from.len());
            if !self.active.contains(column) {
                to.planes_mut().copy_from_slice(from.planes());
            } else if column == Attributes::ROTATION && self.multiply_rotation {
                for i in 0..from.len() {
                    let delta: [f32; 4] = self.delta.rotation.row(i);
                    let square: f32 = delta.iter().map(|x| x * x).sum();
                    let [w, x, y, z] = delta.map(|component| component / square);
                    to.set_row(i, product(from.row(i), [w, -x, -y, -z]));
                }
            } else {
                let mask = self.mask.as_deref().filter(|_| column != Attributes::ROTATION);
                for c in 0..from.width() {
                    let delta = self.delta.attribute_values(column).plane(c);
                    for (i, to) in to.plane_mut(c).iter_mut().enumerate() {
                        *to = (from.plane(c)[i] - delta[i]) / mask.map_or(1.0, |mask| mask[i]);
                    }
                }
            }
        }
    }
}

/// Returns the Hamilton product `a` ⊗ `b` of two quaternions in the order w, x, y, z.
fn product(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// Returns the quaternion `q` scaled to unit length. A zero quaternion stays zero, so that it can still be detected.
fn unit(q: [f32; 4]) -> [f32; 4] {
    let length = q.iter().map(|x| x * x).sum::<f32>().sqrt();
    if length == 0.0 { q } else { q.map(|x| x / length) }
}

/// Returns `x`, or 0 if it is not finite.
pub(super) fn finite(x: f32) -> f32 {
    if x.is_finite() { x } else { 0.0 }
}

/// Computes a derivative through the normalized quaternion product u = `a` ⊗ `b` / ‖`a` ⊗ `b`‖ by the chain rule.
/// `by_unit` is the derivative of some value with respect to u; returns the derivative of this value with respect to
/// `a`. Returns 0 if the product is zero.
fn unit_product_gradient(a: [f32; 4], b: [f32; 4], by_unit: [f32; 4]) -> [f32; 4] {
    let whole = product(a, b);
    let length = whole.iter().map(|x| x * x).sum::<f32>().sqrt();
    if length == 0.0 {
        return [0.0; 4];
    }
    let direction = whole.map(|x| x / length);
    let radial: f32 = direction.iter().zip(by_unit).map(|(x, by)| x * by).sum();
    let by_product = std::array::from_fn(|c| (by_unit[c] - radial * direction[c]) / length);
    let [w, x, y, z] = b;
    product(by_product, [w, -x, -y, -z])
}
