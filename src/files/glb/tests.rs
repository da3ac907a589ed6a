//! Tests of `.glb` files that are written and read.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

use super::read::read_glb;
use super::write::write_glb;
use crate::error::Error;
use crate::files::tests::{assert_signs_reverse_axes, gaussians_with_sh};
use crate::limits::ReadLimit;
use crate::model::{Gaussians, opacity};

/// Returns 30 Gaussians with SH degree `degree`, whose values differ along all axes.
fn gaussians(degree: usize) -> Gaussians {
    gaussians_with_sh(30, degree)
}

/// Returns two parts of the `.glb` file `bytes`: its parsed JSON text, and all bytes after this text.
fn parts(bytes: &[u8]) -> (Value, &[u8]) {
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    (serde_json::from_slice(&bytes[20..20 + length]).unwrap(), &bytes[20 + length..])
}

/// Returns the bytes of a `.glb` file with the JSON text `document`, followed by the bytes `binary` of the binary
/// chunk.
fn file(document: &Value, binary: &[u8]) -> Vec<u8> {
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let whole = (20 + text.len() + binary.len()) as u32;
    let words = [super::MAGIC, super::VERSION, whole, text.len() as u32, super::JSON];
    [&words.into_iter().flat_map(u32::to_le_bytes).collect::<Vec<u8>>()[..], &text, binary].concat()
}

#[test]
fn attributes_are_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    for degree in [0, 1, 3] {
        let state = gaussians(degree);
        write_glb(&state, &path).unwrap();
        let found = read_glb(&path, ReadLimit::NONE).unwrap();
        assert_eq!((&found.position, &found.sh), (&state.position, &state.sh));
        for i in 0..state.len() {
            let [a, b] = [&found, &state].map(|state| state.log_scale.row::<3>(i));
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5), "scale {i}: {a:?}, expected {b:?}");
            let [a, b] = [&found, &state].map(|state| opacity(state.opacity_logit.row::<1>(i)[0]));
            assert!((a - b).abs() < 1e-6, "opacity {i}: {a}, expected {b}");
            let [a, b] = [&found, &state].map(|state| state.rotation.row::<4>(i));
            let length = b.iter().map(|x| x * x).sum::<f32>().sqrt();
            assert!(a.iter().zip(b).all(|(a, b)| (a - b / length).abs() < 1e-6), "rotation {i}: {a:?}, {b:?}");
        }
        let again = folder.path().join("b.glb");
        write_glb(&state, &again).unwrap();
        assert_eq!(fs::read(&path).unwrap(), fs::read(again).unwrap());
    }
}

#[test]
fn sh_signs_match_the_reversed_axes() {
    assert_signs_reverse_axes(super::AXIS_SIGNS, [-1.0, -1.0, 1.0]);
}

#[test]
fn positions_are_stored_with_x_left_and_y_up() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    let state = gaussians(1);
    write_glb(&state, &path).unwrap();
    let bytes = fs::read(&path).unwrap();
    assert_eq!(bytes.len() % 4, 0);
    assert_eq!(u32::from_le_bytes(bytes[8..12].try_into().unwrap()) as usize, bytes.len());
    let (document, rest) = parts(&bytes);
    let stored: Vec<f32> = rest[8..20].as_chunks::<4>().0.iter().map(|x| f32::from_le_bytes(*x)).collect();
    let [x, y, z] = state.position.row::<3>(0);
    assert_eq!(stored, [-x, -y, z]);
    let primitive = &document["meshes"][0]["primitives"][0];
    let extension = &primitive["extensions"]["KHR_gaussian_splatting"];
    assert_eq!(extension, &json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" }));
    assert_eq!((&primitive["mode"], primitive["attributes"].as_object().unwrap().len()), (&json!(0), 9));
    assert!(document["extensionsRequired"].is_null());
    assert!(document["accessors"][0]["max"][2].as_f64().unwrap() >= f64::from(z));
}

#[test]
fn a_node_turned_by_180_degrees_keeps_the_axes_of_a_ply() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    let state = gaussians(1);
    write_glb(&state, &path).unwrap();
    let bytes = fs::read(&path).unwrap();
    let (mut document, rest) = parts(&bytes);
    document["nodes"][0]["rotation"] = json!([0.0, 0.0, 1.0, 0.0]);
    fs::write(&path, file(&document, rest)).unwrap();
    let found = read_glb(&path, ReadLimit::NONE).unwrap();
    let [x, y, z] = state.position.row::<3>(4);
    assert_eq!(found.position.row::<3>(4), [-x, -y, z]);
    assert_eq!(found.sh.plane(3)[4], -state.sh.plane(3)[4]);
}

