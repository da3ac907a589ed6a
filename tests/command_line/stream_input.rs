//! Tests of sequences on standard input: results equal those of the same frames in a file, a broken stream leaves no
//! files, and other programs can write and read streams.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use crate::scene::{Workplace, files, lasting_files, state, tiny};
use gseq::{Reader, TileId};
use splatsieve::files::container::Container;
use splatsieve::source::FrameSource;

fn splatsieve(workplace: &Workplace, arguments: &str) -> Command {
    let mut command = workplace.command(arguments);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn done(output: Output) -> Vec<u8> {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

/// Returns the tiny model as a stream.
fn tiny_stream(workplace: &Workplace) -> Vec<u8> {
    done(workplace.piped("convert {tiny} -", b""))
}

/// Returns the names of leftover files in a folder: hidden files and scratch files of the program.
fn leftover_files(folder: &Path) -> Vec<PathBuf> {
    files(folder).into_keys().filter(|name| name.to_str().unwrap().contains("splatsieve")).collect()
}

#[test]
#[ignore = "needs time"]
fn stream_and_packed_file_give_the_same_bytes() {
    let workplace = Workplace::new();
    let stream = tiny_stream(&workplace);
    done(workplace.piped("convert - packed.gseq", &stream));
    // Frames are scanned once, as they arrive. All views can be rendered then; a hundred evenly spread views are known
    // only at the end.
    let (as_it_arrives, at_the_end): (&[&str], &[&str]) = (&["receive", "score"], &["receive", "visible", "score"]);
    for (name, rest, first) in [
        ("default", "--cameras {tiny}", at_the_end),
        ("all", "--cameras {tiny} --set scoring_views=0", as_it_arrives),
        ("paper", "--cameras {tiny} --preset paper", as_it_arrives),
        (
            "merged",
            "--cameras {tiny} --ratio 0.3 --set frame_stride=3 --set view_stride=2 --set scoring_views=0",
            as_it_arrives,
        ),
        ("rig", "", as_it_arrives),
    ] {
        workplace.done(&format!("compress packed.gseq -o {name}.gseq {rest}"));
        let map = fs::read(workplace.path(&format!("{name}.gseq.index_map.npy"))).unwrap();
        let expected = [".gseq", ".gseq.recipe.toml", ".gseq.index_map.npy"]
            .map(|ending| fs::read(workplace.path(&format!("{name}{ending}"))).unwrap());
        assert_eq!(expected[2], map);
        for threads in [1, 3] {
            let arguments = format!("compress - -o {name}{threads}.gseq {rest} --threads {threads} --json");
            let summary: serde_json::Value =
                serde_json::from_slice(&done(workplace.piped(&arguments, &stream))).unwrap();
            for (ending, expected) in [".gseq", ".gseq.recipe.toml", ".gseq.index_map.npy"].iter().zip(&expected) {
                let found = fs::read(workplace.path(&format!("{name}{threads}{ending}"))).unwrap();
                assert!(found == *expected, "{name}{ending} on {threads} threads");
            }
            let stages: Vec<&str> =
                summary["stages"].as_array().unwrap().iter().map(|stage| stage["name"].as_str().unwrap()).collect();
            assert!(stages.starts_with(first), "{name}: {stages:?}");
        }
    }
    assert!(leftover_files(&workplace.path("")).is_empty());
}

#[test]
fn stream_packs_within_bounds_like_a_file() {
    let workplace = Workplace::new();
    let stream = tiny_stream(&workplace);
    let bounds = "--max-error position=2e-3,sh=1e-2";
    done(workplace.piped(&format!("convert - stream.gseq {bounds}"), &stream));
    workplace.done(&format!("convert {{tiny}} file.gseq {bounds}"));
    let [stream_of, file] =
        ["stream", "file"].map(|name| Reader::open(workplace.path(&format!("{name}.gseq"))).unwrap());
    for column in 0..5 {
        let at = TileId { column, gaussian_block: 0, frame_block: 0 };
        assert_eq!(stream_of.tile_info(at).unwrap().checksum, file.tile_info(at).unwrap().checksum, "{at:?}");
    }
    // Raw tiles, and the table of their positions.
    let larger = String::from_utf8(done(workplace.piped("convert - raw.gseq --raw", &stream))).unwrap();
    assert!(
        larger.contains(&format!("bytes instead of {}: the input stores its values in fewer", stream.len())),
        "{larger}"
    );
    let refused = workplace.piped("convert - x.gseq --max-error position=1%", &stream);
    let message = String::from_utf8_lossy(&refused.stderr);
    assert!(refused.status.code() == Some(2) && message.contains("expected scene units"), "{message}");
    assert!(!workplace.path("x.gseq").exists());
}

#[test]
fn stream_scores_equal_those_of_packed_frames() {
    let workplace = Workplace::new();
    let stream = tiny_stream(&workplace);
    done(workplace.piped("convert - packed.gseq", &stream));
    workplace.done("score packed.gseq --cameras {tiny} -o expected.npz");
    done(workplace.piped("score - --cameras {tiny} -o found.npz", &stream));
    assert!(fs::read(workplace.path("expected.npz")).unwrap() == fs::read(workplace.path("found.npz")).unwrap());
}

/// Returns `stream` with other time stamps: `time` returns the time stamp of a frame, given its number.
fn retimed(stream: &[u8], time: impl Fn(usize) -> f64) -> Vec<u8> {
    let mut bytes = stream.to_owned();
    let (mut frame, mut at) = (0, 0);
    while let Some(found) = bytes[at..].windows(4).position(|window| window == b"FRAM") {
        let start = at + found;
        if bytes[start + 4..start + 8] == (frame as u32).to_le_bytes() {
            bytes[start + 8..start + 16].copy_from_slice(&time(frame).to_le_bytes());
            frame += 1;
        }
        at = start + 4;
    }
    assert_eq!(frame, 10);
    bytes
}

#[test]
fn stream_takes_the_cameras_of_its_container() {
    let workplace = Workplace::new();
    // The times of the cameras are those of the frames. As fractions of the last one, they would not be.
    let stream = retimed(&tiny_stream(&workplace), |frame| frame as f64 / 16.0);
    fs::create_dir(workplace.path("cameras")).unwrap();
    for name in ["transforms_train.json", "transforms_test.json"] {
        let mut cameras: serde_json::Value = serde_json::from_slice(&fs::read(tiny().join(name)).unwrap()).unwrap();
        for image in cameras["frames"].as_array_mut().unwrap() {
            image["time"] = ((image["time"].as_f64().unwrap() * 9.0).round() / 16.0).into();
        }
        fs::write(workplace.path("cameras").join(name), cameras.to_string()).unwrap();
    }
    done(workplace.piped("convert - packed.gseq", &stream));
    for options in ["", " --link always"] {
        workplace.done(&format!("score packed.gseq --cameras cameras -o expected.npz --overwrite{options}"));
        done(workplace.piped(&format!("score - --cameras cameras -o found.npz --overwrite{options}"), &stream));
        assert!(fs::read(workplace.path("expected.npz")).unwrap() == fs::read(workplace.path("found.npz")).unwrap());
    }
    let other = retimed(&stream, |frame| frame as f64 / 32.0);
    let refused = workplace.piped("score - --cameras cameras -o other.npz", &other);
    let message = String::from_utf8_lossy(&refused.stderr);
    assert!(refused.status.code() == Some(2) && message.contains("no frame at this time"), "{message}");
    assert!(!message.contains("--frames"), "{message}");
}

#[test]
#[ignore = "needs time"]
fn uneven_stream_times_give_the_result_of_the_file() {
    let workplace = Workplace::new();
    let stream = retimed(&tiny_stream(&workplace), |frame| (frame * frame) as f64);
    done(workplace.piped("convert - packed.gseq", &stream));
    workplace.done("compress packed.gseq -o expected");
    let output = done(workplace.piped("compress - -o found", &stream));
    assert!(String::from_utf8_lossy(&output).contains("not evenly spaced"), "{}", String::from_utf8_lossy(&output));
    assert!(lasting_files(&workplace.path("expected")) == lasting_files(&workplace.path("found")));
}

#[test]
fn unpacked_stream_packs_to_the_same_frames() {
    let workplace = Workplace::new();
    workplace.done("convert {tiny} a.gseq");
    let stream = done(workplace.piped("convert a.gseq -", b""));
    done(workplace.piped("convert - b.gseq", &stream));
    let [a, b] = ["a.gseq", "b.gseq"].map(|name| Container::open(&workplace.path(name)).unwrap());
    assert_eq!(a.info(), b.info());
    assert!((0..10).all(|frame| state(&a, frame) == state(&b, frame)));
    assert!(done(workplace.piped("convert - -", &stream)) == stream, "a stream of a stream is that stream");
    done(workplace.piped("convert - frames --as ply-sequence", &stream));
    workplace.done("convert a.gseq expected --as ply-sequence");
    assert!(lasting_files(&workplace.path("frames")) == lasting_files(&workplace.path("expected")));

    let mut unpack = splatsieve(&workplace, "convert a.gseq -").spawn().unwrap();
    let output = splatsieve(&workplace, "compress - -o c.gseq --cameras {tiny}")
        .stdin(unpack.stdout.take().unwrap())
        .output()
        .unwrap();
    done(output);
    assert!(unpack.wait().unwrap().success());
    workplace.done("compress a.gseq -o d.gseq --cameras {tiny}");
    // Recipes differ in the digest of their inputs.
    assert!(fs::read(workplace.path("c.gseq")).unwrap() == fs::read(workplace.path("d.gseq")).unwrap());
    let info = String::from_utf8(done(workplace.piped("info -", &stream))).unwrap();
    assert!(info.contains("frame stream") && info.contains("10 frames"), "{info}");
}

#[test]
fn broken_streams_are_errors_and_leave_no_files() {
    let workplace = Workplace::new();
    let stream = tiny_stream(&workplace);
    let refused = |arguments: &str, stdin: &[u8], code: i32, part: &str| {
        let before = files(&workplace.path(""));
        let output = workplace.piped(arguments, stdin);
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{arguments}: {message}");
        assert!(message.contains(part), "{arguments}: {part:?} is not in {message:?}");
        assert!(files(&workplace.path("")) == before, "{arguments}: something was left behind");
    };
    for arguments in ["compress - -o out", "compress - -o out.gseq", "score - -o rows.npz", "convert - a.gseq"] {
        refused(arguments, &stream[..stream.len() - 24], 1, "after 10 complete frames, without its end mark");
        refused(arguments, b"Loading model\n", 1, "standard input");
        refused(arguments, b"", 1, "before its first frame");
        refused(&format!("{arguments} --frames 3"), &stream, 2, "--frames");
    }
    let backwards = retimed(&stream, |frame| -(frame as f64));
    refused("compress - -o out", &backwards, 1, "expected a time stamp above");
    refused("compress - -o missing/out", &stream, 2, "missing");
    refused("compress - -o out --keep-ids 300", &stream, 2, "below 300");
    refused("compress - -o out.ply", &stream, 2, "10 frames do not fit");
    refused("compress - -o out --scratch-dir nowhere", &stream, 2, "nowhere");
}

#[test]
fn closed_pipe_while_streaming_is_no_failure() {
    let workplace = Workplace::new();
    let mut child = splatsieve(&workplace, "convert {tiny} - --quiet").spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Waits until `folder` holds a scratch file of the run. Panics if the run ends before that or after 60 s.
fn wait_for_scratch(folder: &Path, child: &mut Child) {
    let start = Instant::now();
    while leftover_files(folder).is_empty() {
        assert!(start.elapsed() < Duration::from_secs(60), "no scratch file appeared");
        assert!(child.try_wait().unwrap().is_none(), "the run ended");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[cfg(target_os = "linux")]
#[test]
fn next_run_removes_scratch_files_of_a_killed_run() {
    let workplace = Workplace::new();
    let stream = tiny_stream(&workplace);
    for (scratch, next) in [("", "convert {tiny} other.gseq --overwrite"), ("scratch", "compress - -o out --overwrite")]
    {
        let flag = if scratch.is_empty() { String::new() } else { format!(" --scratch-dir {scratch}") };
        let folder = workplace.path(scratch);
        fs::create_dir_all(&folder).unwrap();
        let mut child = splatsieve(&workplace, &format!("compress - -o out{flag}")).spawn().unwrap();
        let mut pipe = child.stdin.take().unwrap();
        pipe.write_all(&stream[..stream.len() / 2]).unwrap();
        wait_for_scratch(&folder, &mut child);
        // SIGKILL.
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(!workplace.path("out").exists());
        assert!(!leftover_files(&folder).is_empty(), "a kill leaves the scratch file");
        done(workplace.piped(&format!("{next}{flag}"), &stream));
        assert!(leftover_files(&folder).is_empty());
    }
}
