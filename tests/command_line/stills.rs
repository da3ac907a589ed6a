//! Tests of files of web viewers that hold one frame: `.sog`, `.spz`, `.splat`, `.compressed.ply`.

use std::fs;

use crate::scene::{Workplace, files, index_map};
use serde_json::Value;
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::models::{OpenOptions, open};
use splatsieve::passes::gather_all;

/// Returns `count` Gaussians without any symmetry, of SH degree 1.
pub(crate) fn scattered(count: usize) -> Gaussians {
    let mut made = Gaussians::zeros(count, 1);
    let fill = |values: &mut [f32], middle: f32, width: f32| {
        values.iter_mut().enumerate().for_each(|(k, x)| *x = middle + width * ((k as f32 * 0.618_034).fract() - 0.5));
    };
    fill(made.position.plane_mut(0), 5.0, 2.0);
    fill(made.position.plane_mut(1), -1.0, 4.0);
    fill(made.position.plane_mut(2), 0.5, 1.0);
    fill(made.rotation.planes_mut(), 0.1, 1.0);
    fill(made.log_scale.planes_mut(), -3.0, 1.0);
    fill(made.opacity_logit.planes_mut(), 1.0, 3.0);
    fill(made.sh.planes_mut(), 0.1, 1.0);
    made
}

/// Writes 40 Gaussians without any symmetry to the PLY file `name`, and returns them.
fn write_ply(workplace: &Workplace, name: &str) -> Gaussians {
    let made = scattered(40);
    workplace.ply(name, &made);
    made
}

fn psnr(workplace: &Workplace, line: &str) -> f64 {
    let found: Value = serde_json::from_str(&workplace.done(&format!("evaluate {line} --json"))).unwrap();
    found["psnr"].as_f64().unwrap()
}

#[test]
fn a_still_is_written_read_and_compressed_as_sog() {
    let workplace = Workplace::new();
    write_ply(&workplace, "still.ply");
    let said = workplace.done("convert still.ply still.sog");
    assert!(said.contains("40 Gaussians"), "{said}");
    let info: Value = serde_json::from_str(&workplace.done("info still.sog --json")).unwrap();
    assert_eq!((&info["kind"], &info["gaussians"]), (&"SOG frames".into(), &40.into()), "{info}");
    assert!(psnr(&workplace, "still.ply still.sog") > 35.0);
    let options = "--count 20 --no-refine --prune-only";
    for input in ["still.ply", "still.sog"] {
        for output in ["small.sog", "small.spz"] {
            let summary = workplace.summary(&format!("{input} -o {output} {options} --overwrite"));
            assert_eq!(summary["gaussians"], 20, "{input}");
            let quality = &summary["quality"];
            assert!(quality["psnr"].is_f64() && quality["before_conversion"].is_null(), "{output}: {quality}");
        }
    }
    workplace.done("convert small.sog back.ply");
    workplace.done(&format!("compress small.sog -o small.gsz --count 15 {}", "--no-refine --prune-only"));
}

#[test]
fn the_index_map_follows_the_order_of_a_sog() {
    let workplace = Workplace::new();
    let made = write_ply(&workplace, "still.ply");
    workplace.done("compress still.ply -o small.sog --count 20 --no-refine --prune-only --quiet");
    let found = open(&workplace.path("small.sog"), &OpenOptions::default()).unwrap().into_linked().unwrap();
    let found = gather_all(found.source(), 0, Attributes::POSITION).unwrap();
    let map = index_map(&workplace.path("small.sog.index_map.npy"));
    assert_eq!(map.iter().filter(|place| **place >= 0).count(), 20);
    for (id, &place) in map.iter().enumerate().filter(|(_, place)| **place >= 0) {
        let [a, b] = [found.position.row::<3>(place as usize), made.position.row::<3>(id)];
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3), "Gaussian {id}: {a:?}, expected {b:?}");
    }
}

