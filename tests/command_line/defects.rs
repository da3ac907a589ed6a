//! Tests of PLY files with defects, from the file to the notes of the commands.

use std::fs;

use crate::scene::{PlyRows, Workplace, index_map};
use crate::stills::scattered;
use serde_json::Value;

/// Number of Gaussians of the test files. One Gaussian is half a percent.
const COUNT: usize = 200;

/// Returns the notes that `info --json` prints about `input`.
fn info_notes(workplace: &Workplace, input: &str) -> String {
    let info: Value = serde_json::from_str(&workplace.done(&format!("info {input} --json"))).unwrap();
    info["notes"].to_string()
}

fn assert_said(text: &str, parts: &[&str]) {
    parts.iter().for_each(|part| assert!(text.contains(part), "{part:?} is not in {text}"));
}

#[test]
fn one_percent_of_nonfinite_rows_is_left_out_and_reported() {
    let workplace = Workplace::new();
    let mut odd = scattered(COUNT);
    odd.position.plane_mut(1)[7] = f32::NAN;
    odd.sh.plane_mut(4)[9] = f32::INFINITY;
    workplace.ply("odd.ply", &odd);
    assert_said(&info_notes(&workplace, "odd.ply"), &["2 of 200 rows (1.00%) have NaN or infinity", "rows 7, 9"]);
    let summary = workplace.summary("odd.ply -o small.ply --count 100 --no-refine --prune-only");
    let notes = summary["notes"].to_string();
    assert_said(&notes, &["2 of 200 Gaussians (1.00%) left out: NaN or infinity", "Gaussian 7, 9"]);
    assert_eq!((&summary["gaussians"], &summary["flags"]["non_finite"]), (&100.into(), &2.into()));
    let map = index_map(&workplace.path("small.ply.index_map.npy"));
    assert_eq!((map[7], map[9]), (-1, -1));
    // The result is that of the other rows alone, and is the same with each parameter that drops them.
    workplace.done("compress odd.ply -o drop.ply --count 100 --no-refine --prune-only --set non_finite=drop");
    let [a, b] = ["small.ply", "drop.ply"].map(|name| fs::read(workplace.path(name)).unwrap());
    assert!(a == b);
    workplace.refused(1, "compress odd.ply -o x.ply --set non_finite=error", &["Gaussian 7, 9", "2 of 200"]);
}

#[test]
fn more_nonfinite_rows_are_refused_with_the_way_out() {
    let workplace = Workplace::new();
    let mut odd = scattered(COUNT);
    (20..23).for_each(|row| odd.log_scale.plane_mut(2)[row] = f32::NAN);
    workplace.ply("odd.ply", &odd);
    let parts = ["odd.ply", "Gaussian 20, 21, 22", "3 of 200", "at most 1%", "--set non_finite=drop"];
    workplace.refused(1, "compress odd.ply -o x.ply", &parts);
    let summary = workplace.summary("odd.ply -o x.ply --set non_finite=drop --no-refine --count 50 --prune-only");
    assert_said(&summary["notes"].to_string(), &["3 of 200 Gaussians (1.50%) left out"]);
}

#[test]
fn zero_quaternions_are_the_identity_and_counted() {
    let workplace = Workplace::new();
    let mut odd = scattered(COUNT);
    [3, 50].iter().for_each(|&row| odd.rotation.set_row(row, [0.0; 4]));
    workplace.ply("odd.ply", &odd);
    [3, 50].iter().for_each(|&row| odd.rotation.set_row(row, [1.0, 0.0, 0.0, 0.0]));
    workplace.ply("identity.ply", &odd);
    let note = "2 of 200 rows (1.00%) repaired: zero quaternion; taken as the identity, as 3DGS does (rows 3, 50)";
    assert_said(&info_notes(&workplace, "odd.ply"), &[note]);
    let same: Value = serde_json::from_str(&workplace.done("evaluate odd.ply identity.ply --json")).unwrap();
    assert_eq!(same["psnr"], 100.0, "{}", same["psnr"]);
    let summary = workplace.summary("odd.ply -o small.ply --count 100 --no-refine --prune-only");
    assert_eq!(summary["flags"]["zero_rotation"], 2);
    assert_said(&summary["notes"].to_string(), &[note]);
}

#[test]
fn infinite_opacity_logits_are_clamped_and_counted() {
    let workplace = Workplace::new();
    let write = |name: &str, logit: f32| {
        let mut odd = scattered(COUNT);
        (odd.opacity_logit.plane_mut(0)[4], odd.opacity_logit.plane_mut(0)[5]) = (logit, -logit);
        workplace.ply(name, &odd);
    };
    write("odd.ply", f32::INFINITY);
    write("clamped.ply", 100.0);
    let note = "2 of 200 rows (1.00%) repaired: infinite opacity logit; read as ±100";
    assert_said(&info_notes(&workplace, "odd.ply"), &[note, "(rows 4, 5)"]);
    assert!(!info_notes(&workplace, "clamped.ply").contains("repaired"));
    let how = "--count 100 --no-refine";
    let summary = workplace.summary(&format!("odd.ply -o odd.sog {how}"));
    assert_said(&summary["notes"].to_string(), &[note]);
    assert_eq!(summary["flags"]["infinite_logit"], 2);
    workplace.done(&format!("compress clamped.ply -o clamped.sog {how}"));
    let [a, b] = ["odd.sog", "clamped.sog"].map(|name| fs::read(workplace.path(name)).unwrap());
    assert!(a == b);
}

