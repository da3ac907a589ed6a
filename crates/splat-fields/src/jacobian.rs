//! Derivative of the state (the attributes at one time) with respect to the raw parameters (the stored attributes) of a
//! deformation field.
//!
//! state = raw + delta(position, time), so ∂state/∂raw of a position is the identity plus ∂delta/∂position. For each of
//! the three components, ∂delta/∂position is computed by a backward pass through the head (MLP of the position), the
//! trunk (MLP shared by all attributes) and the feature planes. Derivatives through the deltas of other attributes are
//! neglected: they would raise the quality of refined models by less than 0.1 dB, and take most of the time.
//!
//! Input: raw positions and rotations, and the result of [`Field::prepare_with_slopes`] for the positions. Output: a
//! [`Jacobian`]. Memory: the Jacobian, and the values of all layers for one group of [`LANES`] Gaussians. Derived in
//! docs/method.md, section 8.2.

use super::deltas::{Deltas, finite};
use super::field::{
    Field, Head, LayerBuffers, Mask, PreparedInput, PreparedPositions, add_frequencies, position_time_features,
};
use super::instruction_set::{Evaluation, InstructionSet, run_on_best};
use super::linear::{CacheLine, LANES, Linear};
use super::planes::{Planes, PreparedPlanes};
use splat_core::error::{Error, Result};
use splat_core::{AttributeValues, Attributes, Gaussians, Jacobian};

/// Outputs of all layers for one group of Gaussians, and the derivatives that the backward pass computes from them.
#[derive(Default)]
struct JacobianGroup {
    features: Vec<CacheLine>,
    /// Derivatives of the plane features with respect to x, y and z.
    slopes: [Vec<CacheLine>; 3],
    /// Output of every layer of the trunk after ReLU.
    trunk: Vec<Vec<CacheLine>>,
    hidden: Vec<CacheLine>,
    /// Derivatives of one position component with respect to the input of the layer that the backward pass has reached.
    gradient: Vec<CacheLine>,
    spare: Vec<CacheLine>,
}

impl Field {
    /// Computes the derivative ∂state/∂raw at `time`, for the attributes `want` of a block of Gaussians. The state is
    /// the attributes at that time: the stored ones `raw` plus the delta that the field predicts.
    ///
    /// - `raw` must contain positions, and rotations if `want` contains them.
    /// - `prepared` is the result of [`Field::prepare_with_slopes`] for these positions.
    /// - A derivative that is not finite becomes 0. For positions, whose derivative is I + ∂delta/∂position, only
    ///   ∂delta/∂position becomes 0, so I remains.
    ///
    /// If the field has a mask (a factor on the stored attributes, option `static_mlp` or `empty_voxel`), masks and
    /// deltas count as constant. A change of the stored position then changes the position at `time` by the mask times
    /// this change.
    ///
    /// # Errors
    /// Fails if `time` is not finite, or if `prepared` has no slopes although they are needed.
    pub fn jacobian(
        &self,
        raw: &Gaussians,
        prepared: &PreparedPositions,
        time: f64,
        want: Attributes,
    ) -> Result<Jacobian> {
        if !time.is_finite() {
            return Err(Error::internal(format!(
                "time of a deformation field: expected a finite number, found {time}"
            )));
        }
        let want = self.config.deformed_attributes & want;
        let mut found = Jacobian::default();
        if let Mask::None = self.mask {
            let head = self.heads.iter().find(|head| head.column == Some(Attributes::POSITION));
            if let Some(head) = head.filter(|_| want.contains(Attributes::POSITION)) {
                let position = self.position_jacobian(head, &raw.position, prepared, time as f32)?;
                *found.derivative_mut(Attributes::POSITION) = position;
            }
        }
        let held = match self.mask {
            Mask::None if self.config.apply_rotation => want & Attributes::ROTATION,
            Mask::None => Attributes::empty(),
            Mask::Head | Mask::Voxel(_) => want,
        };
        if !held.is_empty() {
            let mut deltas = Deltas::new(raw.sh_degree());
            self.deltas(prepared, time, held, &mut LayerBuffers::default(), &mut deltas)?;
            deltas.jacobian(&raw.rotation, &mut found);
        }
        Ok(found)
    }

    /// Computes the derivative of the positions at `time` with respect to the stored positions `position`. `head` is
    /// the MLP that computes the position deltas. Plane `3·i + j` of the result is ∂ component i / ∂ stored component
    /// j. Fails if `prepared` has no slopes although the field has planes.
    fn position_jacobian(
        &self,
        head: &Head,
        position: &AttributeValues,
        prepared: &PreparedPositions,
        time: f32,
    ) -> Result<AttributeValues> {
        let mut out = AttributeValues::zeros(9, position.len());
        let planes = match (&self.planes, &prepared.input) {
            (None, _) => None,
            (Some(planes), PreparedInput::Planes(block)) if block.has_slopes(planes, position.len()) => {
                Some((planes, block))
            }
            _ => return Err(Error::internal("the block was prepared without slopes, or by another deformation field")),
        };
        run_on_best(PositionJacobian { field: self, head, position, planes, time, out: &mut out });
        Ok(out)
    }
}

