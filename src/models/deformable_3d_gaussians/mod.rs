//! Deformable-3D-Gaussians as a model format: a network of position and time deforms canonical Gaussians.
//!
//! At time t, the network's output at the canonical position `xyz` gives the state of a Gaussian. Position: xyz + warp,
//! or the screw motion of xyz. Scale: exp(scale) + d_scaling, of which only the square matters. Rotation: rot/|rot| +
//! d_rotation, not normalized again. For a quaternion of length n the rasterizer's formula gives R(q) = (1 − n²)·I +
//! n²·R(q/n), which is not a rotation, so the covariance R(q)·S²·R(q)ᵀ is decomposed here. Opacity and SH coefficients
//! are constant. Source: Yang et al., "Deformable 3D Gaussians for High-Fidelity Monocular Dynamic Scene
//! Reconstruction", 2024, and its public code.

mod screw;

use glam::{DMat3, DVec3};

use super::deform_folder::{DeformFolder, ModelParts, NetworkMotionModel, has_network, needs_network};
use crate::deform::{EncodedPositions, Network, PredictedMotion};
use crate::error::{Error, Result};
use crate::model::{AttributeValues, Attributes, Gaussians, Jacobian, StoredParams, scale_rotation};
use crate::models::motion_model::{MotionModel, copy_stored};
use crate::models::opened::InputFormat;

/// Model format of Deformable-3D-Gaussians: recognizes and opens a model folder. Also recognizes a folder without the
/// network, of this trainer or of SC-GS, so that opening it names the missing folder.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| found.is_folder && (has_network(found.path) || needs_network(found.path)),
    open: |path, options| DeformFolder::open(path, options, &ENTRY, DeformableMotion::new),
};

/// Attributes that are computed from the covariance of a deformed Gaussian: rotation and scales.
const SHAPE: Attributes = Attributes::ROTATION.union(Attributes::LOG_SCALE);

/// Motion model of Deformable-3D-Gaussians.
#[derive(Debug)]
struct DeformableMotion {
    network: Network,
}

impl DeformableMotion {
    /// Creates the motion model from the network. Also returns a note for each key of `cfg_args` that contradicts the
    /// network's weights.
    fn new(parts: &ModelParts<'_>) -> Result<(DeformableMotion, Vec<String>)> {
        if !parts.tensors.contains_key("linear.0.weight") {
            let names: Vec<&str> = parts.tensors.keys().map(String::as_str).take(6).collect();
            let found = if names.is_empty() { "none".to_owned() } else { format!("{}, …", names.join(", ")) };
            return Err(Error::input(parts.file, "", "tensors linear.0.weight and so on", found)
                .hint("only networks of Deformable-3D-Gaussians and SC-GS are supported"));
        }
        let network = Network::new(parts.tensors, "", parts.file)?;
        let mut notes = Vec::new();
        let time = parts.tensors.contains_key("timenet.0.weight");
        for (key, actual) in [("is_blender", time), ("is_6dof", network.predicts_screw_motion())] {
            let configured = parts.arguments.get(key).bool(actual)?;
            if configured != actual {
                let [configured, actual] = [configured, actual].map(|yes| if yes { "True" } else { "False" });
                notes.push(format!(
                    "cfg_args says {key} = {configured}, but the weights in deform.pth belong to {key} = {actual}: \
                     the weights are used"
                ));
            }
        }
        Ok((DeformableMotion { network }, notes))
    }
}

impl DeformableMotion {
    /// Returns the network's outputs at `time` for a block of Gaussians with the encoded canonical positions `encoded`.
    /// Computes only the outputs on which the attributes `want` depend.
    fn motion(&self, time: f64, encoded: &EncodedPositions, want: Attributes) -> Result<PredictedMotion> {
        let mut motion = PredictedMotion::default();
        let shape = if (want & SHAPE).is_empty() { Attributes::empty() } else { SHAPE };
        let want = want & Attributes::POSITION | shape;
        if !want.is_empty() {
            self.network.motion(encoded, time, want, &mut motion)?;
        }
        Ok(motion)
    }
}

impl MotionModel for DeformableMotion {
    type Prepared = EncodedPositions;

    fn prepare(&self, raw: &StoredParams) -> EncodedPositions {
        self.network.encode(&raw.gaussians.position)
    }

    fn varying(&self) -> Attributes {
        Attributes::POSITION | SHAPE
    }

    fn movable(&self) -> Attributes {
        Attributes::all().difference(SHAPE)
    }

