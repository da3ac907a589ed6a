//! Slow, independent implementation of the rules of the [module documentation](super) in f64. It compares every pair of
//! track and Gaussian. Tests compare the linker and the joiner with it.

use std::collections::{BTreeMap, BTreeSet};

use super::MAX_GAP_FRAMES;
use crate::model::{Gaussians, SH_C0, opacity};

/// Returns the size of Gaussian `i` of `state`: the root mean square of its three scales, scene units.
pub(super) fn rms_size(state: &Gaussians, i: usize) -> f64 {
    let squares = state.log_scale.row::<3>(i).map(|log| (2.0 * f64::from(log)).exp());
    (squares.iter().sum::<f64>() / 3.0).sqrt()
}

/// Slow linker of frames, for comparison with [`super::Linker`]. Links every frame by the same rules, but does not
/// detect cuts (frames that show something else).
#[derive(Default)]
pub(super) struct SlowLinker {
    tracks: Vec<SlowTrack>,
    /// Number of tracks that have begun so far.
    pub(super) born: u32,
}

/// Track (Gaussian followed through frames) that may still continue.
struct SlowTrack {
    number: u32,
    frames_since_seen: f64,
    velocity: Option<[f64; 3]>,
    seen: SeenGaussian,
    is_succeeded: bool,
}

/// Position and appearance of a Gaussian at one frame.
#[derive(Clone)]
pub(super) struct SeenGaussian {
    position: [f64; 3],
    size: f64,
    shape: [[f64; 3]; 3],
    opacity: f64,
    color: [f64; 3],
    bits: Vec<u32>,
}

/// Returns the position and appearance of Gaussian `i` of a frame.
pub(super) fn seen(state: &Gaussians, i: usize) -> SeenGaussian {
    let [w, x, y, z] = {
        let q = state.rotation_f64(i);
        let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        q.map(|x| x / length)
    };
    // Rotation matrix: its columns are the rotated axes.
    let r = glam::DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w));
    let variance = state.log_scale.row::<3>(i).map(|log| (2.0 * f64::from(log)).exp());
    let covariance = r * glam::DMat3::from_diagonal(variance.into()) * r.transpose();
    let trace: f64 = variance.iter().sum();
    let columns = (covariance * trace.recip()).to_cols_array_2d();
    let bits = |values: &[f32]| values.iter().map(|x| x.to_bits()).collect::<Vec<u32>>();
    SeenGaussian {
        position: state.position_f64(i),
        size: rms_size(state, i),
        shape: columns,
        opacity: opacity(state.opacity_logit.plane(0)[i]),
        color: state.sh.row::<3>(i).map(|dc| 0.5 + SH_C0 * f64::from(dc)),
        bits: [
            bits(&state.position.row::<3>(i)),
            bits(&state.rotation.row::<4>(i)),
            bits(&state.log_scale.row::<3>(i)),
            bits(&state.opacity_logit.row::<1>(i)),
            bits(&state.sh.row::<3>(i)),
        ]
        .concat(),
    }
}

/// Returns the difference in size, shape and color between two Gaussians: A in the formulas of the module
/// documentation, without the term for opacity.
fn difference(a: &SeenGaussian, b: &SeenGaussian) -> f64 {
    let shape: f64 = (0..9).map(|k| (b.shape[k / 3][k % 3] - a.shape[k / 3][k % 3]).powi(2)).sum();
    let color: f64 = (0..3).map(|c| (b.color[c] - a.color[c]).powi(2)).sum();
    let size = (b.size / a.size).ln() / 2f64.sqrt().ln();
    size * size + shape / 0.25f64.powi(2) + color / 0.1f64.powi(2)
}

/// Returns whether two Gaussians are near-duplicates: near each other and alike except for opacity.
fn is_near_duplicate(a: &SeenGaussian, b: &SeenGaussian) -> bool {
    let distance: f64 = (0..3).map(|c| (b.position[c] - a.position[c]).powi(2)).sum();
    distance / (0.25 * a.size.min(b.size)).powi(2) + 4.0 * difference(a, b) <= 1.0
}

