//! Ranking by what the pictures would lose, scored anew as the model shrinks.
//!
//! One look at the whole model cannot rank for strong reductions: when a Gaussian goes, those behind it show
//! and those that it made superfluous are needed. So each round looks at what is left, ranks it by
//! [`RemovalError`](crate::render::RemovalError) and lets the worst go. Which Gaussians the next round sees
//! does not depend on how many are wanted in the end: a smaller target keeps a subset of a larger one.
//! Memory: see [`removal_error`].

use super::input::Scene;
use super::pictures::background;
use super::scored::Scored;
use super::summary::Stages;
use crate::error::{Error, Result};
use crate::recipe::Recipe;
use crate::select::Ranking;
use crate::stream::{Sample, removal_error};

/// Pictures per round, the same for a longer sequence: of a scene of 780, 65 rank about as well as 130.
pub(super) const PICTURES: usize = 96;

/// Ranks all but the dropped Gaussians in rounds, until a round leaves at most `fewest`; those that go in one
/// round, and those that stay after the last, by error, ties by the order there was. Protected Gaussians come
/// first.
///
/// Nothing happens without visible contributions, and at a `round_fraction` of 1.
pub fn rank_in_rounds(
    scene: &Scene,
    scored: &mut Scored,
    recipe: &Recipe,
    fewest: usize,
    stages: &mut Stages,
) -> Result<()> {
    let fraction = recipe.select.round_fraction;
    if !scored.has_seen() || fraction >= 1.0 {
        return Ok(());
    }
    let sample = Sample::at_most(&scene.schedule, PICTURES);
    let background = background(None, scene)?;
    let floor = recipe.select.contrast_floor as f32;
    let source = scene.input.source();
    let frames = source.info().times.len().max(1);

    let protected = scored.protected.clone();
    let is_free = |id: &u32| protected.binary_search(id).is_err();
    let mut free: Vec<u32> = scored.ranking.order().iter().copied().filter(is_free).collect();
    // Worst last.
    let mut gone: Vec<u32> = Vec::new();
    let count = free.len() + protected.len();
    let mut rounds = 0;
    while free.len() + protected.len() > fewest && !free.is_empty() {
        let seen = free.len() + protected.len();
        let left = ((seen as f64 * fraction) as usize).max(protected.len());
        let reads = sample.frames() as f64 / frames as f64 * seen as f64 / count as f64;
        stages.run("rounds", seen, reads, || {
            let mut ids: Vec<u32> = free.iter().chain(&protected).copied().collect();
            ids.sort_unstable();
            let errors = removal_error(source, &ids, &sample, background, floor, scene.limits)?.sum;
            let error = |id: &u32| ids.binary_search(id).map_or(0, |row| errors[row]);
            // Stable: ties keep the order there was.
            free.sort_by_cached_key(|id| std::cmp::Reverse(error(id)));
            let mut worst = free.split_off(left - protected.len());
            worst.append(&mut gone);
            gone = worst;
            Ok::<_, Error>(((), left))
        })?;
        rounds += 1;
    }
    if rounds > 0 {
        let order = protected.iter().copied().chain(free).chain(gone).collect();
        (scored.ranking, scored.ranked_by) = (Ranking::new(order), "removal in rounds");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::psnr;
    use crate::model::Columns;
    use crate::pipeline::choose::tests::scene;
    use crate::pipeline::pictures::spread;
    use crate::pipeline::scored::{UserOverrides, score_scene};
    use crate::render::render;
    use crate::stream::gather;

    fn ranked(scene: &Scene, user: &UserOverrides, fewest: usize) -> Scored {
        let recipe = Recipe::preset("default").unwrap();
        let mut scored = score_scene(scene, &recipe, user, &mut Stages::default()).unwrap();
        rank_in_rounds(scene, &mut scored, &recipe, fewest, &mut Stages::default()).unwrap();
        scored
    }

    #[test]
    fn a_smaller_target_keeps_a_subset_of_a_larger_one() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let [few, many] = [200, 800].map(|fewest| ranked(&scene, &UserOverrides::default(), fewest));
        assert_eq!(few.ranking.take(800), many.ranking.take(800));
        assert_ne!(few.ranking.take(800), few.selection.ranking.take(800), "rounds changed nothing");
        let mut every = few.ranking.order().to_vec();
        every.sort_unstable();
        assert!(every.iter().copied().eq(0..1500), "a Gaussian is missing or stands twice");
    }

    #[test]
    fn rounds_keep_more_of_the_pictures_than_one_ranking_by_coverage() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let scored = ranked(&scene, &UserOverrides::default(), 150);
        let all: Vec<u32> = (0..1500).collect();
        for target in [150, 500] {
            let quality = |kept: &[u32]| -> f64 {
                let of_picture = |&(frame, camera): &(usize, u32)| {
                    let original = gather(scene.input.source(), &all, frame, Columns::ALL).unwrap();
                    let camera = &scene.schedule.cameras[camera as usize];
                    psnr(&render(&original.pick(kept), camera, [0.0; 3]), &render(&original, camera, [0.0; 3]))
                };
                spread(&scene.schedule, 12).iter().map(of_picture).sum::<f64>() / 12.0
            };
            let got = quality(&scored.ranking.take(target));
            let once = quality(&scored.selection.ranking.take(target));
            assert!(got > once + 1.0, "{target}: got {got} dB in rounds, {once} at once");
        }
    }

    #[test]
    fn what_the_user_keeps_comes_first_and_what_he_drops_does_not_come() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let worst = ranked(&scene, &UserOverrides::default(), 100).ranking.order()[1490..].to_vec();
        let user = UserOverrides { keep: worst[..5].to_vec(), drop: worst[5..].to_vec(), keep_box: None };
        let scored = ranked(&scene, &user, 100);
        let (mut first, mut kept) = (scored.ranking.order()[..5].to_vec(), worst[..5].to_vec());
        first.sort_unstable();
        kept.sort_unstable();
        assert_eq!(first, kept);
        assert!(worst[5..].iter().all(|id| !scored.ranking.order().contains(id)));
    }

    #[test]
    fn a_model_that_is_small_enough_keeps_its_order() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let scored = ranked(&scene, &UserOverrides::default(), 1500);
        assert_eq!(scored.ranking, scored.selection.ranking);
        assert_eq!(scored.ranked_by, "sqrt(C*W)");
    }
}
