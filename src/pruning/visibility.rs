//! Stage `visible`: measures how much every Gaussian contributes to the views by which Gaussians are scored, occlusion
//! included.

use std::num::NonZeroU32;
use std::ops::Range;

use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{CONTRIBUTION_COST, ResourceEstimate, Workload};
use crate::model::{Attributes, Statistic, StatisticRows};
use crate::passes::{frames_needed_to_see_all, pixel_stride, scoring_views};
use crate::pruning::contribution::{VisibleContribution, visible_contribution};
use crate::recipe::{self, Coverage};
use crate::render::Contribution;
use crate::scene::Scene;

/// Name of this stage in messages and in the cache.
pub(crate) const NAME: &str = "visible";
/// Maximum number of views of a stage that needs few of them ([`VisibilityStage::needs_few_views`]).
const FEW_VIEWS: usize = 16;

/// Stage that renders views to measure the contribution C of every Gaussian (Σ alpha · transmittance over the pixels of
/// a view, averaged over views) and its peak W (maximum in one pixel).
#[derive(Debug, Clone)]
pub struct VisibilityStage {
    /// Parameters by which statistics are computed. This stage uses only the strides of pixels, views and frames, and
    /// the maximum number of views.
    pub recipe: recipe::ScanParams,
    /// Whether pruning rounds will rank the Gaussians again. If so, this stage renders only every n-th column and row of
    /// pixels, so that there is about one pixel per Gaussian.
    pub is_preliminary: bool,
    /// Whether the contributions only show that the cameras see the scene, and order the Gaussians that no view of the
    /// pruning rounds shows. If so, this stage renders at most [`FEW_VIEWS`] views, or as many as there are frames needed
    /// to see all Gaussians, if these are more.
    pub needs_few_views: bool,
}

impl VisibilityStage {
    /// Returns the stage that measures contributions on rendered views, or `None` if `recipe` measures the contribution
    /// C without renders. `has_cameras`: whether the scene has cameras of its own, rather than a virtual rig (cameras
    /// placed by the program).
    pub fn from_recipe(recipe: &recipe::ScanParams, has_cameras: bool) -> Option<VisibilityStage> {
        let looks = match recipe.coverage {
            Coverage::Auto => has_cameras,
            Coverage::Visible => true,
            Coverage::Projected => false,
        };
        looks.then(|| VisibilityStage { recipe: recipe.clone(), is_preliminary: false, needs_few_views: false })
    }

    /// Estimates the memory and time that this stage needs for the input `work`. Memory holds the statistics of the
    /// scan, the contribution C and the peak W (largest weight in one pixel) of every Gaussian, and the views being
    /// rendered.
    pub fn resource_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let (mut per_gaussian, mut fixed) =
            work.view_pass_memory(limits, Attributes::all().difference(Attributes::SH), 12);
        let every = (self.recipe.frame_stride.get() * self.recipe.view_stride.get()) as f64;
        let strided = work.frame_views as f64 / every;
        let max_views = match self.recipe.scoring_views {
            0 => f64::INFINITY,
            max_views => max_views as f64,
        };
        let frames = work.frames.div_ceil(self.recipe.frame_stride.get().into());
        let frames = if strided > max_views { frames.min(max_views as u64) } else { frames };
        let rows = StatisticRows::BYTES_PER_GAUSSIAN + Statistic::C.bytes() + Statistic::W.bytes();
        per_gaussian.insert(0, ("statistics", rows as u64));
        fixed.push(Workload::view_list_memory(strided.min(max_views)));
        if every > 1.0 {
            // Strides turn a schedule (list of views per frame) into a second one, with an entry for each frame.
            fixed.push(("schedule", 2 * (16 * work.frames + 8 * strided as u64)));
        }
        let stride = self.pixel_stride(work.pixels, work.gaussians as usize);
        let seconds = work.reading_seconds(work.gaussian_count(), frames as f64)
            + work.on_grid([stride; 2]).render_seconds(
                strided.min(max_views),
                work.gaussian_count(),
                CONTRIBUTION_COST,
            );
        ResourceEstimate { stage: NAME, reads: work.whole_input_reads(frames, limits), seconds, per_gaussian, fixed }
    }

    /// Returns the stride n for the renders that measure the contributions of `count` Gaussians: only every n-th column
    /// and row of pixels is rendered. `pixels`: number of pixels of a view.
    fn pixel_stride(&self, pixels: u64, count: usize) -> NonZeroU32 {
        let of_ranking = if self.is_preliminary { pixel_stride(pixels, count as f64) } else { NonZeroU32::MIN };
        self.recipe.pixel_stride.max(of_ranking)
    }

    /// Returns whether the views of a frame can be chosen as soon as the frame has been read. This is possible only if
    /// the number of views is not limited; otherwise views can be chosen only after the last frame.
    pub fn can_render_on_arrival(&self) -> bool {
        self.recipe.scoring_views == 0
    }

    /// Renders views of `scene` and returns the contribution C and the peak W of every Gaussian. `life`: number of
    /// frames in which each Gaussian is alive (opacity ≥ alpha_min). Writes a warning to `journal` if the cameras see
    /// very few Gaussians.
    ///
    /// # Errors
    /// Fails if a frame cannot be read.
    pub fn run(&self, scene: &Scene, life: &[u32], journal: &mut Journal) -> Result<VisibleContribution> {
        let source = scene.source();
        let count = source.info().count;
        let frames = frames_needed_to_see_all(life, source.info().times.len());
        let max_views = if self.needs_few_views { frames.max(FEW_VIEWS) } else { usize::MAX };
        let recipe =
            recipe::ScanParams { scoring_views: self.recipe.scoring_views.min(max_views), ..self.recipe.clone() };
        let views = scoring_views(&scene.schedule, &recipe, frames);
        let stride = self.pixel_stride(scene.workload().pixels, count);
        let cameras = &scene.schedule.cameras[..];
        let look = |range: Range<usize>| {
            visible_contribution(source, (cameras, &views[range]), stride, scene.limits, &scene.events)
        };
        let seen: Result<VisibleContribution> = journal.run_stage(NAME, count, source, |_| {
            let key = scene.work.key(&(&views, stride));
            let found = scene.work.compute_in_shards(NAME, key, views.len(), look, |parts| {
                let mut sum = Contribution::new(count);
                for fraction in parts {
                    sum.merge(&fraction?);
                }
                Ok(VisibleContribution::from_sums(&sum, views.len(), stride))
            })?;
            Ok((found, count))
        });
        let seen = seen?;
        if scene.has_cameras {
            journal.notes.extend(wrong_scene_warning(&seen.peak, life, &scene.rig.origin));
        }
        Ok(seen)
    }
}

