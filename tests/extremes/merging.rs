//! Tests of merging, from input file to output file: pairs that merge, pairs that must not merge, and proxies.

use std::fs;

use glam::{DMat3, DQuat, DVec3};
use splatsieve::model::Gaussians;

use super::scene::{PlyRows, Workplace, arrays, index_map};
use super::{CAMERA, assert_close, balls};

/// Options with which the merging tests alone decide, without renders.
const MERGE: &str = "--merge-only --no-refine --set choose_by_views=false --set coverage=projected --overwrite";

/// Returns three Gaussians: two equal balls at the same position, and a ball far away that gives the scene an extent.
fn twins() -> Gaussians {
    let mut cloud = balls(1).pick(&[0, 0, 0]);
    cloud.position.set_row(2, [3.0, 2.0, 1.0]);
    cloud
}

/// Returns how many of the two equal balls of [`twins`] remain after merging. `edit` changes the state of each frame,
/// given the frame number.
fn count_after_merging(frames: usize, edit: impl Fn(usize, &mut Gaussians)) -> usize {
    let workplace = Workplace::new();
    for t in 0..frames {
        let mut cloud = twins();
        edit(t, &mut cloud);
        workplace.ply(&format!("frames/frame_{t:03}.ply"), &cloud);
    }
    workplace.done(&format!("compress frames -o out {MERGE}"));
    let map = index_map(&workplace.path("out/index_map.npy"));
    assert_ne!(map[0], map[2], "what is far off merged");
    if map[0] == map[1] { 1 } else { 2 }
}

fn shift_along_x(cloud: &mut Gaussians, i: usize, by: f64) {
    cloud.position.plane_mut(0)[i] += by as f32;
}

/// Two Gaussians that move differently, teleport or live at different times (cases 13, 17 and 38 of the table in
/// `main.rs`) do not merge. Each case is compared with a pair without the difference, which merges.
#[test]
fn different_motion_or_life_never_merges() {
    const T: usize = 12;
    for speed in [1e-3, 0.02, 1.0] {
        let both = |other: f64| {
            count_after_merging(T, |t, cloud| {
                shift_along_x(cloud, 0, speed * (t as f64 - 6.0));
                shift_along_x(cloud, 1, other * speed * (t as f64 - 6.0));
            })
        };
        assert_eq!([both(1.0), both(-1.0), both(10.0), both(0.1)], [1, 2, 2, 2], "speed {speed}");
    }
    for (distance, expected) in [(0.0, 1), (0.5, 2), (100.0, 2)] {
        let teleport = |t: usize, cloud: &mut Gaussians| shift_along_x(cloud, 1, if t >= 5 { distance } else { 0.0 });
        assert_eq!(count_after_merging(T, teleport), expected, "a teleport by {distance}");
    }
    for (birth, death, expected) in [(0, T, 1), (6, T, 2), (1, 6, 2), (11, T, 2)] {
        let lives = |t: usize, cloud: &mut Gaussians| {
            let logit = |alive: bool| if alive { 2.0 } else { -9.0 };
            // The first is alive exactly where the second is not, or both are alive in all frames.
            let second = (birth..death).contains(&t);
            cloud.opacity_logit.plane_mut(0)[0] = logit(expected == 1 || !second);
            cloud.opacity_logit.plane_mut(0)[1] = logit(second);
        };
        assert_eq!(count_after_merging(T, lives), expected, "a second life from {birth} to {death}");
    }
}

/// Checks that 200 Gaussians that differ only in the signs of zeros are duplicates, and merge (case 19 of the table in
/// `main.rs`).
#[test]
fn duplicates_that_differ_in_the_sign_of_0_merge_to_one() {
    const N: usize = 200;
    let workplace = Workplace::new();
    let mut cloud = balls(1).pick(&[0; N + 1]);
    for i in 0..N {
        let zero = |bit: usize| if i >> bit & 1 == 0 { 0.0 } else { -0.0 };
        cloud.position.set_row(i, [0, 1, 2].map(zero));
        cloud.rotation.set_row(i, [1.0, zero(3), zero(4), zero(5)]);
        cloud.sh.set_row(i, [zero(6), zero(7), 0.5]);
    }
    cloud.position.set_row(N, [3.0, 2.0, 1.0]);
    workplace.ply("cloud.ply", &cloud);
    let summary = workplace.summary(&format!("cloud.ply -o out.ply {MERGE}"));
    assert_eq!(summary["gaussians"], 2, "{summary}");
    let map = index_map(&workplace.path("out.ply.index_map.npy"));
    assert!(map[..N].iter().all(|&place| place == map[0]), "{map:?}");
}

