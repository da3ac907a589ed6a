//! Renderer: computes the image, the contributions and the removal errors of one frame from one camera. Runs the parts
//! of the rasterizer in order: projection, assignment to tiles, blending.

use std::num::NonZeroU32;
use std::ops::Range;

use rayon::prelude::*;

use super::backward::sums::ImageGradientSums;
use super::bin::{Bins, STRIP_PAIRS};
use super::blend::{BlendKernel, ColorSink, SampledPixels, TilePlane, Weight, WeightSink};
use super::color::{ColorSource, ViewColors};
use super::contribution::Contribution;
use super::convention::{BLOCK, TILE};
use super::grid::{PixelGrid, SampledView};
use super::lanes::LANES;
use super::project::{CameraTerms, Splat, Splats, TileRect, project};
use super::removal::{RemovalError, RemovalSink};
use splat_core::{Camera, Gaussians};

/// Maximum number of Gaussians in a span, which one parallel task projects or differentiates.
const MAX_SPAN: usize = 32 * BLOCK;
/// Number of tasks per thread into which a parallel loop is divided if there is enough work. Tasks take different
/// times; with several per thread, all threads finish at about the same time.
const TASKS_PER_THREAD: usize = 8;

/// Bytes of memory per visible Gaussian during a render: footprint, tile rectangle, and two copies of the depth sort
/// key.
pub const BYTES_PER_VISIBLE: usize = size_of::<Splat>() + size_of::<TileRect>() + 2 * size_of::<u64>();
/// Bytes of memory during a render for the (splat, tile) pairs of a strip, which are the tiles that are processed
/// together. Includes the sum and the maximum of the weights of each pair.
pub const STRIP_BYTES: usize = STRIP_PAIRS * (size_of::<u32>() + size_of::<Weight>());

/// Image with red, green and blue per pixel, row by row from the top. White is 1. Values are not clamped.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Image {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Pixel values `[height, width, 3]`.
    pub data: Vec<f32>,
}

impl Image {
    /// Returns the pixels of the tile in column `tile[0]` and row `tile[1]`, row by row; pixels outside the image are
    /// 0.
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

/// Renders `gaussians` from `camera` over the color `background`, on all threads of the rayon pool, and returns the
/// image.
///
/// An image without pixels stays empty, and without Gaussians every pixel is `background`. Scales are clamped to e^±80.
/// A zero quaternion counts as the identity; a NaN color counts as 0.
///
/// # Panics
/// Panics if the attributes of `gaussians` have different lengths.
pub fn render(gaussians: &Gaussians, camera: &Camera, background: [f32; 3]) -> Image {
    Renderer::on_all_threads().render(gaussians, camera, background)
}

/// Adds the visible contribution of each Gaussian in the view of `camera` (alpha · transmittance, summed over pixels)
/// to `seen`, on all threads of the rayon pool. SH coefficients are not read.
///
/// Only every `stride`-th pixel in both directions is sampled: the pixels whose column and row have the remainder
/// `stride / 2` when divided by `stride`. Footprints are those of the full image. The sums are over the sampled pixels,
/// so a stride of s gives about 1/s² of the full sums.
///
/// # Panics
/// Panics if `seen` has another number of Gaussians, or if the attributes of `gaussians` have different lengths.
pub fn contribution(gaussians: &Gaussians, camera: &Camera, stride: NonZeroU32, seen: &mut Contribution) {
    Renderer::on_all_threads().contribution(gaussians, camera, stride, seen);
}

/// Renderer that keeps its buffers between views, so that they are not allocated for each view.
///
/// Its results have the same bits as those of the functions [`render`] and [`contribution`].
#[derive(Debug)]
pub struct Renderer {
    pub(super) parallel: bool,
    pub(super) blend: BlendKernel,
    pub(super) splats: Splats,
    pub(super) bins: Bins,
    weights: Vec<Weight>,
    pub(super) gradient_sums: ImageGradientSums,
    /// Maximum number of (splat, tile) pairs in memory at a time. Only a single tile with more pairs exceeds it.
    pub(super) strip_pairs: usize,
}

impl Default for Renderer {
    fn default() -> Self {
        Renderer::new()
    }
}

impl Renderer {
    /// Creates a renderer that uses only the calling thread. Suits loops that render several views in parallel.
    pub fn new() -> Self {
        Renderer::with_parallel(false)
    }

