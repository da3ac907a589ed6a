//! Links between open tracks (tracks that may continue) and the Gaussians of a frame.

use rayon::prelude::*;

use super::appearance::ComparedAppearance;
use super::grid::CellGrid;
use super::track::{Candidates, NONE, OpenTrack, Round};

/// Maximum number of passes over all tracks (Gaussians followed through frames) in which tracks exchange their
/// Gaussians to lower the costs (distance and difference in appearance) of links.
const MAX_EXCHANGES: usize = 4;

/// Links between the open tracks (Gaussians followed through frames) and the Gaussians of a frame, in both directions.
pub(super) struct Links {
    /// For every open track the Gaussian that continues it; `NONE` if there is none. `track_of_gaussian` holds the
    /// inverse: for every Gaussian the track that it continues.
    pub(super) gaussian_of_track: Vec<u32>,
    pub(super) track_of_gaussian: Vec<u32>,
}

impl Links {
    pub(super) fn count(&self) -> usize {
        self.gaussian_of_track.iter().filter(|&&gaussian| gaussian != NONE).count()
    }

    fn link(&mut self, track: u32, gaussian: u32) {
        (self.gaussian_of_track[track as usize], self.track_of_gaussian[gaussian as usize]) = (gaussian, track);
    }

    /// Removes the link of the open track `track` (Gaussian followed through frames) and returns the Gaussian that it
    /// was linked to.
    pub(super) fn undo(&mut self, track: u32) -> u32 {
        let gaussian = std::mem::replace(&mut self.gaussian_of_track[track as usize], NONE);
        self.track_of_gaussian[gaussian as usize] = NONE;
        gaussian
    }

    fn is_free(&self, track: u32, gaussian: u32) -> bool {
        self.gaussian_of_track[track as usize] == NONE && self.track_of_gaussian[gaussian as usize] == NONE
    }

    /// Links each track (Gaussian followed through frames) to the first Gaussian, among those not linked yet, that
    /// equals the track's last Gaussian bit by bit. Goes through `tracks` and the Gaussians (`appearances`) in order.
    pub(super) fn add_repeats(&mut self, tracks: &[OpenTrack], appearances: &[ComparedAppearance]) {
        let buckets = (2 * appearances.len()).next_power_of_two();
        let bucket = |appearance: &ComparedAppearance| appearance.bits as usize & (buckets - 1);
        let mut starts = vec![0u32; buckets + 1];
        appearances.iter().for_each(|appearance| starts[bucket(appearance) + 1] += 1);
        (0..buckets).for_each(|at| starts[at + 1] += starts[at]);
        let mut next = starts.clone();
        let mut order = vec![0u32; appearances.len()];
        for (gaussian, appearance) in appearances.iter().enumerate() {
            let to = &mut next[bucket(appearance)];
            order[*to as usize] = gaussian as u32;
            *to += 1;
        }
        // From here on, `next` holds the first Gaussian of each hash bucket that is not linked.
        next.copy_from_slice(&starts);
        for (number, track) in tracks.iter().enumerate() {
            let bucket = bucket(&track.appearance);
            let is_free = |gaussian: u32| self.track_of_gaussian[gaussian as usize] == NONE;
            while next[bucket] < starts[bucket + 1] && !is_free(order[next[bucket] as usize]) {
                next[bucket] += 1;
            }
            let left = &order[next[bucket] as usize..starts[bucket + 1] as usize];
            let is_repeat =
                |gaussian: u32| is_free(gaussian) && appearances[gaussian as usize].bits == track.appearance.bits;
            if let Some(&gaussian) = left.iter().find(|&&gaussian| is_repeat(gaussian)) {
                self.link(number as u32, gaussian);
            }
        }
    }

