//! Tests of `render --video`: frames of a film are compared with single renders of the same frames.

use std::env;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::Path;

use assert_cmd::Command;

use super::{FRAMES, SIZE, done, files, refused, run, scene};

/// Decoded animated PNG.
struct Apng {
    /// RGB bytes of every frame.
    frames: Vec<Vec<u8>>,
    size: (usize, usize),
    /// Delay of each frame as a fraction of a second: numerator, denominator.
    delays: Vec<(u16, u16)>,
}

fn apng(path: &Path) -> Apng {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path).unwrap())).read_info().unwrap();
    let control = reader.info().animation_control.unwrap();
    assert_eq!(control.num_plays, 0, "it goes on for ever");
    let (mut frames, mut delays) = (Vec::new(), Vec::new());
    let size = (reader.info().width as usize, reader.info().height as usize);
    for _ in 0..control.num_frames {
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        let frame = reader.info().frame_control.unwrap();
        delays.push((frame.delay_num, frame.delay_den));
        frames.push(pixels);
    }
    Apng { frames, size, delays }
}

/// Renders `input` at the frame `frame` from the view `view` and returns the RGB bytes of the image.
fn single_render(folder: &Path, input: &str, frame: usize, view: u32) -> Vec<u8> {
    done(
        folder,
        &format!("render {input} --cameras cameras.json --frame {frame} --view {view} --overwrite -o still.png"),
    );
    let mut reader =
        png::Decoder::new(BufReader::new(File::open(folder.join("still.png")).unwrap())).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    pixels
}

/// Joins the RGB bytes of two images, so that they stand side by side.
fn side_by_side(left: &[u8], right: &[u8]) -> Vec<u8> {
    left.chunks(3 * SIZE.0).zip(right.chunks(3 * SIZE.0)).flat_map(|rows| [rows.0, rows.1].concat()).collect()
}

#[test]
fn animated_png_frames_equal_single_renders() {
    let folder = scene();
    let at = folder.path();
    done(at, "render scene.gseq --cameras cameras.json --view 2 --video one.png --fps 12");
    let Apng { frames, size, delays } = apng(&at.join("one.png"));
    assert_eq!((frames.len(), size), (FRAMES, SIZE));
    assert!(delays.iter().all(|&delay| delay == (1, 12)), "{delays:?}");
    let said = done(at, "render scene.gseq --cameras cameras.json --beside smaller.gseq --video two.apng");
    assert!(said.contains("4 frames of 96x36") && said.contains("left: scene.gseq; right: smaller.gseq"), "{said}");
    let Apng { frames: pairs, size, .. } = apng(&at.join("two.apng"));
    assert_eq!((pairs.len(), size), (FRAMES, (2 * SIZE.0, SIZE.1)));
    for (frame, (one, pair)) in frames.iter().zip(&pairs).enumerate() {
        assert!(*one == single_render(at, "scene.gseq", frame, 2), "frame {frame}");
        let [left, right] = ["scene.gseq", "smaller.gseq"].map(|input| single_render(at, input, frame, 0));
        assert!(*pair == side_by_side(&left, &right), "frame {frame}: the first view, both models");
    }
    assert!(frames[0] != frames[3], "nothing moves");
}

#[test]
fn camera_path_begins_and_ends_at_single_renders() {
    let folder = scene();
    let at = folder.path();
    done(at, "render scene.gseq --cameras cameras.json --path 0,1,2 --split all --video way.png");
    let frames = apng(&at.join("way.png")).frames;
    assert_eq!(frames.len(), FRAMES);
    assert!(frames[0] == single_render(at, "scene.gseq", 0, 0) && frames[3] == single_render(at, "scene.gseq", 3, 2));
    for (frame, view) in (1..3).flat_map(|frame| (0..3).map(move |view| (frame, view))) {
        assert!(frames[frame] != single_render(at, "scene.gseq", frame, view), "frame {frame} is on the way");
    }
    // All test views in order: 0, 2, 3.
    done(at, "render scene.gseq --cameras cameras.json --path --video all.png");
    let all = apng(&at.join("all.png")).frames;
    assert!(all[0] == frames[0] && all[3] == single_render(at, "scene.gseq", 3, 3));
}

#[test]
fn film_bytes_ignore_thread_count() {
    let folder = scene();
    let at = folder.path();
    for kind in ["png", "gif"] {
        let made = ["1", "2", "5"].map(|threads| {
            let line = "render scene.gseq --cameras cameras.json --beside smaller.gseq --path --fps 30";
            done(at, &format!("{line} --threads {threads} --overwrite --video film.{kind}"));
            fs::read(at.join(format!("film.{kind}"))).unwrap()
        });
        assert!(made[0] == made[1] && made[0] == made[2], "{kind}");
    }
    let mut gif = gif::DecodeOptions::new().read_info(File::open(at.join("film.gif")).unwrap()).unwrap();
    let mut delays = Vec::new();
    while let Some(frame) = gif.read_next_frame().unwrap() {
        assert_eq!((frame.width, frame.height), (96, 36));
        delays.push(frame.delay);
    }
    assert_eq!((delays.len(), delays.iter().sum::<u16>()), (FRAMES, 13), "4 frames of 30 a second: {delays:?}");
}

#[test]
fn film_of_a_continuous_model_has_the_asked_frames() {
    let folder = tempfile::tempdir().unwrap();
    let tiny = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny_model");
    let tiny = tiny.to_str().unwrap();
    done(folder.path(), &format!("render {tiny} --cameras {tiny} --frames 7 --resolution 40x30 --video tiny.gif"));
    let mut gif = gif::DecodeOptions::new().read_info(File::open(folder.path().join("tiny.gif")).unwrap()).unwrap();
    let mut frames = 0;
    while gif.next_frame_info().unwrap().is_some() {
        frames += 1;
    }
    assert_eq!(frames, 7);
}