    /// Creates a renderer that uses all threads of the rayon pool. Suits views that must be rendered one after another.
    pub fn on_all_threads() -> Self {
        Renderer::with_parallel(true)
    }

    /// Creates a renderer that uses all threads of the rayon pool if `parallel`, otherwise only the calling thread.
    fn with_parallel(parallel: bool) -> Self {
        Renderer {
            parallel,
            blend: BlendKernel::fastest(),
            splats: Splats::default(),
            bins: Bins::default(),
            weights: Vec::new(),
            gradient_sums: ImageGradientSums::default(),
            strip_pairs: STRIP_PAIRS,
        }
    }

    /// Returns the number of parallel tasks into which the work on a view is divided, or 1 if one thread does it all.
    /// Results do not depend on this number.
    pub(super) fn task_count(&self) -> usize {
        match rayon::current_num_threads() {
            threads if self.parallel && threads > 1 => TASKS_PER_THREAD * threads,
            _ => 1,
        }
    }

    /// Returns the number of Gaussians of a span, the consecutive Gaussians that one task processes, if `count`
    /// Gaussians are divided: a multiple of [`BLOCK`], at most [`MAX_SPAN`].
    pub(super) fn span_len(&self, count: usize) -> usize {
        count.div_ceil(self.task_count()).next_multiple_of(BLOCK).clamp(BLOCK, MAX_SPAN)
    }

    /// Renders `gaussians` in `view` over the color `background`, like the function [`render`]. The image has the size
    /// of the grid of pixels of `view`.
    pub fn render<'a>(
        &mut self,
        gaussians: &Gaussians,
        view: impl Into<SampledView<'a>>,
        background: [f32; 3],
    ) -> Image {
        let view = CameraTerms::new(view.into());
        self.prepare(gaussians, &view, ColorSource::Coefficients);
        self.render_prepared(&view, background)
    }

