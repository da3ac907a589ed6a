//! Evaluation: compares renders of the compressed model with renders of the original and, if there are any, both with
//! photographs. [`ModelPair`] does the comparison, and [`Evaluation`] holds its result.
//!
//! Frames are read one by one. Memory holds:
//! - one frame state of each model,
//! - one render of each model per thread,
//! - for the temporal error (flicker between two frames of a view), the last images of every view that occurs again at
//!   a later frame. There are two images per view (renders of both models), or three with photographs. Each image takes
//!   12 bytes per pixel.
//!
//! A run can be limited to a shard, which is a range of the (frame, view) pairs. For each view in its range, such a run
//! first renders again the last image of this view before the range.

pub mod baseline;
pub mod cost;
pub mod method;
pub mod precision;
pub mod results;
pub mod trade_off;

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use hashbrown::{HashMap, HashSet};
use rayon::prelude::*;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::TOOL;
use crate::cache::{CacheKey, Completion};
use crate::error::{Error, Result};
use crate::evaluation::results::{
    Comparison, Evaluation, ImageQuality, InsideOutsideMeans, OriginalAndCompressed, TruthComparison, ViewQuality,
};
use crate::files::atomic::{Replace, StagedFile, TargetKind, check_target};
use crate::journal::records::RenderTime;
use crate::limits::Limits;
use crate::memory_plan::{Budget, MemoryPlan, ResourceEstimate, Workload};
use crate::metrics::{self, flip, psnr, ssim, temporal_error};
use crate::model::{Camera, FrameView, Gaussians, Split};
use crate::models::InputModel;
use crate::passes::{BatchLimits, RenderableView, RenderedSource, for_each_view_batch};
use crate::pipeline::stages::quality::render_times;
use crate::pipeline::summary::CameraSummary;
use crate::render::Image;
use crate::scene::photographs::Photographs;
use crate::scene::view_selection::{self, ViewSet, render_background, select_frames, select_views, spread_views};
use crate::scene::views_outside::{RigCone, training_cameras};
use crate::scene::{InputOptions, Scene, check_compressed, open_compressed, open_scene, tracking_notes};

/// Name of the evaluation stage, for progress and cache entries.
const NAME: &str = "evaluate";

/// Options of an evaluation of a compressed model.
#[derive(Debug, Clone)]
pub struct EvaluateOptions {
    /// Original model and its cameras. The split in these options is ignored: `views` selects the views.
    pub original: InputOptions,
    /// Path of the compressed model, in any format.
    pub compressed: PathBuf,
    /// Folder of photographs with which both models are compared; `None`: the models are compared only with each other.
    pub ground_truth: Option<PathBuf>,
    /// Views on which the models are compared.
    pub views: ViewSet,
    /// Maximum number of frames, spread evenly over the sequence; `None`: all frames.
    pub max_frames: Option<usize>,
    /// Maximum number of views, spread over frames and cameras; `None`: all views.
    pub max_views: Option<usize>,
    /// Background color: red, green, blue in [0, 1]; `None`: chosen by [`render_background`].
    pub background: Option<[f32; 3]>,
    /// Whether to compute FLIP, which takes longer than all other measures.
    pub flip: bool,
    /// Path of the CSV file for the quality measures of every view; `None`: no such file is written.
    pub csv: Option<PathBuf>,
    /// Policy for a CSV file that already exists.
    pub overwrite: Replace,
}

/// Opens the original and the compressed model, renders both from the selected views and compares the renders. Returns
/// the evaluation, or a report if the run computes only one shard (part of a divided stage).
///
/// # Errors
/// Fails if inputs, cameras or photographs cannot be read, if the models have different frames, or if the CSV file
/// cannot be written.
///
/// # Examples
/// Compares a model with itself in every view:
///
/// ```
/// # use splatsieve::diagnostics::{demo_scene::DemoScene, test_scene::write_scene};
/// # use splatsieve::progress::Events;
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let folder = tempfile::tempdir()?;
/// # let [model, cameras] = write_scene(&DemoScene::new(400, 4), folder.path(), &Events::default())?;
/// use splatsieve::cache::Completion;
/// use splatsieve::evaluation::{EvaluateOptions, evaluate};
/// use splatsieve::files::atomic::Replace;
/// use splatsieve::scene::InputOptions;
/// use splatsieve::scene::view_selection::ViewSet;
///
/// let options = EvaluateOptions {
///     original: InputOptions { path: model.clone(), cameras: Some(cameras), ..InputOptions::default() },
///     compressed: model,
///     ground_truth: None,
///     views: ViewSet::All,
///     max_frames: None,
///     max_views: None,
///     background: None,
///     flip: false,
///     csv: None,
///     overwrite: Replace::Never,
/// };
/// let Completion::Whole(found) = evaluate(&options)? else { panic!("the run is not divided into shards") };
/// assert!(found.loss.overall.ssim > 0.999_999);
/// # Ok(())
/// # }
/// ```
pub fn evaluate(options: &EvaluateOptions) -> Result<Completion<Evaluation>> {
    Completion::from_result(evaluate_whole(options))
}

