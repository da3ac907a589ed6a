use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use super::*;

/// Tensor as a pickle describes it: storage class, bytes of the storage (block of values), offset, shape, strides.
struct Entry {
    name: &'static str,
    class: &'static str,
    bytes: Vec<u8>,
    element_bytes: usize,
    offset: i32,
    shape: Vec<i32>,
    stride: Vec<i32>,
}

fn f32_entry(name: &'static str, values: &[f32], shape: &[i32], stride: &[i32]) -> Entry {
    Entry {
        name,
        class: "FloatStorage",
        bytes: values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        element_bytes: 4,
        offset: 0,
        shape: shape.to_vec(),
        stride: stride.to_vec(),
    }
}

fn string(text: &str) -> Vec<u8> {
    [b"X", &(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

fn int(value: i32) -> Vec<u8> {
    [b"J", &value.to_le_bytes()[..]].concat()
}

fn tuple(items: &[i32]) -> Vec<u8> {
    [b"(".to_vec(), items.iter().flat_map(|&i| int(i)).collect(), b"t".to_vec()].concat()
}

/// Returns the pickle that torch.save writes for an OrderedDict of the tensors `entries`, but without a memo (table for
/// repeated values).
fn pickle(entries: &[Entry]) -> Vec<u8> {
    let mut out = b"\x80\x02ccollections\nOrderedDict\n)R(".to_vec();
    for (key, e) in entries.iter().enumerate() {
        out.extend(string(e.name));
        out.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        out.extend(string("storage"));
        out.extend(format!("ctorch\n{}\n", e.class).bytes());
        out.extend([string(&key.to_string()), string("cpu"), int((e.bytes.len() / e.element_bytes) as i32)].concat());
        out.extend(b"tQ");
        out.extend([int(e.offset), tuple(&e.shape), tuple(&e.stride)].concat());
        out.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    }
    out.extend(b"u.");
    out
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg()))
    })
}

/// Returns the bytes of a zip archive with uncompressed `files`, given as (name, content).
fn zip(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, bytes) in files {
        let size = (bytes.len() as u32).to_le_bytes();
        let fields = [
            &[20, 0, 0, 0, 0, 0, 0, 0, 0, 0],
            &crc32(bytes).to_le_bytes()[..],
            &size,
            &size,
            &[name.len() as u8, 0, 0, 0],
        ]
        .concat();
        let start = (out.len() as u32).to_le_bytes();
        out.extend([b"PK\x03\x04", &fields[..], name.as_bytes(), bytes].concat());
        directory.extend([b"PK\x01\x02\x14\0", &fields[..], &[0; 10], &start, name.as_bytes()].concat());
    }
    let count = (files.len() as u16).to_le_bytes();
    let end = [(directory.len() as u32).to_le_bytes(), (out.len() as u32).to_le_bytes()].concat();
    out.extend(directory);
    out.extend([b"PK\x05\x06\0\0\0\0", &count[..], &count, &end, &[0, 0]].concat());
    out
}

fn archive(pickle: Vec<u8>, storages: impl Iterator<Item = Vec<u8>>) -> Vec<u8> {
    let mut files = vec![("m/data.pkl".to_owned(), pickle), ("m/byteorder".to_owned(), b"little".to_vec())];
    files.extend(storages.enumerate().map(|(key, bytes)| (format!("m/data/{key}"), bytes)));
    files.push(("m/version".to_owned(), b"3\n".to_vec()));
    zip(&files)
}

fn state_dict(entries: &[Entry]) -> Vec<u8> {
    archive(pickle(entries), entries.iter().map(|e| e.bytes.clone()))
}

struct TempStateDict(tempfile::TempDir);

impl TempStateDict {
    fn new() -> Self {
        TempStateDict(tempfile::tempdir().unwrap())
    }

    fn read(&self, bytes: &[u8]) -> Result<Tensors> {
        let path: PathBuf = self.0.path().join("deformation.pth");
        fs::write(&path, bytes).unwrap();
        read_state_dict(&path, ReadLimit::NONE)
    }
}

