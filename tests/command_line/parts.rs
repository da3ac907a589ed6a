//! Work that is divided among runs: whatever the number of parts and their order, the same bytes as one run's.

use std::collections::BTreeSet;
use std::fs;

use crate::scene::{Workplace, files};
use serde_json::{Value, json};
use splatsieve::diagnostics::demo_scene::Scene;
use splatsieve::models::trajectories::write_sequence;
use splatsieve::outputs::kind::OutputKind;
use splatsieve::progress::Events;

/// More than two frame blocks, one of them not full.
const FRAMES: usize = 70;

/// A folder with `scene.gseq`, `smaller.gseq` of fewer Gaussians, and `cameras.json`: small pictures of three views, of which
/// one ends after 40 frames.
fn workplace(gaussians: usize) -> Workplace {
    let workplace = Workplace::new();
    let made = Scene::new(gaussians, FRAMES);
    write_sequence(&made, OutputKind::Gseq, &workplace.path("scene.gseq"), 1, &Events::IGNORED).unwrap();
    let fewer = Scene::new(gaussians * 3 / 4, FRAMES);
    write_sequence(&fewer, OutputKind::Gseq, &workplace.path("smaller.gseq"), 1, &Events::IGNORED).unwrap();
    let rig = made.rig();
    let shots: Vec<Value> = (0..3u32)
        .flat_map(|view| (0..if view == 1 { 40 } else { FRAMES }).map(move |frame| (view, frame)))
        .map(|(view, frame)| {
            let camera = &rig.cameras[view as usize];
            let (r, t) = (camera.rotation, camera.translation);
            let row = |i: usize| json!([r.row(i).x, r.row(i).y, r.row(i).z, t[i]]);
            json!({
                "v": view, "time": frame as f64 / (FRAMES - 1) as f64, "split": if frame % 8 == 7 { "test" } else { "train" },
                "width": 40, "height": 30, "fx": camera.fx * 40.0 / 256.0, "fy": camera.fy * 40.0 / 256.0, "cx": 20.0,
                "cy": 15.0, "w2c": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            })
        })
        .collect();
    fs::write(workplace.path("cameras.json"), json!({ "frames": shots }).to_string()).unwrap();
    workplace
}

/// The numbers of parts that are tried. Of most stages there are fewer units than the last.
const NUMBERS: [usize; 4] = [1, 2, 7, 64];

/// Runs every part of `of` of `line`, the last first, until there is nothing to do any more, and the first once more; gives
/// what the runs said.
fn run_parts(workplace: &Workplace, line: &str, of: usize) -> Vec<String> {
    let mut said = Vec::new();
    for _ in 0..100 {
        let round: Vec<String> = (1..=of)
            .rev()
            .chain([1])
            .map(|index| workplace.done(&format!("--quiet {line} --work work --part {index}/{of}")))
            .collect();
        let is_done = round.iter().all(|said| said.contains("nothing to do"));
        said.extend(round);
        if is_done {
            return said;
        }
    }
    panic!("{line}: parts without end: {:?}", said.last());
}

/// What `line`, which writes `output`, says and writes by itself, and that of a run that joins parts is the same.
fn joins_to_the_same(workplace: &Workplace, line: &str, output: &str, numbers: &[usize]) {
    let run = |more: &str| {
        let said = workplace.done(&format!("--quiet {line} {more}"));
        let path = workplace.path(output);
        let written = if path.is_dir() { files(&path) } else { [("".into(), fs::read(&path).unwrap())].into() };
        if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) }.unwrap();
        (said, written)
    };
    let (said, written) = run("");
    for &of in numbers {
        _ = fs::remove_dir_all(workplace.path("work"));
        run_parts(workplace, line, of);
        assert!(!workplace.path(output).exists(), "{line}: a part of {of} wrote the output");
        for what in ["joined", "found again"] {
            let (said_now, written_now) = run("--work work");
            assert_eq!(said, said_now, "{line}: {what} of {of} parts");
            assert!(written == written_now, "{line}: {what} of {of} parts, other bytes");
        }
    }
}

#[test]
fn an_evaluation_in_parts_is_that_of_one_run() {
    let workplace = workplace(300);
    workplace.done("--quiet render scene.gseq --cameras cameras.json --all --split all -o photographs");
    let models = "evaluate scene.gseq smaller.gseq --cameras cameras.json --csv scores.csv";
    for line in [
        format!("{models} --max-frames 9 --split all --json --flip --ground-truth photographs"),
        // 24 pictures, and one view that is not in the last ones.
        models.to_owned(),
    ] {
        joins_to_the_same(&workplace, &line, "scores.csv", &NUMBERS);
    }
}

