//! Pictures differentiated: from ∂L/∂ pixel to ∂L/∂ what is stored of the Gaussians they show.
//!
//! Reads as a pipeline: the picture as [`render`](super::render) makes it, a loss of the caller's, `tile` (a second
//! walk over the same pairs), `splat` (the projection's derivative). Data in: [`Gaussians`] and a [`Camera`]. Data out:
//! [`Gradients`]. Memory beside the picture's: 72 bytes per visible Gaussian ([`GRADIENT_BYTES_PER_VISIBLE`]) and 36
//! per pair of a strip ([`GRADIENT_STRIP_BYTES`]). Sources: Kerbl et al., "3D Gaussian Splatting", 2023, and Ye et al.,
//! "gsplat", 2024, for what is to be derived; derived in method.md, section 8.1.
//!
//! Steps have no derivative: what crosses alpha = 1/255, an order that changes, a tile that is just reached. An alpha
//! cut at 0.99, a channel cut off at 0 and a scale beyond e^±80 pass nothing on.

mod splat;
pub(super) mod sums;
mod tile;

use rayon::prelude::*;

use super::bin::STRIP_PAIRS;
use super::blend::SampledPixels;
use super::convention::BLOCK;
use super::project::CameraTerms;
use super::renderer::{BYTES_PER_VISIBLE, Image, Renderer, fill_pairs};
use splat_core::{Camera, Columns, Gaussians, GradientSpan, Gradients};
use sums::{ImageGradientSums, SplatSums};
use tile::{Pull, Pulled};

/// Gaussians whose gradients one task adds to: whole blocks.
const SPAN: usize = 32 * BLOCK;

/// Memory of a picture that is differentiated per Gaussian it shows.
pub const GRADIENT_BYTES_PER_VISIBLE: usize = BYTES_PER_VISIBLE + size_of::<SplatSums<f64>>();
/// Pairs of splats and tiles whose sums lie ready at a time: of small pictures all, of others a part of the strip.
const SUMMED_PAIRS: usize = STRIP_PAIRS / 4;

/// Memory of a picture that is differentiated for pairs of Gaussians and tiles.
pub const GRADIENT_STRIP_BYTES: usize = STRIP_PAIRS * size_of::<u32>() + SUMMED_PAIRS * size_of::<SplatSums<f32>>();

impl Renderer {
    /// Renders as [`Renderer::render`], asks `loss` for a number and its derivative by each value of the picture,
    /// `[height, width, 3]`, and adds the derivatives by what is stored of `gaussians` to `out`.
    ///
    /// The same bits for any number of threads. A pixel where the picture or the derivative is not finite counts as one
    /// that the number does not depend on. What is not visible, or hidden, gets nothing.
    ///
    /// # Panics
    /// If `out` is not of as many Gaussians or has more harmonics, the columns of `gaussians` differ in length, or
    /// `loss` gives a derivative of another size.
    pub fn gradient(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        loss: impl FnOnce(&Image) -> (f64, Image),
        out: &mut Gradients,
    ) -> f64 {
        assert_eq!(out.len(), gaussians.len(), "gradients of another model");
        assert!(out.column(Columns::SH).width() <= gaussians.sh.width(), "gradients of harmonics that do not exist");
        let view = CameraTerms::new(camera);
        self.prepare(gaussians, &view, true);
        let picture = self.picture(&view, background);
        let (value, pull) = loss(&picture);
        assert_eq!([pull.width, pull.height], view.size, "a derivative of another size");

        if Columns::SH.contains(out.columns()) {
            self.second_walk::<false>(&view, &picture, &pull);
        } else {
            self.second_walk::<true>(&view, &picture, &pull);
        }
        let (splats, sums) = (&self.splats.splats, &self.taken.totals);
        let add = |mut span: GradientSpan<'_>| {
            let [start, end] =
                [span.ids().start, span.ids().end].map(|id| splats.partition_point(|splat| (splat.id as usize) < id));
            splat::add(gaussians, &splats[start..end], &sums[start..end], &view, &mut span);
        };
        if self.parallel {
            out.spans(SPAN).into_par_iter().for_each(add);
        } else {
            out.spans(SPAN).into_iter().for_each(add);
        }
        value
    }

    /// What every splat takes: tiles at once, then splats at once, each adding up its tiles in their order.
    fn second_walk<const SHAPE: bool>(&mut self, view: &CameraTerms, picture: &Image, pull: &Image) {
        let ImageGradientSums { totals, of_pairs } = &mut self.taken;
        totals.clear();
        totals.resize(self.splats.splats.len(), SplatSums::default());
        let part = match self.parallel {
            true => totals.len().div_ceil(rayon::current_num_threads()).max(1),
            false => totals.len().max(1),
        };
        self.bins.rewind();
        while let Some(strip) = self.bins.next_strip(&self.splats, self.strip_pairs) {
            let (bins, splats, blend) = (&self.bins, &self.splats.splats, self.blend);
            for tiles in bins.parts(strip, self.strip_pairs.min(SUMMED_PAIRS)) {
                fill_pairs(bins, tiles.clone(), self.parallel, of_pairs, |tile, pairs, sums| {
                    let lattice = SampledPixels::new(tile, view.size, 1);
                    let mut ink = Pulled::<SHAPE> { pull: Pull::new(picture, pull, tile), pairs: sums };
                    blend.tile(splats, pairs, &lattice, &mut ink);
                });
                let add = |(k, totals): (usize, &mut [SplatSums<f64>])| {
                    for (&splat, sums) in bins.pairs(tiles.clone()).iter().zip(&*of_pairs) {
                        // Of another part it wraps or lies beyond.
                        if let Some(total) = totals.get_mut((splat as usize).wrapping_sub(k * part)) {
                            total.add(sums);
                        }
                    }
                };
                if self.parallel {
                    totals.par_chunks_mut(part).enumerate().for_each(add);
                } else {
                    totals.chunks_mut(part).enumerate().for_each(add);
                }
            }
        }
    }
}