#[test]
fn a_sequence_becomes_a_folder_of_numbered_sog_files() {
    let workplace = Workplace::new();
    workplace.refused(2, "convert {tiny} a.sog --cameras {tiny}", &["a.sog", "10 frames", "--as sog-sequence"]);
    workplace.done("convert {tiny} book --cameras {tiny} --as sog-sequence");
    let names: Vec<String> = files(&workplace.path("book")).keys().map(|name| name.display().to_string()).collect();
    let frames: Vec<&String> = names.iter().filter(|name| name.ends_with(".sog")).collect();
    assert_eq!((frames.len(), frames[0].as_str(), frames[9].as_str()), (10, "frame_0000.sog", "frame_0009.sog"));
    assert!(psnr(&workplace, "{tiny} book --cameras {tiny}") > 30.0);
    let summary = workplace.summary("{tiny} -o small --as sog-sequence --cameras {tiny} --ratio 0.5 --no-refine");
    assert_eq!(summary["gaussians"], 150);
    assert!(workplace.done("info small --json").contains("SOG frames"));
}

#[test]
fn attributes_survive_every_format_within_a_step() {
    let workplace = Workplace::new();
    let made = write_ply(&workplace, "still.ply");
    let mut places: Vec<[f32; 3]> = (0..made.len()).map(|i| made.position.row(i)).collect();
    places.sort_by(|a, b| a[0].total_cmp(&b[0]));
    for name in ["a.sog", "a.spz"] {
        workplace.done(&format!("convert still.ply {name}"));
        let found = open(&workplace.path(name), &OpenOptions::default()).unwrap().into_linked().unwrap();
        let found = gather_all(found.source(), 0, Attributes::all()).unwrap();
        let mut read: Vec<[f32; 3]> = (0..found.len()).map(|i| found.position.row(i)).collect();
        read.sort_by(|a, b| a[0].total_cmp(&b[0]));
        for (a, b) in read.iter().zip(&places) {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4), "{name}: {a:?}, expected {b:?}");
        }
    }
}

#[test]
fn still_is_seen_by_every_camera_whatever_its_times() {
    let workplace = Workplace::new();
    write_ply(&workplace, "still.ply");
    workplace.done("convert still.ply still.gseq");
    for input in ["still.ply", "still.gseq"] {
        // Ten frames of four training cameras each, which do not move.
        let summary =
            workplace.summary(&format!("{input} --cameras {{tiny}} -o small.ply --count 20 --no-refine --overwrite"));
        assert_eq!((&summary["cameras"]["pairs"], &summary["gaussians"]), (&4.into(), &20.into()), "{input}");
        assert!(summary["notes"].to_string().contains("whose times are ignored"), "{input}: {}", summary["notes"]);
        workplace.done(&format!("evaluate {input} small.ply --cameras {{tiny}}"));
    }
}

#[test]
fn frames_of_other_players_are_read_from_a_folder() {
    let workplace = Workplace::new();
    for frame in 0..3 {
        write_ply(&workplace, "still.ply");
        fs::create_dir_all(workplace.path("frames")).unwrap();
        workplace.done(&format!("convert still.ply frames/f_{frame}.spz"));
    }
    let said = workplace.done("info frames");
    assert!(said.contains("SPZ frames") && said.contains('3'), "{said}");
    fs::remove_file(workplace.path("frames/f_1.spz")).unwrap();
    workplace.done("convert frames/f_0.spz frames/f_5.spz");
    workplace.refused(1, "info frames", &["--allow-gaps"]);
    assert!(workplace.done("info frames --allow-gaps").contains("SPZ frames"));
}