/// A black and a gray Gaussian, whose SH coefficients have the same direction, do not merge (case 35 of the table in
/// `main.rs`).
#[test]
fn different_colors_never_merge() {
    let colored =
        |dc: [[f32; 3]; 2]| count_after_merging(1, |_, cloud| (0..2).for_each(|i| cloud.sh.set_row(i, dc[i])));
    assert_eq!(colored([[-1.772; 3]; 2]), 1);
    for gray in [-1.2, -0.9, -0.5, -0.1] {
        assert_eq!(colored([[-1.772; 3], [gray; 3]]), 2, "black beside a gray of {gray}");
    }
    // Coefficients below black are also black.
    assert_eq!(colored([[-1.78; 3], [-2.5; 3]]), 1);
}

/// Merges two equal Gaussians, changed by `edit`, to one, by a run with the options `flags`. Returns the scales of the
/// result, its axes as columns, and its PLY row.
fn merge_two(edit: impl Fn(&mut Gaussians), flags: &str) -> ([f64; 3], DMat3, PlyRows) {
    let workplace = Workplace::new();
    let mut cloud = balls(1).pick(&[0, 0]);
    edit(&mut cloud);
    workplace.ply("two.ply", &cloud);
    workplace.done(&format!("compress two.ply -o out.ply {MERGE} {flags}"));
    let rows = PlyRows::read(&workplace.path("out.ply"));
    assert_eq!(rows.rows.len(), 1, "the case must merge");
    let value = |name: &str| f64::from(rows.value(0, name));
    let [w, x, y, z] = [0, 1, 2, 3].map(|k| value(&format!("rot_{k}")));
    let scales = [0, 1, 2].map(|k| value(&format!("scale_{k}")).exp());
    (scales, DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()), rows)
}

/// Options for merging: lengths in scene units, a radius of 1, and thresholds of Mahalanobis distance, color cosine and
/// motion that every pair passes.
const WIDE: &str = "--set length_unit=scene --set passes=1,1e9,-1,-1";

/// A needle that merges with its duplicate keeps its smallest scale (case 21 of the table in `main.rs`), along every
/// axis and in any order of the axes.
#[test]
fn needle_keeps_its_smallest_scale_through_a_ply() {
    for turn in [[1.0, 0.0, 0.0, 0.0], [0.5, -0.5, 0.1, 0.7], [0.2, 0.9, -0.3, 0.1]] {
        for long in 0..3 {
            let mut log_scale = [(1e-6f32).ln(); 3];
            log_scale[long] = (1e6f32).ln();
            let needle = |cloud: &mut Gaussians| {
                for i in 0..2 {
                    cloud.log_scale.set_row(i, log_scale);
                    cloud.rotation.set_row(i, turn);
                }
            };
            let (scales, _, _) = merge_two(needle, "");
            for k in 0..3 {
                let expected = f64::from(log_scale[k]).exp();
                assert_close(format!("scale {k} of {turn:?}"), scales[k], expected, 1e-6 * expected);
            }
        }
    }
}

