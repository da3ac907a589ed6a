//! Projection of Gaussians to image footprints (splats) by EWA splatting: one block at a time, in f64.
//!
//! f64 is needed for two reasons. The radius of a footprint, rounded up to whole pixels, decides which tiles a Gaussian
//! affects. The determinant of the 2-D covariance of a long, thin Gaussian loses all digits in f32. Input: the
//! Gaussians at one frame and a camera. Output: one [`Splat`] for every Gaussian that can change a pixel. Memory: a few
//! stack arrays of [`BLOCK`] entries. Source: Zwicker et al., "EWA Splatting", 2002, with the constants of Kerbl et
//! al., "3D Gaussian Splatting", 2023.

use std::f64::consts::{LN_2, LOG2_E};
use std::ops::Range;

use super::color::{self, ColorSource, Colors};
use super::convention::{BLOCK, MIN_ALPHA, TILE, has_visible};
use super::grid::{PixelGrid, SampledView};
use splat_core::exp_log::exp;
use splat_core::{Gaussians, vectorized};

/// Dilation: variance in pixels² that is added to the diagonal of every 2-D covariance, as in the original rasterizer.
const DILATION: f64 = 0.3;
/// Limit of the slopes x / depth and y / depth at which the Jacobian of the projection is evaluated, as a multiple of
/// the slope at the image edge. For Gaussians with larger slopes, the Jacobian is evaluated at the limit.
const FOV_MARGIN: f64 = 1.3;
/// Limit of the absolute value of a log scale and of an opacity logit. Values are clamped, so that fourth powers of
/// scales stay finite in f64.
pub(super) const LOGARITHM_LIMIT: f64 = 80.0;
/// Amount by which the test alpha ≥ 1/255 is relaxed, as a difference of log₂ alpha. It is thousands of times the
/// rounding error of the exponent of alpha, so rounding never removes a visible pixel.
const CUTOFF_SLACK: f64 = 1e-3;

/// Camera parameters in the form that the projection needs.
pub(super) struct CameraTerms {
    /// Rows of the rotation from world to camera.
    pub(super) rotation: [[f64; 3]; 3],
    /// Translation from world to camera, scene units.
    translation: [f64; 3],
    /// Focal lengths along x and y, pixels.
    pub(super) focal: [f64; 2],
    /// Principal point in pixels, in coordinates in which pixel centers lie at integers.
    principal: [f64; 2],
    /// Largest |x / depth| and |y / depth| at which the Jacobian of the projection is evaluated.
    pub(super) slope_limit: [f64; 2],
    /// Position of the camera in world coordinates, scene units.
    pub(super) center: [f64; 3],
    /// Width and height of the full image, pixels.
    image_size: [u32; 2],
    /// Numbers of tiles across and down the full image.
    image_tiles: [u32; 2],
    /// Pixels of the image that are rendered.
    pub(super) grid: PixelGrid,
    /// Numbers of columns and rows of `grid`: the size of the render.
    pub(super) size: [u32; 2],
    /// Numbers of tiles (16×16 pixels of `grid`) across and down the render.
    pub(super) tiles: [u32; 2],
    /// Near limit in scene units: Gaussians at this depth or closer to the camera are not drawn. Rounded to f32 as in
    /// the original CUDA rasterizer.
    near: f64,
}

impl CameraTerms {
    /// Computes the parameters of the projection from a camera and the pixels that are rendered.
    pub(super) fn new(view: SampledView<'_>) -> Self {
        let SampledView { camera, grid } = view;
        let image_size = [camera.width, camera.height];
        let size = grid.size(image_size);
        let rows = camera.rotation.transpose();
        CameraTerms {
            rotation: [rows.x_axis.to_array(), rows.y_axis.to_array(), rows.z_axis.to_array()],
            translation: camera.translation.to_array(),
            focal: [camera.fx, camera.fy],
            principal: [camera.cx - 0.5, camera.cy - 0.5],
            slope_limit: [
                FOV_MARGIN * f64::from(camera.width) / (2.0 * camera.fx),
                FOV_MARGIN * f64::from(camera.height) / (2.0 * camera.fy),
            ],
            center: camera.center().to_array(),
            image_size,
            image_tiles: image_size.map(|pixels| pixels.div_ceil(TILE)),
            grid,
            size,
            tiles: size.map(|pixels| pixels.div_ceil(TILE)),
            near: f64::from(camera.near as f32),
        }
    }
}

