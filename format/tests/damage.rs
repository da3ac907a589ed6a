//! Tests that damaged files cause an error that names a byte, and never a panic or wrong data.

mod scene;

use std::fs;
use std::path::Path;

use gseq::{Compression, Error, Reader, TileBuffer, TileFrames, TileId, TouchedPages, Writer, recover};
use scene::{Scene, layout};
use xxhash_rust::xxh3::xxh3_64;

/// Opens the container at `path`, verifies it and compares all its tiles with `scene`. Returns an error if the reader
/// finds the file malformed. Asserts that this error names a byte offset of at most `len`, the length of the file.
fn check(scene: &Scene, path: &Path, len: u64) -> Result<(), Error> {
    let checked = Reader::open(path).and_then(|reader| {
        let verified = reader.verify();
        scene.compare(&reader, scene.times.len())?;
        verified.map(drop)
    });
    if let Err(error) = &checked {
        assert!(matches!(error, Error::Malformed { offset, .. } if *offset <= len), "{error}");
    }
    checked
}

fn small_scene() -> Scene {
    Scene::new(layout(3, 2, 2, &[2, 1, 1]), 5, 11)
}

/// Writes a scene whose columns have error bounds to `path`. Returns the original scene, then the scene as read back
/// from the file. Tiles are large enough that the lossy encoding makes some of them smaller.
fn bounded_scene(path: &Path) -> (Scene, Scene) {
    Scene::new(layout(40, 24, 4, &[2, 1, 1, 1]), 9, 11).bounded(1e-2, path)
}

#[test]
fn flipped_bit_anywhere_is_an_error() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let scenes = [
        ((small_scene(), small_scene()), Compression::Raw),
        ((small_scene(), small_scene()), Compression::Zstd(1)),
        (bounded_scene(&path), Compression::Zstd(1)),
    ];
    for ((written, scene), compression) in scenes {
        written.write(&path, compression, |_| ());
        let good = fs::read(&path).unwrap();
        check(&scene, &path, good.len() as u64).unwrap();
        for at in 0..good.len() {
            let mut bad = good.clone();
            bad[at] ^= 1 << (at % 8);
            fs::write(&path, &bad).unwrap();
            assert!(check(&scene, &path, good.len() as u64).is_err(), "{compression:?}, byte {at}: the flip passed");
        }
    }
}

#[test]
fn cut_file_is_an_error_and_recover_saves_whole_blocks() {
    let folder = scene::folder();
    let [path, saved] = ["a", "saved"].map(|name| folder.path().join(name));
    let scene = small_scene();
    for compression in [Compression::Raw, Compression::Zstd(1)] {
        scene.write(&path, compression, |_| ());
        let good = fs::read(&path).unwrap();
        let per_block = scene.tiles().len() / 3;
        // Offset where the last tile of each frame block ends. In this scene the block's last tile has a payload of its
        // own, which lies behind all shared ones.
        let reader = Reader::open(&path).unwrap();
        let ends: Vec<u64> = (0..3)
            .map(|block| {
                let last = reader.tile_info(scene.tiles()[(block + 1) * per_block - 1]).unwrap();
                last.offset + last.stored_bytes
            })
            .collect();
        let header = good.len() - 32 - 64 - 8 * 5 - 64 * scene.tiles().len();
        assert!(ends[2] <= header as u64);
        let mut most = 0;
        for len in (0..good.len()).rev() {
            fs::write(&path, &good[..len]).unwrap();
            assert!(check(&scene, &path, len as u64).is_err(), "{len} of {} bytes passed", good.len());
            match recover(&path, &saved) {
                Err(error) => assert!(matches!(error, Error::Malformed { .. }) && len < 200, "{len}: {error}"),
                Ok(report) => {
                    let blocks = ends.iter().filter(|&&end| end <= len as u64).count();
                    assert_eq!(report.frames, [0, 2, 4, 5][blocks], "{compression:?}, {len} bytes: {report:?}");
                    let reader = Reader::open(&saved).unwrap();
                    reader.verify().unwrap();
                    scene.compare(&reader, report.frames as usize).unwrap();
                    most = most.max(report.frames);
                }
            }
        }
        assert_eq!(most, 5);
    }
}

