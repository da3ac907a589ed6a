//! Stage `degree`: finds the SH degree that gives the best quality for a requested size on disk.
//!
//! A Gaussian of SH degree 3 takes as many bytes as three and a half of degree 0. Whether more Gaussians or more SH
//! coefficients give better renders depends on the scene. The stage tries degrees from the highest down: it takes as
//! many Gaussians of this degree as fit the size, and refines them with a fraction of the usual optimization steps. It
//! stops at the first degree whose quality on validation views is no better than that of the degree before. The best
//! degree is then refined in full by the stage `refine`.
//!
//! Memory: that of refinement.

use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::pipeline::planning::Planning;
use crate::pipeline::stage::{ByteLimitFit, CountPlan, EstimateInput, Phase, RunState, Stage, StageList};
use crate::pruning::Ranking;
use crate::pruning::score::Scored;
use crate::refinement::RefineStage;
use crate::refinement::targets::Targets;
use crate::scene::Scene;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "degree";
/// Fraction of the recipe's optimization steps that refinement does to try an SH degree.
const TRIAL_STEPS: f64 = 0.2;

/// Stage that chooses the SH degree for a requested size on disk.
#[derive(Debug, Clone)]
pub(crate) struct Degree {
    /// Refinement stage with fewer optimization steps than the recipe's; it is run to try an SH degree.
    refine: RefineStage,
}

/// Adds the stage that chooses the SH degree to `stages` if a size on disk is requested and the run refines and may
/// lower the SH degree.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    if let Some(refine) = planning.refine.as_ref().filter(|_| planning.chooses_sh_degree()) {
        stages.add(Phase::Rank, Degree { refine: refine.with_step_fraction(TRIAL_STEPS) });
    }
}

impl Stage for Degree {
    fn estimates(&self, EstimateInput { work, limits, .. }: EstimateInput<'_>) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits)]
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        if run.counts_within_bytes.len() > 1 {
            let (scored, ranking) = (run.scored()?, run.ranking()?);
            let fit =
                self.best(run.scene, &scored, &ranking, &run.template, &run.counts_within_bytes, &mut run.journal)?;
            run.template.sh_degree = fit.sh_degree;
            run.target = Some(fit.gaussians);
        }
        Ok(())
    }
}

impl Degree {
    /// Returns the resource estimate of the stage, which runs one refinement for every SH degree.
    pub(crate) fn resource_estimate(&self, work: &Workload, limits: &Limits) -> ResourceEstimate {
        let need = self.refine.resource_estimate(work, limits);
        let degrees = 1.0 + work.sh_degree as f64;
        ResourceEstimate { stage: NAME, seconds: degrees * need.seconds, reads: degrees * need.reads, ..need }
    }

    /// Refines models for the entries of `fits` (SH degrees with the numbers of Gaussians that fit the size, in order
    /// of decreasing degree), and returns the entry with the best PSNR on validation views. `template` holds all other
    /// settings of the model.
    ///
    /// # Errors
    /// Fails if frames cannot be read or a scratch file cannot be written.
    fn best(
        &self,
        scene: &Scene,
        scored: &Scored,
        ranked: &Ranking,
        template: &CompressedModel,
        fits: &[ByteLimitFit],
        journal: &mut Journal,
    ) -> Result<ByteLimitFit> {
        let gaussian_count = scored.gaussian_count();
        let target_views = self.refine.target_views.with_frames(scored.frames_needed_to_see_all);
        let key = scene.work.key(&(self.refine.key(), target_views, ranked, template, fits));
        journal.run_cached_stage(NAME, gaussian_count, scene, key, |journal| {
            let counts = CountPlan::new(Some(&self.refine), false);
            let initial_count =
                |gaussians: usize| counts.count_before_refinement(gaussians, gaussian_count).min(ranked.order().len());
            let largest = fits.iter().map(|fit| initial_count(fit.gaussians)).max().unwrap_or_default();
            let strides = self.refine.stored_strides(&scene.workload(), largest);
            let targets = Targets::new(scene, target_views, strides, false)?;
            let mut tried: Vec<(ByteLimitFit, f64)> = Vec::new();
            for &fit in fits {
                let start = CompressedModel {
                    sh_degree: fit.sh_degree,
                    ..template.with_kept(ranked.best_ids(initial_count(fit.gaussians)))
                };
                let psnr = self.refine.validation_psnr(
                    NAME,
                    scene,
                    scored,
                    &targets,
                    &start,
                    &ranked.best_ids(fit.gaussians),
                )?;
                let is_no_better = tried.last().is_some_and(|before| psnr <= before.1);
                tried.push((fit, psnr));
                if is_no_better {
                    break;
                }
            }
            // Of two degrees with equal PSNR the higher one wins.
            let best = tried.iter().rev().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(fits[0], |best| best.0);
            let line = |(fit, psnr): &(ByteLimitFit, f64)| {
                let psnr = if psnr.is_nan() { "no number".to_owned() } else { format!("{psnr:.2}") };
                format!("{} Gaussians of degree {}: {psnr}", fit.gaussians, fit.sh_degree)
            };
            let tried = tried.iter().map(line).collect::<Vec<_>>().join(", ");
            let count = targets.split().validation.len();
            journal.notes.push(format!(
                "SH degree {} gives the best quality within the byte limit; PSNR on {count} validation views after a \
                 fifth of the optimization steps, dB: {tried}",
                best.sh_degree
            ));
            Ok((best, best.gaussians))
        })
    }
}
