//! Bodies (objects) of the test scene: the attributes of each of their Gaussians at rest, and its motion.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::ops::Range;

use glam::{DQuat, DVec2, DVec3};

use super::motion::{
    BRIGHT, CLOTH_WIDTH, DemoGaussian, DemoMotion, GONE, GaussianRandom, HALF_LIFE, color, facing_y, spread, still,
};

/// Body of the test scene: a group of Gaussians that form one object, such as a wall. Each body has a property that a
/// compression must handle, such as rigid motion or invisibility.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DemoBody {
    /// Floor and three walls with a checkered texture, without motion. Each square of the texture has one color, so its
    /// Gaussians can be merged.
    Wall,
    /// Near-duplicates of Gaussians of the walls: shifted by up to a tenth of their size, a little smaller and less
    /// opaque, of the same color. Without motion. Merging is expected to merge these Gaussians first.
    Double,
    /// Opaque Gaussians behind the back wall, invisible to every camera. Without motion. A ranking by visibility prunes
    /// them first, a ranking by opacity or size does not.
    Buried,
    /// Tiny faint Gaussians all over the room, without motion. A ranking by contribution (projected area times opacity)
    /// prunes them first.
    Dust,
    /// Egg that runs along an ellipse and spins: strong but rigid motion, so that merging Gaussians of the egg with
    /// each other keeps the motion.
    Egg,
    /// Cloth that is held at its left edge and waves at its right edge: neighboring Gaussians move differently.
    Cloth,
    /// Cloud without motion. Each of its Gaussians fades from opaque to invisible or from invisible to opaque. So its
    /// opacities vary, and each Gaussian is alive in only a part of the frames; its positions are constant, as those of
    /// a wall.
    Fading,
    /// Flying sparks, each visible for an eighth of the sequence around its own time. The life spans of many sparks do
    /// not overlap. A spark does not move outside of its life span.
    Spark,
    /// Hanging wires, each a row of needle-shaped Gaussians that are 25 times longer than thick. Without motion; they
    /// cover little area in a render, but are visible.
    Wire,
}

impl DemoBody {
    /// List of the bodies, in the order of the ids of their Gaussians.
    pub const ALL: [DemoBody; 9] = [
        DemoBody::Wall,
        DemoBody::Double,
        DemoBody::Buried,
        DemoBody::Dust,
        DemoBody::Egg,
        DemoBody::Cloth,
        DemoBody::Fading,
        DemoBody::Spark,
        DemoBody::Wire,
    ];

    /// Returns the name of this body in tables.
    pub const fn name(self) -> &'static str {
        match self {
            DemoBody::Wall => "wall",
            DemoBody::Double => "double",
            DemoBody::Buried => "buried",
            DemoBody::Dust => "dust",
            DemoBody::Egg => "egg",
            DemoBody::Cloth => "cloth",
            DemoBody::Fading => "fading",
            DemoBody::Spark => "spark",
            DemoBody::Wire => "wire",
        }
    }

    /// Returns the number of Gaussians of this body per 1000 Gaussians of the scene.
    const fn share(self) -> usize {
        match self {
            DemoBody::Wall => 400,
            DemoBody::Double => 150,
            DemoBody::Egg => 100,
            DemoBody::Buried | DemoBody::Dust | DemoBody::Cloth => 80,
            DemoBody::Fading | DemoBody::Wire => 40,
            DemoBody::Spark => 30,
        }
    }
}

/// Ids of the Gaussians of each body (object of the test scene).
#[derive(Debug, Clone)]
pub(super) struct BodyLayout {
    /// First id of the Gaussians of each body, in the order of [`DemoBody::ALL`]. The last entry is the number of
    /// Gaussians of the scene.
    starts: [usize; DemoBody::ALL.len() + 1],
}

impl BodyLayout {
    pub(super) fn new(count: usize) -> BodyLayout {
        let mut starts = [0; DemoBody::ALL.len() + 1];
        let mut share = 0;
        for (start, body) in starts[1..].iter_mut().zip(DemoBody::ALL) {
            share += body.share();
            *start = (count as u128 * share as u128 / 1000) as usize;
        }
        BodyLayout { starts }
    }

    pub(super) fn members(&self, body: DemoBody) -> Range<usize> {
        let at = body as usize;
        self.starts[at]..self.starts[at + 1]
    }

