//! An open track, and the Gaussians that may continue it.

use super::appearance::ComparedAppearance;
use super::grid::CellGrid;

/// Maximum number of candidates of a track.
pub(super) const MAX_CANDIDATES: usize = 4;
/// Largest term that speed adds to the unit of distance of a track, in sizes.
const MAX_SPEED_UNITS: f32 = 3.0;
/// Number that stands for no track, or no Gaussian.
pub(super) const NONE: u32 = u32::MAX;

/// Rounds of linking. Each round links what the previous ones left free.
pub(super) const ROUNDS: [Round; 3] = [
    Round { reach: 0.25, strictness: 4.0, includes_missing: false },
    Round { reach: 1.0, strictness: 1.0, includes_missing: true },
    Round { reach: 4.0, strictness: 4.0, includes_missing: true },
];

/// Parameters of a round: `reach` is r and `strictness` is q of the [module](super). `includes_missing` states whether
/// tracks that were missing in the previous frame take part.
pub(super) struct Round {
    pub(super) reach: f32,
    pub(super) strictness: f32,
    pub(super) includes_missing: bool,
}

/// Track that may continue.
#[derive(Clone, Copy)]
pub(super) struct OpenTrack {
    pub(super) number: u32,
    /// Number of frames since the track was seen: 1 if it was seen in the previous frame.
    pub(super) frames_since_seen: u32,
    /// Velocity, scene units per frame; `None` before the first step.
    pub(super) velocity: Option<[f32; 3]>,
    pub(super) appearance: ComparedAppearance,
    /// Whether the track began because the link of its first Gaussian was doubtful.
    pub(super) is_in_doubt: bool,
    /// Whether a Gaussian that looks like the track was at its expected position when it was first missing. The track
    /// then continues only with an exact repeat.
    pub(super) is_succeeded: bool,
}

/// Gaussian that may continue a track, and the cost of that link.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    pub(super) cost: f32,
    pub(super) gaussian: u32,
}

impl OpenTrack {
    /// Creates a track that begins with a Gaussian.
    pub(super) fn new(number: u32, appearance: ComparedAppearance) -> OpenTrack {
        OpenTrack { number, frames_since_seen: 1, velocity: None, appearance, is_in_doubt: false, is_succeeded: false }
    }

    /// Returns the expected position in the next frame.
    pub(super) fn expected_position(&self) -> [f32; 3] {
        let velocity = self.velocity.unwrap_or_default();
        std::array::from_fn(|c| self.appearance.position[c] + self.frames_since_seen as f32 * velocity[c])
    }

    /// Returns u of the [module](super), the unit of distance.
    fn distance_unit(&self) -> f32 {
        let speed = self.velocity.unwrap_or_default().iter().map(|v| v * v).sum::<f32>().sqrt();
        self.appearance.size + (0.5 * self.frames_since_seen as f32 * speed).min(MAX_SPEED_UNITS * self.appearance.size)
    }

    /// Returns the cost that a Gaussian with this appearance continues the track. A link is impossible above 1; if the
    /// distance alone costs more than 1, only that cost is returned.
    pub(super) fn cost(&self, appearance: &ComparedAppearance, round: &Round) -> f32 {
        self.cost_at(appearance, self.expected_position(), round.reach * self.distance_unit(), round.strictness)
    }

    fn cost_at(&self, appearance: &ComparedAppearance, expected: [f32; 3], distance_unit: f32, strictness: f32) -> f32 {
        let squared_distance: f32 = (0..3).map(|c| (appearance.position[c] - expected[c]).powi(2)).sum();
        let distance = squared_distance / (distance_unit * distance_unit);
        // Most Gaussians in the visited cells are too far away, so their difference is not computed.
        if distance > 1.0 { distance } else { distance + strictness * self.appearance.difference(appearance) }
    }

    /// Returns the position, observed or extrapolated, in the frame that was linked last.
    pub(super) fn current_position(&self) -> [f32; 3] {
        let velocity = self.velocity.unwrap_or_default();
        std::array::from_fn(|c| self.appearance.position[c] + (self.frames_since_seen - 1) as f32 * velocity[c])
    }

    /// Continues the track with a Gaussian of the next frame, and updates the velocity.
    pub(super) fn extend(&mut self, appearance: ComparedAppearance) {
        let step: [f32; 3] = std::array::from_fn(|c| {
            (appearance.position[c] - self.appearance.position[c]) / self.frames_since_seen as f32
        });
        self.velocity = Some(match self.velocity {
            None => step,
            Some(velocity) => std::array::from_fn(|c| 0.5 * (velocity[c] + step[c])),
        });
        (self.appearance, self.frames_since_seen, self.is_succeeded) = (appearance, 1, false);
    }

    /// Returns the Gaussians that may continue the track.
    pub(super) fn candidates(&self, grid: &CellGrid, round: &Round) -> Candidates {
        let mut candidates = Candidates::default();
        let (expected, distance_unit) = (self.expected_position(), round.reach * self.distance_unit());
        grid.for_each_near(&self.appearance, expected, distance_unit, |gaussian, appearance| {
            candidates.add_within(self.cost_at(appearance, expected, distance_unit, round.strictness), gaussian);
        });
        candidates
    }
}

/// Candidates of least cost of a track, in the order of cost.
pub(super) struct Candidates {
    best: [Candidate; MAX_CANDIDATES],
}

impl Default for Candidates {
    fn default() -> Candidates {
        Candidates { best: [Candidate { cost: f32::INFINITY, gaussian: NONE }; MAX_CANDIDATES] }
    }
}

impl Candidates {
    /// Adds a Gaussian if its cost is at most 1.
    pub(super) fn add_within(&mut self, cost: f32, gaussian: u32) {
        if cost <= 1.0 {
            self.add(Candidate { cost, gaussian });
        }
    }

    fn add(&mut self, candidate: Candidate) {
        let comes_before = |other: &Candidate| (other.cost, other.gaussian) < (candidate.cost, candidate.gaussian);
        let index = self.best.iter().take_while(|other| comes_before(other)).count();
        if index < MAX_CANDIDATES {
            self.best[index..].rotate_right(1);
            self.best[index] = candidate;
        }
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Candidate> + Clone {
        self.best.iter().take_while(|candidate| candidate.gaussian != NONE)
    }
}
