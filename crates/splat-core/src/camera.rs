//! Pinhole cameras: pose and intrinsics.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// Pinhole camera in OpenCV axes (x right, y down, z forward). Pixel centers lie at half integers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x in pixels.
    pub fx: f64,
    /// Focal length along y in pixels.
    pub fy: f64,
    /// Horizontal principal point in pixels; the image center is at `width / 2`.
    pub cx: f64,
    /// Vertical principal point in pixels; the image center is at `height / 2`.
    pub cy: f64,
    /// Rotation from world to camera.
    pub rotation: DMat3,
    /// Translation from world to camera: `x_camera = rotation · x_world + translation`.
    pub translation: DVec3,
    /// Depth of the near plane in scene units; Gaussians whose center has this depth or less are not drawn.
    pub near: f64,
}

impl Camera {
    /// Depth of the near plane ([`Camera::near`]) in the original CUDA rasterizer, with which models are trained.
    pub const NEAR: f64 = 0.2;

    /// Creates a camera at `eye` that looks at `target`. World z points up in the image, and pixels are square.
    ///
    /// `horizontal_fov` is the horizontal field of view in radians; the last argument is the image size in pixels. The
    /// rotation is NaN if `eye` and `target` are equal or lie on one vertical line.
    pub fn look_at(eye: DVec3, target: DVec3, horizontal_fov: f64, (width, height): (u32, u32)) -> Camera {
        let forward = (target - eye).normalize();
        let right = forward.cross(DVec3::Z).normalize();
        let down = forward.cross(right);
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        let focal = 0.5 * f64::from(width) / (0.5 * horizontal_fov).tan();
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

    /// Returns the position of the camera in world coordinates, scene units.
    pub fn center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn center_has_camera_coordinates_zero() {
        let camera = Camera::look_at(DVec3::new(1.0, 2.0, 3.0), DVec3::new(-1.0, 0.5, 0.0), 0.9, (10, 10));
        assert!((camera.center() - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-14);
        assert!((camera.rotation * camera.center() + camera.translation).length() < 1e-14);
    }

    #[test]
    fn target_is_in_the_image_center_and_z_is_up() {
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
