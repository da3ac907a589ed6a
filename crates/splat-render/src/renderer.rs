//! Pictures, contributions and removal errors of one frame seen by one camera: the parts of the rasteriser in order.

use std::num::NonZeroU32;
use std::ops::Range;

use rayon::prelude::*;

use super::backward::sums::ImageGradientSums;
use super::bin::{Bins, STRIP_PAIRS};
use super::blend::{Blend, Color, SampledPixels, TilePlane, Weight, Weights};
use super::contribution::Contribution;
use super::convention::{BLOCK, TILE};
use super::lanes::LANES;
use super::project::{CameraTerms, Splat, Splats, TileRect, project};
use super::removal::{Removal, RemovalError};
use splat_core::{Camera, Gaussians};

/// Gaussians projected by one task: enough to outweigh handing it out.
const SPAN: usize = 32 * BLOCK;

/// Memory of a picture in the making per Gaussian it shows: footprint, reach, and place in depth with room to sort it.
pub const BYTES_PER_VISIBLE: usize = size_of::<Splat>() + size_of::<TileRect>() + 2 * size_of::<u64>();
/// Memory of a picture in the making for pairs of Gaussians and tiles, with what is summed for each.
pub const STRIP_BYTES: usize = STRIP_PAIRS * (size_of::<u32>() + size_of::<Weight>());

/// A picture: red, green, blue per pixel, row by row from the top, 1 = white, not clamped.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Image {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// `[height, width, 3]`.
    pub data: Vec<f32>,
}

impl Image {
    /// The pixels of one tile, row by row, 0 beyond the picture's edge.
    pub(super) fn tile(&self, tile: [u32; 2]) -> [[[f32; 3]; TILE as usize]; TILE as usize] {
        let mut pixels = [[[0.0; 3]; TILE as usize]; TILE as usize];
        let [x, y] = tile.map(|t| (t * TILE) as usize);
        let columns = x..(x + TILE as usize).min(self.width as usize);
        let rows = self.data.as_chunks().0.chunks_exact(self.width as usize);
        for (pixels, row) in pixels.iter_mut().zip(rows.skip(y)) {
            pixels[..columns.len()].copy_from_slice(&row[columns.clone()]);
        }
        pixels
    }
}

/// Renders `gaussians` before `background` as `camera` sees them, on all threads of the pool.
///
/// A camera without pixels gives an empty image; no Gaussians give the background. Scales are taken
/// within e^±80. A zero quaternion is the identity; a NaN color counts as 0.
///
/// # Panics
/// If the columns of `gaussians` differ in length.
pub fn render(gaussians: &Gaussians, camera: &Camera, background: [f32; 3]) -> Image {
    Renderer::on_all_threads().render(gaussians, camera, background)
}

/// Adds what `camera` sees of each Gaussian to `seen`, on all threads of the pool; reads no color.
///
/// Only every `stride`-th pixel each way is looked at (those whose coordinates leave `stride / 2` when
/// divided by it), with footprints at full resolution; the sums are over the looked-at pixels, so a
/// stride of s gives about 1/s² of the full sums.
///
/// # Panics
/// If `seen` is not of as many Gaussians, or the columns of `gaussians` differ in length.
pub fn contribution(gaussians: &Gaussians, camera: &Camera, stride: NonZeroU32, seen: &mut Contribution) {
    Renderer::on_all_threads().contribution(gaussians, camera, stride, seen);
}

/// Renders and keeps its buffers: one picture after the other.
///
/// Gives the same bits as [`render`] and [`contribution`].
#[derive(Debug)]
pub struct Renderer {
    pub(super) parallel: bool,
    pub(super) blend: Blend,
    pub(super) splats: Splats,
    pub(super) bins: Bins,
    weights: Vec<Weight>,
    pub(super) taken: ImageGradientSums,
    /// Pairs of splats and tiles that lie ready at a time.
    pub(super) strip_pairs: usize,
}

