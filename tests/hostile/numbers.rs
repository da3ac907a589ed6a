//! Tests of tiny counts, empty inputs, and one extreme value per attribute.

use std::fs;
use std::path::PathBuf;

use splatsieve::files::ply::write::write_inria;
use splatsieve::model::{AttributeValues, Gaussians};

use crate::runner::{Attack, Folder, Outcome};

/// Options that make a run with a few Gaussians short.
const QUICK: &str =
    "--cameras cameras.json --set refine_target_views=26 --set refine_steps=12 --set refine_steps_per_prune=3 --quiet";

/// Returns Gaussians of medium size and SH degree 1, distributed over a cube of side 2 by the golden ratio.
fn cloud(count: usize) -> Gaussians {
    let mut cloud = Gaussians::zeros(count, 1);
    let at = |k: usize| ((k + 1) as f32 * 0.618_034).fract();
    for i in 0..count {
        cloud.position.set_row(i, [0, 1, 2].map(|axis| 2.0 * at(3 * i + axis) - 1.0));
        cloud.rotation.set_row(i, [1.0, at(i), 0.0, 0.0]);
        cloud.log_scale.set_row(i, [-2.5, -2.0, -1.5 - at(i)]);
        cloud.opacity_logit.set_row(i, [3.0 * at(7 * i) - 0.5]);
    }
    cloud.sh.planes_mut().iter_mut().enumerate().for_each(|(k, x)| *x = 2.0 * at(k) - 1.0);
    cloud
}

/// Returns a folder with the Gaussians `cloud` as `in.ply`, and `cameras.json` (six small images from all sides).
fn folder_with(cloud: &Gaussians) -> Folder {
    let folder = Folder::new();
    write_inria(cloud, &[], &folder.path("in.ply")).unwrap();
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let turned = [axes, [axes[2], axes[1], [-1.0, 0.0, 0.0]], [axes[0], [0.0, 0.0, -1.0], axes[1]]];
    let camera = |k: usize| {
        // Rows of the camera-to-world matrix: the third column points at the origin.
        let sign = if k < 3 { 1.0 } else { -1.0 };
        let rotation = turned[k % 3].map(|row| [sign * row[0], row[1], sign * row[2]]);
        let position = [0, 1, 2].map(|axis| -4.0 * rotation[axis][2]);
        serde_json::json!({ "id": k, "img_name": k.to_string(), "width": 24, "height": 24, "fx": 24.0, "fy": 24.0,
            "position": position, "rotation": rotation })
    };
    folder.write("cameras.json", serde_json::Value::Array((0..6).map(camera).collect()).to_string());
    folder
}

/// Prepares a run of `compress in.ply -o OUTPUT` with the additional options `options`.
fn compress(folder: &Folder, output: &str, options: &str) -> Attack {
    folder.attack(&format!("compress in.ply -o {output} {QUICK} {options}"))
}

/// Reads the summary beside `output`.
fn summary(folder: &Folder, output: &str) -> serde_json::Value {
    let path = match folder.path(output).is_dir() {
        true => format!("{output}/summary.json"),
        false => format!("{output}.summary.json"),
    };
    serde_json::from_str(&fs::read_to_string(folder.path(&path)).unwrap()).unwrap()
}

/// Checks that a run either wrote all of `output` or explained its failure and left no part of it. Returns the number
/// of Gaussians in the output.
fn wrote_all_or_nothing(outcome: Outcome, folder: &Folder, output: &str) -> Option<u64> {
    let outcome = outcome.ended();
    if outcome.code == Some(0) {
        let summary = summary(folder, output);
        let text = summary.to_string();
        assert!(!text.contains("NaN dB") && !text.contains("inf dB"), "{}: {text}", outcome.shown);
        return summary["gaussians"].as_u64();
    }
    assert!(matches!(outcome.code, Some(1 | 2)), "{}: {:?}\n{}", outcome.shown, outcome.code, outcome.stderr);
    assert!(outcome.stderr.starts_with("splatsieve: ") && outcome.stderr.len() > 40, "{}", outcome.stderr);
    let left: Vec<String> =
        folder.names().into_iter().filter(|name| !["in.ply", "cameras.json"].contains(&&**name)).collect();
    assert!(left.is_empty(), "{}: failed and left {left:?}\n{}", outcome.shown, outcome.stderr);
    None
}