/// Footprint of one Gaussian in one view, which gives its alpha at every pixel.
///
/// At pixel offset (dx, dy) from the center of the splat, alpha is the opacity times 2 to the power of `−falloff_x·(dx
/// − shear·dy)² − falloff_y·dy²`. The exponent is the quadratic form of the inverse 2-D covariance, written as squares,
/// so it is never positive and loses no digits.
///
/// Aligned to a cache line, because splats are not read in the order in which they are stored.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct Splat {
    /// Position of the center of the splat along x in the image, in pixels; pixel centers lie at integers.
    pub(super) u: f64,
    /// Position of the center of the splat along y in the image, in pixels; pixel centers lie at integers.
    pub(super) v: f64,
    /// Coefficient of (dx − shear·dy)² in the exponent of alpha, 1/pixels², where (dx, dy) is the offset of a pixel
    /// from the center.
    pub(super) falloff_x: f32,
    /// Slant of the splat, in pixels along x per row: in the pixel row at the offset dy from the center, alpha is
    /// largest at the offset dx = shear·dy.
    pub(super) shear: f32,
    /// Coefficient of dy² in the exponent of alpha, 1/pixels², where dy is the offset of a pixel row from the center.
    pub(super) falloff_y: f32,
    /// Cutoff for the exponent of 2 in the formula of alpha (see [`Splat`]): a pixel whose exponent is below `−cutoff`
    /// is skipped, because its alpha is below 1/255.
    pub(super) cutoff: f32,
    /// Opacity of the Gaussian, in [0, 1].
    pub(super) opacity: f32,
    /// Depth in scene units, computed in f32 like in the original CUDA rasterizer. Its rounding decides which of two
    /// almost equally deep Gaussians is in front (without this rounding, one render agreed with the original to 81 dB
    /// instead of 116 dB).
    pub(super) sort_depth: f32,
    /// Color of the Gaussian in this view: red, green and blue.
    pub(super) color: [f32; 3],
    /// Index of the Gaussian in the frame.
    pub(super) id: u32,
    /// Tiles in which the original CUDA rasterizer draws the splat, as `[x0, x1, y0, y1]`: columns from x0 to below x1,
    /// rows from y0 to below y1 of the tiles of the full image. Pixels outside these tiles are excluded, although alpha
    /// may exceed 1/255 there.
    ///
    /// [`Splat::UNBOUNDED`] if no pixel has to be excluded. Used only in renders of a grid of pixels, whose tiles are
    /// larger than those of the image.
    pub(super) drawn_tiles: [u16; 4],
}

impl Splat {
    /// Value of [`Splat::drawn_tiles`] of a splat that may be drawn in every tile. With any other value, the splat is
    /// not drawn in pixels outside the tiles in which the original CUDA rasterizer draws it.
    pub(super) const UNBOUNDED: [u16; 4] = [0, u16::MAX, 0, u16::MAX];
}

/// Rectangle of tiles [x0, x1) × [y0, y1) in which a splat can change a pixel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct TileRect {
    pub(super) x0: u32,
    pub(super) x1: u32,
    pub(super) y0: u32,
    pub(super) y1: u32,
}

impl TileRect {
    /// Returns the rectangle as `[x0, x1, y0, y1]` in 16-bit integers: columns of tiles from x0 to below x1, rows of
    /// tiles from y0 to below y1. A number above 65,535 becomes 65,535.
    fn narrow(self) -> [u16; 4] {
        [self.x0, self.x1, self.y0, self.y1].map(|tile| tile.try_into().unwrap_or(u16::MAX))
    }
}

/// Footprints (splats) of visible Gaussians in the order of their indices, and the tiles that each splat can change.
/// Entry i of both lists belongs to the same Gaussian.
#[derive(Debug, Default)]
pub(super) struct Splats {
    pub(super) splats: Vec<Splat>,
    pub(super) rects: Vec<TileRect>,
}

