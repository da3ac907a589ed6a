//! Scan of one block of Gaussians through all frames: accumulates every statistic, and computes rows of statistics from
//! the sums.

use std::mem::size_of;

use super::life::LifeSpans;
use super::motion::MotionSums;
use super::plan::{PAIRS_PER_CARRY, ScanPlan};
use super::projection::{CoverageScale, CoverageSums, FootprintPlanes, project};
use super::state::{BlockState, CHUNK};
use crate::model::{AnomalyFlags, Attributes, Camera, Gaussians, StatisticRows, vectorized};

/// Bytes of memory that a [`BlockScan`] takes per Gaussian, independent of the number of frames.
pub const BYTES_PER_GAUSSIAN: usize = BlockState::BYTES_PER_GAUSSIAN
    + LifeSpans::BYTES_PER_GAUSSIAN
    + MotionSums::BYTES_PER_GAUSSIAN
    + size_of::<u64>()
    + 2 * size_of::<u32>();

/// Opacity (2⁻⁵³) below which a Gaussian adds nothing to a sum of contributions: its contribution to a view, at most
/// 2⁵¹ fixed-point units times the opacity, rounds to 0.
const NEGLIGIBLE_OPACITY: f64 = 0.5 * f64::EPSILON;

/// Number of low bits that remain in a sum of contributions when its high bits are moved to a separate u32. After 2³²
/// contributions of at most 2⁵¹, the sum has 31 bits above its low bits, which fit into the u32.
const CARRY_BITS: u32 = 52;

/// Attributes that a scan needs of every model; SH coefficients may be omitted.
pub const NEEDED_ATTRIBUTES: Attributes = Attributes::all().difference(Attributes::SH);

/// Returns the attributes to read at frame `frame`: all of them at frame 0, and only the `varying` ones after it.
pub(super) fn attributes_to_read(frame: usize, varying: Attributes) -> Attributes {
    if frame == 0 { Attributes::all() } else { varying }
}

/// Statistics of a block of consecutive Gaussians over the frames added so far.
pub struct BlockScan<'a> {
    plan: &'a ScanPlan,
    first_id: usize,
    next_frame: usize,
    /// Whether the opacities of all frames so far equal those of the first frame.
    steady: bool,
    state: BlockState,
    life: LifeSpans,
    motion: MotionSums,
    /// Low part of the sum of covered pixels times opacity, in fixed point, for each Gaussian. The whole sum is
    /// `carried` · 2^[`CARRY_BITS`] + `coverage`.
    coverage: Vec<u64>,
    carried: Vec<u32>,
    /// Number of (frame, view) pairs added to `coverage` since its high bits were last moved to `carried`.
    uncarried: usize,
    touched: Vec<u32>,
    alive_per_frame: Vec<u32>,
}

/// Statistics of a block of Gaussians after its last frame.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockStatistics {
    /// Id of the block's first Gaussian.
    pub first_id: usize,
    /// Statistics, one row per Gaussian. The anisotropy `e` is 0 until [`super::fill_anisotropy`]; the trajectory
    /// magnitude D and the curvature κ include rounding noise until [`super::snap_noise_to_zero`]. All statistics of a
    /// Gaussian with [`AnomalyFlags::NON_FINITE`] are 0.
    pub rows: StatisticRows,
    /// Number of the block's Gaussians alive (opacity ≥ alpha_min) in each frame, for the frames that
    /// [`BlockScan::take_alive_counts`] has not returned. Gaussians with NaN values are included.
    pub alive_per_frame: Vec<u32>,
    /// Largest finite |coordinate| of a position in the block, scene units.
    pub largest_coordinate: f32,
}

impl<'a> BlockScan<'a> {
    /// Creates the running statistics, without frames yet, of the Gaussians with the ids `first_id .. first_id + len`.
    /// `plan`: parameters of the scan.
    pub fn new(len: usize, first_id: usize, plan: &'a ScanPlan) -> Self {
        BlockScan {
            plan,
            first_id,
            next_frame: 0,
            steady: true,
            state: BlockState::new(len),
            life: LifeSpans::new(len),
            motion: MotionSums::new(len, plan.motion),
            coverage: vec![0; len],
            carried: vec![0; len],
            uncarried: 0,
            touched: vec![0; len],
            alive_per_frame: Vec::with_capacity(plan.frames),
        }
    }

    /// Adds frame `t`, in which the block has the attributes `gaussians` and is seen by `cameras`. `changed` names the
    /// attributes that may differ from the previous frame; in frame 0 all attributes but SH count as changed. SH is
    /// only checked for non-finite values, and only if `changed` contains it.
    ///
    /// # Panics
    /// Panics if frames are not added in order, or if an attribute does not have one value for each Gaussian of the
    /// block.
    pub fn add_frame(&mut self, t: usize, gaussians: &Gaussians, cameras: &[&Camera], changed: Attributes) {
        assert_eq!(t, self.next_frame, "frames are scanned in order");
        self.next_frame += 1;
        let changed = if t == 0 { changed | NEEDED_ATTRIBUTES } else { changed };
        self.advance(t, gaussians, changed);
        for cameras in cameras.chunks(PAIRS_PER_CARRY) {
            if self.uncarried + cameras.len() > PAIRS_PER_CARRY {
                self.carry();
            }
            self.uncarried += cameras.len();
            self.project(gaussians, cameras);
        }
    }

