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
//! `cargo bench --bench scan`

use std::collections::BTreeMap;
use std::hint::black_box;
use std::path::Path;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gseq::{Compression, Reader, TileBuffer, TileId};
use splatsieve::emit::container::write_container;
use splatsieve::error::Result;
use splatsieve::ingest::container::Container;
use splatsieve::model::{Columns, Gaussians, Schedule, SequenceInfo};
use splatsieve::pass::{BlockReader, FrameSource, Ids};
use splatsieve::recipe::Recipe;
use splatsieve::select::hash_id;
use splatsieve::stats::ScanPlan;
use splatsieve::stream::scan;

const GAUSSIANS: usize = 16_384;
const FRAMES: usize = 64;

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
    varying: Columns,
}

impl BlockReader for CurveReader {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
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
fn each_tile(reader: &Reader, varying: Columns, mut take: impl FnMut(&[f32])) {
    let mut buffer = TileBuffer::default();
    for gaussian_block in 0..reader.layout().gaussian_blocks() {
        for frame_block in 0..reader.frame_blocks() {
            for (column, of) in Columns::ALL.iter().enumerate() {
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
    let schedule = Schedule { cameras: vec![], frames: vec![vec![]; FRAMES] };
    let plan = ScanPlan::new(&recipe, &times, &schedule).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let dynamic = Columns::ALL.without(Columns::SH);
    for (kind, compression) in [("packed", Compression::Zstd(1)), ("raw", Compression::Raw)] {
        for (name, varying) in [("position", Columns::POSITION), ("all_but_sh", dynamic)] {
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

fn pack(source: &Curves, path: &Path, compression: Compression) {
    write_container(source, path, compression, BTreeMap::new(), |_| ()).unwrap();
}

criterion_group!(all, benches);
criterion_main!(all);
