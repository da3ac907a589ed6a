//! An open track (one that may continue), and the Gaussians of the next frame that may continue it.

use super::appearance::ComparedAppearance;
use super::grid::CellGrid;

/// Maximum number of Gaussians that are considered as the continuation of a track (Gaussian followed through frames).
pub(super) const MAX_CANDIDATES: usize = 4;
/// Maximum of the term for speed in the length unit u of a track, as a multiple of the size of the track's Gaussian
/// ([`OpenTrack::distance_unit`]). The cost of a link divides the distance between the expected and the actual position
/// by u.
const MAX_SPEED_UNITS: f32 = 3.0;
/// Number that stands for no track (Gaussian followed through frames), or no Gaussian.
pub(super) const NONE: u32 = u32::MAX;

/// Rounds of linking, in order. Each round links only tracks (Gaussians followed through frames) and Gaussians that the
/// previous rounds left without a link.
pub(super) const ROUNDS: [Round; 3] = [
    Round { reach: 0.25, strictness: 4.0, includes_missing: false },
    Round { reach: 1.0, strictness: 1.0, includes_missing: true },
    Round { reach: 4.0, strictness: 4.0, includes_missing: true },
];

/// Parameters of a round of linking tracks (Gaussians followed through frames) to Gaussians. A link is possible if its
/// cost is at most 1; in this cost, `reach` scales the distance and `strictness` the difference in appearance.
/// `includes_missing` states whether tracks without a Gaussian in the previous frame take part.
pub(super) struct Round {
    pub(super) reach: f32,
    pub(super) strictness: f32,
    pub(super) includes_missing: bool,
}

/// Track (Gaussian followed through frames) that may still continue: it had a Gaussian in the frame that was linked
/// last or in one of the [`MAX_GAP_FRAMES`](super::MAX_GAP_FRAMES) frames before that.
#[derive(Clone, Copy)]
pub(super) struct OpenTrack {
    pub(super) number: u32,
    /// Number of frames from the last frame in which the track had a Gaussian to the frame that is linked next: 1 if no
    /// frame lies between them.
    pub(super) frames_since_seen: u32,
    /// Velocity, scene units per frame; `None` until the track has a second Gaussian.
    pub(super) velocity: Option<[f32; 3]>,
    pub(super) appearance: ComparedAppearance,
    /// Whether the track began with a Gaussian whose link to another track was dropped as probably wrong.
    pub(super) is_in_doubt: bool,
    /// Whether another Gaussian took the place of the track's Gaussian: in the first frame without a Gaussian of this
    /// track, a similar Gaussian was at its expected position. The track then continues only with a Gaussian that
    /// equals its last one bit by bit.
    pub(super) is_succeeded: bool,
}

/// Gaussian that may continue a track (Gaussian followed through frames), and the cost of linking it to the track:
/// distance and difference in appearance.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    pub(super) cost: f32,
    pub(super) gaussian: u32,
}

impl OpenTrack {
    /// Creates the track (Gaussian followed through frames) with the number `number`, which begins with a Gaussian of
    /// this appearance.
    pub(super) fn new(number: u32, appearance: ComparedAppearance) -> OpenTrack {
        OpenTrack { number, frames_since_seen: 1, velocity: None, appearance, is_in_doubt: false, is_succeeded: false }
    }

    /// Returns the position where the Gaussian of this track is expected in the next frame, scene units.
    pub(super) fn expected_position(&self) -> [f32; 3] {
        let velocity = self.velocity.unwrap_or_default();
        std::array::from_fn(|c| self.appearance.position[c] + self.frames_since_seen as f32 * velocity[c])
    }

    /// Returns the length unit u = s + min(½·n·|v|, 3·s) of the track, in scene units. The cost of a link divides
    /// distances by u, so fast Gaussians are searched for in a larger region. s is the size of the track's Gaussian, v
    /// its velocity per frame, n the number of frames since it was last seen; 3 is [`MAX_SPEED_UNITS`].
    fn distance_unit(&self) -> f32 {
        let speed = self.velocity.unwrap_or_default().iter().map(|v| v * v).sum::<f32>().sqrt();
        self.appearance.size + (0.5 * self.frames_since_seen as f32 * speed).min(MAX_SPEED_UNITS * self.appearance.size)
    }

    /// Returns the cost of linking the track (Gaussian followed through frames) to a Gaussian of the next frame, which
    /// has the appearance `appearance`: (d/(r·u))² + s·Δ.
    /// - d: distance of the Gaussian from the expected position of the track, scene units;
    /// - u: length unit of the track ([`OpenTrack::distance_unit`]), scene units;
    /// - Δ: difference in appearance;
    /// - r and s: `round.reach` and `round.strictness`. Frames are linked in several rounds, with different values of
    ///   these.
    ///
    /// A link is possible only if the cost is at most 1. If the first term exceeds 1, returns only this term.
    pub(super) fn cost(&self, appearance: &ComparedAppearance, round: &Round) -> f32 {
        self.cost_at(appearance, self.expected_position(), round.reach * self.distance_unit(), round.strictness)
    }

    fn cost_at(&self, appearance: &ComparedAppearance, expected: [f32; 3], distance_unit: f32, strictness: f32) -> f32 {
        let squared_distance: f32 = (0..3).map(|c| (appearance.position[c] - expected[c]).powi(2)).sum();
        let distance = squared_distance / (distance_unit * distance_unit);
        // Most Gaussians in the visited cells are too far away; their difference in appearance is not computed.
        if distance > 1.0 { distance } else { distance + strictness * self.appearance.difference(appearance) }
    }

    /// Returns the position of this track's Gaussian in the frame that was linked last, scene units. The position is
    /// extrapolated by the velocity of the track if the track has no Gaussian in that frame.
    pub(super) fn current_position(&self) -> [f32; 3] {
        let velocity = self.velocity.unwrap_or_default();
        std::array::from_fn(|c| self.appearance.position[c] + (self.frames_since_seen - 1) as f32 * velocity[c])
    }

    /// Continues the track (Gaussian followed through frames) with a Gaussian of the next frame, which has the
    /// appearance `appearance`, and updates the track's velocity.
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

    /// Returns the Gaussians in `grid` that may continue the track (Gaussian followed through frames): up to
    /// [`MAX_CANDIDATES`], with the lowest costs (distance and difference in appearance) by the rules of `round`.
    /// Gaussians with a cost above 1 are left out.
    pub(super) fn candidates(&self, grid: &CellGrid, round: &Round) -> Candidates {
        let mut candidates = Candidates::default();
        let (expected, distance_unit) = (self.expected_position(), round.reach * self.distance_unit());
        grid.for_each_near(&self.appearance, expected, distance_unit, |gaussian, appearance| {
            candidates.add_within(self.cost_at(appearance, expected, distance_unit, round.strictness), gaussian);
        });
        candidates
    }
}

/// Gaussians that may continue a track (Gaussian followed through frames): the [`MAX_CANDIDATES`] Gaussians with the
/// lowest costs (distance and difference in appearance), or fewer, in increasing order of cost.
pub(super) struct Candidates {
    best: [Candidate; MAX_CANDIDATES],
}

impl Default for Candidates {
    fn default() -> Candidates {
        Candidates { best: [Candidate { cost: f32::INFINITY, gaussian: NONE }; MAX_CANDIDATES] }
    }
}

impl Candidates {
    /// Adds the Gaussian with the number `gaussian` to the candidates if its cost (distance and difference in
    /// appearance) is at most 1 and among the [`MAX_CANDIDATES`] lowest costs so far.
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
