//! Evaluation: compares renders of the original and the compressed model with each other and with photographs.
//!
//! Frames are read one by one. Memory holds one frame state of each model, and one render of each per thread. For the
//! temporal error, the last images of every view that occurs again are kept: 12 bytes per pixel for two images per
//! view, or three with photographs. A shard first renders the last images of its views again.

pub mod baseline;
pub mod cost;
pub mod found;
pub mod method;
pub mod precision;
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
use crate::evaluation::found::{ByModel, Comparison, Evaluation, ImageScore, RigSides, TruthComparison, ViewScores};
use crate::files::atomic::{Replace, StagedFile, TargetKind, check_target};
use crate::journal::records::RenderTime;
use crate::limits::Limits;
use crate::memory_plan::{Budget, MemoryPlan, ResourceEstimate, Workload};
use crate::metrics::{self, flip, psnr, ssim, temporal_error};
use crate::model::{Camera, FrameView, Gaussians};
use crate::models::InputModel;
use crate::passes::{BatchLimits, RenderedSource, ViewStates, for_each_view_batch};
use crate::pipeline::stages::quality::render_times;
use crate::pipeline::summary::CameraSummary;
use crate::render::Image;
use crate::scene::outside::{RigCone, training_cameras};
use crate::scene::photographs::Photographs;
use crate::scene::pictures::{self, ViewSet, render_background, select_frames, select_views, spread_views};
use crate::scene::{InputOptions, Scene, open_compressed, open_scene};

/// Name of the stage, for progress and cache entries.
const NAME: &str = "evaluate";

/// Options of an evaluation.
#[derive(Debug, Clone)]
pub struct EvaluateOptions {
    /// Original model and its cameras. The split that these options request is ignored; see `views`.
    pub original: InputOptions,
    /// Path of the compressed model, in any format.
    pub compressed: PathBuf,
    /// Folder of photographs; `None`: compare with the original only.
    pub ground_truth: Option<PathBuf>,
    /// Views to compare.
    pub views: ViewSet,
    /// Maximum number of frames, spread evenly; `None`: all.
    pub max_frames: Option<usize>,
    /// Maximum number of views, spread over frames and cameras; `None`: all.
    pub max_views: Option<usize>,
    /// Background color: red, green, blue in [0, 1]; `None`: chosen by [`render_background`].
    pub background: Option<[f32; 3]>,
    /// Whether to compute FLIP, which takes longer than all other scores.
    pub flip: bool,
    /// CSV file for the scores of every view.
    pub csv: Option<PathBuf>,
    /// Policy for an existing CSV file.
    pub overwrite: Replace,
}

/// Renders both models from the selected views and compares them.
///
/// # Errors
/// Fails if inputs, cameras or photographs cannot be read, if the models have different frames, or if the CSV file
/// cannot be written.
pub fn evaluate(options: &EvaluateOptions) -> Result<Completion<Evaluation>> {
    Completion::from_result(evaluate_whole(options))
}

/// Runs [`evaluate`] and returns its result. A run that computes only one shard (part of a divided stage) ends with the
/// error [`Error::ShardDone`].
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

/// Returns the resource estimate of rendering and comparing two models. `work` holds the larger number of Gaussians.
pub fn resource_estimates(work: &Workload, limits: &Limits) -> Vec<ResourceEstimate> {
    // Three images of 12 bytes per pixel (both renders, the photograph), and the buffers of the metrics.
    let mut need = pictures::render_estimate(work, limits, NAME, 2, 3 * 12 + metrics::BYTES_PER_PIXEL as u64);
    need.per_gaussian.push(("other model", work.input.per_gaussian));
    need.fixed.push(("scores", size_of::<ViewScores>() as u64 * work.pictures));
    need.fixed.push(("previous views", 3 * 12 * work.viewpoints * work.pixels));
    vec![need]
}

impl EvaluateOptions {
    /// Returns all paths that are read, so that none of them is overwritten.
    pub fn input_paths(&self) -> Vec<&Path> {
        let mut inputs = vec![self.original.path.as_path(), &self.compressed];
        inputs.extend(self.original.cameras.as_deref());
        inputs.extend(self.ground_truth.as_deref());
        inputs
    }
}

/// Original and compressed model, opened, with the views on which they are compared.
pub struct ModelPair {
    /// Original model with the cameras of all splits.
    pub scene: Scene,
    compressed: Box<dyn InputModel>,
    /// Options with which the compressed model was opened.
    compressed_as: InputOptions,
    background: [f32; 3],
    flip: bool,
    views: Vec<FrameView>,
    truth_folder: Option<PathBuf>,
    truth: Option<Photographs>,
}

