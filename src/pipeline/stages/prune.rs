//! Stage `prune`: keeps the first Gaussians of the ranking as survivors. Later stages may reduce their number.

use crate::error::{Error, Result};
use crate::journal::Journal;
use crate::memory_plan::ResourceEstimate;
use crate::pipeline::planning::Planning;
use crate::pipeline::request::Goal;
use crate::pipeline::stage::{EstimateInput, Phase, RunState, Stage, StageList};
use crate::pruning::Ranking;
use crate::pruning::score::Scored;
use crate::scene::Scene;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "prune";

/// Stage that keeps the first Gaussians of the ranking.
#[derive(Debug, Clone)]
pub(crate) struct Prune {
    /// Whether Gaussians are pruned by rank. Gaussians that the user drops are removed in either case.
    pub prunes: bool,
    /// Whether survivors (Gaussians that are not removed) are merged afterwards.
    pub merges: bool,
}

/// Adds the stage that prunes Gaussians to `stages`. If the user asks for merging only, also records that pruning is
/// omitted.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    if !planning.prunes {
        stages.leave_out("pruning", "--merge-only");
    }
    stages.add(Phase::Reduce, Prune { prunes: planning.prunes, merges: planning.merges });
}

impl Stage for Prune {
    fn estimates(&self, _: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        Vec::new()
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scored, ranking) = (run.scored()?, run.ranking()?);
        let most = ranking.order().len();
        // With a byte limit, the number of Gaussians that fit may exceed the number of Gaussians that may stay.
        let target = run.target.map(|target| if run.request.goal.is_some() { target.min(most) } else { target });
        let protected = scored.protected.len();
        if let (Some(Goal::Bytes(_)), Some(target)) = (&run.request.goal, target.filter(|&target| target < protected)) {
            return Err(Error::usage(format!(
                "--size: {target} Gaussians fit the size, but {protected} are to be kept\n  ask for more bytes, or keep fewer"
            )));
        }
        run.refine_to = self.survivors(run.scene, &scored, &ranking, target, &mut run.journal)?;
        let survivors = run.stages.counts.count_before_refinement(run.refine_to, scored.gaussian_count()).min(most);
        run.result = run.template.with_kept(ranking.best_ids(survivors));
        Ok(())
    }
}

impl Prune {
    /// Returns the number of survivors (Gaussians that are not removed):
    /// - if Gaussians are not pruned by rank: all Gaussians in `ranked`;
    /// - otherwise, if no number of Gaussians is requested (`target` is `None`): the number that the thresholds of the
    ///   recipe select;
    /// - otherwise, if survivors are not merged later: `target`;
    /// - otherwise: all Gaussians in `ranked`, because merging later reduces them to `target`, and only merging can
    ///   tell how many it needs.
    ///
    /// # Errors
    /// Fails if the target is below the number of Gaussians that must stay, or above the number of Gaussians in
    /// `ranked`.
    pub(crate) fn survivors(
        &self,
        scene: &Scene,
        scored: &Scored,
        ranked: &Ranking,
        target: Option<usize>,
        journal: &mut Journal,
    ) -> Result<usize> {
        let all = ranked.order().len();
        if let Some(target) = target {
            check_reachable(target, scored, all)?;
        }
        let survivors = match target {
            _ if !self.prunes => all,
            None => scored.selection.counts.kept,
            Some(target) if !self.merges => target,
            Some(_) => all,
        };
        journal.run_stage(NAME, scored.gaussian_count(), scene.source(), |_| Ok((survivors, survivors)))
    }
}

fn check_reachable(target: usize, scored: &Scored, all: usize) -> Result<()> {
    let protected = scored.protected.len();
    if target < protected {
        return Err(Error::usage(format!("a target of {target} Gaussians, but {protected} are to be kept")));
    }
    if target > all {
        let dropped = scored.selection.counts.total - all;
        return Err(Error::usage(format!(
            "a target of {target} Gaussians, but {dropped} are to be dropped: {all} are left"
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::tests::{scene, score_scene};
    use crate::pruning::score::UserOverrides;
    use crate::recipe::Recipe;

    #[test]
    fn all_survive_if_merging_decides_else_the_target() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let user = UserOverrides { keep: vec![1, 2], drop: vec![3], keep_box: None };
        let scored = score_scene(&scene, &Recipe::preset("default").unwrap(), &user);
        let own = scored.selection.counts.kept;
        let run = |prunes, merges, target| {
            Prune { prunes, merges }.survivors(&scene, &scored, &scored.ranking(), target, &mut Journal::default())
        };
        for (prunes, merges, target, expected) in [
            (true, true, None, own),
            (true, false, None, own),
            (true, false, Some(70), 70),
            (true, true, Some(70), 1499),
            (false, true, None, 1499),
        ] {
            assert_eq!(run(prunes, merges, target).unwrap(), expected, "{prunes} {merges} {target:?}");
        }
        assert!(run(true, true, Some(1)).unwrap_err().to_string().contains("2 are to be kept"));
        assert!(run(true, true, Some(1500)).unwrap_err().to_string().contains("1 are to be dropped"));
    }
}
