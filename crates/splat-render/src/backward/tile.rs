//! Backward pass over a tile: computes, from ∂L/∂pixel for a loss L, the gradient sums of each splat ([`SplatSums`]),
//! from which the derivatives of L with respect to its Gaussian follow.
//!
//! The pass runs front to back again, so that no list of blended splats has to be kept. Each splat subtracts its weight
//! times its color from the color of a pixel. The remaining color comes from behind the splat (docs/method.md, section
//! 8.1). Input: the splats of the tile, ∂L/∂pixel, and the pixels. Output: nine sums per splat of the tile
//! ([`SplatSums`]). A variable `by_x` holds the derivative of the loss with respect to `x`.

use super::super::blend::{BlendSink, Fragment, GROUPS, TilePlane};
use super::super::convention::{MAX_ALPHA, TILE};
use super::super::lanes::{EvenOddSums, LANES, Lanes, Sums as _};
use super::super::project::Splat;
use super::super::renderer::Image;
use super::sums::SplatSums;

/// Largest alpha that is not clamped: the largest f32 below [`MAX_ALPHA`]. An alpha above it has been clamped to
/// `MAX_ALPHA`, so its derivative counts as 0.
const MAX_UNCLAMPED_ALPHA: f32 = f32::from_bits(MAX_ALPHA.to_bits() - 1);

/// Gradients ∂L/∂pixel of the loss with respect to the pixels of a tile, and for each pixel the color that comes from
/// behind the splats processed so far.
pub(super) struct PixelGradients {
    /// Derivatives ∂L/∂pixel of the loss L, one plane per color channel.
    pixel: [TilePlane; 3],
    /// Scalar product, for each pixel, of ∂L/∂pixel and the color that comes from behind the splats processed so far.
    rest: TilePlane,
}

impl PixelGradients {
    /// Copies the pixels in tile column `tile[0]` and tile row `tile[1]` from `image` and from `gradient`, the
    /// derivative of the loss with respect to each value of `image`. A pixel whose color or gradient is not finite gets
    /// gradient 0.
    pub(super) fn new(image: &Image, gradient: &Image, tile: [u32; 2]) -> Self {
        // Copies whole tiles first: their reads wait for memory at the same time, whereas reads of single pixels would
        // wait one by one.
        let (colors, gradients) = (image.tile(tile), gradient.tile(tile));
        let (mut pixel, mut rest) = ([TilePlane::default(); 3], TilePlane::default());
        for group in 0..GROUPS {
            let (v, first) = (group % TILE as usize, group / TILE as usize * LANES);
            for lane in 0..LANES {
                let (color, gradient) = (colors[v][first + lane], gradients[v][first + lane]);
                let product = color[0] * gradient[0] + color[1] * gradient[1] + color[2] * gradient[2];
                if product.is_finite() {
                    rest[group][lane] = product;
                    (0..3).for_each(|c| pixel[c][group][lane] = gradient[c]);
                }
            }
        }
        PixelGradients { pixel, rest }
    }
}

/// Receiver of weights (alpha · transmittance of each splat) that computes, for each splat of a tile, the sums over
/// pixels from which its gradients follow. If `SHAPE` is false, it computes only the sums for the gradients of colors.
pub(super) struct GradientSink<'a, const SHAPE: bool> {
    pub(super) gradients: PixelGradients,
    /// For each splat of the tile, the sums over the pixels of the tile from which its gradients follow.
    pub(super) pairs: &'a mut [SplatSums<f32>],
}

/// Color of the splat that is being processed, and its sums over the pixels so far; see [`SplatSums`] for the sums.
#[derive(Clone, Copy)]
pub(super) struct SplatAccumulator<V: Lanes> {
    color: [V; 3],
    p: V::EvenOddSums,
    first: [V::EvenOddSums; 2],
    second: [V::EvenOddSums; 3],
    color_sums: [V::EvenOddSums; 3],
}