impl Splats {
    /// Removes all splats.
    pub(super) fn clear(&mut self) {
        self.splats.clear();
        self.rects.clear();
    }

    /// Appends the splats of `next`, whose Gaussians must have higher indices than all Gaussians of the present splats.
    pub(super) fn append(&mut self, mut next: Splats) {
        self.splats.append(&mut next.splats);
        self.rects.append(&mut next.rects);
    }
}

/// Projects the Gaussians with the indices `ids` and appends the splats of the visible ones, with colors from `colors`,
/// to `out`.
///
/// A Gaussian with a position, rotation, scale or opacity that is not finite is not visible.
pub(super) fn project(
    gaussians: &Gaussians,
    ids: Range<usize>,
    view: &CameraTerms,
    colors: ColorSource<'_>,
    out: &mut Splats,
) {
    vectorized(
        #[inline(always)]
        || project_blocks(gaussians, ids, view, colors, out),
    );
}

/// Projects Gaussians like [`project`], in blocks of [`BLOCK`] Gaussians.
#[inline(always)]
fn project_blocks(
    gaussians: &Gaussians,
    ids: Range<usize>,
    view: &CameraTerms,
    colors: ColorSource<'_>,
    out: &mut Splats,
) {
    // Reserves memory for all Gaussians at once, because growing vectors would copy splats. Reserved memory that is
    // never written takes no physical memory.
    out.splats.reserve_exact(ids.len());
    out.rects.reserve_exact(ids.len());
    let mut footprints = ProjectedSplats::default();
    let mut evaluated: Colors = [[0.0; BLOCK]; 3];
    for start in ids.clone().step_by(BLOCK) {
        let block = start..(start + BLOCK).min(ids.end);
        if !has_visible(gaussians, block.clone()) {
            continue;
        }
        let before = out.splats.len();
        footprints.fill(gaussians, block.clone(), view);
        footprints.fill_tiles(block.len(), view);
        for i in 0..block.len() {
            if let Some((splat, rect)) = footprints.splat(i, (start + i) as u32, view) {
                out.splats.push(splat);
                out.rects.push(rect);
            }
        }
        let splats = &mut out.splats[before..];
        match colors {
            ColorSource::Coefficients if !splats.is_empty() => {
                color::evaluate(gaussians, block, view.center, &mut evaluated);
                for splat in splats {
                    let i = splat.id as usize - start;
                    splat.color = [evaluated[0][i], evaluated[1][i], evaluated[2][i]];
                }
            }
            ColorSource::Computed(colors, view) => {
                let colors = colors.block(view, start);
                splats.iter_mut().for_each(|splat| splat.color = colors[splat.id as usize - start]);
            }
            ColorSource::Black | ColorSource::Coefficients => {}
        }
    }
}

/// Results of the projection for the Gaussians of one block, one array per quantity of [`Splat`].
struct ProjectedSplats {
    depth: [f64; BLOCK],
    sort_depth: [f32; BLOCK],
    u: [f64; BLOCK],
    v: [f64; BLOCK],
    /// Coefficients of the exponent of alpha for each Gaussian of the block; see the fields of [`Splat`] with the same
    /// names.
    falloff_x: [f64; BLOCK],
    shear: [f64; BLOCK],
    falloff_y: [f64; BLOCK],
    /// Square of half the width of the ellipse on which alpha is half its maximum, pixels². Multiplied by
    /// [`Splat::cutoff`], it is the square of half the width of the ellipse alpha ≥ 1/255, or slightly more.
    squared_half_u: [f64; BLOCK],
    /// Square of half the height of the ellipse on which alpha is half its maximum, pixels². Multiplied by
    /// [`Splat::cutoff`], it is the square of half the height of the ellipse alpha ≥ 1/255, or slightly more.
    squared_half_v: [f64; BLOCK],
    /// Radius of the footprint in pixels: three standard deviations along its longest axis, rounded up.
    radius: [f64; BLOCK],
    opacity: [f64; BLOCK],
    cutoff: [f64; BLOCK],
    /// Tiles that the splat can change, as in [`TileRect`]: x0, x1, y0 and y1, integers in f64.
    tiles: [[f64; BLOCK]; 4],
    /// Tiles of the full image in which the original CUDA rasterizer draws the splat, in the same order, without those
    /// that its ellipse alpha ≥ 1/255 cannot touch.
    image_tiles: [[f64; BLOCK]; 4],
    /// 1 if the splat can change a pixel, otherwise 0. As wide as the other arrays, which suits vector instructions.
    is_visible: [u64; BLOCK],
    /// 1 if the ellipse alpha ≥ 1/255 contains a pixel of the image outside `image_tiles`, otherwise 0.
    is_cut_off: [u64; BLOCK],
}

