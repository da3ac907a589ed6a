//! Tests of unusual point clouds, from input file to output file.

use std::fs;

use super::scene::{self, PlyRows, Workplace, index_map};
use super::{CAMERA, balls, list_contains};
use splatsieve::model::Gaussians;

/// Change of some Gaussians that makes a scene unusual.
type Edit = fn(&mut Gaussians);

fn numbers(summary: &serde_json::Value, key: &str) -> Vec<f64> {
    summary["terms"].as_array().unwrap().iter().map(|term| term[key].as_f64().unwrap()).collect()
}

/// An input without Gaussians (case 1 of the table in `main.rs`) gives an output without Gaussians that commands can
/// read.
#[test]
fn no_gaussians_give_a_valid_empty_output() {
    let workplace = Workplace::new();
    let path = workplace.ply("empty.ply", &balls(0));
    for preset in ["paper", "default"] {
        let summary = workplace.summary(&format!("empty.ply --overwrite -o out.ply --preset {preset}"));
        assert_eq!(summary["gaussians"], 0);
        assert_eq!(fs::read(workplace.path("out.ply")).unwrap(), fs::read(&path).unwrap());
        assert!(index_map(&workplace.path("out.ply.index_map.npy")).is_empty());
        workplace.done(&format!("compress empty.ply --overwrite -o out.gseq --preset {preset}"));
        workplace.done("info out.gseq --check");
        workplace.done("score empty.ply --overwrite -o rows.npz");
    }
}

/// An input of one Gaussian (case 2 of the table in `main.rs`) is written unchanged, whatever the request.
#[test]
fn one_gaussian_is_kept_byte_for_byte() {
    let workplace = Workplace::new();
    let path = workplace.ply("one.ply", &balls(1));
    for request in ["--preset paper", "--preset default", "--count 1", "--ratio 0.01", "--merge-only"] {
        workplace.done(&format!("compress one.ply --overwrite -o out.ply {request}"));
        assert_eq!(fs::read(workplace.path("out.ply")).unwrap(), fs::read(&path).unwrap(), "{request}");
    }
}

/// An input of one frame (case 3 of the table in `main.rs`) has no motion; the summary lists the omitted statistics.
#[test]
fn one_frame_is_static_and_noted() {
    let workplace = Workplace::new();
    workplace.ply("one.ply", &balls(50));
    let summary = workplace.summary("one.ply -o out.ply");
    assert!(list_contains(&summary, "left_out", "motion, curvature, opacity variance"), "{}", summary["left_out"]);
    assert!(list_contains(&summary, "left_out", "1 frame"));
    workplace.done("score one.ply -o rows.npz");
    let rows = scene::arrays(&workplace.path("rows.npz"));
    for name in ["D", "kappa", "V", "dynamic_score"] {
        assert!(rows[name].iter().all(|&x| x == 0.0), "{name}: {:?}", rows[name]);
    }
    assert!(rows["life"].iter().all(|&frames| frames == 1.0));
}

/// A hundred identical Gaussians (case 6 of the table in `main.rs`) are pruned to the requested number. Hashes of the
/// ids decide which ones stay, not their order in the file.
#[test]
fn identical_gaussians_are_pruned_to_exact_count_by_hash() {
    let workplace = Workplace::new();
    let one = balls(1).pick(&[0; 100]);
    workplace.ply("same.ply", &one);
    for preset in ["paper", "default"] {
        // Projected coverage, because visible contribution would differ by drawing order.
        let request =
            format!("same.ply --overwrite -o out.ply --prune-only --preset {preset} --set coverage=projected");
        let summary = workplace.summary(&format!("{request} --count 37"));
        assert_eq!(summary["gaussians"], 37);
        assert!(list_contains(&summary, "left_out", "grading by coverage"), "{}", summary["left_out"]);
        let map = index_map(&workplace.path("out.ply.index_map.npy"));
        let kept: Vec<usize> = (0..100).filter(|&i| map[i] >= 0).collect();
        assert_ne!(kept, (0..37).collect::<Vec<_>>(), "{preset}: places in the file decide");
        // Without a target only stage 1 prunes, by count; stage 2 finds no differences.
        let expected = if preset == "paper" { 80 } else { 100 };
        assert_eq!(workplace.summary(&request)["gaussians"], expected, "{preset}");
        assert!(kept.iter().any(|&i| i < 20) && kept.iter().any(|&i| i > 80), "{preset}: {kept:?}");
    }
}

