//! Target views: renders of the original model, or photographs, that refinement fits Gaussians to.

use std::ops::Range;

use hashbrown::HashSet;
use rayon::prelude::*;
use serde::Serialize;

use crate::cache::{CacheKey, Spill, SpillWriter};
use crate::error::Result;
use crate::memory_plan::{SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload};
use crate::model::{Camera, FrameView, hash_id};
use crate::passes::{
    BatchLimits, RenderableView, RenderedSource, VIEWS_PER_FRAME, for_each_view_batch, select_evenly_over_frames,
    visible_ids,
};
use crate::recipe::RefineParams;
use crate::render::{ALL_PIXELS, GridStrides, Image, PixelGrid, Renderer, SampledView, ViewColors};
use crate::scene::Scene;
use crate::scene::photographs::Photographs;
use crate::scene::views_between::{SplitMix64, cameras_between};
use crate::scene::views_outside::{MIN_SCORED_OUTSIDE, cameras_outside};
use crate::source::Ids;

/// Name of the cache entry of the target views that show only renders.
pub(crate) const NAME: &str = "targets";
/// Name of the cache entry of the target views of which some show photographs.
const PHOTOGRAPHS_NAME: &str = "photograph-targets";
/// Numerator and denominator of the fraction of target views that are from the scene's cameras. All others are from new
/// cameras, which are between two of the scene's cameras or outside the rig.
const SCENE_VIEW_PART: [usize; 2] = [3, 26];
/// If more target views than this are asked for and the scene moves, there are fewer: four fifths, but at least this
/// many. With 800 in place of 1,000 views, the mean PSNR of three moving models at four counts is 0.03 dB lower, and a
/// run takes 2 to 5% less time. Two static captured models at 10% kept lose 0.2 and 0.3 dB, so static scenes have all.
const MOVING_VIEWS: usize = 800;
/// Maximum number of target views from the scene's cameras.
const MAX_SCENE_VIEWS: usize = 45;
/// Numerator and denominator of the fraction of target views that are photographs, in a refinement toward photographs.
const PHOTOGRAPH_PART: [usize; 2] = [20, 26];
/// Maximum number of target views that are photographs.
const MAX_PHOTOGRAPHS: usize = 400;
/// In a refinement toward photographs, `[a, b]` means: for every b photographs, a renders of the original from new
/// cameras are added as target views. They keep the result from overfitting the photographs.
const RENDERS_PER_PHOTOGRAPH: [usize; 2] = [3, 10];
/// Maximum number of bytes of all target views in the scratch file. There are at least [`MIN_VIEWS`] views even if they
/// exceed it.
const MAX_BYTES: u64 = 1 << 30;
/// Minimum number of target views, even if they exceed [`MAX_BYTES`].
const MIN_VIEWS: u64 = 96;
/// Approximate number of validation views of a refinement toward renders. Fewer than 256 target views have fewer
/// validation views, because of [`MIN_VALIDATION_EVERY`].
const VALIDATION_VIEWS: usize = 32;
/// Minimum n in "one of every n target views is a validation view": at most one view in eight is used for validation.
const MIN_VALIDATION_EVERY: usize = 8;

/// Number of views of a frame for which the colors of all Gaussians are computed together, before these views are
/// rendered. It is rounded up to a multiple of the number of views that are rendered at the same time.
const COLORED_VIEWS: usize = 4;

/// Number n by which validation photographs are chosen: the photographs of one in n cameras. If fewer than n cameras
/// have photographs, one in n photographs is chosen instead.
const VALIDATION_CAMERA_EVERY: usize = 8;

/// Number n: one of every n target views is a test view. Only runs with a quality target have test views, which serve
/// only to report the quality.
const TEST_EVERY: usize = 4;

/// Indices of the target views, divided by the purpose of the view.
#[derive(Clone)]
pub(crate) struct ViewSplit {
    /// Training views, to which optimization steps fit the parameters.
    pub(crate) training: Vec<usize>,
    /// Validation views, by which the best parameters are chosen.
    pub(crate) validation: Vec<usize>,
    /// Test views, used only to report the quality, not for training or validation.
    pub(crate) test: Vec<usize>,
}

