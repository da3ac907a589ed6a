//! Projected coverage of a Gaussian: the number of pixels A that it covers in one view, times its opacity.
//!
//! Elliptical weighted averaging (Zwicker et al., "EWA Splatting", 2002) with the conventions of the original
//! rasterizer. Gaussians at a depth z of at most 0.2 (the camera's near plane) are culled. The Jacobian of the
//! projection is evaluated at x/z and y/z clamped to ±1.3·tan(fov/2). The 2-D covariance in the image is Σ = MMᵀ +
//! 0.3·I (px²), where M = J·W·R·S is 2×3: Jacobian J, camera rotation W, rotation R and scales S of the Gaussian.
//!
//! A = 9π·√det Σ × (fraction of the box u ± 3√Σ_xx, v ± 3√Σ_yy that lies inside the image), where (u, v) is the
//! projected center and 9π·√det Σ is the area of the ellipse at three standard deviations. As √det Σ ≤ √(Σ_xx Σ_yy), A
//! is at most π/4 of the image without a further limit.
//!
//! det Σ is never computed as Σ_xx Σ_yy − Σ_xy², which has no correct digit left for a long needle. With d = 0.3,
//! det(MMᵀ + d·I) = Σ(2×2 minors of M)² + d·tr(MMᵀ) + d² is a sum of positive terms only (Cauchy–Binet).
//!
//! The inner loop runs over whole arrays without branches, so that the compiler vectorizes it. It uses no fused
//! multiply-add, so every instruction set gives the same bits.

use std::f64::consts::FRAC_PI_4;

use crate::model::{Camera, vectorized};

/// Limit for |x/z| and |y/z| in the Jacobian, as a multiple of the tangent of half the field of view.
const JACOBIAN_CLAMP: f64 = 1.3;
/// Value added to the diagonal of a projected Gaussian's 2-D covariance, px².
const DILATION_PX2: f64 = 0.3;
/// Half the side of a projected Gaussian's bounding box, in standard deviations.
const REACH: f64 = 3.0;
/// Number of Gaussians for which one step of the projection is computed before the next step begins. A single loop that
/// computes all steps for one Gaussian after the other would have a dependency chain of about 150 cycles per iteration,
/// too long for a processor to overlap two iterations.
const BLOCK_LANES: usize = 32;
/// Constant 2⁵². Adding it to x in [0, 2⁵²) leaves x, rounded to an integer, in the low bits of the sum.
const ROUNDER: f64 = 4_503_599_627_370_496.0;

/// Attributes of a block of Gaussians at one frame, as arrays of equal length with one value per Gaussian.
#[derive(Debug, Clone, Copy)]
pub struct FootprintPlanes<'a> {
    /// Positions in scene coordinates: arrays of x, y and z.
    pub position: [&'a [f32]; 3],
    /// Matrix R·S (rotation times scales) of each Gaussian. Column k is the k-th axis of the Gaussian times its scale.
    /// Array 3·r + k holds the entries in row r and column k.
    pub axes: [&'a [f64]; 9],
    /// Opacity in [0, 1].
    pub opacity: &'a [f64],
}

/// Running sums over (frame, view) pairs for a block of Gaussians. Entry i of each array belongs to Gaussian i of the
/// [`FootprintPlanes`].
#[derive(Debug)]
pub struct CoverageSums<'a> {
    /// Sum of covered pixels times opacity, as a multiple of 2^−exponent px ([`CoverageScale::exponent`]).
    pub coverage: &'a mut [u64],
    /// Number of (frame, view) pairs in which the Gaussian is alive (opacity ≥ alpha_min) and its bounding box overlaps
    /// the image.
    pub touched: &'a mut [u32],
}

/// Settings with which [`CoverageSums`] are computed: the fixed-point scale in which contributions are added, and the
/// minimum opacity at which a Gaussian is alive.
#[derive(Debug, Clone, Copy)]
pub struct CoverageScale {
    /// Exponent of the fixed-point scale: contributions are rounded to multiples of 2^−exponent px. The number of
    /// pixels of an image times 2^exponent must be below 2⁵².
    pub exponent: i32,
    /// Minimum opacity at which a Gaussian counts as alive.
    pub alpha_min: f64,
}

