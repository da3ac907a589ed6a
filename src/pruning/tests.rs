//! Tests of the selection. Expected values are computed literally as the two stages are defined, without a ranking.

use proptest::prelude::*;

use super::*;
use crate::model::hash_id;
use crate::recipe::Recipe;

/// Creates the scores of Gaussians from their pairs of normalized static and dynamic scores. The score S is the sum of
/// a pair.
fn scores(parts: &[(f64, f64)]) -> Scores {
    let (static_norm, dynamic_norm): (Vec<f64>, Vec<f64>) = parts.iter().copied().unzip();
    let score = parts.iter().map(|(s, d)| s + d).collect();
    Scores {
        static_score: static_norm.clone(),
        dynamic_score: dynamic_norm.clone(),
        score,
        static_norm,
        dynamic_norm,
        terms: Vec::new(),
    }
}

fn rule(low_priority: LowScorePolicy, keep_fraction: f64, tau_static: f64, tau_dynamic: f64) -> SelectParams {
    let paper = Recipe::preset("paper").unwrap().select;
    SelectParams { keep_fraction, tau_static, tau_dynamic, low_priority, ..paper }
}

fn without_overrides(scores: &Scores, recipe: &SelectParams) -> Selection {
    select(scores, recipe, &[], &[]).unwrap()
}

/// Returns the ids of the Gaussians that stay, increasing.
fn kept_ids(selection: &Selection) -> Vec<u32> {
    selection.ranking.best_ids(selection.counts.kept)
}

/// Returns the ids of the Gaussians that stay, increasing, computed literally as defined: sorts all Gaussians by score,
/// then applies the thresholds of stage 2, unless all normalized scores are 0.
fn kept_by_definition(scores: &Scores, recipe: &SelectParams) -> Vec<u32> {
    let n = scores.score.len();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| {
        scores.score[b].partial_cmp(&scores.score[a]).unwrap().then(hash_id(a as u64).cmp(&hash_id(b as u64)))
    });
    let candidates = &order[..(recipe.keep_fraction * n as f64 + 0.5).floor() as usize];
    let graded = scores.static_norm.iter().chain(&scores.dynamic_norm).any(|&norm| norm != 0.0);
    (0..n)
        .filter(|&i| {
            let passes =
                !graded || scores.static_norm[i] >= recipe.tau_static || scores.dynamic_norm[i] >= recipe.tau_dynamic;
            passes && (recipe.low_priority == LowScorePolicy::Rescue || candidates.contains(&i))
        })
        .map(|i| i as u32)
        .collect()
}

/// Generates normalized scores in coarse steps, so that ties are frequent. Includes −0 and values outside [0, 1].
fn any_norm() -> impl Strategy<Value = f64> {
    prop_oneof![(-2i32..12).prop_map(|x| f64::from(x) / 8.0), Just(-0.0), Just(0.05), Just(0.05f64.next_down())]
}

// The sign of zero must not matter for the order of stage 2 either, nor among Gaussians that no stage keeps.
#[test]
fn sign_of_zero_changes_no_ranking() {
    let parts = |zero: f64| -> Vec<(f64, f64)> {
        (0..60).map(|i| if i % 3 == 0 { (zero, zero) } else { ([0.0, 0.5][i % 2], 0.0) }).collect()
    };
    for low_priority in [LowScorePolicy::Drop, LowScorePolicy::Rescue] {
        let recipe = rule(low_priority, 0.8, 0.05, 0.05);
        let [plus, minus] = [0.0, -0.0].map(|zero| without_overrides(&scores(&parts(zero)), &recipe));
        assert_eq!((plus.counts, plus.ranking.order()), (minus.counts, minus.ranking.order()));
    }
}

fn any_rule() -> impl Strategy<Value = SelectParams> {
    let tau = || prop_oneof![Just(0.0), Just(0.05), Just(0.5), Just(1.25)];
    let fraction = prop_oneof![Just(0.0), Just(1.0), 0.0..=1.0f64];
    (any::<bool>(), fraction, tau(), tau()).prop_map(|(rescue, fraction, tau_static, tau_dynamic)| {
        rule(if rescue { LowScorePolicy::Rescue } else { LowScorePolicy::Drop }, fraction, tau_static, tau_dynamic)
    })
}

