//! Positions and opacities of selected Gaussians at all frames, in a scratch file. The order of the Gaussians in the
//! file is chosen so that those read together are stored together.
//!
//! The source is read once, a few frames at a time, in blocks of Gaussians in the order of ids. A source that stores
//! tiles (consecutive Gaussians × frames) decodes each tile once if the tile spans no more frames than are read at a
//! time. A source that reads files opens them once for each block and these few frames. The scratch file is read by the
//! calling thread with plain reads: it has no index and leaves no mapped pages, either of which would grow with the
//! number of frames.
//!
//! Layout of the file: x, y, z and opacity logit of every Gaussian at the first frame, `[N, 4]`; then for every block
//! of F frames (the last may be shorter) the W values that vary with time, `[N, F, W]`. W is 4 if positions and
//! opacities vary, 3 if only positions do, and 1 if only opacities do. If nothing varies, there are no blocks. All
//! values are f32 in the byte order of this machine.
//!
//! Memory while gathering: 8 + 4·F·W bytes per Gaussian; per thread, two blocks of Gaussians at F frames.

use std::ops::Range;
use std::path::Path;

use rayon::prelude::*;

use crate::cache::{Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Attributes, Gaussians};
use crate::outputs::container::FRAME_BLOCK;
use crate::passes::GAUSSIANS_PER_BLOCK;
use crate::progress::Events;
use crate::source::{FrameSource, Ids, ReadPlan};

/// Values of one Gaussian at one frame that test 3 of merging (motion) needs: x, y, z, opacity logit.
pub(crate) type TrajectorySample = [f32; 4];

/// Attributes that a [`TrajectorySample`] contains.
pub(crate) const NEEDED: Attributes = Attributes::POSITION.union(Attributes::OPACITY);

/// Maximum difference of the indices, in the scratch file, of two successive requested Gaussians that are read at once,
/// together with the Gaussians between them. Across larger gaps, they are read separately.
const MAX_GAP: u32 = 32;
/// Maximum number of Gaussians that are read from the scratch file at once.
const MAX_RUN: u32 = 2048;

/// Trajectories of Gaussians in an unnamed scratch file, which is deleted when this value is dropped.
pub(crate) struct Trajectories {
    file: Spill,
    count: usize,
    frames: usize,
    /// Number of consecutive frames per block of the file. A block stores all values of one Gaussian together.
    block: usize,
    /// Range of indices of the values in a [`TrajectorySample`] that vary with time.
    varying: Range<usize>,
}

impl Trajectories {
    /// Reads the Gaussians `ids` of `source` (all different) at all frames and stores them in this order in a scratch
    /// file in `folder`. Reads at most `frames_together` frames at a time.
    ///
    /// # Errors
    /// Fails if `source` cannot be read or the scratch file cannot be written. The file is then deleted.
    pub(crate) fn gather(
        source: &dyn FrameSource,
        ids: &[u32],
        frames_together: usize,
        folder: &Path,
        events: &Events,
    ) -> Result<Trajectories> {
        let (frames, columns) = (source.info().times.len(), source.info().varying & NEEDED);
        let mut places: Vec<(u32, u32)> = ids.iter().copied().zip(0..).collect();
        places.par_sort_unstable();
        let mut file = SpillWriter::new(folder)?;
        let block = frames_together.clamp(1, FRAME_BLOCK);
        let progress = events.task("merge", "frames", frames as u64);
        let mut values = Vec::new();
        if frames > 0 {
            read_frames(source, &places, 0..1, NEEDED, &mut values)?;
            file.write(bytemuck::cast_slice(&values))?;
        }
        for start in (0..frames).step_by(block).take_while(|_| !columns.is_empty()) {
            let block_frames = start..frames.min(start + block);
            read_frames(source, &places, block_frames.clone(), columns, &mut values)?;
            file.write(bytemuck::cast_slice(&values))?;
            progress.advance(block_frames.len() as u64);
        }
        let file = file.finish()?;
        let varying = value_range(columns);
        Ok(Trajectories { file, count: ids.len(), frames, block, varying })
    }

