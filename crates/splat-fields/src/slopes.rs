//! HexPlane features (products of samples of six feature planes) and their derivatives with respect to position.
//!
//! Input: the stored positions of a group of Gaussians, their time-independent results ([`PreparedPlanes`]), and the
//! planes with a time axis, interpolated at one time. Output: features `[Σ channels, LANES]`, and their derivatives
//! along x, y and z: three arrays of the same size.
//!
//! A feature is the product of six samples, one per plane. Its derivative along an axis is a sum of three terms, one
//! for each plane with this axis: the derivative of the sample of this plane times the other five samples. Coordinates
//! outside the box are clamped, so derivatives are 0 there. The parts of the derivatives that depend only on the planes
//! without time are computed once per block of Gaussians ([`Planes::slopes_in_space`]).

use super::linear::{CacheLine, LANES};
use super::planes::{FeaturePlane, Planes, PreparedPlanes, SPATIAL, TimeLines, texel_pair, texels};
use splat_core::AttributeValues;

/// Returns how many texels (grid points of a feature plane) lie in one unit of the normalized coordinate `u` along an
/// axis of `size` texels. This factor converts derivatives per texel to derivatives with respect to `u`. Returns 0
/// where [`texel_pair`] clamps `u`, beyond ±1.
fn texels_per_unit(u: f32, size: usize) -> f32 {
    if u.abs() <= 1.0 { (size - 1) as f32 / 2.0 } else { 0.0 }
}

/// Number of channels of a feature plane whose derivatives are computed together.
const CHANNEL_CHUNK: usize = 8;

/// Returns [`CHANNEL_CHUNK`] values of `channels` from index `first` on, filled up with zeros at the end of the list.
#[inline(always)]
fn channel_chunk(channels: &[f32], first: usize) -> [f32; CHANNEL_CHUNK] {
    let rest = &channels[first..];
    match rest.first_chunk() {
        Some(whole) => *whole,
        None => {
            let mut padded = [0.0; CHANNEL_CHUNK];
            padded[..rest.len()].copy_from_slice(rest);
            padded
        }
    }
}

/// Four texels (grid points) of a feature plane around a point, with the data for bilinear interpolation between them.
struct BilinearPatch<'a> {
    /// Features of the four texels (low a, low b), (high a, low b), (low a, high b), (high a, high b), where a and b
    /// are the axes of the plane, and each texel has one value per channel.
    corners: [&'a [f32]; 4],
    /// Weights of the texels with the higher index, for interpolation along the axes a and b of the plane.
    fractions: [f32; 2],
    /// Number of texels in one unit of the normalized coordinate, along the axes a and b of the plane. 0 along an axis
    /// on which the coordinate was clamped.
    per_unit: [f32; 2],
}

impl<'a> BilinearPatch<'a> {
    #[inline(always)]
    fn new(plane: &'a FeaturePlane, [a, b]: [f32; 2], channels: usize) -> Self {
        let (tap_a, tap_b) = (texel_pair(a, plane.size_a), texel_pair(b, plane.size_b));
        let corner = |a, b| plane.texel(a, b, channels);
        let at_low = [corner(tap_a.low, tap_b.low), corner(tap_a.high, tap_b.low)];
        let at_high = [corner(tap_a.low, tap_b.high), corner(tap_a.high, tap_b.high)];
        BilinearPatch {
            corners: [at_low[0], at_low[1], at_high[0], at_high[1]],
            fractions: [tap_a.fraction, tap_b.fraction],
            per_unit: [texels_per_unit(a, plane.size_a), texels_per_unit(b, plane.size_b)],
        }
    }

    /// Returns three lists of [`CHANNEL_CHUNK`] channels, from channel `first` on: the bilinearly interpolated values,
    /// their derivatives along the first axis of the plane, and their derivatives along its second axis. Derivatives
    /// are with respect to normalized coordinates.
    #[inline(always)]
    fn sample_with_slopes(&self, first: usize) -> [[f32; CHANNEL_CHUNK]; 3] {
        let [ll, hl] = [channel_chunk(self.corners[0], first), channel_chunk(self.corners[1], first)];
        let [lh, hh] = [channel_chunk(self.corners[2], first), channel_chunk(self.corners[3], first)];
        let ([a, b], [per_a, per_b]) = (self.fractions, self.per_unit);
        let mut out = [[0.0; CHANNEL_CHUNK]; 3];
        for c in 0..CHANNEL_CHUNK {
            let (low, high) = (ll[c] + a * (hl[c] - ll[c]), lh[c] + a * (hh[c] - lh[c]));
            out[0][c] = low + b * (high - low);
            out[1][c] = per_a * ((1.0 - b) * (hl[c] - ll[c]) + b * (hh[c] - lh[c]));
            out[2][c] = per_b * (high - low);
        }
        out
    }
}

/// Two neighboring texels (grid points) on a line of features along one axis of space, with the data for linear
/// interpolation between them. The line comes from a feature plane over this axis and time, interpolated at one time.
struct TimeLineSegment<'a> {
    ends: [&'a [f32]; 2],
    fraction: f32,
    per_unit: f32,
}

impl TimeLineSegment<'_> {
    /// Interpolates the features linearly between the two texels (grid points), at the position of a Gaussian. Returns
    /// two lists with [`CHANNEL_CHUNK`] channels each, from channel `first` on:
    /// - the interpolated features;
    /// - their derivatives with respect to the position along the spatial axis of the line, in normalized coordinates
    ///   (−1 to 1 inside the box that the feature planes cover).
    #[inline(always)]
    fn sample_with_slopes(&self, first: usize) -> [[f32; CHANNEL_CHUNK]; 2] {
        let [low, high] = [channel_chunk(self.ends[0], first), channel_chunk(self.ends[1], first)];
        let mut out = [[0.0; CHANNEL_CHUNK]; 2];
        for c in 0..CHANNEL_CHUNK {
            out[0][c] = low[c] + self.fraction * (high[c] - low[c]);
            out[1][c] = self.per_unit * (high[c] - low[c]);
        }
        out
    }
}

