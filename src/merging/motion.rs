//! Test 3 of merging: whether two Gaussians move alike while both are alive (visible by opacity), measured frame by
//! frame.
//!
//! Input: pairs of nodes (Gaussians or merged groups), then at each frame the position of every node and whether it is
//! alive. Output: one [`RelativeMotion`] per pair, which depends on no threshold. [`MotionThresholds::similarity`]
//! turns it into the motion similarity, which merging passes compare with their minimum τ_m. Memory: [`PAIR_BYTES`] per
//! pair and [`NODE_BYTES`] per node, whatever the number of frames. Each pair is summed by one thread in frame order,
//! so the thread count does not change the sums.

use glam::DVec3;
use rayon::prelude::*;

use super::appearance::COSINE_EPSILON;
use crate::recipe::{self, MotionParams, MotionSimilarity};

/// Bytes of memory that [`PairMotionAccumulator`] takes for each pair of nodes whose motion it measures.
pub const PAIR_BYTES: usize = size_of::<NodePair>();
/// Bytes of memory that [`PairMotionAccumulator`] takes for each node whose motion it follows.
pub const NODE_BYTES: usize = size_of::<NodeTrack>();

/// Motion of two Gaussians relative to each other. A velocity is a step a = x(t) − x(t−1) between consecutive frames.
/// It is not divided by the time between the frames, because it is compared with the noise level of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelativeMotion {
    /// Mean of the cosines a·b/(‖a‖‖b‖ + 1e-8), where a and b are the steps of the two Gaussians from the previous
    /// frame to this frame. The cosine is 0 if a or b is zero. The mean is over frames in which both Gaussians are
    /// alive (opacity ≥ alpha_min):
    /// - With `MotionParams::Runs`, such a frame counts only if both are alive in the previous frame, too.
    /// - With `MotionParams::Literal`, every such frame counts. The first frame of the sequence has no step; its cosine
    ///   is 0.
    pub cosine: f64,
    /// Σ a·b over the steps, where a and b are the velocities of the two Gaussians; squared scene units.
    pub dot: f64,
    /// Σ (‖a‖² + ‖b‖²) over the steps, where a and b are the velocities of the two Gaussians; squared scene units.
    pub squares: f64,
    /// Number n of steps (from one frame to the next) in the sums `dot` and `squares`.
    pub steps: u32,
    /// Number of frames in which both Gaussians are alive.
    pub common: u32,
    /// Number of frames in which at least one of the Gaussians is alive.
    pub union: u32,
    /// Largest change of the offset between the two Gaussians (difference of their positions) from its value at the
    /// reference frame. In scene units, over the frames in which both Gaussians are alive. A proxy (Gaussian that
    /// replaces both) is built from the offset at the reference frame. It fits other frames only if this change is
    /// small.
    pub drift: f64,
}

impl RelativeMotion {
    /// Returns the alignment of the velocities a and b of the two Gaussians over the n steps,
    /// A = (2Σ a·b + 2nσ²)/(Σ‖a‖² + Σ‖b‖² + 2nσ²), in [−1, 1].
    ///
    /// - For two static Gaussians, A is 1.
    /// - For two equally fast Gaussians (and σ = 0), A is the cosine of the angle between their velocities.
    /// - If one is ten times as fast as the other, A is small.
    /// - Without steps (n = 0), or if neither Gaussian moves and σ = 0, A is 1.
    ///
    /// `noise` is σ, the noise level of a step in scene units.
    pub fn velocity_alignment(&self, noise: f64) -> f64 {
        let floor = 2.0 * f64::from(self.steps) * noise * noise;
        let denominator = self.squares + floor;
        if denominator == 0.0 { 1.0 } else { (2.0 * self.dot + floor) / denominator }
    }