impl<const SHAPE: bool> BlendSink for GradientSink<'_, SHAPE> {
    type Accumulator<V: Lanes> = SplatAccumulator<V>;
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> SplatAccumulator<V> {
        let zero = V::EvenOddSums::zero();
        SplatAccumulator {
            color: splat.color.map(V::splat),
            p: zero,
            first: [zero; 2],
            second: [zero; 3],
            color_sums: [zero; 3],
        }
    }
    #[inline(always)]
    fn add<V: Lanes>(
        &mut self,
        mut accumulator: SplatAccumulator<V>,
        group: usize,
        fragment: Fragment<V>,
    ) -> SplatAccumulator<V> {
        let Fragment { alpha, blended, weight, offset_x, offset_y, .. } = fragment;
        let by_color: [V; 3] = std::array::from_fn(|c| weight.mul(V::load(&self.gradients.pixel[c], group)));
        for (color_sums, by_color) in accumulator.color_sums.iter_mut().zip(by_color) {
            *color_sums = by_color.add_to_even_odd(*color_sums);
        }
        if !SHAPE {
            return accumulator;
        }
        let [red, green, blue] = accumulator.color;
        let own = blue.mul_add(by_color[2], green.mul_add(by_color[1], red.mul(by_color[0])));
        let rest = V::load(&self.gradients.rest, group).sub(own);
        rest.store(&mut self.gradients.rest, group);
        // p = alpha · ∂L/∂alpha = own − rest · alpha / (1 − alpha). A clamped alpha has gradient 0. The division
        // depends only on alpha, so it can start early.
        let odds = alpha.div(V::splat(1.0).sub(alpha));
        let unclamped = V::both(blended, V::splat(MAX_UNCLAMPED_ALPHA).at_least(alpha));
        let p = odds.neg_mul_add(rest, own).keep(unclamped);
        let (px, py) = (p.mul(offset_x), p.mul(offset_y));
        accumulator.p = p.add_to_even_odd(accumulator.p);
        accumulator.first = [px.add_to_even_odd(accumulator.first[0]), py.add_to_even_odd(accumulator.first[1])];
        let [xx, xy, yy] = accumulator.second;
        accumulator.second = [
            px.mul(offset_x).add_to_even_odd(xx),
            px.mul(offset_y).add_to_even_odd(xy),
            py.mul(offset_y).add_to_even_odd(yy),
        ];
        accumulator
    }
    const SPLITS_EVEN_ODD: bool = true;
    #[inline(always)]
    fn swap_even_odd<V: Lanes>(&self, accumulator: SplatAccumulator<V>) -> SplatAccumulator<V> {
        // Not `array::map`, here and below: it is compiled as a separate function, without the wider instructions.
        let SplatAccumulator { color, p, first: [x, y], second: [xx, xy, yy], color_sums: [red, green, blue] } =
            accumulator;
        SplatAccumulator {
            color,
            p: p.swapped(),
            first: [x.swapped(), y.swapped()],
            second: [xx.swapped(), xy.swapped(), yy.swapped()],
            color_sums: [red.swapped(), green.swapped(), blue.swapped()],
        }
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, accumulator: SplatAccumulator<V>, pair: usize) {
        let SplatAccumulator { p, first: [x, y], second: [xx, xy, yy], color_sums: [red, green, blue], .. } =
            accumulator;
        self.pairs[pair] = if SHAPE {
            let (x, y, xx, xy, yy) = (x.combined(), y.combined(), xx.combined(), xy.combined(), yy.combined());
            let (red, green, blue) = (red.combined(), green.combined(), blue.combined());
            let [x, y, xx, xy, yy, red, green, blue] = V::Sums::totals([x, y, xx, xy, yy, red, green, blue]);
            SplatSums { p: p.combined().total(), first: [x, y], second: [xx, xy, yy], color: [red, green, blue] }
        } else {
            let color = [red.combined().total(), green.combined().total(), blue.combined().total()];
            SplatSums { color, ..SplatSums::default() }
        };
    }
}
