//! Scene of `splatsieve demo`: a meadow with a windmill, a flag, a bouncing ball and a walking figure.
//!
//! Every value is a function of the id of the Gaussian, the number of Gaussians and the time, so nothing is stored.
//! Every motion ends where it began, so that a film of the scene can be repeated without a jump.

use std::f64::consts::{FRAC_PI_2, TAU};

use glam::{DQuat, DVec2, DVec3};

use super::motion::{
    BALL_RADIUS, CLOTH_WIDTH, DemoGaussian, DemoMotion, GaussianRandom, color, facing_y, spread, still,
};
use super::{Reader, SH_DEGREE};
use crate::error::Result;
use crate::model::{Attributes, Camera, Rig, RigView, SequenceInfo, Split};
use crate::source::{BlockReader, FrameSource, Ids};

/// Number of cameras of [`Playground::rig`].
const CAMERAS: u32 = 12;
/// Indices of the views that are used only for testing. No test view is at an end of the arc of cameras, so each lies
/// between training views.
const TEST_VIEWS: [u32; 3] = [2, 5, 9];
/// Width and height of the images of the cameras, pixels.
const RENDER: (u32, u32) = (320, 240);
/// Radius of the round ground and of the half sphere of the sky, scene units. The cameras are inside.
const HORIZON: f64 = 8.0;
/// Side length of one square of the checkerboard on the ground, scene units.
const TILE: f64 = 0.8;
/// Half the side length of the checkerboard on the ground, scene units.
const BOARD: f64 = 3.2;
/// Position of the foot of the windmill's tower, scene units.
const MILL: DVec3 = DVec3::new(-1.4, 1.0, 0.0);
/// Height of the windmill's tower, scene units.
const TOWER_HEIGHT: f64 = 1.8;
/// Position of the hub around which the windmill's sails turn, scene units.
const HUB: DVec3 = DVec3::new(MILL.x, MILL.y - 0.52, TOWER_HEIGHT);
/// Length of one sail of the windmill, scene units.
const SAIL: f64 = 1.15;
/// Position of the foot of the flagpole, scene units.
const POLE: DVec3 = DVec3::new(0.75, 1.1, 0.0);
/// Height of the flagpole, scene units.
const POLE_HEIGHT: f64 = 2.5;

/// Objects of the scene in the order of the ids of their Gaussians, each with its number of Gaussians in a scene of
/// 1000 Gaussians.
const SHARES: [(PlaygroundObject, usize); 11] = [
    (PlaygroundObject::Sky, 40),
    (PlaygroundObject::Ground, 330),
    (PlaygroundObject::Trunk, 20),
    (PlaygroundObject::Crown, 110),
    (PlaygroundObject::Tower, 130),
    (PlaygroundObject::Cap, 30),
    (PlaygroundObject::Sails, 90),
    (PlaygroundObject::Pole, 10),
    (PlaygroundObject::Flag, 90),
    (PlaygroundObject::Ball, 70),
    (PlaygroundObject::Figure, 80),
];

/// Object of the demo scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PlaygroundObject {
    Sky,
    Ground,
    Trunk,
    Crown,
    Tower,
    Cap,
    Sails,
    Pole,
    Flag,
    Ball,
    Figure,
}

/// Scene of `splatsieve demo`: a generated meadow with moving objects. z points up; the cameras stand on the side of
/// −y.
///
/// A scene of more Gaussians has the same surfaces, made of smaller Gaussians. A scene of more frames samples the same
/// motion more finely.
///
/// ```
/// use splatsieve::diagnostics::demo_scene::Playground;
/// use splatsieve::source::FrameSource;
///
/// let scene = Playground::new(Playground::DEFAULT_COUNT, Playground::DEFAULT_FRAMES);
/// assert_eq!(scene.info().count, 20_000);
/// assert_eq!(scene.rig().cameras.len(), 12);
/// ```
#[derive(Debug, Clone)]
pub struct Playground {
    info: SequenceInfo,
}

impl Playground {
    /// Default number of Gaussians of the generated scene.
    pub const DEFAULT_COUNT: usize = 20_000;
    /// Default number of frames of the generated scene.
    pub const DEFAULT_FRAMES: usize = 48;

    /// Creates the scene with `count` Gaussians and `frames` frames at evenly spaced times from 0 (included) to 1
    /// (excluded).
    pub fn new(count: usize, frames: usize) -> Playground {
        let info = SequenceInfo {
            count,
            times: (0..frames).map(|frame| frame as f64 / frames as f64).collect(),
            sh_degree: SH_DEGREE,
            varying: Attributes::POSITION | Attributes::ROTATION,
        };
        Playground { info }
    }

