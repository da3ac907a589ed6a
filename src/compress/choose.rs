//! Stage `choose`: letting pictures choose among alternatives at one count, rendered beside the original.
//!
//! No rule wins everywhere, and merging pays on some scenes only (method.md, section 6.1).
//! Memory: statistics and scores while the alternatives are made, then two states of one frame, the original's and an
//! alternative's, and [`AT_ONCE`] pictures.

use super::journal::Journal;
use super::merge::Outcome;
use super::score::{Order, Ranked, Scored, scored};
use crate::budget::{Need, PICTURE_ON_ALL_THREADS, RENDER, Workload};
use crate::error::Result;
use crate::limits::Limits;
use crate::metrics::psnr;
use crate::model::{Camera, Columns, Gaussians, Picture};
use crate::recipe::{self, StaticTerm};
use crate::reduction::Reduction;
use crate::render::{self, Image, render};
use crate::scene::Scene;
use crate::stream::{Batch, Progress, Subject, View, show, spread};

/// What the stage is called.
const NAME: &str = "choose";

/// Scoring pictures that are compared: their mean PSNR differs from that of all by less than the
/// alternatives usually do from one another.
const PICTURES: usize = 24;

/// Pictures of a frame that are compared at a time.
const AT_ONCE: usize = 4;

/// Most alternatives: the run's own order, those by C and by the mean, and what merging leaves.
const ALTERNATIVES: f64 = 4.0;

/// Per Gaussian what is known of clusters, twice while alternatives are compared, and what reading members takes.
pub(super) const CLUSTERED: u64 = 125;

/// The choice of a run.
#[derive(Debug, Clone)]
pub struct Choose {
    /// The scores that alternatives differ in.
    pub score: recipe::Score,
    /// The selection by them.
    pub select: recipe::Select,
    /// Whether the size of the output is asked for.
    pub has_target: bool,
}

/// One way to keep the same number of Gaussians.
struct Alternative {
    /// What its Gaussians were ranked by.
    by: Order,
    reduction: Reduction,
}

impl Choose {
    /// Alternatives, two states of a frame, and pictures.
    pub fn need(&self, work: &Workload, limits: &Limits) -> Need {
        let per_gaussian = vec![
            ("alternatives", 24),
            ("clusters", CLUSTERED),
            ("states", 2 * work.state(Columns::all())),
            ("result", work.input.reduced),
            ("readers", 2 * work.input.reader),
            ("held", 2 * work.held(limits, Columns::all())),
            ("pictures", PICTURE_ON_ALL_THREADS),
        ];
        let pictures = render::STRIP_BYTES as u64 + 12 * work.pixels * (1 + AT_ONCE as u64);
        let frames = (PICTURES as u64).min(work.pictures);
        // The original, and as many alternatives of about half as many Gaussians as there are orders and merging.
        let made = work.picturing(frames as f64, (1.0 + 0.5 * ALTERNATIVES) * work.count(), (RENDER.0, 0.0))
            + work.picturing((1.0 + ALTERNATIVES) * frames as f64, 0.0, RENDER);
        Need {
            stage: NAME,
            seconds: work.reading(work.count(), frames as f64) + made,
            reads: work.reads(frames, limits) + work.scattered_reads(frames, limits),
            per_gaussian: [scored(limits), per_gaussian].concat(),
            fixed: vec![work.arriving(), ("pictures", pictures)],
        }
    }

