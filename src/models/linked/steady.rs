//! What does not change along a track: colors, scales, rotations and opacities that differ by little from frame to frame,
//! as where lives of other colors were joined, are at every frame what they are in the mean.
//!
//! Of a track whose row at frame t has opacity αₜ and values vₜ, v̄ = Σ αₜ·vₜ / Σ αₜ, and a column is steady where the root
//! mean square of what it differs by, weighted by αₜ too, is at most a [bound](Bound): of colors over all directions,
//! √(Σₖ (vₜₖ − v̄ₖ)² / 4π) for coefficients k of the harmonics, in the channel that differs most; of scales |ln sₜ − ln s̄| on
//! the axis that differs most; of rotations 2·|qₜ − q̄| for unit quaternions of one sign; of opacities |αₜ − ᾱ| of all frames
//! alike.

use std::f64::consts::PI;
use std::ops::Range;
use std::path::Path;

use rayon::prelude::*;

use crate::cache::{Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Columns, Gaussians};

/// What may be held: positions move.
const HELD: Columns = Columns::all().difference(Columns::POSITION);
/// Tracks whose means are taken at a time, by each thread.
pub(super) const BATCH: usize = 1 << 16;

/// How little changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bound {
    /// Of colors from 0 to 1.
    pub(super) color: f64,
    /// Of natural logs of scales, of radians, and of opacities.
    pub(super) other: f64,
}

/// Which columns of which tracks are held, and as what.
pub(super) struct Steady {
    /// Of every track.
    columns: Vec<Columns>,
    /// Of every track one after the other the means of [`HELD`], plane after plane.
    means: Spill,
    sh_degree: usize,
}

/// What is held of some tracks.
pub(super) struct HeldMeans {
    columns: Vec<Columns>,
    values: Gaussians,
}

impl Steady {
    /// What changes by at most `bound` along each of `count` tracks, of those of each range that `sums` gives the sums of.
    ///
    /// # Errors
    /// Those of `sums`; a failed write to `scratch`.
    pub(super) fn from_sums(
        count: usize,
        sh_degree: usize,
        sums: impl Fn(Range<usize>) -> Result<TrackSums> + Sync,
        bound: Bound,
        scratch: &Path,
    ) -> Result<Steady> {
        let (mut columns, mut means) = (Vec::with_capacity(count), SpillWriter::new(scratch)?);
        let batches: Vec<Range<usize>> = (0..count).step_by(BATCH).map(|at| at..count.min(at + BATCH)).collect();
        for at_once in batches.chunks(rayon::current_num_threads()) {
            for sums in at_once.par_iter().cloned().map(&sums).collect::<Result<Vec<TrackSums>>>()? {
                for track in 0..sums.len() {
                    columns.push(sums.steady(track, bound));
                    means.write(bytemuck::cast_slice(&sums.means(track)))?;
                }
            }
        }
        Ok(Steady { columns, means: means.finish()?, sh_degree })
    }

    /// Parts of the tracks that hold each of their columns: colors, scales, rotations, opacities.
    pub(super) fn parts(&self) -> [f64; 4] {
        [Columns::SH, Columns::LOG_SCALE, Columns::ROTATION, Columns::OPACITY].map(|column| {
            let held = self.columns.iter().filter(|columns| columns.contains(column)).count();
            held as f64 / self.columns.len().max(1) as f64
        })
    }

    /// Whether any column of `track` is held.
    pub(super) fn holds(&self, track: u32) -> bool {
        !self.columns[track as usize].is_empty()
    }

    /// What is held of `tracks`, in their order, which is cheap where it is that of their numbers.
    ///
    /// # Errors
    /// A failed read.
    pub(super) fn means(&self, tracks: &[u32]) -> Result<HeldMeans> {
        let width = HELD.width(self.sh_degree);
        let mut values = Gaussians::zeros(tracks.len(), self.sh_degree);
        let (mut at, mut read) = (0, Vec::new());
        for following in tracks.chunk_by(|a, b| a + 1 == *b) {
            read.resize(width * following.len(), 0f32);
            self.means.read(4 * width as u64 * u64::from(following[0]), bytemuck::cast_slice_mut(&mut read))?;
            for row in read.chunks_exact(width) {
                let mut row = row.iter();
                for column in values.columns_mut(HELD) {
                    (0..column.width()).zip(&mut row).for_each(|(c, &value)| column.plane_mut(c)[at] = value);
                }
                at += 1;
            }
        }
        Ok(HeldMeans { columns: tracks.iter().map(|&track| self.columns[track as usize]).collect(), values })
    }
}

impl HeldMeans {
    /// Writes to `state` what is held, of each pair of `places` that of the first to the row of the second.
    pub(super) fn hold(&self, places: impl Iterator<Item = (usize, usize)>, state: &mut Gaussians) {
        let places: Vec<(usize, usize)> = places.filter(|&(at, _)| !self.columns[at].is_empty()).collect();
        for column in HELD.iter() {
            let held = places.iter().filter(|(at, _)| self.columns[*at].contains(column));
            let (from, to) = (self.values.column(column), state.column_mut(column));
            for c in 0..to.width() {
                let (from, to) = (from.plane(c), to.plane_mut(c));
                held.clone().for_each(|&(at, row)| to[row] = from[at]);
            }
        }
    }
}

