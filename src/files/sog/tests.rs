//! Tests of `.sog` files that are written and read.

use std::fs;
use std::io::{Cursor, Read, Write};
use std::path::Path;

use serde_json::{Value, json};
use zip::write::FileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::META_FILE;
use super::images::{log_coordinate, morton_order};
use super::read::read_sog;
use super::write::write_sog;
use crate::diagnostics::demo_scene::DemoScene;
use crate::error::Error;
use crate::files::tests::gaussians_with_sh;
use crate::limits::ReadLimit;
use crate::model::{Attributes, Gaussians, color_from_sh, opacity};
use crate::passes::gather_all;

/// Returns `count` Gaussians with SH degree `degree`, whose values differ along all axes.
fn gaussians(count: usize, degree: usize) -> Gaussians {
    let mut state = gaussians_with_sh(count, degree);
    let plain = gather_all(&DemoScene::new(count, 1), 0, Attributes::SH).unwrap();
    state.sh.planes_mut()[..3 * count].copy_from_slice(&plain.sh.planes()[..3 * count]);
    state.position.plane_mut(0).iter_mut().for_each(|x| *x = 40.0 * *x + 100.0);
    state
}

fn write(state: &Gaussians, path: &Path) -> f64 {
    write_sog(state, path).unwrap().position
}

/// Asserts that `found` has the attributes of `state` within half a quantization step.
fn assert_near(found: &Gaussians, state: &Gaussians) {
    assert_eq!((found.len(), found.sh_degree()), (state.len(), state.sh_degree()));
    let range = |values: &[f32]| {
        let (min, max) = values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &x| (a.min(x), b.max(x)));
        f64::from(max) - f64::from(min)
    };
    for axis in 0..3 {
        let logs: Vec<f32> = state.position.plane(axis).iter().map(|&x| log_coordinate(f64::from(x)) as f32).collect();
        for (a, b) in found.position.plane(axis).iter().zip(state.position.plane(axis)) {
            let half = 0.5 * range(&logs) / 65_535.0 * f64::from(b.abs() + 1.0);
            assert!(f64::from((a - b).abs()) <= 1.01 * half + 1e-6, "{a}, expected {b} ± {half}");
        }
    }
    let near = |a: &[f32], b: &[f32], most: f64, what: &str| {
        for (i, (a, b)) in a.iter().zip(b).enumerate() {
            assert!(f64::from((a - b).abs()) <= most, "{what} {i}: {a}, expected {b} ± {most}");
        }
    };
    let (scales, more) = (state.log_scale.planes(), &state.sh.planes()[3 * state.len()..]);
    near(found.log_scale.planes(), scales, range(scales) / 200.0, "scale");
    near(&found.sh.planes()[3 * state.len()..], more, range(more) / 200.0, "SH coefficient");
    for i in 0..state.len() {
        let [a, b] = [found, state].map(|state| state.sh.row::<3>(i).map(color_from_sh));
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1.0 / 255.0), "color {i}: {a:?}, expected {b:?}");
        let [a, b] = [found, state].map(|state| opacity(state.opacity_logit.row::<1>(i)[0]));
        assert!((a - b).abs() <= 0.5 / 255.0 + 1e-7, "opacity {i}: {a}, expected {b}");
        let [a, b] = [found, state].map(|state| state.rotation_f64(i));
        let length = b.iter().map(|x| x * x).sum::<f64>().sqrt();
        let dot: f64 = a.iter().zip(b).map(|(a, b)| a * b / length).sum();
        assert!(dot.abs() > 0.9999, "rotation {i}: {a:?}, expected {b:?}");
    }
}

#[test]
fn attributes_are_read_back_within_half_a_step() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.sog");
    for (count, degree) in [(1, 0), (300, 3), (700, 1), (301, 2)] {
        let state = gaussians(count, degree);
        let largest = write(&state, &path);
        let found = read_sog(&path, ReadLimit::NONE).unwrap();
        let expected = state.pick(&morton_order(&state.position));
        assert_near(&found, &expected);
        let errors = found.position.planes().iter().zip(expected.position.planes()).map(|(a, b)| (a - b).abs());
        assert!((f64::from(errors.fold(0.0, f32::max)) - largest).abs() < 1e-5, "{largest}");
    }
}

#[test]
fn bytes_ignore_thread_count() {
    let folder = tempfile::tempdir().unwrap();
    let state = gaussians(2500, 1);
    let bytes = |threads| {
        let path = folder.path().join(format!("{threads}.sog"));
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| write(&state, &path));
        fs::read(path).unwrap()
    };
    assert_eq!(bytes(1), bytes(3));
}

#[test]
fn archive_is_the_one_that_strict_players_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.sog");
    write(&gaussians(50, 1), &path);
    let bytes = fs::read(&path).unwrap();
    assert_eq!(&bytes[bytes.len() - 22..][..4], b"PK\x05\x06", "an end record without a comment");
    let mut archive = ZipArchive::new(Cursor::new(&bytes)).unwrap();
    let mut names = Vec::new();
    for at in 0..archive.len() {
        let file = archive.by_index(at).unwrap();
        assert_eq!(file.compression(), CompressionMethod::Stored, "{}", file.name());
        names.push(file.name().to_owned());
    }
    assert_eq!(names.last().unwrap(), META_FILE);
    let meta = meta_of(&bytes);
    assert_eq!((&meta["version"], &meta["count"], &meta["shN"]["bands"]), (&json!(2), &json!(50), &json!(1)));
    for entry in ["scales", "sh0", "shN"] {
        assert_eq!(meta[entry]["codebook"].as_array().unwrap().len(), 256, "{entry}");
    }
}

