//! A picture as a linear map: from changes of colour to changes of pixels, and back.
//!
//! With positions, shapes and opacities fixed, a pixel is Σ w·colour + what is left · background, where
//! w = alpha · transmittance does not depend on colour. So a change δ of colours changes the picture by
//! A·δ, and least squares over colours needs A·δ and Aᵀ·picture only, both of which the blend gives; A is
//! never formed. Data in: one frame's Gaussians and a camera. Data out: sums per visible Gaussian.
//! Memory: [`BYTES_PER_VISIBLE`](super::BYTES_PER_VISIBLE) and 4 bytes per (Gaussian, tile) pair of a strip, as
//! long as the operator is kept.

use super::bin::Bins;
use super::blend::{Blend, GROUPS, Ink, Lattice, Plane, Stroke, lane_sum};
use super::lanes::{LANES, Lanes};
use super::project::{Splat, Splats, View};
use super::renderer::{Image, Renderer};
use crate::model::{Camera, Gaussians};

/// What one camera sees of Gaussians whose colours may change.
///
/// A channel that is cut off at 0 here, because its spherical harmonics go below, counts as one that no
/// change moves: the map is that of small changes.
#[derive(Debug)]
pub struct ColorOperator {
    blend: Blend,
    splats: Splats,
    /// All pairs ready if one strip holds them.
    bins: Bins,
    size: [u32; 2],
    strip_pairs: usize,
}

/// Red, green and blue of every visible Gaussian of a [`ColorOperator`].
#[derive(Debug, Clone, PartialEq)]
pub struct PerVisible(Vec<[f64; 3]>);

impl ColorOperator {
    /// What `camera` sees of `gaussians`.
    ///
    /// # Panics
    /// If the columns of `gaussians` differ in length.
    pub fn new(gaussians: &Gaussians, camera: &Camera) -> Self {
        Self::with(Renderer::new(), gaussians, camera)
    }

    pub(super) fn with(mut renderer: Renderer, gaussians: &Gaussians, camera: &Camera) -> Self {
        let view = View::new(camera);
        renderer.prepare(gaussians, &view, true);
        renderer.bins.next_strip(&renderer.splats, renderer.strip_pairs);
        let Renderer { blend, splats, bins, strip_pairs, .. } = renderer;
        ColorOperator { blend, splats, bins, size: view.size, strip_pairs }
    }

    /// Aᵀ·`picture`: of every visible Gaussian Σ over pixels of w · pixel, per channel; f32 within a tile,
    /// in a fixed order.
    ///
    /// # Panics
    /// If `picture` has not the camera's size.
    pub fn transposed(&self, picture: &Image) -> PerVisible {
        assert_eq!([picture.width, picture.height], self.size, "a picture of another size");
        self.per_splat(|tile, lattice, pairs, sums| {
            let planes = picture.planes(tile);
            self.blend.tile(&self.splats.splats, pairs, lattice, &mut Weighed { planes: &planes, pairs: sums });
        })
    }

    /// AᵀA·`change`, with `change` `[N]` red, green and blue of every Gaussian, visible or not.
    ///
    /// # Panics
    /// If `change` is shorter than the Gaussians that were seen.
    pub fn normal(&self, change: &[[f32; 3]]) -> PerVisible {
        self.per_splat(|_, lattice, pairs, sums| {
            let mut made = Change { change, planes: [[[0.0; LANES]; GROUPS]; 3] };
            self.blend.tile(&self.splats.splats, pairs, lattice, &mut made);
            self.blend.tile(&self.splats.splats, pairs, lattice, &mut Weighed { planes: &made.planes, pairs: sums });
        })
    }

    /// The diagonal of AᵀA: of every visible Gaussian Σ over pixels of w².
    pub fn diagonal(&self) -> PerVisible {
        self.per_splat(|_, lattice, pairs, sums| {
            self.blend.tile(&self.splats.splats, pairs, lattice, &mut Power { pairs: sums });
        })
    }

