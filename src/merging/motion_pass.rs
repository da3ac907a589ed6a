//! Measurement of the motion similarity of pairs of Gaussians over all frames.
//!
//! If all pairs fit into memory, they are measured in one read of the source. Otherwise
//! [`merge_survivors`](crate::merging::merge_survivors) divides them into partitions of a fixed number of consecutive
//! pairs whose leaders are close in space, so that the Gaussians of a partition are close in space. The trajectories of
//! all survivors (Gaussians left by pruning) are then first gathered in a scratch file in voxel order. For each
//! partition, the Gaussians of its pairs are read from this file; a Gaussian with pairs in several partitions is read
//! for each of them. Partitions are cut by counting pairs, so even a voxel with more pairs than fit in memory is split.
//! All sums of a pair are computed in one partition, so partitioning does not change a bit.

use std::path::PathBuf;

use rayon::prelude::*;

use super::trajectories::{NEEDED, Trajectories};
use crate::error::Result;
use crate::merging::motion::{MotionThresholds, NODE_BYTES, PAIR_BYTES, PairMotionAccumulator};
use crate::merging::similarity_cache::PairSimilarity;
use crate::merging::voxels::voxel_order;
use crate::model::{AttributeValues, inverse_permutation, opacity};
use crate::outputs::container::FRAME_BLOCK;
use crate::passes::FrameReaders;
use crate::progress::Events;
use crate::recipe;
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan};

/// Bytes of memory for one pair while it is measured: its sums, its two indices into the list of measured Gaussians,
/// and its result.
pub const BYTES_PER_PAIR: usize = PAIR_BYTES + 8 + size_of::<f64>();

/// Returns the bytes of memory for each Gaussian in the pairs that are measured together (at most two Gaussians per
/// pair): its index and id, its record in the measurement ([`NODE_BYTES`]), and its position and opacity at one frame
/// and at the `frames_held` frames that a reader keeps. The memory of the source's own reader is not included.
pub fn bytes_per_gaussian(frames_held: usize) -> usize {
    8 + NODE_BYTES + 16 * (1 + frames_held.min(FRAME_BLOCK))
}

/// Measurement of the motion similarity of pairs of Gaussians of a source: settings, and the trajectories gathered so
/// far.
pub struct PairMeter<'a> {
    source: &'a dyn FrameSource,
    scan: &'a recipe::ScanParams,
    thresholds: MotionThresholds,
    max_kept_frames: usize,
    scratch: PathBuf,
    events: Events,
    /// Trajectories gathered in a scratch file; `None` until they are first needed.
    gathered: Option<GatheredTrajectories>,
}

/// Trajectories of Gaussians in a scratch file, in voxel order: Gaussians close in space are close in the file.
struct GatheredTrajectories {
    trajectories: Trajectories,
    /// For every index of a trajectory in the file, the row of its Gaussian in the list of ids.
    order: Vec<u32>,
    /// For every row of the list of ids, the index of its Gaussian's trajectory in the file.
    place: Vec<u32>,
}

impl<'a> PairMeter<'a> {
    /// Creates a measurement without gathered trajectories.
    /// - `source`: source from which the trajectories are read.
    /// - `scan`: scan parameters. The measurement uses `alpha_min`, the opacity from which a Gaussian is alive, and
    ///   `motion`, which defines the steps between frames that count as motion.
    /// - `thresholds`: thresholds of test 3 (motion) of merging.
    /// - `max_kept_frames`: number of consecutive frames that a reader keeps in memory; trajectories are gathered this
    ///   many frames at a time.
    /// - `scratch`: folder in which the scratch file for trajectories is created.
    /// - `events`: receiver of progress events.
    pub fn new(
        source: &'a dyn FrameSource,
        scan: &'a recipe::ScanParams,
        thresholds: MotionThresholds,
        max_kept_frames: usize,
        scratch: PathBuf,
        events: Events,
    ) -> Self {
        PairMeter { source, scan, thresholds, max_kept_frames, scratch, events, gathered: None }
    }

