//! Tests of `.splatv` files of other programs: Gaussians that no player draws, infinite temporal widths, textures
//! without padding.

use std::fs;
use std::path::Path;

use crate::scene::{Workplace, index_map, shared, state};
use serde_json::Value;
use splatsieve::diagnostics::demo_scene::{DemoScene, cameras_json};
use splatsieve::error::Result;
use splatsieve::files::splatv::write::encode_words;
use splatsieve::files::splatv::{MAGIC, SplatvGaussian, WORDS_PER_GAUSSIAN};
use splatsieve::model::{SequenceInfo, opacity};
use splatsieve::models::trajectories::write_sequence;
use splatsieve::outputs::kind::OutputKind;
use splatsieve::progress::Events;
use splatsieve::scene::{InputOptions, open_scene};
use splatsieve::source::{BlockReader, FrameSource, Ids};

const ROWS: usize = 200;

fn valid_gaussian(i: usize) -> SplatvGaussian {
    let part = |k: usize| ((i * k) % 97) as f32 / 97.0;
    SplatvGaussian {
        position: [4.0 * part(13) - 2.0, 4.0 * part(29) - 2.0, 4.0 * part(41) - 2.0],
        motion: std::array::from_fn(|k| if k < 3 { part(k + 3) - 0.5 } else { 0.0 }),
        rotation: [1.0, 0.1 + part(5), part(7), 0.0],
        scale: [0.1 + 0.2 * part(11), 0.1, 0.2],
        rgb: [0.2 + 0.7 * f64::from(part(17)), 0.5, 0.9 - 0.7 * f64::from(part(19))],
        opacity: 0.8,
        center: part(23),
        width: 0.7,
        ..SplatvGaussian::default()
    }
}

/// Returns 200 Gaussians encoded as rows of a `.splatv` texture. Some have defects: row 3 has no valid position, row 10
/// neither position nor rotation, rows 20 to 24 no rotation, row 30 no width. Rows 40 to 47 have infinite temporal
/// widths.
fn rows() -> Vec<[u32; WORDS_PER_GAUSSIAN]> {
    let mut rows: Vec<[u32; WORDS_PER_GAUSSIAN]> = (0..ROWS).map(|i| encode_words(&valid_gaussian(i))).collect();
    rows[3][1] = f32::NAN.to_bits();
    (rows[10][0], rows[10][3], rows[10][4]) = (f32::INFINITY.to_bits(), 0, 0);
    rows[20..25].iter_mut().for_each(|row| (row[3], row[4]) = (0, 0));
    rows[30][15] &= 0xffff;
    rows[40..48].iter_mut().for_each(|row| row[15] = (row[15] & 0xffff) | 0x7c00 << 16);
    rows
}

const DROPPED: [usize; 8] = [3, 10, 20, 21, 22, 23, 24, 30];

/// Writes the texture rows `rows` to a `.splatv` file, which ends after the last row without padding, as numpy's
/// `tobytes` leaves it.
fn write(path: &Path, rows: &[[u32; WORDS_PER_GAUSSIAN]]) {
    let text = r#"[{"type":"splat","size":65536,"texwidth":4096,"texheight":1,"cameras":[]}]"#;
    let mut bytes = [MAGIC.to_le_bytes(), (text.len() as u32).to_le_bytes()].concat();
    bytes.extend(text.as_bytes());
    bytes.extend(rows.iter().flatten().flat_map(|word| word.to_le_bytes()));
    fs::write(path, bytes).unwrap();
}

fn rows_of(path: &Path) -> Vec<SplatvGaussian> {
    let file = splatsieve::files::splatv::Splatv::open(path).unwrap();
    (0..file.count()).map(|i| SplatvGaussian::from_words(&file.words(i))).collect()
}

fn json(workplace: &Workplace, arguments: &str) -> Value {
    serde_json::from_str(&workplace.done(arguments)).unwrap()
}

/// Returns the notes about defective rows in `found`, the output of `info` or the summary of a compression.
fn notes(found: &Value) -> Vec<String> {
    let notes = found["notes"].as_array().unwrap().iter().map(|note| note.as_str().unwrap().to_owned());
    notes.filter(|note| note.contains(" rows ")).collect()
}

fn assert_said(notes: &[String], parts: &[&str]) {
    for part in parts {
        assert!(notes.iter().any(|note| note.contains(part)), "{part:?} is not in {notes:?}");
    }
}

