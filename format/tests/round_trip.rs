//! Tests that values are read back bit for bit, for every shape and order of writing.

mod scene;

use std::fs;

use gseq::{
    Compression, Encoding, Error, Layout, Reader, TileBuffer, TileFrames, TileId, TileReadCounts, TouchedPages, Writer,
    encode_tile,
};
use proptest::prelude::*;
use scene::{Scene, layout};
use xxhash_rust::xxh3::xxh3_64;

const AT: TileId = TileId { column: 0, gaussian_block: 0, frame_block: 0 };

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_sequence_survives_bit_for_bit(
        gaussians in 0u64..60, frames in 0usize..12, gaussian_block in 1u32..70, frame_block in 1u32..6,
        widths in prop::collection::vec(1u32..4, 1..4), raw: bool, seed: u64, rotate in 0usize..50,
    ) {
        let folder = scene::folder();
        let path = folder.path().join("a.gseq");
        let scene = Scene::new(layout(gaussians, gaussian_block, frame_block, &widths), frames, seed);
        let compression = if raw { Compression::Raw } else { Compression::Zstd(1) };
        let digest = scene.write(&path, compression, |ids| if !ids.is_empty() { let by = rotate % ids.len(); ids.rotate_left(by) });
        let reader = Reader::open(&path).unwrap();
        scene.compare(&reader, frames).unwrap();
        prop_assert_eq!(reader.digest(), digest);
        prop_assert_eq!(reader.verify().unwrap().tiles, scene.tiles().len() as u64);
        prop_assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "a temporary file is left");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Checks columns with an error bound: values are within the bound, every method of reading returns the same
    /// values, and the file states the bounds.
    #[test]
    fn bounded_columns_are_within_their_bound(
        gaussians in 1u64..90, frames in 1usize..12, gaussian_block in 1u32..70, frame_block in 1u32..6,
        widths in prop::collection::vec(1u32..4, 2..4), seed: u64, max_error in 1e-4f64..1.0,
    ) {
        let folder = scene::folder();
        let path = folder.path().join("a.gseq");
        let layout = layout(gaussians, gaussian_block, frame_block, &widths);
        let (exact, back) = Scene::new(layout, frames, seed).bounded(max_error, &path);
        let reader = Reader::open(&path).unwrap();
        back.compare(&reader, frames).unwrap();
        reader.verify().unwrap();
        for ((column, before), after) in reader.layout().columns.iter().zip(&exact.bits).zip(&back.bits) {
            prop_assert_eq!(before.len(), after.len());
            for (&before, &after) in before.iter().zip(after) {
                let [value, found] = [before, after].map(|bits| f64::from(f32::from_bits(bits)));
                let within = before == after || (value - found).abs() <= column.max_error;
                prop_assert!(within, "{}: {} is {}", &column.name, value, found);
            }
        }
    }
}

#[test]
fn tile_with_larger_bound_than_column_is_refused() {
    let folder = scene::folder();
    let mut layout = layout(500, 500, 2, &[1]);
    layout.columns[0].max_error = 1e-3;
    let values: Vec<f32> = (0..1000).map(|i| (i as f32).sin()).collect();
    let tile = |max_error| encode_tile(&values, 2, 1, 500, Compression::Bounded { max_error, level: 1 }).unwrap();
    let mut writer = Writer::create(folder.path().join("a"), layout).unwrap();
    writer.append_times(&[0.0, 1.0]).unwrap();
    let error = writer.write_tile(AT, &tile(2e-3)).unwrap_err().to_string();
    assert!(error.contains("may be off by 0.001"), "{error}");
    writer.write_tile(AT, &tile(5e-4)).unwrap();
    writer.finish().unwrap();
    let encoding = Reader::open(folder.path().join("a")).unwrap().tile_info(AT).unwrap().encoding;
    assert!(matches!(encoding, Encoding::Bounded { .. }), "{encoding:?}");
    for max_error in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-320] {
        let refused = encode_tile(&values, 2, 1, 500, Compression::Bounded { max_error, level: 1 });
        assert!(refused.is_err(), "a bound of {max_error} passed");
    }
}

#[test]
fn digest_ignores_write_order_but_bytes_do_not() {
    let folder = scene::folder();
    let [a, b, c] = ["a", "b", "c"].map(|name| folder.path().join(name));
    let scene = Scene::new(layout(30, 8, 3, &[3, 2, 1]), 7, 5);
    let first = scene.write(&a, Compression::Zstd(1), |_| ());
    assert_eq!(scene.write(&b, Compression::Zstd(1), |_| ()), first);
    assert_eq!(scene.write(&c, Compression::Zstd(1), |ids| ids.reverse()), first);
    assert_eq!(fs::read(&a).unwrap(), fs::read(&b).unwrap());
    assert_ne!(fs::read(&a).unwrap(), fs::read(&c).unwrap());
    let mut other = Scene::new(layout(30, 8, 3, &[3, 2, 1]), 7, 5);
    other.bits[2][11] ^= 1;
    assert_ne!(other.write(&b, Compression::Zstd(1), |_| ()), first, "a changed bit must change the digest");
}

