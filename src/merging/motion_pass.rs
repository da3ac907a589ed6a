//! Measuring how alike pairs of Gaussians move, over all frames.
//!
//! As long as all pairs fit, they are measured in one read of the source. Else [`crate::merging::run`] cuts them into
//! partitions, so many consecutive pairs in voxel order, and the trajectories of all survivors are gathered once in
//! that order: a partition reads the Gaussians that lead its pairs and their ghosts, the partners within ε that other
//! partitions share. As partitions are cut by counting pairs, a voxel that holds more than fit is split. Every pair is
//! summed whole in one partition, so no cut changes a bit.

use std::path::PathBuf;

use rayon::prelude::*;

use super::trajectories::{NEEDED, Trajectories};
use crate::error::Result;
use crate::merging::known::Likeness;
use crate::merging::motion::{MotionGate, NODE_BYTES, PAIR_BYTES, PairMotion};
use crate::merging::voxels::voxel_order;
use crate::model::{Column, opacity};
use crate::outputs::container::FRAME_BLOCK;
use crate::passes::FrameReaders;
use crate::progress::Events;
use crate::recipe;
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan};

/// Memory of one pair while it is measured: its sums, its two Gaussians while they are counted, its result.
pub const BYTES_PER_PAIR: usize = PAIR_BYTES + 8 + size_of::<f64>();

/// Memory of one Gaussian of the pairs that are measured together, at most two per pair, beside what the reader of the
/// source itself keeps: number and id, track, state at one frame, and the frames a reader holds.
pub fn bytes_per_gaussian(frames_held: usize) -> usize {
    8 + NODE_BYTES + 16 * (1 + frames_held.min(FRAME_BLOCK))
}

/// Measures pairs of Gaussians of a source.
pub struct PairMeter<'a> {
    /// Where they move.
    pub source: &'a dyn FrameSource,
    /// What is life, and what is a step.
    pub scan: &'a recipe::ScanParams,
    /// What makes a pair alike.
    pub gate: MotionGate,
    /// Frames that readers hold, and that are gathered together.
    pub frames_held: usize,
    /// Folder for trajectories that have to wait.
    pub scratch: PathBuf,
    /// Where progress goes.
    pub events: Events,
    /// None at first.
    pub gathered: Option<Gathered>,
}

/// Trajectories that wait in voxel order.
pub struct Gathered {
    trajectories: Trajectories,
    /// Row of every place.
    order: Vec<u32>,
    /// Place of every row.
    place: Vec<u32>,
}