/// In a sequence without motion (case 7 of the table in `main.rs`), neighbors merge and the dynamic score is not used.
#[test]
fn static_neighbors_merge_and_dynamic_scores_are_off() {
    let workplace = Workplace::new();
    let mut cloud = balls(40).pick(&(0..80).map(|i| i / 2).collect::<Vec<_>>());
    // Side by side, not at the same position.
    for i in (0..80).step_by(2) {
        cloud.position.plane_mut(2)[i] = 0.001;
    }
    for frame in 0..4 {
        workplace.ply(&format!("frames/frame_{frame}.ply"), &cloud);
    }
    let summary = workplace.summary("frames -o out --no-refine");
    assert!(list_contains(&summary, "left_out", "grading by motion"), "{}", summary["left_out"]);
    assert!(list_contains(&summary, "left_out", "grading by the dynamic score"));
    assert_eq!(summary["merge"]["proxies"], summary["gaussians"], "each pair is one");
    let gaussians = summary["gaussians"].as_u64().unwrap();
    assert_eq!(gaussians * 2, summary["selection"]["kept"].as_u64().unwrap());
    // A result without motion has the same rows in every frame.
    let frames: Vec<PlyRows> =
        (0..4).map(|frame| PlyRows::read(&workplace.path(&format!("out/frame_{frame}.ply")))).collect();
    assert!(frames.iter().all(|frame| frame.rows == frames[0].rows));
}

/// If about 1% of the Gaussians move (case 8 of the table in `main.rs`), pruning keeps all of these.
#[test]
fn all_movers_are_kept_at_around_one_percent() {
    for movers in [1, 2, 3] {
        let workplace = Workplace::new();
        let mut cloud = balls(200);
        for frame in 0..4 {
            for i in 0..movers {
                cloud.position.plane_mut(2)[50 * i] = 0.1 * frame as f32;
            }
            workplace.ply(&format!("frames/frame_{frame}.ply"), &cloud);
        }
        let default = "--preset default --set tau_static=0.99 --set tau_dynamic=1 --no-refine";
        for request in ["--preset paper --count 20", default] {
            workplace.done(&format!("compress frames -o out --overwrite --prune-only {request}"));
            let map = index_map(&workplace.path("out/index_map.npy"));
            assert!((0..movers).all(|i| map[50 * i] >= 0), "{request}, {movers} movers of 200: one was pruned");
            assert!(map.iter().filter(|&&place| place >= 0).count() < 100, "{request}: nothing was pruned");
        }
    }
}

/// Gaussians with an opacity of almost 0 (case 9 of the table in `main.rs`) can be pruned to one, and no score is NaN.
#[test]
fn invisible_gaussians_are_prunable_without_nan() {
    for logit in [-100.0, -30.0] {
        let workplace = Workplace::new();
        let mut cloud = balls(60);
        cloud.opacity_logit.plane_mut(0).fill(logit);
        workplace.ply("dark.ply", &cloud);
        for preset in ["paper", "default"] {
            let request = format!("dark.ply --overwrite --preset {preset} -o out.ply");
            let summary = workplace.summary(&format!("{request} --count 1"));
            assert_eq!(summary["gaussians"], 1, "{preset}");
            assert_eq!(summary["flags"]["never_alive"], 60);
            assert!(numbers(&summary, "p99").iter().all(|x| x.is_finite()));
            workplace.done(&format!("compress {request}"));
        }
    }
}

#[test]
fn gaussians_like_their_background_use_the_contrast_floor() {
    let workplace = Workplace::new();
    // The first has the same black as what it hides; the second is fainter and slightly lighter.
    let mut two = balls(2);
    for (i, sh, logit) in [(0, -1.78, 2.0), (1, -1.70, 0.0)] {
        two.position.set_row(i, [0.2 + 0.6 * i as f32, 0.5, 0.0]);
        two.log_scale.set_row(i, [-2.0; 3]);
        two.sh.set_row(i, [sh; 3]);
        two.opacity_logit.set_row(i, [logit]);
    }
    workplace.ply("two.ply", &two);
    fs::write(workplace.path("cameras.json"), CAMERA).unwrap();
    let request = "two.ply --cameras cameras.json --overwrite -o out.ply --prune-only --no-refine";
    for (floor, expected) in [("", [0, -1]), ("--set contrast_floor=0", [-1, 0])] {
        workplace.done(&format!("compress {request} --set choose_by_views=false --count 1 {floor}"));
        assert_eq!(index_map(&workplace.path("out.ply.index_map.npy")), expected, "{floor:?}");
    }
}

