//! Tests that compare normalization, scores, thresholds and survivors with a plain implementation of method.md,
//! sections 2 to 4: sorted values for percentiles, loops for sums, one sort per stage.

use crate::scene::{by_formula, scene, tiny};
use splatsieve::model::StatisticRows;
use splatsieve::pipeline::score_scene;
use splatsieve::pruning::score::{Scored, UserOverrides};
use splatsieve::recipe::{Anisotropy, LowScorePolicy, Recipe};

const COUNT: usize = 300;
const FRAMES: f64 = 10.0;

fn scored(recipe: &Recipe) -> Scored {
    score_scene(&scene(&tiny()), recipe, &UserOverrides::default()).unwrap()
}

/// Returns the nearest-rank percentile: the smallest value that at least `percent` of all values do not exceed.
fn percentile(values: &[f64], percent: usize) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(|a, b| a.partial_cmp(b).unwrap());
    sorted[(percent * sorted.len()).div_ceil(100) - 1]
}

fn norm(values: &[f64], epsilon: f64, clip: bool) -> Vec<f64> {
    let (p1, p99) = (percentile(values, 1), percentile(values, 99));
    let scaled = |x: f64| {
        if p99 <= p1 {
            return if x > p99 { 1.0 } else { 0.0 };
        }
        let y = (x - p1) / (p99 - p1 + epsilon);
        if clip { y.clamp(0.0, 1.0) } else { y }
    };
    values.iter().map(|&x| scaled(x)).collect()
}

/// Returns the first output of SplitMix64 with state `id`, as published (Steele, Lea and Flood 2014).
fn hash(id: usize) -> u64 {
    let mut z = (id as u64).wrapping_mul(0x9e3779b97f4a7c15).wrapping_add(0x9e3779b97f4a7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58476d1ce4e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d049bb133111eb);
    z ^ z >> 31
}

struct PlainScores {
    static_score: Vec<f64>,
    dynamic_score: Vec<f64>,
    score: Vec<f64>,
    keep: Vec<bool>,
}

fn plain_scores(rows: &StatisticRows, recipe: &Recipe) -> PlainScores {
    let (score, select) = (&recipe.score, &recipe.select);
    let norm = |values: &[f64]| norm(values, score.norm_epsilon, score.clip_norm);
    let life: Vec<f64> = rows.life.iter().map(|&frames| f64::from(frames) / FRAMES).collect();
    let moved = |values: &[f64]| -> Vec<f64> {
        values.iter().zip(&life).map(|(x, life)| if score.weigh_motion_by_life { x * life } else { *x }).collect()
    };
    let weigh = |terms: &[(f64, Vec<f64>)]| -> Vec<f64> {
        let norms: Vec<(f64, Vec<f64>)> = terms.iter().map(|(weight, values)| (*weight, norm(values))).collect();
        (0..COUNT).map(|i| norms.iter().map(|(weight, norm)| weight * norm[i]).sum()).collect()
    };
    let static_score = weigh(&[(1.0, rows.c.clone()), (score.lambda, rows.e.clone())]);
    let dynamic_score = weigh(&[
        (1.0, moved(&rows.d)),
        (score.mu, moved(&rows.kappa)),
        (score.eta, rows.v.clone()),
        (score.xi, life.clone()),
    ]);
    let sum: Vec<f64> =
        (0..COUNT).map(|i| score.w_static * static_score[i] + score.w_dynamic * dynamic_score[i]).collect();

    let mut best: Vec<usize> = (0..COUNT).collect();
    best.sort_by(|&a, &b| sum[b].partial_cmp(&sum[a]).unwrap().then(hash(a).cmp(&hash(b))));
    let candidates = &best[..(select.keep_fraction * COUNT as f64).round() as usize];
    let (of_static, of_dynamic) = (norm(&static_score), norm(&dynamic_score));
    let keep = (0..COUNT)
        .map(|i| {
            let passes = of_static[i] >= select.tau_static || of_dynamic[i] >= select.tau_dynamic;
            passes && (select.low_priority == LowScorePolicy::Rescue || candidates.contains(&i))
        })
        .collect();
    PlainScores { static_score, dynamic_score, score: sum, keep }
}