    /// Returns a copy of this pair meter with the same settings but without gathered trajectories.
    pub fn without_trajectories(&self) -> Self {
        PairMeter { scratch: self.scratch.clone(), events: self.events.clone(), gathered: None, ..*self }
    }

    /// Returns the parameters of the scan that define life spans and motion.
    pub fn scan(&self) -> &'a recipe::ScanParams {
        self.scan
    }

    /// Measures the motion similarity of each of `pairs` and returns it with its pair, in any order.
    /// - `ids`: increasing ids of M Gaussians; a pair is given as two rows of this list;
    /// - `reference`: positions of these M Gaussians at the reference frame, `[3, M]`;
    /// - `reach`: approximate maximum distance of the two Gaussians of a pair at that frame;
    /// - `is_part`: whether pairs are also requested in other calls, so that gathering the trajectories in a file saves
    ///   time.
    ///
    /// `ids` and `reference` must be the same in every call.
    ///
    /// Memory: 16 bytes and [`BYTES_PER_PAIR`] for every pair, and [`bytes_per_gaussian`] for every Gaussian in a pair.
    /// If trajectories are gathered, also 8 bytes for each of `ids`. While they are being gathered, also 12 bytes for
    /// each of `ids` and the values of the frames that the reader keeps. The memory does not grow with the number of
    /// frames.
    ///
    /// If neither positions nor opacities vary, only the first frame is measured.
    ///
    /// # Errors
    /// Fails if the source cannot be read, or the scratch file cannot be read or written. The scratch file is then
    /// deleted.
    pub fn measure(
        &mut self,
        ids: &[u32],
        reference: &AttributeValues,
        mut pairs: Vec<(u32, u32)>,
        reach: f64,
        is_part: bool,
    ) -> Result<Vec<PairSimilarity>> {
        if is_part && self.gathered.is_none() {
            self.gathered = Some(self.gather(ids, reference, reach)?);
        }
        let Some(GatheredTrajectories { trajectories, order, place }) = &mut self.gathered else {
            let rows = members(&pairs);
            let places = rows.iter().map(|&row| reference.row(row as usize));
            let mut motion = PairMotionAccumulator::new(local_indices(&pairs, &rows), places, self.scan.motion);
            self.play_source(&rows.iter().map(|&row| ids[row as usize]).collect::<Vec<u32>>(), &mut motion)?;
            let measured = motion.finish().map(|pair| self.thresholds.similarity(&pair));
            return Ok(pairs.iter().zip(measured).map(|(&(a, b), similarity)| (a, b, similarity)).collect());
        };
        for (a, b) in &mut pairs {
            let (i, j) = (place[*a as usize], place[*b as usize]);
            (*a, *b) = (i.min(j), i.max(j));
        }
        pairs.par_sort_unstable();
        let places = members(&pairs);
        let at = places.iter().map(|&k| reference.row(order[k as usize] as usize));
        let mut motion = PairMotionAccumulator::new(local_indices(&pairs, &places), at, self.scan.motion);
        trajectories.play(&places, |moments| {
            motion.add_frame(|node| {
                let [x, y, z, logit] = moments[node];
                ([x, y, z], opacity(logit) >= self.scan.alpha_min)
            });
        })?;
        let measured = motion.finish().map(|pair| self.thresholds.similarity(&pair));
        let by_row = |(&(i, j), similarity): (&(u32, u32), f64)| {
            let (a, b) = (order[i as usize], order[j as usize]);
            (a.min(b), a.max(b), similarity)
        };
        Ok(pairs.iter().zip(measured).map(by_row).collect())
    }

    /// Gathers the trajectories of all Gaussians `ids` in a scratch file, in voxel order: sorted by the voxel (of side
    /// `reach`) in which their position in `reference` lies. Returns the handle of this file. Fails if the source
    /// cannot be read or the scratch file cannot be written.
    fn gather(&self, ids: &[u32], reference: &AttributeValues, reach: f64) -> Result<GatheredTrajectories> {
        let order = voxel_order(&(0..ids.len() as u32).collect::<Vec<_>>(), |row| reference.row(row as usize), reach);
        let ordered_ids: Vec<u32> = order.iter().map(|&row| ids[row as usize]).collect();
        let trajectories =
            Trajectories::gather(self.source, &ordered_ids, self.max_kept_frames, &self.scratch, &self.events)?;
        Ok(GatheredTrajectories { trajectories, place: inverse_permutation(&order), order })
    }

    /// Passes every frame of the Gaussians `ids` of the source to `motion`. Passes only the first frame if neither
    /// positions nor opacities vary with time.
    fn play_source(&self, ids: &[u32], motion: &mut PairMotionAccumulator) -> Result<()> {
        let info = self.source.info();
        let varying = info.varying & NEEDED;
        let frames = if varying.is_empty() { info.times.len().min(1) } else { info.times.len() };
        let progress = self.events.task("merge", "states", (ids.len() * frames) as u64);
        let wanted = ReadPlan::new(0..frames).with_max_kept_frames(self.max_kept_frames);
        let mut readers = FrameReaders::open(self.source, Ids::List(ids), NEEDED, &wanted)?;
        let mut state = readers.state_buffer();
        for frame in 0..frames {
            readers.read(frame, if frame == 0 { NEEDED } else { varying }, &mut state)?;
            progress.advance(ids.len() as u64);
            motion.add_frame(|node| {
                (state.position.row(node), opacity(state.opacity_logit.plane(0)[node]) >= self.scan.alpha_min)
            });
        }
        Ok(())
    }
}

