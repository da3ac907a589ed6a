//! Virtual cameras for scenes without cameras: a rig around a moving scene, and a rig that views the surface of a still
//! (model without motion) from all sides.

use glam::DVec3;

use crate::model::{Camera, Rig, RigView, Split};

/// Number of cameras around a moving scene. The static models in docs/benchmarks.md are scored with the same number of
/// cameras.
const CAMERAS: u32 = 12;
/// Distance of the cameras around a moving scene from its center, as a multiple of the extent of the scene. With a
/// field of view of 60° the image then spans 2.3 extents, so a cube-shaped scene fits into the image even when seen
/// from a corner.
const DISTANCE: f64 = 2.0;
/// Horizontal field of view in degrees of the cameras around a moving scene.
const FIELD_OF_VIEW_DEGREES: f64 = 60.0;
/// Distance of the near plane from a camera around a moving scene, as a multiple of the extent of the scene. It is
/// relative, so that visibility does not depend on the unit of length.
const NEAR: f64 = 0.1;
/// Image width and height in pixels, for the cameras around a moving scene.
const SIDE_PX: u32 = 512;

/// Returns cameras on a Fibonacci sphere of radius 2 × `extent` around `center`, all looking at the center. Every
/// camera sees every frame and is a training view. [`crate::model::RobustBox`] gives `center` and `extent`.
///
/// Camera k of n is at latitude asin(1 − (2k + 1)/n) and longitude k·π(3 − √5); z points up in the images. An extent
/// that is zero, negative or not finite counts as 1, a center that is not finite as 0.
pub fn virtual_rig(center: DVec3, extent: f64) -> Rig {
    let center = if center.is_finite() { center } else { DVec3::ZERO };
    let extent = if extent.is_finite() && extent > 0.0 { extent } else { 1.0 };
    let radius = DISTANCE * extent;
    let cameras = (0..CAMERAS).map(|k| {
        let (eye, angle) = (center + radius * on_sphere(k, CAMERAS), FIELD_OF_VIEW_DEGREES.to_radians());
        Camera { near: NEAR * extent, ..Camera::look_at(eye, center, angle, (SIDE_PX, SIDE_PX)) }
    });
    let rig_view = |view| RigView { view, camera: view, time: None, split: Split::Train, image: None };
    Rig {
        cameras: cameras.collect(),
        views: (0..CAMERAS).map(rig_view).collect(),
        background: None,
        origin: format!(
            "virtual rig: {CAMERAS} cameras on a Fibonacci sphere of radius {radius:.6} around ({:.6}, {:.6}, {:.6}), \
             {FIELD_OF_VIEW_DEGREES}° field of view, {SIDE_PX}×{SIDE_PX} pixels, every frame",
            center.x, center.y, center.z
        ),
    }
}

/// Number of cameras around a still (model without motion). With 24 evenly distributed cameras, every part of the
/// surface is seen by some camera at more than a grazing angle.
const SURROUNDING_CAMERAS: u32 = 24;
/// Distance of the cameras around a still from its center, as a multiple of the radius of its visible surface.
const SURROUNDING_DISTANCE: f64 = 2.2;
/// Field of view in degrees of the cameras around a still (model without motion). A sphere with the radius of its
/// visible surface nearly fills the image.
const SURROUNDING_FIELD_OF_VIEW_DEGREES: f64 = 49.0;
/// Image width and height in pixels, for the cameras around a still.
const SURROUNDING_SIDE_PX: u32 = 320;
/// Fraction that defines the radius of a still (model without motion): Gaussians with 9/10 of the total visible area
/// lie within this radius of the center. Most Gaussians outside are floaters and ground.
const WEIGHT_WITHIN_RADIUS: f64 = 0.9;

