//! What people hand in, damaged in every way: it is read, or refused in plain words, within a stated memory, and nothing
//! panics. The saved inputs (`make.py`) and the findings of the fuzz targets (`fuzz`), each also cut short and with bytes
//! changed, the same every time.

mod entries;
mod memory;

use std::fs;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use entries::{ENTRIES, Entry, Place};
use splatsieve::model::hash_id;

#[global_allocator]
static ALLOCATOR: memory::Counting = memory::Counting;

/// One test at a time: memory is counted for the whole process.
static COUNTED: Mutex<()> = Mutex::new(());

/// Changed copies of each saved input: cut short, and with bytes changed.
const CUTS: u64 = 24;
const CHANGES: u64 = 76;
/// Of each whole one, as many times more.
const OF_WHOLE: u64 = 8;

/// The saved inputs of an entry, by name.
fn saved(entry: &Entry) -> Vec<(PathBuf, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(entry.corpus);
    let mut files: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|file| file.unwrap().path()).collect();
    files.sort();
    files.into_iter().map(|path| (path.clone(), fs::read(path).unwrap())).collect()
}

/// Numbers without a pattern, the same every time.
struct Dice(u64);

impl Dice {
    fn below(&mut self, end: usize) -> usize {
        self.0 += 1;
        (hash_id(self.0) % end.max(1) as u64) as usize
    }
}

/// The `k`th change of `bytes`.
fn changed(bytes: &[u8], k: u64, dice: &mut Dice) -> Vec<u8> {
    if k < CUTS {
        return bytes[..dice.below(bytes.len())].to_vec();
    }
    let mut bytes = bytes.to_vec();
    for _ in 0..=dice.below(4) {
        let (at, other) = (dice.below(bytes.len()), dice.below(bytes.len()));
        let Some(&byte) = bytes.get(at) else { break };
        bytes[at] = match dice.below(4) {
            0 => byte ^ 1 << dice.below(8),
            1 => [0, 0xFF, 0x7F, 0x80][dice.below(4)],
            // A sign, a digit, a bracket: what means something in a text.
            2 => b"-+.0129eE[](){}\"'\\,: \n"[dice.below(22)],
            _ => bytes[other],
        };
    }
    bytes
}

#[test]
fn saved_inputs_and_changes_of_them_are_read_or_refused_in_plain_words_within_memory() {
    let _counted = COUNTED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let mut runs = 0;
    for entry in &ENTRIES {
        let place = Place::new();
        for (path, bytes) in saved(entry) {
            let whole = path.file_name().is_some_and(|name| name == "whole");
            let mut dice = Dice(hash_id(bytes.len() as u64));
            for round in 0..if whole { OF_WHOLE } else { 1 } {
                for k in 0..=CUTS + CHANGES {
                    // The first as it is.
                    let input = if k == 0 { bytes.clone() } else { changed(&bytes, k - 1, &mut dice) };
                    let kept = panic::catch_unwind(AssertUnwindSafe(|| entry.check(&input, &place)));
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
    let place = Place::new();
    for entry in &ENTRIES {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(entry.corpus).join("whole");
        let outcome = (entry.read)(&fs::read(path).unwrap(), &place);
        assert!(outcome.is_ok(), "{}: {}", entry.name, outcome.unwrap_err());
    }
}

#[test]
fn checksums_put_right_let_a_changed_value_through() {
    let _counted = COUNTED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let place = Place::new();
    for (entry, name) in ENTRIES.iter().filter(|entry| ["container", "archive"].contains(&entry.name)).zip([
        // The last byte of an archive is of its table's blobs; a container's first tile stores position.
        "archive",
        "container",
    ]) {
        assert_eq!(entry.name, name);
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(name).join("whole");
        let whole = fs::read(path).unwrap();
        assert_eq!((entry.mended)(&whole).unwrap(), whole, "{name}: what is right stays");
        let record = whole.windows(4).position(|four| four == b"TILE");
        // A stored minimum, which `verify` compares with the values; a length in the head.
        let at = record.map_or(20, |record| record + 44);
        let mut damaged = whole.clone();
        damaged[at] ^= 1;
        let [before, after] = [damaged.clone(), (entry.mended)(&damaged).unwrap()]
            .map(|bytes| (entry.read)(&bytes, &place).unwrap_err().to_string());
        assert!(before.contains("checksum"), "{name}: {before}");
        assert!(!after.contains("checksum"), "{name}: {after}");
    }
}