/// Does the work of [`evaluate`], and returns the evaluation. A run that computes only one shard (part of a divided
/// stage) ends with the error [`Error::ShardDone`].
fn evaluate_whole(options: &EvaluateOptions) -> Result<Evaluation> {
    if let Some(csv) = &options.csv {
        check_target(csv, TargetKind::File, &options.input_paths(), options.overwrite)?;
    }
    let mut pair = ModelPair::open(options)?;
    pair.plan_memory(options.original.memory, resource_estimates)?;
    let mut evaluation = pair.evaluate()?;
    evaluation.render_ms = pair.render_time()?;
    if let Some(csv) = &options.csv {
        let staged = StagedFile::new(csv, options.overwrite)?;
        fs::write(staged.path(), evaluation.csv()).map_err(Error::io("write", csv))?;
        staged.commit()?;
    }
    Ok(evaluation)
}

/// Returns the resource estimate (memory, time, reads) of the stage that renders and compares two models, under the
/// limits `limits`. `work` holds the sizes of the input; its number of Gaussians must be that of the larger model.
pub fn resource_estimates(work: &Workload, limits: &Limits) -> Vec<ResourceEstimate> {
    // Three images of 12 bytes per pixel (both renders, the photograph), and the buffers of the metrics.
    let mut need =
        view_selection::render_estimate(work, limits, NAME, 2, 3 * 12 + metrics::METRIC_BYTES_PER_PIXEL as u64);
    need.per_gaussian.push(("other model", work.input.per_gaussian));
    need.fixed.push(("scores", size_of::<ViewQuality>() as u64 * work.frame_views));
    need.fixed.push(("previous views", 3 * 12 * work.viewpoints * work.pixels));
    vec![need]
}

impl EvaluateOptions {
    /// Returns the paths of all files and folders that an evaluation reads, which must not be overwritten.
    pub fn input_paths(&self) -> Vec<&Path> {
        let mut inputs = vec![self.original.path.as_path(), &self.compressed];
        inputs.extend(self.original.cameras.as_deref());
        inputs.extend(self.ground_truth.as_deref());
        inputs
    }
}

/// Original and compressed model, both open, together with the views on which they are compared.
pub struct ModelPair {
    /// Original model with the cameras of all splits (training, validation, test).
    pub scene: Scene,
    compressed: Box<dyn InputModel>,
    /// Options with which the compressed model was opened.
    compressed_as: InputOptions,
    background: [f32; 3],
    flip: bool,
    views: Vec<FrameView>,
    /// Split to which the views belong; `None` for views of all splits.
    split: Option<Split>,
    truth_folder: Option<PathBuf>,
    truth: Option<Photographs>,
}

impl ModelPair {
    /// Opens both models and selects the views. The CSV file in `options` is ignored.
    ///
    /// # Errors
    /// Fails if inputs, cameras or the folder of photographs cannot be read, or if the models have different frames.
    pub fn open(options: &EvaluateOptions) -> Result<ModelPair> {
        check_compressed(&options.compressed)?;
        let mut scene = open_scene(&InputOptions { split: None, ..options.original.clone() })?;
        let (compressed, note) = open_compressed(&options.compressed, &scene, &options.original)?;
        scene.notes.extend(note);
        let background = render_background(options.background, &scene)?;
        let times = &scene.source().info().times;
        let mut chosen = select_views(&scene.rig, times, options.views)?;
        if let Some(frames) = options.max_frames {
            chosen = select_frames(chosen, frames);
        }
        if let Some(views) = options.max_views {
            chosen = spread_views(chosen, views);
        }
        let find = |folder: &PathBuf| Photographs::find(folder, &scene.rig, times, chosen.clone());
        let truth = options.ground_truth.as_ref().map(find).transpose()?.map(|found| found.1);
        Ok(ModelPair {
            truth,
            truth_folder: options.ground_truth.clone(),
            compressed_as: InputOptions {
                path: options.compressed.clone(),
                iteration: None,
                ..options.original.clone()
            },
            views: chosen,
            split: options.views.split(&scene.rig),
            scene,
            compressed,
            background,
            flip: options.flip,
        })
    }