#[test]
fn searches_with_fewer_than_six_gaussians_end() {
    for count in [1, 3, 5] {
        let folder = folder_with(&cloud(count));
        let left = wrote_all_or_nothing(compress(&folder, "out.ply", "--min-psnr 30dB").run(), &folder, "out.ply");
        assert!((1..=count as u64).contains(&left.unwrap()), "{left:?} of {count}");
    }
}

#[test]
fn no_gaussians_give_an_empty_output_for_any_target() {
    let folder = folder_with(&cloud(0));
    for size in ["", "--ratio 0.5", "--count 1", "--min-psnr 30dB", "--size 100kB"] {
        let outcome = compress(&folder, "out.ply", size).run().succeeded();
        assert_eq!(summary(&folder, "out.ply")["gaussians"], 0, "{}", outcome.shown);
        folder.names().iter().filter(|name| name.starts_with("out")).for_each(|name| {
            fs::remove_file(folder.path(name)).unwrap();
        });
    }
}

#[test]
fn recipe_values_that_make_a_run_endless_are_refused() {
    let folder = folder_with(&cloud(7));
    let refused = |options: &str, parts: &[&str]| {
        compress(&folder, "out.ply", options).run().refused(2, parts);
    };
    refused("--ratio 0.5 --set round_fraction=0.9999999999", &["select.round_fraction", "0.01 to 0.99"]);
    let folder = folder_with(&cloud(7));
    let outcome =
        folder.attack("compress in.ply -o out.ply --cameras cameras.json --set refine_steps=4000000000").run();
    outcome.refused(2, &["refine.refine_steps", "0 to 1000000"]);
}

/// Compresses 40 Gaussians, and the same Gaussians followed by one whose color is not finite. The outputs must be
/// equal, because dropping the last Gaussian changes no id of the others.
#[test]
fn dropped_gaussians_change_no_byte_of_the_others() {
    let whole = cloud(40);
    let mut odd = whole.pick(&(0..40).chain([39]).collect::<Vec<u32>>());
    odd.sh.plane_mut(0)[40] = f32::INFINITY;
    odd.sh.plane_mut(1)[40] = f32::NAN;
    let [odd, whole] = [odd, whole].map(|cloud| folder_with(&cloud));
    for (output, size) in [("a.ply", "--count 25"), ("b.ply", "--min-psnr 25dB"), ("c.gsz", "--count 30")] {
        let options = format!("{size} --no-refine");
        compress(&odd, output, &format!("{options} --set non_finite=drop")).run().succeeded();
        compress(&whole, output, &options).run().succeeded();
        let [found, expected] = [&odd, &whole].map(|folder| fs::read(folder.path(output)).unwrap());
        assert!(found == expected, "{output}: {} bytes, expected {}", found.len(), expected.len());
    }
}

#[test]
fn infinite_color_in_an_archive_is_no_panic() {
    let mut odd = cloud(16);
    odd.sh.plane_mut(2)[3] = f32::INFINITY;
    let folder = folder_with(&odd);
    let left = wrote_all_or_nothing(compress(&folder, "q.gsz", "--set non_finite=drop").run(), &folder, "q.gsz");
    assert!(left.unwrap() <= 15);
    let folder = folder_with(&odd);
    let outcome = compress(&folder, "q.gsz", "--set non_finite=keep").run();
    assert_eq!(wrote_all_or_nothing(outcome, &folder, "q.gsz"), None, "an archive holds finite values");
}

#[test]
fn lossy_files_are_refused_if_an_outlier_takes_all_bits() {
    let mut odd = cloud(50);
    odd.position.plane_mut(0)[3] = 1e7;
    let folder = folder_with(&odd);
    let before = folder.names();
    let attack = folder.attack("convert in.ply out.spz --quiet");
    attack.run().refused(2, &["a .spz", "position of Gaussian", "scene units", "Gaussian 3 is the furthest"]);
    let attack = folder.attack("view in.ply -o out.html --cameras cameras.json --quiet");
    attack.run().refused(2, &["a page", "position of Gaussian", "Gaussian 3 is the furthest"]);
    assert_eq!(folder.names(), before);
}

