//! Stage `choose`: compares the merged model with a model that is only pruned to the same number of Gaussians, and
//! keeps the one whose renders are closer to those of the original.
//!
//! Merging improves quality on some scenes only (method.md, section 6.1). Memory: the state of the original and of the
//! merged or the pruned model at one frame, and [`VIEWS_PER_BATCH`] rendered views.

use super::merge::MergeOutcome;
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{RENDER_COST, ResourceEstimate, SHARED_VIEW_BYTES_PER_GAUSSIAN, Workload, bytes_of_survivors};
use crate::metrics::{decibels_text, psnr};
use crate::model::{Attributes, FrameView};
use crate::passes::{BatchLimits, RenderableView, RenderedSource, VIEWS_PER_FRAME, for_each_view_batch, select_evenly};
use crate::pipeline::planning::Planning;
use crate::pipeline::stage::{EstimateInput, Phase, RunState, Stage, StageList};
use crate::progress::Message;
use crate::pruning::Ranking;
use crate::pruning::score::{Scored, scored_memory};
use crate::render::{self, Image};
use crate::scene::Scene;

/// Name of this stage in plans, progress and summaries.
const NAME: &str = "choose";

/// Number of views on which the merged and the pruned model are compared; they are chosen among the views used for
/// scoring. The mean PSNR over these few views differs from the mean over all views, but by less than the PSNRs of the
/// two models usually differ.
const COMPARED_VIEWS: usize = 24;

/// Number of views of one frame that are rendered at the same time.
const VIEWS_PER_BATCH: usize = 4;

/// Bytes of memory per Gaussian that the stage takes for the merged clusters: two copies of the clusters, and the
/// reader of their members.
pub(crate) const BYTES_PER_GAUSSIAN: u64 = 125;

/// Stage that keeps either the merged model or a model that is only pruned: the one whose renders are closer to the
/// original.
#[derive(Debug, Clone)]
pub(crate) struct Choose {
    /// Whether the user requested an exact number of Gaussians.
    pub has_target: bool,
}

/// Adds the stage that chooses between merging and pruning to `stages` if Gaussians are pruned by a ranking on rendered
/// views, survivors (Gaussians that are not removed) are merged, and the recipe asks for the comparison.
pub(super) fn plan(planning: &Planning<'_>, stages: &mut StageList) {
    if planning.prunes_by_views() && planning.merges && planning.request.recipe.select.choose_by_views {
        stages.add(Phase::Reduce, Choose { has_target: planning.target.is_some() });
    }
}

impl Stage for Choose {
    fn estimates(
        &self,
        EstimateInput { work, limits, output_fraction, .. }: EstimateInput<'_>,
    ) -> Vec<ResourceEstimate> {
        vec![self.resource_estimate(work, limits, output_fraction)]
    }

    fn run(&self, run: &mut RunState<'_>) -> Result<()> {
        let (scored, ranking) = (run.scored()?, run.ranking()?);
        let merged = MergeOutcome { compressed: run.take_result(), summary: run.merge.take() };
        let found = self.choose(run.scene, &scored, &ranking, merged, &mut run.journal)?;
        run.result = CompressedModel { sh_degree: run.template.sh_degree, ..found.compressed };
        run.merge = found.summary;
        Ok(())
    }
}