impl Default for ProjectedSplats {
    fn default() -> Self {
        let zero = [0.0; BLOCK];
        ProjectedSplats {
            depth: zero,
            sort_depth: [0.0; BLOCK],
            u: zero,
            v: zero,
            falloff_x: zero,
            shear: zero,
            falloff_y: zero,
            squared_half_u: zero,
            squared_half_v: zero,
            radius: zero,
            opacity: zero,
            cutoff: zero,
            tiles: [zero; 4],
            image_tiles: [zero; 4],
            is_visible: [0; BLOCK],
            is_cut_off: [0; BLOCK],
        }
    }
}

impl ProjectedSplats {
    /// Projects every Gaussian of the block, visible or not. The loop has no branches, so the compiler vectorizes it.
    #[inline(always)]
    fn fill(&mut self, gaussians: &Gaussians, block: Range<usize>, view: &CameraTerms) {
        let n = block.len().min(BLOCK);
        let position: [&[f32]; 3] = std::array::from_fn(|c| &gaussians.position.plane(c)[block.clone()][..n]);
        let rotation: [&[f32]; 4] = std::array::from_fn(|c| &gaussians.rotation.plane(c)[block.clone()][..n]);
        let log_scale: [&[f32]; 3] = std::array::from_fn(|c| &gaussians.log_scale.plane(c)[block.clone()][..n]);
        let logit = &gaussians.opacity_logit.plane(0)[block.clone()][..n];
        let [w0, w1, w2] = view.rotation[2].map(|x| x as f32);
        let w3 = view.translation[2] as f32;
        for i in 0..n {
            let p: [f64; 3] = [position[0][i].into(), position[1][i].into(), position[2][i].into()];
            let q: [f64; 4] =
                [rotation[0][i].into(), rotation[1][i].into(), rotation[2][i].into(), rotation[3][i].into()];
            let shape = ProjectedShape::new(p, q, [log_scale[0][i], log_scale[1][i], log_scale[2][i]], view);
            let Covariance { xx, xy, yy, det } = shape.covariance();
            // Squared half difference of the two eigenvalues of the covariance, written as a sum of squares.
            let spread = 0.25 * (xx - yy) * (xx - yy) + xy * xy;
            let largest = 0.5 * (xx + yy) + (if spread < 0.1 { 0.1 } else { spread }).sqrt();
            self.depth[i] = shape.depth;
            self.sort_depth[i] = (w0 * position[0][i] + w1 * position[1][i]) + (w2 * position[2][i] + w3);
            self.u[i] = view.focal[0] * shape.slopes[0] + view.principal[0];
            self.v[i] = view.focal[1] * shape.slopes[1] + view.principal[1];
            let inverse_yy = 1.0 / yy;
            self.falloff_x[i] = 0.5 * LOG2_E * yy / det;
            self.shear[i] = xy * inverse_yy;
            self.falloff_y[i] = 0.5 * LOG2_E * inverse_yy;
            self.squared_half_u[i] = 2.0 * LN_2 * xx;
            self.squared_half_v[i] = 2.0 * LN_2 * yy;
            self.radius[i] = (3.0 * largest.sqrt()).ceil();
            self.opacity[i] = opacity(logit[i]);
        }
    }