    /// Calls `show` for every frame in order, with the samples of the Gaussians at `places` (increasing indices into
    /// the file). If no value varies with time, calls `show` only once.
    ///
    /// Memory: for every Gaussian in `places`, its sample and its varying values at the frames of one block; also a
    /// bounded buffer.
    ///
    /// # Errors
    /// Fails if the scratch file cannot be read.
    pub(crate) fn play(&self, places: &[u32], mut show: impl FnMut(&[TrajectorySample])) -> Result<()> {
        if self.frames == 0 {
            return Ok(());
        }
        let mut now: Vec<TrajectorySample> = vec![TrajectorySample::default(); places.len()];
        self.read(0, 4, places, bytemuck::cast_slice_mut(&mut now))?;
        if self.varying.is_empty() {
            show(&now);
            return Ok(());
        }
        let (width, mut values) = (self.varying.len(), Vec::new());
        for start in (0..self.frames).step_by(self.block) {
            let frames = self.block.min(self.frames - start);
            values.resize(places.len() * frames * width, 0.0);
            let first = self.count * (4 + start * width);
            self.read(first, frames * width, places, &mut values)?;
            for frame in 0..frames {
                for (now, values) in now.iter_mut().zip(values.chunks_exact(frames * width)) {
                    now[self.varying.clone()].copy_from_slice(&values[frame * width..][..width]);
                }
                show(&now);
            }
        }
        Ok(())
    }

    /// Reads the rows with the indices `places` (increasing) of a table in the file into `out`. A row holds `width`
    /// numbers (f32) of one Gaussian. The table begins `first` numbers after the start of the file.
    fn read(&self, first: usize, width: usize, places: &[u32], mut out: &mut [f32]) -> Result<()> {
        let mut values: Vec<f32> = Vec::new();
        for run in places.chunk_by(|a, b| b - a <= MAX_GAP && a / MAX_RUN == b / MAX_RUN) {
            let low = run[0] as usize;
            let rows = run[run.len() - 1] as usize + 1 - low;
            values.resize(rows * width, 0.0);
            self.file.read(4 * (first + low * width) as u64, bytemuck::cast_slice_mut(&mut values))?;
            let (run_out, rest) = out.split_at_mut(run.len() * width);
            for (to, &place) in run_out.chunks_exact_mut(width).zip(run) {
                to.copy_from_slice(&values[(place as usize - low) * width..][..width]);
            }
            out = rest;
        }
        Ok(())
    }
}

/// Returns the range of indices in a [`TrajectorySample`] of the values that belong to the attributes `columns`.
fn value_range(columns: Attributes) -> Range<usize> {
    let start = if columns.contains(Attributes::POSITION) { 0 } else { 3 };
    start..if columns.contains(Attributes::OPACITY) { 4 } else { 3 }
}

