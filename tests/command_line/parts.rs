//! Tests of work divided into shards. For any number and order of shards, the joined result has the same bytes as the
//! result of one undivided run.

use std::collections::BTreeSet;
use std::fs;

use crate::scene::{Workplace, files};
use serde_json::{Value, json};
use splatsieve::diagnostics::demo_scene::DemoScene;
use splatsieve::models::trajectories::write_sequence;
use splatsieve::outputs::kind::OutputKind;
use splatsieve::progress::Events;

/// Number of frames of the test scene: two full frame blocks of 32 frames, and one block that is not full.
const FRAMES: usize = 70;

/// Returns a folder with `scene.gseq` of `gaussians` Gaussians, `smaller.gseq` with fewer, and `cameras.json` with
/// three small cameras. Two of the cameras see every frame, one only the first 40.
fn workplace(gaussians: usize) -> Workplace {
    let workplace = Workplace::new();
    let made = DemoScene::new(gaussians, FRAMES);
    write_sequence(&made, OutputKind::Gseq, &workplace.path("scene.gseq"), 1, &Events::IGNORED).unwrap();
    let fewer = DemoScene::new(gaussians * 3 / 4, FRAMES);
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

/// Numbers of shards to test. Most stages have fewer units of work than 64, so that some shards are empty.
const SHARD_COUNTS: [usize; 4] = [1, 2, 7, 64];

/// Runs all `count` shards of the command `line`, in descending order and then shard 1 again, until none has work left.
/// Returns the standard outputs of all runs.
fn run_parts(workplace: &Workplace, line: &str, count: usize) -> Vec<String> {
    let mut said = Vec::new();
    for _ in 0..100 {
        let round: Vec<String> = (1..=count)
            .rev()
            .chain([1])
            .map(|index| workplace.done(&format!("--quiet {line} --cache work --shard {index}/{count}")))
            .collect();
        let is_done = round.iter().all(|said| said.contains("nothing left to do"));
        said.extend(round);
        if is_done {
            return said;
        }
    }
    panic!("{line}: parts without end: {:?}", said.last());
}

/// Checks that the command `line`, which writes `output`, gives the same result in two ways: in one run, and in a run
/// after its shards were computed separately. `numbers` are the numbers of shards to test.
fn assert_joined_equals_single_run(workplace: &Workplace, line: &str, output: &str, numbers: &[usize]) {
    let run = |more: &str| {
        let said = workplace.done(&format!("--quiet {line} {more}"));
        // Times differ between runs.
        let is_time =
            |line: &&str| line.contains("render time") || line.contains("Render time") || line.contains("MiB peak");
        let is_render_ms =
            |line: &&str| line.contains("render_ms") || line.contains("\"before\"") || line.contains("\"after\"");
        let said: String = said.lines().filter(|line| !is_time(line) && !is_render_ms(line)).collect();
        let path = workplace.path(output);
        let written = if path.is_dir() { files(&path) } else { [("".into(), fs::read(&path).unwrap())].into() };
        if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) }.unwrap();
        (said, written)
    };
    let (said, written) = run("");
    for &count in numbers {
        _ = fs::remove_dir_all(workplace.path("work"));
        run_parts(workplace, line, count);
        assert!(!workplace.path(output).exists(), "{line}: a part of {count} wrote the output");
        for what in ["joined", "found again"] {
            let (said_now, written_now) = run("--cache work");
            assert_eq!(said, said_now, "{line}: {what} of {count} parts");
            assert!(written == written_now, "{line}: {what} of {count} parts, other bytes");
        }
    }
}

#[test]
fn evaluation_in_shards_equals_one_run() {
    let workplace = workplace(300);
    workplace.done("--quiet render scene.gseq --cameras cameras.json --all --split all -o photographs");
    let models = "evaluate scene.gseq smaller.gseq --cameras cameras.json --csv scores.csv";
    for line in [
        format!("{models} --max-frames 9 --split all --json --flip --ground-truth photographs"),
        // 24 images; one view has none of the last frames.
        models.to_owned(),
    ] {
        assert_joined_equals_single_run(&workplace, &line, "scores.csv", &SHARD_COUNTS);
    }
}

