//! Tests of the other model formats. Their frame states are compared with those of their trainers' code, and compressed
//! models are read back.

use std::fs;
use std::path::{Path, PathBuf};

use crate::scene::{Workplace, arrays, shared, state};
use splatsieve::model::{Gaussians, SH_C0, Split};
use splatsieve::scene::{InputOptions, Scene, open_scene};

fn model_path(name: &str) -> PathBuf {
    shared("families").join(name)
}

fn open(model: &Path, cameras: &Path) -> Scene {
    let options = InputOptions { path: model.to_owned(), cameras: Some(cameras.to_owned()), ..InputOptions::default() };
    open_scene(&options).unwrap()
}

/// Name of the array with the colors in the reference files.
const COLOR_KEY: &str = concat!("col", "our");

/// Absolute tolerance of a scale that is the small sum of two numbers of a few hundredths. The trainers' f32 code is
/// off by up to 8e-9 there.
const CANCELLED: f64 = 1e-9;

/// Largest differences between the frame states of a model as this program computes them and as its trainer's code
/// recorded them, over all Gaussians and all recorded frames.
#[derive(Debug, Default)]
struct StateErrors {
    position: f64,
    rotation: f64,
    /// Largest relative difference of a scale, beyond the absolute tolerance [`CANCELLED`].
    scale: f64,
    opacity: f64,
    color: f64,
}

impl StateErrors {
    fn measure(scene: &Scene, model: &Path) -> StateErrors {
        let expected = arrays(&model.join("states.npz"));
        let source = scene.source();
        let mut errors = StateErrors::default();
        for (row, &frame) in expected["frames"].iter().enumerate() {
            let state = state(source, frame as usize);
            errors.add(&state, |name, width| {
                let name = if expected.contains_key(name) { name } else { "features" };
                // Colors are not recorded if they are SH that do not change.
                let Some(all) = expected.get(name) else { return &[] };
                let rows = state.len() * width;
                // An array that does not change with time is recorded once.
                let at = if all.len() == rows { 0 } else { row * rows };
                &all[at..at + rows]
            });
        }
        errors
    }

    fn add<'a>(&mut self, state: &Gaussians, expected: impl Fn(&'static str, usize) -> &'a [f64]) {
        let [xyz, rotation, scales] =
            [("xyz", 3), ("rotation", 4), ("scales", 3)].map(|(name, width)| expected(name, width));
        let (opacity, color) = (expected("opacity", 1), expected(COLOR_KEY, 3));
        let raise = |most: &mut f64, found: f64, wanted: f64| *most = most.max((found - wanted).abs());
        for i in 0..state.len() {
            let q = state.rotation_f64(i);
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            for c in 0..4 {
                raise(&mut self.rotation, q[c] / length, rotation[4 * i + c]);
            }
            for c in 0..3 {
                raise(&mut self.position, f64::from(state.position.plane(c)[i]), xyz[3 * i + c]);
                let (found, wanted) = (f64::from(state.log_scale.plane(c)[i]).exp(), scales[3 * i + c]);
                self.scale = self.scale.max(((found - wanted).abs() - CANCELLED).max(0.0) / wanted);
                if let Some(&wanted) = color.get(3 * i + c) {
                    raise(&mut self.color, 0.5 + SH_C0 * f64::from(state.sh.plane(c)[i]), wanted);
                }
            }
            raise(&mut self.opacity, 1.0 / (1.0 + (-f64::from(state.opacity_logit.plane(0)[i])).exp()), opacity[i]);
        }
    }

    /// Returns whether all differences are within tolerances that are reasonable in f32.
    fn is_within_f32_tolerance(&self) -> bool {
        self.position <= 2e-6
            && self.rotation <= 5e-7
            && self.scale <= 1e-6
            && self.opacity <= 5e-7
            && self.color <= 1e-6
    }
}

