//! Estimates for each link between a track (Gaussian followed through frames) and a Gaussian the probability that it is
//! wrong, and removes doubtful links.

use super::appearance::ComparedAppearance;
use super::links::Links;
use super::track::{Candidates, NONE, OpenTrack, Round};

/// Maximum expected fraction of wrong links among the links of a frame. If more are expected to be wrong, the least
/// certain links are removed.
pub(super) const MAX_WRONG: f64 = 0.005;
/// Cost that is added to the numerator and to the denominator of each ratio of link costs (distance and difference in
/// appearance of linked Gaussians). Costs far below this value thus count as equal, and 0/0 cannot arise.
const COST_TOLERANCE: f32 = 1e-6;
/// Assumed probability that the Gaussian of a track (Gaussian followed through frames) is absent from a frame, although
/// an unrelated one lies within reach.
const ABSENCE_PROBABILITY: f32 = 0.25;

/// Estimates of how many of a frame's links between tracks (Gaussians followed through frames) and Gaussians are wrong.
pub(super) struct LinkConfidence {
    /// Expected number of wrong links: the sum of the probabilities that a link is wrong.
    expected_wrong: f64,
    /// Probability and track number of each link that is wrong with a probability above [`MAX_WRONG`].
    doubtful: Vec<(f32, u32)>,
    /// For each track (Gaussian followed through frames), a ratio R that measures how doubtful its link to a Gaussian
    /// of the frame is: the larger R, the more likely the link is wrong.
    ///
    /// A rival is another Gaussian that could continue the track, or another track that could continue with its
    /// Gaussian. R is the cost (distance and difference in appearance) of the links as made, divided by their cost
    /// after an exchange: the track gets the rival Gaussian, or the rival track gets its Gaussian. With several rivals,
    /// the largest R counts. Without a rival, R is 0.
    ratios: Vec<f32>,
}

impl LinkConfidence {
    pub(super) fn new(tracks: usize) -> LinkConfidence {
        LinkConfidence { expected_wrong: 0.0, doubtful: Vec::new(), ratios: vec![0.0; tracks] }
    }

    /// Updates the estimates by the links that one round of linking has made between tracks (Gaussians followed through
    /// frames) and Gaussians.
    ///
    /// - `candidates_by_track`: for each track that took part in the round, the Gaussians that might have continued it.
    /// - `tracks` and `appearances`: all open tracks, and the appearances of all Gaussians of the frame.
    /// - `round`: parameters of the round, which determine the costs of links.
    pub(super) fn add_round(
        &mut self,
        links: &Links,
        candidates_by_track: &[(u32, Candidates)],
        (tracks, appearances): (&[OpenTrack], &[ComparedAppearance]),
        round: &Round,
    ) {
        let cost =
            |track: u32, gaussian: u32| tracks[track as usize].cost(&appearances[gaussian as usize], round).min(1.0);
        let (mut linked, mut surplus) = (Vec::with_capacity(candidates_by_track.len()), 0);
        for (track, candidates) in candidates_by_track {
            let own = links.gaussian_of_track[*track as usize];
            let own_cost = if own == NONE { 0.0 } else { cost(*track, own) };
            let others = candidates.iter().filter(|candidate| candidate.gaussian != own);
            if own != NONE {
                linked.push((*track, own_cost));
                surplus += others.clone().count();
            }
            for candidate in others {
                let other = links.track_of_gaussian[candidate.gaussian as usize];
                let are_duplicate_tracks =
                    |a: u32, b: u32| tracks[a as usize].appearance.is_near_duplicate(&tracks[b as usize].appearance);
                let are_duplicates =
                    |a: u32, b: u32| appearances[a as usize].is_near_duplicate(&appearances[b as usize]);
                if (other != NONE && are_duplicate_tracks(*track, other))
                    || (own != NONE && are_duplicates(own, candidate.gaussian))
                {
                    continue;
                }
                let now = own_cost + if other == NONE { 0.0 } else { cost(other, candidate.gaussian) };
                let swapped = candidate.cost + if own == NONE || other == NONE { 0.0 } else { cost(other, own) };
                let ratio = (now + COST_TOLERANCE) / (swapped + COST_TOLERANCE);
                for (track, gaussian) in [(*track, own), (other, candidate.gaussian)] {
                    if track != NONE && gaussian != NONE {
                        let most = &mut self.ratios[track as usize];
                        *most = most.max(ratio);
                    }
                }
            }
        }
        let mean_surplus = surplus as f32 / linked.len().max(1) as f32;
        for (track, cost) in linked {
            let ratio = self.ratios[track as usize];
            let fifth = ratio * ratio * ratio * ratio * ratio;
            let probability =
                (ABSENCE_PROBABILITY * mean_surplus * cost * cost.sqrt()).min(0.5).max(fifth / (1.0 + fifth));
            self.expected_wrong += f64::from(probability);
            if f64::from(probability) > MAX_WRONG {
                self.doubtful.push((probability, track));
            }
        }
    }

    /// Removes the least certain links until at most the fraction [`MAX_WRONG`] of the remaining links is expected to
    /// be wrong. Returns the Gaussians whose links were removed.
    pub(super) fn drop_doubtful(mut self, links: &mut Links) -> Vec<u32> {
        self.doubtful.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let count = links.count();
        let mut dropped = Vec::new();
        for (probability, track) in self.doubtful {
            if self.expected_wrong <= MAX_WRONG * (count - dropped.len()) as f64 {
                break;
            }
            dropped.push(links.undo(track));
            self.expected_wrong -= f64::from(probability);
        }
        dropped
    }
}
