//! Kinds of Gaussian that compression is known to damage: fast, thin, or changing in appearance.
//!
//! Input: the original's frames and statistics. Output: the [`KindFlags`] (membership in each kind) of every Gaussian.
//! The kinds are the failure cases of "Temporally-Aware Pruning for Compact 4D Gaussian Splatting Models", section 4.5.
//! The paper gives no thresholds; the thresholds here are this project's. Memory: where colors vary, one frame of
//! colors and 88 bytes per Gaussian; at most 190 bytes per fast Gaussian.

use rayon::prelude::*;

use crate::error::Result;
use crate::limits::Limits;
use crate::memory_plan::{ResourceEstimate, Workload};
use crate::merging::neighbors::PointIndex;
use crate::merging::tree::TreePoint;
use crate::model::{Attributes, Gaussians, SH_C0, StatisticRows, opacity};
use crate::passes::{FrameReaders, gather};
use crate::pruning::score::{SCORING_BYTES_PER_GAUSSIAN, Scored};
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan};

/// Minimum trajectory magnitude D (root mean square step from frame to frame) of a fast Gaussian, as a fraction of the
/// scene extent. It is one pixel per frame in a render that shows the scene over 500 pixels.
pub const MIN_FAST_MOTION: f64 = 2e-3;
/// Minimum non-rigid motion of a fast Gaussian. Non-rigid motion is measured by the distances to neighboring Gaussians:
/// - For one neighbor, it is the root mean square change of the distance over time, relative to the distance.
/// - For a Gaussian, it is the lower median of the values for its neighbors.
pub const MIN_NON_RIGID_CHANGE: f64 = 0.05;
/// Minimum divisor, as a fraction of the scene extent, in the relative change of the distance between two neighbors.
/// The relative change is the change of the distance, divided by max(distance, minimum). Without the minimum, small
/// invisible motions of very close neighbors would give large relative changes.
const NEAREST: f64 = 1e-3;
/// Number of nearest neighbors of a Gaussian to which distances are measured over time.
pub const NEIGHBORS: usize = 8;
/// Minimum ratio of the largest to the middle scale of a thin Gaussian.
pub const MIN_THIN_RATIO: f64 = 5.0;
/// Maximum trajectory magnitude D (root mean square step from frame to frame) of a still Gaussian, as a fraction of the
/// scene extent.
pub const MAX_STILL_MOTION: f64 = 5e-4;
/// Minimum change of opacity that counts as a change of appearance: standard deviation over the frames in which the
/// Gaussian is alive (opacity ≥ alpha_min).
pub const MIN_OPACITY_CHANGE: f64 = 0.05;
/// Minimum change of the base color that counts as a change of appearance: standard deviation over the frames in which
/// the Gaussian is alive (opacity ≥ alpha_min), root mean square over the channels, colors in [0, 1]. It is five steps
/// of 1/255.
pub const MIN_COLOR_CHANGE: f64 = 0.02;
/// Maximum number of frames at which the colors of Gaussians and the distances to their neighbors are measured. The
/// frames are evenly spaced.
pub const MAX_SAMPLED_FRAMES: usize = 24;

/// Kind of Gaussian that compression is known to damage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GaussianKind {
    /// Fast Gaussian that moves differently from its neighbors.
    Motion,
    /// Thin Gaussian, much longer than wide: the largest scale is at least [`MIN_THIN_RATIO`] times the middle one.
    Thin,
    /// Gaussian that hardly moves, but changes its opacity or color.
    Appearance,
}

impl GaussianKind {
    /// Every kind of Gaussian, in the order of the paper. Arrays with a value per kind have this order.
    pub const ALL: [GaussianKind; 3] = [GaussianKind::Motion, GaussianKind::Thin, GaussianKind::Appearance];
}

/// Returns the resource estimate (memory, time, reads) of [`kind_flags`].
pub fn resource_estimate(work: &Workload) -> ResourceEstimate {
    let per_gaussian = vec![
        ("statistics", SCORING_BYTES_PER_GAUSSIAN),
        ("states", work.state_bytes(Attributes::POSITION | Attributes::LOG_SCALE)),
        ("colors", 88 + work.state_bytes(Attributes::SH | Attributes::OPACITY)),
        ("neighbors", 190),
        ("readers", work.input.reader),
        ("kept frames", work.kept_frames_bytes(&Limits::NONE, Attributes::SH | Attributes::OPACITY)),
    ];
    let frames = MAX_SAMPLED_FRAMES.min(work.frames as usize) as u64;
    let reads = work.scattered_whole_input_reads(1, &Limits::NONE)
        + 2.0 * work.scattered_whole_input_reads(frames, &Limits::NONE);
    let seconds = 2e-5 * work.gaussian_count() + work.reading_seconds(work.gaussian_count(), 2.0 * frames as f64);
    ResourceEstimate { stage: "traits", reads, seconds, per_gaussian, fixed: vec![work.block_buffer_memory()] }
}

