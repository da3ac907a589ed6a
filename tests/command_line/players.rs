//! Tests with readers and writers of other programs: splat-transform of PlayCanvas, the loaders of three.js, the spz
//! library and fourdgs. They open files of this program, and this program opens theirs. `SPLATSIEVE_NODE_MODULES` names
//! the folder `node_modules` with the first three, `SPLATSIEVE_FOURDGS` a Python with the last.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use glam::{DMat3, DQuat, DVec3};
use serde_json::Value;
use splatsieve::model::{AttributeValues, Attributes, Gaussians, color_from_sh, opacity};
use splatsieve::models::{OpenOptions, open};
use splatsieve::passes::gather_all;

use crate::scene::Workplace;

/// Number of Gaussians in the test files.
const COUNT: usize = 60;

/// Returns 60 Gaussians of SH degree `degree` without any symmetry: each axis has another range of positions and other
/// scales, and every SH coefficient is different.
pub(crate) fn asymmetrical(degree: usize) -> Gaussians {
    let mut made = Gaussians::zeros(COUNT, degree);
    let fill = |values: &mut [f32], seed: usize, middle: f32, width: f32| {
        values.iter_mut().enumerate().for_each(|(k, x)| {
            *x = middle + width * (((k + 31 * seed) as f32 * 0.618_034).fract() - 0.5);
        });
    };
    for (axis, (middle, width)) in [(5.0, 2.0), (-1.0, 4.0), (0.5, 9.0)].into_iter().enumerate() {
        fill(made.position.plane_mut(axis), axis, middle, width);
        fill(made.log_scale.plane_mut(axis), 3 + axis, -1.5 - axis as f32, 0.5);
    }
    for (k, middle) in [0.7, 0.2, -0.4, 0.5].into_iter().enumerate() {
        fill(made.rotation.plane_mut(k), 7 + k, middle, 0.3);
    }
    fill(made.opacity_logit.plane_mut(0), 11, 1.0, 3.0);
    for plane in 0..made.sh.width() {
        fill(made.sh.plane_mut(plane), 20 + plane, 0.1 * (plane % 9) as f32 - 0.4, 0.6);
    }
    made
}

/// Returns the folder `node_modules` with the packages of other programs, which `SPLATSIEVE_NODE_MODULES` names.
pub(crate) fn modules() -> PathBuf {
    let folder = std::env::var_os("SPLATSIEVE_NODE_MODULES").expect("SPLATSIEVE_NODE_MODULES names a node_modules");
    PathBuf::from(folder)
}

/// Converts the file `from` to `to` with the program splat-transform and its command-line options `options`.
fn splat_transform(workplace: &Workplace, from: &str, to: &str, options: &[&str]) {
    let program = modules().join("@playcanvas/splat-transform/bin/cli.mjs");
    let mut node = Command::new("node");
    node.arg(program).args(["-w", "-q"]).args(options).args([from, to]).current_dir(workplace.path(""));
    let output = node.output().expect("node");
    assert!(output.status.success(), "{from} to {to}: {}", String::from_utf8_lossy(&output.stderr));
}

fn read(path: &Path) -> Gaussians {
    gather_all(open(path, &OpenOptions::default()).unwrap().into_linked().unwrap().source(), 0, Attributes::all())
        .unwrap()
}

/// Returns the Gaussians sorted by their x coordinates, so that two files with other orders can be compared.
fn sorted(gaussians: &Gaussians) -> Gaussians {
    let mut rows: Vec<u32> = (0..gaussians.len() as u32).collect();
    let x = gaussians.position.plane(0);
    rows.sort_by(|&a, &b| x[a as usize].total_cmp(&x[b as usize]));
    gaussians.pick(&rows)
}

/// Maximum allowed differences between the Gaussians that two programs read from a file, or between a file and its
/// original.
struct Steps {
    position: f64,
    log_scale: f64,
    sh: f64,
}