/// Checks that the scores, thresholds and survivors of the program agree with the plain implementation for `recipe`.
/// Returns the number of Gaussians that were kept.
fn assert_agrees(recipe: Recipe) -> usize {
    let scored = scored(&recipe);
    let expected = plain_scores(&scored.rows().unwrap(), &recipe);
    let scores = scored.scores(&recipe.score).unwrap();
    for (what, got, expected) in [
        ("S_static", &scores.static_score, &expected.static_score),
        ("S_dynamic", &scores.dynamic_score, &expected.dynamic_score),
        ("S", &scores.score, &expected.score),
    ] {
        for i in 0..COUNT {
            // A few sums of f64 in another order.
            let tolerance = 1e-13 * (1.0 + expected[i].abs());
            assert!(
                (got[i] - expected[i]).abs() <= tolerance,
                "{what} of {i}: got {}, expected {}",
                got[i],
                expected[i]
            );
        }
    }
    assert_eq!(scored.selection.keep(), expected.keep);
    let kept = expected.keep.iter().filter(|&&keep| keep).count();
    assert_eq!(scored.selection.counts.kept, kept);
    kept
}

#[test]
fn presets_score_and_keep_as_specified() {
    assert_eq!(assert_agrees(by_formula("paper")), 240);
    for preset in ["default", "gentle", "strong"] {
        let kept = assert_agrees(by_formula(preset));
        assert!((100..COUNT).contains(&kept), "{preset}: {kept} kept");
    }
}

#[test]
fn every_score_parameter_acts_as_specified() {
    let edits: [fn(&mut Recipe); 9] = [
        |r| (r.score.w_static, r.score.w_dynamic) = (2.0, 0.3),
        |r| (r.score.lambda, r.score.anisotropy) = (1.5, Anisotropy::Log),
        |r| (r.score.mu, r.score.eta, r.score.xi) = (0.0, 2.0, 0.7),
        |r| r.score.weigh_motion_by_life = true,
        |r| (r.score.norm_epsilon, r.score.clip_norm) = (0.1, false),
        |r| r.score.clip_norm = !r.score.clip_norm,
        |r| r.select.keep_fraction = 0.355,
        |r| (r.select.tau_static, r.select.tau_dynamic) = (0.4, 0.6),
        |r| (r.select.low_priority, r.select.tau_static, r.select.tau_dynamic) = (LowScorePolicy::Drop, 0.2, 0.3),
    ];
    for preset in ["paper", "default"] {
        let counts: Vec<usize> = edits
            .iter()
            .map(|edit| {
                let mut recipe = by_formula(preset);
                edit(&mut recipe);
                assert_agrees(recipe)
            })
            .collect();
        let (fraction, thresholds, both) = (counts[6], counts[7], counts[8]);
        assert!(thresholds < 230 && both < 240 && both > 20, "{preset}: the thresholds bind nothing: {counts:?}");
        assert!(preset == "default" || fraction <= 107, "{preset}: stage 1 binds nothing: {counts:?}");
    }
}

#[test]
fn smaller_targets_keep_a_subset_of_larger_ones() {
    for preset in ["paper", "default"] {
        let recipe = by_formula(preset);
        let scored = scored(&recipe);
        let expected = plain_scores(&scored.rows().unwrap(), &recipe);
        let selection = scored.selection;
        let own: Vec<u32> = (0..COUNT as u32).filter(|&i| expected.keep[i as usize]).collect();
        assert_eq!(selection.ranking.best_ids(own.len()), own, "the recipe's own count gives the recipe's own set");
        let mut larger = selection.ranking.best_ids(COUNT);
        for m in (0..COUNT).rev() {
            let smaller = selection.ranking.best_ids(m);
            assert_eq!(smaller.len(), m);
            assert!(smaller.iter().all(|id| larger.binary_search(id).is_ok()), "{preset}: {m}");
            larger = smaller;
        }
    }
}
