//! Tests of the statistics of trajectories and life spans, from a stream of frames to scores.

use std::f64::consts::TAU;

use splatsieve::model::Attributes;

use super::{Rows, Sequence, assert_close};

const ALIVE: f32 = 0.0;
const DEAD: f32 = -7.0;
/// Options of `score` for the two definitions of motion, without the removal of rounding noise, because the positions
/// here have none.
const RUNS: &str = "--preset default --set snap_noise=false";
const LITERAL: &str = "--preset paper --set snap_noise=false";

/// Returns the statistics of Gaussians that move along the x axis. At frame t, Gaussian i has x coordinate `x(i, t)`
/// and opacity logit `life(i, t)`.
fn move_along_x(
    count: usize,
    frames: usize,
    flags: &str,
    x: impl Fn(usize, usize) -> f64 + Send + 'static,
    life: impl Fn(usize, usize) -> f32 + Send + 'static,
) -> Rows {
    Sequence::new(count, frames, Attributes::POSITION | Attributes::OPACITY).rows(flags, move |t, state| {
        for i in 0..count {
            state.position.set_row(i, [x(i, t) as f32, 0.0, 0.0]);
            state.opacity_logit.set_row(i, [life(i, t)]);
        }
    })
}

/// Returns the statistic `name` of Gaussian `i`.
fn statistic(rows: &Rows, name: &str, i: usize) -> f64 {
    rows[name][i]
}

/// A sequence of two frames (case 4 of the table in `main.rs`) has one step, and no curvature and no variance of
/// opacity.
#[test]
fn two_frames_have_one_step_and_no_curvature() {
    let rows = move_along_x(30, 2, RUNS, |i, t| (i * t) as f64 * 0.25, |_, _| ALIVE);
    for i in 0..30 {
        assert_eq!(
            (statistic(&rows, "D", i), statistic(&rows, "kappa", i), statistic(&rows, "V", i)),
            (0.25 * i as f64, 0.0, 0.0),
            "Gaussian {i}"
        );
    }
}

/// Positions that follow sinusoids over 100,000 frames have the motion D and the curvature κ that formulas give (case 5
/// of the table in `main.rs`), for a range of periods and phases.
///
/// - D has a relative error of at most 1e-6.
/// - κ has an error of at most 1e-6 of the amplitude. Rounding positions to f32 causes this error; the second
///   differences themselves may be as small as 4e-5.
/// - Compared with the second differences of the rounded positions, κ has a relative error of at most 1e-6.
#[test]
#[ignore = "needs time"]
fn sinusoids_over_100_000_frames_have_their_analytic_motion() {
    const T: usize = 100_000;
    const PERIODS: [f64; 8] = [3.0, 10.0, 37.5, 100.0, 333.0, 365.25, 777.7, 1000.0];
    let x = |i: usize, t: usize| (TAU * t as f64 / PERIODS[i % 8] + i as f64).sin();
    let count = 2 * PERIODS.len();
    for (flags, literal) in [(RUNS, false), (LITERAL, true)] {
        let rows = move_along_x(count, T, flags, x, |_, _| ALIVE);
        for i in 0..count {
            let steps: f64 = (1..T).map(|t| (x(i, t) - x(i, t - 1)).powi(2)).sum();
            // The paper divides by |life|.
            let d = (steps / (T - usize::from(!literal)) as f64).sqrt();
            let half = (TAU / PERIODS[i % 8] / 2.0).sin();
            let turns: f64 = (1..T - 1).map(|t| 4.0 * half * half * x(i, t).abs()).sum();
            let rounded = |t: usize| f64::from(x(i, t) as f32);
            let of_rounded: f64 = (1..T - 1).map(|t| (rounded(t + 1) - 2.0 * rounded(t) + rounded(t - 1)).abs()).sum();
            let what = |name: &str| format!("{name} of period {}, {flags}", PERIODS[i % 8]);
            assert_close(what("D"), statistic(&rows, "D", i), d, 1e-6 * d);
            assert_close(what("kappa"), statistic(&rows, "kappa", i), turns / (T - 2) as f64, 1e-6);
            let kappa = of_rounded / (T - 2) as f64;
            assert_close(what("kappa of what was rounded"), statistic(&rows, "kappa", i), kappa, 1e-6 * kappa);
        }
    }
}

