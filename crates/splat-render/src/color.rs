//! View-dependent color of Gaussians by real spherical harmonics (SH) up to degree 3.
//!
//! Input: SH coefficients and positions of a block of Gaussians, and the camera center. Output: red, green and blue, at
//! least 0, without an upper limit. The basis has the signs of Kerbl et al. 2023 and the constants of Sloan, "Stupid
//! Spherical Harmonics Tricks", 2008.

use std::ops::Range;

use rayon::prelude::*;

use super::convention::{BLOCK, has_visible};
use splat_core::{Camera, Gaussians, MAX_SH_DEGREE, SH_C0, sh_coefficient_count, vectorized};

/// Red, green and blue of the Gaussians of one block.
pub(super) type Colors = [[f32; BLOCK]; 3];

/// Colors of all Gaussians of one frame in several views.
///
/// They are computed block by block, for all views. If each render computed its own colors, it would read all SH
/// coefficients (192 bytes per Gaussian with degree 3) from memory again, and reading takes longer than computing.
/// Memory: [`ViewColors::BYTES`] per Gaussian and view.
#[derive(Debug, Default)]
pub struct ViewColors {
    view_count: usize,
    /// Red, green and blue in the layout `[blocks, views, BLOCK]`: for each block of [`BLOCK`] consecutive Gaussians,
    /// their colors in the first view, then in the second view, and so on.
    values: Vec<[f32; 3]>,
}

impl ViewColors {
    /// Bytes of memory per Gaussian and view.
    pub const BYTES: usize = size_of::<[f32; 3]>();

    /// Replaces all colors by those of `gaussians` in the views of `cameras`. Uses all threads of the rayon pool. The
    /// colors of a block without a visible Gaussian are unspecified.
    pub fn fill(&mut self, gaussians: &Gaussians, cameras: &[&Camera]) {
        self.view_count = cameras.len();
        self.values.resize(gaussians.len().div_ceil(BLOCK) * cameras.len() * BLOCK, [0.0; 3]);
        let centers: Vec<[f64; 3]> = cameras.iter().map(|camera| camera.center().to_array()).collect();
        let fill_block = |(k, values): (usize, &mut [[f32; 3]])| {
            let ids = k * BLOCK..gaussians.len().min((k + 1) * BLOCK);
            if !has_visible(gaussians, ids.clone()) {
                return;
            }
            let mut colors: Colors = [[0.0; BLOCK]; 3];
            for (&center, values) in centers.iter().zip(values.chunks_exact_mut(BLOCK)) {
                vectorized(
                    #[inline(always)]
                    || evaluate(gaussians, ids.clone(), center, &mut colors),
                );
                for (i, value) in values.iter_mut().enumerate() {
                    *value = [colors[0][i], colors[1][i], colors[2][i]];
                }
            }
        };
        self.values.par_chunks_mut((cameras.len() * BLOCK).max(1)).enumerate().for_each(fill_block);
    }

    /// Returns the colors in view `view` of the block of Gaussians that begins with the Gaussian `start`, a multiple of
    /// [`BLOCK`].
    ///
    /// # Panics
    /// Panics if there is no view `view`, or if colors were computed for fewer Gaussians.
    pub(super) fn block(&self, view: usize, start: usize) -> &[[f32; 3]] {
        assert!(view < self.view_count, "expected the index of one of {} views, found {view}", self.view_count);
        debug_assert_eq!(start % BLOCK, 0);
        &self.values[(start / BLOCK * self.view_count + view) * BLOCK..][..BLOCK]
    }
}

/// Source of the colors of splats.
#[derive(Debug, Clone, Copy)]
pub(super) enum ColorSource<'a> {
    /// No colors are needed: all splats are black.
    Black,
    /// Colors are computed from the SH coefficients of the Gaussians.
    Coefficients,
    /// Colors have been computed before, for several views. The number is the index of the rendered view among them.
    Computed(&'a ViewColors, usize),
}

