use std::cell::RefCell;
use std::fs;

use super::*;

fn request(folder: &Path, part: Option<&str>) -> CacheRequest {
    CacheRequest { folder: folder.join("work"), shard: part.map(|part| part.parse().unwrap()) }
}

fn open_cache(folder: &Path, part: Option<&str>) -> Cache {
    Cache::open(&request(folder, part), "a test".to_owned()).unwrap()
}

/// Runs a stage that computes the squares of the numbers from 0 to `units` − 1, in shards (parts of the numbers), with
/// the cache `work`. Returns the result of the stage, and the numbers whose squares this call computed because they
/// were not in the cache.
fn squares(work: &Cache, units: usize) -> (Result<Vec<u64>>, Vec<usize>) {
    let computed = RefCell::new(Vec::new());
    let compute = |some: Range<usize>| {
        computed.borrow_mut().extend(some.clone());
        Ok(some.map(|unit| (unit * unit) as u64).collect::<Vec<u64>>())
    };
    let join = |parts: &mut dyn Iterator<Item = Result<Vec<u64>>>| {
        let mut all = Vec::new();
        for part in parts {
            all.extend(part?);
        }
        Ok(all)
    };
    let found = work.compute_in_shards("squares", CacheKey::new(&units), units, compute, join);
    (found, computed.into_inner())
}

fn undivided_squares(units: usize) -> Vec<u64> {
    (0..units as u64).map(|unit| unit * unit).collect()
}

fn names_in(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn shards_in_any_order_join_to_the_undivided_result() {
    for (units, of) in [(10, 1), (10, 2), (10, 7), (10, 64), (0, 3), (1, 2)] {
        let folder = tempfile::tempdir().unwrap();
        let mut computed = Vec::new();
        for index in (1..=of).rev().chain([1, of]).take(if of == 1 { 1 } else { 2 * of }) {
            if of > 1 && count_files(folder.path()) == of {
                break;
            }
            let (found, units) = squares(&open_cache(folder.path(), Some(&format!("{index}/{of}"))), units);
            let message = found.unwrap_err().to_string();
            assert!(message.contains(&format!("part {index}/{of} is done")), "{message}");
            computed.extend(units);
        }
        computed.sort_unstable();
        assert_eq!(computed, (0..units).collect::<Vec<_>>(), "{of} parts");
        let (found, again) = squares(&open_cache(folder.path(), None), units);
        assert_eq!((found.unwrap(), again), (undivided_squares(units), Vec::new()), "{of} parts");
    }
}

fn count_files(folder: &Path) -> usize {
    let work = folder.join("work");
    if work.exists() { names_in(&work).len() } else { 0 }
}

#[test]
fn stored_shard_is_not_recomputed_missing_ones_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for index in [2, 3, 5] {
        _ = squares(&open_cache(folder.path(), Some(&format!("{index}/6"))), 12);
    }
    let (found, computed) = squares(&open_cache(folder.path(), Some("3/6")), 12);
    assert_eq!(found.unwrap_err().to_string(), "squares: part 3/6 is there already; missing: 1, 4, 6");
    assert!(computed.is_empty());
    let work = open_cache(folder.path(), None);
    let (found, computed) = squares(&work, 12);
    assert_eq!((found.unwrap(), computed), (undivided_squares(12), vec![0, 1, 6, 7, 10, 11]));
    assert_eq!(work.take_notes(), ["squares: of 6 parts these are missing and computed here: 1, 4, 6"]);
    // The undivided result is stored now.
    assert!(squares(&open_cache(folder.path(), Some("1/2")), 12).0.is_ok());
}

#[test]
fn shards_of_another_input_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let open_for = |about: &str, part: Option<&str>| {
        let mut work = Cache::open(&request(folder.path(), part), about.to_owned()).unwrap();
        work.depend_on(CacheKey::new(&about));
        work
    };
    _ = squares(&open_for("the first", Some("1/2")), 8);
    let message = squares(&open_for("the second", Some("2/2")), 8).0.unwrap_err().to_string();
    assert!(message.contains("missing: 1") && message.contains("they belong to the first"), "{message}");
    let third = open_for("the third", None);
    assert_eq!(squares(&third, 8).0.unwrap(), undivided_squares(8));
    let notes = third.take_notes().join("\n");
    assert!(notes.contains("belong to the first") && notes.contains("belong to the second"), "{notes}");
}

