//! Path of a virtual camera through given cameras.

use super::views_between::{interpolated_camera, meeting_point};
use crate::model::Camera;

/// Returns `count` cameras on a path from the first to the last of the cameras `stops`, through all of them in order.
/// Between two stops, rotation, distance from the point where the optical axes meet, focal length and principal point
/// are interpolated evenly. All images have the size of the first stop's image.
///
/// The steps from camera to camera are equally long, measured on straight lines between the stops. If all stops are at
/// one position, there are equally many steps between any two successive stops.
pub fn cameras_along(stops: &[Camera], count: usize) -> Vec<Camera> {
    let (Some(first), Some(last)) = (stops.first(), stops.last()) else { return Vec::new() };
    let focus = meeting_point(stops);
    let mut lengths: Vec<f64> = stops.windows(2).map(|pair| pair[0].center().distance(pair[1].center())).collect();
    // If all stops are at one position, the path has equally many steps between each two successive stops.
    if lengths.iter().sum::<f64>() <= 0.0 {
        lengths.fill(1.0);
    }
    let total: f64 = lengths.iter().sum();
    let at = |k: usize| {
        if k == 0 {
            return first.clone();
        }
        if k + 1 == count {
            return Camera { width: first.width, height: first.height, ..last.clone() };
        }
        let mut left = total * k as f64 / (count - 1) as f64;
        for (pair, &length) in stops.windows(2).zip(&lengths) {
            if left <= length && length > 0.0 {
                return interpolated(&pair[0], &pair[1], left / length, focus, first);
            }
            left -= length;
        }
        last.clone()
    };
    (0..count).map(at).collect()
}

fn interpolated(from: &Camera, to: &Camera, fraction: f64, focus: glam::DVec3, first: &Camera) -> Camera {
    let interpolate = |value: fn(&Camera) -> f64| value(from) * (1.0 - fraction) + value(to) * fraction;
    Camera {
        fx: interpolate(|camera| camera.fx),
        fy: interpolate(|camera| camera.fy),
        cx: interpolate(|camera| camera.cx),
        cy: interpolate(|camera| camera.cy),
        width: first.width,
        height: first.height,
        ..interpolated_camera(from, to, fraction, focus)
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// Returns cameras on a circle of radius 3, each a sixth of a turn from the previous one. They look at the center
    /// of the circle with growing angles of view.
    fn arc() -> Vec<Camera> {
        let at = |k: u32| {
            let angle = f64::from(k) * std::f64::consts::TAU / 6.0;
            let eye = DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.0);
            Camera::look_at(eye, DVec3::ZERO, 0.6 + 0.1 * f64::from(k), (64, 48))
        };
        (0..3).map(at).collect()
    }

    #[test]
    fn path_through_an_arc_stays_on_its_circle() {
        let stops = arc();
        let path = cameras_along(&stops, 21);
        assert_eq!((path.len(), &path[0], &path[20]), (21, &stops[0], &stops[2]));
        assert!(path[10].center().distance(stops[1].center()) < 1e-9, "the middle of the path is the middle camera");
        let mut before = -1e-9;
        for camera in &path {
            let center = camera.center();
            assert!((center.length() - 3.0).abs() < 1e-9, "{center} is off the circle");
            let angle = center.y.atan2(center.x);
            assert!(angle > before, "{angle} after {before}");
            before = angle;
            let ahead = camera.rotation * DVec3::ZERO + camera.translation;
            assert!(
                ahead.x.abs() < 1e-9 && ahead.y.abs() < 1e-9,
                "the circle's center is not at the image center: {ahead}"
            );
        }
        assert!((path[5].fx - 0.5 * (stops[0].fx + stops[1].fx)).abs() < 1e-9);
    }

    #[test]
    fn zero_one_and_coinciding_stops_have_a_path() {
        let stops = arc();
        assert!(cameras_along(&[], 3).is_empty());
        assert!(cameras_along(&stops[..1], 3).iter().all(|camera| *camera == stops[0]));
        let turned = Camera::look_at(stops[0].center(), DVec3::new(0.0, 1.0, 0.0), 0.6, (64, 48));
        let path = cameras_along(&[stops[0].clone(), turned], 5);
        assert!(path.iter().all(|camera| camera.center().distance(stops[0].center()) < 1e-9));
        assert_eq!(cameras_along(&stops, 1), stops[..1]);
    }
}