/// Computes into `out` the colors of the Gaussians `ids` (at most [`BLOCK`]), seen from the camera position `center`:
/// `0.5 + Σ Y_k c_k` with SH basis functions Y_k and coefficients c_k. Negative values and NaN become 0. SH
/// coefficients above degree 3, or of an incomplete degree, are ignored.
#[inline(always)]
pub(super) fn evaluate(gaussians: &Gaussians, ids: Range<usize>, center: [f64; 3], out: &mut Colors) {
    let n = ids.len().min(BLOCK);
    for channel in out.iter_mut() {
        channel[..n].fill(0.5);
    }
    let mut values = [[0.0f32; BLOCK]; sh_coefficient_count(3)];
    let position: [&[f32]; 3] = std::array::from_fn(|c| &gaussians.position.plane(c)[ids.clone()][..n]);
    for i in 0..n {
        let (direction, _) = direction([position[0][i], position[1][i], position[2][i]], center);
        for (values, value) in values.iter_mut().zip(basis(direction)) {
            values[i] = value;
        }
    }
    let mut filled = [0.0; BLOCK];
    for (k, values) in values.iter().enumerate().take(coefficients(gaussians)) {
        for (channel, sum) in out.iter_mut().enumerate() {
            let plane = &gaussians.sh.plane(3 * k + channel)[ids.clone()][..n];
            // A short block is filled up: the compiler would process the rest of a loop of variable length one by one.
            let plane = match plane.first_chunk::<BLOCK>() {
                Some(plane) => plane,
                None => {
                    filled[..n].copy_from_slice(plane);
                    &filled
                }
            };
            for i in 0..BLOCK {
                sum[i] += values[i] * plane[i];
            }
        }
    }
    for channel in out.iter_mut() {
        for value in &mut channel[..n] {
            *value = value.max(0.0);
        }
    }
}

/// Returns how many SH coefficients per color channel are evaluated: the coefficients of all complete degrees up to 3.
pub(super) fn coefficients(gaussians: &Gaussians) -> usize {
    let fits = |&degree: &usize| 3 * sh_coefficient_count(degree) <= gaussians.sh.width();
    (0..=MAX_SH_DEGREE).rev().find(fits).map_or(0, sh_coefficient_count)
}

/// Returns the unit vector from `center` to `position`, and the reciprocal of their distance.
#[inline(always)]
pub(super) fn direction(position: [f32; 3], center: [f64; 3]) -> ([f32; 3], f64) {
    // Differences are computed in f64: in f32, rounding would destroy the direction far from the origin.
    let d =
        [f64::from(position[0]) - center[0], f64::from(position[1]) - center[1], f64::from(position[2]) - center[2]];
    let inverse = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    ([(d[0] * inverse) as f32, (d[1] * inverse) as f32, (d[2] * inverse) as f32], inverse)
}

/// Factor of the SH basis functions of degree 1, which are polynomials in x, y, z.
const C1: f32 = 0.488_602_5;
/// Factors of the SH basis functions of degree 2. Several functions share a factor.
const C2: [f32; 3] = [1.092_548_5, 0.315_391_57, 0.546_274_2];
/// Factors of the SH basis functions of degree 3. Several functions share a factor.
const C3: [f32; 5] = [0.590_043_6, 2.890_611_4, 0.457_045_8, 0.373_176_34, 1.445_305_7];

/// Returns the values of the SH basis functions Y_k for the unit vector `[x, y, z]`.
#[inline(always)]
pub(super) fn basis([x, y, z]: [f32; 3]) -> [f32; sh_coefficient_count(3)] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        SH_C0 as f32,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        -C2[0] * y * z,
        C2[1] * (2.0 * zz - xx - yy),
        -C2[0] * x * z,
        C2[2] * (xx - yy),
        -C3[0] * y * (3.0 * xx - yy),
        C3[1] * x * y * z,
        -C3[2] * y * (4.0 * zz - xx - yy),
        C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -C3[2] * x * (4.0 * zz - xx - yy),
        C3[4] * z * (xx - yy),
        -C3[0] * x * (xx - 3.0 * yy),
    ]
}

/// Returns the derivatives of the SH basis functions Y_k (see [`basis`]) with respect to x, y and z. The functions are
/// differentiated as polynomials in x, y and z.
#[inline(always)]
pub(super) fn basis_gradient([x, y, z]: [f32; 3]) -> [[f32; 3]; sh_coefficient_count(3)] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let times = |c: f32, v: [f32; 3]| [c * v[0], c * v[1], c * v[2]];
    [
        [0.0; 3],
        [0.0, -C1, 0.0],
        [0.0, 0.0, C1],
        [-C1, 0.0, 0.0],
        times(C2[0], [y, x, 0.0]),
        times(-C2[0], [0.0, z, y]),
        times(C2[1], [-2.0 * x, -2.0 * y, 4.0 * z]),
        times(-C2[0], [z, 0.0, x]),
        times(C2[2], [2.0 * x, -2.0 * y, 0.0]),
        times(-C3[0], [6.0 * x * y, 3.0 * (xx - yy), 0.0]),
        times(C3[1], [y * z, x * z, x * y]),
        times(-C3[2], [-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z]),
        times(C3[3], [-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * (xx + yy)]),
        times(-C3[2], [4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z]),
        times(C3[4], [2.0 * x * z, -2.0 * y * z, xx - yy]),
        times(-C3[0], [3.0 * (xx - yy), -6.0 * x * y, 0.0]),
    ]
}
