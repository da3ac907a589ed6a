//! Letting pictures choose: the alternatives at one count, rendered beside the original.
//!
//! No rule wins everywhere, and merging pays on some scenes only (METHOD section 6: "let scoring views choose
//! among rules").
//! Memory: statistics and scores while the alternatives are made, then two states of one frame, the original's and an
//! alternative's, and [`AT_ONCE`] pictures.

use super::input::Scene;
use super::merging::Sieved;
use super::pictures::{background, spread};
use super::result::result_frames;
use super::scored::{Scored, name};
use super::summary::{LeftOut, Stages};
use crate::error::{Error, Result};
use crate::metrics::psnr;
use crate::model::{Columns, Gaussians};
use crate::pass::FrameSource;
use crate::recipe::{Recipe, StaticTerm};
use crate::render::{Image, render};
use crate::select::Ranking;
use crate::stream::gather_all;

/// Scoring pictures that are compared: their mean PSNR differs from that of all by less than the
/// alternatives usually do from one another.
pub(super) const PICTURES: usize = 24;

/// Pictures of a frame that are compared at a time.
pub(super) const AT_ONCE: usize = 4;

/// The result that was chosen, and what the summary says of the others.
pub struct Chosen {
    /// The best alternative.
    pub sieved: Sieved,
    /// Stages that did not pay.
    pub left_out: Vec<LeftOut>,
    /// Things a person should know.
    pub notes: Vec<String>,
}

/// One way to keep the same number of Gaussians.
struct Alternative {
    /// What its Gaussians were ranked by.
    rule: &'static str,
    sieved: Sieved,
}

/// Compares `sieved` with the first Gaussians of the recipe's ranking and of those by C and √(C·W), as
/// many as it has, by mean PSNR against the original on scoring pictures; keeps the best, of equals the
/// one without merging and with the recipe's own ranking. Where merging loses and no `target` asks for
/// that count, the recipe's own number of survivors stays.
///
/// Without visible contributions there is nothing to compare by: `sieved` is kept.
pub fn choose(
    scene: &Scene,
    scored: &Scored,
    recipe: &Recipe,
    sieved: Sieved,
    target: Option<usize>,
    stages: &mut Stages,
) -> Result<Chosen> {
    let count = sieved.kept.len();
    let own = scored.ranked_by;
    let mut alternatives = Vec::new();
    if scored.has_seen() && count > 0 {
        alternatives = alternatives_to(scored, recipe, count)?;
    }
    if sieved.clusters.is_empty() {
        // It is the prefix of its ranking already.
        alternatives.retain(|other| other.sieved.kept != sieved.kept);
        if !alternatives.is_empty() {
            alternatives.insert(0, Alternative { rule: own, sieved: sieved.clone() });
        }
    } else if !alternatives.is_empty() {
        alternatives.push(Alternative { rule: own, sieved: sieved.clone() });
    }
    if alternatives.is_empty() {
        return Ok(Chosen { sieved, left_out: Vec::new(), notes: Vec::new() });
    }
    let pictures = spread(&scene.schedule, PICTURES);
    let reads = pictures.len() as f64 / scene.schedule.frames.len().max(1) as f64;
    let found = stages.run("choose", count, reads, || {
        Ok::<_, Error>((mean_psnr(scene, scored, recipe, &alternatives, &pictures)?, count))
    })?;
    // Strictly greater: of equals the first.
    let best = (0..found.len()).fold(0, |best, i| if found[i] > found[best] { i } else { best });
    let Alternative { rule, sieved: kept } = alternatives.swap_remove(best);
    let mut chosen = Chosen { sieved: kept, left_out: Vec::new(), notes: Vec::new() };
    if rule != own {
        let (better, worse) = (found[best], found[0]);
        chosen.notes.push(format!(
            "ranked by {rule} for {own}: at {count} Gaussians scoring pictures keep {better:.2} dB, not {worse:.2}"
        ));
    }
    let merged = !sieved.clusters.is_empty();
    if merged && best + 1 < found.len() {
        let (with, without) = (found[found.len() - 1], found[best]);
        chosen.left_out.push(LeftOut {
            what: "merging",
            why: format!(
                "at the same {count} Gaussians scoring pictures keep {without:.2} dB without it, {with:.2} with it"
            ),
        });
    }
    if merged && chosen.sieved.clusters.is_empty() && target.is_none() {
        let survivors = scored.selection.counts.kept;
        let ranking = rankings(scored, recipe)?.into_iter().find(|(other, _)| *other == rule);
        chosen.sieved = Sieved::pruned(ranking.map_or(scored.ranking.take(survivors), |found| found.1.take(survivors)));
    }
    Ok(chosen)
}

/// The rankings to compare, the recipe's own first, with what they go by.
fn rankings(scored: &Scored, recipe: &Recipe) -> Result<Vec<(&'static str, Ranking)>> {
    let mut found = vec![(scored.ranked_by, scored.ranking.clone())];
    for term in [StaticTerm::Mean, StaticTerm::Geometric] {
        found.push((name(term), scored.ranking_by(term, recipe)?));
    }
    Ok(found)
}

/// The first `count` of every ranking, none twice.
fn alternatives_to(scored: &Scored, recipe: &Recipe, count: usize) -> Result<Vec<Alternative>> {
    let mut found: Vec<Alternative> = Vec::new();
    for (rule, ranking) in rankings(scored, recipe)? {
        let kept = ranking.take(count);
        if found.iter().all(|other| other.sieved.kept != kept) {
            found.push(Alternative { rule, sieved: Sieved::pruned(kept) });
        }
    }
    Ok(found)
}

