//! Tests of extreme inputs through the program and the public library. The table lists the numbered cases and their
//! tests. Cases named "selfcheck" are run by `splatsieve selfcheck`, which prints their bounds:
//!
//! | case | input | test |
//! |---|---|---|
//! | 1 | no Gaussians | `clouds::no_gaussians_give_a_valid_empty_output` |
//! | 2 | one Gaussian | `clouds::one_gaussian_is_kept_byte_for_byte` |
//! | 3 | one frame | `clouds::one_frame_is_static_and_noted` |
//! | 4 | two frames | `motion::two_frames_have_one_step_and_no_curvature` |
//! | 5 | sinusoids, T = 100,000 | `motion::sinusoids_over_100_000_frames_have_their_analytic_motion` |
//! | 6 | all identical | `clouds::identical_gaussians_are_pruned_to_exact_count_by_hash` |
//! | 7 | all static | `clouds::static_neighbors_merge_and_dynamic_scores_are_off` |
//! | 8 | 1% movers | `clouds::all_movers_are_kept_at_around_one_percent` |
//! | 9 | opacities 0 | `clouds::invisible_gaussians_are_prunable_without_nan` |
//! | 10 | opacities 1 | `clouds::solid_gaussians_have_no_variance_and_finite_logits` |
//! | 11 | constant opacity, T = 100,000 | `motion::constant_opacity_has_variance_exactly_0_over_100_000_frames` |
//! | 12 | teleport while dead | `motion::teleport_while_dead_changes_no_motion` |
//! | 13 | teleport while alive | `motion::teleport_while_alive_is_motion`, `merging::different_motion_or_life_never_merges` |
//! | 14 | life of 1, 2, 3 frames | `motion::lives_of_1_2_3_frames_have_0_0_1_curvature_terms`; selfcheck "short lives" |
//! | 15 | alternating life | `motion::alternating_lives_have_no_interior_triples` |
//! | 16 | death at the last frame | `motion::curvature_at_the_last_alive_frame_is_discarded` |
//! | 17 | disjoint lives | `merging::different_motion_or_life_never_merges` |
//! | 18 | NaN, infinity | `clouds::nonfinite_gaussians_are_refused_dropped_or_kept` |
//! | 19 | subnormals, −0 | `motion::subnormals_move_as_values_and_minus_0_is_0`, `merging::duplicates_that_differ_in_the_sign_of_0_merge_to_one`; selfcheck "motion of any size" |
//! | 20 | scales 1e-12, 1e6 | `merging::scales_from_1e_minus_12_to_1e6_overflow_nothing`, `merging::merging_distance_scales_with_size_from_1e_minus_12_to_1e6` |
//! | 21 | needle with its duplicate | selfcheck "needle and its twin" (1e-12), `merging::needle_keeps_its_smallest_scale_through_a_ply` |
//! | 22 | coplanar pancakes | `merging::coplanar_pancakes_stay_flat` |
//! | 23 | equal diagonal | `merging::covariance_with_equal_diagonal_has_correct_axes`; selfcheck "mixture" |
//! | 24 | zero quaternion | `merging::zero_quaternion_is_the_identity_and_flagged` |
//! | 25 | offsets 1e2 … 1e7 | `motion::far_from_the_origin_float_noise_is_snapped_and_counted`; selfcheck "motion far away" |
//! | 26 | camera inside, Gaussian behind | `tests/rendering/render_oracle.rs: gaussians_nearer_than_0_2_or_behind_are_not_drawn` |
//! | 27 | near plane | `tests/rendering/render_oracle.rs: giant_across_the_near_plane_covers_just_the_image`, `merging::scales_from_1e_minus_12_to_1e6_overflow_nothing` |
//! | 28 | no cameras | `clouds::without_cameras_a_virtual_rig_is_used_and_noted` |
//! | 29 | completely occluded | `tests/rendering/render_oracle.rs: occluded_gaussians_contribute_exactly_zero`, `merging::hidden_go_first_and_giant_background_merges_with_none` |
//! | 30 | giant background | `merging::hidden_go_first_and_giant_background_merges_with_none` |
//! | 31 | exact duplicates | `clouds::duplicates_merge_to_one_with_the_named_opacity_rule`, `clouds::any_number_of_duplicates_merges_to_one`; selfcheck "duplicates" |
//! | 32 | many Gaussians in one voxel | `merging::crowded_voxel_is_truncated_and_noted` |
//! | 33 | sorted chain | `merging::sorted_chain_merges_by_the_sequential_rule` |
//! | 34 | partitions 1, 7, 64 | `tests/compression/merging.rs: number_of_pair_partitions_changes_no_byte` |
//! | 35 | black next to gray | `merging::different_colors_never_merge` |
//! | 36 | ΣC·Vis = 0 | `merging::unseen_gaussians_merge_by_opacity_times_area` |
//! | 37 | threads, memory, tiles | `tests/compression/compress.rs: compressed_bytes_ignore_thread_count`, `tests/command_line/memory.rs: named_minimum_memory_works_and_changes_no_byte`; selfcheck "1 and 2 threads" |
//! | 38 | opposite, 10 v | `merging::different_motion_or_life_never_merges` |
//! | 39 | run killed at any time | `tests/command_line/memory.rs: next_run_cleans_up_after_a_killed_run`, `tests/command_line/beside_others.rs: killed_run_leaves_old_or_new_output_and_foreign_files` |
//! | 40 | translated, rotated, scaled | `invariance::*`, `clouds::without_cameras_survivors_ignore_the_length_unit` |
//! | 41 | time stamps | `streams::nonincreasing_time_stamps_are_named` |
//! | 42 | T = 1,000,000; N = 10,000,000 | `tests/command_line/long.rs` |
//! | 43 | another N, other attributes | `clouds::frames_with_unequal_counts_are_named`, `streams::frames_of_another_size_or_attributes_are_named` |
//!
//! C, E and Vis, which no case names, are compared with slow definitions in selfcheck "projected area", "needle on
//! screen" and "contributions", and E in `invariance`.