/// Adds the contribution of every Gaussian of `planes` in the view of `camera` to `sums`.
///
/// Values that are not finite give an arbitrary contribution, but no panic. Finite values of any size give the
/// contribution that the module documentation defines, with a relative error of about 1e-14 plus half a fixed-point
/// unit.
///
/// # Panics
/// Panics if the arrays of `planes` and `sums` differ in length.
pub fn project(camera: &Camera, planes: &FootprintPlanes<'_>, scale: CoverageScale, sums: &mut CoverageSums<'_>) {
    let view = ScanView::new(camera);
    vectorized(
        #[inline(always)]
        || project_planes(&view, planes, scale, sums),
    );
}

/// Camera parameters in the form that the inner loop of the projection uses.
struct ScanView {
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
    focal: [f64; 2],
    principal: [f64; 2],
    size: [f64; 2],
    slope_limit: [f64; 2],
    near: f64,
}

impl ScanView {
    fn new(camera: &Camera) -> Self {
        let size = [f64::from(camera.width), f64::from(camera.height)];
        let focal = [camera.fx, camera.fy];
        ScanView {
            rotation: camera.rotation.transpose().to_cols_array_2d(),
            translation: camera.translation.to_array(),
            focal,
            principal: [camera.cx, camera.cy],
            size,
            slope_limit: std::array::from_fn(|k| JACOBIAN_CLAMP * size[k] / (2.0 * focal[k])),
            near: camera.near,
        }
    }
}

/// Adds the covered pixels times opacity of each Gaussian in one view to `sums`, [`BLOCK_LANES`] Gaussians at a time.
/// Inlined, so that each instruction set has its own compiled version.
#[inline(always)]
fn project_planes(view: &ScanView, planes: &FootprintPlanes<'_>, scale: CoverageScale, sums: &mut CoverageSums<'_>) {
    let n = planes.opacity.len();
    let blocks = n / BLOCK_LANES;
    let mut stage = ProjectedBlock::<BLOCK_LANES>::new();
    for block in 0..blocks {
        stage.project(view, planes, scale, sums, block);
    }
    let mut stage = ProjectedBlock::<1>::new();
    for i in blocks * BLOCK_LANES..n {
        stage.project(view, planes, scale, sums, i);
    }
}

/// Intermediate values of `N` Gaussians, which one step of the projection passes to the next.
struct ProjectedBlock<const N: usize> {
    depth: [f64; N],
    /// 1/depth; 1 for a Gaussian that is culled.
    inverse_depth: [f64; N],
    /// x/z and y/z of the center in camera space.
    slope: [[f64; N]; 2],
    /// Standard deviations √Σ_xx and √Σ_yy of the projected Gaussian, px.
    sigma: [[f64; N]; 2],
    /// √det Σ, where Σ is the 2-D covariance of the projected Gaussian; px².
    root_det: [f64; N],
}

impl<const N: usize> ProjectedBlock<N> {
    fn new() -> Self {
        let zeros = [0.0; N];
        ProjectedBlock { depth: zeros, inverse_depth: zeros, slope: [zeros; 2], sigma: [zeros; 2], root_det: zeros }
    }

    /// Projects the `N` Gaussians of block number `block` and adds their contributions to the sums.
    #[inline(always)]
    fn project(
        &mut self,
        view: &ScanView,
        planes: &FootprintPlanes<'_>,
        scale: CoverageScale,
        sums: &mut CoverageSums<'_>,
        block: usize,
    ) {
        self.project_centers(view, planes.position.map(|plane| &plane.as_chunks().0[block]));
        self.project_covariances(view, planes.axes.map(|plane| &plane.as_chunks().0[block]));
        self.accumulate(
            view,
            &planes.opacity.as_chunks().0[block],
            scale,
            &mut sums.coverage.as_chunks_mut().0[block],
            &mut sums.touched.as_chunks_mut().0[block],
        );
    }

