//! Stiff scenes through the binary and the public library: what EXTREME input comes out as. One table of the cases, by the
//! number of their rows; those of `splatsieve selfcheck` run on every build, with the bounds that it prints:
//!
//! | row | case | test |
//! |---|---|---|
//! | 1 | no Gaussians | `clouds::no_gaussians_give_a_valid_empty_output` |
//! | 2 | one Gaussian | `clouds::one_gaussian_is_kept_byte_for_byte` |
//! | 3 | one frame | `clouds::one_frame_is_static_and_said_to_be` |
//! | 4 | two frames | `motion::two_frames_have_one_step_and_no_curvature` |
//! | 5 | sinusoids, T = 100,000 | `motion::sinusoids_over_100_000_frames_have_their_analytic_motion` |
//! | 6 | all identical | `clouds::identical_gaussians_are_pruned_to_the_exact_count_by_hash` |
//! | 7 | all static | `clouds::static_neighbors_merge_and_the_dynamic_arm_is_off` |
//! | 8 | 1% movers | `clouds::movers_around_one_percent_are_kept_whatever_their_number` |
//! | 9 | opacities 0 | `clouds::invisible_gaussians_are_all_prunable_without_nan` |
//! | 10 | opacities 1 | `clouds::solid_gaussians_have_no_variance_and_finite_logits` |
//! | 11 | constant opacity, T = 100,000 | `motion::constant_opacity_has_variance_exactly_0_over_100_000_frames` |
//! | 12 | teleport while dead | `motion::a_teleport_while_dead_changes_no_motion` |
//! | 13 | teleport while alive | `motion::a_teleport_while_alive_is_motion`, `merging::what_moves_or_lives_otherwise_never_merges` |
//! | 14 | life of 1, 2, 3 frames | `motion::lives_of_1_2_and_3_frames_have_0_0_and_1_curvature_terms`; selfcheck "short lives" |
//! | 15 | alternating life | `motion::alternating_lives_have_no_interior_triples` |
//! | 16 | death at the last frame | `motion::the_turn_about_the_last_life_frame_is_discarded` |
//! | 17 | disjoint lives | `merging::what_moves_or_lives_otherwise_never_merges` |
//! | 18 | NaN, infinity | `clouds::not_finite_gaussians_are_refused_dropped_or_kept_as_asked` |
//! | 19 | subnormals, −0 | `motion::subnormals_move_as_values_and_minus_0_is_0`, `merging::duplicates_that_differ_in_the_sign_of_0_…`; selfcheck "motion of any size" |
//! | 20 | scales 1e-12, 1e6 | `merging::scales_from_1e_minus_12_to_1e6_overflow_nothing`, `merging::balls_of_1e_minus_12_and_of_1e6_merge_…` |
//! | 21 | needle with its duplicate | selfcheck "needle and its twin" (1e-12), `merging::a_needle_keeps_its_smallest_scale_through_a_ply` |
//! | 22 | coplanar pancakes | `merging::coplanar_pancakes_stay_flat` |
//! | 23 | equal diagonal | `merging::a_covariance_with_equal_diagonal_has_its_axes`; selfcheck "mixture" |
//! | 24 | zero quaternion | `merging::a_zero_quaternion_is_the_identity_and_flagged` |
//! | 25 | offsets 1e2 … 1e7 | `motion::far_from_the_origin_noise_is_snapped_…`; selfcheck "motion far away" |
//! | 26 | camera inside, Gaussian behind | `tests/rendering/render_oracle.rs: what_is_nearer_than_0_2_or_behind_is_not_drawn` |
//! | 27 | near plane | `tests/rendering/render_oracle.rs: a_giant_across_the_near_plane_covers_the_image_and_no_more`, `merging::scales_…` |
//! | 28 | no cameras | `clouds::without_cameras_a_virtual_rig_is_used_and_said` |
//! | 29 | wholly occluded | `tests/rendering/render_oracle.rs: what_is_wholly_occluded_contributes_exactly_nothing`, `merging::what_is_hidden_goes_first_…` |
//! | 30 | giant background | `merging::what_is_hidden_goes_first_and_a_giant_background_stays_and_swallows_nothing` |
//! | 31 | exact duplicates | `clouds::exact_duplicates_merge_to_one_…`, `clouds::duplicates_merge_to_one_whatever_their_number`; selfcheck "duplicates" |
//! | 32 | a crowd in one voxel | `merging::a_crowd_in_one_voxel_is_cut_and_said_to_be` |
//! | 33 | sorted chain | `merging::a_sorted_chain_merges_as_the_sequential_rule_says` |
//! | 34 | partitions 1, 7, 64 | `tests/compression/merging.rs: partitions_of_the_pairs_change_no_byte` |
//! | 35 | black beside gray | `merging::what_looks_otherwise_never_merges` |
//! | 36 | ΣC·Vis = 0 | `merging::what_nobody_sees_merges_by_opacity_times_area` |
//! | 37 | threads, memory, tiles | `tests/compression/compress.rs: threads_change_no_byte`, `tests/command_line/memory.rs: the_least_that_is_named_works_…`; selfcheck "1 and 2 threads" |
//! | 38 | opposite, 10 v | `merging::what_moves_or_lives_otherwise_never_merges` |
//! | 39 | killed at any moment | `tests/command_line/memory.rs: a_run_killed_at_any_moment_…`, `tests/command_line/beside_others.rs: whenever_a_run_is_ended_…` |
//! | 40 | translated, rotated, scaled | `laws::*`, `clouds::without_cameras_what_stays_does_not_depend_on_the_unit_of_length` |
//! | 41 | time stamps | `streams::time_stamps_that_do_not_increase_are_named` |
//! | 42 | T = 1,000,000; N = 10,000,000 | `tests/command_line/long.rs` |
//! | 43 | another N, another column set | `clouds::frames_that_disagree_are_named`, `streams::frames_of_another_size_or_columns_are_named` |
//!
//! C, E and Vis, which no row names, have their slow definitions in selfcheck "projected area", "needle on screen" and
//! "contributions", and E in `laws`.