#[test]
fn impossible_films_are_refused_and_leave_no_files() {
    let folder = scene();
    let at = folder.path();
    let line = "render scene.gseq --cameras cameras.json";
    for (rest, says) in [
        ("--video x.avi", &["x.avi", ".gif, .mp4"][..]),
        ("--video x.gif --view 9", &["--view 9", "0, 1, 2, 3"]),
        ("--video x.gif --path 0,9", &["--path 9", "0, 2, 3"]),
        ("--video x.gif --path 0", &["two views"]),
        ("--video x.gif --path 0,2 --view 1", &["--view"]),
        ("--video x.gif --fps 0", &["--fps"]),
        ("--video x.gif -o y.png", &["--output"]),
        ("--path -o y.png --all", &["--video"]),
        ("--beside smaller.gseq --all -o y", &["--video"]),
        ("--fps 9 --frame 0 --view 0 -o y.png", &["--video"]),
        ("--video x.gif --all", &["--all"]),
        ("--video x.gif --cache w", &["--cache"]),
        ("--video x.gif --beside scene.gseq --frames 3", &["--frames"]),
        ("--video scene.gseq", &["scene.gseq"]),
        ("--video no/x.gif", &["does not exist"]),
    ] {
        refused(at, &format!("{line} {rest}"), 2, says);
    }
}

/// Returns a folder with a program named `ffmpeg` that runs the shell script `script`.
#[cfg(unix)]
fn encoder(script: &str) -> tempfile::TempDir {
    use std::os::unix::fs::PermissionsExt;

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ffmpeg");
    fs::write(&path, format!("#!/bin/sh\n{script}\n")).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    folder
}

/// Runs the program with the arguments `line`. PATH begins with the folder `programs`, or has only this folder
/// (`alone`). Returns the exit code and the standard error.
#[cfg(unix)]
fn run_with_programs(programs: &Path, alone: bool, at: &Path, line: &str) -> (i32, String) {
    let others = env::var_os("PATH").filter(|_| !alone).unwrap_or_default();
    let path = env::join_paths([programs.to_owned()].into_iter().chain(env::split_paths(&others))).unwrap();
    let mut command = Command::cargo_bin("splatsieve").unwrap();
    let out = command.current_dir(at).env("PATH", path).args(line.split_whitespace()).output().unwrap();
    (out.status.code().unwrap(), String::from_utf8(out.stderr).unwrap())
}

#[test]
#[cfg(unix)]
fn encoder_gets_every_frame_and_its_errors_are_shown() {
    let folder = scene();
    let at = folder.path();
    let line = "--quiet render scene.gseq --cameras cameras.json --view 2";
    // The last argument is the file to write.
    let keeps = encoder("for last; do :; done; cat > \"$last\"; echo \"$@\" > asked");
    assert_eq!(
        run_with_programs(keeps.path(), false, at, &format!("{line} --video x.mp4 --fps 20")),
        (0, String::new())
    );
    let asked = fs::read_to_string(at.join("asked")).unwrap();
    assert!(asked.contains("-s 48x36 -r 20") && asked.contains("libx264"), "{asked}");
    fs::remove_file(at.join("asked")).unwrap();
    let frames = fs::read(at.join("x.mp4")).unwrap();
    fs::remove_file(at.join("x.mp4")).unwrap();
    let stills: Vec<u8> = (0..FRAMES).flat_map(|frame| single_render(at, "scene.gseq", frame, 2)).collect();
    assert!(frames == stills);

    let before = files(at);
    for (script, says) in [
        // The encoder fails at once, while frames are written, or only after all frames.
        ("echo no such codec >&2; exit 3", &["x.webm", "ffmpeg", "3", "no such codec"][..]),
        ("cat > /dev/null; echo disk on fire >&2; exit 7", &["ffmpeg", "7", "disk on fire"]),
        ("kill -9 $$", &["ffmpeg", "9"]),
    ] {
        let fails = encoder(script);
        let (code, said) = run_with_programs(fails.path(), false, at, &format!("{line} --video x.webm"));
        assert_eq!(code, 1, "{script}: {said}");
        assert!(says.iter().all(|part| said.contains(part)), "{script}: {said}");
    }
    let nothing = tempfile::tempdir().unwrap();
    let (code, said) = run_with_programs(nothing.path(), true, at, &format!("{line} --video x.mp4"));
    assert!(code == 2 && ["ffmpeg", "PATH", "install", ".gif"].iter().all(|part| said.contains(part)), "{said}");
    assert!(files(at) == before, "something was left: {:?}", files(at).keys());
}

#[test]
fn film_by_ffmpeg_shows_every_frame() {
    let folder = scene();
    let at = folder.path();
    if run(at, "render scene.gseq --cameras cameras.json --view 2 --video film.mp4").status.code() == Some(2) {
        println!("skipped: no ffmpeg on this machine");
        return;
    }
    let mut ffmpeg = std::process::Command::new("ffmpeg");
    ffmpeg.args(["-v", "error", "-i", "film.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]).current_dir(at);
    let found = ffmpeg.output().unwrap().stdout;
    let stills: Vec<u8> = (0..FRAMES).flat_map(|frame| single_render(at, "scene.gseq", frame, 2)).collect();
    assert_eq!(found.len(), stills.len(), "{FRAMES} frames");
    let square = |(a, b): (&u8, &u8)| (f64::from(*a) - f64::from(*b)).powi(2);
    let mean = found.iter().zip(&stills).map(square).sum::<f64>() / stills.len() as f64;
    let psnr = 10.0 * (255.0f64.powi(2) / mean).log10();
    assert!(psnr > 25.0, "{psnr} dB");
}