#[test]
fn defective_rows_are_counted_and_left_out_or_kept() {
    let workplace = Workplace::new();
    write(&workplace.path("odd.splatv"), &rows());
    let parts = [
        "200 rows of 1024 declared",
        "16 of 200 rows have defects: 8 (4.00%) left out, 8 repaired",
        "2 of 200 rows (1.00%) left out: NaN or infinite position",
        "6 of 200 rows (3.00%) left out: zero quaternion",
        "1 of 200 rows (0.50%) left out: temporal width",
        "8 of 200 rows (4.00%) repaired: infinite temporal width",
    ];
    assert_said(&notes(&json(&workplace, "info odd.splatv --json")), &parts);
    let options = "--frames 4 --prune-only --no-refine --count 150";
    let summary = workplace.summary(&format!("odd.splatv -o small.splatv {options}"));
    assert_eq!((&summary["input"]["gaussians"], &summary["gaussians"]), (&192.into(), &150.into()));
    assert_said(&notes(&summary), &parts);
    let places: Vec<[f32; 3]> =
        (0..ROWS).filter(|row| !DROPPED.contains(row)).map(|row| valid_gaussian(row).position).collect();
    let small = rows_of(&workplace.path("small.splatv"));
    assert!(small.len() == 150 && small.iter().all(|row| places.contains(&row.position)));
    let map = index_map(&workplace.path("small.splatv.index_map.npy"));
    for (id, &place) in map.iter().enumerate().filter(|(_, place)| **place >= 0) {
        assert_eq!(small[place as usize].position, places[id], "Gaussian {id}");
    }
}

#[test]
fn infinite_temporal_widths_are_visible_at_every_time() {
    let workplace = Workplace::new();
    write(&workplace.path("odd.splatv"), &rows());
    let options = InputOptions { path: workplace.path("odd.splatv"), frames: Some(5), ..InputOptions::default() };
    let scene = open_scene(&options).unwrap();
    for frame in 0..5 {
        let state = state(scene.source(), frame);
        // Row 40 of the file is Gaussian 32.
        let visible = opacity(state.opacity_logit.row::<1>(32)[0]);
        assert!((visible - 204.0 / 255.0).abs() < 1e-6, "{visible} at frame {frame}");
        assert!(state.position.planes().iter().all(|x| x.is_finite()));
    }
    workplace.done("compress odd.splatv -o all.splatv --frames 4 --prune-only --no-refine --ratio 1");
    let all = rows_of(&workplace.path("all.splatv"));
    assert_eq!(all.iter().filter(|row| row.width == 65504.0).count(), 8);
    assert!(all.iter().all(|row| row.width > 0.0 && row.width.is_finite() && row.rotation != [0.0; 4]));
    assert!(!workplace.done("info all.splatv").contains("rows"));
    let psnr = &json(&workplace, "evaluate odd.splatv all.splatv --frames 4 --json")["psnr"];
    assert!(psnr.as_f64().unwrap() > 90.0, "{psnr}");
    let psnr = &json(&workplace, "evaluate all.splatv odd.splatv --frames 4 --json")["psnr"];
    assert!(psnr.as_f64().unwrap() > 90.0, "{psnr}");
}

#[test]
fn zero_quaternions_are_kept_on_request() {
    let workplace = Workplace::new();
    write(&workplace.path("odd.splatv"), &rows());
    let said = workplace.done("info odd.splatv --zero-rotation identity");
    assert!(said.contains("6 of 200 rows (3.00%) repaired: zero quaternion"), "{said}");
    let options = "--frames 4 --prune-only --no-refine --ratio 1 --zero-rotation identity";
    let summary = workplace.summary(&format!("odd.splatv -o all.splatv {options}"));
    assert_eq!(summary["gaussians"], 197);
    let turned =
        rows_of(&workplace.path("all.splatv")).iter().filter(|row| row.rotation == [1.0, 0.0, 0.0, 0.0]).count();
    assert_eq!(turned, 5);
    let recipe = fs::read_to_string(workplace.path("all.splatv.recipe.toml")).unwrap();
    assert!(recipe.contains("zero_rotation = \"identity\""), "{recipe}");
    let again = workplace.summary("odd.splatv --recipe all.splatv.recipe.toml -o again.splatv");
    assert_eq!(again["gaussians"], 197);
    let bytes = |name: &str| fs::read(workplace.path(name)).unwrap();
    assert_eq!(bytes("all.splatv"), bytes("again.splatv"));
}