/// Checks that `found` and `expected` have the same Gaussians in any order, within the differences `steps` and, for
/// colors and opacities, 1/255. `what` names the case in failures.
fn assert_near(found: &Gaussians, expected: &Gaussians, steps: &Steps, what: &str) {
    assert_eq!((found.len(), found.sh_degree()), (expected.len(), expected.sh_degree()), "{what}");
    let [found, expected] = [found, expected].map(sorted);
    let near = |a: &AttributeValues, b: &AttributeValues, most: f64, name: &str| {
        for (i, (a, b)) in a.planes().iter().zip(b.planes()).enumerate() {
            assert!(f64::from((a - b).abs()) <= most, "{what}: {name} {i} is {a}, expected {b} ± {most}");
        }
    };
    near(&found.position, &expected.position, steps.position, "position");
    near(&found.log_scale, &expected.log_scale, steps.log_scale, "log scale");
    near(&found.sh, &expected.sh, steps.sh, "SH coefficient");
    for i in 0..found.len() {
        let [a, b] = [&found, &expected].map(|state| state.sh.row::<3>(i).map(color_from_sh));
        assert!(
            a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1.0 / 255.0),
            "{what}: color {i} is {a:?}, expected {b:?}"
        );
        let [a, b] = [&found, &expected].map(|state| opacity(state.opacity_logit.row::<1>(i)[0]));
        assert!((a - b).abs() <= 1.0 / 255.0, "{what}: opacity {i} is {a}, expected {b}");
        let [a, b] = [&found, &expected].map(|state| quaternion(state, i));
        // A turn by 180° about an axis of the Gaussian itself changes nothing.
        let difference = (a.inverse() * b).to_array().map(f64::abs);
        assert!(difference.into_iter().fold(0.0, f64::max) > 0.9999, "{what}: rotation {i} is {a}, expected {b}");
    }
}

/// Returns the rotation of Gaussian `i` as a unit quaternion.
fn quaternion(gaussians: &Gaussians, i: usize) -> DQuat {
    let [w, x, y, z] = gaussians.rotation_f64(i);
    DQuat::from_xyzw(x, y, z, w).normalize()
}

/// Signs by which the SH coefficients above degree 0 are multiplied if the y and z axes are reversed. They follow from
/// the parity of the basis functions.
const REVERSED_YZ: [f32; 15] = [-1., -1., 1., -1., 1., 1., -1., 1., -1., 1., -1., -1., 1., -1., 1.];

/// Returns the Gaussians turned by 180° about the x axis, which reverses the y and z axes: positions, rotations and SH
/// coefficients change.
pub(crate) fn reversed(gaussians: &Gaussians) -> Gaussians {
    let mut turned = gaussians.clone();
    for axis in [1, 2] {
        turned.position.plane_mut(axis).iter_mut().for_each(|x| *x = -*x);
        turned.rotation.plane_mut(axis + 1).iter_mut().for_each(|x| *x = -*x);
    }
    for plane in 3..turned.sh.width() {
        turned.sh.plane_mut(plane).iter_mut().for_each(|x| *x *= REVERSED_YZ[plane / 3 - 1]);
    }
    turned
}

#[test]
#[ignore = "needs splat-transform"]
fn splat_transform_reads_our_files() {
    let workplace = Workplace::new();
    for degree in [0, 1, 3] {
        let original = asymmetrical(degree);
        workplace.ply("in.ply", &original);
        let sog = Steps { position: 4e-4, log_scale: 2.5 / 200.0, sh: 0.02 };
        let spz = Steps { position: 1e-5, log_scale: 0.51 / 16.0, sh: 8.6 / 128.0 };
        for (name, options, steps) in [("a.sog", "", &sog), ("a.spz", "", &spz), ("b.spz", "--spz-version 4", &spz)] {
            workplace.done(&format!("convert in.ply {name} {options} --overwrite"));
            splat_transform(&workplace, name, "out.ply", &[]);
            let read_by_them = read(&workplace.path("out.ply"));
            // splat-transform does not turn the axes of a .spz.
            let expected = if name.ends_with(".spz") { reversed(&original) } else { original.clone() };
            assert_near(&read_by_them, &expected, steps, &format!("{name}, degree {degree}"));
            let read_by_us = read(&workplace.path(name));
            let same = Steps { position: 1e-5, log_scale: 1e-5, sh: 1e-5 };
            let read_by_us = if name.ends_with(".spz") { reversed(&read_by_us) } else { read_by_us };
            assert_near(&read_by_us, &read_by_them, &same, &format!("{name}, degree {degree}, both readers"));
        }
    }
}