/// Checks that the bytes of version 1 are unchanged, by a hash recorded when version 1 was made. The tiles are raw, so
/// zstd does not affect the hash. If it changes, the format version must change too.
#[test]
fn bytes_of_version_1_are_unchanged() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    Scene::new(layout(30, 8, 3, &[3, 2, 1]), 7, 5).write(&path, Compression::Raw, |_| ());
    let bytes = fs::read(&path).unwrap();
    assert_eq!(bytes[..12], *b"\x89GSEQ\r\n\x1a\x01\0\0\0");
    assert_eq!((bytes.len(), xxh3_64(&bytes)), (9752, 2_483_963_558_680_014_291));
}

#[test]
fn a_column_that_never_changes_is_stored_once() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let scene = Scene::new(layout(100, 100, 2, &[1, 48]), 8, 5);
    scene.write(&path, Compression::Raw, |_| ());
    let reader = Reader::open(&path).unwrap();
    let infos: Vec<_> =
        (0..4).map(|frame_block| reader.tile_info(TileId { column: 1, frame_block, ..AT }).unwrap()).collect();
    assert!(infos.iter().all(|info| info.constant && info.offset == infos[0].offset && info.stored_bytes == 4 * 4800));
    assert_eq!(reader.verify().unwrap().stored_bytes, 4 * 4800 + 4 * 100 * 8);
}

#[test]
fn motion_that_returns_to_its_start_is_kept() {
    // Frame 8 equals frame 0; all frames are in one block.
    let frames = 9;
    let folder = scene::folder();
    let path = folder.path().join("a");
    let turning = || {
        let mut scene = Scene::new(layout(50, 50, 9, &[2, 1]), frames, 5);
        let place = |i: usize| (i % 100) as f32 + ((i / 100 % 8) as f32 * 0.7).sin();
        scene.bits[0] = (0..frames * 100).map(|i| place(i).to_bits()).collect();
        scene
    };
    for compression in [Compression::Raw, Compression::Zstd(1)] {
        turning().write(&path, compression, |_| ());
        turning().compare(&Reader::open(&path).unwrap(), frames).unwrap();
    }
    let (exact, back) = turning().bounded(1e-3, &path);
    let off = |(&a, &b): (&u32, &u32)| (f32::from_bits(a) - f32::from_bits(b)).abs();
    let furthest = exact.bits[0].iter().zip(&back.bits[0]).map(off).fold(0.0, f32::max);
    assert!(furthest <= 1e-3, "a track is {furthest} off");
}

#[test]
fn repeated_tile_equals_tile_written_again() {
    let folder = scene::folder();
    let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
    let tile = encode_tile(&[1.0, 2.0, 3.0], 1, 3, 1, Compression::Zstd(1)).unwrap();
    for (path, repeat) in [(&a, false), (&b, true)] {
        let mut writer = Writer::create(path, layout(1, 1, 2, &[3])).unwrap();
        for times in [&[0.0, 1.0][..], &[2.0, 3.0], &[4.0]] {
            let at = TileId { frame_block: writer.append_times(times).unwrap(), ..AT };
            if at.frame_block > 0 && repeat {
                writer.repeat_tile(at).unwrap();
                assert!(writer.repeat_tile(at).is_err(), "a tile is written once");
            } else {
                assert!(at.frame_block > 0 || writer.repeat_tile(at).is_err(), "there is nothing to repeat yet");
                writer.write_tile(at, &tile).unwrap();
            }
        }
        writer.finish().unwrap();
    }
    assert_eq!(fs::read(a).unwrap(), fs::read(b).unwrap());
}

#[test]
fn one_encoded_frame_serves_frame_blocks_of_any_length() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let mut writer = Writer::create(&path, layout(2, 2, 3, &[1])).unwrap();
    let tile = encode_tile(&[1.0, 2.0], 1, 1, 2, Compression::Raw).unwrap();
    for times in [&[0.0, 1.0, 2.0][..], &[3.0]] {
        let frame_block = writer.append_times(times).unwrap();
        writer.write_tile(TileId { frame_block, ..AT }, &tile).unwrap();
    }
    writer.finish().unwrap();
    let reader = Reader::open(&path).unwrap();
    assert_eq!(reader.tile(AT, &mut TileBuffer::default()).unwrap().plane(2, 0), [1.0, 2.0]);
}

#[test]
fn threads_share_a_reader() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let scene = Scene::new(layout(40, 8, 2, &[3, 1, 1]), 6, 5);
    for compression in [Compression::Raw, Compression::Zstd(1)] {
        scene.write(&path, compression, |_| ());
        let reader = Reader::open(&path).unwrap();
        std::thread::scope(|threads| {
            for _ in 0..4 {
                threads.spawn(|| scene.compare(&reader, 6).unwrap());
            }
        });
    }
}