    /// Returns the attributes at rest and the motion of the Gaussian with the id `id`, which must be less than the
    /// number of Gaussians of the scene.
    pub(super) fn part(&self, id: usize) -> DemoGaussian {
        let body = DemoBody::ALL[self.starts.partition_point(|&start| start <= id) - 1];
        let members = self.members(body);
        let dice = GaussianRandom(id as u64);
        let (k, n) = (id - members.start, members.len());
        match body {
            DemoBody::Wall => wall(k, n, dice),
            DemoBody::Double => self.double(k, n, dice),
            DemoBody::Buried => buried(dice),
            DemoBody::Dust => dust(dice),
            DemoBody::Egg => egg(k, n, dice),
            DemoBody::Cloth => cloth(k, n, dice),
            DemoBody::Fading => fading(dice),
            DemoBody::Spark => spark(dice),
            DemoBody::Wire => wire(k, n, dice),
        }
    }

    fn double(&self, k: usize, n: usize, dice: GaussianRandom) -> DemoGaussian {
        let walls = self.members(DemoBody::Wall);
        // A scene of two Gaussians has a double but no wall.
        let original = (k as u128 * walls.len() as u128 / n as u128) as usize;
        let mut part = wall(original, walls.len().max(1), GaussianRandom((walls.start + original) as u64));
        let size = f64::from(part.log_scale[0]).exp();
        part.position += part.rotation * DVec3::new(dice.signed(0), dice.signed(1), 0.0) * (0.1 * size);
        part.log_scale = part.log_scale.map(|x| x - 0.1);
        part.opacity_logit -= 1.0;
        part
    }
}

fn wall(k: usize, n: usize, dice: GaussianRandom) -> DemoGaussian {
    /// Height of the walls, scene units.
    const HIGH: f64 = 2.5;
    /// Width and depth of the room, scene units.
    const WIDE: f64 = 4.0;
    /// Area of one wall, square scene units.
    const WALL: f64 = HIGH * WIDE;
    const FLOOR: f64 = WIDE * WIDE;
    const ALL: f64 = FLOOR + 3.0 * WALL;

    let at = (k as f64 + 0.5) / n as f64 * ALL;
    let DVec2 { x: u, y: v } = spread(k);
    let (across, up, side) = (WIDE * (u - 0.5), HIGH * v, 0.5 * WIDE);
    let facing_x = DQuat::from_rotation_y(FRAC_PI_2);
    let (position, facing, hue) = if at < FLOOR {
        (DVec3::new(across, WIDE * (v - 0.5), 0.0), DQuat::IDENTITY, [0.55, 0.45, 0.35])
    } else if at < FLOOR + WALL {
        (DVec3::new(across, side, up), facing_y(), [0.45, 0.55, 0.65])
    } else if at < FLOOR + 2.0 * WALL {
        (DVec3::new(-side, across, up), facing_x, [0.65, 0.4, 0.4])
    } else {
        (DVec3::new(side, across, up), facing_x, [0.4, 0.6, 0.45])
    };
    let tile = (position / 0.5).floor();
    let dark = (tile.x + tile.y + tile.z).rem_euclid(2.0) == 0.0;
    let size = 0.6 * (ALL / n as f64).sqrt();
    let scale = [size * dice.between(0, 0.9, 1.4), size * dice.between(1, 0.7, 0.9), 0.1 * size];
    let rotation = facing * DQuat::from_rotation_z(dice.between(2, 0.0, TAU));
    still(
        position,
        rotation,
        scale,
        dice.between(3, 3.0, 5.0),
        color(hue.map(|c| if dark { 0.6 * c } else { c }), dice),
    )
}

fn buried(dice: GaussianRandom) -> DemoGaussian {
    let position = DVec3::new(1.8 * dice.signed(0), dice.between(1, 2.3, 2.8), dice.between(2, 0.2, 2.2));
    let size = dice.between(3, 0.03, 0.06);
    still(position, facing_y(), [size, size, 0.5 * size], 3.0, color([0.9, 0.1, 0.9], dice))
}

fn dust(dice: GaussianRandom) -> DemoGaussian {
    let position = DVec3::new(1.9 * dice.signed(0), 1.9 * dice.signed(1), dice.between(2, 0.1, 2.4));
    let size = dice.between(3, 0.002, 0.004);
    still(position, DQuat::IDENTITY, [size; 3], dice.between(4, -4.0, -1.0), color([0.7; 3], dice))
}