    /// Returns the fraction of frames in which only one of the two Gaussians is alive, among the frames in which at
    /// least one is alive. Returns 1 if neither is ever alive.
    pub fn fraction_with_one_alive(&self) -> f64 {
        if self.union == 0 { 1.0 } else { f64::from(self.union - self.common) / f64::from(self.union) }
    }
}

/// Thresholds of test 3 (motion) that all merging passes share. Lengths are in scene units. The minimum similarity τ_m
/// differs between passes and is not stored here.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionThresholds {
    trajectory: MotionSimilarity,
    noise: f64,
    max_drift: f64,
    max_dead_time: f64,
}

impl MotionThresholds {
    /// Creates the thresholds from those in `merge`, converted to scene units. `unit`: number of scene units in one
    /// unit of the recipe's lengths.
    pub fn new(merge: &recipe::MergeParams, unit: f64) -> Self {
        // An unlimited drift stays unlimited in a scene of extent 0.
        let max_drift = if merge.max_drift.is_infinite() { f64::INFINITY } else { merge.max_drift * unit };
        MotionThresholds {
            trajectory: merge.trajectory,
            noise: merge.motion_noise * unit,
            max_drift,
            max_dead_time: merge.max_dead_time,
        }
    }

    /// Returns the motion similarity of a pair, in [−1, 1]. The pair passes test 3 if the similarity exceeds the
    /// minimum τ_m of the pass. Returns NaN, with which a pair never passes, in three cases:
    /// - the two Gaussians are never alive together;
    /// - the fraction of frames with only one alive exceeds its maximum;
    /// - the change of their offset over time ([`RelativeMotion::drift`]) exceeds its maximum.
    pub fn similarity(&self, pair: &RelativeMotion) -> f64 {
        let together =
            pair.common > 0 && pair.drift <= self.max_drift && pair.fraction_with_one_alive() <= self.max_dead_time;
        match self.trajectory {
            _ if !together => f64::NAN,
            MotionSimilarity::Cosine => pair.cosine,
            MotionSimilarity::Alignment => pair.velocity_alignment(self.noise),
        }
    }
}

/// Position of a node at the current, the previous and the reference frame, and whether it is alive in the current and
/// in the previous frame.
#[derive(Debug, Clone, Copy, Default)]
struct NodeTrack {
    reference: [f32; 3],
    current: [f32; 3],
    previous: [f32; 3],
    alive: bool,
    alive_previously: bool,
}

#[derive(Debug, Clone, Copy, Default)]
struct NodePair {
    nodes: (u32, u32),
    cosines: f64,
    dot: f64,
    squares: f64,
    steps: u32,
    common: u32,
    union: u32,
    drift_squared: f64,
}

/// Measurement of the motion of pairs of nodes, to which the frames are added in order.
#[derive(Debug)]
pub struct PairMotionAccumulator {
    motion: MotionParams,
    frames: usize,
    tracks: Vec<NodeTrack>,
    pairs: Vec<NodePair>,
}

impl PairMotionAccumulator {
    /// Starts to measure the motion of each pair of nodes, for its [`RelativeMotion`]. Frames are then added with
    /// [`PairMotionAccumulator::add_frame`].
    /// - `pairs` yields the indices of the two nodes of each pair.
    /// - `reference` yields the position of every node at the reference frame.
    /// - `motion` selects the steps (from one frame to the next) that count. With `Literal`, these are all steps that
    ///   end in a frame in which both nodes are alive. With `Runs`, a step must begin and end in such a frame.
    pub fn new(
        pairs: impl ExactSizeIterator<Item = (u32, u32)>,
        reference: impl ExactSizeIterator<Item = [f32; 3]>,
        motion: MotionParams,
    ) -> Self {
        let track =
            |reference| NodeTrack { reference, current: reference, previous: reference, ..NodeTrack::default() };
        PairMotionAccumulator {
            motion,
            frames: 0,
            tracks: reference.map(track).collect(),
            pairs: pairs.map(|nodes| NodePair { nodes, ..NodePair::default() }).collect(),
        }
    }