#[test]
fn defects_of_every_frame_of_a_sequence_are_counted() {
    let workplace = Workplace::new();
    for frame in 0..3 {
        let mut odd = scattered(COUNT);
        odd.position.plane_mut(2).iter_mut().for_each(|z| *z += 0.01 * frame as f32);
        odd.rotation.set_row(10 + frame, [0.0; 4]);
        odd.opacity_logit.plane_mut(0)[20 + frame] = f32::INFINITY;
        if frame == 2 {
            odd.position.plane_mut(0)[30] = f32::NAN;
        }
        workplace.ply(&format!("frames/f_{frame}.ply"), &odd);
    }
    let summary = workplace.summary("frames -o small --no-refine --prune-only --link never --set scan_frames=all");
    let flags = &summary["flags"];
    let found = ["zero_rotation", "infinite_logit", "non_finite"].map(|name| flags[name].as_u64().unwrap());
    assert_eq!(found, [3, 3, 1], "{flags}");
    assert_said(
        &summary["notes"].to_string(),
        &[
            "3 Gaussians with a zero quaternion",
            "3 Gaussians with an opacity logit of ±100",
            "1 of 200 Gaussians (0.50%)",
        ],
    );
}

#[test]
fn sh_coefficients_of_degree_4_are_left_out_and_reported() {
    let workplace = Workplace::new();
    let path = workplace.ply("plain.ply", &scattered(COUNT));
    let plain = PlyRows::read(&path);
    let mut header = format!("ply\nformat ascii 1.0\nelement vertex {COUNT}\n");
    let names: Vec<&String> = plain.names.iter().filter(|name| !name.starts_with("f_rest_")).collect();
    names.iter().for_each(|name| header += &format!("property float {name}\n"));
    (0..72).for_each(|k| header += &format!("property float f_rest_{k}\n"));
    let mut text = header + "end_header\n";
    for row in 0..COUNT {
        let own = names.iter().map(|name| plain.value(row, name).to_string());
        let rest = (0..72).map(|k| (k as f32 / 100.0).to_string());
        text += &(own.chain(rest).collect::<Vec<_>>().join(" ") + "\n");
    }
    fs::write(workplace.path("four.ply"), text).unwrap();
    assert_said(&info_notes(&workplace, "four.ply"), &["left out of the PLY: SH coefficients of degree 4"]);
    workplace.done("compress four.ply -o small.ply --count 20 --no-refine --prune-only");
    workplace.done("convert four.ply four.gsz");
    workplace.done("convert four.gsz back.ply");
    for name in ["small.ply", "back.ply"] {
        let found = PlyRows::read(&workplace.path(name));
        assert_eq!(found.names.iter().filter(|name| name.starts_with("f_rest_")).count(), 45, "{name}");
        // Red has the coefficients 0 to 23 of the file, of which 15 are up to degree 3; green begins at 24.
        for (property, expected) in [("f_rest_14", 0.14), ("f_rest_15", 0.24), ("f_rest_44", 0.62)] {
            let value = found.value(0, property);
            assert!((value - expected).abs() < 0.01, "{name}, {property}: {value}, expected {expected}");
        }
    }
}

#[test]
fn elements_with_lists_after_the_gaussians_are_left_out() {
    let workplace = Workplace::new();
    let path = workplace.ply("plain.ply", &scattered(COUNT));
    let plain = fs::read(&path).unwrap();
    let end = plain.windows(11).position(|part| part == b"end_header\n").unwrap();
    let list = b"element face 1\nproperty list uchar int vertex_indices\n";
    let body = [&plain[..end], list, &plain[end..], &[1, 0, 0, 0, 0]].concat();
    fs::write(workplace.path("mesh.ply"), body).unwrap();
    assert_said(&info_notes(&workplace, "mesh.ply"), &["left out of the PLY: element face"]);
    for name in ["plain", "mesh"] {
        workplace.done(&format!("compress {name}.ply -o {name}.small.ply --count 50 --no-refine"));
    }
    let [a, b] = ["plain.small.ply", "mesh.small.ply"].map(|name| fs::read(workplace.path(name)).unwrap());
    assert!(a == b);
}

#[test]
fn point_clouds_are_refused_by_name_with_the_way_out() {
    let workplace = Workplace::new();
    let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nproperty \
                uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 0 1 2 3\n";
    fs::write(workplace.path("points3D.ply"), text).unwrap();
    let parts = ["points3D.ply", "looks like a point cloud", "train a model from it", "point_cloud.ply"];
    workplace.refused(1, "compress points3D.ply -o x.ply", &parts);
}