#[test]
fn recover_saves_blocks_before_a_flipped_bit() {
    let folder = scene::folder();
    let [path, saved] = ["a", "saved"].map(|name| folder.path().join(name));
    for (written, scene) in [(small_scene(), small_scene()), bounded_scene(&path)] {
        written.write(&path, Compression::Zstd(1), |_| ());
        let good = fs::read(&path).unwrap();
        // Start after the header and its padding.
        for at in (256..good.len()).step_by(3) {
            let mut bad = good.clone();
            bad[at] ^= 0x10;
            fs::write(&path, &bad).unwrap();
            let report = recover(&path, &saved).unwrap();
            let reader = Reader::open(&saved).unwrap();
            reader.verify().unwrap();
            scene.compare(&reader, report.frames as usize).unwrap();
        }
        fs::write(&path, &good).unwrap();
        let report = recover(&path, &saved).unwrap();
        let whole = (scene.times.len() as u64, scene.tiles().len() as u64, 0);
        assert_eq!((report.frames, report.tiles_saved, report.bytes_skipped), whole);
        assert_eq!(fs::read(&saved).unwrap(), good, "recovering a whole file copies it");
    }
}

#[test]
fn file_of_a_killed_writer_is_recovered() {
    let folder = scene::folder();
    let scene = small_scene();
    let mut writer = Writer::create(folder.path().join("a"), scene.layout.clone()).unwrap();
    scene.fill(&mut writer, Compression::Zstd(1), |_| ());
    std::mem::forget(writer);
    let left = fs::read_dir(folder.path()).unwrap().next().unwrap().unwrap().path();
    let error = Reader::open(&left).err().unwrap().to_string();
    assert!(error.contains("`splatsieve info NAME.gseq --repair saved.gseq` (`gseq::recover`"), "{error}");
    let saved = folder.path().join("saved");
    assert_eq!(recover(&left, &saved).unwrap().frames, 5);
    scene.compare(&Reader::open(&saved).unwrap(), 5).unwrap();
}

/// Simulates a malicious writer: applies `change` to the index entry and to the record of tile `tile`, in a copy of the
/// container `good`, then makes every checksum valid again. Returns the bytes of the changed container.
fn forge(good: &[u8], tile: usize, change: impl Fn(&mut [u8])) -> Vec<u8> {
    let mut bad = good.to_vec();
    let u64_at = |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    let footer = u64_at(good, good.len() - 32) as usize;
    let index = footer + 64 + 8 * u64_at(good, footer + 8) as usize;
    let entry = index + 64 * tile;
    let record = u64_at(good, entry + 24) as usize - 64;
    for at in [entry, record] {
        change(&mut bad[at..at + 56]);
        let sum = xxh3_64(&bad[at..at + 56]);
        bad[at + 56..at + 64].copy_from_slice(&sum.to_le_bytes());
    }
    let sum = xxh3_64(&bad[footer + 64..good.len() - 32]);
    bad[footer + 32..footer + 40].copy_from_slice(&sum.to_le_bytes());
    let sum = xxh3_64(&bad[footer..footer + 56]);
    bad[footer + 56..footer + 64].copy_from_slice(&sum.to_le_bytes());
    bad
}