impl PairMeter<'_> {
    /// The same, with nothing gathered.
    pub fn fresh(&self) -> Self {
        PairMeter { scratch: self.scratch.clone(), events: self.events.clone(), gathered: None, ..*self }
    }

    /// How alike each of `pairs` (rows of `ids`, which increase) moves, in some order. `reference` `[3, M]` holds the
    /// positions of `ids` at the reference frame; partners lie within about `reach` of each other there. Both are the
    /// same at every call. `is_part`: other pairs were or will be asked for, so that gathering pays.
    ///
    /// Memory: 16 bytes and [`BYTES_PER_PAIR`] for every pair, [`bytes_per_gaussian`] for everybody in one; and of a
    /// part 8 bytes for each of `ids` and, while they are gathered, 12 more and their moments at the
    /// frames held. Nothing grows with the number of frames. A sequence in which neither positions nor opacities vary is
    /// measured by its first.
    ///
    /// # Errors
    /// Those of reading the source, and of writing and reading the scratch file, which is gone then.
    pub fn measure(
        &mut self,
        ids: &[u32],
        reference: &Column,
        mut pairs: Vec<(u32, u32)>,
        reach: f64,
        is_part: bool,
    ) -> Result<Vec<Likeness>> {
        if is_part && self.gathered.is_none() {
            self.gathered = Some(self.gather(ids, reference, reach)?);
        }
        let Some(Gathered { trajectories, order, place }) = &mut self.gathered else {
            let rows = members(&pairs);
            let places = rows.iter().map(|&row| reference.row(row as usize));
            let mut motion = PairMotion::new(local(&pairs, &rows), places, self.scan.motion);
            self.play_source(&rows.iter().map(|&row| ids[row as usize]).collect::<Vec<u32>>(), &mut motion)?;
            let measured = motion.finish().map(|pair| self.gate.likeness(&pair));
            return Ok(pairs.iter().zip(measured).map(|(&(a, b), likeness)| (a, b, likeness)).collect());
        };
        for (a, b) in &mut pairs {
            let (i, j) = (place[*a as usize], place[*b as usize]);
            (*a, *b) = (i.min(j), i.max(j));
        }
        pairs.par_sort_unstable();
        let places = members(&pairs);
        let at = places.iter().map(|&k| reference.row(order[k as usize] as usize));
        let mut motion = PairMotion::new(local(&pairs, &places), at, self.scan.motion);
        trajectories.play(&places, |moments| {
            motion.frame(|node| {
                let [x, y, z, logit] = moments[node];
                ([x, y, z], opacity(logit) >= self.scan.alpha_min)
            });
        })?;
        let measured = motion.finish().map(|pair| self.gate.likeness(&pair));
        let of_rows = |(&(i, j), likeness): (&(u32, u32), f64)| {
            let (a, b) = (order[i as usize], order[j as usize]);
            (a.min(b), a.max(b), likeness)
        };
        Ok(pairs.iter().zip(measured).map(of_rows).collect())
    }

    /// The trajectories of all of `ids` in voxels of side `reach`.
    fn gather(&self, ids: &[u32], reference: &Column, reach: f64) -> Result<Gathered> {
        let rows: Vec<u32> = (0..ids.len() as u32).collect();
        let order = voxel_order(&rows, |row| reference.row(row as usize), reach);
        let of_order: Vec<u32> = order.iter().map(|&row| ids[row as usize]).collect();
        let trajectories = Trajectories::gather(self.source, &of_order, self.frames_held, &self.scratch, &self.events)?;
        let mut place = rows;
        for (&row, k) in order.iter().zip(0u32..) {
            place[row as usize] = k;
        }
        Ok(Gathered { trajectories, order, place })
    }

    /// Shows `motion` every frame of the Gaussians `ids`; the first alone if nothing varies.
    fn play_source(&self, ids: &[u32], motion: &mut PairMotion) -> Result<()> {
        let info = self.source.info();
        let varying = info.varying & NEEDED;
        let frames = if varying.is_empty() { info.times.len().min(1) } else { info.times.len() };
        let progress = self.events.task("merge", "states", (ids.len() * frames) as u64);
        let wanted = ReadPlan::new(0..frames).holding(self.frames_held);
        let mut readers = FrameReaders::open(self.source, Ids::List(ids), NEEDED, &wanted)?;
        let mut state = readers.state();
        for frame in 0..frames {
            readers.read(frame, if frame == 0 { NEEDED } else { varying }, &mut state)?;
            progress.advance(ids.len() as u64);
            motion.frame(|node| {
                (state.position.row(node), opacity(state.opacity_logit.plane(0)[node]) >= self.scan.alpha_min)
            });
        }
        Ok(())
    }
}

/// Everybody in a pair, increasing.
fn members(pairs: &[(u32, u32)]) -> Vec<u32> {
    let mut members = Vec::with_capacity(2 * pairs.len());
    members.extend(pairs.iter().flat_map(|&(a, b)| [a, b]));
    members.par_sort_unstable();
    members.dedup();
    members.shrink_to_fit();
    members
}

