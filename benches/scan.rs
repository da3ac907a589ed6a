//! Measures the cost of the scan, the pass that reads all frames of a container, per Gaussian and frame.
//!
//! The first benchmarks measure how much time the scan takes in addition to reading, on one thread. There are no views,
//! so the scan consists of life span, motion and the search for NaN. Attributes vary in two ways: `position` alone, or
//! `all_but_sh`; attributes that do not vary are read once.
//! - `packed/scan`: scan of compressed tiles. It is compared with `packed/decode`, which only decodes the same tiles;
//!   the goal is 80% of its speed. `packed/zstd` decompresses the same values, compressed without a filter at the same
//!   level, and `packed/copy` copies them.
//! - `raw/scan`: scan of uncompressed tiles in the page cache. It is compared with plain sums over the same bytes:
//!   `raw/sum_f32`, of f32 one after the other, and `raw/sum_u32`, which is as fast as memory. The goal is half the
//!   speed of `raw/sum_f32`.
//!
//! The second benchmarks, `read_ahead/*`, scan a file on all threads. Every thread reads a block of Gaussians and
//! announces its next frame block. `warm_*` reads from the page cache, `cold_*` drops the file from the page cache first
//! (Linux).
//!
//! The third benchmarks, `raw_frames/*`, copy every frame of uncompressed tiles to a state of the caller, on all
//! threads. `ordinary` uses positioned reads. The others use a memory map and differ in when they release its pages:
//! `released_by_block` once per frame block of a Gaussian block, `released_by_frame` after every frame, and
//! `left_mapped` never, so that the whole file becomes resident.
//!
//! Usage: `cargo bench --bench scan`

use std::collections::BTreeMap;
use std::hint::black_box;
use std::path::Path;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gseq::{Compression, Reader, TileBuffer, TileFrames, TileId, TouchedPages};
use rayon::prelude::*;
use splatsieve::error::Result;
use splatsieve::files::container::Container;
use splatsieve::model::hash_id;
use splatsieve::model::{Attributes, Gaussians, SequenceInfo, ViewSchedule};
use splatsieve::outputs::container::write_container;
use splatsieve::recipe::Recipe;
use splatsieve::source::{BlockReader, FrameSource, Ids};
use splatsieve::statistics::ScanPlan;
use splatsieve::statistics::pass::scan;

const GAUSSIANS: usize = 16_384;
const FRAMES: usize = 64;

fn random(k: usize) -> f32 {
    (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32
}

/// Generated sequence: smooth curves with noise of 1e-4, about as compressible as trained models.
struct Curves(SequenceInfo);

impl FrameSource for Curves {
    fn info(&self) -> &SequenceInfo {
        &self.0
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(CurveReader { ids: ids.iter().collect(), varying: self.0.varying }))
    }
}

struct CurveReader {
    ids: Vec<usize>,
    varying: Attributes,
}

impl BlockReader for CurveReader {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        for column in want.iter() {
            let time = if self.varying.contains(column) { frame } else { 0 };
            let to = out.attribute_values_mut(column);
            to.resize(self.ids.len());
            for c in 0..to.width() {
                for (x, id) in to.plane_mut(c).iter_mut().zip(&self.ids) {
                    let k = 64 * id + c;
                    let phase = 6.0 * random(k) + 0.05 * time as f32;
                    *x = phase.sin() + 1e-4 * random(k ^ time << 32);
                }
            }
        }
        Ok(())
    }
}

/// Decodes every tile that a scan reads, and passes its values to `take`. These are all tiles of the attributes
/// `varying`, and of all other attributes only the tiles of the first frame block.
fn each_tile(reader: &Reader, varying: Attributes, mut take: impl FnMut(&[f32])) {
    let mut buffer = TileBuffer::default();
    for gaussian_block in 0..reader.layout().gaussian_blocks() {
        for frame_block in 0..reader.frame_blocks() {
            for (column, of) in Attributes::all().iter().enumerate() {
                if frame_block == 0 || varying.contains(of) {
                    let at = TileId { column: column as u32, gaussian_block, frame_block };
                    take(reader.tile(at, &mut buffer).unwrap().values());
                }
            }
        }
    }
}

