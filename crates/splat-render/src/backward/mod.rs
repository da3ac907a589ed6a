//! Gradients of renders: computes the derivatives of a loss L with respect to the stored attributes of Gaussians.
//!
//! The steps are:
//! - render the image as in [`render`](super::render);
//! - compute ∂L/∂pixel for every pixel by a function of the caller;
//! - compute sums over pixels for each splat by a backward pass over the splats of each tile (`tile`);
//! - compute the gradients of Gaussians from these sums by the derivative of the projection (`splat`).
//!
//! Input: [`Gaussians`] and a [`Camera`](splat_core::Camera). Output: [`Gradients`]. Memory in addition to that of the
//! render: 72 bytes per visible Gaussian ([`GRADIENT_BYTES_PER_VISIBLE`] includes the render), and 36 bytes per (splat,
//! tile) pair of a part of a strip ([`GRADIENT_STRIP_BYTES`]). Sources of the forward model: Kerbl et al., "3D Gaussian
//! Splatting", 2023, and Ye et al., "gsplat", 2024. The gradients are derived in docs/method.md, section 8.1.
//!
//! Discontinuities of the render are ignored: an alpha that crosses 1/255, a changed depth order, a tile that a splat
//! newly touches. An alpha clamped at 0.99, a channel clamped at 0 and a scale beyond e^±80 have derivative 0.

mod splat;
pub(super) mod sums;
mod tile;

use rayon::prelude::*;

use super::bin::STRIP_PAIRS;
use super::blend::SampledPixels;
use super::color::ColorSource;
use super::grid::SampledView;
use super::project::CameraTerms;
use super::renderer::{BYTES_PER_VISIBLE, Image, Renderer, fill_pairs, for_each_part};
use splat_core::{Attributes, Gaussians, GradientSpan, Gradients};
use sums::{ImageGradientSums, SplatSums};
use tile::{GradientSink, PixelGradients};

/// Bytes of memory per visible Gaussian for a render and for the gradient of a loss of this render.
pub const GRADIENT_BYTES_PER_VISIBLE: usize = BYTES_PER_VISIBLE + size_of::<SplatSums<f64>>();
/// Maximum number of (splat, tile) pairs whose gradient sums ([`SplatSums`], sums over pixels) are in memory at a time.
/// A strip (the tiles that are processed together) with more pairs is processed in parts.
const SUMMED_PAIRS: usize = STRIP_PAIRS / 4;

/// Bytes of memory for the (splat, tile) pairs of one strip (the tiles that are processed together), for a render and
/// for the gradient of a loss of this render.
pub const GRADIENT_STRIP_BYTES: usize = STRIP_PAIRS * size_of::<u32>() + SUMMED_PAIRS * size_of::<SplatSums<f32>>();

impl Renderer {
    /// Renders an image like [`Renderer::render`], calls `loss` for it, and adds the derivatives of this loss with
    /// respect to the stored attributes of `gaussians` to `out`. Returns the loss.
    ///
    /// - `loss` gets the image and returns two values: the loss, and its derivative with respect to each value of the
    ///   image.
    /// - If `view` renders a grid of pixels, the image has the size of the grid, and only these pixels take part in the
    ///   loss.
    /// - A pixel whose color or derivative is not finite has no effect on gradients.
    /// - Gaussians that are not visible get gradient 0.
    /// - Results have the same bits for any number of threads.
    ///
    /// # Panics
    /// Panics if `out` has another number of Gaussians or a higher SH degree than `gaussians`, if the attributes of
    /// `gaussians` have different lengths, or if `loss` returns a derivative of another size than the image.
    pub fn gradient<'a>(
        &mut self,
        gaussians: &Gaussians,
        view: impl Into<SampledView<'a>>,
        background: [f32; 3],
        loss: impl FnOnce(&Image) -> (f64, Image),
        out: &mut Gradients,
    ) -> f64 {
        assert_eq!(out.len(), gaussians.len(), "expected as many gradients as Gaussians");
        assert!(
            out.derivatives(Attributes::SH).width() <= gaussians.sh.width(),
            "expected gradients of at most the SH degree of the Gaussians"
        );
        let view = CameraTerms::new(view.into());
        self.prepare(gaussians, &view, ColorSource::Coefficients);
        let image = self.render_prepared(&view, background);
        let (value, pixel_gradient) = loss(&image);
        assert_eq!(
            [pixel_gradient.width, pixel_gradient.height],
            view.size,
            "expected a derivative of the size of the render"
        );

        if Attributes::SH.contains(out.attributes()) {
            self.backward_pass::<false>(&view, &image, &pixel_gradient);
        } else {
            self.backward_pass::<true>(&view, &image, &pixel_gradient);
        }
        let (splats, sums, span) = (&self.splats.splats, &self.gradient_sums.totals, self.span_len(gaussians.len()));
        let add = |mut span: GradientSpan<'_>| {
            let [start, end] =
                [span.ids().start, span.ids().end].map(|id| splats.partition_point(|splat| (splat.id as usize) < id));
            splat::add_gradients(gaussians, &splats[start..end], &sums[start..end], &view, &mut span);
        };
        for_each_part(out.spans(span).into_iter(), self.task_count(), add);
        value
    }

    /// Computes for every splat the sums over pixels from which its gradients follow ([`SplatSums`]). `pixel_gradient`
    /// is the derivative of the loss with respect to each value of `image`. If `SHAPE` is false, computes only the sums
    /// for the gradients of colors.
    ///
    /// First computes the sums of each splat over each tile; a parallel renderer divides this work by parts of rows of
    /// tiles. Then adds the sums of the tiles of each splat in a fixed order; a parallel renderer divides this work by
    /// splats.
    fn backward_pass<const SHAPE: bool>(&mut self, view: &CameraTerms, image: &Image, pixel_gradient: &Image) {
        let task_count = self.task_count();
        let ImageGradientSums { totals, pairs: pair_sums } = &mut self.gradient_sums;
        totals.clear();
        totals.resize(self.splats.splats.len(), SplatSums::default());
        let part = match task_count > 1 {
            true => totals.len().div_ceil(rayon::current_num_threads()).max(1),
            false => totals.len().max(1),
        };
        self.bins.rewind();
        while let Some(strip) = self.bins.next_strip(&self.splats, self.strip_pairs) {
            let (bins, splats, blend) = (&self.bins, &self.splats.splats, self.blend);
            for tiles in bins.parts(strip, self.strip_pairs.min(SUMMED_PAIRS)) {
                fill_pairs(bins, tiles.clone(), task_count, pair_sums, |tile, pairs, sums| {
                    let sampled = SampledPixels::new(tile, view.size, view.grid);
                    let mut sink = GradientSink::<SHAPE> {
                        gradients: PixelGradients::new(image, pixel_gradient, tile),
                        pairs: sums,
                    };
                    blend.tile(splats, pairs, &sampled, &mut sink);
                });
                let add = |(k, totals): (usize, &mut [SplatSums<f64>])| {
                    for (&splat, sums) in bins.pairs(tiles.clone()).iter().zip(&*pair_sums) {
                        // For a splat outside this part, the index wraps around or lies beyond the end.
                        if let Some(total) = totals.get_mut((splat as usize).wrapping_sub(k * part)) {
                            total.add(sums);
                        }
                    }
                };
                if task_count > 1 {
                    totals.par_chunks_mut(part).enumerate().for_each(add);
                } else {
                    totals.chunks_mut(part).enumerate().for_each(add);
                }
            }
        }
    }
}
