//! Which Gaussian of one frame is which of the next, where the frames themselves do not say.
//!
//! In: frames one after the other, of any number of Gaussians in any order. Out: for every Gaussian the number of its
//! *track*. Memory: the frame that is being linked, [`Linker::BYTES_PER_GAUSSIAN`] each, and
//! [`Linker::BYTES_PER_TRACK`] for every track that was seen within the last [`GAP`] frames and in this one.
//! Time: linear in the number of Gaussians, however they lie.
//!
//! A Gaussian is compared by its position x, its size s, the root mean square of its three scales, its shape Ŝ, the
//! covariance over its trace, its opacity α and its base color c. A track, last seen n frames ago, is expected at
//! p = x + n·v, with v its velocity per frame: its first step, then half of the old one and half of the last step.
//!
//! 1. What is repeated to the bit (position, rotation, scales, opacity, base color) is the same, the k-th of equal tracks
//!    the k-th of equal Gaussians.
//! 2. The cost that Gaussian b goes on with track a is
//!    |x_b − p_a|² / (r·u)² + q·A, with u = s_a + min(½·n·|v_a|, 3·s_a) and
//!    A = (ln s_b/s_a / ln √2)² + ‖Ŝ_b − Ŝ_a‖² / ¼² + (α_b − α_a)² / ½² + |c_b − c_a|² / 0.1².
//!    It goes on with it only if that is at most 1. Each track names the four Gaussians that cost least, ties by their
//!    number; those are taken by cost, then track, then Gaussian, each track and each Gaussian once, which is the same
//!    as to take those that are best for one another until none are left. Then two tracks that would cost less together
//!    exchange their Gaussians, in the order of the tracks and of what they named, four times over.
//! 3. First with r = ¼ and q = 4, tracks of the frame before alone; of what is left with r = 1 and q = 1, all tracks; then
//!    with r = 4 and q = 4. A track of the frame before that is missed while a Gaussian is where it is expected and looks
//!    like it, |x_b − p_a|² / (¼·min(s_a, s_b))² + A ≤ 1 without opacities, was succeeded by that: from then on it goes on by
//!    rule 1 alone, and not as a neighbor that begins anew in these frames.
//! 4. A link is wrong with the larger chance of two. By rivals: R⁵ / (1 + R⁵), where R is what it and a rival cost, over
//!    what they would cost the other way round, the largest of all that its track named instead and all that named its
//!    Gaussian; ½ where that makes no difference, and about what is found in trained models whose links are known. Twins
//!    are no rivals: |x_b − x_a|² / (¼·min(s_a, s_b))² + 4·A ≤ 1, opacities aside. Which of them is which nobody sees, and
//!    where one fades out while the other fades in they are one.
//!    By strangers: ¼·k·C^{3/2}, at most ½, for a cost C where tracks name k Gaussians too many in the mean of the round: of
//!    strangers that lie evenly so many cost as little. The least likely links are given up, and begin new tracks, until of
//!    those left no more than one in two hundred is expected to be wrong ([`FrameLinks::doubtful`]).
//! 5. Where less than a quarter goes on, of at least 16, everything has moved at once: a cut, at which all tracks end.
//! 6. Lives that are one ([`Joiner`]). A track that begins where another is, or would be, that was not succeeded names the
//!    four that cost least by |x_b − x_a|² / (r·min(s_a, s_b))² + q·A without opacities, at most 1, with r = 4 and q = 1/16
//!    (alike) or r = q = 1 (close), and sizes within a factor of √2; one that began as nobody could tell which goes on as it
//!    only such as are close. Both may be there together for four frames, in each of which that holds: one fades out while
//!    the other fades in; and for as many more as one was away of them before. When the cheapest that is left has ended, the
//!    track goes on from it, by cost, each end and each beginning once. A track that ends within these frames while the
//!    other goes on was part of it, if they were close. Where several tracks of a life are there together they are
//!    [blended](blend).
//!
//! Tracks are numbered by their births, those of one frame by its order. What is not a number is never compared: it goes on
//! if it is repeated only. Colors are compared without harmonics, which turn with the Gaussian.
//!
//! Gaussians are found by cells of a grid for every octave of sizes. In a cell of more than 64 only 64 are looked at,
//! those of the nearest brightness, so that thousands at one place cost no more than elsewhere.

mod grid;
mod identity;
mod join;
mod linker;
mod links;
mod look;
mod track;
mod trust;

pub use identity::{OrderDifference, identity};
pub use join::{Joiner, blend};
pub use linker::{FrameLinks, GAP, Linker};

#[cfg(test)]
mod tests;