/// Flat Gaussians side by side in a common plane merge to a flat one (case 22 of the table in `main.rs`), for any
/// orientation and thickness. Rotations in f32 limit how flat it is: their error of 1e-7 moves a point at a distance of
/// 0.02 by 2e-9.
#[test]
fn coplanar_pancakes_stay_flat() {
    for turn in [[1.0, 0.0, 0.0, 0.0], [0.5, -0.5, 0.1, 0.7], [0.2, 0.9, -0.3, 0.1]] {
        for thickness in [1e-3, 1e-5, 1e-7] {
            let [w, x, y, z] = turn.map(f64::from);
            let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
            let pancakes = |cloud: &mut Gaussians| {
                for i in 0..2 {
                    let at = axes * DVec3::new(0.02 * i as f64, 0.005 * i as f64, 0.0);
                    cloud.position.set_row(i, at.to_array().map(|x| x as f32));
                    cloud.rotation.set_row(i, turn);
                    cloud.log_scale.set_row(i, [0.05f64, 0.04, thickness].map(|s| s.ln() as f32));
                }
            };
            let (mut scales, found, _) = merge_two(pancakes, WIDE);
            let flat = (0..3).min_by(|&a, &b| scales[a].total_cmp(&scales[b])).unwrap();
            assert_close("the angle between normals", found.col(flat).dot(axes.z_axis).abs(), 1.0, 1e-9);
            scales.sort_by(f64::total_cmp);
            assert_close(format!("thickness of {turn:?}"), scales[0], thickness, 1e-6 * thickness + 4e-9);
            assert!(scales[1] > 0.039, "{scales:?}");
        }
    }
}

/// Two balls along a diagonal merge to a Gaussian with this diagonal as an axis (case 23 of the table in `main.rs`).
/// Its covariance has equal diagonal entries.
#[test]
fn covariance_with_equal_diagonal_has_correct_axes() {
    for direction in [[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, 1.0, -1.0]] {
        let half = 0.02;
        let apart = |cloud: &mut Gaussians| {
            cloud.position.set_row(0, direction.map(|x| (half * x) as f32));
            cloud.position.set_row(1, direction.map(|x| (-half * x) as f32));
        };
        let (scales, axes, rows) = merge_two(apart, &format!("{WIDE} --set placement=mean"));
        let long = (0..3).max_by(|&a, &b| scales[a].total_cmp(&scales[b])).unwrap();
        let along = DVec3::from(direction).normalize();
        assert_close(format!("axis of {direction:?}"), axes.col(long).dot(along).abs(), 1.0, 1e-6);
        let own = f64::from(-3.0f32).exp();
        // The position of the proxy between the two shows their weights.
        let x = f64::from(rows.value(0, "x")) / (half * direction[0]);
        let between = 3.0 * half * half * (1.0 - x * x);
        assert!(x.abs() < 0.1, "{x}");
        assert_close("the long scale", scales[long], (own * own + between).sqrt(), 1e-6);
        for k in (0..3).filter(|&k| k != long) {
            assert_close("another scale", scales[k], own, 1e-6);
        }
    }
}

/// A Gaussian with a zero quaternion merges like one with the identity as rotation, and is counted in the summary (case
/// 24 of the table in `main.rs`).
#[test]
fn zero_quaternion_is_the_identity_and_flagged() {
    let score = |turn: [f32; 4]| {
        let workplace = Workplace::new();
        let mut cloud = balls(6);
        cloud.log_scale.planes_mut()[..6].fill(-1.0);
        cloud.rotation.set_row(2, turn);
        workplace.ply("cloud.ply", &cloud);
        workplace.done("score cloud.ply -o rows.npz");
        let summary = workplace.summary("cloud.ply -o out.ply");
        (arrays(&workplace.path("rows.npz"))["C"].clone(), summary["flags"]["zero_rotation"].as_u64().unwrap())
    };
    let ((zero, flagged), (identity, none), (other, _)) =
        (score([0.0, -0.0, 0.0, 0.0]), score([1.0, 0.0, 0.0, 0.0]), score([1.0, 0.0, 1.0, 0.0]));
    assert_eq!((&zero, flagged, none), (&identity, 1, 0));
    assert_ne!(zero, other, "the rotation must matter");
    let pancakes = |first: [f32; 4]| {
        merge_two(
            |cloud: &mut Gaussians| {
                (0..2).for_each(|i| cloud.log_scale.set_row(i, [-1.0, -2.0, -3.0]));
                cloud.rotation.set_row(0, first);
            },
            "",
        )
    };
    for name in ["scale_0", "scale_1", "scale_2", "opacity", "x"] {
        let [zero, identity] = [[0.0; 4], [1.0, 0.0, 0.0, 0.0]].map(|turn| pancakes(turn).2.value(0, name));
        assert_eq!(zero, identity, "{name}");
    }
}

