//! Models of other families: their states against those that the families' own code gives, and what is left of them, read
//! back.

mod scene;

use std::path::{Path, PathBuf};

use scene::{Workplace, arrays, shared, state};
use splatsieve::model::{Gaussians, SH_C0, Split};
use splatsieve::scene::{InputOptions, Scene, open_scene};

fn family(name: &str) -> PathBuf {
    shared("families").join(name)
}

fn open(model: &Path, cameras: &Path) -> Scene {
    let options = InputOptions { path: model.to_owned(), cameras: Some(cameras.to_owned()), ..InputOptions::default() };
    open_scene(&options).unwrap()
}

/// Largest differences of what a renderer reads, of all Gaussians at all recorded frames.
#[derive(Debug, Default)]
struct Off {
    position: f64,
    rotation: f64,
    /// Relative.
    scale: f64,
    opacity: f64,
    colour: f64,
}

impl Off {
    fn of(scene: &Scene, model: &Path) -> Off {
        let expected = arrays(&model.join("states.npz"));
        let source = scene.source();
        let mut off = Off::default();
        for (row, &frame) in expected["frames"].iter().enumerate() {
            let state = state(source, frame as usize);
            off.add(&state, |name, width| {
                let all = &expected[name];
                let rows = state.len() * width;
                // What does not change with time is there once.
                let at = if all.len() == rows { 0 } else { row * rows };
                &all[at..at + rows]
            });
        }
        off
    }

    fn add<'a>(&mut self, state: &Gaussians, expected: impl Fn(&'static str, usize) -> &'a [f64]) {
        let [xyz, rotation, scales] =
            [("xyz", 3), ("rotation", 4), ("scales", 3)].map(|(name, width)| expected(name, width));
        let (opacity, colour) = (expected("opacity", 1), expected("colour", 3));
        let raise = |most: &mut f64, found: f64, wanted: f64| *most = most.max((found - wanted).abs());
        for i in 0..state.len() {
            let q = state.rotation.row::<4>(i).map(f64::from);
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            for c in 0..4 {
                raise(&mut self.rotation, q[c] / length, rotation[4 * i + c]);
            }
            for c in 0..3 {
                raise(&mut self.position, f64::from(state.position.plane(c)[i]), xyz[3 * i + c]);
                raise(&mut self.scale, f64::from(state.log_scale.plane(c)[i]).exp() / scales[3 * i + c], 1.0);
                raise(&mut self.colour, 0.5 + SH_C0 * f64::from(state.sh.plane(c)[i]), colour[3 * i + c]);
            }
            raise(&mut self.opacity, 1.0 / (1.0 + (-f64::from(state.opacity_logit.plane(0)[i])).exp()), opacity[i]);
        }
    }

    /// Tolerances that are fair in f32.
    fn is_small(&self) -> bool {
        self.position <= 2e-6
            && self.rotation <= 5e-7
            && self.scale <= 1e-6
            && self.opacity <= 5e-7
            && self.colour <= 1e-6
    }
}

#[test]
#[ignore = "needs the trained models"]
fn states_of_dynamic_3d_gaussians_are_those_of_its_own_code() {
    let model = family("d3dg");
    let [own, other] = ["train_meta.json", "transforms_train.json"].map(|name| open(&model, &model.join(name)));
    for scene in [&own, &other] {
        let off = Off::of(scene, &model);
        assert!(off.is_small(), "{off:?}");
    }
    // The cameras of its own files are those of the others.
    let train = |scene: &Scene| -> Vec<_> {
        scene.rig.shots.iter().filter(|shot| shot.split == Split::Train).cloned().collect()
    };
    let [of_own, of_other] = [train(&own), train(&other)];
    assert_eq!(of_own.len(), of_other.len());
    for (a, b) in of_own.iter().zip(&of_other) {
        let [a, b] = [&own.rig.cameras[a.camera as usize], &other.rig.cameras[b.camera as usize]];
        assert!((a.rotation - b.rotation).to_cols_array().iter().all(|x| x.abs() < 1e-8));
        assert!((a.translation - b.translation).length() < 1e-8 && (a.fx - b.fx).abs() < 1e-6 && a.cx == b.cx);
    }
}

/// PSNR of `compressed` against `original`, dB.
fn psnr(place: &Workplace, original: &str, compressed: &str) -> f64 {
    let found = place.done(&format!("evaluate {original} {compressed} --cameras {original} --json"));
    let found: serde_json::Value = serde_json::from_str(&found).unwrap();
    found["psnr"].as_f64().unwrap()
}

#[test]
#[ignore = "needs the trained models"]
fn dynamic_3d_gaussians_go_through_every_verb() {
    let place = Workplace::new();
    let model = family("d3dg").display().to_string();
    let whole = place.done(&format!("info {model}"));
    assert!(whole.contains("Dynamic3DGaussians") && whole.contains("2000"), "{whole}");
    for ratio in [0.4, 0.2] {
        let [pruned, default, refined] =
            [("pruned", "--prune-only --no-refine"), ("merged", "--no-refine"), ("refined", "")].map(
                |(name, options)| {
                    let options = format!("-o {name} --target-ratio {ratio} {options} --force");
                    let summary = place.summary(&format!("{model} --cameras {model} {options}"));
                    assert_eq!(summary["gaussians"], 2000.0 * ratio, "{summary}");
                    psnr(&place, &model, name)
                },
            );
        println!("{ratio}: {pruned} dB pruned, {default} with merging, {refined} refined");
        assert!(default >= pruned && refined > pruned + 1.0, "{pruned} {default} {refined}");
    }
    place.done(&format!("compress {model} --cameras {model} -o merged.gseq --merge-only --preset strong --no-refine"));
    place.done(&format!("pack {model} -o packed.gseq"));
    place.done(&format!("score {model} --cameras {model} -o rows.csv"));
    place.done(&format!("render {model} --cameras {model} --frame 3 --view 1 -o picture.png"));
}
