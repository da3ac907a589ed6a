//! One Gaussian of a generated scene: its constants, its motion in closed form, and the random numbers that belong to
//! it.

use std::f64::consts::{FRAC_PI_2, TAU};

use glam::{DQuat, DVec2, DVec3};
use xxhash_rust::xxh3::xxh3_64_with_seed;

use crate::model::SH_C0;

/// Constants and motion of one Gaussian.
#[derive(Debug, Clone)]
pub(super) struct DemoGaussian {
    pub(super) position: DVec3,
    pub(super) rotation: DQuat,
    pub(super) opacity_logit: f64,
    pub(super) motion: DemoMotion,
    pub(super) log_scale: [f32; 3],
    pub(super) sh: [f32; 12],
}

/// Attributes of one Gaussian that vary over time, at one time.
pub(super) struct Moved {
    pub(super) position: DVec3,
    pub(super) rotation: DQuat,
    pub(super) opacity_logit: f64,
}

/// Motion of a Gaussian. Times run from 0 to 1.
#[derive(Debug, Clone)]
pub(super) enum DemoMotion {
    /// No motion.
    Still,
    /// Circles and spins with the egg. `position` and `rotation` are relative to the egg.
    Egg,
    /// Displacement along y by a wave; `along` is 0 at the edge where the cloth is held and 1 at its free edge.
    Wave { along: f64 },
    /// The opacity logit changes at this rate per unit of time.
    Fade { rate: f64 },
    /// Visible within `half_life` of `peak`, flying at `velocity` meanwhile.
    Spark { peak: f64, half_life: f64, velocity: DVec3 },
    /// Turns around y through `pivot`, by `angle` radians in the sequence.
    Turn { pivot: DVec3, angle: f64 },
    /// Bounces and rolls with the ball. `position` and `rotation` are relative to the ball's center.
    Bounce,
    /// Walks with the figure, whose feet stand at the origin and which faces x. The limb swings around y through
    /// `joint` by at most `swing` radians, with the sign of its first swing.
    Walk { joint: DVec3, swing: f64 },
}

/// Width of the cloth along x, scene units.
pub(super) const CLOTH_WIDTH: f64 = 1.2;
/// Amplitude of the wave at the free edge of the cloth, scene units.
const SWING: f64 = 0.18;
/// Number of wavelengths along the cloth.
const WAVES: f64 = 1.5;
/// Number of periods of the cloth's wave in the sequence.
const PASSES: f64 = 2.0;
/// Opacity logit at which a spark or a fading Gaussian counts as invisible; 0.01, the usual alpha_min, is −4.6.
pub(super) const GONE: f64 = -6.0;
/// Opacity logit of the sparks at their peak.
pub(super) const BRIGHT: f64 = 3.0;
/// Half life span of a spark, as a fraction of the sequence. With 1/16 it is visible for an eighth of the sequence.
pub(super) const HALF_LIFE: f64 = 1.0 / 16.0;
const GRAVITY: f64 = 12.0;
/// Radius of the ball, and how far its center rises in a bounce, scene units.
pub(super) const BALL_RADIUS: f64 = 0.34;
const BOUNCE: f64 = 0.9;
/// Number of bounces of the ball in the sequence.
const BOUNCES: f64 = 3.0;
/// Number of double steps (one with each leg) of the figure in the sequence.
const STEPS: f64 = 6.0;

impl DemoGaussian {
    /// Returns the attributes that vary over time, at `time` in [0, 1].
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

/// Random numbers of one Gaussian, hashed from its id, so that they do not depend on the order of reading.
#[derive(Clone, Copy)]
pub(super) struct GaussianRandom(pub(super) u64);

impl GaussianRandom {
    /// Returns the Gaussian's random number with the index `channel`, in [0, 1].
    pub(super) fn unit(self, channel: u64) -> f64 {
        const BITS: u32 = f64::MANTISSA_DIGITS;
        (xxh3_64_with_seed(&self.0.to_le_bytes(), channel) >> (64 - BITS)) as f64 / (1u64 << BITS) as f64
    }

    /// Returns the Gaussian's random number with the index `channel`, in [−1, 1].
    pub(super) fn signed(self, channel: u64) -> f64 {
        2.0 * self.unit(channel) - 1.0
    }

    /// Returns the Gaussian's random number with the index `channel`, in [`low`, `high`].
    pub(super) fn between(self, channel: u64, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit(channel)
    }
}

/// First of the channels (indices of random numbers in [`GaussianRandom`]) that the Gaussians of all bodies use. The
/// channels of a single body start at 0.
const TINT: u64 = 100;
const SHEEN: u64 = 200;

/// Returns a Gaussian that does not move.
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

/// Returns SH coefficients for a color in [0, 1], with a tint of its own and a slight change with direction.
pub(super) fn color(rgb: [f64; 3], dice: GaussianRandom) -> [f32; 12] {
    std::array::from_fn(|at| match at {
        0..3 => ((rgb[at] + 0.02 * dice.signed(TINT) - 0.5) / SH_C0) as f32,
        _ => (0.04 * dice.signed(SHEEN + at as u64)) as f32,
    })
}

/// Returns point `k` of a sequence that fills the unit square evenly for any number of points (R2: Roberts,
/// "The unreasonable effectiveness of quasirandom sequences", 2018).
pub(super) fn spread(k: usize) -> DVec2 {
    const PLASTIC: f64 = 1.324_717_957_244_746;
    let k = k as f64;
    DVec2::new((0.5 + k / PLASTIC).fract(), (0.5 + k / (PLASTIC * PLASTIC)).fract())
}

/// Returns the rotation that turns z, the thin axis of a flat Gaussian, to −y, so that the Gaussian faces along y.
pub(super) fn facing_y() -> DQuat {
    DQuat::from_rotation_x(FRAC_PI_2)
}
