//! Stages `scan`, `visible` and `score`, which compute the statistics and scores of the Gaussians from the frames and
//! select the Gaussians that stay. The commands `score` and `report` run these stages, too.

use std::sync::Arc;

use super::rounds::Rounds;
use super::scan::{self, ScanStage};
use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::pipeline::planning::Planning;
use crate::pipeline::stage::{
    CountPlan, EstimateInput, Measured, MeasuredOnArrival, Phase, RunState, Stage, StageList,
};
use crate::pruning::score;
use crate::pruning::score::{ScoreStage, Scored, UserOverrides};
use crate::pruning::visibility::{self, VisibilityStage};
use crate::recipe::{Coverage, Recipe, ScanFrames};
use crate::scene::Scene;
use crate::statistics::pass::{ScanResult, scan_units};

/// Adds to `stages` the stages that compute the statistics of the Gaussians and score them. Records why the visible
/// contribution is not measured if there are no cameras for it.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    let scan = &planning.request.recipe.scan;
    if scan.coverage == Coverage::Auto && !planning.input.has_cameras {
        let why = "no cameras given or found: a virtual rig may see only what is in front of the scene";
        let visible = VisibilityStage { recipe: scan.clone(), is_preliminary: false, needs_few_views: false };
        stages.leave_out_stage("visible coverage", why, move |work, limits| visible.resource_estimate(work, limits));
    }
    stages.add(Phase::Rank, MeasureStages::from_planning(planning));
}

/// Stages that compute the statistics of the Gaussians and score them.
#[derive(Debug, Clone)]
pub struct MeasureStages {
    /// Stage that scans the frames for statistics of motion, opacity and shape.
    pub scan: ScanStage,
    /// Stage that renders views to measure the contribution C of every Gaussian; `None` if C is computed without
    /// renders, from opacity and projected area.
    pub visible: Option<VisibilityStage>,
    /// Stage that scores the Gaussians and selects those that stay.
    pub score: ScoreStage,
}

impl MeasureStages {
    /// Returns the stages that compute statistics and scores, for the request and the input in `planning`.
    pub(in crate::pipeline) fn from_planning(planning: &Planning<'_>) -> MeasureStages {
        let recipe = &planning.request.recipe;
        let mut measure = MeasureStages::new(recipe, planning.input.has_cameras, planning.user.clone());
        // If pruning rounds rank the Gaussians and their number is given, no threshold of the scores decides which of
        // them stay.
        measure.scan.can_be_partial = recipe.scan.scan_frames == ScanFrames::Needed
            && planning.target.is_some()
            && planning.prunes_by_views()
            && Rounds::from_recipe(&recipe.select, planning.target_fraction()).is_some();
        if let Some(visible) = &mut measure.visible {
            visible.is_preliminary = measure.scan.can_be_partial;
            // If nothing merges, no decision depends on the scores.
            visible.needs_few_views = visible.is_preliminary && !planning.merges;
        }
        measure
    }

    /// Returns the stages that compute statistics and scores by the parameters of `recipe`. `has_cameras` tells whether
    /// the scene has cameras of its own, rather than virtual ones placed by the program. `user` states which Gaussians
    /// the user wants to keep or to drop in any case.
    pub fn new(recipe: &Recipe, has_cameras: bool, user: UserOverrides) -> MeasureStages {
        MeasureStages {
            scan: ScanStage { recipe: recipe.scan.clone(), can_be_partial: false },
            visible: VisibilityStage::from_recipe(&recipe.scan, has_cameras),
            score: ScoreStage {
                snap_noise: recipe.scan.snap_noise,
                non_finite: recipe.scan.non_finite,
                score: recipe.score.clone(),
                select: recipe.select.clone(),
                user,
            },
        }
    }