#[test]
#[ignore = "needs the trained models"]
fn dynamic_3d_gaussians_states_match_their_trainer() {
    let model = model_path("d3dg");
    let [own, other] = ["train_meta.json", "transforms_train.json"].map(|name| open(&model, &model.join(name)));
    for scene in [&own, &other] {
        let errors = StateErrors::measure(scene, &model);
        assert!(errors.is_within_f32_tolerance(), "{errors:?}");
    }
    // The cameras of this trainer's own files equal those of the transforms files.
    let train = |scene: &Scene| -> Vec<_> {
        scene.rig.views.iter().filter(|rig_view| rig_view.split == Split::Train).cloned().collect()
    };
    let [of_own, of_other] = [train(&own), train(&other)];
    assert_eq!(of_own.len(), of_other.len());
    for (a, b) in of_own.iter().zip(&of_other) {
        let [a, b] = [&own.rig.cameras[a.camera as usize], &other.rig.cameras[b.camera as usize]];
        assert!((a.rotation - b.rotation).to_cols_array().iter().all(|x| x.abs() < 1e-8));
        assert!((a.translation - b.translation).length() < 1e-8 && (a.fx - b.fx).abs() < 1e-6 && a.cx == b.cx);
    }
}

/// Returns the largest differences between the frame states of this program and those that the trainer's code recorded,
/// for models that record covariances: of position, of opacity, and of the covariance relative to its largest entry.
fn covariance_errors(scene: &Scene, model: &Path) -> [f64; 3] {
    let expected = arrays(&model.join("states.npz"));
    let (source, mut errors) = (scene.source(), [0.0f64; 3]);
    for (row, (&frame, &time)) in expected["frames"].iter().zip(&expected["times"]).enumerate() {
        assert!((source.info().times[frame as usize] - time).abs() < 1e-9);
        let state = state(source, frame as usize);
        let count = state.len();
        for i in 0..count {
            let at = row * count + i;
            let q = state.rotation_f64(i);
            let turn = glam::DMat3::from_quat(glam::DQuat::from_xyzw(q[1], q[2], q[3], q[0]).normalize());
            let scales = glam::DVec3::from(state.scales_f64(i));
            let axes = turn * glam::DMat3::from_diagonal(scales);
            let found = (axes * axes.transpose()).to_cols_array();
            let cov = &expected["cov"][6 * at..][..6];
            let most = cov.iter().fold(0.0f64, |most, x| most.max(x.abs()));
            for (k, workplace) in [0, 1, 2, 4, 5, 8].into_iter().enumerate() {
                errors[2] = errors[2].max((found[workplace] - cov[k]).abs() / most);
            }
            for c in 0..3 {
                errors[0] = errors[0].max((f64::from(state.position.plane(c)[i]) - expected["xyz"][3 * at + c]).abs());
            }
            let opacity = 1.0 / (1.0 + (-f64::from(state.opacity_logit.plane(0)[i])).exp());
            errors[1] = errors[1].max((opacity - expected["opacity"][i]).abs());
        }
    }
    errors
}

#[test]
#[ignore = "needs the trained models"]
fn deformable_3d_gaussians_states_match_their_trainer() {
    for (name, cameras) in [("deformable3d", "deform2"), ("deformable3d_6dof", "room2_dynerf")] {
        let model = model_path(name);
        let errors = covariance_errors(&open(&model, &shared(cameras)), &model);
        println!("{name}: position {:e}, opacity {:e}, covariance {:e}", errors[0], errors[1], errors[2]);
        assert!(errors[0] <= 2e-6 && errors[1] <= 5e-7 && errors[2] <= 1e-5, "{name}: {errors:?}");
    }
}

#[test]
#[ignore = "needs the trained models"]
fn sc_gs_states_match_their_trainer() {
    let model = model_path("scgs");
    let errors = StateErrors::measure(&open(&model, &shared("deform2")), &model);
    println!("{errors:?}");
    assert!(errors.is_within_f32_tolerance(), "{errors:?}");
}

/// Returns the PSNR of `compressed` against `original`, in dB.
fn psnr(workplace: &Workplace, original: &str, compressed: &str) -> f64 {
    let found = workplace.done(&format!("evaluate {original} {compressed} --cameras {original} --json"));
    let found: serde_json::Value = serde_json::from_str(&found).unwrap();
    found["psnr"].as_f64().unwrap()
}