impl Default for Renderer {
    fn default() -> Self {
        Renderer::new()
    }
}

impl Renderer {
    /// A renderer on the calling thread alone: for loops that run pictures in parallel.
    pub fn new() -> Self {
        Renderer::with(false)
    }

    /// A renderer on all threads of the pool: for pictures that must follow one another.
    pub fn on_all_threads() -> Self {
        Renderer::with(true)
    }

    fn with(parallel: bool) -> Self {
        Renderer {
            parallel,
            blend: Blend::fastest(),
            splats: Splats::default(),
            bins: Bins::default(),
            weights: Vec::new(),
            taken: ImageGradientSums::default(),
            strip_pairs: STRIP_PAIRS,
        }
    }

    /// As the function [`render`].
    pub fn render(&mut self, gaussians: &Gaussians, camera: &Camera, background: [f32; 3]) -> Image {
        let view = CameraTerms::new(camera);
        self.prepare(gaussians, &view, true);
        self.picture(&view, background)
    }

    /// The picture of what is prepared.
    pub(super) fn picture(&mut self, view: &CameraTerms, background: [f32; 3]) -> Image {
        let [width, height] = view.size;
        let row_len = width as usize * 3;
        let mut data = vec![0.0; row_len * height as usize];
        // Without pixels there are no rows, and chunks must not be empty.
        let tile_row_len = (row_len * TILE as usize).max(1);
        while let Some(strip) = self.bins.next_strip(&self.splats, self.strip_pairs) {
            let (bins, splats, blend) = (&self.bins, &self.splats.splats, self.blend);
            let first = bins.rows(strip.clone()).next().map_or(0, |(y, _)| y);
            let paint_row = |((y, tiles), rows): ((usize, Range<usize>), &mut [f32])| {
                for x in tiles {
                    let lattice = SampledPixels::new([x as u32, y as u32], view.size, 1);
                    let pairs = bins.pairs_of(y, x..x + 1);
                    let planes = paint(blend, splats, pairs, &lattice, background);
                    for (v, row) in rows.chunks_exact_mut(row_len).enumerate() {
                        let start = x * TILE as usize;
                        let pixels = row[start * 3..].chunks_exact_mut(3).take(TILE as usize);
                        for (u, pixel) in pixels.enumerate() {
                            let (group, lane) = (v + u / LANES * TILE as usize, u % LANES);
                            for c in 0..3 {
                                pixel[c] = planes[c][group][lane];
                            }
                        }
                    }
                }
            };
            let rows = bins.rows(strip).zip(data[first * tile_row_len..].chunks_mut(tile_row_len));
            if self.parallel {
                rows.collect::<Vec<_>>().into_par_iter().for_each(paint_row);
            } else {
                rows.for_each(paint_row);
            }
        }
        Image { width, height, data }
    }

    /// As the function [`contribution`].
    ///
    /// # Panics
    /// If `seen` is not of as many Gaussians, or the columns of `gaussians` differ in length.
    pub fn contribution(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        stride: NonZeroU32,
        seen: &mut Contribution,
    ) {
        assert_eq!(seen.len(), gaussians.len(), "contribution of another model");
        let view = CameraTerms::new(camera);
        self.prepare(gaussians, &view, false);
        while let Some(strip) = self.bins.next_strip(&self.splats, self.strip_pairs) {
            let (bins, splats, blend) = (&self.bins, &self.splats.splats, self.blend);
            fill_pairs(bins, strip.clone(), self.parallel, &mut self.weights, |tile, pairs, weights| {
                let lattice = SampledPixels::new(tile, view.size, stride.get());
                blend.tile(splats, pairs, &lattice, &mut Weights { pairs: weights });
            });
            for (&splat, weight) in bins.pairs(strip).iter().zip(&self.weights) {
                if weight.max > 0.0 {
                    seen.add(splats[splat as usize].id as usize, weight.sum, weight.max);
                }
            }
        }
    }