/// Returns the indices of all Gaussians that occur in `pairs`, increasing and without duplicates.
fn members(pairs: &[(u32, u32)]) -> Vec<u32> {
    let mut members = Vec::with_capacity(2 * pairs.len());
    members.extend(pairs.iter().flat_map(|&(a, b)| [a, b]));
    members.par_sort_unstable();
    members.dedup();
    members.shrink_to_fit();
    members
}

/// Converts each pair of `pairs`, given as two values that occur in the sorted list `members`, to the indices of these
/// values in the list.
fn local_indices<'a>(pairs: &'a [(u32, u32)], members: &'a [u32]) -> impl ExactSizeIterator<Item = (u32, u32)> + 'a {
    let place = |member: u32| members.binary_search(&member).unwrap_or_default() as u32;
    pairs.iter().map(move |&(a, b)| (place(a), place(b)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnostics::demo_scene::DemoScene;
    use crate::error::Error;
    use crate::model::{Attributes, Gaussians, SequenceInfo};
    use crate::passes::gather;
    use crate::recipe::Recipe;
    use crate::source::BlockReader;

    /// Frame at which the tests take the reference positions of the Gaussians.
    const REFERENCE: usize = 3;

    /// Test case: every third Gaussian of a demo scene, and all pairs of these that are at most `reach` apart.
    struct Case {
        scene: DemoScene,
        recipe: Recipe,
        ids: Vec<u32>,
        reference: AttributeValues,
        pairs: Vec<(u32, u32)>,
    }

    impl Case {
        fn new(reach: f64) -> Case {
            let scene = DemoScene::new(1500, 9);
            let ids: Vec<u32> = (0..1500).step_by(3).collect();
            let reference = gather(&scene, &ids, REFERENCE, Attributes::POSITION).unwrap().position;
            let at = |i: u32| glam::DVec3::from(reference.row::<3>(i as usize).map(f64::from));
            let count = ids.len() as u32;
            let pairs = (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b)));
            let pairs = pairs.filter(|&(a, b)| at(a).distance(at(b)) <= reach).collect();
            Case { recipe: Recipe::preset("default").unwrap(), ids, pairs, reference, scene }
        }

        fn measure(&self, source: &dyn FrameSource, pairs_together: usize, reach: f64) -> Result<Vec<(u32, u32, u64)>> {
            let folder = tempfile::tempdir().unwrap();
            let thresholds = MotionThresholds::new(&self.recipe.merge, 4.0);
            let scratch = folder.path().to_owned();
            let mut meter = PairMeter::new(source, &self.recipe.scan, thresholds, 4, scratch, Events::IGNORED);
            let is_part = self.pairs.len() > pairs_together;
            // Without pairs there is still one (empty) part.
            let starts = (0..self.pairs.len().max(1)).step_by(pairs_together);
            let parts =
                starts.map(|start| &self.pairs[start..self.pairs.len().min(start.saturating_add(pairs_together))]);
            let found: Result<Vec<Vec<PairSimilarity>>> =
                parts.map(|part| meter.measure(&self.ids, &self.reference, part.to_vec(), reach, is_part)).collect();
            drop(meter);
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "scratch files are left");
            // NaN is a valid result, so bits are compared.
            let mut found: Vec<(u32, u32, u64)> =
                found?.into_iter().flatten().map(|(a, b, x)| (a, b, x.to_bits())).collect();
            found.sort_unstable();
            Ok(found)
        }

        /// Measures the motion similarity of all candidate pairs by reading every frame once with all Gaussians,
        /// without dividing the pairs into partitions. Returns for each pair the indices of its Gaussians in `ids` and
        /// the bits of the similarity (`f64::to_bits`), so that NaN equals NaN.
        fn measure_whole(&self) -> Vec<(u32, u32, u64)> {
            let thresholds = MotionThresholds::new(&self.recipe.merge, 4.0);
            let reference = (0..self.ids.len()).map(|i| self.reference.row(i));
            let mut motion = PairMotionAccumulator::new(self.pairs.iter().copied(), reference, self.recipe.scan.motion);
            for frame in 0..self.scene.info().times.len() {
                let state = gather(&self.scene, &self.ids, frame, NEEDED).unwrap();
                let alive = |i| opacity(state.opacity_logit.plane(0)[i]) >= self.recipe.scan.alpha_min;
                motion.add_frame(|i| (state.position.row(i), alive(i)));
            }
            let similarity = motion.finish().map(|pair| thresholds.similarity(&pair).to_bits());
            self.pairs.iter().zip(similarity).map(|(&(a, b), similarity)| (a, b, similarity)).collect()
        }
    }

    #[test]
    fn partition_count_does_not_change_similarities() {
        let reach = 0.5;
        let case = Case::new(reach);
        let (all, expected) = (case.pairs.len(), case.measure_whole());
        assert!(all > 1000, "{all} pairs");
        let apart = expected.iter().filter(|(.., similarity)| f64::from_bits(*similarity).is_nan()).count();
        assert!(apart > 0 && apart + 100 < all, "{apart} of {all} drift apart");
        for partitions in [1, 7, 64, all] {
            let got = case.measure(&case.scene, all.div_ceil(partitions), reach).unwrap();
            assert!(got == expected, "{partitions} partitions");
        }
    }

    #[test]
    fn overfull_voxels_are_split() {
        let case = Case::new(0.3);
        // The voxels are wider than the scene, so all pairs are in one voxel.
        let got = case.measure(&case.scene, case.pairs.len() / 5, 1e6).unwrap();
        assert!(got == case.measure_whole());
    }

    #[test]
    fn without_pairs_nothing_is_read() {
        let case = Case { pairs: Vec::new(), ..Case::new(0.0) };
        let unreadable = Failing { scene: &case.scene, from: 0 };
        assert!(case.measure(&unreadable, 1, 0.3).unwrap().is_empty());
    }

    #[test]
    fn a_failing_source_leaves_no_scratch_file() {
        let case = Case::new(0.3);
        let failing = Failing { scene: &case.scene, from: 6 };
        for pairs_together in [usize::MAX, 10] {
            let error = case.measure(&failing, pairs_together, 0.3).unwrap_err();
            assert!(error.to_string().contains("frame 6 is gone"), "{error}");
        }
    }

    /// Scene whose frames from number `from` on cannot be read.
    struct Failing<'a> {
        scene: &'a DemoScene,
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
        fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
            if frame >= self.from {
                return Err(Error::usage(format!("frame {frame} is gone")));
            }
            self.reader.read(frame, want, out)
        }
    }
}
