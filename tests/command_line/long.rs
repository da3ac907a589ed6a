//! Tests of very long and very wide sequences, as files and as streams of unknown length (case 42 of the table in
//! `tests/extremes/main.rs`). A run stays within its memory limit for as many frames as the limit allows. It refuses a
//! longer stream with a message that names the limit.
//!
//! `SPLATSIEVE_PROGRAM` may name an optimized program to run in place of the one built with this test.

use std::fs;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::Output;

use crate::scene::{Workplace, stderr_text};
use splatsieve::files::frame_stream::StreamHeader;
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::outputs::frame_stream::StreamWriter;

/// Options for a run that scores and prunes without renders, so that the tests are fast. Renders would take no memory
/// that grows with the number of frames.
const REQUEST: &str = "--set coverage=projected --prune-only --no-refine --set choose_by_views=false --ratio 0.5 \
     --set bands=all";

/// Sequence in which only positions move, back and forth: the first component of Gaussian 0 at frame t is sin(t / 50).
#[derive(Clone, Copy)]
struct LongSequence {
    gaussians: usize,
    frames: usize,
}

impl LongSequence {
    /// Writes the sequence as a stream. Stops without an error if the reader closes the pipe.
    fn write(self, to: impl Write) {
        let header =
            StreamHeader { count: self.gaussians, sh_degree: 0, varying: Attributes::POSITION, is_unlinked: false };
        let mut state = Gaussians::zeros(self.gaussians, 0);
        let value = |i: usize, k: f32| (i as f32 * k).fract();
        for c in 0..3 {
            for (i, x) in state.log_scale.plane_mut(c).iter_mut().enumerate() {
                *x = -4.0 - value(i, 0.618_034);
            }
        }
        state.rotation.plane_mut(0).fill(1.0);
        state.opacity_logit.plane_mut(0).iter_mut().enumerate().for_each(|(i, x)| *x = 3.0 * value(i, 0.754_877) - 1.0);
        let Ok(mut stream) = StreamWriter::new(BufWriter::new(to), Path::new("pipe"), header, &state) else { return };
        let at_rest: Vec<[f32; 3]> =
            (0..self.gaussians).map(|i| [0.618_034, 0.754_877, 0.569_84].map(|k| value(i, k))).collect();
        for frame in 0..self.frames {
            let wave = (frame as f32 / 50.0).sin();
            for (c, weight) in [1.0, 0.3, 0.0].into_iter().enumerate() {
                let to = state.position.plane_mut(c).iter_mut();
                to.zip(&at_rest).for_each(|(x, rest)| *x = rest[c] + weight * wave);
            }
            if stream.write_frame(frame as f64, &state).is_err() {
                return;
            }
        }
        let _ = stream.finish();
    }
}

/// Runs the program with the stream of `sequence` on its standard input.
fn piped(workplace: &Workplace, arguments: &str, sequence: LongSequence) -> Output {
    crate::scene::piped(&mut workplace.command(arguments), move |pipe| sequence.write(pipe))
}

/// Runs the program without an input.
fn run_without_input(workplace: &Workplace, arguments: &str) -> Output {
    piped(workplace, arguments, LongSequence { gaussians: 0, frames: 0 })
}

/// Returns the number in `text` that stands between `before` and `after`.
fn number(text: &str, before: &str, after: &str) -> f64 {
    let (_, rest) = text.split_once(before).unwrap_or_else(|| panic!("{before:?} is not in {text:?}"));
    rest.split_once(after).unwrap().0.trim().parse().unwrap()
}

/// Checks that a run succeeded and used at most `budget` MiB, if the system reports memory use.
fn assert_within_memory(output: &Output, what: &str, budget: f64) {
    let text = stderr_text(output);
    assert!(output.status.success(), "{what}: {text}");
    if let Some(taken) = crate::scene::taken(&text) {
        println!("{what}: {taken} of {budget} MiB");
        assert!(taken <= budget, "{what}: {taken} MiB resident, {budget} promised");
    }
}

/// Writes `sequence` to a container and compresses it as a container and as a stream, each within `budget` MiB. Checks
/// that the results are equal.
fn check_file_and_stream(sequence: LongSequence, budget: u64) {
    let workplace = Workplace::new();
    let limits = format!("--memory {budget}MiB --explain");
    let output = piped(&workplace, &format!("convert - walk.gseq {limits}"), sequence);
    assert_within_memory(&output, "pack", budget as f64);
    let output = run_without_input(&workplace, &format!("compress walk.gseq -o file.gseq {REQUEST} {limits}"));
    assert_within_memory(&output, "container", budget as f64);
    fs::remove_file(workplace.path("walk.gseq")).unwrap();
    let output = piped(&workplace, &format!("compress - -o stream.gseq {REQUEST} {limits}"), sequence);
    assert_within_memory(&output, "stream", budget as f64);
    for name in [".gseq", ".gseq.index_map.npy"] {
        let [file, stream] = ["file", "stream"].map(|of| fs::read(workplace.path(&format!("{of}{name}"))).unwrap());
        assert!(file == stream, "{name}: other bytes");
    }
}

#[test]
fn hundred_thousand_frames_fit_40_mib() {
    check_file_and_stream(LongSequence { gaussians: 10, frames: 100_000 }, 40);
}

#[test]
fn million_gaussians_in_two_frames_fit() {
    check_file_and_stream(LongSequence { gaussians: 1_000_000, frames: 2 }, 700);
}

/// Runs a sequence of a million frames with ten Gaussians (case 42 of the table in `tests/extremes/main.rs`).
#[test]
#[ignore = "slow: minutes unless optimized"]
fn slow_a_million_frames_of_ten_gaussians_fit_64_mib() {
    check_file_and_stream(LongSequence { gaussians: 10, frames: 1_000_000 }, 64);
}

/// Runs a sequence of two frames with ten million Gaussians (case 42 of the table in `tests/extremes/main.rs`).
#[test]
#[ignore = "slow: minutes unless optimized"]
fn slow_ten_million_gaussians_in_two_frames_fit() {
    check_file_and_stream(LongSequence { gaussians: 10_000_000, frames: 2 }, 7000);
}

#[test]
fn too_long_stream_is_refused_naming_enough_memory() {
    let sequence = LongSequence { gaussians: 10, frames: 60_000 };
    for (verb, rest) in [("compress", REQUEST), ("convert", "")] {
        let workplace = Workplace::new();
        let request = |memory: u64| format!("{verb} - -o out.gseq {rest} --memory {memory}MiB --explain");
        let output = piped(&workplace, &request(1), sequence);
        let least = number(&stderr_text(&output), "expected at least ", "MiB") as u64;
        let output = piped(&workplace, &request(least), sequence);
        let text = stderr_text(&output);
        assert_eq!(output.status.code(), Some(1), "{verb} in {least} MiB: {text}");
        for part in ["standard input, frame ", "at most ", &format!("{least}.0 MiB, as asked for"), "send fewer frames"]
        {
            assert!(text.contains(part), "{verb}: {part:?} is not in {text:?}");
        }
        assert!(fs::read_dir(workplace.path("")).unwrap().next().is_none(), "{verb}: something was left behind");
        let enough = number(&text, "MiB, which is enough for ", " frames") as usize;
        let named = number(&text, "use --memory ", "MiB") as u64;
        let as_said = LongSequence { frames: enough, ..sequence };
        assert_within_memory(&piped(&workplace, &request(named), as_said), verb, named as f64);
    }
}