    /// Adds the next frame to the measurement. `state` gets the index of a node, and returns its position and whether
    /// it is alive.
    pub fn add_frame(&mut self, state: impl Fn(usize) -> ([f32; 3], bool) + Sync) {
        self.tracks.par_iter_mut().enumerate().for_each(|(i, track)| {
            (track.previous, track.alive_previously) = (track.current, track.alive);
            (track.current, track.alive) = state(i);
        });
        let steps_end_here = self.frames > 0;
        let (tracks, motion) = (&self.tracks, self.motion);
        self.pairs.par_iter_mut().with_min_len(1024).for_each(|pair| {
            let [a, b] = [pair.nodes.0, pair.nodes.1].map(|node| &tracks[node as usize]);
            pair.union += u32::from(a.alive || b.alive);
            if !(a.alive && b.alive) {
                return;
            }
            pair.common += 1;
            pair.drift(a, b);
            if steps_end_here && (motion == MotionParams::Literal || (a.alive_previously && b.alive_previously)) {
                pair.step(a.velocity(), b.velocity());
            }
        });
        self.frames += 1;
    }

    /// Returns the [`RelativeMotion`] of each pair over all frames added, in the order in which the pairs were given.
    pub fn finish(self) -> impl ExactSizeIterator<Item = RelativeMotion> {
        let motion = self.motion;
        let measure = move |pair: NodePair| {
            let terms = match motion {
                MotionParams::Literal => pair.common,
                MotionParams::Runs => pair.steps,
            };
            RelativeMotion {
                cosine: if terms == 0 { 0.0 } else { pair.cosines / f64::from(terms) },
                dot: pair.dot,
                squares: pair.squares,
                steps: pair.steps,
                common: pair.common,
                union: pair.union,
                drift: pair.drift_squared.sqrt(),
            }
        };
        self.pairs.into_iter().map(measure)
    }
}

impl NodeTrack {
    fn velocity(&self) -> DVec3 {
        wide(self.current) - wide(self.previous)
    }
}

impl NodePair {
    fn step(&mut self, a: DVec3, b: DVec3) {
        let dot = a.dot(b);
        self.cosines += dot / (a.length() * b.length() + COSINE_EPSILON);
        self.dot += dot;
        self.squares += a.length_squared() + b.length_squared();
        self.steps += 1;
    }

    fn drift(&mut self, a: &NodeTrack, b: &NodeTrack) {
        let change = (wide(a.current) - wide(b.current)) - (wide(a.reference) - wide(b.reference));
        let squared = change.length_squared();
        // A NaN must not be lost by `max`: it counts as an infinite drift.
        self.drift_squared = self.drift_squared.max(if squared.is_nan() { f64::INFINITY } else { squared });
    }
}