    /// Returns the resource estimates (memory, time, reads) of the stages. `measured` states which kinds of statistics
    /// were already computed; the stages that compute them are left out.
    pub fn resource_estimates(
        &self,
        work: &Workload,
        limits: &Limits,
        measured: MeasuredOnArrival,
    ) -> Vec<ResourceEstimate> {
        let scan = (!measured.scanned).then(|| self.scan.resource_estimate(work, limits));
        let visible = self
            .visible
            .as_ref()
            .filter(|_| !measured.visible_contribution)
            .map(|visible| visible.resource_estimate(work, limits));
        [scan, visible, Some(self.score.resource_estimate(work, limits))].into_iter().flatten().collect()
    }

    /// Computes the statistics of the Gaussians of `scene`, scores the Gaussians, and selects those to keep. Returns
    /// the statistics and the selection. `arrived` holds statistics that were already computed while the input, a
    /// stream, arrived; they are used instead of a new scan.
    ///
    /// # Errors
    /// Fails if a stage fails.
    pub fn measure(&self, scene: &Scene, arrived: Option<Measured>, journal: &mut Journal) -> Result<Scored> {
        scene.set_excluded_ids(&[]);
        let ScoreStage { snap_noise, non_finite, score, select, user, .. } = &self.score;
        let visible = self.visible.as_ref().map(|visible| (visible.is_preliminary, visible.needs_few_views));
        let key = scene.work.key(&(
            (&self.scan.recipe, self.scan.can_be_partial, visible, snap_noise, non_finite, score, user),
            (select.keep_fraction, select.tau_static, select.tau_dynamic, select.low_priority),
        ));
        let scored =
            journal.cached(&scene.work, score::NAME, key, |journal| self.measure_anew(scene, arrived, journal))?;
        scene.set_excluded_ids(&scored.absent);
        scored.within(&scene.limits, &scene.scratch)
    }

    /// Scans the frames of `scene` and returns the statistics of every Gaussian. If there are Gaussians with NaN or
    /// infinity and the recipe drops them, marks them as absent from `scene` and scans again without them.
    ///
    /// # Errors
    /// Fails if frames cannot be read, or if their times do not allow statistics of motion.
    pub fn scan(&self, scene: &Scene, journal: &mut Journal) -> Result<ScanResult> {
        scene.set_excluded_ids(&[]);
        let scanned = self.scan.run(scene, journal)?;
        let absent = self.score.non_finite_ids_to_drop(&scanned.rows);
        if absent.is_empty() {
            return Ok(scanned);
        }
        scene.set_excluded_ids(&absent);
        self.scan.run(scene, journal)
    }

    fn measure_anew(&self, scene: &Scene, arrived: Option<Measured>, journal: &mut Journal) -> Result<Scored> {
        let Measured { scanned, visible_contribution: seen } = match arrived {
            Some(measured) => measured,
            None => Measured { scanned: self.scan(scene, journal)?, visible_contribution: None },
        };
        let seen = match (&self.visible, seen) {
            (Some(visible), None) => Some(visible.run(scene, &scanned.rows.life, journal)?),
            (_, seen) => seen,
        };
        self.score.run(scene, scanned, seen, journal)
    }
}

impl Stage for MeasureStages {
    fn estimates(&self, EstimateInput { work, limits, measured, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        self.resource_estimates(work, limits, measured)
    }

    fn parameters(&self) -> String {
        match &self.visible {
            Some(visible) if visible.recipe.scoring_views > 0 => {
                format!("visible: {} views at most", visible.recipe.scoring_views)
            }
            Some(_) => "visible: every view".to_owned(),
            None => String::new(),
        }
    }

    fn describe_shardable_work(&self, scene: &Scene, _: &CountPlan) -> Vec<String> {
        let mut units = vec![format!("{}: {} blocks of Gaussians", scan::NAME, scan_units(scene.source().info()))];
        if let Some(visible) = &self.visible {
            let most = match visible.recipe.scoring_views {
                0 => scene.schedule.pair_count(),
                most => most.min(scene.schedule.pair_count()),
            };
            units.push(format!("{}: {most} views", visibility::NAME));
        }
        units
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let scored = self.measure(run.scene, run.arrived.take(), &mut run.journal)?;
        run.ranking = Some(Arc::new(scored.ranking()));
        run.scored = Some(Arc::new(scored));
        Ok(())
    }
}
