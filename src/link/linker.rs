//! Frames one after the other, and the tracks that go through them.

use std::mem::size_of;

use rayon::prelude::*;

use super::grid::Grid;
use super::look::Look;
use crate::model::Gaussians;

/// Frames that a track may be missing from before it ends.
pub const GAP: u32 = 3;
/// Gaussians that a track may go on as.
const NAMED: usize = 4;
/// Of fewer, those that go on tell nothing of a cut.
const FEWEST: usize = 16;
/// Most that speed adds to how far a Gaussian may be from where it is expected, in sizes.
const MOST_FROM_SPEED: f32 = 3.0;
const NONE: u32 = u32::MAX;

/// Rounds of linking, each of what the one before left.
pub(super) const ROUNDS: [Round; 3] = [
    Round { reach: 0.25, strictness: 4.0, missing: false },
    Round { reach: 1.0, strictness: 1.0, missing: true },
    Round { reach: 4.0, strictness: 4.0, missing: true },
];

/// r and q of the [module](super), and whether tracks take part that were not in the frame before.
pub(super) struct Round {
    pub(super) reach: f32,
    pub(super) strictness: f32,
    pub(super) missing: bool,
}

/// Links frames that come one after the other.
#[derive(Default)]
pub struct Linker {
    /// Those that may go on, by their numbers.
    tracks: Vec<Track>,
    born: u32,
}

/// A track that may go on.
#[derive(Clone, Copy)]
pub(super) struct Track {
    number: u32,
    /// Frames since it was seen: 1 for one of the frame before.
    pub(super) ago: u32,
    /// Scene units per frame; none before its first step.
    velocity: Option<[f32; 3]>,
    pub(super) look: Look,
}

/// What became of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Linked {
    /// The track of every Gaussian.
    pub tracks: Vec<u32>,
    /// How many go on by repeating to the bit.
    pub repeated: usize,
    /// How many go on in all.
    pub linked: usize,
    /// Whether the frame before shows something else, so that nothing goes on.
    pub is_cut: bool,
}

/// What going on as a Gaussian costs.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct Offer {
    pub(super) cost: f32,
    pub(super) point: u32,
}

impl Linker {
    /// Bytes for each Gaussian of the frame that is linked, beside the frame.
    pub const BYTES_PER_GAUSSIAN: usize = 3 * size_of::<Look>() + 9 * size_of::<u32>();
    /// Bytes for each track that may go on.
    pub const BYTES_PER_TRACK: usize = size_of::<Track>() + 2 * size_of::<u32>() + NAMED * size_of::<Offer>();

    /// How many tracks there are so far.
    pub fn tracks(&self) -> u32 {
        self.born
    }

    /// Links the next frame. The same for any number of threads.
    pub fn link(&mut self, state: &Gaussians) -> Linked {
        let looks = Look::of_all(state);
        let mut links = Links { of_track: vec![NONE; self.tracks.len()], of_point: vec![NONE; looks.len()] };
        links.take_repeats(&self.tracks, &looks);
        let repeated = links.count();
        for round in &ROUNDS {
            links.take(&self.tracks, &looks, round);
        }
        let before = self.tracks.iter().filter(|track| track.ago == 1).count();
        let fewer = before.min(looks.len());
        let is_cut = fewer >= FEWEST && 4 * links.count() < fewer;
        if is_cut {
            self.tracks.clear();
            links = Links { of_track: Vec::new(), of_point: vec![NONE; looks.len()] };
        }
        let linked = links.count();
        let tracks = self.go_on(&links, &looks);
        Linked { tracks, repeated: if is_cut { 0 } else { repeated }, linked, is_cut }
    }

    /// Moves the tracks on by a frame; gives that of every Gaussian.
    fn go_on(&mut self, links: &Links, looks: &[Look]) -> Vec<u32> {
        let mut of_points = vec![NONE; looks.len()];
        for (track, &point) in self.tracks.iter_mut().zip(&links.of_track) {
            if point == NONE {
                track.ago += 1;
            } else {
                of_points[point as usize] = track.number;
                track.see(looks[point as usize]);
            }
        }
        self.tracks.retain(|track| track.ago <= GAP + 1);
        for (point, of_point) in of_points.iter_mut().enumerate().filter(|(_, track)| **track == NONE) {
            *of_point = self.born;
            self.tracks.push(Track { number: self.born, ago: 1, velocity: None, look: looks[point] });
            self.born += 1;
        }
        of_points
    }
}

