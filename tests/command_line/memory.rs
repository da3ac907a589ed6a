//! Tests of `--memory`: a limit is kept or refused, the minimum that the refusal names is enough, and results do not
//! depend on the limit.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::scene::{Workplace, files, lasting_files, program, said};
use splatsieve::error::Result;
use splatsieve::model::hash_id;
use splatsieve::model::{Attributes, Gaussians, SequenceInfo};
use splatsieve::outputs::container::write_container;
use splatsieve::source::{BlockReader, FrameSource, Ids};

const GAUSSIANS: usize = 30_000;
const FRAMES: usize = 48;
/// Options for few small images from a camera that sees all Gaussians, which keeps the tests fast.
const REQUEST: &str = "--cameras cameras.json --split all --set frame_stride=6";

fn random(k: usize) -> f32 {
    (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32
}

/// Scene of 63 MB: Gaussians in a box, in which every value except the colors differs in every frame.
struct ChangingScene(SequenceInfo);

impl ChangingScene {
    fn new() -> Self {
        let times = (0..FRAMES).map(|t| t as f64).collect();
        ChangingScene(SequenceInfo {
            count: GAUSSIANS,
            times,
            sh_degree: 1,
            varying: Attributes::all().difference(Attributes::SH),
        })
    }
}

impl FrameSource for ChangingScene {
    fn info(&self) -> &SequenceInfo {
        &self.0
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(Block(ids.iter().collect())))
    }
}

struct Block(Vec<usize>);

impl BlockReader for Block {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        for column in want.iter() {
            // Center and amplitude of the values; Gaussians with close ids are close in space.
            let (middle, wander, shake) = match column {
                Attributes::POSITION => (0.0, 2.0, 1e-3),
                Attributes::LOG_SCALE => (-3.5, 0.2, 1e-3),
                Attributes::OPACITY => (1.0, 3.0, 1e-3),
                _ => (0.3, 1.0, 1e-3),
            };
            let to = out.attribute_values_mut(column);
            to.resize(self.0.len());
            for c in 0..to.width() {
                for (x, &id) in to.plane_mut(c).iter_mut().zip(&self.0) {
                    let k = 64 * (id / 4) + 16 * c + column.width(1);
                    let own = wander * (random(k) - 0.5) + 0.01 * random(64 * id + c);
                    let time = if column == Attributes::SH { 0 } else { frame };
                    *x = middle + own + shake * (0.3 * time as f32 + 6.0 * random(k + 1)).sin();
                }
            }
        }
        Ok(())
    }
}

/// Returns a folder with the scene, compressed as `packed.gseq` and uncompressed as `raw.gseq`, and its cameras.
fn scene_workplace() -> Workplace {
    let workplace = Workplace::new();
    for (name, compression) in [("packed.gseq", gseq::Compression::Zstd(1)), ("raw.gseq", gseq::Compression::Raw)] {
        write_container(&ChangingScene::new(), &workplace.path(name), compression, Default::default(), |_| ()).unwrap();
    }
    let camera = r#"{"id": 0, "img_name": "a", "width": 96, "height": 64, "fx": 90, "fy": 90, "position": [0, -4, 0],
        "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}"#;
    std::fs::write(workplace.path("cameras.json"), format!("[{camera}]")).unwrap();
    workplace
}

/// Returns the minimum memory in MiB that a run needs. The message that refuses `--memory 1MiB` states it.
fn minimum_memory(workplace: &Workplace, arguments: &str) -> u64 {
    let run = workplace.run(&format!("{arguments} --memory 1MiB"));
    assert_eq!(run.code, 2, "{}", run.stderr);
    let (_, after) = run.stderr.split_once("at least ").unwrap_or_else(|| panic!("{}", run.stderr));
    after.split_once("MiB").unwrap().0.parse().unwrap()
}

/// Returns the largest resident memory of any stage in the summary of `result`, in MiB, and the name of that stage;
/// `None` if the system does not report it.
fn peak_memory(result: &Path) -> Option<(u64, String)> {
    let text = std::fs::read_to_string(format!("{}.summary.json", result.display())).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
    let of_stage = |stage: &serde_json::Value| {
        Some((stage["peak_memory_bytes"].as_u64()? >> 20, stage["name"].as_str().unwrap_or_default().to_string()))
    };
    said(summary["stages"].as_array().unwrap().iter().filter_map(of_stage).max())
}

