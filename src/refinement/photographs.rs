//! Refinement toward photographs: fits a compressed model, already refined toward renders of the original, to
//! photographs of the training views.

use std::path::Path;

use super::RefineStage;
use super::run::RefineRun;
use super::targets::Targets;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::journal::records::PhotographSummary;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::model::{FrameView, ViewSchedule};
use crate::passes::{VIEWS_PER_FRAME, select_evenly};
use crate::pruning::score::Scored;
use crate::scene::Scene;
use crate::scene::photographs::Photographs;
use crate::scene::view_selection::distinct_views;

/// Name of the stage in plans, progress and summaries.
pub(crate) const NAME: &str = "photographs";
/// Name of the fit in the list of omitted work.
pub(crate) const FIT: &str = "refinement toward photographs";
/// Minimum number of photographs of training views; with fewer, the run is refused.
const MIN_PHOTOGRAPHS: usize = 8;
/// Bytes of memory per pixel while a photograph is decoded: 16-bit RGBA, the same as floats, and the image.
const DECODE_BYTES_PER_PIXEL: u64 = 36;

impl RefineStage {
    /// Returns the views whose photographs in `folder` are used, for fitting or for validation, and these photographs.
    /// The views are spread over frames and cameras, and sorted by frame.
    ///
    /// # Errors
    /// Fails if the folder cannot be read, if it has photographs of fewer than [`MIN_PHOTOGRAPHS`] views, or if two
    /// cameras have the same view number at a frame.
    pub(crate) fn find_photographs(&self, scene: &Scene, folder: &Path) -> Result<(Vec<FrameView>, Photographs)> {
        // Views from cameras that the program placed outside the rig have no number.
        let numbered = scene.schedule.frame_views().filter(|view| view.view != u32::MAX);
        let views = distinct_views(&scene.rig, numbered)?;
        let looked_for = views.len();
        let (found, photographs) = Photographs::find(folder, &scene.rig, &scene.source().info().times, views)?;
        if found.len() < MIN_PHOTOGRAPHS {
            let expected = format!("photographs of {MIN_PHOTOGRAPHS} or more of the {looked_for} training views");
            return Err(Error::input(folder, "", expected, format!("{} of them", found.len())));
        }
        let schedule = ViewSchedule::from_views(scene.schedule.cameras.clone(), &found);
        let [count, _] = self.target_views.photograph_counts(scene.workload().pixels);
        Ok((select_evenly(&schedule, count, VIEWS_PER_FRAME), photographs))
    }

    /// Estimates the memory and time of the fit to photographs for the input `work`.
    pub(crate) fn photographs_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let mut need = self.estimate_for_views(work, limits, self.target_views.photograph_counts(work.pixels));
        need.stage = NAME;
        need.fixed.push(("photographs", work.threads * DECODE_BYTES_PER_PIXEL * work.pixels));
        need
    }

    /// Fits the model `compressed` to photographs and to renders of the original. There are two kinds of target views:
    /// photographs (`photographs`) of the views `seen` from the scene's cameras, and renders from new cameras. Some
    /// photographs are used for validation only (see [`Targets::with_photographs`]). Returns the state of the model
    /// with the highest PSNR on these validation photographs; this may be `compressed` itself.
    ///
    /// Records in `journal` the PSNR on the validation photographs before and after the fit. If the fit did not raise
    /// it, records the reason instead.
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read, or if a scratch file cannot be written.
    pub(crate) fn fit_to_photographs(
        &self,
        scene: &Scene,
        scored: &Scored,
        (seen, photographs): (Vec<FrameView>, &Photographs),
        compressed: CompressedModel,
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let count = compressed.len();
        if self.final_steps_in(scene, scored, count) == 0 {
            journal.leave_out(FIT, "no Gaussians were removed");
            return Ok(compressed);
        }
        let key = (self.key(), &compressed, &seen, photographs.file_fingerprints(&seen)?, &scored.protected);
        let key = scene.work.key(&key);
        journal.run_cached_stage(NAME, count, scene, key, |journal| {
            let strides = self.strides(&scene.workload(), count);
            let targets = Targets::with_photographs(scene, self.target_views, strides, (seen, photographs))?;
            let held_back = targets.split().validation.len();
            // The notes of a refinement are about renders of the original, so they are not taken over.
            let mut own = Journal::default();
            let result = RefineRun::new(NAME, self, scene, scored, &targets).refine_best(compressed, None, &mut own)?;
            match own.refined {
                Some(found) => {
                    let (before, result) = (found.before, found.result);
                    journal.photographs = Some(PhotographSummary { photographs: held_back, before, result });
                }
                None => {
                    let why = own.left_out.into_iter().next().map_or_else(String::new, |left| left.why);
                    journal.leave_out(FIT, format!("against the photographs that were held back, {why}"));
                }
            }
            Ok((result, count))
        })
    }
}
