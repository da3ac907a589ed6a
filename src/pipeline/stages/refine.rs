//! Stage `refine`: fits the survivors (Gaussians that are not removed) to renders of the original by optimization.
//! Between optimization steps, prune steps remove the lowest-ranked Gaussians.

use crate::error::Result;
use crate::memory_plan::ResourceEstimate;
use crate::pipeline::planning::{MemoryFallback, Planning};
use crate::pipeline::stage::{CountPlan, EstimateInput, Phase, RunState, Stage, StageList};
use crate::refinement::RefineStage;
use crate::refinement::targets;
use crate::scene::Scene;

/// Adds the refinement stage to `stages` if the recipe asks for refinement and the memory limit allows it. Records the
/// parts of refinement that are omitted for lack of memory.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    if planning.refine.as_ref().is_some_and(RefineStage::has_smaller_start) {
        let why = match planning.fallback {
            MemoryFallback::SmallStart { required_bytes } => memory_reason(required_bytes),
            _ => "memory: they do not fit within the limit (--memory)".to_owned(),
        };
        stages.leave_out("more Gaussians at the start of refinement", why);
    }
    for (what, bytes) in planning.fallback.left_out() {
        stages.leave_out(what, memory_reason(bytes));
    }
    if let Some(refine) = &planning.refine {
        stages.add(Phase::Reduce, refine.clone());
    }
}

/// Returns the reason why a part of refinement is left out that needs a memory limit of at least `bytes`.
fn memory_reason(bytes: u64) -> String {
    format!("memory: expected at least {}MiB for it (--memory)", bytes.div_ceil(1 << 20))
}

impl Stage for RefineStage {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits)]
    }

    fn parameters(&self) -> String {
        let RefineStage { steps, steps_per_prune, target_views, .. } = self;
        let views = target_views.max_count;
        format!("refine: {steps} steps at the end, {steps_per_prune} before a prune step, toward at most {views} views")
    }

    fn describe_shardable_work(&self, _: &Scene, _: &CountPlan) -> Vec<String> {
        vec![format!("{}: views", targets::NAME)]
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scored, ranking) = (run.scored()?, run.ranking()?);
        let wanted = run.refine_to.min(run.result.len());
        let start = run.take_result();
        // Without prune steps, all Gaussians stay.
        let unrefined = if wanted < start.len() { ranking.best_ids(wanted) } else { start.kept.clone() };
        run.result = match &mut run.prune_steps {
            None => self.run(run.scene, &scored, start, &unrefined, &mut run.journal)?,
            // A model with all Gaussians needs no refinement.
            Some(_) if wanted >= ranking.order().len() => start,
            Some(steps) => steps.refined(start, &unrefined, &mut run.journal)?,
        };
        Ok(())
    }
}