    /// Computes the depth z and the slopes x/z and y/z, in camera space, of the centers of the Gaussians (px, py, pz).
    #[inline(always)]
    fn project_centers(&mut self, view: &ScanView, [px, py, pz]: [&[f32; N]; 3]) {
        let ScanView { rotation: [w0, w1, w2], translation: t, near, .. } = view;
        for i in 0..N {
            let world = [f64::from(px[i]), f64::from(py[i]), f64::from(pz[i])];
            let z = dot(w2, world) + t[2];
            let inverse_depth = 1.0 / if z > *near { z } else { 1.0 };
            self.depth[i] = z;
            self.inverse_depth[i] = inverse_depth;
            self.slope[0][i] = (dot(w0, world) + t[0]) * inverse_depth;
            self.slope[1][i] = (dot(w1, world) + t[1]) * inverse_depth;
        }
    }

    /// Computes three values of the 2-D covariance of each projected Gaussian: the standard deviations along x and y,
    /// and the square root of the determinant. `axes` is the matrix R·S (rotation times scales) of each Gaussian, entry
    /// by entry.
    #[inline(always)]
    #[expect(clippy::needless_range_loop, reason = "i runs over many planes at once")]
    fn project_covariances(&mut self, view: &ScanView, axes: [&[f64; N]; 9]) {
        let ScanView { rotation: [w0, w1, w2], focal, slope_limit, .. } = view;
        for i in 0..N {
            let row = |k: usize, w: &[f64; 3]| {
                let slope = clamp(self.slope[k][i], slope_limit[k]);
                jacobian_row(focal[k] * self.inverse_depth[i], slope, w, w2)
            };
            let (jw_x, jw_y) = (row(0, w0), row(1, w1));
            let column = |k: usize| [axes[k][i], axes[3 + k][i], axes[6 + k][i]];
            let (a, b, c) = (column(0), column(1), column(2));
            let m_x = [dot(&jw_x, a), dot(&jw_x, b), dot(&jw_x, c)];
            let m_y = [dot(&jw_y, a), dot(&jw_y, b), dot(&jw_y, c)];
            let (xx, yy) = (dot(&m_x, m_x), dot(&m_y, m_y));
            let minors = cross(m_x, m_y);
            let det = dot(&minors, minors) + DILATION_PX2 * (xx + yy) + DILATION_PX2 * DILATION_PX2;
            self.sigma[0][i] = (xx + DILATION_PX2).sqrt();
            self.sigma[1][i] = (yy + DILATION_PX2).sqrt();
            self.root_det[i] = det.sqrt();
        }
    }

    /// Adds the covered area inside the image (pixels) times the opacity of each Gaussian to `coverage`, in fixed
    /// point. Counts in `touched` the Gaussians that are alive and whose bounding box overlaps the image.
    #[inline(always)]
    fn accumulate(
        &self,
        view: &ScanView,
        opacity: &[f64; N],
        scale: CoverageScale,
        coverage: &mut [u64; N],
        touched: &mut [u32; N],
    ) {
        let ScanView { focal, principal, size, near, .. } = view;
        let unit = 2f64.powi(scale.exponent);
        for i in 0..N {
            let sigma = [self.sigma[0][i], self.sigma[1][i]];
            let inside = |k: usize| overlap(focal[k] * self.slope[k][i] + principal[k], REACH * sigma[k], size[k]);
            let (inside_x, inside_y) = (inside(0), inside(1));
            let touches = (self.depth[i] > *near) & (inside_x > 0.0) & (inside_y > 0.0);
            // 9π√det Σ × inside_x·inside_y / (6σ_x · 6σ_y): area of the ellipse times the fraction of its box inside
            // the image
            let area = FRAC_PI_4 * (self.root_det[i] / (sigma[0] * sigma[1])) * (inside_x * inside_y);
            let contribution = if touches { area * opacity[i] } else { 0.0 };
            let fixed = (contribution * unit + ROUNDER).to_bits().wrapping_sub(ROUNDER.to_bits());
            coverage[i] = coverage[i].wrapping_add(fixed);
            let seen = touches & (opacity[i] >= scale.alpha_min);
            touched[i] = touched[i].wrapping_add(u32::from(seen));
        }
    }
}

