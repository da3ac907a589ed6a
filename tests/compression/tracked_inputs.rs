//! Tests of inputs whose frames have to be linked, and of frame streams: errors that come before any work, messages
//! that name the files of the user, and notes about the renders of tracks.

use std::fs;

use crate::frame_streams::{stream_header, unlinked_stream};
use crate::scene::{Workplace, stderr_text};
use splatsieve::model::{Gaussians, hash_id};

/// Returns `count` Gaussians of SH degree 0 at frame `frame`. Their order differs from frame to frame, and their colors
/// change slightly.
fn frame(count: usize, frame: usize) -> Gaussians {
    let mut out = Gaussians::zeros(count, 0);
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by_key(|&i| hash_id((i as u64) << 20 | frame as u64));
    for (at, &i) in order.iter().enumerate() {
        let value = |k: u64| (hash_id(16 * i as u64 + k) >> 40) as f32 / (1u64 << 24) as f32;
        out.position.set_row(at, [value(0), value(1), value(2) + 0.001 * frame as f32]);
        out.rotation.set_row(at, [1.0, 0.0, 0.0, 0.0]);
        out.log_scale.set_row(at, [-3.0 + value(3), -3.0, -3.0]);
        out.opacity_logit.set_row(at, [1.0 + value(4)]);
        out.sh.set_row(at, [value(5), value(6), value(7) + 0.002 * (hash_id(frame as u64) % 2) as f32]);
    }
    out
}

#[test]
fn request_is_checked_before_a_stream_is_received() {
    let workplace = Workplace::new();
    fs::write(workplace.path("exists.gseq"), "old").unwrap();
    // Nothing follows the header: reading the first frame would fail.
    for (bytes, link) in
        [(stream_header(2, 0, 0), "auto"), (stream_header(1, 0, 5), "always"), (stream_header(1, 0, 5), "auto")]
    {
        for (arguments, part) in [
            ("-o exists.gseq", "--overwrite"),
            ("-o out.zip", "does not write .zip files"),
            ("-o none/out.gseq", "the folder none"),
            ("-o out.gseq --keep-ids none.txt", "none.txt"),
            ("-o out.gseq --keep-ids 3-x", "3-x"),
            ("-o out.gsz --max-loss 1 --ground-truth .", "--max-loss cannot be used for an archive"),
            ("-o out.gseq --min-psnr 30 --merge-only", "--merge-only"),
            ("-o out --as model", "only a trained model"),
        ] {
            let output = workplace.piped(&format!("compress - --link {link} {arguments}"), &bytes);
            let said = stderr_text(&output);
            assert!(!output.status.success() && said.contains(part), "{arguments}: {said}");
        }
    }
    let output = workplace.piped("evaluate - none.gseq", &stream_header(2, 0, 0));
    assert!(stderr_text(&output).contains("none.gseq"), "{}", stderr_text(&output));
    workplace.refused(2, "evaluate {tiny} -", &["only the original can be a stream"]);
}

#[test]
fn stream_that_is_not_linked_needs_equal_frames() {
    let workplace = Workplace::new();
    let frames: Vec<Gaussians> = (0..4).map(|t| frame(40, t)).collect();
    let output = workplace.piped("convert - same.gseq --link never", &unlinked_stream(0, &frames));
    assert!(output.status.success(), "{}", stderr_text(&output));
    let said = workplace.done("info same.gseq");
    assert!(said.contains("40 Gaussians") || said.contains("40"), "{said}");
    let frames = [frame(40, 0), frame(40, 1), frame(39, 2)];
    for command in ["convert - out.gseq", "compress - -o out.gseq"] {
        let output = workplace.piped(&format!("{command} --link never"), &unlinked_stream(0, &frames));
        let said = stderr_text(&output);
        let parts = ["standard input, frame 2", "40 Gaussians, as in frame 0", "39 Gaussians", "--link"];
        assert!(!output.status.success() && parts.iter().all(|part| said.contains(part)), "{said}");
    }
    let empty = workplace.piped("convert - out.gseq --link never", &unlinked_stream(0, &[]));
    assert!(stderr_text(&empty).contains("at least one frame"));
}