/// Parameters by which target views are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct TargetViewParams {
    /// Maximum number of target views.
    pub max_count: usize,
    /// Whether some target views are from new cameras: between the scene's cameras, or outside the rig.
    pub between: bool,
    /// Number of frames from which target views are needed so that nearly all Gaussians are alive in one of them. Views
    /// are taken from at least so many frames if there are enough views from the scene's cameras.
    pub frames: usize,
}

impl TargetViewParams {
    pub(crate) fn from_recipe(params: &RefineParams) -> TargetViewParams {
        TargetViewParams { max_count: params.refine_target_views, between: params.refine_between, frames: 0 }
    }

    /// Returns a copy with `frames` as [`TargetViewParams::frames`].
    pub(crate) fn with_frames(self, frames: usize) -> TargetViewParams {
        TargetViewParams { frames, ..self }
    }

    /// Returns two numbers of target views of the input `work`: the number from the scene's cameras, and the number from
    /// new cameras. Their sum is at most the maximum. It is smaller if the scene moves (see [`MOVING_VIEWS`]), or if so
    /// many views would exceed [`MAX_BYTES`].
    pub(crate) fn view_counts(self, work: &Workload) -> [usize; 2] {
        let max_if_moving = self.max_count.min(MOVING_VIEWS.max(fraction([4, 5], self.max_count)));
        let max_count = if work.is_static() { self.max_count } else { max_if_moving };
        let count = total_count(max_count, work.pixels);
        let own = if self.between { fraction(SCENE_VIEW_PART, count).min(MAX_SCENE_VIEWS) } else { count };
        [own, count - own]
    }

    /// Returns two numbers of target views if some of them show photographs: the number of photographs, and the number
    /// of renders from new cameras. Their sum is at most the maximum, and smaller if so many views of `pixels` pixels
    /// would exceed [`MAX_BYTES`].
    pub(super) fn photograph_counts(self, pixels: u64) -> [usize; 2] {
        let photographs = fraction(PHOTOGRAPH_PART, total_count(self.max_count, pixels)).min(MAX_PHOTOGRAPHS);
        [photographs, self.renders_beside(photographs)]
    }

    /// Returns the number of renders from new cameras that target views have beside `photographs` photographs.
    fn renders_beside(self, photographs: usize) -> usize {
        if self.between { fraction(RENDERS_PER_PHOTOGRAPH, photographs) } else { 0 }
    }
}

/// Returns the number of target views of `pixels` pixels each: as many as fit into [`MAX_BYTES`], but at least
/// [`MIN_VIEWS`], and never more than `max_views`.
fn total_count(max_views: usize, pixels: u64) -> usize {
    (MAX_BYTES / (6 * pixels.max(1))).max(MIN_VIEWS).min(max_views as u64) as usize
}

/// Returns the number of views of a frame for which colors are computed together, if `together` views are rendered at
/// the same time. See [`COLORED_VIEWS`].
fn colored_views(together: usize) -> usize {
    COLORED_VIEWS.next_multiple_of(together.max(1))
}

/// Returns how many bytes of memory per Gaussian the renderers and the colors of target views take, if `together` views
/// are rendered at the same time.
pub(super) fn render_bytes_per_gaussian(together: u64) -> u64 {
    together * SHARED_VIEW_BYTES_PER_GAUSSIAN + (colored_views(together as usize) * ViewColors::BYTES) as u64
}

/// Returns `count` · `part` / `of`, rounded down.
fn fraction([part, of]: [usize; 2], count: usize) -> usize {
    part * count / of
}

/// Target views in a scratch file: renders of the original model, or photographs. Their cameras are the cameras by
/// which Gaussians are scored, new cameras between these and, if [`Scene::outside`] is not 0, new cameras outside the
/// rig. Training and validation views are stored only at the pixels of a grid; test views are stored as a whole.
pub(crate) struct Targets {
    pub(crate) cameras: Vec<Camera>,
    /// Camera and frame of each target view, sorted by frame.
    pub(crate) views: Vec<FrameView>,
    /// Indices in `cameras` of the cameras whose views are guard views (see [`Targets::is_guard`]).
    guard_cameras: Range<u32>,
    /// Purpose of each target view.
    purposes: Vec<Purpose>,
    strides: ViewStrides,
    /// Cache key of the target views and of what they show.
    pub(super) key: CacheKey,
    /// Scratch files, each with the range of consecutive views that it holds. A file has the color values (0 to 1 as
    /// 16-bit integers) of one view after the other.
    values: Vec<(Range<usize>, Spill)>,
}

