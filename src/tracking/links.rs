//! Which track goes on as which Gaussian of a frame.

use rayon::prelude::*;

use super::grid::CellGrid;
use super::look::ComparedAppearance;
use super::track::{NONE, Offers, OpenTrack, Round};

/// Most times that all tracks are asked whether they would exchange.
const EXCHANGES: usize = 4;

/// Which track goes on as which Gaussian.
pub(super) struct Links {
    /// Gaussian of every track, and track of every Gaussian; none of what is not linked.
    pub(super) of_track: Vec<u32>,
    pub(super) of_point: Vec<u32>,
}

impl Links {
    pub(super) fn count(&self) -> usize {
        self.of_track.iter().filter(|&&point| point != NONE).count()
    }

    fn link(&mut self, track: u32, point: u32) {
        (self.of_track[track as usize], self.of_point[point as usize]) = (point, track);
    }

    /// Undoes what a track is linked to, which is given.
    pub(super) fn undo(&mut self, track: u32) -> u32 {
        let point = std::mem::replace(&mut self.of_track[track as usize], NONE);
        self.of_point[point as usize] = NONE;
        point
    }

    fn is_free(&self, track: u32, point: u32) -> bool {
        self.of_track[track as usize] == NONE && self.of_point[point as usize] == NONE
    }

    /// Links what is repeated to the bit, in order.
    pub(super) fn take_repeats(&mut self, tracks: &[OpenTrack], looks: &[ComparedAppearance]) {
        let buckets = (2 * looks.len()).next_power_of_two();
        let bucket = |look: &ComparedAppearance| look.bits as usize & (buckets - 1);
        let mut starts = vec![0u32; buckets + 1];
        looks.iter().for_each(|look| starts[bucket(look) + 1] += 1);
        (0..buckets).for_each(|at| starts[at + 1] += starts[at]);
        let mut next = starts.clone();
        let mut order = vec![0u32; looks.len()];
        for (point, look) in looks.iter().enumerate() {
            let to = &mut next[bucket(look)];
            order[*to as usize] = point as u32;
            *to += 1;
        }
        // From here on: the first of each bucket that is not linked.
        next.copy_from_slice(&starts);
        for (number, track) in tracks.iter().enumerate() {
            let at = bucket(&track.look);
            let is_free = |point: u32| self.of_point[point as usize] == NONE;
            while next[at] < starts[at + 1] && !is_free(order[next[at] as usize]) {
                next[at] += 1;
            }
            let left = &order[next[at] as usize..starts[at + 1] as usize];
            let same = |point: u32| is_free(point) && looks[point as usize].bits == track.look.bits;
            if let Some(&point) = left.iter().find(|&&point| same(point)) {
                self.link(number as u32, point);
            }
        }
    }

    /// Links what a round does, of what is left; gives what each track may have gone on as.
    pub(super) fn take(
        &mut self,
        tracks: &[OpenTrack],
        looks: &[ComparedAppearance],
        round: &Round,
    ) -> Vec<(u32, Offers)> {
        let takes_part = |track: &OpenTrack| track.ago == 1 || (round.missing && !track.is_succeeded);
        let free =
            |links: &[u32]| -> Vec<u32> { (0..links.len() as u32).filter(|&i| links[i as usize] == NONE).collect() };
        let (points, mut left) = (free(&self.of_point), free(&self.of_track));
        left.retain(|&track| takes_part(&tracks[track as usize]));
        if points.is_empty() || left.is_empty() {
            return Vec::new();
        }
        let grid = CellGrid::new(looks, &points, round.reach);
        let offers = |&track: &u32| (track, tracks[track as usize].offers(&grid, round));
        let named: Vec<(u32, Offers)> = left.par_iter().with_min_len(1024).map(offers).collect();
        self.settle(&named);
        let cost = |track: u32, point: u32| tracks[track as usize].cost(&looks[point as usize], round);
        let mut passes = 0..EXCHANGES;
        while passes.next().is_some() && self.exchange(&named, cost) {}
        named
    }

    /// Lets two tracks that would cost less together exchange their Gaussians, in the order of the tracks; gives whether
    /// any have.
    fn exchange(&mut self, named: &[(u32, Offers)], cost: impl Fn(u32, u32) -> f32) -> bool {
        let mut any = false;
        for (track, offers) in named {
            for offer in offers.iter() {
                let (own, other) = (self.of_track[*track as usize], self.of_point[offer.point as usize]);
                if own == NONE || other == NONE || other == *track {
                    continue;
                }
                let theirs = cost(other, own);
                if theirs <= 1.0 && offer.cost + theirs < cost(*track, own) + cost(other, offer.point) {
                    self.link(*track, offer.point);
                    self.link(other, own);
                    any = true;
                }
            }
        }
        any
    }

    /// Takes offers by cost, then track, then Gaussian.
    fn settle(&mut self, named: &[(u32, Offers)]) {
        let mut best = vec![(f32::INFINITY, NONE); self.of_point.len()];
        for (track, offers) in named {
            for offer in offers.iter() {
                let best = &mut best[offer.point as usize];
                if (offer.cost, *track) < *best {
                    *best = (offer.cost, *track);
                }
            }
        }
        // Those that are best for one another come before all others of both: no need to sort them.
        for (track, offers) in named {
            if let Some(first) = offers.iter().next().filter(|first| best[first.point as usize].1 == *track) {
                self.link(*track, first.point);
            }
        }
        let mut left = Vec::new();
        for (track, offers) in named {
            let free = offers.iter().filter(|offer| self.is_free(*track, offer.point));
            left.extend(free.map(|offer| (offer.cost, *track, offer.point)));
        }
        left.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        for (_, track, point) in left {
            if self.is_free(track, point) {
                self.link(track, point);
            }
        }
    }
}