    /// Plans the memory of the comparison within `budget`. Sets the limits of the scene (such as the numbers of frames
    /// and views in memory at a time) by this plan. `needs` returns the resource estimates of the stages that will run.
    ///
    /// # Errors
    /// Fails if the stages cannot run within `budget`.
    pub fn plan_memory(
        &mut self,
        budget: Budget,
        needs: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Result<()> {
        let scene_work = self.scene.workload();
        let gaussians = scene_work.gaussians.max(self.compressed_count() as u64);
        let views = scene_work.frame_views.max(self.views.len() as u64);
        let plan = MemoryPlan::fit_budget(
            Workload { gaussians, frame_views: views, ..scene_work },
            budget,
            &self.scene.events,
            needs,
        )?;
        plan.send_stage_times(budget.tell, &self.scene.events);
        self.scene.limits = plan.limits;
        Ok(())
    }

    /// Renders and compares all views, and returns the evaluation:
    /// - A run that is limited to one shard stores the quality measures of its views and ends with
    ///   [`Error::ShardDone`].
    /// - A run without such a limit computes the missing shards and joins the quality measures of all shards.
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read, or if the cache folder cannot be used.
    pub fn evaluate(&self) -> Result<Evaluation> {
        let evaluation = self.evaluate_as_first_stage()?;
        self.scene.work.end_shard_run_before("averaging")?;
        Ok(evaluation)
    }

    /// Compares all views as the first stage of a longer run, which may be limited to one shard:
    /// - If the cache has the quality measures of all shards, returns the evaluation, so that the run can go on to its
    ///   next stage.
    /// - If the cache lacks some, ends with [`Error::ShardDone`] after it has stored the quality measures of its own
    ///   shard.
    ///
    /// # Errors
    /// Fails as [`ModelPair::evaluate`].
    pub fn evaluate_as_first_stage(&self) -> Result<Evaluation> {
        let compute = |range| Ok(self.compare_views(range, |_, _, _| ())?.0);
        self.evaluation(self.compute_sharded(NAME, compute)?)
    }

    /// Compares all views in one process, and also calls `observe` for every view, from any thread. Arguments of
    /// `observe`: the frame state of the original, the camera, and the images of the view. Returns the evaluation, and
    /// the values of `observe` in the order of [`Evaluation::views`].
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read.
    pub fn observe<O: Send>(
        &self,
        observe: impl Fn(&Gaussians, &Camera, &RenderedViews) -> O + Sync,
    ) -> Result<(Evaluation, Vec<O>)> {
        let (qualities, observed) = self.compare_views(0..self.views.len(), observe)?;
        Ok((self.evaluation(qualities)?, observed))
    }

    /// Renders every view and returns the values of `observe` for all views, in order. Arguments of `observe`: the
    /// frame state of the original, the camera, and the images of the view. Computes no quality measures. The work is
    /// done as the stage `name`, which can be divided into shards (ranges of the views).
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read, or if the cache folder cannot be used.
    pub fn observe_sharded<O: Send + Serialize + DeserializeOwned>(
        &self,
        name: &'static str,
        observe: impl Fn(&Gaussians, &Camera, &RenderedViews) -> O + Sync,
    ) -> Result<Vec<O>> {
        self.compute_sharded(name, |range| {
            let progress = self.scene.events.task(name, "views", range.len() as u64);
            self.map_views(&self.views[range], |view| {
                let value = observe(view.states[0], view.camera, &self.render_view(view)?);
                progress.advance(1);
                Ok(value)
            })
        })
    }

    /// Returns one value per view, in the order of the views. `compute` returns the values of the views in a range of
    /// indices. The work is done as the stage `name`, which can be divided into shards (ranges of the views).
    fn compute_sharded<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        compute: impl Fn(Range<usize>) -> Result<Vec<T>>,
    ) -> Result<Vec<T>> {
        self.scene.work.compute_in_shards(name, self.key()?, self.views.len(), compute, |parts| {
            Ok(parts.collect::<Result<Vec<Vec<T>>>>()?.into_iter().flatten().collect())
        })
    }

