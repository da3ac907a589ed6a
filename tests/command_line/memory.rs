//! The promise of `--memory`: a budget holds or is refused, the least that the refusal names works, and results do
//! not depend on it.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::scene::{Workplace, files, lasting_files, said};
use splatsieve::error::Result;
use splatsieve::model::hash_id;
use splatsieve::model::{Columns, Gaussians, SequenceInfo};
use splatsieve::outputs::container::write_container;
use splatsieve::source::{BlockReader, FrameSource, Ids};

const GAUSSIANS: usize = 30_000;
const FRAMES: usize = 48;
/// Every picture of a camera that sees all, for cheap.
const REQUEST: &str = "--cameras cameras.json --split all --frame-stride 6";

fn random(k: usize) -> f32 {
    (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32
}

/// Gaussians in a box, of which every value but the colors' differs in every frame: 63 MB of it.
struct Restless(SequenceInfo);

impl Restless {
    fn new() -> Self {
        let times = (0..FRAMES).map(|t| t as f64).collect();
        Restless(SequenceInfo {
            count: GAUSSIANS,
            times,
            sh_degree: 1,
            varying: Columns::all().difference(Columns::SH),
        })
    }
}

impl FrameSource for Restless {
    fn info(&self) -> &SequenceInfo {
        &self.0
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(Block(ids.iter().collect())))
    }
}

struct Block(Vec<usize>);

impl BlockReader for Block {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        for column in want.iter() {
            // Middle and size of what the values wander in; neighbors in id are neighbors in space.
            let (middle, wander, shake) = match column {
                Columns::POSITION => (0.0, 2.0, 1e-3),
                Columns::LOG_SCALE => (-3.5, 0.2, 1e-3),
                Columns::OPACITY => (1.0, 3.0, 1e-3),
                _ => (0.3, 1.0, 1e-3),
            };
            let to = out.column_mut(column);
            to.resize(self.0.len());
            for c in 0..to.width() {
                for (x, &id) in to.plane_mut(c).iter_mut().zip(&self.0) {
                    let k = 64 * (id / 4) + 16 * c + column.width(1);
                    let own = wander * (random(k) - 0.5) + 0.01 * random(64 * id + c);
                    let time = if column == Columns::SH { 0 } else { frame };
                    *x = middle + own + shake * (0.3 * time as f32 + 6.0 * random(k + 1)).sin();
                }
            }
        }
        Ok(())
    }
}

/// A folder with the scene packed as `packed.gseq` and `raw.gseq`, and its cameras.
fn prepared() -> Workplace {
    let workplace = Workplace::new();
    for (name, compression) in [("packed.gseq", gseq::Compression::Zstd(1)), ("raw.gseq", gseq::Compression::Raw)] {
        write_container(&Restless::new(), &workplace.path(name), compression, Default::default(), |_| ()).unwrap();
    }
    let camera = r#"{"id": 0, "img_name": "a", "width": 96, "height": 64, "fx": 90, "fy": 90, "position": [0, -4, 0],
        "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}"#;
    std::fs::write(workplace.path("cameras.json"), format!("[{camera}]")).unwrap();
    workplace
}

/// The least that a refusal names, MiB.
fn least(workplace: &Workplace, arguments: &str) -> u64 {
    let run = workplace.run(&format!("{arguments} --memory 1MiB"));
    assert_eq!(run.code, 2, "{}", run.stderr);
    let (_, after) = run.stderr.split_once("at least ").unwrap_or_else(|| panic!("{}", run.stderr));
    after.split_once("MiB").unwrap().0.parse().unwrap()
}

/// Largest resident memory that the summary beside `result` tells of, MiB; none where the system does not say.
fn peak(result: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(format!("{}.summary.json", result.display())).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
    let stages = summary["stages"].as_array().unwrap();
    said(stages.iter().map(|stage| stage["peak_memory_bytes"].as_u64().map(|bytes| bytes >> 20)).max().flatten())
}

#[test]
#[ignore = "needs time"]
fn the_least_that_is_named_works_holds_and_changes_no_byte() {
    let workplace = prepared();
    for (input, rest) in [
        ("packed.gseq", "--target-ratio 0.4 --refine-steps 30 --refine-cut-steps 5 --as archive"),
        ("packed.gseq", "--no-refine"),
        ("raw.gseq", "--no-refine"),
        ("packed.gseq", "--target-ratio 0.4 --no-refine"),
        ("packed.gseq", "--target-ratio 0.3 --refine-steps 30 --refine-cut-steps 5"),
        ("packed.gseq", "--preset paper"),
    ] {
        let request = |output: &str| format!("compress {input} {REQUEST} {rest} -o {output}/small.gseq --overwrite");
        for name in ["free", "tight"] {
            std::fs::create_dir_all(workplace.path(name)).unwrap();
        }
        workplace.done(&format!("{} --memory 8GiB", request("free")));
        let least = least(&workplace, &request("tight"));
        workplace.done(&format!("{} --memory {least}MiB", request("tight")));
        let [free, tight] = ["free", "tight"].map(|name| workplace.path(name));
        if let Some(peak) = peak(&tight.join("small.gseq")) {
            assert!(peak <= least, "{input} {rest}: {peak} MiB resident, {least} promised");
            assert!(least < 63 || rest != "--no-refine", "{input} {rest}: {least} MiB would hold the scene");
        }
        assert!(lasting_files(&free) == lasting_files(&tight), "{input} {rest}: other bytes at {least} MiB");
    }
}

