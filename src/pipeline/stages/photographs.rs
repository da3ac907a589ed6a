//! Stage `photographs`: fits the Gaussians, after their refinement toward renders of the original, to photographs of
//! the training views.

use std::path::PathBuf;

use crate::error::{Error, Result};
use crate::memory_plan::ResourceEstimate;
use crate::model::FrameView;
use crate::pipeline::planning::Planning;
use crate::pipeline::request::Goal;
use crate::pipeline::stage::{EstimateInput, Phase, RunState, Stage, StageList};
use crate::refinement::RefineStage;
use crate::refinement::photographs::FIT;
use crate::scene::Scene;
use crate::scene::view_selection::{ViewSet, select_views};

/// Stage that fits the Gaussians to photographs.
#[derive(Debug, Clone)]
struct PhotographStage {
    /// Parameters of the optimization, which are those of the refinement toward renders, without prune steps.
    refine: RefineStage,
    /// Folder of the photographs.
    folder: PathBuf,
    /// Whether the run searches for a maximum loss against the photographs of test views.
    is_searched: bool,
}

/// Adds the stage to `stages` if the request names photographs and the run refines. If it does not refine, records this
/// in `stages`.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    match (&planning.request.photographs, &planning.refine) {
        (None, _) => (),
        (Some(_), None) => stages.leave_out(FIT, "the run does not refine"),
        (Some(folder), Some(refine)) => {
            let refine = refine.clone().without_prune_steps();
            let is_searched = matches!(planning.request.goal, Some(Goal::Quality(_)));
            stages.add(Phase::Reduce, PhotographStage { refine, folder: folder.clone(), is_searched });
        }
    }
}

impl Stage for PhotographStage {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![self.refine.photographs_estimate(work, limits)]
    }

    fn parameters(&self) -> String {
        let RefineStage { steps, target_views, .. } = self.refine;
        let views = target_views.max_count;
        format!("photographs: {steps} steps toward {views} views, of which about three quarters are photographs")
    }

    fn check(&self, scene: &Scene) -> Result<()> {
        let (seen, photographs) = self.refine.find_photographs(scene, &self.folder)?;
        if self.is_searched {
            check_test_views_are_apart(scene, &seen)?;
        }
        photographs.check_files(&seen, &scene.schedule.cameras)
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        if run.result.is_empty() {
            return Ok(());
        }
        let scored = run.scored()?;
        let (seen, photographs) = self.refine.find_photographs(run.scene, &self.folder)?;
        let start = run.take_result();
        run.result =
            self.refine.fit_to_photographs(run.scene, &scored, (seen, &photographs), start, &mut run.journal)?;
        Ok(())
    }
}

/// Checks that the test views, on whose photographs the loss is measured, are not among the views `views`, to whose
/// photographs the result is fitted.
///
/// # Errors
/// Fails if there are no test or validation views, or if one of them is among `views`.
fn check_test_views_are_apart(scene: &Scene, views: &[FrameView]) -> Result<()> {
    let test = match scene.rig.held_out_split() {
        Some(_) => select_views(&scene.rig, &scene.source().info().times, ViewSet::HeldOut)?,
        None => views.to_vec(),
    };
    match test.iter().any(|view| views.contains(view)) {
        false => Ok(()),
        true => Err(Error::usage(
            "--max-loss measures photographs of test views, and --toward photographs would fit to the same ones: expected \
             cameras with a test split, and --split train",
        )),
    }
}
