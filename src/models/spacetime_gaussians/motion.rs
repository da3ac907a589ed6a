//! Motion of a SpacetimeGaussians Gaussian: a cubic path, a quaternion that is linear in time, and a temporal window.
//!
//! With dt = t − center: the position is x = p₀ + p₁·dt + p₂·dt² + p₃·dt³; the quaternion is q = rotation + dt·omega,
//! of any length; the opacity is multiplied by the window exp(−(dt/e^log_width)²). Source: Li et al., "Spacetime
//! Gaussian Feature Splatting", 2024, and its public code, which has no factor ½ in that exponent. All computations are
//! in f64.

use crate::fit::polynomial;

/// Motion of a Gaussian, and its temporal window (factor of the opacity over time).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SpacetimeMotion {
    /// Center of the temporal window, in the model's time unit.
    pub(super) center: f64,
    /// Natural logarithm of the width of the temporal window, which is √2 times its standard deviation in time.
    pub(super) log_width: f64,
    /// Coefficients of 1, dt, dt² and dt³ of the position, where dt is the time from the center.
    pub(super) path: [[f64; 3]; 4],
    /// Quaternion wxyz at the center of the window, of any length.
    pub(super) rotation: [f64; 4],
    /// Change of the quaternion per unit of time.
    pub(super) omega: [f64; 4],
}

impl SpacetimeMotion {
    /// Returns the position at `time`, scene units.
    pub(super) fn position(&self, time: f64) -> [f64; 3] {
        let (dt, [p0, p1, p2, p3]) = (time - self.center, self.path);
        std::array::from_fn(|c| p0[c] + dt * (p1[c] + dt * (p2[c] + dt * p3[c])))
    }

    /// Returns the quaternion at `time`, wxyz of any length.
    pub(super) fn rotation(&self, time: f64) -> [f64; 4] {
        let dt = time - self.center;
        std::array::from_fn(|c| self.rotation[c] + dt * self.omega[c])
    }

    /// Returns the value of the temporal window at `time`, by which the opacity is multiplied.
    pub(super) fn window(&self, time: f64) -> f64 {
        let dt = (time - self.center) / self.log_width.exp();
        (-dt * dt).exp()
    }

    /// Returns the same motion, expressed by coefficients around another `center`. At each time, the position and the
    /// direction of the quaternion stay the same up to rounding. The temporal window, however, moves to the new center.
    /// `rotation` is normalized if it is not zero.
    pub(super) fn recentered(&self, center: f64) -> SpacetimeMotion {
        let (by, [_, p1, p2, p3]) = (center - self.center, self.path);
        let path = [
            self.position(center),
            std::array::from_fn(|c| p1[c] + by * (2.0 * p2[c] + by * 3.0 * p3[c])),
            std::array::from_fn(|c| p2[c] + by * 3.0 * p3[c]),
            p3,
        ];
        // The state depends only on the ratio of `rotation` and `omega`.
        let rotation = self.rotation(center);
        let length = dot(&rotation, &rotation).sqrt();
        let length = if length.is_normal() { length } else { 1.0 };
        let [rotation, omega] = [rotation, self.omega].map(|q| q.map(|x| x / length));
        SpacetimeMotion { center, path, rotation, omega, ..*self }
    }
}

/// Returns the product of two quaternions, wxyz.
pub(super) fn product(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    let ([a, x, y, z], [b, u, v, w]) = (a, b);
    [
        a * b - x * u - y * v - z * w,
        a * u + x * b + y * w - z * v,
        a * v - x * w + y * b + z * u,
        a * w + x * v - y * u + z * b,
    ]
}

/// Returns the scalar product of two vectors.
pub(super) fn dot<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Returns the center and the log width of the temporal window into which the windows of `members` are merged. The
/// merged window has the mean and the variance in time of the weighted sum of the members' windows. Each member is a
/// weight and a motion.
pub(super) fn merged_window(members: &[(f64, SpacetimeMotion)]) -> (f64, f64) {
    // Each window counts with its area in time, relative to the widest one, so that no area overflows.
    let longest = members.iter().fold(f64::NEG_INFINITY, |most, (_, motion)| most.max(motion.log_width));
    let area = |(weight, motion): &(f64, SpacetimeMotion)| weight * (motion.log_width - longest).exp();
    let total: f64 = members.iter().map(area).sum();
    let share = |member: &(f64, SpacetimeMotion)| area(member) / total;
    let center: f64 = members.iter().map(|member| share(member) * member.1.center).sum();
    let unit = longest.exp();
    let second = |(_, motion): &(f64, SpacetimeMotion)| {
        let [width, off] = [(motion.log_width - longest).exp(), (motion.center - center) / unit];
        width * width + 2.0 * off * off
    };
    let squared: f64 = members.iter().map(|member| share(member) * second(member)).sum();
    (center, longest + 0.5 * squared.ln())
}