fn benches(criterion: &mut Criterion) {
    let recipe = Recipe::preset("default").unwrap().scan;
    let times: Vec<f64> = (0..FRAMES).map(|t| t as f64).collect();
    let mut schedule = ViewSchedule::default();
    schedule.push_frames(FRAMES, &[]);
    let plan = ScanPlan::new(&recipe, &times, &schedule).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let dynamic = Attributes::all().difference(Attributes::SH);
    for (kind, compression) in [("packed", Compression::Zstd(1)), ("raw", Compression::Raw)] {
        for (name, varying) in [("position", Attributes::POSITION), ("all_but_sh", dynamic)] {
            let source = Curves(SequenceInfo { count: GAUSSIANS, times: times.clone(), sh_degree: 0, varying });
            let path = folder.path().join(format!("{kind}_{name}.gseq"));
            pack(&source, &path, compression);
            let container = Container::open(&path).unwrap();
            let reader = container.reader();
            let mut group = criterion.benchmark_group(kind);
            group.sample_size(20).throughput(Throughput::Elements((GAUSSIANS * FRAMES) as u64));
            group.bench_function(BenchmarkId::new("scan", name), |bencher| {
                bencher.iter(|| one_thread.install(|| scan(&container, &schedule, &plan).unwrap()));
            });
            if kind == "packed" {
                group.bench_function(BenchmarkId::new("decode", name), |bencher| {
                    bencher.iter(|| each_tile(reader, varying, |values| _ = black_box(values)));
                });
                let mut tiles = Vec::new();
                each_tile(reader, varying, |values| tiles.push(values.to_vec()));
                let plain: Vec<Vec<u8>> =
                    tiles.iter().map(|values| zstd::bulk::compress(bytemuck::cast_slice(values), 1).unwrap()).collect();
                let mut room = vec![0; tiles.iter().map(|values| 4 * values.len()).max().unwrap()];
                let mut zstd = zstd::bulk::Decompressor::new().unwrap();
                group.bench_function(BenchmarkId::new("zstd", name), |bencher| {
                    bencher.iter(|| {
                        for tile in &plain {
                            black_box(zstd.decompress_to_buffer(tile, &mut room[..]).unwrap());
                        }
                    });
                });
                group.bench_function(BenchmarkId::new("copy", name), |bencher| {
                    bencher.iter(|| {
                        for values in &tiles {
                            let bytes: &[u8] = bytemuck::cast_slice(values);
                            room[..bytes.len()].copy_from_slice(bytes);
                            black_box(&mut room);
                        }
                    });
                });
                continue;
            }
            group.bench_function(BenchmarkId::new("sum_f32", name), |bencher| {
                bencher.iter(|| each_tile(reader, varying, |values| _ = black_box(values.iter().sum::<f32>())));
            });
            group.bench_function(BenchmarkId::new("sum_u32", name), |bencher| {
                bencher.iter(|| {
                    each_tile(reader, varying, |values| {
                        let add = |sum: u32, x: &f32| sum.wrapping_add(x.to_bits());
                        black_box(values.iter().fold(0, add));
                    });
                });
            });
        }
    }
}

/// Removes the file at `path` from the page cache of the operating system.
#[cfg(target_os = "linux")]
fn drop_cached(path: &Path) {
    let of = format!("of={}", path.display());
    let dd = ["oflag=nocache", "conv=notrunc,fdatasync", "count=0", "status=none"];
    assert!(std::process::Command::new("dd").arg(of).args(dd).status().unwrap().success());
}

