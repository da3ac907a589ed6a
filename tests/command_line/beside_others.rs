//! Tests of runs beside other runs, other programs and foreign files. A run leaves foreign files alone and removes its
//! own temporary files, however it ends.

#![cfg(unix)]

use std::fs;
use std::io::Write;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::scene::{Workplace, files, lasting_files, program, stderr_text, tiny};

/// Returns the tiny model as a frame stream.
fn tiny_stream(workplace: &Workplace) -> Vec<u8> {
    let output = Command::new(program()).arg("convert").arg(tiny()).arg("-").output().unwrap();
    assert!(output.status.success(), "{}", workplace.path("").display());
    output.stdout
}

/// Starts a command in the workplace with pipes for standard input, output and error.
fn start_piped(workplace: &Workplace, mut command: Command) -> Child {
    let piped = command.current_dir(workplace.path("")).stdin(Stdio::piped());
    piped.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Starts the program, which waits for its standard input. Resets the signal handlers to their defaults first, because
/// the test process may ignore signals (a shell ignores some for jobs in the background).
fn start_program(workplace: &Workplace, arguments: &str) -> Child {
    let mut command = Command::new(program());
    command.args(arguments.split_whitespace());
    let reset = || {
        for signal in [libc::SIGINT, libc::SIGTERM, libc::SIGHUP] {
            // SAFETY: the default action is a valid disposition of each of these signals.
            unsafe { libc::signal(signal, libc::SIG_DFL) };
        }
        Ok(())
    };
    // SAFETY: `signal` is async-signal-safe, so it may be called between fork and exec; the closure calls nothing else.
    unsafe { command.pre_exec(reset) };
    start_piped(workplace, command)
}

/// Waits until `folder` holds a file. Panics if the run ends before that or after 60 s.
fn wait_for_temporaries(folder: &Path, child: &mut Child) {
    let start = Instant::now();
    while files(folder).is_empty() {
        assert!(start.elapsed() < Duration::from_secs(60), "nothing appeared in {}", folder.display());
        assert!(child.try_wait().unwrap().is_none(), "the run ended");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn send(signal: &str, child: &Child) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
}

/// Returns a command that runs the program as in a container: in a namespace of process ids of its own, in which the
/// program's id is above `before`.
fn in_container(workplace: &Workplace, before: usize, arguments: &str) -> Command {
    let mut command = crate::unshare(&["-p", "--fork", "--mount-proc"]);
    // Processes that have ended take every process id up to `before`.
    let script = format!("for i in $(seq {before}); do /bin/true; done; {} {arguments}; exit $?", program().display());
    command.args(["sh", "-c", &script]).current_dir(workplace.path(""));
    command
}

#[test]
#[ignore = "needs namespaces of process ids"]
fn runs_in_different_containers_can_share_folders() {
    let workplace = Workplace::new();
    let tiny_stream = tiny_stream(&workplace);
    fs::create_dir(workplace.path("scratch")).unwrap();
    for (first, second) in [
        ("compress - -o a.gseq --scratch-dir scratch", "compress - -o b.gseq --scratch-dir scratch"),
        // Two runs with the same output: the one that finishes last is refused, and removes no file of the other.
        ("convert - c.gseq", "convert - c.gseq"),
    ] {
        let command = in_container(&workplace, 12, first);
        let before = files(&workplace.path("")).len();
        let mut victim = start_piped(&workplace, command);
        let mut pipe = victim.stdin.take().unwrap();
        pipe.write_all(&tiny_stream[..tiny_stream.len() / 2]).unwrap();
        let start = Instant::now();
        // Waits for the scratch file, or for the temporary file of the output.
        while files(&workplace.path("")).len() == before {
            assert!(start.elapsed() < Duration::from_secs(60) && victim.try_wait().unwrap().is_none());
            std::thread::sleep(Duration::from_millis(5));
        }
        std::thread::sleep(Duration::from_millis(100));
        let mut other = start_piped(&workplace, in_container(&workplace, 2, second));
        other.stdin.take().unwrap().write_all(&tiny_stream).unwrap();
        let other = other.wait_with_output().unwrap();
        assert!(other.status.success(), "{second}: {}", stderr_text(&other));
        let finished = pipe.write_all(&tiny_stream[tiny_stream.len() / 2..]);
        drop(pipe);
        let victim = victim.wait_with_output().unwrap();
        if first == second {
            assert!(stderr_text(&victim).contains("exists already"), "{first}: {}", stderr_text(&victim));
            assert_eq!(victim.status.code(), Some(2));
        } else {
            assert!(victim.status.success() && finished.is_ok(), "{first}: {}", stderr_text(&victim));
        }
    }
    let left = lasting_files(&workplace.path(""));
    assert!(left[Path::new("a.gseq")] == left[Path::new("b.gseq")], "the same stream gives the same result");
    assert!(left.keys().all(|name| !name.to_str().unwrap().contains(".splatsieve")), "{:?}", left.keys());
}

#[test]
fn signal_removes_partial_files_and_sets_exit_code() {
    let workplace = Workplace::new();
    let half = tiny_stream(&workplace);
    let half = &half[..half.len() / 2];
    for (signal, code) in [("-INT", 130), ("-TERM", 143), ("-HUP", 129)] {
        for (arguments, input) in [
            ("compress - -o out --scratch-dir scratch", half),
            ("convert - out.gseq", half),
            ("test-scene --gaussians 100000 --frames 400 -o demo", &[]),
        ] {
            fs::create_dir(workplace.path("scratch")).unwrap();
            let mut child = start_program(&workplace, arguments);
            let mut pipe = child.stdin.take().unwrap();
            pipe.write_all(input).unwrap();
            let place = if arguments.contains("scratch") { "scratch" } else { "" };
            if place.is_empty() {
                fs::remove_dir(workplace.path("scratch")).unwrap();
            }
            wait_for_temporaries(&workplace.path(place), &mut child);
            std::thread::sleep(Duration::from_millis(100));
            send(signal, &child);
            let output = child.wait_with_output().unwrap();
            assert_eq!(output.status.code(), Some(code), "{signal} {arguments}: {}", stderr_text(&output));
            _ = fs::remove_dir(workplace.path("scratch"));
            let left = files(&workplace.path(""));
            assert!(left.is_empty(), "{signal} {arguments}: left {:?}", left.keys());
        }
    }
}

#[test]
fn signal_ignored_at_start_stays_ignored() {
    let workplace = Workplace::new();
    let tiny_stream = tiny_stream(&workplace);
    let mut command = Command::new("sh");
    command.args(["-c", &format!("trap '' HUP INT; exec {} convert - out.gseq", program().display())]);
    let mut child = start_piped(&workplace, command);
    let mut pipe = child.stdin.take().unwrap();
    pipe.write_all(&tiny_stream[..tiny_stream.len() / 2]).unwrap();
    wait_for_temporaries(&workplace.path(""), &mut child);
    send("-HUP", &child);
    send("-INT", &child);
    std::thread::sleep(Duration::from_millis(200));
    pipe.write_all(&tiny_stream[tiny_stream.len() / 2..]).unwrap();
    drop(pipe);
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", stderr_text(&output));
    assert_eq!(files(&workplace.path("")).len(), 1);
}

#[test]
#[ignore = "needs time"]
fn overwrite_keeps_files_of_other_programs() {
    let workplace = Workplace::new();
    workplace.done("compress {tiny} -o out");
    // Files that the evaluation code of the trainers writes into a model folder.
    let foreign = ["results.json", "test/ours_7/renders/00000.png", "point_cloud/iteration_7/notes.txt"];
    for name in foreign {
        fs::create_dir_all(workplace.path("out").join(name).parent().unwrap()).unwrap();
        fs::write(workplace.path("out").join(name), "precious").unwrap();
    }
    workplace.done("compress {tiny} -o out --count 50 --overwrite");
    for name in foreign {
        assert_eq!(fs::read(workplace.path("out").join(name)).ok().as_deref(), Some(&b"precious"[..]), "{name}");
    }
    workplace.done("compress {tiny} -o fresh --count 50");
    let [mut left, mut expected] = ["out", "fresh"].map(|name| lasting_files(&workplace.path(name)));
    left.retain(|name, bytes| !bytes.is_empty() && !foreign.contains(&name.to_str().unwrap()));
    expected.retain(|_, bytes| !bytes.is_empty());
    assert!(left == expected, "{:?}, not {:?}", left.keys(), expected.keys());
    // Frames of the earlier result that the new result does not have are removed.
    workplace.done("convert {tiny} frames --as ply-sequence");
    fs::write(workplace.path("frames/notes.txt"), "precious").unwrap();
    workplace.done("test-scene --gaussians 400 --frames 3 -o shorter");
    workplace.done("convert shorter/scene.gseq frames --as ply-sequence --overwrite");
    let plys = fs::read_dir(workplace.path("frames")).unwrap().map(|entry| entry.unwrap().path());
    assert_eq!(plys.filter(|path| path.extension().is_some_and(|e| e == "ply")).count(), 3);
    assert_eq!(fs::read(workplace.path("frames/notes.txt")).unwrap(), b"precious");
    let hidden = fs::read_dir(workplace.path("")).unwrap().map(|entry| entry.unwrap().file_name());
    assert_eq!(hidden.filter(|name| name.to_str().unwrap().starts_with('.')).count(), 0);
}

#[test]
#[ignore = "needs time"]
fn killed_run_leaves_old_or_new_output_and_foreign_files() {
    let workplace = Workplace::new();
    workplace.done("test-scene --gaussians 400 --frames 3 -o shorter");
    workplace.done("convert shorter/scene.gseq old --as ply-sequence");
    let start = Instant::now();
    workplace.done("convert {tiny} new --as ply-sequence");
    let whole = start.elapsed();
    let [old, new] = ["old", "new"].map(|name| lasting_files(&workplace.path(name)));
    let reset = || workplace.done("convert shorter/scene.gseq frames --as ply-sequence --overwrite");
    reset();
    fs::write(workplace.path("frames/notes.txt"), "precious").unwrap();
    const ENDS: u32 = 24;
    for end in 0..ENDS {
        let mut child =
            start_program(&workplace, &format!("convert {} frames --as ply-sequence --overwrite", tiny().display()));
        std::thread::sleep(whole * end / ENDS);
        let is_terminated = end % 2 == 0;
        if is_terminated {
            // The run may have ended already.
            _ = Command::new("kill").arg(child.id().to_string()).stderr(Stdio::null()).status();
        } else {
            child.kill().unwrap();
        }
        child.wait().unwrap();
        let output = workplace.path("frames");
        let mut found = if output.exists() { lasting_files(&output) } else { Default::default() };
        let notes = found.remove(Path::new("notes.txt"));
        assert!(found == old || found == new || (found.is_empty() && !is_terminated), "{end}: {:?}", found.keys());
        if is_terminated {
            assert_eq!(notes.as_deref(), Some(&b"precious"[..]), "{end}");
            let mut left = files(&workplace.path(""));
            left.retain(|name, _| name.to_str().unwrap().starts_with('.'));
            assert!(left.is_empty(), "{end}: {:?}", left.keys());
        }
        reset();
        assert_eq!(fs::read(workplace.path("frames/notes.txt")).unwrap(), b"precious", "{end}");
    }
}

#[test]
fn existing_files_are_replaced_only_with_overwrite() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} scene.gseq");
    for (verb, name) in [
        ("convert {tiny} -o", "a.gseq"),
        ("compress {tiny} --as ply -o", "a.ply"),
        ("score {tiny} -o", "a.csv"),
        ("score {tiny} -o", "a.npz"),
        ("render {tiny} --cameras {tiny} --frame 0 --view 0 -o", "a.png"),
        ("evaluate {tiny} scene.gseq --cameras {tiny} --max-frames 1 --csv", "b.csv"),
        ("info scene.gseq --repair", "b.gseq"),
    ] {
        fs::write(workplace.path(name), "precious").unwrap();
        workplace.refused(2, &format!("{verb} {name}"), &[name, "exists already", "--overwrite"]);
        workplace.done(&format!("{verb} {name} --overwrite"));
        assert_ne!(fs::read(workplace.path(name)).unwrap(), b"precious");
    }
    // Results and the files beside them are replaced too; other files stay.
    workplace.done("convert {tiny} a.gseq --overwrite");
    workplace.done("compress {tiny} --as ply -o a.ply --overwrite --count 100");
    fs::write(workplace.path("a.ply.mine"), "precious").unwrap();
    workplace.done("compress {tiny} --as ply -o a.ply --overwrite");
    assert_eq!(fs::read(workplace.path("a.ply.mine")).unwrap(), b"precious");
}