impl SlowTrack {
    /// Returns the cost of linking this track (Gaussian followed through frames) to the Gaussian `b`: distance plus
    /// difference in appearance. `r` scales the distance from the expected position, `q` the difference in appearance.
    /// A link is possible if the cost is at most 1.
    fn cost(&self, b: &SeenGaussian, r: f64, q: f64) -> f64 {
        let v = self.velocity.unwrap_or_default();
        let speed = v.iter().map(|v| v * v).sum::<f64>().sqrt();
        let u = self.seen.size + (0.5 * self.frames_since_seen * speed).min(3.0 * self.seen.size);
        let distance: f64 =
            (0..3).map(|c| (b.position[c] - self.seen.position[c] - self.frames_since_seen * v[c]).powi(2)).sum();
        distance / (r * u).powi(2) + q * (difference(&self.seen, b) + ((b.opacity - self.seen.opacity) / 0.5).powi(2))
    }
}

impl SlowLinker {
    /// Computes, for every track (Gaussian followed through frames) that a round of linking has linked, the probability
    /// that its link is wrong. Returns pairs (probability, track).
    ///
    /// - `candidates`: all possible links of the round as (cost, track, Gaussian).
    /// - `gaussian_of`: the Gaussian of every linked track.
    /// - `track_of`: the track of every linked Gaussian.
    /// - `cost`: returns the cost (distance and difference in appearance) of the link between a track and a Gaussian.
    /// - `are_duplicates`: decides whether a possible link between a track and a Gaussian is ignored because
    ///   near-duplicates cannot be told apart. Arguments: this track, this Gaussian, the Gaussian that the track is
    ///   really linked to, and the track that the Gaussian is really linked to.
    fn probabilities(
        candidates: &[(f64, usize, usize)],
        gaussian_of: &BTreeMap<usize, usize>,
        track_of: &BTreeMap<usize, usize>,
        cost: impl Fn(usize, usize) -> f64,
        are_duplicates: impl Fn(usize, usize, Option<usize>, Option<usize>) -> bool,
    ) -> Vec<(f64, usize)> {
        let linked: BTreeMap<usize, usize> =
            candidates.iter().filter_map(|&(_, a, _)| gaussian_of.get(&a).map(|&b| (a, b))).collect();
        let rivals: Vec<_> = candidates.iter().filter(|(_, a, b)| gaussian_of.get(a) != Some(b)).collect();
        let surplus = rivals.iter().filter(|(_, a, _)| linked.contains_key(a)).count();
        let mean_surplus = surplus as f64 / linked.len().max(1) as f64;
        let probability = |(&a, &b): (&usize, &usize)| {
            let mut most = 0f64;
            for &&(candidate_cost, c, d) in rivals.iter().filter(|(_, c, d)| *c == a || *d == b) {
                if are_duplicates(c, d, linked.get(&c).copied(), track_of.get(&d).copied()) {
                    continue;
                }
                let (now, swapped) = match (linked.get(&c), track_of.get(&d)) {
                    (Some(&own), Some(&other)) => {
                        (cost(c, own) + cost(other, d), candidate_cost + cost(other, own).min(1.0))
                    }
                    (Some(&own), None) => (cost(c, own), candidate_cost),
                    (None, Some(&other)) => (cost(other, d), candidate_cost),
                    (None, None) => continue,
                };
                most = most.max((now + 1e-6) / (swapped + 1e-6));
            }
            let by_rivals = most.powi(5) / (1.0 + most.powi(5));
            ((0.25 * mean_surplus * cost(a, b).powf(1.5)).min(0.5).max(by_rivals), a)
        };
        linked.iter().map(probability).collect()
    }

