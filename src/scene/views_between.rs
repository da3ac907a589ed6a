//! Cameras in between those of a scene. The original model can be rendered from any camera, so refinement can fit
//! renders from more views than the scene's cameras give.

use glam::{DMat3, DQuat, DVec3};

use crate::model::Camera;

/// Smallest distance of a new camera from either of the two cameras between which it is placed, as a fraction of the
/// path between these two.
const MIN_FRACTION: f64 = 0.15;
/// A new camera is placed between two cameras if the cosine of the angle between their directions, as seen from the
/// point where the optical axes meet, is above this value. So the angle is at most about 127°. Halfway between opposite
/// cameras, the viewing direction would be undefined.
const MIN_COSINE: f64 = -0.6;

/// Returns `count` new cameras, each at a random place on a path between two of `cameras`. Along a path, rotation and
/// distance from the point where the optical axes meet are interpolated evenly. Returns no camera if all cameras are at
/// one position. The random numbers are the same in every run.
///
/// - The camera at the start of a path is chosen at random.
/// - The camera at its end is chosen at random among the cameras that are less than about 127° away, as seen from the
///   point where the optical axes meet. If there are none, the nearest camera at another position is taken.
///
/// Paths between neighbors only would leave the middle of a rig empty.
pub fn cameras_between(cameras: &[Camera], count: usize) -> Vec<Camera> {
    let focus = meeting_point(cameras);
    let mut random = SplitMix64(0);
    let mut found = Vec::with_capacity(count);
    for _ in 0..count {
        let Some(from) = cameras.get(random.next_below(cameras.len())) else { break };
        let squared_distance = |other: &&Camera| other.center().distance_squared(from.center());
        let elsewhere = || cameras.iter().filter(|other| squared_distance(other) > 0.0);
        let direction = |camera: &Camera| (camera.center() - focus).normalize_or_zero();
        let is_near = |other: &&Camera| direction(other).dot(direction(from)) > MIN_COSINE;
        let near: Vec<&Camera> = elsewhere().filter(is_near).collect();
        let nearest = || elsewhere().min_by(|a, b| squared_distance(a).total_cmp(&squared_distance(b)));
        let Some(to) = near.get(random.next_below(near.len())).copied().or_else(nearest) else { continue };
        let fraction = MIN_FRACTION + (1.0 - 2.0 * MIN_FRACTION) * random.next_unit_f64();
        found.push(interpolated_camera(from, to, fraction, focus));
    }
    found
}

/// Returns the camera at the fraction `fraction` (0 to 1) of the path from the camera `from` to the camera `to`.
/// `focus` is the point where the optical axes meet. The rotation, the distance from `focus`, and the direction in
/// which the camera sees `focus` are interpolated evenly.
pub(super) fn interpolated_camera(from: &Camera, to: &Camera, fraction: f64, focus: DVec3) -> Camera {
    let [a, b] = [from, to].map(|camera| DQuat::from_mat3(&camera.rotation));
    let rotated = DMat3::from_quat(a.slerp(b, fraction));
    let [start, end] = [from, to].map(|camera| camera.center() - focus);
    let linear = start.lerp(end, fraction);
    let distance = start.length() * (1.0 - fraction) + end.length() * fraction;
    // If the path passes through the focus, the center is interpolated linearly.
    let center = focus + linear.try_normalize().map_or(linear, |direction| direction * distance);
    // If the two cameras are far apart, even rotation alone would turn the focus out of sight, so the camera is turned
    // back toward it.
    let seen = |camera: &Camera| (camera.rotation * (focus - camera.center())).normalize_or_zero();
    let wanted = seen(from).lerp(seen(to), fraction).normalize_or_zero();
    let direction = (rotated * (focus - center)).normalize_or_zero();
    let is_known = wanted.is_normalized() && direction.is_normalized();
    let correction = if is_known { DQuat::from_rotation_arc(direction, wanted) } else { DQuat::IDENTITY };
    let rotation = DMat3::from_quat(correction) * rotated;
    Camera { rotation, translation: -(rotation * center), ..from.clone() }
}