mod clouds;
mod laws;
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

/// `n` gray balls of radius 0.05 strewn over a unit square by the golden ratio, opacity 0.73.
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

/// One camera as 3DGS writes them, which sees all of [`balls`] at every frame.
const CAMERA: &str = r#"[{"id": 0, "img_name": "a", "width": 64, "height": 64, "fx": 60, "fy": 60,
    "position": [0.5, 0.5, -3], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]"#;

fn says(summary: &serde_json::Value, list: &str, part: &str) -> bool {
    summary[list].to_string().contains(part)
}

fn close(what: impl Display, got: f64, expected: f64, tolerance: f64) {
    assert!((got - expected).abs() <= tolerance, "{what}: got {got:e}, expected {expected:e}, tolerance {tolerance:e}");
}

/// Statistics by name, one value per Gaussian.
type Rows = BTreeMap<String, Vec<f64>>;

/// Runs the program with `stdin` on its standard input, written while it runs: it may stop reading early.
fn piped(workplace: &Workplace, arguments: &str, write: impl FnOnce(&mut dyn Write) + Send + 'static) -> Output {
    scene::piped(&mut workplace.command(arguments), move |pipe| write(&mut BufWriter::new(pipe)))
}

/// A sequence made frame by frame, for the program to read as a stream.
struct Sequence {
    frames: usize,
    header: StreamHeader,
    /// What does not vary, and what a frame begins as.
    state: Gaussians,
    cameras: Option<&'static str>,
    time: fn(usize) -> f64,
}

impl Sequence {
    /// `frames` frames of `count` balls, of which `varying` may be set anew in each.
    fn new(count: usize, frames: usize, varying: Attributes) -> Sequence {
        let header = StreamHeader { count, sh_degree: 0, varying, is_unlinked: false };
        Sequence { frames, header, state: balls(count), cameras: None, time: |t| t as f64 }
    }

    fn with_logits(mut self, logits: Vec<f32>) -> Sequence {
        self.state.opacity_logit.plane_mut(0).copy_from_slice(&logits);
        self
    }

    /// Runs the program on it; `fill` makes the frames.
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
                if stream.frame(time(t), &state).is_err() {
                    return;
                }
            }
            let _ = stream.finish();
        });
        assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
        output
    }

    /// Its statistics.
    fn rows(self, flags: &str, fill: impl Fn(usize, &mut Gaussians) + Send + 'static) -> Rows {
        let workplace = Workplace::new();
        self.run(&workplace, &format!("score - -o rows.npz {flags}"), fill);
        scene::arrays(&workplace.path("rows.npz"))
    }

    /// The summary of compressing it.
    fn summary(self, flags: &str, fill: impl Fn(usize, &mut Gaussians) + Send + 'static) -> serde_json::Value {
        let output = self.run(&Workplace::new(), &format!("compress - -o out.gseq --json {flags}"), fill);
        serde_json::from_slice(&output.stdout).unwrap()
    }
}