/// [`Evaluation`] that computes the result of [`Field::position_jacobian`] into `out`. `planes`: the feature planes
/// with what was prepared for the positions; `None` if the field has no planes.
struct PositionJacobian<'a> {
    field: &'a Field,
    head: &'a Head,
    position: &'a AttributeValues,
    planes: Option<(&'a Planes, &'a PreparedPlanes)>,
    time: f32,
    out: &'a mut AttributeValues,
}

impl Evaluation for PositionJacobian<'_> {
    /// Computes the derivatives in groups of [`LANES`] Gaussians.
    #[inline(always)]
    fn run<S: InstructionSet>(self) {
        let PositionJacobian { field, head, position, planes, time, out } = self;
        let lines = planes.map_or(Vec::new(), |(planes, _)| planes.lines(time));
        let mut group = JacobianGroup::default();
        for start in (0..position.len()).step_by(LANES) {
            let rows = start..position.len().min(start + LANES);
            let positions = [0, 1, 2].map(|axis| &position.plane(axis)[rows.clone()]);
            let JacobianGroup { features, slopes, .. } = &mut group;
            match planes {
                Some((planes, block)) => {
                    planes.features_with_slopes(positions, (block, start), &lines, features, slopes);
                }
                None => position_time_features(positions, time, features),
            }
            if planes.is_some() && field.config.grid_pe > 1 {
                add_frequencies(&mut group.features, field.config.grid_pe as f32);
            }
            group.forward::<S>(field, head);

            for component in 0..3 {
                group.gradient.clear();
                group.gradient.resize(head.output.padded_outputs(), CacheLine([0.0; LANES]));
                group.gradient[component] = CacheLine([1.0; LANES]);
                group.backward::<S>(field, head);
                if planes.is_some() && field.config.grid_pe > 1 {
                    frequencies_backward(&group.features, field.config.grid_pe as f32, &mut group.gradient);
                }
                for axis in 0..3 {
                    let through_delta = match planes {
                        Some(_) => group.axis_derivative(axis),
                        None => group.gradient[axis],
                    };
                    let identity = f32::from(u8::from(component == axis));
                    let out = &mut out.plane_mut(3 * component + axis)[rows.clone()];
                    out.iter_mut().zip(through_delta.0).for_each(|(out, delta)| *out = identity + finite(delta));
                }
            }
        }
    }
}

impl JacobianGroup {
    /// Evaluates the trunk and the hidden layer of `head` for the plane features of the group, and keeps the outputs of
    /// all layers for the backward pass.
    #[inline(always)]
    fn forward<S: InstructionSet>(&mut self, field: &Field, head: &Head) {
        self.trunk.resize(field.trunk.len(), Vec::new());
        let mut input = &self.features;
        for (layer, out) in field.trunk.iter().zip(&mut self.trunk) {
            layer.activate::<S>(input, out);
            input = out;
        }
        head.hidden.activate::<S>(input, &mut self.hidden);
    }

    /// Returns the derivative of a position component with respect to the position along `axis`. By the chain rule,
    /// this is the sum over the plane features of ∂component/∂feature (`gradient`) times ∂feature/∂position (`slopes`).
    #[inline(always)]
    fn axis_derivative(&self, axis: usize) -> CacheLine {
        let mut sums = CacheLine([0.0; LANES]);
        for (gradient, slope) in self.gradient.iter().zip(&self.slopes[axis]) {
            for lane in 0..LANES {
                sums.0[lane] += gradient.0[lane] * slope.0[lane];
            }
        }
        sums
    }

    /// Converts `gradient` from derivatives with respect to the outputs of `head` to derivatives with respect to the
    /// features, by a backward pass through the head (MLP of the position) and the trunk.
    #[inline(always)]
    fn backward<S: InstructionSet>(&mut self, field: &Field, head: &Head) {
        let JacobianGroup { trunk, hidden, gradient, spare, .. } = self;
        let mut step = |layer: &Linear, activations: Option<&[CacheLine]>| {
            layer.backward::<S>(gradient, activations, spare);
            std::mem::swap(gradient, spare);
        };
        step(&head.output, Some(hidden));
        step(&head.hidden, trunk.last().map(Vec::as_slice));
        for (k, layer) in field.trunk.iter().enumerate().rev() {
            step(layer, k.checked_sub(1).map(|before| &trunk[before][..]));
        }
    }
}

/// Converts derivatives with respect to `features` = `[f, sin(p·f), cos(p·f)]` to derivatives with respect to f, which
/// are then in the first third of `gradient`.
fn frequencies_backward(features: &[CacheLine], p: f32, gradient: &mut [CacheLine]) {
    let n = features.len() / 3;
    for c in 0..n {
        for lane in 0..LANES {
            let (sine, cosine) = (features[n + c].0[lane], features[2 * n + c].0[lane]);
            let term = cosine * gradient[n + c].0[lane] - sine * gradient[2 * n + c].0[lane];
            gradient[c].0[lane] += p * term;
        }
    }
}