fn small() -> Vec<Entry> {
    vec![
        f32_entry("net.weight", &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], &[2, 3], &[3, 1]),
        f32_entry("net.bias", &[-1.5, 0.25], &[2], &[1]),
    ]
}

#[test]
fn tensors_have_their_shapes_and_values() {
    let tensors = TempStateDict::new().read(&state_dict(&small())).unwrap();
    let expected: Tensors = BTreeMap::from([
        ("net.weight".into(), Tensor { shape: vec![2, 3], data: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0] }),
        ("net.bias".into(), Tensor { shape: vec![2], data: vec![-1.5, 0.25] }),
    ]);
    assert_eq!(tensors, expected);
}

#[test]
fn the_prefix_of_a_wrapper_is_left_out_and_noted() {
    let temp = TempStateDict::new();
    let values: [&'static str; 2] = ["module._orig_mod.a.weight", "module._orig_mod.b"];
    let wrapped = values.map(|name| f32_entry(name, &[1.0, 2.0], &[2], &[1]));
    let found = temp.read(&state_dict(&wrapped)).unwrap();
    assert_eq!(found.keys().collect::<Vec<_>>(), ["a.weight", "b"]);
    let note = || read_state_dict_with_note(&temp.0.path().join("deformation.pth"), ReadLimit::NONE).unwrap().1;
    let found_note = note().unwrap();
    assert!(found_note.contains("\"module._orig_mod.\""), "{found_note}");
    let partly = ["module.a", "b"].map(|name| f32_entry(name, &[1.0, 2.0], &[2], &[1]));
    assert_eq!(temp.read(&state_dict(&partly)).unwrap().keys().collect::<Vec<_>>(), ["b", "module.a"]);
    assert_eq!(note(), None);
}

#[test]
fn strides_and_offsets_are_honored() {
    let mut transposed = f32_entry("t", &[9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0], &[3, 2], &[1, 3]);
    transposed.offset = 1;
    let tensors = TempStateDict::new().read(&state_dict(&[transposed])).unwrap();
    assert_eq!(tensors["t"], Tensor { shape: vec![3, 2], data: vec![1.0, 4.0, 2.0, 5.0, 3.0, 6.0] });
}

#[test]
fn float_tensors_become_f32_and_others_are_left_out() {
    let entry = |name, class, element_bytes, bytes: Vec<u8>| Entry {
        name,
        class,
        element_bytes,
        shape: vec![(bytes.len() / element_bytes) as i32],
        bytes,
        offset: 0,
        stride: vec![1],
    };
    let le16 = |values: &[u16]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    // float16 values 1, −2, smallest subnormal, largest, infinity; then 1, −2, 2⁻¹³³ (subnormal) in bfloat16.
    let half = le16(&[0x3C00, 0xC000, 0x0001, 0x7BFF, 0x7C00]);
    let tensors = TempStateDict::new()
        .read(&state_dict(&[
            entry("half", "HalfStorage", 2, half),
            entry("bf16", "BFloat16Storage", 2, le16(&[0x3F80, 0xC000, 0x0001])),
            entry("double", "DoubleStorage", 8, 0.1f64.to_le_bytes().to_vec()),
            entry("bool", "BoolStorage", 1, vec![0, 1]),
            entry("long", "LongStorage", 8, 7i64.to_le_bytes().to_vec()),
        ]))
        .unwrap();
    assert_eq!(tensors["half"].data, [1.0, -2.0, 2f32.powi(-24), 65504.0, f32::INFINITY]);
    assert_eq!(tensors["bf16"].data, [1.0, -2.0, 2f32.powi(-133)]);
    assert_eq!(tensors["double"].data, [0.1]);
    assert_eq!(tensors.len(), 3);
}

#[test]
fn truncated_files_are_refused() {
    let (temp, whole) = (TempStateDict::new(), state_dict(&small()));
    for length in 0..whole.len() {
        let error = temp.read(&whole[..length]).expect_err("a cut file must be refused");
        assert!(error.to_string().contains("deformation.pth"), "cut at {length}: {error}");
    }
}

#[test]
fn flipped_bits_never_change_a_value_silently() {
    let (temp, whole) = (TempStateDict::new(), state_dict(&small()));
    let original = temp.read(&whole).unwrap();
    for at in 0..whole.len() {
        for bit in 0..8 {
            let mut bytes = whole.clone();
            bytes[at] ^= 1 << bit;
            if let Ok(tensors) = temp.read(&bytes) {
                for (name, tensor) in &tensors {
                    let same = original.get(name).is_some_and(|original| original == tensor);
                    assert!(same, "byte {at}, bit {bit}: {name} became {tensor:?}");
                }
            }
        }
    }
}

#[test]
fn random_bytes_are_refused() {
    let temp = TempStateDict::new();
    let mut seed = 3u64;
    for length in [1usize, 10, 100, 5000] {
        let bytes: Vec<u8> = std::iter::repeat_with(|| {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (seed >> 56) as u8
        })
        .take(length)
        .collect();
        temp.read(&bytes).expect_err("noise must be refused");
    }
}

#[test]
fn a_small_file_cannot_declare_huge_tensors() {
    let temp = TempStateDict::new();
    // First shape: a million values that repeat one stored value by stride 0. Second shape: its size overflows.
    for shape in [vec![1000, 1000], vec![i32::MAX, i32::MAX, i32::MAX]] {
        let stride = vec![0; shape.len()];
        temp.read(&state_dict(&[f32_entry("t", &[1.0], &shape, &stride)])).expect_err("must be refused");
    }
}

#[test]
fn wrong_storages_are_refused() {
    let temp = TempStateDict::new();
    for (shape, stride, offset) in [
        (vec![7], vec![1], 0),
        (vec![6], vec![1], 1),
        (vec![6], vec![-1], 0),
        (vec![-6], vec![1], 0),
        (vec![6], vec![1], -1),
    ] {
        let mut entry = f32_entry("t", &[0.0; 6], &shape, &stride);
        entry.offset = offset;
        let error = temp.read(&state_dict(&[entry]));
        assert!(error.is_err(), "shape {shape:?}, stride {stride:?}, offset {offset}: {error:?}");
    }
    let missing = archive(pickle(&small()), std::iter::empty());
    temp.read(&missing).expect_err("absent storages must be refused");
}

#[test]
fn a_pickle_with_a_call_is_refused_and_not_executed() {
    let temp = TempStateDict::new();
    let target = temp.0.path().join("called");
    let command = string(&format!("touch {}", target.display()));
    let pickle = [b"\x80\x02cposix\nsystem\n(".to_vec(), command, b"tR.".to_vec()].concat();
    let read = temp.read(&archive(pickle, std::iter::empty()));
    assert!(read.is_err() || read.is_ok_and(|tensors| tensors.is_empty()));
    assert!(!target.exists());
}

#[test]
fn deep_nesting_is_refused_without_stack_overflow() {
    let temp = TempStateDict::new();
    let nested = [b"\x80\x02".to_vec(), b"]".repeat(200_000), b"a".repeat(199_999), b".".to_vec()].concat();
    temp.read(&archive(nested, std::iter::empty())).expect_err("must be refused");
    let tuples = [b"\x80\x02)".to_vec(), b"\x85".repeat(200_000), b".".to_vec()].concat();
    temp.read(&archive(tuples, std::iter::empty())).expect_err("must be refused");
}

#[test]
fn a_missing_file_is_an_io_error() {
    let error = read_state_dict(Path::new("nowhere/deformation.pth"), ReadLimit::NONE).expect_err("must fail");
    assert!(matches!(error, Error::Io { .. }), "{error}");
}
