//! The second walk over a tile: from what pixels take to what splats take.
//!
//! Front to back again, so that no list of what was blended has to be kept: of a pixel's rest of colour each splat
//! takes its own part away, and what is left is what lies behind it (method.md, section 8.1). Data in: the tile's
//! splats, ∂L/∂ pixel, and the pixels. Data out: nine sums per pair of a splat and the tile.

use std::f64::consts::LN_2;

use super::super::blend::{GROUPS, Ink, Plane, Stroke, lane_sum};
use super::super::convention::MAX_ALPHA;
use super::super::lanes::{LANES, Lanes};
use super::super::project::Splat;
use super::super::renderer::Image;

/// The largest alpha that was not cut.
const UNCUT: f32 = f32::from_bits(MAX_ALPHA.to_bits() - 1);

/// What one splat takes from pixels, f32 sums of a tile in a fixed order or f64 sums of those.
///
/// With p = alpha · ∂L/∂alpha and a pixel's offset (s, t) in standard deviations: t along v from the splat's centre, s
/// along u from the middle of the row. s² + t² is at most 2·ln 255, so no size of a splat makes a sum large.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums<T> {
    /// Σ p.
    pub(super) p: T,
    /// Σ p·s and Σ p·t.
    pub(super) first: [T; 2],
    /// Σ p·s², Σ p·s·t and Σ p·t².
    pub(super) second: [T; 3],
    /// Σ weight · ∂L/∂ pixel, by channel.
    pub(super) colour: [T; 3],
}

impl Sums<f64> {
    #[inline(always)]
    pub(super) fn add(&mut self, tile: &Sums<f32>) {
        self.p += f64::from(tile.p);
        (0..2).for_each(|k| self.first[k] += f64::from(tile.first[k]));
        (0..3).for_each(|k| self.second[k] += f64::from(tile.second[k]));
        (0..3).for_each(|k| self.colour[k] += f64::from(tile.colour[k]));
    }
}

/// What the pixels of a tile take, before the walk.
pub(super) struct Pull {
    /// ∂L/∂ pixel, by channel.
    pixel: [Plane; 3],
    /// Inner product of that with the pixel's colour.
    rest: Plane,
}

impl Pull {
    /// Of tile `tile` of `picture`. A pixel that is not finite, itself or in `pull`, takes nothing.
    pub(super) fn new(picture: &Image, pull: &Image, tile: [u32; 2]) -> Self {
        let (colour, mut pixel) = (picture.planes(tile), pull.planes(tile));
        let mut rest = [[0.0; LANES]; GROUPS];
        for group in 0..GROUPS {
            for lane in 0..LANES {
                let product: f32 = (0..3).map(|c| pixel[c][group][lane] * colour[c][group][lane]).sum();
                if product.is_finite() {
                    rest[group][lane] = product;
                } else {
                    (0..3).for_each(|c| pixel[c][group][lane] = 0.0);
                }
            }
        }
        Pull { pixel, rest }
    }
}

/// Sums what splats take; of their colours alone unless `SHAPE`.
pub(super) struct Pulled<'a, const SHAPE: bool> {
    pub(super) pull: Pull,
    /// One per pair of the tile.
    pub(super) pairs: &'a mut [Sums<f32>],
}

/// A splat that is walked over.
#[derive(Clone, Copy)]
pub(super) struct Walked<V> {
    colour: [V; 3],
    /// Standard deviations per pixel, along u and along v.
    per_pixel: [f32; 2],
    p: V,
    first: [V; 2],
    second: [V; 3],
    taken: [V; 3],
}

impl<const SHAPE: bool> Ink for Pulled<'_, SHAPE> {
    type Drop<V: Lanes> = Walked<V>;
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> Walked<V> {
        let zero = V::splat(0.0);
        // Exponents are in powers of two: half the square of an offset is ln 2 times one.
        let per_pixel = |exponent: f32| (exponent * 2.0 * LN_2 as f32).sqrt();
        Walked {
            colour: splat.colour.map(V::splat),
            per_pixel: [per_pixel(splat.narrow), per_pixel(splat.fall)],
            p: zero,
            first: [zero; 2],
            second: [zero; 3],
            taken: [zero; 3],
        }
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, mut walked: Walked<V>, group: usize, stroke: Stroke<V>) -> Walked<V> {
        let Stroke { alpha, blended, weight, across, down, .. } = stroke;
        let pixel: [V; 3] = std::array::from_fn(|c| V::load(&self.pull.pixel[c][group]));
        for (taken, pixel) in walked.taken.iter_mut().zip(pixel) {
            *taken = taken.add(weight.mul(pixel));
        }
        if !SHAPE {
            return walked;
        }
        let [red, green, blue] = walked.colour;
        let own = red.mul(pixel[0]).add(green.mul(pixel[1])).add(blue.mul(pixel[2]));
        let own = weight.mul(own);
        let rest = V::load(&self.pull.rest[group]).sub(own);
        rest.store(&mut self.pull.rest[group]);
        // alpha · (transmittance · own − rest / (1 − alpha)); an alpha that was cut moves nothing. The division waits
        // for alpha alone.
        let odds = alpha.div(V::splat(1.0).sub(alpha));
        let moves = blended.and(V::splat(UNCUT).at_least(alpha));
        let p = own.sub(odds.mul(rest)).and(moves);
        let down = V::splat(down);
        let (px, py) = (p.mul(across), p.mul(down));
        walked.p = walked.p.add(p);
        walked.first = [walked.first[0].add(px), walked.first[1].add(py)];
        let [xx, xy, yy] = walked.second;
        walked.second = [xx.add(px.mul(across)), xy.add(px.mul(down)), yy.add(py.mul(down))];
        walked
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, walked: Walked<V>, pair: usize) {
        let colour = walked.taken.map(lane_sum);
        self.pairs[pair] = if SHAPE {
            let [per_x, per_y] = walked.per_pixel;
            let ([x, y], [xx, xy, yy]) = (walked.first.map(lane_sum), walked.second.map(lane_sum));
            Sums {
                p: lane_sum(walked.p),
                first: [x * per_x, y * per_y],
                second: [xx * per_x * per_x, xy * per_x * per_y, yy * per_y * per_y],
                colour,
            }
        } else {
            Sums { colour, ..Sums::default() }
        };
    }
}
