//! One Gaussian of a generated scene: its attributes at rest, the formula of its motion, and its pseudo-random numbers.

use std::f64::consts::{FRAC_PI_2, TAU};

use glam::{DQuat, DVec2, DVec3};
use xxhash_rust::xxh3::xxh3_64_with_seed;

use crate::model::SH_C0;

/// One Gaussian of a generated scene: its attributes at rest, and the motion that changes them over time.
#[derive(Debug, Clone)]
pub(super) struct DemoGaussian {
    pub(super) position: DVec3,
    pub(super) rotation: DQuat,
    pub(super) opacity_logit: f64,
    pub(super) motion: DemoMotion,
    pub(super) log_scale: [f32; 3],
    pub(super) sh: [f32; 12],
}

/// Position, rotation and opacity logit of one Gaussian at one time. Its other attributes do not vary over time.
pub(super) struct Moved {
    pub(super) position: DVec3,
    pub(super) rotation: DQuat,
    pub(super) opacity_logit: f64,
}

/// Motion of a Gaussian as a function of the time, which runs from 0 to 1 over the sequence.
#[derive(Debug, Clone)]
pub(super) enum DemoMotion {
    /// No motion.
    Still,
    /// Motion of the Gaussians of the egg, which runs along three quarters of an ellipse and spins once. `position` and
    /// `rotation` of the Gaussian are relative to the egg.
    Egg,
    /// Motion of the Gaussians of a cloth or flag, through which a wave runs: displacement along y. `along` is the
    /// position of the Gaussian across the cloth, from 0 at the edge where it is held to 1 at its free edge.
    Wave { along: f64 },
    /// No motion, but a linear change of the opacity logit, by `rate` per unit of time.
    Fade { rate: f64 },
    /// Flight of a spark, which is visible from the time `peak - half_life` to the time `peak + half_life`. It starts
    /// with the velocity `velocity` (scene units per unit of time) and falls under gravity in this time.
    Spark { peak: f64, half_life: f64, velocity: DVec3 },
    /// Rotation by `angle` radians over the sequence about the axis through `pivot` that is parallel to y.
    Turn { pivot: DVec3, angle: f64 },
    /// Motion of the Gaussians of the ball, which bounces and rolls. `position` and `rotation` of the Gaussian are
    /// relative to the center of the ball.
    Bounce,
    /// Motion of a limb of the walking figure. `position` and `rotation` of the Gaussian, and `joint`, are relative to
    /// the figure, whose feet stand at the origin and which faces +x. The limb swings about the axis through `joint`
    /// that is parallel to y, by at most |`swing`| radians; the sign of `swing` gives the direction of the first swing.
    Walk { joint: DVec3, swing: f64 },
}

/// Width of the cloth and of the flag along x, scene units.
pub(super) const CLOTH_WIDTH: f64 = 1.2;
/// Amplitude of the wave at the free edge of the cloth, scene units.
const SWING: f64 = 0.18;
/// Width of the cloth, in wavelengths of its wave.
const WAVES: f64 = 1.5;
/// Number of periods that the wave of the cloth makes during the sequence.
const PASSES: f64 = 2.0;
/// Opacity logit at which a spark or a fading Gaussian counts as invisible. It lies below −4.6, the logit of 0.01,
/// which is the usual alpha_min (minimum opacity at which a Gaussian is alive).
pub(super) const GONE: f64 = -6.0;
/// Opacity logit of a spark at its peak, and of a fading Gaussian when it is most opaque.
pub(super) const BRIGHT: f64 = 3.0;
/// Half the time in which a spark is visible, as a fraction of the sequence. With 1/16, a spark is visible for an
/// eighth of the sequence.
pub(super) const HALF_LIFE: f64 = 1.0 / 16.0;
/// Acceleration of a flying spark toward the ground, scene units per squared unit of time.
const GRAVITY: f64 = 12.0;
/// Radius of the ball, scene units.
pub(super) const BALL_RADIUS: f64 = 0.34;
/// Height by which the center of the ball rises in a bounce, scene units.
const BOUNCE: f64 = 0.9;
/// Number of bounces of the ball in the sequence.
const BOUNCES: f64 = 3.0;
/// Number of double steps (one step with each leg) that the figure takes during the sequence.
const STEPS: f64 = 6.0;