    /// Adds what removing each Gaussian alone would change in `camera`'s picture to `errors`, on this thread.
    ///
    /// # Panics
    /// If `errors` is not of as many Gaussians, or the columns of `gaussians` differ in length.
    pub fn removal_error(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        errors: &mut RemovalError,
    ) {
        assert_eq!(errors.len(), gaussians.len(), "errors of another model");
        let view = CameraTerms::new(camera);
        self.prepare(gaussians, &view, true);
        let mut sums = Vec::new();
        while let Some(strip) = self.bins.next_strip(&self.splats, self.strip_pairs) {
            let (bins, splats) = (&self.bins, &self.splats.splats);
            for (y, x) in bins.rows(strip).flat_map(|(y, tiles)| tiles.map(move |x| (y, x))) {
                let pairs = bins.pairs_of(y, x..x + 1);
                let lattice = SampledPixels::new([x as u32, y as u32], view.size, 1);
                let rest = paint(self.blend, splats, pairs, &lattice, background);
                sums.clear();
                sums.resize(pairs.len(), 0.0);
                let mut ink = Removal { rest, contrast_floor: errors.contrast_floor, pairs: &mut sums };
                self.blend.tile(splats, pairs, &lattice, &mut ink);
                for (&splat, &sum) in pairs.iter().zip(&sums) {
                    errors.add(splats[splat as usize].id as usize, sum);
                }
            }
        }
    }

    /// Projects and sorts.
    pub(super) fn prepare(&mut self, gaussians: &Gaussians, view: &CameraTerms, colored: bool) {
        let count = gaussians.len();
        self.splats.clear();
        if self.parallel {
            let spans: Vec<Splats> = (0..count.div_ceil(SPAN))
                .into_par_iter()
                .map(|span| {
                    let mut splats = Splats::default();
                    project(gaussians, span * SPAN..((span + 1) * SPAN).min(count), view, colored, &mut splats);
                    splats
                })
                .collect();
            spans.into_iter().for_each(|span| self.splats.append(span));
        } else {
            project(gaussians, 0..count, view, colored, &mut self.splats);
        }
        self.bins.begin(&self.splats, view.tiles);
    }
}

/// Makes `sums` one default value for every pair of `tiles` of the strip, and has `of_tile` change those of each tile, given its
/// place and its pairs; tiles at once if `parallel`.
pub(super) fn fill_pairs<T: Copy + Default + Send>(
    bins: &Bins,
    tiles: Range<usize>,
    parallel: bool,
    sums: &mut Vec<T>,
    of_tile: impl Fn([u32; 2], &[u32], &mut [T]) + Sync,
) {
    sums.clear();
    sums.resize(bins.pairs(tiles.clone()).len(), T::default());
    let mut rest = &mut sums[..];
    let mut rows = Vec::new();
    for (y, tiles) in bins.rows(tiles) {
        let (row, after) = rest.split_at_mut(bins.pairs_of(y, tiles.clone()).len());
        rows.push((y, tiles, row));
        rest = after;
    }
    let fill_row = |(y, tiles, mut sums): (usize, Range<usize>, &mut [T])| {
        for x in tiles {
            let pairs = bins.pairs_of(y, x..x + 1);
            let (of_pairs, after) = sums.split_at_mut(pairs.len());
            of_tile([x as u32, y as u32], pairs, of_pairs);
            sums = after;
        }
    };
    if parallel {
        rows.into_par_iter().for_each(fill_row);
    } else {
        rows.into_iter().for_each(fill_row);
    }
}