#[test]
#[ignore = "needs the trained models"]
fn every_command_accepts_dynamic_3d_gaussians() {
    let workplace = Workplace::new();
    let model = model_path("d3dg").display().to_string();
    let whole = workplace.done(&format!("info {model}"));
    assert!(whole.contains("Dynamic3DGaussians") && whole.contains("2000"), "{whole}");
    for ratio in [0.4, 0.2] {
        let [pruned, default, refined] =
            [("pruned", "--prune-only --no-refine"), ("merged", "--no-refine"), ("refined", "")].map(
                |(name, options)| {
                    let options = format!("-o {name} --ratio {ratio} {options} --overwrite");
                    let summary = workplace.summary(&format!("{model} --cameras {model} {options}"));
                    assert_eq!(summary["gaussians"], 2000.0 * ratio, "{summary}");
                    psnr(&workplace, &model, name)
                },
            );
        println!("{ratio}: {pruned} dB pruned, {default} with merging, {refined} refined");
        assert!(default >= pruned && refined > pruned + 1.0, "{pruned} {default} {refined}");
    }
    workplace
        .done(&format!("compress {model} --cameras {model} -o merged.gseq --merge-only --preset strong --no-refine"));
    workplace.done(&format!("convert {model} packed.gseq"));
    workplace.done(&format!("score {model} --cameras {model} -o rows.csv"));
    workplace.done(&format!("render {model} --cameras {model} --frame 3 --view 1 -o render.png"));
}

#[test]
#[ignore = "needs the trained models"]
fn spacetime_gaussians_states_match_their_trainer() {
    let [lite, full] = ["stg_lite", "stg_full"].map(model_path);
    for path in [lite.clone(), lite.join("point_cloud/iteration_10000/point_cloud.ply")] {
        let errors = StateErrors::measure(&open(&path, &lite), &lite);
        assert!(errors.is_within_f32_tolerance(), "{errors:?}");
    }
    let scene = open(&full, &full);
    let expected = arrays(&full.join("states.npz"));
    let decoder = scene.source().decoder().expect("a network");
    let mut errors = StateErrors::default();
    let mut furthest = 0.0f64;
    for (row, &frame) in expected["frames"].iter().enumerate() {
        assert!((scene.source().info().times[frame as usize] - expected["times"][row]).abs() < 1e-9);
        let state = state(scene.source(), frame as usize);
        let count = state.len();
        let features = &expected["features"][9 * count * row..][..9 * count];
        // Color that the first three features have without the decoder.
        let colors: Vec<f64> =
            features.chunks(9).flat_map(|f| [f[0], f[1], f[2]].map(|x| 1.0 / (1.0 + (-x).exp()))).collect();
        errors.add(&state, |name, width| match name {
            COLOR_KEY => &colors,
            "scales" => &expected[name],
            _ => &expected[name][row * width * count..][..width * count],
        });
        let mut found = Default::default();
        decoder.features(frame as usize, &mut found).unwrap();
        for (i, features) in features.chunks(9).enumerate() {
            let row = found.row::<9>(i);
            furthest = row.iter().zip(features).fold(furthest, |most, (&a, b)| most.max((f64::from(a) - b).abs()));
        }
    }
    assert!(errors.is_within_f32_tolerance() && furthest < 5e-7, "{errors:?} {furthest}");
}

#[test]
#[ignore = "needs the trained models"]
fn spacetime_gaussians_decoders_match_their_trainer() {
    let workplace = Workplace::new();
    let full = model_path("stg_full");
    let expected = arrays(&full.join("decoder.npz"));
    for act in ["sandwich", "sandwichnoact", "sandwichnoactss"] {
        let copy = workplace.path(act);
        let iteration = "point_cloud/iteration_25000";
        fs::create_dir_all(copy.join(iteration)).unwrap();
        for name in ["point_cloud.ply", "point_cloud.pt"] {
            fs::copy(full.join(iteration).join(name), copy.join(iteration).join(name)).unwrap();
        }
        fs::write(copy.join("cfg_args"), format!("Namespace(rgbfunction='{act}')")).unwrap();
        let scene = open(&copy, &full);
        let decoder = scene.source().decoder().unwrap();
        let single = |values: &[f64]| values.iter().map(|&x| x as f32).collect::<Vec<f32>>();
        let rows = expected["features"].chunks(9).zip(expected["rays"].chunks(6)).zip(expected[act].chunks(3));
        let mut furthest = 0.0f64;
        for ((features, rays), expected) in rows {
            let rays = single(rays);
            let [center, ray] = [0, 3].map(|at| [rays[at], rays[at + 1], rays[at + 2]]);
            let found = decoder.color(&single(features), center, ray);
            furthest = found.iter().zip(expected).fold(furthest, |most, (&a, b)| most.max((f64::from(a) - b).abs()));
        }
        assert!(furthest < 1e-6, "{act}: {furthest}");
    }
}