#[test]
fn report_in_shards_equals_one_run_and_reuses_evaluate() {
    let workplace = workplace(300);
    workplace.done("--quiet compress scene.gseq --cameras cameras.json --no-refine -o small.gseq --ratio 0.6");
    let models = "scene.gseq small.gseq --cameras cameras.json";
    let rest = "--max-frames 9 --split all --flip";
    assert_joined_equals_single_run(&workplace, &format!("report {models} {rest} -o page"), "page", &[1, 2, 7]);

    _ = fs::remove_dir_all(workplace.path("work"));
    run_parts(&workplace, &format!("evaluate {models} {rest}"), 3);
    let part = |index: usize| {
        workplace.done(&format!("--quiet report {models} {rest} -o page --cache work --shard {index}/3"))
    };
    let said = part(2);
    assert!(said.contains("scan: part 2/3 is done"), "the comparison is there: {said}");
    // Computes shards until the stage that measures failures comes, then two of its three shards; the joining run names
    // the third and computes it.
    let mut others = 0;
    while !part(1).contains("failure: part 1/3") {
        part(2);
        part(3);
        others += 1;
        assert!(others < 9);
    }
    part(2);
    let joined = workplace.run(&format!("--quiet report {models} {rest} -o page --cache work"));
    let missing = "failure: of 3 parts these are missing and computed here: 3";
    assert!(joined.code == 0 && joined.stderr.contains(missing), "{}", joined.stderr);
    workplace.done(&format!("--quiet report {models} {rest} -o other"));
    assert!(files(&workplace.path("page")) == files(&workplace.path("other")));
}

#[test]
fn container_packed_in_shards_equals_one_run() {
    let workplace = workplace(1500);
    for how in ["", "--raw", "--max-error position=0.1%,sh=1e-2"] {
        assert_joined_equals_single_run(
            &workplace,
            &format!("convert scene.gseq packed.gseq {how}"),
            "packed.gseq",
            &SHARD_COUNTS,
        );
    }
    assert_joined_equals_single_run(&workplace, "convert {tiny} packed.gseq", "packed.gseq", &[2]);
}

#[test]
fn renders_in_shards_equal_one_run() {
    let workplace = workplace(300);
    let line = "render scene.gseq --cameras cameras.json --all -o renders";
    assert_joined_equals_single_run(&workplace, line, "renders", &SHARD_COUNTS);
    assert_joined_equals_single_run(&workplace, &format!("{line} --as npy"), "renders", &[2]);
}

#[test]
fn missing_shard_is_named_and_computed_when_joining() {
    let workplace = workplace(300);
    let line = "render scene.gseq --cameras cameras.json --all -o renders --cache work";
    for index in [1, 3, 4] {
        workplace.done(&format!("--quiet {line} --shard {index}/5"));
    }
    assert_eq!(
        workplace.done(&format!("--quiet {line} --shard 3/5")),
        "render: part 3/5 is there already; missing: 2, 5\n"
    );
    let run = workplace.run(&format!("--quiet {line}"));
    assert!(
        run.code == 0 && run.stderr.contains("render: of 5 parts these are missing and computed here: 2, 5"),
        "{}",
        run.stderr
    );
    workplace.done("--quiet render scene.gseq --cameras cameras.json --all -o other");
    assert!(files(&workplace.path("renders")) == files(&workplace.path("other")));
}