    fn state(
        &self,
        time: f64,
        raw: &StoredParams,
        encoded: &EncodedPositions,
        want: Attributes,
        out: &mut Gaussians,
    ) -> Result<()> {
        let raw_state = &raw.gaussians;
        copy_stored(raw, want.difference(self.varying()), out);
        let motion = self.motion(time, encoded, want)?;
        if want.contains(Attributes::POSITION) {
            for row in 0..raw.len() {
                let at = raw_state.position.row::<3>(row);
                let to = match self.network.predicts_screw_motion() {
                    true => {
                        let [x, w, v] = screw(at, motion.warp.row::<6>(row));
                        screw::apply_screw(x, w, v).as_vec3().to_array()
                    }
                    false => {
                        let by = motion.warp.row::<3>(row);
                        [0, 1, 2].map(|c| at[c] + by[c])
                    }
                };
                out.position.set_row(row, to);
            }
        }
        if !(want & SHAPE).is_empty() {
            for row in 0..raw.len() {
                let scales = raw_state.scales_f64(row);
                let rotation = raw_state.rotation_f64(row);
                let by = (motion.scaling.row::<3>(row), motion.rotation.row::<4>(row));
                let (scales, rotation) = scale_rotation(covariance(scales, rotation, by), rotation);
                if want.contains(Attributes::LOG_SCALE) {
                    out.log_scale.set_row(row, scales.map(|scale| scale.ln() as f32));
                }
                if want.contains(Attributes::ROTATION) {
                    out.rotation.set_row(row, rotation.map(|x| x as f32));
                }
            }
        }
        Ok(())
    }

    /// Returns the derivative of the positions at `time` with respect to the stored positions. The derivatives of all
    /// other attributes are left as the identity. Those of rotation and scales are not computed, because the
    /// decomposition of the covariance into rotation and scales is not continuous from frame to frame; the optimizer
    /// does not change these two attributes.
    fn jacobian(
        &self,
        time: f64,
        raw: &StoredParams,
        encoded: &EncodedPositions,
        want: Attributes,
    ) -> Result<Jacobian> {
        let mut found = Jacobian::default();
        if want.contains(Attributes::POSITION) {
            let position = &raw.gaussians.position;
            let slopes = self.network.warp_jacobian(position, time)?;
            let motion = match self.network.predicts_screw_motion() {
                true => self.motion(time, encoded, Attributes::POSITION)?,
                false => PredictedMotion::default(),
            };
            let mut out = AttributeValues::zeros(9, raw.len());
            for row in 0..raw.len() {
                for (axis, unit) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().enumerate() {
                    let along = |first: usize| {
                        DVec3::from([0, 1, 2].map(|c| f64::from(slopes.plane(3 * (first + c) + axis)[row])))
                    };
                    let change = match self.network.predicts_screw_motion() {
                        true => {
                            let [x, w, v] = screw(position.row::<3>(row), motion.warp.row::<6>(row));
                            screw::slope(x, w, v, unit, [along(0), along(3)])
                        }
                        false => unit + along(0),
                    };
                    // If the network's output has no finite derivative, use the identity.
                    let change = if change.is_finite() { change } else { unit };
                    (0..3).for_each(|i| out.plane_mut(3 * i + axis)[row] = change[i] as f32);
                }
            }
            *found.derivative_mut(Attributes::POSITION) = out;
        }
        Ok(found)
    }
}

impl NetworkMotionModel for DeformableMotion {
    const KIND: &'static str = "Deformable-3D-Gaussians model";
    const NORMALIZES_ROTATION: bool = true;

    fn bytes_per_gaussian(&self) -> usize {
        Network::BYTES_PER_GAUSSIAN
    }

    /// Returns the CPU seconds per state (one Gaussian at one frame), measured by `benches/families.rs`, as a function
    /// of the size of the network.
    fn seconds_per_state(&self) -> f64 {
        1e-6 + 2e-11 * self.network.multiplications() as f64
    }
}

/// Returns three vectors of a screw motion: the position `x`, the axis w (first three of the six network outputs), and
/// the translation v (last three outputs).
fn screw(x: [f32; 3], [a, b, c, d, e, f]: [f32; 6]) -> [DVec3; 3] {
    [x, [a, b, c], [d, e, f]].map(|row| DVec3::from(row.map(f64::from)))
}

/// Returns the covariance R(q)·S²·R(q)ᵀ of a deformed Gaussian as xx xy xz yy yz zz. `scales` and `rotation`
/// (quaternion wxyz of any length) are those of the canonical Gaussian. `by` holds the network's outputs that are added
/// to the scales and to the normalized quaternion.
fn covariance(scales: [f64; 3], rotation: [f64; 4], by: ([f32; 3], [f32; 4])) -> [f64; 6] {
    let length = rotation.iter().map(|x| x * x).sum::<f64>().sqrt().max(1e-12);
    let [w, x, y, z] = [0, 1, 2, 3].map(|c| rotation[c] / length + f64::from(by.1[c]));
    let scales = DVec3::from([0, 1, 2].map(|c| scales[c] + f64::from(by.0[c])));
    // The formula for unit quaternions, applied to a quaternion of any length as in the rasterizer.
    let turn = DMat3::from_cols(
        DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        DVec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        DVec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
    let axes = turn * DMat3::from_diagonal(scales);
    let sigma = axes * axes.transpose();
    [sigma.x_axis.x, sigma.x_axis.y, sigma.x_axis.z, sigma.y_axis.y, sigma.y_axis.z, sigma.z_axis.z]
}