#[test]
fn forged_index_entries_are_refused() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let scene = Scene::new(layout(9, 9, 2, &[3, 1]), 4, 11);
    scene.write(&path, Compression::Raw, |_| ());
    let good = fs::read(&path).unwrap();
    let first = Reader::open(&path).unwrap().tile_info(scene.tiles()[0]).unwrap().offset;
    fs::write(&path, forge(&good, 2, |_| ())).unwrap();
    check(&scene, &path, good.len() as u64).unwrap();
    type Change = Box<dyn Fn(&mut [u8])>;
    let put = |at: usize, bytes: &[u8]| -> Change {
        let bytes = bytes.to_vec();
        Box::new(move |entry| entry[at..at + bytes.len()].copy_from_slice(&bytes))
    };
    let cases: [(&str, Change); 15] = [
        ("a reserved byte in use", put(19, &[1])),
        ("an odd offset", put(24, &(first + 4).to_le_bytes())),
        ("another column", put(4, &1u32.to_le_bytes())),
        ("a column that is not there", put(4, &u32::MAX.to_le_bytes())),
        ("another frame block", put(12, &0u32.to_le_bytes())),
        ("an unknown encoding", put(16, &[7, 0])),
        ("an order of 3", put(16, &[1, 3])),
        ("bytes that are no zstd frame", put(16, &[1, 1])),
        ("a constant flag of 2", put(18, &[2])),
        ("no frames", put(20, &0u32.to_le_bytes())),
        ("an offset beyond the file", put(24, &(1u64 << 40).to_le_bytes())),
        ("an offset that overflows", put(24, &(u64::MAX - 63).to_le_bytes())),
        ("the payload of another tile", put(24, &first.to_le_bytes())),
        ("an absurd length", put(40, &u32::MAX.to_le_bytes())),
        ("wrong statistics", put(44, &9e9f32.to_le_bytes())),
    ];
    for (name, change) in cases {
        fs::write(&path, forge(&good, 2, change)).unwrap();
        assert!(check(&scene, &path, good.len() as u64).is_err(), "{name} passed");
        let unread = Reader::open(&path).is_err();
        assert_eq!(unread, name != "wrong statistics", "{name}: only statistics wait for verification");
        // Whether `recover` keeps the forged tile or not, its output must be a valid container.
        recover(&path, folder.path().join("saved")).unwrap();
        Reader::open(folder.path().join("saved")).unwrap().verify().unwrap();
    }
}

#[test]
fn shrinking_mapped_file_is_an_error() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    for compression in [Compression::Raw, Compression::Zstd(1)] {
        let scene = Scene::new(layout(5000, 5000, 2, &[3]), 4, 5);
        scene.write(&path, compression, |_| ());
        let reader = Reader::open(&path).unwrap();
        let at = TileId { column: 0, gaussian_block: 0, frame_block: 1 };
        let (mut buffer, mut touched) = (TileBuffer::default(), TouchedPages::default());
        reader.tile(at, &mut buffer).unwrap();
        let mut loaded = [true, false].map(|in_place| (in_place, TileFrames::default()));
        for (in_place, frames) in &mut loaded {
            reader.load(at, &mut buffer, frames, in_place.then_some(&mut touched)).unwrap();
        }
        fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(4096).unwrap();
        for (in_place, mut frames) in loaded {
            let next = match compression {
                Compression::Raw => reader.read_frame(&mut frames, 1, &mut vec![0.0; 15_000]),
                // A compressed tile that was loaded is in memory, so load it again.
                _ => reader.load(at, &mut buffer, &mut frames, in_place.then_some(&mut touched)),
            };
            assert!(matches!(next, Err(Error::Malformed { .. })), "in place {in_place}: {next:?}");
        }
        reader.release(&mut touched);
        for found in [reader.tile(at, &mut buffer).map(drop), reader.verify().map(drop)] {
            assert!(matches!(found, Err(Error::Malformed { .. })), "{found:?}");
        }
    }
}

#[test]
fn error_names_folders_empty_and_foreign_files() {
    let folder = scene::folder();
    assert!(Reader::open(folder.path()).err().unwrap().to_string().contains("folder"));
    let path = folder.path().join("a");
    assert!(matches!(Reader::open(&path), Err(Error::Io { action: "open", .. })));
    fs::write(&path, "").unwrap();
    assert!(matches!(Reader::open(&path), Err(Error::Malformed { offset: 0, .. })));
    fs::write(&path, "ply\nformat binary_little_endian 1.0\nelement vertex 0\n").unwrap();
    let error = Reader::open(&path).err().unwrap().to_string();
    assert!(error.contains("byte 0: expected the gseq magic"), "{error}");
}