#[test]
fn a_report_in_parts_is_that_of_one_run_and_shares_the_parts_of_evaluate() {
    let workplace = workplace(300);
    workplace.done("--quiet compress scene.gseq --cameras cameras.json --no-refine -o small.gseq --target-ratio 0.6");
    let models = "scene.gseq small.gseq --cameras cameras.json";
    let rest = "--max-frames 9 --split all --flip";
    joins_to_the_same(&workplace, &format!("report {models} {rest} -o page"), "page", &[1, 2, 7]);

    _ = fs::remove_dir_all(workplace.path("work"));
    run_parts(&workplace, &format!("evaluate {models} {rest}"), 3);
    let part =
        |index: usize| workplace.done(&format!("--quiet report {models} {rest} -o page --work work --part {index}/3"));
    let said = part(2);
    assert!(said.contains("scan: part 2/3 is done"), "the comparison is there: {said}");
    // Until the pictures are looked at again; of these two parts are made, and the run that joins names and makes the third.
    let mut others = 0;
    while !part(1).contains("failure: part 1/3") {
        part(2);
        part(3);
        others += 1;
        assert!(others < 9);
    }
    part(2);
    let joined = workplace.run(&format!("--quiet report {models} {rest} -o page --work work"));
    let missing = "failure: missing of 3 parts, and computed here: 3";
    assert!(joined.code == 0 && joined.stderr.contains(missing), "{}", joined.stderr);
    workplace.done(&format!("--quiet report {models} {rest} -o other"));
    assert!(files(&workplace.path("page")) == files(&workplace.path("other")));
}

#[test]
fn a_container_packed_in_parts_is_that_of_one_run() {
    let workplace = workplace(1500);
    for how in ["", "--raw", "--max-error position=0.1%,sh=1e-2"] {
        joins_to_the_same(&workplace, &format!("pack scene.gseq -o packed.gseq {how}"), "packed.gseq", &NUMBERS);
    }
    joins_to_the_same(&workplace, "pack {tiny} -o packed.gseq", "packed.gseq", &[2]);
}

#[test]
fn pictures_rendered_in_parts_are_those_of_one_run() {
    let workplace = workplace(300);
    let line = "render scene.gseq --cameras cameras.json --all -o pictures";
    joins_to_the_same(&workplace, line, "pictures", &NUMBERS);
    joins_to_the_same(&workplace, &format!("{line} --as npy"), "pictures", &[2]);
}

#[test]
fn a_missing_part_is_named_and_made_by_the_run_that_joins() {
    let workplace = workplace(300);
    let line = "render scene.gseq --cameras cameras.json --all -o pictures --work work";
    for index in [1, 3, 4] {
        workplace.done(&format!("--quiet {line} --part {index}/5"));
    }
    assert_eq!(
        workplace.done(&format!("--quiet {line} --part 3/5")),
        "render: part 3/5 is there already; missing: 2, 5\n"
    );
    let run = workplace.run(&format!("--quiet {line}"));
    assert!(
        run.code == 0 && run.stderr.contains("render: missing of 5 parts, and computed here: 2, 5"),
        "{}",
        run.stderr
    );
    workplace.done("--quiet render scene.gseq --cameras cameras.json --all -o other");
    assert!(files(&workplace.path("pictures")) == files(&workplace.path("other")));
}

