//! Stage `scan`: reads every Gaussian at every frame once and gathers its statistics in a state of fixed size.

use crate::error::Result;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::model::{Attributes, Rows};
use crate::passes::GAUSSIANS_PER_BLOCK;
use crate::recipe;
use crate::scene::Scene;
use crate::statistics;
use crate::statistics::ScanPlan;
use crate::statistics::pass::{ScanResult, scan_blocks, scan_units};

/// Name of this stage in plans, progress and summaries.
pub(crate) const NAME: &str = "scan";

/// Processor time of adding one Gaussian at one frame to its statistics, seconds (`benches/scan.rs`).
const SECONDS_TO_ACCUMULATE: f64 = 2e-8;
/// Processor time of projecting one Gaussian at one frame to a view, seconds (`benches/projection.rs`).
const SECONDS_TO_PROJECT: f64 = 8e-9;

/// Stage that gathers the statistics of all Gaussians.
#[derive(Debug, Clone)]
pub struct ScanStage {
    /// Parameters of the statistics that are gathered.
    pub recipe: recipe::ScanParams,
}

impl ScanStage {
    /// Returns the resource estimate of the stage. Its memory holds one block of Gaussians per thread, and the
    /// statistics rows (one per Gaussian) of all blocks.
    pub fn resource_estimate(&self, work: &Workload, _: &Limits) -> ResourceEstimate {
        // Frames held by readers count twice, because a second reader may decode while the first is read.
        let block =
            statistics::BYTES_PER_GAUSSIAN as u64 + 2 * work.kept_frames_bytes(&Limits::NONE, Attributes::all());
        // Number of alive Gaussians per frame, for the blocks of all threads, and the steps between uneven frames.
        let frames = work.frames * (4 * work.threads + 8);
        ResourceEstimate {
            stage: NAME,
            reads: 1.0,
            seconds: work.throughput.states
                * work.gaussian_count()
                * work.frames as f64
                * (SECONDS_TO_ACCUMULATE + work.views as f64 * SECONDS_TO_PROJECT)
                + work.reading_seconds(work.gaussian_count(), work.frames as f64),
            per_gaussian: vec![("rows", 2 * Rows::BYTES_PER_GAUSSIAN as u64)],
            fixed: vec![
                ("blocks", work.threads * work.largest_block(GAUSSIANS_PER_BLOCK as u64) * block),
                work.filling_blocks(),
                ("frames", frames),
            ],
        }
    }

    /// Reads all frames of `scene` and returns the statistics of every Gaussian.
    ///
    /// # Errors
    /// Fails if frames cannot be read, or if their times do not allow statistics of motion.
    pub fn run(&self, scene: &Scene, journal: &mut Journal) -> Result<ScanResult> {
        let source = scene.source();
        let info = source.info();
        let plan = ScanPlan::new(&self.recipe, &info.times, &scene.schedule)?;
        let compute = |blocks| scan_blocks(source, &scene.schedule, &plan, blocks, &scene.events);
        journal.run_stage(NAME, info.count, source, |_| {
            let units = scan_units(info);
            let found = scene.work.compute_in_shards(NAME, scene.work.key(&plan), units, compute, |parts| {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::tests::{scene, work};
    use crate::recipe::Recipe;

    #[test]
    fn every_gaussian_gets_a_row_and_the_stage_is_recorded() {
        let folder = tempfile::tempdir().unwrap();
        let scene = scene(folder.path());
        let scan = ScanStage { recipe: Recipe::preset("default").unwrap().scan };
        let mut journal = Journal::default();
        let found = scan.run(&scene, &mut journal).unwrap();
        assert_eq!((found.rows.len(), found.alive_per_frame.len()), (1500, 6));
        let stage = &journal.stages[0];
        assert_eq!((stage.name.as_str(), stage.gaussians_in, stage.gaussians_out), ("scan", 1500, 1500));
    }

    #[test]
    fn memory_beside_rows_is_bounded_by_one_block() {
        let scan = ScanStage { recipe: Recipe::preset("default").unwrap().scan };
        let need = |count| {
            let need = scan.resource_estimate(&work(count), &Limits::NONE);
            (need.per_gaussian, need.fixed)
        };
        assert_eq!(need(1_024), need(1_000_000));
        assert!(need(100).1[0].1 < need(1_024).1[0].1);
    }
}