/// Gaussians with an opacity of almost 1 (case 10 of the table in `main.rs`) have an opacity variance of 0, and proxies
/// get finite opacity logits.
#[test]
fn solid_gaussians_have_no_variance_and_finite_logits() {
    let workplace = Workplace::new();
    let mut cloud = balls(30).pick(&(0..60).map(|i| i / 2).collect::<Vec<_>>());
    cloud.opacity_logit.plane_mut(0).fill(100.0);
    for frame in 0..3 {
        workplace.ply(&format!("frames/frame_{frame}.ply"), &cloud);
    }
    workplace.done("score frames -o rows.npz");
    assert!(scene::arrays(&workplace.path("rows.npz"))["V"].iter().all(|&v| v == 0.0));
    for preset in ["paper", "default"] {
        let summary = workplace
            .summary(&format!("frames --preset {preset} --set trajectory=alignment --no-refine --overwrite -o out"));
        assert!(summary["merge"]["proxies"].as_u64().unwrap() > 0);
        let rows = PlyRows::read(&workplace.path("out/frame_0.ply"));
        assert!((0..rows.rows.len()).all(|i| rows.value(i, "opacity").is_finite() && rows.value(i, "opacity") > 10.0));
    }
}

/// A Gaussian with NaN or infinity (case 18 of the table in `main.rs`) is refused, dropped or kept, as the recipe asks.
#[test]
fn nonfinite_gaussians_are_refused_dropped_or_kept() {
    let edits: [(&str, Edit); 5] = [
        ("position", |g| g.position.plane_mut(1)[7] = f32::NAN),
        ("scale", |g| g.log_scale.plane_mut(0)[7] = f32::INFINITY),
        ("opacity", |g| g.opacity_logit.plane_mut(0)[7] = f32::NAN),
        ("rotation", |g| g.rotation.plane_mut(3)[7] = f32::NAN),
        ("color", |g| g.sh.plane_mut(2)[7] = f32::NEG_INFINITY),
    ];
    for (what, edit) in edits {
        let workplace = Workplace::new();
        let mut odd_cloud = balls(100);
        edit(&mut odd_cloud);
        let odd = workplace.ply("odd.ply", &odd_cloud);
        workplace.refused(
            1,
            "compress odd.ply -o out.ply --set non_finite=error",
            &["odd.ply", "Gaussian 7", "NaN or infinity", "--set non_finite=drop"],
        );

        let summary = workplace.summary("odd.ply -o dropped.ply --set non_finite=drop --merge-only --no-refine");
        assert_eq!((&summary["gaussians"], &summary["flags"]["non_finite"]), (&99.into(), &1.into()), "{what}");
        assert_eq!(index_map(&workplace.path("dropped.ply.index_map.npy"))[7], -1, "{what}");

        workplace.done("compress odd.ply -o kept.ply --set non_finite=keep --set refine_steps=40");
        let place = index_map(&workplace.path("kept.ply.index_map.npy"))[7];
        let (before, after) = (PlyRows::read(&odd), PlyRows::read(&workplace.path("kept.ply")));
        assert!(place >= 0 && after.rows[place as usize] == before.rows[7], "{what}");

        // The percentiles are those of the other 99 Gaussians from the same camera. The test uses projected coverage,
        // because visible contribution depends on the Gaussians in front.
        fs::write(workplace.path("cameras.json"), CAMERA).unwrap();
        let others: Vec<u32> = (0..100).filter(|&i| i != 7).collect();
        workplace.ply("others.ply", &odd_cloud.pick(&others));
        let [found, expected] = ["odd.ply --set non_finite=keep", "others.ply"].map(|request| {
            workplace
                .summary(&format!("{request} --set coverage=projected --cameras cameras.json --overwrite -o x.ply"))
        });
        assert_eq!(found["terms"], expected["terms"], "{what}");
    }
}

