//! Colour of Gaussians seen from a point: real spherical harmonics up to degree 3.
//!
//! Data in: SH planes of a block and the camera's centre. Data out: rgb, unclamped above. The basis is
//! the field's (signs of Kerbl et al. 2023; constants as in Sloan, "Stupid Spherical Harmonics Tricks", 2008).

use std::ops::Range;

use super::convention::BLOCK;
use crate::model::{Gaussians, SH_C0, sh_coefficients};

/// Red, green and blue of one block.
pub(super) type Colours = [[f32; BLOCK]; 3];

/// Writes the colours of the Gaussians `ids`, at most [`BLOCK`], seen from `center`: `0.5 + Σ Y_k c_k`
/// clamped at 0 (NaN becomes 0). Coefficients beyond degree 3, or short of a whole degree, are not read.
#[inline(always)]
pub(super) fn evaluate(gaussians: &Gaussians, ids: Range<usize>, center: [f64; 3], out: &mut Colours) {
    let n = ids.len().min(BLOCK);
    let degree = (0..=3).rev().find(|&d| 3 * sh_coefficients(d) <= gaussians.sh.width());
    for channel in out.iter_mut() {
        channel[..n].fill(0.5);
    }
    let Some(degree) = degree else { return };
    let mut basis = [[0.0f32; BLOCK]; sh_coefficients(3)];
    let position: [&[f32]; 3] = std::array::from_fn(|c| &gaussians.position.plane(c)[ids.clone()][..n]);
    for i in 0..n {
        // Differences in f64: far from the origin the direction would otherwise be rounded away.
        let d = [
            f64::from(position[0][i]) - center[0],
            f64::from(position[1][i]) - center[1],
            f64::from(position[2][i]) - center[2],
        ];
        let inverse = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        let (x, y, z) = ((d[0] * inverse) as f32, (d[1] * inverse) as f32, (d[2] * inverse) as f32);
        let (xx, yy, zz) = (x * x, y * y, z * z);
        basis[0][i] = SH_C0 as f32;
        basis[1][i] = -0.488_602_5 * y;
        basis[2][i] = 0.488_602_5 * z;
        basis[3][i] = -0.488_602_5 * x;
        basis[4][i] = 1.092_548_5 * x * y;
        basis[5][i] = -1.092_548_5 * y * z;
        basis[6][i] = 0.315_391_57 * (2.0 * zz - xx - yy);
        basis[7][i] = -1.092_548_5 * x * z;
        basis[8][i] = 0.546_274_2 * (xx - yy);
        basis[9][i] = -0.590_043_6 * y * (3.0 * xx - yy);
        basis[10][i] = 2.890_611_4 * x * y * z;
        basis[11][i] = -0.457_045_8 * y * (4.0 * zz - xx - yy);
        basis[12][i] = 0.373_176_34 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        basis[13][i] = -0.457_045_8 * x * (4.0 * zz - xx - yy);
        basis[14][i] = 1.445_305_7 * z * (xx - yy);
        basis[15][i] = -0.590_043_6 * x * (xx - 3.0 * yy);
    }
    for (k, basis) in basis.iter().enumerate().take(sh_coefficients(degree)) {
        for (channel, sum) in out.iter_mut().enumerate() {
            let plane = &gaussians.sh.plane(3 * k + channel)[ids.clone()][..n];
            for i in 0..n {
                sum[i] += basis[i] * plane[i];
            }
        }
    }
    for channel in out.iter_mut() {
        for value in &mut channel[..n] {
            *value = value.max(0.0);
        }
    }
}
