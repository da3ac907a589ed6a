//! Scan of a source on a slow disk as a pipeline: one thread fetches bytes from the disk, several threads decode tiles,
//! and an equal number of threads accumulate statistics. Disk, decoding and arithmetic overlap.
//!
//! The unit of work is a block of Gaussians over a frame block (the frames of one tile). A lane is a thread that
//! decodes and a thread that accumulates, with a bounded channel between them. There are as many lanes as the thread
//! pool has threads, but at most one per block of Gaussians. A block of Gaussians stays in its lane, so its frames
//! arrive in order, and no result depends on the number of threads. As many blocks as there are lanes advance together,
//! frame block by frame block, because their tiles are adjacent in a container. The pipeline has threads of its own
//! because they wait for one another, which tasks of a thread pool must not do.
//!
//! Memory: two readers per lane, each with the frames that it keeps of a frame block. One reader decodes tiles while
//! frames are read from the other. Fetched bytes stay in the file cache of the system.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};
use std::thread;

use crossbeam_channel::{Receiver, Sender, bounded};

use super::blocks::BlockScans;
use crate::error::{Error, Result};
use crate::model::StatisticRows;
use crate::source::{BlockReader, Ids, Prefetch};

/// Maximum number of units of work (a block of Gaussians at some frames) in the queue of each lane (a decoding thread
/// and an accumulating thread). The bytes of a unit in the queue have been fetched, and it waits to be decoded.
const MAX_QUEUED_UNITS: usize = 4;

/// Unit of work: a block of Gaussians at the frames of one frame block (consecutive frames that the source stores
/// together).
struct Unit {
    block: usize,
    frames: Range<usize>,
}

/// Number of a block of Gaussians, and a reader of this block.
type BlockReaderOf<'a> = (usize, Box<dyn BlockReader + 'a>);

/// Results of the blocks of Gaussians that have been scanned, or an error.
struct StagedResult {
    blocks: Vec<Option<(StatisticRows, f32)>>,
    /// Number and error of the lowest-numbered block whose scan failed.
    error: Option<(usize, Error)>,
}

/// Scans all blocks of `scan`. Returns for each block, in order, the statistics of its Gaussians (one row each) and the
/// largest |coordinate| of its positions.
///
/// # Errors
/// Fails if a frame cannot be read, with the error of the lowest-numbered block that failed.
pub(crate) fn scan_in_stages(scan: &BlockScans<'_>, ahead: &dyn Prefetch) -> Result<Vec<(StatisticRows, f32)>> {
    let blocks = scan.blocks();
    let lanes = rayon::current_num_threads().min(blocks);
    let results = Mutex::new(StagedResult { blocks: (0..blocks).map(|_| None).collect(), error: None });
    thread::scope(|scope| {
        let mut to_lanes = Vec::with_capacity(lanes);
        for _ in 0..lanes {
            let (to_lane, fetched) = bounded(MAX_QUEUED_UNITS);
            // A channel without capacity: the decoding thread waits until the other thread takes the reader, so a lane
            // has at most two readers.
            let (decoded, ready) = bounded(0);
            let (used_readers, free_readers) = bounded(2);
            let results = &results;
            scope.spawn(move || decode(scan, &fetched, &free_readers, &decoded));
            scope.spawn(move || accumulate(scan, &ready, &used_readers, results));
            to_lanes.push(to_lane);
        }
        scope.spawn(move || fetch(scan, ahead, to_lanes));
    });
    let StagedResult { blocks, error } = results.into_inner().unwrap_or_else(PoisonError::into_inner);
    match error {
        Some((_, error)) => Err(error),
        None => Ok(blocks.into_iter().flatten().collect()),
    }
}

/// Fetches the bytes of every unit of work into the system's file cache with `ahead`, and sends the unit to its lane
/// (the decoding thread and the accumulating thread that process it). `to_lanes` holds one channel per lane. Stops when
/// a lane has ended.
fn fetch(scan: &BlockScans<'_>, ahead: &dyn Prefetch, to_lanes: Vec<Sender<Unit>>) {
    let frame_block = ahead.frame_block().max(1);
    for first in (0..scan.blocks()).step_by(to_lanes.len().max(1)) {
        for start in (0..scan.frames()).step_by(frame_block) {
            let frames = start..scan.frames().min(start + frame_block);
            for (block, to_lane) in (first..scan.blocks()).zip(&to_lanes) {
                ahead.fetch(scan.range(block), frames.clone(), scan.changed(start));
                if to_lane.send(Unit { block, frames: frames.clone() }).is_err() {
                    return;
                }
            }
        }
    }
}

/// Decodes units of work (a block of Gaussians at the frames of one frame block). Body of the decoding thread of a lane
/// (a decoding thread and an accumulating thread).
///
/// - `fetched`: yields the units of this lane, whose bytes are in the file cache.
/// - `free_readers`: yields the readers that the accumulating thread of the lane has finished with. A reader is used
///   again if it reads the same block of Gaussians.
/// - `decoded`: receives each unit with its reader, from which its frames can now be read, or with an error.
fn decode<'a>(
    scan: &BlockScans<'a>,
    fetched: &Receiver<Unit>,
    free_readers: &Receiver<BlockReaderOf<'a>>,
    decoded: &Sender<(Unit, Result<BlockReaderOf<'a>>)>,
) {
    for unit in fetched {
        let reader = free_readers.try_iter().find(|&(block, _)| block == unit.block);
        let prepared = reader
            .map_or_else(|| scan.source.open(Ids::Range(scan.range(unit.block))), |(_, reader)| Ok(reader))
            .and_then(|mut reader| {
                reader.prepare(unit.frames.start, scan.changed(unit.frames.start))?;
                Ok((unit.block, reader))
            });
        if decoded.send((unit, prepared)).is_err() {
            return;
        }
    }
}