fn egg(k: usize, n: usize, dice: GaussianRandom) -> DemoGaussian {
    let axes = DVec3::new(0.3, 0.3, 0.42);
    let DVec2 { x: turn, y: height } = spread(k);
    let z = 2.0 * height - 1.0;
    let (sin, cos) = (TAU * turn).sin_cos();
    let ball = DVec3::new(cos, sin, 0.0) * (1.0 - z * z).max(0.0).sqrt() + DVec3::Z * z;
    let size = 0.7 * (1.5 / n as f64).sqrt();
    let band = if (4.0 * turn).floor() % 2.0 == 0.0 { [0.95, 0.75, 0.2] } else { [0.2, 0.35, 0.8] };
    let rotation = DQuat::from_rotation_arc(DVec3::Z, (ball / axes).normalize());
    let scale = [size, size, 0.2 * size];
    DemoGaussian { motion: DemoMotion::Egg, ..still(ball * axes, rotation, scale, 4.0, color(band, dice)) }
}

fn cloth(k: usize, n: usize, dice: GaussianRandom) -> DemoGaussian {
    const HIGH: f64 = 1.1;
    let DVec2 { x: along, y: up } = spread(k);
    let position = DVec3::new(-1.6 + CLOTH_WIDTH * along, 1.0, 0.7 + HIGH * up);
    let size = 0.7 * (CLOTH_WIDTH * HIGH / n as f64).sqrt();
    let stripe = if (6.0 * up).floor() % 2.0 == 0.0 { [0.85, 0.85, 0.8] } else { [0.75, 0.15, 0.15] };
    let scale = [size, size, 0.1 * size];
    DemoGaussian { motion: DemoMotion::Wave { along }, ..still(position, facing_y(), scale, 4.0, color(stripe, dice)) }
}

fn fading(dice: GaussianRandom) -> DemoGaussian {
    let position = DVec3::new(1.1, 0.8, 1.0) + 0.4 * DVec3::new(dice.signed(0), dice.signed(1), dice.signed(2));
    let size = dice.between(3, 0.03, 0.06);
    let (start, end) = if dice.unit(4) < 0.5 { (BRIGHT, GONE) } else { (GONE, BRIGHT) };
    let cloud = still(position, DQuat::IDENTITY, [size; 3], start, color([0.8, 0.8, 0.9], dice));
    DemoGaussian { motion: DemoMotion::Fade { rate: end - start }, ..cloud }
}

fn spark(dice: GaussianRandom) -> DemoGaussian {
    let position = DVec3::new(0.9, -0.5, 0.1);
    let velocity = DVec3::new(2.0 * dice.signed(0), 2.0 * dice.signed(1), dice.between(2, 3.0, 5.0));
    // The peak is at a time at which the whole life span of the spark fits into the sequence.
    let motion =
        DemoMotion::Spark { peak: dice.between(3, HALF_LIFE, 1.0 - HALF_LIFE), half_life: HALF_LIFE, velocity };
    DemoGaussian { motion, ..still(position, DQuat::IDENTITY, [0.02; 3], BRIGHT, color([1.0, 0.8, 0.3], dice)) }
}

fn wire(k: usize, n: usize, dice: GaussianRandom) -> DemoGaussian {
    const WIRES: usize = 4;
    const SPAN: f64 = 3.8;
    let (which, at) = (k % WIRES, k / WIRES);
    let along = (at as f64 + 0.5) / n.div_ceil(WIRES) as f64;
    let sag = 0.3 + 0.15 * which as f64;
    let position = DVec3::new(SPAN * (along - 0.5), -1.2 + 0.7 * which as f64, 2.3 - sag * 4.0 * along * (1.0 - along));
    let tangent = DVec3::new(SPAN, 0.0, -sag * 4.0 * (1.0 - 2.0 * along)).normalize();
    let length = 0.6 * SPAN / n.div_ceil(WIRES) as f64;
    let scale = [length, length / 25.0, length / 25.0];
    still(position, DQuat::from_rotation_arc(DVec3::X, tangent), scale, 4.0, color([0.15, 0.15, 0.2], dice))
}