/// Parts of `stage` that the work folder lists, by key.
fn listed(workplace: &Workplace, stage: &str) -> BTreeSet<String> {
    let listed: Value = serde_json::from_str(&workplace.done("work work --json")).unwrap();
    let of_stage = listed.as_array().unwrap().iter().filter(|of| of["stage"] == stage);
    of_stage.map(|of| of["key"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn parts_of_other_inputs_and_options_are_not_taken() {
    let workplace = workplace(300);
    workplace.done("--quiet render scene.gseq --cameras cameras.json --all --split all -o photographs");
    fs::copy(workplace.path("scene.gseq"), workplace.path("same.gseq")).unwrap();
    let evaluate =
        |line: &str| workplace.done(&format!("--quiet evaluate {line} --max-frames 3 --work work --part 1/2"));
    let models = "scene.gseq smaller.gseq --cameras cameras.json";
    let photographs = format!("{models} --ground-truth photographs");
    let lines = [
        models.to_owned(),
        "smaller.gseq scene.gseq --cameras cameras.json".to_owned(),
        "scene.gseq scene.gseq --cameras cameras.json".to_owned(),
        "scene.gseq smaller.gseq".to_owned(),
        format!("{models} --flip"),
        format!("{models} --split train"),
        format!("{models} --background 1,0,0"),
        photographs.clone(),
    ];
    for (done, line) in lines.iter().enumerate() {
        assert!(evaluate(line).contains("part 1/2 is done"), "{line}");
        assert!(evaluate(line).contains("part 1/2 is there already"), "{line}");
        assert_eq!(listed(&workplace, "evaluate").len(), done + 1, "{line}");
    }
    // A photograph that was changed is another; a model under another name is not.
    fs::copy(workplace.path("photographs/t000_v00.png"), workplace.path("photographs/t007_v00.png")).unwrap();
    assert!(evaluate(&photographs).contains("part 1/2 is done"));
    assert!(evaluate("same.gseq smaller.gseq --cameras cameras.json").contains("part 1/2 is there already"));
    let pack = |line: &str| workplace.done(&format!("--quiet pack {line} -o packed.gseq --work work --part 1/2"));
    for (done, line) in
        ["scene.gseq", "smaller.gseq", "scene.gseq --raw", "scene.gseq --level 3", "scene.gseq --max-error sh=1e-2"]
            .iter()
            .enumerate()
    {
        assert!(pack(line).contains("part 1/2 is done"), "{line}");
        assert_eq!(listed(&workplace, "pack").len(), done + 1, "{line}");
    }
    let render = |line: &str| {
        workplace.done(&format!("--quiet render {line} --cameras cameras.json --all -o x --work work --part 1/2"))
    };
    for (done, line) in
        ["scene.gseq", "smaller.gseq", "scene.gseq --as npy", "scene.gseq --background 0,0,1", "scene.gseq --split all"]
            .iter()
            .enumerate()
    {
        assert!(render(line).contains("part 1/2 is done"), "{line}");
        assert_eq!(listed(&workplace, "render").len(), done + 1, "{line}");
    }
}

/// Flips a byte in the middle of every piece of the work folder; gives how many there are.
fn damage(workplace: &Workplace) -> usize {
    let pieces: Vec<_> = fs::read_dir(workplace.path("work")).unwrap().map(|entry| entry.unwrap().path()).collect();
    for path in &pieces {
        let mut bytes = fs::read(path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 8;
        fs::write(path, bytes).unwrap();
    }
    pieces.len()
}

#[test]
fn damaged_parts_are_made_again() {
    let workplace = workplace(300);
    for (line, output) in [
        ("evaluate scene.gseq smaller.gseq --cameras cameras.json --csv out", "out"),
        ("pack scene.gseq -o out", "out"),
        ("render scene.gseq --cameras cameras.json --all -o out", "out"),
        ("compress scene.gseq --cameras cameras.json -o out.gseq --preset paper", "out.gseq"),
    ] {
        let path = workplace.path(output);
        let content = || if path.is_dir() { files(&path) } else { [("".into(), fs::read(&path).unwrap())].into() };
        workplace.done(&format!("--quiet {line}"));
        let whole = content();
        run_parts(&workplace, &format!("{line} --force"), 3);
        assert!(damage(&workplace) >= 4, "{line}");
        let run = workplace.run(&format!("--quiet {line} --work work --force"));
        assert!(run.code == 0 && (run.stderr.contains("is damaged") || output == "out.gseq"), "{line}: {}", run.stderr);
        assert!(content() == whole, "{line}: other bytes");
        // What a run has joined may be damaged, too.
        damage(&workplace);
        assert_eq!(workplace.run(&format!("--quiet {line} --work work --force")).code, 0, "{line}");
        assert!(content() == whole, "{line}: other bytes");
        workplace.done("work work --clean");
        if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) }.unwrap();
    }
}

/// What compressing in parts gives is what one run gives; gives the stages that were divided.
fn compresses_to_the_same(workplace: &Workplace, line: &str, numbers: &[usize]) -> BTreeSet<String> {
    let compress = format!("compress scene.gseq --cameras cameras.json -o out.gseq {line}");
    let outputs = ["out.gseq", "out.gseq.index_map.npy", "out.gseq.recipe.toml"];
    let written = || outputs.map(|name| fs::read(workplace.path(name)).unwrap());
    workplace.done(&format!("--quiet {compress} --force"));
    let whole = written();
    let mut stages = BTreeSet::new();
    for &of in numbers {
        fs::remove_file(workplace.path("out.gseq")).unwrap();
        _ = fs::remove_dir_all(workplace.path("work"));
        let said = run_parts(workplace, &format!("{compress} --force"), of);
        assert!(!workplace.path("out.gseq").exists());
        stages.extend(said.iter().filter_map(|said| Some(said.split_once(": part ")?.0.to_owned())));
        workplace.done(&format!("--quiet {compress} --force --work work"));
        assert!(written() == whole, "{line}: other bytes of {of} parts");
    }
    stages
}

#[test]
fn compressing_in_parts_gives_what_one_run_gives() {
    let workplace = workplace(600);
    let stages = compresses_to_the_same(&workplace, "--no-refine --target-ratio 0.7", &[2, 7]);
    assert!(["scan", "visible", "rounds-01", "rounds-02"].iter().all(|stage| stages.contains(*stage)), "{stages:?}");
    let stages = compresses_to_the_same(&workplace, "--no-refine --target-ratio 0.85", &[64]);
    assert!(stages.contains("rounds-01"), "{stages:?}");
}

#[test]
#[ignore = "needs time"]
fn pairs_measured_in_parts_merge_as_in_one_run() {
    let workplace = Workplace::new();
    workplace.done("--quiet test-scene -o demo --gaussians 40000 --frames 6 --no-refine");
    for name in ["scene.gseq", "cameras.json"] {
        fs::rename(workplace.path("demo").join(name), workplace.path(name)).unwrap();
    }
    let stages = compresses_to_the_same(&workplace, "--preset paper --target-ratio 0.6", &[2, 7]);
    assert_eq!(stages.iter().collect::<Vec<_>>(), ["pairs", "scan"]);
}

#[test]
fn divided_stages_are_listed_with_their_units() {
    let workplace = workplace(2000);
    let list = |line: &str| {
        workplace.done(&format!("--quiet compress scene.gseq --cameras cameras.json -o out.gseq --list-stages {line}"))
    };
    let listed = list("--no-refine --target-ratio 0.7");
    let lines: Vec<&str> = listed.lines().collect();
    assert_eq!(lines[0], "scan: 2 blocks of Gaussians");
    assert!(lines[1].starts_with("visible: ") && lines[1].ends_with(" pictures"), "{listed}");
    assert!(lines[2].starts_with("rounds-01: ") && lines.contains(&"pairs: pairs of neighbours"), "{listed}");
    assert_eq!(list("--preset paper"), "scan: 2 blocks of Gaussians\npairs: pairs of neighbours\n");
    assert!(list("").contains("targets: pictures"));
    workplace.refused(2, "compress scene.gseq -o out.gseq --list-stages --work work --part 1/2", &["--part"]);
}

#[test]
fn a_work_folder_is_listed_and_cleaned() {
    let workplace = workplace(300);
    workplace.done("--quiet pack scene.gseq -o packed.gseq --work work --part 2/3");
    let text = workplace.done("work work");
    assert!(text.starts_with("scene.gseq (splatsieve ") && text.contains("3 parts, missing: 1, 3"), "{text}");
    let listed: Value = serde_json::from_str(&workplace.done("work work --json")).unwrap();
    let pack = listed.as_array().unwrap().iter().find(|of| of["stage"] == "pack").unwrap();
    assert_eq!((&pack["parts"], &pack["missing"], &pack["damaged"]), (&json!(3), &json!([1, 3]), &json!([])));
    damage(&workplace);
    assert!(workplace.done("work work").contains("damaged: 2"));
    fs::write(workplace.path("work/mine.txt"), "kept").unwrap();
    assert!(workplace.done("work work --clean").starts_with("work: 2 files, "));
    assert_eq!(files(&workplace.path("work")).len(), 1);
    fs::remove_file(workplace.path("work/mine.txt")).unwrap();
    assert_eq!(workplace.done("work work"), "nothing is kept here\n");
    workplace.done("work work --clean");
    workplace.refused(1, "work work", &["work"]);
    workplace.refused(2, "work work --clean --json", &["--json"]);
}

#[test]
fn what_cannot_be_divided_is_refused() {
    let workplace = workplace(300);
    for (line, part) in [
        ("pack - -o x.gseq --work work", "splatsieve pack - -o NAME.gseq"),
        ("render - --all -o x --work work", "splatsieve pack - -o NAME.gseq"),
        ("evaluate - scene.gseq --work work", "splatsieve pack - -o NAME.gseq"),
        ("compress - -o x.gseq --work work", "splatsieve pack - -o NAME.gseq"),
        ("render scene.gseq --frame 0 --view 0 -o x.png --work work", "expected --all"),
        ("render scene.gseq --all -o x --part 1/2", "--work"),
        ("evaluate scene.gseq smaller.gseq --work work --part 3/2", "i/n"),
        ("pack scene.gseq -o x.gseq --work work --part 0/2", "i/n"),
        ("pack scene.gseq -o x.gseq --work scene.gseq", "is no folder"),
    ] {
        workplace.refused(2, line, &[part]);
    }
}