#[test]
fn stream_without_frames_is_refused() {
    let workplace = Workplace::new();
    let mut bytes = stream_header(1, 0, 5);
    bytes.extend(b"DONE");
    bytes.extend([0; 20]);
    let output = workplace.piped("convert - out.gseq", &bytes);
    assert!(stderr_text(&output).contains("standard input: expected at least one frame"), "{}", stderr_text(&output));
    assert!(!workplace.path("out.gseq").exists());
}

#[test]
fn errors_of_values_name_standard_input() {
    let workplace = Workplace::new();
    let mut bad = frame(40, 0);
    (0..20).for_each(|i| bad.position.set_row(i, [f32::NAN; 3]));
    let output = workplace.piped("compress - -o out.gseq --link never", &unlinked_stream(0, &[bad, frame(40, 1)]));
    assert!(stderr_text(&output).contains("standard input, Gaussian 0"), "{}", stderr_text(&output));
}

#[test]
fn messages_name_the_files_of_the_user() {
    let workplace = Workplace::new();
    for t in 0..3 {
        workplace.ply(&format!("{t}.ply"), &frame(60 - t, t));
        workplace.done(&format!("convert {t}.ply still/frame_{t}.sog").replace("still/", "still_"));
    }
    fs::create_dir(workplace.path("still")).unwrap();
    (0..3).for_each(|t| {
        let name = format!("frame_{t}.sog");
        fs::rename(workplace.path(&format!("still_{name}")), workplace.path("still").join(name)).unwrap();
    });
    let linked = workplace.run("convert still out.gseq");
    assert!(linked.stderr.contains("frame_1.sog has 59 Gaussians"), "{}", linked.stderr);
    workplace.refused(1, "convert still other.gseq --link never", &["still/frame_1.sog", "as in still/frame_0.sog"]);
}

#[test]
fn evaluation_notes_which_model_was_tracked() {
    let workplace = Workplace::new();
    for t in 0..12 {
        workplace.ply(&format!("frames/{t:02}.ply"), &frame(300, t));
    }
    workplace.done("convert frames apart.gseq --link apart");
    let note = |arguments: &str| {
        let said = workplace.done(&format!("evaluate {arguments} --max-views 2"));
        said.lines().find(|line| line.contains("its frames were linked")).map(str::to_owned)
    };
    let original = note("frames apart.gseq").unwrap();
    assert!(original.contains("the original model: ") && original.contains("--link apart compares"), "{original}");
    let compressed = note("apart.gseq frames").unwrap();
    assert!(compressed.contains("the compressed model: ") && compressed.contains("dB PSNR"), "{compressed}");
    assert_eq!(note("frames apart.gseq --link apart"), None);
}

#[test]
fn container_of_tracks_unpacks_to_visible_gaussians_on_request() {
    let workplace = Workplace::new();
    let count = |t: usize| 100 - 2 * t;
    for t in 0..6 {
        // Every frame is a cut: it shows other Gaussians.
        let mut gaussians = frame(count(t), t);
        gaussians.position.planes_mut().iter_mut().for_each(|x| *x += 100.0 * t as f32);
        workplace.ply(&format!("frames/{t}.ply"), &gaussians);
    }
    workplace.done("convert frames tracks.gseq");
    let all = workplace.run("convert tracks.gseq all");
    assert!(all.stderr.contains("--link apart writes only the visible ones"), "{}", all.stderr);
    workplace.done("convert tracks.gseq visible --link apart");
    let header = fs::read(workplace.path("visible/frame_00003.ply")).unwrap();
    assert!(String::from_utf8_lossy(&header[..400]).contains(&format!("element vertex {}\n", count(3))));
}
