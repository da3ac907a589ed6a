//! Runs that are cut short, and go on from their work folder: the same bytes, and nothing done twice that was done.
//!
//! `SPLATSIEVE_PROGRAM` names another program to run than the one built with this test: an optimized one.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime};

use crate::scene::{Workplace, program};

/// A scene of many Gaussians for its size on the disk, and a run of all that can be kept.
const RUN: &str =
    "compress scene/scene.gseq --cameras scene/cameras.json --quiet --target-ratio 0.2 --refine-steps 150";

fn command(workplace: &Workplace, arguments: &str) -> Command {
    let mut command = Command::new(program());
    command.current_dir(workplace.path("")).args(arguments.split_whitespace());
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn ran(workplace: &Workplace, arguments: &str) -> Output {
    command(workplace, arguments).output().unwrap()
}

fn told(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn made(gaussians: usize) -> Workplace {
    let workplace = Workplace::new();
    let output =
        ran(&workplace, &format!("test-scene --gaussians {gaussians} --frames 8 -o scene --quiet --no-refine"));
    assert!(output.status.success(), "{}", told(&output));
    workplace
}

/// A result but for its summary, in which times are.
fn result(workplace: &Workplace, name: &str) -> BTreeMap<OsString, Vec<u8>> {
    let mut found = BTreeMap::new();
    for ending in ["", ".recipe.toml", ".index_map.npy"] {
        let path = workplace.path(&format!("{name}{ending}"));
        found.insert(ending.into(), fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display())));
    }
    found
}

/// Every piece of a work folder, but for those that are written over while their stage goes on: when it was written.
fn pieces(folder: &Path) -> BTreeMap<String, SystemTime> {
    let Ok(entries) = fs::read_dir(folder) else { return BTreeMap::new() };
    let of =
        |entry: fs::DirEntry| Some((entry.file_name().into_string().ok()?, entry.metadata().ok()?.modified().ok()?));
    let entries = entries.filter_map(|entry| of(entry.unwrap()));
    entries.filter(|(name, _)| name.ends_with(".piece") && !name.starts_with("refine-steps.")).collect()
}

/// Kills a run with a work folder at `kills` moments, spread over as many runs as that takes.
fn killed(gaussians: usize, kills: usize) {
    let workplace = made(gaussians);
    let start = Instant::now();
    let output = ran(&workplace, &format!("{RUN} -o plain.gseq"));
    let whole = start.elapsed();
    assert!(output.status.success(), "{}", told(&output));
    let expected = result(&workplace, "plain.gseq");
    let (mut done, mut runs, mut steps) = (0, 0, 0);
    while done < kills {
        runs += 1;
        let (work, target) = (workplace.path(&format!("work{runs}")), format!("killed{runs}.gseq"));
        let arguments = format!("{RUN} -o {target} --work work{runs}");
        let mut kept = BTreeMap::new();
        let ended = loop {
            let mut child = command(&workplace, &arguments).spawn().unwrap();
            // Moments of all lengths, the same in every run of this test.
            let part = (0.05 + 0.618_034 * (done + runs) as f64).fract();
            sleep(whole.mul_f64(0.5 * part));
            if let Some(_ended) = child.try_wait().unwrap() {
                break child.wait_with_output().unwrap();
            }
            child.kill().unwrap();
            child.wait().unwrap();
            done += 1;
            let now = pieces(&work);
            for (name, written) in &kept {
                assert_eq!(now.get(name), Some(written), "{name} was computed again, or has gone");
            }
            kept = now;
            steps += usize::from(fs::read_dir(&work).is_ok_and(|found| {
                found
                    .filter_map(|entry| entry.unwrap().file_name().into_string().ok())
                    .any(|name| name.starts_with("refine-steps."))
            }));
            assert!(done < 20 * kills, "it never ends");
        };
        assert!(ended.status.success(), "{}", told(&ended));
        assert_eq!(result(&workplace, &target), expected, "run {runs}");
    }
    println!("{done} kills in {runs} runs of {:.1} s, {steps} of them while steps were kept", whole.as_secs_f64());
    assert!(steps > 0, "nothing was refined yet, whenever it was killed");
}

#[test]
#[ignore = "needs time"]
fn a_run_killed_at_some_moments_goes_on_and_writes_the_same_bytes() {
    killed(700, 6);
}

#[test]
#[ignore = "slow: some minutes"]
fn slow_a_run_killed_at_50_moments_goes_on_and_writes_the_same_bytes() {
    killed(4000, 50);
}

#[cfg(unix)]
#[test]
fn a_run_told_to_end_leaves_a_valid_folder_and_exits_with_143() {
    let workplace = made(700);
    let arguments = format!("{RUN} -o told.gseq --work work");
    let child = command(&workplace, &arguments).spawn().unwrap();
    while pieces(&workplace.path("work")).len() < 4 {
        sleep(Duration::from_millis(5));
    }
    Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(143), "{}", told(&output));
    let listed = ran(&workplace, "work work --json");
    let listed: serde_json::Value = serde_json::from_slice(&listed.stdout).unwrap();
    let listed = listed.as_array().unwrap();
    assert!(listed.len() >= 4 && listed.iter().all(|of| of["damaged"].as_array().unwrap().is_empty()), "{listed:?}");
    assert!(ran(&workplace, &arguments).status.success());
    assert!(ran(&workplace, &format!("{RUN} -o plain.gseq")).status.success());
    assert_eq!(result(&workplace, "told.gseq"), result(&workplace, "plain.gseq"));
}