    /// Renders `gaussians` like [`Renderer::render`], with the same result, but with colors that [`ViewColors::fill`] has
    /// computed for `gaussians`. `colors.1` is the index of the camera of `view` among the cameras given to that
    /// function.
    ///
    /// # Panics
    /// Panics if there is no camera with this index, or if the colors belong to fewer Gaussians.
    pub fn render_with_colors<'a>(
        &mut self,
        gaussians: &Gaussians,
        view: impl Into<SampledView<'a>>,
        background: [f32; 3],
        colors: (&ViewColors, usize),
    ) -> Image {
        let view = CameraTerms::new(view.into());
        self.prepare(gaussians, &view, ColorSource::Computed(colors.0, colors.1));
        self.render_prepared(&view, background)
    }

    /// Blends the splats that [`Renderer::prepare`] has projected and sorted over the color `background`, and returns
    /// the image. `view` must be the view for which `prepare` was called.
    pub(super) fn render_prepared(&mut self, view: &CameraTerms, background: [f32; 3]) -> Image {
        let [width, height] = view.size;
        let row_len = width as usize * 3;
        let mut data = vec![0.0; row_len * height as usize];
        // An image without pixels has no rows, and chunks must not be empty.
        let tile_row_len = (row_len * TILE as usize).max(1);
        let task_count = self.task_count();
        while let Some(strip) = self.bins.next_strip(&self.splats, self.strip_pairs) {
            let (bins, splats, blend) = (&self.bins, &self.splats.splats, self.blend);
            // Renders consecutive tiles of a row. `rows` holds their part of each row of pixels.
            let render_part = |(y, tiles, mut rows): (usize, Range<usize>, Vec<&mut [f32]>)| {
                for (k, x) in tiles.enumerate() {
                    let sampled = SampledPixels::new([x as u32, y as u32], view.size, view.grid);
                    let pairs = bins.pairs_in_row(y, x..x + 1);
                    let planes = blend_colors(blend, splats, pairs, &sampled, background);
                    for (v, row) in rows.iter_mut().enumerate() {
                        let pixels = row[k * TILE as usize * 3..].chunks_exact_mut(3).take(TILE as usize);
                        for (u, pixel) in pixels.enumerate() {
                            let (group, lane) = (v + u / LANES * TILE as usize, u % LANES);
                            for c in 0..3 {
                                pixel[c] = planes[c][group][lane];
                            }
                        }
                    }
                }
            };
            let first = bins.rows(strip.clone()).next().map_or(0, |(y, _)| y);
            let mut rows = data[first * tile_row_len..].chunks_mut(tile_row_len);
            // Row of tiles to which `rest` belongs: for each row of pixels, the pixels that are not in a part yet.
            let (mut row, mut rest) = (None, Vec::new());
            let parts = bins.row_parts(strip, task_count).map(|(y, tiles)| {
                if row.replace(y) != Some(y) {
                    let start = tiles.start * TILE as usize * 3;
                    let pixel_rows = rows.next().into_iter().flat_map(|rows| rows.chunks_exact_mut(row_len));
                    rest = pixel_rows.map(|row| &mut row[start..]).collect();
                }
                let len = tiles.len() * TILE as usize * 3;
                let pixels = rest.iter_mut().filter_map(|row| row.split_off_mut(..len.min(row.len()))).collect();
                (y, tiles, pixels)
            });
            for_each_part(parts, task_count, render_part);
        }
        Image { width, height, data }
    }

    /// Adds the visible contribution of each Gaussian in the view of `camera` to `seen`, like the function
    /// [`contribution`].
    ///
    /// # Panics
    /// Panics if `seen` has another number of Gaussians, or if the attributes of `gaussians` have different lengths.
    pub fn contribution(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        stride: NonZeroU32,
        seen: &mut Contribution,
    ) {
        assert_eq!(seen.len(), gaussians.len(), "expected as many contributions as Gaussians");
        let view = CameraTerms::new(PixelGrid::centered([stride; 2]).sampled_view(camera));
        self.prepare(gaussians, &view, ColorSource::Black);
        let task_count = self.task_count();
        while let Some(strip) = self.bins.next_strip(&self.splats, self.strip_pairs) {
            let (bins, splats, blend) = (&self.bins, &self.splats.splats, self.blend);
            fill_pairs(bins, strip.clone(), task_count, &mut self.weights, |tile, pairs, weights| {
                let sampled = SampledPixels::new(tile, view.size, view.grid);
                blend.tile(splats, pairs, &sampled, &mut WeightSink { pairs: weights });
            });
            for (&splat, weight) in bins.pairs(strip).iter().zip(&self.weights) {
                if weight.max > 0.0 {
                    seen.add(splats[splat as usize].id as usize, weight.sum, weight.max);
                }
            }
        }
    }

    /// Adds the removal error of each Gaussian in `view` to `errors`: the squared error of a render over the color
    /// `background` without this Gaussian. Errors are sums over the pixels of the grid of `view`. Tiles are blended on
    /// the calling thread only.
    ///
    /// # Panics
    /// Panics if `errors` has another number of Gaussians, or if the attributes of `gaussians` have different lengths.
    pub fn removal_error<'a>(
        &mut self,
        gaussians: &Gaussians,
        view: impl Into<SampledView<'a>>,
        background: [f32; 3],
        errors: &mut RemovalError,
    ) {
        assert_eq!(errors.len(), gaussians.len(), "expected as many removal errors as Gaussians");
        let view = CameraTerms::new(view.into());
        self.prepare(gaussians, &view, ColorSource::Coefficients);
        let mut sums = Vec::new();
        while let Some(strip) = self.bins.next_strip(&self.splats, self.strip_pairs) {
            let (bins, splats) = (&self.bins, &self.splats.splats);
            for (y, x) in bins.rows(strip).flat_map(|(y, tiles)| tiles.map(move |x| (y, x))) {
                let pairs = bins.pairs_in_row(y, x..x + 1);
                let sampled = SampledPixels::new([x as u32, y as u32], view.size, view.grid);
                let behind = blend_colors(self.blend, splats, pairs, &sampled, background);
                sums.clear();
                sums.resize(pairs.len(), 0.0);
                let mut sink = RemovalSink { behind, contrast_floor: errors.contrast_floor, pairs: &mut sums };
                self.blend.tile(splats, pairs, &sampled, &mut sink);
                for (&splat, &sum) in pairs.iter().zip(&sums) {
                    errors.add(splats[splat as usize].id as usize, sum);
                }
            }
        }
    }

    /// Projects the Gaussians to splats with colors from `colors`. This renderer keeps the splats for later calls, and
    /// sorts them by depth.
    pub(super) fn prepare(&mut self, gaussians: &Gaussians, view: &CameraTerms, colors: ColorSource<'_>) {
        let (count, span) = (gaussians.len(), self.span_len(gaussians.len()));
        self.splats.clear();
        if self.task_count() > 1 {
            let spans: Vec<Splats> = (0..count.div_ceil(span))
                .into_par_iter()
                .with_max_len(1)
                .map(|k| {
                    let mut splats = Splats::default();
                    project(gaussians, k * span..((k + 1) * span).min(count), view, colors, &mut splats);
                    splats
                })
                .collect();
            spans.into_iter().for_each(|span| self.splats.append(span));
        } else {
            project(gaussians, 0..count, view, colors, &mut self.splats);
        }
        self.bins.begin(&self.splats, view.tiles, self.task_count() > 1);
    }
}