#[test]
fn other_inputs_and_parameters_do_not_find_the_result() {
    let folder = tempfile::tempdir().unwrap();
    let key = |number: f64| CacheKey::new(&("stage", number));
    let mut work = open_cache(folder.path(), None);
    work.depend_on(CacheKey::new(&"an input"));
    work.store("stage", key(0.0), &7u32).unwrap();
    assert_eq!(work.load("stage", key(0.0)).unwrap(), Some(7u32));
    assert_eq!(work.load::<u32>("stage", key(-0.0)).unwrap(), None);
    assert_eq!(work.load::<u32>("another", key(0.0)).unwrap(), None);
    let mut other = open_cache(folder.path(), None);
    assert_eq!(other.load::<u32>("stage", key(0.0)).unwrap(), None);
    other.depend_on(CacheKey::new(&"another input"));
    assert_eq!(other.load::<u32>("stage", key(0.0)).unwrap(), None);
}

#[test]
fn damaged_or_renamed_entry_is_recomputed_with_a_note() {
    let folder = tempfile::tempdir().unwrap();
    _ = squares(&open_cache(folder.path(), None), 40).0.unwrap();
    let (work, [name]) = (folder.path().join("work"), &names_in(&folder.path().join("work"))[..]) else {
        panic!("one piece is kept")
    };
    let whole = fs::read(work.join(name)).unwrap();
    let lengths = [0, 1, 47, 48, whole.len() - 1];
    let cut = lengths.map(|length| whole[..length].to_vec());
    let flipped = (0..whole.len()).map(|byte| {
        let mut flipped = whole.clone();
        flipped[byte] ^= 1 << (byte % 8);
        flipped
    });
    let longer = [&whole[..], &[0]].concat();
    for (case, damaged) in cut.into_iter().chain(flipped).chain([longer]).enumerate() {
        fs::write(work.join(name), damaged).unwrap();
        let kept = open_cache(folder.path(), None);
        let (found, computed) = squares(&kept, 40);
        assert_eq!((found.unwrap(), computed.len()), (undivided_squares(40), 40), "case {case}");
        assert!(kept.take_notes()[0].contains("is damaged"), "case {case}");
        assert_eq!(fs::read(work.join(name)).unwrap(), whole, "case {case}");
    }
    let other = name.replace("squares", "cubes");
    fs::rename(work.join(name), work.join(&other)).unwrap();
    assert_eq!(squares(&open_cache(folder.path(), None), 40).1.len(), 40);
}

#[test]
fn content_on_disk_is_divided_and_unnamed_without_a_folder() {
    let write =
        |some: Range<usize>, to: &mut SpillWriter| some.map(|unit| unit as u8).try_for_each(|byte| to.write(&[byte]));
    let read = |spills: Vec<(Range<usize>, Spill)>| -> Vec<u8> {
        let contents = |(some, spill): &(Range<usize>, Spill)| {
            let mut bytes = vec![0; some.len()];
            spill.read(0, &mut bytes).unwrap();
            bytes
        };
        spills.iter().flat_map(contents).collect()
    };
    let expected: Vec<u8> = (0..50).collect();
    let folder = tempfile::tempdir().unwrap();
    let spilled = |work: &Cache| work.spill_in_shards("bytes", CacheKey::new(&1), 50, folder.path(), write);
    assert_eq!(read(spilled(&Cache::disabled()).unwrap()), expected);
    assert!(names_in(folder.path()).is_empty());
    for index in 1..=3 {
        assert!(spilled(&open_cache(folder.path(), Some(&format!("{index}/3")))).is_err());
    }
    let found = spilled(&open_cache(folder.path(), None)).unwrap();
    assert_eq!(found.len(), 3);
    assert_eq!(read(found), expected);
    // Damage one of the shards.
    let work = folder.path().join("work");
    fs::write(work.join(&names_in(&work)[1]), b"SPLSPIEC").unwrap();
    assert_eq!(read(spilled(&open_cache(folder.path(), None)).unwrap()), expected);
}

