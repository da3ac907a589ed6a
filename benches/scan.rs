//! How much does the scan of a container cost beyond reading it, per Gaussian and frame, on one thread?
//!
//! Without views, so that life span, motion and the search for NaN are all there is. `packed/*`: the rival `decode`
//! decodes the same tiles and drops them; the scan should run at 80% of its speed. How good a rival that is, show
//! `zstd`, which decompresses the same values, compressed without a filter at the same level, and `copy`, which
//! copies them. `raw/*`: the tiles lie in the
//! page cache, and the rivals are plain sums over the same bytes: of f32 one after the other, and of u32, which
//! is as fast as memory; the scan should run at half the speed of the first. `position` varies alone, or with
//! rotation, scale and opacity; the constant columns are read once.
//!
//! How is the scan of a container best fed, on all threads? `blocks` has every thread read a block of Gaussians, with
//! advice for its next frame block; `stages` fetches, decodes and accumulates on threads of their own. `warm_*`: from the
//! page cache; `cold_*`: the page cache is told to drop the file first (Linux); `slow_*`: as if from a disk of
//! [`SLOW`] bytes per second, which every way waits for as it would for a real one.
//!
//! What does it cost to use raw tiles in place, on all threads? `raw_frames/*` gives every frame to the state of a
//! caller: `ordinary` by positioned reads, the others from the map, whose pages are released once per frame block of a
//! block, frame by frame, or never, which lets the whole file become resident.
//!
//! `cargo bench --bench scan`

use std::collections::BTreeMap;
use std::hint::black_box;
use std::ops::Range;
use std::path::Path;
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gseq::{Compression, Reader, TileBuffer, TileFrames, TileId, TouchedPages};
use rayon::prelude::*;
use splatsieve::error::Result;
use splatsieve::files::container::Container;
use splatsieve::model::hash_id;
use splatsieve::model::{Attributes, Gaussians, SequenceInfo, ViewSchedule};
use splatsieve::outputs::container::write_container;
use splatsieve::recipe::Recipe;
use splatsieve::source::{BlockReader, FrameSource, Ids, Prefetch};
use splatsieve::statistics::ScanPlan;
use splatsieve::statistics::pass::scan;

const GAUSSIANS: usize = 16_384;
const FRAMES: usize = 64;
/// Bytes per second of a slow disk.
const SLOW: f64 = 300e6;

fn random(k: usize) -> f32 {
    (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32
}

/// Smooth curves with 1e-4 of noise: about as compressible as what training leaves behind.
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
            let to = out.column_mut(column);
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

/// Decodes every tile that a scan reads: all of a varying column, of others the first frames.
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
    schedule.push(FRAMES, &[]);
    let plan = ScanPlan::new(&recipe, &times, &schedule).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let dynamic = Attributes::all().difference(Attributes::SH);
    for (kind, compression) in [("packed", Compression::Zstd(1)), ("raw", Compression::StoredParams)] {
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

/// A disk that brings what is ordered, one order after the other.
struct Disk(Mutex<Instant>);

impl Disk {
    /// Orders `bytes`; they are there at the time it gives.
    fn order(&self, bytes: u64) -> Instant {
        let mut busy = self.0.lock().unwrap();
        *busy = (*busy).max(Instant::now()) + Duration::from_secs_f64(bytes as f64 / SLOW);
        *busy
    }
}

fn wait_for(ready: Instant) {
    thread::sleep(ready.saturating_duration_since(Instant::now()));
}

/// A container fed in one way or the other, from where it lies or as if from a slow disk.
struct Fed<'a> {
    container: &'a Container,
    in_stages: bool,
    disk: Option<Disk>,
}

impl Fed<'_> {
    fn bytes(&self, gaussians: Range<usize>, frames: Range<usize>, want: Attributes) -> u64 {
        let reader = self.container.reader();
        let layout = reader.layout();
        let block = |id: usize, of: u32| (id / of as usize) as u32;
        let mut sum = 0;
        for (column, _) in Attributes::all().iter().enumerate().filter(|&(_, column)| want.contains(column)) {
            for gaussian_block in
                block(gaussians.start, layout.gaussian_block)..=block(gaussians.end - 1, layout.gaussian_block)
            {
                let frame_block = block(frames.start, layout.frame_block);
                let at = TileId { column: column as u32, gaussian_block, frame_block };
                sum += reader.tile_info(at).unwrap().stored_bytes;
            }
        }
        sum
    }
}

