//! A way through cameras.

use super::between::{meeting_point, on_the_way};
use crate::model::Camera;

/// `count` cameras on the way through all of `stops`, in order, from the first to the last: each is turned evenly from stop to
/// stop and as far from where their optical axes meet as its way along says; angle of view and principal point change evenly,
/// too. Steps are of one length, where stops stand apart. Pictures are of the first stop's size.
pub fn along(stops: &[Camera], count: usize) -> Vec<Camera> {
    let (Some(first), Some(last)) = (stops.first(), stops.last()) else { return Vec::new() };
    let focus = meeting_point(stops);
    let mut legs: Vec<f64> = stops.windows(2).map(|pair| pair[0].center().distance(pair[1].center())).collect();
    // Cameras that only turn.
    if legs.iter().sum::<f64>() <= 0.0 {
        legs.fill(1.0);
    }
    let whole: f64 = legs.iter().sum();
    let at = |k: usize| {
        if k == 0 {
            return first.clone();
        }
        if k + 1 == count {
            return Camera { width: first.width, height: first.height, ..last.clone() };
        }
        let mut left = whole * k as f64 / (count - 1) as f64;
        for (pair, &leg) in stops.windows(2).zip(&legs) {
            if left <= leg && leg > 0.0 {
                return between(&pair[0], &pair[1], left / leg, focus, first);
            }
            left -= leg;
        }
        last.clone()
    };
    (0..count).map(at).collect()
}

fn between(from: &Camera, to: &Camera, way: f64, focus: glam::DVec3, first: &Camera) -> Camera {
    let even = |of: fn(&Camera) -> f64| of(from) * (1.0 - way) + of(to) * way;
    Camera {
        fx: even(|camera| camera.fx),
        fy: even(|camera| camera.fy),
        cx: even(|camera| camera.cx),
        cy: even(|camera| camera.cy),
        width: first.width,
        height: first.height,
        ..on_the_way(from, to, way, focus)
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// Cameras on a circle of radius 3, a sixth of a turn apart, that look at its middle with growing angles of view.
    fn arc() -> Vec<Camera> {
        let at = |k: u32| {
            let angle = f64::from(k) * std::f64::consts::TAU / 6.0;
            let eye = DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.0);
            Camera::look_at(eye, DVec3::ZERO, 0.6 + 0.1 * f64::from(k), (64, 48))
        };
        (0..3).map(at).collect()
    }

    #[test]
    fn a_way_begins_and_ends_at_cameras_and_keeps_to_the_circle_they_stand_on() {
        let stops = arc();
        let way = along(&stops, 21);
        assert_eq!((way.len(), &way[0], &way[20]), (21, &stops[0], &stops[2]));
        assert!(way[10].center().distance(stops[1].center()) < 1e-9, "half of the way is the middle camera");
        let mut before = -1e-9;
        for camera in &way {
            let center = camera.center();
            assert!((center.length() - 3.0).abs() < 1e-9, "{center} is off the circle");
            let angle = center.y.atan2(center.x);
            assert!(angle > before, "{angle} after {before}");
            before = angle;
            let ahead = camera.rotation * DVec3::ZERO + camera.translation;
            assert!(ahead.x.abs() < 1e-9 && ahead.y.abs() < 1e-9, "the middle is off the picture's: {ahead}");
        }
        assert!((way[5].fx - 0.5 * (stops[0].fx + stops[1].fx)).abs() < 1e-9);
    }

    #[test]
    fn one_camera_cameras_at_one_place_and_none_have_ways_too() {
        let stops = arc();
        assert!(along(&[], 3).is_empty());
        assert!(along(&stops[..1], 3).iter().all(|camera| *camera == stops[0]));
        let turned = Camera::look_at(stops[0].center(), DVec3::new(0.0, 1.0, 0.0), 0.6, (64, 48));
        let way = along(&[stops[0].clone(), turned], 5);
        assert!(way.iter().all(|camera| camera.center().distance(stops[0].center()) < 1e-9));
        assert_eq!(along(&stops, 1), stops[..1]);
    }
}