/// Returns the `meta.json` of the archive `bytes`.
fn meta_of(bytes: &[u8]) -> Value {
    let mut archive = ZipArchive::new(Cursor::new(bytes)).unwrap();
    serde_json::from_reader(archive.by_name(META_FILE).unwrap()).unwrap()
}

/// Returns a copy of the archive `bytes` with `meta` as its `meta.json`; `edit_file` may change the other files.
fn with_meta(bytes: &[u8], meta: &[u8], edit_file: impl Fn(&str, &mut Vec<u8>)) -> Vec<u8> {
    let mut archive = ZipArchive::new(Cursor::new(bytes)).unwrap();
    let mut out = ZipWriter::new(Cursor::new(Vec::new()));
    for at in 0..archive.len() {
        let mut file = archive.by_index(at).unwrap();
        let mut content = Vec::new();
        file.read_to_end(&mut content).unwrap();
        let name = file.name().to_owned();
        edit_file(&name, &mut content);
        out.start_file(&name, FileOptions::default().compression_method(CompressionMethod::Deflated)).unwrap();
        out.write_all(if name == META_FILE { meta } else { &content }).unwrap();
    }
    out.finish().unwrap().into_inner()
}

#[test]
fn folder_and_compressed_archive_are_read_alike() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.sog");
    write(&gaussians(60, 2), &path);
    let bytes = fs::read(&path).unwrap();
    let expected = read_sog(&path, ReadLimit::NONE).unwrap();
    let unpacked = folder.path().join("unpacked");
    fs::create_dir(&unpacked).unwrap();
    let mut archive = ZipArchive::new(Cursor::new(&bytes)).unwrap();
    for at in 0..archive.len() {
        let mut file = archive.by_index(at).unwrap();
        let path = unpacked.join(file.name());
        std::io::copy(&mut file, &mut fs::File::create(path).unwrap()).unwrap();
    }
    assert_eq!(read_sog(&unpacked, ReadLimit::NONE).unwrap(), expected);
    fs::write(&path, with_meta(&bytes, meta_of(&bytes).to_string().as_bytes(), |_, _| ())).unwrap();
    assert_eq!(read_sog(&path, ReadLimit::NONE).unwrap(), expected);
}

#[test]
fn damaged_files_are_refused_with_their_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.sog");
    write(&gaussians(20, 1), &path);
    let whole = fs::read(&path).unwrap();
    let refused = |bytes: &[u8], memory: ReadLimit| {
        fs::write(&path, bytes).unwrap();
        match read_sog(&path, memory) {
            Err(error @ (Error::Input(_) | Error::Io { .. })) => error.to_string(),
            other => panic!("{:?}", other.map(|found| found.len())),
        }
    };
    for length in (0..whole.len()).step_by(7) {
        refused(&whole[..length], ReadLimit::NONE);
    }
    let memory = refused(&whole, ReadLimit::new(5000));
    assert!(memory.contains("--memory"), "{memory}");
    for (place, value, expected) in [
        ("/version", json!(1), "version"),
        ("/version", json!("2"), "version"),
        ("/count", json!(-1), "meta.json"),
        ("/count", json!(1_000_000), "1000000 pixels"),
        ("/count", json!(u64::MAX), "count"),
        ("/means/files/0", json!("../means_l.webp"), "means_l.webp"),
        ("/means/mins/1", json!(200.0), "means, axis 1"),
        ("/means/maxs", json!([1.0]), "meta.json"),
        ("/scales/codebook", json!([]), "scales, codebook"),
        ("/scales/codebook", json!([0.5]), "indices below 1"),
        ("/scales/codebook/3", json!(null), "finite numbers"),
        ("/shN/bands", json!(2), "a width of 512 pixels"),
        ("/shN/count", json!(1), "a label below 1"),
        ("/shN/count", json!(1_000_000), "1000000 palette entries"),
        ("/shN/files", json!(["quats.webp", "sh0.webp"]), "a width of"),
        ("/quats/files/0", json!("sh0.webp"), "alpha of 252"),
        ("/sh0/files/0", json!("meta.json"), "cannot be decoded"),
    ] {
        let mut meta = meta_of(&whole);
        *meta.pointer_mut(place).unwrap() = value.clone();
        let message = refused(&with_meta(&whole, meta.to_string().as_bytes(), |_, _| ()), ReadLimit::NONE);
        assert!(message.contains("a.sog") && message.contains(expected), "{place} = {value}: {message}");
    }
    for text in [&b"{"[..], b"", b"[]", b"\xff"] {
        refused(&with_meta(&whole, text, |_, _| ()), ReadLimit::NONE);
    }
    let meta = meta_of(&whole).to_string();
    for name in ["means_l.webp", "quats.webp", "shN_centroids.webp", "shN_labels.webp"] {
        let cut = |file: &str, content: &mut Vec<u8>| content.truncate(if file == name { 30 } else { content.len() });
        let message = refused(&with_meta(&whole, meta.as_bytes(), cut), ReadLimit::NONE);
        assert!(message.contains(name), "{message}");
    }
}

#[test]
fn values_that_a_file_cannot_store_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.sog");
    let refused = |edit: &dyn Fn(&mut Gaussians)| {
        let mut state = gaussians(30, 1);
        edit(&mut state);
        write_sog(&state, &path).unwrap_err().to_string()
    };
    let message = refused(&|state| state.position.plane_mut(1)[7] = f32::NAN);
    assert!(message.contains("position of Gaussian 7"), "{message}");
    for message in [
        refused(&|state| state.log_scale.plane_mut(2)[7] = f32::NAN),
        refused(&|state| state.sh.plane_mut(0)[7] = f32::INFINITY),
        refused(&|state| state.sh.plane_mut(5)[7] = f32::NAN),
    ] {
        assert!(message.contains("Gaussian 7"), "{message}");
    }
}