/// Kinds to which one Gaussian belongs: one flag per kind, in the order of [`GaussianKind::ALL`].
pub type KindFlags = [bool; 3];

/// Returns for every Gaussian the [`GaussianKind`]s to which it belongs, as one flag per kind. A Gaussian that is never
/// visible belongs to none. `scored` has the statistics of the Gaussians. The change of a Gaussian's color is measured
/// over the frames at which it is alive: its opacity is at least `alpha_min`.
///
/// # Errors
/// Fails if a frame cannot be read.
pub fn kind_flags(source: &dyn FrameSource, scored: &Scored, alpha_min: f64) -> Result<Vec<KindFlags>> {
    let (rows, extent) = (scored.rows()?, scored.reference.extent);
    let mut flags = vec![[false; 3]; rows.len()];
    let frames = samples(source.info().times.len());
    if rows.is_empty() || frames.is_empty() {
        return Ok(flags);
    }
    let visible = |i: usize| rows.life[i] > 0 && rows.c[i] > 0.0;
    let all_ids: Vec<u32> = (0..rows.len() as u32).collect();
    let reference = gather(source, &all_ids, scored.reference.frame, Attributes::POSITION | Attributes::LOG_SCALE)?;
    let fast: Vec<u32> = all_ids
        .iter()
        .copied()
        .filter(|&i| visible(i as usize) && rows.d[i as usize] >= MIN_FAST_MOTION * extent)
        .collect();
    for (&id, bent) in fast.iter().zip(non_rigid_motion(source, &reference, &fast, visible, &frames, NEAREST * extent)?)
    {
        flags[id as usize][GaussianKind::Motion as usize] = bent >= MIN_NON_RIGID_CHANGE;
    }
    let recolored = color_change(source, &all_ids, &frames, alpha_min)?;
    for i in (0..rows.len()).filter(|&i| visible(i)) {
        flags[i][GaussianKind::Thin as usize] = is_thin(reference.log_scale.row(i));
        flags[i][GaussianKind::Appearance as usize] = rows.d[i] <= MAX_STILL_MOTION * extent
            && (rows.v[i].sqrt() >= MIN_OPACITY_CHANGE || recolored.get(i).is_some_and(|&c| c >= MIN_COLOR_CHANGE));
    }
    Ok(flags)
}

/// Returns two fractions for each kind of Gaussian (fast, thin, changing in appearance), in this order:
/// - the contribution of the kind to renders, divided by the contribution of all Gaussians
/// - the contribution of the Gaussians of this kind for which `is_lost` is true, divided by the contribution of the
///   kind
///
/// `kinds` states for every Gaussian whether it belongs to each kind. The argument of `is_lost` is the index of a
/// Gaussian.
pub fn contribution_shares(
    rows: &StatisticRows,
    kinds: &[KindFlags],
    is_lost: impl Fn(usize) -> bool,
) -> [(f64, f64); 3] {
    // `sum` of nothing is −0, which would be displayed.
    let total: f64 = rows.c.iter().fold(0.0, |sum, c| sum + c);
    std::array::from_fn(|kind| {
        let of = |wanted: &dyn Fn(usize) -> bool| -> f64 {
            (0..rows.len()).filter(|&i| kinds[i][kind] && wanted(i)).fold(0.0, |sum, i| sum + rows.c[i])
        };
        let own = of(&|_| true);
        let part = |of: f64, whole: f64| if whole > 0.0 { of / whole } else { 0.0 };
        (part(own, total), part(of(&is_lost), own))
    })
}

fn is_thin(mut log_scale: [f32; 3]) -> bool {
    log_scale.sort_unstable_by(f32::total_cmp);
    f64::from(log_scale[2]) - f64::from(log_scale[1]) >= MIN_THIN_RATIO.ln()
}

/// Returns at most [`MAX_SAMPLED_FRAMES`] of the indices from 0 to `frames` − 1, evenly spaced from first to last.
fn samples(frames: usize) -> Vec<usize> {
    let count = frames.min(MAX_SAMPLED_FRAMES);
    (0..count).map(|k| if count < 2 { 0 } else { k * (frames - 1) / (count - 1) }).collect()
}