#[test]
fn raw_tiles_are_aligned_and_used_in_place() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let scene = Scene::new(layout(7, 3, 2, &[3]), 4, 5);
    scene.write(&path, Compression::Raw, |_| ());
    let reader = Reader::open(&path).unwrap();
    for id in scene.tiles() {
        let info = reader.tile_info(id).unwrap();
        assert_eq!((info.encoding, info.offset % 64), (Encoding::Raw, 0));
        let mut buffers = [TileBuffer::default(), TileBuffer::default()];
        let [a, b] = buffers.each_mut().map(|buffer| reader.tile(id, buffer).unwrap().values().as_ptr());
        assert_eq!(a, b, "two buffers, one place");
    }
}

#[test]
fn every_stored_byte_read_is_counted_once() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let scene = Scene::new(layout(7, 3, 2, &[3, 1]), 5, 5);
    for compression in [Compression::Raw, Compression::Zstd(1)] {
        scene.write(&path, compression, |_| ());
        let reader = Reader::open(&path).unwrap();
        assert_eq!(reader.tiles_read(), TileReadCounts::default(), "opening reads no tile");
        let (mut buffer, mut frames, mut touched) =
            (TileBuffer::default(), TileFrames::default(), TouchedPages::default());
        for in_place in [true, false, true] {
            let before = reader.tiles_read();
            let mut stored = 0;
            for id in scene.tiles() {
                let info = reader.tile_info(id).unwrap();
                stored += info.stored_bytes;
                reader.load(id, &mut buffer, &mut frames, in_place.then_some(&mut touched)).unwrap();
                let (_, _, width, len) = scene.tile(id);
                let mut values = vec![0.0; (width * len) as usize];
                for frame in 0..info.frames as usize {
                    reader.read_frame(&mut frames, frame, &mut values).unwrap();
                }
            }
            let read = reader.tiles_read();
            assert_eq!(read.bytes - before.bytes, stored, "{compression:?}, in place {in_place}");
            assert_eq!(read.tiles - before.tiles, scene.tiles().len() as u64);
        }
    }
}

#[test]
fn final_name_appears_only_at_the_end() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let scene = Scene::new(layout(5, 2, 2, &[3]), 4, 5);
    let mut writer = Writer::create(&path, scene.layout.clone()).unwrap();
    scene.fill(&mut writer, Compression::Raw, |_| ());
    let names: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert!(names.len() == 1 && names[0].to_string_lossy().ends_with(".tmp"), "{names:?}");
    drop(writer);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "dropping the writer removes its file");
}

#[test]
fn invalid_calls_are_refused_and_writer_stays_usable() {
    let folder = scene::folder();
    let path = folder.path().join("a");
    let mut writer = Writer::create(&path, layout(2, 2, 3, &[1])).unwrap();
    let tile = encode_tile(&[1.0, 2.0, 3.0, 4.0], 2, 1, 2, Compression::Raw).unwrap();
    assert!(matches!(writer.write_tile(AT, &tile), Err(Error::Usage(_))), "before its time stamps");
    for times in [&[][..], &[f64::NAN], &[0.0, 0.0], &[1.0, 0.5], &[0.0, 1.0, 2.0, 3.0]] {
        assert!(matches!(writer.append_times(times), Err(Error::Usage(_))), "{times:?}");
    }
    writer.append_times(&[0.0, 1.0]).unwrap();
    assert!(matches!(writer.append_times(&[2.0]), Err(Error::Usage(_))), "after a short block");
    assert!(writer.write_tile(TileId { column: 1, ..AT }, &tile).is_err());
    assert!(writer.write_tile(AT, &encode_tile(&[1.0, 2.0], 2, 1, 1, Compression::Raw).unwrap()).is_err());
    writer.write_tile(AT, &tile).unwrap();
    assert!(writer.write_tile(AT, &tile).is_err(), "twice");
    writer.finish().unwrap();
    Reader::open(&path).unwrap().verify().unwrap();
    let mut writer = Writer::create(folder.path().join("b"), layout(2, 2, 3, &[1])).unwrap();
    writer.append_times(&[0.0]).unwrap();
    assert!(writer.finish().unwrap_err().to_string().contains("1 of 1 tiles are missing"));
    assert!(!folder.path().join("b").exists());
}

#[test]
fn layouts_outside_their_limits_are_refused() {
    let folder = scene::folder();
    let good = layout(10, 4, 4, &[3]);
    let bad: [fn(&mut Layout); 9] = [
        |l| l.gaussian_block = 0,
        |l| l.frame_block = 0,
        |l| l.frame_block = u32::MAX,
        |l| l.gaussians = (1 << 32) + 1,
        |l| l.columns.clear(),
        |l| l.columns[0].width = 0,
        |l| l.columns[0].width = u32::MAX,
        |l| l.columns[0].name = "Position".into(),
        |l| l.columns.push(l.columns[0].clone()),
    ];
    for (i, spoil) in bad.iter().enumerate() {
        let mut layout = good.clone();
        spoil(&mut layout);
        assert!(matches!(Writer::create(folder.path().join("a"), layout), Err(Error::Usage(_))), "case {i}");
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}