impl ModelPair {
    /// Opens both models and selects the views. Ignores the CSV file of `options`.
    ///
    /// # Errors
    /// Fails if inputs, cameras or the folder of photographs cannot be read, or if the models have different frames.
    pub fn open(options: &EvaluateOptions) -> Result<ModelPair> {
        let scene = open_scene(&InputOptions { split: None, ..options.original.clone() })?;
        let compressed = open_compressed(&options.compressed, &scene, &options.original)?;
        let background = render_background(options.background, &scene)?;
        let times = &scene.source().info().times;
        let mut chosen = select_views(&scene.rig, times, options.views)?;
        if let Some(frames) = options.max_frames {
            chosen = select_frames(chosen, frames);
        }
        if let Some(views) = options.max_views {
            chosen = spread_views(chosen, views);
        }
        let truth = match &options.ground_truth {
            Some(folder) => Some(Photographs::find(folder, &scene.rig, times, chosen.clone())?.1),
            None => None,
        };
        Ok(ModelPair {
            truth,
            truth_folder: options.ground_truth.clone(),
            compressed_as: InputOptions {
                path: options.compressed.clone(),
                iteration: None,
                ..options.original.clone()
            },
            views: chosen,
            scene,
            compressed,
            background,
            flip: options.flip,
        })
    }