/// Strides of the grids of pixels that are stored of target views. Test views are stored as a whole, and so are the
/// validation views of a search and of a fit to photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub(crate) struct ViewStrides {
    pub(crate) training: GridStrides,
    pub(crate) validation: GridStrides,
}

impl ViewStrides {
    /// Returns strides with which validation views are stored as a whole.
    pub(crate) fn with_whole_validation(training: GridStrides) -> ViewStrides {
        ViewStrides { training, validation: ALL_PIXELS }
    }
}

/// If [`Scene::outside`] is 1, this fraction of the new cameras of target views (renders that refinement fits) is
/// placed outside the rig. The other new cameras are placed between two cameras of the scene. For other values of
/// [`Scene::outside`], the fraction is in proportion to it.
///
/// [`Scene::outside`] is the weight, from 0 to 1, of the quality of renders from outside the rig. A camera is outside
/// the rig if it sees the scene from a new direction, one that does not lie between the directions of the scene's
/// cameras.
const OUTSIDE_FRACTION: f64 = 0.7;
/// A new camera outside the rig is a camera turned away from the mean direction of the rig. Its angle from there is
/// multiplied by a random factor from 1 to this value, but by at most 2. So at least half of the new cameras are at
/// twice the angle. In measurements, the value 2 placed cameras nearer to the rig and gained less quality outside.
const OUTSIDE_DRAWN_FACTOR: f64 = 3.0;

/// Purpose of a target view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Purpose {
    Training,
    Validation,
    Test,
}

impl Targets {
    /// Renders the views of the original that `params` asks for, fewer if they would exceed [`MAX_BYTES`]. Stores them
    /// in a scratch file. Returns these target views. Of training and validation views, only the columns and rows of
    /// pixels at `strides` are rendered. If `has_test_views`, every fourth view is a test view; otherwise there are no
    /// test views.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or the scratch file cannot be written.
    pub(crate) fn new(
        scene: &Scene,
        params: TargetViewParams,
        strides: ViewStrides,
        has_test_views: bool,
    ) -> Result<Targets> {
        let [scene_views, new_views] = params.view_counts(&scene.workload());
        let seen = select_evenly_over_frames(&scene.schedule, scene_views, params.frames, VIEWS_PER_FRAME);
        let (cameras, views, guard_cameras) = add_new_views(scene, seen, new_views);
        let purpose = |k: usize| match guard_cameras.contains(&views[k].camera) {
            true => Purpose::Training,
            false => purpose(k, views.len(), has_test_views),
        };
        let purposes = (0..views.len()).map(purpose).collect();
        let key = scene.work.key(&(&cameras, &views, strides, has_test_views));
        let targets = Targets { cameras, views, guard_cameras, purposes, strides, key, values: Vec::new() };
        targets.filled(NAME, scene, |_| None)
    }