    /// Computes the tiles that the first `n` splats of the block can change. The loop has no branches, like that of
    /// [`ProjectedSplats::fill`].
    #[inline(always)]
    fn fill_tiles(&mut self, n: usize, view: &CameraTerms) {
        let size = view.image_size.map(f64::from);
        let image_tiles = view.image_tiles.map(f64::from);
        for i in 0..n.min(BLOCK) {
            let (depth, u, v, opacity) = (self.depth[i], self.u[i], self.v[i], self.opacity[i]);
            let is_finite = depth.is_finite() & u.is_finite() & v.is_finite() & self.falloff_x[i].is_finite();
            let cutoff = log2_bound(opacity * (1.0 / f64::from(MIN_ALPHA))) + CUTOFF_SLACK;
            // The square of tiles of the original CUDA rasterizer, reduced to the tiles that the ellipse alpha ≥ 1/255
            // can touch.
            let (half_u, half_v) = ((cutoff * self.squared_half_u[i]).sqrt(), (cutoff * self.squared_half_v[i]).sqrt());
            let radius = self.radius[i];
            let (x0, x1) = image_tile_range(u, radius, half_u, image_tiles[0]);
            let (y0, y1) = image_tile_range(v, radius, half_v, image_tiles[1]);
            let (start_x, end_x) = view.grid.tile_range(0, (x0, x1), u, half_u, size[0]);
            let (start_y, end_y) = view.grid.tile_range(1, (y0, y1), v, half_v, size[1]);
            let is_drawn = (depth > view.near) & is_finite & (opacity >= f64::from(MIN_ALPHA)) & (x0 < x1) & (y0 < y1);
            self.is_visible[i] = u64::from(is_drawn & (start_x < end_x) & (start_y < end_y));
            self.is_cut_off[i] = u64::from(
                is_cut_off(u, half_u, (x0, x1), image_tiles[0]) | is_cut_off(v, half_v, (y0, y1), image_tiles[1]),
            );
            self.cutoff[i] = cutoff;
            (self.tiles[0][i], self.tiles[1][i], self.tiles[2][i], self.tiles[3][i]) = (start_x, end_x, start_y, end_y);
            (self.image_tiles[0][i], self.image_tiles[1][i]) = (x0, x1);
            (self.image_tiles[2][i], self.image_tiles[3][i]) = (y0, y1);
        }
    }

    /// Returns two values for Gaussian `i` of the block: its splat, and the tiles that the splat can change. Returns
    /// `None` if it cannot change any pixel. `id` is the index of the Gaussian in the frame.
    #[inline(always)]
    fn splat(&self, i: usize, id: u32, view: &CameraTerms) -> Option<(Splat, TileRect)> {
        if self.is_visible[i] == 0 {
            return None;
        }
        let rect = |[x0, x1, y0, y1]: &[[f64; BLOCK]; 4]| TileRect {
            x0: x0[i] as u32,
            x1: x1[i] as u32,
            y0: y0[i] as u32,
            y1: y1[i] as u32,
        };
        let is_cut_off = !view.grid.has_all_pixels() && self.is_cut_off[i] != 0;
        let splat = Splat {
            u: self.u[i],
            v: self.v[i],
            falloff_x: self.falloff_x[i] as f32,
            shear: self.shear[i] as f32,
            falloff_y: self.falloff_y[i] as f32,
            cutoff: self.cutoff[i] as f32,
            opacity: self.opacity[i] as f32,
            sort_depth: self.sort_depth[i],
            color: [0.0; 3],
            id,
            drawn_tiles: if is_cut_off { rect(&self.image_tiles).narrow() } else { Splat::UNBOUNDED },
        };
        Some((splat, rect(&self.tiles)))
    }
}

/// Position and principal axes of one Gaussian, in the world and projected to the image.
pub(super) struct ProjectedShape {
    /// Depth from the camera, scene units.
    pub(super) depth: f64,
    /// Reciprocal of the depth.
    pub(super) inverse_depth: f64,
    /// Position in camera coordinates, divided by the depth: x / depth and y / depth.
    pub(super) slopes: [f64; 2],
    /// Derivatives of the image coordinates u and v with respect to the world position, pixels per scene unit: the rows
    /// of the Jacobian of the projection times the rotation of the camera.
    pub(super) to_pixels: [[f64; 3]; 2],
    /// Directions of the axes of the Gaussian in the world: the columns of its rotation matrix.
    pub(super) axes: [[f64; 3]; 3],
    /// Scales (standard deviations along the axes), scene units.
    pub(super) scale: [f64; 3],
    /// The three axes of the Gaussian, each as long as one standard deviation, projected to the image: `spread[0][k]`
    /// is the extent of axis k along x of the image, `spread[1][k]` along y, in pixels. Equal to `to_pixels` · axes ·
    /// scale.
    pub(super) spread: [[f64; 3]; 2],
}

