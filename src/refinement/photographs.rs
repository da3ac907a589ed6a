//! Refinement toward photographs: fits a compressed model, already refined toward renders of the original, to
//! photographs of the training views.

use super::RefineStage;
use super::run::RefineRun;
use super::targets::{Targets, photograph_views};
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::journal::records::PhotographSummary;
use crate::model::FrameView;
use crate::pruning::score::Scored;
use crate::scene::Scene;
use crate::scene::photographs::Photographs;

/// Name of the stage in plans, progress and summaries.
pub(crate) const NAME: &str = "photographs";
/// Name of the fit among the omitted work, if the photographs that are held back do not become closer.
pub(crate) const FIT: &str = "refinement toward photographs";
/// Minimum number of photographs with which the model is fitted to photographs.
const MIN_PHOTOGRAPHS: usize = 8;

impl RefineStage {
    /// Returns the photographs in `folder` that the refinement fits Gaussians to, and their views, sorted by frame.
    ///
    /// # Errors
    /// Fails if the folder cannot be read, or if it has photographs of fewer than [`MIN_PHOTOGRAPHS`] of these views.
    pub(crate) fn find_photographs(
        &self,
        scene: &Scene,
        folder: &std::path::Path,
    ) -> Result<(Vec<FrameView>, Photographs)> {
        let views = photograph_views(scene, self.pictures);
        let looked_for = views.len();
        let found = Photographs::find(folder, &scene.rig, &scene.source().info().times, views)?;
        match found.0.len() {
            ..MIN_PHOTOGRAPHS => Err(Error::input(
                folder,
                "",
                format!(
                    "photographs of {MIN_PHOTOGRAPHS} or more of the {looked_for} training views that --toward uses"
                ),
                format!("{} of them", found.0.len()),
            )),
            _ => Ok(found),
        }
    }

    /// Fits the model `reduction` to `photographs` of the views `seen`, and to renders of the original from new cameras.
    /// Photographs of some cameras are held back for validation (see [`Targets::with_photographs`]): the result is the
    /// state of the model with the highest PSNR against them, which may be `reduction` itself. Adds this PSNR before and
    /// after the fit to `journal`, or the reason why nothing was changed.
    ///
    /// # Errors
    /// Fails if a frame or a photograph cannot be read, or if a scratch file cannot be written.
    pub(crate) fn fit_to_photographs(
        &self,
        scene: &Scene,
        scored: &Scored,
        (seen, photographs): (Vec<FrameView>, &Photographs),
        reduction: CompressedModel,
        journal: &mut Journal,
    ) -> Result<CompressedModel> {
        let count = reduction.len();
        let key = (self.key(), &reduction, &seen, photographs.file_stamps(&seen)?, &scored.protected);
        let key = scene.work.key(&key);
        journal.run_cached_stage(NAME, count, scene, key, |journal| {
            let stride = self.stride(scene.workload().pixels, count);
            let targets = Targets::with_photographs(scene, self.pictures, stride, (seen, photographs))?;
            let parts = targets.split();
            let held_back = parts.validation.len();
            // The notes of a refinement are about renders of the original, so they are not taken over.
            let mut own = Journal::default();
            let result = RefineRun::new(NAME, self, scene, scored, &targets, parts).refine_best(reduction, &mut own)?;
            match own.refined {
                Some(found) => {
                    let (before, result) = (found.before, found.result);
                    journal.photographs = Some(PhotographSummary { photographs: held_back, before, result });
                }
                None => {
                    let why = format!("it did not improve the PSNR against {held_back} photographs held back for it");
                    journal.leave_out(FIT, why);
                }
            }
            Ok((result, count))
        })
    }
}
