//! Correspondence of Gaussians between frames that do not share Gaussian ids.
//!
//! Input: frames in order, each with any number of Gaussians in any order. Output: for every Gaussian the number of a
//! *track*, which is one Gaussian followed through the frames. Memory: [`Linker::BYTES_PER_GAUSSIAN`] for every
//! Gaussian of the frame that is being linked, and [`Linker::BYTES_PER_TRACK`] for every open track. A track is open if
//! it had a Gaussian in this frame or in one of the [`MAX_GAP_FRAMES`] frames before it. Time: linear in the number of
//! Gaussians, wherever they lie.
//!
//! The appearance of a Gaussian is its position x, its size s (the root mean square of its three scales), its shape Ŝ
//! (the covariance divided by its trace), its opacity α and its base color c. A track last seen n frames ago has the
//! expected position p = x + n·v. Its velocity v per frame is its first step, and after each later step half of the old
//! velocity plus half of the last step.
//!
//! 1. *Repeats.* A Gaussian that equals the last one of a track bit by bit (position, rotation, scales, opacity, base
//!    color) continues the track. Among equal ones, the k-th Gaussian continues the k-th track.
//! 2. *Cost of a link.* The cost that Gaussian b continues track a is
//!    |x_b − p_a|² / (r·u)² + q·A, with u = s_a + min(½·n·|v_a|, 3·s_a) and
//!    A = (ln s_b/s_a / ln √2)² + ‖Ŝ_b − Ŝ_a‖² / ¼² + (α_b − α_a)² / ½² + |c_b − c_a|² / 0.1².
//!    A link is possible only if its cost is at most 1. The candidates of a track are the four Gaussians of least cost;
//!    ties are broken by their number. Candidates are linked in the order of cost, then track, then Gaussian, each
//!    track and each Gaussian once. (Linking those that are mutually best until none are left gives the same result.)
//!    Then two tracks exchange their Gaussians if that lowers their total cost, in the order of the tracks and of their
//!    candidates, in up to four rounds.
//! 3. *Rounds.* The first round of linking has r = ¼ and q = 4 and includes only tracks with a Gaussian in the previous
//!    frame. The second has r = 1 and q = 1, the third r = 4 and q = 4; both include all open tracks that are not
//!    linked yet. A track of the previous frame is *succeeded* if it is missing although a Gaussian at its expected
//!    position looks like it: if |x_b − p_a|² / (¼·min(s_a, s_b))² + A ≤ 1, where A excludes opacity. From then on it
//!    continues by rule 1 only, and no track that begins later is joined to it (rule 6).
//! 4. *Doubtful links.* The probability that a link is wrong is the larger of two estimates. *Rivals:* R⁵ / (1 + R⁵),
//!    where R is the cost of the link and of a rival link, divided by their cost with the Gaussians exchanged. R is the
//!    largest over all other candidates of the link's track and all other tracks with the link's Gaussian as a
//!    candidate. The estimate is ½ if an exchange makes no difference, and it agrees with the error rate in trained
//!    models whose links are known. Near-duplicates are no rivals: |x_b − x_a|² / (¼·min(s_a, s_b))² + 4·A ≤ 1, where A
//!    excludes opacity. They cannot be told apart, and if one fades out while the other fades in they are one Gaussian.
//!    *Unrelated Gaussians:* ¼·k·C^{3/2}, at most ½, for a link of cost C, where k is the mean number of surplus
//!    candidates of the linked tracks of the round. Of unrelated, evenly spread Gaussians, k·C^{3/2} are expected to
//!    have a cost of at most C; ¼ is the assumed probability that the track's own Gaussian is absent. The least certain
//!    links are dropped and their Gaussians begin new tracks, until at most one of 200 remaining links is expected to
//!    be wrong ([`FrameLinks::doubtful`]).
//! 5. *Cuts.* Let N be the smaller one of the numbers of Gaussians in this frame and in the previous one. If N is at
//!    least 16, and fewer than N/4 Gaussians are linked, everything has moved at once. This is a cut, at which all
//!    tracks end.
//! 6. *Joined tracks* ([`Joiner`]). Two tracks may be parts of one Gaussian that fades out as one and fades in as the
//!    other. A track that begins is paired with the four earlier tracks of least cost
//!    |x_b − x_a|² / (r·min(s_a, s_b))² + q·A, where A excludes opacity. The cost must be at most 1, the sizes must
//!    agree within a factor of √2, and the earlier track must not be succeeded. There are two rules: r = 4 and q = 1/16
//!    (*alike*), and r = q = 1 (*close*). A track that began because its link was doubtful (rule 4) is only paired with
//!    close tracks. Each pair has an overlap score: a frame with both tracks adds 1, a frame without one of them
//!    subtracts 1, down to 0. A pair is dropped if its score exceeds 4, or if the rule does not hold in a frame with
//!    both tracks. When the earlier track of the cheapest pair has ended, the later track is joined to it. Joins are
//!    made in the order of cost. Each track is joined to at most one earlier track, and at most one later track is
//!    joined to it. A later track that ends while the earlier one continues was a part of it if they were close. Tracks
//!    of one joined track that are present together are [blended](blend_rows).
//!
//! Tracks are numbered in the order in which they begin; tracks that begin in one frame, in the order of their
//! Gaussians. A Gaussian with a NaN is never compared: it continues a track only as an exact repeat. Colors are
//! compared without the higher SH degrees, which rotate with the Gaussian.
//!
//! Gaussians are found with one grid for every octave of sizes. In a cell with more than 64 Gaussians, only the 64 of
//! the nearest brightness are compared, so thousands at one place cost no more than elsewhere.

mod appearance;
mod confidence;
mod grid;
mod identity;
mod join;
mod linker;
mod links;
mod track;

pub use identity::{OrderDifference, compare_order};
pub use join::{Joiner, blend_rows};
pub use linker::{FrameLinks, Linker, MAX_GAP_FRAMES};

#[cfg(test)]
mod oracle;
#[cfg(test)]
mod tests;