/// Two balls half a standard deviation apart merge, from a size of 1e-12 to 1e6 (case 20 of the table in `main.rs`).
/// Small balls three standard deviations apart do not merge.
#[test]
fn merging_distance_scales_with_size_from_1e_minus_12_to_1e6() {
    for size in [1e-12, 1e-9, 1e-6, 1e-3, 1e3, 1e6f64] {
        let far: &[f64] = if size < 0.1 { &[3.0] } else { &[] };
        for &apart in [0.5].iter().chain(far) {
            let workplace = Workplace::new();
            let mut cloud = balls(1).pick(&[0, 0]);
            (0..2).for_each(|i| cloud.log_scale.set_row(i, [size.ln() as f32; 3]));
            cloud.position.set_row(1, [(apart * size.min(1.0)) as f32, 0.0, 0.0]);
            workplace.ply("two.ply", &cloud);
            let flags = format!("{MERGE} --set length_unit=scene --set passes=1,1,-1,-1");
            workplace.done(&format!("compress two.ply -o out.ply {flags}"));
            let rows = PlyRows::read(&workplace.path("out.ply"));
            assert_eq!(rows.rows.len(), if apart < 1.0 { 1 } else { 2 }, "size {size:e}, {apart} apart");
            for k in 0..3 {
                let scale = f64::from(rows.value(0, &format!("scale_{k}"))).exp();
                // The distance makes the proxy longer along one axis.
                assert!((0.999_99..1.2).contains(&(scale / size)), "{scale:e} of {size:e}, {apart} apart");
            }
        }
    }
}

/// Gaussians from points to the size of the sky, in front of, around and behind the camera, give finite results (cases
/// 20 and 27 of the table in `main.rs`).
#[test]
fn scales_from_1e_minus_12_to_1e6_overflow_nothing() {
    let workplace = Workplace::new();
    let mut cloud = balls(300);
    for i in 0..300 {
        let log = |k: usize| (10f64.powi([-12, -6, -2, 0, 3, 6][(i / (k + 1)) % 6]).ln()) as f32;
        cloud.log_scale.set_row(i, [log(0), log(1), log(2)]);
        // The camera is at z = -3.
        cloud.position.plane_mut(2)[i] = [-3.3, -3.0, -2.81, -2.79, 0.0, 1e3][(i / 7) % 6];
        cloud.opacity_logit.plane_mut(0)[i] = (i % 9) as f32 - 4.0;
    }
    workplace.ply("cloud.ply", &cloud);
    // The second camera has a long focal length: squared areas of the largest Gaussian exceed 1e38.
    let [near, far] = [CAMERA.to_owned(), CAMERA.replace("fx\": 60, \"fy\": 60", "fx\": 6000, \"fy\": 6000")];
    let far = far.replace("\"id\": 0, \"img_name\": \"a\"", "\"id\": 1, \"img_name\": \"b\"");
    fs::write(
        workplace.path("cameras.json"),
        format!("{},{}", near.trim_end_matches(']'), far.trim_start_matches('[')),
    )
    .unwrap();
    for preset in ["paper", "default", "default --set coverage=projected --no-refine", "strong"] {
        let request = format!("cloud.ply --cameras cameras.json -o out.ply --overwrite --preset {preset}");
        let summary = workplace.summary(&request);
        assert!(summary["gaussians"].as_u64().unwrap() > 0);
        let rows = PlyRows::read(&workplace.path("out.ply"));
        for (i, name) in (0..rows.rows.len()).flat_map(|i| rows.names.iter().map(move |name| (i, name))) {
            assert!(rows.value(i, name).is_finite(), "{preset}: {name} of {i}");
        }
        let score = format!("score cloud.ply --cameras cameras.json -o rows.npz --overwrite --preset {preset}");
        workplace.done(&score.replace(" --no-refine", ""));
        for (name, values) in arrays(&workplace.path("rows.npz")) {
            assert!(values.iter().all(|x| x.is_finite()), "{preset}: {name}");
            // The number of pixels of the image.
            assert!(name != "C" || values.iter().all(|&c| (0.0..=64.0 * 64.0).contains(&c)), "{preset}: {values:?}");
        }
    }
}