/// Minimum fraction of the Gaussians that the cameras must see, among the Gaussians that are alive (opacity ≥
/// alpha_min) in some frame. Cameras that see fewer probably belong to another scene. Cameras of trained models see two
/// thirds; those inside a scene that fills a room see a third.
const MIN_SEEN_FRACTION: f64 = 0.1;

/// Returns a warning for the user if very few of the Gaussians that are ever alive (opacity ≥ alpha_min) contribute to
/// any view, so that the cameras may belong to another scene. `peak`: largest contribution W of each Gaussian to a
/// pixel. `life`: number of frames in which each Gaussian is alive. `origin`: where the cameras came from, for the
/// message.
fn wrong_scene_warning(peak: &[f64], life: &[u32], origin: &str) -> Option<String> {
    let alive = life.iter().filter(|&&frames| frames > 0).count();
    let seen = peak.iter().zip(life).filter(|&(&peak, &frames)| frames > 0 && peak > 0.0).count();
    let fraction = seen as f64 / alive.max(1) as f64;
    (alive > 0 && fraction < MIN_SEEN_FRACTION).then(|| {
        format!(
            "warning: the cameras of {origin} see only {seen} of {alive} Gaussians ({:.1}%): check that they are the \
             cameras of this scene",
            100.0 * fraction
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;

    #[test]
    fn cameras_that_see_few_gaussians_cause_a_warning() {
        let life: Vec<u32> = (0..100).map(|i| u32::from(i < 50)).collect();
        let seeing = |range: usize| (0..100).map(|i| if i < range { 0.5 } else { 0.0 }).collect::<Vec<f64>>();
        assert_eq!(wrong_scene_warning(&seeing(5), &life, "far.json"), None);
        let said = wrong_scene_warning(&seeing(4), &life, "far.json").unwrap();
        assert!(said.contains("see only 4 of 50") && said.contains("far.json"), "{said}");
        assert_eq!(wrong_scene_warning(&[], &[], "far.json"), None);
    }

    #[test]
    fn virtual_rigs_are_used_only_on_request() {
        let mut recipe = Recipe::preset("default").unwrap().scan;
        let looks = |recipe: &recipe::ScanParams| {
            [true, false].map(|cameras| VisibilityStage::from_recipe(recipe, cameras).is_some())
        };
        assert_eq!(looks(&recipe), [true, false]);
        recipe.coverage = Coverage::Visible;
        assert_eq!(looks(&recipe), [true, true]);
        recipe.coverage = Coverage::Projected;
        assert_eq!(looks(&recipe), [false, false]);
    }
}