    /// Moves the high bits of the sums `coverage` to `carried`, so that [`PAIRS_PER_CARRY`] more contributions fit.
    fn carry(&mut self) {
        for (coverage, carried) in self.coverage.iter_mut().zip(&mut self.carried) {
            *carried += (*coverage >> CARRY_BITS) as u32;
            *coverage &= (1 << CARRY_BITS) - 1;
        }
        self.uncarried = 0;
    }

    /// Returns how many of the block's Gaussians are alive (opacity ≥ alpha_min) in each frame added since the last
    /// call, and forgets these numbers.
    pub fn take_alive_counts(&mut self) -> Vec<u32> {
        std::mem::take(&mut self.alive_per_frame)
    }

    fn advance(&mut self, t: usize, gaussians: &Gaussians, changed: Attributes) {
        vectorized(
            #[inline(always)]
            || self.advance_inlined(t, gaussians, changed),
        );
    }

    /// Adds the Gaussians of frame `t` to the parts of the scan that need no cameras: current state, life spans,
    /// numbers of alive Gaussians, and motion sums. `changed` names the attributes of `gaussians` that may differ from
    /// the previous frame. Inlined, so that [`vectorized`] compiles it for vector instructions.
    #[inline(always)]
    fn advance_inlined(&mut self, t: usize, gaussians: &Gaussians, changed: Attributes) {
        self.state.update(gaussians, changed);
        let alpha_min = self.plan.alpha_min;
        // The opacities of all frames are compared with those of frame 0, which are new even if `changed` omits them.
        self.steady &= t == 0 || !changed.contains(Attributes::OPACITY);
        let repeats = t > 0 && self.steady;
        let opacity = &self.state.opacity;
        let alive = if repeats { self.life.repeat_frame() } else { self.life.add_frame(opacity, alpha_min) };
        self.alive_per_frame.push(alive);
        let steps = [self.plan.step(t), self.plan.step(t.saturating_sub(1))];
        self.motion.add_frame(&gaussians.position, opacity, alpha_min, steps, repeats);
    }

    fn project(&mut self, gaussians: &Gaussians, cameras: &[&Camera]) {
        let scale = CoverageScale { exponent: self.plan.coverage_exponent, alpha_min: self.plan.alpha_min };
        let len = self.coverage.len();
        for start in (0..len).step_by(CHUNK) {
            let range = start..len.min(start + CHUNK);
            let opacity = &self.state.opacity[range.clone()];
            if opacity.iter().all(|&opacity| opacity < scale.alpha_min.min(NEGLIGIBLE_OPACITY)) {
                continue;
            }
            self.state.update_axes(gaussians, range.clone());
            let from = FootprintPlanes {
                position: std::array::from_fn(|axis| &gaussians.position.plane(axis)[range.clone()]),
                axes: std::array::from_fn(|plane| &self.state.axes[plane][range.clone()]),
                opacity: &self.state.opacity[range.clone()],
            };
            let mut sums =
                CoverageSums { coverage: &mut self.coverage[range.clone()], touched: &mut self.touched[range] };
            for camera in cameras {
                project(camera, &from, scale, &mut sums);
            }
        }
    }

    #[cfg(test)]
    pub(super) fn resident_bytes(&self) -> usize {
        let sums = size_of_val(&self.coverage[..]) + size_of_val(&self.carried[..]) + size_of_val(&self.touched[..]);
        self.state.resident_bytes() + self.life.resident_bytes() + self.motion.resident_bytes() + sums
    }

    /// Ends the scan after the last frame, and returns the statistics of every Gaussian of the block.
    pub fn finish(self) -> BlockStatistics {
        let plan = self.plan;
        self.finish_with_plan(plan)
    }

    /// Ends a scan that began before all frames were known, and returns the statistics of every Gaussian of the block.
    /// `plan` is the plan for the complete sequence.
    ///
    /// # Panics
    /// Panics if frames are missing, or if `plan` does not belong to this scan: only the number of frames and of
    /// (frame, view) pairs may differ from the plan with which the scan began.
    pub fn finish_with_plan(mut self, plan: &ScanPlan) -> BlockStatistics {
        self.life.count_repeats();
        self.motion.count_steady_frames();
        assert_eq!(self.next_frame, plan.frames, "every frame is scanned");
        assert!(
            std::ptr::eq(plan, self.plan) || plan.fits_scan_begun_with(self.plan),
            "the plan is that of another scan"
        );
        let pairs = f64::from(plan.pair_count.max(1));
        let resolution = plan.coverage_resolution_px();
        let sum = |(&coverage, &carried): (&u64, &u32)| (u128::from(carried) << CARRY_BITS) + u128::from(coverage);
        let life = self.life.frames();
        let mut rows = StatisticRows {
            d: self.motion.magnitude(life),
            kappa: self.motion.curvature(life),
            v: self.life.variance(),
            life: life.to_vec(),
            c: self.coverage.iter().zip(&self.carried).map(sum).map(|sum| sum as f64 * resolution / pairs).collect(),
            w: Vec::new(),
            e: vec![0.0; life.len()],
            vis: self.touched.iter().map(|&count| f64::from(count) / pairs).collect(),
            flags: self.state.flags,
        };
        clear_non_finite(&mut rows);
        BlockStatistics {
            first_id: self.first_id,
            rows,
            alive_per_frame: self.alive_per_frame,
            largest_coordinate: self.state.largest_coordinate,
        }
    }
}