impl Choose {
    /// Returns the resource estimate of the stage. Its memory holds the merged and the pruned model, two states (all
    /// Gaussians at one frame), and rendered views. `output_fraction`: number of Gaussians in the result divided by
    /// that in the input.
    pub(crate) fn resource_estimate(&self, work: &Workload, limits: &Limits, output_fraction: f64) -> ResourceEstimate {
        let whole = work.state_bytes(Attributes::all());
        // The trajectories of proxies, which replace merged clusters, are computed from all members.
        let merging = if work.input.compressed > 0 { output_fraction } else { 1.0 };
        let (reader, held) = (work.input.reader, work.kept_frames_bytes(limits, Attributes::all()));
        let per_gaussian = vec![
            ("alternatives", bytes_of_survivors(output_fraction, 8)),
            ("clusters", BYTES_PER_GAUSSIAN),
            ("states", whole + bytes_of_survivors(output_fraction, whole)),
            ("result", bytes_of_survivors(output_fraction, work.input.compressed)),
            ("readers", reader + bytes_of_survivors(merging, reader)),
            ("kept frames", held + bytes_of_survivors(merging, held)),
            ("views", SHARED_VIEW_BYTES_PER_GAUSSIAN),
        ];
        let together = VIEWS_PER_BATCH.min(limits.views_together) as u64;
        let view_bytes = render::STRIP_BYTES as u64 + 12 * work.pixels * (1 + together);
        let frames = (COMPARED_VIEWS as u64).min(work.frame_views);
        // Renders of the original, and of two alternatives with about half as many Gaussians.
        let made = work.render_seconds(frames as f64, 2.0 * work.gaussian_count(), RENDER_COST)
            + work.render_seconds(2.0 * frames as f64, 0.0, RENDER_COST);
        ResourceEstimate {
            stage: NAME,
            seconds: work.reading_seconds(work.gaussian_count(), frames as f64) + made,
            reads: work.whole_input_reads(frames, limits) + work.scattered_whole_input_reads(frames, limits),
            per_gaussian: [scored_memory(limits), per_gaussian].concat(),
            fixed: vec![work.block_buffer_memory(), ("views", view_bytes)],
        }
    }

    /// Compares the model `merged` with the same number of unmerged Gaussians from the top of the ranking, by mean PSNR
    /// against the original on views used for scoring. Returns a model that depends on the comparison:
    ///
    /// - if `merged` has the higher PSNR: `merged`;
    /// - if it has not, and an exact number of Gaussians was requested: the unmerged model;
    /// - if it has not, and no number was requested: an unmerged model with as many Gaussians from the top of the
    ///   ranking as the selection by scores keeps.
    ///
    /// If merging is discarded, records this in `journal`, the log of the run.
    ///
    /// # Errors
    /// Fails if frames cannot be read.
    pub(crate) fn choose(
        &self,
        scene: &Scene,
        scored: &Scored,
        ranking: &Ranking,
        merged: MergeOutcome,
        journal: &mut Journal,
    ) -> Result<MergeOutcome> {
        let compressed = &merged.compressed;
        let count = compressed.len();
        if compressed.clusters.is_empty() {
            return Ok(merged);
        }
        let pruned = ranking.best_ids(count);
        let views = select_evenly(&scene.schedule, COMPARED_VIEWS, VIEWS_PER_FRAME);
        let key = scene.work.key(&(&pruned, compressed, &views));
        let [without, with]: [f64; 2] = journal.run_cached_stage(NAME, count, scene, key, |_| {
            Ok((mean_psnr(scene, &pruned, compressed, &views)?, count))
        })?;
        if with > without {
            return Ok(merged);
        }
        let why = format!(
            "PSNR on scored views at the same {count} Gaussians: {} without merging, {with:.2} dB with merging",
            decibels_text(without, 2)
        );
        scene.events.send(Message::Discarded { stage: "merging", why: &why });
        journal.leave_out("merging", why);
        let kept = if self.has_target { pruned } else { ranking.best_ids(scored.selection.counts.kept) };
        Ok(MergeOutcome { compressed: CompressedModel::pruned(kept, &compressed.merge_params), summary: None })
    }
}