    /// Builds the evaluation from `qualities`, the quality measures of all views in order.
    fn evaluation(&self, qualities: Vec<FrameViewQuality>) -> Result<Evaluation> {
        let times = &self.scene.source().info().times;
        let with_view = |(&FrameView { frame, view, .. }, (loss, truth))| ViewQuality {
            frame,
            time: times[frame],
            view,
            loss,
            truth,
        };
        let view_qualities: Vec<ViewQuality> = self.views.iter().zip(qualities).map(with_view).collect();
        let ground_truth = self.truth_folder.as_deref().and_then(|folder| {
            Some(TruthComparison {
                folder: folder.to_string_lossy().into_owned(),
                compared_views: self.views.len(),
                compressed: Comparison::from_views(&view_qualities, |view| Some(view.truth?.compressed))?,
                original: Comparison::from_views(&view_qualities, |view| Some(view.truth?.original))?,
            })
        });
        let scene = &self.scene;
        let loss = Comparison::from_views(&view_qualities, |view| Some(view.loss)).expect("every view has this score");
        let blind = view_selection::blind_views_note(scene, &self.views, self.background, loss.overall.psnr)?;
        let count = |input: &dyn InputModel| input.source().info().count;
        let path = OriginalAndCompressed {
            original: scene.path.to_string_lossy().into_owned(),
            compressed: self.compressed_as.path.to_string_lossy().into_owned(),
        };
        let size = OriginalAndCompressed { original: scene.input.size()?, compressed: self.compressed.size()? };
        let larger = size.compressed.why_larger_than(&size.original);
        let notes = blind.map(str::to_owned).into_iter().chain(tracking_notes(&*scene.input, &*self.compressed));
        Ok(Evaluation {
            notes: notes.chain(scene.notes.iter().cloned()).chain(larger).collect(),
            tool: TOOL.to_owned(),
            path,
            count: OriginalAndCompressed { original: count(&*scene.input), compressed: count(&*self.compressed) },
            bytes: OriginalAndCompressed { original: size.original.total(), compressed: size.compressed.total() },
            size,
            cameras: CameraSummary {
                origin: scene.rig.origin.clone(),
                cameras: self.views.iter().map(|view| view.camera).collect::<HashSet<_>>().len(),
                pairs: self.views.len(),
            },
            split: self.split.map_or("all", Split::name).to_owned(),
            background: self.background,
            loss,
            rig_sides: InsideOutsideMeans::from_views(&view_qualities, &self.outside_views()),
            ground_truth,
            render_ms: None,
            work_notes: scene.work.take_notes(),
            views: view_qualities,
        })
    }

    /// Returns, for every view, whether its camera is outside the rig of the training cameras, that is, outside the
    /// cone that their directions span. Returns `false` for all views if there are no training cameras.
    fn outside_views(&self) -> Vec<bool> {
        let rig = &self.scene.rig;
        let cone = RigCone::new(&training_cameras(rig));
        self.views.iter().map(|view| cone.is_outside(&rig.cameras[view.camera as usize])).collect()
    }

    /// Returns the cache key of the quality measures. It contains the compressed model, the photographs, the views, the
    /// background, and whether FLIP is computed. The cache adds the original and its cameras to the key.
    fn key(&self) -> Result<CacheKey> {
        if !self.scene.work.is_enabled() {
            return Ok(CacheKey::NONE);
        }
        let compressed = self.scene.input_digest(&self.compressed_as, &*self.compressed)?;
        let photographs = self.truth.as_ref().map(|truth| truth.file_fingerprints(&self.views)).transpose()?;
        Ok(CacheKey::new(&(compressed, photographs, &self.views, self.background, self.flip)))
    }