#[test]
#[ignore = "needs the trained models"]
fn splatv_of_the_lite_model_equals_its_converter_rounded() {
    let workplace = Workplace::new();
    let lite = model_path("stg_lite");
    let [model, cameras] = [lite.clone(), lite.clone()].map(|path| path.display().to_string());
    workplace.done(&format!("compress {model} --cameras {cameras} -o all.splatv --ratio 1 --prune-only --no-refine"));
    let texture = |path: &Path| {
        let bytes = fs::read(path).unwrap();
        let words: Vec<u32> = bytes[..8].chunks(4).map(|word| u32::from_le_bytes(word.try_into().unwrap())).collect();
        assert_eq!(words[0], 0x674b);
        bytes[8 + words[1] as usize..].to_vec()
    };
    let [found, expected] = [workplace.path("all.splatv"), lite.join("model.splatv")].map(|path| texture(&path));
    assert_eq!(found.len(), expected.len());
    // The converter of the viewer computes exponentials in f32: near the middle between two half-precision numbers it
    // may round to the other one.
    let parts =
        |texture: &[u8]| texture.as_chunks().0.iter().map(|&part| u16::from_le_bytes(part)).collect::<Vec<u16>>();
    let (found, expected) = (parts(&found), parts(&expected));
    let differing: Vec<usize> = (0..found.len()).filter(|&k| found[k] != expected[k]).collect();
    // Words 5, 6 and 15 of the 16 words of each Gaussian.
    let are_exponentials = differing.iter().all(|k| [10, 11, 12, 31].contains(&(k % 32)));
    let is_next = differing.iter().all(|&k| found[k].abs_diff(expected[k]) == 1);
    assert!(differing.len() <= 2 && are_exponentials && is_next, "{differing:?}");
    // The file read again moves like the model, to half precision.
    let [read, own] = ["all.splatv", &model].map(|path| open(&workplace.path(path), &lite));
    assert_eq!(read.source().info().times, own.source().info().times);
    let [read, own] = [&read, &own].map(|scene| state(scene.source(), 20));
    let errors =
        read.position.planes().iter().zip(own.position.planes()).fold(0.0f32, |most, (a, b)| most.max((a - b).abs()));
    assert!(errors < 4e-3, "{errors}");
    assert!(workplace.done(&format!("evaluate {model} all.splatv --cameras {model} --json")).contains("psnr"));
}

#[test]
#[ignore = "needs the trained models"]
fn every_command_accepts_spacetime_gaussians() {
    let workplace = Workplace::new();
    // The color decoder of `stg_full` is untrained: neighboring Gaussians have very different colors.
    for (name, least) in [("stg_lite", 32.0), ("stg_full", 23.0)] {
        let model = model_path(name).display().to_string();
        for ratio in [0.4, 0.2] {
            let [pruned, default] = [("pruned", "--prune-only"), ("merged", "")].map(|(name, options)| {
                let options = format!("-o {name} --ratio {ratio} {options} --overwrite");
                workplace.summary(&format!("{model} --cameras {model} {options}"));
                psnr(&workplace, &model, name)
            });
            println!("{name} {ratio}: {pruned} dB pruned, {default} default");
            assert!(default >= pruned && default > least, "{name} {ratio}: {pruned} {default}");
        }
        workplace.done(&format!(
            "compress {model} --cameras {model} -o merged --merge-only --preset strong --no-refine --overwrite"
        ));
        assert!(psnr(&workplace, &model, "merged") > least);
        workplace.done(&format!("convert {model} packed.gseq --cameras {model} --overwrite"));
        workplace.done(&format!("score {model} --cameras {model} -o rows.csv --overwrite"));
        workplace.done(&format!("render {model} --cameras {model} --frame 3 --view 1 -o render.png --overwrite"));
        workplace.done(&format!("report {model} merged --cameras {model} -o report --overwrite"));
    }
}