impl FrameSource for Fed<'_> {
    fn info(&self) -> &SequenceInfo {
        self.container.info()
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let reader = self.container.open(ids.clone())?;
        match ids {
            Ids::Range(gaussians) if self.disk.is_some() && !self.in_stages => {
                Ok(Box::new(Waiting { fed: self, gaussians, reader, coming: None }))
            }
            _ => Ok(reader),
        }
    }

    fn ahead(&self) -> Option<&dyn Prefetch> {
        self.in_stages.then_some(self)
    }
}

impl Prefetch for Fed<'_> {
    fn frame_block(&self) -> usize {
        self.container.frame_block()
    }

    fn fetch(&self, gaussians: Range<usize>, frames: Range<usize>, want: Attributes) {
        match &self.disk {
            Some(disk) => wait_for(disk.order(self.bytes(gaussians, frames, want))),
            None => self.container.fetch(gaussians, frames, want),
        }
    }
}

/// Waits for a slow disk: for the first frame block, and for what is left of the next, which was ordered by advice.
struct Waiting<'a> {
    fed: &'a Fed<'a>,
    gaussians: Range<usize>,
    reader: Box<dyn BlockReader + 'a>,
    /// The next frame block, and when it is there.
    coming: Option<(usize, Instant)>,
}

impl BlockReader for Waiting<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let (of_block, info) = (self.fed.frame_block(), self.fed.info());
        if frame.is_multiple_of(of_block)
            && let Some(disk) = &self.fed.disk
        {
            let order = |start: usize, want| disk.order(self.fed.bytes(self.gaussians.clone(), start..start + 1, want));
            let now = match self.coming {
                Some((start, ready)) if start == frame => ready,
                _ => order(frame, want),
            };
            let next = frame + of_block;
            self.coming = (next < info.times.len()).then(|| (next, order(next, info.varying)));
            wait_for(now);
        }
        self.reader.read(frame, want, out)
    }
}

/// Has the page cache drop a file.
#[cfg(target_os = "linux")]
fn drop_cached(path: &Path) {
    let file = std::fs::File::open(path).unwrap();
    file.sync_all().unwrap();
    rustix::fs::fadvise(&file, 0, None, rustix::fs::Advice::DontNeed).unwrap();
}

fn ways(criterion: &mut Criterion) {
    let recipe = Recipe::preset("default").unwrap().scan;
    let times: Vec<f64> = (0..FRAMES).map(|t| t as f64).collect();
    let mut schedule = ViewSchedule::default();
    schedule.push(FRAMES, &[]);
    let plan = ScanPlan::new(&recipe, &times, &schedule).unwrap();
    // Not where temporary files may lie in memory.
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let varying = Attributes::all().difference(Attributes::SH);
    let source = Curves(SequenceInfo { count: GAUSSIANS, times, sh_degree: 0, varying });
    for (kind, compression) in [("packed", Compression::Zstd(1)), ("raw", Compression::StoredParams)] {
        let path = folder.path().join(format!("{kind}.gseq"));
        pack(&source, &path, compression);
        let container = Container::open(&path).unwrap();
        for (speed, slow) in [("warm", false), ("cold", false), ("slow", true)] {
            let mut group = criterion.benchmark_group(format!("{speed}_{kind}"));
            group.sample_size(20).throughput(Throughput::Elements((GAUSSIANS * FRAMES) as u64));
            for (way, in_stages) in [("blocks", false), ("stages", true)] {
                let disk = slow.then(|| Disk(Mutex::new(Instant::now())));
                let fed = Fed { container: &container, in_stages, disk };
                group.bench_function(way, |bencher| {
                    let before = || {
                        #[cfg(target_os = "linux")]
                        if speed == "cold" {
                            drop_cached(&path);
                        }
                    };
                    bencher.iter_batched(before, |()| scan(&fed, &schedule, &plan).unwrap(), BatchSize::PerIteration);
                });
            }
        }
        if kind == "raw" {
            raw_frames(criterion, container.reader(), varying);
        }
    }
}

/// Every frame of raw tiles to the state of a caller.
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

criterion_group!(all, benches, ways);
criterion_main!(all);