#[test]
fn texture_that_ends_within_a_row_is_refused() {
    let workplace = Workplace::new();
    let path = workplace.path("cut.splatv");
    write(&path, &rows());
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 10]).unwrap();
    let found = format!("{} bytes", bytes.len() - 10);
    let whole = format!("such as {}", bytes.len() - 64);
    workplace.refused(1, "info cut.splatv", &["cut.splatv", "65536", &whole, &found, "cut short"]);
}

/// Checks that `info`, `compress` and `evaluate` accept the file `name`, which another program wrote. Returns the notes
/// of the compression.
fn captured(name: &str) -> Vec<String> {
    let workplace = Workplace::new();
    let folder = shared("captured");
    let [model, cameras] =
        [folder.join(name), folder.join("spinach_4_test.json")].map(|path| path.display().to_string());
    workplace.done(&format!("info {model}"));
    let looks = format!("--cameras {cameras} --frames 3");
    let options = "-o small.splatv --ratio 0.1 --no-refine --prune-only";
    let summary = workplace.summary(&format!("{model} {looks} {options}"));
    let found = json(&workplace, &format!("evaluate {model} small.splatv {looks} --json"));
    assert!(found["psnr"].as_f64().is_some_and(f64::is_finite), "{found}");
    notes(&summary)
}

#[test]
#[ignore = "needs the trained models"]
fn captured_kitchen_has_821_infinite_widths() {
    let notes = captured("spinach_4.splatv");
    let widths = "821 of 62442 rows (1.31%) repaired: infinite temporal width";
    assert_said(
        &notes,
        &[widths, "821 of 62442 rows have defects: 0 (0.00%) left out", "62442 rows of 62464 declared"],
    );
    assert_eq!(notes.len(), 3, "{notes:?}");
}

#[test]
#[ignore = "needs the trained models"]
fn captured_coffee_has_the_defects_that_were_counted() {
    let notes = captured("coffee10.splatv");
    // The 24 rows without a position have a zero quaternion as well.
    let total = "11335 of 11926 rows have defects: 11331 (95.01%) left out, 4 repaired";
    let kinds = ["24 of 11926 rows (0.20%) left out", "11331 of 11926 rows (95.01%) left out: zero quaternion"];
    assert_said(&notes, &[total, kinds[0], kinds[1], "4 of 11926 rows (0.03%) repaired: infinite temporal width"]);
    assert_eq!(notes.len(), 5, "{notes:?}");
}

/// Test scene whose frames have other times.
struct Retimed(DemoScene, SequenceInfo);

impl FrameSource for Retimed {
    fn info(&self) -> &SequenceInfo {
        &self.1
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        self.0.open(ids)
    }
}

#[test]
fn times_outside_0_to_1_are_scaled_for_comparison() {
    let workplace = Workplace::new();
    let scene = DemoScene::new(300, 6);
    let times = scene.info().times.iter().map(|time| 8.0 * time - 2.0).collect();
    fs::write(workplace.path("cameras.json"), cameras_json(&scene.rig())).unwrap();
    let info = SequenceInfo { times, ..scene.info().clone() };
    let retimed = Retimed(scene, info);
    write_sequence(&retimed, OutputKind::Gseq, &workplace.path("scene.gseq"), 1, &Events::IGNORED).unwrap();

    let options = "--cameras cameras.json --prune-only --no-refine --ratio 1";
    let summary = workplace.summary(&format!("scene.gseq -o curves.splatv {options}"));
    let [said, measured] =
        [&summary, &json(&workplace, "evaluate scene.gseq curves.splatv --cameras cameras.json --json")]
            .map(|found| found["quality"]["psnr"].as_f64().or(found["psnr"].as_f64()).unwrap());
    assert!(summary["quality"]["before_conversion"].is_null(), "{summary}");
    assert!((said - measured).abs() < 2.0 && measured > 30.0, "{said} dB printed, {measured} dB measured");
    let evaluated = workplace.done("evaluate scene.gseq curves.splatv --cameras cameras.json");
    assert!(
        evaluated.contains("the times of the original, -2 to 6, are compared with the times 0 to 1"),
        "{evaluated}"
    );
}
