//! Stage `scan`: reads every Gaussian at every frame once and gathers its statistics in a record whose size does not
//! depend on the number of frames.

use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::model::{Attributes, StatisticRows, ViewSchedule};
use crate::passes::{GAUSSIANS_PER_BLOCK, SomeFrames};
use crate::recipe;
use crate::scene::Scene;
use crate::source::FrameSource;
use crate::statistics;
use crate::statistics::ScanPlan;
use crate::statistics::pass::{ScanResult, scan_blocks, scan_units};

/// Name of this stage in plans, progress and summaries.
pub(crate) const NAME: &str = "scan";

/// Processor time of adding one Gaussian at one frame to its statistics, seconds (`benches/scan.rs`).
const SECONDS_TO_ACCUMULATE: f64 = 2e-8;
/// Processor time of projecting one Gaussian at one frame to a view, seconds (`benches/projection.rs`).
const SECONDS_TO_PROJECT: f64 = 8e-9;

/// Maximum number of frames that a partial scan reads. Such a scan measures only the bounds of positions and the
/// fraction of views in which a Gaussian is on screen; neither decides which Gaussians stay.
const PARTIAL_FRAMES: usize = 12;
/// Maximum number of frames of a partial scan if opacities vary with time. Such a scan also
/// measures life spans. The more frames it reads, the more precisely the first and last frame of a life span are known.
const PARTIAL_FRAMES_OF_VARYING_OPACITY: usize = 24;

/// Stage that gathers the statistics of all Gaussians.
#[derive(Debug, Clone)]
pub struct ScanStage {
    /// Parameters of the statistics that are gathered.
    pub recipe: recipe::ScanParams,
    /// Whether the scan may read only some of the frames, because the statistics of motion and opacity (D, κ and V)
    /// decide nothing in this run. Even then, frames are skipped only if a deformation field computes them: its values
    /// change smoothly with time.
    pub can_be_partial: bool,
}

impl ScanStage {
    /// Returns the number of frames that the scan of a sequence of `frames` frames reads. `is_deformed`: whether a
    /// deformation field computes the frames. `varying`: the attributes that vary with time.
    fn frames_read(&self, frames: usize, is_deformed: bool, varying: Attributes) -> usize {
        match (self.can_be_partial && is_deformed, varying.contains(Attributes::OPACITY)) {
            (false, _) => frames,
            (true, true) => frames.min(PARTIAL_FRAMES_OF_VARYING_OPACITY),
            (true, false) => frames.min(PARTIAL_FRAMES),
        }
    }

    /// Returns the resource estimate of the stage. Its memory holds one block of Gaussians per thread, and the
    /// statistics rows (one per Gaussian) of all blocks.
    pub fn resource_estimate(&self, work: &Workload, _: &Limits) -> ResourceEstimate {
        // Frames held by readers count twice, because a second reader may decode while the first is read.
        let block =
            statistics::BYTES_PER_GAUSSIAN as u64 + 2 * work.kept_frames_bytes(&Limits::NONE, Attributes::all());
        // Number of alive Gaussians per frame, for the blocks of all threads, and the steps between uneven frames.
        let frames = work.frames * (4 * work.threads + 8);
        let frames_read = self.frames_read(work.frames as usize, work.input.jacobian > 0, work.varying) as f64;
        ResourceEstimate {
            stage: NAME,
            reads: if work.frames == 0 { 1.0 } else { frames_read / work.frames as f64 },
            seconds: work.gaussian_count()
                * frames_read
                * (SECONDS_TO_ACCUMULATE + work.views as f64 * SECONDS_TO_PROJECT)
                + work.reading_seconds(work.gaussian_count(), frames_read),
            per_gaussian: vec![("statistics", 2 * StatisticRows::BYTES_PER_GAUSSIAN as u64)],
            fixed: vec![
                ("blocks", work.threads * work.largest_block(GAUSSIANS_PER_BLOCK as u64) * block),
                work.block_buffer_memory(),
                ("frames", frames),
            ],
        }
    }

    /// Reads the frames of `scene` and returns the statistics of every Gaussian.
    ///
    /// # Errors
    /// Fails if frames cannot be read, or if their times do not allow statistics of motion.
    pub fn run(&self, scene: &Scene, journal: &mut Journal) -> Result<ScanResult> {
        let (source, info) = (scene.source(), scene.source().info());
        let frames_read = self.frames_read(info.times.len(), source.deformation().is_some(), info.varying);
        let frames = match frames_read < info.times.len() {
            true => evenly_spaced(&frames_with_views(&scene.schedule), frames_read),
            false => Vec::new(),
        };
        if frames.is_empty() {
            let plan = ScanPlan::new(&self.recipe, &info.times, &scene.schedule)?;
            return self.scan_frames(scene, source, &scene.schedule, &plan, journal);
        }
        let some = SomeFrames::new(source, frames.clone());
        let schedule = some.views(&scene.schedule);
        let plan = ScanPlan::new(&self.recipe, &some.info().times, &schedule)?;
        let found = self.scan_frames(scene, &some, &schedule, &plan, journal)?;
        let why = format!(
            "they decide nothing here; the scan read {} of {} frames, which give life spans, bounds and the check for NaN \
             (--set scan_frames=all reads all)",
            some.info().times.len(),
            info.times.len()
        );
        journal.leave_out("statistics of motion and opacity (D, kappa, V)", why);
        Ok(found.extrapolate_to_all_frames(&frames, info.times.len()))
    }

