//! Mask of a deformation field with the option `empty_voxel`: a grid of factors over the box of the scene, interpolated
//! at the stored positions of the Gaussians.

use splat_core::AttributeValues;
use splat_core::error::{Error, Result};

use super::tensors::Lookup;

/// Grid of mask values (factors on stored attributes), of shape `[1, 1, X, Y, Z]`, between two corners in space.
#[derive(Debug, Clone)]
pub(super) struct VoxelMask {
    /// Position of the first grid point of each axis, scene units.
    low: [f32; 3],
    /// Position of the last grid point of each axis, scene units.
    high: [f32; 3],
    size: [usize; 3],
    values: Vec<f32>,
}

impl VoxelMask {
    /// Reads the grid from the tensors `deformation_net.empty_voxel.*`. Only some versions of the trainer save the
    /// corners of the grid. If the file lacks them, the grid gets the corners `corners` = (maximum, minimum) of the box
    /// of the feature planes, because training sets both boxes to the same values.
    pub(super) fn load(lookup: Lookup<'_>, corners: Option<([f32; 3], [f32; 3])>) -> Result<Self> {
        let name = |part: &str| format!("deformation_net.empty_voxel.{part}");
        let grid = lookup.get_shaped(&name("grid"), &[Some(1), Some(1), None, None, None], "empty_voxel=True")?;
        let corner = |part: &str, fallback: Option<[f32; 3]>| match fallback {
            Some(corner) if !lookup.has(&name(part)) => Ok::<_, Error>(corner),
            _ => {
                let tensor = lookup.get_shaped(&name(part), &[Some(3)], "corner of empty_voxel")?;
                Ok([tensor.data[0], tensor.data[1], tensor.data[2]])
            }
        };
        let low = corner("xyz_min", corners.map(|(_, low)| low))?;
        let high = corner("xyz_max", corners.map(|(high, _)| high))?;
        if (0..3).any(|axis| low[axis] == high[axis]) {
            return Err(lookup.mismatch(&name("xyz_max"), "a box of positive size", format!("{low:?} to {high:?}")));
        }
        Ok(VoxelMask { low, high, size: [grid.shape[2], grid.shape[3], grid.shape[4]], values: grid.data.clone() })
    }

    /// Returns the mask (factor on the stored attributes) of every Gaussian at `position` (`[3, N]`), by trilinear
    /// interpolation of the grid. The outermost grid points lie on the faces of the box. Grid points further out count
    /// as 0, so the mask falls to 0 within one grid step outside the box.
    pub(super) fn sample(&self, position: &AttributeValues) -> Vec<f32> {
        (0..position.len()).map(|i| self.sample_one(position.row(i))).collect()
    }

    /// Returns the mask (factor on stored attributes) at position `p`, scene units, by trilinear interpolation of the
    /// grid, whose grid points outside the box count as 0.
    fn sample_one(&self, p: [f32; 3]) -> f32 {
        let at: [f32; 3] = std::array::from_fn(|axis| {
            let u = (p[axis] - self.low[axis]) / (self.high[axis] - self.low[axis]) * 2.0 - 1.0;
            (u + 1.0) / 2.0 * (self.size[axis] - 1) as f32
        });
        let mut sum = 0.0;
        for corner in 0..8 {
            let mut weight = 1.0;
            let mut index = 0;
            for ((axis, &at), &size) in at.iter().enumerate().zip(&self.size) {
                let low = at.floor();
                let (texel, share) =
                    if corner >> axis & 1 == 0 { (low, 1.0 - (at - low)) } else { (low + 1.0, at - low) };
                if texel < 0.0 || texel >= size as f32 {
                    weight = 0.0;
                } else {
                    weight *= share;
                    index = index * size + texel as usize;
                }
            }
            if weight != 0.0 {
                sum += weight * self.values[index];
            }
        }
        sum
    }
}
