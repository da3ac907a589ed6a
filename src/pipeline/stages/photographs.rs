//! Stage `photographs`: fits the Gaussians, after their refinement toward renders of the original, to photographs of the
//! training views.

use std::path::PathBuf;

use crate::error::Result;
use crate::memory_plan::ResourceEstimate;
use crate::pipeline::planning::Planning;
use crate::pipeline::stage::{EstimateInput, Phase, RunState, Stage, StageList};
use crate::refinement::RefineStage;
use crate::refinement::photographs::{FIT, NAME};
use crate::scene::Scene;

/// Stage that fits the Gaussians to photographs.
#[derive(Debug, Clone)]
struct PhotographStage {
    /// Parameters of the optimization, which are those of the refinement toward renders, without prune steps.
    refine: RefineStage,
    /// Folder of the photographs.
    folder: PathBuf,
}

/// Adds the stage to `stages` if the request names photographs and the run refines. If it does not refine, records this
/// in `stages`.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    match (&planning.request.photographs, &planning.refine) {
        (None, _) => (),
        (Some(_), None) => stages.leave_out(FIT, "the run does not refine"),
        (Some(folder), Some(refine)) => {
            let refine = refine.clone().without_prune_steps();
            stages.add(Phase::Reduce, PhotographStage { refine, folder: folder.clone() });
        }
    }
}

impl Stage for PhotographStage {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![ResourceEstimate { stage: NAME, ..self.refine.resource_estimate(work, limits) }]
    }

    fn parameters(&self) -> String {
        let RefineStage { steps, pictures, .. } = self.refine;
        format!("photographs: {steps} steps toward {pictures} views, of which at most half are photographs")
    }

    fn check(&self, scene: &Scene) -> Result<()> {
        self.refine.find_photographs(scene, &self.folder).map(|_| ())
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
