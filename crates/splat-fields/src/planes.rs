//! HexPlane features of positions and time. Six planes span the axis pairs of x, y, z and time at each of several
//! resolutions (levels). A feature of a level is the product of bilinear samples of its six planes.
//!
//! Input: stored positions `[3, N]`, a time. Output: features `[Σ channels, LANES]`, the channels of all levels for a
//! group of Gaussians. Memory: 4·Σ channels + 36·levels bytes per prepared Gaussian, and 12·Σ channels more with slopes
//! (derivatives with respect to position). Source: Cao & Johnson, "HexPlane", 2023; Wu et al., "4D Gaussian Splatting",
//! 2024, section 4.2.
//!
//! The samples of the three planes without time do not depend on time, so their product is computed once per block of
//! Gaussians. All Gaussians share the time of a frame, so each plane with time is first interpolated along time into a
//! line. A Gaussian then interpolates between two points of that line.

use splat_core::error::Result;
use splat_core::{AttributeValues, vectorized};

use super::linear::{CacheLine, LANES};
use super::tensors::Lookup;

const X: usize = 0;
const Y: usize = 1;
const Z: usize = 2;
/// Prefix of the names of all feature planes in the state dict. In a name, the number of the level (resolution) and the
/// number of the plane (0 to 5) follow.
const GRIDS: &str = "deformation_net.grid.grids.";
/// Feature planes over two axes of space, each as (number of the plane in the state dict, first axis a, second axis b).
pub(super) const SPATIAL: [(usize, usize, usize); 3] = [(0, X, Y), (1, X, Z), (3, Y, Z)];
/// Numbers in the state dict of the feature planes over an axis of space and time: (x, t), (y, t) and (z, t).
const TEMPORAL: [usize; 3] = [2, 4, 5];

/// Plane of features over two axes a and b: a grid of texels (grid points with one value per channel). Stored as
/// `[size_b, size_a, channels]`, so that the channels of a texel are contiguous.
#[derive(Debug, Clone)]
pub(super) struct FeaturePlane {
    pub(super) size_a: usize,
    pub(super) size_b: usize,
    texels: Vec<f32>,
}

/// Feature planes of one level (one of several resolutions): three over two axes of space, and three over an axis of
/// space and time.
#[derive(Debug, Clone)]
pub(super) struct Level {
    pub(super) channels: usize,
    pub(super) spatial: [FeaturePlane; 3],
    pub(super) temporal: [FeaturePlane; 3],
}

/// Feature planes over (x, t), (y, t) and (z, t) of one level (resolution), interpolated at a fixed time t. Each plane
/// becomes a line of features, `[size_a, channels]`, along x, y or z, in this order.
pub(super) type TimeLines = [Vec<f32>; 3];

/// Box in space that the feature planes cover.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Box3 {
    /// Corner of the box that is mapped to the normalized coordinates −1, scene units. In trained models this is the
    /// corner with the largest coordinates.
    pub(super) origin: [f32; 3],
    /// Factor from scene units to normalized coordinates per axis: 2 / (other corner − `origin`).
    pub(super) factor: [f32; 3],
}

impl Box3 {
    /// Creates the box between two corners, given as the six values of the tensor `deformation_net.grid.aabb`. Returns
    /// `None` unless the corners differ along every axis.
    pub fn new(corners: &[f32]) -> Option<Box3> {
        let &[x0, y0, z0, x1, y1, z1] = corners else { return None };
        let origin = [x0, y0, z0];
        let factor = [x1 - x0, y1 - y0, z1 - z0].map(|size| 2.0 / size);
        factor.iter().all(|f: &f32| f.is_finite()).then_some(Box3 { origin, factor })
    }

    /// Returns the position `p` (scene units) in normalized coordinates, which are −1 to 1 inside the box.
    #[inline(always)]
    pub fn normalized(&self, p: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|axis| (p[axis] - self.origin[axis]) * self.factor[axis] - 1.0)
    }
}

/// Feature planes of all levels (resolutions), and the box in space that they cover.
#[derive(Debug, Clone)]
pub(super) struct Planes {
    pub(super) space: Box3,
    pub(super) levels: Vec<Level>,
}

