//! A camera: where it stands and what it shows of the world.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// A pinhole camera in OpenCV axes (x right, y down, z forward); pixel centers at half integers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Picture width in pixels.
    pub width: u32,
    /// Picture height in pixels.
    pub height: u32,
    /// Focal length along x in pixels.
    pub fx: f64,
    /// Focal length along y in pixels.
    pub fy: f64,
    /// Principal point in pixels; the picture's middle is `width / 2`.
    pub cx: f64,
    /// Principal point in pixels.
    pub cy: f64,
    /// World to camera.
    pub rotation: DMat3,
    /// World to camera: `x_camera = rotation · x_world + translation`.
    pub translation: DVec3,
    /// View depth up to which nothing is seen, scene units.
    pub near: f64,
}

impl Camera {
    /// [`Camera::near`] of the original rasteriser, for which models are trained.
    pub const NEAR: f64 = 0.2;

    /// A camera at `eye` with `target` in the middle of its picture, z up in it, pixels square.
    ///
    /// `angle` is the horizontal field of view in radians, `size` (width, height) in pixels. The two
    /// points must differ and not lie above one another; else the rotation is NaN.
    pub fn look_at(eye: DVec3, target: DVec3, angle: f64, (width, height): (u32, u32)) -> Camera {
        let forward = (target - eye).normalize();
        let right = forward.cross(DVec3::Z).normalize();
        let down = forward.cross(right);
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        let focal = 0.5 * f64::from(width) / (0.5 * angle).tan();
        Camera {
            width,
            height,
            fx: focal,
            fy: focal,
            cx: 0.5 * f64::from(width),
            cy: 0.5 * f64::from(height),
            rotation,
            translation: -(rotation * eye),
            near: Self::NEAR,
        }
    }

    /// Position of the camera in the world.
    pub fn center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn center_is_where_camera_coordinates_vanish() {
        let camera = Camera::look_at(DVec3::new(1.0, 2.0, 3.0), DVec3::new(-1.0, 0.5, 0.0), 0.9, (10, 10));
        assert!((camera.center() - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-14);
        assert!((camera.rotation * camera.center() + camera.translation).length() < 1e-14);
    }

    #[test]
    fn target_is_in_the_middle_and_z_is_up() {
        let target = DVec3::new(-1.0, 0.5, 0.0);
        let camera = Camera::look_at(DVec3::new(1.0, 2.0, 3.0), target, 0.9, (40, 30));
        let seen = camera.rotation * target + camera.translation;
        assert!(seen.x.abs() < 1e-14 && seen.y.abs() < 1e-14 && seen.z > 0.0, "{seen}");
        assert!((camera.rotation * DVec3::Z).y < 0.0);
        assert!((camera.rotation.determinant() - 1.0).abs() < 1e-14);
        let edge = (0.5 * f64::from(camera.width) / camera.fx).atan();
        assert!((edge - 0.45).abs() < 1e-14);
    }
}
