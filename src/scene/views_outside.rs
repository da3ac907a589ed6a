//! Cameras outside the rig (the cameras of a scene). They see the scene from new directions: no camera of the rig, and
//! no camera on a path between two of them, sees it from there. In a player or in VR, people move to such places.

use std::collections::BTreeSet;
use std::f64::consts::PI;

use glam::{DMat3, DQuat, DVec3};

use super::Scene;
use super::views_between::{SplitMix64, cameras_between, meeting_point};
use crate::model::{Camera, Rig, Split, ViewSchedule};

/// View number of all views from cameras outside the rig. No data set uses this number.
const VIEW_NUMBER: u32 = u32::MAX;
/// Number of different cameras outside the rig that are created, as a multiple of the largest number of views at one
/// frame.
const CAMERAS_PER_VIEW: usize = 8;
/// Maximum number of different cameras outside the rig.
const MAX_CAMERAS: usize = 64;
/// Minimum angle at which a camera counts as outside the rig, radians (2°): the angle between the direction of the
/// camera and the nearest direction in the cone of the rig ([`RigCone`]).
pub const MIN_ANGLE: f64 = 2.0 * PI / 180.0;
/// Minimum weight of the quality outside the rig (the parameter `outside`) at which views from outside are scored and
/// rank the Gaussians. With a smaller weight, only refinement has such views: to score them would cost quality at the
/// cameras of the scene.
pub const MIN_SCORED_OUTSIDE: f64 = 0.1;
/// Maximum number of random cameras that are tried for each wanted camera outside the rig.
const TRIES_PER_CAMERA: usize = 64;
/// Maximum number of iterations in [`RigCone::angle`], which searches a cone for the direction nearest to a given one.
/// Each iteration adds the direction of one camera to a weighted sum that approaches the given direction.
const MAX_DIRECTIONS: usize = 64;
/// Tolerance of [`RigCone::angle`], which searches a cone for the direction nearest to a given one. It has two uses:
/// - The search ends if the remainder (given direction minus the nearest point of the cone found so far) has a dot
///   product of at most this value with every camera direction of the cone.
/// - Vectors count as linearly dependent if the absolute value of their determinant is at most this value.
const ANGLE_TOLERANCE: f64 = 1e-12;
/// Tolerance for the faces of a cone, with two uses:
/// - A direction is on a face if the sine of its angle to the face is below this value.
/// - Two faces are the same if their unit normals are at most this distance apart.
const FACE_TOLERANCE: f64 = 1e-6;

/// Directions from which the cameras of a rig see the scene: the convex cone of the directions from the point where
/// their optical axes meet to the cameras.
pub struct RigCone {
    focus: DVec3,
    directions: Vec<DVec3>,
}

impl RigCone {
    /// Returns the cone of the directions from the point where the optical axes meet to each of `cameras`. If this
    /// point is not in front of every camera, as for parallel cameras, there is no cone, and no camera counts as
    /// outside.
    pub fn new(cameras: &[Camera]) -> RigCone {
        let focus = meeting_point(cameras);
        let is_ahead = |camera: &Camera| (camera.rotation * (focus - camera.center())).z > 0.0;
        let direction = |camera: &Camera| (camera.center() - focus).try_normalize();
        let directions =
            if cameras.iter().all(is_ahead) { cameras.iter().filter_map(direction).collect() } else { Vec::new() };
        RigCone { focus, directions }
    }

    /// Returns the angle in radians, 0 to π/2, between this cone and the direction from [`RigCone::focus`] to `camera`.
    /// Returns 0 in three cases: the direction is inside the cone, the camera is at the focus, or there is no cone (see
    /// [`RigCone::new`]).
    pub fn angle_outside(&self, camera: &Camera) -> f64 {
        let direction = (camera.center() - self.focus).try_normalize().filter(|_| !self.directions.is_empty());
        direction.map_or(0.0, |direction| self.angle(direction))
    }

