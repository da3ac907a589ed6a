//! The scan: every Gaussian at every frame once, blocks of Gaussians on all threads.

use std::sync::Mutex;

use rayon::prelude::*;

use super::{BLOCK, Progress};
use crate::error::Result;
use crate::model::{Camera, Columns, Gaussians, Rows, Schedule};
use crate::pass::{FrameSource, Ids};
use crate::stats::{BlockScan, ScanPlan};

/// What a scan gives.
#[derive(Debug)]
pub struct Scanned {
    /// One row per Gaussian; D and κ before noise is snapped, E not filled.
    pub rows: Rows,
    /// Living Gaussians in each frame.
    pub alive_per_frame: Vec<u32>,
    /// Largest |coordinate| of any position in any frame.
    pub largest_coordinate: f32,
}

/// Scans `source` as seen by the cameras of `schedule`.
///
/// Memory: a row per Gaussian, 4 bytes per frame, and per thread one block of Gaussians with its
/// accumulators ([`crate::stats::BYTES_PER_GAUSSIAN`] each) and its state at one frame.
pub fn scan(source: &dyn FrameSource, schedule: &Schedule, plan: &ScanPlan) -> Result<Scanned> {
    let info = source.info();
    let frames = info.times.len();
    let cameras: Vec<Vec<&Camera>> = schedule
        .frames
        .iter()
        .map(|views| views.iter().map(|&(_, camera)| &schedule.cameras[camera as usize]).collect())
        .collect();
    let progress = Progress::new("scan", "Gaussian frames", info.count as u64 * frames as u64);
    // Sums of integers: the order in which blocks finish does not show.
    let alive = Mutex::new(vec![0u32; frames]);
    let blocks: Vec<(Rows, f32)> = (0..info.count.div_ceil(BLOCK))
        .into_par_iter()
        .map(|block| {
            let range = block * BLOCK..info.count.min((block + 1) * BLOCK);
            let len = range.len();
            let mut scan = BlockScan::new(len, range.start, plan);
            let mut reader = source.open(Ids::Range(range))?;
            let mut state = Gaussians::zeros(len, info.sh_degree);
            for (t, cameras) in cameras.iter().enumerate() {
                let changed = if t == 0 { Columns::ALL } else { info.varying };
                reader.read(t, changed, &mut state)?;
                scan.frame(t, &state, cameras, changed);
                progress.advance(len as u64);
            }
            let found = scan.finish();
            let mut alive = alive.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
            for (sum, count) in alive.iter_mut().zip(found.alive_per_frame) {
                *sum += count;
            }
            Ok((found.rows, found.largest_coordinate))
        })
        .collect::<Result<_>>()?;
    let mut rows = Rows::default();
    let mut largest_coordinate = 0.0f32;
    for (mut block, largest) in blocks {
        rows.append(&mut block);
        largest_coordinate = largest_coordinate.max(largest);
    }
    let alive_per_frame = alive.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner());
    Ok(Scanned { rows, alive_per_frame, largest_coordinate })
}