/// Two neighboring texels (grid points of a feature plane) along one axis, and the weight for linear interpolation at a
/// coordinate between them.
#[derive(Debug, Clone, Copy)]
pub struct TexelPair {
    /// Index of the texel at or below the coordinate.
    pub low: u32,
    /// Index of the next texel, or `low` if there is no next one.
    pub high: u32,
    /// Weight of the texel `high`; the texel `low` has the weight 1 − `fraction`.
    pub fraction: f32,
}

/// Part of the HexPlane features of a block of Gaussians that does not depend on time, so it is computed once and used
/// for every frame.
#[derive(Debug, Clone)]
pub(super) struct PreparedPlanes {
    /// Product of the features that were sampled at each Gaussian from the planes over (x, y), (x, z) and (y, z):
    /// `[rows, width]`, one row per Gaussian with the channels of all levels (resolutions).
    pub(super) product: Vec<f32>,
    /// Position of each Gaussian along x, y and z in the planes over (x, t), (y, t) and (z, t), as two texels and a
    /// weight: `[rows, levels, 3]`, one row per Gaussian.
    pub(super) taps: Vec<TexelPair>,
    /// Derivatives of `product` with respect to the normalized coordinates: `[rows, 3, width]`, for each Gaussian those
    /// along x, then y, then z ([`Planes::slopes_in_space`]). Empty if no Jacobian is computed.
    pub(super) slopes: Vec<f32>,
}

impl PreparedPlanes {
    /// Returns whether slopes were computed, for `rows` Gaussians and the number of features of `planes`.
    pub(super) fn has_slopes(&self, planes: &Planes, rows: usize) -> bool {
        self.slopes.len() == 3 * planes.width() * rows
    }
}

impl FeaturePlane {
    /// Reads a plane from the tensor `name`. Returns the plane and its number of channels. If `channels` is `None`, any
    /// number of channels is accepted.
    fn load(lookup: Lookup<'_>, name: &str, channels: Option<usize>) -> Result<(Self, usize)> {
        let tensor = lookup.get_shaped(name, &[Some(1), channels, None, None], "1, channels, size_b, size_a")?;
        let [channels, size_b, size_a] = [tensor.shape[1], tensor.shape[2], tensor.shape[3]];
        let texel_count = size_b * size_a;
        let mut texels = vec![0.0; tensor.data.len()];
        for (c, plane) in tensor.data.chunks_exact(texel_count).enumerate() {
            for (texel, &value) in texels.chunks_exact_mut(channels).zip(plane) {
                texel[c] = value;
            }
        }
        Ok((FeaturePlane { size_a, size_b, texels }, channels))
    }

    /// Returns the channels of the texel (grid point) with index `a` along the first axis of the plane and `b` along
    /// the second. `channels` is the number of channels of the plane.
    #[inline(always)]
    pub(super) fn texel(&self, a: u32, b: u32, channels: usize) -> &[f32] {
        let start = (b as usize * self.size_a + a as usize) * channels;
        &self.texels[start..start + channels]
    }

    /// Interpolates the plane bilinearly at one point and writes one value per channel to `out`. `a` and `b` give the
    /// neighboring texels (grid points) and their weights along the first and the second axis.
    #[inline(always)]
    fn sample(&self, a: TexelPair, b: TexelPair, out: &mut [f32]) {
        let channels = out.len();
        let corner = |ia, ib| self.texel(ia, ib, channels);
        let [ll, hl] = [corner(a.low, b.low), corner(a.high, b.low)];
        let [lh, hh] = [corner(a.low, b.high), corner(a.high, b.high)];
        let weights = [
            (1.0 - a.fraction) * (1.0 - b.fraction),
            a.fraction * (1.0 - b.fraction),
            (1.0 - a.fraction) * b.fraction,
            a.fraction * b.fraction,
        ];
        for c in 0..out.len() {
            out[c] = ll[c] * weights[0] + hl[c] * weights[1] + lh[c] * weights[2] + hh[c] * weights[3];
        }
    }
}