proptest! {
    #[test]
    fn kept_set_meets_the_definition_and_leads_the_ranking(
        parts in prop::collection::vec((any_norm(), any_norm()), 0..80),
        // Scores S that do not follow from the two parts: a Gaussian that fails stage 2 may then have the best score.
        independent_scores in prop::collection::vec(any_norm(), 80),
        recipe in any_rule(),
    ) {
        let mut scores = scores(&parts);
        scores.score = independent_scores[..parts.len()].to_vec();
        let selection = without_overrides(&scores, &recipe);
        prop_assert_eq!(kept_ids(&selection), kept_by_definition(&scores, &recipe));
        prop_assert_eq!(selection.ranking.best_ids(usize::MAX), (0..parts.len() as u32).collect::<Vec<_>>());
        let counts = selection.counts;
        prop_assert_eq!(counts.kept, counts.candidates - counts.pruned_by_stage_2 + counts.rescued);
        prop_assert_eq!(counts.total, counts.kept + counts.pruned_by_stage_1 + counts.pruned_by_stage_2);
    }

    #[test]
    fn kept_ids_lead_the_ranking_and_dropped_ids_leave_it(
        parts in prop::collection::vec((any_norm(), any_norm()), 1..60),
        decisions in prop::collection::vec(0u8..6, 60),
        recipe in any_rule(),
    ) {
        let scores = scores(&parts);
        let with = |fate| (0..parts.len() as u32).filter(|&i| decisions[i as usize] == fate).collect::<Vec<u32>>();
        let (keep, drop) = (with(0), with(1));
        let selection = select(&scores, &recipe, &keep, &drop).unwrap();
        let natural = kept_by_definition(&scores, &recipe);
        let stays = |&id: &u32| match decisions[id as usize] { 0 => true, 1 => false, _ => natural.contains(&id) };
        prop_assert_eq!(kept_ids(&selection), (0..parts.len() as u32).filter(stays).collect::<Vec<_>>());
        prop_assert_eq!(selection.ranking.best_ids(keep.len()), keep);
        prop_assert_eq!(selection.ranking.order().len(), parts.len() - drop.len());
    }
}

#[test]
fn kept_set_leads_the_ranking_if_the_best_fail_stage_2() {
    let parts: Vec<(f64, f64)> = (0..100).map(|i| (if i == 0 { 0.0 } else { 1.0 }, 0.0)).collect();
    let mut scores = scores(&parts);
    scores.score = (0..100).map(|i| -f64::from(i)).collect();
    let selection = without_overrides(&scores, &rule(LowScorePolicy::Drop, 0.02, 0.5, 0.5));
    assert_eq!(kept_ids(&selection), [1]);
}

#[test]
fn a_single_gaussian_is_kept() {
    for preset in ["paper", "default"] {
        let recipe = Recipe::preset(preset).unwrap().select;
        assert_eq!(without_overrides(&scores(&[(0.0, -0.0)]), &recipe).counts.kept, 1, "{preset}");
    }
}

#[test]
fn presets_follow_their_low_priority() {
    let parts: Vec<(f64, f64)> = (0..1000).map(|i| (f64::from(i) / 1000.0, 0.0)).collect();
    let scores = scores(&parts);
    let paper = without_overrides(&scores, &Recipe::preset("paper").unwrap().select);
    assert_eq!((paper.counts.candidates, paper.counts.rescued, paper.counts.kept), (800, 0, 800));
    // All Gaussians except the last fifty have a normalized score of at least 0.05; stage 1 alone would exclude 150 of
    // them.
    let default = without_overrides(&scores, &Recipe::preset("default").unwrap().select);
    assert_eq!((default.counts.candidates, default.counts.rescued, default.counts.kept), (800, 150, 950));
}

#[test]
fn identical_gaussians_are_pruned_by_hashed_id() {
    let scores = scores(&vec![(0.5, 0.5); 1001]);
    let selection = without_overrides(&scores, &rule(LowScorePolicy::Drop, 0.3, 0.05, 0.05));
    assert_eq!(selection.counts.kept, 300);
    let mut by_hash: Vec<u32> = (0..1001).collect();
    by_hash.sort_by_key(|&id| hash_id(id.into()));
    assert_eq!(selection.ranking.order(), by_hash);
    let first_half = kept_ids(&selection).iter().filter(|&&id| id < 500).count();
    assert!((110..190).contains(&first_half), "ties must not favor a position in the file: {first_half} of 300");
}

#[test]
fn without_candidates_the_ranking_still_follows_the_score() {
    let parts: Vec<(f64, f64)> = (0..50).map(|i| (f64::from(i), 0.0)).collect();
    let selection = without_overrides(&scores(&parts), &rule(LowScorePolicy::Drop, 0.0, 0.05, 0.05));
    assert_eq!(selection.counts.kept, 0);
    assert_eq!(selection.ranking.best_ids(3), [47, 48, 49]);
}

#[test]
fn errors_name_conflicting_and_unknown_ids() {
    let scores = scores(&[(0.0, 0.0); 4]);
    let recipe = rule(LowScorePolicy::Rescue, 0.5, 0.05, 0.05);
    for (keep, drop, id) in [(&[1, 2][..], &[2][..], "2"), (&[7], &[], "7")] {
        let message = select(&scores, &recipe, keep, drop).unwrap_err().to_string();
        assert!(message.contains(id), "{message}");
    }
}

#[test]
fn no_gaussians_give_an_empty_selection() {
    let selection = without_overrides(&scores(&[]), &Recipe::preset("default").unwrap().select);
    assert!(selection.counts.kept == 0 && selection.ranking.order().is_empty());
}

#[test]
fn selection_ignores_thread_count() {
    let parts: Vec<(f64, f64)> =
        (0..20_000u64).map(|i| ((hash_id(i) % 50) as f64 / 50.0, (hash_id(i + 7) % 9) as f64 / 9.0)).collect();
    let scores = scores(&parts);
    let recipe = rule(LowScorePolicy::Drop, 0.6, 0.3, 0.5);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| without_overrides(&scores, &recipe))
    };
    let one = on(1);
    assert!(one == on(2) && one == on(7));
}
