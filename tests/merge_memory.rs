//! Test of the memory for measuring the motion of pairs of Gaussians, counted in allocated bytes. The memory is bounded
//! by the number of pairs measured together, for any number of frames.

#[path = "corpus/memory.rs"]
mod memory;

use std::collections::BTreeMap;
use std::path::Path;

use splatsieve::diagnostics::demo_scene::DemoScene;
use splatsieve::files::container::Container;
use splatsieve::merging::motion::MotionThresholds;
use splatsieve::merging::motion_pass::{BYTES_PER_PAIR, PairMeter, bytes_per_gaussian};
use splatsieve::merging::neighbors::PointIndex;
use splatsieve::merging::similarity_cache::BYTES_PER_CACHED_PAIR;
use splatsieve::merging::tree::TreePoint;
use splatsieve::model::Attributes;
use splatsieve::outputs::container::write_container;
use splatsieve::passes::gather;
use splatsieve::progress::Events;
use splatsieve::recipe::Recipe;

#[global_allocator]
static ALLOCATOR: memory::Counting = memory::Counting;

const COUNT: usize = 20_000;
const FRAMES_HELD: usize = 2;

/// Measures the motion of pairs in a scene of `frames` frames, divided into `partitions` calls. The pairs are those of
/// every Gaussian with its six nearest neighbors. Returns two results: the peak of the allocated memory, less the
/// memory allocated before, in bytes; and the number of pairs.
fn peak(folder: &Path, frames: usize, partitions: usize) -> (usize, usize) {
    let path = folder.join(format!("{frames}.gseq"));
    if !path.exists() {
        let scene = DemoScene::new(COUNT, frames);
        write_container(&scene, &path, gseq::Compression::Zstd(1), BTreeMap::new(), |_| ()).unwrap();
    }
    let container = Container::open(&path).unwrap();
    let ids: Vec<u32> = (0..COUNT as u32).collect();
    let reference = gather(&container, &ids, 0, Attributes::POSITION).unwrap().position;
    let point = |&index: &u32| TreePoint { position: reference.row(index as usize), index };
    let index = PointIndex::new(ids.iter().map(point).collect(), f64::INFINITY);
    let mut search = index.search();
    let mut pairs = Vec::new();
    for &i in &ids {
        let (near, _) = search.nearest(i, reference.row(i as usize), 6);
        pairs.extend(near.filter(|&j| i < j).map(|j| (i, j)));
    }
    let recipe = Recipe::preset("default").unwrap();
    let thresholds = MotionThresholds::new(&recipe.merge, 4.0);
    let mut meter =
        PairMeter::new(&container, &recipe.scan, thresholds, FRAMES_HELD, folder.to_owned(), Events::IGNORED);
    let count = pairs.len();
    let measure = || {
        let mut found = Vec::with_capacity(count);
        for part in pairs.chunks(count.div_ceil(partitions)) {
            found.extend(meter.measure(&ids, &reference, part.to_vec(), 0.1, partitions > 1).unwrap());
        }
        found
    };
    let (found, peak) = memory::peak(measure);
    assert_eq!(found.len(), count);
    (peak, count)
}

#[test]
fn memory_of_pairs_is_estimated_and_ignores_frame_count() {
    let folder = tempfile::tempdir().unwrap();
    // Only two threads, because the buffers of each thread count too.
    rayon::ThreadPoolBuilder::new().num_threads(2).build_global().unwrap();
    let (whole, pairs) = peak(folder.path(), 64, 1);
    let (short, _) = peak(folder.path(), 64, 64);
    let (long, _) = peak(folder.path(), 256, 64);
    eprintln!("{pairs} pairs: {whole} bytes at once; in 64 partitions {short}, with four times the frames {long}");
    let together = pairs / 64 + 1;
    // Estimated bytes, term by term: the cached results of all pairs; the order, the place and the gathered frames of
    // every Gaussian; the pairs of one partition, with two Gaussians each. The buffers of the two threads are added
    // below.
    let stated = BYTES_PER_CACHED_PAIR * pairs
        + (12 + 8 + 16 * FRAMES_HELD) * COUNT
        + (BYTES_PER_PAIR + 2 * bytes_per_gaussian(FRAMES_HELD)) * together;
    let buffers = 3 << 20;
    assert!(short <= stated + buffers, "{short} bytes, {stated} stated and {buffers} for buffers");
    // With more frames it is more likely that the buffers of both threads are full at the same time. If a single frame
    // of all trajectories stayed in memory, it would take 320,000 bytes, and there are 192 more frames.
    assert!(long <= short + (1 << 20), "{long} bytes for four times the frames, {short} before");
    assert!(2 * short < whole, "{short} bytes in partitions, {whole} at once");
}