/// Returns the two neighbors of the normalized coordinate `u` among `size` texels (grid points) along an axis, and the
/// weight of the second one. The first texel lies at −1 and the last at 1 (`align_corners`). Coordinates beyond them
/// are clamped. A NaN coordinate gives a NaN fraction, hence NaN features.
#[inline(always)]
pub fn texel_pair(u: f32, size: usize) -> TexelPair {
    let last = (size - 1) as f32;
    let x = ((u + 1.0) / 2.0 * last).clamp(0.0, last);
    let low = x.floor();
    TexelPair { low: low as u32, high: (low as u32 + 1).min(size as u32 - 1), fraction: x - low }
}

/// Returns how many rows at the start of a feature plane are not read at any time ≥ 0, so that they need not be stored.
/// A row holds the features at one time. Returns 0 for tensors that are not planes over an axis of space and time.
///
/// `name` is the name of the tensor that holds the plane, and `shape` its shape; `shape[2]` is the number of rows. The
/// rows cover the times −1 to 1, but models use times from 0 on, so about half of the rows are never read.
pub fn count_unread_time_rows(name: &str, shape: &[usize]) -> usize {
    let place = name.strip_prefix(GRIDS).and_then(|rest| rest.split_once('.')?.1.parse().ok());
    match (place, shape) {
        (Some(place), &[1, _, rows, _]) if rows > 0 && TEMPORAL.contains(&place) => texel_pair(0.0, rows).low as usize,
        _ => 0,
    }
}

/// Returns two texels of `line` (one line of a plane, with `channels` values per texel): the channels of the texels
/// `tap.low` and `tap.high`. Also returns the weight of the second texel for linear interpolation.
#[inline(always)]
pub(super) fn texels(line: &[f32], tap: TexelPair, channels: usize) -> ([&[f32]; 2], f32) {
    let texel = |at: u32| &line[at as usize * channels..][..channels];
    ([texel(tap.low), texel(tap.high)], tap.fraction)
}

impl Planes {
    /// Reads all planes and their box from the tensors `deformation_net.grid.*`.
    pub(super) fn load(lookup: Lookup<'_>) -> Result<Self> {
        const AABB: &str = "deformation_net.grid.aabb";
        let aabb = &lookup.get_shaped(AABB, &[Some(2), Some(3)], "the two corners of the field's box")?.data;
        let Some(space) = Box3::new(aabb) else {
            return Err(lookup.mismatch(AABB, "two corners that differ along every axis", format!("{aabb:?}")));
        };
        let name = |level: usize, plane: usize| format!("{GRIDS}{level}.{plane}");
        let mut levels = Vec::new();
        while levels.is_empty() || lookup.has(&name(levels.len(), 0)) {
            let level = levels.len();
            let (xy, channels) = FeaturePlane::load(lookup, &name(level, SPATIAL[0].0), None)?;
            let load = |plane| FeaturePlane::load(lookup, &name(level, plane), Some(channels)).map(|(plane, _)| plane);
            levels.push(Level {
                channels,
                spatial: [xy, load(SPATIAL[1].0)?, load(SPATIAL[2].0)?],
                temporal: [load(TEMPORAL[0])?, load(TEMPORAL[1])?, load(TEMPORAL[2])?],
            });
        }
        Ok(Planes { space, levels })
    }

    /// Returns the number of features per Gaussian: the number of channels summed over all levels (resolutions).
    pub(super) fn width(&self) -> usize {
        self.levels.iter().map(|level| level.channels).sum()
    }

    /// Returns the bytes of memory per Gaussian that [`PreparedPlanes`] takes, without slopes.
    pub(super) fn bytes_per_gaussian(&self) -> usize {
        4 * self.width() + 3 * self.levels.len() * size_of::<TexelPair>()
    }

    /// Returns the bytes of memory per Gaussian that the slopes of [`PreparedPlanes`] take.
    pub(super) fn slope_bytes_per_gaussian(&self) -> usize {
        3 * 4 * self.width()
    }

    /// Returns two corners of the box in scene units: the one mapped to normalized coordinates −1, then the one mapped
    /// to +1.
    pub(super) fn corners(&self) -> ([f32; 3], [f32; 3]) {
        let Box3 { origin, factor } = self.space;
        (origin, std::array::from_fn(|axis| origin[axis] + 2.0 / factor[axis]))
    }