#[test]
fn two_runs_in_one_work_folder_write_the_same_bytes() {
    let workplace = made(700);
    let runs = ["one", "two", "three"]
        .map(|name| (name, command(&workplace, &format!("{RUN} -o {name}.gseq --work work")).spawn().unwrap()));
    for (name, child) in runs {
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{name}: {}", told(&output));
    }
    let [one, two, three] = ["one", "two", "three"].map(|name| result(&workplace, &format!("{name}.gseq")));
    assert!(one == two && two == three);
    let left = fs::read_dir(workplace.path("work")).unwrap().map(|entry| entry.unwrap().file_name());
    assert!(left.into_iter().all(|name| name.to_str().unwrap().ends_with(".piece")), "something unfinished is left");
}

#[test]
fn a_changed_recipe_computes_only_what_depends_on_it() {
    let workplace = made(700);
    let run = |name: &str, options: &str| {
        let before = pieces(&workplace.path("work"));
        let run = RUN.replace("--refine-steps 150", if options.contains("steps") { "" } else { "--refine-steps 150" });
        let output = ran(&workplace, &format!("{run} -o {name}.gseq --work work {options}"));
        assert!(output.status.success(), "{}", told(&output));
        let after = pieces(&workplace.path("work"));
        assert!(before.iter().all(|(name, written)| after.get(name) == Some(written)), "a piece was written again");
        let stage = |name: &String| {
            name.split('.').next().unwrap().trim_end_matches(|c: char| "-0123456789".contains(c)).to_owned()
        };
        let mut new: Vec<String> = after.keys().filter(|name| !before.contains_key(*name)).map(stage).collect();
        new.dedup();
        new
    };
    let all = run("first", "");
    for stage in ["input", "scan", "visible", "score", "rounds", "targets", "refine"] {
        assert!(all.iter().any(|name| name == stage), "{stage} is not kept: {all:?}");
    }
    assert_eq!(run("again", ""), [""; 0]);
    let no_steps =
        |new: Vec<String>| new.into_iter().filter(|name| name != "refine-cut" && name != "bands").collect::<Vec<_>>();
    assert_eq!(no_steps(run("steps", "--refine-steps 160")), ["refine"]);
    // Frames and targets are not read again; what was ranked by fewer pictures is, and what follows only if it differs.
    let look = run("look", "--look-pictures 12");
    let is_new = |stage: &str| look.iter().any(|name| name == stage);
    assert!(is_new("visible") && is_new("score") && is_new("rounds"), "{look:?}");
    assert!(!is_new("scan") && !is_new("input") && !is_new("targets"), "{look:?}");
    let threads = ["--threads 1", "--memory 600MiB"].map(|options| run("elsewhere", &format!("{options} --overwrite")));
    assert_eq!(threads, [[""; 0], [""; 0]], "threads and memory change no result");
}

#[test]
fn a_stream_cannot_be_gone_on_with_and_a_part_needs_a_folder() {
    let workplace = Workplace::new();
    let output = ran(&workplace, "compress - -o out.gseq --work work");
    assert_eq!(output.status.code(), Some(2));
    assert!(told(&output).contains("splatsieve pack -"), "{}", told(&output));
    for (arguments, part) in [
        ("compress in.gseq -o out.gseq --part 1/2", "--work"),
        ("compress in.gseq -o out.gseq --work work --part 3/2", "3/8"),
        ("work nowhere", "nowhere"),
    ] {
        let output = ran(&workplace, arguments);
        assert!(!output.status.success() && told(&output).contains(part), "{arguments}: {}", told(&output));
    }
}

/// A disk that is full, of its own: where the system lets a test make one.
#[test]
#[ignore = "needs namespaces of process ids"]
fn a_full_disk_under_the_work_folder_is_named_and_more_room_goes_on() {
    let workplace = made(700);
    fs::create_dir(workplace.path("disk")).unwrap();
    let run = format!("{RUN} -o full.gseq --work disk/work");
    let script = format!(
        "mount -t tmpfs -o size=300k none disk && ({0} {run}; echo \"code $?\" >&2; mount -o remount,size=300m disk && {0} {run})",
        program().display()
    );
    let mut shell = crate::unshare(&["-m"]);
    let output = shell.args(["sh", "-c", &script]).current_dir(workplace.path("")).output().unwrap();
    let told = told(&output);
    assert!(output.status.success(), "{told}");
    assert!(told.contains("code 1") && told.contains("disk/work") && told.contains("No space left"), "{told}");
    assert!(ran(&workplace, &format!("{RUN} -o plain.gseq")).status.success());
    assert_eq!(result(&workplace, "full.gseq"), result(&workplace, "plain.gseq"));
}