    /// Compares `merged` with the first Gaussians of the run's ranking and of those by C and √(C·W), as many as it
    /// has, by mean PSNR against the original on scoring pictures; keeps the best, of equals the one without merging
    /// and with the run's own ranking. Where merging loses and no target asks for that count, the run's own number of
    /// survivors stays.
    ///
    /// # Errors
    /// Frames that cannot be read.
    pub fn run(
        &self,
        scene: &Scene,
        scored: &Scored,
        ranked: &Ranked,
        merged: Outcome,
        journal: &mut Journal,
    ) -> Result<Outcome> {
        let reduction = &merged.reduction;
        let count = reduction.len();
        let has_clusters = !reduction.clusters.is_empty();
        let own = Alternative { by: ranked.by, reduction: reduction.clone() };
        let mut alternatives =
            if count > 0 { self.alternatives(scored, ranked, count, reduction)? } else { Vec::new() };
        if !has_clusters {
            // It is the prefix of its ranking already.
            alternatives.retain(|other| other.reduction.kept != reduction.kept);
            if !alternatives.is_empty() {
                alternatives.insert(0, own);
            }
        } else if !alternatives.is_empty() {
            alternatives.push(own);
        }
        if alternatives.is_empty() {
            return Ok(merged);
        }
        let pictures = spread(&scene.schedule, PICTURES, 1);
        let found =
            journal.stage(NAME, count, scene.source(), |_| Ok((mean_psnr(scene, &alternatives, &pictures)?, count)))?;
        // Strictly greater: of equals the first.
        let best = (0..found.len()).fold(0, |best, i| if found[i] > found[best] { i } else { best });
        let Alternative { by, reduction: mut chosen } = alternatives.swap_remove(best);
        if by != ranked.by {
            let (better, worse) = (found[best], found[0]);
            journal.notes.push(format!(
                "ranked by {} for {}: at {count} Gaussians scoring pictures keep {better:.2} dB, not {worse:.2}",
                by.name(),
                ranked.by.name()
            ));
        }
        if !has_clusters || best + 1 == found.len() {
            return Ok(Outcome { reduction: chosen, summary: merged.summary.filter(|_| has_clusters) });
        }
        let (with, without) = (found[found.len() - 1], found[best]);
        journal.leave_out(
            "merging",
            format!(
                "at the same {count} Gaussians scoring pictures keep {without:.2} dB without it, {with:.2} with it"
            ),
        );
        if !self.has_target {
            let survivors = scored.selection.counts.kept;
            let ranking = self.rankings(scored, ranked)?.into_iter().find(|other| other.by == by);
            let kept = ranking.as_ref().unwrap_or(ranked).ranking.take(survivors);
            chosen = Reduction::pruned(kept, &reduction.rule);
        }
        Ok(Outcome { reduction: chosen, summary: None })
    }

    /// The rankings to compare, the run's own first.
    fn rankings(&self, scored: &Scored, ranked: &Ranked) -> Result<Vec<Ranked>> {
        let mut found = vec![ranked.clone()];
        for term in [StaticTerm::Mean, StaticTerm::Geometric] {
            found.push(Ranked { ranking: scored.ranking_by(term, &self.score, &self.select)?, by: Order::Term(term) });
        }
        Ok(found)
    }

    /// The first `count` of every ranking, none twice.
    fn alternatives(
        &self,
        scored: &Scored,
        ranked: &Ranked,
        count: usize,
        like: &Reduction,
    ) -> Result<Vec<Alternative>> {
        let mut found: Vec<Alternative> = Vec::new();
        for Ranked { ranking, by } in self.rankings(scored, ranked)? {
            let kept = ranking.take(count);
            if found.iter().all(|other| other.reduction.kept != kept) {
                found.push(Alternative { by, reduction: Reduction::pruned(kept, &like.rule) });
            }
        }
        Ok(found)
    }
}

/// Mean PSNR of every alternative against the original over `pictures`, dB. At most one has clusters.
fn mean_psnr(scene: &Scene, alternatives: &[Alternative], pictures: &[Picture]) -> Result<Vec<f64>> {
    let merged = alternatives.iter().position(|other| !other.reduction.clusters.is_empty());
    let result = merged.map(|at| scene.input.reduced(&alternatives[at].reduction)).transpose()?;
    let progress = Progress::new(NAME, "pictures", pictures.len() as u64);
    let mut sums = vec![0.0; alternatives.len()];
    let mut add = |original: &Gaussians, merged: Option<&Gaussians>, cameras: &[&Camera]| {
        let picture = |state: &Gaussians, camera: &Camera| render(state, camera, scene.background);
        let expected: Vec<Image> = cameras.iter().map(|camera| picture(original, camera)).collect();
        for (other, sum) in alternatives.iter().zip(&mut sums) {
            let pruned;
            let state = match merged.filter(|_| !other.reduction.clusters.is_empty()) {
                Some(merged) => merged,
                None => {
                    pruned = original.pick(&other.reduction.kept);
                    &pruned
                }
            };
            let quality = |(camera, expected): (&&Camera, &Image)| psnr(&picture(state, camera), expected);
            *sum += cameras.iter().zip(&expected).map(quality).sum::<f64>();
        }
        progress.advance(cameras.len() as u64);
    };
    let batch = Batch { pictures: AT_ONCE, ..Batch::of_frame(&scene.limits) };
    let (original, cameras) = (Subject::all(scene.source()), &scene.schedule.cameras);
    match &result {
        None => show([original], cameras, pictures, batch, |views| {
            add(views[0].states[0], None, &cameras_of(views));
            Ok(())
        }),
        Some(result) => show([original, Subject::all(&**result)], cameras, pictures, batch, |views| {
            let [original, merged] = views[0].states;
            add(original, Some(merged), &cameras_of(views));
            Ok(())
        }),
    }?;
    Ok(sums.into_iter().map(|sum| sum / pictures.len().max(1) as f64).collect())
}

