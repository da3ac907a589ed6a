//! Attributes that hardly change along a track (Gaussian followed through frames). Colors, scales, rotations and
//! opacities that differ little from frame to frame, as in joined tracks of slightly different colors, are replaced by
//! their mean in every frame.
//!
//! For a track that at frame t has the opacity αₜ and the values vₜ of an attribute, the mean is v̄ = Σ αₜ·vₜ / Σ αₜ.
//! An attribute is steady if its root mean square deviation, weighted by αₜ, is at most a [bound](Bound). Deviations
//! are:
//!
//! - color over all directions: √(Σₖ (vₜₖ − v̄ₖ)² / 4π) for SH coefficients k, in the channel with the largest
//!   deviation;
//! - scale: |ln sₜ − ln s̄| on the axis with the largest deviation;
//! - rotation: 2·|qₜ − q̄| for unit quaternions of one sign;
//! - opacity: |αₜ − ᾱ|, with all frames weighted equally.

use std::f64::consts::PI;
use std::ops::Range;
use std::path::Path;

use rayon::prelude::*;

use crate::cache::{Spill, SpillWriter};
use crate::error::Result;
use crate::model::{Attributes, Gaussians};

/// Attributes that may become constant along a track (Gaussian followed through frames). Positions always vary.
const STEADY_COLUMNS: Attributes = Attributes::all().difference(Attributes::POSITION);
/// Maximum number of tracks (Gaussians followed through frames) whose means a thread computes together.
pub(super) const BATCH: usize = 1 << 16;

/// Maximum root mean square deviation from the mean, along a track (Gaussian followed through frames), of an attribute
/// that becomes constant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bound {
    /// Maximum deviation of colors from their mean along the track, as a difference between color values from 0 to 1.
    pub(super) color: f64,
    /// Maximum deviation from the mean along the track of the natural logarithms of scales, of rotations in radians,
    /// and of opacities.
    pub(super) other: f64,
}

/// For each track (Gaussian followed through frames) the attributes that are constant, and their values.
pub(super) struct Steady {
    /// Attributes that are constant along each track (Gaussian followed through frames), by index of the track.
    columns: Vec<Attributes>,
    /// Means of the attributes [`STEADY_COLUMNS`] over all frames, for every track (Gaussian followed through frames)
    /// in order, component by component.
    means: Spill,
    sh_degree: usize,
}

/// Attributes that are constant along some tracks (Gaussians followed through frames), and their values.
pub(super) struct HeldMeans {
    columns: Vec<Attributes>,
    values: Gaussians,
}

impl Steady {
    /// Finds, for each of `count` tracks (Gaussians followed through frames), the attributes whose root mean square
    /// deviation from their mean over the frames is at most `bound`. `sums` returns the [`TrackSums`] over all frames
    /// for a range of tracks.
    ///
    /// # Errors
    /// Fails if `sums` fails or a write to the folder `scratch` fails.
    pub(super) fn from_sums(
        count: usize,
        sh_degree: usize,
        sums: impl Fn(Range<usize>) -> Result<TrackSums> + Sync,
        bound: Bound,
        scratch: &Path,
    ) -> Result<Steady> {
        let (mut columns, mut means) = (Vec::with_capacity(count), SpillWriter::new(scratch)?);
        let batches: Vec<Range<usize>> = (0..count).step_by(BATCH).map(|at| at..count.min(at + BATCH)).collect();
        for batch in batches.chunks(rayon::current_num_threads()) {
            for sums in batch.par_iter().cloned().map(&sums).collect::<Result<Vec<TrackSums>>>()? {
                for track in 0..sums.len() {
                    columns.push(sums.steady(track, bound));
                    means.write(bytemuck::cast_slice(&sums.means(track)))?;
                }
            }
        }
        Ok(Steady { columns, means: means.finish()?, sh_degree })
    }

    /// Returns the fraction of all tracks (Gaussians followed through frames) whose colors are constant, then the
    /// fractions of tracks with constant scales, with constant rotations and with constant opacities.
    pub(super) fn fractions(&self) -> [f64; 4] {
        [Attributes::SH, Attributes::LOG_SCALE, Attributes::ROTATION, Attributes::OPACITY].map(|column| {
            let held = self.columns.iter().filter(|columns| columns.contains(column)).count();
            held as f64 / self.columns.len().max(1) as f64
        })
    }

    /// Returns whether any attribute of the track with index `track` (Gaussian followed through frames) is constant.
    pub(super) fn has_steady(&self, track: u32) -> bool {
        !self.columns[track as usize].is_empty()
    }

    /// Returns which attributes are constant along each of `tracks` (indices of Gaussians followed through frames), and
    /// the values of these attributes, in the order of `tracks`. Fast if the indices increase.
    ///
    /// # Errors
    /// Fails if a read of the means fails.
    pub(super) fn means(&self, tracks: &[u32]) -> Result<HeldMeans> {
        let width = STEADY_COLUMNS.width(self.sh_degree);
        let mut values = Gaussians::zeros(tracks.len(), self.sh_degree);
        let (mut at, mut read) = (0, Vec::new());
        for following in tracks.chunk_by(|a, b| a + 1 == *b) {
            read.resize(width * following.len(), 0f32);
            self.means.read(4 * width as u64 * u64::from(following[0]), bytemuck::cast_slice_mut(&mut read))?;
            for row in read.chunks_exact(width) {
                let mut row = row.iter();
                for column in values.selected_attribute_values_mut(STEADY_COLUMNS) {
                    (0..column.width()).zip(&mut row).for_each(|(c, &value)| column.plane_mut(c)[at] = value);
                }
                at += 1;
            }
        }
        Ok(HeldMeans { columns: tracks.iter().map(|&track| self.columns[track as usize]).collect(), values })
    }
}