    /// Returns the cameras: twelve on an arc in front of the scene. Every camera sees every frame. Three of them take
    /// test views, the others take training views.
    pub fn rig(&self) -> Rig {
        let camera = |view: u32| {
            let angle = (-66.0 + 12.0 * f64::from(view)).to_radians();
            let eye = DVec3::new(5.0 * angle.sin(), -5.0 * angle.cos(), 1.3 + 0.5 * f64::from(view % 3));
            Camera::look_at(eye, DVec3::new(0.0, 0.2, 1.0), 50f64.to_radians(), RENDER)
        };
        let split = |view| if TEST_VIEWS.contains(&view) { Split::Test } else { Split::Train };
        let rig_view = |view| RigView { view, camera: view, time: None, split: split(view), image: None };
        Rig {
            cameras: (0..CAMERAS).map(camera).collect(),
            views: (0..CAMERAS).map(rig_view).collect(),
            background: Some([0.0; 3]),
            origin: "demo scene".into(),
        }
    }

    /// Returns the attributes at rest and the motion of the Gaussian with the id `id`, which must be less than the
    /// number of Gaussians of the scene.
    fn part(&self, id: usize) -> DemoGaussian {
        let dice = GaussianRandom(id as u64);
        let (mut start, mut share) = (0, 0);
        for (object, parts) in SHARES {
            share += parts;
            let end = (self.info.count as u128 * share as u128 / 1000) as usize;
            if id < end {
                return gaussian(object, id - start, end - start, dice);
            }
            start = end;
        }
        unreachable!("the shares add up to 1000")
    }
}

impl FrameSource for Playground {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        Reader::open(&self.info, ids, |id| self.part(id))
    }
}

/// Point on the surface of an object at which a Gaussian is placed, with the properties of the surface there.
struct SurfacePoint {
    position: DVec3,
    normal: DVec3,
    rgb: [f64; 3],
    /// Area of the surface that the Gaussian covers, square scene units.
    area: f64,
    motion: DemoMotion,
}

/// Returns Gaussian `k` (from 0) of the `n` Gaussians that form the surface of `object`. `dice`: source of its random
/// numbers.
fn gaussian(object: PlaygroundObject, k: usize, n: usize, dice: GaussianRandom) -> DemoGaussian {
    let point = match object {
        PlaygroundObject::Sky => sky(k, n),
        PlaygroundObject::Ground => ground(k, n),
        PlaygroundObject::Trunk => trunk(k, n),
        PlaygroundObject::Crown => crown(k, n, dice),
        PlaygroundObject::Tower => tower(k, n),
        PlaygroundObject::Cap => cap(k, n),
        PlaygroundObject::Sails => sails(k, n),
        PlaygroundObject::Pole => pole(k, n),
        PlaygroundObject::Flag => flag(k, n),
        PlaygroundObject::Ball => ball(k, n),
        PlaygroundObject::Figure => figure(k, n),
    };
    let size = 0.6 * point.area.sqrt() * dice.between(0, 0.9, 1.2);
    let facing = match object {
        PlaygroundObject::Flag | PlaygroundObject::Sails => facing_y(),
        _ => DQuat::from_rotation_arc(DVec3::Z, point.normal),
    };
    let rotation = facing * DQuat::from_rotation_z(dice.between(1, 0.0, TAU));
    let opacity = dice.between(2, 3.0, 5.0);
    let sh = color(point.rgb, dice);
    let made = still(point.position, rotation, [size, dice.between(3, 0.75, 1.0) * size, 0.15 * size], opacity, sh);
    DemoGaussian { motion: point.motion, ..made }
}

/// Returns point `k` of a sequence of points on the unit sphere. Its first n points are spread evenly, for every n. So
/// each of n points represents an area of 4π/n on the sphere.
fn on_sphere(k: usize) -> DVec3 {
    let DVec2 { x: turn, y: height } = spread(k);
    let z = 2.0 * height - 1.0;
    let (sin, cos) = (TAU * turn).sin_cos();
    DVec3::new(cos, sin, 0.0) * (1.0 - z * z).max(0.0).sqrt() + DVec3::Z * z
}