/// A constant opacity has a variance of exactly 0 over 100,000 frames (case 11 of the table in `main.rs`): for
/// opacities up to the largest f32 below 1, stored once or in every frame.
#[test]
#[ignore = "needs time"]
fn constant_opacity_has_variance_exactly_0_over_100_000_frames() {
    let logits: [f32; 6] = [-4.0, -0.847_297_9, 0.0, 0.3, 6.9, 16.1];
    for varying in [Attributes::POSITION, Attributes::POSITION | Attributes::OPACITY] {
        for flags in [RUNS, LITERAL] {
            let rows =
                Sequence::new(logits.len(), 100_000, varying).with_logits(logits.to_vec()).rows(flags, |_, _| ());
            assert_eq!(rows["V"], [0.0; 6], "{flags}, {varying:?} vary");
            assert_eq!(rows["life"], [1e5; 6], "{flags}, {varying:?} vary");
        }
    }
}

/// A Gaussian that jumps while it is not alive has the same motion as without the jump (case 12 of the table in
/// `main.rs`), for a range of distances.
#[test]
fn teleport_while_dead_changes_no_motion() {
    let distance = |i: usize| 2f64.powi(i as i32 - 10);
    let dead = |_: usize, t: usize| if (6..9).contains(&t) { DEAD } else { ALIVE };
    let x = move |i: usize, t: usize, jump: f64| 0.125 * t as f64 + if t >= 7 { jump * distance(i) } else { 0.0 };
    let [still, jumped] = [0.0, 1.0].map(|jump| move_along_x(30, 16, RUNS, move |i, t| x(i, t, jump), dead));
    for name in ["D", "kappa"] {
        for i in 0..30 {
            assert_close(
                format!("{name} at {}", distance(i)),
                statistic(&jumped, name, i),
                statistic(&still, name, i),
                1e-6 * distance(i).max(1.0) * 1e-1,
            );
        }
        assert!(still["D"].iter().all(|&d| d == 0.125), "{:?}", still["D"]);
    }
}

/// A jump of a Gaussian while it is alive counts as motion (case 13 of the table in `main.rs`), for a range of
/// distances. `merging.rs` checks that a Gaussian that jumps does not merge with one that rests.
#[test]
fn teleport_while_alive_is_motion() {
    let distance = |i: usize| 2f64.powi(i as i32 - 10);
    let rows = move_along_x(30, 10, RUNS, move |i, t| if t < 5 { 0.0 } else { distance(i) }, |_, _| ALIVE);
    for i in 0..30 {
        assert_close("D", statistic(&rows, "D", i), distance(i) / 3.0, 1e-12 * distance(i));
        assert_close("kappa", statistic(&rows, "kappa", i), 2.0 * distance(i) / 8.0, 1e-12 * distance(i));
    }
}

/// Gaussians that are alive for 1, 2 and 3 frames have 0, 0 and 1 terms of curvature (case 14 of the table in
/// `main.rs`), for every first frame.
#[test]
fn lives_of_1_2_3_frames_have_0_0_1_curvature_terms() {
    // Gaussian 3·b + l − 1 is alive for l frames from frame b on.
    let life = |i: usize, t: usize| if (i / 3..i / 3 + i % 3 + 1).contains(&t) { ALIVE } else { DEAD };
    for flags in [RUNS, LITERAL] {
        let rows = move_along_x(21, 9, flags, |_, t| (t * t) as f64, life);
        for i in 0..21 {
            assert_eq!(statistic(&rows, "life", i), (i % 3 + 1) as f64);
            // The second difference of t² is 2.
            assert_eq!(statistic(&rows, "kappa", i), if i % 3 == 2 { 2.0 } else { 0.0 }, "{flags}, Gaussian {i}");
        }
    }
}

/// Gaussians that are never alive in two consecutive frames have no motion and no curvature (case 15 of the table in
/// `main.rs`).
#[test]
fn alternating_lives_have_no_interior_triples() {
    let life = |i: usize, t: usize| if t % (2 + i / 2) == i % 2 { ALIVE } else { DEAD };
    let rows = move_along_x(12, 19, RUNS, |_, t| (t * t) as f64, life);
    for i in 0..12 {
        assert_eq!((statistic(&rows, "D", i), statistic(&rows, "kappa", i)), (0.0, 0.0), "Gaussian {i}");
        assert!(statistic(&rows, "life", i) >= 2.0, "Gaussian {i} must live");
    }
}