/// Returns a row of J·W (Jacobian times camera rotation): the gradient of one pixel coordinate (u or v) with respect to
/// the position, f/z·(w − slope·w₂).
///
/// `focal_over_depth` is f/z, `slope` is x/z for u and y/z for v, `w` is the camera axis that belongs to the
/// coordinate, and `w2` is the viewing axis.
#[inline(always)]
fn jacobian_row(focal_over_depth: f64, slope: f64, w: &[f64; 3], w2: &[f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| focal_over_depth * (w[k] - slope * w2[k]))
}

/// Returns the length of the part of the interval [center − reach, center + reach] that lies inside [0, size]. Returns
/// 0 or less if the interval lies outside.
#[inline(always)]
fn overlap(center: f64, reach: f64, size: f64) -> f64 {
    let (low, high) = (center - reach, center + reach);
    // Plain comparisons compile to single instructions; f64::min must also handle NaN.
    (if high < size { high } else { size }) - (if low > 0.0 { low } else { 0.0 })
}

#[inline(always)]
fn clamp(x: f64, limit: f64) -> f64 {
    let x = if x < limit { x } else { limit };
    if x > -limit { x } else { -limit }
}

#[inline(always)]
fn dot(a: &[f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::model::hash_id;

    const LEN: usize = 1003;

    fn random(k: usize) -> f64 {
        (hash_id(k as u64) >> 11) as f64 / 2f64.powi(53)
    }

    /// Runs `with`, one implementation of the projection, on random Gaussians around a camera, some of them behind it
    /// and some very large. Returns two values of each Gaussian: the covered pixels times opacity, in fixed point, and
    /// the number of views in which its bounding box overlaps the image.
    fn run_on_random_gaussians(
        with: impl Fn(&ScanView, &FootprintPlanes<'_>, CoverageScale, &mut CoverageSums<'_>),
    ) -> (Vec<u64>, Vec<u32>) {
        let camera = Camera {
            width: 320,
            height: 256,
            fx: 250.0,
            fy: 260.0,
            cx: 160.0,
            cy: 128.0,
            rotation: DMat3::from_rotation_y(0.3),
            translation: DVec3::new(0.1, -0.2, 3.0),
            near: Camera::NEAR,
        };
        let position: [Vec<f32>; 3] =
            std::array::from_fn(|axis| (0..LEN).map(|i| (10.0 * random(3 * i + axis) - 5.0) as f32).collect());
        let axes: [Vec<f64>; 9] = std::array::from_fn(|plane| {
            (0..LEN).map(|i| (random(7 * i + plane) - 0.5) * 10f64.powf(8.0 * random(i) - 5.0)).collect()
        });
        let opacity: Vec<f64> = (0..LEN).map(|i| random(i + 99)).collect();
        let (mut coverage, mut touched) = (vec![0; LEN], vec![0; LEN]);
        with(
            &ScanView::new(&camera),
            &FootprintPlanes {
                position: position.each_ref().map(|plane| &plane[..]),
                axes: axes.each_ref().map(|plane| &plane[..]),
                opacity: &opacity,
            },
            CoverageScale { exponent: 34, alpha_min: 0.01 },
            &mut CoverageSums { coverage: &mut coverage, touched: &mut touched },
        );
        (coverage, touched)
    }

    #[test]
    fn vector_instructions_give_the_bits_of_the_baseline() {
        let wide = run_on_random_gaussians(|view, planes, scale, sums| {
            vectorized(
                #[inline(always)]
                || project_planes(view, planes, scale, sums),
            );
        });
        let baseline = run_on_random_gaussians(project_planes);
        assert!(baseline.1.iter().filter(|&&touched| touched > 0).count() > 200, "the case must see something");
        assert_eq!(wide, baseline);
    }
}