/// 2-D covariance of a footprint after dilation (adding [`DILATION`] to the diagonal), pixels², and its determinant.
pub(super) struct Covariance {
    pub(super) xx: f64,
    pub(super) xy: f64,
    pub(super) yy: f64,
    pub(super) det: f64,
}

impl ProjectedShape {
    /// Projects a Gaussian with the world position `p`, the quaternion `q` (w, x, y, z) and the logarithms of its
    /// scales `log_scale` to the image of the camera `view`.
    #[inline(always)]
    pub(super) fn new(p: [f64; 3], q: [f64; 4], log_scale: [f32; 3], view: &CameraTerms) -> Self {
        let [r0, r1, r2] = view.rotation;
        let [t0, t1, t2] = view.translation;
        let z = dot(r2, p) + t2;
        let inverse_depth = 1.0 / z;
        let slopes = [(dot(r0, p) + t0) * inverse_depth, (dot(r1, p) + t1) * inverse_depth];
        let axes = rotation_matrix(q);
        let s = [
            exp(clamp_to(log_scale[0].into(), LOGARITHM_LIMIT)),
            exp(clamp_to(log_scale[1].into(), LOGARITHM_LIMIT)),
            exp(clamp_to(log_scale[2].into(), LOGARITHM_LIMIT)),
        ];
        let (jx, jy) = (view.focal[0] * inverse_depth, view.focal[1] * inverse_depth);
        let (kx, ky) = (clamp_to(slopes[0], view.slope_limit[0]), clamp_to(slopes[1], view.slope_limit[1]));
        let to_u = [jx * (r0[0] - kx * r2[0]), jx * (r0[1] - kx * r2[1]), jx * (r0[2] - kx * r2[2])];
        let to_v = [jy * (r1[0] - ky * r2[0]), jy * (r1[1] - ky * r2[1]), jy * (r1[2] - ky * r2[2])];
        // Not `array::map`: it may be compiled as a separate function, which would keep the calling loop from being
        // vectorized.
        let spread = [
            [dot(to_u, axes[0]) * s[0], dot(to_u, axes[1]) * s[1], dot(to_u, axes[2]) * s[2]],
            [dot(to_v, axes[0]) * s[0], dot(to_v, axes[1]) * s[1], dot(to_v, axes[2]) * s[2]],
        ];
        ProjectedShape { depth: z, inverse_depth, slopes, to_pixels: [to_u, to_v], axes, scale: s, spread }
    }

    /// Returns the 2-D covariance of the footprint after dilation (adding [`DILATION`] to the diagonal).
    #[inline(always)]
    pub(super) fn covariance(&self) -> Covariance {
        let [a, b] = self.spread;
        let (aa, bb) = (dot(a, a), dot(b, b));
        let cross = cross(a, b);
        Covariance {
            xx: aa + DILATION,
            xy: dot(a, b),
            yy: bb + DILATION,
            det: dot(cross, cross) + DILATION * (aa + bb) + DILATION * DILATION,
        }
    }
}

/// Returns the opacity in [0, 1] of a stored logit.
#[inline(always)]
pub(super) fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + exp(clamp_to(-f64::from(logit), LOGARITHM_LIMIT)))
}

/// Returns the range of tiles of the full image along one axis, as (first, end), that a splat can change: integers in
/// f64. These are the tiles that the original CUDA rasterizer draws, except tiles whose pixels are all further than
/// `half` from the center of the splat.
///
/// - `at`: center of the splat along the axis, pixels.
/// - `radius`: half the side of the square that the original rasterizer draws, pixels.
/// - `half`: half the extent of the splat along the axis (where alpha ≥ 1/255), pixels.
/// - `tiles`: number of tiles of the image along the axis.
#[inline(always)]
fn image_tile_range(at: f64, radius: f64, half: f64, tiles: f64) -> (f64, f64) {
    let tile = f64::from(TILE);
    let start = ((at - radius) / tile).floor().max(((at - half - (tile - 1.0)) / tile).ceil());
    let end = ((at + radius + tile - 1.0) / tile).floor().min(((at + half) / tile).floor() + 1.0);
    // NaN becomes 0.
    (start.max(0.0).min(tiles), end.max(0.0).min(tiles))
}