#[test]
#[ignore = "needs time"]
fn every_verb_that_touches_frames_keeps_to_a_budget() {
    let workplace = prepared();
    workplace.done(&format!("compress packed.gseq {REQUEST} --prune-only --target-ratio 0.5 -o small.gseq"));
    for arguments in [
        format!("score packed.gseq {REQUEST} -o rows.npz"),
        "render packed.gseq --cameras cameras.json --frame 3 --view 0 -o x.png".to_owned(),
        "render packed.gseq --cameras cameras.json --beside small.gseq --video film.gif".to_owned(),
        "evaluate packed.gseq small.gseq --cameras cameras.json --max-frames 2".to_owned(),
        "report packed.gseq small.gseq --cameras cameras.json --max-frames 2 -o page".to_owned(),
        "pack packed.gseq -o again.gseq".to_owned(),
        "pack packed.gseq -o small_again.gseq --level 19".to_owned(),
        "pack packed.gseq -o within.gseq --max-error position=0.1%,rotation=1e-2,log_scale=1e-2,sh=1e-2".to_owned(),
        "unpack packed.gseq -o plys".to_owned(),
    ] {
        let least = least(&workplace, &arguments);
        let run = workplace.run(&format!("{arguments} --memory {least}MiB --explain"));
        assert_eq!(run.code, 0, "{}", run.stderr);
        for part in ["memory: at most", "N x", "full reads of the input"] {
            assert!(run.stderr.contains(part), "{arguments}: {part:?} is not in {:?}", run.stderr);
        }
        if let Some(taken) = crate::scene::taken(&run.stderr) {
            println!("{arguments}: {taken} of {least} MiB");
            assert!(taken <= least as f64, "{arguments}: {taken} MiB resident, {least} promised");
        }
    }
}

#[test]
fn a_plan_is_explained_before_it_is_refused_and_nonsense_is_no_size() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 1000 --frames 2 -o demo");
    workplace.refused(
        2,
        "compress demo/scene.gseq -o x.gseq --memory 2MiB --explain",
        &["full reads of the input", "--memory 2.0 MiB: expected at least", "MiB"],
    );
    for size in ["0", "lots", "-5MiB"] {
        workplace.refused(2, &format!("compress demo/scene.gseq -o x.gseq --memory={size}"), &["512MiB"]);
    }
}

#[test]
#[ignore = "needs time"]
fn a_run_killed_at_any_moment_leaves_nothing_that_the_next_one_does_not_clean_up() {
    let workplace = prepared();
    let request = "--cameras cameras.json --split all --frame-stride 24 --target-ratio 0.5 -o small.gseq";
    let least = least(&workplace, &format!("compress packed.gseq {request}"));
    let arguments = format!("compress packed.gseq {request} --memory {least}MiB");
    let start = Instant::now();
    workplace.done(&arguments);
    let whole = start.elapsed();
    let expected = lasting_files(&workplace.path(""));
    let results: Vec<_> = expected.keys().filter(|name| name.to_str().unwrap().starts_with("small")).collect();
    let remove = || {
        for name in results.iter().map(|name| workplace.path(name.to_str().unwrap())) {
            _ = std::fs::remove_file(name);
        }
        _ = std::fs::remove_file(workplace.path("small.gseq.summary.json"));
    };
    remove();
    let is_unfinished = |name: &Path| !expected.contains_key(name) && name != Path::new("small.gseq.summary.json");
    let unfinished = || {
        let mut entries = std::fs::read_dir(workplace.path("")).unwrap();
        entries.any(|entry| is_unfinished(Path::new(&entry.unwrap().file_name())))
    };
    const KILLS: u32 = 6;
    let mut dirty = false;
    for kill in 0..KILLS {
        let mut child = Command::new(assert_cmd::cargo::cargo_bin("splatsieve"))
            .current_dir(workplace.path(""))
            .args(arguments.split_whitespace())
            .stderr(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        if kill % 2 == 0 {
            std::thread::sleep(whole * (kill + 1) / KILLS);
        } else {
            // What the run before left is gone once this one has begun, and the result is next.
            std::thread::sleep(whole / 4);
            while !unfinished() && child.try_wait().unwrap().is_none() {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        child.kill().unwrap();
        child.wait().unwrap();
        dirty |= unfinished();
        let left = files(&workplace.path(""));
        for name in results.iter().filter(|name| left.contains_key(**name)) {
            assert!(left[*name] == expected[*name], "{} has its name, and is not whole", name.display());
        }
        remove();
    }
    assert!(dirty, "every kill came too late to leave anything");
    workplace.done(&arguments);
    let found = lasting_files(&workplace.path(""));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>(), "names after killed runs");
    assert!(found == expected, "a file that a killed run began is not as a whole run writes it");
}