    /// Creates target views of two kinds and stores their pixels in a scratch file:
    /// - the views `seen` from the scene's cameras, which show photographs of the scene;
    /// - new cameras, if `params` asks for them, which show renders of the original and keep the result from
    ///   overfitting the photographs. Their number is in a fixed ratio to the number of photographs.
    ///
    /// The photographs of one in eight cameras are validation views. If fewer than eight cameras have photographs, one
    /// in eight photographs is a validation view. All other views are training views; of these only the pixels of
    /// a grid with the strides `strides` are stored.
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read, or if the scratch file cannot be written.
    pub(crate) fn with_photographs(
        scene: &Scene,
        params: TargetViewParams,
        strides: GridStrides,
        (seen, photographs): (Vec<FrameView>, &Photographs),
    ) -> Result<Targets> {
        let strides = ViewStrides::with_whole_validation(strides);
        let new_views = params.renders_beside(seen.len());
        // Index in the schedule of each of the cameras that `add_new_views` lists first.
        let used = scene.schedule.used_cameras();
        let mut cameras_with_photographs: Vec<u32> = seen.iter().map(|view| view.camera).collect();
        cameras_with_photographs.sort_unstable();
        cameras_with_photographs.dedup();
        let by_camera = cameras_with_photographs.len() >= VALIDATION_CAMERA_EVERY;
        let is_validation = |(k, view): &(usize, &FrameView)| match by_camera {
            true => {
                let camera = cameras_with_photographs.binary_search(&view.camera).unwrap_or_default();
                camera % VALIDATION_CAMERA_EVERY == VALIDATION_CAMERA_EVERY / 2
            }
            // Chooses another position in every group of n photographs, so that all cameras of a small rig take part.
            false => k % VALIDATION_CAMERA_EVERY == k / VALIDATION_CAMERA_EVERY % VALIDATION_CAMERA_EVERY,
        };
        let frame_and_view = |view: &FrameView| (view.frame, view.view);
        let validation: HashSet<(usize, u32)> =
            seen.iter().enumerate().filter(is_validation).map(|(_, view)| frame_and_view(view)).collect();
        let stamps = photographs.file_fingerprints(&seen)?;
        let (cameras, views, guard_cameras) = add_new_views(scene, seen, new_views);
        let purpose = |view: &FrameView| match validation.contains(&frame_and_view(view)) {
            true => Purpose::Validation,
            false => Purpose::Training,
        };
        let purposes = views.iter().map(purpose).collect();
        let key = scene.work.key(&(&cameras, &views, strides, stamps));
        let targets = Targets { cameras, views, guard_cameras, purposes, strides, key, values: Vec::new() };
        targets.filled(PHOTOGRAPHS_NAME, scene, |view| {
            // A view from a new camera has no photograph.
            let camera = *used.get(view.camera as usize)?;
            let view = FrameView { camera, ..view };
            photographs
                .has(view)
                .then(|| photographs.read(view, &scene.schedule.cameras[camera as usize], scene.background))
        })
    }

