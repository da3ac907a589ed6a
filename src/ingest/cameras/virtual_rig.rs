//! A stated rig for scenes that come without cameras.

use glam::DVec3;

use crate::model::{Camera, Rig, Shot, Split};

/// Cameras of the rig: as many scoring views as the static models of the README have.
const CAMERAS: u32 = 12;
/// Distance from the centre in extents. At 60° the picture then spans 2.3 extents, so that a scene of
/// equal sides is seen whole from every corner.
const DISTANCE: f64 = 2.0;
const FIELD_OF_VIEW_DEGREES: f64 = 60.0;
/// Near plane in extents: what is seen does not depend on the unit of length.
const NEAR: f64 = 0.1;
const SIDE_PX: u32 = 512;

/// Cameras on a Fibonacci sphere of radius 2 × `extent` around `center`, looking at it, every one at
/// every frame, all for training; [`crate::stats::RobustBox`] gives the two numbers.
///
/// Camera k of n looks from latitude asin(1 − (2k + 1)/n) and longitude k·π(3 − √5); z is up in the
/// pictures. An extent that is zero or not finite counts as 1, a centre that is not finite as 0.
pub fn virtual_rig(center: DVec3, extent: f64) -> Rig {
    let center = if center.is_finite() { center } else { DVec3::ZERO };
    let extent = if extent.is_finite() && extent > 0.0 { extent } else { 1.0 };
    let radius = DISTANCE * extent;
    let golden_angle = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let cameras = (0..CAMERAS).map(|k| {
        let z = 1.0 - f64::from(2 * k + 1) / f64::from(CAMERAS);
        let (sin, cos) = (golden_angle * f64::from(k)).sin_cos();
        let outward = DVec3::new(cos, sin, 0.0) * (1.0 - z * z).sqrt() + DVec3::Z * z;
        let (eye, angle) = (center + radius * outward, FIELD_OF_VIEW_DEGREES.to_radians());
        Camera { near: NEAR * extent, ..Camera::look_at(eye, center, angle, (SIDE_PX, SIDE_PX)) }
    });
    let shot = |view| Shot { view, camera: view, time: None, split: Split::Train, image: None };
    Rig {
        cameras: cameras.collect(),
        shots: (0..CAMERAS).map(shot).collect(),
        background: None,
        origin: format!(
            "virtual rig: {CAMERAS} cameras on a Fibonacci sphere of radius {radius:.6} around ({:.6}, {:.6}, {:.6}), \
             {FIELD_OF_VIEW_DEGREES}° field of view, {SIDE_PX}×{SIDE_PX} pixels, every frame",
            center.x, center.y, center.z
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn virtual_cameras_see_the_centre_in_the_middle_of_the_picture() {
        let center = DVec3::new(3.0, -2.0, 7.0);
        let rig = virtual_rig(center, 1.5);
        assert_eq!(rig.cameras.len(), 12);
        for camera in &rig.cameras {
            let seen = camera.rotation * center + camera.translation;
            assert!((seen - DVec3::new(0.0, 0.0, 3.0)).length() < 1e-12, "{seen}");
            assert!((camera.rotation.determinant() - 1.0).abs() < 1e-12);
            let up = camera.rotation * (center + 0.1 * DVec3::Z) + camera.translation;
            assert!(up.y < 0.0, "z is up in the picture, y is down: {up}");
            assert!((camera.fx - 256.0 / 30f64.to_radians().tan()).abs() < 1e-9);
        }
    }

    #[test]
    fn virtual_cameras_surround_the_scene() {
        let rig = virtual_rig(DVec3::ZERO, 1.0);
        let mean: DVec3 = rig.cameras.iter().map(Camera::center).sum::<DVec3>() / 12.0;
        assert!(mean.length() < 0.3, "{mean}");
        let closest =
            rig.cameras.iter().enumerate().flat_map(|(i, a)| {
                rig.cameras[..i].iter().map(move |b| a.center().angle_between(b.center()).to_degrees())
            });
        assert!(closest.fold(f64::MAX, f64::min) > 40.0);
    }

    #[test]
    fn a_scene_without_extent_still_has_cameras() {
        for extent in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let rig = virtual_rig(DVec3::NAN, extent);
            assert!(rig.cameras.iter().all(|camera| (camera.center().length() - 2.0).abs() < 1e-12));
        }
    }
}
