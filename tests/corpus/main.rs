//! Tests that damaged inputs of every format are read or refused in plain words, within a stated memory, and never
//! cause a panic. The inputs are those that `make.py` made and those that the fuzz targets (`fuzz`) found. They are
//! read unchanged, cut short, and with changed bytes; the changes are the same in every run.

mod entries;
mod memory;

use std::fs;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use entries::{ENTRIES, Entry, InputFolder};
use splatsieve::model::hash_id;

#[global_allocator]
static ALLOCATOR: memory::Counting = memory::Counting;

/// Lock that lets one test run at a time, because memory is counted for the whole process.
static COUNTED: Mutex<()> = Mutex::new(());

/// Number of copies of each saved input that are cut short (`CUTS`), and with changed bytes (`CHANGES`).
const CUTS: u64 = 24;
const CHANGES: u64 = 76;
/// Number of times that `CUTS` + `CHANGES` damaged copies are made of each saved input named `whole`.
const ROUNDS_OF_WHOLE: u64 = 8;

/// Returns path and content of each saved input of `entry`.
fn saved(entry: &Entry) -> Vec<(PathBuf, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(entry.corpus);
    let mut files: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|file| file.unwrap().path()).collect();
    files.sort();
    files.into_iter().map(|path| (path.clone(), fs::read(path).unwrap())).collect()
}

/// Generator of pseudorandom numbers that are the same in every run.
struct Random(u64);

impl Random {
    fn below(&mut self, end: usize) -> usize {
        self.0 += 1;
        (hash_id(self.0) % end.max(1) as u64) as usize
    }
}

/// Returns damaged copy number `k` of `bytes`: cut short if `k` is below [`CUTS`], otherwise with changed bytes.
fn changed(bytes: &[u8], k: u64, random: &mut Random) -> Vec<u8> {
    if k < CUTS {
        return bytes[..random.below(bytes.len())].to_vec();
    }
    let mut bytes = bytes.to_vec();
    for _ in 0..=random.below(4) {
        let (at, other) = (random.below(bytes.len()), random.below(bytes.len()));
        let Some(&byte) = bytes.get(at) else { break };
        bytes[at] = match random.below(4) {
            0 => byte ^ 1 << random.below(8),
            1 => [0, 0xFF, 0x7F, 0x80][random.below(4)],
            // A sign, digit or bracket, which has a meaning in text formats.
            2 => b"-+.0129eE[](){}\"'\\,: \n"[random.below(22)],
            _ => bytes[other],
        };
    }
    bytes
}

#[test]
fn damaged_inputs_are_read_or_refused_within_memory() {
    let _counted = COUNTED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let mut runs = 0;
    for entry in &ENTRIES {
        let folder = InputFolder::new();
        for (path, bytes) in saved(entry) {
            let whole = path.file_name().is_some_and(|name| name == "whole");
            let mut random = Random(hash_id(bytes.len() as u64));
            for round in 0..if whole { ROUNDS_OF_WHOLE } else { 1 } {
                for k in 0..=CUTS + CHANGES {
                    // The first input is unchanged.
                    let input = if k == 0 { bytes.clone() } else { changed(&bytes, k - 1, &mut random) };
                    let kept = panic::catch_unwind(AssertUnwindSafe(|| entry.check(&input, &folder)));
                    assert!(kept.is_ok(), "{} of {}, change {k} of round {round}", entry.name, path.display());
                    runs += 1;
                }
            }
        }
    }
    println!("{runs} inputs");
    assert!(runs > 30_000, "{runs}");
}

#[test]
fn whole_inputs_are_read() {
    let _counted = COUNTED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let folder = InputFolder::new();
    for entry in &ENTRIES {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(entry.corpus).join("whole");
        let outcome = (entry.read)(&fs::read(path).unwrap(), &folder);
        assert!(outcome.is_ok(), "{}: {}", entry.name, outcome.unwrap_err());
    }
}

#[test]
fn archives_of_other_formats_are_read() {
    let _counted = COUNTED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let folder = InputFolder::new();
    for (target, names) in [
        ("archive", &["of_splatv", "of_windows", "of_checkpoint", "of_params", "of_network"][..]),
        ("archive_sections", &["layout"]),
    ] {
        let entry = ENTRIES.iter().find(|entry| entry.name == target).unwrap();
        for name in names {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(entry.corpus).join(name);
            let outcome = (entry.read)(&fs::read(path).unwrap(), &folder);
            assert!(outcome.is_ok(), "{name}: {}", outcome.unwrap_err());
        }
    }
}

#[test]
fn repaired_checksums_let_changed_values_through() {
    let _counted = COUNTED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let folder = InputFolder::new();
    for (entry, name) in ENTRIES.iter().filter(|entry| ["container", "archive"].contains(&entry.name)).zip([
        // The last byte of an archive belongs to the blobs of its table; the first tile of a container stores
        // positions.
        "archive",
        "container",
    ]) {
        assert_eq!(entry.name, name);
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(name).join("whole");
        let whole = fs::read(path).unwrap();
        assert_eq!((entry.repair_checksums)(&whole).unwrap(), whole, "{name}: what is right stays");
        let record = whole.windows(4).position(|four| four == b"TILE");
        // A stored minimum, which `verify` compares with the values, or a length in the header.
        let at = record.map_or(20, |record| record + 44);
        let mut damaged = whole.clone();
        damaged[at] ^= 1;
        let [before, after] = [damaged.clone(), (entry.repair_checksums)(&damaged).unwrap()]
            .map(|bytes| (entry.read)(&bytes, &folder).unwrap_err().to_string());
        assert!(before.contains("checksum"), "{name}: {before}");
        assert!(!after.contains("checksum"), "{name}: {after}");
    }
}