#[test]
fn damaged_files_are_refused_with_their_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    write_glb(&gaussians(1), &path).unwrap();
    let whole = fs::read(&path).unwrap();
    let refused = |bytes: &[u8], memory: ReadLimit| {
        fs::write(&path, bytes).unwrap();
        match read_glb(&path, memory) {
            Err(error @ Error::Input(_)) => error.to_string(),
            other => panic!("{:?}", other.map(|found| found.len())),
        }
    };
    for length in (0..whole.len()).step_by(5) {
        refused(&whole[..length], ReadLimit::NONE);
    }
    assert!(refused(&whole, ReadLimit::new(1000)).contains("--memory"));
    let (document, rest) = parts(&whole);
    for (place, value, expected) in [
        ("/meshes/0/primitives/0/extensions", json!({}), "one primitive"),
        ("/meshes/0/primitives/0/extensions/KHR_gaussian_splatting/kernel", json!("box"), "kernel"),
        ("/meshes/0/primitives/0/extensions/KHR_gaussian_splatting/colorSpace", json!("lin"), "colorSpace"),
        ("/meshes/0/primitives/0/attributes/POSITION", json!(99), "POSITION"),
        ("/meshes/0/primitives/0/attributes/KHR_gaussian_splatting:SCALE", json!(3), "VEC3"),
        ("/nodes/0", json!({ "mesh": 0, "translation": [1, 0, 0] }), "another transform"),
        ("/accessors/0/count", json!(31), "POSITION"),
        ("/accessors/1/count", json!(29), "30 values"),
        ("/accessors/0/count", json!(u64::MAX), "POSITION"),
        ("/accessors/1/componentType", json!(5125), "component types"),
        ("/accessors/2/sparse", json!({}), "sparse"),
        ("/bufferViews/4/byteOffset", json!(1u64 << 60), "SH_DEGREE_0_COEF_0"),
        ("/bufferViews/1/byteStride", json!(3), "ROTATION"),
        ("/bufferViews/0/buffer", json!(1), "POSITION"),
    ] {
        let mut changed = document.clone();
        match changed.pointer_mut(place) {
            Some(at) => *at = value.clone(),
            None => {
                let (parent, key) = place.rsplit_once('/').unwrap();
                changed.pointer_mut(parent).unwrap()[key] = value.clone();
            }
        }
        let message = refused(&file(&changed, rest), ReadLimit::NONE);
        assert!(message.contains("a.glb") && message.contains(expected), "{place} = {value}: {message}");
    }
    let mut wrong = whole.clone();
    let at = whole.len() - rest.len() + 8;
    wrong[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    let message = refused(&wrong, ReadLimit::NONE);
    assert!(message.contains("Gaussian 0") && message.contains("export the file again"), "{message}");
}

#[test]
fn zero_quaternions_are_read_as_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    write_glb(&gaussians(0), &path).unwrap();
    let mut bytes = fs::read(&path).unwrap();
    let (document, rest) = parts(&bytes);
    let at = bytes.len() - rest.len() + 8 + document["bufferViews"][1]["byteOffset"].as_u64().unwrap() as usize;
    bytes[at..at + 16].fill(0);
    fs::write(&path, bytes).unwrap();
    let found = read_glb(&path, ReadLimit::NONE).unwrap();
    assert_eq!(found.rotation.row::<4>(0), [0.0; 4]);
    assert_ne!(found.rotation.row::<4>(1), [0.0; 4]);
}

#[test]
fn values_that_a_file_cannot_store_are_refused() {
    let path = Path::new("never.glb");
    let refused = |edit: &dyn Fn(&mut Gaussians)| {
        let mut state = gaussians(1);
        edit(&mut state);
        write_glb(&state, path).unwrap_err().to_string()
    };
    for message in [
        refused(&|state| state.position.plane_mut(1)[7] = f32::NAN),
        refused(&|state| state.log_scale.plane_mut(0)[7] = 1000.0),
        refused(&|state| state.sh.plane_mut(5)[7] = f32::NAN),
    ] {
        assert!(message.contains("of Gaussian 7 is not finite"), "{message}");
    }
}