/// Returns the weighted mean of motions that have the same center; `None` if `members` is empty. Each member is a
/// weight and a motion. At any time, the position and the quaternion of the mean are the weighted means of the
/// positions and quaternions of all `members`. Before the mean is taken, each quaternion gets the sign that brings it
/// nearer to the quaternion of the member with the largest weight. The temporal window is that of this member.
pub(super) fn mean(members: &[(f64, SpacetimeMotion)]) -> Option<SpacetimeMotion> {
    let heaviest = members.iter().copied().reduce(|a, b| if b.0 > a.0 { b } else { a })?.1;
    let (mut path, mut rotation, mut omega) = ([[0.0; 3]; 4], [0.0; 4], [0.0; 4]);
    for (weight, member) in members {
        let sign = if dot(&member.rotation, &heaviest.rotation) < 0.0 { -weight } else { *weight };
        for (to, of) in path.iter_mut().flatten().zip(member.path.iter().flatten()) {
            *to += weight * of;
        }
        for c in 0..4 {
            rotation[c] += sign * member.rotation[c];
            omega[c] += sign * member.omega[c];
        }
    }
    Some(SpacetimeMotion { path, rotation, omega, ..heaviest })
}

/// State at one time that a fitted motion should approximate, with its weight in the least-squares fit.
#[derive(Debug, Clone, Copy)]
pub(super) struct TargetState {
    pub(super) time: f64,
    pub(super) weight: f64,
    pub(super) position: [f64; 3],
    /// Rotation at this time, quaternion wxyz. q and −q are the same rotation but are fitted differently; the caller
    /// chooses the sign that is nearest to the mean motion.
    pub(super) rotation: [f64; 4],
}