/// The colors of one tile's sampled pixels.
fn paint(
    blend: Blend,
    splats: &[Splat],
    pairs: &[u32],
    lattice: &SampledPixels,
    background: [f32; 3],
) -> [TilePlane; 3] {
    let mut color = Color { planes: [TilePlane::default(); 3] };
    let left = blend.tile(splats, pairs, lattice, &mut color);
    for (plane, background) in color.planes.iter_mut().zip(background) {
        for (pixel, left) in plane.as_flattened_mut().iter_mut().zip(left.as_flattened()) {
            *pixel += left.abs() * background;
        }
    }
    color.planes
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use splat_core::{Columns, Gradients};

    /// 3000 Gaussians of all sizes, and a camera among them whose picture does not end at a tile's edge.
    fn scene() -> (Gaussians, Camera) {
        let mut scene = Gaussians::zeros(3000, 0);
        for i in 0..scene.len() {
            // Low-discrepancy steps: every Gaussian elsewhere, of another size and opacity.
            let step = |k: f64| (i as f64 * k).fract() as f32;
            scene.position.set_row(i, [2.0 * step(0.618_034) - 1.0, 2.0 * step(0.754_878) - 1.0, 1.5 + step(0.569_84)]);
            scene.rotation.set_row(i, [1.0, step(0.819_173), step(0.671_044), step(0.549_701)]);
            scene.log_scale.set_row(i, [-6.0 + 4.0 * step(0.380_2), -3.0, -4.0]);
            scene.opacity_logit.set_row(i, [10.0 * step(0.856_675) - 5.0]);
            scene.sh.set_row(i, [step(0.733_892), step(0.628_71), step(0.538_6)]);
        }
        let camera = Camera {
            width: 99,
            height: 70,
            fx: 80.0,
            fy: 80.0,
            cx: 49.5,
            cy: 35.0,
            rotation: DMat3::IDENTITY,
            translation: DVec3::ZERO,
            near: Camera::NEAR,
        };
        (scene, camera)
    }

    /// Everything a renderer can make of the scene.
    fn made(mut renderer: Renderer) -> (Image, Contribution, RemovalError, Gradients) {
        let (scene, camera) = scene();
        let mut seen = Contribution::new(scene.len());
        renderer.contribution(&scene, &camera, NonZeroU32::MIN, &mut seen);
        let mut errors = RemovalError::new(scene.len(), 0.1);
        renderer.removal_error(&scene, &camera, [0.3; 3], &mut errors);
        let mut gradients = Gradients::new(scene.len(), Columns::all(), 0);
        let loss = |picture: &Image| (0.0, picture.clone());
        renderer.gradient(&scene, &camera, [0.3; 3], loss, &mut gradients);
        (renderer.render(&scene, &camera, [0.3; 3]), seen, errors, gradients)
    }

    #[test]
    fn every_instruction_set_gives_the_bits_of_the_portable_one() {
        let portable = made(Renderer { blend: Blend::Portable, ..Renderer::new() });
        for blend in Blend::all() {
            assert!(made(Renderer { blend, ..Renderer::new() }) == portable, "{blend:?} differs");
        }
    }

    #[test]
    fn pairs_of_as_few_tiles_at_a_time_as_one_give_the_same_bits() {
        let whole = made(Renderer::new());
        let (scene, camera) = scene();
        let mut renderer = Renderer::new();
        renderer.prepare(&scene, &CameraTerms::new(&camera), true);
        let tiles = renderer.bins.next_strip(&renderer.splats, usize::MAX).unwrap();
        let pairs = renderer.bins.pairs(0..7 * 5).len();
        assert_eq!(tiles, 0..7 * 5);
        for strip_pairs in [1, pairs / 20, pairs / 3, pairs] {
            for parallel in [false, true] {
                assert!(made(Renderer { strip_pairs, ..Renderer::with(parallel) }) == whole, "{strip_pairs} at a time");
            }
            renderer.bins.begin(&renderer.splats, [7, 5]);
            let mut at = 0;
            while let Some(strip) = renderer.bins.next_strip(&renderer.splats, strip_pairs) {
                assert!(
                    strip.start == at && (strip.len() == 1 || renderer.bins.pairs(strip.clone()).len() <= strip_pairs)
                );
                at = strip.end;
            }
            assert_eq!(at, 35);
        }
    }
}