    /// Returns these target views with their color values in a scratch file, under `name` and their key in the cache. A
    /// view shows the image that `photograph` returns for it, or, if this is `None`, a render of the original.
    fn filled(
        mut self,
        name: &'static str,
        scene: &Scene,
        photograph: impl Fn(FrameView) -> Option<Result<Image>> + Sync,
    ) -> Result<Targets> {
        let make = |some: Range<usize>, values: &mut SpillWriter| {
            let Some(first) = self.views[some.clone()].first() else { return Ok(()) };
            // Tiles hold consecutive Gaussians: readers of some of these would decode most tiles twice.
            let has_tiles = scene.workload().input.frame_block > 0;
            let visible = if has_tiles { None } else { visible_ids(scene.source(), first.frame)? };
            let ids = visible.as_deref().map(Ids::List);
            let subject = [RenderedSource { ids, ..RenderedSource::all_gaussians(scene.source()) }];
            let mut next = some.start;
            let limits = BatchLimits::one_frame(&scene.limits);
            // One renderer for each view that is rendered at the same time. It keeps its buffers until the last batch.
            let together = limits.views.max(1);
            let mut renderers: Vec<Renderer> = (0..together).map(|_| Renderer::on_all_threads()).collect();
            let mut colors = ViewColors::default();
            let batch = BatchLimits { views: colored_views(together), ..limits };
            for_each_view_batch(subject, &self.cameras, &self.views[some], batch, |views| {
                // All views of a batch have the same frame.
                if let Some(view) = views.first() {
                    colors.fill(view.states[0], &views.iter().map(|view| view.camera).collect::<Vec<_>>());
                }
                for (part, views) in views.chunks(together).enumerate() {
                    let view_values = |(k, (view, renderer)): (usize, (&RenderableView<'_, 1>, &mut Renderer))| {
                        let colors = (&colors, part * together + k);
                        let grid = self.grid(next + k, self.strides.training);
                        let (state, sampled_view) = (view.states[0], grid.sampled_view(view.camera));
                        Ok(narrow(&match photograph(view.frame_view) {
                            Some(photograph) => sampled(&photograph?, grid),
                            None => renderer.render_with_colors(state, sampled_view, scene.background, colors),
                        }))
                    };
                    let jobs = views.par_iter().zip(renderers.par_iter_mut()).enumerate();
                    let made: Vec<Vec<u16>> = jobs.map(view_values).collect::<Result<_>>()?;
                    next += views.len();
                    made.iter().try_for_each(|view_values| values.write(bytemuck::cast_slice(view_values)))?;
                }
                Ok(())
            })
        };
        self.values = scene.work.spill_in_shards(name, self.key, self.views.len(), &scene.scratch, make)?;
        Ok(self)
    }

    /// Returns the strides of the grid of pixels that are stored of training views.
    pub(crate) fn strides(&self) -> GridStrides {
        self.strides.training
    }

    /// Returns the indices of the training, validation and test views.
    pub(crate) fn split(&self) -> ViewSplit {
        let with_purpose = |purpose| (0..self.views.len()).filter(|&k| self.purposes[k] == purpose).collect();
        ViewSplit {
            training: with_purpose(Purpose::Training),
            validation: with_purpose(Purpose::Validation),
            test: with_purpose(Purpose::Test),
        }
    }

    /// Returns the grid of the pixels of view `k` that are rendered and compared. For a training view, these are the
    /// pixels of a grid with the strides `strides`, which must be multiples of [`Targets::strides`]. For a validation
    /// view, the strides are those of its stored pixels. The first column and row come from a hash of `k`, so that
    /// different views sample different pixels. Of a test view, these are all pixels.
    fn grid(&self, k: usize, strides: GridStrides) -> PixelGrid {
        let strides = match self.purposes[k] {
            Purpose::Training => strides,
            Purpose::Validation => self.strides.validation,
            Purpose::Test => ALL_PIXELS,
        };
        let hash = hash_id(k as u64);
        PixelGrid::new(strides, [hash as u32, (hash >> 32) as u32])
    }

    /// Returns the camera of target view `k` with the grid of the pixels to render. [`Targets::values`] returns the
    /// target colors of the same pixels if it gets the same `strides`.
    pub(super) fn view(&self, k: usize, strides: GridStrides) -> SampledView<'_> {
        self.grid(k, strides).sampled_view(self.camera(k))
    }

    /// Returns the camera of target view `k`.
    pub(crate) fn camera(&self, k: usize) -> &Camera {
        &self.cameras[self.views[k].camera as usize]
    }

    /// Returns whether target view `k` is a guard view: a view from outside the rig, in a scene whose
    /// [`Scene::outside`] is below [`MIN_SCORED_OUTSIDE`]. The few guard views protect the quality of renders from
    /// outside. All are training views. Derivatives of their loss are scaled down to the usual magnitude, and prune
    /// steps do not rank by them. If the weight is larger, views from outside are used like all others, and there are
    /// no guard views.
    pub(super) fn is_guard(&self, k: usize) -> bool {
        self.guard_cameras.contains(&self.views[k].camera)
    }

    /// Returns how many columns and how many rows of pixels of view `k` are rendered and compared, if only the pixels of
    /// a grid with the strides `strides` are used.
    fn size(&self, k: usize, strides: GridStrides) -> [usize; 2] {
        let camera = self.camera(k);
        self.grid(k, strides).size([camera.width, camera.height]).map(|pixels| pixels as usize)
    }

    /// Reads the color values of target view `k` at the pixels that [`Targets::view`] returns: red, green, blue per
    /// pixel, 0 to 1 as 16-bit integers. `strides` must be multiples of [`Targets::strides`].
    ///
    /// # Errors
    /// Fails if the scratch file cannot be read.
    pub(crate) fn values(&self, k: usize, strides: GridStrides) -> Result<Vec<u16>> {
        let len = |k: usize| 3 * self.size(k, self.strides()).iter().product::<usize>();
        let mut values = vec![0u16; len(k)];
        for (some, spill) in self.values.iter().filter(|(some, _)| some.contains(&k)) {
            let before: usize = (some.start..k).map(len).sum();
            spill.read(2 * before as u64, bytemuck::cast_slice_mut(&mut values))?;
        }
        let [stored, wanted] = [self.strides(), strides].map(|strides| self.grid(k, strides));
        if stored == wanted {
            return Ok(values);
        }
        // Position on the stored grid of the first column and row of the wanted grid.
        let first = [0, 1].map(|axis| ((wanted.pixel(axis, 0) - stored.pixel(axis, 0)) / stored.stride(axis)) as usize);
        let step = [0, 1].map(|axis| (wanted.stride(axis) / stored.stride(axis)) as usize);
        let row_len = self.size(k, self.strides())[0];
        let rows = values.as_chunks::<3>().0.chunks_exact(row_len.max(1)).skip(first[1]).step_by(step[1]);
        Ok(rows.flat_map(|row| row.iter().skip(first[0]).step_by(step[0])).flatten().copied().collect())
    }
}

