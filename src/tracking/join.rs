//! Joins tracks (Gaussians followed through frames) that belong to one Gaussian: a track that ends, and a similar track
//! that begins where and when the first one ends.

use std::mem::size_of;

use rayon::prelude::*;

use super::appearance::ComparedAppearance;
use super::grid::CellGrid;
use super::linker::Linker;
use super::track::{Candidate, Candidates, MAX_CANDIDATES, NONE, OpenTrack, Round};
use crate::model::{AttributeValues, Gaussians};

/// Rules for joining two tracks (Gaussians followed through frames). `ALIKE` accepts tracks that may be one Gaussian.
/// `CLOSE` is stricter: it accepts only tracks that look the same. Two tracks may be joined if the cost of their pair
/// is at most 1. In this cost, `reach` scales the distance and `strictness` the difference in appearance.
const ALIKE: Round = Round { reach: 4.0, strictness: 1.0 / 16.0, includes_missing: true };
const CLOSE: Round = Round { reach: 1.0, strictness: 1.0, includes_missing: true };
/// Maximum ratio of the sizes of two tracks (Gaussians followed through frames) that may be joined, as a natural
/// logarithm: ln √2. The size is the root mean square of the three scales. The maximum is √2, because the search for
/// similar Gaussians ([`CellGrid::for_each_near`]) is only certain to find sizes up to this ratio.
const MAX_LN_SIZE_RATIO: f32 = std::f32::consts::LN_2 / 2.0;
/// Largest overlap score with which two tracks (Gaussians followed through frames) may still be joined. The score of a
/// pair rises by 1 in each frame in which both tracks are present. It falls by 1, down to 0, in each frame in which one
/// of them is missing. Some overlap is allowed because a Gaussian may fade out as one track while it fades in as the
/// other.
const MAX_OVERLAP_SCORE: u8 = 4;

/// Rules by which tracks (Gaussians followed through frames) are joined. Tracks that satisfy the second rule also
/// satisfy the first.
const RULES: [&Round; 2] = [&ALIKE, &CLOSE];

/// Joiner of tracks (Gaussians followed through frames) that belong to the same Gaussian. It computes two alternative
/// results: the tracks joined by the rule `ALIKE`, and the tracks joined by the stricter rule `CLOSE`. Every frame is
/// passed to it after the [`Linker`] has linked the frame.
pub struct Joiner([JoinedTracks; 2]);

/// Pairs of tracks (Gaussians followed through frames) that are or may be joined by one of the two [`RULES`].
struct JoinedTracks {
    rule: &'static Round,
    /// Pairs of tracks that are not joined yet and may still be. Sorted by the number of the later track, then by cost
    /// (distance and difference in appearance).
    pairs: Vec<TrackPair>,
    /// For each track, the number of the earlier track that it is joined to and continues; `NONE` if there is none.
    predecessor: Vec<u32>,
    /// For each track, whether a later track that continues it has been joined to it.
    has_successor: Vec<bool>,
}

/// Pair of a track (Gaussian followed through frames) and an earlier track that it may continue.
#[derive(Debug, Clone, Copy)]
struct TrackPair {
    track: u32,
    earlier: u32,
    cost: f32,
    /// Overlap score: each frame in which both tracks are present raises it by 1, and each frame in which one of them
    /// is missing lowers it by 1, down to 0. At most [`MAX_OVERLAP_SCORE`].
    overlap_score: u8,
    /// Whether the two tracks looked the same (rule `CLOSE`) in every frame in which both were present.
    are_close: bool,
    /// Whether the earlier track has ended, so that the later track can be joined to it.
    has_ended: bool,
}

impl Default for Joiner {
    fn default() -> Joiner {
        let none = |rule| JoinedTracks { rule, pairs: Vec::new(), predecessor: Vec::new(), has_successor: Vec::new() };
        Joiner(RULES.map(none))
    }
}