fn clear_non_finite(rows: &mut StatisticRows) {
    for i in 0..rows.len() {
        if rows.flags[i].contains(AnomalyFlags::NON_FINITE) {
            rows.clear(i);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::ViewSchedule;
    use crate::model::hash_id;
    use crate::recipe::{MotionParams, Recipe, ScanParams};

    fn random(k: usize) -> f32 {
        (hash_id(k as u64) >> 40) as f32 / (1 << 24) as f32
    }

    /// Returns a frame that has the positions of frame `t` and the opacities of frame `opacity_frame`.
    fn test_frame(t: usize, opacity_frame: usize) -> Gaussians {
        let mut frame = Gaussians::zeros(77, 0);
        for (column, t) in [(Attributes::POSITION, t), (Attributes::OPACITY, opacity_frame), (Attributes::ROTATION, 0)]
        {
            for (i, x) in frame.attribute_values_mut(column).planes_mut().iter_mut().enumerate() {
                // About half of the opacities are below 1/255.
                *x = 10.0 * random(1000 * t + i) - if column == Attributes::OPACITY { 10.5 } else { 7.0 };
            }
        }
        frame
    }

    #[test]
    fn unchanged_opacities_may_be_omitted_from_changed() {
        for motion in [MotionParams::Literal, MotionParams::Runs] {
            let scan = ScanParams { motion, ..Recipe::preset("default").unwrap().scan };
            // For each frame, the number of the frame whose opacities it has: always those of frame 0; changed late,
            // then steady again; changed from frame 1 on; a single frame.
            let opacity_frames: [&[usize]; 4] = [&[0; 7], &[0, 0, 0, 3, 3, 3, 6], &[0, 1, 1, 1], &[0]];
            for opacities in opacity_frames {
                let times: Vec<f64> = (0..opacities.len()).map(|t| t as f64 + f64::from(t > 4)).collect();
                let mut schedule = ViewSchedule::default();
                schedule.push_frames(times.len(), &[]);
                let plan = ScanPlan::new(&scan, &times, &schedule).unwrap();
                let [mut all, mut named] = [BlockScan::new(77, 0, &plan), BlockScan::new(77, 0, &plan)];
                for (t, &opacity_frame) in opacities.iter().enumerate() {
                    let frame = test_frame(t, opacity_frame);
                    let changed = t > 0 && opacity_frame != opacities[t - 1];
                    all.add_frame(t, &frame, &[], NEEDED_ATTRIBUTES);
                    let opacity = if changed { Attributes::OPACITY } else { Attributes::empty() };
                    named.add_frame(t, &frame, &[], Attributes::POSITION | opacity);
                }
                let (all, named) = (all.finish(), named.finish());
                let living = all.rows.life.iter().filter(|&&life| life > 0).count();
                assert!((9..77).contains(&living), "some must live and some not, {living} do");
                assert_eq!(all, named, "{motion:?}, {opacities:?}");
            }
        }
    }

    #[test]
    fn vector_instructions_give_the_bits_of_the_baseline() {
        const LEN: usize = 77;
        for motion in [MotionParams::Literal, MotionParams::Runs] {
            for times in [[0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 1.5, 4.0, 4.5]] {
                let scan = ScanParams { motion, ..Recipe::preset("default").unwrap().scan };
                let mut schedule = ViewSchedule::default();
                schedule.push_frames(times.len(), &[]);
                let plan = ScanPlan::new(&scan, &times, &schedule).unwrap();
                let [mut wide, mut baseline] = [BlockScan::new(LEN, 0, &plan), BlockScan::new(LEN, 0, &plan)];
                for t in 0..times.len() {
                    let mut frame = Gaussians::zeros(LEN, 0);
                    for column in NEEDED_ATTRIBUTES.iter() {
                        for (i, x) in frame.attribute_values_mut(column).planes_mut().iter_mut().enumerate() {
                            *x = 10.0 * random(1000 * t + i) - 7.0;
                        }
                    }
                    frame.position.set_row(t, [f32::NAN, f32::INFINITY, -3.0]);
                    wide.advance(t, &frame, NEEDED_ATTRIBUTES);
                    baseline.advance_inlined(t, &frame, NEEDED_ATTRIBUTES);
                    wide.next_frame += 1;
                    baseline.next_frame += 1;
                }
                let (wide, baseline) = (wide.finish(), baseline.finish());
                assert!(baseline.rows.kappa.iter().filter(|&&kappa| kappa > 0.0).count() > 9, "the case must move");
                assert_eq!(wide, baseline);
            }
        }
    }
}
