//! Trajectories of some Gaussians in a scratch container, in an order of their own: what is read together lies
//! together, so that a piece is read without the rest.
//!
//! The source is read once, block of Gaussians by block of Gaussians in the order of ids, some frames at a time:
//! what holds tiles decodes each once if they span no more frames, and opening a file costs once per block.
//! Memory while they are gathered: per Gaussian 8 bytes, and those of its columns for every frame taken together; for
//! every thread two blocks of as many frames. Nothing grows with the number of frames.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use gseq::Compression;
use rayon::prelude::*;

use super::{BLOCK, Progress};
use crate::emit::atomic::ScratchFile;
use crate::emit::container::{ContainerWriter, FRAME_BLOCK};
use crate::error::Result;
use crate::ingest::container::Container;
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::pass::{BlockReader, FrameSource, Ids};

/// Packed by the fastest level: a fraction of the disk that raw trajectories take, and the container then keeps no
/// mapped pages of the size of what it holds.
const COMPRESSION: Compression = Compression::Zstd(1);

/// Trajectories in a file that lasts as long as this.
pub struct Trajectories {
    container: Container,
    _scratch: ScratchFile,
}

impl Trajectories {
    /// Gathers the columns `want` of the Gaussians `ids` of `source`, all different, in a file in `folder`; all other
    /// columns are zero. Takes at most `frames_together` frames at a time.
    ///
    /// # Errors
    /// Those of reading `source` and of writing the file, which is gone then.
    pub fn gather(
        source: &dyn FrameSource,
        ids: &[u32],
        want: Columns,
        frames_together: usize,
        folder: &Path,
    ) -> Result<Trajectories> {
        let of_source = source.info();
        let info =
            SequenceInfo { count: ids.len(), times: Vec::new(), sh_degree: 0, varying: of_source.varying & want };
        let mut by_id: Vec<(u32, u32)> = ids.iter().copied().zip(0..).collect();
        by_id.par_sort_unstable();
        let mut rows = vec![0; ids.len()];
        for (row, &(_, place)) in by_id.iter().enumerate() {
            rows[place as usize] = row as u32;
        }
        let sorted: Vec<u32> = by_id.into_iter().map(|(id, _)| id).collect();

        let scratch = ScratchFile::new(folder)?;
        let block = frames_together.clamp(1, FRAME_BLOCK);
        let mut writer = ContainerWriter::create(scratch.path(), ids.len(), 0, block, COMPRESSION, BTreeMap::new())?;
        let progress = Progress::new("gather", "Gaussian frames", (ids.len() * of_source.times.len()) as u64);
        let mut gathered = Gathered { info, want, rows, frames: Vec::new() };
        for start in (0..of_source.times.len()).step_by(block) {
            let frames = start..of_source.times.len().min(start + block);
            gathered.take(source, &sorted, frames.clone())?;
            writer.append(&gathered, 0..frames.len(), |done| progress.advance(done))?;
        }
        writer.finish()?;
        Ok(Trajectories { container: Container::open(scratch.path())?, _scratch: scratch })
    }

    /// The trajectories as a source: Gaussian k is the k-th that was asked for.
    pub fn source(&self) -> &dyn FrameSource {
        &self.container
    }
}

/// Some frames of the Gaussians, as they are to be written.
struct Gathered {
    info: SequenceInfo,
    want: Columns,
    /// Row in the frames of every Gaussian.
    rows: Vec<u32>,
    /// By increasing id; columns that do not vary are in the first alone.
    frames: Vec<Gaussians>,
}