/// Returns the point at which the optical axes of all cameras meet: the point nearest to all of them in the
/// least-squares sense. For parallel axes, returns the mean of the camera positions.
pub(super) fn meeting_point(cameras: &[Camera]) -> DVec3 {
    let (mut matrix, mut right, mut middle) = (DMat3::ZERO, DVec3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let axis = camera.rotation.row(2);
        let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        matrix += across;
        right += across * camera.center();
        middle += camera.center();
    }
    let count = cameras.len().max(1) as f64;
    let point = matrix.inverse() * right;
    if matrix.determinant().abs() > 1e-6 * count.powi(3) && point.is_finite() { point } else { middle / count }
}

/// Pseudo-random number generator SplitMix64 (Steele, Lea and Flood, 2014; its mixer is Stafford's variant 13). The
/// field is the state of the generator, at first the seed. The numbers depend on the seed only.
#[derive(Debug, Clone)]
pub struct SplitMix64(pub u64);

impl SplitMix64 {
    /// Returns the next 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut bits = self.0;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        bits ^ (bits >> 31)
    }

    /// Returns a uniformly distributed random number in [0, 1).
    pub fn next_unit_f64(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns a uniformly distributed random integer below `end`; 0 if `end` is 0.
    pub fn next_below(&mut self, end: usize) -> usize {
        ((u128::from(self.next_u64()) * end as u128) >> 64) as usize
    }

    /// Shuffles `values` into a random order.
    pub fn shuffle<T>(&mut self, values: &mut [T]) {
        for k in (1..values.len()).rev() {
            values.swap(k, self.next_below(k + 1));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring(count: usize) -> Vec<Camera> {
        let eye = |k: usize| {
            let angle = std::f64::consts::TAU * k as f64 / count as f64;
            DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 1.0)
        };
        (0..count).map(|k| Camera::look_at(eye(k), DVec3::new(0.1, 0.2, 0.3), 0.8, (64, 48))).collect()
    }

    #[test]
    fn new_cameras_see_the_focus_from_the_same_distance() {
        let cameras = ring(9);
        let focus = DVec3::new(0.1, 0.2, 0.3);
        assert!(meeting_point(&cameras).distance(focus) < 1e-9);
        let found = cameras_between(&cameras, 50);
        assert_eq!((found.len(), &found), (50, &cameras_between(&cameras, 50)));
        let distances: Vec<f64> = cameras.iter().map(|camera| camera.center().distance(focus)).collect();
        let [least, most] = [f64::min, f64::max].map(|pick| distances.iter().copied().reduce(pick).unwrap());
        for camera in &found {
            let rotation = camera.rotation * camera.rotation.transpose();
            assert!((rotation - DMat3::IDENTITY).to_cols_array().iter().all(|x| x.abs() < 1e-9));
            let distance = camera.center().distance(focus);
            assert!((least - 1e-9..=most + 1e-9).contains(&distance), "{distance} of {least} to {most}");
            let ahead = (camera.rotation * focus + camera.translation).normalize();
            assert!(ahead.z > 0.9, "the scene is outside the image: {ahead}");
            assert!(cameras.iter().all(|other| other.center().distance(camera.center()) > 1e-3));
        }
    }

    #[test]
    fn too_few_distinct_cameras_have_none_between() {
        let one = ring(1);
        assert!(cameras_between(&[], 5).is_empty() && cameras_between(&one, 5).is_empty());
        assert!(cameras_between(&[one[0].clone(), one[0].clone()], 5).is_empty());
        // Optical axes that are parallel do not meet.
        let aside =
            |x: f64| Camera { translation: DVec3::new(x, 0.0, 0.0), rotation: DMat3::IDENTITY, ..one[0].clone() };
        assert!(cameras_between(&[aside(0.0), aside(1.0)], 5).iter().all(|camera| camera.center().is_finite()));
    }

    #[test]
    fn shuffle_permutes_and_numbers_stay_in_range() {
        let mut random = SplitMix64(7);
        let mut values: Vec<usize> = (0..100).collect();
        random.shuffle(&mut values);
        assert!(!values.is_sorted());
        values.sort_unstable();
        assert!(values.iter().copied().eq(0..100));
        assert!((0..1000).all(|_| random.next_below(3) < 3 && (0.0..1.0).contains(&random.next_unit_f64())));
        assert_eq!(random.next_below(0), 0);
    }
}
