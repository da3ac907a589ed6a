//! Test that reading a memory-mapped container keeps no more of the file resident than readers may hold. This file has
//! one test, because resident memory belongs to the whole process.
#![cfg(target_os = "linux")]

use std::collections::BTreeMap;
use std::fs;
use std::hint::black_box;

use gseq::{Compression, TileBuffer, TileId};
use splatsieve::diagnostics::demo_scene::DemoScene;
use splatsieve::files::container::Container;
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::outputs::container::{FRAME_BLOCK, write_container};
use splatsieve::passes::FrameReaders;
use splatsieve::source::{BlockReader, FrameSource, Ids, ReadPlan};

const COUNT: usize = 20_000;
const FRAMES: usize = 1200;

/// Returns the value of an entry of `/proc/self/status` in bytes. `line` is the start of its line.
fn status(line: &str) -> usize {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|found| found.strip_prefix(line)).unwrap();
    1024 * line.trim().trim_end_matches(" kB").parse::<usize>().unwrap()
}

#[test]
fn reading_raw_tiles_keeps_no_pages_resident() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("raw.gseq");
    write_container(&DemoScene::new(COUNT, FRAMES), &path, Compression::Raw, BTreeMap::new(), |_| ()).unwrap();
    let file = fs::metadata(&path).unwrap().len() as usize;
    let container = Container::open(&path).unwrap();
    let varying = container.info().varying;
    let before = status("RssFile:");
    let mut most = 0;

    // Block by block, as in a scan.
    let mut state = Gaussians::zeros(0, container.info().sh_degree);
    for start in (0..COUNT).step_by(1024) {
        let mut reader = container.open(Ids::Range(start..COUNT.min(start + 1024))).unwrap();
        for frame in 0..FRAMES {
            reader.read(frame, if frame == 0 { Attributes::all() } else { varying }, &mut state).unwrap();
        }
        most = most.max(status("RssFile:"));
    }
    // Frame by frame.
    let mut frames =
        FrameReaders::open(&container, Ids::Range(0..COUNT), varying, &ReadPlan::all_frames().with_max_kept_frames(1))
            .unwrap();
    let mut state = frames.state_buffer();
    for frame in 0..FRAMES {
        frames.read(frame, varying, &mut state).unwrap();
        most = most.max(status("RssFile:"));
    }
    drop(frames);
    // Some Gaussians of all tiles, some frames of each.
    let scattered: Vec<u32> = (0..COUNT as u32).step_by(7).collect();
    let wanted = ReadPlan::new((0..FRAMES).step_by(5));
    let mut frames = FrameReaders::open(&container, Ids::List(&scattered), varying, &wanted).unwrap();
    let mut state = frames.state_buffer();
    for frame in (0..FRAMES).step_by(5) {
        frames.read(frame, varying, &mut state).unwrap();
        most = most.max(status("RssFile:"));
    }
    drop(frames);
    let grown = most.saturating_sub(before);
    assert!(grown < 6 << 20, "{grown} bytes more of files resident while reading {file}");

    // Frame by frame, when a frame block of all Gaussians may be held.
    let mut frames = FrameReaders::open(&container, Ids::Range(0..COUNT), varying, &ReadPlan::all_frames()).unwrap();
    let mut state = frames.state_buffer();
    for frame in 0..FRAMES {
        frames.read(frame, varying, &mut state).unwrap();
        most = most.max(status("RssFile:"));
    }
    drop(frames);
    let block = COUNT * FRAME_BLOCK * 4 * varying.width(container.info().sh_degree);
    let held = most.saturating_sub(before);
    assert!(held < block + (6 << 20), "{held} bytes more of files resident, {block} may be held");
    let left = status("RssFile:").saturating_sub(before);
    assert!(left < 4 << 20, "{left} bytes of the file are left resident by readers that are gone");

    // Check of the measurement: it sees pages that stay mapped.
    let reader = container.reader();
    let mut touched = 0;
    for gaussian_block in 0..reader.layout().gaussian_blocks() {
        for frame_block in 0..reader.frame_blocks() {
            let at = TileId { column: 0, gaussian_block, frame_block };
            black_box(reader.tile(at, &mut TileBuffer::default()).unwrap().values().iter().sum::<f32>());
            let info = reader.tile_info(at).unwrap();
            touched += if info.constant { 0 } else { info.stored_bytes as usize };
        }
    }
    let mapped = status("RssFile:").saturating_sub(before);
    assert!(
        touched > 8 << 20 && mapped > touched - (1 << 20),
        "{mapped} bytes resident of {touched} touched in the map"
    );
    println!(
        "{file} bytes read, {grown} resident, {held} where {block} may be held; {touched} touched in the map, {mapped} resident"
    );
}