    /// Renders the views with the indices `places` in [`Evaluation::views`] again, and calls `observe` for each of
    /// them. `places` may have any order. Arguments of `observe`: the index, the frame state of the original, the
    /// camera, and the images of the view. Returns the values of `observe`, sorted by the index, with one value per
    /// different index.
    ///
    /// The comparison does not keep its renders for this purpose, because they would take memory that grows with the
    /// numbers of frames and views.
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read.
    pub fn render_views_again<O>(
        &self,
        places: &[usize],
        mut observe: impl FnMut(usize, &Gaussians, &Camera, RenderedViews) -> O,
    ) -> Result<Vec<O>> {
        let mut places = places.to_vec();
        places.sort_unstable();
        places.dedup();
        let chosen: Vec<FrameView> = places.iter().map(|&place| self.views[place]).collect();
        let mut values = Vec::with_capacity(chosen.len());
        self.for_each_batch(&chosen, |views| {
            for view in views {
                values.push(observe(places[values.len()], view.states[0], view.camera, self.render_view(view)?));
            }
            Ok(())
        })?;
        Ok(values)
    }

    /// Returns the view at index `place` of [`Evaluation::views`].
    pub fn view(&self, place: usize) -> FrameView {
        self.views[place]
    }

    /// Renders `views` with both models and returns one value of `observe` per view, in order. Arguments of `observe`:
    /// the render of the original, then that of the compressed model. `views` may be any views of the scene's cameras,
    /// and must be sorted by frame.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or if `observe` fails.
    pub fn render_pairs<O: Send>(
        &self,
        views: &[FrameView],
        observe: impl Fn([&Image; 2]) -> Result<O> + Sync,
    ) -> Result<Vec<O>> {
        self.map_views(views, |view| {
            let images = [0, 1].map(|subject| view.render(subject, self.background));
            observe([&images[0], &images[1]])
        })
    }

