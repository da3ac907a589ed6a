use std::fs;

use super::*;
use crate::files::ply::write::write_inria;

const N: usize = 7;

/// Returns `count` Gaussians at frame `frame`. The values depend on the frame and on the index within each component.
fn state(frame: usize, count: usize) -> Gaussians {
    let mut out = Gaussians::zeros(count, 1);
    for column in Attributes::all().iter() {
        let fill = |(i, value): (usize, &mut f32)| *value = (1000 * frame + i) as f32;
        out.attribute_values_mut(column).planes_mut().iter_mut().enumerate().for_each(fill);
    }
    out
}

fn write(folder: &Path, name: &str, gaussians: &Gaussians) {
    write_inria(gaussians, &[], &folder.join(name)).unwrap();
}

/// Returns a folder with the `frames` PLY files `f_0.ply`, `f_1.ply`, …, written in reverse order.
fn folder(frames: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    (0..frames).rev().for_each(|t| write(folder.path(), &format!("f_{t}.ply"), &state(t, N)));
    folder
}

#[test]
fn frames_come_in_natural_order_at_even_times() {
    let folder = folder(12);
    let sequence = PlySequence::open(folder.path()).unwrap();
    let info = sequence.info();
    assert_eq!((info.count, info.sh_degree, info.varying), (N, 1, Attributes::all()));
    assert_eq!(info.times, (0..12).map(|t| t as f64 / 12.0).collect::<Vec<_>>());
    let mut reader = FrameSource::open(&sequence, Ids::Range(0..N)).unwrap();
    let mut out = Gaussians::zeros(0, 1);
    for t in [11, 2, 10, 0] {
        reader.read(t, Attributes::all(), &mut out).unwrap();
        assert_eq!(out, state(t, N), "frame {t}");
    }
    assert!(reader.read(12, Attributes::all(), &mut out).unwrap_err().to_string().contains("frame 12"));
}

#[test]
fn any_ids_read_the_same_bits() {
    let folder = folder(3);
    let sequence = PlySequence::open(folder.path()).unwrap();
    let whole = state(2, N);
    let mut out = Gaussians::zeros(0, 1);
    let ids = [6, 0, 3, 3];
    FrameSource::open(&sequence, Ids::List(&ids)).unwrap().read(2, Attributes::all(), &mut out).unwrap();
    for (i, &id) in ids.iter().enumerate() {
        assert_eq!(out.sh.row::<12>(i), whole.sh.row::<12>(id as usize));
    }
    FrameSource::open(&sequence, Ids::Range(2..5)).unwrap().read(2, Attributes::POSITION, &mut out).unwrap();
    assert_eq!(out.position.plane(1), &whole.position.plane(1)[2..5]);
    assert!(FrameSource::open(&sequence, Ids::Range(0..N + 1)).is_err());
}

#[test]
fn a_single_file_is_one_constant_frame() {
    let folder = folder(1);
    for sequence in [
        PlySequence::open_single(&folder.path().join("f_0.ply"), &PlyOptions::default()),
        PlySequence::open(folder.path()),
    ] {
        let sequence = sequence.unwrap();
        assert_eq!((sequence.info().varying, &sequence.info().times[..]), (Attributes::empty(), &[0.0][..]));
        let mut out = Gaussians::zeros(0, 1);
        FrameSource::open(&sequence, Ids::Range(0..N)).unwrap().read(0, Attributes::all(), &mut out).unwrap();
        assert_eq!(out, state(0, N));
    }
}

#[test]
fn frames_with_other_counts_or_properties_are_named() {
    let folder = folder(3);
    write(folder.path(), "f_1.ply", &state(1, N - 1));
    let message = PlySequence::open(folder.path()).unwrap_err().to_string();
    let both = message.contains("expected 7 Gaussians") && message.contains("found 6 Gaussians");
    assert!(both && message.contains("f_1.ply") && message.contains("f_0.ply"), "{message}");

    write(folder.path(), "f_1.ply", &Gaussians::zeros(N, 0));
    let message = PlySequence::open(folder.path()).unwrap_err().to_string();
    assert!(message.contains("f_1.ply") && message.contains("f_rest_0"), "{message}");
}

#[test]
fn frames_changed_since_opening_are_named() {
    let folder = folder(2);
    let sequence = PlySequence::open(folder.path()).unwrap();
    write(folder.path(), "f_1.ply", &state(1, N + 2));
    let mut reader = FrameSource::open(&sequence, Ids::Range(0..N)).unwrap();
    let message = reader.read(1, Attributes::all(), &mut Gaussians::zeros(0, 1)).unwrap_err().to_string();
    assert!(message.contains("f_1.ply") && message.contains("found 9"), "{message}");
}

#[test]
fn other_files_are_ignored_and_no_frame_is_an_error() {
    let folder = folder(2);
    for name in ["._f_0.ply", "notes.txt", "ply"] {
        fs::write(folder.path().join(name), b"not a frame").unwrap();
    }
    assert_eq!(PlySequence::open(folder.path()).unwrap().paths().len(), 2);
    fs::create_dir(folder.path().join("more.ply")).unwrap();
    let message = PlySequence::open(folder.path()).unwrap_err().to_string();
    assert!(message.contains("more.ply") && message.contains("a folder"), "{message}");
    assert_eq!(PlyFrames::open_with_gaps(folder.path(), &PlyOptions::default()).unwrap().paths().len(), 2);
    let empty = tempfile::tempdir().unwrap();
    assert!(PlySequence::open(empty.path()).unwrap_err().to_string().contains("no .ply file"));
}

#[test]
fn times_must_increase() {
    let folder = folder(3);
    let with = |times: &[f64]| PlySequence::open(folder.path()).unwrap().with_times(times.to_vec());
    assert_eq!(with(&[-1.0, 0.0, 7.5]).unwrap().info().times, [-1.0, 0.0, 7.5]);
    assert!(with(&[0.0, 1.0, 1.0]).unwrap_err().to_string().contains("frame 1 has 1, frame 2 has 1"));
    assert!(with(&[0.0, 2.0, 1.0]).unwrap_err().to_string().contains("frame 2 has 1"));
    assert!(with(&[0.0, f64::NAN, 1.0]).unwrap_err().to_string().contains("frame 1 is NaN"));
    assert!(with(&[0.0]).unwrap_err().to_string().contains("1 times were given for 3"));
}

#[test]
fn the_digest_depends_on_names_and_bytes_only() {
    let (one, two) = (folder(3), folder(3));
    let digest = |folder: &Path| PlySequence::open(folder).unwrap().digest().unwrap();
    let before = digest(one.path());
    assert_eq!((before.len(), &before), (32, &digest(two.path())));
    write(two.path(), "f_2.ply", &state(1, N));
    assert_ne!(digest(two.path()), before);
    for name in ["f_2.ply", "f_1.ply", "f_0.ply"] {
        fs::rename(one.path().join(name), one.path().join(name.replace('f', "g"))).unwrap();
    }
    assert_ne!(digest(one.path()), before);
}