/// Returns the number n such that one of every n target views is a validation view. `views`: number of target views.
pub(super) fn validation_every(views: usize) -> usize {
    (views / VALIDATION_VIEWS).max(MIN_VALIDATION_EVERY)
}

/// Returns the purpose of the target view with the index `k` among `count` target views, all of which show renders. If
/// `has_test_views` is set, one in four views is used for testing.
fn purpose(k: usize, count: usize, has_test_views: bool) -> Purpose {
    match () {
        () if has_test_views && k % TEST_EVERY == TEST_EVERY - 1 => Purpose::Test,
        () if k % validation_every(count) == 1 => Purpose::Validation,
        () => Purpose::Training,
    }
}

/// Adds to `views`, by which Gaussians are scored, `new_views` views from new cameras: cameras between those of the
/// scene and, if [`Scene::outside`] is not 0, cameras outside the rig. Returns the cameras, the views sorted by frame,
/// and the indices of the cameras whose views are guard views ([`Targets::is_guard`]).
fn add_new_views(
    scene: &Scene,
    mut views: Vec<FrameView>,
    new_views: usize,
) -> (Vec<Camera>, Vec<FrameView>, Range<u32>) {
    let used = scene.schedule.used_cameras();
    let mut cameras: Vec<Camera> = used.iter().map(|&camera| scene.schedule.cameras[camera as usize].clone()).collect();
    for view in &mut views {
        view.camera = used.binary_search(&view.camera).unwrap_or_default() as u32;
    }
    let (seen, mut random) = (views.len(), SplitMix64(2));
    let rig = scene.rig_cameras();
    let more_views = if seen == 0 { 0 } else { new_views };
    let outer_views = (OUTSIDE_FRACTION * scene.outside * more_views as f64) as usize;
    let outer = cameras_outside(&rig, outer_views, OUTSIDE_DRAWN_FACTOR);
    let inner = cameras_between(&rig, more_views - outer.len());
    let guards = if scene.outside < MIN_SCORED_OUTSIDE { outer.len() } else { 0 };
    let guard_cameras = cameras.len() as u32..(cameras.len() + guards) as u32;
    for camera in outer.into_iter().chain(inner) {
        let frame = views[random.next_below(seen)].frame;
        views.push(FrameView { frame, view: u32::MAX, camera: cameras.len() as u32 });
        cameras.push(camera);
    }
    views.sort_by_key(|view| view.frame);
    (cameras, views, guard_cameras)
}

/// Returns the mean square error of `render` against the target view `target`, whose color values are 16-bit integers.
/// Color values are from 0 to 1; the render is clamped to this range.
pub(crate) fn mean_square(render: &Image, target: &[u16]) -> f64 {
    let square = |(value, &wanted): (&f32, &u16)| f64::from(value.clamp(0.0, 1.0) - wide(wanted)).powi(2);
    render.data.iter().zip(target).map(square).sum::<f64>() / target.len().max(1) as f64
}

/// Returns the pixels of `image` that are on `grid`.
fn sampled(image: &Image, grid: PixelGrid) -> Image {
    let [width, height] = grid.size([image.width, image.height]);
    let row = |y: u32| (0..width).map(move |x| [grid.pixel(0, x), grid.pixel(1, y)]);
    let colors = image.data.as_chunks::<3>().0;
    let color = |[x, y]: [u32; 2]| colors[y as usize * image.width as usize + x as usize];
    Image { width, height, data: (0..height).flat_map(row).flat_map(color).collect() }
}

