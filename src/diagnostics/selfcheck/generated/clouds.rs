//! Generated Gaussians and cameras that are difficult for a rasterizer.

use crate::model::{Camera, Gaussians};
use glam::{DMat3, DQuat, DVec3};

/// Returns a camera near the origin that looks approximately along +z. It is rotated a little, so that its axes are not
/// parallel to the world axes.
pub fn tilted_camera(width: u32, height: u32) -> Camera {
    Camera {
        width,
        height,
        fx: 0.9 * f64::from(width),
        fy: 0.95 * f64::from(width),
        cx: 0.5 * f64::from(width) + 1.3,
        cy: 0.5 * f64::from(height) - 0.7,
        rotation: DMat3::from_quat(DQuat::from_xyzw(0.05, -0.03, 0.02, 1.0).normalize()),
        translation: DVec3::new(0.1, -0.2, 0.3),
        near: Camera::NEAR,
    }
}

/// Returns a camera at the origin whose axes coincide with the world axes, with square images of `size` × `size`
/// pixels.
pub fn plain_camera(size: u32) -> Camera {
    Camera {
        width: size,
        height: size,
        fx: 50.0,
        fy: 50.0,
        cx: 0.5 * f64::from(size),
        cy: 0.5 * f64::from(size),
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
        near: Camera::NEAR,
    }
}

/// Generator of pseudo-random numbers in [0, 1) by splitmix64. The field is its state, at first the seed.
pub struct Random(pub u64);

impl Random {
    /// Returns the next number in [0, 1).
    pub fn next_f32(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 40) as f32 / (1u64 << 24) as f32
    }

    /// Returns the next number in [`low`, `high`).
    pub fn next_in(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.next_f32()
    }
}

/// Returns `count` random Gaussians of the SH degree `degree`: among them needles, flat, very large and very small
/// ones, some with quaternions that are not normalized, some off-screen. The same `seed` gives the same Gaussians.
pub fn random_gaussians(seed: u64, count: usize, degree: usize) -> Gaussians {
    let mut random = Random(seed);
    let mut scene = Gaussians::zeros(count, degree);
    for i in 0..count {
        let depth = random.next_in(-0.5, 6.0);
        let reach = depth.abs() + 0.3;
        scene.position.set_row(i, [random.next_in(-reach, reach), random.next_in(-reach, reach), depth]);
        scene.rotation.set_row(i, std::array::from_fn::<f32, 4, _>(|_| random.next_in(-2.0, 2.0)));
        scene.log_scale.set_row(i, std::array::from_fn::<f32, 3, _>(|_| random.next_in(-6.5, -1.0)));
        scene.opacity_logit.set_row(i, [random.next_in(-6.0, 6.0)]);
        for c in 0..scene.sh.width() {
            scene.sh.plane_mut(c)[i] = random.next_in(-0.5, 0.5) * if c < 3 { 3.0 } else { 1.0 };
        }
    }
    scene
}

/// Returns one round Gaussian with the color (1, ½, 0), the standard deviation `scale` and the opacity `opacity`, on
/// the optical axis of [`plain_camera`] at the distance `depth`.
pub fn single_gaussian(depth: f32, scale: f32, opacity: f32) -> Gaussians {
    let mut one = Gaussians::zeros(1, 0);
    one.position.set_row(0, [0.0, 0.0, depth]);
    one.rotation.set_row(0, [1.0, 0.0, 0.0, 0.0]);
    one.log_scale.set_row(0, [scale.ln(); 3]);
    one.opacity_logit.set_row(0, [(opacity / (1.0 - opacity)).ln()]);
    one.sh.set_row(0, [0.5 / 0.282_094_8, 0.0, -9.0]);
    one
}