/// Reads the attributes `columns` (together W values per Gaussian and frame) of N Gaussians at `frames` into `values`,
/// laid out as `[N, frames, W]`. `places` holds for each Gaussian its id and its row in `values`, sorted by id.
fn read_frames(
    source: &dyn FrameSource,
    places: &[(u32, u32)],
    frames: Range<usize>,
    columns: Attributes,
    values: &mut Vec<f32>,
) -> Result<()> {
    let width = columns.width(0);
    values.resize(places.len() * frames.len() * width, 0.0);
    let wanted = ReadPlan::new(frames.clone());
    let read = |block: &[(u32, u32)]| -> Result<Vec<Gaussians>> {
        let ids: Vec<u32> = block.iter().map(|&(id, _)| id).collect();
        let mut reader = source.open(Ids::List(&ids))?;
        reader.expect(&wanted);
        let at = |frame| {
            let mut state = Gaussians::zeros(0, source.info().sh_degree);
            reader.read(frame, columns, &mut state)?;
            Ok(state)
        };
        frames.clone().map(at).collect()
    };
    // Only one batch of blocks is processed at a time, which bounds the memory of states that are not yet copied to
    // `values`.
    for batch in places.chunks(2 * rayon::current_num_threads() * GAUSSIANS_PER_BLOCK) {
        let blocks: Vec<Vec<Gaussians>> = batch.par_chunks(GAUSSIANS_PER_BLOCK).map(read).collect::<Result<_>>()?;
        for (block, states) in batch.chunks(GAUSSIANS_PER_BLOCK).zip(&blocks) {
            for (frame, state) in states.iter().enumerate() {
                let planes =
                    columns.iter().flat_map(|column| state.attribute_values(column).planes().chunks_exact(block.len()));
                for (c, plane) in planes.enumerate() {
                    for (&(_, place), &value) in block.iter().zip(plane) {
                        values[(place as usize * states.len() + frame) * width + c] = value;
                    }
                }
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::model::SequenceInfo;
    use crate::source::BlockReader;

    /// Test scene in which only some attributes vary with time; all others stay as they are at frame 0.
    struct PartlyStatic(DemoScene, SequenceInfo);

    impl PartlyStatic {
        fn new(varying: Attributes) -> PartlyStatic {
            let scene = DemoScene::new(3000, 7);
            let info = SequenceInfo { varying, ..scene.info().clone() };
            PartlyStatic(scene, info)
        }
    }

    impl FrameSource for PartlyStatic {
        fn info(&self) -> &SequenceInfo {
            &self.1
        }

        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            Ok(Box::new(PartlyStaticReader { reader: self.0.open(ids)?, varying: self.1.varying }))
        }
    }

    struct PartlyStaticReader<'a> {
        reader: Box<dyn BlockReader + 'a>,
        varying: Attributes,
    }

    impl BlockReader for PartlyStaticReader<'_> {
        fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
            self.reader.read(0, want, out)?;
            self.reader.read(frame, want & self.varying, out)
        }
    }

    fn samples(source: &dyn FrameSource, ids: &[u32], frame: usize) -> Vec<TrajectorySample> {
        let mut state = Gaussians::zeros(0, source.info().sh_degree);
        source.open(Ids::List(ids)).unwrap().read(frame, NEEDED, &mut state).unwrap();
        let sample = |i| {
            let [x, y, z] = state.position.row(i);
            [x, y, z, state.opacity_logit.plane(0)[i]]
        };
        (0..ids.len()).map(sample).collect()
    }

    #[test]
    fn trajectories_equal_the_source_for_any_block_size() {
        let folder = tempfile::tempdir().unwrap();
        let ids: Vec<u32> = (0..2500).map(|k| (k * 1171 + 5) % 3000).collect();
        // Places with neighbors, narrow and wide gaps, and both ends of the file.
        let places: Vec<u32> = (0..5).chain([9, 40, 300]).chain(1000..2400).chain([2499]).collect();
        let ids_at_places: Vec<u32> = places.iter().map(|&place| ids[place as usize]).collect();
        for varying in [NEEDED, Attributes::POSITION, Attributes::OPACITY, Attributes::empty()] {
            let source = PartlyStatic::new(varying);
            for frames_together in [1, 3, usize::MAX] {
                let gathered =
                    Trajectories::gather(&source, &ids, frames_together, folder.path(), &Events::IGNORED).unwrap();
                let mut played = Vec::new();
                gathered.play(&places, |samples| played.push(samples.to_vec())).unwrap();
                let frames = if varying.is_empty() { 1 } else { 7 };
                let expected: Vec<Vec<TrajectorySample>> =
                    (0..frames).map(|t| samples(&source, &ids_at_places, t)).collect();
                assert!(played == expected, "{varying:?} vary, {frames_together} frames together");
            }
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "scratch files are left");
    }
}