    /// Links the Gaussians of the next frame to tracks (Gaussians followed through frames) and returns the number of
    /// the track of every Gaussian.
    pub(super) fn link(&mut self, state: &Gaussians) -> Vec<u32> {
        let all: Vec<SeenGaussian> = (0..state.len()).map(|i| seen(state, i)).collect();
        let mut gaussian_of: BTreeMap<usize, usize> = BTreeMap::new();
        let mut taken: BTreeMap<usize, usize> = BTreeMap::new();
        for (a, track) in self.tracks.iter().enumerate() {
            let free = |b: &usize| !taken.contains_key(b) && all[*b].bits == track.seen.bits;
            if let Some(b) = (0..all.len()).find(free) {
                gaussian_of.insert(a, b);
                taken.insert(b, a);
            }
        }
        let mut probabilities: Vec<(f64, usize)> = Vec::new();
        for (r, q, includes_missing) in [(0.25, 4.0, false), (1.0, 1.0, true), (4.0, 4.0, true)] {
            let cost = |a: usize, b: usize| self.tracks[a].cost(&all[b], r, q);
            let mut by_cost: Vec<(f64, usize, usize)> = Vec::new();
            for (a, track) in self.tracks.iter().enumerate() {
                if gaussian_of.contains_key(&a)
                    || (track.frames_since_seen > 1.0 && (!includes_missing || track.is_succeeded))
                {
                    continue;
                }
                let free = (0..all.len()).filter(|b| !taken.contains_key(b));
                let mut own: Vec<(f64, usize, usize)> = free.map(|b| (cost(a, b), a, b)).collect();
                own.retain(|candidate| candidate.0 <= 1.0);
                own.sort_by(|x, y| x.partial_cmp(y).unwrap());
                by_cost.extend(own.into_iter().take(4));
            }
            let candidates = by_cost.clone();
            by_cost.sort_by(|x, y| x.partial_cmp(y).unwrap());
            for (_, a, b) in by_cost {
                if !gaussian_of.contains_key(&a) && !taken.contains_key(&b) {
                    gaussian_of.insert(a, b);
                    taken.insert(b, a);
                }
            }
            for _ in 0..4 {
                for &(candidate_cost, a, b) in &candidates {
                    let (Some(&own), Some(&other)) = (gaussian_of.get(&a), taken.get(&b)) else { continue };
                    let theirs = cost(other, own);
                    if other != a && theirs <= 1.0 && candidate_cost + theirs < cost(a, own) + cost(other, b) {
                        gaussian_of.extend([(a, b), (other, own)]);
                        taken.extend([(b, a), (own, other)]);
                    }
                }
            }
            let close = |a: usize, b: usize| is_near_duplicate(&self.tracks[a].seen, &self.tracks[b].seen);
            let are_duplicates = |c, d, own: Option<usize>, other: Option<usize>| {
                other.is_some_and(|e| close(c, e)) || own.is_some_and(|b: usize| is_near_duplicate(&all[b], &all[d]))
            };
            probabilities.extend(Self::probabilities(&candidates, &gaussian_of, &taken, cost, are_duplicates));
        }
        // Drop the least certain links until at most one in two hundred is expected to be wrong.
        probabilities.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
        let mut expected_wrong: f64 = probabilities.iter().map(|(probability, _)| probability).sum();
        for (probability, a) in probabilities {
            if expected_wrong <= 0.005 * gaussian_of.len() as f64 {
                break;
            }
            gaussian_of.remove(&a);
            expected_wrong -= probability;
        }
        self.extend_tracks(&all, &gaussian_of)
    }

    /// Adds the Gaussians of the next frame, `all`, to the tracks (Gaussians followed through frames). Returns for
    /// every Gaussian the number of its track. `gaussian_of` maps the index of each linked track to the index of the
    /// Gaussian that continues it. Every other Gaussian begins a new track.
    fn extend_tracks(&mut self, all: &[SeenGaussian], gaussian_of: &BTreeMap<usize, usize>) -> Vec<u32> {
        let mut numbers = vec![u32::MAX; all.len()];
        for (a, track) in self.tracks.iter_mut().enumerate() {
            let Some(&b) = gaussian_of.get(&a) else {
                if track.frames_since_seen == 1.0 {
                    let v = track.velocity.unwrap_or_default();
                    let expected = SeenGaussian {
                        position: [0, 1, 2].map(|c| track.seen.position[c] + v[c]),
                        ..track.seen.clone()
                    };
                    track.is_succeeded = all.iter().any(|other| {
                        let distance: f64 = (0..3).map(|c| (other.position[c] - expected.position[c]).powi(2)).sum();
                        let unit = 0.25 * other.size.min(expected.size);
                        distance / unit.powi(2) + difference(&expected, other) <= 1.0
                    });
                }
                track.frames_since_seen += 1.0;
                continue;
            };
            numbers[b] = track.number;
            let step: [f64; 3] =
                std::array::from_fn(|c| (all[b].position[c] - track.seen.position[c]) / track.frames_since_seen);
            let velocity = track.velocity.map(|v| std::array::from_fn(|c| 0.5 * (v[c] + step[c])));
            (track.velocity, track.seen, track.frames_since_seen) = (velocity.or(Some(step)), all[b].clone(), 1.0);
            track.is_succeeded = false;
        }
        self.tracks.retain(|track| track.frames_since_seen <= 4.0);
        for b in 0..all.len() {
            if numbers[b] == u32::MAX {
                numbers[b] = self.born;
                let seen = all[b].clone();
                let (number, frames_since_seen, velocity) = (self.born, 1.0, None);
                self.tracks.push(SlowTrack { number, frames_since_seen, velocity, seen, is_succeeded: false });
                self.born += 1;
            }
        }
        numbers
    }
}