/// Gaussians behind a wall are pruned first (case 29 of the table in `main.rs`), and a giant Gaussian in the background
/// merges with no other (case 30).
#[test]
fn hidden_go_first_and_giant_background_merges_with_none() {
    let workplace = Workplace::new();
    let mut cloud = balls(60);
    for i in 0..60 {
        cloud.opacity_logit.plane_mut(0)[i] = 9.0;
        cloud.sh.set_row(i, [0.05 * i as f32 - 1.4, 0.3, 0.0]);
    }
    // A wall in front of the first ten, and a giant Gaussian behind everything.
    for i in 0..10 {
        cloud.position.set_row(i, [0.45 + 0.01 * i as f32, 0.5, 8.0]);
        // They are larger than the Gaussians around the wall; only their being hidden counts against them.
        cloud.log_scale.set_row(i, [-1.0; 3]);
    }
    for i in 10..20 {
        cloud.position.set_row(i, [0.5, 0.5, 4.0 + 0.01 * i as f32]);
        cloud.log_scale.set_row(i, [0.5, 0.5, -5.0]);
    }
    cloud.position.set_row(20, [0.5, 0.5, 60.0]);
    cloud.log_scale.set_row(20, [3.5, 3.5, -2.0]);
    workplace.ply("cloud.ply", &cloud);
    fs::write(workplace.path("cameras.json"), CAMERA).unwrap();
    let request = "cloud.ply --cameras cameras.json -o out.ply --overwrite --no-refine";
    workplace.done(&format!("compress {request} --prune-only --count 50"));
    let map = index_map(&workplace.path("out.ply.index_map.npy"));
    assert!((0..10).all(|i| map[i] < 0), "{map:?}");
    for more in ["", "--merge-only", "--preset paper"] {
        workplace.done(&format!("compress {request} {more} --set tau_static=0"));
        let map = index_map(&workplace.path("out.ply.index_map.npy"));
        assert!(map[20] >= 0, "{more}: the background went");
        assert_eq!(map.iter().filter(|&&place| place == map[20]).count(), 1, "{more}: it swallowed others");
    }
    // Detail with the color of the giant at its center: the giant differs only in size.
    for i in 50..60 {
        cloud.position.set_row(i, [0.5 + 1e-3 * (i - 50) as f32, 0.5, 60.0]);
        cloud.sh.set_row(i, cloud.sh.row::<3>(20));
    }
    workplace.ply("cloud.ply", &cloud);
    for (preset, expected) in [("default", 1), ("strong", 1), ("default --set max_scale_ratio=inf", 11)] {
        workplace.done(&format!("compress {request} --merge-only --set choose_by_views=false --preset {preset}"));
        let map = index_map(&workplace.path("out.ply.index_map.npy"));
        let with_giant = map.iter().filter(|&&place| place == map[20]).count();
        assert_eq!(with_giant, expected, "{preset}: Gaussians that are one with the background");
    }
}

/// If Gaussians have more neighbors than the search returns, only the nearest are compared, and the summary counts
/// these Gaussians (case 32 of the table in `main.rs`). For ten million points see
/// `ten_million_points_in_one_voxel_cost_bounded_time`, which runs only by name.
#[test]
fn crowded_voxel_is_truncated_and_noted() {
    const N: usize = 30_000;
    let workplace = Workplace::new();
    let mut cloud = balls(1).pick(&vec![0; N]);
    for i in 0..N {
        let value = |k: f64| (1e-3 * (i as f64 * k).fract()) as f32;
        cloud.position.set_row(i, [value(0.618_033_988), value(0.754_877_666), value(0.569_840_290)]);
    }
    workplace.ply("crowd.ply", &cloud);
    let summary = workplace.summary(&format!("crowd.ply -o out.ply {MERGE} --set length_unit=scene"));
    let pass = &summary["merge"]["passes"][0];
    assert_eq!(pass["truncated"], N, "{pass}");
    // The search returns at most 32 neighbors of each Gaussian, so there are at most 32 pairs for each.
    assert!(pass["candidates"].as_u64().unwrap() <= 32 * N as u64 && pass["joins"].as_u64().unwrap() > 0, "{pass}");
}

