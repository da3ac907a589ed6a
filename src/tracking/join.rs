//! Lives that are one: a track that ends where and when another begins that looks alike (part 6 of the [module](super)).

use std::mem::size_of;

use rayon::prelude::*;

use super::grid::CellGrid;
use super::linker::Linker;
use super::look::ComparedAppearance;
use super::track::{NAMED, NONE, Offer, Offers, OpenTrack, Round};
use crate::model::{Column, Gaussians};

/// r and q of lives that may be one, and of those that are one to the eye.
const ALIKE: Round = Round { reach: 4.0, strictness: 1.0 / 16.0, missing: true };
const CLOSE: Round = Round { reach: 1.0, strictness: 1.0, missing: true };
/// How much larger one may be, as a natural log: no other is looked for in the grid.
const MOST_LARGER: f32 = std::f32::consts::LN_2 / 2.0;
/// Frames that both lives may be there together, beyond those that one is there alone: one fades out while the other fades in.
const TOGETHER: u8 = 4;

/// How alike lives must be to be one: so that they may be, and so that they are to the eye. What the second takes the first
/// does too.
const RULES: [&Round; 2] = [&ALIKE, &CLOSE];

/// Watches a [`Linker`] for lives that are one.
pub struct Joiner([JoinedTracks; 2]);

/// Lives that are one by a rule.
struct JoinedTracks {
    rule: &'static Round,
    /// By the track that has begun, then by cost.
    pairs: Vec<TrackPair>,
    /// Of every track the one that it goes on from.
    from: Vec<u32>,
    /// Of every track whether another goes on from its end.
    goes_on: Vec<bool>,
}

/// A track that has begun, and one it may go on from.
#[derive(Debug, Clone, Copy)]
struct TrackPair {
    track: u32,
    other: u32,
    cost: f32,
    /// Frames that both were there, less those after them that one was there alone.
    together: u8,
    /// Whether they were one to the eye in all of these.
    are_close: bool,
    /// Whether the other has ended.
    has_ended: bool,
}

impl Default for Joiner {
    fn default() -> Joiner {
        let none = |rule| JoinedTracks { rule, pairs: Vec::new(), from: Vec::new(), goes_on: Vec::new() };
        Joiner(RULES.map(none))
    }
}

impl Joiner {
    /// Bytes for each track there has been, in lists that grow by being copied to twice their length, and what they end as.
    pub const BYTES_PER_TRACK: usize = 2 * RULES.len() * (size_of::<u32>() + size_of::<bool>());
    /// Bytes for each track that may go on.
    pub const BYTES_PER_LIVING: usize = 2 * size_of::<ComparedAppearance>()
        + 6 * size_of::<u32>()
        + RULES.len() * NAMED * (size_of::<Offer>() + 2 * size_of::<TrackPair>());

    /// Takes in the frame that `linker` has linked last.
    pub fn see(&mut self, linker: &Linker) {
        let tracks = linker.living();
        let born = self.0[0].from.len();
        for lives in &mut self.0 {
            lives.watch(tracks);
            lives.settle();
            lives.from.resize(linker.tracks() as usize, NONE);
            lives.goes_on.resize(linker.tracks() as usize, false);
        }
        let (old, new) = tracks.split_at(tracks.partition_point(|track| (track.number as usize) < born));
        self.name(old, new);
    }

    /// Pairs tracks that begin with those that may end here.
    fn name(&mut self, old: &[OpenTrack], new: &[OpenTrack]) {
        if old.is_empty() || new.is_empty() {
            return;
        }
        let looks: Vec<ComparedAppearance> = old.iter().map(|track| track.look.at(track.now())).collect();
        // Who has been succeeded is not again by what begins later.
        let numbers: Vec<u32> = (0..old.len() as u32).filter(|&at| !old[at as usize].is_succeeded).collect();
        let grid = CellGrid::new(&looks, &numbers, ALIKE.reach);
        let named = new.par_iter().with_min_len(256).map(|track| {
            let mut offers = RULES.map(|_| Offers::default());
            grid.near(&track.look, track.look.position, ALIKE.reach * track.look.size, |at, look| {
                for (rule, offers) in RULES.iter().zip(&mut offers) {
                    let cost = cost(look, &track.look, rule);
                    if cost > 1.0 {
                        break;
                    }
                    offers.add_within(cost, at);
                }
            });
            (track, offers)
        });
        let named: Vec<(&OpenTrack, [Offers; 2])> = named.collect();
        for (track, offers) in &named {
            // Which of two that nobody can tell apart goes on does not matter where they are one to the eye.
            let is_in_doubt = track.is_in_doubt;
            for (lives, offers) in self.0.iter_mut().zip(offers) {
                lives.pairs.extend(offers.iter().filter_map(|offer| {
                    let other = &old[offer.point as usize];
                    let are_close = cost(&looks[offer.point as usize], &track.look, &CLOSE) <= 1.0;
                    let together = u8::from(other.ago == 1);
                    let (track, other, cost) = (track.number, other.number, offer.cost);
                    let pair = TrackPair { track, other, cost, together, are_close, has_ended: false };
                    (are_close || !is_in_doubt).then_some(pair)
                }));
            }
        }
    }

