//! Tests of streams whose frames contradict one another.

use super::scene::{Workplace, files};
use super::{balls, piped};
use splatsieve::files::frame_stream::StreamHeader;
use splatsieve::model::Attributes;
use splatsieve::outputs::frame_stream::StreamWriter;
use std::path::Path;

/// Returns the bytes of a stream of five frames with four balls.
fn stream() -> Vec<u8> {
    let (mut bytes, state) = (Vec::new(), balls(4));
    let header = StreamHeader { count: 4, sh_degree: 0, varying: Attributes::POSITION, is_unlinked: false };
    let mut stream = StreamWriter::new(&mut bytes, Path::new("memory"), header, &state).unwrap();
    (0..5).for_each(|t| stream.write_frame(f64::from(t), &state).unwrap());
    stream.finish().unwrap();
    bytes
}

/// Returns the byte offset of frame `t` in the stream. The stream has a header, four balls without positions, then for
/// each frame a mark of 24 bytes and positions.
fn frame_offset(t: usize) -> usize {
    32 + 4 * 4 * (4 + 3 + 1 + 3) + t * (24 + 4 * 4 * 3)
}

/// Checks that every command that reads streams refuses `bytes`, that its message contains all `parts`, and that it
/// leaves no files.
fn refused(bytes: &[u8], parts: &[&str]) {
    for arguments in ["compress - -o out", "convert - a.gseq", "score - -o rows.npz", "info -"] {
        let (workplace, bytes) = (Workplace::new(), bytes.to_owned());
        let output = piped(&workplace, arguments, move |to| drop(to.write_all(&bytes)));
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{arguments}: {text}");
        for part in parts {
            assert!(text.contains(part), "{arguments}: {part:?} is not in {text:?}");
        }
        assert!(files(&workplace.path("")).is_empty(), "{arguments}: something was left behind");
    }
}

/// A time stamp that is not above the one before, or not finite, is refused (case 41 of the table in `main.rs`); the
/// message names the frame.
#[test]
fn nonincreasing_time_stamps_are_named() {
    for (stamp, expected) in [
        (2.0, "a time stamp above 2, that of frame 2"),
        (-1e300, "a time stamp above 2, that of frame 2"),
        (2.0f64.next_down(), "a time stamp above 2, that of frame 2"),
        (f64::NAN, "a time stamp"),
        (f64::INFINITY, "a time stamp"),
        (f64::NEG_INFINITY, "a time stamp"),
    ] {
        let mut bytes = stream();
        bytes[frame_offset(3) + 8..frame_offset(3) + 16].copy_from_slice(&stamp.to_le_bytes());
        refused(&bytes, &["standard input, frame 3", expected]);
    }
}

/// A frame with another number of Gaussians, other attributes or another index than expected is refused (case 43 of the
/// table in `main.rs`); the message names the frame.
#[test]
fn frames_of_another_size_or_attributes_are_named() {
    // (length that frame 3 claims, number of Gaussians that the message computes from it)
    for (length, found) in
        [(5 * 4 * 3u64, "5 Gaussians"), (0, "0 Gaussians"), (4 * 4 * 7 + 4, "no number of Gaussians")]
    {
        let mut bytes = stream();
        bytes[frame_offset(3) + 16..frame_offset(3) + 24].copy_from_slice(&length.to_le_bytes());
        refused(&bytes, &["standard input, frame 3", "4 Gaussians of position", found]);
    }
    for (index, found) in [(2u32, "frame 2"), (4, "frame 4")] {
        let mut bytes = stream();
        bytes[frame_offset(3) + 4..frame_offset(3) + 8].copy_from_slice(&index.to_le_bytes());
        refused(&bytes, &["standard input, frame 3", "expected frame 3", found]);
    }
}