#[test]
fn one_frame_of_a_model_is_the_same_in_a_ply_and_a_glb() {
    let workplace = Workplace::new();
    for name in ["frame.ply", "frame.glb"] {
        let said = workplace.done(&format!("convert {{tiny}} {name} --frames 1"));
        assert!(said.contains("300 Gaussians x 1 frame, "), "{said}");
    }
    assert!(psnr(&workplace, "frame.glb frame.ply") > 99.0);
    // An archive holds the whole model.
    workplace.done("convert {tiny} whole.gsz");
    let parts = ["x.gsz: --frames 1 asks for one frame", "write one frame as .spz"];
    workplace.refused(2, "convert whole.gsz x.gsz --frames 1", &parts);
}

#[test]
fn views_of_a_still_without_cameras_are_virtual() {
    let workplace = Workplace::new();
    write_ply(&workplace, "still.ply");
    let summary = workplace.summary("still.ply -o small.ply --count 20 --no-refine");
    assert_eq!(summary["quality"]["kind"], "virtual", "{summary}");
    workplace.done("view still.ply -o page.html");
    let page = fs::read_to_string(workplace.path("page.html")).unwrap();
    assert!(page.contains(r#""split":"virtual""#) && !page.contains(r#""split":"train""#));
    for (input, views) in [("still.ply", "12 virtual views"), ("{tiny}", "12 views of the cameras")] {
        let archived = workplace.done(&format!("convert {input} x.gsz --overwrite --json"));
        assert!(archived.contains(&format!("PSNR against renders of the input ({views})")), "{archived}");
    }
}

#[test]
fn only_commands_that_rank_warn_of_ranking_by_virtual_views() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 300 --frames 3 -o demo");
    for (arguments, ranks) in [
        ("evaluate demo/scene.gseq demo/scene.gseq", false),
        ("compress demo/scene.gseq -o out.gseq --ratio 50% --no-refine --prune-only", true),
    ] {
        let said = workplace.run(arguments).stderr;
        assert!(said.contains("warning: no cameras were given or found. All views are virtual"), "{said}");
        assert_eq!(said.contains("ranked by virtual views"), ranks, "{said}");
    }
}

#[test]
fn views_that_show_no_gaussian_are_not_a_measure_of_quality() {
    let workplace = Workplace::new();
    write_ply(&workplace, "still.ply");
    // Cameras that look along +y: one in front of the Gaussians, one behind them.
    for (split, y) in [("train", -8.0), ("test", 50.0)] {
        let pose = serde_json::json!([[1, 0, 0, 5], [0, 0, -1, y], [0, 1, 0, 0.5], [0, 0, 0, 1]]);
        let frame = serde_json::json!({"file_path": "./r_0", "transform_matrix": pose});
        let list = serde_json::json!({"camera_angle_x": 1.0, "w": 80, "h": 60, "frames": [frame]});
        fs::write(workplace.path(&format!("transforms_{split}.json")), list.to_string()).unwrap();
    }
    let says = "the measured views show none of the Gaussians";
    let summary = workplace.summary("still.ply --cameras . -o small.ply --count 20 --no-refine --prune-only");
    assert!(summary["quality"].is_null() && summary["notes"][0].to_string().contains(says), "{summary}");
    let evaluated = workplace.done("evaluate still.ply small.ply --cameras .");
    assert!(evaluated.contains(says), "{evaluated}");
    assert!(!workplace.done("evaluate still.ply still.ply --cameras . --split train").contains(says));
}

#[test]
fn damaged_bytes_of_an_archive_are_found_by_their_checksum() {
    let workplace = Workplace::new();
    write_ply(&workplace, "still.ply");
    workplace.done("convert still.ply still.sog");
    let mut bytes = fs::read(workplace.path("still.sog")).unwrap();
    // The bytes of an image follow the name of its file in the archive.
    let name = b"quats.webp";
    let at = bytes.windows(name.len()).position(|part| part == name).unwrap() + name.len();
    bytes[at + 40] ^= 1;
    fs::write(workplace.path("still.sog"), &bytes).unwrap();
    workplace.refused(1, "info still.sog", &["still.sog, quats.webp: expected bytes with the checksum ", ", found "]);
}
