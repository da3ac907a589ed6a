//! What compression cost: the renders of two models side by side, and beside photographs.
//!
//! Frames stream: at a time one state of either model, and per thread one picture of each. For the error
//! of what moves, the last pictures of every view that is seen again stay: 12 bytes per pixel, two or,
//! with ground truth, three pictures per view. A part of the pictures begins by making these of the views before it again.

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
use crate::evaluation::found::{Both, Comparison, Evaluation, ImageScore, PictureScores, TruthComparison};
use crate::files::atomic::{Kind, Replace, StagedFile, check_target};
use crate::journal::records::RenderTime;
use crate::limits::Limits;
use crate::memory_plan::{Budget, Plan, ResourceEstimate, Workload};
use crate::metrics::{self, flip, psnr, ssim, temporal_error};
use crate::model::{Camera, FrameView, Gaussians};
use crate::models::InputModel;
use crate::passes::{Batch, RenderedSource, ViewStates, show};
use crate::pipeline::stages::quality::render_times;
use crate::pipeline::summary::CameraSummary;
use crate::render::Image;
use crate::scene::photographs::Photographs;
use crate::scene::pictures::{self, ViewSet, background, pictures, spread_views, thin};
use crate::scene::{InputOptions, Scene, open_compressed, open_scene};

/// What comparing pictures is called.
const NAME: &str = "evaluate";

/// What to compare.
#[derive(Debug, Clone)]
pub struct EvaluateOptions {
    /// The model before compression and its cameras; of its split nothing is used.
    pub original: InputOptions,
    /// The model after it, of any kind.
    pub compressed: PathBuf,
    /// Folder of photographs.
    pub ground_truth: Option<PathBuf>,
    /// Part of the cameras' pictures to compare.
    pub part: ViewSet,
    /// Compare at most this many frames, evenly; none: all.
    pub max_frames: Option<usize>,
    /// Maximum number of views, spread over frames and cameras; `None`: all.
    pub max_views: Option<usize>,
    /// Red, green, blue in [0, 1]; none: see [`background`].
    pub background: Option<[f32; 3]>,
    /// Whether to compute FLIP too, which takes longer than all else.
    pub flip: bool,
    /// File for the scores of every picture.
    pub csv: Option<PathBuf>,
    /// Replace an earlier file.
    pub overwrite: Replace,
}

/// Renders both models at the cameras' pictures and compares them.
///
/// # Errors
/// Whatever is wrong with inputs, cameras, pictures or output; models whose frames are not the same.
pub fn evaluate(options: &EvaluateOptions) -> Result<Completion<Evaluation>> {
    Completion::from_result(evaluate_whole(options))
}

/// [`evaluate`] of a whole run, without parts.
///
/// # Errors
/// Those of [`evaluate`].
pub(crate) fn evaluate_whole(options: &EvaluateOptions) -> Result<Evaluation> {
    if let Some(csv) = &options.csv {
        check_target(csv, Kind::File, &options.inputs(), options.overwrite)?;
    }
    let mut side = ModelPair::open(options)?;
    side.keep_to(options.original.memory, needs)?;
    let mut evaluation = side.evaluate()?;
    evaluation.render_ms = side.render_time()?;
    if let Some(csv) = &options.csv {
        let staged = StagedFile::new(csv, options.overwrite)?;
        fs::write(staged.path(), evaluation.csv()).map_err(Error::io("write", csv))?;
        staged.commit()?;
    }
    Ok(evaluation)
}

/// What it takes to make pictures of two models, each of as many Gaussians at most, and to compare them.
pub fn needs(work: &Workload, limits: &Limits) -> Vec<ResourceEstimate> {
    // Both models' and the photograph, and what they are compared with.
    let mut need = pictures::need(work, limits, NAME, 2, 3 * 12 + metrics::BYTES_PER_PIXEL as u64);
    need.per_gaussian.push(("other model", work.input.per_gaussian));
    need.fixed.push(("scores", size_of::<PictureScores>() as u64 * work.pictures));
    need.fixed.push(("pictures before", 3 * 12 * work.viewpoints * work.pixels));
    vec![need]
}

impl EvaluateOptions {
    /// Every path that is read.
    pub fn inputs(&self) -> Vec<&Path> {
        let mut inputs = vec![self.original.path.as_path(), &self.compressed];
        inputs.extend(self.original.cameras.as_deref());
        inputs.extend(self.ground_truth.as_deref());
        inputs
    }
}

/// Two open models, and the pictures to compare them on.
pub struct ModelPair {
    /// The original and its cameras, those of every split.
    pub scene: Scene,
    compressed: Box<dyn InputModel>,
    /// How the compressed one was opened.
    compressed_as: InputOptions,
    background: [f32; 3],
    flip: bool,
    pictures: Vec<FrameView>,
    truth_folder: Option<PathBuf>,
    truth: Option<Photographs>,
}

