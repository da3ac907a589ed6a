//! Cameras in between those of a scene: an unpruned model can be rendered from anywhere, so that what is fitted to its
//! pictures need not be fitted to the views of its cameras alone.

use glam::{DMat3, DQuat, DVec3};

use crate::model::Camera;

/// Part of the way from one camera to the other: from this, and as far before the end.
const NEAR_END: f64 = 0.15;
/// Cosine of the angle between two cameras, as seen from where the optical axes meet, up to which there is a way from one
/// to the other: a third of a turn and a bit. Halfway between opposite ones a camera could look anywhere.
const WIDEST: f64 = -0.6;

/// `count` cameras, each on the way from one of `cameras` to another that stands no more than a third of a turn away, as
/// seen from where the optical axes meet, or else to the nearest one: turned evenly, that point at its place in the
/// pictures, and as far from it as its way along says. Ways between neighbors alone leave the middle of a rig empty. None
/// where all cameras stand at one place. The same for the same cameras.
pub fn between(cameras: &[Camera], count: usize) -> Vec<Camera> {
    let focus = meeting_point(cameras);
    let mut dice = SplitMix64(0);
    let mut found = Vec::with_capacity(count);
    for _ in 0..count {
        let Some(from) = cameras.get(dice.below(cameras.len())) else { break };
        let away = |other: &&Camera| other.center().distance_squared(from.center());
        let elsewhere = || cameras.iter().filter(|other| away(other) > 0.0);
        let direction = |camera: &Camera| (camera.center() - focus).normalize_or_zero();
        let is_near = |other: &&Camera| direction(other).dot(direction(from)) > WIDEST;
        let near: Vec<&Camera> = elsewhere().filter(is_near).collect();
        let nearest = || elsewhere().min_by(|a, b| away(a).total_cmp(&away(b)));
        let Some(to) = near.get(dice.below(near.len())).copied().or_else(nearest) else { continue };
        let way = NEAR_END + (1.0 - 2.0 * NEAR_END) * dice.unit();
        found.push(on_the_way(from, to, way, focus));
    }
    found
}

/// The camera at a part `way` of the way from one to another, see [`between`]; `focus`: where the optical axes meet.
pub(super) fn on_the_way(from: &Camera, to: &Camera, way: f64, focus: DVec3) -> Camera {
    let [a, b] = [from, to].map(|camera| DQuat::from_mat3(&camera.rotation));
    let turned = DMat3::from_quat(a.slerp(b, way));
    let [start, end] = [from, to].map(|camera| camera.center() - focus);
    let straight = start.lerp(end, way);
    let distance = start.length() * (1.0 - way) + end.length() * way;
    // Where the way leads through that point it stays straight.
    let center = focus + straight.try_normalize().map_or(straight, |direction| direction * distance);
    // On a wide way turning evenly loses sight of that point: it stays at its place in the pictures.
    let seen = |camera: &Camera| (camera.rotation * (focus - camera.center())).normalize_or_zero();
    let wanted = seen(from).lerp(seen(to), way).normalize_or_zero();
    let found = (turned * (focus - center)).normalize_or_zero();
    let is_known = wanted.is_normalized() && found.is_normalized();
    let back = if is_known { DQuat::from_rotation_arc(found, wanted) } else { DQuat::IDENTITY };
    let rotation = DMat3::from_quat(back) * turned;
    Camera { rotation, translation: -(rotation * center), ..from.clone() }
}

/// The point nearest to all optical axes in the sense of least squares; of parallel ones the middle of the cameras.
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

/// Numbers that look random and are always the same: SplitMix64 (Steele, Lea and Flood, 2014).
#[derive(Debug, Clone)]
pub struct SplitMix64(pub u64);

impl SplitMix64 {
    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut bits = self.0;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        bits ^ (bits >> 31)
    }

    /// In [0, 1).
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Below `end`; 0 of 0.
    pub fn below(&mut self, end: usize) -> usize {
        ((u128::from(self.bits()) * end as u128) >> 64) as usize
    }

    /// `values` in another order.
    pub fn shuffle<T>(&mut self, values: &mut [T]) {
        for k in (1..values.len()).rev() {
            values.swap(k, self.below(k + 1));
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
    fn cameras_in_between_see_what_the_others_see_from_as_far_away() {
        let cameras = ring(9);
        let focus = DVec3::new(0.1, 0.2, 0.3);
        assert!(meeting_point(&cameras).distance(focus) < 1e-9);
        let found = between(&cameras, 50);
        assert_eq!((found.len(), &found), (50, &between(&cameras, 50)));
        let distances: Vec<f64> = cameras.iter().map(|camera| camera.center().distance(focus)).collect();
        let [least, most] = [f64::min, f64::max].map(|of| distances.iter().copied().reduce(of).unwrap());
        for camera in &found {
            let rotation = camera.rotation * camera.rotation.transpose();
            assert!((rotation - DMat3::IDENTITY).to_cols_array().iter().all(|x| x.abs() < 1e-9));
            let distance = camera.center().distance(focus);
            assert!((least - 1e-9..=most + 1e-9).contains(&distance), "{distance} of {least} to {most}");
            let ahead = (camera.rotation * focus + camera.translation).normalize();
            assert!(ahead.z > 0.9, "the scene is off the picture: {ahead}");
            assert!(cameras.iter().all(|other| other.center().distance(camera.center()) > 1e-3));
        }
    }

    #[test]
    fn no_camera_one_camera_and_cameras_at_one_place_have_none_in_between() {
        let one = ring(1);
        assert!(between(&[], 5).is_empty() && between(&one, 5).is_empty());
        assert!(between(&[one[0].clone(), one[0].clone()], 5).is_empty());
        // Parallel axes meet nowhere.
        let aside =
            |x: f64| Camera { translation: DVec3::new(x, 0.0, 0.0), rotation: DMat3::IDENTITY, ..one[0].clone() };
        assert!(between(&[aside(0.0), aside(1.0)], 5).iter().all(|camera| camera.center().is_finite()));
    }

    #[test]
    fn a_shuffle_loses_nothing_and_numbers_stay_below_their_end() {
        let mut dice = SplitMix64(7);
        let mut values: Vec<usize> = (0..100).collect();
        dice.shuffle(&mut values);
        assert!(!values.is_sorted());
        values.sort_unstable();
        assert!(values.iter().copied().eq(0..100));
        assert!((0..1000).all(|_| dice.below(3) < 3 && (0.0..1.0).contains(&dice.unit())));
        assert_eq!(dice.below(0), 0);
    }
}