    /// Reads all frames of `source`, which has all or some of the frames of `scene`. Returns the statistics of every
    /// Gaussian as the recipe in `plan` defines them. `schedule` holds the views of these frames.
    fn scan_frames(
        &self,
        scene: &Scene,
        source: &dyn FrameSource,
        schedule: &ViewSchedule,
        plan: &ScanPlan,
        journal: &mut Journal,
    ) -> Result<ScanResult> {
        let info = source.info();
        let compute = |blocks| scan_blocks(source, schedule, plan, blocks, &scene.events);
        journal.run_stage(NAME, info.count, source, |_| {
            let units = scan_units(info);
            let found =
                scene.work.compute_in_shards(NAME, scene.work.key(&(plan, &info.times)), units, compute, |parts| {
                    let mut all = ScanResult { alive_per_frame: vec![0; info.times.len()], ..ScanResult::default() };
                    for part in parts {
                        all.join(part?);
                    }
                    Ok(all)
                })?;
            Ok((found, info.count))
        })
    }
}

/// Returns the indices of the frames that have views in `schedule`, in increasing order.
fn frames_with_views(schedule: &ViewSchedule) -> Vec<usize> {
    (0..).zip(schedule.iter()).filter(|(_, views)| !views.is_empty()).map(|(frame, _)| frame).collect()
}

/// Returns at most `count` of the frames `frames`, evenly spaced, the first and the last among them.
fn evenly_spaced(frames: &[usize], count: usize) -> Vec<usize> {
    let (count, last) = (count.min(frames.len()), frames.len().saturating_sub(1));
    (0..count).map(|k| frames[k * last / (count - 1).max(1)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::tests::{scene, work};
    use crate::recipe::Recipe;

    #[test]
    fn every_gaussian_gets_a_row_and_the_stage_is_recorded() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let scan = ScanStage { recipe: Recipe::preset("default").unwrap().scan, can_be_partial: false };
        let mut journal = Journal::default();
        let found = scan.run(&scene, &mut journal).unwrap();
        assert_eq!((found.rows.len(), found.alive_per_frame.len()), (1500, 6));
        let stage = &journal.stages[0];
        assert_eq!((stage.name.as_str(), stage.gaussians_in, stage.gaussians_out), ("scan", 1500, 1500));
    }

    #[test]
    fn chosen_frames_are_evenly_spaced() {
        let all: Vec<usize> = (0..60).collect();
        assert_eq!(evenly_spaced(&all, 4), [0, 19, 39, 59]);
        assert_eq!(evenly_spaced(&all[..3], 24), [0, 1, 2]);
        assert_eq!(evenly_spaced(&[7, 9, 30], 2), [7, 30]);
        assert_eq!(
            (evenly_spaced(&[5], 24), evenly_spaced(&all, 1), evenly_spaced(&[], 24)),
            (vec![5], vec![0], vec![])
        );
    }

    #[test]
    fn only_frames_of_fields_are_scanned_partly() {
        let scan = ScanStage { recipe: Recipe::preset("default").unwrap().scan, can_be_partial: true };
        let (moving, fading) = (Attributes::POSITION, Attributes::OPACITY);
        assert_eq!([300, 10].map(|frames| scan.frames_read(frames, true, moving)), [PARTIAL_FRAMES, 10]);
        assert_eq!(scan.frames_read(300, true, fading), PARTIAL_FRAMES_OF_VARYING_OPACITY);
        assert_eq!(scan.frames_read(300, false, fading), 300);
        assert_eq!(ScanStage { can_be_partial: false, ..scan }.frames_read(300, true, moving), 300);
    }

    #[test]
    fn partial_scan_stands_for_all_frames() {
        let rows = StatisticRows {
            life: vec![3, 1, 0],
            d: vec![2.0; 3],
            kappa: vec![1.0; 3],
            v: vec![0.1; 3],
            ..StatisticRows::default()
        };
        let found = ScanResult { rows, alive_per_frame: vec![1, 2, 1], ..ScanResult::default() };
        let all = found.extrapolate_to_all_frames(&[0, 5, 9], 10);
        assert_eq!(all.alive_per_frame, [1, 0, 0, 0, 0, 2, 0, 0, 0, 1]);
        assert_eq!((all.rows.life, all.rows.d, all.rows.v), (vec![10, 4, 0], vec![0.0; 3], vec![0.0; 3]));
        assert!(all.is_partial);
    }

    #[test]
    fn memory_beside_rows_is_bounded_by_one_block() {
        let scan = ScanStage { recipe: Recipe::preset("default").unwrap().scan, can_be_partial: false };
        let need = |count| {
            let need = scan.resource_estimate(&work(count), &Limits::NONE);
            (need.per_gaussian, need.fixed)
        };
        assert_eq!(need(1_024), need(1_000_000));
        assert!(need(100).1[0].1 < need(1_024).1[0].1);
    }
}