    /// Measures and returns the median time of rendering one view with each model, milliseconds. The times differ
    /// between runs. Returns `None` if there are no views, or if a thread cannot be started.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    pub fn render_time(&self) -> Result<Option<RenderTime>> {
        render_times(&self.scene, self.compressed.source(), &self.views)
    }

    /// Returns the number of Gaussians of the compressed model.
    pub fn compressed_count(&self) -> usize {
        self.compressed.source().info().count
    }

    /// Calls `visit` for each of `views`, from any thread, and returns its values in the order of the views.
    fn map_views<O: Send>(
        &self,
        views: &[FrameView],
        visit: impl Fn(&RenderableView<'_, 2>) -> Result<O> + Sync,
    ) -> Result<Vec<O>> {
        let mut values = Vec::with_capacity(views.len());
        self.for_each_batch(views, |batch| {
            values.extend(batch.par_iter().map(&visit).collect::<Result<Vec<O>>>()?);
            Ok(())
        })?;
        Ok(values)
    }

    /// Calls `visit` for all `views`, in order, with a batch of views at a time. For each view of a batch, `visit` gets
    /// the frame states of the original and of the compressed model.
    fn for_each_batch(
        &self,
        views: &[FrameView],
        visit: impl FnMut(&[RenderableView<'_, 2>]) -> Result<()>,
    ) -> Result<()> {
        let subjects = [self.scene.source(), self.compressed.source()].map(RenderedSource::all_gaussians);
        for_each_view_batch(subjects, &self.scene.rig.cameras, views, BatchLimits::one_frame(&self.scene.limits), visit)
    }

    /// Renders and compares the views with the indices `range`. Returns the quality measures of these views, and the
    /// values of `observe` (arguments as in [`ModelPair::observe`]) for them. The temporal error of a view needs the
    /// image of the same view at an earlier frame. Therefore, for every view in `range`, its last image before `range`
    /// is first rendered again.
    fn compare_views<O: Send>(
        &self,
        range: Range<usize>,
        observe: impl Fn(&Gaussians, &Camera, &RenderedViews) -> O + Sync,
    ) -> Result<(Vec<FrameViewQuality>, Vec<O>)> {
        let mut chosen = previous_views(&self.views, range.start, &self.views[range.clone()]);
        let repeated_count = chosen.len();
        chosen.extend_from_slice(&self.views[range]);
        let mut last_frame: HashMap<u32, usize> = HashMap::new();
        for view in &chosen {
            last_frame.insert(view.view, view.frame);
        }
        let mut previous: HashMap<u32, RenderedViews> = HashMap::new();
        let mut qualities = Vec::with_capacity(chosen.len() - repeated_count);
        let mut observed = Vec::with_capacity(chosen.len() - repeated_count);
        let mut shown = 0;
        let progress = self.scene.events.task(NAME, "views", (chosen.len() - repeated_count) as u64);
        self.for_each_batch(&chosen, |views| {
            let first = shown;
            shown += views.len();
            let rendered: Vec<_> = views
                .par_iter()
                .enumerate()
                .map(|(k, view)| {
                    let rendered = self.render_view(view)?;
                    if first + k < repeated_count {
                        return Ok((rendered, None));
                    }
                    let quality = rendered.quality(previous.get(&view.frame_view.view), self.flip);
                    let value = observe(view.states[0], view.camera, &rendered);
                    progress.advance(1);
                    Ok((rendered, Some((quality, value))))
                })
                .collect::<Result<_>>()?;
            for (shown, (rendered, found)) in views.iter().zip(rendered) {
                let FrameView { frame, view, .. } = shown.frame_view;
                if let Some((quality, value)) = found {
                    qualities.push(quality);
                    observed.push(value);
                }
                if last_frame.get(&view).is_some_and(|&last| last > frame) {
                    previous.insert(view, rendered);
                } else {
                    previous.remove(&view);
                }
            }
            Ok(())
        })?;
        Ok((qualities, observed))
    }

    /// Renders a view with both models, and reads its photograph if there is one. Returns these images.
    fn render_view(&self, view: &RenderableView<'_, 2>) -> Result<RenderedViews> {
        let &RenderableView { frame_view, camera, .. } = view;
        Ok(RenderedViews {
            original: view.render(0, self.background),
            compressed: view.render(1, self.background),
            truth: match &self.truth {
                Some(truth) if truth.has(frame_view) => Some(truth.read(frame_view, camera, self.background)?),
                _ => None,
            },
        })
    }
}

/// Returns the views that must be rendered again before a range of views can be compared: for each view number in
/// `range`, the last (frame, view) pair with this view number before the range. `views` has the pairs of all images,
/// sorted by frame. `range` is the part of `views` that begins at the index `start`. The result has the order of
/// `views`.
fn previous_views(views: &[FrameView], start: usize, range: &[FrameView]) -> Vec<FrameView> {
    let mut view_numbers: HashSet<u32> = range.iter().map(|view| view.view).collect();
    let mut last: Vec<FrameView> =
        views[..start].iter().rev().filter(|view| view_numbers.remove(&view.view)).copied().collect();
    last.reverse();
    last
}

/// Quality measures of one view at one frame. First: quality measures of the compressed model against the original.
/// Second: quality measures of each model against the photograph, if there is one.
type FrameViewQuality = (ImageQuality, Option<OriginalAndCompressed<ImageQuality>>);

/// Images of one view at one frame, all of the same size.
pub struct RenderedViews {
    /// Render of the original.
    pub original: Image,
    /// Render of the compressed model.
    pub compressed: Image,
    /// Photograph; `None` if there is none of this view at this frame.
    pub truth: Option<Image>,
}

impl RenderedViews {
    /// Computes the quality measures of these images. `previous`: images of the same view at the previous frame, for
    /// the temporal error. `with_flip`: whether to compute FLIP.
    fn quality(&self, previous: Option<&RenderedViews>, with_flip: bool) -> FrameViewQuality {
        let size = |rendered: &RenderedViews| (rendered.original.width, rendered.original.height);
        // The image size can change with the camera of a view. Then the view has no temporal error.
        let previous = previous.filter(|previous| size(previous) == size(self));
        let loss =
            image_quality(&self.compressed, &self.original, previous.map(|b| [&b.compressed, &b.original]), with_flip);
        let truth = self.truth.as_ref().map(|truth| {
            let against = |image: fn(&RenderedViews) -> &Image| {
                image_quality(image(self), truth, previous.and_then(|b| Some([image(b), b.truth.as_ref()?])), with_flip)
            };
            OriginalAndCompressed {
                original: against(|rendered| &rendered.original),
                compressed: against(|rendered| &rendered.compressed),
            }
        });
        (loss, truth)
    }
}

/// Computes the quality measures of the image `a` against the image `b`. `previous`: images that correspond to `a` and
/// `b` at the previous frame of the view; if `None`, no temporal error is computed.
fn image_quality(a: &Image, b: &Image, previous: Option<[&Image; 2]>, with_flip: bool) -> ImageQuality {
    let temporal = previous.map(|[a_before, b_before]| temporal_error([a_before, a], [b_before, b]));
    ImageQuality { psnr: psnr(a, b), ssim: ssim(a, b), temporal, flip: with_flip.then(|| flip(a, b)) }
}