fn sky(k: usize, n: usize) -> SurfacePoint {
    let DVec2 { x: turn, y: height } = spread(k);
    let (sin, cos) = (TAU * turn).sin_cos();
    let direction = DVec3::new(cos, sin, 0.0) * (1.0 - height * height).sqrt() + DVec3::Z * height;
    let mix = height.sqrt();
    let rgb = [(0.88, 0.40), (0.93, 0.63), (0.97, 0.93)].map(|(low, high)| low + (high - low) * mix);
    // Each Gaussian is larger than its share of the sky, so that the few Gaussians leave no gaps.
    let area = 1.6 * TAU * HORIZON * HORIZON / n as f64;
    SurfacePoint { position: HORIZON * direction, normal: -direction, rgb, area, motion: DemoMotion::Still }
}

fn ground(k: usize, n: usize) -> SurfacePoint {
    /// Exponent p that sets how the Gaussians of the ground are spread: their distances from the center are `HORIZON` ·
    /// u^p, with u evenly spread over [0, 1]. With p = 0.5, Gaussians are equally dense everywhere; a larger p places
    /// fewer and larger Gaussians far from the center.
    const DENSITY: f64 = 0.8;
    let DVec2 { x: turn, y: part } = spread(k);
    let radius = HORIZON * part.powf(DENSITY);
    let (sin, cos) = (TAU * turn).sin_cos();
    let position = DVec3::new(radius * cos, radius * sin, 0.0);
    let tile = (position / TILE).floor();
    let is_dark = (tile.x + tile.y).rem_euclid(2.0) == 0.0;
    let rgb = match position.abs().max_element() < BOARD {
        true if is_dark => [0.36, 0.50, 0.34],
        true => [0.83, 0.82, 0.72],
        false => [0.47, 0.62, 0.38],
    };
    let area = TAU * HORIZON * HORIZON * DENSITY * part.powf(2.0 * DENSITY - 1.0) / n as f64;
    SurfacePoint { position, normal: DVec3::Z, rgb, area, motion: DemoMotion::Still }
}

/// Returns point `k` of `n` on the side of a truncated cone, without its end faces. The cone stands on the point `foot`
/// and has the height `height`; its radius changes from `low` at the foot to `high` at the top (scene units).
fn cone(k: usize, n: usize, foot: DVec3, [low, high]: [f64; 2], height: f64) -> SurfacePoint {
    let DVec2 { x: turn, y: up } = spread(k);
    let (sin, cos) = (TAU * turn).sin_cos();
    let radius = low + (high - low) * up;
    SurfacePoint {
        position: foot + DVec3::new(radius * cos, radius * sin, height * up),
        normal: DVec3::new(cos, sin, (low - high) / height).normalize(),
        rgb: [0.5; 3],
        area: TAU * 0.5 * (low + high) * height / n as f64,
        motion: DemoMotion::Still,
    }
}

/// Positions at which the trunks of the trees stand on the ground, scene units.
const TREES: [DVec3; 2] = [DVec3::new(2.7, 1.6, 0.0), DVec3::new(-3.0, 2.2, 0.0)];

fn trunk(k: usize, n: usize) -> SurfacePoint {
    let (tree, k, n) = (k % TREES.len(), k / TREES.len(), n.div_ceil(TREES.len()));
    SurfacePoint { rgb: [0.42, 0.29, 0.2], ..cone(k, n, TREES[tree], [0.16, 0.1], 0.8) }
}

fn crown(k: usize, n: usize, dice: GaussianRandom) -> SurfacePoint {
    let (tree, k, n) = (k % TREES.len(), k / TREES.len(), n.div_ceil(TREES.len()));
    let axes = DVec3::new(0.62, 0.62, 0.72);
    let at = on_sphere(k);
    let shade = 0.75 + 0.2 * at.z + 0.1 * dice.signed(4);
    SurfacePoint {
        position: TREES[tree] + DVec3::Z * 1.35 + axes * at * dice.between(5, 0.88, 1.04),
        normal: (at / axes).normalize(),
        rgb: [0.25, 0.5, 0.22].map(|c| c * shade),
        area: 2.0 * TAU * 0.43 / n as f64,
        motion: DemoMotion::Still,
    }
}

fn tower(k: usize, n: usize) -> SurfacePoint {
    let point = cone(k, n, MILL, [0.58, 0.36], TOWER_HEIGHT);
    let place = point.position - MILL;
    let is_front = place.y < 0.0;
    let is_door = is_front && place.x.abs() < 0.16 && place.z < 0.55;
    let is_window = is_front && place.x.abs() < 0.11 && (place.z - 1.05).abs() < 0.13;
    let rgb = match (is_door, is_window) {
        (true, _) => [0.35, 0.2, 0.12],
        (_, true) => [0.25, 0.33, 0.42],
        _ if (place.z / 0.3).floor().rem_euclid(2.0) == 0.0 => [0.93, 0.9, 0.82],
        _ => [0.86, 0.8, 0.7],
    };
    SurfacePoint { rgb, ..point }
}