/// Returns the memory in MiB that the summary of `result` names for work that was left out for lack of memory; `None` if
/// nothing was left out for this reason.
fn memory_for_the_rest(result: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(format!("{}.summary.json", result.display())).unwrap();
    let (_, after) = text.split_once("memory: expected at least ")?;
    after.split_once("MiB").unwrap().0.parse().ok()
}

#[test]
#[ignore = "needs time"]
fn named_minimum_memory_works_and_changes_no_byte() {
    let workplace = scene_workplace();
    for (input, rest) in [
        ("packed.gseq", "--ratio 0.4 --set refine_steps=30 --set refine_steps_per_prune=5 --as archive"),
        ("packed.gseq", "--no-refine"),
        ("raw.gseq", "--no-refine"),
        ("packed.gseq", "--ratio 0.4 --no-refine"),
        ("packed.gseq", "--ratio 0.3 --set refine_steps=30 --set refine_steps_per_prune=5"),
        ("packed.gseq", "--preset paper"),
    ] {
        let request = |output: &str| format!("compress {input} {REQUEST} {rest} -o {output}/small.gseq --overwrite");
        for name in ["free", "tight"] {
            std::fs::create_dir_all(workplace.path(name)).unwrap();
        }
        workplace.done(&format!("{} --memory 8GiB", request("free")));
        let mut least = minimum_memory(&workplace, &request("tight"));
        let [free, tight] = ["free", "tight"].map(|name| workplace.path(name));
        workplace.done(&format!("{} --memory {least}MiB", request("tight")));
        // With the least memory, parts of refinement may be left out. The summary names the memory that they need.
        while let Some(more) = memory_for_the_rest(&tight.join("small.gseq")) {
            assert!(more > least, "{input} {rest}: {more} MiB for what was left out at {least} MiB");
            least = more;
            workplace.done(&format!("{} --memory {least}MiB", request("tight")));
        }
        if let Some((peak_memory, stage)) = peak_memory(&tight.join("small.gseq")) {
            assert!(peak_memory <= least, "{input} {rest}: {peak_memory} MiB resident in {stage}, {least} promised");
            assert!(least < 63 || rest != "--no-refine", "{input} {rest}: {least} MiB would hold the scene");
        }
        assert!(lasting_files(&free) == lasting_files(&tight), "{input} {rest}: other bytes at {least} MiB");
    }
}

#[test]
#[ignore = "needs time"]
fn every_command_that_reads_frames_keeps_its_memory_limit() {
    let workplace = scene_workplace();
    workplace.done(&format!("compress packed.gseq {REQUEST} --prune-only --ratio 0.5 -o small.gseq"));
    for arguments in [
        format!("score packed.gseq {REQUEST} -o rows.npz"),
        "render packed.gseq --cameras cameras.json --frame 3 --view 0 -o x.png".to_owned(),
        "render packed.gseq --cameras cameras.json --beside small.gseq --video film.gif".to_owned(),
        "evaluate packed.gseq small.gseq --cameras cameras.json --max-frames 2".to_owned(),
        "report packed.gseq small.gseq --cameras cameras.json --max-frames 2 -o page".to_owned(),
        "convert packed.gseq again.gseq".to_owned(),
        "convert packed.gseq small_again.gseq --level 19".to_owned(),
        "convert packed.gseq within.gseq --max-error position=0.1%,rotation=1e-2,log_scale=1e-2,sh=1e-2".to_owned(),
        "convert packed.gseq plys --as ply-sequence".to_owned(),
    ] {
        let least = minimum_memory(&workplace, &arguments);
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
fn plan_is_printed_before_refusal_and_bad_sizes_fail() {
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
fn next_run_cleans_up_after_a_killed_run() {
    let workplace = scene_workplace();
    let request = "--cameras cameras.json --split all --set frame_stride=24 --ratio 0.5 -o small.gseq";
    let least = minimum_memory(&workplace, &format!("compress packed.gseq {request}"));
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
        let mut child = Command::new(program())
            .current_dir(workplace.path(""))
            .args(arguments.split_whitespace())
            .stderr(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        if kill % 2 == 0 {
            std::thread::sleep(whole * (kill + 1) / KILLS);
        } else {
            // The next run first removes the temporary files of the run before; then its own temporary files appear.
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
