//! The scan of a source on a slow disk, in stages: one thread fetches bytes, some decode tiles, as many accumulate
//! frames. The disk, the decoder and the arithmetic overlap.
//!
//! The unit of work is a block of Gaussians over a frame block. Every thread of the pool that is not there for this
//! stands for a lane, a decoder and an accumulator with a bounded channel between; a block of Gaussians stays in its
//! lane, so that its frames arrive in order and no result depends on the number of threads. As many blocks as there are
//! lanes take their turns frame block by frame block: their tiles lie side by side in a container. The threads are the
//! stages' own, for they wait for one another, which tasks of a pool must not.
//!
//! Memory: per lane two readers with what they keep of a frame block, the one that decodes and the one that is read.
//! What is fetched stays with the system.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};
use std::thread;

use crossbeam_channel::{Receiver, Sender, bounded};

use super::blocks::BlockScans;
use crate::error::{Error, Result};
use crate::model::Rows;
use crate::source::{BlockReader, Ids, Prefetch};

/// Units that have been fetched and wait for a lane's decoder, at most.
const FETCHED: usize = 4;

/// A block of Gaussians over a frame block.
struct Unit {
    block: usize,
    frames: Range<usize>,
}

/// A reader for the Gaussians of a block.
type OfBlock<'a> = (usize, Box<dyn BlockReader + 'a>);

/// What came of the blocks.
struct StagedResult {
    blocks: Vec<Option<(Rows, f32)>>,
    /// The error of the first block that has one.
    error: Option<(usize, Error)>,
}

/// The rows of all blocks of `scan` and their largest coordinates, in order.
pub(crate) fn scan_in_stages(scan: &BlockScans<'_>, ahead: &dyn Prefetch) -> Result<Vec<(Rows, f32)>> {
    let blocks = scan.blocks();
    let lanes = rayon::current_num_threads().min(blocks);
    let found = Mutex::new(StagedResult { blocks: (0..blocks).map(|_| None).collect(), error: None });
    thread::scope(|scope| {
        let mut to_lanes = Vec::with_capacity(lanes);
        for _ in 0..lanes {
            let (to_lane, fetched) = bounded(FETCHED);
            // Whoever decodes waits until the other takes what it has: two readers, no more.
            let (decoded, ready) = bounded(0);
            let (done, free) = bounded(2);
            let found = &found;
            scope.spawn(move || decode(scan, &fetched, &free, &decoded));
            scope.spawn(move || accumulate(scan, &ready, &done, found));
            to_lanes.push(to_lane);
        }
        scope.spawn(move || fetch(scan, ahead, to_lanes));
    });
    let StagedResult { blocks, error } = found.into_inner().unwrap_or_else(PoisonError::into_inner);
    match error {
        Some((_, error)) => Err(error),
        None => Ok(blocks.into_iter().flatten().collect()),
    }
}

/// Brings the bytes of every unit and sends it to its lane, until a lane is gone.
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

