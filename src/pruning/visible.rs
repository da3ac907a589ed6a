//! Stage `visible`: what every Gaussian adds to the pictures, occlusion included.

use std::ops::Range;

use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{LOOK, ResourceEstimate, Workload};
use crate::model::{Columns, Rows, Statistic};
use crate::passes::{frames_to_see, looked_at};
use crate::pruning::contribution::{VisibleContribution, visible_contribution};
use crate::recipe::{self, Coverage};
use crate::render::Contribution;
use crate::scene::Scene;

/// What the stage is called.
pub(crate) const NAME: &str = "visible";

/// The look at the pictures of a run that measures C by them.
#[derive(Debug, Clone)]
pub struct Visible {
    /// Its parameters.
    pub recipe: recipe::ScanParams,
}

impl Visible {
    /// The stage, if `recipe` measures C by pictures; `has_cameras`: these are the scene's own, not a virtual rig.
    pub fn from_recipe(recipe: &recipe::ScanParams, has_cameras: bool) -> Option<Visible> {
        let looks = match recipe.coverage {
            Coverage::Auto => has_cameras,
            Coverage::Visible => true,
            Coverage::Projected => false,
        };
        looks.then(|| Visible { recipe: recipe.clone() })
    }

    /// The rows scanned so far, C and W, and pictures in the making.
    pub fn need(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let (mut per_gaussian, mut fixed) = work.looking(limits, Columns::all().difference(Columns::SH), 12);
        let every = (self.recipe.frame_stride.get() * self.recipe.view_stride.get()) as f64;
        let strided = work.pictures as f64 / every;
        let most = match self.recipe.look_pictures {
            0 => f64::INFINITY,
            most => most as f64,
        };
        let frames = work.frames.div_ceil(self.recipe.frame_stride.get().into());
        let frames = if strided > most { frames.min(most as u64) } else { frames };
        let rows = Rows::BYTES_PER_GAUSSIAN + Statistic::C.bytes() + Statistic::W.bytes();
        per_gaussian.insert(0, ("rows", rows as u64));
        fixed.push(Workload::listed(strided.min(most)));
        if every > 1.0 {
            // What strides leave of a schedule is another list for each frame.
            fixed.push(("schedule", 2 * (16 * work.frames + 8 * strided as u64)));
        }
        let seconds = work.reading(work.count(), frames as f64) + work.picturing(strided.min(most), work.count(), LOOK);
        ResourceEstimate { stage: NAME, reads: work.reads(frames, limits), seconds, per_gaussian, fixed }
    }

    /// Whether a frame's pictures are known as it arrives: of how many they are the ones to look at is only known at the end.
    pub fn can_look_on_arrival(&self) -> bool {
        self.recipe.look_pictures == 0
    }

    /// C and W of every Gaussian of `scene`, of which each lives in `life` frames.
    ///
    /// # Errors
    /// Frames that cannot be read.
    pub fn run(&self, scene: &Scene, life: &[u32], journal: &mut Journal) -> Result<VisibleContribution> {
        let source = scene.source();
        let count = source.info().count;
        let frames = frames_to_see(life, source.info().times.len());
        let pictures = looked_at(&scene.schedule, &self.recipe, frames);
        let stride = self.recipe.pixel_stride;
        let cameras = &scene.schedule.cameras[..];
        let look = |some: Range<usize>| {
            visible_contribution(source, (cameras, &pictures[some]), stride, scene.limits, &scene.events)
        };
        let seen: Result<VisibleContribution> = journal.stage(NAME, count, source, |_| {
            let key = scene.work.key(&(&pictures, stride));
            let found = scene.work.divided(NAME, key, pictures.len(), look, |parts| {
                let mut sum = Contribution::new(count);
                for part in parts {
                    sum.merge(&part?);
                }
                Ok(VisibleContribution::new(&sum, pictures.len(), stride))
            })?;
            Ok((found, count))
        });
        let seen = seen?;
        if scene.has_cameras {
            journal.notes.extend(foreign(&seen.peak, life, &scene.rig.origin));
        }
        Ok(seen)
    }
}

/// Part of the living Gaussians that cameras of their own scene see at least: of trained models they see two thirds, and of
/// a scene that fills a room from inside a third.
const SEEN_AT_LEAST: f64 = 0.1;

/// A warning where hardly a Gaussian that ever lives adds anything to a picture.
fn foreign(peak: &[f64], life: &[u32], origin: &str) -> Option<String> {
    let alive = life.iter().filter(|&&frames| frames > 0).count();
    let seen = peak.iter().zip(life).filter(|&(&peak, &frames)| frames > 0 && peak > 0.0).count();
    let part = seen as f64 / alive.max(1) as f64;
    (alive > 0 && part < SEEN_AT_LEAST).then(|| {
        format!(
            "warning: the cameras see {seen} of {alive} living Gaussians ({:.1}%): are they of this scene? ({origin})",
            100.0 * part
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;

    #[test]
    fn cameras_that_see_hardly_a_living_gaussian_are_warned_of() {
        let life: Vec<u32> = (0..100).map(|i| u32::from(i < 50)).collect();
        let seeing = |some: usize| (0..100).map(|i| if i < some { 0.5 } else { 0.0 }).collect::<Vec<f64>>();
        assert_eq!(foreign(&seeing(5), &life, "far.json"), None);
        let said = foreign(&seeing(4), &life, "far.json").unwrap();
        assert!(said.contains("see 4 of 50") && said.contains("far.json"), "{said}");
        assert_eq!(foreign(&[], &[], "far.json"), None);
    }

    #[test]
    fn pictures_of_a_virtual_rig_are_looked_at_only_when_asked_for() {
        let mut recipe = Recipe::preset("default").unwrap().scan;
        let looks =
            |recipe: &recipe::ScanParams| [true, false].map(|cameras| Visible::from_recipe(recipe, cameras).is_some());
        assert_eq!(looks(&recipe), [true, false]);
        recipe.coverage = Coverage::Visible;
        assert_eq!(looks(&recipe), [true, true]);
        recipe.coverage = Coverage::Projected;
        assert_eq!(looks(&recipe), [false, false]);
    }
}