impl Joiner {
    /// Bytes of memory of the joiner for each track (Gaussian followed through frames) begun so far, the result of
    /// [`Joiner::finish`] included. Each list is counted twice, because it is copied when it grows.
    pub const BYTES_PER_TRACK: usize = 2 * RULES.len() * (size_of::<u32>() + size_of::<bool>());
    /// Bytes of memory for each open track, that is, each track (Gaussian followed through frames) that may still
    /// continue.
    pub const BYTES_PER_OPEN_TRACK: usize = 2 * size_of::<ComparedAppearance>()
        + 6 * size_of::<u32>()
        + RULES.len() * MAX_CANDIDATES * (size_of::<Candidate>() + 2 * size_of::<TrackPair>());

    /// Updates the pairs of tracks (Gaussians followed through frames) by the frame that `linker` has linked last; to
    /// be called after every frame.
    pub fn add_frame(&mut self, linker: &Linker) {
        let tracks = linker.open_tracks();
        let born = self.0[0].predecessor.len();
        for joined in &mut self.0 {
            joined.update_pairs(tracks);
            joined.join_ended();
            joined.predecessor.resize(linker.track_count() as usize, NONE);
            joined.has_successor.resize(linker.track_count() as usize, false);
        }
        let (old, new) = tracks.split_at(tracks.partition_point(|track| (track.number as usize) < born));
        self.add_pairs(old, new);
    }

    /// Adds the pairs of tracks (Gaussians followed through frames) that may be joined. `new` holds the tracks that
    /// begin in this frame; `old` holds the tracks that began earlier and may still continue. A pair consists of a
    /// track of `new` and a similar track of `old`.
    fn add_pairs(&mut self, old: &[OpenTrack], new: &[OpenTrack]) {
        if old.is_empty() || new.is_empty() {
            return;
        }
        let appearances: Vec<ComparedAppearance> =
            old.iter().map(|track| track.appearance.at(track.current_position())).collect();
        // A succeeded track (one that is missing although a Gaussian like it is in its place) is not joined to later
        // tracks.
        let numbers: Vec<u32> = (0..old.len() as u32).filter(|&at| !old[at as usize].is_succeeded).collect();
        let grid = CellGrid::new(&appearances, &numbers, ALIKE.reach);
        let paired = new.par_iter().with_min_len(256).map(|track| {
            let mut candidates = RULES.map(|_| Candidates::default());
            grid.for_each_near(
                &track.appearance,
                track.appearance.position,
                ALIKE.reach * track.appearance.size,
                |at, appearance| {
                    for (rule, candidates) in RULES.iter().zip(&mut candidates) {
                        let cost = cost(appearance, &track.appearance, rule);
                        if cost > 1.0 {
                            break;
                        }
                        candidates.add_within(cost, at);
                    }
                },
            );
            (track, candidates)
        });
        let paired: Vec<(&OpenTrack, [Candidates; 2])> = paired.collect();
        for (track, candidates) in &paired {
            // Which of two indistinguishable tracks continues does not matter if both are close.
            let is_in_doubt = track.is_in_doubt;
            for (joined, candidates) in self.0.iter_mut().zip(candidates) {
                joined.pairs.extend(candidates.iter().filter_map(|candidate| {
                    let earlier = &old[candidate.gaussian as usize];
                    let are_close = cost(&appearances[candidate.gaussian as usize], &track.appearance, &CLOSE) <= 1.0;
                    let overlap_score = u8::from(earlier.frames_since_seen == 1);
                    let (track, earlier, cost) = (track.number, earlier.number, candidate.cost);
                    let pair = TrackPair { track, earlier, cost, overlap_score, are_close, has_ended: false };
                    (are_close || !is_in_doubt).then_some(pair)
                }));
            }
        }
    }

    /// Ends the joining of tracks (Gaussians followed through frames). To be called after the last frame, with the
    /// linker that has linked it. Returns the result of joining by the rule `ALIKE` (tracks that may be one Gaussian),
    /// then the result by the stricter rule `CLOSE` (tracks that look the same). Each result is a pair:
    ///
    /// - for each track, in the order in which the tracks began, the number of the joined track to which it belongs;
    /// - the number of joined tracks.
    pub fn finish(self, linker: &Linker) -> [(Vec<u32>, usize); 2] {
        self.0.map(|joined| joined.finish(linker))
    }
}

