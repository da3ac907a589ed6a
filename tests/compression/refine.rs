//! Refining as a user sees it: every kind of input comes closer to the original, and what is to stay stays.

use std::path::Path;

use crate::scene::{PlyRows, Workplace, files, index_map, tiny};

/// Mean PSNR of `result` against `original` as `cameras` hold out.
fn quality(workplace: &Workplace, original: &str, result: &str, cameras: &str) -> f64 {
    let told = workplace.done(&format!("evaluate {original} {result} --cameras {cameras} --json"));
    serde_json::from_str::<serde_json::Value>(&told).unwrap()["psnr"].as_f64().unwrap()
}

#[test]
#[ignore = "needs time"]
fn every_kind_of_input_comes_closer_to_the_original_at_the_same_count() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 1500 --frames 6 -o demo");
    workplace.done("unpack demo/scene.gseq -o frames");
    let tiny = tiny().display().to_string();
    let first = files(&workplace.path("frames")).into_keys().min().unwrap();
    let first = format!("frames/{}", first.display());
    let demo = "demo/cameras.json";
    for (input, cameras, output, least) in [
        (tiny.as_str(), tiny.as_str(), "model", 3.0),
        ("demo/scene.gseq", demo, "small.gseq", 3.0),
        ("frames", demo, "smaller", 3.0),
        (first.as_str(), demo, "static.ply", 2.0),
    ] {
        let found = ["--no-refine --prune-only", ""].map(|how| {
            workplace.done(&format!(
                "compress {input} --cameras {cameras} --target-ratio 0.2 --refine-steps 600 --overwrite -o {output} {how}"
            ));
            quality(&workplace, input, output, cameras)
        });
        assert!(found[1] > found[0] + least, "{input}: {found:?} dB");
    }
}

#[test]
fn a_static_model_without_cameras_is_refined_by_virtual_ones() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 1200 --frames 2 -o demo");
    workplace.done("unpack demo/scene.gseq -o frames");
    let first = files(&workplace.path("frames")).into_keys().min().unwrap();
    let first = format!("frames/{}", first.display());
    let found = ["--no-refine --prune-only", ""].map(|how| {
        let summary =
            workplace.summary(&format!("{first} --target-ratio 0.3 --refine-steps 150 --overwrite -o small.ply {how}"));
        assert_eq!(summary["gaussians"], 360);
        quality(&workplace, &first, "small.ply", "demo/cameras.json")
    });
    assert!(found[1] > found[0] + 1.0, "{found:?} dB");
}

#[test]
#[ignore = "needs time"]
fn who_asks_for_similarity_gets_it_for_decibels() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 1500 --frames 6 -o demo");
    let found = ["0", "0.5"].map(|part| {
        workplace.done(&format!(
            "compress demo/scene.gseq --cameras demo/cameras.json --target-ratio 0.1 --refine-steps 600 \
             --refine-ssim {part} --overwrite -o small.gseq"
        ));
        let told = workplace.done("evaluate demo/scene.gseq small.gseq --cameras demo/cameras.json --json");
        let told: serde_json::Value = serde_json::from_str(&told).unwrap();
        ["psnr", "ssim"].map(|name| told[name].as_f64().unwrap())
    });
    let [[decibels, similarity], [fewer, more]] = found;
    assert!(more > similarity + 0.005 && fewer > decibels - 1.0, "without and with: {found:?}");
}

#[test]
fn only_what_is_named_moves_and_nothing_of_what_is_protected() {
    let workplace = Workplace::new();
    let cloud = |root: &Path| {
        let name = files(root).into_keys().find(|name| name.ends_with("point_cloud.ply")).unwrap();
        PlyRows::read(&root.join(name))
    };
    let before = cloud(&tiny());
    for (groups, mut moves) in [
        ("colour,opacity,scale,rotation,position", vec!["f_dc_0", "f_rest_3", "opacity", "scale_1", "rot_2", "x"]),
        ("scale", vec!["scale_1"]),
        ("colour,position", vec!["f_dc_0", "f_rest_3", "x"]),
    ] {
        workplace.done(&format!(
            "compress {{tiny}} --cameras {{tiny}} --target-ratio 0.3 --refine {groups} --keep-ids 3,200-209 \
             --refine-steps 200 --refine-cut-steps 20 --overwrite -o out"
        ));
        let after = cloud(&workplace.path("out"));
        let map = index_map(&workplace.path("out/index_map.npy"));
        let kept: Vec<(usize, usize)> =
            (0..map.len()).filter(|&id| map[id] >= 0).map(|id| (id, map[id] as usize)).collect();
        let is_protected = |id: usize| id == 3 || (200..210).contains(&id);
        assert_eq!(kept.iter().filter(|(id, _)| is_protected(*id)).count(), 11);
        for &(id, place) in kept.iter().filter(|(id, _)| is_protected(*id)) {
            assert!(after.rows[place] == before.rows[id], "{groups}: Gaussian {id} moved");
        }
        for name in ["f_dc_0", "f_rest_3", "opacity", "scale_1", "rot_2", "x"] {
            let moved = kept.iter().any(|&(id, place)| after.value(place, name) != before.value(id, name));
            assert_eq!(moved, moves.contains(&name), "{groups}: {name}");
            moves.retain(|other| *other != name);
        }
        assert!(moves.is_empty());
    }
}