/// Mean PSNR of every alternative against the original over `pictures`, dB.
fn mean_psnr(
    scene: &Scene,
    scored: &Scored,
    recipe: &Recipe,
    alternatives: &[Alternative],
    pictures: &[(usize, u32)],
) -> Result<Vec<f64>> {
    let source = scene.input.source();
    let background = background(None, scene)?;
    let results: Vec<Option<Box<dyn FrameSource + '_>>> = alternatives
        .iter()
        .map(|other| match other.sieved.clusters.is_empty() {
            true => Ok(None),
            false => result_frames(&scene.input, scored.reference, &recipe.merge, &other.sieved).map(Some),
        })
        .collect::<Result<_>>()?;
    let mut sums = vec![0.0; alternatives.len()];
    for of_frame in pictures.chunk_by(|a, b| a.0 == b.0).flat_map(|of_frame| of_frame.chunks(AT_ONCE)) {
        let frame = of_frame[0].0;
        let camera = |index: u32| &scene.schedule.cameras[index as usize];
        let original = gather_all(source, frame, Columns::ALL)?;
        let expected: Vec<Image> =
            of_frame.iter().map(|&(_, index)| render(&original, camera(index), background)).collect();
        let compare = |state: &Gaussians| -> f64 {
            let of_picture = |(&(_, index), expected): (&(usize, u32), &Image)| {
                psnr(&render(state, camera(index), background), expected)
            };
            of_frame.iter().zip(&expected).map(of_picture).sum()
        };
        let pruned = alternatives.iter().zip(&mut sums).filter(|(other, _)| other.sieved.clusters.is_empty());
        for (other, sum) in pruned {
            *sum += compare(&original.pick(&other.sieved.kept));
        }
        drop(original);
        for (result, sum) in results.iter().zip(&mut sums) {
            if let Some(result) = result {
                *sum += compare(&gather_all(&**result, frame, Columns::ALL)?);
            }
        }
    }
    Ok(sums.into_iter().map(|sum| sum / pictures.len().max(1) as f64).collect())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::demo;
    use crate::emit::container::write_container;
    use crate::ingest::container::Container;
    use crate::model::Split;
    use crate::pipeline::compress::Only;
    use crate::pipeline::input::Input;
    use crate::pipeline::merging::sieve;
    use crate::pipeline::scored::{UserOverrides, score_scene};

    /// A small dynamic scene with its cameras.
    pub(in crate::pipeline) fn scene(folder: &std::path::Path) -> Scene {
        let made = demo::Scene::new(1500, 6);
        let path = folder.join("scene.gseq");
        write_container(&made, &path, gseq::Compression::Raw, Default::default(), |_| ()).unwrap();
        let input = Input::Container(Container::open(&path).unwrap());
        let rig = made.rig();
        Scene::new(path, input, rig, Some(Split::Train)).unwrap()
    }

    /// Mean PSNR over the pictures that decide.
    fn quality(scene: &Scene, scored: &Scored, recipe: &Recipe, sieved: &Sieved) -> f64 {
        let alone = [Alternative { rule: "C", sieved: sieved.clone() }];
        mean_psnr(scene, scored, recipe, &alone, &spread(&scene.schedule, PICTURES)).unwrap()[0]
    }

    #[test]
    fn what_is_chosen_has_the_same_count_and_is_never_worse_than_any_alternative() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let recipe = Recipe::preset("default").unwrap();
        let stages = &mut Stages::default();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default(), stages).unwrap();
        for target in [150, 600, 1200] {
            let sieved = sieve(&scene, &scored, &recipe, Only::Both, Some(target), stages).unwrap();
            let chosen = choose(&scene, &scored, &recipe, sieved.clone(), Some(target), stages).unwrap();
            assert_eq!(chosen.sieved.kept.len(), target);
            let got = quality(&scene, &scored, &recipe, &chosen.sieved);
            let by_c = Sieved::pruned(scored.ranking_by(StaticTerm::Mean, &recipe).unwrap().take(target));
            let own = Sieved::pruned(scored.ranking.take(target));
            for other in [sieved.clone(), by_c, own] {
                let expected = quality(&scene, &scored, &recipe, &other);
                assert!(got >= expected, "{target}: got {got} dB, an alternative has {expected}");
            }
            let lost = !sieved.clusters.is_empty() && chosen.sieved.clusters.is_empty();
            assert_eq!(chosen.left_out.iter().any(|left| left.what == "merging"), lost);
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
        let stages = &mut Stages::default();
        let scored = score_scene(&scene, &recipe, &UserOverrides::default(), stages).unwrap();
        let sieved = sieve(&scene, &scored, &recipe, Only::Both, None, stages).unwrap();
        let survivors = scored.selection.counts.kept;
        assert!(sieved.kept.len() < survivors, "nothing merged");
        let chosen = choose(&scene, &scored, &recipe, sieved, None, stages).unwrap();
        assert_eq!((chosen.sieved.kept.len(), chosen.left_out.len()), (survivors, 1));
    }

    #[test]
    fn pictures_that_decide_are_spread_over_all_and_none_counts_twice() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let pictures = spread(&scene.schedule, PICTURES);
        assert_eq!(pictures.len(), PICTURES);
        assert!(pictures.is_sorted() && pictures.windows(2).all(|pair| pair[0] != pair[1]));
        assert_eq!((pictures[0].0, pictures[PICTURES - 1].0), (0, 5));
    }
}