/// Computes one value of type `T`, for example a removal error, for each (splat, tile) pair of `tiles`, and writes the
/// values to `sums`, tile after tile. The tiles must lie in the range that [`Bins::next_strip`] returned last, because
/// only the pairs of this range are in memory.
///
/// All values are set to the default of `T` first. Then `fill_tile` is called for each tile, and changes the values of
/// the tile. Its arguments are:
/// - the column and the row of the tile,
/// - the indices of the splats of the tile,
/// - the values of the pairs of the tile, one per splat, in the same order.
///
/// The tiles are divided into about `task_count` tasks, which run in parallel if there is more than one.
pub(super) fn fill_pairs<T: Copy + Default + Send>(
    bins: &Bins,
    tiles: Range<usize>,
    task_count: usize,
    sums: &mut Vec<T>,
    fill_tile: impl Fn([u32; 2], &[u32], &mut [T]) + Sync,
) {
    sums.clear();
    sums.resize(bins.pairs(tiles.clone()).len(), T::default());
    let mut remaining = &mut sums[..];
    let parts = bins.row_parts(tiles, task_count).map(|(y, tiles)| {
        let (part, after) = std::mem::take(&mut remaining).split_at_mut(bins.pairs_in_row(y, tiles.clone()).len());
        remaining = after;
        (y, tiles, part)
    });
    let fill_part = |(y, tiles, mut sums): (usize, Range<usize>, &mut [T])| {
        for x in tiles {
            let pairs = bins.pairs_in_row(y, x..x + 1);
            let (tile_sums, after) = sums.split_at_mut(pairs.len());
            fill_tile([x as u32, y as u32], pairs, tile_sums);
            sums = after;
        }
    };
    for_each_part(parts, task_count, fill_part);
}

/// Calls `process` with each of `parts`: in parallel, one task per part, if `task_count` is more than 1.
pub(super) fn for_each_part<T: Send>(
    parts: impl Iterator<Item = T>,
    task_count: usize,
    process: impl Fn(T) + Send + Sync,
) {
    if task_count > 1 {
        parts.collect::<Vec<_>>().into_par_iter().with_max_len(1).for_each(process);
    } else {
        parts.for_each(process);
    }
}