impl Track {
    /// Where it is expected.
    fn expected(&self) -> [f32; 3] {
        let velocity = self.velocity.unwrap_or_default();
        std::array::from_fn(|c| self.look.position[c] + self.ago as f32 * velocity[c])
    }

    /// u of the [module](super): what a distance is counted in.
    fn unit(&self) -> f32 {
        let speed = self.velocity.unwrap_or_default().iter().map(|v| v * v).sum::<f32>().sqrt();
        self.look.size + (0.5 * self.ago as f32 * speed).min(MOST_FROM_SPEED * self.look.size)
    }

    /// What going on as `look` costs.
    pub(super) fn cost(&self, look: &Look, round: &Round) -> f32 {
        let (expected, unit) = (self.expected(), round.reach * self.unit());
        let distance: f32 = (0..3).map(|c| (look.position[c] - expected[c]).powi(2)).sum();
        distance / (unit * unit) + round.strictness * self.look.unlike(look)
    }

    fn see(&mut self, look: Look) {
        let step: [f32; 3] = std::array::from_fn(|c| (look.position[c] - self.look.position[c]) / self.ago as f32);
        self.velocity = Some(match self.velocity {
            None => step,
            Some(velocity) => std::array::from_fn(|c| 0.5 * (velocity[c] + step[c])),
        });
        (self.look, self.ago) = (look, 1);
    }

    /// The Gaussians it may go on as.
    fn offers(&self, grid: &Grid, round: &Round) -> Offers {
        let mut offers = Offers { best: [Offer { cost: f32::INFINITY, point: NONE }; NAMED] };
        grid.near(&self.look, self.expected(), round.reach * self.unit(), |point, look| {
            let cost = self.cost(look, round);
            if cost <= 1.0 {
                offers.add(Offer { cost, point });
            }
        });
        offers
    }
}

/// The cheapest offers of a track, in order.
struct Offers {
    best: [Offer; NAMED],
}

impl Offers {
    fn add(&mut self, offer: Offer) {
        let comes_before = |other: &Offer| (other.cost, other.point) < (offer.cost, offer.point);
        let place = self.best.iter().take_while(|other| comes_before(other)).count();
        if place < NAMED {
            self.best[place..].rotate_right(1);
            self.best[place] = offer;
        }
    }

    fn iter(&self) -> impl Iterator<Item = &Offer> {
        self.best.iter().take_while(|offer| offer.point != NONE)
    }
}

/// Which track goes on as which Gaussian.
struct Links {
    of_track: Vec<u32>,
    of_point: Vec<u32>,
}

impl Links {
    fn count(&self) -> usize {
        self.of_track.iter().filter(|&&point| point != NONE).count()
    }

    fn link(&mut self, track: u32, point: u32) {
        (self.of_track[track as usize], self.of_point[point as usize]) = (point, track);
    }

    fn is_free(&self, track: u32, point: u32) -> bool {
        self.of_track[track as usize] == NONE && self.of_point[point as usize] == NONE
    }

    /// Links what is repeated to the bit, in order.
    fn take_repeats(&mut self, tracks: &[Track], looks: &[Look]) {
        let buckets = (2 * looks.len()).next_power_of_two();
        let bucket = |look: &Look| look.bits as usize & (buckets - 1);
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

    /// Links what a round does, of what is left.
    fn take(&mut self, tracks: &[Track], looks: &[Look], round: &Round) {
        let takes_part = |track: &Track| round.missing || track.ago == 1;
        let free =
            |links: &[u32]| -> Vec<u32> { (0..links.len() as u32).filter(|&i| links[i as usize] == NONE).collect() };
        let (points, mut left) = (free(&self.of_point), free(&self.of_track));
        left.retain(|&track| takes_part(&tracks[track as usize]));
        if points.is_empty() || left.is_empty() {
            return;
        }
        let grid = Grid::new(looks, &points, round.reach);
        let offers = |&track: &u32| (track, tracks[track as usize].offers(&grid, round));
        let named: Vec<(u32, Offers)> = left.par_iter().with_min_len(1024).map(offers).collect();
        self.settle(&named);
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