/// Returns for each of the Gaussians `ids` how much it moves relative to its neighbors, as one number. A rigid motion,
/// rotations included, gives 0.
///
/// - The neighbors are the nearest visible Gaussians at the reference frame.
/// - For each neighbor, the root mean square change of its distance over the frames `frames` is divided by the distance
///   at the reference frame or by `nearest` (scene units), whichever is larger.
/// - The result is the lower median of these relative changes over the neighbors. So a few neighbors that belong to
///   another object have no effect.
fn non_rigid_motion(
    source: &dyn FrameSource,
    reference: &Gaussians,
    ids: &[u32],
    visible: impl Fn(usize) -> bool,
    frames: &[usize],
    nearest: f64,
) -> Result<Vec<f64>> {
    if ids.is_empty() {
        return Ok(Vec::new());
    }
    let point = |i: usize| TreePoint { position: reference.position.row(i), index: i as u32 };
    let index = PointIndex::new((0..reference.len()).filter(|&i| visible(i)).map(point).collect(), f64::INFINITY);
    let near: Vec<Vec<u32>> = ids
        .par_iter()
        .map_init(
            || index.search(),
            |search, &id| search.nearest(id, reference.position.row(id as usize), NEIGHBORS).0.collect(),
        )
        .collect();
    let mut followed: Vec<u32> = near.iter().flatten().chain(ids).copied().collect();
    followed.sort_unstable();
    followed.dedup();
    let place = |id: u32| followed.binary_search(&id).unwrap_or_default();
    let pairs: Vec<(usize, Vec<usize>)> =
        ids.iter().zip(&near).map(|(&id, near)| (place(id), near.iter().map(|&j| place(j)).collect())).collect();
    let start = reference.position.pick(&followed);
    let mut sums: Vec<Vec<f64>> = near.iter().map(|near| vec![0.0; near.len()]).collect();
    let distance = |p: &crate::model::AttributeValues, i: usize, j: usize| -> f64 {
        let (a, b) = (p.row::<3>(i), p.row::<3>(j));
        (0..3).map(|c| (f64::from(a[c]) - f64::from(b[c])).powi(2)).sum::<f64>().sqrt()
    };
    let mut reader =
        FrameReaders::open(source, Ids::List(&followed), Attributes::POSITION, &ReadPlan::new(frames.to_vec()))?;
    let mut state = reader.state_buffer();
    for &frame in frames {
        reader.read(frame, Attributes::POSITION, &mut state)?;
        let now = &state.position;
        sums.par_iter_mut().zip(&pairs).for_each(|(sums, (i, near))| {
            for (sum, &j) in sums.iter_mut().zip(near) {
                let before = distance(&start, *i, j);
                *sum += ((distance(now, *i, j) - before) / before.max(nearest)).powi(2);
            }
        });
    }
    Ok(sums
        .into_iter()
        .map(|mut sums| {
            sums.sort_unstable_by(f64::total_cmp);
            let median = sums.get(sums.len().saturating_sub(1) / 2).copied().unwrap_or(0.0);
            (median / frames.len() as f64).sqrt()
        })
        .collect())
}