/// Adds decoded frames to the statistics. Body of the accumulating thread of a lane (a decoding thread and an
/// accumulating thread).
///
/// - `ready`: yields the units of work (a block of Gaussians at the frames of one frame block) that the decoding thread
///   of the lane has decoded, each with its reader.
/// - `used_readers`: receives the readers, for use by the decoding thread.
/// - `results`: receives the results of finished blocks, and errors.
fn accumulate<'a>(
    scan: &BlockScans<'a>,
    ready: &Receiver<(Unit, Result<BlockReaderOf<'a>>)>,
    used_readers: &Sender<BlockReaderOf<'a>>,
    results: &Mutex<StagedResult>,
) {
    let mut running = None;
    for (unit, prepared) in ready {
        let added = prepared.and_then(|(block, mut reader)| {
            let running = running.get_or_insert_with(|| scan.begin(block));
            scan.add(running, unit.frames.clone(), &mut *reader)?;
            // The channel has space, as there are at most two readers. If the decoding thread has ended, nobody needs
            // the reader.
            _ = used_readers.send((block, reader));
            Ok(())
        });
        let mut results = results.lock().unwrap_or_else(PoisonError::into_inner);
        if let Err(error) = added {
            if results.error.as_ref().is_none_or(|&(block, _)| unit.block < block) {
                results.error = Some((unit.block, error));
            }
            return;
        }
        if unit.frames.end == scan.frames() {
            results.blocks[unit.block] = running.take().map(|state| scan.finish(state));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::{Attributes, Gaussians, SequenceInfo, ViewSchedule};
    use crate::passes::GAUSSIANS_PER_BLOCK;
    use crate::recipe::Recipe;
    use crate::source::FrameSource;
    use crate::statistics::ScanPlan;
    use crate::statistics::pass::ScanResult;
    use crate::statistics::pass::scan;

    /// Gaussians, frames and attributes of one call of `fetch`.
    type Fetched = (Range<usize>, Range<usize>, Attributes);

    /// Scene whose bytes are to be fetched in blocks of `frame_block` frames, and whose frames from `fails_from` on
    /// cannot be read.
    struct SlowScene {
        scene: DemoScene,
        frame_block: Option<usize>,
        fails_from: usize,
        fetched: Mutex<Vec<Fetched>>,
    }

    impl SlowScene {
        fn new(frame_block: Option<usize>, fails_from: usize) -> SlowScene {
            SlowScene {
                scene: DemoScene::new(4 * GAUSSIANS_PER_BLOCK + 77, 7),
                frame_block,
                fails_from,
                fetched: Mutex::default(),
            }
        }

        fn scan(&self, threads: usize) -> Result<ScanResult> {
            let info = self.scene.info();
            let schedule: ViewSchedule = self.scene.rig().schedule(&info.times, None).unwrap();
            let plan = ScanPlan::new(&Recipe::preset("default").unwrap().scan, &info.times, &schedule).unwrap();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| scan(self, &schedule, &plan))
        }
    }

    impl FrameSource for SlowScene {
        fn info(&self) -> &SequenceInfo {
            self.scene.info()
        }

        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            Ok(Box::new(SlowReader { reader: self.scene.open(ids)?, fails_from: self.fails_from }))
        }

        fn prefetcher(&self) -> Option<&dyn Prefetch> {
            self.frame_block.is_some().then_some(self)
        }
    }

    impl Prefetch for SlowScene {
        fn frame_block(&self) -> usize {
            self.frame_block.unwrap_or_default()
        }

        fn fetch(&self, gaussians: Range<usize>, frames: Range<usize>, want: Attributes) {
            self.fetched.lock().unwrap().push((gaussians, frames, want));
        }
    }

    struct SlowReader<'a> {
        reader: Box<dyn BlockReader + 'a>,
        fails_from: usize,
    }

    impl BlockReader for SlowReader<'_> {
        fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
            if frame >= self.fails_from {
                return Err(Error::usage(format!("frame {frame} is gone")));
            }
            self.reader.read(frame, want, out)
        }
    }

    #[test]
    fn staged_scan_equals_the_parallel_scan() {
        let expected = SlowScene::new(None, usize::MAX).scan(2).unwrap();
        for (threads, frame_block) in [(1, 3), (2, 7), (3, 1), (9, 100)] {
            let scene = SlowScene::new(Some(frame_block), usize::MAX);
            let found = scene.scan(threads).unwrap();
            assert_eq!(found.rows, expected.rows, "{threads} threads, {frame_block} frames");
            assert_eq!(found.alive_per_frame, expected.alive_per_frame);
            assert_eq!(found.largest_coordinate, expected.largest_coordinate);
            let mut states = 0;
            for (gaussians, frames, want) in scene.fetched.into_inner().unwrap() {
                states += gaussians.len() * frames.len();
                assert_eq!(want, if frames.start == 0 { Attributes::all() } else { scene.scene.info().varying });
            }
            assert_eq!(states, scene.scene.info().count * 7, "each unit is fetched once");
        }
    }

    #[test]
    fn a_failing_read_ends_all_stages_with_its_error() {
        for fails_from in [0, 5] {
            let error = SlowScene::new(Some(2), fails_from).scan(3).unwrap_err().to_string();
            assert!(error.contains(&format!("frame {fails_from} is gone")), "{error}");
        }
    }
}