    /// Links tracks (Gaussians followed through frames) and Gaussians that are not linked yet, by the costs (distance
    /// and difference in appearance) and limits of `round`. Returns the tracks that took part, each with its candidates
    /// (the Gaussians that could continue it).
    pub(super) fn add_round(
        &mut self,
        tracks: &[OpenTrack],
        appearances: &[ComparedAppearance],
        round: &Round,
    ) -> Vec<(u32, Candidates)> {
        let takes_part =
            |track: &OpenTrack| track.frames_since_seen == 1 || (round.includes_missing && !track.is_succeeded);
        let free =
            |links: &[u32]| -> Vec<u32> { (0..links.len() as u32).filter(|&i| links[i as usize] == NONE).collect() };
        let (gaussians, mut left) = (free(&self.track_of_gaussian), free(&self.gaussian_of_track));
        left.retain(|&track| takes_part(&tracks[track as usize]));
        if gaussians.is_empty() || left.is_empty() {
            return Vec::new();
        }
        let grid = CellGrid::new(appearances, &gaussians, round.reach);
        let candidates = |&track: &u32| (track, tracks[track as usize].candidates(&grid, round));
        let candidates_by_track: Vec<(u32, Candidates)> = left.par_iter().with_min_len(1024).map(candidates).collect();
        self.link_by_cost(&candidates_by_track);
        let cost = |track: u32, gaussian: u32| tracks[track as usize].cost(&appearances[gaussian as usize], round);
        let mut rounds = 0..MAX_EXCHANGES;
        while rounds.next().is_some() && self.exchange(&candidates_by_track, cost) {}
        candidates_by_track
    }

    /// Exchanges the Gaussians of two tracks (Gaussians followed through frames) wherever that lowers the total cost
    /// (distance and difference in appearance) of their links. Goes through the tracks and their candidates (Gaussians
    /// that could continue them) in the order of `candidates_by_track`. `cost` returns the cost of the link between a
    /// track and a Gaussian. Returns whether any exchange was made.
    fn exchange(&mut self, candidates_by_track: &[(u32, Candidates)], cost: impl Fn(u32, u32) -> f32) -> bool {
        let mut any = false;
        for (track, candidates) in candidates_by_track {
            for candidate in candidates.iter() {
                let (own, other) =
                    (self.gaussian_of_track[*track as usize], self.track_of_gaussian[candidate.gaussian as usize]);
                if own == NONE || other == NONE || other == *track {
                    continue;
                }
                let theirs = cost(other, own);
                if theirs <= 1.0 && candidate.cost + theirs < cost(*track, own) + cost(other, candidate.gaussian) {
                    self.link(*track, candidate.gaussian);
                    self.link(other, own);
                    any = true;
                }
            }
        }
        any
    }

    /// Links tracks (Gaussians followed through frames) to their candidates (the Gaussians that could continue them) in
    /// the order of cost (distance and difference in appearance); ties in the order of track, then Gaussian. Skips
    /// tracks and Gaussians that already have a link.
    fn link_by_cost(&mut self, candidates_by_track: &[(u32, Candidates)]) {
        let mut best = vec![(f32::INFINITY, NONE); self.track_of_gaussian.len()];
        for (track, candidates) in candidates_by_track {
            for candidate in candidates.iter() {
                let best = &mut best[candidate.gaussian as usize];
                if (candidate.cost, *track) < *best {
                    *best = (candidate.cost, *track);
                }
            }
        }
        // A track and a Gaussian that are each other's best candidate precede all other candidates of both, so they are
        // linked without sorting.
        for (track, candidates) in candidates_by_track {
            if let Some(first) = candidates.iter().next().filter(|first| best[first.gaussian as usize].1 == *track) {
                self.link(*track, first.gaussian);
            }
        }
        let mut left = Vec::new();
        for (track, candidates) in candidates_by_track {
            let free = candidates.iter().filter(|candidate| self.is_free(*track, candidate.gaussian));
            left.extend(free.map(|candidate| (candidate.cost, *track, candidate.gaussian)));
        }
        left.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        for (_, track, gaussian) in left {
            if self.is_free(track, gaussian) {
                self.link(track, gaussian);
            }
        }
    }
}
