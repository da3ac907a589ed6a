//! HexPlane features with their derivatives by position.
//!
//! Data in: canonical positions of a group, the time planes at one time. Data out: features `[Σ channels, LANES]`, and
//! as much for each axis. A feature is a product of six samples, so each derivative is a sample's times the other five.
//! What lies outside the box along an axis is clipped and does not change with it. Memory: the stack.

use super::linear::{CacheLine, LANES};
use super::planes::{FeaturePlane, Planes, SPATIAL, TimeLines, tap, texels};

/// Texels per unit of normalized coordinate `u` on `size` of them; 0 where [`tap`] clips it.
fn texels_per_unit(u: f32, size: usize) -> f32 {
    if u.abs() <= 1.0 { (size - 1) as f32 / 2.0 } else { 0.0 }
}

/// Channels whose derivatives are made together.
const CHUNK: usize = 8;

/// The channels of one sample from `first` on, 0 beyond the last.
#[inline(always)]
fn chunk(channels: &[f32], first: usize) -> [f32; CHUNK] {
    let rest = &channels[first..];
    match rest.first_chunk() {
        Some(whole) => *whole,
        None => {
            let mut padded = [0.0; CHUNK];
            padded[..rest.len()].copy_from_slice(rest);
            padded
        }
    }
}

/// Four texels that two taps lie between.
struct Patch<'a> {
    /// Low and high along a, at low b, then at high b.
    corners: [&'a [f32]; 4],
    fractions: [f32; 2],
    per_unit: [f32; 2],
}

impl<'a> Patch<'a> {
    #[inline(always)]
    fn new(plane: &'a FeaturePlane, [a, b]: [f32; 2], channels: usize) -> Self {
        let (tap_a, tap_b) = (tap(a, plane.size_a), tap(b, plane.size_b));
        let corner = |a, b| plane.texel(a, b, channels);
        let at_low = [corner(tap_a.low, tap_b.low), corner(tap_a.high, tap_b.low)];
        let at_high = [corner(tap_a.low, tap_b.high), corner(tap_a.high, tap_b.high)];
        Patch {
            corners: [at_low[0], at_low[1], at_high[0], at_high[1]],
            fractions: [tap_a.fraction, tap_b.fraction],
            per_unit: [texels_per_unit(a, plane.size_a), texels_per_unit(b, plane.size_b)],
        }
    }

    /// Channels from `first` on of the bilinear sample, and of its derivatives by both normalized coordinates.
    #[inline(always)]
    fn sloped(&self, first: usize) -> [[f32; CHUNK]; 3] {
        let [ll, hl] = [chunk(self.corners[0], first), chunk(self.corners[1], first)];
        let [lh, hh] = [chunk(self.corners[2], first), chunk(self.corners[3], first)];
        let ([a, b], [per_a, per_b]) = (self.fractions, self.per_unit);
        let mut out = [[0.0; CHUNK]; 3];
        for c in 0..CHUNK {
            let (low, high) = (ll[c] + a * (hl[c] - ll[c]), lh[c] + a * (hh[c] - lh[c]));
            out[0][c] = low + b * (high - low);
            out[1][c] = per_a * ((1.0 - b) * (hl[c] - ll[c]) + b * (hh[c] - lh[c]));
            out[2][c] = per_b * (high - low);
        }
        out
    }
}

/// Two texels of a time line that a tap lies between.
struct Section<'a> {
    ends: [&'a [f32]; 2],
    fraction: f32,
    per_unit: f32,
}

impl Section<'_> {
    /// Channels from `first` on of the sample, and of its derivative by the normalized coordinate.
    #[inline(always)]
    fn sloped(&self, first: usize) -> [[f32; CHUNK]; 2] {
        let [low, high] = [chunk(self.ends[0], first), chunk(self.ends[1], first)];
        let mut out = [[0.0; CHUNK]; 2];
        for c in 0..CHUNK {
            out[0][c] = low[c] + self.fraction * (high[c] - low[c]);
            out[1][c] = self.per_unit * (high[c] - low[c]);
        }
        out
    }
}

impl Planes {
    /// Writes features and slopes, by axis, of the Gaussians at `places`, by axis and at most [`LANES`] long; lanes
    /// beyond them hold nothing of meaning.
    #[inline(always)]
    pub(super) fn sloped(
        &self,
        [x, y, z]: [&[f32]; 3],
        lines: &[TimeLines],
        features: &mut Vec<CacheLine>,
        slopes: &mut [Vec<CacheLine>; 3],
    ) {
        let width = self.width();
        for out in slopes.iter_mut().chain([&mut *features]) {
            out.resize(width, CacheLine([0.0; LANES]));
        }
        for (lane, ((&x, &y), &z)) in x.iter().zip(y).zip(z).enumerate() {
            let u = self.space.normalized([x, y, z]);
            let mut before = 0;
            for (level, lines) in self.levels.iter().zip(lines) {
                let n = level.channels;
                let patch = |k: usize| Patch::new(&level.spatial[k], [u[SPATIAL[k].1], u[SPATIAL[k].2]], n);
                let section = |axis: usize| {
                    let size = level.temporal[axis].size_a;
                    let (ends, fraction) = texels(&lines[axis], tap(u[axis], size), n);
                    Section { ends, fraction, per_unit: texels_per_unit(u[axis], size) }
                };
                let [xy, xz, yz] = [patch(0), patch(1), patch(2)];
                let [xt, yt, zt] = [section(0), section(1), section(2)];
                for first in (0..n).step_by(CHUNK) {
                    let ([xy, xy_x, xy_y], [xz, xz_x, xz_z]) = (xy.sloped(first), xz.sloped(first));
                    let ([yz, yz_y, yz_z], [xt, xt_x]) = (yz.sloped(first), xt.sloped(first));
                    let ([yt, yt_y], [zt, zt_z]) = (yt.sloped(first), zt.sloped(first));
                    let mut found = [[0.0; CHUNK]; 4];
                    for c in 0..CHUNK {
                        let (space, time) = (xy[c] * xz[c] * yz[c], xt[c] * yt[c] * zt[c]);
                        found[0][c] =
                            time * yz[c] * (xy_x[c] * xz[c] + xy[c] * xz_x[c]) + space * yt[c] * zt[c] * xt_x[c];
                        found[1][c] =
                            time * xz[c] * (xy_y[c] * yz[c] + xy[c] * yz_y[c]) + space * xt[c] * zt[c] * yt_y[c];
                        found[2][c] =
                            time * xy[c] * (xz_z[c] * yz[c] + xz[c] * yz_z[c]) + space * xt[c] * yt[c] * zt_z[c];
                        found[3][c] = space * time;
                    }
                    let place = before + first..before + n.min(first + CHUNK);
                    for (axis, out) in slopes.iter_mut().enumerate() {
                        for (out, found) in out[place.clone()].iter_mut().zip(found[axis]) {
                            out.0[lane] = self.space.factor[axis] * found;
                        }
                    }
                    for (out, found) in features[place].iter_mut().zip(found[3]) {
                        out.0[lane] = found;
                    }
                }
                before += n;
            }
        }
    }
}