/// Balls along a line, sorted by contribution, merge in pairs (case 33 of the table in `main.rs`): each ball could be
/// the leader of the next one, so the sequential rule decides.
#[test]
fn sorted_chain_merges_by_the_sequential_rule() {
    const N: usize = 4000;
    let workplace = Workplace::new();
    let mut cloud = balls(1).pick(&vec![0; N]);
    for i in 0..N {
        cloud.position.set_row(i, [i as f32 / 1024.0, 0.0, 0.0]);
        // Opacities fall along the line, and so does C.
        cloud.opacity_logit.set_row(i, [4.0 - 6.0 * i as f32 / N as f32]);
        cloud.log_scale.set_row(i, [-9.0; 3]);
    }
    workplace.ply("chain.ply", &cloud);
    // A camera far away, so that every ball has the same size in the image.
    let camera =
        CAMERA.replace("[0.5, 0.5, -3]", "[2, 0, -400]").replace("\"fx\": 60, \"fy\": 60", "\"fx\": 900, \"fy\": 900");
    fs::write(workplace.path("cameras.json"), camera).unwrap();
    // The next neighbor is within reach, the one after it is not.
    let flags = "--set length_unit=scene --set passes=0.0011,1e9,-1,-1 --cameras cameras.json";
    let summary = workplace.summary(&format!("chain.ply -o out.ply {MERGE} {flags}"));
    workplace.done("score chain.ply --set coverage=projected --cameras cameras.json -o rows.npz");
    let c = arrays(&workplace.path("rows.npz"))["C"].clone();
    assert!(c.windows(2).all(|pair| pair[0] > pair[1]), "the chain must be sorted");
    let map = index_map(&workplace.path("out.ply.index_map.npy"));
    let expected: Vec<i64> = (0..N as i64).map(|i| i / 2).collect();
    assert_eq!(map, expected, "who comes first leads who comes second, and so on");
    assert_eq!(summary["merge"]["passes"][0]["sequential"], true, "{}", summary["merge"]);
}

/// Gaussians behind the camera, whose C and Vis are 0, merge with the weights opacity × area (case 36 of the table in
/// `main.rs`). The weights are equal if these are 0 too.
#[test]
fn unseen_gaussians_merge_by_opacity_times_area() {
    for (logits, weight) in [([2.0f32, -1.0], None), ([-200.0, -200.0], Some(0.5))] {
        let workplace = Workplace::new();
        // The third Gaussian is in view.
        let mut cloud = balls(1).pick(&[0, 0, 0]);
        cloud.position.set_row(2, [0.5, 0.5, 0.0]);
        for (i, logit) in logits.into_iter().enumerate() {
            cloud.position.set_row(i, [0.01 * i as f32, 0.0, -50.0]);
            cloud.opacity_logit.set_row(i, [logit]);
        }
        workplace.ply("two.ply", &cloud);
        fs::write(workplace.path("cameras.json"), CAMERA).unwrap();
        let flags = format!("{MERGE} {WIDE} --set placement=mean --set alpha_min=0 --cameras cameras.json");
        let summary = workplace.summary(&format!("two.ply -o out.ply {flags}"));
        assert_eq!((&summary["gaussians"], &summary["flags"]["never_in_view"]), (&2.into(), &2.into()));
        let opacity = logits.map(|x| 1.0 / (1.0 + (-f64::from(x)).exp()));
        let second = weight.unwrap_or(opacity[1] / (opacity[0] + opacity[1]));
        let place = index_map(&workplace.path("out.ply.index_map.npy"))[0] as usize;
        let found = PlyRows::read(&workplace.path("out.ply")).value(place, "x");
        assert_close("x of the proxy", f64::from(found), second * f64::from(0.01f32), 1e-8);
    }
}
