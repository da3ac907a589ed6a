//! Tests of runs that are interrupted and resumed from their cache: they write the same bytes and repeat no finished
//! work.
//!
//! `SPLATSIEVE_PROGRAM` may name an optimized program to run in place of the one built with this test.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime};

use crate::scene::{Workplace, program, stderr_text};

/// Arguments of a run in which every stage can be cached. It keeps many Gaussians, compared with the size of the scene.
const RUN: &str = "compress scene/scene.gseq --cameras scene/cameras.json --quiet --ratio 0.2 --set refine_steps=150";

fn command(workplace: &Workplace, arguments: &str) -> Command {
    let mut command = Command::new(program());
    command.current_dir(workplace.path("")).args(arguments.split_whitespace());
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn run_program(workplace: &Workplace, arguments: &str) -> Output {
    command(workplace, arguments).output().unwrap()
}

fn workplace_with_scene(gaussians: usize) -> Workplace {
    let workplace = Workplace::new();
    let output =
        run_program(&workplace, &format!("test-scene --gaussians {gaussians} --frames 8 -o scene --quiet --no-refine"));
    assert!(output.status.success(), "{}", stderr_text(&output));
    workplace
}

/// Returns the files of the result `name` except its summary, which contains times.
fn result_files(workplace: &Workplace, name: &str) -> BTreeMap<OsString, Vec<u8>> {
    let mut found = BTreeMap::new();
    for ending in ["", ".recipe.toml", ".index_map.npy"] {
        let path = workplace.path(&format!("{name}{ending}"));
        found.insert(ending.into(), fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display())));
    }
    found
}

/// Returns the name and the modification time of every cache entry. Entries that are overwritten while their stage runs
/// are left out.
fn cache_entries(folder: &Path) -> BTreeMap<String, SystemTime> {
    let Ok(entries) = fs::read_dir(folder) else { return BTreeMap::new() };
    let entry_time =
        |entry: fs::DirEntry| Some((entry.file_name().into_string().ok()?, entry.metadata().ok()?.modified().ok()?));
    let entries = entries.filter_map(|entry| entry_time(entry.unwrap()));
    entries.filter(|(name, _)| name.ends_with(".piece") && !name.starts_with("refine-steps.")).collect()
}

/// Kills runs with a cache at `kills` moments in total. A killed run is resumed from its cache; when it completes, the
/// next run begins with an empty cache. Checks the result of every complete run.
fn check_killed_runs(gaussians: usize, kills: usize) {
    let workplace = workplace_with_scene(gaussians);
    let start = Instant::now();
    let output = run_program(&workplace, &format!("{RUN} -o plain.gseq"));
    let whole = start.elapsed();
    assert!(output.status.success(), "{}", stderr_text(&output));
    let expected = result_files(&workplace, "plain.gseq");
    let (mut done, mut runs, mut steps) = (0, 0, 0);
    while done < kills {
        runs += 1;
        let (work, target) = (workplace.path(&format!("work{runs}")), format!("killed{runs}.gseq"));
        // A run may be killed after it has written its output.
        let arguments = format!("{RUN} -o {target} --cache work{runs} --overwrite");
        let mut kept = BTreeMap::new();
        let ended = loop {
            let mut child = command(&workplace, &arguments).spawn().unwrap();
            // Moments spread over the whole run, the same in every execution of this test.
            let part = (0.05 + 0.618_034 * (done + runs) as f64).fract();
            sleep(whole.mul_f64(0.5 * part));
            if let Some(_ended) = child.try_wait().unwrap() {
                break child.wait_with_output().unwrap();
            }
            child.kill().unwrap();
            child.wait().unwrap();
            done += 1;
            let now = cache_entries(&work);
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
        assert!(ended.status.success(), "{}", stderr_text(&ended));
        assert_eq!(result_files(&workplace, &target), expected, "run {runs}");
    }
    println!("{done} kills in {runs} runs of {:.1} s, {steps} of them while steps were kept", whole.as_secs_f64());
    assert!(steps > 0, "nothing was refined yet, whenever it was killed");
}

#[test]
#[ignore = "needs time"]
fn resumed_run_writes_the_same_bytes() {
    check_killed_runs(700, 6);
}

#[test]
#[ignore = "slow: some minutes"]
fn slow_run_resumed_50_times_writes_the_same_bytes() {
    check_killed_runs(4000, 50);
}

#[cfg(unix)]
#[test]
fn terminated_run_leaves_a_valid_cache_and_exits_143() {
    let workplace = workplace_with_scene(700);
    let arguments = format!("{RUN} -o told.gseq --cache work");
    let child = command(&workplace, &arguments).spawn().unwrap();
    while cache_entries(&workplace.path("work")).len() < 4 {
        sleep(Duration::from_millis(5));
    }
    Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(143), "{}", stderr_text(&output));
    let listed = run_program(&workplace, "cache work --json");
    let listed: serde_json::Value = serde_json::from_slice(&listed.stdout).unwrap();
    let listed = listed.as_array().unwrap();
    assert!(listed.len() >= 4 && listed.iter().all(|of| of["damaged"].as_array().unwrap().is_empty()), "{listed:?}");
    assert!(run_program(&workplace, &arguments).status.success());
    assert!(run_program(&workplace, &format!("{RUN} -o plain.gseq")).status.success());
    assert_eq!(result_files(&workplace, "told.gseq"), result_files(&workplace, "plain.gseq"));
}