#[test]
fn scales_far_beyond_the_scene_are_stored_as_the_largest() {
    let mut odd = cloud(50);
    odd.log_scale.plane_mut(1)[9] = 20.0;
    let folder = folder_with(&odd);
    let outcome = folder.attack("convert in.ply out.spz --quiet").run().succeeded();
    assert!(outcome.stderr.contains("Gaussians much larger than the scene: 1;"), "{}", outcome.stderr);
    folder.attack("convert in.ply out.splatv --quiet").run().succeeded();
}

/// Name and function of a change to Gaussian 3.
type Edit = (&'static str, fn(&mut Gaussians));

/// Changes that set a value to NaN or infinity, in every attribute.
const NOT_FINITE: [Edit; 8] = [
    ("position nan", |cloud| cloud.position.plane_mut(1)[3] = f32::NAN),
    ("position inf", |cloud| cloud.position.plane_mut(1)[3] = f32::INFINITY),
    ("rotation nan", |cloud| cloud.rotation.plane_mut(2)[3] = f32::NAN),
    ("scale nan", |cloud| cloud.log_scale.plane_mut(0)[3] = f32::NAN),
    ("scale -inf", |cloud| cloud.log_scale.plane_mut(0)[3] = f32::NEG_INFINITY),
    ("opacity inf", |cloud| cloud.opacity_logit.plane_mut(0)[3] = f32::INFINITY),
    ("color inf", |cloud| cloud.sh.plane_mut(0)[3] = f32::INFINITY),
    ("harmonic nan", |cloud| cloud.sh.plane_mut(7)[3] = f32::NAN),
];

/// Changes that set a value to a finite number far beyond those of any scene.
const EXTREME: [Edit; 12] = [
    ("position 1e30", |cloud| cloud.position.plane_mut(1)[3] = 1e30),
    ("position 1e7", |cloud| cloud.position.plane_mut(0)[3] = 1e7),
    ("rotation 0", |cloud| cloud.rotation.set_row(3, [0.0; 4])),
    ("rotation 1e30", |cloud| cloud.rotation.set_row(3, [1e30; 4])),
    ("scale 100", |cloud| cloud.log_scale.plane_mut(0)[3] = 100.0),
    ("scale -100", |cloud| cloud.log_scale.set_row(3, [-100.0; 3])),
    ("opacity 1e30", |cloud| cloud.opacity_logit.plane_mut(0)[3] = 1e30),
    ("color 1e30", |cloud| cloud.sh.plane_mut(0)[3] = 1e30),
    ("harmonic 1e30", |cloud| cloud.sh.plane_mut(7)[3] = 1e30),
    ("all opacities 0", |cloud| cloud.opacity_logit.planes_mut().fill(-100.0)),
    ("all at one place", |cloud| cloud.position.planes_mut().fill(0.25)),
    ("all behind the cameras", |cloud| cloud.position = AttributeValues::from_planes(3, vec![1e4; 3 * cloud.len()])),
];

const OUTPUTS: [&str; 5] = ["out.ply", "out.gseq", "out.spz", "out.splatv", "out.gsz"];

/// Returns a folder with 24 Gaussians changed by `edit`.
fn folder_with_edit(edit: &Edit) -> Folder {
    let mut cloud = cloud(24);
    (edit.1)(&mut cloud);
    folder_with(&cloud)
}

#[test]
#[ignore = "slow: 225 runs"]
fn slow_few_gaussians_end_for_every_target_and_output() {
    let sizes = ["", "--ratio 0.5", "--count 2", "--min-psnr 20dB", "--size 200kB"];
    for count in [0u64, 1, 2, 3, 4, 5, 7, 16, 50] {
        let cloud = cloud(count as usize);
        for size in sizes {
            for output in OUTPUTS {
                let folder = folder_with(&cloud);
                let left = wrote_all_or_nothing(compress(&folder, output, size).run(), &folder, output);
                let case = format!("{count} Gaussians, {size:?}, {output}: {left:?}");
                match (size, left) {
                    ("--count 2", None) => assert_eq!(count, 1, "{case}"),
                    (_, None) => panic!("{case}"),
                    ("--ratio 0.5", Some(left)) => {
                        assert_eq!(left, if count == 0 { 0 } else { count.div_ceil(2) }, "{case}");
                    }
                    ("--count 2", Some(left)) => assert_eq!(left, count.min(2), "{case}"),
                    (_, Some(left)) => assert!(left <= count && (left > 0 || count == 0), "{case}"),
                }
            }
        }
    }
}

#[test]
#[ignore = "slow: 136 runs"]
fn slow_nonfinite_values_are_refused_dropped_or_kept() {
    for edit in &NOT_FINITE {
        let folder = folder_with_edit(edit);
        for size in ["", "--ratio 0.5"] {
            compress(&folder, "out.ply", size).run().refused(1, &["in.ply", "Gaussian 3", "--non-finite"]);
        }
        for size in ["--ratio 0.5", "--min-psnr 20dB", "--size 100kB"] {
            for output in OUTPUTS {
                let folder = folder_with_edit(edit);
                let outcome = compress(&folder, output, &format!("{size} --set non_finite=drop")).run();
                let left = wrote_all_or_nothing(outcome, &folder, output);
                assert!(left.is_some_and(|left| (1..=23).contains(&left)), "{}, {size}, {output}: {left:?}", edit.0);
            }
        }
    }
}

#[test]
#[ignore = "slow: 120 runs"]
fn slow_runs_that_keep_nonfinite_values_end() {
    for edit in &NOT_FINITE {
        for size in ["", "--ratio 0.5", "--min-psnr 20dB"] {
            for output in OUTPUTS {
                let folder = folder_with_edit(edit);
                let outcome = compress(&folder, output, &format!("{size} --set non_finite=keep")).run();
                wrote_all_or_nothing(outcome, &folder, output);
            }
        }
    }
}

#[test]
#[ignore = "slow: 180 runs"]
fn slow_extreme_values_end_with_a_result_or_a_clear_error() {
    for edit in &EXTREME {
        for size in ["", "--ratio 0.5", "--min-psnr 20dB"] {
            for output in OUTPUTS {
                let folder = folder_with_edit(edit);
                let left = wrote_all_or_nothing(compress(&folder, output, size).run(), &folder, output);
                let is_exact = output == "out.ply" || output == "out.gseq";
                let is_seen = edit.0 != "all behind the cameras";
                assert!(left.is_some() || !is_exact || !is_seen, "{}, {size}, {output}", edit.0);
            }
        }
    }
}

#[test]
#[ignore = "slow: sweep and precision of 0 and 3 Gaussians"]
fn slow_sweep_and_precision_of_few_gaussians_end() {
    for count in [0, 3] {
        let folder = folder_with(&cloud(count));
        for attack in [
            "sweep in.ply --cameras cameras.json --fractions 0.5,1 --methods default,paper --steps 10 -o sweep --quiet",
            "precision in.ply --cameras cameras.json -o precision --runs 1 --max-frames 1 --set refine_steps=12 --quiet",
        ] {
            let outcome = folder.attack(attack).within(120.0).run().ended();
            assert!(matches!(outcome.code, Some(0..=2)), "{}: {}", outcome.shown, outcome.stderr);
        }
    }
}

#[test]
#[ignore = "slow: 12 runs"]
fn slow_extreme_parameters_end() {
    let folder = folder_with(&cloud(16));
    for (k, options) in [
        "--epsilon 1e300 --no-refine",
        "--set max_neighbors=1024 --no-refine",
        "--set round_fraction=0.99 --count 1",
        "--set round_fraction=0.1 --count 1",
        "--set refine_keyframes=1000",
        "--set round_groups=1000",
        "--set round_views=1000000000",
        "--set scoring_views=1000000000",
        "--set pixel_stride=4294967295",
        "--set frame_stride=4294967295",
        "--set alpha_min=1",
        "--set w_static=0",
    ]
    .into_iter()
    .enumerate()
    {
        let output = format!("out{k}.ply");
        let outcome = compress(&folder, &output, options).within(60.0).run().ended();
        assert!(matches!(outcome.code, Some(0..=2)), "{}: {}", outcome.shown, outcome.stderr);
        let written: Vec<PathBuf> = vec![folder.path(&output)];
        assert_eq!(written[0].exists(), outcome.code == Some(0), "{}", outcome.shown);
    }
}
