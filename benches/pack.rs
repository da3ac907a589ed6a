//! Measures how fast tiles of a container are encoded and decoded, per (Gaussian, frame), on one thread. A tile has the
//! values of one attribute for some Gaussians at some frames.
//!
//! The inputs are generated curves and the trained models, which are skipped if they are missing. All attributes that
//! vary with time are encoded.
//! - `encode/tile`: only the encoding of tiles. `encode/container`: writing a whole container. Frame states are
//!   gathered into tiles, encoded, written and synced to disk.
//! - `decode/tile`: tiles are read from the page cache, verified and decoded. `decode/raw`: uncompressed tiles are
//!   copied from the page cache.
//! - `encode/bounded`, `decode/bounded`: lossy tiles with an error of at most 0.001 in every attribute, compressed at
//!   zstd level 15, which `convert` uses for error bounds.
//! - For comparison: `plain_zstd` compresses or decompresses the same values with zstd level 1, without a filter;
//!   `memcpy` copies them.
//!
//! The stored sizes are printed before each scene.
//!
//! Usage: `cargo bench --bench pack`. The time per (Gaussian, frame) is the inverse of the throughput that is printed.

mod trajectories;

use std::collections::BTreeMap;
use std::hint::black_box;
use std::path::Path;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gseq::{Compression, Reader, TileBuffer, TileId, encode_tile};
use splatsieve::model::Attributes;
use splatsieve::outputs::bounds::{ErrorBounds, MaxError};
use splatsieve::outputs::container::{GAUSSIAN_BLOCK, Packing, write_container};
use splatsieve::passes::FramesInMemory;
use splatsieve::source::FrameSource;

/// zstd level of the lossless tiles and of `plain_zstd`.
const LEVEL: i32 = 1;
/// Compression of the lossy tiles.
const BOUNDED: Compression = Compression::Bounded { max_error: 1e-3, level: 15 };

/// Returns every tile of the attributes that vary with time, as a pair: number of components per Gaussian, and values.
/// A tile has the values of one attribute for some Gaussians at all frames.
fn all_tiles(scene: &FramesInMemory) -> Vec<(u32, Vec<f32>)> {
    let info = scene.info();
    let tiles_with_width = |column: Attributes| {
        trajectories::tiles(scene, column).into_iter().map(move |tile| (column.width(info.sh_degree) as u32, tile))
    };
    info.varying.iter().flat_map(tiles_with_width).collect()
}

fn write(scene: &FramesInMemory, path: &Path, packing: impl Into<Packing>) {
    write_container(scene, path, packing, BTreeMap::new(), |_| ()).unwrap();
}

fn decode_all(reader: &Reader, varying: Attributes, buffer: &mut TileBuffer) {
    for gaussian_block in 0..reader.layout().gaussian_blocks() {
        for (column, attribute) in Attributes::all().iter().enumerate() {
            if varying.contains(attribute) {
                let at = TileId { column: column as u32, gaussian_block, frame_block: 0 };
                black_box(reader.read_tile(at, buffer).unwrap().values());
            }
        }
    }
}

fn benches(criterion: &mut Criterion) {
    let folder = tempfile::tempdir().unwrap();
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    for (name, scene) in trajectories::scenes() {
        let (frames, varying) = (scene.len() as u32, scene.info().varying);
        let tiles = all_tiles(&scene);
        let bytes = |(_, tile): &(u32, Vec<f32>)| bytemuck::cast_slice::<f32, u8>(tile).to_vec();
        let raw: Vec<Vec<u8>> = tiles.iter().map(bytes).collect();
        let plain: Vec<Vec<u8>> = raw.iter().map(|raw| zstd::bulk::compress(raw, LEVEL).unwrap()).collect();
        let encode_as = |(width, tile): &(u32, Vec<f32>), compression| {
            encode_tile(tile, frames, *width, GAUSSIAN_BLOCK as u32, compression).unwrap()
        };
        let encode = |tile| encode_as(tile, Compression::Zstd(LEVEL));
        let percent = |stored: usize| 100.0 * stored as f64 / raw.iter().map(Vec::len).sum::<usize>() as f64;
        eprintln!(
            "{name}: tiles take {:.1}% of their raw bytes, within a bound {:.1}%, plain zstd {:.1}%",
            percent(tiles.iter().map(|tile| encode(tile).stored_bytes()).sum()),
            percent(tiles.iter().map(|tile| encode_as(tile, BOUNDED).stored_bytes()).sum()),
            percent(plain.iter().map(Vec::len).sum())
        );
        let path = folder.path().join("scene.gseq");
        let [raw_path, within_path] = ["raw.gseq", "within.gseq"].map(|name| folder.path().join(name));
        write(&scene, &path, Compression::Zstd(LEVEL));
        write(&scene, &raw_path, Compression::Raw);
        let bounds: Vec<MaxError> =
            Attributes::all().iter().map(|column| format!("{}=1e-3", column.name()).parse().unwrap()).collect();
        write(&scene, &within_path, Packing::with_bounds(ErrorBounds::from_errors(&bounds, || Ok(1.0)).unwrap(), 15));
        let [reader, raw_reader, within] = [&path, &raw_path, &within_path].map(|path| Reader::open(path).unwrap());
        let most = raw.iter().map(Vec::len).max().unwrap_or(0);
        let (mut copy, mut buffer) = (vec![0; most], TileBuffer::default());
        let mut group = |verb: &str, rival: &str, work: &mut dyn FnMut()| {
            let mut group = criterion.benchmark_group(verb);
            group.sample_size(10).throughput(Throughput::Elements((scene.info().count * scene.len()) as u64));
            group.bench_function(BenchmarkId::new(rival, name), |bencher| bencher.iter(&mut *work));
        };
        group("encode", "tile", &mut || tiles.iter().for_each(|tile| _ = black_box(encode(tile))));
        group("encode", "bounded", &mut || tiles.iter().for_each(|tile| _ = black_box(encode_as(tile, BOUNDED))));
        group("encode", "container", &mut || {
            one_thread.install(|| write(&scene, &folder.path().join("again.gseq"), Compression::Zstd(LEVEL)));
        });
        group("encode", "plain_zstd", &mut || {
            raw.iter().for_each(|raw| _ = black_box(zstd::bulk::compress(raw, LEVEL).unwrap()));
        });
        group("encode", "memcpy", &mut || {
            raw.iter().for_each(|raw| black_box(&mut copy)[..raw.len()].copy_from_slice(raw));
        });
        group("decode", "tile", &mut || decode_all(&reader, varying, &mut buffer));
        group("decode", "bounded", &mut || decode_all(&within, varying, &mut buffer));
        group("decode", "raw", &mut || decode_all(&raw_reader, varying, &mut buffer));
        group("decode", "plain_zstd", &mut || {
            for stored in &plain {
                zstd::bulk::decompress_to_buffer(stored, black_box(&mut copy)).unwrap();
            }
        });
        group("decode", "memcpy", &mut || {
            raw.iter().for_each(|raw| black_box(&mut copy)[..raw.len()].copy_from_slice(raw));
        });
    }
}

criterion_group!(all, benches);
criterion_main!(all);