#[test]
fn undivided_stage_ends_a_run_of_a_shard() {
    let folder = tempfile::tempdir().unwrap();
    let run_undivided = |work: &Cache| {
        work.get_or_compute("alone", CacheKey::new(&1), || work.end_shard_run_before("alone").map(|()| 5u8))
    };
    let message = run_undivided(&open_cache(folder.path(), Some("1/2"))).unwrap_err().to_string();
    assert!(message.contains("the next stage, alone, is not divided"), "{message}");
    assert_eq!(run_undivided(&open_cache(folder.path(), None)).unwrap(), 5);
    assert_eq!(run_undivided(&open_cache(folder.path(), Some("1/2"))).unwrap(), 5);
}

#[test]
fn listing_names_contents_and_cleaning_keeps_other_files() {
    let folder = tempfile::tempdir().unwrap();
    let work = folder.path().join("work");
    _ = squares(&open_cache(folder.path(), Some("2/3")), 9);
    open_cache(folder.path(), None).store("stage", CacheKey::new(&1), &[1u64, 2]).unwrap();
    let listed = list_results(&work).unwrap();
    assert_eq!(listed.len(), 2);
    let [squares, stage] = [0, 1].map(|k| &listed[k]);
    assert_eq!((&squares.stage[..], squares.parts, &squares.missing[..]), ("squares", 3, &[1, 3][..]));
    assert_eq!((&stage.stage[..], stage.parts, stage.missing.len(), stage.damaged.len()), ("stage", 1, 0, 0));
    assert!(listed.iter().all(|entry| entry.belongs_to == "a test" && entry.bytes > 48));
    assert!(format_list(&listed).contains("3 parts, missing: 1, 3"), "{}", format_list(&listed));
    fs::write(work.join("mine.txt"), "kept").unwrap();
    assert_eq!(remove_entries(&work).unwrap().0, 2);
    assert_eq!(names_in(&work), ["mine.txt"]);
    fs::remove_file(work.join("mine.txt")).unwrap();
    remove_entries(&work).unwrap();
    assert!(!work.exists() && list_results(&work).is_err());
}

#[test]
fn invalid_or_vanished_folder_is_an_error_that_names_it() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("work"), "a file").unwrap();
    let message = Cache::open(&request(folder.path(), None), String::new()).unwrap_err().to_string();
    assert!(message.contains("expected a folder"), "{message}");
    fs::remove_file(folder.path().join("work")).unwrap();
    let work = open_cache(folder.path(), None);
    fs::remove_dir(folder.path().join("work")).unwrap();
    for message in [
        work.store("stage", CacheKey::new(&1), &1).unwrap_err(),
        work.load::<i32>("stage", CacheKey::new(&1)).unwrap_err(),
    ] {
        assert!(message.to_string().contains("work"), "{message}");
    }
    let message = Cache::open(&request(&folder.path().join("nowhere"), None), String::new()).unwrap_err().to_string();
    assert!(message.contains("nowhere"), "{message}");
}

#[test]
fn shard_is_parsed_from_index_and_count() {
    for good in ["1/1", "3/8", "64/64"] {
        assert_eq!(good.parse::<Shard>().unwrap().to_string(), good);
    }
    for bad in ["", "1", "0/3", "4/3", "1/0", "a/b", "1/2/3", "-1/2", "1/901"] {
        assert!(bad.parse::<Shard>().is_err(), "{bad}");
    }
}

#[test]
fn no_key_is_hashed_without_a_work_folder() {
    struct Untouched;
    impl Serialize for Untouched {
        fn serialize<S: serde::Serializer>(&self, _: S) -> std::result::Result<S::Ok, S::Error> {
            unreachable!("it would be hashed for nothing")
        }
    }
    assert_eq!(Cache::disabled().key(&Untouched), CacheKey::NONE);
    assert_eq!(CacheKey::NONE.extended_by(&Untouched), CacheKey::NONE);
}
