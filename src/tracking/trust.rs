//! How likely links are wrong, and which of them are given up.

use super::links::Links;
use super::look::ComparedAppearance;
use super::track::{NONE, Offers, OpenTrack, Round};

/// Part of a frame's links that may be expected to be wrong.
pub(super) const MOST_WRONG: f64 = 0.005;
/// Costs that differ by less are the same.
const SAME: f32 = 1e-6;
/// Chance that a track whose gate holds one stranger is not there itself.
const AWAY: f32 = 0.25;

/// What is expected of the links of a frame.
pub(super) struct LinkConfidence {
    /// Links expected to be wrong.
    wrong: f64,
    /// Those that are likely enough to be, with that chance.
    doubted: Vec<(f32, u32)>,
    /// Of every track that is linked: what it and a rival cost, over what they would cost the other way round, at most.
    ratios: Vec<f32>,
}

impl LinkConfidence {
    pub(super) fn new(tracks: usize) -> LinkConfidence {
        LinkConfidence { wrong: 0.0, doubted: Vec::new(), ratios: vec![0.0; tracks] }
    }

    /// Takes in what a round has linked, of those that it had `named` Gaussians for.
    pub(super) fn weigh(
        &mut self,
        links: &Links,
        named: &[(u32, Offers)],
        (tracks, looks): (&[OpenTrack], &[ComparedAppearance]),
        round: &Round,
    ) {
        let cost = |track: u32, point: u32| tracks[track as usize].cost(&looks[point as usize], round).min(1.0);
        let (mut linked, mut strangers) = (Vec::with_capacity(named.len()), 0);
        for (track, offers) in named {
            let own = links.of_track[*track as usize];
            let own_cost = if own == NONE { 0.0 } else { cost(*track, own) };
            let others = offers.iter().filter(|offer| offer.point != own);
            if own != NONE {
                linked.push((*track, own_cost));
                strangers += others.clone().count();
            }
            for offer in others {
                let other = links.of_point[offer.point as usize];
                let of_tracks = |a: u32, b: u32| tracks[a as usize].look.is_near_duplicate(&tracks[b as usize].look);
                let of_points = |a: u32, b: u32| looks[a as usize].is_near_duplicate(&looks[b as usize]);
                if (other != NONE && of_tracks(*track, other)) || (own != NONE && of_points(own, offer.point)) {
                    continue;
                }
                let now = own_cost + if other == NONE { 0.0 } else { cost(other, offer.point) };
                let swapped = offer.cost + if own == NONE || other == NONE { 0.0 } else { cost(other, own) };
                let ratio = (now + SAME) / (swapped + SAME);
                for (track, point) in [(*track, own), (other, offer.point)] {
                    if track != NONE && point != NONE {
                        let most = &mut self.ratios[track as usize];
                        *most = most.max(ratio);
                    }
                }
            }
        }
        let crowd = strangers as f32 / linked.len().max(1) as f32;
        for (track, cost) in linked {
            let ratio = self.ratios[track as usize];
            let fifth = ratio * ratio * ratio * ratio * ratio;
            let chance = (AWAY * crowd * cost * cost.sqrt()).min(0.5).max(fifth / (1.0 + fifth));
            self.wrong += f64::from(chance);
            if f64::from(chance) > MOST_WRONG {
                self.doubted.push((chance, track));
            }
        }
    }

    /// Undoes the least likely links until of those left no more are expected to be wrong; gives their Gaussians.
    pub(super) fn give_up(mut self, links: &mut Links) -> Vec<u32> {
        self.doubted.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let count = links.count();
        let mut given_up = Vec::new();
        for (chance, track) in self.doubted {
            if self.wrong <= MOST_WRONG * (count - given_up.len()) as f64 {
                break;
            }
            given_up.push(links.undo(track));
            self.wrong -= f64::from(chance);
        }
        given_up
    }
}