impl ModelPair {
    /// Opens both models and finds every picture; of `options` the files to write are not looked at.
    ///
    /// # Errors
    /// Whatever is wrong with inputs, cameras or the folder of photographs; models whose frames are not
    /// the same.
    pub fn open(options: &EvaluateOptions) -> Result<ModelPair> {
        let scene = open_scene(&InputOptions { split: None, ..options.original.clone() })?;
        let compressed = open_compressed(&options.compressed, &scene, &options.original)?;
        let background = background(options.background, &scene)?;
        let times = &scene.source().info().times;
        let mut chosen = pictures(&scene.rig, times, options.part)?;
        if let Some(frames) = options.max_frames {
            chosen = thin(chosen, frames);
        }
        if let Some(views) = options.max_views {
            chosen = spread_views(chosen, views);
        }
        let truth = match &options.ground_truth {
            Some(folder) => Some(Photographs::of_some(folder, &scene.rig, times, chosen.clone())?.1),
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
            pictures: chosen,
            scene,
            compressed,
            background,
            flip: options.flip,
        })
    }

    /// Limits what comparing keeps in memory; `needs` names what is to be done.
    ///
    /// # Errors
    /// A budget that cannot work.
    pub fn keep_to(
        &mut self,
        budget: Budget,
        needs: impl Fn(&Workload, &Limits) -> Vec<ResourceEstimate>,
    ) -> Result<()> {
        let of_scene = self.scene.workload();
        let gaussians = of_scene.gaussians.max(self.compressed_count() as u64);
        let pictures = of_scene.pictures.max(self.pictures.len() as u64);
        let plan = Plan::fit(Workload { gaussians, pictures, ..of_scene }, budget, &self.scene.events, needs)?;
        plan.tell_time(budget.tell, &self.scene.events);
        self.scene.limits = plan.limits;
        Ok(())
    }

    /// Compares all pictures; in parts, if the scene's work folder has some.
    ///
    /// # Errors
    /// A source or a photograph that cannot be read; those of the work folder.
    pub fn evaluate(&self) -> Result<Evaluation> {
        let evaluation = self.compare()?;
        self.scene.work.end_shard_before("averaging")?;
        Ok(evaluation)
    }

    /// [`ModelPair::evaluate`] as the beginning of a longer run, which uses the same parts.
    ///
    /// # Errors
    /// Those of [`ModelPair::evaluate`].
    pub fn compare(&self) -> Result<Evaluation> {
        let compute = |some| Ok(self.scores(some, |_, _, _| ())?.0);
        self.evaluation(self.divided(NAME, compute)?)
    }

    /// [`ModelPair::compare`], undivided, of which `observe` sees every picture too, with the original's state, from any
    /// thread. Gives what it made of them in the order of [`Evaluation::pictures`].
    ///
    /// # Errors
    /// A source or a photograph that cannot be read.
    pub fn observe<O: Send>(
        &self,
        observe: impl Fn(&Gaussians, &Camera, &RenderedViews) -> O + Sync,
    ) -> Result<(Evaluation, Vec<O>)> {
        let (scores, observed) = self.scores(0..self.pictures.len(), observe)?;
        Ok((self.evaluation(scores)?, observed))
    }

    /// What `observe` makes of every picture, as [`ModelPair::observe`] has it, without scores: the stage `name`, in
    /// parts if the scene's work folder has some.
    ///
    /// # Errors
    /// A source or a photograph that cannot be read; those of the work folder.
    pub fn observe_in_parts<O: Send + Serialize + DeserializeOwned>(
        &self,
        name: &'static str,
        observe: impl Fn(&Gaussians, &Camera, &RenderedViews) -> O + Sync,
    ) -> Result<Vec<O>> {
        self.divided(name, |some| {
            let progress = self.scene.events.task(name, "pictures", some.len() as u64);
            let mut all = Vec::with_capacity(some.len());
            self.show(&self.pictures[some], |views| {
                let see = |view: &ViewStates<'_, 2>| {
                    let seen = observe(view.states[0], view.camera, &self.take(view)?);
                    progress.advance(1);
                    Ok(seen)
                };
                all.extend(views.par_iter().map(see).collect::<Result<Vec<O>>>()?);
                Ok(())
            })?;
            Ok(all)
        })
    }

    /// What `compute` finds of every picture, in order, as the stage `name`.
    fn divided<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        compute: impl Fn(Range<usize>) -> Result<Vec<T>>,
    ) -> Result<Vec<T>> {
        let work = &self.scene.work;
        let key = self.key()?;
        work.divided(name, key, self.pictures.len(), compute, |parts| {
            let mut all = Vec::with_capacity(self.pictures.len());
            for part in parts {
                all.extend(part?);
            }
            Ok(all)
        })
    }

    /// What the scores of all pictures say.
    fn evaluation(&self, scores: Vec<PairScores>) -> Result<Evaluation> {
        let times = &self.scene.source().info().times;
        let of_picture = |(&FrameView { frame, view, .. }, (loss, truth))| PictureScores {
            frame,
            time: times[frame],
            view,
            loss,
            truth,
        };
        let scores: Vec<PictureScores> = self.pictures.iter().zip(scores).map(of_picture).collect();
        let ground_truth = self.truth_folder.as_deref().and_then(|folder| {
            Some(TruthComparison {
                folder: folder.to_string_lossy().into_owned(),
                of: self.pictures.len(),
                compressed: Comparison::from_pictures(&scores, |picture| Some(picture.truth?.compressed))?,
                original: Comparison::from_pictures(&scores, |picture| Some(picture.truth?.original))?,
            })
        });
        let scene = &self.scene;
        let count = |input: &dyn InputModel| input.source().info().count;
        let path = Both {
            original: scene.path.to_string_lossy().into_owned(),
            compressed: self.compressed_as.path.to_string_lossy().into_owned(),
        };
        let size = Both { original: scene.input.size()?, compressed: self.compressed.size()? };
        Ok(Evaluation {
            tool: TOOL.to_owned(),
            path,
            count: Both { original: count(&*scene.input), compressed: count(&*self.compressed) },
            bytes: Both { original: size.original.whole(), compressed: size.compressed.whole() },
            size,
            cameras: CameraSummary {
                origin: scene.rig.origin.clone(),
                cameras: self.pictures.iter().map(|picture| picture.camera).collect::<HashSet<_>>().len(),
                pairs: self.pictures.len(),
            },
            background: self.background,
            loss: Comparison::from_pictures(&scores, |picture| Some(picture.loss))
                .expect("every picture has this score"),
            ground_truth,
            render_ms: None,
            notes: scene.notes.iter().cloned().chain(size.compressed.why_larger_than(&size.original)).collect(),
            work_notes: scene.work.take_notes(),
            pictures: scores,
        })
    }

    /// What scores follow from, beside the original and its cameras.
    fn key(&self) -> Result<CacheKey> {
        if !self.scene.work.keeps() {
            return Ok(CacheKey::NONE);
        }
        let compressed = self.scene.digest_of(&self.compressed_as, &*self.compressed)?;
        let photographs = self.truth.as_ref().map(|truth| truth.stamps(&self.pictures)).transpose()?;
        Ok(CacheKey::new(&(compressed, photographs, &self.pictures, self.background, self.flip)))
    }

    /// Makes the pictures numbered `places` among [`Evaluation::pictures`] again (to keep all of them would
    /// take memory that grows with frames and views), each with the original's state.
    ///
    /// # Errors
    /// A source or a photograph that cannot be read.
    pub fn again<O>(
        &self,
        places: &[usize],
        mut see: impl FnMut(usize, &Gaussians, &Camera, RenderedViews) -> O,
    ) -> Result<Vec<O>> {
        let mut places = places.to_vec();
        places.sort_unstable();
        places.dedup();
        let chosen: Vec<FrameView> = places.iter().map(|&place| self.pictures[place]).collect();
        let mut found = Vec::with_capacity(chosen.len());
        self.show(&chosen, |views| {
            for view in views {
                found.push(see(places[found.len()], view.states[0], view.camera, self.take(view)?));
            }
            Ok(())
        })?;
        Ok(found)
    }

    /// That of the number `place` among [`Evaluation::pictures`].
    pub fn picture(&self, place: usize) -> FrameView {
        self.pictures[place]
    }

    /// What `see` makes of both models' pictures, the original's first, of any `pictures` of the scene's cameras, in order.
    ///
    /// # Errors
    /// A source that cannot be read; those of `see`.
    pub fn both<O: Send>(
        &self,
        pictures: &[FrameView],
        see: impl Fn([&Image; 2]) -> Result<O> + Sync,
    ) -> Result<Vec<O>> {
        let mut found = Vec::with_capacity(pictures.len());
        self.show(pictures, |views| {
            let of = |view: &ViewStates<'_, 2>| {
                let images = [0, 1].map(|subject| view.render(subject, self.background));
                see([&images[0], &images[1]])
            };
            found.extend(views.par_iter().map(of).collect::<Result<Vec<O>>>()?);
            Ok(())
        })?;
        Ok(found)
    }

    /// Returns the time of rendering a view of either model; the values differ between runs.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    pub fn render_time(&self) -> Result<Option<RenderTime>> {
        render_times(&self.scene, self.compressed.source(), &self.pictures)
    }

    /// Gaussians of the compressed model.
    pub fn compressed_count(&self) -> usize {
        self.compressed.source().info().count
    }

    /// Shows the original and the compressed model.
    fn show(&self, pictures: &[FrameView], visit: impl FnMut(&[ViewStates<'_, 2>]) -> Result<()>) -> Result<()> {
        let subjects = [self.scene.source(), self.compressed.source()].map(RenderedSource::all);
        show(subjects, &self.scene.rig.cameras, pictures, Batch::of_frame(&self.scene.limits), visit)
    }

    /// Scores of `some` of the pictures. The last ones before them of their views are made again.
    fn scores<O: Send>(
        &self,
        some: Range<usize>,
        observe: impl Fn(&Gaussians, &Camera, &RenderedViews) -> O + Sync,
    ) -> Result<(Vec<PairScores>, Vec<O>)> {
        let mut chosen = last_before(&self.pictures, some.start, &self.pictures[some.clone()]);
        let again = chosen.len();
        chosen.extend_from_slice(&self.pictures[some]);
        let mut last_frame: HashMap<u32, usize> = HashMap::new();
        for picture in &chosen {
            last_frame.insert(picture.view, picture.frame);
        }
        let mut before: HashMap<u32, RenderedViews> = HashMap::new();
        let mut all = Vec::with_capacity(chosen.len() - again);
        let mut observed = Vec::with_capacity(chosen.len() - again);
        let mut shown = 0;
        let progress = self.scene.events.task(NAME, "pictures", (chosen.len() - again) as u64);
        self.show(&chosen, |views| {
            let first = shown;
            shown += views.len();
            let taken: Vec<_> = views
                .par_iter()
                .enumerate()
                .map(|(k, view)| {
                    let taken = self.take(view)?;
                    if first + k < again {
                        return Ok((taken, None));
                    }
                    let scores = taken.scores(before.get(&view.picture.view), self.flip);
                    let seen = observe(view.states[0], view.camera, &taken);
                    progress.advance(1);
                    Ok((taken, Some((scores, seen))))
                })
                .collect::<Result<_>>()?;
            for (shown, (taken, found)) in views.iter().zip(taken) {
                let FrameView { frame, view, .. } = shown.picture;
                if let Some((scores, seen)) = found {
                    all.push(scores);
                    observed.push(seen);
                }
                if last_frame.get(&view).is_some_and(|&last| last > frame) {
                    before.insert(view, taken);
                } else {
                    before.remove(&view);
                }
            }
            Ok(())
        })?;
        Ok((all, observed))
    }

    fn take(&self, view: &ViewStates<'_, 2>) -> Result<RenderedViews> {
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

/// Of every view of `these` the last of the first `start` of `pictures`, in their order.
fn last_before(pictures: &[FrameView], start: usize, these: &[FrameView]) -> Vec<FrameView> {
    let mut views: HashSet<u32> = these.iter().map(|picture| picture.view).collect();
    let mut last: Vec<FrameView> =
        pictures[..start].iter().rev().filter(|picture| views.remove(&picture.view)).copied().collect();
    last.reverse();
    last
}

/// Of a picture: compressed against original, and each against the ground truth, where that is given.
type PairScores = (ImageScore, Option<Both<ImageScore>>);

/// The pictures of one (frame, view), all of one size.
pub struct RenderedViews {
    /// Render of the original.
    pub original: Image,
    /// Render of the compressed model.
    pub compressed: Image,
    /// The photograph, where there are any.
    pub truth: Option<Image>,
}

impl RenderedViews {
    /// Scores, with those of motion from the pictures `before` of the same view.
    fn scores(&self, before: Option<&RenderedViews>, with_flip: bool) -> PairScores {
        let size = |taken: &RenderedViews| (taken.original.width, taken.original.height);
        // A view whose camera changed may have another size, and nothing to be compared with.
        let before = before.filter(|before| size(before) == size(self));
        let loss = score(&self.compressed, &self.original, before.map(|b| [&b.compressed, &b.original]), with_flip);
        let truth = self.truth.as_ref().map(|truth| {
            let against = |image: fn(&RenderedViews) -> &Image| {
                score(image(self), truth, before.and_then(|b| Some([image(b), b.truth.as_ref()?])), with_flip)
            };
            Both { original: against(|taken| &taken.original), compressed: against(|taken| &taken.compressed) }
        });
        (loss, truth)
    }
}

/// How close `a` is to `b`, given the same two at the view's frame before.
fn score(a: &Image, b: &Image, before: Option<[&Image; 2]>, with_flip: bool) -> ImageScore {
    let temporal = before.map(|[a_before, b_before]| temporal_error([a_before, a], [b_before, b]));
    ImageScore { psnr: psnr(a, b), ssim: ssim(a, b), temporal, flip: with_flip.then(|| flip(a, b)) }
}
