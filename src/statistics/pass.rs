//! The scan: one pass over all Gaussians at all frames that computes their statistics, with blocks of Gaussians on all
//! threads.

pub(crate) mod blocks;

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::model::{Camera, Gaussians, SequenceInfo, StatisticRows, ViewSchedule};
use crate::passes::GAUSSIANS_PER_BLOCK;
use crate::progress::Events;
use crate::source::{FrameSource, Ids};
use crate::statistics::pass::blocks::BlockScans;
use crate::statistics::{BlockScan, NEEDED_ATTRIBUTES, ScanPlan, attributes_to_read};

/// Result of a scan, the pass over all frames that computes the statistics of every Gaussian.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct ScanResult {
    /// Statistics, one row per Gaussian. The trajectory magnitude D and the curvature κ still include rounding noise;
    /// the anisotropy E is not filled yet.
    pub rows: StatisticRows,
    /// Number of Gaussians alive (opacity ≥ alpha_min) in each frame.
    pub alive_per_frame: Vec<u32>,
    /// Largest |coordinate| of all positions in all frames, scene units.
    pub largest_coordinate: f32,
    /// Whether only some frames were read. The trajectory magnitude D, the curvature κ and the opacity variance V are
    /// then 0 for all Gaussians.
    pub is_partial: bool,
}

/// Scans all frames of `source`: computes the statistics of all Gaussians, as seen by the cameras of `schedule`. Blocks
/// of Gaussians are processed in parallel.
///
/// Memory: one row of statistics per Gaussian (twice while blocks are joined), and 4 bytes per frame. Per thread: the
/// accumulators of one block of Gaussians ([`crate::statistics::BYTES_PER_GAUSSIAN`] each), its attributes at one
/// frame, and its reader.
///
/// # Errors
/// Fails if a frame cannot be read.
pub fn scan(source: &dyn FrameSource, schedule: &ViewSchedule, plan: &ScanPlan) -> Result<ScanResult> {
    scan_blocks(source, schedule, plan, 0..scan_units(source.info()), &Events::IGNORED)
}

/// Returns the number of blocks of Gaussians into which [`scan`] divides a sequence.
pub fn scan_units(info: &SequenceInfo) -> usize {
    info.count.div_ceil(GAUSSIANS_PER_BLOCK)
}

/// Scans only the blocks of Gaussians with the numbers `blocks`, at all frames, like [`scan`]. [`ScanResult::join`]
/// combines several such results.
pub fn scan_blocks(
    source: &dyn FrameSource,
    schedule: &ViewSchedule,
    plan: &ScanPlan,
    blocks: Range<usize>,
    events: &Events,
) -> Result<ScanResult> {
    let info = source.info();
    let frames = info.times.len();
    let gaussians =
        info.count.min(blocks.end * GAUSSIANS_PER_BLOCK) - info.count.min(blocks.start * GAUSSIANS_PER_BLOCK);
    let progress = events.task("scan", "states", gaussians as u64 * frames as u64);
    let scan = BlockScans { source, schedule, plan, blocks, progress, alive: Mutex::new(vec![0; frames]) };
    let blocks: Vec<_> = scan.blocks.clone().into_par_iter().map(|block| scan.block(block)).collect::<Result<_>>()?;
    Ok(joined(blocks, scan.alive.into_inner().unwrap_or_else(PoisonError::into_inner)))
}

impl ScanResult {
    /// Converts the result of a scan that read only the frames `frames` (increasing indices) into a result for the
    /// whole sequence, which has `frame_count` frames.
    ///
    /// - Life spans grow in proportion to the number of frames.
    /// - The number of Gaussians alive (opacity ≥ alpha_min) is 0 in frames that were not read.
    /// - The trajectory magnitude D, the curvature κ and the opacity variance V become 0, because steps between the
    ///   frames that were read are not the steps of the sequence.
    pub fn extrapolate_to_all_frames(mut self, frames: &[usize], frame_count: usize) -> ScanResult {
        let mut alive_per_frame = vec![0; frame_count];
        frames.iter().zip(&self.alive_per_frame).for_each(|(&frame, &alive)| alive_per_frame[frame] = alive);
        let in_all = |life: u32| (life as usize * frame_count).div_ceil(frames.len().max(1)) as u32;
        self.rows.life.iter_mut().for_each(|life| *life = in_all(*life));
        for values in [&mut self.rows.d, &mut self.rows.kappa, &mut self.rows.v] {
            values.fill(0.0);
        }
        ScanResult { alive_per_frame, is_partial: true, ..self }
    }

    /// Appends `other`, the result of a scan of the Gaussians that follow the Gaussians of this result, at the same
    /// frames.
    pub fn join(&mut self, mut other: ScanResult) {
        self.rows.append(&mut other.rows);
        self.alive_per_frame.iter_mut().zip(other.alive_per_frame).for_each(|(sum, alive)| *sum += alive);
        self.largest_coordinate = self.largest_coordinate.max(other.largest_coordinate);
    }
}

/// Joins the results of consecutive blocks of Gaussians: the statistics (one row per Gaussian) and the largest
/// |coordinate| of each block. `alive_per_frame` holds the number of Gaussians alive (opacity ≥ alpha_min) in each
/// frame.
fn joined(blocks: impl IntoIterator<Item = (StatisticRows, f32)>, alive_per_frame: Vec<u32>) -> ScanResult {
    let mut rows = StatisticRows::default();
    let mut largest_coordinate = 0.0f32;
    for (mut block, largest) in blocks {
        rows.append(&mut block);
        largest_coordinate = largest_coordinate.max(largest);
    }
    ScanResult { rows, alive_per_frame, largest_coordinate, is_partial: false }
}