/// For an input without cameras (case 28 of the table in `main.rs`), the program places virtual cameras and says so in
/// a note.
#[test]
fn without_cameras_a_virtual_rig_is_used_and_noted() {
    let workplace = Workplace::new();
    workplace.ply("some.ply", &balls(20));
    let summary = workplace.summary("some.ply -o out.ply");
    assert!(list_contains(&summary, "notes", "no cameras were given or found: virtual rig"), "{}", summary["notes"]);
    assert!(summary["cameras"]["origin"].as_str().unwrap().contains("virtual rig"));
    assert!(summary["cameras"]["pairs"].as_u64().unwrap() > 1);
    assert_eq!(summary["flags"]["never_in_view"], 0);
}

/// For an input without cameras, the survivors do not depend on the unit of length (case 40 of the table in `main.rs`).
#[test]
fn without_cameras_survivors_ignore_the_length_unit() {
    let kept = |power: i32| {
        let (workplace, unit) = (Workplace::new(), 2f32.powi(power));
        let mut cloud = balls(2000);
        for i in 0..2000 {
            let value = |k: f32| (i as f32 * k).fract();
            let place = cloud.position.row::<3>(i);
            cloud.position.set_row(i, [place[0], place[1], value(0.754_877)].map(|x| x * unit));
            cloud.log_scale.set_row(i, [0.1, 0.2, 0.3].map(|k| unit.ln() - 3.5 - value(k)));
            cloud.opacity_logit.set_row(i, [6.0 * value(0.569_84) - 3.0]);
        }
        workplace.ply("cloud.ply", &cloud);
        workplace.done("compress cloud.ply -o out.ply --prune-only --no-refine --count 1000");
        index_map(&workplace.path("out.ply.index_map.npy"))
    };
    let expected = kept(1);
    // The virtual cameras are two extents away.
    for power in [-4, 20] {
        assert!(kept(power) == expected, "2^{power}: other Gaussians stay");
    }
}

/// Three copies of a Gaussian (case 31 of the table in `main.rs`) merge to one, with the opacity that the rule in the
/// recipe gives.
#[test]
fn duplicates_merge_to_one_with_the_named_opacity_rule() {
    let workplace = Workplace::new();
    let cloud = balls(10).pick(&(0..30).map(|i| i / 3).collect::<Vec<_>>());
    workplace.ply("three.ply", &cloud);
    let single = PlyRows::read(&workplace.ply("single.ply", &balls(10)));
    // Three opacities of 0.731 over the same area.
    let rules = [("sum", 1.0f64), ("union", 1.0 - (1.0f64 - 0.731_058_6).powi(3)), ("area", 1.0)];
    for (rule, opacity) in rules {
        let request = format!("three.ply --overwrite -o out.ply --merge-only --no-refine --set opacity={rule}");
        let summary = workplace.summary(&request);
        assert_eq!((&summary["gaussians"], &summary["merge"]["opacity"]), (&10.into(), &rule.into()));
        let rows = PlyRows::read(&workplace.path("out.ply"));
        for i in 0..10 {
            for name in rows.names.iter().filter(|name| *name != "opacity") {
                let (found, expected) = (rows.value(i, name), single.value(i, name));
                assert!((found - expected).abs() <= 2e-6 * expected.abs(), "{name}: {found}, expected {expected}");
            }
            let found = 1.0 / (1.0 + (-f64::from(rows.value(i, "opacity"))).exp());
            assert!((found - opacity).abs() < 1e-6, "{rule}: {found}, expected {opacity}");
        }
    }
}

/// Any number of copies of a Gaussian (case 31 of the table in `main.rs`) merges to one.
#[test]
fn any_number_of_duplicates_merges_to_one() {
    for count in [34, 100, 5000] {
        let workplace = Workplace::new();
        workplace.ply("same.ply", &balls(1).pick(&vec![0; count]));
        let summary = workplace.summary("same.ply -o out.ply --merge-only --no-refine");
        assert_eq!(summary["gaussians"], 1, "{count} copies");
    }
}

/// Frames with different numbers of Gaussians (case 43 of the table in `main.rs`) are refused if linking is off; the
/// message names the file.
#[test]
fn frames_with_unequal_counts_are_named() {
    let workplace = Workplace::new();
    workplace.ply("frames/frame_1.ply", &balls(5));
    workplace.ply("frames/frame_2.ply", &balls(5));
    workplace.ply("frames/frame_3.ply", &balls(4));
    workplace.refused(1, "compress frames -o out --link never", &["frame_3.ply", "5", "4"]);
    // By default such frames are linked.
    assert!(workplace.summary("frames -o out")["notes"].to_string().contains("linked"));
}