impl DemoGaussian {
    /// Returns position, rotation and opacity logit of this Gaussian at `time`, from 0 to 1.
    pub(super) fn at(&self, time: f64) -> Moved {
        let DemoGaussian { mut position, mut rotation, mut opacity_logit, .. } = *self;
        match self.motion {
            DemoMotion::Still => {}
            DemoMotion::Egg => {
                let (sin, cos) = (0.75 * TAU * time).sin_cos();
                let spin = DQuat::from_axis_angle(DVec3::new(1.0, 1.0, 3.0).normalize(), TAU * time);
                position = DVec3::new(0.6 * cos, 0.2 + 0.4 * sin, 0.7) + spin * position;
                rotation = spin * rotation;
            }
            DemoMotion::Wave { along } => {
                let (sin, cos) = (TAU * (WAVES * along - PASSES * time)).sin_cos();
                position.y += SWING * along * sin;
                let slope = SWING * (sin + along * TAU * WAVES * cos) / CLOTH_WIDTH;
                rotation = DQuat::from_rotation_z(slope.atan()) * rotation;
            }
            DemoMotion::Fade { rate } => opacity_logit += rate * time,
            DemoMotion::Spark { peak, half_life, velocity } => {
                let away = (time - peak) / half_life;
                opacity_logit = BRIGHT + (GONE - BRIGHT) * (away * away).min(1.5);
                let flown = (time - (peak - half_life)).clamp(0.0, 2.0 * half_life);
                position += velocity * flown - DVec3::Z * (0.5 * GRAVITY * flown * flown);
            }
            DemoMotion::Turn { pivot, angle } => {
                let turn = DQuat::from_rotation_y(angle * time);
                position = pivot + turn * (position - pivot);
                rotation = turn * rotation;
            }
            DemoMotion::Bounce => {
                let along = 0.75 * (TAU * time).cos();
                let roll = DQuat::from_rotation_y(along / BALL_RADIUS);
                let phase = (BOUNCES * time).fract();
                let height = BALL_RADIUS + 4.0 * BOUNCE * phase * (1.0 - phase);
                position = DVec3::new(1.1 + along, -0.7, height) + roll * position;
                rotation = roll * rotation;
            }
            DemoMotion::Walk { joint, swing } => {
                let limb = DQuat::from_rotation_y(swing * (TAU * STEPS * time).sin());
                let (sin, cos) = (TAU * time).sin_cos();
                let place = DVec3::new(-0.7 + 0.85 * cos, -1.0 + 0.45 * sin, 0.0);
                let heading = DQuat::from_rotation_z((0.45 * cos).atan2(-0.85 * sin));
                position = place + heading * (joint + limb * (position - joint));
                rotation = heading * limb * rotation;
            }
        }
        Moved { position, rotation, opacity_logit }
    }
}

/// Source of the pseudo-random numbers of one Gaussian; the field is the id of the Gaussian. A number is a hash of this
/// id and of an index, called channel. So the numbers do not depend on the order in which Gaussians are read.
#[derive(Clone, Copy)]
pub(super) struct GaussianRandom(pub(super) u64);

impl GaussianRandom {
    /// Returns the pseudo-random number with the index `channel` of this Gaussian, scaled to [0, 1). Repeated calls
    /// with the same `channel` return the same number.
    pub(super) fn unit(self, channel: u64) -> f64 {
        const BITS: u32 = f64::MANTISSA_DIGITS;
        (xxh3_64_with_seed(&self.0.to_le_bytes(), channel) >> (64 - BITS)) as f64 / (1u64 << BITS) as f64
    }

    /// Returns the pseudo-random number with the index `channel` of this Gaussian, scaled to [−1, 1). Repeated calls
    /// with the same `channel` return the same number.
    pub(super) fn signed(self, channel: u64) -> f64 {
        2.0 * self.unit(channel) - 1.0
    }

    /// Returns the pseudo-random number with the index `channel` of this Gaussian, scaled to the range from `low` to
    /// `high`. Repeated calls with the same `channel` return the same number.
    pub(super) fn between(self, channel: u64, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit(channel)
    }
}

/// Index of the random number ([`GaussianRandom`]) that makes the color of a Gaussian a little brighter or darker. It
/// is large because the indices that single objects use for other numbers start at 0.
const BRIGHTNESS_INDEX: u64 = 100;
/// Offset of the indices of the random numbers ([`GaussianRandom`]) from which the SH coefficients of degree 1 are
/// made. They let the color of a Gaussian depend a little on the view direction. Coefficient `at` of the 12
/// coefficients (3 to 11 have degree 1) uses the random number with the index `VIEW_COLOR_INDEX + at`. The offset is
/// large because the indices that single objects use for other numbers start at 0.
const VIEW_COLOR_INDEX: u64 = 200;

/// Returns a Gaussian with the given attributes that does not move. `scale`: standard deviations along its axes, scene
/// units.
pub(super) fn still(
    position: DVec3,
    rotation: DQuat,
    scale: [f64; 3],
    opacity_logit: f64,
    sh: [f32; 12],
) -> DemoGaussian {
    let log_scale = scale.map(|s| s.ln() as f32);
    DemoGaussian { position, rotation, opacity_logit, motion: DemoMotion::Still, log_scale, sh }
}

/// Returns the 12 SH coefficients up to degree 1 for the color `rgb`, whose components are in [0, 1]. Random numbers of
/// the Gaussian, from `dice`, change its brightness a little and let its color depend slightly on the view direction.
pub(super) fn color(rgb: [f64; 3], dice: GaussianRandom) -> [f32; 12] {
    std::array::from_fn(|at| match at {
        0..3 => ((rgb[at] + 0.02 * dice.signed(BRIGHTNESS_INDEX) - 0.5) / SH_C0) as f32,
        _ => (0.04 * dice.signed(VIEW_COLOR_INDEX + at as u64)) as f32,
    })
}

/// Returns point `k` of a sequence of points in the unit square. Its first n points are spread evenly, for every n
/// (sequence R2 of Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018).
pub(super) fn spread(k: usize) -> DVec2 {
    const PLASTIC: f64 = 1.324_717_957_244_746;
    let k = k as f64;
    DVec2::new((0.5 + k / PLASTIC).fract(), (0.5 + k / (PLASTIC * PLASTIC)).fract())
}

/// Returns the rotation that turns the z axis to −y. A flat Gaussian is thin along its z axis, so its flat side then
/// faces along y.
pub(super) fn facing_y() -> DQuat {
    DQuat::from_rotation_x(FRAC_PI_2)
}