    /// Computes the time-independent part of the features ([`PreparedPlanes`]) of Gaussians at the stored positions
    /// `position` (`[3, N]`).
    pub(super) fn prepare(&self, position: &AttributeValues) -> PreparedPlanes {
        vectorized(
            #[inline(always)]
            || self.prepare_rows(position),
        )
    }

    /// Computes the result of [`Planes::prepare`]. The compiler inlines this function into one copy per instruction
    /// set.
    #[inline(always)]
    fn prepare_rows(&self, position: &AttributeValues) -> PreparedPlanes {
        let rows = position.len();
        let width = self.width();
        let mut prepared = PreparedPlanes {
            product: vec![1.0; rows * width],
            taps: Vec::with_capacity(rows * 3 * self.levels.len()),
            slopes: Vec::new(),
        };
        let mut sample = vec![0.0; width];
        for (i, row) in prepared.product.chunks_exact_mut(width).enumerate() {
            let u = self.space.normalized(position.row(i));
            let mut rest = row;
            for level in &self.levels {
                let out;
                (out, rest) = rest.split_at_mut(level.channels);
                for (plane, &(_, a, b)) in level.spatial.iter().zip(&SPATIAL) {
                    let sample = &mut sample[..level.channels];
                    plane.sample(texel_pair(u[a], plane.size_a), texel_pair(u[b], plane.size_b), sample);
                    out.iter_mut().zip(&*sample).for_each(|(out, sample)| *out *= sample);
                }
                prepared.taps.extend(level.temporal.iter().zip(u).map(|(plane, u)| texel_pair(u, plane.size_a)));
            }
        }
        prepared
    }

    /// Interpolates the planes that have a time axis at the time `time`, so that each becomes a line of features along
    /// one axis of space. Returns, for every level (resolution), three lines: along x, y and z.
    pub(super) fn lines(&self, time: f32) -> Vec<TimeLines> {
        let line = |level: &Level, plane: &FeaturePlane| {
            let TexelPair { low, high, fraction } = texel_pair(time, plane.size_b);
            let row =
                |b: u32| &plane.texels[b as usize * plane.size_a * level.channels..][..plane.size_a * level.channels];
            row(low).iter().zip(row(high)).map(|(a, b)| a * (1.0 - fraction) + b * fraction).collect::<Vec<f32>>()
        };
        self.levels.iter().map(|level| std::array::from_fn(|axis| line(level, &level.temporal[axis]))).collect()
    }

    /// Computes the features of `lanes` Gaussians of the prepared block, from index `start` on, at one time. Writes
    /// them to `out` `[width, LANES]`; values of unused lanes are 0. `lines` are the planes with a time axis,
    /// interpolated at this time ([`Planes::lines`]).
    #[inline(always)]
    pub(super) fn features(
        &self,
        prepared: &PreparedPlanes,
        lines: &[TimeLines],
        start: usize,
        lanes: usize,
        out: &mut Vec<CacheLine>,
    ) {
        let width = self.width();
        out.clear();
        out.resize(width, CacheLine([0.0; LANES]));
        let product = &prepared.product[start * width..][..lanes * width];
        let taps = &prepared.taps[start * 3 * self.levels.len()..];
        let rows = product.chunks_exact(width).zip(taps.chunks_exact(3 * self.levels.len()));
        for (lane, (product, taps)) in rows.enumerate() {
            let mut first = 0;
            for ((level, [x, y, z]), taps) in self.levels.iter().zip(lines).zip(taps.chunks_exact(3)) {
                let n = level.channels;
                let (out, product) = (&mut out[first..][..n], &product[first..][..n]);
                let ([x0, x1], x) = texels(x, taps[0], n);
                let ([y0, y1], y) = texels(y, taps[1], n);
                let ([z0, z1], z) = texels(z, taps[2], n);
                // Multiplies the samples of all three axes in one loop: separate loops would read and write the row
                // three times.
                for c in 0..n {
                    let along_x = x0[c] * (1.0 - x) + x1[c] * x;
                    let along_y = y0[c] * (1.0 - y) + y1[c] * y;
                    let along_z = z0[c] * (1.0 - z) + z1[c] * z;
                    out[c].0[lane] = product[c] * along_x * along_y * along_z;
                }
                first += n;
            }
        }
    }
}