impl JoinedTracks {
    /// Updates the pairs of tracks (Gaussians followed through frames) after a frame. `tracks` are the open tracks
    /// after this frame; a track that is not among them has ended. There are four cases for a pair:
    ///
    /// - The earlier track has ended: the pair is marked as ready to be joined.
    /// - The later track has ended first: the two tracks are joined if they always looked the same (rule `CLOSE`). The
    ///   pair is removed.
    /// - Both are present in this frame: the overlap score rises by 1. The pair is removed if the score exceeds
    ///   [`MAX_OVERLAP_SCORE`], or if the tracks do not satisfy the rule of `self`.
    /// - One of them is missing in this frame: the overlap score falls by 1, down to 0.
    fn update_pairs(&mut self, tracks: &[OpenTrack]) {
        let find = |number: u32| tracks.binary_search_by_key(&number, |track| track.number).ok().map(|at| &tracks[at]);
        let rule = self.rule;
        let mut absorbed = Vec::new();
        self.pairs.retain_mut(|pair| match (find(pair.earlier), find(pair.track)) {
            (None, _) => {
                pair.has_ended = true;
                true
            }
            (Some(_), None) => {
                if pair.are_close {
                    absorbed.push(*pair);
                }
                false
            }
            (Some(a), Some(b)) if a.frames_since_seen == 1 && b.frames_since_seen == 1 => {
                pair.overlap_score += 1;
                pair.are_close &= cost(&a.appearance, &b.appearance, &CLOSE) <= 1.0;
                pair.overlap_score <= MAX_OVERLAP_SCORE && cost(&a.appearance, &b.appearance, rule) <= 1.0
            }
            // If a Gaussian reappears often, a track that fades out may be joined to the second track that fades in
            // after it. So frames in which one of the two tracks is missing lower the overlap score.
            _ => {
                pair.overlap_score = pair.overlap_score.saturating_sub(1);
                true
            }
        });
        // A track that began and ended while the other was open was a part of the other. Pairs are in the order of
        // cost, so the cheapest one decides.
        for pair in absorbed {
            if self.predecessor[pair.track as usize] == NONE {
                self.predecessor[pair.track as usize] = pair.earlier;
            }
        }
        let predecessor = &self.predecessor;
        self.pairs.retain(|pair| predecessor[pair.track as usize] == NONE);
    }

    /// Joins pairs of tracks (Gaussians followed through frames) whose earlier track has ended. A later track is joined
    /// only by its pair of lowest cost (distance and difference in appearance). Pairs are joined in the order of cost.
    /// Each track continues at most one other, and at most one other continues it.
    fn join_ended(&mut self) {
        loop {
            let firsts = self.pairs.chunk_by(|a, b| a.track == b.track).map(|pairs| pairs[0]);
            let mut ended: Vec<TrackPair> = firsts.filter(|first| first.has_ended).collect();
            if ended.is_empty() {
                return;
            }
            ended.sort_by(|a, b| a.cost.total_cmp(&b.cost).then((a.track, a.earlier).cmp(&(b.track, b.earlier))));
            for pair in ended {
                if !self.has_successor[pair.earlier as usize] {
                    (self.predecessor[pair.track as usize], self.has_successor[pair.earlier as usize]) =
                        (pair.earlier, true);
                }
            }
            let (predecessor, has_successor) = (&self.predecessor, &self.has_successor);
            self.pairs.retain(|pair| {
                predecessor[pair.track as usize] == NONE && !(pair.has_ended && has_successor[pair.earlier as usize])
            });
        }
    }