/// Sums over the frames of some tracks, of each one after the other.
pub(super) struct TrackSums {
    sh_width: usize,
    /// Σ 1, Σ α, Σ α².
    opacity: Vec<[f64; 3]>,
    /// Σ α·v of [`HELD`].
    values: Vec<f64>,
    /// Σ α·q/|q|.
    turns: Vec<[f64; 4]>,
    /// Σ α·v² of the scales.
    scales: Vec<[f64; 3]>,
    /// Σ α·Σₖ vₖ² of the channels.
    colors: Vec<[f64; 3]>,
    /// The first quaternion, which says the sign of the others.
    first: Vec<[f32; 4]>,
}

impl TrackSums {
    /// Of `len` tracks that were not seen at any frame yet.
    pub(super) fn new(len: usize, sh_degree: usize) -> TrackSums {
        TrackSums {
            sh_width: Columns::SH.width(sh_degree),
            opacity: vec![[0.0; 3]; len],
            values: vec![0.0; HELD.width(sh_degree) * len],
            turns: vec![[0.0; 4]; len],
            scales: vec![[0.0; 3]; len],
            colors: vec![[0.0; 3]; len],
            first: vec![[0.0; 4]; len],
        }
    }

    /// Bytes of a track.
    pub(super) fn bytes(sh_degree: usize) -> u64 {
        (8 * (3 + HELD.width(sh_degree) + 4 + 3 + 3) + 16) as u64
    }

    fn len(&self) -> usize {
        self.opacity.len()
    }

    /// Adds row `at` of `state`, in which `track` is at a frame.
    pub(super) fn add(&mut self, track: usize, state: &Gaussians, at: usize) {
        let [logit] = state.opacity_logit.row(at);
        let alpha = 1.0 / (1.0 + (-f64::from(logit)).exp());
        for (sum, term) in self.opacity[track].iter_mut().zip([1.0, alpha, alpha * alpha]) {
            *sum += term;
        }
        let turn = state.rotation.row::<4>(at);
        if self.opacity[track][0] == 1.0 {
            self.first[track] = turn;
        }
        let along: f32 = turn.iter().zip(&self.first[track]).map(|(a, b)| a * b).sum();
        let turn = turn.map(|q| f64::from(if along < 0.0 { -q } else { q }));
        let length = turn.iter().map(|q| q * q).sum::<f64>().sqrt();
        for (sum, q) in self.turns[track].iter_mut().zip(turn) {
            *sum += alpha * q / length;
        }
        let width = self.values.len() / self.opacity.len();
        let values = &mut self.values[track * width..][..width];
        let (sums_of_turns, others) = values.split_at_mut(4);
        for (sum, q) in sums_of_turns.iter_mut().zip(turn) {
            *sum += alpha * q;
        }
        let (sums_of_scales, others) = others.split_at_mut(3);
        for (c, sum) in sums_of_scales.iter_mut().enumerate() {
            let value = f64::from(state.log_scale.plane(c)[at]);
            *sum += alpha * value;
            self.scales[track][c] += alpha * value * value;
        }
        others[0] += alpha * f64::from(logit);
        for (c, sum) in others[1..].iter_mut().enumerate() {
            let value = f64::from(state.sh.plane(c)[at]);
            *sum += alpha * value;
            self.colors[track][c % 3] += alpha * value * value;
        }
    }

    /// Means of [`HELD`].
    fn means(&self, track: usize) -> Vec<f32> {
        let width = self.values.len() / self.opacity.len();
        let [_, weight, _] = self.opacity[track];
        self.values[track * width..][..width].iter().map(|sum| (sum / weight) as f32).collect()
    }

    /// What changes by at most `bound`. What is not a number changes.
    fn steady(&self, track: usize, bound: Bound) -> Columns {
        let [frames, weight, squares] = self.opacity[track];
        let width = self.values.len() / self.opacity.len();
        let mean: Vec<f64> = self.values[track * width..][..width].iter().map(|sum| sum / weight).collect();
        let (scales, colors) = (&mean[4..7], &mean[width - self.sh_width..]);
        let turn = 4.0 * (1.0 - self.turns[track].iter().map(|sum| (sum / weight).powi(2)).sum::<f64>());
        let within = |variance: f64, bound: f64| variance <= bound * bound;
        let are_scales = (0..3).all(|c| within(self.scales[track][c] / weight - scales[c].powi(2), bound.other));
        let are_colors = (0..3).all(|channel| {
            let of_mean: f64 = colors.iter().skip(channel).step_by(3).map(|value| value * value).sum();
            within((self.colors[track][channel] / weight - of_mean) / (4.0 * PI), bound.color)
        });
        let mut steady = Columns::empty();
        steady.set(Columns::ROTATION, within(turn, bound.other));
        steady.set(Columns::LOG_SCALE, are_scales);
        steady.set(Columns::OPACITY, within(squares / frames - (weight / frames).powi(2), bound.other));
        steady.set(Columns::SH, are_colors);
        steady
    }
}