    /// Returns the point nearest to the optical axes of all cameras, from which the directions of the cone start.
    pub fn focus(&self) -> DVec3 {
        self.focus
    }

    /// Returns the inward unit normals of the flat faces of the cone. A direction is inside the cone if its dot
    /// products with all of them are at least 0. Takes time in proportion to the cube of the number of cameras.
    pub fn inward_face_normals(&self) -> Vec<DVec3> {
        let all = &self.directions;
        let pairs = (0..all.len()).flat_map(|i| (0..all.len()).filter(move |&j| j != i).map(move |j| (i, j)));
        let normals = pairs.filter_map(|(i, j)| all[i].cross(all[j]).try_normalize());
        let mut faces: Vec<DVec3> = Vec::new();
        for normal in normals.filter(|normal| all.iter().all(|own| normal.dot(*own) > -FACE_TOLERANCE)) {
            if faces.iter().all(|face| face.distance(normal) > FACE_TOLERANCE) {
                faces.push(normal);
            }
        }
        faces
    }

    /// Returns whether `camera` is outside the cone by an angle of at least [`MIN_ANGLE`] (2°).
    pub fn is_outside(&self, camera: &Camera) -> bool {
        self.angle_outside(camera) >= MIN_ANGLE
    }

    /// Returns the angle in radians between the unit vector `direction` and this cone; 0 if `direction` is inside. The
    /// cone consists of all sums Σ wᵢ·dᵢ with weights wᵢ ≥ 0, where the unit vectors dᵢ are the directions from the
    /// focus to the cameras of the rig.
    ///
    /// The nearest point of the cone is Σ wᵢ·dᵢ for the weights wᵢ ≥ 0 that minimize ‖direction − Σ wᵢ·dᵢ‖, found by
    /// the active-set method of Lawson and Hanson (Solving Least Squares Problems, 1974, chapter 23). At most three
    /// weights are above 0. The remainder, `direction` minus the nearest point, is perpendicular to the nearest point.
    fn angle(&self, direction: DVec3) -> f64 {
        let mut used: Vec<(DVec3, f64)> = Vec::new();
        let mut rest = direction;
        for _ in 0..MAX_DIRECTIONS {
            let gain = |own: &&DVec3| own.dot(rest);
            let best = self.directions.iter().max_by(|a, b| gain(a).total_cmp(&gain(b)));
            let Some(best) = best.filter(|own| gain(own) > ANGLE_TOLERANCE) else { break };
            used.push((*best, 0.0));
            if !fit_weights(&mut used, direction) {
                break;
            }
            rest = direction - used.iter().map(|(own, weight)| *own * *weight).sum::<DVec3>();
        }
        rest.length().atan2((direction - rest).length())
    }
}

/// Finds weights ≥ 0 for which the weighted sum of unit vectors is nearest to `direction`. `weighted` has pairs of a
/// vector and its weight; the weights are replaced, and vectors whose weight becomes 0 are removed. Returns false if
/// the vectors are linearly dependent.
fn fit_weights(weighted: &mut Vec<(DVec3, f64)>, direction: DVec3) -> bool {
    loop {
        let Some(free) = least_squares(weighted, direction) else { return false };
        // The weights change toward `free`, the best weights of any sign. A weight that would become negative limits
        // the change to the fraction at which this weight is 0. A weight that is 0 already gives the fraction 0, not
        // 0/0.
        let limit = |(&(_, weight), &free): (&(DVec3, f64), &f64)| {
            (free <= 0.0).then(|| weight / (weight - free).max(f64::MIN_POSITIVE))
        };
        let limits = weighted.iter().zip(&free).map(limit).enumerate();
        let first_zero = limits.filter_map(|(k, limit)| Some((k, limit?))).min_by(|a, b| a.1.total_cmp(&b.1));
        let step = first_zero.map_or(1.0, |(_, limit)| limit);
        weighted.iter_mut().zip(&free).for_each(|((_, weight), free)| *weight += step * (free - *weight));
        let Some((k, _)) = first_zero else { return true };
        // Rounding may leave this weight slightly above 0; without the removal the loop might never end.
        weighted.remove(k);
        weighted.retain(|&(_, weight)| weight > 0.0);
    }
}