fn read_ahead(criterion: &mut Criterion) {
    let recipe = Recipe::preset("default").unwrap().scan;
    let times: Vec<f64> = (0..FRAMES).map(|t| t as f64).collect();
    let mut schedule = ViewSchedule::default();
    schedule.push_frames(FRAMES, &[]);
    let plan = ScanPlan::new(&recipe, &times, &schedule).unwrap();
    // A folder for temporary files may be in memory, so this one is in the target folder.
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let varying = Attributes::all().difference(Attributes::SH);
    let source = Curves(SequenceInfo { count: GAUSSIANS, times, sh_degree: 0, varying });
    for (kind, compression) in [("packed", Compression::Zstd(1)), ("raw", Compression::Raw)] {
        let path = folder.path().join(format!("{kind}.gseq"));
        pack(&source, &path, compression);
        let container = Container::open(&path).unwrap();
        let mut group = criterion.benchmark_group("read_ahead");
        group.sample_size(20).throughput(Throughput::Elements((GAUSSIANS * FRAMES) as u64));
        for speed in ["warm", "cold"] {
            group.bench_function(format!("{speed}_{kind}"), |bencher| {
                let before = || {
                    #[cfg(target_os = "linux")]
                    if speed == "cold" {
                        drop_cached(&path);
                    }
                };
                bencher.iter_batched(before, |()| scan(&container, &schedule, &plan).unwrap(), BatchSize::PerIteration);
            });
        }
        group.finish();
        if kind == "raw" {
            raw_frames(criterion, container.reader(), varying);
        }
    }
}

/// Measures the copying of every frame from uncompressed tiles to a state of the caller, for the attributes `varying`.
fn raw_frames(criterion: &mut Criterion, reader: &Reader, varying: Attributes) {
    let columns: Vec<(u32, usize)> = Attributes::all()
        .iter()
        .zip(0..)
        .filter(|&(column, _)| varying.contains(column))
        .map(|(column, place)| (place, column.width(0)))
        .collect();
    let read = |in_place: bool, release_frames: usize| {
        (0..reader.layout().gaussian_blocks()).into_par_iter().for_each(|gaussian_block| {
            let len = reader.layout().gaussian_range(gaussian_block).count();
            let (mut buffer, mut touched) = (TileBuffer::default(), TouchedPages::default());
            let mut state: Vec<Vec<f32>> = columns.iter().map(|&(_, width)| vec![0.0; width * len]).collect();
            let mut tiles: Vec<TileFrames> = columns.iter().map(|_| TileFrames::default()).collect();
            for frame_block in 0..reader.frame_blocks() {
                for frame in 0..32 {
                    for ((&(column, _), tile), out) in columns.iter().zip(&mut tiles).zip(&mut state) {
                        if frame % release_frames == 0 {
                            let at = TileId { column, gaussian_block, frame_block };
                            reader.load(at, &mut buffer, tile, in_place.then_some(&mut touched)).unwrap();
                        }
                        reader.read_frame(tile, frame, out).unwrap();
                    }
                    if (frame + 1) % release_frames == 0 {
                        reader.release(&mut touched);
                    }
                    black_box(&mut state);
                }
            }
        });
    };
    let mut group = criterion.benchmark_group("raw_frames");
    let state: usize = columns.iter().map(|&(_, width)| 4 * width).sum();
    group.sample_size(20).throughput(Throughput::Bytes((GAUSSIANS * FRAMES * state) as u64));
    for (name, in_place, release_frames) in [
        ("ordinary", false, 32),
        ("released_by_block", true, 32),
        ("released_by_frame", true, 1),
        ("left_mapped", true, usize::MAX),
    ] {
        group.bench_function(name, |bencher| bencher.iter(|| read(in_place, release_frames)));
    }
}

fn pack(source: &Curves, path: &Path, compression: Compression) {
    write_container(source, path, compression, BTreeMap::new(), |_| ()).unwrap();
}

criterion_group!(all, benches, read_ahead);
criterion_main!(all);