fn wide(v: [f32; 3]) -> DVec3 {
    DVec3::from(v.map(f64::from))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::recipe::Recipe;

    type Path = Vec<(f32, bool)>;

    /// Measures a pair of nodes that move along the x axis. `a` and `b` hold the x coordinate of each node at every
    /// frame, and whether it is alive. The reference frame is frame 0.
    fn measure(a: &Path, b: &Path, motion: MotionParams) -> RelativeMotion {
        let state = |t: usize, node: usize| {
            let (x, alive) = [a, b][node][t];
            ([x, 0.0, 0.0], alive)
        };
        let reference = (0..2).map(|node| state(0, node).0);
        let mut pairs = PairMotionAccumulator::new([(0, 1)].into_iter(), reference, motion);
        for t in 0..a.len() {
            pairs.add_frame(|node| state(t, node));
        }
        pairs.finish().next().unwrap()
    }

    fn path(x: impl Fn(usize) -> f32) -> Path {
        (0..20).map(|t| (x(t), true)).collect()
    }

    /// Returns whether two Gaussians on the paths `a` and `b` pass test 3 with the default recipe in a scene of extent
    /// `extent`.
    fn merges(a: &Path, b: &Path, extent: f64) -> bool {
        let merge = Recipe::preset("default").unwrap().merge;
        MotionThresholds::new(&merge, extent).similarity(&measure(a, b, MotionParams::Runs)) > merge.passes[0].tau_m
    }

    fn merges_in_paper(a: &Path, b: &Path) -> bool {
        let merge = Recipe::preset("paper").unwrap().merge;
        MotionThresholds::new(&merge, 1.0).similarity(&measure(a, b, MotionParams::Literal)) > merge.passes[0].tau_m
    }

    #[test]
    fn static_gaussians_move_alike_except_by_the_paper() {
        let still = path(|_| 3.0);
        assert!(merges(&still, &path(|_| 3.1), 1.0));
        assert!(merges(&still, &path(|_| 3.1), 0.0), "a scene of no extent");
        assert!(!merges_in_paper(&still, &still));
        let one_frame = vec![(1.0, true)];
        assert!(merges(&one_frame, &one_frame, 1.0));
    }

    #[test]
    fn different_velocities_are_not_merged() {
        let slow = path(|t| 0.01 * t as f32);
        assert!(!merges(&slow, &path(|t| -0.01 * t as f32), 1.0));
        assert!(!merges(&slow, &path(|t| 0.1 * t as f32), 1.0));
        let opposite = measure(&slow, &path(|t| -0.01 * t as f32), MotionParams::Runs);
        assert!((opposite.velocity_alignment(0.0) + 1.0).abs() < 1e-12);
        let tenfold = measure(&slow, &path(|t| 0.1 * t as f32), MotionParams::Runs);
        assert!((tenfold.velocity_alignment(0.0) - 20.0 / 101.0).abs() < 1e-6);
        assert!(merges_in_paper(&slow, &path(|t| 0.1 * t as f32)), "the cosine is blind to speed");
        assert!(!merges_in_paper(&slow, &path(|t| -0.01 * t as f32)));
        assert!(merges(&slow, &path(|t| 5.0 + 0.01 * t as f32), 1.0));
    }

    #[test]
    fn tiny_steps_hardly_count_in_the_cosine_of_the_paper() {
        let slow = path(|t| 1e-5 * t as f32);
        assert!(merges_in_paper(&path(|t| 1e-3 * t as f32), &path(|t| 1e-3 * t as f32)));
        let cosine = measure(&slow, &slow, MotionParams::Runs).cosine;
        // Expected cosine for steps of 1e-5: 1e-10 / (1e-10 + 1e-8); coordinates are f32.
        assert!((cosine - 1.0 / 101.0).abs() < 1e-6, "{cosine}");
        assert!(!merges_in_paper(&slow, &slow));
    }

    #[test]
    fn jumps_prevent_merging_only_while_alive() {
        let still = path(|_| 0.0);
        let jump = path(|t| if t < 10 { 0.0 } else { 50.0 });
        assert!(!merges(&still, &jump, 1.0) && !merges_in_paper(&still, &jump));
        // The node jumps at frame 10 while it is not alive, so no visible motion occurs.
        let mut hidden = path(|t| if t == 10 { 50.0 } else { 0.0 });
        hidden[10].1 = false;
        assert!(merges(&still, &hidden, 1.0));
        assert_eq!(measure(&still, &hidden, MotionParams::Runs).squares, 0.0);
        assert!(measure(&still, &hidden, MotionParams::Literal).squares > 0.0, "the literal rule counts the step back");
    }

    #[test]
    fn disjoint_life_spans_are_not_merged() {
        let first: Path = (0..20).map(|t| (0.0, t < 10)).collect();
        let last: Path = (0..20).map(|t| (0.0, t >= 10)).collect();
        assert!(!merges(&first, &last, 1.0));
        let mut merge = Recipe::preset("default").unwrap().merge;
        merge.max_dead_time = f64::INFINITY;
        merge.max_drift = f64::INFINITY;
        // The pair passes at no threshold, not even at one that every alignment exceeds.
        let exceeds = |a: &Path, b: &Path, tau: f64| {
            MotionThresholds::new(&merge, 1.0).similarity(&measure(a, b, MotionParams::Runs)) > tau
        };
        assert!(!exceeds(&first, &last, f64::NEG_INFINITY));
        let never: Path = vec![(0.0, false); 20];
        assert!(!exceeds(&never, &never, f64::NEG_INFINITY));
        assert!(exceeds(&first, &first, -2.0));
    }

    #[test]
    fn dead_time_is_the_fraction_with_only_one_alive() {
        let long: Path = (0..20).map(|t| (0.0, t < 16)).collect();
        let short: Path = (0..20).map(|t| (0.0, (4..16).contains(&t))).collect();
        let pair = measure(&long, &short, MotionParams::Runs);
        assert_eq!((pair.common, pair.union, pair.steps, pair.fraction_with_one_alive()), (12, 16, 11, 0.25));
        assert!(!merges(&long, &short, 1.0), "a quarter dead is more than a tenth");
    }

    #[test]
    fn a_step_to_nan_or_infinity_prevents_merging() {
        for lost in [f32::NAN, f32::INFINITY] {
            let non_finite = path(|t| if t == 7 { lost } else { 0.0 });
            assert!(!merges(&non_finite, &non_finite, 1.0), "{lost}");
            assert!(!merges_in_paper(&non_finite, &path(|t| t as f32)), "{lost}");
        }
    }

    proptest! {
        #[test]
        fn streaming_sums_equal_the_definitions(
            frames in prop::collection::vec((-1.0..1.0f32, any::<bool>(), -1.0..1.0f32, any::<bool>()), 1..30),
        ) {
            let a: Path = frames.iter().map(|f| (f.0, f.1)).collect();
            let b: Path = frames.iter().map(|f| (f.2, f.3)).collect();
            let both = |t: usize| a[t].1 && b[t].1;
            let common: Vec<usize> = (0..a.len()).filter(|&t| both(t)).collect();
            for motion in [MotionParams::Literal, MotionParams::Runs] {
                let got = measure(&a, &b, motion);
                let ends: Vec<usize> =
                    common.iter().copied().filter(|&t| t > 0 && (motion == MotionParams::Literal || both(t - 1))).collect();
                let v = |p: &Path, t: usize| f64::from(p[t].0) - f64::from(p[t - 1].0);
                let products = ends.iter().map(|&t| v(&a, t) * v(&b, t));
                let signs: f64 = products.map(|product| product / (product.abs() + 1e-8)).sum();
                let terms = if motion == MotionParams::Literal { common.len() } else { ends.len() };
                let cosine = if terms == 0 { 0.0 } else { signs / terms as f64 };
                let dot: f64 = ends.iter().map(|&t| v(&a, t) * v(&b, t)).sum();
                let squares: f64 = ends.iter().map(|&t| v(&a, t).powi(2) + v(&b, t).powi(2)).sum();
                let offset = |t: usize| f64::from(a[t].0) - f64::from(b[t].0);
                let drift = common.iter().map(|&t| (offset(t) - offset(0)).abs()).fold(0.0, f64::max);
                prop_assert!((got.cosine - cosine).abs() < 1e-12, "cosine {} for {cosine}", got.cosine);
                prop_assert!((got.dot - dot).abs() < 1e-12 && (got.squares - squares).abs() < 1e-12);
                prop_assert!((got.drift - drift).abs() < 1e-12, "drift {} for {drift}", got.drift);
                prop_assert_eq!((got.steps as usize, got.common as usize), (ends.len(), common.len()));
                prop_assert_eq!(got.union as usize, (0..a.len()).filter(|&t| a[t].1 || b[t].1).count());
            }
        }
    }
}
