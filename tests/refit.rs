//! Refitted colours as a user gets them: what changes, what does not, and that every kind of output says the same.

mod scene;

use std::path::Path;

use scene::{Workplace, lasting_files, state, tiny};
use splatsieve::families::ModelFolder;
use splatsieve::ingest::container::Container;
use splatsieve::ingest::ply_sequence::PlySequence;
use splatsieve::model::Columns;
use splatsieve::source::FrameSource;

/// A dynamic scene, and what pruning and refitting leave of it, to be given a name.
fn request(workplace: &Workplace) -> &'static str {
    workplace.done("demo --gaussians 2000 --frames 4 -o demo");
    "--cameras demo/cameras.json --split train --prune-only --target-ratio 0.3"
}

fn psnr(workplace: &Workplace, result: &str) -> f64 {
    let found = workplace.done(&format!("evaluate demo/scene.gseq {result} --cameras demo/cameras.json --json"));
    serde_json::from_str::<serde_json::Value>(&found).unwrap()["psnr"].as_f64().unwrap()
}

/// Both sequences hold the same bits at every frame.
fn assert_same(a: &dyn FrameSource, b: &dyn FrameSource) {
    assert_eq!(a.info().times.len(), b.info().times.len());
    for frame in 0..a.info().times.len() {
        assert!(state(a, frame) == state(b, frame), "frame {frame}");
    }
}

#[test]
fn base_colours_alone_change_by_as_much_at_every_frame_and_held_out_pictures_gain() {
    let workplace = Workplace::new();
    let request = request(&workplace);
    workplace.done(&format!("compress demo/scene.gseq {request} -o plain.gseq"));
    workplace.done(&format!("compress demo/scene.gseq {request} --refit-pictures 24 -o fitted.gseq"));
    let open = |name: &str| Container::open(&workplace.path(name)).unwrap();
    let (plain, fitted) = (open("plain.gseq"), open("fitted.gseq"));
    let first = (state(&plain, 0), state(&fitted, 0));
    let mut changed = 0;
    for frame in 0..4 {
        let (before, after) = (state(&plain, frame), state(&fitted, frame));
        for column in Columns::all().difference(Columns::SH).iter() {
            assert!(before.column(column) == after.column(column), "{} at frame {frame}", column.name());
        }
        for c in 0..before.sh.width() {
            for i in 0..before.len() {
                let now = after.sh.plane(c)[i] - before.sh.plane(c)[i];
                let then = first.1.sh.plane(c)[i] - first.0.sh.plane(c)[i];
                // Both are differences of rounded sums.
                assert!((now - then).abs() < 1e-6, "coefficient {c} of {i}: {now} at frame {frame}, {then} at first");
                assert!(c < 3 || now == 0.0, "coefficient {c} of {i} changed by {now}");
                changed += usize::from(now != 0.0);
            }
        }
    }
    assert!(changed > 1000, "{changed} values changed");
    let (before, after) = (psnr(&workplace, "plain.gseq"), psnr(&workplace, "fitted.gseq"));
    assert!(after > before + 0.3, "got {after} dB, {before} without refitting");
}

#[test]
fn every_kind_of_output_holds_the_same_colours() {
    let workplace = Workplace::new();
    let request = request(&workplace);
    let fitted = |input: &str, output: &str| {
        workplace.done(&format!("compress {input} {request} --refit-pictures 12 {output}"));
    };
    fitted("demo/scene.gseq", "-o fitted.gseq");
    fitted("demo/scene.gseq", "-o frames --as ply-sequence");
    workplace.done("compress demo/scene.gseq --prune-only --target-ratio 1 -o whole --as ply-sequence");
    fitted("whole", "-o like");
    let container = Container::open(&workplace.path("fitted.gseq")).unwrap();
    for frames in ["frames", "like"] {
        assert_same(&container, &PlySequence::open(&workplace.path(frames)).unwrap());
    }

    let model = format!("{0} --cameras {0} --target-ratio 0.4 --refit-pictures 12", tiny().display());
    let summary = workplace.summary(&format!("{model} -o model"));
    let notes = summary["notes"].to_string();
    assert!(notes.contains("base colours refitted"), "{notes}");
    workplace.done(&format!("compress {model} -o model.gseq"));
    let baked = Container::open(&workplace.path("model.gseq")).unwrap();
    let folder = ModelFolder::open(&workplace.path("model"), None).unwrap();
    assert_same(&baked, &folder.with_times(baked.info().times.clone()).unwrap());
}

#[test]
fn a_result_that_lacks_nothing_is_left_alone_and_says_so() {
    let workplace = Workplace::new();
    request(&workplace);
    let request = "demo/scene.gseq --cameras demo/cameras.json --prune-only --target-ratio 1";
    workplace.done(&format!("compress {request} -o plain"));
    let summary = workplace.summary(&format!("{request} --refit-pictures 12 -o fitted"));
    let left_out = summary["left_out"].to_string();
    assert!(left_out.contains("refitting colours"), "{left_out}");
    let points = |name: &str| {
        let mut files = lasting_files(&workplace.path(name));
        files.retain(|name, _| name.extension().is_some_and(|extension| extension == "ply"));
        files
    };
    assert!(!points("plain").is_empty() && points("plain") == points("fitted"));
}

#[test]
fn threads_change_no_byte() {
    let workplace = Workplace::new();
    let request = request(&workplace);
    let [one, three] = ["1", "3"].map(|threads| {
        workplace.done(&format!(
            "compress demo/scene.gseq {request} --refit-pictures 12 --threads {threads} -o out{threads}"
        ));
        lasting_files(Path::new(&workplace.path(&format!("out{threads}"))))
    });
    assert!(one == three);
}

#[test]
fn protected_gaussians_keep_their_colours() {
    let workplace = Workplace::new();
    let request = request(&workplace);
    workplace
        .done(&format!("compress demo/scene.gseq {request} --refit-pictures 12 --keep-ids 3,700,1999 -o out.gseq"));
    let [original, result] =
        ["demo/scene.gseq", "out.gseq"].map(|name| Container::open(&workplace.path(name)).unwrap());
    let map = scene::index_map(&workplace.path("out.gseq.index_map.npy"));
    let (before, after) = (state(&original, 0), state(&result, 0));
    for id in [3, 700, 1999] {
        let place = usize::try_from(map[id]).unwrap();
        assert_eq!(scene::bits(&after, place), scene::bits(&before, id), "Gaussian {id}");
    }
}