fn cap(k: usize, n: usize) -> SurfacePoint {
    let mut at = on_sphere(k);
    at.z = at.z.abs();
    let axes = DVec3::new(0.42, 0.42, 0.4);
    SurfacePoint {
        position: MILL + DVec3::Z * TOWER_HEIGHT + axes * at,
        normal: (at / axes).normalize(),
        rgb: [0.72, 0.2, 0.16],
        area: TAU * 0.17 / n as f64,
        motion: DemoMotion::Still,
    }
}

/// Returns point `k` of `n` on the four sails of the windmill, which turn once during the sequence.
fn sails(k: usize, n: usize) -> SurfacePoint {
    const WIDTH: f64 = 0.3;
    let (sail, k, n) = (k % 4, k / 4, n.div_ceil(4));
    let DVec2 { x: across, y: along } = spread(k);
    let is_spar = across < 0.16;
    let is_rung = (9.0 * along).fract() < 0.22;
    let rgb = if is_spar || is_rung { [0.36, 0.22, 0.14] } else { [0.97, 0.96, 0.92] };
    let flat = DVec3::new(WIDTH * (across - 0.08), 0.0, 0.12 + (SAIL - 0.12) * along);
    let turned = DQuat::from_rotation_y(FRAC_PI_2 * sail as f64 + 0.3);
    SurfacePoint {
        position: HUB + turned * flat,
        normal: DVec3::Y,
        rgb,
        area: WIDTH * SAIL / n as f64,
        motion: DemoMotion::Turn { pivot: HUB, angle: TAU },
    }
}

fn pole(k: usize, n: usize) -> SurfacePoint {
    SurfacePoint { rgb: [0.8, 0.8, 0.83], ..cone(k, n, POLE, [0.035, 0.025], POLE_HEIGHT) }
}

fn flag(k: usize, n: usize) -> SurfacePoint {
    const HEIGHT: f64 = 0.8;
    let DVec2 { x: along, y: up } = spread(k);
    let disk = DVec2::new(CLOTH_WIDTH * (along - 0.5), HEIGHT * (up - 0.5)).length();
    let rgb = match (3.0 * up).floor() as usize {
        _ if disk < 0.22 => [0.98, 0.8, 0.15],
        0 => [0.1, 0.3, 0.65],
        1 => [0.95, 0.95, 0.95],
        _ => [0.82, 0.15, 0.2],
    };
    SurfacePoint {
        position: POLE + DVec3::new(0.03 + CLOTH_WIDTH * along, 0.0, POLE_HEIGHT - 0.05 - HEIGHT * (1.0 - up)),
        normal: DVec3::Y,
        rgb,
        area: CLOTH_WIDTH * HEIGHT / n as f64,
        motion: DemoMotion::Wave { along },
    }
}

fn ball(k: usize, n: usize) -> SurfacePoint {
    let at = on_sphere(k);
    // Stripes from pole to pole around y, the axis that the ball rolls around.
    let sector = (6.0 * (at.x.atan2(at.z) / TAU + 0.5)).floor() as usize;
    let rgb = match sector % 6 {
        _ if at.y.abs() > 0.93 => [0.95, 0.95, 0.95],
        0 | 3 => [0.9, 0.16, 0.14],
        1 | 4 => [0.96, 0.95, 0.93],
        _ => [0.98, 0.72, 0.1],
    };
    SurfacePoint {
        position: BALL_RADIUS * at,
        normal: at,
        rgb,
        area: 2.0 * TAU * BALL_RADIUS * BALL_RADIUS / n as f64,
        motion: DemoMotion::Bounce,
    }
}

/// Part of the walking figure: an ellipsoid that swings around a joint.
struct Limb {
    center: DVec3,
    axes: DVec3,
    joint: DVec3,
    swing: f64,
    rgb: [f64; 3],
    /// Number of Gaussians of this limb per 100 Gaussians of the figure.
    share: usize,
}

