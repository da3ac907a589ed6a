//! A track that may go on, and what it may go on as.

use super::grid::CellGrid;
use super::look::ComparedAppearance;

/// Gaussians that a track may go on as.
pub(super) const NAMED: usize = 4;
/// Most that speed adds to how far a Gaussian may be from where it is expected, in sizes.
const MOST_FROM_SPEED: f32 = 3.0;
/// No track, no Gaussian.
pub(super) const NONE: u32 = u32::MAX;

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

/// A track that may go on.
#[derive(Clone, Copy)]
pub(super) struct OpenTrack {
    pub(super) number: u32,
    /// Frames since it was seen: 1 for one of the frame before.
    pub(super) ago: u32,
    /// Scene units per frame; none before its first step.
    pub(super) velocity: Option<[f32; 3]>,
    pub(super) look: ComparedAppearance,
    /// Whether it has begun as nobody could tell which track goes on as it.
    pub(super) is_in_doubt: bool,
    /// Whether another was where it was expected when it was missed first: only as what it was to the bit it goes on.
    pub(super) is_succeeded: bool,
}

/// What going on as a Gaussian costs.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct Offer {
    pub(super) cost: f32,
    pub(super) point: u32,
}

impl OpenTrack {
    /// One that begins.
    pub(super) fn begin(number: u32, look: ComparedAppearance) -> OpenTrack {
        OpenTrack { number, ago: 1, velocity: None, look, is_in_doubt: false, is_succeeded: false }
    }

    /// Where it is expected.
    pub(super) fn expected(&self) -> [f32; 3] {
        let velocity = self.velocity.unwrap_or_default();
        std::array::from_fn(|c| self.look.position[c] + self.ago as f32 * velocity[c])
    }

    /// u of the [module](super): what a distance is counted in.
    fn unit(&self) -> f32 {
        let speed = self.velocity.unwrap_or_default().iter().map(|v| v * v).sum::<f32>().sqrt();
        self.look.size + (0.5 * self.ago as f32 * speed).min(MOST_FROM_SPEED * self.look.size)
    }

    /// What going on as `look` costs; more than 1 where that is too much, whatever it is.
    pub(super) fn cost(&self, look: &ComparedAppearance, round: &Round) -> f32 {
        self.cost_at(look, self.expected(), round.reach * self.unit(), round.strictness)
    }

    fn cost_at(&self, look: &ComparedAppearance, expected: [f32; 3], unit: f32, strictness: f32) -> f32 {
        let distance: f32 = (0..3).map(|c| (look.position[c] - expected[c]).powi(2)).sum();
        let apart = distance / (unit * unit);
        // Most of those in its cells are too far away.
        if apart > 1.0 { apart } else { apart + strictness * self.look.unlike(look) }
    }

    /// Where it is, seen or not, in the frame that was linked last.
    pub(super) fn now(&self) -> [f32; 3] {
        let velocity = self.velocity.unwrap_or_default();
        std::array::from_fn(|c| self.look.position[c] + (self.ago - 1) as f32 * velocity[c])
    }

    pub(super) fn see(&mut self, look: ComparedAppearance) {
        let step: [f32; 3] = std::array::from_fn(|c| (look.position[c] - self.look.position[c]) / self.ago as f32);
        self.velocity = Some(match self.velocity {
            None => step,
            Some(velocity) => std::array::from_fn(|c| 0.5 * (velocity[c] + step[c])),
        });
        (self.look, self.ago, self.is_succeeded) = (look, 1, false);
    }

    /// The Gaussians it may go on as.
    pub(super) fn offers(&self, grid: &CellGrid, round: &Round) -> Offers {
        let mut offers = Offers::default();
        let (expected, unit) = (self.expected(), round.reach * self.unit());
        grid.near(&self.look, expected, unit, |point, look| {
            offers.add_within(self.cost_at(look, expected, unit, round.strictness), point);
        });
        offers
    }
}

/// The cheapest offers of a track, in order.
pub(super) struct Offers {
    best: [Offer; NAMED],
}

impl Default for Offers {
    fn default() -> Offers {
        Offers { best: [Offer { cost: f32::INFINITY, point: NONE }; NAMED] }
    }
}

impl Offers {
    /// Takes in what costs 1 at most.
    pub(super) fn add_within(&mut self, cost: f32, point: u32) {
        if cost <= 1.0 {
            self.add(Offer { cost, point });
        }
    }

    fn add(&mut self, offer: Offer) {
        let comes_before = |other: &Offer| (other.cost, other.point) < (offer.cost, offer.point);
        let place = self.best.iter().take_while(|other| comes_before(other)).count();
        if place < NAMED {
            self.best[place..].rotate_right(1);
            self.best[place] = offer;
        }
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Offer> + Clone {
        self.best.iter().take_while(|offer| offer.point != NONE)
    }
}