#[test]
#[ignore = "needs the trained models"]
fn native_4d_gaussians_states_match_their_trainer() {
    let model = model_path("yang4d");
    // The duration is in the configuration file beside the model.
    let scene = open(&model, &model);
    let expected = arrays(&model.join("states.npz"));
    let count = scene.source().info().count;
    let mut errors = [0.0f64; 4];
    let mut raise = |k: usize, found: f64, wanted: f64| errors[k] = errors[k].max((found - wanted).abs());
    for (row, &frame) in expected["frames"].iter().enumerate() {
        assert!((scene.source().info().times[frame as usize] - expected["times"][row]).abs() < 1e-9);
        let state = state(scene.source(), frame as usize);
        for i in 0..count {
            for c in 0..3 {
                raise(0, state.position.plane(c)[i].into(), expected["xyz"][3 * (row * count + i) + c]);
            }
            let opacity = 1.0 / (1.0 + (-f64::from(state.opacity_logit.plane(0)[i])).exp());
            raise(1, opacity, expected["opacity"][row * count + i]);
            let wanted = &expected["cov"][6 * i..][..6];
            let most = wanted.iter().fold(0.0f64, |most, x| most.max(x.abs()));
            let found = covariance(&state, i);
            (0..6).for_each(|c| raise(2, found[c] / most, wanted[c] / most));
            if let Some(harmonics) = expected.get(&format!("sh_t{frame}")) {
                (0..48).for_each(|c| raise(3, state.sh.plane(c)[i].into(), harmonics[48 * i + c]));
            }
        }
    }
    println!(
        "position {:e}, opacity {:e}, covariance {:e}, harmonics {:e}",
        errors[0], errors[1], errors[2], errors[3]
    );
    assert!(errors[0] <= 2e-6 && errors[1] <= 5e-7 && errors[2] <= 5e-6 && errors[3] <= 1e-6, "{errors:?}");
}

/// Returns the covariance R diag(s)² Rᵀ of Gaussian `i` as xx, xy, xz, yy, yz, zz.
fn covariance(state: &Gaussians, i: usize) -> [f64; 6] {
    let q = state.rotation_f64(i);
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    let [w, x, y, z] = q.map(|x| x / length);
    let s = state.scales_f64(i);
    let rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let entry = |i: usize, j: usize| (0..3).map(|k| rows[i][k] * rows[j][k] * s[k] * s[k]).sum();
    [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)]
}

#[test]
#[ignore = "needs the trained models"]
fn free_time_gs_states_match_their_trainer() {
    let model = model_path("ftgs");
    let scene = open(&model, &shared("deform2"));
    let expected = arrays(&model.join("states.npz"));
    let mut errors = StateErrors::default();
    for (row, &frame) in expected["frames"].iter().enumerate() {
        let state = state(scene.source(), frame as usize);
        // Colors do not change and are not recorded.
        let color = |i: usize, c: usize| 0.5 + SH_C0 * f64::from(state.sh.plane(c)[i]);
        let colors: Vec<f64> = (0..state.len()).flat_map(|i| [0, 1, 2].map(|c| color(i, c))).collect();
        errors.add(&state, |name, width| match name {
            COLOR_KEY => &colors,
            "xyz" | "opacity" => &expected[name][row * width * state.len()..][..width * state.len()],
            _ => &expected[name],
        });
    }
    assert!(errors.is_within_f32_tolerance(), "{errors:?}");
}