    /// Adds `sums`, which this operator made, to `[N]` totals.
    ///
    /// # Panics
    /// If `total` is shorter than the Gaussians that were seen.
    pub fn add(&self, sums: &PerVisible, total: &mut [[f64; 3]]) {
        for (splat, sums) in self.splats.splats.iter().zip(&sums.0) {
            let total = &mut total[splat.id as usize];
            (0..3).for_each(|c| total[c] += sums[c]);
        }
    }

    /// Sums over tiles of what `of_tile` writes for every pair of a tile, zero for channels cut off at 0.
    fn per_splat(&self, mut of_tile: impl FnMut([u32; 2], &Lattice, &[u32], &mut [[f32; 3]])) -> PerVisible {
        let mut total = vec![[0.0; 3]; self.splats.splats.len()];
        let mut sums = Vec::new();
        let mut of_strip = |bins: &Bins| {
            for (y, x) in bins.rows().flat_map(|(y, tiles)| tiles.map(move |x| (y, x))) {
                let pairs = &bins.pairs()[bins.range(y, x..x + 1)];
                let tile = [x as u32, y as u32];
                sums.clear();
                sums.resize(pairs.len(), [0.0; 3]);
                of_tile(tile, &Lattice::new(tile, self.size, 1), pairs, &mut sums);
                for (&splat, sum) in pairs.iter().zip(&sums) {
                    let total = &mut total[splat as usize];
                    (0..3).for_each(|c| total[c] += f64::from(sum[c]));
                }
            }
        };
        of_strip(&self.bins);
        if !self.bins.is_last_strip() {
            let mut bins = self.bins.clone();
            while bins.next_strip(&self.splats, self.strip_pairs).is_some() {
                of_strip(&bins);
            }
        }
        for (total, splat) in total.iter_mut().zip(&self.splats.splats) {
            (0..3).filter(|&c| splat.colour[c] == 0.0).for_each(|c| total[c] = 0.0);
        }
        PerVisible(total)
    }
}

/// Paints changes of colour, without what is cut off at 0.
struct Change<'a> {
    change: &'a [[f32; 3]],
    planes: [Plane; 3],
}

impl Ink for Change<'_> {
    type Drop<V: Lanes> = [V; 3];
    #[inline(always)]
    fn begin<V: Lanes>(&self, splat: &Splat) -> [V; 3] {
        let change = self.change[splat.id as usize];
        std::array::from_fn(|c| V::splat(if splat.colour[c] > 0.0 { change[c] } else { 0.0 }))
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, change: [V; 3], group: usize, Stroke { weight, .. }: Stroke<V>) -> [V; 3] {
        for (plane, change) in self.planes.iter_mut().zip(change) {
            V::load(&plane[group]).add(change.mul(weight)).store(&mut plane[group]);
        }
        change
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, _: [V; 3], _: usize) {}
}

/// Sums pixels by weight.
struct Weighed<'a> {
    planes: &'a [Plane; 3],
    pairs: &'a mut [[f32; 3]],
}

impl Ink for Weighed<'_> {
    type Drop<V: Lanes> = [V; 3];
    #[inline(always)]
    fn begin<V: Lanes>(&self, _: &Splat) -> [V; 3] {
        [V::splat(0.0); 3]
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, sums: [V; 3], group: usize, Stroke { weight, .. }: Stroke<V>) -> [V; 3] {
        std::array::from_fn(|c| sums[c].add(weight.mul(V::load(&self.planes[c][group]))))
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, sums: [V; 3], pair: usize) {
        self.pairs[pair] = sums.map(lane_sum);
    }
}

/// Sums squares of weights, the same for all channels.
struct Power<'a> {
    pairs: &'a mut [[f32; 3]],
}

impl Ink for Power<'_> {
    type Drop<V: Lanes> = V;
    #[inline(always)]
    fn begin<V: Lanes>(&self, _: &Splat) -> V {
        V::splat(0.0)
    }
    #[inline(always)]
    fn add<V: Lanes>(&mut self, sum: V, _: usize, Stroke { weight, .. }: Stroke<V>) -> V {
        sum.add(weight.mul(weight))
    }
    #[inline(always)]
    fn end<V: Lanes>(&mut self, sum: V, pair: usize) {
        self.pairs[pair] = [lane_sum(sum); 3];
    }
}