    /// Ends the joining of tracks (Gaussians followed through frames) by one rule. `linker` has linked the last frame.
    /// Returns for each track the number of the joined track to which it belongs, then the number of joined tracks.
    fn finish(mut self, linker: &Linker) -> (Vec<u32>, usize) {
        let open_tracks = linker.open_tracks();
        self.pairs.retain_mut(|pair| {
            let earlier = open_tracks.binary_search_by_key(&pair.earlier, |track| track.number);
            pair.has_ended =
                pair.are_close || earlier.is_err() || earlier.is_ok_and(|at| open_tracks[at].frames_since_seen > 1);
            pair.has_ended
        });
        self.join_ended();
        let (mut joined, mut count) = (self.predecessor, 0);
        for track in 0..joined.len() {
            // The earlier track of a pair has a smaller number, so its joined track is known.
            joined[track] = match joined[track] {
                NONE => {
                    count += 1;
                    count - 1
                }
                predecessor => joined[predecessor as usize],
            };
        }
        (joined, count as usize)
    }
}

/// Returns the cost of joining two tracks (Gaussians followed through frames) by `rule`: their squared distance plus
/// the difference of their appearances, both scaled by `rule` ([`ComparedAppearance::distance_cost`]). The tracks may
/// be joined if the cost is at most 1. Opacity is not compared. Returns infinity if one Gaussian is more than √2 times
/// as large as the other.
fn cost(a: &ComparedAppearance, b: &ComparedAppearance, rule: &Round) -> f32 {
    if (a.ln_size - b.ln_size).abs() > MAX_LN_SIZE_RATIO {
        return f32::INFINITY;
    }
    a.distance_cost(b, rule.reach, rule.strictness)
}

/// Blends the Gaussians with the indices `rows` of `state` and writes the result to Gaussian `rows[0]`. The opacity
/// becomes 1 − Π(1 − αᵢ); all other attributes become means weighted by the opacities αᵢ. Before averaging, each
/// quaternion gets the sign that brings it closest to the quaternion of Gaussian `rows[0]`. Does nothing if the
/// opacities sum to 0 or are not finite.
pub fn blend_rows(state: &mut Gaussians, rows: &[usize]) {
    let first = rows[0];
    let alpha = |&i: &usize| 1.0 / (1.0 + (-f64::from(state.opacity_logit.plane(0)[i])).exp());
    let alphas: Vec<f64> = rows.iter().map(alpha).collect();
    let sum: f64 = alphas.iter().sum();
    if !(sum > 0.0 && sum.is_finite()) {
        return;
    }
    let weights: Vec<f64> = alphas.iter().map(|alpha| alpha / sum).collect();
    let own = state.rotation.row::<4>(first);
    let signs: Vec<f64> = rows
        .iter()
        .map(|&i| {
            let dot: f32 = own.iter().zip(state.rotation.row::<4>(i)).map(|(a, b)| a * b).sum();
            if dot < 0.0 { -1.0 } else { 1.0 }
        })
        .collect();
    let mean = |column: &mut AttributeValues, signs: Option<&[f64]>| {
        for c in 0..column.width() {
            let plane = column.plane_mut(c);
            let part =
                |(k, &i): (usize, &usize)| weights[k] * signs.map_or(1.0, |signs| signs[k]) * f64::from(plane[i]);
            plane[first] = rows.iter().enumerate().map(part).sum::<f64>() as f32;
        }
    };
    mean(&mut state.position, None);
    mean(&mut state.rotation, Some(&signs));
    mean(&mut state.log_scale, None);
    mean(&mut state.sh, None);
    // Logit ln(α / (1 − α)) of the blended opacity α, where 1 − α = Π(1 − αᵢ). The logs of 1 − αᵢ are exact even if
    // opacities are nearly 1.
    let clear: f64 = rows.iter().map(|&i| -softplus(f64::from(state.opacity_logit.plane(0)[i]))).sum();
    let logit = (-clear.exp_m1()).ln() - clear;
    state.opacity_logit.plane_mut(0)[first] = logit as f32;
}

/// Returns ln(1 + eˣ), which is −ln(1 − α) for an opacity logit x.
fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}