/// Decodes unit after unit, with readers that have been read where they are of the same block.
fn decode<'a>(
    scan: &BlockScans<'a>,
    fetched: &Receiver<Unit>,
    free: &Receiver<OfBlock<'a>>,
    decoded: &Sender<(Unit, Result<OfBlock<'a>>)>,
) {
    for unit in fetched {
        let reader = free.try_iter().find(|&(block, _)| block == unit.block);
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

/// Accumulates the frames of unit after unit, and gives the readers back.
fn accumulate<'a>(
    scan: &BlockScans<'a>,
    ready: &Receiver<(Unit, Result<OfBlock<'a>>)>,
    done: &Sender<OfBlock<'a>>,
    found: &Mutex<StagedResult>,
) {
    let mut running = None;
    for (unit, prepared) in ready {
        let added = prepared.and_then(|(block, mut reader)| {
            let running = running.get_or_insert_with(|| scan.begin(block));
            scan.add(running, unit.frames.clone(), &mut *reader)?;
            // There is room: no more than two readers are about. If nobody takes it, it is not needed.
            _ = done.send((block, reader));
            Ok(())
        });
        let mut found = found.lock().unwrap_or_else(PoisonError::into_inner);
        if let Err(error) = added {
            if found.error.as_ref().is_none_or(|&(block, _)| unit.block < block) {
                found.error = Some((unit.block, error));
            }
            return;
        }
        if unit.frames.end == scan.frames() {
            found.blocks[unit.block] = running.take().map(|of_block| scan.finish(of_block));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::Scene;
    use crate::model::{Columns, Gaussians, Schedule, SequenceInfo};
    use crate::passes::BLOCK;
    use crate::recipe::Recipe;
    use crate::source::FrameSource;
    use crate::statistics::ScanPlan;
    use crate::statistics::pass::Scanned;
    use crate::statistics::pass::scan;

    /// Gaussians, frames and columns.
    type Fetched = (Range<usize>, Range<usize>, Columns);

    /// A scene that wants to be fetched, by `frame_block` frames, and whose frames from one on cannot be read.
    struct Slow {
        scene: Scene,
        frame_block: Option<usize>,
        fails_from: usize,
        fetched: Mutex<Vec<Fetched>>,
    }

    impl Slow {
        fn new(frame_block: Option<usize>, fails_from: usize) -> Slow {
            Slow { scene: Scene::new(4 * BLOCK + 77, 7), frame_block, fails_from, fetched: Mutex::default() }
        }

        fn scan(&self, threads: usize) -> Result<Scanned> {
            let info = self.scene.info();
            let schedule: Schedule = self.scene.rig().schedule(&info.times, None).unwrap();
            let plan = ScanPlan::new(&Recipe::preset("default").unwrap().scan, &info.times, &schedule).unwrap();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| scan(self, &schedule, &plan))
        }
    }

    impl FrameSource for Slow {
        fn info(&self) -> &SequenceInfo {
            self.scene.info()
        }

        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            Ok(Box::new(SlowReader { reader: self.scene.open(ids)?, fails_from: self.fails_from }))
        }

        fn ahead(&self) -> Option<&dyn Prefetch> {
            self.frame_block.is_some().then_some(self)
        }
    }

    impl Prefetch for Slow {
        fn frame_block(&self) -> usize {
            self.frame_block.unwrap_or_default()
        }

        fn fetch(&self, gaussians: Range<usize>, frames: Range<usize>, want: Columns) {
            self.fetched.lock().unwrap().push((gaussians, frames, want));
        }
    }

    struct SlowReader<'a> {
        reader: Box<dyn BlockReader + 'a>,
        fails_from: usize,
    }

    impl BlockReader for SlowReader<'_> {
        fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
            if frame >= self.fails_from {
                return Err(Error::usage(format!("frame {frame} is gone")));
            }
            self.reader.read(frame, want, out)
        }
    }

    #[test]
    fn stages_find_what_blocks_side_by_side_find_whatever_the_threads_and_frame_blocks() {
        let expected = Slow::new(None, usize::MAX).scan(2).unwrap();
        for (threads, frame_block) in [(1, 3), (2, 7), (3, 1), (9, 100)] {
            let slow = Slow::new(Some(frame_block), usize::MAX);
            let found = slow.scan(threads).unwrap();
            assert_eq!(found.rows, expected.rows, "{threads} threads, {frame_block} frames");
            assert_eq!(found.alive_per_frame, expected.alive_per_frame);
            assert_eq!(found.largest_coordinate, expected.largest_coordinate);
            let mut states = 0;
            for (gaussians, frames, want) in slow.fetched.into_inner().unwrap() {
                states += gaussians.len() * frames.len();
                assert_eq!(want, if frames.start == 0 { Columns::all() } else { slow.scene.info().varying });
            }
            assert_eq!(states, slow.scene.info().count * 7, "each unit is fetched once");
        }
    }

    #[test]
    fn a_source_that_fails_midway_ends_all_stages_with_its_error() {
        for fails_from in [0, 5] {
            let error = Slow::new(Some(2), fails_from).scan(3).unwrap_err().to_string();
            assert!(error.contains(&format!("frame {fails_from} is gone")), "{error}");
        }
    }
}