/// Returns whether a splat reaches a pixel of the image outside the tiles `start` to below `end` along one axis, so
/// that the original CUDA rasterizer cuts it off there. The other arguments are those of [`image_tile_range`].
#[inline(always)]
fn is_cut_off(at: f64, half: f64, (start, end): (f64, f64), tiles: f64) -> bool {
    let [start_pixel, end_pixel] = [start * f64::from(TILE), end * f64::from(TILE)];
    ((start > 0.0) & (at - half <= start_pixel - 1.0)) | ((end < tiles) & (at + half >= end_pixel))
}

/// Returns an upper bound of log₂ x for normal positive x, at most 0.087 above it.
///
/// For x = 2ⁿ·(1 + m) with 0 ≤ m < 1, the bits of x, read as an integer and scaled by 2⁻⁵², are 1023 + n + m. The bound
/// uses log₂(1 + m) ≤ m + 0.0861. The last twelve bits are left out; they contribute less than 2⁻⁴⁰.
#[inline(always)]
fn log2_bound(x: f64) -> f64 {
    // Converts the integer k of the remaining bits to f64: as k < 2⁵², it is the mantissa of the f64 2⁵² + k. AVX2 has no
    // instruction for this conversion, so `as f64` would keep the calling loop from being vectorized.
    const OFFSET: f64 = (1u64 << 52) as f64;
    let k = f64::from_bits(OFFSET.to_bits() | (x.to_bits() >> 12)) - OFFSET;
    k * (1.0 / (1u64 << 40) as f64) - (1023.0 - 0.0861)
}

/// Returns `x` limited to −`bound` … `bound`. NaN stays NaN, so that the Gaussian counts as not finite. (`f64::clamp`
/// may panic, which keeps a loop from being vectorized.)
#[inline(always)]
fn clamp_to(x: f64, bound: f64) -> f64 {
    let x = if x > bound { bound } else { x };
    if x < -bound { -bound } else { x }
}

/// Returns the scalar product of `a` and `b`.
#[inline(always)]
pub(super) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Returns the cross product `a` × `b`.
#[inline(always)]
pub(super) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Returns the columns of the rotation matrix of a quaternion (w, x, y, z) of any length. A zero quaternion gives the
/// identity.
#[inline(always)]
fn rotation_matrix([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    // The factor 2/|q|² replaces normalization. Its floor keeps 0 · s = 0 for a zero quaternion.
    let norm = w * w + x * x + y * y + z * z;
    let s = 2.0 / if norm < f64::MIN_POSITIVE { f64::MIN_POSITIVE } else { norm };
    [
        [1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)],
        [s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x)],
        [s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y)],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log2_bound_exceeds_log2_by_less_than_0_087() {
        for step in 0..100_000 {
            let x = 1.0 + f64::from(step) * 2.54e-3;
            let excess = log2_bound(x) - x.log2();
            assert!((0.0..0.087).contains(&excess), "log2 of {x} is exceeded by {excess}");
        }
    }

    #[test]
    fn zero_quaternion_is_the_identity() {
        assert_eq!(rotation_matrix([0.0; 4]), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    }

    #[test]
    fn tile_ranges_match_the_reference_kernel_without_ellipse() {
        for step in -400..4000 {
            let at = f64::from(step) * 0.1;
            for radius in [1.0f64, 3.0, 17.0, 250.0] {
                let expected_start = (((at - radius) / 16.0) as i64).clamp(0, 20) as f64;
                let expected_end = (((at + radius + 15.0) / 16.0) as i64).clamp(0, 20) as f64;
                let (start, end) = image_tile_range(at, radius, 1e9, 20.0);
                if expected_start < expected_end {
                    assert_eq!((start, end), (expected_start, expected_end), "at {at} radius {radius}");
                } else {
                    assert!(start >= end, "at {at} radius {radius}: got {start}..{end}, expected none");
                }
            }
        }
    }
}