/// The pairs as places in `members`.
fn local<'a>(pairs: &'a [(u32, u32)], members: &'a [u32]) -> impl ExactSizeIterator<Item = (u32, u32)> + 'a {
    let place = |member: u32| members.binary_search(&member).unwrap_or_default() as u32;
    pairs.iter().map(move |&(a, b)| (place(a), place(b)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::Scene;
    use crate::error::Error;
    use crate::model::{Columns, Gaussians, SequenceInfo};
    use crate::passes::gather;
    use crate::recipe::Recipe;
    use crate::source::BlockReader;

    /// The reference frame of all tests.
    const REFERENCE: usize = 3;

    /// Every third Gaussian of a demo scene, and all pairs of them within `reach`.
    struct Case {
        scene: Scene,
        recipe: Recipe,
        ids: Vec<u32>,
        reference: Column,
        pairs: Vec<(u32, u32)>,
    }

    impl Case {
        fn new(reach: f64) -> Case {
            let scene = Scene::new(1500, 9);
            let ids: Vec<u32> = (0..1500).step_by(3).collect();
            let reference = gather(&scene, &ids, REFERENCE, Columns::POSITION).unwrap().position;
            let at = |i: u32| glam::DVec3::from(reference.row::<3>(i as usize).map(f64::from));
            let count = ids.len() as u32;
            let pairs = (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b)));
            let pairs = pairs.filter(|&(a, b)| at(a).distance(at(b)) <= reach).collect();
            Case { recipe: Recipe::preset("default").unwrap(), ids, pairs, reference, scene }
        }

        fn measure(&self, source: &dyn FrameSource, pairs_together: usize, reach: f64) -> Result<Vec<(u32, u32, u64)>> {
            let folder = tempfile::tempdir().unwrap();
            let mut meter = PairMeter {
                source,
                scan: &self.recipe.scan,
                gate: MotionGate::new(&self.recipe.merge, 4.0),
                frames_held: 4,
                scratch: folder.path().to_owned(),
                events: Events::IGNORED,
                gathered: None,
            };
            let is_part = self.pairs.len() > pairs_together;
            // No pairs are one part.
            let starts = (0..self.pairs.len().max(1)).step_by(pairs_together);
            let of_parts =
                starts.map(|start| &self.pairs[start..self.pairs.len().min(start.saturating_add(pairs_together))]);
            let found: Result<Vec<Vec<Likeness>>> =
                of_parts.map(|part| meter.measure(&self.ids, &self.reference, part.to_vec(), reach, is_part)).collect();
            drop(meter);
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "scratch files are left");
            // NaN is a finding too, so bits are compared.
            let mut found: Vec<(u32, u32, u64)> =
                found?.into_iter().flatten().map(|(a, b, x)| (a, b, x.to_bits())).collect();
            found.sort_unstable();
            Ok(found)
        }

        /// All frames of all Gaussians at once.
        fn plainly(&self) -> Vec<(u32, u32, u64)> {
            let gate = MotionGate::new(&self.recipe.merge, 4.0);
            let reference = (0..self.ids.len()).map(|i| self.reference.row(i));
            let mut motion = PairMotion::new(self.pairs.iter().copied(), reference, self.recipe.scan.motion);
            for frame in 0..self.scene.info().times.len() {
                let state = gather(&self.scene, &self.ids, frame, NEEDED).unwrap();
                let alive = |i| opacity(state.opacity_logit.plane(0)[i]) >= self.recipe.scan.alpha_min;
                motion.frame(|i| (state.position.row(i), alive(i)));
            }
            let likeness = motion.finish().map(|pair| gate.likeness(&pair).to_bits());
            self.pairs.iter().zip(likeness).map(|(&(a, b), likeness)| (a, b, likeness)).collect()
        }
    }

    #[test]
    fn any_number_of_partitions_finds_what_one_look_at_everything_finds() {
        let reach = 0.5;
        let case = Case::new(reach);
        let (all, expected) = (case.pairs.len(), case.plainly());
        assert!(all > 1000, "{all} pairs");
        let apart = expected.iter().filter(|(.., likeness)| f64::from_bits(*likeness).is_nan()).count();
        assert!(apart > 0 && apart + 100 < all, "{apart} of {all} drift apart");
        for partitions in [1, 7, 64, all] {
            let got = case.measure(&case.scene, all.div_ceil(partitions), reach).unwrap();
            assert!(got == expected, "{partitions} partitions");
        }
    }

    #[test]
    fn a_voxel_with_more_pairs_than_a_partition_holds_is_split() {
        let case = Case::new(0.3);
        // Voxels wider than the scene: all pairs are led from one.
        let got = case.measure(&case.scene, case.pairs.len() / 5, 1e6).unwrap();
        assert!(got == case.plainly());
    }

    #[test]
    fn no_pair_reads_nothing() {
        let case = Case { pairs: Vec::new(), ..Case::new(0.0) };
        let unreadable = Failing { scene: &case.scene, from: 0 };
        assert!(case.measure(&unreadable, 1, 0.3).unwrap().is_empty());
    }

    #[test]
    fn a_source_that_fails_midway_leaves_no_scratch_file() {
        let case = Case::new(0.3);
        let failing = Failing { scene: &case.scene, from: 6 };
        for pairs_together in [usize::MAX, 10] {
            let error = case.measure(&failing, pairs_together, 0.3).unwrap_err();
            assert!(error.to_string().contains("frame 6 is gone"), "{error}");
        }
    }

    /// A scene whose frames cannot be read from one on.
    struct Failing<'a> {
        scene: &'a Scene,
        from: usize,
    }

    impl FrameSource for Failing<'_> {
        fn info(&self) -> &SequenceInfo {
            self.scene.info()
        }

        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            Ok(Box::new(FailingReader { reader: self.scene.open(ids)?, from: self.from }))
        }
    }

    struct FailingReader<'a> {
        reader: Box<dyn BlockReader + 'a>,
        from: usize,
    }

    impl BlockReader for FailingReader<'_> {
        fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
            if frame >= self.from {
                return Err(Error::usage(format!("frame {frame} is gone")));
            }
            self.reader.read(frame, want, out)
        }
    }
}