mod clouds;
mod invariance;
mod merging;
mod motion;
#[path = "../scene/mod.rs"]
mod scene;
mod streams;

use std::collections::BTreeMap;
use std::fmt::Display;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::Output;

use scene::Workplace;
use splatsieve::files::frame_stream::StreamHeader;
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::outputs::frame_stream::StreamWriter;

/// Returns `n` gray balls of radius 0.05 and opacity 0.73, distributed over a unit square by the golden ratio.
fn balls(n: usize) -> Gaussians {
    let mut balls = Gaussians::zeros(n, 0);
    for i in 0..n {
        let x = (i as f32 * 0.618_034).fract();
        balls.position.set_row(i, [x, i as f32 / n as f32, 0.0]);
        balls.rotation.set_row(i, [1.0, 0.0, 0.0, 0.0]);
        balls.log_scale.set_row(i, [-3.0; 3]);
        balls.opacity_logit.set_row(i, [1.0]);
        balls.sh.set_row(i, [0.2; 3]);
    }
    balls
}

/// One camera in the file format of 3DGS that sees all of [`balls`] in every frame.
const CAMERA: &str = r#"[{"id": 0, "img_name": "a", "width": 64, "height": 64, "fx": 60, "fy": 60,
    "position": [0.5, 0.5, -3], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]"#;

fn list_contains(summary: &serde_json::Value, list: &str, part: &str) -> bool {
    summary[list].to_string().contains(part)
}

fn assert_close(what: impl Display, got: f64, expected: f64, tolerance: f64) {
    assert!((got - expected).abs() <= tolerance, "{what}: got {got:e}, expected {expected:e}, tolerance {tolerance:e}");
}

/// Statistics of a sequence by name, with one value per Gaussian.
type Rows = BTreeMap<String, Vec<f64>>;

/// Runs the program while `write` writes to its standard input. The program may stop reading early.
fn piped(workplace: &Workplace, arguments: &str, write: impl FnOnce(&mut dyn Write) + Send + 'static) -> Output {
    scene::piped(&mut workplace.command(arguments), move |pipe| write(&mut BufWriter::new(pipe)))
}

/// Sequence that is generated frame by frame and passed to the program as a stream.
struct Sequence {
    frames: usize,
    header: StreamHeader,
    /// Constant attributes, and the initial state of each frame.
    state: Gaussians,
    cameras: Option<&'static str>,
    time: fn(usize) -> f64,
}

impl Sequence {
    /// Returns a sequence of `frames` frames with `count` balls. The attributes `varying` can be set in each frame.
    fn new(count: usize, frames: usize, varying: Attributes) -> Sequence {
        let header = StreamHeader { count, sh_degree: 0, varying, is_unlinked: false };
        Sequence { frames, header, state: balls(count), cameras: None, time: |t| t as f64 }
    }

    fn with_logits(mut self, logits: Vec<f32>) -> Sequence {
        self.state.opacity_logit.plane_mut(0).copy_from_slice(&logits);
        self
    }

    /// Runs the program with the sequence on its standard input. `fill` sets the state of each frame, given the frame
    /// number.
    fn run(
        self,
        workplace: &Workplace,
        arguments: &str,
        fill: impl Fn(usize, &mut Gaussians) + Send + 'static,
    ) -> Output {
        let Sequence { frames, header, mut state, cameras, time } = self;
        let cameras = cameras.map_or(String::new(), |text| {
            std::fs::write(workplace.path("cameras.json"), text).unwrap();
            "--cameras cameras.json".to_owned()
        });
        let output = piped(workplace, &format!("{arguments} {cameras}"), move |to| {
            let mut stream = StreamWriter::new(to, Path::new("pipe"), header, &state).unwrap();
            for t in 0..frames {
                fill(t, &mut state);
                if stream.write_frame(time(t), &state).is_err() {
                    return;
                }
            }
            let _ = stream.finish();
        });
        assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
        output
    }

    /// Runs `score` on the sequence and returns the statistics. `fill` sets the state of each frame.
    fn rows(self, flags: &str, fill: impl Fn(usize, &mut Gaussians) + Send + 'static) -> Rows {
        let workplace = Workplace::new();
        self.run(&workplace, &format!("score - -o rows.npz {flags}"), fill);
        scene::arrays(&workplace.path("rows.npz"))
    }

    /// Runs `compress` on the sequence and returns the summary. `fill` sets the state of each frame.
    fn summary(self, flags: &str, fill: impl Fn(usize, &mut Gaussians) + Send + 'static) -> serde_json::Value {
        let output = self.run(&Workplace::new(), &format!("compress - -o out.gseq --json {flags}"), fill);
        serde_json::from_slice(&output.stdout).unwrap()
    }
}