#[test]
#[ignore = "needs splat-transform"]
fn files_of_splat_transform_are_read() {
    let workplace = Workplace::new();
    for degree in [0, 1, 3] {
        let original = asymmetrical(degree);
        workplace.ply("in.ply", &original);
        for (name, options, steps) in [
            ("a.compressed.ply", &[][..], Steps { position: 0.01, log_scale: 1e-3, sh: 0.02 }),
            ("a.spz", &["--spz-version", "3"], Steps { position: 5e-4, log_scale: 0.51 / 16.0, sh: 8.6 / 128.0 }),
            ("b.spz", &["--spz-version", "4"], Steps { position: 5e-4, log_scale: 0.51 / 16.0, sh: 8.6 / 128.0 }),
            ("a.glb", &[], Steps { position: 1e-5, log_scale: 1e-5, sh: 1e-5 }),
        ] {
            splat_transform(&workplace, "in.ply", name, options);
            let expected = if name.ends_with(".spz") { reversed(&original) } else { original.clone() };
            assert_near(&read(&workplace.path(name)), &expected, &steps, &format!("{name}, degree {degree}"));
        }
    }
    // Without SH coefficients, splat-transform needs no GPU to write a .sog.
    workplace.ply("in.ply", &asymmetrical(0));
    splat_transform(&workplace, "in.ply", "a.sog", &["-g", "cpu"]);
    let steps = Steps { position: 8e-4, log_scale: 0.03, sh: 0.02 };
    assert_near(&read(&workplace.path("a.sog")), &asymmetrical(0), &steps, "a.sog");
}

#[test]
#[ignore = "needs the spz library"]
fn spz_library_reads_our_files_and_we_read_its_files() {
    let workplace = Workplace::new();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/read_with_spz.mjs");
    for degree in [0, 1, 3] {
        let original = asymmetrical(degree);
        workplace.ply("in.ply", &original);
        for version in [3, 4] {
            workplace.done(&format!("convert in.ply a.spz --spz-version {version} --overwrite"));
            let files = ["a.spz", "out.ply", "b.spz"].map(|name| workplace.path(name));
            let output = Command::new("node").arg(&script).arg(modules()).args(files).output().expect("node");
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            // Half a quantization step of positions is 2^-13; scales have steps of 1/16.
            let steps = Steps { position: 1.3e-4, log_scale: 0.51 / 16.0, sh: 8.6 / 128.0 };
            let what = format!("version {version}, degree {degree}");
            assert_near(&read(&workplace.path("out.ply")), &original, &steps, &format!("{what}, read by the library"));
            let twice = Steps { position: 2.6e-4, log_scale: 0.51 / 16.0, sh: 2.0 * 8.6 / 128.0 };
            assert_near(&read(&workplace.path("b.spz")), &original, &twice, &format!("{what}, written by it"));
        }
    }
}

#[test]
#[ignore = "needs fourdgs"]
fn fourdgs_reads_our_4dgs_files() {
    const FRAMES: usize = 10;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/benchmark/fourdgs_frames.py");
    let python = std::env::var_os("SPLATSIEVE_FOURDGS").expect("SPLATSIEVE_FOURDGS names a Python with fourdgs");
    // Rounding errors: base colors have steps of 1/255, other SH coefficients steps of 8/255.
    for (degree, sh) in [(0, 1.01 / 255.0 / 0.282), (2, 4.1 / 255.0)] {
        let workplace = Workplace::new();
        fs::create_dir(workplace.path("frames")).unwrap();
        let frames: Vec<Gaussians> = (0..FRAMES).map(|frame| moved(&asymmetrical(degree), frame)).collect();
        for (number, frame) in frames.iter().enumerate() {
            workplace.ply(&format!("frames/frame_{number:04}.ply"), frame);
        }
        workplace.done("convert frames a.4dgs");
        let mut command = Command::new(&python);
        command
            .arg(&script)
            .args([workplace.path("a.4dgs"), workplace.path("read")])
            .args(["--frames", &FRAMES.to_string()]);
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        // Pieces of motion may be off by a tenth of the middle scale, which is 0.08 or less.
        let steps = Steps { position: 0.01, log_scale: 0.02, sh };
        for (number, frame) in frames.iter().enumerate() {
            let found = read(&workplace.path(&format!("read/frame_{number:04}.ply")));
            assert_near(&found, frame, &steps, &format!("SH degree {degree}, frame {number}"));
        }
    }
}