/// Returns cameras around the visible surface of a still (model without motion), evenly distributed on a Fibonacci
/// sphere. All of them are training views.
///
/// - `weights` holds the visible area of each Gaussian: its opacity times the product of its two larger scales. So
///   floaters, which are many but have little opacity or area, count little. Weights above the 99th percentile are
///   reduced to this percentile, so that a backdrop of few huge Gaussians does not dominate.
/// - The center of the sphere is the weighted median of `positions`, separately for x, y and z.
/// - The radius of the surface is the distance from the center within which nine tenths of the weight lie. The sphere
///   has 2.2 times this radius.
pub fn surrounding_rig(positions: &[DVec3], weights: &[f64]) -> Rig {
    let mut all: Vec<(DVec3, f64)> = positions
        .iter()
        .copied()
        .zip(weights.iter().copied())
        .filter(|(position, weight)| position.is_finite() && *weight > 0.0)
        .collect();
    let mut sorted: Vec<f64> = all.iter().map(|&(_, weight)| weight).collect();
    sorted.sort_by(f64::total_cmp);
    let most = sorted.get(sorted.len() * 99 / 100).copied().unwrap_or(1.0);
    all.iter_mut().for_each(|(_, weight)| *weight = weight.min(most));
    let quantile = |fraction: f64, coordinate: &dyn Fn(DVec3) -> f64| -> f64 {
        let mut values: Vec<(f64, f64)> =
            all.iter().map(|&(position, weight)| (coordinate(position), weight)).collect();
        values.sort_by(|a, b| a.0.total_cmp(&b.0));
        let wanted = fraction * values.iter().map(|value| value.1).sum::<f64>();
        let mut sum = 0.0;
        let found = values.iter().find(|value| {
            sum += value.1;
            sum >= wanted
        });
        found.or(values.last()).map_or(0.0, |value| value.0)
    };
    let middle = DVec3::from_array([0, 1, 2].map(|axis| quantile(0.5, &|position| position[axis])));
    let radius = quantile(WEIGHT_WITHIN_RADIUS, &|position| position.distance(middle));
    let radius = if radius > 0.0 { radius } else { 1.0 };
    let distance = SURROUNDING_DISTANCE * radius;
    let camera = |k: u32| {
        let eye = middle + distance * on_sphere(k, SURROUNDING_CAMERAS);
        let camera = Camera::look_at(
            eye,
            middle,
            SURROUNDING_FIELD_OF_VIEW_DEGREES.to_radians(),
            (SURROUNDING_SIDE_PX, SURROUNDING_SIDE_PX),
        );
        Camera { near: NEAR * radius, ..camera }
    };
    let rig_view = |view| RigView { view, camera: view, time: None, split: Split::Train, image: None };
    Rig {
        cameras: (0..SURROUNDING_CAMERAS).map(camera).collect(),
        views: (0..SURROUNDING_CAMERAS).map(rig_view).collect(),
        background: None,
        origin: format!(
            "virtual rig: {SURROUNDING_CAMERAS} cameras on a Fibonacci sphere of radius {distance:.6} around the \
             surface at ({:.6}, {:.6}, {:.6}), {SURROUNDING_FIELD_OF_VIEW_DEGREES}° field of view, \
             {SURROUNDING_SIDE_PX}×{SURROUNDING_SIDE_PX} pixels",
            middle.x, middle.y, middle.z
        ),
    }
}

/// Returns direction `k` of `n` directions that are evenly distributed over the unit sphere: latitude asin(1 − (2k +
/// 1)/n), longitude k·π(3 − √5).
fn on_sphere(k: u32, n: u32) -> DVec3 {
    let golden_angle = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let z = 1.0 - f64::from(2 * k + 1) / f64::from(n);
    let (sin, cos) = (golden_angle * f64::from(k)).sin_cos();
    DVec3::new(cos, sin, 0.0) * (1.0 - z * z).sqrt() + DVec3::Z * z
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn virtual_cameras_look_at_the_center_with_z_up() {
        let center = DVec3::new(3.0, -2.0, 7.0);
        let rig = virtual_rig(center, 1.5);
        assert_eq!(rig.cameras.len(), 12);
        for camera in &rig.cameras {
            let seen = camera.rotation * center + camera.translation;
            assert!((seen - DVec3::new(0.0, 0.0, 3.0)).length() < 1e-12, "{seen}");
            assert!((camera.rotation.determinant() - 1.0).abs() < 1e-12);
            let up = camera.rotation * (center + 0.1 * DVec3::Z) + camera.translation;
            assert!(up.y < 0.0, "z is up in the image, y is down: {up}");
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
    fn floaters_do_not_move_the_rig_around_a_still() {
        let shell: Vec<DVec3> = (0..500).map(|k| DVec3::new(5.0, -2.0, 1.0) + on_sphere(k, 500)).collect();
        let alone = surrounding_rig(&shell, &[1.0; 500]);
        for camera in &alone.cameras {
            assert!((camera.center().distance(DVec3::new(5.0, -2.0, 1.0)) - 2.2).abs() < 0.2, "{}", camera.center());
            let seen = camera.rotation * DVec3::new(5.0, -2.0, 1.0) + camera.translation;
            assert!(seen.truncate().length() < 0.1 && seen.z > 1.9, "{seen}");
        }
        let floating = (0..400).map(|k| 80.0 * on_sphere(k, 400));
        let positions: Vec<DVec3> = shell.iter().copied().chain(floating).collect();
        let weights: Vec<f64> = (0..900).map(|k| if k < 500 { 1.0 } else { 0.01 }).collect();
        let rig = surrounding_rig(&positions, &weights);
        for (a, b) in rig.cameras.iter().zip(&alone.cameras) {
            assert!(a.center().distance(b.center()) < 0.1, "{} {}", a.center(), b.center());
        }
        assert_eq!(surrounding_rig(&[], &[]).cameras.len(), 24);
    }

    #[test]
    fn a_scene_without_extent_still_has_cameras() {
        for extent in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let rig = virtual_rig(DVec3::NAN, extent);
            assert!(rig.cameras.iter().all(|camera| (camera.center().length() - 2.0).abs() < 1e-12));
        }
    }
}