/// All tracks (Gaussians followed through frames). The map of a track has an entry for each frame in which the track
/// has a Gaussian: frame → this Gaussian.
pub(super) type History = Vec<BTreeMap<usize, SeenGaussian>>;

/// Returns the position of a track (Gaussian followed through frames) at `frame` in scene units, and the number of
/// frames since the last frame in which the track has a Gaussian. If this number is not 0, the position is
/// extrapolated. `frame` must not be before the first frame of the track.
fn position_at(track: &BTreeMap<usize, SeenGaussian>, frame: usize) -> ([f64; 3], usize) {
    let seen: Vec<(&usize, &SeenGaussian)> = track.range(..=frame).collect();
    let mut velocity: Option<[f64; 3]> = None;
    for pair in seen.windows(2) {
        let step: [f64; 3] =
            std::array::from_fn(|c| (pair[1].1.position[c] - pair[0].1.position[c]) / (pair[1].0 - pair[0].0) as f64);
        velocity = Some(velocity.map_or(step, |v| std::array::from_fn(|c| 0.5 * (v[c] + step[c]))));
    }
    let (&last, at) = seen[seen.len() - 1];
    let v = velocity.unwrap_or_default();
    (std::array::from_fn(|c| at.position[c] + (frame - last) as f64 * v[c]), frame - last)
}

/// Pairs of a later and an earlier track (Gaussians followed through frames), sorted by later track and cost (distance
/// and difference in appearance).
///
/// - Key: number of the later track, then the bits of the cost of the pair.
/// - Value: number of the earlier track; overlap score (a frame with both tracks adds 1, a frame without one of them
///   subtracts 1, down to 0); whether the two tracks look the same (rule *close*); whether the earlier track has ended
///   (has had no Gaussian for more than [`MAX_GAP_FRAMES`] frames).
type TrackPairs = BTreeMap<(usize, u64), (usize, usize, bool, bool)>;