impl Planes {
    /// Returns the derivatives of the product of the samples of the three planes without time, with respect to the
    /// normalized coordinates: `[N, 3, width]`, for Gaussians at the stored positions `position` (`[3, N]`).
    pub(super) fn slopes_in_space(&self, position: &AttributeValues) -> Vec<f32> {
        let width = self.width();
        let mut slopes = vec![0.0; 3 * width * position.len()];
        for (i, row) in slopes.chunks_exact_mut(3 * width).enumerate() {
            let u = self.space.normalized(position.row(i));
            let mut before = 0;
            for level in &self.levels {
                let n = level.channels;
                let patch = |k: usize| {
                    let (_, a, b) = SPATIAL[k];
                    BilinearPatch::new(&level.spatial[k], [u[a], u[b]], n)
                };
                let [xy, xz, yz] = [patch(0), patch(1), patch(2)];
                for first in (0..n).step_by(CHANNEL_CHUNK) {
                    let ([xy, xy_x, xy_y], [xz, xz_x, xz_z]) =
                        (xy.sample_with_slopes(first), xz.sample_with_slopes(first));
                    let [yz, yz_y, yz_z] = yz.sample_with_slopes(first);
                    for c in 0..CHANNEL_CHUNK.min(n - first) {
                        let channel = before + first + c;
                        row[channel] = yz[c] * (xy_x[c] * xz[c] + xy[c] * xz_x[c]);
                        row[width + channel] = xz[c] * (xy_y[c] * yz[c] + xy[c] * yz_y[c]);
                        row[2 * width + channel] = xy[c] * (xz_z[c] * yz[c] + xz[c] * yz_z[c]);
                    }
                }
                before += n;
            }
        }
        slopes
    }

    /// Computes the plane features of up to [`LANES`] Gaussians at one time, and their derivatives with respect to the
    /// position.
    ///
    /// - `x`, `y`, `z`: positions of the Gaussians, scene units.
    /// - `prepared`: time-independent results of a block of Gaussians, with slopes; `start`: index in this block of the
    ///   first of the Gaussians.
    /// - `lines`: the planes with a time axis, interpolated at this time ([`Planes::lines`]).
    /// - `features`: receives the features. Values of unused lanes are unspecified.
    /// - `slopes`: receives the derivatives of the features with respect to x, y and z.
    #[inline(always)]
    pub(super) fn features_with_slopes(
        &self,
        [x, y, z]: [&[f32]; 3],
        (prepared, start): (&PreparedPlanes, usize),
        lines: &[TimeLines],
        features: &mut Vec<CacheLine>,
        slopes: &mut [Vec<CacheLine>; 3],
    ) {
        let (width, tap_count) = (self.width(), 3 * self.levels.len());
        for out in slopes.iter_mut().chain([&mut *features]) {
            out.resize(width, CacheLine([0.0; LANES]));
        }
        let rows = prepared.product[start * width..].chunks_exact(width);
        let rows = rows.zip(prepared.slopes[3 * start * width..].chunks_exact(3 * width));
        let rows = rows.zip(prepared.taps[start * tap_count..].chunks_exact(tap_count));
        for (lane, (((&x, &y), &z), ((product, spatial), taps))) in x.iter().zip(y).zip(z).zip(rows).enumerate() {
            let u = self.space.normalized([x, y, z]);
            let spatial = [0, 1, 2].map(|axis| &spatial[axis * width..][..width]);
            let mut before = 0;
            for ((level, lines), taps) in self.levels.iter().zip(lines).zip(taps.chunks_exact(3)) {
                let n = level.channels;
                let section = |axis: usize| {
                    let (ends, fraction) = texels(&lines[axis], taps[axis], n);
                    let per_unit = texels_per_unit(u[axis], level.temporal[axis].size_a);
                    TimeLineSegment { ends, fraction, per_unit }
                };
                let [xt, yt, zt] = [section(0), section(1), section(2)];
                for first in (0..n).step_by(CHANNEL_CHUNK) {
                    let ([xt, xt_x], [yt, yt_y]) = (xt.sample_with_slopes(first), yt.sample_with_slopes(first));
                    let [zt, zt_z] = zt.sample_with_slopes(first);
                    // Values beyond this level are not used.
                    let product = channel_chunk(product, before + first);
                    let spatial = spatial.map(|values| channel_chunk(values, before + first));
                    let (mut along, mut feature) = ([[0.0; CHANNEL_CHUNK]; 3], [0.0; CHANNEL_CHUNK]);
                    for c in 0..CHANNEL_CHUNK {
                        let time = xt[c] * yt[c] * zt[c];
                        along[0][c] = time * spatial[0][c] + product[c] * yt[c] * zt[c] * xt_x[c];
                        along[1][c] = time * spatial[1][c] + product[c] * xt[c] * zt[c] * yt_y[c];
                        along[2][c] = time * spatial[2][c] + product[c] * xt[c] * yt[c] * zt_z[c];
                        feature[c] = product[c] * time;
                    }
                    let channels = before + first..before + n.min(first + CHANNEL_CHUNK);
                    for (axis, out) in slopes.iter_mut().enumerate() {
                        for (out, slope) in out[channels.clone()].iter_mut().zip(along[axis]) {
                            out.0[lane] = self.space.factor[axis] * slope;
                        }
                    }
                    for (out, feature) in features[channels].iter_mut().zip(feature) {
                        out.0[lane] = feature;
                    }
                }
                before += n;
            }
        }
    }
}