/// Returns the parts of the figure (head, trunk, legs and arms). The feet of the figure stand at the origin, and it
/// faces +x.
fn limbs() -> [Limb; 6] {
    let still = |center, axes, rgb, share| Limb { center, axes, joint: DVec3::ZERO, swing: 0.0, rgb, share };
    let swinging = |side: f64, height: f64, length: f64, thick: f64, swing: f64, rgb, share| Limb {
        center: DVec3::new(0.0, side, height - 0.5 * length),
        axes: DVec3::new(thick, thick, 0.55 * length),
        joint: DVec3::new(0.0, side, height),
        swing,
        rgb,
        share,
    };
    let (shirt, skin, trousers) = ([0.85, 0.35, 0.12], [0.9, 0.7, 0.56], [0.16, 0.2, 0.4]);
    [
        still(DVec3::new(0.0, 0.0, 1.13), DVec3::new(0.13, 0.12, 0.15), skin, 14),
        still(DVec3::new(0.0, 0.0, 0.76), DVec3::new(0.13, 0.19, 0.28), shirt, 30),
        swinging(0.1, 0.55, 0.52, 0.085, 0.55, trousers, 18),
        swinging(-0.1, 0.55, 0.52, 0.085, -0.55, trousers, 18),
        swinging(0.24, 0.95, 0.44, 0.055, -0.6, shirt, 10),
        swinging(-0.24, 0.95, 0.44, 0.055, 0.6, shirt, 10),
    ]
}

fn figure(k: usize, n: usize) -> SurfacePoint {
    let mut start = 0;
    let mut share = 0;
    for limb in limbs() {
        share += limb.share;
        let end = n * share / 100;
        if k < end {
            let at = on_sphere(k - start);
            // Surface area of the ellipsoid by Thomsen's formula, which is accurate to 1%.
            let [a, b, c] = limb.axes.to_array().map(|axis| axis.powf(1.6));
            let area = 2.0 * TAU * ((a * b + a * c + b * c) / 3.0).powf(1.0 / 1.6);
            return SurfacePoint {
                position: limb.center + limb.axes * at,
                normal: (at / limb.axes).normalize(),
                rgb: limb.rgb,
                area: area / (end - start) as f64,
                motion: DemoMotion::Walk { joint: limb.joint, swing: limb.swing },
            };
        }
        start = end;
    }
    unreachable!("the shares add up to 100")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Gaussians;
    use crate::render::render;

    fn state(scene: &Playground, frame: usize) -> Gaussians {
        let mut out = Gaussians::zeros(0, SH_DEGREE);
        let ids = Ids::Range(0..scene.info().count);
        scene.open(ids).unwrap().read(frame, Attributes::all(), &mut out).unwrap();
        out
    }

    #[test]
    fn shares_add_up_and_every_count_gives_finite_values() {
        assert_eq!(SHARES.iter().map(|share| share.1).sum::<usize>(), 1000);
        assert_eq!(limbs().iter().map(|limb| limb.share).sum::<usize>(), 100);
        for count in [1, 7, 1003] {
            let scene = Playground::new(count, 3);
            let state = state(&scene, 2);
            assert_eq!(state.len(), count);
            let columns = [&state.position, &state.rotation, &state.log_scale, &state.opacity_logit, &state.sh];
            assert!(columns.iter().all(|column| column.planes().iter().all(|x| x.is_finite())), "{count}");
        }
    }

    #[test]
    fn every_camera_sees_a_full_render_that_changes_with_time() {
        let scene = Playground::new(Playground::DEFAULT_COUNT, 12);
        let [first, later] = [0, 5].map(|frame| state(&scene, frame));
        for camera in &scene.rig().cameras {
            let [a, b] = [&first, &later].map(|state| render(state, camera, [1.0, 0.0, 1.0]));
            // The background would be pink.
            let pink = a.data.chunks_exact(3).filter(|p| p[0] > 0.8 && p[1] < 0.25 && p[2] > 0.8).count();
            assert!(pink < a.data.len() / 3 / 500, "{pink} pixels of background");
            let differing = a.data.iter().zip(&b.data).filter(|(a, b)| (*a - *b).abs() > 0.1).count();
            assert!(differing > a.data.len() / 100, "{differing} values of {} change", a.data.len());
        }
    }

    #[test]
    fn the_last_frame_leads_back_to_the_first() {
        let scene = Playground::new(2000, 40);
        let moved = |a: usize, b: usize| {
            let [a, b] = [a, b].map(|frame| state(&scene, frame));
            let far = (0..2000).map(|i| {
                let [a, b] = [&a, &b].map(|state| DVec3::from_array(state.position_f64(i)));
                (a - b).length()
            });
            far.fold(0.0, f64::max)
        };
        let longest = (0..39).map(|frame| moved(frame, frame + 1)).fold(0.0, f64::max);
        let back = moved(39, 0);
        assert!(back <= 1.01 * longest, "{back} back, {longest} at most between frames");
    }
}