/// Returns the weights, of any sign, for which the weighted sum of unit vectors is nearest to `direction`. `weighted`
/// has pairs of a unit vector and a weight, which is ignored. Returns `None` if the vectors are linearly dependent or
/// more than three.
fn least_squares(weighted: &[(DVec3, f64)], direction: DVec3) -> Option<Vec<f64>> {
    match *weighted {
        [(a, _)] => Some(vec![a.dot(direction)]),
        [(a, _), (b, _)] => {
            let (cosine, to_a, to_b) = (a.dot(b), a.dot(direction), b.dot(direction));
            let determinant = 1.0 - cosine * cosine;
            let weights = || vec![(to_a - cosine * to_b) / determinant, (to_b - cosine * to_a) / determinant];
            (determinant > ANGLE_TOLERANCE).then(weights)
        }
        [(a, _), (b, _), (c, _)] => {
            let matrix = DMat3::from_cols(a, b, c);
            let weights = || (matrix.inverse() * direction).to_array().to_vec();
            (matrix.determinant().abs() > ANGLE_TOLERANCE).then(weights)
        }
        _ => None,
    }
}

/// Returns at most `count` cameras outside the rig of `cameras`. The random numbers are the same in every run.
///
/// - Each starts as one of `cameras`, or as a camera between two of them. It is then turned about the point where the
///   optical axes meet, away from the mean direction of the rig. This multiplies its angle from the mean direction by a
///   random factor from 1 to `max_factor`, but the angle at most doubles and never exceeds 180°.
/// - There are fewer than `count` cameras if hardly any direction is outside the rig, as for a rig all around the
///   scene.
/// - There are none for parallel cameras.
pub fn cameras_outside(cameras: &[Camera], count: usize, max_factor: f64) -> Vec<Camera> {
    let cone = RigCone::new(cameras);
    let Some(middle) = cone.directions.iter().sum::<DVec3>().try_normalize() else { return Vec::new() };
    let bases = [cameras, &cameras_between(cameras, count)].concat();
    let mut random = SplitMix64(3);
    let mut found = Vec::with_capacity(count);
    for _ in 0..count * TRIES_PER_CAMERA {
        if found.len() == count {
            break;
        }
        let base = &bases[random.next_below(bases.len())];
        let offset = base.center() - cone.focus;
        let factor = 1.0 + (max_factor - 1.0) * random.next_unit_f64();
        let Some(axis) = middle.cross(offset).try_normalize() else { continue };
        let angle = middle.angle_between(offset);
        let more = angle.min(PI - angle).min((factor - 1.0) * angle);
        let turned = turned_about(base, cone.focus, DQuat::from_axis_angle(axis, more));
        if cone.is_outside(&turned) {
            found.push(turned);
        }
    }
    found
}

/// Returns the cameras of `rig` that took training views.
pub fn training_cameras(rig: &Rig) -> Vec<Camera> {
    let training = rig.views.iter().filter(|rig_view| rig_view.split == Split::Train).map(|rig_view| rig_view.camera);
    let training: BTreeSet<u32> = training.collect();
    training.into_iter().map(|camera| rig.cameras[camera as usize].clone()).collect()
}

/// Returns `camera` after the rotation `turn` about the point `focus`. The turned camera sees what `camera` would see
/// if the scene were rotated the other way about `focus`.
fn turned_about(camera: &Camera, focus: DVec3, turn: DQuat) -> Camera {
    let center = focus + turn * (camera.center() - focus);
    let rotation = camera.rotation * DMat3::from_quat(turn).transpose();
    Camera { rotation, translation: -(rotation * center), ..camera.clone() }
}

