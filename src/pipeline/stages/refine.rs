//! Stage `refine`: fits the survivors (Gaussians that are not removed) to renders of the original by optimization.
//! Between optimization steps, prune steps remove the lowest-ranked Gaussians.

use crate::error::Result;
use crate::memory_plan::ResourceEstimate;
use crate::pipeline::planning::Planning;
use crate::pipeline::stage::{CountPlan, EstimateInput, Phase, RunState, Stage, StageList};
use crate::refinement::RefineStage;
use crate::refinement::targets;
use crate::scene::Scene;

/// Adds the refinement stage to `stages` if the recipe asks for refinement and the memory limit allows it. Records the
/// parts of refinement that are omitted for lack of memory.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    let has_smaller_start = planning.refine.as_ref().is_some_and(RefineStage::has_smaller_start);
    let start = planning.fallback.required_bytes().filter(|_| has_smaller_start);
    let start = start.map(|bytes| ("more Gaussians at the start of refinement", bytes));
    for (what, bytes) in start.into_iter().chain(planning.fallback.left_out()) {
        let why = format!("memory: expected at least {}MiB for it (--memory)", bytes.div_ceil(1 << 20));
        stages.leave_out(what, why);
    }
    if let Some(refine) = &planning.refine {
        stages.add(Phase::Reduce, refine.clone());
    }
}

impl Stage for RefineStage {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits)]
    }

    fn parameters(&self) -> String {
        let RefineStage { steps, steps_per_prune, target_views, .. } = self;
        let views = target_views.max_count;
        format!("refine: {steps} steps at the end, {steps_per_prune} before a prune step, toward {views} views")
    }

    fn describe_shardable_work(&self, _: &Scene, _: &CountPlan) -> Vec<String> {
        vec![format!("{}: views", targets::NAME)]
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scored, ranking) = (run.scored()?, run.ranking()?);
        let wanted = run.refine_to.min(run.result.len());
        let start = run.take_result();
        run.result = match &mut run.prune_steps {
            None => self.run(run.scene, &scored, start, wanted, &mut run.journal)?,
            // A model with all Gaussians needs no refinement.
            Some(_) if wanted >= ranking.order().len() => start,
            Some(steps) => steps.refined(start, wanted, &mut run.journal)?,
        };
        Ok(())
    }
}