#[test]
#[ignore = "needs the trained models"]
fn every_command_accepts_checkpoints() {
    let workplace = Workplace::new();
    let ftgs = [model_path("ftgs"), shared("deform2")].map(|path| path.display().to_string());
    let yang4d = [model_path("yang4d"), model_path("yang4d")].map(|path| path.display().to_string());
    for ([model, cameras], said) in [(yang4d, " --time-duration 0,2"), (ftgs, "")] {
        for ratio in [0.4, 0.2] {
            let [pruned, default] = [("pruned", "--prune-only"), ("merged", "")].map(|(name, options)| {
                let options = format!("-o {name} --ratio {ratio} {options} --overwrite{said}");
                workplace.summary(&format!("{model} --cameras {cameras} {options}"));
                let found = workplace.done(&format!("evaluate {model} {name} --cameras {cameras} --json{said}"));
                let found: serde_json::Value = serde_json::from_str(&found).unwrap();
                found["psnr"].as_f64().unwrap()
            });
            println!("{model} {ratio}: {pruned} dB pruned, {default} default");
            assert!(default >= pruned, "{model} {ratio}: {pruned} {default}");
        }
        let done = |line: &str| workplace.done(&format!("{line} --cameras {cameras} --overwrite{said}"));
        done(&format!("compress {model} -o merged --merge-only --preset strong --no-refine"));
        done(&format!("convert {model} packed.gseq"));
        done(&format!("score {model} -o rows.csv"));
        done(&format!("render {model} --frame 3 --view 1 -o render.png"));
        done(&format!("report {model} merged -o page"));
    }
}

#[test]
#[ignore = "needs the trained models"]
fn every_command_accepts_models_of_control_nodes() {
    check_every_command(&[("scgs", "deform2", "SC-GS", 1500.0)]);
}

/// Runs every command on models whose network is evaluated for every Gaussian. This takes half an hour without
/// optimization, so this test runs only by name, with `SPLATSIEVE_PROGRAM`.
#[test]
#[ignore = "slow: half an hour unless optimized"]
fn slow_every_command_accepts_deep_networks() {
    check_every_command(&[
        ("deformable3d", "deform2", "Deformable-3D-Gaussians", 4000.0),
        ("deformable3d_6dof", "room2_dynerf", "Deformable-3D-Gaussians", 3000.0),
    ]);
}

/// Runs every command on trained models, each given by the name of the model, the name of the scene with its cameras,
/// the name of its format, and its number of Gaussians.
fn check_every_command(models: &[(&str, &str, &str, f64)]) {
    let workplace = Workplace::new();
    for &(name, scene_name, kind, count) in models {
        let [model, cameras] = [model_path(name), shared(scene_name)].map(|path| path.display().to_string());
        let whole = workplace.done(&format!("info {model}"));
        assert!(whole.contains(kind) && whole.contains(&count.to_string()), "{whole}");
        let psnr = |compressed: &str| {
            let found = workplace.done(&format!("evaluate {model} {compressed} --cameras {cameras} --json"));
            serde_json::from_str::<serde_json::Value>(&found).unwrap()["psnr"].as_f64().unwrap()
        };
        for ratio in [0.4, 0.2] {
            let [pruned, default] =
                [("pruned", "--prune-only --no-refine"), ("merged", "--no-refine")].map(|(result, options)| {
                    let options = format!("-o {result} --ratio {ratio} {options} --overwrite");
                    let summary = workplace.summary(&format!("{model} --cameras {cameras} {options}"));
                    assert_eq!(summary["gaussians"], count * ratio, "{summary}");
                    psnr(result)
                });
            println!("{name}, {ratio}: {pruned} dB pruned, {default} with merging");
            assert!(default >= pruned, "{name}: {pruned} {default}");
        }
        if name == "scgs" {
            workplace.done(&format!("compress {model} --cameras {cameras} -o refined --ratio 0.2"));
            let [pruned, refined] = ["pruned", "refined"].map(psnr);
            assert!(refined > pruned + 1.0, "{pruned} {refined}");
        }
        workplace.done(&format!(
            "compress {model} --cameras {cameras} -o m.gseq --merge-only --preset strong --no-refine --overwrite"
        ));
        workplace.done(&format!("convert {model} p.gseq --cameras {cameras} --overwrite"));
        workplace.done(&format!("score {model} --cameras {cameras} -o rows.csv --overwrite"));
        workplace.done(&format!("render {model} --cameras {cameras} --frame 3 --view 1 -o render.png --overwrite"));
    }
}