impl Scene {
    /// Adds views from cameras outside the rig (the cameras of the scene) to the views of every frame
    /// (`self.schedule`). Gaussians that only these views show are then kept and refined.
    ///
    /// `reach` is a number from 0 to 1 with two effects:
    /// - Position of the added cameras: each is a camera of the rig, or a camera between two of them, rotated about the
    ///   point where the optical axes meet. The rotation multiplies its angle from the mean direction of the rig by a
    ///   random factor from 1 to at most 1 + `reach`.
    /// - Number of added views: a frame with n views gets `reach` · n more, rounded up.
    ///
    /// Adds no views if no camera outside the rig can be found (see [`cameras_outside`]), or if `reach` is less than
    /// [`MIN_SCORED_OUTSIDE`]. Refinement then still fits a few views from outside ([`Scene::outside`]), unless `reach`
    /// is 0.
    pub fn add_outside_views(&mut self, reach: f64) {
        if reach < MIN_SCORED_OUTSIDE {
            self.outside = reach;
            if reach > 0.0 {
                self.depend_on_views();
            }
            return;
        }
        let rig_cameras = self.rig_cameras();
        let count = (CAMERAS_PER_VIEW * self.schedule.max_views_per_frame()).min(MAX_CAMERAS);
        let cameras = cameras_outside(&rig_cameras, count, 1.0 + reach);
        if cameras.is_empty() {
            self.notes.push("outside: the cameras leave no views outside their rig to be added".to_owned());
            return;
        }
        let (first, count) = (self.schedule.cameras.len(), cameras.len());
        let mut schedule = ViewSchedule::new([&self.schedule.cameras[..], &cameras].concat());
        let mut taken = 0;
        for views in self.schedule.iter() {
            let more = taken..taken + (reach * views.len() as f64).ceil() as usize;
            taken = more.end;
            let outside = more.map(|k| (VIEW_NUMBER, (first + k % count) as u32));
            schedule.push_frames(1, &views.iter().copied().chain(outside).collect::<Vec<_>>());
        }
        let rig_count = rig_cameras.len();
        self.notes.push(format!("outside: {count} cameras outside the rig are used beside its {rig_count}"));
        (self.schedule, self.outside) = (schedule, reach);
        self.depend_on_views();
    }