/// Returns the Gaussians as they are at the frame number `frame`. Each moves along y and z at a speed of its own, and
/// keeps its x coordinate.
pub(crate) fn moved(gaussians: &Gaussians, frame: usize) -> Gaussians {
    let mut moved = gaussians.clone();
    for axis in [1, 2] {
        let plane = moved.position.plane_mut(axis);
        plane.iter_mut().enumerate().for_each(|(i, x)| *x += 0.01 * frame as f32 * ((i + axis) % 7) as f32);
    }
    moved
}

#[test]
#[ignore = "needs three.js"]
fn three_js_reads_our_files() {
    let workplace = Workplace::new();
    let original = asymmetrical(2);
    workplace.ply("in.ply", &original);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/read_with_three.mjs");
    for (name, options, axes, relative) in [
        ("a.spz", "", DVec3::new(1.0, -1.0, -1.0), 0.07),
        ("b.spz", "--spz-version 4", DVec3::new(1.0, -1.0, -1.0), 0.07),
        ("a.glb", "", DVec3::new(-1.0, -1.0, 1.0), 1e-5),
    ] {
        workplace.done(&format!("convert in.ply {name} {options}"));
        let output = Command::new("node").arg(&script).arg(modules()).arg(workplace.path(name)).output().expect("node");
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
        let found: Value = serde_json::from_slice(&output.stdout).unwrap();
        let values = |key: &str| -> Vec<f64> {
            found[key].as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect()
        };
        let (positions, covariances, colors) = (values("positions"), values("covariances"), values("colors"));
        assert_eq!(positions.len(), 3 * COUNT, "{name}");
        for i in 0..COUNT {
            let expected = DVec3::from_array(original.position_f64(i)) * axes;
            let place = DVec3::from_slice(&positions[3 * i..]);
            assert!((place - expected).abs().max_element() < 1e-4, "{name}, {i}: {place}, expected {expected}");
            let turn = DMat3::from_diagonal(axes) * DMat3::from_quat(quaternion(&original, i));
            let scale = DVec3::from_array(original.scales_f64(i));
            let half = turn * DMat3::from_diagonal(scale);
            let covariance = half * half.transpose();
            let largest = covariance.col(0).x.max(covariance.col(1).y).max(covariance.col(2).z);
            let upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];
            for (k, (row, column)) in upper.into_iter().enumerate() {
                let (a, b) = (covariances[6 * i + k], covariance.col(column)[row]);
                assert!((a - b).abs() <= 2.0 * relative * largest, "{name}, {i}: {a}, expected {b}");
            }
            let rgb = original.sh.row::<3>(i).map(|dc| 255.0 * color_from_sh(dc).clamp(0.0, 1.0));
            // Half a step of a .spz is 0.94, and the loader rounds down to bytes.
            for c in 0..3 {
                assert!(
                    (colors[4 * i + c] - rgb[c]).abs() <= 1.95,
                    "{name}, {i}: {:?}, {rgb:?}",
                    &colors[4 * i..][..4]
                );
            }
            let alpha = 255.0 * opacity(original.opacity_logit.row::<1>(i)[0]);
            assert!((colors[4 * i + 3] - alpha).abs() <= 1.01, "{name}, {i}: opacity {}", colors[4 * i + 3]);
        }
    }
}