/// Scan of a sequence whose frames arrive over time, in groups. Each group is read once, when it is added. The result
/// is the same as that of [`scan`].
///
/// Memory: the accumulators of all Gaussians ([`crate::statistics::BYTES_PER_GAUSSIAN`] each), 4 bytes per frame, and
/// per thread the attributes of one block of Gaussians at one frame.
pub struct RunningScan<'a> {
    blocks: Vec<BlockScan<'a>>,
    alive_per_frame: Vec<u32>,
}

impl<'a> RunningScan<'a> {
    /// Creates a scan (running statistics) of `count` Gaussians, to which no frame has been added yet.
    pub fn new(count: usize, plan: &'a ScanPlan) -> Self {
        let block = |start: usize| BlockScan::new(GAUSSIANS_PER_BLOCK.min(count - start), start, plan);
        RunningScan {
            blocks: (0..count).step_by(GAUSSIANS_PER_BLOCK).map(block).collect(),
            alive_per_frame: Vec::new(),
        }
    }

    /// Adds all frames of `source` to the scan; they follow the frames that were added before. `cameras` lists for each
    /// of these frames the cameras that see it.
    ///
    /// # Errors
    /// Fails if a frame cannot be read.
    pub fn add(&mut self, source: &dyn FrameSource, cameras: &[Vec<&Camera>]) -> Result<()> {
        let info = source.info();
        let first = self.alive_per_frame.len();
        let alive: Vec<Vec<u32>> = self
            .blocks
            .par_iter_mut()
            .enumerate()
            .map(|(block, scan)| {
                let range = block * GAUSSIANS_PER_BLOCK..info.count.min((block + 1) * GAUSSIANS_PER_BLOCK);
                let mut state = Gaussians::zeros(range.len(), info.sh_degree);
                let mut reader = source.open(Ids::Range(range))?;
                for (t, cameras) in cameras.iter().enumerate() {
                    let changed = attributes_to_read(first + t, info.varying);
                    // The buffer is new, so its first read must also fill the attributes that do not vary. They count
                    // as unchanged all the same, since the scan knows them already.
                    let want = if t == 0 { changed | NEEDED_ATTRIBUTES } else { changed };
                    reader.read(t, want, &mut state)?;
                    scan.add_frame(first + t, &state, cameras, changed);
                }
                Ok(scan.take_alive_counts())
            })
            .collect::<Result<_>>()?;
        self.alive_per_frame.resize(first + cameras.len(), 0);
        for alive in alive {
            for (sum, count) in self.alive_per_frame[first..].iter_mut().zip(alive) {
                *sum += count;
            }
        }
        Ok(())
    }

    /// Ends the scan after the last frame, and returns the statistics of all Gaussians. `plan` is the plan for the
    /// complete sequence, as [`ScanPlan::new`] creates it.
    ///
    /// # Panics
    /// Panics if `plan` does not belong to the frames that were added ([`ScanPlan::fits_scan_begun_with`]).
    pub fn finish(self, plan: &ScanPlan) -> ScanResult {
        let blocks = self.blocks.into_iter().map(|block| {
            let found = block.finish_with_plan(plan);
            (found.rows, found.largest_coordinate)
        });
        joined(blocks, self.alive_per_frame)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::{Attributes, SequenceInfo, Split};
    use crate::recipe::Recipe;
    use crate::source::BlockReader;

    /// Test scene of which only the positions vary in time. Records the frame and the attributes of every read.
    struct RecordingScene {
        scene: DemoScene,
        info: SequenceInfo,
        /// Frame index and requested attributes of every read, in the order of the reads.
        reads: Mutex<Vec<(usize, Attributes)>>,
    }

    struct RecordingReader<'a>(&'a RecordingScene, Box<dyn BlockReader + 'a>);

    impl FrameSource for RecordingScene {
        fn info(&self) -> &SequenceInfo {
            &self.info
        }
        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            Ok(Box::new(RecordingReader(self, self.scene.open(ids)?)))
        }
    }

    impl BlockReader for RecordingReader<'_> {
        fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
            self.0.reads.lock().unwrap().push((frame, want));
            self.1.read(frame, want & Attributes::POSITION, out)?;
            self.1.read(0, want.difference(Attributes::POSITION), out)
        }
    }

    #[test]
    fn constant_attributes_are_read_once_without_changing_a_bit() {
        let scene = DemoScene::new(1500, 5);
        let info = scene.info().clone();
        let schedule = scene.rig().schedule(&info.times, Some(Split::Train)).unwrap();
        let mut recording = RecordingScene { scene, info, reads: Mutex::default() };
        let mut scan_with = |varying: Attributes| {
            recording.info.varying = varying;
            let plan =
                ScanPlan::new(&Recipe::preset("default").unwrap().scan, &recording.info.times, &schedule).unwrap();
            let found = scan(&recording, &schedule, &plan).unwrap();
            (format!("{:?}", found.rows), found.alive_per_frame, std::mem::take(&mut *recording.reads.lock().unwrap()))
        };
        let (skipping, everything) = (scan_with(Attributes::POSITION), scan_with(Attributes::all()));
        assert_eq!((&skipping.0, &skipping.1), (&everything.0, &everything.1));
        for (frame, want) in &skipping.2 {
            assert_eq!(*want, if *frame == 0 { Attributes::all() } else { Attributes::POSITION }, "frame {frame}");
        }
        assert!(everything.2.iter().all(|(_, want)| *want == Attributes::all()));
        assert_eq!((skipping.2.len(), everything.2.len()), (10, 10), "blocks times frames");
    }
}