/// The cameras of views of one frame.
fn cameras_of<'a, const S: usize>(views: &[View<'a, S>]) -> Vec<&'a Camera> {
    views.iter().map(|view| view.camera).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compress::merge::Merge;
    use crate::compress::score::UserOverrides;
    use crate::compress::tests::{scene, score_scene};
    use crate::recipe::Recipe;

    /// Mean PSNR over the pictures that decide.
    fn quality(scene: &Scene, reduction: &Reduction) -> f64 {
        let alone = [Alternative { by: Order::Rounds, reduction: reduction.clone() }];
        mean_psnr(scene, &alone, &spread(&scene.schedule, PICTURES, 1)).unwrap()[0]
    }

    /// What merging leaves of a scene, and what is chosen then.
    fn chosen(scene: &Scene, scored: &Scored, recipe: &Recipe, target: Option<usize>) -> (Reduction, Outcome, Journal) {
        let merge = Merge { recipe: recipe.merge.clone(), scan: recipe.scan.clone(), prunes: true, target };
        let (ranked, mut journal) = (scored.ranked(), Journal::default());
        let survivors = target.map_or(scored.selection.counts.kept, |_| ranked.ranking.order().len());
        let merged = merge.run(scene, scored, &ranked, survivors, &mut journal).unwrap();
        let before = merged.reduction.clone();
        let (score, select, has_target) = (recipe.score.clone(), recipe.select.clone(), target.is_some());
        let chosen = Choose { score, select, has_target }.run(scene, scored, &ranked, merged, &mut journal).unwrap();
        (before, chosen, journal)
    }

    #[test]
    fn what_is_chosen_has_the_same_count_and_is_never_worse_than_any_alternative() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let recipe = Recipe::preset("default").unwrap();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default());
        for target in [150, 600, 1200] {
            let (merged, chosen, journal) = chosen(&scene, &scored, &recipe, Some(target));
            assert_eq!(chosen.reduction.len(), target);
            let got = quality(&scene, &chosen.reduction);
            let by_c = scored.ranking_by(StaticTerm::Mean, &recipe.score, &recipe.select).unwrap().take(target);
            let by_c = Reduction::pruned(by_c, &recipe.merge);
            let own = Reduction::pruned(scored.ranked().ranking.take(target), &recipe.merge);
            for other in [&merged, &by_c, &own] {
                let expected = quality(&scene, other);
                assert!(got >= expected, "{target}: got {got} dB, an alternative has {expected}");
            }
            let lost = !merged.clusters.is_empty() && chosen.reduction.clusters.is_empty();
            assert_eq!(journal.left_out.iter().any(|left| left.what == "merging"), lost);
        }
    }

    #[test]
    fn without_a_target_merging_that_does_not_pay_leaves_every_survivor_of_pruning() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        // Nothing is pruned, so that what is never seen is there to be dropped instead of merging the rest.
        let mut recipe = Recipe::preset("default").unwrap();
        recipe.select.tau_static = 0.0;
        recipe.merge.max_color_difference = f64::INFINITY;
        let scored = score_scene(&scene, &recipe, &UserOverrides::default());
        let survivors = scored.selection.counts.kept;
        let (merged, chosen, journal) = chosen(&scene, &scored, &recipe, None);
        assert!(merged.len() < survivors, "nothing merged");
        assert_eq!((chosen.reduction.len(), journal.left_out.len()), (survivors, 1));
    }
}