    /// Returns the cameras of the rig from which at least one view in `self.schedule` (the views at each frame) is
    /// seen. Cameras that were added outside the rig are not included.
    pub fn rig_cameras(&self) -> Vec<Camera> {
        let used = self.schedule.used_cameras().into_iter().map(|index| index as usize);
        used.filter(|&index| index < self.rig.cameras.len()).map(|index| self.schedule.cameras[index].clone()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns cameras on an arc of `degrees` degrees around the origin, all at the height 1.
    fn arc(count: usize, degrees: f64) -> Vec<Camera> {
        let eye = |k: usize| {
            let angle = (degrees * (k as f64 / (count - 1) as f64 - 0.5)).to_radians();
            DVec3::new(4.0 * angle.sin(), -4.0 * angle.cos(), 1.0)
        };
        (0..count).map(|k| Camera::look_at(eye(k), DVec3::ZERO, 0.8, (64, 48))).collect()
    }

    #[test]
    fn angle_is_zero_inside_and_exact_outside() {
        let cameras = arc(5, 60.0);
        let cone = RigCone::new(&cameras);
        let between_two = cameras_between(&cameras, 20);
        assert!(cameras.iter().chain(&between_two).all(|camera| cone.angle_outside(camera) < 1e-6));
        // Beyond the end of the arc, the last camera of the arc is nearest.
        let beyond = Camera::look_at(DVec3::new(4.0, 0.0, 1.0), DVec3::ZERO, 0.8, (64, 48));
        let [a, b] = [&beyond, &cameras[4]].map(|camera| camera.center().normalize());
        assert!((cone.angle_outside(&beyond) - a.angle_between(b)).abs() < 1e-6);
        let below = Camera::look_at(DVec3::new(0.0, -1.0, -4.0), DVec3::ZERO, 0.8, (64, 48));
        assert!((cone.angle_outside(&below) - PI / 2.0).abs() < 1e-6, "the cone ends at a right angle");
    }

    #[test]
    fn search_for_the_nearest_direction_ends_for_all_directions() {
        let mut random = SplitMix64(7);
        let mut unit = || {
            let mut axis = || 2.0 * random.next_unit_f64() - 1.0;
            DVec3::new(axis(), axis(), axis()).normalize()
        };
        for cone in 0..300 {
            // Narrow cones with nearly dependent directions are the hardest.
            let middle = unit();
            let directions: Vec<DVec3> = (0..13).map(|_| (middle + 0.3 * unit()).normalize()).collect();
            let cone_of_rig = RigCone { focus: DVec3::ZERO, directions: directions.clone() };
            for _ in 0..200 {
                let direction = (middle + 0.5 * unit()).normalize();
                let angle = cone_of_rig.angle(direction);
                let to_camera = directions.iter().map(|own| own.angle_between(direction)).fold(PI, f64::min);
                assert!((0.0..=to_camera + 1e-6).contains(&angle), "cone {cone}: {angle}, nearest camera {to_camera}");
            }
        }
    }

    #[test]
    fn faces_divide_inside_from_outside() {
        let lower = arc(5, 60.0);
        let raised = |camera: &Camera| Camera::look_at(camera.center() + DVec3::Z, DVec3::ZERO, 0.8, (64, 48));
        let cameras = [lower.clone(), lower.iter().map(raised).collect()].concat();
        let (cone, faces) = (RigCone::new(&cameras), RigCone::new(&cameras).inward_face_normals());
        assert!((4..=10).contains(&faces.len()), "{}", faces.len());
        let is_inside = |camera: &Camera| faces.iter().all(|face| face.dot(camera.center().normalize()) > -1e-4);
        assert!(cameras_between(&cameras, 30).iter().all(is_inside));
        let outer = cameras_outside(&cameras, 30, 1.5);
        assert!(outer.iter().all(|camera| cone.is_outside(camera) && !is_inside(camera)));
    }

    #[test]
    fn new_cameras_are_outside_and_see_the_focus() {
        let cameras = arc(7, 60.0);
        let (cone, found) = (RigCone::new(&cameras), cameras_outside(&cameras, 40, 2.0));
        assert_eq!((found.len(), &found), (40, &cameras_outside(&cameras, 40, 2.0)));
        let widest = found.iter().map(|camera| cone.angle_outside(camera).to_degrees()).fold(0.0, f64::max);
        assert!((20.0..=30.0).contains(&widest), "{widest}");
        for camera in &found {
            assert!(cone.angle_outside(camera) >= MIN_ANGLE);
            assert!((camera.center().length() - 17f64.sqrt()).abs() < 1e-9);
            let ahead = (camera.rotation * -camera.center()).normalize();
            assert!(ahead.z > 1.0 - 1e-9, "turned away from the scene: {ahead}");
        }
    }

    #[test]
    fn rigs_all_around_and_parallel_ones_have_no_outside() {
        let eyes = [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z];
        let around = eyes.map(|eye| Camera::look_at(3.0 * eye + DVec3::splat(0.01), DVec3::ZERO, 0.8, (64, 48)));
        assert!(cameras_outside(&around, 5, 2.0).is_empty());
        let aside =
            |x: f64| Camera { translation: DVec3::new(x, 0.0, 0.0), rotation: DMat3::IDENTITY, ..around[0].clone() };
        let parallel = [aside(0.0), aside(1.0), aside(2.0)];
        assert!(cameras_outside(&parallel, 5, 2.0).is_empty());
        assert_eq!(RigCone::new(&parallel).angle_outside(&around[4]), 0.0);
        assert!(cameras_outside(&[], 5, 2.0).is_empty() && cameras_outside(&around[..1], 5, 2.0).is_empty());
    }
}