    /// Plans the memory of the comparison; `needs` returns the estimates of its stages.
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
        let views = scene_work.pictures.max(self.views.len() as u64);
        let plan = MemoryPlan::fit_budget(
            Workload { gaussians, pictures: views, ..scene_work },
            budget,
            &self.scene.events,
            needs,
        )?;
        plan.send_times(budget.tell, &self.scene.events);
        self.scene.limits = plan.limits;
        Ok(())
    }

    /// Compares all views. With a cache folder, joins the results of shards; a run of one shard stores its shard and
    /// ends.
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read, or if the cache folder cannot be used.
    pub fn evaluate(&self) -> Result<Evaluation> {
        let evaluation = self.evaluate_as_first_stage()?;
        self.scene.work.end_shard_before("averaging")?;
        Ok(evaluation)
    }

    /// Compares all views as the first stage of a longer run: like [`ModelPair::evaluate`], but a run of one shard goes
    /// on to the next stage if the results of all shards are in the cache.
    ///
    /// # Errors
    /// Fails as [`ModelPair::evaluate`].
    pub fn evaluate_as_first_stage(&self) -> Result<Evaluation> {
        let compute = |range| Ok(self.scores(range, |_, _, _| ())?.0);
        self.evaluation(self.compute_sharded(NAME, compute)?)
    }

    /// Compares all views in one process and calls `observe` with the images of every view and the frame state of the
    /// original, from any thread. Returns the values of `observe` in the order of [`Evaluation::views`].
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read.
    pub fn observe<O: Send>(
        &self,
        observe: impl Fn(&Gaussians, &Camera, &RenderedViews) -> O + Sync,
    ) -> Result<(Evaluation, Vec<O>)> {
        let (scores, observed) = self.scores(0..self.views.len(), observe)?;
        Ok((self.evaluation(scores)?, observed))
    }

    /// Returns the values of `observe` for every view, like [`ModelPair::observe`], without scores. Runs as the stage
    /// `name`, which shards can divide.
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
            let mut all = Vec::with_capacity(range.len());
            self.show(&self.views[range], |views| {
                let observe_view = |view: &ViewStates<'_, 2>| {
                    let seen = observe(view.states[0], view.camera, &self.render_view(view)?);
                    progress.advance(1);
                    Ok(seen)
                };
                all.extend(views.par_iter().map(observe_view).collect::<Result<Vec<O>>>()?);
                Ok(())
            })?;
            Ok(all)
        })
    }

    /// Computes one value per view with `compute`, as the stage `name`, which shards can divide. Returns the values in
    /// order.
    fn compute_sharded<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        compute: impl Fn(Range<usize>) -> Result<Vec<T>>,
    ) -> Result<Vec<T>> {
        let work = &self.scene.work;
        let key = self.key()?;
        work.compute_in_shards(name, key, self.views.len(), compute, |parts| {
            let mut all = Vec::with_capacity(self.views.len());
            for part in parts {
                all.extend(part?);
            }
            Ok(all)
        })
    }

    /// Builds the evaluation from the scores of all views.
    fn evaluation(&self, scores: Vec<PairScores>) -> Result<Evaluation> {
        let times = &self.scene.source().info().times;
        let view_scores = |(&FrameView { frame, view, .. }, (loss, truth))| ViewScores {
            frame,
            time: times[frame],
            view,
            loss,
            truth,
        };
        let scores: Vec<ViewScores> = self.views.iter().zip(scores).map(view_scores).collect();
        let ground_truth = self.truth_folder.as_deref().and_then(|folder| {
            Some(TruthComparison {
                folder: folder.to_string_lossy().into_owned(),
                of: self.views.len(),
                compressed: Comparison::from_views(&scores, |picture| Some(picture.truth?.compressed))?,
                original: Comparison::from_views(&scores, |picture| Some(picture.truth?.original))?,
            })
        });
        let scene = &self.scene;
        let count = |input: &dyn InputModel| input.source().info().count;
        let path = ByModel {
            original: scene.path.to_string_lossy().into_owned(),
            compressed: self.compressed_as.path.to_string_lossy().into_owned(),
        };
        let size = ByModel { original: scene.input.size()?, compressed: self.compressed.size()? };
        Ok(Evaluation {
            tool: TOOL.to_owned(),
            path,
            count: ByModel { original: count(&*scene.input), compressed: count(&*self.compressed) },
            bytes: ByModel { original: size.original.total(), compressed: size.compressed.total() },
            size,
            cameras: CameraSummary {
                origin: scene.rig.origin.clone(),
                cameras: self.views.iter().map(|picture| picture.camera).collect::<HashSet<_>>().len(),
                pairs: self.views.len(),
            },
            background: self.background,
            loss: Comparison::from_views(&scores, |picture| Some(picture.loss)).expect("every view has this score"),
            rig_sides: RigSides::from_views(&scores, &self.outside_views()),
            ground_truth,
            render_ms: None,
            notes: scene.notes.iter().cloned().chain(size.compressed.why_larger_than(&size.original)).collect(),
            work_notes: scene.work.take_notes(),
            views: scores,
        })
    }

    /// Returns for every view whether it is outside the rig of the training cameras; `false` for all if there are none.
    fn outside_views(&self) -> Vec<bool> {
        let rig = &self.scene.rig;
        let cone = RigCone::new(&training_cameras(rig));
        self.views.iter().map(|view| cone.is_outside(&rig.cameras[view.camera as usize])).collect()
    }

    /// Returns the cache key of the scores, without the original and its cameras, which the cache adds.
    fn key(&self) -> Result<CacheKey> {
        if !self.scene.work.is_enabled() {
            return Ok(CacheKey::NONE);
        }
        let compressed = self.scene.input_digest(&self.compressed_as, &*self.compressed)?;
        let photographs = self.truth.as_ref().map(|truth| truth.file_stamps(&self.views)).transpose()?;
        Ok(CacheKey::new(&(compressed, photographs, &self.views, self.background, self.flip)))
    }

    /// Renders the views with the indices `places` in [`Evaluation::views`] again and passes them to `see`, each
    /// with the frame state of the original. Keeping all renders would take memory that grows with frames and views.
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read.
    pub fn render_again<O>(
        &self,
        places: &[usize],
        mut see: impl FnMut(usize, &Gaussians, &Camera, RenderedViews) -> O,
    ) -> Result<Vec<O>> {
        let mut places = places.to_vec();
        places.sort_unstable();
        places.dedup();
        let chosen: Vec<FrameView> = places.iter().map(|&place| self.views[place]).collect();
        let mut found = Vec::with_capacity(chosen.len());
        self.show(&chosen, |views| {
            for view in views {
                found.push(see(places[found.len()], view.states[0], view.camera, self.render_view(view)?));
            }
            Ok(())
        })?;
        Ok(found)
    }

    /// Returns the view at index `place` of [`Evaluation::views`].
    pub fn view(&self, place: usize) -> FrameView {
        self.views[place]
    }

    /// Renders `pictures` with both models and returns the values of `see`, in order. The first image is of the
    /// original. The views may be any views of the cameras of the scene.
    ///
    /// # Errors
    /// Fails if a frame cannot be read or if `see` fails.
    pub fn render_pairs<O: Send>(
        &self,
        pictures: &[FrameView],
        see: impl Fn([&Image; 2]) -> Result<O> + Sync,
    ) -> Result<Vec<O>> {
        let mut found = Vec::with_capacity(pictures.len());
        self.show(pictures, |views| {
            let compare_view = |view: &ViewStates<'_, 2>| {
                let images = [0, 1].map(|subject| view.render(subject, self.background));
                see([&images[0], &images[1]])
            };
            found.extend(views.par_iter().map(compare_view).collect::<Result<Vec<O>>>()?);
            Ok(())
        })?;
        Ok(found)
    }

    /// Returns the time of rendering a view of either model; the values differ between runs.
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

    /// Calls `visit` with batches of views, each with the frame states of the original and the compressed model.
    fn show(&self, pictures: &[FrameView], visit: impl FnMut(&[ViewStates<'_, 2>]) -> Result<()>) -> Result<()> {
        let subjects = [self.scene.source(), self.compressed.source()].map(RenderedSource::all);
        for_each_view_batch(
            subjects,
            &self.scene.rig.cameras,
            pictures,
            BatchLimits::one_frame(&self.scene.limits),
            visit,
        )
    }

    /// Computes the scores and the values of `observe` for the views in `range`. For the temporal error, first renders
    /// the last images of these views before `range` again.
    fn scores<O: Send>(
        &self,
        range: Range<usize>,
        observe: impl Fn(&Gaussians, &Camera, &RenderedViews) -> O + Sync,
    ) -> Result<(Vec<PairScores>, Vec<O>)> {
        let mut chosen = previous_views(&self.views, range.start, &self.views[range.clone()]);
        let again = chosen.len();
        chosen.extend_from_slice(&self.views[range]);
        let mut last_frame: HashMap<u32, usize> = HashMap::new();
        for picture in &chosen {
            last_frame.insert(picture.view, picture.frame);
        }
        let mut before: HashMap<u32, RenderedViews> = HashMap::new();
        let mut all = Vec::with_capacity(chosen.len() - again);
        let mut observed = Vec::with_capacity(chosen.len() - again);
        let mut shown = 0;
        let progress = self.scene.events.task(NAME, "views", (chosen.len() - again) as u64);
        self.show(&chosen, |views| {
            let first = shown;
            shown += views.len();
            let rendered: Vec<_> = views
                .par_iter()
                .enumerate()
                .map(|(k, view)| {
                    let rendered = self.render_view(view)?;
                    if first + k < again {
                        return Ok((rendered, None));
                    }
                    let scores = rendered.scores(before.get(&view.picture.view), self.flip);
                    let seen = observe(view.states[0], view.camera, &rendered);
                    progress.advance(1);
                    Ok((rendered, Some((scores, seen))))
                })
                .collect::<Result<_>>()?;
            for (shown, (rendered, found)) in views.iter().zip(rendered) {
                let FrameView { frame, view, .. } = shown.picture;
                if let Some((scores, seen)) = found {
                    all.push(scores);
                    observed.push(seen);
                }
                if last_frame.get(&view).is_some_and(|&last| last > frame) {
                    before.insert(view, rendered);
                } else {
                    before.remove(&view);
                }
            }
            Ok(())
        })?;
        Ok((all, observed))
    }

    /// Renders a view with both models and reads its photograph, if there is one.
    fn render_view(&self, view: &ViewStates<'_, 2>) -> Result<RenderedViews> {
        let &ViewStates { picture, camera, .. } = view;
        Ok(RenderedViews {
            original: view.render(0, self.background),
            compressed: view.render(1, self.background),
            truth: match &self.truth {
                Some(truth) if truth.has(picture) => Some(truth.read(picture, camera, self.background)?),
                _ => None,
            },
        })
    }
}

/// Returns, for every view that occurs in `range`, its last occurrence among the first `start` of `all`, in their
/// order.
fn previous_views(all: &[FrameView], start: usize, range: &[FrameView]) -> Vec<FrameView> {
    let mut views: HashSet<u32> = range.iter().map(|picture| picture.view).collect();
    let mut last: Vec<FrameView> =
        all[..start].iter().rev().filter(|picture| views.remove(&picture.view)).copied().collect();
    last.reverse();
    last
}

/// Scores of one view: of the compressed model against the original, and of both against the photograph, if any.
type PairScores = (ImageScore, Option<ByModel<ImageScore>>);

/// Images of one (frame, view), all of the same size.
pub struct RenderedViews {
    /// Render of the original.
    pub original: Image,
    /// Render of the compressed model.
    pub compressed: Image,
    /// Photograph; `None` if the view has none.
    pub truth: Option<Image>,
}

impl RenderedViews {
    /// Computes the scores; `before` holds the previous images of the same view, for the temporal error.
    fn scores(&self, before: Option<&RenderedViews>, with_flip: bool) -> PairScores {
        let size = |rendered: &RenderedViews| (rendered.original.width, rendered.original.height);
        // The image size can change with the camera of a view; then there is no temporal error.
        let before = before.filter(|before| size(before) == size(self));
        let loss = score(&self.compressed, &self.original, before.map(|b| [&b.compressed, &b.original]), with_flip);
        let truth = self.truth.as_ref().map(|truth| {
            let against = |image: fn(&RenderedViews) -> &Image| {
                score(image(self), truth, before.and_then(|b| Some([image(b), b.truth.as_ref()?])), with_flip)
            };
            ByModel {
                original: against(|rendered| &rendered.original),
                compressed: against(|rendered| &rendered.compressed),
            }
        });
        (loss, truth)
    }
}

/// Computes the scores of `a` against `b`; `before` holds the same two images at the previous frame of the view.
fn score(a: &Image, b: &Image, before: Option<[&Image; 2]>, with_flip: bool) -> ImageScore {
    let temporal = before.map(|[a_before, b_before]| temporal_error([a_before, a], [b_before, b]));
    ImageScore { psnr: psnr(a, b), ssim: ssim(a, b), temporal, flip: with_flip.then(|| flip(a, b)) }
}