/// Returns two mean PSNRs against the original over `views`, dB. First: of the model that consists of the unchanged
/// Gaussians `pruned` (increasing ids). Second: of the model `merged`.
fn mean_psnr(scene: &Scene, pruned: &[u32], merged: &CompressedModel, views: &[FrameView]) -> Result<[f64; 2]> {
    let result = scene.input.compressed_frames(merged)?;
    let progress = scene.events.task(NAME, "views", views.len() as u64);
    let mut sums = [0.0; 2];
    let views_together = VIEWS_PER_BATCH.min(scene.limits.views_together);
    let max_batch = BatchLimits { views: views_together, ..BatchLimits::one_frame(&scene.limits) };
    let subjects = [RenderedSource::all_gaussians(scene.source()), RenderedSource::all_gaussians(&*result)];
    for_each_view_batch(subjects, &scene.schedule.cameras, views, max_batch, |batch| {
        let image = |subject: usize, view: &RenderableView<'_, 2>| view.render(subject, scene.background);
        let expected: Vec<Image> = batch.iter().map(|view| image(0, view)).collect();
        // All views of a batch show the same frame.
        let state = batch[0].states[0].pick(pruned);
        let features = batch[0].features(0).map(|features| features.pick(pruned));
        for (view, expected) in batch.iter().zip(&expected) {
            sums[0] += psnr(&view.render_as(0, &state, features.as_ref(), scene.background), expected);
            sums[1] += psnr(&image(1, view), expected);
        }
        progress.advance(batch.len() as u64);
        Ok(())
    })?;
    Ok(sums.map(|sum| sum / views.len().max(1) as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::stages::merge::MergeStage;
    use crate::pipeline::tests::{scene, score_scene};
    use crate::pruning::score::UserOverrides;
    use crate::recipe::Recipe;

    /// Returns the mean PSNR, dB, of renders of `compressed` against renders of the original, over the views on which
    /// the stage `choose` compares models.
    fn quality(scene: &Scene, compressed: &CompressedModel) -> f64 {
        mean_psnr(scene, &[], compressed, &select_evenly(&scene.schedule, COMPARED_VIEWS, VIEWS_PER_FRAME)).unwrap()[1]
    }

    /// Merges the Gaussians of a scene (down to `target` Gaussians, if given). The stage `choose` then takes either
    /// this model or a pruned one. Returns the merged model, the model that the stage took, and the journal.
    fn chosen(
        scene: &Scene,
        scored: &Scored,
        recipe: &Recipe,
        target: Option<usize>,
    ) -> (CompressedModel, MergeOutcome, Journal) {
        let merge = MergeStage { recipe: recipe.merge.clone(), scan: recipe.scan.clone(), prunes: true, target };
        let (ranking, mut journal) = (scored.ranking(), Journal::default());
        let survivors = target.map_or(scored.selection.counts.kept, |_| ranking.order().len());
        let merged = merge.merge(scene, scored, &ranking, survivors, &mut journal).unwrap();
        let before = merged.compressed.clone();
        let chosen =
            Choose { has_target: target.is_some() }.choose(scene, scored, &ranking, merged, &mut journal).unwrap();
        (before, chosen, journal)
    }

    #[test]
    fn choice_has_same_count_and_best_quality() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default());
        for target in [150, 600, 1200] {
            let (merged, chosen, journal) = chosen(&scene, &scored, &recipe, Some(target));
            assert_eq!(chosen.compressed.len(), target);
            let got = quality(&scene, &chosen.compressed);
            let own = CompressedModel::pruned(scored.ranking().best_ids(target), &recipe.merge);
            for other in [&merged, &own] {
                let expected = quality(&scene, other);
                assert!(got >= expected, "{target}: got {got} dB, an alternative has {expected}");
            }
            let lost = !merged.clusters.is_empty() && chosen.compressed.clusters.is_empty();
            assert_eq!(journal.left_out.iter().any(|left| left.what == "merging"), lost);
        }
    }

    #[test]
    fn losing_merge_without_target_keeps_all_survivors() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        // Nothing is pruned, so the alternative to merging is to drop invisible Gaussians.
        let mut recipe = Recipe::preset("default").unwrap();
        recipe.select.tau_static = 0.0;
        recipe.merge.max_color_difference = f64::INFINITY;
        let scored = score_scene(&scene, &recipe, &UserOverrides::default());
        let survivors = scored.selection.counts.kept;
        let (merged, chosen, journal) = chosen(&scene, &scored, &recipe, None);
        assert!(merged.len() < survivors, "nothing merged");
        assert_eq!((chosen.compressed.len(), journal.left_out.len()), (survivors, 1));
    }
}
