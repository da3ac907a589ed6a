//! The second walk over a tile: from what pixels take to what splats take.
//!
//! Front to back again, so that no list of what was blended has to be kept: of a pixel's rest of color each splat
//! takes its own part away, and what is left is what lies behind it (method.md, section 8.1). Data in: the tile's
//! splats, ∂L/∂ pixel, and the pixels. Data out: nine sums per pair of a splat and the tile.

use super::super::blend::{BlendSink, Fragment, GROUPS, TilePlane};
use super::super::convention::{MAX_ALPHA, TILE};
use super::super::lanes::{LANES, Lanes, Sums as _, Twins};
use super::super::project::Splat;
use super::super::renderer::Image;
use super::sums::SplatSums;

/// The largest alpha that was not cut.
const UNCUT: f32 = f32::from_bits(MAX_ALPHA.to_bits() - 1);

/// What the pixels of a tile take, before the walk.
pub(super) struct Pull {
    /// ∂L/∂ pixel, by channel.
    pixel: [TilePlane; 3],
    /// Inner product of that with the pixel's color.
    rest: TilePlane,
}

impl Pull {
    /// Of tile `tile` of `picture`. A pixel that is not finite, itself or in `pull`, takes nothing.
    pub(super) fn new(picture: &Image, pull: &Image, tile: [u32; 2]) -> Self {
        // Copied first: the copies wait for memory together, one pixel after the other would wait alone.
        let (colors, pulls) = (picture.tile(tile), pull.tile(tile));
        let (mut pixel, mut rest) = ([TilePlane::default(); 3], TilePlane::default());
        for group in 0..GROUPS {
            let (v, first) = (group % TILE as usize, group / TILE as usize * LANES);
            for lane in 0..LANES {
                let (color, pull) = (colors[v][first + lane], pulls[v][first + lane]);
                let product = color[0] * pull[0] + color[1] * pull[1] + color[2] * pull[2];
                if product.is_finite() {
                    rest[group][lane] = product;
                    (0..3).for_each(|c| pixel[c][group][lane] = pull[c]);
                }
            }
        }
        Pull { pixel, rest }
    }
}

/// Sums what splats take; of their colors alone unless `SHAPE`.
pub(super) struct Pulled<'a, const SHAPE: bool> {
    pub(super) pull: Pull,
    /// One per pair of the tile.
    pub(super) pairs: &'a mut [SplatSums<f32>],
}

/// A splat that is walked over.
#[derive(Clone, Copy)]
pub(super) struct Walked<V: Lanes> {
    color: [V; 3],
    p: V::Twins,
    first: [V::Twins; 2],
    second: [V::Twins; 3],
    taken: [V::Twins; 3],
}

impl<const SHAPE: bool> BlendSink for Pulled<'_, SHAPE> {
    type Drop<V: Lanes> = Walked<V>;
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> Walked<V> {
        let zero = V::Twins::zero();
        Walked { color: splat.color.map(V::splat), p: zero, first: [zero; 2], second: [zero; 3], taken: [zero; 3] }
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, mut walked: Walked<V>, group: usize, stroke: Fragment<V>) -> Walked<V> {
        let Fragment { alpha, blended, weight, across, down, .. } = stroke;
        let by_color: [V; 3] = std::array::from_fn(|c| weight.mul(V::load(&self.pull.pixel[c], group)));
        for (taken, by_color) in walked.taken.iter_mut().zip(by_color) {
            *taken = by_color.add_to_own(*taken);
        }
        if !SHAPE {
            return walked;
        }
        let [red, green, blue] = walked.color;
        let own = red.mul(by_color[0]).add(green.mul(by_color[1])).add(blue.mul(by_color[2]));
        let rest = V::load(&self.pull.rest, group).sub(own);
        rest.store(&mut self.pull.rest, group);
        // alpha · (transmittance · own − rest / (1 − alpha)); an alpha that was cut moves nothing. The division waits
        // for alpha alone.
        let odds = alpha.div(V::splat(1.0).sub(alpha));
        let moves = V::both(blended, V::splat(UNCUT).at_least(alpha));
        let p = own.sub(odds.mul(rest)).keep(moves);
        let (px, py) = (p.mul(across), p.mul(down));
        walked.p = p.add_to_own(walked.p);
        walked.first = [px.add_to_own(walked.first[0]), py.add_to_own(walked.first[1])];
        let [xx, xy, yy] = walked.second;
        walked.second = [px.mul(across).add_to_own(xx), px.mul(down).add_to_own(xy), py.mul(down).add_to_own(yy)];
        walked
    }
    const TURNS: bool = true;
    #[inline(always)]
    fn turn<V: Lanes>(&self, walked: Walked<V>) -> Walked<V> {
        // Not `array::map`, here and below: it is compiled apart, for the plainest machine.
        let Walked { color, p, first: [x, y], second: [xx, xy, yy], taken: [red, green, blue] } = walked;
        Walked {
            color,
            p: p.turned(),
            first: [x.turned(), y.turned()],
            second: [xx.turned(), xy.turned(), yy.turned()],
            taken: [red.turned(), green.turned(), blue.turned()],
        }
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, walked: Walked<V>, pair: usize) {
        let Walked { p, first: [x, y], second: [xx, xy, yy], taken: [red, green, blue], .. } = walked;
        self.pairs[pair] = if SHAPE {
            let (x, y, xx, xy, yy) = (x.together(), y.together(), xx.together(), xy.together(), yy.together());
            let (red, green, blue) = (red.together(), green.together(), blue.together());
            let [x, y, xx, xy, yy, red, green, blue] = V::Sums::totals([x, y, xx, xy, yy, red, green, blue]);
            SplatSums { p: p.together().total(), first: [x, y], second: [xx, xy, yy], color: [red, green, blue] }
        } else {
            let color = [red.together().total(), green.together().total(), blue.together().total()];
            SplatSums { color, ..SplatSums::default() }
        };
    }
}