impl HeldMeans {
    /// Writes the values of constant attributes to rows of `state`. A pair (i, row) of `places` states that this row of
    /// `state` holds the track (Gaussian followed through frames) at index i of the list that was given to
    /// [`Steady::means`].
    pub(super) fn write_to(&self, places: impl Iterator<Item = (usize, usize)>, state: &mut Gaussians) {
        let places: Vec<(usize, usize)> = places.filter(|&(at, _)| !self.columns[at].is_empty()).collect();
        for column in STEADY_COLUMNS.iter() {
            let held = places.iter().filter(|(at, _)| self.columns[*at].contains(column));
            let (from, to) = (self.values.attribute_values(column), state.attribute_values_mut(column));
            for c in 0..to.width() {
                let (from, to) = (from.plane(c), to.plane_mut(c));
                held.clone().for_each(|&(at, row)| to[row] = from[at]);
            }
        }
    }
}

/// Sums over frames for some tracks (Gaussians followed through frames), by index of the track. α is the opacity at a
/// frame.
pub(super) struct TrackSums {
    sh_width: usize,
    /// For each track (Gaussian followed through frames) its number of frames, the sum over these frames of the opacity
    /// α, and the sum of α².
    opacity: Vec<[f64; 3]>,
    /// For each track (Gaussian followed through frames) and each component v of the attributes [`STEADY_COLUMNS`]: sum
    /// over frames of α·v, where α is the opacity.
    values: Vec<f64>,
    /// For each track (Gaussian followed through frames): sum over frames of α·q/|q|, where α is the opacity and q the
    /// quaternion.
    rotations: Vec<[f64; 4]>,
    /// For each track (Gaussian followed through frames): sum over frames of α·v² for the three log scales v, where α
    /// is the opacity.
    scales: Vec<[f64; 3]>,
    /// For each track (Gaussian followed through frames) and color channel: sum over frames of α·Σₖ vₖ², where α is the
    /// opacity and vₖ are the SH coefficients.
    colors: Vec<[f64; 3]>,
    /// First quaternion of each track (Gaussian followed through frames). A later quaternion q is replaced by −q if −q
    /// is nearer to the first one.
    first: Vec<[f32; 4]>,
}

impl TrackSums {
    /// Creates sums for `len` tracks (Gaussians followed through frames); no frame has been added yet.
    pub(super) fn new(len: usize, sh_degree: usize) -> TrackSums {
        TrackSums {
            sh_width: Attributes::SH.width(sh_degree),
            opacity: vec![[0.0; 3]; len],
            values: vec![0.0; STEADY_COLUMNS.width(sh_degree) * len],
            rotations: vec![[0.0; 4]; len],
            scales: vec![[0.0; 3]; len],
            colors: vec![[0.0; 3]; len],
            first: vec![[0.0; 4]; len],
        }
    }

    /// Returns the bytes of memory that the sums of one track (Gaussian followed through frames) take.
    pub(super) fn bytes(sh_degree: usize) -> u64 {
        (8 * (3 + STEADY_COLUMNS.width(sh_degree) + 4 + 3 + 3) + 16) as u64
    }

    fn len(&self) -> usize {
        self.opacity.len()
    }

    /// Adds one frame to the sums of track `track` (Gaussian followed through frames). The state of the track in this
    /// frame is the Gaussian in row `at` of `state`.
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
        for (sum, q) in self.rotations[track].iter_mut().zip(turn) {
            *sum += alpha * q / length;
        }
        let width = self.values.len() / self.opacity.len();
        let values = &mut self.values[track * width..][..width];
        let (rotation_sums, others) = values.split_at_mut(4);
        for (sum, q) in rotation_sums.iter_mut().zip(turn) {
            *sum += alpha * q;
        }
        let (scale_sums, others) = others.split_at_mut(3);
        for (c, sum) in scale_sums.iter_mut().enumerate() {
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

    /// Returns the means of the attributes [`STEADY_COLUMNS`] of track `track` (Gaussian followed through frames) over
    /// its frames, component by component.
    fn means(&self, track: usize) -> Vec<f32> {
        let width = self.values.len() / self.opacity.len();
        let [_, weight, _] = self.opacity[track];
        self.values[track * width..][..width].iter().map(|sum| (sum / weight) as f32).collect()
    }

    /// Returns the attributes of track `track` (Gaussian followed through frames) whose root mean square deviation from
    /// their mean is at most `bound`. Attributes with NaN are not among them.
    fn steady(&self, track: usize, bound: Bound) -> Attributes {
        let [frames, weight, squares] = self.opacity[track];
        let width = self.values.len() / self.opacity.len();
        let mean: Vec<f64> = self.values[track * width..][..width].iter().map(|sum| sum / weight).collect();
        let (scales, colors) = (&mean[4..7], &mean[width - self.sh_width..]);
        let turn = 4.0 * (1.0 - self.rotations[track].iter().map(|sum| (sum / weight).powi(2)).sum::<f64>());
        let within = |variance: f64, bound: f64| variance <= bound * bound;
        let are_scales = (0..3).all(|c| within(self.scales[track][c] / weight - scales[c].powi(2), bound.other));
        let are_colors = (0..3).all(|channel| {
            let of_mean: f64 = colors.iter().skip(channel).step_by(3).map(|value| value * value).sum();
            within((self.colors[track][channel] / weight - of_mean) / (4.0 * PI), bound.color)
        });
        let mut steady = Attributes::empty();
        steady.set(Attributes::ROTATION, within(turn, bound.other));
        steady.set(Attributes::LOG_SCALE, are_scales);
        steady.set(Attributes::OPACITY, within(squares / frames - (weight / frames).powi(2), bound.other));
        steady.set(Attributes::SH, are_colors);
        steady
    }
}