/// Returns the motion that fits the states `targets` best (least squares) and has the center of `initial`; returns
/// `initial` if there are no targets. A ridge term regularizes coefficients that the times do not determine.
///
/// Time is measured in widths of the window. Coefficients then have comparable magnitudes, so one ridge term suits all.
pub(super) fn fitted(initial: &SpacetimeMotion, targets: &[TargetState]) -> SpacetimeMotion {
    let unit = initial.log_width.exp().clamp(1e-6, 1e6);
    let ridge = if targets.len() < 4 { 1e-3 } else { 1e-6 };
    // Fit the differences from `initial`, so that nothing changes where `initial` is already right.
    let residual = |target: &TargetState| {
        let [x, at] = [target.position, initial.position(target.time)];
        let [q, rotated] = [target.rotation, initial.rotation(target.time)];
        (
            (target.time - initial.center) / unit,
            std::array::from_fn(|c| x[c] - at[c]),
            std::array::from_fn(|c| q[c] - rotated[c]),
        )
    };
    let path: [[f64; 3]; 4] =
        polynomial(targets.iter().map(|target| (residual(target).0, residual(target).1, target.weight)), ridge);
    let turn: [[f64; 4]; 2] =
        polynomial(targets.iter().map(|target| (residual(target).0, residual(target).2, target.weight)), ridge);
    let mut found = *initial;
    for (k, (to, more)) in found.path.iter_mut().zip(path).enumerate() {
        (0..3).for_each(|c| to[c] += more[c] / unit.powi(k as i32));
    }
    let [rotated, rotating] = turn;
    (0..4).for_each(|c| {
        found.rotation[c] += rotated[c];
        found.omega[c] += rotating[c] / unit;
    });
    found
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn motion() -> impl Strategy<Value = SpacetimeMotion> {
        let values = |most: f64, count: usize| prop::collection::vec(-most..most, count);
        (-0.5..1.5f64, -3.0..2.0f64, values(3.0, 12), values(1.0, 8)).prop_map(|(center, log_width, path, turn)| {
            SpacetimeMotion {
                center,
                log_width,
                path: std::array::from_fn(|k| std::array::from_fn(|c| path[3 * k + c])),
                // Keep quaternions away from zero length.
                rotation: std::array::from_fn(|c| turn[c] + if c == 0 { 3.0 } else { 0.0 }),
                omega: std::array::from_fn(|c| turn[4 + c]),
            }
        })
    }

    fn unit(q: [f64; 4]) -> [f64; 4] {
        let length = dot(&q, &q).sqrt();
        q.map(|x| x / length)
    }

    fn largest_difference<const N: usize>(a: [f64; N], b: [f64; N]) -> f64 {
        a.iter().zip(b).fold(0.0, |most, (a, b)| most.max((a - b).abs()))
    }

    proptest! {
        #[test]
        fn recentered_motion_is_unchanged(motion in motion(), center in -0.5..1.5f64) {
            let recentered = motion.recentered(center);
            prop_assert_eq!(recentered.center, center);
            prop_assert!((dot(&recentered.rotation, &recentered.rotation) - 1.0).abs() < 1e-12);
            for k in 0..=10 {
                let time = f64::from(k) / 10.0;
                let size = 1.0 + motion.position(time).iter().fold(0.0f64, |most, x| most.max(x.abs()));
                let off = largest_difference(motion.position(time), recentered.position(time)) / size;
                prop_assert!(off < 1e-12, "{} at {}", off, time);
                let off = largest_difference(unit(motion.rotation(time)), unit(recentered.rotation(time)));
                prop_assert!(off < 1e-12, "{} at {}", off, time);
            }
        }

        #[test]
        fn mean_motion_has_the_mean_state_at_every_time(
            some in prop::collection::vec((0.1..1.0f64, motion()), 1..5),
            flip in 0..4usize,
        ) {
            let total: f64 = some.iter().map(|member| member.0).sum();
            let center = merged_window(&some).0;
            let mut recentered: Vec<(f64, SpacetimeMotion)> =
                some.iter().map(|(weight, motion)| (weight / total, motion.recentered(center))).collect();
            let expected = mean(&recentered).unwrap();
            // Negate the quaternions of one member; its rotations stay the same.
            let other = flip % recentered.len();
            let flipped = &mut recentered[other].1;
            (flipped.rotation, flipped.omega) = (flipped.rotation.map(|x| -x), flipped.omega.map(|x| -x));
            let found = mean(&recentered).unwrap();
            for k in 0..=4 {
                let time = f64::from(k) / 4.0;
                let mean_coordinate = |c: usize| some.iter().map(|(w, motion)| w / total * motion.position(time)[c]).sum::<f64>();
                let size = 1.0 + (0..3).fold(0.0f64, |most, c| most.max(mean_coordinate(c).abs()));
                prop_assert!(largest_difference(found.position(time), std::array::from_fn(mean_coordinate)) / size < 1e-11);
                let off = 1.0 - dot(&unit(found.rotation(time)), &unit(expected.rotation(time))).abs();
                prop_assert!(off < 1e-12, "{}", off);
            }
        }

        #[test]
        fn merged_window_keeps_the_second_moment(
            some in prop::collection::vec((0.1..1.0f64, motion()), 1..5),
        ) {
            let (center, log_width) = merged_window(&some);
            // Compute the moments by summing the windows over time.
            let widest = some.iter().fold(0.0f64, |most, (_, motion)| most.max(motion.log_width.exp()));
            // Cover the most distant center and the widest window.
            let (mut sums, step) = ([0.0; 3], (8.0 * widest + 2.0) / 20000.0);
            for k in -20000..=20000 {
                let time = center + f64::from(k) * step;
                let height: f64 = some.iter().map(|(weight, motion)| weight * motion.window(time)).sum();
                let terms = [1.0, time, time * time];
                sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += height * term);
            }
            let mean = sums[1] / sums[0];
            let variance = sums[2] / sums[0] - mean * mean;
            prop_assert!((mean - center).abs() < 1e-6 * (1.0 + widest), "{} for {}", center, mean);
            // The width is √2 times the standard deviation.
            let expected = (2.0 * variance).sqrt();
            prop_assert!((log_width.exp() / expected - 1.0).abs() < 1e-4, "{} for {}", log_width.exp(), expected);
        }

        #[test]
        fn fit_recovers_a_cubic_path(initial in motion(), motion in motion()) {
            let initial = SpacetimeMotion { log_width: 0.0, ..initial };
            let motion = SpacetimeMotion { log_width: 0.0, ..motion.recentered(initial.center) };
            let times = (0..20).map(|k| f64::from(k) / 20.0);
            let state = |time| {
                TargetState { time, weight: 1.0 + time, position: motion.position(time), rotation: motion.rotation(time) }
            };
            let targets: Vec<TargetState> = times.map(state).collect();
            let found = fitted(&initial, &targets);
            for TargetState { time, position, rotation, .. } in targets {
                // The ridge of 10⁻⁶ matters for powers of time that are nearly collinear here.
                let at = found.position(time);
                prop_assert!(largest_difference(at, position) < 0.05, "{:?} {:?}", at, position);
                prop_assert!(largest_difference(found.rotation(time), rotation) < 1e-4);
            }
            // Without target states the result is `initial`.
            prop_assert_eq!(fitted(&initial, &[]), initial);
        }
    }

    #[test]
    fn quaternion_product_agrees_with_glam() {
        let q = |[w, x, y, z]: [f64; 4]| glam::DQuat::from_xyzw(x, y, z, w);
        let (a, b) = ([0.3, -1.0, 2.0, 0.5], [-0.7, 0.2, 0.1, 4.0]);
        let expected = q(a) * q(b);
        assert!(largest_difference(product(a, b), [expected.w, expected.x, expected.y, expected.z]) < 1e-14);
    }
}