#[test]
fn log_has_one_line_per_stage_and_quiet_none() {
    let workplace = Workplace::new();
    let run = workplace.run("compress {tiny} --cameras {tiny} -o out.gseq");
    assert_eq!(run.code, 0, "{}", run.stderr);
    for stage in ["scan", "visible", "score", "refine", "emit"] {
        let lines: Vec<&str> = run.stderr.lines().filter(|line| line.contains(&format!("] {stage}  "))).collect();
        assert_eq!(lines.len(), 1, "{stage}: {}", run.stderr);
        assert!(lines[0].starts_with('[') && lines[0].contains("/s, ") && lines[0].ends_with(" s"), "{}", lines[0]);
    }
    assert!(!run.stderr.contains('\r') && !run.stderr.contains('\x1b'), "{:?}", run.stderr);
    let quiet = workplace.run("compress {tiny} -o quiet.gseq --quiet");
    assert_eq!((quiet.code, quiet.stderr.as_str()), (0, ""));
}

#[test]
fn run_prints_its_estimate_before_any_work() {
    let workplace = Workplace::new();
    let real = workplace.run("compress {tiny} --cameras {tiny} -o real.gseq --no-refine");
    let first: Vec<&str> = real.stderr.lines().take(2).collect();
    assert!(first[0].starts_with("time: ") && first[1].starts_with("memory: at most "), "{}", real.stderr);
    let run = workplace.done("compress {tiny} --cameras {tiny} -o out.gseq --dry-run");
    assert!(run.contains("\ntime: ") && run.contains("\nwould write out.gseq, out.gseq.recipe.toml"), "{run}");
    let planned = workplace.run("compress {tiny} --cameras {tiny} -o out.gseq --dry-run --explain");
    assert!(planned.stderr.starts_with("budget: ") && planned.stderr.contains("\n  scan "), "{}", planned.stderr);
    let explained = workplace.run("compress {tiny} --cameras {tiny} -o out.gseq --explain");
    let place = |what: &str| explained.stderr.find(what).unwrap_or_else(|| panic!("{what}: {}", explained.stderr));
    assert!(place("\ntime: ") < place("] scan  ") && place("\ncore-seconds: scan ") < place("] scan  "));
    let quiet = workplace.run("compress {tiny} -o other.gseq --dry-run --quiet");
    assert_eq!((quiet.code, quiet.stderr.as_str()), (0, ""));
}