impl Gathered {
    /// Takes `frames` of `source` in place of those before; `ids` increase.
    fn take(&mut self, source: &dyn FrameSource, ids: &[u32], frames: Range<usize>) -> Result<()> {
        let of_source = source.info();
        self.info.times = of_source.times[frames.clone()].to_vec();
        self.frames.resize_with(frames.len().max(self.frames.len()), || Gaussians::zeros(0, 0));
        let columns = |frame: usize| if frame == 0 { self.want } else { self.info.varying };
        if columns(frames.end - 1).is_empty() && columns(frames.start).is_empty() {
            return Ok(());
        }
        for (state, frame) in self.frames.iter_mut().zip(frames.clone()) {
            columns(frame).iter().for_each(|column| state.column_mut(column).resize(ids.len()));
        }
        let read = |ids: &[u32]| -> Result<Vec<Gaussians>> {
            let mut reader = source.open(Ids::List(ids))?;
            reader.hold(frames.len());
            let at = |frame| {
                let mut state = Gaussians::zeros(0, of_source.sh_degree);
                reader.read(frame, columns(frame), &mut state)?;
                Ok(state)
            };
            frames.clone().map(at).collect()
        };
        // One batch of blocks at a time bounds what waits to be put in its place.
        let batch = 2 * rayon::current_num_threads() * BLOCK;
        for (ids, start) in ids.chunks(batch).zip((0..).step_by(batch)) {
            let blocks: Vec<Vec<Gaussians>> = ids.par_chunks(BLOCK).map(read).collect::<Result<_>>()?;
            for (of_block, start) in blocks.iter().zip((start..).step_by(BLOCK)) {
                for ((state, block), frame) in self.frames.iter_mut().zip(of_block).zip(frames.clone()) {
                    for column in columns(frame).iter() {
                        let (from, to) = (block.column(column), state.column_mut(column));
                        for c in 0..from.width() {
                            to.plane_mut(c)[start..][..from.len()].copy_from_slice(from.plane(c));
                        }
                    }
                }
            }
        }
        Ok(())
    }
}

impl FrameSource for Gathered {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Ok(Box::new(GatheredReader { gathered: self, rows: ids.iter().map(|id| self.rows[id]).collect() }))
    }
}

struct GatheredReader<'a> {
    gathered: &'a Gathered,
    rows: Vec<u32>,
}

impl BlockReader for GatheredReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        let Gathered { info, want: known, frames, .. } = self.gathered;
        for column in want.iter() {
            let to = out.column_mut(column);
            to.resize(self.rows.len());
            if !known.contains(column) {
                to.planes_mut().fill(0.0);
                continue;
            }
            let from = frames[if info.varying.contains(column) { frame } else { 0 }].column(column);
            for c in 0..to.width() {
                let plane = from.plane(c);
                to.plane_mut(c).iter_mut().zip(&self.rows).for_each(|(to, &row)| *to = plane[row as usize]);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::Scene;

    fn states(source: &dyn FrameSource, ids: &[u32], frame: usize) -> (Vec<u32>, Vec<u32>) {
        let mut state = Gaussians::zeros(0, source.info().sh_degree);
        let mut reader = source.open(Ids::List(ids)).unwrap();
        reader.read(frame, Columns::POSITION | Columns::OPACITY, &mut state).unwrap();
        let bits = |planes: &[f32]| planes.iter().map(|x| x.to_bits()).collect();
        (bits(state.position.planes()), bits(state.opacity_logit.planes()))
    }

    #[test]
    fn gathered_trajectories_are_those_of_the_source_in_any_order_however_many_frames_are_taken_together() {
        let folder = tempfile::tempdir().unwrap();
        let scene = Scene::new(3000, 7);
        let ids: Vec<u32> = (0..2500).map(|k| (k * 1171 + 5) % 3000).collect();
        for frames_together in [1, 3, usize::MAX] {
            let gathered = Trajectories::gather(
                &scene,
                &ids,
                Columns::POSITION | Columns::OPACITY,
                frames_together,
                folder.path(),
            )
            .unwrap();
            assert_eq!(gathered.source().info().times, scene.info().times);
            let places = [0, 1, 999, 1024, 2499, 7];
            let of_places = places.map(|place| ids[place as usize]);
            for frame in [0, 2, 3, 6] {
                let (got, expected) = (states(gathered.source(), &places, frame), states(&scene, &of_places, frame));
                assert_eq!(got, expected, "frame {frame}, {frames_together} together");
            }
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "scratch files are left");
    }

    #[test]
    fn what_does_not_vary_is_stored_once() {
        let folder = tempfile::tempdir().unwrap();
        let scene = Scene::new(100, 70);
        let gathered = Trajectories::gather(&scene, &[3, 99], Columns::LOG_SCALE, 4, folder.path()).unwrap();
        assert!(gathered.source().info().varying.is_empty());
        let mut state = Gaussians::zeros(0, 0);
        gathered.source().open(Ids::Range(0..2)).unwrap().read(69, Columns::LOG_SCALE, &mut state).unwrap();
        let mut expected = Gaussians::zeros(0, scene.info().sh_degree);
        scene.open(Ids::List(&[3, 99])).unwrap().read(0, Columns::LOG_SCALE, &mut expected).unwrap();
        assert_eq!(state.log_scale, expected.log_scale);
    }
}
