//! Opacities and scaled axes of a block of Gaussians at the current frame, computed in f64 from stored attributes. They
//! are kept between frames, so only attributes that changed are computed again.

use std::mem::size_of;
use std::ops::Range;

use crate::model::{self, AnomalyFlags, AttributeValues, Attributes, Gaussians, INFINITE_LOGIT};

/// Largest ln(scale); larger values are clamped to it. A scale of e¹⁰⁰ scene units causes no overflow later, and such a
/// Gaussian already covers every view entirely.
const MAX_LOG_SCALE: f64 = 100.0;

/// Number of Gaussians whose projection is computed together. Each takes about 108 bytes, so after the first view of a
/// frame they are found in the first-level cache.
pub(super) const CHUNK: usize = 256;

/// Opacities, axes (rotation times scales) and flags of a block of Gaussians at the current frame.
pub(super) struct BlockState {
    /// Opacity in [0, 1].
    pub(super) opacity: Vec<f64>,
    /// Matrix R·S (rotation times scales) of each Gaussian: entry (row, axis) is in array 3·row + axis.
    /// [`BlockState::update_axes`] updates it, one chunk of [`CHUNK`] Gaussians at a time, before it is used.
    pub(super) axes: [Vec<f64>; 9],
    /// For each chunk of [`CHUNK`] Gaussians, whether rotations or scales have changed since the axes (rotation times
    /// scales) were computed.
    axes_outdated: Vec<bool>,
    pub(super) flags: Vec<AnomalyFlags>,
    /// Largest finite |coordinate| of the positions so far, scene units.
    pub(super) largest_coordinate: f32,
}

impl BlockState {
    pub(super) const BYTES_PER_GAUSSIAN: usize = 10 * size_of::<f64>() + size_of::<AnomalyFlags>();

    pub(super) fn new(len: usize) -> Self {
        BlockState {
            opacity: vec![0.0; len],
            axes: std::array::from_fn(|_| vec![0.0; len]),
            axes_outdated: vec![false; len.div_ceil(CHUNK)],
            flags: vec![AnomalyFlags::empty(); len],
            largest_coordinate: 0.0,
        }
    }

    /// Updates the block to the next frame, in which its attributes are `gaussians`. Computes and checks only the
    /// attributes `changed`: sets flags for non-finite values and zero quaternions. The axes (rotation times scales)
    /// are needed only for projection, so [`BlockState::update_axes`] computes them later.
    #[inline(always)]
    pub(super) fn update(&mut self, gaussians: &Gaussians, changed: Attributes) {
        for column in changed.iter() {
            let values = gaussians.attribute_values(column);
            let largest = largest_magnitude(values.planes());
            if !largest.is_finite() {
                self.flag_non_finite(values);
            }
            if column == Attributes::OPACITY && (largest.is_nan() || largest >= INFINITE_LOGIT) {
                for (flags, logit) in self.flags.iter_mut().zip(values.plane(0)) {
                    let is_replaced = logit.is_finite() && logit.abs() >= INFINITE_LOGIT;
                    *flags |= if is_replaced { AnomalyFlags::INFINITE_LOGIT } else { AnomalyFlags::empty() };
                }
            }
            if column == Attributes::POSITION {
                let finite = if largest.is_finite() { largest } else { largest_finite(values.planes()) };
                self.largest_coordinate = self.largest_coordinate.max(finite);
            }
        }
        if changed.contains(Attributes::OPACITY) {
            for (opacity, &logit) in self.opacity.iter_mut().zip(gaussians.opacity_logit.plane(0)) {
                *opacity = model::opacity(logit);
            }
        }
        if changed.contains(Attributes::ROTATION) {
            self.flag_zero_rotation(&gaussians.rotation);
        }
        if changed.intersects(Attributes::ROTATION | Attributes::LOG_SCALE) {
            self.axes_outdated.fill(true);
        }
    }

    fn flag_non_finite(&mut self, column: &AttributeValues) {
        for c in 0..column.width() {
            for (flags, x) in self.flags.iter_mut().zip(column.plane(c)) {
                *flags |= if x.is_finite() { AnomalyFlags::empty() } else { AnomalyFlags::NON_FINITE };
            }
        }
    }

    #[inline(always)]
    fn flag_zero_rotation(&mut self, rotation: &AttributeValues) {
        let n = self.flags.len();
        let [w, x, y, z]: [&[f32]; 4] = std::array::from_fn(|c| &rotation.plane(c)[..n]);
        for (i, flags) in self.flags.iter_mut().enumerate() {
            let zero = (w[i] == 0.0) & (x[i] == 0.0) & (y[i] == 0.0) & (z[i] == 0.0);
            *flags |= if zero { AnomalyFlags::ZERO_ROTATION } else { AnomalyFlags::empty() };
        }
    }

    /// Recomputes the axes (rotation times scales) of the Gaussians `chunk` if they are outdated. `gaussians` holds the
    /// attributes at the current frame.
    pub(super) fn update_axes(&mut self, gaussians: &Gaussians, chunk: Range<usize>) {
        if !std::mem::take(&mut self.axes_outdated[chunk.start / CHUNK]) {
            return;
        }
        for i in chunk {
            let mut quaternion = gaussians.rotation_f64(i);
            if quaternion == [0.0; 4] {
                quaternion = [1.0, 0.0, 0.0, 0.0];
            }
            let rotation = rotation_matrix(quaternion);
            let scale = gaussians.log_scale.row::<3>(i).map(|log| f64::from(log).min(MAX_LOG_SCALE).exp());
            for (plane, axes) in self.axes.iter_mut().enumerate() {
                axes[i] = rotation[plane / 3][plane % 3] * scale[plane % 3];
            }
        }
    }

    #[cfg(test)]
    pub(super) fn resident_bytes(&self) -> usize {
        let BlockState { opacity, axes, axes_outdated: _, flags, largest_coordinate: _ } = self;
        size_of_val(&opacity[..])
            + axes.iter().map(|plane| size_of_val(&plane[..])).sum::<usize>()
            + size_of_val(&flags[..])
    }
}

/// Returns the largest |x| of `values`, or a non-finite number if any value is not finite. Compares the bits as
/// integers, many at a time: without the sign, the bits of floats have the order of their values, with infinity and NaN
/// last.
#[inline(always)]
fn largest_magnitude(values: &[f32]) -> f32 {
    f32::from_bits(values.iter().fold(0, |largest, x| largest.max(x.abs().to_bits())))
}

fn largest_finite(values: &[f32]) -> f32 {
    values.iter().filter(|x| x.is_finite()).fold(0.0, |largest, x| largest.max(x.abs()))
}

/// Returns the rows of the rotation matrix of a wxyz quaternion of any length but zero. Dividing by the squared length
/// avoids a square root; f64 holds the square of any f32, subnormals included.
fn rotation_matrix([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    let s = 2.0 / (w * w + x * x + y * y + z * z);
    [
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    ]
}