/// Returns how much the base color of each of the Gaussians with the ids `ids` changes over time: its standard
/// deviation, root mean square over the channels, with colors in [0, 1]. Of the frames `frames`, only those at which
/// the Gaussian is alive (opacity at least `alpha_min`) count. Returns an empty list if colors do not vary.
fn color_change(source: &dyn FrameSource, ids: &[u32], frames: &[usize], alpha_min: f64) -> Result<Vec<f64>> {
    if !source.info().varying.contains(Attributes::SH) {
        return Ok(Vec::new());
    }
    // Differences from the first color: sums of small numbers lose no digits.
    let mut first: Vec<Option<[f64; 3]>> = vec![None; ids.len()];
    let mut sums = vec![(0u32, [0.0f64; 3], [0.0f64; 3]); ids.len()];
    let columns = Attributes::SH | Attributes::OPACITY;
    let mut reader = FrameReaders::open(source, Ids::List(ids), columns, &ReadPlan::new(frames.to_vec()))?;
    let mut state = reader.state_buffer();
    for &frame in frames {
        reader.read(frame, columns, &mut state)?;
        for (i, (n, sum, squares)) in sums.iter_mut().enumerate() {
            if opacity(state.opacity_logit.row::<1>(i)[0]) < alpha_min {
                continue;
            }
            let color = state.sh.row::<3>(i).map(|c| SH_C0 * f64::from(c));
            let start = first[i].get_or_insert(color);
            *n += 1;
            for c in 0..3 {
                let away = color[c] - start[c];
                sum[c] += away;
                squares[c] += away * away;
            }
        }
    }
    let deviation = |&(n, sum, squares): &(u32, [f64; 3], [f64; 3])| {
        let n = f64::from(n.max(1));
        let variance = |c: usize| (squares[c] / n - (sum[c] / n).powi(2)).max(0.0);
        ((0..3).map(variance).sum::<f64>() / 3.0).sqrt()
    };
    Ok(sums.iter().map(deviation).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::SequenceInfo;
    use crate::source::{BlockReader, Ids};

    /// Frame source for tests, made of a function that sets the attributes of a Gaussian at a frame.
    struct Made<F>(SequenceInfo, F);

    impl<F: Fn(usize, usize, &mut Gaussians, usize) + Sync + Send> FrameSource for Made<F> {
        fn info(&self) -> &SequenceInfo {
            &self.0
        }
        fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
            Ok(Box::new(Reader(ids.iter().collect(), &self.1)))
        }
    }

    struct Reader<'a, F>(Vec<usize>, &'a F);

    impl<F: Fn(usize, usize, &mut Gaussians, usize) + Sync> BlockReader for Reader<'_, F> {
        fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
            let mut all = Gaussians::zeros(self.0.len(), 0);
            for (row, &id) in self.0.iter().enumerate() {
                (self.1)(id, frame, &mut all, row);
            }
            want.iter().for_each(|column| *out.attribute_values_mut(column) = all.attribute_values(column).clone());
            Ok(())
        }
    }

    fn info(count: usize, frames: usize) -> SequenceInfo {
        SequenceInfo { count, times: (0..frames).map(|t| t as f64).collect(), sh_degree: 0, varying: Attributes::all() }
    }

    /// Returns the non-rigid motion ([`non_rigid_motion`]) of each point of a moving lattice of 5 × 5 × 5 points.
    /// `place` returns the position of a lattice point at a time from 0 to 1.
    fn bent(place: impl Fn([f64; 3], f64) -> [f64; 3] + Sync + Send) -> Vec<f64> {
        let source = Made(info(125, 10), |id, frame, out: &mut Gaussians, row| {
            let at = [id % 5, id / 5 % 5, id / 25].map(|k| k as f64);
            out.position.set_row(row, place(at, frame as f64 / 9.0).map(|x| x as f32));
        });
        let all: Vec<u32> = (0..125).collect();
        let reference = gather(&source, &all, 0, Attributes::POSITION).unwrap();
        non_rigid_motion(&source, &reference, &all, |_| true, &samples(10), 1e-3).unwrap()
    }

    #[test]
    fn rigid_motion_gives_0_and_stretching_its_relative_change() {
        let turned = bent(|[x, y, z], t| {
            let (sin, cos) = (3.0 * t).sin_cos();
            [x * cos - y * sin + 40.0 * t, x * sin + y * cos, z - 7.0 * t]
        });
        assert!(turned.iter().all(|&bent| bent < 1e-5), "got {turned:?}");
        // Every distance grows evenly by 40%.
        let grown = bent(|at, t| at.map(|x| x * (1.0 + 0.4 * t)));
        let expected = 0.4 * ((0..10).map(|k| f64::from(k * k) / 81.0).sum::<f64>() / 10.0).sqrt();
        assert!(grown.iter().all(|&bent| (bent - expected).abs() < 1e-5), "got {grown:?}, expected {expected}");
    }

    #[test]
    fn color_changes_count_only_while_a_gaussian_is_alive() {
        // 0 flashes, 1 is constant, 2 flashes only while dead.
        let source = Made(info(3, 8), |id, frame, out: &mut Gaussians, row| {
            let flash = frame % 2 == 1;
            let dead = id == 2 && flash;
            out.opacity_logit.set_row(row, [if dead { -9.0 } else { 2.0 }]);
            let away = if flash && id != 1 { 0.1 } else { 0.0 };
            out.sh.set_row(row, [((0.2 + away) / SH_C0) as f32; 3]);
        });
        let found = color_change(&source, &[0, 1, 2], &samples(8), 0.01).unwrap();
        assert!((found[0] - 0.05).abs() < 1e-6, "half of the time 0.1 away: got {}", found[0]);
        assert_eq!(found[1..], [0.0, 0.0]);
        let still = Made(SequenceInfo { varying: Attributes::POSITION, ..info(3, 8) }, source.1);
        assert!(color_change(&still, &[0, 1, 2], &samples(8), 0.01).unwrap().is_empty(), "nothing is read");
    }

    #[test]
    fn samples_reach_from_the_first_frame_to_the_last() {
        assert_eq!(samples(0), [0usize; 0]);
        assert_eq!(samples(1), [0]);
        assert_eq!(samples(3), [0, 1, 2]);
        let many = samples(1000);
        assert_eq!((many.len(), many[0], many[MAX_SAMPLED_FRAMES - 1]), (MAX_SAMPLED_FRAMES, 0, 999));
        assert!(many.windows(2).all(|pair| pair[0] < pair[1]));
    }
}