/// A jump after the last frame in which a Gaussian is alive does not count as curvature (case 16 of the table in
/// `main.rs`), whichever frame is the last.
#[test]
fn curvature_at_the_last_alive_frame_is_discarded() {
    // Straight until death, then far away: only a second difference centered on the last alive frame would see the
    // jump.
    let x = |i: usize, t: usize| if t <= i + 2 { t as f64 } else { 50.0 };
    let life = |i: usize, t: usize| if t <= i + 2 { ALIVE } else { DEAD };
    for flags in [RUNS, LITERAL] {
        let rows = move_along_x(8, 10, flags, x, life);
        assert_eq!(rows["kappa"], [0.0; 8], "{flags}");
        assert_eq!(rows["life"], [3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]);
    }
}

/// Subnormal coordinates count as motion like any other values, and −0 counts as 0 (case 19 of the table in `main.rs`).
#[test]
fn subnormals_move_as_values_and_minus_0_is_0() {
    let step = |i: usize| f64::from(f32::from_bits(1)) * (i + 1) as f64;
    let rows = move_along_x(40, 6, RUNS, move |i, t| step(i) * t as f64, |_, _| ALIVE);
    for i in 0..40 {
        assert_close(format!("D of steps of {:e}", step(i)), statistic(&rows, "D", i), step(i), 1e-12 * step(i));
    }
    let signed = |zero: f32| {
        Sequence::new(40, 4, Attributes::POSITION | Attributes::OPACITY).rows(RUNS, move |t, state| {
            for i in 0..40 {
                state.position.set_row(i, [if (i + t) % 3 == 0 { zero } else { (i % 5) as f32 }, zero, 1.0]);
                state.opacity_logit.set_row(i, [if i % 2 == 0 { zero } else { 1.0 }]);
                state.rotation.set_row(i, [1.0, zero, zero, zero]);
                state.log_scale.set_row(i, [zero, -2.0, zero]);
            }
        })
    };
    let [plus, minus] = [0.0, -0.0].map(signed);
    assert!(plus == minus, "the sign of 0 shows");
}

/// Far from the origin (case 25 of the table in `main.rs`), Gaussians that rest except for rounding noise have no
/// motion, and the summary counts them. Gaussians that move have the motion of their rounded positions.
#[test]
fn far_from_the_origin_float_noise_is_snapped_and_counted() {
    const RESTING: usize = 30;
    for exponent in 2..=7 {
        let offset = 10f64.powi(exponent);
        let ulp = f64::from((offset as f32).next_up()) - f64::from(offset as f32);
        // Each axis has its own pattern, one ulp high; the other Gaussians move in steps of 64 ulps.
        let x = move |i: usize, t: usize| match i {
            0..RESTING => offset + ulp * ((t >> (i % 3)) % 2) as f64,
            _ => offset + 64.0 * ulp * (t * (i - RESTING + 1) % 7) as f64,
        };
        let sequence = || Sequence::new(2 * RESTING, 40, Attributes::POSITION);
        let fill = move |t: usize, state: &mut splatsieve::model::Gaussians| {
            (0..2 * RESTING).for_each(|i| state.position.set_row(i, [x(i, t) as f32, 0.0, 0.0]));
        };
        let rows = sequence().rows("--preset default", fill);
        let summary = sequence().summary("--preset default --set coverage=projected --prune-only --no-refine", fill);
        assert!(rows.values().flatten().all(|value| value.is_finite()), "offset {offset:e}");
        for i in 0..2 * RESTING {
            let at = |t: usize| f64::from(x(i, t) as f32);
            let steps: f64 = (1..40).map(|t| (at(t) - at(t - 1)).powi(2)).sum();
            let expected = if i < RESTING { 0.0 } else { (steps / 39.0).sqrt() };
            assert_close(format!("D of {i} at {offset:e}"), statistic(&rows, "D", i), expected, 1e-6 * expected);
        }
        assert_eq!(summary["flags"]["snapped_d"], RESTING, "offset {offset:e}: {}", summary["flags"]);
    }
}