#[test]
fn two_runs_with_one_cache_write_the_same_bytes() {
    let workplace = workplace_with_scene(700);
    let runs = ["one", "two", "three"]
        .map(|name| (name, command(&workplace, &format!("{RUN} -o {name}.gseq --cache work")).spawn().unwrap()));
    for (name, child) in runs {
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{name}: {}", stderr_text(&output));
    }
    let [one, two, three] = ["one", "two", "three"].map(|name| result_files(&workplace, &format!("{name}.gseq")));
    assert!(one == two && two == three);
    let left = fs::read_dir(workplace.path("work")).unwrap().map(|entry| entry.unwrap().file_name());
    assert!(left.into_iter().all(|name| name.to_str().unwrap().ends_with(".piece")), "something unfinished is left");
}

#[test]
fn changed_recipe_recomputes_only_dependent_stages() {
    let workplace = workplace_with_scene(700);
    let run = |name: &str, options: &str| {
        let before = cache_entries(&workplace.path("work"));
        let run = RUN
            .replace("--set refine_steps=150", if options.contains("steps") { "" } else { "--set refine_steps=150" });
        let output = run_program(&workplace, &format!("{run} -o {name}.gseq --cache work {options}"));
        assert!(output.status.success(), "{}", stderr_text(&output));
        let after = cache_entries(&workplace.path("work"));
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
    assert_eq!(no_steps(run("steps", "--set refine_steps=160")), ["refine"]);
    // Frames and target views are not read again. Ranking by fewer views is computed again; later stages only if the
    // ranking differs.
    let fewer = run("fewer", "--set scoring_views=12");
    let is_new = |stage: &str| fewer.iter().any(|name| name == stage);
    assert!(is_new("visible") && is_new("score") && is_new("rounds"), "{fewer:?}");
    assert!(!is_new("scan") && !is_new("input") && !is_new("targets"), "{fewer:?}");
    let threads = ["--threads 1", "--memory 600MiB"].map(|options| run("elsewhere", &format!("{options} --overwrite")));
    assert_eq!(threads, [[""; 0], [""; 0]], "threads and memory change no result");
}

#[test]
fn streams_cannot_resume_and_shards_need_a_cache() {
    let workplace = Workplace::new();
    let output = run_program(&workplace, "compress - -o out.gseq --cache work");
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr_text(&output).contains("splatsieve convert -"), "{}", stderr_text(&output));
    for (arguments, part) in [
        ("compress in.gseq -o out.gseq --shard 1/2", "--cache"),
        ("compress in.gseq -o out.gseq --cache work --shard 3/2", "3/8"),
        ("cache nowhere", "nowhere"),
    ] {
        let output = run_program(&workplace, arguments);
        assert!(
            !output.status.success() && stderr_text(&output).contains(part),
            "{arguments}: {}",
            stderr_text(&output)
        );
    }
}

/// Puts the cache on a small file system that becomes full during the run. Needs a system that allows tests to mount
/// one.
#[test]
#[ignore = "needs namespaces of process ids"]
fn full_cache_disk_is_named_and_a_larger_one_resumes() {
    let workplace = workplace_with_scene(700);
    fs::create_dir(workplace.path("disk")).unwrap();
    let run = format!("{RUN} -o full.gseq --cache disk/work");
    let script = format!(
        "mount -t tmpfs -o size=300k none disk && ({0} {run}; echo \"code $?\" >&2; mount -o remount,size=300m disk && {0} {run})",
        program().display()
    );
    let mut shell = crate::unshare(&["-m"]);
    let output = shell.args(["sh", "-c", &script]).current_dir(workplace.path("")).output().unwrap();
    let stderr_text = stderr_text(&output);
    assert!(output.status.success(), "{stderr_text}");
    assert!(
        stderr_text.contains("code 1") && stderr_text.contains("disk/work") && stderr_text.contains("No space left"),
        "{stderr_text}"
    );
    assert!(run_program(&workplace, &format!("{RUN} -o plain.gseq")).status.success());
    assert_eq!(result_files(&workplace, "full.gseq"), result_files(&workplace, "plain.gseq"));
}