/// Joins tracks (Gaussians followed through frames) that belong to one Gaussian: one track ends where and when a
/// similar one begins. Returns for every track the number of the joined track to which it belongs.
///
/// - `in_doubt`: numbers of the tracks that began because a link was probably wrong.
/// - `succeeded`: pairs (frame, track). The track has no Gaussian in this frame, and another Gaussian has replaced its
///   Gaussian: a similar one is at the expected position.
/// - `frames`: number of frames.
/// - `r` and `q`: in the cost of a pair, `r` scales the distance and `q` the difference in appearance.
pub(super) fn slow_joined_tracks(
    tracks: &History,
    in_doubt: &BTreeSet<u32>,
    succeeded: &BTreeSet<(usize, u32)>,
    frames: usize,
    (r, q): (f64, f64),
) -> Vec<u32> {
    let cost = |a: &SeenGaussian, at: [f64; 3], b: &SeenGaussian, (r, q): (f64, f64)| {
        let distance: f64 = (0..3).map(|c| (at[c] - b.position[c]).powi(2)).sum();
        let sizes_agree = a.size.max(b.size) <= 2f64.sqrt() * a.size.min(b.size);
        let cost = distance / (r * a.size.min(b.size)).powi(2) + q * difference(a, b);
        if sizes_agree { cost } else { f64::INFINITY }
    };
    let first = |track: usize| *tracks[track].keys().next().unwrap();
    let is_gone = |track: usize, frame: usize| frame > tracks[track].keys().last().unwrap() + MAX_GAP_FRAMES as usize;
    let last_seen = |track: usize, frame: usize| tracks[track].range(..=frame).last().unwrap().1;
    let mut predecessor: Vec<Option<usize>> = vec![None; tracks.len()];
    let mut has_successor = vec![false; tracks.len()];
    let mut pairs = TrackPairs::new();
    for frame in 0..frames {
        let mut absorbed = Vec::new();
        pairs.retain(|&(b, _), (a, overlap_score, close, ended)| {
            if is_gone(*a, frame) {
                *ended = true;
                return true;
            }
            if is_gone(b, frame) {
                if *close {
                    absorbed.push((b, *a));
                }
                return false;
            }
            let (Some(seen_a), Some(seen_b)) = (tracks[*a].get(&frame), tracks[b].get(&frame)) else {
                *overlap_score = overlap_score.saturating_sub(1);
                return true;
            };
            *overlap_score += 1;
            *close &= cost(seen_a, seen_a.position, seen_b, (1.0, 1.0)) <= 1.0;
            *overlap_score <= 4 && cost(seen_a, seen_a.position, seen_b, (r, q)) <= 1.0
        });
        for (b, a) in absorbed {
            predecessor[b] = predecessor[b].or(Some(a));
        }
        pairs.retain(|&(b, _), _| predecessor[b].is_none());
        join_ended(&mut pairs, &mut predecessor, &mut has_successor);
        for b in (0..tracks.len()).filter(|&b| first(b) == frame) {
            let own = &tracks[b][&frame];
            let mut candidates = Vec::new();
            let may_continue = |&a: &usize| first(a) < frame && !succeeded.contains(&(frame, a as u32));
            for a in (0..tracks.len()).filter(may_continue) {
                let (at, missing) = position_at(&tracks[a], frame);
                let appearance = last_seen(a, frame);
                let all = cost(appearance, at, own, (r, q));
                if missing <= MAX_GAP_FRAMES as usize && all <= 1.0 {
                    let close = cost(appearance, at, own, (1.0, 1.0)) <= 1.0;
                    candidates.push((all.to_bits(), (a, usize::from(missing == 0), close, false)));
                }
            }
            candidates.sort_unstable();
            candidates.truncate(4);
            candidates.retain(|&(_, (_, _, close, _))| close || !in_doubt.contains(&(b as u32)));
            pairs.extend(candidates.into_iter().map(|(cost, pair)| ((b, cost), pair)));
        }
    }
    pairs.retain(|_, (a, _, close, ended)| {
        *ended = *close || is_gone(*a, frames - 1) || !tracks[*a].contains_key(&(frames - 1));
        *ended
    });
    join_ended(&mut pairs, &mut predecessor, &mut has_successor);
    let (mut joined, mut count) = (Vec::<u32>::new(), 0);
    for predecessor in predecessor {
        joined.push(predecessor.map_or(count, |a| joined[a]));
        count += u32::from(predecessor.is_none());
    }
    joined
}

/// Joins tracks (Gaussians followed through frames) that seem to be one Gaussian. Each of `pairs` is a possible join of
/// a later track to an earlier track. It has a cost (distance and difference in appearance) and states whether the
/// earlier track has ended (see [`TrackPairs`]).
///
/// Works in rounds. Each round has three steps:
/// 1. Select the pair of lowest cost of each later track. If the earlier track of this pair has not ended, the later
///    track is not joined in this round, and this pair remains in `pairs`.
/// 2. Go through the other selected pairs by increasing cost. Join the two tracks of a pair, unless the earlier track
///    is already continued by another track.
/// 3. Remove all pairs of later tracks that are joined, and all pairs of earlier tracks that have ended and are already
///    continued. A later track that loses its selected pair in this way selects another one in the next round.
///
/// Stops after a round in which step 1 selects no pair whose earlier track has ended.
///
/// The joins are recorded in two lists with one entry per track:
/// - `predecessor`: number of the earlier track that the track continues, or `None`.
/// - `has_successor`: whether a later track continues the track.
fn join_ended(pairs: &mut TrackPairs, predecessor: &mut [Option<usize>], has_successor: &mut [bool]) {
    loop {
        let mut firsts: BTreeMap<usize, (u64, usize, bool)> = BTreeMap::new();
        for (&(b, cost), &(a, _, _, ended)) in pairs.iter() {
            firsts.entry(b).or_insert((cost, a, ended));
        }
        let mut ended: Vec<(u64, usize, usize)> =
            firsts.into_iter().filter(|(_, (_, _, ended))| *ended).map(|(b, (cost, a, _))| (cost, b, a)).collect();
        ended.sort_unstable();
        for &(_, b, a) in &ended {
            if !has_successor[a] {
                (predecessor[b], has_successor[a]) = (Some(a), true);
            }
        }
        pairs.retain(|&(b, _), (a, _, _, has_ended)| predecessor[b].is_none() && !(*has_ended && has_successor[*a]));
        if ended.is_empty() {
            return;
        }
    }
}