/// Blends the splats of one tile over the color `background`. Returns the colors of the pixels `sampled` of the tile,
/// one plane per channel. `pairs` holds the indices in `splats` of the splats of the tile, nearest first.
fn blend_colors(
    blend: BlendKernel,
    splats: &[Splat],
    pairs: &[u32],
    sampled: &SampledPixels,
    background: [f32; 3],
) -> [TilePlane; 3] {
    let mut color = ColorSink { planes: [TilePlane::default(); 3] };
    let transmittance = blend.tile(splats, pairs, sampled, &mut color);
    for (plane, background) in color.planes.iter_mut().zip(background) {
        for (pixel, transmittance) in plane.as_flattened_mut().iter_mut().zip(transmittance.as_flattened()) {
            *pixel += transmittance.abs() * background;
        }
    }
    color.planes
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use splat_core::{AttributeValues, Attributes, Gradients};

    /// Returns 3000 Gaussians of many sizes, and a camera that looks at them. Width and height of the image are not
    /// multiples of the tile side.
    fn scene() -> (Gaussians, Camera) {
        let mut scene = Gaussians::zeros(3000, 0);
        for i in 0..scene.len() {
            // A low-discrepancy sequence gives every Gaussian another position, size and opacity.
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

    /// Returns the image, contributions, removal errors and gradients that `renderer` computes for the test scene.
    fn all_results(mut renderer: Renderer) -> (Image, Contribution, RemovalError, Gradients) {
        let (scene, camera) = scene();
        let mut seen = Contribution::new(scene.len());
        renderer.contribution(&scene, &camera, NonZeroU32::MIN, &mut seen);
        let mut errors = RemovalError::new(scene.len(), 0.1);
        renderer.removal_error(&scene, &camera, [0.3; 3], &mut errors);
        let mut gradients = Gradients::new(scene.len(), Attributes::all(), 0);
        let loss = |image: &Image| (0.0, image.clone());
        renderer.gradient(&scene, &camera, [0.3; 3], loss, &mut gradients);
        (renderer.render(&scene, &camera, [0.3; 3]), seen, errors, gradients)
    }

    #[test]
    fn instruction_sets_give_equal_bits() {
        let portable = all_results(Renderer { blend: BlendKernel::Portable, ..Renderer::new() });
        for blend in BlendKernel::all() {
            assert!(all_results(Renderer { blend, ..Renderer::new() }) == portable, "{blend:?} differs");
        }
    }

    #[test]
    fn colors_computed_for_several_views_give_the_same_images() {
        let (mut scene, camera) = scene();
        let coefficients = (0..12 * scene.len()).map(|k| (k as f32 * 0.618_034).fract() - 0.3);
        scene.sh = AttributeValues::from_planes(12, coefficients.collect());
        // The first block has no visible Gaussian.
        scene.opacity_logit.plane_mut(0)[..200].fill(-9.0);
        let cameras = [-0.4, 0.0, 0.3].map(|x| Camera { translation: DVec3::new(x, 0.1, 0.0), ..camera.clone() });
        let (mut renderer, mut colors) = (Renderer::on_all_threads(), ViewColors::default());
        let mut means = Vec::new();
        for cameras in [&cameras[..], &cameras[1..2], &cameras[..2]] {
            colors.fill(&scene, &cameras.iter().collect::<Vec<_>>());
            for (k, camera) in cameras.iter().enumerate() {
                let expected = renderer.render(&scene, camera, [0.3; 3]);
                assert!(renderer.render_with_colors(&scene, camera, [0.3; 3], (&colors, k)) == expected, "view {k}");
                means.push(expected.data.iter().sum::<f32>());
            }
        }
        assert_ne!(means[0], means[1], "the views should differ");
    }

    #[test]
    fn results_do_not_depend_on_the_number_of_threads() {
        let expected = all_results(Renderer::new());
        for threads in [1, 2, 7] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            assert!(pool.install(|| all_results(Renderer::on_all_threads())) == expected, "{threads} threads");
        }
    }

    #[test]
    fn results_do_not_depend_on_the_strip_size() {
        let whole = all_results(Renderer::new());
        let (scene, camera) = scene();
        let mut renderer = Renderer::new();
        renderer.prepare(&scene, &CameraTerms::new((&camera).into()), ColorSource::Coefficients);
        let tiles = renderer.bins.next_strip(&renderer.splats, usize::MAX).unwrap();
        let pairs = renderer.bins.pairs(0..7 * 5).len();
        assert_eq!(tiles, 0..7 * 5);
        for strip_pairs in [1, pairs / 20, pairs / 3, pairs] {
            for parallel in [false, true] {
                assert!(
                    all_results(Renderer { strip_pairs, ..Renderer::with_parallel(parallel) }) == whole,
                    "{strip_pairs} at a time"
                );
            }
            renderer.bins.begin(&renderer.splats, [7, 5], true);
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

    /// Returns grids of pixels for tests: with several strides, each with all offsets of the first column and several
    /// offsets of the first row.
    fn grids() -> impl Iterator<Item = PixelGrid> {
        [[2, 1], [1, 2], [2, 2], [3, 3], [4, 2], [5, 5]].into_iter().flat_map(|strides| {
            let strides = strides.map(|stride| NonZeroU32::new(stride).unwrap());
            (0..strides[0].get()).map(move |phase| PixelGrid::new(strides, [phase, 3 * phase + 1]))
        })
    }

    #[test]
    fn grid_render_equals_the_pixels_of_the_full_render() {
        let (mut scene, camera) = scene();
        // Opaque round Gaussians, which are cut off at the edge of their tiles.
        for i in 0..100 {
            scene.log_scale.set_row(i, [-3.0; 3]);
            scene.opacity_logit.set_row(i, [9.0]);
        }
        let mut renderer = Renderer::new();
        let whole = renderer.render(&scene, &camera, [0.3; 3]);
        let mut bounded = 0;
        for grid in grids() {
            let got = renderer.render(&scene, grid.sampled_view(&camera), [0.3; 3]);
            bounded += renderer.splats.splats.iter().filter(|splat| splat.drawn_tiles != Splat::UNBOUNDED).count();
            assert_eq!([got.width, got.height], grid.size([camera.width, camera.height]));
            for (k, pixel) in got.data.as_chunks::<3>().0.iter().enumerate() {
                let [x, y] = [grid.pixel(0, k as u32 % got.width), grid.pixel(1, k as u32 / got.width)];
                let expected = whole.data.as_chunks::<3>().0[(y * camera.width + x) as usize];
                for (got, expected) in pixel.iter().zip(expected) {
                    assert!((got - expected).abs() < 2e-5, "{grid:?}, pixel {x}, {y}: got {got}, expected {expected}");
                }
            }
        }
        assert!(bounded > 100, "{bounded} splats are cut off");
    }

    #[test]
    fn gradients_of_all_phases_add_up_to_the_full_gradient() {
        let (scene, camera) = scene();
        let gradient = |view: SampledView<'_>| {
            let mut gradients = Gradients::new(scene.len(), Attributes::all(), 0);
            let loss = |image: &Image| (0.0, image.clone());
            Renderer::new().gradient(&scene, view, [0.3; 3], loss, &mut gradients);
            gradients
        };
        let strides = [3, 2].map(|stride| NonZeroU32::new(stride).unwrap());
        let phases = (0..6).map(|k| PixelGrid::new(strides, [k % 3, k / 3]));
        let parts: Vec<Gradients> = phases.map(|grid| gradient(grid.sampled_view(&camera))).collect();
        let whole = gradient((&camera).into());
        for column in Attributes::all().iter() {
            let expected = whole.derivatives(column).planes();
            let largest = expected.iter().fold(0.0f32, |largest, x| largest.max(x.abs()));
            for (i, &expected) in expected.iter().enumerate() {
                let sum: f64 = parts.iter().map(|part| f64::from(part.derivatives(column).planes()[i])).sum();
                let error = (sum - f64::from(expected)).abs();
                assert!(error <= f64::from(1e-5 * largest), "{column:?} {i}: got {sum}, expected {expected}");
            }
        }
    }

    #[test]
    fn grid_results_do_not_depend_on_threads_or_instructions() {
        let (scene, camera) = scene();
        let results = |mut renderer: Renderer, grid: PixelGrid| {
            let mut seen = Contribution::new(scene.len());
            renderer.contribution(&scene, &camera, NonZeroU32::new(grid.stride(0)).unwrap(), &mut seen);
            let mut errors = RemovalError::new(scene.len(), 0.1);
            renderer.removal_error(&scene, grid.sampled_view(&camera), [0.3; 3], &mut errors);
            let mut gradients = Gradients::new(scene.len(), Attributes::all(), 0);
            let loss = |image: &Image| (0.0, image.clone());
            renderer.gradient(&scene, grid.sampled_view(&camera), [0.3; 3], loss, &mut gradients);
            (seen, errors, gradients)
        };
        for grid in grids() {
            let expected = results(Renderer::new(), grid);
            assert!(results(Renderer::on_all_threads(), grid) == expected, "{grid:?} differs with threads");
            for blend in BlendKernel::all() {
                assert!(results(Renderer { blend, ..Renderer::new() }, grid) == expected, "{grid:?} {blend:?} differs");
            }
        }
    }
}