    /// Ends with the last frame; gives of every track the number of the life it is of, counted by their beginnings, and how
    /// many lives there are: where all are one that are alike, and where twins are.
    pub fn finish(self, linker: &Linker) -> [(Vec<u32>, usize); 2] {
        self.0.map(|lives| lives.finish(linker))
    }
}

impl JoinedTracks {
    /// Drops pairs that differ, and marks those of tracks that have ended.
    fn watch(&mut self, tracks: &[OpenTrack]) {
        let find = |number: u32| tracks.binary_search_by_key(&number, |track| track.number).ok().map(|at| &tracks[at]);
        let rule = self.rule;
        let mut within = Vec::new();
        self.pairs.retain_mut(|pair| match (find(pair.other), find(pair.track)) {
            (None, _) => {
                pair.has_ended = true;
                true
            }
            (Some(_), None) => {
                if pair.are_close {
                    within.push(*pair);
                }
                false
            }
            (Some(a), Some(b)) if a.ago == 1 && b.ago == 1 => {
                pair.together += 1;
                pair.are_close &= cost(&a.look, &b.look, &CLOSE) <= 1.0;
                pair.together <= TOGETHER && cost(&a.look, &b.look, rule) <= 1.0
            }
            // Where lives are short, one that fades out is linked with what the one after the next fades in as.
            _ => {
                pair.together = pair.together.saturating_sub(1);
                true
            }
        });
        // What has come and gone beside another was part of it: pairs are in the order of cost.
        for pair in within {
            if self.from[pair.track as usize] == NONE {
                self.from[pair.track as usize] = pair.other;
            }
        }
        let from = &self.from;
        self.pairs.retain(|pair| from[pair.track as usize] == NONE);
    }

    /// Joins each track with the cheapest that it may go on from, if that has ended: by cost, each end and each beginning
    /// once.
    fn settle(&mut self) {
        loop {
            let firsts = self.pairs.chunk_by(|a, b| a.track == b.track).map(|of_track| of_track[0]);
            let mut ended: Vec<TrackPair> = firsts.filter(|first| first.has_ended).collect();
            if ended.is_empty() {
                return;
            }
            ended.sort_by(|a, b| a.cost.total_cmp(&b.cost).then((a.track, a.other).cmp(&(b.track, b.other))));
            for pair in ended {
                if !self.goes_on[pair.other as usize] {
                    (self.from[pair.track as usize], self.goes_on[pair.other as usize]) = (pair.other, true);
                }
            }
            let (from, goes_on) = (&self.from, &self.goes_on);
            self.pairs
                .retain(|pair| from[pair.track as usize] == NONE && !(pair.has_ended && goes_on[pair.other as usize]));
        }
    }

    /// The tracks' lives, and how many there are.
    fn finish(mut self, linker: &Linker) -> (Vec<u32>, usize) {
        let living = linker.living();
        self.pairs.retain_mut(|pair| {
            let other = living.binary_search_by_key(&pair.other, |track| track.number);
            pair.has_ended = pair.are_close || other.is_err() || other.is_ok_and(|at| living[at].ago > 1);
            pair.has_ended
        });
        self.settle();
        let (mut lives, mut count) = (self.from, 0);
        for track in 0..lives.len() {
            // What a track goes on from has begun before it.
            lives[track] = match lives[track] {
                NONE => {
                    count += 1;
                    count - 1
                }
                from => lives[from as usize],
            };
        }
        (lives, count as usize)
    }
}

/// What it costs that both are one, opacities aside: too much where one is more than √2 times as large as the other.
fn cost(a: &ComparedAppearance, b: &ComparedAppearance, rule: &Round) -> f32 {
    if (a.ln_size - b.ln_size).abs() > MOST_LARGER {
        return f32::INFINITY;
    }
    a.apart(b, rule.reach, rule.strictness)
}

/// Writes to row `rows[0]` of `state` what all of `rows` are together: opacity 1 − Π(1 − αᵢ), all else the mean of what they
/// are, weighted by αᵢ, signs of quaternions as the first has them.
pub fn blend(state: &mut Gaussians, rows: &[usize]) {
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
    let mean = |column: &mut Column, signs: Option<&[f64]>| {
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
    // ln(α / (1 − α)) of 1 − α = Π(1 − αᵢ), whose logs are exact where opacities are nearly 1.
    let clear: f64 = rows.iter().map(|&i| -softplus(f64::from(state.opacity_logit.plane(0)[i]))).sum();
    let logit = (-clear.exp_m1()).ln() - clear;
    state.opacity_logit.plane_mut(0)[first] = logit as f32;
}

/// ln(1 + eˣ), which is −ln(1 − α) of an opacity logit x.
fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}