/// Returns the keys of the cached shards of `stage`.
fn cached_shards(workplace: &Workplace, stage: &str) -> BTreeSet<String> {
    let cached_shards: Value = serde_json::from_str(&workplace.done("cache work --json")).unwrap();
    let of_stage = cached_shards.as_array().unwrap().iter().filter(|entry| entry["stage"] == stage);
    of_stage.map(|entry| entry["key"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn shards_of_other_inputs_and_options_are_not_used() {
    let workplace = workplace(300);
    workplace.done("--quiet render scene.gseq --cameras cameras.json --all --split all -o photographs");
    fs::copy(workplace.path("scene.gseq"), workplace.path("same.gseq")).unwrap();
    let evaluate =
        |line: &str| workplace.done(&format!("--quiet evaluate {line} --max-frames 3 --cache work --shard 1/2"));
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
        assert_eq!(cached_shards(&workplace, "evaluate").len(), done + 1, "{line}");
    }
    // A changed photograph changes the cache key; another file name of the same model does not.
    fs::copy(workplace.path("photographs/t000_v00.png"), workplace.path("photographs/t007_v00.png")).unwrap();
    assert!(evaluate(&photographs).contains("part 1/2 is done"));
    assert!(evaluate("same.gseq smaller.gseq --cameras cameras.json").contains("part 1/2 is there already"));
    let pack = |line: &str| workplace.done(&format!("--quiet convert {line} packed.gseq --cache work --shard 1/2"));
    for (done, line) in
        ["scene.gseq", "smaller.gseq", "scene.gseq --raw", "scene.gseq --level 3", "scene.gseq --max-error sh=1e-2"]
            .iter()
            .enumerate()
    {
        assert!(pack(line).contains("part 1/2 is done"), "{line}");
        assert_eq!(cached_shards(&workplace, "pack").len(), done + 1, "{line}");
    }
    let render = |line: &str| {
        workplace.done(&format!("--quiet render {line} --cameras cameras.json --all -o x --cache work --shard 1/2"))
    };
    for (done, line) in
        ["scene.gseq", "smaller.gseq", "scene.gseq --as npy", "scene.gseq --background 0,0,1", "scene.gseq --split all"]
            .iter()
            .enumerate()
    {
        assert!(render(line).contains("part 1/2 is done"), "{line}");
        assert_eq!(cached_shards(&workplace, "render").len(), done + 1, "{line}");
    }
}

/// Flips a byte in the middle of every cache entry. Returns the number of entries.
fn damage_cache_entries(workplace: &Workplace) -> usize {
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
fn damaged_shards_are_computed_again() {
    let workplace = workplace(300);
    for (line, output) in [
        ("evaluate scene.gseq smaller.gseq --cameras cameras.json --csv out", "out"),
        ("convert scene.gseq out.gseq", "out.gseq"),
        ("render scene.gseq --cameras cameras.json --all -o out", "out"),
        ("compress scene.gseq --cameras cameras.json -o out.gseq --preset paper", "out.gseq"),
    ] {
        let path = workplace.path(output);
        let content = || if path.is_dir() { files(&path) } else { [("".into(), fs::read(&path).unwrap())].into() };
        workplace.done(&format!("--quiet {line}"));
        let whole = content();
        run_parts(&workplace, &format!("{line} --overwrite"), 3);
        assert!(damage_cache_entries(&workplace) >= 4, "{line}");
        let run = workplace.run(&format!("--quiet {line} --cache work --overwrite"));
        assert!(run.code == 0 && (run.stderr.contains("is damaged") || output == "out.gseq"), "{line}: {}", run.stderr);
        assert!(content() == whole, "{line}: other bytes");
        // Joined entries may be damaged, too.
        damage_cache_entries(&workplace);
        assert_eq!(workplace.run(&format!("--quiet {line} --cache work --overwrite")).code, 0, "{line}");
        assert!(content() == whole, "{line}: other bytes");
        workplace.done("cache work --clean");
        if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) }.unwrap();
    }
}

/// Checks that compressing in shards writes the same files as one run. `line` holds additional arguments of `compress`,
/// and `numbers` the numbers of shards to test. Returns the names of the stages that were divided.
fn assert_compresses_the_same(workplace: &Workplace, line: &str, numbers: &[usize]) -> BTreeSet<String> {
    let compress = format!("compress scene.gseq --cameras cameras.json -o out.gseq {line}");
    let outputs = ["out.gseq", "out.gseq.index_map.npy", "out.gseq.recipe.toml"];
    let written = || outputs.map(|name| fs::read(workplace.path(name)).unwrap());
    workplace.done(&format!("--quiet {compress} --overwrite"));
    let whole = written();
    let mut stages = BTreeSet::new();
    for &count in numbers {
        fs::remove_file(workplace.path("out.gseq")).unwrap();
        _ = fs::remove_dir_all(workplace.path("work"));
        let said = run_parts(workplace, &format!("{compress} --overwrite"), count);
        assert!(!workplace.path("out.gseq").exists());
        stages.extend(said.iter().filter_map(|said| Some(said.split_once(": part ")?.0.to_owned())));
        workplace.done(&format!("--quiet {compress} --overwrite --cache work"));
        assert!(written() == whole, "{line}: other bytes of {count} parts");
    }
    stages
}

#[test]
fn compressing_in_shards_equals_one_run() {
    let workplace = workplace(600);
    let stages = assert_compresses_the_same(&workplace, "--no-refine --ratio 0.7", &[2, 7]);
    assert!(["scan", "visible", "rounds-01", "rounds-02"].iter().all(|stage| stages.contains(*stage)), "{stages:?}");
    let stages = assert_compresses_the_same(&workplace, "--no-refine --ratio 0.85", &[64]);
    assert!(stages.contains("rounds-01"), "{stages:?}");
}

#[test]
#[ignore = "needs time"]
fn pairs_measured_in_shards_merge_as_in_one_run() {
    let workplace = Workplace::new();
    workplace.done("--quiet test-scene -o test-scene --gaussians 40000 --frames 6 --no-refine");
    for name in ["scene.gseq", "cameras.json"] {
        fs::rename(workplace.path("test-scene").join(name), workplace.path(name)).unwrap();
    }
    let stages = assert_compresses_the_same(&workplace, "--preset paper --ratio 0.6", &[2, 7]);
    assert_eq!(stages.iter().collect::<Vec<_>>(), ["pairs", "scan"]);
}

#[test]
fn divided_stages_are_listed_with_their_units() {
    let workplace = workplace(2000);
    let list = |line: &str| {
        workplace
            .done(&format!("--quiet compress scene.gseq --cameras cameras.json -o out.gseq --dry-run=stages {line}"))
    };
    let cached_shards = list("--no-refine --ratio 0.7");
    let lines: Vec<&str> = cached_shards.lines().collect();
    assert_eq!(lines[0], "scan: 2 blocks of Gaussians");
    assert!(lines[1].starts_with("visible: ") && lines[1].ends_with(" views"), "{cached_shards}");
    assert!(lines[2].starts_with("rounds-01: ") && lines.contains(&"pairs: pairs of neighbors"), "{cached_shards}");
    assert_eq!(list("--preset paper"), "scan: 2 blocks of Gaussians\npairs: pairs of neighbors\n");
    assert!(list("").contains("targets: views"));
    workplace.refused(2, "compress scene.gseq -o out.gseq --dry-run=stages --cache work --shard 1/2", &["--shard"]);
}

#[test]
fn cache_folder_is_listed_and_cleaned() {
    let workplace = workplace(300);
    workplace.done("--quiet convert scene.gseq packed.gseq --cache work --shard 2/3");
    let text = workplace.done("cache work");
    assert!(text.starts_with("scene.gseq (splatsieve ") && text.contains("3 parts, missing: 1, 3"), "{text}");
    let cached_shards: Value = serde_json::from_str(&workplace.done("cache work --json")).unwrap();
    let pack = cached_shards.as_array().unwrap().iter().find(|entry| entry["stage"] == "pack").unwrap();
    assert_eq!((&pack["parts"], &pack["missing"], &pack["damaged"]), (&json!(3), &json!([1, 3]), &json!([])));
    damage_cache_entries(&workplace);
    assert!(workplace.done("cache work").contains("damaged: 2"));
    fs::write(workplace.path("work/mine.txt"), "kept").unwrap();
    let cleaned: serde_json::Value = serde_json::from_str(&workplace.done("cache work --clean --json")).unwrap();
    assert_eq!((&cleaned["folder"], &cleaned["files_removed"]), (&"work".into(), &2.into()));
    assert_eq!(files(&workplace.path("work")).len(), 1);
    fs::remove_file(workplace.path("work/mine.txt")).unwrap();
    assert_eq!(workplace.done("cache work"), "no results are stored here\n");
    workplace.done("cache work --clean");
    workplace.refused(1, "cache work", &["the cache folder work"]);
}

#[test]
fn indivisible_commands_refuse_shards() {
    let workplace = workplace(300);
    for (line, part) in [
        ("convert - x.gseq --cache work", "splatsieve convert - NAME.gseq"),
        ("render - --all -o x --cache work", "splatsieve convert - NAME.gseq"),
        ("evaluate - scene.gseq --cache work", "splatsieve convert - NAME.gseq"),
        ("compress - -o x.gseq --cache work", "splatsieve convert - NAME.gseq"),
        ("render scene.gseq --frame 0 --view 0 -o x.png --cache work", "expected --all"),
        ("render scene.gseq --all -o x --shard 1/2", "--cache"),
        ("evaluate scene.gseq smaller.gseq --cache work --shard 3/2", "i/n"),
        ("convert scene.gseq x.gseq --cache work --shard 0/2", "i/n"),
        ("convert scene.gseq x.gseq --cache scene.gseq", "expected a folder"),
    ] {
        workplace.refused(2, line, &[part]);
    }
}