/// Converts the color values of a render, 0 to 1, to 16-bit integers. Values outside this range are clamped.
pub(super) fn narrow(image: &Image) -> Vec<u16> {
    // NaN becomes 0.
    image.data.iter().map(|value| (value.clamp(0.0, 1.0) * f32::from(u16::MAX)).round() as u16).collect()
}

/// Converts a 16-bit value made by [`narrow`] back to a value from 0 to 1.
pub(super) fn wide(value: u16) -> f32 {
    f32::from(value) / f32::from(u16::MAX)
}

#[cfg(test)]
impl TargetViewParams {
    /// Returns parameters for at most `max_count` target views, some of them from new cameras.
    pub(super) fn at_most(max_count: usize) -> TargetViewParams {
        TargetViewParams { max_count, between: true, frames: 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_bits_are_accurate_to_1e_5() {
        let image = Image { width: 1, height: 1, data: vec![0.0, 1.0, 0.123_456] };
        let back: Vec<f32> = narrow(&image).into_iter().map(wide).collect();
        assert!(back.iter().zip(&image.data).all(|(a, b)| (a - b).abs() < 1e-5), "{back:?}");
        let odd = Image { data: vec![-3.0, f32::NAN, 7.0], ..image };
        assert_eq!(narrow(&odd), [0, 0, u16::MAX]);
    }

    #[test]
    fn sampled_pixels_are_those_of_the_grid() {
        let [width, height] = [7u32, 5];
        let value = |x: u32, y: u32, channel: u32| (100 * y + 10 * x + channel) as f32;
        let colors = (0..height).flat_map(|y| (0..width).flat_map(move |x| (0..3).map(move |c| value(x, y, c))));
        let image = Image { width, height, data: colors.collect() };
        let grid = PixelGrid::new([3, 2].map(|stride| std::num::NonZeroU32::new(stride).unwrap()), [2, 1]);
        let found = sampled(&image, grid);
        assert_eq!([found.width, found.height], grid.size([width, height]));
        for y in 0..found.height {
            for x in 0..found.width {
                let at = 3 * (y * found.width + x) as usize;
                let expected = [0, 1, 2].map(|channel| value(grid.pixel(0, x), grid.pixel(1, y), channel));
                assert_eq!(found.data[at..at + 3], expected);
            }
        }
    }

    #[test]
    fn large_views_are_fewer_but_never_too_few() {
        let static_counts =
            |params: TargetViewParams, pixels| params.view_counts(&Workload::with_frames_and_pixels(1, pixels));
        assert_eq!(static_counts(TargetViewParams::at_most(1000), 320 * 256), [45, 955]);
        assert_eq!(static_counts(TargetViewParams::at_most(520), 0), [45, 475]);
        assert_eq!(static_counts(TargetViewParams::at_most(1000), 1352 * 1014), [15, 115]);
        assert_eq!(static_counts(TargetViewParams::at_most(1000), 1 << 40), [11, 85]);
        assert_eq!(static_counts(TargetViewParams::at_most(40), 1 << 40), [4, 36]);
        let moving = Workload::with_frames_and_pixels(2, 320 * 256);
        let moving_counts = [700, 1000, 2000].map(|count| TargetViewParams::at_most(count).view_counts(&moving));
        assert_eq!(moving_counts, [[45, 655], [45, 755], [45, 1555]]);
        let own = TargetViewParams { between: false, ..TargetViewParams::at_most(520) };
        assert_eq!((static_counts(own, 0), own.photograph_counts(0)), ([520, 0], [400, 0]));
        assert_eq!(TargetViewParams::at_most(1000).photograph_counts(320 * 256), [400, 120]);
        assert_eq!(TargetViewParams::at_most(1000).photograph_counts(1352 * 1014), [100, 30]);
    }

    #[test]
    fn number_of_validation_views_grows_to_32() {
        let count = |views: usize| (0..views).filter(|k| purpose(*k, views, false) == Purpose::Validation).count();
        assert_eq!([8, 130, 256, 520, 1000].map(count), [1, 17, 32, 33, 33]);
    }
}
